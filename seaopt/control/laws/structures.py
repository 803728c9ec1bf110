r"""The control law of every structure, as gains, as its parts at frequencies, and as a state space.

.. math:: F_m = C_r(q) F_\mathrm{ref} - C_y(q) F_\mathrm{meas}, \qquad q = z^{-1} .

With

.. math::
    F_m &= k_r F_\mathrm{ref} - k_p F_\mathrm{meas}
           + k_i \frac{T_s}{2} \frac{1+q}{1-q} (F_\mathrm{ref} - F_\mathrm{meas})
           + k_d D(q) (c F_\mathrm{ref} - F_\mathrm{meas}), \\
    D(q) &= \frac{1}{T_f + T_s}\, \frac{1 - q}{1 - q\, T_f/(T_f + T_s)} .

**Weights of the reference.** :math:`k_r = 1/P(0) + k_p` with :math:`c = 1` is feedforward and feedback of the error;
less of either weakens the zeros that the reference's path puts in front of the loop, and leaves the loop as it is
(Astrom, Hagglund, Advanced PID Control, ISA 2006, setpoint weighting). Where nothing integrates the error (`pd`, and a
`pid_dob` whose k_i is 0) the static gain is :math:`P(0) k_r/(1 + P(0) k_p)`, the observer's :math:`Q/P_n` being
:math:`1/P(0)` there: :math:`k_r = 1/P(0) + k_p` is then fixed, so that it is 1.

**Disturbance observer** (`pid_dob`; K. Ohnishi's, reviewed by Sariyildiz, Oboe, Ohnishi, IEEE TIE 67(3), 2020).
The motor force v of the law above is corrected by the disturbance that the nominal plant :math:`P_n` would need to
explain the measurement, :math:`F_m = v - Q (P_n^{-1} F_\mathrm{meas} - F_m)`, so that

.. math:: F_m = \frac{v - (Q/P_n) F_\mathrm{meas}}{1 - Q} .

:math:`P_n` is the design plant with its hold and delay. Write it as :math:`q^{1+d} B_s B_u / A`, where :math:`B_u`
holds the zeros that must not be inverted: those outside the unit circle, close to it, or on its left, where an
inverse rings. Delay and :math:`B_u` stay in Q, so that the inverse is exact, stable and causal:

.. math::
    Q = Q_0 \, q^{1+d} \frac{B_u(q)}{B_u(1)}, \qquad \frac{Q}{P_n} = Q_0 \frac{A(q)}{B_s(q) B_u(1)}, \qquad
    Q_0 = \Big(\frac{T_s}{T_q + T_s - q T_q}\Big)^2 .

:math:`Q(1) = 1`: the observer integrates, and k_i may be 0 beside it. With :math:`\delta = 1 - q`,
:math:`p = T_q/(T_q + T_s)` and :math:`q^{1+d} B_u(q)/B_u(1) = \sum_i \kappa_i q^i`, whose coefficients add up to 1,
the integrator comes out by hand, and so does what is left:

.. math:: 1 - Q = \frac{\delta\, E(q)}{(1 - p q)^2}, \qquad
          E = (1-p)^2 \sum_j \Big(\sum_{i>j} \kappa_i\Big) q^j + 2 p (1-p) + p^2 \delta, \qquad
          F_m = v + \frac{(1-p)^2}{\delta E} \Big(\sum_i \kappa_i q^i\, v
                - \frac{A}{B_s B_u(1)} F_\mathrm{meas}\Big) .

`Gains.law` puts the parts together so (`seaopt.control.laws.assembly`): in the inputs error and reference, where what
stands on the reference alone has one integrator less, so that the loop rests at its reference to the last bit.

**Cascade** (`cascade`). A speed loop of the motor, P or PI, inside the force loop:

.. math::
    F_m = \frac{F_\mathrm{ref}}{P(0)} + k_v \Big(1 + \frac{I}{T_v}\Big) (v_\mathrm{ref} - \Delta y_v), \qquad
    k_v v_\mathrm{ref} = k_r F_\mathrm{ref} - k_p F_\mathrm{meas} + k_i I (F_\mathrm{ref} - F_\mathrm{meas})
    + k_d D (c F_\mathrm{ref} - F_\mathrm{meas}),

:math:`I = \frac{T_s}{2}\frac{1+q}{1-q}`. :math:`y_v` is the motor's speed and :math:`\Delta = 1`, or the position that
an encoder reads and :math:`\Delta = (1 - q)/T_s`. Gains of the force loop are of effort, as everywhere: a drive's
(speed per force) are these over :math:`k_v`. So :math:`k_v = 0` is a pid, and all is affine in :math:`k_v` too.
The feedforward acts beside the speed loop, whose integral would otherwise sum it up.

**Notch**, in series with all of it: a biquad :math:`(s^2 + 2 g \zeta \omega s + \omega^2)/(s^2 + 2 \zeta \omega s +
\omega^2)` by Tustin's rule, prewarped to be exact at :math:`\omega`; :math:`\zeta` is its width, g its depth.

**Prefilter**, in series with C_r alone: a low-pass of first or second order, :math:`\omega/(s + \omega)` or
:math:`\omega^2/(s^2 + 2\zeta\omega s + \omega^2)` by the same rule, whose static gain is 1. It takes from the reference
what the feedback would make a peak of, so that the loop may be faster than the bandwidth asked.

At fixed T_f, T_q, T_v, notch and prefilter, C_r, C_y and what feeds the speed back are affine in
(k_p, k_i, k_d, k_r, c k_d, k_v).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from itertools import zip_longest
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from seaopt.codec import to_content
from seaopt.control.laws.assembly import Assembly, Columns
from seaopt.control.loops.compensation.link_feedforward import LOWEST_HZ, LinkPath
from seaopt.control.loops.law import Law
from seaopt.control.loops.loop import Loop
from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.control.loops.transfer_function import Frequencies, Response, TransferFunction
from seaopt.formatting import format_percent
from seaopt.options import option
from seaopt.records import record

Structure = Literal["pd", "pid", "pid_dob", "cascade", "custom"]
SpeedLaw = Literal["P", "PI"]
PrefilterOrder = Literal["first_order", "second_order"]
PREFILTER_ORDERS: tuple[PrefilterOrder, ...] = ("first_order", "second_order")
ReferenceWeights = Literal["tuned", "error", "measurement"]
CASCADE: Structure = "cascade"
TUNED: tuple[Structure, ...] = ("pd", "pid", "pid_dob", CASCADE)
CUSTOM: Structure = "custom"  # a law that is given, and that no gains describe
STRUCTURES = (*TUNED, CUSTOM)
LARGEST_INVERTED = 0.95  # zeros of larger magnitude, or of negative real part, are left in Q
PREFILTER = "prefilter_corner_hz"  # the gain that every prefilter has
LAW_GAINS = ("k_p", "k_i", "k_d", "T_f", "k_r", "c")
PREFILTER_DAMPING = "prefilter_damping"  # that of one of second order
NOTCH_GAINS = ("notch_frequency_hz", "notch_width", "notch_depth")
INNER_GAINS = ("k_v", "k_ff")  # of a cascade besides; and T_v where its speed loop integrates
SURPLUS_ROUNDING = 1e-12  # the reference's own gain at 0 Hz less 1/P(0) is zero below this share of its terms
AGREES = 1e-6  # numbers for reading give the law's response to this share
MADE_ROUNDING = 1e-10  # of a response's largest: left where a prefilter takes away next to all of it
OBSERVED = 50  # frequencies at which an observer is weighed
LEAST_OBSERVED = 0.02  # of a disturbance: an observer that takes less away is of no use
COMPARED = np.geomspace(1e-4, 0.49, 60)  # frequencies at which it is compared, of the sample rate
OBJECTIVE_HZ = 0.1  # disturbances count from here
HALF_POWER_OF_Q = math.sqrt(math.sqrt(2.0) - 1.0)  # omega T_q where two equal lags are 3 dB down


@record
class Notch:
    """A notch; what is left out is tuned."""

    frequency_hz: float | None = option("Its centre; tuned where left out.", default=None, unit="Hz", least=LOWEST_HZ)
    width: float | None = option(
        "Damping ratio of its poles: it is 2 width frequency_hz wide; tuned where left out.",
        default=None,
        above=0.0,
        most=10.0,
    )
    depth: float | None = option("Gain at its centre; tuned where left out.", default=None, above=0.0, most=1.0)

    def biquad(self, sample_time_s: float) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Return numerator and denominator, denominator not normalised; every field must have a value."""
        assert self.frequency_hz is not None and self.width is not None and self.depth is not None
        w = math.tan(math.pi * self.frequency_hz * sample_time_s)
        num, den = (
            np.array([1 + damping + w * w, 2 * (w * w - 1), 1 - damping + w * w])
            for damping in (2 * self.depth * self.width * w, 2 * self.width * w)
        )
        return num, den


