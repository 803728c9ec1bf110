"""What the parameters of each actuator do over time: their trends, and an alarm where one has changed.

A value differs from run to run by more than the std of its fit: the actuator is warmer, screwed down again, run in. The
variance between runs is estimated once for each parameter, over all actuators, from the differences of runs that
follow each other, which neither slow drift nor a step now and then spoils; differences beyond `CLIP_SQUARE` count as
that, whatever they are (Huber's scale, for differences of unlike variances). With it each actuator has a chart of its
innovations (`seaopt.fleet.cusum`), and a trend by weighted least squares.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl
from jaxtyping import Float, Int
from scipy.optimize import brentq
from scipy.stats import chi2

from seaopt.errors import SeaoptError, suggestion
from seaopt.fleet.cusum import ALLOWANCE, Charts, alarm_probabilities, chart_runs, choose_threshold, find_change
from seaopt.fleet.history import LABEL, TIME, History, format_time, order_runs, parse_time
from seaopt.fleet.result import Fleet
from seaopt.fleet.worker import FAILED, MET
from seaopt.formatting import format_count, format_number, format_table, html_text, join_words
from seaopt.records import record

FALSE_ALARMS, PER_RUNS = 0.01, 100  # per actuator, within so many runs
CLIP_SQUARE = 6.0  # standardised squared differences count for no more; 1.4 % of those of healthy actuators are larger
FEWEST_PAIRS = 8  # of runs that follow each other, in the whole fleet, from which a variance can be told
FEWEST_OF_TREND = 3  # runs
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

    def describe(self) -> str:
        """Return what has changed, in one sentence without an end."""
        change = self.after - self.before
        share = f" by {format_number(abs(100 * change / self.before), 2)} %" if self.before else ""
        values = f"{format_number(self.before)} to {format_number(self.after)} {self.unit}".rstrip(" -")
        word = "rose" if change > 0 else "fell"
        return f"{self.parameter} {word}{share}, {values}, since {self.since_time} ({format_count(self.runs, 'run')})"


@record
class Between:
    """How much a parameter differs from run to run, beyond the std of its fits.

    Parameters
    ----------
    std : float
    pairs : int
        Runs that follow each other, of which that is known.
    dof : float
        Degrees of freedom of the variance of a run, fit and between runs together.

    """

    std: float
    pairs: int
    dof: float


@record(eq=False, repr=False)
class Drift:
    """What `find_drift` returns; ``print(drift)`` is a summary.

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
    expected : float
        How many actuators would have one here, if all were healthy; at most this.
    left_out : mapping of reason to int
        Logs that no chart has.
    missing : str
        Why there are no charts; "" where there are.

    """

    table: pl.DataFrame
    alarms: tuple[Alarm, ...]
    actuators: int
    history: History
    between: Mapping[str, Between]
    threshold: float
    false_alarms: float
    expected: float
    left_out: Mapping[str, int]
    missing: str = ""

    @property
    def verdict(self) -> str:
        """What to say of it in one line."""
        if self.missing:
            return f"not looked for: {self.missing}"
        count = len({one.actuator for one in self.alarms})
        found = f"{count or 'none'} of {format_count(self.actuators, 'actuator')} with an alarm"
        return f"{found}; were all healthy, {format_number(self.expected, 2)} would be expected"

    def describe_left_out(self) -> str:
        """Return which logs no chart has, "2 not met and 1 without a time"; empty where all are in one."""
        return join_words([f"{count} {reason}" for reason, count in self.left_out.items()])

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the part drift of fleet.json."""
        names = [name for name in Alarm.__dataclass_fields__ if name != "identity"]
        return {
            "verdict": self.verdict, "actuators": self.actuators, "time": self.history.source,
            "time_unit": self.history.unit, "actuator": list(self.history.actuator), "false_alarms": self.false_alarms,
            "per_runs": PER_RUNS, "threshold": self.threshold, "allowance": ALLOWANCE, "expected": self.expected,
            "left_out": dict(self.left_out),
            "between_runs": {
                name: {"std": one.std, "pairs": one.pairs, "dof": one.dof} for name, one in self.between.items()
            },
            "alarms": [
                {name: getattr(one, name) for name in names} | {"text": one.describe()} for one in self.alarms
            ],
        }  # fmt: skip

    def __repr__(self) -> str:
        lines = [f"Drift: {self.verdict}", *(f"  {one.actuator}: {one.describe()}" for one in self.alarms[:20])]
        if len(self.alarms) > 20:
            lines.append(f"  and {len(self.alarms) - 20} more: drift.alarms")
        cells = [(name, format_number(one.std), str(one.pairs)) for name, one in self.between.items()]
        table = format_table(cells, ("parameter", "std between runs", "of pairs"), "<>>") if cells else []
        return "\n".join([*lines, *(f"  {line}" for line in table)])

    _repr_html_ = html_text


