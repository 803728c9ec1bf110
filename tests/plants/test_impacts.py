"""Energy, blows and contacts against the books of test_mechanics and against stiff, short forces."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import seaopt as so
from seaopt.errors import PlantError
from seaopt.plants import wrapped
from seaopt.plants.impacts import catch, check_held, release, strike

spec = importlib.util.spec_from_file_location("mechanics", Path(__file__).with_name("test_mechanics.py"))
mechanics = importlib.util.module_from_spec(spec)
spec.loader.exec_module(mechanics)

KNOWN = [("stribeck", "backlash", "spring_damping", "screw_mode"), ("hardening", "spring_damping", "screw_mode"), ()]


def energy_of(plant, params):
    stored = ca.Function("e", [plant.x, plant.p], [plant.stored_energy()])
    return lambda x: float(stored(x, plant.complete(params).vector))


@pytest.mark.parametrize("drive", ["unlumped", "lumped"])
@pytest.mark.parametrize("spring", ["link1", "link2"])
@pytest.mark.parametrize(("links", "parts"), [(("mass", "pendulum"), p) for p in KNOWN] + [(("fixed", "fixed"), ())])
def test_the_energy_is_that_of_the_bodies(links, parts, drive, spring):
    plant = so.plants.two_link(*links, drive=drive, spring=spring, parts=parts)
    params = mechanics.values_of(plant)
    p = {name: item.value for name, item in params.items()}
    rest = {"I": 0.0, "Fe1": 0.0, "Fe2": 0.0}
    for x in 1e-2 * np.random.default_rng(2).normal(size=(4, len(plant.states))):
        expected = mechanics.books(zip(plant.states, x, strict=True), rest, links, drive, spring, parts, p)[0]
        assert energy_of(plant, params)(x) == pytest.approx(expected, rel=1e-7)


def test_rotary_energy_changes_by_what_goes_in_and_out():
    plant = so.plants.rotary()
    params = plant.defaults
    p = {name: item.value for name, item in params.items()}
    x, current = np.array([0.3, 2.0, -0.01, 1.0]), 1.5
    f = ca.Function("f", [plant.x, plant.u, plant.p], [plant.dynamics])
    gradient = ca.Function("g", [plant.x, plant.p], [ca.gradient(plant.stored_energy(), plant.x)])
    values = plant.complete(params).vector
    change = float(np.array(gradient(x, values)).ravel() @ np.array(f(x, current, values)).ravel())
    twist = x[1] / p["N"] - x[3]
    expected = p["K_tau"] * current * x[1] - p["b_r"] * x[1] ** 2 - p["d_l"] * x[3] ** 2 - p["c_s"] * twist**2
    assert change == pytest.approx(expected, rel=1e-9)


def test_play_and_hardening_together_declare_no_energy():
    plant = so.plants.high_impedance(parts=("backlash", "hardening"))
    with pytest.raises(PlantError, match="declares no energy"):
        plant.stored_energy()


def braked(plant, params, x, force, seconds):
    """Integrate with a short external force on link 2, a function of its speed."""
    p = plant.complete(params).vector
    f = ca.Function("f", [plant.x, plant.u, plant.p], [plant.dynamics])
    names = list(plant.states)

    def speed(x):
        s = dict(zip(names, x, strict=True))
        arm = params["L_a2"].value * np.cos(s["phi2"]) if "phi2" in s else None
        return arm * s["phid2"] if arm is not None else s["v_2"]

    def rate(t, x):
        return np.array(f(x, [0.0, 0.0, force(speed(x))], p)).ravel()

    return solve_ivp(rate, (0, seconds), x, method="Radau", rtol=1e-9, atol=1e-12).y[:, -1]


def moving(link2):
    """Return a state with every rate, the spring nearly relaxed."""
    return np.array(
        [1e-6 - 0.0725 * np.sin(0.4), 0.02, 0.4, 0.5] if link2 == "pendulum" else [-0.009999, 0.02, 0.01, 0.5]
    )


@pytest.mark.parametrize("link2", ["pendulum", "mass"])
@pytest.mark.parametrize("drive", ["unlumped", "lumped"])
@pytest.mark.parametrize("spring", ["link1", "link2"])
def test_a_blow_is_a_strong_short_force(link2, drive, spring):
    plant = so.plants.two_link("fixed", link2, drive=drive, spring=spring)
    params = plant.complete(plant.defaults)
    x = moving(link2)
    after = strike(plant, params, x, "x_2", 0.7)
    np.testing.assert_allclose(after, braked(plant, params, x, lambda v: 0.7e7, 1e-7), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("link2", ["pendulum", pytest.param("mass", marks=pytest.mark.slow)])
@pytest.mark.parametrize("drive", ["unlumped", pytest.param("lumped", marks=pytest.mark.slow)])
@pytest.mark.parametrize("spring", ["link1", "link2"])
def test_a_catch_is_a_stiff_brake(link2, drive, spring):
    plant = so.plants.two_link("fixed", link2, drive=drive, spring=spring)
    params = plant.complete(plant.defaults)
    x = moving(link2)
    slow = braked(plant, params, x, lambda v: -1e9 * v, 2e-6)
    assert abs(slow[3]) < 1e-4
    state, _, loss = catch(plant, params, x, plant.port)
    assert state[1] == pytest.approx(slow[1], abs=1e-4)
    kinetic = energy_of(plant, params)(x) - energy_of(plant, params)(np.r_[x[0], state[1], x[2], 0.0])
    assert loss == pytest.approx(kinetic, rel=1e-9)


def test_the_unlumped_catch_by_hand(swing, thor):
    """The sprung mass's momentum goes into m_l + M; the torque impulse stops I_p and what m_l loses."""
    x = np.array([2e-4, 0.03, 0.3, 2.0])
    state, impulse, _ = catch(swing, swing.complete(thor), x, swing.port)
    big = thor["J"].value / (0.002 / (6 * np.pi)) ** 2
    speed = 0.0725 * np.cos(0.3) * 2.0
    after = 0.03 + 0.646 / (big + 0.646) * speed
    assert state[1] == pytest.approx(after, rel=1e-9)
    assert state[0] == pytest.approx(2e-4 + 0.0725 * np.sin(0.3))
    momentum = 0.36 * 2.0 + 0.646 * 0.0725 * np.cos(0.3) * (0.03 + speed)
    assert impulse == pytest.approx(0.646 * 0.0725 * np.cos(0.3) * after - momentum, rel=1e-9)


