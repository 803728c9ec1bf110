"""Physics that a model may lack: each a part that is added, with what it frees and where a refit of it starts.

A hypothesis changes plants by their roles alone, and names no parameters but those of its part. Where a part's effect
is zero at zero, and straight there, its refit starts from zero: one step then goes as far as the log wants. Others,
such as play, have no slope there, and start from a size that actuators have.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import field, fields, replace

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.errors import SeaoptError
from seaopt.estimation.judgement.traces.hold_search import find_holds
from seaopt.estimation.judgement.traces.ripple_search import find_followed_ripple, find_ripple, move_zero
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.residual_statistics import ResidualsByExperiment
from seaopt.estimation.problem.shapes import Vector
from seaopt.estimation.result.fit_result import Fit
from seaopt.estimation.result.trials import Hold
from seaopt.formatting import join_words
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant, add_part
from seaopt.plants.memo import memo
from seaopt.plants.parts import list_dead_times
from seaopt.plants.plant import name_input, name_symbols
from seaopt.records import record
from seaopt.signals import VectorN
from seaopt.simulation import simulate

FASTEST = 2.0  # of the rate of a log: a pole beyond it does nothing that the log shows, and takes ever shorter steps
LARGEST = 0.999  # quantile of a size over a log: what it has at its largest, but for rounding
LEVEL = 0.05  # of a size that commands have: what is so near to it, or to zero, is there
BETWEEN = 0.02  # of the samples that may be elsewhere
SIMULATED = 1e-2  # of a signal: error of the simulation that tells sizes

Starts = Sequence[Mapping[str, float]]


@record
class Sizes:
    """How large things are in the logs, of the actuator that is fitted: zero where no role tells."""

    current: float  # the commanded input
    speed: float  # of what rubs
    travel: float  # of what rubs, from one end to the other
    friction: float  # dry friction
    deflection: float  # of the spring
    stiffness: float
    ripple: Mapping[str, float] = field(default_factory=dict[str, float])  # of the residual, over the motor's position
    holds: Mapping[str, Hold] = field(default_factory=dict[str, Hold])  # of the command, by experiment


SIZES = tuple(each.name for each in fields(Sizes) if each.name not in ("ripple", "holds"))


@record
class Scale:
    """What the size of an effect that a log may not show goes by."""

    stiffness: float  # of the spring; 0 where no role tells
    level: float  # the one size that all commands have where they are not zero; 0 where they have several


@record(eq=False)
class Hypothesis:
    """What a model may lack: in words, the part that brings it, and from which values of its own a refit starts.

    Those that it frees are the first of each start; `fixed` are chosen once. What is `searched` is free in the refit
    alone, and fixed at its value where the effect is taken: logs hardly tell how large it is. `poles` are in Hz, a
    `dead_time` in s: alone it is an experiment's own delay, and named as that (`candidates`).
    `usual` is of what logs often do not show at all: a size that actuators have of this scale, 0 where logs do show it
    (`silence`); `built_in` the parameter by which a plant has it without the part. One that `holds` the commands of the
    logs frees nothing, and may need no part. What goes `further` is tried where the hypothesis is the best and takes
    half of the excess, but leaves some: by itself it would take a part of much else.
    """

    effect: str
    part: str
    starts: Callable[[Sizes], Starts]
    fixed: Callable[[Sizes], Mapping[str, float]] = lambda sizes: {}
    searched: tuple[str, ...] = ()
    poles: tuple[str, ...] = ()
    dead_time: str | None = None
    usual: Callable[[Scale], float] | None = None
    holds: bool = False
    further: Hypothesis | None = None
    built_in: Callable[[Plant], str | None] = lambda plant: None
    lag: Callable[[Mapping[str, float]], float] = lambda start: 0.0  # s, that a fitted delay has in place of the effect
    # that a fitted stiffness has in place of it
    stiffens: Callable[[Sizes, Mapping[str, float]], float] = lambda sizes, start: 0.0


def _zero(*names: str) -> Callable[[Sizes], Starts]:
    return lambda sizes: [dict.fromkeys(names, 0.0)]


def _rise_at_rest(s: Sizes) -> Starts:
    """Return breakaway friction above what slides, over a slow and over a fast fall."""
    return [{"f_s": 1.4 * s.friction, "v_st": share * s.speed} for share in (0.03, 0.2) if s.friction and s.speed]


def _slip_in_spring(s: Sizes) -> Starts:
    """Return a spring that gives way at a tenth of the deflection, gradually and nearly at once, or hardly at all."""
    shares = ((0.05, 0.1, 1.0), (0.05, 0.1, 4.0), (0.1, 0.8, 10.0)) if s.deflection else ()
    return [{"k_h": part * s.stiffness, "y_h": share * s.deflection, "n_h": n} for part, share, n in shares]


def _bend_before_slipping(s: Sizes) -> Starts:
    """Return bristles that give way at a fiftieth of the travel, and at far less: of a light joint that resonates."""
    bends = (50.0, 400.0) if s.friction and s.travel else ()
    return [{"sigma_0": part * s.friction / s.travel, "sigma_1": 0.0} for part in bends]


# In the order in which they are tried, those that are the quickest to refit first.
HYPOTHESES = (
    Hypothesis(
        effect="the motor's torque droops at large currents",
        part="droop",
        starts=lambda s: [{"a_i": 0.1 / s.current**2}] if s.current else [],
        usual=lambda s: 0.1 / s.level**2 if s.level else 0.0,
    ),
    Hypothesis(effect="the motor's torque falls with its speed", part="falling_torque", starts=_zero("a_v")),
    Hypothesis(effect="the spring hardens", part="hardening", starts=_zero("k_3")),
    Hypothesis(
        effect="the current lags its command",
        part="current_loop",
        # From more than twice of what it is a step goes beyond zero, from half of it a search is slow.
        starts=lambda s: [{"current_loop_hz": hertz} for hertz in (60.0, 110.0, 200.0)],
        poles=("current_loop_hz",),
        lag=lambda start: 1.0 / (2.0 * math.pi * start["current_loop_hz"]),
    ),
    Hypothesis(
        effect="the command arrives late",
        part="command_delay",
        starts=lambda s: [{"T_c": 1e-3}],  # from more than it is a step beside another effect ends elsewhere
        dead_time="T_c",
    ),
    Hypothesis(
        effect="friction changes over the log",
        part="friction_drift",
        starts=_zero("w_c", "b_t"),
        further=Hypothesis(
            effect="friction changes over the log and settles",
            part="friction_drift",
            starts=_zero("w_c", "b_t", "r_t"),
        ),
    ),
    Hypothesis(
        effect="friction grows with the spring's load",
        part="load_friction",
        starts=lambda s: [{"c_e": 0.03}],
    ),
    Hypothesis(
        effect="friction grows with the motor's effort",
        part="load_friction",
        starts=lambda s: [{"c_m": 0.03}],
    ),
    Hypothesis(effect="breakaway friction is larger than sliding friction", part="stribeck", starts=_rise_at_rest),
    Hypothesis(effect="damping differs between the directions", part="friction_direction", starts=_zero("b_a")),
    Hypothesis(effect="dry friction differs between the directions", part="friction_direction", starts=_zero("f_a")),
    Hypothesis(
        effect="the spring has play",
        part="backlash",
        starts=lambda s: [{"g_b": share * s.deflection} for share in (0.01, 0.05) if s.deflection],
        fixed=lambda s: {"eps_b": 3e-5 * s.deflection},  # a rounder corner shows beside an encoder's noise
    ),
    Hypothesis(
        effect="the spring is damped",
        part="spring_damping",
        starts=_zero("c_k"),
        usual=lambda s: 1e-3 * s.stiffness,
        built_in=lambda plant: None if plant.spring is None else plant.spring.damper,
    ),
    Hypothesis(
        effect="the spring loses energy in each cycle",
        part="hysteresis",
        starts=_slip_in_spring,
        searched=("n_h",),
        stiffens=lambda s, start: start["k_h"] * start["y_h"] / s.deflection,
    ),
    Hypothesis(
        effect="the joint gives way before it slips",
        part="lugre",
        starts=_bend_before_slipping,
    ),
    Hypothesis(effect="the motor cogs", part="cogging", starts=lambda s: [s.ripple] if s.ripple else []),
    Hypothesis(effect="the supply sags", part="supply_sag", starts=_zero("R_b")),
    Hypothesis(
        effect="the command is taken only every few rows of the log",
        part="",
        starts=lambda s: [{}] if s.holds else [],
        holds=True,
    ),
    Hypothesis(
        effect="the servo's firmware runs only every few rows of the log",
        part="servo_sample",
        starts=lambda s: [{}] if s.holds else [],
        holds=True,
    ),
    Hypothesis(
        effect="the servo's firmware holds what it reads",
        part="servo_hold",
        starts=lambda s: [{"T_h": 1e-3}],
    ),
    Hypothesis(
        effect="the servo's firmware acts late",
        part="servo_delay",
        starts=lambda s: [{"T_v": 1e-3}],
        lag=lambda start: start["T_v"],
    ),
    Hypothesis(
        effect="the stand is compliant",
        part="stand",
        starts=lambda s: [{"c_t": 0.02 / s.stiffness}] if s.stiffness else [],
        usual=lambda s: 0.04 / s.stiffness if s.stiffness else 0.0,
    ),
    Hypothesis(
        effect="friction differs between driving and back-driving",
        part="back_driving",
        starts=_zero("d_e"),
        usual=lambda s: 0.05 if s.stiffness else 0.0,
    ),
)


@record(eq=False)
class Change:
    """One or two hypotheses on the experiments of a fit: what is to be refitted."""

    hypotheses: tuple[Hypothesis, ...]
    experiments: tuple[Experiment, ...]
    params: ParameterSet
    starts: Starts  # of what the last of them frees
    frees: tuple[str, ...]  # of all of them
    fixed: Mapping[str, float]
    sizes: Sizes

    @property
    def effect(self) -> str:
        """What the model lacks, in words."""
        return join_words([hypothesis.effect for hypothesis in self.hypotheses])

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts that are added."""
        return tuple(dict.fromkeys(hypothesis.part for hypothesis in self.hypotheses if hypothesis.part))

    @property
    def holds(self) -> Mapping[str, Hold]:
        """Over how many rows the command of each experiment's log is held, and the row from which on; where it is."""
        return self.sizes.holds if any(hypothesis.holds for hypothesis in self.hypotheses) else {}

    def lag(self, start: Mapping[str, float]) -> float:
        """Return what a fitted delay has in place of the last of the hypotheses, s."""
        if not self.hypotheses[-1].holds:
            return self.hypotheses[-1].lag(start)
        return 0.5 * max((self.holds[e.name][0] - 1) * e.log.period for e in self.experiments)