@record
class Prefilter:
    """A low-pass in series with the reference; what is left out is tuned."""

    order: PrefilterOrder = option("Without or with a damping.", default="first_order", stated=True)
    corner_hz: float | None = option(
        "Where its asymptotes meet; tuned where left out.", default=None, unit="Hz", least=LOWEST_HZ
    )
    damping: float | None = option(
        "Damping ratio of one of second order; tuned where left out.", default=None, above=0.0, most=10.0
    )

    @property
    def is_second_order(self) -> bool:
        """Whether it has a damping."""
        return self.order == "second_order"

    def filters(self, sample_time_s: float) -> tuple[TransferFunction, TransferFunction]:
        """Return F and (F - 1)/(1 - q) over one denominator; every field it uses must have a value."""
        assert self.corner_hz is not None
        w = math.tan(math.pi * self.corner_hz * sample_time_s)
        if not self.is_second_order:
            num, den, difference = [w, w], np.array([1 + w, w - 1]), [-1.0, 0.0]
        else:
            assert self.damping is not None
            damping = 2 * self.damping * w
            num, difference = [w * w, 2 * w * w, w * w], [-1 - damping, 1 - damping, 0.0]
            den = np.array([1 + damping + w * w, 2 * (w * w - 1), 1 - damping + w * w])
        over, left = (TransferFunction(num=np.array(top) / den[0], den=den / den[0]) for top in (num, difference))
        return over, left


