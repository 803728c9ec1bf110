"""Certificates of predictive control: its linear region by python-control, its limits by runs that are played again."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import control
import numpy as np
import pytest
from scipy.signal import cont2discrete

import seaopt as so
from seaopt.control import (
    Impedance,
    LinkFeedforward,
    MPCSpec,
    NoiseModel,
    add_impedance,
    close_loop,
    force_mpc,
    runnable,
)
from seaopt.errors import ControlError, FileError
from seaopt.files import seal, to_json
from seaopt.reporting.sections import judge
from seaopt.reporting.sections.data import Commands
from seaopt.robustness import Phase, Scenario, feed_link_forward, linear_controller, verify
from seaopt.robustness.certificate import constrained
from seaopt.robustness.certificate.linear_region import sweep_plans
from seaopt.robustness.verification import playback
from seaopt.robustness.verification.playback import play
from seaopt.robustness.verification.verification import make_rigs

TS = 1e-3
SPEED_LIMIT = {"qd": (-0.08, 0.08)}
HERE = {"J": (3.2e-6, 3.4e-6)}


@pytest.fixture(scope="module")
def mpc(stand, thor):
    spec = MPCSpec(current_limit_A=9.0, current_slew_A_per_s=2000.0, bandwidth_hz=20.0, bounds=SPEED_LIMIT)
    return force_mpc(stand, thor, spec)


@pytest.fixture(scope="module")
def certificate(mpc, stand, thor):
    return so.certify(mpc, {"stand": stand}, thor, ranges=HERE, samples=200, runs=2)


def find_ms(mpc, params, inertia):
    """Return Ms of the law on the stand with an inertia, by python-control."""
    v = {name: params[name].value for name in params} | {"J": inertia}
    r = v["l"] / (2 * np.pi * v["N_p"])
    mass, b = v["J"] / r**2, v["b_r"] / r**2
    a = np.array([[0.0, 1.0], [-v["k"] / mass, -b / mass]])
    plant = cont2discrete((a, np.array([[0.0], [1.0 / mass]]), np.array([[v["k"], 0.0]]), np.zeros((1, 1))), TS)[:3]
    back = control.ss(mpc.law.a, -mpc.law.b[:, 1:], mpc.law.c[None], -mpc.law.d[1], TS)
    z = np.exp(2j * np.pi * np.geomspace(0.01, 499.0, 4000) * TS)
    gain = (control.ss(*plant, 0, TS) * control.ss(control.tf([1.0], [1.0, 0.0], TS)) * back)(z)
    return np.max(np.abs(1.0 / (1.0 + gain)))


def test_the_linear_region_is_certified_as_a_law(certificate, mpc, thor):
    assert certificate.plants["stand"].ms == pytest.approx(find_ms(mpc, thor, thor["J"].value), rel=1e-3)
    ends = [find_ms(mpc, thor, inertia) for inertia in HERE["J"]]
    assert certificate.worst["stand"].ms == pytest.approx(max(ends), rel=2e-3)
    assert certificate.monte_carlo.samples == 200 and certificate.monte_carlo.failures == 0
    linear = linear_controller(mpc)
    assert linear.feasible == mpc.feasible and linear.spec.bandwidth_hz == mpc.spec.bandwidth_hz
    assert any("linear region" in note for note in certificate.notes)


@pytest.mark.parametrize("delay", [1, 2, 3])
@pytest.mark.parametrize("inertia", [2.8e-6, 3.3e-6, 3.9e-6])
def test_the_law_integrates_and_runs_whichever_side_of_the_unit_circle_rounding_leaves_its_pole(
    stand, thor, inertia, delay
):
    mpc = force_mpc(
        stand, thor.update(J=inertia), MPCSpec(current_limit_A=9.0, bandwidth_hz=20, compute_delay_samples=delay)
    )
    controller, f = linear_controller(mpc), np.geomspace(0.1, 499.0, 50)
    assert controller.law.integrators == 1 and runnable(controller).integrators == 1
    assert np.allclose(controller.law.responses(f), mpc.law.responses(f), rtol=1e-7)


def test_runs_that_keep_everything_pass_with_the_bound_of_clopper_and_pearson(certificate):
    runs = certificate.constrained
    assert certificate.passed and (runs.runs, runs.failures) == (2, 0)
    assert runs.failure_probability_bound == pytest.approx(1.0 - 1e-6 ** (1 / 2), rel=1e-9)  # no failure: (1 - p)^n
    assert 0.0 < runs.at_limit < 1.0  # the limits were active
    assert 0.0 < runs.iterations <= 100 and runs.largest_violation <= runs.bound_tolerance
    rows = {row.name: row for row in certificate.requirements}
    assert rows["constrained_failures"].met


def test_a_motor_much_stronger_than_its_model_fails_and_its_run_can_be_played_again(mpc, stand, thor):
    strong = {"K_tau": (1.45 * thor["K_tau"].value, 1.5 * thor["K_tau"].value)}
    failed = so.certify(mpc, {"stand": stand}, thor, ranges=strong, samples=1, runs=1, max_failure_probability=0.5)
    runs = failed.constrained
    assert not failed.passed and runs.failures == 1 and runs.failure_probability_bound == 1.0
    broken = {row.name for row in failed.requirements if not row.met}
    assert {"constrained_failures", "constrained_failure_probability"} <= broken
    assert runs.over_bound + runs.not_settled + runs.diverged == 1
    assert "fit K_tau or narrow" in runs.remedy and "qd" in runs.remedy and "max_iterations" not in runs.remedy
    assert judge(failed, Commands(certify="seaopt certify", tune="seaopt tune")).next[0].text.startswith(runs.remedy)
    torque = runs.parameters["K_tau"]
    run = close_loop(mpc.command, mpc.start, stand, thor.update(K_tau=torque), np.full(100, 2000.0))
    assert np.max(np.abs(run.state[:, 1])) > 1.05 * SPEED_LIMIT["qd"][1]


@pytest.mark.slow
def test_a_drives_delay_is_in_the_linear_region_in_the_runs_and_in_the_draws(stand, thor):
    """1.32 samples of it: the figures are those of the plan, and runs fail where they are drawn with ten."""
    spec = MPCSpec(current_limit_A=9.0, bandwidth_hz=20.0, drive_delay_s=1.32e-3)
    mpc = force_mpc(stand, thor, spec)
    near = so.certify(mpc, {"stand": stand}, thor, ranges={"drive_delay_s": (1.3e-3, 1.34e-3)}, samples=50, runs=1)
    assert near.passed
    assert near.plants["stand"].ms == pytest.approx(mpc.achieved.ms, rel=1e-9)
    assert not any("drive_delay_s is not drawn" in note for note in near.constrained.left_out)
    far = so.certify(mpc, {"stand": stand}, thor, ranges={"drive_delay_s": (0.01, 0.011)}, samples=1, runs=1)
    assert far.constrained.failures == 1 and "drive_delay_s" in far.constrained.parameters


def test_a_loop_with_more_delay_than_it_stands_diverges_or_does_not_settle(mpc, stand, thor):
    late = so.certify(mpc, {"stand": stand}, thor, ranges={"delay_s": (9e-3, 10e-3)}, samples=1, runs=1)
    assert late.constrained.failures == 1 and not late.passed
    assert late.constrained.diverged + late.constrained.not_settled == 1
    assert "fit delay_s or narrow" in late.constrained.remedy


def test_of_a_loop_that_rings_a_lower_bandwidth_is_asked_for(stand, thor, monkeypatch):
    """With nothing asked of where the force settles, as of a link that moves."""
    monkeypatch.setattr(constrained._PlantRun, "_judge_force", lambda *_: None)
    mpc = force_mpc(stand, thor, MPCSpec(current_limit_A=9.0, bandwidth_hz=20.0))
    late = so.certify(mpc, {"stand": stand}, thor, ranges={"delay_s": (6.5e-3, 6.6e-3)}, samples=1, runs=1).constrained
    assert late.ringing == 1 and late.remedy.startswith("a lower bandwidth_hz, or narrower ranges of delay_s")


def test_a_bound_that_noise_breaks_on_the_design_plant_itself_is_named_with_the_room_it_needs(stand, thor):
    spec = MPCSpec(current_limit_A=9.0, current_slew_A_per_s=2000.0, bandwidth_hz=20.0, bounds={"qd": (-0.05, 0.05)})
    tight = force_mpc(stand, thor, spec)
    runs = so.certify(
        tight, {"stand": stand}, thor, ranges=HERE, samples=1, runs=1, sensors=so.Sensors(noise_std={"F1": 3.0})
    ).constrained
    assert runs.over_bound == 1 and "on the design plant with its own parameters too" in runs.remedy
    low, high = (float(end) for end in runs.remedy.split("[")[1].split("]")[0].split(","))
    assert -high == pytest.approx(low) and high == pytest.approx(0.05 * (1 + runs.largest_violation), rel=0.2)


def test_iterations_are_named_where_a_run_has_no_plan(stand, thor):
    spec = MPCSpec(
        current_limit_A=9.0, current_slew_A_per_s=2000.0, bandwidth_hz=20.0, bounds={"qd": (-0.05, 0.05)},
        max_iterations=1,
    )  # fmt: skip
    runs = so.certify(force_mpc(stand, thor, spec), {"stand": stand}, thor, ranges=HERE, samples=1, runs=2).constrained
    assert runs.failures and runs.remedy.startswith("a larger max_iterations in [mpc]: ")


def simulate_rounded(mpc, params, force, quantum, seconds=1.0):
    """Return the force under a constant reference, its reading rounded, by the exact response of the stand."""
    v = {name: params[name].value for name in params}
    r = v["l"] / (2 * np.pi * v["N_p"])
    mass, b = v["J"] / r**2 + v["m_l"], v["b_r"] / r**2
    per_ampere = mpc.static_gain  # N at rest, of the spring: k q = gain I
    a = np.array([[0.0, 1.0], [-v["k"] / mass, -b / mass]])
    step, push = cont2discrete((a, np.array([[0.0], [per_ampere / mass]]), np.eye(2), np.zeros((2, 1))), TS)[:2]
    x, state, waiting, out = np.zeros(2), mpc.start, 0.0, []
    for _ in range(round(seconds / TS)):
        out.append(v["k"] * x[0])
        command, state = mpc.command(state, force, quantum * np.floor(out[-1] / quantum + 0.5) if quantum else out[-1])
        x, waiting = step @ x + push[:, 0] * waiting, command
    return np.array(out)


def test_a_law_reads_what_its_sensor_rounds(mpc, stand, thor):
    coarse = so.Sensors(quantisation={"F1": 5.0})
    run = close_loop(mpc.command, mpc.start, stand, thor, np.full(300, 777.0), sensors=coarse)
    np.testing.assert_allclose(run.force, simulate_rounded(mpc, thor, 777.0, 5.0, 0.3), atol=0.01)


@pytest.mark.slow
def test_a_law_whose_estimate_trusts_a_coarse_reading_rings_and_is_not_met(stand, thor):
    noise = NoiseModel(sensor_std={"F1": 0.002}, input_noise={"I": 0.05}, input_drift={"I": 0.05})
    spec = MPCSpec(current_limit_A=9.0, bandwidth_hz=50, noise=noise, max_sensitivity=False, max_complementary=False)
    mpc = force_mpc(stand, thor, spec)
    swings = {q: [np.ptp(simulate_rounded(mpc, thor, r, q)[-160:]) / 2 for r in (777.0, 1234.5)] for q in (0.0, 5.0)}
    assert max(swings[0.0]) < 0.01 and max(swings[5.0]) > 50.0
    coarse, options = so.Sensors(quantisation={"F1": 5.0}), {"ranges": HERE, "samples": 1, "runs": 6}
    found = so.certify(mpc, {"stand": stand}, thor, sensors=coarse, **options)
    runs = found.constrained
    assert not found.passed and 0 < runs.ringing <= runs.failures
    assert runs.largest_ring > 7.5 and f"{runs.largest_ring:.3g} N" in str(runs)
    assert runs.remedy.startswith("finer sensors") and "does not die out" in runs.text
    content = json.loads(to_json(found.to_dict()))
    again = so.Certificate.from_dict(content, found.controller, {"stand": stand}, thor, plan=mpc)
    assert again.constrained == runs and again.runs.rows == found.runs.rows
    ideal = so.certify(mpc, {"stand": stand}, thor, **options)
    assert ideal.passed and ideal.constrained.largest_ring < 0.01
    options |= {"runs": 1, "seed": 14}  # a run that swings half as much in the end as just before
    fading = so.certify(mpc, {"stand": stand}, thor, sensors=coarse, **options).constrained
    assert fading.ringing == 1 and fading.remedy.startswith("finer sensors")


def test_what_a_run_swings_is_its_peak(mpc, stand, thor):
    """By the simulation of this test, of other steps and with the quantum as coarse."""
    coarse = so.Sensors(quantisation={"F1": 20.0})
    runs = so.certify(mpc, {"stand": stand}, thor, ranges=HERE, samples=1, runs=3, sensors=coarse).constrained
    force = [simulate_rounded(mpc, thor, r, 20.0, 0.6)[-160:] for r in (777.0, 1234.5)]
    assert 0.0 < max(np.ptp(one) / 2 for one in force) <= runs.largest_ring


def test_devices_that_keep_a_run_from_settling_are_named(mpc, stand, thor):
    short = so.Sensors(saturation={"F1": 100.0})
    runs = so.certify(mpc, {"stand": stand}, thor, ranges=HERE, samples=1, runs=1, sensors=short).constrained
    assert runs.not_settled == 1 and "more range" in runs.remedy


def test_what_an_amplifier_rounds_reaches_the_steps_of_the_linear_region_too(mpc, stand, thor):
    rough = so.certify(mpc, {"stand": stand}, thor, ranges=HERE, samples=1, runs=1, command_step=2.0)
    assert all(rig.command_step == 2.0 for rig in rough.runs.rigs.values())
    assert 0.0 < rough.constrained.largest_ring < 0.5 * 2.0 * abs(mpc.static_gain)


@pytest.mark.slow
def test_of_friction_no_sensors_are_asked_for_that_no_step_would_have(stand, thor):
    rubbing = thor.update(f_c=20.0)
    law = force_mpc(stand, rubbing, MPCSpec(current_limit_A=9.0, bandwidth_hz=20))
    found = so.certify(
        law, {"stand": stand}, rubbing, ranges=HERE, samples=1, runs=1, sensors=so.Sensors(noise_std={"F1": 2.0})
    )
    assert not any("give certify(sensors" in note for note in found.notes)


def test_it_comes_back_from_its_file(certificate, mpc, stand, thor):
    content = json.loads(to_json(certificate.to_dict()))
    again = so.Certificate.from_dict(content, certificate.controller, {"stand": stand}, thor, plan=mpc)
    assert again.constrained == certificate.constrained and again.passed
    (row,) = (row for row in again.steps.rows if (row.scenario, row.draw) == ("50 % step", "nominal"))
    assert np.max(np.abs(again.steps.replay(row).current)) == row.peak_command


def test_steps_are_played_as_exported(certificate, mpc, stand, thor):
    """Each command is that of the plan's own step; of the largest its rate is at the slew limit, which no law of the
    linear region keeps.
    """
    rows = {row.scenario: row for row in certificate.steps.rows if row.draw == "nominal"}
    assert list(rows) == ["2 % step", "10 % step", "50 % step", "unsaturated step"]
    played = certificate.steps.replay(rows["50 % step"])
    state, currents = mpc.start, []
    for wanted, force in zip(played.reference[0], played.outputs["F1"][0], strict=True):
        current, state = mpc.command(state, wanted, force)
        currents.append(current)
    np.testing.assert_allclose(played.current[0], currents, atol=1e-9)
    slews = np.abs(np.diff(currents))
    assert np.max(slews) == pytest.approx(2000.0 * TS) and np.count_nonzero(slews > 1.99) > 1
    assert played.reference[0, -1] == pytest.approx(0.5 * 9.0 * abs(mpc.static_gain))
    alone = linear_controller(mpc)
    assert np.max(np.abs(runnable(alone).step(runnable(alone).reset(), played.reference[0, -1], 0.0)[0])) > 2.0


def test_steps_are_of_what_bounds_let_the_plan_hold(stand, thor):
    """800 N of 1,442 N that the limit of the command holds."""
    bound = 800.0 / thor["k"].value
    spec = MPCSpec(current_limit_A=9.0, bandwidth_hz=20.0, bounds={"spring_deflection": (-bound, bound)})
    steps = so.certify(force_mpc(stand, thor, spec), {"stand": stand}, thor, samples=1, runs=1).steps
    (row,) = (row for row in steps.rows if (row.scenario, row.draw) == ("50 % step", "nominal"))
    assert steps.met and steps.replay(row).reference[0, -1] == pytest.approx(400.0, rel=1e-6)


@pytest.mark.parametrize("prefilter", [None, "second_order"])
def test_a_plan_rests_where_a_step_begins(stand, swing, thor, prefilter):
    """At an angle the spring carries a part of the link's weight, and nothing moves, the link fed forward or not."""
    mpc = force_mpc(stand, thor, MPCSpec(current_limit_A=9.0, bandwidth_hz=20.0, prefilter=prefilter))
    for plan in (mpc, feed_link_forward(mpc, LinkFeedforward(), {"swing": (swing, thor)})):
        placed = thor.with_parameters(so.Parameter(name="phi", value=0.4, unit="rad"))
        (rig,) = make_rigs(linear_controller(plan), {"swing": swing}, None, 0.0, plan=plan).values()
        still = play(rig, Scenario(name="rest", phases=(Phase(duration_s=0.3),)), [placed])
        force, angle = still.outputs["F1"][0], still.outputs["phi"][0]
        weight = thor["m"].value * 9.81 * thor["L"].value * np.tan(0.4) / thor["L_a"].value
        assert abs(force[0]) == pytest.approx(weight, rel=1e-6)
        np.testing.assert_allclose(force, force[0], atol=1e-3)
        np.testing.assert_allclose(angle, 0.4, atol=1e-6)


