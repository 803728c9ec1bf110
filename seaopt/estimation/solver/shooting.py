r"""Multiple shooting: each segment is cut into shots that start from states (nodes) of their own.

With :math:`x^-_i` the state in which shot i ends, the joints are residuals too,

.. math:: \rho\, S^{-1} (x^-_i - x_{i+1} + \mu_i), \qquad \mu_i \leftarrow \mu_i + (x^-_i - x_{i+1}),

S the size of the states: at first weak, so that no simulation can run away from the log, then stiffer and stiffer, and
at the end exact by the method of multipliers (Hestenes 1969; Bock, 1983, for the shooting). A Gauss-Newton step in the
parameters :math:`z` and the nodes :math:`n` has a Hessian

.. math:: \begin{pmatrix} H & F^T \\ F & M \end{pmatrix}

with M block tridiagonal: M is factored in time linear in the shots, and what is left, :math:`H - F^T M^{-1} F`, is no
larger than the parameters. `least_squares` sees that; the nodes follow, :math:`dn = -M^{-1} (g_n + F dz)`.
"""

from __future__ import annotations

from dataclasses import field, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from seaopt.errors import EstimationError
from seaopt.estimation.problem.experiment import Experiment, check_shots, shot_edges
from seaopt.estimation.problem.losses import Linear
from seaopt.estimation.problem.methods import MultipleShooting
from seaopt.estimation.problem.normal_equations import add_gram
from seaopt.estimation.problem.residual_statistics import errors
from seaopt.estimation.problem.residuals import Evaluation, Residuals
from seaopt.estimation.problem.unknowns import collect
from seaopt.estimation.solver.least_squares import Callback, minimise
from seaopt.estimation.solver.solve import (
    Solved,
    best_start,
    estimated_sigma,
    explains_little,
    held_start,
    settle,
    with_observers,
)
from seaopt.parameters import ParameterSet
from seaopt.records import record
from seaopt.simulation import Pass, run_passes

STIFFNESS = (1e-4, 1e-2, 1.0, 1e2, 1e4)  # of the joints, over what the log says of a node
JOINED = 1e-7  # of the size of the states
MULTIPLIER_ROUNDS = 8
WORSE = 2.0  # residual power of single shooting, over that of the joined shots, that is no longer the same fit


@record(eq=False)
class Shots:
    """The shots of one segment: edges, nodes, multipliers, the size of the states, and how stiff the joints are."""

    edges: Int[np.ndarray, " shots1"]
    nodes: Float[np.ndarray, "shots nx"]
    shift: Float[np.ndarray, "joints nx"]
    weight: Float[np.ndarray, " nx"]
    fixed: bool

    def moved(self, step: Float[np.ndarray, "shots nx"]) -> Shots:
        """Return the shots with nodes moved."""
        return replace(self, nodes=self.nodes + step)


@record(eq=False)
class ShotEvaluation(Evaluation):
    """An evaluation with its nodes, and the step of the nodes that goes with a step of z: own - slope dz."""

    shots: tuple[tuple[Shots, ...], ...] = ()
    own: tuple[tuple[Float[np.ndarray, "shots nx"], ...], ...] = ()
    slope: tuple[tuple[Float[np.ndarray, "shots nx n"], ...], ...] = ()
    gaps: tuple[tuple[Float[np.ndarray, "joints nx"], ...], ...] = field(default=())


