"""The fit's logs judge a law: a stand of equations of the test's own, with a mode at 40 Hz that the model may lack."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

import seaopt as so
from seaopt.control import MPCSpec, force_mpc, runnable, tune_schedule
from seaopt.errors import LogError
from seaopt.files import to_json
from seaopt.frequency.residual import find_feedback, measure_residual
from seaopt.problem.stages import certify_problem
from seaopt.robustness.certificate.limits import describe_log
from seaopt.robustness.certificate.requirement import LOG_AGREEMENT, LOG_SENSITIVITY
from seaopt.robustness.certificate.simulated import STEPS
from seaopt.robustness.uncertainty.agreement import judge_agreement, widen_by_model
from seaopt.robustness.uncertainty.logs import CONTRADICT, GRACE, SilentLog, judge_log
from tests.checks import leave_out

RATE, SECONDS, MODE_HZ, ZETA, NOISE = 1000.0, 20.0, 40.0, 0.02, 2.0
SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6)


@pytest.fixture(scope="module", autouse=True)
def without_steps():
    """Let certificates have no simulated steps: what is looked at here is linear."""
    with pytest.MonkeyPatch.context() as patch:
        leave_out(patch, STEPS)
        yield


def sampled_stand(params, size):
    """Return numerator and denominator in z of F1/I = k e/(M s^2 + b s + k) (1 + size w s/(s^2 + 2 zeta w s + w^2))."""
    p = {name: item.value for name, item in params.items()}
    per, w = p["l"] / (2 * np.pi * p["N_p"]), 2 * np.pi * MODE_HZ
    mass, damping, effort = p["J"] / per**2, p["b_r"] / per**2, p["eta"] * p["K_tau"] / per
    mode = np.array([1.0, 2 * ZETA * w, w**2])
    num, den = p["k"] * effort * np.polyadd(mode, [size * w, 0.0]), np.convolve([mass, damping, p["k"]], mode)
    b, a, _ = scipy.signal.cont2discrete((num, den), 1.0 / RATE)
    return np.ravel(b), a


def record(params, size=0.0, seed=1, amplitude=2.0, gain=1.0, late=0):
    rng, time = np.random.default_rng(seed), np.arange(round(SECONDS * RATE)) / RATE
    growth = np.log(1000.0)
    phase = 2 * np.pi * 0.1 * SECONDS / growth * np.expm1(growth * time / SECONDS)
    current = amplitude * np.sin(phase) + rng.normal(scale=0.25 * amplitude, size=time.size)
    felt = gain * np.concatenate([np.zeros(late), current[: current.size - late]])
    force = scipy.signal.lfilter(*sampled_stand(params, size), felt) + rng.normal(scale=NOISE, size=time.size)
    return so.Log.from_arrays(time=time, I=current, F1=force)


def simulate(plant, params):
    log = record(params)
    force = so.simulate(plant, params, log)["F2"]
    return so.Log.from_arrays(time=log.time, I=log["I"], F2=force + np.random.default_rng(5).normal(size=len(log)))


@pytest.fixture(scope="module")
def fit_to(stand, thor):
    def fit(*sizes, validate=(), **options):
        experiments = [so.Experiment(plant=stand, log=record(thor, size, k), name=f"chirp{k}") for k, size in sizes]
        others = [so.Experiment(plant=stand, log=record(thor, size, k), name=f"other{k}") for k, size in validate]
        start = thor.update(J=3e-6).free("J", "b_r")
        return so.fit(experiments, start, validation=others, diagnostics=False, **options)

    return fit


@pytest.fixture(scope="module")
def right(fit_to):
    return fit_to((1, 0.0), validate=[(2, 0.0)], holdout=0.25)


@pytest.fixture(scope="module")
def controller(stand, right):
    return so.tune(stand, right.parameters, SPEC)


def certify(controller, stand, fit):
    return so.certify(controller, {"stand": stand}, fit, samples=20, simulations=False)


def rows_of(certificate, name=LOG_SENSITIVITY):
    return [row for row in certificate.requirements if row.name == name]


def sensitivity(controller, params, size, f):
    z, (b, a) = np.exp(2j * np.pi * f / RATE), sampled_stand(params, size)
    plant = np.polyval(b, z) / np.polyval(a, z) * controller.command.per_effort * z**-controller.compute_delay_samples
    return 1.0 / np.abs(1.0 + plant * controller.law.measurement_response(f))


def test_mode_that_the_model_lacks_fails_by_the_name_of_the_log(stand, thor, fit_to, controller):
    certificate = certify(controller, stand, fit_to((1, 0.05)))
    (row,) = rows_of(certificate)
    (verdict,) = certificate.logs
    assert not row.met and not certificate.met
    assert (row.scope, row.risk) == ("measured", None)  # of samples that were fitted no risk is stated
    assert row.plant == "log:chirp1" and row.limit == pytest.approx(1.6 * (1 + GRACE))
    assert verdict.outcome == "refuted" and 38.0 < verdict.ms_hz < 46.0
    assert "log:chirp1: fitted, refuted at" in row.where and f"measured Ms {verdict.ms:.3g}, pred" in row.where
    f = np.linspace(38.0, 46.0, 2000)
    peak = np.max(sensitivity(controller, thor, 0.05, f))
    assert verdict.ms_least < peak
    assert verdict.ms == pytest.approx(sensitivity(controller, thor, 0.05, np.array([verdict.ms_hz]))[0], rel=0.1)
    assert verdict.ms_predicted == pytest.approx(
        sensitivity(controller, thor, 0.0, np.array([verdict.ms_hz]))[0], rel=0.05
    )


def test_mode_that_makes_the_loop_unstable_is_refuted(stand, fit_to, controller):
    (row,) = rows_of(certify(controller, stand, fit_to((1, 0.2))))
    assert not row.met


def test_predictive_control_fails_by_the_name_of_a_log_too(stand, fit_to):
    fit = fit_to((1, 0.0), validate=[(2, 0.0), (3, 0.3)])
    spec = MPCSpec(current_limit_A=9.0, current_slew_A_per_s=2000.0, bandwidth_hz=20.0)
    mpc = force_mpc(stand, fit.parameters, spec)
    certificate = so.certify(mpc, {"stand": stand}, fit, samples=4, runs=1, simulations=False)
    assert [row.risk for row in rows_of(certificate)] == [None, pytest.approx(0.05), pytest.approx(0.01)]
    assert [(row.plant, row.met) for row in rows_of(certificate)] == [
        ("log:chirp1", True),
        ("log:other2", True),
        ("log:other3", False),
    ]


def test_right_model_passes_and_fitted_samples_confirm_nothing(stand, controller, right):
    with_room = replace(controller, spec=replace(SPEC, max_sensitivity=1.9))
    certificate = certify(with_room, stand, right)
    fitted, held_out, other = certificate.logs
    assert all(row.met for row in rows_of(certificate)) and len(rows_of(certificate)) == 3
    assert (fitted.experiment, fitted.samples, fitted.outcome) == ("chirp1", "fitted", "undecided")
    assert fitted.confidence is None
    first, held, last = (row.where for row in rows_of(certificate))
    assert "tells from" in first and first.endswith("; not independent")
    assert held.endswith("; at 95 %") and last.endswith("; at 95 %") and "validate, confirmed at" in last
    assert fitted.band_hz[0] < 2.0 and fitted.band_hz[1] > 100.0
    assert (held_out.experiment, held_out.samples) == ("chirp1", "held out")
    assert (other.experiment, other.samples, other.outcome) == ("other2", "validate", "confirmed")
    assert other.confidence == 0.95


def test_log_that_is_too_narrow_confirms_nothing_and_says_what_it_would_have_to_tell(stand, thor, controller, right):
    wide = record(thor, 0.0, 2)
    sos = scipy.signal.butter(8, 25.0, fs=RATE, output="sos")
    current = scipy.signal.sosfilt(sos, wide["I"])
    force = scipy.signal.lfilter(*sampled_stand(thor, 0.0), current)
    force += np.random.default_rng(4).normal(scale=NOISE, size=force.size)
    narrow = so.Log.from_arrays(time=wide.time, I=current, F1=force)
    for log, outcome in ((wide, "confirmed"), (narrow, "undecided")):
        ((verdict,), _) = judge_log(controller, right, so.Experiment(plant=stand, log=log, name="other"), 1.9)
        assert verdict.outcome == outcome and verdict.asked_hz is not None
        low, high = verdict.asked_hz
        assert low < controller.achieved.crossover_hz < controller.achieved.ms_hz < high
        assert (verdict.band_hz[1] < high) == (outcome == "undecided")
    assert f"; not confirmed at 95 %, which asks for all from {low:.3g} to" in describe_log(verdict)


def test_log_for_validation_refutes_at_its_confidence(stand, controller, fit_to):
    _, other = certify(controller, stand, fit_to((1, 0.0), validate=[(2, 0.05)])).logs
    assert (other.experiment, other.outcome, other.confidence) == ("other2", "refuted", 0.99)


def test_verdicts_come_back_from_the_file(stand, controller, right):
    certificate = certify(controller, stand, right)
    again = so.Certificate.from_dict(json.loads(to_json(certificate.to_dict())), controller, {"stand": stand}, right)
    assert again.logs == certificate.logs and rows_of(again) == rows_of(certificate)


def test_friction_is_judged_at_the_amplitude_of_its_log(stand, thor):
    rubbing = so.plants.let_stick(stand)
    params = thor.update(f_c=60.0)
    log = record(thor)
    force = so.simulate(rubbing, params, log)["F1"] + np.random.default_rng(5).normal(scale=NOISE, size=len(log))
    log = so.Log.from_arrays(time=log.time, I=log["I"], F1=force)
    start = params.update(f_c=50.0).free("J", "b_r", "f_c")
    fit = so.fit([so.Experiment(plant=rubbing, log=log, name="chirp")], start, diagnostics=False)
    tuned = so.tune(rubbing, fit.parameters, SPEC)
    (verdict,) = certify(tuned, rubbing, fit).logs
    assert verdict.at_amplitude and verdict.amplitude == pytest.approx(np.std(log["I"]))
    assert verdict.outcome == "undecided"


def test_values_without_logs_and_logs_of_other_plants_judge_nothing(stand, swing, controller, right, thor):
    assert not certify(controller, stand, thor).logs
    of_swing = so.tune(swing, thor, SPEC)
    certificate = so.certify(of_swing, {"swing": swing}, right, samples=20, simulations=False)
    assert not certificate.logs
    assert "no log of the fit is of a plant that is certified, so that none judges the law" in certificate.notes


def test_log_without_what_the_law_reads_is_a_note(stand, thor, controller):
    experiment = so.Experiment(plant=stand, log=simulate(stand, thor), outputs=("F2",), name="other")
    certificate = certify(controller, stand, so.fit([experiment], thor.free("b_r"), diagnostics=False))
    assert not certificate.logs
    assert "log other does not judge the law: it has no F1" in certificate.notes


def test_log_that_says_nothing_is_a_note(stand, thor, controller):
    weak = so.Experiment(plant=stand, log=record(thor, amplitude=1e-3), name="weak")
    fit = so.fit([weak], thor.free("b_r"), diagnostics=False)
    certificate = certify(controller, stand, fit)
    assert not certificate.logs and not rows_of(certificate)
    assert any("log weak says nothing of this loop" in note for note in certificate.notes)


def test_logs_that_cannot_be_read_again_are_a_note(monkeypatch, stand, right, controller):
    problem = so.read_problem(so.demo_path())

    def fail(_):
        raise LogError("chirp.csv: is not there; give another")

    monkeypatch.setattr(type(problem), "experiments", fail)
    monkeypatch.setattr("seaopt.problem.stages.certify", lambda *_, **__: certify(controller, stand, right))
    stored = replace(right, experiments=(), validation=())
    assert any("cannot be read: chirp.csv" in note for note in certify_problem(problem, controller, stored).notes)


def test_schedule_is_judged_where_its_variable_stood(stand, thor, fit_to):
    fit = fit_to((1, 0.0))
    m_l = thor["m_l"].value
    schedule = tune_schedule(stand, fit.parameters, SPEC, "m_l", [m_l, 2.0 * m_l])
    certificate = so.certify(schedule, {"stand": stand}, fit, samples=8, simulations=False)
    assert [bool(place.logs) for place in certificate.places] == [True] + [False] * (len(certificate.places) - 1)
    assert [row.place for row in rows_of(certificate)] == [("m_l", m_l)]


def run_under(controller, params, seed, reference, noise=NOISE, dither=0.0):
    """Return the log of a law on the stand, sample by sample, at a chirp of its reference."""
    law, (b, a), rng = runnable(controller), sampled_stand(params, 0.0), np.random.default_rng(seed)
    n, growth = round(10.0 * RATE), np.log(1000.0)
    r = reference * np.sin(2 * np.pi / growth * np.expm1(growth * np.arange(n) / n))
    state, waiting, order = law.reset(), [0.0] * int(controller.compute_delay_samples), len(a) - 1
    u, force, measured = np.zeros(n + order), np.zeros(n + order), np.zeros(n)
    for k in range(order, n + order):
        past = slice(k - order, k)
        force[k] = np.dot(b[:0:-1], u[past]) - np.dot(a[:0:-1], force[past])
        measured[k - order] = force[k] + rng.normal(scale=noise)
        command, state = law.step(state, float(r[k - order]), float(measured[k - order]))
        waiting.append(command + rng.normal(scale=dither))
        u[k] = waiting.pop(0)
    return so.Log.from_arrays(time=np.arange(n) / RATE, I=u[order:], F1=measured)


UNDER_LAW = ((), SilentLog(experiment="again", why="taken under feedback"))
LOOKS_SO = ((), SilentLog(experiment="again", why="looks like feedback"))


@pytest.mark.parametrize(("reference", "noise", "dither"), [(200.0, 2.0, 0.0), (200.0, 0.02, 0.0), (50.0, 2.0, 0.5)])
def test_log_under_the_law_neither_refutes_nor_confirms(stand, thor, controller, right, reference, noise, dither):
    log = run_under(controller, thor, 3, reference, noise, dither)
    assert judge_log(controller, right, so.Experiment(plant=stand, log=log, name="again"), 1.6) == LOOKS_SO


def test_stated_feedback_and_fits_of_prediction_errors_are_notes(stand, thor, controller, right):
    again = so.Experiment(plant=stand, log=record(thor, 0.0, 2), name="again")
    assert judge_log(controller, right, again, 1.6)[0]
    for stated in (replace(again, feedback=True), replace(again, log=replace(again.log, law="0123456789abcdef"))):
        assert judge_log(controller, right, stated, 1.6) == UNDER_LAW
    assert judge_log(controller, replace(right, method="prediction_error"), again, 1.6) == UNDER_LAW


@pytest.mark.parametrize("size", [0.0, 0.05, 0.2])
def test_mode_that_the_model_lacks_is_no_feedback(thor, size):
    n = round(SECONDS * RATE)
    for seed in range(2):
        rng = np.random.default_rng(seed)
        phase = rng.uniform(0.0, 6.0, (59, 1))
        sines = np.sum(np.cos(np.pi * np.outer(np.arange(1, 60), np.arange(n) / RATE) + phase), axis=0)
        for u in (record(thor, seed=seed)["I"], np.repeat(rng.choice([-1.0, 1.0], n // 50), 50), sines):
            right, true = (scipy.signal.lfilter(*sampled_stand(thor, each), u) for each in (0.0, size))
            error = true - right + rng.normal(scale=NOISE, size=n)
            assert not find_feedback(u, error[None], [slice(0, 9000), slice(9001, n)])


def test_samples_are_held_out_by_time(stand, thor, controller):
    log = record(thor)
    gap = so.Log.from_arrays(time=log.time + 100.0 * (log.time >= 18.0), I=log["I"], F1=log["F1"])
    experiment = so.Experiment(plant=stand, log=gap, name="gap")
    fit = so.fit([experiment], thor.update(J=3e-6).free("J", "b_r"), holdout=0.25, diagnostics=False)
    used = sum(np.count_nonzero(part.keep[0]) for part in experiment.segments(0.25))
    assert experiment.count_fitted(0.25) == used == 18000
    verdicts, _ = judge_log(controller, fit, experiment, 1.9)
    held_out = [verdict.amplitude for verdict in verdicts if verdict.samples == "held out"]
    assert held_out in ([], [pytest.approx(np.std(log["I"][18000:]))])


def test_fitted_log_that_is_given_again_confirms_nothing(stand, thor, controller, right):
    for log in (right.experiments[0].log, record(thor, 0.0, 1), record(thor, 0.0, 1).between(1.0, 16.0)):
        ((verdict,), _) = judge_log(controller, right, so.Experiment(plant=stand, log=log, name="same"), 1.9)
        assert (verdict.samples, verdict.outcome) == ("fitted", "undecided")


def test_discs_of_what_a_model_leaves_hold_the_truth_as_often_as_stated():
    rng, n, period, outside, lines = np.random.default_rng(3), 8000, 1e-3, 0, 0
    b, a = scipy.signal.butter(2, 0.1)
    for _ in range(20):
        u = rng.normal(size=n)
        error = 0.1 * scipy.signal.lfilter(b, a, u) + rng.normal(scale=0.5, size=n)
        for found in measure_residual(
            u, np.zeros((1, n)), error[None], period, [slice(0, 3000), slice(3001, n)], longest_s=0.25, highest_hz=200.0
        ):
            _, truth = scipy.signal.freqz(b, a, found.frequency_hz, fs=1.0 / period)
            _, centre, std, _ = found.read(np.ones((1, found.frequency_hz.size), dtype=complex))
            outside += np.sum(np.abs(centre - 0.1 * truth) > std * found.widen(0.05))
            lines += truth.size
    assert outside / lines == pytest.approx(0.05, abs=0.015)


def test_of_logs_with_lagged_noise_hardly_one_has_a_line_outside_its_disc():
    """At 1 % of a log over all lines of all windows: of 80 logs 4 or more with a probability below 1 %."""
    n, period, outside = 5000, 2e-3, 0
    time = period * np.arange(n)
    chirp = np.sin(2 * np.pi * 0.1 * time[-1] / np.log(300.0) * np.expm1(np.log(300.0) * time / time[-1]))
    for seed in range(80):
        noise = np.random.default_rng(seed).normal(size=n + 500)
        error = scipy.signal.lfilter([1.0], [1.0, -0.95], noise)[500:]
        found = measure_residual(
            chirp, np.zeros((1, n)), error[None], period, [slice(0, n)], longest_s=5.0, highest_hz=125.0
        )
        alpha = 0.01 / sum(each.frequency_hz.size for each in found)
        read = [(each, *each.read(np.ones((1, each.frequency_hz.size), dtype=complex))) for each in found]
        outside += any(np.any(np.abs(e) > std * each.widen(alpha)) for each, _, e, std, _ in read)
    assert outside <= 3


@pytest.fixture(scope="module")
def judge_slow(stand, thor):
    """Certify a law of 4 Hz, whose Ms hardly feels by what another actuator is off, on a fit with its intervals."""
    start = thor.update(J=3e-6).free("J", "b_r", "eta")

    def judge(fitted=(), validate=(), max_sensitivity=1.9):
        spec = so.ControllerSpec(
            bandwidth_hz=4, bandwidth_range_hz=(1, 60), max_sensitivity=max_sensitivity, max_noise_gain=1.0
        )
        logs = {"chirp": {}} | {f"fitted{k}": each for k, each in enumerate(fitted)}
        others = {f"other{k}": each for k, each in enumerate(validate)}
        experiments, validation = (
            [so.Experiment(plant=stand, log=record(thor, **each), name=name) for name, each in part.items()]
            for part in (logs, others)
        )
        fit = so.fit(experiments, start, validation=validation)
        return certify(so.tune(stand, fit.parameters, spec), stand, fit)

    return judge


@pytest.mark.parametrize("off", [{"gain": 0.5}, {"late": 3}])
def test_log_of_another_actuator_whose_loop_keeps_its_limit_fails_by_name(judge_slow, off):
    certificate = judge_slow(validate=[{"seed": 2} | off])
    (_, kept), (right, row) = rows_of(certificate), rows_of(certificate, LOG_AGREEMENT)
    assert kept.met and right.met and not row.met and not certificate.met
    assert (row.plant, row.scope, row.risk, right.risk) == ("log:other0", "measured", 0.01, None)
    found = certificate.logs[1].agreement
    assert found.contradicts and (found.misfit, found.allowed) == (row.value, row.limit)
    expected = 0.5 if "gain" in off else abs(np.expm1(-2j * np.pi * found.off_hz * 3e-3))
    assert 0.3 * expected < found.off < 1.1 * expected
    assert "log:other0: validate, contradicts the model: its response is off by" in row.where


def test_fitted_log_of_another_actuator_fails_by_name_too(judge_slow):
    rows = rows_of(judge_slow(fitted=[{"seed": 2, "gain": 0.5}]), LOG_AGREEMENT)
    assert {row.plant for row in rows if not row.met} == {"log:chirp"}  # the fit is of the other one
    assert all(row.risk is None for row in rows)


def test_log_of_another_actuator_fails_by_name_where_no_sensitivity_is_asked(judge_slow):
    certificate = judge_slow(validate=[{"seed": 2, "gain": 0.5}], max_sensitivity=False)
    rows = rows_of(certificate, LOG_AGREEMENT)
    assert [(row.plant, row.met) for row in rows] == [("log:chirp", True), ("log:other0", False)]
    assert rows_of(certificate) == [] and not certificate.met


def test_right_log_and_one_whose_gain_is_within_the_intervals_agree_and_risks_add_up(judge_slow):
    certificate = judge_slow(validate=[{"seed": 2}, {"seed": 3, "gain": 0.97}, {"seed": 4, "amplitude": 1.0}])
    rows = rows_of(certificate, LOG_AGREEMENT)
    assert len(rows) == 4 and all(row.met for row in rows)
    assert "log:other0: validate, agrees with the model" in rows[1].where
    each_log = [row.risk for row in rows_of(certificate) if row.risk is not None]
    draws = 1.0 - certificate.monte_carlo.confidence
    assert certificate.risk == pytest.approx(sum(each_log) + 3 * 0.01 + draws, rel=1e-9)
    assert certificate.to_dict()["risk"] == certificate.risk


def contradicts(seed, off, known):
    """Return whether windows of any length of a log whose gain is off contradict a fit that knows it to `known`."""
    rng, n, (b, a) = np.random.default_rng(seed), 6000, scipy.signal.butter(2, 0.1)
    u = rng.normal(size=n)
    model = scipy.signal.lfilter(b, a, u)
    error = off * model + scipy.signal.lfilter([1.0], [1.0, -0.6], rng.normal(scale=0.1, size=n))
    found = measure_residual(u, model[None], error[None], 1e-3, [slice(0, n)], longest_s=0.5, highest_hz=100.0)
    for each in found:
        loop, left, sigma, unseen = each.read(np.ones((1, each.frequency_hz.size), dtype=complex))
        agreement = judge_agreement(
            each.frequency_hz, 3.0 * loop, 3.0 * left, 3.0 * sigma, 3.0 * unseen,
            freedom=each.freedom, alpha=CONTRADICT / len(found), move=lambda loop=loop: 3.0 * known * loop[None],
        )  # fmt: skip
        if agreement.contradicts:
            return True
    return False


@pytest.mark.parametrize("std", [0.0, 0.03, 0.3])
def test_of_right_logs_hardly_one_contradicts_what_the_fit_knows(std):
    """At 1 % of a log: of 200 logs 6 or more with a probability below 2 %."""
    off = std * np.random.default_rng(7).normal(size=200)
    assert sum(contradicts(seed, each, std) for seed, each in enumerate(off)) <= 5


@pytest.mark.parametrize("off", [-0.5, 0.2, 0.5])
def test_gain_beyond_its_interval_contradicts(off):
    assert all(contradicts(seed, off, 0.01) for seed in range(20))
    assert not any(contradicts(seed, off, 0.5) for seed in range(20))
    assert contradicts(0, off, 0.0)  # no parameter of the fit moves this log


def test_error_of_the_model_widens_up_to_what_a_met_fit_may_leave():
    assert widen_by_model(0.98, 8000) == 1.0
    assert widen_by_model(1.2, 8000) == pytest.approx(np.sqrt(1 + (1 - 1 / 1.44) * 100))
    assert widen_by_model(None, 8000) == widen_by_model(7.0, 8000) == widen_by_model(1.5, 8000)
