"""Fits of an actuator whose friction jumps at rest, made by a simulator that sticks exactly and shares no code."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.errors import EstimationError
from seaopt.estimation.problem.fit_problem import count_evaluations, pose_problem
from seaopt.estimation.problem.losses import Squares
from seaopt.estimation.solver.prediction import find_predicting_start
from seaopt.simulation import count_stable_steps, make_model
from tests.stick_slip import Mass, simulate

RATE_HZ, SECONDS = 500.0, 4.0
FREE = ("k", "J", "b_r", "f_c")


@pytest.fixture(scope="module")
def truth(stand, thor):
    return stand.complete(thor.update(f_c=35.0))


@pytest.fixture(scope="module")
def bench(stand, truth):
    """Multisine and a slow triangle of current, 2 N of noise; the encoder is as good."""
    p = {name: parameter.value for name, parameter in truth.items()}
    t, rng = np.arange(int(RATE_HZ * SECONDS)) / RATE_HZ, np.random.default_rng(0)
    sines = sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 2 * np.pi)) for f in np.geomspace(0.3, 60, 20))
    current = 0.25 * sines + 2.0 * (2.0 * np.abs(2.0 * ((t / 2.0 + 0.2) % 1.0) - 1.0) - 1.0)
    effort = 2.0 * np.pi * p["N_p"] / p["l"] * p["eta"] * p["K_tau"]
    open_loop = {
        "sample_time_s": 1.0 / RATE_HZ, "delay_samples": 0, "reference": {"num": [1.0], "den": [1.0]},
        "measurement": {"num": [0.0], "den": [1.0]},
    }  # fmt: skip
    force = simulate([Mass.of(p, jump=True)], [open_loop], effort * current[None], substeps=25).force[0]
    noise = 2.0 * rng.normal(size=(2, t.size))
    log = so.Log.from_arrays(time=t, I=current, F1=force + noise[0], q=(force + noise[1]) / p["k"])
    return so.Experiment(plant=stand, log=log, name="jump", outputs=("F1", "q"))


@pytest.mark.parametrize("start", [1e-3, pytest.param(1e-9, marks=pytest.mark.slow)])
def test_a_free_smoothing_speed_falls_until_the_log_resolves_no_more(bench, truth, start):
    fit = so.fit([bench], truth.update(v_s=start).free(*FREE, "v_s"))
    assert fit.met, fit
    for name in FREE:
        found = fit.parameters[name]
        assert abs(found.value - truth[name].value) < 4.0 * found.std, name
    v_s = fit.parameters["v_s"]
    assert v_s.value < 1e-4 and v_s.value < 4.0 * v_s.std  # nothing tells it from the jump


def test_no_last_digit_decides_how_sharp_friction_is_found(bench, truth):
    """Its cost has kinks where steps are too long: searches crept among them in 160 to 480 evaluations, and one of two
    stalled.
    """
    rng, ends, log = np.random.default_rng(5), [], bench.log
    for _ in range(6):
        digits = {name: log[name] * (1.0 + 1e-12 * rng.uniform(-1.0, 1.0, len(log))) for name in ("I", "F1", "q")}
        other = replace(bench, log=so.Log.from_arrays(time=log.time, **digits))
        before = count_evaluations()
        fit = so.fit([other], truth.update(v_s=1e-9).free(*FREE, "v_s"), diagnostics=False)
        assert fit.status == "converged" and not fit.findings, fit
        assert count_evaluations() - before < 80
        ends.append([fit.parameters[name].value for name in (*FREE, "v_s")])
    np.testing.assert_allclose(ends, [ends[0]] * len(ends), rtol=1e-6)


@pytest.mark.slow
def test_what_is_told_of_smooth_friction_is_no_bound(bench, truth):
    fit = so.fit([bench], truth.update(v_s=1e-3).free(*FREE))
    (cause,) = (finding for finding in fit.findings if finding.kind == "cause")
    assert cause.where == "v_s" and "jumps" in cause.text
    assert not cause.preferred and "sticks = true" in cause.proposal
    again = so.fit([bench], truth.update(v_s=1e-5).free(*FREE))
    assert again.met and not again.findings


@pytest.mark.parametrize("v_s", [1e-3, 1e-5])
def test_a_predicting_start_ends_where_its_cost_is_flat(bench, truth, v_s):
    """Friction that is sharp for its few integration steps leaves kinks: it took 64 and 82 evaluations."""
    off = {"k": 1.2, "J": 1.5, "b_r": 0.6, "f_c": 0.6}
    start = truth.update(v_s=v_s, **{name: factor * truth[name].value for name, factor in off.items()})
    problem = pose_problem((bench,), start.free(*FREE), loss=Squares())
    before = count_evaluations()
    z = find_predicting_start(problem, problem.unknowns.start, 120)
    assert z is not None and count_evaluations() - before < 40
    for name, value in zip(problem.shared_names, z, strict=False):
        assert value == pytest.approx(truth[name].value, rel=0.15), name


def test_friction_that_takes_too_long_is_fitted_as_it_jumps(bench, truth):
    notes, log, repeats = [], bench.log, 8
    long = so.Log.from_arrays(
        time=np.arange(repeats * len(log)) / RATE_HZ, **{name: np.tile(log[name], repeats) for name in ("I", "F1", "q")}
    )
    one = replace(bench, log=long)
    params = truth.update(v_s=6e-6).free(*FREE)
    steps = count_stable_steps(make_model(bench.plant, truth.update(v_s=6e-6)), np.zeros(0), 1.0 / RATE_HZ)
    assert 8.0 < steps < 50.0
    fit = so.fit([one], params, diagnostics=False, progress=lambda note, share=None: notes.append(note))
    sticking = so.fit([replace(one, plant=so.plants.let_stick(bench.plant))], params, diagnostics=False)
    assert [finding.kind for finding in fit.findings] == ["sharp"] and not sticking.findings
    assert any("fitted as it jumps" in note for note in notes)
    assert fit.experiments[0].plant.sticks
    for name in FREE:
        assert fit.parameters[name].value == pytest.approx(sticking.parameters[name].value, rel=1e-9)


def test_friction_too_sharp_to_simulate_is_refused_with_the_speed_that_can_be(bench, truth):
    with pytest.raises(EstimationError, match=r"v_s = .* or more in place of 1e-09") as caught:
        so.fit([bench], truth.update(v_s=1e-9).free(*FREE))
    least = float(str(caught.value).split("v_s = ")[1].split()[0])
    steps = count_stable_steps(make_model(bench.plant, truth.update(v_s=least)), np.zeros(0), 1.0 / RATE_HZ)
    assert 240 < steps < 270


def test_steps_are_stable_at_rest(stand, truth):
    """There the plant is the spring-mass with b + f_c/v_s of damping, whose fast pole is (b + f_c/v_s)/m, about."""
    p, v_s, period = {name: parameter.value for name, parameter in truth.items()}, 1e-6, 1e-3
    mass = Mass.of(p)
    fast = np.max(np.abs(np.roots([mass.m, mass.b + mass.f_c / v_s, mass.k])))
    steps = count_stable_steps(make_model(stand, truth.update(v_s=v_s)), np.zeros(0), period)
    assert steps == np.ceil(fast * period / 2.5)
    growth = np.polyval([1 / 24, 1 / 6, 1 / 2, 1.0, 1.0], -fast * period / steps)  # of Runge-Kutta's method
    assert abs(growth) < 1.0