@record(eq=False)
class Shooting:
    """The problem of `least_squares` at one stiffness: residuals of the log and of the joints."""

    problem: Residuals
    shots: tuple[tuple[Shots, ...], ...]

    @np.errstate(all="ignore")
    def evaluate(
        self, z: Float[np.ndarray, " n"], here: Evaluation | None = None, damping: float = 0.0
    ) -> ShotEvaluation:
        """Return cost and reduced gradient and Hessian at z, with the nodes moved along."""
        shots = self._followed(z, here, damping)
        n = z.size
        unknowns = self.problem.unknowns
        (cost, gradient, hessian), pending = unknowns.prior(z), 0.0
        own: list[tuple[Any, ...]] = []
        slope: list[tuple[Any, ...]] = []
        gaps: list[tuple[Any, ...]] = []
        passes: list[tuple[Pass, ...]] = []
        for e, row in enumerate(shots):
            parts = [self._segment(e, s, z, shot) for s, shot in enumerate(row)]
            for part in parts:
                cost, gradient, hessian = cost + part.cost, gradient + part.gradient, hessian + part.hessian
                pending += part.pending
            own.append(tuple(part.own for part in parts))
            slope.append(tuple(part.slope for part in parts))
            gaps.append(tuple(part.gaps for part in parts))
            passes.append(tuple(part.found for part in parts))
        initial = [
            slot.index for places in unknowns.locals_of for r in places.initial for slot in r if slot.index is not None
        ]
        hessian[initial, initial] += 1.0  # an initial state is the first node, not an unknown of its own
        finite = np.isfinite(cost) and np.all(np.isfinite(gradient)) and np.all(np.isfinite(hessian))
        squares = tuple(np.sum([p.gram[:, :, 0, 0].sum(axis=0) for p in row], axis=0) for row in passes)
        counts = tuple(np.sum([p.count.sum(axis=0) for p in row], axis=0) for row in passes)
        return ShotEvaluation(
            z=z, cost=cost if finite else np.inf, gradient=gradient, hessian=hessian, squares=squares, counts=counts,
            undamped=np.zeros(n, dtype=bool), origin=z, passes=tuple(passes), pending=pending, shots=shots,
            own=tuple(own), slope=tuple(slope), gaps=tuple(gaps),
        )  # fmt: skip

    def _followed(
        self, z: Float[np.ndarray, " n"], here: Evaluation | None, damping: float
    ) -> tuple[tuple[Shots, ...], ...]:
        if not isinstance(here, ShotEvaluation):
            return self.shots
        dz, part = z - here.z, 1.0 / (1.0 + damping)
        return tuple(
            tuple(shot.moved(part * own - slope @ dz) for shot, own, slope in zip(*row, strict=True))
            for row in zip(here.shots, here.own, here.slope, strict=True)
        )

    def _segment(self, e: int, s: int, z: Float[np.ndarray, " n"], shots: Shots) -> _Segment:
        problem, n = self.problem, z.size
        model, piece = problem.unknowns.models[e], problem.segments[e][s]
        found = run_passes(model, piece, problem.point(e, z), shots.nodes, problem.weights(e), edges=shots.edges)
        count, nx = shots.nodes.shape
        shared = found.last.shape[2] - 1 - nx
        normal = np.zeros((count, 1 + n + nx, 1 + n + nx))  # of [residual, z, node], one a shot
        for o, places in enumerate(problem.columns(e, s)):
            is_node = (np.arange(places.size) >= shared) & (np.arange(places.size) < shared + nx)
            where = np.where(is_node, n + np.arange(places.size) - shared, places)
            add_gram(normal, found.gram[:, o] / problem.sigma[e][o] ** 2, where)
        cost = float(np.sum(found.loss / problem.sigma[e] ** 2))
        gaps = found.last[:-1, :, 0] - shots.nodes[1:]
        pulled = gaps + shots.shift
        cost += 0.5 * float(np.sum(shots.weight * pulled**2))
        joint = np.zeros((count - 1, nx, 1 + n + nx))  # residual of a joint, its derivatives by z and the node before
        joint[:, :, 0] = pulled
        theta = problem.columns(e, s)[0][:shared]
        joint[:, :, 1 + theta] = found.last[:-1, :, 1 : 1 + shared]
        joint[:, :, 1 + n :] = found.last[:-1, :, 1 + shared : 1 + shared + nx]
        normal[:-1] += np.einsum("sia,i,sib->sab", joint, shots.weight, joint)
        return _eliminated(cost, normal, joint, shots, found, gaps, n)


@record(eq=False)
class _Segment:
    """What a segment gives to the reduced problem, and how its nodes follow."""

    cost: float
    gradient: Float[np.ndarray, " n"]
    hessian: Float[np.ndarray, "n n"]
    pending: float
    own: Float[np.ndarray, "shots nx"]
    slope: Float[np.ndarray, "shots nx n"]
    gaps: Float[np.ndarray, "joints nx"]
    found: Pass


def _eliminated(
    cost: float, normal: Float[np.ndarray, "shots m m"], joint: Float[np.ndarray, "joints nx m"], shots: Shots,
    found: Pass, gaps: Float[np.ndarray, "joints nx"], n: int,
) -> _Segment:  # fmt: skip
    """Eliminate the nodes: factor the block tridiagonal M, and form the Schur complement."""
    from scipy.linalg import LinAlgError, solveh_banded

    count, nx = shots.nodes.shape
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
            solved = solveh_banded(band, flat)
    except (LinAlgError, ValueError):
        solved = np.full_like(flat, np.nan)
    own, slope = -solved[:, 0].reshape(count, nx), solved[:, 1:].reshape(count, nx, n)
    gradient = normal[:, 0, z].sum(axis=0) - flat[:, 1:].T @ solved[:, 0]
    hessian = normal[:, z, z].sum(axis=0) - flat[:, 1:].T @ solved[:, 1:]
    return _Segment(
        cost=cost, gradient=gradient, hessian=0.5 * (hessian + hessian.T),
        pending=0.5 * float(flat[:, 0] @ solved[:, 0]), own=own, slope=slope, gaps=gaps, found=found,
    )  # fmt: skip


