r"""The law as it runs: one step a sample, with the motor's current limit and anti-windup.

State space
-----------
C_r and C_y become one system with two inputs, of least order, in coordinates that single precision can hold. With
:math:`\delta = 1 - q`, every denominator is :math:`\delta^m R(q)`, R without a root at 1, and the m integrators split
off exactly: with X the first m terms of the Taylor series of N/R at :math:`\delta = 0`,

.. math:: \frac{N}{\delta^m R} = \frac{X(\delta)}{\delta^m} + \frac{Y(q)}{R(q)}, \qquad Y = \frac{N - X R}{\delta^m}

and in :math:`w = 1/(z - 1)`, where :math:`1/\delta = 1 + w`, the first part is :math:`g_0 + g_1 w + \dots + g_m w^m`:
a chain of m accumulators whose poles are 1 to the last bit. The rest is balanced (Moore, IEEE Trans. Automatic
Control 26(1), 1981): controllability and observability Gramians are equal and diagonal, which keeps rounding noise
low (Mullis, Roberts, IEEE Trans. Circuits and Systems 23(9), 1976), and states that C_r and C_y share, or that
nothing drives, show as Hankel singular values of zero and are left out.

Anti-windup
-----------
.. math::
    u &= C x + D_r r - D_y y, \qquad x^+ = A x + B_r r - B_y y + K (\mathrm{sat}(u) - u)

K does nothing until the current saturates. While it does, the state moves with :math:`A - K C`: K is chosen so that
the poles of the m integrators go from 1 to :math:`\lambda = T_t/(T_t + T_s)`, and the others stay:
:math:`K_j = \binom{m}{j} (1-\lambda)^j` on the chain and zero elsewhere. For one integrator that is back-calculation
with the tracking time constant T_t (Astrom, Hagglund, PID Controllers, 2nd ed., ISA 1995, integrator windup). Theirs
is T_i for a PI, and :math:`\sqrt{T_i T_d}` with a derivative. The feedforward of these laws makes another one right.
At rest at the limit, with a reference that is out of reach by e,
:math:`u - \mathrm{sat}(u) = (k_\mathrm{ff} + k_p) e + x_I` and :math:`\dot x_I = k_i e - (u - \mathrm{sat}(u))/T_t`,
so that the integrator rests at zero, and the law returns from saturation as if it had been given the reference that
is in reach (Hanus, Kinnaert, Henrotte, Automatica 23(6), 1987), for

.. math:: T_t = \frac{k_\mathrm{ff} + k_p}{k_i}, \qquad \text{in general } T_s \frac{a_1}{a_0} \text{ of }
          C_r = a_0 \delta^{-m} + a_1 \delta^{1-m} + \dots

the default (a sample at least), which is T_i where there is no feedforward.

A disturbance observer, :math:`u = v + Q (\mathrm{sat}(u) - P_n^{-1} y)`, has to see the saturated command, not its
own. Here it does: unsaturated, :math:`u = (v - Q P_n^{-1} y)/(1 - Q)` integrates, since Q = 1 at 0 Hz, and the
saturated law differs from it by sat(u) - u at the input of Q, which is a K. For :math:`Q = (1-\lambda)/(z - \lambda)`
that K is :math:`1 - \lambda`: this module's, with T_t the time constant of Q, and since
:math:`1/(1-Q) = (1 - \lambda q)/(1-q)`, that is the default too. For Q of higher order K moves the integrator alone;
the other poles of 1/(1 - Q), about as fast as Q, stay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from seaopt.control.controller import Controller
from seaopt.control.law import TransferFunction
from seaopt.errors import ControlError

Vector = Float[np.ndarray, " n"]
AT_ONE = 1e-12  # a denominator this small at q = 1, against its coefficients, has a root there
NEGLIGIBLE = 1e-13  # Hankel singular values below this share of the law's gain are rounding
VANISHED = 1e-18  # a power of A this small adds nothing to a Gramian


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LawState:
    """What a running law remembers.

    Parameters
    ----------
    x : array, shape (n,)
        State.
    current_A : float
        The last command.
    held : int
        Samples in a row that were not used because a number in them was not finite.

    """

    x: Vector
    current_A: float = 0.0
    held: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunnableLaw:
    """F = c x + d_reference r - d_measurement y, x+ = a x + b_reference r - b_measurement y + anti_windup (sat(F) - F).

    Parameters
    ----------
    a, b_reference, b_measurement, c, d_reference, d_measurement
        Matrices, shapes (n, n), (n,), (n,), (n,) and numbers; the first `integrators` states are the integrators.
    anti_windup : array, shape (n,)
        K of the module's docstring.
    integrators : int
        How many poles at z = 1.
    tracking_time_s : float or None
        T_t; None where nothing integrates.
    sample_time_s : float
        Seconds.
    current_per_force_A_per_N : float
        The command is this times F.
    current_limit_A : float
        The command's largest magnitude; infinite where there is no limit.

    """

    a: Float[np.ndarray, "n n"]
    b_reference: Vector
    b_measurement: Vector
    c: Vector
    d_reference: float
    d_measurement: float
    anti_windup: Vector
    integrators: int
    tracking_time_s: float | None
    sample_time_s: float
    current_per_force_A_per_N: float
    current_limit_A: float

    @property
    def force_limit_N(self) -> float:
        """The motor force at the current limit."""
        return self.current_limit_A / self.current_per_force_A_per_N

    def rest(self) -> tuple[Vector, Vector]:
        """Return x per reference and per measurement (counted negative) at rest, integrators zero."""
        m, n = self.integrators, self.c.size
        out = np.zeros((2, n))
        inner = np.eye(n - m) - self.a[m:, m:]
        out[:, m:] = np.linalg.solve(inner, np.column_stack([self.b_reference[m:], self.b_measurement[m:]])).T
        return out[0], out[1]

    def reset(self, reference: float = 0.0, measurement: float = 0.0, current_A: float = 0.0) -> LawState:
        """Return the state at rest under constant inputs, with the integrator set to continue from a current.

        A law without integrator has no such freedom: its next command follows from the inputs alone.

        Raises
        ------
        ControlError
            An input is not finite, or the current is above the limit.

        """
        if not (math.isfinite(reference) and math.isfinite(measurement)):
            raise ControlError(f"reference = {reference:g}, measurement = {measurement:g}: give finite numbers")
        if not abs(current_A) <= self.current_limit_A:
            raise ControlError(f"current_A = {current_A:g} is above the limit of {self.current_limit_A:g} A; lower it")
        per_reference, per_measurement = self.rest()
        x = per_reference * reference - per_measurement * measurement
        if self.integrators:
            force = float(self.c @ x) + self.d_reference * reference - self.d_measurement * measurement
            x[0] = current_A / self.current_per_force_A_per_N - force
        return LawState(x=x, current_A=current_A)

    def step(self, state: LawState, reference: float, measurement: float) -> tuple[float, LawState]:
        """Return the current (A) to command at this sample, and the next state.

        A sample with a number that is not finite, in its inputs or in what would follow, is not used: the last command
        is held, the state stays, and `held` counts.
        """
        with np.errstate(all="ignore"):
            force = float(self.c @ state.x) + self.d_reference * reference - self.d_measurement * measurement
            applied = min(max(force, -self.force_limit_N), self.force_limit_N)
            x = self.a @ state.x + self.b_reference * reference - self.b_measurement * measurement
            x += self.anti_windup * (applied - force)
        if not (math.isfinite(force) and np.all(np.isfinite(x))):
            return state.current_A, LawState(x=state.x, current_A=state.current_A, held=state.held + 1)
        current = applied * self.current_per_force_A_per_N
        current = min(max(current, -self.current_limit_A), self.current_limit_A)  # a limit to the last bit
        return current, LawState(x=x, current_A=current)

    def run(
        self,
        references: Float[np.ndarray, " samples"],
        measurements: Float[np.ndarray, " samples"],
        state: LawState | None = None,
    ) -> tuple[Float[np.ndarray, " samples"], LawState]:
        """Return the currents (A) of a sequence of samples, and the last state; it starts from zero if not given."""
        state = self.reset() if state is None else state
        out = np.zeros(references.size)
        for i, (reference, measurement) in enumerate(zip(references, measurements, strict=True)):
            out[i], state = self.step(state, float(reference), float(measurement))
        return out, state


def runnable(
    controller: Controller, *, current_limit_A: float | None = None, tracking_time_s: float | None = None
) -> RunnableLaw:
    """Return a controller's law ready to run.

    Parameters
    ----------
    controller : Controller
        As tuned or read.
    current_limit_A : float, optional
        The specification's if left out; infinite where neither is given.
    tracking_time_s : float, optional
        T_t of the anti-windup; the module's docstring has the default.

    Raises
    ------
    ControlError
        As `realise`.

    Examples
    --------
    >>> import seaopt as so
    >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)
    >>> law = runnable(so.tune(so.plants.high_impedance(), so.plants.thor(), spec))
    >>> current, state = law.step(law.reset(), reference=5000.0, measurement=0.0)
    >>> round(current, 6)
    9.0

    """
    limit = controller.spec.current_limit_A if current_limit_A is None else current_limit_A
    return realise(
        controller.reference,
        controller.measurement,
        sample_time_s=controller.sample_time_s,
        current_per_force_A_per_N=controller.current_per_force_A_per_N,
        current_limit_A=limit,
        tracking_time_s=tracking_time_s,
    )


def realise(
    reference: TransferFunction,
    measurement: TransferFunction,
    *,
    sample_time_s: float,
    current_per_force_A_per_N: float = 1.0,
    current_limit_A: float | None = None,
    tracking_time_s: float | None = None,
) -> RunnableLaw:
    """Return F = C_r F_ref - C_y F_meas as a state-space law of least order with limit and anti-windup.

    Parameters
    ----------
    reference, measurement : TransferFunction
        C_r and C_y, of any order.
    sample_time_s : float
        Seconds.
    current_per_force_A_per_N : float
        A/N.
    current_limit_A : float, optional
        None: no limit.
    tracking_time_s : float, optional
        T_t; the module's docstring has the default.

    Raises
    ------
    ControlError
        A number is out of range, or the law by itself is unstable other than by integrators.

    """
    for name, value in (
        ("sample_time_s", sample_time_s),
        ("current_per_force_A_per_N", current_per_force_A_per_N),
        ("current_limit_A", current_limit_A),
        ("tracking_time_s", tracking_time_s),
    ):
        if value is not None and not value > 0.0:
            raise ControlError(f"{name} = {value:g} is not positive; give a positive number")
    parts = [_split(name, tf) for name, tf in (("reference", reference), ("measurement", measurement))]
    m = max(part.chain.size for part in parts)
    gains = np.zeros((m, 2))
    for column, part in enumerate(parts):
        gains[: part.chain.size, column] = part.chain
    through = (float(reference.num[0]), float(measurement.num[0]))
    a, b, c = _balanced(*_common(parts), max(map(abs, through)))
    tracking = _tracking(parts, sample_time_s) if tracking_time_s is None and m else tracking_time_s
    share = sample_time_s / (tracking + sample_time_s) if tracking is not None else 0.0
    b = np.vstack([gains, b])
    return RunnableLaw(
        a=np.asarray(block_diag(np.eye(m) + np.eye(m, k=1), a)),
        b_reference=b[:, 0].copy(),
        b_measurement=b[:, 1].copy(),
        c=np.concatenate([np.eye(1, m)[0], c]),
        d_reference=through[0],
        d_measurement=through[1],
        anti_windup=np.array([math.comb(m, j) * share**j for j in range(1, m + 1)] + [0.0] * c.size),
        integrators=m,
        tracking_time_s=tracking if m else None,
        sample_time_s=sample_time_s,
        current_per_force_A_per_N=current_per_force_A_per_N,
        current_limit_A=math.inf if current_limit_A is None else current_limit_A,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Part:
    """A transfer function taken apart: g_1 ... g_m, Y, R, and the first m + 2 terms of the series of N/R."""

    chain: Float[np.ndarray, " m"]
    rest: Float[np.ndarray, " _"]
    den: Float[np.ndarray, " _"]
    series: Float[np.ndarray, " _"]


def _split(name: str, tf: TransferFunction) -> _Part:
    """Take a transfer function apart as the module's docstring does, m as small as the numerator lets it be."""
    num, den, m = tf.num.astype(float), np.trim_zeros(tf.den.astype(float), "b"), 0
    if not (np.all(np.isfinite(num)) and np.all(np.isfinite(den)) and tf.den[0] == 1.0):
        raise ControlError(f"{name}: num or den has a number that is not finite, or den[0] is not 1; tune again")
    while den.size > 1 and _at_one(den):
        den, m = np.cumsum(den)[:-1], m + 1
        if num.size > 1 and _at_one(num):
            num, m = np.cumsum(num)[:-1], m - 1
    series = _taylor(num, den, m + 2)
    chain = np.zeros(m + 1)  # the coefficients of w^0 ... w^m in X / delta^m, with 1/delta = 1 + w
    for power, value in zip(range(m, 0, -1), series, strict=False):
        chain[: power + 1] += value * np.array([math.comb(power, i) for i in range(power + 1)])
    removed = np.convolve(_flipped(series[:m]), den) if m else np.zeros(1)
    rest = np.zeros(max(num.size, removed.size, m + 1))
    rest[: num.size] = num
    rest[: removed.size] -= removed
    for _ in range(m):
        rest = np.cumsum(rest)[:-1]
    return _Part(chain=chain[1:], rest=rest, den=den, series=series)


