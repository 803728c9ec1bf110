r"""How fast a scheduling variable may move, by simulation: sweeps of growing speed on the nonlinear plant.

The limits of a schedule are judged with the variable standing still. Here it moves, imposed from outside as

.. math:: s(t) = s_0 + \tfrac12 (s_1 - s_0)(1 - \cos \omega t),

through the whole table and back, at a peak rate of :math:`\tfrac12 (s_1 - s_0)\,\omega`: in place of a parameter, or in
place of a state, whose own rate then is ds/dt. The law runs as it is exported, and reads s in the same sample as the
regulated output. Where an outer loop is around it, its x_0 goes with a link that is moved so, and pulses are of the
force that its stiffness makes of x_0.

Each sweep is simulated twice, with pulses of the reference and without, and what is judged is the difference: the
motion itself stretches the spring, which disturbs every law alike. The difference must keep the reference peak that a
step is allowed (and 10 % grace), both ways, and be settled to a tenth of the step in the last quarter of every pulse
and pause, or to twice what the law leaves there while s stands still. The command may not saturate: beyond that the
motion asks for more than the drive has, whatever the gains.

This finds where a sweep of this shape goes wrong. It proves nothing of other motions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from seaopt.codec import OrInfinite
from seaopt.control.loops.compensation.terms import FORGOTTEN
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.running.closed_loop import LoopRun, LoopState, run_loop
from seaopt.control.running.equilibrium import Equilibrium, equilibrium
from seaopt.control.running.law_step import find_faults
from seaopt.control.running.loop_kernel import Rows
from seaopt.control.scheduling.runnable_schedule import RunnableSchedule
from seaopt.control.scheduling.scheduled_controller import ScheduledController, place_variable
from seaopt.errors import SimulationError
from seaopt.executors import Shared, map_ordered
from seaopt.formatting import format_percent
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.plants.memo import memo
from seaopt.progress import Progress, ignore
from seaopt.records import record
from seaopt.robustness.verification.judgement import Judge, find_saturated, take_ends
from seaopt.robustness.verification.oscillation import Signal
from seaopt.robustness.verification.scenarios import PEAK_GRACE, SETTLED, build_loop
from seaopt.units import show_command

SHARES = tuple(2.0**power for power in range(-7, 0))  # of the least bandwidth: frequencies of the sweeps
PULSE_PERIODS = 10.0  # of the least bandwidth, that a pulse lasts, and a pause
LEAST_PULSES = 4
STEP_SHARE = 0.1  # of the effort that the command's limit leaves
KICK_SHARE = 0.8  # of that limit, that the command reaches at most as a pulse begins
DEFAULT_PEAK = 1.3  # of a reference peak, where the specification lifts its limit
JUDGED_FROM = 0.75  # of a pulse or pause: its end
SWEEP = ("sweep_from", "sweep_to", "sweep_rad_s")  # parameters of a swept plant


@record
class Sweep:
    """The findings of one sweep.

    Parameters
    ----------
    plant : str
        Its name.
    rate : float
        The largest rate of the variable, in its unit per second.
    frequency_hz : float
        Of the sweep through the table and back.
    peak : float
        Largest of the response to the pulses, over their size.
    left : float
        How far off it still was in the last quarter of a pulse or a pause, over their size.
    fault : str
        Why it does not keep the judgement; empty where it does.
    """

    plant: str
    rate: float
    frequency_hz: float
    peak: OrInfinite
    left: OrInfinite
    fault: str


@record(eq=False)
class _Pulses:
    """The pulses of the reference: their size, the samples of one, and what is allowed of the response."""

    size: float
    samples: int
    allowed_peak: float
    allowed_left: float


def sweep_schedule(
    schedule: ScheduledController,
    name: str,
    plant: Plant,
    params: ParameterSet,
    progress: Progress = ignore,
    executor: Executor | None = None,
) -> tuple[Sweep, ...]:
    """Sweep a plant's scheduling variable at growing rates, up to the first that does not keep the judgement.

    Parameters
    ----------
    schedule : ScheduledController
        The law.
    name : str
        The plant's, for the result.
    plant, params
        Which has the variable, as a parameter or as a state.
    progress : callable, optional
        Called before each sweep.
    executor : concurrent.futures.Executor, optional
        Where sweeps are simulated, some of them beyond the first that does not keep the judgement; here, if left out.

    Returns
    -------
    tuple of Sweep
        By rate; all but the last keep the judgement. Empty of a plant that does not have the variable.

    Raises
    ------
    ControlError
        The plant cannot rest at the first point.
    """
    if schedule.over not in plant.parameters and schedule.over not in plant.states:
        return ()
    least, pulses = min(schedule.bandwidths_hz), _choose_pulses(schedule, plant, params)
    sweeps: list[Sweep] = []
    frequencies = [least * share for share in SHARES]
    runs = map_ordered(partial(_run_sweep, Shared((schedule, name, plant, params, pulses))), frequencies, executor)
    for number, frequency in enumerate(frequencies):
        progress(f"sweep at {frequency:.3g} Hz", number / len(frequencies))
        sweeps.append(next(runs))
        if sweeps[-1].fault:
            break
    return tuple(sweeps)


def find_fastest(sweeps: Sequence[Sweep]) -> float:
    """Return the largest rate up to which every sweep keeps the judgement; zero where the slowest does not."""
    kept = [sweep.rate for sweep in sweeps if not sweep.fault]
    return max(kept, default=0.0)


def describe_sweeps(sweeps: Sequence[Sweep], unit: str) -> str:
    """Return what the sweeps of one plant found, in one line; rates are in `unit`."""
    head, last = f"keeps its judgement in sweeps of up to {find_fastest(sweeps):.3g} {unit}", sweeps[-1]
    return f"{head}, the fastest tried" if not last.fault else f"{head}; at {last.rate:.3g} {unit} {last.fault}"


def _choose_pulses(schedule: ScheduledController, plant: Plant, params: ParameterSet) -> _Pulses:
    """Return pulses small enough for the command's limit at every point, and what is allowed of their response."""
    spec, ts = schedule.spec, schedule.spec.sample_time_s
    samples, loops = math.ceil(PULSE_PERIODS / min(schedule.bandwidths_hz) / ts), schedule.close_points(plant, params)
    left = max(
        abs(loop.measure_step_left(JUDGED_FROM * samples * ts)) / max(abs(loop.tracking(np.zeros(1))[0]), 1e-9)
        for loop in loops
    )
    limit = schedule.controllers[0].command_limit or math.inf
    efforts = (float(np.max(np.abs(loop.simulate(np.ones(samples))[1]))) for loop in loops)
    kick = max(abs(schedule.command.per_effort) * effort for effort in efforts)  # of a pulse of one
    return _Pulses(
        size=min(STEP_SHARE * find_least_effort(schedule), KICK_SHARE * limit / kick),
        samples=samples,
        allowed_peak=PEAK_GRACE * (spec.level("max_reference_peak") or DEFAULT_PEAK),
        allowed_left=max(SETTLED, 2.0 * left),
    )


