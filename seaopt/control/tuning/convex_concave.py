r"""Improve a law's gains by successive quadratic programs, the convex-concave procedure, for the tuner's second step.

At fixed filters C_r and C_y, and with them every :math:`L_m = P_m C_y`, are affine in the gains
:math:`\theta = (k_p, k_i, k_d, w_r, w_c)`, the last two the weights of the reference, and k_v of a cascade. At the last
iterate let :math:`\alpha_m = \arg(1 + L_m)`. Then

.. math:: |1 + L_m(\theta)| \ge \rho_m(\theta) = \mathrm{Re}\, e^{-j\alpha_m} (1 + L_m(\theta)),

an affine function that is exact at the iterate: a limit :math:`|1 + L| \ge 1/M_s` is kept by
:math:`\rho \ge 1/M_s`, an inner approximation (Karimi, Galdos 2010; Hast, Astrom, Bernhardsson, Boyd, ECC 2013). As
:math:`\rho > 0` at every frequency turns 1 + L by less than a quarter from a curve that does not encircle the origin,
stability is kept too, where the frequencies are dense enough; eigenvalues decide. A limit :math:`|X| \le M |1 + L|`, X
one of L, 1 - L, C_y, P C_r, becomes

.. math:: \mathrm{Re}\, e^{-j \arg X_k} X(\theta) \le M \rho(\theta),

one side of the disk, whose other points a trust region keeps in reach. Passivity of the port, Re
conj(u) (1 + G C_y) >= 0 with u and G known, is affine as it stands where the regulated force tells that at the port;
with further signals it is linearised. The objective
:math:`\int |S|\, d\ln f \le \int d\ln f / \rho` is majorised by a convex function, of which the program takes value,
gradient and curvature; the peak of :math:`|C_y S|` enters by its own rows. Bandwidth is a linearised equality. One
slack, at a price, is added to every row, so that the program always has a solution and a start that breaks limits
is repaired in as even a way as possible.

A step is kept if the merit, objective and price of the worst usage, falls, and if all loops are stable; otherwise the
trust region shrinks. Rows are in units of their limit, variables in units of the gains. Of all rows only those
that matter are given to the solver. OSQP's status is checked, and its answer by the merit, which knows all rows: an
answer that is cut off after 500 iterations, as half of them are, is good enough to go on from.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control.tuning.frequencies import choose_prominent
from seaopt.control.tuning.grid import FRICTION, Curve, Grid, Indices, LawResponse, Path, Usage, Values, use_disc
from seaopt.control.tuning.law_numbers import K_D, K_P, K_V, LawNumbers
from seaopt.control.tuning.optimisation_problem import CURVES, NEXT_TO_NO_NOISE, PASSIVE, SCOPES, Task
from seaopt.records import record
from seaopt.signals import ComplexN, MatrixMN, MatrixNN

PerGain = Float[np.ndarray, " g"]
ValueSlopes = Float[np.ndarray, "n g"]
PointSlopes = Float[np.ndarray, "c g"]
GainResponses = Complex[np.ndarray, "g m"]
Rows = tuple[Values, ValueSlopes]

MOST_PROGRAMS = 8
ROWS_PER_LIMIT = 10  # per kind of limit
FIRST_GAIN_RADIUS = 0.4  # trust region, as a fraction of the gains
SMALLEST_GAIN_RADIUS = 0.01
NEAR = 0.4  # of a limit: points that use less of it are left out
STEP = 1e-5  # of C_y: of differences where responses lie in discs
USAGE_PRICE = 20.0  # of one unit of usage beyond the limit, in logarithms of the objective


@record(eq=False)
class _Affine:
    """The law at the iterate, and the derivatives of C_y, C_r and C_v by the g gains."""

    law: LawResponse
    by_y: GainResponses
    by_r: GainResponses
    by_v: GainResponses


def improve(task: Task, grid: Grid, start: LawNumbers) -> tuple[float, LawNumbers]:
    """Return merit and numbers after quadratic programs in the gains of a stable law; its filters stay as they are."""
    x, radius = start, FIRST_GAIN_RADIUS
    least = _choose_least_gains(task, grid)
    scale = _scale_gains(task, start, least)
    merit = _measure_merit(task, grid, x)
    for _ in range(MOST_PROGRAMS):
        step = _solve_step(task, grid, x, radius * scale)
        if step is None:
            break
        trial = x.copy()
        trial[task.gains_tuned] += step
        trial = task.tidy(trial)
        trial_merit = _measure_merit(task, grid, trial)
        if trial_merit < merit and task.is_stable(trial):
            small = merit - trial_merit < 1e-3
            x, merit, radius = trial, trial_merit, min(1.5 * radius, 1.0)
            scale = _scale_gains(task, x, 0.1 * scale)
            if small:
                break
        else:
            radius *= 0.35
            if radius < SMALLEST_GAIN_RADIUS:
                break
    return merit, x


def _choose_least_gains(task: Task, grid: Grid) -> PerGain:
    """Return gains that make a difference: a tenth of the inverse plant's at the bandwidth."""
    w_b, at = 2 * np.pi * task.spec.bandwidth_hz, task.find_bandwidth(grid)
    inverse, of_speed = (1.0 / (gain or 1.0) for gain in (float(np.abs(grid.plants.y[0, at])), task.speed_gain(grid)))
    least = 0.1 * np.array([inverse, 0.1 * w_b * inverse, inverse / w_b, inverse, inverse / w_b, of_speed])
    return least[task.gains_tuned]


