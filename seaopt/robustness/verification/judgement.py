"""The judge of every simulated run: its figures, and whether they are allowed.

A `Judge` is asked check after check by whoever has a run: of a scenario here, of sweeps and pushes of a schedule, of
predictive control with its limits active. A run of a scenario passes if:

- it stays finite, and the current stays within the limit, rounded down to a whole step of the amplifier;
- the linear loop of the last phase is stable (`linear`). An unstable one may still settle by luck, on a step of the
  sensor or because the scenario does not excite the growing mode;
- nothing grows without noise: the run is simulated again on a sensor and an amplifier that only have a range. In its
  last phase, where the reference is constant, the largest energy of the second half (after a fifth for settling) does
  not exceed that of the first by more than 5 % and a thousandth of the whole run's. Under a constant reference the loop
  acts on the link like a constant force, which is conservative: over a swing the energy of link and actuator returns
  to its value, unless the loop feeds it. Where a plant declares no energy, the square of the force error replaces it.
  A step that settles with friction that sticks is exempt: a joint that sticks and lets go may move by a tenth of the
  step without any growth. Energy is counted from that of the rest where the run started. This finds growth
  within seconds; the eigenvalues find a mode that takes minutes. Noise moves the energy by more than 5 %, which is
  not growth;
- noise does not set off an oscillation: in the second half the force error is at most twice what it was before, with or
  without noise, plus six standard deviations of the force that noise makes in the linear loop;
- no oscillation sustains itself in the last phase (`oscillation`), above the level of noise and quantisation. Where a
  link moves, oscillations slower than a tenth of the bandwidth are excluded: an undamped link may swing; so are those
  of the link on its spring while friction holds the drive, which no law can damp;
- the scenario's limits are met: the final error, a mean, with an allowance of four standard deviations of its noise
  and of half a step of reading and command, which no law can tell from its reference, and of none in the run without;
  of a step from rest, as its user sees it, the largest force over the reference, and the time until the force stays
  within a tenth of it, both without noise. A step whose current saturates may overshoot further only where the limit
  makes it: the same step without the limit must keep the peak.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.codec import Key, OrInfinite, OrNaN
from seaopt.control.running.closed_loop import ENERGY
from seaopt.control.running.sampled_loop import largest_command
from seaopt.formatting import format_percent, format_values
from seaopt.parameters import ParameterSet
from seaopt.plants.friction import find_locked_modes
from seaopt.records import Result, record
from seaopt.robustness.verification.linear import LinearView, linearise_last_phase
from seaopt.robustness.verification.oscillation import Signal, find_oscillation
from seaopt.robustness.verification.playback import Playback, Rig
from seaopt.robustness.verification.scenarios import SETTLED, Scenario

SETTLE = 0.2  # of the last phase, which is not judged
GROWTH, GROWTH_FLOOR = 1.05, 1e-3
ROUNDING = 1e-24  # of the largest energy or square of an error, below which it is rounding: neither grows nor decays
OUTBREAK, OUTLIER = 2.0, 6.0
AT_LIMIT = ABOVE_LIMIT = 1e-9  # shares of the limit: rounding of a command that is at it
LINE_SIGMAS = 4.0  # standard deviations of noise that a line in its spectrum stays below: the amplitude is Rayleigh's
MEAN_SIGMAS = 4.0  # standard deviations that a mean of noise stays below
LEAST_WINDOW_S = 3.0
SLOWEST = 10.0  # times slower than the bandwidth: the slowest oscillation that is looked for
LINE_PERIODS = 8.0  # of the slowest oscillation, in the window
SHORTER = 4.0  # times shorter: the second window
STILL_PERIODS = 4.0  # where no link moves: of the slowest oscillation that is distinct from a drift
SAME_FREQUENCY = 0.02  # by which a line in a spectrum may be off from a mode that it is of
# With friction that sticks the integral grows until the joint lets go.
SLOWER_INTEGRAL = 'tune with reference_weights = "measurement" or objective = "noise", whose integral is slower'
VISIBLE = 0.01  # of a step: a smaller oscillation about it is none
NOMINAL = "nominal"
LOST = ("overflow", "unstable")  # kinds of fault that explain every other of the same run


@record
class Fault:
    """Something that a run is not allowed to do."""

    kind: str  # "overshoot", "settling", "oscillation", "growth", ...: faults of one kind are one failure
    text: str  # what happened, with figures
    value: OrInfinite = 1.0
    limit: OrInfinite = 0.0
    unit: str = ""  # of value and limit
    remedy: str = ""  # where something particular can be done

    def __str__(self) -> str:
        return f"{self.text}; {self.remedy}" if self.remedy else self.text


@record
class Outcome(Result):
    """One scenario on one plant at one set of parameters.

    Parameters
    ----------
    scenario, plant, draw : str
        `draw` is "nominal" or the number of a draw, from 1.
    faults : tuple of Fault
        What failed.
    parameters : mapping of name to float
        Where the draw differs from nominal: with scenario, plant and seed, the witness.
    peak_force_N, peak_command : float
        Peaks of the measured output (in its unit), between samples too, and of the command.
    saturated : float
        Share of the samples at the current limit.
    peak_angle_rad : float or None
        Peak of the plant's angles.
    peak_energy_J, energy_growth : float or None
        Largest energy; ratio of the largest in the last phase's second half to that in its first.
    final_error_N : float or None
        Mean of reference minus force over the last fifth of the last phase.
    limit_cycle_N, limit_cycle_hz : float or None
        Amplitude and frequency of an oscillation that does not die out.
    overshoot, settling_s : float or None
        Of a step from rest: the largest force over the reference, and the time until it stays within a tenth of it.
    overshoot_by_limit : bool
        A step overshoots further than is allowed, but would not without the current limit.
    contact_impulse, contact_loss_J : float or None
        Of the hardest contact: what stops the link along its coordinate, and the energy lost.
    """

    json_keys = (
        "met", "passed", "reason", "scenario", "plant", "draw", Key(field="kinds", name="faults"),
        Key(field="faults", name="findings"), "parameters", "peak_force_N",
        Key(field="peak_command", name="peak_current_A"), "saturated",
        "peak_angle_rad", "peak_energy_J", "energy_growth", "final_error_N", "limit_cycle_N", "limit_cycle_hz",
        "overshoot", "settling_s", "overshoot_by_limit", "contact_impulse", "contact_loss_J",
    )  # fmt: skip

    scenario: str
    plant: str
    draw: str
    faults: tuple[Fault, ...]
    parameters: Mapping[str, float]
    peak_force_N: OrInfinite
    peak_command: OrInfinite
    saturated: OrNaN
    peak_angle_rad: float | None = None
    peak_energy_J: float | None = None
    energy_growth: float | None = None
    final_error_N: float | None = None
    limit_cycle_N: float | None = None
    limit_cycle_hz: float | None = None
    overshoot: float | None = None
    settling_s: float | None = None
    overshoot_by_limit: bool = False
    contact_impulse: float | None = None
    contact_loss_J: float | None = None

    @property
    def met(self) -> bool:
        """Whether nothing is wrong with the run."""
        return not self.faults

    @property
    def reason(self) -> str:
        """The faults in words; empty if there is none."""
        return "; ".join(map(str, self.faults))

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of its faults."""
        return tuple(fault.kind for fault in self.faults)


