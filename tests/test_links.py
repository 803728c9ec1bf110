"""Every link of the documentation leads somewhere, and no line of it is left out; no network is needed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.pages import DOCS, list_pages

ROOT = DOCS.parent
PAGES = [*(f"docs/{name}" for name in list_pages()), "README.md", "CHANGELOG.md", "CONTRIBUTING.md"]


def strip_code(text):
    """Return the text without its code blocks and code spans, in which brackets mean something else."""
    return re.sub(r"`[^`\n]*`", "", re.sub(r"^(```+).*?^\1", "", text, flags=re.DOTALL | re.MULTILINE))


def list_anchors(path):
    """Return the anchors of a page's headings, as GitHub and MyST make them."""
    text = re.sub(r"^(```+).*?^\1", "", path.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    headings = (
        re.sub(r"[*`]|(?<!\w)_|_(?!\w)", "", text) for text in re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    )
    labels = re.findall(r"^\(([\w-]+)\)=$", text, flags=re.MULTILINE)
    return {*labels, *(re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in headings)}


def list_links(text):
    return re.findall(r"\]\(([^)\s]+)(?: \"[^\"]*\")?\)", strip_code(text))


@pytest.mark.parametrize("name", PAGES)
def test_every_link_leads_somewhere(name):
    page = ROOT / name
    for link in list_links(page.read_text(encoding="utf-8")):
        if re.match(r"[a-z]+:", link):
            continue
        target, _, anchor = link.partition("#")
        path = (page.parent / target) if target else page
        assert path.exists(), f"{name}: {link}"
        if anchor:
            assert anchor in list_anchors(path), f"{name}: {link}"


def test_every_file_that_is_named_is_there():
    """Pages name scripts, problems and pages by their paths in the repository."""
    for name in PAGES:
        text = (ROOT / name).read_text(encoding="utf-8")
        for path in re.findall(r"\b(?:docs|problems|benchmarks|notebooks|seaopt|tests|tools)/[\w/.-]+\.\w+", text):
            if name != "CHANGELOG.md":
                assert Path(ROOT / path).exists(), f"{name}: {path}"


def test_a_broken_link_is_seen(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# A title: of two\n\n```text\n# no heading\n```\n[here](#a-title-of-two) and `[not](a link)`\n")
    assert list_anchors(page) == {"a-title-of-two"}
    assert list_links(page.read_text()) == ["#a-title-of-two"]


@pytest.mark.parametrize("name", PAGES)
def test_no_line_is_taken_for_a_comment(name):
    text = strip_code((ROOT / name).read_text(encoding="utf-8"))
    assert not re.findall(r"^ *%.*", text, flags=re.MULTILINE), "MyST leaves a line out that begins with %"