@record(eq=False)
class Nominal:
    """The nominal plant of a disturbance observer in its two parts: Q = Q_0 kept, Q/P_n = Q_0 inverse."""

    kept: Float[np.ndarray, " n"]  # q^(1+d) B_u(q)/B_u(1), coefficients in ascending powers of q
    # A(q)/(B_s(q) B_u(1)) as a product of factors of second order at most: multiplied out it would lose digits
    inverse: tuple[TransferFunction, ...]

    @classmethod
    def of(cls, plant: DigitalPlant) -> Nominal:
        """Split a sampled plant."""
        a = np.poly(plant.a)
        b = np.poly(plant.a - np.outer(plant.b, plant.c[0])) - a + plant.d[0] * a  # of z, descending: of q, ascending
        lead = int(np.argmax(np.abs(b) > 1e-9 * np.max(np.abs(b))))
        zeros = np.roots(b[lead:]).astype(complex)
        inverted = (np.abs(zeros) < LARGEST_INVERTED) & (np.real(zeros) > 0.0)
        left = np.atleast_1d(np.real(np.poly(zeros[~inverted])))
        poles = np.linalg.eigvals(plant.a).astype(complex)
        pairs = zip_longest(_factors(poles), _factors(zeros[inverted]), fillvalue=np.ones(1))
        inverse = [TransferFunction(num=top, den=below) for top, below in pairs]
        gain = 1.0 / (b[lead] * np.sum(left))
        if np.isfinite(plant.static_gain) and plant.static_gain:  # which is known better than what b and left give
            gain = 1.0 / (plant.static_gain * cls(kept=left, inverse=tuple(inverse)).static_inverse)
        inverse.append(TransferFunction(num=np.array([gain]), den=np.ones(1)))
        return cls(
            kept=np.concatenate([np.zeros(lead + plant.delay_samples), left / np.sum(left)]), inverse=tuple(inverse)
        )

    def scaled(self, gain: float) -> Nominal:
        """Return the same of a plant whose inverse has another gain, `inverse_gain`."""
        return replace(self, inverse=(*self.inverse[:-1], TransferFunction(num=np.array([gain]), den=np.ones(1))))

    @property
    def inverse_gain(self) -> float:
        """The number among the factors of the inverse, the last one."""
        return float(self.inverse[-1].num[0])

    @property
    def static_inverse(self) -> float:
        """Its inverse at 0 Hz."""
        return math.prod(float(np.sum(part.num) / np.sum(part.den)) for part in self.inverse)

    def inverse_response(self, f: Frequencies, sample_time_s: float) -> Response:
        """Return A/(B_s B_u(1)) at frequencies in Hz."""
        return np.prod([part.response(f, sample_time_s) for part in self.inverse], axis=0)


