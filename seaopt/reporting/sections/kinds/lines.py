"""Results that say themselves in a few lines: sweeps of the amplitude, the port at link 2, and its environments."""

from __future__ import annotations

from seaopt.reporting.sections.data import Section

PARTS = {"LargeSignal": "amplitude"}  # of the page; the others are about contact


def describe(result: object) -> list[Section]:
    """Return the lines that the result prints."""
    title, *lines = repr(result).splitlines()
    part = PARTS.get(type(result).__name__, "contact")
    return [Section(title=title, part=part, sentences=tuple(line.strip() for line in lines))]
