r"""Multiple shooting: each segment is cut into shots that start from states (nodes) of their own.

With :math:`x^-_i` the state in which shot i ends, the joints are residuals too,

.. math:: \rho\, S^{-1} (x^-_i - x_{i+1} + \mu_i), \qquad \mu_i \leftarrow \mu_i + (x^-_i - x_{i+1}),

S the size of the states: at first weak, so that no simulation can run away from the log, then stiffer and stiffer, and
at the end exact by the method of multipliers (Hestenes 1969; Bock, 1983, for the shooting). A Gauss-Newton step in the
parameters :math:`z` and the nodes :math:`n` has a Hessian

.. math:: \begin{pmatrix} H & F^T \\ F & M \end{pmatrix}

with M block tridiagonal: M is factored in time linear in the shots, and what is left, :math:`H - F^T M^{-1} F`, is no
larger than the parameters. `least_squares` is given that condensed problem; the nodes follow,
:math:`dn = -M^{-1} (g_n + F dz)`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.errors import EstimationError
from seaopt.estimation.problem.experiment import Experiment, check_shots, cut_into_shots
from seaopt.estimation.problem.fit_experiment import FitExperiment, FitSegment, ResidualPower
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.losses import Squares
from seaopt.estimation.problem.normal_equations import QuadraticModel, TrustRegionStep, add_gram
from seaopt.estimation.problem.residual_statistics import compute_residuals
from seaopt.estimation.solver.least_squares import Callback, minimise
from seaopt.estimation.solver.methods import Method, OutputError, find_start
from seaopt.estimation.solver.prediction import add_predictors, find_predicting_start
from seaopt.estimation.solver.settle import Solved, estimate_sigma, explains_little, settle
from seaopt.records import record
from seaopt.simulation import Pass, run_passes

STIFFNESS = (1e-4, 1e-2, 1.0, 1e2, 1e4)  # of the joints, over what the log says of a node
JOINED = 1e-7  # of the size of the states
MULTIPLIER_ROUNDS = 8
ANOTHER_FIT = 2.0  # residual power of single shooting, over that of the joined shots, that is no longer the same fit


@record
class MultipleShooting(Method):
    """Each segment is cut into shots that start from states of their own; the shots are joined while the fit goes on.

    For plants that are unstable, or a start far off: a simulation that restarts at intervals cannot diverge. At the
    end the shots join to rounding: the result is that of `OutputError` wherever both find it. Where the plant diverges
    in one pass the shots keep their own initial states, as the message states: the intervals are then wider.

    Parameters
    ----------
    segments : int
        Shots per log segment; a segment shorter than the longest may have fewer. Each shot needs a sample more than the
        plant has states, and at least four.
    max_iterations : int
        Of least squares, each time the joints are made stiffer.
    search : bool
        Start from the logs' frequency responses where they explain the logs better than the given values.
    seed : int
        Of that search.

    """

    key: ClassVar[str] = "multiple_shooting"

    segments: int = 50

    def __post_init__(self) -> None:
        if self.segments < 1:
            raise EstimationError(f"MultipleShooting(segments={self.segments}): give at least 1")

    def solve(self, problem: FitProblem, callback: Callback | None) -> Solved:
        """Join the shots step by step; then settle by single shooting, or on separate shots if the plant runs away."""
        for experiment in problem.experiments:
            check_shots(
                experiment.data, experiment.longest, self.segments, f"MultipleShooting(segments={self.segments})"
            )
        start, _ = find_start(problem, self)
        z = start.z
        if self.search and (not np.isfinite(start.cost) or explains_little(problem, start.power)):
            predicting = find_predicting_start(problem, z, self.max_iterations)
            z = z if predicting is None else predicting
        joined, z, shots = _join(problem.with_each(band_hz=None, loss=Squares()), z, self, callback)
        single = problem.evaluate(_with_first_nodes(problem, z, shots))
        solved = settle(problem, single, self.max_iterations, callback) if np.isfinite(single.cost) else None
        if solved is not None and not (_has_converged(solved) and _explains_as_much(solved, joined)):
            solved = None
        if self.search and (solved is None or _explains_little(solved)):
            # Shots may follow a log that no input drives; a plant that is simulated in one go cannot.
            other = OutputError(max_iterations=self.max_iterations, seed=self.seed).solve(problem, callback)
            if _has_converged(other) and not _explains_little(other):
                return other
        if solved is not None:
            return solved
        return _settle_apart(problem, self, z, shots, callback)


@record(eq=False)
class Shots:
    """The shots of one segment: edges, nodes, multipliers, the size of the states, and how stiff the joints are."""

    edges: Int[np.ndarray, " shots1"]
    nodes: Float[np.ndarray, "shots nx"]
    shift: Float[np.ndarray, "joints nx"]
    weight: Float[np.ndarray, " nx"]
    fixed: bool


ShotsByExperiment = Mapping[str, tuple[Shots, ...]]  # one per segment


@record(eq=False)
class CondensedSegment:
    """What a segment gives to the problem without nodes, and the step of the nodes with a step dz: own - slope dz.

    `pending` is the fall of the cost still expected from the nodes, `gaps` what the joints still leave open.
    """

    cost: float
    gradient: Float[np.ndarray, " n"]
    hessian: Float[np.ndarray, "n n"]
    pending: float
    own: Float[np.ndarray, "shots nx"]
    slope: Float[np.ndarray, "shots nx n"]
    gaps: Float[np.ndarray, "joints nx"]
    shots: Shots
    passes: Pass

    def move_nodes(self, dz: Float[np.ndarray, " n"], share: float) -> Shots:
        """Return the shots with their nodes moved along."""
        return replace(self.shots, nodes=self.shots.nodes + (share * self.own - self.slope @ dz))


@record(eq=False)
class CondensedModel(QuadraticModel):
    """The quadratic model in the parameters alone, and the segments whose nodes were eliminated."""

    power: Mapping[str, ResidualPower]
    segments: Mapping[str, tuple[CondensedSegment, ...]]

    @property
    def pending(self) -> float:
        """The fall of the cost still expected from the nodes."""
        return sum(segment.pending for row in self.segments.values() for segment in row)

    @property
    def shots(self) -> dict[str, tuple[Shots, ...]]:
        """Of every experiment."""
        return {name: tuple(segment.shots for segment in row) for name, row in self.segments.items()}

    def distance_squared(self, free: Bool[np.ndarray, " n"]) -> float:
        """Return the squared distance to the minimum, nodes included."""
        return QuadraticModel.distance_squared(self, free) + 2.0 * self.pending

    def predict_fall(self, step: Float[np.ndarray, " n"]) -> float:
        """Return by how much a step lowers the cost with the nodes moved along."""
        return QuadraticModel.predict_fall(self, step) + self.pending


@record(eq=False)
class Shooting:
    """The condensed problem at one stiffness: residuals of the log and of the joints."""

    problem: FitProblem
    first_shots: ShotsByExperiment

    def evaluate(self, z: Float[np.ndarray, " n"]) -> CondensedModel:
        """Return the condensed model at z, with the nodes where the stage starts."""
        return self._condense(z, self.first_shots)

    def take_step(self, step: TrustRegionStep[CondensedModel]) -> CondensedModel:
        """Return the condensed model at the end of a step, with the nodes moved along.

        Of the nodes' own step they make the share 1/(1 + lambda), as the region shortens that of the parameters.
        """
        share, segments = 1.0 / (1.0 + step.damping), step.start.segments
        moved = {name: tuple(s.move_nodes(step.moved, share) for s in row) for name, row in segments.items()}
        return self._condense(step.end, moved)

    @np.errstate(all="ignore")
    def _condense(self, z: Float[np.ndarray, " n"], shots: ShotsByExperiment) -> CondensedModel:
        unknowns = self.problem.unknowns
        cost, gradient, hessian = unknowns.prior(z)
        segments: dict[str, tuple[CondensedSegment, ...]] = {}
        for experiment in self.problem.experiments:
            pairs = zip(experiment.segments, shots[experiment.name], strict=True)
            segments[experiment.name] = tuple(_condense(experiment, segment, z, one) for segment, one in pairs)
            for part in segments[experiment.name]:
                cost, gradient, hessian = cost + part.cost, gradient + part.gradient, hessian + part.hessian
        starts = (segment.initial for experiment in self.problem.experiments for segment in experiment.segments)
        initial = [slot.index for slots in starts for slot in slots if slot.index is not None]
        hessian[initial, initial] += 1.0  # an initial state is the first node, not an unknown of its own
        finite = np.isfinite(cost) and np.all(np.isfinite(gradient)) and np.all(np.isfinite(hessian))
        power = {
            name: ResidualPower(
                squares=np.sum([part.passes.gram[:, :, 0, 0].sum(axis=0) for part in row], axis=0),
                counts=np.sum([part.passes.count.sum(axis=0) for part in row], axis=0),
            )
            for name, row in segments.items()
        }
        return CondensedModel(
            z=z, cost=cost if finite else np.inf, gradient=gradient, hessian=hessian,
            linear=np.zeros(z.size, dtype=bool), power=power, segments=segments,
        )  # fmt: skip


def _condense(
    experiment: FitExperiment, segment: FitSegment, z: Float[np.ndarray, " n"], shots: Shots
) -> CondensedSegment:
    """Add up the normal equations of a segment's shots and joints, and eliminate the nodes."""
    n, (count, nx) = z.size, shots.nodes.shape
    passes = run_passes(
        experiment.model, segment.samples, experiment.point(z), shots.nodes, experiment.weights, edges=shots.edges
    )
    shared = passes.last.shape[2] - 1 - nx
    columns = experiment.columns(segment)
    normal = np.zeros((count, 1 + n + nx, 1 + n + nx))  # of [residual, z, node], one per shot
    for o, places in enumerate(columns):
        is_node = (np.arange(places.size) >= shared) & (np.arange(places.size) < shared + nx)
        where = np.where(is_node, n + np.arange(places.size) - shared, places)
        add_gram(normal, passes.gram[:, o] / experiment.sigma[o] ** 2, where)
    cost = float(np.sum(passes.loss / experiment.sigma**2))
    gaps = passes.last[:-1, :, 0] - shots.nodes[1:]
    pulled = gaps + shots.shift
    cost += 0.5 * float(np.sum(shots.weight * pulled**2))
    joint = np.zeros((count - 1, nx, 1 + n + nx))  # residual of a joint, its derivatives by z and the node before
    joint[:, :, 0] = pulled
    theta = columns[0][:shared]
    joint[:, :, 1 + theta] = passes.last[:-1, :, 1 : 1 + shared]
    joint[:, :, 1 + n :] = passes.last[:-1, :, 1 + shared : 1 + shared + nx]
    normal[:-1] += np.einsum("sia,i,sib->sab", joint, shots.weight, joint)
    return _eliminate_nodes(cost, normal, joint, shots, passes, gaps)


