"""A channel that is late looks like a damper in the spring: what was held out tells them apart.

The logs are of a held joint that is integrated here.
"""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from tests.actuator_logs import drive, integrate

RATE_HZ = 500.0
TRUTH = {"J_m": 2.4e-5, "b_r": 1.5e-4, "f_c": 0.004, "v_s": 1.0, "N": 100.0, "K_tau": 0.037, "k_s": 300.0}
DAMPER = 0.387  # N m s/rad: 1.29 ms of the spring


def record(*, damper=0.0, late=0, delay=0):
    """Return a log; `late`, `delay`: samples that the encoder is stamped late, and from the current to its effect."""
    p = TRUTH
    t, current = drive(6.0, RATE_HZ, 1.5, seed=1, top_hz=25.0)

    def rates(x, ampere):
        angle, speed = x
        torque = p["k_s"] * angle / p["N"] + damper * speed / p["N"]
        rub = p["b_r"] * speed + p["f_c"] * np.tanh(speed / p["v_s"])
        return speed, (p["K_tau"] * ampere - rub - torque / p["N"]) / p["J_m"]

    acting = np.concatenate([np.zeros(delay), current[: current.size - delay]])
    angle, speed = integrate(rates, 2, acting, 1.0 / RATE_HZ, 4)
    torque = (p["k_s"] * angle + damper * speed) / p["N"]
    noise = np.random.default_rng(7).normal(size=(2, t.size))
    read = np.concatenate([np.zeros(late), angle[: t.size - late]])
    return so.Log.from_arrays(time=t, I=current, tau_s=torque + 0.02 * noise[0], theta_m=read + 2e-3 * noise[1])


def find_cause(log):
    """Return the finding that names the likely cause, of a fit without a damper and without a delay."""
    plant = so.plants.rotary(link="locked")
    params = plant.defaults.update(**TRUTH, c_s=0.0).update(J_m=3e-5, k_s=240.0)
    fit = so.fit([so.Experiment(plant=plant, log=log)], params.free("J_m", "b_r", "f_c", "k_s"))
    (cause,) = [finding for finding in fit.findings if finding.kind == "cause"]
    return cause


@pytest.mark.slow  # every hypothesis of a held joint is tried ahead of it
def test_the_spring_is_damped_and_no_channel_is_late():
    cause = find_cause(record(damper=DAMPER))
    assert cause.text.startswith("likely cause: c_s") and "early" not in cause.text
    assert cause.preferred["c_s"][0] == pytest.approx(DAMPER, rel=0.01)


def test_a_channel_is_late_and_the_spring_undamped():
    cause = find_cause(record(late=1))
    assert cause.text.startswith("likely cause: theta_m is 1.99") and "c_s" not in cause.text


def test_a_drive_that_is_late_hides_no_damper():
    """Either alone leaves the other's part: delays of each channel, the only pair that was tried, were named."""
    cause = find_cause(record(damper=DAMPER, delay=1))
    assert cause.text.startswith("likely cause: a delay of 1.99") and "tau_s is" not in cause.text
    assert cause.preferred["c_s"][0] == pytest.approx(DAMPER, rel=0.01)
    assert cause.preferred["experiment.delay_s"][0] == pytest.approx(1.0 / RATE_HZ, rel=0.01)
