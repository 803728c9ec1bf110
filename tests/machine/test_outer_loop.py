"""Acceptance of a law with an outer loop around it, on equations of motion and an outer loop of the test's own."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from typer.testing import CliRunner

import seaopt as so
from seaopt.cli.main import app
from seaopt.control import Impedance, add_impedance, tune_schedule
from seaopt.machine.design_run import run_design
from tests.machine.conftest import KNEE
from tests.machine.conftest import OBSERVED as KNEE_SPEC
from tests.machine.simulator import Bench, Machine, multisine
from tests.machine.test_hidden import LINES as KNEE_LINES

T = 1e-3
INERTIA, DAMPER = 0.5, 2.0  # of the link


def run(law, goal, *, stiffness=20.0, damping=1.0, late=0, seed=1, dry=0.0, stays=None):
    """Return x_0, or the force asked for where the law has no stiffness, then the force reference, the torque, the
    link's angle, and the command, a row per tick. `dry` is friction at the motor, N m, smoothed over 1 rad/s; `stays`:
    where a dead encoder says that the link is.
    """
    rng, outer = np.random.default_rng(seed), law.outer
    mass, kick = KNEE["N"] ** 2 * KNEE["J_m"], KNEE["N"] * KNEE["eta"] * KNEE["K_tau"]
    a = np.zeros((6, 6))  # motor's angle at the output, its speed, the link's, its speed, current, friction
    a[0, 1] = a[2, 3] = 1.0
    a[1, [0, 2]], a[1, 1] = np.array([-1.0, 1.0]) * KNEE["k_s"] / mass, -(KNEE["N"] ** 2) * KNEE["b_r"] / mass
    a[1, 5] = -KNEE["N"] / mass
    a[1, 4], a[3, [0, 2]] = kick / mass, np.array([1.0, -1.0]) * KNEE["k_s"] / INERTIA
    a[3, 3] = -DAMPER / INERTIA
    parts = 20 if dry else 1
    moved = scipy.linalg.expm(a * T / parts)
    x, state, speed, before, waiting = np.zeros(6), np.zeros(law.law.c.size), 0.0, 0.0, 0.0
    rows = np.empty((goal.size, 5))
    places = [0.0] * (late + 1)
    for k in range(goal.size):
        angle = x[2] + 1e-5 * rng.normal() if stays is None else stays
        torque = KNEE["k_s"] * (x[0] - x[2]) + 0.02 * rng.normal()
        places.append(angle)
        seen = places[-1 - late]
        speed = (0.005 * speed + seen - before) / (0.005 + T)
        before = seen
        asked = outer.direction * (stiffness * (goal[k] - seen) - damping * speed)
        asked += 0.0 if outer.stiffness else goal[k]
        effort = law.law.c @ state + law.law.d @ np.array([asked, torque])
        state = law.law.a @ state + law.law.b @ np.array([asked, torque])
        current = effort * law.per_effort
        rows[k] = goal[k], asked, torque, angle, current
        x[4], waiting = waiting, current
        for _ in range(parts):
            x[5] = dry * math.tanh(KNEE["N"] * x[1])
            x = moved @ x
    return rows


def make_log(rows, *, inner=False, position=True, unit="rad"):
    columns = {"reference": rows[:, 1 if inner else 0], "tau_s": rows[:, 2], "I": rows[:, 4]}
    units = {"reference": "N m" if inner else unit, "tau_s": "N m", "I": "A"}
    if position:
        columns, units = columns | {"theta_l": rows[:, 3]}, units | {"theta_l": "rad"}
    return so.Log.from_arrays(time=T * np.arange(len(rows)), units=units, source="knee", **columns)


def replace_reference(log, values):
    columns = {name: log[name] for name in log.signals} | {"reference": values}
    units = {name: log.signal(name).unit for name in log.signals}
    return so.Log.from_arrays(time=log.time, units=units, source=log.source, **columns)


GOAL = 0.1 * np.sin(2.0 * np.pi * np.arange(4000) * T) + 0.05 * (np.arange(4000) // 1000 % 2)
FORCE = 20.0 * GOAL  # N m


@pytest.mark.parametrize("first", [0, 777])
def test_the_outer_loop_is_replayed_with_the_law(impedance, first):
    rows = run(impedance, GOAL)[first:]
    result = so.accept(impedance, [make_log(rows)])
    (row,) = result.replays
    assert row.met and row.mismatch < 1e-3 * row.rms, row
    assert result.response is None and "give the plant of the link" in result.left_out["knee"]
    assert so.accept(impedance, [make_log(rows, inner=True, position=False)]).replayed


def test_a_reference_without_a_unit_is_what_the_command_is_made_of(impedance):
    rows = run(impedance, GOAL)
    for unit, inner in (("-", False), ("-", True), ("", False)):
        log = make_log(rows, unit=unit)
        log = replace_reference(log, rows[:, 1]) if inner else log
        (row,) = so.accept(impedance, [log]).replays
        assert row.met and not row.unit_missing, (unit, inner)


def test_where_neither_makes_the_command_the_unit_is_asked_for(impedance):
    rng, rows = np.random.default_rng(4), run(impedance, GOAL)
    rows[:, 0] += 0.05 * rng.normal(size=len(rows))  # another reference than the law was given
    result = so.accept(impedance, [make_log(rows, unit="-")])
    assert result.replays[0].unit_missing and not result.met
    text = " ".join(str(result).split())
    assert "write [rad] in its header if it is x_0" in text and "or [N m] if" in text


@pytest.mark.parametrize(
    ("changes", "what", "value"), [({"stiffness": 10.0}, "stiffness", 0.5), ({"damping": 0.5}, "damping", 0.5)]
)
def test_another_outer_loop_is_named(impedance, changes, what, value):
    (row,) = so.accept(impedance, [make_log(run(impedance, GOAL, **changes))]).replays
    cause = row.causes[0]
    assert not row.met and cause.explains and cause.what == what and np.isclose(cause.value, value, rtol=1e-3), row


def test_an_outer_loop_whose_whole_output_is_less_is_named_by_that(impedance):
    result = so.accept(impedance, [make_log(run(impedance, GOAL, stiffness=12.0, damping=0.6))])
    cause = result.replays[0].causes[0]
    assert cause.explains and cause.kind == "factor" and np.isclose(cause.value, 0.6, rtol=1e-3), cause
    assert "the outer loop's output is 0.6 times what it should be" in " ".join(str(result).split())


def test_without_the_links_position_it_says_what_to_log(impedance):
    with pytest.raises(so.SeaoptError, match="log in each tick tau_s and theta_l"):
        so.accept(impedance, [make_log(run(impedance, GOAL[:500]), position=False)])


def test_damping_alone_is_replayed_of_the_force_before_it_and_after(damping):
    """The force that is asked for is what the test adds its own damping to; `step` is given the sum."""
    rows = run(damping, FORCE, stiffness=0.0)
    assert np.std(rows[:, 1] - rows[:, 0]) > 0.1 * np.std(rows[:, 0])
    before, after = make_log(rows, unit="N m"), make_log(rows, inner=True, position=False)
    result = so.accept(damping, [before, after, make_log(rows, inner=True)])
    for row in result.replays:
        assert row.met and row.mismatch < 1e-3 * row.rms, row
    assert len(result.experiments) == 2  # before the damping it is of the link's plant, which was not given


def test_another_damping_alone_is_named(damping):
    (row,) = so.accept(damping, [make_log(run(damping, FORCE, stiffness=0.0, damping=0.5), unit="N m")]).replays
    cause = row.causes[0]
    assert not row.met and cause.explains and cause.what == "damping" and np.isclose(cause.value, 0.5, rtol=1e-3), row


@pytest.mark.parametrize(
    ("law", "words"),
    [
        ("impedance", "log its x_0 as the reference, with the link's position"),
        ("damping", "log what step was given as the reference; or, with the link's position, the force"),
    ],
)
def test_the_page_of_a_bring_up_says_what_to_log(law, words, request):
    law = request.getfixturevalue(law)
    plants = {"stand": law.design[0], "knee": so.plants.rotary()}
    plan = so.bring_up(law, plants, law.design[1], samples=2, fractions=(), limits={"tau_s": 40.0})
    assert words in " ".join(repr(plan).split())


@pytest.mark.parametrize("others", [False, True])
def test_a_position_that_stays_with_the_outer_loop_closed_is_said_and_judges_nothing(impedance, others):
    """The encoder is dead: the law makes the logged command of what it read, and nothing holds the link to x_0."""
    log = replace(make_log(run(impedance, excite(20.0, 3), stays=0.02)), source="dead")
    right = [make_log(run(impedance, excite(20.0, 3)))] if others else []
    result = so.accept(impedance, [*right, log], link=take_link())
    row = result.replays[-1]
    assert row.met and row.position_stays == 0.02 and not result.met, result
    assert (result.response is not None) == others and len(result.experiments) == len(right)
    assert result.to_dict()["replay"]["logs"][-1]["position_stays"] == 0.02
    words = "theta_l stays at 0.02 rad with the outer loop closed"
    assert " ".join(str(result).split()).count(words) == 1 and words in result.left_out["dead"], result


def take_link():
    """Return the plant of the test's link, and its values."""
    knee = so.plants.rotary()
    return knee, knee.complete(so.ParameterSet()).update(**KNEE, J_l=INERTIA, d_l=DAMPER)


