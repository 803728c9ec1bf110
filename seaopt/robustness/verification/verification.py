"""Verification: simulate the controller as exported on nonlinear plants, and judge every run."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from typing import Any

from seaopt.bench import Sensors
from seaopt.codec import Key, OrInfinite, read_fields, to_content
from seaopt.control import Controller, ForceMPC
from seaopt.control.laws.command import Command
from seaopt.errors import ControlError, SimulationError, StepSizeError, UnplayedError, suggestion
from seaopt.executors import Shared, map_ordered
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import take_sliding
from seaopt.plants.impacts import check_held
from seaopt.plants.plant import share_drive
from seaopt.plants.sensors.deflection import weigh_encoders
from seaopt.progress import Progress, ignore
from seaopt.records import PlotAccessor, Result, Worded, record
from seaopt.robustness.uncertainty.draws import Plants
from seaopt.robustness.verification.judgement import NOMINAL, Outcome, find_differences, judge_run, overshoots_at_limit
from seaopt.robustness.verification.playback import Playback, Rig, check_planned, play
from seaopt.robustness.verification.scenarios import Scenario, default_scenarios, list_left_out, make_sticking
from seaopt.units import Mechanics

ChooseScenarios = Callable[[Controller, Plant, Sequence[ParameterSet]], Sequence[Scenario]]
TOO_STEEP = "friction is smoothed over too small a speed to be simulated so; it is played as friction that sticks"


@record(eq=False, repr=False)
class Verification(Result, Worded):
    """The runs of all scenarios, their judgement, and the data to simulate them again.

    Parameters
    ----------
    rows : tuple of Outcome
    skipped : tuple of (scenario, plant, reason)
        Requested runs that cannot be simulated.
    real_time_factor : mapping of plant name to float
        Simulated seconds per second of computing, over all runs.
    error : float
        Largest estimated integration error of a sample, relative to the state's largest value.
    seed : int
        Seed of noise and random excitations.
    rigs : mapping of plant name to Rig
    scenarios : mapping of plant name to tuple of Scenario
    draws : mapping of plant name to tuple of ParameterSet
        Nominal first; `replay` uses them.
    follows_hz : mapping of plant name to (lo, hi) or None
        Band in which the linear loop's force is within 3 dB of its reference, at nominal parameters, friction sliding.
        With a swinging link it does not begin at 0 Hz, and a step does not reach its reference.
    """

    plot = PlotAccessor()
    json_keys = (
        "met", "passed", "seed", Key(field="error", name="integration_error"), "follows_hz", "rows",
        Key(field="skipped_rows", name="skipped"), "scenarios",
    )  # fmt: skip

    rows: tuple[Outcome, ...]
    skipped: tuple[tuple[str, str, str], ...]
    real_time_factor: Mapping[str, float]
    error: OrInfinite
    seed: int
    rigs: Mapping[str, Rig]
    scenarios: Mapping[str, tuple[Scenario, ...]]
    draws: Mapping[str, tuple[ParameterSet, ...]]
    follows_hz: Mapping[str, tuple[float, float] | None]

    @property
    def met(self) -> bool:
        """Whether every run passed, and there is one."""
        return bool(self.rows) and all(row.met for row in self.rows)

    @property
    def mechanics(self) -> Mechanics:
        """Units and words of the effort that the controller makes."""
        return self.command.mechanics

    @property
    def command(self) -> Command:
        """The controller's command: its input, unit and limit."""
        return next(iter(self.rigs.values())).controller.command

    def scenario(self, row: Outcome) -> Scenario:
        """Return the scenario of a row."""
        return next(scenario for scenario in self.scenarios[row.plant] if scenario.name == row.scenario)

    def replay(self, row: Outcome) -> Playback:
        """Return the samples of a row, simulated again."""
        scenario = self.scenario(row)
        drawn = self.draws[row.plant][0 if row.draw == NOMINAL else int(row.draw)]
        return play(self.rigs[row.plant], scenario, [drawn], seed=self.seed)

    def has_loop(self, rig: Rig, name: str, nominal: ParameterSet) -> bool:
        """Tell whether these are runs of a rig's law on its plant, at these nominal parameters."""
        before = self.rigs.get(name)
        if before is None or before.controller is not rig.controller or before.plant is not rig.plant:
            return False
        return self.draws[name][0] is nominal

    def recall(
        self, rig: Rig, name: str, scenario: Scenario, draws: Sequence[ParameterSet], seed: int
    ) -> list[Outcome]:
        """Return the rows of a scenario that was played on this rig, at these draws; none if it was not."""
        if not self.has_loop(rig, name, draws[0]):
            return []
        devices, same = ((each.sensors, each.command_step) for each in (self.rigs[name], rig))
        same_draws = list(map(id, self.draws[name])) == list(map(id, draws))
        locked = any(phase.held for phase in scenario.phases)  # by a partner, which may be another one
        if locked or devices != same or self.seed != seed or not same_draws or scenario not in self.scenarios[name]:
            return []
        return [row for row in self.rows if (row.plant, row.scenario) == (name, scenario.name)]

    @property
    def failures(self) -> tuple[Outcome, ...]:
        """The rows that did not pass."""
        return tuple(row for row in self.rows if not row.met)

    def worst(self) -> tuple[Outcome, ...]:
        """Return one row per scenario and plant: one that failed, else the one with the largest force."""
        best: dict[tuple[str, str], Outcome] = {}
        for row in self.rows:
            before = best.setdefault((row.plant, row.scenario), row)
            if (not row.met, row.peak_force_N) > (not before.met, before.peak_force_N):
                best[row.plant, row.scenario] = row
        return tuple(best.values())

    @property
    def skipped_rows(self) -> tuple[Mapping[str, str], ...]:
        """The skipped runs as a file holds them."""
        keys = ("scenario", "plant", "reason")
        return tuple(dict(zip(keys, row, strict=True)) for row in self.skipped)

    def to_dict(self) -> dict[str, Any]:
        """Return what goes into robustness.json under "simulation"."""
        return to_content(self)

    @classmethod
    def from_dict(
        cls,
        content: Mapping[str, Any],
        rigs: Mapping[str, Rig],
        draws: Mapping[str, tuple[ParameterSet, ...]],
        source: str,
        remedy: str,
    ) -> Verification:
        """Return what `to_dict` gave, of the same rigs and draws; nothing is simulated. Raises FileError: a key is
        missing or a value of the wrong kind.
        """
        stored = read_fields(cls, content, source, remedy=remedy)
        stored["rows"] = tuple(map(_restore_settling, stored["rows"]))
        skipped = tuple((row["scenario"], row["plant"], row["reason"]) for row in content["skipped"])
        return cls(skipped=skipped, real_time_factor={}, rigs=rigs, draws=draws, **stored)


