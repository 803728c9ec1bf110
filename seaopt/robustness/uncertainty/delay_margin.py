r"""The smallest extra delay that makes a sampled loop unstable, with the plant sampled with that delay in it.

A delay of :math:`(w + r) T_s`, :math:`0 \le r \le 1`, makes the loop gain :math:`L_r(z) z^{-w}`: the hold's response
changes with r, whole samples only turn the phase. With the crossovers :math:`\theta_j` of :math:`L_r`, where
:math:`|L_r| = 1`, and its phases :math:`0 \le p_j < 2\pi` left there to -1, each of the w samples turns
:math:`\theta_j` towards -1, and

.. math:: U(w, r) = U(0, r) + 2 \sum_j s_j \left(\left\lfloor \frac{w \theta_j - p_j}{2\pi} \right\rfloor + 1\right)
          + w\, [|L_r(-1)| > 1]

closed-loop poles are outside the circle: Nyquist's count, :math:`s_j = 1` where abs(L) falls with the frequency and -1
where it rises. One eigenvalue problem for every r, of the loop without w, is enough for any number of samples.

Between neighbouring r a term can step and another step back: an unstable window narrower than the grid. Every crossover
is therefore followed from r to r, and wherever one of the terms steps the delay at which it does is bisected. Where
crossovers come or go from one r to the next, the grid is halved.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.control import Controller
from seaopt.control.loops.loop import STABLE
from seaopt.control.loops.peaks import crossovers
from seaopt.control.loops.sampled_plant import DELAY
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.units import factor

CELLS = 16  # of a sample
FINEST = 1e-4  # of a sample: narrower, a crossover that comes and goes is not looked for
BISECTIONS = 40
LONGEST = 20_000  # samples: beyond, a delay is no longer one of the loop that was modelled
TURN = 2.0 * np.pi


@record(eq=False)
class _Late:
    """A loop whose plant is late by a part r of a sample, and what decides on every further whole sample.

    Parameters
    ----------
    part : float
        r.
    angles, phases
        Crossovers, ascending, and the phase left to -1.
    outside : int
        Closed-loop poles not inside the circle.
    loud : bool
        abs(L) > 1 at the Nyquist frequency.

    """

    part: float
    angles: Float[np.ndarray, " k"]
    phases: Float[np.ndarray, " k"]
    outside: int
    loud: bool

    @property
    def falling(self) -> Int[np.ndarray, " k"]:
        """1 where abs(L) falls through 1, -1 where it rises."""
        last = self.angles.size - 1 + int(self.loud)
        return 1 - 2 * ((last - np.arange(self.angles.size)) % 2)

    def like(self, other: _Late) -> bool:
        """Tell whether the crossovers are the other's, moved."""
        return self.angles.size == other.angles.size and self.loud == other.loud

    def unstable(self, samples: Int[np.ndarray, " w"]) -> Int[np.ndarray, " w"]:
        """Return how many closed-loop poles are outside with as many further samples."""
        return self.outside + 2 * (self.passes(samples, self.phases) + 1) @ self.falling + samples * self.loud

    def passes(self, samples: Int[np.ndarray, " w"], phases: Float[np.ndarray, " k"]) -> Int[np.ndarray, "w k"]:
        """Return how often each crossover has been through -1."""
        return np.floor((samples[:, None] * self.angles - phases) / TURN).astype(int)

    def followed(self, start: _Late) -> Float[np.ndarray, " k"]:
        """Return the phases as they go on from another's, by less than half a turn."""
        step = self.phases - start.phases
        return start.phases + step - TURN * np.round(step / TURN)


