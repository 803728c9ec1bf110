r"""The control law: two transfer functions in q = z^-1.

.. math:: F_m = C_r(q) F_\mathrm{ref} - C_y(q) F_\mathrm{meas}

Every structure is written as these two,

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

:math:`Q(1) = 1`: the observer integrates, and k_i may be 0 beside it.

**Notch**, in series with all of it: a biquad :math:`(s^2 + 2 g \zeta \omega s + \omega^2)/(s^2 + 2 \zeta \omega s +
\omega^2)` by Tustin's rule, prewarped to be exact at :math:`\omega`; :math:`\zeta` is its width, g its depth.

At fixed T_f, T_q and notch, C_r and C_y are affine in (k_p, k_i, k_d, k_r, c k_d).
"""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.records import record

Structure = Literal["pd", "pid", "pid_dob"]
ReferenceWeights = Literal["tuned", "error", "measurement"]
REFERENCE_WEIGHTS: tuple[ReferenceWeights, ...] = ("tuned", "error", "measurement")
STRUCTURES: tuple[Structure, ...] = ("pd", "pid", "pid_dob")
LARGEST_INVERTED = 0.95  # zeros of larger magnitude, or of negative real part, are left in Q
LAW_GAINS = ("k_p", "k_i", "k_d", "T_f", "k_r", "c")
HALF_POWER_OF_Q = math.sqrt(math.sqrt(2.0) - 1.0)  # omega T_q where two equal lags are 3 dB down


@record
class Notch:
    """A notch; what is None is tuned.

    Parameters
    ----------
    frequency_hz : float, optional
        Its centre.
    width : float, optional
        Damping ratio of its poles: it is 2 width frequency_hz wide.
    depth : float, optional
        Gain at its centre, above 0 to 1.

    """

    frequency_hz: float | None = None
    width: float | None = None
    depth: float | None = None

    def biquad(self, sample_time_s: float) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Return numerator and denominator, denominator not normalised; every field must have a value."""
        assert self.frequency_hz is not None and self.width is not None and self.depth is not None
        w = math.tan(math.pi * self.frequency_hz * sample_time_s)
        num, den = (
            np.array([1 + damping + w * w, 2 * (w * w - 1), 1 - damping + w * w])
            for damping in (2 * self.depth * self.width * w, 2 * self.width * w)
        )
        return num, den


@record(eq=False)
class Nominal:
    """The nominal plant of a disturbance observer in its two parts: Q = Q_0 kept, Q/P_n = Q_0 inverse.

    Parameters
    ----------
    kept : array
        q^(1+d) B_u(q)/B_u(1), coefficients in ascending powers of q.
    inverse : TransferFunction
        A(q)/(B_s(q) B_u(1)).

    """

    kept: Float[np.ndarray, " n"]
    inverse: TransferFunction

    @classmethod
    def of(cls, plant: DigitalPlant) -> Nominal:
        """Split a sampled plant."""
        a = np.poly(plant.a)
        b = np.poly(plant.a - np.outer(plant.b, plant.c)) - a + plant.d * a  # of z, descending: of q, ascending
        lead = int(np.argmax(np.abs(b) > 1e-9 * np.max(np.abs(b))))
        zeros = np.roots(b[lead:]).astype(complex)
        inverted = (np.abs(zeros) < LARGEST_INVERTED) & (np.real(zeros) > 0.0)
        stable, left = (np.atleast_1d(np.real(np.poly(group))) for group in (zeros[inverted], zeros[~inverted]))
        return cls(
            kept=np.concatenate([np.zeros(lead + plant.delay_samples), left / np.sum(left)]),
            inverse=TransferFunction(num=a / (b[lead] * np.sum(left)), den=stable),
        )


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

    def filters(self, sample_time_s: float) -> tuple[TransferFunction, TransferFunction]:
        """Return Q and Q/P_n."""
        pole = self.T_q / (self.T_q + sample_time_s)
        lags, gain = np.convolve([1.0, -pole], [1.0, -pole]), (1.0 - pole) ** 2
        inverse = self.nominal.inverse
        return (
            TransferFunction(num=gain * self.nominal.kept, den=lags),
            TransferFunction(num=gain * inverse.num, den=np.convolve(lags, inverse.den)),
        )


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
        N/N: weight of the reference.
    c : float
        Weight of the reference in what is differentiated.
    observer : DisturbanceObserver, optional
        Of a pid_dob.
    notch : Notch, optional
        With a value in every field.

    """

    k_p: float
    k_i: float
    k_d: float
    T_f: float
    k_r: float
    c: float = 1.0
    observer: DisturbanceObserver | None = None
    notch: Notch | None = None

    def by_name(self) -> dict[str, float]:
        """Return the numbers by name, those of observer and notch too."""
        out = {name: getattr(self, name) for name in LAW_GAINS}
        if self.observer is not None:
            out["T_q"] = self.observer.T_q
        if self.notch is not None:
            out |= {f"notch_{name}": value for name, value in asdict(self.notch).items()}
        return out

    def transfer_functions(
        self, structure: Structure, sample_time_s: float
    ) -> tuple[TransferFunction, TransferFunction]:
        """Return C_r and C_y over their common denominator.

        It is (1 - alpha q) of a pd and (1 - q) (1 - alpha q) of a pid; observer and notch multiply it.
        """
        alpha = self.T_f / (self.T_f + sample_time_s)
        lag = np.array([1.0, -alpha])
        integrates = structure == "pid" or (structure == "pid_dob" and self.k_i != 0.0)
        difference = np.array([1.0, -1.0])
        den = np.convolve(difference, lag) if integrates else lag
        unit = den
        rate = self.k_d / (self.T_f + sample_time_s) * (
            np.convolve(difference, difference) if integrates else difference
        )  # fmt: skip
        whole = self.k_i * sample_time_s / 2 * np.convolve([1.0, 1.0], lag) if integrates else np.zeros(1)
        measurement = _add(self.k_p * unit, rate, whole)
        reference = _add(self.k_r * unit, self.c * rate, whole)
        if self.observer is not None:
            q, inverse = self.observer.filters(sample_time_s)
            through = inverse.den  # holds the lags of Q
            rest = np.convolve(_add(q.den, -q.num), self.observer.nominal.inverse.den)
            measurement = _add(np.convolve(measurement, through), np.convolve(inverse.num, den))
            reference, den = np.convolve(reference, through), np.convolve(den, rest)
        if self.notch is not None:
            over, under = self.notch.biquad(sample_time_s)
            reference, measurement, den = (
                np.convolve(*p) for p in ((reference, over), (measurement, over), (den, under))
            )
        return tuple(TransferFunction(num=num / den[0], den=den / den[0]) for num in (reference, measurement))  # type: ignore[return-value]


