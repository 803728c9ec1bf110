r"""The closed loop as one system, its response on the unit circle, and what separates the level sets of it.

Plant, hold, delay and controller together are

.. math::
    x^+ = A x + B_n n + B_r F_\mathrm{ref}, \qquad
    m = C_m x + D_m n + D_{mr} F_\mathrm{ref}, \qquad u = C_u x + \dots

with sensor noise :math:`n`, measured force :math:`m = y + n` and motor force :math:`u`. Its transfer functions are
:math:`S` (n to m), :math:`T = 1 - S`, :math:`C_y S` (n to -u) and :math:`T_r` (reference to force). They are computed
in a Schur basis of the balanced system, where :math:`zI - A` is triangular: one back substitution serves all
frequencies, no pole of plant or controller on the circle (an integrator) has to be avoided, and repeated ones do no
harm.

A function :math:`\Phi(z) = \overline{G} G - \gamma^2` on the circle is zero where :math:`|G| = \gamma`. With
:math:`\lambda = z (A^T \lambda + C^T C x + C^T D u)` the zeros are eigenvalues of a symplectic pencil in
:math:`(x, \lambda, u)`,

.. math::
    \begin{bmatrix} A & 0 & B \\ 0 & I & 0 \\ D C & B^T & D^2 - \gamma^2 \end{bmatrix} v = z
    \begin{bmatrix} I & 0 & 0 \\ C^T C & A^T & C^T D \\ 0 & 0 & 0 \end{bmatrix} v ,

and so are those of :math:`2 \mathrm{Re}\, S - 1` and :math:`\mathrm{Im}\, S` with other last rows. The angles of all
eigenvalues cut the circle into arcs on none of which the function changes sign, so that one look at each arc's middle
tells where it is positive: no crossing and no peak is missed, however narrow (Boyd, Balakrishnan, Kabamba, Math.
Control Signals Systems 2, 1989; Bruinsma, Steinbuch, Systems & Control Letters 14, 1990).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Complex, Float, Int

from seaopt.control.loops.law import Law
from seaopt.control.loops.sampled_plant import StateSpace
from seaopt.records import record

SHIFTS = (1.5, -1.7)  # of the pencils' inverse: real, off the circle
CROSSING_DISTANCE = 3e-7  # how far from an eigenvalue a crossing is looked for first, as a fraction of the angle
STRAIGHT_RESIDUE = 1e-6  # of its value at both ends: less is left at the zero of the line through them if f is straight
MAX_ZERO_STEPS = 100
ROUNDINGS = 100 * float(np.finfo(float).eps)  # error of a sampled plant or a law, as a fraction
LARGEST_ENTRY = 1e100  # entry of a loop's matrices: beyond, its eigenvalues cannot be computed

Pencil = tuple[Float[np.ndarray, "k k"], Float[np.ndarray, "k k"]]
Indices = Int[np.ndarray, " m"]
Indexed = Callable[[Float[np.ndarray, " m"], Indices], Float[np.ndarray, " m"]]


@record(eq=False)
class ClosedLoop:
    """A closed loop from (noise, reference) to (measured force, motor force), balanced.

    Parameters
    ----------
    a, b, c, d
        Shapes (n, n), (n, 2), (2, n) and (2, 2).
    triangle, right, left
        The complex Schur form of `a`, and `b` and `c` in its basis.
    opened
        The poles of plant and law, which are the zeros of S.
    blocks
        The matrices of plant and law whose eigenvalues those are, but for the law's integrators.

    """

    a: Float[np.ndarray, "n n"]
    b: Float[np.ndarray, "n 2"]
    c: Float[np.ndarray, "2 n"]
    d: Float[np.ndarray, "2 2"]
    triangle: Complex[np.ndarray, "n n"]
    right: Complex[np.ndarray, "n 2"]
    left: Complex[np.ndarray, "2 n"]
    opened: Complex[np.ndarray, " n"]
    blocks: tuple[Float[np.ndarray, "np np"], Float[np.ndarray, "nk nk"]]

    @property
    def poles(self) -> Complex[np.ndarray, " n"]:
        """The eigenvalues of `a`."""
        return np.diag(self.triangle)

    def curves(self, theta: Float[np.ndarray, " m"]) -> Complex[np.ndarray, "5 m"]:
        """Return S, T, S - T, C_y S and F/F_ref at angles (rad) on the unit circle."""
        return self._combine(self._solve(np.exp(1j * theta), self.right[:, :, None]), direct=True)

    def sensitivity(self, theta: Float[np.ndarray, " m"]) -> Complex[np.ndarray, " m"]:
        """Return S as a product over its zeros and poles: exact where it vanishes, at an integrator."""
        z = np.exp(1j * theta)[:, None]
        return self.d[0, 0] * np.prod((z - self.opened) / (z - self.poles), axis=1)

    def resolution(self) -> Float[np.ndarray, " n"]:
        """Return how well each pole of plant and law is known: rounding times its condition, large of a double one.

        The first-order bound of an eigenvalue's error, of the balanced matrix (Golub, Van Loan, Matrix Computations,
        7.2.2).
        """
        plant, rest = (_resolution(block) for block in self.blocks)
        return np.concatenate([plant, np.zeros(self.opened.size - plant.size - rest.size), rest])

    def slopes(self, theta: Float[np.ndarray, " m"]) -> Float[np.ndarray, "5 m"]:
        """Return half the derivative of -1/abs(curve)^2 along the angle.

        It has the sign of the curve's own slope, and about a resonance it is close to a straight line.
        """
        z = np.exp(1j * theta)
        x = self._solve(z, self.right[:, :, None])
        values: Any = self._combine(x, direct=True)
        turned: Any = self._combine(self._solve(z, x), direct=False) * (-1j * z)
        size = np.maximum(values.real**2 + values.imag**2, 1e-150)
        return (values.real * turned.real + values.imag * turned.imag) / size**2

    def _solve(self, z: Complex[np.ndarray, " m"], rhs: Complex[np.ndarray, "n 2 k"]) -> Complex[np.ndarray, "n 2 m"]:
        """Return (zI - A)^-1 rhs in the Schur basis, by back substitution."""
        n = self.triangle.shape[0]
        x = np.zeros((n, 2, z.size), dtype=complex)
        flat = x.reshape(n, 2 * z.size)
        for i in range(n - 1, -1, -1):
            known = self.triangle[i, i + 1 :] @ flat[i + 1 :]
            x[i] = (rhs[i] + known.reshape(2, -1)) / (z - self.triangle[i, i])
        return x

    def _combine(self, x: Complex[np.ndarray, "n 2 m"], direct: bool) -> Complex[np.ndarray, "5 m"]:
        """Return the five transfer functions of a state, with or without their direct terms."""
        n, _, count = x.shape
        out = (self.left @ x.reshape(n, 2 * count)).reshape(2, 2, count)
        through = self.d if direct else np.zeros((2, 2))
        one = 1.0 if direct else 0.0
        s, t = out[0, 0] + through[0, 0], (one - through[0, 0]) - out[0, 0]
        return np.array([s, t, s - t, -out[1, 0] - through[1, 0], out[0, 1] + through[0, 1]])

    def modulus(self, curve: int, level: float) -> Pencil:
        """Return the pencil whose eigenvalues on the circle are where abs(curve) = level."""
        row, column, factor, offset = ((0, 0, 1, 0), (0, 0, -1, 1), (0, 0, 2, -1), (1, 0, -1, 0), (0, 1, 1, 0))[curve]
        c = self.c[row] * (factor / level)
        d = (self.d[row, column] * factor + offset) / level
        return self._pencil(self.b[:, column], (np.outer(c, c), c * d), (d * c, 1.0, d * d - 1.0))

    def equal(self) -> Pencil:
        """Return the pencil whose eigenvalues on the circle are where abs(L) = 1, that is 2 Re S = 1."""
        c, none = self.c[0], np.zeros_like(self.a)
        return self._pencil(self.b[:, 0], (none, c), (c, 1.0, 2.0 * self.d[0, 0] - 1.0))

    def real(self) -> Pencil:
        """Return the pencil whose eigenvalues on the circle are where L is real, that is Im S = 0."""
        c, none = self.c[0], np.zeros_like(self.a)
        return self._pencil(self.b[:, 0], (none, c), (c, -1.0, 0.0))

    def _pencil(
        self, b: Float[np.ndarray, " n"], costate: tuple[Float[np.ndarray, "n n"], Float[np.ndarray, " n"]],
        last: tuple[Float[np.ndarray, " n"], float, float],
    ) -> Pencil:  # fmt: skip
        n = b.size
        m, k = np.zeros((2 * n + 1, 2 * n + 1)), np.zeros((2 * n + 1, 2 * n + 1))
        m[:n, :n], m[:n, -1] = self.a, b
        m[n:-1, n:-1] = k[:n, :n] = np.eye(n)
        m[-1, :n], m[-1, n:-1], m[-1, -1] = last[0], last[1] * b, last[2]
        k[n:-1, :n], k[n:-1, n:-1], k[n:-1, -1] = costate[0], self.a.T, costate[1]
        return m, k


def close(plant: StateSpace, law: Law) -> ClosedLoop:
    """Return the loop of a plant (with its delay) and the law u = C_r r - C_y m.

    A plant that is not finite, of absurd parameters, has every pole at infinity: its loop is not stable.
    """
    from scipy.linalg import matrix_balance, schur

    ap, bp, cp, dp = plant
    sign = np.array([1.0, -1.0])
    ak, bk, ck, dk = law.a, law.b * sign, law.c, law.d * sign
    # u and m = y + n satisfy u = c_k x_k + d_r r - d_y m, m = c_p x_p + d_p u + n.
    n, m = bp.size, ck.size
    loop = 1.0 / (1.0 + dp * dk[1])
    c_u = np.concatenate([-dk[1] * cp, ck]) * loop
    d_u = np.array([-dk[1], dk[0]]) * loop
    c_m = np.concatenate([cp, np.zeros(m)]) + dp * c_u
    d_m = np.array([1.0, 0.0]) + dp * d_u
    a, b = np.zeros((n + m, n + m)), np.zeros((n + m, 2))
    a[:n, :n], a[n:, n:] = ap, ak
    a[:n] += np.outer(bp, c_u)
    a[n:] -= np.outer(bk[:, 1], c_m)
    b[:n], b[n:] = np.outer(bp, d_u), -np.outer(bk[:, 1], d_m)
    b[n:, 1] += bk[:, 0]
    c, d = np.stack([c_m, c_u]), np.stack([d_m, d_u])
    opened = np.full(n + m, np.inf + 0j)
    whole = np.block([[a, b], [c, np.zeros((2, 2))]])
    if not np.max(np.abs(whole)) < LARGEST_ENTRY:
        gone = np.diag(opened)
        return ClosedLoop(
            a=a, b=b, c=c, d=d, triangle=gone, right=b + 0j, left=c + 0j, opened=opened, blocks=(ap, law.rest[0])
        )  # fmt: skip
    with np.errstate(over="ignore", invalid="ignore"):  # of scales too far apart for doubles
        scale = np.asarray(matrix_balance(whole, permute=False, separate=True)[1][0])
        scale = scale[: n + m] / np.sqrt(scale[-2] * scale[-1])
        balanced = a * scale / scale[:, None], b / scale[:, None], c * scale
    if all(np.all(np.isfinite(matrix)) for matrix in balanced):
        a, b, c = balanced
    triangle, basis = (np.asarray(matrix) for matrix in schur(a, output="complex")[:2])
    opened = np.concatenate([np.linalg.eigvals(ap), law.poles]).astype(complex)
    return ClosedLoop(
        a=a, b=b, c=c, d=d, triangle=triangle, right=basis.conj().T @ b, left=c @ basis, opened=opened,
        blocks=(ap, law.rest[0]),
    )  # fmt: skip


def _resolution(a: Float[np.ndarray, "n n"]) -> Float[np.ndarray, " n"]:
    """Return the eigenvalues' errors for a backward error of ROUNDINGS, in the order of `numpy.linalg.eigvals`."""
    from scipy.linalg import eig, matrix_balance

    if not a.size:
        return np.empty(0)
    balanced: Any = matrix_balance(a, permute=False)[0]
    values, left, right = (np.asarray(part) for part in eig(balanced, left=True, right=True))
    with np.errstate(divide="ignore"):  # of a defective eigenvalue the two vectors are at right angles
        errors = ROUNDINGS * np.linalg.norm(balanced) / np.abs(np.sum(left.conj() * right, axis=0))
    order = np.argmin(np.abs(np.linalg.eigvals(a)[:, None] - values), axis=1)
    return errors[order]


