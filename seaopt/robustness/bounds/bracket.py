r"""The worst case from above: bounds on Ms and Mt that no plant of the set exceeds, and a proof that all are stable.

Branch and bound over boxes of the uncertain coordinates times arcs of the unit circle. An arc of a box is done when
its bounds on abs(S) and abs(T) are within a tolerance of the largest that any plant is known to have; else the arc is
halved, or the box, along the coordinate that its bounds suffer from most. A box whose loop has no pole on any arc for
any of its plants, and is stable at its centre, is stable throughout: eigenvalues are continuous.

Every bound is a theorem but for rounding, which is estimated at every step and added, and a billionth besides.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.control import Controller
from seaopt.control.loops.loop import STABLE
from seaopt.errors import ControlError
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.bounds.impulse import Pulse, pulse
from seaopt.robustness.bounds.region import Boxes, Region, region
from seaopt.robustness.bounds.unit_circle import Arcs, Found, bounded
from seaopt.robustness.uncertainty.batch import batch_figures
from seaopt.robustness.uncertainty.draws import Uncertainty
from seaopt.robustness.uncertainty.severity import severities
from seaopt.robustness.uncertainty.worst import Worst

SLACK = 1e-9
AGREE = 1e-6  # of the figures met, which are computed another way
EDGES = np.pi * np.concatenate([[0.0], np.geomspace(1e-5, 1.0, 31)])  # of the arcs at the start
BLOCK = 128  # boxes at a time
ARCS = 4096  # arcs at a time: bounds the memory
CANDIDATES = 16  # arcs of a block at whose worst corners a plant is measured
ARC_SHARE = 0.5  # an arc is halved if the angle's share in D is at least this much of what the box adds to it
SHORTEST = 1e-6  # share of the angle below which halving the arc is of no use
TRIAL = 0.25  # part of the set's width over which it is tried how hard a coordinate is
EASY = 0.9  # sum of the coordinates' hardness with which a box is worth bounding


@record
class Budget:
    """When bounds are near enough, and when to stop.

    Parameters
    ----------
    tolerance : float
        Done when the bounds are within this fraction of the largest Ms and Mt met.
    boxes : int
        Boxes after which to stop, for each plant.
    seconds : float
        The same in time, looked at between blocks of boxes; what is then found depends on the machine.

    """

    tolerance: float = 0.01
    boxes: int = 1000
    seconds: float = 60.0

    def __post_init__(self) -> None:
        for name in ("tolerance", "boxes", "seconds"):
            if not getattr(self, name) > 0.0:
                raise ControlError(f"{name} = {getattr(self, name):g} of a budget is not positive")


@record
class Bracket:
    """What the worst case of one plant lies between.

    Parameters
    ----------
    ms_lower, mt_lower : float
        The largest Ms and Mt of any plant of the set that was met.
    ms_upper, mt_upper : float
        No plant of the set has more; infinite where that is not proven.
    proven_stable : bool
        Every plant of the set is stable with this controller.
    boxes : int
        How many boxes it took.
    left_out : str
        Why nothing could be bounded; empty if it could.
    parameters : mapping of name to value
        Those of the severest plant met on the way, if it is worse than the worst case that was known; else empty.

    """

    ms_lower: float
    ms_upper: float
    mt_lower: float
    mt_upper: float
    proven_stable: bool
    boxes: int
    left_out: str = ""
    parameters: dict[str, float] = field(default_factory=dict[str, float])

    @property
    def statement(self) -> str:
        """What is proven, in words; its figures are rounded up."""
        if self.left_out:
            return f"no bound: {self.left_out}"
        if not np.isfinite(self.ms_lower):
            return "no bound: a plant of the set is unstable"
        if not self.proven_stable:
            return f"no bound in {self.boxes} boxes"
        return f"proven: all stable, Ms below {_above(self.ms_upper)}, Mt below {_above(self.mt_upper)}"

    def to_dict(self) -> dict[str, Any]:
        """Return what robustness.json keeps with the worst case."""
        return {item.name: getattr(self, item.name) for item in fields(self) if item.name != "parameters"}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Bracket:
        """Return what robustness.json keeps; bounds that are missing are infinite, as JSON has no infinity."""
        names = [item.name for item in fields(cls) if item.name != "parameters"]
        kept: dict[str, Any] = {name: np.inf if content[name] is None else content[name] for name in names}
        return cls(**kept)

    def __repr__(self) -> str:
        return f"Bracket(Ms from {self.ms_lower:.5g}, Mt from {self.mt_lower:.5g}; {self.statement})"


def _above(value: float) -> str:
    """Return a number with four digits, rounded up."""
    step = 10.0 ** (np.floor(np.log10(value)) - 3)
    return f"{np.ceil(value / step) * step:.4g}"


@dataclass(slots=True, kw_only=True, eq=False)
class _Search:
    """What is open, and what is known.

    `lower` and `upper` are of S and T: the largest met, and the largest bound of what is done.
    """

    controller: Controller
    plant: Plant
    unknown: Uncertainty
    within: Region
    tolerance: float
    boxes: Boxes
    arcs: Arcs
    hardness: Float[np.ndarray, " k"]
    lower: Float[np.ndarray, " 2"]
    upper: Float[np.ndarray, " 2"]
    severity: float
    stable: bool = True
    count: int = 0
    parameters: dict[str, float] = field(default_factory=dict[str, float])


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # what is not finite is not proven
def bracket(
    controller: Controller, plant: Plant, unknown: Uncertainty, worst: Worst | None = None, budget: Budget | None = None
) -> Bracket:
    """Bound the worst Ms and Mt over the set of `find_worst` from above, and prove that all its plants are stable.

    Parameters
    ----------
    controller, plant, unknown
        What is closed around what, and over what.
    worst : Worst, optional
        The worst case that was found, from below.
    budget : Budget, optional
        When to stop; what is proven then still holds.

    Returns
    -------
    Bracket
        With infinite bounds if nothing could be proven.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.robustness import uncertainty
    >>> from seaopt.robustness.bounds.bracket import bracket
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30))
    >>> unknown = uncertainty(thor, so.ParameterSet(), {"eta": (0.8, 1.0)}, {"stand": stand})
    >>> found = bracket(controller, stand, unknown)
    >>> found.proven_stable, found.ms_upper / found.ms_lower < 1.011
    (True, True)

    """
    budget = budget or Budget()
    end = time.perf_counter() + budget.seconds
    known = np.zeros(2) if worst is None else np.array([worst.ms, worst.mt])
    try:
        found = _started(controller, plant, unknown, budget.tolerance, known, 0.0 if worst is None else worst.severity)
        while found.arcs.box.size and found.count < budget.boxes and time.perf_counter() < end:
            if not np.all(np.isfinite(found.lower)) or (found.count and not found.within.size):
                break  # one is unstable, or there is nothing to halve
            _step(found)
        found.stable &= bool(np.all(_meet(found, found.boxes.centre)))
    except ControlError as error:
        return Bracket(
            ms_lower=float(known[0]), ms_upper=np.inf, mt_lower=float(known[1]), mt_upper=np.inf, proven_stable=False,
            boxes=0, left_out=str(error),
        )  # fmt: skip
    open_bounds = [np.max(found.arcs.s, initial=0.0), np.max(found.arcs.t, initial=0.0)]
    bound = np.maximum(found.upper, open_bounds) * (1.0 + SLACK)
    if found.boxes.centre.size and np.any(found.lower > bound * (1.0 + AGREE)) and np.all(np.isfinite(found.lower)):
        return Bracket(
            ms_lower=float(found.lower[0]), ms_upper=np.inf, mt_lower=float(found.lower[1]), mt_upper=np.inf,
            proven_stable=False, boxes=found.count, parameters=found.parameters,
            left_out="a plant of the set is worse than the bound, which is therefore none; the model was not enclosed",
        )  # fmt: skip
    upper = np.maximum(bound, found.lower)
    proven = bool(np.all(np.isfinite(upper)) and found.stable)
    ms, mt = (float(item) if proven else np.inf for item in upper)
    return Bracket(
        ms_lower=float(found.lower[0]), ms_upper=ms, mt_lower=float(found.lower[1]), mt_upper=mt, proven_stable=proven,
        boxes=found.count, parameters=found.parameters,
    )  # fmt: skip


def _started(
    controller: Controller, plant: Plant, unknown: Uncertainty, tolerance: float, known: Float[np.ndarray, " 2"],
    severity: float,
) -> _Search:  # fmt: skip
    within = region(plant, unknown)
    boxes = within.whole(controller.sample_time_s)
    _check(controller, plant, unknown, within, boxes)
    hardness = _hardness(controller, plant, unknown, within, boxes)
    while boxes.centre.shape[0] < BLOCK and np.sum(hardness * boxes.radius[0]) > EASY:
        axis = int(np.argmax(hardness * boxes.radius[0]))
        boxes = within.cut(boxes.halves(np.full(boxes.centre.shape[0], axis)))[0]
    count, middle, half = boxes.centre.shape[0], 0.5 * (EDGES[1:] + EDGES[:-1]), 0.5 * np.diff(EDGES)
    nothing = np.full(count * half.size, np.inf)
    arcs = Arcs(
        box=np.repeat(np.arange(count), half.size), middle=np.tile(middle, count), half=np.tile(half, count),
        s=nothing, t=nothing,
    )  # fmt: skip
    return _Search(
        controller=controller, plant=plant, unknown=unknown, within=within, tolerance=tolerance, boxes=boxes, arcs=arcs,
        hardness=hardness, lower=known.copy(), upper=np.zeros(2), severity=severity,
    )  # fmt: skip


def _check(controller: Controller, plant: Plant, unknown: Uncertainty, within: Region, boxes: Boxes) -> None:
    """Refuse a loop that cannot be bounded even at a single plant and single angles, for all the digits it loses."""
    one = Boxes(centre=boxes.centre[:1], radius=np.zeros_like(boxes.radius[:1]))
    theta = 0.5 * (EDGES[1:] + EDGES[:-1])
    open_bounds = np.full(theta.size, np.inf)
    arcs = Arcs(box=np.zeros(theta.size, dtype=int), middle=theta, half=0.0 * theta, s=open_bounds, t=open_bounds)
    found = bounded(controller, pulse(controller, plant, unknown.nominal, within, one), one, within.ball, arcs)
    if not np.all(np.isfinite(found.s)):
        raise ControlError(
            f"{plant.name} cannot be told from a plant with a pole on the unit circle: its {len(plant.states)} states "
            "lose too many digits, or the pole is there"
        )


def _hardness(
    controller: Controller, plant: Plant, unknown: Uncertainty, within: Region, boxes: Boxes
) -> Float[np.ndarray, " k"]:
    """Return how much each coordinate adds to the root of the models' rests, which is nearly linear in its width."""
    if not within.size:
        return np.zeros(0)
    width = boxes.radius[0]
    alone = Boxes(centre=np.repeat(boxes.centre[:1], within.size, axis=0), radius=TRIAL * np.diag(width))
    found = pulse(controller, plant, unknown.nominal, within, alone).denominator
    with np.errstate(divide="ignore", invalid="ignore"):
        rest = np.nan_to_num(found.r / np.abs(found.c), nan=0.0, posinf=1e6)
        return np.max(rest, axis=1) ** (1.0 / (found.basis.degree + 1)) / np.where(width > 0.0, TRIAL * width, np.inf)


