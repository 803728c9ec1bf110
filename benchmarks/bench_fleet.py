"""What a fleet costs, and whether it stays the same however many logs there are.

    python benchmarks/bench_fleet.py overhead [--logs 200]
    python benchmarks/bench_fleet.py workers [--logs 400]
    python benchmarks/bench_fleet.py scale [--logs 10000] [--workers 2] [--seconds 1] [--rate 200]
    python benchmarks/bench_fleet.py table [--logs 300000]

`overhead`: the same logs are read and fitted in a plain loop, then by `fit_fleet` in this process, and again where
nothing is left to do, in processor time. What the second takes more than the first is hashing, rows and table.
`workers`: logs and samples per second on one and on two processes, started beforehand, against the clock.
`scale`: one run over as many logs, each with noise of its own; every tenth of it what a log cost and what memory client
and workers hold, then what the table took, and how often a C compiler was called.
`table`: the table alone, of as many rows that nobody fitted: added, then replaced.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import tempfile
import time
from collections.abc import Callable, Generator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import polars as pl

import seaopt as so
from seaopt.bench import PAPER_STAND
from seaopt.executors import Processes
from seaopt.fleet.plan import list_columns, make_plan
from seaopt.fleet.table import FleetTable, make_schema

PROBLEM = """
schema = 1
parameters = { J = { value = 2e-6, free = true }, b_r = { value = 2e-4, free = true } }
plant.stand.kind = "high_impedance"
[[experiment]]
name = "test"
plant = "stand"
log = "0000000.csv"
time = "time [s]"
inputs = { I = "I [A]" }
outputs = { F1 = "F1 [N]" }
"""
ACTUATORS = 50  # of different inertias
NOISE_N = 2.0
TENTHS = 10


class Here(Executor):
    """Works at once, in this thread."""

    _max_workers = 1

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        future.set_result(fn(*args, **kwargs))
        return future


@contextmanager
def make_logs(count: int, seconds: float, rate_hz: float) -> Generator[Path]:
    """Yield a folder with a problem file and so many logs, each of an actuator and with noise of its own."""
    with tempfile.TemporaryDirectory(prefix="bench-fleet-") as place:
        folder, plant, truth = Path(place), so.plants.high_impedance(), so.plants.thor()
        (folder / "stand.toml").write_text(PROBLEM)
        sensors, rng = so.Sensors(), np.random.default_rng(1)
        clean = []
        for k in range(min(count, ACTUATORS)):
            params = truth.update(J=truth["J"].value * (0.9 + 0.2 * k / ACTUATORS))
            clean.append(so.virtual_log(
                plant, params, PAPER_STAND, duration_s=seconds, rate_hz=rate_hz, seed=k, sensors=sensors
            ))  # fmt: skip
        for k in range(count):
            if k % 1000 == 0:  # a folder of a million files is slow to list
                (folder / f"{k // 1000:04d}").mkdir()
            log = clean[k % len(clean)]
            force = log["F1"] + NOISE_N * rng.normal(size=log.time.size)
            frame = pl.DataFrame({"time [s]": log.time, "I [A]": log["I"], "F1 [N]": force})
            frame.write_csv(folder / f"{k // 1000:04d}/{k:07d}.csv", float_precision=6)
        yield folder


def list_logs(folder: Path) -> list[Path]:
    return sorted(folder.glob("*/*.csv"))


def measure_overhead(count: int) -> None:
    """Print processor time per log: of the fit alone, of the fleet, of a fleet that is done."""
    with make_logs(count, 10.0, 400.0) as folder:
        problem, paths = so.read_problem(folder / "stand.toml"), list_logs(folder)

        def fit(path: Path) -> bool:
            experiment = problem.repeat_experiment(path)
            return so.fit([experiment], problem.parameters, **problem.fit_options).met

        so.fit_fleet(problem, paths[:1], executor=Here())  # kernels are compiled, modules loaded
        begun = time.process_time()
        sum(map(fit, paths))
        plain = time.process_time() - begun
        for what in ("fleet", "again"):
            begun = time.process_time()
            so.fit_fleet(problem, paths, folder / "out", executor=Here())
            spent = time.process_time() - begun
            more = f", {1e3 * (spent - plain) / count:.1f} ms more than the fit" if what == "fleet" else ""
            print(f"{what}: {1e3 * spent / count:.1f} ms per log{more}")
        print(f"plain loop: {1e3 * plain / count:.1f} ms per log, {count} logs")
        print(f"memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB at most")


def measure_workers(count: int) -> None:
    """Print logs and samples per second on one and two processes."""
    with make_logs(count, 10.0, 400.0) as folder:
        paths = list_logs(folder)
        for workers in (1, 2):
            with Processes(workers) as executor:
                so.fit_fleet(folder / "stand.toml", paths[:20], executor=executor)
                pids = list_workers(executor)
                begun, before = time.perf_counter(), sum(map(read_time, pids))
                fleet = so.fit_fleet(folder / "stand.toml", paths, executor=executor)
                took, spent = time.perf_counter() - begun, sum(map(read_time, pids)) - before
            samples = int(fleet.rows["samples"].sum())
            print(
                f"{workers} workers: {count / took:.1f} logs/s, {samples / took:.0f} samples/s; "
                f"{1e3 * spent / count:.1f} ms of processor time per log; {fleet.verdict}"
            )


def measure_scale(count: int, workers: int, seconds: float, rate_hz: float) -> None:
    """Print what a log costs, and who holds how much memory, along one run over many logs."""
    begun = time.perf_counter()
    with make_logs(count, seconds, rate_hz) as folder, count_compilers(folder / "compilers") as list_calls:
        paths = [str(path) for path in list_logs(folder)]
        print(
            f"{count} logs of {seconds:g} s at {rate_hz:g} Hz made in {time.perf_counter() - begun:.0f} s", flush=True
        )
        print("   logs   wall s   workers' s   client's s   ms per log   workers MB      client MB   parts", flush=True)
        with Processes(workers) as executor:
            tell = Tell(count, folder / "out/fleet", executor)
            fleet = so.fit_fleet(folder / "stand.toml", paths, folder / "out", executor=executor, progress=tell)
            tell.show(count)
            before = time.process_time()
            again = so.fit_fleet(folder / "stand.toml", paths, folder / "out", executor=executor)
            print(f"again: {again.unchanged} unchanged, client {time.process_time() - before:.1f} s of processor time")
        size = sum(path.stat().st_size for path in (folder / "out/fleet").iterdir())
        print(f"{fleet.verdict}; table {size / 1e6:.1f} MB; calls of a C compiler: {len(list_calls())}")
        print(
            f"std of J over actuators and noise: {fleet.rows['J'].std():.3e}, stated {fleet.rows['J_std'].median():.3e}"
        )


def measure_table(count: int) -> None:
    """Print what a row costs along a table that grows, and one that is replaced, and what memory that takes."""
    with make_logs(1, 1.0, 200.0) as folder:
        plan = make_plan(so.read_problem(folder / "stand.toml"), None, None, "bench")
        table = FleetTable(folder / "out", make_schema(list_columns(plan.make_problem()), ()), plan)
        row = {"status": "met", "J": 1e-6, "J_std": 1e-9, "log_sha256": "0" * 64, "findings": []}
        for what in ("added", "replaced"):
            for tenth in range(TENTHS):
                begun = time.process_time()
                for start in range(tenth * count // TENTHS, (tenth + 1) * count // TENTHS, 100):
                    table.add([row | {"log": f"/logs/{k:09d}.csv"} for k in range(start, start + 100)])
                spent = 1e6 * (time.process_time() - begun) * TENTHS / count
                memory = read_memory(os.getpid())
                print(f"{what} {(tenth + 1) * count // TENTHS}: {spent:.0f} us per row, {memory:.0f} MB", flush=True)
            begun = time.process_time()
            table.finish()
            print(f"finished in {time.process_time() - begun:.1f} s, {len(table.parts())} files")
        table.close()


class Tell:
    """Prints a line every tenth of a run."""

    def __init__(self, count: int, table: Path, executor: Processes) -> None:
        self.count, self.table, self.executor = count, table, executor
        self.begun, self.client, self.printed = time.perf_counter(), time.process_time(), 0
        self.last = (0, 0.0)

    def __call__(self, text: str, share: float | None = None, /) -> None:
        if share is not None and share * TENTHS >= self.printed + 1:
            self.show(int(text.split()[0]))
            self.printed = int(share * TENTHS)

    def show(self, done: int) -> None:
        pids = list_workers(self.executor)
        spent, client = sum(map(read_time, pids)), time.process_time() - self.client
        each = 1e3 * (spent - self.last[1]) / max(done - self.last[0], 1)
        held = ", ".join(f"{read_memory(pid):.0f}" for pid in pids)
        parts = len(list(self.table.glob("*.parquet")))
        print(
            f"{done:7d} {time.perf_counter() - self.begun:8.0f} {spent:12.1f} {client:12.1f} {each:12.1f}   {held:12s} "
            f"{read_memory(os.getpid()):12.0f} {parts:7d}", flush=True,
        )  # fmt: skip
        self.last = (done, spent)


def list_workers(executor: Processes) -> list[int]:
    """Return the processes of an executor."""
    return sorted((executor._pool._processes if executor._pool else None) or {})


def read_time(pid: int) -> float:
    """Return the processor time of a process so far, in seconds."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def read_memory(pid: int) -> float:
    """Return what a process holds in memory now, in MB."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


@contextmanager
def count_compilers(folder: Path) -> Generator[Callable[[], list[str]]]:
    """Yield what lists the calls of a C compiler from here on, with a cache of kernels that is empty."""
    compiler, calls = shutil.which("cc"), folder / "calls"
    (folder / "cache").mkdir(parents=True)
    calls.touch()
    (folder / "cc").write_text(f'#!/bin/sh\necho "$@" >> {calls}\nexec {compiler} "$@"\n')
    (folder / "cc").chmod(0o755)
    before = {name: os.environ.get(name) for name in ("SEAOPT_COMPILER", "SEAOPT_CACHE_DIR")}
    os.environ |= {"SEAOPT_COMPILER": str(folder / "cc"), "SEAOPT_CACHE_DIR": str(folder / "cache")}
    try:
        yield lambda: calls.read_text().splitlines()
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["overhead", "workers", "scale", "table"])
    parser.add_argument("--logs", type=int)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--rate", type=float, default=200.0)
    given = parser.parse_args()
    for name in ("OPENBLAS_NUM_THREADS", "POLARS_MAX_THREADS"):  # as the command does
        os.environ.setdefault(name, "1")
    if given.what == "overhead":
        measure_overhead(given.logs or 200)
    elif given.what == "workers":
        measure_workers(given.logs or 400)
    elif given.what == "table":
        measure_table(given.logs or 300_000)
    else:
        measure_scale(given.logs or 10_000, given.workers, given.seconds, given.rate)


if __name__ == "__main__":
    main()
