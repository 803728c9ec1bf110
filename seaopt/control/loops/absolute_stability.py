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
friction effort to the measured force (:math:`K G_y` of several measured signals is
:math:`\sum_i C_i G_{y_i}/(1 + L)`: the command is one, and so the rank is the same), the hold
:math:`h(s) = (1 - e^{-sT})/s`, :math:`z = e^{j\theta}`, and
:math:`K = C_y/(1 + P z^{-d} C_y)`. The Hermitian part of :math:`M (H + \kappa^{-1})` is a block-diagonal
:math:`D_k`, the Hermitian part of :math:`M(j\omega_k) (G_v(j\omega_k) + \kappa^{-1})`, and
:math:`\tfrac12 (a b^* + b a^*)` of rank two, a multiplied by M. With
:math:`\alpha = \sum a_k^* D_k^{-1} a_k`, :math:`\beta = \sum b_k^* D_k^{-1} b_k`,
:math:`\gamma = \sum b_k^* D_k^{-1} a_k` it is positive definite where all :math:`D_k > 0` and
:math:`|2 + \gamma|^2 > \alpha\beta` (the inertia of a block matrix and its Schur complement; Haynsworth, Linear Algebra
Appl. 1, 1968). The sums converge like :math:`1/k^2`; what is beyond the last alias is bounded by its size there and
counted against the test.

The largest :math:`\kappa` for which the test holds, at the same proportion for every friction, is the *friction
margin*; divided by the curve's own steepest slope it is a factor, above 1 where stability is shown: by a test at
several hundred angles, between which nothing is enclosed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from seaopt.control.loops.friction_loop import FrictionLoop
from seaopt.records import record
from seaopt.welch import square

ALIASES = 30  # on either side; what is beyond is bounded
ORDERS = np.arange(-ALIASES, ALIASES + 1)
TAIL_GROWTH = 1.1  # of the terms beyond the last alias, times frequency squared, over those at it
ANGLES = 160
LOWEST_ANGLE = 1e-4  # rad; below, a loop with an integrator is nearly static
NEAR_MODES = np.geomspace(0.1, 10.0, 7)  # half widths of a mode
REFINEMENTS, REFINED_DIPS, POINTS_PER_DIP = 3, 4, 9
MULTIPLIER_POINTS = 9  # corner frequencies tried
ZAMES_FALB_AREAS = (0.5, 0.9, 0.99)
SMALLEST_INVERSE, LARGEST_INVERSE = 1e-6, 1e6  # 1/kappa looked at, in units of the curves' own 1/slope
MARGIN_PRECISION = 1e-2
NO_FEEDBACK = 1e9  # weight where a multiplier shows nothing, whatever the feedback
SIMPLEST = "circle"  # the multiplier that is 1
WORTHWHILE = 0.9  # of the inverse: a multiplier that gains less is not looked at further

AtAliases = Complex[np.ndarray, "m k"]
ComplexTerms = Complex[np.ndarray, "a n"]
RealTerms = Float[np.ndarray, "a n"]
Mobility = Complex[np.ndarray, "m k p p"]
Angles = Float[np.ndarray, " m"]
Multiplier = Callable[[Complex[np.ndarray, "*n"]], Complex[np.ndarray, "*n"]]
Places = slice | Int[np.ndarray, " a"]
Test = Callable[[float, Places], Angles]  # of 1/kappa and which angles: positive where M (H + 1/kappa) is definite
Terms = tuple[
    Bool[np.ndarray, " a"], RealTerms, RealTerms, ComplexTerms
]  # where all D_k > 0, and at every alias what alpha, beta and gamma are the sums of
TermsOf = Callable[[float, Places], Terms]
EVERY = slice(None)


