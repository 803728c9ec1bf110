r"""A control law as one discrete state space, from (reference, measured) to effort, with what integrates kept apart.

.. math:: x^+ = A x + B \begin{bmatrix} r \\ y \end{bmatrix}, \qquad
          u = C x + D \begin{bmatrix} r \\ y \end{bmatrix} = C_r r - C_y y .

y may be several signals, the first the regulated one: :math:`C_y y = \sum_i C_i y_i`.

The first m states are a chain of accumulators, :math:`x_j^+ = x_j + x_{j+1} + \dots`, read at its head:

.. math:: u = \sum_{j=1}^{m} g_j w^j + \text{(a stable remainder)}, \qquad w = \frac{1}{z-1},

with :math:`g_j` the j-th row of B. Its poles are 1 to the last bit, however many they are, and the loop comes to rest
where :math:`g_m` says: at a force equal to its reference exactly if the two columns' :math:`g_m` are equal but for
their sign. Multiplied out as polynomials a double pole at 1 is known to the root of rounding only, and the DC gain of
what stands beside it to :math:`\epsilon/\prod|1 - p_i|`, which at a few kHz is percents.

Responses use :math:`z - 1` itself and a complex Schur form of the remainder, by back substitution for all frequencies
at once, so that they keep their digits down to 0 Hz.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Complex, Float
from numpy.polynomial.polynomial import polypow

from seaopt.control.loops.minimal import (
    NEAR_ONE,
    RESPONSE_TOLERANCE,
    balance,
    build_chain,
    has_response,
    read_companion,
    realise_remainder,
    refuse_slow_poles,
    split,
    split_integrators,
)
from seaopt.control.loops.transfer_function import Frequencies, Response, TransferFunction
from seaopt.control.systems.block import (
    COMMAND,
    EFFORT,
    OUTSIDE,
    REFERENCE,
    Block,
    connect,
    name_readings,
    subtract_last,
)
from seaopt.control.systems.resolvent import Resolvent
from seaopt.errors import ControlError
from seaopt.formatting import format_count
from seaopt.records import record
from seaopt.signals import ComplexN, MatrixNN, VectorK, VectorN

SLOW_LAG = 1e-3  # distance from 1 of a pole that may have been meant to be an integrator
SAME_POLE = 1e-3  # to which poles that are equal are computed
NO_COEFFICIENT = 1e-7  # of a polynomial that begins with 1: what rounding leaves of some twenty poles at zero is below
if TYPE_CHECKING:
    import control

TINY = 1e-300
LOWEST = 1e-4  # of the sample rate: from here on a law with integrators set apart has the response it was given with
ROUNDED = 1e-8  # of the largest response at higher frequencies: what is less at a zero is rounding
SAME_RESPONSE = 1e-3  # as a share of it: at `LOWEST` a pole moved by 6e-7 does as much
EQUAL_GAINS = 1e-9  # integrals of reference and measurement that differ by less are one of the error
NEAREST_TO_ONE = 1e-17  # abs(z - 1) at least: an integrator's response at 0 Hz is large instead of infinite


@record(eq=False)
class Law:
    """x+ = a x + b (r, y), u = c x + d (r, y): a control law from its reference and what it measures to an effort.

    Parameters
    ----------
    a, b, c, d
        Matrices, shapes (n, n), (n, 1 + measured), (n,) and (1 + measured,).
    sample_time_s : float
        Seconds.

    Examples
    --------
    >>> pi = Law.from_transfer_functions(
    ...     *2 * [TransferFunction(num=np.array([2.5, -1.5]), den=np.array([1.0, -1.0]))], sample_time_s=1e-3
    ... )
    >>> pi.integrators, pi.b.tolist(), pi.d.tolist()
    (1, [[1.0, -1.0]], [2.5, -2.5])
    """

    a: MatrixNN
    b: Float[np.ndarray, "n k"]
    c: VectorN
    d: VectorK
    sample_time_s: float

    @property
    def integrators(self) -> int:
        """How many of the first states are the chain of accumulators."""
        return _count_integrators(self)

    @property
    def block(self) -> Block:
        """The law with named signals; its effort is a part of the command, which may have others."""
        rows = np.ones((2, 1))
        inputs = (REFERENCE, *name_readings(self.d.size - 1))
        return Block(a=self.a, b=self.b, c=rows * self.c, d=rows * self.d, inputs=inputs, outputs=(EFFORT, COMMAND))

    @classmethod
    def of(cls, block: Block, sample_time_s: float) -> Law:
        """Return the law of a block from the reference and what is measured, in order, to an effort."""
        return cls(a=block.a, b=block.b, c=block.c[0], d=block.d[0], sample_time_s=sample_time_s)

    def connected(self, blocks: Sequence[Block], inputs: Sequence[str]) -> Law:
        """Return the law that this one and blocks around it make, of some signals: reference first, then readings."""
        return Law.of(connect([self.block, *blocks], inputs, [EFFORT]), self.sample_time_s)

    @property
    def remainder(self) -> tuple[Float[np.ndarray, "l l"], Float[np.ndarray, "l k"], Float[np.ndarray, " l"]]:
        """A, B and C of what does not integrate."""
        m = self.integrators
        return self.a[m:, m:], self.b[m:], self.c[m:]

    @property
    def static_remainder(self) -> VectorK:
        """The part that does not integrate, at 0 Hz: effort per reference and per measured signal."""
        a, b, c = self.remainder
        return self.d + c @ np.linalg.solve(np.eye(c.size) - a, b)

    @property
    def poles(self) -> ComplexN:
        """The eigenvalues of `a`, those of the chain exactly 1."""
        return np.concatenate([np.ones(self.integrators), np.linalg.eigvals(self.remainder[0])]).astype(complex)

    def responses(self, f: Frequencies) -> Complex[np.ndarray, "k m"]:
        """Return u per reference and per measured signal at frequencies in Hz; very large at 0 where it integrates."""
        return self.evaluate(np.expm1(2j * np.pi * f * self.sample_time_s))

    def reference_response(self, f: Frequencies) -> Response:
        """Return C_r at frequencies in Hz."""
        return self.responses(f)[0]

    def measurement_response(self, f: Frequencies) -> Response:
        """Return C_y of the first measured signal at frequencies in Hz."""
        return -self.responses(f)[1]

    def feedback_responses(self, f: Frequencies) -> Complex[np.ndarray, "y m"]:
        """Return C_y of every measured signal at frequencies in Hz."""
        return -self.responses(f)[1:]

    def evaluate(self, from_one: Response) -> Complex[np.ndarray, "k m"]:
        """Return u per reference and per measured signal at z = 1 + from_one."""
        m, resolvent = _factorise(self)
        distance = np.where(np.abs(from_one) < NEAREST_TO_ONE, NEAREST_TO_ONE, from_one)
        out = np.repeat(self.d[:, None], from_one.size, axis=1).astype(complex)
        power = np.ones_like(distance)
        for row in self.b[:m]:
            power = power / distance
            out += np.multiply.outer(row, power)
        apart = from_one + (1.0 - resolvent.poles[:, None])
        return out + resolvent.read(resolvent.solve(apart, resolvent.right[:, :, None]))[:, 0]

    def balanced(self) -> Law:
        """Return the same law with what does not integrate balanced and of least order; as it is if that hardly decays.

        Balanced, controllability and observability Gramians are equal and diagonal, which keeps rounding noise low, so
        that single precision can hold the states (`seaopt.control.loops.minimal`).
        """
        m, block = self.integrators, self.remainder
        if not block[2].size or np.max(np.abs(np.linalg.eigvals(block[0]))) >= 1.0:
            return self
        try:
            balanced = balance(*block, float(np.max(np.abs(self.d))))
        except np.linalg.LinAlgError:  # so close to the unit circle that rounding makes a Gramian infinite
            return self
        return Law(**build_chain(self.b[:m], *balanced), d=self.d, sample_time_s=self.sample_time_s)

    def transfer_functions(self) -> tuple[TransferFunction, ...]:
        """Return C_r and each C_y multiplied out over one denominator, for reading: they say less than the law does."""
        m, (a, b, c) = self.integrators, self.remainder
        powers = [polypow([1.0, -1.0], k) for k in range(m + 1)]  # of 1 - q
        slow = np.real(np.poly(a)) if c.size else np.ones(1)
        out: list[TransferFunction] = []
        for column, sign in enumerate([1.0] + [-1.0] * (self.d.size - 1)):
            over = (np.real(np.poly(a - np.outer(b[:, column], c))) - slow) if c.size else np.zeros(1)
            num = np.convolve(powers[m], over + self.d[column] * slow)
            for j, gain in enumerate(self.b[:m, column], start=1):  # gain q^j (1 - q)^(m - j)
                num += gain * np.convolve(np.concatenate([np.zeros(j), powers[m - j]]), slow)
            out.append(TransferFunction(num=sign * num, den=np.convolve(powers[m], slow)))
        return tuple(out)

    def to_control(self) -> control.StateSpace:
        """Return the law as python-control's `StateSpace`, inputs reference and measured, output effort."""
        import control  # deferred: slow to import

        measured = ["measured"] if self.d.size == 2 else [f"measured{i}" for i in range(1, self.d.size)]
        names: dict[str, Any] = {"inputs": ["reference", *measured], "outputs": ["effort"], "name": "law"}
        return control.StateSpace(self.a, self.b, self.c[None], self.d[None], self.sample_time_s, **names)

    def to_dict(self) -> dict[str, Any]:
        """Return A, B, C and D as matrices, for JSON."""
        return {"A": self.a, "B": self.b, "C": self.c[None], "D": self.d[None]}

    @classmethod
    def from_state_space(
        cls, a: MatrixNN, b: Float[np.ndarray, "n k"], c: VectorN, d: VectorK, sample_time_s: float
    ) -> Law:
        """Return the balanced law of a state space in any coordinates, with what integrates set apart.

        Poles nearer to 1 than 1e-6 are integrators, two at most, where the response from 1e-4 of the sample rate on
        stays the same, to 0.1 %. Of a companion form the coefficients are read. A law without such poles, or whose slow
        poles rounding does not tell from them, has no integrators, and no anti-windup acts on it.

        Raises
        ------
        ControlError
            Shapes do not fit, or a number is not finite.

        Examples
        --------
        >>> pi = Law.from_state_space(
        ...     np.array([[1.0]]), np.array([[2.0, -2.0]]), np.array([0.5]), np.array([2.5, -2.5]), sample_time_s=1e-3
        ... )
        >>> pi.integrators, pi.b.tolist()
        (1, [[1.0, -1.0]])
        """
        a, b, c, d = (np.asarray(part, dtype=float) for part in (a, b, c, d))
        n, k = c.size, d.size
        if a.shape != (n, n) or b.shape != (n, k) or c.shape != (n,) or d.shape != (k,) or k < 2:
            raise ControlError(
                f"law: A, B, C and D have the shapes {a.shape}, {b.shape}, {c.shape} and {d.shape}; give (n, n), "
                "(n, 2), (n,) and (2,), the columns being reference and measured, or one more for each further signal"
            )
        if not all(np.all(np.isfinite(part)) for part in (a, b, c, d)):
            raise ControlError("law: A, B, C or D has a number that is not finite; correct it")
        return cls(a=a, b=b, c=c, d=d, sample_time_s=sample_time_s).set_apart()

    def set_apart(self) -> Law:
        """Return the law balanced, with what integrates set apart, as `from_state_space` does."""
        fractions = read_companion(self.a, self.b, self.c, self.d)
        if fractions:  # whose coefficients tell a root at 1 from one next to it, where eigenvalues do not
            reference, *measurements = fractions
            with suppress(ControlError):
                paths = [replace(path, num=-path.num) for path in measurements]
                return Law.from_transfer_functions(reference, paths, self.sample_time_s)
        return _set_apart(self)

    @classmethod
    def from_control(cls, system: Any) -> Law:
        """Return the law of a python-control system: discrete, u = G(z) (r - y), or with the inputs r and y of its own.

        Parameters
        ----------
        system : control.TransferFunction or control.StateSpace
            With a sample time. Of one input it acts on the error r - y; of two and more, they are the reference and
            what is measured, the latter with their own signs (`to_control`).

        Raises
        ------
        ControlError
            It is none of these.

        Examples
        --------
        >>> import control
        >>> Law.from_control(control.tf([2.5, -1.5], [1.0, -1.0], 1e-3)).d.tolist()
        [2.5, -2.5]
        """
        import control  # deferred: slow to import

        if not isinstance(system, control.TransferFunction | control.StateSpace):
            raise ControlError(
                f"law is a {type(system).__name__}; give a python-control transfer function or state space"
            )
        ts = system.dt
        if ts is None or isinstance(ts, bool) or not ts > 0.0:
            raise ControlError(f"law has dt = {ts}; sample it first: control.sample_system(law, sample_time_s)")
        if system.noutputs != 1 or system.ninputs < 1:
            raise ControlError(
                f"law has {system.ninputs} inputs and {system.noutputs} outputs; give one output, and the error or "
                "(reference, measured) as inputs"
            )
        if isinstance(system, control.TransferFunction):
            first, *inputs = (_in_delay(num, den) for num, den in zip(system.num[0], system.den[0], strict=True))
            paths = [replace(path, num=-path.num) for path in inputs] or [first]
            return cls.from_transfer_functions(first, paths, float(ts))
        b, d = np.asarray(system.B), np.asarray(system.D)[0]
        if system.ninputs == 1:
            b, d = np.hstack([b, -b]), np.concatenate([d, -d])
        return cls.from_state_space(np.asarray(system.A), b, np.asarray(system.C)[0], d, float(ts))

    def differenced(self, column: int) -> Law:
        r"""Return the law that reads a position where this one reads its speed, in a column of b.

        An encoder gives positions, and a drive has the speed from two of them a sample apart,
        :math:`v_k = (\theta_k - \theta_{k-1})/T_s`: half a sample late, and rounded to one step of the encoder per
        sample. As a part of the law that is in every figure and every simulation.
        """
        inputs = list(self.block.inputs)
        speed, inputs[column] = inputs[column], OUTSIDE
        return self.connected([subtract_last(OUTSIDE, speed, gain=1.0 / self.sample_time_s)], inputs).set_apart()

    def reading(self, feedback: TransferFunction) -> Law:
        """Return the law u - C(q) y that reads one signal more, in a last column of b."""
        return self.connected([feedback.block(OUTSIDE, EFFORT, -1.0)], [*self.block.inputs, OUTSIDE])

    def behind(self, part: TransferFunction) -> Law:
        """Return the law whose reference is behind a filter."""
        return self.connected([part.block(OUTSIDE, REFERENCE)], [OUTSIDE, *self.block.inputs[1:]])

    def scaled(self, factor: float) -> Law:
        """Return the law with its output times a factor; the chain is read as before."""
        return replace(self, b=self.b * factor, d=self.d * factor)

    @classmethod
    def from_transfer_functions(
        cls,
        reference: TransferFunction,
        measurement: TransferFunction | Sequence[TransferFunction],
        sample_time_s: float,
    ) -> Law:
        """Return the balanced law u = C_r r - C_y y of transfer functions, one C_y for each measured signal.

        Raises
        ------
        ControlError
            A coefficient is not finite, den[0] is not 1, or slow poles lie so close together that double precision does
            not tell them from integrators.

        Examples
        --------
        >>> lag = TransferFunction(num=np.array([0.5]), den=np.array([1.0, -0.5]))
        >>> Law.from_transfer_functions(lag, lag, sample_time_s=1e-3).c.size
        1
        """
        measurements = [measurement] if isinstance(measurement, TransferFunction) else list(measurement)
        paths_by_name = {"reference": reference} | {
            f"measurement {number}" if len(measurements) > 1 else "measurement": path
            for number, path in enumerate(measurements, start=1)
        }
        parts = [split(name, tf) for name, tf in paths_by_name.items()]
        m = max(gains.size for gains, _, _ in parts)
        chain = np.zeros((m, len(parts)))
        for column, (gains, _, _) in enumerate(parts):
            chain[: gains.size, column] = gains
        sign = np.array([1.0] + [-1.0] * len(measurements))
        through = sign * np.array([tf.num[0] for tf in paths_by_name.values()], dtype=float)
        a, b, c = realise_remainder([part[1:] for part in parts])
        made = cls(**build_chain(chain * sign, a, b * sign, c), d=through, sample_time_s=sample_time_s)

        def find_wrong(law: Law) -> str | None:
            for i, (name, tf) in enumerate(paths_by_name.items()):
                if not has_response(tf, lambda f, i=i: sign[i] * law.responses(f)[i], sample_time_s):
                    return name
            return None

        balanced = made.balanced()  # which loses the small states beside those of a pole next to 1
        if find_wrong(balanced) is None:
            made = balanced
        elif wrong := find_wrong(made):
            raise refuse_slow_poles(wrong)
        near = np.any(np.abs(made.poles[m:] - 1.0) < NEAR_ONE)  # of coefficients with fewer digits
        return _set_apart(made) if near else made


