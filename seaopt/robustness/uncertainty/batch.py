r"""Closed-loop eigenvalues and peaks of S and T of many plants at once, for Monte Carlo and the worst-case searches.

With the eigenvalues :math:`o_i` of the open loop (plant, delay, controller) and :math:`c_i` of the closed one,

.. math:: S(z) = \frac{1}{1 + d\, d_c} \prod_i \frac{z - o_i}{z - c_i}, \qquad T = 1 - S,

so that no linear system is solved at any frequency and the derivatives along the circle are sums of simple fractions.
Every draw has its own grid, with points about the poles of its loop. About a peak :math:`1/|S|^2` is close to a
parabola in the angle: Newton's method on its derivative, kept between the neighbouring grid points, ends at rounding.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from seaopt.control import Controller
from seaopt.control.loops.loop import STABLE
from seaopt.control.loops.response import LARGEST_ENTRY
from seaopt.control.loops.sampled_plant import LinearPlants, conditions, find_delay, hold, linearise, read_conditions
from seaopt.control.running.fed_back import close_terms
from seaopt.control.systems.block import COMMAND, connect, make_plant
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.progress import Progress, ignore
from seaopt.records import record
from seaopt.robustness.uncertainty.draws import Column
from seaopt.robustness.uncertainty.rows import join_rows, take_rows

DRAW_BLOCK = 8192  # draws linearised at once: bounds the memory
CURVE_BLOCK = 512  # draws whose curves are evaluated at once: bounds the cache
BASE_ANGLES = np.concatenate([[0.0], np.pi * np.geomspace(1e-5, 1.0, 60)])
FAN = np.array([-3.0, -1.0, -0.4, 0.0, 0.4, 1.0, 3.0])  # about a pole, in distances of it from the circle
MAXIMA = 3  # local maxima refined
SAME_ANGLE = 1e-14
SPEED_NEWTON_STEPS = 40

NO_PEAKS = ((np.nan, np.nan), (np.nan, np.nan))
Curves = Complex[np.ndarray, "n m"]  # a row per draw

Peaks = tuple[Column, Column]
Levels = Float[np.ndarray, "*n 2"]  # of Ms and Mt


@record(eq=False)
class BatchFigures:
    """Spectral radius, Ms and Mt of every draw (infinite where unstable), arrays of shape (n,).

    A draw so far off that the sampled plant is not finite is unstable, with an infinite spectral radius.
    """

    spectral_radius: Column
    ms: Column
    mt: Column


def batch_figures(
    controller: Controller,
    plant: Plant,
    nominal: ParameterSet,
    draws: Mapping[str, Column],
    progress: Progress = ignore,
    threads: int = 2,
    peaks: bool = True,
    by: Levels | None = None,
) -> BatchFigures:
    """Close `controller`, with what its terms feed back, around `plant` at every draw.

    Parameters
    ----------
    controller : Controller
        The law.
    plant, nominal
        The plant, and the values of what is not drawn.
    draws : mapping of name to array, shape (n,)
        Parameters of the plant and conditions (`seaopt.control.loops.sampled_plant`); other names are ignored.
    progress : callable, optional
        Called after each block of draws.
    threads : int
        Blocks of draws computed at once.
    peaks : bool
        Whether to compute Ms and Mt; if not, they are NaN where stable.
    by : array, shape (n, 2), optional
        Levels of Ms and Mt that draws are ranked by: a peak whose level is infinite is only that of its grid.
    """
    controller = close_terms(controller, plant)
    values, extra = expand_draws(plant, controller.delay(nominal), draws)
    count = values.shape[1]
    columns = np.vstack([values, *extra.values()])
    if count > 1 and np.array_equal(columns, np.repeat(columns[:, :1], count, axis=1)):
        # Nothing that is drawn concerns this plant: all draws are one loop.
        first = {name: column[:1] for name, column in draws.items()}
        single = batch_figures(controller, plant, nominal, first, ignore, threads, peaks)  # of both curves
        progress(f"{count} of {count} draws", 1.0)
        return take_rows(single, np.zeros(count, dtype=int))
    parts: list[BatchFigures] = []
    ranked = np.ones((count, 2)) if by is None else by
    with ThreadPoolExecutor(threads) as pool:
        for start in range(0, count, DRAW_BLOCK):
            block = slice(start, min(start + DRAW_BLOCK, count))
            at = {name: column[block] for name, column in extra.items()}
            delays = np.zeros(block.stop - block.start) + find_delay(plant, at)
            continuous = linearise(plant, values[:, block], at, controller.signals, controller.command.per_effort)
            pieces = [slice(k, k + CURVE_BLOCK) for k in range(0, delays.size, CURVE_BLOCK)]
            run = pool.map if len(pieces) > 1 else map  # a thread costs more than few draws take
            parts += run(
                lambda piece, matrices=continuous, delay=delays, ranked=ranked[block]: _close_piece(
                    controller, tuple(matrix[piece] for matrix in matrices), delay[piece], peaks, ranked[piece]
                ),
                pieces,
            )
            progress(f"{block.stop} of {count} draws", block.stop / count)
    return join_rows(parts)


def expand_draws(
    plant: Plant, nominal: ParameterSet, draws: Mapping[str, Column]
) -> tuple[Float[np.ndarray, "np n"], dict[str, Column]]:
    """Return a plant's parameters, one column per draw, and its conditions."""
    count = len(next(iter(draws.values()))) if draws else 1
    values = np.repeat(plant.complete(nominal).vector[:, None], count, axis=1)
    for row, name in enumerate(plant.parameters):
        if name in draws:
            values[row] = draws[name]
    at_rest = read_conditions(plant, nominal)
    extra = {
        name: draws[name] if name in draws else np.full(count, at_rest[name])
        for name in conditions((plant,))
        if name in draws or name in at_rest
    }
    return values, extra


