"""Limit cycles of friction and of play, looked for by simulation, for the certificate.

A cycle that the describing function predicts is started from: the plant in the predicted state, pushed beyond it, law
and commands at rest, a reference of zero. What is left after many periods has found itself, whatever was predicted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from seaopt.codec import from_content
from seaopt.control import Controller
from seaopt.control.laws.limit_cycles import LimitCycle, predict_limit_cycles
from seaopt.control.laws.realisation import runnable
from seaopt.control.running.closed_loop import SampledLoop, at_rest, run_loop
from seaopt.control.running.sampled_loop import find_longest_delay
from seaopt.errors import SimulationError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.verification.judgement import NOMINAL
from seaopt.robustness.verification.oscillation import find_oscillation
from seaopt.robustness.verification.play_cycles import predict_play_cycles
from seaopt.robustness.verification.verification import Verification
from seaopt.units import LINEAR

PUSH = 1.5  # times the predicted cycle, where a run starts
PERIODS, LEAST_S, LONGEST_S = 60.0, 1.0, 30.0  # of the predicted cycle, that a run lasts
JUDGED = 0.4  # of a run, at its end
FLOOR = 0.05  # of the predicted force: a smaller oscillation is one that dies out


@record
class _StoredCycle:
    """What a file has of a limit cycle."""

    predicted: LimitCycle | None
    simulated: Mapping[str, float] | None
    runs_away: bool
    found_by: str
    not_simulated: str | None
    unit: str = LINEAR.unit


@record
class FoundCycle:
    """A limit cycle: predicted, and what the simulation that starts there does.

    Parameters
    ----------
    predicted : LimitCycle or None
        By the describing function; None where only a simulation found it.
    simulated_N, simulated_hz : float or None
        Amplitude of the measured output and frequency of what remains; None where it dies out.
    runs_away : bool
        The simulated oscillation grows without end.
    not_simulated : str
        Why there is no simulation; empty where there is one.
    found_by : str
        Where the simulation started: there, or with which step.
    unit : str
        Of the amplitudes: N, or N m.

    """

    predicted: LimitCycle | None
    simulated_N: float | None
    simulated_hz: float | None
    runs_away: bool = False
    found_by: str = "there"
    not_simulated: str = ""
    unit: str = LINEAR.unit

    @property
    def lasts(self) -> bool:
        """Whether it keeps oscillating: as simulated or, where that failed, as a stable cycle is predicted to."""
        if self.not_simulated:
            return self.predicted is not None and self.predicted.stable
        return self.simulated_N is not None or self.runs_away

    @property
    def force_N(self) -> float:
        """Amplitude of what lasts: as simulated, without end, or as predicted where there is no simulation."""
        if self.not_simulated and self.predicted is not None:
            return self.predicted.force_N
        return math.inf if self.simulated_N is None else self.simulated_N

    def to_dict(self) -> dict[str, Any]:
        """Return the cycle as it stands in robustness.json."""
        return {
            "predicted": None if self.predicted is None else asdict(self.predicted),
            "simulated": {"force_N": self.simulated_N, "frequency_hz": self.simulated_hz} if self.simulated_N else None,
            "runs_away": self.runs_away,
            "found_by": self.found_by,
            "not_simulated": self.not_simulated or None,
            "unit": self.unit,
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], source: str, remedy: str) -> FoundCycle:
        """Return what `to_dict` gave."""
        stored = from_content(_StoredCycle, content, source, remedy=remedy)
        simulated = stored.simulated or {}
        return cls(
            predicted=stored.predicted,
            simulated_N=simulated.get("force_N"),
            simulated_hz=simulated.get("frequency_hz"),
            runs_away=stored.runs_away,
            found_by=stored.found_by,
            not_simulated=stored.not_simulated or "",
            unit=stored.unit,
        )

    def __str__(self) -> str:
        parts: list[str] = []
        if self.predicted is not None:
            kind = "a stable" if self.predicted.stable else "an unstable"
            size = f"{self.predicted.force_N:.3g} {self.unit} at {self.predicted.frequency_hz:.3g} Hz"
            parts.append(f"the describing function predicts {kind} oscillation of {size}")
        if self.not_simulated:
            parts.append(f"its simulation failed: {self.not_simulated}")
        elif self.runs_away:
            parts.append(f"simulated from {self.found_by} it grows without end")
        elif self.simulated_N is not None:
            parts.append(
                f"simulated from {self.found_by}: {self.simulated_N:.3g} {self.unit} at {self.simulated_hz:.3g} Hz"
            )
        else:
            parts.append(f"simulated from {self.found_by} it dies out")
        return "; ".join(parts)


def seek_limit_cycles(
    controller: Controller, plant: Plant, params: ParameterSet, *, shown: bool = False
) -> tuple[FoundCycle, ...]:
    """Return the limit cycles that friction, unless stability is shown, and play may make, at rest at zero.

    They are predicted and simulated; a prediction whose simulation fails stands alone, with the reason.
    """
    predicted = () if shown else predict_limit_cycles(controller, plant, params)
    predicted += predict_play_cycles(controller, plant, params)
    unit = controller.command.reference_unit
    return tuple(replace(_simulate(controller, plant, params, cycle), unit=unit) for cycle in predicted)


def list_step_cycles(runs: Verification, plant: str) -> tuple[FoundCycle, ...]:
    """Return the oscillations that steps on a plant end in, at its nominal parameters."""
    return tuple(
        FoundCycle(
            predicted=None,
            simulated_N=row.limit_cycle_N,
            simulated_hz=row.limit_cycle_hz,
            found_by=f"the {row.scenario}",
            unit=runs.mechanics.unit,
        )
        for row in runs.rows
        if row.plant == plant and row.draw == NOMINAL and row.limit_cycle_N is not None
    )


def _simulate(controller: Controller, plant: Plant, params: ParameterSet, cycle: LimitCycle) -> FoundCycle:
    """Return what a run that starts beyond a predicted cycle ends in."""
    period = controller.sample_time_s
    lasting = min(max(PERIODS / cycle.frequency_hz, LEAST_S), LONGEST_S)
    values = plant.complete(controller.delay(params)).drop_conditions()
    measured, delay = controller.signals, controller.compute_delay_samples
    try:
        loop = SampledLoop(
            plant=plant,
            law=runnable(controller),
            measured=measured,
            delay_samples=delay,
            longest_delay_s=find_longest_delay(plant, [values]),
        )
        start = at_rest(loop, 1, PUSH * np.array(cycle.state))
        run = run_loop(loop, [values], np.zeros(math.ceil(lasting / period)), start=start)
    except SimulationError as error:
        return FoundCycle(predicted=cycle, simulated_N=None, simulated_hz=None, not_simulated=str(error))
    force = run.outputs[controller.spec.regulated][0]
    if not np.all(np.isfinite(force)):
        return FoundCycle(predicted=cycle, simulated_N=None, simulated_hz=None, runs_away=True)
    end = force[-int(JUDGED * force.size) :]
    line = find_oscillation(end, period, floor=FLOOR * cycle.force_N, lowest_hz=0.3 * cycle.frequency_hz)
    if line is None or not (line.sustained or line.growing):
        return FoundCycle(predicted=cycle, simulated_N=None, simulated_hz=None)
    return FoundCycle(
        predicted=cycle,
        simulated_N=None if line.growing else line.amplitude,
        simulated_hz=None if line.growing else line.frequency_hz,
        runs_away=line.growing,
    )
