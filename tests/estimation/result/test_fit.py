"""Fits against known truth, closed forms and NIST's certified values."""

from __future__ import annotations

import json
import time
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import cont2discrete, lfilter

import seaopt as so
from seaopt.bench import PAPER_STAND, PAPER_SWING, Noise
from seaopt.errors import EstimationError, FileError
from seaopt.estimation import Squares, profile
from seaopt.estimation.problem.residual_statistics import compute_statistics
from seaopt.estimation.result.covariance import compute_meat
from seaopt.estimation.result.findings import state_guesses
from seaopt.files import to_json

FREE = ("J", "b_r", "eta")


def experiment(plant, log, **options):
    return so.Experiment(plant=plant, log=log, **{"outputs": ("F1", "F2"), "name": "chirp", **options})


@pytest.mark.parametrize(
    "factors", [(0.3, 3, 0.3), (3, 0.3, 3), (3, 3, 1), (0.3, 0.3, 0.5), (10, 0.1, 1), (0.1, 10, 1)]
)
def test_the_stand_log_gives_the_published_values(stand, stand_log, thor, factors):
    """164 s, 2 N noise: J, b_r, eta within 0.5 % and 4 std; residual rms is the noise within 2 %."""
    start = {name: thor[name].value * factor for name, factor in zip(FREE, factors, strict=True)}
    fit = so.fit([experiment(stand, stand_log)], thor.update(**start).free(*FREE))
    assert fit.status == "converged"
    so.testing.assert_recovered(fit, thor, sigmas=4, within=0.005)
    for output in fit.outputs["chirp"].values():
        assert output.rms_residual == pytest.approx(2.0, rel=0.02)
    assert fit.nuisance["chirp"].offset["F1"] == pytest.approx(3.0, abs=0.1)
    assert fit.samples == 131_200


def test_a_joint_fit_shares_parameters(stand, swing, thor):
    """Stand and swing, the swing nonlinear with friction: six parameters, each from one log or both."""
    truth = thor.update(f_c=30.0, v_s=5e-3, d=0.1, eta=0.95)
    noise = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0})
    logs = [
        so.virtual_log(plant, truth, excitation, duration_s=30, rate_hz=400, seed=5, sensors=noise)
        for plant, excitation in ((stand, PAPER_STAND), (swing, PAPER_SWING))
    ]
    start = truth.update(J=2e-6, b_r=2e-4, eta=0.8, f_c=10.0, I_p=0.5, d=0.3)
    fit = so.fit(
        [experiment(stand, logs[0]), experiment(swing, logs[1], name="swing")],
        start.free("J", "b_r", "eta", "f_c", "I_p", "d"),
        diagnostics=False,
    )
    so.testing.assert_recovered(fit, truth, sigmas=4.5)
    assert fit.step_error_sigma <= 0.01


def test_covariance_of_a_static_line_is_the_closed_form():
    """y = a u + offset with known sigma: the covariance of least squares, (X'X)^-1 sigma^2."""
    plant = so.Plant(
        name="line", states={"z": "m"}, inputs={"u": "A"}, outputs={"y": "N"}, parameters={"a": "N/A"},
        f=lambda t, x, u, p: {"z": -x.z + u.u}, h=lambda t, x, u, p: {"y": p.a * u.u + 0 * x.z},
    )  # fmt: skip
    rng = np.random.default_rng(3)
    u = rng.normal(size=5000)
    y = 2.5 * u + 4 + 0.3 * rng.normal(size=u.size)
    log = so.Log.from_arrays(time=np.arange(u.size) / 100, u=u, y=y)
    params = so.ParameterSet.of(a=(1.0, "N/A")).free("a")
    fit = so.fit(
        [so.Experiment(plant=plant, log=log, sigma={"y": 0.3}, initial_state="rest")], params, diagnostics=False
    )
    x = np.column_stack([u, np.ones_like(u)])
    expected = np.linalg.lstsq(x, y, rcond=None)[0]
    covariance = np.linalg.inv(x.T @ x) * 0.3**2
    assert fit.parameters["a"].value == pytest.approx(expected[0], rel=1e-9)
    assert fit.nuisance["experiment"].offset["y"] == pytest.approx(expected[1], rel=1e-6)
    assert fit.parameters["a"].std == pytest.approx(np.sqrt(covariance[0, 0]), rel=0.05)