def _restore_settling(row: Outcome) -> Outcome:
    """Return a step that never settles with the infinite time that JSON cannot hold."""
    never = row.settling_s is None and row.overshoot is not None
    return replace(row, settling_s=math.inf) if never else row


def make_rigs(
    controller: Controller,
    plants: Plants,
    sensors: Sensors | None,
    command_step: float,
    partners: Plants | None = None,
    plan: ForceMPC | None = None,
) -> dict[str, Rig]:
    """Return where a controller is played: on plants as it sees them, with what holds their links. In place of the
    linear region of a `plan` that runs, with its limit of the command.
    """
    if plan is not None:
        limits = {"current_limit_A": plan.spec.current_limit_A, "command_limit": plan.spec.command_limit}
        controller = replace(controller, spec=replace(controller.spec, **limits))
    seen = {name: controller.see(plant) for name, plant in plants.items()}
    return {
        name: Rig(
            controller=controller,
            plant=plant,
            partner=_partner(plant, (partners or {}).get(name)),
            sensors=sensors or Sensors(),
            command_step=command_step,
            plan=plan,
        )
        for name, plant in seen.items()
    }


def verify(
    controller: Controller,
    plants: Plants,
    parameters: ParameterSet,
    *,
    scenarios: Sequence[Scenario] | ChooseScenarios | None = None,
    draws: Mapping[str, Sequence[ParameterSet]] | None = None,
    sensors: Sensors | None = None,
    command_step: float = 0.0,
    partners: Plants | None = None,
    seed: int = 1,
    known: Verification | None = None,
    plan: ForceMPC | None = None,
    executor: Executor | None = None,
    progress: Progress = ignore,
) -> Verification:
    """Simulate a controller, as exported, on nonlinear plants (`Verification`).

    Parameters
    ----------
    controller : Controller
        Its law runs with its own rate, delay, current limit and anti-windup.
    plants : mapping of name to Plant
        Plants to simulate it on.
    parameters : ParameterSet
        Nominal values; parameters that are left out have the plants' defaults.
    scenarios : sequence of Scenario, or callable (controller, plant, sets) -> sequence of Scenario, optional
        The same for every plant, or what the callable returns for a plant and the sets of parameters that it is played
        with, such as `step_scenarios`; `default_scenarios` of each if left out.
    draws : mapping of plant name to sequence of ParameterSet, optional
        Simulated besides the nominal values, such as a certificate's worst draws; conditions among them (phi, delay_s)
        set where those runs start, and how late the loop is (`seaopt.robustness.verification.playback.play`).
    sensors : Sensors, optional
        Noise, offset, range and quantisation of the measured output; ideal if left out.
    command_step : float
        Step that the current is rounded to; 0 for none.
    partners : mapping of plant name to Plant, optional
        The same actuator with its link fixed, for scenarios of contact; what the plant's port makes where left out.
    seed : int
        Seed of noise and random excitations.
    known : Verification, optional
        What was played before: a scenario that it has, on the same rig at the same draws, is not played again.
    plan : ForceMPC, optional
        Predictive control whose linear region (`linear_controller`) the controller is: it is played in its place. In
        forces from rest alone: of the default scenarios those of contact, impact, payload and fall are refused.
    executor : concurrent.futures.Executor, optional
        Where scenarios are played (`seaopt.executors`); here, if left out. The outcomes are the same, bit for bit.
    progress : callable, optional
        Called before each scenario (`seaopt.progress.Progress`).

    Raises
    ------
    ControlError
        There is no plant, or an argument names an unknown one; with a plan, a scenario is not of forces alone.
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
    (True, 17)
    """
    check_plants(plants, draws or {}, partners or {})
    check_sensors(sensors, controller, plants)
    rigs = make_rigs(controller, plants, sensors, command_step, partners, plan)
    controller = next(iter(rigs.values())).controller
    sets = {name: (parameters, *(draws or {}).get(name, ())) for name in plants}
    skipped: list[tuple[str, str, str]] = []
    parts: list[tuple[str, Scenario, list[Outcome]]] = []  # with the rows that are known
    for name, rig in rigs.items():
        if scenarios is None:
            reason = "nothing saturates without a limit of the command"
            skipped += [(scenario, name, reason) for scenario in list_left_out(controller, rig.plant)]
        choose = scenarios or default_scenarios
        for scenario in choose if isinstance(choose, Sequence) else choose(controller, rig.plant, sets[name]):
            obstacle = scenario.obstacle(rig.plant, rig.partner)
            if obstacle is None:
                rows = [] if known is None else known.recall(rig, name, scenario, sets[name], seed)
                parts.append((name, scenario, rows))
            else:
                skipped.append((scenario.name, name, obstacle))
    check_planned(plan, [scenario for _, scenario, _ in parts])
    names = {name: {scenario.name for plant, scenario, _ in parts if plant == name} for name in rigs}
    play_part = partial(_play_part, Shared((rigs, sets, names, seed)))
    results = map_ordered(play_part, [(name, scenario) for name, scenario, rows in parts if not rows], executor)
    played: dict[str, list[_Runs]] = {name: [] for name in rigs}
    for number, (name, scenario, rows) in enumerate(parts):
        progress(f"{name}, scenario {number + 1} of {len(parts)}", number / len(parts))
        if rows and known is not None:
            played[name].append(_Runs(actual=scenario, outcomes=rows, error=known.error))
            continue
        runs = next(results)
        if runs.actual != scenario:
            skipped.append((scenario.name, name, TOO_STEEP))
        played[name].append(runs)
    walls = {name: sum(runs.wall_s for runs in of_plant) for name, of_plant in played.items()}
    return Verification(
        rows=tuple(row for of_plant in played.values() for runs in of_plant for row in runs.outcomes),
        skipped=tuple(skipped),
        real_time_factor={
            name: sum(runs.simulated_s for runs in of_plant) / walls[name] if walls[name] else math.nan
            for name, of_plant in played.items()
        },
        error=max((runs.error for of_plant in played.values() for runs in of_plant), default=0.0),
        seed=seed,
        rigs=rigs,
        scenarios={name: tuple(runs.actual for runs in of_plant if runs.outcomes) for name, of_plant in played.items()},
        draws=sets,
        follows_hz={
            name: known.follows_hz[name]
            if known is not None and known.has_loop(rig, name, parameters)
            else controller.close(take_sliding(rig.plant, parameters), parameters).figures().tracking_band_hz
            for name, rig in rigs.items()
        },
    )


