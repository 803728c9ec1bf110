r"""Tune a controller: place a bandwidth under limits on several plants at once, for `so.tune`.

The law is eight numbers at most: gains k_p, k_i, k_d; filters T_f, T_q; a notch's frequency, width and depth. Every
limit is a curve over frequency on every plant (`seaopt.control.tuning.optimisation_problem`), and the design plant's
bandwidth an equality. That is solved in four steps, each the next one's start:

1. a scan over filters and two gains, the third from the bandwidth equality in closed form (`find_starts`);
2. from the best, successive quadratic programs in the gains, the convex-concave procedure (`convex_concave`);
3. an interior-point method in all numbers at once, on exact derivatives (`interior_point`);
4. a recheck on frequencies that resolve every pole of plants and closed loops; where a limit is broken between the
   frequencies, those are added and step 3 is repeated.

The result is then measured by `Loop.figures`, which uses none of these frequencies. What is returned as feasible has
been measured to be so. Where limits cannot all be kept, the result misses them by one common factor, the least
found, and the largest bandwidth at which they can be kept is found by bisection.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Complex

from seaopt.control.laws.command import command_of
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.delay import settle_delay
from seaopt.control.laws.limits import MeasuredLoop
from seaopt.control.laws.spec import LOWEST_HZ, ControllerSpec
from seaopt.control.laws.structures import Nominal
from seaopt.control.laws.verdict import explain_broken, judge_all, list_active, list_broken
from seaopt.control.loops.loop import GROWING, Loop
from seaopt.control.loops.port import port_of
from seaopt.control.loops.sampled_plant import sample
from seaopt.control.tuning.convex_concave import improve
from seaopt.control.tuning.feasibility import check_current, check_delay
from seaopt.control.tuning.interior_point import refine
from seaopt.control.tuning.optimisation_problem import OBJECTIVE_HZ, Grid, LawNumbers, Task, place_frequencies
from seaopt.control.tuning.starts import find_starts
from seaopt.errors import ControlError, suggestion
from seaopt.estimation import Fit
from seaopt.formatting import format_values
from seaopt.parameters import ParameterSet
from seaopt.plants import CompletedParameters, Plant
from seaopt.plants.friction import find_dry_friction, split_friction

STARTS_TRIED = 3  # two more where an observer or a notch makes more valleys
STARTS_REFINED = 2  # one more with an observer, all with a notch
RECHECKS = 3
BANDWIDTH_RESOLUTION = 0.01  # to which the largest bandwidth is found
HOPELESS_USAGE = 1.03  # near a bandwidth that is possible, what misses by more is not looked for elsewhere
BANDWIDTHS_PROBED = 5  # when the lowest cannot be met


def tune(
    plant: Plant,
    params: Fit | ParameterSet,
    spec: ControllerSpec,
    robust_to: Mapping[str, Plant | tuple[Plant, ParameterSet]] | None = None,
    *,
    draws: Sequence[Mapping[str, float]] = (),
) -> Controller:
    """Tune a digital force controller.

    Parameters
    ----------
    plant : Plant
        The design plant, the test stand as a rule.
    params : Fit or ParameterSet
        Its parameters; of a fit also the delay, where the specification leaves delay_samples out.
    spec : ControllerSpec
        Bandwidth and limits.
    robust_to : mapping of name to Plant or (Plant, ParameterSet), optional
        Plants that must be stable and meet Ms, Mt and disk margin too, driven by the same current.
    draws : sequence of mappings of parameter to value, optional
        Values at which the design plant and every plant of robust_to must meet them too; see `corners` and `draw`.

    Returns
    -------
    Controller
        With `feasible` False, and the limits that block in `active_constraints`, when the limits cannot all be met;
        it is then the controller that misses them least, and `largest_bandwidth_hz` is what is possible.

    Raises
    ------
    ControlError
        The measured output does not respond to the motor at 0 Hz, the plant is unstable without control, a draw names
        a parameter that no plant has, delay or current limit make the request impossible for every controller, or a
        passive band is required of a plant without a port at link 2, or with an elastic screw before it.

    Examples
    --------
    >>> import seaopt as so
    >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6)
    >>> controller = so.tune(so.plants.high_impedance(), so.plants.thor(), spec)
    >>> controller.feasible, round(controller.achieved.bandwidth_hz)
    (True, 30)

    """
    spec = settle_delay(spec, plant, params)
    params = params.parameters if isinstance(params, Fit) else params
    values = plant.complete(params)
    task = make_task(plant, values, spec, robust_to or {}, draws)
    check_delay(spec, task.plants[0])
    command = command_of(plant, values, spec.measured)
    check_current(spec, task.k_ff, command, find_dry_friction(plant, values))
    x, loops = solve(task)
    largest = None
    if list_broken(judge_all(spec, loops, task.design_states)):
        largest, near = find_largest_bandwidth(task, x)
        # From there another answer may be in reach: a better compromise, or none needed.
        if near is not None:
            x, loops = solve(task, (x, near))
    return make_controller(task, x, loops, (plant, params), largest)


def make_task(
    plant: Plant, params: ParameterSet, spec: ControllerSpec,
    robust_to: Mapping[str, Plant | tuple[Plant, ParameterSet]], draws: Sequence[Mapping[str, float]] = (),
) -> Task:  # fmt: skip
    """Return what is to be tuned.

    Raises
    ------
    ControlError
        As `tune`.

    """
    values = plant.complete(params)
    gain = command_of(plant, values, spec.measured).per_effort
    if not isinstance(robust_to, Mapping):
        raise ControlError(f"robust_to is a {type(robust_to).__name__}; give a mapping of name to plant")
    named = {"design plant": (plant, values)}
    named |= {str(name): p if isinstance(p, tuple) else (p, values) for name, p in robust_to.items()}
    varied = {parameter for draw in draws for parameter in draw}
    models: dict[str, tuple[Plant, CompletedParameters]] = {}
    for name, (model, given) in named.items():
        completed = model.complete(given)
        variants = split_friction({name: model}, completed, varied)
        models |= {one: (variant, variant.complete(completed)) for one, variant in variants.items()}
    pairs = [*models.items(), *_draw_plants(models, draws)]
    design_plant = pairs[0][1][0]
    plants = tuple(
        sample(model, values, spec.measured, gain, spec.sample_time_s, spec.loop_delay_samples)
        for _, (model, values) in pairs
    )
    static = plants[0].static_gain
    if not np.isfinite(static) or abs(static) < 1e-6:
        raise ControlError(
            f"measured = {spec.measured}: the static gain of {plant.name} from motor force is {static:g}, which "
            "feedforward cannot invert; tune on the stand and name this plant in robust_to"
        )
    names = tuple(name for name, _ in pairs)
    for name, sampled in zip(names, plants, strict=True):
        if np.max(np.abs(np.linalg.eigvals(sampled.a))) > GROWING:
            raise ControlError(f"plant {name} is unstable without control, which the tuner does not treat")
    nominal = Nominal.of(plants[0]) if spec.structure == "pid_dob" else None
    port = None if spec.passive_band_hz is None else port_of(design_plant, values, spec.measured, gain)
    return Task(
        spec=spec, plants=plants, names=names, k_ff=1.0 / static, nominal=nominal, port=port,
        design_states=1 if design_plant is plant else 2,
    )  # fmt: skip


def _draw_plants(
    models: Mapping[str, tuple[Plant, CompletedParameters]], draws: Sequence[Mapping[str, float]]
) -> list[tuple[str, tuple[Plant, CompletedParameters]]]:
    """Return every plant at every draw, under a name; a draw that changes nothing of a plant is left out."""
    known = {name for model, _ in models.values() for name in model.parameters}
    out: list[tuple[str, tuple[Plant, CompletedParameters]]] = []
    for number, values in enumerate(draws, start=1):
        for parameter in values:
            if parameter not in known:
                raise ControlError(f'draws name "{parameter}", which no plant has; {suggestion(parameter, known)}')
        for name, (model, nominal) in models.items():
            used = {key: float(value) for key, value in values.items() if key in model.parameters}
            if not used:
                continue
            label = format_values(used, missing="") if len(used) < 3 else f"draw {number}"
            out.append((f"{name}, {label}", (model, model.complete(nominal.update(**used)))))
    return out


def solve(task: Task, warm: Sequence[LawNumbers] = ()) -> tuple[LawNumbers, list[MeasuredLoop]]:
    """Find the best numbers, and return them with every plant's loop.

    Parameters
    ----------
    task : Task
        What is to be tuned.
    warm : sequence of arrays, shape (8,)
        Numbers to start from besides those of the scan, which then tries one less.

    """
    grid = task.grid(place_frequencies(task))
    x = find_best(task, grid, warm)
    for _ in range(RECHECKS):
        missed = _find_missed(task, x, grid)
        if not missed.size:
            break
        grid = task.grid(np.unique(np.concatenate([grid.f, missed])))
        x = refine(task, grid, x)
    return x, task.measure(x)


def find_best(task: Task, grid: Grid, warm: Sequence[LawNumbers] = ()) -> LawNumbers:
    """Find the best numbers on a grid."""
    more = task.nominal is not None or task.spec.notch is not None
    warm = [task.tidy(x) for x in warm]
    first = [x for x in warm if task.is_stable(x)] + find_starts(task, grid, STARTS_TRIED + 2 * more - bool(warm))
    ranked = sorted((improve(task, grid, x) for x in first), key=lambda pair: pair[0])
    count = len(ranked) if task.spec.notch is not None else STARTS_REFINED + more
    chosen: list[LawNumbers] = []
    for _, x in ranked:
        if len(chosen) < count and not any(np.allclose(x, other, rtol=0.1, atol=1e-6) for other in chosen):
            chosen.append(x)
    return min((refine(task, grid, x) for x in chosen), key=lambda x: task.rank(grid, x))


def _find_missed(task: Task, x: LawNumbers, grid: Grid) -> np.ndarray:
    """Return frequencies between the grid's at which more of a limit is used than anywhere on it."""
    allowed = {name: max(1.0, float(np.max(curve))) for name, curve in task.usage(grid, x).items()}
    out: list[float] = []
    for row in range(len(task.plants)):
        dense = task.loop(x, row).grid()
        f = dense[(dense >= LOWEST_HZ) & (dense < grid.f[-1])]
        for name, curve in task.usage(task.grid(f, [row]), x).items():
            top = int(np.argmax(curve))
            if curve[0, top] > allowed[name] * (1.0 + max(0.4 * task.spec.reserve, 1e-6)):
                out.append(float(f[top]))
    return np.array([f for f in out if np.min(np.abs(grid.f / f - 1.0)) > 1e-7])


