"""Changes that may explain logs which a fit does not: other values, delays, channels, units, parts and plants.

Each candidate is one change of the problem, with the words for what its refit shows; `causes` refits and weighs them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import field, replace
from functools import partial
from itertools import combinations, zip_longest
from typing import Any, TypeVar

import casadi as ca
import numpy as np

from seaopt.estimation.judgement.score_test import (
    Freed,
    ScoreTest,
    find_candidates,
    free_delay,
    free_more,
    run_score_tests,
)
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.residual_statistics import ResidualsByExperiment
from seaopt.estimation.problem.shapes import Signal
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.formatting import join_words
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import list_smoothing
from seaopt.plants.parts import wrapped
from seaopt.plants.plant import name_symbols
from seaopt.records import record
from seaopt.signals import HOLDS
from seaopt.units import ROTARY, mechanics_of, unit_after

MOST_REFITTED, MOST_BENDING = 6, 4  # fixed parameters, and those that would make a linear plant nonlinear
SHARPER = 0.1  # times the speed that friction is smoothed over, below which it is a jump
SAME_EFFECT = 1e-3  # of a test's figures, by which parameters that act alike may differ
POLE = "load_cell_hz"  # of the part that reads an output through a pole
FILTERED = (POLE, "sensor_filter_hz")  # of all parts that read one through a low-pass
LEAD = 40  # samples that signals are shifted by so that a delay may be negative
UNIT_FACTORS = {1e3: "1000", 1e-3: "0.001", 4.448: "4.448", 1.0 / 4.448: "1/4.448"}
LIKELY_GAINS = (0.05, 20.0)  # of sensors that are not of another unit
SNAP = 0.1  # of a factor: an estimate so near is taken for it
FASTEST_POLE = 2.0  # of Nyquist's frequency: a sensor's pole beyond it does nothing that a log shows
CLIP_QUANTILES = 1.0 - np.geomspace(1e-3, 0.4, 40)  # of what was measured: where it may be cut
CLIPPED_SAMPLES = 20  # that have to be beyond a level
CLIPPED_POWER = 0.2  # of a residual's

V = TypeVar("V")
Values = Mapping[str, float]  # of unknowns, or their standard deviations, by name
Describe = Callable[[Values, Values], str | None]


@record(eq=False)
class Candidate:
    """A change to be refitted, and what it says: a text, or one made of the refit's values and stds (None: nothing)."""

    where: str
    experiments: tuple[Experiment, ...]
    params: ParameterSet
    says: str | Describe
    certain: bool = False  # nothing but a mistake explains a gain
    delays: tuple[str, ...] = ()  # unknowns whose refit starts from the best of `FIRST_DELAYS`, all alike
    gains: tuple[str, ...] = ()  # unknowns that start from how a simulation compares with its output
    # The fit's own experiments with the samples that the change leaves, where it leaves out some: residuals of other
    # samples show a gain of many units by chance.
    kept: tuple[Experiment, ...] = ()
    frees: Mapping[str, float] = field(default_factory=dict[str, float])  # whose values to state, less these offsets
    apart: bool = False  # each output has a delay of its own
    further: bool = False  # it frees more than the one before, and is worth a look where that explains something
    smoothed: Parameter | None = None  # what is freed, if it is a speed over which friction is smoothed

    def jumps(self, values: Values, stds: Values) -> bool:
        """Tell whether the refit makes of smoothed friction a jump, or nearly."""
        return self.smoothed is not None and _is_sharp(self.smoothed, values, stds)

    def describe(self, values: Values, stds: Values) -> str | None:
        """Return what the refit shows; None where it shows nothing."""
        return self.says if isinstance(self.says, str) else self.says(values, stds)


