"""Loops around a Python law: the plant against scipy, the delay between samples, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import seaopt as so
from seaopt.control import close_loop
from seaopt.control.running import held
from seaopt.control.running.closed_loop import SampledLoop, run_loop
from seaopt.control.running.held import make_hold
from seaopt.errors import ControlError, RunawayError, SimulationError
from tests.control.running.test_closed_loop import delayed, law, swing_by_hand


def proportional(state, reference, measurement):
    """Return 2 r - y over THOR's 240 N/A."""
    return (2.0 * reference - measurement) / 240.0, state


@pytest.mark.parametrize(("friction", "v_s"), [(0.0, 1e-3), (60.0, 2e-5)])
def test_the_plant_is_dop853s_however_sharp_its_friction(swing, thor, friction, v_s):
    params = thor.update(f_c=friction, v_s=v_s, d=0.05)
    reference = np.where(np.arange(300) < 100, 60.0, -30.0)
    run = close_loop(proportional, None, swing, delayed(params, 0.4e-3), reference, disturbance=0.05)
    rate, force = swing_by_hand(params)
    x, waiting, forces, states = np.zeros(4), [0.0, 0.0], [], []
    for k in range(300):
        states.append(x)
        forces.append(force(x))
        waiting.append(proportional(None, reference[k], forces[-1])[0])
        for command, lasting in ((waiting[-3], 0.4e-3), (waiting[-2], 0.6e-3)):
            options = {"method": "LSODA" if friction else "DOP853", "rtol": 1e-11, "atol": 1e-14}
            x = solve_ivp(rate, (0, lasting), x, args=(command + 0.05,), **options).y[:, -1]
    np.testing.assert_allclose(run.force, forces, atol=2e-4 * np.max(np.abs(forces)))
    np.testing.assert_allclose(run.state[:, 2], np.array(states)[:, 2], atol=1e-5)
    assert run.error <= 1e-6
    assert run.substeps == 4 if not friction else run.substeps > 4


@pytest.mark.parametrize("sticks", [False, True])
def test_compiled_and_interpreted_hold_a_plant_alike(stand, thor, sticks):
    """From rest, where it sticks, and where it slides and stops, in two and in eight steps."""
    values, rng = stand.complete(thor.update(f_c=20.0)).vector, np.random.default_rng(1)
    ways = [make_hold(stand, sticks), held._hold_interpreted(stand, sticks)]
    for steps in (2, 8):
        for speed in (0.0, 1e-3, 0.05):
            x, u = np.array([1e-4, speed]) * rng.normal(size=2), [2.0 * rng.normal()]
            compiled, interpreted = (hold(0.0, x, u, values, 1e-3, steps) for hold in ways)
            for one, other in zip(compiled, interpreted, strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-16)


@pytest.mark.parametrize("delay_s", [0.0, 0.7e-3, 2.3e-3])
def test_the_exported_law_runs_here_as_there(swing, thor, delay_s):
    runnable, params = law(3.0), delayed(thor.update(f_c=20.0), delay_s)
    reference = np.where(np.arange(200) < 100, 120.0, -60.0)

    def step(state, wanted, measurement):
        return runnable.step(state, wanted, measurement)

    one = close_loop(step, runnable.reset(), swing, params, reference, delay_samples=2)
    loop = SampledLoop(plant=swing, law=runnable, measured="F1", delay_samples=2, longest_delay_s=2.3e-3)
    other = run_loop(loop, [params], reference)
    np.testing.assert_allclose(one.force, other.outputs["F1"][0], atol=1e-3)
    assert np.max(np.abs(one.current)) == 3.0


def test_friction_sticks_here_as_there_and_peaks_are_between_the_samples_too(stand, thor):
    """The limit slides the drive until spring and friction hold it."""
    runnable, params = law(0.15), stand.complete(thor.update(f_c=20.0))
    reference = np.where(np.arange(300) < 150, 80.0, -80.0)
    one = close_loop(runnable.step, runnable.reset(), stand, params, reference, sticks=True)
    loop = SampledLoop(plant=stand, law=runnable, measured="F1", delay_samples=1, sticks=True)
    other = run_loop(loop, [params], reference)
    still = np.diff(one.state[:, list(stand.states).index("q")]) == 0.0
    assert 10 < np.count_nonzero(still) < 290
    np.testing.assert_allclose(one.force, other.outputs["F1"][0], atol=1e-2)
    assert one.peaks.keys() == other.peaks.keys() and "energy" in one.outputs
    for name, peak in one.peaks.items():
        assert peak == pytest.approx(float(other.peaks[name][0]), rel=1e-3)
        assert peak >= np.max(np.abs(one.outputs[name]))


