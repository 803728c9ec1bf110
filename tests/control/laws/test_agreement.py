"""Force and encoders that must agree through the spring: threshold, false alarms and faults, in Python and in C."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, norm

import seaopt as so
from seaopt.control import MPCSpec, PlausibilityGate, force_mpc, runnable
from seaopt.control.laws.plausibility import FALSE_ALARMS, SIGMAS, Agreement
from seaopt.errors import ControlError
from seaopt.problem import tune_problem
from seaopt.problem.completion import complete_controller
from seaopt.problem.stages import fit_problem
from tests.c_code import CompiledLaw

K, SIGMA, SIGMA_Q = 655e3, 2.0, 1e-6
NOISE = {"F1": SIGMA, "q": SIGMA_Q}
STATUS = ("ok", "held", "fault")


def make_gate(agreement, max_held=5):
    return PlausibilityGate(
        range_N=(-4000.0, 4000.0), max_step_N=400.0, max_held=max_held, ramp_per_s=90.0, agreement=agreement
    )


@pytest.fixture(scope="module")
def check(stand, thor):
    return Agreement.of_plant(stand, thor.prior(k=3000.0), "F1", NOISE)


def test_the_threshold_is_five_point_seven_sigma_and_what_the_spring_is_not_known_by():
    knee = so.plants.rotary(link="free")
    values = knee.defaults.update(c_s=0.3).prior(k_s=2.0, c_s=0.02)
    noise = {"tau_s": 0.05, "theta_m": 2e-3, "theta_l": 1e-4}
    found = Agreement.of_plant(knee, values, "tau_s", noise, rate=40.0, zero=0.1)
    k, n = values["k_s"].value, values["N"].value
    np.testing.assert_allclose(found.weights, [k / n, -k], rtol=1e-9)
    share = SIGMAS * 2.0 / k
    lag = 0.3 / (k - SIGMAS * 2.0) + SIGMAS * 0.02 / k
    sigma = np.hypot(0.05, (1 + share) * k * np.hypot(2e-3 / n, 1e-4))
    assert found.share == pytest.approx(share, rel=1e-9)
    assert found.limit == pytest.approx(SIGMAS * sigma + 0.1 + 40.0 * lag, rel=1e-9)


def test_the_share_is_that_of_the_end_that_needs_more():
    """Of a ratio the weight is k/N: its lower end moves it further than its upper one."""
    knee = so.plants.rotary(link="locked")
    values = knee.defaults.prior(N=0.05 * knee.defaults["N"].value)
    found = Agreement.of_plant(knee, values, "tau_s", dict.fromkeys(("tau_s", "theta_m", "theta_l"), 1e-3))
    assert found.share == pytest.approx(1.0 / (1.0 - 0.05 * SIGMAS) - 1.0, rel=1e-9)


@pytest.mark.parametrize("off", [-SIGMAS, 0.0, SIGMAS])
def test_false_alarms_of_gaussian_noise_are_under_one_in_1e8(off, check):
    """By the Gaussian tail, at any load, with the spring at either end of its interval."""
    k = K + off * 3000.0
    sigma = np.hypot(SIGMA, K * SIGMA_Q)
    for force in np.linspace(-3000.0, 3000.0, 31):
        allowed = check.limit + check.share * abs(K * force / k)
        bias = abs(force - K * force / k)
        assert norm.sf((allowed - bias) / sigma) + norm.sf((allowed + bias) / sigma) <= FALSE_ALARMS


@pytest.mark.parametrize("lowered", [2.0, 3.0])
def test_the_rate_of_false_alarms_is_that_of_the_tail(lowered, check, compiler, tuned, tmp_path):
    """The exported C, its threshold lowered to so many sigma of the difference, the spring as it is."""
    sigma, count = np.hypot(SIGMA, K * SIGMA_Q), 40_000
    low = replace(check, limit=lowered * sigma, share=0.0)
    compiled = CompiledLaw(compiler, tmp_path, tuned, "double", gate=make_gate(low, max_held=1000))
    rng = np.random.default_rng(4)
    alarms = 0
    for force, encoder in rng.normal(size=(count, 2)) * [SIGMA, SIGMA_Q] + [600.0, 600.0 / K]:
        compiled.step(600.0, force, encoder)
        alarms += compiled.law.disagrees
    assert binom.cdf(alarms, count, 2 * norm.sf(lowered)) > 1e-4
    assert binom.sf(alarms - 1, count, 2 * norm.sf(lowered)) > 1e-4


FAULTS = {
    "slip": (1, slice(100, None), lambda row: row + 100.0 / K, "fault"),
    "encoder is lost": (1, slice(100, None), lambda row: np.nan * row, "fault"),
    "encoder is huge": (1, slice(100, None), lambda row: 0.0 * row + 1e300, "fault"),
    "for a moment": (1, slice(100, 104), lambda row: row + 1.0, "held"),
    "cell drifts": (0, slice(100, None), lambda row: row + 0.5 * np.arange(row.size), "fault"),
    "cell breaks": (0, slice(100, None), lambda row: 0.2 * row, "fault"),
    "none": (0, slice(100, None), lambda row: row, "ok"),
}


@pytest.mark.parametrize("name", list(FAULTS))
def test_what_disagrees_is_bridged_then_a_fault(name, check, compiler, tuned, tmp_path):
    gate = make_gate(check)
    compiled, law = CompiledLaw(compiler, tmp_path, tuned, "double", gate=gate), runnable(tuned, gate=gate)
    rng = np.random.default_rng(5)
    force = 600.0 + 50.0 * np.sin(0.05 * np.arange(300))
    rows = np.array([force + SIGMA * rng.normal(size=300), force / K + SIGMA_Q * rng.normal(size=300)])
    column, where, change, worst = FAULTS[name]
    rows[column, where] = change(rows[column, where])
    state, statuses = law.reset(), []
    for reading, encoder in rows.T.tolist():
        wanted, state = law.step(state, 600.0, reading, [encoder])
        assert compiled.step(600.0, reading, encoder) == pytest.approx(wanted, rel=0, abs=1e-11)
        assert (STATUS[compiled.law.status], compiled.law.disagrees) == (state.status, state.gate.disagrees)
        statuses.append(state.status)
    assert set(statuses[:100]) == {"ok"}
    assert max(statuses, key=STATUS.index) == worst
    if worst == "fault":
        assert state.gate.disagrees and wanted == 0.0
    if name == "slip":
        assert statuses.index("fault") == 100 + gate.max_held


def test_an_encoder_that_the_law_feeds_back_too_is_one_argument_in_c(check, compiler, tuned, tmp_path):
    """A law of force and motor position: Python takes the encoder twice, as every law with terms does."""
    law = replace(tuned.law, b=np.column_stack([tuned.law.b, tuned.law.b[:, 1]]), d=np.append(tuned.law.d, -50.0))
    both = replace(tuned, law=law, design=None, reads=("F1", "q"), gate=make_gate(check))
    compiled, law = CompiledLaw(compiler, tmp_path, both, "double", gate=both.gate), runnable(both)
    rng, state = np.random.default_rng(6), law.reset()
    for k in range(300):
        force = 100.0 + SIGMA * rng.normal()
        encoder = 100.0 / K + SIGMA_Q * rng.normal() + (k % 50 == 7) * 1e-3
        wanted, state = law.step(state, 600.0, np.array([force, encoder]), [encoder])
        assert compiled.step(600.0, force, encoder) == pytest.approx(wanted, rel=0, abs=1e-11)
    assert state.status == "ok"


def test_it_goes_into_the_file_and_comes_back(check, stand, thor, tuned):
    guarded = replace(tuned, gate=make_gate(check))
    assert so.Controller.from_dict(guarded.to_dict(), stand, thor).gate == guarded.gate
    assert guarded.further == ("q",) and runnable(guarded).further == ("q",)
    assert "12.09 N and 2.6 % of what the spring carries by q are believed" in guarded.gate.describe("N")


def test_what_cannot_be_compared_is_refused(check, stand, thor, tuned):
    knee, noise = so.plants.rotary, dict.fromkeys(("F1", "F2", "q", "tau_s", "tau_d", "theta_m", "theta_l"), 1e-3)
    hard = knee(parts=("hardening",))
    sensed = knee(parts=("deflection_sensor",))
    for plant, values, regulated, told in (
        (stand, thor, "F2", "F2 of high_impedance.* is no fixed multiple of q"),
        (hard, hard.defaults.update(k_3=1e5), "tau_s", "the spring is not linear"),
        (knee(parts=("load_cell",)), None, "tau_s", "or a sensor lags; leave it out"),
        (sensed, None, "tau_d", "tau_d of .* is computed from the encoders, so that there is no force"),
        (knee(), knee().defaults.prior(N=1.0), "tau_s", "N has a std, and changes what one encoder says"),
        (knee(), knee().defaults.prior(k_s=60.0), "tau_s", "the std of the spring is 20 % of it"),
        (knee(), knee().defaults.free("k_s"), "tau_s", "k_s is not known; fit it"),
    ):
        with pytest.raises(ControlError, match=f"agreement: .*{told}"):
            Agreement.of_plant(plant, values or plant.defaults, regulated, noise)
    for std, told in (
        (0.0, "limit of 0 should be between .*; give the sensors their noise"),
        (-2.0, "noise of F1 = -2 is no std; give a finite one"),
        (np.nan, "noise of F1 = nan is no std"),
        (np.inf, "noise of F1 = inf is no std"),
        ("2", "noise of F1 = '2' is a str; give a real number"),
    ):
        with pytest.raises(ControlError, match=f"agreement: {told}"):
            Agreement.of_plant(stand, thor, "F1", {"F1": std, "q": 0.0})
    with pytest.raises(ControlError, match=r"the noise of q is not known; it takes a log with F1 and q, or"):
        PlausibilityGate.of_controller(tuned, range_N=(-4000.0, 4000.0), agreement=True, noise={"F1": 2.0})
    mpc = force_mpc(stand, thor, MPCSpec(current_limit_A=9.0))
    with pytest.raises(ControlError, match="it is of a law"):
        PlausibilityGate.of_controller(mpc, range_N=(-4000.0, 4000.0), agreement=True, noise=NOISE)
    with pytest.raises(ControlError, match=r"gate.agreement: predictive control reads the force alone"):
        force_mpc(stand, thor, MPCSpec(current_limit_A=9.0), gate=make_gate(check))
    law = runnable(tuned, gate=make_gate(Agreement(reads=("q",), weights=(K,), limit=12.0, share=0.0)))
    with pytest.raises(ControlError, match="the law reads q besides, and got 0; give one of each"):
        law.step(law.reset(), 0.0, 0.0)


PROBLEM = """
schema = 1
title = "agreeing"
[parameters]
k = {{ value = 655000, prior_std = 3000, free = true }}
[plant.stand]
kind = "high_impedance"
drive = "unlumped"
[[experiment]]
name = "chirp"
plant = "stand"
virtual = {{ seed = 1, duration_s = 5, rate_hz = 400, outputs = {outputs}, noise_std = {{ F1 = 2.0, q = 1e-6 }}, excitation = {{ chirp = {{ amplitude = 2.0, f0_hz = 0.5, f1_hz = 100 }} }} }}
[controller]
plant = "stand"
bandwidth_hz = 30
max_sensitivity = 1.6
current_limit_A = 9.0
[controller.gate]
range_N = [-4000, 4000]
agreement = true
"""  # noqa: E501


def test_the_noise_is_that_of_a_log_that_has_both(tmp_path, tuned):
    """The fit's residual gives the noise, its std the interval; a log without the encoder is named."""
    for outputs in ('["F1", "q"]', '["F1"]'):
        file = tmp_path / "agreeing.toml"
        file.write_text(PROBLEM.format(outputs=outputs), encoding="utf-8")
        problem = so.read_problem(file)
        fit = fit_problem(problem)
        controller = replace(tuned, design=(tuned.design[0], problem.values(fit)))
        if "q" not in outputs:
            with pytest.raises(so.SeaoptError, match=r"controller.gate: agreement: the noise of q is not known"):
                complete_controller(problem, controller, fit)
            continue
        found = complete_controller(problem, controller, fit).gate.agreement
        k = fit.parameters["k"]
        assert found.share == pytest.approx(SIGMAS * k.total_std / k.value, rel=1e-6)
        assert found.limit == pytest.approx(SIGMAS * np.hypot(SIGMA, K * SIGMA_Q), rel=0.1)


