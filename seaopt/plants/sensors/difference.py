r"""Speed by difference: what a device makes of the positions that it samples, as the model has to make it, too.

.. math:: d_k = \frac{\theta_k - \theta_{k-n}}{n T}, \qquad s_k = s_{k-1} + a (d_k - s_{k-1}), \qquad
          a = 1 - e^{-2 \pi f_c T}

with the position :math:`\theta_k` at the sample itself and, where the device filters, a first-order lag of bandwidth
f_c. This is not the speed: it is the mean speed of the last n periods, n T/2 late, and 1.6 % low at a tenth of the
sample rate where n = 1. The model differences its own position. To do so it holds the last n positions, and
:math:`s_{k-1}`, in states that stand still between samples and are set at each (`Sampling`). Which positions came
before the first sample is not in the log, so that these states are unknown where the initial state is, and the first n
differences of each segment then tell nothing but them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import casadi as ca
import numpy as np
from jaxtyping import Complex

from seaopt.errors import PlantError, require_type, suggestion
from seaopt.options import check_options, option
from seaopt.plants.memo import memo
from seaopt.plants.plant import Plant, extend
from seaopt.plants.roles import Sampling
from seaopt.records import record
from seaopt.signals import VectorN


@record
class DifferencedSpeed:
    """A speed that a device computed from a position, sample by sample.

    Raises
    ------
    PlantError
        A number is out of range.

    Examples
    --------
    >>> import numpy as np
    >>> DifferencedSpeed(of="theta_m").read(np.array([0.0, 0.1, 0.3]), 0.01)
    array([ 0., 10., 20.])
    """

    of: str = option("The position that the device differences: a state of the plant, or an output that is one.")
    samples: int = option("Over how many samples of the log it is taken.", default=1, least=1, most=100)
    lag_hz: float | None = option(
        "Corner of the first-order filter behind it; none where left out.", default=None, unit="Hz", above=0.0
    )

    def __post_init__(self) -> None:
        require_type(self.of, str, "of (of a DifferencedSpeed)", "give the name of a position", PlantError)
        check_options(self, PlantError, "DifferencedSpeed: ")

    def share(self, period_s: float) -> float:
        """Return a: how much of the way to each difference the lag goes; 1 without one."""
        return 1.0 if self.lag_hz is None else -math.expm1(-2.0 * math.pi * self.lag_hz * period_s)

    def read(self, position: VectorN, period_s: float) -> VectorN:
        """Return what the device makes of a recorded position, which was at rest before."""
        before = np.concatenate([np.repeat(position[:1], self.samples), position])[: position.size]
        out, share, level = (position - before) / (self.samples * period_s), self.share(period_s), 0.0
        for k, difference in enumerate(out.tolist() if share < 1.0 else ()):
            level += share * (difference - level)
            out[k] = level
        return out

    def respond(self, s: Complex[np.ndarray, " m"], period_s: float) -> Complex[np.ndarray, " m"]:
        """Return the response of the reading to the position."""
        back, share = np.exp(-s * period_s), self.share(period_s)
        return (1.0 - back**self.samples) / (self.samples * period_s) * share / (1.0 - (1.0 - share) * back)


@memo
def add_difference(plant: Plant, name: str, difference: DifferencedSpeed, period_s: float) -> Plant:
    """Return a plant with one more output: the speed that a device which samples with this period computes. Raises
    PlantError: the plant has such an output, or no such position, or samples with another period.
    """
    if name in plant.outputs:
        raise PlantError(f'plant {plant.name} has an output "{name}" of its own; name the difference otherwise')
    sampling = plant.sampling or Sampling()
    if sampling.period_s not in (None, period_s):
        raise PlantError(f"plant {plant.name} samples every {sampling.period_s:g} s, not {period_s:g} s")
    position = find_state(plant, difference.of)
    unit = f"{plant.states[position]}/s"
    memories = [f"{name}_held_{i}" for i in range(1, difference.samples + 1)]
    rate = {position: 1.0 / (difference.samples * period_s), memories[-1]: -1.0 / (difference.samples * period_s)}
    shifts = zip([position, *memories], memories, strict=False)
    sets: dict[str, Mapping[str, float]] = {now: {before: 1.0} for before, now in shifts}
    states, reading, share = dict.fromkeys(memories, plant.states[position]), rate, difference.share(period_s)
    if difference.lag_hz is not None:
        behind = f"{name}_lagged"
        states[behind] = unit
        reading = {behind: 1.0 - share, **{state: share * weight for state, weight in rate.items()}}
        sets[behind] = reading

    made = {**sampling.differences, name: difference}
    return extend(
        plant,
        rates=lambda t, x, u, p: dict.fromkeys(states, 0.0),
        readings=lambda t, x, u, p: {name: sum(weight * getattr(x, state) for state, weight in reading.items())},
        states={**plant.states, **states},
        outputs={**plant.outputs, name: unit},
        sampling=replace(sampling, period_s=period_s, sets={**sampling.sets, **sets}, differences=made),
    )


def read_positions(plant: Plant, differences: Mapping[str, DifferencedSpeed]) -> Plant:
    """Return a plant with differences in which these outputs are the positions themselves."""
    states = {name: find_state(plant, difference.of) for name, difference in differences.items()}
    return extend(plant, readings=lambda t, x, u, p: {name: getattr(x, state) for name, state in states.items()})


def find_state(plant: Plant, position: str) -> str:
    """Return the state that a position is."""
    if position in plant.outputs and position not in plant.states:
        row = plant.output[list(plant.outputs).index(position)]
        for name, symbol in zip(plant.states, ca.vertsplit(plant.x), strict=True):
            if ca.is_equal(row, symbol):
                return name
        raise PlantError(
            f'output "{position}" is no state, so that its difference over samples is not known '
            f"to the model; give one of {', '.join(plant.states)}",
            plant=plant.name,
        )
    if position not in plant.states:
        positions = [*plant.states, *plant.outputs]
        raise PlantError(
            f'plant {plant.name} has no position "{position}" to difference; {suggestion(position, positions)}'
        )
    return position