def find_arcs(pencils: Sequence[Pencil]) -> list[Float[np.ndarray, " _"]]:
    """Return, for each pencil, the angles from 0 to pi that separate where its function is positive and negative."""
    whole = _on_circle(np.stack([p[0] for p in pencils]), np.stack([p[1] for p in pencils]))
    rows = [_on_circle(m[None], k[None]) for m, k in pencils] if whole is None else list(whole[:, None])
    angles = [np.empty(0) if row is None else row[np.isfinite(row)] for row in rows]
    return [np.unique(np.concatenate([[0.0], row, [np.pi]])) for row in angles]


def _on_circle(m: Float[np.ndarray, "p k k"], k: Float[np.ndarray, "p k k"]) -> Float[np.ndarray, "p k"] | None:
    """Return the angles of the pencils' eigenvalues; None where one is singular, its function being constant."""
    for shift in SHIFTS:
        try:
            inverse: Any = np.linalg.eigvals(np.linalg.solve(m - shift * k, k)).astype(complex)
        except np.linalg.LinAlgError:
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.abs(np.angle(shift + 1.0 / inverse))
    return None


def find_sign_changes(function: Indexed, edges: Sequence[Float[np.ndarray, " _"]]) -> list[Float[np.ndarray, " _"]]:
    """Return, for each set of arcs, the angles at which its function changes sign.

    `function(theta, which)` is the function number `which` of each angle; rounding about zero has no sign.
    """
    middles = [0.5 * (row[:-1] + row[1:]) for row in edges]
    which = np.repeat(np.arange(len(middles)), [row.size for row in middles])
    theta, end = np.concatenate(middles), np.concatenate([row[1:] for row in edges])
    values = function(theta, which)
    kept = np.abs(values) > 1e-13
    theta, end, which, values = theta[kept], end[kept], which[kept], values[kept]
    flips = np.flatnonzero((values[:-1] * values[1:] < 0.0) & (which[:-1] == which[1:]))
    flipped, edge = which[flips], end[flips]
    low, high = edge * (1.0 - CROSSING_DISTANCE), edge * (1.0 + CROSSING_DISTANCE)
    at_low, at_high = np.split(function(np.concatenate([low, high]), np.concatenate([flipped, flipped])), 2)
    tight = at_low * at_high < 0.0
    zeros = low.copy()
    zeros[tight] += ((high - low) * at_low / (at_low - at_high))[tight]
    bent = tight & (np.abs(function(zeros, flipped)) > STRAIGHT_RESIDUE * np.maximum(np.abs(at_low), np.abs(at_high)))
    left = np.flatnonzero(~tight | bent)  # the eigenvalue is not quite where the function is zero, or a mode is narrow
    before, after = flips[left], flips[left] + 1
    close_by, ends = bent[left], (theta[before], theta[after], values[before], values[after])
    low, high, at_low, at_high = (
        np.where(close_by, inner[left], outer) for inner, outer in zip((low, high, at_low, at_high), ends, strict=True)
    )
    zeros[left] = find_zeros(lambda x, i: function(x, flipped[left[i]]), low, high, at_low, at_high, 1e-13)
    return [zeros[flipped == row] for row in range(len(edges))]


