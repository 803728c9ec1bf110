"""Controllers tuned on the frequency response of a noisy log alone, judged on the plant that made the log.

The judge shares nothing with the package: it discretises the true plant, k/(m_k s^2 + b_m s + k), by SciPy's matrix
exponential, closes the loop as one state space, takes its eigenvalues, and looks at its curves on 20,000 frequencies.

python benchmarks/bench_measured.py [--seeds 100] [--rate 1000] [--duration 164]
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy.linalg import expm

import seaopt as so
from seaopt.bench import Chirp, Noise

EXCITATION = (Chirp(amplitude=4.0, f0_hz=0.05, f1_hz=150.0), Noise(std=2.0, band_hz=200.0))
SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.7, max_noise_gain=60)
BANDWIDTH_KNOWN_TO = 0.03  # of a measured response the least bandwidth is 0.97 of the one asked, or more
POINTS = 20_000


def judge(controller: so.Controller) -> dict[str, float]:
    """Return the figures of a law on the stand of Orekhov et al., from its equations."""
    r = 0.002 / (2 * np.pi * 3.0)
    mass, damping, k = 0.646 + 3.31e-6 / r**2, 1.31e-4 / r**2, 655e3
    ts, late = controller.sample_time_s, controller.compute_delay_samples
    whole = np.zeros((3, 3))
    whole[:2] = [[0.0, 1.0, 0.0], [-k / mass, -damping / mass, k / mass]]
    step = expm(whole * ts)
    n = 2 + late  # position, speed, and the commands that are on their way
    a, b, c = np.zeros((n, n)), np.zeros(n), np.eye(n)[0]
    a[:2, :2] = step[:2, :2]
    if late:
        a[:2, -1], b[2] = step[:2, 2], 1.0
        a[3:, 2:-1] = np.eye(late - 1)
    else:
        b[:2] = step[:2, 2]
    law = controller.law
    closed = np.block(
        [[a + np.outer(b, law.d[1] * c), np.outer(b, law.c)], [np.outer(law.b[:, 1], c), law.a]]
    )  # fmt: skip
    f = np.geomspace(1e-3, 0.5 / ts, POINTS)
    z = np.exp(2j * np.pi * f * ts)

    def respond(a, b, c, d):
        states = np.linalg.solve(
            z[:, None, None] * np.eye(len(a)) - a, np.broadcast_to(b[:, None], (POINTS, len(a), 1))
        )
        return states[:, :, 0] @ c + d

    p = respond(a, b.astype(complex), c, 0.0)
    c_r, c_y = (sign * respond(law.a, law.b[:, i].astype(complex), law.c, law.d[i]) for i, sign in ((0, 1), (1, -1)))
    s = 1.0 / (1.0 + p * c_y)
    tracking = np.abs(p * c_r * s)
    return {
        "radius": float(np.max(np.abs(np.linalg.eigvals(closed)))), "ms": float(np.max(np.abs(s))),
        "mt": float(np.max(np.abs(p * c_y * s))), "noise": float(np.max(np.abs(c_y * s))),
        "peak": float(np.max(tracking)), "bandwidth_hz": float(f[np.argmax(tracking < np.sqrt(0.5))]),
    }  # fmt: skip


def keeps(figures: dict[str, float], spec: so.ControllerSpec) -> bool:
    """Tell whether the limits of a specification are kept."""
    asked = spec.bandwidth_hz
    return (
        figures["radius"] < 1.0 and figures["ms"] <= spec.max_sensitivity and figures["mt"] <= spec.max_complementary
        and figures["peak"] <= spec.max_reference_peak and figures["noise"] <= (spec.max_noise_gain or np.inf)
        and abs(figures["bandwidth_hz"] / asked - 1.0) <= BANDWIDTH_KNOWN_TO + 0.002
    )  # fmt: skip


def tune_on_log(
    seed: int, rate_hz: float, duration_s: float, spec: so.ControllerSpec = SPEC
) -> tuple[so.Controller, so.MeasuredResponse]:
    """Return the controller of a log's frequency response; the parameters only say what effort a current makes."""
    stand, thor = so.plants.high_impedance(), so.plants.thor()
    log = so.virtual_log(
        stand, thor, EXCITATION, duration_s=duration_s, rate_hz=rate_hz, seed=seed,
        sensors=so.Sensors(noise_std={"F1": 2.0}),
    )  # fmt: skip
    measured = so.measure_response(stand, log, "F1", name="chirp")
    return so.tune(measured, thor, spec), measured


def main() -> None:
    """Print how many controllers keep their limits on the plant."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name, value in (("seeds", 100), ("rate", 1000), ("duration", 164)):
        parser.add_argument(f"--{name}", type=int, default=value)
    options = parser.parse_args()
    began, feasible, kept, worst = time.process_time(), 0, 0, dict.fromkeys(("ms", "mt", "noise", "peak"), 0.0)
    for seed in range(options.seeds):
        controller, measured = tune_on_log(seed, options.rate, options.duration)
        figures = judge(controller)
        feasible += controller.feasible
        kept += controller.feasible and keeps(figures, SPEC)
        worst = {name: max(value, figures[name]) for name, value in worst.items()}
        if not (controller.feasible and keeps(figures, SPEC)):
            print(f"seed {seed}: {controller.explanation or figures}")
        if seed == 0:
            print(measured)
    spent = (time.process_time() - began) / options.seeds
    print(f"{options.seeds} logs of {options.duration} s at {options.rate} Hz, {spent:.2f} s of processor time each")
    print(f"feasible on the measured points: {feasible}; of them keep every limit on the plant: {kept}")
    print("worst on the plant: " + ", ".join(f"{name} {value:.4g}" for name, value in worst.items()))


if __name__ == "__main__":
    main()
