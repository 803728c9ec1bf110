"""How often the sensor's noise fails a healthy loop: `python benchmarks/bench_false_alarms.py [SEEDS]`.

Loops of 45 and 60 Hz on THOR's stand and swing, with load cells of 2 N and of 20 N; the unsaturated step and the chirp.
"""

from __future__ import annotations

import sys

import seaopt as so
from seaopt.robustness import default_scenarios, verify


def count_failures(bandwidth_hz: float, name: str, std: float, seeds: int) -> int:
    """Return the number of seeds whose verification fails."""
    plants, thor = {"stand": so.plants.high_impedance(), "swing": so.plants.moving_output()}, so.plants.thor()
    spec = so.ControllerSpec(bandwidth_hz=bandwidth_hz, max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)
    controller = so.tune(plants["stand"], thor, spec, robust_to={"swing": plants["swing"]})
    scenarios = [s for s in default_scenarios(controller, plants[name]) if s.name in ("unsaturated step", "chirp")]
    cell, on = so.Sensors(noise_std={"F1": std}), {name: plants[name]}
    runs = (verify(controller, on, thor, scenarios=scenarios, sensors=cell, seed=seed) for seed in range(seeds))
    return sum(not verification.passed for verification in runs)


if __name__ == "__main__":
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 30
    for bandwidth_hz in (45, 60):
        for name in ("stand", "swing"):
            for std in (2.0, 20.0):
                failures = count_failures(bandwidth_hz, name, std, seeds)
                print(f"{bandwidth_hz} Hz, {name}, {std:g} N: {failures} of {seeds} failed")
