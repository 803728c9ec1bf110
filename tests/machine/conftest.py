from __future__ import annotations

from dataclasses import replace

import pytest

import seaopt as so
from seaopt.control import Gains, Impedance, add_impedance
from tests.machine.simulator import Bench, Machine

KNEE = {"N": 100, "K_tau": 0.0369, "eta": 0.7, "J_m": 2.4e-5, "b_r": 1e-4, "k_s": 300.0}
SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)

OBSERVED = so.ControllerSpec(
    bandwidth_hz=20,
    structure="pid_dob",
    measured="tau_s",
    max_sensitivity=1.6,
    max_noise_gain=45,
    current_limit_A=9.0,
)
GAINS = {
    "k_p": 3.5967254, "k_i": 53.649854, "k_d": 0.10047331, "T_f": 1.9399547e-3, "k_r": 4.4688964, "c": 0.40760695
}  # fmt: skip


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


@pytest.fixture(scope="package")
def observed():
    """Return a law with a disturbance observer, and its machine: a knee with dry friction."""
    plant = so.plants.rotary(link="locked")
    values = plant.complete(so.ParameterSet()).update(**KNEE, f_c=0.005, v_s=1.0)
    law = so.tune(plant, values, OBSERVED)
    observer = replace(law.observer, T_q=2.9989379)  # a slower one tells little in 20 s
    gains = Gains.from_names(GAINS, observer)
    made = gains.law("pid_dob", 1e-3).balanced()
    return replace(law, law=made, gains=gains.by_name(), observer=observer), Machine.of_knee(values)
