"""Figures of a fit and of a prediction: outputs, residuals, spectra, correlations, and the parameters' intervals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from seaopt.errors import EstimationError
from seaopt.estimation import Diagnostics, Experiment, Fit, ModelledOutputs
from seaopt.reporting.figures.panel import Panel
from seaopt.reporting.figures.thinning import describe_thinning, thin_series
from seaopt.units import unit_after

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WINDOW_S = 1.0  # of the stretch with the largest motion
SPECTRUM_STRETCHES = 8  # of the log, for a spectrum, that do not overlap
LONGEST_STRETCH = 4096  # samples
FEWEST_SAMPLES = 32  # of a spectrum
Z95 = 1.959964  # standard deviations of a 95 % interval


def label_channel(name: str, unit: str) -> str:
    """Return a channel with its unit in brackets, for an axis."""
    return f"{name} [{unit_after(unit).strip() or '-'}]"


def outputs_panel(prediction: ModelledOutputs, span_s: tuple[float, float] | None = None) -> Panel:
    """Draw measured and model outputs from one time to another, seconds after the log's first sample.

    Left out: the second with the largest motion of the first output.
    """
    names, time = list(prediction.measured), prediction.time - prediction.time[0]
    low, high = span_s if span_s is not None else find_busiest(prediction.measured[names[0]], time)
    near = (time >= low) & (time <= high)
    if np.count_nonzero(near) < 2:
        raise EstimationError(
            f"span_s = ({low:g}, {high:g}) has no two samples of {prediction.name}, which runs from 0 to "
            f"{time[-1]:g} s; give a longer one"
        )

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import BLUE, MEASURED

        for axis, name in zip(axes, names, strict=True):
            axis.plot(
                *thin_series(time[near], prediction.measured[name][near]),
                color=MEASURED,
                linewidth=2.2,
                label="measured",
            )
            axis.plot(*thin_series(time[near], prediction.model[name][near]), color=BLUE, linewidth=1.0, label="model")
            axis.set_ylabel(label_channel(name, prediction.units[name]))
            axis.margins(x=0.0)
        axes[-1].set_xlabel("time [s]")

    where = "the second with the largest motion" if span_s is None else f"{low:g} to {high:g} s"
    percents = ", ".join(f"{name} {percent:.2f} %" for name, percent in prediction.fit_percent.items())
    return Panel(
        name=f"outputs_{prediction.name}",
        title=f"{prediction.name}: measured and model",
        draw=draw,
        heights=_stack(len(names)),
        link=f"time {prediction.name}",
        caption=f"Measured and model outputs over {where}; fit over the whole log: {percents}. "
        + describe_thinning(int(np.count_nonzero(near))),
    )


def find_busiest(values: Float[np.ndarray, " n"], time: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Return the ends of the second about the sample farthest from the mean."""
    usable = np.where(np.isfinite(values), np.abs(values - np.nanmean(values)), 0.0)
    centre = float(time[int(np.argmax(usable))])
    centre = float(np.clip(centre, WINDOW_S / 2, max(time[-1] - WINDOW_S / 2, WINDOW_S / 2)))
    return centre - WINDOW_S / 2, centre + WINDOW_S / 2


def residuals_panel(prediction: ModelledOutputs) -> Panel:
    """Draw measured minus model over the whole log."""
    names, time = list(prediction.measured), prediction.time - prediction.time[0]

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import LIMIT, MEASURED

        for axis, name in zip(axes, names, strict=True):
            rest = prediction.measured[name] - prediction.model[name]
            axis.plot(*thin_series(time, rest), color=MEASURED, linewidth=0.7, label="measured - model")
            rms = prediction.rms_residual[name]
            for side in (-rms, rms):
                axis.axhline(side, color=LIMIT, linestyle="--", linewidth=0.8, label="± rms")
            axis.set_ylabel(label_channel(name, prediction.units[name]))
            axis.margins(x=0.0)
        axes[-1].set_xlabel("time [s]")

    size = ", ".join(
        f"{name} {rms:.3g}{unit_after(prediction.units[name])}" for name, rms in prediction.rms_residual.items()
    )
    return Panel(
        name=f"residuals_{prediction.name}",
        title=f"{prediction.name}: residual",
        draw=draw,
        heights=_stack(len(names)),
        link=f"whole {prediction.name}",
        caption=f"Measured minus model over the whole log; root mean square: {size}. {describe_thinning(time.size)}",
    )


