r"""Stability with friction that is compensated from the sampled motor speed, for every friction curve of a sector.

The compensation adds the effort :math:`c = \psi(s)` to the law's, s being the friction's velocity as the controller
has it, sampled or the difference of two samples of a position, and :math:`\psi` odd and monotone with a slope between
0 and :math:`\kappa_c`: fraction times Coulomb friction over the speed of its smoothing. That is positive feedback of a
speed, and its sign is what friction's is not. Seen from the friction efforts :math:`w = -\varphi(v)` at the aliases of
an angle (`seaopt.control.loops.absolute_stability`, whose symbols these are) and from c at its fundamental,

.. math::
    v &= G_v w + m\, S (c - C R w), \qquad s = R_s w + P_s S (c - C R w), \\
    m_k &= G_{vm} h z^{-d}/T, \qquad S = 1/(1 + P C), \qquad P_s \text{ from effort to } s,

with R and :math:`R_s` the rows from friction efforts to what the law reads and to s. A multiplier M of the friction and
one of the compensation, N, each keep their curve's product positive, so that the loop is stable for all of them where

.. math::
    \mathrm{Re}\{ w^* M (v + \kappa^{-1} w) \} + \lambda\, \mathrm{Re}\{ c^* N (c/\kappa_c - s) \} > 0

for every (w, c) that is not zero, with one :math:`\lambda > 0` for all angles (two integral quadratic constraints;
Megretski, Rantzer, IEEE TAC 42(6), 1997). N is 1 or :math:`1 \pm \rho z^{\pm 1}`, O'Shea's for odd monotone curves
(Willems, Brockett, IEEE TAC 13(3), 1968). Friction and compensation are taken as strangers: friction may be none at
all, so that a fraction too large for the friction that there is, is covered.

Of w only :math:`\xi = X^* w`, :math:`X = [M m, (CSR)^*, R_s^*]`, matters besides :math:`w^* D w`, whose least value is
:math:`\xi^* \Gamma^{-1} \xi` with :math:`\Gamma = X^* D^{-1} X`. What is left is a Hermitian form in
:math:`(\xi, c)`, which is positive where :math:`\Gamma^{-1} + E > 0` (the test without compensation;
:math:`E_{12} = E_{21} = -\tfrac12`) and

.. math::
    \frac{\mathrm{Re}\, N}{\kappa_c} > \mathrm{Re}(N P_s S) + \lambda^{-1} q_0 + q_1 + \lambda q_2, \qquad
    (q_0, q_1, q_2) = \text{of } u^* (\Gamma^{-1} + E)^{-1} u, \quad
    u = \tfrac12 (S, \lambda \overline{N P_s}, -\lambda \overline N),

so that the largest :math:`\kappa_c` follows from one search over :math:`\lambda`, in whose logarithm the right side is
convex. A larger :math:`\Gamma` makes the form smaller: what the sums over aliases leave out is bounded and added.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control.loops.absolute_stability import (
    ORDERS,
    REFINEMENTS,
    Angles,
    LoopResponses,
    Multiplier,
    bound_rest,
    choose_angles,
    find_obstacle,
    find_responses,
    invert_mobility,
    list_multipliers,
    refine_angles,
)
from seaopt.control.loops.friction_loop import FrictionLoop
from seaopt.control.loops.sampled_plant import sample_matrices
from seaopt.records import record

AtAngles = Complex[np.ndarray, " m"]
AtAliases = Complex[np.ndarray, "m k"]
Forms = Complex[np.ndarray, "m 3 3"]
SHARE = 0.9  # rho, below 1: the sum of what N weighs later or earlier samples with
SIMPLEST_SHIFT = "1"
SHIFTS = (SIMPLEST_SHIFT, "1 - rho/z", "1 - rho z", "1 + rho/z", "1 + rho z")
RATIOS = 16.0  # decades of lambda in which the best is looked for, about where both its terms are alike
ROUNDING = 1e-12  # added to the diagonal of a scaled matrix
MARGIN_KEPT = 1.01  # what may lie between the angles that were looked at is not enclosed


@record(eq=False)
class SpeedReading:
    """The friction's velocity as the controller has it."""

    velocity: Float[np.ndarray, " n"]  # its row of the states
    differenced: bool  # it is the difference of two samples of a position, over the time between them

    def weigh(self, theta: Angles, s: AtAliases, period: float) -> AtAliases:
        """Return what is read of a velocity at every alias."""
        if not self.differenced:
            return np.ones_like(s)
        return -np.expm1(-1j * theta)[:, None] / (period * s)

    def respond(self, loop: FrictionLoop, theta: Angles) -> AtAngles:
        """Return P_s at angles, the hold and the delay in it; its position is integrated with the plant."""
        n, period = len(loop.a), loop.plant.sample_time_s
        a, b = np.zeros((n + 1, n + 1)), np.append(loop.motor, 0.0)
        a[:n, :n], a[n, :n] = loop.a, self.velocity
        row = np.eye(1, n + 1, k=n) if self.differenced else np.append(self.velocity, 0.0)[None]
        plant = sample_matrices((a, b, row, np.zeros(1)), loop.delay_s, period, loop.plant.delay_samples)
        scale = -np.expm1(-1j * theta) / period if self.differenced else 1.0
        return plant.response(theta / (2 * np.pi * period)) * scale


