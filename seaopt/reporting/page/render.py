"""The report's HTML templates, with the filters that write numbers."""

from __future__ import annotations

import re
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

from seaopt.estimation.advice.forecasts import Percent
from seaopt.formatting import MISSING, format_band, format_number, printable
from seaopt.units import unit_after

if TYPE_CHECKING:
    from jinja2 import Environment

FIXED = {"style": "style.css", "script": "script.js", "table_script": "table.js"}  # files that pages take as they are


def render_template(name: str, **values: Any) -> str:
    """Return a template of this package with its values filled in, every text escaped."""
    return _make_environment().get_template(name).render(values)


@cache
def _make_environment() -> Environment:
    """Return what keeps the templates that it has compiled, with the filters and the files that all of them take."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=PackageLoader("seaopt.reporting.page", "templates"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
        finalize=_show,
    )
    environment.filters |= {
        "number": format_number,
        "band": _format_band,
        "interval": _format_interval,
        "percent": _format_percent,
        "unit": _format_unit,
        "slug": make_slug,
    }
    folder = files("seaopt.reporting.page").joinpath("templates")
    fixed: dict[str, Any] = {
        name: Markup(folder.joinpath(file).read_text(encoding="utf-8"))  # noqa: S704
        for name, file in FIXED.items()
    }
    environment.globals.update(fixed)
    return environment


def make_slug(text: str) -> str:
    """Return a text as an id.

    Examples
    --------
    >>> make_slug("Margins on every plant")
    'margins-on-every-plant'

    """
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


def _show(value: Any) -> Any:
    """Return a text with its control characters shown, markup as it is."""
    return printable(value) if isinstance(value, str) and not hasattr(value, "__html__") else value


def _format_unit(unit: str) -> str:
    return unit_after(unit).strip()


def _format_band(ends: tuple[float, float] | None) -> str:
    return format_band(ends, missing=MISSING)


def _format_interval(ends: tuple[float, float] | None) -> str:
    return " to ".join(format_number(end, 6) for end in ends) if ends and np.all(np.isfinite(ends)) else "unknown"


def _format_percent(percent: Percent) -> str:
    held_out = "" if percent.held_out is None else f" ({format_number(percent.held_out)})"
    return format_number(percent.used) + held_out
