r"""Tune a controller: place a bandwidth under limits on several plants at once, for `so.tune`.

The law is fourteen numbers at most: gains k_p, k_i, k_d, and k_v of a speed loop; weights k_r, c of the reference;
filters T_f, T_q; the speed loop's T_v; a notch's frequency, width and depth; a prefilter's corner and damping. Every
limit is a curve over frequency on every plant (`seaopt.control.tuning.optimisation_problem`), and the design plant's
bandwidth an equality. That is solved by `seaopt.control.tuning.solution`.

The result is then measured by `Loop.figures`, which uses none of these frequencies. What is returned as feasible has
been measured to be so. Where no law is found that keeps them all, an evolution looks for one
(`seaopt.control.tuning.evolution`); where that has none either, the result misses them by one common factor, the least
found, and the bandwidths at which they can be kept are looked for (`seaopt.control.tuning.possible_bandwidths`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from seaopt.control.laws.command import command_of
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.delay import place_drive_delay, settle_delays, take_own_delays
from seaopt.control.laws.friction import find_friction_margin
from seaopt.control.laws.limits import FAST_BANDWIDTH, MeasuredLoop
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.laws.structures import CASCADE, CUSTOM, DisturbanceObserver, Nominal, SpeedLoop
from seaopt.control.laws.verdict import PossibleBandwidths, explain_broken, judge_all, list_active, list_broken
from seaopt.control.loops.compensation.link_feedforward import (
    LinkPath,
    limit_fraction,
    model_link_path,
    name_link_signal,
)
from seaopt.control.loops.friction_loop import make_friction_loops
from seaopt.control.loops.law import Law
from seaopt.control.loops.loop import Loop
from seaopt.control.loops.measured.loop import DiscLoop, measure_all_discs
from seaopt.control.loops.measured.plant import MeasuredPlant
from seaopt.control.loops.moved_link import close_plant
from seaopt.control.loops.port import port_of
from seaopt.control.loops.sampled_plant import (
    DRIVE_DELAY,
    DigitalPlant,
    conditions,
    find_signals,
    list_names,
    read_conditions,
    sample,
)
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.control.systems.block import EFFORT, REFERENCE, add_up
from seaopt.control.tuning.feasibility import check_current, check_delay
from seaopt.control.tuning.found_law import FoundLaw, Surround, find_law, find_near, meet_outer
from seaopt.control.tuning.frequencies import count_growing
from seaopt.control.tuning.grid import FRICTION, PlantWithFriction, Response
from seaopt.control.tuning.law_numbers import LawNumbers
from seaopt.control.tuning.optimisation_problem import OBJECTIVE_HZ, Task
from seaopt.control.tuning.solution import ROOM, feed_link, weigh_link
from seaopt.errors import ControlError, InternalError, SeaoptError, require_number, require_type, suggestion
from seaopt.estimation import Fit
from seaopt.formatting import format_values
from seaopt.frequency import MeasuredResponse
from seaopt.parameters import ParameterSet
from seaopt.plants import CompletedParameters, Plant
from seaopt.plants.friction import (
    FAST,
    SLIDING,
    falls,
    find_dry_friction,
    friction_slopes,
    friction_states,
    slide_fast,
    split_friction,
    take_sliding,
)
from seaopt.plants.motor.thermal import rate_motor
from seaopt.plants.plant import require_plant
from seaopt.progress import Progress, divide, ignore

FRACTION_FREQUENCIES = 1500
# Hz and share of the bandwidth: from there down to here a gain falls so far where nothing holds the link.
STILL_HZ, LASTING, FALLS = 1e-4, 0.1, 0.01
NO_FORCE = 0.02  # of the design plant's static gain: where the force answers less, the feedback does next to nothing
USUAL_MS = 1.7  # that the fraction of a feedforward is chosen for where no Ms is asked
AROUND = 1.0  # of the time of a tune: once more with the outer loop

Draws = Sequence[Mapping[str, float]]  # of values by parameter
RobustTo = Mapping[str, Plant | tuple[Plant, ParameterSet] | MeasuredResponse]


def tune(
    plant: Plant | MeasuredResponse,
    params: Fit | ParameterSet,
    spec: ControllerSpec,
    robust_to: RobustTo | None = None,
    *,
    draws: Draws = (),
    outer: Surround | None = None,
    near: Controller | None = None,
    progress: Progress = ignore,
) -> Controller:
    """Tune a digital force controller.

    Parameters
    ----------
    plant : Plant or MeasuredResponse
        The design plant, the test stand as a rule; or its measured frequency response (`seaopt.measure_response`), of
        which all limits hold for every response in the discs: the bandwidth is placed on their centres, and none is
        below 0.97 of it.
    params : Fit or ParameterSet
        Its parameters; of a fit also the drive's delay. Of a measured
        response they only say what effort the command makes, in which gains are counted.
    spec : ControllerSpec
        Bandwidth and limits.
    robust_to : mapping of name to Plant, (Plant, ParameterSet) or MeasuredResponse, optional
        Plants that must be stable and meet Ms, Mt and disk margin too, driven by the same current; of a measured one
        every response in the discs.
    draws : sequence of mappings of parameter to value, optional
        Values at which the design plant and every plant of robust_to must meet them too; see `corners` and `draw`.
    outer : callable, optional
        Returns the outer loop that a tuned controller is to run with, or None: the `outer` of what
        `seaopt.control.add_impedance` returns. Ms, Mt, disk margin and stability are then those of both loops on every
        plant whose link moves; what is asked of the design plant alone is asked of the force law.
    near : Controller, optional
        A law of the same parts that was tuned with a limit or the bandwidth a little off: only what is near it is
        looked at, in a third of the time, and everything where that keeps not all limits, or a friction margin is
        asked for. A far better law of other gains is not seen.
    progress : callable, optional
        Called with what is done and the share of it that is done (`seaopt.progress.Progress`).

    Returns
    -------
    Controller
        With `feasible` False, and the limits that block in `binding`, when the limits cannot all be met;
        it is then the controller that misses them least, and `possible` has the bandwidths that keep them.

    Raises
    ------
    InternalError
        A defect of seaopt; its note has the request.
    ControlError
        The measured output does not respond to the motor at 0 Hz, a draw names a parameter that no plant has, delay or
        current limit make the request impossible for every controller, a passive band is required of a plant without
        a port at link 2, or a friction margin where friction acts on the measured output itself or the plant is not
        linear besides it.

    Examples
    --------
    >>> import seaopt as so
    >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6)
    >>> controller = so.tune(so.plants.high_impedance(), so.plants.thor(), spec)
    >>> controller.feasible, round(controller.achieved.bandwidth_hz)
    (True, 30)
    """
    require_type(spec, ControllerSpec, "spec", "give a ControllerSpec", ControlError)
    raised: list[Exception] = []  # by the caller's own hook, which is how a caller stops a tune

    def hook(note: str, share: float | None = None, /) -> None:
        try:
            progress(note, share)
        except Exception as error:
            raised.append(error)
            raise

    try:
        return _tune(plant, params, spec, robust_to or {}, draws, outer, near, hook)
    except (SeaoptError, MemoryError):
        raise
    except Exception as error:
        if error in raised:
            raise
        raise InternalError.of(error, "tune", _describe_request(plant, params, spec, robust_to or {}, draws)) from error


def _describe_request(
    plant: Plant | MeasuredResponse, params: Fit | ParameterSet, spec: ControllerSpec, robust_to: RobustTo, draws: Draws
) -> str:
    """Return what it takes to repeat a call."""
    values = params.parameters if isinstance(params, Fit) else params
    named = {name: (plant[0] if isinstance(plant, tuple) else plant).name for name, plant in robust_to.items()}
    numbers = {name: parameter.value for name, parameter in values.items()}
    return (
        f"plant: {plant.name}; parameters: {numbers}; specification: {spec.to_dict()}; "
        f"robust_to: {named}; draws: {[dict(values) for values in draws]}"
    )


def _tune(
    plant: Plant | MeasuredResponse,
    params: Fit | ParameterSet,
    spec: ControllerSpec,
    robust_to: RobustTo,
    draws: Draws,
    outer: Surround | None,
    near: Controller | None,
    progress: Progress,
) -> Controller:
    model = name_design(plant)
    if spec.structure == CUSTOM:
        raise ControlError('structure = "custom" is of a law that is given, which nothing tunes; use seaopt.assess')
    if spec.structure != CASCADE and not isinstance(spec.measured, str):
        raise ControlError(
            f'measured = {list(spec.measured)}: structure = "{spec.structure}" feeds back one output; name one, or '
            'give structure = "cascade"'
        )
    robust_to = take_own_delays(spec, model, robust_to, params)
    spec, params = settle_delays(spec, model, params)
    values = model.complete(params)
    if model.winding is not None:
        rate_motor(model, values)  # the controller states it: refused here, not when it is printed
    task = make_task(plant, values, spec, robust_to, draws)
    if isinstance(task.plants[0], DigitalPlant):
        check_delay(spec, task.plants[0])
    command = command_of(model, values, spec.regulated)
    check_current(spec, task.k_ff, command, {} if model is not plant else find_dry_friction(model, values))
    at_rest, allowed = _find_rest_gain(task), spec.level("max_noise_gain")
    if at_rest is not None and allowed is not None:  # no law keeps it, at any bandwidth: the others are looked after
        task = replace(task, eased={"max_noise_gain": ROOM * at_rest / allowed})
    alone, around = divide(progress, 1.0, AROUND * (outer is not None))
    found = None if near is None else find_near(task, near)
    found = find_law(task, (), alone) if found is None else found
    if outer is not None:
        found = meet_outer(found, partial(_describe, design=(plant, params)), outer, around)
    found = replace(found, task=weigh_link(found.task, found.x, found.loops))
    controller = _describe(found, (plant, params))
    progress(f"{spec.structure}, {spec.bandwidth_hz:g} Hz", 1.0)
    return controller


def _describe(found: FoundLaw, design: tuple[Plant | MeasuredResponse, ParameterSet]) -> Controller:
    return make_controller(found.task, found.x, found.loops, design, found.possible)


def name_design(plant: Plant | MeasuredResponse) -> Plant:
    """Return the plant that says what commands a design plant, model or measured. Raises ControlError: neither."""
    model = plant.plant if isinstance(plant, MeasuredResponse) else plant
    require_plant(model, "plant", ControlError)
    return model


def make_task(
    plant: Plant | MeasuredResponse, params: ParameterSet, spec: ControllerSpec, robust_to: RobustTo, draws: Draws = ()
) -> Task:
    """Return the task of a request. Raises ControlError: as `tune`."""
    design = name_design(plant)
    values = design.complete(params)
    command = command_of(design, values, spec.regulated)
    if spec.structure == CASCADE:
        _check_cascade(spec, design)
    gain, signals = command.per_effort, find_signals(design, spec.measured)
    require_type(draws, Sequence, "draws", "give a sequence of mappings of parameter to value", ControlError)
    for draw in draws:
        require_type(draw, Mapping, "one of draws", "give a mapping of parameter to value", ControlError)
    seen: dict[str, MeasuredPlant] = {}
    first: dict[str, MeasuredPlant] = {}
    named: dict[str, tuple[Plant, ParameterSet]] = {}
    if isinstance(plant, MeasuredResponse):
        _check_measured_design(spec)
        first[f"frf:{plant.name}"] = spec.see_response(plant, command)
    else:
        named["design plant"] = (plant, values)
    late = read_conditions(design, values).get(DRIVE_DELAY, 0.0)
    for name, other in robust_to.items():
        if isinstance(other, MeasuredResponse):
            seen[str(name)] = spec.see_response(other, command)
            continue
        pair = other if isinstance(other, tuple) else (other, values)
        if len(pair) != 2:
            raise ControlError(f"robust_to: {name} is a tuple of {len(pair)}; give a plant, or (plant, parameters)")
        require_plant(pair[0], f"robust_to: {name}", ControlError)
        named[str(name)] = (pair[0], place_drive_delay(spec, pair[1], late)) if pair is other else pair
    link = find_link(spec, named, gain)
    if link is not None:
        named = {name: (link.see(model), params) for name, (model, params) in named.items()}
        design, signals = link.see(design), (*signals, link.measured)
    varied = {parameter for draw in draws for parameter in draw}
    models: dict[str, tuple[Plant, CompletedParameters]] = {}
    design_states, fast = 1 if first else len(split_friction({"": design}, values, varied)), None
    if not first and spec.level(FAST_BANDWIDTH) is not None and falls(design, values):
        fast, design_states = design_states, design_states + 1
    whole: dict[Plant, Plant] = {}  # the plant with its friction, of one that slides
    for name, (model, params) in named.items():
        completed = model.complete(params)
        variants = split_friction({name: model}, completed, varied)
        if not models and fast is not None:
            variants[f"{name} {FAST}"] = slide_fast(model)
        models |= {state: (variant, variant.complete(completed)) for state, variant in variants.items()}
        if model not in variants.values():  # it has friction, and is there twice or more
            whole[friction_states(model)[SLIDING]] = model
    pairs = [*models.items(), *_draw_plants(models, draws)]
    sampled = (sample(*pair, signals, gain, spec.sample_time_s, spec.loop_delay_samples) for _, pair in pairs)
    plants = (*first.values(), *sampled, *seen.values())
    static = plants[0].static_gain
    if not np.isfinite(static) or abs(static) < 1e-6:
        raise ControlError(
            f"measured = {spec.regulated}: the static gain of {design.name} from what the motor gives is {static:g}, "
            "which feedforward cannot invert; tune on the stand and name this plant in robust_to"
        )
    names = (*first, *(name for name, _ in pairs), *seen)
    nominal = port = None
    if spec.structure == "pid_dob":
        nominal = _find_nominal(spec, plants[0], design, values, signals, gain)
    if isinstance(plants[0], DigitalPlant):
        port = None if spec.passive_band_hz is None else port_of(pairs[0][1][0], values, signals, gain)
    speed_loop = spec.find_speed_loop(signals)
    further: tuple[TransferFunction | SpeedLoop, ...] = () if speed_loop is None else (speed_loop,)
    if link is not None:
        link = choose_fraction(link, spec, plants)
        further = (*further, link.feedback(spec.sample_time_s))
    return Task(
        spec=spec,
        plants=plants,
        names=names,
        k_ff=1.0 / static,
        nominal=nominal,
        port=port,
        design_states=design_states,
        fast=fast,
        signals=signals,
        frictions=_find_friction(spec, signals, [pair for _, pair in pairs], plants, whole, gain, len(first)),
        further=further,
        link=link,
        models=(*(None for _ in first), *(pair for _, pair in pairs), *(None for _ in seen)),
    )


def _check_cascade(spec: ControllerSpec, design: Plant) -> None:
    """Refuse a cascade whose second signal is not the motor's speed."""
    first, name = list_names(spec.measured)
    speed = None if design.sensing is None else design.sensing.motor_speed
    if speed is not None and name != speed:
        raise ControlError(
            f'measured = {[first, name]}: a cascade reads the motor\'s speed second, and "{name}" is not that of '
            f'{design.name}; give measured = ["{first}", "{speed}"]'
        )