@record
class CompensationMargin:
    """The steepest compensation from the motor's speed shown to be stable, with the plant's friction and less."""

    # the steepest, N s/m (N m s/rad) of effort over the friction's velocity: fraction times Coulomb friction over the
    # speed of the smoothing. Infinite where none is bounded, zero where nothing is shown
    slope: float
    required: float  # the slope of the compensation itself
    frequency_hz: float  # where the test fails first with a steeper one
    multiplier: str  # with which it holds, of friction; why not, where nothing is shown
    shift: str = ""  # the compensation's part of it
    angles: int = 0  # at how many angles it was looked at; between them nothing is enclosed

    @property
    def shown(self) -> bool:
        """Whether stability is shown for the compensation as it is."""
        return self.slope >= self.required

    @property
    def factor(self) -> float:
        """The steepest slope over the compensation's own."""
        return self.slope / self.required

    def __str__(self) -> str:
        if not self.slope:
            return f"with its friction compensated from the speed, stability is not shown ({self.multiplier})"
        if np.isinf(self.slope):
            return "with its friction compensated from the speed, stability is shown however steep that is"
        verdict = "stability is shown" if self.shown else "stability is NOT shown: it would be for one"
        return f"with its friction compensated from the speed, {verdict} up to {self.factor:.3g} times as steep"


def compensation_margin(
    loop: FrictionLoop, reading: SpeedReading, required: float, first: str = "", enough: float = np.inf
) -> CompensationMargin:
    """Return the steepest compensation for which the test of stability holds, the best over all multipliers. `loop`:
    stable, with its friction taken out and without compensation. `required`: the slope of the compensation, N s/m (N m
    s/rad). `first`: a multiplier that is tried first. `enough`: a slope of so many times `required` ends the search.
    """
    if obstacle := find_obstacle(loop):
        return CompensationMargin(slope=0.0, required=required, frequency_hz=0.0, multiplier=obstacle)
    search = _MultiplierSearch(
        loop=loop, reading=reading, required=required, base=_LoopAtAngles.at(loop, reading, choose_angles(loop))
    )
    best = CompensationMargin(
        slope=0.0, required=required, frequency_hz=0.0, multiplier="it is not without compensation either"
    )
    for name, multiplier in sorted(list_multipliers(loop), key=lambda named: named[0] != first):
        form = _MultiplierTest.of(search.base, multiplier)
        if form is None:
            continue
        for shift in SHIFTS:
            margin = search.measure(form, multiplier, shift, best.slope)
            if margin is not None and margin.slope > best.slope:
                best = replace(margin, multiplier=name, shift=shift)
            if best.slope >= enough * required:
                return best
    return best


@record(eq=False)
class _LoopAtAngles:
    """A loop at m angles, as the test takes it: friction's responses, R_s at every alias, P_s and S."""

    friction: LoopResponses
    speed: Complex[np.ndarray, "m k p"]
    through: AtAngles
    sensitivity: AtAngles

    @classmethod
    def at(cls, loop: FrictionLoop, reading: SpeedReading, theta: Angles) -> _LoopAtAngles:
        """Return the responses of a loop at angles."""
        friction, period = find_responses(loop, theta), loop.plant.sample_time_s
        rows = loop.respond(theta, ORDERS, reading.velocity[None]).by_friction[..., 0, :] * np.sqrt(loop.slopes)
        return cls(
            friction=friction,
            speed=rows * reading.weigh(theta, friction.s, period)[..., None],
            through=reading.respond(loop, theta),
            sensitivity=loop.sampled.sensitivity(theta / (2 * np.pi * period)),
        )


