"""Figures of simulations and of coupled stability, and their section of the report."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from seaopt.reporting.figures import MEASURED, MODEL, PLANT_COLOURS, panels
from seaopt.reporting.templates import render_template
from seaopt.robustness.certificate.simulated import Simulated
from seaopt.robustness.verification.environments import StabilityMap
from seaopt.robustness.verification.judgement import NOMINAL, Outcome, find_judged_window
from seaopt.robustness.verification.large_signal import LargeSignal
from seaopt.robustness.verification.playback import Playback
from seaopt.robustness.verification.verification import Verification

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LAST_PHASE_S = 0.6  # drawn of the last phase of a run that passed, where the others are shorter
HELD_COLOUR, JUDGED_COLOUR = "#f1f1f1", "#fdf3d8"


def verification_figure(verification: Verification, plant: str) -> Figure:
    """Draw force (torque) and command of each scenario on one plant: the run that failed, or has the largest force.

    Of a run that passed the end of the last phase is left out; a run that failed is drawn whole, with the window that
    it is judged in.
    """
    rows = [row for row in verification.worst() if row.plant == plant]
    controller = verification.stages[plant].controller
    name, limit = controller.spec.measured, controller.command_limit
    figure, axes = panels(len(rows), 2, 0.5 + 1.5 * len(rows))
    for (left, right), row in zip(axes, rows, strict=True):
        trace = verification.replay(row)
        visible = trace.time <= (_visible_until(trace) if row.passed else trace.time[-1])
        time = trace.time[visible]
        left.plot(time, trace.reference[0][visible], color=MEASURED, linewidth=1.6, label="reference")
        left.plot(time, trace.outputs[name][0][visible], color=MODEL, linewidth=0.9, label=name)
        right.step(
            time,
            trace.current[0][visible],
            where="post",
            color=PLANT_COLOURS[1],
            linewidth=0.9,
            label=controller.command.word,
        )
        if limit is not None and row.saturated > 0.0:
            for side in (-limit, limit):
                right.axhline(side, color="#444444", linestyle=":", linewidth=0.9)
        _phases((left, right), trace, float(time[-1]), verification, row)
        draw = "" if row.draw == NOMINAL else f", draw {row.draw}"
        cut = "" if visible.all() else f", {time[-1]:.2g} of {trace.time[-1]:.3g} s"
        verdict = cut if row.passed else ": FAILED"
        left.set_title(f"{row.scenario}{draw}{verdict}", fontsize="medium", loc="left")
        left.set_ylabel(f"{name} [{verification.mechanics.unit}]")
        right.set_ylabel(controller.command.label)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", frameon=False, ncols=2)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    return figure


def _visible_until(trace: Playback) -> float:
    """Return how much of a trace is drawn: all of one phase, else the last one's beginning."""
    if len(trace.edges) == 2:
        return float(trace.time[-1])
    return float(trace.time[trace.edges[-2]]) + max(LAST_PHASE_S, float(trace.time[trace.edges[-2]]))


def _phases(axes: tuple[Axes, Axes], trace: Playback, until: float, verification: Verification, row: Outcome) -> None:
    if not row.passed:
        window = find_judged_window(trace)
        for axis in axes:
            axis.axvspan(
                float(trace.time[window.start]), float(trace.time[window.stop - 1]), color=JUDGED_COLOUR, zorder=0
            )
    for phase, start, stop in zip(verification.scenario(row).phases, trace.edges[:-1], trace.edges[1:], strict=True):
        if phase.held:
            for axis in axes:
                axis.axvspan(trace.time[start], min(trace.time[stop - 1], until), color=HELD_COLOUR, zorder=0)


