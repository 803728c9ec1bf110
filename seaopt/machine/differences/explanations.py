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
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control.loops.sampled_plant import DELAYS
from seaopt.machine.differences.comparison import TOLERATED, Comparison, Lines
from seaopt.machine.differences.leeway import Leeway, Spread, take_spread
from seaopt.parameters import Parameter, ParameterSet
from seaopt.records import record
from seaopt.robustness.uncertainty.worst import place_values

STEP = 0.02  # of a parameter, to see what it does
ROUNDS = 4  # of Gauss and Newton
FOUND = 1e-3  # of a factor's logarithm: it is found where it moves by less
MOST_STEP = 0.5  # of it, in a round
MOST_LOG = 1.5  # of a factor: its logarithm goes no further
MOST_SPREAD = 10.0  # of a factor's logarithm, above which the log does not tell the factor
RIVAL = 20.0  # times what the best parameter leaves: parameters whose leeway is looked at where they are
WORTH = 2.0  # times what noise leaves: a misfit above has causes
# Of the misfit, in what noise leaves of a line: twice the difference of two causes is a chi square, 99.9 %.
UNTOLD = 5.4
ALIKE = 2.0  # times what the best of some causes leaves of other outputs: causes that go with these as well
MODE_DAMPINGS = (0.02, 0.1)
SEEN = 5.0  # std by which a line differs where a mode is looked for
MODE_COST = 2.0  # by which a mode, of several sizes, has to leave less than another cause does
LEAST_DAMPING, MOST_DAMPED = math.log(1e-4), 0.3
# Over that of the clock, at which timers step a law by mistake; the first two are tried always.
USUAL_RATES = (0.5, 2.0, 0.1, 0.2, 0.25, 1.0 / 3.0, 3.0, 4.0, 5.0, 10.0)
SAME_RATE = 0.01  # relative: a rate that is a usual one
RATE_COST = 2.0  # by which such a rate may leave more than another cause does
MOST = 4  # causes that are listed

Slopes = Complex[np.ndarray, "n m"]


@record
class Difference:
    """A way in which the machine differs, its size, and how much of the difference it explains."""

    kind: str  # parameter, gain, delay, mode, range, rate
    name: str  # the parameter, the signal
    value: float  # factor of a parameter or gain; seconds; Hz of a mode, of the law's ticks; the range
    low: float | None
    high: float | None
    unit: str
    explains: float  # share of the misfit, of what no certified machine has
    alike: tuple[str, ...] = ()  # parameters that would explain as much
    alike_values: tuple[float, ...] = ()  # their factors
    size: float | None = None  # of a mode: its zero's frequency over its pole's; of a rate: over that of the log


@record(eq=False)
class _Tried:
    """A cause with the size that fits best, and the misfit that it leaves."""

    difference: Difference
    left: float
    response: Lines
    values: ParameterSet | None = None  # of the plant, where a parameter is the cause

    def is_like(self, other: _Tried, noise: float) -> bool:
        """Tell whether two causes may be one, both factors of parameters or gains: the log does not tell them apart, or
        their responses differ by less than a machine and its model do. `noise`: what it leaves of the misfit.
        """
        mine, its = self.difference, other.difference
        if not (mine.unit == its.unit == "-" and {mine.kind, its.kind} <= {"parameter", "gain"}):
            return False
        untold = abs(self.left - other.left) <= UNTOLD * max(other.left / noise, 1.0)
        return untold or bool(np.max(np.abs(self.response / other.response - 1.0)) <= TOLERATED)

    @property
    def rank(self) -> float:
        """What it leaves, times what its kind costs."""
        if self.difference.kind == "rate":
            return self.left / RATE_COST
        return self.left * (MODE_COST if self.difference.kind == "mode" else 1.0)


