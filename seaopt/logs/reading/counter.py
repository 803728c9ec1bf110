"""A column that counts samples shows which ones were lost, although the recorder's clock runs on without a gap.

Each count stands for a fixed number of samples. A count that was held shorter, or skipped, tells how many samples are
missing; the recorder's time column does not, because it counts rows. The first and the last count may be cut.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from seaopt.errors import LogError
from seaopt.formatting import format_count
from seaopt.options import option
from seaopt.records import record

LARGEST = 2**53  # below which a float is every whole number
MOST_PER_COUNT = 1_000_000
PROBE_SAMPLES = 1000  # samples that must look like a counter before all are looked at


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
            shown = self.samples_per_count if abs(self.samples_per_count) < LARGEST else "a number of many digits"
            raise LogError(f"Counter: samples_per_count = {shown}; give a whole number from 1 to {MOST_PER_COUNT}")

    def open_gaps(
        self, time: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"], place: str
    ) -> tuple[Float[np.ndarray, " n"], str]:
        """Return time with the later samples moved by the lost ones, and a note of what was done.

        Raises
        ------
        LogError
            The column is not a counter: not whole, or falling.

        """
        if not _is_whole(values) or np.any(np.diff(values) < 0):
            raise LogError(
                f'{place}: counter "{self.column}" is not a whole number that only rises; choose another column'
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

    @staticmethod
    def suspect(values: Float[np.ndarray, " n"]) -> int:
        """Return how many samples a column seems to miss, if it looks like a counter; 0 otherwise."""
        for part in (values[:PROBE_SAMPLES], values):
            if part.size < 10 or not _is_whole(part) or np.any(np.diff(part) < 0):
                return 0
        runs = np.diff(np.flatnonzero(np.diff(values)))
        if runs.size < 5:
            return 0
        usual = int(np.bincount(runs).argmax())
        jumps = np.diff(values)[np.diff(values) > 0]
        if np.mean(runs == usual) < 0.8 or np.mean(jumps == 1) < 0.8:
            return 0
        return int(_count_losses(values, usual)[1].sum())


def _is_whole(values: Float[np.ndarray, " n"]) -> bool:
    """Tell whether values are whole numbers that differences are exact of."""
    return bool(np.all((np.abs(values) < LARGEST) & (values == np.floor(values))))


def _count_losses(values: Float[np.ndarray, " n"], each: int) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Return where each count but the first begins, and how many samples are missing before it."""
    starts = np.flatnonzero(np.diff(values)) + 1
    skipped = (np.diff(values)[starts - 1] - 1.0) * each  # of integers the product could overflow
    # A count that was held for fewer samples than usual lost the others.
    lengths = np.diff(np.concatenate([[0], starts]))
    missing = np.maximum(each - lengths, 0)
    missing[:1] = 0  # the recording may begin within a count
    return starts, skipped + missing
