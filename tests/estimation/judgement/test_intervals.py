"""When intervals are believed: a residual of noise, logs at two amplitudes, values known well, more than one step."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import seaopt as so
from seaopt.bench import PAPER_STAND
from seaopt.estimation import Fit, compare_with_log
from seaopt.estimation.judgement.intervals import find_rough, find_single_event, find_step_error
from seaopt.estimation.result.model_error import ModelError
from seaopt.estimation.result.widening import widen
from seaopt.files import to_json
from seaopt.parameters import QUANTILE
from tests.robustness.certificate.test_logs import record as record_stand

N, PERIOD = 8000, 1e-3
GAIN = so.Plant(
    name="gain", states={"z": "-"}, inputs={"u": "-"}, outputs={"y": "-"}, parameters={"a": "-"},
    f=lambda t, x, u, p: {"z": u.u - x.z}, h=lambda t, x, u, p: {"y": p.a * u.u + 0 * x.z},
)  # fmt: skip
FREE = so.ParameterSet.of(a=(1.0, "-")).free("a")


def record_log(amplitude, cubic, seed, noise=0.01, name="log"):
    """Return a log of y = 2 u + c u^3 + e, u of a standard deviation."""
    rng = np.random.default_rng(seed)
    u = lfilter([1.0], [1.0, -0.98], rng.normal(size=N + 1000))[1000:]
    u *= amplitude / np.std(u)
    y = 2.0 * u + cubic * u**3 + noise * rng.normal(size=N)
    log = so.Log.from_arrays(time=np.arange(N) * PERIOD, u=u, y=y)
    return so.Experiment(plant=GAIN, log=log, initial_state="rest", offset=False, name=name)


def fit(*experiments, **options):
    return so.fit(experiments, FREE, method=so.OutputError(search=False), **options)


def list_kinds(result, severity):
    return {finding.kind for finding in result.findings if finding.severity == severity}


def test_a_residual_far_above_its_noise_is_not_met_by_one_log_and_asks_for_half_the_amplitude():
    result = fit(record_log(1.0, 0.05, 1))
    assert result.outputs["log"]["y"].excess > 3.0
    assert not result.met and "excess" in list_kinds(result, "error")
    (finding,) = (each for each in result.errors if each.kind == "excess")
    assert "second log at half the amplitude" in finding.text


def test_two_amplitudes_give_intervals_as_wide_as_the_values_differ():
    """Of Gaussian u the best gain is 2 + 3 c var u: the difference of both is 2.25 c, and the gain at small u is in."""
    c = 0.05
    result = fit(record_log(1.0, c, 1, name="full"), record_log(0.5, c, 2, name="half"))
    assert result.met and "excess" in list_kinds(result, "warning")
    large, small = (result.logs[name].values["a"][0] for name in ("full", "half"))
    assert large - small == pytest.approx(3 * c * (1.0 - 0.25), rel=0.1)
    parameter = result.parameters["a"]
    assert parameter.model_std >= large - small
    assert "Values by each log alone" in repr(result) and f"{small:.6g}" in repr(result)
    assert parameter.ci95[0] <= 2.0 <= parameter.ci95[1]
    assert result.logs["half"].amplitude == pytest.approx(0.5 * result.logs["full"].amplitude, rel=0.1)


def test_a_second_log_of_the_same_amplitude_tells_nothing_of_it():
    result = fit(record_log(1.0, 0.05, 1, name="one"), record_log(0.95, 0.05, 2, name="two"))
    assert not result.met and "excess" in list_kinds(result, "error")


def test_a_log_for_validation_is_a_second_log():
    full, half = record_log(1.0, 0.05, 1, name="full"), record_log(0.5, 0.05, 2, name="half")
    result = fit(full, validation=[half])
    alone = fit(full)
    assert result.parameters["a"].value == alone.parameters["a"].value
    assert result.met and not alone.met
    assert result.logs["half"].values["a"][0] == pytest.approx(2.0 + 3 * 0.05 * 0.25, rel=1e-2)
    assert result.parameters["a"].ci95[0] <= 2.0
    read = Fit.from_dict(json.loads(to_json(result.to_dict())))
    assert read.logs["half"].values["a"] == pytest.approx(result.logs["half"].values["a"])
    assert read.parameters["a"].known == pytest.approx(result.parameters["a"].known)


def test_another_log_contradicts_values_that_it_would_not_give():
    full, half = (record_log(size, 0.05, seed, name="log") for size, seed in ((1.0, 1), (0.5, 2)))
    result, same = fit(full), record_log(1.0, 0.0, 5)
    comparison = compare_with_log(Fit.from_dict(json.loads(to_json(result.to_dict()))), half)
    assert comparison.met is False and comparison.distances["a"] > 3.0
    assert comparison.amplitudes[0] == pytest.approx(2.0 * comparison.log.amplitude, rel=0.1)
    assert "contradicts the fit" in repr(comparison) and "0.4" in repr(comparison)
    alike = compare_with_log(result, record_log(1.0, 0.05, 7))
    assert max(alike.distances.values()) < 3.0 and alike.met is False and "on a fit that is not met" in repr(alike)
    strange = compare_with_log(fit(record_log(1.0, 0.0, 6)), record_log(1.0, 0.05, 8))
    assert strange.met is False and "times its sensor's noise is left" in repr(strange)
    assert "next: fit both logs" in repr(comparison)
    changed = compare_with_log(fit(record_log(1.0, 0.0, 6)), record_log(1.0, 0.05, 5))
    assert changed.met is False and "at one amplitude the actuator itself differs" in " ".join(repr(changed).split())
    agrees = compare_with_log(fit(record_log(1.0, 0.0, 6)), same)
    assert agrees.met and "its own values are the fit's" in repr(agrees)


def test_logs_that_agree_leave_the_intervals_alone():
    result = fit(record_log(1.0, 0.0, 1, name="full"), record_log(0.5, 0.0, 2, name="half"))
    assert result.met and not result.findings
    parameter = result.parameters["a"]
    assert parameter.total_std <= 1.2 * parameter.std


@pytest.mark.parametrize(("share", "missing", "met"), [(0.0, 0.02, True), (0.0, 0.06, False), (0.5, 0.02, False)])
def test_a_cause_that_leaves_the_values_is_an_error_where_the_residual_is_far_above_noise(share, missing, met):
    """Of y = 2 u + b w + e with b fixed at 0, least squares are off by b (w'u)/(u'u): nothing where w is across u."""
    rng = np.random.default_rng(4)
    u, w = (lfilter([1.0], [1.0, -0.98], rng.normal(size=N + 1000))[1000:] for _ in range(2))
    u, w = u / np.std(u), w / np.std(w)
    w = w - (w @ u) / (u @ u) * u + share * u
    log = so.Log.from_arrays(time=np.arange(N) * PERIOD, u=u, w=w, y=2.0 * u + missing * w + 0.01 * rng.normal(size=N))
    plant = replace(
        GAIN, inputs={"u": "-", "w": "-"}, parameters={"a": "-", "b": "-"},
        h=lambda t, x, u, p: {"y": p.a * u.u + p.b * u.w + 0 * x.z},
    )  # fmt: skip
    bench = so.Experiment(plant=plant, log=log, initial_state="rest", offset=False, name="log")
    params = so.ParameterSet.of(a=(1.0, "-"), b=(0.0, "-")).free("a")
    result = so.fit([bench], params, method=so.OutputError(search=False))
    assert result.parameters["a"].value - 2.0 == pytest.approx(missing * share, abs=1e-3)
    assert (result.outputs["log"]["y"].excess > 3.0) is (missing > 0.05)
    (cause,) = (finding for finding in result.findings if finding.kind == "cause")
    assert cause.where == "b" and cause.severity == ("warning" if met else "error")
    assert result.met is met


@pytest.mark.usefixtures("without_hypotheses")
def test_a_value_that_is_known_only_roughly_is_named(thor):
    """Efficiency and torque constant are one scale: a prior of 30 % on the one is all that is known of either."""
    stand, sensors = so.plants.high_impedance(), so.Sensors(noise_std={"F1": 2.0, "F2": 2.0})
    log = so.virtual_log(stand, thor, PAPER_STAND, duration_s=10, rate_hz=400, seed=3, sensors=sensors)
    bench, free = so.Experiment(plant=stand, log=log, outputs=("F1", "F2")), thor.free("J", "b_r", "K_tau", "eta")
    rough, fine = (so.fit([bench], free.prior(K_tau=share * thor["K_tau"].value)) for share in (0.3, 0.03))
    assert {(finding.kind, finding.where) for finding in rough.errors} == {("rough", "K_tau"), ("rough", "eta")}
    assert rough.parameters["eta"].known == pytest.approx(1.96 * 0.3, rel=0.1) and not rough.met
    assert rough.parameters["J"].known < 0.2
    assert fine.met and fine.parameters["eta"].known == pytest.approx(1.96 * 0.03, rel=0.1)


@pytest.mark.parametrize(("output", "moved", "warned"), [(0.009, 0.09, 0), (0.021, 0.09, 1), (0.009, 0.2, 1)])
def test_a_step_error_above_a_hundredth_of_the_noise_is_said(output, moved, warned):
    exact = fit(record_log(1.0, 0.0, 1))
    findings = list(find_step_error(replace(exact, step_error_sigma=output, step_error_parameter=moved)))
    assert [(each.severity, each.kind) for each in findings] == [("warning", "step")] * warned


def test_one_step_has_no_power_to_refute():
    stand, thor = so.plants.high_impedance(), so.plants.thor()
    time = np.arange(1600) / 400
    rng = np.random.default_rng(0)

    def step_at(*times, size=0.5):
        current = sum(np.where(time >= at, size, 0.0) for at in times)
        run = so.simulate(stand, thor, so.Log.from_arrays(time=time, I=current))
        noisy = {name: run[name] + rng.normal(scale=2.0, size=time.size) for name in ("F1", "F2")}
        log = so.Log.from_arrays(time=time, I=current, **noisy)
        return so.Experiment(plant=stand, log=log, outputs=("F1", "F2"), initial_state="rest")

    params = thor.update(J=2e-6).free("J", "b_r")
    first = so.fit([step_at(1.0)], params)
    assert "event" in list_kinds(first, "error")
    assert so.fit([step_at(0.5, 1.5, 2.5, 3.0)], params).met
    assert "event" in list_kinds(so.fit([step_at(1.0), step_at(2.0)], params), "error")
    assert "event" in list_kinds(so.fit([step_at(0.0)], params), "error")  # a log that begins with it
    assert so.fit([step_at(1.0), step_at(1.0, size=0.25)], params).met
    assert so.fit([step_at(1.0)], params, validation=[step_at(1.0, size=0.25)]).met
    silent = [step_at(1.0, size=1e-6)]  # a log for validation in which nothing is seen
    assert "event" in list_kinds(so.fit([step_at(1.0)], params, validation=silent), "error")


@pytest.mark.parametrize("rise", [1, 50])
@pytest.mark.parametrize("noise", [0.01, 0.05])
def test_one_step_stays_one_in_a_reading_with_noise(rise, noise):
    """A current that takes 0.1 s to rise, and whose reading has 5 % noise: no sample stands out."""
    time, stand = np.arange(5000) / 500, so.plants.high_impedance()
    reading = noise * np.random.default_rng(1).normal(size=time.size)

    def log(current):
        log = so.Log.from_arrays(time=time, I=current + reading, F1=np.zeros(time.size))
        return so.Experiment(plant=stand, log=log, outputs=("F1",))

    step = np.interp(time, [2.0, 2.0 + rise / 500], [0.0, 1.0])
    assert [finding.kind for finding in find_single_event([log(step)])] == ["event"]
    assert not list(find_single_event([log(step - 0.3 * (time > 7.0))]))  # a second one
    assert not list(find_single_event([log(0.0 * step + reading)]))  # noise that is the input


@pytest.mark.parametrize(("small", "follows"), [("dither", True), ("chirp", True), ("reading", False)])
def test_what_the_outputs_follow_is_no_noise_of_a_reading(small, follows):
    """A first-order lag of the test's own, driven by a step with a small part, or read with it."""
    time, rng = np.arange(5000) / 500, np.random.default_rng(3)
    white = 0.03 * rng.normal(size=time.size)
    chirp = 0.1 * np.sin(2.0 * np.pi * (0.2 + 0.05 * time) * time)
    part = chirp if small == "chirp" else white
    step = (time > 1.0).astype(float)
    commanded = step + part * (time > 1.0) if follows else step
    lag = np.exp(-1.0 / 500 / 0.05)
    y = lfilter([0.0, 2.0 * (1.0 - lag)], [1.0, -lag], commanded) + 0.01 * rng.normal(size=time.size)
    plant = so.Plant(
        name="lag", states={"z": "-"}, inputs={"u": "-"}, outputs={"y": "-"}, parameters={"a": "-", "T": "s"},
        f=lambda t, x, u, p: {"z": (p.a * u.u - x.z) / p.T}, h=lambda t, x, u, p: {"y": x.z},
    )  # fmt: skip
    log = so.Log.from_arrays(time=time, u=commanded if follows else step + white, y=y)
    bench = so.Experiment(plant=plant, log=log, initial_state="rest", offset=False)
    start = so.ParameterSet.of(a=(1.8, "-"), T=(0.06, "s")).free("a", "T")
    result = so.fit([bench], start, method=so.OutputError(search=False))
    assert ("event" in list_kinds(result, "error")) is not follows
    assert [each.kind for each in find_single_event([bench])] == ["event"]


