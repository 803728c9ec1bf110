"""A rotary actuator under a sampled impedance controller, simulated sample by sample with SciPy alone, for tests."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.linalg import expm


def simulate_link(
    values: Mapping[str, Any], law: Any, delay_samples: int, per_effort: float, gains: tuple[float, float, float],
    load: tuple[float, float, float], start: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the state one sample later: motor, link (angles and speeds), commands under way, law, last angle, speed.

    `gains` are K_v, D_v and T_v; `load` is everything on the spring's outer end: inertia, damper, spring.
    """
    j_m, b_r, n, k_s, c_s = (values[name].value for name in ("J_m", "b_r", "N", "k_s", "c_s"))
    effort_per_ampere = values["eta"].value * n * values["K_tau"].value
    stiffness, damping, filter_s = gains
    inertia, damper, spring = load
    period = law.sample_time_s
    motor, commands = start[:4], start[4 : 4 + delay_samples]
    inner, last, speed = start[4 + delay_samples : -2], start[-2], start[-1]
    theta_m, theta_l = motor[0], motor[2]
    torque = k_s * (theta_m / n - theta_l) + c_s * (motor[1] / n - motor[3])
    speed = (filter_s * speed + (theta_l - last)) / (filter_s + period)
    reference = -stiffness * theta_l - damping * speed
    effort = law.c @ inner + law.d @ [reference, torque]
    inner = law.a @ inner + law.b @ [reference, torque]
    line = np.concatenate([commands, [effort]])  # the oldest first
    current = per_effort * line[0]
    a = np.array([
        [0, 1, 0, 0], [-k_s / n**2, -b_r - c_s / n**2, k_s / n, c_s / n],
        [0, 0, 0, 1], [k_s / n, c_s / n, -k_s - spring, -c_s - damper],
    ])  # fmt: skip
    a[1] /= j_m
    a[3] /= inertia
    block = np.zeros((5, 5))
    block[:4, :4] = a
    block[1, 4] = effort_per_ampere / n / j_m
    motor = (expm(block * period) @ np.concatenate([motor, [current]]))[:4]
    return np.concatenate([motor, line[1:], inner, [theta_l, speed]])


def find_radius(
    values: Mapping[str, Any], law: Any, delay_samples: int, per_effort: float, gains: tuple[float, float, float],
    load: tuple[float, float, float],
) -> float:  # fmt: skip
    """Return the largest magnitude of the eigenvalues of one sample of `simulate_link`."""
    size = 4 + delay_samples + law.c.size + 2
    step = [simulate_link(values, law, delay_samples, per_effort, gains, load, row) for row in np.eye(size)]
    return float(np.max(np.abs(np.linalg.eigvals(np.array(step).T))))