def find_largest_bandwidth(task: Task, x: LawNumbers) -> tuple[float, LawNumbers | None]:
    """Return the largest bandwidth in range that keeps the limits, and its numbers; 0 and None if there is none.

    Found by bisection from the bandwidth asked, which does not keep them, towards the lowest; if that does not either,
    a few others are tried first. It is right to a hundredth, if limits that can be kept at one bandwidth can be kept
    at a lower one.
    """
    spec, asked = task.spec, task.spec.bandwidth_hz
    low = max(spec.bandwidth_range_hz[0], 1.01 * (spec.min_sensitivity_bandwidth_hz or 0.0))
    near: list[LawNumbers] = []

    def possible(bandwidth_hz: float) -> bool:
        feasible = _find_feasible(
            replace(task, spec=replace(spec, bandwidth_hz=bandwidth_hz)), near[-1] if near else x, near=bool(near)
        )
        near.extend([] if feasible is None else [feasible])
        return feasible is not None

    tried = [low, *np.geomspace(low, asked, BANDWIDTHS_PROBED + 2)[-2:0:-1]] if low < asked else []
    first = next((k for k, f in enumerate(tried) if possible(float(f))), None)
    if first is None:
        return 0.0, None
    lower, upper = tried[first], tried[first - 1] if first > 1 else asked
    while upper / lower > 1.0 + BANDWIDTH_RESOLUTION:
        middle = float(np.sqrt(lower * upper))
        lower, upper = (middle, upper) if possible(middle) else (lower, middle)
    return float(lower), near[-1]