@record
class Judge:
    """What is asked of one run, check after check: its figures, and a fault for each that is more than it may be."""

    figures: dict[str, Any] = field(default_factory=dict[str, Any])
    faults: list[Fault] = field(default_factory=list[Fault])

    def require(self, kind: str, value: float, most: float, text: str, unit: str = "", remedy: str = "") -> None:
        """Ask that a value is at most what is allowed; the text says what is wrong with one that is not."""
        if not value <= most:
            self.faults.append(Fault(kind=kind, text=text, value=value, limit=most, unit=unit, remedy=remedy))

    def refuse(self, kind: str, text: str, remedy: str = "") -> None:
        """Add a fault that has no figure, where there is a text."""
        self.require(kind, float(bool(text)), 0.0, text, remedy=remedy)

    @property
    def first(self) -> str:
        """What is wrong in the first place; empty where nothing is."""
        return str(self.faults[0]) if self.faults else ""


def take_ends(signal: Signal, ends: Sequence[int], length: int) -> Float[np.ndarray, "ends length"]:
    """Return the last samples of the phases of a run that end there, of which is judged what has settled."""
    return np.array([signal[end - length : end] for end in ends])


def find_saturated(command: Float[np.ndarray, "..."], limit: float) -> float:
    """Return the share of the samples at which a command is at its limit."""
    return float(np.mean(np.abs(command) >= limit * (1.0 - AT_LIMIT)))


