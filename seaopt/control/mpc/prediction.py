r"""What a force model predictive controller minimises: a condensed quadratic cost over a few currents.

From targets x_s, u_s that hold the reference, :math:`\xi = x - x_s`, :math:`\mu = u - u_s`; over N samples

.. math::
    J = \sum_{j=0}^{N-1} \Big[ (w\,\xi_j / g)^2 + \rho\,(\mu_j - \mu_{j-1})^2 \Big]
        + \begin{bmatrix} \xi_N \\ \mu_{N-1} \end{bmatrix}^T \Pi \begin{bmatrix} \xi_N \\ \mu_{N-1} \end{bmatrix},
    \qquad \xi_{j+1} = A \xi_j + b \mu_j + b' \mu_{j-1}

where b' is not zero if a drive's delay leaves a part of a sample in which the command before still acts, and
with :math:`w\,\xi = F - F_\mathrm{ref} + \tau \dot F`, so that an error which dies out with the time constant
:math:`\tau` costs nothing and overshoot does; g the static gain in N/A, and :math:`\Pi` the cost of going on for ever
without limits (the Riccati solution of the plant with its last current as a state): with every sample free and no limit
active, the first current is that of the linear-quadratic regulator, whatever N. The weight :math:`\rho` is found from
the bandwidth that is asked of it.

Currents are free at some knots only, and straight lines between: :math:`\mu = W \theta`. A limit on size or slope of
such a line holds everywhere if it holds at the knots, so that nothing is lost but freedom.

A reference that is known ahead moves the target of sample j by :math:`\delta_j = (1 + \tau\,d/dt)(r_j - r_s)` from the
last that is known, :math:`r_s`, which is the target of the end: the cost weighs :math:`w\,\xi_j - \delta_j` instead,
and :math:`\delta` adds to the gradient. Bounds of outputs are in `output_bounds`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from seaopt.control.loops.peaks import HALF_POWER
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.control.mpc.force_plant import ForcePlant, interpolate_knots
from seaopt.control.mpc.output_bounds import OutputBounds
from seaopt.errors import ControlError
from seaopt.records import record
from seaopt.signals import MatrixMN, MatrixNN, VectorM

WEIGHTS = (1e-9, 1e9)  # of rho, over the square of the current per force
FASTEST_PLAN = 4.0  # times the bandwidth that is asked behind a prefilter
BELOW = 1000  # frequencies of the three decades below the bandwidth at which the force must follow


@record(eq=False)
class Regulator:
    """The unlimited optimum: increments of current are -(K_x xi + K_u mu), the cost to go is quadratic in Pi."""

    rho: float  # weight of the current's increments, 1/A^2
    K_x: Float[np.ndarray, " nx"]  # A per unit of each state
    K_u: float
    Pi: MatrixNN


@record(eq=False)
class HorizonProgram:
    """The quadratic program in theta, the knots' deviations from u_s in units of the current limit. Minimise theta' H
    theta / 2 + (F s + R delta)' theta, s = [xi_0, mu_-1], with rows theta and M theta within bounds, and those of
    `outputs`, whose slacks are variables too.
    """

    knots: Int[np.ndarray, " n"]  # samples at which the current is free
    H: MatrixNN
    F: Float[np.ndarray, "n s"]
    # slopes between knots over the slew limit, if there is one; the first row is the step from the last current
    M: MatrixMN
    lag_s: float  # with which a force error dies out at no cost
    # of the differences to the last reference known, at as many samples as can be known ahead
    R: Float[np.ndarray, "n p"]
    outputs: OutputBounds
    # the matrix of all rows, over knots and slacks: knots, slopes, and those of `outputs`
    rows: Float[np.ndarray, "r nv"]

    def take(self, added: float, stepped: float) -> Float[np.ndarray, " r"]:
        """Return what the ends of the rows lose to what is added to the command, a share of its limit, and to the step
        that is made of it, a share of the slew limit.
        """
        taken = np.zeros(len(self.rows))
        taken[: self.knots.size] = added
        taken[self.knots.size : self.knots.size + min(len(self.M), 1)] = stepped
        return taken


def solve_regulator(plant: ForcePlant, rho: float) -> Regulator:
    """Return the linear-quadratic regulator of w xi over the gain, and of the current's increments."""
    from scipy.linalg import solve_discrete_are  # deferred: scipy is slow to load

    A, b = plant.add_command()
    row = np.append(plant.w / plant.gain, 0.0)
    try:
        Pi = np.asarray(solve_discrete_are(A, b[:, None], np.outer(row, row), np.array([[rho]])))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ControlError(
            f"the plant has a mode that the current cannot steer ({error}); design on another, such as the stand"
        ) from error
    K = b @ Pi @ A / (rho + b @ Pi @ b)
    return Regulator(rho=rho, K_x=K[:-1], K_u=float(K[-1]), Pi=Pi)


