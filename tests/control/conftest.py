"""A controller that several files of this folder examine, tuned once."""

from __future__ import annotations

import pytest

import seaopt as so


@pytest.fixture(scope="session")
def tuned(stand, thor):
    """Return a controller of 30 Hz for the stand, with a current limit of 9 A."""
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)
    return so.tune(stand, thor, spec)
