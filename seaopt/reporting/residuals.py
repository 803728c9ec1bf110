"""Figures of what is left over: residuals with their correlations, and the octaves in which fits differ."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from seaopt.estimation import Diagnostics, Experiment, Fit, Ranking
from seaopt.estimation.problem.correlation import CrossCorrelation
from seaopt.reporting.figures import MEASURED, PLANT_COLOURS, envelope, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BAND = "#f2d9c4"  # of what chance allows
ROW = 2.3  # inches


def residual_figure(fit: Fit, diagnostics: Diagnostics, name: str) -> Figure:
    """Draw, for each output of an experiment, the residual, its autocorrelation and its correlation with each input."""
    experiment = next(experiment for experiment in fit.experiments if experiment.name == name)
    outputs = diagnostics.outputs[name]
    figure, axes = panels(len(outputs), 3, ROW * len(outputs), sharex="col", width_ratios=(1.2, 0.8, 1.0))
    for (output, statistics), (left, middle, right) in zip(outputs.items(), axes, strict=True):
        _residual(left, experiment, diagnostics, output)
        left.set_ylabel(f"{output} [sigma]")
        lags = np.arange(statistics.autocorrelation.size)
        _band(middle, statistics.autocorrelation_bound)
        middle.vlines(lags[1:], 0.0, statistics.autocorrelation[1:], color=MEASURED, linewidth=1.6)
        _reach(middle, [statistics.autocorrelation[1:]], statistics.autocorrelation_bound)
        for (label, cross), colour in zip(statistics.inputs.items(), PLANT_COLOURS * 9, strict=False):
            _cross(right, label, cross, colour)
        _reach(right, [cross.values for cross in statistics.inputs.values()], 0.0)
    for axis, title in zip(
        axes[0],
        ("samples used: range of the residual", "correlation with itself", "correlation with inputs"),
        strict=True,
    ):
        axis.set_title(title, fontsize="medium")
    for axis, label in zip(axes[-1], ("time [s]", "lag [samples]", "lag [samples]"), strict=True):
        axis.set_xlabel(label)
    if axes[0, 2].get_legend_handles_labels()[1]:
        axes[0, 2].legend(frameon=False, fontsize="small", loc="upper right", ncols=3)
    return figure


def _residual(axis: Axes, experiment: Experiment, diagnostics: Diagnostics, output: str) -> None:
    log = experiment.log
    time = np.concatenate([log.time[piece] for piece in experiment.pieces]) - log.time[0]
    values = np.concatenate(diagnostics.residuals[experiment.name].weighted_of(output))
    low, high, at = envelope(np.where(values == 0.0, np.nan, values), time)
    axis.fill_between(at, low, high, color=MEASURED, linewidth=0.0)


def _band(axis: Axes, bound: float, colour: str = BAND) -> None:
    axis.axhspan(-bound, bound, color=colour, linewidth=0.0)
    axis.axhline(0.0, color="#444444", linewidth=0.6)


def _cross(axis: Axes, label: str, cross: CrossCorrelation, colour: str) -> None:
    _band(axis, cross.bound)
    axis.plot(cross.lags, cross.values, color=colour, linewidth=1.3, marker=".", markersize=3, label=label)
    if cross.outside:
        axis.axvline(cross.worst_lag, color=colour, linewidth=0.8, linestyle=":")


def _reach(axis: Axes, values: list[Any], bound: float) -> None:
    """Leave room for the values, and around the bound where they are small."""
    largest = max([bound, 1e-3, *(float(np.max(np.abs(row))) for row in values if row.size)])
    axis.set_ylim(-1.25 * largest, 1.25 * largest)


def ranking_figure(ranking: Ranking) -> Figure:
    """Draw the residual of every fit per octave, an output a panel."""
    outputs = list(dict.fromkeys((band.experiment, band.output) for band in ranking.bands))
    columns = min(2, len(outputs))
    figure, axes = panels(-(-len(outputs) // columns), columns, 2.8 * -(-len(outputs) // columns))
    for axis, (experiment, output) in zip(axes.ravel(), outputs, strict=False):
        bands = [band for band in ranking.bands if (band.experiment, band.output) == (experiment, output)]
        lows = [band.low_hz or band.high_hz / 2.0 for band in bands]
        edges = np.array([*lows, bands[-1].high_hz])
        for row, colour in zip(ranking.rows, PLANT_COLOURS * 9, strict=False):
            rms = np.sqrt([max(band.power[row.name], 1e-300) for band in bands])
            axis.stairs(rms, edges, color=colour, linewidth=1.8, label=row.name, baseline=None)
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_title(f"{experiment}: {output}", fontsize="medium")
        axis.set_ylabel(f"rms an octave [{bands[0].unit}]")
        axis.set_xlabel("frequency [Hz]")
    for axis in axes.ravel()[len(outputs) :]:
        axis.set_visible(False)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper left", frameon=False, ncols=4)
    return figure
