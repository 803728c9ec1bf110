r"""What a sampled impedance controller is to the world: when no passive environment destabilises it, exactly.

The link is moved with the speed v, and takes the effort :math:`F_e` (`seaopt.control.loops.port`: :math:`F = G_{11} u
+ G_{12} v`, :math:`F_e = G_{21} u + G_{22} v`). The law is sampled with the period T, d samples late, and its output is
held; so is the outer loop (`seaopt.control.loops.outer_loop`), and

.. math:: u^* = -C_y F^* - W x^*, \qquad W = \sigma C_r(z) (K_v + D_v D(z)) .

At :math:`\theta = \omega T` the loop couples the aliases :math:`\omega_k = (\theta + 2\pi k)/T`: with
:math:`s_k = j \omega_k`, the hold :math:`h(s) = (1 - e^{-sT})/s` and the sampled plant P with the link held,

.. math::
    F_{e,k} = G_{22}(s_k) v_k + a_k \sum_l b_l v_l, \qquad
    a_k = -G_{21}(s_k) \frac{h(s_k)}{T} \frac{z^{-d}}{1 + P z^{-d} C_y}, \qquad
    b_l = C_y G_{12}(s_l) + \frac{W}{s_l} ,

where :math:`P C_y` and :math:`C_y G_{12}` are sums over the signals that the law reads.

An environment of the impedances :math:`E_k` at these frequencies, the link's own inertia in them, closes it:
:math:`1 + \sum_k a_k b_k/(G_{22}(s_k) + E_k) = 0` is an oscillation. A passive linear environment may have any
:math:`E_k` with :math:`\mathrm{Re}\, E_k \ge 0`, each for itself, so that with
:math:`D_k = d + \mathrm{Re}\, G_{22}(s_k)`, d being the damper at the link, each :math:`1/(G_{22} + E_k)` fills the
disk about :math:`1/(2 D_k)` that touches 0, and their sum a disk too. With :math:`c_k = a_k b_k/D_k` no passive
environment makes the loop unstable if, and only if, the loop is stable with the link held and at every
:math:`\theta \in (0, \pi]`

.. math:: \Big| 2 + \sum_k c_k \Big| > \sum_k |c_k| .

The disk is convex and holds the link held (0), so that no oscillation is passed on the way from there. For a rigid link
without an actuator between, :math:`G_{21} = -1`, :math:`G_{12} = 0`, all :math:`c_k` have one angle, and the
condition is :math:`d > \frac{T}{2} \frac{1}{1 - \cos\theta} \mathrm{Re}[(1 - e^{-j\theta}) H]`, that of Colgate and
Schenkel (J. Robotic Systems 14(1), 1997), who showed it to be necessary and sufficient.

Environments that couple frequencies (contact that opens and closes) are more than that. Without any damper at the port
or in the spring nothing takes energy between the samples: the sums then diverge, and nothing is passive.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control.impedance.link import ControlledLink
from seaopt.control.loops.absolute_stability import refine_angles
from seaopt.control.loops.loop import GROWING, Loop
from seaopt.control.loops.outer_loop import Impedance
from seaopt.records import record

Angles = Float[np.ndarray, " m"]
Points = Float[np.ndarray, " n"]
Aliases = Complex[np.ndarray, "m k"]
ALIASES = 24  # on either side; what is beyond is summed as falling like 1/omega^2
NEAR = 2  # aliases on either side whose c_k are added exactly; of the others only the size counts
LOWEST_HZ = 0.01
NEAR_MODES = np.geomspace(0.05, 20.0, 12)  # half widths of a mode
BLOCK = 500  # points that are looked at together
REFINEMENTS, DIPS, POINTS_PER_DIP = 3, 6, 17
FAILING = 40  # frequencies at which an environment is looked for


@record(eq=False)
class PortTerms:
    """a_k b_k = p_k + W q_k at m angles and k aliases, and what takes energy there, with one damper at the link."""

    theta: Angles
    by_force: Aliases  # p_k, the aliases in the order -N to N
    by_place: Aliases  # q_k
    weights: Complex[np.ndarray, "2 m"]  # W per stiffness and per damping
    resistance: Float[np.ndarray, "m k"]  # the actuator's own Re G_22, and the least of it at the highest frequencies
    least_resistance: float
    damper: float  # at the link

    def margin(self, stiffness: Points, damping: Points) -> Float[np.ndarray, "n m"]:
        """Return (|2 + sum c_k|^2 - (sum |c_k|)^2)/4 at every angle for n pairs of gains, positive where it is passive.
        Of one alias it is 1 + Re c: 1 without control, 0 where nothing is left of the damping. Of the far aliases the
        sizes of p_k and W q_k are added, which is more than that of their sum. Where nothing takes energy between the
        samples it is -inf.
        """
        dissipated, floor = self.damper + self.resistance, self.damper + self.least_resistance
        if not floor > 0.0:
            return np.full((stiffness.size, self.theta.size), -np.inf)
        by_force, by_place = (
            _add_beyond(part / dissipated, dissipated / floor, self.theta) for part in (self.by_force, self.by_place)
        )
        near = slice(ALIASES - NEAR, ALIASES + NEAR + 1)
        far = np.ones(by_force.shape[1], dtype=bool)
        far[near] = False
        p_all, q_all = np.sum(by_force, axis=1), np.sum(by_place, axis=1)
        p_far, q_far = (np.sum(np.abs(part[:, far]), axis=1) for part in (by_force, by_place))
        w = stiffness[:, None] * self.weights[0] + damping[:, None] * self.weights[1]
        whole, sizes = np.abs(2.0 + p_all + w * q_all), p_far + np.abs(w) * q_far
        for p, q in zip(by_force[:, near].T, by_place[:, near].T, strict=True):
            sizes += np.abs(p + w * q)
        return 0.25 * (whole - sizes) * (whole + sizes)

    def margin_of(self, impedance: Impedance) -> Angles:
        """Return the margin of one impedance at every angle; its filter is the port's."""
        return self.margin(np.array([impedance.stiffness]), np.array([impedance.damping]))[0]

    def least(self, stiffness: Points, damping: Points) -> Points:
        """Return the least margin over the angles, for n pairs of gains."""
        blocks = (slice(i, i + BLOCK) for i in range(0, stiffness.size, BLOCK))
        return np.concatenate([np.min(self.margin(stiffness[some], damping[some]), axis=1) for some in blocks])