LINES = np.unique(np.round(np.geomspace(2, 120, 20)).astype(int))


class Quiet:
    """No noise."""

    def normal(self):
        return 0.0


def excite_quietly():
    return 0.05 * np.sin(2.0 * np.pi * 3.0 * T * np.arange(2000)) * np.minimum(1.0, np.arange(2000) / 500.0)


def excite(stiffness, seed):
    return multisine(2000, LINES, 8, 0.1 if stiffness else 2.0, seed)


@pytest.mark.parametrize("stiffness", [20.0, 0.0])
def test_the_whole_loop_of_a_right_machine_is_met_and_is_its_margin_at_the_command(impedance, damping, stiffness):
    """Ms by the matrices of the test's own machine: 1 + L from the law with the outer loop written out by hand."""
    law = impedance if stiffness else damping
    rows = run(law, excite(stiffness, 3), stiffness=stiffness)
    log = make_log(rows, unit="rad" if stiffness else "N m")
    result = so.accept(law, [log], link=take_link())
    assert result.met and result.enclosed and result.to_dict()["enclosed"], result
    figures = {row.name: row for row in result.response.judged}
    assert "bandwidth" not in figures and "with the outer loop in it" in " ".join(str(result).split())
    f = np.linspace(1.0, 60.0, 2000)
    z = np.exp(2j * np.pi * f * T)
    mass, kick = KNEE["N"] ** 2 * KNEE["J_m"], KNEE["N"] * KNEE["eta"] * KNEE["K_tau"]
    a, b = np.zeros((5, 5)), np.zeros(5)
    a[0, 1] = a[2, 3] = 1.0
    a[1, [0, 2]], a[1, 1] = np.array([-1.0, 1.0]) * KNEE["k_s"] / mass, -(KNEE["N"] ** 2) * KNEE["b_r"] / mass
    a[3, [0, 2]], a[3, 3] = np.array([1.0, -1.0]) * KNEE["k_s"] / INERTIA, -DAMPER / INERTIA
    a[1, 4] = kick / mass
    moved = scipy.linalg.expm(a * T)
    b[:4] = moved[:4, 4]
    states = np.array([np.linalg.solve(each * np.eye(4) - moved[:4, :4], b[:4]) for each in z])
    torque, angle = KNEE["k_s"] * (states[:, 0] - states[:, 2]), states[:, 2]
    block = law.law
    inner = np.array(
        [block.c @ np.linalg.solve(each * np.eye(block.c.size) - block.a, block.b) + block.d for each in z]
    )
    speed = (z - 1.0) / ((0.005 + T) * z - 0.005)
    outer = -law.outer.direction * (stiffness + speed) * angle  # damping of 1
    loop = -law.per_effort * (inner[:, 1] * torque + inner[:, 0] * outer) / z  # a command waits for the next tick
    assert figures["Ms"].value == pytest.approx(np.max(1.0 / np.abs(1.0 + loop)), rel=0.02)
    assert figures["Ms"].predicted == pytest.approx(np.max(1.0 / np.abs(1.0 + loop)), rel=1e-3)


