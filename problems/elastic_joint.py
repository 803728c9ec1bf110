r"""The case that rigid tools miss: an elastic joint under a firmware's PD, by its goal and an encoder at the motor.

A motor with a gear turns a link through a spring. Its firmware holds the motor's angle by current; a log has the goal,
a chirp of 20 s from 0.1 to 10 Hz, and the motor's angle in encoder steps. The goal acts 1.4 samples late. The truth
is simulated here, by NumPy and SciPy alone, with dry friction that sticks; `fit_rigid` and `fit_elastic` fit what rigid
tools assume, and the joint as it is. docs/evidence/elastic_joint.md tells what comes out.

    python problems/elastic_joint.py [SEED]
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import expm

import seaopt as so
from seaopt.estimation.result.findings import ModelledOutputs

RATE_HZ = 200.0
DURATION_S = 20.0
BAND_HZ = (0.1, 10.0)
AMPLITUDE = 0.5  # rad at the motor
DELAY_S = 1.4 / RATE_HZ
STEP = {"theta_m": 2 * np.pi / 512, "theta_l": 2 * np.pi / 16384}  # rad, of the encoders at motor and link
SUBSTEPS = 50  # of the truth, per sample
KNOWN = {"N": 10.0, "K_tau": 0.05}
GAINS = {"k_p": 40.0, "k_d": 0.4}  # A/rad and A s/rad, of the firmware
TRUTH = {"J_m": 3e-4, "J_l": 0.08, "k_s": 100.0, "c_s": 0.15, "b_r": 2e-3, "f_c": 0.02, "delay_s": DELAY_S}
START = {"J_m": 1e-4, "J_l": 0.05, "k_s": 200.0, "c_s": 0.5, "b_r": 1e-3, "f_c": 0.005}


def draw_truth(seed: int) -> dict[str, float]:
    """Return a joint of its own for each seed: every parameter up to 20 % off, seed 0 as `TRUTH` has it."""
    spread = np.random.default_rng([16, seed]).uniform(0.8, 1.2, len(TRUTH)) if seed else np.ones(len(TRUTH))
    joint = {name: value * factor for (name, value), factor in zip(TRUTH.items(), spread, strict=True)}
    return {**joint, "delay_s": DELAY_S}


def sweep(band_hz: tuple[float, float] = BAND_HZ, duration_s: float = DURATION_S) -> np.ndarray:
    """Return the goal (rad at the motor): a sine whose frequency grows in proportion to time."""
    t = np.arange(round(duration_s * RATE_HZ)) / RATE_HZ
    low, high = band_hz
    return AMPLITUDE * np.sin(2 * np.pi * (low * t + 0.5 * (high - low) / duration_s * t**2))


def step_goals(seed: int = 0, duration_s: float = 10.0) -> np.ndarray:
    """Return goals (rad at the motor) that jump every 0.4 s: what a fit to the chirp is to predict."""
    jumps = round(duration_s / 0.4)
    return np.repeat(AMPLITUDE * np.random.default_rng([17, seed]).uniform(-0.5, 0.5, jumps), round(0.4 * RATE_HZ))


def find_resonances(joint: Mapping[str, float]) -> dict[str, float]:
    """Return the frequencies of the link on its spring with the motor held, and of both without the firmware."""
    reflected = KNOWN["N"] ** 2 * joint["J_m"]
    inverse = {"antiresonance_hz": 1 / joint["J_l"], "resonance_hz": 1 / joint["J_l"] + 1 / reflected}
    return {name: float(np.sqrt(joint["k_s"] * one)) / (2 * np.pi) for name, one in inverse.items()}


def simulate(joints: Mapping[str, np.ndarray | float], goal: np.ndarray, substeps: int = SUBSTEPS) -> np.ndarray:
    """Return the angles of motor and link at the samples, shape (2, samples, joints), of many joints at once.

    Between two substeps the joint is linear, with the friction's torque constant: that is exact. The torque is what
    would stop the motor by the end of the substep, at most f_c: a motor that it stops is stuck.
    """
    names = (*TRUTH, *KNOWN, *GAINS)
    values = {**KNOWN, **GAINS, **joints}
    p = dict(zip(names, np.broadcast_arrays(*(np.atleast_1d(values[name]) for name in names)), strict=True))
    count = p["J_m"].size
    a, effects = np.zeros((count, 6, 6)), np.zeros((count, 4, 2))
    a[:, 0, 1] = a[:, 2, 3] = 1.0
    pull, drag = p["k_s"] / p["N"], p["c_s"] / p["N"]  # of the spring on the motor, per rad of the link
    a[:, 1, 0] = -(pull / p["N"] + p["K_tau"] * p["k_p"]) / p["J_m"]
    a[:, 1, 1] = -(drag / p["N"] + p["K_tau"] * p["k_d"] + p["b_r"]) / p["J_m"]
    a[:, 1, 2], a[:, 1, 3] = pull / p["J_m"], drag / p["J_m"]
    a[:, 3, 0], a[:, 3, 1] = pull / p["J_l"], drag / p["J_l"]
    a[:, 3, 2], a[:, 3, 3] = -p["k_s"] / p["J_l"], -p["c_s"] / p["J_l"]
    effects[:, 1, 0], effects[:, 1, 1] = p["K_tau"] * p["k_p"] / p["J_m"], -1.0 / p["J_m"]
    a[:, :4, 4:] = effects
    step = expm(a / (RATE_HZ * substeps))[:, :4]  # [state, goal, friction] -> state
    moves, driven, rubbed = step[:, :, :4], step[:, :, 4], step[:, :, 5]
    late = p["delay_s"] * RATE_HZ * substeps
    whole = np.floor(late).astype(int)
    share = late - whole
    held = np.concatenate([np.full(np.max(whole) + 1, goal[0]), np.repeat(goal, substeps)])
    x, out = np.zeros((count, 4)), np.empty((2, goal.size, count))
    for k in range(goal.size):
        out[:, k] = x[:, 0], x[:, 2]
        for j in range(substeps):
            at = k * substeps + j + np.max(whole) + 1 - whole
            now = (1 - share) * held[at] + share * held[at - 1]
            x = np.einsum("nij,nj->ni", moves, x) + driven * now[:, None]
            friction = np.clip(-x[:, 1] / rubbed[:, 1], -p["f_c"], p["f_c"])
            x += rubbed * friction[:, None]
    return out


def record(goal: np.ndarray, angles: np.ndarray, seed: int = 0) -> so.Log:
    """Return the log of one joint's angles, shape (2, samples), in encoder steps that begin anywhere."""
    begin = np.random.default_rng([18, seed]).uniform(0.0, 1.0, len(STEP))
    read = {
        name: np.round(angle / step + first) * step
        for (name, step), angle, first in zip(STEP.items(), angles, begin, strict=True)
    }
    return so.Log.from_arrays(time=np.arange(goal.size) / RATE_HZ, goal=goal, **read)


