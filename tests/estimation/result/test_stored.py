"""What a fit.json may hold, and how a mistake in one is named."""

from __future__ import annotations

import json

import numpy as np
import pytest

import seaopt as so
from seaopt.errors import FileError
from seaopt.files import to_json
from tests.damage import put

CONTENT = {
    "schema": "seaopt/fit/2", "met": True, "findings": [],
    "status": "converged", "message": "the cost no longer falls", "cost": 1.5,
    "iterations": 3, "samples": 800, "provenance": {"wall_s": 0.1}, "later": "keys that are not read may stand here",
    "parameters": {
        "J": {"value": 3e-6, "unit": "kg m^2", "free": True, "std": 1e-9, "min": 1e-8, "max": None},
        "eta": {"value": 0.9, "unit": "-", "free": True, "std": None},
        "k": {"value": 655000, "unit": "N/m", "free": False, "std": None},
    },
    "derived": {"m_k": {"value": 400.0, "unit": "kg", "std": None}},
    "covariance": {"names": ["J", "eta"], "matrix": [[1e-18, None], [None, None]]},
    "outputs": {"chirp": {"F1": {
        "fit_percent": 98.0, "holdout_fit_percent": None, "rms_residual": 2.0, "sigma": 2.0, "unit": "N",
        "whiteness_p": None,
    }}},
    "experiments": {"chirp": {
        "delay_s": 0.001, "gain": {"F1": 1.0}, "offset": {"F1": 3.0}, "initial_state": [{"q": 0.0, "qd": 0.0}],
    }},
    "identifiability": {"rank": 1, "free": 2, "condition": None, "unidentifiable": [{"eta": 1.0}]},
}  # fmt: skip


def test_null_is_infinite_where_json_has_no_infinity():
    fit = so.Fit.from_dict(CONTENT)
    assert (fit.parameters["J"].std, fit.parameters["eta"].std, fit.parameters["k"].std) == (1e-9, np.inf, None)
    assert (fit.parameters["J"].min, fit.parameters["J"].max) == (1e-8, np.inf)
    assert fit.parameters.unidentified_names == ("eta",)
    assert fit.covariance.std("J") == pytest.approx(1e-9)
    assert np.isinf(fit.covariance.matrix[0, 1]) and np.isinf(fit.identifiability.condition)
    assert np.isinf(fit.derived["m_k"].std) and np.isnan(fit.outputs["chirp"]["F1"].whiteness_p)
    assert fit.nuisance["chirp"].initial_state == ({"q": 0.0, "qd": 0.0},)
    assert fit.white_covariance.names == ("J", "eta")


@pytest.mark.parametrize(
    ("keys", "value", "words"),
    [
        (("cost",), ..., "key cost is missing"),
        (("parameters", "J", "value"), ..., "key parameters.J.value is missing"),
        (("parameters", "J", "value"), "3e-6", "parameters.J.value = '3e-6': should be a valid number"),
        (("parameters", "J", "value"), True, "parameters.J.value = True"),
        (("parameters", "J", "free"), 1, "parameters.J.free = 1"),
        (("status",), "done", "status = 'done': should be 'converged', "),
        (("iterations",), 2.5, "iterations = 2.5"),
        (("covariance", "matrix"), [[1.0]], "covariance: matrix is not 2 by 2"),
        (("covariance", "matrix"), [[-1.0, 0.0], [0.0, 1.0]], "covariance: has a negative variance"),
        (("covariance", "names"), ["J", "k"], "covariance.names = J, k is not what parameters has free, J, eta"),
        (("outputs", "chirp"), [], "outputs.chirp = []"),
        (("met",), 3, "met = 3"),
        (("met",), False, "met is False, and the other keys make True"),
        (("parameters", "J", "ci95"), [0.0, 1.0], "parameters.J.ci95 is [0.0, 1.0], and the other keys make [2.99"),
    ],
)
def test_a_mistake_is_one_line_with_place_value_and_remedy(keys, value, words):
    with pytest.raises(FileError) as raised:
        so.Fit.from_dict(put(CONTENT, keys, value))
    message = str(raised.value)
    assert message.startswith("fit.json: ") and words in message
    assert message.endswith("; run the fit again") and "\n" not in message


def test_a_fit_read_from_its_file_writes_the_same_bytes():
    fit = so.Fit.from_dict(CONTENT)
    written = to_json(fit.to_dict())
    again = so.Fit.from_dict(json.loads(written))
    assert to_json(again.to_dict()) == written and repr(again) == repr(fit)
