r"""The optimisation problem of the tuner: plants, frequencies and limits as arrays, a law as eight numbers.

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
1 - Re Z/abs(Z) of the design plant's port impedance (`seaopt.control.laws.passivity`), the gap that the reserve leaves
taken off.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Complex, Float, Int

from seaopt.control.laws.limits import BY_NAME, LIMITS, MeasuredLoop, Scope
from seaopt.control.laws.passivity import measure_port
from seaopt.control.laws.spec import LOWEST_HZ, ControllerSpec
from seaopt.control.laws.structures import DisturbanceObserver, Gains, LawTerms, Nominal, Notch, evaluate_terms
from seaopt.control.loops.law import Law
from seaopt.control.loops.loop import Loop
from seaopt.control.loops.port import PortModel, weigh_passivity
from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.records import record

OBJECTIVE_HZ = 0.1  # disturbances count from here
INTEGRAL_RAD_S = 2 * np.pi * 0.05  # k_i / (1 + k_p) at least, so that the integral does something
FREQUENCIES = 300
SLOW_FREQUENCIES = 40  # frequencies below 0.1 Hz
MORE_FREQUENCIES = 300  # about lightly damped modes
LIGHT_DAMPING = 0.2  # damping ratio below which a mode is resolved
NO_RATE = 1e-3  # rad/s
NO_LIMIT = 1e9
NEARLY_KEPT = 1.001
SLOWEST_OBSERVER_S = 3.0  # slower, double-precision coefficients say too little of Q at 1e-3 Hz
LOWEST_NOTCH = 1.2  # of the bandwidth: one at the bandwidth would make it by a dip
HIGHEST_NOTCH = 0.45  # of the sample rate
CURVES = {limit.name: limit.curve for limit in LIMITS if limit.curve is not None}
SCOPES: dict[Scope, tuple[str, ...]] = {
    scope: tuple(name for name in CURVES if BY_NAME[name].scope == scope) for scope in ("every plant", "design plant")
}
PASSIVE = "passive_band_hz"

LawNumbers = Float[np.ndarray, " 8"]  # k_p, k_i, k_d, T_f, T_q, notch_w, notch_width, notch_depth


@record(eq=False)
class Grid:
    """Responses at frequencies.

    Parameters
    ----------
    f, q
        Frequencies in Hz, and exp(-j omega T_s).
    p : array, shape (plants, m)
        Plants with hold and delay; the first is the design plant.
    rows : tuple of int
        Which of the task's plants they are.
    kept, inverse
        The nominal plant's parts at q; zeros without an observer.
    port, unit
        The loop with link 2 held but for C_y, and G_22/abs(G_22), in the passive band; zeros elsewhere.

    """

    f: Float[np.ndarray, " m"]
    q: Complex[np.ndarray, " m"]
    p: Complex[np.ndarray, "n m"]
    rows: tuple[int, ...]
    kept: Complex[np.ndarray, " m"]
    inverse: Complex[np.ndarray, " m"]
    port: Complex[np.ndarray, " m"]
    unit: Complex[np.ndarray, " m"]

    def at(self, index: Int[np.ndarray, " k"]) -> Grid:
        """Return some of the frequencies."""
        return Grid(
            f=self.f[index], q=self.q[index], p=self.p[:, index], rows=self.rows, kept=self.kept[index],
            inverse=self.inverse[index], port=self.port[index], unit=self.unit[index],
        )  # fmt: skip


@record(eq=False)
class Task:
    """A specification with the plants it is to hold for.

    The first is the design plant, whose port must be passive; of two `design_states` it is the sliding one, and the
    second plant is the same one stuck by its friction.
    """

    spec: ControllerSpec
    plants: tuple[DigitalPlant, ...]
    names: tuple[str, ...]
    k_ff: float
    nominal: Nominal | None
    port: PortModel | None = None
    design_states: int = 1

    @property
    def least_rate(self) -> float:
        """The least k_i/(1 + k_p), rad/s: an integral does something, and a disturbance observer integrates itself."""
        return INTEGRAL_RAD_S if self.spec.structure == "pid" else 0.0

    def tidy(self, x: LawNumbers) -> LawNumbers:
        """Return numbers within their bounds; beside an observer an integral that does nothing becomes none."""
        x = np.clip(x, *self.bounds())
        if self.nominal is not None and x[1] < NO_RATE * (1 + x[0]):
            x[1] = 0.0
        return x

    def levels(self) -> dict[str, float]:
        """Return each curve's level, with the reserve taken off; one that is never reached where none is imposed."""
        levels: dict[str, float] = {}
        for name, curve in CURVES.items():
            limit, allowed = BY_NAME[name], self.spec.allowed(BY_NAME[name])
            keep = 1.0 if limit.reserve == "none" else 1.0 - self.spec.reserve
            if allowed is None:
                levels[name] = 1.0 / NO_LIMIT if curve.floor else NO_LIMIT
            else:
                level = curve.level(allowed)
                levels[name] = level / keep if curve.floor else max(level * keep, 1e-6)
        return levels

    def bounds(self) -> tuple[LawNumbers, LawNumbers]:
        """Return the least and largest values of the eight numbers; equal where a number is fixed or absent."""
        spec, ts = self.spec, self.spec.sample_time_s
        notch = ((0.1, 0.1), (0.5, 0.5), (1.0, 1.0))
        if spec.notch is not None:
            centre = _range(spec.notch.frequency_hz, LOWEST_NOTCH * spec.bandwidth_hz, HIGHEST_NOTCH / ts)
            notch = (
                (float(np.tan(np.pi * centre[0] * ts)), float(np.tan(np.pi * centre[1] * ts))),
                _range(spec.notch.width, 0.02, 1.0),
                _range(spec.notch.depth, 0.01, 1.0),
            )
        ranges = [
            (0.0, np.inf), (0.0, 0.0) if self.spec.structure == "pd" else (0.0, np.inf), (0.0, np.inf),
            (0.0, 4.0 / (2 * np.pi * spec.bandwidth_hz)),
            (0.2 * ts, SLOWEST_OBSERVER_S) if self.nominal is not None else (1.0, 1.0), *notch,
        ]  # fmt: skip
        low, high = (np.array(ends, dtype=float) for ends in zip(*ranges, strict=True))
        return low, high

    def gains(self, x: LawNumbers) -> Gains:
        """Return a vector's numbers by name."""
        ts, notch = self.spec.sample_time_s, None
        if self.spec.notch is not None:
            notch = Notch(frequency_hz=float(np.arctan(x[5]) / (np.pi * ts)), width=float(x[6]), depth=float(x[7]))
        return Gains(
            k_p=float(x[0]), k_i=float(x[1]), k_d=float(x[2]), T_f=float(x[3]), k_r=self.k_ff + float(x[0]),
            c=float(self.spec.reference_weights != "measurement"), notch=notch,
            observer=None if self.nominal is None else DisturbanceObserver(nominal=self.nominal, T_q=float(x[4])),
        )  # fmt: skip

    def law_of(self, x: LawNumbers) -> Law:
        """Return the law of a vector, not balanced."""
        return self.gains(x).law(self.spec.structure, self.spec.sample_time_s)

    def loop(self, x: LawNumbers, plant: int = 0) -> Loop:
        """Return the loop around one plant."""
        return Loop(plant=self.plants[plant], law=self.law_of(x))

    def is_stable(self, x: LawNumbers) -> bool:
        """Tell whether every plant's loop is stable, by its eigenvalues."""
        law = self.law_of(x)
        loops = (Loop(plant=plant, law=law) for plant in self.plants)
        return all(np.max(np.abs(loop.eigenvalues())) < 1.0 for loop in loops)

    def grid(self, f: Float[np.ndarray, " m"], rows: Sequence[int] | None = None) -> Grid:
        """Return the responses of the plants, or of some of them, at frequencies."""
        q = np.exp(-2j * np.pi * f * self.spec.sample_time_s)
        kept = inverse = np.zeros(f.size, dtype=complex)
        if self.nominal is not None:
            kept = np.polynomial.polynomial.polyval(q, self.nominal.kept)
            inverse = self.nominal.inverse_response(f, self.spec.sample_time_s)
        rows = tuple(range(len(self.plants)) if rows is None else rows)
        p = np.array([self.plants[row].response(f) for row in rows])
        port, unit = np.zeros(f.size, dtype=complex), np.zeros(f.size, dtype=complex)
        if self.port is not None and self.spec.passive_band_hz is not None:
            low, high = self.spec.passive_band_hz
            inside = np.flatnonzero((f >= low * (1 - 1e-9)) & (f <= high * (1 + 1e-9)))
            port[inside], unit[inside] = weigh_passivity(
                self.port, self.spec.sample_time_s, self.spec.loop_delay_samples, f[inside]
            )  # fmt: skip
        return Grid(f=f, q=q, p=p, rows=rows, kept=kept, inverse=inverse, port=port, unit=unit)

    def terms(self, grid: Grid, x: LawNumbers) -> LawTerms:
        """Return the law's terms on a grid."""
        observer = None if self.nominal is None else (x[4], grid.kept, grid.inverse)
        notch = None if self.spec.notch is None else (x[5], x[6], x[7])
        return evaluate_terms(grid.q, self.spec.sample_time_s, x[3], observer, notch)

    def law(self, grid: Grid, x: LawNumbers) -> tuple[Complex[np.ndarray, " m"], Complex[np.ndarray, " m"]]:
        """Return C_r and C_y on a grid."""
        series, integral, rate, observer = self.terms(grid, x)
        both = x[0] + x[1] * integral
        c_y = series * (both + x[2] * rate + observer)
        on_reference = x[2] * rate if self.spec.reference_weights != "measurement" else 0.0
        return series * (both + on_reference + self.k_ff), c_y

    def usage(self, grid: Grid, x: LawNumbers) -> dict[str, Float[np.ndarray, "k m"]]:
        """Return how much of each limit is used, by its name, with one row for each of the first plants it is for."""
        c_r, c_y = self.law(grid, x)
        rows: dict[str, list[Float[np.ndarray, " m"]]] = {}
        for position in range(len(grid.rows)):
            for name, curve in self.design_usage(grid, position, c_y, c_r).items():
                rows.setdefault(name, []).append(curve)
        everywhere = self.curves(SCOPES["every plant"], grid.f, grid.p, c_y, c_r)
        return everywhere | {name: np.array(curves) for name, curves in rows.items()}

    def curves(
        self,
        names: Sequence[str],
        f: Float[np.ndarray, " m"],
        p: Complex[np.ndarray, "*k m"],
        c_y: Complex[np.ndarray, "*n m"],
        c_r: Complex[np.ndarray, "*n m"],
    ) -> dict[str, np.ndarray]:
        """Return the usage of some limits on plants p."""
        levels, open_loop = self.levels(), p * c_y
        distance = np.abs(1.0 + open_loop)
        out: dict[str, np.ndarray] = {}
        for name in names:
            curve = CURVES[name]
            size, allowed = np.abs(curve.numerator(p, c_y, c_r, open_loop)), levels[name] * distance
            usage = allowed / np.maximum(size, 1e-12) if curve.floor else size / allowed
            out[name] = usage if curve.until_hz is None else np.where(f <= self.until_hz(name), usage, 0.0)
        return out

    def until_hz(self, name: str) -> float:
        """Return up to where a curve is looked at, a little beyond what is asked: that is one of the frequencies."""
        curve, allowed = CURVES[name], self.spec.allowed(BY_NAME[name])
        if curve.until_hz is None or allowed is None:
            return np.inf
        return curve.until_hz(allowed, self.spec.bandwidth_hz) * (1 + 1e-9)

    def design_usage(
        self, grid: Grid, position: int, c_y: Complex[np.ndarray, "*n m"], c_r: Complex[np.ndarray, "*n m"]
    ) -> dict[str, np.ndarray]:
        """Return the usage of the limits that one of the grid's plants keeps as the design plant, sliding or stuck."""
        row, names = grid.rows[position], SCOPES["design plant"]
        if row >= self.design_states:
            return {}
        if row:
            names = tuple(name for name in names if BY_NAME[name].stuck_too)
        out = self.curves(names, grid.f, grid.p[position], c_y, c_r)
        if self.port is not None and row == 0:
            one = 1.0 + grid.port * c_y
            cosine = np.real(grid.unit * np.conj(one)) / np.maximum(np.abs(one), 1e-300)
            out[PASSIVE] = np.where(grid.unit != 0.0, (1.0 - cosine) / (1.0 - self.spec.reserve), 0.0)
        return out

    def measure(self, x: LawNumbers) -> list[MeasuredLoop]:
        """Return the loop of every plant as limits are judged on it, the design plant's first."""
        port, spec, band, law = None, self.spec, self.spec.passive_band_hz, self.law_of(x).balanced()
        if self.port is not None and band is not None:
            port = measure_port(self.port, law, spec.sample_time_s, spec.loop_delay_samples, band)
        return [
            MeasuredLoop(name=name, figures=Loop(plant=self.plants[i], law=law).figures(), port=None if i else port)
            for i, name in enumerate(self.names)
        ]

    def weights(self, f: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Return trapezoidal weights over ln f from 0.1 Hz to the bandwidth, both of which are frequencies."""
        first, last = np.searchsorted(f, [OBJECTIVE_HZ * (1 - 1e-9), self.spec.bandwidth_hz * (1 + 1e-9)])
        out, step = np.zeros(f.size), 0.5 * np.diff(np.log(f[first:last]))
        out[first : last - 1] += step
        out[first + 1 : last] += step
        return out

    def miss(self, grid: Grid, x: LawNumbers) -> float:
        """Return ln of abs(F/F_ref) over -3 dB at the bandwidth, which is 0."""
        at = grid.at(np.array([int(np.argmin(np.abs(grid.f - self.spec.bandwidth_hz)))]))
        c_r, c_y = self.law(at, x)
        return float(np.log(np.abs(np.sqrt(2.0) * at.p[0] * c_r / (1 + at.p[0] * c_y)))[0])

    def rank(self, grid: Grid, x: LawNumbers) -> tuple[float, float]:
        """Return what to sort laws by: the worst usage if a limit is broken, then the objective.

        A bandwidth that is missed counts ten times a limit that is.
        """
        worst = max(float(np.max(curve)) for curve in self.usage(grid, x).values())
        worst = max(worst, 1.0 + 10.0 * abs(self.miss(grid, x)))
        return (worst if worst > NEARLY_KEPT else 0.0), self.objective(grid, x)

    def objective(self, grid: Grid, x: LawNumbers) -> float:
        """Return the objective on a grid."""
        _, c_y = self.law(grid, x)
        distance = np.abs(1.0 + grid.p * c_y)
        if self.spec.objective == "noise":
            return float(np.max(np.abs(c_y) / distance[: self.design_states]))
        return float(np.max((1.0 / distance) @ self.weights(grid.f)))


def _range(fixed: float | None, low: float, high: float) -> tuple[float, float]:
    return (low, high) if fixed is None else (fixed, fixed)


def find_light_modes(plant: DigitalPlant) -> list[tuple[float, float]]:
    """Return frequency (Hz) and damping ratio of the modes that are lightly damped."""
    values = np.linalg.eigvals(plant.a).astype(complex)
    poles = np.log(values[np.imag(values) > 0.0]) / plant.sample_time_s  # a delay's are zero
    modes = [(abs(p) / (2 * np.pi), -p.real / abs(p)) for p in poles]
    return [(float(f), float(max(zeta, 1e-9))) for f, zeta in modes if zeta < LIGHT_DAMPING]


def place_frequencies(task: Task) -> Float[np.ndarray, " m"]:
    """Return a logarithmic grid up to the Nyquist frequency, coarse below 0.1 Hz, with f_b and all bands' ends in it.

    About lightly damped plant modes its steps are zeta f / 4, or as small as 80 points a mode and 300 in all allow;
    what falls between is found afterwards.
    """
    spec, nyquist = task.spec, 0.5 / task.spec.sample_time_s
    near: list[Float[np.ndarray, " _"]] = []
    for f, zeta in {mode for plant in task.plants for mode in find_light_modes(plant)}:
        reach = max(4 * zeta, 0.02) * f
        near.append(np.linspace(f - reach, f + reach, int(min(2 * reach / max(zeta * f / 4, 1e-4), 80))))
    extra = np.sort(np.concatenate([np.zeros(0), *near]))
    extra = extra[:: 1 + extra.size // MORE_FREQUENCIES]
    slow, base = (
        np.geomspace(LOWEST_HZ, OBJECTIVE_HZ, SLOW_FREQUENCIES),
        np.geomspace(OBJECTIVE_HZ, 0.999 * nyquist, FREQUENCIES),
    )
    ends = [spec.bandwidth_hz, *(spec.passive_band_hz or ())]
    for name, curve in CURVES.items():
        allowed = spec.allowed(BY_NAME[name])
        if curve.until_hz is not None and allowed is not None and BY_NAME[name].reserve == "curve":
            ends.append(curve.until_hz(allowed, spec.bandwidth_hz))
    grid = np.unique(np.concatenate([slow[:-1], base, extra, ends]))
    return grid[(grid >= LOWEST_HZ) & (grid < nyquist)]


def choose_prominent(usage: Float[np.ndarray, "k m"], count: int) -> Int[np.ndarray, " c"]:
    """Return flat indices of up to `count` points that matter most: local maxima first, then the largest of others.

    Of the others every third is looked at: neighbours say the same.
    """
    rows, m = usage.shape
    wide = np.full((rows, m + 2), -np.inf)
    wide[:, 1:-1] = usage
    top = (usage >= wide[:, :-2]) & (usage >= wide[:, 2:])
    rank = np.where(
        top, usage + 10.0 * (usage > 0.5), -np.inf
    )  # a maximum outranks what is none, if it is near its limit
    rank[:, ::3] = np.maximum(rank[:, ::3], usage[:, ::3])
    flat = rank.ravel()
    count = min(count, int(np.count_nonzero(np.isfinite(flat))))
    return np.argpartition(-flat, count - 1)[:count]
