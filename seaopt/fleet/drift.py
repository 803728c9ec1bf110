"""The trend of each actuator's parameters over time, and an alarm where one has changed.

A value differs from run to run by more than the std of its fit: the actuator is warmer, screwed down again, run in. By
how much, how alike in runs that follow each other, and with what tails is estimated over all actuators
(`seaopt.fleet.scatter`). With it each actuator has a chart of its innovations (`seaopt.fleet.cusum`), and a trend by
weighted least squares.

How many alarms a healthy fleet would raise is said only where its runs bear out what the charts assume: actuators
without an alarm are counted at a threshold so low that about a quarter of healthy ones would go beyond it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl
from jaxtyping import Float, Int

from seaopt.codec import to_content
from seaopt.fleet.cusum import ALLOWANCE, Charts, alarm_probabilities, chart_runs, choose_threshold, find_change
from seaopt.fleet.history import LABEL, TIME, History, check_names, format_time, leave_out, order_runs, parse_time
from seaopt.fleet.result import Fleet
from seaopt.fleet.scatter import (
    FEWEST_ACTUATORS,
    FEWEST_PAIRS,
    MOST_OF_TAILS,
    Between,
    Runs,
    differ_in_scatter,
    estimate_between_runs,
    estimate_tails,
    wander,
)
from seaopt.fleet.worker import FAILED, MET
from seaopt.formatting import format_count, format_number, join_words
from seaopt.records import Worded, record
from seaopt.signals import VectorN

FALSE_ALARMS, PER_RUNS = 0.01, 100  # per actuator, within so many runs
LOW_CHANCE = 0.25  # of an alarm at the threshold by which it is seen whether healthy actuators scatter as assumed
MATTERS = 1.3  # times as many beyond it as should be are no longer as assumed
FEWEST_OF_TREND = 3  # runs
WANDER = "wander over many runs, as with season, temperature or wear"
CELLS = 2_000_000  # of arrays at once
_PLACE, _RUN = "place:", "run:"  # columns that are added


@record
class Alarm:
    """A parameter of an actuator that has changed.

    Parameters
    ----------
    actuator : str
    identity : mapping of name to text
        The same, by columns.
    parameter, unit : str
    since, raised : str
        The log from which on the value is likely to differ, and the one at which that was sure.
    since_time, raised_time : str
        When these were.
    begun : float
        The time of `since`, in the unit of the history.
    before, before_std, after, after_std : float
        Weighted means of the runs before and from then on, and their standard deviations.
    runs : int
        From `since` on.
    level : float
        The chart over its threshold, where it is largest; above 1.
    """

    json_keys = (
        *("actuator", "parameter", "unit", "since", "raised", "since_time", "raised_time", "begun", "before"),
        *("before_std", "after", "after_std", "runs", "level", "text"),
    )

    actuator: str
    identity: Mapping[str, str]
    parameter: str
    unit: str
    since: str
    raised: str
    since_time: str
    raised_time: str
    begun: float
    before: float
    before_std: float
    after: float
    after_std: float
    runs: int
    level: float

    @property
    def text(self) -> str:
        """The change in words, as `describe` returns it."""
        return self.describe()

    def describe(self) -> str:
        """Return what has changed, in one sentence without an end."""
        change = self.after - self.before
        share = f" by {format_number(abs(100 * change / self.before), 2)} %" if self.before else ""
        values = f"{format_number(self.before)} to {format_number(self.after)} {self.unit}".rstrip(" -")
        word = "rose" if change > 0 else "fell"
        return f"{self.parameter} {word}{share}, {values}, since {self.since_time} ({format_count(self.runs, 'run')})"


@record(eq=False, repr=False)
class Drift(Worded):
    """The result of `find_drift`; ``print(drift)`` is a summary.

    Parameters
    ----------
    table : polars.DataFrame
        A row for each actuator and parameter: runs, first and last time, mean, slope per unit of time, change over the
        whole time by that slope, with standard deviations, the chart now over its threshold (level), alarm.
    alarms : tuple of Alarm
        The worst first, each actuator's together.
    actuators : int
    history : History
        The logs in order.
    between : mapping of parameter to Between
        Those that have charts.
    threshold : float
        h of the charts, in standard deviations.
    false_alarms : float
        Probability that a healthy actuator raises an alarm within 100 runs; at most this.
    expected : float or None
        How many actuators would have one here, if all were healthy; at most this. None where that is not known.
    left_out : mapping of reason to int
        Logs that no chart has.
    missing : str
        Why there are no charts; "" where there are.
    doubt : str
        Why it is not known how many would have an alarm if all were healthy; "" where it is.
    """

    table: pl.DataFrame
    alarms: tuple[Alarm, ...]
    actuators: int
    history: History
    between: Mapping[str, Between]
    threshold: float
    false_alarms: float
    expected: float | None
    left_out: Mapping[str, int]
    missing: str = ""
    doubt: str = ""

    @property
    def verdict(self) -> str:
        """The verdict in one line."""
        if self.missing:
            return f"not looked for: {self.missing}"
        count = len({alarm.actuator for alarm in self.alarms})
        alarmed = f"{count or 'none'} of {format_count(self.actuators, 'actuator')} with an alarm"
        return f"{alarmed}; {self.describe_expected()}"

    def describe_expected(self) -> str:
        """Return how many actuators would have an alarm if all were healthy, or why that is not known."""
        if self.expected is None:
            return f"how many would have one if all were healthy is not known: {self.doubt}"
        return f"were all healthy, {format_number(self.expected, 2)} would be expected"

    def describe_left_out(self) -> str:
        """Return which logs no chart has, "2 not met and 1 without a time"; empty where all are in one."""
        return join_words([f"{count} {reason}" for reason, count in self.left_out.items()])

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the part drift of fleet.json."""
        return {
            "verdict": self.verdict,
            "actuators": self.actuators,
            "time": self.history.source,
            "time_unit": self.history.unit,
            "actuator": list(self.history.actuator),
            "false_alarms": self.false_alarms,
            "per_runs": PER_RUNS,
            "threshold": self.threshold,
            "allowance": ALLOWANCE,
            "expected": self.expected,
            "doubt": self.doubt,
            "left_out": dict(self.left_out),
            "between_runs": to_content(self.between),
            "alarms": to_content(self.alarms),
        }


