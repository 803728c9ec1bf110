"""Run what the linear figures leave out, for a certificate: nonlinear plants, large signals, and the port.

Steps of several sizes are always simulated: where no link moves, a step must not overshoot by more than the reference
peak allows, settle, and end at its reference; nothing may oscillate. All other scenarios are where they are asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from seaopt.bench import Sensors
from seaopt.codec import to_content
from seaopt.control import Controller, ForceMPC
from seaopt.control.laws.passivity import Passivity, passivity
from seaopt.errors import ControlError, SeaoptError, UnplayedError
from seaopt.executors import Shared, map_ordered
from seaopt.formatting import format_count
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import has_friction, split_friction
from seaopt.progress import Progress, divide, ignore, prefix
from seaopt.records import Result, Worded, record
from seaopt.robustness.certificate.cases import Cases, Check, CheckContext, Evidence
from seaopt.robustness.certificate.requirement import LIMIT_CYCLE, DrawnAt, Requirement, require_at_most
from seaopt.robustness.uncertainty.draws import Plants, Varied
from seaopt.robustness.uncertainty.worst import Worst
from seaopt.robustness.verification.environments import StabilityMap, coupled_stability
from seaopt.robustness.verification.judgement import LOST, Fault, Outcome
from seaopt.robustness.verification.large_signal import LargeSignal, large_signal
from seaopt.robustness.verification.limit_cycles import FoundCycle, list_step_cycles, seek_limit_cycles
from seaopt.robustness.verification.scenarios import Scenario, step_scenarios
from seaopt.robustness.verification.verification import Verification, check_plants, check_sensors, verify

Played = TypeVar("Played")
SIMULATION_FAILURES = "simulation_failures"
STEP_SECONDS, SECONDS = 1.0, 3.5  # that steps, and all scenarios, of a plant take as a rule
SWEEP, SCENARIOS, PORT = 1.5, 2.0, 0.7  # of the time of simulations: of each plant, and of the design plant's port
NOTHING_LARGE = (
    "large signals"  # of all plants, where no command is limited and nothing rubs: they look like small ones
)
STEP_OVERSHOOT, STEP_SETTLING = "step_overshoot", "step_settling_s"
UNPLAYED = "not simulated"  # the cause where a scenario cannot be simulated
# Kinds of fault that have a figure of their own are requirements by these names; all others are counted.
NAMED_FAULTS = {
    "overshoot": STEP_OVERSHOOT, "settling": STEP_SETTLING, "steady error": "steady_error",
    "oscillation": "sustained_oscillation",
}  # fmt: skip


@record(eq=False, repr=False)
class Simulated(Result, Worded):
    """Scenarios and large signals on every plant; passivity and coupled stability on the design plant.

    Parameters
    ----------
    verification : Verification or None
        None if a plant cannot be simulated.
    large_signal : tuple of LargeSignal
        One per plant, the design plant first; empty without a current limit and friction.
    passivity, environments : Passivity and StabilityMap, or None
        None for a plant without a port at link 2.
    left_out : mapping of what to reason
    unchecked : tuple of str
        Of `left_out`, what applies and could not be made.
    sensors, command_step, seed
        What the scenarios were played with.
    """

    verification: Verification | None
    large_signal: tuple[LargeSignal, ...]
    passivity: Passivity | None
    environments: StabilityMap | None
    left_out: Mapping[str, str]
    sensors: Sensors
    command_step: float
    seed: int
    unchecked: tuple[str, ...] = ()
    unplayed: SeaoptError | None = None  # why there is no verification; not read back from a file

    @property
    def met(self) -> bool:
        """Whether every scenario passed; large signals and passivity are findings."""
        return self.verification is not None and self.verification.met

    def simulation_dict(self) -> dict[str, Any]:
        """Return what goes into robustness.json under "simulation"."""
        played = {} if self.verification is None else self.verification.to_dict()
        names = ("large_signal", "sensors", "command_step", "seed", "left_out", "unchecked")
        parts = {name: to_content(getattr(self, name)) for name in names}
        return {"met": self.met, "passed": self.met} | played | parts

    def passivity_dict(self) -> dict[str, Any] | None:
        """Return what goes into robustness.json under "passivity"; None for a plant without a port."""
        if self.passivity is None or self.environments is None:
            return None
        return self.passivity.to_dict() | {"environments": self.environments.to_dict()}


def measure_steps(context: CheckContext, progress: Progress) -> Evidence:
    """Play steps of several sizes on every plant, at its worst draws too, and look for limit cycles."""
    cases, unknown, found = context.cases, context.cases.unknown, context.found
    models = select_simulated(cases.models, context.place)
    devices = {} if context.simulations else context.devices  # else those scenarios, steps among them, have them
    try:
        steps: Verification | SeaoptError = verify(
            cases.controller,
            models,
            unknown.nominal,
            scenarios=step_scenarios if context.plan is None else partial(_list_plan_steps, context.plan),
            draws=list_worst_draws(models, unknown.nominal, unknown.varied(), found["worst"]),
            plan=context.plan,
            executor=context.executor,
            progress=progress,
            seed=context.options.seed,
            **devices,
        )
    except SeaoptError as error:
        steps = error
    shown = {name: name not in found["friction"] or found["friction"][name].shown for name in models}
    cycles: dict[str, tuple[FoundCycle, ...]] = {}
    for name, seen in zip(
        shown, map_ordered(partial(_seek, context.shared, context.plan), shown.items(), context.executor), strict=True
    ):
        if seen or not shown[name]:
            ends = list_step_cycles(steps, name) if isinstance(steps, Verification) else ()
            cycles[name] = (*seen, *ends)
    lasting = (  # those that steps end in are required of the steps
        require_at_most(LIMIT_CYCLE, cycle.force_N, 0.0, plant=name, text=str(cycle))
        for name, seen in cycles.items()
        for cycle in seen
        if cycle.predicted is not None and cycle.lasts
    )
    rows = () if context.simulations else require_runs(steps)  # else those scenarios are judged
    kept = steps if isinstance(steps, Verification) else str(steps)
    return Evidence(requirements=(*lasting, *rows), fields={"steps": kept, "cycles": cycles}, scope="simulated")


def _list_plan_steps(
    plan: ForceMPC, controller: Controller, plant: Plant, sets: Sequence[ParameterSet]
) -> tuple[Scenario, ...]:
    """Return steps in sizes of what the bounds of outputs let a plan hold, too."""
    spec, most = plan.spec, plan.command_limit
    low, high = plan.prediction.outputs.admissible_rest(0.0, -most, most)
    held = min(-low, high)
    key = "command_limit" if spec.current_limit_A is None else "current_limit_A"
    limited = replace(controller.spec, **{key: held if held > 0.0 else most})
    return step_scenarios(replace(controller, spec=limited), plant, sets)


def measure_simulations(context: CheckContext, progress: Progress) -> Evidence:
    """Play every scenario on the nonlinear plants, at their worst draws too."""
    cases, unknown, steps = context.cases, context.cases.unknown, context.found.get("steps")
    models = select_simulated(cases.models, context.place)
    simulated = run_simulations(
        cases.controller,
        models,
        unknown.nominal,
        draws=list_worst_draws(models, unknown.nominal, unknown.varied(), context.found["worst"]),
        seed=context.options.seed,
        steps=steps if isinstance(steps, Verification) else None,
        large_signals=context.large_signals,
        executor=context.executor,
        progress=progress,
        **context.devices,
    )
    return Evidence(requirements=require_simulated(simulated), fields={"simulated": simulated}, scope="simulated")


STEPS = Check(
    measure=measure_steps,
    seconds=lambda context: STEP_SECONDS * len(context.cases.models),
    applies=lambda context: context.steps,
)
SIMULATIONS = Check(
    measure=measure_simulations,
    seconds=lambda context: SECONDS * len(context.cases.models),
    applies=lambda context: context.steps and context.simulations,
)


def _seek(shared: Shared[Cases], plan: ForceMPC | None, model: tuple[str, bool]) -> tuple[FoundCycle, ...]:
    """Return the limit cycles of one model, whose friction is shown to be harmless or is not."""
    cases, (name, shown) = shared.value, model
    return seek_limit_cycles(cases.controller, cases.models[name], cases.unknown.nominal, shown=shown, plan=plan)


def select_simulated(models: Plants, at: tuple[str, float] | None) -> dict[str, Plant]:
    """Return the models that are simulated. Where a plant moves a schedule's variable, a law that is frozen there is
    not what runs.
    """
    over = "" if at is None else at[0]
    return {name: plant for name, plant in models.items() if over not in plant.states}


def list_worst_draws(
    models: Plants, nominal: ParameterSet, varied: Sequence[Varied], worst: Mapping[str, Worst]
) -> dict[str, list[ParameterSet]]:
    """Return the worst draws of each plant, of those with friction sliding and stuck, without what is nominal."""
    names = [each.name for each in varied]
    states = {name: split_friction({name: model}, nominal, names) for name, model in models.items()}
    return {
        name: [worst[state][1] for state in of_model if state in worst and worst[state].parameters]
        for name, of_model in states.items()
    }


def run_simulations(
    controller: Controller,
    plants: Mapping[str, Plant],
    parameters: ParameterSet,
    *,
    draws: Mapping[str, Sequence[ParameterSet]] | None = None,
    sensors: Sensors | None = None,
    command_step: float = 0.0,
    seed: int = 1,
    steps: Verification | None = None,
    large_signals: bool = True,
    executor: Executor | None = None,
    progress: Progress = ignore,
) -> Simulated:
    """Run scenarios, large signals, passivity and environments, as far as plants and controller allow.

    Parameters
    ----------
    controller, plants, parameters, draws, sensors, command_step, seed
        As in `verify`; the controller knows its design plant.
    steps : Verification, optional
        Runs of steps that were played before: on the same devices they are not played again.
    large_signals : bool
        Whether amplitudes are swept.
    executor : concurrent.futures.Executor, optional
        As in `verify`.
    progress : callable, optional
        Called before each of them.

    Returns
    -------
    Simulated
        What cannot be simulated is None, and `left_out` gives the reason.

    Raises
    ------
    ControlError
        There is no plant, the controller does not know its design plant, or `draws` names an unknown plant.
    """
    if controller.design is None:
        raise ControlError(
            "the controller does not know its design plant; tune it, or read it with Controller.from_dict"
        )
    check_plants(plants, draws or {}, {})
    check_sensors(sensors, controller, plants)
    devices: dict[str, Any] = {"sensors": sensors or Sensors(), "command_step": command_step, "seed": seed}
    sweeps = _list_sweeps(controller, plants, parameters) if large_signals else {}
    port = _list_port_jobs(controller)
    jobs, parts = sweeps | port, [*[SWEEP] * len(sweeps), *[PORT / len(port)] * len(port)]
    sweeping, playing = divide(progress, SWEEP * len(sweeps) + PORT, SCENARIOS * len(plants))
    # in this process a sweep tells how far it has come
    apart = port if executor is None else jobs
    attempts = map_ordered(_attempt, apart.values(), executor)
    done: dict[str, tuple[Any, SeaoptError | None]] = {}
    for what, tell in zip(jobs, divide(sweeping, *parts), strict=True):
        tell(what, 0.0)
        if executor is None and what in sweeps:
            done[what] = _attempt(partial(jobs[what], progress=prefix(tell, what)))
        else:
            done[what] = next(attempts)
    play = partial(verify, controller, plants, parameters, draws=draws, known=steps, executor=executor, **devices)
    done["simulation"] = _attempt(partial(play, progress=playing))
    left_out = {what: str(error) for what, (_, error) in done.items() if error is not None}
    applies = set(jobs) if controller.design[0].ports else set(sweeps)
    return Simulated(
        verification=done["simulation"][0],
        large_signal=tuple(done[what][0] for what in sweeps if done[what][1] is None),
        passivity=done["passivity"][0],
        environments=done["environments"][0],
        left_out=left_out,
        unchecked=tuple(what for what in left_out if what in applies - {NOTHING_LARGE}),
        unplayed=done["simulation"][1],
        **devices,
    )


def find_port_figures(controller: Controller) -> dict[str, Any]:
    """Return what the linear loop does at the design plant's port; None what cannot be had."""
    return {what: _attempt(job)[0] for what, job in _list_port_jobs(controller).items()}


