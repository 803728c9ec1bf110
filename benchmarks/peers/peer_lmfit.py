"""lmfit with SciPy's `odeint`: what a first search turns up.

lmfit's own difference steps drown in the integrator's error. Hence unknowns in units of SCALE, shifted by one so that
none starts at zero, and steps of a hundredth; and the loosest tolerances whose error stays well under the noise. It
stops itself at the time limit and tells the best it has found.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import lmfit
import numpy as np
from problem import LOWER, NAMES, NOISE_N, SAMPLES, SCALE, START, STEP_S, UPPER, V_S, Answer, Data, K, Settings, report
from scipy.integrate import odeint

UNKNOWNS = (*NAMES, "x0", "v0")


def simulate(z: np.ndarray, current: list[float]) -> np.ndarray:
    """Return the force (N) at the samples."""
    m, b, gain, coulomb, offset = z[:5]

    def rates(state: np.ndarray, t: float) -> tuple[float, float]:
        x, v = state
        u = current[min(int(t / STEP_S + 1e-9), SAMPLES - 1)]
        return v, (gain * u - b * v - coulomb * math.tanh(v / V_S) - K * x) / m

    states = odeint(rates, z[5:], np.arange(SAMPLES) * STEP_S, hmax=STEP_S, rtol=1e-5, atol=1e-8)
    return K * states[:, 0] + offset


def prepare(data: Data, settings: Settings) -> Callable[[], Answer]:
    """Name the parameters."""
    params = lmfit.Parameters()
    for name, value, low, high in zip(UNKNOWNS, *(bound / SCALE + 1.0 for bound in (START, LOWER, UPPER)), strict=True):
        params.add(name, value=value, min=low, max=high)
    current = data.current.tolist()
    deadline = time.perf_counter() + settings.limit_s

    def solve() -> Answer:
        best = (math.inf, START)
        count = 0

        def residual(tried: lmfit.Parameters) -> np.ndarray:
            nonlocal best, count
            z = (np.array([tried[name].value for name in UNKNOWNS]) - 1.0) * SCALE
            out = (simulate(z, current) - data.force) / NOISE_N
            best, count = min(best, (float(out @ out), z), key=lambda item: item[0]), count + 1
            return out

        found = lmfit.minimize(
            residual, params, method="least_squares", x_scale="jac", diff_step=1e-2,
            iter_cb=lambda *_: time.perf_counter() > deadline,
        )  # fmt: skip
        note = f"stopped after {settings.limit_s:.0f} s, not converged" if found.aborted else found.message
        return Answer(theta=best[1], evaluations=count, note=note)

    return solve


if __name__ == "__main__":
    report("lmfit + odeint", "lmfit", prepare)