@record
class _Runs:
    """A scenario as it was played, with its outcomes, none where another one is the same; what it took and missed."""

    actual: Scenario
    outcomes: list[Outcome]
    simulated_s: float = 0.0
    wall_s: float = 0.0
    error: float = 0.0


_Staged = tuple[dict[str, Rig], dict[str, tuple[ParameterSet, ...]], dict[str, set[str]], int]


def _play_part(staged: Shared[_Staged], part: tuple[str, Scenario]) -> _Runs:
    """Play a scenario on one rig; with friction that sticks, where its smoothed curve is too steep to simulate. Raises
    UnplayedError: neither can be simulated.
    """
    rigs, sets, names, seed = staged.value
    name, scenario = part
    rig = rigs[name]
    try:
        try:
            return _run_scenario(rig, name, scenario, sets[name], seed)
        except StepSizeError:
            actual = make_sticking(scenario)
            if scenario.friction == "sticking" or actual.obstacle(rig.plant, rig.partner):
                raise
            if actual.name in names[name]:
                return _Runs(actual=actual, outcomes=[])
            return _run_scenario(rig, name, actual, sets[name], seed)
    except SimulationError as error:
        draw = NOMINAL if error.run == 0 else str(error.run)
        differs = find_differences(sets[name][error.run], sets[name][0])
        raise UnplayedError(
            *error.args, plant=name, scenario=scenario.name, draw=draw, parameters=differs, seed=seed
        ) from error


