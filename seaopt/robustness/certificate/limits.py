"""Limits of a law's figures: on the design plant, on every plant at the nominal parameters, on measured points and on
the logs of the fit.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace

import numpy as np

from seaopt.control import Controller, LoopFigures
from seaopt.control.laws.delay import warn_delays
from seaopt.control.laws.limits import BY_NAME, MeasuredLoop, PortFigures, Scope
from seaopt.control.laws.passivity import measure_port
from seaopt.control.laws.verdict import judge
from seaopt.control.loops.measured.loop import DiscLoop, measure_discs
from seaopt.control.loops.port import port_of
from seaopt.control.loops.sampled_plant import DRIVE_DELAY
from seaopt.control.running.fed_back import close_whole, feeds_back
from seaopt.control.scheduling.tuning import find_response_place
from seaopt.errors import ControlError
from seaopt.estimation import Experiment, Fit
from seaopt.formatting import format_band, format_percent
from seaopt.frequency import MeasuredResponse
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import friction_states, has_friction
from seaopt.progress import Progress
from seaopt.robustness.certificate.cases import Cases, Check, CheckContext, Evidence
from seaopt.robustness.certificate.requirement import (
    DESIGN_PLANT,
    KEPT_TO,
    LOG_AGREEMENT,
    LOG_SENSITIVITY,
    MIN_FRICTION_MARGIN,
    SPECTRAL_RADIUS,
    UNSTABLE_LOOP,
    Requirement,
    Spot,
    require_at_most,
)
from seaopt.robustness.uncertainty.agreement import Agreement
from seaopt.robustness.uncertainty.logs import CONTRADICT, GRACE, LogVerdict, judge_log
from seaopt.robustness.uncertainty.plant_margins import plant_margins
from seaopt.robustness.verification.large_signal import SLOWEST_STUCK, predict_bandwidths
from seaopt.robustness.verification.scenarios import STEP_SHARES

PASSIVE = "passive_band_hz"
ANY_MS = 1e6  # of a law that no sensitivity is asked of: what is above is unstable
WITH_TERMS = (
    "margins, worst cases and draws of every plant are of the loop with the outer loop around it, with what is "
    "compensated of its weight and, where it sticks, with friction's compensation from the speed; what is asked of the "
    "design plant alone is of the law as tuned"
)
WHERE_IT_SLIDES = (
    "of the law where friction slides, as it did in the log, and its compensation from the speed is at its full size; "
    "at rest both are steepest, which models show"
)
NO_LOG = "no log of the fit is of a plant that is certified, so that none judges the law"
SILENT = {
    "lacks a signal": "log {0.experiment} does not judge the law: it has no {0.detail}",
    "looks like feedback": "log {0.experiment} looks like feedback: its input answers its noise, and it judges no law; "
    "if it was taken under one, write feedback = true",
    "taken under feedback": "log {0.experiment} was taken under feedback: its input carries its noise, and it judges "
    "no law",
    "too weak": "log {0.experiment} says nothing of this loop: it is too short, or too weak",
    "an error": "log {0.experiment} does not judge the law: {0.detail}",
}
LOG_SECONDS = 0.02  # that the logs of a fit take as a rule
AMPLITUDES = 9  # looked at for the remark on bandwidth


def measure_nominal(context: CheckContext, _: Progress) -> Evidence:
    """Judge every loop at the nominal parameters; the design plant by its own limits too, where the law was tuned."""
    cases, controller, nominal = context.cases, context.cases.controller, context.cases.unknown.nominal
    assert controller.design is not None
    design, values = controller.design
    of_design = values.with_parameters(
        *(nominal[name] for name in nominal if name in {*design.parameters, DRIVE_DELAY})
    )
    varied = [row.name for row in cases.unknown.varied()]
    figures = {name: close_whole(controller, plant, nominal).figures() for name, plant in cases.plants.items()}
    of_model = context.point and not controller.designs_on_response  # else of the response
    stated = cases.plants if context.point else {}  # of margins nothing is required, and some take long
    amplitudes = _remark_amplitude(cases, design) if context.point else ()
    closed = any(feeds_back(controller, plant) for plant in cases.plants.values())
    return Evidence(
        requirements=(
            *(design_requirements(controller, design, of_design, varied) if of_model else ()),
            *(row for name, spot in cases.spots.items() for row in plant_requirements(controller, spot, figures[name])),
        ),
        fields={
            "plants": figures,
            "margins": {name: plant_margins(controller, plant, nominal) for name, plant in stated.items()},
        },
        remarks=(
            *warn_delays(controller.spec, design, context.source),
            *amplitudes,
            *((WITH_TERMS,) if closed else ()),
        ),
        scope="nominal",
    )


def measure_responses(context: CheckContext, _: Progress) -> Evidence:
    """Judge the loop on every measured response, of a schedule with the law where it was taken; a law that was designed
    on one by all limits on the first.
    """
    rows, remarks = list[Requirement](), list[str]()
    for name, response in context.measured.items():
        controller, place = _find_law(context, name, response)
        scopes: tuple[Scope, ...] = ("every plant",)
        if controller.designs_on_response and not rows:
            scopes = ("design plant", *scopes)
        for scope in scopes:
            of_response = measured_requirements(controller, name, response, scope)
            rows += (replace(row, place=place, risk=1.0 - response.confidence) for row in of_response)
        plant = controller.spec.see_response(response, controller.command)
        remarks.append(str(measure_discs(plant, controller.law, controller.spec.bandwidth_hz)))
        terms = controller.compensation
        if terms is not None and terms.friction is not None and terms.friction.reads:
            remarks.append(f"{name}: {WHERE_IT_SLIDES}")
    return Evidence(requirements=rows, remarks=tuple(remarks), scope="measured")


def _find_law(
    context: CheckContext, name: str, response: MeasuredResponse
) -> tuple[Controller, tuple[str, float] | None]:
    """Return the law that a response is of, and of a schedule the value at which it was taken."""
    if not context.places:
        return context.cases.controller, None
    source, schedule = context.source, context.schedule
    fitted = source.parameters if isinstance(source, Fit) else source
    values, (first, *_, last) = context.supplement.with_parameters(*fitted.values()), schedule.points
    taken_at = find_response_place(schedule.over, name, response, values)
    if not first <= taken_at <= last:
        raise ControlError(
            f"measured: {name} was taken at {schedule.over} = {taken_at:g}, outside the points; leave it out, or give "
            "points that reach there"
        )
    return schedule.at(taken_at), (schedule.over, taken_at)


def judge_logs(context: CheckContext, _: Progress) -> Evidence:
    """Judge the law on every log of the fit that is of one of its plants, and was taken where a schedule stands."""
    controller, fit = context.cases.controller, context.source
    if not isinstance(fit, Fit):
        return Evidence()
    limit = controller.spec.level("max_sensitivity") or ANY_MS
    names = {plant.name for plant in context.cases.models.values()}
    logs = [each for each in (*fit.experiments, *fit.validation) if each.plant.name in names]
    if context.place is not None:
        logs = [each for each in logs if np.isclose(_find_log_place(context.place[0], fit, each), context.place[1])]
    judged = [judge_log(controller, fit, experiment, limit) for experiment in logs]
    verdicts = tuple(verdict for of_log, _ in judged for verdict in of_log)
    rows = [row for each in verdicts for row in _list_log_rows(each, limit * (1.0 + GRACE))]
    remarks = [SILENT[silent.why].format(silent) for _, silent in judged if silent is not None]
    if fit.experiments and not logs and context.place is None:
        remarks.append(NO_LOG)
    return Evidence(requirements=rows, fields={"logs": verdicts}, remarks=tuple(remarks), scope="measured")


def _list_log_rows(log: LogVerdict, limit: float) -> Iterator[Requirement]:
    """Yield what a log says of the law, where that breaks what is asked of it or anything is, and of the model that the
    other checks judge it by, each with its risk.
    """
    plant, independent = f"log:{log.experiment}", log.confidence is not None
    risk = None if log.confidence is None else 1.0 - log.confidence
    if limit < ANY_MS or log.outcome == "refuted":
        yield require_at_most(LOG_SENSITIVITY, log.ms_least, limit, plant=plant, text=describe_log(log), risk=risk)
    if log.agreement is not None:
        yield require_at_most(
            LOG_AGREEMENT,
            log.agreement.misfit,
            log.agreement.allowed,
            plant=plant,
            text=f"{log.samples}, {describe_agreement(log.agreement)}",
            risk=CONTRADICT if independent else None,
        )


def describe_agreement(agreement: Agreement) -> str:
    """Return whether a log agrees with the model, and where least, for its row."""
    if not agreement.contradicts:
        return "agrees with the model"
    return (
        f"contradicts the model: its response is off by {format_percent(agreement.off, 2)} at "
        f"{agreement.off_hz:.3g} Hz, which noise and the fit's intervals do not explain"
    )


def describe_log(log: LogVerdict) -> str:
    """Return what a log says of the loop, up to which frequency and how surely, for its row."""
    measured = "UNSTABLE" if np.isinf(log.ms) else f"Ms {log.ms:.3g}"
    alone = f", at its amplitude of {log.amplitude:.3g} {log.unit} rms alone" if log.at_amplitude else ""
    sure = "not independent" if log.confidence is None else f"at {format_percent(log.confidence, 6)}"
    if log.outcome == "undecided" and log.asked_hz is not None:
        sure = f"not confirmed {sure}, which asks for all from {format_band(log.asked_hz)} Hz"
    return (
        f"{log.samples}, {log.outcome} at {log.ms_hz:.3g} Hz: measured {measured}, predicted {log.ms_predicted:.3g}; "
        f"it tells from {format_band(log.band_hz)} Hz{alone}; {sure}"
    )


def _find_log_place(over: str, fit: Fit, experiment: Experiment) -> float:
    """Return where a schedule's variable stood in a log: a parameter at its value, a state at rest."""
    values = experiment.apply_own(fit.parameters)
    source = values if over in values else experiment.plant.defaults
    return source[over].value if over in source else 0.0


