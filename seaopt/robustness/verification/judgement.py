"""The judgement of each simulated run, for verification: its figures, and whether they are allowed.

A run passes if:

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
from dataclasses import field
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.codec import Key, OrInfinite, OrNaN
from seaopt.control.running.closed_loop import ENERGY
from seaopt.control.running.sampled_loop import largest_current
from seaopt.formatting import format_values
from seaopt.parameters import ParameterSet
from seaopt.plants.friction import find_locked_modes
from seaopt.records import Result, record
from seaopt.robustness.verification.linear import LinearView, linearise_last_phase
from seaopt.robustness.verification.oscillation import find_oscillation
from seaopt.robustness.verification.playback import Playback, Stage
from seaopt.robustness.verification.scenarios import SETTLED, Scenario

SETTLE = 0.2  # of the last phase, which is not judged
GROWTH, GROWTH_FLOOR = 1.05, 1e-3
OUTBREAK, OUTLIER = 2.0, 6.0
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
    """Something that a run is not allowed to do.

    Parameters
    ----------
    kind : str
        "overshoot", "settling", "steady error", "oscillation", "growth", ...: faults of one kind are one failure.
    text, remedy : str
        What happened, with figures, and what to do about it where that is particular.
    value, limit : float
        The figure and what is allowed, in `unit`.
    unit : str

    """

    kind: str
    text: str
    value: OrInfinite = 1.0
    limit: OrInfinite = 0.0
    unit: str = ""
    remedy: str = ""

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
    peak_force_N, peak_current_A : float
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
        Key(field="faults", name="findings"), "parameters", "peak_force_N", "peak_current_A", "saturated",
        "peak_angle_rad", "peak_energy_J", "energy_growth", "final_error_N", "limit_cycle_N", "limit_cycle_hz",
        "overshoot", "settling_s", "overshoot_by_limit", "contact_impulse", "contact_loss_J",
    )  # fmt: skip

    scenario: str
    plant: str
    draw: str
    faults: tuple[Fault, ...]
    parameters: Mapping[str, float]
    peak_force_N: OrInfinite
    peak_current_A: OrInfinite
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
        """What failed; empty if nothing did."""
        return "; ".join(map(str, self.faults))

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of its faults."""
        return tuple(fault.kind for fault in self.faults)


@record
class _Findings:
    """Figures of one run, as fields of an `Outcome`, and what is not allowed."""

    figures: dict[str, Any] = field(default_factory=dict[str, Any])
    faults: list[Fault] = field(default_factory=list[Fault])

    def add(self, kind: str, text: str, **figure: Any) -> None:
        """Add a fault, its figure as the fields of a `Fault`."""
        self.faults.append(Fault(kind=kind, text=text, **figure))


def judge_run(
    stage: Stage,
    name: str,
    scenario: Scenario,
    trace: Playback,
    run: int,
    sets: Sequence[ParameterSet],
    ideal: Playback | None = None,
    unlimited: Playback | None = None,
) -> Outcome:
    """Return the outcome of one run of a trace, played on the plant `name` with `sets`, nominal first.

    `ideal` is the same scenario on `stage.ideal`; the trace itself where the stage is ideal. `unlimited` is that one
    without a current limit, where it `overshoots_at_limit`.
    """
    findings, twin = _Findings(), trace if ideal is None else ideal
    view = linearise_last_phase(stage, scenario, sets[run])
    if view.instability:
        findings.add("unstable", view.instability)
    measured = stage.controller.spec.regulated
    force, current = trace.outputs[measured][run], trace.current[run]
    _judge_extremes(stage, scenario, trace, run, findings)
    _judge_rest(stage, trace, run, sets[run], findings)
    if all(np.all(np.isfinite(signal)) for signal in (force, current, twin.outputs[measured][run])):
        if scenario.friction == "smooth" or scenario.settling_s is None:
            _judge_growth(stage, scenario, twin, run, findings)
        if not view.instability:
            _judge_outbreak(stage, scenario, trace, twin, run, view, findings)
        _judge_oscillation(stage, scenario, trace, run, sets[run], view, findings)
        _judge_step(stage, scenario, twin, run, findings, unlimited)
        _judge_final_error(stage, scenario, trace, twin, run, findings)
    else:
        findings.faults.insert(0, Fault(kind="overflow", text="its numbers overflow"))
    return Outcome(
        scenario=scenario.name,
        plant=name,
        draw=NOMINAL if run == 0 else str(run),
        faults=tuple(findings.faults),
        parameters=_find_differences(sets[0], sets[run]),
        **findings.figures,
    )


