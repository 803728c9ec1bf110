"""The largest friction margin at a bandwidth, against a global search: python benchmarks/bench_friction_margin.py

The actuator of `bench_tune_friction`, whose equations, laws and limits are used here too; none are the product's. The
proof is written here again: aliases of the sampled loop, and one multiplier for each run of scipy's differential
evolution, which looks for laws whose proof holds for friction of a slope, all other limits kept. The slope is bisected.
Options: --bandwidth 20 --generations 400 (of each run, of 64 laws each) --seed 1.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from bench_tune_friction import ISSUE, LEAST_RATE, Case, Judge
from scipy.optimize import differential_evolution

import seaopt as so
from seaopt.control.laws.friction import find_friction_margin

ALIASES = np.arange(-150, 151)
MULTIPLIERS = {
    "circle": np.ones_like,
    **{f"Popov, {eta:g} s": lambda s, eta=eta: 1 + eta * s for eta in (2e-4, 2e-3, 2e-2)},
    **{
        f"Zames-Falb, {share:g} at {hz:g} Hz": lambda s, share=share, w=2 * np.pi * hz: 1 - share * w / (w + s)
        for share in (0.5, 0.9)
        for hz in (-30.0, -10.0, 30.0, 100.0)
    },
}


class Proof:
    """What a multiplier asks of C_y on the stand's sliding plant at friction of a slope: |1 + p C_y| > size |C_y|."""

    def __init__(self, judge: Judge, multiplier, slope: float) -> None:
        v, ts = judge.case.values, judge.ts
        radius = v["l"] / (2 * np.pi * v["N_p"])
        mass, damping = v["J"] / radius**2 + v["m_l"], v["b_r"] / radius**2
        self.inside = judge.f * ts > 2e-5
        theta = 2 * np.pi * judge.f[self.inside] * ts
        s = 1j * (theta[:, None] + 2 * np.pi * ALIASES) / ts
        inner = mass * s**2 + damping * s + v["k"]
        weight = multiplier(s)
        real = np.real(weight * (s / inner + 1 / slope))
        motion = (
            -weight * s / inner * (1 - np.exp(-s * ts)) / s * np.exp(-1j * theta * judge.case.delay_samples)[:, None]
        )
        sensed = np.conj(v["k"] / inner) / ts
        self.possible = bool(np.all(real > 0))
        alpha, beta = (np.sum(np.abs(one) ** 2 / real, axis=1) for one in (motion, sensed))
        self.p = judge.p[0][self.inside] + np.sum(np.conj(sensed) * motion / real, axis=1) / 2
        self.size = np.sqrt(alpha * beta) / 2

    def usage(self, c_y):
        c_y = c_y[:, self.inside]
        return np.max(self.size * np.abs(c_y) / np.abs(1 + self.p * c_y), axis=1)


def search(judge: Judge, proof: Proof, generations: int, seed: int) -> bool:
    """Tell whether a law was found that keeps everything."""
    inverse, w_b = 1 / np.abs(judge.p[0][judge.at]), 2 * np.pi * judge.case.bandwidth_hz
    logs = [
        (0.02 * max(inverse, 1), 30 * max(inverse, 1)), (LEAST_RATE, 4 * w_b),
        (1e-3 * inverse / w_b, 30 * inverse / w_b), (judge.ts, 4 / w_b),
    ]  # fmt: skip
    best = [np.inf]

    def merit_of(numbers):
        clean = np.nan_to_num(numbers)
        worst, stable, _ = judge.judge(clean)
        worst = np.maximum(worst, proof.usage(judge.law(clean)[0]))
        return np.where(np.isnan(numbers[:, 4]), 200.0, np.log(worst) + np.where(stable, 0.0, 50.0))

    def cost(v):
        k_p, rate, k_d, t_f = np.exp(v[:4])
        numbers = np.column_stack([k_p, rate * (1 + k_p), k_d, t_f, 0.0 * k_p, v[4] * k_d])
        merit = np.fmin(*(merit_of(one) for one in judge.place(numbers)))
        best[0] = min(best[0], float(np.min(merit)))
        return merit

    differential_evolution(
        cost, [*(tuple(np.log(pair)) for pair in logs), (0.0, 1.0)], seed=seed, maxiter=generations, popsize=12,
        tol=1e-9, polish=False, vectorized=True, init="sobol", updating="deferred",
        callback=lambda intermediate_result: best[0] < 0.0,
    )  # fmt: skip
    return best[0] < 0.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (("bandwidth", 20.0), ("generations", 400), ("seed", 1)):
        parser.add_argument(f"--{name}", type=type(default), default=default)
    args = parser.parse_args()
    case = Case(ISSUE, args.bandwidth)
    plant, params = so.plants.high_impedance(), so.plants.thor().update(**case.values)
    for asked in (None, 1e7):
        started = time.process_time()
        controller = so.tune(plant, params, replace(case.spec, min_friction_margin=asked))
        margin = find_friction_margin(controller, plant, params)
        print(
            f"asked {asked}: {margin.least_slope:.4g} N s/m by {margin.multiplier}, "
            f"{time.process_time() - started:.1f} s {controller.explanation}"
        )
    reached, judge = margin.least_slope, Judge(case)
    for name, multiplier in MULTIPLIERS.items():
        low, high = None, 4.0 * reached
        for share in (0.5, 0.8, 0.95, 1.0, 1.05, 1.1, 1.3, 1.6, 2.5):
            proof = Proof(judge, multiplier, share * reached)
            if not (proof.possible and search(judge, proof, args.generations, args.seed)):
                high = share
                break
            low = share
        print(f"{name}: the search keeps all limits at {low} of that slope, not at {high}", flush=True)


if __name__ == "__main__":
    main()
