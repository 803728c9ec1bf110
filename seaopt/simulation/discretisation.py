r"""Exact discretisation of a linear plant, with its exact parameter derivatives.

Over one period T the input is a hold of the samples: zero-order, first-order, or zero-order with a delay of which
:math:`\delta < T` is the fraction (the older sample :math:`u_b` acts for :math:`\delta`, then :math:`u_a`). Each is
the exponential of an augmented matrix (Van Loan, IEEE TAC 23(3), 1978): with :math:`z = [x, u, 1]`,
:math:`\dot z = N z`, :math:`z(T) = e^{N T} z(0)`. Its derivatives are those of the same products, rule by rule.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

from seaopt.errors import SimulationError
from seaopt.records import record
from seaopt.simulation.model import Model

Hold = Literal["zero", "first"]
REACH, DEGREE = 0.125, 10  # 0.125^11 / 11! = 3e-18


@record
class Clock:
    """How samples become the input of a continuous plant.

    Parameters
    ----------
    period : float
        Seconds between samples.
    hold : {"zero", "first"}
        The input between samples: held (a command from a computer) or a straight line (a measured current).
    delay_s : float
        The plant gets the input this much later; with a first-order hold, a whole number of samples.
    delay_free : bool
        Whether derivatives with respect to the delay are wanted (zero-order hold only).

    """

    period: float
    hold: Hold = "zero"
    delay_s: float = 0.0
    delay_free: bool = False

    def __post_init__(self) -> None:
        if self.hold not in ("zero", "first"):
            raise SimulationError(f'hold = "{self.hold}" is not known; use "zero" or "first"')
        if not 0.0 <= self.delay_s < np.inf:
            raise SimulationError(f"delay_s = {self.delay_s:g} is not a delay; give zero or more seconds")
        if self.hold == "first" and (self.fraction_s > 0.0 or self.delay_free):
            raise SimulationError(
                f"delay_s = {self.delay_s:g} is not a whole number of samples of {self.period:g} s; "
                'with hold = "first" it must be, and cannot be free; use hold = "zero"'
            )

    @property
    def whole(self) -> int:
        """Whole samples in the delay."""
        return int(np.floor(self.delay_s / self.period + 1e-9))

    @property
    def fraction_s(self) -> float:
        """The rest of the delay, in seconds; zero to rounding."""
        rest = self.delay_s - self.whole * self.period
        return rest if rest > 1e-9 * self.period else 0.0

    @property
    def lags(self) -> tuple[int, int]:
        """The rows of the input in force: u[k - lags[0]] is u_a, u[k - lags[1]] is u_b."""
        return (self.whole, self.whole - 1) if self.hold == "first" else (self.whole, self.whole + 1)


@np.errstate(all="ignore")  # a plant far off may overflow: the result is then not finite
def expm_with_derivatives(
    n: Float[np.ndarray, "m m"], dn: Float[np.ndarray, "np m m"]
) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, "np m m"]]:
    """Return exp(n) and its derivatives along each dn: Taylor's polynomial by Horner's rule, scaled and squared.

    Products of small matrices only: a linear solver's threads would cost more than the matrices themselves.
    """
    norm = float(np.max(np.sum(np.abs(n), axis=1), initial=0.0))
    if not np.isfinite(norm) or not np.all(np.isfinite(dn)):
        return np.full_like(n, np.nan), np.full_like(dn, np.nan)
    squarings = max(0, int(np.ceil(np.log2(max(norm, 1e-300) / REACH))))
    m = n.shape[0]
    x = np.zeros((len(dn) + 1, 2 * m, 2 * m))  # [n, dn; 0, n]: powers of it are [n^k, d(n^k); 0, n^k]
    x[:, :m, :m] = x[:, m:, m:] = n * 2.0**-squarings
    x[1:, :m, m:] = dn * 2.0**-squarings
    one = np.eye(2 * m)
    e = np.broadcast_to(one, x.shape)
    for k in range(DEGREE, 0, -1):
        e = one + x @ e / k
    for _ in range(squarings):
        e = e @ e
    return e[0, :m, :m], e[1:, :m, m:]


def transition(model: Model, theta: Float[np.ndarray, " np"], clock: Clock) -> Float[np.ndarray, "..."]:
    """Return the sampled model and its derivatives.

    Returns
    -------
    array, shape (1 + np [+ 1], nx + ny, nx + 2 nu + 1)
        First x+ = F w over y = H w with w = [x, u_a, u_b, 1]; then the derivatives with respect to theta, and with
        respect to the delay where ``clock.delay_free``.

    """
    nx, nu, ny = model.nx, model.nu, model.ny
    g, dg = model.matrices(theta)
    if clock.hold == "first":
        f, df = _first_order(g[:nx], dg[:, :nx], nu, clock.period)
    else:
        f, df = _zero_order(g[:nx], dg[:, :nx], nu, clock)
    blocks = np.zeros((1 + df.shape[0], nx + ny, nx + 2 * nu + 1))
    blocks[0, :nx], blocks[1:, :nx] = f, df
    shift = nu if clock.fraction_s > 0.0 else 0  # at the sample the older input still acts
    for block, source in zip(blocks, (g, *dg), strict=False):
        block[nx:, :nx] = source[nx:, :nx]
        block[nx:, nx + shift : nx + shift + nu] = source[nx:, nx : nx + nu]
        block[nx:, -1] = source[nx:, -1]
    return blocks


def _zero_order(
    g: Float[np.ndarray, "nx w"], dg: Float[np.ndarray, "np nx w"], nu: int, clock: Clock
) -> tuple[Float[np.ndarray, "nx v"], Float[np.ndarray, "nd nx v"]]:
    nx, w = g.shape
    count = dg.shape[0]
    n, dn = np.zeros((w, w)), np.zeros((count, w, w))
    n[:nx], dn[:, :nx] = g, dg
    older, newer = clock.fraction_s, clock.period - clock.fraction_s
    second, dsecond = expm_with_derivatives(n * newer, dn * newer)
    f = np.zeros((nx, nx + 2 * nu + 1))
    df = np.zeros((count + clock.delay_free, nx, nx + 2 * nu + 1))
    ua, ub = slice(nx, nx + nu), slice(nx + nu, nx + 2 * nu)
    if older == 0.0 and not clock.delay_free:
        for target, source in ((f, second), (df, dsecond)):
            target[..., :nx], target[..., ua] = source[..., :nx, :nx], source[..., :nx, nx : nx + nu]
            target[..., -1] = source[..., :nx, -1]
        return f, df
    first, dfirst = expm_with_derivatives(n * older, dn * older)
    a2, b2, c2 = second[:nx, :nx], second[:nx, nx : nx + nu], second[:nx, -1]
    a1, b1, c1 = first[:nx, :nx], first[:nx, nx : nx + nu], first[:nx, -1]
    f[:, :nx], f[:, ua], f[:, ub], f[:, -1] = a2 @ a1, b2, a2 @ b1, a2 @ c1 + c2
    for j in range(count):
        da2, db2, dc2 = dsecond[j, :nx, :nx], dsecond[j, :nx, nx : nx + nu], dsecond[j, :nx, -1]
        da1, db1, dc1 = dfirst[j, :nx, :nx], dfirst[j, :nx, nx : nx + nu], dfirst[j, :nx, -1]
        df[j, :, :nx] = da2 @ a1 + a2 @ da1
        df[j, :, ua], df[j, :, ub] = db2, da2 @ b1 + a2 @ db1
        df[j, :, -1] = da2 @ c1 + a2 @ dc1 + dc2
    if clock.delay_free:  # d/d(older) of b2(T - older) u_a + a2 b1(older) u_b
        df[-1, :, ua] = -a2 @ g[:, nx : nx + nu]
        df[-1, :, ub] = a2 @ g[:, nx : nx + nu]
    return f, df


def _first_order(
    g: Float[np.ndarray, "nx w"], dg: Float[np.ndarray, "np nx w"], nu: int, period: float
) -> tuple[Float[np.ndarray, "nx v"], Float[np.ndarray, "np nx v"]]:
    """With z = [x, u, slope, 1]: xd = A x + B u + a, ud = slope; u_a = u, slope = (u_b - u_a) / T."""
    nx, w = g.shape
    m = w + nu
    n, dn = np.zeros((m, m)), np.zeros((dg.shape[0], m, m))
    for target, source in ((n, g), (dn, dg)):
        target[..., :nx, : nx + nu] = source[..., : nx + nu]
        target[..., :nx, -1] = source[..., -1]
    n[nx : nx + nu, nx + nu : nx + 2 * nu] = np.eye(nu)
    whole, dwhole = expm_with_derivatives(n * period, dn * period)

    def arrange(e: Float[np.ndarray, "... m m"]) -> Float[np.ndarray, "... nx v"]:
        slope = e[..., :nx, nx + nu : nx + 2 * nu] / period
        start = e[..., :nx, nx : nx + nu] - slope
        return np.concatenate([e[..., :nx, :nx], start, slope, e[..., :nx, -1:]], axis=-1)

    return arrange(whole), arrange(dwhole)
