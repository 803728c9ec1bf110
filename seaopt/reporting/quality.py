"""The figure of a quality report: the clock, and every channel in time and in frequency with its faults marked."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from seaopt.logs import Log, Quality, Table
from seaopt.logs.quality.channel import ChannelQuality
from seaopt.logs.quality.clock import ClockQuality
from seaopt.logs.quality.faults import RowRanges
from seaopt.logs.quality.report import describe_jitter
from seaopt.reporting.drawing import write_figure
from seaopt.reporting.figures import envelope, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIGNAL_COLOUR = "#5b6570"
GAP_COLOUR, STUCK_COLOUR, MISSING_COLOUR, OUTLIER_COLOUR = "#e69f00", "#cc79a7", "#0072b2", "#009e73"
CLIPPED_COLOUR = HUM_COLOUR = "#d55e00"
MOST_MARKS = 200  # marks of a kind in a panel: more are a blur
DRAWN = 1e100  # the largest number that a figure's axes are laid out for
BINS = 600  # of time, each drawn as its least and largest value
PANEL_HEIGHT = 1.75  # inches


@np.errstate(over="ignore", invalid="ignore")  # numbers near the largest float have no power
def quality_figure(data: Log | Table, quality: Quality) -> Figure:
    """Draw the steps of time and the excitation on top, then each channel over time and its spectrum.

    Parameters
    ----------
    data : Log or Table
        What the report was made of.
    quality : Quality
        The report.

    """
    count = 1 + len(quality.channels)
    figure, axes = panels(count, 2, PANEL_HEIGHT * count + 0.6)
    time = data.time
    _draw_steps(axes[0, 0], time, quality)
    _draw_excitation(axes[0, 1], quality)
    for (left, right), channel in zip(axes[1:], quality.channels.values(), strict=True):
        _draw_in_time(left, time, data.signals[channel.name].values, channel, quality)
        _draw_in_frequency(right, channel, quality)
    for axis in axes[1:, 0]:
        axis.set_xlim(axes[0, 0].get_xlim())
    if quality.spectra is not None:
        for axis in axes[:, 1]:
            axis.set_xlim(0.8 * quality.spectra.frequency_hz[1], 1.1 * quality.spectra.frequency_hz[-1])
    axes[-1, 0].set_xlabel("time [s]")
    axes[-1, 1].set_xlabel("frequency [Hz]")
    handles: dict[str, Any] = {}
    for axis in axes.ravel():
        lines, labels = axis.get_legend_handles_labels()
        handles |= dict(zip(labels, lines, strict=True))
    if handles:
        figure.legend(
            list(handles.values()), list(handles), loc="outside upper left", frameon=False, ncols=min(len(handles), 7)
        )
    return figure


def write_quality_figure(data: Log | Table, quality: Quality, path: Path | str) -> list[Path]:
    """Draw a quality report to SVG and PNG.

    Parameters
    ----------
    data : Log or Table
        What the report was made of.
    quality : Quality
        The report.
    path : path
        Without suffix; ``.svg`` and ``.png`` are added.

    Returns
    -------
    list of Path
        The two files.

    Raises
    ------
    FileError
        The folder cannot be written.

    """
    return write_figure(quality_figure(data, quality), path)


def _draw_steps(axis: Axes, time: Float[np.ndarray, " n"], quality: Quality) -> None:
    """Draw the steps of time against the period, gaps as marks at the top: they would flatten all else."""
    clock, step = quality.clock, np.diff(time)
    step = np.where(np.abs(step) > 3.0 * clock.period, np.nan, step)
    _draw_range(axis, time[1:], 1e3 * step, clock.gaps - 1)
    axis.axhline(1e3 * clock.period, color=MISSING_COLOUR, linewidth=0.8, label="period")
    _mark_gaps(axis, time, clock)
    _mark_lines(axis, time, np.concatenate([clock.repeated, clock.backwards]), CLIPPED_COLOUR, "repeated or backwards")
    # A perfect clock is drawn as a line, not as its rounding.
    spread = max(1.2e3 * float(np.nanmax(np.abs(step - clock.period), initial=0.0)), 20.0 * clock.period)
    axis.set_ylim(1e3 * clock.period - spread, 1e3 * clock.period + spread)
    axis.set_ylabel("step [ms]")
    axis.set_title(f"clock: {describe_jitter(clock)}", fontsize="medium", loc="left")


def _draw_excitation(axis: Axes, quality: Quality) -> None:
    """Draw how coherent the best output is with each input, band by band, and the band that identifies a model."""
    axis.set_title("coherence of the best output with the input", fontsize="medium", loc="left")
    axis.set_ylim(0.0, 1.05)
    axis.set_xscale("log")
    if not quality.excitation:
        axis.text(0.5, 0.5, "no input, or too few samples", transform=axis.transAxes, ha="center", va="center")
        return
    for name, excitation in quality.excitation.items():
        middle = [float(np.sqrt(band.low_hz * band.high_hz)) for band in excitation.bands]
        height = [band.coherence if band.coherence is not None else np.nan for band in excitation.bands]
        axis.plot(middle, height, color=SIGNAL_COLOUR, linewidth=1.2, drawstyle="steps-mid")
        if excitation.usable_hz is not None:
            label = f"{name}: band that identifies a model"
            axis.axvspan(*excitation.usable_hz, color=MISSING_COLOUR, alpha=0.12, linewidth=0.0, label=label)


def _draw_in_time(
    axis: Axes,
    time: Float[np.ndarray, " n"],
    values: Float[np.ndarray, " n"],
    channel: ChannelQuality,
    quality: Quality,
) -> None:
    values = np.clip(values, -DRAWN, DRAWN)
    _draw_range(axis, time, values, quality.clock.gaps)
    _mark_gaps(axis, time, quality.clock)
    _mark_spans(axis, time, channel.missing, MISSING_COLOUR, "missing")
    _mark_spans(axis, time, channel.stuck, STUCK_COLOUR, "stuck")
    for rail in channel.rails:
        axis.axhline(
            float(np.clip(rail.value, -DRAWN, DRAWN)),
            color=CLIPPED_COLOUR,
            linewidth=1.0,
            linestyle="--",
            label="flat top",
        )
    rows = channel.outliers[:MOST_MARKS]
    if rows.size:
        axis.plot(time[rows], values[rows], "o", color=OUTLIER_COLOUR, markersize=4, fillstyle="none", label="outlier")
    if channel.counter is not None:
        _mark_lines(axis, time, channel.counter.rows, GAP_COLOUR, "lost, by the counter")
    axis.set_ylabel(f"{channel.name} [{channel.unit}]" if channel.unit else channel.name)


def _draw_range(
    axis: Axes, time: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"], gaps: Int[np.ndarray, " k"]
) -> None:
    """Draw the range of a channel over time, with nothing across a gap."""
    edges = [0, *(gaps.tolist() if gaps.size <= MOST_MARKS else []), time.size]
    for first, last in pairwise(edges):
        if last - first < 2:
            continue
        low, high, at = envelope(values[first:last], time[first:last], max(2, BINS * (last - first) // time.size))
        axis.fill_between(at, low, high, color=SIGNAL_COLOUR, linewidth=0.8)


def _mark_spans(axis: Axes, time: Float[np.ndarray, " n"], runs: RowRanges, colour: str, label: str) -> None:
    for start, stop in zip(
        time[runs.start[:MOST_MARKS]].tolist(), time[runs.stop[:MOST_MARKS] - 1].tolist(), strict=True
    ):
        axis.axvspan(start, stop, color=colour, alpha=0.35, linewidth=1.0, label=label)


def _mark_gaps(axis: Axes, time: Float[np.ndarray, " n"], clock: ClockQuality) -> None:
    _mark_spans(axis, time, RowRanges(start=clock.gaps - 1, stop=clock.gaps + 1), GAP_COLOUR, "gap")


def _mark_lines(
    axis: Axes, time: Float[np.ndarray, " n"], rows: Int[np.ndarray, " k"], colour: str, label: str
) -> None:
    for at in time[rows[:MOST_MARKS]].tolist():
        axis.axvline(at, color=colour, linewidth=1.0, label=label)


def _draw_in_frequency(axis: Axes, channel: ChannelQuality, quality: Quality) -> None:
    spectra = quality.spectra
    axis.set_xscale("log")
    axis.set_yscale("log")
    unit = channel.unit or "1"
    axis.set_ylabel(f"density [{unit}/√Hz]")
    if spectra is None or channel.name not in spectra.channels:
        axis.text(0.5, 0.5, "no spectrum", transform=axis.transAxes, ha="center", va="center")
        return
    f, n = spectra.frequency_hz[1:], 2 * (spectra.frequency_hz.size - 1)
    density = np.sqrt(2.0 * spectra.power(channel.name)[1:] * spectra.period / (0.375 * n))  # Hann's mean square is 3/8
    top = float(np.max(density))
    if not np.isfinite(top) or top <= 0.0:
        axis.text(0.5, 0.5, "no spectrum", transform=axis.transAxes, ha="center", va="center")
        return
    axis.plot(f, np.maximum(density, 1e-12 * top), color=SIGNAL_COLOUR, linewidth=0.9)
    axis.set_ylim(max(float(np.min(density)), 1e-6 * top) / 2.0, 3.0 * top)
    for line in channel.hum.lines_hz if channel.hum is not None else ():
        axis.axvline(line, color=HUM_COLOUR, linewidth=0.8, linestyle=":", label="mains")
