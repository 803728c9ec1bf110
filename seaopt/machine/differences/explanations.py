r"""Which fault a machine has whose response is not the certified one, found by trying.

A cause with a size :math:`\theta`, a parameter's factor, a gain, a delay, a mode, makes another response of the model.
The size that fits best is that of the least misfit, beside what certified machines differ by
(`seaopt.machine.differences.leeway`). Causes are ranked by how much of the misfit they take away beyond the number of
lines, which noise leaves.

Some cannot be told from each other by what the law reads: a torque constant and an efficiency never, and a softer
spring hardly from a heavier motor, for both lower the resonance of the force. They are named together, unless more
was logged than the law reads: an encoder beside the force tells the last two apart, as force over deflection is the
spring.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.machine.differences.comparison import Comparison, Lines
from seaopt.machine.differences.drive_limit import find_distortion, make_knob, take_limited, try_limit
from seaopt.machine.differences.leeway import Spread, take_spread
from seaopt.machine.differences.pairs import Start, find_pairs, is_worth
from seaopt.machine.differences.size_fit import Best, Difference, SizeFit, Tried, drop_digits, rank
from seaopt.machine.differences.size_search import (
    FOUND,
    MOST_SPREAD,
    MOST_STEP,
    ROUNDS,
    STEP,
    SURE,
    Search,
    Slopes,
    find_slopes,
    list_knobs,
    make_delay,
    refine,
    step,
)
from seaopt.machine.ticks import Ticks
from seaopt.parameters import ParameterSet
from seaopt.records import record

RIVAL = 20.0  # times what the best parameter leaves: parameters whose leeway is looked at where they are
WORTH = 2.0  # times what noise leaves: a misfit above has causes
ALIKE = 2.0  # times what the best of some causes leaves of other outputs, or between the lines: they go with it too
EVERY = 0.75  # of the law's rate, above which a log has each of its ticks
HALF = 0.5  # of what the best cause explains, and of what a gain does, from which on others are looked at
MODE_DAMPINGS = (0.02, 0.1)
SEEN = 5.0  # std by which a line differs where a mode is looked for
SMALL = 1e-5  # of a size, for slopes
LEAST_DAMPING, MOST_DAMPED = math.log(1e-4), 0.3
# Over that of the clock, at which timers step a law by mistake; the first two are tried always.
USUAL_RATES = (0.5, 2.0, 0.1, 0.2, 0.25, 1.0 / 3.0, 3.0, 4.0, 5.0, 10.0)
SAME_RATE = 0.01  # relative: a rate that is a usual one
MOST = 4  # causes that are listed


@record(eq=False)
class Case:
    """What is to be explained: the measured response beside a model's, and the spread of what was certified."""

    comparison: Comparison
    beside: Comparison  # of what was logged and the law does not read
    logs: Sequence[Ticks]  # all of them, which the comparison may have in part
    values: ParameterSet
    spread: Spread
    model: Lines
    slopes: Slopes  # of what was certified, at the model
    before: float  # the misfit without any cause

    @property
    def noise(self) -> float:
        """What noise leaves of the misfit."""
        return float(self.comparison.f.size)

    @property
    def fit(self) -> SizeFit:
        """The fit of sizes beside what certified machines differ by."""
        return SizeFit(comparison=self.comparison, leeway=self.spread.leave(self.slopes))

    def share(self, tried: Tried) -> float:
        """Return how much of the misfit a cause explains."""
        return 1.0 - max(tried.left - self.noise, 0.0) / (self.before - self.noise)


