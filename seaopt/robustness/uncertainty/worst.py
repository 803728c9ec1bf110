r"""The worst case: the parameters, of all that the fit and the ranges allow, with the largest Ms or spectral radius.

The set is an ellipsoid of the fit's covariance that holds `LEVEL` of its probability, cut by the physical bounds, times
the box of the ranges. From the worst draws and vertices of the ranges, those first that are apart, each round takes the
exact gradient of how much of the limits a point uses (`seaopt.robustness.uncertainty.severity`) and tries points along
it, towards the vertex of the set that it points to (Frank, Wolfe, Naval Research Logistics 3, 1956) and about the
point, all starts of a round in one batch. What it finds is a lower bound on the true worst case: a witness, checked by
`Worst.verify`, and no proof that there is none worse.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import product

import numpy as np
from jaxtyping import Float

from seaopt.control import Controller, LoopFigures
from seaopt.control.loops.sampled_plant import conditions, conditions_of
from seaopt.markup import figure, table
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.uncertainty.batch import BatchFigures, batch_figures
from seaopt.robustness.uncertainty.draws import Uncertainty, radius
from seaopt.robustness.uncertainty.severity import limits, severities, severity_slopes

STARTS = 8
CORNERS = 64  # vertices of the ranges looked at
APART = 0.5  # of half a range, or of the ellipsoid's radius
ROUNDS = 30
VERTEX_STEPS = np.array([1.0, 0.5, 0.2, 0.05, 0.01])
GRADIENT_STEPS = np.array([1.0, 0.3, 0.1, 0.03, 0.01, 0.001])
PROBE_STEPS = np.repeat(np.array([0.3, 0.1, 0.03, 0.01]), 3)
ON_BOUND = 1e-8  # of a physical bound, in standard deviations
MATCH = 1e-6
ROUNDING = 1e-6

Slopes = Float[np.ndarray, "s k"]
Trials = Float[np.ndarray, "s t k"]
Score = Callable[[Float[np.ndarray, "m k"]], Float[np.ndarray, " m"]]


@record
class Witness:
    """The figures of a worst case, and the parameters that produce them."""

    parameters: dict[str, float]
    ms: float
    mt: float
    ms_hz: float
    spectral_radius: float
    severity: float


class Worst(tuple[Plant, ParameterSet]):
    """A plant and the parameters at which it comes nearest to failing, or fails most.

    It is the pair (plant, parameters) that `tune(..., robust_to=...)` takes, with the figures found there. Points are
    ranked by instability, then by how much of the Ms or Mt limit they use; by Ms where there is no limit.
    """

    witness: Witness
    limited: bool

    def __new__(cls, plant: Plant, values: ParameterSet, witness: Witness, *, limited: bool) -> Worst:
        """Return the pair with its figures; `limited` if the specification limits Ms or Mt."""
        self = super().__new__(cls, (plant, values))
        self.witness, self.limited = witness, limited
        return self

    @property
    def parameters(self) -> dict[str, float]:
        """What is uncertain of the plant, at its worst."""
        return self.witness.parameters

    @property
    def ms(self) -> float:
        """Peak of abs(S) there; infinite if unstable."""
        return self.witness.ms

    @property
    def mt(self) -> float:
        """Peak of abs(T) there; infinite if unstable."""
        return self.witness.mt

    @property
    def severity(self) -> float:
        """The fraction of the limits that is used, or a million and the spectral radius if unstable."""
        return self.witness.severity

    def figures(self, controller: Controller) -> LoopFigures:
        """Return every figure of the loop there, computed again."""
        return controller.close(*self).figures()

    def verify(self, controller: Controller) -> bool:
        """Tell whether the loop, closed again, has the figures that the witness states."""
        again, said = self.figures(controller), self.witness
        pairs = ((again.ms, said.ms), (again.mt, said.mt), (again.spectral_radius, said.spectral_radius))
        return all(now == then or abs(now - then) <= MATCH * abs(then) for now, then in pairs)

    def __repr__(self) -> str:
        where = ", ".join(f"{name} = {value:.5g}" for name, value in self.parameters.items()) or "the nominal values"
        return (
            f"Worst(Ms {self.ms:.5g}, Mt {self.mt:.5g}, spectral radius {self.witness.spectral_radius:.6g} at {where})"
        )

    def _repr_html_(self) -> str:
        return worst_html(self)


def find_worst(
    controller: Controller, plant: Plant, unknown: Uncertainty, drawn: Float[np.ndarray, "n k"],
    severity: Float[np.ndarray, " n"],
) -> Worst:  # fmt: skip
    """Return the worst point that the draws and a search from the worst of them find.

    Parameters
    ----------
    controller, plant, unknown
        What is closed around what, and over what.
    drawn, severity
        Draws as coordinates, and how bad each is; none if nothing is uncertain.

    """
    points, scores = drawn, severity
    if unknown.size:
        score = _score(controller, plant, unknown)
        starts = _into_set(unknown, np.vstack([drawn, _corners(unknown)]))
        found, value = _search(controller, plant, unknown, _spread(unknown, starts, score(starts)), score)
        worst = np.argsort(severity)[::-1][:1]
        points, scores = np.vstack([drawn[worst], found]), np.concatenate([severity[worst], value])
    k = int(np.argmax(scores)) if scores.size else 0
    at = unknown.values(points[k : k + 1]) if unknown.size else {}
    return witnessed(controller, plant, unknown.nominal, {name: float(item[0]) for name, item in at.items()})


def witnessed(controller: Controller, plant: Plant, nominal: ParameterSet, at: Mapping[str, float]) -> Worst:
    """Return the worst case at given parameters and conditions, measured one by one."""
    extra = conditions((plant,))
    values = plant.complete(nominal)
    own = {name: value for name, value in at.items() if name in values}
    given = {name: value for name, value in at.items() if name in extra}
    known = conditions_of(plant, nominal) | given
    values = values.update(**own).with_parameters(*(replace(extra[name], value=known[name]) for name in known))
    figures = controller.close(plant, values).figures()
    single = BatchFigures(
        spectral_radius=np.array([figures.spectral_radius]), ms=np.array([figures.ms]), mt=np.array([figures.mt])
    )
    witness = Witness(
        parameters=own | given, ms=figures.ms, mt=figures.mt, ms_hz=figures.ms_hz,
        spectral_radius=figures.spectral_radius, severity=float(severities(controller, single)[0]),
    )  # fmt: skip
    return Worst(plant, values, witness, limited=bool(np.isfinite(min(limits(controller)))))


def _score(controller: Controller, plant: Plant, unknown: Uncertainty) -> Score:
    """Return the function that tells how bad points are, those outside the bounds not at all."""

    def score(points: Float[np.ndarray, "m k"]) -> Float[np.ndarray, " m"]:
        found = batch_figures(controller, plant, unknown.nominal, unknown.values(points))
        return np.where(unknown.inside(points), severities(controller, found), -np.inf)

    return score


def _corners(unknown: Uncertainty) -> Float[np.ndarray, "n k"]:
    """Return vertices of the ranges, the Gaussian part at its mean: all of them, or a fixed choice of many."""
    size, rng = len(unknown.ranges), np.random.default_rng(0)
    if 2**size <= CORNERS:
        signs = np.array(list(product((-1.0, 1.0), repeat=size))).reshape(2**size, size)
    else:
        signs = rng.choice((-1.0, 1.0), (CORNERS, size))
    return np.hstack([np.zeros((len(signs), len(unknown.names))), signs])


def _spread(
    unknown: Uncertainty, points: Float[np.ndarray, "n k"], severity: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "s k"]:
    """Return the worst points that are apart, then the worst of the others: one valley must not take all starts."""
    scaled = points.copy()
    scaled[:, : len(unknown.names)] /= max(radius(len(unknown.names)), 1.0)
    order = list(np.argsort(severity)[::-1])
    kept: list[int] = []
    for i in order:
        apart = all(np.max(np.abs(scaled[i] - scaled[j])) > APART for j in kept)
        if apart and len(kept) < STARTS and np.isfinite(severity[i]):
            kept.append(i)
    kept += [i for i in order if i not in kept][: max(STARTS - len(kept), 0)]
    return points[kept]


def _search(
    controller: Controller, plant: Plant, unknown: Uncertainty, x: Float[np.ndarray, "s k"], score: Score
) -> tuple[Float[np.ndarray, "s k"], Float[np.ndarray, " s"]]:
    """Climb from every start until none gets worse."""
    value, rng = score(x), np.random.default_rng(0)
    for _ in range(ROUNDS):
        slope = _inward(unknown, x, severity_slopes(controller, plant, unknown, x))
        trials = _trials(unknown, x, slope, rng)
        scores = score(trials.reshape(-1, x.shape[1])).reshape(trials.shape[:2])
        best = np.argmax(scores, axis=1)
        rows = np.arange(x.shape[0])
        better = scores[rows, best] - value > 1e-7 * np.minimum(np.abs(value), 1.0)
        x = np.where(better[:, None], trials[rows, best], x)
        value = np.where(better, scores[rows, best], value)
        if not np.any(better):
            break
    return x, value


def _inward(unknown: Uncertainty, x: Float[np.ndarray, "s k"], slope: Slopes) -> Slopes:
    """Return the slopes without what leads out of a physical bound that a point lies on."""
    slope = slope.copy()
    for normal, room in unknown.bounds(x):
        pushing = np.maximum(slope @ normal, 0.0) * (room <= 2.0 * ON_BOUND)
        slope -= pushing[:, None] * normal
    return slope


def _trials(unknown: Uncertainty, x: Float[np.ndarray, "s k"], slope: Slopes, rng: np.random.Generator) -> Trials:
    """Return points towards the set's vertex in the slope's direction, along the slope, and at random about x.

    The last for the ridge between two peaks of S, where neither peak's slope leads up.
    """
    g = len(unknown.names)
    size = np.linalg.norm(slope, axis=1, keepdims=True)
    unit = slope / np.maximum(size, 1e-300)
    inner = np.linalg.norm(unit[:, :g], axis=1, keepdims=True)
    vertex = np.hstack([radius(g) * unit[:, :g] / np.maximum(inner, 1e-300), np.sign(unit[:, g:])])
    towards = x[:, None] + VERTEX_STEPS[:, None] * (vertex - x)[:, None]
    along = x[:, None] + GRADIENT_STEPS[:, None] * unit[:, None]
    about = x[:, None] + PROBE_STEPS[:, None] * rng.normal(size=(x.shape[0], PROBE_STEPS.size, x.shape[1]))
    whole = np.concatenate([towards, along, about], axis=1)
    return _cut(unknown, x, _into_set(unknown, whole.reshape(-1, x.shape[1])).reshape(whole.shape))


def _cut(unknown: Uncertainty, x: Float[np.ndarray, "s k"], trials: Float[np.ndarray, "s t k"]) -> Trials:
    """Return the trials, those beyond a physical bound moved back along their way from x."""
    share = np.ones(trials.shape[:2])
    for normal, room in unknown.bounds(x):
        way, free = (trials - x[:, None]) @ normal, np.maximum(room - ON_BOUND, 0.0)[:, None]
        beyond = way > free
        share = np.minimum(share, np.where(beyond, free / np.where(beyond, way, 1.0), 1.0))
    return x[:, None] + share[:, :, None] * (trials - x[:, None])


def _into_set(unknown: Uncertainty, x: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    """Return the points, those outside the ellipsoid or the box moved onto its edge."""
    g = len(unknown.names)
    size = np.linalg.norm(x[:, :g], axis=1, keepdims=True)
    return np.hstack([x[:, :g] * np.minimum(1.0, radius(g) / np.maximum(size, 1e-300)), np.clip(x[:, g:], -1.0, 1.0)])


def worst_html(found: Worst) -> str:
    """Return a worst case's figures and its parameters in SI units."""
    said = found.witness
    rows = [("Ms", f"{figure(found.ms)} at {figure(said.ms_hz, 'Hz')}"), ("Mt", figure(found.mt))]
    rows += [("spectral radius", f"{said.spectral_radius:.6g}")]
    return table(("worst case", ""), [*rows, *((name, f"{value:.5g}") for name, value in found.parameters.items())])
