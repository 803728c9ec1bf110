r"""The control law: two transfer functions in q = z^-1.

.. math:: F_m = C_r(q) F_\mathrm{ref} - C_y(q) F_\mathrm{meas}

Every structure is written as these two. With :math:`e = F_\mathrm{ref} - F_\mathrm{meas}` and :math:`v = e`, or
:math:`v = -F_\mathrm{meas}` for the derivative on the measurement,

.. math::
    F_m &= k_\mathrm{ff} F_\mathrm{ref} + k_p e + k_i \frac{T_s}{2} \frac{1+q}{1-q} e + k_d D(q) v, \\
    D(q) &= \frac{1}{T_f + T_s}\, \frac{1 - q}{1 - q\, T_f/(T_f + T_s)}, \qquad k_\mathrm{ff} = 1/P(0) .
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Complex, Float

Structure = Literal["pd", "pid"]
Derivative = Literal["error", "measurement"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TransferFunction:
    """num(q)/den(q): coefficients in ascending powers of q = z^-1, den[0] = 1."""

    num: Float[np.ndarray, " n"]
    den: Float[np.ndarray, " m"]

    def response(self, f: Float[np.ndarray, " k"], sample_time_s: float) -> Complex[np.ndarray, " k"]:
        """Return the values at frequencies in Hz."""
        q = np.exp(-2j * np.pi * f * sample_time_s)
        return np.polynomial.polynomial.polyval(q, self.num) / np.polynomial.polynomial.polyval(q, self.den)

    def state_space(
        self,
    ) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"], float]:
        """Return a controllable canonical realisation."""
        n = max(self.num.size, self.den.size) - 1
        num, den = np.zeros(n + 1), np.zeros(n + 1)
        num[: self.num.size], den[: self.den.size] = self.num, self.den
        a, b = np.zeros((n, n)), np.zeros(n)
        if n:
            a[0], b[0] = -den[1:], 1.0
            a[1:, :-1] = np.eye(n - 1)
        return a, b, num[1:] - num[0] * den[1:], float(num[0])


@dataclass(frozen=True, slots=True, kw_only=True)
class Gains:
    """The numbers of a pd or pid law.

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
    k_ff : float
        N/N: feedforward of the reference.
    derivative : {"error", "measurement"}
        What is differentiated.

    """

    k_p: float
    k_i: float
    k_d: float
    T_f: float
    k_ff: float
    derivative: Derivative = "error"

    def transfer_functions(
        self, structure: Structure, sample_time_s: float
    ) -> tuple[TransferFunction, TransferFunction]:
        """Return C_r and C_y over their common denominator (1 - q) (1 - alpha q), or (1 - alpha q) for a pd."""
        alpha = self.T_f / (self.T_f + sample_time_s)
        lag = np.array([1.0, -alpha])
        integrates = structure == "pid"
        difference = np.array([1.0, -1.0])
        den = np.convolve(difference, lag) if integrates else lag
        unit = den
        rate = self.k_d / (self.T_f + sample_time_s) * (
            np.convolve(difference, difference) if integrates else difference
        )  # fmt: skip
        whole = self.k_i * sample_time_s / 2 * np.convolve([1.0, 1.0], lag) if integrates else np.zeros(1)
        measurement = _added(self.k_p * unit, rate, whole)
        reference = _added((self.k_ff + self.k_p) * unit, rate if self.derivative == "error" else np.zeros(1), whole)
        return TransferFunction(num=reference, den=den), TransferFunction(num=measurement, den=den)


def _added(*polynomials: Float[np.ndarray, " _"]) -> Float[np.ndarray, " m"]:
    out = np.zeros(max(p.size for p in polynomials))
    for p in polynomials:
        out[: p.size] += p
    return out