def _set_apart(original: Law) -> Law:
    """Return a law balanced, with the poles next to 1 made integrators where its response stays the same."""
    slowest = np.abs(original.responses(np.array([LOWEST / original.sample_time_s]))[:, 0])
    for chain, a, b, c in split_integrators(original.a, original.b, original.c):
        law = replace(original, **build_chain(_settle(chain, slowest), a, b, c))
        for made in (law.balanced(), law):
            if _is_same(made, original, SAME_RESPONSE):
                return made
    balanced = original.balanced()
    return balanced if _is_same(balanced, original) else original


def _settle(chain: Float[np.ndarray, "m k"], slowest: VectorK) -> Float[np.ndarray, "l k"]:
    """Return a chain's gains without what rounding made: differences of two, and integrals of nothing. Those of
    reference and regulated signal are alike, or that of the reference zero, where only rounding parts them; a last
    integral is left out that is below rounding in the response at `LOWEST`, `slowest`.
    """
    out = chain.copy()
    while len(out) and np.all(np.abs(out[-1]) <= EQUAL_GAINS * slowest * (2 * np.pi * LOWEST) ** len(out)):
        out = out[:-1]
    for row in out:
        if abs(row[0] + row[1]) <= EQUAL_GAINS * abs(row[0]):
            row[1] = -row[0]
        elif abs(row[0]) <= EQUAL_GAINS * abs(row[1]):
            row[0] = 0.0
    return out