def test_steps_of_one_size_are_no_evidence_however_many_logs_have_one():
    """A motor whose dry friction the model lacks: without a residual its inertia comes out 43 % too large."""
    motor = so.Plant(
        name="motor", states={"w": "rad/s"}, inputs={"tau": "N m"}, outputs={"w": "rad/s"},
        parameters={"J": "kg m^2", "b": "N m s"},
        f=lambda t, x, u, p: {"w": (u.tau - p.b * x.w) / p.J}, h=lambda t, x, u, p: {"w": x.w},
    )  # fmt: skip
    time, inertia, damping, dry = np.arange(1500) / 500, 1.2e-4, 1e-4, 6e-3

    def step_to(torque, seed):
        speed = (torque - dry) / damping * (1.0 - np.exp(-damping / inertia * np.maximum(time - 0.5, 0.0)))
        speed += np.random.default_rng(seed).normal(scale=0.3, size=time.size)
        log = so.Log.from_arrays(time=time, tau=np.where(time >= 0.5, torque, 0.0), w=speed)
        return so.Experiment(plant=motor, log=log, initial_state="rest", offset=False, name=f"step{seed}")

    params = so.ParameterSet.of(J=(2e-4, "kg m^2"), b=(2e-4, "N m s")).free("J", "b")
    alike = so.fit([step_to(0.02, seed) for seed in range(3)], params)
    assert alike.parameters["J"].value == pytest.approx(1.43 * inertia, rel=0.01)
    assert {finding.kind for finding in alike.errors} == {"event"}
    assert not so.fit([step_to(0.02, 1), step_to(0.01, 2)], params).met


