"""The scripts of benchmarks/ that judge: on numbers and records whose answer is given."""

import importlib.util
import sys
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


def load_script(name, monkeypatch):
    """Import a script, whose settings of the environment end with the test."""
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    monkeypatch.setenv("POLARS_MAX_THREADS", "1")
    spec = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


def test_a_ratio_that_grew_by_more_than_a_tenth_is_named(monkeypatch):
    table = load_script("table", monkeypatch)
    case = lambda ratio: {"s": ratio, "yardstick": "numpy", "yardstick_s": 1.0, "ratio": ratio}  # noqa: E731
    kept = {"read": case(2.0), "fit": case(3.0), "gone": case(1.0)}
    assert table.find_losses({"read": case(2.19), "fit": case(3.31), "new": case(9.0)}, kept) == [
        "fit: 3 to 3.31 times numpy"
    ]
    lines = table.format_table({"machine": {"cores": 2}, "versions": {"numpy": "2.0"}, "cases": kept}).splitlines()
    assert lines[3] == "| fit | 3 | numpy | 1 | 3 |"
    assert lines[-1] == "cores 2; numpy 2.0. `make bench`"


def test_least_times_of_turns_that_alternate(monkeypatch):
    table = load_script("table", monkeypatch)
    calls = []
    monkeypatch.setattr(table, "spend", lambda call: call())
    times = {"ours": iter([9.0, 0.5, 0.3, 0.4]), "theirs": iter([9.0, 0.1, 0.2, 0.3])}
    turn = lambda name: lambda: calls.append(name) or next(times[name])  # noqa: E731
    assert table.measure(turn("ours"), turn("theirs"), seconds=0.0) == (0.3, 0.1, 3)
    assert calls == ["ours", "theirs"] * 4
