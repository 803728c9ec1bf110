"""A table: channels as a file holds them, in SI, not yet checked to be a log."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from seaopt.records import record
from seaopt.signals import Signal


@record(eq=False)
class Table:
    """Channels of one clock, as read: time may repeat, run backwards or be missing.

    Parameters
    ----------
    time : array, shape (n,)
        Seconds, as the file has them.
    signals : mapping of name to Signal
        Channels of n samples each, in SI where their unit is known.
    source : str
        The file, or the files.
    notes : tuple of str
        What was done on reading, one sentence each.

    """

    time: Float[np.ndarray, " n"]
    signals: Mapping[str, Signal]
    source: str
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return int(self.time.size)
