"""A servo whose firmware is slower than its log: it takes its goal, or runs its whole loop, every few rows of it.

The servo is integrated here, by Runge and Kutta's classical steps in plain floats.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

import seaopt as so
from seaopt.errors import EstimationError, LogError
from seaopt.estimation.judgement.traces.whitening import whiten

RATE_HZ, SECONDS, STEPS = 500.0, 8.0, 10
TRUTH = {"J_m": 2.4e-5, "b_r": 1.5e-4, "f_c": 0.02, "v_s": 5.0, "N": 100.0, "K_tau": 0.05, "k_s": 300.0, "c_s": 0.0}
SERVO = {"k_p": 0.25, "k_d": 0.006, "g_s": 1.0}
START = {"J_m": 2.8e-5, "k_s": 270.0, "f_c": 0.017}
FREE = ("J_m", "b_r", "f_c", "k_s")


def make_goal():
    """Return a chirp to 25 Hz on some lines."""
    t = np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ
    lines, phases = np.geomspace(0.3, 25.0, 12), np.random.default_rng(1).uniform(0.0, 2.0 * np.pi, 12)
    noise = np.sin(2.0 * np.pi * np.outer(t, lines) + phases).sum(axis=1) / math.sqrt(6.0)
    return t, 8.0 * (np.sin(2.0 * np.pi * (0.2 * t + 24.8 / (2.0 * SECONDS) * t**2)) + 0.4 * noise)


def record(rows, first, *, whole_loop, harder=0.0, v_s=TRUTH["v_s"]):
    """Return a log. `whole_loop`: firmware reads its position, too, every so many rows, and holds what it commands."""
    p, h = TRUTH, 1.0 / RATE_HZ / STEPS
    t, goals = make_goal()
    angle = speed = command = 0.0
    taken, angles = float(goals[0]), list[float]()

    def accelerate(angle, speed):
        current = command if whole_loop else SERVO["k_p"] * (taken - angle) - SERVO["k_d"] * speed
        turned = angle / p["N"]
        rub = p["b_r"] * speed + p["f_c"] * math.tanh(speed / v_s)
        return (p["K_tau"] * current - rub - (p["k_s"] * turned + harder * turned**3) / p["N"]) / p["J_m"]

    for row, goal in enumerate(goals.tolist()):
        angles.append(angle)
        if (row - first) % rows == 0:
            taken = goal
            command = SERVO["k_p"] * (taken - angle) - SERVO["k_d"] * speed
        for _ in range(STEPS):
            a1 = accelerate(angle, speed)
            a2 = accelerate(angle + 0.5 * h * speed, speed + 0.5 * h * a1)
            a3 = accelerate(angle + 0.5 * h * (speed + 0.5 * h * a1), speed + 0.5 * h * a2)
            a4 = accelerate(angle + h * (speed + 0.5 * h * a2), speed + h * a3)
            angle += h * speed + h * h / 6.0 * (a1 + a2 + a3)
            speed += h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
    noise, turned = np.random.default_rng(2), np.array(angles) / p["N"]
    return so.Log.from_arrays(
        time=t,
        goal=goals,
        tau_s=p["k_s"] * turned + harder * turned**3 + noise.normal(scale=0.02, size=t.size),
        theta_m=np.array(angles) + noise.normal(scale=1e-3, size=t.size),
    )


def fit(log, *parts, start="estimate", sticks=False, **options):
    plant = so.plants.rotary(link="locked", parts=["position_servo", *parts])
    plant = so.plants.let_stick(plant) if sticks else plant
    stated = [so.Parameter(name="k_p", value=1.0, unit=plant.parameter_unit("k_p"))]
    known = {name: value for name, value in (TRUTH | SERVO | START).items() if name in plant.parameters}
    params = plant.defaults.with_parameters(*stated).update(**known)
    experiment = so.Experiment(plant=plant, log=log, outputs=("tau_s", "theta_m"), initial_state=start)
    return so.fit([experiment], params.free(*FREE), **options)


def assert_true(values, rel=1e-3):
    for name in FREE:
        assert values[name] == pytest.approx(TRUTH[name], rel=rel), name


@pytest.mark.parametrize(("whole_loop", "parts"), [(False, ()), (True, ("servo_sample",))], ids=["goal", "loop"])
def test_a_firmware_s_rate_is_named_with_the_row_from_which_on_and_its_lines_make_the_fit_right(whole_loop, parts):
    """Of 12 ms, where rows are 2 ms apart: once `servo_delay` and a slow current, and b_r 9 or 46 % off."""
    log = record(6, 4, whole_loop=whole_loop)
    found = fit(log)
    best, *others = found.hypotheses
    assert not found.met and (best.parts, best.outcome, best.holds) == (parts, "adopted", {"experiment": (6, 4)})
    assert best.excess < 1.2 < 5.0 < min(trial.excess for trial in others)
    assert_true(best.parameters)
    assert so.Fit.from_dict(found.to_dict(), ()).hypotheses == found.hypotheses
    (cause,) = (finding for finding in found.findings if finding.kind == "cause")
    assert cause.proposal is not None and cause.proposal.splitlines()[-1] == "held = { samples = 6, first = 4 }"
    mended = fit(log.hold("goal", *best.holds["experiment"]), *parts)
    assert mended.met, mended
    so.testing.assert_recovered(mended, {name: TRUTH[name] for name in FREE}, sigmas=4)
    assert_true({name: mended.parameters[name].value for name in FREE})


@pytest.mark.slow
def test_a_firmware_s_rate_is_found_beside_a_spring_that_hardens():
    found = fit(record(6, 1, whole_loop=True, harder=4e4), start="rest")
    best = found.hypotheses[0]
    assert ({*best.parts}, best.outcome) == ({"hardening", "servo_sample"}, "adopted")
    assert best.holds == {"experiment": (6, 1)}
    assert_true(best.parameters, rel=3e-3)


@pytest.mark.slow
def test_a_joint_that_sticks_under_slow_firmware_has_its_values():
    """Between two of its ticks it stops and starts where it will; the log's friction is smoothed over 0.3 rad/s."""
    log = record(6, 3, whole_loop=True, v_s=0.3).hold("goal", 6, 3)
    found = fit(log, "servo_sample", start="rest", sticks=True, diagnostics=False)
    assert_true({name: found.parameters[name].value for name in FREE}, rel=5e-3)


