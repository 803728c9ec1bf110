"""Figures (matplotlib, without its global state): measured against model, and the loop on every plant."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from seaopt.control import Controller, Loop
from seaopt.estimation import Fit, ModelledOutputs
from seaopt.frequency import Survey
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.reporting.comparison import survey_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MEASURED, MODEL = "#767676", "#0072b2"
PLANT_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00")
WINDOW_S = 1.0


def panels(rows: int, columns: int, height: float, **options: Any) -> tuple[Figure, Any]:
    """Return a figure of the page's width and its axes, with the report's grid."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for axis in axes.ravel():
        axis.grid(visible=True, which="both", color="#e4e4e4", linewidth=0.5)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def time_figure(prediction: ModelledOutputs, units: dict[str, str]) -> Figure:
    """Draw measured and model outputs over the second with the largest motion, and the residual of the whole log."""
    names = list(prediction.measured)
    figure, axes = panels(len(names), 2, 2.3 * len(names), sharex="col", width_ratios=(1, 1))
    time = prediction.time - prediction.time[0]
    centre = _busiest(prediction.measured[names[0]], time)
    near = (time >= centre - WINDOW_S / 2) & (time <= centre + WINDOW_S / 2)
    for row, name in enumerate(names):
        measured, model = prediction.measured[name], prediction.model[name]
        left, right = axes[row]
        left.plot(time[near], measured[near], color=MEASURED, linewidth=2.2, label="measured")
        left.plot(time[near], model[near], color=MODEL, linewidth=1.0, label="model")
        left.set_ylabel(f"{name} [{units[name]}]")
        low, high, at = envelope(measured - model, time)
        right.fill_between(at, low, high, color=MEASURED, linewidth=0.0)
        right.set_ylabel(f"residual [{units[name]}]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper left", frameon=False, ncols=2)
    for axis, title in zip(axes[0], ("largest motion", "whole log: range of measured - model"), strict=True):
        axis.set_title(title, fontsize="medium")
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    return figure


def _busiest(values: Float[np.ndarray, " n"], time: Float[np.ndarray, " n"]) -> float:
    usable = np.where(np.isfinite(values), np.abs(values - np.nanmean(values)), 0.0)
    centre = float(time[int(np.argmax(usable))])
    return float(np.clip(centre, WINDOW_S / 2, max(time[-1] - WINDOW_S / 2, WINDOW_S / 2)))


def envelope(values: Float[np.ndarray, " n"], time: Float[np.ndarray, " n"], bins: int = 400) -> tuple[Any, Any, Any]:
    """Return the least and the largest value of each of `bins` stretches, and their times."""
    edges = np.linspace(0, values.size, min(bins, values.size) + 1).astype(int)[:-1]
    low = np.fmin.reduceat(values, edges)
    high = np.fmax.reduceat(values, edges)
    return low, high, time[edges]


def _bode(axes: Iterable[Axes], f: Any, response: Any, phase_deg: Any, style: dict[str, Any]) -> None:
    magnitude, phase = axes
    magnitude.semilogx(f, 20 * np.log10(np.maximum(np.abs(response), 1e-12)), **style)
    phase.semilogx(f, phase_deg, **style)


def loop_figure(controller: Controller, plants: dict[str, tuple[Plant, ParameterSet]]) -> Figure:
    """Draw the open loop, the sensitivity and the tracking response on every plant."""
    figure, axes = panels(2, 2, 5.6, sharex=True)
    for (name, (plant, values)), colour in zip(plants.items(), PLANT_COLOURS * 9, strict=False):
        loop: Loop = controller.close(plant, values)
        grid = loop.grid()
        f = grid[(grid >= 0.05) & (grid < 0.999 * loop.plant.nyquist_hz)]
        style = {"color": colour, "linewidth": 1.3, "label": name}
        open_loop = loop.open_loop(f)
        _bode((axes[0, 0], axes[1, 0]), f, open_loop, np.degrees(np.unwrap(np.angle(open_loop))), style)
        axes[0, 1].semilogx(f, 20 * np.log10(np.abs(loop.sensitivity(f))), **style)
        axes[1, 1].semilogx(f, 20 * np.log10(np.maximum(np.abs(loop.tracking(f)), 1e-6)), **style)
    spec = controller.spec
    ms = spec.level("max_sensitivity")
    if ms is not None:
        axes[0, 1].axhline(20 * np.log10(ms), color="#444444", linestyle="-.", linewidth=0.9, label=f"Ms = {ms:g}")
    axes[1, 1].axhline(-3.0103, color="#444444", linestyle=":", linewidth=0.9, label="-3 dB")
    axes[1, 1].axvline(spec.bandwidth_hz, color="#444444", linestyle="--", linewidth=0.9, label="bandwidth asked")
    axes[1, 1].set_ylim(bottom=-30)
    axes[0, 0].set_ylim(-60, 60)
    titles = (("open loop L: magnitude [dB]", "sensitivity |S| [dB]"),
              ("open loop L: phase [deg]", f"tracking |{spec.measured}/F_ref| [dB]"))  # fmt: skip
    for row, pair in zip(axes, titles, strict=True):
        for axis, title in zip(row, pair, strict=True):
            axis.set_title(title, fontsize="medium")
    for axis in axes[1]:
        axis.set_xlabel("frequency [Hz]")
    handles: dict[str, Any] = {}
    for axis in axes.ravel():
        handles |= {str(line.get_label()): line for line in axis.lines if not str(line.get_label()).startswith("_")}
    columns = min(len(handles), 5)
    figure.legend(list(handles.values()), list(handles), loc="outside upper left", frameon=False, ncols=columns)
    return figure


def all_figures(
    fit: Fit | None,
    surveys: Mapping[str, Survey],
    controller: Controller | None,
    plants: dict[str, tuple[Plant, ParameterSet]],
) -> dict[str, Figure]:
    """Return every figure that the results allow, by file name; `surveys` are the fit's experiments in frequency."""
    out: dict[str, Figure] = {}
    for experiment in fit.experiments if fit is not None else ():
        assert fit is not None
        units = {name: experiment.plant.outputs[name] for name in experiment.outputs}
        out[f"time_{experiment.name}"] = time_figure(fit.predict(experiment), units)
        if experiment.name in surveys:
            measured = surveys[experiment.name]
            out[f"response_{experiment.name}"] = survey_figure(
                {experiment.name: measured}, fitted={experiment.name: (measured, fit)}
            )
    if controller is not None and plants:
        out["loop"] = loop_figure(controller, plants)
    return out