def exponential(name, f, h, states):
    return so.Plant(name=name, states=states, inputs={"u": "-"}, outputs={"y": "-"},
                    parameters={f"b{i}": "-" for i in range(1, 3)}, f=f, h=h)  # fmt: skip


# NIST StRD nonlinear regression, Misra1a (www.itl.nist.gov/div898/strd): y = b1 (1 - exp(-b2 x)); certified values.
MISRA_X = [77.6, 114.9, 141.1, 190.8, 239.9, 289.0, 332.8, 378.4, 434.8, 477.3, 536.8, 593.1, 689.1, 760.0]
MISRA_Y = [10.07, 14.73, 17.94, 23.93, 29.61, 35.18, 40.02, 44.82, 50.76, 55.05, 61.01, 66.40, 75.47, 81.78]
MISRA = {"b1": (2.3894212918e2, 2.7070075241), "b2": (5.5015643181e-4, 7.2668688436e-6)}


def test_misra1a_values_and_standard_errors_are_nists():
    """As a plant, y is the step response of a first-order lag sampled where NIST measured (0.1 apart, else missing)."""
    plant = exponential(
        "Misra1a",
        f=lambda t, x, u, p: {"z": p.b2 * (p.b1 * u.u - x.z)},
        h=lambda t, x, u, p: {"y": x.z},
        states={"z": "-"},
    )
    time = np.arange(0, 7601) / 10
    y = np.full(time.size, np.nan)
    y[np.round(np.array(MISRA_X) * 10).astype(int)] = MISRA_Y
    log = so.Log.from_arrays(time=time, u=np.ones(time.size), y=y)
    start = so.ParameterSet.of(b1=(500.0, "-"), b2=(1e-4, "-")).free("b1", "b2")
    bench = so.Experiment(plant=plant, log=log, initial_state="rest", offset=False)
    fit = so.fit([bench], start, diagnostics=False)
    residual_dof = np.sqrt(len(MISRA_X) / (len(MISRA_X) - 2))  # NIST divides by n - p
    for name, (value, error) in MISRA.items():
        assert fit.parameters[name].value == pytest.approx(value, rel=1e-6)
        assert fit.white_covariance.std(name) * residual_dof == pytest.approx(error, rel=1e-3)


@pytest.mark.slow
@pytest.mark.usefixtures("without_causes")
def test_intervals_cover_the_truth(stand, thor):
    """95 % intervals of J, b_r, eta over 60 seeds (180 intervals)."""
    inside = 0
    for seed in range(60):
        noise = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0})
        log = so.virtual_log(
            stand, thor, (Noise(std=1.0, band_hz=50),), duration_s=6, rate_hz=400, seed=seed, sensors=noise
        )
        fit = so.fit([experiment(stand, log)], thor.free(*FREE), method=so.OutputError(search=False))
        for name in FREE:
            low, high = fit.parameters[name].ci95
            inside += low <= thor[name].value <= high
    assert 0.89 <= inside / 180 <= 0.99


@pytest.mark.slow
@pytest.mark.usefixtures("without_causes")
def test_coloured_residuals_widen_the_intervals(stand, thor):
    """Noise with a correlation time of 0.1 s: the stated std matches the scatter of the estimates over seeds."""
    found, stated = [], []
    for seed in range(40):
        log = so.virtual_log(stand, thor, (Noise(std=1.0, band_hz=20),), duration_s=20, rate_hz=400, seed=seed)
        rng = np.random.default_rng(1000 + seed)
        coloured = np.zeros(len(log))
        for k in range(1, len(log)):
            coloured[k] = 0.975 * coloured[k - 1] + rng.normal()
        noisy = so.Log.from_arrays(time=log.time, I=log["I"], F1=log["F1"] + coloured)
        fit = so.fit(
            [experiment(stand, noisy, outputs=("F1",))], thor.free("J", "b_r"), method=so.OutputError(search=False)
        )
        found.append(fit.parameters["b_r"].value)
        stated.append(fit.parameters["b_r"].std)
    assert np.mean(stated) == pytest.approx(np.std(found), rel=0.35)


