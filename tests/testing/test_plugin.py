"""The pytest plugin as users run it: problem files with [expect] become tests, in this process and in two of xdist."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import seaopt as so

for _name in so.__all__ + so.testing.__all__:  # pytester forgets what is imported during a run in this process
    getattr(so, _name, None) or getattr(so.testing, _name)
pytest_plugins = ["pytester"]
ROOT = Path(__file__).resolve().parents[2]
PLUGIN = "seaopt.testing.plugin"
# What is installed is found anew by each run in this process, and not by all: each run loads what it names (below).
OPTIONS = ("-q", "-p", PLUGIN, "-p", "no:cacheprovider")
BENCH = """
schema = 1
[parameters]
J = { value = 2e-6, free = true }
b_r = { value = 3e-4, free = true }
[plant.stand]
kind = "high_impedance"
[[experiment]]
name = "chirp"
plant = "stand"
virtual = { seed = 1, duration_s = 5, rate_hz = 400, noise_std = { F1 = 2.0, F2 = 2.0 }, truth = { J = 3.31e-6, b_r = 1.31e-4 }, excitation = { chirp = { amplitude = 2.0, f0_hz = 0.1, f1_hz = 100 }, noise = { std = 1.0, band_hz = 150 } } }
[[experiment]]
name = "again"
plant = "stand"
use = "validate"
virtual = { seed = 2, duration_s = 5, rate_hz = 400, noise_std = { F1 = 2.0 }, truth = { J = 3.31e-6, b_r = 1.31e-4 }, excitation = { noise = { std = 1.0, band_hz = 150 } } }
"""  # noqa: E501
EXPECT = """
[expect.parameters]
J = [3.2e-6, 3.4e-6]
b_r = { max = 0.2, unit = "mN m s" }
[expect.fit_percent]
chirp = { F1 = 98, F2 = 98 }
again = 95
"""
COUNTED = """
import os
import seaopt.problem.stages as stages
made = stages.fit
def fit(*args, **kwargs):
    with open("calls", "a") as calls:
        calls.write(f"{os.getpid()}\\n")
    return make(*args, **kwargs)
stages.fit = fit
def pytest_unconfigure():
    stages.fit = made
"""
REAL = COUNTED + "make = made\n"
# What the expectations read of a fit, for processes that would take seconds for a real one.
STUB = (
    COUNTED
    + """
from types import SimpleNamespace as Of
def make(experiments, parameters, **_):
    percents = {"chirp": {"F1": Of(fit_percent=99.0), "F2": Of(fit_percent=99.0)}}
    return Of(met=True, verdict="", outputs=percents, derived={}, parameters=parameters.update(J=3.3e-6, b_r=1.3e-4),
              predict=lambda experiment: Of(name=experiment.name, fit_percent={"F1": 96.0}))
"""
)


@pytest.fixture(autouse=True)
def _as_users_do(pytester, monkeypatch):
    """Let processes that the tests start find this seaopt, not an installed one, and no settings of these tests."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    pytester.makeini("[pytest]\naddopts = --strict-markers\n")


def write(pytester, text, name="knee"):
    (pytester.path / f"{name}.problem.toml").write_text(text, encoding="utf-8")


def calls(pytester):
    return Counter((pytester.path / "calls").read_text(encoding="utf-8").split())


def test_each_expectation_is_an_item_and_the_fit_is_made_once(pytester):
    write(pytester, BENCH + EXPECT)
    pytester.makeconftest(REAL)
    result = pytester.runpytest_inprocess(*OPTIONS, "-vv", "--no-header")
    result.assert_outcomes(passed=6)
    for name in ("fit_met", "parameters.J", "parameters.b_r", "fit_percent.chirp.F2", "fit_percent.again"):
        result.stdout.fnmatch_lines(f"*knee.problem.toml::{name} PASSED*")
    assert list(calls(pytester).values()) == [1]


def test_what_is_not_met_says_what_was_found_what_was_asked_and_what_to_do(pytester):
    write(pytester, BENCH + "[expect.parameters]\nJ = [1e-6, 3e-6]\n[expect.fit_percent]\nchirp = { F1 = 99.99 }\n")
    result = pytester.runpytest_inprocess(*OPTIONS)
    result.assert_outcomes(passed=1, failed=2)
    result.stdout.fnmatch_lines([
        "*parameters.J*", "expect.parameters.J: found 3.* ± * kg m^2, asked for 1e-06 to 3e-06 kg m^2; *seaopt run *",
        "expect.fit_percent.chirp.F1: found 9*.* % (F1), asked for at least 99.99 %; *",
    ])  # fmt: skip
    result.stdout.no_fnmatch_line("*Traceback*")


