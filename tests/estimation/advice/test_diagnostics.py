"""Diagnostics against closed forms, and against logs whose fault is known."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import seaopt as so
from seaopt.bench import PAPER_STAND, PAPER_SWING
from seaopt.errors import EstimationError
from seaopt.estimation import diagnose
from seaopt.estimation.problem.correlation import autocorrelation, cross_correlation
from seaopt.files import to_json

pytestmark = pytest.mark.usefixtures("without_hypotheses")  # which `diagnose` does not read
FREE = ("J", "b_r", "eta")
NOISE = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0})


def fitted(plant, log, params, **options):
    bench = so.Experiment(plant=plant, log=log, name="stand", outputs=("F1", "F2"))
    return so.fit([bench], params.free(*FREE), **options)


def preferred_delay(fit):
    (cause,) = (one for one in diagnose(fit).findings if one.kind == "cause")
    return cause.preferred["stand.delay_s"][0]


def shifted(log, samples):
    """Return the log with its outputs late by so many samples (early if negative)."""
    n, k = len(log), abs(samples)
    u, y = (slice(k, n), slice(0, n - k)) if samples > 0 else (slice(0, n - k), slice(k, n))
    return so.Log.from_arrays(time=log.time[: n - k], I=log["I"][u], F1=log["F1"][y], F2=log["F2"][y])


@pytest.fixture(scope="module")
def log(stand, thor):
    return so.virtual_log(stand, thor, PAPER_STAND, duration_s=20, rate_hz=400, seed=3, sensors=NOISE)


def ar1(a, n, rng):
    return lfilter([1.0], [1.0, -a], rng.normal(size=n + 300))[300:]


@pytest.mark.parametrize(("a", "b"), [(0.0, 0.0), (0.9, 0.0), (0.9, 0.8), (0.8, -0.6)])
def test_the_bound_is_that_of_two_independent_ar1_series(a, b):
    """Sum R_e(k) R_u(k) over R_e(0) R_u(0) is (1 + ab)/(1 - ab): Ljung (16.60), Bartlett's formula."""
    rng, n = np.random.default_rng(5), 20_000
    found = cross_correlation([ar1(a, n, rng)], [ar1(b, n, rng)])
    assert found.bound * np.sqrt(n) / 2.5758293 == pytest.approx(np.sqrt((1 + a * b) / (1 - a * b)), rel=0.05)


@pytest.mark.slow
def test_chance_is_outside_the_bound_as_often_as_it_says():
    """1 % of the lags; 1 % or less of the series by Bonferroni's p. A standard error is 0.14 and 0.5 %."""
    rng, outside, small = np.random.default_rng(7), 0.0, 0
    for _ in range(400):
        found = cross_correlation([ar1(0.7, 1000, rng)], [ar1(0.7, 1000, rng)])
        outside += np.mean(np.abs(found.values) > found.bound) / 400
        small += found.p < 0.01
    assert 0.005 < outside < 0.018
    assert small <= 12


def test_correlations_are_numpys():
    rng = np.random.default_rng(1)
    e, u = rng.normal(size=300), rng.normal(size=300)
    centred, moved = e - e.mean(), u - u.mean()
    found = cross_correlation([e], [u], lags=4)
    whole = np.correlate(centred, moved, "full")[295:304] / (300 * e.std() * u.std())
    np.testing.assert_allclose(found.values, whole, rtol=1e-10)
    full = np.correlate(centred, centred, "full")[299:310]
    np.testing.assert_allclose(autocorrelation(e, 10), full / full[0], rtol=1e-10)


def test_nothing_is_wrong_with_the_right_model(stand, thor, log):
    fit = fitted(stand, log, thor, holdout=0.2)
    found = diagnose(fit)
    assert found.met, found.sentences
    assert (found.aic, found.bic) == (fit.aic, fit.bic)
    for name, item in found.outputs["stand"].items():
        assert item.free_run.used == pytest.approx(fit.outputs["stand"][name].fit_percent)
        assert item.free_run.held_out == pytest.approx(fit.outputs["stand"][name].holdout_fit_percent)
        assert item.one_step.used == pytest.approx(item.free_run.used, abs=0.05)  # no process noise: nothing to gain


