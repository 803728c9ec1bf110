"""Friction of bristles (LuGre), springs with hysteresis, play: integrations by scipy, closed forms, energy, roles."""

from __future__ import annotations

import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import lambertw

import seaopt as so
from seaopt.control.loops.sampled_plant import find_rest, linearise_sets
from seaopt.errors import ParameterError, PlantError
from seaopt.plants.friction import find_breakaway, find_dry_friction, friction_states, split_friction
from tests.independent_springs import simulate_independently, spring_force

LINK_HELD = {"M": 3e-5, "b": 4e-5, "N": 60.0, "k": 200.0}
KNEE = {"J_m": 3e-5, "b_r": 4e-5, "N": 60.0, "k_s": 200.0, "K_tau": 0.05}
RUB = {"f_c": 0.012, "f_s": 0.02, "v_st": 2.0, "sigma_0": 8.0, "sigma_1": 4e-3}
SLIP = {"k_h": 60.0, "y_h": 0.006}
PLAY = {"g_b": 0.004, "eps_b": 5e-5}


def make_knee(parts, **values):
    plant = so.plants.rotary(link="locked", parts=parts)
    return plant, plant.defaults.update(**KNEE, **values)


def make_stand(parts, thor, **values):
    plant = so.plants.high_impedance(parts=parts)
    values = {"f_c": 60.0} | values if "lugre" in parts else values
    own = [one for one in plant.parameters.values() if one.name not in thor]
    return plant, thor.with_parameters(*own).update(**values)


@pytest.mark.parametrize(
    ("parts", "values"),
    [(["stribeck", "lugre"], RUB), (["hysteresis"], SLIP), (["lugre", "hysteresis", "backlash"], RUB | SLIP | PLAY)],
)
def test_a_run_is_that_of_an_independent_integration(parts, values):
    plant, params = make_knee(parts, **{name: value for name, value in values.items() if name in
                                        so.plants.rotary(parts=parts).parameters})  # fmt: skip
    t = np.arange(80) / 200
    current = 0.8 * np.sin(2 * np.pi * 3.0 * t) + 0.3 * np.sin(2 * np.pi * 8.0 * t)
    others = {} if "stribeck" in parts else {"f_s": values.get("f_c", 0.0)}
    expected = simulate_independently(LINK_HELD | values | others, t, 0.05 * current)
    run = so.simulate(plant, params, so.Log.from_arrays(time=t, I=current), hold="first", rtol=1e-6)
    assert np.max(np.abs(run["tau_s"] - expected["force"])) < 2e-5 * np.max(np.abs(expected["force"]))
    assert np.max(np.abs(run["theta_m"] - expected["x"])) < 2e-5 * np.max(np.abs(expected["x"]))
    if "lugre" in parts:
        assert np.max(np.abs(run["z_f"] - expected["z_f"])) < 1e-3 * np.max(np.abs(expected["z_f"]))


def test_a_screw_with_bristles_slides_with_the_friction_of_the_curve_and_holds_below_it(thor):
    """Of a force that grows slowly the spring gets what g(v) leaves; before, k q + g (1 - exp(-sigma_0 q/g)) = F."""
    plant, params = make_stand(["stribeck", "lugre"], thor, f_s=80.0, v_st=1e-3)
    t = np.arange(4000) / 1000
    force = np.where(t < 2.0, 25.0 * t, 50.0 + 400.0 * (t - 2.0))  # 50 N, then to 850 N
    per_ampere = 240.331838
    run = so.simulate(plant, params, so.Log.from_arrays(time=t, I=force / per_ampere), hold="first", rtol=1e-6)
    k, sigma_0 = 655e3, params["sigma_0"].value
    held = slice(200, 1900, 100)
    carried = k * run["q"][held] + 80.0 * (1.0 - np.exp(-sigma_0 * run["q"][held] / 80.0))
    assert carried == pytest.approx(force[held], abs=0.3)
    late = t > 3.5  # it slides with dq/dt = 400/k
    lead = params["l"].value / (2 * np.pi * params["N_p"].value)
    level = 60.0 + 20.0 * np.exp(-((400.0 / k / 1e-3) ** 2)) + params["b_r"].value / lead**2 * 400.0 / k
    assert force[late] - run["F1"][late] == pytest.approx(level, rel=5e-3)
    complete = plant.complete(params)
    assert find_breakaway(plant, complete) == pytest.approx(80.0, rel=1e-3)
    assert 60.0 <= find_dry_friction(plant, complete)["F_f"] <= 80.0


def drive_spring(plant, params, name, turn, amplitude, cycles):
    """Return deflection and force of the last of some slow cycles of a plant's own equations of its spring."""
    p = plant.complete(params).by_attribute
    rate, stiffness = plant.friction[name].bristles.rate, plant.friction[name].bristles.stiffness(p)
    s = np.linspace(0.0, 2 * np.pi * cycles, 2000 * cycles + 1)
    run = solve_ivp(
        lambda s, z: [float(rate(z[0], amplitude * np.cos(s), p))], (0.0, s[-1]), [0.0], t_eval=s, rtol=1e-9, atol=1e-14
    )
    deflection = amplitude * np.sin(s)
    return deflection[-2001:], (turn(deflection) + stiffness * run.y[0])[-2001:]


