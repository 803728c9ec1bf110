"""Whose each log is, and in what order the logs of an actuator were taken, from the columns of their identity.

Columns of time are those that are called so (`DATES`, `ORDERS`), or that the caller names; the others name the
actuator. Where no column tells the time, logs are taken in the order of their paths, which a warning says: a
file's own time is not looked at, for it is that of its last copy.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

import polars as pl

from seaopt.errors import SeaoptError, suggestion
from seaopt.fleet.result import Fleet
from seaopt.formatting import join_words
from seaopt.records import record

DATES = ("date", "day", "when", "datetime", "timestamp", "time", "clock")
ORDERS = ("run", "cycle", "cycles", "hours", "session", "trial", "take")
LABEL, TIME = "actuator:", "time:"  # columns that are added; no identity has a colon in its name
FORMATS = (
    "%Y-%m-%d", "%Y%m%d", "%Y-%m-%dT%H:%M:%S", "%Y-%m-%dT%H:%M:%SZ", "%Y-%m-%dT%H:%M:%S%z", "%Y-%m-%d %H:%M:%S",
    "%Y-%m-%dT%H:%M", "%Y-%m-%d %H:%M", "%Y%m%dT%H%M%S", "%Y%m%d_%H%M%S", "%Y%m%d-%H%M%S", "%Y%m%d %H%M%S",
    "%Y-%m-%d_%H-%M-%S", "%Y-%m-%d %H-%M-%S", "%Y-%m-%d_%H%M%S", "%Y-%m-%d %H%M%S", "%Y%m%d %H%M", "%Y-%m-%d %H%M",
    "%Y%m%d_%H%M", "%Y-%m-%d_%H%M", "%Y-%m-%d_%H-%M", "%Y%m%dT%H%M",
)  # fmt: skip
YEARS = (1980, 2100)  # other numbers are no dates
UNIX_S = 1e8  # seconds since 1970, beyond which a number is that, and no count
DAY_S = 86400.0
COLUMN = "column of the identity"
DAY, ORDER = "day", ""  # units: the latter of texts that have an order only


@record(eq=False)
class History:
    """The logs of a fleet by actuator and time.

    Parameters
    ----------
    rows : polars.DataFrame
        The fleet's, each actuator's together and in order of time, with two columns more: `LABEL`, the actuator in one
        text, and `TIME`, the time as a number; null where a log has none.
    actuator : tuple of str
        Columns that name the actuator; none where all logs are of one.
    unit : str
        Of the time: "day" of dates, the column's name of numbers, "run" where there is only an order.
    source : str
        Where the time is from, in words.
    warning : str
        What is doubtful about it; "" where nothing is.
    """

    rows: pl.DataFrame
    actuator: tuple[str, ...]
    unit: str
    source: str
    warning: str = ""


def leave_out(rows: pl.DataFrame, conditions: Mapping[str, pl.Expr]) -> tuple[pl.DataFrame, dict[str, int]]:
    """Return the rows that meet all conditions, and how many do not, by the reason that names the first of them."""
    left_out: dict[str, int] = {}
    for reason, condition in conditions.items():
        kept = rows.filter(condition)
        if len(kept) < len(rows):
            left_out[reason] = len(rows) - len(kept)
        rows = kept
    return rows, left_out


def order_runs(fleet: Fleet, actuator: Sequence[str] | None = None, time: Sequence[str] | None = None) -> History:
    """Return the logs of a fleet by actuator and time.

    Parameters
    ----------
    fleet : Fleet
        With an identity.
    actuator : sequence of str, optional
        The columns of its identity that name the actuator: all that are not of time, if left out. A log in which these
        are all empty is an actuator of its own, called by its path.
    time : sequence of str, optional
        The columns that say when: dates, clocks, numbers, or names with a number (run12); several are read together, as
        a date and a clock. Columns that are called date, time, run or the like, if left out.

    Raises
    ------
    SeaoptError
        There is no such column, or its texts are no times.

    Examples
    --------
    >>> logs = ["b/2.csv", "a/10.csv", "a/9.csv"]
    >>> rows = pl.DataFrame({"log": logs, "unit": ["b", "a", "a"], "run": ["2", "10", "9"]})
    >>> history = order_runs(Fleet(rows=rows, units={}, identity=("unit", "run")))
    >>> history.rows["log"].to_list(), history.unit, history.source
    (['a/9.csv', 'a/10.csv', 'b/2.csv'], 'run', 'column "run"')
    """
    when = _choose_time(fleet.identity) if time is None else check_names(time, fleet.identity, "time", COLUMN)
    if actuator is None:
        temporal = {name for name in fleet.identity if name.lower() in (*DATES, *ORDERS)} | set(when)
        whose = tuple(name for name in fleet.identity if name not in temporal)
    else:
        whose = check_names(actuator, fleet.identity, "actuator", COLUMN)
    if not fleet.identity:
        whose = ("log",)
    rows = fleet.rows.with_columns(_label(fleet.rows, whose))
    times, unit, source = _read_times(rows, when)
    paths = pl.Series(":path", _rank(rows["log"].to_list()))
    rows = rows.with_columns(pl.Series(TIME, times, dtype=pl.Float64), paths).sort(
        LABEL, TIME, ":path", nulls_last=True
    )
    if unit == ORDER:  # an actuator's own runs are counted
        ordinal = pl.col(TIME).cum_count().over(LABEL).cast(pl.Float64)
        rows = rows.with_columns(pl.when(pl.col(TIME).is_not_null()).then(ordinal).alias(TIME))
    several = rows[LABEL].n_unique() < len(rows)
    warning = ""
    if several and not when:
        warning = (
            "no column says when a log was taken: the order of their paths is taken for that of time; name the columns "
            "with --time, or in the identity: {joint}_{date}.csv"
        )
    return History(rows=rows.drop(":path"), actuator=whose, unit=unit or "run", source=source, warning=warning)


def check_names(names: Sequence[str], valid: Sequence[str], argument: str, what: str) -> tuple[str, ...]:
    """Return the names that an argument gives, one or several, if all are valid."""
    chosen = (names,) if isinstance(names, str) else tuple(names)
    for name in chosen:
        if name not in valid:
            remedy = suggestion(name, valid) if valid else "give --identity or --manifest, which make columns"
            raise SeaoptError(f'{argument} = "{name}" is no {what}; {remedy}')
    return chosen


def _choose_time(identity: Sequence[str]) -> tuple[str, ...]:
    """Return the columns that say when by their names: a day with its clock before a count."""
    by_name = {name.lower(): name for name in identity}
    days = [by_name[name] for name in ("date", "day", "when") if name in by_name][:1]
    clocks = [by_name[name] for name in ("time", "clock") if name in by_name][:1]
    if days:
        return (*days, *clocks)
    first = [by_name[name] for name in ("datetime", "timestamp", "time", *ORDERS) if name in by_name]
    return tuple(first[:1])


def _label(rows: pl.DataFrame, whose: Sequence[str]) -> pl.Series:
    if not whose:
        return pl.Series(LABEL, ["the actuator"] * len(rows), dtype=pl.String)
    columns = [rows[name].cast(pl.String).fill_null("").to_list() for name in whose]
    # Logs of which nobody says whose they are need not be of one actuator: each is its own.
    labels = [
        " / ".join(parts) if any(parts) else log for log, *parts in zip(rows["log"].to_list(), *columns, strict=True)
    ]
    return pl.Series(LABEL, labels, dtype=pl.String)


def _read_times(rows: pl.DataFrame, when: Sequence[str]) -> tuple[list[float | None], str, str]:
    """Return each log's time as a number, its unit, and where it is from."""
    if not when:
        return [float(rank) for rank in _rank(rows["log"].to_list())], ORDER, "the order of the paths"
    columns = [rows[name].cast(pl.String).fill_null("").to_list() for name in when]
    texts = [" ".join(parts).strip() for parts in zip(*columns, strict=True)]
    source = f"column{'s' if len(when) > 1 else ''} " + join_words([f'"{name}"' for name in when])
    days = _read_dates(texts)
    if days is not None:
        return days, DAY, source
    numbers = _read_numbers(texts)
    if numbers is not None:
        if when[0].lower() in DATES and min((number for number in numbers if number is not None), default=0.0) > UNIX_S:
            return [None if number is None else number / DAY_S for number in numbers], DAY, source
        return numbers, when[0], source
    if when[0].lower() in DATES:
        first, odd = _find_odd_date(texts)
        exception = "" if odd == first else f', but "{first}" elsewhere'
        raise SeaoptError(
            f'{source} has "{odd}"{exception}, which are no dates of one form; write all as 2026-01-31 or '
            "2026-01-31T12:00:00, or name another column with --time"
        )
    ranks = _rank(texts)
    return [float(rank) if text else None for rank, text in zip(ranks, texts, strict=True)], ORDER, source


