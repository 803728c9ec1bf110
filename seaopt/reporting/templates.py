"""The report's HTML templates, with the filters that write numbers."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import numpy as np

from seaopt.estimation.advice.forecasts import Percent
from seaopt.formatting import MISSING, format_band, format_number


def render_template(name: str, **values: Any) -> str:
    """Return a template of this package with its values filled in, every text escaped."""
    from jinja2 import Environment

    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["number"] = format_number
    environment.filters["band"] = _format_band
    environment.filters["interval"] = _format_interval
    environment.filters["percent"] = _format_percent
    source = files("seaopt.reporting").joinpath(name).read_text(encoding="utf-8")
    return environment.from_string(source).render(**values)


def _format_band(ends: tuple[float, float] | None) -> str:
    return format_band(ends, missing=MISSING)


def _format_interval(ends: tuple[float, float] | None) -> str:
    return " to ".join(format_number(end, 6) for end in ends) if ends and np.all(np.isfinite(ends)) else "unknown"


def _format_percent(percent: Percent) -> str:
    held_out = "" if percent.held_out is None else f" ({format_number(percent.held_out)})"
    return format_number(percent.used) + held_out