def explain(comparison: Comparison, beside: Comparison, model: Lines, spread: Spread) -> list[Difference]:
    """Return the causes that explain the misfit of a controller's design plant, the best first. `beside`: of what was
    logged and the law does not read. `spread`: of the certified machines.
    """
    assert comparison.controller.design is not None
    values, noise = comparison.controller.design[1], float(comparison.f.size)
    if comparison.misfit(model) <= WORTH * noise:
        return []
    slopes = _find_slopes(comparison, spread, values, model)
    fit = _Fit(comparison=comparison, leeway=spread.leave(slopes))
    before = fit.solve(lambda _: model, []).left
    if before <= WORTH * noise:  # draws explain it by themselves, and do not help to tell of what
        spread, slopes = take_spread((), {}), slopes[:0]
        fit, before = replace(fit, leeway=spread.leave(slopes)), comparison.misfit(model)
    tried = [*_try_parameters(comparison, values, model, spread, slopes), *_try_shapes(fit, model)]
    tried = [each for each in (*tried, *_try_rate(comparison, values, spread)) if each.left < before]
    tried.sort(key=lambda each: each.rank)
    kinds: list[list[_Tried]] = []
    for each in tried:
        twins = next((kind for kind in kinds if each.is_like(kind[0], noise)), None)
        if twins is None:
            kinds.append([each])
        else:
            twins.append(each)
    found: list[Difference] = []
    for first, *others in (_tell_apart(beside, values, kind) for kind in kinds[:MOST]):
        share = 1.0 - max(first.left - noise, 0.0) / (before - noise)
        also, values_of = (tuple(getattr(each.difference, key) for each in others) for key in ("name", "value"))
        found.append(replace(first.difference, explains=share, alike=also, alike_values=values_of))
    return found


def _tell_apart(beside: Comparison, values: ParameterSet, kind: list[_Tried]) -> list[_Tried]:
    """Return causes that explain what the law reads as well as each other, the best first, without those that do not go
    with what was logged besides.
    """
    if not beside.names or len(kind) == 1:
        return kind
    models = beside.predict([each.values or values for each in kind])
    gains = [1.0 if each.values else each.difference.value for each in kind]
    left = [beside.misfit(gain * lines) for gain, lines in zip(gains, models, strict=True)]
    order = np.argsort(left, kind="stable").tolist()
    return [kind[k] for k in order if left[k] <= ALIKE * left[order[0]]]


@record(eq=False)
class _Best:
    """Sizes that fit best."""

    sizes: Float[np.ndarray, " k"]
    std: float  # of the first
    left: float  # of the misfit
    response: Lines


@record(eq=False)
class _Fit:
    """A least-squares fit of a cause's sizes to the measured response, and of what certified machines differ by."""

    comparison: Comparison
    leeway: Leeway

    def solve(self, make: Callable[[Any], Lines], start: Sequence[float], most: float = math.inf) -> _Best:
        """Return the best sizes of what makes a response of sizes. `most`: that they may be."""
        from scipy.optimize import least_squares  # deferred: 0.2 s

        k, leeway, measured = len(start), self.leeway, self.comparison.response
        std = self.comparison.std / math.sqrt(2.0)

        def respond(x: Float[np.ndarray, " n"]) -> Lines:
            return make(x[:k]) * np.exp(x[k:] @ leeway.directions)

        def errors(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " r"]:
            off = (measured - respond(x)) / std
            return np.concatenate([off.real, off.imag, x[k:] / leeway.std])

        first = np.array([*start, *(0.5 * (leeway.low + leeway.high))])  # at an edge the search would stay
        if not first.size:
            left = 0.5 * float(np.sum(errors(first) ** 2))
            return _Best(sizes=first, std=math.inf, left=left, response=respond(first))
        edges = [np.concatenate([np.full(k, sign * most), ends]) for sign, ends in ((-1, leeway.low), (1, leeway.high))]
        scale = np.concatenate([np.maximum(np.abs(start), 1e-3), leeway.std])
        solved = least_squares(errors, first, x_scale=scale, bounds=edges, max_nfev=200)
        left, variance = float(solved.cost), np.linalg.pinv(solved.jac.T @ solved.jac, hermitian=True)[0, 0]
        std_of_first = math.sqrt(max(left / measured.size, 1.0) * variance) if variance else math.inf
        return _Best(sizes=solved.x[:k], std=std_of_first, left=left, response=respond(solved.x))


def _find_slopes(comparison: Comparison, spread: Spread, values: ParameterSet, model: Lines) -> Slopes:
    """Return what each value that was drawn adds to the logarithm of a model's response, for its own spread."""
    moved = comparison.predict([place_values(comparison.plant, values, place) for place in spread.places])
    return np.log(np.array(moved).reshape(-1, model.size) / model)


