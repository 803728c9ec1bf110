"""Findings: each fault of a log with its number, its place and a sentence that says what to do."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np

from seaopt.formatting import format_count, format_figure, format_key
from seaopt.logs.quality.channel import BEYOND, ChannelQuality
from seaopt.logs.quality.clock import JITTER_LIMIT, ClockQuality, advise_clock, measure_steps
from seaopt.logs.quality.excitation import InputExcitation
from seaopt.logs.quality.faults import RowRanges
from seaopt.logs.quality.lags import ChannelPair
from seaopt.records import record
from seaopt.signals import SAME_SIGN, VectorN

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
MOTIONS = ("m", "rad", "m/s", "rad/s")  # units of what stands still where its link is held
MAX_PLACES = 20  # that a finding lists
COARSE_LEVELS, FINE_LEVELS = 32, 4096  # in a channel's range: a warning below the one, no finding above the other
MOST_BRIDGED = 50  # missing samples in a row of a device with times of its own
PART = 0.1  # of a log: where no more of it is without holes, they are everywhere
LEAST_CORRELATION = 0.3  # correlation above which a lag is one
SURELY_AHEAD = 0.5  # above which an output that is ahead is no chance: a place that drifts is 0.4 ahead of its input


@record
class Finding:
    """One thing that a log's user should know.

    Parameters
    ----------
    kind : str
        For programs: "gap", "clipping", ...
    severity : "error", "warning" or "note"
        A fit refuses the log or is wrong; look at it; for information.
    channel : str
        "" for the clock; "F1, F2" for a pair.
    count : int
        How many samples, runs or lines.
    value : float
        The number that goes with it, in `unit`.
    unit : str
    where_s : tuple of (float, float)
        First places, from and to, in s of the log's time.
    sentence : str
        What it is and what to do.
    keys : tuple of dict
        The same remedy in a problem file: keys of an [[experiment]], each set by itself enough.
    """

    kind: str
    severity: Severity
    sentence: str
    channel: str = ""
    count: int = 0
    value: float = 0.0
    unit: str = ""
    where_s: tuple[tuple[float, float], ...] = ()
    keys: tuple[dict[str, Any], ...] = ()


def find_clock_faults(clock: ClockQuality, time: VectorN, channels: Iterable[ChannelQuality] = ()) -> Iterator[Finding]:
    """Yield what is wrong with the clock. Where devices write rows in turn, by what their channels lack, rounding of
    one clock is no explanation.
    """
    for kind, rows, what in (
        ("time_missing", clock.not_numbers, "no number as time; remove these rows"),
        ("backwards", clock.backwards, "a time before that of the row ahead; sort the rows, or cut the log there"),
        ("duplicate", clock.repeated, 'the time of the row ahead; keep one row of each: duplicates = "first"'),
    ):
        if rows.size:
            text = f"{format_count(rows.size, 'row')} of {clock.samples} with {what}"
            yield _locate(RowRanges(start=rows, stop=rows + 1), time, kind=kind, severity="error", sentence=text)
    share = clock.jitter_max / clock.period
    if share > JITTER_LIMIT:
        text = f"steps of time differ by up to {share:.0%} from the period of {clock.period:.4g} s"
        advice = (
            _advise_on_holes(each.missing, time) for each in channels if each.missing.samples not in (0, time.size)
        )
        in_turn = next((each for each in advice if "resample" in each), None)
        if clock.rounded_only and in_turn is None:
            text += f", which the rounding of the timestamps to {clock.rounding:.3g} s explains"
        else:
            text += f" (rms {clock.jitter_rms / clock.period:.1%})"
        remedy, keys = advise_clock(clock.period, rounded=clock.rounded_only)
        remedy, keys = (remedy, keys) if in_turn is None else (_say_join(in_turn), [in_turn])
        yield Finding(
            kind="jitter",
            severity="error",
            value=100.0 * share,
            unit="% of the period",
            sentence=f"{text}; {remedy}",
            keys=tuple(keys),
        )
    if clock.gaps.size:
        total, longest = int(np.sum(clock.lost)), int(np.max(clock.lost))
        yield _locate(
            RowRanges(start=clock.gaps - 1, stop=clock.gaps + 1),
            time,
            kind="gap",
            severity="warning",
            count=int(clock.gaps.size),
            value=float(total),
            unit="samples",
            sentence=f"{format_count(clock.gaps.size, 'gap')}, {format_count(total, 'sample')} lost, {longest} in the "
            'longest; a fit starts anew after each (gaps = "split")',
        )


def find_channel_faults(channel: ChannelQuality, time: VectorN, *, may_drive: bool) -> Iterator[Finding]:
    """Yield what is wrong with one channel; `may_drive`: it may be an input, as far as is known."""
    name, unit, missing, beyond = channel.name, channel.unit, channel.missing, channel.beyond
    fault = partial(_locate, time=time, channel=name)
    if missing.samples == time.size:
        text = f"{name} has no number in any sample; leave it out"
        yield fault(missing, kind="missing", severity="error", unit=unit, sentence=text)
    elif len(missing):
        text = (
            f"{name} lacks {format_count(missing.samples, 'sample')} of {time.size}; in an output they have no weight; "
            "an input must have none"
        )
        keys = _advise_on_holes(missing, time)
        if "resample" in keys:
            text += f": {_say_join(keys)}"
        else:
            text += f": cut the log to its longest part without, log.between({', '.join(map(str, keys['slice_s']))})"
        keys = (keys,)
        yield fault(missing, kind="missing", severity="warning", unit=unit, sentence=text, keys=keys)
    if beyond.size:
        count = format_count(beyond.size, "sample")
        text = (
            f"{name} has {count} beyond any sensor (above {BEYOND:g}): nothing else here counts them; set them to NaN"
        )
        yield fault(RowRanges(start=beyond, stop=beyond + 1), kind="beyond", severity="error", sentence=text)
    if missing.samples + beyond.size == time.size:
        return
    if channel.constant:
        advice = f"leave it out{' if the link is held' if unit in MOTIONS else ''}, or check its wiring"
        text = f"{name} is {format_figure(channel.low, unit)} throughout; {advice}"
        yield Finding(kind="constant", severity="warning", channel=name, value=channel.low, unit=unit, sentence=text)
        return
    if len(channel.stuck):
        longest = int(np.max(channel.stuck.lengths))
        text = (
            f"{name} stands still {format_count(len(channel.stuck), 'time')}, up to {longest} samples, where it "
            "otherwise changes: a sensor or a message that stopped, or a joint that stuck. If the joint stuck there, "
            "leave those samples, for a fit of friction needs them; else cut the log there, or set them to NaN"
        )
        if may_drive:
            typed = f"--input {shlex.quote(name)} (inputs=[{json.dumps(name, ensure_ascii=False)}])"
            text += f". An input that holds its value is named: {typed}"
        yield fault(channel.stuck, kind="stuck", severity="warning", unit=unit, sentence=text)
    for rail in channel.rails:
        edge = "largest" if rail.side == "high" else "least"
        share = f"{format_count(rail.runs.samples, 'sample')} ({rail.runs.samples / time.size:.2%})"
        text = f"{name} is flat at its {edge} value, {format_figure(rail.value, unit)}, for {share}"
        if rail.clear:
            text += ": it is clipped; a fit masks these samples of an output"
        else:
            text += ": clipped, or at rest there; if clipped, declare its range, "
            text += f"saturation = {{ {format_key(name)} = [low, high] }}"
        severity: Severity = "warning" if rail.clear else "note"
        yield fault(rail.runs, kind="clipping", severity=severity, value=rail.value, unit=unit, sentence=text)
    yield from _find_level_faults(channel)
    if (rows := channel.outliers).size:
        text = f"{format_count(rows.size, 'outlier')} in {name}; fit with loss=so.Huber(), or set them to NaN"
        yield fault(RowRanges(start=rows, stop=rows + 1), kind="outlier", severity="warning", sentence=text)
    losses = channel.counter
    if losses is not None and losses.rows.size:
        total = int(np.sum(losses.lost))
        counter = {"column": name} | (
            {"samples_per_count": losses.samples_per_count} if losses.samples_per_count > 1 else {}
        )
        spelt = ", ".join(f"{key}={json.dumps(value, ensure_ascii=False)}" for key, value in counter.items())
        text = (
            f"{name} counts, and skips at {format_count(losses.rows.size, 'place')}: {format_count(total, 'sample')} "
            f"lost that the clock does not show; read the log with counter=Counter({spelt}), which opens the gaps"
        )
        runs, keys = RowRanges(start=losses.rows, stop=losses.rows + 1), ({"counter": counter},)
        yield fault(runs, kind="gap", severity="error", value=float(total), unit="samples", sentence=text, keys=keys)
    if channel.hum is not None:
        lines = ", ".join(f"{line:g} Hz" for line in channel.hum.lines_hz)
        yield Finding(
            kind="hum",
            severity="warning",
            channel=name,
            count=len(channel.hum.lines_hz),
            value=channel.hum.rms,
            unit=unit,
            sentence=f"{name} hums with the mains at {lines}: {format_figure(channel.hum.rms, unit)} rms, "
            f"{max(channel.hum.over_floor_db):.0f} dB over the noise; ground and shield, or fit a band without it "
            "(band_hz)",
        )


def _advise_on_holes(missing: RowRanges, time: VectorN) -> dict[str, Any]:
    """Return the keys of a problem file for a log with missing samples: holes that are short and everywhere are
    bridged, else the log is cut.
    """
    start, stop = _find_longest_without(missing, time)
    longest = int(np.max(missing.lengths))
    if longest > MOST_BRIDGED or (stop - start) > PART * np.ptp(time):
        return {"slice_s": [start, stop]}
    step = np.diff(time)
    period = measure_steps(step[step > 0.0])[0]
    bridge_s = float(f"{(longest + 1.5) * period:.3g}")
    return {"resample": {"rate_hz": float(f"{1.0 / period:.6g}"), "bridge_s": bridge_s, "rule": {"readings": {}}}}


def _say_join(keys: Mapping[str, Any]) -> str:
    rate_hz, bridge_s = keys["resample"]["rate_hz"], keys["resample"]["bridge_s"]
    return (
        f"devices write at times of their own; log.resample(rate_hz={rate_hz:g}, bridge_s={bridge_s:g}, "
        "rule=Readings(), steps=[INPUTS]) joins what they have"
    )


def _find_longest_without(runs: RowRanges, time: VectorN) -> tuple[float, float]:
    """Return from where to where, in s of the log, the longest part reaches that none of the runs interrupts."""
    starts, stops = np.concatenate([[0], runs.stop]), np.concatenate([runs.start, [time.size]])
    longest = int(np.argmax(stops - starts))
    first, last = int(starts[longest]), int(stops[longest]) - 1
    begin = float(np.nanmin(time))
    # Rounded inwards, so that the samples beside are not in it.
    return np.ceil(1e6 * (time[first] - begin)) / 1e6, np.floor(1e6 * (time[last] - begin)) / 1e6


def _find_level_faults(channel: ChannelQuality) -> Iterator[Finding]:
    """Yield what is wrong with the levels that a channel takes."""
    if channel.held > 1:
        text = (
            f"{channel.name} repeats each value {channel.held} times: its own rate is lower than the log's; "
            'decimate, or use hold = "zero" for an input'
        )
        yield Finding(kind="held", severity="note", channel=channel.name, count=channel.held, sentence=text)
    levels = (channel.high - channel.low) / channel.quantum if channel.quantum else np.inf
    if channel.counter is None and levels < FINE_LEVELS:
        coarse = levels < COARSE_LEVELS
        step = format_figure(channel.quantum, channel.unit)
        text = f"{channel.name} moves in steps of {step}, {levels:.0f} over its range"
        yield Finding(
            kind="quantisation",
            severity="warning" if coarse else "note",
            channel=channel.name,
            value=channel.quantum,
            unit=channel.unit,
            sentence=text + "; use a finer range, or expect coloured residuals" * coarse,
        )


def find_pair_faults(pair: ChannelPair, period: float, driven: bool) -> Iterator[Finding]:
    """Yield what is wrong between two channels; `driven`: the first is an input of the second."""
    name = f"{pair.first}, {pair.second}"
    if {pair.first.casefold(), pair.second.casefold()} == set(SAME_SIGN) and pair.flipped:
        text = (
            f"{pair.second} has the opposite sign of {pair.first}; on the stand both are positive together: turn one "
            "around"
        )
        yield Finding(kind="sign", severity="error", channel=name, value=pair.correlation, sentence=text)
    samples = pair.lag_s / period
    if abs(pair.correlation) < LEAST_CORRELATION or abs(samples) < 0.25:
        return
    late, early = (pair.second, pair.first) if samples > 0 else (pair.first, pair.second)
    text = f"{late} follows {early} by {1e3 * abs(pair.lag_s):.3g} ms ({abs(samples):.2f} samples), correlation "
    text += f"{pair.correlation:.2f}" + (" (with the opposite sign)" if pair.correlation < 0.0 and not driven else "")
    severity: Severity = "note"
    if driven and pair.leads and samples < -1.5 and abs(pair.correlation) > SURELY_AHEAD:
        severity = "warning"
        text += "; an input cannot come after what it causes: align the channels"
    elif driven and samples > 0:
        text += "; that is the plant's own lag and any delay: let a fit tell them apart (delay_s free)"
    yield Finding(kind="delay", severity=severity, channel=name, value=pair.lag_s, unit="s", sentence=text)


def describe_excitation(excitation: InputExcitation) -> Finding:
    """Return which linear responses to an input the log shows."""
    usable = excitation.usable_hz
    return Finding(
        kind="excitation",
        severity="note" if usable else "warning",
        channel=excitation.channel,
        value=usable[1] if usable else 0.0,
        unit="Hz",
        sentence=excitation.sentence,
    )


def sort_findings(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return the findings, the most severe first."""
    return tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))


def count_findings(findings: Sequence[Finding]) -> Mapping[str, int]:
    """Return how many findings there are of each severity."""
    return {level: sum(finding.severity == level for finding in findings) for level in SEVERITIES}


def _locate(runs: RowRanges, time: VectorN, count: int | None = None, **fields: Any) -> Finding:
    """Return a finding with its first places, and the number of its samples where no other is counted."""
    pairs = zip(runs.start[:MAX_PLACES], runs.stop[:MAX_PLACES], strict=True)
    where_s = tuple((float(time[start]), float(time[stop - 1])) for start, stop in pairs)
    return Finding(count=runs.samples if count is None else count, where_s=where_s, **fields)
