"""Panels for a page: their drawings as SVG whose colours follow the page, and what a script needs to zoom and to read.

The drawing is matplotlib's, complete without the script, which finds curves by their ids and reads their points out of
the SVG. Nothing is drawn twice, and no data are repeated.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from seaopt.formatting import printable
from seaopt.records import record
from seaopt.reporting.drawing import render_figure
from seaopt.reporting.figures.panel import Panel, draw_panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes

POINTS_PER_INCH = 72.0  # the units of a drawing
_COLOUR = re.compile(r"#[0-9a-f]{6}\b")
_DIGITS = re.compile(r"(?<=\d\.\d{3})\d+\b")  # beyond a thousandth of a point, of a drawing that is 350 wide
_TAG = re.compile(r"<[^>]*>")
_STYLE = re.compile(r'style="([^"]*)"')


@record
class KeyEntry:
    """A label of the key: which elements it stands for, and the stroke that they are drawn with."""

    label: str
    ids: tuple[str, ...]
    colour: str
    dash: str
    marker: bool


@record
class Chart:
    """A panel on a page; name, title, caption, link and hover are those of the panel, the name made an id."""

    name: str
    title: str
    caption: str
    link: str
    svg: str  # the drawing, an <svg> element whose ids begin with the name
    axes: str  # JSON for the script: the box, sides and curves of each axes; empty where there is nothing to read
    hover: str
    key: tuple[KeyEntry, ...]


def make_chart(panel: Panel) -> Chart:
    """Draw a panel for a page, with every point of its curves in the drawing."""
    from matplotlib import rc_context

    with rc_context({"path.simplify": False}):
        return _make_chart(panel)


def make_id(name: str) -> str:
    """Return a name as an id, another one for every name."""
    return re.sub(r"[^A-Za-z0-9]", lambda match: "-" if match[0] == "_" else f"_{ord(match[0]):x}_", name) or "figure"


def _make_chart(panel: Panel) -> Chart:
    from seaopt.reporting.figures.canvas import label_lines
    from seaopt.reporting.figures.ticks import simplify_ticks

    name = make_id(panel.name)
    drawn: Any = draw_panel(panel, bare=True)
    figure: Any = drawn if len(panel.heights) > 1 else drawn.get_figure(root=True)
    figure.patch.set_visible(False)
    key: dict[str, list[tuple[str, Any]]] = {}
    panes: list[dict[str, Any]] = []
    for number, axis in enumerate(figure.axes):
        axis.patch.set_visible(False)
        axis.set_gid(f"pane{number}")
        curves = _name_curves(axis, number)
        for label in label_lines(axis):
            drawn_artists = (*axis.lines, *axis.collections, *axis.patches)
            artists = [artist for artist in drawn_artists if str(artist.get_label()) == label]
            for index, artist in enumerate(artists):
                if artist.get_gid() is None:
                    artist.set_gid(f"mark{number}-{len(key)}-{index}")
                key.setdefault(label, []).append((artist.get_gid(), artist))
        panes.append(_describe_axes(axis, figure, curves, str(figure.axes[-1].get_xlabel())))
    simplify_ticks(figure.axes)
    svg = _fit_to_page(render_figure(figure, "svg").decode("utf-8"), name, f"{panel.title}. {panel.caption}")
    entries = tuple(_make_entry(label, artists, name) for label, artists in key.items())
    return Chart(
        name=name,
        title=printable(panel.title),
        caption=printable(panel.caption),
        link=panel.link,
        svg=svg,
        axes=json.dumps(panes, separators=(",", ":")) if panel.hover else "",
        hover=panel.hover,
        key=entries if len(entries) > 1 else (),
    )


def _name_curves(axis: Axes, number: int) -> list[dict[str, str]]:
    """Give ids to the curves that have points to read, those in data coordinates; return them with labels."""
    curves: list[dict[str, str]] = []
    for line in axis.lines:
        label = str(line.get_label())
        points = np.asarray(line.get_xdata(orig=False)).size
        if points < 2 or line.get_transform() != axis.transData or (label.startswith("_") and points < 3):
            continue
        line.set_gid(f"curve{number}-{len(curves)}")
        curves.append({"id": str(line.get_gid()), "label": "" if label.startswith("_") else label})
    return curves


def _describe_axes(axis: Axes, figure: Any, curves: list[dict[str, str]], xlabel: str) -> dict[str, Any]:
    """Return the box of axes in the drawing (from its left and top), their sides, and their curves."""
    width, height = (POINTS_PER_INCH * side for side in figure.get_size_inches())
    axis.apply_aspect()
    box = axis.get_position()
    corners = (box.x0 * width, (1.0 - box.y1) * height, box.x1 * width, (1.0 - box.y0) * height)
    return {
        "box": [round(float(corner), 3) for corner in corners],
        "x": _describe_side(axis.get_xlim(), axis.get_xscale(), xlabel),
        "y": _describe_side(axis.get_ylim(), axis.get_yscale(), str(axis.get_ylabel())),
        "curves": curves,
    }


def _describe_side(ends: Sequence[float], scale: str, label: str) -> dict[str, Any]:
    return {"low": float(ends[0]), "high": float(ends[1]), "log": scale == "log", "label": label}


def _make_entry(label: str, artists: list[tuple[str, Any]], name: str) -> KeyEntry:
    from matplotlib.colors import to_hex

    artist = artists[0][1]
    line = hasattr(artist, "get_linestyle") and hasattr(artist, "get_marker")
    style = str(artist.get_linestyle()) if line else "-"
    colour = artist.get_color() if line else (artist.get_facecolor())
    colour = np.atleast_2d(colour)[0] if not isinstance(colour, str) else colour
    dash = {"--": "6 3", "-.": "7 3 2 3", ":": "2 3"}.get(style, "")
    return KeyEntry(
        label=printable(label),
        ids=tuple(f"{name}-{gid}" for gid, _ in artists),
        colour=to_hex(colour),
        dash=dash,
        marker=style in ("None", "none", "") or not line,
    )


def _fit_to_page(svg: str, name: str, alternative: str) -> str:
    """Return the <svg> element alone: without its size, ids unique in the page, colours as the page's variables."""
    body = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    body = re.sub(r'(<image\b[^>]*?)\sid="[^"]*"', r"\1", body)  # named after what they show, twice
    body = re.sub(r'\bid="', f'id="{name}-', body)
    body = re.sub(r'(xlink:href|href)="#', rf'\1="#{name}-', body)
    body = body.replace("url(#", f"url(#{name}-")
    for attribute in ("height", "width", "xmlns:xlink", "xmlns", "version"):
        if attribute != "xmlns:xlink":
            body = re.sub(rf'(<svg[^>]*?)\s{attribute}="[^"]*"', r"\1", body, count=1)
    body = _STYLE.sub(lambda match: f'style="{_COLOUR.sub(_follow, match.group(1))}"', body)
    body = _TAG.sub(lambda match: _DIGITS.sub("", match.group(0)), body)  # not the numbers at ticks
    body = re.sub(r"\s*\n\s*", "\n", body).replace("\nL ", "L")
    return body.replace("<svg", f'<svg role="img" aria-label="{escape(printable(alternative))}"', 1).strip()


def _follow(match: re.Match[str]) -> str:
    """Return a colour as the page's variable of that name, itself where the page has none."""
    colour = match.group(0)
    return f"var(--c{colour[1:]},{colour})"
