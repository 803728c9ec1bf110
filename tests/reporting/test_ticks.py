"""Ticks of finished drawings against matplotlib's own, on the same axes."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg

from seaopt.reporting.figures.canvas import PlainFigure, add_axes, scale_log
from seaopt.reporting.figures.panel import Panel, draw_panel
from seaopt.reporting.figures.ticks import simplify_ticks


def draw_linear(axis):
    axis.plot([-3.0, 7.0], [-120.0, 4e3])


def draw_log(upper, lower):
    upper.plot([0.02, 300.0], [1e-3, 40.0])
    lower.plot([0.02, 300.0], [0.0, 1.0])
    scale_log([upper], "y")


def draw_square(axis):
    axis.plot([-1.0, 1.0], [-1.0, 1.0])
    axis.set_aspect("equal", adjustable="box")


def draw_names(axis):
    axis.plot([0.0, 2.0], [0.0, 2.0])
    axis.set_yticks([0, 1, 2], ["J", "b_r", "eta"])
    axis.tick_params(length=0)


LABELS = {
    draw_linear: {"x": "time [s]", "y": ("force [N]",)},
    draw_log: {"x": "frequency [Hz]", "y": ("gain",), "log": "x", "heights": (0.7, 0.6)},
}


def make_figures(draw):
    """Return the same figure twice, the second with its ticks replaced."""
    panel = Panel(name="one", title="one", draw=draw, **LABELS.get(draw, {}))
    plain, finished = (
        draw_panel(panel, add_axes(PlainFigure(figsize=(5.0, 4.0)), panel.heights, 0.8, final=final))
        for final in (False, True)
    )
    plain, finished = (each.get_figure(root=True) if isinstance(each, Axes) else each for each in (plain, finished))
    simplify_ticks(finished.axes)
    return plain, finished


def paint(figure):
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].astype(int)


@pytest.mark.parametrize("draw", [draw_linear, draw_log, draw_square, draw_names])
def test_they_look_as_matplotlibs_own(draw):
    figures = make_figures(draw)
    for axis in (axis for figure in figures for axis in figure.axes):
        axis.set(xlabel="", ylabel="")
    before, after = map(paint, figures)
    assert np.count_nonzero(before < 128) > 1000
    np.testing.assert_allclose(before, after, atol=2)


@pytest.mark.parametrize("draw", [draw_linear, draw_log])
def test_labels_stand_beyond_the_numbers(draw):
    figures = make_figures(draw)
    for figure in figures:
        paint(figure)
    ours, theirs = (
        [
            side.label.get_window_extent().p0
            for axis in figure.axes
            for side in (axis.xaxis, axis.yaxis)
            if side.label.get_text()
        ]
        for figure in figures
    )
    np.testing.assert_allclose(ours, theirs, atol=1.5)  # pixels


def test_a_logarithmic_side_on_which_nothing_is_drawn_has_no_ticks():
    figure = PlainFigure(figsize=(5.0, 4.0))
    (axis,) = add_axes(figure, (1.0,), 0.8)
    axis.plot([1.0, 10.0], [np.inf, np.inf])
    scale_log([axis], "y")
    simplify_ticks([axis])
    paint(figure)