def _step(found: _Search) -> None:
    """Bound the boxes whose bounds are largest, and halve those that are not done."""
    worst = np.zeros(found.boxes.centre.shape[0])
    scale = np.maximum(found.lower, 1.0)
    np.maximum.at(worst, found.arcs.box, np.maximum(found.arcs.s / scale[0], found.arcs.t / scale[1]))
    order = np.argsort(-worst, kind="stable")
    chosen, rest = np.sort(order[:BLOCK]), np.sort(order[BLOCK:])
    boxes, arcs = found.boxes.rows(chosen), _of(found.arcs, chosen, worst.size)
    waiting = _of(found.arcs, rest, worst.size)
    stable = _meet(found, boxes.centre)
    sampled = pulse(found.controller, found.plant, found.unknown.nominal, found.within, boxes)
    left, influence = _bounded(found, sampled, boxes, arcs, stable)
    found.count += chosen.size
    found.boxes, found.arcs = found.boxes.rows(rest), waiting
    if left.box.size:
        _halve(found, boxes, left, influence)


def _bounded(
    found: _Search, sampled: Pulse, boxes: Boxes, arcs: Arcs, stable: Bool[np.ndarray, " b"]
) -> tuple[Arcs, Float[np.ndarray, "b k"]]:
    """Return the arcs of which the box has to be halved, and how much each coordinate of it is to blame.

    A box whose centre is unstable, which is then outside the set, is halved whatever its bounds.
    """
    hard = found.hardness * boxes.radius
    hard = hard / np.maximum(np.sum(hard, axis=1, keepdims=True), 1e-300)
    blame, left = np.zeros_like(hard), list[Arcs]()
    first = True
    while arcs.box.size:
        now, arcs = arcs.rows(slice(0, ARCS)), arcs.rows(slice(ARCS, None))
        new = bounded(found.controller, sampled, boxes, found.within.ball, now)
        now = now.bounded(new.s, new.t)
        if first:
            _meet(found, _corners(found, boxes, now, new))
            first = False
        goal = found.lower * (1.0 + found.tolerance)
        done = (now.s <= goal[0]) & (now.t <= goal[1]) & stable[now.box]
        found.upper = np.maximum(found.upper, [np.max(now.s[done], initial=0.0), np.max(now.t[done], initial=0.0)])
        by_box = np.maximum(np.max(new.by_box, axis=1, initial=0.0), new.rest)
        halved = ~done & stable[now.box] & (new.by_angle >= ARC_SHARE * by_box) & (new.by_angle > SHORTEST)
        stuck = ~done & ~halved
        left.append(now.rows(stuck))
        share = new.by_box / np.maximum(np.sum(new.by_box, axis=1, keepdims=True), 1e-300)
        # A rest does not say whose it is: the trial does.
        beyond = ~(new.rest <= np.max(new.by_box, axis=1, initial=0.0))
        share = np.where(beyond[:, None], hard[now.box], share)
        np.add.at(blame, now.box[stuck], np.nan_to_num(share[stuck]))
        arcs = joined([arcs, now.rows(halved).halves()])
    return joined(left), blame


