"""Motors that saturate, friction that drifts or differs by direction: against equations that SciPy integrates."""

import math
import pickle

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import seaopt as so
from seaopt.errors import PlantError
from seaopt.plants.parts import add_part

TRUTH = {"J_m": 2.4e-5, "b_r": 1.5e-4, "f_c": 0.02, "v_s": 2.0, "N": 100.0, "K_tau": 0.05, "k_s": 300.0, "c_s": 0.5}
EFFECTS = {
    "droop": {"a_i": 0.012},
    "falling_torque": {"a_v": 0.2},
    "friction_drift": {"w_c": 0.4, "b_t": 8e-5, "r_t": 0.9},
    "friction_direction": {"f_a": 0.006, "b_a": -4e-5},
    "back_driving": {"d_e": 0.06},
    "cogging": {"a_g": 0.01, "b_g": -0.006, "n_g": 1.4},
    "stand": {"c_t": 1.0 / (15.0 * 300.0)},
}
NONLINEAR = ("droop", "falling_torque", "friction_drift", "friction_direction")


def _command(t):
    return 3.0 * np.sin(2 * np.pi * 1.3 * t) + 1.5 * np.sin(2 * np.pi * 5.1 * t + 1.0)


def _rate(t, x, p):
    angle, speed = x
    k = 1.0 / (1.0 / p["k_s"] + p.get("c_t", 0.0))
    current, torque = _command(t), k * angle / p["N"] + p["c_s"] * speed / p["N"]
    motor = (
        p["K_tau"] * current * (1.0 - p.get("a_i", 0.0) * current**2) * (1.0 - p.get("a_v", 0.0) * abs(speed) / p["N"])
    )
    s = -math.expm1(-p["r_t"] * t) / p["r_t"] if "r_t" in p else t
    dry = p["f_c"] * math.tanh(speed / p["v_s"]) * (1.0 - p.get("w_c", 0.0) * s)
    viscous = (p["b_r"] + p.get("b_t", 0.0) * s) * speed
    rub = dry + viscous + p.get("f_a", 0.0) + p.get("b_a", 0.0) * abs(speed)
    phase = p.get("n_g", 0.0) * angle
    rub += p.get("a_g", 0.0) * math.sin(phase) + p.get("b_g", 0.0) * math.cos(phase)
    rub += p.get("d_e", 0.0) * torque / p["N"]
    return speed, (motor - rub - torque / p["N"]) / p["J_m"]


def _make(part, plant=None):
    plant = plant or so.plants.rotary(link="locked", parts=[part])
    return plant, plant.defaults.update(**TRUTH, **EFFECTS[part])


@pytest.mark.parametrize("part", EFFECTS)
def test_a_plant_moves_as_its_equations_say(part):
    plant, params = _make(part)
    time = np.arange(2000) / 1000
    log = so.Log.from_arrays(time=time + 7.0, I=_command(time))  # a clock that does not begin at zero
    run = so.simulate(plant, params, log, hold="first")
    exact = solve_ivp(_rate, (0, 2), [0, 0], t_eval=time, rtol=1e-10, atol=1e-12, max_step=1e-3,
                      args=(TRUTH | EFFECTS[part],)).y  # fmt: skip
    assert np.max(np.abs(run["theta_m"] - exact[0])) < 2e-4 * np.max(np.abs(exact[0]))
    plain = solve_ivp(_rate, (0, 2), [0, 0], t_eval=time, rtol=1e-8, max_step=1e-3, args=(TRUTH,)).y
    assert np.max(np.abs(run["theta_m"] - plain[0])) > 0.01 * np.max(np.abs(exact[0]))


@pytest.mark.parametrize("part", NONLINEAR)
def test_a_controller_is_designed_on_the_plant_without_the_effect(part):
    plant, params = _make(part)
    bare = so.plants.rotary(link="locked")
    at = bare.linearize(bare.defaults.update(**TRUTH))
    assert np.allclose(plant.linearize(params).A, at.A)
    assert np.allclose(plant.linearize(params).B[:, 0], at.B[:, 0])