def _eliminate_nodes(
    cost: float, normal: Float[np.ndarray, "shots m m"], joint: Float[np.ndarray, "joints nx m"], shots: Shots,
    passes: Pass, gaps: Float[np.ndarray, "joints nx"],
) -> CondensedSegment:  # fmt: skip
    """Eliminate the nodes: factor the block tridiagonal M, and form the Schur complement."""
    from scipy.linalg import LinAlgError, solveh_banded

    count, nx = shots.nodes.shape
    n = normal.shape[1] - 1 - nx
    node, z = slice(1 + n, 1 + n + nx), slice(1, 1 + n)
    diagonal = normal[:, node, node].copy()
    right = np.concatenate([normal[:, node, :1], normal[:, node, z]], axis=2)  # [g_n, F]
    diagonal[1:] += np.diag(shots.weight)
    right[1:] -= shots.weight[:, None] * joint[:, :, : 1 + n]
    coupling = -joint[:, :, node].transpose(0, 2, 1) * shots.weight  # rows: node, columns: the next
    if shots.fixed:
        diagonal[0], right[0] = np.eye(nx), 0.0
        coupling[:1] = 0.0
    band = np.zeros((2 * nx, count * nx))  # LAPACK's upper form: entry (i, j) at [2 nx - 1 + i - j, j]
    for i in range(nx):
        for j in range(nx):
            if j >= i:
                band[2 * nx - 1 + i - j, j::nx] = diagonal[:, i, j]
            band[nx - 1 + i - j, nx + j :: nx] = coupling[:, i, j]
    band[-1] = band[-1] * (1.0 + 1e-12) + 1e-300
    flat = right.reshape(count * nx, 1 + n)
    try:
        with np.errstate(all="ignore"):
            solution = solveh_banded(band, flat)
    except (LinAlgError, ValueError):
        solution = np.full_like(flat, np.nan)
    own, slope = -solution[:, 0].reshape(count, nx), solution[:, 1:].reshape(count, nx, n)
    gradient = normal[:, 0, z].sum(axis=0) - flat[:, 1:].T @ solution[:, 0]
    hessian = normal[:, z, z].sum(axis=0) - flat[:, 1:].T @ solution[:, 1:]
    return CondensedSegment(
        cost=cost, gradient=gradient, hessian=0.5 * (hessian + hessian.T),
        pending=0.5 * float(flat[:, 0] @ solution[:, 0]), own=own, slope=slope, gaps=gaps,
        shots=shots, passes=passes,
    )  # fmt: skip


