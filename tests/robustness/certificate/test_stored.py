"""What a robustness.json may hold, and how a mistake in one is named."""

from __future__ import annotations

import numpy as np
import pytest

from seaopt.errors import FileError
from seaopt.files import seal
from seaopt.robustness.certificate.stored import read_certificate
from tests.damage import put

CONTENT = {
    "schema": "seaopt/robustness/3", "passed": True,
    "requirements": [{"name": "max_sensitivity", "limit": 1.6, "value": None, "met": False, "where": "stand"}],
    "plants": {
        "stand": {"ms": 1.5, "worst": {"parameters": {}}},
        "swing": {"worst": {"parameters": {"I_p": 0.2}, "ms_lower": 1.5, "ms_upper": None, "mt_lower": 1.2,
                            "mt_upper": None, "bounded_stable": False, "boxes": 7}},
    },
    "monte_carlo": {"samples": 50, "failures": 0, "seed": 1, "failure_probability_bound": 0.2, "confidence": 0.999999},
    "varied": [{"name": "J", "unit": "kg m^2", "value": 3e-6, "std": 1e-9, "low": None, "high": None}],
    "simulation": None,
}  # fmt: skip


def test_null_is_infinite():
    stored = read_certificate(seal(CONTENT))
    assert stored.requirements[0].value == np.inf
    assert (stored.varied[0].low, stored.varied[0].high) == (-np.inf, np.inf)
    assert stored.plants["swing"].worst.parameters == {"I_p": 0.2}


@pytest.mark.parametrize(
    ("keys", "value", "words"),
    [
        (("monte_carlo", "failures"), "none", "monte_carlo.failures = 'none': should be a valid integer"),
        (("monte_carlo", "seed"), ..., "key monte_carlo.seed is missing"),
        (("plants", "swing", "worst", "parameters", "I_p"), "x", "plants.swing.worst.parameters.I_p = 'x'"),
        (("requirements", 0, "met"), 1, "requirements.1.met = 1: should be a valid boolean"),
        (("simulation",), {"seed": 1}, "key simulation.sensors is missing"),
    ],
)
def test_a_mistake_is_one_line_with_place_value_and_remedy(keys, value, words):
    with pytest.raises(FileError) as raised:
        read_certificate(seal(put(CONTENT, keys, value)))
    message = str(raised.value)
    assert message.startswith("robustness.json: ") and words in message
    assert message.endswith("; certify again") and "\n" not in message


def test_a_file_of_an_older_version_is_refused_with_what_to_do():
    with pytest.raises(FileError, match=r'"seaopt/robustness/3"; certify again'):
        read_certificate(seal(CONTENT | {"schema": "seaopt/robustness/2"}))
