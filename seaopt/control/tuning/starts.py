r"""Find starts for the tuner: a scan of laws that have the bandwidth exactly, and one that is always stable.

With the other numbers given, the design plant's bandwidth is a quadratic equation in one of them. Let :math:`a = P g`
with g the series part, F the prefilter, B what further signals make of 1, :math:`Y = k_i I + k_d D + O` and
:math:`R = h/(g P(0)) + k_i I + (k_d - w_c) D` (terms of `LawTerms`). Where the reference's
weight k_r is fixed, that number is k_p: at :math:`f_b`

.. math::
    2\,|aF|^2 |k_p + R|^2 &= |B + a Y + a k_p|^2 \iff \\
    |a|^2 (2|F|^2 - 1) k_p^2 + 2\,\mathrm{Re}(2|aF|^2 R - a\,\overline{(B + aY)})\,k_p
    + 2|aF|^2|R|^2 - |B + aY|^2 &= 0 .

Where it is free, that number is w_r, which leaves the loop as it is:

.. math::
    |k_p + R - w_r| = \rho = \frac{|B + a (k_p + Y)|}{\sqrt2\,|aF|} \iff
    w_r = k_p + \mathrm{Re}\,R \pm \sqrt{\rho^2 - (\mathrm{Im}\,R)^2} .

The scan solves these over a grid of the others and ranks both roots by the largest usage of a limit on a coarse set of
frequencies, then by the objective. With k_r free the loops alone are ranked first, by the limits that the reference's
path does not enter, and only some are given weights. Since the plants are stable, next to no feedback is a start that
is always valid. A speed loop's gain and time are scanned as filters are.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from seaopt.control.laws.limits import INTEGRAL_RAD_S
from seaopt.control.laws.spec import HIGHEST_CORNER
from seaopt.control.laws.structures import CASCADE, LawTerms
from seaopt.control.tuning.frequencies import count_growing, find_light_modes
from seaopt.control.tuning.grid import Grid, LawResponse, Response, Responses, Values, use_friction
from seaopt.control.tuning.law_numbers import (
    K_D,
    K_I,
    K_P,
    K_V,
    NOTCH_W,
    PREFILTER_W,
    SPEED_RATE,
    T_F,
    T_Q,
    W_C,
    W_R,
    LawNumbers,
    warp_frequency,
)
from seaopt.control.tuning.optimisation_problem import (
    LOWEST_NOTCH,
    NEXT_TO_NO_NOISE,
    OBJECTIVE_HZ,
    SCOPES,
    TRACKING,
    Task,
)
from seaopt.records import record

GainRows = Float[np.ndarray, "n 5"]

DERIVATIVE_GAINS = 24  # values of k_d where k_p follows from it
LOOP_GAINS = 12  # values of k_p and of k_d where the reference's weight follows from them
LOOPS_WEIGHTED = 200  # of each shape
INTEGRAL_RATES = 4  # values of k_i/(1 + k_p) then
HOPELESS_MERIT = 10.0  # loops whose merit is worse than the best one's by this are given no weights
WEIGHTS = (0.0, 0.5, 1.0)  # of w_c/k_d
COARSE_FREQUENCIES = 90
MOST_SHAPES = 48  # with one optional part at most, and a third as many with several
SCANNED_PLANTS = 4
PASSIVE_FREQUENCIES = 20  # of the passive band
SPEED_GAINS = (0.3, 1.0, 3.0)  # of k_v, over the speed per command at the bandwidth
SPEED_RATES = (0.0, 0.15, 0.6)  # of 1/T_v, over the bandwidth's rad/s
PREFILTERS = (0.7, 1.2, 2.0)  # corners over the bandwidth; and the highest, which is next to none
PREFILTER_START = 0.8  # damping
# k_v, T_f, T_q, 1/T_v, notch_w, notch_width, notch_depth, prefilter_w, prefilter_damping
Shape = tuple[float, ...]
LEAST_LEAD = 1e-9  # of the bandwidth equation's leading coefficient
LEAST_TURN = -0.3 * np.pi  # of 1 + L from the lowest frequency to the highest: less is an encirclement


def find_starts(task: Task, grid: Grid, count: int) -> list[LawNumbers]:
    """Return up to `count` distinct stable starts, best first; next to no feedback if the scan has none."""
    coarse = thin_grid(task, grid)
    shapes = list(_list_shapes(task, coarse))
    merits, scanned = zip(*(_rank_shape(task, coarse, shape) for shape in shapes), strict=True)
    merit, gains = np.concatenate(merits), np.concatenate(scanned)
    shape_of = np.repeat(np.arange(len(shapes)), [part.size for part in merits])
    distinct: list[LawNumbers] = []
    tried = 0
    for k in np.argsort(merit):
        if len(distinct) == count or tried == 40 * count or not np.isfinite(merit[k]):
            break
        x = task.tidy(np.array([*gains[k], *shapes[shape_of[k]]]))
        if any(_are_alike(task, x, other) for other in distinct):
            continue
        tried += 1
        if task.is_stable(x):
            distinct.append(x)
    return distinct or [make_rest_start(task)]


def make_rest_start(task: Task) -> LawNumbers:
    """Return the law with next to no feedback, stable because the plants are."""
    ts = task.spec.sample_time_s
    return task.tidy(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, ts, 10.0, 0.0, 0.3, 0.5, 1.0, 1.0, 1.0]))


def _are_alike(task: Task, x: LawNumbers, other: LawNumbers) -> bool:
    """Tell whether two starts lead to the same place: valleys differ by notch, observer or integral."""
    apart = np.abs(np.log((x + 1e-4) / (other + 1e-4)))
    if task.spec.notch is not None:
        apart = apart[NOTCH_W:PREFILTER_W]
    elif task.nominal is not None:
        apart = apart[[K_I, T_Q]]
    elif task.speed_loop is not None:
        apart = apart[[K_I, SPEED_RATE, PREFILTER_W]] * [0.25, 1.0, 1.0]
    elif task.spec.reference_filter is not None:
        apart = apart[[K_I, PREFILTER_W]]
    elif task.spec.structure == "pid":
        apart = apart[K_I]
    return bool(np.max(apart) < 0.4)


def thin_grid(task: Task, grid: Grid, plants: Sequence[int] = range(SCANNED_PLANTS)) -> Grid:
    """Return some of the grid's frequencies, the bandwidth and light modes among them, and some of its plants."""
    some = [k for k in plants if k < len(grid.rows)]
    wanted = [task.spec.bandwidth_hz]
    wanted += [f for k in some for f, _ in find_light_modes(task.plants[grid.rows[k]])]
    if task.spec.passive_band_hz is not None:
        wanted += [*np.geomspace(*task.spec.passive_band_hz, PASSIVE_FREQUENCIES)]
    near = [int(np.argmin(np.abs(grid.f - f))) for f in wanted]
    even = np.searchsorted(grid.f, np.geomspace(OBJECTIVE_HZ, grid.f[-1], COARSE_FREQUENCIES))
    index = np.unique(np.clip(np.concatenate([even, near]), 0, grid.f.size - 1))
    coarse = grid.at(index)
    return replace(
        coarse, plants=coarse.plants.at(some), discs=coarse.discs.at(some), rows=tuple(coarse.rows[k] for k in some)
    )


