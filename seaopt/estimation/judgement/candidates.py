"""What may be wrong where a fit does not explain its logs: other values, delays, channels, units, parts and plants.

Each candidate is one change of the problem, with the words for what comes of it; `causes` refits and weighs them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import field, replace
from itertools import combinations, zip_longest
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.estimation.judgement.score_test import ScoreTest, find_candidates, free_more, run_score_tests
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.residual_statistics import ResidualsByExperiment
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.formatting import join_words
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import list_smoothing
from seaopt.plants.parts import wrapped
from seaopt.plants.plant import name_symbols
from seaopt.records import record
from seaopt.units import ROTARY, mechanics_of, unit_after

MOST_REFITTED, MOST_BENDING = 6, 4  # fixed parameters, and those that would make a linear plant nonlinear
SAME_EFFECT = 1e-3  # of a test's figures, by which parameters that act alike may differ
LOAD, LOAD_SHARE = "load_at_motor", "share_of_load"  # of friction that is tried
LEAD = 40  # samples that signals are shifted by so that a delay may be negative
UNIT_FACTORS = {1e3: "1000", 1e-3: "0.001", 4.448: "4.448", 1.0 / 4.448: "1/4.448"}
LIKELY_GAINS = (0.05, 20.0)  # of sensors that are not of another unit
SNAP = 0.1  # of a factor: an estimate so near is taken for it
FASTEST_POLE = 2.0  # of Nyquist's frequency: a sensor's pole beyond it does nothing that a log shows
CLIP_QUANTILES = 1.0 - np.geomspace(1e-3, 0.4, 40)  # of what was measured: where it may be cut
CLIPPED_SAMPLES = 20  # that have to be beyond a level
CLIPPED_POWER = 0.2  # of a residual's

V = TypeVar("V")


@record(eq=False)
class Candidate:
    """A change to be refitted, and how to say what came of it: nothing where it came to nothing.

    `delays` are unknowns whose refit starts from the best of `FIRST_DELAYS`, all alike, `gains` unknowns that start
    from how a simulation compares with its output. `frees` are those whose values are worth stating, and what is to be
    taken off them. Where `certain`, nothing but a mistake explains a gain. `kept` are
    the fit's own experiments with the samples that the change leaves, where it leaves out some: residuals of other
    samples tell a gain of many units by chance.
    """

    where: str
    experiments: tuple[Experiment, ...]
    params: ParameterSet
    describe: Callable[[Mapping[str, float], Mapping[str, float]], str | None]  # of the unknowns, and their stds
    certain: bool = False
    delays: tuple[str, ...] = ()
    gains: tuple[str, ...] = ()
    kept: tuple[Experiment, ...] = ()
    frees: Mapping[str, float] = field(default_factory=dict[str, float])


def list_candidates(
    fit: Fit,
    minimum: Minimum,
    residuals: ResidualsByExperiment,
    suspects: Mapping[str, ScoreTest],
    alternatives: Sequence[Plant],
    *,
    poor: bool,
) -> Iterator[Candidate]:
    """Yield the changes to try."""
    first = minimum.problem.params
    values = first if poor else fit.parameters
    yield from _swap_channels(fit.experiments, values, poor=poor)
    if poor:
        for plant in alternatives:  # the right one is soon found, and the wrong one takes long to refit
            yield from _change_plant(fit.experiments, first, plant)
        yield from _free_gains(fit.experiments, first)
    yield from _read_deflections(fit.experiments, values)
    yield from _free_delays(fit.experiments, values)
    yield from _free_parameters(fit, minimum, suspects)
    yield from _load_friction(fit.experiments, values)
    yield from _clip_outputs(minimum.problem, residuals, values)
    yield from _filter_outputs(fit.experiments, values)


def _free_parameters(fit: Fit, minimum: Minimum, suspects: Mapping[str, ScoreTest]) -> Iterator[Candidate]:
    """Yield the fixed parameters that are at odds with the logs, and what would make a linear plant nonlinear.

    One of each group that acts alike, such as a screw's lead and its gear, is tried before the second of any.
    """
    plain, bending = find_candidates(minimum.problem, fit)
    tests = dict(suspects)
    for name in bending[:MOST_BENDING]:
        tests |= run_score_tests(minimum, fit, (name,)) if name not in tests else {}
    speeds = {name for e in fit.experiments for name in list_smoothing(e.plant)}
    groups = _group_alike({name: test for name, test in tests.items() if name in plain})
    in_turn = [name for rank in zip_longest(*groups) for name in rank if name is not None]
    for name in [*in_turn[:MOST_REFITTED], *(name for name in tests if name in bending)]:
        parameter, test = fit.parameters[name], tests[name]
        if name in bending and not parameter.min < test.preferred < parameter.max:
            continue
        start = test.preferred if name in bending else parameter.value
        params = free_more(fit, (name,)).update(**{name: start})

        def describe(values: Mapping[str, float], stds: Mapping[str, float], parameter: Parameter = parameter) -> str:
            name = parameter.name
            return _say_value(parameter, values[name], stds[name] if name in speeds else 0.0)

        yield Candidate(where=name, experiments=fit.experiments, params=params, describe=describe, frees={name: 0.0})


def _read_deflections(experiments: tuple[Experiment, ...], params: ParameterSet) -> Iterator[Candidate]:
    """Yield the effort at the spring as made of its deflection by two encoders, where the model has a damper in it."""
    first = experiments[0].plant
    sensing, spring = first.sensing, first.spring
    if sensing is None or spring is None or spring.stiffness is None or any(e.plant is not first for e in experiments):
        return
    stiffness, deflection = spring.stiffness, spring.deflection
    for output in experiments[0].outputs:
        if output not in sensing.regulated or not _adds_damping(first, output, stiffness):
            continue

        def h(t: Any, x: Any, u: Any, p: Any, output: str = output) -> Mapping[str, Any]:
            return {**first.h(t, x, u, p), output: getattr(p, stiffness) * deflection(x, p)}

        def describe(values: Mapping[str, float], stds: Mapping[str, float], output: str = output) -> str | None:
            unit = first.outputs[output]
            name = "tau_d" if unit == ROTARY.unit else "F_d"
            return (
                f"{output} is the {mechanics_of(unit).word} from deflection, a stiffness times what two "
                f"encoders read, without what else acts at the spring; add part deflection_sensor, and name it {name}"
            )

        plant = replace(first, h=h)
        yield Candidate(
            where=output,
            experiments=tuple(replace(e, plant=plant) for e in experiments),
            params=params,
            describe=describe,
        )


def _adds_damping(plant: Plant, output: str, stiffness: str) -> bool:
    """Tell whether an output is the spring's stiffness times its deflection at rest, and more in motion."""
    assert plant.spring is not None
    x, _, p = name_symbols(plant, plant.x, plant.u, plant.p)
    row = plant.output[list(plant.outputs).index(output)] - getattr(p, stiffness) * plant.spring.deflection(x, p)
    more = ca.Function("more", [plant.t, plant.x, plant.u, plant.p], [row])
    still = np.array([0.0 if unit.endswith("/s") else 1.0 for unit in plant.states.values()])
    ones = np.ones(len(plant.parameters))
    resting, motion = (abs(float(more(0.0, at, 0.0, ones))) for at in (still, 1.0 + np.arange(still.size)))
    return resting < 1e-12 < motion


