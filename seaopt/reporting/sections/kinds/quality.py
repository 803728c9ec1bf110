"""The quality of a log in words: what is wrong with it, and a row of figures per channel."""

from __future__ import annotations

from seaopt.formatting import MISSING, format_count, format_remedies, join_words
from seaopt.logs import Quality
from seaopt.logs.quality.channel import ChannelQuality
from seaopt.logs.quality.clock import ClockQuality
from seaopt.reporting.sections.data import Item, Section, Table

HEAD = ("channel", "unit", "low", "high", "std", "missing", "step", "stuck", "saturated", "outliers", "hum")


def describe(quality: Quality) -> list[Section]:
    """Return the findings, and the figures of every channel; faults that no channel has are left out."""
    clock = quality.clock
    size = f"{clock.samples} samples, {quality.duration_s:.6g} s at {clock.rate_hz:.6g} Hz, {describe_jitter(clock)}."
    rows = tuple(map(_format_channel, quality.channels.values()))
    table = Table(head=HEAD, rows=rows, align="<<".ljust(len(HEAD), ">"))
    return [
        Section(
            title=f"{quality.source}: {_count_faults(quality)}",
            part="logs",
            sentences=(size,),
            items=tuple(
                Item(severity=finding.severity, text=format_remedies(finding.sentence, finding.keys))
                for finding in quality.findings
            ),
        ),
        Section(title="Channels", part="logs", tables=(table,), remarks=quality.notes),
    ]


def _count_faults(quality: Quality) -> str:
    """Return whether a log can be fitted as it is, and how many findings say otherwise."""
    errors, warnings = (sum(each.severity == kind for each in quality.findings) for kind in ("error", "warning"))
    if not errors and not warnings:
        return "No problem found."
    counts = join_words([format_count(n, word) for n, word in ((errors, "error"), (warnings, "warning")) if n])
    return f"{counts}: " + ("correct them before a fit" if errors else "check them")


def describe_jitter(clock: ClockQuality) -> str:
    """Return the jitter of a clock, in shares of its period."""
    if clock.jitter_max <= 1e-6 * clock.period:
        return "no jitter"
    text = f"jitter {clock.jitter_rms / clock.period:.2%} rms, {clock.jitter_max / clock.period:.2%} at most"
    return text + (f" (timestamps rounded to {clock.rounding:.3g} s)" if clock.rounded_only else "")


def _format_channel(channel: ChannelQuality) -> tuple[str, ...]:
    counts = (channel.stuck.samples, channel.saturated, channel.outliers.size)
    return (
        channel.name,
        channel.unit or "-",
        f"{channel.low:.4g}",
        f"{channel.high:.4g}",
        f"{channel.std:.4g}",
        str(channel.missing.samples or MISSING),
        f"{channel.quantum:.3g}" if channel.quantum else MISSING,
        *(str(count or MISSING) for count in counts),
        f"{channel.hum.rms:.3g}" if channel.hum else MISSING,
    )