@record(eq=False)
class _Runs:
    """Runs of one parameter, a row an actuator, a column a run, nan where there is none."""

    actuators: list[str]
    places: Int[np.ndarray, "actuators runs"]  # rows of the history; -1 for none
    times: Float[np.ndarray, "actuators runs"]
    values: Float[np.ndarray, "actuators runs"]
    variances: Float[np.ndarray, "actuators runs"]  # of the fits


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
    What is assumed: the values of a healthy actuator scatter around its own mean independently from run to run, with
    the variance of the fits and one between runs that is the same in the whole fleet.

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
    names = _choose_parameters(fleet, parameters)
    threshold = choose_threshold(false_alarms, PER_RUNS, max(len(names), 1))
    rows, left_out = _select_rows(history, since)
    actuators = history.rows[LABEL].n_unique()
    tables: list[pl.DataFrame] = []
    alarms: list[Alarm] = []
    between: dict[str, Between] = {}
    longest = np.zeros(actuators, dtype=int)
    labels = {label: place for place, label in enumerate(history.rows[LABEL].unique(maintain_order=True))}
    for name in names:
        known = rows.filter(pl.col(name).is_finite() & pl.col(f"{name}_std").is_finite())
        if len(known) < len(rows):
            left_out[f"{name} not identified"] = len(rows) - len(known)
        batches = list(_batch_runs(known, name))
        spread = estimate_between_runs([(batch.values, batch.variances) for batch in batches])
        if spread is None:
            continue
        between[name] = spread
        for batch in batches:
            charts = chart_runs(batch.values, batch.variances + spread.std**2, threshold, dof=spread.dof)
            tables.append(_tabulate(batch, name, fleet.units[name], spread, charts, threshold))
            alarms += _list_alarms(batch, history, name, fleet.units[name], spread, charts, threshold)
            own = np.array([labels[label] for label in batch.actuators], dtype=int)
            longest[own] = np.maximum(longest[own], np.isfinite(batch.values).sum(axis=1))
    within = 2 * max(len(names), 1) * alarm_probabilities(threshold, max(int(longest.max(initial=0)) - 1, 0))
    return Drift(
        table=pl.concat(tables) if tables else pl.DataFrame(), alarms=_order_alarms(alarms), actuators=actuators,
        history=history, between=between, threshold=threshold, false_alarms=false_alarms,
        expected=float(np.minimum(within, 1.0)[np.maximum(longest - 1, 0)].sum()), left_out=left_out,
        missing="" if between else _explain_missing(history, rows),
    )  # fmt: skip


def estimate_between_runs(
    runs: Sequence[tuple[Float[np.ndarray, "actuators runs"], Float[np.ndarray, "actuators runs"]]],
) -> Between | None:
    """Return how much values differ from run to run beyond the variances of their fits; None of too few runs.

    Parameters
    ----------
    runs : sequence of (values, variances)
        A row an actuator in the order of time, nan where there is no run.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> values = rng.normal(size=(50, 1)) + 0.3 * rng.normal(size=(50, 40)) + 0.4 * rng.normal(size=(50, 40))
    >>> round(estimate_between_runs([(values, np.full((50, 40), 0.3**2))]).std, 2)
    0.39

    """
    squares = np.concatenate([_select(np.diff(values, axis=1) ** 2) for values, _ in runs] or [np.zeros(0)])
    fits = np.concatenate([_select(variances[:, 1:] + variances[:, :-1]) for _, variances in runs] or [np.zeros(0)])
    if squares.size < FEWEST_PAIRS or not squares.any():
        return None
    expected = chi2.cdf(CLIP_SQUARE, 3) + CLIP_SQUARE * chi2.sf(CLIP_SQUARE, 1)  # of a clipped square, if normal

    def exceed(variance: float) -> float:
        ratios = squares / np.maximum(2.0 * variance + fits, 1e-300)
        return float(np.mean(np.minimum(ratios, CLIP_SQUARE)) - expected)

    largest = float(squares.max())
    variance = 0.0 if exceed(0.0) <= 0.0 else _find_root(exceed, largest)
    return Between(std=variance**0.5, pairs=squares.size, dof=_count_freedom(fits, variance))


