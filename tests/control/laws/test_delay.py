"""The delay that a fit finds reaches the controller: against a loop of python-control with the true delay."""

from __future__ import annotations

import control
import numpy as np
import pytest
from scipy.signal import cont2discrete

import seaopt as so
from seaopt.control import MPCSpec, force_mpc
from seaopt.control.laws.delay import warn_short_delay

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


def _true_ms(controller, plant, params, samples):
    """Return the peak of abs(S) on a dense grid, of a loop that is late by so many samples."""
    period, system = controller.sample_time_s, plant.linearize(params)
    f1 = control.ss(system.A, system.B, system.C[:1], system.D[:1])
    z = np.exp(2j * np.pi * np.geomspace(0.01, 499.9, 8_000) * period)
    c_y = np.polyval(controller.measurement.num[::-1], 1 / z) / np.polyval(controller.measurement.den[::-1], 1 / z)
    p = control.sample_system(f1, period, "zoh")(z) * controller.command.per_effort
    return np.max(1.0 / np.abs(1.0 + p * z**-samples * c_y))


def test_a_fitted_delay_is_counted_in_whole_samples_rounded_up(fit, stand):
    assert fit.delay_s(stand) == pytest.approx(DELAY_S, abs=2e-5)
    controller = so.tune(stand, fit, SPEC)
    assert controller.delay_samples == 3
    assert controller.feasible
    assert _true_ms(controller, stand, fit.parameters, 3) == pytest.approx(controller.achieved.ms, rel=1e-3)
    assert _true_ms(controller, stand, fit.parameters, 2) < 1.6


def test_a_delay_that_is_given_stands_and_is_warned_of(fit, stand):
    spec = so.ControllerSpec(bandwidth_hz=50, max_sensitivity=1.6, max_noise_gain=60, delay_samples=1)
    controller = so.tune(stand, fit, spec)
    assert controller.delay_samples == 1
    assert _true_ms(controller, stand, fit.parameters, 2) > 1.7 > controller.achieved.ms
    certificate = so.certify(controller, {"stand": stand}, fit, samples=10, simulations=False)
    assert "delay_samples = 3" in certificate.notes[0]
    assert not warn_short_delay(3, 1000.0, stand, fit)


def test_predictive_control_has_the_fits_delay(fit, stand, thor):
    """Left out it is the fit's, and the margin is that of a loop with it; a shorter one is warned of."""
    mpc = force_mpc(stand, fit, MPCSpec(current_limit_A=9.0, bandwidth_hz=15))
    assert (mpc.delay_samples, mpc.warnings) == (3, ())
    response = np.exp(2j * np.pi * np.geomspace(0.01, 499.9, 8_000) * 1e-3)
    system, law = stand.linearize(fit.parameters), mpc.unlimited()
    p = control.sample_system(control.ss(system.A, system.B, system.C[:1], system.D[:1]), 1e-3, "zoh")(response)
    c_y = control.ss(law.a, -law.b[:, 1:], law.c[None], -law.d[1], 1e-3)(response)
    true_ms = np.max(1.0 / np.abs(1.0 + p * response**-3 * c_y))
    assert mpc.achieved.ms == pytest.approx(true_ms, rel=1e-3)
    short = force_mpc(stand, fit, MPCSpec(current_limit_A=9.0, bandwidth_hz=15, delay_samples=1))
    assert short.delay_samples == 1 and "delay_samples = 3" in short.warnings[0] and short.warnings[0] in repr(short)
    assert force_mpc(stand, thor, MPCSpec(current_limit_A=9.0, bandwidth_hz=15)).delay_samples == 1


def test_without_a_fit_it_is_one_sample(stand, thor):
    assert so.tune(stand, thor, SPEC).delay_samples == 1


def test_the_fit_read_again_has_the_delay(fit, stand, swing):
    again = so.estimation.Fit.from_dict(fit.to_dict())
    assert again.delay_s(stand) == fit.delay_s(stand)
    assert again.delay_s(swing) == fit.delay_s(stand)  # no experiment of its own: that of the same electronics