@record(eq=False)
class _Factor:
    """A parameter's factor as far as it was found, and the response of the model with it."""

    parameter: Parameter  # at its nominal value
    log: float
    model: Lines
    slopes: Slopes  # of the values that were drawn
    best: _Best | None = None

    def place(self, values: ParameterSet, step: float = 0.0) -> ParameterSet:
        """Return a plant's values with it, or a step of its logarithm further."""
        value = self.parameter.value * math.exp(self.log + step)
        return values.with_parameters(replace(self.parameter, value=value, min=-math.inf, max=math.inf))

    def describe(self) -> Difference:
        """Return it as a difference, with its interval where the log tells it."""
        assert self.best is not None
        far, value = 1.96 * self.best.std, math.exp(self.log)
        low, high = (value * math.exp(-far), value * math.exp(far)) if far < MOST_SPREAD else (None, None)
        name = self.parameter.name
        return Difference(kind="parameter", name=name, value=value, low=low, high=high, unit="-", explains=0.0)


def _try_parameters(
    comparison: Comparison, values: ParameterSet, model: Lines, spread: Spread, slopes: Slopes
) -> Iterator[_Tried]:
    """Yield the parameters of the plant with the factors that fit best."""
    moving = [
        _Factor(parameter=each, log=0.0, model=model, slopes=slopes)
        for name, each in comparison.plant.complete(values).items()
        if each.value and name not in DELAYS
    ]
    done: list[_Factor] = []
    for _ in range(ROUNDS):
        before, after = moving, _step(comparison, spread, values, moving)
        still = [abs(new.log - old.log) <= FOUND for new, old in zip(after, before, strict=True)]
        done += [each for each, rests in zip(after, still, strict=True) if rests]
        moving = [each for each, rests in zip(after, still, strict=True) if not rests]
        models = comparison.predict([each.place(values) for each in moving]) if moving else []
        moving = [replace(each, model=found) for each, found in zip(moving, models, strict=True)]
    done = [each for each in (*done, *moving) if each.best is not None]
    least = min((each.best.left for each in done if each.best), default=0.0)
    for each in done:
        if spread.names and each.best and each.best.left <= RIVAL * least:
            there = _find_slopes(comparison, spread, each.place(values), each.model)
            (each,) = _step(comparison, spread, values, [replace(each, slopes=there)])
        assert each.best is not None
        yield _Tried(
            difference=each.describe(), left=each.best.left, response=each.best.response, values=each.place(values)
        )


def _step(comparison: Comparison, spread: Spread, values: ParameterSet, factors: Sequence[_Factor]) -> list[_Factor]:
    """Return factors a step of Gauss and Newton further; as they are where they have no effect."""
    changed = list[_Factor]()
    for each, after in zip(factors, comparison.predict([each.place(values, STEP) for each in factors]), strict=True):
        slope = (after - each.model) / STEP
        if not np.any(slope) or not np.all(np.isfinite(slope)):
            changed.append(each)
            continue
        fit = _Fit(comparison=comparison, leeway=spread.leave(each.slopes, each.parameter.name))
        best = fit.solve(lambda x, each=each, slope=slope: each.model + x[0] * slope, [0.0], MOST_STEP)
        log = float(np.clip(each.log + best.sizes[0], -MOST_LOG, MOST_LOG))
        changed.append(replace(each, log=log, best=best))
    return changed


def _try_rate(comparison: Comparison, values: ParameterSet, spread: Spread) -> Iterator[_Tried]:
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
    best: _Best | None = None
    for _ in range(ROUNDS):
        (model,), (after,) = at(log).predict([values]), at(log + STEP).predict([values])
        slope = (after - model) / STEP
        if not np.all(np.isfinite(slope)):
            return
        leeway = spread.leave(_find_slopes(at(log), spread, values, model))
        fit = _Fit(comparison=comparison, leeway=leeway)
        best = fit.solve(lambda x, model=model, slope=slope: model + x[0] * slope, [0.0], MOST_STEP)
        log += float(best.sizes[0])
        if abs(best.sizes[0]) <= FOUND:
            break
    assert best is not None
    far = 1.96 * best.std
    rate = next((each for each in USUAL_RATES if abs(math.exp(log) / each - 1.0) <= SAME_RATE), None)
    if rate is None:
        return
    value = rate / comparison.controller.sample_time_s
    low, high = (value * math.exp(-far), value * math.exp(far)) if far < MOST_SPREAD else (None, None)
    difference = Difference(
        kind="rate", name="law", value=value, low=low, high=high, unit="Hz", explains=0.0, size=rate
    )  # fmt: skip
    yield _Tried(difference=difference, left=best.left, response=best.response)


