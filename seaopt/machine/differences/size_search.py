"""The size of a cause, or of two at once, searched on the model of the machine."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control.loops.sampled_plant import DELAY, DELAYS
from seaopt.machine.differences.comparison import Comparison, Lines
from seaopt.machine.differences.leeway import Spread
from seaopt.machine.differences.size_fit import Best, Difference, SizeFit, Tried
from seaopt.parameters import Parameter, ParameterSet
from seaopt.records import record
from seaopt.robustness.uncertainty.worst import place_values

STEP = 0.02  # of a size, to see what it does
ROUNDS = 8  # of Gauss and Newton
FOUND = 1e-3  # a size is found where it moves by less
MOST_STEP = 0.5  # of it, in a round
MOST_LOG = 3.0  # of a factor: its logarithm goes no further
MOST_SPREAD = 10.0  # of a factor's logarithm, above which the log does not tell the factor
SURE = 1.96  # std, of 95 %

Slopes = Complex[np.ndarray, "n m"]


@record(eq=False)
class Knob:
    """What a cause changes of the machine: a parameter's factor, whose size is its logarithm, or the delay, in sample
    times.
    """

    kind: str  # parameter, drive limit, delay
    parameter: Parameter  # at the value that its size counts from
    sample_time_s: float = 1.0
    earliest: float = 0.0  # of a delay

    @property
    def ends(self) -> tuple[float, float]:
        """Between which its size lies."""
        return (self.earliest, math.inf) if self.kind == "delay" else (-MOST_LOG, MOST_LOG)

    def limit(self, size: float) -> tuple[float, float]:
        """Return between what its size may change in a round."""
        low, high = self.ends
        return max(low - size, -MOST_STEP), min(high - size, MOST_STEP)

    def place(self, values: ParameterSet, size: float) -> ParameterSet:
        """Return a plant's values with it."""
        late = self.sample_time_s * size
        value = late if self.kind == "delay" else self.parameter.value * math.exp(size)
        return values.with_parameters(replace(self.parameter, value=value, min=-math.inf, max=math.inf))

    def describe(self, size: float, std: float) -> Difference:
        """Return it as a difference, with its interval where the log tells it and its size is at no end of what is
        tried.
        """
        far = SURE * std
        told = far < MOST_SPREAD and all(abs(size - end) > FOUND for end in self.ends)
        value, low, high = map(self._measure, (size, size - far, size + far))
        return Difference(
            kind=self.kind, name=self.name, unit=self._unit, explains=0.0,
            value=value, low=low if told else None, high=high if told else None,
        )  # fmt: skip

    @property
    def name(self) -> str:
        """Under which it is stated."""
        return "delay" if self.kind == "delay" else self.parameter.name

    @property
    def _unit(self) -> str:
        return "-" if self.kind == "parameter" else self.parameter.unit

    def _measure(self, size: float) -> float:
        """Return a size in its unit."""
        if self.kind == "delay":
            return self.sample_time_s * size
        return (1.0 if self.kind == "parameter" else self.parameter.value) * math.exp(min(size, MOST_SPREAD))


def find_end(factor: float) -> int:
    """Return whether a factor of a parameter is at the upper (1) or the lower end (-1) of what is tried, or neither."""
    end = math.exp(MOST_LOG - FOUND)
    return int(factor >= end) - int(factor <= 1.0 / end)


def make_delay(comparison: Comparison) -> Knob:
    """Return the delay beside that which was certified: earlier by no more than the law has of it in whole ticks, and
    not where the model is simulated.
    """
    law = comparison.controller
    earliest = 0.0 if comparison.simulates else -float(law.compute_delay_samples)
    parameter = Parameter(name=DELAY, value=0.0, unit="s")
    return Knob(kind="delay", parameter=parameter, sample_time_s=law.sample_time_s, earliest=earliest)


def list_knobs(comparison: Comparison, values: ParameterSet) -> list[Knob]:
    """Return what may be another one of the machine."""
    parameters = [
        Knob(kind="parameter", parameter=each)
        for name, each in comparison.plant.complete(values).items()
        if each.value and name not in DELAYS
    ]
    return [*parameters, make_delay(comparison)]