@record
class FrictionMargin:
    """How much steeper than they are all friction curves may be for the test of stability to hold."""

    # of the curves' own steepest slopes, 1 and more where the test holds for the curves as they are; infinite where it
    # does even for a jump (ideal Coulomb friction), zero where it does for nothing
    factor: float
    slopes: tuple[float, ...]  # the slopes up to which it holds, N s/m (N m s/rad)
    frequency_hz: float  # where the test fails first with steeper curves
    multiplier: str  # with which it holds
    # at how many angles it was looked at, those about the worst of them included; between them nothing is enclosed
    angles: int = 0
    linearised: bool = False  # a link turns, for which the plant is linearised at rest

    @property
    def shown(self) -> bool:
        """Whether the test of stability holds, at every angle looked at, for the curves as they are."""
        return self.factor >= 1.0

    @property
    def least_slope(self) -> float:
        """The least of the slopes for which stability is shown, N s/m (N m s/rad), of what is not viscous."""
        return min((slope for slope in self.slopes if slope > 0.0), default=0.0)

    def describe(self) -> str:
        """Return up to how steep a friction stability is shown, and how, or why it is not."""
        if not self.factor:
            return f"stability between sliding and stuck is not shown ({self.multiplier})"
        steep = "however steep" if np.isinf(self.factor) else f"up to {self.factor:.3g} times as steep as the model's"
        missing = "" if self.shown else "; not for the model's own"
        where = f"by a test at {self.angles} angles, between the samples too"
        where += ", linearised at rest" if self.linearised else ""
        return f"stable for any friction curve {steep}, {where}{missing}"

    def __str__(self) -> str:
        return f"friction: {self.describe()}"


def friction_margin(loop: FrictionLoop, first: str = "", least: float = 0.0) -> FrictionMargin:
    """Return the steepest friction for which the test of stability holds, the best over all multipliers tried. The loop
    without friction must be stable, by its eigenvalues, and have no `FrictionLoop.obstacle`; else the margin is zero,
    and its `multiplier` says why. Sums over aliases are truncated with a bound on the rest; rounding is not enclosed,
    nor is what lies between the angles looked at. `first`: a multiplier that is tried first, and alone where it shows
    stability for the curves as they are. `least`: below it nothing is looked for, and the margin is zero.
    """
    none = FrictionMargin(factor=0.0, slopes=(0.0,) * loop.slopes.size, frequency_hz=0.0, multiplier="none")
    if obstacle := find_obstacle(loop):
        return replace(none, multiplier=f"none: {obstacle}")
    responses = find_responses(loop, choose_angles(loop))
    bar = 1.0 / least if least else np.inf
    best = none
    for name, multiplier in sorted(list_multipliers(loop), key=lambda named: named[0] != first):
        test = _weigh(responses, multiplier)
        inverse = _least_inverse(test, WORTHWHILE / best.factor if best.factor else bar)
        if inverse is None:
            continue
        theta, test, inverse, count = _settle(loop, responses.theta, test, multiplier, inverse)
        if np.isinf(inverse) or (best.factor and inverse >= 1.0 / best.factor):
            continue
        worst = int(np.argmin(test(inverse * (1.0 - 0.01), EVERY)))
        factor = np.inf if inverse == 0.0 else 1.0 / inverse
        best = FrictionMargin(
            factor=float(factor),
            slopes=tuple(float(slope) for slope in factor * loop.slopes),
            frequency_hz=float(theta[worst] / (2 * np.pi * loop.plant.sample_time_s)),
            multiplier=name,
            angles=count,
            linearised=loop.linearised,
        )
        if name == first and best.shown:
            break
    return best


def find_obstacle(loop: FrictionLoop) -> str:
    """Return why no test of absolute stability is for this loop under its law; empty where one is."""
    return loop.obstacle or ("" if loop.sampled.is_stable() else "unstable without friction")


def _settle(
    loop: FrictionLoop, theta: Angles, test: Test, multiplier: Multiplier, inverse: float
) -> tuple[Float[np.ndarray, " new"], Test, float, int]:
    """Look between the angles, where the test may fail, and give way until it holds; infinite where it never does.
    Returns the last angles, the test at them, 1/kappa and the number of all angles looked at.
    """
    count = theta.size
    for _ in range(REFINEMENTS):
        theta = refine_angles(theta, test(inverse, EVERY))
        count += theta.size
        test = _weigh(find_responses(loop, theta), multiplier)
        again = _least_inverse(test, LARGEST_INVERSE)
        if again is None:
            return theta, test, np.inf, count
        if again <= inverse * (1.0 + MARGIN_PRECISION):
            return theta, test, max(again, inverse), count
        inverse = again
    return theta, test, inverse, count


