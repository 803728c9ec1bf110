"""The tests check array shapes and types while they run (see conftest): that they do."""

from __future__ import annotations

import os

import numpy as np
import pytest
from beartype.roar import BeartypeCallHintViolation

from seaopt.estimation.problem.normal_equations import measure_decrement
from seaopt.signals import Signal
from seaopt.welch import list_starts, square


@pytest.mark.parametrize("run", ["first", "after many calls"])
def test_a_wrong_shape_is_caught(run):
    """Calls are checked now and then; the first ones of each test are, whatever ran before it."""
    with pytest.raises(BeartypeCallHintViolation, match="gradient"):
        measure_decrement(np.eye(2), np.ones(3), 1e-12)
    for _ in range(200):
        assert measure_decrement(np.eye(2), np.ones(2), 1e-12) == pytest.approx(2.0)


def test_a_wrong_shape_in_a_record_is_caught():
    with pytest.raises(BeartypeCallHintViolation, match="values"):
        Signal(name="I", values=np.ones((2, 2)), unit="A")


@pytest.mark.parametrize(("made", "checked"), [(square, True), (Signal.__init__, True), (list_starts, False)])
def test_what_has_no_arrays_is_left_to_static_types(made, checked):
    assert hasattr(made, "__wrapped__") is (checked or os.environ.get("SEAOPT_TYPES") == "all")
