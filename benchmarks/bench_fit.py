"""What a fit costs, side by side in one run: `python benchmarks/bench_fit.py [--quick]`.

1. The stand, 65,600 samples of two outputs: the fit with and without diagnostics against pandas.read_csv of the same
   log's CSV, the shortest of many of each, taken in turn; and one pass against a pass written by hand in C
   (hand_pass.c), same recursion, same compiler and flags.
2. Stand and swing together, nonlinear with friction: 2 x 24,000 samples of two outputs, six parameters.
3. The stand from 10^4 to 10^7 samples: time, and peak memory over that of the log itself, each in a process of its own.

pandas is the only thing that is needed besides seaopt: the extra `bench`.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import seaopt as so
from seaopt.bench import PAPER_STAND, PAPER_SWING
from seaopt.simulation import Clock, Point, Segment, make_model, run_passes, transition
from seaopt.simulation.native import FLAGS, NATIVE, find_compiler

FREE = ("J", "b_r", "eta")
ROUNDS = 40
HERE = Path(__file__).resolve().parent
SENSORS = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0})


def best(call: Callable[[], Any], rounds: int) -> float:
    """Return the shortest time of a call, after one to warm up."""
    call()
    times = []
    for _ in range(rounds):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return min(times)


def spent(call: Callable[[], Any]) -> tuple[float, float]:
    """Return the wall time of a call, and the processor time of all its threads."""
    began, used = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - began, time.process_time() - used


def stand_log(duration_s: float) -> so.Log:
    """Return the paper's experiment."""
    stand, thor = so.plants.high_impedance(), so.plants.thor()
    return so.virtual_log(stand, thor, PAPER_STAND, duration_s=duration_s, rate_hz=400, seed=1, sensors=SENSORS)


def start() -> so.ParameterSet:
    """Return a start off by factors of two to three."""
    return so.plants.thor().update(J=1e-6, b_r=4e-4, eta=0.4).free(*FREE)


def against_reading() -> None:
    """Print the stand fit beside reading its CSV."""
    try:
        import pandas as pd
    except ImportError:
        print('pandas is not installed, so that its reading is not compared; pip install "seaopt[bench]"')
        return
    log = stand_log(164)
    experiment = so.Experiment(plant=so.plants.high_impedance(), log=log, outputs=("F1", "F2"))
    with tempfile.TemporaryDirectory() as folder:
        path = so.write_log(log, Path(folder) / "chirp.csv")
        calls = {
            "pandas.read_csv": lambda: pd.read_csv(path),
            "with diagnostics": lambda: so.fit([experiment], start()),
            "without": lambda: so.fit([experiment], start(), diagnostics=False),
        }
        for call in calls.values():
            call()
        rounds = [[spent(call) for call in calls.values()] for _ in range(ROUNDS)]  # in turn: a busy moment hits all
    shortest = dict(zip(calls, np.min(rounds, axis=0), strict=True))
    read = shortest.pop("pandas.read_csv")
    for name, took in shortest.items():
        print(
            f"stand fit, {len(log)} x 2, {name}: {1e3 * took[0]:.1f} ms, {took[0] / read[0]:.2f} of pandas.read_csv "
            f"({1e3 * read[0]:.1f} ms); {1e3 * took[1]:.1f} ms of processor time, {took[1] / read[1]:.2f} of "
            f"{1e3 * read[1]:.1f} ms"
        )


def against_hand() -> None:
    """Print one pass beside one written by hand."""
    stand, thor = so.plants.high_impedance(), so.plants.thor()
    log = stand_log(164)
    model = make_model(stand, thor, FREE, ("F1", "F2"))
    segment = Segment(u=(log["I"],), y=(log["F1"], log["F2"]))
    point = Point(
        theta=np.array(thor.values_of(FREE)), offset=np.zeros(2), gain=np.ones(2), clock=Clock(period=log.period),
        drift=np.zeros((2, 0)),
    )  # fmt: skip
    x0 = np.zeros(2)
    compiler = find_compiler()
    if compiler is None:
        print("no C compiler: no pass to compare")
        return
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "hand.so"
        command = [
            *compiler,
            *FLAGS,
            *NATIVE,
            "-fvisibility=default",
            str(HERE / "hand_pass.c"),
            "-o",
            str(library),
            "-lm",
        ]
        subprocess.run(command, check=True)
        hand = ctypes.CDLL(str(library)).hand_pass
        hand.argtypes = [ctypes.c_long, *([ctypes.c_void_p] * 5)]
        blocks = transition(model, point.theta, point.clock)[:, :, [0, 1, 2, 4]]
        numbers = np.concatenate(
            [blocks[0, :2].ravel(), blocks[1:, :2].ravel(), blocks[0, 2:].ravel(), blocks[1:, 2:].ravel()]
        )
        gram = np.zeros((2, 8, 8))
        arrays = [np.ascontiguousarray(a) for a in (log["I"], log["F1"], log["F2"], numbers)]

        def by_hand() -> None:
            hand(len(log), *(a.ctypes.data for a in arrays), gram.ctypes.data)

        ours = run_passes(model, segment, point, x0).gram
        by_hand()
        np.testing.assert_allclose(ours, gram, rtol=1e-9, atol=1e-9 * np.max(gram))
        pairs = [(best(lambda: run_passes(model, segment, point, x0), 3), best(by_hand, 3)) for _ in range(9)]
    mine, theirs = (float(np.min(column)) for column in zip(*pairs, strict=True))
    # ours runs the log's two halves at once, where there are two cores
    print(f"one pass: {1e3 * mine:.2f} ms, {mine / theirs:.2f} of one written by hand ({1e3 * theirs:.2f} ms)")


