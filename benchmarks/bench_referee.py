"""Covariance, profile and bootstrap of a fit beside a posterior: `python benchmarks/bench_referee.py [--page FILE.md]`.

numpyro's NUTS (No-U-Turn sampler), or importance sampling, samples the posterior of the plant of `peers/problem.py`,
simulated in JAX and by no code of the product, under a flat prior: its quantiles are those that each of the product's
intervals means to have. Importance sampling takes a minute where NUTS takes twenty, with more draws that are
independent, but for posteriors near a multivariate t alone: it states what its draws are worth.
Two cases: *light*, 4 s of a chirp of 4 A, where everything is well told; *badly conditioned*, 3 s of 0.8 A, where the
spring moves little more than friction holds, so that friction and damping are hardly told apart. An interval's error
is that of its ends, over the half width of the posterior's 95 %. What a fit states has, besides noise, what the model
may lack.

The sampler runs in an environment of its own: `--python` is an interpreter that has `peers/requirements/nuts.txt`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

import seaopt as so

sys.path.insert(0, str(Path(__file__).resolve().parent / "peers"))
import peer_seaopt
import problem

SAMPLERS = ("nuts", "importance")
CASES = {"light": (4.0, 4.0), "badly conditioned": (0.8, 3.0)}  # amplitude in A, seconds
QUANTILES = (0.025, 0.5, 0.975)
NAMES = problem.NAMES[:4]  # of the plant; the offset and the start belong to the log


def make_data(amplitude: float, seconds: float, seed: int = 1) -> tuple[problem.Data, np.ndarray]:
    """Return the data of a case, and a factor of the Fisher information's inverse, which scales the sampler."""
    current = problem.chirp(amplitude, round(seconds * problem.RATE_HZ))
    truth, jacobian = problem.differentiate(current)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    force = truth + problem.NOISE_N * np.random.default_rng(seed).normal(size=current.size)
    data = problem.Data(current=current, force=force, std=np.sqrt(np.diag(covariance)))
    return data, np.linalg.cholesky(covariance)


def sample(data: problem.Data, center: np.ndarray, factor: np.ndarray, python: Path, draws: int, by: str) -> dict:
    """Return what a sampler says."""
    script = Path(peer_seaopt.__file__).with_name(f"peer_{by}.py")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "data.npz"
        np.savez(path, current=data.current, force=data.force, std=data.std, center=center, factor=factor)
        command = [str(python), str(script), str(path), "--draws", str(draws), "--quantiles"]
        done = subprocess.run([*command, *map(str, QUANTILES)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{by} failed; --python needs peers/requirements/nuts.txt\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def compare(case: str, python: Path, draws: int, by: str) -> Iterator[str]:
    """Yield the lines of a case."""
    data, factor = make_data(*CASES[case])
    experiment, guess = peer_seaopt.pose(data)
    fit = so.fit([experiment], guess)
    found = sample(data, peer_seaopt.list_unknowns(fit), factor, python, draws, by)
    redrawn = so.bootstrap(fit, draws=2000, seed=1)
    yield f"## {case[0].upper()}{case[1:]}\n"
    mixed = f"split R-hat {found['mixing']:.3f}" if by == "nuts" else f"the heaviest {found['heaviest']:.1e} of all"
    yield f"Effective draws {found['effective']:.0f}, {mixed}; the fit is {fit.verdict}.\n"
    yield f"| | {by}: 2.5 % | 97.5 % | by noise alone | stated | profile | bootstrap | called Gaussian |"
    yield "|---|---|---|---|---|---|---|---|"
    for name in NAMES:
        low, _, high = found["quantiles"][name]
        profile = so.profile(fit, name)
        ends = (profile.wald, fit.parameters[name].ci95, profile.interval, redrawn.interval(name))
        errors = [100.0 * max(abs(end[0] - low), abs(end[1] - high)) / (0.5 * (high - low)) for end in ends]
        gaussian = (
            max(abs(a - b) for a, b in zip(profile.interval, profile.wald, strict=True))
            < 0.05 * (profile.wald[1] - profile.wald[0]) / 2.0
        )
        cells = " | ".join(f"{error:.1f} %" for error in errors)
        yield f"| {name} | {low:.5g} | {high:.5g} | {cells} | {'yes' if gaussian else 'no'} |"
    yield ""


def main() -> None:
    """Run both cases."""
    parser = argparse.ArgumentParser(description="A posterior as the referee of a fit's intervals.")
    parser.add_argument("--python", type=Path, required=True, help="an interpreter with numpyro")
    parser.add_argument("--sampler", choices=SAMPLERS, default=SAMPLERS[0])
    parser.add_argument("--draws", type=int, default=4000, help="of each of four chains of NUTS, or in all")
    parser.add_argument("--case", choices=list(CASES), action="append")
    parser.add_argument("--page", type=Path)
    given = parser.parse_args()
    lines = ["# A posterior as referee\n"]
    for case in given.case or CASES:
        table = list(compare(case, given.python, given.draws, given.sampler))
        print(*table, sep="\n", flush=True)
        lines += table
    if given.page:
        given.page.write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main()
