"""Results say whether they are met by one word, and answer wrong names with the right ones."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace

import pytest

import seaopt as so
from seaopt.errors import SeaoptError

SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.8)


@pytest.fixture(scope="module")
def controller():
    return so.tune(so.plants.high_impedance(), so.plants.thor(), SPEC)


def test_met_is_in_python_and_in_json_beside_the_older_word(controller):
    assert controller.met is controller.feasible is True
    content = controller.to_dict()
    assert content["met"] is content["feasible"] is True


@pytest.mark.parametrize(
    ("wrong", "right"),
    {"success": "met", "kp": r'gains\["k_p"\]', "k_p": r'gains\["k_p"\]', "save": r"to_dict\(\)",
     "achievd": "achieved", "bandwidth": r"achieved\.bandwidth_hz"}.items(),
)  # fmt: skip
def test_a_wrong_name_is_answered_with_the_right_one(controller, wrong, right):
    with pytest.raises(AttributeError, match=right) as caught:
        getattr(controller, wrong)
    assert isinstance(caught.value, SeaoptError)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("wrong", "right"),
    {"params": "parameters", "success": "met", "residuals": "minimum.residuals", "cov": "covariance",
     "stderr": r'parameters\["NAME"\]\.std'}.items(),
)  # fmt: skip
def test_a_fit_knows_what_users_of_other_tools_try(wrong, right):
    fit = object.__new__(so.Fit)  # no field is set: the answer needs none
    with pytest.raises(AttributeError, match=right):
        getattr(fit, wrong)


def test_what_looks_for_optional_attributes_finds_none(controller):
    assert not hasattr(controller, "_repr_svg_")
    assert not hasattr(controller, "fit")
    assert getattr(controller, "stderr", 3) == 3
    for again in (copy.copy(controller), copy.deepcopy(controller), pickle.loads(pickle.dumps(controller))):
        assert again.met
        assert again.achieved == controller.achieved


def test_a_property_that_fails_by_itself_says_its_own_error():
    fit = object.__new__(so.Fit)
    with pytest.raises(AttributeError, match="status"):
        _ = fit.met


@pytest.mark.parametrize(
    ("make", "right"),
    [
        (lambda: so.ControllerSpec(bandwidth=30), "ControllerSpec has no bandwidth; .*bandwidth_hz"),
        (lambda: replace(SPEC, max_sensitvity=1.6), "max_sensitivity"),
        (lambda: so.Experiment(plant=so.plants.high_impedance(), data=None), "Experiment has no data"),
        (lambda: so.Parameter(name="J", val=1.0), "Parameter has no val; .*value"),
    ],
)
def test_a_wrong_keyword_is_answered_with_the_right_one(make, right):
    with pytest.raises(SeaoptError, match=right) as caught:
        make()
    assert isinstance(caught.value, TypeError)