def spectrum_panel(prediction: ModelledOutputs) -> Panel:
    """Draw the spectral density of what was measured and of the residual, by Welch's method."""
    names, period = list(prediction.measured), float(np.median(np.diff(prediction.time)))

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import BLUE, MEASURED, scale_log

        for axis, name in zip(axes, names, strict=True):
            measured, model = prediction.measured[name], prediction.model[name]
            for values, colour, label in (
                (measured, MEASURED, "measured"),
                (measured - model, BLUE, "measured - model"),
            ):
                f, density = amplitude_density(values, period)
                axis.plot(f, density, color=colour, linewidth=1.1, label=label)
            axis.set_ylabel(label_channel(name, f"{unit_after(prediction.units[name]).strip() or '1'}/√Hz"))
            axis.margins(x=0.0)
        scale_log(axes)
        scale_log(axes, "y")
        axes[-1].set_xlabel("frequency [Hz]")

    return Panel(
        name=f"spectrum_{prediction.name}",
        title=f"{prediction.name}: spectra",
        draw=draw,
        heights=_stack(len(names)),
        link="frequency",
        caption="Amplitude spectral density of what was measured and of what the model leaves (Welch, Hann window). "
        "What is left should be flat, as the sensor's noise is.",
    )


def amplitude_density(
    values: Float[np.ndarray, " n"], period: float
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Return frequencies above zero and the root of the power density there, of the longest run without a gap.

    Raises
    ------
    EstimationError
        It has too few samples.

    """
    from scipy.signal import welch  # deferred: 0.3 s

    run = longest_run(values)
    if run.size < FEWEST_SAMPLES:
        raise EstimationError(
            f"a run of {run.size} samples without a gap is too short for a spectrum; choose a longer stretch with "
            "slice_s"
        )
    length = min(max(run.size // SPECTRUM_STRETCHES, FEWEST_SAMPLES), LONGEST_STRETCH)
    f, power = welch(run, fs=1.0 / period, window="hann", nperseg=length, detrend="constant")
    return f[1:], np.sqrt(power[1:])


def longest_run(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
    """Return the longest run of finite samples."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.isfinite(values).astype(int), [0]])))
    runs = edges.reshape(-1, 2)
    if not runs.size:
        return values[:0]
    first, last = runs[int(np.argmax(runs[:, 1] - runs[:, 0]))]
    return values[first:last]


def autocorrelation_panel(diagnostics: Diagnostics, experiment: str) -> Panel:
    """Draw the correlation of each output's weighted residual with itself."""
    outputs = diagnostics.outputs[experiment]

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import MEASURED

        for axis, (name, one) in zip(axes, outputs.items(), strict=True):
            _shade(axis, one.autocorrelation_bound)
            lags = np.arange(1, one.autocorrelation.size)
            axis.vlines(lags, 0.0, one.autocorrelation[1:], color=MEASURED, linewidth=1.6)
            axis.plot(lags, one.autocorrelation[1:], ".", color=MEASURED, markersize=3, label="residual with itself")
            _reach(axis, [one.autocorrelation[1:]], one.autocorrelation_bound)
            axis.set_ylabel(f"{name} [-]")
        axes[-1].set_xlabel("lag [samples]")

    return Panel(
        name=f"autocorrelation_{experiment}",
        title=f"{experiment}: the residual's own correlation",
        draw=draw,
        heights=_stack(len(outputs)),
        link=f"lag {experiment}",
        caption="Correlation of the weighted residual with itself. Shaded: what one lag of a hundred exceeds by "
        "chance, were the residual white.",
    )


def input_correlation_panel(diagnostics: Diagnostics, experiment: str) -> Panel:
    """Draw the correlation of each output's weighted residual with each input."""
    outputs = diagnostics.outputs[experiment]

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import COLOURS

        for axis, (name, one) in zip(axes, outputs.items(), strict=True):
            for (label, cross), colour in zip(one.inputs.items(), COLOURS * 9, strict=False):
                _shade(axis, cross.bound)
                axis.plot(cross.lags, cross.values, color=colour, linewidth=1.2, marker=".", markersize=3, label=label)
            _reach(axis, [cross.values for cross in one.inputs.values()], 0.0)
            axis.set_ylabel(f"{name} [-]")
        axes[-1].set_xlabel("lag [samples]")

    return Panel(
        name=f"inputs_{experiment}",
        title=f"{experiment}: the residual against inputs",
        draw=draw,
        heights=_stack(len(outputs)),
        link=f"lag {experiment}",
        caption="Correlation of the weighted residual with the inputs. Shaded: what one lag of a hundred exceeds by "
        "chance. A residual that follows an input is something that the model lacks.",
    )


def parameters_panel(fit: Fit) -> Panel:
    """Draw the 95 % interval of each free parameter in percent of its value, and what was known before."""
    free = [one for one in fit.parameters.values() if one.free and one.value and one.std and np.isfinite(one.std)]
    if not free:
        raise EstimationError("no free parameter has a standard deviation, so that there is no interval to draw")

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import BLUE, MEASURED, scale_log

        (axis,) = axes
        places = np.arange(len(free))[::-1]
        axis.hlines(places, [1e-300], [_percent(one.std, one.value) for one in free], color=BLUE, linewidth=1.0)
        axis.plot(
            [_percent(one.std, one.value) for one in free],
            places,
            "o",
            color=BLUE,
            markersize=6,
            label="95 % interval, fitted",
        )
        before = [
            (place, _percent(one.prior_std, one.value))
            for place, one in zip(places, free, strict=True)
            if one.prior_std is not None
        ]
        if before:
            axis.plot(
                [width for _, width in before],
                [place for place, _ in before],
                "D",
                color=MEASURED,
                fillstyle="none",
                markersize=7,
                label="95 % interval, known before",
            )
        axis.set_yticks(places, [one.name for one in free])
        axis.set_ylim(-0.6, len(free) - 0.4)
        widths = [_percent(one.std, one.value) for one in free] + [width for _, width in before]
        axis.set_xlim(min(widths) / 3.0, max(widths) * 3.0)
        scale_log(axes)
        axis.grid(visible=False, axis="y")
        axis.set_xlabel("half of the 95 % interval [% of the value]")

    return Panel(
        name="parameters",
        hover="",
        title="How well the parameters are known",
        draw=draw,
        heights=(max(0.35 + 0.14 * len(free), 0.6),),
        caption="Half of each fitted parameter's 95 % interval, in percent of its value, on a logarithmic axis: the "
        "further left, the better known.",
    )


def _percent(std: float | None, value: float) -> float:
    return 100.0 * Z95 * (std or 0.0) / abs(value)


def correlation_panel(fit: Fit) -> Panel:
    """Draw the correlation of the free parameters' errors."""
    std = np.sqrt(np.diag(fit.covariance.matrix))
    known = np.isfinite(std) & (std > 0.0)
    if np.count_nonzero(known) < 2:
        raise EstimationError("fewer than two parameters have a standard deviation: there is no correlation to draw")
    names = [name for name, used in zip(fit.covariance.names, known, strict=True) if used]
    matrix = fit.covariance.matrix[known][:, known] / np.outer(std[known], std[known])

    def draw(axes: Sequence[Axes]) -> None:
        (axis,) = axes
        n = len(names)
        axis.imshow(matrix, cmap="RdBu_r", vmin=-1.0, vmax=1.0, aspect="auto", interpolation="nearest")
        axis.set_xticks(range(n), names)
        axis.set_yticks(range(n), names)
        axis.grid(visible=False)
        axis.tick_params(length=0)
        for row in range(n):
            for column in range(n):
                value = matrix[row, column]
                axis.text(
                    column,
                    row,
                    f"{value:.2f}",
                    ha="center",
                    va="center",
                    fontsize=8,
                    color="white" if abs(value) > 0.7 else "black",
                )

    return Panel(
        name="correlation",
        hover="",
        title="Correlation of the parameters' errors",
        draw=draw,
        heights=(float(np.clip(0.35 + 0.16 * len(names), 0.7, 2.4)),),
        caption="Correlation coefficients of the fitted parameters' errors. Near ±1 the logs tell a combination of the "
        "two, not each by itself.",
    )


def _stack(count: int) -> tuple[float, ...]:
    """Return the heights of so many axes in a panel: smaller where there are several."""
    return (1.0,) if count == 1 else (0.75,) * count


def _shade(axis: Axes, bound: float) -> None:
    from seaopt.reporting.figures.canvas import BAND, LIMIT

    axis.axhspan(-bound, bound, color=BAND, linewidth=0.0)
    axis.axhline(0.0, color=LIMIT, linewidth=0.6)


def _reach(axis: Axes, values: list[Any], bound: float) -> None:
    """Leave room for the values, and around the bound where they are small."""
    largest = max([bound, 1e-3, *(float(np.max(np.abs(row))) for row in values if row.size)])
    axis.set_ylim(-1.25 * largest, 1.25 * largest)


def choose_experiments(fit: Fit, experiment: str | None) -> tuple[Experiment, ...]:
    """Return the experiment of a name, or all of a fit's.

    Raises
    ------
    EstimationError
        There is none of that name, or the fit was read from a file without its logs.

    """
    if not fit.experiments:
        raise EstimationError("this fit was read from a file without its logs; Fit.from_dict(content, experiments)")
    chosen = tuple(one for one in fit.experiments if experiment in (None, one.name))
    if not chosen:
        known = ", ".join(one.name for one in fit.experiments)
        raise EstimationError(f'experiment = "{experiment}" is none of the fit\'s; give one of {known}')
    return chosen


PredictionPanel = Callable[[ModelledOutputs], Panel]
PREDICTION_PANELS: Mapping[str, PredictionPanel] = {
    "outputs": outputs_panel,
    "residuals": residuals_panel,
    "spectrum": spectrum_panel,
}
