"""CasADi single shooting: `mapaccum` over the samples, forward sensitivities as states, SciPy's trust region.

The Jacobian is a `mapaccum` of the step together with its derivative, which CasADi evaluates four times faster than the
derivative of a `mapaccum`.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np
import simulate_casadi
from problem import LOWER, NOISE_N, SAMPLES, START, UPPER, Answer, Data, K, Settings, report
from scipy.optimize import least_squares


def sensitive_step(substeps: int) -> ca.Function:
    """Return (x and its derivatives by p and x0, u, p) -> the same one sample later."""
    x, s, u, p = ca.SX.sym("x", 2), ca.SX.sym("s", 2, 6), ca.SX.sym("u"), ca.SX.sym("p", 4)
    after = simulate_casadi.advance(x, u, p, substeps)
    direct = ca.horzcat(ca.jacobian(after, p), ca.SX(2, 2))
    derivative = ca.jacobian(after, x) @ s + direct
    return ca.Function("step", [ca.vertcat(x, ca.vec(s)), u, p], [ca.vertcat(after, ca.vec(derivative))])


def prepare(data: Data, settings: Settings) -> Callable[[], Answer]:
    """Unroll both functions over the samples."""
    plain = simulate_casadi.step(settings.substeps).mapaccum(SAMPLES - 1)
    sensitive = sensitive_step(settings.substeps).mapaccum(SAMPLES - 1)
    inputs = ca.DM(data.current[:-1]).T
    at_start = np.concatenate([np.zeros(8), np.eye(2).ravel(order="F")])  # columns: m, b, Kf, Fc, x0, v0

    def residual(z: np.ndarray) -> np.ndarray:
        x = np.asarray(plain(z[5:], inputs, z[:4]))[0]
        return (K * np.concatenate([z[5:6], x]) + z[4] - data.force) / NOISE_N

    def jacobian(z: np.ndarray) -> np.ndarray:
        rows = np.asarray(sensitive(np.concatenate([z[5:], at_start]), inputs, z[:4]))[2::2]
        columns = np.concatenate([at_start[::2, None], rows], axis=1).T * (K / NOISE_N)
        return np.insert(columns, 4, 1.0 / NOISE_N, axis=1)

    def solve() -> Answer:
        found = least_squares(residual, START, jac=jacobian, bounds=(LOWER, UPPER), x_scale="jac")
        return Answer(theta=found.x, evaluations=found.nfev, note=f"{found.njev} Jacobians")

    return solve


if __name__ == "__main__":
    report("CasADi mapaccum, SciPy TRF", "casadi", prepare)
