"""The reading keys of a problem file."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from seaopt.errors import LogError, ProblemError

T = np.arange(400) / 400
HEAD = 'schema = 1\n[plant.a]\nkind = "high_impedance"\n[[experiment]]\nname = "x"\nplant = "a"\n'


@pytest.fixture
def problem(tmp_path):
    counts = np.round(1000 * np.sin(9 * T)).astype(np.int64) % 65536
    rows = "".join(f"{1000 * t:.6f},{n}\n" for t, n in zip(T, counts, strict=True))
    (tmp_path / "motor.csv").write_text("t,cur\n" + rows)
    late = T[::2] + 0.5
    rows = "".join(f"{t:.6f},{np.cos(t - 0.5):.9f}\n" for t in late)
    (tmp_path / "cell.csv").write_text("t [s],F1 [kN]\n" + rows)

    def write(keys):
        path = tmp_path / "problem.toml"
        path.write_text(HEAD + keys, encoding="utf-8")
        return so.read_problem(path)

    return write


KEYS = """
log = "motor.csv"
time = { column = "t", unit = "ms", file = "motor.csv" }
inputs = { I = { column = "cur", unit = "mA", wrap_bits = 16, scale = 2.0, offset = 1.0 } }
[experiment.outputs]
F1 = { column = "F1 [kN]", file = "cell.csv", clock_offset_s = -0.5, align = { linear = { max_gap_s = 0.01 } } }
"""


def test_columns_are_converted_and_aligned(problem):
    (experiment,) = problem(KEYS).experiments()
    log = experiment.log
    np.testing.assert_allclose(log["I"], 1e-3 * (2 * np.round(1000 * np.sin(9 * T)) + 1), atol=1e-12)
    np.testing.assert_allclose(log["F1"][:-1], 1000 * np.cos(T[:-1]), atol=5e-3)
    assert np.isnan(log["F1"][-1])


def test_a_window_and_a_rule_for_all(problem):
    keys = KEYS.replace(", align = { linear = { max_gap_s = 0.01 } }", "")
    with pytest.raises(LogError, match=r"problem.toml: experiment x: .*on the clock"):
        problem(keys).experiments()
    more = "align = { hold = { max_age_s = 0.01 } }\nwindow_s = [0.1, 0.2]\n[experiment.outputs]"
    (experiment,) = problem(keys.replace("[experiment.outputs]", more)).experiments()
    assert len(experiment.log) == 41
    np.testing.assert_allclose(experiment.log["F1"], 1000 * np.cos(np.floor(np.arange(40, 81) / 2) / 200), atol=1e-3)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"motor.csv"\n', '"../motor.csv"\n', "leaves the problem file's folder"),
        ('"cell.csv"', '"/tmp/cell.csv"', "leaves the problem file's folder"),
        ('"cell.csv"', '"C:\\\\cell.csv"', "leaves the problem file's folder"),
        (
            "linear = { max_gap_s = 0.01 }",
            "linear = {}, hold = {}",
            "exactly one of hold, linear, nearest and readings",
        ),
        ("wrap_bits = 16", "wrap_bits = 99", "wrap_bits"),
        ("wrap_bits = 16", 'from = "footer"', "header"),
        ("clock_offset_s = -0.5", "clok_offset_s = -0.5", 'did you mean "clock_offset_s"'),
    ],
)
def test_bad_keys_are_named(problem, old, new, words):
    with pytest.raises(ProblemError, match=words) as raised:
        problem(KEYS.replace(old, new, 1))
    assert "\n" not in str(raised.value)


def test_columns_by_number_a_rate_and_constants_of_the_header(problem, tmp_path):
    (tmp_path / "bare.csv").write_text("# gain = 3 N\n1,10\n2,20\n3,25\n", encoding="utf-8")
    keys = """
log = "bare.csv"
rate_hz = 100
inputs = { I = { column = 1, unit = "A" } }
[experiment.outputs]
F1 = { column = 2, unit = "N" }
F2 = { column = "gain", from = "header" }
"""
    (experiment,) = problem(keys).experiments()
    assert experiment.log.rate_hz == 100.0 and experiment.log["F1"].tolist() == [10, 20, 25]
    assert experiment.log["F2"].tolist() == [3, 3, 3]


def test_rows_by_name_duplicates_and_a_stated_rate(problem, tmp_path):
    stamps = T + 2e-4 * (np.arange(400) % 3)
    lines = [f"{name},{value},{t:.7f}\n" for t in [0.0, *stamps] for name, value in (("I", 2), ("F1", 30.0 + t))]
    (tmp_path / "long.csv").write_text("id,value,t [s]\n" + "".join(lines), encoding="utf-8")
    keys = """
