r"""A gate in front of a running law: readings that cannot be true are bridged, a sensor that stays wrong is a fault.

A reading is plausible if it is a number within its range and no further from the last plausible one than the plant
moves in the time since: with h readings refused in between, `max_step_N` (h + 1), so that a force that really has
moved is believed again as soon as it can have got there. The first reading is judged by its jump from the measurement
that the law was reset with; where none was given, as in predictive control, it is judged by its range alone. Up to
`max_held` readings in a row that are not plausible are replaced by the last that was. One more is a fault: from then on
the law stands still, the command goes to zero at `ramp_A_per_s`, and stays there until the law is reset, for a sensor
that comes back is not one to trust.

The most that a sampled plant can move between two samples while the effort stays within :math:`\pm F` is

.. math:: F \sum_k |h_{k+1} - h_k| , \qquad h \text{ its response to an effort of one at one sample,}

reached by an effort that has the signs of these terms. A link that the world pushes moves further: `of_controller`
takes a factor for that.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.errors import ControlError, require_number
from seaopt.options import check_options, option
from seaopt.records import record

SETTLED = 1e-12  # of the largest term: a response below it is over
MOST_TERMS = 200_000
LARGEST, MOST_HELD = 1e15, 1_000_000  # what float and unsigned long of every target hold, and what follows from it


def is_number(value: float) -> bool:
    """Tell whether a running law takes a number: finite, and so small that no later command overflows."""
    return bool(-LARGEST <= value <= LARGEST)


@record
class GateState:
    """The last plausible reading (NaN: none yet), how many in a row were not, and whether that became a fault.

    A measurement that is known before the first reading is one that the first must be near.
    """

    measurement: float = math.nan
    held: int = 0
    fault: bool = False

    @property
    def status(self) -> str:
        """Tell "ok", "held" or "fault"."""
        return "fault" if self.fault else "held" if self.held else "ok"


@record(keywords=True)
class GateSpec:
    """The options of a gate: which readings a running law is to believe, and what it does about the others.

    Raises ControlError: a value is out of range.
    """

    range_N: tuple[float, float] = option(
        "Range of the sensor, in units of what is measured; readings outside are not believed."
    )
    max_step_N: float | None = option(
        "Largest change of a reading in a sample; where left out, that of the design plant times margin.",
        default=None,
        above=0.0,
    )
    max_held: int = option(
        "Readings in a row that are bridged; one more is a fault, and the command goes to zero.",
        default=5,
        least=0,
        most=MOST_HELD,
    )
    ramp_s: float = option(
        "Time in which the command goes from its limit to zero at a fault.", default=0.1, unit="s", above=0.0
    )
    margin: float = option(
        "Factor on the design plant's largest step, for what the world does to it.", default=3.0, above=0.0
    )

    def __post_init__(self) -> None:
        check_options(self, ControlError)


@record
class PlausibilityGate:
    """Which readings a running law believes, and what it does about the others.

    Parameters
    ----------
    range_N : (low, high)
        Of the sensor, in units of the measured effort.
    max_step_N : float
        Largest change from one sample to the next.
    max_held : int
        Readings in a row that are bridged.
    ramp_A_per_s : float
        How fast the command goes to zero at a fault.

    Raises
    ------
    ControlError
        A value is out of range.

    Examples
    --------
    >>> gate = PlausibilityGate(range_N=(-2000, 2000), max_step_N=100, max_held=2, ramp_A_per_s=50)
    >>> state = GateState(measurement=10.0)
    >>> for reading in (20.0, 1e4, float("nan"), float("nan")):
    ...     used, state = gate.screen(state, reading)
    ...     print(used, state.status)
    20.0 ok
    20.0 held
    20.0 held
    20.0 fault
    """

    range_N: tuple[float, float]
    max_step_N: float
    max_held: int
    ramp_A_per_s: float

    def __post_init__(self) -> None:
        ends: Any = self.range_N
        if not isinstance(ends, tuple | list) or len(ends) != 2:
            raise ControlError(f"range_N = {ends!r} is not a range; give (low, high)")
        low, high = (require_number(end, "range_N", ControlError) for end in ends)
        if not -LARGEST < low < high < LARGEST:
            raise ControlError(f"range_N = ({low:g}, {high:g}) is not a range; give finite low < high")
        for name in ("max_step_N", "ramp_A_per_s"):
            value = require_number(getattr(self, name), name, ControlError)
            if not 1.0 / LARGEST < value < LARGEST:  # which a target's `float` holds, too
                raise ControlError(
                    f"{name} = {value:g} is not between {1.0 / LARGEST:g} and {LARGEST:g}; give such a number"
                )
        held: Any = self.max_held
        if isinstance(held, bool) or not isinstance(held, int | np.integer) or not 0 <= held <= MOST_HELD:
            raise ControlError(f"max_held = {held!r} is not a number of samples; give 0, 1, ... up to {MOST_HELD}")

    def start(self, measurement: float) -> GateState:
        """Return the state in which the first reading must be near a measurement at rest. Raises ControlError: it is
        not within the range itself.
        """
        low, high = self.range_N
        if not low <= measurement <= high:
            raise ControlError(
                f"measurement = {measurement:g} is not within range_N = ({low:g}, {high:g}); give the force at rest"
            )
        return GateState(measurement=measurement)

    def screen(self, state: GateState, measurement: float) -> tuple[float, GateState]:
        """Return the reading to use, and the next state; NaN where there was none yet."""
        if state.fault:
            return state.measurement, state
        low, high = self.range_N
        moved = abs(measurement - state.measurement) if math.isfinite(state.measurement) else 0.0
        if low <= measurement <= high and moved <= self.max_step_N * (state.held + 1):
            return measurement, GateState(measurement=measurement)
        held = state.held + 1
        return state.measurement, GateState(measurement=state.measurement, held=held, fault=held > self.max_held)

    def ramp(self, current_A: float, sample_time_s: float) -> float:
        """Return the command a sample later, at a fault."""
        step = self.ramp_A_per_s * sample_time_s
        return math.copysign(max(abs(current_A) - step, 0.0), current_A)

    @classmethod
    def of_controller(cls, controller: Any, **asked: Any) -> PlausibilityGate:
        """Return a gate with the step that the design plant makes at most, times a margin for what the world does.

        Parameters
        ----------
        controller : Controller or ForceMPC
            With its design plant and a current limit.
        **asked
            Fields of `GateSpec`: range_N, and where they differ from its defaults max_step_N, max_held, ramp_s, margin.

        Raises
        ------
        ControlError
            The controller has no current limit or no design plant, or the plant does not come to rest by itself.

        Examples
        --------
        >>> import seaopt as so
        >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)
        >>> controller = so.tune(so.plants.high_impedance(), so.plants.thor(), spec)
        >>> gate = PlausibilityGate.of_controller(controller, range_N=(-4000.0, 4000.0))
        >>> print(f"{gate.max_step_N:.0f} N, {gate.ramp_A_per_s:.0f} A/s")
        473 N, 90 A/s
        """
        if not hasattr(controller, "command_limit"):
            raise ControlError(f"controller = {controller!r:.80}: give a Controller, or a ForceMPC")
        spec, limit = GateSpec(**asked), controller.command_limit
        if limit is None:
            raise ControlError("the controller has no current limit (or command_limit); give its specification one")
        largest = spec.max_step_N
        if largest is None:
            if controller.design is None:
                raise ControlError("the controller has no design plant to compute the largest step of; give max_step_N")
            plant = controller.close(*controller.design).plant
            largest = spec.margin * largest_step(plant, limit / controller.per_effort)
        return cls(range_N=spec.range_N, max_step_N=largest, max_held=spec.max_held, ramp_A_per_s=limit / spec.ramp_s)

    def describe(self, unit: str) -> str:
        """Return in one line which readings are believed."""
        low, high = self.range_N
        return (
            f"Readings from {low:g} to {high:g} {unit} that move by up to {self.max_step_N:.4g} {unit} a sample are "
            f"believed, {self.max_held} others in a row are bridged"
        )


def largest_step(plant: DigitalPlant, effort_limit: float) -> float:
    """Return how far an output moves at most in a sample, the effort limited. Raises ControlError: it never rests."""
    if np.max(np.abs(np.linalg.eigvals(plant.a)), initial=0.0) >= 1.0:
        raise ControlError("the plant does not come to rest by itself, so that no step is the largest; give max_step_N")
    x, row, before = plant.b, plant.c[0], float(plant.d[0])
    total = largest = abs(before)
    for _ in range(MOST_TERMS):
        now = float(row @ x)
        total += abs(now - before)
        largest, before, x = max(largest, abs(now)), now, plant.a @ x
        if np.linalg.norm(row) * np.linalg.norm(x) <= SETTLED * largest:
            break
    return effort_limit * (total + abs(before))