def test_scenarios_that_no_plan_plays_are_refused(mpc, stand, swing, thor):
    """They were met: the blow with a peak of 0 N, the fall by the linear law."""
    law, plants = linear_controller(mpc), {"stand": stand, "swing": swing}
    named = r'and "impact", "payload", "fall through 90 deg" and "contact" hold, strike or load .*; leave them out'
    with pytest.raises(ControlError, match=named):
        verify(law, plants, thor, plan=mpc)
    rig = make_rigs(law, plants, None, 0.0, plan=mpc)["swing"]
    push = Phase(duration_s=0.1, force_N=5.0)
    for phase, state in (
        ({"impulse_Ns": 0.1}, {}),
        ({"scale": {"m": 2.0}}, {}),
        ({"held": True}, {}),
        ({}, {"phi": 1}),
    ):
        other = Scenario(name="other", phases=(push, replace(push, **phase)), initial_state=state)
        with pytest.raises(ControlError, match='"other" hold, strike or load the link, or begin elsewhere'):
            play(replace(rig, partner=stand), other, [thor])
    blow = Scenario(name="blow", phases=(push, replace(push, impulse_Ns=0.1)), on="free")
    played = verify(law, {"stand": stand}, thor, plan=mpc, scenarios=[Scenario(name="push", phases=(push,)), blow])
    assert [row.scenario for row in played.rows] == ["push"] and [each[0] for each in played.skipped] == ["blow"]