def find_zeros(
    function: Indexed, low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"], at_low: Float[np.ndarray, " m"],
    at_high: Float[np.ndarray, " m"], tolerance: float,
) -> Float[np.ndarray, " m"]:  # fmt: skip
    """Return a zero in every bracket (Chandrupatla, Advances in Engineering Software 28, 1997).

    `function(x, i)` is evaluated at x for the brackets number i only. A bracket is done when it, or the function
    in it, is smaller than `tolerance` as a fraction of where it is, or of what it was.
    """
    # scipy's elementwise.find_root gives the same zeros; its overhead would make `margins` of a loop 70 % slower.
    a, b, c = high.copy(), low.copy(), high.copy()  # b is the newest, a across the zero from it, c the one before
    fa, fb, fc = at_high.copy(), at_low.copy(), at_high.copy()
    fraction, small = np.full(a.size, 0.5), tolerance * np.minimum(np.abs(at_low), np.abs(at_high))
    live = np.arange(a.size)
    for _ in range(MAX_ZERO_STEPS):
        if not live.size:
            break
        x = b[live] + fraction[live] * (a[live] - b[live])
        fx = function(x, live)
        same = np.sign(fx) == np.sign(fb[live])
        c[live], fc[live] = np.where(same, b[live], a[live]), np.where(same, fb[live], fa[live])
        a[live], fa[live] = np.where(same, a[live], b[live]), np.where(same, fa[live], fb[live])
        b[live], fb[live] = x, fx
        least = tolerance * np.abs(x)
        live = live[(np.abs(a[live] - x) > least) & (np.abs(fx) > small[live])]
        fraction[live] = _fraction(a[live], b[live], c[live], fa[live], fb[live], fc[live], tolerance)
    return b


def _fraction(
    a: Float[np.ndarray, " m"], b: Float[np.ndarray, " m"], c: Float[np.ndarray, " m"], fa: Float[np.ndarray, " m"],
    fb: Float[np.ndarray, " m"], fc: Float[np.ndarray, " m"], tolerance: float,
) -> Float[np.ndarray, " m"]:  # fmt: skip
    """Return where to look next from b to a: by inverse quadratic interpolation where that is safe, else the middle."""
    with np.errstate(divide="ignore", invalid="ignore"):
        xi, phi = (b - a) / (c - a), (fb - fa) / (fc - fa)
        t = fb / (fa - fb) * fc / (fa - fc) + (c - b) / (a - b) * fb / (fc - fb) * fa / (fc - fa)
        safe = (phi**2 < xi) & ((1 - phi) ** 2 < 1 - xi) & np.isfinite(t)
        edge = np.minimum(0.5 * tolerance * np.abs(b / (a - b)), 0.5)
    return np.where(safe, np.clip(np.where(safe, t, 0.5), edge, 1.0 - edge), 0.5)
