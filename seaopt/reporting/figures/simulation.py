"""Figures of simulated loops: runs of scenarios, gain and bandwidth by amplitude, stability against environments."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from seaopt.reporting.figures.fit import label_channel
from seaopt.reporting.figures.loop import HALF_POWER_DB
from seaopt.reporting.figures.panel import (
    BLUE,
    COLOURS,
    LIMIT,
    MEASURED,
    VERMILION,
    Panel,
    draw_level,
    frequency_panel,
    to_decibel,
)
from seaopt.reporting.figures.thinning import thin_series
from seaopt.robustness.verification.environments import StabilityMap
from seaopt.robustness.verification.judgement import NOMINAL, Outcome, find_judged_window
from seaopt.robustness.verification.large_signal import LargeSignal
from seaopt.robustness.verification.playback import Playback
from seaopt.robustness.verification.verification import Verification

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LAST_PHASE_S = 0.6  # drawn of the last phase of a run that passed, where the others are shorter
HELD_COLOUR, JUDGED_COLOUR = "#f1f1f1", "#fdf3d8"
STABLE_COLOUR, UNSTABLE_COLOUR = "#cfe3f1", "#f6d9c6"


def simulation_panel(verification: Verification, row: Outcome) -> Panel:
    """Draw force (torque) and command of one run, simulated again. Of a run that passed the end of the last phase is
    left out; a run that failed is drawn whole, with the window that it is judged in.
    """
    controller = verification.rigs[row.plant].controller
    name, limit = controller.spec.regulated, controller.command_limit
    trace = verification.replay(row)
    visible = trace.time <= (_visible_until(trace) if row.passed else trace.time[-1])
    time = trace.time[visible]

    def draw(upper: Axes, lower: Axes) -> None:
        upper.plot(*thin_series(time, trace.reference[0][visible]), color=MEASURED, linewidth=1.8, label="reference")
        upper.plot(*thin_series(time, trace.outputs[name][0][visible]), color=BLUE, linewidth=1.0, label=name)
        command = thin_series(time, trace.current[0][visible])
        word = controller.command.word
        lower.plot(*command, drawstyle="steps-post", color=VERMILION, linewidth=0.9, label=word)
        if limit is not None and row.saturated > 0.0:
            for level in (-limit, limit):
                draw_level(lower, level, "limit", style=":")
        _draw_phases((upper, lower), trace, float(time[-1]), verification, row)

    drawn = "" if row.draw == NOMINAL else f", draw {row.draw}"
    cut = "" if visible.all() else f", {time[-1]:.2g} of {trace.time[-1]:.3g} s"
    return Panel(
        name=f"simulation_{row.plant}_{row.scenario}",
        title=f"{row.plant}, {row.scenario}{drawn}{cut if row.passed else ': FAILED'}",
        draw=draw,
        x="time [s]",
        y=(label_channel(name, controller.command.reference_unit), controller.command.label),
        tight=True,
        heights=(0.8, 0.5),
        caption=f"{name} and {controller.command.word} of {row.scenario} on {row.plant}"
        + ("." if row.passed else f": {row.reason}. Yellow: the window that is judged."),
    )


def _visible_until(trace: Playback) -> float:
    """Return how much of a trace is drawn: all of one phase, else the last one's beginning."""
    if len(trace.edges) == 2:
        return float(trace.time[-1])
    return float(trace.time[trace.edges[-2]]) + max(LAST_PHASE_S, float(trace.time[trace.edges[-2]]))


def _draw_phases(axes: Sequence[Axes], trace: Playback, until: float, verification: Verification, row: Outcome) -> None:
    """Shade where the link is held, and of a run that failed the window that it is judged in."""
    spans: list[tuple[int, int, str]] = []
    if not row.passed:
        window = find_judged_window(trace)
        spans.append((window.start, window.stop, JUDGED_COLOUR))
    phases = zip(verification.scenario(row).phases, trace.edges[:-1], trace.edges[1:], strict=True)
    spans += [(start, stop, HELD_COLOUR) for phase, start, stop in phases if phase.held]
    for start, stop, colour in spans:
        for axis in axes:
            axis.axvspan(trace.time[start], min(trace.time[stop - 1], until), color=colour, zorder=0)