def test_a_file_is_read_with_the_plan_that_it_is_of_alone(certificate, mpc, stand, thor):
    """Without it, steps were replayed by the linear law; steps that an older seaopt played by that were taken."""
    content, law = certificate.to_dict(), certificate.controller
    read = partial(so.Certificate.from_dict, law=law, plants={"stand": stand}, parameters=thor)
    with pytest.raises(FileError, match=r"is of predictive control, .*; give plan="):
        read(content)
    older = json.loads(to_json(certificate.to_dict()))
    older["steps"]["rows"] = [row | {"scenario": "step"} for row in older["steps"]["rows"] if "2 %" in row["scenario"]]
    with pytest.raises(FileError, match=r'its steps \("step"\) are of the linear region, .*; certify again'):
        read(seal(older), plan=mpc)
    with pytest.raises(FileError, match=r"is of a law, and not of predictive control; leave out plan"):
        read(seal(json.loads(to_json(content)) | {"constrained": None}), plan=mpc)


def test_what_cannot_be_is_said_in_one_line(certificate, mpc, stand, thor):
    for options, said in (({"runs": 0}, "runs = 0"), ({"bound_tolerance": -1.0}, "bound_tolerance = -1")):
        with pytest.raises(ControlError, match=said):
            so.certify(mpc, {"stand": stand}, thor, **options)
    with pytest.raises(ControlError, match="predictive control is simulated by certify alone"):
        certificate.with_simulation()