def _judge_extremes(stage: Stage, scenario: Scenario, trace: Playback, run: int, findings: _Findings) -> None:
    controller, plant = stage.controller, stage.plant
    force = float(trace.peaks[controller.spec.regulated][run])
    angles = [float(trace.peaks[name][run]) for name, unit in plant.outputs.items() if unit == "rad"]
    current, limit = np.abs(trace.current[run]), controller.command_limit
    most = largest_current(math.inf if limit is None else limit, stage.current_step_A)
    hardest = max(trace.contacts, key=lambda contact: abs(contact.impulse[run]), default=None)
    findings.figures.update(
        peak_force_N=force,
        peak_current_A=float(np.max(current)),
        peak_angle_rad=max(angles) if angles else None,
        saturated=float(np.mean(current >= most * (1 - 1e-9))),
        peak_energy_J=float(trace.peaks[ENERGY][run]) if ENERGY in trace.peaks else None,
        contact_impulse=None if hardest is None else float(hardest.impulse[run]),
        contact_loss_J=None if hardest is None else float(hardest.loss_J[run]),
    )
    if np.max(current) > most * (1 + 1e-9):
        findings.add(
            "current",
            f"the {controller.command.word} reaches {controller.command.show(np.max(current))}, above its limit of "
            f"{controller.command.show(most)}",
        )
    for what, value, allowed, unit in (
        (controller.spec.regulated, force, scenario.max_force_N, controller.command.reference_unit),
        ("the angle", max(angles, default=0.0), scenario.max_angle_rad, "rad"),
    ):
        if allowed is not None and not value <= allowed:
            findings.add(f"peak of {what}", f"{what} reaches {value:.4g} {unit}, {allowed:g} {unit} are allowed")
    for name, value in scenario.passes.items():
        reached = trace.outputs[name][run]
        if not np.nanmin(reached) <= value <= np.nanmax(reached):
            findings.add("no event", f"{name} never passes {value:g}, so that the scenario does not happen")


def _judge_rest(stage: Stage, trace: Playback, run: int, drawn: ParameterSet, findings: _Findings) -> None:
    """Check that the motor can hold the plant where the draw puts it at rest."""
    limit, show = stage.controller.command_limit, stage.controller.command.show
    if trace.rest is None or limit is None or abs(trace.rest.current_A[run]) <= limit * (1 + 1e-9):
        return
    where = format_values({name: drawn[name].value for name in stage.plant.states if name in drawn}, missing="")
    findings.add(
        "rest",
        f"to rest at {where} takes {show(trace.rest.current_A[run])}, above the limit of {show(limit)}",
        remedy="narrow its range",
    )


def _judge_growth(stage: Stage, scenario: Scenario, trace: Playback, run: int, findings: _Findings) -> None:
    if ENERGY in trace.outputs:
        base = 0.0 if trace.rest is None or not scenario.about_rest else trace.rest.energy_J[run]
        level, what = trace.outputs[ENERGY][run] - base, "the energy"
    else:
        name = stage.controller.spec.regulated
        with np.errstate(over="ignore"):
            level = _error(scenario, trace, run, trace.outputs[name][run]) ** 2
        what = f"the square of the error of {name}"
    level = np.abs(level[np.isfinite(level)])
    last = level[-(trace.edges[-1] - trace.edges[-2]) :]
    last = last[int(SETTLE * last.size) :]
    first, second = (float(np.max(half)) for half in np.array_split(last, 2))
    findings.figures["energy_growth"] = second / max(first, 1e-300)
    if second > GROWTH * first + GROWTH_FLOOR * float(np.max(level)):
        findings.add("growth", f"{what} grows {second / max(first, 1e-300):.3g} times while the reference is constant")


def _judge_outbreak(
    stage: Stage, scenario: Scenario, trace: Playback, twin: Playback, run: int, view: LinearView, findings: _Findings
) -> None:
    """Check that noise does not set off a growing force error."""
    if twin is trace:
        return
    name = stage.controller.spec.regulated
    off, alone = (np.abs(_error(scenario, one, run, one.outputs[name][run])) for one in (trace, twin))
    half = trace.last.stop - (trace.last.stop - trace.last.start) // 2
    before, after = max(float(np.max(off[:half])), float(np.max(alone))), float(np.max(off[half:]))
    allowed = OUTBREAK * before + OUTLIER * view.force_std()
    if not after <= allowed:
        unit = stage.controller.command.reference_unit
        end = f"{after:.4g} {unit} in the end, without noise by {np.max(alone):.4g} {unit}"
        findings.add("outbreak", f"{name} is off by up to {end}")