@record(eq=False)
class DisturbanceObserver:
    """A disturbance observer: the filters Q and Q/P_n.

    Parameters
    ----------
    nominal : Nominal
        Of the design plant.
    T_q : float
        Seconds: time constant of Q_0.
    """

    nominal: Nominal
    T_q: float

    @property
    def bandwidth_hz(self) -> float:
        """Where Q_0, as two continuous lags, is 3 dB down."""
        return HALF_POWER_OF_Q / (2 * math.pi * self.T_q)

    def warn(self, share: float, bandwidth_hz: float) -> tuple[str, ...]:
        """Return that it does next to nothing, where it takes no more than a `share` off a disturbance."""
        if share >= LEAST_OBSERVED:
            return ()
        return (
            f"the disturbance observer does next to nothing: Q is 3 dB down at {self.bandwidth_hz:.3g} Hz, and from "
            f"{OBJECTIVE_HZ:g} to {0.1 * bandwidth_hz:.3g} Hz it takes at most {format_percent(max(share, 0.0), 2)} "
            'off what the gains alone leave of a disturbance; structure = "pid" does as well',
        )

    def filters(self, sample_time_s: float) -> tuple[TransferFunction, TransferFunction]:
        """Return Q and Q/P_n, multiplied out."""
        pole, short = self._pole(sample_time_s)
        lags, gain, inverse = np.convolve([1.0, -pole], [1.0, -pole]), short**2, self.nominal.inverse
        num, den = (functools.reduce(np.convolve, [getattr(part, end) for part in inverse]) for end in ("num", "den"))
        return (
            TransferFunction(num=gain * self.nominal.kept, den=lags),
            TransferFunction(num=gain * num, den=np.convolve(lags, den)),
        )

    def to_dict(self, sample_time_s: float) -> dict[str, Any]:
        """Return the filters, and what it takes to build it again, as they stand in controller.json."""
        q, inverse = self.filters(sample_time_s)
        content = {
            "T_q": self.T_q,
            "bandwidth_hz": self.bandwidth_hz,
            "Q": q,
            "Q_over_P_n": inverse,
            "kept": self.nominal.kept,
            "inverse": self.nominal.inverse,
        }
        return to_content(content)

    def correct(self, law: Assembly, surplus: float, sample_time_s: float) -> Assembly:
        """Return (law - Q/P_n measurement)/(1 - Q), of the inputs error and reference.

        `surplus` is what acts on the reference alone at 0 Hz, less 1/P_n: where it is zero, so is its integral.
        """
        seen = Assembly.of_gains(np.array([1.0, -1.0]))  # - measurement = error - reference
        for part in self.nominal.inverse:
            seen = seen.through(part)
        return self._enclose(law, law, seen, np.array([0.0, surplus]), sample_time_s)

    def limit(self, law: Assembly, sample_time_s: float) -> Assembly:
        """Return (law + Q excess)/(1 - Q) of one input, the excess: what the limit takes off the command."""
        return self._enclose(law, law.plus(Assembly.of_gains(np.ones(1))), None, np.zeros(1), sample_time_s)

    def _enclose(
        self,
        law: Assembly,
        through_q: Assembly,
        through_inverse: Assembly | None,
        surplus: Columns,
        sample_time_s: float,
    ) -> Assembly:
        """Return law + (Q through_q + Q_0 through_inverse)/(1 - Q); `surplus`: at 0 Hz of the inputs that nothing
        integrates but Q.
        """
        pole, short = self._pole(sample_time_s)
        kept = self.nominal.kept
        e = np.zeros(max(kept.size - 1, 2))
        e[: kept.size - 1] = short**2 * np.cumsum(kept[:0:-1])[::-1]
        at_one = float(np.sum(e)) + 2 * pole * short
        e[:2] += [2 * pole * short + pole**2, -(pole**2)]
        over_e = TransferFunction(num=short**2 / e[:1], den=e / e[0])
        estimate = through_q.through(TransferFunction(num=kept, den=np.ones(1)))
        estimate = (estimate if through_inverse is None else estimate.plus(through_inverse)).through(over_e)
        return law.plus(estimate.integrated(np.array([estimate.static[0], *(short**2 / at_one * surplus[1:])])))

    def _pole(self, sample_time_s: float) -> tuple[float, float]:
        """Return p and 1 - p."""
        return self.T_q / (self.T_q + sample_time_s), sample_time_s / (self.T_q + sample_time_s)


