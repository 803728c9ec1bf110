from __future__ import annotations

import pytest

import seaopt as so
from seaopt.control import Impedance, add_impedance
from tests.machine.simulator import Bench

KNEE = {"N": 100, "K_tau": 0.0369, "eta": 0.7, "J_m": 2.4e-5, "b_r": 1e-4, "k_s": 300.0}
SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)


@pytest.fixture(scope="package")
def controller():
    return so.tune(so.plants.high_impedance(), so.plants.thor(), SPEC)


@pytest.fixture(scope="package")
def bench(compiler, tmp_path_factory, controller):
    return Bench(compiler, tmp_path_factory.mktemp("bench"), controller)


def make_knee(stiffness):
    """Return a knee's law that renders an impedance at its link."""
    knee = so.plants.rotary()
    values = knee.complete(so.ParameterSet()).update(**KNEE)
    spec = so.ControllerSpec(bandwidth_hz=20, measured="tau_s", current_limit_A=9.0, max_noise_gain=45)
    law = so.tune(so.plants.rotary(link="locked"), values, spec)
    asked = Impedance(stiffness=stiffness, damping=1.0, velocity_filter_s=0.005)
    return add_impedance(law, knee, values, asked, name="knee")


@pytest.fixture(scope="package")
def impedance():
    """Return a knee's law that renders a stiffness and a damping."""
    return make_knee(20.0)


@pytest.fixture(scope="package")
def damping():
    """Return a knee's law that renders a damping alone."""
    return make_knee(0.0)