@pytest.mark.parametrize("amplitude", [1e-3, 6e-3, 3e-2])
def test_the_area_of_a_loop_is_that_of_the_closed_form(amplitude):
    plant, params = make_knee(["hysteresis"], **SLIP)
    x, force = drive_spring(plant, params, "spring_slip", lambda d: 200.0 * d, amplitude, 6 + int(0.06 / amplitude))
    y, k_h = SLIP["y_h"], SLIP["k_h"]
    z_0 = y * (1.0 - float(np.real(lambertw(np.exp(1.0 - 2.0 * amplitude / y)))))
    expected = 2.0 * k_h * (2.0 * y * (amplitude - z_0) - 0.5 * z_0**2)
    assert abs(np.trapezoid(force, x)) == pytest.approx(expected, rel=2e-3)
    assert np.max(force) == pytest.approx(200.0 * amplitude + k_h * z_0, rel=1e-4)


def test_the_stiffness_stays_between_all_sticking_and_all_slipping_and_energy_is_only_lost():
    plant, params = make_knee(["hysteresis"], **SLIP)
    bristles, p = plant.friction["spring_slip"].bristles, plant.complete(params).by_attribute
    rng = np.random.default_rng(3)
    for _ in range(200):
        z, v = rng.uniform(-1.0, 1.0) * SLIP["y_h"], rng.normal()
        share = float(bristles.rate(z, v, p)) / v
        assert -1e-12 <= share <= 1.0 + 1e-12
        assert z * (v - float(bristles.rate(z, v, p))) >= -1e-15
    assert float(bristles.rate(-SLIP["y_h"], 1.0, p)) == 1.0  # it unloads with the stiffness of both
    assert float(bristles.rate(SLIP["y_h"], 1.0, p)) == 0.0


@pytest.mark.parametrize("parts", [("lugre",), ("hysteresis",), ("backlash",), ("lugre", "hysteresis", "backlash")])
def test_no_part_makes_energy(parts):
    """What the motor puts in is stored, or lost; of any stretch of a run the loss is not negative."""
    own = {"lugre": RUB, "hysteresis": SLIP, "backlash": PLAY}
    values = {name: value for part in parts for name, value in own[part].items() if name not in ("f_s", "v_st")}
    plant, params = make_knee(parts, **values)
    t, rng = np.arange(2000) / 4000, np.random.default_rng(5)
    current = sum(0.4 * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (1.0, 3.0, 7.0))
    run = so.simulate(plant, params, so.Log.from_arrays(time=t, I=current), hold="first", rtol=1e-6)
    stored = ca.Function("stored", [plant.x, plant.p], [plant.stored_energy()])
    x, p = np.array([run[name] for name in plant.states]), plant.complete(params).vector
    energy = np.array(stored(x, np.tile(p[:, None], t.size))).ravel()
    power = (KNEE["K_tau"] * current - KNEE["b_r"] * run["thetad_m"]) * run["thetad_m"]
    put = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1])) / 4000])
    lost = put - energy
    size = np.max(energy)
    assert np.min(np.diff(lost[::40])) > -1e-4 * size
    assert (lost[-1] > 1e-3 * size) == (parts != ("backlash",))


def test_play_is_a_free_gap_without_a_loop():
    plant, params = make_knee(["backlash"], **PLAY)
    x = np.linspace(-0.01, 0.01, 2001)
    there, back = spring_force(x, 0.0, {"k": 200.0, "k_h": 0.0} | PLAY), spring_force(x[::-1], 0.0, {"k": 200.0,
                               "k_h": 0.0} | PLAY)  # fmt: skip
    assert np.trapezoid(there, x) == pytest.approx(-np.trapezoid(back, x[::-1]), abs=1e-15)
    log = so.Log.from_arrays(time=np.arange(400) / 400, I=np.zeros(400))
    inside = so.simulate(plant, params, log, initial_state={"theta_m": 60.0 * 0.003})
    assert np.max(np.abs(inside["theta_m"] / 60.0 - 0.003)) < 1e-3  # eps_b pulls a little
    assert np.max(np.abs(inside["tau_s"])) < 200.0 * 5e-5


