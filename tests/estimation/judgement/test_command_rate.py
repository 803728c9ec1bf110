"""Logs of every second tick: half of what was commanded is not in them, and no part of a model explains what it did.

The actuators are integrated here at the command's own rate, in NumPy, and rows are left out.
"""

from __future__ import annotations

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


def record(current, every, *, rate_hz=TICK_HZ, missing=0.0, **options):
    """Return the fit of every so many rows of a locked knee, the evaluations before its judgement, and all."""
    truth = KNEE | {"f_c": missing}
    columns = knee(current, rate_hz, locked=True, **truth)
    time = np.arange(current.size) / rate_hz
    log = so.Log.from_arrays(time=time[::every], **{n: columns[n][::every] for n in ("I", "tau_s", "theta_m")})
    plant = so.plants.rotary(link="locked")
    known = {name: KNEE[name] for name in ("J_m", "b_r", "k_s", "N", "K_tau")}
    params = plant.defaults.update(**known | {"c_s": 0.0, "J_m": 3e-5, "b_r": 2e-4, "k_s": 260.0}).free(*FREE)
    experiment = so.Experiment(plant=plant, log=log, outputs=("tau_s", "theta_m"), **options)
    kept, before = [], count_evaluations()
    fit = so.fit([experiment], params, keep=lambda _: kept.append(count_evaluations() - before))
    return fit, kept[0], count_evaluations() - before


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