def _settle_apart(
    problem: FitProblem, method: MultipleShooting, z: Float[np.ndarray, " n"], shots: ShotsByExperiment,
    callback: Callback | None,
) -> Solved:  # fmt: skip
    """Settle on shots that keep initial states of their own, for a plant that runs away in one go."""
    cut = {e.name: replace(e.data, shots=e.data.shots * method.segments) for e in problem.experiments}
    apart, values = problem.rebuild(problem.params, z, cut)
    for experiment in apart.experiments:
        settle_rows, longest = experiment.weights.settle, experiment.longest
        if longest <= 2 * settle_rows:
            raise EstimationError(
                f"experiment {experiment.name}: the plant runs away in simulation, and its shots have {longest} "
                f"samples, of which the band filter takes {settle_rows} to settle; use fewer segments or no band_hz"
            )
    for old, new in zip(problem.experiments, apart.experiments, strict=True):
        nodes = _find_nodes_by_row(old.data, shots[old.name])
        for segment, piece in zip(new.segments, new.data.pieces, strict=True):
            for slot, value in zip(segment.initial, nodes.get(piece.start, ()), strict=False):
                if slot.index is not None:
                    values[slot.index] = float(value)
    solved = settle(apart, apart.evaluate(values), method.max_iterations, callback)
    message = f"{solved.solution.message}; the plant runs away in one go: shots keep initial states of their own"
    return replace(solved, solution=replace(solved.solution, message=message))


