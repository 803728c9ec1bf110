"""Oscillations, swings and describing functions against their closed forms."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from seaopt.robustness.verification.amplitude_prediction import predict_gain
from seaopt.robustness.verification.large_signal import predict_bandwidths
from seaopt.robustness.verification.oscillation import find_oscillation, measure_swing
from seaopt.robustness.verification.play_cycles import DEFLECTIONS, describe_play, predict_play_cycles

TIME = np.arange(2000) * 1e-3
TONE = 3.0 * np.sin(2 * np.pi * 41.7 * TIME)


def test_a_tone_is_found_between_the_bins():
    line = find_oscillation(TONE, 1e-3, floor=0.1, lowest_hz=5.0)
    assert (round(line.frequency_hz, 1), round(line.amplitude, 2), line.sustained) == (41.7, 3.0, True)
    assert not find_oscillation(TONE * np.exp(-2 * TIME), 1e-3, floor=0.1, lowest_hz=5.0).sustained


def test_a_swing_is_measured_on_a_drift():
    time = TIME[:400]
    swing = measure_swing(100 * time + 3.0 * np.sin(2 * np.pi * 40 * time), 1e-3, lowest_hz=10.0)
    assert (round(swing.frequency_hz), round(swing.amplitude, 1), round(swing.peak, 1)) == (40, 3.0, 3.2)
    assert swing.sustained


def test_the_gain_of_play_is_that_of_a_dead_zone():
    dead = (DEFLECTIONS > 1e-3).astype(float)
    x = 1e-3 / 4e-3
    expected = 1 - 2 / np.pi * (np.arcsin(x) + x * np.sqrt(1 - x**2))
    assert describe_play(dead, np.array([4e-3]))[0] == pytest.approx(expected, abs=0.05)


def test_friction_takes_gain_and_bandwidth_of_small_amplitudes():
    stand, rubbing = so.plants.high_impedance(), so.plants.thor().update(f_c=50.0)
    controller = so.tune(stand, rubbing, so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6))
    stuck, sliding = np.abs(predict_gain(controller, stand, rubbing, np.array([15.0]), np.array([0.1, 1e4])))[:, 0]
    assert stuck < sliding
    small, large = predict_bandwidths(controller, stand, rubbing, np.array([30.0, 1e5]))
    assert small < large and round(large) == 20
    assert predict_play_cycles(controller, stand, rubbing) == ()
