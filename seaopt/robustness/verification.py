"""The controller as exported on nonlinear plants: scenarios, what they showed, and whether that is allowed.

What every run is judged by:

- it stays finite, and the current within the limit;
- nothing grows: in the last phase, where the reference is constant, the largest energy of the second half (after a
  fifth of settling) is no more than that of the first, with 5 % and a thousandth of the whole run's to spare. With the
  force held, the loop works on the link like a constant force, which is conservative: over a swing the energy of link
  and actuator comes back to where it was, unless the loop feeds it. Where a plant declares no energy, the square of the
  force's error stands for it. This sees growth within seconds; a mode that takes minutes is seen by the eigenvalues;
- no oscillation sustains itself in the last phase (`oscillation`), above what noise and quantisation make, faster than
  a tenth of the bandwidth: an undamped link that swings is the link's own business;
- the limits of the scenario.
"""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.bench import Sensors
from seaopt.control import Controller
from seaopt.control.closed_loop import ENERGY
from seaopt.errors import ControlError, suggestion
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.impacts import is_pair
from seaopt.robustness.oscillation import oscillation
from seaopt.robustness.playback import Stage, Trace, play
from seaopt.robustness.scenarios import Scenario, default_scenarios

SETTLE = 0.2  # of the last phase, before it is judged
GROWTH, GROWTH_FLOOR = 1.05, 1e-3
WINDOW_S = 3.0
NOMINAL = "nominal"


@dataclass(frozen=True, slots=True, kw_only=True)
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
    peak_angle_rad : float or None
        Of the plant's angles.
    saturated : float
        Share of the samples at the current limit.
    peak_energy_J, energy_growth : float or None
        Largest energy; largest of the last phase's second half over that of its first.
    final_error_N : float
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
    peak_angle_rad: float | None
    saturated: float
    peak_energy_J: float | None
    energy_growth: float | None
    final_error_N: float
    limit_cycle_N: float | None
    limit_cycle_hz: float | None
    contact_impulse: float | None
    contact_loss_J: float | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Verification:
    """What `verify` returns.

    Parameters
    ----------
    passed : bool
        Every row passed, and there is one.
    rows : tuple of Outcome
    skipped : tuple of (scenario, plant, reason)
        What was asked for and cannot be played.
    real_time_factor : mapping of plant name to float
        Seconds simulated in a second, over all runs.
    error : float
        Largest estimated integration error of a sample, relative to the state's largest value.
    seed : int
        Of noise and random excitations.
    stages : mapping of plant name to Stage
    scenarios : mapping of plant name to tuple of Scenario
    draws : mapping of plant name to tuple of ParameterSet
        Nominal first: what `replay` plays again.

    """

    passed: bool
    rows: tuple[Outcome, ...]
    skipped: tuple[tuple[str, str, str], ...]
    real_time_factor: Mapping[str, float]
    error: float
    seed: int
    stages: Mapping[str, Stage]
    scenarios: Mapping[str, tuple[Scenario, ...]]
    draws: Mapping[str, tuple[ParameterSet, ...]]

    def replay(self, row: Outcome) -> Trace:
        """Return the trace of a row, played again."""
        (scenario,) = (item for item in self.scenarios[row.plant] if item.name == row.scenario)
        drawn = self.draws[row.plant][0 if row.draw == NOMINAL else int(row.draw)]
        return play(self.stages[row.plant], scenario, [drawn], seed=self.seed)

    @property
    def failures(self) -> tuple[Outcome, ...]:
        """The rows that did not pass."""
        return tuple(row for row in self.rows if not row.passed)

    def worst(self) -> tuple[Outcome, ...]:
        """Return one row a scenario and plant: one that failed, else the one with the largest force."""
        best: dict[tuple[str, str], Outcome] = {}
        for row in self.rows:
            key = (row.plant, row.scenario)
            if key not in best or (not row.passed, row.peak_force_N) > (not best[key].passed, best[key].peak_force_N):
                best[key] = row
        return tuple(best.values())

    def to_dict(self) -> dict[str, Any]:
        """Return what goes into robustness.json under "simulation"."""
        return {
            "passed": self.passed,
            "seed": self.seed,
            "real_time_factor": dict(self.real_time_factor),
            "integration_error": self.error,
            "rows": [{f.name: _plain(getattr(row, f.name)) for f in fields(Outcome)} for row in self.rows],
            "skipped": [dict(zip(("scenario", "plant", "reason"), item, strict=True)) for item in self.skipped],
        }

    def __repr__(self) -> str:
        failed = len(self.failures)
        verdict = "passed" if self.passed else (f"FAILED in {failed} of {len(self.rows)} runs" if failed else "EMPTY")
        lines = [f"Verification by simulation: {verdict}"]
        lines += [f"  {line}" for line in _table(self.worst())]
        lines += [
            f"  FAILED {row.plant}, {row.scenario}, draw {row.draw}: {row.reason}{_witness(row)}"
            for row in self.failures
        ]
        lines += [f"  not played: {scenario} on {plant}, {reason}" for scenario, plant, reason in self.skipped]
        speed = ", ".join(f"{name} {value:.0f}" for name, value in self.real_time_factor.items())
        return "\n".join([*lines, f"  seconds simulated in a second: {speed}; seed {self.seed}"])

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(repr(self))}</pre>"