def find_link(
    spec: ControllerSpec, named: Mapping[str, tuple[Plant, ParameterSet]], per_effort: float
) -> LinkPath | None:
    """Return the path from the link's motion, of the first plant whose link moves; None where none is requested. Raises
    ControlError: no plant has such a signal.
    """
    feedforward = spec.link_feedforward
    if feedforward is None:
        return None
    for model, values in named.values():
        if name_link_signal(feedforward, model) is not None:
            return model_link_path(feedforward, model, values, spec.regulated, per_effort, spec.bandwidth_hz)
    signal = feedforward.measured
    missing = "link motion" if signal is None else f'output "{signal}" that is its link\'s motion'
    raise ControlError(
        f"link_feedforward: none of {', '.join(named)} has a {missing}; name a plant whose link moves in robust_to, "
        'as robust_to = ["swing"]'
    )


def choose_fraction(link: LinkPath, spec: ControllerSpec, plants: Sequence[DigitalPlant | MeasuredPlant]) -> LinkPath:
    """Return the path with the largest fraction that may be, where none is stated."""
    if spec.link_feedforward is None or spec.link_feedforward.fraction is not None:
        return link
    models = [plant for plant in plants if isinstance(plant, DigitalPlant)]
    f = np.geomspace(0.1 * OBJECTIVE_HZ, spec.bandwidth_hz, FRACTION_FREQUENCIES)
    regulated, motions = (
        np.array(part) for part in zip(*(plant.responses(f)[[0, -1]] for plant in models), strict=True)
    )
    beyond = np.abs(regulated) < NO_FORCE * abs(models[0].static_gain)
    largest = (spec.level("max_sensitivity") or USUAL_MS) * (1.0 - spec.reserve)
    return replace(link, fraction=limit_fraction(link, motions, beyond, f, spec.sample_time_s, largest))