def find_least_effort(schedule: ScheduledController) -> float:
    """Return what the command's limit leaves of the output at every point, at rest and at the bandwidth."""
    limits = [controller.force_limit(0.0) for controller in schedule.controllers]
    fast = [controller.force_limit(controller.spec.bandwidth_hz) for controller in schedule.controllers]
    efforts = [abs(value) for value in (*limits, *fast) if value is not None and math.isfinite(value)]
    return min(efforts, default=1.0 / STEP_SHARE)


def _run_sweep(
    shared: Shared[tuple[ScheduledController, str, Plant, ParameterSet, _Pulses]], frequency_hz: float
) -> Sweep:
    """Simulate one sweep with pulses and without, and judge the difference."""
    schedule, name, plant, params, pulses = shared.value
    low, high, ts = schedule.points[0], schedule.points[-1], schedule.spec.sample_time_s
    omega = 2.0 * math.pi * frequency_hz
    count = max(LEAST_PULSES, math.ceil(1.0 / frequency_hz / (2 * pulses.samples * ts)))
    pulse = np.tile(np.repeat([1.0, 0.0], pulses.samples), count)
    path = low + 0.5 * (high - low) * (1.0 - np.cos(omega * ts * np.arange(pulse.size)))
    start = RestStart.at_rest(schedule, plant, params, low)
    values = start.params.with_parameters(
        *(
            Parameter(name=key, value=value, unit=unit)
            for key, value, unit in zip(SWEEP, (low, high, omega), (schedule.unit, schedule.unit, "rad/s"), strict=True)
        )
    )
    make_sweep = partial(Sweep, plant=name, rate=0.5 * (high - low) * omega, frequency_hz=frequency_hz)
    try:
        run = start.run(make_swept_plant(plant, schedule.over), values, np.outer([0.0, pulses.size], pulse), path)
    except SimulationError as error:
        return make_sweep(peak=math.inf, left=math.inf, fault=f"is lost: {error}")
    calm, moved = start.find_errors(run, path)
    response = (moved - calm) / pulses.size + pulse
    peak = float(max(np.max(response), 1.0 - np.min(response)))
    ends = range(pulses.samples, pulse.size + 1, pulses.samples)
    left = float(np.max(np.abs(take_ends(response - pulse, ends, int((1.0 - JUDGED_FROM) * pulses.samples)))))
    judge, saturated = Judge(), find_saturated(run.current, schedule.runnable().command_limit)
    judge.require("limit", saturated, 0.0, "the motion takes the command to its limit")
    reached = f"a step reaches {peak:.3g} of its size, {pulses.allowed_peak:.3g} allowed"
    judge.require("overshoot", peak, pulses.allowed_peak, reached)
    off = f"a step is still {format_percent(left)} off at its end, {format_percent(pulses.allowed_left)} allowed"
    judge.require("settling", left, pulses.allowed_left, off)
    return make_sweep(peak=peak, left=left, fault=judge.first)


