"""Compensation of gravity from a plant: what its spring carries where its link rests, over the link's position.

The plant is put to rest at angles of its link, as a certificate's draws are, and what is regulated there becomes a
series of Chebyshev's polynomials of what an encoder of the link reads. With all of it as a reference the link stands
where it is, and neither falls nor rises: what is asked besides moves it as if it weighed nothing.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from numpy.polynomial.chebyshev import chebfit, chebval

from seaopt.control.loops.compensation.terms import CompensateGravity, GravityTerm
from seaopt.control.loops.sampled_plant import find_rests
from seaopt.errors import ControlError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.plant import output_function

NODES = 241
HIGHEST_ORDER = 30
ACCURACY = 1e-6  # of the largest effort
TURNING = math.pi  # how far a joint is looked at
LEVERED = math.pi / 3  # how far a link on a lever arm is, which vanishes at 90 degrees
NOTHING = 1e-9  # of an effort, N or N m, that is none


def make_gravity_term(plant: Plant, params: ParameterSet, regulated: str, spec: CompensateGravity) -> GravityTerm:
    """Return the compensation of the weight of a plant's link. `plant`, `params`: a plant whose link moves, and its
    parameters. `regulated`: the output that the reference is of. Raises ControlError: the plant holds its link, no
    output is its position, or it rests without effort.
    """
    port = plant.port
    if port is None or port.motion is None or port.coordinate is None:
        raise ControlError(
            f"compensate.gravity: {plant.name} holds its link; name the plant whose link moves: compensate = "
            '{ gravity = { plant = "swing" } }'
        )
    position = plant.sensing.link_position if plant.sensing is not None else None
    reads = position if position is not None and position in plant.outputs else port.motion
    unit, coordinate = plant.outputs[reads], port.coordinate
    reach = TURNING if unit == plant.states[coordinate] == "rad" else LEVERED
    places, efforts = _rest_at(plant, params, coordinate, np.linspace(-reach, reach, NODES), (reads, regulated))
    largest = float(np.max(np.abs(efforts)))
    if not largest > NOTHING:
        raise ControlError(
            f"compensate.gravity: the link of {plant.name} rests without effort wherever it is; leave gravity out of "
            "compensate"
        )
    low, high = float(np.min(places)), float(np.max(places))
    scaled = (2.0 * places - low - high) / (high - low)
    series = chebfit(scaled, efforts, HIGHEST_ORDER)
    for order in range(1, HIGHEST_ORDER):
        shorter = chebfit(scaled, efforts, order)
        if np.max(np.abs(chebval(scaled, shorter) - efforts)) <= ACCURACY * largest:
            series = shorter
            break
    coefficients = tuple(float(spec.fraction * coefficient) for coefficient in series)
    return GravityTerm(coefficients=coefficients, low=low, high=high, reads=reads, unit=unit, fraction=spec.fraction)


def _rest_at(
    plant: Plant, params: ParameterSet, coordinate: str, angles: Float[np.ndarray, " n"], names: tuple[str, str]
) -> Float[np.ndarray, "2 n"]:
    """Return two outputs where the plant rests at angles of its link."""
    observe, rows = output_function(plant), [list(plant.outputs).index(name) for name in names]
    values = plant.complete(params)
    x, u = find_rests(plant, values, {coordinate: angles}, angles.size)
    outputs = [np.array(observe(0.0, *at, values.vector)).ravel()[rows] for at in zip(x.T, u.T, strict=True)]
    return np.array(outputs).T
