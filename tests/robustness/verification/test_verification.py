"""Verification by simulation: limit cycles where describing functions put them, faults named, scenarios that happen."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.bench import Chirp
from seaopt.control import Gains, MPCSpec, force_mpc
from seaopt.control.laws.realisation import runnable
from seaopt.errors import ControlError, UnplayedError
from seaopt.reporting.sections.kinds.verification import describe_tracking
from seaopt.robustness import linear_controller
from seaopt.robustness.verification.large_signal import large_signal
from seaopt.robustness.verification.oscillation import find_oscillation
from seaopt.robustness.verification.playback import Rig, _build_reference, play
from seaopt.robustness.verification.scenarios import Phase, Scenario, default_scenarios, find_step_limit, list_left_out
from seaopt.robustness.verification.verification import verify
from tests.blocks import of_one_input

CELL = so.Sensors(noise_std={"F1": 1.0}, quantisation={"F1": 0.5})


@pytest.fixture(scope="module")
def controller(limited_controller):
    return limited_controller


@pytest.fixture(scope="module")
def verification(controller, stand, swing, thor):
    draws = {"swing": [thor.update(I_p=0.2), thor.update(I_p=0.6)]}
    return verify(controller, {"stand": stand, "swing": swing}, thor, sensors=CELL, draws=draws)


STEPS = {"2 % step", "10 % step", "50 % step", "unsaturated step"}


def with_law(controller, **gains):
    """Return the controller with another pd law, as if somebody had typed it in."""
    law = Gains(**{"k_i": 0.0, "T_f": 1e-3, "k_r": 1.0 + gains["k_p"], **gains})
    return replace(controller, law=law.law("pd", controller.sample_time_s))


def test_the_tuned_controller_passes(verification):
    assert verification.passed, verification
    names = {row.scenario for row in verification.rows if row.plant == "swing"}
    assert names == {*STEPS, "saturating doublet", "chirp", "impact", "payload", "fall through 90 deg", "contact"}
    assert len(verification.rows) == 7 + 3 * 10
    assert all(factor > 1 for factor in verification.real_time_factor.values())
    assert "passed" in repr(verification)


def test_a_swinging_output_is_blamed_only_where_there_is_one(verification):
    lines = list(describe_tracking(replace(verification, follows_hz={"stand": (2.0, 30.0), "swing": (2.0, 30.0)})))
    assert [line.split()[0] for line in lines] == ["swing"]
    assert "swinging" in lines[0]


def test_it_goes_into_json(verification):
    content = json.loads(json.dumps(verification.to_dict(), allow_nan=False))
    assert content["passed"] is True
    row = next(item for item in content["rows"] if item["scenario"] == "contact" and item["draw"] == "1")
    assert row["parameters"] == {"I_p": 0.2}
    assert row["contact_loss_J"] > 0.0


def test_scenarios_do_what_they_say(verification):
    rows = {(row.plant, row.scenario): row for row in verification.rows if row.draw == "nominal"}
    for name in ("stand", "swing"):
        assert rows[name, "unsaturated step"].saturated == 0.0
        assert rows[name, "saturating doublet"].saturated > 0.0
        assert rows[name, "saturating doublet"].peak_command == pytest.approx(9.0)
    assert rows["stand", "saturating hold"].saturated > 0.1
    fall = verification.replay(rows["swing", "fall through 90 deg"])
    phi = fall.outputs["phi"][0]
    assert phi[0] == pytest.approx(math.radians(120))
    assert phi.min() < math.pi / 2
    assert abs(fall.outputs["F1"][0, 0]) < 1e-6
    contact = verification.replay(rows["swing", "contact"])
    caught = slice(contact.edges[2], contact.edges[3])
    assert np.all(np.isnan(contact.outputs["phi"][0, caught]))
    before, after = contact.edges[2] - 1, contact.edges[2]
    assert contact.outputs["F1"][0, after] == pytest.approx(contact.outputs["F1"][0, before], abs=15.0)


def test_a_row_is_its_own_witness(verification):
    row = next(item for item in verification.rows if item.draw == "2" and item.scenario == "saturating doublet")
    again = verification.replay(row)
    assert again.peaks["F1"][0] == pytest.approx(row.peak_force_N, rel=1e-3)
    assert row.parameters == {"I_p": 0.6}


def test_the_step_limit_is_where_the_current_saturates(controller, stand, thor):
    """The first samples of the law by hand: the largest motor force for a step, before the plant answers and after."""
    law = runnable(controller, command_limit=math.inf)
    loop = controller.close(stand, thor)
    a, b, (c,), _ = of_one_input(loop.plant.block)
    x, memory, largest = np.zeros(len(b)), law.reset(), 0.0
    for _ in range(200):
        current, memory = law.step(memory, 1.0, float(c @ x))
        x = a @ x + b * current / controller.command.per_effort
        largest = max(largest, abs(current))
    assert find_step_limit(controller) == pytest.approx(9.0 / largest, rel=1e-4)


@pytest.mark.parametrize("factor", [10.5, 11.0])
def test_a_limit_cycle_is_found_where_the_describing_function_says(controller, stand, thor, factor):
    """1 + N(A) L = 0, N(A) = 2/pi (asin s + s sqrt(1 - s^2)), s = limit/A; F has the amplitude |P| N(A) A."""
    wild = with_law(controller, k_p=3.0 * factor, k_d=0.03 * factor)
    loop = wild.close(stand, thor)
    assert not loop.figures().stable
    f = np.linspace(20, 200, 200_001)
    gain = loop.open_loop(f)
    at = np.flatnonzero((gain.imag[:-1] * gain.imag[1:] < 0) & (gain.real[:-1] < -1))[0]
    needed = -1 / gain.real[at]
    s = np.linspace(1e-4, 1, 100_001)
    shape = 2 / np.pi * (np.arcsin(s) + s * np.sqrt(1 - s**2))
    motor = 9.0 / wild.command.per_effort / np.interp(needed, shape, s)
    force = np.abs(loop.plant.response(f[at : at + 1]))[0] * needed * motor

    kick = Scenario(name="kick", phases=(Phase(duration_s=0.1, force_N=200.0), Phase(duration_s=3.0)))
    verification = verify(wild, {"stand": stand}, thor, scenarios=[kick])
    (row,) = verification.rows
    assert not row.passed
    assert "sustains itself" in row.reason
    assert row.limit_cycle_hz == pytest.approx(f[at], rel=0.015)
    assert row.limit_cycle_N == pytest.approx(force, rel=0.03)


def test_an_unstable_loop_without_limit_grows_and_is_named(controller, stand, thor):
    wild = with_law(replace(controller, spec=replace(controller.spec, current_limit_A=None)), k_p=45.0, k_d=0.45)
    verification = verify(wild, {"stand": stand}, thor.update(b_r=2e-4))
    assert not verification.passed
    assert all("grows" in row.reason or "numbers" in row.reason for row in verification.rows)
    assert "FAILED" in repr(verification) and "error    stand, " in repr(verification)


def test_a_draw_may_bring_a_delay(controller, stand, thor):
    """Beyond the delay margin the loop does not settle; within it it does."""
    margin = controller.achieved.delay_margin_s
    late = [thor.with_parameters(so.Parameter(name="delay_s", value=share * margin, unit="s")) for share in (0.5, 1.15)]
    verification = verify(controller, {"stand": stand}, thor, draws={"stand": late})
    assert [row.passed for row in verification.rows if row.scenario == "unsaturated step"] == [True, True, False]
    assert verification.failures[0].parameters == {"delay_s": 1.15 * margin}


def test_limits_are_named_with_the_draw(controller, swing, thor):
    scenario = Scenario(
        name="knock", phases=(Phase(duration_s=0.05), Phase(duration_s=1.0, impulse_Ns=1.0)), max_force_N=10.0,
        max_angle_rad=1e-4,
    )  # fmt: skip
    verification = verify(
        controller, {"swing": swing}, thor, scenarios=[scenario], draws={"swing": [thor.update(m=5.0)]}
    )
    assert len(verification.failures) == 2
    assert "F1 reaches" in verification.failures[1].reason and "the angle reaches" in verification.failures[1].reason
    assert "m = 5" in repr(verification)


def test_a_payload_arrives(controller, swing, thor):
    phases = (Phase(duration_s=0.2, force_N=30.0), Phase(duration_s=0.5, scale={"m": 2.0, "I_p": 2.0}))
    trace = play(Rig(controller=controller, plant=swing), Scenario(name="p", phases=phases), [thor])
    k = trace.edges[1]
    phi = trace.outputs["phi"][0]
    speed = (phi[k] - phi[k - 1]) / 1e-3
    potential = lambda m: m * 9.81 * 0.3 * (1 - np.cos(phi[k]))  # noqa: E731
    jump = trace.outputs["energy"][0, k] - trace.outputs["energy"][0, k - 1]
    assert jump == pytest.approx(0.5 * 0.36 * speed**2 + potential(4.0), rel=0.1)


def test_what_cannot_be_played_is_said(controller, stand, swing, thor):
    contact = Scenario(name="contact", phases=(Phase(duration_s=0.1, held=True), Phase(duration_s=0.5)))
    verification = verify(controller, {"swing": replace(swing, ports=())}, thor, scenarios=[contact])
    assert not verification.passed
    assert verification.skipped == (
        ("contact", "swing", "there is no plant with the same actuator and its link fixed"),
    )
    assert verify(controller, {"swing": swing}, thor, scenarios=[contact], partners={"swing": stand}).rows
    blow = Scenario(name="blow", phases=(Phase(duration_s=0.1, impulse_Ns=1.0),))
    with pytest.raises(ControlError, match="cannot be played"):
        play(Rig(controller=controller, plant=stand), blow, [thor])


@pytest.mark.parametrize(
    ("attempt", "words"),
    [
        (lambda c, p: verify(c, {}, p), "at least one"),
        (lambda c, p: verify(c, {"a": so.plants.high_impedance()}, p, draws={"b": []}), '"b"'),
        (lambda c, p: Phase(duration_s=0.0), "duration_s"),
        (lambda c, p: Phase(duration_s=1.0, held=True, impulse_Ns=1.0), "cannot be struck"),
        (lambda c, p: Phase(duration_s=1.0, scale={"m": 0.0}), "positive"),
        (lambda c, p: Scenario(name="x", phases=()), "no phases"),
        (lambda c, p: default_scenarios(replace(c, design=None), so.plants.high_impedance()), "design plant"),
        (lambda c, p: large_signal(c, so.plants.high_impedance(), p, amplitudes_N=(-1.0,)), "not positive"),
        (lambda c, p: large_signal(c, so.plants.high_impedance(), p, frequencies_hz=(9.0, 5.0)), "rise"),
    ],
)
def test_bad_input(controller, thor, attempt, words):
    with pytest.raises(ControlError, match=words):
        attempt(controller, thor)


def test_what_a_missing_current_limit_leaves_out_is_said(controller, stand, swing, thor):
    free = replace(controller, spec=replace(controller.spec, current_limit_A=None))
    verification = verify(free, {"stand": stand}, thor)
    assert [skipped[:2] for skipped in verification.skipped] == [(name, "stand") for name in list_left_out(free, stand)]
    assert list_left_out(free, stand) == ("saturating doublet", "saturating hold")
    assert list_left_out(free, swing) == ("saturating doublet",)
    assert "saturating hold on stand, nothing saturates without a limit of the command" in " ".join(
        repr(verification).split()
    )


def test_a_trace_is_printed_short(verification):
    text = repr(verification.replay(verification.rows[0]))
    assert text.startswith("Playback of 1 run of ")
    assert len(text) < 400 and "\n" not in text and "array" not in text


def test_scenarios_of_other_plants(controller, thor):
    """A mass and the numbered pendulum of two_link, behind a load cell: blows, payloads, falls and contacts too."""
    for link, payload, parts in (("mass", "m_2", ("load_cell",)), ("pendulum", "I_p2", ())):
        plant = so.plants.two_link("fixed", link, parts=parts)
        held = so.plants.two_link("fixed", "fixed", parts=parts)
        names = {item.name: item for item in default_scenarios(controller, plant)}
        assert {"impact", "payload", "contact"} <= set(names)
        assert payload in names["payload"].phases[1].scale
        chosen = [names["impact"], names["contact"]]
        verification = verify(controller, {"plant": plant}, thor, scenarios=chosen, partners={"plant": held})
        assert [row.scenario for row in verification.rows] == ["impact", "contact"]


def test_noise_is_no_limit_cycle_and_ringing_neither():
    rng = np.random.default_rng(0)
    t = np.arange(2000) * 1e-3
    coloured = np.convolve(rng.normal(size=2000), np.exp(-np.arange(60) / 10), mode="same")
    assert find_oscillation(coloured, 1e-3, floor=0.1, lowest_hz=5.0) is None
    ringing = find_oscillation(np.exp(-3 * t) * np.sin(2 * np.pi * 31 * t), 1e-3, floor=1e-3, lowest_hz=5.0)
    assert ringing is None or not (ringing.sustained or ringing.growing)
    growing = find_oscillation(np.exp(2 * t) * np.sin(2 * np.pi * 31 * t), 1e-3, floor=1e-3, lowest_hz=5.0)
    assert growing is not None and growing.growing
    swaying = 50 * np.sin(2 * np.pi * 0.9 * t + 1) + 0.5 * np.sin(2 * np.pi * 47.3 * t)
    hidden = find_oscillation(swaying, 1e-3, floor=0.1, lowest_hz=4.0)
    assert hidden is not None and hidden.sustained
    assert hidden.frequency_hz == pytest.approx(47.3, abs=0.1)
    assert hidden.amplitude == pytest.approx(0.5, rel=0.02)


def test_the_sweep_is_linear_below_the_saturation_map_and_not_above(controller, stand, thor):
    sweep = large_signal(controller, stand, thor)
    linear = np.abs(controller.close(stand, thor).tracking(sweep.frequency_hz))
    above = sweep.amplitude_N[:, None] > sweep.onset_N
    clear = np.abs(sweep.amplitude_N[:, None] / sweep.onset_N - 1) > 0.01
    np.testing.assert_array_equal(sweep.saturated[clear], above[clear])
    size = np.abs(sweep.gain)
    np.testing.assert_allclose(size[~above], np.broadcast_to(linear, size.shape)[~above], rtol=2e-3)
    far = sweep.amplitude_N[:, None] > 1.5 * sweep.onset_N
    assert np.all(size[far] < np.broadcast_to(linear, size.shape)[far])
    assert sweep.bandwidth_hz[0] == pytest.approx(30.0, rel=0.01)
    assert sweep.bandwidth_hz[0] > sweep.bandwidth_hz[3] > sweep.bandwidth_hz[4]


def test_far_above_the_limit_the_current_is_a_square_wave(controller, stand, thor):
    """4/pi of the motor force at its limit, through the plant: what is left of any controller."""
    sweep = large_signal(controller, stand, thor, amplitudes_N=(2e4,), frequencies_hz=(40.0,))
    f = sweep.frequency_hz
    plant = np.abs(controller.plant(stand, thor).response(f))[0]
    expected = 4 / np.pi * 9.0 / controller.command.per_effort * plant
    assert np.abs(sweep.gain[0, 0]) * 2e4 == pytest.approx(expected, rel=0.02)


def test_a_chirp_needs_its_phase(controller, stand, thor):
    """The reference of a phase is its constant and its excitation, sample by sample."""
    phase = Phase(duration_s=0.5, force_N=7.0, excitation=(Chirp(amplitude=3.0, f0_hz=5.0, f1_hz=20.0),))
    trace = play(Rig(controller=controller, plant=stand), Scenario(name="c", phases=(phase,)), [thor])
    rise = np.log(4.0) / 0.5
    expected = 7 + 3 * np.sin(2 * np.pi * 5.0 / rise * np.expm1(rise * trace.time))
    np.testing.assert_allclose(trace.reference[0], expected, atol=1e-9)


def test_a_phase_that_does_not_fit_in_memory_is_refused():
    with pytest.raises(ControlError, match=r"phase: duration_s = 1e\+09 takes about .* GB of memory"):
        _build_reference(Phase(duration_s=1e9, force_N=1.0), 1e-3, np.random.default_rng(0))


def test_of_predictive_control_the_draw_that_cannot_be_simulated_is_named(stand, thor):
    """The nominal machine was named, whatever draw it was."""
    mpc = force_mpc(stand, thor, MPCSpec(current_limit_A=9.0, bandwidth_hz=20))
    stuck = thor.update(f_c=500.0, v_s=1e-9)
    scenarios = (Scenario(name="step", phases=(Phase(duration_s=0.2, force_N=20.0),)),)
    with pytest.raises(UnplayedError) as failed:
        verify(
            linear_controller(mpc),
            {"stand": stand},
            thor,
            draws={"stand": [thor, stuck]},
            plan=mpc,
            scenarios=scenarios,
        )
    assert failed.value.draw == "2"
    assert failed.value.parameters == {"f_c": 500.0, "v_s": 1e-9}