def _try_shapes(fit: _Fit, model: Lines) -> Iterator[_Tried]:
    """Yield a gain, a delay and a mode, each with the size that fits best."""
    f = fit.comparison.f
    late = lambda x: model * np.exp(-2j * np.pi * f * x[0])  # noqa: E731
    for kind, unit, make, start in (("gain", "-", lambda x: model * x[0], 1.0), ("delay", "s", late, 0.0)):
        best = fit.solve(make, [start])
        value, reach = float(best.sizes[0]), 1.96 * best.std
        low, high = value - reach, value + reach
        difference = Difference(kind=kind, name=kind, value=value, low=low, high=high, unit=unit, explains=0.0)
        yield _Tried(difference=difference, left=best.left, response=best.response)
    yield from _try_mode(fit, model)


def _try_mode(fit: _Fit, model: Lines) -> Iterator[_Tried]:
    """Yield the mode that fits best: a mass on a spring beside the drive, or a pair of zeros and one of poles. The
    force that a mass on a spring takes of the motion is added to the inverse of the response without hold and delay.
    """
    comparison = fit.comparison
    f, controller = comparison.f, comparison.controller
    late = (controller.delay_samples + 0.5) * controller.sample_time_s
    held = np.sinc(f * controller.sample_time_s) * np.exp(-2j * np.pi * f * late)
    moved = -model / held * (2.0 * np.pi * f) ** 2
    low, high = math.log(0.5 * f[0]), math.log(2.0 * np.max(f))

    def pair(hertz: Any, damping: Any) -> Lines:
        return 1.0 - (f / hertz) ** 2 + 2j * damping * f / hertz

    def take(x: Float[np.ndarray, " k"], k: int) -> tuple[Any, Any]:
        return np.exp(np.clip(x[k], low, high)), np.exp(np.clip(x[k + 1], LEAST_DAMPING, 0.0))

    def absorb(x: Float[np.ndarray, " k"]) -> Lines:
        hertz, damping = take(x, 0)
        return 1.0 / (1.0 + x[2] * scale * moved * (1.0 + 2j * damping * f / hertz) / pair(hertz, damping))

    def divide(x: Float[np.ndarray, " k"]) -> Lines:
        return pair(*take(x, 0)) / pair(*take(x, 2))

    misfit = np.abs((comparison.response - model) / comparison.std)
    best: tuple[_Best, float | None] | None = None
    apart = np.where(misfit > SEEN, np.abs(comparison.response / model - 1.0), 0.0)
    for line in np.unique(np.concatenate([np.argsort(-misfit)[:2], np.argsort(-apart)[:2]])):
        at, scale = math.log(f[line]), 1.0 / abs(moved[line])
        for damping in map(math.log, MODE_DAMPINGS):
            starts = [(absorb, [at, damping, sign * 0.1]) for sign in (1.0, -1.0)]
            starts += [(divide, [at, damping, at + step, damping]) for step in (-0.05, 0.05)]
            for shape, start in starts:
                found = fit.solve(lambda x, shape=shape: model * shape(x), start)
                hertz, damped = take(found.sizes, 0)
                inside = f[0] < hertz < np.max(f) and damped < MOST_DAMPED
                if inside and (best is None or found.left < best[0].left):
                    best = found, float(hertz / take(found.sizes, 2)[0]) if shape is divide else None
    if best is not None:
        found, size = best
        difference = Difference(
            kind="mode", name="mode", value=float(take(found.sizes, 0)[0]), low=None, high=None, unit="Hz",
            explains=0.0, size=size,
        )  # fmt: skip
        # it has some sizes where others have one
        yield _Tried(difference=difference, left=found.left + 3.0, response=found.response)