def explain(
    comparison: Comparison, beside: Comparison, logs: Sequence[Ticks], model: Lines, spread: Spread
) -> tuple[list[Difference], Spread]:
    """Return the causes that explain the misfit of a controller's design plant, the best first, and what certified
    machines differ by beside them. `beside`: of what was logged and the law does not read; `logs`: all of them;
    `spread`: of the certified machines.
    """
    assert comparison.controller.design is not None
    values, noise = comparison.controller.design[1], float(comparison.f.size)
    if (before := comparison.misfit(model)) <= WORTH * noise:
        return [], spread
    slopes = find_slopes(comparison, spread, values, model)
    left = SizeFit(comparison=comparison, leeway=spread.leave(slopes)).solve(lambda _: model, []).left
    if left <= WORTH * noise:  # draws explain it by themselves, and do not help to tell of what
        spread, slopes = take_spread((), {}), slopes[:0]
    else:
        before = left
    case = Case(
        comparison=comparison, beside=beside, logs=logs, values=values, spread=spread, model=model, slopes=slopes,
        before=before,
    )  # fmt: skip
    tried = [*_try_parameters(case), *_try_shapes(case), *_try_rate(comparison, values, spread)]
    tried = rank(each for each in tried if each.left < before)
    if not tried:
        return [], spread
    limited = take_limited(comparison, logs) if _may_be_limited(case, tried) else None
    limit, told = (None, False) if limited is None else _try_limit(case, tried, limited)
    if limit is not None:
        tried = [limit, *tried] if told else rank((*tried, limit))
    kinds = _group(tried, noise)
    if tried[0].left > comparison.most_noise * noise:
        starts = _list_starts(case, kinds, limit, limited)
        pairs = find_pairs(starts, list_knobs(comparison, values), values, spread, tried, noise)
        inside = tried[0].difference.low is not None  # else more of it than is tried may be all
        sought = _try_mode(case, _find_gain(tried)) if inside else ()
        modes = [each for each in sought if is_worth(each, tried[0].left, noise)]
        pairs = [*modes, *pairs] if modes and (not pairs or modes[0].rank < pairs[0].left) else pairs
        kinds = [*([pair] for pair in pairs), *kinds]
    return _list_found(case, kinds, told=told), spread


def _group(tried: Sequence[Tried], noise: float) -> list[list[Tried]]:
    """Return causes, those together that may be one."""
    kinds: list[list[Tried]] = []
    for each in tried:
        twins = next((kind for kind in kinds if each.is_like(kind[0], noise)), None)
        if twins is None:
            kinds.append([each])
        else:
            twins.append(each)
    return kinds


def _list_found(case: Case, kinds: Sequence[list[Tried]], *, told: bool) -> list[Difference]:
    """Return what is listed: the best cause, those that the log does not tell from it, and, where it leaves more than
    noise, those that explain half as much. `told`: what lies between the lines tells it from all others.
    """
    found, best = list[Difference](), kinds[0][0]
    for kind in kinds[:MOST]:
        first, *others = _tell_apart(case.beside, case.values, kind)
        share, untold = case.share(first), not told and first.is_untold(best, case.noise)
        in_part = best.left > WORTH * case.noise and share >= HALF * case.share(best)
        if first is not best and kind is not kinds[0] and not untold and not in_part:
            continue
        alike = first.difference.alike + tuple(each.difference.name for each in others)
        values = first.difference.alike_values + tuple(each.difference.value for each in others)
        found.append(
            replace(
                first.difference,
                explains=share,
                left=first.left / case.noise,
                alike=alike,
                alike_values=values,
                untold=untold and kind is not kinds[0],
            )
        )
    return found


def _may_be_limited(case: Case, tried: Sequence[Tried]) -> bool:
    """Tell whether to try a limit of the drive: where a smaller gain explains much, or nothing explains all."""
    smaller = any(
        each.difference.kind == "gain" and 0.0 < each.difference.value < 1.0 and each.left <= HALF * case.before
        for each in tried
    )
    period = case.comparison.controller.sample_time_s
    every_tick = all(ticks.rate_hz * period > EVERY for ticks in case.logs)
    return every_tick and (smaller or tried[0].left > WORTH * case.noise)


