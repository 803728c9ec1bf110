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

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np

from seaopt.control import Controller
from seaopt.control.compensation.compensate import ENOUGH, find_compensation_margins
from seaopt.control.laws.outer_run import enclose
from seaopt.control.loops.compensation.stability import CompensationMargin
from seaopt.control.loops.sampled_plant import find_rest
from seaopt.control.systems.block import EFFORT, REFERENCE, add_up, name_readings
from seaopt.errors import ControlError
from seaopt.executors import Shared
from seaopt.formatting import format_percent
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.plants.plant import output_function
from seaopt.progress import Progress
from seaopt.records import record
from seaopt.robustness.certificate.cases import Cases, Check, CheckContext, Draw, Evidence
from seaopt.robustness.certificate.friction import MarginDraws, draw_margins
from seaopt.robustness.certificate.measured_draws import judge_draws
from seaopt.robustness.certificate.requirement import DrawnAt, Requirement, require_at_least, require_at_most
from seaopt.robustness.uncertainty.worst import place_values

FRICTION_COMPENSATION = "friction_compensation"
GRAVITY_COMPENSATION = "gravity_compensation"
RIPPLE_COMPENSATION = "ripple_compensation"
EIGENVALUE_DRAWS = 20  # at most so many are looked at, of gravity and of ripple
SLOPES = 9  # from the steepest negative to the steepest positive
PLACES, INSIDE = 9, 0.95  # over so much of the range
NEUTRAL = 1e-6  # beyond 1, of an eigenvalue that neither grows nor decays, by rounding and the series' last digits
WITHOUT_RIPPLE = (
    "margins, worst cases and draws are of the law without its compensation of ripple, with which stability alone is "
    "shown"
)
FROM_REFERENCE = "friction is compensated from the reference, outside the loop: its stability is the law's without it"


def measure_compensation(context: CheckContext, _: Progress) -> Evidence:
    """Return whether the loop stays stable with what is compensated, on every plant and over draws."""
    cases, controller = context.cases, context.cases.controller
    ripple = None if controller.compensation is None else controller.compensation.ripple
    opened = ripple is not None and any(ripple.reads in plant.outputs for plant in cases.models.values())
    margins = find_nominal_compensation(controller, cases.models, cases.unknown.nominal)
    shown = {name: partial(_find_margins, each.multiplier) for name, each in margins.items() if each.shown}
    draws = draw_margins(context, shown)
    gravity, ripple = find_gravity_cases(context), find_ripple_cases(context)
    return Evidence(
        requirements=(
            *compensation_requirements(controller, margins, draws),
            *eigenvalue_requirements(controller, cases.models, gravity, ripple),
        ),
        fields={"compensation": margins, "compensation_draws": draws},
        remarks=(WITHOUT_RIPPLE,) if opened else (),
        scope="drawn" if draws else "nominal",
    )


COMPENSATION = Check(
    measure=measure_compensation, applies=lambda context: context.cases.controller.compensation is not None
)


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


def _find_margins(first: str, cases: Shared[Cases], name: str, draws: Sequence[Draw]) -> list[CompensationMargin]:
    """Return the margins of one plant at draws, a multiplier tried first."""
    return find_compensation_margins(
        cases.value.controller, cases.value.models[name], cases.value.place(name, draws), first=first
    )


def describe_compensation(
    controller: Controller, margins: Mapping[str, CompensationMargin], draws: Mapping[str, MarginDraws]
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
    margins: Mapping[str, CompensationMargin], draws: Mapping[str, MarginDraws]
) -> dict[str, dict[str, Any]]:
    """Return what robustness.json has of them, by plant."""
    return {
        name: asdict(margin) | {"shown": margin.shown, "draws": asdict(draws[name]) if name in draws else None}
        for name, margin in margins.items()
    }


@record
class EigenvalueCase:
    """The largest eigenvalue of a loop with a term compensated, and at which draw.

    `at` is the angle of the link where gravity is compensated, the slope over the motor's position where ripple is.
    """

    radius: float
    at: float = 0.0
    parameters: dict[str, float]


Measure = Callable[[Controller, Plant, ParameterSet, Draw], EigenvalueCase]


