"""Find the numbers of a law for one bandwidth in five steps, each the next one's start, for the tuner.

1. a scan over filters and gains, one of them or k_r from the bandwidth equality in closed form (`find_starts`);
2. from the best, successive quadratic programs in the gains, the convex-concave procedure (`convex_concave`);
3. an interior-point method in all numbers at once, on exact derivatives (`interior_point`);
4. where the best law leaves more of a step to its integral than is taken away in time, steps 2 and 3 from it with that
   as a limit, which beforehand would lead to worse local optima;
5. a recheck on frequencies that resolve every pole of plants and closed loops; where a limit is broken between the
   frequencies, those are added and step 3 is repeated.

Where no law keeps the limits, an evolution looks for one (`search`), from which steps 2 to 5 are repeated.
A friction margin is asked for afterwards, of the law that is best without, and everything repeated with it as a limit;
and less of a link's motion is fed forward where no law keeps the limits with all of it (`lower_fraction`).

The minimax leaves every limit as much room as the worst one uses: beside a noise gain that no law keeps, say, a
bandwidth far from the one asked costs nothing. So where no law keeps all limits, those that are missed most are eased
to what is used of them, and the law is looked for again, which then keeps the others as well as may be (`ease_limits`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from seaopt.control.laws.limits import BY_NAME, MeasuredLoop
from seaopt.control.laws.spec import LOWEST_HZ
from seaopt.control.laws.verdict import judge_all
from seaopt.control.loops.absolute_stability import SIMPLEST
from seaopt.control.loops.compensation.link_feedforward import FollowedBand, LinkEffect, LinkPath
from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.control.tuning.convex_concave import improve
from seaopt.control.tuning.evolution import Evolution
from seaopt.control.tuning.frequencies import make_grid, place_frequencies
from seaopt.control.tuning.grid import FRICTION, Grid
from seaopt.control.tuning.interior_point import CLEARLY, HOPELESS, refine
from seaopt.control.tuning.law_numbers import K_I, T_Q, W_R, LawNumbers
from seaopt.control.tuning.optimisation_problem import Task
from seaopt.control.tuning.starts import find_starts
from seaopt.progress import Progress, count_off, divide, ignore

STARTS_TRIED = 3  # two more where an observer, a notch, a prefilter or a speed loop makes more valleys
STARTS_REFINED = 2  # one more with an observer, a prefilter or a speed loop, all with a notch
FAR_OFF = 1.15  # of `far_off`; an evolution follows
AGREED, AGREEMENT = 1.01, 0.05  # usage of the limits themselves beyond which two starts tell; and how alike they miss
ROUNDS, LONG_ROUNDS = 5, 9  # of the interior point; integrals of a cascade move far
QUICKER_INTEGRAL = 10.0  # factor of k_i
RECHECKS = 3
NARROW = 1.01  # of a limit: what a law misses by less, it may miss between the frequencies alone
TIGHTENINGS = 3
MORE_RESERVE = (2e-3, 5e-3)  # more than a law may miss that counts as keeping its limits while one is looked for
LEAST_TIGHTENING = 1.0015  # less moves no law: a limit missed by a thousandth counts as kept on a grid
NO_LEVEL_ABOVE = 10.0  # a frequency further off counts no more: |F/F_ref| along -3 dB falls below it anywhere
LOWER_FRACTIONS = 4  # of a link's feedforward, by a fifth each
CLOSER = 0.5  # of what is missed with all of it and without any: a fraction between that misses more is not solved
EASINGS = 3
ALIKE = 1.1  # limits missed by as much as the worst within this factor are eased with it
ROOM = 1.02  # beyond what is used of an eased limit
MARGIN_RESOLUTION = 1.03  # ratio to which the largest friction margin is found
LEAST_MARGIN = 1e-3  # of the one asked: of a law without any, less is not looked for
SCAN, IMPROVEMENT, REFINEMENT, RECHECK = 1.0, 1.0, 3.0, 0.5  # of the time of a solution
ONCE, RAISING = 1.0, 4.0  # of that of one with a friction margin: each of four solutions, and a bisection
Solution = tuple[LawNumbers, list[MeasuredLoop]]  # with the loop of every plant


def solve_beside(
    task: Task, warm: Sequence[LawNumbers] = (), progress: Progress = ignore, *, far_off: float = FAR_OFF
) -> Solution:
    """Find the best numbers as `solve` does; of a disturbance observer also from the law without one, beside one so
    slow that it does nothing, and it is never worse than that. One that is the only integral is no slower than 3 s.
    What misses a limit by more than `far_off` is not begun again.
    """
    if task.nominal is None:
        return solve(task, warm, progress, far_off=far_off)
    whole, without = divide(progress, ONCE, ONCE)
    found, grid = solve(task, warm, whole, far_off=far_off), make_grid(task)
    if task.rank(grid, found[0])[0] > far_off:
        return found
    plain = replace(task, spec=replace(task.spec, structure="pid"), nominal=None)
    x, _ = solve(plain, progress=without, far_off=far_off)
    x[T_Q] = task.slowest_observer_s
    near = solve_near(task, task.tidy(x))
    return min(found, near, key=lambda each: (bool(task.list_broken(each[1])), task.rank(grid, each[0])))


def solve(
    task: Task, warm: Sequence[LawNumbers] = (), progress: Progress = ignore, *, far_off: float = FAR_OFF
) -> Solution:
    """Find the best numbers, and return them with every plant's loop. `warm`: numbers to start from besides those of
    the scan, which then tries one less. `far_off`: worst usage of the best of two refined starts beyond which no other
    is refined.
    """
    once, raising = divide(progress, ONCE, (3.0 * ONCE + RAISING) * task.asks_margin)
    x, loops = _solve_once(task, warm, once, far_off)
    return _meet_friction_margin(task, x, loops, raising) if task.asks_margin else (x, loops)


def _meet_friction_margin(task: Task, x: LawNumbers, loops: list[MeasuredLoop], progress: Progress) -> Solution:
    """Return the best law with the friction margin asked for, from the best without. The multiplier that shows most of
    a law is made a limit, and the best law with that looked for, as another may then show more. Where none has the
    margin, it is the law with the largest that keeps all other limits.
    """
    broken, best = task.list_broken(loops), (x, loops)
    if not broken:
        return best
    *parts, raising = divide(progress, ONCE, ONCE, ONCE, RAISING)
    if broken - {FRICTION}:  # what cannot be kept without a margin cannot be kept with it
        return solve_near(task.aim_multipliers(x), x, parts[0])
    other = x
    for multiplier, part in zip(("", "", SIMPLEST), parts, strict=True):
        tried = _solve_once(task.aim_multipliers(best[0], multiplier), (best[0],), part)
        broken, other = task.list_broken(tried[1]), tried[0]
        if not broken:
            return tried
        if broken == {FRICTION} and _least_slope(tried[1]) > _least_slope(best[1]):
            best = tried
    return _raise_friction_margin(task, *best, other, raising)


def _raise_friction_margin(
    task: Task, x: LawNumbers, loops: list[MeasuredLoop], other: LawNumbers, progress: Progress
) -> Solution:
    """Return the law with the largest friction margin below the one asked, by bisection, all other limits kept. At
    every slope two laws are tried: from the best so far, with the multiplier that shows most of it; and from the
    `other`, which misses all limits evenly with the simplest.
    """
    high = task.spec.level(FRICTION)
    assert high is not None
    low, f = _least_slope(loops) or LEAST_MARGIN * high, place_frequencies(task)
    least, most = low, high
    while high / low > MARGIN_RESOLUTION:
        left = _count_halvings(low, high) / _count_halvings(least, most)
        progress(f"friction margin {low:.3g} of {most:.3g}", 1.0 - left)
        middle = float(np.sqrt(low * high))
        easier = replace(task, spec=replace(task.spec, min_friction_margin=middle))
        for start, multiplier in ((x, ""), (other, SIMPLEST)):
            aimed = easier.aim_multipliers(start, multiplier)
            grid = aimed.grid(f)
            tried = refine(aimed, grid, improve(aimed, grid, start)[1])
            measured = aimed.measure(tried)
            if not aimed.list_broken(measured):
                x, loops, low = tried, measured, _least_slope(measured)
                break
        else:
            high = middle
    return x, loops


def _count_halvings(low: float, high: float) -> float:
    """Return how many bisections take a range to the resolution."""
    return math.log2(math.log(high / low) / math.log(MARGIN_RESOLUTION))


def _least_slope(loops: Sequence[MeasuredLoop]) -> float:
    return min(loop.friction_slope for loop in loops)


def _solve_once(task: Task, warm: Sequence[LawNumbers], progress: Progress, far_off: float = FAR_OFF) -> Solution:
    """Find the best numbers with the multipliers that are aimed at, if any."""
    finding, checking = divide(progress, SCAN + IMPROVEMENT + REFINEMENT, RECHECK)
    grid = make_grid(task)
    x = find_best(replace(task, settles=False), grid, warm, finding, far_off)
    return _finish(task, grid, x, checking)


def solve_near(task: Task, x: LawNumbers, progress: Progress = ignore, *, keeping: bool = False) -> Solution:
    """Find the best numbers near others; `keeping` is of `refine`."""
    grid = make_grid(task)
    return _finish(task, grid, _descend(task, grid, x, keeping=keeping), progress)


def _descend(task: Task, grid: Grid, x: LawNumbers, *, keeping: bool = False) -> LawNumbers:
    """Return the numbers after quadratic programs and interior point."""
    return refine(task, grid, improve(task, grid, x)[1], _count_rounds(task), keeping=keeping)


def follow_task(task: Task, x: LawNumbers, loops: list[MeasuredLoop]) -> Solution:
    """Return a law near one that misses limits of a task which has changed; that one where there is none that is
    better.
    """
    missed = measure_missed(task, loops)
    if missed and max(missed.values()) <= NARROW:
        near = tighten_limits(task, x, loops)
        if not task.list_broken(near[1]):
            return near
    return retry(task, x, loops, [x])


def search(task: Task, x: LawNumbers, loops: list[MeasuredLoop], *, again: bool = True) -> Solution:
    """Return a law that keeps the limits as it is; of one that misses them a better one, if an evolution finds it.
    `again`: whether a second population is tried where the first has no law that keeps them.
    """
    if not task.list_broken(loops) - {FRICTION}:
        return x, loops
    evolution = Evolution.of(task, make_grid(task), [x])
    return retry(task, x, loops, evolution.find([x], again=again), keeping=not again)


def retry(
    task: Task, x: LawNumbers, loops: list[MeasuredLoop], starts: Sequence[LawNumbers], *, keeping: bool = False
) -> Solution:
    """Return a better law than the one that misses limits, from other starts; else that one. `keeping` is of `refine`:
    the first numbers that keep the limits may be enough.
    """
    grid = make_grid(task)
    best, rank = (x, loops), task.rank(grid, x)
    for start in map(task.tidy, starts):
        if not task.is_stable(start):
            continue
        tried = solve_near(task, start, keeping=keeping)
        broken = task.list_broken(tried[1])
        if not broken - {FRICTION}:
            return _meet_friction_margin(task, *tried, ignore) if broken else tried
        if task.rank(grid, tried[0]) < rank:
            best, rank = tried, task.rank(grid, tried[0])
        if keeping and rank[0] == 0.0:  # what is eased is kept as eased
            break
    return best


def _finish(task: Task, grid: Grid, x: LawNumbers, checking: Progress) -> Solution:
    """Return numbers that leave as much to their integral as is allowed, rechecked, with their loops."""
    settling = task.tidy(x)
    if settling[W_R] < x[W_R]:
        x = _descend(task, grid, settling)
    checking("checking between the frequencies", 0.0)
    x = recheck(task, grid, x)
    loops = task.measure(x)
    return (x, loops) if task.rank(grid, x)[0] > 0.0 else tighten_limits(task, x, loops)


def tighten_limits(task: Task, x: LawNumbers, loops: list[MeasuredLoop]) -> Solution:
    """Return a law that keeps limits which the given one misses by next to nothing; that one where none is found. With
    no reserve a law is on its limits at the frequencies looked at, and may be beyond them in between. So these are
    lowered by what is missed, and the law refined; where that is so little that the law counts as keeping the lowered
    ones too, or a frequency is missed, with more of a reserve.
    """
    best, factors = (x, loops), dict(task.eased)
    for _ in range(TIGHTENINGS):
        missed = measure_missed(task, best[1])
        if not missed or max(missed.values()) > NARROW or not all(map(can_ease, missed)):
            break
        factors |= {name: factors.get(name, 1.0) / max(used**2, LEAST_TIGHTENING) for name, used in missed.items()}
        tight = replace(task, eased=factors)
        trial = refine(tight, make_grid(tight), best[0])
        best = (trial, task.measure(trial))
        if not task.list_broken(best[1]):
            return best
    missed = measure_missed(task, loops)
    if missed and all(used <= NARROW or BY_NAME[name].reserve == "curve" for name, used in missed.items()):
        for reserve in (more for more in MORE_RESERVE if more > task.spec.reserve):
            tight = replace(task, spec=replace(task.spec, reserve=reserve))
            trial = refine(tight, make_grid(tight), x)
            measured = task.measure(trial)
            if not task.list_broken(measured):
                return trial, measured
    return x, loops


def can_ease(name: str) -> bool:
    """Tell whether a limit is a level, and not a frequency, which is what is asked for."""
    return BY_NAME[name].curve is not None and BY_NAME[name].reserve == "figure"


def measure_missed(task: Task, loops: Sequence[MeasuredLoop]) -> dict[str, float]:
    """Return how much of each limit that is missed is used, on the plant that uses most."""
    missed: dict[str, float] = {}
    for verdict in judge_all(task.spec, loops, task.design_states):
        if not verdict.met:
            name = verdict.limit.name
            used = verdict.severity if can_ease(name) or name == "stability" else min(verdict.severity, NO_LEVEL_ABOVE)
            missed[name] = max(missed.get(name, 1.0), used)
    return missed


def recheck(task: Task, grid: Grid, x: LawNumbers, rounds: int = ROUNDS) -> LawNumbers:
    """Refine numbers on a grid until no limit is broken between its frequencies, or no more than on them. Of what
    misses limits clearly on them nothing is refined.
    """
    for _ in range(RECHECKS if task.rank(grid, x)[0] <= HOPELESS else 0):
        missed = _find_missed(task, x, grid)
        if not missed.size:
            break
        grid = task.grid(np.unique(np.concatenate([grid.f, missed])))
        x = refine(task, grid, x, rounds)
    return x


def find_best(task: Task, grid: Grid, warm: Sequence[LawNumbers], progress: Progress, far_off: float) -> LawNumbers:
    """Find the best numbers on a grid; `far_off` is of `solve`."""
    scanning, improving, refining = divide(progress, SCAN, IMPROVEMENT, REFINEMENT)
    scanning("scanning gains", 0.0)
    spec = task.spec
    more = any(part is not None for part in (task.nominal, spec.notch, spec.reference_filter, task.speed_loop))
    warm = [task.tidy(x) for x in warm]
    first = [x for x in warm if task.is_stable(x)] + find_starts(task, grid, STARTS_TRIED + 2 * more - bool(warm))
    ranked = sorted((improve(task, grid, x) for x in count_off(first, "start", improving)), key=lambda pair: pair[0])
    count = len(ranked) if spec.notch is not None else STARTS_REFINED + more
    chosen: list[LawNumbers] = []
    for _, x in ranked:
        if len(chosen) < count and not any(np.allclose(x, other, rtol=0.1, atol=1e-6) for other in chosen):
            chosen.append(x)
    refined: list[tuple[tuple[float, float], LawNumbers]] = []
    best = chosen[0]
    for start in count_off(chosen, "refining start", refining):
        x = refine(task, grid, start, _count_rounds(task))
        refined.append((task.rank(grid, x), x))
        (least, _), best = min(refined, key=lambda pair: pair[0])
        if len(refined) == STARTS_REFINED and (least > far_off or _agree(task, *(rank[0] for rank, _ in refined))):
            return best
    return best if task.speed_loop is None else _quicken_integral(task, grid, best)


def _agree(task: Task, *usages: float) -> bool:
    """Tell whether laws from different starts miss the limits themselves, and by the same: the least there is."""
    least, most = min(usages) * (1.0 - task.spec.reserve), max(usages) * (1.0 - task.spec.reserve)
    return least > AGREED and most - least < AGREEMENT * (least - 1.0)


def _count_rounds(task: Task) -> int:
    return ROUNDS if task.speed_loop is None else LONG_ROUNDS


def _quicken_integral(task: Task, grid: Grid, x: LawNumbers) -> LawNumbers:
    """Return the better of numbers and what comes of them with a much faster integral, a valley of its own."""
    faster = x.copy()
    faster[K_I] *= QUICKER_INTEGRAL
    faster = task.tidy(faster)
    if not task.is_stable(faster):
        return x
    return min(x, _descend(task, grid, faster), key=lambda numbers: task.rank(grid, numbers))


def _find_missed(task: Task, x: LawNumbers, grid: Grid) -> np.ndarray:
    """Return frequencies between the grid's at which more of a limit is used than anywhere on it."""
    allowed = {name: max(1.0, float(np.max(curve))) for name, curve in task.usage(grid, task.respond(grid, x)).items()}
    out: list[float] = []
    for row in range(len(task.plants)):
        dense = task.loop(x, row).grid()
        f = dense[(dense >= LOWEST_HZ) & (dense < grid.f[-1])]
        between = task.grid(f, [row])
        for name, curve in task.usage(between, task.respond(between, x)).items():
            top = int(np.argmax(curve))
            if curve[0, top] > allowed[name] * (1.0 + max(0.4 * task.spec.reserve, 1e-6)):
                out.append(float(f[top]))
    return np.array([f for f in out if np.min(np.abs(grid.f / f - 1.0)) > 1e-7])


