"""A transfer function in q = z^-1, as loops and control laws are made of."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from jaxtyping import Complex, Float

from seaopt.codec import Constraints
from seaopt.control.systems.block import Block
from seaopt.records import record
from seaopt.signals import MatrixNN, VectorM, VectorN

Frequencies = Float[np.ndarray, " m"]  # Hz
Response = Complex[np.ndarray, " m"]  # at these
POLE_ROUNDING = 1e-17  # least denominator, over the sum of its coefficients


@record(eq=False)
class TransferFunction:
    """num(q)/den(q): coefficients in ascending powers of q = z^-1, den[0] = 1."""

    num: Annotated[VectorN, Constraints(min_length=1)]
    den: Annotated[VectorM, Constraints(min_length=1)]

    def response(self, f: Frequencies, sample_time_s: float) -> Response:
        """Return the values at frequencies in Hz; next to a pole on the circle, no more than rounding allows."""
        q = np.exp(-2j * np.pi * f * sample_time_s)
        below = np.polynomial.polynomial.polyval(q, self.den)
        least = POLE_ROUNDING * np.sum(np.abs(self.den))
        return np.polynomial.polynomial.polyval(q, self.num) / np.where(np.abs(below) < least, least, below)

    def state_space(self) -> tuple[MatrixNN, VectorN, VectorN, float]:
        """Return a controllable canonical realisation."""
        n = max(self.num.size, self.den.size) - 1
        num, den = np.zeros(n + 1), np.zeros(n + 1)
        num[: self.num.size], den[: self.den.size] = self.num, self.den
        a, b = np.zeros((n, n)), np.zeros(n)
        if n:
            a[0], b[0] = -den[1:], 1.0
            a[1:, :-1] = np.eye(n - 1)
        return a, b, num[1:] - num[0] * den[1:], float(num[0])

    def block(self, read: str, output: str, gain: float = 1.0) -> Block:
        """Return it from one signal to another, times a gain."""
        a, b, c, d = self.state_space()
        c, d = gain * c[None], np.full((1, 1), gain * d)
        return Block(a=a, b=b[:, None], c=c, d=d, inputs=(read,), outputs=(output,))