def test_a_log_under_an_impedance_is_an_experiment_of_its_link(impedance):
    """A fit of it finds what the test's own machine was made of, from values that are off."""
    knee, values = take_link()
    log = make_log(run(impedance, excite(20.0, 7)))
    result = so.accept(impedance, [log], link=(knee, values))
    ((plant, recorded),) = result.experiments
    assert plant is knee and {"I", "tau_s", "theta_l"} <= set(recorded.signals)
    again = so.Experiment(plant=plant, log=recorded, feedback=True)
    start = values.update(eta=0.6, J_l=0.4, d_l=1.5).free("eta", "J_l", "d_l")
    fit = so.fit([again], start, method=so.PredictionError())
    so.testing.assert_recovered(fit, {"eta": KNEE["eta"], "J_l": INERTIA, "d_l": DAMPER}, sigmas=4)
    assert fit.parameters["eta"].std < 0.02 * KNEE["eta"]


PROBLEM = """
schema = 1
title = "Knee"
parameters = { N = 100, K_tau = 0.0369, eta = 0.7, J_m = 2.4e-5, b_r = 1e-4, k_s = 300.0, J_l = 0.5, d_l = 2.0 }
plant = { stand = { kind = "rotary", link = "locked" }, knee = { kind = "rotary" } }
controller = { plant = "stand", measured = "tau_s", bandwidth_hz = 20, current_limit_A = 9.0, max_noise_gain = 45 }
impedance = { plant = "knee", stiffness = 20.0, damping = 1.0, velocity_filter_s = 0.005 }
robustness = { plants = ["knee"], samples = 5 }
"""


