"""How often the 95 % intervals of a fit hold the truth: `python benchmarks/bench_coverage.py [SEEDS] [--page FILE.md]`.

In most cases short logs of the stand, F1 and F2 with 2 N of noise; J, b_r and eta are fitted:

white
    What the plant says, and white noise.
heavy tails
    The noise has Student's distribution with three degrees of freedom, scaled to the same std.
coloured
    The noise is an autoregression of order one with a correlation time of 25 ms; once with a broad excitation, once
    with the chirp, which spends half of its six seconds below 1.2 Hz: there the intervals of eta
    are some 10 % too narrow.
mode
    The true screw has a mode at 80 Hz (`parts=("screw_mode",)`) that the fitted plant lacks; the noise is white. The
    fitted plant's k is the stiffness of spring and screw in series, which a static test of the stand measures. Once
    all frequencies count, once those up to 8 Hz: a tenth of the mode's, where its gain is 1 % from one.
friction, rotary with encoders
    A screw and a pendulum's knee of `truth/actuators.py`, played once by its C simulator, whose friction is set-valued:
    15 s at 500 Hz, forces with 2 N of noise, a torque with 0.5 N m, encoders of 1,024 steps at the motor and 8,192 at
    the link that begin anywhere. The friction sticks; a delay is free.
servo
    An elastic joint under a firmware's PD by its goal and one encoder of 512 steps (`problems/elastic_joint.py`,
    simulated there); a delay is free.

`--kept FILE` keeps what each seed gives, so that a run goes on where it was stopped; `--as-kept` makes the page of the
seeds that are there.

What the model lacks is the matter of `truth/run.py`, whose kept cases (--truth FILE...) go into the page as a case.

A covariance is right when the scatter of the estimates over seeds is the stated std, and each interval holds the
truth in 95 % of the logs; so does the ellipsoid of all, whose squared radius is the 95 % quantile of chi^2. An interval
is as a fit states it, of noise and of the model's error; "by noise alone" is the part of it that noise makes, to which
std, bias and scatter refer, and "widened" how many times as wide the whole is, in the median.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads cost these small problems more than they bring

import numpy as np
from scipy.signal import lfilter
from scipy.stats import chi2

import seaopt as so
from seaopt.bench import PAPER_STAND, Excitation, Noise
from seaopt.estimation.judgement import judge

sys.path.insert(0, str(Path(__file__).resolve().parent / "truth"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "problems"))
import actuators
import elastic_joint
from run import list_free, pose, summarise

FREE = ("J", "b_r", "eta")
RATE_HZ = 400.0
NOISE_N = 2.0
POLE = 0.9  # of the coloured noise, at 400 Hz
BAND_HZ = (0.0, 8.0)
INSIDE = 1.959964  # std from the truth, within which 95 % are
BROAD: Excitation = (Noise(std=1.0, band_hz=150.0),)
QUIET: Excitation = (Noise(std=0.25, band_hz=150.0),)

# What explains a misfit better is not asked: that takes most of such a fit's time, and changes no estimate or interval.
judge.find_causes = lambda *_, **__: []

STAND = so.plants.high_impedance()
MODAL = so.plants.high_impedance(parts=("screw_mode",))
THOR = so.plants.thor()


def series_stiffness() -> float:
    """Return what a static test measures of spring and screw, N/m."""
    spring, screw = THOR["k"].value, MODAL.parameters["k_b"].value
    return spring * screw / (spring + screw)


def start(**known: float) -> so.ParameterSet:
    """Return a start somewhat off the truth, J, b_r and eta free."""
    factors = {"J": 1.2, "b_r": 0.8, "eta": 0.9}
    return THOR.update(**{name: THOR[name].value * factor for name, factor in factors.items()}, **known).free(*FREE)


def autoregression(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return coloured noise of unit variance, stationary from its first sample."""
    drive = np.sqrt(1 - POLE**2) * rng.normal(size=n)
    drive[0] = rng.normal()
    return lfilter([1.0], [1.0, -POLE], drive)