def aim_task(task: Task, spec: ControllerSpec) -> Task:
    """Return a task at another bandwidth, with the corners and the largest fraction of the link's path there."""
    task, feedforward = replace(task, spec=spec), spec.link_feedforward
    if feedforward is None or task.link is None:
        return task
    return feed_link(task, choose_fraction(feedforward.place(task.link, spec.bandwidth_hz), spec, task.plants))


def _find_nominal(
    spec: ControllerSpec,
    first: DigitalPlant | MeasuredPlant,
    design: Plant,
    values: CompletedParameters,
    signals: tuple[str, ...],
    gain: float,
) -> Nominal:
    """Return an observer's nominal plant: the design plant; of a measured response what was on the bench, with the
    gain at rest that was measured, as the reference is weighted by that.
    """
    if isinstance(first, DigitalPlant):
        return Nominal.of(first)
    model = take_sliding(design, values)
    nominal = Nominal.of(sample(model, values, signals, gain, spec.sample_time_s, spec.loop_delay_samples))
    return nominal.scaled(nominal.inverse_gain / (first.static_gain * nominal.static_inverse))


def _check_measured_design(spec: ControllerSpec) -> None:
    """Refuse what takes a model of the design plant, where that is a measured response."""
    asked = [name for name in (FRICTION, FAST_BANDWIDTH) if spec.level(name) is not None]
    if spec.passive_band_hz is not None or asked:
        name = "passive_band_hz" if spec.passive_band_hz is not None else asked[0]
        raise ControlError(
            f"{name} takes a model of the design plant, and that is a measured response; leave it out, or design on a "
            "model and name the response in robust_to"
        )


