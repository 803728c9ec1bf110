"""From a problem file to an accepted machine: fit, law, certificate, stages of bring-up, their logs, the verdicts.

    python problems/commissioning.py [FOLDER]

The machine is simulated here, by python-control's sampled model of the plant and the exported law's own step; on a real
one the logs come from the firmware, and the same is typed:

    seaopt run commissioning.toml -o out
    seaopt bringup commissioning.toml -o out
    seaopt accept commissioning.toml stage_1.csv --stage stage_1 -o out
    seaopt accept commissioning.toml full.csv -o out
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import control
import numpy as np

import seaopt as so
from seaopt.control import runnable
from seaopt.machine import write_bring_up
from seaopt.problem import certify_problem, fit_problem, tune_problem

PROBLEM = Path(__file__).with_name("commissioning.toml")
TRUTH = {"J": 3.31e-6, "b_r": 1.31e-4, "eta": 0.95}


def play(law: so.Controller, plant: so.Plant, truth: so.ParameterSet, reference: np.ndarray, seed: int) -> so.Log:
    """Return the log of a machine under a law: in each tick what the law was given, read and returned."""
    period, noise = law.sample_time_s, 2.0 * np.random.default_rng(seed).normal(size=reference.size)
    sampled = control.c2d(plant.linearize(truth), period)
    row = list(plant.outputs).index("F1")
    step, state = runnable(law), runnable(law).reset()
    x, force, current = np.zeros(len(sampled.A)), np.zeros(reference.size), np.zeros(reference.size)
    for k, goal in enumerate(reference):
        force[k] = sampled.C[row] @ x + noise[k]
        current[k], state = step.step(state, float(goal), float(force[k]))
        x = sampled.A @ x + sampled.B[:, 0] * (current[k - 1] if k else 0.0)  # put out at the next tick
    time = period * np.arange(reference.size)
    units = {"goal": "N", "I": "A", "F1": "N"}
    return so.Log.from_arrays(time=time, goal=reference, I=current, F1=force, units=units, source="machine")


def commission(folder: Path) -> tuple[so.Certificate, list[bool]]:
    """Return the certificate of the law, and whether each stage's log is accepted; its files are in `folder`."""
    problem = so.read_problem(PROBLEM)
    fit = fit_problem(problem)
    law = tune_problem(problem, fit)
    law = getattr(law, "controller", law)
    certificate = certify_problem(problem, law, fit)
    plants, stand = problem.certified_plants(), problem.design_plant
    plan = so.bring_up(law, plants, fit, samples=300, certificate=certificate, limits={"F1": 1500.0})
    write_bring_up(plan, folder)
    truth = problem.values(fit).update(**TRUTH)
    accepted: list[bool] = []
    for number, stage in enumerate(plan.stages):
        log = play(stage.controller, stand, truth, stage.excitation.reference, seed=number)
        so.write_log(log, folder / f"{stage.name}.csv")
        acceptance = so.accept(stage.controller, [log], reference="goal", uncertainty=fit)
        print(acceptance, end="\n\n")
        accepted.append(acceptance.met)
    return certificate, accepted


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp())
    certificate, accepted = commission(target)
    print(f"certificate {'met' if certificate.met else 'not met'}; stages accepted: {accepted}; files in {target}")
