"""Draws a second of the certificate: eigenvalues, Ms and Mt of N plants, and the same numbers one by one.

    python benchmarks/bench_certify.py [N]

Run with OPENBLAS_NUM_THREADS=1: the two threads work on blocks of draws, not inside products of 8 x 8 matrices.
"""

from __future__ import annotations

import sys
import time

import numpy as np

import seaopt as so
from seaopt.robustness import batch_figures

COMPARED = 200


def main(count: int) -> None:
    stand, swing, thor = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_complementary=1.3)
    controller = so.tune(stand, thor, spec, robust_to={"swing": swing})
    rng = np.random.default_rng(0)
    draws = {
        "I_p": rng.uniform(0.2, 0.6, count), "J": 3.31e-6 * rng.uniform(0.8, 1.2, count),
        "b_r": 1.31e-4 * rng.uniform(0.8, 1.2, count), "L_a": rng.uniform(0.065, 0.08, count),
    }  # fmt: skip
    for name, plant in (("stand", stand), ("swing", swing)):
        wall, cpu = time.perf_counter(), time.process_time()
        found = batch_figures(controller, plant, thor, draws)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        error, one = 0.0, time.process_time()
        for k in range(COMPARED):
            at = thor.update(**{key: float(item[k]) for key, item in draws.items()})
            figures = controller.close(plant, at).figures()
            pairs = (
                (found.spectral_radius[k], figures.spectral_radius),
                (found.ms[k], figures.ms),
                (found.mt[k], figures.mt),
            )
            error = max(error, *(abs(a / b - 1.0) for a, b in pairs))
        one = (time.process_time() - one) / COMPARED
        print(
            f"{name}: {count} draws in {wall:.2f} s ({cpu:.2f} s of processor time), "
            f"one by one {1e3 * one:.2f} ms each; largest difference {error:.1e} in {COMPARED}"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000)
