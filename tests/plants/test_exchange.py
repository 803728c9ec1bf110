"""Plants in other tools, simulated in both."""

from __future__ import annotations

from pathlib import Path

import control
import numpy as np
import pytest

import seaopt as so
from seaopt.errors import PlantError
from seaopt.plants import export_fmu, modes, to_control
from seaopt.simulation.native import find_compiler


@pytest.mark.slow
def test_python_control_simulates_the_same(swing, thor):
    params = thor.update(f_c=20.0, v_s=0.01, d=0.2)
    system = to_control(swing, params)
    assert system.input_labels == ["I"]
    time = np.arange(200) / 400
    current = 2 * np.sin(2 * np.pi * 3 * time)
    theirs = control.input_output_response(
        system,
        time,
        current,
        [0, 0, 0.1, 0],
        solve_ivp_kwargs={"method": "DOP853", "rtol": 1e-9, "atol": 1e-12, "max_step": 1e-3},
    )
    ours = so.simulate(
        swing, params, so.Log.from_arrays(time=time, I=current), initial_state={"phi": 0.1}, hold="first"
    )
    for row, name in enumerate(swing.outputs):
        np.testing.assert_allclose(ours[name], theirs.outputs[row], atol=1e-5 * np.abs(ours[name]).max())


def test_an_fmu_simulates_the_same(swing, thor, tmp_path):
    """A step of current on the nonlinear pendulum, in FMPy (CVode) and here."""
    fmpy = pytest.importorskip("fmpy", reason="FMPy is not installed")
    if find_compiler() is None:
        pytest.skip("no C compiler")
    headers = Path(fmpy.__file__).parent / "c-code"
    path = export_fmu(swing, thor, tmp_path / "swing.fmu", include=headers)
    described = fmpy.read_model_description(str(path))
    assert described.fmiVersion == "3.0"
    n = 400
    step = np.array([(0.0, 1.5), (10.0, 1.5)], dtype=[("time", "f8"), ("I", "f8")])
    run = fmpy.simulate_fmu(
        str(path), stop_time=(n - 1) / 400, output_interval=1 / 400, input=step, relative_tolerance=1e-10,
        output=["F1", "F2", "phi_out"], start_values={"d": 0.1},
    )  # fmt: skip
    ours = so.simulate(swing, thor.update(d=0.1), so.Log.from_arrays(time=np.arange(n) / 400, I=np.full(n, 1.5)))
    for theirs, name in (("F1", "F1"), ("F2", "F2"), ("phi_out", "phi")):
        np.testing.assert_allclose(run[theirs], ours[name], atol=2e-5 * np.abs(ours[name]).max())


def test_an_fmu_of_sources_alone(stand, thor, tmp_path):
    import zipfile

    path = export_fmu(stand, thor, tmp_path / "1-my stäntd #.fmu")
    names = zipfile.ZipFile(path).namelist()
    assert "modelDescription.xml" in names
    assert any(name.endswith(".c") for name in names)


def test_explicit_time_is_not_exported(thor, tmp_path):
    plant = so.Plant(
        name="clocked", states={"x": "m"}, inputs={"u": "N"}, outputs={"x": "m"}, parameters={"a": "1/s"},
        f=lambda t, x, u, p: {"x": -p.a * x.x + t + u.u}, h=lambda t, x, u, p: {"x": x.x},
    )  # fmt: skip
    with pytest.raises(PlantError, match="time"):
        export_fmu(plant, so.ParameterSet.of(a=(1.0, "1/s")), tmp_path / "c.fmu")


def test_modes_are_python_controls(swing, thor):
    found = modes(swing, thor)
    model = swing.linearize(thor)
    np.testing.assert_allclose(np.sort(np.abs(found.poles)), np.sort(np.abs(model.poles())), rtol=1e-8)
    for row, output in enumerate(("F1", "F2")):
        theirs = np.sort(np.abs(model[row, 0].zeros()))
        ours = np.sort(np.abs(found.zeros[output, "I"]))
        np.testing.assert_allclose(ours, theirs[: ours.size], rtol=1e-5)
        assert found.dc_gain[output, "I"] == pytest.approx(model.dcgain()[row, 0], rel=1e-8)
    (resonance,) = found.resonances
    assert resonance.frequency_hz == pytest.approx(17.04, abs=0.01)  # the point mass's; the paper prints 15.76
    assert "phid" in resonance.states
    dip = np.abs(found.zeros["F1", "I"]) / 2 / np.pi
    assert np.min(dip) == pytest.approx(np.sqrt(9.81 / 0.3) / 2 / np.pi, rel=1e-3)  # the pendulum: the dip near 1 Hz


def test_modes_follow_the_operating_point(swing, thor):
    at_rest, raised = modes(swing, thor), modes(swing, thor, x={"phi": 1.0})
    assert raised.resonances[0].frequency_hz < 0.8 * at_rest.resonances[0].frequency_hz
    assert "resonance 17.0" in repr(at_rest)


def test_a_free_mass_has_no_static_gain():
    plant = so.plants.two_link(link2="mass")
    found = modes(plant, plant.defaults).dc_gain
    assert found["F1", "Fe2"] == pytest.approx(1.0, rel=1e-3)  # the spring holds what is pushed
    assert found["F1", "I"] == 0.0  # the motor alone runs away
    assert np.isinf(found["q", "I"])


def test_what_an_export_leaves_out_is_said(stand, thor, tmp_path):
    import xml.etree.ElementTree as ElementTree
    import zipfile

    def describe(plant, *more):
        path = export_fmu(plant, thor.update(f_c=300.0).with_parameters(*more), tmp_path / "plant.fmu")
        with zipfile.ZipFile(path) as packed:
            return ElementTree.fromstring(packed.read("modelDescription.xml")).attrib["description"]

    assert "creeps" not in describe(stand)
    said = describe(so.plants.let_stick(stand))
    assert "creeps" in said
    assert "v_s" in said
    late = so.Parameter(name="drive_delay_s", value=1.32, unit="ms")
    assert "drive" not in said
    assert "The drive's delay of 1.32 ms is not in this FMU" in describe(stand, late)
    assert to_control(stand, thor.with_parameters(late)).name == f"{to_control(stand, thor).name}_without_drive_delay"