def _find_root(function: Callable[[float], float], largest: float) -> float:
    """Return where a falling function is zero, between zero and `largest`."""
    solver: Any = brentq
    return float(solver(function, 0.0, largest, xtol=1e-12 * largest))


def _count_freedom(fits: Float[np.ndarray, " n"], variance: float) -> float:
    """Return the degrees of freedom of a run's variance, from the sampling variance of the clipped mean square.

    Differences that share a run are correlated by -1/2, their squares by 1/4: half as much again as if they were not.
    """
    second = 3.0 * chi2.cdf(CLIP_SQUARE, 5) + CLIP_SQUARE**2 * chi2.sf(CLIP_SQUARE, 1)
    first = chi2.cdf(CLIP_SQUARE, 3) + CLIP_SQUARE * chi2.sf(CLIP_SQUARE, 1)
    slope = np.mean(2.0 / (2.0 * variance + fits)) * chi2.cdf(CLIP_SQUARE, 3)
    sampling = 1.5 * (second - first**2) / fits.size / slope**2
    return float(2.0 * (variance + np.median(fits) / 2.0) ** 2 / sampling)


def _select(values: Float[np.ndarray, "..."]) -> Float[np.ndarray, " n"]:
    return values[np.isfinite(values)]


def _choose_parameters(fleet: Fleet, parameters: Sequence[str] | None) -> tuple[str, ...]:
    """Return what has a chart."""
    if parameters is None:
        return fleet.fitted or tuple(fleet.units)
    chosen = (parameters,) if isinstance(parameters, str) else tuple(parameters)
    for name in chosen:
        if name not in fleet.units:
            raise SeaoptError(f'parameters = "{name}" is no column of the fleet; {suggestion(name, fleet.units)}')
    return chosen


def _select_rows(history: History, since: str | float | None) -> tuple[pl.DataFrame, dict[str, int]]:
    """Return the logs that charts have, and how many are left out for which reason."""
    rows = history.rows.with_row_index(_PLACE)
    left_out: dict[str, int] = {}
    status = pl.col("status")
    conditions = [("failed", status != FAILED), ("not met", status == MET)]
    conditions.append(("without a time", pl.col(TIME).is_not_null()))
    if since is not None:
        conditions.append((f"before {since}", pl.col(TIME) >= parse_time(since, history)))
    for reason, condition in conditions:
        kept = rows.filter(condition)
        if len(kept) < len(rows):
            left_out[reason] = len(rows) - len(kept)
        rows = kept
    return rows, left_out


def _explain_missing(history: History, rows: pl.DataFrame) -> str:
    if not history.actuator or history.actuator == ("log",):
        hint = "name whose logs they are with --identity or --manifest"
    else:
        hint = f"an actuator is told by {join_words(history.actuator)}, the time by {history.source}"
    if len(rows) == rows[LABEL].n_unique():
        return f"no actuator has two logs that are met ({hint})"
    return f"fewer than {FEWEST_PAIRS} times one log of an actuator follows another ({hint})"


def _batch_runs(rows: pl.DataFrame, name: str) -> Iterator[_Runs]:
    """Yield the runs of a parameter, some actuators at once, those of about as many runs together."""
    own = rows.with_columns(pl.int_range(pl.len()).over(LABEL).alias(_RUN))
    counts = own.group_by(LABEL, maintain_order=True).len().sort("len", maintain_order=True)
    batch: list[str] = []
    for label, count in [*counts.iter_rows(), ("", 0)]:
        if batch and (not count or (len(batch) + 1) * count > CELLS):
            yield _pack(own.filter(pl.col(LABEL).is_in(batch)), batch, name)
            batch = []
        batch.append(label)


