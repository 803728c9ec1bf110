"""Logs of every second tick: half of what was commanded is not in them, and no part of a model explains what it did.

The actuators are integrated here at the command's own rate, in NumPy, and rows are left out.
"""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

import seaopt as so
from seaopt.estimation.problem.fit_problem import count_evaluations
from seaopt.estimation.result.fit_result import Fit
from tests.actuator_logs import KNEE, knee

TICK_HZ, SECONDS = 1000.0, 6.0
FREE = ("J_m", "b_r", "k_s")


def play_multisine(top_hz=60.0):
    t, rng = np.arange(round(SECONDS * TICK_HZ)) / TICK_HZ, np.random.default_rng(4)
    lines = np.arange(0.5, top_hz, 0.5)
    phases = rng.uniform(0, 6.28, lines.size)
    return np.sum(np.cos(2 * np.pi * lines * t[:, None] + phases) / np.sqrt(lines), axis=1)


def play_binary(ticks=1):
    steps = np.random.default_rng(4).choice([-3.0, 3.0], round(SECONDS * TICK_HZ) // ticks)
    return np.repeat(steps, ticks)


def make_log(current, every, *, rate_hz=TICK_HZ, missing=0.0, later=0, noise=1.0):
    """Return every so many rows of a locked knee, its outputs so many of them later than the command."""
    columns = knee(current, rate_hz, locked=True, noise=noise, **KNEE | {"f_c": missing})
    rows = np.arange(0, current.size - later, every)
    outputs = {name: columns[name][rows + later] for name in ("tau_s", "theta_m")}
    return so.Log.from_arrays(time=rows / rate_hz, I=columns["I"][rows], **outputs)


def fit_logs(*logs, **options):
    """Return a fit, the evaluations before its judgement, and all."""
    plant = so.plants.rotary(link="locked")
    known = {name: KNEE[name] for name in ("J_m", "b_r", "k_s", "N", "K_tau")}
    params = plant.defaults.update(**known | {"c_s": 0.0, "J_m": 3e-5, "b_r": 2e-4, "k_s": 260.0}).free(*FREE)
    names = [f"log-{number}" for number in range(len(logs))] if len(logs) > 1 else ["experiment"]
    outputs = ("tau_s", "theta_m")
    experiments = [
        so.Experiment(plant=plant, log=log, name=name, outputs=outputs, **options)
        for name, log in zip(names, logs, strict=True)
    ]
    kept, before = [], count_evaluations()
    fit = so.fit(experiments, params, keep=lambda _: kept.append(count_evaluations() - before))
    return fit, kept[0], count_evaluations() - before


def record(current, every, *, missing=0.0, **options):
    return fit_logs(make_log(current, every, missing=missing), **options)


def list_rates(fit):
    return [finding.rate_hz for finding in fit.findings if finding.kind == "command"]


@pytest.mark.parametrize("every", [2, 4])
@pytest.mark.parametrize("free", [False, True], ids=["no delay", "free delay"])
def test_a_smooth_command_that_changes_between_the_rows_is_named_at_once(every, free):
    """With a free delay, which cannot be negative, a damper of the spring was named, and a hundred causes tried."""
    delay = so.Parameter(name="delay", value=1e-3, unit="s", min=0.0, max=0.01, free=True)
    fit, fitting, whole = record(play_multisine(), every, **({"delay_s": delay} if free else {}))
    assert not fit.met
    (finding,) = (each for each in fit.findings if each.kind == "command")
    assert (finding.severity, finding.where) == ("error", "experiment")
    assert finding.rate_hz == pytest.approx(TICK_HZ, rel=1e-9 if every == 2 else 0.3)  # four or five of so many rows
    assert "log every tick, or command at the log's rate" in finding.text
    assert not [each for each in fit.findings if each.kind in ("cause", "fixed", "budget")]
    assert not fit.hypotheses
    assert whole - fitting <= 100  # refits of two to five rates, of the four or five values that they know nearly
    again = Fit.from_dict(fit.to_dict())
    assert list_rates(again) == list_rates(fit)


@pytest.mark.parametrize("every", [2, 5])
def test_a_command_that_changes_from_tick_to_tick_is_named(every):
    fit, fitting, whole = record(play_binary(), every)
    assert not fit.met
    (rate,) = list_rates(fit)
    assert rate == pytest.approx(TICK_HZ, rel=0.25)
    assert not [each for each in fit.findings if each.kind == "cause"]
    assert whole - fitting <= 5 * 40 + 40


@pytest.mark.parametrize("every", [1, 2], ids=["every tick", "ticks of half the rate"])
@pytest.mark.parametrize("play", [play_multisine, play_binary])
def test_a_log_that_has_all_that_was_commanded_is_met(play, every):
    current = np.repeat(play()[::every], every)
    fit, _, _ = record(current, every)
    assert fit.met, fit
    assert not list_rates(fit)


@pytest.mark.parametrize("play", [play_multisine, play_binary, lambda: play_binary(20)])
def test_friction_that_the_model_lacks_is_no_command_between_the_rows(play):
    fit, _, _ = record(play(), 1, missing=0.02)
    assert not list_rates(fit)


@pytest.mark.parametrize("part", [4, 3])
def test_readings_taken_a_part_of_a_tick_after_the_command_are_that(part):
    """Two values a row move the outputs by a quarter of a row, too: that was named, and nothing else looked for."""
    current = np.repeat(play_multisine(), 12)  # held over the whole tick
    fit, _, _ = fit_logs(make_log(current, 12, rate_hz=12 * TICK_HZ, later=12 // part))
    assert not fit.met
    assert not [each for each in fit.errors if each.kind == "command"]
    (cause,) = (each.text for each in fit.findings if each.kind == "cause")
    (late, *_) = re.findall(r"stamped ([0-9.]+) ms late", cause)
    assert float(late) == pytest.approx(1.0 / part, abs=0.01)


def test_where_a_late_stamp_explains_as_much_both_are_named():
    """Under so much noise steps of 1 and of 2 ms, a quarter of these apart, do not differ."""
    fit, _, _ = fit_logs(make_log(play_multisine(), 2, noise=5.0))
    (finding,) = (each for each in fit.findings if each.kind == "command")
    assert (finding.severity, finding.rate_hz) == ("warning", TICK_HZ)
    assert "may have been held" in finding.text and "as much with inputs that are stamped late" in finding.text
    (cause,) = (each.text for each in fit.findings if each.kind == "cause")
    assert "late" in cause


@pytest.mark.parametrize("play", [play_multisine, play_binary])
def test_each_log_has_a_rate_of_its_own(play):
    slow = make_log(np.repeat(play()[::2], 2), 4)
    fit, _, _ = fit_logs(make_log(play(), 2), slow)
    rates = {each.where: each.rate_hz for each in fit.findings if each.kind == "command"}
    assert rates == {"log-0": TICK_HZ, "log-1": TICK_HZ / 2}


def fit_late(current, every, delay_ticks, *, noise=1.0):
    """Return the fit of a log of every so many ticks, whose outputs follow the command after a delay, which is free."""
    acted = np.concatenate([np.zeros(delay_ticks), current])[: current.size]
    columns = knee(acted, TICK_HZ, locked=True, noise=noise, **KNEE | {"f_c": 0.0})
    rows = np.arange(0, current.size, every)
    outputs = {name: columns[name][rows] for name in ("tau_s", "theta_m")}
    delay = so.Parameter(name="delay", value=1e-3, unit="s", min=0.0, max=0.02, free=True)
    log = so.Log.from_arrays(time=rows / TICK_HZ, I=current[rows], **outputs)
    fit = fit_logs(log, delay_s=delay)[0]
    nuisance = fit.nuisance["experiment"]
    return fit, nuisance.delay_s, math.hypot(nuisance.std["delay_s"], nuisance.model_std["delay_s"])


@pytest.mark.parametrize(("every", "ticks", "top_hz"), [(2, 2, 60.0), (2, 5, 8.0), (4, 6, 20.0)])
def test_a_delay_that_makes_up_for_what_lies_between_the_rows_is_named(every, ticks, top_hz):
    """It ended half a tick short, 1.5008 +- 0.0004 ms of 2, and met, where the residual is hardly above the noise."""
    fit, delay, std = fit_late(play_multisine(top_hz), every, ticks)
    assert abs(delay - ticks / TICK_HZ) < 1.96 * std
    (finding,) = (each for each in fit.findings if each.kind == "command")
    assert finding.severity == "warning" and "may have been held at a faster rate" in finding.text
    assert every / 2 <= finding.rate_hz * every / TICK_HZ <= every + 1


@pytest.mark.parametrize(("every", "ticks", "top_hz"), [(2, 2, 60.0), (2, 4, 8.0), (4, 8, 20.0), (3, 6, 30.0)])
def test_a_command_held_at_the_rate_of_its_log_keeps_its_delay(every, ticks, top_hz):
    fit, delay, std = fit_late(np.repeat(play_multisine(top_hz)[::every], every), every, ticks)
    assert fit.met and not [each for each in fit.findings if each.kind == "command"]
    assert std < 1e-5 and abs(delay - ticks / TICK_HZ) < 4.0 * std


@pytest.mark.parametrize("held", [False, True])
def test_a_delay_is_named_where_the_log_does_not_tell_at_which_rate_the_command_was_held(held):
    """It is half a tick short where the command had values between the rows: said, and not added to the interval, as
    of all that such a log cannot tell.
    """
    current = play_multisine(3.0)
    fit, delay, std = fit_late(np.repeat(current[::2], 2) if held else current, 2, 4)
    (finding,) = (each for each in fit.findings if each.kind == "command")
    assert finding.severity == "note" and finding.rate_hz == TICK_HZ and "0.5 ms longer" in finding.text
    assert fit.met and abs(delay - (4e-3 if held else 3.5e-3)) < 4.0 * std < 1e-4
    assert "experiment.delay_s where the command was held at 1000 Hz" in " ".join(str(fit).split())