def find_gravity_cases(context: CheckContext) -> dict[str, EigenvalueCase]:
    """Return how fast each plant's link runs away at most with its weight compensated; none of held links."""
    compensation, models = context.cases.controller.compensation, context.cases.models
    term = None if compensation is None else compensation.gravity
    moving = [name for name, model in models.items() if model.port is not None and term and term.reads in model.outputs]
    return _find_worst(measure_gravity, context, moving)


def find_ripple_cases(context: CheckContext) -> dict[str, EigenvalueCase]:
    """Return the largest eigenvalue of every plant's loop over the slopes of a ripple's compensation; empty without."""
    compensation = context.cases.controller.compensation
    ripples = compensation is not None and compensation.ripple is not None
    return _find_worst(measure_ripple, context, list(context.cases.models) if ripples else ())


def _find_worst(measure: Measure, context: CheckContext, names: Collection[str]) -> dict[str, EigenvalueCase]:
    """Return the worst case of some plants, among the nominal parameters and draws."""
    judges = dict.fromkeys(names, partial(_measure_draws, measure))
    made = judge_draws(context, EIGENVALUE_DRAWS, judges, nominal=[{}])
    return {name: choose_worst(case for _, case in pairs) for name, pairs in made.items()}


def _measure_draws(measure: Measure, cases: Shared[Cases], name: str, draws: Sequence[Draw]) -> list[EigenvalueCase]:
    at = cases.value
    return [measure(at.controller, at.models[name], at.unknown.nominal, draw) for draw in draws]


def choose_worst(cases: Iterable[EigenvalueCase]) -> EigenvalueCase:
    """Return the case with the largest eigenvalue; infinite where the link falls by itself in all of them."""
    worst = max(cases, key=lambda case: case.radius)
    return worst if worst.radius else replace(worst, radius=np.inf)


def measure_gravity(controller: Controller, plant: Plant, nominal: ParameterSet, draw: Draw) -> EigenvalueCase:
    """Return the largest eigenvalue over angles at one draw; zero where the link falls at all of them."""
    assert controller.compensation is not None and controller.compensation.gravity is not None
    assert plant.port is not None and plant.port.coordinate is not None
    term, coordinate, unit = controller.compensation.gravity, plant.port.coordinate, plant.states[plant.port.coordinate]
    reach = INSIDE * (min(abs(term.low), abs(term.high)) if term.unit == unit else np.pi / 3)
    placed, cases = place_values(plant, nominal, draw), list[tuple[float, float]]()
    for angle in map(float, np.linspace(-reach, reach, PLACES)):
        at = placed.with_parameters(Parameter(name=coordinate, value=angle, unit=unit))
        if find_radius(controller, plant, at) > 1.0 + NEUTRAL:
            continue  # a link that stands on its head falls by itself
        weight = term.reads, term.slope(_read_position(plant, at, term.reads))
        cases.append((find_radius(controller, plant, at, weight=weight), angle))
    return _make_case(cases, placed, draw)


def measure_ripple(controller: Controller, plant: Plant, nominal: ParameterSet, draw: Draw) -> EigenvalueCase:
    """Return the largest eigenvalue over the slopes at a draw. Raises ControlError: the plant lacks the output."""
    compensation = controller.compensation
    assert compensation is not None and compensation.ripple is not None
    ripple, gravity = compensation.ripple, compensation.gravity
    if ripple.reads not in plant.outputs:
        raise ControlError(
            f"compensate.ripple: {plant.name} has no output {ripple.reads}, by which ripple is compensated; give it "
            "one, or leave the plant out of [robustness]"
        )
    placed, weight = place_values(plant, nominal, draw), None
    if gravity is not None and gravity.reads in plant.outputs:
        weight = gravity.reads, gravity.slope(_read_position(plant, placed, gravity.reads))
    slopes = map(float, np.linspace(*ripple.steepest, SLOPES))
    cases = [(find_radius(controller, plant, placed, weight, (ripple.reads, slope)), slope) for slope in slopes]
    return _make_case(cases, placed, draw)


