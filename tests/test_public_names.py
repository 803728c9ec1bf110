"""The names that users reach: those of `seaopt` itself, and of its packages; each is on a page of the documentation."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path

import pytest

import seaopt as so
from tests.pages import DOCS

PACKAGES = (
    "parameters", "plants", "logs", "simulation", "bench", "frequency", "estimation", "control", "robustness",
    "problem", "reporting", "fleet", "machine", "testing", "executors", "errors",
)  # fmt: skip


def list_public(package):
    """Return the public names of a package: its `__all__`, or what a module defines; of the errors the classes."""
    module = importlib.import_module(f"seaopt.{package}" if package else "seaopt")
    if hasattr(module, "__all__"):
        return list(module.__all__)
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_") and getattr(value, "__module__", None) == module.__name__
        if package != "errors" or isinstance(value, type)
    ]


def test_the_names_of_the_package_are_those_that_type_checkers_see():
    tree = ast.parse(Path(so.__file__).read_text(encoding="utf-8"))
    (typed,) = (node for node in tree.body if isinstance(node, ast.If))
    names = [alias.name for line in typed.body for alias in line.names]
    assert sorted(names) == sorted(so.__all__) and len(so.__all__) == len(set(so.__all__))
    for name in so.__all__:
        assert getattr(so, name) is not None
        assert name in dir(so)


def test_the_names_are_in_the_order_of_the_data_path():
    order = [package for package in PACKAGES if package != "errors"]
    homes = [so._HOME[name].split(".")[1] for name in so.__all__ if name != "SeaoptError"]
    assert so.__all__ == [*so._HOME]
    assert homes == sorted(homes, key=order.index)


@pytest.mark.parametrize("package", ["", *PACKAGES])
def test_every_public_name_is_on_a_page(package):
    pages = [DOCS.parent / "README.md", *(path for path in DOCS.rglob("*.md") if "_build" not in path.parts)]
    words = set(re.findall(r"\w+", " ".join(path.read_text(encoding="utf-8") for path in pages)))
    assert [name for name in list_public(package) if name not in words] == []


def test_the_reference_lists_the_names_that_are_there():
    listed = re.findall(
        r"^   (seaopt\.[\w.]+)$", (DOCS / "reference" / "api.md").read_text(encoding="utf-8"), flags=re.MULTILINE
    )
    assert len(listed) == len(set(listed))
    for name in listed:
        module, _, last = name.rpartition(".")
        assert hasattr(importlib.import_module(module), last), name
