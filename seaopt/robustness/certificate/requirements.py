"""The requirements of a certificate, for `certify`: limits on figures, on draws, on worst cases."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from seaopt.control import Controller, LoopFigures, ScheduledController
from seaopt.control.laws.limits import BY_NAME, MeasuredLoop, PortFigures, Scope
from seaopt.control.laws.passivity import measure_port
from seaopt.control.laws.verdict import judge
from seaopt.control.loops.absolute_stability import FrictionMargin
from seaopt.control.loops.compensation.stability import CompensationMargin
from seaopt.control.loops.measured.loop import DiscLoop
from seaopt.control.loops.port import port_of
from seaopt.frequency import MeasuredResponse
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import friction_states, has_friction
from seaopt.robustness.certificate.compensation import (
    FRICTION_COMPENSATION,
    GRAVITY_COMPENSATION,
    NEUTRAL,
    RIPPLE_COMPENSATION,
    CompensationDraws,
    EigenvalueCase,
)
from seaopt.robustness.certificate.friction import FrictionDraws
from seaopt.robustness.certificate.impedance import CertifiedImpedance
from seaopt.robustness.certificate.requirement import (
    DESIGN_PLANT,
    KEPT_TO,
    MIN_FRICTION_MARGIN,
    SPECTRAL_RADIUS,
    DrawnAt,
    Requirement,
    Spot,
    require_at_least,
    require_at_most,
)
from seaopt.robustness.uncertainty.failure_probability import MonteCarlo
from seaopt.robustness.uncertainty.severity import UNSTABLE
from seaopt.robustness.uncertainty.worst import Worst
from seaopt.robustness.verification.impedance_steps import AT_REST
from seaopt.robustness.verification.schedule_motion import Motion, describe_motion
from seaopt.robustness.verification.schedule_sweep import Sweep, find_fastest

NO_FRICTION = "no friction: any margin holds"
WITNESS_REMEDY = "tune with that plant in robust_to, a larger reserve or a lower bandwidth"
PASSIVE = "passive_band_hz"
UNSTABLE_LOOP = "the loop is UNSTABLE"
MOTION_RATE = "min_motion_rate"


def design_requirements(
    controller: Controller, plant: Plant, values: ParameterSet, varied: Collection[str] = ()
) -> list[Requirement]:
    """Return what is required of the design plant at the nominal `values`; of one that is stuck only some limits."""
    states = friction_states(plant) if has_friction(plant, values, varied) else {"": plant}
    figures = {state: controller.close(variant, values).figures() for state, variant in states.items()}
    (state, achieved), *stuck = figures.items()
    band, port = controller.spec.passive_band_hz, None
    if band is not None and controller.design is not None:
        held = port_of(states[state], controller.delay(values), controller.signals, controller.command.per_effort)
        port = measure_port(held, controller.law, controller.compute_delay_samples, band)
    rows = _judge(controller, controller.measure("", achieved, port), "design plant", Spot(DESIGN_PLANT, state))
    for other, loop in stuck:
        measured = controller.measure("", loop)
        rows += _judge(controller, measured, "design plant", Spot(DESIGN_PLANT, other), stuck=True)
    if band is None or port is None:
        return rows
    return [_place_passive(row, port, band) if row.name == PASSIVE else row for row in rows]


def plant_requirements(controller: Controller, spot: Spot, figures: LoopFigures) -> list[Requirement]:
    """Return what is required of every plant at the nominal parameters, but for friction margins."""
    return [
        replace(row, text="" if figures.stable or row.name != SPECTRAL_RADIUS else UNSTABLE_LOOP)
        for row in _judge(controller, controller.measure("", figures), "every plant", spot)
        if row.name != MIN_FRICTION_MARGIN
    ]


def measured_requirements(
    controller: Controller, name: str, measured: MeasuredResponse, scope: Scope = "every plant"
) -> list[Requirement]:
    """Return the limits of a scope on a measured response, of every response in the discs."""
    plant = controller.spec.see_response(measured, controller.command)
    figures = DiscLoop(plant=plant, law=controller.law).figures(controller.spec.bandwidth_hz)
    on = f"on measured points, at {100 * measured.confidence:.4g} %"
    if scope == "every plant":
        rows = plant_requirements(controller, Spot(name), figures)
    else:
        rows = _judge(controller, controller.measure(name, figures), scope, Spot(name))
    return [replace(row, text=f"{on}; {row.text}" if row.text else on) for row in rows]


def _judge(
    controller: Controller, loop: MeasuredLoop, scope: Scope, spot: Spot, *, stuck: bool = False
) -> list[Requirement]:
    return [
        Requirement(
            name=verdict.limit.requirement or verdict.limit.name,
            limit=verdict.allowed,
            value=verdict.value,
            met=verdict.met,
            sense=verdict.limit.symbol,
            tolerance=max(verdict.limit.tolerance, KEPT_TO),
            unit=loop.unit(verdict.limit),
            **spot._asdict(),
        )
        for verdict in judge(controller.spec, loop, scope, stuck=stuck)
    ]


def _place_passive(row: Requirement, port: PortFigures, band: tuple[float, float]) -> Requirement:
    """Return the row with where in the passive band the port is least passive, and what to do where it is not."""
    text = f"Re Z/|Z| at {port.at_hz:.4g} Hz, of {band[0]:g} to {band[1]:g} Hz"
    if row.met:
        return replace(row, text=text)
    remedy = BY_NAME[PASSIVE].remedy if port.held_stable else "the loop grows with its link held"
    return replace(row, text=text, remedy=remedy)


def draw_requirements(
    result: MonteCarlo, worst: Mapping[Spot, Worst], max_failure_probability: float | None = None
) -> list[Requirement]:
    """Return what the draws require; where none fails, that the worst case found by search does not either."""
    bound = _require_bound(result, max_failure_probability)
    if not result.samples:
        return bound
    spot, case = max(worst.items(), key=lambda found: found[1].severity)
    size = f"has Ms {case.witness.ms:.4g}, Mt {case.witness.mt:.4g}" if case.severity < UNSTABLE else "is UNSTABLE"
    rows = [
        require_at_most(
            "monte_carlo_failures",
            float(result.failures),
            0.0,
            draw=DrawnAt(parameters=case.parameters),
            text=f"the worst case {size}",
            remedy=WITNESS_REMEDY if result.failures else "",
            **spot._asdict(),
        )
    ]
    if not result.failures:
        rows += [_require_worst(key, case) for key, case in worst.items() if case.limited or case.severity >= UNSTABLE]
    return rows + bound


def friction_requirements(
    margins: Mapping[str, FrictionMargin], draws: Mapping[str, FrictionDraws], least: float | None, unit: str
) -> list[Requirement]:
    """Return that stability is shown for friction as steep as asked, nominal and drawn; infinite without friction."""
    if least is None:
        return []

    require = partial(require_at_least, MIN_FRICTION_MARGIN, limit=least, unit=unit)
    rows: list[Requirement] = []
    for name in dict.fromkeys((*margins, *draws)):
        margin, drawn = margins.get(name), draws.get(name)
        nominal = np.inf if margin is None else margin.least_slope
        if drawn is not None and drawn.least_slope < nominal:
            rows.append(require(value=drawn.least_slope, plant=name, draw=DrawnAt(parameters=drawn.parameters)))
        else:
            text = NO_FRICTION if margin is None else f"{margin.multiplier} at {margin.frequency_hz:.4g} Hz"
            rows.append(require(value=nominal, plant=name, text=text))
    return rows or [require(value=np.inf, text=NO_FRICTION)]


def compensation_requirements(
    controller: Controller, margins: Mapping[str, CompensationMargin], draws: Mapping[str, CompensationDraws]
) -> list[Requirement]:
    """Return that stability is shown with friction compensated from the speed, at nominal values and over draws. Where
    it is, or is not, says the largest fraction of Coulomb friction that is shown at the compensation's speed.
    """
    friction = None if controller.compensation is None else controller.compensation.friction
    rows: list[Requirement] = []
    for name, margin in margins.items():
        drawn, value, draw = draws.get(name), margin.slope, None
        said = [f"{margin.multiplier}; {margin.shift} at {margin.frequency_hz:.4g} Hz" if value else margin.multiplier]
        if drawn is not None and drawn.least_slope < value:
            value, draw, said = drawn.least_slope, DrawnAt(parameters=drawn.parameters), []
        if friction is not None and value:
            said.append(f"shown up to {value / margin.asked * friction.fraction:.3g} of the friction")
        rows.append(
            require_at_least(
                FRICTION_COMPENSATION,
                value,
                margin.asked,
                unit=controller.command.mechanics.damping,
                plant=name,
                draw=draw,
                text="; ".join(said),
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
        compensated = f"with {100.0 * terms.gravity.fraction:.3g} % of the weight compensated"
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


def impedance_requirements(impedance: CertifiedImpedance | None) -> list[Requirement]:
    """Return what is required of an impedance, friction sliding and stuck: a stable link in any environment."""
    if impedance is None:
        return []
    called, unit, plant = impedance.rendering.called, impedance.rendering.outer.place_unit, impedance.plant
    rows: list[Requirement] = []
    for state, rendered in (("", impedance.rendering), ("stuck", impedance.stuck)):
        if rendered is None:
            continue
        breaking = "" if rendered.breaking is None else f"; {rendered.breaking.describe(called)}"
        rows += [
            Requirement(
                name="impedance_stable",
                limit=1.0,
                value=rendered.spectral_radius,
                met=rendered.stable,
                plant=plant,
                state=state,
                text="the link with nothing on it",
            ),
            Requirement(
                name="impedance_damper",
                limit=rendered.link_damping,
                value=rendered.needed_damper,
                met=rendered.passive,
                unit=called.damping,
                plant=plant,
                state=state,
                text=f"{called.damping} at the link that make it passive, and its own{breaking}",
            ),
        ]
    drawn = impedance.draws
    if drawn is not None:
        rows.append(
            require_at_most(
                "impedance_draws",
                float(drawn.samples - min(drawn.stable, drawn.passive)),
                0.0,
                plant=plant,
                draw=DrawnAt(parameters=drawn.parameters),
                text=f"stable in {drawn.stable} of {drawn.samples} draws and passive in {drawn.passive}",
            )
        )
    return rows + [
        require_at_most(
            "impedance_rest",
            step.moving,
            AT_REST,
            plant=plant,
            scenario=f"step of x_0 by {step.size:.3g} {unit}",
            text=step.describe(unit),
        )
        for step in impedance.steps
    ]


def _require_bound(result: MonteCarlo, limit: float | None) -> list[Requirement]:
    """Return that the stated failure probability is low enough, where that is asked for."""
    if limit is None:
        return []
    value = result.failure_probability_bound if result.samples else 1.0
    fewest = int(np.ceil(np.log(1.0 - result.confidence) / np.log1p(-limit))) if limit < 1.0 else 1
    text, remedy = f"{result.failures} failures in {result.samples} draws", ""
    if not result.samples:
        text, remedy = "nothing is uncertain, so that nothing was drawn", "give a fit, prior_std or ranges"
    elif value > limit:
        remedy = f"{fewest} draws without a failure would do"
    return [require_at_most("max_failure_probability", value, limit, text=text, remedy=remedy)]


def _require_worst(spot: Spot, case: Worst) -> Requirement:
    """Return how much of the limits the worst case uses: 1 is all of it."""
    unstable = case.severity >= UNSTABLE
    row = require_at_most(
        "worst_case",
        np.inf if unstable else case.severity,
        1.0,
        draw=DrawnAt(parameters=case.parameters),
        text=UNSTABLE_LOOP if unstable else "",
        **spot._asdict(),
    )
    return row if row.met else replace(row, remedy=WITNESS_REMEDY)


def require_limits_between(schedule: ScheduledController) -> list[Requirement]:
    """Return that the design plant's limits hold between the points, 0.9 of the bandwidth asked among them."""
    return [
        require_at_most(
            "limits_between_points",
            float(len(place.broken)),
            0.0,
            place=(schedule.over, place.value),
            text=", ".join(place.broken),
            remedy=schedule.remedy if place.broken else "",
        )
        for place in schedule.between
    ]


def require_rate(sweeps: Sequence[Sweep], unit: str, least: float | None) -> Requirement:
    """Return that a plant's sweeps keep their judgement: the slowest at all, and as fast as asked."""
    faults = [sweep.fault for sweep in sweeps if sweep.fault]
    return require_at_least(
        "min_schedule_rate",
        find_fastest(sweeps),
        sweeps[0].rate if least is None else least,
        unit=unit,
        plant=sweeps[0].plant,
        scenario="sweep",
        text=faults[0] if faults else f"the fastest tried is {sweeps[-1].rate:.3g} {unit}",
    )


def require_motion(motion: Motion, over: str, unit: str, least: float | None) -> Requirement:
    """Return that a plant that moves the variable keeps its judgement: at the rate reached at all, or as asked. What
    keeps its judgement at less than was asked is not met: nothing is known of the rate that was.
    """
    row = require_at_least(
        MOTION_RATE,
        0.0 if motion.fault else motion.rate,
        motion.rate if least is None else least,
        unit=unit,
        plant=motion.plant,
        text=describe_motion(motion, over, unit),
    )
    if motion.fault or row.met:
        return replace(row, met=not motion.fault)
    return replace(row, remedy="ask a smaller min_rate, or give the command a higher limit")
