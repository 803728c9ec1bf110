"""Frequency responses are read back from frf.json without the logs, and a damaged file is refused."""

from __future__ import annotations

import json
from functools import partial

import numpy as np
import pytest

import seaopt as so
from seaopt.bench import PAPER_STAND
from seaopt.errors import FileError
from seaopt.files import read_json, seal, to_json, write_json
from seaopt.progress import ignore
from seaopt.reporting.responses import FRF_SCHEMA, Responses, estimate_responses
from seaopt.reporting.sections import write_text
from tests.damage import damage, refuse

PROBLEM = """
schema = 1
[plant.stand]
kind = "high_impedance"
[[experiment]]
name = "chirp"
plant = "stand"
log = "chirp.csv"
time = "time [s]"
inputs = { I = "I [A]" }
outputs = { F1 = "F1 [N]" }
gain = { F1 = 1.02 }
parameters = { eta = 0.9 }
"""


@pytest.fixture(scope="module")
def problem(stand, thor, tmp_path_factory):
    home = tmp_path_factory.mktemp("frf")
    sensors = so.Sensors(noise_std={"F1": 2.0})
    log = so.virtual_log(stand, thor, PAPER_STAND, duration_s=20, rate_hz=400, seed=1, sensors=sensors)
    so.write_log(log, home / "chirp.csv")
    (home / "problem.toml").write_text(PROBLEM, encoding="utf-8")
    return so.read_problem(home / "problem.toml")


@pytest.fixture(scope="module")
def responses(problem):
    return estimate_responses(problem.experiments(), problem, None, None, ignore)


@pytest.fixture(scope="module")
def content(responses):
    return json.loads(to_json(seal({"schema": FRF_SCHEMA, **responses.to_dict()})))


def test_responses_are_read_back(problem, responses, content, tmp_path, monkeypatch):
    path = write_json(tmp_path / "frf.json", content)
    monkeypatch.setattr("seaopt.problem.problem.read_log", None)  # no log is read
    again = Responses.from_dict(read_json(path, FRF_SCHEMA), problem)
    (before,), (pair,) = responses.surveys["chirp"].pairs, again.surveys["chirp"].pairs
    np.testing.assert_array_equal(pair.estimate.response, before.estimate.response)
    np.testing.assert_array_equal(pair.second_order.covariance, before.second_order.covariance)
    assert pair.peak == before.peak and pair.good_band_hz == before.good_band_hz
    adapted = again.surveys["chirp"].adapt(problem.parameters)
    assert adapted["eta"].value == 0.9 and again.surveys["chirp"].gain == {"F1": 1.02}
    assert again.verdict() == responses.verdict() and write_text(again) == write_text(responses)


def test_what_is_read_is_the_second_order_form_of_the_paper(problem, content):
    """(16) with k/m_k = b: 655000/295.2 of THOR's stand."""
    (pair,) = Responses.from_dict(content, problem).surveys["chirp"].pairs
    assert abs(pair.second_order.b.value - 655000 / 295.2) < 4.0 * pair.second_order.b.std


def test_figures_of_another_machine_are_read_back(problem, content):
    pair = content["experiments"]["chirp"]["pairs"][0]
    place = ("experiments", "chirp", "pairs", 0)
    written, _ = damage(content, place, "model_misfit", pair["model_misfit"] * (1.0 + 1e-7))
    assert Responses.from_dict(written, problem).surveys.keys() == {"chirp"}


@pytest.mark.parametrize(
    ("place", "key", "value", "words"),
    [
        ((), "experiments", [], "experiments"),
        ((), "experiments", {"other": {}}, "clock is missing"),
        (("pairs", 0), "coherence", "high", r"pairs\.1\.coherence"),
        (("pairs", 0), "coherence", None, r"pairs\.1\.coherence"),
        (("pairs", 0, "second_order"), "values", [1.0, None, 2.0, 3.0], r"second_order\.values"),
        (("pairs", 0, "second_order", "b"), "value", 1.0, "second_order"),
        (("pairs", 0), "model_misfit", 1e3, "experiments"),
        (("clock",), "hold", "third", "hold"),
        ((), "gain", {"F1": 1.3}, "experiments"),
    ],
)
def test_damaged_responses_are_refused(problem, content, place, key, value, words):
    inside = () if key == "experiments" else ("experiments", "chirp")
    refuse(
        partial(Responses.from_dict, problem=problem), content, (*inside, *place), key, value, words, file="frf.json"
    )


def test_responses_of_another_problem_or_version_are_refused(problem, content, tmp_path):
    renamed = {"schema": FRF_SCHEMA, "experiments": {"sweep": content["experiments"]["chirp"]}}
    with pytest.raises(FileError, match="has no experiment sweep"):
        Responses.from_dict(renamed, problem)
    path = write_json(tmp_path / "frf.json", content | {"schema": "seaopt/frf/9"})
    with pytest.raises(FileError, match="seaopt/frf/9"):
        read_json(path, FRF_SCHEMA)
