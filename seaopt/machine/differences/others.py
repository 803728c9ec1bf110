r"""The interval of a difference beside others that may be there too.

Noise may hide another difference beside one that is found, and the size of the one that is found takes it up: a loop
that is later looks like some friction. About the place where it was found all that may be another one of the machine
has a size x, a factor's logarithm or a delay, and to first order of log G

.. math:: \chi^2 = \sum_k |\hat G_k - G_k (1 + \sum_i x_i w_{ik})|^2/s_k^2 + \tfrac12 c^T \Sigma^{-1} c
          + \tfrac12 \sum_j x_j^2/3^2,

with the sizes sought that are found, those c of certified machines, whose covariance is that of the draws, and those of
some others, which are within what is tried, 3. Stated is what holds the joint intervals beside none, and beside each
other that the log does not exclude: which leaves no more than noise does, or no more than the best of these. Where
another, or two, would leave it unsure that the difference is there at all, or make the interval more than twice as
wide, they do what it does: they are named, and the interval is that of their not being off.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Float

from seaopt.control.loops.sampled_plant import DELAY
from seaopt.machine.differences.comparison import Comparison, Lines
from seaopt.machine.differences.leeway import FELT, Spread
from seaopt.machine.differences.size_fit import UNTOLD, Difference
from seaopt.machine.differences.size_search import (
    MOST_LOG,
    MOST_SPREAD,
    STEP,
    SURE,
    Knob,
    Slopes,
    list_knobs,
    place_draw,
)
from seaopt.parameters import ParameterSet
from seaopt.records import record

FINE = 1e-5  # of a size, for the slopes of what has equations
ROUNDS = 2  # of Gauss and Newton, to the certified machine that goes best with a difference
WIDE = 2.0  # times the least of all: a std of which what makes it so is named
AT_ONCE = 2  # differences that are looked for
TOGETHER = 3  # of which what is named may be
GAIN = "gain"
OF_ALL = ""  # the gain among sizes, where a parameter of the plant may be named gain

Sizes = Float[np.ndarray, " n"]


@record(eq=False)
class Moves:
    """All that may be another one of the machine, and how certified machines differ in it."""

    comparison: Comparison
    values: ParameterSet  # of the plant without a difference
    spread: Spread
    knobs: Mapping[str, Knob]  # by parameter
    names: tuple[str, ...]  # of what has a size; the last is a gain's
    gain: float  # from which that one counts
    drawn: Float[np.ndarray, "n n"]  # covariance of the draws' sizes, about none

    def place(self, sizes: Sizes) -> ParameterSet:
        """Return the plant's values with sizes."""
        parts = dict(zip(self.names, sizes.tolist(), strict=True))
        moved = self.spread.move(np.array([parts[name] for name in self.spread.names]))
        at = {name: value for name, value in moved.items() if name not in self.knobs}
        values = place_draw(self.comparison, self.values, at) if at else self.values
        for name, knob in self.knobs.items():
            first = values[DELAY].value / knob.sample_time_s if name == DELAY and DELAY in values else 0.0
            values = knob.place(values, max(first + parts[name], knob.ends[0])) if parts[name] else values
        return values

    def respond(self, places: Sequence[Sizes]) -> list[Lines]:
        """Return the responses with sizes; of a loop that is earlier than the model can be, with that as a shape."""
        delay, k = self.knobs[DELAY], self.names.index(DELAY)
        late = -2j * np.pi * self.comparison.f * delay.sample_time_s
        models = zip(self.comparison.predict([*map(self.place, places)]), places, strict=True)
        return [self.gain * model * np.exp(min(x[k] - delay.earliest, 0.0) * late + x[-1]) for model, x in models]

    def look(self, sizes: Sizes) -> tuple[Lines, Slopes]:
        """Return the response with sizes, and what each adds to it."""
        step = STEP if self.comparison.simulates else FINE
        here, *moved = self.respond([sizes, *(sizes + each for each in step * np.eye(sizes.size))])
        ways = here * np.log(np.array(moved) / here) / step
        return here, np.where(np.isfinite(ways), ways, 0.0)

    def solve(
        self, here: Lines, ways: Slopes, sizes: Sizes, own: Sequence[int], others: Sequence[int] = ()
    ) -> tuple[Sizes, Float[np.ndarray, " k"], float]:
        """Return by how much the best sizes, own ones beside some others, are off those that make a response; the std
        of the own ones; and what is left by line.
        """
        free, drawn = [*own, *others], self.drawn.copy()
        drawn[free] = drawn[:, free] = 0.0
        variances, axes = np.linalg.eigh(drawn)
        felt = variances > FELT**2 * variances[-1]
        moves = np.vstack([np.eye(sizes.size)[free], axes.T[felt]])
        prior = np.concatenate([np.zeros(len(own)), np.full(len(others), 1.0 / MOST_LOG), variances[felt] ** -0.5])
        weight = math.sqrt(2.0) / self.comparison.std
        columns, off = weight * (moves @ ways), weight * (self.comparison.response - here)
        rows = np.hstack([columns.real, columns.imag, np.diag(prior)])
        right = np.concatenate([off.real, off.imag, -prior * (moves @ sizes)])
        covariance = np.linalg.pinv(rows @ rows.T, hermitian=True)
        change = covariance @ (rows @ right)
        left = 0.5 * float(np.sum((right - change @ rows) ** 2)) / here.size
        widening = self.comparison.widening * math.sqrt(max(left, 1.0))
        stds = widening * np.sqrt(np.maximum(np.diag(covariance)[: len(own)], 0.0))
        return change @ moves, stds, left


