"""Searches that ended near by: a knee with two encoders whose friction sticks, simulated here step by step."""

import math

import numpy as np
import pytest

import seaopt as so

RATE_HZ, SUBSTEPS, DELAY_S = 1000.0, 100, 0.0013
K_TAU, N = 0.055, 80.0
TRUTH = {"J_m": 3e-5, "b_r": 1.5e-4, "k_s": 350.0, "f_c": 0.03, "J_l": 0.2, "d_l": 0.4}
STEPS = {"theta_m": 2 * math.pi / 16384, "theta_l": 2 * math.pi / 65536}


def record(seed, seconds=8.0):
    """Return a log of a multisine: positions at half steps, and friction that takes what would stop the motor."""
    rng, h = np.random.default_rng(seed), 1.0 / RATE_HZ / SUBSTEPS
    t, f = np.arange(round(seconds * RATE_HZ)) / RATE_HZ, np.geomspace(0.1, 12.0, 25)
    current = np.sin(2 * np.pi * np.outer(t, f) + rng.uniform(0.0, 6.28, f.size)).sum(axis=1)
    current = np.round(0.8 * current / current.std(), 3)
    J_m, b_r, k_s, f_c, J_l, d_l = TRUTH.values()
    late = math.floor(DELAY_S * RATE_HZ)
    switch = (DELAY_S * RATE_HZ - late) * SUBSTEPS  # the substep from which the newer of two commands acts
    padded = np.concatenate([np.zeros(late + 1), current]).tolist()
    motor = speed = link = rate = 0.0
    angles = np.empty((2, t.size))
    for i in range(t.size):
        angles[:, i] = motor, link
        for s in range(SUBSTEPS):
            effort = K_TAU * padded[i + 1 if s + 0.5 >= switch else i]
            motor += 0.5 * h * speed
            link += 0.5 * h * rate
            torque = k_s * (motor / N - link)
            speed += h * (effort - b_r * speed - torque / N) / J_m
            speed -= max(-h * f_c / J_m, min(h * f_c / J_m, speed))
            rate += h * (torque - d_l * rate) / J_l
            motor += 0.5 * h * speed
            link += 0.5 * h * rate
    noise = [[5e-5], [1e-5]] * rng.normal(size=(2, t.size))
    step = np.array([[each] for each in STEPS.values()])
    motor, link = np.round((angles + noise) / step) * step
    return so.Log.from_arrays(time=t, I=current, theta_m=motor, theta_l=link)


@pytest.mark.parametrize("seed", [11, 13])
def test_a_search_that_ended_near_by_begins_again_around_the_given_values(seed):
    """Ended with the delay at 5 and 6 ms, J_m 40 % below and 23 % above, and hundreds of times an encoder's noise."""
    plant, rng = so.plants.let_stick(so.plants.rotary(link="free")), np.random.default_rng(7)
    start = {name: value * 2.0 ** rng.uniform(-0.7, 0.7) for name, value in TRUTH.items()}
    known = plant.defaults.update(K_tau=K_TAU, N=N, eta=1.0, c_s=0.0, **start)
    delay = so.Parameter(name="delay_s", value=1e-3, unit="s", free=True, min=0.0, max=0.01)
    bench = so.Experiment(plant=plant, log=record(seed), name="bench", outputs=tuple(STEPS), delay_s=delay)
    fit = so.fit([bench], known.free(*TRUTH), diagnostics=False)
    assert fit.nuisance["bench"].delay_s == pytest.approx(DELAY_S, abs=2e-5)
    for name, value in TRUTH.items():
        assert fit.parameters[name].value == pytest.approx(value, rel=2e-3)
