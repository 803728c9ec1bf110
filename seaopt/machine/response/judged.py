"""A figure of the measured loop with what the log says of it, and the response at one amplitude."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import Complex, Float

from seaopt.machine.response.discs import Ratio
from seaopt.machine.response.periods import LeftOut
from seaopt.records import record

Outcome = Literal["confirmed", "refuted", "undecided"]


@record
class Judged:
    """A figure of the measured loop, and what the log says of its limit."""

    name: str
    limit: float | None  # as judged: with the grace
    sense: Literal["at most", "at least"]
    value: float | None  # estimated
    low: float | None  # the interval, at the confidence that is stated
    high: float | None
    unit: str
    outcome: Outcome
    where_hz: float | None  # the line that decides, or is the nearest to deciding
    periods: int | None  # in all, that would decide where it is undecided
    predicted: float | None = None  # of the design plant
    # Of the machine whose limit and prediction these are, by dry friction: "stuck", or "as played", which is that of
    # the certified machines under the reference that was played.
    state: str = ""
    near: float | None = None  # where those periods last over an hour: the estimate's distance from the limit, relative


@record(eq=False)
class Measured:
    """The response at one amplitude."""

    f: Float[np.ndarray, " m"]
    loop: Ratio  # L
    tracking: Ratio  # Y/R of the regulated output
    outputs: Mapping[str, Ratio]  # per effort: of each signal, and of the plant's outputs that were logged besides
    periods: int
    blocks: int
    phases: int
    amplitude: float
    left_out: LeftOut

    @property
    def distance(self) -> Complex[np.ndarray, " m"]:
        """1 + L."""
        return 1.0 + self.loop.value


@record
class Prediction:
    """What the certified machines do under the reference that was played, where dry friction makes that another thing
    at each amplitude.
    """

    figures: Mapping[str, float]  # of the design plant, by their names
    bandwidth_hz: float  # the least of them and of those that were drawn
