"""Figures of closed loops: step, open loop, sensitivity, tracking, of one controller on one or several plants."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from seaopt.control import Controller, Loop
from seaopt.control.running.fed_back import close_whole
from seaopt.errors import ControlError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.reporting.figures.fit import label_channel
from seaopt.reporting.figures.panel import COLOURS, LIMIT, MEASURED, Panel, draw_level, frequency_panel, to_decibel
from seaopt.signals import VectorM, VectorN
from seaopt.units import unit_after

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Plants = Mapping[str, tuple[Plant, ParameterSet]]
LOWEST_HZ = 0.05
STYLES = ("-", "--", "-.", ":")
# Of a step that is drawn until it has settled on the first plant: periods of the bandwidth and seconds, share, factor.
LEAST_PERIODS, MOST_S, SETTLED, SPARE = 4.0, 4.0, 0.01, 1.25
RUNAWAY = 3.0  # steps of size beyond which an unstable loop is not drawn
FLOOR_DB = -40.0
HALF_POWER_DB = -3.0103


def design_of(controller: Controller) -> tuple[Plant, ParameterSet]:
    """Return the design plant and its parameters. Raises ControlError: the controller does not have it."""
    if controller.design is None:
        raise ControlError("the controller does not know its design plant; read it with Controller.from_dict")
    return controller.design


def close_loops(controller: Controller, plants: Plants | None = None) -> dict[str, Loop]:
    """Return the loop on each plant; on the design plant where none are given."""
    plants = plants if plants is not None else {"design plant": design_of(controller)}
    return {name: close_whole(controller, plant, values) for name, (plant, values) in plants.items()}


def _style_loops(loops: Mapping[str, Loop]) -> Iterator[tuple[Loop, dict[str, Any]]]:
    """Yield each plant's loop, and how it is drawn: colour, line and label."""
    for number, (name, loop) in enumerate(loops.items()):
        style = STYLES[(number // len(COLOURS)) % len(STYLES)]
        yield loop, {"color": COLOURS[number % len(COLOURS)], "linestyle": style, "linewidth": 1.4, "label": name}


def list_frequencies(loop: Loop) -> VectorM:
    """Return the frequencies at which a loop's responses are drawn."""
    grid = loop.grid()
    return grid[(grid >= LOWEST_HZ) & (grid < 0.999 * loop.plant.nyquist_hz)]


def step_panel(
    controller: Controller, plants: Plants | None = None, *, size: float = 1.0, duration_s: float | None = None
) -> Panel:
    """Draw the output and the command after a step of the reference; linear, without limits and noise. `plants`:
    mapping of name to (Plant, ParameterSet); the design plant if left out. `size`: of the step, in the reference's
    unit. `duration_s`: until it has settled if left out. `ax`: a sequence of two Axes.
    """
    loops, period = close_loops(controller, plants), controller.sample_time_s
    if duration_s is None:
        first = next(iter(loops.values()))
        settled = _settle(first.simulate(np.ones(round(MOST_S / period)))[0]) * period if first.is_stable() else 0.0
        duration_s = min(max(LEAST_PERIODS / controller.spec.bandwidth_hz, SPARE * settled), MOST_S)
    samples = max(round(duration_s / period), 2)
    command, measured = controller.command, controller.spec.regulated

    def draw(upper: Axes, lower: Axes) -> None:
        time = np.arange(samples) * period
        upper.plot([0.0, time[-1]], [size, size], color=LIMIT, linestyle=":", linewidth=1.0, label="reference")
        for loop, look in _style_loops(loops):
            force, effort = loop.simulate(np.full(samples, size))
            if not loop.is_stable():
                look["label"] += " (unstable)"
                gone = np.flatnonzero(np.abs(force) > RUNAWAY * abs(size))
                force[gone[0] if gone.size else samples :] = np.nan
                effort[np.isnan(force)] = np.nan
            upper.plot(time, force, **look)
            lower.plot(time, command.per_effort * effort, drawstyle="steps-post", **look)

    unit = unit_after(command.reference_unit)
    return Panel(
        name="step",
        title=f"Step of {size:g}{unit}",
        draw=draw,
        x="time [s]",
        y=(label_channel(measured, command.reference_unit), command.label),
        tight=True,
        heights=(1.0, 0.7),
        caption=f"{measured} and the {command.word} after a step of the reference by {size:g}{unit}: the linear loop, "
        "sampled, without limit and noise.",
    )


def _settle(force: VectorN) -> int:
    """Return from which sample on a response stays within a hundredth of its last."""
    outside = np.flatnonzero(np.abs(force - force[-1]) > SETTLED * max(abs(float(force[-1])), 1e-12))
    return int(outside[-1]) + 1 if outside.size else 1


def bode_panel(controller: Controller, plants: Plants | None = None) -> Panel:
    """Draw magnitude and phase of the open loop; `ax` is a sequence of two Axes."""
    loops = close_loops(controller, plants)

    def draw(magnitude: Axes, phase: Axes) -> None:
        for loop, look in _style_loops(loops):
            f = list_frequencies(loop)
            response = loop.open_loop(f)
            magnitude.plot(f, to_decibel(response), **look)
            phase.plot(f, np.degrees(np.unwrap(np.angle(response))), **look)
        for axis, level in ((magnitude, 0.0), (phase, -180.0)):
            axis.axhline(level, color=LIMIT, linestyle=":", linewidth=0.9)
        magnitude.set_ylim(-60, 60)

    return frequency_panel(
        name="bode",
        title="Open loop",
        draw=draw,
        y=("|L| [dB]", "phase of L [deg]"),
        tight=True,
        heights=(1.0, 0.7),
        caption="Open loop L = C_y P with hold and delay: where its size crosses 0 dB the phase's distance from -180 "
        "degrees is the phase margin.",
    )


def nyquist_panel(controller: Controller, plants: Plants | None = None) -> Panel:
    """Draw the open loop in the complex plane, with the disk that it must not enter."""
    loops, ms = close_loops(controller, plants), controller.spec.level("max_sensitivity")

    def draw(axis: Axes) -> None:
        turn = np.linspace(0.0, 2.0 * np.pi, 361)
        axis.plot(np.cos(turn), np.sin(turn), color=MEASURED, linewidth=0.7, linestyle=":", label="unit circle")
        if ms is not None:
            x, y = -1.0 + np.cos(turn) / ms, np.sin(turn) / ms
            axis.fill(x, y, color=LIMIT, alpha=0.12, linewidth=0.0)
            axis.plot(x, y, color=LIMIT, linewidth=0.9, linestyle="--", label=f"Ms = {ms:g}")
        for loop, look in _style_loops(loops):
            response = loop.open_loop(list_frequencies(loop))
            axis.plot(np.real(response), np.imag(response), **look)
        axis.plot([-1.0], [0.0], "+", color=LIMIT, markersize=9, markeredgewidth=1.4)
        axis.set_xlim(-2.6, 1.6)
        axis.set_ylim(-2.2, 1.3)
        axis.set_aspect("equal", adjustable="box")

    disk = "" if ms is None else f", and must stay out of the shaded disk of radius 1/{ms:g} about it"
    return Panel(
        name="nyquist",
        hover="point",
        title="Nyquist",
        draw=draw,
        x="Re L [-]",
        y=("Im L [-]",),
        heights=(1.6,),
        caption=f"The open loop in the complex plane: it must not encircle -1{disk}.",
    )


def _magnitude_panel(
    controller: Controller,
    plants: Plants | None,
    respond: Callable[[Loop, Any], Any],
    *,
    draw_limits: Callable[[Axes], object],
    label: str,
    decibel: bool = True,
    **words: Any,
) -> Panel:
    """Draw the size of a closed-loop function, and its limits."""
    loops = close_loops(controller, plants)

    def draw(axis: Axes) -> None:
        for loop, look in _style_loops(loops):
            f = list_frequencies(loop)
            size = respond(loop, f)
            axis.plot(f, to_decibel(size) if decibel else np.abs(size), **look)
        if decibel:
            axis.set_ylim(bottom=max(axis.get_ylim()[0], FLOOR_DB))
        draw_limits(axis)

    return frequency_panel(draw=draw, y=(label,), tight=True, **words)


def sensitivity_panel(controller: Controller, plants: Plants | None = None) -> Panel:
    """Draw abs(S), with its limits."""
    slow = controller.spec.level("min_sensitivity_bandwidth_hz")

    def draw_limits(axis: Axes) -> None:
        draw_level(axis, controller.spec.level("max_sensitivity"), "Ms = {:g}", decibel=True)
        if slow:
            ends = [LOWEST_HZ, slow], [HALF_POWER_DB, HALF_POWER_DB]
            axis.plot(*ends, color=LIMIT, linestyle=":", linewidth=1.2, label=f"-3 dB up to {slow:g} Hz")

    return _magnitude_panel(
        controller,
        plants,
        lambda loop, f: loop.sensitivity(f),
        draw_limits=draw_limits,
        name="sensitivity",
        title="Sensitivity",
        label="|S| [dB]",
        caption="Sensitivity |S| = |1/(1 + L)|: what feedback leaves of a disturbance. Its peak is Ms.",
    )


def complementary_panel(controller: Controller, plants: Plants | None = None) -> Panel:
    """Draw abs(T), with its limit."""
    return _magnitude_panel(
        controller,
        plants,
        lambda loop, f: 1.0 - loop.sensitivity(f),
        draw_limits=lambda axis: draw_level(
            axis, controller.spec.level("max_complementary"), "Mt = {:g}", decibel=True
        ),
        name="complementary",
        title="Complementary sensitivity",
        label="|T| [dB]",
        caption="Complementary sensitivity |T| = |L/(1 + L)|: what errors of the model at high frequency act on.",
    )


def tracking_panel(controller: Controller, plants: Plants | None = None) -> Panel:
    """Draw the output over its reference, with the bandwidth that was asked for."""
    spec = controller.spec

    def draw_limits(axis: Axes) -> None:
        draw_level(axis, HALF_POWER_DB, "-3 dB", style=":")
        draw_level(axis, spec.bandwidth_hz, "asked: {:g} Hz", side="x")

    return _magnitude_panel(
        controller,
        plants,
        lambda loop, f: loop.tracking(f),
        draw_limits=draw_limits,
        name="tracking",
        title="Tracking",
        label=f"|{spec.regulated}/reference| [dB]",
        caption=f"{spec.regulated} over its reference; the bandwidth is where it has fallen by 3 dB.",
    )


def noise_panel(controller: Controller, plants: Plants | None = None) -> Panel:
    """Draw the effort that sensor noise makes, per unit of noise, with its limit."""
    return _magnitude_panel(
        controller,
        plants,
        lambda loop, f: loop.noise(f),
        draw_limits=lambda axis: draw_level(axis, controller.spec.level("max_noise_gain"), "noise gain {:g}"),
        decibel=False,
        name="noise",
        title="Noise gain",
        label=f"|C_y S| [{controller.command.gain_unit}]",
        caption=f"Motor {controller.command.mechanics.word} that noise on {controller.signals[0]} makes, per unit of "
        "noise.",
    )


LOOP_PANELS: Mapping[str, Callable[..., Panel]] = {
    "step": step_panel,
    "bode": bode_panel,
    "sensitivity": sensitivity_panel,
    "tracking": tracking_panel,
    "nyquist": nyquist_panel,
    "noise": noise_panel,
    "complementary": complementary_panel,
}
MAIN = ("step", "bode", "tracking", "sensitivity", "nyquist", "noise")  # on a sheet and on the page