def _scale_gains(task: Task, x: LawNumbers, least: PerGain) -> PerGain:
    """Return the size that a change of each gain is compared with: a weight's is that of what it weights."""
    sizes = np.array([*np.abs(x[: K_D + 1]), task.k_ff + x[K_P], x[K_D], x[K_V]])
    return np.maximum(sizes[task.gains_tuned], least)


def _measure_merit(task: Task, grid: Grid, x: LawNumbers) -> float:
    """Return the logarithm of the objective and the price of the worst usage."""
    worst, objective = task.judge(grid, x, bandwidth_price=1.0)
    return float(np.log(objective)) + USAGE_PRICE * max(0.0, worst - 1.0)


def linearise_law(task: Task, grid: Grid, x: LawNumbers) -> _Affine:
    """Return the law on a grid with its derivatives by the gains."""
    series, integral, rate, _, _, prefilter = task.terms(grid, x)
    ones, zeros, gains = np.ones_like(grid.q), np.zeros_like(grid.q), task.gains_tuned
    by_y = series * np.array([ones, integral, rate, zeros, zeros, zeros])[gains]
    by_r = series * prefilter * np.array([ones, integral, rate, -ones, -rate, zeros])[gains]
    by_v = series * np.array([zeros, zeros, zeros, zeros, zeros, task.sense(grid.q)])[gains]
    return _Affine(law=task.respond(grid, x), by_y=by_y, by_r=by_r, by_v=by_v)


def _differentiate_size(value: ComplexN, by: Complex[np.ndarray, "g n"]) -> ValueSlopes:
    """Return the derivative of abs(value): the part of `by` along it."""
    size = np.maximum(np.abs(value), 1e-300)
    return np.real(np.conj(value) / size * by).T


def _linearise_limits(task: Task, grid: Grid, law: _Affine) -> list[Rows]:
    """Return rows value + slope dtheta - slack <= 1 at the frequencies and plants where the limits matter."""
    rows, usage = list[Rows](), task.usage(grid, law.law)
    for name in grid.levels:
        index = choose_near(usage[name])
        used, near_limit = usage[name].ravel()[index], CURVES[name].of == "1"  # the limit is on abs(1 + L) itself
        if grid.in_discs:
            slope = _differentiate_usage(grid, law, name, index)
            rows.append((2.0 - 1.0 / used, slope / used[:, None] ** 2) if near_limit else (used, slope))
            continue
        near, relative = _differentiate_curve(grid, law, name, index)
        if near_limit:
            rows.append((2.0 - 1.0 / used, -near / used[:, None]))
            continue
        rows.append((used, used[:, None] * ((near - relative) if CURVES[name].floor else (relative - near))))
    if task.port is not None:
        index = choose_near(usage[PASSIVE])
        used, column = usage[PASSIVE].ravel()[index], index % grid.f.size
        (loop, by_loop), (top, by_top) = (
            _change_path(path.at(column), law, column) for path in (grid.port, grid.force)
        )
        slope = np.real(grid.unit[column] * (by_top * np.conj(loop) + top * np.conj(by_loop))) / np.abs(top * loop)
        rows.append((used, -slope.T / (1.0 - task.spec.reserve)))
    if FRICTION in usage:
        index = choose_near(usage[FRICTION])
        used, (row, column) = usage[FRICTION].ravel()[index], np.divmod(index, grid.f.size)
        distance, by_distance = _change_path(grid.friction.at((row, column)), law, column)
        parts, by_parts = _change_path(grid.friction_size.at((row, slice(None), column)), law, column)
        relative = np.real(np.sum(np.conj(parts) * by_parts, axis=-1)) / np.sum(np.abs(parts) ** 2, axis=-1)
        near = _differentiate_size(distance, by_distance) / np.abs(distance)[:, None]
        rows.append((used, used[:, None] * (relative.T - near)))
    return [*rows, _linearise_bandwidth(task, grid, law)]