def _list_port_jobs(controller: Controller) -> dict[str, Callable[[], Any]]:
    assert controller.design is not None
    verbs = {"passivity": passivity, "environments": coupled_stability}
    return {what: partial(measure, controller, *controller.design) for what, measure in verbs.items()}


def _attempt(verb: Callable[[], Played]) -> tuple[Played | None, SeaoptError | None]:
    """Return what a verb returns, or None and why it cannot be had."""
    try:
        return verb(), None
    except SeaoptError as error:
        return None, error
    except np.linalg.LinAlgError as error:
        text = f"a matrix of it cannot be factorised ({error}); look at parameters that are zero or huge"
        return None, SeaoptError(text)


def require_simulated(simulated: Simulated) -> list[Requirement]:
    """Return what the scenarios require, or why there are none."""
    runs = simulated.unplayed if simulated.verification is None else simulated.verification
    assert runs is not None
    return require_runs(runs)


def require_runs(runs: Verification | SeaoptError) -> list[Requirement]:
    """Return what the runs require: the same fault in many runs of a plant is one requirement, with the worst of them.
    An error says which of them could not be simulated.
    """
    if isinstance(runs, SeaoptError):
        spot: dict[str, Any] = {}
        if isinstance(runs, UnplayedError):
            draw = DrawnAt(parameters=runs.parameters, number=runs.draw, seed=runs.seed)
            spot = {"plant": runs.plant, "scenario": runs.scenario, "draw": draw}
        return [require_at_most(SIMULATION_FAILURES, np.inf, 0.0, text=str(runs), cause=UNPLAYED, **spot)]
    requirements: list[Requirement] = []
    for plant in runs.rigs:
        rows = [row for row in runs.rows if row.plant == plant]
        requirements += [*_list_failures(runs, rows), *_list_kept(runs, plant, rows)]
    return requirements


