"""The plant in CasADi: one sample of classical Runge-Kutta steps as an SX function."""

from __future__ import annotations

import casadi as ca
from problem import STEP_S, V_S, K


def rates(x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
    """Return dx/dt of x = (position, speed), p = (m, b, Kf, Fc)."""
    return ca.vertcat(x[1], (p[2] * u - p[1] * x[1] - p[3] * ca.tanh(x[1] / V_S) - K * x[0]) / p[0])


def advance(x: ca.SX, u: ca.SX, p: ca.SX, substeps: int) -> ca.SX:
    """Return the state one sample later."""
    h = STEP_S / substeps
    for _ in range(substeps):
        k1 = rates(x, u, p)
        k2 = rates(x + h / 2 * k1, u, p)
        k3 = rates(x + h / 2 * k2, u, p)
        k4 = rates(x + h * k3, u, p)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


def step(substeps: int) -> ca.Function:
    """Return (x, u, p) -> the state one sample later."""
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 4)
    return ca.Function("step", [x, u, p], [advance(x, u, p, substeps)])
