"""A figure of the measured loop with what the log says of it, and the response at one amplitude."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import Complex, Float

from seaopt.machine.response.discs import EXACT, Ratio
from seaopt.machine.response.periods import LeftOut
from seaopt.records import record

Outcome = Literal["confirmed", "refuted", "undecided"]


@record
class Doubt:
    """The lines at which a figure is open, and why."""

    lines_hz: tuple[float, ...]
    # disc: it reaches beyond the limit; command: it is too near its own scatter for the gain at the line to be sure,
    # whatever that is
    why: Literal["disc", "command"]


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
    periods: int | None  # in all, that would decide where it is undecided, or tell a margin that has no interval
    predicted: float | None = None  # of the design plant
    # Of the machine whose limit and prediction these are, by dry friction: "stuck", or "as played", which is that of
    # the certified machines under the reference that was played.
    state: str = ""
    near: float | None = (
        None  # the estimate's distance from the limit, relative, where those periods last over ten minutes
    )
    # The worst that certified machines have under the reference that was played, where that breaks the limit and is why
    # the log does not decide; of stability, 0, where their 1 + L turns otherwise than that of a stable model, too; of
    # the bandwidth, where no line lies below.
    certified: float | None = None
    doubt: Doubt | None = None  # where it is undecided for want of periods, or of a larger reference

    @property
    def told(self) -> bool:
        """Whether it has an interval."""
        return self.low is not None or self.high is not None


@record
class Bias:
    """Where the plant from command and readings alone is shown to be off, and by how much."""

    lines: int
    largest: float  # of the plant's size
    where_hz: float  # of the largest
    by_noise: bool  # whether noise that goes round the loop makes all of it


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
    direct: Complex[np.ndarray, " m"]  # the plant from command and readings alone, without the reference
    by_noise: Complex[np.ndarray, " m"]  # what that is where only noise that goes round the loop biases it

    @property
    def plant(self) -> Ratio:
        """Of the regulated output."""
        return next(iter(self.outputs.values()))

    def find_bias(self, alpha: float) -> Bias | None:
        """Return where the direct estimate lies outside of the plant's discs, which `alpha` shares; None where it does
        at no line.
        """
        centre, radius = self.plant.disc(alpha / self.f.size)
        apart = np.abs(self.direct - centre)
        off = np.where(apart > np.maximum(radius, EXACT * np.abs(centre)), np.abs(self.direct / centre - 1.0), 0.0)
        at = int(np.argmax(off))
        if not off[at]:
            return None
        explained = np.abs(self.direct - self.by_noise) <= radius
        return Bias(
            lines=int(np.count_nonzero(off)),
            largest=float(off[at]),
            where_hz=float(self.f[at]),
            by_noise=bool(np.all(explained[off > 0.0])),
        )

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
    peaks: Mapping[str, float]  # the largest of them and of those that were drawn, of what has a limit above
    bandwidth_hz: float  # the least of them and of those that were drawn
    turned: bool  # whether 1 + L of one of these turns otherwise than that of the model, sliding or stuck
