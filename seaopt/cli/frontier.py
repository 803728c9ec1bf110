"""The sweep of bandwidths: what is asked on the command line, and the table that answers."""

from __future__ import annotations

import math

from rich.console import Console

from seaopt.control import Frontier
from seaopt.errors import ControlError

MAX_BANDWIDTHS = 200
FRONTIER_NOTE = (
    "noise gain: peak of |F_m/noise on the {word}|, {gain}; Ms: of the worst plant; disturbance: integral of |S| "
    "over ln f from 0.1 Hz to the bandwidth, worst plant; |S| < -3 dB: up to here; {word} limit: largest reference "
    "at that frequency before the command saturates"
)


def parse_bandwidths(text: str) -> tuple[float, ...]:
    """Return the bandwidths of LOW:HIGH:STEP, both ends included.

    Raises
    ------
    ControlError
        It is not three numbers, or not an ascending range of a reasonable length.

    Examples
    --------
    >>> parse_bandwidths("15:25:5")
    (15.0, 20.0, 25.0)

    """
    try:
        low, high, step = (float(number) for number in text.split(":"))
    except ValueError as error:
        raise ControlError(f'--sweep {text}: is not LOW:HIGH:STEP; give three numbers such as "15:60:5"') from error
    if not (0.0 < low <= high < math.inf and 0.0 < step < math.inf):
        raise ControlError(f"--sweep {text}: is not ascending; give 0 < LOW <= HIGH and a positive STEP")
    steps = (high - low) / step * (1 + 1e-12) + 1e-9
    count = math.floor(min(steps, 2.0 * MAX_BANDWIDTHS)) + 1
    if count > MAX_BANDWIDTHS:
        raise ControlError(
            f"--sweep {text}: asks for {steps + 1:.10g} bandwidths; give a larger STEP, for {MAX_BANDWIDTHS} at most"
        )
    return tuple(low + k * step for k in range(count))


def print_frontier(frontier: Frontier, console: Console) -> None:
    """Print a row per bandwidth, and what its columns mean."""
    console.print(repr(frontier), highlight=False, markup=False)
    called = frontier.mechanics
    console.print(FRONTIER_NOTE.format(word=called.word, gain=called.gain), style="dim", highlight=False, markup=False)
