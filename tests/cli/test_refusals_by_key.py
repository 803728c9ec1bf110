"""What is refused names the key that is wrong."""

from __future__ import annotations

import json
import tomllib
import warnings

import numpy as np
import pytest

import seaopt as so
from seaopt.control.given.law_file import read_law
from seaopt.files import to_json
from seaopt.logs import assess_quality
from seaopt.signals import Signal
from tests.schedules import tune_knee

PROBLEM = """
schema = 1
parameters = { J = { value = 3.31e-6 } }
plant.stand.kind = "high_impedance"
controller = { plant = "stand", bandwidth_hz = 30 }
"""


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("schema = 1", "schema = true", r"schema = True: should be 1; correct it: schema = 1$"),
        ("schema = 1", "schema = 1.0", r"schema = 1.0: should be 1; correct it: schema = 1$"),
        ("schema = 1", "schema = 2", r"schema = 2: should be 1; correct it: schema = 1$"),
        ("schema = 1", 'schema = "1"', r"schema = '1': should be 1; correct it: schema = 1$"),
        ("schema = 1", 'title = "x"', r"key schema is missing; add it: schema = 1$"),
        ("3.31e-6 }", '3.31e-6, free = "nan" }', r"parameters.J.free = 'nan'"),
        ("3.31e-6 }", '3.31e-6, min = "low" }', r"parameters.J.min = 'low'"),
        ("= 30", "= -30", r"bandwidth_hz = -30 is not positive.*bandwidth_hz = 30$"),
        ("= 30", "= 0", r"bandwidth_hz = 0 is not positive.*bandwidth_hz = 30$"),
        ("= 30", '= 30, structure = "pdi"', r"structure = 'pdi': should be 'pd', .* or 'mpc'; .*structure = \"pd\"$"),
        (
            "= 30",
            '= 30, schedule = { over = "k", points = [1] }',
            r"points = \[1\]: should have at least 2 items, not 1",
        ),
    ],
)
def test_a_wrong_value_is_refused_by_its_key(tmp_path, before, after, words):
    assert before in PROBLEM
    (tmp_path / "p.toml").write_text(PROBLEM.replace(before, after), encoding="utf-8")
    with pytest.raises(so.SeaoptError, match=words):
        so.read_problem(tmp_path / "p.toml").controller_spec()


def test_a_schedules_controller_json_is_refused_as_a_law_by_what_it_is(tmp_path):
    (tmp_path / "controller.json").write_text(to_json(tune_knee().to_dict()), encoding="utf-8")
    with pytest.raises(so.SeaoptError, match="should have no schedule: one law is measured"):
        read_law(tmp_path / "controller.json")


@pytest.mark.parametrize("top", [2.0, 1e300, 1e-300])
@pytest.mark.parametrize("first", [-1e300, 1e300, 1e-300, 1e-308])
def test_a_law_whose_first_coefficient_is_absurd_is_refused(tmp_path, first, top):
    content = {
        "sample_rate_hz": 1000.0, "compute_delay_samples": 1,
        "reference": {"num": [2.0, 0.1], "den": [1.0, -0.5]}, "measurement": {"num": [2.0], "den": [1.0, -0.5]},
    }  # fmt: skip
    content["reference"] = {"num": [top], "den": [first, -0.5]}
    (tmp_path / "law.json").write_text(json.dumps(content), encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        if 1e-50 < abs(top / first) < 1e50 and abs(0.5 / first) < 1e50:
            assert np.isfinite(read_law(tmp_path / "law.json").law.reference_response(np.array([10.0]))).all()
            return
        with pytest.raises(so.SeaoptError, match=r"reference.den\[0\] = "):
            read_law(tmp_path / "law.json")


@pytest.mark.parametrize("key", ["A", "B", "C", "D"])
def test_a_matrix_beyond_what_squares_bear_is_refused(tmp_path, key):
    law = {"A": [[0.5]], "B": [[1.0, -1.0]], "C": [[1.0]], "D": [[1.0, -1.0]]}
    law[key] = [[1e300] * len(law[key][0])]
    content = {"sample_rate_hz": 1000.0, "compute_delay_samples": 1, "law": law}
    (tmp_path / "law.json").write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(so.SeaoptError, match=rf"law.{key}.*should be within ±1e\+50"):
        read_law(tmp_path / "law.json")


@pytest.mark.parametrize("name", ["Kraft_N", "Kraft N", 'a "b"'])
def test_the_range_that_is_proposed_for_a_flat_signal_is_toml(name):
    t = np.arange(2000) / 1000.0
    wave = np.sin(2.0 * np.pi * t)
    signals = {"I": wave, name: np.minimum(wave, 0.8)}
    log = so.Log(time=t, signals={key: Signal(name=key, values=values) for key, values in signals.items()})
    lines = [one.sentence for one in assess_quality(log).findings if "saturation = " in one.sentence]
    assert lines
    for line in lines:
        text = line[line.index("saturation = ") :].replace("[low, high]", "[0, 1]")
        assert tomllib.loads(text)["saturation"] == {name: [0, 1]}
