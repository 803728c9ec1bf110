"""Faults of one channel, found from its samples alone; rows are counted from 0.

Each detector judges a channel against its own activity: a run of equal samples is normal for an encoder at rest, and a
fault of a load cell whose noise makes every sample differ from the last.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np
from jaxtyping import Bool, Int

from seaopt.records import record
from seaopt.signals import RowsK, VectorK, VectorN

LEVEL_SAMPLES = 50_000  # samples that are enough to see a quantisation step
STILLNESS_WINDOW = 64  # samples over which a channel's stillness is averaged
FEW_LEVELS = 8  # a channel of so few values is switched, not clipped
PILE = 6.0  # times more samples at a rail than at each of the levels below it
OUTLYING = 6.0  # robust standard deviations (Hampel)
FEW_WINDOWS = 5_000  # that are enough to see what distances are usual
STICKS_OUT = 0.8  # of its distance: how far an outlier lies beyond the second of its neighbours
NEIGHBOURS = 5  # samples each side of an outlier that it is compared with
HOLDS = 0.4  # share of still samples from which a channel may be one that is held
REGULAR = 0.8  # share of a counter's, or a held channel's, steps that must be alike
LARGEST_COUNT = 2.0**53  # below which a float is every whole number
FEW_APART = 2_000  # distances that are enough to see that half of them are no multiples of a step
FEWEST_SAMPLES = 16  # samples below which nothing is judged
WHOLE = 0.02  # of a step, by which one that is stated may differ from what a channel shows


@record(eq=False)
class RowRanges:
    """Rows from `start` up to, and not including, `stop`, one pair per run."""

    start: RowsK = field(default_factory=lambda: np.zeros(0, dtype=int))
    stop: RowsK = field(default_factory=lambda: np.zeros(0, dtype=int))

    def __len__(self) -> int:
        return int(self.start.size)

    @property
    def lengths(self) -> RowsK:
        """Samples in each run."""
        return self.stop - self.start

    @property
    def samples(self) -> int:
        """Samples in all runs."""
        return int(np.sum(self.lengths))

    def where(self, chosen: Bool[np.ndarray, " k"]) -> RowRanges:
        """Return the chosen runs."""
        return RowRanges(start=self.start[chosen], stop=self.stop[chosen])


@record(eq=False)
class Rail:
    """Samples piled up at an extreme value; `clear`: three or more visits, where samples otherwise differ."""

    json_keys = ("side", "value", "samples", "clear", "runs")

    side: str
    value: float
    runs: RowRanges
    clear: bool

    @property
    def samples(self) -> int:
        """Samples in all runs."""
        return self.runs.samples


@record(eq=False)
class CounterLosses:
    """A channel that counts: `samples_per_count` alike as a rule, `lost` samples skipped ahead of each of `rows`."""

    samples_per_count: int
    rows: RowsK
    lost: RowsK


def find_runs(mask: Bool[np.ndarray, " n"]) -> RowRanges:
    """Return the runs of True."""
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False))
    return RowRanges(start=edges[::2], stop=edges[1::2])


def find_repeats(values: VectorN) -> RowRanges:
    """Return the runs of two or more equal samples."""
    runs = find_runs(values[1:] == values[:-1])
    return RowRanges(start=runs.start, stop=runs.stop + 1)


def measure_stillness(values: VectorN) -> float:
    """Return the share of samples equal to the last, in the median window of 64: what is usual for the channel."""
    same = values[1:] == values[:-1]
    windows = same.size // STILLNESS_WINDOW
    if not windows:
        return float(np.mean(same))
    return float(np.median(np.mean(same[: windows * STILLNESS_WINDOW].reshape(windows, STILLNESS_WINDOW), axis=1)))


def find_quantisation(values: VectorN) -> float:
    """Return the step whose multiples the samples are; 0 where there is none."""
    apart = _measure_levels(values)
    if not apart.size or values.size < FEWEST_SAMPLES:
        return 0.0
    least = float(np.min(apart))
    # The least difference may be several steps where a level next to another never occurs.
    some = apart[:: max(1, apart.size // FEW_APART)]  # of a channel without a step they tell so
    for parts in (1, 2, 3, 4, 5):
        step = least / parts
        if _count_near(some, _refine(some, step)) < 0.5:
            continue
        step = _refine(apart, step)
        if _count_near(apart, step) > 0.98:
            return step
    return 0.0


def has_step(values: VectorN, step: float) -> bool:
    """Tell whether samples are multiples of a step as far as they tell: those of one level do."""
    apart = _measure_levels(values)
    if not apart.size:
        return True
    if not np.any(np.round(apart / step)):
        return False
    refined = _refine(apart, step)
    return bool(_count_near(apart, refined) > 0.98 and abs(refined / step - 1.0) < WHOLE)


def _measure_levels(values: VectorN) -> VectorK:
    """Return how far the levels that samples take are apart; nothing where there are too few, or none is finite."""
    stride = max(1, values.size // LEVEL_SAMPLES)
    kinds = np.sort(values[::stride][np.isfinite(values[::stride])])
    apart = np.diff(kinds)
    if np.count_nonzero(apart) < 2:
        return apart[:0]
    apart = apart[apart > 1e-9 * float(kinds[-1] - kinds[0])]
    return apart if np.isfinite(apart).all() else apart[:0]  # numbers near the largest float have no differences


def _refine(apart: VectorK, step: float) -> float:
    """Return the step of which distances are multiples, in the mean."""
    counts = np.round(apart / step)
    return float(np.sum(apart * counts) / np.sum(counts**2))


def _count_near(apart: VectorK, step: float) -> float:
    """Return the share of distances that are nearly multiples of a step."""
    return float(np.mean(np.abs(apart / step - np.round(apart / step)) < 0.05))


def find_outliers(values: VectorN, quantum: float) -> RowsK:
    """Return the rows of samples that stand out from their neighbours (Hampel's test). A sample stands out that lies
    beyond six robust standard deviations from the median of the five samples on each side: both of those ten, and of
    what is usual for such distances over the whole channel. One of the ten may be an outlier too. Pearson et al.,
    Generalized Hampel filters, EURASIP J. Adv. Signal Process. 2016:87.
    """
    if values.size < FEWEST_SAMPLES:
        return np.zeros(0, dtype=int)
    some = np.arange(0, values.size, max(1, values.size // FEW_WINDOWS))
    usual = _distances(values, some)[1]
    floor = max(OUTLYING * 1.4826 * float(np.median(usual)), 2.0 * quantum) if usual.size else np.inf
    # A cheap test first: nearly every sample lies near the line between its neighbours.
    bend = np.abs(values[1:-1] - 0.5 * (values[2:] + values[:-2]))
    bent = bend > 0.25 * floor  # an outlier is, by its height, and its neighbours by half of that
    near = np.zeros(values.size, dtype=bool)
    near[1:-1] = bent
    near[:-2] |= bent
    near[2:] |= bent
    rows = np.flatnonzero(near)
    standing_out: list[Int[np.ndarray, " _"]] = []
    for part in np.array_split(rows, max(1, -(-rows.size // LEVEL_SAMPLES))):  # in the memory of a part
        kept, off, spread, beyond = _distances(values, part)
        standing_out.append(kept[(off > np.maximum(OUTLYING * spread, floor)) & (beyond > STICKS_OUT * off)])
    return np.concatenate(standing_out)


def _distances(values: VectorN, rows: Int[np.ndarray, " m"]) -> tuple[RowsK, VectorK, VectorK, VectorK]:
    """Return rows whose window is whole, their distance from its median, its spread, and how far they stick out."""
    offsets = np.concatenate([np.arange(-NEIGHBOURS, 0), np.arange(1, NEIGHBOURS + 1)])
    rows = rows[(rows >= NEIGHBOURS) & (rows < values.size - NEIGHBOURS)]
    window = values[rows[:, None] + offsets]
    whole = np.all(np.isfinite(window), axis=1) & np.isfinite(values[rows])
    window, at = np.sort(window[whole], axis=1), values[rows[whole]]
    middle = 0.5 * (window[:, NEIGHBOURS - 1] + window[:, NEIGHBOURS])
    spread = 1.4826 * np.median(np.abs(window - middle[:, None]), axis=1)
    # A peak of a fast signal is far from the median, but not from the second of its neighbours.
    beyond = np.maximum(at - window[:, -2], window[:, 1] - at)
    return rows[whole], np.abs(at - middle), spread, beyond


def find_rails(values: VectorN, quantum: float, still: float) -> list[Rail]:
    """Return the flat tops and bottoms: equal samples piled up at the largest or the least value."""
    repeated = count_repeats(values) if still >= HOLDS else 1
    stride = max(1, values.size // LEVEL_SAMPLES)
    finite = values[::stride][np.isfinite(values[::stride])]
    if values.size < FEWEST_SAMPLES or np.unique(finite).size <= FEW_LEVELS:
        return []
    flat_edges: list[Rail] = []
    low, high = float(np.fmin.reduce(values)), float(np.fmax.reduce(values))
    # Samples at the edge are compared with those on the four levels below it, where a smooth signal has as many.
    level = quantum if quantum else 1e-3 * (high - low)
    alike = max(0.01 * quantum, 1e-12 * (high - low))
    for side, edge in (("low", low), ("high", high)):
        at = values >= high - alike if side == "high" else values <= low + alike
        near = values >= high - 4.5 * level if side == "high" else values <= low + 4.5 * level
        count = int(np.count_nonzero(at))
        below = (np.count_nonzero(near) - count) / 4.0
        runs = find_runs(at)
        # A run at either end may be rest, and single samples the peaks of a periodic signal.
        flat = runs.where((runs.start > 0) & (runs.stop < values.size) & (runs.lengths > repeated))
        if count >= 3 * repeated and count >= PILE * max(below, 0.5) and len(flat):
            clear = len(flat) >= 3 and (still < 0.5 or repeated > 1)
            flat_edges.append(Rail(side=side, value=edge, runs=runs, clear=clear))
    return flat_edges


def find_stuck(values: VectorN, quantum: float, still: float) -> RowRanges:
    """Return the runs of equal samples that the channel's usual stillness does not explain. With a share p of still
    steps, L equal samples in a row have a probability of about n p^(L-1): the limit is where that is 1e-3. A channel
    that is quantised more coarsely than its noise also rests at its extremes, and leaves them by one quantisation step;
    a run that ends in a larger jump, or with the log and twice as long as any rest, is none.
    """
    n = values.size
    if n < FEWEST_SAMPLES or still > 0.98:
        return RowRanges()
    shortest = 1.0 + np.log(1e3 * n) / -np.log(max(still, 0.1))
    runs = find_repeats(values)
    ends = runs.stop == n
    last = np.minimum(runs.stop, n - 1)
    rests = ~ends & (np.abs(values[last] - values[last - 1]) <= 1.5 * quantum)
    coarse = still >= 0.2 or bool(np.count_nonzero(rests) > 0.5 * len(runs))
    long = runs.lengths > shortest
    if not coarse:
        return runs.where(long)
    longest = int(np.max(runs.lengths[rests], initial=0))
    return runs.where(long & ~rests & (~ends | (runs.lengths > 2 * longest)))


def count_repeats(values: VectorN) -> int:
    """Return how many samples each value is repeated, regularly; 1 where it is not."""
    changes = 1 + np.flatnonzero(values[1:] != values[:-1])
    spacing = np.diff(changes)
    if spacing.size < 8:
        return 1
    usual = int(np.median(spacing))
    return usual if np.mean(spacing == usual) >= REGULAR else 1


def find_counter_losses(values: VectorN) -> CounterLosses | None:
    """Return the samples that a counter shows to be missing; None where the channel does not count. A counter goes up
    by one, at regular intervals, and may wrap.
    """
    if values.size < FEWEST_SAMPLES or np.any(values[:STILLNESS_WINDOW] != np.round(values[:STILLNESS_WINDOW])):
        return None  # NaN is not equal to itself
    if not np.all((np.abs(values) < LARGEST_COUNT) & (values == np.round(values))):
        return None
    step = np.diff(values)
    changes = 1 + np.flatnonzero(step)
    if changes.size < 8:
        return None
    up = step[changes - 1]
    # A counter that wraps falls by its modulus: the range of the log itself, or that of an integer type.
    for modulus in (np.ptp(values) + 1.0, 2.0**8, 2.0**16, 2.0**32):
        turned = np.where(up < 0.0, up + modulus, up)
        if np.all(turned > 0.0) and np.mean(turned == 1.0) >= REGULAR:
            break
    else:
        return None
    spacing = np.diff(changes)
    usual = int(np.median(spacing))
    if np.mean(spacing == usual) < REGULAR:
        return None
    # A value that was held too briefly lost samples; so did every value that was passed over.
    lost = np.maximum(usual - spacing, 0) + ((turned[1:] - 1.0) * usual).astype(int)
    short = lost > 0
    return CounterLosses(samples_per_count=usual, rows=changes[1:][short], lost=lost[short])
