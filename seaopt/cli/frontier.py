"""The sweep of bandwidths: what is asked on the command line, and the table that answers."""

from __future__ import annotations

import math

from seaopt.cli.terminal import Terminal
from seaopt.control import Frontier
from seaopt.control.laws.verdict import shorten_blocked
from seaopt.errors import ControlError
from seaopt.formatting import format_number, join_words

MAX_BANDWIDTHS = 200
HEAD = ("Hz", "met", "noise", "Ms", "worst on", "|S| Hz", "phase °")
FRONTIER_NOTE = (
    "noise: peak of |F_m/noise on the {word}|, {gain}; Ms: of the worst plant; |S| Hz: below -3 dB up to here; limit: "
    "largest reference at that frequency before the command saturates"
)
FRICTION_NOTE = "; friction: by how much it raises the integral of |S|"
FREE_NOTE = (
    "; free law: the least {objective} that any linear law could have on the design plant alone, and by how much the "
    "tuned one is above"
)
OBJECTIVES = {"disturbance": "integral of |S| over ln f from 0.1 Hz to the bandwidth", "noise": "noise"}


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


def print_frontier(frontier: Frontier, console: Terminal) -> None:
    """Print a row per bandwidth, what blocks those that are not met, and what the columns mean."""
    called, sticks = frontier.mechanics, any(row.without_sticking for row in frontier.rows)
    free = next((row.free_law for row in frontier.rows if row.free_law), None)
    rows = [
        (
            f"{row.bandwidth_hz:g}", "yes" if row.feasible else "no", format_number(row.noise_gain, 3),
            format_number(row.ms), row.ms_plant, format_number(row.sensitivity_bandwidth_hz, 3),
            format_number(row.phase_margin_deg, 3), format_number(row.force_limit_N),
            *([row.describe_friction_cost()] if sticks else []),
            *([row.describe_structure_cost()] if free else []),
        )
        for row in frontier.rows
    ]  # fmt: skip
    head = (*HEAD, f"limit {called.unit}", *(["friction"] if sticks else []), *(["free law"] if free else []))
    console.tabulate(rows, head, "><>><>>>>>"[: len(head)])
    blocked: dict[str, list[str]] = {}
    for row in frontier.rows:
        if row.blocked_by:
            blocked.setdefault(shorten_blocked(row.blocked_by), []).append(f"{row.bandwidth_hz:g}")
    for text, at in blocked.items():
        console.wrap(f"not met at {join_words(at)} Hz: {text}", indent=2)
    note = FRONTIER_NOTE.format(word=called.word, gain=called.gain)
    note += FRICTION_NOTE if sticks else ""
    note += FREE_NOTE.format(objective=OBJECTIVES[free.objective]) if free else ""
    console.wrap(note, indent=2, style="dim")
