"""Figures of a log and its quality: the clock, channels in time and in frequency with their faults, the excitation."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from seaopt.logs import Log, Quality, RawLog
from seaopt.logs.quality.clock import ClockQuality
from seaopt.logs.quality.faults import RowRanges
from seaopt.reporting.figures.fit import label_channel
from seaopt.reporting.figures.panel import BLUE, COLOURS, GREEN, MEASURED, ORANGE, PINK, VERMILION, Panel
from seaopt.reporting.figures.thinning import STRETCHES, break_at, describe_thinning, thin_series
from seaopt.reporting.sections.kinds.quality import describe_jitter
from seaopt.signals import RowsK, VectorM, VectorN
from seaopt.welch import MEAN_SQUARE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_MARKS = 200  # marks of a kind in a panel: more are a blur
DRAWN = 1e100  # the largest number that a figure's axes are laid out for


def log_panels(data: Log | RawLog, quality: Quality) -> list[Panel]:
    """Return the clock and the excitation, then each channel over time and its spectrum."""
    panels = [clock_panel(data, quality), excitation_panel(quality)]
    for name in quality.channels:
        panels += [channel_panel(data, quality, name), density_panel(quality, name)]
    return panels


def clock_panel(data: Log | RawLog, quality: Quality) -> Panel:
    """Draw the steps of time against the period, gaps as marks: they would flatten all else."""
    clock, time = quality.clock, data.time

    def draw(axis: Axes) -> None:
        step = np.diff(time)
        step = np.where(np.abs(step) > 3.0 * clock.period, np.nan, step)
        _draw_series(axis, time[1:], 1e3 * step, clock.gaps - 1, MEASURED, "step")
        axis.axhline(1e3 * clock.period, color=BLUE, linewidth=0.9, linestyle="--", label="period")
        _mark_gaps(axis, time, clock)
        _mark_lines(axis, time, np.concatenate([clock.repeated, clock.backwards]), VERMILION, "repeated or backwards")
        # A perfect clock is drawn as a line, not as its rounding.
        spread = max(1.2e3 * float(np.nanmax(np.abs(step - clock.period), initial=0.0)), 20.0 * clock.period)
        axis.set_ylim(1e3 * clock.period - spread, 1e3 * clock.period + spread)

    return Panel(
        name="clock",
        title=f"Clock: {describe_jitter(clock)}",
        draw=draw,
        x="time [s]",
        y=("step [ms]",),
        tight=True,
        link="log time",
        caption=f"Steps of time between samples. {describe_thinning(time.size)}",
    )


def excitation_panel(quality: Quality) -> Panel:
    """Draw how coherent the best output is with each input, band by band, and the band that identifies a model."""

    def draw(axis: Axes) -> None:
        axis.set_ylim(0.0, 1.05)
        if not quality.excitation:
            axis.text(0.5, 0.5, "no input, or too few samples", transform=axis.transAxes, ha="center", va="center")
        for (name, excitation), colour in zip(quality.excitation.items(), COLOURS * 9, strict=False):
            middle = [float(np.sqrt(band.low_hz * band.high_hz)) for band in excitation.bands]
            height = [band.coherence if band.coherence is not None else np.nan for band in excitation.bands]
            axis.plot(middle, height, color=colour, linewidth=1.3, drawstyle="steps-mid", label=name)
            if excitation.usable_hz is not None:
                label = f"{name}: band that identifies a model"
                axis.axvspan(*excitation.usable_hz, color=colour, alpha=0.12, linewidth=0.0, label=label)
        if quality.excitation and quality.spectra is not None:
            axis.set_xlim(0.8 * quality.spectra.frequency_hz[1], 1.1 * quality.spectra.frequency_hz[-1])

    return Panel(
        name="excitation",
        title="What the inputs excite",
        draw=draw,
        x="frequency [Hz]",
        y=("coherence [-]",),
        log="x" if quality.excitation else "",
        link="log frequency",
        caption="Coherence of the best output with the input, band by band; shaded: where a model can be identified.",
    )


def channel_panel(data: Log | RawLog, quality: Quality, name: str) -> Panel:
    """Draw one channel over time, with its faults marked."""
    channel, time = quality.channels[name], data.time
    values = np.clip(data.signals[name].values, -DRAWN, DRAWN)

    def draw(axis: Axes) -> None:
        _draw_series(axis, time, values, quality.clock.gaps, MEASURED, name)
        _mark_gaps(axis, time, quality.clock)
        _mark_spans(axis, time, channel.missing, BLUE, "missing")
        _mark_spans(axis, time, channel.stuck, PINK, "stuck")
        for rail in channel.rails:
            level = float(np.clip(rail.value, -DRAWN, DRAWN))
            axis.axhline(level, color=VERMILION, linewidth=1.0, linestyle="--", label="flat top")
        rows = channel.outliers[:MOST_MARKS]
        if rows.size:
            axis.plot(time[rows], values[rows], "o", color=GREEN, markersize=4, fillstyle="none", label="outlier")
        if channel.counter is not None:
            _mark_lines(axis, time, channel.counter.rows, ORANGE, "lost, by the counter")

    return Panel(
        name=f"channel_{name}",
        title=f"{name} over time",
        draw=draw,
        x="time [s]",
        y=(label_channel(name, channel.unit) if channel.unit else name,),
        tight=True,
        link="log time",
        caption=f"The channel {name} as logged, with what is wrong with it marked. {describe_thinning(time.size)}",
    )


def density_panel(quality: Quality, name: str) -> Panel:
    """Draw the spectral density of one channel, with the lines of the mains where they stand out."""
    channel, f, density = quality.channels[name], *_measure_density(quality, name)
    top = float(np.max(density, initial=0.0))
    empty = not np.isfinite(top) or top <= 0.0

    def draw(axis: Axes) -> None:
        if empty:
            axis.text(0.5, 0.5, "no spectrum", transform=axis.transAxes, ha="center", va="center")
            return
        axis.plot(f, np.maximum(density, 1e-12 * top), color=MEASURED, linewidth=0.9, label=name)
        axis.set_ylim(max(float(np.min(density)), 1e-6 * top) / 2.0, 3.0 * top)
        for line in channel.hum.lines_hz if channel.hum is not None else ():
            axis.axvline(line, color=VERMILION, linewidth=0.8, linestyle=":", label="mains")
        axis.set_xlim(0.8 * f[0], 1.1 * f[-1])

    return Panel(
        name=f"density_{name}",
        title=f"{name} in frequency",
        draw=draw,
        x="frequency [Hz]",
        y=(f"{name} [{channel.unit or '1'}/√Hz]",),
        log="" if empty else "xy",
        link="log frequency",
        caption=f"Amplitude spectral density of {name} (Welch, Hann window).",
    )


def _measure_density(quality: Quality, name: str) -> tuple[VectorM, VectorM]:
    """Return the frequencies above 0 Hz and the root of the power density there; empty without a spectrum."""
    spectra = quality.spectra
    if spectra is None or name not in spectra.channels:
        return np.zeros(0), np.zeros(0)
    n = 2 * (spectra.frequency_hz.size - 1)
    with np.errstate(over="ignore", invalid="ignore"):  # numbers near the largest float have no power
        density = np.sqrt(2.0 * spectra.power(name)[1:] * spectra.period / (MEAN_SQUARE * n))
    return spectra.frequency_hz[1:], density


def _draw_series(axis: Axes, time: VectorN, values: VectorN, gaps: RowsK, colour: str, label: str) -> None:
    """Draw a channel over time, with nothing across a gap."""
    gaps = gaps[(gaps > 0) & (gaps < time.size)] if gaps.size <= MOST_MARKS else gaps[:0]
    ends = [0, *gaps.tolist(), time.size]
    parts = [
        thin_series(time[first:last], values[first:last], max(2, STRETCHES * (last - first) // time.size))
        for first, last in pairwise(ends)
    ]
    starts = np.cumsum([part[0].size for part in parts])[:-1]
    times, kept = (np.concatenate([part[side] for part in parts]) for side in (0, 1))
    axis.plot(*break_at(times, kept, starts), color=colour, linewidth=0.8, label=label)


def _mark_spans(axis: Axes, time: VectorN, runs: RowRanges, colour: str, label: str) -> None:
    ends = time[runs.start[:MOST_MARKS]], time[runs.stop[:MOST_MARKS] - 1]
    for start, stop in np.stack(ends, axis=1).tolist():
        axis.axvspan(start, stop, color=colour, alpha=0.35, linewidth=1.0, label=label)


def _mark_gaps(axis: Axes, time: VectorN, clock: ClockQuality) -> None:
    _mark_spans(axis, time, RowRanges(start=clock.gaps - 1, stop=clock.gaps + 1), ORANGE, "gap")


def _mark_lines(axis: Axes, time: VectorN, rows: RowsK, colour: str, label: str) -> None:
    for at in time[rows[:MOST_MARKS]].tolist():
        axis.axvline(at, color=colour, linewidth=1.0, label=label)
