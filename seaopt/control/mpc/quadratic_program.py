"""The quadratic program of a `HorizonProgram` in OSQP (Stellato et al., Math. Prog. Comp. 12, 2020), set up once.

Only its vectors change from sample to sample. Each solution starts from a given point with the same penalty rho, so
that it is a function of what it is given, here and in the C code, whatever was solved before.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.control.mpc.prediction import HorizonProgram
from seaopt.control.mpc.spec import ITERATIONS_PER_CHECK

RHO = 0.3  # of ADMM at the start of each program; with slew limits on many knots it has to grow on the way
PENALTY = 3.0  # of a unit of slack, a tenth of half the width of its bounds; the Hessian's diagonal is 1 on the mean
CURVATURE = 1.0  # of half its square: ADMM converges slowly along a direction with little
SOLVED, UNFINISHED = "solved", "maximum iterations reached"  # the solver's status, where it has a plan
WIDE = 1e6  # stands for no limit: of a row in units of its limit
SETTINGS: dict[str, Any] = {
    "eps_abs": 1e-4, "eps_rel": 1e-4, "check_termination": ITERATIONS_PER_CHECK, "rho": RHO, "adaptive_rho": True,
    "adaptive_rho_interval": 50, "adaptive_rho_tolerance": 2.0, "polishing": False, "warm_starting": True,
    "scaling": 10, "verbose": False,
}  # fmt: skip


def stack_hessian(prediction: HorizonProgram) -> Float[np.ndarray, "nv nv"]:
    """Return the Hessian over knots and slacks."""
    n, k = prediction.knots.size, len(prediction.outputs.names)
    return np.block([[prediction.H, np.zeros((n, k))], [np.zeros((k, n)), CURVATURE * np.eye(k)]])


def make_solver(hessian: Float[np.ndarray, "nv nv"], rows: Float[np.ndarray, "r nv"], max_iterations: int) -> Any:
    """Return OSQP set up with a program's matrices, and bounds that have no effect yet."""
    import osqp  # deferred: scipy.sparse and jinja2 are slow to load
    from scipy.sparse import csc_matrix

    solver = osqp.OSQP(algebra="builtin")
    P, wide = csc_matrix(np.triu(hessian)), np.full(len(rows), 10.0)
    solver.setup(
        P=P, q=np.zeros(len(hessian)), A=csc_matrix(rows), l=-wide, u=wide, max_iter=max_iterations, **SETTINGS
    )  # fmt: skip
    return solver


def solve_program(
    solver: Any, q: Float[np.ndarray, " n"], low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"],
    first: Float[np.ndarray, " n"], dual: Float[np.ndarray, " m"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"], str, Any]:  # fmt: skip
    """Return the solution, the dual to go on from, what went wrong ("" if nothing), and the solver's report.

    A program that the iterations did not suffice for is not wrong: its plan may keep the limits all the same.
    """
    solver.update(q=q, l=low, u=high)
    solver.warm_start(x=first, y=dual)
    result = solver.solve(raise_error=False)
    if result.info.rho_updates:
        solver.update_settings(rho=RHO)  # the next step starts as this one did
    x, y = np.array(result.x), np.array(result.y)
    wrong = "" if result.info.status in (SOLVED, UNFINISHED) else str(result.info.status)
    if not wrong and not (np.all(np.isfinite(x)) and np.all(np.isfinite(y))):
        wrong = "solution is not finite"
    return x, np.zeros_like(y) if wrong else y, wrong, result.info