@record(eq=False)
class Addition:
    """An effect that logs may not show, its part ("" where plants have it), and its parameter at the neutral value."""

    effect: str
    part: str
    parameter: Parameter
    size: float  # that actuators have
    plants: Mapping[str, Plant]  # of all experiments of a fit, with its part and those of the additions before it


def list_additions(problem: FitProblem, z: Vector) -> Iterator[Addition]:
    """Yield the hypotheses that logs may not show, on those experiments whose plants take them, one after the other;
    and what plants have of it without a part, fixed. `z`: the values of the fit.
    """
    fitted = (replace(problem.params[name], value=float(z[i])) for i, name in enumerate(problem.shared_names))
    params = problem.params.with_parameters(*fitted)
    data = {experiment.name: experiment.data for experiment in problem.experiments}
    plants = {name: experiment.plant for name, experiment in data.items()}
    for hypothesis in HYPOTHESES:
        if hypothesis.usual is None:
            continue
        changed, names = dict[str, Plant](), set[str]()
        for experiment, plant in plants.items():
            if (built_in := hypothesis.built_in(plant)) is not None:
                if built_in not in data[experiment].parameters:
                    changed[experiment] = plant
                    names.add(built_in)
            elif (other := _add(plant, hypothesis.part)) is not None:
                changed[experiment] = other
                names |= other.parameters.keys() - plant.parameters.keys()
        if len(names) != 1:
            continue
        (name,) = names
        first, plant = next(iter(changed.items()))
        parameter, is_there = plant.parameters[name], name in plants[first].parameters
        if is_there:
            parameter = params[name]
        elif name in params:
            continue
        size = hypothesis.usual(_measure_scale([data[experiment] for experiment in changed], params))
        if not size or not isinstance(parameter, Parameter) or parameter.free:
            continue
        plants = plants | changed
        yield Addition(
            effect=hypothesis.effect + (" more" if parameter.value else ""),
            part="" if is_there else hypothesis.part,
            parameter=parameter,
            size=size,
            plants=plants,
        )