def state(comparison: Comparison, spread: Spread, values: ParameterSet, difference: Difference) -> Difference:
    """Return a difference from a plant's values with intervals that hold beside others; as it is where that is not
    looked for.
    """
    parts = (difference, *difference.beside)
    if not difference.held_beside_others or any(part.low is None for part in parts):
        return difference
    knobs = {knob.parameter.name: knob for knob in list_knobs(comparison, values)}
    names = (*dict.fromkeys((*knobs, *spread.names)), OF_ALL)
    gain = next((part.value for part in parts if part.kind == GAIN), 1.0)
    moves = Moves(
        comparison=comparison, values=values, spread=spread, knobs=knobs, names=names, gain=gain,
        drawn=_find_covariance(spread, knobs, names),
    )  # fmt: skip
    places = {"delay": DELAY, GAIN: OF_ALL}
    own, sizes = [names.index(places.get(part.kind, part.name)) for part in parts], np.zeros(len(names))
    for k, part in zip(own, parts, strict=True):
        if part.kind != GAIN:
            sizes[k] = part.value / knobs[DELAY].sample_time_s if part.kind == "delay" else math.log(part.value)
    here, ways = moves.look(sizes)
    for _ in range(ROUNDS):
        sizes = sizes + moves.solve(here, ways, sizes, own)[0]
        here, ways = moves.look(sizes)
    others = [k for k, name in enumerate(names) if name in knobs and np.any(ways[k]) and k not in own]
    chosen = [each for size in range(TOGETHER + 1 - len(parts)) for each in combinations(others, size)]
    solved = [(each, *moves.solve(here, ways, sizes, own, each)) for each in chosen]
    least = min(left for *_, left in solved)
    most = max(comparison.most_noise, least + UNTOLD * max(least, 1.0) / here.size)
    usable = sorted((each for each in solved if each[-1] <= most), key=lambda each: (len(each[0]), each[-1]))
    if not usable:  # no model has numbers there
        return difference
    narrow = WIDE * np.min([stds for _, _, stds, _ in usable], axis=0)
    count = max(AT_ONCE - len(parts), len(usable[0][0]))
    stated = list[Difference]()
    for i, (k, part) in enumerate(zip(own, parts, strict=True)):
        found, unless = list[Difference](), list[tuple[int, ...]]()
        for each, change, stds, _ in usable:
            at = _measure(moves, part, float(sizes[k] + change[k]), SURE * float(stds[i]))
            if any({*some} <= {*each} for some in unless):
                continue
            if each and (not at.is_there or stds[i] > narrow[i]):
                unless.append(each)
            elif len(each) <= count:
                found.append(at)
        unless.sort(key=lambda each: (len(each), each))
        said = [tuple(knobs[names[other]].name for other in each) for each in unless]
        stated.append(_join(found or [part], said))
    return replace(stated[0], beside=tuple(stated[1:]))


def _find_covariance(spread: Spread, knobs: Mapping[str, Knob], names: Sequence[str]) -> Float[np.ndarray, "n n"]:
    """Return the covariance of the draws' sizes, about none."""
    drawn = np.zeros((len(names), len(spread.beyond)))
    for name, at, size, beyond in zip(spread.names, spread.nominal, spread.sizes, spread.beyond.T, strict=True):
        if name == DELAY:
            beyond = beyond * size / knobs[name].sample_time_s
        elif name in knobs:
            beyond = np.log(np.maximum(1.0 + beyond * size / at, FINE))
        drawn[names.index(name)] = beyond
    return drawn @ drawn.T / max(len(spread.beyond), 1)


def _measure(moves: Moves, part: Difference, size: float, far: float) -> Difference:
    """Return a part of a difference with its size and interval in its unit, and those of what is alike, whose
    logarithms go with its own.
    """
    ends = (size, size - far, size + far)
    if part.kind == "delay":
        value, low, high = (moves.knobs[DELAY].sample_time_s * x for x in ends)
        return replace(part, value=value, low=low, high=high)
    scale = part.value if part.kind == GAIN else 1.0
    value, *both = (scale * math.exp(min(x, MOST_SPREAD)) for x in ends)
    share = math.log(value) / math.log(part.value) if part.value > 0.0 and part.value != 1.0 else 1.0
    alike = tuple(each**share if each > 0.0 else each for each in part.alike_values)
    return replace(part, value=value, low=min(both), high=max(both), alike_values=alike)


def _join(found: Sequence[Difference], unless: Sequence[tuple[str, ...]]) -> Difference:
    """Return the first of what was found beside others with an interval that holds all of theirs. `unless`: what does
    what it does.
    """
    ends = [end for each in found for end in (each.low, each.high) if end is not None]
    named = tuple(each for each in unless if not {*found[0].alike}.intersection(each))
    return replace(found[0], low=min(ends), high=max(ends), unless=named)
