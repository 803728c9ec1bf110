"""`seaopt export` as a user runs it: files, exit codes, and controllers that must not be flashed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys

import pytest

import seaopt as so

SHORT = so.demo_path().read_text(encoding="utf-8").replace("duration_s = 164", "duration_s = 8").replace(
    "duration_s = 60", "duration_s = 4"
)  # fmt: skip


def seaopt(*arguments, cwd):
    return subprocess.run(
        [sys.executable, "-W", "error", "-m", "seaopt.cli", *map(str, arguments)],
        capture_output=True, text=True, check=False, cwd=cwd, env={**os.environ, "COLUMNS": "200"},
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("export")
    (path / "short.toml").write_text(SHORT, encoding="utf-8")
    for stage in ("fit", "tune"):
        done = seaopt(stage, "short.toml", "-o", "results", cwd=path)
        assert done.returncode == 0, done.stderr
    return path


def test_it_writes_the_law_and_the_gains(folder):
    done = seaopt("export", "results", "--c", "firmware/knee", "--name", "knee", "--precision", "float", cwd=folder)
    assert done.returncode == 0, done.stderr
    names = {"knee.h", "knee.c", "knee_gains.h", "knee_gains.m"}
    assert {path.name for path in (folder / "firmware" / "knee").iterdir()} == names
    header = (folder / "firmware" / "knee" / "knee.h").read_text(encoding="utf-8")
    assert "typedef float knee_real;" in header
    assert "#define KNEE_CURRENT_LIMIT_A 9.0f" in header
    assert all(name in done.stdout for name in names)


def test_json_names_the_files(folder):
    done = seaopt("export", "results", "--c", "named", "--current-limit", "3", "--json", cwd=folder)
    content = json.loads(done.stdout)
    assert (content["schema"], content["feasible"]) == ("seaopt/export/1", True)
    assert "CURRENT_LIMIT_A 3.0" in (folder / content["files"][0]).read_text(encoding="utf-8")


def one_line(done):
    assert done.returncode == 2
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("seaopt: ")
    return line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("nowhere", "--c", "out"), "give the folder of results"),
        (("short.toml", "--c", "out"), "give the folder of results"),
        (("results", "--c", "short.toml"), "cannot be written"),
        (("results", "--c", "out", "--precision", "half"), 'use "double" or "float"'),
        (("results", "--c", "out", "--name", "7"), "cannot begin a name in C"),
        (("results", "--c", "out", "--current-limit", "0"), "is not positive"),
    ],
)
def test_bad_input_is_one_line_and_exits_2(folder, arguments, words):
    assert words in one_line(seaopt("export", *arguments, cwd=folder))
    assert not (folder / "out").exists()


def test_without_a_target_it_is_a_usage_error(folder):
    assert seaopt("export", "results", cwd=folder).returncode == 2


def test_a_controller_of_another_fit_is_refused(folder):
    shutil.copytree(folder / "results", folder / "refitted")
    fit = folder / "refitted" / "fit.json"
    fit.write_text(fit.read_text(encoding="utf-8") + "\n", encoding="utf-8")
    assert "was tuned with another fit" in one_line(seaopt("export", "refitted", "--c", "out", cwd=folder))
    assert not (folder / "out").exists()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("seaopt/controller/1", "seaopt/controller/0", "schema is"),
        ('"den": [', '"den": [2.0,', "not 1"),
        ('"reference"', '"referense"', "missing or malformed"),
        ("{", "", "not valid JSON"),
    ],
)
def test_a_stale_or_broken_controller_is_refused(folder, tmp_path, old, new, words):
    text = (folder / "results" / "controller.json").read_text(encoding="utf-8").replace(old, new, 1)
    (tmp_path / "controller.json").write_text(text, encoding="utf-8")
    assert words in one_line(seaopt("export", tmp_path, "--c", tmp_path / "out", cwd=folder))


def test_an_infeasible_controller_is_written_only_when_asked_and_exits_1(folder, tmp_path):
    content = json.loads((folder / "results" / "controller.json").read_text(encoding="utf-8"))
    content |= {"feasible": False, "active_constraints": ["max_noise_gain"]}
    (tmp_path / "controller.json").write_text(json.dumps(content), encoding="utf-8")
    assert "misses max_noise_gain" in one_line(seaopt("export", tmp_path, "--c", tmp_path / "out", cwd=folder))
    asked = seaopt("export", tmp_path, "--c", tmp_path / "out", "--allow-infeasible", cwd=folder)
    assert asked.returncode == 1
    assert "not met: max_noise_gain" in asked.stdout
    assert len(list((tmp_path / "out").iterdir())) == 4