def test_stuck_it_is_a_spring_and_sliding_the_flattest_curve(thor):
    """Against the eigenvalues of M q'' + (b + sigma_1) q' + (k + sigma_0) q, and of springs k and k + k_h."""
    plant, params = make_stand(["stribeck", "lugre", "hysteresis"], thor, f_s=80.0, k_h=2e5)
    p = {name: one.value for name, one in plant.complete(params).items()}
    r = p["l"] / (2 * np.pi * p["N_p"])
    mass, b = p["m_l"] + p["J"] / r**2, p["b_r"] / r**2
    fall = -np.sqrt(2.0 / np.e) * 20.0 / p["v_st"]
    expected = {
        "sliding": (b + fall, p["k"]),
        "spring_slip stuck": (b + fall, p["k"] + p["k_h"]),
        "F_f stuck": (b + p["sigma_1"], p["k"] + p["sigma_0"]),
        "stuck": (b + p["sigma_1"], p["k"] + p["sigma_0"] + p["k_h"]),
    }
    states = friction_states(plant)
    assert list(states) == list(expected)
    for name, (damping, stiffness) in expected.items():
        poles = states[name].linearize(params).poles()
        for pole in np.roots([mass, damping, stiffness]):
            assert np.min(np.abs(poles - pole)) < 1e-7 * abs(pole)
        assert np.count_nonzero(np.abs(poles + 1.0) < 1e-9) == 2  # the deflections, which nothing depends on
    assert list(split_friction({"a": plant}, params)) == [f"a {name}" for name in expected]
    assert list(friction_states(so.plants.high_impedance(parts=["lugre"]))) == ["sliding", "stuck"]


@pytest.mark.parametrize(
    ("plant", "place", "current", "values"),
    [
        (so.plants.rotary(link="pendulum", parts=["lugre"]), "theta_l", None, {}),
        (so.plants.rotary(link="pendulum", parts=["hysteresis", "backlash"]), "theta_l", None, {"k_h": 60.0}),
        (so.plants.moving_output(parts=["lugre"]), "phi", -0.3691, {"f_c": 20.0}),
        (so.plants.rotary(link="pendulum", parts=["lugre", "thermal", "voltage_input"]), "theta_l", None, {}),
    ],
)
def test_a_raised_plant_rests_with_bristles_unbent_and_is_linearised_there(thor, plant, place, current, values):
    """The plant's own f is zero; its finite differences with z' = v have the poles, and zero for each deflection."""
    own = thor.values() if place == "phi" else ()
    held = plant.defaults.with_parameters(*(one for one in own if one.name in plant.parameters))
    params = held.update(**values).with_parameters(so.Parameter(name=place, value=0.5, unit="rad"))
    complete = plant.complete(params)
    x, u = find_rest(plant, complete)
    f = ca.Function("f", [plant.x, plant.u, plant.p], [ca.substitute(plant.dynamics, plant.t, 0.0)])
    names = list(plant.states)
    warm = [i for i, name in enumerate(names) if name.startswith("rise")]
    moving = [i for i in range(len(names)) if i not in warm]

    def rates(x):
        return np.array(f(x, u, complete.vector)).ravel()[moving]

    assert np.max(np.abs(rates(x))) < 1e-8 and x[names.index(place)] == 0.5
    if current is not None:
        assert u[0] == pytest.approx(current, abs=1e-4)
    steps = 1e-7 * np.eye(len(names))[moving]
    slopes = np.column_stack([(rates(x + step) - rates(x - step)) / 2e-7 for step in steps])
    expected = np.linalg.eigvals(slopes)
    (a, *_), _ = linearise_sets(plant, [complete], next(iter(plant.outputs)), 1.0)
    poles, size = np.linalg.eigvals(a[0]), np.max(np.abs(expected))
    count = sum(one.bristles is not None for one in plant.friction.values())
    assert np.count_nonzero(np.abs(poles + 1.0) < 1e-6) == np.count_nonzero(np.abs(expected) < 1e-5 * size) == count
    for pole in expected[np.abs(expected) > 1e-5 * size]:
        assert np.min(np.abs(poles - pole)) < 1e-5 * size


@pytest.mark.parametrize("make", [lambda: so.plants.moving_output(parts=["lugre", "hysteresis", "load_friction"]),
                                  lambda: so.plants.rotary(parts=["stribeck", "lugre", "duty_input"])])  # fmt: skip
def test_bristles_survive_pickling(make):
    plant = make()
    again = pickle.loads(pickle.dumps(plant))
    params = plant.defaults
    missing = [name for name in plant.parameters if name not in params]
    assert not missing
    for name in friction_states(plant):
        one, other = (friction_states(each)[name].linearize(params) for each in (plant, again))
        assert np.array_equal(one.A, other.A), name


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"state": "theta_m"}, "rate"),
        ({"rate": lambda z, v, p: 0.5 * v}, "rate"),
        ({"coordinate": lambda x, p: -x.theta_m}, "coordinate"),
    ],
)
def test_bristles_that_contradict_f_are_refused(change, word):
    """The role changed, f is not: dz/dt is another there, or the coordinate's rate is not the velocity."""
    plant = so.plants.rotary(link="locked", parts=["lugre"])
    role = plant.friction["tau_f"]
    changed = replace(role, bristles=replace(role.bristles, **change))
    with pytest.raises(PlantError, match=word):
        replace(plant, friction={"tau_f": changed})


def test_bristles_need_friction(thor):
    with pytest.raises(ParameterError, match="f_c"):
        so.plants.high_impedance(parts=["lugre"]).linearize(thor)
