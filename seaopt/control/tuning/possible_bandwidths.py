r"""Find the bandwidths that keep the limits where the one asked does not, for the tuner's answer.

What is possible is not always an interval that begins at the lowest: below a resonance a law may need more feedback
than above it. So bandwidths are probed outwards from the one asked, in steps of a fifth, down to a quarter and up to
twice it, or 60 Hz, at each a short evolution; the ends of what is possible next to it are found by bisection, and the
largest of all from the top down.

Where a sliding plant grows, how steeply friction may fall with speed is told too. Of Stribeck's friction
:math:`\sigma < 0` is the flattest slope, and a plant that slides has the damping :math:`b + \sigma`, which may be
negative: it then needs its controller to be stable. With a share of the fall it is

.. math:: A_\lambda = A + (1 - \lambda)\, B_f\, \sigma\, C_v,

from Coulomb's friction at 0 to the plant's own at 1. The largest share at which the limits are kept is found by
bisection, each law from the one before: a continuation, whose end is a start for the plant itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from seaopt.control.laws.verdict import PossibleBandwidths
from seaopt.control.loops.sampled_plant import sample_matrices
from seaopt.control.tuning.convex_concave import improve
from seaopt.control.tuning.evolution import ENCIRCLES, Evolution
from seaopt.control.tuning.frequencies import count_growing, make_grid, place_frequencies
from seaopt.control.tuning.grid import PlantWithFriction
from seaopt.control.tuning.interior_point import refine
from seaopt.control.tuning.law_numbers import LawNumbers
from seaopt.control.tuning.optimisation_problem import NEARLY_KEPT, Task
from seaopt.control.tuning.solution import recheck, solve, tighten_limits
from seaopt.progress import Progress, ignore

FARTHEST_BELOW, FARTHEST_ABOVE = 4.0, 2.0  # of the bandwidth asked: where others are looked for
USUAL_HZ = 60.0  # and as far as force loops usually go: above a resonance a law may need less than below it
PROBE_RATIO = 1.2  # of a probe to the next
STEP = 1.001 * math.log(PROBE_RATIO)
RESOLUTION = 0.01  # to which the end of what is possible is found, next to the bandwidth asked
FAR_RESOLUTION = 0.05  # and far from it, of the distance, in logarithms: nobody moves an octave for 1 % more
BISECTIONS = math.ceil(math.log2(math.log(PROBE_RATIO) / RESOLUTION))  # that find such an end
MEMBERS, GENERATIONS = 30, 40  # of the evolution at every bandwidth
STARTS_TRIED = 4
PROMISING_USAGE = 1.5  # of the evolution; what misses by more is not refined
REFINEMENTS = 3  # solutions of the interior-point method
HIGHEST_BANDWIDTH = 0.249  # of the sample rate
FAR = 1e3  # how much further away a law counts that does not keep the limits
FALL_RESOLUTION = 1.03  # ratio to which the largest share of a fall is found
SMALLEST_SHARE = 1e-3
HOPELESS_USAGE = 1.03  # near a bandwidth that is possible, what misses by more is not looked for elsewhere


def find_possible_bandwidths(
    task: Task, x: LawNumbers, progress: Progress = ignore
) -> tuple[PossibleBandwidths, list[LawNumbers]]:
    """Return the bandwidths nearby that keep the limits, and the numbers of the laws at those next to the task's own.
    `x`: the numbers that miss them least at the task's bandwidth.
    """
    return _Probes(task, x, progress).find()


def list_steps(bandwidth_hz: float, end: float) -> list[float]:
    """Return the bandwidths to probe from the one asked, which is not among them, to an end of the range."""
    count = int(np.ceil(abs(np.log(end / bandwidth_hz)) / np.log(PROBE_RATIO)))
    return [float(f) for f in np.geomspace(bandwidth_hz, end, count + 1)[1:]]


def find_end(
    keeps: Callable[[float], bool], steps: Sequence[float], outside: float | None, centre: float | None = None
) -> float | None:
    """Return the first bandwidth that keeps the limits, moved towards the one before, which does not.

    `outside`: the one before the first step, if there is any; `centre`: what the resolution depends on, else that one.
    """
    centre = centre or outside
    for inside in steps:
        if keeps(inside):
            break
        outside = inside
    else:
        return None
    resolution = max(RESOLUTION, FAR_RESOLUTION * abs(np.log(inside / (centre or inside))))
    while outside is not None and abs(np.log(outside / inside)) > resolution:
        middle = float(np.sqrt(inside * outside))
        inside, outside = (middle, outside) if keeps(middle) else (inside, middle)
    return inside


class _Probes:
    """What was found at the bandwidths tried: how much of a limit is used, and the numbers. The usage is 0 where all
    limits are kept, and infinite where no law was stable.
    """

    def __init__(self, task: Task, x: LawNumbers, progress: Progress) -> None:
        self.progress, self.expected = progress, 1
        self.task, self.bandwidth_hz = task.aim_multipliers(x), task.spec.bandwidth_hz
        self.tried: dict[float, tuple[float, LawNumbers]] = {self.bandwidth_hz: (np.inf, x)}

    def find(self) -> tuple[PossibleBandwidths, list[LawNumbers]]:
        """Return what `find_possible_bandwidths` does."""
        spec = self.task.spec
        lowest = max(self.bandwidth_hz / FARTHEST_BELOW, 1.01 * (spec.min_sensitivity_bandwidth_hz or 0.0))
        highest = min(max(self.bandwidth_hz * FARTHEST_ABOVE, USUAL_HZ), HIGHEST_BANDWIDTH * spec.sample_rate_hz)
        down, up = (list_steps(self.bandwidth_hz, end) for end in (lowest, highest))
        self.expected = len(down) + len(up) + BISECTIONS
        below, above = (find_end(self._keeps, steps, self.bandwidth_hz) for steps in (down, up))
        largest = below if above is None else find_end(self._keeps, [*reversed(up), above], None, self.bandwidth_hz)
        nearest = tuple(f for f in (below, above) if f is not None)
        missed, closest = min((usage, f) for f, (usage, _) in self.tried.items())
        possible = PossibleBandwidths(nearest_hz=nearest, largest_hz=largest)
        if np.isfinite(missed):
            possible = replace(possible, closest_hz=closest, missed_by=max(missed - 1.0, 0.0))
        return possible, [self.tried[f][1] for f in nearest]

    def _keeps(self, bandwidth_hz: float) -> bool:
        """Tell whether a law was found that keeps the limits, as measured."""
        if bandwidth_hz not in self.tried:
            done = len(self.tried) - 1
            self.progress(f"trying {bandwidth_hz:.3g} Hz instead", done / max(self.expected, done + 1))
            usage, x = self._tune(bandwidth_hz)
            self.tried[bandwidth_hz] = (usage, x) if usage else self._measure(bandwidth_hz, x)
        return self.tried[bandwidth_hz][0] == 0.0

    def _measure(self, bandwidth_hz: float, x: LawNumbers) -> tuple[float, LawNumbers]:
        """Return usage and numbers, by measurement, of a law that keeps the limits on the frequencies looked at. A
        friction margin is not measured again: it is aimed at with a reserve, and takes long.
        """
        task = self._aim(bandwidth_hz)
        plain = replace(task, spec=replace(task.spec, min_friction_margin=None))
        if not plain.list_broken(plain.measure(x)):
            return 0.0, x
        x = recheck(task, make_grid(task), x, REFINEMENTS)
        x, loops = tighten_limits(plain, x, plain.measure(x))
        return (NEARLY_KEPT if plain.list_broken(loops) else 0.0), x

    def _aim(self, bandwidth_hz: float) -> Task:
        low, high = self.task.spec.bandwidth_range_hz  # what may be asked, not what may be looked at
        around = min(low, bandwidth_hz), max(high, bandwidth_hz)
        spec = replace(self.task.spec, bandwidth_hz=bandwidth_hz, bandwidth_range_hz=around)
        return replace(self.task, spec=spec)

    def _tune(self, bandwidth_hz: float) -> tuple[float, LawNumbers]:
        """Return usage and numbers: from the nearest bandwidth's law, one that keeps the limits if there is any. A step
        away from a bandwidth that is possible its law is refined first, and what misses clearly from there is not
        looked for anywhere else. From further away a refinement leads nowhere.
        """
        task = self._aim(bandwidth_hz)
        grid = make_grid(task)
        apart, kept, start = min(
            (abs(np.log(f / bandwidth_hz)) + FAR * (usage > 0.0), usage == 0.0, f)
            for f, (usage, _) in self.tried.items()
        )
        x, refined = task.tidy(self.tried[start][1]), False
        if kept and apart < STEP and task.is_stable(x):
            x, refined = refine(task, grid, x, REFINEMENTS), True
            usage, _ = task.rank(grid, x)
            if usage == 0.0 or usage > HOPELESS_USAGE:
                return usage, x
        search = Evolution.of(task, grid, [x])
        usages, laws = search.run([x], members=MEMBERS, generations=GENERATIONS)
        starts = list(filter(task.is_stable, map(task.tidy, laws[usages < ENCIRCLES][:STARTS_TRIED])))
        if not starts:
            return np.inf, x
        near, x = x, min(starts, key=lambda start: task.rank(grid, start))
        if task.rank(grid, x)[0] <= PROMISING_USAGE and not (refined and np.allclose(x, near, rtol=1e-3)):
            x = refine(task, grid, x, REFINEMENTS)
        x = min(near, x, key=lambda numbers: task.rank(grid, numbers)) if refined else x
        return task.rank(grid, x)[0], x


def find_largest_fall(task: Task) -> tuple[PlantWithFriction, float, LawNumbers] | None:
    """Return the plant whose friction falls most, the largest share of it with which the limits are kept, and the law.
    It is one of the plants that grow as they slide; None where no friction falls, or the limits are not kept without a
    fall either. That a law keeps them is measured, as it is of the answer itself.
    """
    falling = [
        sliding
        for sliding in task.frictions
        if count_growing(task.plants[sliding.plant]) and sliding.find_fall()[1] > 0.0
    ]
    if not falling:
        return None

    def ease(share: float) -> Task:
        eased = {sliding.plant: _ease_fall(sliding, share) for sliding in falling}
        plants = tuple(eased[k].loop.plant if k in eased else plant for k, plant in enumerate(task.plants))
        frictions = tuple(eased.get(sliding.plant, sliding) for sliding in task.frictions)
        return replace(task, plants=plants, frictions=frictions)

    x, loops = solve(ease(0.0))
    if task.list_broken(loops):
        return None
    low, high, f = 0.0, 1.0, place_frequencies(task)
    while high > max(FALL_RESOLUTION * low, SMALLEST_SHARE):
        middle = float(np.sqrt(low * high)) if low else 0.25 * high
        eased = ease(middle)
        trial = refine(eased, eased.grid(f), improve(eased, eased.grid(f), x)[1]) if eased.is_stable(x) else x
        if eased.is_stable(trial) and not eased.list_broken(eased.measure(trial)):
            x, low = trial, middle
        else:
            high = middle
    return max(falling, key=lambda sliding: sliding.find_fall()[1]), low, x


def _ease_fall(sliding: PlantWithFriction, share: float) -> PlantWithFriction:
    """Return a sliding plant with a share of the fall of its friction."""
    loop, left = sliding.loop, (1.0 - share) * np.minimum(sliding.flattest, 0.0)
    a = loop.a + (loop.friction * left) @ loop.velocity
    c = loop.sensed + (loop.through * left) @ loop.velocity
    timing = loop.delay_s, loop.plant.sample_time_s, loop.plant.delay_samples
    plant = sample_matrices((a, loop.motor, c, loop.plant.d), *timing)
    eased = replace(loop, a=a, sensed=c, slopes=loop.slopes + left, plant=plant)
    return replace(sliding, loop=eased, flattest=sliding.flattest - left)
