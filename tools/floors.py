"""Print the lowest version of every library that pyproject.toml declares, as lines for pip's --constraint.

The tests' own tools stay at the versions of constraints.txt.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
EXTRAS = ("hdf5", "ros", "mdf", "tdms")


def list_floors() -> list[str]:
    """Return "name==lowest" for each "name>=lowest" of the core and the extras, and the lines of the tests' tools."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    declared = [*project["dependencies"], *(line for extra in EXTRAS for line in extras[extra])]
    tools = {line.split(">=")[0] for line in extras["test"]}
    pinned = (ROOT / "constraints.txt").read_text().splitlines()
    return [line.replace(">=", "==") for line in declared] + [line for line in pinned if line.split("==")[0] in tools]


if __name__ == "__main__":
    print("\n".join(list_floors()))  # noqa: T201