log = "long.csv"
time = { column = "t [s]", where = { id = "I" } }
inputs = { I = { column = "value", unit = "A", where = { id = "I" } } }
outputs = { F1 = { column = "value", unit = "N", where = { id = "F1" } } }
duplicates = "mean"
resample = { rate_hz = 400, rule = "restamp" }
"""
    (experiment,) = problem(keys).experiments()
    assert len(experiment.log) == 400 and len(experiment.log.segments) == 1
    np.testing.assert_allclose(np.diff(experiment.log.time), 1 / 400)


def test_a_held_input_is_averaged_over_the_periods_of_a_new_clock(problem, tmp_path):
    rng = np.random.default_rng(0)
    t, command = T + np.append(0.0, 2e-4 * rng.uniform(-1, 1, 399)), rng.normal(size=400)
    rows = "".join(f"{at:.9f},{a:.9f},{np.cos(at):.9f}\n" for at, a in zip(t, command, strict=True))
    (tmp_path / "late.csv").write_text("t [s],I [A],F1 [N]\n" + rows)
    keys = 'log = "late.csv"\ninputs = { I = "I [A]" }\noutputs = { F1 = "F1 [N]" }\nresample = { rate_hz = 400 }\n'
    (held,), (lines,) = problem(keys).experiments(), problem(keys + 'hold = "first"').experiments()
    area = np.interp(held.log.time, t, np.append(0.0, np.cumsum(np.diff(t) * command[:-1])))
    np.testing.assert_allclose(held.log["I"][:-1], 400 * np.diff(area), atol=1e-5)
    np.testing.assert_allclose(lines.log["I"], np.interp(lines.log.time, t, command), atol=1e-5)


def test_a_byte_order_mark_is_no_part_of_the_file(tmp_path):
    path = tmp_path / "problem.toml"
    path.write_bytes(b"\xef\xbb\xbf" + b'schema = 1\n[plant.a]\nkind = "high_impedance"\n')
    assert list(so.read_problem(path).plants) == ["a"]


def test_an_uneven_clock_is_answered_with_the_keys_that_mend_it(problem, tmp_path):
    """The advice is final: what it says is taken as it is."""
    rng = np.random.default_rng(0)
    for name, stamps in (("late", T + 4e-4 * rng.random(400)), ("rounded", np.round(T, 3))):
        rows = "".join(f"{t:.7f},1,{np.cos(t):.9f}\n" for t in stamps)
        (tmp_path / f"{name}.csv").write_text("t [s],I [A],F1 [N]\n" + rows)
    keys = 'log = "{}.csv"\ninputs = {{ I = "I [A]" }}\noutputs = {{ F1 = "F1 [N]" }}\n'
    with pytest.raises(LogError, match=r"experiment x: .*call log.resample") as late:
        problem(keys.format("late")).experiments()
    advice = str(late.value).rsplit("in a problem file: ", 1)[1].split(", or ")
    assert advice == ["resample = { rate_hz = 400 }", 'resample = { rate_hz = 400, rule = "restamp" }']
    for line in advice:
        (experiment,) = problem(keys.format("late") + line).experiments()
        assert len(experiment.log.segments) == 1
    with pytest.raises(LogError, match=r'call log.restamp\(\); in a problem file: resample = "restamp"'):
        problem(keys.format("rounded")).experiments()
    with pytest.raises(LogError, match=r"resample = \{ rate_hz = 400 \} and decimate = 4") as slow:
        problem(keys.format("late") + "resample = { rate_hz = 100 }").experiments()
    assert "..." not in str(slow.value)


def test_columns_on_two_clocks_are_answered_with_the_key_that_aligns_them(problem):
    keys = KEYS.replace(", align = { linear = { max_gap_s = 0.01 } }", "")
    with pytest.raises(LogError, match=r"align = \{ hold = \{\} \}, or align = \{ linear = \{\} \}"):
        problem(keys).experiments()
