"""A sweep is read back from frontier.json without tuning, and a damaged file is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

import seaopt as so
from seaopt.control import Frontier, sweep
from seaopt.control.frontier.rows import FRONTIER_SCHEMA, FrontierRow
from seaopt.errors import FileError
from seaopt.files import read_json, seal, to_json, write_json
from tests.damage import damage, refuse

SPEC = so.ControllerSpec(structure="pd", max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)


@pytest.fixture(scope="module")
def frontier(stand, swing, thor):
    return sweep(stand, thor, SPEC, [20, 60], {"swing": swing}, free_law=True)


@pytest.fixture(scope="module")
def content(frontier):
    return json.loads(to_json(seal(frontier.to_dict())))


def test_a_sweep_is_read_back(frontier, content, stand, thor, tmp_path, monkeypatch):
    path = write_json(tmp_path / "frontier.json", content)
    monkeypatch.setattr("seaopt.control.frontier.frontier.solve", None)  # nothing is tuned
    again = Frontier.from_dict(read_json(path, FRONTIER_SCHEMA), stand, thor)
    assert [row.met for row in again.rows] == [True, False] == [law.met for law in again.controllers]
    assert [row.bandwidth_hz for row in again.rows] == [20, 60]
    assert again.rows[1].blocked_by == frontier.rows[1].blocked_by
    assert again.rows[0].free_law.bound == pytest.approx(frontier.rows[0].free_law.bound, rel=1e-12)
    assert repr(again) == repr(frontier)
    assert seal(again.to_dict()).keys() == content.keys()


def test_figures_of_an_unstable_loop_are_read_back(frontier, content, stand, thor):
    row = replace(frontier.rows[1], ms=float("inf"), noise_gain=float("inf"), disturbance=float("inf"))
    written = json.loads(to_json(replace(frontier, rows=(frontier.rows[0], row)).to_dict()))
    assert written["rows"][1]["ms"] is None
    read = Frontier.from_dict(seal(written), stand, thor).rows[1]
    assert isinstance(read, FrontierRow) and read.ms == read.noise_gain == read.disturbance == float("inf")


def test_figures_of_another_machine_are_read_back(content, stand, thor):
    """A bandwidth is known to the root of rounding, which another machine's library has otherwise."""
    width = content["controllers"][0]["achieved"]["bandwidth_hz"]
    written, _ = damage(content, ("controllers", 0, "achieved"), "bandwidth_hz", width * (1.0 + 1e-7))
    assert Frontier.from_dict(written, stand, thor).controllers[0].achieved.bandwidth_hz == pytest.approx(width)


@pytest.mark.parametrize(
    ("place", "key", "value", "words"),
    [
        ((), "rows", None, "rows"),
        (("rows", 0), "ms", "large", r"rows\.1\.ms"),
        (("rows", 0), "phase_margin_deg", "wide", r"rows\.1\.phase_margin_deg"),
        (("rows", 0), "disk_margin", float("nan"), r"rows\.1\.disk_margin"),
        (("rows", 1), "free_law", 3, r"rows\.2\.free_law"),
        ((), "controllers", [], "controllers has 0 entries for 2 rows"),
        ((), "met", False, "met is False"),
        (("rows", 1), "feasible", True, "rows"),
        (("controllers", 0), "gains", {"k_p": 1.0}, "gains"),
        (("rows", 0), "bandwidth_hz", 21.0, r"rows\.1\.bandwidth_hz is 21\.0, and the other keys make 20\.0"),
        (("rows", 1), "met", True, r"rows\.2\.met is True"),
    ],
)
def test_a_damaged_sweep_is_refused(content, stand, thor, place, key, value, words):
    damaged = refuse(
        lambda each: Frontier.from_dict(each, stand, thor),
        content,
        place,
        key,
        value,
        words,
        file=("frontier.json", "controller.json"),
    )
    table = damaged
    for part in place:
        table = table[part]
    del table[key]
    with pytest.raises(FileError):
        Frontier.from_dict(damaged, stand, thor)


def test_controllers_of_other_rows_are_refused(content, stand, thor):
    swapped = seal(content | {"controllers": content["controllers"][::-1]})
    with pytest.raises(
        FileError, match=r"rows\.1\.bandwidth_hz is 20\.0, and the other keys make 60\.0; run its sweep again"
    ):
        Frontier.from_dict(swapped, stand, thor)


def test_a_sweep_of_another_version_is_refused(content, tmp_path):
    path = write_json(tmp_path / "frontier.json", content | {"schema": "seaopt/frontier/9"})
    with pytest.raises(FileError, match=r"frontier\.json: schema is 'seaopt/frontier/9'"):
        read_json(path, FRONTIER_SCHEMA)


def test_a_sweep_of_a_schedule_is_read_back(stand, thor):
    spec = so.ControllerSpec(structure="pd", bandwidth_hz=30, current_limit_A=9.0)
    made = sweep(stand, thor, spec, [30], over="k", points=(5e5, 7e5))
    again = Frontier.from_dict(json.loads(to_json(made.to_dict())), stand, thor)
    assert again.over == "k" and again.controllers[0].points == (5e5, 7e5)
    assert repr(again) == repr(made)
    slower = replace(made.rows[0], bandwidth_hz=0.9 * made.rows[0].bandwidth_hz)
    with pytest.raises(FileError, match=r"rows\.1\.bandwidth_hz is 27"):
        Frontier.from_dict(seal(replace(made, rows=(slower,)).to_dict()), stand, thor)