@pytest.mark.parametrize(("over", "points"), [("J", (3e-6, 4e-6)), ("k", (5e5, 8e5))])
def test_a_schedule_has_one_agreement_or_is_refused(over, points, tmp_path):
    """It took the weights of the widest gate, and true readings at another stiffness were a fault."""
    file = tmp_path / "agreeing.toml"
    text = PROBLEM.format(outputs='["F1", "q"]').replace(
        "_hz = 30", f'_hz = 25\nschedule = {{ over = "{over}", points = {list(points)} }}'
    )
    file.write_text(text + "[robustness.sensors]\nnoise_std = { F1 = 2.0, q = 1e-6 }\n", encoding="utf-8")
    problem = so.read_problem(file)
    values = problem.parameters.update(eta=1.0)
    if over == "k":
        with pytest.raises(
            so.SeaoptError, match=r"gate: agreement: what q say of the force differs over k .* leave agr"
        ):
            tune_problem(problem, values)
        return
    schedule = tune_problem(problem, values)
    steps = [
        PlausibilityGate.of_controller(replace(each, gate=None), range_N=(-4e3, 4e3)).max_step_N
        for each in schedule.controllers
    ]
    assert {each.gate.max_step_N for each in schedule.controllers} == {max(steps)} and steps[0] != steps[1]
    law = schedule.runnable()
    for value in np.linspace(*points, 3):
        state = law.reset(place=value)
        for _ in range(20):
            _, state = law.step(state, 600.0, 600.0, value, [600.0 / K])
        assert state.status == "ok"
