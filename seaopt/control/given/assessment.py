"""Measure a law that was not tuned here against a specification."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from seaopt.control.frontier.rows import FrontierRow, make_row
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.delay import settle_delays, take_own_delays
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.laws.structures import CUSTOM
from seaopt.control.loops.law import Law, count_filter_samples, find_integral_rate
from seaopt.control.loops.sampled_plant import find_signals, list_names
from seaopt.control.tuning.found_law import Surround
from seaopt.control.tuning.optimisation_problem import Task
from seaopt.control.tuning.tuner import Draws, RobustTo, describe_law, make_task, name_design
from seaopt.errors import ControlError, require_type
from seaopt.estimation import Fit
from seaopt.frequency import MeasuredResponse
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant

SAME_RATE = 1e-9  # share by which a law's sample rate may be off the specification's


def assess(
    law: Any,
    plant: Plant | MeasuredResponse,
    params: Fit | ParameterSet,
    spec: ControllerSpec,
    robust_to: RobustTo | None = None,
    *,
    draws: Draws = (),
    outer: Surround | None = None,
) -> Controller:
    """Measure a law of one's own against a specification; the controller that it makes is certified and exported alike.

    Parameters
    ----------
    law : Law or a python-control system
        From reference and each measured signal to effort: `Law.from_state_space`, `Law.from_transfer_functions`,
        `seaopt.control.parallel_pid`, `ideal_pid`, or what `Law.from_control` takes. A law to the command itself (A) is
        divided by the command for one unit of effort: `law.scaled(1/command_of(plant, params, measured).per_effort)`.
    plant, params
        The design plant, and its parameters, as in `tune`.
    spec : ControllerSpec
        Limits, and the bandwidth that the law should have at least; its structure, notch, prefilter,
        link_feedforward and reference_weights are those of no law, and its sample rate must be the law's.
    robust_to, draws, outer
        As in `tune`.

    Returns
    -------
    Controller
        Of the structure "custom", without gains; `feasible` tells whether every limit is met.

    Raises
    ------
    ControlError
        As `tune`, or the law is none, or of another sample time.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.control import ideal_pid
    >>> law = ideal_pid(K=2.0, T_i=0.05, T_d=0.01, N=10.0, sample_time_s=1e-3)
    >>> spec = so.ControllerSpec(bandwidth_hz=20, max_sensitivity=2.0, max_droop_db=False)
    >>> controller = assess(law, so.plants.high_impedance(), so.plants.thor(), spec)
    >>> controller.structure, controller.achieved.stable
    ('custom', True)
    """
    return assess_row(law, plant, params, spec, robust_to, draws=draws, outer=outer)[1]


def assess_row(
    law: Any,
    plant: Plant | MeasuredResponse,
    params: Fit | ParameterSet,
    spec: ControllerSpec,
    robust_to: RobustTo | None = None,
    *,
    draws: Draws = (),
    outer: Surround | None = None,
) -> tuple[FrontierRow, Controller]:
    """Return the controller of `assess` with its row of a frontier."""
    if isinstance(law, Plant):
        raise ControlError("law = a Plant; the law comes first, as in certify: assess(law, plant, params, spec)")
    require_type(spec, ControllerSpec, "spec", "give a ControllerSpec", ControlError)
    design = name_design(plant)
    law = law if isinstance(law, Law) else Law.from_control(law)
    names, signals = list_names(spec.measured), find_signals(design, spec.measured)
    if law.d.size != 1 + len(names):
        raise ControlError(
            f"law reads {law.d.size - 1} signals, and measured = {list(names)} names {len(names)}; give one of the "
            "reference and of each signal, or name them all in measured"
        )
    for column, (name, signal) in enumerate(zip(names, signals, strict=True), start=1):
        law = law if name == signal else law.differenced(column)
    if abs(law.sample_time_s * spec.sample_rate_hz - 1.0) > SAME_RATE:
        raise ControlError(
            f"law has a sample time of {law.sample_time_s:g} s, and the specification sample_rate_hz = "
            f"{spec.sample_rate_hz:g}; give sample_rate_hz = {1.0 / law.sample_time_s:g}, or sample the law again"
        )
    law = replace(law, sample_time_s=spec.sample_time_s)
    robust_to = take_own_delays(spec, design, robust_to or {}, params)
    spec, values = settle_delays(spec, design, params)
    spec = replace(spec, structure=CUSTOM, notch=None, prefilter=None, link_feedforward=None, reference_weights="tuned")
    task = make_task(plant, design.complete(values), spec, robust_to, draws)

    def describe(task: Task) -> tuple[FrontierRow, Controller]:
        loops = task.measure_law(law, filter_samples=count_filter_samples(law), integral_rad_s=find_integral_rate(law))
        controller = describe_law(task, law, loops, (plant, values), gains={})
        return make_row(task, law, loops, controller), controller

    row, controller = describe(task)
    around = None if outer is None else outer(controller)
    return (row, controller) if around is None else describe(task.enclosed(around, controller.command.per_effort))