def _read_dates(texts: Sequence[str]) -> list[float | None] | None:
    """Return days since 1970, null where there is no text; None where they are no dates of one form."""
    for form in FORMATS:
        try:
            return [_read_date(text, form) if text else None for text in texts]
        except ValueError:
            continue
    return None


def _find_odd_date(texts: Sequence[str]) -> tuple[str, str]:
    """Return the first text, and the first that is no date of its form; twice the first where that is no date."""
    first = next(text for text in texts if text)
    form = next((form for form in FORMATS if _has_form(first, form)), None)
    odd = (text for text in texts if text and form and not _has_form(text, form))
    return first, next(odd, first)


def _has_form(text: str, form: str) -> bool:
    try:
        _read_date(text, form)
    except ValueError:
        return False
    return True


def _read_date(text: str, form: str) -> float:
    moment = datetime.strptime(text, form)  # without a zone all are taken as of one
    # Python reads one digit for two: 123456 would be a day of the year 1234.
    if not YEARS[0] <= moment.year <= YEARS[1] or ("%z" not in form and moment.strftime(form) != text):
        raise ValueError
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp() / DAY_S


def _read_numbers(texts: Sequence[str]) -> list[float | None] | None:
    try:
        return [float(text) if text else None for text in texts]
    except ValueError:
        return None


def _rank(texts: Sequence[str]) -> list[int]:
    """Return the place of each text in the order that people count in: run2 before run10; equal texts share one."""
    keys = [
        tuple((0, int(part)) if part.isdecimal() else (1, part) for part in re.split(r"(\d+)", text) if part)
        for text in texts
    ]
    places = {key: rank for rank, key in enumerate(sorted(set(keys)))}
    return [places[key] for key in keys]


def parse_time(text: str | float, history: History) -> float:
    """Return a time in the unit of a history. Raises SeaoptError: it is no time."""
    days = _read_dates([str(text)]) if history.unit == DAY else None
    numbers = days or _read_numbers([str(text)])
    if numbers is None or numbers[0] is None:
        expected = "a date, as 2026-01-31" if history.unit == DAY else f"a number, as {history.source} has"
        raise SeaoptError(f'since = "{text}" is no time of these logs; give {expected}')
    return numbers[0]


def format_time(time: float, unit: str) -> str:
    """Return a time as people write it."""
    if unit != DAY:
        return f"{unit} {time:.10g}"
    moment = datetime.fromtimestamp(time * DAY_S, tz=UTC)
    return moment.strftime("%Y-%m-%d" if time == int(time) else "%Y-%m-%d %H:%M")