@record(eq=False)
class _MultiplierTest:
    """The test for one multiplier of the friction: factors of Gamma, and of what it is tested with."""

    at: _LoopAtAngles
    left: Forms
    inner: Forms

    @classmethod
    def of(cls, at: _LoopAtAngles, multiplier: Multiplier) -> _MultiplierTest | None:
        """Return the form at angles; None where the test fails without compensation."""
        gram = _gather(at, multiplier(at.friction.s))
        if gram is None:
            return None
        left = np.conj(np.swapaxes(gram, -1, -2))
        coupled = np.zeros((3, 3))
        coupled[0, 1] = coupled[1, 0] = -0.5
        inner = np.eye(3) + left @ coupled @ gram
        return cls(at=at, left=left, inner=inner) if np.all(np.linalg.eigvalsh(inner)[:, 0] > 0.0) else None

    def find_least_inverse(self, shift: str) -> _LeastInverse:
        """Return the least 1/kappa_c that the test allows at all angles."""
        from scipy.optimize import minimize_scalar  # deferred: scipy is slow to load

        at, n = self.at, _shift(shift, np.exp(1j * self.at.friction.theta))
        u = np.zeros((n.size, 3, 2), dtype=complex)  # of u the part without lambda, and that with it
        u[:, 0, 0], u[:, 1, 1], u[:, 2, 1] = 0.5 * at.sensitivity, 0.5 * np.conj(n * at.through), -0.5 * np.conj(n)
        u = self.left @ u
        q = np.conj(np.swapaxes(u, -1, -2)) @ np.linalg.solve(self.inner, u)
        q_0, q_2 = np.real(q[:, 0, 0]), np.real(q[:, 1, 1])
        fixed = np.real(n * at.through * at.sensitivity) + 2.0 * np.real(q[:, 0, 1])

        def inverse_at(ratio: float) -> Angles:
            return (fixed + q_0 / ratio + q_2 * ratio) / np.real(n)

        middle, reach = 0.5 * np.log(np.max(q_0) / np.max(q_2)), 0.5 * RATIOS * np.log(10.0)
        best = minimize_scalar(
            lambda log: float(np.max(inverse_at(np.exp(log)))),
            bounds=(middle - reach, middle + reach),
            method="bounded",
            options={"xatol": 1e-3},
        )
        ratio = float(np.exp(best.x))
        return _LeastInverse(theta=at.friction.theta, inverse=float(best.fun), ratio=ratio, at_ratio=inverse_at)


@record(eq=False)
class _MultiplierSearch:
    """A loop, what the compensation reads, and the loop's responses at the first angles."""

    loop: FrictionLoop
    reading: SpeedReading
    required: float
    base: _LoopAtAngles

    def measure(
        self, form: _MultiplierTest, multiplier: Multiplier, shift: str, least: float
    ) -> CompensationMargin | None:
        """Return what a pair of multipliers shows, looked at between the angles too; None where it is below `least`."""
        result, needed, count = form.find_least_inverse(shift), -np.inf, self.base.through.size
        worst = result.worst_angle
        for _ in range(REFINEMENTS):
            if least and result.inverse >= 1.0 / least:
                return None
            if result.inverse > needed:
                needed, worst = result.inverse, result.worst_angle
            theta = refine_angles(result.theta, -result.at_ratio(result.ratio))
            finer = _MultiplierTest.of(_LoopAtAngles.at(self.loop, self.reading, theta), multiplier)
            if finer is None:
                return None
            result, count = finer.find_least_inverse(shift), count + theta.size
            if result.inverse <= needed * MARGIN_KEPT:
                break
        needed = max(needed, result.inverse)
        slope = np.inf if needed <= 0.0 else 1.0 / (MARGIN_KEPT * needed)
        return CompensationMargin(
            slope=float(slope),
            required=self.required,
            multiplier=shift,
            angles=count,
            frequency_hz=float(worst / (2 * np.pi * self.loop.plant.sample_time_s)),
        )


@record(eq=False)
class _LeastInverse:
    """The least 1/kappa_c at all angles, lambda for which it is, and what it is at each angle."""

    theta: Angles
    inverse: float
    ratio: float
    at_ratio: Callable[[float], Angles]

    @property
    def worst_angle(self) -> float:
        return float(self.theta[np.argmax(self.at_ratio(self.ratio))])


def _shift(name: str, z: AtAngles) -> AtAngles:
    """Return N of a name."""
    if name == SIMPLEST_SHIFT:
        return np.ones_like(z)
    sign = -1.0 if "-" in name else 1.0
    return 1.0 + sign * SHARE * (1.0 / z if "/" in name else z)


def _gather(at: _LoopAtAngles, weight: AtAliases) -> Forms | None:
    """Return a factor L of Gamma = L L*, what is beyond the aliases added; None where some D is not positive."""
    friction = at.friction
    possible, inverse = invert_mobility(weight, friction.mobility, 1.0)
    if not np.all(possible):
        return None
    x = np.stack([-weight[..., None] * friction.command, friction.sensed, np.conj(at.speed)], axis=-1)
    terms = np.conj(np.swapaxes(x, -1, -2)) @ (inverse @ x)
    gamma = np.sum(terms, axis=1)
    for i in range(3):  # a positive matrix is at most three times its diagonal
        gamma[:, i, i] += 3.0 * bound_rest(friction, np.real(terms[..., i, i]))
    size = np.sqrt(np.real(np.einsum("mii->mi", gamma)))
    size = np.where(size > 0.0, size, 1.0)
    scaled = gamma / (size[:, :, None] * size[:, None, :]) + ROUNDING * np.eye(3)
    return np.linalg.cholesky(scaled) * size[:, :, None]
