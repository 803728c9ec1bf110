from __future__ import annotations

import pytest

import seaopt as so
from tests.machine.simulator import Bench

SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)


@pytest.fixture(scope="package")
def controller():
    return so.tune(so.plants.high_impedance(), so.plants.thor(), SPEC)


@pytest.fixture(scope="package")
def bench(compiler, tmp_path_factory, controller):
    return Bench(compiler, tmp_path_factory.mktemp("bench"), controller)