@record
class SpeedLoop:
    """The signal of a cascade's speed loop: the motor's speed, or its encoder."""

    differenced: bool  # it is an encoder's position, and the law takes the difference over one sample

    def sense(self, q: Response, sample_time_s: float) -> Response:
        """Return the speed per what is read, at q = exp(-j omega T_s)."""
        return (1.0 - q) / sample_time_s if self.differenced else np.ones_like(q)


@record
class InnerLoop:
    """The speed loop of a cascade."""

    k_v: float  # effort per motor speed, N s/m or N m s/rad
    T_v: float  # seconds: its integral time; infinite for none
    k_ff: float  # effort per reference besides, 1/P(0)
    speed: SpeedLoop  # what it reads

    @property
    def integrates(self) -> bool:
        """Whether it is a PI."""
        return math.isfinite(self.T_v)

    def close(self, law: Assembly, sample_time_s: float) -> Assembly:
        """Return the law that this loop is closed around: `law` is k_v v_ref, of error and reference."""
        read = Assembly.of_gains(np.array([0.0, 0.0, -self.k_v]))
        if self.speed.differenced:
            read = read.through(TransferFunction(num=np.array([1.0, -1.0]) / sample_time_s, den=np.ones(1)))
        whole = law.widened(3).plus(read)
        if self.integrates:  # 1 + I/T_v = 1 - h + 2 h/delta with h = T_s/(2 T_v), as of k_i
            static = whole.static * np.array([1.0, 1.0, 0.0 if self.speed.differenced else 1.0])
            half = 0.5 * sample_time_s / self.T_v
            whole = whole.scaled(1.0 - half).plus(whole.integrated(static).scaled(2.0 * half))
        return whole.plus(Assembly.of_gains(np.array([0.0, self.k_ff, 0.0])))


