"""Scenarios play the law as it is exported: with its gate, and with its heat guard."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import PlausibilityGate
from seaopt.robustness.verification.large_signal import large_signal
from seaopt.robustness.verification.playback import Rig, play
from seaopt.robustness.verification.scenarios import Phase, Scenario
from seaopt.robustness.verification.verification import verify
from tests.control.deploy.test_derating import HEAT, LIMIT_A, warm

STEP = Scenario(name="step", phases=(Phase(duration_s=0.1), Phase(duration_s=0.4, force_N=200.0)), final_error=5.0)


def gated(controller, largest_step):
    gate = PlausibilityGate(range_N=(-4e3, 4e3), max_step_N=largest_step, max_held=3, ramp_per_s=90.0)
    return replace(controller, gate=gate)


def test_a_gate_that_is_never_asked_changes_nothing(limited_controller, stand, thor):
    plain, wide = (
        verify(each, {"stand": stand}, thor, scenarios=[STEP])
        for each in (limited_controller, gated(limited_controller, 500.0))
    )
    assert wide.rows == plain.rows
    assert plain.met


def test_bandwidths_at_amplitudes_are_those_of_the_law_behind_its_gate(limited_controller, stand, thor):
    plain, strict = (
        large_signal(each, stand, thor, amplitudes_N=(20.0,), frequencies_hz=(10.0, 30.0, 60.0))
        for each in (limited_controller, gated(limited_controller, 0.5))
    )
    np.testing.assert_array_equal(plain.gain, strict.gain)


def test_a_gate_that_takes_true_readings_for_faults_fails_the_run(limited_controller, stand, thor):
    verification = verify(gated(limited_controller, 0.5), {"stand": stand}, thor, scenarios=[STEP])
    (row,) = verification.rows
    assert "gate" in row.kinds
    assert "controller.gate" in row.reason
    current = verification.replay(row).current[0]
    assert np.any(current)
    assert not np.any(current[-100:])  # ramped to zero, until a reset


def test_the_heat_guard_limits_the_current_of_a_run():
    plant = so.plants.rotary(link="locked", parts=["thermal"])
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=15, current_limit_A=LIMIT_A)
    values = plant.defaults.update(**HEAT)
    controller = so.tune(plant, values, spec)
    push = Scenario(name="push", phases=(Phase(duration_s=3.0, force_N=2.0 * controller.force_limit(0.0)),))
    hottest = {
        derate: np.max(warm(play(Rig(controller=each, plant=plant), push, [values]).current[0]))
        for derate in (False, True)
        for each in [replace(controller, derate=derate)]
    }
    assert hottest[False] > HEAT["T_max"] + 30.0
    assert hottest[True] <= HEAT["T_max"]
    assert hottest[True] == pytest.approx(HEAT["T_max"], abs=15.0)
