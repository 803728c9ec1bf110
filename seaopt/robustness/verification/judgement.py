"""Whether what a run showed is allowed.

What every run is judged by:

- it stays finite, and the current within the limit: the last whole step of the amplifier within it;
- the linear loop of the last phase is stable (`linear`). An unstable one may still settle by luck, on a step of the
  sensor or because the scenario does not move what grows;
- nothing grows without noise: the run is played again on a sensor and an amplifier that only have a range. In its last
  phase, where the reference is constant, the largest energy of the second half (after a fifth of settling) is no more
  than that of the first, with 5 % and a thousandth of the whole run's to spare. With the force held, the loop works on
  the link like a constant force, which is conservative: over a swing the energy of link and actuator comes back to
  where it was, unless the loop feeds it. Where a plant declares no energy, the square of the force's error stands for
  it. What counts is the energy above or below that of the rest where the run started. This sees growth within seconds;
  a mode that takes minutes is seen by the eigenvalues. Noise itself moves energy up and down, more than 5 %, which is
  no growth;
- noise does not set off what would not grow without: in the second half the force is off by no more than twice what it
  was before, with or without noise, and six standard deviations of what noise makes in the linear loop;
- no oscillation sustains itself in the last phase (`oscillation`), above what noise and quantisation make. Where a link
  moves, slower ones than a tenth of the bandwidth are not looked at: an undamped link that swings is its own business;
- the limits of the scenario: the final error, a mean, with four of its standard deviations of noise to spare, and
  without noise with none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.control.running.closed_loop import ENERGY
from seaopt.control.running.sampled_loop import largest_current
from seaopt.parameters import ParameterSet
from seaopt.records import record
from seaopt.robustness.verification.linear import LinearView, linear_view
from seaopt.robustness.verification.oscillation import find_oscillation
from seaopt.robustness.verification.playback import Stage, Trace
from seaopt.robustness.verification.scenarios import Scenario

SETTLE = 0.2  # of the last phase, before it is judged
GROWTH, GROWTH_FLOOR = 1.05, 1e-3
OUTBREAK, OUTLIER = 2.0, 6.0
LINE = 4.0  # standard deviations of noise that a line in the spectrum stays below: its amplitude is Rayleigh's
MEAN = 4.0  # standard deviations of a mean
WINDOW_S = 3.0
SLOWER, PERIODS = 10.0, 8.0  # how far below the bandwidth oscillations are looked for, and how many periods of them
SHORTER = 4.0
STILL_PERIODS = 4.0  # where no link moves: the slowest that a window tells from a drift
NOMINAL = "nominal"


@record
class Outcome:
    """One scenario on one plant at one set of parameters.

    Parameters
    ----------
    scenario, plant, draw : str
        `draw` is "nominal" or the number of a draw, from 1.
    passed : bool
    reason : str
        What failed; empty if nothing did.
    parameters : mapping of name to float
        Where the draw differs from nominal: with scenario, plant and seed, the witness.
    peak_force_N, peak_current_A : float
        Of the measured output (in its unit), between samples too, and of the command.
    saturated : float
        Share of the samples at the current limit.
    peak_angle_rad : float or None
        Of the plant's angles.
    peak_energy_J, energy_growth : float or None
        Largest energy; largest of the last phase's second half over that of its first.
    final_error_N : float or None
        Mean of reference minus force over the last fifth of the last phase.
    limit_cycle_N, limit_cycle_hz : float or None
        Amplitude and frequency of an oscillation that does not die out.
    contact_impulse, contact_loss_J : float or None
        Of the hardest contact: what stops the link along its coordinate, and the energy lost.

    """

    scenario: str
    plant: str
    draw: str
    passed: bool
    reason: str
    parameters: Mapping[str, float]
    peak_force_N: float
    peak_current_A: float
    saturated: float
    peak_angle_rad: float | None = None
    peak_energy_J: float | None = None
    energy_growth: float | None = None
    final_error_N: float | None = None
    limit_cycle_N: float | None = None
    limit_cycle_hz: float | None = None
    contact_impulse: float | None = None
    contact_loss_J: float | None = None


@record
class _Findings:
    """What one run showed, as figures of an `Outcome`, and sentences on what is not allowed."""

    figures: dict[str, Any] = field(default_factory=dict[str, Any])
    faults: list[str] = field(default_factory=list[str])


def judged(
    stage: Stage, name: str, scenario: Scenario, trace: Trace, run: int, sets: Sequence[ParameterSet],
    ideal: Trace | None = None,
) -> Outcome:  # fmt: skip
    """Return the outcome of one run of a trace, played on the plant `name` with `sets`, nominal first.

    `ideal` is the same scenario on `stage.ideal`; the trace itself where the stage is ideal.
    """
    found, twin = _Findings(), trace if ideal is None else ideal
    view = linear_view(stage, scenario, sets[run])
    if view.instability:
        found.faults.append(view.instability)
    measured = stage.controller.spec.measured
    force, current = trace.outputs[measured][run], trace.current[run]
    _extremes(stage, scenario, trace, run, found)
    _resting(stage, trace, run, sets[run], found)
    if all(np.all(np.isfinite(item)) for item in (force, current, twin.outputs[measured][run])):
        _growth(stage, scenario, twin, run, found)
        if not view.instability:
            _outbreak(stage, scenario, trace, twin, run, view, found)
        _ringing(stage, scenario, trace, run, view, found)
        _ending(stage, scenario, trace, twin, run, found)
    else:
        found.faults.insert(0, "it leaves what numbers can hold")
    return Outcome(
        scenario=scenario.name, plant=name, draw=NOMINAL if run == 0 else str(run), passed=not found.faults,
        reason="; ".join(found.faults), parameters=_difference(sets[0], sets[run]),
        **found.figures,
    )  # fmt: skip


def _extremes(stage: Stage, scenario: Scenario, trace: Trace, run: int, found: _Findings) -> None:
    controller, plant = stage.controller, stage.plant
    force = float(trace.peaks[controller.spec.measured][run])
    angles = [float(trace.peaks[name][run]) for name, unit in plant.outputs.items() if unit == "rad"]
    current, limit = np.abs(trace.current[run]), controller.spec.current_limit_A
    most = largest_current(math.inf if limit is None else limit, stage.current_step_A)
    hits = trace.contacts
    hardest = max(hits, key=lambda item: abs(item.impulse[run]), default=None)
    found.figures.update(
        peak_force_N=force,
        peak_current_A=float(np.max(current)),
        peak_angle_rad=max(angles) if angles else None,
        saturated=float(np.mean(current >= most * (1 - 1e-9))),
        peak_energy_J=float(trace.peaks[ENERGY][run]) if ENERGY in trace.peaks else None,
        contact_impulse=None if hardest is None else float(hardest.impulse[run]),
        contact_loss_J=None if hardest is None else float(hardest.loss_J[run]),
    )
    if np.max(current) > most * (1 + 1e-9):
        found.faults.append(f"the current reaches {np.max(current):.4g} A, above its limit of {most:.4g} A")
    for what, value, allowed, unit in (
        (controller.spec.measured, force, scenario.max_force_N, "N"),
        ("the angle", max(angles, default=0.0), scenario.max_angle_rad, "rad"),
    ):
        if allowed is not None and not value <= allowed:
            found.faults.append(f"{what} reaches {value:.4g} {unit}, {allowed:g} {unit} are allowed")
    for name, value in scenario.passes.items():
        reached = trace.outputs[name][run]
        if not np.nanmin(reached) <= value <= np.nanmax(reached):
            found.faults.append(f"{name} never passes {value:g}, so that the scenario shows nothing")


def _resting(stage: Stage, trace: Trace, run: int, drawn: ParameterSet, found: _Findings) -> None:
    """Find whether the motor can hold the plant where the draw wants it to rest."""
    limit = stage.controller.spec.current_limit_A
    if trace.rest is None or limit is None or abs(trace.rest.current_A[run]) <= limit * (1 + 1e-9):
        return
    where = ", ".join(f"{name} = {drawn[name].value:.4g}" for name in stage.plant.states if name in drawn)
    found.faults.append(
        f"to rest at {where} takes {trace.rest.current_A[run]:.4g} A, above the limit of {limit:g} A; narrow its range"
    )


def _growth(stage: Stage, scenario: Scenario, trace: Trace, run: int, found: _Findings) -> None:
    if ENERGY in trace.outputs:
        base = 0.0 if trace.rest is None or not scenario.about_rest else trace.rest.energy_J[run]
        level, what = trace.outputs[ENERGY][run] - base, "the energy"
    else:
        name = stage.controller.spec.measured
        with np.errstate(over="ignore"):
            level = _error(scenario, trace, run, trace.outputs[name][run]) ** 2
        what = f"the square of the error of {name}"
    level = np.abs(level[np.isfinite(level)])
    last = level[-(trace.edges[-1] - trace.edges[-2]) :]
    last = last[int(SETTLE * last.size) :]
    first, second = (float(np.max(half)) for half in np.array_split(last, 2))
    found.figures["energy_growth"] = second / max(first, 1e-300)
    if second > GROWTH * first + GROWTH_FLOOR * float(np.max(level)):
        found.faults.append(f"{what} grows {second / max(first, 1e-300):.3g} times while the reference is constant")


def _outbreak(
    stage: Stage, scenario: Scenario, trace: Trace, twin: Trace, run: int, view: LinearView, found: _Findings
) -> None:
    """Find a force that runs away under noise alone."""
    if twin is trace:
        return
    name = stage.controller.spec.measured
    off, alone = (np.abs(_error(scenario, item, run, item.outputs[name][run])) for item in (trace, twin))
    half = trace.last.stop - (trace.last.stop - trace.last.start) // 2
    before, after = max(float(np.max(off[:half])), float(np.max(alone))), float(np.max(off[half:]))
    allowed = OUTBREAK * before + OUTLIER * view.force_std()
    if not after <= allowed:
        found.faults.append(f"{name} is off by up to {after:.4g} N in the end, without noise by {np.max(alone):.4g} N")


def _ringing(
    stage: Stage, scenario: Scenario, trace: Trace, run: int, view: LinearView, found: _Findings
) -> None:  # fmt: skip
    """Find an oscillation that lasts: a slow one in a long window, one whose phase noise moves in a short one."""
    spec, period = stage.controller.spec, stage.controller.sample_time_s
    if not scenario.quiet:
        return
    free = stage.plant.moves and not scenario.phases[-1].held
    for window in _windows(stage, trace):
        lasting = period * (window.stop - window.start)
        lowest = max(spec.bandwidth_hz / SLOWER, PERIODS / lasting) if free else STILL_PERIODS / lasting
        floor = _floor(stage, trace, run)
        if not view.instability:
            floor = max(floor, LINE * view.force_std(lowest))
        seen = find_oscillation(trace.outputs[spec.measured][run][window], period, floor=floor, lowest_hz=lowest)
        if seen is not None and (seen.sustained or seen.growing):
            found.figures.update(limit_cycle_N=seen.amplitude, limit_cycle_hz=seen.frequency_hz)
            what = "sustains itself" if seen.sustained else f"grows {seen.growth:.3g} times"
            found.faults.append(f"an oscillation of {seen.amplitude:.3g} N at {seen.frequency_hz:.4g} Hz {what}")
            return


def judged_window(trace: Trace) -> slice:
    """Return the samples of the last phase that growth and oscillations are looked for in."""
    last = trace.last
    return slice(last.start + int(SETTLE * (last.stop - last.start)), last.stop)


def _windows(stage: Stage, trace: Trace) -> tuple[slice, slice]:
    last, controller = judged_window(trace), stage.controller
    slow = max(WINDOW_S, PERIODS * SLOWER / controller.spec.bandwidth_hz)
    found = (max(last.start, last.stop - math.ceil(item / controller.sample_time_s)) for item in (slow, slow / SHORTER))
    long, short = (slice(start, last.stop) for start in found)
    return long, short


def _floor(stage: Stage, trace: Trace, run: int) -> float:
    """Return the amplitude (N) that noise, quantisation and rounding make by themselves."""
    name, sensors = stage.controller.spec.measured, stage.sensors
    rounding = 0.5 * stage.current_step_A / stage.controller.command.per_effort
    noise = 2.0 * sensors.noise_std.get(name, 0.0) + 1.5 * sensors.quantisation.get(name, 0.0)
    return max(noise + rounding, 1e-3 * float(trace.peaks[name][run]))


def _ending(stage: Stage, scenario: Scenario, trace: Trace, twin: Trace, run: int, found: _Findings) -> None:
    last, name = trace.last, stage.controller.spec.measured
    end = slice(last.stop - max(1, (last.stop - last.start) // 5), last.stop)
    error, alone = (float(np.mean(_error(scenario, item, run, item.outputs[name][run])[end])) for item in (trace, twin))
    found.figures["final_error_N"] = error
    spare = MEAN * stage.sensors.noise_std.get(name, 0.0) / math.sqrt(end.stop - end.start)
    for value, more, what in ((error, spare, ""), (alone, 0.0, " without noise")):
        if scenario.final_error is not None and not abs(value) <= scenario.final_error + more:
            allowed = scenario.final_error + more
            found.faults.append(f"the force ends {value:.4g} N off{what}, {allowed:.4g} N are allowed")
            return


def _error(scenario: Scenario, trace: Trace, run: int, force: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return reference minus force, each counted from rest: a law without integrator rests at another reference."""
    at_rest = (
        0.0 if trace.rest is None or not scenario.about_rest else trace.rest.reference[run] - trace.rest.force[run]
    )
    return trace.reference[run] - force - at_rest


def _difference(nominal: ParameterSet, drawn: ParameterSet) -> dict[str, float]:
    return {
        name: item.value for name, item in drawn.items() if name not in nominal or item.value != nominal[name].value
    }
