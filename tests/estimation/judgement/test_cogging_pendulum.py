"""A motor that cogs behind a pendulum: the refit follows the measured position, as the simulated one is off by waves.

The logs are of a pendulum that is integrated here.
"""

from __future__ import annotations

import math
import pickle
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import seaopt as so
from seaopt.estimation.judgement.hypotheses import measure_sizes
from seaopt.estimation.judgement.traces.ripple_search import find_followed_ripple
from seaopt.estimation.problem.fit_problem import pose_problem
from seaopt.estimation.problem.losses import Squares
from seaopt.plants.plant import follow_readings
from tests.actuator_logs import drive, integrate

RATE_HZ = 400.0
TRUTH = {"J_m": 2.4e-5, "b_r": 1.5e-4, "f_c": 0.02, "v_s": 2.0, "N": 100.0, "K_tau": 0.05, "k_s": 300.0, "c_s": 0.0}
LINK = {"J_l": 0.25, "d_l": 0.3, "m": 2.5, "L": 0.2}
COGS = {"a_g": 0.006, "b_g": 0.003, "n_g": 42.0}
ENCODER = 2.0 * math.pi / 4096.0


@cache
def swing(seconds=8.0, *, held=False):
    """Return current, motor and link of a pendulum whose motor cogs; `held`: of one whose link does not move."""
    p, weight = TRUTH, LINK["m"] * 9.81 * LINK["L"]
    _, current = drive(seconds, RATE_HZ, 1.2, seed=1, top_hz=8.0)

    def rates(x, ampere):
        angle, speed, link, turn = x
        torque = p["k_s"] * (angle / p["N"] - link)
        phase = COGS["n_g"] * angle
        rub = p["f_c"] * math.tanh(speed / p["v_s"]) + p["b_r"] * speed
        rub += COGS["a_g"] * math.sin(phase) + COGS["b_g"] * math.cos(phase)
        push = p["K_tau"] * ampere - rub - torque / p["N"]
        if held:
            return speed, push / p["J_m"], 0.0, 0.0
        return speed, push / p["J_m"], turn, (torque - LINK["d_l"] * turn - weight * math.sin(link)) / LINK["J_l"]

    angle, _, link, _ = integrate(rates, 4, current, 1.0 / RATE_HZ, 40)
    return current, angle, link


def record(*, step=ENCODER):
    """Return a log of both encoders; `step`: of the motor's."""
    current, angle, link = swing()
    noise = np.random.default_rng(2)
    return so.Log.from_arrays(
        time=np.arange(angle.size) / RATE_HZ,
        I=current,
        theta_m=step * np.round((angle + 0.3 * step * noise.normal(size=angle.size)) / step),
        theta_l=link + noise.normal(scale=2e-5, size=angle.size),
    )


def pose(log, *, parts=(), **values):
    """Return an experiment and parameters off by a third."""
    plant = so.plants.rotary(link="pendulum", parts=parts)
    params = plant.defaults.update(**TRUTH, **LINK).update(J_m=3.2e-5, k_s=240.0, f_c=0.015, **values)
    return so.Experiment(plant=plant, log=log, initial_state="rest"), params.free("J_m", "b_r", "f_c", "k_s")


def test_cogging_is_found_and_what_follows_is_right():
    experiment, params = pose(record())
    best = so.fit([experiment], params).hypotheses[0]
    assert (best.parts, best.outcome) == (("cogging",), "adopted")
    assert best.frees["n_g"] == pytest.approx(COGS["n_g"], rel=1e-4)
    size = math.hypot(best.frees["a_g"], best.frees["b_g"])
    assert size == pytest.approx(math.hypot(COGS["a_g"], COGS["b_g"]), rel=0.03)
    for name in ("J_m", "b_r", "f_c", "k_s"):
        assert best.parameters[name] == pytest.approx(TRUTH[name], rel=0.01), name


def test_what_the_encoder_shakes_is_no_excess():
    """Of 42 waves per rad its steps shake the motor by more than they are; still nothing is lacking."""
    experiment, params = pose(record(step=0.003), parts=("cogging",), **COGS)
    fit = so.fit([experiment], params)
    assert not fit.hypotheses
    assert all(figures.excess < 1.3 for figures in fit.outputs["experiment"].values())


def test_the_wave_number_is_found_at_values_that_are_far_off():
    """No simulation is asked: with an inertia and a friction of half, the force that the motion lacks has the waves."""
    experiment, params = pose(record())
    params = params.update(J_m=1.2e-5, f_c=0.01, k_s=400.0)
    problem = pose_problem((experiment,), params, loss=Squares())
    (posed,), rows = problem.experiments, slice(0, len(experiment.log))
    found = find_followed_ripple(posed, params, rows, problem.unknowns.start)
    assert found["n_g"] == pytest.approx(COGS["n_g"], rel=1e-3)
    assert math.atan2(found["b_g"], found["a_g"]) == pytest.approx(math.atan2(COGS["b_g"], COGS["a_g"]), abs=0.3)