def _find_nodes_by_row(experiment: Experiment, shots: tuple[Shots, ...]) -> dict[int, Float[np.ndarray, " nx"]]:
    """Return the nodes by the row of the log at which they stand."""
    return {
        piece.start + int(edge): node
        for piece, one in zip(experiment.pieces, shots, strict=True)
        for edge, node in zip(one.edges[:-1], one.nodes, strict=True)
    }


def _join(
    problem: FitProblem, z: Float[np.ndarray, " n"], method: MultipleShooting, callback: Callback | None
) -> tuple[FitProblem, Float[np.ndarray, " n"], ShotsByExperiment]:
    """Return the problem with its sigmas, unknowns and shots after the joints have closed, as far as they do."""
    shots = _make_shots(problem, z, method.segments)
    low, high = problem.unknowns.low, problem.unknowns.high
    scale = _weigh_nodes(problem, Shooting(problem=problem, first_shots=shots).evaluate(z))
    for number in range(len(STIFFNESS) + MULTIPLIER_ROUNDS):
        stiff = STIFFNESS[min(number, len(STIFFNESS) - 1)]
        shots = {
            name: tuple(replace(one, weight=stiff * size) for one, size in zip(row, scale[name], strict=True))
            for name, row in shots.items()
        }
        shooting = Shooting(problem=problem, first_shots=shots)
        solution = minimise(shooting, z, low, high, max_iterations=method.max_iterations, callback=callback)
        last = solution.evaluation
        if not np.isfinite(last.cost):
            break
        z, shots = solution.z, last.shots
        problem = problem.with_sigma(estimate_sigma(problem, last.power, z))
        if number >= len(STIFFNESS) - 1:
            if _measure_gaps(last) < JOINED:
                break
            shots = {
                name: tuple(replace(part.shots, shift=part.shots.shift + part.gaps) for part in row)
                for name, row in last.segments.items()
            }
    return problem, z, shots