def _load_friction(experiments: tuple[Experiment, ...], params: ParameterSet) -> Iterator[Candidate]:
    """Yield friction that grows with the motor's effort, where the plant's own does not."""
    loaded = {plant: _grow_with_load(plant) for plant in dict.fromkeys(e.plant for e in experiments)}
    if None in loaded.values():
        return
    changed = tuple(replace(e, plant=loaded[e.plant] or e.plant) for e in experiments)

    def describe(values: Mapping[str, float], stds: Mapping[str, float]) -> str | None:
        share = values[LOAD_SHARE]
        return None if share < 1e-3 else f"friction grows with the load, by {share:.3g} of it; add part load_friction"

    share = Parameter(name=LOAD_SHARE, value=0.05, unit="-", free=True, min=0.0, max=1.0)
    yield Candidate(
        where=experiments[0].name, experiments=changed, params=params.with_parameters(share), describe=describe
    )


def _grow_with_load(plant: Plant) -> Plant | None:
    """Return a plant whose friction takes a share of the motor's effort, too; None where roles do not tell how."""
    actuation = plant.actuation
    name, friction = next(iter(plant.friction.items()), ("", None))
    if actuation is None or friction is None or friction.loads is not None or not list_smoothing(plant):
        return None
    smoothing, curve, jump = list_smoothing(plant)[0], friction.force, friction.jump

    def take(p: Any) -> Any:
        return getattr(p, LOAD_SHARE) * ca.fabs(getattr(p, LOAD))

    grown = replace(
        friction,
        force=lambda v, p: curve(v, p) + take(p) * ca.tanh(v / getattr(p, smoothing)),
        jump=None if jump is None else lambda speed, p: jump(speed, p) + take(p),
        loads=lambda x, u, p: {LOAD: actuation.effort(p) * getattr(u, actuation.input) / friction.effort(p)},
        rated={LOAD: 0.0},
    )
    share = Parameter(name=LOAD_SHARE, value=0.0, unit="-", min=0.0)
    return replace(plant, friction={**plant.friction, name: grown}, parameters={**plant.parameters, LOAD_SHARE: share})