@pytest.mark.parametrize("samples", [1, 3])
def test_a_delay_is_found_with_its_size(stand, thor, log, samples):
    fit = fitted(stand, shifted(log, samples), thor)
    assert preferred_delay(fit) == pytest.approx(2.5e-3 * samples, rel=0.01)
    assert diagnose(fit).outputs["stand"]["F1"].inputs["I"].worst_lag > 0


def test_a_delay_is_tried_in_the_band_of_the_fit(stand, thor, log):
    """A drift outside the band is no part of the power that a delay leaves."""
    slow = 60.0 * np.sin(2 * np.pi * 0.2 * log.time)
    late = shifted(log.__class__.from_arrays(**log.to_arrays() | {"F1": log["F1"] + slow}), 2)
    assert preferred_delay(fitted(stand, late, thor, band_hz=(5.0, 50.0))) == pytest.approx(5e-3, rel=0.02)


def test_an_input_that_is_stamped_late_is_no_delay(stand, thor, log):
    assert preferred_delay(fitted(stand, shifted(log, -1), thor)) == pytest.approx(-2.5e-3, rel=0.02)


def test_a_fit_without_diagnostics_is_judged(stand, thor, log):
    fit = fitted(stand, shifted(log, 1), thor, diagnostics=False)
    assert not fit.findings
    assert preferred_delay(fit) == pytest.approx(2.5e-3, rel=0.01)


def test_a_missing_mode_is_found_with_its_frequency(thor):
    """The screw mode of the defaults lies at 80 Hz (paper, Sec. IV-A); the bare model lacks it."""
    true = so.plants.high_impedance(parts=("screw_mode",))
    log = so.virtual_log(true, thor, PAPER_STAND, duration_s=20, rate_hz=400, seed=3, sensors=NOISE)
    found = diagnose(fitted(so.plants.high_impedance(), log, thor))
    (said,) = [s for s in found.sentences if s.startswith("stand.F2") and "a missing pole" in s]
    assert 70 < float(said.split("below ")[1].split(" Hz")[0]) < 90
    assert found.held["k"].chi2 > 100  # k or m_l take up little of it, whatever their chi-square: the pole is told, too


def test_what_an_input_would_explain_is_not_called_noise(log, stand, thor):
    """A hundred times the inertia hides the mode from the simulation; a filter predicts the log all the same."""
    bench = so.Experiment(plant=stand, log=log, name="stand", outputs=("F1",))
    fit = so.fit([bench], thor.update(J=3e-4).free("b_r"), method=so.OutputError(search=False))
    assert "stand.F1" in [one.where for one in fit.findings if one.kind == "explained"]
    said = diagnose(fit).sentences
    assert not any("PredictionError" in sentence for sentence in said)
    assert any("the inputs account for" in sentence for sentence in said)


def test_a_delay_is_tried_where_the_input_is_joined_by_lines(stand, thor, log):
    """Lines through a current that was held are half a sample ahead of it."""
    late = shifted(log, 3)
    bench = so.Experiment(plant=stand, log=late, name="stand", outputs=("F1",), hold="first")
    fit = so.fit([bench], thor.free("J", "b_r"))
    assert preferred_delay(fit) == pytest.approx(2.5e-3 * 3.5, rel=0.01)


def test_a_disturbance_is_told_from_what_follows_the_input(stand, thor, log):
    """Slow noise on the force, independent of the current: coloured, predictable, and followed by nothing."""
    slow = 60.0 * np.sqrt(1 - 0.99**2) * ar1(0.99, len(log), np.random.default_rng(2))
    moved = so.Log.from_arrays(time=log.time, I=log["I"], F1=log["F1"] + slow, F2=log["F2"] + slow)
    found = diagnose(fitted(stand, moved, thor))
    assert found.outputs["stand"]["F1"].inputs["I"].p > 0.01
    assert any("coloured" in sentence or "PredictionError" in sentence for sentence in found.sentences)
    item = found.outputs["stand"]["F1"]
    assert item.one_step.used > item.free_run.used + 3


@pytest.mark.parametrize("method", [so.OutputError(), pytest.param(so.PredictionError(), marks=pytest.mark.slow)])
def test_held_out_samples_are_predicted_one_step_ahead_too(stand, thor, log, method):
    slow = 60.0 * np.sqrt(1 - 0.99**2) * ar1(0.99, len(log), np.random.default_rng(2))
    moved = so.Log.from_arrays(time=log.time, I=log["I"], F1=log["F1"] + slow, F2=log["F2"] + slow)
    item = diagnose(fitted(stand, moved, thor, holdout=0.3, method=method)).outputs["stand"]["F1"]
    assert 100 - item.one_step.held_out < 0.7 * (100 - item.free_run.held_out)