def _measure_gaps(model: CondensedModel) -> float:
    """Return the widest gap at a joint, over the largest value of its state."""
    worst = 0.0
    for row in model.segments.values():
        for part in row:
            size = np.maximum(np.max(np.abs(part.shots.nodes), axis=0), 1e-300)
            worst = max(worst, float(np.max(np.abs(part.gaps) / size, initial=0.0)))
    return worst


def _has_converged(solved: Solved) -> bool:
    return solved.solution.status == "converged"


def _explains_little(solved: Solved) -> bool:
    return explains_little(solved.problem, solved.solution.evaluation.power)


def _explains_as_much(solved: Solved, joined: FitProblem) -> bool:
    """Tell whether single shooting leaves no more than the joined shots do; where the plant runs away it does not."""
    plain = solved.problem.with_each(band_hz=None, loss=Squares())  # as the shots were joined
    plain = plain.with_sigma({experiment.name: experiment.sigma for experiment in joined.experiments})
    for residuals in compute_residuals(plain, solved.solution.z).values():
        weighted = residuals.weighted
        used = np.maximum(np.count_nonzero(weighted, axis=0), 1)
        # The level is left free: a band that leaves out 0 Hz does not see it.
        power = np.sum(weighted**2, axis=0) / used - (np.sum(weighted, axis=0) / used) ** 2
        if not np.all(power < ANOTHER_FIT):
            return False
    return True


@np.errstate(all="ignore")
def _weigh_nodes(problem: FitProblem, model: CondensedModel) -> dict[str, list[Float[np.ndarray, " nx"]]]:
    """Return, for each segment, what the log says of a node: the median diagonal of its information."""
    scale: dict[str, list[Float[np.ndarray, " nx"]]] = {}
    for experiment in problem.experiments:
        scale[experiment.name] = []
        for part in model.segments[experiment.name]:
            passes, nx = part.passes, part.shots.nodes.shape[1]
            first = passes.last.shape[2] - nx
            information = sum(
                passes.gram[:, o, first : first + nx, first : first + nx] / sigma**2
                for o, sigma in enumerate(experiment.sigma)
            )
            diagonal = np.median(np.diagonal(np.asarray(information), axis1=1, axis2=2), axis=0)
            size = np.maximum(np.std(part.shots.nodes, axis=0), 1e-300)
            ruling = float(np.max(np.where(np.isfinite(diagonal), diagonal, 0.0) * size**2))
            scale[experiment.name].append(max(ruling, 1.0) / size**2)
    return scale


def _make_shots(problem: FitProblem, z: Float[np.ndarray, " n"], count: int) -> ShotsByExperiment:
    """Return shots whose nodes are where a filter that hardly trusts the plant sees the state."""
    predicting = add_predictors(problem, z, follows=False)
    experiments = (problem if predicting is None else predicting).experiments
    return {e.name: tuple(_make_segment_shots(e, segment, z, count) for segment in e.segments) for e in experiments}


def _make_segment_shots(
    experiment: FitExperiment, segment: FitSegment, z: Float[np.ndarray, " n"], count: int
) -> Shots:
    edges, nx = cut_into_shots(segment.samples.n, count), experiment.model.nx
    shots = len(edges) - 1
    nodes = np.zeros((shots, nx))
    if experiment.predictor is not None:
        states = experiment.run(segment, z, sums=False, states=True).states
        assert states is not None
        nodes = states[edges[:-1]].copy() if np.all(np.isfinite(states)) else nodes
    fixed = all(slot.index is None for slot in segment.initial)
    if fixed:
        nodes[0] = segment.start(z)
    return Shots(edges=edges, nodes=nodes, shift=np.zeros((shots - 1, nx)), weight=np.ones(nx), fixed=fixed)


def _with_first_nodes(
    problem: FitProblem, z: Float[np.ndarray, " n"], shots: ShotsByExperiment
) -> Float[np.ndarray, " n"]:
    """Return the unknowns with each segment's first node as its initial state."""
    z = z.copy()
    for experiment in problem.experiments:
        for segment, one in zip(experiment.segments, shots[experiment.name], strict=True):
            for slot, value in zip(segment.initial, one.nodes[0], strict=True):
                if slot.index is not None:
                    z[slot.index] = value
    return z
