"""JAX: `lax.scan` of RK4 with forward sensitivities (`jacfwd`), and SciPy's trust-region reflective least squares."""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np
import simulate_jax
from problem import LOWER, START, UPPER, Answer, Data, Settings, report
from scipy.optimize import least_squares


def prepare(data: Data, settings: Settings) -> Callable[[], Answer]:
    """Compile residual and Jacobian."""
    function = simulate_jax.residual(data, settings.substeps)
    residual, jacobian = jax.jit(function), jax.jit(jax.jacfwd(function))
    residual(START).block_until_ready()
    jacobian(START).block_until_ready()

    def solve() -> Answer:
        found = least_squares(
            lambda z: np.asarray(residual(z)),
            START,
            jac=lambda z: np.asarray(jacobian(z)),
            bounds=(LOWER, UPPER),
            x_scale="jac",
        )
        return Answer(theta=found.x, evaluations=found.nfev, note=f"{found.njev} Jacobians")

    return solve


if __name__ == "__main__":
    report("JAX lax.scan + jacfwd, SciPy TRF", "jax", prepare)
