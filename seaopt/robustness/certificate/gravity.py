"""Whether a link stays where it is with its weight compensated from its position, on every plant and over draws.

Compensation of gravity is a feedback of the link's position into the reference. At angles over its range the sampled
loop is linearised, sliding, with the slope that the compensation has there, and with the impedance's outer loop where
there is one. All of a link's weight compensated leaves it neutral, an eigenvalue at 1; more than it weighs lets it
rise, so that fractions near 1 want an impedance, or a load that is known well. Angles at which the link falls without
compensation, as it does on its head, are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from seaopt.control import Controller, Law, Loop, runnable
from seaopt.control.loops.compensation.terms import GravityTerm
from seaopt.control.loops.sampled_plant import find_rest, sample
from seaopt.control.running.outer_run import enclose_law
from seaopt.formatting import format_values
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import take_sliding
from seaopt.plants.plant import output_function
from seaopt.records import record
from seaopt.robustness.certificate.certificate import Requirement
from seaopt.robustness.uncertainty.draws import Uncertainty
from seaopt.robustness.uncertainty.worst import place_values

GRAVITY_COMPENSATION = "gravity_compensation"
GRAVITY_DRAWS = 20
PLACES, INSIDE = 9, 0.95  # over so much of the range
NEUTRAL = 1e-6  # beyond 1, of an eigenvalue that neither grows nor decays, by rounding and the series' last digits


@record
class GravityCase:
    """The largest eigenvalue of a loop with gravity compensated, and where."""

    radius: float
    angle: float
    parameters: dict[str, float]


def require_gravity(
    controller: Controller, models: Mapping[str, Plant], unknown: Uncertainty, samples: int, rng: np.random.Generator
) -> list[Requirement]:
    """Return that no plant's link runs away with its weight compensated; nothing where none is.

    Parameters
    ----------
    controller : Controller
        Any.
    models : mapping of name to Plant
        Those whose link is held are left out.
    unknown : Uncertainty
        Of the parameters.
    samples : int
        Draws; at most `GRAVITY_DRAWS` are looked at.
    rng : numpy.random.Generator
        Of the draws.

    """
    term = None if controller.compensation is None else controller.compensation.gravity
    if term is None:
        return []
    count = min(samples, GRAVITY_DRAWS)
    values = unknown.values(unknown.draw(count, rng)) if count else {}
    draws = [{name: float(column[k]) for name, column in values.items()} for k in range(count)]
    rows: list[Requirement] = []
    for name, model in models.items():
        if model.port is None or term.reads not in model.outputs:
            continue
        worst = find_worst_gravity(controller, model, unknown.nominal, [{}, *draws])
        known = f" and {format_values(worst.parameters)}" if worst.parameters else ""
        rows.append(Requirement(
            name=GRAVITY_COMPENSATION, limit=1.0 + NEUTRAL, value=worst.radius, met=worst.radius <= 1.0 + NEUTRAL,
            where=f"{name} at {worst.angle:.3g} {model.states[str(model.port.coordinate)]}{known}: the largest "
            f"eigenvalue with {100.0 * term.fraction:.3g} % of the weight compensated",
        ))  # fmt: skip
    return rows


def find_worst_gravity(
    controller: Controller, plant: Plant, nominal: ParameterSet, draws: Sequence[Mapping[str, float]]
) -> GravityCase:
    """Return the largest eigenvalue over angles and draws.

    Parameters
    ----------
    controller : Controller
        With a compensation of gravity.
    plant : Plant
        Whose link moves.
    nominal : ParameterSet
        What is not drawn.
    draws : sequence of mapping
        Values by name.

    """
    assert controller.compensation is not None and controller.compensation.gravity is not None
    assert plant.port is not None and plant.port.coordinate is not None
    term, coordinate, unit = controller.compensation.gravity, plant.port.coordinate, plant.states[plant.port.coordinate]
    reach = INSIDE * (min(abs(term.low), abs(term.high)) if term.unit == unit else np.pi / 3)
    worst = GravityCase(radius=0.0, angle=0.0, parameters={})
    for draw in draws:
        placed = place_values(plant, nominal, draw)
        for angle in np.linspace(-reach, reach, PLACES):
            at = placed.with_parameters(Parameter(name=coordinate, value=float(angle), unit=unit))
            if _find_radius(controller, term, plant, at, share=0.0) > 1.0 + NEUTRAL:
                continue  # a link that stands on its head falls by itself
            radius = _find_radius(controller, term, plant, at)
            if radius > worst.radius:
                used = {name: value for name, value in draw.items() if name in placed}
                worst = GravityCase(radius=radius, angle=float(angle), parameters=used)
    return worst


def _find_radius(
    controller: Controller, term: GravityTerm, plant: Plant, params: ParameterSet, share: float = 1.0
) -> float:
    """Return the largest eigenvalue of the loop at one angle, with a share of the compensation."""
    law, signals = runnable(controller), list(controller.signals)
    if controller.outer is not None:
        law = enclose_law(law, controller.outer)
        signals.append(str(plant.port.motion) if plant.port is not None else term.reads)
        assert law.compensation is not None and law.compensation.gravity is not None
        term = law.compensation.gravity
    n = law.c.size
    b, d = np.reshape(law.b_measurement, (n, -1)), np.ravel(law.d_measurement)
    if term.reads not in signals:
        signals.append(term.reads)
        b, d = np.hstack([b, np.zeros((n, 1))]), np.append(d, 0.0)
    position = _read_position(plant, params, term.reads)
    slope, column = share * term.slope(position), signals.index(term.reads)
    b, d = b.copy(), d.copy()
    b[:, column] -= law.b_reference * slope
    d[column] -= law.d_reference * slope
    whole = Law(
        a=law.a, b=np.column_stack([law.b_reference, -b]), c=law.c, d=np.append(law.d_reference, -d),
        sample_time_s=law.sample_time_s,
    )  # fmt: skip
    sliding = take_sliding(plant, params)
    sampled = sample(
        sliding, params, tuple(signals), controller.command.per_effort, law.sample_time_s, controller.delay_samples
    )
    return float(np.max(np.abs(Loop(plant=sampled, law=whole).eigenvalues())))


def _read_position(plant: Plant, params: ParameterSet, output: str) -> float:
    values = plant.complete(params)
    x, u = find_rest(plant, values)
    return float(output_function(plant)(0.0, x, u, values.vector)[list(plant.outputs).index(output)])
