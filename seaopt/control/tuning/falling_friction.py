r"""How steeply friction may fall with speed at a bandwidth, for the tuner's answer where a sliding plant grows.

Where Stribeck's friction falls, :math:`\sigma < 0` is the flattest slope, and a plant that slides has the damping
:math:`b + \sigma`, which may be negative: it then needs its controller to be stable. With a share of the fall it is

.. math:: A_\lambda = A + (1 - \lambda)\, B_f\, \sigma\, C_v,

from Coulomb's friction at 0 to the plant's own at 1. The largest share at which the limits are kept is found by
bisection, each law from the one before: a continuation, whose end is a start for the plant itself.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from seaopt.control.loops.sampled_plant import sample_linear
from seaopt.control.tuning.convex_concave import improve
from seaopt.control.tuning.frequencies import count_growing, place_frequencies
from seaopt.control.tuning.interior_point import refine
from seaopt.control.tuning.optimisation_problem import LawNumbers, PlantWithFriction, Task
from seaopt.control.tuning.solution import solve

RESOLUTION = 1.03  # ratio to which the share is found
SMALLEST_SHARE = 1e-3


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
        eased = {sliding.plant: _ease(sliding, share) for sliding in falling}
        plants = tuple(eased[k].loop.plant if k in eased else plant for k, plant in enumerate(task.plants))
        frictions = tuple(eased.get(sliding.plant, sliding) for sliding in task.frictions)
        return replace(task, plants=plants, frictions=frictions)

    x, loops = solve(ease(0.0))
    if task.list_broken(loops):
        return None
    low, high, f = 0.0, 1.0, place_frequencies(task)
    while high > max(RESOLUTION * low, SMALLEST_SHARE):
        middle = float(np.sqrt(low * high)) if low else 0.25 * high
        eased = ease(middle)
        trial = refine(eased, eased.grid(f), improve(eased, eased.grid(f), x)[1]) if eased.is_stable(x) else x
        if eased.is_stable(trial) and not eased.list_broken(eased.measure(trial)):
            x, low = trial, middle
        else:
            high = middle
    return max(falling, key=lambda sliding: sliding.find_fall()[1]), low, x


def _ease(sliding: PlantWithFriction, share: float) -> PlantWithFriction:
    """Return a sliding plant with a share of the fall of its friction."""
    loop, left = sliding.loop, (1.0 - share) * np.minimum(sliding.flattest, 0.0)
    a = loop.a + (loop.friction * left) @ loop.velocity
    c = loop.sensed + (loop.through * left) @ loop.velocity
    linear = (a[None], loop.motor[None], c[None], loop.plant.sensed[1][None])
    delay_s = np.array([loop.delay_s])
    (plant,) = sample_linear(linear, delay_s, loop.plant.sample_time_s, loop.plant.delay_samples)
    eased = replace(loop, a=a, sensed=c, slopes=loop.slopes + left, plant=plant)
    return replace(sliding, loop=eased, flattest=sliding.flattest - left)
