r"""Find starts for the tuner: a scan of laws that have the bandwidth exactly, and one that is always stable.

With the other numbers given, the design plant's bandwidth is a quadratic equation in k_p. Let :math:`a = P g` with
g the series part, and :math:`R = k_\mathrm{ff} + k_i I + k_d D`, :math:`Y = k_i I + k_d D + O` (terms of `LawTerms`;
D is absent from R with the derivative on the measurement). Then at :math:`f_b`

.. math::
    2\,|a|^2 |k_p + R|^2 = |1 + a Y + a k_p|^2 \iff
    |a|^2 k_p^2 + 2\,\mathrm{Re}(2|a|^2 R - a\,\overline{(1 + aY)})\,k_p + 2|a|^2|R|^2 - |1 + aY|^2 = 0 .

The scan solves it over a grid of the others and ranks both roots by the largest usage of a limit on a coarse set of
frequencies, then by the objective. Since the plants are stable, next to no feedback is a start that is always valid.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control.tuning.optimisation_problem import (
    HIGHEST_NOTCH,
    INTEGRAL_RAD_S,
    LOWEST_NOTCH,
    OBJECTIVE_HZ,
    SCOPES,
    Grid,
    LawNumbers,
    Task,
    find_light_modes,
)

DERIVATIVE_GAINS = 24  # values of k_d
COARSE_FREQUENCIES = 90
SCANNED_PLANTS = 4
PASSIVE_FREQUENCIES = 20  # of the passive band
LEAST_TURN = -0.3 * np.pi  # of 1 + L from the lowest frequency to the highest: less is an encirclement


def find_starts(task: Task, grid: Grid, count: int) -> list[LawNumbers]:
    """Return up to `count` distinct stable starts, best first; next to no feedback if the scan has none.

    Parameters
    ----------
    task : Task
        What is to be tuned.
    grid : Grid
        Frequencies that hold the bandwidth.
    count : int
        How many.

    """
    coarse = _thin_grid(task, grid)
    merits, laws = zip(*(_rank_shape(task, coarse, shape) for shape in _list_shapes(task)), strict=True)
    merit, points = np.concatenate(merits), np.concatenate(laws)
    distinct: list[LawNumbers] = []
    tried = 0
    for k in np.argsort(merit):
        if len(distinct) == count or tried == 40 * count or not np.isfinite(merit[k]):
            break
        x = task.tidy(points[k])
        if any(_are_alike(task, x, other) for other in distinct):
            continue
        tried += 1
        if task.is_stable(x):
            distinct.append(x)
    return distinct or [make_rest_start(task)]


def make_rest_start(task: Task) -> LawNumbers:
    """Return the law with next to no feedback, stable because the plants are."""
    ts = task.spec.sample_time_s
    return task.tidy(np.array([0.0, task.least_rate, 0.0, ts, 10.0, 0.3, 0.5, 1.0]))


def _are_alike(task: Task, x: LawNumbers, other: LawNumbers) -> bool:
    """Tell whether two starts lead to the same place: valleys differ by notch, observer or integral."""
    apart = np.abs(np.log((x + 1e-4) / (other + 1e-4)))
    if task.spec.notch is not None:
        apart = apart[5:]
    elif task.nominal is not None:
        apart = apart[[1, 4]]
    elif task.spec.structure == "pid":
        apart = apart[1]
    return bool(np.max(apart) < 0.4)


def _thin_grid(task: Task, grid: Grid) -> Grid:
    """Return some of the grid's frequencies, the bandwidth and the plants' light modes among them."""
    wanted = [
        task.spec.bandwidth_hz,
        *(f for plant in task.plants[:SCANNED_PLANTS] for f, _ in find_light_modes(plant)),
    ]
    wanted += (
        [*np.geomspace(*task.spec.passive_band_hz, PASSIVE_FREQUENCIES)]
        if task.spec.passive_band_hz is not None
        else []
    )
    near = [int(np.argmin(np.abs(grid.f - f))) for f in wanted]
    even = np.searchsorted(grid.f, np.geomspace(OBJECTIVE_HZ, grid.f[-1], COARSE_FREQUENCIES))
    index = np.unique(np.clip(np.concatenate([even, near]), 0, grid.f.size - 1))
    coarse = grid.at(index)
    return replace(coarse, p=coarse.p[:SCANNED_PLANTS], rows=coarse.rows[:SCANNED_PLANTS])


def _list_shapes(task: Task) -> Iterator[tuple[float, float, float, float, float]]:
    """Yield (T_f, T_q, notch_w, notch_width, notch_depth) to try."""
    low, high = task.bounds()
    spec, ts = task.spec, task.spec.sample_time_s
    unit = 1 / (2 * np.pi * spec.bandwidth_hz)
    filters = np.geomspace(0.15 * ts, min(0.7 * unit, high[3]), 5 if spec.notch is None else 3)
    # An output that swings at a few tenths of a hertz bears only a slow observer.
    lags = [0.5 * unit, 2.0 * unit, 8.0 * unit, 0.5, 3.0] if task.nominal is not None else [1.0]
    notches = _list_notches(task) if spec.notch is not None else [(low[5], low[6], low[7])]
    for t_f in filters:
        for t_q in lags:
            for notch in notches:
                yield (*np.clip((t_f, t_q, *notch), low[3:], high[3:]),)


def _list_notches(task: Task) -> list[tuple[float, float, float]]:
    """Return (notch_w, notch_width, notch_depth) to try: none, and some at light modes and above the bandwidth."""
    f_b, ts = task.spec.bandwidth_hz, task.spec.sample_time_s
    modes = [f for plant in task.plants[:SCANNED_PLANTS] for f, _ in find_light_modes(plant) if f > f_b]
    centres = np.minimum(np.unique(np.round([*modes, 1.5 * f_b, 3.0 * f_b], 1)), HIGHEST_NOTCH / ts)
    shapes = ((0.2, 0.1), (0.6, 0.1), (0.6, 0.4))
    w = np.tan(np.pi * centres * ts)
    least = float(np.tan(np.pi * min(LOWEST_NOTCH * f_b, HIGHEST_NOTCH / ts) * ts))
    return [
        (float(w[-1]), 0.5, 1.0),
        (least, 0.05, 0.05),
        *((float(one), width, depth) for one in w for width, depth in shapes),
    ]


def _rank_shape(
    task: Task, grid: Grid, shape: tuple[float, float, float, float, float]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 8"]]:
    """Return merits (less is better) and numbers of the laws of one shape."""
    spec, at = task.spec, int(np.argmin(np.abs(grid.f - task.spec.bandwidth_hz)))
    series, integral, rate, more = task.terms(grid, np.array([0.0, 0.0, 0.0, *shape]))
    series, more = (np.broadcast_to(term, grid.f.shape) for term in (series, more))
    k_d, k_i = (v.ravel() for v in np.meshgrid(*_list_gains(task, grid, at, abs(rate[at]))))
    on_reference = rate if spec.reference_weights != "measurement" else 0.0 * rate
    slope = k_i[:, None] * integral + task.k_ff + k_d[:, None] * on_reference
    back = k_i[:, None] * integral + k_d[:, None] * rate + more
    k_p = _solve_bandwidth(grid.p[0, at] * series[at], slope[:, at], back[:, at])
    keep = np.isfinite(k_p) & (k_p >= 0.0)
    which = np.flatnonzero(keep) % k_d.size
    k_p, k_d, k_i, slope, back = k_p[keep], k_d[which], k_i[which], slope[which], back[which]
    merit = _measure_merit(task, grid, series * (k_p[:, None] + back), series * (k_p[:, None] + slope))
    merit += np.maximum(0.0, np.log(np.maximum(task.least_rate * (1 + k_p), 1e-12) / np.maximum(k_i, 1e-12)))
    points = np.column_stack([k_p, k_i, k_d, np.tile(shape, (k_p.size, 1))])
    return merit, points


def _list_gains(
    task: Task, grid: Grid, at: int, rate: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"]]:
    """Return values of k_d and k_i, in units of the inverse of the plant at the bandwidth."""
    inverse = 1.0 / max(abs(grid.p[0, at]), 1e-6)
    k_d = np.concatenate([[0.0], np.geomspace(0.02, 20.0, DERIVATIVE_GAINS)]) * inverse / rate
    if task.spec.structure == "pd":
        return k_d, np.zeros(1)
    slowest = 1.3 * INTEGRAL_RAD_S * (1 + np.array([0.1, 1.0]) * inverse)
    k_i = np.append(slowest, max(0.05 * 2 * np.pi * task.spec.bandwidth_hz * inverse, 2.0 * slowest[1]))
    return k_d, k_i if task.nominal is None else np.array([0.0, k_i[2]])


def _solve_bandwidth(
    a: complex, slope: Complex[np.ndarray, " n"], back: Complex[np.ndarray, " n"]
) -> Float[np.ndarray, " two_n"]:
    """Return both roots k_p of the bandwidth equation, not a number where there is none."""
    size, one = abs(a) ** 2, 1.0 + a * back
    half = np.real(2.0 * size * slope - a * np.conj(one))
    rest = 2.0 * size * np.abs(slope) ** 2 - np.abs(one) ** 2
    with np.errstate(invalid="ignore"):
        root = np.sqrt(half**2 - size * rest)
    return np.concatenate([(-half + root) / size, (-half - root) / size])


def _measure_merit(
    task: Task, grid: Grid, c_y: Complex[np.ndarray, "n m"], c_r: Complex[np.ndarray, "n m"]
) -> np.ndarray:
    """Return the objective where the limits are kept, and what is worse than any objective where they are not."""
    weights, worst = task.weights(grid.f), np.zeros(c_y.shape[0])
    value, turned = np.zeros(c_y.shape[0]), np.zeros(c_y.shape[0])
    for row, p in enumerate(grid.p):
        usage = task.curves(SCOPES["every plant"], grid.f, p, c_y, c_r)
        usage |= task.design_usage(grid, row, c_y, c_r)
        for curve in usage.values():
            worst = np.maximum(worst, np.max(curve, axis=1))
        distance = 1.0 + p * c_y
        turn = np.unwrap(np.angle(distance), axis=1)
        turned = np.minimum(turned, turn[:, -1] - turn[:, 0])
        if task.spec.objective == "disturbance":
            value = np.maximum(value, (1.0 / np.abs(distance)) @ weights)
        elif row < task.design_states:
            value = np.maximum(value, np.max(np.abs(c_y / distance), axis=1))
    broken = np.log(np.maximum(worst, 1.0))
    size = np.min(value) if value.size else 1.0
    return np.log(value / size) + 20.0 * broken + np.where(turned < LEAST_TURN, 50.0, 0.0)
