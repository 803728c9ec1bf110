"""What runs of a tuned law: with the file's outer loop, gate and heat guard, and with what it compensates."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from seaopt.control import (
    CompensateFriction,
    CompensateGravity,
    CompensateRipple,
    Controller,
    ForceMPC,
    Impedance,
    ScheduledController,
    add_compensation,
    add_impedance,
    compensate_schedule,
    critical_impedance,
)
from seaopt.control.laws.plausibility import PlausibilityGate
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.loops.sampled_plant import list_names
from seaopt.control.scheduling.scheduled_controller import PARTS, list_inner, place_variable
from seaopt.errors import ControlError, ProblemError
from seaopt.estimation import Fit
from seaopt.formatting import join_words
from seaopt.parameters import ParameterSet
from seaopt.problem.option_tables import make_record
from seaopt.problem.problem import Problem


def complete_controller(problem: Problem, controller: Controller, source: Fit | ParameterSet) -> Controller:
    """Return a controller with the problem's outer loop, its guards, and with what it compensates. Raises
    SeaoptError: as `seaopt.control.add_compensation`, or the stiffness has no critically damped impedance.
    """
    return _guard(problem, surround_controller(problem, controller, source), source)


def surround_controller(problem: Problem, controller: Controller, source: Fit | ParameterSet) -> Controller:
    """Return a controller with the problem's outer loop and with what it compensates."""
    values = problem.values(source)
    (controller,), terms = add_outer_loop(problem, [(controller, values)]), _list_terms(problem, values)
    return add_compensation(controller, **terms) if terms else controller


def find_outer(problem: Problem, source: Fit | ParameterSet) -> Callable[[Any], OuterLoop | None] | None:
    """Return what says with which outer loop a tuned law, or a schedule, is to run; None where the file has none."""
    return None if problem.table.impedance is None else partial(_surround, problem, source)


def _surround(problem: Problem, source: Fit | ParameterSet, law: Controller | ScheduledController) -> OuterLoop | None:
    if isinstance(law, ScheduledController):
        return _surround_schedule(problem, law, source)[0].outer
    return add_outer_loop(problem, [(law, problem.values(source))])[0].outer


def add_outer_loop(
    problem: Problem,
    laws: Sequence[tuple[Controller, ParameterSet]],
    between: Iterable[tuple[Controller, ParameterSet]] = (),
) -> list[Controller]:
    """Return controllers, each with the parameters of its place, with one outer loop; critical damping is the largest
    that one of them needs, or of those `between` them.
    """
    outer = problem.table.impedance
    if outer is None:
        return [controller for controller, _ in laws]
    plant, filter_s = problem.plants[outer.plant], outer.velocity_filter_s
    if outer.damping == "critical":
        each = [
            critical_impedance(law, plant, at, outer.stiffness, velocity_filter_s=filter_s)
            for law, at in (*laws, *between)
        ]
        impedance = max(each, key=lambda impedance: impedance.damping)
    else:
        impedance = Impedance(stiffness=outer.stiffness, damping=outer.damping, velocity_filter_s=filter_s)
    return [add_impedance(law, plant, at, impedance, name=outer.plant) for law, at in laws]


def _list_terms(problem: Problem, values: ParameterSet) -> dict[str, Any]:
    """Return what the file asks to compensate, as `add_compensation` takes it."""
    tables = problem.controller_table.compensation
    kinds = {"friction": CompensateFriction, "gravity": CompensateGravity, "ripple": CompensateRipple}
    terms: dict[str, Any] = {
        name: make_record(kind, table) for name, kind in kinds.items() if (table := getattr(tables, name))
    }
    link = tables.gravity and tables.gravity.plant
    return terms | ({"link": (problem.plants[link], values)} if link else {})


def _guard(problem: Problem, controller: Controller, source: Fit | ParameterSet) -> Controller:
    """Return a controller with the problem's gate and heat guard."""
    return replace(controller, gate=make_gate(problem, controller, source), derate=derates(problem, controller))