def _judge_oscillation(
    stage: Stage,
    scenario: Scenario,
    trace: Playback,
    run: int,
    drawn: ParameterSet,
    view: LinearView,
    findings: _Findings,
) -> None:
    """Check that no oscillation lasts: a slow one in a long window, one whose phase noise moves in a short one."""
    spec, period = stage.controller.spec, stage.controller.sample_time_s
    if not scenario.quiet:
        return
    free = stage.plant.moves and not scenario.phases[-1].held
    for window in _find_windows(stage, trace):
        lasting = period * (window.stop - window.start)
        lowest = max(spec.bandwidth_hz / SLOWEST, LINE_PERIODS / lasting) if free else STILL_PERIODS / lasting
        floor = find_noise_floor(stage, float(trace.peaks[spec.regulated][run]))
        if scenario.settling_s is not None:  # what creeps against friction is no pure exponential
            floor = max(floor, VISIBLE * abs(scenario.phases[-1].force_N))
        if not view.instability:
            floor = max(floor, LINE_SIGMAS * view.force_std(lowest))
        line = find_oscillation(trace.outputs[spec.regulated][run][window], period, floor=floor, lowest_hz=lowest)
        if line is not None and not line.growing and _swings_alone(stage, scenario, drawn, line.frequency_hz):
            continue
        if line is not None and (line.sustained or line.growing):
            findings.figures.update(limit_cycle_N=line.amplitude, limit_cycle_hz=line.frequency_hz)
            what = "sustains itself" if line.sustained else f"grows {line.growth:.3g} times"
            unit = stage.controller.command.reference_unit
            text = f"an oscillation of {line.amplitude:.3g} {unit} at {line.frequency_hz:.4g} Hz {what}"
            findings.add("oscillation", text, value=line.amplitude, unit=unit)
            return


def _swings_alone(stage: Stage, scenario: Scenario, drawn: ParameterSet, frequency_hz: float) -> bool:
    """Tell whether a moving plant has a mode at a frequency while its joints stick, which no law can then damp."""
    if scenario.friction == "smooth" or not stage.plant.moves:
        return False
    modes = find_locked_modes(stage.plant, drawn)
    return bool(np.any(np.abs(modes / frequency_hz - 1.0) < SAME_FREQUENCY))


def find_judged_window(trace: Playback) -> slice:
    """Return the samples of the last phase that are searched for growth and oscillations."""
    last = trace.last
    return slice(last.start + int(SETTLE * (last.stop - last.start)), last.stop)


def _find_windows(stage: Stage, trace: Playback) -> tuple[slice, slice]:
    """Return a window long enough for the slowest oscillation, and a short one, where noise moves fast phases less."""
    last, controller = find_judged_window(trace), stage.controller
    slow = max(LEAST_WINDOW_S, LINE_PERIODS * SLOWEST / controller.spec.bandwidth_hz)
    lengths = (math.ceil(duration / controller.sample_time_s) for duration in (slow, slow / SHORTER))
    long, short = (slice(max(last.start, last.stop - length), last.stop) for length in lengths)
    return long, short


def find_noise_floor(stage: Stage, peak: float) -> float:
    """Return the amplitude (N) that noise, quantisation and rounding make without an oscillation in a run's peak."""
    rounding = 0.5 * stage.current_step_A / stage.controller.command.per_effort
    std, step = stage.reading_errors
    noise = 2.0 * std + 1.5 * step
    return max(noise + rounding, 1e-3 * peak)


def overshoots_at_limit(stage: Stage, scenario: Scenario, trace: Playback) -> bool:
    """Tell whether a step overshoots further than is allowed in a run whose current reaches its limit."""
    limit, allowed = stage.controller.command_limit, scenario.max_overshoot
    if limit is None or allowed is None:
        return False
    at_limit = np.max(np.abs(trace.current), axis=1) >= limit * (1 - 1e-9)
    return any(_find_peak(stage, scenario, trace, int(run)) > allowed for run in np.flatnonzero(at_limit))