def _find_friction(
    spec: ControllerSpec,
    signals: tuple[str, ...],
    pairs: Sequence[tuple[Plant, CompletedParameters]],
    plants: Sequence[DigitalPlant | MeasuredPlant],
    whole: Mapping[Plant, Plant],
    gain: float,
    before: int,
) -> tuple[PlantWithFriction, ...]:
    """Return the plants of which a friction margin is required, and those that grow as they slide. `whole`: of a plant
    that slides the one with friction. `before`: how many of the task's `plants` precede the pairs.
    """
    nothing = Law.of(add_up(EFFORT, dict.fromkeys((REFERENCE, *signals), 0.0)), spec.sample_time_s)
    slope, frictions = spec.level(FRICTION), list[PlantWithFriction]()
    for number, (model, values) in enumerate(pairs, start=before):
        if model not in whole or (slope is None and not count_growing(plants[number])):
            continue
        plant = whole[model]
        (loop,) = make_friction_loops(plant, [values], signals, gain, spec.loop_delay_samples, nothing)
        if loop is None:
            continue
        if slope is not None and loop.obstacle:
            raise ControlError(
                f"{FRICTION} = {slope:g} cannot be shown on {plant.name}: {loop.obstacle}; leave the limit out, or "
                "change the plant or the measured output"
            )
        flattest, _ = friction_slopes(plant, values)
        frictions.append(PlantWithFriction(plant=number, model=plant, loop=loop, flattest=flattest))
    return tuple(frictions)


