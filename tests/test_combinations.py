"""docs/reference/combinations.md says of every part whether it goes with a law: each is tried again."""

import importlib.util
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"
SPEC = importlib.util.spec_from_file_location("combinations", DOCS / "combinations.py")
combinations = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(combinations)


def read_page():
    """Return the reason of each cell by part, in the order of the laws; empty where it works."""
    text = (DOCS / "reference" / "combinations.md").read_text(encoding="utf-8")
    reasons = dict(re.findall(r"^(\d+)\. (.+)$", text, re.MULTILINE)) | {"✓": ""}
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("| ")
    ]
    return {part: [reasons[cell] for cell in cells] for part, *cells in rows[1:]}


def test_the_page_has_every_law_and_part():
    page = read_page()
    assert list(page) == list(combinations.PARTS)
    assert all(len(cells) == len(combinations.LAWS) for cells in page.values())


@pytest.mark.slow
@pytest.mark.parametrize("part", combinations.PARTS)
def test_each_combination_does_what_the_page_says(part, tmp_path):
    for law, reason in zip(combinations.LAWS, read_page()[part], strict=True):
        assert combinations.try_combination(law, part, tmp_path) == reason, law
