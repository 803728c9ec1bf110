"""Bandwidth against amplitude of a joint that sticks, against what its dry friction can hold."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from seaopt.robustness.verification.large_signal import large_signal

FRICTION = 50.0 * 0.02  # N m at the joint: N f_c


@pytest.fixture(scope="module")
def sweep():
    plant = so.plants.let_stick(so.plants.rotary(link="locked"))
    values = plant.defaults.update(
        N=50.0, eta=0.9, K_tau=0.1, J_m=5e-5, b_r=3e-4, f_c=0.02, k_s=300.0, c_s=0.4, v_s=1.0
    )
    spec = so.ControllerSpec(
        measured="tau_s", bandwidth_hz=20.0, max_sensitivity=1.6, max_noise_gain=60.0, current_limit_A=20.0
    )
    law = so.tune(plant, values, spec)
    return law, large_signal(law, plant, values, amplitudes_N=(0.02, 0.1, 1.0, 6.0))


def test_a_motor_that_friction_holds_does_not_follow(sweep):
    """The effort k_r r + k_i of its integral, 2 A/(2 pi f) from rest at most, is below the friction: nothing moves."""
    law, swept = sweep
    assert swept.friction_N == pytest.approx(FRICTION)
    effort = law.gains["k_r"] + 2.0 * law.gains["k_i"] / (2.0 * np.pi * swept.frequency_hz)
    held = swept.amplitude_N[:, None] * effort < 0.98 * FRICTION
    assert np.count_nonzero(held) >= 6
    assert np.all(np.abs(swept.gain[held]) < 1e-6)
    assert np.all(np.abs(swept.gain[-1]) > 0.1)


def test_prediction_and_simulation_of_a_motor_that_sticks_agree(sweep):
    _, swept = sweep
    assert swept.bandwidth_hz[0] is None  # held at every frequency, or at all but the slowest
    for simulated, predicted in list(zip(swept.bandwidth_hz, swept.predicted_hz, strict=True))[2:]:
        assert predicted == pytest.approx(simulated, rel=0.1)


def test_a_motor_that_sticks_has_no_bandwidth_of_its_smoothing(sweep):
    law, _ = sweep
    assert "20 Hz sliding" in repr(law)
    assert "Hz stuck" not in repr(law) and "bandwidth, stuck" not in repr(law)
