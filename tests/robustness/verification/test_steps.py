"""Steps as a user sees them: overshoot, settling and steady error, against a stick-slip simulator of the tests' own."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.errors import ControlError
from seaopt.robustness.verification import verification
from seaopt.robustness.verification.amplitude_prediction import predict_gain
from seaopt.robustness.verification.large_signal import large_signal
from seaopt.robustness.verification.playback import play
from seaopt.robustness.verification.scenarios import step_scenarios
from seaopt.robustness.verification.verification import verify
from tests.laws import law_of, multiply_out, scaled
from tests.stick_slip import Mass, simulate

SPEC = so.ControllerSpec(
    bandwidth_hz=25, max_sensitivity=1.6, max_noise_gain=25, max_reference_peak=1.3, compute_delay_samples=2,
    current_limit_A=10, max_complementary=False, max_droop_db=False, min_filter_samples=False,
    reference_weights="error",
)  # fmt: skip
GAINS = {"reference": 1.0, "measurement": 0.2}


@pytest.fixture(scope="module")
def rubbing(thor):
    return thor.update(k=120e3, m_l=0.9, l=0.005, N_p=1, K_tau=0.075, J=1.2e-5, b_r=2.5e-4, eta=0.86, f_c=25, v_s=0.004)


@pytest.fixture(scope="module")
def blind(stand, rubbing):
    """Return a law of 25 Hz and Ms 1.59 where the friction sticks, as if it were a damper; sliding its Ms is 7."""
    narrow = replace(SPEC, bandwidth_range_hz=(24.5, 25.5))  # 25 Hz is not possible, and nobody asks what is
    tuned = so.tune(stand, rubbing.update(f_c=0.0), narrow)
    ahead, back = multiply_out("pid", 1e-3, k_p=4.1182, k_i=193.96, k_d=0.036216, T_f=1.2604e-3, k_r=5.1182)
    law = law_of(back.num, back.den, (ahead.num, ahead.den))
    return replace(tuned, law=law, spec=SPEC, design=(stand, rubbing))


@pytest.fixture(scope="module")
def certificate(blind, stand, rubbing):
    return so.certify(blind, {"stand": stand}, rubbing, simulations=False)


def play_independently(controller, params, steps, jump=False):
    mass = Mass.of({name: params[name].value for name in params}, jump=jump)
    reference = np.repeat(np.array(steps)[:, None], 300, axis=1)
    return simulate([mass] * len(steps), [controller.to_dict()] * len(steps), reference, substeps=40 if jump else 20)


def test_steps_overshoot_as_the_independent_simulator_says(blind, certificate, rubbing):
    assert not any(row.overshoot_by_limit for row in certificate.steps.rows)  # nor is the limit to blame for the others
    rows = {row.scenario: row for row in certificate.steps.rows if not row.saturated}
    names = ["2 % step", "unsaturated step"]
    small = [f"step of {share} times the friction, sticking" for share in (0.1, 0.3, 0.7)]
    assert set(rows) == {*names, *(f"{name}, sticking" for name in names), *small}
    worst = 0.0
    for jump, chosen in ((False, names), (True, [*(f"{name}, sticking" for name in names), *small])):
        steps = np.array([certificate.steps.scenario(rows[name]).phases[-1].force_N for name in chosen])
        expected = play_independently(blind, rubbing, steps, jump=jump).overshoot(steps)
        assert [rows[name].overshoot for name in chosen] == pytest.approx(expected, rel=2e-3, abs=1e-6)
        worst = max(worst, *expected)
    (over,) = [row for row in certificate.requirements if row.name == "step_overshoot"]
    assert not over.met and not certificate.passed
    assert (over.value, over.limit) == pytest.approx((1.0 + worst, 1.1 * 1.3), rel=2e-3)
    assert (over.plant, over.scenario) == ("stand", "unsaturated step") and over.count > 1


@pytest.mark.slow
def test_what_overshoots_only_once_friction_lets_go_is_not_passed(stand, thor):
    """Smoothed as declared no step overshoots by a sixth; one that waits for the integral by two thirds."""
    params = thor.update(
        m_l=0.08, k=4.85e5, l=7.03e-3, N_p=1.32, K_tau=0.0302, J=1.48e-5, b_r=6.9e-4, eta=0.85, f_c=3.09, v_s=8.7e-3
    )  # fmt: skip
    spec = so.ControllerSpec(bandwidth_hz=32.4, compute_delay_samples=3, max_noise_gain=25, current_limit_A=13.5)
    controller = so.tune(stand, params, spec)
    certificate = so.certify(controller, {"stand": stand}, params, simulations=False)
    rows = {row.scenario: row.overshoot for row in certificate.steps.rows}
    smooth = max(rows[name] for name in rows if "sticking" not in name)
    (over,) = [row for row in certificate.requirements if row.name == "step_overshoot"]
    step = np.array([0.309])
    alone = simulate(
        [Mass.of({name: params[name].value for name in params}, jump=True)], [controller.to_dict()],
        np.repeat(step[:, None], 2500, axis=1), substeps=20,
    )  # fmt: skip
    assert controller.feasible and not certificate.passed
    assert smooth < 0.2 < 0.43 < over.value - 1.0
    assert over.value - 1.0 == pytest.approx(alone.overshoot(step)[0], rel=5e-3)


def test_a_sample_at_the_limit_excuses_no_overshoot(blind, certificate, stand, rubbing):
    """One sample of the step saturates, by a hundredth of its current: it overshoots as it does without the limit."""
    rows = certificate.steps
    row = next(row for row in rows.rows if row.scenario == "unsaturated step")
    tight = replace(blind, spec=replace(SPEC, current_limit_A=0.99 * row.peak_command))
    found = verify(tight, {"stand": stand}, rubbing, scenarios=(rows.scenario(row),)).rows[0]
    assert 0.0 < found.saturated < 0.002
    assert [fault.kind for fault in found.faults] == ["overshoot"] and not found.overshoot_by_limit


@pytest.mark.parametrize("cell", [None, so.Sensors(noise_std={"F1": 1.0})])
def test_an_overshoot_that_the_limit_alone_makes_stands(cell, stand, thor):
    """Near the limit nothing is left to brake a fast law's step with; without the limit it keeps 1.05."""
    thor = thor.update(b_r=2e-5)
    tuned = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=60, max_reference_peak=1.05, current_limit_A=9.0))
    step = 0.95 * tuned.force_limit(0.01)
    last = step_scenarios(tuned, stand)[0]
    large = replace(last, phases=(last.phases[0], replace(last.phases[1], force_N=step)), final_error=0.02 * step)
    row = verify(tuned, {"stand": stand}, thor, scenarios=(large,), sensors=cell).rows[0]
    alone = play_independently(tuned, thor, [step]).overshoot(np.array([step]))[0]
    assert alone < 1.1 * 1.05 - 1.0 < row.overshoot
    assert row.overshoot_by_limit and "overshoot" not in [fault.kind for fault in row.faults]


