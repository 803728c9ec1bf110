"""The quality report of a log: every fault in the data made visible before it becomes a wrong parameter.

It reads a `Log`, or a `Table` as a file holds it, whose time may repeat or run backwards. Nothing is changed.
"""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np

from seaopt.errors import LogError, suggestion
from seaopt.logs.channel import ChannelQuality, channel_of, moving
from seaopt.logs.clock import ClockQuality, clock_of
from seaopt.logs.excitation import Excitation, excitation
from seaopt.logs.findings import (
    Finding,
    channel_findings,
    clock_findings,
    counts,
    excitation_finding,
    ordered,
    pair_findings,
)
from seaopt.logs.log import Log
from seaopt.logs.pairs import Pair, pair
from seaopt.logs.spectra import Spectra, hum, spectra
from seaopt.logs.table import Table
from seaopt.records import record

SCHEMA = "seaopt/quality/1"
INPUTS = frozenset({"i", "fe1", "fe2", "u"})  # names of inputs, in any case
INPUT_UNITS = frozenset({"A", "V"})


@record(eq=False)
class Quality:
    """What is wrong with a log's data, and what they can tell; ``print(quality)`` is a report.

    Parameters
    ----------
    source : str
    duration_s : float
        From the first sample to the last.
    clock : ClockQuality
    channels : mapping of name to ChannelQuality
    inputs : tuple of str
        Channels that were taken as inputs.
    pairs : tuple of Pair
        Each input with each other channel, and the others with one another where they share a unit.
    excitation : mapping of input to Excitation
    spectra : Spectra or None
        From which hum, pairs and excitation come; None where no stretch is long enough.
    findings : tuple of Finding
        The gravest first.
    notes : tuple of str
        What was done to the log before.

    """

    source: str
    duration_s: float
    clock: ClockQuality
    channels: Mapping[str, ChannelQuality]
    inputs: tuple[str, ...]
    pairs: tuple[Pair, ...]
    excitation: Mapping[str, Excitation]
    spectra: Spectra | None
    findings: tuple[Finding, ...]
    notes: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether there is neither an error nor a warning."""
        return all(item.severity == "note" for item in self.findings)

    @property
    def summary(self) -> str:
        """Samples, length and rate in one line."""
        clock = self.clock
        return f"{clock.samples} samples, {self.duration_s:.6g} s at {clock.rate_hz:.6g} Hz, {jitter(clock)}"

    def of(self, kind: str, channel: str | None = None) -> tuple[Finding, ...]:
        """Return the findings of a kind, of one channel if given."""
        return tuple(item for item in self.findings if item.kind == kind and channel in (None, item.channel))

    def to_dict(self) -> dict[str, Any]:
        """Return the content of quality.json (schema seaopt/quality/1)."""
        clock = self.clock
        return {
            "schema": SCHEMA,
            "source": self.source,
            "samples": clock.samples,
            "duration_s": self.duration_s,
            "rate_hz": clock.rate_hz,
            "jitter": {
                "rms_s": clock.jitter_rms, "max_s": clock.jitter_max,
                "max_percent": 100.0 * clock.jitter_max / clock.period, "rounding_s": clock.rounding,
                "rounding_explains_it": clock.rounded_only,
            },
            "gaps": {
                "count": int(clock.gaps.size), "samples_lost": int(np.sum(clock.lost)),
                "longest_samples": int(np.max(clock.lost, initial=0)),
            },
            "duplicates": int(clock.repeated.size),
            "backwards": int(clock.backwards.size),
            "time_missing": int(clock.not_numbers.size),
            "channels": {name: _channel_dict(item) for name, item in self.channels.items()},
            "inputs": list(self.inputs),
            "pairs": [_fields(item) for item in self.pairs],
            "excitation": {
                name: {
                    "told_hz": item.told_hz, "sentence": item.sentence, "bands": [_fields(band) for band in item.bands],
                }
                for name, item in self.excitation.items()
            },
            "findings": [item.to_dict() for item in self.findings],
            "counts": dict(counts(self.findings)),
            "notes": list(self.notes),
        }  # fmt: skip

    def __repr__(self) -> str:
        lines = [f"Quality of {self.source}: {self.summary}"]
        lines += [f"  {note}" for note in self.notes]
        lines += [
            f"  {row}" for row in _aligned([CHANNEL_HEAD, *(channel_row(item) for item in self.channels.values())])
        ]
        lines += [f"  {item.severity}: {item.sentence}" for item in self.findings]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        head = "".join(f"<th>{html.escape(cell)}</th>" for cell in CHANNEL_HEAD)
        rows = [channel_row(item) for item in self.channels.values()]
        body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
        said = "".join(f"<li><b>{item.severity}</b>: {html.escape(item.sentence)}</li>" for item in self.findings)
        return (
            f"<p>{html.escape(self.source)}: {html.escape(self.summary)}</p>"
            f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table><ul>{said}</ul>"
        )


@np.errstate(over="ignore", invalid="ignore")  # numbers near the largest float have no std, and are reported as such
def quality(data: Log | Table, *, inputs: Sequence[str] | None = None) -> Quality:
    """Look for every fault in a log.

    Parameters
    ----------
    data : Log or Table
        `log.quality` is this with its defaults.
    inputs : sequence of str, optional
        Channels that drive the others. Left out: those named I, Fe1, Fe2 or u, or else those in A or V.

    Raises
    ------
    LogError
        An input is no channel, there is no channel, or time never increases.

    Examples
    --------
    >>> t = np.arange(4000) / 400
    >>> rng = np.random.default_rng(0)
    >>> log = Log.from_arrays(time=t, I=rng.normal(size=4000), F1=np.clip(rng.normal(size=4000), -1, 1))
    >>> [(item.kind, item.channel) for item in quality(log).findings if item.severity == "warning"][:2]
    [('clipping', 'F1'), ('clipping', 'F1')]

    """
    if not data.signals:
        raise LogError(f"{data.source}: holds no channel; name the columns to look at")
    for name in inputs or ():
        if name not in data.signals:
            raise LogError(
                f'{data.source}: inputs names "{name}", which is no channel; {suggestion(name, data.signals)}'
            )
    clock = clock_of(data.time, data.source)
    found = {name: channel_of(signal) for name, signal in data.signals.items()}
    found = {name: _against_others(item, found, data) for name, item in found.items()}
    varying = {name: data.signals[name].values for name, item in found.items() if _varies(item)}
    drives = tuple(inputs) if inputs is not None else _likely_inputs(found)
    seen = spectra(varying, _pieces(clock, len(data)), clock.period)
    if seen is not None:
        heard = {name: hum(seen, name, drives) for name in seen.channels}
        found = {name: replace(item, hum=heard.get(name)) for name, item in found.items()}
    pairs = _pairs(seen, drives, found)
    told = _excitations(seen, drives)
    findings = [*clock_findings(clock, data.time)]
    findings += [finding for item in found.values() for finding in channel_findings(item, data.time)]
    findings += [finding for item in pairs for finding in pair_findings(item, clock.period, item.first in drives)]
    findings += [excitation_finding(item) for item in told.values()]
    findings += _unjudged(drives, seen, data)
    finite = data.time[np.isfinite(data.time)]
    return Quality(
        source=data.source, duration_s=float(np.ptp(finite)), clock=clock, channels=found, inputs=drives, pairs=pairs,
        excitation=told, spectra=seen, findings=ordered(findings), notes=data.notes,
    )  # fmt: skip


def _varies(item: ChannelQuality) -> bool:
    return item.std > 0.0 and item.counter is None


def _against_others(item: ChannelQuality, found: Mapping[str, ChannelQuality], data: Log | Table) -> ChannelQuality:
    """Keep the runs of a channel as stuck during which another one moves."""
    others = [
        (data.signals[name].values, other.std)
        for name, other in found.items()
        if name != item.name and other.std > 0.0 and other.counter is None
    ]
    return replace(item, stuck=moving(item.stuck, others)) if len(item.stuck) else item


def _pieces(clock: ClockQuality, n: int) -> list[slice]:
    """Return the rows without a gap or a step backwards."""
    breaks = np.unique(np.concatenate([clock.gaps, clock.backwards, clock.not_numbers]))
    edges = [0, *breaks.tolist(), n]
    return [slice(a, b) for a, b in pairwise(edges) if b > a]


def _likely_inputs(found: Mapping[str, ChannelQuality]) -> tuple[str, ...]:
    active = [name for name, item in found.items() if _varies(item)]
    named = tuple(name for name in active if name.casefold() in INPUTS)
    return named or tuple(name for name in active if found[name].unit in INPUT_UNITS)


def _pairs(seen: Spectra | None, drives: Sequence[str], found: Mapping[str, ChannelQuality]) -> tuple[Pair, ...]:
    if seen is None:
        return ()
    rest = [name for name in seen.channels if name not in drives]
    wanted = [(first, second) for first in drives if first in seen.channels for second in rest]
    wanted += [(a, b) for a, b in combinations(rest, 2) if found[a].unit and found[a].unit == found[b].unit]
    named = {name.casefold(): name for name in rest}
    if "f1" in named and "f2" in named and not any(set(two) == {named["f1"], named["f2"]} for two in wanted):
        wanted.append((named["f1"], named["f2"]))
    agreed = [pair(seen, first, second) for first, second in wanted]
    return tuple(item for item in agreed if item is not None)


def _excitations(seen: Spectra | None, drives: Sequence[str]) -> dict[str, Excitation]:
    if seen is None:
        return {}
    rest = [name for name in seen.channels if name not in drives]
    told = {name: excitation(seen, name, rest) for name in drives if name in seen.channels}
    return {name: item for name, item in told.items() if item is not None}


def _unjudged(drives: Sequence[str], seen: Spectra | None, data: Log | Table) -> list[Finding]:
    """Return what could not be looked at, and why."""
    if seen is None:
        text = f"{len(data)} samples are too few for spectra: hum, delays, signs and excitation were not looked at"
        return [Finding(kind="unjudged", severity="note", sentence=text)]
    out: list[Finding] = []
    if not drives:
        text = "no channel is known to be an input: excitation and delays were not looked at; name it (inputs)"
        out.append(Finding(kind="unjudged", severity="note", sentence=text))
    return out


CHANNEL_HEAD = ("channel", "unit", "low", "high", "std", "missing", "step", "stuck", "saturated", "outliers", "hum")


def channel_row(item: ChannelQuality) -> tuple[str, ...]:
    """Return a channel's figures for people, in the order of CHANNEL_HEAD."""
    return (
        item.name, item.unit or "-", f"{item.low:.4g}", f"{item.high:.4g}", f"{item.std:.4g}",
        str(item.missing.samples), f"{item.quantum:.3g}" if item.quantum else "-", str(item.stuck.samples),
        str(item.saturated), str(item.outliers.size), f"{item.hum.rms:.3g}" if item.hum else "-",
    )  # fmt: skip


def jitter(clock: ClockQuality) -> str:
    """Return the clock's jitter for people."""
    if clock.jitter_max <= 1e-6 * clock.period:
        return "no jitter"
    said = f"jitter {clock.jitter_rms / clock.period:.2%} rms, {clock.jitter_max / clock.period:.2%} at most"
    return said + (f" (timestamps rounded to {clock.rounding:.3g} s)" if clock.rounded_only else "")


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _fields(item: Any) -> dict[str, Any]:
    return {name: getattr(item, name) for name in item.__dataclass_fields__}


def _channel_dict(item: ChannelQuality) -> dict[str, Any]:
    return {
        "unit": item.unit, "low": item.low, "high": item.high, "mean": item.mean, "std": item.std,
        "missing": item.missing.samples, "constant": item.constant, "quantisation": item.quantum, "held": item.held,
        "stuck": item.stuck.samples, "saturated": item.saturated,
        "rails": [
            {"side": rail.side, "value": rail.value, "samples": rail.runs.samples, "clear": rail.clear}
            for rail in item.rails
        ],
        "outliers": int(item.outliers.size),
        "hum": _fields(item.hum) if item.hum else None,
    }  # fmt: skip
