"""The EMPS ball-screw drive from a bad start: the yardstick of nonlinear identification.

    M q'' = F - F_v q' - F_c tanh(10000 q' / F_c) - O

with the truth of the published benchmark (A. Janot, M. Gautier, M. Brunot, Data Set and Reference Models of EMPS,
Workshop on Nonlinear System Identification Benchmarks, 2019), 10,000 noise-free samples of q at 1 kHz from a
random-phase multisine of 1 to 4 Hz (5,000 samples, twice, 60 N rms) and a start, (0.2, -10, 0.2, 10), whose simulation
runs away: mass a five-hundredth, friction that drives. Published (Retzler, Swevers, Gillis, Kollar, IEEE AMC 2022): of
100 multisines single shooting and nlgreyest recover none, multiple shooting about 64. Success is an output error below
0.1 %.

    python problems/emps.py [number of multisines]
"""

from __future__ import annotations

import sys
import time
from typing import Any

import casadi as ca
import numpy as np

import seaopt as so

TRUTH = {"M": 95.1089, "F_v": 203.5034, "F_c": 20.3935, "O": -3.1648}
START = {"M": 0.2, "F_v": -10.0, "F_c": 0.2, "O": 10.0}
UNITS = {"M": "kg", "F_v": "N s/m", "F_c": "N", "O": "N"}
RATE_HZ = 1000.0


def drive() -> so.Plant:
    """Return the drive: mass, viscous and Coulomb friction, and an offset of the force."""
    return so.Plant(
        name="EMPS",
        states={"q": "m", "v": "m/s"},
        inputs={"F": "N"},
        outputs={"q": "m"},
        parameters=UNITS,
        f=lambda t, x, u, p: {
            "q": x.v,
            "v": (u.F - p.F_v * x.v - p.F_c * ca.tanh(10000.0 * x.v / p.F_c) - p.O) / p.M,
        },
        h=lambda t, x, u, p: {"q": x.q},
    )


def parameters(values: dict[str, float]) -> so.ParameterSet:
    """Return a parameter set with the drive's units."""
    return so.ParameterSet.of(**{name: (value, UNITS[name]) for name, value in values.items()})


def multisine(seed: int) -> Any:
    """Return 10,000 samples of force: random phases at the lines of 0.2 Hz from 1 to 4 Hz, 60 N rms, twice 5 s."""
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 16)
    t = np.arange(5000) / RATE_HZ
    force = sum(np.cos(2.0 * np.pi * (1.0 + 0.2 * k) * t + phase) for k, phase in enumerate(phases))
    return np.tile(60.0 * force / np.std(force), 2)


def log(seed: int) -> so.Log:
    """Return the measured log: force and position."""
    force = multisine(seed)
    time = np.arange(force.size) / RATE_HZ
    run = so.simulate(drive(), parameters(TRUTH), so.Log.from_arrays(time=time, F=force))
    return so.Log.from_arrays(time=time, F=force, q=run["q"])


def fit(seed: int, method: Any = None) -> so.Fit:
    """Fit the drive to one log with one call, from the bad start; the initial state is known."""
    experiment = so.Experiment(plant=drive(), log=log(seed), name="multisine", initial_state="rest", offset=False)
    return so.fit([experiment], parameters(START).free(*START), method=method)


def main() -> None:
    """Print how many of the multisines are recovered."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    recovered, seconds = 0, 0.0
    for seed in range(count):
        started = time.perf_counter()
        result = fit(seed)
        seconds += time.perf_counter() - started
        error = 1.0 - result.outputs["multisine"]["q"].fit_percent / 100.0
        recovered += error < 1e-3
        print(f"{seed:3d}  {result.status}  output error {100 * error:.2g} %")
    print(f"{recovered} of {count} recovered, {seconds / count:.2f} s each")
    assert recovered == count


if __name__ == "__main__":
    main()
