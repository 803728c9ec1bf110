"""Bode figures of measured frequency responses: H1 with its deviation, its coherence, and models on top."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from seaopt.frequency import Pair
from seaopt.records import record

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MEASURED, BAND = "#5b6570", "#c9d0d8"
H1, DEVIATION = "H1 estimate", "± 2 std"
SHOWN = 0.3  # of coherence: below it an estimate says too little to be drawn
ROWS = (3.0, 2.0, 1.0)  # heights of magnitude, phase and coherence
COLUMNS = 2


@record(eq=False)
class Curve:
    """A model's response, a function of frequencies in Hz."""

    label: str
    response: Any
    colour: str
    style: str = "-"


@record(eq=False)
class Panel:
    """One measured response and the models drawn over it, the one that tells the phase's branch first."""

    title: str
    pair: Pair
    curves: tuple[Curve, ...]


def bode_figure(panels: Sequence[Panel]) -> Figure:
    """Draw magnitude with two standard deviations, phase and coherence of each panel, two panels a row."""
    from matplotlib.figure import Figure

    columns = min(COLUMNS, len(panels))
    blocks = -(-len(panels) // columns)
    figure = Figure(figsize=(9.0, 5.6 * blocks + 0.4), layout="constrained")
    axes = figure.subplots(3 * blocks, columns, squeeze=False, height_ratios=ROWS * blocks)
    for axis in axes.ravel():
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(visible=True, which="both", color="#e4e4e4", linewidth=0.5)
    for index, panel in enumerate(panels):
        block, column = divmod(index, columns)
        _draw(axes[3 * block : 3 * block + 3, column], panel, first=column == 0)
    for axis in axes[3 * (blocks - 1) :, columns - (columns * blocks - len(panels)) :].ravel():
        axis.set_visible(False)
    handles: dict[str, Any] = {}
    for axis in axes[::3].ravel():
        if not axis.get_visible():
            continue
        handles |= {str(label): line for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    order = sorted(handles, key=lambda label: label not in (H1, DEVIATION))  # the data first, then models as drawn
    figure.legend(
        [handles[label] for label in order], order, loc="outside upper left", frameon=False, ncols=5, markerscale=3
    )
    return figure


def _draw(axes: Any, panel: Panel, *, first: bool) -> None:
    magnitude, phase, coherence = axes
    estimate = panel.pair.estimate
    shown = estimate.coherence > SHOWN
    f = estimate.frequency_hz
    ends = (f[0], f[shown][-1] if np.any(shown) else f[-1])
    dense = np.geomspace(*ends, 600)
    branch = _model_curves(magnitude, phase, panel.curves, dense)
    if np.any(shown):  # after the models, whose branch it takes
        _measured(magnitude, phase, panel, shown, np.interp(f[shown], dense, branch))
    coherence.semilogx(f, estimate.coherence, color=MEASURED, linewidth=0.8)
    coherence.set_ylim(0.0, 1.05)
    magnitude.set_title(panel.title, fontsize="medium")
    coherence.set_xlabel("frequency [Hz]")
    for axis in axes:
        axis.set_xlim(*ends)
    for axis in (magnitude, phase):
        axis.tick_params(labelbottom=False)
    if first:
        for axis, label in zip(axes, ("magnitude [dB]", "phase [deg]", "coherence"), strict=True):
            axis.set_ylabel(label)


def _model_curves(magnitude: Axes, phase: Axes, curves: Sequence[Curve], f: Any) -> Any:
    """Draw the models, all on the phase branch of the first; return that phase in degrees."""
    branch = np.zeros(f.size)
    for number, curve in enumerate(curves):
        response = curve.response(f)
        angle = np.degrees(np.unwrap(np.angle(response)))
        if number == 0:
            branch = angle = angle - 360.0 * np.round(angle[0] / 360.0)
        else:
            angle = angle - 360.0 * np.round(np.median(angle - branch) / 360.0)
        look: dict[str, Any] = {"color": curve.colour, "linestyle": curve.style, "linewidth": 1.3, "zorder": 3}
        magnitude.semilogx(f, 20 * np.log10(np.maximum(np.abs(response), 1e-12)), label=curve.label, **look)
        phase.semilogx(f, angle, **look)
    return branch


def _measured(magnitude: Axes, phase: Axes, panel: Panel, shown: Any, branch: Any) -> None:
    """Draw H1; its phase on the branch nearest the model's: noise at a dip must not shift the rest by a turn."""
    estimate = panel.pair.estimate
    f, h, std = estimate.frequency_hz[shown], estimate.response[shown], estimate.relative_std[shown]
    level = 20 * np.log10(np.maximum(np.abs(h), 1e-300))
    angle = np.degrees(np.angle(h * np.exp(-1j * np.radians(branch)))) + branch
    low, high = (20 * np.log10(np.maximum(1.0 + side * 2.0 * std, 0.05)) for side in (-1.0, 1.0))
    magnitude.fill_between(f, level + low, level + high, color=BAND, linewidth=0.0, label=DEVIATION)
    dots: dict[str, Any] = {"color": MEASURED, "marker": ".", "markersize": 2.5, "linestyle": ""}
    magnitude.semilogx(f, level, label=H1, **dots)
    phase.semilogx(f, angle, **dots)
    span = float(np.ptp(level))
    magnitude.set_ylim(float(level.min()) - 0.15 * span - 3.0, float(level.max()) + 0.15 * span + 3.0)
    width = max(float(np.ptp(angle)), 45.0)
    phase.set_ylim(float(angle.min()) - 0.15 * width, float(angle.max()) + 0.15 * width)