@record(eq=False)
class _RunTable:
    """Runs of one parameter: a row per actuator, a column per run, nan where there is none."""

    actuators: list[str]
    places: Int[np.ndarray, "actuators runs"]  # rows of the history; -1 for none
    times: Runs
    values: Runs
    variances: Runs  # of the fits


def find_drift(
    fleet: Fleet,
    *,
    actuator: Sequence[str] | None = None,
    time: Sequence[str] | None = None,
    parameters: Sequence[str] | None = None,
    since: str | float | None = None,
    false_alarms: float = FALSE_ALARMS,
) -> Drift:
    """Return the trends of each actuator's parameters, and alarms where one has changed.

    Logs that are not met, that do not identify the parameter, or that have no time are left out, and counted.

    Parameters
    ----------
    fleet : Fleet
        With an identity that tells the logs of one actuator from those of another, and their times.
    actuator, time : sequence of str, optional
        Columns of the identity, as in `seaopt.fleet.order_runs`.
    parameters : sequence of str, optional
        What has a chart: all that is fitted, if left out; derived figures may be named. Each further one makes all
        charts a little slower, for the false alarms are of all together.
    since : str or float, optional
        A date, or a number as the column of time has them: earlier logs are left out, as after a repair.
    false_alarms : float
        Probability, at most, that a healthy actuator raises an alarm within 100 runs.

    Returns
    -------
    Drift
        Without charts, but with a reason, where no actuator has several logs, or the fleet too few.

    Raises
    ------
    SeaoptError
        A column or parameter is not there, its texts are no times, or false_alarms is no probability.

    Notes
    -----
    What is assumed: the values of a healthy actuator scatter around its own mean with the variance of the fits, which
    are independent, and one between runs; the latter, its correlation in runs that follow each other and the tails are
    the same in the whole fleet. Where the runs are too few to tell, or tell otherwise, `expected` is None and `doubt`
    says why.

    Examples
    --------
    >>> rng, n = np.random.default_rng(0), 30
    >>> J = np.concatenate([5.0 + 0.1 * rng.normal(size=n), 6.0 + 0.1 * rng.normal(size=n)])
    >>> J[45:] += 0.5  # the second one, from its 16th run on
    >>> rows = pl.DataFrame({
    ...     "log": [f"{i}.csv" for i in range(2 * n)], "status": "met", "joint": ["hip"] * n + ["knee"] * n,
    ...     "run": [str(i) for i in (*range(1, n + 1), *range(1, n + 1))], "J": J, "J_std": 0.05,
    ... })
    >>> drift = find_drift(Fleet(rows=rows, units={"J": "kg m^2"}, identity=("joint", "run"), fitted=("J",)))
    >>> [(one.actuator, one.since_time, one.raised_time) for one in drift.alarms]
    [('knee', 'run 16', 'run 17')]
    """
    history = order_runs(fleet, actuator, time)
    names = fleet.fitted or tuple(fleet.units)
    if parameters is not None:
        names = check_names(parameters, tuple(fleet.units), "parameters", "column of the fleet")
    threshold = choose_threshold(false_alarms, PER_RUNS, max(len(names), 1))
    rows, left_out = _select_rows(history, since)
    actuators = history.rows[LABEL].n_unique()
    tables: list[pl.DataFrame] = []
    alarms: list[Alarm] = []
    between: dict[str, Between] = {}
    unlike: list[str] = []
    wandering: list[str] = []
    tops = _Tops(level=np.zeros(actuators), runs=np.zeros(actuators, dtype=int), charts=max(len(names), 1))
    labels = {label: number for number, label in enumerate(history.rows[LABEL].unique(maintain_order=True))}
    for name in names:
        identified = rows.filter(pl.col(name).is_finite() & pl.col(f"{name}_std").is_finite())
        if len(identified) < len(rows):
            left_out[f"{name} not identified"] = len(rows) - len(identified)
        batches = list(_batch_runs(identified, name))
        runs = [(batch.values, batch.variances) for batch in batches]
        spread = estimate_between_runs(runs)
        if spread is None:
            continue
        if differ_in_scatter(runs, spread):
            unlike.append(name)
        between[name] = spread = _shape(batches, spread, threshold)
        still: list[tuple[Runs, Runs]] = []
        for batch in batches:
            charts = chart_runs(batch.values, batch.variances, threshold, **spread.chart)
            tables.append(_tabulate(batch, name, fleet.units[name], spread, charts, threshold))
            alarms += _list_alarms(batch, history, name, fleet.units[name], spread, charts, threshold)
            still.append((batch.values[charts.alarm < 0], batch.variances[charts.alarm < 0]))
            numbers = np.array([labels[label] for label in batch.actuators], dtype=int)
            highest = np.maximum(charts.upper, charts.lower).max(axis=1)
            tops.level[numbers] = np.maximum(tops.level[numbers], highest)
            tops.runs[numbers] = np.maximum(tops.runs[numbers], np.isfinite(batch.values).sum(axis=1))
        if wander(still, spread):
            wandering.append(name)
    doubt = _doubt(tops, threshold, between, unlike, wandering) if between else ""
    return Drift(
        table=pl.concat(tables) if tables else pl.DataFrame(),
        alarms=_order_alarms(alarms),
        actuators=actuators,
        history=history,
        between=between,
        threshold=threshold,
        false_alarms=false_alarms,
        expected=None if doubt else float(tops.expect(threshold).sum()),
        left_out=left_out,
        missing="" if between else _explain_missing(history, rows),
        doubt=doubt,
    )