def scatter(stand, thor, spoil, seeds, **options):
    """Return the scatter of J and b_r over seeds, over their mean stated std."""
    found, stated = [], []
    for seed in range(seeds):
        log = so.virtual_log(stand, thor, (Noise(std=1.0, band_hz=20),), duration_s=4, rate_hz=400, seed=seed)
        f1, f2 = spoil(np.random.default_rng(1000 + seed), log["F1"], log["F2"])
        noisy = so.Log.from_arrays(time=log.time, I=log["I"], F1=f1, F2=f2)
        fit = so.fit([experiment(stand, noisy)], thor.free("J", "b_r"), method=so.OutputError(search=False), **options)
        found.append([fit.parameters[name].value for name in ("J", "b_r")])
        stated.append([fit.parameters[name].std for name in ("J", "b_r")])
    return np.std(found, axis=0) / np.mean(stated, axis=0)


@pytest.mark.slow
@pytest.mark.usefixtures("without_causes")
def test_noise_common_to_both_load_cells_widens_the_intervals(stand, thor):
    """Output by output, the stated std would be 1/sqrt(2) of the scatter."""

    def common(rng, f1, f2):
        noise = 2 * rng.normal(size=f1.size)
        return f1 + noise, f2 + noise

    np.testing.assert_allclose(scatter(stand, thor, common, 60), 1.0, atol=0.25)


@pytest.mark.slow
@pytest.mark.usefixtures("without_causes")
def test_hubers_intervals_mean_what_they_say(stand, thor):
    def outliers(rng, f1, f2):
        hit = rng.random(f1.size) < 0.05
        return f1 + 2 * rng.normal(size=f1.size) + 60 * hit * rng.normal(size=f1.size), f2 + 2 * rng.normal(
            size=f1.size
        )

    np.testing.assert_allclose(scatter(stand, thor, outliers, 60, loss=so.Huber()), 1.0, atol=0.25)


def location(e, loss, **options):
    """Return the fit of a in y = a u + e, sigma 1, a prior left out; u is -1 or 1, so that the design says nothing."""
    u = np.random.default_rng(9).choice([-1.0, 1.0], size=e.size)
    plant = so.Plant(
        name="gain", states={"z": "-"}, inputs={"u": "-"}, outputs={"y": "-"}, parameters={"a": "-"},
        f=lambda t, x, u, p: {"z": u.u - x.z}, h=lambda t, x, u, p: {"y": p.a * u.u + 0 * x.z},
    )  # fmt: skip
    log = so.Log.from_arrays(time=np.arange(float(e.size)), u=u, y=3.0 * u + e)
    bench = so.Experiment(plant=plant, log=log, sigma={"y": 1.0}, initial_state="rest", offset=False)
    return so.fit([bench], so.ParameterSet.of(a=(3.0, "-")).free("a"), loss=loss, **options), u


@pytest.mark.parametrize("diagnostics", [True, False])
def test_the_white_std_of_a_robust_loss_has_hubers_factor(diagnostics):
    """Var = E[psi^2] / (E[psi']^2 n) (Huber 1981, ch. 7): 1/0.95 of least squares' on Gaussian noise, at 1.345."""
    e = np.random.default_rng(8).normal(size=40_000)
    fit, u = location(e, so.Huber(), diagnostics=diagnostics)
    residual = 3.0 * u + e - fit.parameters["a"].value * u
    inside = np.abs(residual) <= 1.345
    factor = np.mean(np.clip(residual, -1.345, 1.345) ** 2) / np.mean(inside) ** 2
    assert fit.white_covariance.std("a") == pytest.approx(np.sqrt(factor / e.size), rel=1e-6)
    assert factor == pytest.approx(1 / 0.95, rel=0.03)


