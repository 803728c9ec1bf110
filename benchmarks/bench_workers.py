"""What processes gain: certificates, a sweep and a bootstrap here, then on one and two processes.

    python benchmarks/bench_workers.py

Against the clock, on a machine that does nothing else, so the seconds are the best of several runs; and the processor
time of this process and its workers. A pool's first part waits for its processes to start, which is printed by itself.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path

import numpy as np

import seaopt as so
from seaopt.control import sweep
from seaopt.estimation import bootstrap
from seaopt.executors import Processes
from seaopt.files import to_json

RUNS = 3
STAND, SWING, THOR = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)
RANGES = {"I_p": (0.3, 0.5), "k": (0.9 * THOR["k"].value, 1.1 * THOR["k"].value)}


def make_jobs() -> dict[str, Callable[[Executor | None], str]]:
    """Return what is measured, by name; each returns its figures as text, which must be the same every time."""
    controller = so.tune(STAND, THOR, SPEC, robust_to={"swing": SWING})
    drive = so.Log.from_arrays(time=np.arange(20_000) / 400, I=np.random.default_rng(1).normal(size=20_000))
    force = so.simulate(STAND, THOR, drive)["F1"] + np.random.default_rng(2).normal(size=20_000)
    log = so.Log.from_arrays(time=drive.time, I=drive["I"], F1=force)
    fitted = so.fit([so.Experiment(plant=STAND, log=log, outputs=("F1",))], THOR.free("J", "b_r"))

    def certify(samples: int, f_c: float = 0.0) -> Callable[[Executor | None], str]:
        def run(executor: Executor | None) -> str:
            found = so.certify(
                controller,
                {"stand": STAND, "swing": SWING},
                THOR.update(f_c=f_c),
                ranges=RANGES,
                samples=samples,
                executor=executor,
            )
            return str([row.value for row in found.requirements])

        return run

    return {
        "certificate, 1,375 draws": certify(1375),
        "certificate with friction, 1,375 draws": certify(1375, f_c=30.0),
        "certificate, 200,000 draws": certify(200_000),
        "sweep of 12 bandwidths": lambda executor: to_json(
            sweep(STAND, THOR.update(f_c=30.0), SPEC, list(np.linspace(15, 48, 12)), executor=executor).to_dict()
        ),
        "bootstrap, 200 refits": lambda executor: str(bootstrap(fitted, 200, refit=True, executor=executor).draws),
    }


def measure(job: Callable[[Executor | None], str], executor: Executor | None) -> tuple[float, float, str]:
    """Return seconds by the clock and of processors, the best of several runs, and the figures."""
    best, figures = (np.inf, np.inf), ""
    for _ in range(RUNS):
        begun, before = time.perf_counter(), read_time(executor)
        figures = job(executor)
        best = min(best, (time.perf_counter() - begun, read_time(executor) - before))
    return *best, figures


def read_time(executor: Executor | None) -> float:
    """Return the processor time of this process and of an executor's."""
    pool = executor._pool if isinstance(executor, Processes) else None
    fields = (
        Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split() for pid in (pool._processes if pool else ())
    )
    ticks = sum(int(one[11]) + int(one[12]) for one in fields)
    return time.process_time() + ticks / os.sysconf("SC_CLK_TCK")


def main() -> None:
    jobs = make_jobs()
    alone = {name: measure(job, None) for name, job in jobs.items()}
    for name, (seconds, spent, _) in alone.items():
        print(f"{name}, here: {seconds:.2f} s, processors {spent:.2f} s", flush=True)
    for workers in (1, 2):
        with Processes(workers) as executor:
            begun = time.perf_counter()
            list(executor.map(abs, range(2 * workers)))
            print(f"{workers} processes start in {time.perf_counter() - begun:.2f} s")
            for name, job in jobs.items():
                seconds, spent, figures = measure(job, executor)
                assert figures == alone[name][2], name
                ratio = alone[name][0] / seconds
                print(
                    f"{name}, {workers} processes: {seconds:.2f} s ({ratio:.2f} x), processors {spent:.2f} s",
                    flush=True,
                )


if __name__ == "__main__":
    main()
