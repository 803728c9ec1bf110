r"""The delay margin of a sampled loop, for its margins: the smallest extra delay that makes it unstable.

The plant is sampled with that delay in it.

A delay of :math:`(w + r) T_s`, :math:`0 \le r \le 1`, makes the loop gain :math:`L_r(z) z^{-w}`: the hold's response
changes with r, whole samples only turn the phase. With the crossovers :math:`\theta_j` of :math:`L_r`, where
:math:`|L_r| = 1`, and its phases :math:`0 \le p_j < 2\pi` left there to -1, each of the w samples turns
:math:`\theta_j` towards -1, and

.. math:: U(w, r) = U(0, r) + 2 \sum_j s_j \left(\left\lfloor \frac{w \theta_j - p_j}{2\pi} \right\rfloor + 1\right)
          + w\, [|L_r(-1)| > 1]

closed-loop poles are outside the circle: Nyquist's count, :math:`s_j = 1` where abs(L) falls with the frequency and -1
where it rises. One eigenvalue problem for every r, of the loop without w, is enough for any number of samples.

Between neighbouring r a term can step and another step back: an unstable window narrower than the grid. Every crossover
is therefore followed from r to r, and wherever one of the terms steps the delay at which it does is solved for: what
is under the floor is smooth. Where crossovers come or go from one r to the next, the grid is halved.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.control import Controller
from seaopt.control.loops.loop import STABLE, Loop
from seaopt.control.loops.peaks import find_crossovers
from seaopt.control.loops.sampled_plant import linearise_sets, sample_linear
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import take_sliding
from seaopt.records import record

CELLS = 16  # of a sample
NARROWEST_CELL = 1e-4  # of a sample: a crossover that comes and goes within less is not looked for
DELAY_BISECTIONS = 40
PART_TOLERANCE = 1e-13  # of a sample
LONGEST_DELAY = 20_000  # samples: beyond, a delay is no longer one of the loop that was modelled
FULL_TURN = 2.0 * np.pi
Crossovers = Float[np.ndarray, " k"]
Whole = Int[np.ndarray, " w"]  # samples


@record(eq=False)
class _DelayedLoop:
    """A loop whose plant is delayed by a part r of a sample, and what decides on every further whole sample."""

    part: float  # r
    angles: Crossovers  # ascending
    phases: Crossovers  # what is left to -1 at each
    outside: int  # closed-loop poles not inside the circle
    loud: bool  # abs(L) > 1 at the Nyquist frequency

    def matches(self, other: _DelayedLoop) -> bool:
        """Return whether the crossovers are those of the other, moved."""
        return self.angles.size == other.angles.size and self.loud == other.loud

    def count_unstable(self, samples: Whole) -> Whole:
        """Return the number of closed-loop poles outside the circle with so many further samples."""
        last = self.angles.size - 1 + int(self.loud)
        falling = 1 - 2 * ((last - np.arange(self.angles.size)) % 2)  # abs(L) through 1; -1 where it rises
        return self.outside + 2 * (self.count_passes(samples, self.phases) + 1) @ falling + samples * self.loud

    def turn(self, samples: Whole, phases: Crossovers) -> Float[np.ndarray, "w k"]:
        """Return by how many turns each crossover is beyond -1."""
        return (samples[:, None] * self.angles - phases) / FULL_TURN

    def count_passes(self, samples: Whole, phases: Crossovers) -> Int[np.ndarray, "w k"]:
        """Return how often each crossover has passed -1."""
        return np.floor(self.turn(samples, phases)).astype(int)

    def follow_phases(self, start: _DelayedLoop) -> Crossovers:
        """Return the phases continued from those of another loop, by less than half a turn."""
        step = self.phases - start.phases
        return start.phases + step - FULL_TURN * np.round(step / FULL_TURN)


def sampled_delay_margin(controller: Controller, plant: Plant, params: ParameterSet, reach_s: float) -> float | None:
    """Return the smallest extra delay, s, that makes the sampled loop unstable; zero where it is without one. None if
    no delay up to `reach_s` does. A delay among the parameters stays in the loop.
    """
    period = controller.sample_time_s
    sliding, effort = take_sliding(plant, params), controller.command.per_effort
    late = sliding.complete(controller.delay(params))
    linear, before = linearise_sets(sliding, [late], controller.signals, effort)

    @cache
    def delay_loop(part: float) -> _DelayedLoop:
        (sampled,) = sample_linear(linear, before + part * period, period, controller.compute_delay_samples)
        system = Loop(plant=sampled, law=controller.law).system()
        angles, phases = find_crossovers(system)
        return _DelayedLoop(
            part=part,
            angles=angles,
            phases=np.mod(phases, FULL_TURN),
            loud=bool(system.curves(np.array([np.pi]))[0, 0].real < 0.5),
            outside=int(np.sum(~(np.abs(system.poles) < STABLE))),
        )

    grid = _build_grid(delay_loop)
    samples = np.arange(int(np.ceil(reach_s / period)) + 1)
    outside = np.array([loop.count_unstable(samples) for loop in grid])
    if outside[0, 0]:
        return 0.0
    stepping = np.array([_find_steps(a, b, samples) for a, b in pairwise(grid)])
    events = (outside[:-1] > 0) | (outside[1:] > 0) | stepping
    for w, cell in zip(*np.nonzero(events.T), strict=True):
        part = _find_first(delay_loop, grid[cell], grid[cell + 1], int(w))
        if part is not None:
            delay = (w + part) * period
            return float(delay) if delay <= reach_s else None
    return None


def _build_grid(delay_loop: Callable[[float], _DelayedLoop]) -> list[_DelayedLoop]:
    """Return loops from no part of a sample to a whole one, fine enough to follow every crossover."""
    grid = [delay_loop(float(part)) for part in np.linspace(0.0, 1.0, CELLS + 1)]
    cell = 0
    while cell < len(grid) - 1:
        first, second = grid[cell], grid[cell + 1]
        if first.matches(second) or second.part - first.part < NARROWEST_CELL:
            cell += 1
        else:
            grid.insert(cell + 1, delay_loop(0.5 * (first.part + second.part)))
    return grid


def _find_steps(first: _DelayedLoop, second: _DelayedLoop, samples: Whole) -> Bool[np.ndarray, " w"]:
    """Return with which numbers of whole samples a crossover passes -1 between two neighbours."""
    if not first.matches(second):
        return np.zeros(samples.size, dtype=bool)
    passed = second.count_passes(samples, second.follow_phases(first))
    return np.any(first.count_passes(samples, first.phases) != passed, axis=1)


def _find_first(
    delay_loop: Callable[[float], _DelayedLoop], low: _DelayedLoop, high: _DelayedLoop, w: int
) -> float | None:
    """Return where between two neighbours the loop with w further samples becomes unstable; None if it does not."""
    from scipy.optimize import brentq

    samples = np.array([w])
    if low.count_unstable(samples)[0]:
        return low.part

    def bisect(beyond: Callable[[_DelayedLoop], bool]) -> float:
        start, end = low.part, high.part
        for _ in range(DELAY_BISECTIONS):
            middle = 0.5 * (start + end)
            start, end = (start, middle) if beyond(delay_loop(middle)) else (middle, end)
        return end

    ends = [high.part]
    if low.matches(high):
        before = low.count_passes(samples, low.phases)[0]
        after = high.count_passes(samples, high.follow_phases(low))[0]

        def find_pass(j: int) -> float:
            level = before[j] + (after[j] > before[j])
            nearest = low.turn(samples, low.phases)[0, j] - level

            def beyond(part: float) -> float:
                loop = delay_loop(part)  # one with other crossovers counts as not beyond
                return loop.turn(samples, loop.follow_phases(low))[0, j] - level if loop.matches(low) else nearest

            part: Any = brentq(beyond, low.part, high.part, xtol=PART_TOLERANCE)
            return float(part)

        ends = [*sorted(map(find_pass, map(int, np.flatnonzero(before != after)))), high.part]
    for end, following in pairwise(ends):
        if delay_loop(0.5 * (end + following)).count_unstable(samples)[0]:
            return end
    return bisect(lambda loop: bool(loop.count_unstable(samples)[0])) if high.count_unstable(samples)[0] else None