def test_sizes_are_of_the_measured_motion():
    """What else such a model lacks is looked for from sizes: its own motion cannot even be simulated to a tolerance."""
    experiment, params = pose(record(), parts=("cogging",), **COGS)
    sizes = measure_sizes(so.fit([experiment], params, diagnostics=False))
    speed = np.quantile(np.abs(np.gradient(swing()[1], 1.0 / RATE_HZ)), 0.999)
    assert sizes.speed == pytest.approx(speed, rel=0.01)


def test_the_model_with_its_own_position_is_the_same_physics():
    """What a controller is tuned on has the state in the reading's place: fed with that, both move alike."""
    plant = so.plants.rotary(link="pendulum", parts=("cogging",))
    params = plant.defaults.update(**TRUTH, **LINK, **COGS)
    current, angle, link = swing()
    times = np.arange(600) / RATE_HZ
    own = so.simulate(plant, params, so.Log.from_arrays(time=times, I=current[:600]))
    read = so.Log.from_arrays(time=times, I=current[:600], theta_m_read=own["theta_m"])
    followed = so.simulate(follow_readings(plant), params, read, rtol=1e-6)
    assert np.max(np.abs(own["theta_m"] - followed["theta_m"])) < 2e-3 * np.ptp(own["theta_m"])
    assert np.max(np.abs(own["theta_m"] - angle[:600])) < 1e-3 * np.ptp(angle[:600])
    assert np.max(np.abs(own["theta_l"] - link[:600])) < 1e-3 * np.ptp(link[:600])


@pytest.mark.parametrize(("step", "follows"), [(ENCODER, True), (0.01, True), (0.05, False)])
def test_a_coarse_reading_is_not_followed(step, follows):
    """Of 42 waves per rad one of 0.05 rad is 2.1 rad of a wave: the model's own position is better."""
    experiment, params = pose(record(step=step), parts=("cogging",), **COGS)
    assert bool(experiment.follow(params).read_inputs) is follows
    said = experiment.describe_readings(params)
    assert bool(said) is not follows
    rounded = COGS["n_g"] * step / math.sqrt(12.0)  # the noise besides is a third of a step
    assert follows or rounded < float(re.search(r"are (.*?) rad", said[0])[1]) < 2.0 * rounded


@pytest.mark.parametrize(("missing", "splits"), [(0, False), (3, False), (400, True)])
def test_where_the_position_is_lost_the_log_is_left_out(missing, splits):
    """What follows starts from a state of its own, though the log starts at rest."""
    experiment, params = pose(_hide(record(), "theta_m", slice(1000, 1000 + missing)), parts=("cogging",), **COGS)
    n = len(experiment.log)
    assert experiment.log_segments == ((slice(0, 1000), slice(1400, n)) if splits else (slice(0, n),))
    assert any(f"{n - 400} of {n} samples are used" in note for note in experiment.notes) is splits
    fit = so.fit([experiment], params.free("a_g"))
    assert fit.parameters["a_g"].value == pytest.approx(COGS["a_g"], rel=0.03)
    assert all(figures.excess < 1.3 for figures in fit.outputs["experiment"].values())
    assert not fit.hypotheses


def test_cogging_is_found_where_the_position_is_lost_for_a_while():
    """The plain plant's fit had no segment there: the state that it passes is where that of the other begins."""
    experiment, params = pose(_hide(record(), "theta_m", slice(1000, 1400)))
    best = so.fit([experiment], params).hypotheses[0]
    assert (best.parts, best.outcome) == (("cogging",), "adopted")
    assert best.frees["n_g"] == pytest.approx(COGS["n_g"], rel=1e-4)
    for name in ("J_m", "b_r", "f_c", "k_s"):
        assert best.parameters[name] == pytest.approx(TRUTH[name], rel=1e-3), name


def test_a_position_with_few_samples_in_a_row_is_not_followed():
    experiment, params = pose(_hide(record(), "theta_m", np.arange(3200) % 6 > 0), parts=("cogging",), **COGS)
    assert experiment.log_segments == (slice(0, len(experiment.log)),)
    assert not experiment.follow(params).read_inputs
    assert "too few samples in a row" in experiment.describe_readings(params)[0]


