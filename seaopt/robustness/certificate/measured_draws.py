"""A controller's loops at draws of what is uncertain, and the worst case of each plant, for the certificate.

Draws are made and measured in blocks, so that any number of them fits in memory; only the worst are kept. Parts of a
block, and searches of the plants, are independent of each other: an executor may do them in any order, and what comes
of them is the same, as nothing is cut or drawn by it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float

from seaopt.control.running.fed_back import WEIGHT
from seaopt.executors import Shared, map_ordered
from seaopt.progress import Progress, divide
from seaopt.records import record
from seaopt.robustness.bounds.bracket import Bracket, bracket
from seaopt.robustness.certificate.cases import Cases, Check, CheckContext, Draw, Evidence
from seaopt.robustness.certificate.requirement import UNSTABLE_LOOP, DrawnAt, Requirement, Spot, require_at_most
from seaopt.robustness.uncertainty.batch import DRAW_BLOCK, BatchFigures, batch_figures
from seaopt.robustness.uncertainty.draws import Column, Points
from seaopt.robustness.uncertainty.failure_probability import MonteCarlo, count_failures
from seaopt.robustness.uncertainty.rows import join_rows, take_rows
from seaopt.robustness.uncertainty.severity import LARGEST_MS, LARGEST_MT, UNSTABLE, find_failures, severities
from seaopt.robustness.uncertainty.worst import Worst, combine_worst, find_worst, measure_worst, place_values

DRAWS_PER_BLOCK = 50_000
DRAWS_KEPT = 5000  # of which Ms is kept, to be drawn
WORST_KEPT = 64  # worst draws kept of each plant
DRAWS_PER_PART = 4  # of those that are judged one by one
DRAW, SEARCH, BOUND = 1.5e-4, 0.3, 0.4  # seconds that each draw, search and bound of a plant takes as a rule
WITNESS_REMEDY = "tune with that plant in robust_to, a larger reserve or a lower bandwidth"
WEIGHT_REMEDY = "compensate a smaller fraction of gravity, or add an impedance: the tuner's loops are without a weight"

Case = TypeVar("Case")


@record(eq=False)
class _Tally:
    """The worst draws of a plant so far by one figure, as coordinates."""

    points: Points
    severity: Column

    def add(self, points: Points, severity: Column) -> _Tally:
        """Return the worst of these and of new draws."""
        both = join_rows([self, _Tally(points=points, severity=severity)])
        return take_rows(both, np.argsort(both.severity)[::-1][:WORST_KEPT])


def measure_uncertainty(context: CheckContext, progress: Progress) -> Evidence:
    """Return what the draws say, and the worst cases from them and a search."""
    drawing, searching = divide(progress, *_list_seconds(context))
    failed, drawn, drawn_ms = measure_draws(context.shared, context.samples, context.drawing, context.executor, drawing)
    worst, brackets = search_worst(context.shared, drawn, context.executor, searching)
    options = context.options
    counts, by_spot = count_failures(failed, options.seed, options.confidence), name_worst(context, worst)
    rows = () if context.place else draw_requirements(counts, by_spot, options.max_failure_probability)
    return Evidence(
        requirements=rows,
        fields={"monte_carlo": counts, "worst": worst, "brackets": brackets, "drawn_ms": drawn_ms},
        scope="drawn",
        risk=counts.risk,
    )


def name_worst(context: CheckContext, worst: Mapping[str, Worst]) -> dict[Spot, Worst]:
    """Return the worst case of each plant by where it is."""
    spots = context.cases.spots
    return {spots[name]._replace(place=context.place): case for name, case in worst.items()}


def _list_seconds(context: CheckContext) -> tuple[float, float]:
    plants, bounded = len(context.cases.plants), context.cases.bounds is not None
    return DRAW * context.samples * plants, (SEARCH + BOUND * bounded) * plants


DRAWS = Check(
    measure=measure_uncertainty,
    seconds=lambda context: sum(_list_seconds(context)),
    applies=lambda _: True,
    brief=lambda _: True,
)


def measure_draws(
    cases: Shared[Cases], samples: int, rng: np.random.Generator, executor: Executor | None, progress: Progress
) -> tuple[Bool[np.ndarray, "3 _"], dict[str, Float[np.ndarray, "_ k"]], dict[str, Float[np.ndarray, " _"]]]:
    """Draw and measure in blocks: which draws fail on some plant, the worst of each plant, and Ms of the first."""
    controller, plants, unknown = cases.value.controller, cases.value.plants, cases.value.unknown
    none = _Tally(points=np.empty((0, unknown.size)), severity=np.empty(0))
    tallies = {name: [none, none] for name in plants}  # by Ms, and by Mt
    failed = [np.zeros((3, 0), dtype=bool)]
    sizes = [min(DRAWS_PER_BLOCK, samples - start) for start in range(0, samples, DRAWS_PER_BLOCK)]
    hooks = iter(divide(progress, *(float(size) for size in sizes)))
    first: dict[str, Column] = {}
    for size in sizes:
        points = unknown.draw(size, rng)
        failed.append(np.zeros((3, size), dtype=bool))
        for name, batch in _measure_block(cases, unknown.values(points), size, executor, next(hooks)):
            failed[-1] |= find_failures(controller, batch)
            first.setdefault(name, batch.ms[:DRAWS_KEPT])
            tallies[name] = [
                tally.add(points, severities(controller, batch, by))
                for tally, by in zip(tallies[name], (LARGEST_MS, LARGEST_MT), strict=True)
            ]
    drawn = {name: np.unique(np.vstack([tally.points for tally in both]), axis=0) for name, both in tallies.items()}
    return np.hstack(failed), drawn, first


def _measure_block(
    cases: Shared[Cases],
    values: Mapping[str, Float[np.ndarray, " _"]],
    size: int,
    executor: Executor | None,
    progress: Progress,
) -> Iterator[tuple[str, BatchFigures]]:
    """Yield the figures of every plant at draws, which are cut where no executor has a say in it."""
    names, slices = list(cases.value.plants), [slice(k, k + DRAW_BLOCK) for k in range(0, size, DRAW_BLOCK)]
    threads = 2 if executor is None else 1
    parts = (
        (name, {key: column[piece] for key, column in values.items()}, threads) for name in names for piece in slices
    )
    measured = map_ordered(partial(_measure_part, cases), parts, executor)
    for number, name in enumerate(names):
        pieces: list[BatchFigures] = []
        for k, piece in enumerate(slices):
            pieces.append(next(measured))
            share = (number + (k + 1) / len(slices)) / len(names)
            progress(f"{name}, {min(piece.stop, size)} of {size} draws", share)
        yield name, join_rows(pieces)


def _measure_part(cases: Shared[Cases], part: tuple[str, Mapping[str, Column], int]) -> BatchFigures:
    """Return the figures of one plant at some draws."""
    name, values, threads = part
    measured = cases.value
    return batch_figures(measured.controller, measured.plants[name], measured.unknown.nominal, values, threads=threads)


def search_worst(
    cases: Shared[Cases], drawn: Mapping[str, Float[np.ndarray, "_ k"]], executor: Executor | None, progress: Progress
) -> tuple[dict[str, Worst], dict[str, Bracket]]:
    """Return the worst case found of every plant, from its worst draws, and the bounds where they are asked for."""
    worst: dict[str, Worst] = {}
    brackets: dict[str, Bracket] = {}
    searched = map_ordered(partial(_search_plant, cases), drawn.items(), executor)
    for number, (name, plant) in enumerate(cases.value.plants.items()):
        progress(f"worst case, plant {number + 1} of {len(drawn)}", number / len(drawn))
        case, bounded = next(searched)
        worst[name] = case.on(plant)
        if bounded is not None:
            brackets[name] = bounded
    return worst, brackets


def _search_plant(cases: Shared[Cases], part: tuple[str, Points]) -> tuple[Worst, Bracket | None]:
    """Return the worst case found of one plant, from its worst draws, and the bounds where they are asked for."""
    name, drawn = part
    controller, plant, unknown = cases.value.controller, cases.value.plants[name], cases.value.unknown
    worst = find_worst(controller, plant, unknown, drawn)
    if cases.value.bounds is None:
        return worst, None
    bounded = bracket(controller, plant, unknown, worst, cases.value.bounds)
    if bounded.parameters:
        worst = combine_worst([worst, measure_worst(controller, plant, unknown.nominal, bounded.parameters)])
    return worst, bounded


def judge_draws(
    context: CheckContext,
    most: int,
    judges: Mapping[str, Callable[[Shared[Cases], str, Sequence[Draw]], Sequence[Case]]],
    nominal: Sequence[Draw] = (),
) -> dict[str, list[tuple[Draw, Case]]]:
    """Return what the judgement of each plant makes of draws, the same for all, and of what is `nominal` before them:
    pairs of what the plant has of a draw and of what is made of it. What does not differ in that is judged once.
    """
    count, models, unknown = min(context.samples, most), context.cases.models, context.cases.unknown
    draws = [*nominal, *(unknown.list_draws(count, context.rng) if count and judges else ())]
    made: dict[str, list[tuple[Draw, Case]]] = {}
    for name, judge in judges.items() if draws else ():
        has = place_values(models[name], unknown.nominal, draws[-1])
        of_plant: list[Draw] = [{key: value for key, value in draw.items() if key in has} for draw in draws]
        distinct = list({tuple(draw.items()): draw for draw in of_plant}.values())
        parts = (distinct[k : k + DRAWS_PER_PART] for k in range(0, len(distinct), DRAWS_PER_PART))
        judged = map_ordered(partial(judge, context.shared, name), parts, context.executor)
        cases = zip(distinct, (case for part in judged for case in part), strict=True)
        by_draw = {tuple(draw.items()): case for draw, case in cases}
        made[name] = [(draw, by_draw[tuple(draw.items())]) for draw in of_plant]
    return made


def draw_requirements(
    result: MonteCarlo, worst: Mapping[Spot, Worst], max_failure_probability: float | None = None
) -> list[Requirement]:
    """Return what the draws require; where none fails, that the worst case found by search does not either."""
    bound = _require_bound(result, max_failure_probability)
    if not result.samples:
        return bound
    spot, case = max(worst.items(), key=lambda entry: entry[1].severity)
    size = f"has Ms {case.witness.ms:.4g}, Mt {case.witness.mt:.4g}" if case.severity < UNSTABLE else "is UNSTABLE"
    rows = [
        require_at_most(
            "monte_carlo_failures",
            float(result.failures),
            0.0,
            draw=DrawnAt(parameters=case.parameters),
            text=f"the worst case {size}",
            remedy=_advise_worst(case) if result.failures else "",
            **spot._asdict(),
        )
    ]
    if not result.failures:
        rows += [_require_worst(key, case) for key, case in worst.items() if case.limited or case.severity >= UNSTABLE]
    return rows + bound


def _require_bound(result: MonteCarlo, limit: float | None) -> list[Requirement]:
    """Return that the stated failure probability is low enough, where that is asked for."""
    if limit is None:
        return []
    value = result.failure_probability_bound if result.samples else 1.0
    fewest = int(np.ceil(np.log(1.0 - result.confidence) / np.log1p(-limit))) if limit < 1.0 else 1
    text, remedy = f"{result.failures} failures in {result.samples} draws", ""
    if not result.samples:
        text, remedy = "nothing is uncertain, so that nothing was drawn", "give a fit, prior_std or ranges"
    elif value > limit:
        remedy = f"{fewest} draws without a failure would do"
    return [require_at_most("max_failure_probability", value, limit, text=text, remedy=remedy)]


def _advise_worst(case: Worst) -> str:
    """Return what to do about a worst case."""
    return WEIGHT_REMEDY if WEIGHT in case[0].outputs else WITNESS_REMEDY


def _require_worst(spot: Spot, case: Worst) -> Requirement:
    """Return how much of the limits the worst case uses: 1 is all of it."""
    unstable = case.severity >= UNSTABLE
    row = require_at_most(
        "worst_case",
        np.inf if unstable else case.severity,
        1.0,
        draw=DrawnAt(parameters=case.parameters),
        text=UNSTABLE_LOOP if unstable else "",
        **spot._asdict(),
    )
    return row if row.met else replace(row, remedy=_advise_worst(case))