def bandwidth_panel(sweeps: Sequence[LargeSignal]) -> Panel:
    """Draw bandwidth against amplitude, one curve per plant: simulated as points, predicted as a line."""

    def draw(axis: Axes) -> None:
        for sweep, colour in zip(sweeps, itertools.cycle(COLOURS), strict=False):
            points, line = (np.array(values, dtype=float) for values in (sweep.bandwidth_hz, sweep.predicted_hz))
            axis.plot(sweep.amplitude_N, line, color=colour, linewidth=1.3, label=f"{sweep.plant}, predicted")
            axis.plot(sweep.amplitude_N, points, "o", color=colour, markersize=4, label=f"{sweep.plant}, simulated")
            saturated = np.any(sweep.saturated, axis=1)
            look: dict[str, Any] = {
                "color": colour,
                "markersize": 8,
                "fillstyle": "none",
                "label": "the command saturates",
            }
            axis.plot(sweep.amplitude_N[saturated], points[saturated], "s", **look)
            if sweep.friction_N:
                axis.axvline(sweep.friction_N, color=colour, linestyle=":", linewidth=1.0, label="dry friction")

    return Panel(
        name="bandwidth",
        title="Bandwidth against amplitude",
        draw=draw,
        x=f"amplitude of the reference [{' or '.join(dict.fromkeys(sweep.unit for sweep in sweeps))}]",
        y=("bandwidth [Hz]",),
        log="xy",
        heights=(1.2,),
        caption="Bandwidth against the amplitude of a sine, simulated and predicted by describing functions: below its "
        "dry friction a plant sticks, at large amplitudes the command saturates.",
    )


def amplitude_panel(sweep: LargeSignal) -> Panel:
    """Draw the gain against frequency at each amplitude."""

    def draw(axis: Axes) -> None:
        shades = np.linspace(0.85, 0.0, sweep.amplitude_N.size)
        for amplitude, gain, hit, shade in zip(sweep.amplitude_N, sweep.gain, sweep.saturated, shades, strict=True):
            colour = (shade * 0.75, 0.30 + shade * 0.55, 0.55 + shade * 0.4)
            size = np.maximum(to_decibel(gain), -120.0)
            axis.plot(sweep.frequency_hz, size, color=colour, linewidth=1.3, label=f"{amplitude:.3g} {sweep.unit}")
            axis.plot(sweep.frequency_hz[hit], size[hit], ".", color=colour, markersize=6)
        axis.axhline(HALF_POWER_DB, color=LIMIT, linestyle=":", linewidth=0.9)

    return frequency_panel(
        name=f"amplitude_{sweep.plant}",
        title=f"{sweep.plant}: gain at amplitudes",
        draw=draw,
        y=("|F/F_ref| [dB]",),
        caption="First harmonic of what is measured over the reference's amplitude; dots: the command saturates.",
    )


def saturation_panel(sweep: LargeSignal) -> Panel:
    """Draw the amplitude at which the command of the linear loop saturates."""

    def draw(axis: Axes) -> None:
        if not np.any(np.isfinite(sweep.onset_N)):
            axis.text(0.5, 0.5, "the command has no limit", transform=axis.transAxes, ha="center")
        axis.plot(sweep.frequency_hz, sweep.onset_N, color=BLUE, linewidth=1.4, label="the command saturates above")

    return frequency_panel(
        name=f"saturation_{sweep.plant}",
        title=f"{sweep.plant}: where the command saturates",
        draw=draw,
        y=(f"amplitude [{sweep.unit}]",),
        log="xy",
        caption="The amplitude of a sinusoidal reference at which the linear loop's command reaches its limit.",
    )


def environment_panels(stability: StabilityMap) -> list[Panel]:
    """Return where the loop is stable against a mass (an inertia) on a spring, a panel per damper."""
    return [_environment_panel(stability, number) for number in range(stability.damping.size)]


def _environment_panel(stability: StabilityMap, number: int) -> Panel:
    damping, called = stability.damping[number], stability.called
    stable, edge = stability.stable[number], stability.boundary[number]

    def draw(axis: Axes) -> None:
        from matplotlib.colors import BoundaryNorm, ListedColormap

        from seaopt.reporting.figures.canvas import scale_log

        axis.pcolormesh(
            stability.mass,
            stability.stiffness,
            (~stable).T.astype(float),
            cmap=ListedColormap([STABLE_COLOUR, UNSTABLE_COLOUR]),
            norm=BoundaryNorm([0, 0.5, 1], 2),
            shading="nearest",
            rasterized=True,
        )
        if len(edge):
            axis.plot(edge[:, 0], edge[:, 1], ".", color=VERMILION, markersize=3, label="edge of stability")
        axis.set_xscale("log")
        axis.set_yscale("log")
        scale_log([axis])
        scale_log([axis], "y")
        axis.minorticks_off()  # hundreds over these decades, behind the map, and slow to draw

    share = 100.0 * float(np.mean(stable))
    return Panel(
        name=f"environment_{number + 1}",
        hover="",
        title=f"Damper of {damping:g} {called.damping}: stable in {share:.3g} %",
        draw=draw,
        x=f"{called.inertia_word} on link 2 [{called.inertia}]",
        y=(f"spring to ground [{called.stiffness}]",),
        caption=f"Blue: the loop is stable with such a {called.inertia_word} on link 2, tied to the ground by a spring "
        f"and a damper of {damping:g} {called.damping}; orange: it is not.",
    )