def _try_limit(case: Case, tried: Sequence[Tried], limited: Comparison) -> tuple[Tried | None, bool]:
    """Return a limit of the drive where the log does not exclude it; and whether what lies between the lines tells it
    from the best of what was tried, which leaves no less than it. `limited`: the comparison whose model has one.
    """
    best = tried[0]
    limit = try_limit(limited, case.values, case.spread)
    if limit is None or limit.values is None or limit.left > RIVAL * max(best.left, case.noise):
        return None, False
    (its,) = find_distortion(limited, case.logs, [limit.values])
    unlimited = replace(limited, controller=case.comparison.controller)
    (others,) = find_distortion(unlimited, case.logs, [best.values or case.values])
    if not math.isfinite(its + others):  # nothing lies between the lines
        return limit, False
    if others * ALIKE <= its:
        return None, False
    return limit, its * ALIKE <= others and limit.is_untold(best, case.noise)


def _list_starts(
    case: Case, kinds: Sequence[Sequence[Tried]], limit: Tried | None, limited: Comparison | None
) -> list[Start]:
    """Return the best of each kind of causes that a second can be tried beside. `limited`: the model of `limit`."""
    starts, knobs = list[Start](), {knob.parameter.name: knob for knob in list_knobs(case.comparison, case.values)}
    for kind in kinds:
        for each in kind:
            what, value = each.difference, each.difference.value
            if what.kind == "parameter":
                start = knobs[what.name], math.log(value), case.comparison
            elif what.kind == "delay":
                knob = make_delay(case.comparison)
                start = knob, max(value / knob.sample_time_s, knob.earliest), case.comparison
            elif each is limit and limited is not None:
                start = make_knob(limited, value), 0.0, limited
            else:
                continue
            starts.append(Start(knob=start[0], size=start[1], comparison=start[2], single=each))
            break
    return starts


def _tell_apart(beside: Comparison, values: ParameterSet, kind: list[Tried]) -> list[Tried]:
    """Return causes that explain what the law reads as well as each other, the best first, without those that do not go
    with what was logged besides.
    """
    if not beside.names or len(kind) == 1:
        return kind
    models = beside.predict([each.values or values for each in kind])
    gains = [1.0 if each.values else each.difference.value for each in kind]
    left = [beside.misfit(gain * lines) for gain, lines in zip(gains, models, strict=True)]
    order = np.argsort([*map(drop_digits, left)], kind="stable").tolist()
    return [kind[k] for k in order if left[k] <= ALIKE * left[order[0]]]


def _try_parameters(case: Case) -> Iterator[Tried]:
    """Yield the parameters of the plant with the factors that fit best."""
    comparison, values, spread = case.comparison, case.values, case.spread
    searches = [
        Search(knobs=(knob,), sizes=np.zeros(1), model=case.model, slopes=case.slopes)
        for knob in list_knobs(comparison, values)
        if knob.kind == "parameter"
    ]
    done = refine(comparison, spread, values, searches)
    least = min((each.best.left for each in done if each.best), default=0.0)
    for each in done:
        if spread.names and each.best and each.best.left <= RIVAL * least:
            there = find_slopes(comparison, spread, each.place(values), each.model)
            (each,) = step(comparison, spread, values, [replace(each, slopes=there)])
        yield each.conclude(values)


