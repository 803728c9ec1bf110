"""The requirements of a certificate, for `certify`: limits on figures, on draws, on worst cases."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from seaopt.control import Controller, LoopFigures
from seaopt.control.laws.limits import LIMIT_ROUNDING, MeasuredLoop, PortFigures
from seaopt.control.laws.passivity import measure_port
from seaopt.control.laws.verdict import Verdict, judge
from seaopt.control.loops.absolute_stability import FrictionMargin
from seaopt.control.loops.compensation.stability import CompensationMargin
from seaopt.control.loops.measured.loop import DiscLoop
from seaopt.control.loops.port import port_of
from seaopt.formatting import format_values
from seaopt.frequency import MeasuredResponse
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.robustness.certificate.certificate import KEPT_TO, MIN_FRICTION_MARGIN, Requirement
from seaopt.robustness.certificate.compensation import (
    FRICTION_COMPENSATION,
    GRAVITY_COMPENSATION,
    NEUTRAL,
    RIPPLE_COMPENSATION,
    CompensationDraws,
    GravityCase,
    RippleCase,
)
from seaopt.robustness.certificate.friction import FrictionDraws
from seaopt.robustness.certificate.impedance import CertifiedImpedance
from seaopt.robustness.uncertainty.failure_probability import MonteCarlo
from seaopt.robustness.uncertainty.severity import UNSTABLE
from seaopt.robustness.uncertainty.worst import Worst
from seaopt.robustness.verification.impedance_steps import AT_REST

NO_FRICTION = "no friction: any margin holds"
WITNESS_REMEDY = "; tune with that plant in robust_to, a larger reserve or a lower bandwidth"


def design_requirements(controller: Controller, states: Mapping[str, Plant], values: ParameterSet) -> list[Requirement]:
    """Return what is required of the design plant at the nominal parameters `values`.

    Of two `states` the first is the plant sliding, the second the plant stuck.
    """
    figures = {name: controller.close(plant, values).figures() for name, plant in states.items()}
    (name, achieved), *stuck = figures.items()
    spec, band = controller.spec, controller.spec.passive_band_hz
    port = None
    if band is not None and controller.design is not None:
        held = port_of(states[name], controller.delay(values), controller.signals, controller.command.per_effort)
        port = measure_port(held, controller.law, controller.sample_time_s, controller.compute_delay_samples, band)
    verdicts = judge(spec, controller.measure(name, achieved, port), "design plant")
    for other, loop in stuck:
        verdicts += judge(spec, MeasuredLoop(name=other, figures=loop), "design plant", stuck=True)
    return [_make_requirement(verdict, _place_passive(verdict, port, band)) for verdict in verdicts]


def plant_requirements(controller: Controller, name: str, figures: LoopFigures) -> list[Requirement]:
    """Return what is required of every plant at the nominal parameters, but for friction margins."""
    spec = replace(controller.spec, min_friction_margin=None)
    verdicts = judge(spec, MeasuredLoop(name=name, figures=figures), "every plant")
    return [
        _make_requirement(verdict, "" if figures.stable or verdict.limit.has_field else ": the loop is UNSTABLE")
        for verdict in verdicts
    ]


def measured_requirements(controller: Controller, name: str, measured: MeasuredResponse) -> list[Requirement]:
    """Return what is required on a measured response: the limits of every plant, of every response in the discs."""
    return plant_requirements(controller, *_measure_discs(controller, name, measured))


def measured_design_requirements(controller: Controller, name: str, measured: MeasuredResponse) -> list[Requirement]:
    """Return what is required on the measured response that a controller was designed on, of the design plant alone."""
    on, figures = _measure_discs(controller, name, measured)
    return [
        _make_requirement(verdict, "")
        for verdict in judge(controller.spec, controller.measure(on, figures), "design plant")
    ]


def _measure_discs(controller: Controller, name: str, measured: MeasuredResponse) -> tuple[str, LoopFigures]:
    plant = controller.spec.see_response(measured, controller.command)
    figures = DiscLoop(plant=plant, law=controller.law).figures(controller.spec.bandwidth_hz)
    return f"{name} (on measured points, at {100 * measured.confidence:.4g} %)", figures


def _make_requirement(verdict: Verdict, remark: str) -> Requirement:
    limit = verdict.limit
    return Requirement(
        name=limit.requirement or limit.name, limit=verdict.allowed, value=verdict.value, met=verdict.met,
        where=f"{verdict.plant}{remark}", sense=limit.symbol, tolerance=max(limit.tolerance, KEPT_TO),
    )  # fmt: skip


def _place_passive(verdict: Verdict, port: PortFigures | None, band: tuple[float, float] | None) -> str:
    """Return where in the passive band its port is least passive, and what to do where it is not."""
    if verdict.limit.name != "passive_band_hz" or port is None or band is None:
        return ""
    where = f", Re Z/|Z| at {port.at_hz:.4g} Hz, of {band[0]:g} to {band[1]:g} Hz"
    if verdict.met:
        return where
    return where + (f"; {verdict.limit.remedy}" if port.held_stable else "; the loop grows with its link held")


def draw_requirements(
    result: MonteCarlo, worst: Mapping[str, Worst], max_failure_probability: float | None = None
) -> list[Requirement]:
    """Return what the draws require; where none fails, that the worst case found by search does not either."""
    bound = _require_bound(result, max_failure_probability)
    if not result.samples:
        return bound
    name = max(worst, key=lambda key: worst[key].severity)
    case = worst[name]
    where = format_values(case.parameters, missing="")
    size = f"has Ms {case.witness.ms:.4g}, Mt {case.witness.mt:.4g}" if case.severity < UNSTABLE else "is UNSTABLE"
    witness = f"{name}: worst case {size}" + (f" at {where}" if where else "")
    rows = [
        Requirement(
            name="monte_carlo_failures", limit=0.0, value=float(result.failures), met=result.failures == 0,
            where=witness + (WITNESS_REMEDY if result.failures else ""),
        )
    ]  # fmt: skip
    if not result.failures:
        rows += [row for key, case in worst.items() for row in _require_worst(key, case)]
    return rows + bound


def friction_requirements(
    margins: Mapping[str, FrictionMargin], draws: Mapping[str, FrictionDraws], least: float | None
) -> list[Requirement]:
    """Return that stability is shown for friction as steep as asked, at the nominal values and over draws.

    Without friction there is nothing to show: the row says so, with an infinite value.
    """
    if least is None:
        return []
    if not margins and not draws:
        return [Requirement(name=MIN_FRICTION_MARGIN, limit=least, value=np.inf, met=True, where=NO_FRICTION)]
    rows: list[Requirement] = []
    for name in dict.fromkeys((*margins, *draws)):
        margin, drawn = margins.get(name), draws.get(name)
        if margin is None:
            value, where = np.inf, f"{name}: {NO_FRICTION}"
        else:
            value, where = margin.least_slope, f"{name}: {margin.multiplier} at {margin.frequency_hz:.4g} Hz"
        if drawn is not None and drawn.least_slope < value:
            value, where = drawn.least_slope, f"{name} at {format_values(drawn.parameters)}"
        met = bool(value >= least * (1.0 - LIMIT_ROUNDING))
        rows.append(Requirement(name=MIN_FRICTION_MARGIN, limit=least, value=value, met=met, where=where))
    return rows


def compensation_requirements(
    controller: Controller, margins: Mapping[str, CompensationMargin], draws: Mapping[str, CompensationDraws]
) -> list[Requirement]:
    """Return that stability is shown with friction compensated from the speed, at nominal values and over draws.

    Where it is, or is not, says the largest fraction of Coulomb friction that is shown at the compensation's speed.
    """
    rows: list[Requirement] = []
    for name, margin in margins.items():
        value, where = margin.slope, f"{name}: {margin.multiplier}"
        where += f" at {margin.frequency_hz:.4g} Hz" if margin.slope else ""
        drawn = draws.get(name)
        if drawn is not None and drawn.least_slope < value:
            value, where = drawn.least_slope, f"{name} at {format_values(drawn.parameters)}"
        met = bool(value >= margin.asked * (1.0 - LIMIT_ROUNDING))
        if controller.compensation is not None and controller.compensation.friction is not None and value:
            where += (
                f"; shown up to {value / margin.asked * controller.compensation.friction.fraction:.3g} of the friction"
            )
        rows.append(Requirement(name=FRICTION_COMPENSATION, limit=margin.asked, value=value, met=met, where=where))
    return rows


def eigenvalue_requirements(
    controller: Controller, models: Mapping[str, Plant], gravity: Mapping[str, GravityCase],
    ripple: Mapping[str, RippleCase],
) -> list[Requirement]:  # fmt: skip
    """Return that neither a weight nor a ripple compensated makes a loop grow, at nominal values and over draws."""
    terms = controller.compensation
    found: list[tuple[str, str, GravityCase | RippleCase, str, str]] = []
    if terms is not None and terms.gravity is not None:
        looked = f"with {100.0 * terms.gravity.fraction:.3g} % of the weight compensated"
        for name, case in gravity.items():
            port = models[name].port
            unit = "" if port is None else models[name].states[str(port.coordinate)]
            found.append((GRAVITY_COMPENSATION, name, case, f"{case.angle:.3g} {unit}", looked))
    if terms is not None and terms.ripple is not None:
        unit = f"{controller.command.effort_unit}/{terms.ripple.unit}"
        for name, case in ripple.items():
            found.append((RIPPLE_COMPENSATION, name, case, f"{case.slope:.3g} {unit}", "over the slopes"))
    limit = 1.0 + NEUTRAL
    return [
        Requirement(
            name=requirement, limit=limit, value=case.radius, met=case.radius <= limit,
            where=f"{name} at {at}{f' and {format_values(case.parameters)}' if case.parameters else ''}: the largest "
            f"eigenvalue {looked}",
        )
        for requirement, name, case, at, looked in found
    ]  # fmt: skip


def impedance_requirements(impedance: CertifiedImpedance | None) -> list[Requirement]:
    """Return what is required of an impedance: the link is stable by itself, and no environment changes that.

    Both hold with friction sliding and stuck, and at the draws, and simulated steps come to rest.
    """
    if impedance is None:
        return []
    called, unit = impedance.rendering.called, impedance.rendering.outer.place_unit
    link = f"{impedance.plant}: link"
    rows: list[Requirement] = []
    for state, rendered in (("", impedance.rendering), (", friction stuck", impedance.stuck)):
        if rendered is None:
            continue
        breaking = "" if rendered.breaking is None else f"; {rendered.breaking.describe(called)}"
        rows += [
            Requirement(
                name="impedance_stable", limit=1.0, value=rendered.spectral_radius, met=rendered.stable,
                where=f"{link} with nothing on it{state}",
            ),
            Requirement(
                name="impedance_damper", limit=rendered.link_damping, value=rendered.needed_damper,
                met=rendered.passive,
                where=f"{link}, {called.damping} that make it passive, and its own{state}{breaking}",
            ),
        ]  # fmt: skip
    if impedance.draws is not None:
        drawn = impedance.draws
        failed = drawn.samples - min(drawn.stable, drawn.passive)
        rows.append(
            Requirement(
                name="impedance_draws", limit=0.0, value=float(failed), met=not failed,
                where=f"{link}: {drawn}",
            )
        )  # fmt: skip
    for step in impedance.steps:
        rows.append(
            Requirement(
                name="impedance_rest", limit=AT_REST, value=step.moving, met=step.rests,
                where=f"{link}: {step.describe(unit)}",
            )
        )  # fmt: skip
    return rows


def _require_bound(result: MonteCarlo, limit: float | None) -> list[Requirement]:
    """Return that the stated failure probability is low enough, where that is asked for."""
    if limit is None:
        return []
    value = result.failure_probability_bound if result.samples else 1.0
    fewest = int(np.ceil(np.log(1.0 - result.confidence) / np.log1p(-limit))) if limit < 1.0 else 1
    where = f"{result.failures} failures in {result.samples} draws"
    if not result.samples:
        where = "nothing is uncertain, so that nothing was drawn; give a fit, prior_std or ranges"
    elif value > limit:
        where += f"; {fewest} draws without a failure would do"
    return [
        Requirement(name="max_failure_probability", limit=limit, value=value, met=bool(value <= limit), where=where)
    ]


def _require_worst(name: str, case: Worst) -> list[Requirement]:
    """Return how much of the limits the worst case uses: 1 is all of it."""
    if not case.limited and case.severity < UNSTABLE:
        return []
    where = format_values(case.parameters, missing="")
    met = case.severity <= 1.0 + LIMIT_ROUNDING
    used = case.severity if case.severity < UNSTABLE else np.inf
    return [
        Requirement(
            name="worst_case",
            limit=1.0,
            value=used,
            met=met,
            where=f"{name}{'' if case.severity < UNSTABLE else ', UNSTABLE,'} at {where}"
            + ("" if met else WITNESS_REMEDY),
        )
    ]