@record(eq=False)
class _TraceRun:
    """One run of a trace."""

    rig: Rig
    scenario: Scenario
    trace: Playback
    index: int

    @property
    def regulated(self) -> str:
        """Name of the output that the law regulates."""
        return self.rig.controller.spec.regulated

    @property
    def unit(self) -> str:
        """Unit of that output."""
        return self.rig.controller.command.reference_unit

    @property
    def force(self) -> Signal:
        """The regulated output."""
        return self.trace.outputs[self.regulated][self.index]

    @property
    def step(self) -> float:
        """The last phase's reference."""
        return self.scenario.phases[-1].force_N

    @property
    def rest_force(self) -> float:
        """The force of the rest where the run started."""
        return 0.0 if self.trace.equilibrium is None else float(self.trace.equilibrium.force[self.index])

    @property
    def error(self) -> Signal:
        """Reference minus force, each relative to rest: a law without integrator rests at another reference."""
        start = self.trace.equilibrium
        offset = 0.0 if start is None or not self.scenario.about_rest else start.reference[self.index] - self.rest_force
        return self.trace.reference[self.index] - self.force - offset

    @property
    def response(self) -> Signal:
        """The force from rest over the last phase's reference."""
        return (self.force - self.rest_force) / self.step

    @property
    def largest(self) -> float:
        """The largest force over the last phase's reference, between samples too where the run rests at zero."""
        if self.rest_force:
            return float(np.max(np.abs(self.response)))
        return float(self.trace.peaks[self.regulated][self.index]) / abs(self.step)


def judge_run(
    rig: Rig,
    name: str,
    scenario: Scenario,
    trace: Playback,
    index: int,
    sets: Sequence[ParameterSet],
    twin: Playback,
    unlimited: Playback | None = None,
) -> Outcome:
    """Return the outcome of one run of a trace, played on the plant `name` with `sets`, nominal first. `twin` is the
    same scenario on `rig.ideal`; the trace itself where the rig is ideal. `unlimited` is that one without a current
    limit, where it `overshoots_at_limit`.
    """
    judge, drawn, nominal = Judge(), sets[index], sets[0]
    view = linearise_last_phase(rig, scenario, drawn)
    run = _TraceRun(rig=rig, scenario=scenario, trace=trace, index=index)
    ideal = replace(run, trace=twin)
    finite = all(np.all(np.isfinite(signal)) for signal in (run.force, trace.current[index], ideal.force))
    judge.refuse("overflow", "" if finite else "its numbers overflow")
    judge.refuse("unstable", view.instability)
    _judge_extremes(run, judge)
    _judge_rest(run, drawn, judge)
    if finite:
        if scenario.friction == "smooth" or scenario.settling_s is None:
            _judge_growth(ideal, judge)
        if not view.instability and twin is not trace:
            _judge_outbreak(run, ideal, view, judge)
        if scenario.quiet:
            _judge_oscillation(run, drawn, view, judge)
        if scenario.settling_s is not None:
            _judge_step(ideal, scenario.settling_s, judge, unlimited)
        _judge_final_error(run, ideal, judge)
    return Outcome(
        scenario=scenario.name,
        plant=name,
        draw=NOMINAL if index == 0 else str(index),
        faults=tuple(judge.faults),
        parameters=find_differences(drawn, nominal),
        **judge.figures,
    )


