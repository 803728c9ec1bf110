r"""The step of a nonlinear plant: classical Runge-Kutta of order four, as a CasADi function with its derivatives.

One step of length :math:`h` from :math:`x` at :math:`t`, with the input a straight line from :math:`u_0` to
:math:`u_1` over the step; CasADi differentiates the step itself, so that the sensitivities are those of the
numbers that the step computes.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from seaopt.simulation.model import Model


def step_function(model: Model) -> Any:
    """Return the CasADi function (t, x, u0, u1, p, h) -> (x1, dx1/dx, dx1/d[theta, h])."""
    if "step" not in model.functions:
        rate = ca.Function("rate", [model.t, model.x, model.u, model.p], [model.f])
        t, h = ca.SX.sym("t"), ca.SX.sym("h")
        x, p = ca.SX.sym("x", model.nx), ca.SX.sym("p", model.p.numel())
        u0, u1 = ca.SX.sym("u0", model.nu), ca.SX.sym("u1", model.nu)
        middle = 0.5 * (u0 + u1)
        k1 = rate(t, x, u0, p)
        k2 = rate(t + h / 2, x + h / 2 * k1, middle, p)
        k3 = rate(t + h / 2, x + h / 2 * k2, middle, p)
        k4 = rate(t + h, x + h * k3, u1, p)
        x1 = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        results = [x1, ca.densify(ca.jacobian(x1, x)), ca.densify(ca.jacobian(x1, ca.vertcat(p[: model.np], h)))]
        model.functions["step"] = ca.Function("seaopt_step", [t, x, u0, u1, p, h], results)
    return model.functions["step"]


def output_function(model: Model) -> Any:
    """Return the CasADi function (t, x, u, p) -> (y, dy/dx, dy/dtheta)."""
    if "output" not in model.functions:
        results = [
            ca.densify(model.h),
            ca.densify(ca.jacobian(model.h, model.x)),
            ca.densify(ca.jacobian(model.h, model.theta)),
        ]
        arguments = [model.t, model.x, model.u, model.p]
        model.functions["output"] = ca.Function("seaopt_output", arguments, results)
    return model.functions["output"]