def _make_case(cases: Sequence[tuple[float, float]], placed: ParameterSet, draw: Draw) -> EigenvalueCase:
    """Return the first of the largest of some eigenvalues, each with where it is."""
    if not cases:
        return EigenvalueCase(radius=0.0, parameters={})
    radius, at = max(cases, key=lambda case: case[0])
    used = {name: value for name, value in draw.items() if name in placed}
    return EigenvalueCase(radius=radius, at=at, parameters=used)


def find_radius(
    controller: Controller,
    plant: Plant,
    params: ParameterSet,
    weight: tuple[str, float] | None = None,
    ripple: tuple[str, float] | None = None,
) -> float:
    """Return the largest eigenvalue of the sampled loop, sliding, with further feedback. `weight` feeds the reference
    by the link's position, `ripple` the effort by the motor's: each an output and a slope.
    """
    enclosed = enclose(controller, plant, of_force=True)
    fed = {output: way for output, way in ((REFERENCE, weight), (EFFORT, ripple)) if way is not None}
    signals = tuple(dict.fromkeys((*enclosed.signals, *(reads for reads, _ in fed.values()))))
    names = dict(zip(signals, name_readings(len(signals)), strict=True))
    further = [add_up(output, {names[reads]: slope}) for output, (reads, slope) in fed.items()]
    law = enclosed.law.connected(further, [REFERENCE, *names.values()])
    loop = replace(enclosed, law=law, reads=signals).close(plant, params)
    return float(np.max(np.abs(loop.eigenvalues())))


def _read_position(plant: Plant, params: ParameterSet, output: str) -> float:
    values = plant.complete(params)
    x, u = find_rest(plant, values)
    return float(output_function(plant)(0.0, x, u, values.vector)[list(plant.outputs).index(output)])


def compensation_requirements(
    controller: Controller, margins: Mapping[str, CompensationMargin], draws: Mapping[str, MarginDraws]
) -> list[Requirement]:
    """Return that stability is shown with friction compensated from the speed, at nominal values and over draws. Where
    it is, or is not, says the largest fraction of Coulomb friction that is shown at the compensation's speed.
    """
    friction = None if controller.compensation is None else controller.compensation.friction
    rows: list[Requirement] = []
    for name, margin in margins.items():
        drawn, value, draw = draws.get(name), margin.slope, None
        reasons = [
            f"{margin.multiplier}; {margin.shift} at {margin.frequency_hz:.4g} Hz" if value else margin.multiplier
        ]
        if drawn is not None and drawn.least_slope < value:
            value, draw, reasons = drawn.least_slope, DrawnAt(parameters=drawn.parameters), []
        if friction is not None and value:
            reasons.append(f"shown up to {value / margin.required * friction.fraction:.3g} of the friction")
        rows.append(
            require_at_least(
                FRICTION_COMPENSATION,
                value,
                margin.required,
                unit=controller.command.mechanics.damping,
                plant=name,
                draw=draw,
                text="; ".join(reasons),
            )
        )
    return rows


def eigenvalue_requirements(
    controller: Controller,
    models: Mapping[str, Plant],
    gravity: Mapping[str, EigenvalueCase],
    ripple: Mapping[str, EigenvalueCase],
) -> list[Requirement]:
    """Return that neither a weight nor a ripple compensated makes a loop grow, at nominal values and over draws."""
    terms, cases = controller.compensation, list[tuple[str, str, EigenvalueCase, str]]()
    if terms is not None and terms.gravity is not None:
        compensated = f"with {format_percent(terms.gravity.fraction)} of the weight compensated"
        for name, case in gravity.items():
            port = models[name].port
            unit = "" if port is None else models[name].states[str(port.coordinate)]
            cases.append((GRAVITY_COMPENSATION, name, case, f"{compensated}, at {case.at:.3g} {unit}".rstrip()))
    if terms is not None and terms.ripple is not None:
        unit = f"{controller.command.effort_unit}/{terms.ripple.unit}"
        cases += [
            (RIPPLE_COMPENSATION, name, case, f"over the slopes, at {case.at:.3g} {unit}")
            for name, case in ripple.items()
        ]
    return [
        require_at_most(
            requirement,
            case.radius,
            1.0 + NEUTRAL,
            plant=plant,
            draw=DrawnAt(parameters=case.parameters),
            text=f"the largest eigenvalue, {text}",
        )
        for requirement, plant, case, text in cases
    ]
