"""The scripts of benchmarks/ that judge: on numbers and records whose answer is given."""

import importlib.util
import itertools
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat
from scipy.linalg import expm

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


def test_laws_that_logs_refuse_though_they_are_fine_are_counted_with_a_bound(monkeypatch):
    monkeypatch.setattr(sys, "path", sys.path.copy())
    judge = load_script("judge/run", monkeypatch)
    log = {"outcome": "undecided"}
    kept = {"fit_met": True, "certified": True, "refused": [], "logs": [log], "ms": 1.4, "limit": 1.785, "bad": False}
    bad = kept | {"fit_met": False, "ms": 1.9, "bad": True}
    confirmed = kept | {"logs": [log, {"outcome": "confirmed"}]}
    refuted = kept | {"refused": ["log_sensitivity"]}
    others = bad | {"refused": ["ms"], "certified": False}
    rows = [kept, bad, confirmed, refuted, refuted | {"bad": True}, others, {"status": "none"}]
    assert list(judge.summarise(rows)) == [
        "7 cases, 6 tuned; 4 on fits that are met",
        "certified without the logs 5, bad of these 2; on fits that are met 4, bad of these 1",
        "certified with them        3, bad of these 1; on fits that are met 2, bad of these 0",
        "refused by a log alone     2, of which fine 1: of all 20.0 %, below 65.7 %",
        "refused by other checks    1, bad of these 1; by a log too 0, bad of these 0",
        "confirmed by a log         1, over Ms 0: 0.0 %, below 95.0 %",
    ]
    unplayed = {name: kept[name] for name in ("fit_met", "certified", "refused", "logs")}
    assert list(judge.summarise([unplayed, unplayed, refuted])) == [
        "3 cases, 3 tuned; 3 on fits that are met",
        "refused by a log alone     1, of which fine 1: of all 33.3 %, below 86.5 %",
    ]


def test_only_what_repeats_with_a_periodic_input_looks_like_a_response(monkeypatch):
    monkeypatch.setattr(sys, "path", sys.path.copy())
    noise = load_script("judge/noise", monkeypatch)
    logs, share = noise.count_outside("periodic", "lag_5_hz", 4, 8.0)
    assert logs == 0 and 0.02 < share < 0.06
    assert noise.count_outside("periodic", "hum", 4, 15.0)[0] == 4  # at a line of it


EMPS = {"M": 95.1, "F_v": 203.5, "F_c": 20.39, "O": -3.165}
BELT = {"K": 36.0, "b": 20.0, "k_m": 367.0, "k_p": 142.0, "c": 0.003}
SILVERBOX = {"w": 428.0, "zeta": 0.0228, "g": 0.5, "a_2": 0.1, "a_3": 2.0, "o": 1e-3}


def write_emps(folder, pulses, name):
    """Two back and forth at 1 kHz under a PD law, with 1 um of noise; the axis stands still where friction holds it."""
    t = np.arange(6000) / 1000
    goal = np.where(t < 3, 0.1, 0.05) * np.clip(np.abs((t % 3.0) - 1.5) / 0.9 - 0.3, 0, 1)
    extra = pulses * np.sign(np.sin(5.0 * t)) * (np.sin(0.8 * t) > 0.3)
    q, v, before = goal[0], 0.0, goal[0]
    volts, read = np.empty(t.size), np.empty(t.size)
    for k in range(t.size):
        volts[k] = np.clip(243.45 * (160.18 * (goal[k] - q) - (q - before) * 1000), -10, 10) + extra[k]
        read[k] = before = q
        for _ in range(10):
            free = v + 1e-4 * (35.15 * volts[k] - EMPS["O"] - EMPS["F_v"] * v) / EMPS["M"]
            v = np.sign(free) * max(abs(free) - 1e-4 * EMPS["F_c"] / EMPS["M"], 0.0)
            q += 1e-4 * v
    read += 1e-6 * np.random.default_rng(0).standard_normal(t.size)
    savemat(folder / name, {"t": t[:, None], "vir": volts[:, None], "qm": read[:, None], "gtau": 35.15})


def write_drives(folder, spoiled=0.0):
    """The belt, linear between samples, with 0.01 ticks/s of noise; `spoiled` is added to what only tests."""
    p, rng, block = BELT, np.random.default_rng(0), np.zeros((4, 4))
    block[0] = -p["b"] - p["k_m"] * p["c"], -p["k_m"], p["k_m"] * p["c"], p["K"]
    block[1, [0, 2]] = 1.0, -1.0
    block[2, :3] = p["k_p"] * p["c"], p["k_p"], -p["k_p"] * p["c"]
    step, content = expm(block * 0.02), {}
    for tag, low, high in (("11", -1.5, 2.5), ("12", -1.0, 3.0)):
        u = np.repeat(rng.uniform(0, 1, 100), 5) * np.where(np.repeat(rng.integers(0, 2, 50), 10), high, low)
        x, y = np.zeros(3), np.empty(500)
        for k in range(500):
            y[k], x = abs(x[2]), step[:3, :3] @ x + step[:3, 3] * u[k]
        y += 0.01 * rng.standard_normal(500) + spoiled * (np.arange(500) >= 400)
        content |= {"u" + tag: u[:, None], "z" + tag: y[:, None]}
    savemat(folder / "DATAUNIF.MAT", content)


