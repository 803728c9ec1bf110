r"""The steady-state Kalman filter of a plant, as the correction of its simulation by each prediction error.

.. math:: \hat x_{k+1} = F(\hat x_k, u_k) + K (y_k - \hat y_k), \qquad
          K = A P C^T (C P C^T + R)^{-1}, \qquad P = A P A^T - K (C P C^T + R) K^T + Q

with A, C the plant's derivatives over one sample, averaged over where the state has been if the plant is nonlinear.
The Riccati equation is solved by doubling (Anderson 1978; Chu, Fan, Lin, Wang, Int. J. Control 77, 2004), for the point
and its neighbours at once: K depends on the parameters and on the noise, and its derivatives are differences.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.estimation.problem.shapes import PerOutput
from seaopt.plants.memo import memo
from seaopt.records import record
from seaopt.simulation import Model, Point, transition
from seaopt.simulation.discretisation import expm_with_derivatives

DOUBLINGS = 60
LEAK = 1e-6  # per sample: what drifts and is hardly seen is forgotten in the end
HORIZON = 12  # doublings: samples over which an output may show a state
UNOBSERVABLE = 1e-8  # singular values below this part of the largest belong to what no output shows
DISTRUST = float(np.log(0.1))  # process noise, over each state's size, of a filter that hardly trusts the plant
RATE_LIMIT = 0.3  # per sample: dry friction at rest looks like a damping that would forget the speed within a sample
NEIGHBOUR = 1e-6  # relative step of the differences


@record(eq=False)
class SteadyStateFilter:
    """The settings from which one experiment's filter gain follows, besides parameters and noise."""

    size: Float[np.ndarray, " nx"]  # size of each state; its process noise over one sample is exp(noise) times that
    sensors: PerOutput  # standard deviation of the measurement noise, in output units
    places: Float[np.ndarray, "m w"]  # states and inputs over which a nonlinear plant is linearised
    gain: PerOutput  # of the sensors, as it is at the start: the filter's gain does not follow it
    follows: bool = True  # whether to compute the gain's derivatives; False: a constant gain

    def correction(self, model: Model, point: Point, noise: Float[np.ndarray, " q"]) -> Float[np.ndarray, "ns1 nx ny"]:
        """Return the gain, then its derivatives in the order of `Layout`: theta, a free delay, the noise. `noise` is
        empty where it is not estimated: the filter then hardly trusts the plant.
        """
        free_delay = point.clock.delay_free
        base = np.concatenate([point.theta, noise])
        steps = NEIGHBOUR * np.where(np.arange(base.size) < point.theta.size, np.abs(base), 1.0)
        steps[steps == 0.0] = NEIGHBOUR
        trials = np.vstack([base, base + np.diag(steps)]) if self.follows else base[None]
        a, c = self.linearise(model, point, trials[:, : point.theta.size])
        level = trials[:, point.theta.size :] if noise.size else np.full((len(trials), model.nx), DISTRUST)
        q = (self.size * np.exp(level)) ** 2
        gains = kalman_gain(a, c * self.gain[:, None], q, self.sensors**2)
        correction = np.zeros((1 + base.size + free_delay, model.nx, model.ny))
        correction[0] = gains[0]
        if self.follows:
            slopes = (gains[1:] - gains[0]) / steps[:, None, None]
            correction[1 : 1 + point.theta.size] = slopes[: point.theta.size]
            correction[1 + point.theta.size + free_delay :] = slopes[point.theta.size :]
        return correction

    def linearise(
        self, model: Model, point: Point, thetas: Float[np.ndarray, "t np"]
    ) -> tuple[Float[np.ndarray, "t nx nx"], Float[np.ndarray, "t ny nx"]]:
        """Return A and C, over one sample, at each theta."""
        nx, clock = model.nx, replace(point.clock, delay_free=False)
        a, c = np.empty((len(thetas), nx, nx)), np.empty((len(thetas), model.ny, nx))
        for i, theta in enumerate(thetas):
            if model.linear:
                block = transition(model, theta, clock)[0]
                a[i], c[i] = block[:nx, :nx], block[nx:, :nx]
                continue
            f, h = self._mean_derivatives(model, theta, clock.period)
            a[i], _ = expm_with_derivatives(f * clock.period, np.zeros((0, nx, nx)))
            model.set_samples(a[i])
            c[i] = h
        return a, c

    def _mean_derivatives(
        self, model: Model, theta: Float[np.ndarray, " np"], period: float
    ) -> tuple[Float[np.ndarray, "nx nx"], Float[np.ndarray, "ny nx"]]:
        m, nx = self.places.shape[0], model.nx
        p = np.repeat(model.parameters(theta)[:, None], m, axis=1)
        f, h = _map_derivatives(model, m)(0.0, self.places[:, :nx].T, self.places[:, nx:].T, p)
        rates, limit = np.array(f).reshape(nx, m, nx), RATE_LIMIT / period
        mean = rates.mean(axis=1)
        diagonal = np.clip(rates[np.arange(nx), :, np.arange(nx)], -limit, limit)
        # The filter has to hold the plant to the log wherever it is, also where it is damped least.
        mean[np.diag_indices(nx)] = diagonal.mean(axis=1) if self.follows else diagonal.max(axis=1)
        return mean, np.array(h).reshape(model.ny, m, nx).mean(axis=1)


