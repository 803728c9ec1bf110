"""Figures of fits that are compared: their residuals octave by octave, and the evidence between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from seaopt.estimation import Ranking
from seaopt.reporting.figures.panel import NAMES_LEFT, Panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DECISIVE = 10.0  # a difference of BIC that is very strong evidence


def octave_panels(ranking: Ranking) -> list[Panel]:
    """Return the residual of every fit per octave, a panel per output."""
    outputs = dict.fromkeys((band.experiment, band.output) for band in ranking.bands)
    return [octave_panel(ranking, experiment, output) for experiment, output in outputs]


def octave_panel(ranking: Ranking, experiment: str, output: str) -> Panel:
    """Draw the residual of every fit per octave, of one output."""
    bands = [band for band in ranking.bands if (band.experiment, band.output) == (experiment, output)]

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import COLOURS, scale_log

        (axis,) = axes
        lows = [band.low_hz or band.high_hz / 2.0 for band in bands]
        edges = np.array([*lows, bands[-1].high_hz])
        for row, colour in zip(ranking.rows, COLOURS * 9, strict=False):
            rms = np.sqrt([max(band.power[row.name], 1e-300) for band in bands])
            axis.plot(
                edges, np.append(rms, rms[-1]), drawstyle="steps-post", color=colour, linewidth=1.8, label=row.name
            )
        scale_log(axes)
        scale_log(axes, "y")
        axis.margins(x=0.0)
        axis.set_ylabel(f"rms per octave [{bands[0].unit}]")
        axis.set_xlabel("frequency [Hz]")

    return Panel(
        name=f"octaves_{experiment}_{output}",
        title=f"{experiment}: residual of {output}",
        draw=draw,
        link="frequency",
        caption="Residuals of the fits that are compared, octave by octave: where one falls short.",
    )


def evidence_panel(ranking: Ranking) -> Panel:
    """Draw how far each fit's effective BIC lies above the best one's."""
    best = ranking.rows[0].effective_bic

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import BLUE, LIMIT

        (axis,) = axes
        places = np.arange(len(ranking.rows))[::-1]
        axis.plot([row.effective_bic - best for row in ranking.rows], places, "o", color=BLUE, markersize=7)
        axis.axvline(DECISIVE, color=LIMIT, linestyle="--", linewidth=0.9, label="very strong evidence beyond")
        axis.set_yticks(places, [row.name for row in ranking.rows])
        axis.set_ylim(-0.6, len(ranking.rows) - 0.4)
        axis.set_xscale("symlog", linthresh=DECISIVE)
        axis.set_xlim(left=-1.0)
        axis.set_xlabel("effective BIC above the best [-]")

    return Panel(
        name="evidence",
        title="Evidence against each fit",
        draw=draw,
        heights=(0.5 + 0.12 * len(ranking.rows),),
        left=NAMES_LEFT,
        hover="",
        caption="How far the effective BIC of each fit lies above the best one's, on an axis that is linear up to 10.",
    )
