"""What things cost as ratios within one run: `make bench` writes the table, `make bench-check` compares with it.

    python benchmarks/table.py [--out FILE.json] [--check KEPT.json] [--only WORD]

Each case takes turns with a yardstick that does related work with bare NumPy, SciPy, polars or CasADi. Of each the
least processor time counts, children included. A ratio is compared with ratios only: another machine moves both. A case
that seems to have lost is measured twice more before it is named.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

# Before NumPy: a second thread on a busy core costs more than it brings.
os.environ |= {"OPENBLAS_NUM_THREADS": "1", "POLARS_MAX_THREADS": "1"}
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # a process would compile all of seaopt, and not its yardstick

import casadi as ca
import numpy as np
import polars as pl
from scipy.signal import lfilter

import seaopt as so
from seaopt.bench import PAPER_STAND
from seaopt.robustness import batch_figures

LOST = 1.10
LEAST_ROUNDS, MOST_ROUNDS, SECONDS = 3, 40, 2.0
PACKAGES = ("seaopt", "casadi", "numpy", "scipy", "polars", "control", "osqp", "pydantic")
Call = Callable[[], Any]


def spend(call: Call) -> float:
    """Return the processor time of a call and of the processes that it starts."""

    def now() -> float:
        children = resource.getrusage(resource.RUSAGE_CHILDREN)
        return time.process_time() + children.ru_utime + children.ru_stime

    began = now()
    call()
    return now() - began


def measure(ours: Call, yardstick: Call, seconds: float = SECONDS) -> tuple[float, float, int]:
    """Return the least times of both, taken in turn, and the number of rounds; the first round warms up."""
    rounds: list[tuple[float, float]] = []
    spend(ours), spend(yardstick)
    while len(rounds) < LEAST_ROUNDS or (len(rounds) < MOST_ROUNDS and np.sum(rounds) < seconds):
        rounds.append((spend(ours), spend(yardstick)))
    return *(float(least) for least in np.min(rounds, axis=0)), len(rounds)


def run_python(*arguments: str) -> None:
    """Run a fresh interpreter."""
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True)


def filter_log(log: so.Log) -> np.ndarray:
    """Return the normal matrix of two outputs' sensitivities to five unknowns: one pass of a fit, by SciPy."""
    columns = [lfilter([0.1, 0.1], [1.0, -1.5, 0.7 + 0.01 * i], log["I"]) for i in range(10)]
    table = np.column_stack([*columns, log["F1"], log["F2"]])
    return table.T @ table


def make_rollout(log: so.Log) -> Call:
    """Return a simulation of the stand with friction in CasADi's virtual machine, four Runge-Kutta steps a sample."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    rate = lambda x: ca.vertcat(x[1], 0.8 * u - 12 * x[1] - 0.4 * ca.tanh(x[1] / 5e-3) - 2620 * x[0])  # noqa: E731
    end, h = x, 1 / 1600
    for _ in range(4):
        k1 = rate(end)
        k2 = rate(end + h / 2 * k1)
        k3 = rate(end + h / 2 * k2)
        end += h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(end + h * k3))
    steps = ca.Function("step", [x, u], [end]).mapaccum(len(log))
    return lambda: steps(0, log["I"][None])


def solve_matrices() -> tuple[np.ndarray, np.ndarray]:
    """Return the eigenvalues of 2,000 loops of 8 states and the responses of 50, by NumPy."""
    loops = np.random.default_rng(0).normal(size=(2000, 8, 8)) / 4
    z = np.exp(1j * np.linspace(0.01, 3.0, 200))[:, None, None, None]
    return np.linalg.eigvals(loops), np.linalg.solve(z * np.eye(8) - loops[:50], np.ones((8, 1)))


def list_cases(folder: Path) -> Iterator[tuple[str, Call, str, Call]]:
    """Yield what is measured: its name, the call, what the yardstick does, and its call."""
    stand, swing, thor = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
    sensors = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0})
    record = partial(so.virtual_log, stand, rate_hz=400, seed=1, sensors=sensors)

    bare = ("import numpy", partial(run_python, "-c", "import numpy"))
    yield "seaopt --version, a process", partial(run_python, "-m", "seaopt", "--version"), *bare
    libraries = "import casadi, polars, pydantic, scipy.linalg"
    imports = (libraries, partial(run_python, "-c", libraries))
    names = "import seaopt as so; [getattr(so, name) for name in so.__all__]"
    yield "import of every name, a process", partial(run_python, "-c", names), *imports
    problem = folder / "demo.toml"
    problem.write_text(so.demo_path().read_text(), encoding="utf-8")
    command = ("-m", "seaopt", "fit", str(problem), "-o", str(folder / "fit"))
    yield "seaopt fit of the demo, a process", partial(run_python, *command), *imports

    log = record(thor, PAPER_STAND, duration_s=164)
    path = so.write_log(log, folder / "chirp.csv")
    channels = {"I": "I [A]", "F1": "F1 [N]", "F2": "F2 [N]"}
    read = partial(so.read_log, path, time="time [s]", channels=channels)
    yield "read 65,600 rows of CSV", read, "polars.read_csv", partial(pl.read_csv, path)

    start = thor.update(J=1e-6, b_r=4e-4, eta=0.4).free("J", "b_r", "eta")
    experiments = [so.Experiment(plant=stand, log=log, outputs=("F1", "F2"))]
    fit = partial(so.fit, experiments, start)
    by_filter = ("12 columns by scipy.signal.lfilter", partial(filter_log, log))
    yield "linear fit, 65,600 x 2", fit, *by_filter
    yield "linear fit without diagnostics", partial(fit, diagnostics=False), *by_filter

    truth = thor.update(f_c=60.0, v_s=5e-3)
    rough = record(truth, PAPER_STAND, duration_s=20)
    rollout = ("CasADi's mapaccum of the same steps", make_rollout(rough))
    start = truth.update(J=2e-6, b_r=2e-4, eta=0.8, f_c=20.0).free("J", "b_r", "eta", "f_c")
    fit = partial(so.fit, [so.Experiment(plant=stand, log=rough, outputs=("F1", "F2"))], start)
    yield "friction fit, 8,000 x 2", fit, *rollout
    yield "friction fit without diagnostics", partial(fit, diagnostics=False), *rollout

    loops = ("eigenvalues and responses by NumPy", solve_matrices)
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_complementary=1.3, max_noise_gain=25)
    robust = {"swing": swing}
    yield "tune at 30 Hz", partial(so.tune, stand, thor, spec, robust), *loops
    slow = so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6, max_complementary=1.3, max_noise_gain=25)
    yield "tune with friction", partial(so.tune, stand, truth, slow, robust), *loops
    law, plants = so.tune(stand, thor, spec, robust), {"stand": stand, "swing": swing}
    certify = partial(so.certify, law, plants, thor, ranges={"I_p": (0.2, 0.6)}, samples=200)
    yield "certificate, 200 draws, steps simulated", certify, *loops
    draws = {"J": 3.31e-6 * np.random.default_rng(0).uniform(0.8, 1.2, 10_000)}
    yield "Ms and Mt of 10,000 plants", partial(batch_figures, law, stand, thor, draws), *loops


def describe_machine() -> dict[str, Any]:
    """Return what the times depend on."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    return {
        "processor": next((line.split(":")[1].strip() for line in lines if "model name" in line), platform.machine()),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "load": round(os.getloadavg()[0], 1),
    }


