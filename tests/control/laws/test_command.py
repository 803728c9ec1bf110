"""What is commanded: its range, its name and its unit, from the plant to the exported code."""

import json
import re
import subprocess

import numpy as np
import pytest

import seaopt as so
from seaopt.control import Controller, MPCSpec, export_mpc, force_mpc
from seaopt.control.deploy.export import export
from seaopt.control.laws.realisation import runnable
from seaopt.errors import ControlError, FileError, PlantError, SeaoptError
from seaopt.estimation import Limits, design_experiment
from seaopt.plants.equations.stored_equations import store_plant
from seaopt.plants.plant import find_range
from seaopt.problem import read_problem
from seaopt.robustness.verification.scenarios import step_scenarios
from tests.c_code import STRICT

PLANT = so.plants.rotary(link="locked", parts=["duty_input"])
VALUES = PLANT.defaults


def tune(plant=PLANT, **limits):
    return so.tune(plant, plant.defaults, so.ControllerSpec(measured="tau_s", bandwidth_hz=15, **limits))


@pytest.fixture(scope="module")
def asked_for_nine():
    return tune(command_limit=9.0)


def stall_torque(duty):
    """Return what a bridge and a stalled motor twist the spring with: the supply sets the current."""
    p = {name: VALUES[name].value for name in ("N", "eta", "K_tau", "V_s", "R")}
    return p["N"] * p["eta"] * p["K_tau"] * p["V_s"] / p["R"] * min(duty, 1.0)


def test_a_duty_above_one_does_nothing_in_the_plant_and_nothing_in_what_is_allowed(asked_for_nine):
    time = np.arange(0.0, 2.0, 1e-3)
    for duty in (9.0, 1.0, 0.4):
        log = so.Log.from_arrays(time=time, duty=np.full(time.size, duty))
        assert so.simulate(PLANT, VALUES, log)["tau_s"][-1] == pytest.approx(stall_torque(duty), rel=1e-3)
    assert asked_for_nine.force_limit(0.0) == pytest.approx(stall_torque(1.0), rel=1e-9)
    assert f"{stall_torque(1.0):g} N m at rest" in repr(asked_for_nine)


@pytest.mark.parametrize(
    ("limits", "holds", "notes"),
    [
        ({"current_limit_A": 9.0}, 1.0, 2),
        ({"command_limit": 9.0}, 1.0, 1),
        ({}, 1.0, 1),
        ({"command_limit": 0.8}, 0.8, 0),
    ],
)
def test_the_smaller_of_what_is_asked_and_the_range_limits_everything(limits, holds, notes):
    controller = tune(**limits)
    assert controller.command_limit == holds
    assert len([note for note in controller.notes if "duty" in note]) == notes
    law = runnable(controller)
    assert law.step(law.reset(), 1e6, 0.0)[0] == holds
    steps = {scenario.name: scenario.phases[-1].force_N for scenario in step_scenarios(controller, PLANT)}
    assert steps["50 % step"] == pytest.approx(0.5 * stall_torque(holds))


def test_a_rate_of_a_duty_has_its_own_name_and_unit():
    """Under the name in amperes it is the same plan, with a note that it is none; both are refused."""
    spec = {"command_limit": 0.9, "measured": "tau_s", "bandwidth_hz": 10, "max_sensitivity": 2.0}
    named, older, none = (
        force_mpc(PLANT, VALUES, MPCSpec(**spec, **rate))
        for rate in ({"command_slew_per_s": 20.0}, {"current_slew_A_per_s": 20.0}, {})
    )
    state, commands = named.start, [0.0]
    for _ in range(20):
        command, state = named.command(state, 0.5 * named.static_gain, 0.0)
        commands.append(command)
    assert np.max(np.abs(np.diff(commands))) == pytest.approx(20.0 * 1e-3, rel=1e-6)
    assert named.command(named.start, 5.0, 0.0)[0] == older.command(older.start, 5.0, 0.0)[0]
    assert none.command(none.start, 0.5 * none.static_gain, 0.0)[0] > 0.03
    assert ", 20 1/s," in " ".join(repr(named).split())
    assert not [note for note in named.notes if "slew" in note]
    (note,) = (note for note in older.notes if "slew" in note)
    assert "20 1/s of duty" in note and "command_slew_per_s is the same" in note
    with pytest.raises(ControlError, match="current_slew_A_per_s = 5 and command_slew_per_s = 6 are both given; give"):
        MPCSpec(**spec, current_slew_A_per_s=5.0, command_slew_per_s=6.0)