def _say_value(parameter: Parameter, value: float, unresolved: float) -> str:
    """Return what a parameter should have been; `unresolved` is the std of a speed that smooths friction."""
    unit = unit_after(parameter.unit)
    instead = f"in place of {parameter.value:.4g}{unit}"
    if value < 2.0 * unresolved:
        return (
            f"friction that jumps at rest more sharply than the logs resolve: {parameter.name} = {value:.1g}{unit} or "
            f"less {instead}; let it jump, with sticks = true in [plant.NAME] (so.plants.let_stick), or fix it there"
        )
    if value in (parameter.min, parameter.max):
        way = "smaller" if value < parameter.value else "larger"
        return f"{parameter.name} is much {way} {instead}, as far as its bounds allow; correct it, or widen its bounds"
    return f"{parameter.name} = {value:.4g}{unit} {instead}; free it, or correct it"


def _group_alike(tests: Mapping[str, ScoreTest]) -> list[list[str]]:
    """Return the names in groups of the same test: what no residual distinguishes near the fit."""
    groups: list[list[str]] = []
    for name, test in tests.items():
        for group in groups:
            first = tests[group[0]]
            same = (
                abs(test.fall - first.fall) < SAME_EFFECT * first.fall
                and abs(test.chi2 - first.chi2) < SAME_EFFECT * first.chi2
            )
            if same:
                group.append(name)
                break
        else:
            groups.append([name])
    return groups