def white(seed: int) -> so.Fit:
    log = so.virtual_log(STAND, THOR, PAPER_STAND, duration_s=6, rate_hz=RATE_HZ, seed=seed,
                         sensors=so.Sensors(noise_std={"F1": NOISE_N, "F2": NOISE_N}))  # fmt: skip
    return fitted(log, start())


def heavy(seed: int) -> so.Fit:
    log = so.virtual_log(STAND, THOR, BROAD, duration_s=6, rate_hz=RATE_HZ, seed=seed)
    rng = np.random.default_rng([seed, 2])
    # of the distribution, whose variance is 3
    forces = {name: log[name] + NOISE_N / np.sqrt(3.0) * rng.standard_t(3, len(log)) for name in ("F1", "F2")}
    return fitted(so.Log.from_arrays(time=log.time, I=log["I"], **forces), start())


def coloured(seed: int, excitation: Excitation = BROAD) -> so.Fit:
    log = so.virtual_log(STAND, THOR, excitation, duration_s=6, rate_hz=RATE_HZ, seed=seed)
    rng = np.random.default_rng([seed, 1])
    forces = {name: log[name] + NOISE_N * autoregression(len(log), rng) for name in ("F1", "F2")}
    # Stated, as noise of a colour is told from physics that the model lacks by nothing else.
    stated = {"F1": NOISE_N, "F2": NOISE_N}
    return fitted(so.Log.from_arrays(time=log.time, I=log["I"], **forces), start(), sigma=stated)


def coloured_chirp(seed: int) -> so.Fit:
    return coloured(seed, PAPER_STAND)


def mode(seed: int, band_hz: tuple[float, float] | None = None) -> so.Fit:
    log = so.virtual_log(MODAL, THOR, QUIET, duration_s=8, rate_hz=RATE_HZ, seed=seed,
                         sensors=so.Sensors(noise_std={"F1": NOISE_N, "F2": NOISE_N}))  # fmt: skip
    return fitted(log, start(k=series_stiffness()), sigma={"F1": NOISE_N, "F2": NOISE_N}, band_hz=band_hz)


def mode_in_band(seed: int) -> so.Fit:
    return mode(seed, BAND_HZ)


def fitted(
    log: so.Log, given: so.ParameterSet, sigma: dict[str, float] | None = None,
    band_hz: tuple[float, float] | None = None,
) -> so.Fit:  # fmt: skip
    bench = so.Experiment(plant=STAND, log=log, outputs=("F1", "F2"), sigma=sigma or {})
    return so.fit([bench], given, method=so.OutputError(search=False), band_hz=band_hz)


SCREW = actuators.Actuator(kind="screw")
NOISE = {"F1": NOISE_N, "F2": NOISE_N, "tau_s": 0.5}  # N, N m
STEP = {"theta_m": 2 * np.pi / 1024, "theta_l": 2 * np.pi / 8192}  # rad, of encoders that begin anywhere
KNEE = actuators.Actuator(kind="knee", link="pendulum")