def test_a_limit_of_amperes_stays_as_it_is_asked():
    stand = so.plants.high_impedance()
    spec = so.ControllerSpec(bandwidth_hz=30, current_limit_A=9.0)
    controller = so.tune(stand, so.plants.thor(), spec)
    assert controller.command_limit == 9.0
    assert find_range(stand, so.plants.thor()) is None
    mpc = force_mpc(stand, so.plants.thor(), MPCSpec(current_limit_A=9.0, bandwidth_hz=20))
    assert controller.force_limit(0.0) == pytest.approx(9.0 * mpc.static_gain, rel=1e-9)  # one number in both


def test_gains_of_an_angle_have_its_unit():
    arm = so.Plant(
        name="arm", states={"phi": "rad", "w": "rad/s"}, inputs={"I": "A"}, outputs={"phi": "rad"},
        parameters={name: so.Parameter(name=name, value=value, unit=unit) for name, value, unit in (
            ("K", 5.0, "N m/A"), ("J", 0.1, "kg m^2"), ("d", 1.0, "N m s/rad"), ("k", 20.0, "N m/rad"))},
        f=lambda t, x, u, p: {"phi": x.w, "w": (p.K * u.I - p.d * x.w - p.k * x.phi) / p.J},
        h=lambda t, x, u, p: {"phi": x.phi},
        actuation=so.plants.Actuation(input="I", effort=lambda p: p.K, unit="N m"),
    )  # fmt: skip
    spec = so.ControllerSpec(measured="phi", bandwidth_hz=6, bandwidth_range_hz=(1, 60), current_limit_A=9.0)
    controller = so.tune(arm, arm.defaults, spec)
    units = {name: unit for name, (_, unit) in controller.engineering.items()}
    assert units == {"k_p": "A/rad", "k_i": "A/(rad s)", "k_d": "A s/rad", "k_r": "A/rad"}
    text = repr(controller)
    assert "N m/rad" in text
    assert "N m/(N m)" not in text
    assert controller.force_limit(0.0) == pytest.approx(9.0 * 5.0 / 20.0)
    assert "2.25 rad at rest" in text
    assert (
        Controller.from_dict(so.files.plain(controller.to_dict()), arm, arm.defaults).engineering.keys() == units.keys()
    )


def test_two_limits_are_one_too_many():
    with pytest.raises(ControlError, match="command_limit"):
        so.ControllerSpec(current_limit_A=1.0, command_limit=1.0)
    for limits in ({}, {"current_limit_A": 1.0, "command_limit": 1.0}):
        with pytest.raises(ControlError, match="command_limit"):
            MPCSpec(bandwidth_hz=15, **limits)


def test_the_range_comes_back_from_the_file_and_from_the_plant(asked_for_nine, tmp_path):
    content = json.loads(json.dumps(so.files.plain(asked_for_nine.to_dict())))
    assert content["command"]["largest"] == 1.0
    assert Controller.from_dict(content, PLANT, VALUES).command_limit == 1.0
    del content["command"]["largest"]  # as written before there were ranges
    assert Controller.from_dict(content, PLANT, VALUES).command_limit == 1.0
    export(content, tmp_path, name="elbow")  # for which 9 was asked
    assert "#define ELBOW_DUTY_LIMIT 1.0\n" in (tmp_path / "elbow.h").read_text()
    content["command"]["largest"] = 5.0
    with pytest.raises(FileError, match=r"command\.largest"):
        export(content, tmp_path)


