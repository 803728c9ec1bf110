r"""Periods of a log under a periodic reference: where they are, and their Fourier coefficients at its lines.

Noise that goes round a loop moves its states. The coefficient of a period p holds, beside the noise at its line, what
the state at its start has more than at its end, :math:`t_p - t_{p+1}`; the mean over P periods that follow each other
holds only :math:`(t_1 - t_{P+1})/P`. From period to period the coefficients therefore scatter by more than the error of
their mean tells, at the lines below the loop's bandwidth by up to five times its square. Of such a run there are
coefficients without that, too: with X the transform of all of its rows, whose line k P is line k of the periods,

.. math:: Z_p = \frac1P \sum_j X_{kP + j}\, e^{2 \pi i j (p + 1/2)/P}, \qquad -P/2 < j \le P/2 ,

has the same mean, :math:`X_{kP}/P`, and scatters by the noise at the P - 1 lines of the record about it, which have
what its ends add as much as the mean has (Pintelon and Schoukens, System Identification, 2012, chapter 7).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from seaopt.control import Controller
from seaopt.errors import LogError
from seaopt.estimation.problem.correlation import find_quick_size
from seaopt.formatting import format_count, join_words
from seaopt.logs.quality.faults import find_runs
from seaopt.machine.response.runaway import say_runaway
from seaopt.machine.ticks import AT_LIMIT, Ticks
from seaopt.records import record
from seaopt.signals import bridge

SHORTEST = 20  # ticks of a period
LIKE = 0.25  # of the autocorrelation at zero: what a period's is at least
STEADY = 1e-9  # of the reference's range, a row: a ramp's steps differ by less
MOST_LAGS = 50  # that are the likeliest periods, by either measure
REPEATS = 0.2  # of the rows, that repeat after a period at least
MOST_MISSING = 0.3  # of the rows, above which those that are left may not show a period
SAME = 1e-4  # of the reference's range: rows that are alike
WEAKEST = 1e-2  # of the strongest line
NOT_PLAYED = 1e-3  # of the strongest line: what a rounded reference has where it has nothing
STAYS = 0.9  # of the ticks at the limit: a loop that ran away, and no amplitude that is too large
NEAR_UNSTABLE = (
    "or, where the amplitude is the one that was planned, the loop is near its limit of stability or beyond: check the "
    "rate at which the law is stepped, its delay, signs and units"
)
TRANSIENT = 1  # periods that are left out at the start of each stretch
SAME_AMPLITUDE = 0.1  # relative


@record
class Played:
    """How long a reference is that was to be played."""

    period_s: float
    lasts_s: float  # all of it
    outer: Played | None = None  # what was to be played with the outer loop closed


@record
class LeftOut:
    """Periods after the first of each stretch that are not used, by why; of a gap as many as its rows would make."""

    limit: int = 0  # the command was at its limit
    gate: int = 0  # a reading was not believed, and the one before it stood in
    gap: int = 0  # a row or a number is missing, or they lie beyond a gap

    @property
    def total(self) -> int:
        """How many in all."""
        return self.limit + self.gate + self.gap

    def __add__(self, other: LeftOut) -> LeftOut:
        return LeftOut(limit=self.limit + other.limit, gate=self.gate + other.gate, gap=self.gap + other.gap)


@record(eq=False)
class Blocks:
    """Whole periods, one row each, at the lines of the reference."""

    f: Float[np.ndarray, " m"]
    reference: Complex[np.ndarray, "b m"]
    effort: Complex[np.ndarray, "b m"]  # the command over what an effort of one takes
    measured: Complex[np.ndarray, "b y m"]
    beside: Mapping[str, Complex[np.ndarray, "b m"]]  # outputs that the law does not read
    realisation: Int[np.ndarray, " b"]  # which stretch of the reference, of one set of phases
    rows: int  # of a period
    period_s: float
    amplitude: float  # rms of the reference about its mean
    swing: float  # the most by which the effort swings about its middle in the periods of a log
    noise: float  # std of the command from period to period of one set of phases; 0 where there is one of each
    left_out: LeftOut
    between: Complex[np.ndarray, "b k"]  # what is regulated, where the reference has nothing: noise and distortion
    unbroken: Blocks | None = None  # the same, scattered by the noise about each line alone

    @property
    def realisations(self) -> int:
        """How many stretches there are."""
        return len(np.unique(self.realisation))

    def make_efforts(self, responses: Complex[np.ndarray, "k m"]) -> Complex[np.ndarray, "b m"]:
        """Return what a linear law of these responses makes of the reference and of what it reads."""
        return responses[0] * self.reference + np.sum(responses[1:] * self.measured, axis=1)

    def follow(self, responses: Complex[np.ndarray, "k m"]) -> Blocks:
        """Return the periods with the efforts that a linear law of these responses makes."""
        return self.change_efforts(lambda each: each.make_efforts(responses))

    def change_efforts(self, make: Callable[[Blocks], Complex[np.ndarray, "b m"]]) -> Blocks:
        """Return the periods with the efforts that are made of them, and so those scattered about each line alone."""
        unbroken = None if self.unbroken is None else self.unbroken.change_efforts(make)
        return replace(self, effort=make(self), unbroken=unbroken)

    def average(self) -> Blocks:
        """Return one row per stretch, the mean of its periods."""
        kinds = np.unique(self.realisation)
        rows = [self.realisation == kind for kind in kinds]
        reference, effort, measured, between = (
            np.array([part[chosen].mean(axis=0) for chosen in rows])
            for part in (self.reference, self.effort, self.measured, self.between)
        )
        beside = {name: np.array([part[chosen].mean(axis=0) for chosen in rows]) for name, part in self.beside.items()}
        return replace(
            self, reference=reference, effort=effort, measured=measured, beside=beside, between=between,
            realisation=kinds, unbroken=None,
        )  # fmt: skip


def find_period(reference: Float[np.ndarray, " n"]) -> int | None:
    """Return the period of a reference in rows; None where it does not repeat."""
    return _find_period(np.asarray(reference, dtype=float).tobytes())


@lru_cache(maxsize=4)  # each model of a machine is played the same reference
def _find_period(content: bytes) -> int | None:
    reference = np.frombuffer(content)
    if reference.size < 2 * SHORTEST:
        return None
    moving = np.diff(reference)  # in which a bias that fades in is small
    moving = np.nan_to_num(moving - np.nanmean(moving))
    size, n = _span(reference), moving.size
    lags = n // 2 + 3  # differences are one fewer: half of the rows is a lag inside
    long = find_quick_size(n + lags)
    total = np.fft.irfft(np.abs(np.fft.rfft(moving, long)) ** 2, long)[:lags]
    if total[0] <= (STEADY * size) ** 2 * n:
        return None
    like = total * n / (total[0] * (n - np.arange(total.size)))  # as many rows at every lag
    inner = like[1:-1]
    peaks = 1 + np.flatnonzero((inner >= like[:-2]) & (inner >= like[2:]) & (inner > LIKE))
    peaks = peaks[peaks >= SHORTEST - 1]
    # Of a period and its multiples the total is largest at the period, the mean is largest where all rows repeat.
    peaks = np.concatenate([peaks[np.argsort(-each[peaks], kind="stable")[:MOST_LAGS]] for each in (like, total)])
    near = np.unique(
        np.concatenate([peaks - 1, peaks, peaks + 1])
    )  # where a stretch ends the peak is beside the period
    for lag in near[near >= SHORTEST].tolist():
        if np.mean(_find_repeated(reference, lag, size)) > REPEATS:
            return int(lag)
    return None


def find_again(reference: Float[np.ndarray, " n"]) -> tuple[Bool[np.ndarray, " k"], int]:
    """Return which rows of a reference come again after its period, and that; none, after all of them, where it has no
    period.
    """
    period = find_period(reference)
    if period is None:
        return np.zeros(0, dtype=bool), reference.size
    return _find_repeated(reference, period, _span(reference)), period


def _find_repeated(reference: Float[np.ndarray, " n"], lag: int, size: float) -> Bool[np.ndarray, " k"]:
    """Tell which rows come again after a lag."""
    return np.abs(reference[lag:] - reference[:-lag]) <= SAME * size


def _span(reference: Float[np.ndarray, " n"]) -> float:
    """Return the range of the rows that are there."""
    return float(np.nanmax(reference) - np.nanmin(reference))


def _find_short(missing: Bool[np.ndarray, " n"], most: int) -> Bool[np.ndarray, " n"]:
    """Tell which of the missing rows are in gaps of no more than so many rows."""
    short = np.zeros(missing.size, dtype=bool)
    gaps = find_runs(missing)
    gaps = gaps.where(gaps.lengths <= most)
    for start, stop in zip(gaps.start, gaps.stop, strict=True):
        short[start:stop] = True
    return short


def _find_stretches(reference: Float[np.ndarray, " n"], period: int) -> list[tuple[int, int]]:
    """Return where each stretch begins in which periods repeat, and how many there are. What is missing for less than
    half of a period repeats as what is around it does.
    """
    size, stretches, missing = _span(reference), list[tuple[int, int]](), np.isnan(reference)
    short = _find_short(missing, period // 2)
    there = ~(missing & ~short)
    same = _find_repeated(reference, period, size) | short[period:] | short[:-period]
    same = np.concatenate([[False], same & there[period:] & there[:-period], [False]])
    for first, last in np.flatnonzero(np.diff(same.astype(int))).reshape(-1, 2).tolist():
        if last - first >= period and _span(reference[first : first + period]) > SAME * size:
            stretches.append((first, (last - first) // period + 1))
    return stretches


def _list_starts(reference: Float[np.ndarray, " n"], period: int) -> list[tuple[int, int]]:
    """Return the first row of each period, but those of the transients, with the number of its stretch."""
    stretches = enumerate(_find_stretches(reference, period))
    return [(first + period * k, number) for number, (first, whole) in stretches for k in range(TRANSIENT, whole)]


def list_periods(reference: Float[np.ndarray, " n"]) -> tuple[int, list[tuple[int, int]]]:
    """Return the rows of a period of a reference that repeats, and where each begins that is judged, with the number of
    its stretch.
    """
    period = find_period(reference)
    assert period is not None
    return period, _list_starts(reference, period)


def shorten(ticks: Ticks) -> Ticks:
    """Return as many periods of each stretch of a log as its response takes without noise."""
    period = find_period(ticks.reference)
    assert period is not None
    stretches = _find_stretches(ticks.reference, period)
    least = TRANSIENT + (1 if len(stretches) > 1 else 2)
    rows = [np.arange(first, first + period * min(least, whole)) for first, whole in stretches]
    reference = _fill(ticks.reference, period, stretches)
    return replace(ticks, reference=reference).take(np.concatenate(rows))


def _fill(
    reference: Float[np.ndarray, " n"], period: int, stretches: Sequence[tuple[int, int]]
) -> Float[np.ndarray, " n"]:
    """Return a reference with the rows that are missing as they are in the other periods of their stretch."""
    filled = reference.copy()
    for first, whole in stretches:
        part = filled[first : first + period * whole].reshape(whole, period)  # a view
        for row in part:
            for other in part:
                np.copyto(row, other, where=np.isnan(row))
    return bridge(filled)


def say_left_out(left_out: LeftOut) -> list[str]:
    """Return why periods are left out, and what to do about it."""
    counts = (
        (left_out.limit, "in {} of them the command is at its limit: lower the amplitude, or allow a larger limit"),
        (left_out.gate, "in {} of them the gate did not believe a reading: look at its range and its largest step"),
        (left_out.gap, "in {} of them a row or a number is missing, or they lie beyond such a gap: log every tick"),
    )
    return [text.format(count) for count, text in counts if count]


def _say_aperiodic(ticks: Ticks, played: Played | None) -> str:
    """Return why there is no period in a log, and how long to record."""
    lasts_s, missing = len(ticks) / ticks.rate_hz, int(np.sum(~ticks.complete))
    if played is not None and lasts_s < 2.0 * played.period_s:
        few = "shorter than one period" if lasts_s < played.period_s else "shorter than two periods"
        return (
            f"it lasts {lasts_s:.3g} s, {few} of its stage's reference, of {played.period_s:.3g} s each; record all of "
            f"that reference, {played.lasts_s:.4g} s, or at least the period that fades in and three after it, "
            f"{4.0 * played.period_s:.3g} s"
        )
    if missing > MOST_MISSING * len(ticks):
        return (
            f"{missing} of its {len(ticks)} rows are missing, so that no period of its reference is seen; log every "
            "tick, and drain the ring before it is full"
        )
    return (
        f"its reference does not repeat within half of its {lasts_s:.3g} s, so that the loop's response cannot be told "
        "from noise: it has no period, or the log is shorter than two of them; play a periodic multisine as the "
        "reference, and record at least 3 periods"
    )


def cut_periods(
    controller: Controller,
    ticks: Ticks,
    refused: Bool[np.ndarray, " n"] | None = None,
    played: Played | None = None,
) -> Blocks:
    """Return the periods of a log. `refused`: rows whose reading the law did not believe; `played`: the reference of
    its stage, where one is known. Raises LogError: its reference does not repeat, or too few periods are whole, below
    the limit of the command and believed.
    """
    period, seconds = find_period(ticks.reference), 1.0 / ticks.rate_hz
    if period is None:
        why = say_runaway(controller, ticks) or _say_aperiodic(ticks, played)
        raise LogError(f"{ticks.source}: {why}")
    starts = _list_starts(ticks.reference, period)
    at_limit = np.abs(ticks.command) >= AT_LIMIT * (controller.command_limit or np.inf)
    limited = [bool(np.any(at_limit[first : first + period])) for first, _ in starts]
    gated = [refused is not None and bool(np.any(refused[first : first + period])) for first, _ in starts]
    complete = ticks.complete
    cut = [not bool(np.all(complete[first : first + period])) for first, _ in starts]
    free = [pair for pair, *off in zip(starts, limited, gated, cut, strict=True) if not any(off)]
    limit = sum(by and not gap for by, gap in zip(limited, cut, strict=True))
    gate = sum(by and not any(off) for by, *off in zip(gated, limited, cut, strict=True))
    beyond = (int(np.sum(~complete & ~_find_short(~complete, period // 2))) + ticks.left_out) // period
    left_out = LeftOut(limit=limit, gate=gate, gap=sum(cut) + beyond)
    if len(free) < 2:
        if (away := say_runaway(controller, ticks)) is not None:
            raise LogError(f"{ticks.source}: {away}")
        why = join_words(say_left_out(left_out)) or "record more"
        if limited and all(limited):
            why = f"{why} ({NEAR_UNSTABLE})"
        if (stays := float(np.mean(at_limit))) > STAYS:
            why = f"its command stays at the limit ({stays:.0%} of the ticks): check the signs of command and readings"
        raise LogError(
            f"{ticks.source}: it has {format_count(len(free), 'whole period')} of {period * seconds:.3g} s after the "
            f"first of each stretch; {why}, at least 3 periods are needed"
        )
    return _transform(controller, ticks, period, free, left_out)


def _transform(
    controller: Controller, ticks: Ticks, period: int, starts: Sequence[tuple[int, int]], left_out: LeftOut
) -> Blocks:
    rows = np.array([first for first, _ in starts])[:, None] + np.arange(period)
    reference, command = (np.fft.rfft(part[rows], axis=1) for part in (ticks.reference, ticks.command))
    measured = np.fft.rfft(ticks.measured[rows], axis=1).swapaxes(1, 2)
    strength = np.sqrt(np.mean(np.abs(reference) ** 2, axis=0))
    strength[0] = 0.0
    lines = np.flatnonzero(strength > WEAKEST * np.max(strength))
    lines = lines[lines < (period - 1) // 2]
    between = np.flatnonzero(strength <= NOT_PLAYED * np.max(strength))[1:]
    scale = 2.0 / period
    blocks = Blocks(
        f=lines * ticks.rate_hz / period,
        reference=scale * reference[:, lines],
        effort=scale * command[:, lines] / controller.command.per_effort,
        measured=scale * measured[:, :, lines],
        beside={name: scale * np.fft.rfft(part[rows], axis=1)[:, lines] for name, part in ticks.beside.items()},
        realisation=np.array([number for _, number in starts]),
        rows=period,
        period_s=period / ticks.rate_hz,
        amplitude=float(np.sqrt(0.5 * np.mean(np.sum(np.abs(scale * reference[:, lines]) ** 2, axis=1)))),
        swing=float(np.ptp(ticks.command[rows])) / 2.0 / abs(controller.per_effort),
        noise=_find_noise(ticks.command[rows], [number for _, number in starts]),
        left_out=left_out,
        between=scale * measured[:, 0, between],
    )
    columns = np.column_stack([ticks.command, ticks.measured, *ticks.beside.values()])
    effort, *others = (scale * _transform_runs(columns, rows[:, 0], period, lines)).swapaxes(0, 1)
    inputs = ticks.measured.shape[1]
    unbroken = replace(
        blocks,
        effort=effort / controller.command.per_effort,
        measured=np.stack(others[:inputs], axis=1),
        beside=dict(zip(ticks.beside, others[inputs:], strict=True)),
    )
    return replace(blocks, unbroken=unbroken)


def _transform_runs(
    columns: Float[np.ndarray, "n c"], starts: Int[np.ndarray, " b"], period: int, lines: Int[np.ndarray, " m"]
) -> Complex[np.ndarray, "b c m"]:
    """Return coefficients of periods from the transforms of all that follow each other."""
    parts = list[Complex[np.ndarray, "p c m"]]()
    for run in np.split(starts, np.flatnonzero(np.diff(starts) != period) + 1):
        count = run.size
        about = np.arange(-((count - 1) // 2), count // 2 + 1)
        spectrum = np.fft.rfft(columns[run[0] : run[0] + count * period], axis=0)
        turned = np.exp(2j * np.pi * np.outer(np.arange(count) + 0.5, about) / count) / count
        parts.append(np.einsum("pj,jmc->pcm", turned, spectrum[count * lines + about[:, None]]))
    return np.concatenate(parts)


def _find_noise(command: Float[np.ndarray, "b n"], numbers: Sequence[int]) -> float:
    """Return the std of a command about its mean over the periods of each set of phases."""
    groups = [command[np.array(numbers) == number] for number in sorted(set(numbers))]
    free = sum(len(group) - 1 for group in groups) * command.shape[1]
    left = sum(float(np.sum((group - group.mean(axis=0)) ** 2)) for group in groups)
    return math.sqrt(left / free) if free else 0.0


def join_blocks(parts: Sequence[Blocks]) -> list[Blocks]:
    """Return the periods of several logs, together where they have the same lines and amplitude."""
    groups: list[list[Blocks]] = []
    for part in sorted(parts, key=lambda each: each.amplitude):
        for group in groups:
            first = group[0]
            alike = first.f.size == part.f.size and bool(np.allclose(first.f, part.f, rtol=1e-3))
            if alike and abs(part.amplitude / first.amplitude - 1.0) < SAME_AMPLITUDE:
                group.append(part)
                break
        else:
            groups.append([part])
    return [_join(group) for group in groups]


def _join(group: Sequence[Blocks]) -> Blocks:
    if len(group) == 1:
        return group[0]
    names = set.intersection(*(set(part.beside) for part in group))
    unbroken = [part.unbroken for part in group if part.unbroken is not None]
    offsets = np.cumsum([0, *(int(np.max(part.realisation)) + 1 for part in group[:-1])])
    return replace(
        group[0],
        reference=np.concatenate([part.reference for part in group]),
        effort=np.concatenate([part.effort for part in group]),
        measured=np.concatenate([part.measured for part in group]),
        between=np.concatenate([part.between[:, : min(each.between.shape[1] for each in group)] for part in group]),
        beside={name: np.concatenate([part.beside[name] for part in group]) for name in sorted(names)},
        realisation=np.concatenate([part.realisation + at for part, at in zip(group, offsets, strict=True)]),
        amplitude=float(np.mean([part.amplitude for part in group])),
        swing=max(part.swing for part in group),
        noise=max(part.noise for part in group),
        left_out=sum((part.left_out for part in group), LeftOut()),
        unbroken=_join(unbroken) if len(unbroken) == len(group) else None,
    )