def _corners(found: _Search, boxes: Boxes, arcs: Arcs, new: Found) -> Float[np.ndarray, "c k"]:
    """Return points of the set where abs(S) and abs(T) of the worst arcs are largest to first order."""
    points: list[Float[np.ndarray, "c k"]] = []
    for bound, slope in ((arcs.s, new.towards[0]), (arcs.t, new.towards[1])):
        best = np.argsort(-np.where(np.isfinite(bound), bound, 0.0), kind="stable")[:CANDIDATES]
        own = arcs.box[best]
        points.append(boxes.centre[own] + boxes.radius[own] * np.sign(slope[best]))
    return found.within.into(np.vstack(points))


def _halve(found: _Search, boxes: Boxes, left: Arcs, blame: Float[np.ndarray, "b k"]) -> None:
    """Put the halves of boxes in place of them, each with the arcs that are left."""
    parents = np.unique(left.box)
    if not found.within.size:
        found.boxes, found.arcs = boxes, left
        return
    wide = np.where(boxes.radius[parents] > 0.0, blame[parents], -1.0)
    halves, kept = found.within.cut(boxes.rows(parents).halves(np.argmax(wide, axis=1)))
    own = np.searchsorted(parents, left.box)
    number = np.where(kept, np.cumsum(kept) - 1, -1) + found.boxes.centre.shape[0]
    both = [left.moved(number[own + side * parents.size]).rows(kept[own + side * parents.size]) for side in (0, 1)]
    found.boxes = Boxes(
        centre=np.vstack([found.boxes.centre, halves.centre]), radius=np.vstack([found.boxes.radius, halves.radius])
    )
    found.arcs = joined([found.arcs, *both])


