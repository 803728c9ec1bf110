"""A motor that cogs in linear loops: no slope as it slides, the steepest where it is stuck; by equations alone."""

from __future__ import annotations

import math

import numpy as np
import pytest

import seaopt as so
from seaopt.control.loops.sampled_plant import sample
from seaopt.plants.friction import name_states, split_friction, take_sliding
from seaopt.plants.plant import state_space

ANKLE = {"J_m": 3e-5, "b_r": 2e-4, "f_c": 0.02, "v_s": 0.5, "N": 60.0, "K_tau": 0.06, "k_s": 250.0, "c_s": 0.0}
SIZE, WAVE = 0.0065, 42.0  # a slope of 3.9 times the spring's at the motor


def make(turn=0.4, link="locked", **values):
    """Return an ankle whose motor cogs, and its parameters; `turn`: of the waves, by the encoder's zero."""
    plant = so.plants.rotary(link=link, parts=("cogging",))
    cogs = {"a_g": SIZE * math.cos(turn), "b_g": SIZE * math.sin(turn), "n_g": WAVE}
    return plant, plant.defaults.update(**ANKLE, **cogs).update(**values)


def find_poles(plant, params):
    return np.sort_complex(np.linalg.eigvals(state_space(plant, params)[0]))


@pytest.mark.parametrize(
    ("state", "dry", "stiffness"),
    [
        ("sliding", 0.002, 0.0),
        ("stuck", 0.02, 0.0),
        ("stuck", 0.002, (SIZE - 0.002) * WAVE),
        ("stuck", 0.0, SIZE * WAVE),
    ],
)
@pytest.mark.parametrize("turn", [0.0, 2.5])
def test_poles_are_those_of_the_motor_on_its_spring(state, dry, stiffness, turn):
    """Friction that holds more than the wave pushes holds the motor anywhere; less leaves it in a well."""
    plant, params = make(turn, f_c=dry)
    p, damping = ANKLE, dry / ANKLE["v_s"] if state == "stuck" else 0.0
    expected = np.roots([p["J_m"], p["b_r"] + damping, p["k_s"] / p["N"] ** 2 + stiffness])
    poles = find_poles(split_friction({"p": plant}, params)[f"p {state}"], params)
    assert poles == pytest.approx(np.sort_complex(expected), rel=1e-9)


def test_a_pendulum_slides_as_without_cogging():
    plant, params = make(link="pendulum")
    plain = so.plants.rotary(link="pendulum")
    poles = find_poles(take_sliding(plant, params), params)
    assert poles == pytest.approx(find_poles(take_sliding(plain, params), params), rel=1e-12)


@pytest.mark.parametrize("state", ["sliding", "stuck"])
def test_a_port_has_no_slope_of_its_own_either(state):
    """The probe of a plant in a state is the probe in that state, whatever the encoder's zero."""
    probes = [
        split_friction({"p": plant}, params)[f"p {state}"].port.probe()
        for plant, params in (make(0.0, f_c=0.0), make(2.5, f_c=0.0))
    ]
    poles = [find_poles(probe, make(turn, f_c=0.0)[1]) for probe, turn in zip(probes, (0.0, 2.5), strict=True)]
    assert poles[0] == pytest.approx(poles[1], rel=1e-9)


def test_a_loop_around_the_plant_as_it_is_has_no_slope_of_it():
    plant, params = make()
    plain = so.plants.rotary(link="locked")
    sampled = [sample(each, params, "tau_s", 1.0, 1e-3, 1) for each in (plant, plain)]
    assert sampled[0].a == pytest.approx(sampled[1].a, rel=1e-12)
    assert sampled[0].static_gain == pytest.approx(ANKLE["N"] * ANKLE["K_tau"], rel=1e-9)


@pytest.mark.parametrize(
    ("values", "varied", "expected"),
    [
        ({}, (), ["sliding", "stuck"]),
        ({"a_g": 0.0, "b_g": 0.0}, (), [""]),
        ({"a_g": 0.0, "b_g": 0.0}, ("b_g",), ["sliding", "stuck"]),
    ],
)
def test_without_dry_friction_the_waves_alone_hold_a_motor(values, varied, expected):
    plant, params = make(f_c=0.0, **values)
    states = name_states({"p": plant}, params, varied)
    assert [state for _, state in states.values()] == expected


def test_a_law_is_the_same_whatever_the_zero_of_the_encoder():
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=20, max_sensitivity=1.7)
    laws = [so.tune(*make(turn), spec) for turn in (0.0, 2.5)]
    assert all(law.met for law in laws)
    gains = [np.array([law.gains[name] for name in ("k_p", "k_i", "k_d")]) for law in laws]
    assert gains[0] == pytest.approx(gains[1], rel=1e-6)
    plain, params = so.plants.rotary(link="locked"), make()[1]
    assert laws[0].achieved.ms == pytest.approx(laws[0].close(plain, params.update(f_c=0.0)).figures().ms, rel=1e-9)


def test_without_dry_friction_a_law_is_certified_in_a_well_too():
    """With the steepest slope as a spring, as in a well: the loop there is that of a plant of its own."""
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=20, max_sensitivity=1.7)
    plant, params = make(f_c=0.0)
    law = so.tune(plant, params, spec)
    certificate = so.certify(law, {"joint": plant}, params, samples=10, simulations=False)
    p = ANKLE
    well = so.Plant(
        name="well",
        states={"angle": "rad", "speed": "rad/s"},
        inputs={"I": "A"},
        outputs={"tau_s": "N m"},
        parameters={},
        f=lambda t, x, u, _: {
            "angle": x.speed,
            "speed": (p["K_tau"] * u.I - p["b_r"] * x.speed - (p["k_s"] / p["N"] ** 2 + SIZE * WAVE) * x.angle)
            / p["J_m"],
        },
        h=lambda t, x, u, _: {"tau_s": p["k_s"] / p["N"] * x.angle},
    )
    expected = law.close(well, well.defaults).figures()
    assert certificate.to_dict()["plants"]["joint stuck"]["ms"] == pytest.approx(expected.ms, rel=1e-6)
    assert expected.ms != pytest.approx(law.achieved.ms, rel=1e-3)