@cache
def play(kind: str, link: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return 15 s of the current, and what ideal sensors would read."""
    actuator = actuators.Actuator(kind=kind, link=link)
    current = np.round(actuator.draw_current(15.0, np.random.default_rng(1)), 3)  # as it is played
    return current, actuator.simulate(current)


def sticking(actuator: actuators.Actuator, seed: int) -> so.Fit:
    current, ideal = play(actuator.kind, actuator.link)
    rng = np.random.default_rng([seed, 3])
    readings = {name: values + NOISE.get(name, 0.0) * rng.normal(size=values.size) for name, values in ideal.items()}
    for name, step in STEP.items():
        if name in readings:
            readings[name] = step * np.round(readings[name] / step + rng.uniform())
    log = so.Log.from_arrays(time=np.arange(current.size) / actuators.RATE_HZ, I=current, **readings)
    plant, params, delay = pose(actuator, actuator.truth)
    params = params.update(**{name: 1.1 * params[name].value for name in list_free(actuator)})
    return so.fit([so.Experiment(plant=plant, log=log, outputs=tuple(ideal), delay_s=delay)], params)


@cache
def turn_joint() -> tuple[np.ndarray, np.ndarray]:
    """Return the goal of the elastic joint, and its angles without encoders."""
    goal = elastic_joint.sweep()
    return goal, elastic_joint.simulate(elastic_joint.TRUTH, goal)[:, :, 0]


def servo(seed: int) -> so.Fit:
    return elastic_joint.fit_elastic(elastic_joint.record(*turn_joint(), seed))


@dataclass(frozen=True, kw_only=True)
class Case:
    """What makes a fit of a seed, and the true values of its free parameters."""

    fit: Callable[[int], so.Fit]
    truth: Mapping[str, float]


def _choose(values: Mapping[str, float], *names: str) -> dict[str, float]:
    return {name: values[name] for name in names}


OF_STAND = {name: THOR[name].value for name in FREE}
CASES = {
    "white noise": Case(fit=white, truth=OF_STAND),
    "heavy tails": Case(fit=heavy, truth=OF_STAND),
    "coloured noise": Case(fit=coloured, truth=OF_STAND),
    "coloured noise, chirp": Case(fit=coloured_chirp, truth=OF_STAND),
    "80 Hz mode, all frequencies": Case(fit=mode, truth=OF_STAND),
    "80 Hz mode, 0 to 8 Hz": Case(fit=mode_in_band, truth=OF_STAND),
    "friction": Case(fit=partial(sticking, SCREW), truth=_choose(SCREW.truth, *list_free(SCREW))),
    "rotary with encoders": Case(fit=partial(sticking, KNEE), truth=_choose(KNEE.truth, *list_free(KNEE))),
    "servo": Case(fit=servo, truth=_choose(elastic_joint.TRUTH, *elastic_joint.START)),
}


def find_errors(job: tuple[str, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, bool]:
    """Return of a seed the errors, their stds by noise alone and in all, the squared radius, and whether it is met."""
    name, seed = job
    fit, truth = CASES[name].fit(seed), CASES[name].truth
    error = np.array([fit.parameters[each].value - value for each, value in truth.items()])
    by_noise, std = (np.array([each.std(name) for name in truth]) for each in (fit.covariance, fit.total_covariance))
    order = [fit.total_covariance.names.index(each) for each in truth]
    correlation = fit.total_covariance.matrix[np.ix_(order, order)] / np.outer(std, std)
    return error, by_noise, std, float(error / std @ np.linalg.solve(correlation, error / std)), fit.met


KEYS = ("error", "noise", "std", "radius", "met")  # of a kept row, what `find_errors` returns


def read_kept(file: Path | None, name: str) -> dict[int, tuple[Any, ...]]:
    """Return the kept rows of a case, by seed."""
    lines = file.read_text(encoding="utf-8").splitlines() if file is not None and file.exists() else []
    rows = (row for row in map(json.loads, lines) if row["case"] == name)
    return {row["seed"]: tuple(row[key] for key in KEYS) for row in rows}


def list_rows(name: str, seeds: int, workers: int, kept: Path | None) -> list[tuple[Any, ...]]:
    """Return the rows of a case's seeds; those that are not kept are made, and kept as they come."""
    known = read_kept(kept, name)
    jobs = [(name, seed) for seed in range(seeds) if seed not in known]
    pool = ProcessPoolExecutor(workers) if workers > 1 and jobs else None
    made = map(find_errors, jobs) if pool is None else pool.map(find_errors, jobs, chunksize=5)
    for (_, seed), row in zip(jobs, made, strict=True):
        known[seed] = row
        if kept is not None:
            values = {key: np.asarray(value).tolist() for key, value in zip(KEYS, row, strict=True)}
            with kept.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"case": name, "seed": seed, **values}) + "\n")
    return [known[seed] for seed in range(seeds)]


