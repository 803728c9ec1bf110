r"""The closed loop as one system, its response on the unit circle, and what separates the level sets of it.

Plant, hold, delay and controller together are

.. math::
    x^+ = A x + B_n n + B_r F_\mathrm{ref}, \qquad
    m = C_m x + D_m n + D_{mr} F_\mathrm{ref}, \qquad u = C_u x + \dots

with sensor noise :math:`n`, measured force :math:`m = y + n` and motor force :math:`u`. Its transfer functions are
:math:`S` (n to m), :math:`T = 1 - S`, :math:`C_y S` (n to -u) and :math:`T_r` (reference to force). Of a law with
several measured signals the loop is broken at the command, where it is scalar, :math:`L = \sum_i C_i P_i`: with a
disturbance w that adds to the command, :math:`S` is from w to w + u, and :math:`C_i S` from the noise :math:`n_i` to
-u; of one signal S is the same at both places.

They are computed in a Schur basis of the balanced system, where :math:`zI - A` is triangular: one back substitution
serves all frequencies, no pole of plant or controller on the circle (an integrator) has to be avoided, and repeated
ones do no harm.

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
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from seaopt.control.loops.law import Law
from seaopt.control.systems.block import COMMAND, EFFORT, REFERENCE, Block, connect
from seaopt.control.systems.resolvent import Resolvent
from seaopt.records import record
from seaopt.signals import ComplexM, ComplexN, MatrixNN, VectorK, VectorN

SHIFTS = (1.5, -1.7)  # of the pencils' inverse: real, off the circle
CROSSING_DISTANCE = 3e-7  # how far from an eigenvalue a crossing is looked for first, as a fraction of the angle
STRAIGHT_RESIDUE = 1e-6  # of its value at both ends: less is left at the zero of the line through them if f is straight
MAX_ZERO_STEPS = 100
ROUNDINGS = 100 * float(np.finfo(float).eps)  # error of a sampled plant or a law, as a fraction
LARGEST_ENTRY = 1e100  # entry of a loop's matrices: beyond, its eigenvalues cannot be computed

Angles = Float[np.ndarray, " m"]  # rad a sample, or a number at each
Edges = Float[np.ndarray, " _"]  # angles, as many as there are
Pencil = tuple[Float[np.ndarray, "k k"], Float[np.ndarray, "k k"]]
Indices = Int[np.ndarray, " m"]
Indexed = Callable[[Angles, Indices], Angles]


@record(eq=False)
class Curves:
    """Transfer functions that a loop is judged by: each is factor G + offset, G from one input to one output."""

    outputs: Int[np.ndarray, " k"]
    inputs: Int[np.ndarray, " k"]
    factors: VectorK
    offsets: VectorK


@cache
def list_curves(measured: int) -> Curves:
    """Return S, T, S - T, C_y S and F/F_ref, and of further measured signals C_y S each. Of one signal the inputs are
    noise and reference, the outputs measured and effort. Of several the inputs are w, reference and one noise each; the
    outputs command, effort and regulated force.
    """
    if measured == 1:
        noises, regulated = [0], 0
    else:
        noises, regulated = [*range(2, 2 + measured)], 2
    more = len(noises) - 1
    return Curves(
        outputs=np.array([0, 0, 0, 1, regulated] + [1] * more),
        inputs=np.array([0, 0, 0, noises[0], 1, *noises[1:]]),
        factors=np.array([1.0, -1.0, 2.0, -1.0, 1.0] + [-1.0] * more),
        offsets=np.array([0.0, 1.0, -1.0, 0.0, 0.0] + [0.0] * more),
    )


@record(eq=False)
class ClosedLoop:
    """A closed loop from (noise, reference) to (measured force, motor force), balanced; or of `list_curves`."""

    block: Block
    resolvent: Resolvent  # of it
    opened: ComplexN  # the poles of plant and law, which are the zeros of S
    # the matrices of plant and law whose eigenvalues those are, but for the law's integrators
    matrices: tuple[Float[np.ndarray, "np np"], Float[np.ndarray, "nk nk"]]
    table: Curves  # its curves
    through: VectorK  # their direct terms

    @property
    def poles(self) -> ComplexN:
        """The eigenvalues of its matrix."""
        return self.resolvent.poles

    def curves(self, theta: Angles) -> Complex[np.ndarray, "k m"]:
        """Return S, T, S - T, C_y S, F/F_ref and what else is in the table at angles (rad) on the unit circle."""
        return self._combine(self.resolvent.respond(np.exp(1j * theta)))

    def sensitivity(self, theta: Angles) -> ComplexM:
        """Return S as a product over its zeros and poles: exact where it vanishes, at an integrator."""
        z = np.exp(1j * theta)[:, None]
        return self.block.d[0, 0] * np.prod((z - self.opened) / (z - self.poles), axis=1)

    def resolution(self) -> VectorN:
        """Return how well each pole of plant and law is known: rounding times its condition, large of a double one. The
        first-order bound of an eigenvalue's error, of the balanced matrix (Golub, Van Loan, Matrix Computations,
        7.2.2).
        """
        plant, law = map(_resolution, self.matrices)
        return np.concatenate([plant, np.zeros(self.opened.size - plant.size - law.size), law])

    def differentiate(
        self, theta: Angles, which: Indices | None = None
    ) -> tuple[Complex[np.ndarray, "*k m"], Float[np.ndarray, "*k m"]]:
        """Return the curves and half the derivatives of -1/abs(curve)^2 along the angle. These have the sign of the
        curve's own slope, and about a resonance they are close to a straight line. Of all curves, shape (k, m), or of
        the curve number `which` of each angle, shape (m,).
        """
        z = np.exp(1j * theta)
        resolvent, distance = self.resolvent, z - self.poles[:, None]
        x = resolvent.solve(distance, resolvent.right[:, :, None])
        values: Any = self._combine(resolvent.read(x), which)
        turned: Any = self._combine(resolvent.read(resolvent.solve(distance, x)), which, direct=False) * (-1j * z)
        size = np.maximum(values.real**2 + values.imag**2, 1e-150)
        return values, (values.real * turned.real + values.imag * turned.imag) / size**2

    def _combine(
        self, out: Complex[np.ndarray, "o i m"], which: Indices | None = None, direct: bool = True
    ) -> Complex[np.ndarray, "*k m"]:
        """Return the curves of all responses, or of each angle's the curve `which`, with or without direct terms."""
        table, through = self.table, self.through
        if which is None:
            values = table.factors[:, None] * out[table.outputs, table.inputs]
            return values + through[:, None] if direct else values
        values = table.factors[which] * out[table.outputs[which], table.inputs[which], np.arange(which.size)]
        return values + through[which] if direct else values

    def modulus(self, curve: int, level: float) -> Pencil:
        """Return the pencil whose eigenvalues on the circle are where abs(curve) = level."""
        table, block = self.table, self.block
        c = block.c[table.outputs[curve]] * (table.factors[curve] / level)
        d = float(self.through[curve]) / level
        return self._pencil(block.b[:, table.inputs[curve]], (np.outer(c, c), c * d), (d * c, 1.0, d * d - 1.0))

    def equal(self) -> Pencil:
        """Return the pencil whose eigenvalues on the circle are where abs(L) = 1, that is 2 Re S = 1."""
        return self._compare_s(1.0, 2.0 * self.block.d[0, 0] - 1.0)

    def real(self) -> Pencil:
        """Return the pencil whose eigenvalues on the circle are where L is real, that is Im S = 0."""
        return self._compare_s(-1.0, 0.0)

    def _compare_s(self, sign: float, direct: float) -> Pencil:
        block = self.block
        c, none = block.c[0], np.zeros_like(block.a)
        return self._pencil(block.b[:, 0], (none, c), (c, sign, direct))

    def _pencil(self, b: VectorN, costate: tuple[MatrixNN, VectorN], last: tuple[VectorN, float, float]) -> Pencil:
        n = b.size
        m, k = np.zeros((2 * n + 1, 2 * n + 1)), np.zeros((2 * n + 1, 2 * n + 1))
        a = self.block.a
        m[:n, :n], m[:n, -1] = a, b
        m[n:-1, n:-1] = k[:n, :n] = np.eye(n)
        m[-1, :n], m[-1, n:-1], m[-1, -1] = last[0], last[1] * b, last[2]
        k[n:-1, :n], k[n:-1, n:-1], k[n:-1, -1] = costate[0], a.T, costate[1]
        return m, k


