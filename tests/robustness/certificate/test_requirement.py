"""A requirement is data; its words are made in one place, and a file keeps all of it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from seaopt.codec import to_content
from seaopt.files import to_json
from seaopt.robustness.certificate.requirement import DrawnAt, Requirement
from seaopt.robustness.certificate.stored import read_requirements

ROWS = [
    (Requirement(name="max_sensitivity", limit=1.6, value=1.5, met=True, plant="stand"), "stand"),
    (
        Requirement(
            name="simulation_failures", limit=0.0, value=3.0, met=False, plant="frf:a, b (c): d", state="stuck",
            place=("phi", 0.4), scenario="step", draw=DrawnAt(parameters={"k": 2.0, "eta": 0.9}, number="2", seed=7),
            text="it rings", remedy="sample faster", count=3,
        ),
        "phi = 0.4, frf:a, b (c): d stuck, step, draw 2, seed 7 at k = 2, eta = 0.9: it rings; "
        "the worst of 3 such runs; sample faster",
    ),
    (Requirement(name="min_friction_margin", limit=1.0, value=np.inf, met=True, sense="≥", text="none"), "none"),
]  # fmt: skip


@pytest.mark.parametrize(("row", "words"), ROWS, ids=[row.name for row, _ in ROWS])
def test_words_and_file_follow_from_the_fields(row, words):
    assert row.where == words
    content = json.loads(to_json({"requirements": [to_content(row)]}))
    assert {"name", "limit", "sense", "value", "unit", "met", "plant", "state", "place", "draw", "where"} <= {
        *content["requirements"][0]
    }
    (again,) = read_requirements(content)
    assert again == row


def test_a_whole_number_is_one_with_a_point():
    row = Requirement(name="max_sensitivity", limit=2, value=1, met=True)
    assert json.dumps(to_content(row)) == json.dumps(to_content(replace(row, limit=2.0, value=1.0)))
    assert '"limit": 2.0' in json.dumps(to_content(row))
