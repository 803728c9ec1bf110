"""Acceptance of schedules and of predictive control: the exported C on a machine that shares nothing with seaopt."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import (
    LawState,
    MPCSpec,
    PlausibilityGate,
    ScheduledController,
    force_mpc,
    runnable,
    tune_schedule,
)
from seaopt.control.laws.structures import Gains
from seaopt.control.loops.compensation.link_feedforward import LinkPath
from seaopt.control.loops.compensation.terms import Compensation, FrictionTerm, GravityTerm
from seaopt.control.running.law_step import run_law
from seaopt.formatting import format_number
from seaopt.machine.design_run import run_design
from seaopt.machine.page.verdict import judge
from seaopt.machine.stepped import Setting, limit_law
from seaopt.machine.ticks import Ticks
from seaopt.machine.wording import say_cause
from seaopt.reporting.sections.data import Commands
from tests.machine.simulator import Bench, Machine, multisine
from tests.machine.test_response import LINES, REFERENCE, respond

STAND, THOR = so.plants.high_impedance(), so.plants.thor()
SOFT = replace(Machine(), stiffness=5.5e5)


@pytest.fixture(scope="module")
def schedule():
    spec = so.ControllerSpec(bandwidth_hz=25, max_sensitivity=1.6, current_limit_A=9.0)
    return tune_schedule(STAND, THOR, spec, "k", [5e5, 8e5])


@pytest.fixture(scope="module")
def scheduled(compiler, tmp_path_factory, schedule):
    return Bench(compiler, tmp_path_factory.mktemp("schedule"), schedule)


def test_a_schedule_is_judged_where_its_variable_stood(schedule, scheduled):
    log = scheduled.log(SOFT, REFERENCE, places=np.full(REFERENCE.size, 5.5e5)).between(0.3, 9.9)
    result = so.accept(schedule, [log])
    assert result.met and result.place == ("k", 5.5e5, "N/m") and result.differences.misfit < 2.0, result
    assert result.controller.spec == schedule.at(5.5e5).spec
    noiseless = so.accept(schedule, [scheduled.log(SOFT, REFERENCE, noise=0.0, places=np.full(REFERENCE.size, 5.5e5))])
    (part,) = noiseless.response.measured
    loop, _ = respond(SOFT, part.f, schedule.at(5.5e5), 1)
    assert np.allclose(part.loop.value, loop, rtol=1e-4)
    stiff = so.accept(schedule, [scheduled.log(Machine(), REFERENCE, places=np.full(REFERENCE.size, 5.5e5))])
    assert stiff.replayed and not stiff.met and stiff.differences.found[0].name == "k", stiff


@pytest.mark.parametrize("ramp", [False, True])
def test_a_log_that_begins_in_the_middle_of_a_move_is_of_the_schedule(schedule, scheduled, compiler, tmp_path, ramp):
    """The state at its first row is told at the places of the rows after it, not at the middle of all places."""
    n = REFERENCE.size
    places = np.linspace(5e5, 8e5, n) if ramp else 6.5e5 + 1.4e5 * np.sin(2e-3 * np.arange(n))
    (row,) = so.accept(
        schedule, [scheduled.log(Machine(), REFERENCE, places=places, decimals=3).between(0.3, 9.9)]
    ).replays
    assert row.met, row
    bench = Bench(compiler, tmp_path, edit(schedule, {"k_p": [1.25, 1.0]}))
    (row,) = so.accept(schedule, [bench.log(Machine(), REFERENCE, places=places, decimals=3).between(0.3, 9.9)]).replays
    first = row.causes[0]
    assert not row.met and first.explains and (first.what, first.edited.points) == ("k_p", (5e5,)), row
    assert first.edited.factor == pytest.approx(1.25, rel=0.01)


def test_a_schedule_whose_variable_moves_is_replayed_and_has_no_response(schedule, scheduled):
    places = np.linspace(5e5, 8e5, REFERENCE.size)
    result = so.accept(schedule, [scheduled.log(Machine(), REFERENCE, places=places, decimals=2)])
    assert result.replayed and result.response is None and "hold it at a value" in result.left_out["bench"]


@pytest.mark.parametrize(
    ("given", "kind", "value"), [(5e5, "place", 5e5), (8e5, "place", 8e5), (5.5e8, "place", 8e5), (6.0e2, "place", 5e5)]
)
def test_a_schedule_that_was_given_another_place_is_named(schedule, scheduled, given, kind, value):
    log = scheduled.log(SOFT, REFERENCE, places=np.full(REFERENCE.size, given))
    log = so.Log.from_arrays(
        **{name: log[name] for name in ("reference", "I", "F1")}, time=log.time, k=np.full(REFERENCE.size, 6.5e5)
    )
    (row,) = so.accept(schedule, [log]).replays
    assert (row.causes[0].kind, row.causes[0].what, row.causes[0].value) == (kind, "k", value)


@pytest.mark.parametrize("decimals", [3, None])
def test_a_schedule_that_was_given_a_value_between_its_points_is_named_with_it(schedule, scheduled, decimals):
    log = scheduled.log(SOFT, REFERENCE, places=np.full(REFERENCE.size, 6.2e5), decimals=decimals)
    (row,) = so.accept(schedule, [replace_place(log, np.full(REFERENCE.size, 6.5e5))]).replays
    cause = row.causes[0]
    assert cause.kind == "place" and cause.explains and cause.value == pytest.approx(6.2e5, rel=1e-3), row
    assert not row.met and f"the law was given {cause.value:.4g} N/m as k" in say_cause(cause, "I")


def test_a_moving_variable_that_was_logged_with_an_offset_is_named_with_it(schedule, scheduled):
    places = 6.4e5 + 1e5 * np.sin(2e-3 * np.arange(REFERENCE.size))
    log = scheduled.log(SOFT, REFERENCE, places=places, decimals=3)
    (row,) = so.accept(schedule, [replace_place(log, places - 3e4)]).replays
    cause = row.causes[0]
    assert cause.kind == "shift" and cause.explains and cause.value == pytest.approx(3e4, rel=1e-2), row
    assert "N/m added to what was logged" in say_cause(cause, "I")


@pytest.mark.parametrize(
    ("factor", "decimals", "moving"),
    [(1.01, 2, False), (1.02, 1, False), (1.02, 2, False), (1.02, 2, True), (1.05, 2, True)],
)
def test_a_factor_is_not_taken_for_another_place(schedule, scheduled, factor, decimals, moving):
    """With coarse digits a fitted place explains it, too, and leaves more."""
    wave = 1e5 * np.sin(2e-3 * np.arange(REFERENCE.size)) * moving
    log = scheduled.log(SOFT, REFERENCE, places=6.2e5 + wave, decimals=decimals)
    columns = {"reference": log["reference"], "F1": log["F1"], "I": factor * log["I"], "k": 6.2e5 + wave}
    (row,) = so.accept(schedule, [so.Log.from_arrays(time=log.time, **columns)]).replays
    assert not row.met and row.causes[0].what == "I" and row.causes[0].value == pytest.approx(factor, abs=2e-3), row


def test_a_factor_that_coarse_digits_do_not_tell_from_another_place_is_named_beside_it(schedule, scheduled):
    places = 6.2e5 + 1e5 * np.sin(2e-3 * np.arange(REFERENCE.size))
    log = scheduled.log(SOFT, REFERENCE, places=places, decimals=2)
    columns = {"reference": log["reference"], "F1": log["F1"], "I": 1.01 * log["I"], "k": places}
    result = so.accept(schedule, [so.Log.from_arrays(time=log.time, **columns)])
    (reason,) = (each.what for each in judge(result, Commands()).reasons if "should be" in each.what)
    said = re.search(r"I is ([\d.]+) times what it should be", reason)
    assert said and float(said[1]) == pytest.approx(1.01, abs=2e-3) and "the log does not tell them apart" in reason
    assert "the law was given k with" in reason and "added to what was logged" in reason


def replace_place(log, places):
    return so.Log.from_arrays(**{name: log[name] for name in ("reference", "I", "F1")}, time=log.time, k=places)


def test_a_schedule_at_exactly_zero_is_not_taken_at_its_fallback(schedule):
    zeros = np.zeros(100)
    columns = dict.fromkeys(("reference", "command", "place"), zeros)
    ticks = Ticks(source="log", rate_hz=1e3, measured=zeros[:, None], further=np.zeros((100, 0)), **columns)
    law = schedule.runnable()
    setting = Setting(controller=schedule.at(5e5), law=law, ticks=ticks)
    assert np.array_equal(setting.linear.d_measurement, law.freeze(0.0, None).d_measurement)
    assert not np.array_equal(setting.linear.d_measurement, law.freeze(law.fallback, None).d_measurement)


def test_where_a_schedule_stood_is_said_or_asked_for(schedule, scheduled):
    log = scheduled.log(SOFT, REFERENCE, places=np.full(REFERENCE.size, 5.5e5))
    bare = so.Log.from_arrays(**{name: log[name] for name in ("reference", "I", "F1")}, time=log.time)
    assert so.accept(schedule, [bare], at=5.5e5).replayed
    with pytest.raises(so.SeaoptError, match="--at VALUE"):
        so.accept(schedule, [bare])
    with pytest.raises(so.SeaoptError, match="from 500000 to 800000"):
        so.accept(schedule, [bare], at=0.55)
    other = scheduled.log(SOFT, REFERENCE, places=np.full(REFERENCE.size, 7e5))
    with pytest.raises(so.SeaoptError, match="by themselves"):
        so.accept(schedule, [log, other])
    with pytest.raises(so.SeaoptError, match="not scheduled"):
        so.accept(schedule.at(6e5), [bare], at=6e5)


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("limited", [True, False])
def test_a_law_steps_over_a_log_as_by_itself(monkeypatch, schedule, compiled, limited):
    if not compiled:
        monkeypatch.setattr("seaopt.control.running.law_step._load_kernel", lambda _: None)
    rng, n = np.random.default_rng(1), 700
    r, y = (2000.0 * rng.normal(size=n) for _ in range(2))
    limit, place = 9.0 if limited else np.inf, 6e5
    law = limit_law(schedule.runnable(), limit)
    commands = run_law(law, r, y[:, None], np.zeros((n, 0)), np.full(n, place), law.reset(place=place))
    state, expected = law.reset(place=place), np.empty(n)
    for k in range(n):
        expected[k], state = law.step(state, r[k], y[k], place)
    np.testing.assert_allclose(commands, expected, rtol=0.0 if limited else 1e-12, atol=1e-12)
    frozen = law.freeze(place)
    at_rest = LawState(x=np.zeros(frozen.c.size))
    np.testing.assert_allclose(run_law(frozen, r, y[:, None], np.zeros((n, 0)), None, at_rest), expected, atol=1e-11)
    assert bool(np.max(np.abs(expected)) <= 9.0) is limited
    alone = runnable(schedule.at(place), command_limit=limit)
    np.testing.assert_allclose(alone.run(r, y)[0], expected, atol=1e-11)


@pytest.fixture(scope="module")
def planned(compiler, tmp_path_factory):
    mpc = force_mpc(STAND, THOR, MPCSpec(current_limit_A=9.0, bandwidth_hz=20))
    return Bench(compiler, tmp_path_factory.mktemp("mpc"), mpc)


SHORT = multisine(1000, LINES, 4, 60.0, 3, bias=300.0)


@pytest.mark.slow
def test_predictive_control_is_replayed_and_judged_and_its_fault_is_named(planned):
    mpc = planned.controller
    log = planned.log(Machine(), SHORT)
    right = so.accept(mpc, [log.between(0.7, 4.0)])
    assert right.replayed and right.replays[0].mismatch < 1e-6, right
    response = so.accept(mpc, [log]).response
    loop, _ = respond(Machine(), response.measured[0].f, right.controller, mpc.compute_delay_samples)
    centre, radius = response.measured[0].loop.disc(0.05)
    assert np.mean(np.abs(centre - loop) <= radius) > 0.8
    half = so.accept(mpc, [planned.log(Machine(law_gain=0.5), SHORT[:1000])])
    assert (half.replays[0].causes[0].kind, half.replays[0].causes[0].what) == ("factor", "I")


def test_predictive_control_at_its_limits_is_replayed(planned):
    jump = np.where(np.arange(800) % 400 < 200, 0.0, 2400.0)
    log = planned.log(Machine(), jump)
    (row,) = so.accept(planned.controller, [log]).replays
    assert row.met and row.saturated > 0.02 and row.largest < 1e-6


@pytest.mark.parametrize("limited", [False, True])
def test_a_weight_beside_predictive_control_is_replayed_and_missed(planned, limited, compiler, tmp_path):
    """Its C adds the weight of what is read; where that is left out, the log is of another law."""
    weight = GravityTerm(coefficients=(4.0, 150.0), low=-1e-3, high=1e-3, reads="q", unit="m", fraction=1.0)
    mpc = replace(
        planned.controller, compensation=Compensation(sample_time_s=planned.controller.sample_time_s, gravity=weight)
    )
    reference = np.where(np.arange(480) % 240 < 120, 0.0, 2400.0) if limited else SHORT[:600]
    log = Bench(compiler, tmp_path, mpc).log(Machine(), reference)
    (row,) = so.accept(mpc, [log]).replays
    assert row.met and row.largest < 1e-6 and (row.saturated > 0.02) is limited
    force = planned.log(Machine(), reference)
    without = so.Log.from_arrays(
        time=force.time,
        source="bench",
        reference=force["reference"],
        F1=force["F1"],
        I=force["I"],
        q=force["F1"] / 655e3,
    )
    (row,) = so.accept(mpc, [without]).replays
    assert not row.met and (row.causes[0].kind, row.causes[0].what) == ("compensation", "gravity"), row.causes
    assert row.causes[0].explains
    lower = limit_law(mpc, 4.5)
    assert lower.command_limit == 4.5 and lower.compensation.gravity == weight


def test_a_link_fed_forward_beside_predictive_control_is_replayed_and_missed(planned, compiler, tmp_path):
    numbers = {"inertia": 100.0, "damping": 4e3, "fraction": 0.4, "corner_hz": 20.0, "high_pass_hz": 2.0}
    path = LinkPath(measured="q", unit="m", is_speed=False, **numbers)
    mpc = replace(planned.controller, link=path)
    log = Bench(compiler, tmp_path, mpc).log(Machine(), SHORT[:1000])
    (row,) = so.accept(mpc, [log]).replays
    assert row.met and row.largest < 1e-6
    force = planned.log(Machine(), SHORT[:1000])
    columns = {name: force[name] for name in ("reference", "F1", "I")} | {"q": force["F1"] / 655e3}
    (row,) = so.accept(mpc, [so.Log.from_arrays(time=force.time, source="bench", **columns)]).replays
    assert not row.met and (row.causes[0].kind, row.causes[0].what) == ("feedforward", "link"), row.causes
    assert row.causes[0].explains and limit_law(mpc, 4.5).link == path


def test_of_two_terms_beside_predictive_control_the_one_left_out_is_named(planned, compiler, tmp_path):
    """Each reads an output of its own: without the first, the second is given its own still."""
    period = planned.controller.sample_time_s
    weight = GravityTerm(coefficients=(4.0, 150.0), low=-1e-3, high=1e-3, reads="q", unit="m", fraction=1.0)
    steady = {"effort": 20.0, "speed": 1.0, "speed_unit": "m/s", "fraction": 1.0, "velocity_per_rate": 1e-3}
    rubbing = FrictionTerm(source="speed", reads="F2", **steady)
    mpc = replace(planned.controller, compensation=Compensation(sample_time_s=period, gravity=weight))
    log = Bench(compiler, tmp_path, mpc).log(Machine(), SHORT[:1000])
    both = replace(mpc, compensation=replace(mpc.compensation, friction=rubbing))
    assert both.reads == ("F2", "q")
    columns = {name: log[name] for name in ("reference", "F1", "I", "q")}
    columns["F2"] = np.cumsum(np.random.default_rng(1).normal(size=1000))
    (row,) = so.accept(both, [so.Log.from_arrays(time=log.time, source="bench", **columns)]).replays
    assert not row.met and (row.causes[0].kind, row.causes[0].what) == ("compensation", "friction"), row.causes
    assert row.causes[0].explains


@pytest.mark.slow
def test_older_predictive_control_is_named_where_it_is_at_its_limits(planned, compiler, tmp_path):
    """Its linear law would not do there."""
    older = force_mpc(STAND, THOR, MPCSpec(current_limit_A=9.0, bandwidth_hz=15))
    jump = np.where(np.arange(800) % 400 < 200, 0.0, 2400.0)
    log = Bench(compiler, tmp_path, older).log(Machine(), jump)
    (row,) = so.accept(planned.controller, [log], others={"old/controller.json": older}).replays
    assert row.saturated > 0.02 and not row.met
    assert (row.causes[0].kind, row.causes[0].what) == ("another law", "old/controller.json") and row.causes[0].explains
    right = planned.log(Machine(), jump)
    assert so.accept(planned.controller, [right], others={"old/controller.json": older}).replayed


@pytest.mark.slow
def test_a_gate_of_predictive_control_that_tripped_is_named(planned):
    """Its sensor fails in a row, and stays."""
    gate = PlausibilityGate(range_N=(-1500.0, 1500.0), max_step_N=1000.0, max_held=3, ramp_per_s=50.0)
    gated, first = replace(planned.controller, gate=gate), 2500
    log = planned.log(Machine(), SHORT)
    force = np.where(np.arange(len(log)) < first, log["F1"], 9000.0)
    state, current = gated.start, np.empty(len(log))
    for k, (goal, read) in enumerate(zip(log["reference"].tolist(), force.tolist(), strict=True)):
        step = gated.step(state, goal, read)
        current[k], state = step.command, step.state
    assert np.allclose(current[:first], log["I"][:first], atol=1e-6) and np.all(current[first + 500 :] == 0.0)
    taken = so.Log.from_arrays(time=log.time, source="bench", reference=log["reference"], F1=force, I=current)
    result = so.accept(gated, [taken])
    (row,) = result.replays
    assert row.met and (row.trip.row, row.trip.readings, row.trip.why) == (first, 4, "range")
    assert "the gate tripped at" in " ".join(repr(result).split())


def refuse(fraction):
    raise so.SeaoptError("no slower law")


def test_a_schedule_is_brought_up_with_less_effort_then_at_each_point(schedule, compiler, tmp_path):
    from seaopt.machine.bringup.files import write_bring_up

    certified = []

    def certify(law):  # all of a schedule's certificate takes ten seconds
        certified.append(law)
        return so.certify(law.at(5e5), {"stand": STAND}, THOR, samples=5, simulations=False)

    options = {"fractions": (0.5,), "limits": {"F1": 900.0}, "certify_stage": certify, "tune_stage": refuse}
    plan = so.bring_up(schedule, {"stand": STAND}, THOR, **options)
    assert [(stage.name, stage.place) for stage in plan.stages] == [("stage_1", 5e5), ("full_1", 5e5), ("full_2", 8e5)]
    first, _, last = plan.stages
    assert first.controller.command_limit == 4.5 and last.controller.command_limit == 9.0
    assert certified == [first.source, schedule] and "k" in last.channels
    write_bring_up(plan, tmp_path)
    assert (tmp_path / "full_2" / "force_law.c").is_file() and "Keep k at 8" in " ".join(str(plan).split())
    bench = Bench(compiler, tmp_path / "bench", schedule)
    reference = last.excitation.reference
    stiff = replace(Machine(), stiffness=8e5)
    log = bench.log(stiff, reference, places=np.full(reference.size, 8e5))
    assert so.accept(schedule, [log]).met
    assert np.max(np.abs(log["I"])) < last.stop["I"] and np.max(np.abs(log["F1"])) < last.stop["F1"]


@pytest.mark.slow
def test_predictive_control_is_brought_up_with_less_effort(planned, tmp_path):
    from seaopt.machine.bringup.files import write_bring_up
    from seaopt.robustness import linear_controller

    mpc = planned.controller

    def certify(law):  # all of a plan's certificate takes a minute
        return so.certify(linear_controller(law), {"stand": STAND}, THOR, samples=5, simulations=False)

    options = {"fractions": (0.5,), "limits": {"F1": 900.0}, "certify_stage": certify, "tune_stage": refuse}
    plan = so.bring_up(mpc, {"stand": STAND}, THOR, **options)
    first, full = plan.stages
    assert first.source.command_limit == 4.5 and full.source is mpc
    write_bring_up(plan, tmp_path)
    assert (tmp_path / "stage_1" / "force_mpc.h").is_file()
    log = planned.log(Machine(), full.excitation.reference)
    assert so.accept(mpc, [log]).replayed and np.max(np.abs(log["I"])) < full.stop["I"]


def test_an_older_gain_table_is_named_by_its_file(schedule, scheduled, compiler, tmp_path):
    """As `seaopt accept` reads it from the folder, without its plant."""
    older = tune_schedule(STAND, THOR, replace(schedule.controllers[0].spec, bandwidth_hz=20), "k", [5e5, 8e5])
    read = ScheduledController.read(older.to_dict())
    places = np.linspace(5e5, 8e5, REFERENCE.size)
    log = Bench(compiler, tmp_path, older).log(Machine(), REFERENCE, places=places, decimals=2)
    (row,) = so.accept(schedule, [log], others={"old/controller.json": read}).replays
    assert not row.met and row.causes[0].explains
    assert (row.causes[0].kind, row.causes[0].what) == ("another law", "old/controller.json")
    right = scheduled.log(Machine(), REFERENCE, places=places)
    assert so.accept(schedule, [right], others={"old/controller.json": read}).replayed


def test_an_older_gain_table_is_named_in_a_log_of_every_second_tick(schedule, compiler, tmp_path):
    older = tune_schedule(STAND, THOR, replace(schedule.controllers[0].spec, bandwidth_hz=20), "k", [5e5, 8e5])
    read = ScheduledController.read(older.to_dict())
    places = np.full(REFERENCE.size, 5.5e5)
    log = Bench(compiler, tmp_path, older).log(SOFT, REFERENCE, places=places)
    columns = {name: log[name][2:-2:2] for name in ("reference", "F1", "I", "k")}
    log = so.Log.from_arrays(time=log.time[2:-2:2], **columns)
    (row,) = so.accept(schedule, [log], others={"old/controller.json": read}).replays
    assert row.ticks_per_row == 2 and not row.met and row.causes[0].explains
    assert (row.causes[0].kind, row.causes[0].what) == ("another law", "old/controller.json")


def test_a_cascade_is_replayed_and_another_set_of_its_gains_is_named():
    plant = so.plants.rotary(link="locked")
    stated = {"N": 100, "K_tau": 0.0369, "eta": 0.7, "J_m": 2.4e-5, "b_r": 1e-4, "k_s": 300.0}
    values = plant.complete(so.ParameterSet()).update(**stated)
    measured = ("tau_s", "thetad_m")
    spec = so.ControllerSpec(bandwidth_hz=20, structure="cascade", measured=measured, current_limit_A=9.0)
    law = so.tune(plant, values, spec)
    reference = multisine(1000, LINES, 6, 1.0, 3, bias=2.0)

    def play(law):
        run = run_design(law, [values], reference)
        columns = {name: run.outputs[name][0][:-1] for name in law.signals} | {"reference": reference[:-1]}
        # The command of a row is put out in the next one.
        return so.Log.from_arrays(time=1e-3 * np.arange(reference.size - 1), I=run.current[0][1:], **columns)

    (row,) = so.accept(law, [play(law)]).replays
    assert row.met and row.command_late == 0 and row.mismatch < 1e-9
    gains = law.read_gains()
    other = replace(
        gains, k_p=0.7 * gains.k_p, k_i=1.3 * gains.k_i, inner=replace(gains.inner, k_v=0.8 * gains.inner.k_v)
    )
    made = replace(law, law=other.law("cascade", 1e-3).balanced(), gains=other.by_name())
    (row,) = so.accept(law, [play(made)]).replays
    assert (row.causes[0].kind, row.causes[0].explains) == ("gains", True)
    assert row.causes[0].gains == pytest.approx(other.by_name(), rel=1e-4)


def edit(schedule, factors):
    """Return the schedule with gains of its table times factors, by name one for each point."""
    controllers = []
    for i, each in enumerate(schedule.controllers):
        gains = {name: value * factors.get(name, (1.0, 1.0))[i] for name, value in each.gains.items()}
        law = Gains.from_names(gains).law(each.spec.structure, each.sample_time_s).balanced()
        controllers.append(replace(each, gains=gains, law=law))
    return replace(schedule, controllers=tuple(controllers))


@pytest.mark.parametrize(
    ("factors", "points", "gains"),
    [
        ({"k_p": [1.0, 1.3]}, [8e5], {"k_p": 1.3}),
        ({"k_i": [0.8, 1.0]}, [5e5], {"k_i": 0.8}),
        ({"T_f": [2.0, 1.0]}, [5e5], {"T_f": 2.0}),
        ({"k_d": [1.2, 1.2]}, [5e5, 8e5], {"k_d": 1.2}),
        ({name: [1.0, 0.7] for name in ("k_p", "k_i", "k_d", "k_r")}, [8e5], None),
        ({"k_p": [1.0, 0.7], "k_i": [1.0, 1.4], "k_d": [1.0, 1.1]}, [8e5], {"k_p": 0.7, "k_i": 1.4, "k_d": 1.1}),
    ],
)
def test_an_edited_gain_of_a_table_is_named_with_its_point_and_factor(
    schedule, compiler, tmp_path, factors, points, gains
):
    places = 6.5e5 + 1.4e5 * np.sin(2e-3 * np.arange(REFERENCE.size))
    log = Bench(compiler, tmp_path, edit(schedule, factors)).log(Machine(), REFERENCE, places=places, decimals=3)
    (row,) = so.accept(schedule, [log]).replays
    first = row.causes[0]
    assert not row.met and first.explains and first.edited is not None, row
    assert list(first.edited.points) == points and (first.edited.over, first.edited.unit) == ("k", "N/m")
    if gains is None:
        assert first.kind == "gains" and first.edited.factor == pytest.approx(0.7, rel=0.01)
    elif len(gains) == 1:
        ((name, factor),) = gains.items()
        assert (first.kind, first.what) == ("gain", name) and first.edited.factor == pytest.approx(factor, rel=0.01)
    else:
        found = {name: first.gains[name] / first.exported[name] for name in first.gains}
        assert first.kind == "gains" and found == pytest.approx(dict.fromkeys(found, 1.0) | gains, rel=0.01)
    said = "at all points of k" if len(points) > 1 else f"at k = {format_number(points[0])} N/m"
    assert said in say_cause(first, "I")


@pytest.mark.parametrize(
    ("factors", "pair"),
    [
        ({"k_p": [1.0, 1.3], "k_i": [0.8, 1.0]}, {"k_p": (1.3, [8e5]), "k_i": (0.8, [5e5])}),
        ({"k_p": [0.8, 0.8], "k_d": [1.3, 1.3]}, {"k_p": (0.8, None), "k_d": (1.3, None)}),
        ({"k_i": [1.5, 1.5], "k_p": [1.0, 0.9]}, {"k_i": (1.5, None), "k_p": (0.9, [8e5])}),
        ({"T_f": [1.5, 1.5], "k_p": [1.25, 1.0]}, {"T_f": (1.5, None), "k_p": (1.25, [5e5])}),
    ],
)
def test_two_edited_gains_of_a_table_are_named_each_with_its_points_and_factor(
    schedule, compiler, tmp_path, factors, pair
):
    places = 6.5e5 + 1.4e5 * np.sin(2e-3 * np.arange(REFERENCE.size))
    log = Bench(compiler, tmp_path, edit(schedule, factors)).log(Machine(), REFERENCE, places=places, decimals=3)
    (row,) = so.accept(schedule, [log]).replays
    first = row.causes[0]
    assert not row.met and first.explains and first.edited is not None, row
    found = {part.name: part for part in first.edited.pair}
    assert found.keys() == pair.keys(), found
    for name, (factor, points) in pair.items():
        assert found[name].factor == pytest.approx(factor, rel=0.01)
        assert (None if found[name].everywhere else list(found[name].points)) == points
        where = "at all points of k" if points is None else f"at k = {format_number(points[0])} N/m"
        said = f"the gain {name} is {format_number(found[name].factor)} times what was exported {where}"
        assert said in say_cause(first, "I")


def test_an_entry_of_the_table_that_was_edited_in_the_c_is_named(schedule, compiler, tmp_path):
    """Its anti-windup stays what was exported."""
    so.export(schedule, tmp_path / "law", allow_infeasible=True)
    source, number = tmp_path / "law" / "force_law.c", float(schedule.table.gains["k_p"][0])
    text = source.read_text()
    written = [each for each in set(re.findall(r"[0-9.]+e?[-+]?[0-9]*", text)) if is_near(each, number)]
    assert len(written) == 1
    source.write_text(text.replace(written[0], f"{1.25 * number:.17g}"))
    places = 6.5e5 + 1.4e5 * np.sin(2e-3 * np.arange(REFERENCE.size))
    log = Bench(compiler, tmp_path, schedule, exported=True).log(Machine(), REFERENCE, places=places, decimals=3)
    (row,) = so.accept(schedule, [log]).replays
    first = row.causes[0]
    assert (first.kind, first.what, first.edited.points, first.explains) == ("gain", "k_p", (5e5,), True)
    assert first.edited.factor == pytest.approx(1.25, rel=0.01)


def is_near(text, number):
    try:
        return abs(float(text) / number - 1.0) < 1e-9
    except ValueError:
        return False
