"""Results that somebody edited: whatever is changed in one, nothing is certified by it."""

from __future__ import annotations

import copy
import json
import shutil

import pytest

import seaopt as so
from seaopt.cli.export import export_controller
from seaopt.cli.session import SCHEMAS, Session
from seaopt.files import read_json, seal, write_json
from seaopt.robustness import Certificate
from seaopt.robustness.certificate.simulated import SIMULATIONS
from tests.checks import leave_out

PROBLEM = """
schema = 1
[parameters]
J = { value = 3.31e-6, free = false }
eta = { value = 0.95, max = 2.0 }
[plant.stand]
kind = "high_impedance"
[controller]
plant = "stand"
bandwidth_hz = 30
max_sensitivity = 1.6
[robustness]
parameters = { J = [3.3e-6, 3.32e-6] }
samples = 20
"""
FAILING = PROBLEM.replace("[3.3e-6, 3.32e-6]", "[1e-6, 1.2e-5]")


@pytest.fixture(scope="module")
def certified(tmp_path_factory):
    """Return two folders, problem.toml and its results in out: one's certificate is met, the other's failed."""
    folders = {}
    for name, text in (("met", PROBLEM), ("failed", FAILING)):
        folder = folders[name] = tmp_path_factory.mktemp(name)
        (folder / "problem.toml").write_text(text, encoding="utf-8")
        with pytest.MonkeyPatch.context() as patch:
            leave_out(patch, SIMULATIONS)
            run(folder / "problem.toml", folder / "out", stages=("tune", "certify"))
    return folders


def run(problem, folder, stages):
    session = Session(problem, folder)
    for stage in stages:
        session.run(stage)
    return session


def find_broken(content):
    """Return a row that is not met; of a certificate that is, its row of the draws."""
    rows = content["requirements"]
    return next((row for row in rows if not row["met"]), next(r for r in rows if r["name"] == "monte_carlo_failures"))


def set_met(content, other):
    find_broken(content)["met"] = not find_broken(content)["met"]


def delete_row(content, other):
    content["requirements"].remove(find_broken(content))


def empty_rows(content, other):
    content["requirements"] = []


def raise_limit(content, other):
    find_broken(content)["limit"] = 1e9


def raise_limit_and_set_met(content, other):
    find_broken(content).update(limit=1e9, met=True)


def lower_value(content, other):
    find_broken(content).update(value=-1.0, met=True)


def turn_sense(content, other):
    find_broken(content).update(name="min_" + find_broken(content)["name"], met=True)


def set_passed(content, other):
    content["passed"] = not content["passed"]


def change_draws(content, other):
    content["monte_carlo"]["samples"] = 100_000


def change_failures(content, other):
    content["monte_carlo"]["failures"] = 1 - min(content["monte_carlo"]["failures"], 1)


def change_seed(content, other):
    content["monte_carlo"]["seed"] += 1


def rename_plant(content, other):
    content["plants"]["swing"] = content["plants"].pop("stand")


def change_worst(content, other):
    content["plants"]["stand"]["worst"]["parameters"]["J"] *= 1.01


def add_key(content, other):
    content["remark"] = "looked at"


def set_fit_met(content, other):
    content["fit_met"] = None


def delete_digest(content, other):
    del content["made_from"]["content"]


def delete_made_from(content, other):
    del content["made_from"]


def empty_made_from(content, other):
    content["made_from"] = {}


def take_other_digest(content, other):
    content["made_from"]["content"] = other["made_from"]["content"]


def forget_controller(content, other):
    del content["made_from"]["controller.json"]


def take_other_controller(content, other):
    content["made_from"]["controller.json"] = other["made_from"]["content"]


def change_problem(content, other):
    content["made_from"]["problem"] = "0" * 64


OF_WHAT_IS_MET = [
    set_met, delete_row, empty_rows, raise_limit, raise_limit_and_set_met, lower_value, turn_sense, set_passed,
    change_draws, change_failures, take_other_digest, take_other_controller,
]  # fmt: skip
OF_EITHER = [
    change_seed, rename_plant, change_worst, add_key, set_fit_met, delete_digest, delete_made_from, empty_made_from,
    forget_controller, change_problem,
]  # fmt: skip
EDITS = [
    *((edit, state) for edit in OF_WHAT_IS_MET for state in ("met", "failed")), *((edit, "met") for edit in OF_EITHER)
]  # fmt: skip