def write_silverbox(folder):
    """An arrow of noise and ten multisines, held between samples, by Runge-Kutta's method, with 0.2 mV of noise."""
    rng, n, h = np.random.default_rng(0), 131072, 1 / 610.35 / 3
    u, y, lines = np.empty(n), np.empty(n), np.zeros(4097, complex)
    u[:40650] = np.linspace(0, 0.15, 40650) * np.clip(rng.standard_normal(40650), -2, 2)
    lines[1:2600:2] = 1.0
    for begin in range(40650, n, 8192):
        wave = np.fft.irfft(lines * np.exp(2j * np.pi * rng.uniform(size=4097)), 8192)
        u[begin : begin + 8192] = (0.05 / wave.std() * wave)[: n - begin]
    w, zeta, g, second, third, offset = SILVERBOX.values()
    rate = lambda x, v, f: w * w * (f - x - second * x * x - third * x**3) - 2 * zeta * w * v  # noqa: E731
    x = v = 0.0
    for k, f in enumerate((g * u).tolist()):
        y[k] = x
        for _ in range(3):
            b1 = rate(x, v, f)
            v2 = v + h / 2 * b1
            b2 = rate(x + h / 2 * v, v2, f)
            v3 = v + h / 2 * b2
            b3 = rate(x + h / 2 * v2, v3, f)
            v4 = v + h * b3
            x, v = x + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (b1 + 2 * b2 + 2 * b3 + rate(x + h * v3, v4, f))
    savemat(folder / "SNLS80mV.mat", {"V1": u[None], "V2": (y + offset + 2e-4 * rng.standard_normal(n))[None]})


def test_the_positioner_is_found_where_friction_holds_it(tmp_path, monkeypatch):
    yardsticks = load_script("yardsticks", monkeypatch)
    write_emps(tmp_path, 0.0, "DATA_EMPS.mat")
    write_emps(tmp_path, 0.7, "DATA_EMPS_PULSES.mat")
    fit, _, errors = yardsticks.run(yardsticks.YARDSTICKS["emps"], tmp_path)
    assert {name: fit.parameters[name].value for name in EMPS} == pytest.approx(EMPS, rel=0.02)
    assert 1e-3 <= errors["pulses"] < 1e-2  # mm: its noise, and a ten-thousandth of the stroke


def test_the_drives_are_fitted_on_their_training_part_alone(tmp_path, monkeypatch):
    yardsticks = load_script("yardsticks", monkeypatch)
    write_drives(tmp_path)
    fit, _, errors = yardsticks.run(yardsticks.YARDSTICKS["ced"], tmp_path)
    for name, value in BELT.items():
        assert abs(fit.parameters[name].value - value) < 3 * fit.parameters[name].std
    assert errors == pytest.approx({"low_amplitude": 0.01, "high_amplitude": 0.01}, rel=0.2)
    write_drives(tmp_path, spoiled=1.0)
    again, _, spoiled = yardsticks.run(yardsticks.YARDSTICKS["ced"], tmp_path)
    assert list(again.parameters.values()) == list(fit.parameters.values())
    assert spoiled == pytest.approx({"low_amplitude": 1.0, "high_amplitude": 1.0}, abs=0.01)


@pytest.mark.slow
def test_the_silverbox_is_simulated_to_its_noise(tmp_path, monkeypatch):
    yardsticks = load_script("yardsticks", monkeypatch)
    write_silverbox(tmp_path)
    fit, hold, errors = yardsticks.run(yardsticks.YARDSTICKS["silverbox"], tmp_path)
    assert hold == "zero"
    assert {name: fit.parameters[name].value for name in SILVERBOX} == pytest.approx(SILVERBOX, rel=0.01)
    assert errors == pytest.approx(dict.fromkeys(("multisine", "arrow", "arrow_without_extrapolation"), 0.2), rel=0.3)


def test_the_table_of_what_sticks_is_written_between_its_marks(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "path", [*sys.path])
    bench, page = load_script("bench_sticking", monkeypatch), tmp_path / "page.md"
    row = {"link": "locked", "seconds": 8.0, "seed": 3, "limit_s": 60.0, "cpu_s": None}
    done = row | {"cpu_s": 0.391, "status": "converged", "met": True, "off": 4.6e-5}
    kept = {"before": [row, done | {"seconds": 30.0, "met": False, "status": "max_iterations"}], "after": [done]}
    page.write_text(f"above\n{bench.MARKS[0]}old\n{bench.MARKS[1]}below\n", encoding="utf-8")
    bench.write_page(page, kept)
    lines = page.read_text(encoding="utf-8").splitlines()
    assert (lines[0], lines[-1]) == ("above", "below") and "old" not in lines
    assert lines[2:6] == [
        "| log | before | after |",
        "|---|---|---|",
        "| 8 s, link held | not done in 60 s | 0.39 s, met, 0.0046 % off |",
        "| 30 s, link held | 0.39 s, max iterations, not met, 0.0046 % off | not measured |",
    ]


def test_a_limit_of_processor_time_ends_what_takes_longer(monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    bench = load_script("bench_sticking", monkeypatch)
    with pytest.raises(TimeoutError), bench.limit_processor(0.05):
        any(number < 0 for number in itertools.count())
    with bench.limit_processor(0.05):
        pass