def _measure_scale(experiments: Sequence[Experiment], params: ParameterSet) -> Scale:
    """Return the stiffness of the first spring, and the size of commands that are a pulse or a square wave, the same in
    all logs: these are the same whatever a motor makes of other currents.
    """
    stiffness, levels = 0.0, list[float]()
    for experiment in experiments:
        plant = experiment.plant
        if not stiffness and plant.spring is not None and plant.spring.stiffness:
            stiffness = plant.complete(experiment.apply_own(params))[plant.spring.stiffness].value
        command = None if plant.actuation is None else experiment.log.signals.get(plant.actuation.input)
        if command is not None and np.any(command.values):  # else it is zero throughout, which shows nothing
            levels.append(_find_level(np.abs(command.values)))
    same = bool(levels) and min(levels) > (1.0 - LEVEL) * max(levels)
    return Scale(stiffness=stiffness, level=max(levels) if same else 0.0)


def _find_level(sizes: VectorN) -> float:
    """Return the one size that a log's commands have where they are not zero, but for a few; 0 if they have several."""
    sizes = sizes[np.isfinite(sizes)]
    used = sizes[sizes > LEVEL * np.quantile(sizes, 1.0 - BETWEEN)] if sizes.size else sizes  # the largest are spikes
    level = float(np.median(used)) if used.size else 0.0
    return level if np.sum(np.abs(used - level) > LEVEL * level) < BETWEEN * sizes.size else 0.0


