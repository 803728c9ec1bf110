"""The page on testing: its problem file and its tests run as they stand, and it shows what they say."""

from __future__ import annotations

import os
import re

import pytest

import seaopt as so
from tests.pages import blocks
from tests.testing.test_plugin import OPTIONS, ROOT

pytest_plugins = ["pytester"]
PAGE = "howto/testing.md"
for _name in so.__all__:  # pytester forgets what is imported during a run in this process
    getattr(so, _name)


@pytest.fixture
def problem_file(pytester, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    pytester.makeini("[pytest]\n")
    (text,) = blocks(PAGE, "toml")
    path = pytester.path / "knee.problem.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_its_problem_file_meets_what_it_expects(pytester, problem_file):
    names, _ = blocks(PAGE, "text")
    result = pytester.runpytest_inprocess(*OPTIONS, "-rp")
    shown = re.findall(r"PASSED (\S+)", result.stdout.str())
    assert shown == names.split()
    result.assert_outcomes(passed=len(shown))


def test_its_message_is_what_the_other_range_gives(pytester, problem_file):
    _, message = blocks(PAGE, "text")
    text = problem_file.read_text(encoding="utf-8").replace("J = [3.2e-6, 3.4e-6]", "J = [1e-6, 3e-6]")
    problem_file.write_text(text[: text.index("[expect.fit_percent]")], encoding="utf-8")
    result = pytester.runpytest_inprocess(*OPTIONS)
    result.assert_outcomes(passed=3, failed=1)
    (said,) = (line for line in result.outlines if line.startswith("expect.parameters.J"))
    (found, asked), (shown, promised) = (line.split(" kg m^2, ", 1) for line in (said, message.strip()))
    assert asked.replace(str(problem_file), problem_file.name) == promised
    for one, other in zip(re.findall(r"[\d.]+e-\d+", found), re.findall(r"[\d.]+e-\d+", shown), strict=True):
        assert float(one) == pytest.approx(float(other), rel=0.05)


def test_its_tests_pass(pytester, problem_file):
    problem_file.unlink()
    (code,) = blocks(PAGE, "python")
    pytester.makepyfile(test_knee=code)
    pytester.runpytest_inprocess(*OPTIONS).assert_outcomes(passed=3)