def sampled_delay_margin(controller: Controller, plant: Plant, params: ParameterSet, reach_s: float) -> float | None:
    """Return the smallest extra delay that makes the sampled loop unstable.

    Parameters
    ----------
    controller, plant, params
        A loop that is stable; a delay among `params` stays in it.
    reach_s : float
        How far to look, seconds.

    Returns
    -------
    float or None
        Seconds, zero for an unstable loop; None if no delay up to `reach_s` does.

    Examples
    --------
    >>> import seaopt as so
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6))
    >>> 1e-3 < sampled_delay_margin(controller, stand, thor, 0.02) < 0.02
    True

    """
    period = controller.sample_time_s

    def late(part: float) -> _Late:
        return _late(controller, plant, params, part)

    grid = _followable(late)
    samples = np.arange(int(np.ceil(reach_s / period)) + 1)
    outside = np.array([item.unstable(samples) for item in grid])
    if outside[0, 0]:
        return 0.0
    stepping = np.array([_steps(a, b, samples) for a, b in pairwise(grid)])
    events = (outside[:-1] > 0) | (outside[1:] > 0) | stepping
    for w, cell in zip(*np.nonzero(events.T), strict=True):
        found = _first(late, grid[cell], grid[cell + 1], int(w))
        if found is not None:
            delay = (w + found) * period
            return float(delay) if delay <= reach_s else None
    return None


def _late(controller: Controller, plant: Plant, params: ParameterSet, part: float) -> _Late:
    before = params[DELAY].value * factor(params[DELAY].unit, "s") if DELAY in params else 0.0
    delay = Parameter(name=DELAY, value=before + part * controller.sample_time_s, unit="s")
    system = controller.close(plant, params.with_parameters(delay)).system()
    angles, phases = crossovers(system)
    nyquist = system.curves(np.array([np.pi]))[0, 0]
    return _Late(
        part=part, angles=angles, phases=np.mod(phases, TURN), loud=bool(nyquist.real < 0.5),
        outside=int(np.sum(~(np.abs(system.poles) < STABLE))),
    )  # fmt: skip


def _followable(late: Callable[[float], _Late]) -> list[_Late]:
    """Return loops from no part of a sample to a whole one, between neighbours of which crossovers can be followed."""
    grid = [late(float(part)) for part in np.linspace(0.0, 1.0, CELLS + 1)]
    cell = 0
    while cell < len(grid) - 1:
        first, second = grid[cell], grid[cell + 1]
        if first.like(second) or second.part - first.part < FINEST:
            cell += 1
        else:
            grid.insert(cell + 1, late(0.5 * (first.part + second.part)))
    return grid


def _steps(first: _Late, second: _Late, samples: Int[np.ndarray, " w"]) -> Bool[np.ndarray, " w"]:
    """Tell with how many whole samples a crossover passes -1 between two neighbours."""
    if not first.like(second):
        return np.zeros(samples.size, dtype=bool)
    return np.any(first.passes(samples, first.phases) != second.passes(samples, second.followed(first)), axis=1)


def _first(late: Callable[[float], _Late], low: _Late, high: _Late, w: int) -> float | None:
    """Return where between two neighbours the loop with w further samples ceases to be stable; None if it does not."""
    samples = np.array([w])
    if low.unstable(samples)[0]:
        return low.part

    def bisected(beyond: Callable[[_Late], bool]) -> float:
        start, end = low.part, high.part
        for _ in range(BISECTIONS):
            middle = 0.5 * (start + end)
            start, end = (start, middle) if beyond(late(middle)) else (middle, end)
        return end

    ends = [high.part]
    if low.like(high):
        before, after = low.passes(samples, low.phases)[0], high.passes(samples, high.followed(low))[0]
        ends = [
            bisected(lambda at, j=j: at.like(low) and at.passes(samples, at.followed(low))[0, j] != before[j])
            for j in np.flatnonzero(before != after)
        ]
        ends = [*sorted(ends), high.part]
    for end, following in pairwise(ends):
        if late(0.5 * (end + following)).unstable(samples)[0]:
            return end
    return bisected(lambda at: bool(at.unstable(samples)[0])) if high.unstable(samples)[0] else None
