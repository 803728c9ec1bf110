"""Controllers that several files of this folder examine, tuned once."""

from __future__ import annotations

from contextlib import contextmanager

import pytest

import seaopt as so
from seaopt.robustness.certificate.simulated import STEPS
from tests.checks import leave_out


@pytest.fixture(scope="session")
def robust_controller(stand, swing, thor):
    """Return a controller of 30 Hz, its Ms below 1.6 on the stand and the swing, without a current limit."""
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6)
    return so.tune(stand, thor, spec, robust_to={"swing": swing})


@pytest.fixture(scope="session")
def limited_controller(stand, swing, thor):
    """Return a controller of 30 Hz, its Ms below 1.6 on the stand and the swing, with a current limit of 9 A."""
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)
    return so.tune(stand, thor, spec, robust_to={"swing": swing})


@pytest.fixture(scope="module")
def without_steps():
    """Return a context in which certificates have no simulated steps: of what is linear they take most of the time."""
    return _without_steps


@contextmanager
def _without_steps():
    with pytest.MonkeyPatch.context() as patch:
        leave_out(patch, STEPS)
        yield