def test_a_held_actuator_is_fitted_from_values_and_a_delay_that_are_off():
    """Its own position would do at the minimum; from here fits of it end at other waves, a response's guess as well."""
    current, angle, _ = swing(4.0, held=True)
    noise = np.random.default_rng(2).normal(size=(2, angle.size))
    log = so.Log.from_arrays(
        time=np.arange(angle.size) / RATE_HZ,
        I=current,
        tau_s=TRUTH["k_s"] / TRUTH["N"] * angle + 0.05 * noise[0],
        theta_m=ENCODER * np.round(angle / ENCODER + 0.3 * noise[1]),
    )
    plant = so.plants.rotary(link="locked", parts=("cogging",))
    params = plant.defaults.update(**TRUTH, **COGS)
    params = params.update(J_m=3.2e-5, k_s=240.0, f_c=0.015, a_g=0.004, b_g=0.004, n_g=42.1)
    delay = so.Parameter(name="delay", value=1e-3, unit="s", min=0.0, max=0.01, free=True)
    experiment = so.Experiment(plant=plant, log=log, initial_state="rest", delay_s=delay)
    fit = so.fit([experiment], params.free("J_m", "b_r", "f_c", "k_s", *COGS), diagnostics=False)
    for name, value in {**TRUTH, **COGS}.items():
        if fit.parameters[name].free:
            assert fit.parameters[name].value == pytest.approx(value, rel=0.01), name


def test_a_log_without_the_position_is_not_followed():
    experiment, params = pose(record(), parts=("cogging",), **COGS)
    assert experiment.follow(params).read_inputs == ("theta_m_read",)
    log = experiment.log
    silent = so.Log.from_arrays(time=log.time, I=log["I"], theta_l=log["theta_l"])
    assert not replace(experiment, log=silent, outputs=("theta_l",)).follow(params).read_inputs


def test_an_encoder_that_is_left_out_of_the_outputs_is_not_read():
    """One of wrong sign would turn the sign of the sine's share, and the fit would look as good."""
    whole, params = pose(record(), parts=("cogging",), **COGS)
    experiment = replace(whole, outputs=("theta_l",))
    assert whole.reads("theta_m") and not experiment.reads("theta_m")
    assert not experiment.follow(params).read_inputs
    problem = pose_problem((experiment,), params, loss=Squares())
    rows = slice(0, len(experiment.log))
    assert not find_followed_ripple(problem.experiments[0], params, rows, problem.unknowns.start)


def test_a_fit_that_went_through_a_pickle_follows_as_before():
    experiment, params = pose(record(), parts=("cogging",), **COGS)
    stored = pickle.loads(pickle.dumps(experiment.plant))
    fits = [so.fit([replace(experiment, plant=p)], params, diagnostics=False) for p in (experiment.plant, stored)]
    for name in ("J_m", "b_r", "f_c", "k_s"):
        assert fits[0].parameters[name].value == pytest.approx(TRUTH[name], rel=0.01), name
        assert fits[1].parameters[name].value == pytest.approx(fits[0].parameters[name].value, rel=1e-9), name
    shown = fits[0].predict(experiment)
    assert np.std(shown.model["theta_m"] - shown.measured["theta_m"]) < 0.01 * np.std(shown.measured["theta_m"])


def _hide(log, name, rows):
    """Return a log in which some samples of a channel are missing."""
    columns = {each: log[each].copy() for each in log.signals}
    columns[name][rows] = np.nan
    return so.Log.from_arrays(time=log.time, **columns)


@pytest.mark.parametrize(
    "hidden",
    [slice(1000, 1400), np.random.default_rng(0).random(3200) < 0.05],
    ids=["a second", "one sample of twenty"],
)
def test_samples_that_the_position_misses_do_not_hide_the_waves(hidden):
    """Over a second the motor turns by tens of waves, which a line between its ends does not have."""
    experiment, params = pose(_hide(record(), "theta_m", hidden))
    best = so.fit([experiment], params).hypotheses[0]
    assert (best.parts, best.outcome) == (("cogging",), "adopted")
    assert best.frees["n_g"] == pytest.approx(COGS["n_g"], rel=1e-4)
    for name in ("J_m", "b_r", "f_c", "k_s"):
        assert best.parameters[name] == pytest.approx(TRUTH[name], rel=0.01), name


@pytest.mark.parametrize("channel", ["theta_m", "theta_l"])
def test_a_channel_without_a_sample_and_a_short_log_have_no_missing_force(channel):
    log = _hide(record(), channel, slice(None))
    whole, params = pose(record())
    experiment = replace(whole, log=log, outputs=tuple({"theta_m", "theta_l"} - {channel}))
    for each, rows in ((experiment, slice(0, len(log))), (whole, slice(0, 15))):
        problem = pose_problem((each,), params, loss=Squares())
        assert not find_followed_ripple(problem.experiments[0], params, rows, problem.unknowns.start)
