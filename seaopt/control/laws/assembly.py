r"""A law put together from its parts, with what integrates written down and not multiplied out.

With :math:`q = z^{-1}` and :math:`\delta = 1 - q`, an `Assembly` is

.. math:: u = \sum_{j=1}^{m} \frac{g_j}{\delta^j} + D + C (zI - A)^{-1} B ,

one column for each input, A stable. A part :math:`G = d + c(zI - a)^{-1}b` in series splits the integrators off by
its Taylor series at :math:`\delta = 0`, whose terms are those of

.. math:: \frac{G(z) - G(1)}{\delta} = -c(I-a)^{-1}b - c\,(zI - a)^{-1}(I-a)^{-1}a\,b ,

a system with the same poles: what cancels is never computed. As :math:`1/\delta = 1 + w`, w = 1/(z - 1), the
:math:`g_j` become the chain of `seaopt.control.loops.law`.

A filter F of the reference alone, of unit static gain, has :math:`F - 1 = \delta G`, G with the poles of F. What
integrates the error integrates :math:`F r - y = (r - y) + \delta G r`: its integral of the error is as before, to the
last bit, and the rest has one integrator less.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.control.loops.law import Law
from seaopt.control.loops.minimal import build_chain
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.records import record

Columns = Float[np.ndarray, " k"]


@record(eq=False)
class Assembly:
    """Integrators in powers of 1/delta, shape (m, k), beside a state space (a, b, c, d)."""

    chain: Float[np.ndarray, "m k"]
    a: Float[np.ndarray, "n n"]
    b: Float[np.ndarray, "n k"]
    c: Float[np.ndarray, " n"]
    d: Columns

    @classmethod
    def of_gains(cls, gains: Columns) -> Assembly:
        """Return numbers, one per input."""
        k = gains.size
        return cls(chain=np.zeros((0, k)), a=np.zeros((0, 0)), b=np.zeros((0, k)), c=np.zeros(0), d=gains)

    @property
    def static(self) -> Columns:
        """The part that does not integrate, at 0 Hz."""
        return self.d + self.c @ np.linalg.solve(np.eye(self.c.size) - self.a, self.b)

    def plus(self, other: Assembly) -> Assembly:
        """Return the sum, on the same inputs."""
        chain = np.zeros((max(len(self.chain), len(other.chain)), self.d.size))
        chain[: len(self.chain)] += self.chain
        chain[: len(other.chain)] += other.chain
        n, more = self.c.size, other.c.size
        a = np.zeros((n + more, n + more))  # `block_diag` would take longer than all the rest of a law
        a[:n, :n], a[n:, n:] = self.a, other.a
        return Assembly(
            chain=chain, a=a, b=np.vstack([self.b, other.b]), c=np.concatenate([self.c, other.c]), d=self.d + other.d
        )

    def scaled(self, factor: float) -> Assembly:
        """Return this times a factor."""
        return replace(self, chain=self.chain * factor, c=self.c * factor, d=self.d * factor)

    def widened(self, count: int) -> Assembly:
        """Return this on so many inputs, of which it does not read the last; of a negative count, not the first."""
        more = ((0, 0), (0, count - self.d.size) if count > 0 else (-count - self.d.size, 0))
        return replace(self, chain=np.pad(self.chain, more), b=np.pad(self.b, more), d=np.pad(self.d, more[1]))

    def through(self, part: TransferFunction) -> Assembly:
        """Return this in series with a stable part."""
        a, b, c, d = part.state_space()
        into, through, chain, inner = b[:, None] * self.d, d * self.d, np.zeros_like(self.chain), np.eye(c.size) - a
        drive, direct = b, d  # of one term of the part's Taylor series after the other, first the part itself
        for order in range(len(chain)):
            fixed = np.linalg.solve(inner, drive) if c.size else b
            chain[: len(chain) - order] += (direct + float(c @ fixed)) * self.chain[order:]
            drive, direct = -a @ fixed, -float(c @ fixed)
            into = into + drive[:, None] * self.chain[order]
            through = through + direct * self.chain[order]
        n, whole = self.c.size, np.zeros((self.c.size + c.size, self.c.size + c.size))  # as in `plus`
        whole[:n, :n], whole[n:, :n], whole[n:, n:] = self.a, b[:, None] * self.c, a
        return Assembly(
            chain=chain, a=whole, b=np.concatenate([self.b, into]), c=np.concatenate([d * self.c, c]), d=through
        )

    def integrated(self, static: Columns) -> Assembly:
        """Return this over delta; `static` is its `static`, in which the caller may know a zero to be one."""
        inner = np.eye(self.c.size) - self.a
        row = np.linalg.solve(inner.T, self.c)
        return replace(self, chain=np.vstack([static, self.chain]), c=-row @ self.a, d=-row @ self.b)

    def with_reference_behind(self, part: TransferFunction, difference: TransferFunction) -> Assembly:
        """Return this with the reference behind a stable filter F = `part`, F(0) = 1; `difference`: (F - 1)/delta."""
        a, b, row, through = difference.state_space()
        n, chain, whole = self.c.size, self.chain.copy(), np.sum(self.chain[:, :2], axis=1)
        c, d, inner = np.zeros(b.size), 0.0, np.eye(b.size) - a
        for power in range(
            len(chain)
        ):  # difference/delta^power: what it leaves at 0 Hz goes to the chain, term by term
            c, d = c + whole[power] * row, d + whole[power] * through
            for order in range(power + 1, len(chain)):
                chain[order - power - 1, 1] += whole[order] * (through + float(row @ np.linalg.solve(inner, b)))
            fixed = np.linalg.solve(inner.T, row)
            row, through = -fixed @ a, -float(fixed @ b)
        _, _, seen, direct = part.state_space()  # of F; F - 1 has the same states
        direct -= 1.0
        into, onto = np.sum(self.b[:, :2], axis=1), float(np.sum(self.d[:2]))
        states = np.block([[self.a, np.outer(into, seen)], [np.zeros((b.size, n)), a]])
        reference = np.eye(self.d.size)[1]
        entry = np.vstack([self.b + np.outer(into * direct, reference), np.outer(b, reference)])
        through = self.d + (onto * direct + d) * reference
        return Assembly(chain=chain, a=states, b=entry, c=np.concatenate([self.c, onto * seen + c]), d=through)

    def law(self, sample_time_s: float) -> Law:
        """Return the law of reference and measured signals, the inputs being error, reference and further signals."""
        m = len(self.chain)
        while m and not np.any(self.chain[m - 1]):
            m -= 1
        chain, d = np.zeros((m, self.d.size)), self.d.copy()
        for power, row in enumerate(self.chain[:m], start=1):
            d += row
            for j in range(1, power + 1):
                chain[j - 1] += math.comb(power, j) * row
        turn = np.eye(self.d.size)  # inputs (error, reference, ...) from (reference, measurement, ...)
        turn[:2, :2] = [[1.0, -1.0], [1.0, 0.0]]
        return Law(**build_chain(chain @ turn, self.a, self.b @ turn, self.c), d=d @ turn, sample_time_s=sample_time_s)