@record(eq=False)
class Products:
    """S of every draw as a product over poles of the open and the closed loop."""

    opened: Complex[np.ndarray, "n k"]
    closed: Complex[np.ndarray, "n k"]
    scale: Column

    def sensitivity(self, z: Curves) -> Curves:
        """Return S of each row at that row's points."""
        above, below = (_multiply_factors(z, poles) for poles in (self.opened, self.closed))
        above /= below
        return above * self.scale[:, None]

    def logarithmic(self, z: Curves) -> tuple[Curves, Curves]:
        """Return S'/S and its derivative."""
        first, second = np.zeros_like(z), np.zeros_like(z)
        for k in range(self.opened.shape[1]):
            above, below = 1.0 / (z - self.opened[:, k, None]), 1.0 / (z - self.closed[:, k, None])
            first += above - below
            second += below**2 - above**2
        return first, second


def _multiply_factors(z: Curves, poles: Complex[np.ndarray, "n k"]) -> Curves:
    """Return the product of z - p over each row's poles p; one array takes all factors, for memory is slow."""
    out = z - poles[:, :1]
    factor = np.empty_like(out)
    for k in range(1, poles.shape[1]):
        out *= np.subtract(z, poles[:, k, None], out=factor)
    return out


def _close_piece(
    controller: Controller, continuous: LinearPlants, delay: Float[np.ndarray, " k"], peaks: bool, by: Levels
) -> BatchFigures:
    """Return the figures of some draws."""
    a, b, c, d = hold(*continuous, controller.sample_time_s, delay)
    count = len(d)
    whole = np.concatenate([matrix.reshape(count, -1) for matrix in (a, b, c, d)], axis=1)
    finite = np.max(np.abs(whole), axis=1) < LARGEST_ENTRY  # not so of nan
    a, b, c, d = (np.where(finite.reshape(-1, *(1,) * (m.ndim - 1)), m, 0.0) for m in (a, b, c, d))
    loops = compute_products(controller, a, b, c, d)
    radius = np.where(finite, np.max(np.abs(loops.closed), axis=1), np.inf)
    ms, mt = np.full(radius.size, np.inf), np.full(radius.size, np.inf)
    stable = np.flatnonzero(radius < STABLE)
    if stable.size:
        (ms[stable], _), (mt[stable], _) = find_peaks(take_rows(loops, stable), by[stable]) if peaks else NO_PEAKS
    return BatchFigures(spectral_radius=radius, ms=ms, mt=mt)


def compute_products(
    controller: Controller,
    a: Float[np.ndarray, "n x x"],
    b: Float[np.ndarray, "n x"],
    c: Float[np.ndarray, "n y x"],
    d: Float[np.ndarray, "n y"],
) -> Products:
    """Return S of every plant behind its hold, from the eigenvalues of the open and of the closed loop."""
    law, k = controller.law, controller.compute_delay_samples
    loops = connect([make_plant(a, b, c, d, k), law.block], [COMMAND], [COMMAND])  # what adds to it comes back as S
    fixed = np.broadcast_to(np.concatenate([law.poles, np.zeros(k)]), (len(a), law.c.size + k))
    return Products(
        opened=np.concatenate([np.linalg.eigvals(a), fixed], axis=1).astype(complex),
        closed=np.linalg.eigvals(loops.a).astype(complex),
        scale=loops.d[:, 0, 0],
    )


