from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import coherence, csd, welch

import seaopt as so
from seaopt.errors import LogError
from seaopt.frequency.response import conditioned_responses


def test_h1_and_coherence_are_scipys():
    rng = np.random.default_rng(0)
    u = rng.normal(size=16_000)
    y = np.convolve(u, [0.5, 0.3, 0.1])[: u.size] + 0.2 * rng.normal(size=u.size)
    found = so.h1(u, y, 1 / 400, stretch_s=1000 / 400)
    options = {"fs": 400, "nperseg": 1000}  # Hann's window of a period and half overlap are its own choice
    f, suy = csd(u, y, **options)
    _, suu = welch(u, **options)
    _, gamma = coherence(u, y, **options)
    np.testing.assert_allclose(found.frequency_hz, f[1:])
    np.testing.assert_allclose(found.response, (suy / suu)[1:], rtol=1e-9)
    np.testing.assert_allclose(found.coherence, gamma[1:], rtol=1e-9)


def test_the_stated_std_is_the_scatter():
    """The relative std from the coherence is the scatter of |H1| about the truth over frequencies."""
    rng = np.random.default_rng(1)
    u = rng.normal(size=64_000)
    found = so.h1(u, 2 * u + rng.normal(size=u.size), 1 / 400, stretch_s=2)
    scatter = np.std(np.abs(found.response) / 2 - 1)
    assert scatter == pytest.approx(np.mean(found.relative_std), rel=0.15)


def test_too_little_is_said():
    with pytest.raises(LogError, match="too few"):
        so.h1(np.ones(10), np.ones(10), 0.01)
    with pytest.raises(LogError, match="constant"):
        so.h1(np.ones(1000), np.ones(1000), 0.01)


def test_inputs_that_move_together_have_the_responses_of_one_regression():
    """Of gains, exactly, however alike the inputs; one that does nothing has no coherence beside noise."""
    rng = np.random.default_rng(3)
    first, noise = rng.normal(size=(2, 8000))
    second = 0.8 * first + 0.6 * rng.normal(size=8000)
    (of_first, idle), (of_second, alone) = conditioned_responses(
        (first, second), (3.0 * first - 2.0 * second, second + noise), 1 / 400, stretch_s=0.5
    )
    assert np.allclose(of_first.response, 3.0, rtol=1e-9) and np.allclose(of_second.response, -2.0, rtol=1e-9)
    assert np.min(of_first.coherence) > 0.999
    assert np.mean(idle.coherence) < 2.0 / of_first.averages + 0.02
    # What is left of the second input beside the first has 0.36 of its power, against noise of power one.
    assert np.mean(alone.coherence) == pytest.approx(0.36 / 1.36, abs=0.05)
    with pytest.raises(LogError, match="too few"):
        conditioned_responses((first, second), (first,), 1 / 400, stretch_s=15.0)