def _shape(batches: Sequence[_RunTable], between: Between, threshold: float) -> Between:
    """Return the same with tails, of the innovations until what led to an alarm; of some actuators of many."""
    step = -(-sum(batch.values.size for batch in batches) // (2 * MOST_OF_TAILS))
    ratios: list[VectorN] = []
    for batch in batches:
        values, variances = batch.values[::step], batch.variances[::step]
        charts = chart_runs(values, variances, threshold, **between.chart)
        end = np.full(len(values), values.shape[1])
        for row in np.flatnonzero(charts.alarm >= 0):
            runs = slice(int(charts.alarm[row]) + 1)
            end[row] = find_change(values[row, runs], 1.0 / (variances[row, runs] + between.std**2))
        healthy = charts.ratios[np.arange(values.shape[1]) < end[:, None]]
        ratios.append(healthy[np.isfinite(healthy)])
    tails, scale = estimate_tails(np.concatenate(ratios))
    return replace(between, tails=tails, scale=scale)


@record(eq=False)
class _Tops:
    """The largest charts of each actuator, and how many runs it has."""

    level: Float[np.ndarray, " actuators"]  # of S+ and S- of all its parameters
    runs: Int[np.ndarray, " actuators"]
    charts: int

    def expect(self, threshold: float) -> Float[np.ndarray, " actuators"]:
        """Return with which probability each actuator would have an alarm, if healthy; at most this."""
        longest = max(int(self.runs.max(initial=0)) - 1, 0)
        within = 2 * self.charts * alarm_probabilities(threshold, longest)
        return np.minimum(within, 1.0)[np.maximum(self.runs - 1, 0)]


def _doubt(
    tops: _Tops, threshold: float, between: Mapping[str, Between], unlike: Sequence[str], wandering: Sequence[str]
) -> str:
    """Return why nobody can say how many healthy actuators would have an alarm; "" where one can."""
    few = [name for name, spread in between.items() if not spread.shaped]
    healthy = tops.level <= threshold
    if few or tops.runs.size < FEWEST_ACTUATORS:
        least = between[few[0]].pairs if few else min(spread.pairs for spread in between.values())
        return (
            f"{format_count(tops.runs.size, 'actuator')} and {least} times one run after another are too few to tell "
            "how healthy ones scatter"
        )
    if unlike:
        return f"actuators scatter unlike one another in {join_words(unlike)}"
    if healthy.sum() < tops.runs.size / 2:
        return "more than half of them have one, so that healthy ones are not known"
    if wandering:
        return f"values of {join_words(wandering)} {WANDER}"
    low = choose_threshold(LOW_CHANCE, max(int(np.median(tops.runs)) - 1, 1), tops.charts)
    beyond, share = tops.level[healthy] > low, 1.0 - np.exp(-tops.expect(low)[healthy])
    if beyond.sum() > max(share.sum() * MATTERS, share.sum() + 3.0 * share.sum() ** 0.5):
        return (
            f"{beyond.sum()} of the {beyond.size} without one are beyond a threshold that {share.sum():.0f} should be: "
            f"values {WANDER}"
        )
    return ""


def _select_rows(history: History, since: str | float | None) -> tuple[pl.DataFrame, dict[str, int]]:
    """Return the logs that charts have, and how many are left out for which reason."""
    status, time = pl.col("status"), pl.col(TIME)
    conditions = {"failed": status != FAILED, "not met": status == MET, "without a time": time.is_not_null()}
    if since is not None:
        conditions[f"before {since}"] = time >= parse_time(since, history)
    return leave_out(history.rows.with_row_index(_PLACE), conditions)


def _explain_missing(history: History, rows: pl.DataFrame) -> str:
    if not history.actuator or history.actuator == ("log",):
        hint = "name whose logs they are with --identity or --manifest"
    else:
        hint = f"an actuator is told by {join_words(history.actuator)}, the time by {history.source}"
    if len(rows) == rows[LABEL].n_unique():
        return f"no actuator has two logs that are met ({hint})"
    return f"fewer than {FEWEST_PAIRS} times one log of an actuator follows another ({hint})"


def _batch_runs(rows: pl.DataFrame, name: str) -> Iterator[_RunTable]:
    """Yield the runs of a parameter, some actuators at once, those of about as many runs together."""
    numbered = rows.with_columns(pl.int_range(pl.len()).over(LABEL).alias(_RUN))
    counts = numbered.group_by(LABEL, maintain_order=True).len().sort("len", maintain_order=True)
    batch: list[str] = []
    for label, count in [*counts.iter_rows(), ("", 0)]:
        if batch and (not count or (len(batch) + 1) * count > CELLS):
            yield _pack(numbered.filter(pl.col(LABEL).is_in(batch)), batch, name)
            batch = []
        batch.append(label)


def _pack(rows: pl.DataFrame, actuators: list[str], name: str) -> _RunTable:
    """Return runs as arrays."""
    index = {label: row for row, label in enumerate(actuators)}
    at = np.array([index[label] for label in rows[LABEL]]), rows[_RUN].to_numpy()
    shape = len(actuators), int(at[1].max()) + 1
    places, times, values, variances = np.full(shape, -1), *(np.full(shape, np.nan) for _ in range(3))
    places[at], times[at] = rows[_PLACE].to_numpy(), rows[TIME].to_numpy()
    values[at], variances[at] = rows[name].to_numpy(), rows[f"{name}_std"].to_numpy() ** 2
    return _RunTable(actuators=actuators, places=places, times=times, values=values, variances=variances)


def _tabulate(
    batch: _RunTable, name: str, unit: str, spread: Between, charts: Charts, threshold: float
) -> pl.DataFrame:
    """Return the rows of a parameter in the table of trends."""
    with np.errstate(invalid="ignore", divide="ignore"):
        weights = np.nan_to_num(1.0 / (batch.variances + spread.std**2))
        widened = np.nan_to_num(spread.widen(batch.variances) * weights**2)  # of a weighted sum of runs
        total = weights.sum(axis=1)
        values, times = np.nan_to_num(batch.values), np.nan_to_num(batch.times)
        mean, middle = (weights * values).sum(axis=1) / total, (weights * times).sum(axis=1) / total
        away = weights * (times - middle[:, None])
        lever = (away * (times - middle[:, None])).sum(axis=1)
        slope = (away * values).sum(axis=1) / lever
        slope_std = (widened * (times - middle[:, None]) ** 2).sum(axis=1) ** 0.5 / lever
    runs, (first, last) = (
        np.isfinite(batch.values).sum(axis=1),
        (f(batch.times, axis=1) for f in (np.nanmin, np.nanmax)),
    )
    sloped = (runs >= FEWEST_OF_TREND) & (last > first)
    slope, slope_std = np.where(sloped, slope, np.nan), np.where(sloped, slope_std, np.nan)
    now = np.maximum(charts.upper[:, -1], charts.lower[:, -1]) / threshold
    return pl.DataFrame(
        {
            "actuator": batch.actuators,
            "parameter": name,
            "unit": unit,
            "runs": runs,
            "first": first,
            "last": last,
            "mean": mean,
            "mean_std": widened.sum(axis=1) ** 0.5 / total,
            "slope": slope,
            "slope_std": slope_std,
            "change": slope * (last - first),
            "change_std": slope_std * (last - first),
            "level": now,
            "alarm": charts.alarm >= 0,
        }
    )


def _list_alarms(
    batch: _RunTable, history: History, name: str, unit: str, spread: Between, charts: Charts, threshold: float
) -> list[Alarm]:
    """Return the alarms of a parameter."""
    alarms: list[Alarm] = []
    for row in np.flatnonzero(charts.alarm >= 0):
        raised, runs = int(charts.alarm[row]), int(np.isfinite(batch.values[row]).sum())
        weights = 1.0 / (batch.variances[row, :runs] + spread.std**2)
        rises = bool(charts.upper[row, raised] > charts.lower[row, raised])
        widened = spread.widen(batch.variances[row, :runs]) * weights**2
        start, end, before, after = _measure_change(batch.values[row, :runs], weights, raised, rises=rises)
        first, then = (history.rows.row(int(batch.places[row, run]), named=True) for run in (start, raised))
        alarms.append(
            Alarm(
                actuator=batch.actuators[row],
                identity={column: str(first[column]) for column in history.actuator},
                parameter=name,
                unit=unit,
                since=first["log"],
                raised=then["log"],
                since_time=format_time(first[TIME], history.unit),
                raised_time=format_time(then[TIME], history.unit),
                begun=first[TIME],
                before=before,
                before_std=float(widened[:start].sum() ** 0.5 / weights[:start].sum()),
                after=after,
                after_std=float(widened[start:end].sum() ** 0.5 / weights[start:end].sum()),
                runs=end - start,
                level=float(max(charts.upper[row].max(), charts.lower[row].max()) / threshold),
            )
        )
    return alarms


def _measure_change(values: VectorN, weights: VectorN, raised: int, *, rises: bool) -> tuple[int, int, float, float]:
    """Return the runs of a change, first and one past the last, and the means before it and of these. They go on to the
    last run, unless the value has come back since, further than it was: then to the alarm.
    """
    start = find_change(values[: raised + 1], weights[: raised + 1])
    before = float(np.average(values[:start], weights=weights[:start]))
    for end in (len(values), raised + 1):
        after = float(np.average(values[start:end], weights=weights[start:end]))
        if (after > before) == rises:
            return start, end, before, after
    return start, raised + 1, before, after


def _order_alarms(alarms: Sequence[Alarm]) -> tuple[Alarm, ...]:
    """Return alarms, each actuator's together, the worst first."""
    worst: dict[str, float] = {}
    for alarm in alarms:
        worst[alarm.actuator] = max(worst.get(alarm.actuator, 0.0), alarm.level)
    return tuple(sorted(alarms, key=lambda alarm: (-worst[alarm.actuator], alarm.actuator, -alarm.level)))
