"""How often the intervals of an elastic joint's figures hold the truth: `python benchmarks/bench_elastic_joint.py`.

Every seed is a joint of its own, with every parameter up to 20 % off, and encoders that begin elsewhere
(problems/elastic_joint.py, whose simulator shares no code with the product). Interrupted, it reports the joints that
are done.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads cost these small problems more than they bring

import numpy as np

import seaopt as so

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "problems"))
import elastic_joint as joint

FIGURES = ("antiresonance_hz", "resonance_hz", "J_m", "J_l", "k_s", "c_s", "b_r", "f_c", "delay_s")
COVERED = 1.959964  # standard deviations of a 95 % interval


def read(fit: so.Fit, name: str) -> tuple[float, float]:
    """Return a figure of a fit and its standard deviation, of noise and model."""
    own = fit.nuisance["experiment"].fitted
    figure = own[name] if name in own else fit.derived[name] if name in fit.derived else fit.parameters[name]
    return figure.value, figure.total_std


def main() -> None:
    """Fit every joint and print a row of each figure."""
    parser = argparse.ArgumentParser(description="Coverage of the intervals of an elastic joint's figures.")
    parser.add_argument("seeds", type=int, nargs="?", default=200)
    seeds = range(1, parser.parse_args().seeds + 1)
    joints = [joint.draw_truth(seed) for seed in seeds]
    goal, begin = joint.sweep(), time.perf_counter()
    angles = joint.simulate({name: np.array([one[name] for one in joints]) for name in joints[0]}, goal)
    print(f"{len(joints)} joints simulated in {time.perf_counter() - begin:.0f} s")
    error, std, busy, failed, met = [], [], [], 0, 0
    for seed, truth in zip(seeds, joints, strict=True):
        begin = time.process_time()
        try:
            fit = joint.fit_elastic(joint.record(goal, angles[:, :, seed - 1], seed))
        except KeyboardInterrupt:
            break
        busy.append(time.process_time() - begin)
        known = np.array([{**truth, **joint.find_resonances(truth)}[name] for name in FIGURES])
        value, spread = zip(*(read(fit, name) for name in FIGURES), strict=True)
        error.append(value / known - 1.0)
        std.append(spread / known)
        failed, met = failed + (fit.status != "converged"), met + fit.met
    error, std = np.array(error), np.array(std)
    print(f"{len(error)} joints fitted, {met} met")
    print(f"{failed} did not converge; a fit takes {np.median(busy):.2f} s of processor time, at most {max(busy):.2f}")
    print(f"{'':17s} covered   largest error   std      scatter/std   bias/std")
    for name, e, s in zip(FIGURES, error.T, std.T, strict=True):
        covered, scaled = 100 * np.mean(np.abs(e) <= COVERED * s), e / s
        print(f"{name:17s} {covered:5.1f} %   {100 * np.max(np.abs(e)):8.4f} %   {100 * np.median(s):.4f} %"
              f"   {np.std(scaled):6.2f}       {np.mean(scaled):+6.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
