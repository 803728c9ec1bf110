"""problems/knee.toml, a rotary knee with friction, on its own virtual logs."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from html import unescape
from pathlib import Path

import pytest

import seaopt as so
from seaopt.problem import completion
from tests.cli.test_schemas import validator
from tests.schedules import read_knee, tune_knee
from tests.words import check_words

KNEE = Path(__file__).resolve().parents[2] / "problems" / "knee.toml"
TRUTH = {"J_m": 2.4e-5, "b_r": 1e-4, "f_c": 0.005, "k_s": 300.0, "J_l": 0.25, "d_l": 0.3}


@pytest.mark.slow
def test_the_knee_runs_with_everything_met(tmp_path):
    command = [sys.executable, "-m", "seaopt", "run", str(KNEE), "-o", str(tmp_path)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr
    stored = {name: json.loads((tmp_path / f"{name}.json").read_text(encoding="utf-8")) for name in
              ("fit", "controller", "robustness")}  # fmt: skip
    page = re.sub(
        r"<(style|script).*?</\1>|<[^>]*>", " ", (tmp_path / "report.html").read_text(encoding="utf-8"), flags=re.DOTALL
    )
    own = r"N\s+100\s+gear ratio|m\s+4\s+kg\s+pendulum mass"  # the table's rows of a name and of a mass
    check_words(run.stdout, re.sub(own, "", unescape(page)))
    assert stored["fit"]["met"] and stored["controller"]["feasible"] and stored["robustness"]["passed"]
    assert stored["controller"]["command"]["effort_unit"] == "N m"
    for name, value in TRUTH.items():
        fitted = stored["fit"]["parameters"][name]
        assert abs(fitted["value"] - value) < 4 * fitted["std"]
    for name, content in stored.items():
        assert not list(validator(name).iter_errors(content))


def test_critical_damping_is_the_largest_between_the_points_too(monkeypatch):
    """A value of the variable stands for the damping that it needs."""
    values = read_knee()[-1]
    problem, schedule = so.read_problem(KNEE), tune_knee()

    def need(law, plant, at, stiffness, **_):
        return so.control.Impedance(stiffness=stiffness, damping=at["phi"].value)

    monkeypatch.setattr(completion, "critical_impedance", need)

    def note(law, plant, at, impedance, *, name):
        noted.append(impedance.damping)
        return law

    noted = []
    monkeypatch.setattr(completion, "add_impedance", note)
    points, between = (
        [
            (schedule.controllers[0], values.with_parameters(so.Parameter(name="phi", value=value, unit="rad")))
            for value in each
        ]
        for each in ((1.0, 2.0), (2.5, 1.5))
    )
    completion.add_outer_loop(problem, points, iter(between))
    assert noted == [2.5, 2.5]


SCREW = '[plant.screw]\nkind = "high_impedance"\n[plant.swing]'


@pytest.mark.parametrize(
    ("line", "mistake", "words"),
    [
        ('unit = "N m/rad", free', 'unit = "N/m", free', ("parameters.k_s", '"N/m" is not one of N m/rad')),
        ('value = 0.002, unit = "N m"', 'value = 0.002, unit = "N"', ("parameters.f_c", '"N" is not one of N m')),
        ("eta = 0.7", "eta = 0.7\nK_e = 0.05", ('"K_e"', "give K_tau alone")),
        ("[plant.swing]", SCREW, ("parameters.f_c is in N m for plant.stand and in N for plant.screw",)),
        ('measured = "tau_s"', 'measured = "F1"', ('controller.measured = "F1"', "which has tau_s")),
        ('measured = "tau_s"\n', "", ("controller.measured, which is left out", "which has tau_s")),
        ("{ noise_std = { tau_s = 0.02 } }", "{ noise_std = { F1 = 2.0 } }", ('"F1"', "known: tau_s")),
        ("noise_std = { tau_s = 0.02, theta_m = 2e-3 }", "noise_std = { theta_l = 1e-3 }", ('"theta_l"', "theta_m")),
        ('link = "locked"', 'link = "fixed"', ('link = "fixed"', '"locked"')),
        ('link = "locked"', 'link = "locked"\nparts = ["screw_mode"]', ("screw_mode", "k_s")),
    ],
)
def test_mistakes_are_one_line_with_a_remedy(tmp_path, line, mistake, words):
    text = KNEE.read_text(encoding="utf-8")
    assert line in text
    path = tmp_path / "knee.toml"
    path.write_text(text.replace(line, mistake).replace("duration_s = 30", "duration_s = 0.1"), encoding="utf-8")
    with pytest.raises(so.SeaoptError) as caught:
        so.read_problem(path).experiments()
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value)


def test_parameters_of_the_other_kind_are_kept(tmp_path):
    """A rotary file's f_s is in N m also where its plants have no Stribeck friction; a linear one's is in N."""
    path = tmp_path / "knee.toml"
    more = 'eta = 0.7\nk = 655000\nf_s = { value = 0.01, unit = "N m" }'
    path.write_text(KNEE.read_text(encoding="utf-8").replace("eta = 0.7", more), encoding="utf-8")
    parameters = so.read_problem(path).parameters
    assert (parameters["f_s"].unit, parameters["k"].unit, parameters["m"].value) == ("N m", "N/m", 4.0)
