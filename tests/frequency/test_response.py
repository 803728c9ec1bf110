from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import coherence, csd, welch

import seaopt as so
from seaopt.errors import LogError


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
