"""Linearisation of a plant: A, B, C, D from CasADi's exact Jacobians."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.errors import PlantError, suggestion
from seaopt.parameters import ParameterSet
from seaopt.plants.plant import Plant

Matrices = tuple[
    Float[np.ndarray, "nx nx"],
    Float[np.ndarray, "nx nu"],
    Float[np.ndarray, "ny nx"],
    Float[np.ndarray, "ny nu"],
]


def jacobians(plant: Plant) -> Any:
    """Return the CasADi function (x, u, p) -> (A, B, C, D), made once a plant."""
    if "jacobians" not in plant.cache:
        blocks = [
            ca.densify(ca.jacobian(expression, variable))
            for expression in (plant.dynamics, plant.output)
            for variable in (plant.x, plant.u)
        ]
        arguments = [plant.x, plant.u, plant.p]
        blocks = [ca.substitute(block, plant.t, 0.0) for block in blocks]
        plant.cache["jacobians"] = ca.Function("jacobians", arguments, blocks)
    return plant.cache["jacobians"]


def point(kind: str, names: Mapping[str, str], values: Mapping[str, float] | None) -> Float[np.ndarray, " n"]:
    """Return the vector of `names` with the given values, zero elsewhere.

    Raises
    ------
    PlantError
        A name is not one of `names`.

    """
    if values is not None and not isinstance(values, Mapping):
        raise PlantError(f"{kind}s are given as a {type(values).__name__}; give a mapping of {kind} name to value")
    given = dict(values or {})
    for name in given:
        if name not in names:
            raise PlantError(f'"{name}" is not a {kind} of this plant; {suggestion(name, names)}')
    return np.array([float(given.get(name, 0.0)) for name in names])


def state_space(
    plant: Plant,
    params: ParameterSet,
    x: Mapping[str, float] | None = None,
    u: Mapping[str, float] | None = None,
) -> Matrices:
    """Return (A, B, C, D) of a plant at an operating point, as `Plant.linearize` but plain arrays."""
    at = (point("state", plant.states, x), point("input", plant.inputs, u), plant.parameter_values(params))
    a, b, c, d = (np.array(block) for block in jacobians(plant)(*at))
    return a, b, c, d