def test_a_saturated_motor_makes_no_less_torque_of_more_current():
    plant, params = _make("droop")
    largest = 1.0 / math.sqrt(3.0 * 0.012)
    hold = {"x": dict.fromkeys(plant.states, 0.0), "u": {"I": 2.0 * largest}}
    assert plant.linearize(params, **hold).B[1, 0] == 0.0
    log = so.Log.from_arrays(time=np.arange(4000) / 1000, I=np.full(4000, 2.0 * largest))
    torque = so.simulate(plant, params.update(f_c=0.0, c_s=20.0), log)["tau_s"][-1]
    assert abs(torque / (100.0 * 0.05 * largest * 2.0 / 3.0) - 1.0) < 1e-6


def test_what_sticks_breaks_away_sooner_in_one_direction():
    plant, params = _make("friction_direction")
    stuck = so.plants.let_stick(plant)
    time = np.arange(400) / 1000
    for torque, moves in ((0.025, False), (0.027, True), (-0.013, False), (-0.015, True)):  # f_c +- f_a: 0.026, 0.014
        log = so.Log.from_arrays(time=time, I=np.full(time.size, torque / TRUTH["K_tau"]))
        assert bool(np.ptp(so.simulate(stuck, params, log, rtol=1e-4)["theta_m"]) > 1e-6) is moves, torque


@pytest.mark.parametrize(("rate", "expected"), [(0.0, 1.0), (1e-6, 1.0), (0.4, -math.log(1.0 - 0.4) / 0.4)])
def test_what_sticks_breaks_away_later_as_friction_falls(rate, expected):
    """Once f_c (1 - w_c s) is the torque: s = 1, the time where nothing settles."""
    plant, params = _make("friction_drift")
    params = params.update(r_t=rate)
    time = np.arange(3000) / 1000
    log = so.Log.from_arrays(time=time, I=np.full(time.size, 0.012 / TRUTH["K_tau"]))
    angle = so.simulate(so.plants.let_stick(plant), params, log, rtol=1e-4)["theta_m"]
    started = time[np.flatnonzero(np.abs(angle) > 1e-6)[0]]
    assert abs(started - expected) < 5e-3


@pytest.mark.parametrize(
    "part",
    [
        *(part for part in EFFECTS if part != "stand"),
        "hardening",
        "stribeck",
        "backlash",
        "load_friction",
        "hysteresis",
    ],
)
def test_a_part_is_added_as_if_the_plant_were_made_with_it(part):
    made = so.plants.let_stick(so.plants.rotary(link="pendulum", parts=["current_loop", part]))
    plant = so.plants.let_stick(so.plants.rotary(link="pendulum", parts=["current_loop"]))
    added = add_part(pickle.loads(pickle.dumps(plant)), part)
    assert added.states.keys() == made.states.keys()
    assert added.parameters.keys() == made.parameters.keys()
    assert added.sticks


def test_what_was_changed_since_it_was_made_takes_parts_around_it_alone():
    plant = so.plants.wrapped(so.plants.high_impedance(), ["load_cell"])  # its recipe knows nothing of it
    assert add_part(plant, "droop").name.endswith("with load_cell with droop")
    with pytest.raises(PlantError, match="inside an actuator"):
        add_part(plant, "hardening")
    with pytest.raises(PlantError, match="given twice"):
        add_part(so.plants.high_impedance(parts=["hardening"]), "hardening")


def test_a_stand_gives_in_series_with_the_spring_alone():
    plant, params = _make("stand")
    bare = so.plants.rotary(link="locked")
    softer = bare.defaults.update(**TRUTH | {"k_s": 300.0 * 15.0 / 16.0})
    assert np.allclose(plant.linearize(params).A, bare.linearize(softer).A)
    with pytest.raises(PlantError, match="holds a link"):
        so.plants.rotary(link="pendulum", parts=["stand"])


def test_a_part_says_which_role_it_lacks():
    bare = so.Plant(
        name="mass", states={"x": "m", "v": "m/s"}, inputs={"F": "N"}, outputs={"x": "m"}, parameters={"m": "kg"},
        f=lambda t, x, u, p: {"x": x.v, "v": u.F / p.m}, h=lambda t, x, u, p: {"x": x.x},
    )  # fmt: skip
    needed = {"droop": "current", "falling_torque": "speed", "stand": "stiffness"}
    for part, needs in (dict.fromkeys(EFFECTS, "friction") | needed).items():
        with pytest.raises(PlantError, match=needs):
            so.plants.wrapped(bare, [part])