@memo
def _map_derivatives(model: Model, count: int) -> ca.Function:
    """Return the function that gives the derivatives of f and h by the state at `count` places."""
    columns = [ca.densify(ca.jacobian(e, model.x)) for e in (model.f, model.h)]
    return ca.Function("derivatives", [model.t, model.x, model.u, model.p], columns).map(count)


def kalman_gain(
    a: Float[np.ndarray, "t nx nx"], c: Float[np.ndarray, "t ny nx"], q: Float[np.ndarray, "t nx"], r: PerOutput
) -> Float[np.ndarray, "t nx ny"]:
    """Return the predictor's steady-state gain of each plant; not finite where there is none. What no output shows, as
    the place of a free body under force sensors, would drift without bound: it is left out of the filter and not
    corrected. `a`, `c`: the plants over one sample; `q`, `r`: variances of the process noise per state, and of the
    measurement noise per output.
    """
    with np.errstate(all="ignore"):
        scaled = c / np.sqrt(r)[:, None]
        if not np.all(np.isfinite(a)) or not np.all(np.isfinite(scaled)):
            return np.full((len(a), a.shape[1], c.shape[1]), np.nan)
        to, back = _reduce_to_seen(a, scaled)
        noise = (to * q[:, None, :]) @ to.transpose(0, 2, 1)
        return back @ _solve_riccati(to @ a @ back, c @ back, noise, r)


def _reduce_to_seen(
    a: Float[np.ndarray, "t nx nx"], c: Float[np.ndarray, "t ny nx"]
) -> tuple[Float[np.ndarray, "t m nx"], Float[np.ndarray, "t nx m"]]:
    """Return the map of each plant's states to those that the outputs show, and a map back; m is the first plant's."""
    _, values, _ = _decompose_observability(a[:1], c[:1])
    rank = max(int(np.count_nonzero(values[0] > UNOBSERVABLE * values[0, 0])), 1)
    if rank == a.shape[1]:
        identity = np.broadcast_to(np.eye(rank), a.shape)
        return identity, identity
    scale, _, vectors = _decompose_observability(a, c)
    chosen = vectors[:, :rank]
    return chosen * scale[:, None, :], (chosen / scale[:, None, :]).transpose(0, 2, 1)


def _decompose_observability(
    a: Float[np.ndarray, "t nx nx"], c: Float[np.ndarray, "t ny nx"]
) -> tuple[Float[np.ndarray, "t nx"], Float[np.ndarray, "t m"], Float[np.ndarray, "t nx nx"]]:
    """Return how much the outputs of 2^HORIZON samples show of each state, and, of states so scaled, the directions."""
    growth = np.max(np.abs(np.linalg.eigvals(a)), axis=1)
    rows, power = c, a / np.maximum(growth, 1.0)[:, None, None]  # an unstable plant so scaled shows the same states
    for number in range(1, HORIZON + 1):
        rows, power = np.concatenate([rows, rows @ power], axis=1), power @ power
        if number % 4 == 0:
            rows = np.linalg.qr(rows, mode="r")
    scale = np.linalg.norm(rows, axis=1)
    scale = np.where(scale > 0.0, scale, 1.0)
    _, values, vectors = np.linalg.svd(rows / scale[:, None, :])
    return scale, values, vectors


def _solve_riccati(
    a: Float[np.ndarray, "t m m"], c: Float[np.ndarray, "t ny m"], q: Float[np.ndarray, "t m m"], r: PerOutput
) -> Float[np.ndarray, "t m ny"]:
    identity = np.eye(a.shape[1])
    x, g, h = (1.0 - LEAK) * a.transpose(0, 2, 1), c.transpose(0, 2, 1) @ (c / r[:, None]), q
    for _ in range(DOUBLINGS):
        if not np.all(np.isfinite(h)) or not np.all(np.isfinite(g)):
            return np.full((len(a), a.shape[1], c.shape[1]), np.nan)
        w = _invert_each(identity + g @ h)
        after = h + x.transpose(0, 2, 1) @ h @ w @ x
        g = g + x @ w @ g @ x.transpose(0, 2, 1)
        x = x @ w @ x
        done = np.max(np.abs(after - h)) <= 1e-14 * np.max(np.abs(after))
        h = after
        if done:
            break
    cross = a @ h @ c.transpose(0, 2, 1)
    return cross @ _invert_each(c @ h @ c.transpose(0, 2, 1) + np.diag(r))


def _invert_each(matrices: Float[np.ndarray, "t n n"]) -> Float[np.ndarray, "t n n"]:
    """Return the inverses; not finite if one of them has none."""
    try:
        return np.linalg.inv(matrices)
    except np.linalg.LinAlgError:
        return np.full_like(matrices, np.nan)