def find_differences(drawn: ParameterSet, nominal: ParameterSet) -> dict[str, float]:
    """Return the values of a draw that differ from the nominal ones."""
    return {
        name: each.value for name, each in drawn.items() if name not in nominal or each.value != nominal[name].value
    }


def _judge_extremes(run: _TraceRun, judge: Judge) -> None:
    scenario, trace, index, command = run.scenario, run.trace, run.index, run.rig.controller.command
    force = float(trace.peaks[run.regulated][index])
    angles = [float(trace.peaks[name][index]) for name, unit in run.rig.plant.outputs.items() if unit == "rad"]
    current, limit = float(np.max(np.abs(trace.current[index]))), run.rig.controller.command_limit
    most = largest_command(math.inf if limit is None else limit, run.rig.command_step)
    hardest = max(trace.contacts, key=lambda contact: abs(contact.impulse[index]), default=None)
    judge.figures.update(
        peak_force_N=force,
        peak_command=current,
        peak_angle_rad=max(angles) if angles else None,
        saturated=find_saturated(trace.current[index], most),
        peak_energy_J=float(trace.peaks[ENERGY][index]) if ENERGY in trace.peaks else None,
        contact_impulse=None if hardest is None else float(hardest.impulse[index]),
        contact_loss_J=None if hardest is None else float(hardest.loss_J[index]),
    )
    remedy = "a larger max_step_N, max_held or range_N in [controller.gate], or no agreement"
    judge.refuse("gate", "the gate takes a true reading for a fault" if trace.faulted[index] else "", remedy)
    text = f"the {command.word} reaches {command.show(current)}, above its limit of {command.show(most)}"
    judge.require("current", current, most * (1.0 + ABOVE_LIMIT), text, command.unit)
    for what, value, allowed, unit in (
        (run.regulated, force, scenario.max_force_N, run.unit),
        ("the angle", max(angles, default=0.0), scenario.max_angle_rad, "rad"),
    ):
        if allowed is not None:
            text = f"{what} reaches {value:.4g} {unit}, {allowed:g} {unit} are allowed"
            judge.require(f"peak of {what}", value, allowed, text, unit)
    for name, value in scenario.passes.items():
        output = trace.outputs[name][index]
        missed = max(np.nanmin(output) - value, value - np.nanmax(output))
        judge.require("no event", missed, 0.0, f"{name} never passes {value:g}, so that the scenario does not happen")


def _judge_rest(run: _TraceRun, drawn: ParameterSet, judge: Judge) -> None:
    """Check that the motor can hold the plant where the draw puts it at rest."""
    start, limit, command = run.trace.equilibrium, run.rig.controller.command_limit, run.rig.controller.command
    if start is None or limit is None:
        return
    takes = abs(float(start.rest_command[run.index]))
    where = format_values({name: drawn[name].value for name in run.rig.plant.states if name in drawn}, missing="")
    taken = command.show(float(start.rest_command[run.index]))
    text = f"to rest at {where} takes {taken}, above the limit of {command.show(limit)}"
    judge.require("rest", takes, limit * (1.0 + ABOVE_LIMIT), text, command.unit, remedy="narrow its range")