def _try_rate(comparison: Comparison, values: ParameterSet, spread: Spread) -> Iterator[Tried]:
    """Yield the rate of the law's ticks that fits best, where timers run at such a one: a machine of other inertia and
    stiffness is like one at any. Law and log both go by ticks, so that the replay of a log whose clock counts them does
    not tell it; the machine goes by seconds, and its response does.
    """

    def at(log: float) -> Comparison:
        return replace(comparison, rate=math.exp(log))

    def misfit(log: float) -> float:
        left = comparison.misfit(at(log).predict([values])[0])
        return left if math.isfinite(left) else math.inf  # of a loop that runs away at that rate

    sliding = [comparison.misfit(replace(comparison, rate=rate).linearise(values)) for rate in USUAL_RATES]
    log = min(map(math.log, {*USUAL_RATES[:2], USUAL_RATES[int(np.nanargmin(sliding))]}), key=misfit)
    best: Best | None = None
    for _ in range(ROUNDS):
        (model,), (after,) = at(log).predict([values]), at(log + STEP).predict([values])
        slope = (after - model) / STEP
        if not np.all(np.isfinite(slope)):
            return
        leeway = spread.leave(find_slopes(at(log), spread, values, model))
        fit = SizeFit(comparison=comparison, leeway=leeway)
        best = fit.solve(lambda x, model=model, slope=slope: model + x[0] * slope, [0.0], [(-MOST_STEP, MOST_STEP)])
        log += float(best.sizes[0])
        if abs(best.sizes[0]) <= FOUND:
            break
    assert best is not None
    far = SURE * float(best.stds[0])
    rate = next((each for each in USUAL_RATES if abs(math.exp(log) / each - 1.0) <= SAME_RATE), None)
    if rate is None:
        return
    value = rate / comparison.controller.sample_time_s
    low, high = (value * math.exp(-far), value * math.exp(far)) if far < MOST_SPREAD else (None, None)
    difference = Difference(
        kind="rate", name="law", value=value, low=low, high=high, unit="Hz", explains=0.0, size=rate
    )  # fmt: skip
    yield Tried(difference=difference, left=best.left, response=best.response)


def _try_shapes(case: Case) -> Iterator[Tried]:
    """Yield a gain, a delay and a mode, each with the size that fits best."""
    f, fit, model = case.comparison.f, case.fit, case.model
    late = lambda x: model * np.exp(-2j * np.pi * f * x[0])  # noqa: E731
    for kind, unit, make, start in (("gain", "-", lambda x: model * x[0], 1.0), ("delay", "s", late, 0.0)):
        best = fit.solve(make, [start])
        value, reach = float(best.sizes[0]), SURE * float(best.stds[0])
        low, high = value - reach, value + reach
        difference = Difference(kind=kind, name=kind, value=value, low=low, high=high, unit=unit, explains=0.0)
        shaped = Tried(difference=difference, left=best.left, response=best.response)
        moves = kind == "delay" and value > 0.0 and case.comparison.simulates
        yield _simulate_delay(case, shaped) if moves else shaped
    yield from _try_mode(case)


def _simulate_delay(case: Case, shaped: Tried) -> Tried:
    """Return the delay that fits best, from one on that is about it: with dry friction the loop moves otherwise."""
    knob = make_delay(case.comparison)
    size = np.array([shaped.difference.value / knob.sample_time_s])
    search = Search(knobs=(knob,), sizes=size, model=case.model, slopes=case.slopes)
    (model,) = case.comparison.predict([search.place(case.values)])
    found = refine(case.comparison, case.spread, case.values, [replace(search, model=model)])
    return found[0].conclude(case.values) if found else shaped


def _find_gain(tried: Sequence[Tried]) -> float:
    """Return the gain that explains most by itself."""
    return next((each.difference.value for each in tried if each.difference.kind == "gain"), 1.0)