def test_the_command_writes_it_as_an_experiment_of_the_links_plant(tmp_path):
    """The problem with the tables that are written reads back, and a fit with them starts."""
    text = PROBLEM.replace("current_limit_A = 9.0,", "current_limit_A = 9.0, drive_delay_s = 4e-4,")
    (tmp_path / "knee.toml").write_text(text)
    call, options = CliRunner().invoke, [str(tmp_path / "knee.toml"), "-o", str(tmp_path / "out")]
    assert call(app, ["tune", *options]).exit_code == 0
    problem = so.read_problem(tmp_path / "knee.toml")
    content = json.loads((tmp_path / "out" / "controller.json").read_text())
    law = so.Controller.from_dict(content, problem.design_plant, problem.values(problem.parameters))
    so.write_log(make_log(run(law, excite(20.0, 7))), tmp_path / "running.csv")
    done = call(app, ["accept", options[0], str(tmp_path / "running.csv"), *options[1:]])
    assert "running_under_law.toml" in done.output, done.output
    tables = (tmp_path / "out" / "again" / "running_under_law.toml").read_text()
    assert 'plant = "knee"' in tables and 'theta_l = "theta_l [rad]"' in tables
    rows = run(law, excite(20.0, 7))
    rows[:, 3] = 0.0  # the law alone, on a link that is held, as it was told
    so.write_log(make_log(rows, inner=True), tmp_path / "held.csv")
    done = call(app, ["accept", options[0], str(tmp_path / "held.csv"), *options[1:]])
    assert "in 1 of 1 log" in " ".join(done.output.split()) and "is constant" not in done.output, done.output
    (tmp_path / "knee.toml").write_text(text + tables)
    (experiment,) = so.read_problem(tmp_path / "knee.toml").experiments()
    assert experiment.delay_s.value == 4e-4 and experiment.delay_s.free  # the drive's, behind the program's
    assert experiment.feedback and {"tau_s", "theta_l"} <= set(experiment.outputs)


def test_what_is_simulated_has_the_outer_loop(impedance, monkeypatch):
    """On the test's own machine: drives with a limit, and dry friction, are told by simulating law and outer loop."""
    monkeypatch.setattr(np.random, "default_rng", lambda seed: Quiet())
    goal = excite_quietly()
    rows = run(impedance, goal)
    simulated = run_design(replace(impedance, design=take_link()), [take_link()[1]], goal)
    np.testing.assert_allclose(simulated.outputs["tau_s"][0], rows[:, 2], atol=2e-3 * np.ptp(rows[:, 2]))
    np.testing.assert_allclose(simulated.outputs["theta_l"][0], rows[:, 3], atol=2e-3 * np.ptp(rows[:, 3]))