def _of(arcs: Arcs, boxes: Int[np.ndarray, " b"], count: int) -> Arcs:
    """Return the arcs of some of `count` boxes, which are numbered by their place among these."""
    place = np.full(count, -1)
    place[boxes] = np.arange(boxes.size)
    moved = arcs.moved(place[arcs.box])
    return moved.rows(moved.box >= 0)


def _meet(found: _Search, points: Float[np.ndarray, "c k"]) -> Bool[np.ndarray, " c"]:
    """Measure plants at points and tell which are stable; those of the set bound the worst from below."""
    within = found.within
    count = points.shape[0]
    points = points if within.size else points[:1]
    if not count:
        return np.ones(0, dtype=bool)
    fixed = {name: np.full(len(points), value) for name, value in within.fixed.items()}
    every = within.at(points) | fixed
    figures = batch_figures(found.controller, found.plant, found.unknown.nominal, every)
    inside = within.inside(points)
    for k, item in enumerate((figures.ms, figures.mt)):
        found.lower[k] = max(found.lower[k], np.max(item[inside], initial=0.0))
    severity = np.where(inside, severities(found.controller, figures), 0.0)
    worst = int(np.argmax(severity))
    if severity[worst] > found.severity * (1.0 + SLACK):
        found.severity = float(severity[worst])
        found.parameters = {name: float(item[worst]) for name, item in every.items()}
    return np.broadcast_to(figures.spectral_radius < STABLE, count)


def joined(parts: list[Arcs]) -> Arcs:
    """Return arcs as one."""
    return Arcs(**{item.name: np.concatenate([getattr(part, item.name) for part in parts]) for item in fields(Arcs)})