def test_where_no_peak_is_asked_for_the_certificate_says_that_none_is_judged(blind, stand, rubbing):
    lifted = replace(blind, spec=replace(SPEC, max_reference_peak=False))
    certificate = so.certify(lifted, {"stand": stand}, rubbing, simulations=False)
    assert not any(row.name == "step_overshoot" for row in certificate.requirements)
    assert any("overshoot" in note for note in certificate.notes)


def test_a_step_that_ends_short_neither_settles_nor_passes(stand, rubbing):
    """A proportional law of static gain 1/(1 + 0.2): every step ends a sixth short."""
    pd = so.tune(stand, rubbing.update(f_c=0.0), replace(SPEC, current_limit_A=None, max_reference_peak=False))
    law = law_of([GAINS["measurement"]], reference=([GAINS["reference"]], [1.0]))
    short = replace(pd, law=law, design=(stand, rubbing))
    found = verify(short, {"stand": stand}, rubbing, scenarios=step_scenarios)
    steps = [found.scenario(row).phases[-1].force_N for row in found.rows]
    sizes = [5.0, 25.0, 125.0, 625.0]  # times the friction, without a current limit
    assert steps == pytest.approx([*sizes, *sizes])  # a law without an integral never lets go of less than the friction
    for row, step in zip(found.rows, steps, strict=True):
        faults = {fault.kind: fault for fault in row.faults}
        assert {"settling", "steady error"} <= set(faults)
        if "sticking" not in row.scenario:
            assert faults["steady error"].value == pytest.approx(step / 6.0, rel=0.02)
        elif GAINS["reference"] * step <= 25.0:  # it never lets go
            assert faults["steady error"].value == pytest.approx(step)
        assert faults["settling"].value == np.inf


@pytest.mark.parametrize(("factor", "late"), [(40.0, 0), pytest.param(1.0, 30, marks=pytest.mark.slow)])
def test_a_run_away_is_told_once_and_allows_nothing_absurd(blind, stand, rubbing, factor, late):
    wild = replace(blind, law=scaled(blind.law, factor), compute_delay_samples=2 + late)
    certificate = so.certify(wild, {"stand": stand}, rubbing, simulations=False)
    (told,) = [row for row in certificate.requirements if row.name == "simulation_failures"]
    assert (told.value, "unstable" in told.where) == (11.0, True)
    sizes = [step.phases[-1].force_N for step in certificate.steps.scenarios["stand"]]
    assert min(sizes) > 1.0