def _pack(rows: pl.DataFrame, actuators: list[str], name: str) -> _Runs:
    """Return runs as arrays."""
    index = {label: place for place, label in enumerate(actuators)}
    at = np.array([index[label] for label in rows[LABEL]]), rows[_RUN].to_numpy()
    shape = len(actuators), int(at[1].max()) + 1
    places, times, values, variances = np.full(shape, -1), *(np.full(shape, np.nan) for _ in range(3))
    places[at], times[at] = rows[_PLACE].to_numpy(), rows[TIME].to_numpy()
    values[at], variances[at] = rows[name].to_numpy(), rows[f"{name}_std"].to_numpy() ** 2
    return _Runs(actuators=actuators, places=places, times=times, values=values, variances=variances)


def _tabulate(batch: _Runs, name: str, unit: str, spread: Between, charts: Charts, threshold: float) -> pl.DataFrame:
    """Return the rows of a parameter in the table of trends."""
    with np.errstate(invalid="ignore", divide="ignore"):
        weights = np.nan_to_num(1.0 / (batch.variances + spread.std**2))
        total = weights.sum(axis=1)
        values, times = np.nan_to_num(batch.values), np.nan_to_num(batch.times)
        mean, middle = (weights * values).sum(axis=1) / total, (weights * times).sum(axis=1) / total
        away = weights * (times - middle[:, None])
        lever = (away * (times - middle[:, None])).sum(axis=1)
        slope, slope_std = (away * values).sum(axis=1) / lever, lever**-0.5
    runs, (first, last) = (
        np.isfinite(batch.values).sum(axis=1),
        (f(batch.times, axis=1) for f in (np.nanmin, np.nanmax)),
    )
    known = (runs >= FEWEST_OF_TREND) & (last > first)
    slope, slope_std = np.where(known, slope, np.nan), np.where(known, slope_std, np.nan)
    now = np.maximum(charts.upper[:, -1], charts.lower[:, -1]) / threshold
    return pl.DataFrame({
        "actuator": batch.actuators, "parameter": name, "unit": unit, "runs": runs, "first": first, "last": last,
        "mean": mean, "mean_std": total**-0.5, "slope": slope, "slope_std": slope_std, "change": slope * (last - first),
        "change_std": slope_std * (last - first), "level": now, "alarm": charts.alarm >= 0,
    })  # fmt: skip


def _list_alarms(
    batch: _Runs, history: History, name: str, unit: str, spread: Between, charts: Charts,
    threshold: float,
) -> list[Alarm]:  # fmt: skip
    """Return the alarms of a parameter."""
    alarms: list[Alarm] = []
    for own in np.flatnonzero(charts.alarm >= 0):
        raised, runs = int(charts.alarm[own]), int(np.isfinite(batch.values[own]).sum())
        weights = 1.0 / (batch.variances[own, :runs] + spread.std**2)
        rises = bool(charts.upper[own, raised] > charts.lower[own, raised])
        start, end, before, after = _measure_change(batch.values[own, :runs], weights, raised, rises=rises)
        first, then = (history.rows.row(int(batch.places[own, run]), named=True) for run in (start, raised))
        alarms.append(
            Alarm(
                actuator=batch.actuators[own],
                identity={column: str(first[column]) for column in history.actuator},
                parameter=name,
                unit=unit,
                since=first["log"],
                raised=then["log"],
                since_time=format_time(first[TIME], history.unit),
                raised_time=format_time(then[TIME], history.unit),
                begun=first[TIME],
                before=before,
                before_std=float(weights[:start].sum() ** -0.5),
                after=after,
                after_std=float(weights[start:end].sum() ** -0.5),
                runs=end - start,
                level=float(max(charts.upper[own].max(), charts.lower[own].max()) / threshold),
            )
        )
    return alarms


def _measure_change(
    values: Float[np.ndarray, " n"], weights: Float[np.ndarray, " n"], raised: int, *, rises: bool
) -> tuple[int, int, float, float]:
    """Return the runs of a change, first and one past the last, and the means before it and of these.

    They go on to the last run, unless the value has come back since, further than it was: then to the alarm.
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
    for one in alarms:
        worst[one.actuator] = max(worst.get(one.actuator, 0.0), one.level)
    return tuple(sorted(alarms, key=lambda one: (-worst[one.actuator], one.actuator, -one.level)))