def _require(runs: Verification, row: Outcome, name: str, value: float, limit: float, **fields: Any) -> Requirement:
    """Return a requirement that a run decides."""
    draw = DrawnAt(parameters=row.parameters, number=row.draw, seed=runs.seed)
    return require_at_most(name, value, limit, plant=row.plant, scenario=row.scenario, draw=draw, **fields)


def _list_failures(runs: Verification, rows: Sequence[Outcome]) -> list[Requirement]:
    faults: dict[str, list[tuple[Fault, Outcome]]] = {}
    for row in rows:
        decisive = [fault for fault in row.faults if fault.kind in LOST][:1] or row.faults
        for fault in decisive:
            faults.setdefault(fault.kind, []).append((fault, row))
    requirements: list[Requirement] = []
    for kind, cases in faults.items():
        fault, row = max(cases, key=lambda case: case[0].value / (case[0].limit or 1.0))
        name, value, limit, unit = SIMULATION_FAILURES, float(len(cases)), 0.0, ""
        if kind in NAMED_FAULTS:
            name, value, limit, unit = NAMED_FAULTS[kind], fault.value, fault.limit, fault.unit
        words = {"text": fault.text, "remedy": fault.remedy, "count": len(cases), "unit": unit, "cause": kind}
        requirements.append(replace(_require(runs, row, name, value, limit, **words), met=False))
    return requirements