def close(plant: Block, law: Law) -> ClosedLoop:
    """Return the loop of a plant and u = C_r r - C_y m; of a plant that is not finite an unstable one."""
    from scipy.linalg import matrix_balance

    measured, regulated, *_ = len(plant.outputs), *plant.outputs
    inputs, outputs = (regulated, REFERENCE), (regulated, EFFORT)
    if measured > 1:
        inputs, outputs = (COMMAND, REFERENCE, *plant.outputs), (COMMAND, EFFORT, regulated)
    block = connect([plant, law.block], inputs, outputs)
    a, b, c, d, n = block.a, block.b, block.c, block.d, len(block.a)
    table = list_curves(measured)
    through = d[table.outputs, table.inputs] * table.factors + table.offsets
    opened = np.full(n, np.inf + 0j)
    side = max(b.shape[1], len(c))
    whole = np.zeros((n + side, n + side))
    whole[:n, : n + b.shape[1]], whole[n : n + len(c), :n] = np.hstack([a, b]), c
    if not np.max(np.abs(whole)) < LARGEST_ENTRY:
        resolvent = Resolvent(triangle=np.diag(opened), right=b + 0j, left=c + 0j)
    else:
        with np.errstate(over="ignore", invalid="ignore"):  # of scales too far apart for doubles
            scale = np.asarray(matrix_balance(whole, permute=False, separate=True)[1][0])
            scale = scale[:n] / np.prod(scale[n:]) ** (1.0 / side)
            balanced = a * scale / scale[:, None], b / scale[:, None], c * scale
        if all(np.all(np.isfinite(matrix)) for matrix in balanced):
            a, b, c = balanced
            block = replace(block, a=a, b=b, c=c)
        resolvent = Resolvent.of(a, b, c)
        opened = np.concatenate([np.linalg.eigvals(plant.a), law.poles]).astype(complex)
    return ClosedLoop(
        block=block,
        resolvent=resolvent,
        opened=opened,
        matrices=(plant.a, law.remainder[0]),
        table=table,
        through=through,
    )