def test_what_differs_under_a_running_impedance_is_named(impedance, monkeypatch):
    link = take_link()
    for changed, value in (("eta", 0.85 * KNEE["eta"]), ("k_s", 0.8 * KNEE["k_s"])):
        monkeypatch.setitem(KNEE, changed, value)
        rows = run(impedance, excite(20.0, 5))
        monkeypatch.undo()
        result = so.accept(impedance, [make_log(rows)], link=link)
        best = result.differences.found[0]
        assert result.replayed and not result.met and best.explains > 0.99
        assert changed in str(result), (changed, result)
        assert best.value == pytest.approx(value / KNEE[changed], abs=0.01)


def test_a_goal_that_stands_still_says_what_to_record(impedance):
    result = so.accept(impedance, [make_log(run(impedance, np.full(4000, 0.1)))], link=take_link())
    assert result.replayed and result.response is None and "periodic multisine" in result.left_out["knee"]


def test_a_log_of_the_force_law_alone_is_simulated_without_the_outer_loop(compiler, tmp_path):
    """With dry friction, which takes a simulation: the machine's own bench knows no outer loop."""
    locked, free = so.plants.rotary(link="locked"), so.plants.rotary()
    values = free.complete(so.ParameterSet()).update(**KNEE, f_c=0.005, v_s=1.0)
    force = so.tune(locked, values, replace(KNEE_SPEC, structure="pid"))
    law = add_impedance(force, free, values, Impedance(stiffness=20.0, damping=1.0), name="knee")
    reference = np.concatenate([multisine(1000, KNEE_LINES, 3, 1.0, seed) for seed in range(6)])
    log = Bench(compiler, tmp_path, force).log(Machine.of_knee(values), reference, noise=0.02)
    result = so.accept(law, [log])
    assert result.differences.inside and result.differences.misfit < 2.0 and not result.enclosed, result


def test_the_link_of_a_schedule_is_where_its_variable_stood(impedance):
    """The values of the link are given at another place: the machine is the one where the log was taken."""
    knee, values = take_link()
    schedule = tune_schedule(so.plants.rotary(link="locked"), values, impedance.spec, "k_s", [200.0, 400.0])
    around = [replace(each, outer=impedance.outer) for each in schedule.controllers]
    schedule = replace(schedule, controllers=tuple(around))
    rows = run(schedule.at(KNEE["k_s"]), 0.4 * excite(20.0, 3))
    link = knee, values.update(k_s=200.0)
    result = so.accept(schedule, [make_log(rows)], at=KNEE["k_s"], link=link)
    assert result.replayed and result.enclosed and result.differences.inside, result


SLOW = multisine(1000, np.unique(np.round(np.geomspace(1, 60, 20)).astype(int)), 16, 0.05, 5)


def keep_every(rows, every, **options):
    log = make_log(rows, **options)
    columns = {name: log[name][::every] for name in log.signals}
    units = {name: log.signal(name).unit for name in log.signals}
    return so.Log.from_arrays(time=log.time[::every], units=units, source="knee", **columns)


@pytest.mark.parametrize("every", [2, 4])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_log_of_every_nth_tick_under_an_outer_loop_is_of_this_law(impedance, every, seed):
    (row,) = so.accept(impedance, [keep_every(run(impedance, SLOW, seed=seed), every)]).replays
    assert row.met and row.ticks_per_row == every, row


@pytest.mark.parametrize(
    ("changes", "what", "value"), [({"stiffness": 10.0}, "stiffness", 0.5), ({"damping": 0.5}, "damping", 0.5)]
)
def test_another_outer_loop_in_a_log_of_every_second_tick_is_named(impedance, changes, what, value):
    (row,) = so.accept(impedance, [keep_every(run(impedance, SLOW, **changes), 2)]).replays
    cause = row.causes[0]
    assert not row.met and cause.explains and cause.what == what and np.isclose(cause.value, value, rtol=0.05), row


def test_without_a_stiffness_a_log_of_every_second_tick_says_why_it_tells_nothing(damping):
    result = so.accept(damping, [keep_every(run(damping, 20.0 * SLOW, stiffness=0.0), 2, unit="N m")])
    assert not result.replayed and "the link drifts" in " ".join(str(result).split())


def test_the_response_of_a_log_of_every_second_tick_under_an_outer_loop_is_that_of_the_right_machine(impedance):
    result = so.accept(impedance, [keep_every(run(impedance, excite(20.0, 3)), 2)], link=take_link())
    assert result.replayed and result.enclosed and result.differences.inside, result
    assert not any(row.outcome == "refuted" for row in result.response.judged if row.limit is not None)
