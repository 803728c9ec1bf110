"""The quality report of a log: every fault in the data made visible before it becomes a wrong parameter.

It reads a `Log`, or a `RawLog` as a file holds it, whose time may repeat or run backwards. Nothing is changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from seaopt.codec import check_agrees, read_fields, to_content
from seaopt.errors import LogError, suggestion
from seaopt.formatting import format_count
from seaopt.logs.quality.channel import ChannelQuality, assess_channel
from seaopt.logs.quality.clock import ClockQuality, assess_clock, split_rows
from seaopt.logs.quality.excitation import InputExcitation, assess_excitation, find_top
from seaopt.logs.quality.faults import RowRanges
from seaopt.logs.quality.findings import (
    Finding,
    count_findings,
    describe_excitation,
    find_channel_faults,
    find_clock_faults,
    find_pair_faults,
    sort_findings,
)
from seaopt.logs.quality.lags import ChannelPair, correlate_channels
from seaopt.logs.quality.spectra import FEWEST_WINDOWS, SHORTEST_WINDOW, Spectra, compute_spectra, find_hum
from seaopt.progress import Progress, count_off, divide, ignore
from seaopt.records import Result, Worded, record
from seaopt.signals import HOLDING_NAMES, INPUT_NAMES, INPUT_UNITS, SAME_SIGN, Recording, VectorN

QUALITY_SCHEMA = "seaopt/quality/1"
FILE, INSPECT_AGAIN = "quality.json", "inspect the log again"
CHANNELS, PAIRS = 0.6, 0.4  # of the time
MOVING_STD = 0.05  # of its standard deviation over the log: what makes a channel move during a run of another
MOST_FILLED = 1000  # samples of a gap: of a longer one the rows beside it are put together
MOST_PAIRED = 100  # outputs; of more only `SAME_SIGN` are correlated with each other
ENOUGH_SAMPLES = FEWEST_WINDOWS * SHORTEST_WINDOW  # for spectra, in one segment


@record(eq=False, repr=False)
class Quality(Result, Worded):
    """Faults of a log's data, and what they excite; ``print(quality)`` is a report.

    Parameters
    ----------
    source : str
    duration_s : float
        From the first sample to the last.
    clock : ClockQuality
    channels : mapping of name to ChannelQuality
    inputs : tuple of str
        Channels that were taken as inputs.
    pairs : tuple of ChannelPair
        Each input with each other channel, and the moving with one another where they share a unit.
    excitation : mapping of input to InputExcitation
    spectra : Spectra or None
        From which hum, pairs and excitation come; None where no segment is long enough, or it was read from a file.
    findings : tuple of Finding
        The most severe first.
    notes : tuple of str
        What was done to the log before.
    """

    json_keys = (
        *("met", "source", "duration_s", "clock", "channels", "inputs", "pairs", "excitation", "findings", "notes"),
    )

    source: str
    duration_s: float
    clock: ClockQuality
    channels: Mapping[str, ChannelQuality]
    inputs: tuple[str, ...]
    pairs: tuple[ChannelPair, ...]
    excitation: Mapping[str, InputExcitation]
    spectra: Spectra | None = None
    findings: tuple[Finding, ...]
    notes: tuple[str, ...] = ()

    @property
    def met(self) -> bool:
        """Whether no finding is an error."""
        return all(finding.severity != "error" for finding in self.findings)

    @property
    def ok(self) -> bool:
        """Whether there is neither an error nor a warning."""
        return all(finding.severity == "note" for finding in self.findings)

    def of(self, kind: str, channel: str | None = None) -> tuple[Finding, ...]:
        """Return the findings of a kind, of one channel if given."""
        return tuple(
            finding for finding in self.findings if finding.kind == kind and channel in (None, finding.channel)
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the content of quality.json (schema seaopt/quality/1)."""
        clock = self.clock
        return {
            "schema": QUALITY_SCHEMA,
            "samples": clock.samples,
            "rate_hz": clock.rate_hz,
            "jitter": {
                "rms_s": clock.jitter_rms,
                "max_s": clock.jitter_max,
                "max_percent": 100.0 * clock.jitter_max / clock.period,
                "rounding_s": clock.rounding,
                "rounding_explains_it": clock.rounded_only,
            },
            "gaps": {
                "count": int(clock.gaps.size),
                "samples_lost": int(np.sum(clock.lost)),
                "longest_samples": int(np.max(clock.lost, initial=0)),
            },
            "duplicates": int(clock.repeated.size),
            "backwards": int(clock.backwards.size),
            "time_missing": int(clock.not_numbers.size),
            "counts": dict(count_findings(self.findings)),
            **to_content(self),
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Quality:
        """Return the quality of a quality.json, without its spectra. Raises FileError: a field is missing or malformed,
        or contradicts another.
        """
        quality = cls(**read_fields(cls, content, FILE, remedy=INSPECT_AGAIN))
        check_agrees(content, quality.to_dict(), FILE, remedy=INSPECT_AGAIN)
        return quality


@np.errstate(over="ignore", invalid="ignore")  # numbers near the largest float have no std, and are reported as such
def assess_quality(data: Recording, *, inputs: Sequence[str] | None = None, progress: Progress = ignore) -> Quality:
    """Look for every fault in a log.

    Parameters
    ----------
    data : Log or RawLog
        `log.quality` is this with its defaults.
    inputs : sequence of str, optional
        Channels that drive the moving, and may hold a value. Left out: those named I, V, duty, goal, Fe1, Fe2 or u (a v
        only in V), or else those in A or V.
    progress : callable, optional
        Called before each channel (`seaopt.progress.Progress`).

    Raises
    ------
    LogError
        An input is not a channel, there is no channel, or time never increases.

    Examples
    --------
    >>> import seaopt as so
    >>> t = np.arange(4000) / 400
    >>> rng = np.random.default_rng(0)
    >>> log = so.Log.from_arrays(time=t, I=rng.normal(size=4000), F1=np.clip(rng.normal(size=4000), -1, 1))
    >>> [(finding.kind, finding.channel) for finding in log.quality.findings if finding.severity == "warning"][:2]
    [('clipping', 'F1'), ('clipping', 'F1')]
    """
    if not isinstance(getattr(data, "signals", None), Mapping):
        raise LogError(f"data = {repr(data)[:60]} is a {type(data).__name__}; give a Log")
    if not data.signals:
        raise LogError(f"{data.source}: holds no channel; name the columns to look at")
    for name in inputs or ():
        if name not in data.signals:
            raise LogError(
                f'{data.source}: inputs names "{name}", which is not a channel; {suggestion(name, data.signals)}'
            )
    clock = assess_clock(data.time, data.source)
    looking, correlating = divide(progress, CHANNELS, PAIRS)
    channels = {name: assess_channel(data.signals[name]) for name in count_off(list(data.signals), "channel", looking)}
    holding = {*(inputs or ()), *(name for name in channels if name.lower() in HOLDING_NAMES)}
    channels = {
        name: replace(channel, stuck=RowRanges() if name in holding else _find_stuck_runs(channel, channels, data))
        for name, channel in channels.items()
    }
    # A constant has no spectrum, and a counter one that means nothing.
    varying = {
        name: _drop_beyond(data.signals[name].values, channel) for name, channel in channels.items() if channel.varies
    }
    correlating("spectra and pairs of channels", 0.0)
    inputs = tuple(inputs) if inputs is not None else _likely_inputs(channels)
    segments = split_rows(np.unique(np.concatenate([clock.gaps, clock.backwards, clock.not_numbers])), len(data))
    spectra = None if clock.irregular else compute_spectra(varying, segments, clock.period)
    if spectra is not None:
        hums = {name: find_hum(spectra, name, inputs) for name in spectra.channels}
        channels = {name: replace(channel, hum=hums.get(name)) for name, channel in channels.items()}
    pairs = () if spectra is None else _correlate_pairs(spectra, inputs, channels)
    excitation = {} if spectra is None else _assess_inputs(spectra, inputs, varying, clock)
    findings = [*find_clock_faults(clock, data.time, channels.values())]
    for channel in channels.values():
        may_drive = not inputs and channel.unit in ("", *INPUT_UNITS)
        findings += find_channel_faults(channel, data.time, may_drive=may_drive)
    findings += [finding for pair in pairs for finding in find_pair_faults(pair, clock.period, pair.first in inputs)]
    findings += [describe_excitation(bands) for bands in excitation.values()]
    findings += _list_unjudged(inputs, spectra, [rows.stop - rows.start for rows in segments], clock)
    finite = data.time[np.isfinite(data.time)]
    progress(format_count(len(channels), "channel"), 1.0)
    return Quality(
        source=data.source,
        duration_s=float(np.ptp(finite)),
        clock=clock,
        channels=channels,
        inputs=inputs,
        pairs=pairs,
        excitation=excitation,
        spectra=spectra,
        findings=sort_findings(findings),
        notes=data.notes,
    )


def _drop_beyond(values: VectorN, channel: ChannelQuality) -> VectorN:
    """Return a channel's samples without those that no sensor gives."""
    if not channel.beyond.size:
        return values
    tame = values.copy()
    tame[channel.beyond] = np.nan
    return tame


def _find_stuck_runs(channel: ChannelQuality, channels: Mapping[str, ChannelQuality], data: Recording) -> RowRanges:
    """Return the runs of a channel's equal samples during which another channel moves; all where there is no other."""
    moving = [
        (data.signals[name].values, other.std)
        for name, other in channels.items()
        if other.varies and other is not channel
    ]
    runs = channel.stuck
    if not moving:
        return runs

    def moves(start: int, stop: int) -> bool:
        windows = [(values[start:stop], std) for values, std in moving]
        return any(np.nanstd(part) > MOVING_STD * std for part, std in windows if np.any(np.isfinite(part)))

    pairs = zip(runs.start.tolist(), runs.stop.tolist(), strict=True)
    return runs.where(np.array([moves(start, stop) for start, stop in pairs], dtype=bool))


def _likely_inputs(channels: Mapping[str, ChannelQuality]) -> tuple[str, ...]:
    active = {name: channel for name, channel in channels.items() if channel.varies}
    named = tuple(name for name in active if name.casefold() in INPUT_NAMES and not _is_speed(active[name]))
    return named or tuple(name for name, channel in active.items() if channel.unit in INPUT_UNITS)


def _is_speed(channel: ChannelQuality) -> bool:
    """Tell whether a v is not a voltage: by its unit, and without one as a small letter."""
    return channel.name.casefold() == "v" and channel.unit != "V" and (channel.name == "v" or bool(channel.unit))


def _correlate_pairs(
    spectra: Spectra, inputs: Sequence[str], channels: Mapping[str, ChannelQuality]
) -> tuple[ChannelPair, ...]:
    """Correlate inputs with outputs, and outputs of one unit, or of the same sign by their names, with each other."""
    outputs = [name for name in spectra.channels if name not in inputs]
    wanted = [(first, second) for first in inputs if first in spectra.channels for second in outputs]
    if len(outputs) <= MOST_PAIRED:
        wanted += [
            (a, b) for a, b in combinations(outputs, 2) if channels[a].unit and channels[a].unit == channels[b].unit
        ]
    named = {name.casefold(): name for name in outputs}
    alike = tuple(named[name] for name in SAME_SIGN if name in named)
    if len(alike) == 2 and alike not in wanted and alike[::-1] not in wanted:
        wanted.append(alike)
    pairs = [correlate_channels(spectra, first, second) for first, second in wanted]
    return tuple(pair for pair in pairs if pair is not None)


def _assess_inputs(
    spectra: Spectra, inputs: Sequence[str], values: Mapping[str, VectorN], clock: ClockQuality
) -> dict[str, InputExcitation]:
    outputs = [name for name in spectra.channels if name not in inputs]
    bands = {name: assess_excitation(spectra, name, outputs) for name in inputs if name in spectra.channels}
    return {
        name: each if each.peak_hz is None else replace(each, top_hz=_find_top(each, values, clock))
        for name, each in bands.items()
        if each is not None
    }


def _find_top(excitation: InputExcitation, values: Mapping[str, VectorN], clock: ClockQuality) -> float | None:
    """Return where the response is largest, by the lines of the whole log with its short gaps filled."""
    lost = np.where(clock.lost <= MOST_FILLED, clock.lost, 0)
    u, y = (
        np.insert(values[name], np.repeat(clock.gaps, lost), np.nan) for name in (excitation.channel, excitation.output)
    )
    return find_top(excitation, u, y, clock.period)


def _list_unjudged(
    inputs: Sequence[str], spectra: Spectra | None, lengths: Sequence[int], clock: ClockQuality
) -> list[Finding]:
    """Return what could not be looked at, and why; `lengths` are those of the segments between gaps."""
    total = sum(lengths)
    if clock.irregular:
        text = (
            "steps of time are too uneven for spectra: hum, delays, signs and excitation were not looked at; resample "
            "the log first"
        )
    elif spectra is None and total >= ENOUGH_SAMPLES and len(lengths) > 1:
        text = (
            f"{len(lengths) - 1} gaps leave segments of at most {max(lengths)} samples, too short for spectra: hum, "
            "delays, signs and excitation were not looked at; to bridge them resample the log with bridge_s"
        )
    elif spectra is None:
        text = f"{total} samples are too few for spectra: hum, delays, signs and excitation were not looked at"
    elif not inputs:
        text = "no channel is known to be an input: excitation and delays were not looked at; name it: --input NAME "
        text += '(inputs=["NAME"])'
    else:
        return []
    return [Finding(kind="unjudged", severity="note", sentence=text)]
