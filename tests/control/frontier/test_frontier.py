"""The sweep of bandwidths: rows are recomputed, infeasible rows are results, the command writes them."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.cli import main
from seaopt.cli.frontier import parse_bandwidths
from seaopt.control import sweep, tune_schedule
from seaopt.control.tuning import possible_bandwidths
from seaopt.errors import ControlError
from seaopt.executors import Processes
from tests.control.loops.test_loop import independent

PROBLEM = """
schema = 1
[plant.stand]
kind = "high_impedance"
[controller]
plant = "stand"
structure = "pd"
bandwidth_hz = 30
max_sensitivity = 1.6
max_noise_gain = 25
current_limit_A = 9.0
"""


def test_rows_are_what_a_recomputation_gives(stand, swing, thor):
    spec = so.ControllerSpec(structure="pd", max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)
    found = sweep(stand, thor, spec, [20, 60], {"swing": swing})
    assert [row.feasible for row in found.rows] == [True, False]
    assert found.rows[1].blocked_by
    row, controller = found.rows[0], found.controllers[0]
    f = np.geomspace(0.1, 499.9, 20_000)
    loops = [controller.close(plant, thor) for plant in (stand, swing)]
    s = [1 / (1 + independent(loop, f)[0]) for loop in loops]
    assert row.ms == pytest.approx(max(np.abs(one).max() for one in s), rel=1e-3)
    inside = f <= 20
    integral = [np.trapezoid(np.abs(one[inside]), np.log(f[inside])) for one in s]
    assert row.disturbance == pytest.approx(max(integral), rel=1e-2)
    assert row.noise_gain == pytest.approx(np.abs(independent(loops[0], f)[2]).max(), rel=1e-3)
    at = np.array([20.0])
    motor = abs(controller.law.reference_response(at) * loops[0].sensitivity(at))[0]
    assert row.force_limit_N == pytest.approx(9.0 / controller.command.per_effort / motor, rel=1e-6)


@pytest.mark.slow
def test_a_row_says_what_friction_costs(stand, thor):
    """Without sticking is what a plant whose friction is nothing can have: Coulomb friction does not damp in motion."""
    spec = so.ControllerSpec(structure="pd", max_sensitivity=1.6, max_noise_gain=25)
    rubbing, smooth = (sweep(stand, thor.update(f_c=f_c), spec, [40], {"twin": stand}) for f_c in (50.0, 0.0))
    (row,), (free,) = rubbing.rows, smooth.rows
    assert free.without_sticking is None
    assert row.without_sticking.feasible == free.feasible
    assert row.without_sticking.disturbance == pytest.approx(free.disturbance, rel=1e-2)
    assert row.without_sticking.disturbance <= row.disturbance * 1.001
    assert "friction: by how much it raises the integral" in repr(rubbing) and "%" in repr(rubbing)


POINTS = [5e5, 6e5]
OF_POINTS = so.ControllerSpec(structure="pd", max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)


@pytest.fixture(scope="module")
def swept(stand, swing, thor):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(possible_bandwidths, "FARTHEST_BELOW", 1.01)  # a row says nothing of other bandwidths
        return sweep(stand, thor, OF_POINTS, [20, 30, 60], {"swing": swing}, over="k", points=POINTS)


def test_rows_of_a_schedule_are_its_worst_places(stand, swing, thor, swept):
    """At the points and the values that are judged between them, of the law that is tuned for that bandwidth alone."""
    found = swept
    assert [row.met for row in found.rows][::2] == [True, False] and found.over == "k"
    assert "max_sensitivity" in found.rows[2].blocked_by[0]
    row, schedule = found.rows[0], found.controllers[0]
    alone = tune_schedule(stand, thor, replace(OF_POINTS, bandwidth_hz=20), "k", POINTS, {"swing": swing})
    assert [one.gains for one in schedule.controllers] == [one.gains for one in alone.controllers]
    f = np.geomspace(0.1, 499.9, 5_000)
    inside = f <= 20
    ms, left, noise = {}, [], []
    for value in (*POINTS, *(place.value for place in schedule.between)):
        law, values = schedule.at(value), thor.update(k=value)
        for name, plant in {"design plant": stand, "swing": swing}.items():
            s, _, back = independent(law.close(plant, values), f)
            s = np.abs(1 / (1 + s))
            ms[name, value] = s.max()
            left.append(np.trapezoid(s[inside], np.log(f[inside])))
            noise.append(np.abs(back).max() if plant is stand else 0.0)
    assert row.ms == pytest.approx(max(ms.values()), rel=1e-3)
    assert ms[row.ms_plant, row.ms_place] == pytest.approx(row.ms, rel=1e-3)
    assert row.disturbance == pytest.approx(max(left), rel=1e-2)
    assert row.noise_gain == pytest.approx(max(noise), rel=1e-3)
    assert row.force_limit_N == min(schedule.at(value).force_limit(20.0) for value in POINTS)
    assert f"k = {row.ms_place:.4g}" in " ".join(repr(found).split())


def test_a_schedule_is_swept_in_another_process_alike(stand, swing, thor, swept):
    with Processes(2) as executor:
        apart = sweep(stand, thor, OF_POINTS, [20], {"swing": swing}, executor=executor, over="k", points=POINTS)
    assert apart.to_dict()["rows"] == swept.to_dict()["rows"][:1]


@pytest.mark.slow
def test_a_row_of_a_schedule_says_what_friction_and_structure_cost(stand, thor):
    spec = so.ControllerSpec(structure="pd", max_sensitivity=1.6, max_noise_gain=25)
    options = {"over": "k", "points": POINTS, "free_law": True}
    (row,), (free,) = (
        sweep(stand, thor.update(f_c=f_c), spec, [40], {"twin": stand}, **options).rows for f_c in (50.0, 0.0)
    )  # fmt: skip
    assert free.without_sticking is None
    assert row.without_sticking.disturbance == pytest.approx(free.disturbance, rel=1e-2)
    bounds = [
        sweep(stand, thor.update(f_c=0.0, k=k), spec, [40], {"twin": stand}, free_law=True).rows[0].free_law.bound
        for k in POINTS
    ]
    assert min(abs(free.free_law.bound / bound - 1.0) for bound in bounds) < 1e-3


def test_the_command_writes_table_json_and_figure(tmp_path, monkeypatch, capsys):
    problem = tmp_path / "p.toml"
    problem.write_text(PROBLEM)
    command = ["seaopt", "tune", str(problem), "-o", str(tmp_path / "out"), "--sweep", "40:60:20", "--json"]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit) as end:
        main()
    assert not end.value.code
    content = json.loads(capsys.readouterr().out)
    assert content["schema"] == "seaopt/frontier/1"
    assert [row["bandwidth_hz"] for row in content["rows"]] == [40, 60]
    assert [row["feasible"] for row in content["rows"]] == [True, False]
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"frontier.json", "frontier.png", "frontier.svg"}
    monkeypatch.setattr(sys, "argv", ["seaopt", "report", str(problem), "-o", str(tmp_path / "out")])
    monkeypatch.setattr("seaopt.problem.stages.sweep", None)  # it is read
    with pytest.raises(SystemExit) as end:
        main()
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert not end.value.code and "Bandwidths" in page and (tmp_path / "out" / "figures" / "frontier.svg").exists()
    problem.write_text(PROBLEM.replace("1.6", "1.7"))
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2 and "left out: " in (said := capsys.readouterr().err) and "frontier.json" in said


@pytest.mark.parametrize("text", ["15", "15:60", "60:15:5", "15:60:0", "a:b:c", "1:2:1e-9", "nan:60:5"])
def test_bad_sweeps(text):
    with pytest.raises(ControlError, match="--sweep"):
        parse_bandwidths(text)


def test_points_without_a_variable_are_refused(thor):
    with pytest.raises(so.SeaoptError, match=r"points = .* without over"):
        sweep(so.plants.high_impedance(), thor, so.ControllerSpec(), [20], points=[5e5, 6e5])
