"""An acceptance is read back from acceptance.json without its logs, and a damaged file is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import pytest

import seaopt as so
from seaopt.errors import FileError
from seaopt.files import read_json, seal, to_json, write_json
from seaopt.machine import Acceptance
from seaopt.machine.acceptance import ACCEPTANCE_SCHEMA, read_origin
from tests.damage import refuse
from tests.machine.simulator import Bench, Machine, multisine
from tests.machine.test_response import LINES

SPEC = so.ControllerSpec(measured="F1", bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)
MACHINES = {"good": Machine(), "half": Machine(law_gain=0.5)}


@pytest.fixture(scope="module")
def controller(stand, thor):
    return so.tune(stand, thor, SPEC)


@pytest.fixture(scope="module")
def results(compiler, controller, thor, tmp_path_factory):
    home = tmp_path_factory.mktemp("stored")
    bench, reference = Bench(compiler, home, controller), multisine(1000, LINES, 8, 60.0, 3, bias=300.0)
    logs = {name: bench.log(machine, reference, decimals=3) for name, machine in MACHINES.items()}
    ranges = {"k": (6e5, 7e5)}
    return {name: so.accept(controller, [log], uncertainty=thor, ranges=ranges) for name, log in logs.items()}


@pytest.fixture(scope="module")
def content(results):
    return json.loads(to_json(seal(results["good"].to_dict())))


@pytest.mark.parametrize("name", MACHINES)
def test_an_acceptance_is_read_back(results, controller, name, tmp_path, monkeypatch):
    before = results[name]
    path = write_json(tmp_path / "acceptance.json", before.to_dict())
    for module in ("replay", "judge_response", "compare"):
        monkeypatch.setattr(f"seaopt.machine.acceptance.{module}", None)  # nothing is judged again
    again = Acceptance.from_dict(read_json(path, ACCEPTANCE_SCHEMA), controller)
    assert again.met == before.met == (name == "good")
    assert again.sources == before.sources and again.left_out == before.left_out
    (read,), (row,) = again.replays, before.replays
    assert read.met == row.met and read.ticks == row.ticks and read.mismatch == pytest.approx(row.mismatch)
    assert [cause.kind for cause in read.causes] == [cause.kind for cause in row.causes]
    if name == "good":
        assert again.response.judged == before.response.judged
        assert again.differences.inside and again.differences.misfit == pytest.approx(before.differences.misfit)
    first = repr(before).splitlines()[0]
    assert repr(again).splitlines()[0] == first


@pytest.mark.parametrize(
    ("place", "key", "value", "words"),
    [
        ((), "certificate", "lost", "certificate"),
        ((), "met", False, "met is False"),
        (("replay", "logs", 0), "ticks", "all", r"logs\.1\.ticks"),
        (("replay", "logs", 0), "met", False, "replay.met|met is True"),
        (("response",), "confidence", float("nan"), r"response\.confidence"),
        (("response", "figures", 0), "outcome", "sure", r"response\.figures\.1\.outcome"),
        (("response", "figures", 0), "limit", "1.6", r"response\.figures\.1\.limit"),
        (("differences",), "misfit", [], r"differences\.misfit"),
    ],
)
def test_a_damaged_acceptance_is_refused(content, controller, place, key, value, words):
    refuse(
        partial(Acceptance.from_dict, controller=controller), content, place, key, value, words, file="acceptance.json"
    )


@pytest.mark.parametrize("key", ["met", "replay", "response", "differences", "place"])
def test_an_acceptance_without_a_key_is_refused(content, controller, key):
    kept = {name: value for name, value in content.items() if name not in (key, "made_from")}
    with pytest.raises(FileError, match=f"key {key} is missing; judge its logs again"):
        Acceptance.from_dict(kept, controller)


def test_what_was_judged_on_a_fit_that_is_not_met_is_not_met_when_it_is_read_back(content, controller):
    made = {name: value for name, value in content.items() if name != "made_from"} | {"met": False, "fit_met": False}
    again = Acceptance.from_dict(made, controller)
    assert again.fit_met is False and not again.met
    assert "on a fit that is not met" in repr(again)
    with pytest.raises(FileError, match="met is True"):
        Acceptance.from_dict(made | {"met": True}, controller)


def test_the_acceptance_of_a_stage_is_none_of_the_full_law(results, controller):
    whole = results["good"]
    assert whole.stage is None and whole.of_full and repr(whole).startswith("met      Acceptance: ")
    for stage, of_full in (("stage_1", False), ("full", True), ("full_2", True)):
        content = json.loads(to_json(replace(whole, stage=stage).to_dict()))
        again = Acceptance.from_dict(content, controller)
        assert again.met and again.stage == stage and again.of_full is of_full
        text = " ".join(repr(again).split())
        assert f"Acceptance of {stage}" in text and ("not of the full law" in text) is not of_full
        assert ("they say nothing of the full law" in text) is not of_full


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("stage", value) for value in (5, ["stage_1"], "../bringup/stage_1", "a\\b", "..", "", "stage_1\n")),
        *(("place", value) for value in ([1.0], {"over": "q", "value": "x", "unit": "m"}, "q")),
        *(("law", value) for value in (None, 7)),
    ],
)
def test_whose_logs_they_are_is_told_by_a_malformed_file_in_one_line(content, key, value):
    with pytest.raises(FileError, match=rf"acceptance\.json.*{key}.*judge its logs again"):
        read_origin({name: each for name, each in content.items() if name != "made_from"} | {key: value})


def test_another_version_is_refused(content, tmp_path):
    path = write_json(tmp_path / "acceptance.json", content | {"schema": "seaopt/acceptance/9"})
    with pytest.raises(FileError, match="seaopt/acceptance/9"):
        read_json(path, ACCEPTANCE_SCHEMA)
