"""The report's HTML templates, with the filters that write numbers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup, escape

from seaopt.files import write_text
from seaopt.formatting import format_number, printable
from seaopt.reporting.sections.data import KeyFigure, Section, Verdict
from seaopt.reporting.sections.glossary import explain_terms
from seaopt.reporting.sections.html import render_section

if TYPE_CHECKING:
    from jinja2 import Environment

FIXED = {"style": "style.css", "script": "script.js", "table_script": "table.js"}  # files that pages take as they are


def render_template(name: str, **values: Any) -> str:
    """Return a template of this package with its values filled in, every text escaped."""
    return _make_environment().get_template(name).render(values)


def render_parts(sections: Iterable[Section], headings: Mapping[str, str]) -> dict[str, list[Markup]]:
    """Return sections as HTML, by the part of the page where they stand, whose heading is not repeated."""
    parts: dict[str, list[Markup]] = {}
    for section in sections:
        html = render_section(section, title=bool(section.aside) or section.title != headings[section.part])
        parts.setdefault(section.part, []).append(Markup(html))  # noqa: S704 - escaped there
    return parts


def write_result_page(
    path: Path | str,
    *,
    title: str,
    parts: Mapping[str, str],
    verdict: Verdict | None,
    glance: Sequence[KeyFigure],
    sections: Iterable[Section],
    plates: Mapping[str, Any],
) -> Path:
    """Write the page of a result that is no stage of a report; sections and plates stand in its `parts`."""
    html = render_template(
        "page.html.jinja",
        title=title,
        parts=parts,
        verdicts=[verdict],
        glance=glance,
        described=render_parts(sections, parts),
        plates=plates,
        doubt="",
        controller=None,
        header=None,
    )
    return write_text(Path(path), html)


@cache
def _make_environment() -> Environment:
    """Return what keeps the templates that it has compiled, with the filters and the files that all of them take."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("seaopt.reporting.page", "templates"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
        finalize=_show,
    )
    environment.filters["number"] = format_number
    environment.filters["explain"] = lambda text: Markup(explain_terms(escape(text)))  # noqa: S704
    folder = files("seaopt.reporting.page").joinpath("templates")
    fixed: dict[str, Any] = {
        name: Markup(folder.joinpath(file).read_text(encoding="utf-8"))  # noqa: S704
        for name, file in FIXED.items()
    }
    environment.globals.update(fixed)
    return environment


def _show(value: Any) -> Any:
    """Return a text with its control characters shown, markup as it is."""
    return printable(value) if isinstance(value, str) and not hasattr(value, "__html__") else value