def _change_path(
    path: Path, law: _Affine, column: Indices
) -> tuple[Complex[np.ndarray, "c ..."], Complex[np.ndarray, "g c ..."]]:
    """Return a path's sums at c points, of one row or one per signal, and their derivatives by the g gains."""
    at = [part[column] for part in (law.law.c_y, law.law.c_v, law.law.c_r)]
    by = [part[:, column] for part in (law.by_y, law.by_v, law.by_r)]
    if path.y.ndim > 1:
        at, by = ([part[..., None] for part in parts] for parts in (at, by))
    return path.add_up(*at), path.change(*by)


def _take_path(grid: Grid, name: str) -> Path:
    """Return the plants as a limit is asked of them: of the design plant with the force law alone."""
    return grid.plants.alone if name in SCOPES["design plant"] else grid.plants


def _differentiate_curve(grid: Grid, law: _Affine, name: str, index: Indices) -> tuple[PointSlopes, PointSlopes]:
    """Return the derivatives of ln abs(1 + L) and of ln abs(X) of a limit by the gains, at points of plants."""
    at, curve, (row, column) = law.law, CURVES[name], np.divmod(index, grid.f.size)
    path = _take_path(grid, name).at((row, column))
    distance, by_loop = _change_path(path, law, column)
    by_y, by_r, by_v = (by[:, column] for by in (law.by_y, law.by_r, law.by_v))
    near = _differentiate_size(distance, by_loop) / np.abs(distance)[:, None]
    if curve.of == "1":
        return near, 0.0 * near
    value = curve.numerator(path.y, at.c_y[column], at.c_r[column], distance - 1.0, at.c_v[column])
    change = curve.change(path.y, by_y, by_r, by_loop, by_v)
    return near, _differentiate_size(value, change) / np.maximum(np.abs(value), 1e-300)[:, None]


def choose_near(usage: Usage) -> Indices:
    """Return flat indices of the points of a limit that are given to the program."""
    index = choose_prominent(usage, ROWS_PER_LIMIT)
    return index[usage.ravel()[index] > NEAR]


def _differentiate_usage(grid: Grid, law: _Affine, name: str, index: Indices) -> PointSlopes:
    """Return the derivative of a limit's usage by the gains at points in discs, by central differences."""
    curve, (row, column) = CURVES[name], np.divmod(index, grid.f.size)
    path, discs = _take_path(grid, name).at((row, column)), grid.discs.at((row, column))
    level, now = grid.levels[name][column], [part[column] for part in (law.law.c_y, law.law.c_r, law.law.c_v)]
    slope = np.zeros((index.size, len(law.by_y)))
    for k in range(len(law.by_y)):
        by = [part[k, column] for part in (law.by_y, law.by_r, law.by_v)]
        moved = now[2] if np.any(by[2]) else now[0]
        size = np.max(np.abs(by), axis=0)
        step = STEP * np.maximum(np.abs(moved), 1e-9) / np.maximum(size, 1e-300)
        ends: list[Float[np.ndarray, " c"]] = []
        for sign in (1.0, -1.0):
            law_there = (c + sign * step * change for c, change in zip(now, by, strict=True))
            ends.append(use_disc(curve, level, path, discs, *law_there))
        slope[:, k] = (ends[0] - ends[1]) / (2.0 * step)
    return slope


def _linearise_bandwidth(task: Task, grid: Grid, law: _Affine) -> Rows:
    at = np.array([task.find_bandwidth(grid)])
    path = grid.plants.alone.at((0, at))
    distance, by_loop = _change_path(path, law, at)
    through = path.y * law.law.c_r[at]
    slope = _differentiate_size(through, path.y * law.by_r[:, at]) / np.abs(through)
    slope = slope - _differentiate_size(distance, by_loop) / np.abs(distance)
    miss = task.miss(grid, law.law)
    return np.array([1.0 + miss, 1.0 - miss]), np.concatenate([slope, -slope])