def test_the_profile_of_a_robust_loss_is_as_wide_as_its_std():
    rng = np.random.default_rng(8)
    e = rng.normal(size=4000) * np.where(rng.random(4000) < 0.1, 10.0, 1.0)
    fit, _ = location(e, so.SoftL1())
    found = profile(fit, "a", points=0, coloured=False)
    half = 1.959964 * fit.white_covariance.std("a")
    np.testing.assert_allclose(np.array(found.interval) - fit.parameters["a"].value, (-half, half), rtol=0.02)


def test_what_cannot_be_told_is_named(stand, short_log, thor):
    fit = so.fit([experiment(stand, short_log)], thor.free("J", "b_r", "eta", "K_tau"), diagnostics=False)
    assert fit.status == "not_identifiable"
    assert "K_tau and eta enter only together" in fit.message
    (direction,) = fit.identifiability.unidentifiable
    assert direction["K_tau"] == pytest.approx(-direction["eta"])
    assert np.isinf(fit.parameters["eta"].std)
    assert set(fit.parameters.unidentified_names) == {"K_tau", "eta"}
    again = so.Fit.from_dict(json.loads(to_json(fit.to_dict())))
    assert again.parameters.unidentified_names == fit.parameters.unidentified_names
    assert fit.parameters.update(eta=0.95).unidentified_names == ("K_tau",)
    assert fit.parameters["J"].value == pytest.approx(3.31e-6, rel=1e-3)


@pytest.mark.parametrize("start", [{}, {"J_m": 0.01, "b_r": 0.2, "K_tau": 0.3, "k_s": 40.0}, {"J_m": 1e-3, "k_s": 5.0}])
@pytest.mark.parametrize("J_l", [1e4, 1e6])
def test_what_a_heavy_link_hides_is_marked_whatever_the_start(J_l, start):
    """tau_s of a motor against a link that hardly moves has J_m, b_r and k_s over each other, and K_tau alone."""
    plant, free = so.plants.rotary(), ("J_m", "b_r", "K_tau", "k_s")
    truth = plant.defaults.update(J_m=0.0032, b_r=0.588, K_tau=0.867, k_s=16.5, N=1.0, J_l=J_l)
    log = so.virtual_log(plant, truth, (Noise(std=1.0, band_hz=60),), duration_s=10, rate_hz=400, seed=1)
    torque = log["tau_s"] + 0.005 * np.std(log["tau_s"]) * np.random.default_rng(1).normal(size=len(log))
    measured = so.Log.from_arrays(time=log.time, I=log["I"], tau_s=torque)
    fit = so.fit(
        [experiment(plant, measured, outputs=("tau_s",))], truth.update(**start).free(*free), diagnostics=False
    )
    assert fit.status == "not_identifiable"
    assert set(fit.parameters.unidentified_names) == {"J_m", "b_r", "k_s"}
    assert fit.parameters["K_tau"].value == pytest.approx(0.867, rel=1e-3)
    resonance = np.sqrt(16.5 / 0.0032) / (2 * np.pi)  # k_s over J_m, which the data do tell
    figure = fit.derived["resonance_hz"]
    assert 0.0 < figure.std < 0.01
    assert abs(figure.value - resonance) < 4 * figure.std


