from __future__ import annotations

from dataclasses import replace

import pytest

import seaopt as so
from seaopt.control import Gains, Impedance, add_impedance
from seaopt.machine.bringup.excitation import design_excitation
from tests.machine.simulator import Bench, Machine

KNEE = {"N": 100, "K_tau": 0.0369, "eta": 0.7, "J_m": 2.4e-5, "b_r": 1e-4, "k_s": 300.0}
SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)

FRICTION = 40.0  # N, of the dry machine
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


@pytest.fixture(scope="package")
def dry_bench(compiler, tmp_path_factory):
    """Return the bench of a law for a plant with dry friction."""
    values = so.plants.thor().update(f_c=FRICTION, v_s=5e-3)
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=45, current_limit_A=9.0)
    return Bench(compiler, tmp_path_factory.mktemp("dry"), so.tune(so.plants.high_impedance(), values, spec))


def play_against_friction(bench, periods):
    """Return a reference of six sets of phases for that bench."""
    options = {"share": 0.5, "bias": 0.0, "phases": 6, "limits": {"F1": 600.0}, "seed": 1}
    return design_excitation(bench.controller, periods=periods, **options).reference


@pytest.fixture(scope="package")
def dry(dry_bench):
    """Return that bench, and a reference of four periods of each set."""
    return dry_bench, play_against_friction(dry_bench, 4)


@pytest.fixture(scope="package")
def gentle():
    """Return the stages of a knee, of which the first has so little effort that most of it is noise of 0.05 N m, and
    its values.
    """
    knee = so.plants.rotary(link="locked")
    values = knee.complete(so.ParameterSet()).update(
        N=60, K_tau=0.06, eta=0.75, J_m=5e-5, b_r=1e-4, f_c=0.01, v_s=1.0, k_s=180.0
    )
    spec = so.ControllerSpec(
        bandwidth_hz=20, measured="tau_s", current_limit_A=15.0, max_noise_gain=80, max_sensitivity=1.7
    )
    law = so.tune(knee, values, spec)

    def tune_nothing(fraction):
        raise so.SeaoptError("no law at this bandwidth")

    def certify(law):  # steps say enough here: all simulations take ten seconds
        return so.certify(law, {"knee": knee}, values, samples=5, simulations=False)

    options = {"fractions": (0.2,), "limits": {"tau_s": 45.0}, "tune_stage": tune_nothing, "certify_stage": certify}
    plan = so.bring_up(law, {"knee": knee}, values, sensors=so.Sensors(noise_std={"tau_s": 0.05}), **options)
    return plan.stages, values