@pytest.mark.slow
@pytest.mark.parametrize("dist", ["load", "loadfile"])
def test_two_workers_each_make_the_fit_at_most_once(pytester, dist):
    pytest.importorskip("xdist")
    write(pytester, BENCH + EXPECT)
    pytester.makeconftest(STUB)
    result = pytester.runpytest_subprocess(*OPTIONS, "-p", "xdist", "-n", "2", "--dist", dist)
    result.assert_outcomes(passed=6)
    assert set(calls(pytester).values()) == {1}
    assert len(calls(pytester)) <= (1 if dist == "loadfile" else 2)


def test_files_without_expectations_and_others_are_left_alone(pytester):
    write(pytester, BENCH)
    (pytester.path / "other.toml").write_text(BENCH + EXPECT, encoding="utf-8")
    pytester.runpytest_inprocess(*OPTIONS).assert_outcomes()


@pytest.mark.parametrize(
    ("expect", "words"),
    [
        ("[expect.controler]\n", '*unknown key expect.controler; did you mean "controller"?*'),
        ("[expect]\nzzz = 1\n", "*unknown key expect.zzz; known: fit_met, parameters, fit_percent, *"),
        ("[expect.parameters]\nJJ = [0, 1]\n", '*expect.parameters names "JJ"; *'),
        ("[expect.fit_percent]\nchrip = 1\n", '*expect.fit_percent names "chrip"; did you mean "chirp"?*'),
        ("[expect.fit_percent]\nchirp = { q9 = 1 }\n", '*expect.fit_percent.chirp names "q9"; *'),
        ("[expect.parameters]\nJ = [2, 1]\n", "*expect.parameters.J = [[]2, 1[]]: should be [[]low, high[]]*"),
        ("[expect.parameters]\nJ = 1\n", "*expect.parameters.J = 1 is not a range*"),
        ('[expect.parameters]\nJ = { min = 1, unit = "N" }\n', "*expect.parameters.J: *"),
        ("[expect.controller]\nms = 1.6\n", "*expect.controller*no *controller* is*"),
        ("[expect.parameters\n", "*cannot be read as TOML*"),
    ],
)
def test_mistakes_in_a_file_are_one_line_of_its_collection(pytester, expect, words):
    write(pytester, BENCH + expect)
    (pytester.path / "test_own.py").write_text("def test_own(): pass\n", encoding="utf-8")
    result = pytester.runpytest_inprocess(*OPTIONS, "--continue-on-collection-errors")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(words)
    result.stdout.no_fnmatch_line("*Traceback*")


def test_a_fit_that_cannot_be_made_is_tried_once_and_says_why(pytester):
    write(pytester, BENCH.replace("amplitude = 2.0", "amplitude = 0.0").replace("std = 1.0", "std = 0.0") + EXPECT)
    pytester.makeconftest(REAL)
    result = pytester.runpytest_inprocess(*OPTIONS)
    result.assert_outcomes(failed=6)
    result.stdout.fnmatch_lines("*constant throughout*")
    assert list(calls(pytester).values()) == [1]


def test_the_experiments_of_the_plugin_recover_the_truth(pytester):
    pytester.makepyfile("""
        import seaopt as so
        def test_fit(stand_experiment, swing_experiment, virtual_experiment):
            thor = so.plants.thor()
            fit = so.fit([stand_experiment], thor.update(J=2e-6).free("J", "b_r"))
            so.testing.assert_recovered(fit, thor, sigmas=4)
            assert swing_experiment.name == "swing" and swing_experiment.outputs == ("F1", "F2")
            assert len(virtual_experiment(so.plants.high_impedance(), thor, duration_s=1).log) == 400
    """)
    pytester.runpytest_inprocess(*OPTIONS).assert_outcomes(passed=1)


def test_pytest_starts_without_anything_heavy():
    code = f"import sys, {PLUGIN}; print([name for name in ('numpy', 'casadi', 'pydantic') if name in sys.modules])"
    found = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert found.stdout.strip() == "[]"


def test_a_seaopt_that_cannot_be_imported_breaks_no_other_test(pytester, monkeypatch):
    write(pytester, BENCH + EXPECT)
    (pytester.path / "test_own.py").write_text("def test_own(): pass\n", encoding="utf-8")
    broken = pytester.mkdir("broken")
    (broken / "casadi.py").write_text("raise ImportError('no casadi here')\n", encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(broken), os.environ["PYTHONPATH"]]))
    result = pytester.runpytest_subprocess(*OPTIONS, "--continue-on-collection-errors")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines("*seaopt cannot be imported (no casadi here)*")