def find_peaks(loop: Products, by: Levels) -> tuple[Peaks, Peaks]:
    """Return the largest abs(S) and abs(T) of every row, each with its angle: the highest local maxima of its grid, by
    Newton's method, of both curves and all rows in one batch. Where a curve's level is infinite, its grid has to do.
    """
    angle, distance = np.abs(np.angle(loop.closed)), np.abs(1.0 - np.abs(loop.closed))
    upper = np.imag(loop.closed)[:, :, None] >= 0.0  # of a pair; a point that is doubled looks like a maximum
    near_poles = np.where(upper, angle[:, :, None] + distance[:, :, None] * FAN, 0.0).reshape(angle.shape[0], -1)
    base = np.broadcast_to(BASE_ANGLES, (angle.shape[0], BASE_ANGLES.size))
    theta = np.sort(np.clip(np.concatenate([base, near_poles], axis=1), 0.0, np.pi), axis=1)
    theta = theta[:, np.argmax(np.any(theta > 0.0, axis=0)) - 1 :]  # each row begins with one 0, or with some
    z = np.exp(1j * theta)
    s = loop.sensitivity(z)
    values = np.concatenate([np.abs(s), np.abs(1.0 - s)])
    even = np.imag(z) < SAME_ANGLE  # a curve at 0 and at half the rate: the grid has the value
    counts = np.isfinite(by.T.reshape(-1, 1)) & ~np.concatenate([even, even])
    rows, points = _list_maxima(values, counts)
    at, count = rows % len(theta), len(theta)
    low, high = _find_neighbours(theta[at], points)
    refined, angles = _refine_peaks(take_rows(loop, at), low, theta[at, points], high, rows >= count)
    every = np.arange(len(values))
    first = np.argmax(values, axis=1)
    top, where = values[every, first], theta[every % count, first]
    rising = np.argsort(refined)
    rising = rising[refined[rising] > top[rows[rising]]]  # the last of a row is its highest
    top[rows[rising]], where[rows[rising]] = refined[rising], angles[rising]
    return (top[:count], where[:count]), (top[count:], where[count:])


def _list_maxima(
    values: Float[np.ndarray, "n m"], counts: Bool[np.ndarray, "n m"]
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Return rows and columns of the highest local maxima, up to `MAXIMA` of a row, that count and come near
    the largest.
    """
    every, top, inner = np.arange(len(values)), np.max(values, axis=1), values[:, 1:-1]
    local = np.where(counts[:, 1:-1] & (inner >= values[:, :-2]) & (inner >= values[:, 2:]), inner, -np.inf)
    rows, points = list[Int[np.ndarray, " k"]](), list[Int[np.ndarray, " k"]]()
    for _ in range(MAXIMA):
        at = np.argmax(local, axis=1)
        worth = np.flatnonzero(local[every, at] > 0.5 * top)
        rows.append(worth)
        points.append(at[worth] + 1)
        # Neighbours on a plateau, or at doubled points, are the same maximum.
        for near in (at - 1, at, at + 1):
            local[every, np.clip(near, 0, local.shape[1] - 1)] = -np.inf
    return np.concatenate(rows), np.concatenate(points)


def _find_neighbours(theta: Float[np.ndarray, "n m"], point: Int[np.ndarray, " n"]) -> tuple[Column, Column]:
    """Return the neighbours of a grid point that do not coincide with it."""
    rows, last = np.arange(point.size), theta.shape[1] - 1
    centre = theta[rows, point]
    below, above = np.maximum(point - 1, 0), np.minimum(point + 1, last)
    while (same := (theta[rows, below] >= centre - SAME_ANGLE) & (below > 0)).any():
        below = below - same
    while (same := (theta[rows, above] <= centre + SAME_ANGLE) & (above < last)).any():
        above = above + same
    return theta[rows, below], theta[rows, above]


def _refine_peaks(loop: Products, low: Column, x: Column, high: Column, complement: Bool[np.ndarray, " n"]) -> Peaks:
    """Return the value of each row's curve, T or S, at its maximum between `low` and `high`, and the angle."""
    best, where = np.zeros(x.size), x.copy()
    live = np.arange(x.size)
    low, x, high = low.copy(), x.copy(), high.copy()
    small = 1e-6 * (high - low)
    for _ in range(SPEED_NEWTON_STEPS):
        value, g, slope = _differentiate(take_rows(loop, live), x[live], complement[live])
        higher = value > best[live]
        best[live[higher]], where[live[higher]] = value[higher], x[live[higher]]
        low[live] = np.where(g > 0.0, x[live], low[live])
        high[live] = np.where(g > 0.0, high[live], x[live])
        with np.errstate(divide="ignore", invalid="ignore"):
            step = g / (g**2 - slope)  # Newton on the derivative of 1/abs(curve)^2
        new = x[live] + step
        inside = (new > low[live]) & (new < high[live])
        new = np.where(inside, new, 0.5 * (low[live] + high[live]))
        moving = np.abs(new - x[live]) > small[live]
        x[live] = new
        live = live[moving]
        if not live.size:
            break
    return best, where


@np.errstate(divide="ignore", invalid="ignore")  # on a pole of the open loop, an integrator at angle 0
def _differentiate(loop: Products, x: Column, complement: Bool[np.ndarray, " n"]) -> tuple[Column, Column, Column]:
    """Return abs(curve) and the first two derivatives of log abs(curve)^2 along the angle."""
    z = np.exp(1j * x)[:, None]
    s, (first, second) = loop.sensitivity(z), loop.logarithmic(z)
    curvature, of_t = second + first**2, complement[:, None]
    value = np.where(of_t, 1.0 - s, s)
    share = np.where(of_t, -s / value, 1.0)
    first, curvature = share * first, share * curvature
    rise = 2.0 * np.real(1j * z * first)[:, 0]
    bend = -2.0 * np.real(z * first + z**2 * (curvature - first**2))[:, 0]
    return np.abs(value)[:, 0], np.where(np.isfinite(rise), rise, 1.0), bend
