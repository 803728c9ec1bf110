"""A column that counts samples shows which ones were lost, although the recorder's clock runs on without a gap.

Each count stands for a fixed number of samples. A count that was held shorter, or skipped, tells how many samples are
missing; the recorder's time column does not, because it counts rows. The first and the last count may be cut.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from seaopt.errors import LogError
from seaopt.formatting import format_count
from seaopt.logs.quality.faults import LARGEST_COUNT
from seaopt.options import option
from seaopt.records import record
from seaopt.signals import VectorM, VectorN

MOST_PER_COUNT = 1_000_000


@record
class Counter:
    """A declared sample counter.

    Examples
    --------
    >>> import numpy as np
    >>> time, note = Counter(column="n").open_gaps(np.array([0.0, 1.0, 2.0]), np.array([7.0, 8.0, 10.0]), "log.csv")
    >>> time.tolist()
    [0.0, 1.0, 3.0]
    """

    column: str = option("A whole number that rises by one every `samples_per_count` samples.")
    samples_per_count: int = option("Samples for one count.", default=1, least=1)

    def __post_init__(self) -> None:
        if not 1 <= self.samples_per_count <= MOST_PER_COUNT:
            shown = self.samples_per_count if abs(self.samples_per_count) < LARGEST_COUNT else "a number of many digits"
            raise LogError(f"Counter: samples_per_count = {shown}; give a whole number from 1 to {MOST_PER_COUNT}")

    def open_gaps(self, time: VectorN, values: VectorN, source: str) -> tuple[VectorN, str]:
        """Return time with the later samples moved by the lost ones, and a note of what was done. Raises LogError: the
        column is not a counter: not whole, or falling.
        """
        whole = np.all((np.abs(values) < LARGEST_COUNT) & (values == np.floor(values)))
        if not whole or np.any(np.diff(values) < 0):
            raise LogError(
                f'{source}: counter "{self.column}" is not a whole number that only rises; choose another column'
            )
        starts, lost = _count_losses(values, self.samples_per_count)
        total = int(lost.sum())
        if not total:
            return time, f'counter "{self.column}" shows no lost sample'
        shift = np.zeros(time.size)
        shift[starts] = lost
        first = float(time[starts[np.flatnonzero(lost)[0]]])
        moved = time + np.cumsum(shift) * float(np.median(np.diff(time)))
        lost_samples = format_count(total, "lost sample")
        return moved, (
            f'counter "{self.column}" shows {lost_samples}, the first before t = {first:.6g} s; later '
            "times were moved to open gaps"
        )


def _count_losses(values: VectorN, each: int) -> tuple[Int[np.ndarray, " m"], VectorM]:
    """Return where each count but the first begins, and how many samples are missing before it."""
    starts = np.flatnonzero(np.diff(values)) + 1
    skipped = (np.diff(values)[starts - 1] - 1.0) * each  # of integers the product could overflow
    # A count that was held for fewer samples than usual lost the others.
    lengths = np.diff(np.concatenate([[0], starts]))
    missing = np.maximum(each - lengths, 0)
    missing[:1] = 0  # the recording may begin within a count
    return starts, skipped + missing
