"""The sweep of bandwidths: what is asked on the command line, and the table that answers."""

from __future__ import annotations

import math

from rich.console import Console
from rich.table import Table

from seaopt.control import Frontier
from seaopt.errors import ControlError

MOST = 200
HEAD = ("Hz", "met", "noise", "Ms", "worst", "disturb.", "|S|<-3dB", "phase", "force")
NOTE = (
    "noise: peak of |F_m/noise on the force|, N/N; Ms: of the worst plant; disturb.: integral of |S| over ln f from "
    "0.1 Hz to the bandwidth, worst plant; |S|<-3dB: up to here; phase: margin; force: largest reference at that "
    "frequency before the current saturates"
)


def bandwidths(text: str) -> tuple[float, ...]:
    """Return the bandwidths of LOW:HIGH:STEP, both ends included.

    Raises
    ------
    ControlError
        It is not three numbers, or not an ascending range of a reasonable length.

    Examples
    --------
    >>> bandwidths("15:25:5")
    (15.0, 20.0, 25.0)

    """
    try:
        low, high, step = (float(item) for item in text.split(":"))
    except ValueError as error:
        raise ControlError(f'--sweep {text}: is not LOW:HIGH:STEP; give three numbers such as "15:60:5"') from error
    if not (0.0 < low <= high < math.inf and 0.0 < step < math.inf):
        raise ControlError(f"--sweep {text}: is not ascending; give 0 < LOW <= HIGH and a positive STEP")
    count = math.floor((high - low) / step * (1 + 1e-12) + 1e-9) + 1
    if count > MOST:
        raise ControlError(f"--sweep {text}: asks for {count} bandwidths; give a larger STEP, for {MOST} at most")
    return tuple(low + k * step for k in range(count))


def show_frontier(frontier: Frontier, console: Console) -> None:
    """Print a row a bandwidth, and below what blocks the rows that are not met."""
    table = Table(box=None, pad_edge=False, collapse_padding=True, header_style="dim")
    for title in HEAD:
        table.add_column(title, justify="left" if title in ("met", "worst") else "right", no_wrap=True)
    for row in frontier.rows:
        phase = "–" if row.phase_margin_deg is None else f"{row.phase_margin_deg:.1f}°"
        force = "–" if row.force_limit_N is None else f"{row.force_limit_N:.4g} N"
        table.add_row(
            f"{row.bandwidth_hz:g}", "[green]yes[/]" if row.feasible else "[red]no[/]", f"{row.noise_gain:.4g}",
            f"{row.ms:.4g}", row.ms_plant, f"{row.disturbance:.4g}", f"{row.sensitivity_bandwidth_hz:.3g} Hz", phase,
            force,
        )  # fmt: skip
    console.print(table)
    console.print(NOTE, style="dim", highlight=False, markup=False)
    for row in frontier.rows:
        if not row.feasible:
            blocked = " and ".join(row.blocked_by)
            console.print(f"{row.bandwidth_hz:g} Hz is blocked by {blocked}", highlight=False, markup=False)