@cache
def make_rigid() -> so.Plant:
    """Return what rigid tools assume: motor and link as one inertia J, at the motor, with viscous and dry friction."""
    plant = so.Plant(
        name="rigid joint",
        states={"theta_m": "rad", "thetad_m": "rad/s"},
        inputs={"I": "A"},
        outputs={"theta_m": "rad", "theta_l": "rad"},
        parameters={"J": "kg m^2", "b": "N m s", "f_c": "N m", "K_tau": "N m/A", "N": "-"},
        f=lambda t, x, u, p: {"theta_m": x.thetad_m, "thetad_m": (p.K_tau * u.I - p.b * x.thetad_m - u.tau_f) / p.J},
        h=lambda t, x, u, p: {"theta_m": x.theta_m, "theta_l": x.theta_m / p.N},
        actuation=so.plants.Actuation(input="I", effort=lambda p: p.N * p.K_tau, unit="N m"),
        sensing=so.plants.Sensing(regulated=(), motor_position="theta_m", motor_speed="thetad_m"),
        friction={
            "tau_f": so.plants.Friction(
                velocity=lambda x, p: x.thetad_m, force=lambda v, p: p.f_c * ca.tanh(v), jump=lambda v, p: p.f_c,
                unit="N m",
            )
        },
    )  # fmt: skip
    return so.plants.let_stick(so.plants.wrapped(plant, ["position_servo"]))


