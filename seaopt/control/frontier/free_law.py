r"""The best that any linear law could do on one plant under the same limits: what the tuned structure costs.

For a stable plant P, with hold and delay, the laws that make a stable loop are :math:`C_y = Q/(1 - PQ)` with Q stable
(Youla), and every limit on the loop is convex in Q:

.. math:: S = 1 - PQ, \quad T = PQ, \quad C_y S = Q, \qquad
    |S| \le M_s, \; |T| \le M_t, \; |2S - 1| \le 2/\alpha, \; |Q| \le N, \; |S| \le 1/\sqrt2 \; (f \le f_s),

as are the objectives, :math:`\int |S|\, d\ln f` and :math:`\max |Q|`. What the reference does, C_r of a law with two
degrees of freedom, is chosen apart and costs nothing here: its limits are left out. A law that integrates has
:math:`S = 0` at 0 Hz.

Q is a sum of Laguerre's functions (complete in the stable ones: more of them come as close as one likes), of slow
exponentials, and of the tuned law's own Q, so that the tuned law is among those compared. A modulus is the largest of
its parts in all directions, :math:`|z| = \max_\psi \mathrm{Re}\, e^{-j\psi} z`; a linear program has some directions at
some frequencies, those that its answer breaks are added until none is (Kelley's cutting planes), by the solver HiGHS.

The integral of abs(S) is taken interval by interval of the program's frequencies, u = ln f, and

.. math:: \int_I |S|\, du \ge \Big| \int_I S\, du \Big|,

a modulus of what is linear in Q, which the program takes in place of abs(S) at a frequency. It is less by the turning
of S within an interval, half the variance of its angle there, and never more, as a rule of trapezoids is where abs(S)
is convex.

**In which sense it is a bound.** A program with fewer directions and frequencies has a smaller optimum, and so has one
with these integrals: for laws of the `functions` counted the value is a lower bound, whether or not the last cuts
changed it, up to the rounding of quadrature and solver. For all laws it is the limit of many functions, from above, and
no bound; `seaopt.control.tuning.feasibility` has what is proved for all. With several plants it is a bound only:
those besides the design plant ask more of a tuned law, and here nothing of a free one. So do a passive band, a friction
margin, and the limits of a structure (the derivative's filter, the integral's rate).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control.laws.spec import LOWEST_HZ, ControllerSpec
from seaopt.control.loops.law import Law
from seaopt.control.loops.loop import GROWING, Loop
from seaopt.control.loops.peaks import HALF_POWER
from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.control.loops.transfer_function import Frequencies, Response
from seaopt.errors import ControlError
from seaopt.records import record

Coefficients = Float[np.ndarray, " n"]
FUNCTIONS = 40
SLOW_POLES = 12  # exponentials, from the slowest to the bandwidth
SLOWEST_HZ = 0.01
LAGUERRE_AT = 2.0  # times the bandwidth: the pole of Laguerre's functions
FREQUENCIES, EVEN = 130, 130  # of the program: in ratio below, and at even distances up to the Nyquist frequency
SLOW = 12  # of them below 0.1 Hz
OBJECTIVE_HZ = 0.1  # disturbances count from here
FIRST_DIRECTIONS = 6
MOST_CUTS = 30  # rounds
CUTS_AT_ONCE = 120  # of one limit
OPTIMAL, INFEASIBLE = 0, 2  # of linprog's status
LONGEST_S = 60.0  # of one linear program, which takes a third of a second
LEAST_SIZE = 1e-7  # of the largest combination of functions
TOLERANCE = 2e-4  # by which a modulus may be beyond its limit, or the objective beyond the program's
FINER = 7  # times as many frequencies, on which the answer's limits are looked at again
NODES = 7  # of Gauss and Legendre in every interval of the objective's integral


@record(eq=False)
class FreeLaw:
    """The best of the free laws.

    Parameters
    ----------
    status : {"optimal", "impossible", "unstable plant", "no answer"}
        Impossible: no law of as many functions keeps the limits. Of a plant that grows by itself nothing is computed.
    objective : str
        Which one it is.
    bound : float or None
        No law of the functions counted has less of the objective; None where there is none.
    missed : float or None
        By which share the law found is beyond a limit between the frequencies of the program: if that is small, a law
        with nearly this value exists.
    reached : float or None
        The objective of the law found, on many frequencies; never below the bound.
    functions : int
        Of which Q is a sum.
    frequencies : int
        Of the program.
    """

    status: Literal["optimal", "impossible", "unstable plant", "no answer"]
    objective: str
    bound: float | None = None
    reached: float | None = None
    missed: float | None = None
    functions: int = 0
    frequencies: int = 0


@record(eq=False)
class _Terms:
    """What Q is a sum of, and the plant, at frequencies."""

    f: Frequencies
    p: Response
    basis: Complex[np.ndarray, "m n"]

    def s(self, x: Coefficients) -> Response:
        """Return S."""
        return 1.0 - self.p * (self.basis @ x)


@record(eq=False)
class _Integral:
    """The integral over ln f of what is known at nodes, several in each interval: sums of `weights` times values."""

    terms: _Terms
    weights: Float[np.ndarray, "i k"]

    def add_up(self, values: Complex[np.ndarray, "m ..."]) -> Complex[np.ndarray, "i ..."]:
        """Return the integral of each interval."""
        shape = (*self.weights.shape, *values.shape[1:])
        return np.einsum("ik,ik...->i...", self.weights, values.reshape(shape))


@record(eq=False)
class _Modulus:
    """abs(constant + slope x) <= level at some of the frequencies."""

    constant: Complex[np.ndarray, " k"]
    slope: Complex[np.ndarray, "k n"]
    level: Float[np.ndarray, " k"]


def bound_free_law(
    plant: DigitalPlant, spec: ControllerSpec, laws: Sequence[Law] = (), *, functions: int = FUNCTIONS
) -> FreeLaw:
    """Return the best that a free linear law could do on a plant.

    Parameters
    ----------
    plant : DigitalPlant
        The design plant, with hold and delay; of one with friction the one that slides.
    spec : ControllerSpec
        Limits and objective; the reserve is not taken off.
    laws : sequence of Law
        Laws that are among those compared; those that make an unstable loop are left out.
    functions : int
        Laguerre's functions; with twice as many the bound is lower, by how much says how far it is from the limit.

    Raises
    ------
    ControlError
        `functions` is not 1 or more.

    Examples
    --------
    >>> import seaopt as so
    >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25)
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> tuned = so.tune(stand, thor, spec)
    >>> free = bound_free_law(tuned.plant(stand, thor), spec, [tuned.law])
    >>> free.status
    'optimal'
    """
    if isinstance(functions, bool) or not isinstance(functions, int) or functions < 1:
        raise ControlError(f"functions = {functions!r} is not a number of functions; give 1 or more")
    if np.max(np.abs(np.linalg.eigvals(plant.a)), initial=0.0) > GROWING:
        return FreeLaw(status="unstable plant", objective=spec.objective)
    stable = [law for law in laws if Loop(plant=plant, law=law).is_stable()]
    f = _place(spec)
    terms = _make_terms(plant, spec, stable, _add_rest(spec, f), functions)
    nodes, weights = _place_nodes(spec, f)
    integral = _Integral(terms=_make_terms(plant, spec, stable, nodes, functions), weights=weights)
    answer = _LinearProgram(spec, terms, integral).solve()
    if isinstance(answer, str):
        return FreeLaw(status=answer, objective=spec.objective, functions=terms.basis.shape[1], frequencies=f.size)
    value, x = answer
    fine = np.unique(np.concatenate([f, *(f[:-1] + share * np.diff(f) for share in np.arange(1, FINER) / FINER)]))
    reached, missed = _look_again(spec, _make_terms(plant, spec, stable, _add_rest(spec, fine), functions), integral, x)
    return FreeLaw(
        status="optimal",
        objective=spec.objective,
        bound=value,
        reached=reached,
        missed=missed,
        functions=terms.basis.shape[1],
        frequencies=f.size,
    )


def _place(spec: ControllerSpec) -> Frequencies:
    """Return the frequencies of the program, with the ends of all bands."""
    nyquist = 0.5 * spec.sample_rate_hz
    ends = [OBJECTIVE_HZ, spec.bandwidth_hz, spec.sensitivity_bandwidth_limit_hz or spec.bandwidth_hz]
    slow, base = np.geomspace(LOWEST_HZ, OBJECTIVE_HZ, SLOW), np.geomspace(OBJECTIVE_HZ, nyquist, FREQUENCIES)
    return np.unique(np.concatenate([slow, base, np.linspace(spec.bandwidth_hz, nyquist, EVEN), ends]))


def _add_rest(spec: ControllerSpec, f: Frequencies) -> Coefficients:
    """Return frequencies with 0 Hz before them where the law integrates."""
    return f if spec.structure == "pd" else np.concatenate([[0.0], f])


def _place_nodes(spec: ControllerSpec, f: Frequencies) -> tuple[Coefficients, Float[np.ndarray, "i k"]]:
    """Return the nodes and weights of the integral over ln f from 0.1 Hz to the bandwidth, of each interval a row."""
    u = np.log(f[(f >= OBJECTIVE_HZ * (1 - 1e-9)) & (f <= spec.bandwidth_hz * (1 + 1e-9))])
    at, share = np.polynomial.legendre.leggauss(NODES)
    middle, half = 0.5 * (u[1:] + u[:-1]), 0.5 * np.diff(u)
    return np.exp(middle[:, None] + half[:, None] * at).ravel(), half[:, None] * share


def _make_terms(
    plant: DigitalPlant, spec: ControllerSpec, laws: Sequence[Law], f: Frequencies, functions: int
) -> _Terms:
    """Return plant and functions at frequencies."""
    ts, z = plant.sample_time_s, np.exp(2j * np.pi * f * plant.sample_time_s)
    q = 1.0 / z
    a = np.exp(-2 * np.pi * min(LAGUERRE_AT * spec.bandwidth_hz, 0.2 / ts) * ts)
    columns = [np.sqrt(1.0 - a * a) / (1.0 - a * q)]
    for _ in range(functions - 1):
        columns.append(columns[-1] * (q - a) / (1.0 - a * q))
    slow = np.exp(-2 * np.pi * np.geomspace(SLOWEST_HZ, spec.bandwidth_hz, SLOW_POLES) * ts)
    columns += [(1.0 - pole) / (1.0 - pole * q) for pole in slow]
    p = plant.response(f)
    for law in laws:
        c = law.measurement_response(np.maximum(f, 1e-9))
        columns.append(c / (1.0 + p * c))
    return _Terms(f=f, p=p, basis=np.column_stack(columns))


def _orthogonalise(terms: _Terms) -> Float[np.ndarray, "n k"]:
    """Return the combinations of functions that differ at the frequencies, each of the same size. Many functions are
    nearly combinations of others, and a program in their coefficients cannot be solved.
    """
    both = np.concatenate([terms.basis / np.max(np.abs(terms.basis)), terms.p[:, None] * terms.basis])
    _, sizes, turns = np.linalg.svd(np.concatenate([np.real(both), np.imag(both)]), full_matrices=False)
    kept = sizes > LEAST_SIZE * sizes[0]
    return turns[kept].T / sizes[kept] * np.sqrt(terms.f.size)


class _LinearProgram:
    """The linear program, and the cuts it has so far."""

    def __init__(self, spec: ControllerSpec, terms: _Terms, integral: _Integral) -> None:
        self.spec, self.terms = spec, terms
        self.noise = spec.objective == "noise"
        m, self.turn = terms.f.size, _orthogonalise(terms)
        basis = terms.basis @ self.turn
        n = basis.shape[1]
        loop = -terms.p[:, None] * basis  # of S
        self.integrates = spec.structure != "pd"
        some = slice(1, None) if self.integrates else slice(None)
        ones = np.ones(m - self.integrates) + 0j
        self.limits = [
            _Modulus(constant=(offset + factor) * ones, slope=factor * loop[some], level=level)
            for offset, factor, level in _list_loop_limits(spec, terms.f[some])
        ]
        noise = spec.level("max_noise_gain")
        if noise is not None and not self.noise:
            self.limits.append(_Modulus(constant=np.zeros(m) + 0j, slope=basis, level=np.full(m, float(noise))))
        self.zero = loop[0].real if self.integrates else np.zeros(n)
        if self.noise:
            self.weights, self.owner = np.ones(1), np.zeros(m, dtype=int)
            self.aim = _Modulus(constant=np.zeros(m) + 0j, slope=basis, level=np.zeros(m))
        else:
            self.weights, objective = np.sum(integral.weights, axis=1), integral.terms
            mean = integral.add_up(-objective.p[:, None] * (objective.basis @ self.turn)) / self.weights[:, None]
            self.owner = np.arange(self.weights.size)
            self.aim = _Modulus(constant=np.ones(self.weights.size) + 0j, slope=mean, level=0.0 * self.weights)
        self.rows: list[Float[np.ndarray, "r v"]] = []
        self.ends: list[Float[np.ndarray, " r"]] = []

    def solve(self) -> tuple[float, Coefficients] | Literal["impossible", "no answer"]:
        """Return the optimum and the coefficients; or why there are none."""
        for psi in 2 * np.pi * np.arange(FIRST_DIRECTIONS) / FIRST_DIRECTIONS:
            for limit in (*self.limits, self.aim):
                chosen = np.arange(0, limit.level.size, 3)
                self._cut(limit, chosen, np.full(chosen.size, psi))
        n, t = self.turn.shape[1], self.weights.size
        x, bound = np.zeros(n), np.zeros(t)
        for _ in range(MOST_CUTS):
            answer = self._run(n, t)
            if isinstance(answer, str):
                return answer
            x, bound = answer[:n], answer[n:]
            if not self._add_cuts(x, bound):
                break
        return float(self.weights @ bound), self.turn @ x

    def _run(self, n: int, t: int) -> Float[np.ndarray, " v"] | Literal["impossible", "no answer"]:
        from scipy.optimize import linprog

        equal: dict[str, Any] = {}
        if self.integrates:
            equal = {"A_eq": np.concatenate([self.zero, np.zeros(t)])[None], "b_eq": [-1.0]}
        cost, rows, ends = np.concatenate([np.zeros(n), self.weights]), np.concatenate(self.rows), self.ends
        result: Any = None
        for method in ("highs-ds", "highs-ipm"):  # the simplex is quicker; where it loses its way, the other one
            result = linprog(
                cost,
                A_ub=rows,
                b_ub=np.concatenate(ends),
                bounds=[(None, None)] * n + [(0.0, None)] * t,
                method=method,
                options={"time_limit": LONGEST_S},
                **equal,
            )
            if result.status == OPTIMAL:
                return np.asarray(result.x)
        return "impossible" if result.status == INFEASIBLE else "no answer"

    def _add_cuts(self, x: Coefficients, bound: Float[np.ndarray, " t"]) -> bool:
        """Add the directions in which the answer breaks a limit, or its own objective; tell whether there are any."""
        added = False
        for limit in self.limits:
            value = limit.constant + limit.slope @ x
            beyond = np.flatnonzero(np.abs(value) > limit.level * (1.0 + TOLERANCE))
            if beyond.size:
                beyond = beyond[np.argsort(-np.abs(value[beyond]) / limit.level[beyond])][:CUTS_AT_ONCE]
                self._cut(limit, beyond, np.angle(value[beyond]))
                added = True
        value, total = self.aim.constant + self.aim.slope @ x, float(self.weights @ bound)
        short = np.abs(value) - bound[self.owner]
        if self.noise:
            beyond = np.flatnonzero(short > TOLERANCE * total)
        elif float(self.weights @ np.maximum(short, 0.0)) > TOLERANCE * total:
            beyond = np.flatnonzero(short > 0.0)
        else:
            beyond = np.zeros(0, dtype=int)
        if beyond.size:
            self._cut(self.aim, beyond, np.angle(value[beyond]))
        return added or bool(beyond.size)

    def _cut(self, limit: _Modulus, at: Any, psi: Float[np.ndarray, " k"]) -> None:
        """Add Re exp(-j psi) (constant + slope x) <= level, in units of the level."""
        turn, t = np.exp(-1j * psi), self.weights.size
        rows, ends = np.real(turn[:, None] * limit.slope[at]), limit.level[at] - np.real(turn * limit.constant[at])
        extra = np.zeros((psi.size, t))
        if limit is self.aim:
            extra[np.arange(psi.size), self.owner[at]] = -1.0
        else:
            rows, ends = rows / limit.level[at][:, None], ends / limit.level[at]
        self.rows.append(np.hstack([rows, extra]))
        self.ends.append(ends)


def _list_loop_limits(spec: ControllerSpec, f: Frequencies) -> list[tuple[float, float, Frequencies]]:
    """Return (offset, factor, level) of each limit on the loop: abs(offset + factor S) is at most the level."""
    ms, mt, disk = (spec.level(name) for name in ("max_sensitivity", "max_complementary", "min_disk_margin"))
    slow = f <= spec.sensitivity_bandwidth_limit_hz * (1.0 + 1e-9)
    limits = [(0.0, 1.0, np.minimum(np.where(slow, HALF_POWER, ms or np.inf), 1e3))]
    if mt is not None:
        limits.append((1.0, -1.0, np.full(f.size, float(mt))))
    if disk is not None:
        limits.append((-1.0, 2.0, np.full(f.size, 2.0 / disk)))
    return limits


def _look_again(spec: ControllerSpec, terms: _Terms, integral: _Integral, x: Coefficients) -> tuple[float, float]:
    """Return the objective, and by which share a limit is missed at most on many frequencies."""
    positive, q = terms.f > 0.0, terms.basis @ x
    s, noise = terms.s(x)[positive], spec.level("max_noise_gain")
    limits = _list_loop_limits(spec, terms.f[positive])
    usage = [float(np.max(np.abs(offset + factor * s) / level)) for offset, factor, level in limits]
    value = np.max(np.abs(q))
    if spec.objective != "noise":
        usage += [] if noise is None else [float(np.max(np.abs(q[positive])) / noise)]
        value = np.sum(integral.weights.ravel() * np.abs(integral.terms.s(x)))
    return float(value), max(0.0, *(used - 1.0 for used in usage))