def list_candidates(
    fit: Fit,
    minimum: Minimum,
    residuals: ResidualsByExperiment,
    suspects: Mapping[str, ScoreTest],
    alternatives: Sequence[Plant],
    *,
    poor: bool,
    noticed: bool = True,
) -> Iterator[Candidate]:
    """Yield the changes to try; channels are not swapped where nothing is `noticed` but that a parameter is suspect."""
    problem, experiments = minimum.problem, fit.experiments
    values = problem.params if poor else fit.parameters
    if noticed:
        yield from _swap_channels(experiments, values, poor=poor)
    if poor:
        for plant in alternatives:  # the right one is soon found, and the wrong one takes long to refit
            yield from _change_plant(experiments, problem.params, plant)
        yield _free_gains(experiments, problem.params)
    yield from _read_deflections(experiments, values)
    yield from _free_delays(problem, values, poor=poor)
    yield from _clip_outputs(problem, residuals, values)
    yield from _free_parameters(fit, minimum, suspects)
    yield from _filter_outputs(experiments, values)


def _free_parameters(fit: Fit, minimum: Minimum, suspects: Mapping[str, ScoreTest]) -> Iterator[Candidate]:
    """Yield the fixed parameters that are at odds with the logs, and those that would make a linear plant nonlinear.
    One of each group that acts alike, such as a screw's lead and its gear, is tried before the second of any.
    """
    plain, bending = find_candidates(minimum.problem)
    tests = dict(suspects)
    for name in bending[:MOST_BENDING]:
        if name not in tests:
            tests |= run_score_tests(minimum, Freed.make(minimum.problem, minimum.z, (name,)))
    speeds = {name for e in fit.experiments for name in list_smoothing(e.plant)}
    groups = _group_alike({name: test for name, test in tests.items() if name in plain})
    in_turn = [name for rank in zip_longest(*groups) for name in rank if name is not None]
    for name in [*in_turn[:MOST_REFITTED], *(name for name in tests if name in bending)]:
        parameter, start = fit.parameters[name], fit.parameters[name].value
        if name in bending:
            start = tests[name].preferred
            if not parameter.min < start < parameter.max:
                continue
        yield Candidate(
            where=name,
            experiments=fit.experiments,
            params=free_more(fit.parameters, (name,)).update(**{name: start}),
            says=partial(_state_value, parameter, name in speeds),
            frees={name: 0.0},
            smoothed=parameter if name in speeds else None,
        )


def _is_sharp(parameter: Parameter, values: Values, stds: Values) -> bool:
    return values[parameter.name] < max(2.0 * stds[parameter.name], SHARPER * parameter.value)


def _state_value(parameter: Parameter, smooths: bool, values: Values, stds: Values) -> str:
    """Return what a parameter should have been; `smooths`: it is a speed over which friction is smoothed."""
    name, unit, value = parameter.name, unit_after(parameter.unit), values[parameter.name]
    instead = f"in place of {parameter.value:.4g}{unit}"
    if smooths and _is_sharp(parameter, values, stds):
        return (
            f"friction that jumps at rest, or nearly: {name} = {value:.1g}{unit} or less {instead}; let it jump, with "
            "sticks = true in [plant.NAME] (so.plants.let_stick), or fix it there"
        )
    if value in (parameter.min, parameter.max):
        way = "smaller" if value < parameter.value else "larger"
        return f"{name} is much {way} {instead}, as far as its bounds allow; correct it, or widen its bounds"
    return f"{name} = {value:.4g}{unit} {instead}; free it, or correct it"


