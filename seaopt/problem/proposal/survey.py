"""The columns of a raw log with their headers and samples, before they have roles."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from seaopt.errors import LogError
from seaopt.formatting import join_words
from seaopt.logs import Column, contents, read_table
from seaopt.problem.proposal.vocabulary import Header, read_header
from seaopt.records import record

SLOW_HZ = 1.0
ALIKE = 0.5  # of the correlation below SLOW_HZ, from which its sign means something
ENOUGH = 64  # samples for a correlation
SAME = 1.0 - 1e-6  # share of variance from which a column is another one, rounded
TIME_STEPS = {"s": (2e-5, 0.2), "ms": (0.2, 200.0), "us": (200.0, 1e7)}  # of a clock without a unit, from and up to


@record(eq=False)
class SurveyedColumn:
    """A column as the file holds it; `values` are raw numbers in whatever unit it has."""

    header: Header
    values: Float[np.ndarray, " n"]

    @property
    def name(self) -> str:
        """The column's name, as a problem file gives it."""
        return self.header.name

    @property
    def swing(self) -> float:
        """Robust spread of the samples: half of what lies between their 1 % and 99 % quantiles."""
        present = self.values[np.isfinite(self.values)]
        return float(np.subtract(*np.quantile(present, [0.99, 0.01])) / 2.0) if present.size else 0.0

    @property
    def largest(self) -> float:
        """The largest magnitude."""
        return float(np.max(np.abs(self.values[np.isfinite(self.values)]), initial=0.0))

    @property
    def noise(self) -> float:
        """Standard deviation of what changes from sample to sample: third differences remove what is smooth."""
        third = np.diff(self.values[np.isfinite(self.values)], 3)
        return float(np.median(np.abs(third)) / 0.6745 / np.sqrt(20.0)) if third.size else 0.0

    @property
    def whole(self) -> bool:
        """Whether all samples are whole numbers, as of an encoder's steps."""
        return bool(np.all(self.values[np.isfinite(self.values)] % 1.0 == 0.0)) and self.swing > 0.0


@record(eq=False)
class Survey:
    """The columns of one log."""

    path: Path
    clock: SurveyedColumn | None  # the column of times; None where the file has none
    # columns that may be the time by their names; none where the clock was found by its samples
    clocks: tuple[str, ...]
    columns: tuple[SurveyedColumn, ...]  # all others that hold numbers and vary
    left_out: Mapping[str, str]  # why other columns cannot be used: text, constants, and those without a number

    @property
    def name(self) -> str:
        """The log's file name."""
        return self.path.name

    def clock_unit(self) -> tuple[str, bool]:
        """Return the clock's unit, and whether the file says so or the size of its steps suggests it."""
        if self.clock is None:
            return "s", False
        if self.clock.header.unit:
            return self.clock.header.unit, True
        step = float(np.nanmedian(np.abs(np.diff(self.clock.values))))
        return next((unit for unit, (low, high) in TIME_STEPS.items() if low <= step < high), "s"), False


def survey_log(path: Path, clock: str | None = None) -> Survey:
    r"""Read every column of a log; `clock` names the time where the file leaves that open. Raises LogError: the file
    cannot be read, or holds no numbers that vary.
    """
    held = contents(path)
    numeric = [field for field in held.fields if field.numeric]
    if not numeric:
        command = f"seaopt inspect {shlex.quote(str(path))} --list"
        raise LogError(f"{path}: holds no column of numbers; list what it holds with {command}")
    headers = {field.name: read_header(field.name, field.unit) for field in numeric}
    times = [name for name, header in headers.items() if header.quantity == "time"]
    clocks = [field.clock for field in numeric if field.clock]
    chosen = clock or (clocks[0] if clocks else times[0] if times else None)
    values = _read_raw(path, list(headers), chosen)
    if chosen is None:
        chosen = next((name for name, samples in values.items() if _runs_on(samples)), None)
    columns = {name: SurveyedColumn(header=header, values=values[name]) for name, header in headers.items()}
    moving = [column for name, column in columns.items() if name != chosen and name not in times and column.swing > 0.0]
    if not moving:
        raise LogError(f"{path}: no column varies; record a log in which the actuator moves")
    copies = _find_copies(moving)
    moving = [column for column in moving if column.name not in copies]
    still = {
        name: "constant" if np.any(np.isfinite(column.values)) else "holds no number"
        for name, column in columns.items()
        if column.swing == 0.0 and name != chosen
    }
    words = {field.name: "text" for field in held.fields if not field.numeric}
    return Survey(
        path=path,
        clock=columns[chosen] if chosen is not None else None,
        clocks=tuple(times or clocks),
        columns=tuple(moving),
        left_out=words | still | copies,
    )