def test_one_step_is_that_of_the_fit_where_it_predicts(stand, thor, log):
    fit = fitted(stand, log, thor, method=so.PredictionError())
    item = diagnose(fit).outputs["stand"]["F1"]
    assert item.one_step.used == pytest.approx(fit.outputs["stand"]["F1"].one_step_fit_percent)


def test_shares_are_those_of_independent_averages():
    """y = a u + e, u^2 = 1: sigma 1 and 2, 20 and 60 samples, a prior of 0.5 have the information 20, 15 and 4."""
    plant = so.Plant(
        name="gain", states={"z": "-"}, inputs={"u": "-"}, outputs={"y": "-"}, parameters={"a": "-"},
        f=lambda t, x, u, p: {"z": u.u - x.z}, h=lambda t, x, u, p: {"y": p.a * u.u + 0 * x.z},
    )  # fmt: skip
    rng, benches = np.random.default_rng(0), []
    for name, n, sigma in (("one", 20, 1.0), ("two", 60, 2.0)):
        u = rng.choice([-1.0, 1.0], size=n)
        log = so.Log.from_arrays(time=np.arange(float(n)), u=u, y=3 * u + sigma * rng.normal(size=n))
        benches.append(
            so.Experiment(plant=plant, log=log, name=name, sigma={"y": sigma}, initial_state="rest", offset=False)
        )
    prior = so.Parameter(name="a", value=3.0, unit="-", free=True, prior_std=0.5)
    found = diagnose(so.fit(benches, so.ParameterSet([prior]))).leverage
    whole = 20 + 15 + 4
    for name, part in (("one", 20), ("two", 15), ("priors", 4)):
        assert found[name].parameters["a"] == pytest.approx(part / whole, rel=1e-6)
        assert found[name].whole == pytest.approx(part / whole, rel=1e-6)


def test_shares_add_up_to_one(stand, swing, thor, log):
    other = so.virtual_log(swing, thor, PAPER_SWING, duration_s=10, rate_hz=400, seed=5, sensors=NOISE)
    benches = [
        so.Experiment(plant=stand, log=log, name="stand", outputs=("F1", "F2")),
        so.Experiment(plant=swing, log=other, name="swing", outputs=("F1", "F2")),
    ]
    found = diagnose(so.fit(benches, thor.free("J", "b_r", "I_p"), method=so.OutputError(search=False))).leverage
    for name in ("J", "b_r", "I_p"):
        assert sum(item.parameters[name] for item in found.values()) == pytest.approx(1.0)
    assert all(0.0 <= share <= 1.0 for item in found.values() for share in item.parameters.values())


def test_a_bound_and_a_changed_plant_are_told(stand, thor, log):
    held = thor.update(eta=0.5).bound(eta=(0.0, 0.9)).free(*FREE)
    bench = so.Experiment(plant=stand, log=log, name="stand", outputs=("F1", "F2"))
    found = diagnose(so.fit([bench], held))
    assert found.at_bound == ("eta",)
    assert "eta" in [one.where for one in found.findings if one.kind == "bound"]
    later = log["F1"].copy()
    later[-len(later) // 5 :] *= 1.2
    changed = so.Log.from_arrays(time=log.time, I=log["I"], F1=later, F2=log["F2"])
    findings = diagnose(fitted(stand, changed, thor, holdout=0.25)).findings
    assert [(one.kind, one.where) for one in findings] == [("held_out", "stand.F1")]


def test_it_can_be_written_and_read_by_people(stand, thor, log):
    fit = fitted(stand, log, thor)
    found = diagnose(fit)
    assert json.loads(to_json(found.to_dict()))["outputs"]["stand"]["F1"]["inputs"]["I"]["outside"] in (True, False)
    assert repr(found).startswith("Diagnostics\n  No problem found")
    assert found._repr_html_().startswith("<h3>Diagnostics</h3>")
    with pytest.raises(EstimationError, match="diagnose needs the fit itself"):
        diagnose(replace(fit, minimum=None))