@record(eq=False)
class RestStart:
    """Where a run starts: the loop at rest at a value of the variable."""

    schedule: ScheduledController
    params: ParameterSet
    value: float  # of the variable
    states: dict[str, float]
    equilibrium: Equilibrium

    @classmethod
    def at_rest(cls, schedule: ScheduledController, plant: Plant, params: ParameterSet, value: float) -> RestStart:
        """Return where a plant rests with the variable at a value."""
        placed, law = plant.complete(place_variable(plant, params, schedule.over, value)), schedule.runnable(outer=True)
        loop = build_loop(schedule.controllers[0], plant, [placed], law, place=schedule.over)
        start = equilibrium(loop, [placed], value)
        return cls(
            schedule=schedule,
            params=placed.drop_conditions(),
            value=value,
            states=dict(zip(plant.states, start.state.x[0].tolist(), strict=True)),
            equilibrium=start,
        )

    @property
    def regulated(self) -> str:
        """The output that follows the reference."""
        return self.schedule.controllers[0].signals[0]

    def run(self, plant: Plant, values: ParameterSet, references: Rows, places: Signal | float = math.nan) -> LoopRun:
        """Return runs of the loop from there, of a plant that has these states; references count from there, and
        `places` are for a plant that does not have the variable. Raises SimulationError: to hold it there takes
        more than the command's limit, the loop runs away, or the gate gives its sensor up.
        """
        law, holding = self.schedule.runnable(outer=True), abs(float(self.equilibrium.rest_command[0]))
        if holding > law.command_limit:
            needed, limit = (show_command(value, *law.command) for value in (holding, law.command_limit))
            raise SimulationError(
                f"{needed} holds it at {self.schedule.over} = {self.value:.4g}, above the limit of {limit}"
            )
        loop = build_loop(self.schedule.controllers[0], plant, [values], law, place=self.schedule.over)
        played, count = self.equilibrium.given[0] + references, len(references)
        if law.outer is not None:
            travelled, _ = law.outer.split(_travel(plant, law.outer, values, references.shape[1]))
            played = self.equilibrium.given[0] + references / law.outer.per_given + travelled
        x, z = [self.states[name] for name in plant.states], self.equilibrium.state.z
        start = LoopState(x=np.tile(x, (count, 1)), z=np.tile(z, (count, 1)))
        run = run_loop(loop, [values] * count, played, start=start, places=places)
        if not all(np.all(np.isfinite(rows)) for rows in (*run.outputs.values(), run.current)):
            raise SimulationError("it runs away")
        if np.any(find_faults(law, run.end.z)):
            raise SimulationError("the gate gives its sensor up")
        return run

    def find_errors(self, run: LoopRun, places: Signal) -> Rows:
        """Return how far the output is from what the law follows, the weight that it compensates included."""
        law, followed = self.schedule.runnable(outer=True), run.reference
        if law.outer is not None:
            followed = law.outer.ask(followed, run.outputs.get(law.outer.position, np.zeros_like(followed)))
        errors = run.outputs[self.regulated] - followed
        if law.compensation is None or law.compensation.gravity is None:
            return errors
        name = law.compensation.gravity.reads
        read = run.outputs.get(name, np.zeros_like(errors))
        rows = [
            [_weigh(law, {name: position}, value) for position, value in zip(row, places.tolist(), strict=True)]
            for row in read.tolist()
        ]
        return errors - np.array(rows)


