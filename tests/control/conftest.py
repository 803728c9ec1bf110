"""A controller that several files of this folder examine, tuned once."""

from __future__ import annotations

import sys

import pytest

import seaopt as so
from seaopt.control.running.closed_loop import run_loop
from seaopt.simulation import run_passes
from seaopt.simulation.simulate import simulate


@pytest.fixture(scope="session")
def tuned(stand, thor):
    """Return a controller of 30 Hz for the stand, with a current limit of 9 A."""
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)
    return so.tune(stand, thor, spec)


@pytest.fixture
def no_simulation(monkeypatch):
    """Let every name that a module of seaopt has for a simulation raise."""

    def fail(*args, **kwargs):
        raise AssertionError("reading a result simulated")

    simulators = {id(function) for function in (run_loop, run_passes, simulate)}
    modules = [module for name, module in sys.modules.items() if name.startswith("seaopt")]
    places = [(module, name) for module in modules for name, value in vars(module).items() if id(value) in simulators]
    assert len(places) > 3
    for module, name in places:
        monkeypatch.setattr(module, name, fail)
