"""Whether a controller stays stable with its friction compensated from the speed, on every plant and over draws.

The compensation is the controller's, made for the design plant's friction; each plant and draw has its own. The test
takes friction of any steepness up to the plant's own, and none at all, so that compensating more than a draw has of it
is covered.

Compensation of gravity is a feedback of the link's position into the reference. At angles over its range the sampled
loop is linearised, sliding, with the slope that the compensation has there, and with the impedance's outer loop where
there is one. All of a link's weight compensated leaves it neutral, an eigenvalue at 1; more than it weighs lets it
rise, so that fractions near 1 want an impedance, or a load that is known well. Angles at which the link falls without
compensation, as it does on its head, are left out.

Compensation of ripple is a feedback of the motor's position whose slope changes sign over a revolution. The sampled
loop, sliding and with gravity's slope where that is compensated, is linearised with slopes from its steepest negative
to its steepest positive. That says that no place at which the motor rests is unstable, on a plant whose ripple is none;
one that moves through the slopes has a loop that varies, of which eigenvalues prove nothing, and ripple that is
elsewhere than compensated may double the slope.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np

from seaopt.codec import OrInfinite
from seaopt.control import Controller, Law, Loop, runnable
from seaopt.control.compensation.compensate import ENOUGH, find_compensation_margins
from seaopt.control.loops.compensation.stability import CompensationMargin
from seaopt.control.loops.compensation.terms import GravityTerm
from seaopt.control.loops.sampled_plant import find_rest, sample
from seaopt.control.running.outer_run import enclose_controller
from seaopt.errors import ControlError
from seaopt.executors import Shared
from seaopt.formatting import format_values
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import take_sliding
from seaopt.plants.plant import output_function
from seaopt.records import record
from seaopt.robustness.certificate.friction import MARGIN_DRAWS
from seaopt.robustness.certificate.measured_draws import Draw, Loops, judge_draws, select_own
from seaopt.robustness.uncertainty.worst import place_values

FRICTION_COMPENSATION = "friction_compensation"
GRAVITY_COMPENSATION = "gravity_compensation"
RIPPLE_COMPENSATION = "ripple_compensation"
GRAVITY_DRAWS = 20
RIPPLE_DRAWS, SLOPES = 20, 9  # draws, and slopes from the steepest negative to the steepest positive
PLACES, INSIDE = 9, 0.95  # over so much of the range
NEUTRAL = 1e-6  # beyond 1, of an eigenvalue that neither grows nor decays, by rounding and the series' last digits
FROM_REFERENCE = "friction is compensated from the reference, outside the loop: its stability is the law's without it"


@record
class CompensationDraws:
    """For how many draws stability is shown with friction compensated, and the least slope for which it is.

    Parameters
    ----------
    samples, shown : int
        Draws looked at, and those for which it is.
    least_slope : float
        The steepest compensation for which it is shown, of the draw with the least; zero where it is not for one.
    parameters : mapping
        That draw.

    """

    samples: int
    shown: int
    least_slope: OrInfinite
    parameters: dict[str, float]

    def __str__(self) -> str:
        where = f", the least at {format_values(self.parameters)}" if self.parameters else ""
        return f"over draws, it is shown for {self.shown} of {self.samples}{where}"


def compensates_speed(controller: Controller) -> bool:
    """Tell whether a controller compensates friction from a measured speed, which is a feedback."""
    compensation = controller.compensation
    return compensation is not None and compensation.friction is not None and compensation.friction.source == "speed"


def find_nominal_compensation(
    controller: Controller, models: Mapping[str, Plant], params: ParameterSet
) -> dict[str, CompensationMargin]:
    """Return for how steep a compensation stability is shown, of every plant; empty where none is from the speed."""
    if not compensates_speed(controller):
        return {}
    return {
        name: find_compensation_margins(controller, model, [params], enough=ENOUGH)[0] for name, model in models.items()
    }


def find_compensation_at_draws(
    loops: Shared[Loops],
    nominal: Mapping[str, CompensationMargin],
    samples: int,
    rng: np.random.Generator,
    executor: Executor | None = None,
) -> dict[str, CompensationDraws]:
    """Return the same over draws, of the plants for which it is shown at the nominal parameters."""
    enough, count = {name: margin for name, margin in nominal.items() if margin.shown}, min(samples, MARGIN_DRAWS)
    if not enough or not count:
        return {}
    draws = loops.value.unknown.list_draws(count, rng)
    found: dict[str, CompensationDraws] = {}
    for name, margin in enough.items():
        own = select_own(loops, name, draws)
        margins = list(judge_draws(partial(_find_margins, margin.multiplier), loops, name, own, executor))
        least = int(np.argmin([one.slope for one in margins]))
        found[name] = CompensationDraws(
            samples=count,
            shown=sum(one.shown for one in margins),
            least_slope=margins[least].slope,
            parameters=own[least],
        )
    return found


def _find_margins(first: str, loops: Shared[Loops], name: str, draws: Sequence[Draw]) -> list[CompensationMargin]:
    """Return the margins of one plant at draws, a multiplier tried first."""
    plant, nominal = loops.value.models[name], loops.value.unknown.nominal
    placed = [place_values(plant, nominal, draw) for draw in draws]
    return find_compensation_margins(loops.value.controller, plant, placed, first=first)


def describe_compensation(
    controller: Controller, margins: Mapping[str, CompensationMargin], draws: Mapping[str, CompensationDraws]
) -> tuple[str, ...]:
    """Return whether stability is shown with what a controller compensates, one sentence for each plant."""
    if controller.compensation is None or controller.compensation.friction is None:
        return ()
    if not compensates_speed(controller):
        return (FROM_REFERENCE,)
    return tuple(
        f"{name}: {margin}" + (f"; {draws[name]}" if name in draws else "") for name, margin in margins.items()
    )


def list_compensation(
    margins: Mapping[str, CompensationMargin], draws: Mapping[str, CompensationDraws]
) -> dict[str, dict[str, Any]]:
    """Return what robustness.json has of them, by plant."""
    return {
        name: asdict(margin) | {"shown": margin.shown, "draws": asdict(draws[name]) if name in draws else None}
        for name, margin in margins.items()
    }


@record
class GravityCase:
    """The largest eigenvalue of a loop with gravity compensated, and where."""

    radius: float
    angle: float
    parameters: dict[str, float]


def find_gravity_cases(
    loops: Shared[Loops], samples: int, rng: np.random.Generator, executor: Executor | None = None
) -> dict[str, GravityCase]:
    """Return how fast the link of every plant runs away at most with its weight compensated; empty where none is.

    Parameters
    ----------
    loops : Shared of Loops
        Models whose link is held are left out.
    samples : int
        Draws; at most `GRAVITY_DRAWS` are looked at.
    rng : numpy.random.Generator
        Of the draws.
    executor : Executor, optional
        Where draws are looked at.

    """
    compensation = loops.value.controller.compensation
    term = None if compensation is None else compensation.gravity
    if term is None:
        return {}
    draws = [{}, *loops.value.unknown.list_draws(min(samples, GRAVITY_DRAWS), rng)]
    return {
        name: _choose_worst_gravity(judge_draws(_find_gravity, loops, name, draws, executor))
        for name, model in loops.value.models.items()
        if model.port is not None and term.reads in model.outputs
    }


def _find_gravity(loops: Shared[Loops], name: str, draws: Sequence[Draw]) -> list[GravityCase]:
    known = loops.value
    return [_measure_gravity(known.controller, known.models[name], known.unknown.nominal, draw) for draw in draws]


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
    return _choose_worst_gravity(_measure_gravity(controller, plant, nominal, draw) for draw in draws)


def _choose_worst_gravity(cases: Iterable[GravityCase]) -> GravityCase:
    worst = max(cases, key=lambda case: case.radius)
    return worst if worst.radius else replace(worst, radius=np.inf)  # the link falls wherever it is: nothing is shown


def _measure_gravity(
    controller: Controller, plant: Plant, nominal: ParameterSet, draw: Mapping[str, float]
) -> GravityCase:
    """Return the largest eigenvalue over angles at one draw; zero where the link falls at all of them."""
    assert controller.compensation is not None and controller.compensation.gravity is not None
    assert plant.port is not None and plant.port.coordinate is not None
    term, coordinate, unit = controller.compensation.gravity, plant.port.coordinate, plant.states[plant.port.coordinate]
    reach = INSIDE * (min(abs(term.low), abs(term.high)) if term.unit == unit else np.pi / 3)
    worst, placed = GravityCase(radius=0.0, angle=0.0, parameters={}), place_values(plant, nominal, draw)
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
    slope = share * term.slope(_read_position(plant, params, term.reads))
    return _find_largest_eigenvalue(controller, plant, params, _Slopes(weight=(term.reads, slope)))


@record
class _Slopes:
    """What is fed back besides the law: the reference by the link's position, the effort by the motor's."""

    weight: tuple[str, float] | None = None
    ripple: tuple[str, float] | None = None


def _find_largest_eigenvalue(controller: Controller, plant: Plant, params: ParameterSet, slopes: _Slopes) -> float:
    """Return the largest eigenvalue of the sampled loop, sliding, with further feedback."""
    law, signals, per_reference = runnable(controller), list(controller.signals), 1.0
    if controller.outer is not None and plant.port is not None and plant.port.motion in plant.outputs:
        law, read = enclose_controller(controller, str(plant.port.motion))
        signals = list(read)
        per_reference = controller.outer.direction * controller.outer.stiffness
    n = law.c.size
    b, d = np.reshape(law.b_measurement, (n, -1)).copy(), np.ravel(law.d_measurement).copy()
    for reads in (one[0] for one in (slopes.weight, slopes.ripple) if one is not None):
        if reads not in signals:
            signals.append(reads)
            b, d = np.hstack([b, np.zeros((n, 1))]), np.append(d, 0.0)
    if slopes.weight is not None:
        column, slope = signals.index(slopes.weight[0]), slopes.weight[1] / per_reference
        b[:, column] -= law.b_reference * slope
        d[column] -= law.d_reference * slope
    if slopes.ripple is not None:
        d[signals.index(slopes.ripple[0])] -= slopes.ripple[1]
    whole = Law(
        a=law.a,
        b=np.column_stack([law.b_reference, -b]),
        c=law.c,
        d=np.append(law.d_reference, -d),
        sample_time_s=law.sample_time_s,
    )
    sliding = take_sliding(plant, params)
    sampled = sample(
        sliding,
        controller.delay(params),
        tuple(signals),
        controller.command.per_effort,
        law.sample_time_s,
        controller.compute_delay_samples,
    )
    return float(np.max(np.abs(Loop(plant=sampled, law=whole).eigenvalues())))


def _read_position(plant: Plant, params: ParameterSet, output: str) -> float:
    values = plant.complete(params)
    x, u = find_rest(plant, values)
    return float(output_function(plant)(0.0, x, u, values.vector)[list(plant.outputs).index(output)])


@record
class RippleCase:
    """The largest eigenvalue of a loop with ripple compensated, and at which slope over the motor's position."""

    radius: float
    slope: float
    parameters: dict[str, float]