@pytest.mark.parametrize("stiffness", [40.0, 0.0])
def test_runs_with_limits_active_have_the_outer_loop(monkeypatch, stiffness):
    """Each command is that of the plan, of the force that stiffness and damping ask where the link of the run was."""
    held, free = so.plants.rotary("locked"), so.plants.rotary()
    values = free.defaults.update(N=100.0, K_tau=0.0369, eta=0.7, J_m=2.4e-5, b_r=1e-4, k_s=300.0, J_l=0.25, d_l=0.3)
    mpc = force_mpc(held, values, MPCSpec(measured="tau_s", current_limit_A=8.0, bandwidth_hz=12, preview_samples=5))
    asked = Impedance(stiffness=stiffness, damping=2.0, velocity_filter_s=5e-3)
    mpc = replace(mpc, outer=add_impedance(linear_controller(mpc), free, values, asked, name="free").outer)
    runs, play = [], playback.close_loop
    monkeypatch.setattr(playback, "close_loop", lambda *a, **k: runs.append(play(*a, **k)) or runs[-1])
    checked = so.certify(mpc, {"free": free}, values, samples=2, runs=1)
    assert checked.constrained.failures == 0
    run = [run for run in runs if run.state.shape[1] == len(free.states)][-1]  # steps are played before
    places = run.state[:, list(free.states).index("theta_l")]
    assert np.ptp(places) > 0.1
    state, before, speed = mpc.start, places[0], 0.0
    for wanted, place, torque, current in zip(run.reference, places, run.force, run.current, strict=True):
        speed, before = (5e-3 * speed + place - before) / (5e-3 + TS), place
        command, state = mpc.command(state, wanted - stiffness * place - 2.0 * speed, torque)
        assert command == pytest.approx(current, abs=1e-9)


