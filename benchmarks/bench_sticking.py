"""Fits of a knee whose friction sticks, with a free delay: processor time by length of log.

    OMP_NUM_THREADS=1 python -m benchmarks.bench_sticking [SECONDS ...] [--seed 3] [--smooth V_S]

The knee (N = 80, 1 kHz, two encoders and the spring's torque) is simulated by benchmarks/truth, its link held and as a
pendulum; values start off by up to a factor of two. With --smooth friction is smoothed over V_S rad/s instead.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

import seaopt as so

sys.path.insert(0, str(Path(__file__).parent / "truth"))
import actuators

RATE_HZ = 1000.0
KNEE = actuators._rotary(
    J_m=1.2e-4, b_r=5e-4, K_tau=0.08, N=80.0, k_s=350.0, f_c=0.06, torque=0.1, current=8.0, chirp_hz=(0.1, 20.0)
)
FREE = ("J_m", "b_r", "k_s", "f_c", "eta")


def fit_knee(link: str, seconds: float, seed: int, v_s: float | None) -> tuple[so.Fit, float]:
    """Return the fit of a knee's log, and its processor time."""
    actuators.RATE_HZ, actuators.SUBSTEPS, actuators.KINDS["knee"] = RATE_HZ, 400, KNEE
    readings = actuators.Actuator(kind="knee", link=link).record(seconds=seconds, amplitude=1.0, seed=seed)
    log = so.Log.from_arrays(**readings).restamp(rate_hz=RATE_HZ)
    plant = so.plants.rotary(link=link)
    if v_s is None:
        plant = so.plants.let_stick(plant)
    rng = np.random.default_rng(seed)
    known = {name: value for name, value in KNEE.values.items() if name in plant.parameters}
    guess = {name: known[name] * 2.0 ** rng.uniform(-1, 1) for name in FREE}
    smooth = {} if v_s is None else {"v_s": v_s}
    params = plant.defaults.update(**known | guess | smooth).free(*FREE)
    delay = so.Parameter(name="delay", value=1e-3, unit="s", min=0.0, max=0.01, free=True)
    outputs = tuple(name for name in readings if name not in ("time", "I"))
    started = time.process_time()
    fit = so.fit([so.Experiment(plant=plant, log=log, outputs=outputs, delay_s=delay)], params)
    return fit, time.process_time() - started


def main() -> None:
    """Fit logs of the lengths that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seconds", type=float, nargs="*", default=[8.0, 15.0, 30.0, 60.0])
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--smooth", type=float)
    options = parser.parse_args()
    for seconds in options.seconds:
        for link in ("locked", "pendulum"):
            fit, cpu = fit_knee(link, seconds, options.seed, options.smooth)
            off = max(abs(fit.parameters[name].value / KNEE.values[name] - 1.0) for name in FREE)
            met = "met" if fit.met else "not met"
            print(f"{link:8s} {seconds:5.0f} s  {cpu:6.2f} s  {fit.status}, {met}, {100 * off:.2g} % off", flush=True)


if __name__ == "__main__":
    main()
