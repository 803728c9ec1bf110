"""What a fleet costs beyond its fits, in processor time per log: python benchmarks/bench_fleet.py [LOGS].

The same logs of 10 s at 400 Hz are read and fitted in a plain loop, then by `fit_fleet` in this process, and again
where nothing is left to do. What the second takes more than the first is the overhead: hashing, rows, table.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from concurrent.futures import Executor, Future
from pathlib import Path

import seaopt as so
from seaopt.bench import PAPER_STAND

PROBLEM = """
schema = 1
parameters = { J = { value = 2e-6, free = true }, b_r = { value = 2e-4, free = true } }
plant.stand.kind = "high_impedance"
[[experiment]]
name = "test"
plant = "stand"
log = "0.csv"
time = "time [s]"
inputs = { I = "I [A]" }
outputs = { F1 = "F1 [N]" }
"""
DIFFERENT = 10  # contents; the others are copies, which a fleet fits all the same


class Here(Executor):
    """Works at once, in this thread."""

    _max_workers = 1

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        future.set_result(fn(*args, **kwargs))
        return future


def main(count: int) -> None:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "stand.toml").write_text(PROBLEM)
        plant, truth, cells = so.plants.high_impedance(), so.plants.thor(), so.Sensors(noise_std={"F1": 2.0})
        for k in range(count):
            if k < DIFFERENT:
                log = so.virtual_log(plant, truth, PAPER_STAND, duration_s=10, rate_hz=400, seed=k, sensors=cells)
                so.write_log(log, folder / f"{k}.csv")
            else:
                (folder / f"{k}.csv").write_bytes((folder / f"{k % DIFFERENT}.csv").read_bytes())
        problem = so.read_problem(folder / "stand.toml")

        def fit(path: Path) -> bool:
            experiment = problem.repeat_experiment(path)
            return so.fit([experiment], problem.parameters, **problem.fit_options).met

        paths = sorted(folder.glob("*.csv"))
        so.fit_fleet(problem, paths[:1], executor=Here())  # kernels are compiled, modules loaded
        begun = time.process_time()
        assert all(map(fit, paths))
        plain = time.process_time() - begun
        for what in ("fleet", "again"):
            begun = time.process_time()
            assert so.fit_fleet(problem, paths, folder / "out", executor=Here()).met
            spent = time.process_time() - begun
            more = f", {1e3 * (spent - plain) / count:.1f} ms more than the fit" if what == "fleet" else ""
            print(f"{what}: {1e3 * spent / count:.1f} ms per log{more}")
        print(f"plain loop: {1e3 * plain / count:.1f} ms per log, {count} logs")
        print(f"memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB at most")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
