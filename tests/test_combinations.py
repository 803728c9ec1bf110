"""docs/reference/combinations.md says of every part whether it goes with a law, as one run of all of them found it."""

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


def test_the_page_has_every_law_and_part_as_it_is_written():
    page = read_page()
    assert combinations.PAGE.read_text(encoding="utf-8") == combinations.compose_page(page)
    assert list(page) == list(combinations.PARTS)
    assert all(len(cells) == len(combinations.LAWS) for cells in page.values())


def test_what_the_page_refuses_is_refused_for_that_reason(tmp_path):
    cells = [
        (law, part, reason)
        for part, reasons in read_page().items()
        for law, reason in zip(combinations.LAWS, reasons, strict=True)
        if reason
    ]
    assert cells
    found = [combinations.try_combination(law, part, tmp_path) for law, part, _ in cells]
    assert found == [reason for *_, reason in cells]


def test_a_schedule_whose_link_is_fed_forward_is_certified(tmp_path):
    """The link is that of a plant it was tuned on besides: once its certificate left those out, and was refused."""
    assert not combinations.try_combination("schedule of `pid`", "`link_feedforward`", tmp_path)


def test_a_plan_is_played_where_friction_lets_go_late(tmp_path):
    """Errors were measured by states that had hardly moved yet, and no step was short enough."""
    assert not combinations.try_combination("predictive control", "friction, from the speed", tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("part", combinations.PARTS)
def test_a_row_of_the_page_is_what_a_run_finds(part, tmp_path):
    assert combinations.try_row(part, tmp_path) == read_page()[part]
