"""Figures of fits that are compared: their residuals octave by octave, and the evidence between them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from seaopt.estimation import Ranking
from seaopt.reporting.figures.panel import BLUE, COLOURS, NAMES_LEFT, Panel, draw_level, frequency_panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DECISIVE = 10.0  # a difference of BIC that is very strong evidence


def octave_panels(ranking: Ranking) -> list[Panel]:
    """Draw the residual of every fit per octave, a figure per output."""
    outputs = dict.fromkeys((band.experiment, band.output) for band in ranking.bands)
    return [_octave_panel(ranking, experiment, output) for experiment, output in outputs]


def _octave_panel(ranking: Ranking, experiment: str, output: str) -> Panel:
    bands = [band for band in ranking.bands if (band.experiment, band.output) == (experiment, output)]

    def draw(axis: Axes) -> None:
        edges = np.array([*(band.low_hz or band.high_hz / 2.0 for band in bands), bands[-1].high_hz])
        for row, colour in zip(ranking.rows, COLOURS * 9, strict=False):
            rms = np.sqrt([max(band.power[row.name], 1e-300) for band in bands])
            rms = np.append(rms, rms[-1])
            axis.plot(edges, rms, drawstyle="steps-post", color=colour, linewidth=1.8, label=row.name)

    return frequency_panel(
        name=f"octaves_{experiment}_{output}",
        title=f"{experiment}: residual of {output}",
        draw=draw,
        y=(f"rms per octave [{bands[0].unit}]",),
        log="xy",
        tight=True,
        caption="Residuals of the fits that are compared, octave by octave: where one falls short.",
    )


def evidence_panel(ranking: Ranking) -> Panel:
    """Draw how far each fit's effective BIC lies above the best one's."""
    best = ranking.rows[0].effective_bic

    def draw(axis: Axes) -> None:
        heights = np.arange(len(ranking.rows))[::-1]
        axis.plot([row.effective_bic - best for row in ranking.rows], heights, "o", color=BLUE, markersize=7)
        draw_level(axis, DECISIVE, "very strong evidence beyond", side="x")
        axis.set_xscale("symlog", linthresh=DECISIVE)
        axis.set_xlim(left=-1.0)

    return Panel(
        name="evidence",
        title="Evidence against each fit",
        draw=draw,
        x="effective BIC above the best [-]",
        rows=[row.name for row in ranking.rows],
        heights=(0.5 + 0.12 * len(ranking.rows),),
        left=NAMES_LEFT,
        hover="",
        caption="How far the effective BIC of each fit lies above the best one's, on an axis that is linear up to 10.",
    )