def _find_feasible(task: Task, x: LawNumbers, *, near: bool) -> LawNumbers | None:
    """Return numbers that keep all limits on the frequencies looked at, or None: from x first, then from anywhere.

    Near a bandwidth that is possible what x misses clearly is not looked for anywhere else.
    """
    grid = task.grid(place_frequencies(task))
    x = task.tidy(x)
    if task.is_stable(x):
        x = refine(task, grid, x)
        usage, _ = task.rank(grid, x)
        if usage == 0.0 or (near and usage > HOPELESS_USAGE):
            return x if usage == 0.0 else None
    x = find_best(task, grid, [x])
    return x if task.rank(grid, x)[0] == 0.0 else None


def make_controller(
    task: Task,
    x: LawNumbers,
    loops: Sequence[MeasuredLoop],
    design: tuple[Plant, ParameterSet],
    largest: float | None = None,
) -> Controller:
    """Return the controller of tuned numbers."""
    spec, gains = task.spec, task.gains(x)
    verdicts = judge_all(spec, loops, task.design_states)
    broken = list_broken(verdicts)
    return Controller(
        structure=spec.structure,
        gains=gains.by_name(),
        sample_time_s=spec.sample_time_s,
        delay_samples=spec.loop_delay_samples,
        law=task.law_of(x).balanced(),
        command=command_of(*design, spec.measured),
        spec=spec,
        achieved=loops[0].figures,
        feasible=not broken,
        active_constraints=tuple(broken or list_active(spec, verdicts)),
        robust_to=task.names[task.design_states :],
        design=design,
        observer=gains.observer,
        blocked_by=tuple(explain_broken(spec, verdicts, loops[0], task.loop(x))),
        largest_bandwidth_hz=largest,
    )


def disturbance(loop: Loop, bandwidth_hz: float) -> float:
    """Return the integral over ln f of abs(S) from 0.1 Hz to the bandwidth."""
    f = np.geomspace(OBJECTIVE_HZ, bandwidth_hz, 2000)
    s: Complex[np.ndarray, " m"] = loop.sensitivity(f)
    return float(np.trapezoid(np.abs(s), np.log(f)))