def _is_same(law: Law, original: Law, share: float = RESPONSE_TOLERANCE) -> bool:
    """Tell whether two laws have the same responses from `LOWEST` on, but for a share of them."""
    per_sample = np.geomspace(LOWEST, 0.49, 25)
    response, wanted = (side.responses(per_sample / law.sample_time_s) for side in (law, original))
    size = np.abs(wanted)
    above = np.maximum.accumulate(size[:, ::-1], axis=1)[:, ::-1]
    return bool(np.all(np.abs(response - wanted) <= share * size + ROUNDED * above + TINY))


def _in_delay(num: VectorN, den: Frequencies) -> TransferFunction:
    """Return a transfer function of z, descending powers, as one of q = 1/z."""
    num, den = np.trim_zeros(np.asarray(num, dtype=float), "f"), np.trim_zeros(np.asarray(den, dtype=float), "f")
    if num.size > den.size:
        raise ControlError("law has a higher power of z in its numerator than in its denominator; delay it")
    num = np.concatenate([np.zeros(den.size - num.size), num])
    return TransferFunction(num=num / den[0], den=den / den[0])


@lru_cache(maxsize=32)
def _count_integrators(law: Law) -> int:
    """Return the length of the longest chain of accumulators that the first states are, once for a law."""
    a, c = law.a, law.c
    n, m = c.size, 0
    for length in range(1, n + 1):
        if a[length - 1, length - 1] != 1.0:
            break
        rows = np.eye(length, n) + np.eye(length, n, k=1) * (np.arange(n) < length)
        alone = np.array_equal(a[:length], rows) and not np.any(a[length:, :length])
        if alone and np.array_equal(c[:length], np.eye(1, length)[0]):
            m = length
    return m


