"""Coverage of intervals from a coarse encoder of a slow motion: `bench_coarse_encoder.py [LOGS] [stated]`.

A held joint, simulated here (exact steps of a fortieth of a sample, in each of which dry friction is what would stop
the joint, at most f_c), moves by a few steps of an encoder of 12 bits a turn, whose noise is a fifth to a twentieth of
a step. Each log has its own multisine and its own place of the steps. Of each case: how many fits are met, and how
often 95 % intervals hold the truth. With `stated`, of other logs without friction: the same where the fit finds the
steps, and where `quantisation` states them, the scatter of the values and the half of an interval over 1.96, medians.
"""

from __future__ import annotations

import os
import sys

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.linalg import expm

import seaopt as so

STEP, RATE_HZ, SECONDS, SUBSTEPS = 2 * np.pi / 4096, 500.0, 20.0, 40
TRUTH = {"J_m": 1e-3, "b_r": 5e-3, "k_s": 0.5}
FRICTION = 0.002  # N m


def record(rng: np.random.Generator, swing: float, noise: float, friction: float) -> so.Log:
    """Return a log whose motion has an rms of so many rad before friction."""
    t = np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ
    f = np.arange(0.1, 6.0, 1.0 / SECONDS)
    J, b, k = TRUTH.values()
    gain = np.abs(1.0 / (k - J * (2 * np.pi * f) ** 2 + 2j * np.pi * f * b))
    torque = np.cos(2 * np.pi * np.outer(t, f) + rng.uniform(0, 2 * np.pi, f.size)).sum(axis=1)
    torque *= (swing / np.sqrt(np.mean(gain**2)) + 2.0 * friction) / torque.std()
    rates = np.array([[0, 1, 0, 0], [-k / J, -b / J, 1 / J, -1 / J], [0, 0, 0, 0], [0, 0, 0, 0]], dtype=float)
    substeps = SUBSTEPS if friction else 1
    step = expm(rates / RATE_HZ / substeps)[:2]
    moves, driven, rubbed = step[:, :2], step[:, 2], step[:, 3]
    x, angle = np.zeros(2), np.empty(t.size)
    for i, value in enumerate(torque):
        angle[i] = x[0]
        for _ in range(substeps):
            x = moves @ x + driven * value
            x = x + rubbed * np.clip(-x[1] / rubbed[1], -friction, friction)
    read = angle + noise * rng.normal(size=t.size) + rng.uniform(0.0, STEP)
    return so.Log.from_arrays(time=t, I=torque, theta_m=np.round(read / STEP) * STEP)


def fit(log: so.Log, friction: float, *, stated: bool = False) -> so.Fit:
    """Return a fit from values that are 20 to 30 % off; `stated`: it is told the step."""
    plant = so.plants.rotary(link="locked")
    plant = so.plants.let_stick(plant) if friction else plant
    start = {name: factor * value for (name, value), factor in zip(TRUTH.items(), (1.3, 0.7, 0.8), strict=True)}
    known = plant.defaults.update(N=1.0, K_tau=1.0, eta=1.0, c_s=0.0, f_c=1.3 * friction)
    names = (*TRUTH, "f_c") if friction else tuple(TRUTH)
    told = {"theta_m": STEP} if stated else {}
    bench = so.Experiment(plant=plant, log=log, outputs=("theta_m",), initial_state="rest", quantisation=told)
    return so.fit([bench], known.update(**start).free(*names))


def compare(logs: int) -> None:
    """Print rows of fits that find the steps, and of those that are told them."""
    print("| motion, steps rms | step over noise | step | met | held | J_m: scatter | J_m: std |")
    print("|---|---|---|---|---|---|---|")
    truth = np.array(list(TRUTH.values()))
    for swing, ratio in ((3.0, 20), (13.0, 20), (3.0, 10), (3.0, 5), (13.0, 10), (13.0, 5)):
        rows: dict[bool, list[tuple[bool, list[float], list[float]]]] = {False: [], True: []}
        for seed in range(5000, 5000 + logs):
            log = record(np.random.default_rng([seed, ratio, int(swing)]), swing * STEP, STEP / ratio, 0.0)
            for stated, row in rows.items():
                found = fit(log, 0.0, stated=stated)
                values = [found.parameters[name] for name in TRUTH]
                row.append((found.met, [p.value for p in values], [p.total_std or 0.0 for p in values]))
        for stated, row in rows.items():
            off = np.array([values for _, values, _ in row]) / truth - 1.0
            std = np.array([stds for _, _, stds in row]) / truth
            held, scatter = np.mean(np.abs(off) <= 1.96 * std), np.sqrt(np.mean(off[:, 0] ** 2))
            figures = f"{100 * held:.1f} % | {100 * scatter:.3f} % | {100 * np.median(std[:, 0]):.3f} %"
            met = sum(good for good, _, _ in row)
            print(
                f"| {swing:g} | {ratio} | {'stated' if stated else 'found'} | {met} of {logs} | {figures} |", flush=True
            )


def main() -> None:
    """Print a row of each case."""
    logs = int(sys.argv[1]) if len(sys.argv) > 1 else 40
    if "stated" in sys.argv:
        compare(logs)
        return
    print("| dry friction | motion, steps rms | step over noise | met | " + " | ".join((*TRUTH, "f_c")) + " |")
    print("|---|---|---|---|---|---|---|---|")
    for friction in (0.0, FRICTION):
        for swing in (3.0, 13.0, 65.0)[: 2 if friction else 3]:
            for ratio in (5, 10, 20):
                truth = {**TRUTH, "f_c": friction} if friction else TRUTH
                held, met = dict.fromkeys(truth, 0), 0
                for seed in range(logs):
                    rng = np.random.default_rng([seed, ratio])
                    found = fit(record(rng, swing * STEP, STEP / ratio, friction), friction)
                    met += found.met
                    for name, value in truth.items():
                        low, high = found.parameters[name].ci95
                        held[name] += low <= value <= high
                cells = [f"{100.0 * held[name] / logs:.0f} %" if name in held else "" for name in (*TRUTH, "f_c")]
                about = f"{friction:g} N m" if friction else "none"
                print(f"| {about} | {swing:g} | {ratio} | {met} of {logs} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