NOMINAL = Check(measure=measure_nominal, brief=lambda _: True)
LOGS = Check(
    measure=judge_logs,
    seconds=lambda _: LOG_SECONDS,
    applies=lambda context: bool(context.cases.models) and isinstance(context.source, Fit),
)
MEASURED = Check(measure=measure_responses, applies=lambda context: bool(context.measured))


def design_requirements(
    controller: Controller, plant: Plant, values: ParameterSet, varied: Collection[str] = ()
) -> list[Requirement]:
    """Return what is required of the design plant at the nominal `values`; of one that is stuck only some limits."""
    states = friction_states(plant) if has_friction(plant, values, varied) else {"": plant}
    figures = {state: controller.close(variant, values).figures() for state, variant in states.items()}
    (state, achieved), *stuck = figures.items()
    band, port = controller.spec.passive_band_hz, None
    if band is not None and controller.design is not None:
        port_plant = port_of(states[state], controller.delay(values), controller.signals, controller.command.per_effort)
        port = measure_port(port_plant, controller.law, controller.compute_delay_samples, band)
    sliding = replace(controller.measure("", achieved, port), fast=controller.measure_fast(plant, values))
    rows = _judge(controller, sliding, "design plant", Spot(DESIGN_PLANT, state))
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
    on = f"on measured points, at {format_percent(measured.confidence, 4)}"
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