def verify(
    controller: Controller,
    plants: Mapping[str, Plant],
    parameters: ParameterSet,
    *,
    scenarios: Sequence[Scenario] | None = None,
    draws: Mapping[str, Sequence[ParameterSet]] | None = None,
    sensors: Sensors | None = None,
    current_step_A: float = 0.0,
    partners: Mapping[str, Plant] | None = None,
    seed: int = 1,
) -> Verification:
    """Simulate a controller, as exported, on nonlinear plants.

    Parameters
    ----------
    controller : Controller
        Its law runs with its own rate, delay, current limit and anti-windup.
    plants : mapping of name to Plant
        What it must survive.
    parameters : ParameterSet
        Nominal values; the plants' defaults where left out.
    scenarios : sequence of Scenario, optional
        The same for every plant; `default_scenarios` of each if left out.
    draws : mapping of plant name to sequence of ParameterSet, optional
        Played besides the nominal values, such as a certificate's worst draws.
    sensors : Sensors, optional
        Noise, offset, range and quantisation of the measured output; ideal if left out.
    current_step_A : float
        What the current is rounded to; 0 for not at all.
    partners : mapping of plant name to Plant, optional
        The same actuator with link 2 fixed, for scenarios of contact; found among `plants` and the controller's design
        plant where left out.
    seed : int
        Of noise and random excitations.

    Returns
    -------
    Verification

    Raises
    ------
    ControlError
        There is no plant, or an argument names one that is not there.
    SimulationError
        A plant cannot be simulated to the accuracy asked for.

    Examples
    --------
    >>> import seaopt as so
    >>> stand, swing, thor = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
    >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)
    >>> controller = so.tune(stand, thor, spec, robust_to={"swing": swing})
    >>> cell = so.Sensors(noise_std={"F1": 1.0})
    >>> verification = verify(controller, {"stand": stand, "swing": swing}, thor, sensors=cell)
    >>> verification.passed, len(verification.rows)
    (True, 11)

    """
    _check(plants, draws or {}, partners or {})
    stages = {
        name: Stage(
            controller=controller, plant=plant, partner=_partner(name, plant, plants, controller, partners or {}),
            sensors=sensors or Sensors(), current_step_A=current_step_A,
        )
        for name, plant in plants.items()
    }  # fmt: skip
    played: dict[str, tuple[Scenario, ...]] = {}
    skipped: list[tuple[str, str, str]] = []
    sets = {name: (parameters, *(draws or {}).get(name, ())) for name in plants}
    rows: list[Outcome] = []
    speeds: dict[str, float] = {}
    error = 0.0
    for name, stage in stages.items():
        chosen = default_scenarios(controller, stage.plant) if scenarios is None else tuple(scenarios)
        found = [(item, item.obstacle(stage.plant, stage.partner)) for item in chosen]
        played[name] = tuple(item for item, obstacle in found if obstacle is None)
        skipped += [(item.name, name, obstacle) for item, obstacle in found if obstacle is not None]
        simulated = wall = 0.0
        for item in played[name]:
            trace = play(stage, item, sets[name], seed=seed)
            rows += [_judged(stage, name, item, trace, k, sets[name]) for k in range(len(sets[name]))]
            simulated += len(sets[name]) * trace.time.size * controller.sample_time_s
            wall, error = wall + trace.wall_s, max(error, trace.error)
        speeds[name] = simulated / wall if wall else math.nan
    return Verification(
        passed=bool(rows) and all(row.passed for row in rows), rows=tuple(rows), skipped=tuple(skipped),
        real_time_factor=speeds, error=error, seed=seed, stages=stages, scenarios=played, draws=sets,
    )  # fmt: skip


