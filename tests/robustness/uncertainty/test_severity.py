"""Slopes of the worst figure against central differences of loops closed one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.parameters import ParameterSet
from seaopt.robustness.uncertainty.draws import combine_uncertainty
from seaopt.robustness.uncertainty.severity import UNSTABLE, severity_slopes
from seaopt.robustness.uncertainty.worst import measure_worst

STEP = 1e-4
RANGES = {"L_a": (0.065, 0.08), "phi": (0.1, 0.6), "delay_s": (2e-4, 8e-4), "eta": (0.85, 1.1)}


@pytest.fixture(scope="module")
def controller(robust_controller):
    return robust_controller


def by_differences(controller, plant, unknown, point):
    def measure(x):
        at = {name: float(column[0]) for name, column in unknown.values(x[None]).items()}
        worst = measure_worst(controller, plant, unknown.nominal, at)
        return worst.severity if worst.severity < UNSTABLE else worst.witness.spectral_radius

    steps = STEP * np.eye(point.size)
    return np.array([(measure(point + step) - measure(point - step)) / (2 * STEP) for step in steps])


@pytest.mark.slow
@pytest.mark.parametrize("limits", [{}, {"max_complementary": 0.2}, {"max_sensitivity": None}])
def test_slopes_are_central_differences(controller, swing, thor, limits):
    law = replace(controller, spec=replace(controller.spec, **limits))
    params = thor.prior(J=1e-7, b_r=1e-5)
    unknown = combine_uncertainty(params, ParameterSet(), RANGES, {"swing": swing})
    points = unknown.draw(4, np.random.default_rng(3))
    slopes = severity_slopes(law, swing, unknown, points)
    for point, slope in zip(points, slopes, strict=True):
        expected = by_differences(law, swing, unknown, point)
        np.testing.assert_allclose(slope, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_slopes_of_an_unstable_loop_are_its_poles(controller, swing, thor):
    """Twelve samples of delay too many: the fastest pole's radius."""
    late = replace(controller, compute_delay_samples=controller.compute_delay_samples + 12)
    unknown = combine_uncertainty(thor.prior(J=1e-7, b_r=1e-5), ParameterSet(), RANGES, {"swing": swing})
    points = unknown.draw(3, np.random.default_rng(4))
    draws = [{name: float(column[k]) for name, column in unknown.values(points).items()} for k in range(3)]
    assert all(measure_worst(late, swing, unknown.nominal, at).severity > UNSTABLE for at in draws)
    slopes = severity_slopes(late, swing, unknown, points)
    for point, slope in zip(points, slopes, strict=True):
        expected = by_differences(late, swing, unknown, point)
        np.testing.assert_allclose(slope, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_the_screws_mode_has_a_slope(thor):
    plant = so.plants.high_impedance(parts=["screw_mode"])
    controller = so.tune(plant, thor, so.ControllerSpec(bandwidth_hz=20))
    unknown = combine_uncertainty(thor, ParameterSet(), {"screw_mode_hz": (70.0, 80.0)}, {"stand": plant})
    point = np.array([[0.123]])
    expected = by_differences(controller, plant, unknown, point[0])
    np.testing.assert_allclose(severity_slopes(controller, plant, unknown, point)[0], expected, rtol=1e-4)