@record(eq=False)
class SampledPort:
    """The port of a force-controlled link, with an outer loop of any gains and one filter of its speed."""

    link: ControlledLink  # actuator, law and link
    velocity_filter_s: float  # T_v of the outer loop

    def held_stable(self) -> bool:
        """Tell whether nothing grows with the link held, which the gains do not change."""
        return bool(np.max(np.abs(self.held_poles()), initial=0.0) <= GROWING)

    def held_poles(self) -> Complex[np.ndarray, " n"]:
        """Return the eigenvalues of the force loop with the link held."""
        return Loop(plant=self.link.held(), law=self.link.law).eigenvalues()

    def angles(self) -> Angles:
        """Return angles from nearly static to the Nyquist frequency, close about the modes of plant and loop."""
        period = self.link.sample_time_s
        locked = self.held_poles()
        poles = np.concatenate([self.link.port.find_poles(), np.log(locked[np.abs(locked) > 1e-6]) / period])
        at, width = np.abs(np.imag(poles)), np.abs(np.real(poles))
        around = at[:, None] + width[:, None] * np.concatenate([-NEAR_MODES, [0.0], NEAR_MODES])
        folded = np.abs((around.ravel() * period + np.pi) % (2 * np.pi) - np.pi)
        lowest = 2 * np.pi * LOWEST_HZ * period
        even = np.concatenate([np.geomspace(lowest, 0.3, 160), np.linspace(0.3, np.pi, 160)])
        return np.unique(np.concatenate([even, folded[folded >= lowest]]))

    def terms(self, theta: Angles, damper: float) -> PortTerms:
        """Return the terms at angles with a damper at the link."""
        link, period = self.link, self.link.sample_time_s
        orders = np.arange(-ALIASES, ALIASES + 1)
        omega = (theta[:, None] + 2 * np.pi * orders) / period
        response = link.port.response(np.abs(omega).ravel() / (2 * np.pi))
        conjugated = omega < 0.0

        def at(values: Complex[np.ndarray, " n"]) -> Aliases:
            grid = values.reshape(omega.shape)
            return np.where(conjugated, np.conj(grid), grid)

        s, z = 1j * omega, np.exp(1j * theta)
        f = theta / (2 * np.pi * period)
        reference, feedback = link.law.reference_response(f), link.law.feedback_responses(f)
        closed = z**-link.delay_samples / (1.0 + np.sum(link.held().responses(f) * feedback, axis=0))
        moved = sum(c[:, None] * at(g) for c, g in zip(feedback, response.motion_to_read, strict=True))
        drive = -at(response.motor_to_port) * (-np.expm1(-1j * theta) * closed)[:, None] / (s * period)
        outer = link.speed_filter(self.velocity_filter_s)
        gain = link.direction * reference
        return PortTerms(
            theta=theta,
            by_force=drive * moved,
            by_place=drive / s,
            weights=np.array([gain, gain * outer.difference(z)]),
            resistance=np.maximum(np.real(at(response.motion_to_port)), 0.0),
            least_resistance=self._find_floor(),
            damper=damper,
        )

    def worst(self, impedance: Impedance, damper: float, theta: Angles) -> tuple[float, float]:
        """Return the least margin of an impedance with a damper at the link, also between the angles, and its angle."""
        least, worst, angles = np.inf, float(theta[0]), theta
        for _ in range(REFINEMENTS):
            margin = self.terms(angles, damper).margin_of(impedance)
            at = int(np.argmin(margin))
            if margin[at] < least:
                least, worst = float(margin[at]), float(angles[at])
            angles = refine_angles(angles, margin, DIPS, POINTS_PER_DIP)
        return least, worst

    def find_failing_hz(self, impedance: Impedance, damper: float) -> Float[np.ndarray, " m"]:
        """Return frequencies at which an impedance is not passive, at most `FAILING`, and where it is least so."""
        theta = self.angles()
        margin, worst = self.terms(theta, damper).margin_of(impedance), self.worst(impedance, damper, theta)[1]
        failing = theta[(margin <= 0.0) & np.isfinite(margin)]
        if failing.size:
            failing = failing[np.unique(np.linspace(0, failing.size - 1, FAILING).astype(int))]
        return np.union1d(failing, [worst]) / (2 * np.pi * self.link.sample_time_s)

    def refine(self, impedance: Impedance, damper: float, theta: Angles) -> Float[np.ndarray, " new"]:
        """Return new angles about those at which an impedance is least passive."""
        return refine_angles(theta, self.terms(theta, damper).margin_of(impedance), DIPS, POINTS_PER_DIP)

    def _find_floor(self) -> float:
        """Return what the actuator's own port dissipates at the highest frequencies: its spring's damper."""
        f = np.array([1e6, 1e7]) / self.link.sample_time_s
        low, high = np.maximum(np.real(self.link.port.response(f).motion_to_port), 0.0)
        return float(high) if high > 0.5 * low > 0.0 else 0.0


def _add_beyond(terms: Aliases, over_floor: Float[np.ndarray, "m k"], theta: Angles) -> Complex[np.ndarray, "m new"]:
    """Return terms that fall at least like 1/omega^2 with the sum beyond the last alias on either side. It is summed as
    if they fell no faster from there, and as if the port dissipated its least.
    """
    from scipy.special import polygamma  # deferred: scipy is slow to load

    turns = theta / (2 * np.pi)
    sides = [
        terms[:, end] * over_floor[:, end] * (ALIASES + sign * turns) ** 2 * polygamma(1, ALIASES + 1 + sign * turns)
        for end, sign in ((0, -1.0), (-1, 1.0))
    ]
    return np.column_stack([terms, *sides])
