r"""The worst case from above, for the certificate: bounds on Ms and Mt over the whole set, and stability.

Branch and bound over boxes of the uncertain coordinates times arcs of the unit circle. An arc of a box is done when
its bounds on abs(S) and abs(T) are within a tolerance of the largest that any plant is known to have; else the arc is
halved, or the box, along the coordinate that widens its bounds most. A box whose loop has no pole on any arc for
any of its plants, and is stable at its centre, is stable throughout: eigenvalues are continuous.

Every bound is a theorem but for rounding, which is estimated at every step and added, and a billionth besides.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.codec import OrInfinite
from seaopt.control import Controller
from seaopt.control.loops.loop import GROWING, STABLE
from seaopt.control.running.fed_back import close_terms
from seaopt.errors import ControlError
from seaopt.options import check_options, option
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.bounds.impulse import ImpulseTransfer, enclose_plant
from seaopt.robustness.bounds.region import Boxes, Region, Rows, build_region
from seaopt.robustness.bounds.scheduled_law import ScheduledLaw
from seaopt.robustness.bounds.unit_circle import (
    ArcBounds,
    Arcs,
    LawPolynomials,
    bound_arcs,
    expand_controller,
    expand_nothing,
)
from seaopt.robustness.uncertainty.batch import BatchFigures, batch_figures
from seaopt.robustness.uncertainty.draws import Points, Uncertainty
from seaopt.robustness.uncertainty.rows import join_rows, take_rows
from seaopt.robustness.uncertainty.severity import severities
from seaopt.robustness.uncertainty.worst import Worst

SLACK = 1e-9
AGREEMENT = 1e-6  # relative, with measured figures, which are computed another way
FIRST_EDGES = np.pi * np.concatenate([[0.0], np.geomspace(1e-5, 1.0, 31)])  # of the arcs at the start
BOX_BLOCK = 128  # boxes at a time
ARC_BLOCK = 4096  # arcs at a time: bounds the memory
CORNERS_MEASURED = 16  # arcs of a block at whose worst corners a plant is measured
ARC_SHARE = 0.5  # an arc is halved if the angle's share in D is at least this much of what the box adds to it
SHORTEST = 1e-6  # share of the angle below which halving the arc is of no use
TRIAL = 0.25  # part of the set's width on which a coordinate's hardness is measured
EASY = 0.9  # sum of the coordinates' hardness with which a box is worth bounding


@record
class Budget:
    """When bounds are tight enough, and when to stop."""

    tolerance: float = option(
        "Done when the bounds are within this fraction of the largest Ms and Mt measured.", default=0.01, above=0.0
    )
    boxes: int = option("Boxes after which to stop, for each plant.", default=1000, above=0)
    arcs: int = option("Bounds of a box on an arc, S and T at once, after which to stop.", default=1_000_000, above=0)

    def __post_init__(self) -> None:
        check_options(self, ControlError)


@record
class Bracket:
    """Lower and upper bounds on the worst case of one plant.

    Parameters
    ----------
    ms_lower, mt_lower : float
        The largest Ms and Mt of any plant of the set that was measured.
    ms_upper, mt_upper : float
        No plant of the set has more; infinite where there is no bound. Rounding is estimated, not enclosed.
    bounded_stable : bool
        Every plant of the set is stable with this controller, by those bounds.
    boxes : int
        Number of boxes used.
    left_out : str
        Why there is no bound; empty if there is one.
    parameters : mapping of name to value
        Those of the worst plant measured meanwhile, if it is worse than the given worst case; else empty.
    """

    json_keys = ("ms_lower", "ms_upper", "mt_lower", "mt_upper", "bounded_stable", "boxes", "left_out")

    ms_lower: OrInfinite
    ms_upper: OrInfinite
    mt_lower: OrInfinite
    mt_upper: OrInfinite
    bounded_stable: bool
    boxes: int
    left_out: str = ""
    parameters: dict[str, float] = field(default_factory=dict[str, float])

    @property
    def statement(self) -> str:
        """The bounds as text; their figures are rounded up."""
        if self.left_out:
            return f"no bound: {self.left_out}"
        if not np.isfinite(self.ms_lower):
            return "no bound: a plant of the set is unstable"
        if not self.bounded_stable:
            return f"no bound in {self.boxes} boxes"
        ms, mt = _round_up(self.ms_upper), _round_up(self.mt_upper)
        return f"bounded, rounding estimated: all stable, Ms below {ms}, Mt below {mt}"

    def __repr__(self) -> str:
        return f"Bracket(Ms from {self.ms_lower:.5g}, Mt from {self.mt_lower:.5g}; {self.statement})"


def _round_up(value: float) -> str:
    """Return a number with four digits, rounded up."""
    step = 10.0 ** (np.floor(np.log10(value)) - 3)
    return f"{np.ceil(value / step) * step:.4g}"


@dataclass(slots=True, kw_only=True, eq=False)  # replaced field by field as the search goes on
class _BranchAndBound:
    """One search: boxes and arcs still open, and the largest of S and T measured (`lower`) and bounded (`upper`)."""

    controller: Controller
    plant: Plant
    scheduled: ScheduledLaw | None
    law: LawPolynomials
    within: Region
    tolerance: float
    boxes: Boxes
    arcs: Arcs
    hardness: Float[np.ndarray, " k"]
    lower: Float[np.ndarray, " 2"]
    upper: Float[np.ndarray, " 2"]
    severity: float
    stable: bool = True
    marginal: float | None = None  # where a law that changes has a loop that is stable but for rounding
    count: int = 0
    bounded: int = 0  # arcs
    parameters: dict[str, float] = field(default_factory=dict[str, float])


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # what is not finite is no bound
def bracket(
    controller: Controller,
    plant: Plant,
    unknown: Uncertainty,
    worst: Worst | None = None,
    budget: Budget | None = None,
    scheduled: ScheduledLaw | None = None,
) -> Bracket:
    """Bound the worst Ms and Mt over the set of `find_worst` from above, and find whether all its plants are stable.

    Parameters
    ----------
    controller, plant, unknown
        The loop's controller and plant, and what is uncertain of the plant.
    worst : Worst, optional
        The worst case known, from `find_worst`.
    budget : Budget, optional
        When to stop; what is bounded by then still holds.
    scheduled : ScheduledLaw, optional
        The law, in place of the controller's, that changes over one of the coordinates.

    Returns
    -------
    Bracket
        With infinite bounds if nothing could be bounded.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.robustness import bracket, combine_uncertainty
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30))
    >>> unknown = combine_uncertainty(thor, so.ParameterSet(), {"eta": (0.8, 1.0)}, {"stand": stand})
    >>> bounds = bracket(controller, stand, unknown)
    >>> bounds.bounded_stable, bounds.ms_upper / bounds.ms_lower < 1.011
    (True, True)
    """
    budget = budget or Budget()
    peaks = np.zeros(2) if worst is None else np.array([worst.ms, worst.mt])
    try:
        controller = close_terms(controller, plant)
        search = _start(
            controller, plant, unknown, budget.tolerance, peaks, 0.0 if worst is None else worst.severity, scheduled
        )
        while search.arcs.box.size and search.count < budget.boxes and search.bounded < budget.arcs:
            if not np.all(np.isfinite(search.lower)) or (search.count and not search.within.size):
                break  # a plant is unstable, or there is nothing to halve
            first, boxes = not search.count, search.boxes
            _step(search)
            if first and not np.all(np.isfinite(search.arcs.s)):
                _check_digits(search, boxes)
        search.stable &= bool(np.all(_measure(search, search.boxes.centre)))
    except ControlError as error:
        return Bracket(
            ms_lower=float(peaks[0]),
            ms_upper=np.inf,
            mt_lower=float(peaks[1]),
            mt_upper=np.inf,
            bounded_stable=False,
            boxes=0,
            left_out=str(error),
        )
    return _conclude(search)


def _conclude(search: _BranchAndBound) -> Bracket:
    """Return what is bounded when a search ends: bounds of all arcs, unless a measured plant contradicts them."""
    open_bounds = [np.max(search.arcs.s, initial=0.0), np.max(search.arcs.t, initial=0.0)]
    bound = np.maximum(search.upper, open_bounds) * (1.0 + SLACK)
    exceeded = np.any(search.lower > bound * (1.0 + AGREEMENT)) and np.all(np.isfinite(search.lower))
    void = bool(search.boxes.centre.size and exceeded)
    upper = np.maximum(bound, search.lower)
    bounded = bool(np.all(np.isfinite(upper)) and search.stable) and not void
    lower, upper = search.lower.tolist(), upper.tolist() if bounded else [np.inf, np.inf]
    reason = "a plant of the set is worse than the bound, which is therefore void; the model was not enclosed" * void
    if not (void or bounded or search.marginal is None) and np.all(np.isfinite(search.lower)):
        reason = f"at {search.marginal:.9g} the loop has a pole that is 1 to rounding"
    return Bracket(
        ms_lower=lower[0],
        ms_upper=upper[0],
        mt_lower=lower[1],
        mt_upper=upper[1],
        bounded_stable=bounded,
        boxes=search.count,
        parameters=search.parameters,
        left_out=reason,
    )


def _start(
    controller: Controller,
    plant: Plant,
    unknown: Uncertainty,
    tolerance: float,
    peaks: Float[np.ndarray, " 2"],
    severity: float,
    scheduled: ScheduledLaw | None,
) -> _BranchAndBound:
    within = build_region(plant, replace(unknown, nominal=controller.delay(unknown.nominal)))
    boxes = within.cover(controller.sample_time_s)
    hardness = _measure_hardness(controller, plant, within, boxes)
    law = expand_controller(controller) if scheduled is None else expand_nothing(controller)
    while boxes.centre.shape[0] < BOX_BLOCK and np.sum(hardness * boxes.radius[0]) > EASY:
        axis = int(np.argmax(hardness * boxes.radius[0]))
        boxes = within.cut(boxes.halve(np.full(boxes.centre.shape[0], axis)))[0]
    return _BranchAndBound(
        controller=controller,
        plant=plant,
        scheduled=scheduled,
        law=law,
        within=within,
        tolerance=tolerance,
        boxes=boxes,
        arcs=_make_arcs(boxes.centre.shape[0]),
        hardness=hardness,
        lower=peaks.copy(),
        upper=np.zeros(2),
        severity=severity,
    )


def _make_arcs(count: int) -> Arcs:
    """Return the arcs of the start, of so many boxes."""
    middle, half = 0.5 * (FIRST_EDGES[1:] + FIRST_EDGES[:-1]), 0.5 * np.diff(FIRST_EDGES)
    no_bound = np.full(count * half.size, np.inf)
    return Arcs(
        box=np.repeat(np.arange(count), half.size),
        middle=np.tile(middle, count),
        half=np.tile(half, count),
        s=no_bound,
        t=no_bound,
    )


def _enclose(search: _BranchAndBound, boxes: Boxes) -> ImpulseTransfer:
    """Return the sampled plant over boxes, with a law in front of it that changes over them."""
    sampled, scheduled = enclose_plant(search.controller, search.plant, search.within, boxes), search.scheduled
    if scheduled is None:
        return sampled
    values = search.within.enclose(boxes, sampled.denominator.basis.degree)
    return scheduled.extend(sampled, values[scheduled.coordinate])


def _check_digits(search: _BranchAndBound, boxes: Boxes) -> None:
    """Refuse a loop that loses so many digits that not even one plant can be bounded at single angles."""
    plant, point = search.plant, Boxes(centre=boxes.centre[:1], radius=np.zeros_like(boxes.radius[:1]))
    arcs = _make_arcs(1)
    arcs = replace(arcs, half=0.0 * arcs.half)
    if not np.all(np.isfinite(bound_arcs(search.law, _enclose(search, point), point, search.within.ball, arcs).s)):
        raise ControlError(
            f"{plant.name} cannot be distinguished from a plant with a pole on the unit circle: its "
            f"{len(plant.states)} states lose too many digits, or the pole is there"
        )


def _measure_hardness(controller: Controller, plant: Plant, within: Region, boxes: Boxes) -> Float[np.ndarray, " k"]:
    """Return what each coordinate adds to the root of the models' remainders, which is nearly linear in its width. A
    single one has nothing to be compared with.
    """
    if within.size < 2:
        return np.zeros(within.size)
    width = boxes.radius[0]
    alone = Boxes(centre=np.repeat(boxes.centre[:1], within.size, axis=0), radius=TRIAL * np.diag(width))
    model = enclose_plant(controller, plant, within, alone).denominator
    with np.errstate(divide="ignore", invalid="ignore"):
        remainder = np.nan_to_num(model.r / np.abs(model.c), nan=0.0, posinf=1e6)
        return np.max(remainder, axis=1) ** (1.0 / (model.basis.degree + 1)) / np.where(
            width > 0.0, TRIAL * width, np.inf
        )


def _step(search: _BranchAndBound) -> None:
    """Bound the boxes whose bounds are largest, and halve those that are not done."""
    worst = np.zeros(search.boxes.centre.shape[0])
    scale = np.maximum(search.lower, 1.0)
    np.maximum.at(worst, search.arcs.box, np.maximum(search.arcs.s / scale[0], search.arcs.t / scale[1]))
    order = np.argsort(-worst, kind="stable")
    chosen, remaining = np.sort(order[:BOX_BLOCK]), np.sort(order[BOX_BLOCK:])
    boxes, arcs = take_rows(search.boxes, chosen), _take_arcs_of(search.arcs, chosen, worst.size)
    waiting = _take_arcs_of(search.arcs, remaining, worst.size)
    stable = _measure(search, boxes.centre)
    sampled = _enclose(search, boxes)
    left, blame = _bound_block(search, sampled, boxes, arcs, stable)
    search.count += chosen.size
    search.boxes, search.arcs = take_rows(search.boxes, remaining), waiting
    if left.box.size:
        _halve(search, boxes, left, blame)


def _bound_block(
    search: _BranchAndBound, sampled: ImpulseTransfer, boxes: Boxes, arcs: Arcs, stable: Bool[np.ndarray, " b"]
) -> tuple[Arcs, Rows]:
    """Return the arcs whose box has to be halved, and how much each coordinate of the box is to blame. A box with an
    unstable centre, which is then outside the set, is halved whatever its bounds.
    """
    hard = search.hardness * boxes.radius
    hard = hard / np.maximum(np.sum(hard, axis=1, keepdims=True), 1e-300)
    blame, left = np.zeros_like(hard), list[Arcs]()
    first = True
    while arcs.box.size:
        block, arcs = take_rows(arcs, slice(0, ARC_BLOCK)), take_rows(arcs, slice(ARC_BLOCK, None))
        new = bound_arcs(search.law, sampled, boxes, search.within.ball, block)
        block, search.bounded = block.tighten(new.s, new.t), search.bounded + block.box.size
        if first:
            _measure(search, _worst_corners(search, boxes, block, new))
            first = False
        goal = search.lower * (1.0 + search.tolerance)
        done = (block.s <= goal[0]) & (block.t <= goal[1]) & stable[block.box]
        search.upper = np.maximum(
            search.upper, [np.max(block.s[done], initial=0.0), np.max(block.t[done], initial=0.0)]
        )
        by_box = np.maximum(np.max(new.by_box, axis=1, initial=0.0), new.remainder)
        halved = ~done & stable[block.box] & (new.by_angle >= ARC_SHARE * by_box) & (new.by_angle > SHORTEST)
        stuck = ~done & ~halved
        left.append(take_rows(block, stuck))
        share = new.by_box / np.maximum(np.sum(new.by_box, axis=1, keepdims=True), 1e-300)
        # A remainder does not show which coordinate makes it; the hardness measured on a trial does.
        beyond = ~(new.remainder <= np.max(new.by_box, axis=1, initial=0.0))
        share = np.where(beyond[:, None], hard[block.box], share)
        np.add.at(blame, block.box[stuck], np.nan_to_num(share[stuck]))
        arcs = join_rows([arcs, take_rows(block, halved).halve()])
    return join_rows(left), blame


def _worst_corners(search: _BranchAndBound, boxes: Boxes, arcs: Arcs, bounds: ArcBounds) -> Points:
    """Return points of the set where abs(S) and abs(T) of the worst arcs are largest to first order."""
    points: list[Points] = []
    for bound, slope in ((arcs.s, bounds.gradients[0]), (arcs.t, bounds.gradients[1])):
        largest = np.argsort(-np.where(np.isfinite(bound), bound, 0.0), kind="stable")[:CORNERS_MEASURED]
        box = arcs.box[largest]
        points.append(boxes.centre[box] + boxes.radius[box] * np.sign(slope[largest]))
    return search.within.project(np.vstack(points))


def _halve(search: _BranchAndBound, boxes: Boxes, left: Arcs, blame: Rows) -> None:
    """Replace boxes by their halves, each with the arcs that are left."""
    parents = np.unique(left.box)
    if not search.within.size:
        search.boxes, search.arcs = boxes, left
        return
    wide = np.where(boxes.radius[parents] > 0.0, blame[parents], -1.0)
    halves, kept = search.within.cut(take_rows(boxes, parents).halve(np.argmax(wide, axis=1)))
    parent = np.searchsorted(parents, left.box)
    index = np.where(kept, np.cumsum(kept) - 1, -1) + search.boxes.centre.shape[0]
    children = [parent + side * parents.size for side in (0, 1)]
    both = [take_rows(left.renumber(index[child]), kept[child]) for child in children]
    search.boxes = join_rows([search.boxes, halves])
    search.arcs = join_rows([search.arcs, *both])


def _take_arcs_of(arcs: Arcs, boxes: Int[np.ndarray, " b"], count: int) -> Arcs:
    """Return the arcs of some of `count` boxes, with their indices among these."""
    index = np.full(count, -1)
    index[boxes] = np.arange(boxes.size)
    renumbered = arcs.renumber(index[arcs.box])
    return take_rows(renumbered, renumbered.box >= 0)


def _measure(search: _BranchAndBound, points: Points) -> Bool[np.ndarray, " c"]:
    """Close the loop at points and return which are stable; points of the set raise the lower bounds."""
    within = search.within
    count = points.shape[0]
    points = points if within.size else points[:1]
    if not count:
        return np.ones(0, dtype=bool)
    fixed = {name: np.full(len(points), value) for name, value in within.fixed.items()}
    values = within.evaluate(points) | fixed
    figures = _measure_draws(search, values)
    inside = within.contains(points)
    if search.scheduled is not None:  # where a gain starts at zero a pole comes out of 1: that refutes nothing
        near = (figures.spectral_radius >= STABLE) & (figures.spectral_radius <= GROWING) & inside
        if np.any(near):
            search.marginal = float(values[search.scheduled.coordinate][int(np.argmax(near))])
        inside = inside & ~near
    for k, peaks in enumerate((figures.ms, figures.mt)):
        search.lower[k] = max(search.lower[k], np.max(peaks[inside], initial=0.0))
    severity = np.where(inside, severities(search.controller, figures), 0.0)
    worst = int(np.argmax(severity))
    if severity[worst] > search.severity * (1.0 + SLACK):
        search.severity = float(severity[worst])
        search.parameters = {name: float(column[worst]) for name, column in values.items()}
    return np.broadcast_to(figures.spectral_radius < STABLE, count)


def _measure_draws(search: _BranchAndBound, values: dict[str, Float[np.ndarray, " n"]]) -> BatchFigures:
    """Return the figures of draws, each with the law that it has where that changes over the one coordinate."""
    scheduled, plant, nominal = search.scheduled, search.plant, search.within.nominal
    if scheduled is None:
        return batch_figures(search.controller, plant, nominal, values)
    different, rows = np.unique(values[scheduled.coordinate], return_inverse=True)
    first = [int(np.argmax(rows == k)) for k in range(different.size)]
    figures = [
        batch_figures(
            scheduled.at(float(value)), plant, nominal, {name: column[k : k + 1] for name, column in values.items()}
        )
        for k, value in zip(first, different, strict=True)
    ]
    return take_rows(join_rows(figures), rows)
