"""Figures (matplotlib, without its global state): measured against model, and the loop on every plant."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from seaopt.control import Controller, Loop
from seaopt.errors import LogError
from seaopt.estimation import Experiment, Fit, Prediction
from seaopt.frequency import h1
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.simulation import Clock, linearised, make_model, transition

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MEASURED, MODEL = "#767676", "#0072b2"
PLANT_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00")
WINDOW_S = 1.0


def _figure(rows: int, columns: int, height: float, **options: Any) -> tuple[Figure, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for axis in axes.ravel():
        axis.grid(visible=True, which="both", color="#e4e4e4", linewidth=0.5)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def time_figure(prediction: Prediction, units: dict[str, str]) -> Figure:
    """Draw measured and model outputs over the second with the largest motion, and the residual of the whole log."""
    names = list(prediction.measured)
    figure, axes = _figure(len(names), 2, 2.3 * len(names), sharex="col", width_ratios=(1, 1))
    time = prediction.time - prediction.time[0]
    centre = _busiest(prediction.measured[names[0]], time)
    near = (time >= centre - WINDOW_S / 2) & (time <= centre + WINDOW_S / 2)
    for row, name in enumerate(names):
        measured, model = prediction.measured[name], prediction.model[name]
        left, right = axes[row]
        left.plot(time[near], measured[near], color=MEASURED, linewidth=2.2, label="measured")
        left.plot(time[near], model[near], color=MODEL, linewidth=1.0, label="model")
        left.set_ylabel(f"{name} [{units[name]}]")
        low, high, at = _envelope(measured - model, time)
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


def _envelope(values: Float[np.ndarray, " n"], time: Float[np.ndarray, " n"], bins: int = 400) -> tuple[Any, Any, Any]:
    edges = np.linspace(0, values.size, min(bins, values.size) + 1).astype(int)[:-1]
    low = np.fmin.reduceat(values, edges)
    high = np.fmax.reduceat(values, edges)
    return low, high, time[edges]


def response_figure(experiment: Experiment, parameters: ParameterSet, delay_s: float) -> Figure | None:
    """Draw the H1 estimate of every output over the model's response; None where the log does not allow one."""
    log, plant = experiment.log, experiment.plant
    active = [name for name in plant.inputs if name in log.signals and np.ptp(log[name]) > 0.0]
    if len(active) != 1 or len(log.segments) > 1:
        return None
    names = [name for name in experiment.outputs if np.all(np.isfinite(log[name]))]
    try:
        estimates = {name: h1(log[active[0]], log[name], log.period) for name in names}
    except LogError:
        return None
    if not estimates:
        return None
    figure, axes = _figure(2, len(estimates), 4.4, sharex=True)
    for column, (name, estimate) in enumerate(estimates.items()):
        good = estimate.coherence > 0.3
        f = estimate.frequency_hz[good]
        dense = np.geomspace(f[0], f[-1], 800)
        model = _sampled_response(plant, parameters, experiment, active[0], name, delay_s, dense)
        unit = f"{plant.outputs[name]}/{plant.inputs[active[0]]}"
        dots = {"color": MEASURED, "marker": ".", "markersize": 2.5, "linestyle": ""}
        line = {"color": MODEL, "linewidth": 1.3}
        phase = np.degrees(np.unwrap(np.angle(model)))
        # Measured phase is drawn on the branch nearest the model's: noise at a dip must not shift the rest by a turn.
        nearest = np.interp(f, dense, phase)
        turned = np.degrees(np.angle(estimate.response[good] * np.exp(-1j * np.radians(nearest)))) + nearest
        _bode(axes[:, column], f, estimate.response[good], turned, dots)
        _bode(axes[:, column], dense, model, phase, line)
        axes[0, column].set_title(f"{name}/{active[0]} [{unit}]", fontsize="medium")
        axes[1, column].set_xlabel("frequency [Hz]")
    labels = ("measured (H1, coherence above 0.3)", "model")
    figure.legend(axes[0, 0].lines[:2], labels, loc="outside upper left", frameon=False, ncols=2)
    axes[0, 0].set_ylabel("magnitude [dB]")
    axes[1, 0].set_ylabel("phase [deg]")
    return figure


def _sampled_response(
    plant: Plant, parameters: ParameterSet, experiment: Experiment, source: str, output: str, delay_s: float,
    f: Float[np.ndarray, " m"],
) -> Any:  # fmt: skip
    """Return the response from input samples to output samples of the plant linearised at rest."""
    model = linearised(make_model(plant, parameters, (), (output,)))
    clock = Clock(period=experiment.log.period, hold=experiment.hold, delay_s=delay_s)
    block = transition(model, np.zeros(0), clock)[0]
    nx, nu = model.nx, model.nu
    k = list(plant.inputs).index(source)
    z = np.exp(2j * np.pi * f * clock.period)
    lag_a, lag_b = clock.lags
    drive = z[:, None] ** -lag_a * block[:, nx + k] + z[:, None] ** -lag_b * block[:, nx + nu + k]
    inner = z[:, None, None] * np.eye(nx) - block[:nx, :nx]
    state = np.linalg.solve(inner, drive[:, :nx, None])[:, :, 0]
    return state @ block[nx, :nx] + drive[:, nx]


def _bode(axes: Iterable[Axes], f: Any, response: Any, phase_deg: Any, style: dict[str, Any]) -> None:
    magnitude, phase = axes
    magnitude.semilogx(f, 20 * np.log10(np.maximum(np.abs(response), 1e-12)), **style)
    phase.semilogx(f, phase_deg, **style)


def loop_figure(controller: Controller, plants: dict[str, tuple[Plant, ParameterSet]]) -> Figure:
    """Draw the open loop, the sensitivity and the tracking response on every plant."""
    figure, axes = _figure(2, 2, 5.6, sharex=True)
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
    if spec.max_sensitivity is not None:
        limit = 20 * np.log10(spec.max_sensitivity)
        axes[0, 1].axhline(
            limit, color="#444444", linestyle="-.", linewidth=0.9, label=f"Ms = {spec.max_sensitivity:g}"
        )
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
    figure.legend(list(handles.values()), list(handles), loc="outside upper left", frameon=False, ncols=len(handles))
    return figure


def all_figures(
    fit: Fit | None, controller: Controller | None, plants: dict[str, tuple[Plant, ParameterSet]]
) -> dict[str, Figure]:
    """Return every figure that the results allow, by file name."""
    out: dict[str, Figure] = {}
    for experiment in fit.experiments if fit is not None else ():
        assert fit is not None
        units = {name: experiment.plant.outputs[name] for name in experiment.outputs}
        out[f"time_{experiment.name}"] = time_figure(fit.predict(experiment), units)
        response = response_figure(experiment, fit.parameters, fit.nuisance[experiment.name].delay_s)
        if response is not None:
            out[f"response_{experiment.name}"] = response
    if controller is not None and plants:
        out["loop"] = loop_figure(controller, plants)
    return out
