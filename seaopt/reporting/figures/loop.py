"""Figures of closed loops: step, open loop, sensitivity, tracking, of one controller on one or several plants."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from seaopt.control import Controller, Loop
from seaopt.control.loops.loop import STABLE
from seaopt.errors import ControlError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.reporting.figures.fit import label_channel
from seaopt.reporting.figures.panel import Panel
from seaopt.units import unit_after

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Plants = Mapping[str, tuple[Plant, ParameterSet]]
LOWEST_HZ = 0.05
STYLES = ("-", "--", "-.", ":")
LEAST_PERIODS, MOST_S, SETTLED, SPARE = (
    4.0,
    4.0,
    0.01,
    1.25,
)  # of a step that is drawn until it has settled on the first plant
RUNAWAY = 3.0  # steps of size beyond which an unstable loop is not drawn
FLOOR_DB = -40.0


def loops_of(controller: Controller, plants: Plants | None = None) -> dict[str, Loop]:
    """Return the loop on each plant, the design plant alone where none are given.

    Raises
    ------
    ControlError
        None are given, and the controller does not know its design plant.

    """
    if plants is None:
        if controller.design is None:
            raise ControlError(
                "the controller does not know its design plant; give plants, or read it with Controller.from_dict"
            )
        plants = {"design plant": controller.design}
    return {name: controller.close(plant, values) for name, (plant, values) in plants.items()}


def _looks(loops: Mapping[str, Loop]) -> Iterator[tuple[str, Loop, dict[str, Any]]]:
    """Return each plant's name, loop, and how it is drawn: colour and line."""
    from seaopt.reporting.figures.canvas import COLOURS

    for number, (name, loop) in enumerate(loops.items()):
        style = STYLES[(number // len(COLOURS)) % len(STYLES)]
        yield name, loop, {"color": COLOURS[number % len(COLOURS)], "linestyle": style, "linewidth": 1.4, "label": name}


def _frequencies(loop: Loop) -> Float[np.ndarray, " m"]:
    grid = loop.grid()
    return grid[(grid >= LOWEST_HZ) & (grid < 0.999 * loop.plant.nyquist_hz)]


def _decibel(values: Any) -> Any:
    return 20 * np.log10(np.maximum(np.abs(values), 1e-12))


def step_panel(
    controller: Controller, plants: Plants | None = None, *, size: float = 1.0, duration_s: float | None = None
) -> Panel:
    """Draw what is measured, and what is commanded, after a step of the reference; linear, without limits and noise."""
    loops, period = loops_of(controller, plants), controller.sample_time_s
    if duration_s is None:
        most = round(MOST_S / period)
        least = LEAST_PERIODS / controller.spec.bandwidth_hz
        first = next(iter(loops.values()))
        settled = _settling(first.simulate(np.ones(most))[0]) * period if _is_stable(first) else 0.0
        duration_s = min(max(least, SPARE * settled), MOST_S)
    samples = max(round(duration_s / period), 2)
    command, measured = controller.command, controller.spec.regulated

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import LIMIT

        upper, lower = axes
        time = np.arange(samples) * period
        upper.plot([0.0, time[-1]], [size, size], color=LIMIT, linestyle=":", linewidth=1.0, label="reference")
        for name, loop, look in _looks(loops):
            force, effort = loop.simulate(np.full(samples, size))
            if not _is_stable(loop):
                look["label"] = f"{name} (unstable)"
                gone = np.flatnonzero(np.abs(force) > RUNAWAY * abs(size))
                force[gone[0] if gone.size else samples :] = np.nan
                effort[np.isnan(force)] = np.nan
            upper.plot(time, force, **look)
            lower.plot(time, command.per_effort * effort, drawstyle="steps-post", **look)
        upper.set_ylabel(label_channel(measured, command.reference_unit))
        lower.set_ylabel(command.label)
        lower.set_xlabel("time [s]")
        upper.margins(x=0.0)

    unit = unit_after(command.reference_unit)
    return Panel(
        name="step",
        title=f"Step of {size:g}{unit}",
        draw=draw,
        heights=(1.0, 0.7),
        caption=f"{measured} and the {command.word} after a step of the reference by {size:g}{unit}: the linear loop, "
        "sampled, without limit and noise.",
    )


def _is_stable(loop: Loop) -> bool:
    return bool(np.max(np.abs(loop.eigenvalues()), initial=0.0) < STABLE)


def _settling(force: Float[np.ndarray, " n"]) -> int:
    """Return from which sample on a response stays within a hundredth of its last."""
    outside = np.flatnonzero(np.abs(force - force[-1]) > SETTLED * max(abs(float(force[-1])), 1e-12))
    return int(outside[-1]) + 1 if outside.size else 1


def bode_panel(controller: Controller, plants: Plants | None = None) -> Panel:
    """Draw magnitude and phase of the open loop."""
    loops = loops_of(controller, plants)

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import LIMIT, scale_log

        magnitude, phase = axes
        for _, loop, look in _looks(loops):
            f = _frequencies(loop)
            response = loop.open_loop(f)
            magnitude.plot(f, _decibel(response), **look)
            phase.plot(f, np.degrees(np.unwrap(np.angle(response))), **look)
        magnitude.axhline(0.0, color=LIMIT, linestyle=":", linewidth=0.9)
        phase.axhline(-180.0, color=LIMIT, linestyle=":", linewidth=0.9)
        magnitude.set_ylim(-60, 60)
        _finish(axes, ("|L| [dB]", "phase of L [deg]"))
        scale_log(axes)

    return Panel(
        name="bode",
        title="Open loop",
        draw=draw,
        heights=(1.0, 0.7),
        link="frequency",
        caption="Open loop L = C_y P with hold and delay: where its size crosses 0 dB the phase's distance from -180 "
        "degrees is the phase margin.",
    )


def nyquist_panel(controller: Controller, plants: Plants | None = None) -> Panel:
    """Draw the open loop in the complex plane, with the disk that it must not enter."""
    loops, ms = loops_of(controller, plants), controller.spec.level("max_sensitivity")

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import LIMIT, MEASURED

        (axis,) = axes
        turn = np.linspace(0.0, 2.0 * np.pi, 361)
        axis.plot(np.cos(turn), np.sin(turn), color=MEASURED, linewidth=0.7, linestyle=":", label="unit circle")
        if ms is not None:
            x, y = -1.0 + np.cos(turn) / ms, np.sin(turn) / ms
            axis.fill(x, y, color=LIMIT, alpha=0.12, linewidth=0.0)
            axis.plot(x, y, color=LIMIT, linewidth=0.9, linestyle="--", label=f"Ms = {ms:g}")
        for _, loop, look in _looks(loops):
            response = loop.open_loop(_frequencies(loop))
            axis.plot(np.real(response), np.imag(response), **look)
        axis.plot([-1.0], [0.0], "+", color=LIMIT, markersize=9, markeredgewidth=1.4)
        axis.set_xlim(-2.6, 1.6)
        axis.set_ylim(-2.2, 1.3)
        axis.set_aspect("equal", adjustable="box")
        axis.set_xlabel("Re L [-]")
        axis.set_ylabel("Im L [-]")

    said = "" if ms is None else f", and must stay out of the shaded disk of radius 1/{ms:g} about it"
    return Panel(
        name="nyquist",
        hover="point",
        title="Nyquist",
        draw=draw,
        heights=(1.6,),
        caption=f"The open loop in the complex plane: it must not encircle -1{said}.",
    )


def _magnitude_panel(
    controller: Controller,
    plants: Plants | None,
    values: Callable[[Loop, Any], Any],
    name: str,
    title: str,
    ylabel: str,
    caption: str,
    lines: Callable[[Axes], None],
    decibels: bool = True,
) -> Panel:
    """Draw the size of a closed-loop function, and its limits as `lines`."""
    loops = loops_of(controller, plants)

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import scale_log

        (axis,) = axes
        for _, loop, look in _looks(loops):
            f = _frequencies(loop)
            size = values(loop, f)
            axis.plot(f, _decibel(size) if decibels else np.abs(size), **look)
        if decibels:
            axis.set_ylim(bottom=max(axis.get_ylim()[0], FLOOR_DB))
        lines(axis)
        _finish(axes, (ylabel,))
        scale_log(axes)

    return Panel(name=name, title=title, draw=draw, link="frequency", caption=caption)


def _finish(axes: Sequence[Axes], labels: Sequence[str]) -> None:
    for axis, label in zip(axes, labels, strict=True):
        axis.set_ylabel(label)
        axis.margins(x=0.0)
    axes[-1].set_xlabel("frequency [Hz]")


def _draw_level(axis: Axes, level: float, label: str, style: str = "--") -> None:
    from seaopt.reporting.figures.canvas import LIMIT

    axis.axhline(level, color=LIMIT, linestyle=style, linewidth=0.9, label=label)


def sensitivity_panel(controller: Controller, plants: Plants | None = None) -> Panel:
    """Draw abs(S), with its limits."""
    spec = controller.spec
    ms, slow = spec.level("max_sensitivity"), spec.level("min_sensitivity_bandwidth_hz")

    def lines(axis: Axes) -> None:
        from seaopt.reporting.figures.canvas import LIMIT

        if ms is not None:
            _draw_level(axis, float(_decibel(ms)), f"Ms = {ms:g}")
        if slow:
            axis.plot(
                [LOWEST_HZ, slow],
                [-3.0103, -3.0103],
                color=LIMIT,
                linestyle=":",
                linewidth=1.2,
                label=f"-3 dB up to {slow:g} Hz",
            )

    return _magnitude_panel(
        controller,
        plants,
        lambda loop, f: loop.sensitivity(f),
        "sensitivity",
        "Sensitivity",
        "|S| [dB]",
        "Sensitivity |S| = |1/(1 + L)|: what feedback leaves of a disturbance. Its peak is Ms.",
        lines,
    )


def complementary_panel(controller: Controller, plants: Plants | None = None) -> Panel:
    """Draw abs(T), with its limit."""
    mt = controller.spec.level("max_complementary")

    def lines(axis: Axes) -> None:
        if mt is not None:
            _draw_level(axis, float(_decibel(mt)), f"Mt = {mt:g}")

    return _magnitude_panel(
        controller,
        plants,
        lambda loop, f: 1.0 - loop.sensitivity(f),
        "complementary",
        "Complementary sensitivity",
        "|T| [dB]",
        "Complementary sensitivity |T| = |L/(1 + L)|: what errors of the model at high frequency act on.",
        lines,
    )


def tracking_panel(controller: Controller, plants: Plants | None = None) -> Panel:
    """Draw what is measured over its reference, with the bandwidth that was asked for."""
    spec = controller.spec

    def lines(axis: Axes) -> None:
        from seaopt.reporting.figures.canvas import LIMIT

        axis.axhline(-3.0103, color=LIMIT, linestyle=":", linewidth=1.0, label="-3 dB")
        axis.axvline(spec.bandwidth_hz, color=LIMIT, linestyle="--", linewidth=0.9, label="bandwidth asked")

    return _magnitude_panel(
        controller,
        plants,
        lambda loop, f: loop.tracking(f),
        "tracking",
        "Tracking",
        f"|{spec.regulated}/reference| [dB]",
        f"{spec.regulated} over its reference; the bandwidth is where it has fallen by 3 dB.",
        lines,
    )


def noise_panel(controller: Controller, plants: Plants | None = None) -> Panel:
    """Draw the effort per noise on what is measured, with its limit."""
    limit, unit = controller.spec.level("max_noise_gain"), controller.command.gain_unit

    def lines(axis: Axes) -> None:
        if limit is not None:
            _draw_level(axis, limit, f"noise gain {limit:g}")

    return _magnitude_panel(
        controller,
        plants,
        lambda loop, f: loop.noise(f),
        "noise",
        "Noise gain",
        f"|C_y S| [{unit}]",
        f"Motor {controller.command.mechanics.word} that noise on {controller.signals[0]} makes, per unit of noise.",
        lines,
        decibels=False,
    )


LoopPanel = Callable[[Controller, Plants | None], Panel]
LOOP_PANELS: Mapping[str, LoopPanel] = {
    "step": step_panel, "bode": bode_panel, "nyquist": nyquist_panel, "sensitivity": sensitivity_panel,
    "complementary": complementary_panel, "tracking": tracking_panel, "noise": noise_panel,
}  # fmt: skip
