"""A bring-up is read back from bringup.json without certifying, and a damaged file is refused."""

from __future__ import annotations

import json
from functools import partial

import pytest

import seaopt as so
from seaopt.errors import FileError, SeaoptError
from seaopt.files import read_json, seal, to_json, write_json
from seaopt.machine import BringUp, write_bring_up
from seaopt.machine.bringup.plan import BRINGUP_SCHEMA, list_stages
from tests.damage import refuse


@pytest.fixture(scope="module")
def plan(controller):
    plants, thor = {"stand": so.plants.high_impedance()}, so.plants.thor()
    return so.bring_up(controller, plants, thor, samples=20, fractions=(0.5,), limits={"F1": 900.0})


@pytest.fixture(scope="module")
def laws(plan):
    return {stage.name: stage.source for stage in plan.stages}


@pytest.fixture(scope="module")
def content(plan):
    return json.loads(to_json(seal(plan.to_dict())))


def test_a_bring_up_of_before_has_no_share_of_machines(content, laws):
    old = json.loads(
        to_json(seal({key: each for key, each in content.items() if key not in ("peaks_kept", "made_from")}))
    )
    assert content["peaks_kept"] == 0.98 and list_stages(old) == list_stages(content)
    assert "peaks_kept" not in BringUp.from_dict(old, laws).to_dict()


def test_a_bring_up_is_read_back(plan, laws, tmp_path, monkeypatch):
    path = write_json(tmp_path / "bringup.json", plan.to_dict())
    for module in ("certify", "expect", "tune_certified"):
        monkeypatch.setattr(f"seaopt.machine.bringup.stages.{module}", None)  # nothing is planned again
    again = BringUp.from_dict(read_json(path, BRINGUP_SCHEMA), laws)
    assert again.met == plan.met and repr(again) == repr(plan)
    for read, stage in zip(again.stages, plan.stages, strict=True):
        assert read.certificate is None and read.requirements == stage.requirements
        assert read.tracking == stage.tracking and read.step == stage.step and read.stop == stage.stop
        assert read.excitation.lines.tolist() == stage.excitation.lines.tolist()
        assert read.excitation.lasts_s == pytest.approx(stage.excitation.reference.size * 1e-3)


def test_what_was_read_back_has_no_reference_to_write(plan, laws, content, tmp_path):
    with pytest.raises(SeaoptError, match=r"reference\.csv of its stage"):
        write_bring_up(BringUp.from_dict(content, laws), tmp_path)


def test_a_bring_up_of_other_laws_is_refused(laws, content):
    with pytest.raises(FileError, match=r"stage_1 is of law \w+, not \w+; plan the stages again"):
        BringUp.from_dict(content, laws | {"stage_1": laws["full"]})
    with pytest.raises(FileError, match="full has no law"):
        BringUp.from_dict(content, {"stage_1": laws["stage_1"]})


@pytest.mark.parametrize(
    ("place", "key", "value", "words"),
    [
        ((), "met", False, "met is False"),
        ((), "stages", [], "stages"),
        (("stages", 0), "met", False, r"stages\.1\.met is False"),
        (("stages", 0), "name", 3, r"stages\.1\.name"),
        (("stages", 0), "name", "../bringup/stage_1", r"stages\.1\.name"),
        (("stages", 0), "bandwidth_hz", 16.0, r"stages\.1\.bandwidth_hz is 16"),
        (("stages", 0), "channels", ["F1"], r"stages\.1\.channels"),
        (("stages", 0), "rate_hz", 500.0, r"stages\.1\.rate_hz"),
        (("stages", 0), "requirements", [], r"stages\.1\.requirements"),
        (("stages", 0, "requirements", 0), "met", False, "met is True"),
        (("stages", 0, "reference"), "amplitude", float("nan"), r"stages\.1\.reference\.amplitude"),
        (("stages", 0, "reference"), "period_s", 4.0001, r"stages\.1\.reference\.(period_s|frequency_hz)"),
        (("stages", 0, "reference"), "phases", 0, r"stages\.1\.reference\.phases"),
        (("stages", 0, "reference"), "unit", "N m", r"stages\.1\.reference\.unit"),
        (("stages", 0, "peaks"), "I", "large", r"stages\.1\.peaks\.I"),
        (("stages", 0, "expected", "step"), "low", None, r"stages\.1\.expected\.step\.low"),
    ],
)
def test_a_damaged_bring_up_is_refused(content, laws, place, key, value, words):
    refuse(partial(BringUp.from_dict, laws=laws), content, place, key, value, words, file="bringup.json")


@pytest.mark.parametrize("key", ["reference", "expected", "law", "requirements", "friction"])
def test_a_bring_up_without_a_key_is_refused(content, laws, key):
    stages = [{name: value for name, value in stage.items() if name != key} for stage in content["stages"]]
    kept = {name: value for name, value in content.items() if name != "made_from"} | {"stages": stages}
    with pytest.raises(FileError, match=f"{key}.*plan the stages again"):
        BringUp.from_dict(kept, laws)


def test_a_bring_up_on_a_fit_that_is_not_met_is_not_met_when_it_is_read_back(content, laws):
    made = {name: value for name, value in content.items() if name != "made_from"} | {"met": False, "fit_met": False}
    again = BringUp.from_dict(made, laws)
    assert again.fit_met is False and not again.met and all(stage.met for stage in again.stages)
    assert "on a fit that is not met" in repr(again)


@pytest.mark.parametrize("stages", [None, [], ["full"], "full", [{}], [{"name": "full"}], {}])
def test_a_bring_up_without_its_stages_is_refused_in_one_line(content, stages):
    kept = {name: value for name, value in content.items() if name not in ("made_from", "stages")}
    for damaged in (kept, kept | {"stages": stages}):
        with pytest.raises(FileError, match=r"bringup\.json.*stages.*plan the stages again") as caught:
            list_stages(damaged)
        assert "\n" not in str(caught.value)


def test_an_older_bring_up_without_laws_is_of_another_version(content, tmp_path):
    path = write_json(tmp_path / "bringup.json", content | {"schema": "seaopt/bringup/1"})
    with pytest.raises(FileError, match="seaopt/bringup/1"):
        read_json(path, BRINGUP_SCHEMA)


def test_a_stage_is_handed_on_again_once_it_says_that_the_next_is_left_out(controller):
    def refuse(fraction):
        raise SeaoptError("none")

    plants, thor, kept = {"stand": so.plants.high_impedance()}, so.plants.thor(), []
    certificate = so.certify(controller, plants, thor, samples=5, simulations=False)
    plan = so.bring_up(
        controller, plants, thor, samples=5, fractions=(0.25, 0.26), limits={"F1": 900.0}, certificate=certificate,
        tune_stage=lambda fraction: controller, certify_stage=lambda law: certificate, keep_stage=kept.append,
    )  # fmt: skip
    assert "stage_2 would be the same experiment" in plan.stages[0].note
    last = {stage.name: stage for stage in kept}
    assert [last[stage.name].note for stage in plan.stages] == [stage.note for stage in plan.stages]
