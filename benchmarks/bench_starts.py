"""How often each method finds the truth from a random start: every built-in plant, factors of 0.1 to 10.

    python benchmarks/bench_starts.py [starts] [--plant NAME] [--method NAME]

A log of 12 s at 400 Hz (noise over 0 to 60 Hz, sensors with 0.5 % of each output's spread as noise), one draw of
starts a plant, log-uniform and independent. Recovered: every free parameter within 5 standard deviations or 2 % of the
truth.

Two plants of problems/ come with logs of their own: a flexible link whose mode rings for minutes (damping ratio 3e-4 to
2e-3, 30 to 60 s at 1 kHz, servo steps and squares, noise of 0.3 to 10 %, another log for every start), and the EMPS
drive with friction, noise of 0.2 % and viscous friction that drives in every second start.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import scipy.signal

import seaopt as so
from seaopt.bench import Noise

sys.path.append(str(Path(__file__).resolve().parents[1] / "problems"))
import emps
import flexlink

FRICTION = {"f_c": 30.0, "v_s": 5e-3}
PLANTS: dict[str, tuple[so.Plant, tuple[str, ...], dict[str, float], tuple[str, ...]]] = {
    "stand": (so.plants.high_impedance(), ("J", "b_r", "eta"), {}, ("F1", "F2")),
    "stand, k for eta": (so.plants.high_impedance(), ("J", "b_r", "k"), {}, ("F1", "F2")),
    "stand, friction": (so.plants.high_impedance(), ("J", "b_r", "eta", "f_c"), FRICTION, ("F1", "F2")),
    "stand, lumped": (so.plants.high_impedance(drive="lumped"), ("J", "b_r", "eta"), {}, ("F1", "F2")),
    "stand, spring at link 2": (so.plants.high_impedance(spring="link2"), ("J", "b_r", "eta"), {}, ("F1", "F2")),
    "swing": (so.plants.moving_output(), ("J", "b_r", "eta", "I_p", "d"), {"d": 0.5}, ("F1", "F2", "phi")),
    "swing, friction": (
        so.plants.moving_output(), ("J", "b_r", "eta", "f_c", "I_p", "d"), {"d": 0.5, **FRICTION}, ("F1", "F2", "phi"),
    ),
    "swing, lumped": (
        so.plants.moving_output(drive="lumped"), ("J", "b_r", "eta", "I_p", "d"), {"d": 0.5}, ("F1", "F2", "phi"),
    ),
    "two masses": (so.plants.two_link("mass", "mass"), ("J", "b_r", "eta", "m_1", "m_2"), {}, ("F1", "F2")),
    "mass and pendulum": (
        so.plants.two_link("mass", "pendulum"), ("J", "b_r", "eta", "m_1", "I_p2"), {"d2": 0.5}, ("F1", "F2"),
    ),
    "rotary": (so.plants.rotary(), ("J_m", "b_r", "k_s", "J_l", "d_l"), {"d_l": 0.2}, ("tau_s", "theta_m", "theta_l")),
}  # fmt: skip
METHODS = {
    "output_error": so.OutputError(),
    "multiple_shooting": so.MultipleShooting(),
    "prediction_error": so.PredictionError(),
}


def case(name: str) -> tuple[so.Experiment, so.ParameterSet, tuple[str, ...]]:
    """Return the experiment, the truth and the free names of a plant."""
    plant, free, changes, outputs = PLANTS[name]
    truth = plant.defaults.update(**changes)
    log = so.virtual_log(plant, truth, (Noise(std=1.0, band_hz=60),), duration_s=12, rate_hz=400, seed=3)
    rng = np.random.default_rng(4)
    channels: dict[str, Any] = {i: log[i] for i in plant.inputs if i in log.signals}
    channels |= {o: log[o] + 0.005 * np.std(log[o]) * rng.normal(size=len(log)) for o in outputs}
    noisy = so.Log.from_arrays(time=log.time, **channels)
    return so.Experiment(plant=plant, log=noisy, outputs=outputs, name="log"), truth, free


def light_link(number: int) -> tuple[so.Experiment, so.ParameterSet, tuple[str, ...]]:
    """Return a servo's steps or squares and the deflection of a link that rings; k stands for 2.9 Hz."""
    rng = np.random.default_rng([9, number])
    ratio, rate = 10.0 ** rng.uniform(-3.5, -2.7), 1000.0
    values = {"k": 340.0, "c": 2.0 * ratio * np.sqrt(340.0), "gamma": 1.2}
    n = int(rate * rng.uniform(30.0, 60.0))
    hold = int(rate * rng.uniform(1.5, 4.0))
    levels = rng.uniform(-0.8, 0.8, n // hold + 1) if number % 2 else 0.6 * (-1.0) ** np.arange(n // hold + 1)
    servo = (2.0 * np.pi * rng.uniform(3.0, 6.0)) ** 2
    hub = _filter([servo], [1.0, 1.4 * np.sqrt(servo), servo], np.repeat(levels, hold)[:n], "zoh")
    link = [1.0, values["c"], values["k"]]
    alpha = _filter([-values["gamma"], 0.0, 0.0], link, hub, "foh")
    alpha += 10.0 ** rng.uniform(-2.5, -1.0) * np.std(alpha) * rng.normal(size=n)
    log = so.Log.from_arrays(time=np.arange(n) / rate, theta=hub, alpha=alpha)
    truth = so.ParameterSet.of(k=(340.0, "1/s^2"), c=(values["c"], "1/s"), gamma=(1.2, "-")).bound(k=(0.0, 1e5))
    return so.Experiment(plant=flexlink.link(), log=log, name="log", hold="first"), truth, ("k", "c", "gamma")


def _filter(num: list[float], den: list[float], u: Any, hold: str) -> Any:
    """Return the response of a transfer function to samples that are held, or joined by lines."""
    b, a, _ = scipy.signal.cont2discrete((num, den), 1e-3, hold)
    return scipy.signal.lfilter(np.ravel(b), a, u)


def noisy_emps(number: int) -> tuple[so.Experiment, so.ParameterSet, tuple[str, ...]]:
    """Return the EMPS drive's multisine with noise on its position."""
    log = emps.log(number)
    noise = 2e-3 * np.std(log["q"]) * np.random.default_rng([3, number]).normal(size=len(log))
    noisy = so.Log.from_arrays(time=log.time, F=log["F"], q=log["q"] + noise)
    experiment = so.Experiment(plant=emps.drive(), log=noisy, name="log", initial_state="rest", offset=False)
    truth = emps.parameters(emps.TRUTH).bound(F_c=(0.0, np.inf))  # of either sign it is the same friction
    return experiment, truth, tuple(emps.TRUTH)


OWN_LOGS = {"light link": light_link, "EMPS": noisy_emps}


def attempt(job: tuple[str, str, int]) -> tuple[bool, str, float]:
    """Fit from one start; return whether the truth was recovered, the status and the time."""
    name, method, number = job
    experiment, truth, free = OWN_LOGS[name](number) if name in OWN_LOGS else case(name)
    rng = np.random.default_rng([7, number])
    values = {n: truth[n].value * 10.0 ** rng.uniform(-1.0, 1.0) for n in free}
    if name == "EMPS" and number % 2:
        values["F_v"] *= -1.0
    start = truth.update(**values).free(*free)
    began = time.perf_counter()
    try:
        fit = so.fit([experiment], start, method=METHODS[method])
    except so.SeaoptError as error:
        return False, type(error).__name__, time.perf_counter() - began
    took = time.perf_counter() - began
    close = all(
        abs(fit.parameters[n].value - truth[n].value)
        <= max(5.0 * (fit.parameters[n].std or 0.0), 0.02 * abs(truth[n].value))
        for n in free
    ) and all(fit.parameters[n].std < 0.5 * abs(truth[n].value) for n in free)
    return close, fit.status, took


def main() -> None:
    """Print success rates and median times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("starts", nargs="?", type=int, default=100)
    parser.add_argument("--plant", choices=[*PLANTS, *OWN_LOGS], action="append")
    parser.add_argument("--method", choices=METHODS, action="append")
    arguments = parser.parse_args()
    print(f"{'plant':26s}" + "".join(f"{m:>28s}" for m in arguments.method or METHODS), flush=True)
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for name in arguments.plant or [*PLANTS, *OWN_LOGS]:
            row = f"{name:26s}"
            for method in arguments.method or METHODS:
                found = list(pool.map(attempt, [(name, method, i) for i in range(arguments.starts)]))
                rate = 100.0 * sum(ok for ok, _, _ in found) / len(found)
                lost = sum(ok is False and status == "converged" for ok, status, _ in found)
                row += f"{rate:7.0f} % {np.median([t for _, _, t in found]):7.2f} s {lost:3d} lost"
            print(row, flush=True)


if __name__ == "__main__":
    main()
