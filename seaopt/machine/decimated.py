r"""The replay of a log that has every n-th tick only: line by line, since the law's state between the rows is unknown.

The law is linear while nothing limits it, so that at each line of a periodic reference
:math:`U = (C_r R - C_y Y)\,e^{-j\omega T l}`, with C at the law's own rate, T its sample time, and l the ticks by which
the command is logged late. What readings and command share in noise drops out; what aliases into a line does not, and
is in its disc, which is too wide to say something where the line is weak. Lines above half of the log's rate come back
as others, where the law does not hold.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Complex, Float

from seaopt.control import Controller
from seaopt.machine.response.discs import Ratio
from seaopt.machine.response.periods import Blocks, cut_periods
from seaopt.machine.ticks import Ticks
from seaopt.records import record

MOST = 20  # ticks per row
SAME_RATE = 0.02  # relative: of the log's clock and the law's, or a whole number of its ticks
RISK = 0.01  # that a line of this law is taken for another's
OFF = 0.01  # of the command at a line, that is as good as nothing
WIDEST, FEWEST_LINES = 0.3, 8  # radius of a disc that still says something; how many do
LATE = (0, 1, -1)  # ticks


@record(eq=False)
class LineMatch:
    """The command at the lines over what the law makes of reference and readings: 1, where it is this law."""

    f: Float[np.ndarray, " m"]
    ratio: Complex[np.ndarray, " m"]
    radius: Float[np.ndarray, " m"]
    late: int  # ticks
    size: float  # rms of the command at the lines

    @property
    def sure(self) -> Bool[np.ndarray, " m"]:
        """Which lines say something."""
        return self.radius < WIDEST

    @property
    def off(self) -> Float[np.ndarray, " k"]:
        """How far each of these is from the law's."""
        return np.abs(self.ratio - 1.0)[self.sure]

    @property
    def factor(self) -> float:
        """What the command is times the law's, at the line in the middle of these."""
        return float(np.median(np.real(self.ratio)[self.sure])) if np.any(self.sure) else 1.0

    def is_near(self, factor: float) -> bool:
        """Tell whether the command is a factor times the law's at every line, of which enough say something."""
        allowed = self.radius + OFF * abs(factor)
        enough = np.count_nonzero(self.sure) >= FEWEST_LINES
        return bool(enough and np.all(np.abs(self.ratio - factor) <= allowed))


def count_ticks_per_row(controller: Controller, ticks: Ticks) -> int:
    """Return how many ticks of a law a row of its log takes by its clock; 1 where that is no whole number."""
    ratio = 1.0 / (controller.sample_time_s * ticks.rate_hz)
    whole = round(ratio)
    return whole if 2 <= whole <= MOST and abs(ratio / whole - 1.0) <= SAME_RATE else 1


def match_lines(controller: Controller, ticks: Ticks) -> LineMatch:
    """Return how the law matches a log line by line, with the lateness that suits best. Raises LogError: the reference
    does not repeat, or too few periods are whole.
    """
    blocks = cut_periods(controller, ticks)
    forward, *feedback = controller.law.responses(blocks.f)
    made = forward * blocks.reference + np.sum(np.array(feedback) * blocks.measured, axis=1)
    tried: list[LineMatch] = []
    for late in LATE:
        seen = shift_command(controller, blocks, late)
        ratio = Ratio(numerator=seen.effort, denominator=made)
        centre, radius = ratio.disc(RISK / blocks.f.size)
        size = float(np.sqrt(0.5 * np.mean(np.sum(np.abs(seen.effort) ** 2, axis=1)))) * controller.command.per_effort
        tried.append(LineMatch(f=blocks.f, ratio=centre, radius=radius, late=late, size=size))
    return min(tried, key=lambda match: float(np.sum(np.abs((match.ratio - match.factor) / match.radius) ** 2)))


def shift_command(controller: Controller, blocks: Blocks, late: int) -> Blocks:
    """Return blocks with the command so many ticks of the law earlier."""
    turned = np.exp(2j * np.pi * blocks.f * controller.sample_time_s * late)
    return replace(blocks, effort=blocks.effort * turned)