def _respond(stage: Stage, scenario: Scenario, trace: Playback, run: int) -> Float[np.ndarray, " n"]:
    """Return the force from rest over the last phase's reference."""
    rest = 0.0 if trace.rest is None else float(trace.rest.force[run])
    return (trace.outputs[stage.controller.spec.regulated][run] - rest) / scenario.phases[-1].force_N


def _find_peak(stage: Stage, scenario: Scenario, trace: Playback, run: int) -> float:
    """Return the largest force over the last phase's reference, between samples too where the run rests at zero."""
    if trace.rest is not None and trace.rest.force[run]:
        return float(np.max(np.abs(_respond(stage, scenario, trace, run))))
    return float(trace.peaks[stage.controller.spec.regulated][run]) / abs(scenario.phases[-1].force_N)


def _judge_step(
    stage: Stage, scenario: Scenario, trace: Playback, run: int, findings: _Findings, unlimited: Playback | None
) -> None:
    """Judge a step from rest by its largest force, between samples too, and by when it has settled."""
    if scenario.settling_s is None:
        return
    step, last, unit = scenario.phases[-1].force_N, trace.last, stage.controller.command.reference_unit
    response, largest = _respond(stage, scenario, trace, run), _find_peak(stage, scenario, trace, run)
    outside = np.flatnonzero(np.abs(response[last] - 1.0) > SETTLED)
    settled = outside.size == 0 or outside[-1] + 1 < last.stop - last.start
    settling_s = float(outside[-1] + 1 if outside.size else 0) * stage.controller.sample_time_s if settled else math.inf
    findings.figures.update(overshoot=max(largest - 1.0, 0.0), settling_s=settling_s)
    allowed = scenario.max_overshoot
    if allowed is not None and largest > allowed:
        by_limit = unlimited is not None and _find_peak(stage, scenario, unlimited, run) <= allowed
        findings.figures.update(overshoot_by_limit=by_limit)
        if not by_limit:
            over, most = (f"{100.0 * (share - 1.0):.3g} %" for share in (largest, allowed))
            text = f"a step of {step:.3g} {unit} overshoots by {over}, {most} are allowed"
            remedy = SLOWER_INTEGRAL if scenario.friction == "sticking" else ""
            findings.add("overshoot", text, value=largest, limit=allowed, remedy=remedy)
    if settling_s > scenario.settling_s:
        when = f"after {settling_s:.4g} s" if settled else "not at all"
        text = f"a step of {step:.3g} {unit} settles {when}, {scenario.settling_s:.4g} s are allowed"
        findings.add("settling", text, value=settling_s, limit=scenario.settling_s, unit="s")


def _judge_final_error(
    stage: Stage, scenario: Scenario, trace: Playback, twin: Playback, run: int, findings: _Findings
) -> None:
    last, name, called = trace.last, stage.controller.spec.regulated, stage.controller.command.mechanics
    end = slice(last.stop - max(1, (last.stop - last.start) // 5), last.stop)
    error, alone = (float(np.mean(_error(scenario, one, run, one.outputs[name][run])[end])) for one in (trace, twin))
    findings.figures["final_error_N"] = error
    (noise, count), rounding = stage.reading_errors, stage.current_step_A / stage.controller.command.per_effort
    spare = MEAN_SIGMAS * noise / math.sqrt(end.stop - end.start) + 0.5 * (count + rounding)
    for value, more, what in ((error, spare, ""), (alone, 0.0, " without noise")):
        if scenario.final_error is not None and not abs(value) <= scenario.final_error + more:
            allowed = scenario.final_error + more
            side = "below" if value > 0.0 else "above"
            word, unit = called.word, called.unit
            text = (
                f"the {word} ends {abs(value):.4g} {unit} {side} its reference{what}, {allowed:.4g} {unit} are allowed"
            )
            findings.add("steady error", text, value=abs(value), limit=allowed, unit=unit)
            return


def _error(scenario: Scenario, trace: Playback, run: int, force: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return reference minus force, each relative to rest: a law without integrator rests at another reference."""
    at_rest = (
        0.0 if trace.rest is None or not scenario.about_rest else trace.rest.reference[run] - trace.rest.force[run]
    )
    return trace.reference[run] - force - at_rest


def _find_differences(nominal: ParameterSet, drawn: ParameterSet) -> dict[str, float]:
    return {name: p.value for name, p in drawn.items() if name not in nominal or p.value != nominal[name].value}
