"""What processes gain: small jobs of every kind on one and on two processes, in one run.

    python benchmarks/bench_workers.py

Seconds by the clock. One and two processes do a job in turn, so that what else the machine does meets both, and the
best of the runs counts; say how busy the machine was when ratios are quoted. All processes have started before.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import Executor

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # inherited by the processes, which would fight over cores

import numpy as np

import seaopt as so
from seaopt.control import Impedance, MPCSpec, add_impedance, force_mpc, sweep, tune_schedule
from seaopt.estimation import bootstrap
from seaopt.executors import Processes

Job = Callable[[Executor | None], object]
RUNS = 2
STAND, SWING, THOR = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)
RANGES = {"I_p": (0.3, 0.5), "k": (0.95 * THOR["k"].value, 1.05 * THOR["k"].value)}


def make_certificate(samples: int) -> Job:
    controller = so.tune(STAND, THOR, SPEC, robust_to={"swing": SWING})
    plants = {"stand": STAND, "swing": SWING}
    return lambda executor: so.certify(controller, plants, THOR, ranges=RANGES, samples=samples, executor=executor)


def make_bootstrap() -> Job:
    rng = np.random.default_rng(1)
    drive = so.Log.from_arrays(time=np.arange(8000) / 400, I=rng.normal(size=8000))
    force = so.simulate(STAND, THOR, drive)["F1"] + rng.normal(size=8000)
    log = so.Log.from_arrays(time=drive.time, I=drive["I"], F1=force)
    fitted = so.fit([so.Experiment(plant=STAND, log=log, outputs=("F1",))], THOR.free("J", "b_r"))
    return lambda executor: bootstrap(fitted, 200, refit=True, executor=executor)


def make_sweep() -> Job:
    return lambda executor: sweep(STAND, THOR.update(f_c=30.0), SPEC, list(np.linspace(15, 48, 8)), executor=executor)


def make_schedule() -> Job:
    spec = so.ControllerSpec(structure="pd", bandwidth_hz=20, max_sensitivity=1.6, max_noise_gain=25)
    schedule, ranges = tune_schedule(STAND, THOR, spec, "k", [5e5, 6e5]), {"J": (3.2e-6, 3.4e-6)}
    return lambda executor: so.certify(schedule, {"stand": STAND}, THOR, ranges=ranges, samples=20, executor=executor)


def make_plan() -> Job:
    mpc, ranges = force_mpc(STAND, THOR, MPCSpec(current_limit_A=9.0, bandwidth_hz=20)), {"J": (2e-6, 5e-6)}
    sensors = so.Sensors(noise_std={"F1": 1.0})
    return lambda executor: so.certify(
        mpc, {"stand": STAND}, THOR, ranges=ranges, samples=100, runs=20, sensors=sensors, executor=executor
    )


def make_impedance() -> Job:
    knee, held = so.plants.rotary(link="pendulum"), so.plants.rotary(link="locked")
    values = knee.defaults.update(N=50.0, k_s=300.0, J_l=0.3, d_l=0.5, m=4.0, L=0.2, f_c=0.0)
    law = so.tune(held, values, so.ControllerSpec(measured="tau_s", bandwidth_hz=15, max_sensitivity=1.6))
    law = add_impedance(law, knee, values, Impedance(stiffness=20.0, damping=1.0), name="knee")
    ranges = {"m": (3.0, 5.0), "k_s": (250.0, 350.0)}
    return lambda executor: so.certify(
        law, {"knee": knee}, values, ranges=ranges, samples=40, simulations=False, executor=executor
    )


JOBS: dict[str, Callable[[], Job]] = {
    "certificate, 1,375 draws": lambda: make_certificate(1375),
    "certificate, 50,000 draws": lambda: make_certificate(50_000),
    "bootstrap, 200 refits of 20 s": make_bootstrap,
    "sweep of 8 bandwidths": make_sweep,
    "schedule certificate, 20 draws": make_schedule,
    "MPC certificate, 20 runs": make_plan,
    "impedance certificate, 40 draws": make_impedance,
}


def measure(job: Job, executor: Executor) -> float:
    """Return the seconds of one run."""
    begun = time.perf_counter()
    job(executor)
    return time.perf_counter() - begun


def main() -> None:
    with Processes(1) as one, Processes(2) as two:
        for executor, workers in ((one, 1), (two, 2)):
            begun = time.perf_counter()
            list(executor.map(abs, range(2 * workers)))
            print(f"{workers} processes start in {time.perf_counter() - begun:.2f} s", flush=True)
        for name, make in JOBS.items():
            job, best = make(), [np.inf, np.inf]
            for _ in range(RUNS):
                best = [min(before, measure(job, pool)) for before, pool in zip(best, (one, two), strict=True)]
            load = os.getloadavg()[0]
            print(
                f"{name}: {best[0]:.2f} s on one, {best[1]:.2f} s on two: {best[0] / best[1]:.2f} x, load {load:.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