def test_a_figure_that_the_data_tell_keeps_its_std():
    """Of a spring-mass with J, b, k and the gain free, the frequency is as certain as with k known; stiffness is not.

    The scatter over 30 logs is the reference; the response is scipy's.
    """
    J, b, k, rate = 2e-3, 4e-3, 10.0, 500.0
    plant = so.Plant(
        name="spring-mass", states={"q": "rad", "w": "rad/s"}, inputs={"T": "N m"}, outputs={"q": "rad"},
        parameters={"J": "kg m^2", "b": "N m s/rad", "k": "N m/rad", "g": "-"},
        f=lambda t, x, u, p: {"q": x.w, "w": (p.g * u.T - p.b * x.w - p.k * x.q) / p.J},
        h=lambda t, x, u, p: {"q": x.q},
        derived=lambda p: {"f_n": (ca.sqrt(p.k / p.J) / (2 * ca.pi), "Hz"), "compliance": (1 / p.k, "rad/(N m)")},
    )  # fmt: skip
    truth = so.ParameterSet.of(J=(J, "kg m^2"), b=(b, "N m s/rad"), k=(k, "N m/rad"), g=(1.0, "-"))
    num, den, _ = cont2discrete(([1.0], [J, b, k]), 1.0 / rate, "zoh")
    figures = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        u = rng.normal(size=2000)
        y = lfilter(num.ravel(), den, u)
        log = so.Log.from_arrays(time=np.arange(2000) / rate, T=u, q=y + 0.02 * np.std(y) * rng.normal(size=2000))
        free = so.fit([so.Experiment(plant=plant, log=log)], truth.free("J", "b", "k", "g"), diagnostics=False)
        figures.append(free.derived["f_n"])
        if not seed:
            known = so.fit([so.Experiment(plant=plant, log=log)], truth.free("J", "b", "g"), diagnostics=False)
            assert free.parameters.unidentified_names == ("J", "b", "k", "g")
            assert np.isinf(free.derived["compliance"].std)
            assert free.derived["f_n"].std == pytest.approx(known.derived["f_n"].std, rel=1e-3)
    z = np.array([(figure.value - np.sqrt(k / J) / (2 * np.pi)) / figure.std for figure in figures])
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.35  # chi-square of 30: 0.1 % on either side


def test_a_parameter_without_effect_is_named(stand, short_log, thor):
    fit = so.fit([experiment(stand, short_log)], thor.free("J", "v_s"), diagnostics=False)
    assert fit.status == "not_identifiable"
    assert "v_s has no effect" in fit.message


def test_a_prior_settles_what_the_data_do_not(stand, short_log, thor):
    fit = so.fit([experiment(stand, short_log)], thor.free("J", "b_r", "eta").prior(K_tau=1e-4), diagnostics=False)
    assert fit.status == "converged"
    assert fit.parameters["K_tau"].std == pytest.approx(1e-4, rel=0.05)


def test_a_bound_is_kept_and_said(stand, short_log, thor):
    fit = so.fit(
        [experiment(stand, short_log)], thor.update(J=5e-6).free("J", "b_r").bound(J=(3.4e-6, 1e-5)), diagnostics=False
    )
    assert fit.parameters["J"].value == 3.4e-6
    assert fit.parameters["J"].at_bound
    assert json.loads(json.dumps(fit.to_dict()["parameters"]["J"]))["at_bound"] is True


def test_huber_shrugs_off_outliers(stand, short_log, thor):
    rng = np.random.default_rng(0)
    spoiled = short_log["F1"].copy()
    spoiled[rng.choice(spoiled.size, 200, replace=False)] += 400
    log = so.Log.from_arrays(time=short_log.time, I=short_log["I"], F1=spoiled)
    errors = {}
    for loss in (Squares(), so.Huber()):
        fit = so.fit([experiment(stand, log, outputs=("F1",))], thor.free("J", "b_r"), loss=loss, diagnostics=False)
        errors[type(loss)] = abs(fit.parameters["b_r"].value / thor["b_r"].value - 1)
    assert errors[so.Huber] < 0.002
    assert errors[so.Huber] < 0.3 * errors[Squares]


def test_band_weighting_hides_what_is_outside(stand, short_log, thor):
    """A 120 Hz disturbance of 60 N: outside the band it does not move the estimates."""
    hum = 60 * np.sin(2 * np.pi * 120 * short_log.time)
    log = so.Log.from_arrays(time=short_log.time, I=short_log["I"], F1=short_log["F1"] + hum)
    fit = so.fit([experiment(stand, log, outputs=("F1",))], thor.free("J", "b_r"), band_hz=(0.5, 60))
    so.testing.assert_recovered(fit, thor, sigmas=4, within=0.005)
    assert fit.outputs["chirp"]["F1"].band_fit_percent > 99


