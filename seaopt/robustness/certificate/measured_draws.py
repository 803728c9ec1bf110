"""A controller's loops at draws of what is uncertain, and the worst case of each plant, for the certificate.

Draws are made and measured in blocks, so that any number of them fits in memory; only the worst are kept. Parts of a
block, and searches of the plants, are independent of each other: an executor may do them in any order, and what comes
of them is the same, as nothing is cut or drawn by it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float

from seaopt.control import Controller
from seaopt.executors import Shared, map_ordered
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.progress import Progress, divide
from seaopt.records import record
from seaopt.robustness.bounds.bracket import Bracket, Budget, bracket
from seaopt.robustness.uncertainty.batch import DRAW_BLOCK, BatchFigures, batch_figures
from seaopt.robustness.uncertainty.draws import Column, Points, Uncertainty
from seaopt.robustness.uncertainty.rows import join_rows, take_rows
from seaopt.robustness.uncertainty.severity import LARGEST_MS, LARGEST_MT, find_failures, severities
from seaopt.robustness.uncertainty.worst import Worst, combine_worst, find_worst, measure_worst, place_values

DRAWS_PER_BLOCK = 50_000
DRAWS_KEPT = 5000  # of which Ms is kept, to be drawn
WORST_KEPT = 64  # worst draws kept of each plant
DRAWS_PER_PART = 4  # of those that are judged one by one

Draw = Mapping[str, float]
Case = TypeVar("Case")


@record(eq=False)
class Loops:
    """A controller on its plants, their uncertainty, and how much work to spend on bounds."""

    controller: Controller
    models: Mapping[str, Plant]  # as they are, with their friction
    plants: Mapping[str, Plant]  # without friction that sticks: sliding or stuck
    unknown: Uncertainty
    bounds: Budget | None = None

    def place(self, name: str, draws: Sequence[Draw]) -> list[ParameterSet]:
        """Return the parameters of the model of a name at draws."""
        return [place_values(self.models[name], self.unknown.nominal, draw) for draw in draws]


@record(eq=False)
class _Tally:
    """The worst draws of a plant so far by one figure, as coordinates."""

    points: Points
    severity: Column

    def add(self, points: Points, severity: Column) -> _Tally:
        """Return the worst of these and of new draws."""
        both = join_rows([self, _Tally(points=points, severity=severity)])
        return take_rows(both, np.argsort(both.severity)[::-1][:WORST_KEPT])


def measure_draws(
    loops: Shared[Loops], samples: int, rng: np.random.Generator, executor: Executor | None, progress: Progress
) -> tuple[Bool[np.ndarray, "3 _"], dict[str, Float[np.ndarray, "_ k"]], dict[str, Float[np.ndarray, " _"]]]:
    """Draw and measure in blocks: which draws fail on some plant, the worst of each plant, and Ms of the first."""
    controller, plants, unknown = loops.value.controller, loops.value.plants, loops.value.unknown
    none = _Tally(points=np.empty((0, unknown.size)), severity=np.empty(0))
    tallies = {name: [none, none] for name in plants}  # by Ms, and by Mt
    failed = [np.zeros((3, 0), dtype=bool)]
    sizes = [min(DRAWS_PER_BLOCK, samples - start) for start in range(0, samples, DRAWS_PER_BLOCK)]
    hooks = iter(divide(progress, *(float(size) for size in sizes)))
    first: dict[str, Column] = {}
    for size in sizes:
        points = unknown.draw(size, rng)
        failed.append(np.zeros((3, size), dtype=bool))
        for name, batch in _measure_block(loops, unknown.values(points), size, executor, next(hooks)):
            failed[-1] |= find_failures(controller, batch)
            first.setdefault(name, batch.ms[:DRAWS_KEPT])
            tallies[name] = [
                tally.add(points, severities(controller, batch, by))
                for tally, by in zip(tallies[name], (LARGEST_MS, LARGEST_MT), strict=True)
            ]
    drawn = {name: np.unique(np.vstack([tally.points for tally in both]), axis=0) for name, both in tallies.items()}
    return np.hstack(failed), drawn, first


def _measure_block(
    loops: Shared[Loops],
    values: Mapping[str, Float[np.ndarray, " _"]],
    size: int,
    executor: Executor | None,
    progress: Progress,
) -> Iterator[tuple[str, BatchFigures]]:
    """Yield the figures of every plant at draws, which are cut where no executor has a say in it."""
    names, slices = list(loops.value.plants), [slice(k, k + DRAW_BLOCK) for k in range(0, size, DRAW_BLOCK)]
    threads = 2 if executor is None else 1
    parts = (
        (name, {key: column[piece] for key, column in values.items()}, threads) for name in names for piece in slices
    )
    measured = map_ordered(partial(_measure_part, loops), parts, executor)
    for number, name in enumerate(names):
        pieces: list[BatchFigures] = []
        for k, piece in enumerate(slices):
            pieces.append(next(measured))
            share = (number + (k + 1) / len(slices)) / len(names)
            progress(f"{name}, {min(piece.stop, size)} of {size} draws", share)
        yield name, join_rows(pieces)


def _measure_part(loops: Shared[Loops], part: tuple[str, Mapping[str, Column], int]) -> BatchFigures:
    """Return the figures of one plant at some draws."""
    name, values, threads = part
    measured = loops.value
    return batch_figures(measured.controller, measured.plants[name], measured.unknown.nominal, values, threads=threads)


def search_worst(
    loops: Shared[Loops], drawn: Mapping[str, Float[np.ndarray, "_ k"]], executor: Executor | None, progress: Progress
) -> tuple[dict[str, Worst], dict[str, Bracket]]:
    """Return the worst case found of every plant, from its worst draws, and the bounds where they are asked for."""
    worst: dict[str, Worst] = {}
    brackets: dict[str, Bracket] = {}
    searched = map_ordered(partial(_search_plant, loops), drawn.items(), executor)
    for number, (name, plant) in enumerate(loops.value.plants.items()):
        progress(f"worst case, plant {number + 1} of {len(drawn)}", number / len(drawn))
        case, bounded = next(searched)
        worst[name] = case.on(plant)
        if bounded is not None:
            brackets[name] = bounded
    return worst, brackets


def _search_plant(loops: Shared[Loops], part: tuple[str, Points]) -> tuple[Worst, Bracket | None]:
    """Return the worst case found of one plant, from its worst draws, and the bounds where they are asked for."""
    name, drawn = part
    controller, plant, unknown = loops.value.controller, loops.value.plants[name], loops.value.unknown
    worst = find_worst(controller, plant, unknown, drawn)
    if loops.value.bounds is None:
        return worst, None
    bounded = bracket(controller, plant, unknown, worst, loops.value.bounds)
    if bounded.parameters:
        worst = combine_worst([worst, measure_worst(controller, plant, unknown.nominal, bounded.parameters)])
    return worst, bounded


def select_own(loops: Shared[Loops], name: str, draws: Sequence[Draw]) -> list[dict[str, float]]:
    """Return of draws what the model of a name has of them."""
    model, nominal = loops.value.models[name], loops.value.unknown.nominal
    names = [key for key in draws[0] if key in place_values(model, nominal, draws[0])] if draws else []
    return [{key: draw[key] for key in names} for draw in draws]


def judge_draws(
    judge: Callable[[Shared[Loops], str, Sequence[Draw]], Sequence[Case]],
    loops: Shared[Loops],
    name: str,
    draws: Sequence[Draw],
    executor: Executor | None,
) -> Iterator[Case]:
    """Yield what a judgement makes of every draw on the plant of a name, in order; it gets some draws at a time."""
    parts = (draws[k : k + DRAWS_PER_PART] for k in range(0, len(draws), DRAWS_PER_PART))
    for cases in map_ordered(partial(judge, loops, name), parts, executor):
        yield from cases
