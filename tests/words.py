"""Words and units that do not belong to a rotary actuator."""

from __future__ import annotations

import re

WRONG_UNIT = re.compile(r"(?<![A-Za-z_])N(?! m\b|_|\))(?=[\s/\]),;:]|$)|\bforces?\b|N s/m\b|\bN/m\b|\bkg\b(?! m\^2)")


def check_words(*texts):
    """Check that no text speaks of forces, newtons or kilograms where a torque, N m or kg m^2 is meant."""
    for text in map(flatten, texts):
        wrong = WRONG_UNIT.search(text)
        assert wrong is None, text[max(0, wrong.start() - 60) : wrong.end() + 40]


def flatten(text):
    """Return a text on one line, as it was before it was wrapped."""
    return " ".join(text.split())