def _list_kept(runs: Verification, plant: str, rows: Sequence[Outcome]) -> list[Requirement]:
    """Return the requirements on a plant that every run meets, the figures of steps with the worst of them."""
    if not rows:
        return []
    kept: list[Requirement] = []
    if all(row.met for row in rows):
        text = format_count(len(rows), "run")
        kept.append(require_at_most(SIMULATION_FAILURES, 0.0, 0.0, plant=plant, text=text))
    steps = [(row, runs.scenario(row)) for row in rows if row.overshoot is not None and row.settling_s is not None]
    peaks = [
        (1.0 + (row.overshoot or 0.0), scenario.max_overshoot, row)
        for row, scenario in steps
        if scenario.max_overshoot is not None and not row.overshoot_by_limit
    ]
    times = [(row.settling_s or 0.0, scenario.settling_s or 0.0, row) for row, scenario in steps]
    for name, unit, figures in ((STEP_OVERSHOOT, "", peaks), (STEP_SETTLING, "s", times)):
        if figures and all(value <= limit for value, limit, _ in figures):
            value, limit, row = max(figures, key=lambda figure: figure[0])
            kept.append(_require(runs, row, name, value, limit, unit=unit))
    return kept


def _list_sweeps(
    controller: Controller, plants: Mapping[str, Plant], parameters: ParameterSet
) -> dict[str, Callable[[], LargeSignal]]:
    """Return the sweeps of amplitudes, by what to call them if they fail."""
    assert controller.design is not None
    design, values = controller.design
    rub = any(has_friction(plant, parameters) for plant in plants.values())
    if controller.command_limit is None and not rub:  # one reason for all of them
        return {NOTHING_LARGE: partial(_sweep, controller, design.name, design, values)}
    label = next((name for name, plant in plants.items() if plant is design), design.name)
    on = {label: (design, values)} | {name: (plant, parameters) for name, plant in plants.items() if name != label}
    return {f"large signals on {name}": partial(_sweep, controller, name, *pair) for name, pair in on.items()}


def _sweep(
    controller: Controller, name: str, plant: Plant, parameters: ParameterSet, progress: Progress = ignore
) -> LargeSignal:
    return replace(large_signal(controller, plant, parameters, progress=progress), plant=name)