def test_a_plant_of_ones_own_states_its_range():
    def make(largest):
        return so.Plant(
            name="own", states={"tau": "N m"}, inputs={"V": "V"}, outputs={"tau": "N m"},
            parameters={"gain": so.Parameter(name="gain", value=2.0, unit="N m/V"),
                        "V_max": so.Parameter(name="V_max", value=12.0, unit="V")},
            f=lambda t, x, u, p: {"tau": 100.0 * (p.gain * u.V - x.tau)}, h=lambda t, x, u, p: {"tau": x.tau},
            actuation=so.plants.Actuation(input="V", effort=lambda p: p.gain, unit="N m", largest=largest),
        )  # fmt: skip

    plant = make(lambda p: p.V_max)
    assert find_range(plant, plant.defaults) == 12.0
    assert find_range(so.Plant(**store_plant(plant)), plant.defaults) == 12.0
    assert find_range(plant, plant.defaults.update(V_max=5.0)) == 5.0
    with pytest.raises(PlantError, match="largest"):
        find_range(make(lambda p: -p.V_max), plant.defaults)


def test_an_experiment_keeps_to_the_range():
    limits = Limits(duration_s=2.0, rate_hz=200, peaks={"tau_s": 1e4})
    design = design_experiment(PLANT, VALUES.free("J_m", "b_r"), limits, sigma={"tau_s": 0.1})
    assert design.peaks["duty"] <= 1.0
    assert design.limits.peak == 1.0


@pytest.mark.parametrize(
    ("part", "symbol", "limit", "unit"),
    [
        ("duty_input", "command_duty", "DUTY_LIMIT", "1/(N m)"),
        ("voltage_input", "voltage_V", "VOLTAGE_LIMIT_V", "V/(N m)"),
    ],
)
def test_exported_files_name_what_is_commanded(part, symbol, limit, unit, tmp_path, compiler):
    controller = tune(so.plants.rotary(link="locked", parts=[part]), command_limit=0.8)
    export(controller, tmp_path, name="elbow")
    texts = {path.name: path.read_text() for path in tmp_path.iterdir()}
    for name, text in texts.items():
        assert not re.search(r"[Cc]urrent|_A\b|, A\b|in A\b|[Aa]mpere", text), name
    assert f"#define ELBOW_{limit} 0.8" in texts["elbow.h"]
    assert f"{symbol}; /* the last command */" in texts["elbow.h"]
    assert f"/* {unit} */" in texts["elbow_gains.h"]
    macros = [line for line in texts["elbow_gains.h"].splitlines() if re.match(r"#define ELBOW_GAIN_", line)]
    assert macros
    assert all("/*" in line for line in macros)  # each has its unit
    command = [*compiler, *STRICT, "-fsyntax-only", str(tmp_path / "elbow.c")]
    subprocess.run(command, check=True)
    assert not re.search(r"current|ampere", repr(controller), re.I)
    assert not re.search(r"current|\bA\b", repr(runnable(controller)))


def test_predictive_control_names_what_is_commanded_and_keeps_to_its_range(tmp_path):
    mpc = force_mpc(PLANT, VALUES, MPCSpec(command_limit=9.0, measured="tau_s", bandwidth_hz=10, max_sensitivity=2.0))
    assert mpc.command_limit == 1.0
    state, commands = mpc.start, []
    for _ in range(60):
        command, state = mpc.command(state, 1e6, 0.0)
        commands.append(command)
    assert max(commands) == pytest.approx(1.0)
    assert max(commands) <= 1.0
    assert "current" not in repr(mpc)
    folder = export_mpc(mpc, tmp_path)
    data = (folder / "force_mpc_data.h").read_text()
    for line in ('COMMAND "duty"', 'COMMAND_UNIT "-"', 'UNIT "N m"'):
        assert f"#define FORCE_MPC_{line}" in data
    assert "mpc_limit = (force_mpc_real)1;" in data
    for name in ("force_mpc.h", "force_mpc.c", "example.c"):
        assert not re.search(r"current|\(A\)|\(N\)", (folder / name).read_text()), name


@pytest.mark.parametrize("keys", ["current_step_A = 0.1\ncommand_step = 0.1"])
def test_two_steps_of_the_amplifier_are_one_too_many(keys, tmp_path):

    (tmp_path / "p.toml").write_text(f'schema = 1\n[plant.a]\nkind = "rotary"\n[robustness]\n{keys}\n')
    with pytest.raises(SeaoptError, match="command_step"):
        read_problem(tmp_path / "p.toml")