@lru_cache(maxsize=32)
def _factorise(law: Law) -> tuple[int, Resolvent]:
    """Return how many states integrate, and the resolvent of the remainder from output to inputs, once for a law."""
    a, b, c = law.remainder
    return law.integrators, Resolvent.of(a.T, c[:, None], b.T)


def count_filter_samples(law: Law) -> float:
    """Return the shortest time constant of a law, in samples, that can be a derivative's filter; infinite without one.
    Such a filter is a real pole between 0 and 1, T/(T + 1) of T samples. A pole at zero is a delay, as averages over
    samples have it, and a negative or complex one no lag at all.
    """
    # Poles at zero are computed apart from it, far apart where they are many; their polynomial still ends in zeros.
    polynomial = np.atleast_1d(np.poly(law.poles[law.integrators :])).real
    poles = np.roots(np.where(np.abs(polynomial) > NO_COEFFICIENT, polynomial, 0.0))
    lags = poles.real[(np.abs(poles.imag) < SAME_POLE) & (poles.real > SAME_POLE) & (poles.real < 1.0)]
    return float(np.min(lags / (1.0 - lags), initial=np.inf))


def find_integral_rate(law: Law) -> float:
    """Return k_i/(1 + k_p), rad/s, of a law: how fast its slowest integral acts; infinite without one. The gains are
    those of powers of 1/s, s = (2/T_s)(z - 1)/(z + 1): of two integrals it is the ratio of their gains.
    """
    m = law.integrators
    if not m:
        return np.inf
    last, before = -law.b[m - 1, 1], 1.0 - law.static_remainder[1] if m == 1 else -law.b[m - 2, 1]
    return float(last / (law.sample_time_s * (before - 0.5 * m * last)))


def describe_integrators(law: Law) -> str:
    """Return how many integrators a law has, or that it has none, with the lag that may have been meant to be one."""
    if law.integrators:
        return f"{format_count(law.integrators, 'integrator')}, on which anti-windup acts"
    slowest = float(np.max(np.real(law.poles), initial=0.0))
    lag = law.sample_time_s / (1.0 - slowest) if 1.0 - SLOW_LAG < slowest < 1.0 else None
    wound = "" if lag is None else f"; its lag of {lag:.3g} s is no integrator, and no anti-windup acts on it"
    return f"no integral: a constant disturbance leaves an error{wound}"
