"""The delay that a fit finds reaches the controller: against a loop held in steps of 40 us with the true delay."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.signal import cont2discrete

import seaopt as so
from seaopt.control import MPCSpec, force_mpc
from seaopt.control.laws.delay import settle_delays, warn_delays
from seaopt.errors import ControlError

DELAY_S = 2.04e-3
SUBSTEPS, STEPS_LATE = 25, 51  # of 1 ms: 2.04 ms are 51 steps of 40 us
SPEC = so.ControllerSpec(bandwidth_hz=25, max_sensitivity=1.6, max_noise_gain=25)


@pytest.fixture(scope="module")
def fit(stand, thor):
    """A fit of a log made outside the package: steps of a microsecond's grid, the command late by a known time."""
    rng = np.random.default_rng(5)
    current = np.repeat(rng.normal(size=500), 8) + 0.3 * rng.normal(size=4000)
    current[:10] = 0.0  # nothing is known of the command before the log
    fine = np.concatenate([np.zeros(STEPS_LATE), np.repeat(current, SUBSTEPS)])[: current.size * SUBSTEPS]
    plant = stand.linearize(thor)
    a, b, c, d, _ = cont2discrete((plant.A, plant.B, plant.C, plant.D), 1e-3 / SUBSTEPS)
    x, force = np.zeros(a.shape[0]), np.zeros(current.size)
    row = plant.output_labels.index("F1")
    for k, u in enumerate(fine):
        if k % SUBSTEPS == 0:
            force[k // SUBSTEPS] = c[row] @ x + d[row, 0] * u
        x = a @ x + b[:, 0] * u
    log = so.Log.from_arrays(time=1e-3 * np.arange(current.size), I=current, F1=force + rng.normal(size=current.size))
    delay = so.Parameter(name="delay_s", value=1e-3, unit="s", free=True, max=0.01)
    experiment = so.Experiment(plant=stand, log=log, sigma={"F1": 1.0}, initial_state="rest", delay_s=delay)
    return so.fit([experiment], thor.update(b_r=1.3e-4).free("b_r"), diagnostics=False)


def _true_ms(controller, plant, params, seconds):
    """Return the peak of abs(S) on a dense grid, of a loop that is late by so many seconds: held in steps of 40 us."""
    period, system = controller.sample_time_s, plant.linearize(params)
    fine = period / SUBSTEPS
    a, b, c, d, _ = cont2discrete((system.A, system.B, system.C[:1], system.D[:1]), fine)
    z = np.exp(2j * np.pi * np.geomspace(0.01, 499.9, 8_000) * period)
    c_y = np.polyval(controller.measurement.num[::-1], 1 / z) / np.polyval(controller.measurement.den[::-1], 1 / z)
    late = round(seconds / fine)
    whole, part = divmod(late, SUBSTEPS)
    power = np.linalg.matrix_power
    older = sum((power(a, SUBSTEPS - 1 - k) @ b for k in range(part)), np.zeros_like(b))
    newer = sum((power(a, SUBSTEPS - 1 - k) @ b for k in range(part, SUBSTEPS)), np.zeros_like(b))
    x = np.linalg.solve(z[:, None, None] * np.eye(len(a)) - power(a, SUBSTEPS), (newer + older / z[:, None, None]))
    p = (c @ x)[:, 0, 0] * controller.command.per_effort
    assert d[0, 0] == 0.0
    return np.max(1.0 / np.abs(1.0 + p * z**-whole * c_y))


def test_a_fitted_delay_is_the_drives_and_the_program_that_logged_waits_for_nothing(fit, stand):
    assert fit.delay_s(stand) == pytest.approx(DELAY_S, abs=2e-5)
    controller = so.tune(stand, fit, SPEC)
    assert (controller.compute_delay_samples, controller.drive_delay_s) == (0, fit.delay_s(stand))
    assert controller.delay_samples == pytest.approx(2.04, abs=0.02)
    assert controller.feasible
    assert _true_ms(controller, stand, fit.parameters, DELAY_S) == pytest.approx(controller.achieved.ms, rel=2e-3)
    assert _true_ms(controller, stand, fit.parameters, DELAY_S + 1e-3) > 1.02 * controller.achieved.ms
    assert "compute delay 0 samples + drive delay 2.0" in repr(controller)


def test_a_command_that_is_measured_says_nothing_of_the_program(fit, stand):
    """Of inputs that run straight between samples, as measured currents do, the drive's delay is known alone."""
    own = {name: replace(one, hold="first") for name, one in fit.nuisance.items()}
    controller = so.tune(stand, replace(fit, nuisance=own), SPEC)
    assert (controller.compute_delay_samples, controller.drive_delay_s) == (1, fit.delay_s(stand))


def test_an_output_with_the_present_command_in_it_waits_for_a_sample(fit):
    """F2 of the lumped drive contains the motor's force."""
    lumped = so.plants.high_impedance(drive="lumped")
    assert settle_delays(so.ControllerSpec(measured="F2"), lumped, fit)[0].compute_delay_samples == 1
    assert settle_delays(so.ControllerSpec(measured="F1"), lumped, fit)[0].compute_delay_samples == 0


def test_less_delay_than_the_fits_is_warned_of(fit, stand):
    spec = so.ControllerSpec(
        bandwidth_hz=50, max_sensitivity=1.6, max_noise_gain=60, compute_delay_samples=0, drive_delay_s=1e-3
    )
    controller = so.tune(stand, fit, spec)
    assert controller.delay_samples == 1
    assert _true_ms(controller, stand, fit.parameters, DELAY_S) > 1.65 > controller.achieved.ms
    certificate = so.certify(controller, {"stand": stand}, fit, samples=10, simulations=False)
    assert "drive_delay_s = 0.001, but the experiments have a delay of 2.0" in certificate.notes[0]
    assert not warn_delays(SPEC, stand, fit)


def test_the_older_key_is_the_whole_loop(fit, stand):
    older = so.ControllerSpec(bandwidth_hz=25, max_sensitivity=1.6, max_noise_gain=25, delay_samples=3)
    newer = replace(older, delay_samples=None, compute_delay_samples=3, drive_delay_s=0.0)
    one, other = so.tune(stand, fit, older), so.tune(stand, fit, newer)
    assert (one.compute_delay_samples, one.drive_delay_s) == (3, 0.0)
    assert one.achieved == other.achieved
    (warning,) = warn_delays(older, stand, fit)
    assert "delay_samples = 3 is an older key" in warning
    assert "experiments have a delay" in warn_delays(replace(older, delay_samples=2), stand, fit)[1]


@pytest.mark.parametrize("other", [{"compute_delay_samples": 0}, {"drive_delay_s": 0.0}])
@pytest.mark.parametrize("make", [so.ControllerSpec, partial(MPCSpec, current_limit_A=9.0)])
def test_the_older_key_is_refused_beside_a_new_one(make, other):
    (name,) = other
    with pytest.raises(ControlError, match=rf"delay_samples = 2 and {name} = 0 are both given.*keep compute_delay"):
        make(delay_samples=2, **other)


@pytest.mark.parametrize("value", [-1e-3, 2.0, np.nan, True])
def test_a_drives_delay_is_in_seconds(value):
    with pytest.raises(ControlError, match=r"drive_delay_s = .* is in seconds"):
        so.ControllerSpec(drive_delay_s=value)


def test_predictive_control_has_the_fits_delay(fit, stand, thor):
    """Left out it is the fit's, and a sample for planning; a shorter one is warned of."""
    mpc = force_mpc(stand, fit, MPCSpec(current_limit_A=9.0, bandwidth_hz=15))
    assert mpc.warnings == () and mpc.delay_samples == 4
    given = MPCSpec(current_limit_A=9.0, bandwidth_hz=15, compute_delay_samples=1, drive_delay_s=0.0)
    short = force_mpc(stand, fit, given)
    assert short.delay_samples == 1 and "drive_delay_s = 0, but" in short.warnings[0]
    assert short.warnings[0] in repr(short)
    assert force_mpc(stand, thor, MPCSpec(current_limit_A=9.0, bandwidth_hz=15)).delay_samples == 1


def test_without_a_fit_it_is_one_sample(stand, thor):
    assert so.tune(stand, thor, SPEC).delay_samples == 1


def test_the_fit_read_again_has_the_delay(fit, stand, swing):
    again = so.estimation.Fit.from_dict(fit.to_dict())
    assert again.delay_s(stand) == fit.delay_s(stand)
    assert again.delay_s(swing) == fit.delay_s(stand)  # no experiment of its own: that of the same electronics
