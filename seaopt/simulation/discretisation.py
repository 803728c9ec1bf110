r"""Exact discretisation of a linear plant, with its exact parameter derivatives.

Between samples the input is held, or joined by straight lines. A delay of :math:`\delta < T` over whole samples puts
its corners at :math:`\delta` into each period T: two stretches, over each of which the input is a line. A stretch of
:math:`\tau` is the exponential of an augmented matrix (Van Loan, IEEE TAC 23(3), 1978): with
:math:`z = [x, u, \dot u, 1]`, :math:`\dot z = N z`, :math:`z(\tau) = e^{N \tau} L w`, where L makes the line of
:math:`w = [x, u_a, u_b, ..., 1]`, the state at the start and the samples in force. Derivatives are those of the same
products, rule by rule; with respect to the delay, :math:`d e^{N \delta} = N e^{N \delta}`, and the lines themselves
move where they are not level.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Float

from seaopt.errors import SimulationError
from seaopt.records import record
from seaopt.simulation.model import Model

Hold = Literal["zero", "first"]
SAME_PERIOD = 1e-6
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
        The plant gets the input this much later.
    delay_free : bool
        Whether derivatives with respect to the delay are wanted.
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

    @property
    def whole(self) -> int:
        """Whole samples in the delay."""
        return int(np.floor(self.delay_s / self.period + 1e-9))

    @property
    def fraction_s(self) -> float:
        """The rest of the delay, in seconds; zero to rounding."""
        left = self.delay_s - self.whole * self.period
        return left if left > 1e-9 * self.period else 0.0

    @property
    def split(self) -> bool:
        """Whether a period has two stretches: the older samples act for the first."""
        return self.fraction_s > 0.0 or self.delay_free

    @property
    def lags(self) -> tuple[int, ...]:
        """The rows of the input in force: u[k - lags[0]] is u_a, u[k - lags[1]] is u_b, and so on.

        A line from u_a to u_b, and with a fraction of a delay one from u_c to u_a before it; or u_a is held, and u_b
        before it.
        """
        whole = self.whole
        if self.hold == "zero":
            return whole, whole + 1
        return (whole, whole - 1, whole + 1) if self.split else (whole, whole - 1)


@np.errstate(all="ignore")  # a plant far off may overflow: the result is then not finite
def expm_with_derivatives(
    n: Float[np.ndarray, "m m"], dn: Float[np.ndarray, "np m m"]
) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, "np m m"]]:
    """Return exp(n) and its derivatives along each dn by a scaled Taylor polynomial: products of small matrices."""
    norm = float(np.max(np.sum(np.abs(n), axis=1), initial=0.0))
    if not np.isfinite(norm) or not np.all(np.isfinite(dn)):
        return np.full_like(n, np.nan), np.full_like(dn, np.nan)
    squarings = max(0, int(np.ceil(np.log2(max(norm, 1e-300) / REACH))))
    m = n.shape[0]
    x = np.zeros((len(dn) + 1, 2 * m, 2 * m))  # [n, dn; 0, n]: powers of it are [n^k, d(n^k); 0, n^k]
    x[:, :m, :m] = x[:, m:, m:] = n * 2.0**-squarings
    x[1:, :m, m:] = dn * 2.0**-squarings
    identity = np.eye(2 * m)
    e = np.broadcast_to(identity, x.shape)
    for k in range(DEGREE, 0, -1):
        e = identity + x @ e / k
    for _ in range(squarings):
        e = e @ e
    return e[0, :m, :m], e[1:, :m, m:]


def check_period(model: Model, clock: Clock) -> None:
    """Refuse a plant that holds samples of another period."""
    sampling = model.plant.sampling
    if sampling is None or sampling.period_s is None:
        return
    if abs(sampling.period_s / clock.period - 1.0) > SAME_PERIOD:
        raise SimulationError(
            f"plant {model.plant.name} samples every {sampling.period_s:g} s, and is simulated every {clock.period:g} "
            "s; make the difference anew for this period"
        )


@np.errstate(all="ignore")
def transition(model: Model, theta: Float[np.ndarray, " np"], clock: Clock) -> Float[np.ndarray, "..."]:
    """Return the sampled model and its derivatives.

    Returns
    -------
    array, shape (1 + np [+ 1], nx + ny, nx + m nu + 1)
        First x+ = F w over y = H w with w = [x, u_a, u_b, ..., 1], an input for each of ``clock.lags``; then the
        derivatives with respect to theta, and with respect to the delay where ``clock.delay_free``.

    Raises
    ------
    SimulationError
        The plant samples with another period.
    """
    check_period(model, clock)
    nx, nu = model.nx, model.nu
    g, dg = model.matrices(theta)
    generator = _augment(np.concatenate([g[None, :nx], dg[:, :nx]]), nu, joined=clock.hold == "first")
    older, newer = _make_lines(nx, nu, clock)
    step = _advance(generator, clock.period - clock.fraction_s, newer, nx, -1.0, free=clock.delay_free)
    if clock.split:
        first = _advance(generator, clock.fraction_s, older, nx, 1.0, free=clock.delay_free)
        chained = step[:, :, :nx] @ first[0]
        chained[1:] += step[0, :, :nx] @ first[1:]
        chained[:, :, nx:] += step[:, :, nx:]
        step = chained
    model.set_samples(step)
    blocks = np.concatenate([step, np.zeros((len(step), model.ny, step.shape[2]))], axis=1)
    # At the sample itself the older input still acts, if for any time at all.
    line = (older if clock.fraction_s > 0.0 or (clock.split and clock.hold == "first") else newer)[:, nx : nx + nu]
    for block, source in zip(blocks, (g, *dg), strict=False):
        block[nx:, :nx], block[nx:, -1] = source[nx:, :nx], source[nx:, -1]
        block[nx:] += source[nx:, nx : nx + nu] @ line[0]
    if clock.delay_free:
        blocks[-1, nx:] += g[nx:, nx : nx + nu] @ line[1]
    return blocks


def _augment(g: Float[np.ndarray, "nd nx w"], nu: int, *, joined: bool) -> Float[np.ndarray, "nd m m"]:
    """Return N of z = [x, u, 1], or of [x, u, slope, 1] where samples are joined by lines, and its derivatives."""
    nx, m = g.shape[1], g.shape[2] + nu * joined
    n = np.zeros((len(g), m, m))
    n[:, :nx, : nx + nu], n[:, :nx, -1] = g[:, :, : nx + nu], g[:, :, -1]
    if joined:
        n[0, nx : nx + nu, nx + nu : nx + 2 * nu] = np.eye(nu)
    return n


@lru_cache(maxsize=32)
def _make_lines(nx: int, nu: int, clock: Clock) -> tuple[Float[np.ndarray, "2 m v"], Float[np.ndarray, "2 m v"]]:
    """Return L, z = L w at the start of the older and of the newer stretch, each with its derivative by the delay."""
    joined, inputs = clock.hold == "first", len(clock.lags)
    older = np.zeros((2, nx + nu * (1 + joined) + 1, nx + nu * inputs + 1))
    older[0, :nx, :nx], older[0, -1, -1] = np.eye(nx), 1.0
    newer = older.copy()
    u, slope = slice(nx, nx + nu), slice(nx + nu, nx + 2 * nu)
    ua, ub, uc = (slice(nx + i * nu, nx + (i + 1) * nu) for i in range(3))
    identity, rate = np.eye(nu), np.eye(nu) / clock.period
    newer[0, u, ua] = identity
    if not joined:
        older[0, u, ub] = identity
        return older, newer
    newer[0, slope, ua], newer[0, slope, ub] = -rate, rate
    if clock.split:  # the line from u_c to u_a, which it reaches where the newer one begins
        older[0, u, ua], older[0, u, uc] = identity - rate * clock.fraction_s, rate * clock.fraction_s
        older[1, u, ua], older[1, u, uc] = -rate, rate
        older[0, slope, ua], older[0, slope, uc] = rate, -rate
    return older, newer


def _advance(
    generator: Float[np.ndarray, "nd m m"],
    duration: float,
    line: Float[np.ndarray, "2 m v"],
    nx: int,
    growth: float,
    *,
    free: bool,
) -> Float[np.ndarray, "nd2 nx v"]:
    """Return x at the end of a stretch from w, and its derivatives; the duration grows so fast with the delay."""
    whole, slopes = expm_with_derivatives(generator[0] * duration, generator[1:] * duration)
    steps = np.concatenate([whole[None], slopes])[:, :nx] @ line[0]
    if not free:
        return steps
    late = growth * (generator[0] @ whole)[:nx] @ line[0] + whole[:nx] @ line[1]
    return np.concatenate([steps, late[None]])