@record(eq=False)
class LoopResponses:
    """The loop's responses at m angles and k aliases, efforts in units that make each curve's steepest slope 1. b
    (`sensed`) is that of the law's feedback; or one for each of y signals, per unit of its feedback.
    """

    theta: Angles
    s: AtAliases
    mobility: Mobility
    command: Complex[np.ndarray, "m k p"]
    sensed: Complex[np.ndarray, "m k p *y"]
    tail: Float[np.ndarray, " m"]
    order: Float[np.ndarray, " m"]


def find_responses(loop: FrictionLoop, theta: Angles, *, feedback: bool = True) -> LoopResponses:
    """Return G_v, a (without M) and b at angles; b of each signal, per unit of its K, without the feedback."""
    from scipy.special import polygamma  # deferred: scipy is slow to load

    period, root = loop.plant.sample_time_s, np.sqrt(loop.slopes)
    seen = np.vstack([root[:, None] * loop.velocity, loop.sensed])  # phi = slope v: the slope of phi / root is 1
    response, ports = loop.respond(theta, ORDERS, seen), len(root)
    by_friction = root * response.by_friction
    read = np.swapaxes(by_friction[..., ports:, :] + loop.through * root, -1, -2)
    if feedback:
        read = np.einsum("ym,mkpy->mkp", loop.feedback(theta), read)
    return LoopResponses(
        theta=theta,
        s=1j * (theta[:, None] + 2 * np.pi * ORDERS) / period,
        mobility=by_friction[..., :ports, :],
        command=-response.by_motor[..., :ports],
        sensed=np.conj(read),
        tail=polygamma(1, ALIASES + 1 + theta / (2 * np.pi)) + polygamma(1, ALIASES + 1 - theta / (2 * np.pi)),
        order=ALIASES + theta / (2 * np.pi),
    )


def _weigh(at: LoopResponses, multiplier: Multiplier) -> Test:
    """Return the test of one multiplier."""
    form = _form_terms(at, multiplier(at.s))

    def test(inverse: float, angles: Places) -> Angles:
        positive, alpha, beta, gamma = form(inverse, angles)
        return np.where(positive, _compare(at, angles, alpha, beta, gamma), -1.0)

    return test


def _form_terms(at: LoopResponses, weight: AtAliases) -> TermsOf:
    """Return what gives, for 1/kappa, where all D_k are positive, and the terms of alpha, beta and gamma there."""
    if at.mobility.shape[-1] == 1:
        return _form_terms_of_one(at, weight)
    right = np.stack([weight[..., None] * at.command, at.sensed], axis=-1)

    def form(inverse: float, angles: Places) -> Terms:
        positive, block = _form_blocks(weight[angles], at.mobility[angles], inverse)
        sums = np.conj(np.swapaxes(right[angles], -1, -2)) @ np.linalg.solve(block, right[angles])
        return positive, np.real(sums[..., 0, 0]), np.real(sums[..., 1, 1]), sums[..., 1, 0]

    return form


def _form_terms_of_one(at: LoopResponses, weight: AtAliases) -> TermsOf:
    """Return `_form_terms` where there is one friction: numbers, not matrices, and most of them for every 1/kappa."""
    mobility, slope = np.real(weight * at.mobility[..., 0, 0]), np.real(weight)
    command, sensed = weight * at.command[..., 0], at.sensed[..., 0]
    commanded, sensing, crossed = square(command), square(sensed), np.conj(sensed) * command

    def form(inverse: float, angles: Places) -> Terms:
        real = mobility[angles] + inverse * slope[angles]
        share = 1.0 / np.where(real > 0.0, real, 1.0)
        return np.min(real, axis=-1) > 0.0, commanded[angles] * share, sensing[angles] * share, crossed[angles] * share

    return form


