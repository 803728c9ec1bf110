"""The README is short, and its figures are those of the pages that it names; its path runs as a doctest."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

import seaopt as so
from tests.pages import DOCS

ROOT = DOCS.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def list_measured():
    """Return the figure, command and page of each row of the table of measured figures."""
    table = README[README.index("## Measured") :].split("\n\n")[1]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]
    return [(figure, command.strip("`"), re.search(r"\((.*)\)", page)[1]) for _, figure, command, page in rows]


def test_the_whole_path_takes_at_most_25_lines():
    (path,) = (block for block in re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL) if "so.fit(" in block)
    typed = [line for line in path.splitlines() if line.startswith((">>>", "..."))]
    assert 10 < len(typed) <= 25
    for verb in ("virtual_log", "fit", "tune", "certify", "write_report"):
        assert f"so.{verb}(" in path


@pytest.mark.parametrize(("figure", "command", "page"), list_measured())
def test_a_measured_figure_is_on_its_page_with_its_command(figure, command, page):
    text = (ROOT / page).read_text(encoding="utf-8")
    script = command.removeprefix("python ")
    assert (ROOT / script).exists() and script in text
    for number in re.findall(r"\d[\d.,]*", figure):
        assert number in text, number


def test_the_picture_is_drawn_from_the_path_and_light():
    """The script has the README's numbers; 60 kB is little for a page."""
    drawn = (DOCS / "readme_figure.py").read_text(encoding="utf-8")
    for words in ("duration_s=164, rate_hz=400, seed=1", "bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25"):
        assert words in drawn and words in README
    assert (DOCS / "figures" / "readme.svg").stat().st_size < 60_000


def test_the_version_stands_in_one_place():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert "version" not in project and project["dynamic"] == ["version"]
    assert re.fullmatch(r"\d+\.\d+\.\d+", so.__version__)
    assert f"## {so.__version__}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert "\nversion:" not in Path(ROOT / "CITATION.cff").read_text(encoding="utf-8")