@memo
def _add(plant: Plant, part: str) -> Plant | None:
    """Return a plant with a part; None where it does not take it."""
    try:
        return add_part(plant, part)
    except SeaoptError:
        return None


def change_plants(
    hypothesis: Hypothesis,
    experiments: tuple[Experiment, ...],
    params: ParameterSet,
    sizes: Sizes,
    before: Change | None = None,
) -> Change | None:
    """Return a hypothesis on experiments; None where their plants do not take it, or have it already. `before`: the
    change of another, which the experiments and parameters have.
    """
    starts, fixed = hypothesis.starts(sizes), hypothesis.fixed(sizes)
    if not starts or (hypothesis.dead_time is not None and any(map(_has_delay, experiments))):
        return None
    if hypothesis.holds:
        if before is not None and before.holds:
            return None
        experiments = tuple(_hold(experiment, *sizes.holds[experiment.name]) for experiment in experiments)
    names = {*starts[0], *fixed}
    changed: dict[Plant, Plant] = {}
    for plant in dict.fromkeys(experiment.plant for experiment in experiments):
        if names <= plant.parameters.keys() and (names or not hypothesis.part):
            if any(name in params and (params[name].free or params[name].value != 0.0) for name in names):
                return None
            changed[plant] = plant
            continue
        try:
            changed[plant] = add_part(plant, hypothesis.part)
        except SeaoptError:  # its roles do not tell how, or another part excludes it
            return None
    declared = next(iter(changed.values())).parameters
    if not names <= declared.keys():  # such plants have it without the part, under a name of their own
        return None
    added, fastest = list[Parameter](), FASTEST / min(experiment.log.period for experiment in experiments)
    for name, value in {**starts[0], **fixed}.items():
        parameter = declared[name]
        assert isinstance(parameter, Parameter)
        most = fastest if name in hypothesis.poles else parameter.max
        least = 1.0 / fastest if name == hypothesis.dead_time else parameter.min
        value = min(max(value, least), most)
        added.append(replace(parameter, value=value, min=least, max=most, free=name in starts[0]))
    return Change(
        hypotheses=(*(before.hypotheses if before else ()), hypothesis),
        frees=(*(before.frees if before else ()), *starts[0]),
        fixed={**(before.fixed if before else {}), **fixed},
        experiments=tuple(replace(each, plant=changed[each.plant]) for each in experiments),
        params=params.with_parameters(*added),
        starts=starts,
        sizes=sizes,
    )


def _hold(experiment: Experiment, samples: int, first: int) -> Experiment:
    """Return an experiment whose command stands for so many rows."""
    return replace(experiment, log=experiment.log.hold(name_input(experiment.plant)[0], samples, first))