def figures(name: str, seeds: int, workers: int = 1, kept: Path | None = None) -> dict[str, dict[str, float]]:
    """Return a parameter's figures each, the coverage of the ellipsoid, and the share of fits that are met."""
    rows = list_rows(name, seeds, workers, kept)
    truth = CASES[name].truth
    error, by_noise, std, radius, met = (np.array(column) for column in zip(*rows, strict=True))
    mean = np.mean(by_noise, axis=0)
    found = {
        "covered": np.mean(np.abs(error) <= INSIDE * std, axis=0),
        "covered_by_noise": np.mean(np.abs(error) <= INSIDE * by_noise, axis=0),
        "std_percent": 100.0 * mean / list(truth.values()),
        "bias_in_std": np.mean(error, axis=0) / mean,
        "scatter_in_std": np.std(error, axis=0) / mean,
        "widened": np.median(std / by_noise, axis=0),
    }
    out = {each: {key: float(values[i]) for key, values in found.items()} for i, each in enumerate(truth)}
    inside = float(np.mean(radius <= chi2.ppf(0.95, len(truth))))
    return {**out, "together": {"covered": inside, "met": float(np.mean(met))}}


def tabulate(name: str, found: Mapping[str, Mapping[str, float]], seeds: int) -> Iterator[str]:
    """Yield the lines of one case."""
    together, spread = found["together"], 196.0 * np.sqrt(0.95 * 0.05 / seeds)
    yield f"## {name[0].upper()}{name[1:]}\n"
    met = f"{100 * together['met']:.1f} % of the fits met"
    yield f"{seeds} logs, {met}; a right 95 % comes out as 95 ± {spread:.1f}.\n"
    yield "| | covered | by noise alone | std | bias / std | scatter / std | widened |"
    yield "|---|---|---|---|---|---|---|"
    for each, row in found.items():
        if each != "together":
            yield (
                f"| {each} | {100 * row['covered']:.1f} % | {100 * row['covered_by_noise']:.1f} % "
                f"| {row['std_percent']:.3g} % | {row['bias_in_std']:+.2f} | {row['scatter_in_std']:.3f} "
                f"| {row['widened']:.2f} |"
            )
    yield f"| together | {100 * together['covered']:.1f} % | | | | | |\n"


def tabulate_truth(files: Sequence[Path]) -> Iterator[str]:
    """Yield the table of kept cases of `truth/run.py`."""
    kept = [row for file in files for row in json.loads(file.read_text(encoding="utf-8"))]
    yield "## Physics that the model lacks\n"
    yield "From `benchmarks/truth/run.py`, whose text says what the columns are.\n\n```text"
    yield from summarise(kept)
    yield "```"


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description="How often the 95 % intervals of a fit hold the truth.")
    parser.add_argument("seeds", type=int, nargs="?", default=2000)
    parser.add_argument("--case", choices=list(CASES), action="append", help="every case if left out")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--kept", type=Path, help="a file of rows that are kept, and not made again")
    parser.add_argument("--as-kept", action="store_true", help="tables of the first seeds that are kept, however many")
    parser.add_argument("--truth", type=Path, nargs="*", default=[], help="kept cases of truth/run.py")
    parser.add_argument("--page", type=Path, help="write a page, besides what is printed")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    names = given.case or list(CASES)
    if given.json:
        print(json.dumps({name: figures(name, given.seeds, given.workers, given.kept) for name in names}))
        return
    made = f"Made by `python benchmarks/bench_coverage.py {given.seeds}`, whose text says what the cases are"
    made += "; of each as many logs as there was time for.\n" if given.as_kept else ".\n"
    lines = ["# How often intervals hold the truth\n", made]
    print(*lines, sep="\n")
    for name in names:
        started = time.perf_counter()
        there = read_kept(given.kept, name).keys()
        whole = next(seed for seed in range(given.seeds + 1) if seed not in there or seed == given.seeds)
        seeds = whole if given.as_kept else given.seeds
        table = list(tabulate(name, figures(name, seeds, given.workers, given.kept), seeds))
        print(*table, f"({time.perf_counter() - started:.0f} s)", sep="\n", flush=True)
        lines += table
    lines += tabulate_truth(given.truth) if given.truth else []
    if given.page:
        given.page.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