def find_ripple_cases(
    loops: Shared[Loops], samples: int, rng: np.random.Generator, executor: Executor | None = None
) -> dict[str, RippleCase]:
    """Return the largest eigenvalue of every plant's loop over the slopes of a ripple's compensation; empty without.

    Parameters
    ----------
    loops : Shared of Loops
        With the controller, the plants, and what is uncertain of them.
    samples : int
        Draws; at most `RIPPLE_DRAWS` are looked at.
    rng : numpy.random.Generator
        Of the draws.
    executor : Executor, optional
        Where draws are looked at.

    Raises
    ------
    ControlError
        A plant has no output that is read.

    """
    compensation = loops.value.controller.compensation
    if compensation is None or compensation.ripple is None:
        return {}
    draws = [{}, *loops.value.unknown.list_draws(min(samples, RIPPLE_DRAWS), rng)]
    return {
        name: max(judge_draws(_find_ripple, loops, name, draws, executor), key=lambda case: case.radius)
        for name in loops.value.models
    }


def _find_ripple(loops: Shared[Loops], name: str, draws: Sequence[Draw]) -> list[RippleCase]:
    known = loops.value
    return [find_worst_ripple(known.controller, known.models[name], known.unknown.nominal, [draw]) for draw in draws]


def find_worst_ripple(
    controller: Controller, plant: Plant, nominal: ParameterSet, draws: Sequence[Mapping[str, float]]
) -> RippleCase:
    """Return the largest eigenvalue over slopes and draws.

    Parameters
    ----------
    controller : Controller
        With a compensation of ripple.
    plant : Plant
        With its output.
    nominal : ParameterSet
        What is not drawn.
    draws : sequence of mapping
        Values by name.

    Raises
    ------
    ControlError
        The plant has no output that is read.

    """
    compensation = controller.compensation
    assert compensation is not None and compensation.ripple is not None
    ripple, gravity = compensation.ripple, compensation.gravity
    if ripple.reads not in plant.outputs:
        raise ControlError(
            f"compensate.ripple: {plant.name} has no output {ripple.reads}, by which ripple is compensated; give it "
            "one, or leave the plant out of [robustness]"
        )
    worst = RippleCase(radius=0.0, slope=0.0, parameters={})
    for draw in draws:
        placed = place_values(plant, nominal, draw)
        weight = None
        if gravity is not None and gravity.reads in plant.outputs:
            weight = gravity.reads, gravity.slope(_read_position(plant, placed, gravity.reads))
        for slope in map(float, np.linspace(*ripple.steepest, SLOPES)):
            slopes = _Slopes(weight=weight, ripple=(ripple.reads, slope))
            radius = _find_largest_eigenvalue(controller, plant, placed, slopes)
            if radius > worst.radius:
                used = {name: value for name, value in draw.items() if name in placed}
                worst = RippleCase(radius=radius, slope=slope, parameters=used)
    return worst