def test_gaps_missing_samples_and_delay(stand, thor):
    delay = 0.0031
    log = so.virtual_log(stand, thor, PAPER_STAND, duration_s=20, rate_hz=400, seed=3)
    late = so.simulate(stand, thor, log, delay_s=delay)["F1"] + 0.5 * np.random.default_rng(0).normal(size=len(log))
    late[200:230] = np.nan
    keep = np.r_[0:3000, 3500:8000]
    bench = experiment(
        stand,
        so.Log.from_arrays(time=log.time[keep], I=log["I"][keep], F1=1.02 * late[keep]),
        outputs=("F1",),
        delay_s=so.Parameter(name="d", value=0.001, unit="s", free=True, max=0.01),
        gain={"F1": so.Parameter(name="g", value=1.0, unit="-", free=True)},
    )
    fit = so.fit([bench], thor.free("J", "b_r"), diagnostics=False)
    so.testing.assert_recovered(fit, thor, sigmas=4.5)
    own = fit.nuisance["chirp"]
    assert own.delay_s == pytest.approx(delay, abs=2e-5)
    assert own.gain["F1"] == pytest.approx(1.02, abs=1e-3)
    assert len(own.initial_state) == 2


def test_holdout_is_kept_back(stand, short_log, thor):
    fit = so.fit([experiment(stand, short_log)], thor.free(*FREE), holdout=0.25)
    assert fit.samples == pytest.approx(0.75 * 2 * len(short_log), abs=4)
    assert fit.outputs["chirp"]["F1"].holdout_fit_percent > 90


def test_fit_json_round_trip(stand, short_log, thor, tmp_path):
    bench = experiment(stand, short_log)
    fit = so.fit([bench], thor.free("J", "b_r"))
    from seaopt.files import read_json, write_json

    path = write_json(tmp_path / "fit.json", fit.to_dict())
    again = so.Fit.from_dict(read_json(path, "seaopt/fit/2"), (bench,))
    assert again.parameters["J"] == fit.parameters["J"]
    np.testing.assert_allclose(again.covariance.matrix, fit.covariance.matrix)
    np.testing.assert_allclose(again.predict(bench).model["F1"], fit.predict(bench).model["F1"])
    assert repr(again) == repr(fit)
    overflown = replace(fit, step_error_sigma=np.inf, step_error_parameter=np.inf)
    write_json(path, overflown.to_dict())
    stored = so.Fit.from_dict(read_json(path, "seaopt/fit/2"))
    assert stored.step_error_sigma == stored.step_error_parameter == np.inf
    content = overflown.to_dict()
    write_json(path, content | {"covarience": content.pop("covariance")})
    with pytest.raises(FileError, match="covariance"):
        so.Fit.from_dict(read_json(path, "seaopt/fit/2"))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda s, log, p: so.fit([], p), "no experiment"),
        (lambda s, log, p: so.fit([experiment(s, log)], p.free("I_p")), "I_p is free, but no plant"),
        (lambda s, log, p: so.fit([experiment(s, log)], p.free("J"), holdout=1.5), "holdout"),
        (lambda s, log, p: so.fit([experiment(s, log)], p.free("J"), band_hz=(50, 10)), "band_hz"),
        (lambda s, log, p: experiment(s, log, outputs=("F9",)), "F9"),
        (lambda s, log, p: experiment(s, log, sigma={"F1": -1}), "sigma of F1"),
        (lambda s, log, p: experiment(s, log, initial_state={"z": 1}), '"z"'),
        (lambda s, log, p: experiment(s, log, gain={"F3": 1}), "F3"),
        (lambda s, log, p: experiment(s, log, name='"><b>'), "not a name"),
    ],
)
def test_bad_input(stand, short_log, thor, make, words):
    with pytest.raises(EstimationError, match=words):
        make(stand, short_log, thor)