def test_friction_that_is_not_there_does_not_have_to_be_known(thor):
    """A Coulomb friction that the plant need not have, truly 0: its interval is 100 % of it, and does nothing."""
    plant, log_of = so.plants.rotary(link="locked"), so.virtual_log
    values = plant.defaults.update(J_m=3e-5, b_r=2e-4, K_tau=0.06, N=60.0, k_s=250.0, eta=1.0, f_c=0.0, c_s=0.0)
    log = log_of(
        plant, values, PAPER_STAND, duration_s=10, rate_hz=400, seed=3, sensors=so.Sensors(noise_std={"tau_s": 0.05})
    )
    bench = so.Experiment(plant=plant, log=log, outputs=("tau_s",))
    result = so.fit([bench], values.update(J_m=2e-5, c_s=0.01).free("J_m", "b_r", "c_s"))
    assert result.parameters["c_s"].known > 0.2 or result.parameters["c_s"].at_bound
    assert "rough" not in list_kinds(result, "error")


@pytest.mark.parametrize(("half", "severity"), [(0.15, None), (0.25, "rough")])
def test_a_component_of_cogging_is_known_over_the_size_of_both(half, severity):
    """Nearly all of it is in the sine: where the encoder has its zero."""
    t, sizes = np.arange(1500) / 500.0, {"a_g": 2e-3, "b_g": 2e-5, "n_g": 7.0}
    plant = so.plants.add_part(so.plants.rotary(link="locked"), "cogging")
    truth = plant.defaults.update(f_c=0.004, v_s=1.0, **sizes)
    current = 2.0 * np.sin(2 * np.pi * (0.5 * t + t**2))
    run = so.simulate(plant, truth, so.Log.from_arrays(time=t, I=current))
    noise = np.random.default_rng(2).normal(scale=1e-2, size=t.size)
    log = so.Log.from_arrays(time=t, I=current, tau_s=run["tau_s"] + noise)
    experiment = so.Experiment(plant=plant, log=log, outputs=("tau_s",))
    fit = so.fit([experiment], truth.free("J_m", "a_g", "b_g"), diagnostics=False)
    names = fit.covariance.names
    value = fit.parameters["b_g"]
    std = half * np.hypot(fit.parameters["a_g"].value, value.value) / QUANTILE
    assert std > 3.0 * value.std and value.known > 0.2
    matters = ModelError(names=names, excess={}, effect=np.full(len(names), 1e6))
    wide = np.diag(np.square([std * (name == "b_g") for name in names]))
    found = list(find_rough(widen(fit, wide), matters))
    assert [(each.kind, each.where) for each in found] == ([(severity, "b_g")] if severity else [])


