"""Figures of a certificate: how much of each limit is used, draws, worst cases, friction, the port."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from seaopt.control import Controller
from seaopt.control.laws.limits import BY_REQUIREMENT
from seaopt.control.loops.port import hold_response, port_of
from seaopt.control.running.fed_back import close_whole
from seaopt.errors import ControlError
from seaopt.formatting import format_percent
from seaopt.plants.friction import take_sliding
from seaopt.reporting.figures.loop import LOWEST_HZ, Plants, design_of, list_frequencies
from seaopt.reporting.figures.panel import (
    BLUE,
    COLOURS,
    LIMIT,
    MEASURED,
    NAMES_LEFT,
    ORANGE,
    VERMILION,
    Panel,
    draw_level,
    frequency_panel,
    to_decibel,
)
from seaopt.robustness import Certificate
from seaopt.robustness.certificate.requirement import Requirement, usage_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_USED = 3.0  # times a limit: what is beyond stands at the edge
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
    return FROM_DRAWS.get(row.name) or row.name.removesuffix("_s").replace("_", " ")


def requirements_panel(certificate: Certificate) -> Panel:
    """Draw how much of its limit each kind of requirement uses, on the plant that uses most."""
    most: dict[str, tuple[float, Requirement]] = {}
    for row in certificate.requirements:
        used = usage_of(row)
        if used is not None and (row.name not in most or used > most[row.name][0]):
            most[row.name] = (used, row)
    labels = [label_requirement(row) for _, row in most.values()]

    def draw(axis: Axes) -> None:
        heights = np.arange(len(labels))[::-1]
        used = 100.0 * np.minimum([used for used, _ in most.values()], MOST_USED)
        met = np.array([row.met for _, row in most.values()], dtype=bool)
        for rows, colour, marker, label in ((met, BLUE, "o", "met"), (~met, VERMILION, "X", "not met")):
            if rows.any():
                axis.hlines(heights[rows], 0.0, used[rows], color=colour, linewidth=1.2)
                axis.plot(used[rows], heights[rows], marker, color=colour, markersize=7, label=label)
        draw_level(axis, 100.0, "limit", side="x")
        axis.set_xlim(left=0.0)

    return Panel(
        name="requirements",
        hover="",
        title="How much of each limit is used",
        draw=draw,
        x="used of the limit [%]",
        rows=labels,
        heights=(max(0.35 + 0.12 * len(labels), 0.6),),
        caption="For each requirement, the plant, draw or run that uses most of its limit. Beyond 100 % it is not met; "
        f"what uses more than {format_percent(MOST_USED)} is drawn there.",
        left=NAMES_LEFT,
    )


def worst_panel(certificate: Certificate) -> Panel:
    """Draw abs(S) of every plant, nominal and at the worst parameters found."""
    controller, ms = certificate.controller, certificate.controller.spec.level("max_sensitivity")

    def draw(axis: Axes) -> None:
        for (name, plant), colour in zip(certificate.linear_models.items(), COLOURS * 9, strict=False):
            cases = [("", (plant, certificate.parameters), "-")]
            if name in certificate.worst and certificate.worst[name].parameters:
                cases.append((", worst", (certificate.worst[name][0], certificate.worst[name][1]), "--"))
            for word, (model, values), style in cases:
                loop = close_whole(controller, model, values)
                f = list_frequencies(loop)
                size = to_decibel(loop.sensitivity(f))
                axis.plot(f, size, color=colour, linestyle=style, linewidth=1.3, label=f"{name}{word}")
        draw_level(axis, ms, "Ms = {:g}", style="-.", decibel=True)
        axis.set_ylim(bottom=max(axis.get_ylim()[0], -40.0))

    return frequency_panel(
        name="worst",
        title="Sensitivity, nominal and at the worst found",
        draw=draw,
        y=("|S| [dB]",),
        tight=True,
        caption="Sensitivity of every plant at the nominal parameters, and at the worst ones that draws and search "
        "found.",
    )


def draws_panel(certificate: Certificate) -> Panel:
    """Draw which share of the draws has at most a given Ms, on each plant."""
    drawn, ms = certificate.drawn_ms, certificate.controller.spec.level("max_sensitivity")
    if not drawn:
        raise ControlError(
            "this certificate has no draws to show: nothing was uncertain, or it was read from a file; call certify"
        )

    def draw(axis: Axes) -> None:
        for (name, peaks), colour in zip(drawn.items(), COLOURS * 9, strict=False):
            x = np.sort(peaks)
            share = 100.0 * np.arange(1, x.size + 1) / x.size
            stable, worst = np.isfinite(x), certificate.worst[name].ms
            axis.plot(x[stable], share[stable], color=colour, linewidth=1.5, drawstyle="steps-post", label=name)
            if np.isfinite(worst):
                axis.plot([worst], [100.0], "v", color=colour, markersize=7, label=f"{name}, worst found")
        draw_level(axis, ms, "limit {:g}", side="x")

    return Panel(
        name="draws",
        title=f"Ms over {max(peaks.size for peaks in drawn.values())} draws",
        draw=draw,
        x="Ms [-]",
        y=("draws with at most this [%]",),
        caption="Share of the draws whose Ms is at most the one on the axis; triangles: the worst case found by draws "
        f"and search. {certificate.monte_carlo}.",
    )


def friction_panel(certificate: Certificate) -> Panel:
    """Draw how much steeper than the fitted one a plant's friction curve may be for stability to be proved."""
    margins, draws = certificate.friction, certificate.friction_draws
    names = list(dict.fromkeys((*margins, *draws)))
    if not names:
        raise ControlError("no plant of this certificate has friction, so that there is no friction margin to draw")

    def draw(axis: Axes) -> None:
        factors = [margin.factor for margin in (*margins.values(), *draws.values())]
        finite = [factor for factor in factors if np.isfinite(factor) and factor > 0.0]
        low, high = 0.5 * min([1.0, *finite]), 4.0 * max([1.0, *finite])
        rows = {name: row for row, name in enumerate(reversed(names))}
        for label, values, colour, marker in (
            ("nominal", margins, BLUE, "o"),
            ("least of the draws", draws, ORANGE, "D"),
        ):
            points = [(float(np.clip(margin.factor, low, high)), rows[name]) for name, margin in values.items()]
            if points:
                axis.plot(*zip(*points, strict=True), marker, color=colour, markersize=8, label=label)
        draw_level(axis, 1.0, "its own friction", side="x")
        axis.set_xlim(low, high)

    margins_text = " ".join(f"{name}: {margin.describe()}." for name, margin in margins.items())
    return Panel(
        name="friction",
        title="Friction margin",
        draw=draw,
        x="steepest friction shown stable, over its own [-]",
        rows=names,
        log="x",
        heights=(0.5 + 0.12 * len(names),),
        left=NAMES_LEFT,
        hover="",
        caption=f"{margins_text} A margin without a bound is drawn at the right edge, none at the left edge.",
    )


