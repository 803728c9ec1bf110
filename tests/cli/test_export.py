"""`seaopt export` as a user runs it: files, exit codes, and controllers that must not be flashed."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

import seaopt as so
from seaopt.cli.export import _list_typed
from seaopt.codec import to_content
from seaopt.control import MPCSpec, PlausibilityGate, force_mpc
from seaopt.control.mpc.stored import describe_mpc
from seaopt.files import write_json


def test_it_writes_the_law_and_the_gains(folder, done, seaopt):
    out = seaopt("export", done.results, "--c", "firmware/knee", "--name", "knee", "--precision", "float")
    assert out.returncode == 0
    names = {"knee.h", "knee.c", "knee_gains.h", "knee_gains.m"}
    assert {path.name for path in (folder / "firmware" / "knee").iterdir()} == names
    header = (folder / "firmware" / "knee" / "knee.h").read_text(encoding="utf-8")
    assert "typedef float knee_real;" in header
    assert "#define KNEE_CURRENT_LIMIT_A 9.0f" in header
    assert all(name in out.stdout for name in names)


def test_json_names_the_files(folder, done, seaopt):
    content = json.loads(seaopt("export", done.results, "--c", "named", "--current-limit", "3", "--json").stdout)
    assert (content["schema"], content["feasible"]) == ("seaopt/export/1", True)
    assert "CURRENT_LIMIT_A 3.0" in (folder / content["files"][0]).read_text(encoding="utf-8")


@pytest.mark.parametrize(("limit", "warned"), [("30", True), ("inf", True), ("9", False), ("3", False)])
def test_a_limit_above_the_certified_one_is_warned_of(done, seaopt, tmp_path, limit, warned):
    out = seaopt("export", done.results, "--c", tmp_path / "out", "--current-limit", limit)
    assert out.returncode == 0
    said = " ".join(out.stderr.split())
    assert (
        "the controller was certified with, 9 A: its certificate says nothing about larger commands" in said
    ) == warned
    header = (tmp_path / "out" / "force_law.h").read_text(encoding="utf-8")
    assert ("It was designed with a limit of 9 A" in header) == warned


def test_a_raised_limit_of_a_controller_without_a_certificate_is_of_its_design(done, seaopt, tmp_path):
    (tmp_path / "controller.json").write_bytes((done.results / "controller.json").read_bytes())
    out = seaopt("export", tmp_path, "--c", tmp_path / "out", "--current-limit", "30")
    assert "designed with, 9 A: its figures say nothing about larger commands" in " ".join(out.stderr.split())


@pytest.mark.parametrize(
    ("typed", "part"),
    [
        (("--gate", "-4000:4000", "--gate-max-step", "300"), "the gate"),
        (("--tracking-time", "0.1"), "the anti-windup"),
        (("--no-gate", "--no-derate"), ""),
    ],
)
def test_a_law_that_is_not_the_certified_one_is_warned_of(done, seaopt, tmp_path, typed, part):
    out = seaopt("export", done.results, "--c", tmp_path / "out", *typed)
    assert out.returncode == 0
    assert (f"warning: {part} of this export" in " ".join(out.stderr.split())) == bool(part)


@pytest.mark.parametrize(("largest", "typed"), [(300.0, []), (200.0, ["the gate"])])
def test_a_gate_that_is_typed_as_the_file_has_it_is_the_certified_one(largest, typed):
    gate = PlausibilityGate(range_N=(-4e3, 4e3), max_step_N=300.0, max_held=5, ramp_per_s=90.0)
    content = {"guards": {"gate": to_content(gate), "derate": False}}
    options = {"gate": replace(gate, max_step_N=largest), "derate": None, "tracking_time_s": None}
    assert _list_typed(content, options) == typed


def test_a_gate_that_is_left_out_of_predictive_control_is_not_the_certified_one():
    plant = so.plants.rotary(link="locked")
    gate = PlausibilityGate(range_N=(-300.0, 300.0), max_step_N=60.0, max_held=4, ramp_per_s=300.0)
    spec = MPCSpec(current_limit_A=3.0, measured="tau_s", bandwidth_hz=10.0, max_sensitivity=2.0)
    for made, differs in ((gate, ["the gate"]), (None, [])):
        content = {"mpc": describe_mpc(force_mpc(plant, plant.defaults, spec, gate=made)), "sample_time_s": 1e-3}
        assert _list_typed(content, {"gate": False, "derate": None, "tracking_time_s": None}) == differs
        assert _list_typed(content, {"gate": gate, "derate": None, "tracking_time_s": None}) != differs


def one_line(out):
    assert out.returncode == 2
    (line,) = out.stderr.strip().splitlines()
    assert line.startswith("seaopt: ")
    return line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("nowhere", "--c", "out"), "give the folder of results"),
        (("short.toml", "--c", "out"), "give the folder of results"),
        (("results", "--c", "short.toml"), "is a file; give a folder"),
        (("results", "--c", "n" * 300), "cannot be a folder"),
        (("results", "--c", "out", "--precision", "half"), 'use "double" or "float"'),
        (("results", "--c", "out", "--name", "7"), "cannot begin a name in C"),
        (("results", "--c", "out", "--current-limit", "0"), "is not positive"),
        (("results", "--c", "out", "--derate-margin", "15"), "part thermal"),
        (("results", "--c", "out", "--no-derate", "--derate-margin", "15"), "type one of them"),
    ],
)
def test_bad_input_is_one_line_and_exits_2(folder, done, seaopt, arguments, words):
    arguments = (done.results if name == "results" else name for name in arguments)
    assert words in one_line(seaopt("export", *arguments))
    assert not (folder / "out").exists()


def test_without_a_target_it_is_a_usage_error(done, seaopt):
    assert seaopt("export", done.results).returncode == 2


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("seaopt/controller/3", "seaopt/controller/1", "schema is"),
        ('"den": [', '"den": [2.0,', "was edited"),
        ('"reference"', '"referense"', "was edited"),
        ('"made_from": {', '"made_from": {}, "before": {', "written by hand"),
        ('"feasible": true', '"feasible": false', "was edited"),
        ("{", "", "not valid JSON"),
    ],
)
def test_a_stale_or_broken_controller_is_refused(done, seaopt, tmp_path, old, new, words):
    text = (done.results / "controller.json").read_text(encoding="utf-8").replace(old, new, 1)
    (tmp_path / "controller.json").write_text(text, encoding="utf-8")
    assert words in one_line(seaopt("export", tmp_path, "--c", tmp_path / "out"))


def test_an_infeasible_controller_is_written_only_when_asked_and_exits_1(done, seaopt, tmp_path):
    content = json.loads((done.results / "controller.json").read_text(encoding="utf-8"))
    content |= {"feasible": False, "active_constraints": ["max_noise_gain"]}
    write_json(tmp_path / "controller.json", content)
    assert "misses max_noise_gain" in one_line(seaopt("export", tmp_path, "--c", tmp_path / "out"))
    out = seaopt("export", tmp_path, "--c", tmp_path / "out", "--allow-infeasible")
    assert out.returncode == 1
    assert "not met: max_noise_gain" in out.stdout
    assert len(list((tmp_path / "out").iterdir())) == 4


def test_a_controller_whose_certificate_failed_exits_1(done, seaopt, tmp_path):
    for name in ("controller.json", "robustness.json"):
        content = json.loads((done.results / name).read_text(encoding="utf-8"))
        if name == "robustness.json":
            content["requirements"][0]["met"] = False
        write_json(tmp_path / name, content)
    out = seaopt("export", tmp_path, "--c", tmp_path / "out")
    assert out.returncode == 1
    assert "certificate" in out.stdout and "FAILED" in out.stdout
    content = json.loads(seaopt("export", tmp_path, "--c", tmp_path / "out", "--json").stdout)
    assert content["certified"] is False and content["certificate_failed"]
    assert len(list((tmp_path / "out").iterdir())) == 4
    header = (tmp_path / "out" / "force_law.h").read_text(encoding="utf-8")
    assert f"NOT CERTIFIED: the certificate of this law FAILED: {content['certificate_failed'][0]}" in header


def test_a_controller_that_was_never_certified_says_so(done, seaopt, tmp_path):
    (tmp_path / "controller.json").write_bytes((done.results / "controller.json").read_bytes())
    out = seaopt("export", tmp_path, "--c", tmp_path / "out")
    assert out.returncode == 1 and f"next: type seaopt certify PROBLEM -o {tmp_path}" in out.stdout
    content = json.loads(seaopt("export", tmp_path, "--c", tmp_path / "out", "--json").stdout)
    assert content["met"] is False and content["certified"] is False
    for name in ("force_law.h", "force_law_gains.h", "force_law_gains.m"):
        assert "NOT CERTIFIED: seaopt certify was not run" in (tmp_path / "out" / name).read_text(encoding="utf-8")
    assert "not certified" not in seaopt("export", done.results, "--c", tmp_path / "out").stdout
    assert "NOT CERTIFIED" not in (tmp_path / "out" / "force_law.h").read_text(encoding="utf-8")
