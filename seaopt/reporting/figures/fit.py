"""Figures of a fit and of a prediction: outputs, residuals, spectra, correlations, and the parameters' intervals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from seaopt import welch
from seaopt.errors import EstimationError
from seaopt.estimation import Diagnostics, Fit, ModelledOutputs
from seaopt.logs.quality.faults import find_runs
from seaopt.reporting.figures.panel import BAND, BLUE, COLOURS, LIMIT, MEASURED, Panel, draw_level, frequency_panel
from seaopt.reporting.figures.thinning import describe_thinning, thin_series
from seaopt.signals import VectorM, VectorN
from seaopt.units import unit_after

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WINDOW_S = 1.0  # of the stretch with the largest motion
SPECTRUM_WINDOWS = 8  # of the log, for a spectrum, that do not overlap
LONGEST_WINDOW = 4096  # samples
FEWEST_SAMPLES = 32  # of a spectrum
Z95 = 1.959964  # standard deviations of a 95 % interval


def label_channel(name: str, unit: str) -> str:
    """Return a channel with its unit in brackets, for an axis."""
    return f"{name} [{unit_after(unit).strip() or '-'}]"


def _label_outputs(prediction: ModelledOutputs) -> tuple[str, ...]:
    return tuple(label_channel(name, prediction.units[name]) for name in prediction.measured)


def outputs_panel(prediction: ModelledOutputs, span_s: tuple[float, float] | None = None) -> Panel:
    """Draw measured and model outputs from one time to another, seconds after the log's first sample. Without `span_s`:
    the second with the largest motion of the first output.
    """
    time = prediction.time - prediction.time[0]
    low, high = span_s if span_s is not None else _find_busiest(next(iter(prediction.measured.values())), time)
    near = (time >= low) & (time <= high)
    if np.count_nonzero(near) < 2:
        raise EstimationError(
            f"span_s = ({low:g}, {high:g}) has no two samples of {prediction.name}, which runs from 0 to "
            f"{time[-1]:g} s; give a longer one"
        )

    def draw(*axes: Axes) -> None:
        for axis, (name, measured) in zip(axes, prediction.measured.items(), strict=True):
            axis.plot(*thin_series(time[near], measured[near]), color=MEASURED, linewidth=2.2, label="measured")
            axis.plot(*thin_series(time[near], prediction.model[name][near]), color=BLUE, linewidth=1.0, label="model")

    where = "the second with the largest motion" if span_s is None else f"{low:g} to {high:g} s"
    percents = ", ".join(f"{name} {percent:.2f} %" for name, percent in prediction.fit_percent.items())
    return Panel(
        name=f"outputs_{prediction.name}",
        title=f"{prediction.name}: measured and model",
        draw=draw,
        x="time [s]",
        y=_label_outputs(prediction),
        tight=True,
        heights=_stack(len(prediction.measured)),
        link=f"time {prediction.name}",
        caption=f"Measured and model outputs over {where}; fit over the whole log: {percents}. "
        + describe_thinning(int(np.count_nonzero(near))),
    )


def _find_busiest(values: VectorN, time: VectorN) -> tuple[float, float]:
    """Return the ends of the second about the sample farthest from the mean."""
    usable = np.where(np.isfinite(values), np.abs(values - np.nanmean(values)), 0.0)
    centre = float(time[int(np.argmax(usable))])
    centre = float(np.clip(centre, WINDOW_S / 2, max(time[-1] - WINDOW_S / 2, WINDOW_S / 2)))
    return centre - WINDOW_S / 2, centre + WINDOW_S / 2


def residuals_panel(prediction: ModelledOutputs) -> Panel:
    """Draw measured minus model over the whole log."""
    time = prediction.time - prediction.time[0]

    def draw(*axes: Axes) -> None:
        for axis, (name, measured) in zip(axes, prediction.measured.items(), strict=True):
            residual = thin_series(time, measured - prediction.model[name])
            axis.plot(*residual, color=MEASURED, linewidth=0.7, label="measured - model")
            for level in (-prediction.rms_residual[name], prediction.rms_residual[name]):
                draw_level(axis, level, "± rms")

    size = ", ".join(
        f"{name} {rms:.3g}{unit_after(prediction.units[name])}" for name, rms in prediction.rms_residual.items()
    )
    return Panel(
        name=f"residuals_{prediction.name}",
        title=f"{prediction.name}: residual",
        draw=draw,
        x="time [s]",
        y=_label_outputs(prediction),
        tight=True,
        heights=_stack(len(prediction.measured)),
        link=f"whole {prediction.name}",
        caption=f"Measured minus model over the whole log; root mean square: {size}. {describe_thinning(time.size)}",
    )


def spectrum_panel(prediction: ModelledOutputs) -> Panel:
    """Draw the spectral density of what was measured and of the residual, by Welch's method."""
    period = float(np.median(np.diff(prediction.time)))

    def draw(*axes: Axes) -> None:
        for axis, (name, measured) in zip(axes, prediction.measured.items(), strict=True):
            residual = measured - prediction.model[name]
            for values, colour, label in ((measured, MEASURED, "measured"), (residual, BLUE, "measured - model")):
                axis.plot(*amplitude_density(values, period), color=colour, linewidth=1.1, label=label)

    units = {name: unit_after(prediction.units[name]).strip() or "1" for name in prediction.measured}
    return frequency_panel(
        name=f"spectrum_{prediction.name}",
        title=f"{prediction.name}: spectra",
        draw=draw,
        y=tuple(label_channel(name, f"{unit}/√Hz") for name, unit in units.items()),
        log="xy",
        tight=True,
        heights=_stack(len(prediction.measured)),
        caption="Amplitude spectral density of the measured output and of the residual (Welch, Hann window). "
        "The residual should be flat, as the sensor's noise is.",
    )


