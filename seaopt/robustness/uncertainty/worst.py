r"""The worst case from below: the parameters, of all that fit and ranges allow, with the largest Ms, and those of Mt.

The set is an ellipsoid of the fit's covariance that holds `LEVEL` of its probability, cut by the physical bounds, times
the box of the ranges. Ms and Mt are searched each for itself, instability before either. A search starts from the worst
draws and vertices of the ranges, from distant ones first. Each round takes the exact gradient of a point's severity
(`seaopt.robustness.uncertainty.severity`) and tries points along it, towards the vertex of the set that it points to
(Frank, Wolfe, Naval Research Logistics 3, 1956) and about the point, all starts of a round in one batch. The result is
a lower bound on the true worst case: a witness, checked by `Worst.verify`, and not a proof that there is none worse;
`seaopt.robustness.bounds` bounds it from above.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from seaopt.control import Controller, LoopFigures
from seaopt.control.loops.sampled_plant import conditions, read_conditions
from seaopt.control.running.fed_back import close_whole
from seaopt.formatting import format_figure, html_table
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.uncertainty.batch import BatchFigures, Levels, batch_figures
from seaopt.robustness.uncertainty.draws import Column, Points, Uncertainty, confidence_radius
from seaopt.robustness.uncertainty.rows import join_rows, take_rows
from seaopt.robustness.uncertainty.severity import (
    LARGEST_MS,
    LARGEST_MT,
    SeveritySlopes,
    limits,
    severities,
    severity_slopes,
)

STARTS = 5  # of each figure
CORNERS = 64  # vertices of the ranges evaluated
APART = 0.5  # least distance of starts: of half a range, or of the ellipsoid's radius
ROUNDS = 30
VERTEX_STEPS = np.array([1.0, 0.5, 0.2, 0.05, 0.01])
GRADIENT_STEPS = np.array([1.0, 0.3, 0.1, 0.03, 0.01, 0.001])
PROBE_STEPS = np.repeat(np.array([0.3, 0.1, 0.03, 0.01]), 3)
ON_BOUND = 1e-8  # of a physical bound, in standard deviations
WITNESS_TOLERANCE = 1e-6
SAME_TEXT = 1.001  # figures within this factor are printed alike
Starts = Float[np.ndarray, "s k"]

Trials = Float[np.ndarray, "s t k"]
Score = Callable[[Points], Column]
Slopes = Callable[[Points], SeveritySlopes]


@record
class Witness:
    """The figures of a loop, and the parameters that produce them."""

    parameters: dict[str, float]
    ms: float
    mt: float
    ms_hz: float
    spectral_radius: float
    severity: float


class Worst(tuple[Plant, ParameterSet]):
    """A plant and the parameters at which it is nearest to failing, or fails most.

    It is the pair (plant, parameters) that `tune(..., robust_to=...)` takes, with the figures there. Points are ranked
    by instability, then by the fraction of the Ms or Mt limit that they use; by Ms where there is no limit. The largest
    Ms and the largest Mt found, which other parameters may have, stand beside it with witnesses of their own.
    """

    witness: Witness
    largest: tuple[Witness, Witness]
    limited: bool

    def __new__(
        cls,
        plant: Plant,
        values: ParameterSet,
        witness: Witness,
        *,
        limited: bool,
        largest: tuple[Witness, Witness] | None = None,
    ) -> Worst:
        """Return the pair with its figures; `limited` if the specification limits Ms or Mt. `largest` are the witnesses
        of the largest Ms and Mt found; the pair's own where they are left out.
        """
        self = super().__new__(cls, (plant, values))
        self.witness, self.limited, self.largest = witness, limited, largest or (witness, witness)
        return self

    def on(self, plant: Plant) -> Worst:
        """Return the same of a plant that equals its own: one that went to another process and back is a copy."""
        return Worst(plant, self[1], self.witness, limited=self.limited, largest=self.largest)

    def __getnewargs_ex__(self) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """Return what a copy, or one that is unpickled, is made of."""
        return (*self, self.witness), {"limited": self.limited, "largest": self.largest}

    @property
    def parameters(self) -> dict[str, float]:
        """The uncertain parameters and conditions, at their worst."""
        return self.witness.parameters

    @property
    def ms(self) -> float:
        """The largest peak of abs(S) found; infinite if unstable."""
        return self.largest[0].ms

    @property
    def mt(self) -> float:
        """The largest peak of abs(T) found; infinite if unstable."""
        return self.largest[1].mt

    @property
    def severity(self) -> float:
        """The fraction of the limits that is used; a million plus the spectral radius if unstable."""
        return self.witness.severity

    @property
    def elsewhere(self) -> dict[str, Witness]:
        """The witnesses of the largest Ms and Mt, by name, that are larger than at the worst case's own parameters."""
        ms, mt = self.largest
        larger = {"Ms": ms} if ms.ms > SAME_TEXT * self.witness.ms else {}
        return larger | ({"Mt": mt} if mt.mt > SAME_TEXT * self.witness.mt else {})

    def figures(self, controller: Controller) -> LoopFigures:
        """Return every figure of the loop there, computed again."""
        return close_whole(controller, *self).figures()

    def verify(self, controller: Controller) -> bool:
        """Return whether the loop, closed again, has the figures that the witness states."""
        again, stated = self.figures(controller), self.witness
        pairs = ((again.ms, stated.ms), (again.mt, stated.mt), (again.spectral_radius, stated.spectral_radius))
        return all(new == old or abs(new - old) <= WITNESS_TOLERANCE * abs(old) for new, old in pairs)

    def __repr__(self) -> str:
        where = ", ".join(f"{name} = {value:.5g}" for name, value in self.parameters.items()) or "the nominal values"
        stated = self.witness
        return f"Worst(Ms {stated.ms:.5g}, Mt {stated.mt:.5g}, spectral radius {stated.spectral_radius:.6g} at {where})"

    def _repr_html_(self) -> str:
        ms = f"{format_figure(self.witness.ms)} at {format_figure(self.witness.ms_hz, 'Hz')}"
        rows = [
            ("Ms", ms),
            ("Mt", format_figure(self.witness.mt)),
            ("spectral radius", f"{self.witness.spectral_radius:.6g}"),
        ]
        rows += [(name, f"{value:.5g}") for name, value in self.parameters.items()]
        return html_table(("worst case", ""), rows)