def _run_scenario(rig: Rig, name: str, scenario: Scenario, sets: Sequence[ParameterSet], seed: int) -> _Runs:
    """Play and judge one scenario at every set of parameters."""
    trace = play(rig, scenario, sets, seed=seed)
    ideal = trace if rig.is_ideal else play(rig.ideal, scenario, sets, seed=seed)
    unlimited = None
    if overshoots_at_limit(rig, scenario, ideal):
        unlimited = play(rig.ideal.unlimited, scenario, sets, seed=seed)
    traces = [trace] if ideal is trace else [trace, ideal]
    return _Runs(
        actual=scenario,
        outcomes=[judge_run(rig, name, scenario, trace, k, sets, ideal, unlimited) for k in range(len(sets))],
        simulated_s=sum(len(sets) * played.time.size * rig.controller.sample_time_s for played in traces),
        wall_s=sum(played.wall_s for played in traces),
        error=max(played.error for played in traces),
    )


def check_plants(plants: Plants, draws: Mapping[str, Any], partners: Plants) -> None:
    """Check that there is a plant, and that draws and partners are of known plants."""
    if not isinstance(plants, Mapping) or not plants:
        raise ControlError("verify needs a mapping of name to plant with at least one; give {name: plant}")
    for argument, names in (("draws", draws), ("partners", partners)):
        for name in names:
            if name not in plants:
                raise ControlError(f'{argument} = {{"{name}": ...}} is none of the plants; {suggestion(name, plants)}')


def list_readings(controller: Controller, plants: Plants) -> list[str]:
    """Return the signals whose sensors' errors are in the runs: what the law reads, and encoders that make it."""
    outer = controller.outer
    named = [*controller.signals, *controller.further, *(() if outer is None else (outer.position,))]
    seen = [controller.see(plant) for plant in plants.values()]
    encoders = (
        name for plant in seen for signal in named if signal in plant.outputs for name in weigh_encoders(plant, signal)
    )
    return list(dict.fromkeys([*named, *encoders]))


def check_sensors(sensors: Sensors | None, controller: Controller, plants: Plants) -> None:
    """Refuse errors of a sensor that the law does not read, and no encoder that it is computed from."""
    if sensors is None:
        return
    read = list_readings(controller, plants)
    for kind in ("noise_std", "offset", "quantisation", "saturation"):
        for name in getattr(sensors, kind):
            if name not in read:
                raise ControlError(
                    f'sensors: {kind} of "{name}" would be in no run, for the law reads {", ".join(read)}; '
                    + suggestion(name, read)
                )


def _partner(plant: Plant, partner: Plant | None) -> Plant | None:
    """Return the plant with the port held: as given, else as the port makes it; None where it makes none."""
    if partner is not None:
        check_held(plant, partner)
        return share_drive(partner, plant)
    if plant.port is None or plant.port.held is None:
        return None
    return share_drive(plant.port.held(), plant)