def impedance_panel(controller: Controller) -> Panel:
    """Draw the impedance that a hand meets at link 2, and where it is passive."""
    plant, values = design_of(controller)
    port = port_of(take_sliding(plant, values), values, controller.signals, controller.command.per_effort)
    period = controller.sample_time_s

    def draw(upper: Axes, lower: Axes) -> None:
        from seaopt.reporting.figures.canvas import scale_log

        f = np.geomspace(LOWEST_HZ, 0.499 / period, PORT_POINTS)
        law = controller.law.feedback_responses(f) * hold_response(f, period, controller.compute_delay_samples)
        open_port, closed = port.response(f).impedance(0.0 * law), port.response(f).impedance(law)
        for z, colour, style, label in ((open_port, MEASURED, "--", "no control"), (closed, BLUE, "-", "controlled")):
            upper.plot(f, np.abs(z), color=colour, linestyle=style, linewidth=1.3, label=label)
            lower.plot(f, np.real(z) / np.abs(z), color=colour, linestyle=style, linewidth=1.3, label=label)
        lower.axhline(0.0, color=LIMIT, linewidth=0.9, linestyle=":")
        lower.set_ylim(-1.1, 1.1)
        scale_log([upper], "y")

    return frequency_panel(
        name="impedance",
        title="Impedance at link 2",
        draw=draw,
        y=(f"|Z| [{controller.command.mechanics.unit} s/{port.place_unit}]", "Re Z/|Z| [-]"),
        tight=True,
        heights=(0.9, 0.7),
        caption="Impedance that a hand at link 2 meets, link 1 held. Where Re Z is not below zero the actuator is "
        "passive: nothing passive that it touches there is made unstable by it.",
    )