def _judge_growth(run: _TraceRun, judge: Judge) -> None:
    trace = run.trace
    if ENERGY in trace.outputs:
        base = (
            0.0 if trace.equilibrium is None or not run.scenario.about_rest else trace.equilibrium.energy_J[run.index]
        )
        level, what = trace.outputs[ENERGY][run.index] - base, "the energy"
    else:
        with np.errstate(over="ignore"):
            level = run.error**2
        what = f"the square of the error of {run.regulated}"
    level = np.abs(level[np.isfinite(level)])
    last = level[-(trace.edges[-1] - trace.edges[-2]) :]
    last = last[int(SETTLE * last.size) :]
    first, second = (float(np.max(half)) for half in np.array_split(last, 2))
    largest = float(np.max(level))
    growth = second / max(first, 1e-300) if second > ROUNDING * largest else 0.0
    judge.figures["energy_growth"] = growth
    text = f"{what} grows {growth:.3g} times while the reference is constant"
    judge.require("growth", second, GROWTH * first + GROWTH_FLOOR * largest, text)


def _judge_outbreak(run: _TraceRun, ideal: _TraceRun, view: LinearView, judge: Judge) -> None:
    """Check that noise does not set off a growing force error."""
    off, alone, last = np.abs(run.error), float(np.max(np.abs(ideal.error))), run.trace.last
    half = last.stop - (last.stop - last.start) // 2
    before, after = max(float(np.max(off[:half])), alone), float(np.max(off[half:]))
    end = f"{after:.4g} {run.unit} in the end, without noise by {alone:.4g} {run.unit}"
    most = OUTBREAK * before + OUTLIER * view.force_std()
    judge.require("outbreak", after, most, f"{run.regulated} is off by up to {end}", run.unit)


def _judge_oscillation(run: _TraceRun, drawn: ParameterSet, view: LinearView, judge: Judge) -> None:
    """Check that no oscillation lasts: a slow one in a long window, one whose phase noise moves in a short one."""
    rig, scenario = run.rig, run.scenario
    band, period = rig.controller.spec.bandwidth_hz, rig.controller.sample_time_s
    free = rig.plant.moves and not scenario.phases[-1].held
    # A window long enough for the slowest oscillation, and a short one, where noise moves fast phases less.
    last, slow = find_judged_window(run.trace), max(LEAST_WINDOW_S, LINE_PERIODS * SLOWEST / band)
    for length in (math.ceil(duration / period) for duration in (slow, slow / SHORTER)):
        window = slice(max(last.start, last.stop - length), last.stop)
        lasting = period * (window.stop - window.start)
        lowest = max(band / SLOWEST, LINE_PERIODS / lasting) if free else STILL_PERIODS / lasting
        floor = find_noise_floor(rig, float(run.trace.peaks[run.regulated][run.index]), view, lowest)
        if scenario.settling_s is not None:  # what creeps against friction is no pure exponential
            floor = max(floor, VISIBLE * abs(run.step))
        line = find_oscillation(run.force[window], period, floor=floor, lowest_hz=lowest)
        if line is None or (not line.growing and _swings_alone(run, drawn, line.frequency_hz)):
            continue
        if line.sustained or line.growing:
            judge.figures.update(limit_cycle_N=line.amplitude, limit_cycle_hz=line.frequency_hz)
            what = "sustains itself" if line.sustained else f"grows {line.growth:.3g} times"
            text = f"an oscillation of {line.amplitude:.3g} {run.unit} at {line.frequency_hz:.4g} Hz {what}"
            judge.require("oscillation", line.amplitude, 0.0, text, run.unit)
            return


def _swings_alone(run: _TraceRun, drawn: ParameterSet, frequency_hz: float) -> bool:
    """Tell whether a moving plant has a mode at a frequency while its joints stick, which no law can then damp."""
    if run.scenario.friction == "smooth" or not run.rig.plant.moves:
        return False
    modes = find_locked_modes(run.rig.plant, drawn)
    return bool(np.any(np.abs(modes / frequency_hz - 1.0) < SAME_FREQUENCY))