def test_errors_of_prediction_are_refused_where_firmware_reads_at_some_rows():
    log = record(6, 3, whole_loop=True).hold("goal", 6, 3)
    with pytest.raises(EstimationError, match=r"reads its states at some samples alone.*OutputError\(\)"):
        fit(log, "servo_sample", method=so.PredictionError())


def test_firmware_that_is_as_fast_as_the_log_is_not_said_to_be_slower():
    assert not any(trial.holds for trial in fit(record(1, 0, whole_loop=True, harder=4e4)).hypotheses)


def test_a_log_is_held_from_its_first_value_on_and_says_so():
    log = so.Log.from_arrays(time=np.arange(6) / 10.0, goal=np.arange(6.0)).hold("goal", 3, 4)
    assert log["goal"].tolist() == [0.0, 1.0, 1.0, 1.0, 4.0, 4.0]
    assert log["holds"].tolist() == [1.0, 0.0, 1.0, 1.0, 0.0, 1.0]
    assert log.notes == ("goal: held over 3 samples each, from sample 2 on",)
    for wrong in ({"samples": 0}, {"samples": 2.0}, {"samples": 2, "first": -1}):
        with pytest.raises(LogError, match="is not a whole number; give"):
            log.hold("goal", **wrong)


def test_a_residual_of_which_no_sample_is_there_is_not_looked_into():
    """An output that begins late in a log made numpy warn of the mean of nothing."""
    assert whiten(np.stack([np.full(100, np.nan), np.arange(100.0)])) is None
