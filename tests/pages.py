"""The documentation's pages, for the tests that hold them against the code."""

from __future__ import annotations

import re
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1] / "docs"


def list_pages():
    """Return every page of the site, by its path below docs."""
    paths = (path.relative_to(DOCS) for path in DOCS.rglob("*.md"))
    return sorted(str(path) for path in paths if not path.parts[0].startswith("_"))


def read_page(name):
    return (DOCS / name).read_text(encoding="utf-8")


def unbroken(name):
    """Return a page without its line breaks."""
    return " ".join(read_page(name).split())


def blocks(name, language):
    """Return the code blocks of a page in one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", read_page(name), flags=re.DOTALL | re.MULTILINE)