def _common(parts: list[_Part]) -> tuple[list[Float[np.ndarray, " _"]], Float[np.ndarray, " _"]]:
    """Return both Y over one R."""
    one, other = parts
    if np.array_equal(one.den, other.den):
        return [one.rest, other.rest], one.den
    return [np.convolve(one.rest, other.den), np.convolve(other.rest, one.den)], np.convolve(one.den, other.den)


def _at_one(polynomial: Float[np.ndarray, " n"]) -> bool:
    return bool(abs(np.sum(polynomial)) <= AT_ONE * np.sum(np.abs(polynomial)))


def _flipped(polynomial: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the coefficients in 1 - q of a polynomial in q, or the other way."""
    out = np.zeros(polynomial.size)
    for value in polynomial[::-1]:  # Horner's rule; the last coefficient shifted out is zero
        out = out - np.concatenate([[0.0], out[:-1]])
        out[0] += value
    return out


def _taylor(num: Float[np.ndarray, " n"], den: Float[np.ndarray, " k"], terms: int) -> Float[np.ndarray, " terms"]:
    """Return the first terms of num/den in powers of 1 - q."""
    top, bottom = (np.concatenate([_flipped(p), np.zeros(terms)]) for p in (num, den))
    out = np.zeros(terms)
    for j in range(terms):
        out[j] = (top[j] - np.dot(out[:j], bottom[j:0:-1])) / bottom[0]
    return out


def _tracking(parts: list[_Part], sample_time_s: float) -> float:
    """Return T_s abs(a_1/a_0) of C_r, of C_y where the reference is not integrated; a sample at least."""
    most = max(part.chain.size for part in parts)
    a_0, a_1 = next(part.series for part in parts if part.chain.size == most)[:2]
    return sample_time_s * max(abs(float(a_1 / a_0)), 1.0)


def _balanced(
    numerators: list[Float[np.ndarray, " _"]], den: Float[np.ndarray, " k"], gain: float
) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, "m 2"], Float[np.ndarray, " m"]]:
    """Return a balanced realisation of least order of two transfer functions over one denominator, each of its input.

    What is below `NEGLIGIBLE` of `gain`, or of the largest Hankel singular value, is rounding.
    """
    n = max(p.size for p in (*numerators, den)) - 1
    column = np.pad(den, (0, n + 1 - den.size))[1:]
    a, c = np.eye(n, k=1), np.eye(1, n)[0]
    a[:, :1] -= column[:, None]
    b = np.column_stack([np.pad(p, (0, n + 1 - p.size))[1:] - p[0] * column for p in numerators])
    if not c.size:
        return a, b, c
    radius = float(np.max(np.abs(np.linalg.eigvals(a))))
    if radius >= 1.0:
        raise ControlError(f"the law has a pole at |z| = {radius:.9g} besides its integrators; tune a stable one")
    reach, show = _factor(a, b), _factor(a.T, c[:, None])
    left, hankel, right = np.linalg.svd(show.T @ reach)
    kept = hankel > NEGLIGIBLE * max(float(hankel[0]), gain)
    root = np.sqrt(hankel[kept])
    into, back = reach @ right[kept].T / root, (show @ left[:, kept] / root).T
    return back @ a @ into, back @ b, c @ into


def _factor(a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n _"]) -> Float[np.ndarray, "n n"]:
    """Return G with G G' = the sum of a^k b b' a^k' over k >= 0, never squared: small directions keep their digits."""

    def triangle(wide: Float[np.ndarray, "n _"]) -> Float[np.ndarray, "n n"]:
        return np.asarray(np.linalg.qr(wide.T, mode="r")).T

    g = triangle(np.hstack([b, np.zeros(a.shape)]))
    while np.linalg.norm(a) > VANISHED:
        g, a = triangle(np.hstack([g, a @ g])), a @ a
    return g