def _list_shapes(task: Task, grid: Grid) -> Iterator[Shape]:
    """Yield shapes to try."""
    low, high = task.bounds(make_rest_start(task))
    spec, ts = task.spec, task.spec.sample_time_s
    unit = 1 / (2 * np.pi * spec.bandwidth_hz)
    filters = np.geomspace(max(0.15 * ts, low[T_F]), min(0.7 * unit, high[T_F]), 5 if spec.notch is None else 3)
    filters = filters if task.speed_loop is None else filters[:3:2]
    # An output that swings at a few tenths of a hertz bears only a slow observer.
    lags = [0.5 * unit, 2.0 * unit, 8.0 * unit, 0.5, 3.0] if task.nominal is not None else [1.0]
    notches = _list_notches(task) if spec.notch is not None else [tuple(low[NOTCH_W:PREFILTER_W])]
    parts = [_list_speed_loops(task, grid), notches, _list_prefilters(task)[::-1]]  # the first of each is none
    every = list(itertools.product(filters, lags, *map(enumerate, parts)))
    every.sort(key=lambda shape: sum(number > 0 for number, _ in shape[2:]) > 1)  # one part at a time comes first
    alone = sum(sum(number > 0 for number, _ in shape[2:]) <= 1 for shape in every)
    for t_f, t_q, (_, (k_v, speed_rate)), (_, notch), (_, prefilter) in (
        *_thin_out(every[:alone], MOST_SHAPES),
        *_thin_out(every[alone:], MOST_SHAPES // 3),
    ):
        shape = np.clip((k_v, t_f, t_q, 0.0, *notch, *prefilter), low[K_V:], high[K_V:])
        shape[SPEED_RATE - K_V] = speed_rate
        yield (*shape,)


def _thin_out(shapes: list[Any], most: int) -> list[Any]:
    """Return as many of a list at even distances, or all."""
    return shapes if len(shapes) <= most else [shapes[k] for k in np.linspace(0, len(shapes) - 1, most).astype(int)]


def _list_speed_loops(task: Task, grid: Grid) -> list[tuple[float, float]]:
    """Return (k_v, 1/T_v) to try: none, and of a cascade some of each."""
    if task.speed_loop is None:
        return [(0.0, 0.0)]
    gains = np.array(SPEED_GAINS) / max(task.speed_gain(grid), 1e-12)
    shares = SPEED_RATES if task.spec.speed_loop == "PI" else SPEED_RATES[:1]
    rates = [share * 2 * np.pi * task.spec.bandwidth_hz for share in shares]
    return [(0.0, 0.0), *itertools.product(map(float, gains), rates)]


def _list_prefilters(task: Task) -> list[tuple[float, float]]:
    """Return (prefilter_w, prefilter_damping) to try."""
    if task.spec.reference_filter is None or task.spec.reference_filter.corner_hz is not None:
        return [(1.0, 1.0)]
    highest = HIGHEST_CORNER * task.spec.sample_rate_hz
    corners = np.minimum([*(task.spec.bandwidth_hz * np.array(PREFILTERS)), highest], highest)
    return [(warp_frequency(corner, task.spec.sample_time_s), PREFILTER_START) for corner in corners]


def _list_notches(task: Task) -> list[tuple[float, float, float]]:
    """Return (notch_w, notch_width, notch_depth) to try: none, and some at light modes and above the bandwidth."""
    f_b, ts = task.spec.bandwidth_hz, task.spec.sample_time_s
    modes = [f for plant in task.plants[:SCANNED_PLANTS] for f, _ in find_light_modes(plant) if f > f_b]
    centres = np.minimum(np.unique(np.round([*modes, 1.5 * f_b, 3.0 * f_b], 1)), HIGHEST_CORNER / ts)
    shapes = ((0.2, 0.1), (0.6, 0.1), (0.6, 0.4))
    w = [warp_frequency(centre, ts) for centre in centres]
    least = warp_frequency(min(LOWEST_NOTCH * f_b, HIGHEST_CORNER / ts), ts)
    return [(w[-1], 0.5, 1.0), (least, 0.05, 0.05), *((at, *shape) for at in w for shape in shapes)]


@record(eq=False)
class _Scan:
    """The laws of one shape, with their terms on the scan's frequencies, of which number `at` is the bandwidth."""

    task: Task
    grid: Grid
    shape: Shape
    terms: LawTerms
    c_v: Response
    at: int

    def respond(self, c_y: Responses, c_r: Responses) -> LawResponse:
        """Return laws of this shape."""
        return LawResponse(c_y=c_y, c_r=c_r, c_v=self.c_v)

    @property
    def plant(self) -> complex:
        """The design plant at the bandwidth."""
        return complex(self.grid.plants.y[0, self.at])

    @property
    def through(self) -> complex:
        """The design plant times the series part, at the bandwidth."""
        return self.plant * complex(self.terms.series[self.at])

    @property
    def constant(self) -> complex:
        """B of the design plant at the bandwidth."""
        return complex(self.grid.plants.alone.at(0).add_constant(self.c_v, 0.0 * self.c_v)[self.at])

    @property
    def inverse(self) -> float:
        """The inverse of the plant at the bandwidth, in which gains are counted."""
        return 1.0 / max(abs(self.plant), 1e-6)

    @property
    def derivatives(self) -> float:
        """The k_d that makes as much of an error at the bandwidth as a k_p of `inverse`."""
        return self.inverse / float(abs(self.terms.rate[self.at]))

    @property
    def gained(self) -> Complex[np.ndarray, "3 m"]:
        """What k_p, k_i and k_d are multiplied with."""
        return np.array([np.ones_like(self.grid.q), self.terms.integral, self.terms.rate])

    def measurement(self, gains: GainRows) -> Responses:
        """Return C_y of laws, without the series part."""
        return gains[:, :W_R] @ self.gained + self.terms.observer

    def reference(self, gains: GainRows) -> Responses:
        """Return C_r of laws, without the series part and the prefilter."""
        ahead = self.task.k_ff * self.terms.ahead / self.terms.series
        behind = gains[:, :W_R].copy()
        behind[:, [K_P, K_D]] -= gains[:, [W_R, W_C]]
        return behind @ self.gained + ahead

    def behind_prefilter(self, gains: GainRows) -> Responses:
        """Return C_r of laws."""
        return self.terms.series * self.terms.prefilter * self.reference(gains)


def _rank_shape(task: Task, grid: Grid, shape: Shape) -> tuple[Values, GainRows]:
    """Return merits (less is better) and gains of the laws of one shape."""
    x = np.array([0.0, 0.0, 0.0, 0.0, 0.0, *shape])
    terms = LawTerms(*(np.broadcast_to(term, grid.f.shape) for term in task.terms(grid, x)))
    c_v = x[K_V] * terms.series * task.sense(grid.q)
    scan = _Scan(task=task, grid=grid, shape=shape, terms=terms, c_v=c_v, at=task.find_bandwidth(grid))
    parts = [_scan_fixed_weight(scan)]
    if task.spec.structure != "pd" and task.spec.reference_weights != "error":
        parts.append(_scan_free_weight(scan))
    merit, gains = (np.concatenate(part) for part in zip(*parts, strict=True))
    return merit, gains


def _scan_fixed_weight(scan: _Scan) -> tuple[Values, GainRows]:
    """Return merits and gains of laws with w_r = 0: k_p makes the bandwidth."""
    k_d = np.concatenate([[0.0], np.geomspace(0.02, 20.0, DERIVATIVE_GAINS)]) * scan.derivatives
    grids = np.meshgrid(k_d, _list_integrals(scan), _list_weights(scan.task), indexing="ij")
    k_d, k_i, weight = (values.ravel() for values in grids)
    gains = np.column_stack([0.0 * k_d, k_i, k_d, 0.0 * k_d, weight * k_d])[(k_d > 0.0) | (weight == weight[0])]
    back = scan.constant + scan.through * scan.measurement(gains)[:, scan.at]
    ahead = scan.through * complex(scan.terms.prefilter[scan.at])
    k_p = solve_bandwidth(scan.through, ahead, ahead * scan.reference(gains)[:, scan.at], back)
    gains = np.tile(gains, (2, 1))
    gains[:, K_P] = k_p
    gains = gains[np.isfinite(k_p) & (k_p >= 0.0)]
    c_y, c_r = scan.terms.series * scan.measurement(gains), scan.behind_prefilter(gains)
    return _judge_loops(scan, c_y, c_r) + _judge_tracking(scan, c_y, c_r) + _price_missing_integral(scan, gains), gains


def _scan_free_weight(scan: _Scan) -> tuple[Values, GainRows]:
    """Return merits and gains of laws of which w_r makes the bandwidth, of the loops that promise most."""
    k_p = np.geomspace(0.03, 10.0, LOOP_GAINS) * max(scan.inverse, 1.0)
    k_d = np.concatenate([[0.0], np.geomspace(0.03, 10.0, LOOP_GAINS)]) * scan.derivatives
    rates = np.geomspace(1.3 * INTEGRAL_RAD_S, 2 * np.pi * scan.task.spec.bandwidth_hz, INTEGRAL_RATES)
    k_p, k_d, rate = (values.ravel() for values in np.meshgrid(k_p, k_d, rates, indexing="ij"))
    gains = np.column_stack([k_p, rate * (1.0 + k_p), k_d, 0.0 * k_p, 0.0 * k_p])
    c_y = scan.terms.series * scan.measurement(gains)
    around = scan.grid.plants.r is not None  # then the reference's weights are in the loop, too
    merit = _judge_loops(scan, c_y, scan.behind_prefilter(gains) if around else c_y)
    weights = np.repeat(_list_weights(scan.task), 2)  # for both roots
    chosen = np.repeat(_choose_loops(merit), weights.size)
    gains, c_y, merit = gains[chosen], c_y[chosen], merit[chosen]
    gains[:, W_C] = np.resize(weights, chosen.size) * gains[:, K_D]
    whole = scan.reference(gains)[:, scan.at]
    distance = scan.constant + scan.plant * c_y[:, scan.at]
    size = np.abs(distance) / (np.sqrt(2.0) * abs(scan.through * scan.terms.prefilter[scan.at]))
    with np.errstate(invalid="ignore"):
        gains[:, W_R] = np.real(whole) + np.resize([-1.0, 1.0], chosen.size) * np.sqrt(size**2 - np.imag(whole) ** 2)
    most = scan.task.k_ff + gains[:, K_P]
    if scan.task.settles and not scan.shape[SPEED_RATE - K_V]:
        most = np.minimum(most, scan.task.most_left_to_integral(gains[:, K_P], gains[:, K_I]))
    keep = (gains[:, W_R] >= 0.0) & (gains[:, W_R] <= most)
    gains, c_y, merit = gains[keep], c_y[keep], merit[keep]
    c_r = scan.behind_prefilter(gains)
    if around:
        merit = _judge_loops(scan, c_y, c_r)
    return merit + _judge_tracking(scan, c_y, c_r), gains


def _choose_loops(merit: Values) -> Int[np.ndarray, " k"]:
    """Return the loops that are given weights: half of them the best, half spread over what keeps its limits."""
    order = np.argsort(merit)
    best, worse = np.split(order, [LOOPS_WEIGHTED // 2])
    worse = worse[merit[worse] < merit[order[0]] + HOPELESS_MERIT]
    return np.concatenate([best, worse[:: 1 + worse.size // (LOOPS_WEIGHTED // 2)]])


def _list_weights(task: Task) -> tuple[float, ...]:
    """Return values of w_c/k_d to try."""
    return {"tuned": WEIGHTS, "error": (0.0,), "measurement": (1.0,)}[task.spec.reference_weights]


def _list_integrals(scan: _Scan) -> Values:
    """Return values of k_i to try where k_p is not known yet."""
    if scan.task.spec.structure == "pd":
        return np.zeros(1)
    slowest = 1.3 * INTEGRAL_RAD_S * (1 + np.array([0.1, 1.0]) * scan.inverse)
    fast = max(0.05 * 2 * np.pi * scan.task.spec.bandwidth_hz * scan.inverse, 2.0 * slowest[1])
    return np.append(slowest, fast) if scan.task.nominal is None else np.array([0.0, fast])


def _price_missing_integral(scan: _Scan, gains: GainRows) -> Values:
    """Return what a k_i counts that is below the least; beside an observer it will be none."""
    if scan.task.spec.structure not in ("pid", CASCADE):
        return np.zeros(gains.shape[0])
    least = INTEGRAL_RAD_S * (1 + gains[:, K_P])
    return np.maximum(0.0, np.log(least / np.maximum(gains[:, K_I], 1e-12)))


def solve_bandwidth(
    by_y: Any, by_r: Any, slope: Complex[np.ndarray, " n"], distance: Complex[np.ndarray, " n"]
) -> Float[np.ndarray, " two_n"]:
    """Return both roots k_p of 2 |by_r k_p + slope|^2 = |by_y k_p + one|^2; not a number where there is none."""
    size, passed = np.abs(by_y) ** 2, 2.0 * np.abs(by_r) ** 2
    half = np.real(2.0 * slope * np.conj(by_r) - distance * np.conj(by_y))
    constant = 2.0 * np.abs(slope) ** 2 - np.abs(distance) ** 2
    lead = passed - size
    lead = np.where(np.abs(lead) > LEAST_LEAD * size, lead, LEAST_LEAD * size)  # at |F|^2 = 1/2 it is linear
    with np.errstate(invalid="ignore"):
        root = np.sqrt(half**2 - lead * constant)
    return np.concatenate([(-half + root) / lead, (-half - root) / lead])


def _judge_loops(scan: _Scan, c_y: Responses, c_r: Responses) -> Values:
    """Return the logarithm of the objective, and what is worse than any where a limit on the loop is broken."""
    value, worst, encircles = judge_loops(scan.task, scan.grid, scan.respond(c_y, c_r))
    return np.log(np.maximum(value, NEXT_TO_NO_NOISE)) + _price(worst) + np.where(encircles, 50.0, 0.0)


def judge_loops(task: Task, grid: Grid, laws: LawResponse) -> tuple[Values, Values, Bool[np.ndarray, " n"]]:
    """Return the objective of n laws, their worst usage of a limit on the loop, and whether 1 + L encircles zero."""
    count = laws.c_y.shape[0]
    weights, worst, value, turned = task.weights(grid.f), np.zeros(count), np.zeros(count), np.zeros(count)
    for margins in use_friction(grid, laws).values():
        worst = np.max(margins, axis=(1, 2))
    for row in range(len(grid.rows)):
        names = tuple(name for name in task.design_limits(grid.rows[row]) if name not in TRACKING)
        usage = task.curves(SCOPES["every plant"] + names, grid, row, laws)
        usage |= task.port_usage(grid, laws) if grid.rows[row] == 0 else {}
        for curve in usage.values():
            worst = np.maximum(worst, np.max(curve, axis=-1))
        distance = grid.plants.at(row).add_up(laws.c_y, laws.c_v, laws.c_r)
        turn = np.sum(np.angle(distance[:, 1:] * np.conj(distance[:, :-1])), axis=1)
        # A stable loop turns by half a circle more for every pole of the plant that grows.
        turned = np.minimum(turned, turn - np.pi * count_growing(task.plants[grid.rows[row]]))
        if task.spec.objective == "disturbance":
            value = np.maximum(value, (1.0 / np.abs(distance)) @ weights)
        elif grid.rows[row] < task.design_states:
            alone = grid.plants.alone.at(row).add_up(laws.c_y, laws.c_v, laws.c_r)
            value = np.maximum(value, np.max(np.abs(laws.c_y / alone), axis=1))
    return value, worst, turned < LEAST_TURN


def _judge_tracking(scan: _Scan, c_y: Responses, c_r: Responses) -> Values:
    """Return what limits on the reference's path count that are broken."""
    return _price(use_tracking(scan.task, scan.grid, scan.respond(c_y, c_r)))


def use_tracking(task: Task, grid: Grid, laws: LawResponse) -> Values:
    """Return the worst usage of a limit on the reference's path, of n laws."""
    worst = np.zeros(laws.c_y.shape[0])
    for row, plant in enumerate(grid.rows):
        names = tuple(name for name in task.design_limits(plant) if name in TRACKING)
        for curve in task.curves(names, grid, row, laws).values():
            worst = np.maximum(worst, np.max(curve, axis=-1))
    return worst


def _price(worst: Values) -> Values:
    return 20.0 * np.log(np.maximum(worst, 1.0))
