"""Figures of an acceptance: what was measured at each line, with its disc, beside what was predicted."""

from __future__ import annotations

from typing import Any

import numpy as np

from seaopt.machine.acceptance import Acceptance
from seaopt.machine.response.verdicts import GRACE, Measured
from seaopt.reporting.figures.panel import BLUE, LIMIT, VERMILION, Panel, draw_level, frequency_panel, to_decibel


def list_panels(result: Acceptance) -> list[Panel]:
    """Return sensitivity and tracking, measured and predicted; none without a response."""
    response, controller = result.response, result.controller
    if response is None:
        return []
    alpha, design = 1.0 - response.confidence, controller.design
    loop = None if design is None else controller.close(*design)
    ms, spec = controller.spec.level("max_sensitivity"), controller.spec
    predicted = "predicted, as it slides" if response.friction is not None else "predicted"

    def draw_sensitivity(axis: Any) -> None:
        for part in response.measured:
            centre, radius = part.loop.disc(alpha)
            distance = np.abs(1.0 + centre)
            low = to_decibel(1.0 / (distance + radius))
            high = to_decibel(1.0 / np.maximum(distance - radius, 1e-3))
            _draw_lines(axis, part, to_decibel(1.0 / distance), low, high)
        if loop is not None:
            f = _spread(response.measured)
            axis.plot(f, to_decibel(loop.sensitivity(f)), color=VERMILION, linewidth=1.2, label=predicted)
        draw_level(axis, None if ms is None else ms * (1.0 + GRACE), "Ms = {:g}", decibel=True)

    def draw_tracking(axis: Any) -> None:
        for part in response.measured:
            centre, radius = part.tracking.disc(alpha)
            size = np.abs(centre)
            _draw_lines(
                axis, part, to_decibel(size), to_decibel(np.maximum(size - radius, 1e-6)), to_decibel(size + radius)
            )
        if loop is not None:
            f = _spread(response.measured)
            axis.plot(f, to_decibel(loop.tracking(f)), color=VERMILION, linewidth=1.2, label=predicted)
        axis.axhline(-3.0103, color=LIMIT, linestyle=":", linewidth=0.9, label="-3 dB")
        draw_level(axis, spec.bandwidth_hz, "asked: {:g} Hz", side="x")

    return [
        frequency_panel(
            name="sensitivity", title="Sensitivity", draw=draw_sensitivity, y=("|S| [dB]",), tight=True,
            caption="|S| at the lines of the reference, with the bars that hold it, and as it was predicted.",
        ),
        frequency_panel(
            name="tracking", title="Tracking", draw=draw_tracking, y=("|Y/R| [dB]",), tight=True,
            caption="What is regulated over its reference, measured and predicted.",
        ),
    ]  # fmt: skip


def _spread(measured: tuple[Measured, ...]) -> np.ndarray:
    low, high = (pick(edge for part in measured for edge in (part.f[0], part.f[-1])) for pick in (min, max))
    return np.geomspace(low, high, 300)


def _draw_lines(axis: Any, part: Measured, middle: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    axis.plot(part.f, middle, "o", color=BLUE, markersize=3, label=f"measured, {part.periods} periods")
    axis.vlines(part.f, low, high, color=BLUE, linewidth=0.9)
