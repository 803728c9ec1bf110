"""What the firmware's own status says of the law, where a log has it: 0 ok, 1 held, 2 a fault."""

from __future__ import annotations

import numpy as np

from seaopt.logs import Log
from seaopt.machine.replay import Replay
from seaopt.records import record
from seaopt.signals import STATUS

HELD, FAULT = 1, 2


@record
class Reported:
    """The status of a law, as its machine logged it."""

    held: int  # rows whose reading was not used
    fault_s: float | None  # of the first fault, from the first row; None without one
    contradicts: bool  # the replay: a trip without a fault, or a law that goes on behind one


def read_status(log: Log, row: Replay) -> Reported | None:
    """Return what the status of a log says, beside its replay; None where it has none that is one of a law."""
    if STATUS not in log.signals or log.signal(STATUS).unit not in ("", "-"):
        return None
    status = log[STATUS]
    if not np.all(np.isin(status, (0, HELD, FAULT))):
        return None
    faults = np.flatnonzero(status == FAULT)
    whole = row.met and row.ticks_per_row == 1 and row.ticks >= len(log) - abs(row.command_late)
    return Reported(
        held=int(np.sum(status == HELD)),
        fault_s=float(log.time[faults[0]] - log.time[0]) if faults.size else None,
        contradicts=(row.trip is not None and not faults.size) or (whole and row.trip is None and faults.size > 0),
    )