def _group_alike(tests: Mapping[str, ScoreTest]) -> list[list[str]]:
    """Return the names in groups of the same test: what no residual distinguishes near the fit."""

    def are_alike(test: ScoreTest, first: ScoreTest) -> bool:
        pairs = ((test.fall, first.fall), (test.chi2, first.chi2))
        return all(abs(value - reference) < SAME_EFFECT * reference for value, reference in pairs)

    groups: list[list[str]] = []
    for name, test in tests.items():
        group = next((group for group in groups if are_alike(test, tests[group[0]])), None)
        if group is None:
            groups.append([name])
        else:
            group.append(name)
    return groups


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

        plant, unit = replace(first, h=h), first.outputs[output]
        yield Candidate(
            where=output,
            experiments=tuple(replace(e, plant=plant) for e in experiments),
            params=params,
            says=f"{output} is the {mechanics_of(unit).word} from deflection, a stiffness times what two encoders "
            "read, without what else acts at the spring; add part deflection_sensor, and name it "
            f"{'tau_d' if unit == ROTARY.unit else 'F_d'}",
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


def _free_delays(problem: FitProblem, params: ParameterSet, *, poor: bool) -> Iterator[Candidate]:
    """Yield a delay of the inputs, with the spring's damper as well, and one for each output; negative where signals
    can be shifted. `poor`: the damper may be tried nowhere else.
    """
    experiments = [e.data for e in problem.experiments]
    stated = [e.slots.delay.value for e in problem.experiments]
    if any(e.slots.delay.index is not None for e in problem.experiments):
        return
    leads = [LEAD if len(e.log_segments) == 1 and len(e.log) > 4 * LEAD else 0 for e in experiments]
    shifts = [lead * e.log.period for e, lead in zip(experiments, leads, strict=True)]
    names = tuple(f"{e.name}.delay_s" for e in experiments)
    trials = list(zip(experiments, names, shifts, stated, strict=True))
    shifted = tuple(
        free_delay(lead_inputs(e, lead), value + shift)
        for (e, _, shift, value), lead in zip(trials, leads, strict=True)
    )
    kept = tuple(_cut_ends(e, lead) for e, lead in zip(experiments, leads, strict=True))

    def describe_common(values: Values, stds: Values) -> str | None:
        words: list[str] = []
        for e, name, shift, value in trials:
            late = values[name] - shift - value
            if abs(late) > 0.05 * e.log.period:
                words.append(_state_delay(f" of {e.name}" if len(experiments) > 1 else "", late, value))
        return join_words(words) or None

    def describe_each(values: Values, stds: Values) -> str | None:
        words: list[str] = []
        for e, _, shift, value in trials:
            late = {o: values[f"{e.name}-{o}.delay_s"] - shift - value for o in e.outputs}
            least, of = 0.3 * e.log.period, f" of {e.name}" if len(experiments) > 1 else ""
            words += [
                f"{o}{of} is {1e3 * abs(seconds):.4g} ms {'late' if seconds > 0.0 else 'early'}"
                for o, seconds in late.items()
                if np.ptp(list(late.values())) >= least < abs(seconds)
            ]
        return f"{join_words(words)}: correct the channels' stamps" if words else None

    where = experiments[0].name
    yield Candidate(
        where=where,
        experiments=shifted,
        params=params,
        says=describe_common,
        delays=names,
        kept=kept,
        frees=dict(zip(names, shifts, strict=True)),
    )
    if not any(len(e.outputs) > 1 for e in experiments):
        return
    if (damper := _find_damper(experiments, params)) is not None:

        def describe_both(values: Values, stds: Values) -> str | None:
            late, value = describe_common(values, stds), f"{damper.name} = {values[damper.name]:.4g}"
            if late is None:
                return _state_value(damper, False, values, stds) if poor else None
            return f"{late}; with {value}{unit_after(damper.unit)} in place of {damper.value:.4g}, free it as well"

        yield Candidate(
            where=f"{where}, {damper.name}",
            experiments=shifted,
            params=params.with_parameters(replace(damper, free=True)),
            says=describe_both,
            delays=names,
            kept=kept,
            frees=dict(zip((*names, damper.name), (*shifts, 0.0), strict=True)),
            further=not poor,
        )
    apart = tuple(_take_output(e, output) for e in shifted for output in e.outputs)
    delays = tuple(f"{e.name}.delay_s" for e in apart)
    yield Candidate(
        where=where, experiments=apart, params=params, says=describe_each, delays=delays, kept=kept, apart=True
    )


def _find_damper(experiments: Sequence[Experiment], params: ParameterSet) -> Parameter | None:
    """Return what damps the spring of all plants, where it is fixed."""
    names = {None if e.plant.spring is None else e.plant.spring.damper for e in experiments}
    name = names.pop() if len(names) == 1 else None
    damper = None if name is None else params.get(name)
    return None if damper is None or damper.free else damper


def _state_delay(of: str, late: float, value: float) -> str:
    if late > 0.0:
        return f"a delay{of} of {1e3 * (value + late):.4g} ms; give delay_s, or free it"
    return f"inputs{of} that are stamped {-1e3 * late:.4g} ms late; shift their channels"


def _take_output(experiment: Experiment, output: str) -> Experiment:
    """Return an experiment of one of its outputs alone, EXPERIMENT-OUTPUT."""

    def pick(values: Mapping[str, V]) -> dict[str, V]:
        return {output: values[output]} if output in values else {}

    return replace(
        experiment,
        name=f"{experiment.name}-{output}",
        outputs=(output,),
        sigma=pick(experiment.sigma),
        quantisation=pick(experiment.quantisation),
        gain=pick(experiment.gain),
        saturation=pick(experiment.saturation),
        offset=pick(experiment.offset) if isinstance(experiment.offset, Mapping) else experiment.offset,
    )


def lead_inputs(experiment: Experiment, samples: int) -> Experiment:
    """Return the experiment with its inputs so many samples early, without the outputs whose inputs are not known."""
    inputs = (name for name in experiment.plant.inputs if name != HOLDS)  # which says when positions are read
    cut, names = _cut_ends(experiment, samples), [name for name in inputs if name in experiment.log.signals]
    led = {name: np.append(cut.log[name][samples:], np.repeat(cut.log[name][-1:], samples)) for name in names}
    return _with_channels(cut, led)


def _cut_ends(experiment: Experiment, samples: int) -> Experiment:
    """Return the experiment without the outputs of so many samples at either end."""
    inside = np.arange(len(experiment.log))
    inside = (inside >= samples) & (inside < inside.size - samples)
    return _with_channels(experiment, {o: np.where(inside, experiment.log[o], np.nan) for o in experiment.outputs})


def _with_channels(experiment: Experiment, values: Mapping[str, Signal], **changes: Any) -> Experiment:
    """Return the experiment with other samples of some channels of its log."""
    log = experiment.log
    signals = {name: replace(log.signals[name], values=samples) for name, samples in values.items()}
    return replace(experiment, log=replace(log, signals={**log.signals, **signals}), **changes)


def _swap_channels(experiments: tuple[Experiment, ...], params: ParameterSet, *, poor: bool) -> Iterator[Candidate]:
    """Yield the outputs swapped in pairs; inputs with outputs too where hardly anything is explained."""
    first = experiments[0]
    inputs = [name for name in first.plant.inputs if name in first.log.signals] if poor else []
    for channel, other in combinations([*inputs, *first.outputs], 2):
        pair = {channel, other}
        if pair <= set(inputs) or not all(pair <= set(e.log.signals) for e in experiments):
            continue
        swapped = tuple(
            _with_channels(
                e,
                {channel: e.log[other], other: e.log[channel]},
                sigma={name: value for name, value in e.sigma.items() if name not in pair},
                quantisation={name: step for name, step in e.quantisation.items() if name not in pair},
            )
            for e in experiments
        )
        yield Candidate(
            where=f"{channel}, {other}",
            experiments=swapped,
            params=params,
            says=f"the columns of {channel} and {other} are swapped",
            certain=True,
        )


def _clip_outputs(problem: FitProblem, residuals: ResidualsByExperiment, params: ParameterSet) -> Iterator[Candidate]:
    """Yield the outputs as clipped by their amplifier, where a clipped model is nearer to what was measured."""
    clipped = {e.name: dict[str, tuple[float, float]]() for e in problem.experiments}
    words: list[str] = []
    for output in problem.outputs:
        measured = np.concatenate(output.measured)
        model = measured + np.concatenate(residuals[output.experiment.name].raw_of(output.name))
        ends = find_clipping(model, measured)
        if ends is not None and output.name not in output.experiment.data.saturation:
            clipped[output.experiment.name][output.name] = ends[:2]
            words.append(f"{output.name} is clipped at {ends[2]:.4g} and {ends[3]:.4g}{unit_after(output.unit)}")
    if words:
        yield Candidate(
            where=problem.experiments[0].name,
            experiments=tuple(
                replace(e.data, saturation={**e.data.saturation, **clipped[e.name]}) for e in problem.experiments
            ),
            params=params,
            says=f"{join_words(words)}, ahead of its noise; declare saturation",
        )


def find_clipping(model: Signal, measured: Signal) -> tuple[float, float, float, float] | None:
    """Return the range inside which nothing is clipped, and the ends at which a model would have to be, if any. The
    model's outermost samples are cut at each of some levels; the level that leaves the least is taken where it takes a
    part of the residual's power away.
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
    filtered = not first.plant.parameters.keys().isdisjoint(FILTERED)
    if filtered or any(e.plant is not first.plant for e in experiments):
        return
    regulated = () if first.plant.sensing is None else first.plant.sensing.regulated
    read = [name for name in first.outputs if name in regulated]
    fastest = FASTEST_POLE * 0.5 / first.log.period
    for group in [read, *([name] for name in read if len(read) > 1)] if read else []:
        plant, names = wrapped(first.plant, ("load_cell",), outputs=group), join_words(group)

        def describe(values: Values, stds: Values, names: str = names) -> str | None:
            cut = values[POLE]
            if cut > fastest:
                return None
            return (
                f"{names} passed a low-pass of {cut:.3g} Hz; log it unfiltered, or add the part load_cell, or "
                "sensor_filter where it has two poles"
            )

        # The faster a pole, the more integration steps it takes: its range ends soon after what is said of it.
        default = plant.complete(params)[POLE]
        pole = replace(default, value=0.3 * fastest / FASTEST_POLE, free=True, max=2.0 * fastest)
        yield Candidate(
            where=names,
            experiments=tuple(replace(e, plant=plant) for e in experiments),
            params=params.with_parameters(pole),
            says=describe,
        )


def _free_gains(experiments: tuple[Experiment, ...], params: ParameterSet) -> Candidate:
    """Return a gain for each output: of wrong sign, or of another unit; one gain for all is the input's."""
    free = Parameter(name="gain", value=1.0, unit="-", free=True)
    names = {f"{e.name}.gain.{o}": o for e in experiments for o in e.outputs}

    def describe(values: Values, stds: Values) -> str | None:
        gains = [values[name] for name in names]
        common = float(np.median(gains))
        if len(gains) > 1 and all(abs(gain - common) < SNAP * abs(common) for gain in gains):
            words, inputs = _state_gain(1.0 / common), join_words([*experiments[0].plant.inputs])
            return words and f"{inputs} {words}, or every output does by the inverse"
        words = [f"{o} {fault}" for name, o in names.items() if (fault := _state_gain(values[name]))]
        return join_words(list(dict.fromkeys(words))) or None

    return Candidate(
        where=experiments[0].name,
        experiments=tuple(replace(e, gain=dict.fromkeys(e.outputs, free)) for e in experiments),
        params=params,
        says=describe,
        gains=tuple(names),
    )


def _state_gain(gain: float) -> str | None:
    """Return what is wrong with a channel that reads so many times what it should; None of what is no sensor's gain."""
    if abs(gain + 1.0) < SNAP:
        return "has the wrong sign"
    for factor, words in UNIT_FACTORS.items():
        if abs(abs(gain) / factor - 1.0) < SNAP:
            return f"reads {'-' if gain < 0.0 else ''}{words} times what it should: check its unit"
    likely = LIKELY_GAINS[0] < abs(gain) < LIKELY_GAINS[1] and abs(gain - 1.0) > SNAP
    return f"reads {gain:.3g} times what it should" if likely else None


def _change_plant(experiments: tuple[Experiment, ...], params: ParameterSet, plant: Plant) -> Iterator[Candidate]:
    """Yield another plant in place of the experiments' own, where it has their channels and some free parameter."""

    def suits(e: Experiment) -> bool:
        return (
            e.plant.name != plant.name
            and set(e.outputs) - set(e.differences) <= set(plant.outputs)
            and all(difference.of in plant.states for difference in e.differences.values())
            and set(plant.inputs) <= {*e.log.signals, *plant.optional_inputs}
        )

    free = [name for name in params.free_names if name in plant.parameters]
    if not free or not all(map(suits, experiments)):
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
    local = [parameter for e in changed for parameter in e.list_own().values()]
    values = plant.complete(changed[0].apply_own(params.fix())).values()
    yield Candidate(
        where=experiments[0].name,
        experiments=changed,
        params=ParameterSet([*values, *local]).free(*free),
        says=f"the log is of the plant {plant.name}, not {experiments[0].plant.name}",
    )
