"""The tests check array shapes and types while they run (see conftest): that they do."""

from __future__ import annotations

import numpy as np
import pytest
from beartype.roar import BeartypeCallHintViolation

from seaopt.estimation.problem.normal_equations import measure_decrement


@pytest.mark.parametrize("run", ["first", "after many calls"])
def test_a_wrong_shape_is_caught(run):
    """Calls are checked now and then; the first ones of each test are, whatever ran before it."""
    with pytest.raises(BeartypeCallHintViolation, match="gradient"):
        measure_decrement(np.eye(2), np.ones(3), 1e-12)
    for _ in range(200):
        assert measure_decrement(np.eye(2), np.ones(2), 1e-12) == pytest.approx(2.0)
