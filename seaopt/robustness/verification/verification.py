"""The controller as exported on nonlinear plants: scenarios, what they showed, and whether that is allowed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

from seaopt.bench import Sensors
from seaopt.control import Controller
from seaopt.errors import ControlError, suggestion
from seaopt.formatting import format_number, format_table, html_text
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.impacts import check_held
from seaopt.records import record
from seaopt.robustness.verification.judgement import NOMINAL, Outcome, judged
from seaopt.robustness.verification.playback import Stage, Trace, play
from seaopt.robustness.verification.scenarios import Scenario, default_scenarios, left_out


@record(eq=False)
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
    follows_hz : mapping of plant name to (lo, hi) or None
        Where the linear loop's force is within 3 dB of its reference, at nominal parameters. On a link that swings that
        does not begin at 0 Hz, and a step does not come to its reference.

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
    follows_hz: Mapping[str, tuple[float, float] | None]

    def scenario(self, row: Outcome) -> Scenario:
        """Return the scenario of a row."""
        return next(item for item in self.scenarios[row.plant] if item.name == row.scenario)

    def replay(self, row: Outcome) -> Trace:
        """Return the trace of a row, played again."""
        scenario = self.scenario(row)
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

    def drawn(self) -> list[str]:
        """Return what each draw is: where it differs from nominal, a line each."""
        rows = {(row.plant, row.draw): row for row in self.rows if row.draw != NOMINAL}
        return [
            f"draw {row.draw} on {row.plant}: "
            + (", ".join(f"{name} = {value:.6g}" for name, value in row.parameters.items()) or "nominal")
            for row in rows.values()
        ]

    def following(self) -> list[str]:
        """Return, a line each, on which plants slow references are not followed."""
        lines: list[str] = []
        for name, band in self.follows_hz.items():
            if band is None:
                lines.append(f"{name} tracks no reference within 3 dB: a step does not reach its reference")
            elif band[0] > 0.0:
                lines.append(
                    f"{name} tracks references between {band[0]:.3g} and {band[1]:.3g} Hz (within 3 dB); below "
                    "that the swinging output prevents it"
                )
        return lines

    def to_dict(self) -> dict[str, Any]:
        """Return what goes into robustness.json under "simulation"."""
        return {
            "passed": self.passed,
            "seed": self.seed,
            "real_time_factor": dict(self.real_time_factor),
            "integration_error": self.error,
            "follows_hz": {name: None if band is None else list(band) for name, band in self.follows_hz.items()},
            "rows": [{f.name: _plain(getattr(row, f.name)) for f in fields(Outcome)} for row in self.rows],
            "skipped": [dict(zip(("scenario", "plant", "reason"), item, strict=True)) for item in self.skipped],
        }

    def __repr__(self) -> str:
        failed = len(self.failures)
        verdict = "passed" if self.passed else (f"FAILED in {failed} of {len(self.rows)} runs" if failed else "EMPTY")
        lines = [f"Verification by simulation: {verdict}"]
        lines += [f"  {line}" for line in (*_table(self), *self.drawn(), *self.following())]
        lines += [
            f"  FAILED {row.plant}, {row.scenario}, draw {row.draw}: {row.reason}{witness(row)}"
            for row in self.failures
        ]
        lines += [f"  not played: {scenario} on {plant}, {reason}" for scenario, plant, reason in self.skipped]
        speed = ", ".join(f"{name} {value:.0f}" for name, value in self.real_time_factor.items())
        return "\n".join([*lines, f"  seconds simulated in a second: {speed}; seed {self.seed}"])

    _repr_html_ = html_text


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
        Played besides the nominal values, such as a certificate's worst draws; a condition among them (phi, delay_s) is
        where, and how late, those runs start (`seaopt.robustness.verification.playback.play`).
    sensors : Sensors, optional
        Noise, offset, range and quantisation of the measured output; ideal if left out.
    current_step_A : float
        What the current is rounded to; 0 for not at all.
    partners : mapping of plant name to Plant, optional
        The same actuator with its link fixed, for scenarios of contact; what the plant's port makes where left out.
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
    check_plants(plants, draws or {}, partners or {})
    stages = {
        name: Stage(
            controller=controller, plant=plant, partner=_partner(plant, (partners or {}).get(name)),
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
        if scenarios is None:
            skipped += [
                (item, name, "nothing saturates without current_limit_A") for item in left_out(controller, stage.plant)
            ]
        skipped += [(item.name, name, obstacle) for item, obstacle in found if obstacle is not None]
        simulated = wall = 0.0
        for item in played[name]:
            trace = play(stage, item, sets[name], seed=seed)
            ideal = trace if stage.is_ideal else play(stage.ideal, item, sets[name], seed=seed)
            rows += [judged(stage, name, item, trace, k, sets[name], ideal) for k in range(len(sets[name]))]
            for one in (trace,) if ideal is trace else (trace, ideal):
                simulated += len(sets[name]) * one.time.size * controller.sample_time_s
                wall, error = wall + one.wall_s, max(error, one.error)
        speeds[name] = simulated / wall if wall else math.nan
    return Verification(
        passed=bool(rows) and all(row.passed for row in rows), rows=tuple(rows), skipped=tuple(skipped),
        real_time_factor=speeds, error=error, seed=seed, stages=stages, scenarios=played, draws=sets,
        follows_hz={
            name: controller.close(plant, parameters).figures().tracking_band_hz for name, plant in plants.items()
        },
    )  # fmt: skip


def check_plants(plants: Mapping[str, Plant], draws: Mapping[str, Any], partners: Mapping[str, Plant]) -> None:
    """Refuse no plants at all, and draws or partners of plants that are not there."""
    if not isinstance(plants, Mapping) or not plants:
        raise ControlError("verify needs a mapping of name to plant with at least one; give {name: plant}")
    for what, given in (("draws", draws), ("partners", partners)):
        for name in given:
            if name not in plants:
                raise ControlError(f'{what} = {{"{name}": ...}} is none of the plants; {suggestion(name, plants)}')


def _partner(plant: Plant, partner: Plant | None) -> Plant | None:
    """Return the plant with the port held: as given, else as the port makes it; None where it makes none."""
    if partner is not None:
        check_held(plant, partner)
        return partner
    return plant.port.held() if plant.port is not None and plant.port.held is not None else None


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def witness(row: Outcome) -> str:
    """Return where a row's draw differs from nominal, as text that follows its reason."""
    return "".join(f"; {name} = {value:.6g}" for name, value in row.parameters.items())


def _table(found: Verification) -> list[str]:
    head = (
        "plant", "scenario", "size", "", "force N", "current A", "angle deg", "energy J", "at limit", "ends off N",
        "allowed N", "draw",
    )  # fmt: skip
    cells: list[tuple[str, ...]] = []
    for row in found.worst():
        angle = None if row.peak_angle_rad is None else math.degrees(row.peak_angle_rad)
        scenario = found.scenario(row)
        cells.append((
            row.plant, row.scenario, scenario.size, "passed" if row.passed else "FAILED", f"{row.peak_force_N:.4g}",
            *(format_number(value, 3, "") for value in (row.peak_current_A, angle, row.peak_energy_J)),
            f"{100 * row.saturated:.3g} %", format_number(row.final_error_N, 3, ""),
            format_number(scenario.final_error, 3, ""), row.draw,
        ))  # fmt: skip
    return format_table(cells, head)