def _read_raw(path: Path, names: Sequence[str], clock: str | None) -> dict[str, Float[np.ndarray, " n"]]:
    """Return the numbers of columns as they are, without their units."""
    # Neither a channel's name nor its unit matters here, and a clock may not increase.
    channels = {f"column {at}": Column(column=name, unit="-") for at, name in enumerate(names)}
    time = Column(column=clock, unit="s") if clock is not None else None
    table = read_table(path, time=time, channels=channels, rate_hz=1.0 if time is None else None, digest=False)
    if any(signal.values.size != len(table) for signal in table.signals.values()):
        raise LogError(f"{path}: {join_words(names)} are on several clocks; give each log a file of its own")
    return {name: table.signals[f"column {at}"].values for at, name in enumerate(names)}


def _runs_on(values: Float[np.ndarray, " n"]) -> bool:
    """Tell whether a column is a clock by its samples: it only rises, by nearly the same each time."""
    steps = np.diff(values)
    return bool(
        steps.size > 1 and np.all(steps > 0.0) and np.quantile(steps, 0.9) < 1.5 * np.median(steps) < 1e7 * steps[0]
    )


def _find_copies(columns: Sequence[SurveyedColumn]) -> dict[str, str]:
    """Return the columns that are another one but for a factor, as raw counts beside newtons, and what they are."""
    kept, copies = list[SurveyedColumn](), dict[str, str]()
    for column in sorted(columns, key=lambda column: not column.header.unit):
        for other in kept:
            if column.header.quantity != other.header.quantity or column.values.size < ENOUGH:
                continue
            slope, share = regress(column.values, other.values)
            if share > SAME:
                copies[column.name] = f"{slope:.4g} times {other.name}"
                break
        else:
            kept.append(column)
    return copies


def find_leader(columns: Sequence[SurveyedColumn]) -> SurveyedColumn:
    """Return the column that the others follow: what drives an actuator is there before anything answers."""
    used = [column for column in columns if column.values.size >= ENOUGH]
    if not used:
        return columns[0]
    return max(
        used, key=lambda column: sum(_lead(column.values, other.values) for other in used if other is not column)
    )


def _lead(first: Float[np.ndarray, " n"], second: Float[np.ndarray, " n"]) -> float:
    """Return by how many samples `first` leads `second`, weighted with how well they correlate."""
    a, b = (np.nan_to_num(np.diff(values)) for values in (first, second))
    a, b = a - np.mean(a), b - np.mean(b)
    size = 2 * a.size
    cross = np.fft.irfft(np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size), size)
    reach = min(a.size // 4, 200)
    cross = np.concatenate([cross[-reach:], cross[: reach + 1]])
    scale = float(np.sqrt(np.sum(a**2) * np.sum(b**2))) or 1.0
    at = int(np.argmax(np.abs(cross)))
    return (at - reach) * float(np.abs(cross[at])) / scale


def slow_sign(first: Float[np.ndarray, " n"], second: Float[np.ndarray, " n"], rate_hz: float) -> int:
    """Return 1 where two columns move alike below 1 Hz, -1 where one falls as the other rises, else 0."""
    f = np.fft.rfftfreq(first.size, 1.0 / rate_hz)
    slow = (f > 0.0) & (f <= max(SLOW_HZ, 2.0 * rate_hz / first.size))
    a, b = (np.fft.rfft(np.nan_to_num(values - np.nanmean(values)))[slow] for values in (first, second))
    scale = float(np.sqrt(np.sum(np.abs(a) ** 2) * np.sum(np.abs(b) ** 2))) or 1.0
    alike = float(np.real(np.vdot(a, b))) / scale
    return 0 if abs(alike) < ALIKE else 1 if alike > 0.0 else -1


def regress(values: Float[np.ndarray, " n"], on: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Return the slope of a column on another, and the share of its variance that this explains."""
    good = np.isfinite(values) & np.isfinite(on)
    y, x = values[good] - np.mean(values[good]), on[good] - np.mean(on[good])
    power = float(x @ x)
    if power <= 0.0 or not float(y @ y):
        return 0.0, 0.0
    slope = float(x @ y) / power
    return float(f"{slope:.12g}"), float(f"{slope**2 * power / float(y @ y):.12g}")
