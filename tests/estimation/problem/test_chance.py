"""Probabilities and sizes of transforms, against SciPy's."""

import numpy as np
import pytest
from scipy.fft import next_fast_len, prev_fast_len
from scipy.special import gammaincc

from seaopt.estimation.problem.chance import exceeds
from seaopt.estimation.problem.correlation import find_quick_size, find_quick_size_within, ljung_box


@pytest.mark.parametrize("shape", [0.1, 0.5, 1.0, 2.5, 12.0, 140.5, 3000.0, 1e5])
def test_what_chance_exceeds(shape: float) -> None:
    """Below the mean and above it, far into both tails, and where series and fraction meet."""
    around = shape + np.sqrt(shape) * np.array([-8.0, -2.0, -0.5, 0.0, 0.5, 2.0, 8.0, 30.0])
    for x in [*around[around > 0.0], shape + 1.0 - 1e-9, shape + 1.0, 1e-3 * shape, 4.0 * shape]:
        assert exceeds(shape, float(x)) == pytest.approx(float(gammaincc(shape, x)), rel=1e-9, abs=1e-290)


def test_chance_at_the_ends() -> None:
    """All is above zero, nothing above infinity; and what is no number is not chance: no test passes on it."""
    assert [exceeds(3.0, x) for x in (0.0, -1.0, np.inf, 1e9)] == [1.0, 1.0, 0.0, 0.0]
    assert [exceeds(0.0, x) for x in (0.0, 1e-9)] == [1.0, 0.0]  # of no degrees of freedom: the constant 0
    assert np.isnan(exceeds(3.0, np.nan)) and np.isnan(ljung_box(np.array([0.1, np.nan]), 100))


def test_sizes_of_quick_transforms() -> None:
    """The next and the last number without a prime factor above 5."""
    for n in [*range(1, 2000), *np.random.default_rng(1).integers(2000, 10**8, 500)]:
        assert find_quick_size(int(n)) == next_fast_len(int(n), real=True)
        assert find_quick_size_within(int(n)) == prev_fast_len(int(n), real=True)
    assert find_quick_size_within(0) == 1
