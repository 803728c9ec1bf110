"""Scores of controllers in words: tracking, apparent impedance, its passivity and noise, a row per controller."""

from __future__ import annotations

from seaopt.control import Scorecard
from seaopt.control.impedance.scorecard import HEADS
from seaopt.reporting.sections.data import Section, Table


def describe(card: Scorecard) -> list[Section]:
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
