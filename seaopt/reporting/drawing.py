"""Figures as files: the same bytes each time, and their <svg> elements for a page."""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from seaopt.files import write_bytes
from seaopt.formatting import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 130


def write_figure(figure: Figure, path: Path | str) -> list[Path]:
    """Write a figure as SVG and PNG, whose suffixes are added to the path."""
    return [write_bytes(f"{path}.{kind}", render_figure(figure, kind)) for kind in ("svg", "png")]


def render_figure(figure: Figure, kind: str) -> bytes:
    """Return a figure as a file of a kind, the same bytes each time."""
    import matplotlib as mpl

    stream = io.BytesIO()
    metadata = {"Date": None} if kind == "svg" else None
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "seaopt", "font.size": 9.0}):
        _take_literally(figure)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Glyph .* missing")  # a character that the font lacks is a box
            _lay_out(figure)
            figure.savefig(stream, format=kind, dpi=DPI, metadata=metadata)
    return stream.getvalue()


def _take_literally(figure: Figure) -> None:
    r"""Let titles, labels and legends show a channel named "$\foo$" as it is: only numbers at ticks are mathematics."""
    texts = list(figure.texts)
    legends = list(figure.legends)
    for axis in figure.axes:
        texts += [axis.title, axis.xaxis.label, axis.yaxis.label, *axis.texts]
        texts += [getattr(axis, side) for side in ("_left_title", "_right_title") if hasattr(axis, side)]
        legend = axis.get_legend()
        legends += [legend] if legend is not None else []
    for text in [*texts, *(entry for legend in legends for entry in legend.get_texts())]:
        text.set_parse_math(False)
        text.set_text(printable(text.get_text()))


def _lay_out(figure: Figure) -> None:
    """Lay a figure out, once, and leave it without an engine: for one, even an idle one, `savefig` draws twice."""
    for axis in figure.axes:
        for side in (axis.xaxis, axis.yaxis):
            if not side.label.get_text():  # to place it, all tick labels would be measured
                side.set_label_coords(0.5, 0.5)
    engine = figure.get_layout_engine()
    if engine is not None:
        figure.set_dpi(DPI)
        engine.execute(figure)
        figure.set_layout_engine(None)


def inline_svg(svg: str, name: str) -> str:
    """Return the <svg> element alone, without its size, its ids made unique in the page by a name."""
    body = re.sub(r'(<image\b[^>]*?)\sid="[^"]*"', r"\1", svg[svg.index("<svg") :])  # named after what they show, twice
    body = re.sub(r'\bid="', f'id="{name}-', body)
    body = re.sub(r'(xlink:href|href)="#', rf'\1="#{name}-', body)
    body = body.replace("url(#", f"url(#{name}-")
    for size in ("height", "width"):
        body = re.sub(rf'(<svg[^>]*?)\s{size}="[^"]*"', r"\1", body, count=1)
    return body
