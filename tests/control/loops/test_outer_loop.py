"""The outer loop against SciPy's filter."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from seaopt.control import OuterLoop


def test_it_is_stiffness_and_filtered_difference() -> None:
    rng = np.random.default_rng(0)
    x, x_0 = rng.normal(size=50), rng.normal(size=50)
    outer = OuterLoop(
        stiffness=30.0, damping=2.0, velocity_filter_s=3e-3, direction=-1.0, sample_time_s=1e-3, place_unit="m"
    )
    state, got = outer.reset(x[0]), []
    for reference, position in zip(x_0, x, strict=True):
        asked, state = outer.step(state, float(reference), float(position))
        got.append(asked)
    speed = np.asarray(lfilter([1.0 / 4e-3, -1.0 / 4e-3], [1.0, -3.0 / 4.0], x - x[0]))
    assert got == pytest.approx(-(30.0 * (x_0 - x) - 2.0 * speed), rel=1e-12)


def test_its_response_is_its_difference() -> None:
    outer = OuterLoop(
        stiffness=0.0, damping=1.0, velocity_filter_s=2e-3, direction=1.0, sample_time_s=1e-3, place_unit="rad"
    )
    points = np.array([0.9, 1.1])
    z = points.astype(complex)
    step = 1e-6
    slope = (outer.difference(z + step) - outer.difference(z - step)) / (2 * step)
    assert np.real(slope) == pytest.approx(outer.difference_slope(points), rel=1e-6)