def large_signal_figure(sweeps: Sequence[LargeSignal]) -> Figure:
    """Draw the gain against frequency at each amplitude, and the saturation map, a row per plant."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure, axes = panels(len(sweeps), 2, 3.0 * len(sweeps), sharex=True)
    for (left, right), sweep in zip(axes, sweeps, strict=True):
        shades = np.linspace(0.85, 0.0, sweep.amplitude_N.size)
        for amplitude, gain, hit, shade in zip(sweep.amplitude_N, sweep.gain, sweep.saturated, shades, strict=True):
            colour = (shade * 0.75, 0.30 + shade * 0.55, 0.55 + shade * 0.4)
            size = 20 * np.log10(np.maximum(np.abs(gain), 1e-6))
            left.semilogx(sweep.frequency_hz, size, color=colour, linewidth=1.3, label=f"{amplitude:.3g} {sweep.unit}")
            left.semilogx(sweep.frequency_hz[hit], size[hit], ".", color=colour, markersize=5)
        left.axhline(-3.0103, color="#444444", linestyle=":", linewidth=0.9)
        left.legend(frameon=False, fontsize="small")
        left.set_title(f"{sweep.plant}: |F/F_ref| [dB]; dots: saturated", fontsize="medium", loc="left")
        right.loglog(sweep.frequency_hz, sweep.onset_N, color=MODEL, linewidth=1.3)
        right.set_title(f"amplitude at which the command saturates [{sweep.unit}]", fontsize="medium", loc="left")
        for axis in (left.xaxis, right.xaxis, right.yaxis):
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(NullFormatter())
    for axis in axes[-1]:
        axis.set_xlabel("frequency [Hz]")
    return figure


def bandwidth_figure(sweeps: Sequence[LargeSignal]) -> Figure:
    """Draw bandwidth against amplitude, one curve per plant: simulated as points, predicted as a line."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure, axes = panels(1, 1, 3.2)
    axis = axes[0, 0]
    for sweep, colour in zip(sweeps, itertools.cycle(PLANT_COLOURS), strict=False):
        points, line = (
            np.array([np.nan if hz is None else hz for hz in values])
            for values in (sweep.bandwidth_hz, sweep.predicted_hz)
        )
        axis.loglog(sweep.amplitude_N, line, color=colour, linewidth=1.3, label=f"{sweep.plant}, predicted")
        axis.loglog(sweep.amplitude_N, points, "o", color=colour, markersize=4, label=f"{sweep.plant}, simulated")
        saturated = np.any(sweep.saturated, axis=1)
        axis.loglog(sweep.amplitude_N[saturated], points[saturated], "s", color=colour, markersize=7, fillstyle="none")
        if sweep.friction_N:
            axis.axvline(sweep.friction_N, color=colour, linestyle=":", linewidth=0.9)
    for one in (axis.xaxis, axis.yaxis):
        one.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        one.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        one.set_minor_formatter(NullFormatter())
    unit = " or ".join(dict.fromkeys(sweep.unit for sweep in sweeps))
    marks = "dotted: dry friction; squares: the command saturates in the sweep"
    axis.set_xlabel(f"amplitude of the reference [{unit}]; {marks}")
    axis.set_ylabel("bandwidth [Hz]")
    axis.legend(frameon=False, fontsize="small")
    return figure


def stability_figure(stability: StabilityMap) -> Figure:
    """Draw where the loop is stable against a mass on a spring, a panel per damper."""
    from matplotlib.colors import BoundaryNorm, ListedColormap

    columns = min(2, stability.damping.size)
    rows = -(-stability.damping.size // columns)
    figure, axes = panels(rows, columns, 3.1 * rows, sharex=True, sharey=True)
    colours = ListedColormap(["#cfe3f1", "#f6d9c6"])
    for index, (damping, stable, edge) in enumerate(
        zip(stability.damping, stability.stable, stability.boundary, strict=True)
    ):
        axis = axes.ravel()[index]
        axis.pcolormesh(
            stability.mass, stability.stiffness, (~stable).T.astype(float), cmap=colours,
            norm=BoundaryNorm([0, 0.5, 1], 2), shading="nearest", rasterized=True,
        )  # fmt: skip
        if len(edge):
            axis.plot(edge[:, 0], edge[:, 1], ".", color=PLANT_COLOURS[1], markersize=3)
        share = 100.0 * float(np.mean(stable))
        axis.set_title(
            f"damper {damping:g} {stability.called.damping}: stable in {share:.3g} %", fontsize="medium", loc="left"
        )
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.minorticks_off()  # hundreds over these decades, behind the map, and slow to draw
    for axis in axes.ravel()[stability.damping.size :]:
        axis.set_visible(False)
    for axis in axes[-1]:
        axis.set_xlabel(f"{stability.called.inertia_word} on link 2 [{stability.called.inertia}]")
    for axis in axes[:, 0]:
        axis.set_ylabel(f"spring to ground [{stability.called.stiffness}]")
    return figure


def verification_figures(
    verification: Verification | None, large: Sequence[LargeSignal], coupled: StabilityMap | None
) -> dict[str, Figure]:
    """Return every figure that the results allow, by file name."""
    out: dict[str, Figure] = {}
    if verification is not None:
        played = dict.fromkeys(row.plant for row in verification.rows)
        out |= {f"simulation_{name}": verification_figure(verification, name) for name in played}
    if large:
        out["bandwidth"] = bandwidth_figure(large)
        out["amplitude"] = large_signal_figure(large)
    if coupled is not None:
        out["environments"] = stability_figure(coupled)
    return out


def render_verification(
    verification: Verification | None,
    large: Sequence[LargeSignal],
    coupled: StabilityMap | None,
    simulated: Simulated | None,
    svgs: Mapping[str, str],
) -> str:
    """Return the section's HTML: tables, and the figures' <svg> elements by file name."""
    return render_template(
        "verification.html.jinja", verification=verification, large=large, coupled=coupled, svgs=svgs,
        passivity=None if simulated is None else simulated.passivity,
        left_out={} if simulated is None else simulated.left_out,
        certified=simulated is not None and simulated.verification is verification,
    )  # fmt: skip
