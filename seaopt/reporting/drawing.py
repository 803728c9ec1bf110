"""Figures as files: the same bytes each time."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from seaopt.files import write_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 130
TEXT_AS_TEXT: dict[Any, Any] = {"svg.fonttype": "none", "pdf.fonttype": 42, "svg.hashsalt": "seaopt"}


def write_figure(figure: Figure, path: Path | str) -> list[Path]:
    """Write a finished figure as SVG and PNG, whose suffixes are added to the path."""
    from seaopt.reporting.figures.ticks import simplify_ticks

    simplify_ticks(figure.axes)
    return [write_bytes(f"{path}.{kind}", render_figure(figure, kind)) for kind in ("svg", "png")]


def render_figure(figure: Figure, kind: str) -> bytes:
    """Return a figure as a file of a kind, the same bytes each time."""
    from matplotlib import rc_context

    stream = io.BytesIO()
    metadata = {"Date": None} if kind == "svg" else None
    with rc_context(TEXT_AS_TEXT), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing")  # a character that the font lacks is a box
        options: dict[str, Any] = {"pil_kwargs": {"compress_level": 1}} if kind == "png" else {}  # in half the time
        figure.savefig(stream, format=kind, dpi=DPI, metadata=metadata, **options)
    return stream.getvalue()
