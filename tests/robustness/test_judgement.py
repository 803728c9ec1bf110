"""What is allowed: no false alarm from noise, no cycle that is missed, no current above the limit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control.realisation import runnable
from seaopt.errors import SimulationError
from seaopt.robustness.playback import Stage, play
from seaopt.robustness.scenarios import default_scenarios
from seaopt.robustness.verification import verify

SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)


@pytest.fixture(scope="module")
def controller(stand, swing, thor):
    return so.tune(stand, thor, SPEC, robust_to={"swing": swing})


def chosen(controller, plant, name):
    (found,) = [item for item in default_scenarios(controller, plant) if item.name == name]
    return found


def test_an_amplifier_that_rounds_stays_within_the_limit(controller, stand, thor):
    """The law's own commands, rounded by NumPy to whole steps and cut at 8.96 A = 128 steps of 0.07 A."""
    stage = Stage(controller=controller, plant=stand, current_step_A=0.07)
    trace = play(stage, chosen(controller, stand, "saturating doublet"), [thor])
    commands, _ = runnable(controller).run(trace.reference[0], trace.outputs["F1"][0])
    rounded = np.clip(0.07 * np.round(commands / 0.07), -8.96, 8.96)
    np.testing.assert_allclose(trace.current[0, 1:], rounded[:-1], atol=1e-9)
    assert np.max(np.abs(commands)) == 9.0 and np.max(np.abs(trace.current)) == pytest.approx(8.96)
    found = verify(controller, {"stand": stand}, thor, current_step_A=0.07)
    assert max(row.peak_current_A for row in found.rows) <= 9.0
    assert next(row for row in found.rows if row.scenario == "saturating hold").saturated > 0.1


def test_a_step_above_the_limit_leaves_no_current(controller, stand, thor):
    with pytest.raises(SimulationError, match="every current but zero"):
        verify(controller, {"stand": stand}, thor, current_step_A=9.5)


def test_a_load_is_no_bound_on_what_is_known(controller, stand, swing, thor):
    """The same run, sample by sample, whether the inertia's bounds hold 1.5 times its value or not."""
    bounded = thor.with_parameters(replace(thor["I_p"], min=0.3, max=0.5))
    stage = Stage(controller=controller, plant=swing, partner=stand)
    loaded = [play(stage, chosen(controller, swing, "payload"), [params]) for params in (thor, bounded)]
    np.testing.assert_array_equal(loaded[0].outputs["phi"], loaded[1].outputs["phi"])
    assert verify(controller, {"swing": swing}, bounded, scenarios=[chosen(controller, swing, "payload")]).passed