def find_judged_window(trace: Playback) -> slice:
    """Return the samples of the last phase that are searched for growth and oscillations."""
    last = trace.last
    return slice(last.start + int(SETTLE * (last.stop - last.start)), last.stop)


def find_noise_floor(rig: Rig, peak: float, view: LinearView, lowest_hz: float) -> float:
    """Return the amplitude (N) above a frequency that noise, quantisation and rounding make without an oscillation in a
    run's peak; of an unstable loop there is no telling what it makes of them.
    """
    rounding = 0.5 * rig.command_step / rig.controller.command.per_effort
    std, step = rig.reading_errors
    noise = 0.0 if view.instability else LINE_SIGMAS * view.force_std(lowest_hz)
    return max(2.0 * std + 1.5 * step + rounding, 1e-3 * peak, noise)


def overshoots_at_limit(rig: Rig, scenario: Scenario, trace: Playback) -> bool:
    """Tell whether a step overshoots further than is allowed in a run whose current reaches its limit."""
    limit, allowed = rig.controller.command_limit, scenario.max_overshoot
    if limit is None or allowed is None:
        return False
    at_limit = (index for index, current in enumerate(trace.current) if find_saturated(current, limit))
    runs = (_TraceRun(rig=rig, scenario=scenario, trace=trace, index=index) for index in at_limit)
    return any(run.largest > allowed for run in runs)


def _judge_step(run: _TraceRun, most_s: float, judge: Judge, unlimited: Playback | None) -> None:
    """Judge a step from rest by its largest force, between samples too, and by when it has settled."""
    last, largest, allowed = run.trace.last, run.largest, run.scenario.max_overshoot
    outside = np.flatnonzero(np.abs(run.response[last] - 1.0) > SETTLED)
    settled = outside.size == 0 or outside[-1] + 1 < last.stop - last.start
    samples = float(outside[-1] + 1 if outside.size else 0) if settled else math.inf
    settling_s = samples * run.rig.controller.sample_time_s
    judge.figures.update(overshoot=max(largest - 1.0, 0.0), settling_s=settling_s)
    step = f"a step of {run.step:.3g} {run.unit}"
    if allowed is not None and largest > allowed and unlimited is not None:
        judge.figures["overshoot_by_limit"] = replace(run, trace=unlimited).largest <= allowed
    if allowed is not None and not judge.figures.get("overshoot_by_limit"):
        over, most = (format_percent(share - 1.0) for share in (largest, allowed))
        remedy = SLOWER_INTEGRAL if run.scenario.friction == "sticking" else ""
        text = f"{step} overshoots by {over}, {most} are allowed"
        judge.require("overshoot", largest, allowed, text, remedy=remedy)
    when = f"after {settling_s:.4g} s" if settled else "not at all"
    judge.require("settling", settling_s, most_s, f"{step} settles {when}, {most_s:.4g} s are allowed", "s")


def _judge_final_error(run: _TraceRun, ideal: _TraceRun, judge: Judge) -> None:
    last, rig, most = run.trace.last, run.rig, run.scenario.final_error
    judged = max(1, (last.stop - last.start) // 5)
    error, alone = (float(np.mean(take_ends(each.error, [last.stop], judged))) for each in (run, ideal))
    judge.figures["final_error_N"] = error
    if most is None:
        return
    called, (noise, count) = rig.controller.command.mechanics, rig.reading_errors
    rounding = rig.command_step / rig.controller.command.per_effort
    spare = MEAN_SIGMAS * noise / math.sqrt(judged) + 0.5 * (count + rounding)
    noisy = not abs(error) <= most + spare
    value, allowed, what = (error, most + spare, "") if noisy else (alone, most, " without noise")
    side = "below" if value > 0.0 else "above"
    ends = f"the {called.word} ends {abs(value):.4g} {called.unit} {side} its reference{what}"
    text = f"{ends}, {allowed:.4g} {called.unit} are allowed"
    judge.require("steady error", abs(value), allowed, text, called.unit)
