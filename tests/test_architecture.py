"""The architecture page tells of the code as it is: rooms, their order, and the names it points to."""

from __future__ import annotations

import importlib
import re
import tomllib
from pathlib import Path

import seaopt
from tests.pages import read_page

ROOT = Path(__file__).resolve().parents[1]
PAGE = read_page("reference/architecture.md")
PACKAGE = Path(seaopt.__file__).parent


def drawn_lines():
    """Return the names of each line of the drawing, and the package whose box it stands in."""
    (drawing,) = re.findall(r"```text\n(.*?)```", PAGE, flags=re.DOTALL)
    box, lines = None, []
    for line in drawing.splitlines():
        if "┌" in line:
            box, beside = re.match(r" ┌ (\w+) ─+┐? ?(\w+)?", line).groups()
            lines.append((None, {box, beside} - {None}))
        elif "└" in line:
            box = None
        else:
            names = re.match(r"[ │]*((?:\w+)(?: \| \w+)*)", line).group(1)
            lines.append((box, set(names.split(" | "))))
    return lines


def test_the_drawing_has_the_order_of_the_import_contracts():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = project["tool"]["importlinter"]["contracts"]
    layers = {contract["containers"][0]: contract["layers"] for contract in contracts if contract["type"] == "layers"}
    for container, rows in layers.items():
        box = None if container == "seaopt" else container.split(".")[-1]
        drawn = [names for where, names in drawn_lines() if where == box]
        assert drawn == [set(row.split(" | ")) for row in rows], container


def test_every_room_is_drawn():
    for package in (None, "control", "estimation", "robustness", "logs"):
        folder = PACKAGE if package is None else PACKAGE / package
        rooms = {path.parent.name for path in folder.glob("*/__init__.py")}
        drawn = set().union(*(names for where, names in drawn_lines() if where == package))
        assert rooms <= drawn, package


def test_every_name_on_the_page_exists():
    for name in re.findall(r"`(seaopt(?:\.\w+)+)`", PAGE):
        module, rest = name, []
        while True:
            try:
                value = importlib.import_module(module)
                break
            except ModuleNotFoundError:
                module, _, last = module.rpartition(".")
                rest.insert(0, last)
        for attribute in rest:
            value = getattr(value, attribute)


def test_no_room_is_crowded():
    for folder in {path.parent for path in PACKAGE.rglob("*.py")}:
        assert len(list(folder.glob("*.py"))) <= 15, folder


def test_type_checkers_are_told_that_it_is_typed():
    assert Path(seaopt.__file__).with_name("py.typed").is_file()