def _compare(at: LoopResponses, angles: Places, alpha: RealTerms, beta: RealTerms, gamma: ComplexTerms) -> Angles:
    """Return |2 + gamma|^2 - alpha beta of the terms at the aliases, scaled, with what is beyond them against it. The
    terms fall like 1/omega^2: the rest of each sum is at most a multiple of its last term.
    """
    product = np.sum(alpha, axis=1) + bound_rest(at, alpha, angles)
    product = product * (np.sum(beta, axis=1) + bound_rest(at, beta, angles))
    least = np.abs(2.0 + np.sum(gamma, axis=1)) - bound_rest(at, gamma, angles)
    return (np.sign(least) * least**2 - product) / (4.0 + np.abs(product))


def bound_rest(at: LoopResponses, terms: ComplexTerms | RealTerms, angles: Places = EVERY) -> Angles:
    """Return a bound on what is beyond the last aliases of terms that fall like 1/omega^2."""
    reach = TAIL_GROWTH * at.order[angles] ** 2 * at.tail[angles]
    return reach * np.maximum(np.abs(terms[:, 0]), np.abs(terms[:, -1]))


def _least_inverse(test: Test, bar: float) -> float | None:
    """Return the least 1/kappa, in units of the curves' own 1/slope, that holds at all angles; None if none below bar.
    More of it adds the Hermitian part of M, which is not negative: what holds at one value holds above it, so that only
    angles that fail at the lower end are looked at in between. What is returned is tested at all of them.
    """

    def fail(inverse: float, angles: Places = EVERY) -> Int[np.ndarray, " lost"]:
        lost = np.flatnonzero(~(test(inverse, angles) > 0.0))  # what is not a number fails
        return lost if isinstance(angles, slice) else angles[lost]

    high = top = min(bar, LARGEST_INVERSE)
    if fail(high).size:
        return None
    failing = fail(0.0)
    if not failing.size:
        return 0.0
    low = SMALLEST_INVERSE
    failing = fail(low, failing)
    if not failing.size:
        high = low
    while True:
        while high / low > 1.0 + MARGIN_PRECISION:
            middle = float(np.sqrt(low * high))
            still = fail(middle, failing)
            low, high, failing = (middle, high, still) if still.size else (low, middle, failing)
        failing = fail(high)
        if not failing.size:
            return high
        low, high = high, top  # the bound on what is beyond the aliases need not fall as the rest does


