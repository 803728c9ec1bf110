"""An actuator that is held at its link, with friction of bristles, play and a spring with hysteresis, by scipy alone.

Nothing of it is the package's: the equations are written down again, and LSODA takes its own steps.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.integrate import solve_ivp


def rates(t, y, effort, p):
    """Return d/dt of coordinate, rate, bristles and slipping spring; `effort` drives the coordinate, gear 1/N."""
    x, v, z_f, z_h = y
    delta, turn = x / p["N"], v / p["N"]
    slip = turn - 0.5 * (turn * abs(z_h) + abs(turn) * z_h) / p["y_h"]
    level = p["f_c"] + (p["f_s"] - p["f_c"]) * math.exp(-((v / p["v_st"]) ** 2))
    bend = v - p["sigma_0"] * abs(v) * z_f / level if level else 0.0
    rub = p["sigma_0"] * z_f + p["sigma_1"] * bend if level else 0.0
    force = spring_force(delta, z_h, p)
    return [v, (effort(t) - p["b"] * v - rub - force / p["N"]) / p["M"], bend, slip]


def spring_force(delta, z_h, p):
    g, e = p["g_b"], p["eps_b"]
    z = delta + 0.5 * (np.sqrt((delta - g) ** 2 + e**2) - np.sqrt((delta + g) ** 2 + e**2)) if g else delta
    return p["k"] * z + p["k_h"] * z_h


def simulate_independently(p, time, effort):
    """Return coordinate, its rate, bristles' deflection and the spring's force; `effort` is piecewise straight."""
    p = {"N": 1.0, "f_c": 0.0, "f_s": p.get("f_c", 0.0), "v_st": 1.0, "sigma_0": 0.0, "sigma_1": 0.0, "k_h": 0.0,
         "y_h": 1.0, "g_b": 0.0, "eps_b": 0.0} | p  # fmt: skip
    size = np.array([1e-3, 1e-1, 1e-6, 1e-4]) * p.get("scale", 1.0)
    run = solve_ivp(
        rates, (time[0], time[-1]), np.zeros(4), method="LSODA", t_eval=time, rtol=1e-7, atol=1e-7 * size,
        max_step=time[1] - time[0], args=(lambda t: np.interp(t, time, effort), p),
    )  # fmt: skip
    x, v, z_f, z_h = run.y
    return {"x": x, "v": v, "z_f": z_f, "force": spring_force(x / p["N"], z_h, p)}