def _has_delay(experiment: Experiment) -> bool:
    """Tell whether an experiment's delay is estimated, or its plant has one: a servo's is of its firmware."""
    recipe, delay = experiment.plant.recipe, experiment.delay_s
    servo = recipe is not None and "position_servo" in recipe.parts
    return servo or (isinstance(delay, Parameter) and delay.free) or bool(list_dead_times(experiment.plant))


def measure_sizes(fit: Fit) -> Sizes:
    """Return how large things are, of the largest experiment: by a simulation of each with the fit's values."""
    residuals = fit.require_minimum("measure_sizes").residuals()
    rows = [_measure(experiment, fit, residuals) for experiment in fit.experiments]
    largest = {name: max(getattr(row, name) for row in rows) for name in SIZES}
    posed = fit.require_minimum("measure_sizes").problem.experiments
    shares = {e.name: find_holds(e, residuals[e.name], fit.parameters) for e in posed}
    # Firmware has one rate, and begins anywhere in a log.
    common = set[int].intersection(*(set(each) for each in shares.values()))
    samples = max(common, key=lambda rows: sum(each[rows][0] for each in shares.values()), default=0)
    holds = {name: (samples, each[samples][1]) for name, each in shares.items() if samples}
    return Sizes(**largest, ripple=next((row.ripple for row in rows if row.ripple), {}), holds=holds)


def _measure(experiment: Experiment, fit: Fit, residuals: ResidualsByExperiment) -> Sizes:
    plant, log = experiment.follow(fit.parameters), experiment.log
    for name in plant.read_inputs:
        state = plant.followed[name].state
        signal = replace(log.signals[state], name=name, values=experiment.read(state))
        log = replace(log, signals={**log.signals, name: signal})
    number, longest = max(
        enumerate(experiment.log_segments), key=lambda pair: pair[1].stop - pair[1].start
    )  # no gap is crossed
    log = log.between(*(log.time[[longest.start, longest.stop - 1]] - log.time[0]))
    params = plant.complete(experiment.apply_own(fit.parameters))
    run = simulate(plant, params, log, rtol=SIMULATED)
    x, u, p = name_symbols(plant, plant.x, plant.u, plant.p)
    friction = next((each for each in plant.friction.values() if each.bristles is None), None)
    spring, values = plant.spring, params.by_attribute
    rows = [
        getattr(u, plant.actuation.input) if plant.actuation else ca.SX(0),
        friction.velocity(x, p) if friction else ca.SX(0),
        spring.deflection(x, p) if spring else ca.SX(0),
    ]
    read = ca.Function("sizes", [plant.x, plant.u, plant.p], [ca.vertcat(*rows)])
    states, inputs = (np.stack([run[name] for name in names]) for names in (plant.states, plant.inputs))
    current, speed, deflection = np.array(read(states, inputs, params.vector))
    ripple: Mapping[str, float] = {}
    position, left = plant.sensing and plant.sensing.motor_position, residuals[experiment.name]
    if position and position in plant.states and len(left.segments) == len(experiment.log_segments):
        minimum = fit.require_minimum("_measure")
        posed = next(e for e in minimum.problem.experiments if e.name == experiment.name)
        read = experiment.reads(position)
        if plant.moves and read:
            ripple = find_followed_ripple(posed, fit.parameters, longest, minimum.z)
        if not ripple:
            place = experiment.read(position)[longest] if read else run[position]
            ripple = find_ripple(posed, left, fit.parameters, place, number)
            if not (ripple and ripple["n_g"] <= experiment.find_finest(position)):
                ripple = move_zero(posed, minimum.z, ripple, position)
    dry = 0.0 if friction is None or friction.jump is None else friction.jump(0.0, friction.add_rated(values))
    return Sizes(
        current=_find_largest(current),
        speed=_find_largest(speed),
        travel=float(np.ptp(np.cumsum(speed))) * log.period,
        friction=float(ca.DM(dry)),
        deflection=_find_largest(deflection),
        stiffness=getattr(values, spring.stiffness) if spring and spring.stiffness else 0.0,
        ripple=ripple,
    )


def _find_largest(values: Float[np.ndarray, " n"]) -> float:
    return float(np.quantile(np.abs(values), LARGEST))