@record
class Gains:
    """The numbers of a law.

    Parameters
    ----------
    k_p : float
        N/N.
    k_i : float
        1/s.
    k_d : float
        s.
    T_f : float
        Seconds: time constant of the derivative's filter.
    k_r : float
        N/N: weight of the reference; in a cascade besides its k_ff, and negative down to it.
    c : float
        Weight of the reference in what is differentiated.
    observer : DisturbanceObserver, optional
        Of a pid_dob.
    notch, prefilter : Notch and Prefilter, optional
        With a value in every field that they use.
    inner : InnerLoop, optional
        Of a cascade.
    link : LinkPath, optional
        What is fed forward of the link's motion, the last signal read.
    """

    k_p: float
    k_i: float
    k_d: float
    T_f: float
    k_r: float
    c: float = 1.0
    observer: DisturbanceObserver | None = None
    notch: Notch | None = None
    inner: InnerLoop | None = None
    prefilter: Prefilter | None = None
    link: LinkPath | None = None

    @property
    def integral_rad_s(self) -> float:
        """How fast the integral takes an error away, rad/s; of two integrals the ratio of their gains."""
        if self.inner is not None and self.inner.integrates:
            return self.k_i / (self.k_p + self.k_i * self.inner.T_v)
        return self.k_i / (1.0 + self.k_p)

    def weigh_observer(self, loop: Loop, bandwidth_hz: float) -> float:
        """Return the largest share that the observer takes off abs(S) of a loop, beside the same gains without it, from
        where disturbances count to a tenth of the bandwidth: above that its phase costs more than it takes away.
        """
        f = np.geomspace(OBJECTIVE_HZ, max(0.1 * bandwidth_hz, OBJECTIVE_HZ), OBSERVED)
        bare = replace(loop, law=replace(self, observer=None).law("pid", loop.law.sample_time_s))
        return float(np.max(1.0 - np.abs(loop.sensitivity(f) / bare.sensitivity(f))))

    def by_name(self) -> dict[str, float]:
        """Return the numbers by name, those of observer, notch and prefilter too."""
        out = {name: getattr(self, name) for name in LAW_GAINS}
        if self.observer is not None:
            out["T_q"] = self.observer.T_q
        if self.inner is not None:
            out |= {name: getattr(self.inner, name) for name in INNER_GAINS}
            out |= {"T_v": self.inner.T_v} if self.inner.integrates else {}
        if self.notch is not None:
            out |= {f"notch_{name}": value for name, value in asdict(self.notch).items()}
        if self.prefilter is not None:
            numbers = {name: getattr(self.prefilter, name) for name in ("corner_hz", "damping")}
            out |= {f"prefilter_{name}": value for name, value in numbers.items() if value is not None}
        return out

    @classmethod
    def from_names(
        cls,
        numbers: Mapping[str, float],
        observer: DisturbanceObserver | None = None,
        speed: SpeedLoop | None = None,
        link: LinkPath | None = None,
    ) -> Gains:
        """Return the gains of `by_name`; observer, what a speed loop reads and link are given."""
        notch = inner = prefilter = None
        if PREFILTER in numbers:
            damping = numbers.get(PREFILTER_DAMPING)
            order = PREFILTER_ORDERS[damping is not None]
            prefilter = Prefilter(order=order, corner_hz=numbers[PREFILTER], damping=damping)
        if speed is not None:
            inner = InnerLoop(k_v=numbers["k_v"], k_ff=numbers["k_ff"], T_v=numbers.get("T_v", math.inf), speed=speed)
        if NOTCH_GAINS[0] in numbers:
            notch = Notch(**{field.name: numbers[f"notch_{field.name}"] for field in fields(Notch)})
        return cls(
            **{name: numbers[name] for name in LAW_GAINS},
            observer=observer,
            notch=notch,
            inner=inner,
            prefilter=prefilter,
            link=link,
        )

    def makes(self, law: Law, structure: Structure) -> bool:
        """Tell whether these gains make a law: its responses, to a millionth or to rounding, and its integrators."""
        made, f = self.law(structure, law.sample_time_s), COMPARED / law.sample_time_s
        expected = made.responses(f)
        rounding = MADE_ROUNDING * np.max(np.abs(expected), axis=-1, keepdims=True)
        near = np.abs(law.responses(f) - expected) <= AGREES * np.abs(expected) + rounding
        return made.integrators == law.integrators and bool(np.all(near))

    def law(self, structure: Structure, sample_time_s: float, share: float | None = None) -> Law:
        """Return the law as a state space from reference and what is measured; `Law.balanced` is what runs. With a
        `share` of the excess that its integral takes (an observer's law) a last input is that excess, the limited
        effort less the unlimited, which the observer sees.
        """
        alone = self.k_r - self.k_p  # the two inputs are the error and the reference, on which these act alone
        short = sample_time_s / (self.T_f + sample_time_s)
        lag = TransferFunction(num=np.array([1.0, -1.0]), den=np.array([1.0, -self.T_f / (self.T_f + sample_time_s)]))
        rate = Assembly.of_gains(self.k_d * short / sample_time_s * np.array([1.0, self.c - 1.0])).through(lag)
        law = Assembly.of_gains(np.array([self.k_p, alone])).plus(rate)
        if structure != "pd" and self.k_i:  # (1 + q)/(1 - q) = 2/delta - 1
            half = self.k_i * sample_time_s / 2 * np.array([1.0, 0.0])
            law = law.plus(Assembly.of_gains(2 * half).integrated(2 * half)).plus(Assembly.of_gains(-half))
        if self.observer is not None:
            inverse = self.observer.nominal.static_inverse
            surplus = alone - inverse
            rounding = SURPLUS_ROUNDING * (abs(self.k_p) + abs(alone) + abs(inverse))
            law = self.observer.correct(law, surplus if abs(surplus) > rounding else 0.0, sample_time_s)
        if self.inner is not None:
            law = self.inner.close(law, sample_time_s)
        if self.notch is not None:
            over, under = self.notch.biquad(sample_time_s)
            law = law.through(TransferFunction(num=over / under[0], den=under / under[0]))
        if self.prefilter is not None:
            law = law.with_reference_behind(*self.prefilter.filters(sample_time_s))
        if share is not None and self.observer is not None:
            taken = Assembly.of_gains(np.array([share]))  # q/(1 - q) = 1/delta - 1
            wound = self.observer.limit(taken.integrated(taken.static).plus(taken.scaled(-1.0)), sample_time_s)
            law = law.widened(3).plus(wound.widened(-3))
        made = law.law(sample_time_s)
        if self.link is None:
            return made
        made = made.reading(self.link.feedback(sample_time_s))
        return made if share is None else replace(made, b=made.b[:, [0, 1, 3, 2]], d=made.d[[0, 1, 3, 2]])