def amplitude_density(values: VectorN, period: float) -> tuple[VectorM, VectorM]:
    """Return frequencies and root power density of the longest whole run. Raises EstimationError: too short."""
    run = _find_longest_run(values)
    if run.size < FEWEST_SAMPLES:
        raise EstimationError(
            f"a run of {run.size} samples without a gap is too short for a spectrum; choose a longer part with slice_s"
        )
    length = min(max(run.size // SPECTRUM_WINDOWS, FEWEST_SAMPLES), LONGEST_WINDOW) // 2 * 2
    taper, starts = welch.hann(length), welch.list_starts([slice(0, run.size)], length)
    spectra = welch.transform(np.stack([run[start : start + length] for start in starts]), taper)
    density = np.mean(welch.square(spectra), axis=0) * (2.0 * period / np.sum(taper**2))
    density[-1] *= 0.5  # the Nyquist frequency has no other side
    return np.fft.rfftfreq(length, period)[1:], np.sqrt(density[1:])


def _find_longest_run(values: VectorN) -> VectorM:
    """Return the longest run of finite samples."""
    runs = find_runs(np.isfinite(values))
    if not len(runs):
        return values[:0]
    longest = int(np.argmax(runs.lengths))
    return values[runs.start[longest] : runs.stop[longest]]


def autocorrelation_panel(diagnostics: Diagnostics, experiment: str) -> Panel:
    """Draw the correlation of each output's weighted residual with itself."""

    def draw(*axes: Axes) -> None:
        for axis, output in zip(axes, diagnostics.outputs[experiment].values(), strict=True):
            values = output.autocorrelation[1:]
            lags = np.arange(1, values.size + 1)
            _shade(axis, output.autocorrelation_bound)
            axis.vlines(lags, 0.0, values, color=MEASURED, linewidth=1.6)
            axis.plot(lags, values, ".", color=MEASURED, markersize=3, label="residual with itself")
            _scale_correlation(axis, [values], output.autocorrelation_bound)

    return _lag_panel(
        diagnostics,
        experiment,
        name="autocorrelation",
        title="the residual's own correlation",
        draw=draw,
        caption="Correlation of the weighted residual with itself. Shaded: what one lag of a hundred exceeds by "
        "chance, were the residual white.",
    )


def input_correlation_panel(diagnostics: Diagnostics, experiment: str) -> Panel:
    """Draw the correlation of each output's weighted residual with each input."""

    def draw(*axes: Axes) -> None:
        for axis, output in zip(axes, diagnostics.outputs[experiment].values(), strict=True):
            for (label, cross), colour in zip(output.inputs.items(), COLOURS * 9, strict=False):
                _shade(axis, cross.bound)
                axis.plot(cross.lags, cross.values, color=colour, linewidth=1.2, marker=".", markersize=3, label=label)
            _scale_correlation(axis, [cross.values for cross in output.inputs.values()], 0.0)

    return _lag_panel(
        diagnostics,
        experiment,
        name="inputs",
        title="the residual against inputs",
        draw=draw,
        caption="Correlation of the weighted residual with the inputs. Shaded: what one lag of a hundred exceeds by "
        "chance. A residual that follows an input is something that the model lacks.",
    )


def _lag_panel(diagnostics: Diagnostics, experiment: str, *, name: str, title: str, draw: Any, caption: str) -> Panel:
    """Return a panel of correlations over lags, an axis per output."""
    outputs = diagnostics.outputs[experiment]
    return Panel(
        name=f"{name}_{experiment}",
        title=f"{experiment}: {title}",
        draw=draw,
        x="lag [samples]",
        y=tuple(f"{output} [-]" for output in outputs),
        heights=_stack(len(outputs)),
        link=f"lag {experiment}",
        caption=caption,
    )


def parameters_panel(fit: Fit) -> Panel:
    """Draw the 95 % interval of each free parameter in percent of its value, and what was known before."""
    free = [each for each in fit.parameters.values() if each.free and each.value and each.std and np.isfinite(each.std)]
    if not free:
        raise EstimationError("no free parameter has a standard deviation, so that there is no interval to draw")
    widths, before = (
        100.0 * Z95 * np.array([std or np.nan for std in stds]) / np.abs([parameter.value for parameter in free])
        for stds in ([parameter.std for parameter in free], [parameter.prior_std for parameter in free])
    )
    prior = np.isfinite(before)

    def draw(axis: Axes) -> None:
        rows = np.arange(len(free))[::-1]
        axis.hlines(rows, [1e-300], widths, color=BLUE, linewidth=1.0)
        axis.plot(widths, rows, "o", color=BLUE, markersize=6, label="95 % interval, fitted")
        if prior.any():
            look: dict[str, Any] = {
                "color": MEASURED,
                "fillstyle": "none",
                "markersize": 7,
                "label": "95 % interval, known before",
            }
            axis.plot(before[prior], rows[prior], "D", **look)
        axis.set_xlim(np.nanmin([widths, before]) / 3.0, np.nanmax([widths, before]) * 3.0)

    return Panel(
        name="parameters",
        hover="",
        title="How well the parameters are known",
        draw=draw,
        x="half of the 95 % interval [% of the value]",
        rows=[parameter.name for parameter in free],
        log="x",
        heights=(max(0.35 + 0.14 * len(free), 0.6),),
        caption="Half of each fitted parameter's 95 % interval, in percent of its value, on a logarithmic axis: the "
        "further left, the better known.",
    )


def correlation_panel(fit: Fit) -> Panel:
    """Draw the correlation of the free parameters' errors."""
    std = np.sqrt(np.diag(fit.covariance.matrix))
    identified = np.isfinite(std) & (std > 0.0)
    n = np.count_nonzero(identified)
    if n < 2:
        raise EstimationError("fewer than two parameters have a standard deviation: there is no correlation to draw")
    names = np.array(fit.covariance.names)[identified].tolist()
    matrix = fit.covariance.matrix[identified][:, identified] / np.outer(std[identified], std[identified])

    def draw(axis: Axes) -> None:
        axis.imshow(matrix, cmap="RdBu_r", vmin=-1.0, vmax=1.0, aspect="auto", interpolation="nearest")
        axis.set_xticks(range(n), names)
        axis.set_yticks(range(n), names)
        axis.grid(visible=False)
        axis.tick_params(length=0)
        for (row, column), value in np.ndenumerate(matrix):
            colour = "white" if abs(value) > 0.7 else "black"
            axis.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=8, color=colour)

    return Panel(
        name="correlation",
        hover="",
        title="Correlation of the parameters' errors",
        draw=draw,
        heights=(float(np.clip(0.35 + 0.16 * n, 0.7, 2.4)),),
        caption="Correlation coefficients of the fitted parameters' errors. Near ±1 the logs tell a combination of the "
        "two, not each by itself.",
    )


def _stack(count: int) -> tuple[float, ...]:
    """Return the heights of so many axes in a panel: smaller where there are several."""
    return (1.0,) if count == 1 else (0.75,) * count


def _shade(axis: Axes, bound: float) -> None:
    axis.axhspan(-bound, bound, color=BAND, linewidth=0.0)
    axis.axhline(0.0, color=LIMIT, linewidth=0.6)


def _scale_correlation(axis: Axes, values: list[Any], bound: float) -> None:
    """Leave room for the values, and around the bound where they are small."""
    largest = max([bound, 1e-3, *(float(np.max(np.abs(row))) for row in values if row.size)])
    axis.set_ylim(-1.25 * largest, 1.25 * largest)