def test_bandwidth_against_amplitude_is_that_of_an_independent_simulator(blind, stand, rubbing):
    """Stuck and sliding: sines on the tests' own simulator, as simulated and as predicted."""
    smooth = replace(blind, spec=replace(SPEC, current_limit_A=None))
    amplitude, f = np.array([5.0, 40.0, 1000.0]), 500.0 / 22  # Hz: 132 samples are three periods
    sweep = large_signal(smooth, stand, rubbing, amplitudes_N=tuple(amplitude), frequencies_hz=(f,))
    assert sweep.friction_N == pytest.approx(25.0)
    wave = np.exp(2j * np.pi * sweep.frequency_hz[0] * 1e-3 * np.arange(800))
    mass = Mass.of({name: rubbing[name].value for name in rubbing})
    runs = simulate([mass] * 3, [smooth.to_dict()] * 3, amplitude[:, None] * wave.imag, substeps=20)
    last = slice(800 - round(6 * 1e3 / sweep.frequency_hz[0]), 800)
    expected = 2.0 * np.abs(np.mean(runs.force[:, last] * wave.conj()[last], axis=1)) / amplitude
    assert np.abs(sweep.gain[:, 0]) == pytest.approx(expected, rel=0.02)
    predicted = np.abs(predict_gain(smooth, stand, rubbing, sweep.frequency_hz, amplitude))[:, 0]
    assert predicted == pytest.approx(expected, rel=0.05)
    assert expected[2] > 1.5 * expected[0]


def test_steps_are_played_once(limited_controller, stand, thor, monkeypatch):
    """On the same devices `with_simulation` takes over what `certify` played; the rows are those played anew."""
    certificate = so.certify(limited_controller, {"stand": stand}, thor, simulations=False)
    played = []
    monkeypatch.setattr(
        verification, "play", lambda rig, scenario, *rest, **more: played.append(scenario.name) or play(
            rig, scenario, *rest, **more
        )
    )  # fmt: skip

    def leave_out(*_, **__):
        raise ControlError("left out of this test")

    for name in ("passivity", "large_signal", "coupled_stability"):
        monkeypatch.setattr(sys.modules["seaopt.robustness.certificate.simulated"], name, leave_out)
    whole = certificate.with_simulation().simulated.verification
    steps = [scenario.name for scenario in step_scenarios(limited_controller, stand)]
    assert played and not set(played) & set(steps)
    assert whole.rows == verify(limited_controller, {"stand": stand}, thor).rows
    played.clear()
    certificate.with_simulation(sensors=so.Sensors(noise_std={"F1": 1.0}))
    assert set(steps) <= set(played)


def test_the_friction_that_holds_sizes_the_steps(blind, stand, rubbing):
    """Breakaway, not the level of sliding, and the largest of all sets; smoothing has no part in it."""
    plant = so.plants.high_impedance(parts=["stribeck"])
    weak, strong = (
        rubbing.update(f_c=f_c).with_parameters(
            so.Parameter(name="f_s", value=2 * f_c, unit="N"), so.Parameter(name="v_st", value=1e-4, unit="m/s")
        )
        for f_c in (1e-6, 25.0)
    )
    law = replace(blind, design=(plant, weak))
    for sets in ([strong], [weak, strong]):
        steps = {each.name: each.phases[-1].force_N for each in step_scenarios(law, plant, sets)}
        assert steps["step of 0.1 times the friction, sticking"] == pytest.approx(5.0)
    assert not any("times the friction" in each.name for each in step_scenarios(law, plant, [weak]))  # not worth a step


@pytest.mark.slow
def test_friction_that_is_too_steep_is_played_as_friction_that_sticks(blind, stand, rubbing):
    """The rows are those that were simulated, can be played again, and what was left out is said."""
    found = verify(blind, {"stand": stand}, rubbing.update(v_s=1e-8), scenarios=step_scenarios)
    left_out = {name for name, _, reason in found.skipped if "sticks" in reason}
    names = [row.scenario for row in found.rows]
    assert left_out and not left_out & set(names) and len(set(names)) == len(names)
    assert {f"{name}, sticking" for name in left_out} < set(names)
    assert [scenario.name for scenario in found.scenarios["stand"]] == names


def test_a_link_that_rings_on_its_spring_while_friction_holds_is_no_limit_cycle(stand, swing, thor):
    params = thor.update(f_c=60.0, v_s=0.01)
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)
    controller = so.tune(stand, params, spec, robust_to={"swing": swing})
    found = verify(controller, {"swing": swing}, params, scenarios=step_scenarios)
    row = next(row for row in found.rows if row.scenario == "2 % step, sticking")
    assert "oscillation" not in [fault.kind for fault in row.faults]
