"""The requirement on a controller that compensates ripple: no slope over the motor's angle is unstable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import CompensateGravity, CompensateRipple, SampledLoop, add_compensation, run_loop, runnable
from seaopt.robustness.certificate.compensation import NEUTRAL, choose_worst, measure_ripple
from tests.hanging_link import HELD, KNEE, VALUES, tune_held


@pytest.fixture(scope="module")
def plain():
    return tune_held()


def find_worst_ripple(controller, plant, nominal, draws):
    return choose_worst(measure_ripple(controller, plant, nominal, draw) for draw in draws)


def compensate(controller, slope_per_effort, **more):
    """Return a controller with a series of that slope, effort per rad, at zero and of the opposite half a turn on."""
    sine = slope_per_effort * controller.command.per_effort
    asked = CompensateRipple(cycles=(1,), cos=(0.0,), sin=(sine,), fraction=1.0)
    return add_compensation(controller, ripple=asked, **more)


def test_eigenvalue_is_the_growth_that_is_simulated(plain):
    controller = compensate(plain, 60.0)  # the spring's 300/50^2 is 6 N m of effort per rad of the motor
    found = find_worst_ripple(controller, HELD, VALUES, [{}])
    loop = SampledLoop(plant=HELD, law=runnable(controller), measured="tau_s", delay_samples=1)
    reference = np.zeros(1200)
    reference[0] = 1e-9
    run = run_loop(loop, [VALUES], reference).outputs["tau_s"][0]
    size = np.array([np.max(np.abs(part)) for part in np.split(run, 12)])
    assert found.radius > 1.0 + 1e-3
    assert (size[9] / size[5]) ** (1.0 / 400.0) - 1.0 == pytest.approx(found.radius - 1.0, rel=0.02)


def test_small_ripple_is_met_and_the_worst_draw_is_named(plain):
    small = compensate(plain, 0.5)
    assert find_worst_ripple(small, HELD, VALUES, [{}]).radius < 1.0
    steep = compensate(plain, 60.0)
    worst = find_worst_ripple(steep, HELD, VALUES, [{"k_s": 300.0}, {"k_s": 240.0}])
    assert worst.parameters in ({"k_s": 300.0}, {"k_s": 240.0})
    assert abs(worst.at) == pytest.approx(60.0, rel=1e-2)


def test_free_link_may_drift_but_not_run_away(plain):
    free = so.plants.rotary()
    assert find_worst_ripple(compensate(plain, 0.5), free, VALUES, [{}]).radius <= 1.0 + NEUTRAL
    weightless = compensate(plain, 0.5, gravity=CompensateGravity(fraction=0.9), link=(KNEE, VALUES))
    assert find_worst_ripple(weightless, KNEE, VALUES, [{}]).radius < 1.0


def test_a_plant_without_the_reading_is_refused(plain):
    controller = compensate(plain, 0.5)
    ripple = replace(controller.compensation.ripple, reads="theta_x")
    other = replace(controller, compensation=replace(controller.compensation, ripple=ripple))
    with pytest.raises(so.SeaoptError, match="no output theta_x"):
        find_worst_ripple(other, HELD, VALUES, [{}])


@pytest.mark.slow
@pytest.mark.parametrize(("slope", "met"), [(0.5, True), (60.0, False)])
def test_certificate_requires_it(plain, slope, met):
    certificate = so.certify(
        compensate(plain, slope), {"knee": HELD}, VALUES, ranges={"k_s": (270.0, 330.0)}, samples=5, simulations=False
    )
    (row,) = [row for row in certificate.requirements if row.name == "ripple_compensation"]
    assert row.met == met