def test_a_channel_in_the_wrong_unit_is_refused(stand, short_log):
    log = so.Log.from_arrays(time=short_log.time, I=short_log["I"], F1=short_log["F1"], units={"F1": "V", "I": "A"})
    with pytest.raises(EstimationError, match="channel F1 is in V"):
        so.Experiment(plant=stand, log=log)


@pytest.mark.parametrize(
    ("still", "words"),
    [
        (("F1", "F2"), "F1 and F2 constant throughout, nothing can be learnt"),
        (("I", "F1", "F2"), "F1 and F2 constant throughout"),
        (("I",), "I constant throughout, nothing drives the plant"),
    ],
)
def test_a_log_in_which_nothing_moves_is_refused(stand, short_log, thor, still, words):
    arrays = short_log.to_arrays() | {name: np.full(len(short_log), 2.0) for name in still}
    bench = experiment(stand, so.Log.from_arrays(**arrays))
    with pytest.raises(EstimationError, match=words):
        so.fit([bench], thor.free("J", "b_r"))


def test_one_constant_output_is_noted_and_the_other_fitted(stand, short_log, thor):
    log = so.Log.from_arrays(**short_log.to_arrays() | {"F2": np.full(len(short_log), 2.0)})
    fit = so.fit(
        [experiment(stand, log, sigma={"F1": 2.0, "F2": 1e6})], thor.update(J=2e-6).free("J"), diagnostics=False
    )
    assert "chirp: F2: is constant at 2" in fit.notes
    so.testing.assert_recovered(fit, thor, sigmas=4)


def test_a_dead_output_of_unknown_noise_is_refused(stand, short_log, thor):
    """Its noise would be estimated as zero, and its weight as infinite."""
    log = so.Log.from_arrays(**short_log.to_arrays() | {"F1": np.full(len(short_log), 5.0)})
    with pytest.raises(EstimationError, match="output F1 is constant throughout"):
        so.fit([so.Experiment(plant=stand, log=log, outputs=("F1", "F2"))], thor.free("J", "b_r", "eta"))


def test_a_unit_that_a_parameter_can_absorb_is_asked_about(stand, short_log, thor):
    """A current in mA that is taken for A makes an efficiency a thousand times too small."""
    log = so.Log.from_arrays(**short_log.to_arrays() | {"I": 1e3 * short_log["I"]})
    fit = so.fit([experiment(stand, log)], thor.free("J", "b_r", "eta"), diagnostics=False)
    assert any("1000 times below its start of 1: check the units" in note for note in fit.notes)


def test_a_value_that_is_not_told_from_zero_is_no_question_of_units(stand, thor):
    """There is no dry friction in the log: what is left of its start, a 2000th, is chance."""
    sensors = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0})
    log = so.virtual_log(stand, thor, PAPER_STAND, duration_s=4, rate_hz=400, seed=2, sensors=sensors)
    fit = so.fit([experiment(stand, log)], thor.update(f_c=100.0).free("f_c", "b_r"), diagnostics=False)
    friction = fit.parameters["f_c"]
    assert 0.0 < friction.value < min(1.0, 2.0 * friction.std)
    assert not any("check the units" in note for note in fit.notes)


def test_how_far_a_value_is_from_its_start_has_few_digits(stand, short_log, thor):
    fit = so.fit([experiment(stand, short_log)], thor.update(b_r=1e-134).free("b_r"), diagnostics=False)
    (note,) = (note for note in fit.notes if "times above its start of 1e-134" in note)
    assert len(note.split(" is ")[1].split(" times ")[0]) <= len("1.259e+133")