def joint() -> None:
    """Print the joint nonlinear fit."""
    stand, swing = so.plants.high_impedance(), so.plants.moving_output()
    truth = so.plants.thor().update(f_c=30.0, v_s=5e-3, d=0.1, eta=0.95)
    experiments = [
        so.Experiment(
            plant=plant, outputs=("F1", "F2"), name=name,
            log=so.virtual_log(plant, truth, excitation, duration_s=60, rate_hz=400, seed=5, sensors=SENSORS),
        )
        for name, plant, excitation in (("stand", stand, PAPER_STAND), ("swing", swing, PAPER_SWING))
    ]  # fmt: skip
    begin = truth.update(J=2e-6, b_r=2e-4, eta=0.8, f_c=10.0, I_p=0.5, d=0.3).free("J", "b_r", "eta", "f_c", "I_p", "d")
    fit = so.fit(experiments, begin)
    so.testing.assert_recovered(fit, truth, sigmas=4.5)
    took = best(lambda: so.fit(experiments, begin), 3)
    bare = best(lambda: so.fit(experiments, begin, diagnostics=False), 3)
    steps = [own.substeps for own in fit.nuisance.values()]
    print(
        f"stand and swing with friction, 2 x 24,000 x 2, six parameters: {took:.2f} s "
        f"({bare:.2f} s without diagnostics), {fit.iterations} iterations, "
        f"{steps} steps a sample, step error {fit.step_error_parameter:.2g} std"
    )


def one_size(n: int) -> None:
    """Print, as JSON, what a fit of n samples takes; run in a process of its own."""
    rng = np.random.default_rng(0)
    t = np.arange(n) / 400.0
    log = so.Log.from_arrays(time=t, I=np.cumsum(rng.normal(size=n)) * 0.0 + rng.normal(size=n), F1=t * 0.0, F2=t * 0.0)
    del t
    stand, thor = so.plants.high_impedance(), so.plants.thor()
    model = make_model(stand, thor, (), ("F1", "F2"))
    point = Point(
        theta=np.zeros(0), offset=np.zeros(2), gain=np.ones(2), clock=Clock(period=1 / 400), drift=np.zeros((2, 0))
    )
    found = run_passes(model, Segment(u=(log["I"],)), point, np.zeros(2), outputs=True).outputs
    assert found is not None
    for o, name in enumerate(("F1", "F2")):
        log[name].setflags(write=True)
        log[name][:] = found[:, o]
        log[name][:] += 2.0 * rng.normal(size=n)
    del found
    experiment = so.Experiment(plant=stand, log=log, outputs=("F1", "F2"))
    small = so.Experiment(plant=stand, log=log.between(0, 20), outputs=("F1", "F2"))
    so.fit([small], start())  # compiles, imports
    before = _memory_now()
    _reset_peak()
    began = time.perf_counter()
    fit = so.fit([experiment], start())
    took = time.perf_counter() - began
    so.testing.assert_recovered(fit, thor, sigmas=4.5)
    size = 32 * n
    print(json.dumps({"n": n, "s": took, "log": size, "before": before, "peak": _peak()}))


def _memory_now() -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) * 1024
    return 0


def _reset_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def _peak() -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def growth(sizes: tuple[int, ...]) -> None:
    """Print time and memory against the log's length."""
    for n in sizes:
        done = subprocess.run(
            [sys.executable, __file__, "--one", str(n)], check=True, capture_output=True, text=True, env=os.environ
        )
        row = json.loads(done.stdout)
        print(
            f"{n:>10,} samples: {row['s']:.3f} s, {1e6 * row['s'] / n:.2f} us each; peak {row['peak'] / 1e6:.0f} MB, "
            f"{row['peak'] / row['log']:.2f} of the log "
            f"({row['log'] / 1e6:.0f} MB; {row['before'] / 1e6:.0f} MB before)"
        )


def main() -> None:
    """Run all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--one", type=int)
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    if arguments.one:
        one_size(arguments.one)
        return
    against_reading()
    against_hand()
    joint()
    growth((10_000, 100_000, 1_000_000) if arguments.quick else (10_000, 100_000, 1_000_000, 10_000_000))


if __name__ == "__main__":
    main()