def format_table(result: dict[str, Any]) -> str:
    """Return a run in Markdown."""
    machine = ", ".join(f"{name} {value}" for name, value in result["machine"].items())
    versions = ", ".join(f"{name} {value}" for name, value in result["versions"].items())
    lines = ["| what | processor time, s | yardstick | its time, s | ratio |", "|---|---|---|---|---|"]
    lines += [
        f"| {name} | {case['s']:.4g} | {case['yardstick']} | {case['yardstick_s']:.4g} | {case['ratio']:.3g} |"
        for name, case in result["cases"].items()
    ]
    return "\n".join([*lines, "", f"{machine}; {versions}. `make bench`", ""])


def find_losses(cases: dict[str, Any], kept: dict[str, Any]) -> list[str]:
    """Return what lost more than a tenth against the table that is kept, in words."""
    shared = [name for name in cases if name in kept]
    return [
        f"{name}: {kept[name]['ratio']:.3g} to {cases[name]['ratio']:.3g} times {kept[name]['yardstick']}"
        for name in shared
        if cases[name]["ratio"] > LOST * kept[name]["ratio"]
    ]


def main() -> int:
    """Measure, write and compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/bench.json"))
    parser.add_argument("--check", type=Path, help="the table to compare with")
    parser.add_argument("--only", default="", help="cases whose name contains this")
    options = parser.parse_args()
    kept = json.loads(options.check.read_text())["cases"] if options.check else {}
    machine, cases = describe_machine(), {}
    with tempfile.TemporaryDirectory() as folder:
        for name, ours, what, yardstick in list_cases(Path(folder)):
            if options.only not in name:
                continue
            for _ in range(3):
                took, base, rounds = measure(ours, yardstick)
                case = {"s": took, "yardstick": what, "yardstick_s": base, "ratio": took / base, "rounds": rounds}
                if name not in cases or case["ratio"] < cases[name]["ratio"]:
                    cases[name] = case
                if not find_losses({name: cases[name]}, kept):
                    break
            print(f"{name:40s} {cases[name]['s']:8.4f} s {cases[name]['ratio']:9.3f} of {what}", flush=True)
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    result = {"machine": machine, "versions": versions, "cases": cases}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    options.out.with_suffix(".md").write_text(format_table(result), encoding="utf-8")
    losses = find_losses(cases, kept)
    for loss in losses:
        print(f"lost more than 10 %: {loss}")
    if options.check:
        gone = sorted(set(kept) - set(cases)) if not options.only else []
        print(
            f"{len(losses)} of {len(cases)} lost more than 10 %" + "".join(f"; not measured: {name}" for name in gone)
        )
    return 1 if losses else 0


if __name__ == "__main__":
    sys.exit(main())
