r"""The optimisation problem of the tuner: plants, frequencies and limits as arrays, a law as fourteen numbers.

Every limit is one curve over frequency, its *usage*, which must not exceed 1 (`seaopt.control.laws.limits`):
:math:`|X| / (m\,|1 + L|)`, or its inverse where abs(X) is to be above. As m is what the specification allows less the
reserve, these are for the rows of today

.. math::
    \frac{1}{M_s |1 + L|}, \quad \frac{|L|}{M_t |1 + L|}, \quad \frac{\alpha\,|1 - L|}{2\,|1 + L|}
    \qquad \text{(every plant)} \\
    \frac{|P C_r|}{M_r |1 + L|}, \quad \frac{|C_y|}{N |1 + L|}, \quad
    \frac{\sqrt 2}{|1 + L|} \; (f \le f_s), \quad \frac{|1 + L|}{\sqrt 2 |P C_r|} \; (f < f_b)
    \qquad \text{(design plant)}

with :math:`\alpha` the disk margin. The last is equal to 1 at :math:`f_b`. In the passive band there is a further one,
1 - Re Z/abs(Z) of the design plant's port impedance (`seaopt.control.loops.port.PassivityCondition`), the gap that the
reserve leaves taken off; and where a friction margin is asked for, one of each plant with friction, the test with one
multiplier (`seaopt.control.loops.absolute_stability.FeedbackLimit`): a noise gain, weighted, on another plant.

The reference's weights are counted from feedforward and feedback of the error: with :math:`w_r = 1/P(0) + k_p - k_r`
and :math:`w_c = (1 - c) k_d`,

.. math:: C_r = F \,[h/P(0) + g \,(k_p - w_r + k_i I + (k_d - w_c) D)], \qquad C_y = g \,(k_p + k_i I + k_d D + O)

(terms of `LawTerms`; h is g but for the integral of a speed loop, and F the prefilter) are affine in the gains, on
which there are four linear limits besides: :math:`k_i \ge \omega_i (1 + k_p)`, :math:`w_r \le 1/P(0) + k_p`,
:math:`w_c \le k_d`, and what of a step the integral is left with (`Task.most_left_to_integral`).

**Further signals.** The loop is broken at the command: :math:`1 + L = B + P C_y` with
:math:`B = 1 + \sum_i P_i C_i` over the signals that the law reads besides the regulated one. Of a given filter
:math:`C_i` it is known; of a speed loop :math:`C_v = g\,k_v \Delta` with :math:`\Delta = (1 - q)/T_s` where the speed
is computed from an encoder, and 1 where it is measured. So

.. math:: B = B_0 + g\,k_v\, \Delta P_v, \qquad B_0 = 1 + \sum_{i \ne v} P_i C_i,

is affine in :math:`k_v`, and with it all of the above: gains of the force loop are those of effort, the speed loop's
multiplied in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.control.laws.limits import BY_NAME, FAST_BANDWIDTH, LIMITS, STEADY, STEADY_PERIODS, MeasuredLoop, Scope
from seaopt.control.laws.passivity import measure_port
from seaopt.control.laws.spec import HIGHEST_CORNER, ControllerSpec
from seaopt.control.laws.structures import OBJECTIVE_HZ, Gains, LawTerms, Nominal, SpeedLoop, evaluate_terms
from seaopt.control.laws.verdict import list_broken_limits
from seaopt.control.loops.absolute_stability import SIMPLEST, FrictionMargin, friction_margin
from seaopt.control.loops.compensation.link_feedforward import LinkPath
from seaopt.control.loops.law import Law
from seaopt.control.loops.loop import Loop, LoopFigures
from seaopt.control.loops.measured.loop import DiscLoop
from seaopt.control.loops.measured.plant import MeasuredPlant
from seaopt.control.loops.moved_link import MovedLinks, close_plant
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.loops.port import PortModel, weigh_passivity
from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.control.tuning.grid import (
    FRICTION,
    Curve,
    Frequencies,
    Grid,
    LawResponse,
    Path,
    PlantWithFriction,
    Response,
    Usage,
    feed_back,
    stack_paths,
    use_disc,
    use_friction,
    weigh_friction,
)
from seaopt.control.tuning.law_numbers import (
    DAMPING,
    K_D,
    K_I,
    K_P,
    K_V,
    NOTCH_DEPTH,
    NOTCH_W,
    NOTCH_WIDTH,
    PREFILTER_W,
    SLOWEST_SPEED_RATE,
    SPEED_RATE,
    T_F,
    T_Q,
    W_C,
    W_R,
    LawNumbers,
    LawsNumbers,
    least_integral_rate,
    make_gains,
    warp_frequency,
)
from seaopt.plants import CompletedParameters, Plant
from seaopt.records import record

NO_LIMIT, NO_FLOOR = 1e9, 1e-9
NO_FLOOR_FILTERED = 1e-15  # below what a prefilter leaves next to the Nyquist frequency, where it has a zero
NEARLY_KEPT = 1.001
ALONE_S = 3.0  # the slowest observer that is the law's only integral: what a constant load does leaves as slowly
NEXT_TO_NO_NOISE = 1e-9  # N/N, of a law without feedback: the objective's logarithm is taken
LOWEST_NOTCH = 1.2  # of the bandwidth: one at the bandwidth would make it by a dip
LOWEST_PREFILTER = 0.3  # of the bandwidth
PREFILTER_DAMPING = (0.4, 2.0)
CURVES = {limit.name: limit.curve for limit in LIMITS if limit.curve is not None}
SCOPES: dict[Scope, tuple[str, ...]] = {
    scope: tuple(name for name in CURVES if BY_NAME[name].scope == scope) for scope in ("every plant", "design plant")
}
TRACKING = tuple(name for name, curve in CURVES.items() if curve.of == "P C_r")  # limits on the reference's path
NOISE, PASSIVE = "max_noise_gain", "passive_band_hz"
LINEAR_LIMITS = 4


@record(eq=False)
class Task:
    """A specification with the plants it is to hold for.

    The first is the design plant, whose port must be passive; of two `design_states` it is the sliding one, and the
    second plant is the same one stuck by its friction. `frictions` are those of which a friction margin is asked, and
    those that friction which falls with speed makes grow; `signals` are the outputs that the law reads.

    What it reads besides the regulated one has an entry each in `further`: the filter C that feeds it back, which is
    given, or the `SpeedLoop` that is tuned. `link` is what the last of them is made of, where that feeds the motion of
    the link forward. `models` are the plants that are sampled; None where one is measured. With `moved` links the outer
    loop is closed around them, but for what is asked of the design plant alone, which is asked of the force law.
    `eased` are factors by which more of a limit may be used while a law is looked for, by its name
    (`seaopt.control.tuning.solution`); and unless it `settles`, any part of a step may be left to the integral. `fast`
    is which of the design states is the plant as it slides fast, where a bandwidth is asked for there.
    """

    spec: ControllerSpec
    plants: tuple[DigitalPlant | MeasuredPlant, ...]
    names: tuple[str, ...]
    k_ff: float
    nominal: Nominal | None
    port: PortModel | None = None
    design_states: int = 1
    frictions: tuple[PlantWithFriction, ...] = ()
    signals: tuple[str, ...] = ()
    further: tuple[TransferFunction | SpeedLoop, ...] = ()
    link: LinkPath | None = None
    models: tuple[tuple[Plant, CompletedParameters] | None, ...] = ()
    moved: MovedLinks | None = None
    eased: Mapping[str, float] = field(default_factory=dict[str, float])
    settles: bool = True
    fast: int | None = None
    slowest_observer_s: float = 30.0  # where the objective begins, 0.1 Hz, Q is 0.003: it does nothing

    @property
    def speed_loop(self) -> SpeedLoop | None:
        """The speed loop that is tuned; None without one."""
        return next((path for path in self.further if isinstance(path, SpeedLoop)), None)

    @property
    def gains_tuned(self) -> slice:
        """The numbers that the law is affine in, the first five or six."""
        return slice(0, K_V + (self.speed_loop is not None))

    @property
    def curve_names(self) -> tuple[str, ...]:
        """The limits that are curves and imposed, with the noise gain where that is the objective. That on a speed
        loop's own noise gain is one only where there is such a loop.
        """
        imposed = [name for name in CURVES if self.spec.level(name) is not None]
        if self.spec.objective == "noise" and NOISE not in imposed:
            imposed.append(NOISE)
        missing = {FAST_BANDWIDTH} if self.fast is None else set[str]()
        missing |= set() if self.speed_loop is not None else {name for name in imposed if CURVES[name].of == "C_v"}
        return tuple(name for name in imposed if name not in missing)

    @property
    def asks_margin(self) -> bool:
        """Whether a friction margin is asked of some plant."""
        return bool(self.frictions) and self.spec.level(FRICTION) is not None

    def integrates(self, x: LawNumbers) -> bool:
        """Tell whether the law integrates the error: not a pd, nor a disturbance observer that is alone at it."""
        return self.spec.structure in ("pid", "cascade") or (self.nominal is not None and bool(x[K_I] > 0.0))

    def tidy(self, x: LawNumbers) -> LawNumbers:
        """Return numbers within their bounds; beside an observer an integral that does too little becomes none."""
        x, least = x.copy(), least_integral_rate(x) * (1.0 + max(x[K_P], 0.0))
        if self.nominal is not None and x[K_I] < 0.5 * least:
            x[K_I] = 0.0
        x = np.clip(x, *self.bounds(x))
        if self.integrates(x):
            x[K_I] = max(x[K_I], least)
        x[W_R] = min(x[W_R], max(self.k_ff + x[K_P], 0.0))
        if self.settles and self.integrates(x) and x[SPEED_RATE] == 0.0:
            x[W_R] = min(x[W_R], self.most_left_to_integral(x[K_P], x[K_I]))
        x[W_C] = x[K_D] if self.spec.reference_weights == "measurement" else min(x[W_C], x[K_D])
        return x

    def linear_limits(
        self, x: LawNumbers
    ) -> tuple[Float[np.ndarray, "4 g"], Float[np.ndarray, " 4"], Float[np.ndarray, " 4"]]:
        """Return matrix, least and largest value of the linear limits on the gains of a law that integrates as x does.
        They are what an integral does at least, the least weights, k_r = 0 and c = 0, and what of a step is left to the
        integral at most, behind a speed loop's own none.
        """
        rate = least_integral_rate(x) if self.integrates(x) else 0.0
        weighed = self.integrates(x) and x[SPEED_RATE] == 0.0 and self.spec.reference_weights != "error"
        left = STEADY if self.settles and weighed else 0.0
        matrix = np.zeros((LINEAR_LIMITS, self.gains_tuned.stop))
        matrix[:, :K_V] = [
            [-rate, 1.0, 0.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 1.0, 0.0], [0.0, 0.0, -1.0, 0.0, 1.0],
            [-left, -left * self.steady_s, 0.0, 1.0, 0.0],
        ]  # fmt: skip
        least_c = 0.0 if self.spec.reference_weights == "measurement" else -np.inf
        most = np.array([np.inf, max(self.k_ff, 0.0), 0.0, left * max(self.k_ff, 0.0) if left else np.inf])
        return matrix, np.array([rate, -np.inf, least_c, -np.inf]), most

    @property
    def steady_s(self) -> float:
        """When the force of a step is to be at its reference, as the certificate judges it."""
        return STEADY_PERIODS / self.spec.bandwidth_hz

    def most_left_to_integral(self, k_p: Any, k_i: Any) -> Any:
        r"""Return the largest w_r, of gains or arrays of them, with which a step is within 2 % when its end is judged.
        The feedback alone leaves a step off by :math:`w_r/(1/P(0) + k_p)`, which the integral takes away at the rate
        :math:`\rho = k_i/(1/P(0) + k_p)`. As :math:`e^{\rho t} \ge 1 + \rho t` it is enough that
        :math:`w_r \le 0.02\,(1/P(0) + k_p + k_i t)`, which is linear in the gains.
        """
        return STEADY * (max(self.k_ff, 0.0) + k_p + k_i * self.steady_s)

    def level(self, name: str, f: Frequencies) -> Curve:
        """Return a curve's level, with the reserve taken off; one that is never reached where none is imposed."""
        curve, limit, keep = CURVES[name], BY_NAME[name], 1.0 - self.spec.reserve
        allowed, floor = self.spec.allowed(limit), NO_FLOOR if self.spec.reference_filter is None else NO_FLOOR_FILTERED
        never = floor if curve.floor else NO_LIMIT
        if allowed is None:
            return np.full(f.size, never)
        if limit.reserve == "figure":
            allowed = allowed * keep if limit.sense == "at most" else allowed / keep
        level = curve.level(allowed)
        if limit.reserve == "curve":
            level = level / keep if curve.floor else level * keep
        more = self.eased.get(name, 1.0)
        level = level / more if curve.floor else level * more
        low, high = self.band_hz(name)
        inside = (f >= low * (1 - 1e-9)) & (f <= high * (1 + 1e-9))
        return np.where(inside, max(level, 1e-6) * (self.spec.bandwidth_hz / f) ** curve.fall, never)

    def bounds(self, x: LawNumbers) -> tuple[LawNumbers, LawNumbers]:
        """Return the least and largest numbers of a law that integrates as x does; equal where one is fixed or absent.
        Without an integral k_r is fixed, for a static gain of 1.
        """
        spec, ts, integrates = self.spec, self.spec.sample_time_s, self.integrates(x)
        fixed, free, unused = (0.0, 0.0), (0.0, np.inf), (1.0, 1.0)

        def warp(corner_hz: float | None, lowest: float) -> tuple[float, float]:
            low, high = _range(corner_hz, lowest * spec.bandwidth_hz, HIGHEST_CORNER / ts)
            return warp_frequency(low, ts), warp_frequency(high, ts)

        notch, prefilter = ((0.1, 0.1), (0.5, 0.5), unused), (unused, unused)
        fastest = (spec.level("min_filter_samples") or 0.0) * ts
        if spec.notch is not None:
            width, depth = _range(spec.notch.width, 0.02, 1.0), _range(spec.notch.depth, 0.01, 1.0)
            notch = (warp(spec.notch.frequency_hz, LOWEST_NOTCH), width, depth)
        low_pass = spec.reference_filter
        if low_pass is not None:
            damping = _range(low_pass.damping, *PREFILTER_DAMPING) if low_pass.is_second_order else unused
            prefilter = (warp(low_pass.corner_hz, LOWEST_PREFILTER), damping)
        ranges = [
            free, free if integrates else fixed, free,
            free if integrates and spec.reference_weights != "error" else fixed,
            free if spec.reference_weights != "error" else fixed,
            free if self.speed_loop is not None else fixed,
            (fastest, max(fastest, 4.0 / (2 * np.pi * spec.bandwidth_hz))),
            (0.2 * ts, self.slowest_observer_s if integrates else ALONE_S) if self.nominal is not None else unused,
            (SLOWEST_SPEED_RATE, 1.0 / ts) if self.speed_loop is not None and x[SPEED_RATE] > 0.0 else fixed,
            *notch, *prefilter,
        ]  # fmt: skip
        low, high = (np.array(ends, dtype=float) for ends in zip(*ranges, strict=True))
        return low, high

    def gains(self, x: LawNumbers) -> Gains:
        """Return a vector's numbers by name."""
        return make_gains(self.spec, x, self.k_ff, self.speed_loop, self.nominal)

    def enclosed(self, outer: OuterLoop, per_effort: float) -> Task:
        """Return the task with an outer loop around the plants whose links move. `per_effort` is the command's."""
        timing = self.spec.sample_time_s, self.spec.loop_delay_samples
        return replace(self, moved=MovedLinks.of(outer, self.models, self.signals, per_effort, *timing))

    def law_of(self, x: LawNumbers) -> Law:
        """Return the law of a vector, not balanced."""
        return self._make_law(self.gains(x))

    def _make_law(self, gains: Gains) -> Law:
        law = gains.law(self.spec.structure, self.spec.sample_time_s)
        for path in self.further:
            law = law if isinstance(path, SpeedLoop) else law.reading(path)
        return law

    def loop(self, x: LawNumbers, plant: int = 0) -> Loop | DiscLoop:
        """Return the loop around one plant."""
        return self.close(plant, self.law_of(x))

    def close(self, row: int, law: Law) -> Loop | DiscLoop:
        """Return the loop of a law around one plant, with the outer loop where its link moves."""
        moved = None if self.moved is None else self.moved.close(row, law)
        return close_plant(self.plants[row], law) if moved is None else moved

    def is_stable(self, x: LawNumbers) -> bool:
        """Tell whether every plant's loop is stable: by its eigenvalues, or by the turns of a measured one."""
        gains = self.gains(x)
        if self.moved is None:
            gains = replace(gains, prefilter=None)  # which is no part of the loop
        law = self._make_law(gains)
        return all(self.close(row, law).is_stable() for row in range(len(self.plants)))

    def grid(self, f: Frequencies, rows: Sequence[int] | None = None) -> Grid:
        """Return the responses of the plants, or of some of them, at frequencies."""
        q = np.exp(-2j * np.pi * f * self.spec.sample_time_s)
        kept = inverse = np.zeros(f.size, dtype=complex)
        if self.nominal is not None:
            kept = np.polynomial.polynomial.polyval(q, self.nominal.kept)
            inverse = self.nominal.inverse_response(f, self.spec.sample_time_s)
        rows = tuple(range(len(self.plants)) if rows is None else rows)
        paths = [self._respond(row, f) for row in rows]
        discs = [self._surround(row, f) for row in rows]
        unit = np.zeros(f.size, dtype=complex)
        count, feed = 1 + len(self.further), partial(feed_back, further=self.further, f=f, ts=self.spec.sample_time_s)
        loops, forces = np.zeros((2, count, f.size), dtype=complex)
        if self.port is not None and self.spec.passive_band_hz is not None:
            low, high = self.spec.passive_band_hz
            inside = np.flatnonzero((f >= low * (1 - 1e-9)) & (f <= high * (1 + 1e-9)))
            passive = weigh_passivity(self.port, self.spec.sample_time_s, self.spec.loop_delay_samples, f[inside])
            unit[inside], loops[:, inside], forces[:, inside] = passive.unit, passive.loops, passive.forces
        aimed = [sliding for sliding in self.frictions if sliding.multiplier and sliding.plant in rows]
        plants = np.zeros((len(aimed), count, f.size), dtype=complex)
        weights = np.zeros((len(aimed), count, count, f.size), dtype=complex)
        for k, sliding in enumerate(aimed):
            plants[k], weights[k] = weigh_friction(sliding, self.spec, count, f)
        return Grid(
            f=f,
            q=q,
            plants=stack_paths(paths),
            discs=stack_paths(discs),
            rows=rows,
            kept=kept,
            inverse=inverse,
            port=feed(loops, 1.0),
            force=feed(forces, 1.0),
            unit=unit,
            friction=feed(plants, 1.0),
            friction_size=feed(weights, 0.0),
            levels={name: self.level(name, f) for name in self.curve_names},
        )

    def _respond(self, row: int, f: Frequencies) -> Path:
        """Return 1 + L of one plant, the speed of a speed loop as it is read."""
        plant, moved, signals = self.plants[row], self.moved, 1 + len(self.further)
        read = plant.responses(f, signals) if isinstance(plant, MeasuredPlant) else plant.responses(f)[:signals]
        path = feed_back(read, 1.0, self.further, f, self.spec.sample_time_s)
        return path if moved is None else replace(path, r=moved.respond(row, f))

    def _surround(self, row: int, f: Frequencies) -> Path:
        """Return the radii of the discs around what `_respond` has of one plant; zeros of a model."""
        plant, signals = self.plants[row], 1 + len(self.further)
        radii = plant.discs(f, signals) if isinstance(plant, MeasuredPlant) else np.zeros((signals, f.size))
        return feed_back(radii, 0.0, self.further, f, self.spec.sample_time_s, sizes=True)

    def terms(self, grid: Grid, x: LawsNumbers) -> LawTerms:
        """Return the law's terms on a grid."""
        observer = None if self.nominal is None else (x[T_Q], grid.kept, grid.inverse)
        notch = None if self.spec.notch is None else (x[NOTCH_W], x[NOTCH_WIDTH], x[NOTCH_DEPTH])
        low_pass = self.spec.reference_filter
        prefilter = None if low_pass is None else (x[PREFILTER_W], x[DAMPING] if low_pass.is_second_order else None)
        return evaluate_terms(grid.q, self.spec.sample_time_s, x[T_F], observer, notch, x[SPEED_RATE], prefilter)

    def respond(self, grid: Grid, x: LawsNumbers) -> LawResponse:
        """Return the law on a grid."""
        series, integral, rate, observer, ahead, prefilter = self.terms(grid, x)
        both, sense = x[K_P] + x[K_I] * integral, self.sense(grid.q)
        return LawResponse(
            c_y=series * (both + x[K_D] * rate + observer),
            c_r=prefilter * (ahead * self.k_ff + series * (both - x[W_R] + (x[K_D] - x[W_C]) * rate)),
            c_v=sense if self.speed_loop is None else x[K_V] * series * sense,
        )

    def sense(self, q: Response) -> Response:
        """Return from the speed's signal to the speed as the law has it; zeros without a speed loop."""
        return np.zeros_like(q) if self.speed_loop is None else self.speed_loop.sense(q, self.spec.sample_time_s)

    def speed_gain(self, grid: Grid) -> float:
        """Return the design plant's speed per command as the law has it, at the bandwidth; 0 without a speed loop."""
        at = self.find_bandwidth(grid)
        return float(np.abs(grid.plants.v[0, at] * self.sense(grid.q)[at]))

    def usage(self, grid: Grid, law: LawResponse) -> dict[str, Usage]:
        """Return how much of each limit is used, by its name, with one row for each of the first plants it is for."""
        rows: dict[str, list[Curve]] = {}
        for position, row in enumerate(grid.rows):
            if row >= self.design_states:
                continue
            curves = self.curves(self.design_limits(row), grid, position, law)
            curves |= self.port_usage(grid, law) if row == 0 else {}
            for name, curve in curves.items():
                before = rows.setdefault(name, [])
                before += [np.zeros_like(curve)] * (position - len(before))  # of plants that it is not for
                before.append(curve)
        everywhere = self.curves(SCOPES["every plant"], grid, slice(None), law) | use_friction(grid, law)
        return everywhere | {name: np.array(usage) for name, usage in rows.items()}

    def curves(self, names: Sequence[str], grid: Grid, plants: int | slice, law: LawResponse) -> dict[str, np.ndarray]:
        """Return the usage of the imposed ones of some limits on a grid's plants, in discs around them the worst. Those
        of the design plant are asked of the force law alone.
        """
        path, imposed = grid.plants.at(plants), [name for name in names if name in grid.levels]
        if path.r is None:
            return self._use(imposed, grid, path, plants, law)
        of_design = [name for name in imposed if name in SCOPES["design plant"]]
        shared = [name for name in imposed if name not in of_design]
        return self._use(shared, grid, path, plants, law) | self._use(of_design, grid, path.alone, plants, law)

    def _use(
        self, names: Sequence[str], grid: Grid, path: Path, plants: int | slice, law: LawResponse
    ) -> dict[str, np.ndarray]:
        """Return the usage of limits on plants with one path."""
        discs, p = grid.discs.at(plants) if grid.in_discs else None, path.y
        open_loop = path.add_constant(law.c_v, law.c_r) - 1.0 + p * law.c_y
        distance = np.abs(1.0 + open_loop)
        out: dict[str, np.ndarray] = {}
        discs = discs if discs is not None and np.any(discs.y) else None
        for name in names:
            curve, level = CURVES[name], grid.levels[name]
            if discs is not None:
                out[name] = use_disc(curve, level, path, discs, law.c_y, law.c_r, law.c_v)
                continue
            size = np.abs(curve.numerator(p, law.c_y, law.c_r, open_loop, law.c_v))
            out[name] = level * distance / np.maximum(size, 1e-12) if curve.floor else size / (level * distance)
        return out

    def band_hz(self, name: str) -> tuple[float, float]:
        """Return from where to where a curve is looked at; finite ends are among the frequencies."""
        curve, allowed = CURVES[name], self.spec.allowed(BY_NAME[name])
        ends = [
            None if end is None or allowed is None else end(allowed, self.spec.bandwidth_hz)
            for end in (curve.from_hz, curve.until_hz)
        ]
        return 0.0 if ends[0] is None else ends[0], np.inf if ends[1] is None else ends[1]

    def design_limits(self, row: int) -> tuple[str, ...]:
        """Return the limits that a plant keeps as the design plant, sliding, stuck or fast; none if it is another."""
        if row >= self.design_states:
            return ()
        limits = (BY_NAME[name] for name in SCOPES["design plant"])
        return tuple(
            limit.name for limit in limits if limit.stuck_too or (row == self.fast if limit.of_fast else row == 0)
        )

    def port_usage(self, grid: Grid, law: LawResponse) -> dict[str, np.ndarray]:
        """Return the usage of the passive band, where one is asked for."""
        if self.port is None:
            return {}
        at = law.c_y, law.c_v, law.c_r
        turned = grid.force.add_up(*at) * np.conj(grid.port.add_up(*at))
        cosine = np.real(grid.unit * turned) / np.maximum(np.abs(turned), 1e-300)
        return {PASSIVE: np.where(grid.unit != 0.0, (1.0 - cosine) / (1.0 - self.spec.reserve), 0.0)}

    def aim_multipliers(self, x: LawNumbers, multiplier: str = "") -> Task:
        """Return the task with one multiplier per plant with friction: that named, or the one that shows most of x."""
        if not self.asks_margin:
            return self
        names = [multiplier] * len(self.frictions)
        if not multiplier:
            names = [margin.multiplier if margin.factor else SIMPLEST for margin in self.find_margins(self.law_of(x))]
        aimed = (replace(sliding, multiplier=name) for sliding, name in zip(self.frictions, names, strict=True))
        return replace(self, frictions=tuple(aimed))

    def list_broken(self, loops: Sequence[MeasuredLoop]) -> set[str]:
        """Return the limits that a law with these loops misses."""
        return list_broken_limits(self.spec, loops, self.design_states)

    def find_margins(self, law: Law) -> list[FrictionMargin]:
        """Return the margin of every plant with friction."""
        return [friction_margin(replace(sliding.loop, law=law)) for sliding in self.frictions]

    def measure(self, x: LawNumbers) -> list[MeasuredLoop]:
        """Return the loop of every plant as limits are judged on it, the design plant's first."""
        return self.measure_law(
            self.law_of(x).balanced(),
            filter_samples=float(x[T_F] / self.spec.sample_time_s) if x[K_D] > 0.0 else np.inf,
            integral_rad_s=self.gains(x).integral_rad_s if self.integrates(x) else np.inf,
        )

    def measure_law(self, law: Law, *, filter_samples: float, integral_rad_s: float) -> list[MeasuredLoop]:
        """Return the same of any law, whose filter and integral are known."""
        port, spec, band = None, self.spec, self.spec.passive_band_hz
        if self.port is not None and band is not None:
            port = measure_port(self.port, law, spec.loop_delay_samples, band)
        slopes: dict[int, float] = {}
        if self.asks_margin:
            margins = zip(self.frictions, self.find_margins(law), strict=True)
            slopes = {sliding.plant: margin.least_slope for sliding, margin in margins}
        figures = [self.measure_figures(law, i) for i in range(len(self.names))]
        return [
            MeasuredLoop(
                name=name,
                figures=figures[i],
                fast=None if i or self.fast is None else figures[self.fast],
                port=None if i else port,
                filter_samples=filter_samples,
                integral_rad_s=integral_rad_s,
                friction_slope=slopes.get(i, np.inf),
            )
            for i, name in enumerate(self.names)
        ]

    def measure_figures(self, law: Law, row: int = 0) -> LoopFigures:
        """Return the figures of a plant's loop; of the design plant those of the force law alone, with the margins of
        the outer loop around it.
        """
        whole = self.close(row, law)
        figures = whole.figures(self.spec.bandwidth_hz) if isinstance(whole, DiscLoop) else whole.figures()
        if self.moved is None or row >= self.design_states or not self.moved.moves(row):
            return figures
        return replace(self, moved=None).measure_figures(law, row).with_margins(figures)

    def weights(self, f: Frequencies) -> Curve:
        """Return trapezoidal weights over ln f from 0.1 Hz to the bandwidth, both of which are frequencies."""
        first, last = np.searchsorted(f, [OBJECTIVE_HZ * (1 - 1e-9), self.spec.bandwidth_hz * (1 + 1e-9)])
        out, step = np.zeros(f.size), 0.5 * np.diff(np.log(f[first:last]))
        out[first : last - 1] += step
        out[first + 1 : last] += step
        return out

    def find_bandwidth(self, grid: Grid) -> int:
        """Return which of a grid's frequencies is the bandwidth."""
        return int(np.argmin(np.abs(grid.f - self.spec.bandwidth_hz)))

    def miss(self, grid: Grid, law: LawResponse) -> float:
        """Return ln of abs(F/F_ref) over -3 dB at the bandwidth, which is 0."""
        at = np.array([self.find_bandwidth(grid)])
        path, c_r = grid.plants.alone.at((0, at)), law.c_r[at]
        return float(np.log(np.abs(np.sqrt(2.0) * path.y * c_r / path.add_up(law.c_y[at], law.c_v[at], c_r)))[0])

    def rank(self, grid: Grid, x: LawNumbers) -> tuple[float, float]:
        """Return what to sort laws by: the worst usage if a limit is broken, then the objective. A bandwidth that is
        missed counts ten times a limit that is.
        """
        worst, objective = self.judge(grid, x, bandwidth_price=10.0)
        return (worst if worst > NEARLY_KEPT else 0.0), objective

    def judge(self, grid: Grid, x: LawNumbers, bandwidth_price: float) -> tuple[float, float]:
        """Return the worst usage on a grid, with the price of a bandwidth that is missed, and the objective."""
        law = self.respond(grid, x)
        return max(self.worst(grid, law), 1.0 + bandwidth_price * abs(self.miss(grid, law))), self.objective(grid, law)

    def worst(self, grid: Grid, law: LawResponse) -> float:
        """Return the largest usage of a limit on a grid."""
        return max(float(np.max(curve)) for curve in self.usage(grid, law).values())

    def objective(self, grid: Grid, law: LawResponse) -> float:
        """Return the objective on a grid."""
        noise = self.spec.objective == "noise"
        plants = grid.plants.alone if noise else grid.plants
        distance = np.abs(plants.add_up(law.c_y, law.c_v, law.c_r))
        if noise:
            return max(float(np.max(np.abs(law.c_y) / distance[: self.design_states])), NEXT_TO_NO_NOISE)
        return float(np.max((1.0 / distance) @ self.weights(grid.f)))


def _range(fixed: float | None, low: float, high: float) -> tuple[float, float]:
    return (low, high) if fixed is None else (fixed, fixed)