def feed_link(task: Task, link: LinkPath | None) -> Task:
    """Return a task whose link is fed forward by another path; the same where it is not fed forward."""
    if link is None:
        return task
    return replace(task, link=link, further=(*task.further[:-1], link.feedback(task.spec.sample_time_s)))


def lower_fraction(task: Task, x: LawNumbers, loops: list[MeasuredLoop]) -> tuple[Task, LawNumbers, list[MeasuredLoop]]:
    """Return task, numbers and loops with as large a fraction of the link's feedforward as keeps the limits.

    It is lowered by a fifth at a time where none is asked and a limit is broken; where none keeps them, it is that
    which shows most of a friction margin that alone is missed, else zero, as nothing shows then which one misses least.
    Where limits are missed clearly with all of it, little is looked for without any, and where they are missed far,
    only near that law, as an evolution follows; and what lies between is solved only where a law near the better of
    these two comes close to keeping them.
    """
    request, link = task.spec.link_feedforward, task.link
    broken = task.list_broken(loops)
    if request is None or request.fraction is not None or link is None or not broken:
        return task, x, loops
    shares = (*(0.8 ** (power + 1) for power in range(LOWER_FRACTIONS)), 0.0)
    *lower, none = (feed_link(task, replace(link, fraction=round(share * link.fraction, 3))) for share in shares)
    missing, without = [(task, x, loops)] if broken == {FRICTION} else [], None
    miss = _measure_miss(task, x)
    if miss > CLEARLY:
        near = none.tidy(x)
        scanned = miss <= FAR_OFF or not none.is_stable(near)
        without = solve_beside(none, (x,), far_off=CLEARLY) if scanned else solve_near(none, near)
        if none.list_broken(without[1]) == {FRICTION} and not scanned:
            without = _meet_friction_margin(none, *without, ignore)
        least, start = min((miss, x), (_measure_miss(none, without[0]), without[0]), key=lambda pair: pair[0])
        close = float(np.clip(1.0 + CLOSER * (least - 1.0), CLEARLY, HOPELESS))
        lower = [] if least > FAR_OFF else [fed for fed in lower if _follow(fed, start) <= close]
    answer = (task, x, loops)
    for fed in (*lower, none):
        answer = (fed, *(without if fed is none and without else solve_beside(fed)))
        broken = fed.list_broken(answer[2])
        if not broken:
            return answer
        if broken == {FRICTION}:
            missing.append(answer)
    return max(missing, key=lambda solution: _least_slope(solution[2])) if missing else answer


