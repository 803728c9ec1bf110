"""Figures of a certificate: what limits leave, draws, worst cases, friction, the port."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from seaopt.control import Controller
from seaopt.control.laws.limits import BY_REQUIREMENT
from seaopt.control.loops.port import hold_response, port_of
from seaopt.errors import ControlError
from seaopt.plants.friction import take_sliding
from seaopt.reporting.figures.loop import Plants
from seaopt.reporting.figures.panel import NAMES_LEFT, Panel
from seaopt.robustness import Certificate
from seaopt.robustness.certificate.requirement import Requirement, usage_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_USED = 3.0  # times a limit: what is beyond stands at the edge
LOWEST_HZ = 0.05
PORT_POINTS = 800
FROM_DRAWS = {
    "monte_carlo_failures": "draws that fail",
    "worst_case": "worst case, of its limits",
    "max_failure_probability": "failure probability",
}


def plants_of(certificate: Certificate) -> Plants:
    """Return the plants whose loops are measured, at the nominal parameters: one with friction sliding and stuck."""
    return {name: (plant, certificate.parameters) for name, plant in certificate.linear_models.items()}


def label_requirement(row: Requirement) -> str:
    """Return a requirement's name in words."""
    if row.name in BY_REQUIREMENT:
        return BY_REQUIREMENT[row.name].label
    if row.name in FROM_DRAWS:
        return FROM_DRAWS[row.name]
    return row.name.removesuffix("_s").replace("_", " ")


def requirements_panel(certificate: Certificate) -> Panel:
    """Draw how much of its limit each kind of requirement uses, on the plant that uses most."""
    most: dict[str, tuple[float, Requirement]] = {}
    for row in certificate.requirements:
        used = usage_of(row)
        if used is not None and (row.name not in most or used > most[row.name][0]):
            most[row.name] = (used, row)
    labels = [label_requirement(row) for _, row in most.values()]

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import BLUE, LIMIT, VERMILION

        (axis,) = axes
        places = np.arange(len(labels))[::-1]
        for met, colour, marker in ((True, BLUE, "o"), (False, VERMILION, "X")):
            rows = [
                (place, min(used, MOST_USED))
                for place, (used, row) in zip(places, most.values(), strict=True)
                if row.met == met
            ]
            if rows:
                at = np.array(rows, dtype=float)
                axis.hlines(at[:, 0], 0.0, 100.0 * at[:, 1], color=colour, linewidth=1.2)
                axis.plot(
                    100.0 * at[:, 1],
                    at[:, 0],
                    marker,
                    color=colour,
                    markersize=7,
                    linestyle="",
                    label="met" if met else "not met",
                )
        axis.axvline(100.0, color=LIMIT, linestyle="--", linewidth=0.9, label="limit")
        axis.set_yticks(places, labels)
        axis.set_ylim(-0.6, len(labels) - 0.4)
        axis.set_xlim(left=0.0)
        axis.grid(visible=False, axis="y")
        axis.set_xlabel("used of the limit [%]")

    return Panel(
        name="requirements",
        hover="",
        title="How much of each limit is used",
        draw=draw,
        heights=(max(0.35 + 0.12 * len(labels), 0.6),),
        caption="Of each requirement the plant, draw or run that uses most of its limit. Beyond 100 % it is not met; "
        f"what uses more than {100 * MOST_USED:g} % stands there.",
        left=NAMES_LEFT,
    )


def worst_panel(certificate: Certificate) -> Panel:
    """Draw abs(S) of every plant, nominal and at the worst parameters found."""
    controller, ms = certificate.controller, certificate.controller.spec.level("max_sensitivity")

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import COLOURS, LIMIT, scale_log

        (axis,) = axes
        for (name, plant), colour in zip(certificate.linear_models.items(), COLOURS * 9, strict=False):
            cases = [("", (plant, certificate.parameters), "-")]
            if name in certificate.worst and certificate.worst[name].parameters:
                cases.append((", worst case", (certificate.worst[name][0], certificate.worst[name][1]), "--"))
            for word, (model, values), style in cases:
                loop = controller.close(model, values)
                f = loop.grid()
                f = f[(f >= LOWEST_HZ) & (f < 0.999 * loop.plant.nyquist_hz)]
                size = 20 * np.log10(np.maximum(np.abs(loop.sensitivity(f)), 1e-12))
                axis.plot(f, size, color=colour, linestyle=style, linewidth=1.3, label=f"{name}{word}")
        if ms is not None:
            axis.axhline(20 * np.log10(ms), color=LIMIT, linestyle="-.", linewidth=0.9, label=f"Ms = {ms:g}")
        axis.set_ylim(bottom=max(axis.get_ylim()[0], -40.0))
        axis.margins(x=0.0)
        scale_log(axes)
        axis.set_xlabel("frequency [Hz]")
        axis.set_ylabel("|S| [dB]")

    return Panel(
        name="worst",
        title="Sensitivity, nominal and at the worst found",
        draw=draw,
        link="frequency",
        caption="Sensitivity of every plant at the nominal parameters, and at those that draws and search found worst.",
    )


