"""The frequencies that the tuner looks at: a grid that resolves light modes, and the points of it that matter most."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float

from seaopt.control.laws.spec import LOWEST_HZ
from seaopt.control.loops.loop import GROWING
from seaopt.control.loops.measured.plant import MeasuredPlant
from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.control.tuning.grid import Curve, Grid, Indices, Usage
from seaopt.control.tuning.optimisation_problem import CURVES, OBJECTIVE_HZ, Task

FREQUENCIES = 300
SLOW_FREQUENCIES = 40  # frequencies below 0.1 Hz
MORE_FREQUENCIES = 300  # about lightly damped modes
LIGHT_DAMPING = 0.2  # damping ratio below which a mode is resolved


def find_light_modes(plant: DigitalPlant | MeasuredPlant) -> list[tuple[float, float]]:
    """Return frequency (Hz) and the damping ratio's size of the modes that are lightly damped, or grow slowly. Of a
    measured plant there are none: its own frequencies are looked at instead.
    """
    if isinstance(plant, MeasuredPlant):
        return []
    values = np.linalg.eigvals(plant.a).astype(complex)
    poles = np.log(values[np.imag(values) > 0.0]) / plant.sample_time_s  # a delay's are zero
    modes = [(abs(p) / (2 * np.pi), abs(p.real) / abs(p)) for p in poles]
    return [(float(f), float(max(zeta, 1e-9))) for f, zeta in modes if zeta < LIGHT_DAMPING]


@lru_cache(maxsize=256)
def count_growing(plant: DigitalPlant | MeasuredPlant) -> int:
    """Return how many of a plant's poles grow without control; none of a measured one, whose log is bounded."""
    if isinstance(plant, MeasuredPlant):
        return 0
    return int(np.count_nonzero(np.abs(np.linalg.eigvals(plant.a)) > GROWING))


def place_frequencies(task: Task) -> Curve:
    """Return a logarithmic grid up to the Nyquist frequency, coarse below 0.1 Hz, with f_b and all bands' ends in it.
    About lightly damped plant modes its steps are zeta f / 4, or as small as 80 points a mode and 300 in all allow;
    what falls between is found afterwards.
    """
    spec, nyquist = task.spec, 0.5 / task.spec.sample_time_s
    near: list[Float[np.ndarray, " _"]] = []
    for mode, zeta in {mode for plant in task.plants for mode in find_light_modes(plant)}:
        reach = max(4 * zeta, 0.02) * mode
        near.append(np.linspace(mode - reach, mode + reach, int(min(2 * reach / max(zeta * mode / 4, 1e-4), 80))))
    measured = [plant.f for plant in task.plants if isinstance(plant, MeasuredPlant)]
    extra = [f[:: 1 + f.size // MORE_FREQUENCIES] for f in (np.sort(np.concatenate([np.zeros(0), *near])), *measured)]
    slow = np.geomspace(LOWEST_HZ, OBJECTIVE_HZ, SLOW_FREQUENCIES)[:-1]
    base = np.geomspace(OBJECTIVE_HZ, 0.999 * nyquist, FREQUENCIES)
    ends = [spec.bandwidth_hz, *(spec.passive_band_hz or ())]
    ends += [end for name in CURVES for end in task.band_hz(name)]
    f = np.unique(np.concatenate([slow, base, *extra, ends]))
    return f[(f >= LOWEST_HZ) & (f < nyquist)]


def make_grid(task: Task) -> Grid:
    """Return the responses of a task's plants at the frequencies that the tuner looks at."""
    return task.grid(place_frequencies(task))


def choose_prominent(usage: Usage, count: int) -> Indices:
    """Return flat indices of the `count` points that matter most: local maxima, then the largest of every third."""
    wide = np.full((usage.shape[0], usage.shape[1] + 2), -np.inf)  # `np.pad` would take longer than all the rest
    wide[:, 1:-1] = usage
    top = (usage >= wide[:, :-2]) & (usage >= wide[:, 2:])
    rank = np.where(top, usage + 10.0 * (usage > 0.5), -np.inf)  # a maximum near its limit outranks the others
    rank[:, ::3] = np.maximum(rank[:, ::3], usage[:, ::3])
    flat = rank.ravel()
    count = min(count, int(np.count_nonzero(np.isfinite(flat))))
    return np.argpartition(-flat, count - 1)[:count]