def multiple_shooting(
    problem: Residuals, params: ParameterSet, method: MultipleShooting, callback: Callback | None
) -> Solved:
    """Join the shots step by step; then settle by single shooting, or on shots of their own if the plant runs away."""
    for experiment, pieces in zip(problem.experiments, problem.segments, strict=True):
        longest = max(piece.n for piece in pieces)
        check_shots(experiment, longest, method.segments, f"MultipleShooting(segments={method.segments})")
    start, _ = best_start(problem, method)
    plain = replace(problem, band_hz=None, loss=Linear())
    z = start.z
    if method.search and (not np.isfinite(start.cost) or explains_little(problem, start)):
        held = held_start(problem, z, method.max_iterations)
        z = z if held is None else held
    z, ends, sigma = _joined(plain, z, method, callback)
    single = problem.evaluate(_with_initial(problem, z, ends))
    if np.isfinite(single.cost):
        settled = settle(problem, single, method.max_iterations, callback)
        if settled.solution.status == "converged" and _explains(settled, sigma):
            return settled
    return _apart(problem, params, method, z, ends, callback)


def _apart(
    problem: Residuals, params: ParameterSet, method: MultipleShooting, z: Float[np.ndarray, " n"],
    ends: tuple[tuple[Shots, ...], ...], callback: Callback | None,
) -> Solved:  # fmt: skip
    """Settle on shots that keep initial states of their own, for a plant that runs away in one go."""
    experiments = tuple(replace(e, shots=e.shots * method.segments) for e in problem.experiments)
    unknowns = collect(experiments, params, band_hz=problem.band_hz)
    segments = tuple(tuple(e.segments(problem.holdout)) for e in experiments)
    apart = replace(problem, experiments=experiments, unknowns=unknowns, segments=segments)
    for e, experiment in enumerate(experiments):
        settle_rows, longest = apart.weights(e).settle, max(piece.n for piece in segments[e])
        if longest <= 2 * settle_rows:
            raise EstimationError(
                f"experiment {experiment.name}: the plant runs away in simulation, and its shots have {longest} "
                f"samples, of which the band filter takes {settle_rows} to settle; use fewer segments or no band_hz"
            )
    values = unknowns.start.copy()
    for name, value in zip(problem.unknowns.names, z, strict=True):
        if name in unknowns.names:
            values[unknowns.names.index(name)] = value
    for e, places in enumerate(unknowns.locals_of):
        nodes = _nodes_by_row(problem.experiments[e], ends[e])
        for slots, piece in zip(places.initial, experiments[e].pieces, strict=True):
            for slot, value in zip(slots, nodes.get(piece.start, ()), strict=False):
                if slot.index is not None:
                    values[slot.index] = float(value)
    found = settle(apart, apart.evaluate(values), method.max_iterations, callback)
    told = f"{found.solution.message}; the plant runs away in one go: shots keep initial states of their own"
    return replace(found, solution=replace(found.solution, message=told))


def _nodes_by_row(experiment: Experiment, shots: tuple[Shots, ...]) -> dict[int, Float[np.ndarray, " nx"]]:
    """Return the nodes by the row of the log at which they stand."""
    return {
        piece.start + int(edge): node
        for piece, one in zip(experiment.pieces, shots, strict=True)
        for edge, node in zip(one.edges[:-1], one.nodes, strict=True)
    }


def _joined(
    problem: Residuals, z: Float[np.ndarray, " n"], method: MultipleShooting, callback: Callback | None
) -> tuple[Float[np.ndarray, " n"], tuple[tuple[Shots, ...], ...], tuple[Float[np.ndarray, " _"], ...]]:
    """Return unknowns, shots and sigmas after the joints have closed, as far as they do."""
    shots = _first_shots(problem, z, method.segments)
    low, high = problem.unknowns.low, problem.unknowns.high
    scale = _weights(Shooting(problem=problem, shots=shots), z)
    for number in range(len(STIFFNESS) + MULTIPLIER_ROUNDS):
        stiff = STIFFNESS[min(number, len(STIFFNESS) - 1)]
        shots = tuple(
            tuple(replace(shot, weight=stiff * own) for shot, own in zip(row, rows, strict=True))
            for row, rows in zip(shots, scale, strict=True)
        )
        shooting = Shooting(problem=problem, shots=shots)
        found = minimise(shooting.evaluate, z, low, high, max_iterations=method.max_iterations, callback=callback)
        last = found.evaluation
        if not isinstance(last, ShotEvaluation) or not np.isfinite(last.cost):
            break
        z, shots = found.z, last.shots
        problem = problem.with_sigma(estimated_sigma(problem, last))
        worst = 0.0
        for row, gaps in zip(shots, last.gaps, strict=True):
            for shot, gap in zip(row, gaps, strict=True):
                size = np.maximum(np.max(np.abs(shot.nodes), axis=0), 1e-300)
                worst = max(worst, float(np.max(np.abs(gap) / size, initial=0.0)))
        if number >= len(STIFFNESS) - 1:
            if worst < JOINED:
                break
            shots = tuple(
                tuple(replace(shot, shift=shot.shift + gap) for shot, gap in zip(row, gaps, strict=True))
                for row, gaps in zip(shots, last.gaps, strict=True)
            )
    return z, shots, problem.sigma


