"""The quadratic program of a `HorizonProgram` in OSQP (Stellato et al., Math. Prog. Comp. 12, 2020), set up once.

Only its vectors change from sample to sample. Each solution starts from a given point with the same penalty rho, so
that it is a function of what it is given, here and in the C code, whatever was solved before.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.control.mpc.prediction import HorizonProgram

RHO = 0.3  # of ADMM at the start of each program; with slew limits on many knots it has to grow on the way
SETTINGS: dict[str, Any] = {
    "eps_abs": 1e-4, "eps_rel": 1e-4, "max_iter": 1000, "check_termination": 5, "rho": RHO, "adaptive_rho": True,
    "adaptive_rho_interval": 20, "adaptive_rho_tolerance": 2.0, "polishing": False, "warm_starting": True,
    "scaling": 10, "verbose": False,
}  # fmt: skip


def make_solver(prediction: HorizonProgram) -> Any:
    """Return OSQP set up with the program's matrices, and bounds that have no effect yet."""
    import osqp  # deferred: scipy.sparse and jinja2 are slow to load
    from scipy.sparse import csc_matrix

    n = prediction.knots.size
    rows = np.vstack([np.eye(n), prediction.M])
    solver = osqp.OSQP(algebra="builtin")
    wide = np.full(len(rows), 10.0)
    P = csc_matrix(np.triu(prediction.H))
    solver.setup(P=P, q=np.zeros(n), A=csc_matrix(rows), l=-wide, u=wide, **SETTINGS)
    return solver


def solve_program(
    solver: Any, q: Float[np.ndarray, " n"], low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"],
    first: Float[np.ndarray, " n"], dual: Float[np.ndarray, " m"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"], str, Any]:  # fmt: skip
    """Return the solution, its dual, what went wrong ("" if nothing), and the solver's report."""
    solver.update(q=q, l=low, u=high)
    solver.warm_start(x=first, y=dual)
    result = solver.solve(raise_error=False)
    if result.info.rho_updates:
        solver.update_settings(rho=RHO)  # the next step starts as this one did
    x, y = np.array(result.x), np.array(result.y)
    wrong = "" if result.info.status == "solved" else str(result.info.status)
    if not wrong and not (np.all(np.isfinite(x)) and np.all(np.isfinite(y))):
        wrong = "solution is not finite"
    return x, y, wrong, result.info