def weigh_link(task: Task, x: LawNumbers, loops: Sequence[MeasuredLoop]) -> Task:
    """Return the task whose link's path has what it changes beside the law without it, tuned near this one; as it is
    where the limits are kept with it or without it alone.
    """
    link = task.link
    if link is None or not link.fraction or task.list_broken(loops):
        return task
    without = feed_link(task, replace(link, fraction=0.0))
    start = without.tidy(x)
    if not without.is_stable(start):
        return task
    other, bare = solve_near(without.aim_multipliers(start), start)
    if without.list_broken(bare):
        return task
    cost = task.rank(make_grid(task), x)[1] / without.rank(make_grid(without), other)[1] - 1.0
    bands = [
        FollowedBand(plant=loop.name, band_hz=loop.figures.tracking_band_hz, without_hz=beside.figures.tracking_band_hz)
        for plant, loop, beside in zip(task.plants, loops, bare, strict=True)
        if isinstance(plant, DigitalPlant) and np.any(plant.c[-1])
    ]
    effect = LinkEffect(objective=task.spec.objective, cost=cost, bands=tuple(bands))
    return feed_link(task, replace(link, effect=effect))


def _measure_miss(task: Task, x: LawNumbers) -> float:
    """Return the worst usage of a limit."""
    return task.rank(make_grid(task), x)[0]