def _free_delays(experiments: tuple[Experiment, ...], params: ParameterSet) -> Iterator[Candidate]:
    """Yield a delay of the inputs, and one for each output; negative where signals can be shifted."""
    leads = [LEAD if len(e.log_segments) == 1 and len(e.log) > 4 * LEAD else 0 for e in experiments]
    delays = [e.delay_s.value if isinstance(e.delay_s, Parameter) else e.delay_s for e in experiments]
    if any(isinstance(e.delay_s, Parameter) and e.delay_s.free for e in experiments):
        return
    shifted = tuple(
        free_delay(_lead(e, lead), value + lead * e.log.period)
        for e, lead, value in zip(experiments, leads, delays, strict=True)
    )

    def describe_common(values: Mapping[str, float], stds: Mapping[str, float]) -> str | None:
        words: list[str] = []
        for e, lead, value in zip(experiments, leads, delays, strict=True):
            late = values[f"{e.name}.delay_s"] - lead * e.log.period - value
            if abs(late) > 0.05 * e.log.period:
                words.append(_say_late(e.name if len(experiments) > 1 else "", late, value))
        return join_words(words) if words else None

    names = tuple(f"{e.name}.delay_s" for e in experiments)
    kept = tuple(_cut_ends(e, lead) for e, lead in zip(experiments, leads, strict=True))
    yield Candidate(
        where=experiments[0].name,
        experiments=shifted,
        params=params,
        describe=describe_common,
        delays=names,
        kept=kept,
        frees={name: lead * e.log.period for name, e, lead in zip(names, experiments, leads, strict=True)},
    )
    if all(len(e.outputs) == 1 for e in experiments):
        return
    apart = tuple(
        replace(
            e,
            outputs=(o,),
            name=f"{e.name}-{o}",
            sigma=_only(e.sigma, o),
            gain=_only(e.gain, o),
            saturation=_only(e.saturation, o),
            offset=_only(e.offset, o) if isinstance(e.offset, Mapping) else e.offset,
        )
        for e in shifted
        for o in e.outputs
    )

    def describe_each(values: Mapping[str, float], stds: Mapping[str, float]) -> str | None:
        words: list[str] = []
        for e, lead, value in zip(experiments, leads, delays, strict=True):
            late = {o: values[f"{e.name}-{o}.delay_s"] - lead * e.log.period - value for o in e.outputs}
            if np.ptp(list(late.values())) < 0.3 * e.log.period:
                continue
            words += [
                f"{o} is {1e3 * abs(shift):.4g} ms {'late' if shift > 0.0 else 'early'}"
                for o, shift in late.items()
                if abs(shift) > 0.3 * e.log.period
            ]
        return f"{join_words(words)}: correct the channels' stamps" if words else None

    yield Candidate(
        where=experiments[0].name,
        experiments=apart,
        params=params,
        describe=describe_each,
        delays=tuple(f"{e.name}.delay_s" for e in apart),
        kept=kept,
    )


def _say_late(where: str, late: float, value: float) -> str:
    of = f" of {where}" if where else ""
    if late > 0.0:
        return f"a delay{of} of {1e3 * (value + late):.4g} ms; give delay_s, or free it"
    return f"inputs{of} that are stamped {-1e3 * late:.4g} ms late; shift their channels"


def _only(values: Mapping[str, V], name: str) -> dict[str, V]:
    return {name: values[name]} if name in values else {}


def free_delay(experiment: Experiment, value: float, longest: float = np.inf) -> Experiment:
    """Return the experiment with a free delay that starts at a value."""
    delay = Parameter(name="delay_s", value=value, unit="s", free=True, min=0.0, max=longest)
    return replace(experiment, delay_s=delay)


def _lead(experiment: Experiment, samples: int) -> Experiment:
    """Return the experiment with its inputs so many samples early, without the outputs whose inputs are not known."""
    if not samples:
        return experiment
    cut = _cut_ends(experiment, samples)
    signals = dict(cut.log.signals)
    for name in experiment.plant.inputs:
        if name in signals:
            values = signals[name].values
            led = np.concatenate([values[samples:], np.repeat(values[-1:], samples)])
            signals[name] = replace(signals[name], values=led)
    return replace(cut, log=replace(cut.log, signals=signals))


def _cut_ends(experiment: Experiment, samples: int) -> Experiment:
    """Return the experiment without the outputs of so many samples at either end."""
    if not samples:
        return experiment
    signals = dict(experiment.log.signals)
    for name in experiment.outputs:
        values = signals[name].values.copy()
        values[:samples] = values[-samples:] = np.nan
        signals[name] = replace(signals[name], values=values)
    return replace(experiment, log=replace(experiment.log, signals=signals))


def _swap_channels(experiments: tuple[Experiment, ...], params: ParameterSet, *, poor: bool) -> Iterator[Candidate]:
    """Yield the outputs swapped in pairs; inputs with outputs too where hardly anything is explained."""
    first = experiments[0]
    inputs = [name for name in first.plant.inputs if name in first.log.signals] if poor else []
    for channel, other in combinations([*inputs, *first.outputs], 2):
        if channel in inputs and other in inputs:
            continue
        swapped = tuple(_swap(e, channel, other) for e in experiments if {channel, other} <= set(e.log.signals))
        if len(swapped) < len(experiments):
            continue

        def describe(
            values: Mapping[str, float], stds: Mapping[str, float], channel: str = channel, other: str = other
        ) -> str | None:
            return f"the columns of {channel} and {other} are swapped"

        yield Candidate(
            where=f"{channel}, {other}", experiments=swapped, params=params, describe=describe, certain=True
        )


