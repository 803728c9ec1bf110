"""Results of a few lines: scores of controllers, sweeps of the amplitude, the port at link 2, and its environments."""

from __future__ import annotations

from seaopt.control import Scorecard
from seaopt.control.impedance.scorecard import HEADS
from seaopt.reporting.sections.data import Section, Table

PARTS = {"LargeSignal": "amplitude"}  # of the page; the others are about contact


def describe(result: object) -> list[Section]:
    """Return a table of scores, or the lines that the result prints."""
    if isinstance(result, Scorecard):
        return _describe_scores(result)
    title, *lines = repr(result).splitlines()
    part = PARTS.get(type(result).__name__, "contact")
    return [Section(title=title, part=part, sentences=tuple(line.strip() for line in lines))]


def _describe_scores(card: Scorecard) -> list[Section]:
    """Return the table of scores."""
    rows = tuple((name, *score.cells()) for name, score in card.scores.items())
    return [
        Section(
            title="Scorecard",
            aside=f"impedance and damper in {card.unit}",
            part="contact",
            tables=(Table(head=("controller", *HEADS), rows=rows, align="<".ljust(len(HEADS) + 1, ">")),),
            remarks=(
                "On the design plant, link 1 held. Damper: what makes the impedance passive everywhere; of no control: "
                "a root mean square from 0.1 Hz to the bandwidth; noise: from the sensor to the effort, at its peak "
                "and for white noise.",
            ),
        )
    ]