def _follow(task: Task, x: LawNumbers) -> float:
    """Return the worst usage of a limit near a law of another fraction."""
    x = task.tidy(x)
    if not task.is_stable(x):
        return math.inf
    grid = make_grid(task)
    return task.rank(grid, refine(task, grid, x, 2))[0]


def ease_limits(task: Task, x: LawNumbers, loops: list[MeasuredLoop], progress: Progress = ignore) -> Solution:
    """Return the law that keeps what can be kept beside the limits missed most, from the one whose worst is least."""
    best, factors = (x, loops), dict(task.eased)
    for number in range(EASINGS):
        missed = measure_missed(task, best[1])
        left = {name: used for name, used in missed.items() if can_ease(name) and name not in factors}
        if not left or not math.isfinite(max(missed.values())):
            break
        progress("keeping what can be kept", number / EASINGS)
        worst = max(left.values())
        factors |= {name: ROOM * used for name, used in left.items() if used * ALIKE >= worst}
        tried = search(replace(task, eased=factors), *best, again=False)
        if _total(measure_missed(task, tried[1])) < _total(missed):
            best = tried
    return best


def _total(missed: Mapping[str, float]) -> float:
    """Return by how much limits are missed in all, in logarithms."""
    return sum(map(math.log, missed.values()))