def _swap(experiment: Experiment, channel: str, other: str) -> Experiment:
    """Return the experiment with the values of two channels swapped."""
    signals = dict(experiment.log.signals)
    signals[channel] = replace(signals[channel], values=experiment.log[other])
    signals[other] = replace(signals[other], values=experiment.log[channel])
    sigma = {name: value for name, value in experiment.sigma.items() if name not in (channel, other)}
    return replace(experiment, log=replace(experiment.log, signals=signals), sigma=sigma)


def _clip_outputs(problem: FitProblem, residuals: ResidualsByExperiment, params: ParameterSet) -> Iterator[Candidate]:
    """Yield the outputs as clipped by their amplifier, where a clipped model is nearer to what was measured."""
    clipped = {e.name: {} for e in problem.experiments}
    for output in problem.outputs:
        measured = np.concatenate(output.measured)
        model = measured + np.concatenate(residuals[output.experiment.name].raw_of(output.name))
        ends = find_clipping(model, measured)
        if ends is not None and output.name not in output.experiment.data.saturation:
            clipped[output.experiment.name][output.name] = ends
    if not any(clipped.values()):
        return
    experiments = tuple(
        replace(e.data, saturation={**e.data.saturation, **{o: ends[:2] for o, ends in clipped[e.name].items()}})
        for e in problem.experiments
    )
    words = [
        f"{o} is clipped at {ends[2]:.4g} and {ends[3]:.4g}{unit_after(e.data.plant.outputs[o])}"
        for e in problem.experiments
        for o, ends in clipped[e.name].items()
    ]

    def describe(values: Mapping[str, float], stds: Mapping[str, float]) -> str | None:
        return f"{join_words(words)}, ahead of its noise; declare saturation"

    yield Candidate(where=problem.experiments[0].name, experiments=experiments, params=params, describe=describe)


def find_clipping(
    model: Float[np.ndarray, " n"], measured: Float[np.ndarray, " n"]
) -> tuple[float, float, float, float] | None:
    """Return the range inside which nothing is clipped, and the ends at which a model would have to be, if any.

    The model's outermost samples are cut at each of some levels; the level that leaves the least is taken where it
    takes a part of the residual's power away.
    """
    good = np.isfinite(model) & np.isfinite(measured)
    model, measured = model[good], measured[good]
    if model.size < CLIPPED_SAMPLES:
        return None
    whole = float(np.sum((model - measured) ** 2))
    ends: list[float] = []
    gone = 0.0
    for sign in (-1.0, 1.0):
        x, y = sign * model, sign * measured
        levels = np.quantile(y, CLIP_QUANTILES)
        left = [float(np.sum((np.minimum(x, level) - y) ** 2)) for level in levels]
        best = int(np.argmin(left))
        clips = left[best] < whole and np.count_nonzero(x > levels[best]) >= CLIPPED_SAMPLES
        gone += whole - left[best] if clips else 0.0
        ends.append(sign * float(levels[best]) if clips else sign * np.inf)
    if gone < CLIPPED_POWER * whole:
        return None
    noise = 3.0 * float(np.sqrt(max(whole - gone, 0.0) / model.size))
    low, high = ends[0] + noise, ends[1] - noise
    return (low, high, ends[0], ends[1]) if low < high else None