@pytest.mark.parametrize("stiffness", [40.0, 0.0])
def test_a_row_of_a_sweep_has_the_outer_loop(stiffness):
    """Ms of all that is fed back, force and motion of the link, by python-control's sampled plants."""
    held, free = so.plants.rotary("locked"), so.plants.rotary()
    values = free.defaults.update(N=100.0, K_tau=0.0369, eta=0.7, J_m=2.4e-5, b_r=1e-4, k_s=300.0, J_l=0.25, d_l=0.3)
    mpc = force_mpc(held, values, MPCSpec(measured="tau_s", current_limit_A=8.0, bandwidth_hz=12))
    asked = Impedance(stiffness=stiffness, damping=2.0, velocity_filter_s=5e-3)
    mpc = replace(mpc, outer=add_impedance(linear_controller(mpc), free, values, asked, name="free").outer)
    (row,) = sweep_plans([mpc], {"free": free}).rows
    law, z = mpc.unlimited(), np.exp(2j * np.pi * np.geomspace(0.05, 499.0, 40_000) * TS)
    states = np.linalg.solve(z[:, None, None] * np.eye(len(law.a)) - law.a, np.tile(law.b, (z.size, 1, 1)))
    c_r, c_y = (states.transpose(0, 2, 1) @ law.c + law.d).T
    speed = (1.0 - 1.0 / z) / (5e-3 + TS - 5e-3 / z)
    ms = {}
    for name, plant in (("design plant", held), ("free", free)):
        model = plant.linearize(values)
        force = control.sample_system(model["tau_s", "I"], TS, "zoh")(z) / z
        back = 0.0
        if plant is free:
            back = control.sample_system(model["theta_l", "I"], TS, "zoh")(z) / z * c_r * (stiffness + 2.0 * speed)
        ms[name] = np.max(np.abs(1.0 / (1.0 - force * c_y + back)))
    worst = max(ms, key=ms.get)
    assert row.ms == pytest.approx(ms[worst], rel=1e-3) and row.ms_plant == worst