def _remark_amplitude(cases: Cases, plant: Plant) -> tuple[str, ...]:
    """Say which bandwidth the design plant has at amplitudes of use, where friction makes it depend on them. They are
    shares of the force that the current limit holds at rest, those of the simulated steps.
    """
    controller, nominal = cases.controller, cases.unknown.nominal
    name = next(name for name, model in cases.models.items() if model is plant)
    holding, sliding = controller.force_limit(0.0), controller.achieved.bandwidth_hz
    if holding is None or sliding is None or not has_friction(plant, nominal):
        return ()
    low, high = STEP_SHARES[0], STEP_SHARES[-1]
    bands = predict_bandwidths(controller, plant, nominal, holding * np.geomspace(low, high, AMPLITUDES))
    reached = [band for band in bands if band is not None]
    at = f"at {100.0 * low:g} to {format_percent(high)} of the current"
    if not reached:
        return (f"{name}: bandwidth {sliding:.3g} Hz sliding; below {sliding / SLOWEST_STUCK:.2g} Hz {at}",)
    least = f"{min(reached):.3g}" if len(reached) == len(bands) else f"less than {min(reached):.3g}"
    return (f"{name}: bandwidth {sliding:.3g} Hz sliding; between {least} and {max(reached):.3g} Hz {at}, predicted",)
