"""Covariance, profile and bootstrap of a fit beside a posterior: `python benchmarks/bench_referee.py [--page FILE.md]`.

numpyro's NUTS (No-U-Turn sampler) samples the posterior of the plant of `peers/problem.py`, simulated in JAX and by no
code of the product, under a flat prior: its quantiles are those that each of the product's intervals means to have.
Two cases: *light*, 4 s of a chirp of 4 A, where everything is well told; *badly conditioned*, 3 s of 0.8 A, where the
spring moves little more than friction holds, so that friction and damping are hardly told apart. An interval's error
is that of its ends, over the half width of the posterior's 95 %.

NUTS runs in an environment of its own: `--python` is an interpreter that has `peers/requirements/nuts.txt`.
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

SAMPLER = Path(peer_seaopt.__file__).with_name("peer_nuts.py")
CASES = {"light": (4.0, 4.0), "badly conditioned": (0.8, 3.0)}  # amplitude in A, seconds
QUANTILES = (0.025, 0.5, 0.975)
NAMES = problem.NAMES[:4]  # of the plant; the offset and the start belong to the log


def make_data(amplitude: float, seconds: float, seed: int = 1) -> dict[str, np.ndarray]:
    """Return current, noisy force, and the Fisher information's centre and factor, which scale the sampler."""
    t = np.arange(round(seconds * problem.RATE_HZ)) * problem.STEP_S
    low, high = problem.CHIRP_HZ
    scale = seconds / np.log(high / low)
    current = amplitude * np.sin(2 * np.pi * low * scale * np.expm1(t / scale))
    tiny, truth = 1e-30, problem.TRUTH
    columns = problem.simulate(truth[:, None] + 1j * tiny * np.eye(truth.size), current)
    jacobian = columns.imag / (tiny * problem.NOISE_N)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    force = columns[:, 0].real + problem.NOISE_N * np.random.default_rng(seed).normal(size=t.size)
    factor = np.linalg.cholesky(covariance)
    return {"current": current, "force": force, "std": np.sqrt(np.diag(covariance)), "factor": factor}


def fit_data(data: dict[str, np.ndarray]) -> tuple[so.Fit, np.ndarray]:
    """Return the fit of a case, and all seven unknowns at its minimum."""
    log = so.Log.from_arrays(time=np.arange(data["current"].size) * problem.STEP_S, i=data["current"], F=data["force"])
    values = dict(zip(NAMES, problem.TRUTH, strict=False))
    units = dict(zip(NAMES, problem.UNITS, strict=False))
    guess = so.ParameterSet.of(
        **{name: (values[name], units[name]) for name in NAMES}, k=(problem.K, "N/m"), v_s=(problem.V_S, "m/s")
    ).free(*NAMES)
    bounds = zip(problem.LOWER, problem.UPPER, strict=True)
    guess = guess.bound(**dict(zip(NAMES, bounds, strict=False)))
    experiment = so.Experiment(plant=peer_seaopt.plant(), log=log, sigma={"F": problem.NOISE_N})
    fit = so.fit([experiment], guess)
    own = fit.nuisance[experiment.name]
    theta = [*(fit.parameters[name].value for name in NAMES), own.offset["F"], *own.initial_state[0].values()]
    return fit, np.array(theta)


def sample(data: dict[str, np.ndarray], center: np.ndarray, python: Path, draws: int) -> dict:
    """Return what NUTS says."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "data.npz"
        np.savez(path, **data, center=center)
        command = [str(python), str(SAMPLER), str(path), "--draws", str(draws), "--quantiles"]
        done = subprocess.run([*command, *map(str, QUANTILES)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"NUTS failed; --python needs peers/requirements/nuts.txt\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def compare(case: str, python: Path, draws: int) -> Iterator[str]:
    """Yield the lines of a case."""
    data = make_data(*CASES[case])
    fit, center = fit_data(data)
    found = sample(data, center, python, draws)
    redrawn = so.bootstrap(fit, draws=2000, seed=1)
    yield f"## {case[0].upper()}{case[1:]}\n"
    yield f"Effective draws {found['effective']:.0f}, split R-hat {found['mixing']:.3f}; the fit is {fit.verdict}.\n"
    yield "| | NUTS: 2.5 % | 97.5 % | covariance | profile | bootstrap | called Gaussian |"
    yield "|---|---|---|---|---|---|---|"
    for name in NAMES:
        low, _, high = found["quantiles"][name]
        profile = so.profile(fit, name)
        ends = (fit.parameters[name].ci95, profile.interval, redrawn.interval(name))
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
    parser.add_argument("--draws", type=int, default=4000, help="of each of four chains")
    parser.add_argument("--case", choices=list(CASES), action="append")
    parser.add_argument("--page", type=Path)
    given = parser.parse_args()
    lines = ["# A posterior as referee\n"]
    for case in given.case or CASES:
        table = list(compare(case, given.python, given.draws))
        print(*table, sep="\n", flush=True)
        lines += table
    if given.page:
        given.page.write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main()