def _expand_objective(task: Task, grid: Grid, law: _Affine) -> tuple[Float[np.ndarray, "g g"], Values, ValueSlopes]:
    """Return curvature, values and slopes of the functions whose largest is the objective, over its present value."""
    at, count = law.law, len(law.by_y)
    if task.spec.objective == "noise":
        design = grid.plants.alone.at(0)
        noise = np.abs(at.c_y / design.add_up(at.c_y, at.c_v, at.c_r))
        index = choose_prominent(noise[None] / max(np.max(noise), NEXT_TO_NO_NOISE), ROWS_PER_LIMIT)
        (distance, by_loop), used = _change_path(design.at(index), law, index), noise[index]
        by_size = _differentiate_size(at.c_y[index], law.by_y[:, index])
        slope = by_size - used[:, None] * _differentiate_size(distance, by_loop)
        size = max(np.max(used), NEXT_TO_NO_NOISE)
        return np.zeros((count, count)), used / size, slope / np.abs(distance)[:, None] / size
    w = task.weights(grid.f)
    inside = w > 0.0
    plants = grid.plants.at((slice(None), inside))
    distance = plants.add_up(at.c_y[inside], at.c_v[inside], at.c_r[inside])
    rho = np.abs(distance)
    values = (1.0 / rho) @ w[inside]
    size, worst = np.max(values), int(np.argmax(values))
    unit = np.conj(distance) / rho
    along = np.real((unit * plants.y)[:, None] * law.by_y[None, :, inside])
    if task.speed_loop is not None:
        along += np.real((unit * plants.v)[:, None] * law.by_v[None, :, inside])
    if plants.r is not None:
        along += np.real((unit * plants.r)[:, None] * law.by_r[None, :, inside])
    slopes = -np.einsum("nkm,nm,m->nk", along, rho**-2, w[inside])
    curvature = 2.0 * np.einsum("km,lm,m,m->kl", along[worst], along[worst], rho[worst] ** -3, w[inside])
    return curvature / size, values / size, slopes / size


def _solve_step(task: Task, grid: Grid, x: LawNumbers, reach: PerGain) -> PerGain | None:
    """Return the change of the gains that the quadratic program takes; None if it has no answer."""
    law, gains, n = linearise_law(task, grid, x), task.gains_tuned, reach.size
    rows = _linearise_limits(task, grid, law)
    curvature, values, slopes = _expand_objective(task, grid, law)
    low, high = (ends[gains] for ends in task.bounds(x))
    linear, least, largest = task.linear_limits(x)
    # Variables: the gains' changes in units of `reach`, the objective, the slack.
    value, slope = (np.concatenate(part) for part in zip(*rows, strict=True))
    rows_of = [
        np.column_stack([slope * reach, np.zeros(value.size), -np.ones(value.size)]),
        np.column_stack([slopes * reach, -np.ones(values.size), np.zeros(values.size)]),
        np.column_stack([linear * reach, np.zeros((least.size, 2))]),
        np.column_stack([np.eye(n), np.zeros((n, 2))]),
        np.eye(n + 2)[-1:],
    ]
    matrix, now = np.concatenate(rows_of), linear @ x[gains]
    upper = np.concatenate([1.0 - value, -values, largest - now, np.minimum(1.0, (high - x[gains]) / reach), [np.inf]])
    lower = np.full(upper.size, -np.inf)
    lower[-(n + least.size + 1) :] = [*(least - now), *np.maximum(-1.0, (low - x[gains]) / reach), 0.0]
    size = np.maximum(1.0, np.max(np.abs(matrix), axis=1))
    quadratic = np.zeros((n + 2, n + 2))
    quadratic[:n, :n] = curvature * np.outer(reach, reach) + 1e-4 * np.eye(n)
    cost = np.append(np.zeros(n), [1.0, USAGE_PRICE])
    answer = solve_qp(quadratic, cost, matrix / size[:, None], lower / size, upper / size)
    return None if answer is None else answer[:n] * reach


def solve_qp(quadratic: MatrixNN, linear: Values, matrix: MatrixMN, lower: Curve, upper: Curve) -> Values | None:
    """Minimise x'Qx/2 + c'x with lower <= A x <= upper by OSQP; None where it refuses, or its status is no solution."""
    import osqp

    solver = osqp.OSQP(algebra="builtin")  # else it looks for others at every program
    try:
        solver.setup(
            P=_make_sparse(np.triu(quadratic)),
            q=linear,
            A=_make_sparse(matrix),
            l=lower,
            u=upper,
            verbose=False,
            eps_abs=1e-5,
            eps_rel=1e-5,
            max_iter=500,
            check_termination=10,
        )
    except osqp.OSQPException:  # ends that have crossed by a rounding, or numbers that are not finite
        return None
    result = solver.solve(raise_error=False)
    status: Any = osqp.SolverStatus
    usable = result.info.status_val in (status.OSQP_SOLVED, status.OSQP_SOLVED_INACCURATE, status.OSQP_MAX_ITER_REACHED)
    x = np.asarray(result.x, dtype=float)
    return x if usable and np.all(np.isfinite(x)) else None


def _make_sparse(matrix: MatrixMN) -> Any:
    """Return a small matrix as a sparse one, by columns, in a third of the time that SciPy takes for a dense one."""
    from scipy.sparse import csc_matrix

    columns, rows = np.nonzero(matrix.T)
    starts = np.searchsorted(columns, np.arange(matrix.shape[1] + 1))
    return csc_matrix((matrix[rows, columns], rows, starts), shape=matrix.shape)
