r"""Stability of a sampled loop for every friction curve of a sector, between the samples too, for the certificate.

The plant is linear but for friction efforts :math:`-\varphi_i(v_i)`, each a monotone function of one velocity with a
slope between 0 and :math:`\kappa_i` (Coulomb's, smoothed: :math:`\kappa = f_c/v_s`; a falling Stribeck part belongs
into the plant's damping first, so that the rest rises). The law is sampled with period T and d samples of delay, and
its output held. Seen from the friction efforts w to the velocities v the closed loop is a linear T-periodic operator H.
If :math:`M (H + \kappa^{-1})` is strictly passive on L2 for a multiplier M that keeps every :math:`\varphi` passive,
the loop is stable for all of them, stick and slip included: the circle criterion with M = 1 (Sandberg; Zames, IEEE TAC
11(2-3), 1966), Popov's with :math:`M = 1 + \eta s`, that of Zames and Falb (SIAM J. Control 6(1), 1968) with
:math:`M = 1 - \rho\, a/(a \pm s)`, whose second term has a non-negative impulse response of area
:math:`\rho \le 1`, so that monotone curves are enough and they need not be odd. A static load that friction carries
shifts the curve and leaves it monotone.

At :math:`\theta = \omega T` in :math:`[0, \pi]` it acts on the aliases :math:`\omega_k = (\theta + 2\pi k)/T`:

.. math::
    H_{kl} = G_v(j\omega_k)\,\delta_{kl} + a_k b_l^*, \qquad a_k = -G_{vm}(j\omega_k)\, h(j\omega_k)\, z^{-d} K(z),
    \qquad b_l^* = G_y(j\omega_l)/T

with :math:`G_v` from friction effort to velocity, :math:`G_{vm}` from motor effort to velocity, :math:`G_y` from
friction effort to the measured force, the hold :math:`h(s) = (1 - e^{-sT})/s`, :math:`z = e^{j\theta}`, and
:math:`K = C_y/(1 + P z^{-d} C_y)`. The Hermitian part of :math:`M (H + \kappa^{-1})` is a block-diagonal
:math:`D_k`, the Hermitian part of :math:`M(j\omega_k) (G_v(j\omega_k) + \kappa^{-1})`, and
:math:`\tfrac12 (a b^* + b a^*)` of rank two, a multiplied by M. With
:math:`\alpha = \sum a_k^* D_k^{-1} a_k`, :math:`\beta = \sum b_k^* D_k^{-1} b_k`,
:math:`\gamma = \sum b_k^* D_k^{-1} a_k` it is positive definite where all :math:`D_k > 0` and
:math:`|2 + \gamma|^2 > \alpha\beta` (the inertia of a block matrix and its Schur complement; Haynsworth, Linear Algebra
Appl. 1, 1968). The sums converge like :math:`1/k^2`; what is beyond the last alias is bounded by its size there and
counted against the test.

The largest :math:`\kappa` for which the test holds, at the same proportion for every friction, is the *friction
margin*; divided by the curve's own steepest slope it is a factor, above 1 where stability is proved.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Complex, Float
from scipy.special import polygamma

from seaopt.control.loops.law import Law
from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.records import record

ALIASES = 30  # on either side; what is beyond is bounded
TAIL_GROWTH = 1.1  # of the terms beyond the last alias, times frequency squared, over those at it
ANGLES = 160
LOWEST_ANGLE = 1e-4  # rad; below, a loop with an integrator is nearly static
NEAR_MODES = np.geomspace(0.1, 10.0, 7)  # half widths of a mode
REFINEMENTS, REFINED_DIPS, POINTS_PER_DIP = 3, 4, 9
MULTIPLIER_POINTS = 9  # corner frequencies tried
ZAMES_FALB_AREAS = (0.5, 0.9, 0.99)
SMALLEST_INVERSE, LARGEST_INVERSE = 1e-6, 1e6  # 1/kappa looked at, in units of the curves' own 1/slope
MARGIN_PRECISION = 1e-2
WORTHWHILE = 0.9  # of the inverse: a multiplier that gains less is not looked at further

Angles = Float[np.ndarray, " m"]
Multiplier = Callable[[Complex[np.ndarray, "*n"]], Complex[np.ndarray, "*n"]]
Test = Callable[[float], Angles]


@record(eq=False)
class FrictionLoop:
    r"""A sampled loop with its friction taken out: :math:`\dot x = A x + b u - B_f \varphi(v)`, v = C_v x, y = c x.

    Parameters
    ----------
    a, motor : arrays, shapes (n, n) and (n,)
        The continuous plant without friction, and the effect of the motor effort u.
    friction : array, shape (n, p)
        The effect of each friction effort in the direction of its velocity.
    velocity, measured : arrays, shapes (p, n) and (n,)
        The velocities that friction acts on, and the fed-back output.
    through : array, shape (p,)
        The effect of each friction effort on the output itself.
    slopes : array, shape (p,)
        The steepest slope of each friction curve, N s/m (N m s/rad).
    plant : DigitalPlant
        The same plant, sampled, from u to y, with its delay.
    law : Law
        Its C_y closes the loop.
    delay_s : float
        Of the motor effort, besides the whole samples of `plant`.

    """

    a: Float[np.ndarray, "n n"]
    motor: Float[np.ndarray, " n"]
    friction: Float[np.ndarray, "n p"]
    velocity: Float[np.ndarray, "p n"]
    measured: Float[np.ndarray, " n"]
    through: Float[np.ndarray, " p"]
    slopes: Float[np.ndarray, " p"]
    plant: DigitalPlant
    law: Law
    delay_s: float = 0.0


@record
class FrictionMargin:
    """How much steeper than they are all friction curves may be with stability still proved.

    Parameters
    ----------
    factor : float
        Of the curves' own steepest slopes, 1 and more where stability is proved for the curves as they are; infinite
        where even a jump (ideal Coulomb friction) is proved, zero where nothing is.
    slopes : tuple of float
        The slopes that are proved, N s/m (N m s/rad).
    frequency_hz : float
        Where the test fails first with steeper curves.
    multiplier : str
        What proves it.

    """

    factor: float
    slopes: tuple[float, ...]
    frequency_hz: float
    multiplier: str

    @property
    def proved(self) -> bool:
        """Whether stability is proved for the curves as they are."""
        return self.factor >= 1.0

    def __str__(self) -> str:
        if not self.factor:
            return f"friction: stability between sliding and stuck is not proved ({self.multiplier})"
        steep = "however steep" if np.isinf(self.factor) else f"up to {self.factor:.3g} times as steep as its own"
        missing = "" if self.proved else "; for its own it is not"
        return f"friction: stability is proved for every curve {steep}, between the samples too{missing}"


def friction_margin(loop: FrictionLoop, first: str = "", least: float = 0.0) -> FrictionMargin:
    """Return the steepest friction for which the loop is proved stable, the best over all multipliers tried.

    The loop without friction must be stable, by its eigenvalues; the caller sees to that. Sums over aliases are
    truncated with a bound on the rest; rounding is not enclosed.

    Parameters
    ----------
    loop : FrictionLoop
        The loop with its friction taken out.
    first : str, optional
        The name of a multiplier that is tried first, and alone where it proves stability for the curves as they are.
    least : float
        A smaller factor is not looked for, which is quicker: the margin is then zero.

    """
    responses = _respond(loop, _angles(loop))
    bar = 1.0 / least if least else np.inf
    best = FrictionMargin(factor=0.0, slopes=(0.0,) * loop.slopes.size, frequency_hz=0.0, multiplier="none")
    for name, multiplier in sorted(_multipliers(loop), key=lambda named: named[0] != first):
        inverse = _least_inverse(responses, multiplier, WORTHWHILE / best.factor if best.factor else bar)
        if inverse is None:
            continue
        fine, inverse = _settle(loop, responses, multiplier, inverse)
        if np.isinf(inverse) or (best.factor and inverse >= 1.0 / best.factor):
            continue
        worst = int(np.argmin(_definiteness(fine, multiplier, inverse * (1.0 - 0.01))))
        factor = np.inf if inverse == 0.0 else 1.0 / inverse
        best = FrictionMargin(
            factor=float(factor), slopes=tuple(float(slope) for slope in factor * loop.slopes),
            frequency_hz=float(fine.theta[worst] / (2 * np.pi * loop.plant.sample_time_s)), multiplier=name,
        )  # fmt: skip
        if name == first and best.proved:
            break
    return best


def _settle(
    loop: FrictionLoop, responses: _Responses, multiplier: Multiplier, inverse: float
) -> tuple[_Responses, float]:
    """Look between the angles, where the test may fail, and give way until it holds; infinite where it never does."""
    for _ in range(REFINEMENTS):
        responses = _refine(loop, responses, multiplier, inverse)
        again = _least_inverse(responses, multiplier, LARGEST_INVERSE)
        if again is None:
            return responses, np.inf
        if again <= inverse * (1.0 + MARGIN_PRECISION):
            return responses, max(again, inverse)
        inverse = again
    return responses, inverse


@record(eq=False)
class _Responses:
    """The loop's responses at m angles and k aliases, efforts in units that make each curve's steepest slope 1."""

    theta: Angles
    s: Complex[np.ndarray, "m k"]
    mobility: Complex[np.ndarray, "m k p p"]
    command: Complex[np.ndarray, "m k p"]
    sensed: Complex[np.ndarray, "m k p"]
    tail: Float[np.ndarray, " m"]
    order: Float[np.ndarray, " m"]


def _respond(loop: FrictionLoop, theta: Angles) -> _Responses:
    """Return G_v, a (without M) and b at angles."""
    period = loop.plant.sample_time_s
    z = np.exp(1j * theta)
    f = theta / (2 * np.pi * period)
    law = loop.law.measurement_response(f)
    through = loop.plant.response(f)
    gain = law / (1.0 + through * law) * z**-loop.plant.delay_samples
    s = 1j * (theta[:, None] + 2 * np.pi * np.arange(-ALIASES, ALIASES + 1)) / period
    root = np.sqrt(loop.slopes)  # phi = slope v: with v' = root v and phi' = phi / root the slope is 1
    causes = np.column_stack([loop.friction * root, loop.motor])
    seen = np.vstack([root[:, None] * loop.velocity, loop.measured])
    response = _transfer(loop.a, causes, seen, s)
    velocity, measured = response[..., :-1, :], response[..., -1, :-1]
    hold = -np.expm1(-s * period) / s * np.exp(-s * loop.delay_s)
    return _Responses(
        theta=theta, s=s, mobility=velocity[..., :-1], command=-velocity[..., -1] * (hold * gain[:, None])[..., None],
        sensed=np.conj(measured + loop.through * root) / period,
        tail=polygamma(1, ALIASES + 1 + theta / (2 * np.pi)) + polygamma(1, ALIASES + 1 - theta / (2 * np.pi)),
        order=ALIASES + theta / (2 * np.pi),
    )  # fmt: skip


def _transfer(
    a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n u"], c: Float[np.ndarray, "y n"], s: Complex[np.ndarray, "m k"]
) -> Complex[np.ndarray, "m k y u"]:
    """Return c (sI - a)^-1 b, by back substitution in a Schur basis of the balanced matrix, for all s at once."""
    from scipy.linalg import matrix_balance, schur

    balanced, transform = matrix_balance(a, permute=False)
    scale = np.diag(transform)
    triangle, basis = np.array(schur(balanced, output="complex")[:2])
    right, left = basis.conj().T @ (b / scale[:, None]), (c * scale) @ basis
    n, flat = len(triangle), s.ravel()
    x = np.empty((n, right.shape[1], flat.size), dtype=complex)
    for i in range(n - 1, -1, -1):
        known = np.tensordot(triangle[i, i + 1 :], x[i + 1 :], axes=1) if i + 1 < n else 0.0
        x[i] = (right[i][:, None] + known) / (flat - triangle[i, i])
    out = np.tensordot(left, x, axes=1)
    return np.moveaxis(out, -1, 0).reshape(*s.shape, *out.shape[:2])


def _definiteness(at: _Responses, multiplier: Multiplier, inverse: float) -> Angles:
    """Return, per angle, what is positive where M (H + inverse) is positive definite."""
    return _weigh(at, multiplier)(inverse)


def _weigh(at: _Responses, multiplier: Multiplier) -> Test:
    """Return the test of one multiplier: of 1/kappa, the values of `_definiteness`."""
    weight = multiplier(at.s)
    if at.mobility.shape[-1] == 1:
        return _weigh_one(at, weight)
    right = np.stack([weight[..., None] * at.command, at.sensed], axis=-1)

    def test(inverse: float) -> Angles:
        block = weight[..., None, None] * (at.mobility + inverse * np.eye(at.mobility.shape[-1]))
        block = 0.5 * (block + np.conj(np.swapaxes(block, -1, -2)))
        negative = np.any(np.linalg.eigvalsh(block) <= 0.0, axis=(-2, -1))
        block = np.where(negative[:, None, None, None], np.eye(block.shape[-1]), block)
        sums = np.conj(np.swapaxes(right, -1, -2)) @ np.linalg.solve(block, right)
        alpha, beta, gamma = (sums[..., i, j] for i, j in ((0, 0), (1, 1), (1, 0)))
        return np.where(negative, -1.0, _compare(at, np.real(alpha), np.real(beta), gamma))

    return test


def _weigh_one(at: _Responses, weight: Complex[np.ndarray, "m k"]) -> Test:
    """Return the test where there is one friction: numbers, not matrices, and most of them for every 1/kappa."""
    mobility, slope = np.real(weight * at.mobility[..., 0, 0]), np.real(weight)
    command, sensed = weight * at.command[..., 0], at.sensed[..., 0]
    own, other, both = np.abs(command) ** 2, np.abs(sensed) ** 2, np.conj(sensed) * command

    def test(inverse: float) -> Angles:
        real = mobility + inverse * slope
        negative = np.any(real <= 0.0, axis=-1)
        real = np.where(real > 0.0, real, 1.0)
        return np.where(negative, -1.0, _compare(at, own / real, other / real, both / real))

    return test


def _compare(
    at: _Responses, alpha: Float[np.ndarray, "m k"], beta: Float[np.ndarray, "m k"], gamma: Complex[np.ndarray, "m k"]
) -> Angles:
    """Return |2 + gamma|^2 - alpha beta of the terms at the aliases, scaled, with what is beyond them against it.

    The terms fall like 1/omega^2: the rest of each sum is at most a multiple of its last term.
    """
    reach = TAIL_GROWTH * at.order**2 * at.tail

    def rest(terms: Complex[np.ndarray, "m k"] | Float[np.ndarray, "m k"]) -> Angles:
        return reach * np.maximum(np.abs(terms[:, 0]), np.abs(terms[:, -1]))

    product = (np.sum(alpha, axis=1) + rest(alpha)) * (np.sum(beta, axis=1) + rest(beta))
    least = np.abs(2.0 + np.sum(gamma, axis=1)) - rest(gamma)
    return (np.sign(least) * least**2 - product) / (4.0 + np.abs(product))


def _least_inverse(at: _Responses, multiplier: Multiplier, bar: float) -> float | None:
    """Return the least 1/kappa, in units of the curves' own 1/slope, that holds at all angles; None if none below bar.

    More of it adds the Hermitian part of M, which is not negative: what holds at one value holds above it.
    """
    test = _weigh(at, multiplier)

    def holds(inverse: float) -> bool:
        return bool(np.min(test(inverse)) > 0.0)

    high = min(bar, LARGEST_INVERSE)
    if not holds(high):
        return None
    if holds(0.0):
        return 0.0
    low = SMALLEST_INVERSE
    if holds(low):
        return low
    while high / low > 1.0 + MARGIN_PRECISION:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high


def _angles(loop: FrictionLoop) -> Angles:
    """Return angles from nearly static to the Nyquist frequency, close about the modes of plant and closed loop."""
    period = loop.plant.sample_time_s
    even = np.concatenate([np.geomspace(LOWEST_ANGLE, 0.1, ANGLES // 2), np.linspace(0.1, np.pi, ANGLES)])
    poles = np.linalg.eigvals(loop.a)
    turns, widths = np.abs(np.imag(poles)) * period, np.maximum(np.abs(np.real(poles)) * period, 1e-6)
    around = turns[:, None] + widths[:, None] * np.concatenate([-NEAR_MODES, [0.0], NEAR_MODES])
    folded = np.abs((around.ravel() + np.pi) % (2 * np.pi) - np.pi)
    return np.unique(np.concatenate([even, folded[folded >= LOWEST_ANGLE]]))


def _refine(loop: FrictionLoop, at: _Responses, multiplier: Multiplier, inverse: float) -> _Responses:
    """Return the responses at new angles, about the least values of the test."""
    values = _definiteness(at, multiplier, inverse)
    dips = [
        i for i in range(values.size) if values[i] <= min(values[max(i - 1, 0)], values[min(i + 1, values.size - 1)])
    ]
    dips = sorted(dips, key=lambda i: values[i])[:REFINED_DIPS]
    new = [
        np.linspace(at.theta[max(i - 1, 0)], at.theta[min(i + 1, values.size - 1)], POINTS_PER_DIP) for i in dips
    ]  # fmt: skip
    return _respond(loop, np.unique(np.concatenate(new)))


def _multipliers(loop: FrictionLoop) -> Iterator[tuple[str, Multiplier]]:
    """Yield multipliers by name: none, Popov's, and those of Zames and Falb, over corner frequencies."""
    yield "circle", np.ones_like
    rates = np.geomspace(0.02, 2.0, MULTIPLIER_POINTS) * np.pi / loop.plant.sample_time_s

    def popov(eta: float) -> Multiplier:
        return lambda s: 1.0 + eta * s

    def zames_falb(share: float, rate: float) -> Multiplier:
        return lambda s: 1.0 - share * rate / (rate + s)

    for rate in rates:
        yield f"Popov, {1.0 / rate:.3g} s", popov(1.0 / rate)  # a negative time needs a bounded slope
        for sign in (1.0, -1.0):
            for share in ZAMES_FALB_AREAS:
                name = f"Zames-Falb, {share:g} at {sign * rate / (2 * np.pi):.3g} Hz"
                # A negative rate is the anticausal one: -rate / (-rate + s) = rate / (rate - s).
                yield name, zames_falb(share, sign * rate)
