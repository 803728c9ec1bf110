"""Findings: each fault of a log with its number, its place and a sentence that says what to do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from seaopt.logs.channel import ChannelQuality
from seaopt.logs.clock import ClockQuality
from seaopt.logs.excitation import Excitation
from seaopt.logs.faults import Runs
from seaopt.logs.log import JITTER_LIMIT
from seaopt.logs.pairs import Pair
from seaopt.records import record

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
SHOWN = 20  # places that a finding lists
COARSE, FINE = 32, 4096  # levels in a channel's range: below the one a warning, above the other not worth a word
AGREED = 0.3  # correlation above which a lag is one


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

    """

    kind: str
    severity: Severity
    sentence: str
    channel: str = ""
    count: int = 0
    value: float = 0.0
    unit: str = ""
    where_s: tuple[tuple[float, float], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as plain data."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}


def clock_findings(clock: ClockQuality, time: Float[np.ndarray, " n"]) -> Iterator[Finding]:
    """Yield what is wrong with the clock."""
    for kind, rows, what in (
        ("time_missing", clock.not_numbers, "no number as time; remove these rows"),
        ("backwards", clock.backwards, "a time before that of the row ahead; sort the rows, or cut the log there"),
        ("duplicate", clock.repeated, "the time of the row ahead; keep one row of each"),
    ):
        if rows.size:
            text = f"{_some(rows.size, 'row')} of {clock.samples} with {what}"
            yield Finding(kind=kind, severity="error", count=int(rows.size), where_s=_rows(time, rows), sentence=text)
    share = clock.jitter_max / clock.period
    if share > JITTER_LIMIT:
        yield _jitter(clock, share)
    if clock.gaps.size:
        total, longest = int(np.sum(clock.lost)), int(np.max(clock.lost))
        yield Finding(
            kind="gap", severity="warning", count=int(clock.gaps.size), value=float(total), unit="samples",
            where_s=tuple((float(time[row - 1]), float(time[row])) for row in clock.gaps[:SHOWN]),
            sentence=f"{_some(clock.gaps.size, 'gap')}, {_some(total, 'sample')} lost, {longest} in the longest; a fit "
            "starts anew after each (gaps = \"split\")",
        )  # fmt: skip


def _jitter(clock: ClockQuality, share: float) -> Finding:
    said = f"steps of time stray up to {share:.0%} from the period of {clock.period:.4g} s"
    if clock.rounded_only:
        text = (
            f"{said}, which the rounding of the timestamps to {clock.rounding:.3g} s explains; call log.restamp() "
            '(resample = "restamp" in a problem file)'
        )
    else:
        rate = float(f"{clock.rate_hz:.3g}")
        text = f"{said} (rms {clock.jitter_rms / clock.period:.1%}); call log.resample(rate_hz={rate:g}) to fit it"
    return Finding(kind="jitter", severity="error", value=100.0 * share, unit="% of the period", sentence=text)


def channel_findings(found: ChannelQuality, time: Float[np.ndarray, " n"]) -> Iterator[Finding]:
    """Yield what is wrong with one channel."""
    name, n = found.name, time.size
    if len(found.missing):
        count = found.missing.samples
        text = (
            f"{name} has no number in any sample; leave it out"
            if count == n
            else f"{name} lacks {_some(count, 'sample')} of {n}; in an output they have no weight, in an input cut the "
            "log there (log.between)"
        )
        yield _runs("missing", "error" if count == n else "warning", found, found.missing, time, text)
        if count == n:
            return
    if found.constant:
        text = f"{name} is {_with(found.low, found.unit)} throughout; check its wiring, or leave it out"
        yield Finding(
            kind="constant", severity="warning", channel=name, value=found.low, unit=found.unit, sentence=text
        )
        return
    if len(found.stuck):
        longest = int(np.max(found.stuck.lengths))
        text = (
            f"{name} stands still {_some(len(found.stuck), 'time')}, up to {longest} samples, where it else changes: a "
            "sensor or a message that stopped; cut the log there, or set those samples to NaN"
        )
        yield _runs("stuck", "warning", found, found.stuck, time, text)
    yield from _rails(found, time)
    yield from _levels(found)
    if found.outliers.size:
        text = f"{_some(found.outliers.size, 'outlier')} in {name}; fit with loss=so.Huber(), or set them to NaN"
        yield Finding(
            kind="outlier", severity="warning", channel=name, count=int(found.outliers.size), sentence=text,
            where_s=_rows(time, found.outliers),
        )  # fmt: skip
    if found.counter is not None and found.counter.rows.size:
        rows, lost = found.counter.rows, int(np.sum(found.counter.lost))
        held = f", samples_per_count={found.counter.held}" if found.counter.held > 1 else ""
        text = (
            f"{name} counts, and skips at {_some(rows.size, 'place')}: {_some(lost, 'sample')} lost that the clock "
            f'does not show; read the log with counter=Counter(column="{name}"{held}), which opens the gaps'
        )
        yield Finding(
            kind="gap", severity="error", channel=name, count=int(rows.size), value=float(lost), unit="samples",
            where_s=_rows(time, rows), sentence=text,
        )  # fmt: skip
    if found.hum is not None:
        yield _hum(found)


def _rails(found: ChannelQuality, time: Float[np.ndarray, " n"]) -> Iterator[Finding]:
    name = found.name
    for rail in found.rails:
        edge = "largest" if rail.side == "high" else "least"
        count = f"{_some(rail.runs.samples, 'sample')} ({rail.runs.samples / time.size:.2%})"
        text = f"{name} is flat at its {edge} value, {_with(rail.value, found.unit)}, for {count}"
        text += (
            ": it is clipped; a fit masks these samples of an output"
            if rail.clear
            else f": clipped, or at rest there; if clipped, declare its range, saturation = {{ {name} = [low, high] }}"
        )
        severity: Severity = "warning" if rail.clear else "note"
        yield _runs("clipping", severity, found, rail.runs, time, text, value=rail.value)


def _levels(found: ChannelQuality) -> Iterator[Finding]:
    if found.held > 1:
        text = (
            f"{found.name} repeats each value {found.held} times: its own rate is lower than the log's; decimate, or "
        )
        text += 'use hold = "zero" for an input'
        yield Finding(kind="held", severity="note", channel=found.name, count=found.held, sentence=text)
    levels = (found.high - found.low) / found.quantum if found.quantum else np.inf
    if found.counter is None and levels < FINE:
        text = f"{found.name} moves in steps of {_with(found.quantum, found.unit)}, {levels:.0f} over its range"
        text += "; use a finer range, or expect coloured residuals" if levels < COARSE else ""
        yield Finding(
            kind="quantisation", severity="warning" if levels < COARSE else "note", channel=found.name,
            value=found.quantum, unit=found.unit, sentence=text,
        )  # fmt: skip


def _hum(found: ChannelQuality) -> Finding:
    assert found.hum is not None
    lines = ", ".join(f"{line:g} Hz" for line in found.hum.lines_hz)
    text = (
        f"{found.name} hums with the mains at {lines}: {_with(found.hum.rms, found.unit)} rms, "
        f"{max(found.hum.over_floor_db):.0f} dB over the noise; ground and shield, or fit a band without it (band_hz)"
    )
    return Finding(
        kind="hum", severity="warning", channel=found.name, count=len(found.hum.lines_hz), value=found.hum.rms,
        unit=found.unit, sentence=text,
    )  # fmt: skip


def pair_findings(found: Pair, period: float, driven: bool) -> Iterator[Finding]:
    """Yield what two channels say together; `driven` tells that the first is an input of the second."""
    name = f"{found.first}, {found.second}"
    if {found.first.casefold(), found.second.casefold()} == {"f1", "f2"} and found.flipped:
        text = (
            f"{found.second} has the opposite sign of {found.first}; on the stand both are positive together: turn one "
            "around"
        )
        yield Finding(kind="sign", severity="error", channel=name, value=found.correlation, sentence=text)
    samples = found.lag_s / period
    if abs(found.correlation) < AGREED or abs(samples) < 0.25:
        return
    late, early = (found.second, found.first) if samples > 0 else (found.first, found.second)
    text = f"{late} follows {early} by {1e3 * abs(found.lag_s):.3g} ms ({abs(samples):.2f} samples), correlation "
    text += f"{found.correlation:.2f}" + (" (with the opposite sign)" if found.correlation < 0.0 and not driven else "")
    severity: Severity = "note"
    if driven and found.leads and samples < -1.5:
        severity = "warning"
        text += "; an input cannot come after what it causes: align the channels"
    elif driven and samples > 0:
        text += "; that is the plant's own lag and any delay: let a fit tell them apart (delay_s free)"
    yield Finding(kind="delay", severity=severity, channel=name, value=found.lag_s, unit="s", sentence=text)


def excitation_finding(found: Excitation) -> Finding:
    """Return what an input can and cannot tell."""
    told = found.told_hz
    return Finding(
        kind="excitation", severity="note" if told else "warning", channel=found.channel,
        value=told[1] if told else 0.0, unit="Hz", sentence=found.sentence,
    )  # fmt: skip


def ordered(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return the findings, the gravest first."""
    return tuple(sorted(findings, key=lambda item: SEVERITIES.index(item.severity)))


def counts(findings: Sequence[Finding]) -> Mapping[str, int]:
    """Return how many findings there are of each severity."""
    return {level: sum(item.severity == level for item in findings) for level in SEVERITIES}


def _some(count: int, noun: str) -> str:
    return f"{count} {noun}" + ("" if count == 1 else "s")


def _with(value: float, unit: str) -> str:
    return f"{value:.4g} {unit}".rstrip()


def _rows(time: Float[np.ndarray, " n"], rows: Int[np.ndarray, " k"]) -> tuple[tuple[float, float], ...]:
    return tuple((float(time[row]), float(time[row])) for row in rows[:SHOWN])


def _runs(
    kind: str, severity: Severity, found: ChannelQuality, runs: Runs, time: Float[np.ndarray, " n"], text: str,
    value: float = 0.0,
) -> Finding:  # fmt: skip
    pairs = zip(runs.start[:SHOWN], runs.stop[:SHOWN], strict=True)
    return Finding(
        kind=kind, severity=severity, channel=found.name, count=runs.samples, value=value, unit=found.unit,
        where_s=tuple((float(time[a]), float(time[b - 1])) for a, b in pairs), sentence=text,
    )  # fmt: skip
