"""Bounds on the worst case from above: how near, and at what price.

    python benchmarks/bench_bracket.py

Run with OPENBLAS_NUM_THREADS=1. The fit is that of the paper's experiment, 164 s with 2 N of noise.
"""

from __future__ import annotations

import time

import numpy as np

import seaopt as so
from seaopt.bench import PAPER_STAND
from seaopt.robustness import Budget, batch_figures, bracket, combine_uncertainty

DRAWS = 20_000
WIDE, ANGLE, DELAY = {"I_p": (0.2, 0.6)}, {"phi": (-0.5, 0.5)}, {"delay_s": (0.0, 2e-4)}
INERTIA, DAMPING = {"I_p": (0.3, 0.5)}, {"d": (0.0, 0.1)}


def main() -> None:
    stand, swing, thor = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6)
    controller = so.tune(stand, thor, spec, robust_to={"swing": swing})
    sensors = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0}, offset={"F1": 3.0})
    log = so.virtual_log(stand, thor, PAPER_STAND, duration_s=164, rate_hz=400, seed=11, sensors=sensors)
    fit = so.fit([so.Experiment(plant=stand, log=log, outputs=("F1", "F2"))], thor.free("J", "b_r", "eta"))
    narrow, wide = thor.prior(J=3.3e-8, b_r=2e-6, eta=0.01), thor.prior(J=3.3e-7, b_r=2e-5, eta=0.03)
    cases = [
        ("stand", stand, fit, {}), ("swing", swing, fit, INERTIA), ("swing", swing, fit, INERTIA | DAMPING),
        ("swing", swing, fit, INERTIA | DAMPING | DELAY), ("swing", swing, fit, INERTIA | DAMPING | ANGLE),
        ("swing", swing, fit, WIDE | ANGLE | DELAY), ("swing, 1 %", swing, narrow, INERTIA),
        ("swing, 10 %", swing, wide, INERTIA),
    ]  # fmt: skip
    for name, plant, source, ranges in cases:
        certificate = so.certify(controller, {"plant": plant}, source, ranges=ranges, samples=500, simulations=False)
        unknown = combine_uncertainty(source, so.ParameterSet(), ranges, {"plant": plant})
        wall, cpu = time.perf_counter(), time.process_time()
        found = bracket(controller, plant, unknown, certificate.worst["plant"], Budget())
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        points = unknown.values(unknown.draw(DRAWS, np.random.default_rng(0)))
        figures = batch_figures(controller, plant, unknown.nominal, points)
        print(
            f"{name} {', '.join(ranges) or '-'}: {found.boxes} boxes, {wall:.1f} s ({cpu:.1f} s of processor time), "
            f"Ms {found.ms_lower:.4f} to {found.ms_upper:.4f} (draws {np.max(figures.ms):.4f}), "
            f"Mt {found.mt_lower:.4f} to {found.mt_upper:.4f} (draws {np.max(figures.mt):.4f})",
            flush=True,
        )


if __name__ == "__main__":
    main()
