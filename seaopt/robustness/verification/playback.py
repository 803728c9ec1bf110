"""Simulation of a scenario for verification: phase after phase on the sampled loop, several parameter sets at once."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from seaopt.bench import Sensors, excite
from seaopt.control import Controller, ForceMPC, ForceRun, MPCState, close_loop
from seaopt.control.laws.realisation import RunnableLaw, runnable
from seaopt.control.loops.outer_loop import FIRST, follow_link
from seaopt.control.loops.sampled_plant import DELAYS, find_rows
from seaopt.control.mpc.compiled import PlanSample, make_stepper
from seaopt.control.mpc.step import add_terms, rest_filter
from seaopt.control.running.closed_loop import LoopRun, LoopState, SampledLoop, at_rest, describe_runs, run_loop
from seaopt.control.running.equilibrium import Equilibrium, equilibrium
from seaopt.control.running.law_step import find_faults
from seaopt.control.running.sampled_loop import channel_names, find_longest_delay
from seaopt.errors import ControlError, SimulationError, StepSizeError, require_memory, require_seed
from seaopt.formatting import join_words
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import CompletedParameters, Plant, Port
from seaopt.plants.friction import can_stick
from seaopt.plants.impacts import catch, offset, release, strike
from seaopt.plants.plant import fill_vector, output_function
from seaopt.plants.sensors.deflection import weigh_encoders
from seaopt.records import record
from seaopt.robustness.verification.oscillation import Signal
from seaopt.robustness.verification.scenarios import Phase, Scenario, build_loop

RunSamples = Float[np.ndarray, "runs n"]


@record(eq=False)
class Rig:
    """Controller, plant and devices that scenarios are simulated on."""

    controller: Controller
    plant: Plant  # with the link at its port as it is
    partner: Plant | None = None  # the same actuator with that link fixed, for phases in which it is held
    sensors: Sensors = field(default_factory=Sensors)
    command_step: float = 0.0
    plan: ForceMPC | None = None  # predictive control, whose linear region the controller is

    def loop(self, held: bool, longest_delay_s: float = 0.0, *, sticks: bool = False) -> SampledLoop:
        """Return the loop with the link held or not, with friction as its curve says or one that sticks."""
        plant = self.partner if held else self.plant
        if plant is None:
            raise ControlError(
                f"a phase holds the link of {self.plant.name}; give partner, the plant with that link fixed"
            )
        devices = {"sensors": self.sensors, "command_step": self.command_step, "longest_delay_s": longest_delay_s}
        sticks = sticks and can_stick(plant)  # bristles hold by themselves
        return build_loop(self.controller, plant, (), self.law, sticks=sticks, **devices)

    @property
    def law(self) -> RunnableLaw:
        """The law as exported, with its outer loop."""
        return runnable(self.controller, outer=True)

    @property
    def ideal(self) -> Rig:
        """The rig with a sensor and an amplifier that only have a range: no noise, no offset, no steps."""
        return replace(self, sensors=Sensors(saturation=self.sensors.saturation), command_step=0.0)

    @property
    def unlimited(self) -> Rig:
        """The rig with no limit of the command; of predictive control its linear region."""
        spec = replace(self.controller.spec, current_limit_A=None, command_limit=None)
        command = replace(self.controller.command, largest=None)
        return replace(self, controller=replace(self.controller, spec=spec, command=command, derate=False), plan=None)

    @property
    def is_ideal(self) -> bool:
        """Whether sensors and amplifier add nothing of their own."""
        signals = (*self.controller.signals, *(() if self.law.outer is None else (self.law.outer.position,)))
        sources = {*signals, *(name for signal in signals for name in weigh_encoders(self.plant, signal))}
        offset = any(self.sensors.offset.get(name) for name in sources)
        return not (self.command_step or offset or any(any(self.find_errors(name)) for name in signals))

    @property
    def reading_errors(self) -> tuple[float, float]:
        """Noise (std) and rounding (step) of the regulated output."""
        return self.find_errors(self.controller.spec.regulated)

    def find_errors(self, name: str) -> tuple[float, float]:
        """Return noise and rounding of what is fed back, of the encoders included that it is computed from."""
        if self.controller.design is None:
            return self.sensors.noise_std.get(name, 0.0), self.sensors.quantisation.get(name, 0.0)
        plant, params = self.controller.design
        return self.sensors.combine_errors(plant, plant.complete(params), name)


@record(eq=False)
class Contact:
    """A link that is caught: the impulse that stops it and the energy (J) it loses, one per run."""

    impulse: Float[np.ndarray, " runs"]
    loss_J: Float[np.ndarray, " runs"]


@record(eq=False)
class Playback:
    """The samples of a simulated scenario."""

    time: Signal
    reference: RunSamples  # N, of the force law: with an outer loop what that asks of it where the link is
    current: RunSamples  # A
    outputs: Mapping[str, RunSamples]  # and "energy" where declared; NaN while a held link has no such output
    peaks: Mapping[str, Float[np.ndarray, " runs"]]  # largest magnitudes, between samples too
    equilibrium: Equilibrium | None  # where runs started; None where the scenario has an initial state
    edges: tuple[int, ...]  # first samples of the phases, and one past the last
    contacts: tuple[Contact, ...]
    faulted: Bool[np.ndarray, " runs"]  # the law's gate gave up the sensor
    error: float  # estimated integration error of the worst sample, relative
    substeps: int  # integration steps per sample, the largest number of all phases
    wall_s: float  # time of computing
    command: tuple[str, str] = ("I", "A")

    def __repr__(self) -> str:
        contacts = f"{len(self.contacts)} contacts; "
        return describe_runs(
            "Playback", f"{self.time[-1]:.4g} s", self.current, self.peaks, self.error, self.command, contacts
        )

    @property
    def last(self) -> slice:
        """The samples of the last phase."""
        return slice(self.edges[-2], self.edges[-1])


def play(rig: Rig, scenario: Scenario, params: Sequence[ParameterSet], *, seed: int = 1) -> Playback:
    """Simulate a scenario, once for each set of parameters. A run starts at rest: at zero, or where a condition among
    its parameters (an angle such as phi) puts the plant, with the law and the commands that wait at rest too, and the
    scenario's forces counted from the one that keeps it there. A scenario with an `initial_state` starts in that,
    whatever the conditions. `delay_s` among the parameters is a delay besides the controller's. `seed` is of the sensor
    noise and of random excitations. Around an outer loop a force of a phase is the x_0 that its stiffness makes it of;
    without a stiffness it is added to what that asks for. Raises ControlError: the rig has a plan, and the scenario is
    not of forces alone.
    """
    check_planned(rig.plan, [scenario])
    obstacle = scenario.obstacle(rig.plant, rig.partner)
    if obstacle is not None:
        raise ControlError(f'scenario "{scenario.name}" cannot be played on {rig.plant.name}: {obstacle}')
    if not params:
        raise ControlError("params is empty; give one ParameterSet per run")
    placed = [rig.plant.complete(rig.controller.delay(drawn)) for drawn in params]
    delays = [[drawn.given[name] for name in DELAYS if name in drawn.given] for drawn in placed]
    longest = find_longest_delay(rig.plant, placed)
    carried = [drawn.with_parameters(*delay) for drawn, delay in zip(placed, delays, strict=True)]
    start = None if scenario.initial_state else equilibrium(rig.loop(held=False, longest_delay_s=longest), placed)
    now, grip = _start_state(rig, scenario, placed, longest) if start is None else start.state, None
    offset = start.given[:, None] if start is not None and scenario.about_rest else np.zeros((len(params), 1))
    outer = rig.law.outer
    per_force = 1.0 if outer is None else 1.0 / outer.per_given
    if rig.plan is not None:
        assert start is not None  # else the scenario is not of forces alone
        return _play_plan(rig, rig.plan, scenario, placed, start, offset, per_force, seed)
    runs: list[LoopRun] = []
    positions: list[RunSamples] = []  # of the link, as the outer loop reads it
    contacts: list[Contact] = []
    begin_s = 0.0
    for number, phase in enumerate(scenario.phases):
        carried = [apply_load(unloaded, phase.scale) for unloaded in carried]
        values = [rig.plant.complete(loaded) for loaded in carried]
        if phase.held and grip is None:
            now, grip, contact = _catch(rig, values, now)
            contacts.append(contact)
        elif grip is not None and not phase.held:
            port, rows = _port(rig.plant), zip(now.x, values, grip, strict=True)
            freed = [release(rig.plant, p, port, row, link) for row, p, link in rows]
            now, grip = LoopState(x=np.stack(freed), z=now.z), None
        if phase.impulse_Ns:
            link = _port(rig.plant).motion or ""
            blows = [strike(rig.plant, p, x, link, phase.impulse_Ns) for p, x in zip(values, now.x, strict=True)]
            now = LoopState(x=np.stack(blows), z=now.z)
        loop = rig.loop(phase.held, longest, sticks=scenario.friction == "sticking")
        reference = offset + per_force * _build_reference(
            phase, loop.law.sample_time_s, np.random.default_rng([require_seed(seed, ControlError), number])
        )
        standing = np.zeros((1, 0)) if grip is None else _read_standing(rig, values, grip, loop.standing)
        run = run_loop(
            loop,
            values,
            reference,
            start=now,
            seed=seed + 7919 * number,
            start_s=begin_s,
            standing=standing if standing.size else 0.0,
        )
        now, begin_s = run.end, begin_s + reference.shape[1] * loop.law.sample_time_s
        runs.append(run)
        if outer is not None:
            still = dict(zip(loop.standing, standing.T, strict=False)).get(outer.position, np.zeros(1))
            positions.append(run.outputs.get(outer.position, np.broadcast_to(still[:, None], run.reference.shape)))
    played = _join_phases(rig, runs, start, tuple(contacts))
    return played if outer is None else replace(played, reference=outer.ask(played.reference, np.hstack(positions)))


def check_planned(plan: ForceMPC | None, scenarios: Sequence[Scenario]) -> None:
    """Refuse scenarios that predictive control cannot be played in (ControlError)."""
    others = dict.fromkeys(f'"{scenario.name}"' for scenario in scenarios if not scenario.is_of_forces_alone)
    if plan is not None and others:
        raise ControlError(
            f"predictive control is played in forces from rest alone, and {join_words(list(others))} hold, strike or "
            "load the link, or begin elsewhere; leave them out (scenarios=step_scenarios), or leave out plan"
        )


def _play_plan(
    rig: Rig,
    plan: ForceMPC,
    scenario: Scenario,
    values: Sequence[CompletedParameters],
    start: Equilibrium,
    offset: Float[np.ndarray, "runs 1"],
    per_force: float,
    seed: int,
) -> Playback:
    """Simulate phases of forces alone with predictive control as exported: steps that nobody knew ahead of."""
    began, outer, names = time.perf_counter(), plan.outer, channel_names(rig.plant)
    rng = np.random.default_rng(require_seed(seed, ControlError))
    parts = [_build_reference(phase, plan.sample_time_s, rng) for phase in scenario.phases]
    given, wanted = np.concatenate(parts), list[Signal]()
    runs, ended = list[ForceRun](), list[PlanSample]()
    for run, each in enumerate(values):
        resting = not (start.force[run] or start.rest_command[run] or start.reference[run])
        wanted.append(offset[run, 0] + per_force * given)
        steps = list[PlanSample]()
        try:
            played = run_plan(
                plan,
                rig.plant,
                each,
                wanted[-1],
                steps,
                start=None if resting else rest_plan(plan, rig.plant, each, start, run),
                sensors=rig.sensors,
                command_step=rig.command_step,
                seed=seed,
                start_state=start.state.x[run],
                start_command=float(start.rest_command[run]),
                sticks=scenario.friction == "sticking" and can_stick(rig.plant),
            )
        except SimulationError as error:
            error.run = run
            raise
        runs.append(played)
        ended.append(steps[-1])
    outputs = {name: np.stack([run.outputs[name] for run in runs]) for name in names}
    reference = np.stack(wanted)
    if outer is not None:
        reference = outer.ask(reference, outputs.get(outer.position, np.zeros_like(reference)))
    return Playback(
        time=runs[0].time,
        reference=reference,
        current=np.stack([run.current for run in runs]),
        outputs=outputs,
        peaks={name: np.array([run.peaks[name] for run in runs]) for name in names},
        equilibrium=start,
        edges=tuple(int(edge) for edge in np.cumsum([0, *(part.size for part in parts)])),
        contacts=(),
        faulted=np.array([step.faulted for step in ended]),
        error=max(run.error for run in runs),
        command=runs[0].command,
        substeps=max(run.substeps for run in runs),
        wall_s=time.perf_counter() - began,
    )


def run_plan(
    plan: ForceMPC,
    plant: Plant,
    values: ParameterSet,
    reference: Signal,
    steps: list[PlanSample],
    *,
    start: MPCState | None = None,
    **options: Any,
) -> ForceRun:
    """Return the samples of a run, and add each step of the plan to `steps`; `options` are those of `close_loop`. An
    outer loop is given what it makes the reference of, an x_0 or a force, and asks for the force of one sample.
    """
    outer, reads = plan.outer, plan.reads
    named = (*reads, *(() if outer is None else (outer.position,)))
    moved = tuple(dict.fromkeys(name for name in named if name in plant.outputs))

    def run(**tolerated: Any) -> ForceRun:
        step = make_stepper(plan, start)
        steps.clear()

        def law(kept: Any, r: Any, y: Any) -> tuple[float, Any]:
            force, *positions = np.ravel(y).tolist()
            places = dict(zip(moved, positions, strict=True))
            if outer is not None:
                x_0, besides = outer.split(r / outer.per_given)
                kept = follow_link(outer.numbers, kept, x_0, places.get(outer.position, 0.0))
                r = besides + kept[-1]
            steps.append(step(r, force, [places.get(name, 0.0) for name in reads]))
            return steps[-1].command, kept

        return close_loop(
            law,
            FIRST,
            plant,
            values,
            reference,
            measured=(plan.measured, *moved),
            sample_time_s=plan.sample_time_s,
            delay_samples=plan.compute_delay_samples,
            command_limit=plan.command_limit,
            **options,
            **tolerated,
        )

    try:
        return run()
    except StepSizeError:  # of a state that has hardly moved yet, as where friction lets go, errors look large
        rough = run(rtol=np.inf)
        return run(sizes=np.max(np.abs(rough.state), axis=0))


def rest_plan(plan: ForceMPC, plant: Plant, values: ParameterSet, start: Equilibrium, run: int) -> MPCState:
    """Return the state of a plan that rests with its plant: the estimate is that of the force, whose drift is what the
    command does not explain.
    """
    force, current, x = float(start.force[run]), float(start.rest_command[run]), start.state.x[run]
    inputs = np.append(current, np.zeros(len(plant.inputs) - 1))
    read = output_function(plant)(0.0, x, inputs, plant.complete(values).vector)
    outputs = dict(zip(plant.outputs, np.ravel(np.array(read)).tolist(), strict=True))
    readings = [outputs.get(name, 0.0) for name in plan.reads]
    reference = np.array([float(start.reference[run])])
    terms = add_terms(plan.compensation, plan.link_filter, plan.start.terms, reference, readings)
    planned, kalman, low_pass = current - terms[1] * plan.per_effort, plan.kalman, plan.spec.low_pass
    drift = (force - float(kalman.offset[0])) / plan.static_gain - planned
    predicted, past = np.zeros(len(kalman.A)), kalman.start.past.copy()
    predicted[: plan.rest_state.size], predicted[-1] = plan.rest_state * (planned + drift), drift
    past[:, 0] = planned
    return replace(
        plan.start,
        kalman=replace(kalman.start, predicted=predicted, corrected=predicted, past=past),
        command=current,
        plan=np.full(plan.start.plan.size, planned),
        shaped=() if low_pass is None else rest_filter(low_pass, force),
        terms=terms,
    )


def _start_state(rig: Rig, scenario: Scenario, values: Sequence[CompletedParameters], longest: float) -> LoopState:
    """Return the first states of the plant with its link free: those of the scenario, the spring relaxed."""
    plant, loop = rig.plant, rig.loop(held=False, longest_delay_s=longest)
    start = at_rest(loop, len(values), fill_vector("state", plant.states, scenario.initial_state))
    if plant.port is not None:
        for row, p in zip(start.x, values, strict=True):
            row -= offset(plant, p, row, plant.port)
    return start


def _port(plant: Plant) -> Port:
    assert plant.port is not None  # else the scenario has an obstacle
    return plant.port


def apply_load(params: ParameterSet, scale: Mapping[str, float]) -> ParameterSet:
    """Return the scaled parameters; their bounds, which limit what is known and not what is carried, are widened."""
    changed: list[Parameter] = []
    for name, factor in scale.items():
        loaded = params[name]
        value = factor * loaded.value
        changed.append(replace(loaded, value=value, min=min(loaded.min, value), max=max(loaded.max, value)))
    return params.with_parameters(*changed)


def _build_reference(phase: Phase, sample_time_s: float, rng: np.random.Generator) -> Signal:
    samples = phase.duration_s / sample_time_s
    require_memory(20.0 * samples, f"phase: duration_s = {phase.duration_s:g}", ControlError)
    n = max(1, round(samples))
    if not phase.excitation:
        return np.full(n, phase.force_N)
    return phase.force_N + excite(phase.excitation, duration_s=n * sample_time_s, rate_hz=1 / sample_time_s, rng=rng)[1]


def _catch(
    rig: Rig, values: Sequence[CompletedParameters], now: LoopState
) -> tuple[LoopState, list[dict[str, float]], Contact]:
    """Return the states after the link is caught, where its coordinate stands in each run, and the contact."""
    plant, port = rig.plant, _port(rig.plant)
    name = port.coordinate or ""
    column = list(plant.states).index(name)
    states, impulses, losses = zip(
        *(catch(plant, p, row, port) for p, row in zip(values, now.x, strict=True)), strict=True
    )
    contact = Contact(impulse=np.array(impulses), loss_J=np.array(losses))
    return LoopState(x=np.stack(states), z=now.z), [{name: float(row[column])} for row in now.x], contact


def _read_standing(
    rig: Rig, values: Sequence[CompletedParameters], grip: Sequence[Mapping[str, float]], names: tuple[str, ...]
) -> Float[np.ndarray, "runs k"]:
    """Return where held links stand, as each of the outputs that are read of them."""
    plant = rig.plant
    observe, rows, still = output_function(plant), find_rows(plant, names), np.zeros(len(plant.inputs))
    places = [fill_vector("state", plant.states, at) for at in grip]
    return np.array(
        [np.array(observe(0.0, x, still, each.vector)).ravel()[rows] for x, each in zip(places, values, strict=True)]
    )


def _join_phases(
    rig: Rig, runs: Sequence[LoopRun], start: Equilibrium | None, contacts: tuple[Contact, ...]
) -> Playback:
    names = channel_names(rig.plant)
    count = runs[0].current.shape[0]

    def column(run: LoopRun, name: str) -> RunSamples:
        return run.outputs[name] if name in run.outputs else np.full((count, run.time.size), np.nan)

    return Playback(
        time=np.concatenate([run.time for run in runs]),
        reference=np.hstack([run.reference for run in runs]),
        current=np.hstack([run.current for run in runs]),
        outputs={name: np.hstack([column(run, name) for run in runs]) for name in names},
        peaks={name: np.max([run.peaks[name] for run in runs if name in run.peaks], axis=0) for name in names},
        equilibrium=start,
        edges=tuple(int(edge) for edge in np.cumsum([0, *(run.time.size for run in runs)])),
        contacts=contacts,
        faulted=find_faults(rig.law, runs[-1].end.z),
        error=max(run.error for run in runs),
        command=runs[0].command,
        substeps=max(run.substeps for run in runs),
        wall_s=sum(run.wall_s for run in runs),
    )