def _draw_plants(
    models: Mapping[str, tuple[Plant, CompletedParameters]], draws: Draws
) -> list[tuple[str, tuple[Plant, CompletedParameters]]]:
    """Return every plant at every draw, under a name; a draw that changes nothing of a plant is left out."""
    names = {name for model, _ in models.values() for name in (*model.parameters, *conditions((model,)))}
    pairs: list[tuple[str, tuple[Plant, CompletedParameters]]] = []
    for number, values in enumerate(draws, start=1):
        for name in values:
            if name not in names:
                raise ControlError(f'draws name "{name}", which no plant has; {suggestion(name, names)}')
        drawn = {name: require_number(value, f"draws: {name}", ControlError) for name, value in values.items()}
        for plant, (model, nominal) in models.items():
            parameters = {**conditions((model,)), **nominal}
            used = {name: value for name, value in drawn.items() if name in parameters}
            if not used:
                continue
            label = format_values(used, missing="") if len(used) < 3 else f"draw {number}"
            changed = (replace(parameters[name], value=value) for name, value in used.items())
            completed = model.complete(nominal.given.with_parameters(*changed))
            pairs.append((f"{plant}, {label}", (model, completed)))
    return pairs


def make_controller(
    task: Task,
    x: LawNumbers,
    loops: Sequence[MeasuredLoop],
    design: tuple[Plant | MeasuredResponse, ParameterSet],
    possible: PossibleBandwidths | None = None,
) -> Controller:
    """Return the controller of tuned numbers."""
    gains = task.gains(x)
    return describe_law(
        task,
        task.law_of(x).balanced(),
        loops,
        design,
        gains=gains.by_name(),
        observer=gains.observer,
        possible=possible,
    )