@pytest.mark.parametrize(("edit", "state"), EDITS, ids=lambda item: getattr(item, "__name__", item))
def test_an_edited_certificate_certifies_nothing(certified, tmp_path, capsys, edit, state):
    """Neither for `export`, nor for `report`, nor where Python reads it."""
    folder = shutil.copytree(certified[state], tmp_path / "copy")
    path, others = folder / "out" / "robustness.json", certified["failed" if state == "met" else "met"] / "out"
    content = json.loads(path.read_text(encoding="utf-8"))
    edited = copy.deepcopy(content)
    edit(edited, json.loads((others / "robustness.json").read_text(encoding="utf-8")))
    assert edited != content
    path.write_text(json.dumps(edited), encoding="utf-8")
    capsys.readouterr()
    for read in (
        lambda: export_controller(folder / "out", tmp_path / "c", json=True),
        lambda: run(folder / "problem.toml", folder / "out", ["report"]),
        lambda: read_json(path, SCHEMAS["certify"]),
        lambda: read_certificate(folder, edited),
    ):
        with pytest.raises(so.SeaoptError, match=r"was edited|written by hand"):
            read()
    assert "certified" not in capsys.readouterr().out


def read_certificate(folder, content):
    problem = so.read_problem(folder / "problem.toml")
    stand = problem.plants["stand"]
    law = read_json(folder / "out" / "controller.json", SCHEMAS["tune"])
    controller = so.Controller.from_dict(law, stand, problem.parameters)
    return Certificate.from_dict(content, controller, {"stand": stand}, problem.parameters)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"met": False, "value": 1.0}, "monte_carlo_failures"),
        ({"met": True, "value": 1.0}, "monte_carlo_failures is called met"),
        ({"limit": -1.0}, "monte_carlo_failures is called met"),
    ],
)
def test_rows_are_judged_again(certified, change, words):
    """Also where the digest is one made for the edited content: what is called met keeps its limit."""
    content = json.loads((certified["met"] / "out" / "robustness.json").read_text(encoding="utf-8"))
    row = next(row for row in content["requirements"] if row["name"] == "monte_carlo_failures")
    row.update(change)
    if row["met"]:
        with pytest.raises(so.SeaoptError, match=words):
            read_certificate(certified["met"], seal(content))
    else:
        assert not read_certificate(certified["met"], seal(content)).passed
    content["requirements"] = []
    with pytest.raises(so.SeaoptError, match="requirements is empty"):
        read_certificate(certified["met"], seal(content))


def test_a_certificate_of_another_controller_is_not_one_of_this(certified, tmp_path):
    folder = shutil.copytree(certified["met"], tmp_path / "copy")
    text = PROBLEM.replace("bandwidth_hz = 30", "bandwidth_hz = 25")
    (folder / "problem.toml").write_text(text, encoding="utf-8")
    run(folder / "problem.toml", folder / "out", ["tune"])
    with pytest.raises(so.SeaoptError, match=r"robustness.json: is not of controller.json beside it.*seaopt certify"):
        export_controller(folder / "out", tmp_path / "c", json=True)
    with pytest.raises(so.SeaoptError, match="was made from another"):
        run(folder / "problem.toml", folder / "out", ["report"])


def change_gain(content):
    content["gains"]["k_p"] *= 1.001


def change_delay(content):
    content["compute_delay_samples"] += 1
    content["delay_samples"] += 1


def change_feasible(content):
    content["feasible"] = not content["feasible"]


def change_command(content):
    content["command"]["largest"] = 100.0


def leave_out_made_from(content):
    del content["made_from"]


LAW_EDITS = [change_gain, change_delay, change_feasible, change_command, leave_out_made_from]


@pytest.mark.parametrize("edit", LAW_EDITS, ids=lambda edit: edit.__name__)
def test_an_edited_controller_is_taken_as_a_law_of_ones_own_alone(certified, tmp_path, capsys, edit):
    folder = shutil.copytree(certified["met"], tmp_path / "copy")
    path = folder / "out" / "controller.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    edit(content)
    path.write_text(json.dumps(content), encoding="utf-8")
    for read in (
        lambda: export_controller(folder / "out", tmp_path / "c", json=True),
        lambda: run(folder / "problem.toml", folder / "out", ["report"]),
        lambda: run(folder / "problem.toml", folder / "out", ["certify"]),
    ):
        with pytest.raises(so.SeaoptError, match=r"(was edited|written by hand).*seaopt certify PROBLEM --controller"):
            read()
    session = Session(folder / "problem.toml", folder / "own")
    session.take_law(path)
    assert session.results["tune"].spec.structure == "custom"


def test_what_python_writes_is_told_from_what_was_edited(certified, tmp_path):
    content = read_json(certified["met"] / "out" / "robustness.json", SCHEMAS["certify"])
    path = write_json(tmp_path / "own.json", {"schema": "seaopt/own/1", "numbers": [1.0, 2.5, None]})
    assert read_json(path, "seaopt/own/1")["numbers"] == [1.0, 2.5, None]
    path.write_text(path.read_text(encoding="utf-8").replace("2.5", "2.6"), encoding="utf-8")
    with pytest.raises(so.SeaoptError, match="was edited"):
        read_json(path, "seaopt/own/1")
    again = write_json(tmp_path / "again.json", content)
    assert read_json(again, SCHEMAS["certify"]) == content