def _try_mode(case: Case, gain: float | None = None) -> Iterator[Tried]:
    """Yield the mode that fits best: a mass on a spring beside the drive, or a pair of zeros and one of poles. The
    force that a mass on a spring takes of the motion is added to the inverse of the response without hold and delay.
    `gain`: from which on one beside it is sought.
    """
    fit, model, comparison = case.fit, case.model, case.comparison
    f, controller = comparison.f, comparison.controller
    late = (controller.delay_samples + 0.5) * controller.sample_time_s
    held = np.sinc(f * controller.sample_time_s) * np.exp(-2j * np.pi * f * late)
    moved = -model / held * (2.0 * np.pi * f) ** 2
    lowest, highest = math.log(0.5 * f[0]), math.log(2.0 * np.max(f))

    def pair(hertz: Any, damping: Any) -> Lines:
        return 1.0 - (f / hertz) ** 2 + 2j * damping * f / hertz

    def take(x: Float[np.ndarray, " k"], k: int) -> tuple[Any, Any]:
        return np.exp(np.clip(x[k], lowest, highest)), np.exp(np.clip(x[k + 1], LEAST_DAMPING, 0.0))

    def absorb(x: Float[np.ndarray, " k"], scale: float) -> Lines:
        hertz, damping = take(x, 0)
        return 1.0 / (1.0 + x[2] * scale * moved * (1.0 + 2j * damping * f / hertz) / pair(hertz, damping))

    def divide(x: Float[np.ndarray, " k"]) -> Lines:
        return pair(*take(x, 0)) / pair(*take(x, 2))

    gains, near = ([], model) if gain is None else ([gain], gain * model)

    def make(x: Float[np.ndarray, " k"], shape: Callable[[Any], Lines]) -> Lines:
        return model * shape(x) * (x[-1] if gains else 1.0)

    misfit = np.abs((comparison.response - near) / comparison.std)
    best: tuple[Best, Callable[[Any], Lines]] | None = None
    apart = np.where(misfit > SEEN, np.abs(comparison.response / near - 1.0), 0.0)
    for line in np.unique(np.concatenate([np.argsort(-misfit)[:2], np.argsort(-apart)[:2]])):
        at, scale = math.log(f[line]), float(1.0 / abs(moved[line]))
        for damping in map(math.log, MODE_DAMPINGS):
            starts = [(partial(absorb, scale=scale), [at, damping, sign * 0.1]) for sign in (1.0, -1.0)]
            starts += [(divide, [at, damping, at + step, damping]) for step in (-0.05, 0.05)]
            for shape, start in starts:
                found = fit.solve(partial(make, shape=shape), [*start, *gains])
                hertz, damped = take(found.sizes, 0)
                inside = f[0] < hertz < np.max(f) and damped < MOST_DAMPED
                if inside and (best is None or found.left < best[0].left):
                    best = found, shape
    if best is not None:
        found, shape = best
        value, far = float(take(found.sizes, 0)[0]), SURE * float(found.stds[0])
        low, high = (value * math.exp(-far), value * math.exp(far)) if far < 1.0 else (None, None)
        changes, least, most = _find_change(found, shape)
        difference = Difference(
            kind="mode", name="mode", value=value, low=low, high=high, unit="Hz", explains=0.0,
            size=value / float(take(found.sizes, 2)[0]) if shape is divide else None,
            changes=changes, changes_low=least, changes_high=most,
            beside=tuple(_state_gain(float(found.sizes[-1]), float(found.stds[-1])) for _ in gains),
        )  # fmt: skip
        # it has some sizes where others have one
        yield Tried(difference=difference, left=found.left + 3.0, response=found.response)


def _state_gain(value: float, std: float) -> Difference:
    """Return a gain with its interval."""
    low, high = value - SURE * std, value + SURE * std
    return Difference(kind="gain", name="gain", value=value, low=low, high=high, unit="-", explains=0.0)


def _find_change(found: Best, shape: Callable[[Any], Lines]) -> tuple[float, float | None, float | None]:
    """Return by which factor a shape changes the response at a line, at most, and the interval of that factor."""

    def measure(x: Float[np.ndarray, " k"]) -> Float[np.ndarray, " m"]:
        return np.log(np.abs(shape(x)))

    sizes = measure(found.sizes)
    line = int(np.argmax(np.abs(sizes)))
    steps = SMALL * np.eye(found.sizes.size)
    slopes = [(measure(found.sizes + step)[line] - measure(found.sizes - step)[line]) / (2.0 * SMALL) for step in steps]
    size, far = abs(float(sizes[line])), SURE * math.sqrt(max(float(slopes @ found.covariance @ slopes), 0.0))
    told = 0.0 < far < size
    return math.exp(size), math.exp(size - far) if told else None, math.exp(size + far) if told else None