def describe_law(
    task: Task,
    law: Law,
    loops: Sequence[MeasuredLoop],
    design: tuple[Plant | MeasuredResponse, ParameterSet],
    *,
    gains: Mapping[str, float],
    observer: DisturbanceObserver | None = None,
    possible: PossibleBandwidths | None = None,
) -> Controller:
    """Return the controller of a law whose loops are measured."""
    spec, (plant, params) = task.spec, design
    if not isinstance(plant, MeasuredResponse) and task.link is not None:
        plant = task.link.see(plant)
    verdicts = judge_all(spec, loops, task.design_states)
    broken = list_broken(verdicts)
    explanations = explain_broken(spec, verdicts, loops[0], close_plant(task.plants[0], law))
    controller = Controller(
        structure=spec.structure,
        gains=gains,
        sample_time_s=spec.sample_time_s,
        compute_delay_samples=spec.loop_delay_samples,
        drive_delay_s=read_conditions(name_design(plant), params).get(DRIVE_DELAY, 0.0),
        law=law,
        command=command_of(name_design(plant), params, spec.regulated),
        spec=spec,
        achieved=loops[0].figures if task.moved is None else replace(task, moved=None).measure_figures(law),
        met=not broken,
        binding=tuple(broken or list_active(spec, verdicts)),
        robust_to=task.names[task.design_states :],
        design=None if isinstance(plant, MeasuredResponse) else (plant, params),
        measured_on=(name_design(plant), params) if isinstance(plant, MeasuredResponse) else None,
        observer=observer,
        blocked_by=tuple(_explain_rest(task, limit, text) for limit, text in explanations.items()),
        possible=None if not broken else possible,
        measured=measure_all_discs(task.plants, law, spec.bandwidth_hz),
        link=task.link,
        outer=None if task.moved is None else task.moved.outer,
        reads=() if task.signals == list_names(spec.measured) else task.signals,
    )
    if isinstance(plant, MeasuredResponse):
        return controller
    return replace(controller, friction=find_friction_margin(controller, plant, params))


def _find_rest_gain(task: Task) -> float | None:
    """Return the noise gain that any integral has on the stuck plant at rest; None where the limit allows it. An
    integral holds the reading at rest: it makes 1/P(0) there, which is far above 1 where bristles hold the motor.
    """
    allowed = task.spec.level("max_noise_gain")
    at_rest = max((1.0 / abs(plant.static_gain) for plant in task.plants[1 : task.design_states]), default=0.0)
    return None if allowed is None or task.spec.structure == "pd" or at_rest <= allowed else at_rest


def _has_unheld(task: Task) -> bool:
    """Tell whether the law integrates, and no effort lasts on some plant: at rest its gain is zero."""
    f = np.array([STILL_HZ, LASTING * task.spec.bandwidth_hz])
    gains = [np.abs(plant.response(f)) for plant in task.plants if isinstance(plant, DigitalPlant)]
    return task.spec.structure != "pd" and any(still < FALLS * moving for still, moving in gains)


def _explain_rest(task: Task, limit: str, text: str) -> str:
    """Return what is said of a broken limit; of a noise gain, or of a stability, that no integral keeps, that, too."""
    if limit == "stability" and _has_unheld(task):
        return (
            f"{text}: nothing holds the link there, so that no effort lasts on it, and an integral drifts; take "
            'structure = "pd", or leave that plant out of robust_to'
        )
    at_rest = _find_rest_gain(task) if limit == "max_noise_gain" else None
    if at_rest is None:
        return text
    return f"{text}, where any integral makes {at_rest:.4g}: give max_noise_gain = {math.ceil(1.01 * at_rest)}"


def disturbance(loop: Loop | DiscLoop, bandwidth_hz: float) -> float:
    """Return the integral over ln f of abs(S) from 0.1 Hz to the bandwidth."""
    f = np.geomspace(OBJECTIVE_HZ, bandwidth_hz, 2000)
    s: Response = loop.sensitivity(f)
    return float(np.trapezoid(np.abs(s), np.log(f)))