def _factors(roots: Complex[np.ndarray, " n"]) -> list[Float[np.ndarray, " _"]]:
    """Return real polynomials of second order at most with these roots, those of the slowest first."""
    pairs = [np.real(np.poly([root, np.conj(root)])) for root in roots[np.imag(roots) > 0.0]]
    real = np.sort(np.real(roots[np.imag(roots) == 0.0]))[::-1]
    factors = pairs + [np.atleast_1d(np.poly(real[i : i + 2])) for i in range(0, real.size, 2)]
    return sorted(factors, key=np.sum)


class LawTerms(NamedTuple):
    """The parts of a law at some frequencies: C_y = series (k_p + k_i integral + k_d rate + observer). `ahead` is in
    series with feedforward: `series` but for the integral of a speed loop. C_r is behind the `prefilter` besides.
    """

    series: Any
    integral: Any
    rate: Any
    observer: Any
    ahead: Any
    prefilter: Any


def evaluate_terms(
    q: Any,
    ts: Any,
    T_f: Any,
    observer: tuple[Any, Any, Any] | None = None,
    notch: tuple[Any, Any, Any] | None = None,
    speed_rate: Any = 0.0,
    prefilter: tuple[Any, Any | None] | None = None,
) -> LawTerms:
    """Return the terms of a law at q, of numbers, arrays or symbols. `observer`: time constant, and the nominal plant's
    two parts at q. `notch`, `prefilter`: w = tan(pi f T_s) of its frequency; damping None of first order. `speed_rate`:
    1/T_v of a speed loop, rad/s; 0 where it does not integrate.
    """
    series: Any = 1.0
    more: Any = 0.0
    low_pass: Any = 1.0
    s = (1.0 - q) / (1.0 + q)
    if observer is not None:
        T_q, kept, inverse = observer
        lag = ts / (T_q + ts - q * T_q)
        series, more = 1.0 / (1.0 - lag * lag * kept), lag * lag * inverse
    if notch is not None:
        w, width, depth = notch
        series = series * (s * s + s * (2.0 * depth * width * w) + w * w) / (s * s + s * (2.0 * width * w) + w * w)
    if prefilter is not None:
        w, damping = prefilter
        low_pass = w / (s + w) if damping is None else (w * w) / (s * s + s * (2.0 * damping * w) + w * w)
    rate = (1.0 - q) / (T_f + ts - q * T_f)
    integral = (1.0 + q) / (1.0 - q) * (ts / 2)
    inside = series if isinstance(speed_rate, float) and not speed_rate else series * (integral * speed_rate + 1.0)
    return LawTerms(series=inside, integral=integral, rate=rate, observer=more, ahead=series, prefilter=low_pass)