@pytest.mark.parametrize("late", [0, 2])
def test_a_fit_without_the_search_is_not_met_where_something_asks_for_it(thor, late):
    """A log 2 ms late moves J by 8 %, outside its interval, with a residual of 1.3 times the noise."""
    log = record_stand(thor, amplitude=0.4, late=late)
    experiment = so.Experiment(plant=so.plants.high_impedance(), log=log, name="chirp", initial_state="rest")
    fit = so.fit([experiment], thor.update(J=3e-6).free("J", "b_r"), causes=False)
    assert [each.severity for each in fit.findings if each.kind == "unsearched"] == ["error" if late else "note"]
    assert fit.met == (late == 0)


def test_a_short_log_beside_a_step_is_judged():
    """Of 60 rows some of the 64 blocks that look for events are empty."""
    rng = np.random.default_rng(3)

    def step(rows, name):
        u = np.where(np.arange(rows) > 0.4 * rows, 1.0, 0.0) + 1e-3 * rng.normal(size=rows)
        log = so.Log.from_arrays(time=np.arange(rows) * PERIOD, u=u, y=2.0 * u + 0.01 * rng.normal(size=rows))
        return so.Experiment(plant=GAIN, log=log, initial_state="rest", offset=False, name=name)

    assert "event" in list_kinds(fit(step(1500, "long"), step(60, "short")), "error")
