"""CasADi partially constrained multiple shooting, Gauss-Newton Hessian, IPOPT.

The method that nlgreyfast recommends (Retzler, Swevers, Gillis, Kollar, AMC 2022), which itself needs MATLAB: a
shooting node every D = 8 samples, continuity as constraints, the J'J of the residuals in place of the Hessian. Nodes
start at the measured force over the spring and at its difference quotient.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np
import simulate_casadi
from problem import LOWER, NOISE_N, SAMPLES, SCALE, START, STEP_S, UPPER, Answer, Data, K, Settings, report

GROUP = 8
GROUPS = SAMPLES // GROUP
THREADS = 2


def program(data: Data, substeps: int) -> tuple[dict[str, ca.MX], ca.Function]:
    """Return the nonlinear program in scaled unknowns and its Gauss-Newton Hessian."""
    p, nodes = ca.MX.sym("p", 5), ca.MX.sym("nodes", 2, GROUPS)
    w = ca.veccat(p, nodes)
    real, start = p * SCALE[:5], nodes * SCALE[5:]
    shoot = simulate_casadi.step(substeps).mapaccum(GROUP).map(GROUPS, "thread", THREADS)
    after = shoot(start, ca.DM(data.current).T, ca.repmat(real[:4], 1, SAMPLES))
    ends = after[:, GROUP - 1 :: GROUP]
    inner = ca.reshape(after[0, :], GROUP, GROUPS)[: GROUP - 1, :]
    force = K * ca.vec(ca.vertcat(start[0, :], inner)) + real[4]
    residual = (force - data.force) / NOISE_N
    gaps = (ends[:, :-1] - start[:, 1:]) / SCALE[5:]
    jacobian = ca.jacobian(residual, w)
    sigma, multipliers = ca.MX.sym("sigma"), ca.MX.sym("lam", 2 * (GROUPS - 1))
    hessian = ca.Function(
        "nlp_hess_l", [w, ca.MX.sym("none", 0), sigma, multipliers], [sigma * ca.triu(jacobian.T @ jacobian)]
    )
    return {"x": w, "f": 0.5 * ca.dot(residual, residual), "g": ca.vec(gaps)}, hessian


def prepare(data: Data, settings: Settings) -> Callable[[], Answer]:
    """Build the program and its derivatives."""
    nlp, hessian = program(data, settings.substeps)
    options = {"hess_lag": hessian, "print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-8}}
    solver = ca.nlpsol("solver", "ipopt", nlp, options)
    x = data.force / K
    nodes = np.stack([x, np.gradient(x, STEP_S)])[:, ::GROUP] / SCALE[5:, None]
    start = np.concatenate([START[:5] / SCALE[:5], nodes.ravel(order="F")])
    free = np.full(2 * GROUPS, np.inf)
    low, high = (np.concatenate([bound[:5] / SCALE[:5], sign * free]) for bound, sign in ((LOWER, -1), (UPPER, 1)))

    def solve() -> Answer:
        found = solver(x0=start, lbx=low, ubx=high, lbg=0, ubg=0)
        stats, theta = solver.stats(), np.asarray(found["x"]).ravel()[:7] * SCALE
        return Answer(theta=theta, evaluations=stats["iter_count"], note=stats["return_status"])

    return solve


if __name__ == "__main__":
    report("CasADi multiple shooting (D=8), IPOPT", "casadi", prepare)