def find_worst(controller: Controller, plant: Plant, unknown: Uncertainty, drawn: Points) -> Worst:
    """Return the worst of the draws and of the points that searches from the worst draws reach. The draws hold those of
    the largest Ms and Mt; there is none if nothing is uncertain.
    """
    if not unknown.size:
        return measure_worst(controller, plant, unknown.nominal, {})
    points = np.vstack([drawn, _list_corners(unknown)])
    inner = _project(unknown, points)
    moved = np.any(inner != points, axis=1)
    figures = batch_figures(controller, plant, unknown.nominal, unknown.values(np.vstack([points, inner[moved]])))
    at = np.where(moved, len(points) - 1 + np.cumsum(moved), np.arange(len(points)))  # whose figures those of inner are
    start, levels, value = _choose_all_starts(controller, unknown, inner, take_rows(figures, at))

    def score(points: Points) -> Column:
        """Return severities, each by its start's level; points outside the bounds score minus infinity."""
        by = np.repeat(levels, len(points) // len(levels), axis=0)
        figures = batch_figures(controller, plant, unknown.nominal, unknown.values(points), by=by)
        return np.where(unknown.inside(points), severities(controller, figures, by), -np.inf)

    def slopes(points: Starts) -> SeveritySlopes:
        return severity_slopes(controller, plant, unknown, points, levels)

    ends = _climb(unknown, start, value, score, slopes)
    reached = batch_figures(controller, plant, unknown.nominal, unknown.values(ends))
    figures = join_rows([take_rows(figures, np.arange(len(drawn))), reached])
    values = unknown.values(np.vstack([drawn, ends]))
    rows = [int(np.argmax(severities(controller, figures, by))) for by in (LARGEST_MS, LARGEST_MT)]
    largest = [{name: float(column[row]) for name, column in values.items()} for row in dict.fromkeys(rows)]
    return combine_worst([measure_worst(controller, plant, unknown.nominal, at) for at in largest])


def combine_worst(cases: Sequence[Worst]) -> Worst:
    """Return the most severe of some cases of one plant, with the largest Ms and Mt of all."""
    worst = max(cases, key=lambda case: case.severity)
    ms = max((case.largest[0] for case in cases), key=lambda witness: witness.ms)
    mt = max((case.largest[1] for case in cases), key=lambda witness: witness.mt)
    return Worst(*worst, worst.witness, limited=worst.limited, largest=(ms, mt))


def place_values(plant: Plant, nominal: ParameterSet, at: Mapping[str, float]) -> ParameterSet:
    """Return a plant's parameters with those of a draw that it has, and its conditions, in place of the nominal."""
    extra = conditions((plant,))
    values = plant.complete(nominal)
    changed = {name: value for name, value in at.items() if name in values}
    placed = read_conditions(plant, nominal) | {name: value for name, value in at.items() if name in extra}
    return values.update(**changed).with_parameters(*(replace(extra[name], value=placed[name]) for name in placed))


def measure_worst(controller: Controller, plant: Plant, nominal: ParameterSet, at: Mapping[str, float]) -> Worst:
    """Return the worst case at parameters and conditions, its loop closed on its own and not in a batch."""
    values = place_values(plant, nominal, at)
    figures = close_whole(controller, plant, values).figures()
    single = BatchFigures(
        spectral_radius=np.array([figures.spectral_radius]), ms=np.array([figures.ms]), mt=np.array([figures.mt])
    )
    witness = Witness(
        parameters={name: value for name, value in at.items() if name in values},
        ms=figures.ms,
        mt=figures.mt,
        ms_hz=figures.ms_hz,
        spectral_radius=figures.spectral_radius,
        severity=float(severities(controller, single)[0]),
    )
    return Worst(plant, values, witness, limited=bool(np.isfinite(min(limits(controller)))))


def _list_corners(unknown: Uncertainty) -> Points:
    """Return vertices of the ranges, the Gaussian part at its mean: all of them, or a fixed choice of many."""
    size, rng = len(unknown.ranges), np.random.default_rng(0)
    if 2**size <= CORNERS:
        signs = np.array(list(product((-1.0, 1.0), repeat=size))).reshape(2**size, size)
    else:
        signs = rng.choice((-1.0, 1.0), (CORNERS, size))
    return np.hstack([np.zeros((len(signs), len(unknown.names))), signs])


def _choose_all_starts(
    controller: Controller, unknown: Uncertainty, points: Points, figures: BatchFigures
) -> tuple[Starts, Levels, Float[np.ndarray, " s"]]:
    """Return where to start from for a large Ms, then for a large Mt, and the levels and severities by which each is
    ranked.
    """
    inside = unknown.inside(points)
    starts, levels, values = list[Starts](), list[Levels](), list[Column]()
    for by in (LARGEST_MS, LARGEST_MT):
        severity = np.where(inside, severities(controller, figures, by), -np.inf)
        kept = _choose_starts(unknown, points, severity)
        starts.append(points[kept])
        levels.append(np.tile(by, (len(kept), 1)))
        values.append(severity[kept])
    return np.vstack(starts), np.vstack(levels), np.concatenate(values)


def _choose_starts(unknown: Uncertainty, points: Points, severity: Column) -> Int[np.ndarray, " s"]:
    """Return numbers of the worst points that are apart, then of the worst others: not all may lie in one valley."""
    scaled = points.copy()
    scaled[:, : len(unknown.names)] /= max(confidence_radius(len(unknown.names)), 1.0)
    order = list(np.argsort(severity)[::-1])
    kept: list[int] = []
    for i in order:
        apart = all(np.max(np.abs(scaled[i] - scaled[j])) > APART for j in kept)
        if apart and len(kept) < STARTS and np.isfinite(severity[i]):
            kept.append(i)
    kept += [i for i in order if i not in kept][: max(STARTS - len(kept), 0)]
    return np.array(kept)


def _climb(unknown: Uncertainty, x: Starts, value: Column, score: Score, slopes: Slopes) -> Starts:
    """Climb from every start, whose severity is `value`, until none rises further, and return the ends."""
    rng = np.random.default_rng(0)
    for _ in range(ROUNDS):
        slope = _project_slopes(unknown, x, slopes(x))
        trials = _propose_trials(unknown, x, slope, rng)
        scores = score(trials.reshape(-1, x.shape[1])).reshape(trials.shape[:2])
        best = np.argmax(scores, axis=1)
        rows = np.arange(x.shape[0])
        better = scores[rows, best] - value > 1e-7 * np.minimum(np.abs(value), 1.0)
        x = np.where(better[:, None], trials[rows, best], x)
        value = np.where(better, scores[rows, best], value)
        if not np.any(better):
            break
    return x


def _project_slopes(unknown: Uncertainty, x: Starts, slope: SeveritySlopes) -> SeveritySlopes:
    """Return the slopes without what leads out of a physical bound that a point lies on."""
    slope = slope.copy()
    for normal, room in unknown.bounds(x):
        pushing = np.maximum(slope @ normal, 0.0) * (room <= 2.0 * ON_BOUND)
        slope -= pushing[:, None] * normal
    return slope


def _propose_trials(unknown: Uncertainty, x: Starts, slope: SeveritySlopes, rng: np.random.Generator) -> Trials:
    """Return points towards the set's vertex in the slope's direction, along the slope, and at random about x. Random
    points serve the ridge between two peaks of S, where neither peak's slope leads up.
    """
    g = len(unknown.names)
    size = np.linalg.norm(slope, axis=1, keepdims=True)
    unit = slope / np.maximum(size, 1e-300)
    inner = np.linalg.norm(unit[:, :g], axis=1, keepdims=True)
    vertex = np.hstack([confidence_radius(g) * unit[:, :g] / np.maximum(inner, 1e-300), np.sign(unit[:, g:])])
    towards = x[:, None] + VERTEX_STEPS[:, None] * (vertex - x)[:, None]
    along = x[:, None] + GRADIENT_STEPS[:, None] * unit[:, None]
    about = x[:, None] + PROBE_STEPS[:, None] * rng.normal(size=(x.shape[0], PROBE_STEPS.size, x.shape[1]))
    trials = np.concatenate([towards, along, about], axis=1)
    return _shorten(unknown, x, _project(unknown, trials.reshape(-1, x.shape[1])).reshape(trials.shape))


def _shorten(unknown: Uncertainty, x: Starts, trials: Trials) -> Trials:
    """Return the trials, with those beyond a physical bound moved back towards x."""
    share = np.ones(trials.shape[:2])
    for normal, room in unknown.bounds(x):
        way, free = (trials - x[:, None]) @ normal, np.maximum(room - ON_BOUND, 0.0)[:, None]
        beyond = way > free
        share = np.minimum(share, np.where(beyond, free / np.where(beyond, way, 1.0), 1.0))
    return x[:, None] + share[:, :, None] * (trials - x[:, None])


def _project(unknown: Uncertainty, x: Points) -> Points:
    """Return the points, with those outside the ellipsoid or the box moved onto its edge."""
    g = len(unknown.names)
    size = np.linalg.norm(x[:, :g], axis=1, keepdims=True)
    share = np.minimum(1.0, confidence_radius(g) / np.maximum(size, 1e-300))
    return np.hstack([x[:, :g] * share, np.clip(x[:, g:], -1.0, 1.0)])
