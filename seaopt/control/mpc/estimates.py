"""What a Kalman filter estimates: the states, with the disturbances of the inputs, and what follows from them."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.control.mpc.noise import NoiseModel
from seaopt.plants import CompletedParameters, Plant
from seaopt.plants.plant import deflection_row


def disturbances_of(plant: Plant, noise: NoiseModel, sample_time_s: float) -> list[tuple[int, float, float]]:
    """Return (input, pole, variance over one sample) of each disturbance: white ones have pole 0, walks pole 1."""
    inputs, root = list(plant.inputs), np.sqrt(sample_time_s)
    white = [(inputs.index(name), 0.0, (s / root) ** 2) for name, s in noise.input_noise.items() if s > 0.0]
    return white + [(inputs.index(name), 1.0, (s * root) ** 2) for name, s in noise.input_drift.items() if s > 0.0]


def augment(
    a: Float[np.ndarray, "nx nx"], b: Float[np.ndarray, "nx nu"], disturbances: list[tuple[int, float, float]]
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n nu"], Float[np.ndarray, "n n"]]:
    """Return A, B and Q of the plant with its disturbances as states."""
    nx, count = len(a), len(disturbances)
    A, Q = np.zeros((nx + count, nx + count)), np.zeros((nx + count, nx + count))
    A[:nx, :nx] = a
    for i, (column, pole, variance) in enumerate(disturbances, start=nx):
        A[:nx, i], A[i, i], Q[i, i] = b[:, column], pole, variance
    return A, np.vstack([b, np.zeros((count, b.shape[1]))]), Q


def list_estimates(
    plant: Plant, params: CompletedParameters, matrices: tuple[Any, Any, Any, Any],
    disturbances: list[tuple[int, float, float]],
) -> tuple[tuple[str, ...], tuple[str, ...], Float[np.ndarray, "nz n"], Float[np.ndarray, "nz nu"]]:  # fmt: skip
    """Return names, units, G and H of everything that is estimated."""
    a, b, c, d = matrices
    nx, nu = b.shape
    columns = [column for column, _, _ in disturbances]
    units = dict(plant.outputs)
    rows = {name: (c[i], d[i]) for i, name in enumerate(plant.outputs)}
    for i, (name, unit) in enumerate(plant.states.items()):
        if name not in rows:
            rows[name], units[name] = (np.eye(nx)[i], np.zeros(nu)), unit
    if plant.spring is not None:
        row, unit = deflection_row(plant, params), plant.spring.unit
        rows |= {"spring_deflection": (row, np.zeros(nu)), "spring_rate": (row @ a, row @ b)}
        units |= {"spring_deflection": unit, "spring_rate": f"{unit}/s"}
    count = len(disturbances)
    wide = {name: (np.concatenate([x, u[columns]]), u) for name, (x, u) in rows.items()}
    for i, (column, pole, _) in enumerate(disturbances, start=nx):
        if pole == 1.0:
            name = list(plant.inputs)[column]
            wide[f"{name}_drift"] = (np.eye(nx + count)[i], np.zeros(nu))
            units[f"{name}_drift"] = plant.inputs[name]
    G, H = (np.array([pair[k] for pair in wide.values()]) for k in (0, 1))
    return tuple(wide), tuple(units[name] for name in wide), G, H
