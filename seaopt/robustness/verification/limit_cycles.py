"""Limit cycles of friction and of play, looked for by simulation, for the certificate.

A cycle that the describing function predicts is started from: the plant in the predicted state, pushed beyond it, law
and commands at rest, a reference of zero. What is left after many periods has found itself, whatever was predicted.

Of predictive control the cycles are predicted of its linear region, and played with its own step: beyond the limits of
the plan, which a cycle or the push may reach, it is no linear law.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from seaopt.control import Controller, ForceMPC
from seaopt.control.laws.friction import LimitCycle, predict_limit_cycles
from seaopt.control.laws.realisation import runnable
from seaopt.control.running.closed_loop import at_rest, run_loop
from seaopt.errors import RunawayError, SimulationError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.verification.judgement import NOMINAL
from seaopt.robustness.verification.oscillation import STEADY, find_oscillation
from seaopt.robustness.verification.play_cycles import predict_play_cycles
from seaopt.robustness.verification.playback import run_plan
from seaopt.robustness.verification.scenarios import build_loop
from seaopt.robustness.verification.verification import Verification
from seaopt.units import LINEAR

PUSH = 1.5  # times the predicted cycle, where a run starts
PERIODS, LEAST_S, LONGEST_S = 60.0, 1.0, 30.0  # of the predicted cycle, that a run lasts
JUDGED = 0.4  # of a run, at its end
FLOOR = 0.05  # of the predicted force: a smaller oscillation is one that dies out


@record
class SimulatedCycle:
    """The oscillation that a simulation ends in: amplitude of the measured output and frequency."""

    force_N: float
    frequency_hz: float


@record
class FoundCycle:
    """A limit cycle: predicted, and what the simulation that starts there does."""

    predicted: LimitCycle | None  # by the describing function; None where only a simulation found it
    simulated: SimulatedCycle | None = None  # None where it dies out, runs away or is not simulated
    runs_away: bool = False  # the simulated oscillation grows without end
    found_by: str = "there"  # where the simulation started: there, or with which step
    not_simulated: str | None = None  # why there is no simulation
    unit: str = LINEAR.unit  # of the amplitudes: N, or N m

    @property
    def lasts(self) -> bool:
        """Whether it keeps oscillating: as simulated or, where that failed, as a stable cycle is predicted to."""
        if self.not_simulated:
            return self.predicted is not None and self.predicted.stable
        return self.simulated is not None or self.runs_away

    @property
    def force_N(self) -> float:
        """Amplitude of what lasts: as simulated, without end, or as predicted where there is no simulation."""
        if self.not_simulated and self.predicted is not None:
            return self.predicted.force_N
        return math.inf if self.simulated is None else self.simulated.force_N

    def __str__(self) -> str:
        prediction = ""
        if self.predicted is not None:
            kind = "a stable" if self.predicted.stable else "an unstable"
            prediction = f"the describing function predicts {kind} oscillation of {self._size(self.predicted)}; "
        if self.not_simulated:
            return f"{prediction}its simulation failed: {self.not_simulated}"
        if self.simulated is not None:
            return f"{prediction}simulated from {self.found_by}: {self._size(self.simulated)}"
        return f"{prediction}simulated from {self.found_by} it {'grows without end' if self.runs_away else 'dies out'}"

    def _size(self, cycle: LimitCycle | SimulatedCycle) -> str:
        return f"{cycle.force_N:.3g} {self.unit} at {cycle.frequency_hz:.3g} Hz"


def seek_limit_cycles(
    controller: Controller, plant: Plant, params: ParameterSet, *, shown: bool = False, plan: ForceMPC | None = None
) -> tuple[FoundCycle, ...]:
    """Return the limit cycles that friction, unless stability is shown, and play may make, at rest at zero. They are
    predicted and simulated; a prediction whose simulation fails stands alone, with the reason. `plan`: predictive
    control, whose linear region the controller is.
    """
    predicted = () if shown else predict_limit_cycles(controller, plant, params)
    predicted += predict_play_cycles(controller, plant, params)
    unit = controller.command.reference_unit
    return tuple(replace(_simulate(controller, plant, params, cycle, plan), unit=unit) for cycle in predicted)


def list_step_cycles(runs: Verification, plant: str) -> tuple[FoundCycle, ...]:
    """Return the oscillations that steps on a plant end in, at its nominal parameters."""
    return tuple(
        FoundCycle(
            predicted=None,
            simulated=SimulatedCycle(force_N=row.limit_cycle_N, frequency_hz=row.limit_cycle_hz),
            found_by=f"the {row.scenario}",
            unit=runs.mechanics.unit,
        )
        for row in runs.rows
        if row.plant == plant and row.draw == NOMINAL
        if row.limit_cycle_N is not None and row.limit_cycle_hz is not None
    )


def _simulate(
    controller: Controller, plant: Plant, params: ParameterSet, cycle: LimitCycle, plan: ForceMPC | None
) -> FoundCycle:
    """Return what a run that starts beyond a predicted cycle ends in."""
    period = controller.sample_time_s
    lasting = min(max(PERIODS / cycle.frequency_hz, LEAST_S), LONGEST_S)
    values = plant.complete(controller.delay(params)).drop_conditions()
    begin, still = PUSH * np.array(cycle.state), np.zeros(math.ceil(lasting / period))
    try:
        # A gate that gives its sensor up ends a cycle, which would pass for one that does not last.
        if plan is not None:
            force = run_plan(replace(plan, gate=None), plant, values, still, [], start_state=begin).force
        else:
            loop = build_loop(controller, plant, [values], runnable(controller, gate=False, outer=True))
            run = run_loop(loop, [values], still, start=at_rest(loop, 1, begin))
            force = run.outputs[controller.spec.regulated][0]
    except SimulationError as error:
        return FoundCycle(predicted=cycle, not_simulated=str(error))
    except RunawayError:
        return FoundCycle(predicted=cycle, runs_away=True)
    if not np.all(np.isfinite(force)):
        return FoundCycle(predicted=cycle, runs_away=True)
    end = force[-int(JUDGED * force.size) :]
    line = find_oscillation(end, period, floor=FLOOR * cycle.force_N, lowest_hz=0.3 * cycle.frequency_hz)
    if line is None or not line.sustained:
        first, last = (float(np.max(np.abs(half))) for half in np.array_split(end, 2))
        growing = (line is not None and line.growing) or last > max(STEADY * first, cycle.force_N)  # though no line
        return FoundCycle(predicted=cycle, runs_away=growing)
    simulated = SimulatedCycle(force_N=line.amplitude, frequency_hz=line.frequency_hz)
    return FoundCycle(predicted=cycle, simulated=simulated)
