"""Find the numbers of a law for one bandwidth in four steps, each the next one's start, for the tuner.

1. a scan over filters and gains, one of them or k_r from the bandwidth equality in closed form (`find_starts`);
2. from the best, successive quadratic programs in the gains, the convex-concave procedure (`convex_concave`);
3. an interior-point method in all numbers at once, on exact derivatives (`interior_point`);
4. a recheck on frequencies that resolve every pole of plants and closed loops; where a limit is broken between the
   frequencies, those are added and step 3 is repeated.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from seaopt.control.laws.limits import MeasuredLoop
from seaopt.control.laws.spec import LOWEST_HZ
from seaopt.control.tuning.convex_concave import improve
from seaopt.control.tuning.interior_point import refine
from seaopt.control.tuning.optimisation_problem import Grid, LawNumbers, Task, place_frequencies
from seaopt.control.tuning.starts import find_starts

STARTS_TRIED = 3  # two more where an observer or a notch makes more valleys
STARTS_REFINED = 2  # one more with an observer, all with a notch
RECHECKS = 3


def solve(task: Task, warm: Sequence[LawNumbers] = ()) -> tuple[LawNumbers, list[MeasuredLoop]]:
    """Find the best numbers, and return them with every plant's loop.

    Parameters
    ----------
    task : Task
        What is to be tuned.
    warm : sequence of arrays, shape (10,)
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
