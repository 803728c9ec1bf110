"""The passive band as a limit of the tuner, judged by equations and by frequencies that the tuner does not know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import Controller, passivity
from seaopt.control.tuning.tuner import disturbance
from seaopt.errors import ControlError
from seaopt.plants import high_impedance

QUIET = {"bandwidth_hz": 30, "max_sensitivity": 1.6, "objective": "noise"}
BAND = (1.0, 60.0)
LIFTED = dict.fromkeys(["max_complementary", "max_reference_peak", "max_droop_db", "min_filter_samples"], False)
LIFTED["reference_weights"] = "error"

SLOW = pytest.mark.slow


def real_part(controller, thor, f):
    """Return Re Z from M q'' = F_m - b q' - F2, F1 = k (q + x2), F2 = F1 + m_l (q'' + x2''), with hold and delay."""
    radius = thor["l"].value / (2 * np.pi * thor["N_p"].value)
    mass, b = thor["J"].value / radius**2, thor["b_r"].value / radius**2
    k, sprung, ts = thor["k"].value, thor["m_l"].value, controller.sample_time_s
    s = 2j * np.pi * f
    q = np.exp(-s * ts)
    law = np.polyval(controller.measurement.num[::-1], q) / np.polyval(controller.measurement.den[::-1], q)
    law = law * q**controller.compute_delay_samples * (1 - q) / (s * ts)
    return np.real((sprung * s**2 + k) * (mass * s + b) / ((mass + sprung) * s**2 + b * s + k * (1 + law)))


@pytest.mark.parametrize(
    "spec",
    [
        QUIET,
        pytest.param(
            {"bandwidth_hz": 30, "max_sensitivity": 2.2, "compute_delay_samples": 2, **LIFTED}, marks=pytest.mark.slow
        ),
        pytest.param({"bandwidth_hz": 15, "max_sensitivity": 2.5, "max_noise_gain": 10}, marks=pytest.mark.slow),
        pytest.param(
            {"bandwidth_hz": 30, "max_sensitivity": 1.6, "objective": "noise", "structure": "pid_dob"},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_what_was_not_passive_becomes_so(stand, thor, spec):
    free, bound = (so.tune(stand, thor, so.ControllerSpec(**spec, passive_band_hz=band)) for band in (None, BAND))
    f = np.linspace(*BAND, 5000)
    assert real_part(free, thor, f).min() < 0
    assert bound.feasible
    assert real_part(bound, thor, f).min() >= 0
    assert passivity(bound, stand, thor).holds(BAND)
    assert bound.achieved.bandwidth_hz == pytest.approx(spec["bandwidth_hz"], rel=0.005)


def test_the_undelayed_integral_keeps_the_rule(stand, thor):
    """k_i <= b_m (1 + k_p)/M, which the law that is only to reject disturbances breaks by a factor above two."""
    spec = {"bandwidth_hz": 15, "max_sensitivity": 2.0, "compute_delay_samples": 0}
    free, bound = (so.tune(stand, thor, so.ControllerSpec(**spec, passive_band_hz=band)) for band in (None, BAND))
    rule = thor["b_r"].value / thor["J"].value
    rates = [law.gains["k_i"] / (1 + law.gains["k_p"]) for law in (free, bound)]
    assert rates[0] > 2 * rule
    assert 0.9 * rule < rates[1] <= rule
    assert "passive_band_hz" in bound.active_constraints


def test_a_limit_that_is_kept_anyway_changes_nothing(stand, thor):
    spec = {"bandwidth_hz": 30, "max_sensitivity": 1.6, "max_noise_gain": 25, "max_reference_peak": 1.3}
    free, bound = (so.tune(stand, thor, so.ControllerSpec(**spec, passive_band_hz=band)) for band in (None, BAND))
    rejected = [disturbance(law.close(stand, thor), 30.0) for law in (free, bound)]
    assert rejected[1] == pytest.approx(rejected[0], rel=0.005)


@SLOW
def test_a_band_that_the_delay_rules_out_is_said(stand, thor):
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=60, passive_band_hz=(1, 159))
    controller = so.tune(stand, thor, spec)
    assert not controller.feasible
    assert "passive_band_hz" in controller.active_constraints
    assert "passive_band_hz = [1, 159], Re Z/|Z| -0." in controller.explanation
    assert "\n" not in controller.explanation


def test_a_band_is_tuned_for_where_its_condition_is_not_affine(thor):
    """Behind an elastic screw, whose heavy nut is at the port."""
    screw, spec = high_impedance(parts=("screw_mode",)), so.ControllerSpec(bandwidth_hz=20, passive_band_hz=BAND)
    controller = so.tune(screw, thor, spec)
    assert controller.feasible
    assert passivity(controller, screw, thor).holds(BAND)


@pytest.mark.parametrize("band", [(60.0, 1.0), (0.0, 60.0), (1.0, 500.0), (1.0, float("nan"))])
def test_what_is_no_band_is_refused(band):
    with pytest.raises(ControlError, match=r"passive_band_hz = .* is not a band"):
        so.ControllerSpec(passive_band_hz=band)


def test_the_band_is_in_controller_json(stand, thor):
    controller = so.tune(stand, thor, so.ControllerSpec(**QUIET, passive_band_hz=BAND))
    again = Controller.from_dict(controller.to_dict(), stand, thor)
    assert again.spec == controller.spec
    assert again.spec.passive_band_hz == BAND


def test_a_delay_of_the_motor_turns_the_port_as_the_controllers_does(stand, thor):
    """A whole sample of delay_s is one more of delay_samples."""
    controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6))
    late = thor.with_parameters(so.Parameter(name="delay_s", value=controller.sample_time_s, unit="s"))
    other = passivity(replace(controller, compute_delay_samples=2), stand, thor)
    found = passivity(controller, stand, late)
    np.testing.assert_allclose(np.ravel(found.bands_hz), np.ravel(other.bands_hz), rtol=1e-6)