def _add(*polynomials: Float[np.ndarray, " _"]) -> Float[np.ndarray, " m"]:
    out = np.zeros(max(p.size for p in polynomials))
    for p in polynomials:
        out[: p.size] += p
    return out


class LawTerms(NamedTuple):
    """What a law is made of at some frequencies: C_y = series (k_p + k_i integral + k_d rate + observer)."""

    series: Any
    integral: Any
    rate: Any
    observer: Any


def evaluate_terms(
    q: Any, ts: Any, T_f: Any, observer: tuple[Any, Any, Any] | None = None, notch: tuple[Any, Any, Any] | None = None
) -> LawTerms:
    """Return the terms of a law at q, for numbers that may be arrays or symbols.

    Parameters
    ----------
    q : complex
        exp(-j omega T_s).
    ts, T_f
        Seconds.
    observer : (T_q, kept, inverse), optional
        The time constant, and the two parts of the nominal plant at q.
    notch : (w, width, depth), optional
        w = tan(pi f T_s) of its frequency.

    """
    series: Any = 1.0
    more: Any = 0.0
    if observer is not None:
        T_q, kept, inverse = observer
        lag = ts / (T_q + ts - q * T_q)
        series, more = 1.0 / (1.0 - lag * lag * kept), lag * lag * inverse
    if notch is not None:
        w, width, depth = notch
        s = (1.0 - q) / (1.0 + q)
        series = series * (s * s + s * (2.0 * depth * width * w) + w * w) / (s * s + s * (2.0 * width * w) + w * w)
    rate = (1.0 - q) / (T_f + ts - q * T_f)
    return LawTerms(series=series, integral=(1.0 + q) / (1.0 - q) * (ts / 2), rate=rate, observer=more)