def draws_panel(certificate: Certificate) -> Panel:
    """Draw which share of the draws has at most a given Ms, on each plant."""
    drawn, ms = certificate.drawn_ms, certificate.controller.spec.level("max_sensitivity")
    if not drawn:
        raise ControlError(
            "this certificate has no draws to show: nothing was uncertain, or it was read from a file; call certify"
        )

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import COLOURS, LIMIT

        (axis,) = axes
        for (name, peaks), colour in zip(drawn.items(), COLOURS * 9, strict=False):
            x = np.sort(peaks)
            share = 100.0 * np.arange(1, x.size + 1) / x.size
            stable = np.isfinite(x)
            axis.plot(x[stable], share[stable], color=colour, linewidth=1.5, drawstyle="steps-post", label=name)
            if np.isfinite(certificate.worst[name].ms):
                axis.plot(
                    [certificate.worst[name].ms], [100.0], "v", color=colour, markersize=7, label=f"{name}, worst found"
                )
        if ms is not None:
            axis.axvline(ms, color=LIMIT, linestyle="--", linewidth=0.9, label=f"limit {ms:g}")
        axis.set_xlabel("Ms [-]")
        axis.set_ylabel("draws with at most this [%]")

    count = max(peaks.size for peaks in drawn.values())
    return Panel(
        name="draws",
        title=f"Ms over {count} draws",
        draw=draw,
        caption="Share of the draws whose Ms is at most the one on the axis; triangles: the worst case found by draws "
        f"and search. {certificate.monte_carlo}.",
    )


def friction_panel(certificate: Certificate) -> Panel:
    """Draw how much steeper than its own a plant's friction may be for stability to be shown."""
    margins, draws = certificate.friction, certificate.friction_draws
    names = list(dict.fromkeys((*margins, *draws)))
    if not names:
        raise ControlError("no plant of this certificate has friction, so that there is no friction margin to draw")

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import BLUE, LIMIT, ORANGE

        (axis,) = axes
        places = {name: place for place, name in enumerate(reversed(names))}
        shown: dict[str, tuple[Any, Any, str, str]] = {
            "nominal": (margins, lambda one: one.factor, BLUE, "o"),
            "least of the draws": (draws, lambda one: one.factor, ORANGE, "D"),
        }
        finite = [factor(one) for values, factor, _, _ in shown.values() for one in values.values()]
        finite = [value for value in finite if np.isfinite(value) and value > 0.0]
        low, high = 0.5 * min([1.0, *finite]), 4.0 * max([1.0, *finite])
        for label, (values, factor, colour, marker) in shown.items():
            at = [(float(np.clip(factor(one), low, high)), places[name]) for name, one in values.items()]
            if at:
                axis.plot(*zip(*at, strict=True), marker, color=colour, markersize=8, label=label)
        axis.axvline(1.0, color=LIMIT, linestyle="--", linewidth=0.9, label="its own friction")
        axis.set_yticks(list(places.values()), list(places))
        axis.set_ylim(-0.6, len(names) - 0.4)
        axis.set_xlim(low, high)
        axis.grid(visible=False, axis="y")
        axis.set_xlabel("steepest friction shown stable, over its own [-]")
        from seaopt.reporting.figures.canvas import scale_log

        scale_log(axes)

    said = " ".join(f"{name}: {margin.describe()}." for name, margin in margins.items())
    return Panel(
        name="friction",
        title="Friction margin",
        draw=draw,
        heights=(0.5 + 0.12 * len(names),),
        left=NAMES_LEFT,
        hover="",
        caption=f"{said} What has no bound stands at the right edge, what is not shown at the left one.",
    )


def impedance_panel(controller: Controller) -> Panel:
    """Draw what the actuator is to a hand at link 2: its impedance, and where it is passive."""
    if controller.design is None:
        raise ControlError("the controller does not know its design plant; read it with Controller.from_dict")
    plant, values = controller.design
    port = port_of(take_sliding(plant, values), values, controller.signals, controller.command.per_effort)
    period = controller.sample_time_s

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import BLUE, LIMIT, MEASURED, scale_log

        upper, lower = axes
        f = np.geomspace(LOWEST_HZ, 0.499 / period, PORT_POINTS)
        law = controller.law.feedback_responses(f) * hold_response(f, period, controller.compute_delay_samples)
        open_port, closed = port.response(f).impedance(0.0 * law), port.response(f).impedance(law)
        for z, colour, style, label in ((open_port, MEASURED, "--", "no control"), (closed, BLUE, "-", "controlled")):
            upper.plot(f, np.abs(z), color=colour, linestyle=style, linewidth=1.3, label=label)
            lower.plot(f, np.real(z) / np.abs(z), color=colour, linestyle=style, linewidth=1.3, label=label)
        lower.axhline(0.0, color=LIMIT, linewidth=0.9, linestyle=":")
        lower.set_ylim(-1.1, 1.1)
        upper.margins(x=0.0)
        scale_log(axes)
        scale_log([upper], "y")
        upper.set_ylabel(f"|Z| [{controller.command.mechanics.unit} s/{port.place_unit}]")
        lower.set_ylabel("Re Z/|Z| [-]")
        lower.set_xlabel("frequency [Hz]")

    return Panel(
        name="impedance",
        title="Impedance at link 2",
        draw=draw,
        heights=(0.9, 0.7),
        link="frequency",
        caption="Impedance that a hand at link 2 meets, link 1 held. Where Re Z is not below zero the actuator is "
        "passive: nothing passive that it touches there is made unstable by it.",
    )