def test_letting_go_keeps_the_spring(swing, thor):
    held = np.array([1.5e-4, 0.01])
    x = release(swing, swing.complete(thor), swing.port, held, {"phi": -0.7})
    assert x[0] + 0.0725 * np.sin(-0.7) == pytest.approx(1.5e-4)
    assert (x[1], x[2], x[3]) == (0.01, -0.7, 0.0)
    again, impulse, loss = catch(swing, swing.complete(thor), x, swing.port)
    np.testing.assert_allclose(again, held)
    assert abs(impulse) < 1e-3  # what m_l moves with q is taken along
    assert loss == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("parts", [(), ("load_cell",), ("stribeck", "screw_mode", "command_delay")])
@pytest.mark.parametrize("link2", ["pendulum", "mass"])
@pytest.mark.parametrize("drive", ["unlumped", "lumped"])
@pytest.mark.parametrize("spring", ["link1", "link2"])
def test_the_port_makes_the_same_actuator_with_its_link_fixed(link2, drive, spring, parts):
    plant = so.plants.two_link("fixed", link2, drive=drive, spring=spring, parts=parts)
    fixed = so.plants.two_link("fixed", "fixed", drive=drive, spring=spring, parts=parts)
    held, params = plant.port.held(), plant.defaults.with_parameters()
    assert (held.states, held.inputs, held.outputs) == (fixed.states, fixed.inputs, fixed.outputs)
    x, u = 1e-3 * np.random.default_rng(4).normal(size=len(held.states)), [0.7, 0.0, 0.0]
    for plant_of in ("dynamics", "output"):
        values = [
            ca.Function("f", [item.x, item.u, item.p], [getattr(item, plant_of)])(x, u, item.complete(params).vector)
            for item in (held, fixed)
        ]
        np.testing.assert_array_equal(*(np.array(item) for item in values))


def test_a_held_plant_has_the_states_that_are_left(stand, swing):
    check_held(swing, stand)
    check_held(wrapped(swing, ["load_cell"]), wrapped(stand, ["load_cell"]))
    for plant, held in ((stand, swing), (swing, swing), (swing, so.plants.rotary())):
        with pytest.raises(PlantError, match="with a link fixed"):
            check_held(plant, held)


@pytest.mark.parametrize("options", [{"spring": "link2"}, {"parts": ("hardening",)}, {"parts": ("spring_damping",)}])
@pytest.mark.parametrize("drive", ["unlumped", "lumped"])
def test_another_actuator_with_the_same_states_is_not_the_held_plant(drive, options):
    check_held(so.plants.moving_output(drive, **options), so.plants.high_impedance(drive, **options))
    with pytest.raises(PlantError, match="with a link fixed"):
        check_held(so.plants.moving_output(drive), so.plants.high_impedance(drive, **options))


def test_bad_blows_and_releases(stand, swing, thor):
    with pytest.raises(PlantError, match="x_3"):
        strike(swing, swing.complete(thor), np.zeros(4), "x_3", 1.0)
    with pytest.raises(PlantError, match="depends on more than positions"):
        strike(swing, swing.complete(thor), np.zeros(4), "F2", 1.0)
    with pytest.raises(PlantError, match="theta"):
        release(swing, swing.complete(thor), swing.port, np.zeros(2), {"theta": 0.1})
    with pytest.raises(PlantError, match="does not move"):
        catch(stand, stand.complete(thor), np.zeros(2), stand.port)
