"""A log's quality is read back from quality.json without the log, and a damaged file is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from seaopt.errors import FileError
from seaopt.files import read_json, seal, to_json, write_json
from seaopt.logs import Quality, RawLog, assess_quality
from seaopt.logs.quality.report import QUALITY_SCHEMA
from seaopt.signals import Signal
from tests.damage import refuse

N = 4000


@pytest.fixture(scope="module")
def quality():
    """Return the quality of a log with a fault of every kind."""
    rng, time = np.random.default_rng(3), np.arange(N) / 400
    current = rng.normal(size=N)
    force = np.clip(np.convolve(current, np.ones(8) / 8)[:N] + 0.02 * rng.normal(size=N), -0.7, 0.7)
    force[100:130] = np.nan
    load = np.round(np.cumsum(rng.normal(size=N)), 1)
    load[[700, 1900]] += 400.0
    time[2000:] += 0.05
    time[3000] = time[2999]
    channels = {
        "I": ("A", current),
        "F1": ("N", force),
        "load": ("N", load),
        "tick": ("-", np.arange(N, dtype=float) + 3.0 * (np.arange(N) > 900)),
        "off": ("V", np.zeros(N)),
        "empty": ("N", np.full(N, np.nan)),
    }
    signals = {name: Signal(name=name, values=values, unit=unit) for name, (unit, values) in channels.items()}
    return assess_quality(RawLog(time=time, signals=signals, source="bad.csv", notes=("as logged",)))


@pytest.fixture(scope="module")
def content(quality):
    return json.loads(to_json(seal(quality.to_dict())))


def test_a_quality_is_read_back(quality, content, tmp_path):
    again = Quality.from_dict(read_json(write_json(tmp_path / "quality.json", content), QUALITY_SCHEMA))
    assert repr(again) == repr(quality) and again.met == quality.met and again.ok == quality.ok
    assert again.of("gap") == quality.of("gap") != ()
    assert again.clock.gaps.tolist() == [2000, 3001] and again.clock.repeated.tolist() == [3000]
    force, tick = again.channels["F1"], again.channels["tick"]
    assert force.missing.start.tolist() == [100] and force.missing.stop.tolist() == [130]
    assert {rail.side for rail in force.rails} == {"low", "high"}
    assert [rail.samples for rail in force.rails] == [rail.samples for rail in quality.channels["F1"].rails]
    assert again.channels["load"].outliers.tolist() == [700, 1900]
    assert tick.counter is not None and tick.counter.lost.tolist() == [3]
    assert np.isnan(again.channels["empty"].mean) and again.channels["off"].constant
    assert again.excitation == quality.excitation != {} and again.pairs == quality.pairs != ()
    assert again.spectra is None


def test_what_was_read_is_what_the_file_counts(content):
    force = content["channels"]["F1"]
    assert content["met"] is all(finding["severity"] != "error" for finding in content["findings"])
    assert force["missing"] == sum(force["missing_rows"]["stop"]) - sum(force["missing_rows"]["start"]) == 30
    assert content["channels"]["load"]["outliers"] == len(content["channels"]["load"]["outlier_rows"]) == 2
    assert content["gaps"]["count"] == len(content["clock"]["gaps"]) == 2


@pytest.mark.parametrize(
    ("place", "key", "value", "words"),
    [
        ((), "clock", 3.0, "clock"),
        (("clock",), "period", "slow", r"clock\.period"),
        (("clock",), "gaps", [2000.5], r"clock\.gaps"),
        (("channels", "F1"), "low", "far", r"channels\.F1\.low"),
        (("channels", "F1"), "missing", 29, r"channels.F1.missing is 29, and the other keys make 30"),
        (("channels", "F1"), "rails", [3], r"channels\.F1\.rails"),
        (("findings", 0), "severity", "mild", r"findings\.1\.severity"),
        ((), "met", True, "met is True"),
        ((), "rate_hz", 100.0, "rate_hz is 100"),
        (("pairs", 0), "lag_s", float("nan"), r"pairs\.1\.lag_s"),
    ],
)
def test_a_damaged_quality_is_refused(content, place, key, value, words):
    refuse(Quality.from_dict, content, place, key, value, words, file="quality.json")


@pytest.mark.parametrize("key", ["clock", "channels", "findings", "excitation"])
def test_a_quality_without_a_key_is_refused(content, key):
    kept = {name: value for name, value in content.items() if name not in (key, "made_from")}
    with pytest.raises(FileError, match=f"key {key} is missing; inspect the log again"):
        Quality.from_dict(kept)


def test_another_version_is_refused(content, tmp_path):
    path = write_json(tmp_path / "quality.json", content | {"schema": "seaopt/quality/9"})
    with pytest.raises(FileError, match="seaopt/quality/9"):
        read_json(path, QUALITY_SCHEMA)
