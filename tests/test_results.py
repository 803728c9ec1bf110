"""Results say whether they are met by one word, and answer wrong names with the right ones."""

from __future__ import annotations

import copy
import pickle
import sys
from dataclasses import replace
from functools import partial
from importlib import import_module

import pytest

import seaopt as so
from seaopt.errors import SeaoptError
from seaopt.records import Result

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


def list_results(cls=Result):
    """Return the classes of results; a dataclass with slots leaves the class that it was made from behind."""
    return [sub for sub in cls.__subclasses__() if getattr(sys.modules[sub.__module__], sub.__name__, None) is sub]


def test_results_with_a_verdict_share_its_words():
    """Every public class with `met` is one, and so are the parts of results that have a verdict of their own."""
    public = {
        each
        for package in (
            "seaopt",
            *(
                f"seaopt.{name}"
                for name in ("control", "estimation", "robustness", "fleet", "logs", "machine", "testing")
            ),
        )
        for each in map(partial(getattr, import_module(package)), import_module(package).__all__)
        if isinstance(each, type) and ("met" in dir(each) or "met" in getattr(each, "__annotations__", {}))
    }
    assert public <= {*list_results()}
    names = {each.__name__ for each in list_results()}
    assert {"Fit", "Controller", "ForceMPC", "ScheduledController", "Certificate", "Frontier", "FrontierRow",
            "SlidingAlone", "Quality", "ConstrainedRuns", "Requirement", "Simulated",
            "Verification", "Outcome", "JointTuning", "Fleet", "Acceptance", "Replay", "Response", "BringUp",
            "Diagnostics"} <= names  # fmt: skip


@pytest.mark.parametrize("cls", list_results(), ids=lambda cls: cls.__name__)
def test_no_result_is_taken_for_a_truth_value(cls):
    result = object.__new__(cls)
    with pytest.raises(TypeError, match=r"use \.met") as caught:
        bool(result)
    assert isinstance(caught.value, SeaoptError)
    assert hasattr(cls, "met")


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