def choose_angles(loop: FrictionLoop) -> Angles:
    """Return angles from nearly static to the Nyquist frequency, close about the modes of plant and closed loop."""
    period = loop.plant.sample_time_s
    even = np.concatenate([np.geomspace(LOWEST_ANGLE, 0.1, ANGLES // 2), np.linspace(0.1, np.pi, ANGLES)])
    poles = np.linalg.eigvals(loop.a)
    turns, widths = np.abs(np.imag(poles)) * period, np.maximum(np.abs(np.real(poles)) * period, 1e-6)
    around = turns[:, None] + widths[:, None] * np.concatenate([-NEAR_MODES, [0.0], NEAR_MODES])
    folded = np.abs((around.ravel() + np.pi) % (2 * np.pi) - np.pi)
    return np.unique(np.concatenate([even, folded[folded >= LOWEST_ANGLE]]))


def refine_angles(
    theta: Angles, values: Angles, most_dips: int = REFINED_DIPS, points: int = POINTS_PER_DIP
) -> Float[np.ndarray, " new"]:
    """Return new angles, about the least values of a test."""
    beside = np.concatenate([values[:1], values, values[-1:]])
    dips = np.flatnonzero(values <= np.minimum(beside[:-2], beside[2:]))
    dips = dips[np.argsort(values[dips], kind="stable")][:most_dips]
    low, high = np.maximum(dips - 1, 0), np.minimum(dips + 1, values.size - 1)
    return np.unique(np.linspace(theta[low], theta[high], points))


def list_multipliers(loop: FrictionLoop) -> Iterator[tuple[str, Multiplier]]:
    """Yield multipliers by name: none, Popov's, and those of Zames and Falb, over corner frequencies."""
    yield SIMPLEST, np.ones_like
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


@record(eq=False)
class FeedbackLimit:
    r"""The condition of a multiplier on the feedback C, one row per signal, at m angles: |weights C| < |1 + plants C|.

    K, to which b is proportional, is :math:`C/(1 + P^T C)`. So :math:`\gamma = \gamma_1^T K`,
    :math:`\beta = K^* B K`, and :math:`|2 + \gamma|^2 > \alpha\beta` reads

    .. math:: |1 + (P + \tfrac12 \gamma_1)^T C| > \tfrac12 \sqrt{\alpha\, C^* B C} .
    """

    plants: Complex[np.ndarray, "y m"]  # :math:`P + \gamma_1/2`, with the loop's delay
    # a root of :math:`\alpha B/4`, with what is beyond the aliases; `NO_FEEDBACK` where no feedback does
    weights: Complex[np.ndarray, "y y m"]


def limit_feedback(loop: FrictionLoop, theta: Angles, multiplier: str, factor: float) -> FeedbackLimit:
    """Return what is asked of C so that a multiplier shows stability for curves `factor` times as steep as they are.
    `loop`: the loop with its friction taken out; its own law does not matter. `theta`: shape (m,). `factor`: of the
    curves' own steepest slopes.
    """
    at = find_responses(loop, theta, feedback=False)
    through = loop.plant.responses(theta / (2 * np.pi * loop.plant.sample_time_s))
    weight = dict(list_multipliers(loop))[multiplier](at.s)
    possible, inverse = invert_mobility(weight, at.mobility, 1.0 / factor)
    right = np.concatenate([(weight[..., None] * at.command)[..., None], at.sensed], axis=-1)
    terms = np.conj(np.swapaxes(right, -1, -2)) @ (inverse @ right)
    reach = TAIL_GROWTH * at.order**2 * at.tail
    sums, ends = np.sum(terms, axis=1), terms[:, [0, -1]]
    far = reach[:, None, None] * np.sum(ends, axis=1)
    alpha = np.real(sums[:, 0, 0] + far[:, 0, 0])
    b = alpha[:, None, None] * np.conj(sums[:, 1:, 1:] + far[:, 1:, 1:])
    beyond = reach[:, None, None] * ends[:, :, 1:, 0]  # of gamma
    both = np.einsum("mki,mkj->mij", np.conj(beyond), beyond)
    # |x| + |y| <= |(sqrt(1 + e) x, sqrt(1 + 1/e) y)| for every e > 0, and is equal where e = |y|/|x|
    share = np.sqrt(np.trace(both, axis1=1, axis2=2).real / np.trace(b, axis1=1, axis2=2).real)[:, None, None] + 1e-9
    values, basis = np.linalg.eigh(0.25 * ((1.0 + share) * b + (1.0 + 1.0 / share) * both))
    root = np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.conj(np.swapaxes(basis, -1, -2))
    root = np.where(possible[:, None, None], root, NO_FEEDBACK * np.eye(len(through)))
    return FeedbackLimit(plants=through + 0.5 * sums[:, 1:, 0].T, weights=np.moveaxis(root, 0, -1))


def invert_mobility(weight: AtAliases, mobility: Mobility, inverse: float) -> tuple[Bool[np.ndarray, " m"], Mobility]:
    """Return where all D_k are positive definite at a 1/kappa, and their inverses; the identity where not."""
    possible, block = _form_blocks(weight, mobility, inverse)
    return possible, 1.0 / block if block.shape[-1] == 1 else np.linalg.inv(block)


def _form_blocks(weight: AtAliases, mobility: Mobility, inverse: float) -> tuple[Bool[np.ndarray, " m"], Mobility]:
    """Return where all D_k are positive definite at a 1/kappa, and these; the identity where not."""
    block = weight[..., None, None] * (mobility + inverse * np.eye(mobility.shape[-1]))
    block = 0.5 * (block + np.conj(np.swapaxes(block, -1, -2)))
    least = block[..., 0].real if block.shape[-1] == 1 else np.linalg.eigvalsh(block)  # of numbers LAPACK is slow
    possible = np.all(least > 0.0, axis=(-2, -1))
    return possible, np.where(possible[:, None, None, None], block, np.eye(block.shape[-1]))
