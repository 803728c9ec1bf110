"""A schedule for tests: the knee on a crank of problems/lever_knee.toml, over a part of its angle."""

from functools import lru_cache

import seaopt as so
from seaopt.control import tune_schedule

POINTS = (0.0, 0.4, 0.65)


@lru_cache
def read_knee():
    """Return the stand, the swinging shank, and their parameters."""
    problem = so.read_problem("problems/lever_knee.toml")
    return problem.plants["stand"], problem.plants["swing"], problem.parameters


@lru_cache
def tune_knee():
    """Return the schedule over `POINTS`, tuned on the stand and robust to the swing."""
    stand, swing, values = read_knee()
    spec = so.ControllerSpec(measured="tau", bandwidth_hz=30, max_sensitivity=1.6, reserve=0.03, current_limit_A=5.0)
    return tune_schedule(stand, values, spec, "phi", POINTS, {"swing": swing})