def _filter_outputs(experiments: tuple[Experiment, ...], params: ParameterSet) -> Iterator[Candidate]:
    """Yield the outputs as read through a pole, all of them or one."""
    first = experiments[0]
    regulated = () if first.plant.sensing is None else first.plant.sensing.regulated
    read = [name for name in first.outputs if name in regulated]
    if "load_cell_hz" in first.plant.parameters or any(e.plant is not first.plant for e in experiments):
        return
    nyquist = 0.5 / first.log.period
    groups = [tuple(read), *((name,) for name in read if len(read) > 1)] if read else []
    for group in groups:
        plant = wrapped(first.plant, ("load_cell",), outputs=group)
        default = plant.complete(params)["load_cell_hz"]
        # The faster a pole, the more integration steps it takes: its range ends soon after what is said of it.
        pole = replace(default, value=0.3 * nyquist, free=True, max=2.0 * FASTEST_POLE * nyquist)

        def describe(
            values: Mapping[str, float], stds: Mapping[str, float], group: tuple[str, ...] = group
        ) -> str | None:
            cut = values["load_cell_hz"]
            if cut > FASTEST_POLE * nyquist:
                return None
            names = join_words([*group])
            return f"{names} passed a low-pass of {cut:.3g} Hz; log it unfiltered, or add the part load_cell"

        changed = tuple(replace(e, plant=plant) for e in experiments)
        yield Candidate(
            where=join_words([*group]), experiments=changed, params=params.with_parameters(pole), describe=describe
        )


def _free_gains(experiments: tuple[Experiment, ...], params: ParameterSet) -> Iterator[Candidate]:
    """Yield a gain for each output: of wrong sign, or of another unit; one gain for all is the input's."""
    free = Parameter(name="gain", value=1.0, unit="-", free=True)
    changed = tuple(replace(e, gain=dict.fromkeys(e.outputs, free)) for e in experiments)
    names = {f"{e.name}.gain.{o}": o for e in experiments for o in e.outputs}

    def describe(values: Mapping[str, float], stds: Mapping[str, float]) -> str | None:
        gains = [values[name] for name in names]
        common = float(np.median(gains))
        if len(gains) > 1 and all(abs(gain - common) < SNAP * abs(common) for gain in gains):
            words = _say_gain(1.0 / common)
            return (
                words and f"{join_words([*experiments[0].plant.inputs])} {words}, or every output does by the inverse"
            )
        words = [f"{o} {said}" for name, o in names.items() if (said := _say_gain(values[name]))]
        return join_words(list(dict.fromkeys(words))) if words else None

    yield Candidate(
        where=experiments[0].name, experiments=changed, params=params, describe=describe, gains=tuple(names)
    )


def _say_gain(gain: float) -> str | None:
    """Return what is wrong with a channel that reads so many times what it should; None of what is no sensor's gain."""
    if abs(gain + 1.0) < SNAP:
        return "has the wrong sign"
    for factor, words in UNIT_FACTORS.items():
        if abs(abs(gain) / factor - 1.0) < SNAP:
            return f"reads {'-' if gain < 0.0 else ''}{words} times what it should: check its unit"
    likely = LIKELY_GAINS[0] < abs(gain) < LIKELY_GAINS[1] and abs(gain - 1.0) > SNAP
    return f"reads {gain:.3g} times what it should" if likely else None


def _change_plant(experiments: tuple[Experiment, ...], params: ParameterSet, plant: Plant) -> Iterator[Candidate]:
    """Yield another plant in place of the experiments' own."""
    if any(e.plant.name == plant.name for e in experiments):
        return
    if any(not set(e.outputs) - set(e.differences) <= set(plant.outputs) for e in experiments):
        return
    if any(difference.of not in plant.states for e in experiments for difference in e.differences.values()):
        return
    if any(not set(plant.inputs) <= {*e.log.signals, *plant.optional_inputs} for e in experiments):
        return
    free = [name for name in params.free_names if name in plant.parameters]
    if not free:
        return
    changed = tuple(
        replace(
            e,
            plant=plant,
            initial_state=e.initial_state if isinstance(e.initial_state, str) else "estimate",
            parameters={
                name: value
                for name, value in e.parameters.items()
                if name in plant.parameters and plant.parameter_unit(name) == e.plant.parameter_unit(name)
            },
        )
        for e in experiments
    )
    local = [local for e in changed for local in e.list_own().values()]
    values = plant.complete(changed[0].apply_own(params.fix())).values()

    def describe(values: Mapping[str, float], stds: Mapping[str, float]) -> str | None:
        return f"the log is of the plant {plant.name}, not {experiments[0].plant.name}"

    yield Candidate(
        where=experiments[0].name,
        experiments=changed,
        params=ParameterSet([*values, *local]).free(*free),
        describe=describe,
    )
