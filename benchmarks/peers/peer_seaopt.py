"""seaopt by its public names: a plant of one's own, and `fit` as it comes."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np
from problem import LOWER, NAMES, NOISE_N, START, STEP_S, UNITS, UPPER, V_S, Answer, Data, K, Settings, report

import seaopt as so


def plant() -> so.Plant:
    """Return the actuator on its stand; the sensor's offset belongs to the experiment."""
    return so.Plant(
        name="stand",
        states={"x": "m", "v": "m/s"},
        inputs={"i": "A"},
        outputs={"F": "N"},
        parameters={**dict(zip(NAMES[:4], UNITS[:4], strict=True)), "k": "N/m", "v_s": "m/s"},
        f=lambda t, x, u, p: {
            "x": x.v,
            "v": (p.Kf * u.i - p.b * x.v - p.Fc * ca.tanh(x.v / p.v_s) - p.k * x.x) / p.m,
        },
        h=lambda t, x, u, p: {"F": p.k * x.x},
    )


def pose(data: Data) -> tuple[so.Experiment, so.ParameterSet]:
    """Return the experiment, and where the search begins."""
    log = so.Log.from_arrays(time=np.arange(data.current.size) * STEP_S, i=data.current, F=data.force)
    free = {name: (START[j], UNITS[j]) for j, name in enumerate(NAMES[:4])}
    guess = so.ParameterSet.of(**free, k=(K, "N/m"), v_s=(V_S, "m/s")).free(*free)
    guess = guess.bound(**{name: (LOWER[j], UPPER[j]) for j, name in enumerate(free)})
    return so.Experiment(plant=plant(), log=log, sigma={"F": NOISE_N}), guess


def list_unknowns(fit: so.Fit) -> np.ndarray:
    """Return all seven unknowns at a fit's minimum."""
    (own,) = fit.nuisance.values()
    values = (fit.parameters[name].value for name in NAMES[:4])
    return np.array([*values, own.offset["F"], *own.initial_state[0].values()])


def prepare(data: Data, settings: Settings) -> Callable[[], Answer]:
    """State the problem; seaopt chooses its own steps and compiles in the first fit."""
    experiment, guess = pose(data)

    def solve() -> Answer:
        fit = so.fit([experiment], guess)
        own = fit.nuisance[experiment.name]
        note = f"{fit.status}; {own.substeps} steps a sample, error {fit.step_error_sigma:.3f} sigma"
        return Answer(theta=list_unknowns(fit), evaluations=fit.iterations, note=note)

    return solve


if __name__ == "__main__":
    report("seaopt", "seaopt", prepare)
