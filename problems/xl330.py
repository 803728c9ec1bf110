"""A servo under position control, on the measured logs of ../shared/data/xl330; the problem itself is in xl330.toml.

This script puts the logs beside the problem file, reads off them how the firmware turns position error into duty, fits
with and without friction that grows with the load (Duclusaud and Passault, Extended Friction Models for the Physics
Simulation of Servo Actuators, 2024), and says by how many degrees the angle is wrong on trajectories that were not
fitted, from rest, by the goal and the supply. Both gains are fitted; how far one gain's values hold at the other is
said, too.

    python problems/xl330.py [folder with the JSON files [folder to work in]]
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np

import seaopt as so

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "xl330"
PROBLEM = Path(__file__).with_suffix(".toml")
FULL_DUTY = 885.0  # counts
COUNTS_PER_RAD = 4096 / (2 * np.pi) / 256  # duty counts per radian of error and unit of gain; see `duty_scale`
LOAD = ("c_m", "c_g")  # friction's shares of the load
# Rhoban's own fit of this servo with their largest model, params/xl330/m6.json in Rhoban/bam, with the tolerance asked
# for here. Their duty per radian, 0.00246, is smaller than in the logs and their R with it: the product is compared.
PUBLISHED = {"kt": (0.3036, 0.05), "J": (0.002057, 0.0003), "c_m": (0.2843, 0.05), "c_g": (0.1363, 0.05)}
PUBLISHED_DEG = 1.77  # their mean absolute error, on their recordings


def gather(logs: Path, folder: Path) -> so.Problem:
    """Return the problem, copied into a folder with its logs; `seaopt fit FOLDER/xl330.toml` reads it there, too."""
    for path in (PROBLEM, *logs.glob("*.json")):
        shutil.copy(path, folder)
    return so.read_problem(folder / PROBLEM.name)


def duty_scale(folder: Path) -> float:
    """Return the duty counts per radian of error and unit of gain that the logs show, away from full duty."""
    errors, counts = [], []
    for path in sorted(folder.glob("*.json")):
        content = json.loads(path.read_text())
        names = ("position", "goal_position", "load", "torque_enable")
        q, goal, duty, on = np.array([[float(row[name]) for name in names] for row in content["entries"]]).T
        duty = np.where(duty > 32767, duty - 65536, duty)  # wrapped into 16 bits without sign
        inside = (on > 0) & (np.abs(duty) < 0.9 * FULL_DUTY)
        errors.append(content["kp"] * (goal - q)[inside])
        counts.append(duty[inside])
    x, y = np.concatenate(errors), np.concatenate(counts)
    return float(x @ y / (x @ x))


def fit(problem: so.Problem, load_friction: bool = True) -> so.Fit:
    """Fit the servo to the trajectories that the problem file fits, with or without friction from the load."""
    guess = problem.parameters
    if not load_friction:
        guess = guess.update(**dict.fromkeys(LOAD, 0.0)).fix(*LOAD)
    fitted = problem.choose_fitted(problem.experiments())
    return so.fit(fitted, guess, **problem.fit_options, diagnostics=load_friction)


def fit_gain(problem: so.Problem, gain: int) -> so.Fit:
    """Fit every trajectory at one gain, to see how far its values hold at the other."""
    fitted = [experiment for experiment in problem.experiments() if experiment.parameters["k_p"] == gain]
    return so.fit(fitted, problem.parameters, **problem.fit_options, diagnostics=False)


def errors_deg(fit: so.Fit, problem: so.Problem, fitted: bool) -> dict[str, float]:
    """Return the mean absolute error of the angle (deg) by log, from rest by the goal and the supply, of those fitted
    or not.
    """
    out: dict[str, float] = {}
    known = {experiment.name for experiment in fit.experiments}
    for experiment in problem.experiments():
        if (experiment.name in known) == fitted:
            parameters = fit.parameters.update(**experiment.parameters)
            run = so.simulate(experiment.plant, parameters, experiment.log, hold="first", rtol=1e-5)
            out[experiment.name] = float(np.rad2deg(np.mean(np.abs(run["angle"] - experiment.log["angle"]))))
    return out


def average(errors: dict[str, float]) -> float:
    """Return the mean over the logs."""
    return float(np.mean(list(errors.values())))


def check(fit: so.Fit, names: Iterable[str] = ("kt", "J")) -> None:
    """Compare the fitted servo with the published one: of its friction these logs tell little."""
    for name, (value, tolerance) in PUBLISHED.items():
        print(f"{name} = {fit.parameters[name].value:.4g}; {value:.4g} published")
        assert name not in names or abs(fit.parameters[name].value - value) < tolerance, fit.parameters[name]


def main(logs: Path, folder: Path) -> None:
    """Print both friction models, their errors on trajectories that were not fitted, and check them."""
    if not list(logs.glob("*.json")):
        print(f"{logs}/*.json is not there; give the folder of the JSON logs")
        raise SystemExit(2)
    scale = duty_scale(logs)
    print(f"duty: {scale:.3f} counts per radian and unit of gain; 4096/(2 pi)/256 is {COUNTS_PER_RAD:.3f}")
    assert abs(scale / COUNTS_PER_RAD - 1) < 0.01
    problem, found = gather(logs, folder), {}
    for load_friction in (False, True):
        result = fit(problem, load_friction)
        print(result)
        for title, fitted in (("fitted", True), ("not fitted", False)):
            errors = errors_deg(result, problem, fitted)
            listed = ", ".join(f"{name}: {value:.2f}" for name, value in errors.items())
            print(f"{title}: mean absolute error {average(errors):.2f} deg ({listed})")
            found[load_friction] = average(errors)
    for gain, other in ((100, 400), (400, 100)):
        errors = average(errors_deg(fit_gain(problem, gain), problem, fitted=False))
        print(f"all four trajectories at gain {gain} fitted: {errors:.2f} deg on those at {other}")
    check(result)
    assert found[True] < PUBLISHED_DEG
    assert found[True] < 0.6 * found[False]


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(prefix="xl330-") as scratch:
        given = [Path(argument) for argument in sys.argv[1:]]
        main(given[0] if given else DATA, given[1] if len(given) > 1 else Path(scratch))