def _travel(plant: Plant, outer: OuterLoop, values: ParameterSet, samples: int) -> Signal:
    """Return how far a sweep moves the link's position at each sample; zero of a link that is not moved by it."""
    names = list(plant.outputs)
    position = plant.output[names.index(outer.position)] if outer.position in names else ca.SX(0)
    if ca.depends_on(position, ca.vertcat(plant.x, plant.u)):
        return np.zeros(samples)
    read = ca.Function("position", [plant.t, plant.p], [position])
    times = outer.sample_time_s * np.arange(samples)
    path = np.array(read(times[None], plant.complete(values).vector)).ravel()
    return path - path[0]


def _weigh(law: RunnableSchedule, readings: Mapping[str, float], value: float) -> float:
    """Return what a law adds to its reference at readings, those that are missing at zero."""
    if law.compensation is None:
        return 0.0
    read = [readings.get(name, 0.0) for name in law.compensation.reads]
    return law.compensation.step(FORGOTTEN, 0.0, read, law.find_terms(value))[0]


@memo
def make_swept_plant(plant: Plant, over: str) -> Plant:
    """Return a plant in which a parameter, or a state with its rate, follows a sweep of time. Its parameters are those
    of the plant, and sweep_from, sweep_to and sweep_rad_s.
    """
    unit = plant.parameter_unit(over) if over in plant.parameters else plant.states[over]
    rate = _find_rate(plant, over)
    kept = {name: unit for name, unit in plant.states.items() if name not in (over, rate)}
    equations = ca.Function("plant", [plant.t, plant.x, plant.u, plant.p], [plant.dynamics, plant.output])

    def evaluate(t: Any, x: Any, u: Any, p: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        half, phase = 0.5 * (p.sweep_to - p.sweep_from), p.sweep_rad_s * t
        moved = {over: p.sweep_from + half * (1.0 - ca.cos(phase))}
        moved |= {rate: half * p.sweep_rad_s * ca.sin(phase)} if rate else {}
        states, values = ({**vars(space), **moved} for space in (x, p))
        slopes, outputs = equations(
            t,
            ca.vertcat(*(states[name] for name in plant.states)),
            ca.vertcat(*(getattr(u, n) for n in plant.inputs)),
            ca.vertcat(*(values[name] for name in plant.parameters)),
        )
        return (
            dict(zip(plant.states, ca.vertsplit(slopes), strict=True)),
            {over: moved[over], **dict(zip(plant.outputs, ca.vertsplit(outputs), strict=True))},
        )

    def f(t: Any, x: SimpleNamespace, u: SimpleNamespace, p: SimpleNamespace) -> dict[str, Any]:
        return {name: slope for name, slope in evaluate(t, x, u, p)[0].items() if name in kept}

    def h(t: Any, x: SimpleNamespace, u: SimpleNamespace, p: SimpleNamespace) -> dict[str, Any]:
        return evaluate(t, x, u, p)[1]

    shown = {} if over in plant.outputs else {over: unit}  # for a compensation that reads it
    return Plant(
        name=f"{plant.name}, {over} swept",
        states=kept,
        inputs=plant.inputs,
        outputs={**plant.outputs, **shown},
        parameters={**plant.parameters, **dict(zip(SWEEP, (unit, unit, "rad/s"), strict=True))},
        f=f,
        h=h,
        drive_offset_s=plant.drive_offset_s,
    )


def _find_rate(plant: Plant, over: str) -> str:
    """Return the state that is the rate of a state; empty where there is none, or it is a parameter that moves."""
    if over not in plant.states:
        return ""
    slope = plant.dynamics[list(plant.states).index(over)]
    for name, symbol in zip(plant.states, ca.vertsplit(plant.x), strict=True):
        if ca.is_equal(slope, symbol, 2):
            return name
    return ""