def _resolution(a: MatrixNN) -> VectorN:
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


def find_arcs(pencils: Sequence[Pencil]) -> list[Edges]:
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


def find_sign_changes(function: Indexed, edges: Sequence[Edges]) -> list[Edges]:
    """Return where function(theta, which), of each set of arcs, changes sign; rounding about zero has none."""
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
    function: Indexed,
    low: Angles,
    high: Angles,
    at_low: Angles,
    at_high: Angles,
    tolerance: float,
    wanted: Bool[np.ndarray, " m"] | None = None,
) -> Angles:
    """Return a zero in every bracket (Chandrupatla, Advances in Engineering Software 28, 1997). `function(x, i)` is
    evaluated at x for the brackets number i only. A bracket is done when it, or the function in it, is smaller than
    `tolerance` as a fraction of where it is, or of what it was; and all are when those `wanted` are.
    """
    # scipy's elementwise.find_root gives the same zeros; its overhead would make `margins` of a loop 70 % slower.
    a, b, c = high.copy(), low.copy(), high.copy()  # b is the newest, a across the zero from it, c the one before
    fa, fb, fc = at_high.copy(), at_low.copy(), at_high.copy()
    fraction, small = np.full(a.size, 0.5), tolerance * np.minimum(np.abs(at_low), np.abs(at_high))
    live = np.arange(a.size)
    for _ in range(MAX_ZERO_STEPS):
        if not live.size or not (wanted is None or np.any(wanted[live])):
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


def _fraction(a: Angles, b: Angles, c: Angles, fa: Angles, fb: Angles, fc: Angles, tolerance: float) -> Angles:
    """Return where to look next from b to a: by inverse quadratic interpolation where that is safe, else the middle."""
    with np.errstate(divide="ignore", invalid="ignore"):
        xi, phi = (b - a) / (c - a), (fb - fa) / (fc - fa)
        t = fb / (fa - fb) * fc / (fa - fc) + (c - b) / (a - b) * fb / (fc - fb) * fa / (fc - fa)
        safe = (phi**2 < xi) & ((1 - phi) ** 2 < 1 - xi) & np.isfinite(t)
        edge = np.minimum(0.5 * tolerance * np.abs(b / (a - b)), 0.5)
    return np.where(safe, np.clip(np.where(safe, t, 0.5), edge, 1.0 - edge), 0.5)