@cache
def make_elastic() -> so.Plant:
    """Return the joint as it is."""
    return so.plants.let_stick(so.plants.rotary(parts=["position_servo"]))


def observe(plant: so.Plant, log: so.Log, **options: Any) -> so.Experiment:
    """Return the experiment: from rest, the firmware's gains known, the delay not."""
    delay = so.Parameter(name="delay", value=1.0 / RATE_HZ, unit="s", free=True, max=10.0 / RATE_HZ)
    chosen = {"outputs": ("theta_m",), "delay_s": delay, "initial_state": "rest", **options}
    return so.Experiment(plant=plant, log=log, parameters=GAINS, **chosen)


def fit_rigid(log: so.Log, **options: Any) -> so.Fit:
    """Fit inertia, both frictions and delay of a rigid joint."""
    guess = so.ParameterSet.of(
        J=(1e-3, "kg m^2"), b=(1e-3, "N m s"), f_c=(5e-3, "N m"), K_tau=(KNOWN["K_tau"], "N m/A"), N=(KNOWN["N"], "-")
    )
    free = ("J", "b", "f_c")
    guess = guess.bound(J=(1e-5, 1.0), b=(0.0, 1.0), f_c=(0.0, 1.0)).free(*free)
    return so.fit([observe(make_rigid(), log)], guess, **options)


def fit_elastic(log: so.Log, **options: Any) -> so.Fit:
    """Fit both inertias, the spring and its damping, both frictions and delay of the joint as it is."""
    plant = make_elastic()
    guess = plant.defaults.update(**KNOWN, **START).bound(J_m=(1e-5, 1.0)).free(*START)
    return so.fit([observe(plant, log)], guess, **options)


def find_peak(goal: np.ndarray, link: np.ndarray) -> tuple[float, float]:
    """Return how many times the goal's amplitude the link's motion reaches in a sweep, and at which frequency (Hz)."""
    k = int(np.argmax(np.abs(link)))
    return float(KNOWN["N"] * np.abs(link[k]) / np.max(np.abs(goal))), float(np.interp(k, [0, goal.size], BAND_HZ))


def predict(fit: so.Fit, log: so.Log) -> ModelledOutputs:
    """Return a fit's prediction of another log's motor and link, from rest."""
    delay = fit.nuisance["experiment"].delay_s
    held_out = observe(fit.experiments[0].plant, log, name="held-out", outputs=("theta_m", "theta_l"), delay_s=delay)
    return fit.predict(held_out)


def main(seed: int) -> None:
    """Fit both models to one joint's log, and say what each makes of it."""
    truth, goal, steps = draw_truth(seed), sweep(), step_goals(seed)
    angles, others = simulate(truth, goal)[:, :, 0], simulate(truth, steps)[:, :, 0]
    log, other = record(goal, angles, seed), record(steps, others, seed + 1)
    print("truth:", ", ".join(f"{name} = {hz:.4g}" for name, hz in find_resonances(truth).items()))
    print("link in the chirp: {:.3g} times the goal at {:.3g} Hz".format(*find_peak(goal, angles[1])))
    for fit in (fit_rigid(log), fit_elastic(log)):
        print(fit)
        swing = find_peak(goal, predict(fit, log).model["theta_l"])
        print("link in the chirp: {:.3g} times the goal at {:.3g} Hz".format(*swing))
        print(predict(fit, other))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 0)