def derates(problem: Problem, controller: Controller | ForceMPC) -> bool:
    """Tell whether the file asks to lower the limit as the winding warms up."""
    derate = problem.controller_table.derate
    if derate and controller.heat_guard is None:
        raise ProblemError(
            f"{problem.source}: controller.derate: nothing is known of the motor's heat; give the design plant the "
            "part thermal and a current to command, or leave it out"
        )
    return derate


def complete_schedule(
    problem: Problem, schedule: ScheduledController, source: Fit | ParameterSet
) -> ScheduledController:
    """Return a schedule with the problem's guards, the gate's step that of the point where the plant moves the
    furthest, and with what it compensates.
    """
    guarded = [_guard(problem, controller, source) for controller in _surround_schedule(problem, schedule, source)]
    gate = _join_gates(problem, schedule, [controller.gate for controller in guarded if controller.gate is not None])
    guarded = replace(schedule, controllers=tuple(replace(each, gate=gate) for each in guarded))
    terms = _list_terms(problem, problem.values(source))
    return compensate_schedule(guarded, **terms) if terms else guarded


def _surround_schedule(problem: Problem, schedule: ScheduledController, source: Fit | ParameterSet) -> list[Controller]:
    """Return a schedule's controllers with the problem's outer loop."""
    values, outer = problem.values(source), problem.table.impedance
    link = problem.design_plant if outer is None else problem.plants[outer.plant]
    stand = partial(place_variable, link, values, schedule.over)
    between = ((schedule.at(value), stand(value)) for value in list_inner(schedule.points, PARTS))
    return add_outer_loop(problem, list(zip(schedule.controllers, map(stand, schedule.points), strict=True)), between)


def _join_gates(
    problem: Problem, schedule: ScheduledController, gates: Sequence[PlausibilityGate]
) -> PlausibilityGate | None:
    """Return the gate of all points: with the widest step and agreement, where the encoders say the same at each."""
    if not gates:
        return None
    widest = max(gates, key=lambda gate: gate.max_step_N)
    agreements = [gate.agreement for gate in gates if gate.agreement is not None]
    if not agreements:
        return widest
    first = agreements[0]
    for value, each in zip(schedule.points, agreements, strict=True):
        if not np.allclose(each.weights, first.weights, rtol=1e-9, atol=0.0):
            raise ProblemError(
                f"{problem.source}: controller.gate: agreement: what {join_words(first.reads)} say of the force "
                f"differs over {schedule.over} (weights {first.weights} at {schedule.points[0]:g}, {each.weights} at "
                f"{value:g}), and a schedule has one gate; leave agreement out, or schedule over what the spring does "
                "not depend on"
            )
    limit, share = (max(getattr(each, name) for each in agreements) for name in ("limit", "share"))
    return replace(widest, agreement=replace(first, limit=limit, share=share))


def make_gate(
    problem: Problem, controller: Controller | ForceMPC, source: Fit | ParameterSet
) -> PlausibilityGate | None:
    """Return the gate that the file asks for; None where it asks for none."""
    table = problem.controller_table.gate
    if table is None:
        return None
    try:
        noise = _find_noise(problem, source) if table.agreement else None
        return PlausibilityGate.of_controller(controller, noise=noise, **table.model_dump())
    except ControlError as error:
        raise ProblemError(f"{problem.source}: controller.gate: {error}") from error


def _find_noise(problem: Problem, source: Fit | ParameterSet) -> dict[str, float]:
    """Return the noise of sensors in the logs that have the regulated force, the largest of each; that of [robustness]
    for what no such log has.
    """
    noise = dict(problem.robustness.sensors.noise_std)
    regulated = list_names(problem.controller_table.measured)[0]
    logs = [outputs for outputs in source.outputs.values() if regulated in outputs] if isinstance(source, Fit) else []
    for name in {name for outputs in logs for name in outputs}:
        scores = [outputs[name] for outputs in logs if name in outputs]
        noise[name] = max(figure for score in scores for figure in (score.sigma, score.rms_residual))
    return noise