@pytest.mark.slow
@pytest.mark.parametrize("samples", [40, 100])
@pytest.mark.usefixtures("without_causes")
def test_intervals_of_few_samples_are_not_far_too_narrow(stand, thor, samples):
    """Windows of one log: what a fit takes out of few residuals may not narrow their intervals."""
    log = so.virtual_log(stand, thor, PAPER_STAND, duration_s=40, rate_hz=400, seed=3,
                         sensors=so.Sensors(noise_std={"F1": 2.0, "F2": 2.0}))  # fmt: skip
    off = []
    for start in range(0, 15000, 240):
        window = so.Log.from_arrays(**{key: x[start : start + samples] for key, x in log.to_arrays().items()})
        fit = so.fit([so.Experiment(plant=stand, log=window, outputs=("F1", "F2"))], thor.free("J", "b_r"))
        off += [abs(fit.parameters[name].value - thor[name].value) / fit.parameters[name].std for name in ("J", "b_r")]
    assert np.mean(np.array(off) < 1.96) >= 0.88
    assert any("samples are few" in note for note in fit.notes)


@given(st.integers(0, 1000))
@settings(max_examples=5)
def test_scaling_the_force_scales_eta(seed):
    """Twice the force from the same current is twice the efficiency, whatever the noise."""
    stand, thor = so.plants.high_impedance(), so.plants.thor()
    log = so.virtual_log(stand, thor, PAPER_STAND, duration_s=5, rate_hz=400, seed=seed,
                         sensors=so.Sensors(noise_std={"F1": 2.0}))  # fmt: skip
    eta = []
    for scale in (1.0, 2.0):
        scaled = so.Log.from_arrays(time=log.time, I=log["I"], F1=scale * log["F1"])
        eta.append(
            so.fit([so.Experiment(plant=stand, log=scaled)], thor.free(*FREE), diagnostics=False)
            .parameters["eta"]
            .value
        )
    assert eta[1] == pytest.approx(2 * eta[0], rel=1e-4)


def test_a_bad_fit_is_said_readably(stand, short_log, thor):
    fit = so.fit([experiment(stand, short_log)], thor.update(k=5e5).free("J", "b_r"))
    with pytest.raises(AssertionError) as raised:
        so.testing.assert_recovered(fit, thor, sigmas=3)
    text = str(raised.value)
    assert "J" in text
    assert "TOO FAR" in text
    assert "std" in text
    with pytest.raises(so.SeaoptError, match='truth has no "J"'):
        so.testing.assert_recovered(fit, {"b_r": 1.31e-4})


def test_it_is_quick(stand, stand_log, thor):
    """Not a benchmark: an upper bound far above what is measured, to catch an accidental loop in Python."""
    from seaopt.simulation.native import find_compiler

    if find_compiler() is None:
        pytest.skip("no C compiler")
    so.fit([experiment(stand, stand_log)], thor.free(*FREE))
    started = time.process_time()
    so.fit([experiment(stand, stand_log)], thor.free(*FREE))
    assert time.process_time() - started < 10


def test_guesses_are_counted_and_named():
    assert state_guesses(["N_p", "l"]) == "on 2 guesses: N_p, l"
    assert state_guesses([]) == ""


def test_the_meat_of_many_logs_is_that_of_each_direction_alone():
    """With more directions than a log has unknowns the sum goes another way."""
    plant, thor = so.plants.high_impedance(), so.plants.thor()
    sensors = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0})
    experiments = [
        so.Experiment(
            plant=plant, name=f"log{k}", outputs=("F1", "F2"),
            log=so.virtual_log(plant, thor, PAPER_STAND, duration_s=15, rate_hz=400, seed=k, sensors=sensors),
        )
        for k in range(3)
    ]  # fmt: skip
    minimum = so.fit(experiments, thor.free("J", "b_r"), diagnostics=False).require_minimum("test")
    statistics = compute_statistics(minimum.problem, minimum.z)
    directions = np.random.default_rng(0).normal(size=(minimum.z.size, 9))
    alone = [compute_meat(minimum.problem, minimum.z, column[:, None], statistics)[0, 0] for column in directions.T]
    together = compute_meat(minimum.problem, minimum.z, directions, statistics)
    np.testing.assert_allclose(np.diag(together), alone, rtol=1e-9)