@record(eq=False)
class Search:
    """The sizes of one cause, or of several at once, as far as they were found, and the response of the model there."""

    knobs: tuple[Knob, ...]
    sizes: Float[np.ndarray, " k"]
    model: Lines
    slopes: Slopes  # of the values that were drawn
    best: Best | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters that it moves."""
        return tuple(knob.parameter.name for knob in self.knobs)

    def place(self, values: ParameterSet, ahead: int | None = None) -> ParameterSet:
        """Return a plant's values with the causes, one of them a step ahead."""
        for k, (knob, size) in enumerate(zip(self.knobs, self.sizes.tolist(), strict=True)):
            values = knob.place(values, size + (STEP if k == ahead else 0.0))
        return values

    def conclude(self, values: ParameterSet) -> Tried:
        """Return what was found: the first cause, with the others beside it."""
        assert self.best is not None
        parts = zip(self.knobs, self.sizes.tolist(), self.best.stds.tolist(), strict=True)
        first, *others = (knob.describe(size, std) for knob, size, std in parts)
        difference = replace(first, beside=tuple(others))
        return Tried(difference=difference, left=self.best.left, response=self.best.response, values=self.place(values))


def find_slopes(comparison: Comparison, spread: Spread, values: ParameterSet, model: Lines) -> Slopes:
    """Return what each value that was drawn adds to the logarithm of a model's response, for its own spread."""
    moved = comparison.predict([place_draw(comparison, values, place) for place in spread.places])
    return np.log(np.array(moved).reshape(-1, model.size) / model)


def place_draw(comparison: Comparison, values: ParameterSet, place: Mapping[str, float]) -> ParameterSet:
    """Return values with those of a draw in place of the nominal; a loop that is earlier, as no draw is, stays so."""
    early = [parameter for name, parameter in values.items() if name == DELAY and parameter.value < 0.0]
    within = values.with_parameters(*(replace(parameter, value=0.0) for parameter in early))
    return place_values(comparison.plant, within, place).with_parameters(*early)


def refine(
    comparison: Comparison, spread: Spread, values: ParameterSet, searches: Sequence[Search], rounds: int = ROUNDS
) -> list[Search]:
    """Return searches as far as they come, without those that have no effect."""
    moving, done = list(searches), list[Search]()
    for _ in range(rounds):
        before, after = moving, step(comparison, spread, values, moving)
        still = [bool(np.all(np.abs(a.sizes - b.sizes) <= FOUND)) for a, b in zip(after, before, strict=True)]
        done += [each for each, rests in zip(after, still, strict=True) if rests]
        moving = [each for each, rests in zip(after, still, strict=True) if not rests]
        models = comparison.predict([each.place(values) for each in moving]) if moving else []
        moving = [replace(each, model=found) for each, found in zip(moving, models, strict=True)]
    done += [_judge_anew(comparison, spread, each) for each in moving]
    return [each for each in done if each.best is not None]


def _judge_anew(comparison: Comparison, spread: Spread, search: Search) -> Search:
    """Return a search that moved to its last round with what its model leaves there, in place of a straight line's."""
    if search.best is None:
        return search
    fit = SizeFit(comparison=comparison, leeway=spread.leave(search.slopes, *search.names))
    there = fit.solve(lambda _: search.model, [])
    return replace(search, best=replace(search.best, left=there.left, response=there.response))


def step(comparison: Comparison, spread: Spread, values: ParameterSet, searches: Sequence[Search]) -> list[Search]:
    """Return searches a step of Gauss and Newton further; as they are where they have no effect."""
    ahead = [each.place(values, k) for each in searches for k in range(len(each.knobs))]
    models, changed = iter(comparison.predict(ahead)), list[Search]()
    for each in searches:
        slopes = np.array([(next(models) - each.model) / STEP for _ in each.knobs])
        if not np.all(np.any(slopes, axis=1)) or not np.all(np.isfinite(slopes)):
            changed.append(each)
            continue
        fit = SizeFit(comparison=comparison, leeway=spread.leave(each.slopes, *each.names))
        start = [0.0] * len(each.knobs)
        ends = [knob.limit(size) for knob, size in zip(each.knobs, each.sizes.tolist(), strict=True)]
        best = fit.solve(lambda x, each=each, slopes=slopes: each.model + x @ slopes, start, ends)
        changed.append(replace(each, sizes=each.sizes + best.sizes, best=best))
    return changed