def tune_regulator(plant: ForcePlant, bandwidth_hz: float) -> Regulator:
    """Return the regulator whose force follows its reference, within 3 dB, up to a frequency; by a search for rho."""
    from scipy.optimize import brentq  # deferred: scipy is slow to load

    below = bandwidth_hz * np.geomspace(1e-3, 1.0, BELOW)

    def excess(log_rho: float) -> float:
        """Return ln of abs(F/F_ref) over -3 dB at the bandwidth; it falls with the weight."""
        return float(np.log(_track(plant, solve_regulator(plant, float(np.exp(log_rho))), below[-1:])[0] / HALF_POWER))

    low, high = np.log(WEIGHTS).tolist()
    if excess(low) < 0.0:
        raise ControlError(
            f"bandwidth_hz = {bandwidth_hz:g} is beyond what any weight gives at {1 / plant.sample_time_s:g} Hz; lower "
            "it"
        )
    if excess(high) > 0.0:
        raise ControlError(f"bandwidth_hz = {bandwidth_hz:g} is slower than any weight makes it; raise it")
    root: Any = brentq(excess, low, high, xtol=1e-12)
    regulator = solve_regulator(plant, float(np.exp(root)))
    dips = np.flatnonzero(_track(plant, regulator, below) < 0.99 * HALF_POWER)
    if dips.size:
        raise ControlError(
            f"the force is lost near {below[dips[0]]:.3g} Hz, far below bandwidth_hz = {bandwidth_hz:g}: the plant "
            "has a zero there that no controller fills; design on the stand"
        )
    return regulator


def _track(plant: ForcePlant, candidate: Regulator, f: VectorM) -> VectorM:
    """Return abs(F/F_ref); whole samples of delay, which do not change it, are left out."""
    (A, b), row = plant.add_command(), np.append(plant.c, 0.0)
    closed = A - np.outer(b, np.append(candidate.K_x, candidate.K_u))
    drive = b * (candidate.K_x @ (plant.rest_state / plant.gain) + candidate.K_u / plant.gain)
    inner = np.exp(2j * np.pi * f * plant.sample_time_s)[:, None, None] * np.eye(b.size) - closed
    return np.abs(np.linalg.solve(inner, drive[None, :, None])[..., 0] @ row)


def find_plan_bandwidth(
    make_plant: Callable[[float], ForcePlant], bandwidth_hz: float, low_pass: TransferFunction | None
) -> float:
    """Return the bandwidth of a plan, of which `make_plant` gives the plant, that makes one behind a low-pass."""
    if low_pass is None:
        return bandwidth_hz
    from scipy.optimize import brentq  # deferred: scipy is slow to load

    at, period = np.array([bandwidth_hz]), make_plant(bandwidth_hz).sample_time_s
    shaped = float(np.abs(low_pass.response(at, period))[0])

    def excess(plan_hz: float) -> float:
        plant = make_plant(plan_hz)
        return float(_track(plant, tune_regulator(plant, plan_hz), at)[0]) * shaped / HALF_POWER - 1.0

    fastest = min(FASTEST_PLAN * bandwidth_hz, 0.24 / period)
    if not fastest > bandwidth_hz or excess(fastest) < 0.0:
        raise ControlError(
            f"bandwidth_hz = {bandwidth_hz:g}: no plan has it behind the prefilter; raise its corner, or ask for less"
        )
    root: Any = brentq(excess, bandwidth_hz, fastest, xtol=1e-6 * bandwidth_hz)
    return float(root)


def condense(
    plant: ForcePlant,
    regulator: Regulator,
    knots: Int[np.ndarray, " n"],
    limit: float,
    slew_per_sample: float,
    previewed: int,
    outputs: OutputBounds,
) -> HorizonProgram:
    """Return the quadratic program of a horizon. `limit` and `slew_per_sample` are in A, the latter infinite if there
    is none; references are known at `previewed` samples besides the last.
    """
    W = interpolate_knots(knots)
    N, n, size = len(W), knots.size, plant.b.size + 1
    *states, (free, forced) = plant.respond(N)  # xi_j = free [xi_0, mu_-1] + forced mu
    rows = np.array([plant.w @ each / plant.gain for _, each in states])
    starts = np.array([plant.w @ each / plant.gain for each, _ in states])
    step = np.eye(N) - np.eye(N, k=-1)  # mu_j - mu_{j-1}, of which the first has mu_-1
    end, begin = np.vstack([forced, np.eye(N)[-1]]), np.vstack([free, np.zeros(size)])
    hessian = rows.T @ rows + regulator.rho * step.T @ step + end.T @ regulator.Pi @ end
    cross = rows.T @ starts + end.T @ regulator.Pi @ begin
    cross[0, -1] -= regulator.rho
    H, F, R = limit**2 * W.T @ hessian @ W, limit * W.T @ cross, -limit * W.T @ rows.T[:, :previewed] / plant.gain
    scale = n / float(np.trace(H))
    slopes = np.zeros((0, n))
    if np.isfinite(slew_per_sample):
        steps = np.diff(knots, prepend=knots[0] - 1)
        slopes = (np.eye(n) - np.eye(n, k=-1)) * limit / (slew_per_sample * steps)[:, None]
    limits = np.vstack([np.eye(n), slopes])
    slackless = np.zeros((len(limits), len(outputs.names)))
    return HorizonProgram(
        knots=knots,
        H=0.5 * (H + H.T) * scale,
        F=F * scale,
        M=slopes,
        lag_s=plant.lag_s,
        R=R * scale,
        outputs=outputs,
        rows=np.vstack([np.hstack([limits, slackless]), outputs.rows()]),
    )