def test_sensors_and_amplifier_err_here_as_there(thor):
    """The torque computed from two encoders, of which the motor's counts, clips and is off."""
    knee = so.plants.rotary(parts=["deflection_sensor"])
    params = knee.complete(so.ParameterSet.of(k_n=(300.0, "N m/rad")))
    sensors = so.Sensors(
        quantisation={"theta_m": 2e-3, "tau_d": 0.05}, offset={"theta_m": 1e-3, "theta_l": 2e-4},
        saturation={"tau_d": 4.0},
    )  # fmt: skip
    runnable = law(4.3, per_effort=0.4)
    reference = np.where(np.arange(120) < 60, 6.0, -2.0)
    one = close_loop(
        runnable.step, runnable.reset(), knee, params, reference, measured="tau_d", sensors=sensors,
        command_step=0.4, command_limit=4.3,
    )  # fmt: skip
    loop = SampledLoop(plant=knee, law=runnable, measured="tau_d", delay_samples=1, sensors=sensors, command_step=0.4)
    other = run_loop(loop, [params], reference)
    np.testing.assert_allclose(one.force, other.outputs["tau_d"][0], atol=1e-6)
    assert np.max(np.abs(one.current)) == pytest.approx(4.0)  # the last whole step within the limit


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"command_step": -1.0}, "command_step"),
        ({"sensors": so.Sensors(noise_std={"F1": -1.0})}, "noise_std of F1"),
        ({"command_step": 5.0, "command_limit": 4.0}, "above the limit of the command, 4"),
    ],
)
def test_devices_that_cannot_be_are_refused(swing, thor, options, named):
    with pytest.raises(ControlError, match=named):
        close_loop(lambda s, r, y: (0.0, s), None, swing, thor, np.zeros(5), **options)


def test_time_goes_on(thor):
    """x' = a (I + 3 t): x = a (I t + 3 t^2/2)."""
    plant = so.Plant(
        name="clocked", states={"x": "N"}, inputs={"I": "A"}, outputs={"F1": "N"}, parameters={"a": "N/(A s)"},
        f=lambda t, x, u, p: {"x": p.a * (u.I + 3.0 * t)}, h=lambda t, x, u, p: {"F1": x.x},
    )  # fmt: skip
    params = so.ParameterSet([so.Parameter(name="a", value=2.0, unit="N/(A s)")])
    run = close_loop(lambda s, r, y: (1.0, s), None, plant, params, np.zeros(500), delay_samples=0)
    np.testing.assert_allclose(run.force, 2.0 * run.time + 3.0 * run.time**2, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"f_c": 500.0, "v_s": 1e-9}, SimulationError, "smooth the friction"),
        ({"measured": "F9"}, ControlError, "F9"),
        ({"measured": "F2", "delay_samples": 0}, ControlError, "present command"),
        ({"phi": 0.3}, ControlError, "hold phi"),
        ({"law": 1e3}, SimulationError, "does not run away"),
    ],
)
def test_what_is_refused(swing, thor, changes, error, words):
    numbers = {name: changes.pop(name) for name in ("f_c", "v_s") if name in changes}
    params = thor.update(**numbers)
    if "phi" in changes:
        params = params.with_parameters(so.Parameter(name="phi", value=changes.pop("phi"), unit="rad"))
    gain = changes.pop("law", 0.01)
    with pytest.raises(error, match=words):
        close_loop(lambda s, r, y: (gain * (r - y), s), None, swing, params, np.full(400, 80.0), **changes)


def test_a_loop_that_runs_away_is_told(stand, thor):
    with pytest.raises(RunawayError, match="runs away at t = "):
        close_loop(lambda s, r, y: (1e3 * (r - y), s), None, stand, thor, np.full(400, 80.0))