def _explains(settled: Solved, sigma: tuple[Float[np.ndarray, " _"], ...]) -> bool:
    """Tell whether single shooting leaves no more than the joined shots do; where the plant runs away it does not."""
    plain = replace(settled.problem, band_hz=None, loss=Linear(), sigma=sigma)  # as the shots were joined
    for row in errors(plain, settled.solution.z):
        weighted = np.concatenate([error.weighted for error in row])
        used = np.maximum(np.count_nonzero(weighted, axis=0), 1)
        # The level is left free: a band that leaves out 0 Hz does not see it.
        power = np.sum(weighted**2, axis=0) / used - (np.sum(weighted, axis=0) / used) ** 2
        if not np.all(power < WORSE):
            return False
    return True


@np.errstate(all="ignore")
def _weights(shooting: Shooting, z: Float[np.ndarray, " n"]) -> list[list[Float[np.ndarray, " nx"]]]:
    """Return, for each segment, what the log says of a node: the median diagonal of its information."""
    found = shooting.evaluate(z)
    rows: list[list[Float[np.ndarray, " nx"]]] = []
    for e, (passes, shots) in enumerate(zip(found.passes, found.shots, strict=True)):
        row: list[Float[np.ndarray, " nx"]] = []
        for one, shot in zip(passes, shots, strict=True):
            nx = shot.nodes.shape[1]
            first = one.last.shape[2] - nx
            information = sum(
                one.gram[:, o, first : first + nx, first : first + nx] / shooting.problem.sigma[e][o] ** 2
                for o in range(one.gram.shape[1])
            )
            diagonal = np.median(np.diagonal(np.asarray(information), axis1=1, axis2=2), axis=0)
            size = np.maximum(np.std(shot.nodes, axis=0), 1e-300)
            ruling = float(np.max(np.where(np.isfinite(diagonal), diagonal, 0.0) * size**2))
            row.append(max(ruling, 1.0) / size**2)
        rows.append(row)
    return rows


def _first_shots(problem: Residuals, z: Float[np.ndarray, " n"], count: int) -> tuple[tuple[Shots, ...], ...]:
    """Return shots whose nodes are where a filter that hardly trusts the plant sees the state."""
    watched = with_observers(problem, z, follows=False)
    rows: list[tuple[Shots, ...]] = []
    for e, pieces in enumerate(problem.segments):
        row: list[Shots] = []
        nx = problem.unknowns.models[e].nx
        for s, piece in enumerate(pieces):
            edges = shot_edges(piece.n, count)
            shots = len(edges) - 1
            nodes = np.zeros((shots, nx))
            if watched is not None:
                states = watched.run(e, s, z, sums=False, states=True).states
                assert states is not None
                nodes = states[edges[:-1]].copy() if np.all(np.isfinite(states)) else nodes
            fixed = all(slot.index is None for slot in problem.unknowns.locals_of[e].initial[s])
            if fixed:
                nodes[0] = problem.start(e, s, z)
            row.append(
                Shots(edges=edges, nodes=nodes, shift=np.zeros((shots - 1, nx)), weight=np.ones(nx), fixed=fixed)
            )
        rows.append(tuple(row))
    return tuple(rows)


def _with_initial(
    problem: Residuals, z: Float[np.ndarray, " n"], shots: tuple[tuple[Shots, ...], ...]
) -> Float[np.ndarray, " n"]:
    """Return the unknowns with each segment's first node as its initial state."""
    z = z.copy()
    for places, row in zip(problem.unknowns.locals_of, shots, strict=True):
        for slots, shot in zip(places.initial, row, strict=True):
            for slot, value in zip(slots, shot.nodes[0], strict=True):
                if slot.index is not None:
                    z[slot.index] = value
    return z