def _check(plants: Mapping[str, Plant], draws: Mapping[str, Any], partners: Mapping[str, Plant]) -> None:
    if not isinstance(plants, Mapping) or not plants:
        raise ControlError("verify needs a mapping of name to plant with at least one; give {name: plant}")
    for what, given in (("draws", draws), ("partners", partners)):
        for name in given:
            if name not in plants:
                raise ControlError(f'{what} = {{"{name}": ...}} is none of the plants; {suggestion(name, plants)}')


def _partner(
    name: str, plant: Plant, plants: Mapping[str, Plant], controller: Controller, given: Mapping[str, Plant]
) -> Plant | None:
    if name in given:
        return given[name]
    known = [*([controller.design[0]] if controller.design is not None else []), *plants.values()]
    return next((item for item in known if is_pair(plant, item)), None)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Findings:
    """What one run showed, as figures of an `Outcome`, and sentences on what is not allowed."""

    figures: dict[str, Any] = field(default_factory=dict[str, Any])
    faults: list[str] = field(default_factory=list[str])


def _judged(
    stage: Stage, name: str, scenario: Scenario, trace: Trace, run: int, sets: Sequence[ParameterSet]
) -> Outcome:
    found = _Findings()
    measured = stage.controller.spec.measured
    force, current = trace.outputs[measured][run], trace.current[run]
    _extremes(stage, scenario, trace, run, found)
    if np.all(np.isfinite(force)) and np.all(np.isfinite(current)):
        _growth(stage, trace, run, found)
        _ringing(stage, scenario, trace, run, found)
        _ending(scenario, trace, run, force, found)
    else:
        found.faults.insert(0, "it leaves what numbers can hold")
    empty = dict.fromkeys(("energy_growth", "final_error_N", "limit_cycle_N", "limit_cycle_hz"))
    return Outcome(
        scenario=scenario.name, plant=name, draw=NOMINAL if run == 0 else str(run), passed=not found.faults,
        reason="; ".join(found.faults), parameters=_difference(sets[0], sets[run]),
        **{**empty, "final_error_N": math.nan, **found.figures},
    )  # fmt: skip


def _extremes(stage: Stage, scenario: Scenario, trace: Trace, run: int, found: _Findings) -> None:
    controller, plant = stage.controller, stage.plant
    force = float(trace.peaks[controller.spec.measured][run])
    angles = [float(trace.peaks[name][run]) for name, unit in plant.outputs.items() if unit == "rad"]
    current, limit = np.abs(trace.current[run]), controller.spec.current_limit_A
    hits = trace.contacts
    hardest = max(hits, key=lambda item: abs(item.impulse[run]), default=None)
    found.figures.update(
        peak_force_N=force,
        peak_current_A=float(np.max(current)),
        peak_angle_rad=max(angles) if angles else None,
        saturated=float(np.mean(current >= limit * (1 - 1e-9))) if limit is not None else 0.0,
        peak_energy_J=float(trace.peaks[ENERGY][run]) if ENERGY in trace.peaks else None,
        contact_impulse=None if hardest is None else float(hardest.impulse[run]),
        contact_loss_J=None if hardest is None else float(hardest.loss_J[run]),
    )
    if limit is not None and np.max(current) > limit * (1 + 1e-9) + 0.5 * stage.current_step_A:
        found.faults.append(f"the current reaches {np.max(current):.4g} A, above its limit of {limit:g} A")
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


def _growth(stage: Stage, trace: Trace, run: int, found: _Findings) -> None:
    if ENERGY in trace.outputs:
        level, what = trace.outputs[ENERGY][run], "the energy"
    else:
        name = stage.controller.spec.measured
        level, what = (trace.outputs[name][run] - trace.reference[run]) ** 2, f"the square of the error of {name}"
    level = np.abs(level[np.isfinite(level)])
    last = level[-(trace.edges[-1] - trace.edges[-2]) :]
    last = last[int(SETTLE * last.size) :]
    first, second = (float(np.max(half)) for half in np.array_split(last, 2))
    found.figures["energy_growth"] = second / max(first, 1e-300)
    if second > GROWTH * first + GROWTH_FLOOR * float(np.max(level)):
        found.faults.append(f"{what} grows {second / max(first, 1e-300):.3g} times while the reference is constant")


def _ringing(stage: Stage, scenario: Scenario, trace: Trace, run: int, found: _Findings) -> None:
    spec, period = stage.controller.spec, stage.controller.sample_time_s
    if not scenario.quiet:
        return
    window = _window(trace, period)
    seen = oscillation(
        trace.outputs[spec.measured][run][window], period, floor=_floor(stage, trace, run),
        lowest_hz=max(spec.bandwidth_hz / 10.0, 8.0 / (period * (window.stop - window.start))),
    )  # fmt: skip
    if seen is None or not (seen.sustained or seen.growing):
        return
    found.figures |= {"limit_cycle_N": seen.amplitude, "limit_cycle_hz": seen.frequency_hz}
    what = "sustains itself" if seen.sustained else f"grows {seen.growth:.3g} times"
    found.faults.append(f"an oscillation of {seen.amplitude:.3g} N at {seen.frequency_hz:.4g} Hz {what}")


def _window(trace: Trace, period: float) -> slice:
    last = trace.last
    start = last.start + int(SETTLE * (last.stop - last.start))
    return slice(max(start, last.stop - int(WINDOW_S / period)), last.stop)


def _floor(stage: Stage, trace: Trace, run: int) -> float:
    """Return the amplitude (N) that noise, quantisation and rounding make by themselves."""
    name, sensors = stage.controller.spec.measured, stage.sensors
    rounding = 0.5 * stage.current_step_A / stage.controller.current_per_force_A_per_N
    noise = 2.0 * sensors.noise_std.get(name, 0.0) + 1.5 * sensors.quantisation.get(name, 0.0)
    return max(noise + rounding, 1e-3 * float(trace.peaks[name][run]))


def _ending(scenario: Scenario, trace: Trace, run: int, force: Float[np.ndarray, " n"], found: _Findings) -> None:
    last = trace.last
    end = slice(last.stop - max(1, (last.stop - last.start) // 5), last.stop)
    error = float(np.mean(trace.reference[run][end] - force[end]))
    found.figures["final_error_N"] = error
    if scenario.final_error is not None and not abs(error) <= scenario.final_error:
        found.faults.append(f"the force ends {error:.4g} N off, {scenario.final_error:.4g} N are allowed")


def _difference(nominal: ParameterSet, drawn: ParameterSet) -> dict[str, float]:
    return {
        name: item.value for name, item in drawn.items() if name not in nominal or item.value != nominal[name].value
    }


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _witness(row: Outcome) -> str:
    return "".join(f"; {name} = {value:.6g}" for name, value in row.parameters.items())


def _table(rows: Sequence[Outcome]) -> list[str]:
    head = ("plant", "scenario", "", "force N", "current A", "angle deg", "energy J", "at limit", "draw")
    cells = [head]
    for row in rows:
        angle = "" if row.peak_angle_rad is None else f"{math.degrees(row.peak_angle_rad):.3g}"
        energy = "" if row.peak_energy_J is None else f"{row.peak_energy_J:.3g}"
        cells.append((
            row.plant, row.scenario, "passed" if row.passed else "FAILED", f"{row.peak_force_N:.4g}",
            f"{row.peak_current_A:.3g}", angle, energy, f"{100 * row.saturated:.3g} %", row.draw,
        ))  # fmt: skip
    widths = [max(len(line[i]) for line in cells) for i in range(len(head))]
    return ["  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in cells]
