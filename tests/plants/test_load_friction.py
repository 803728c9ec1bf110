"""Friction that grows with what a gear carries: the published forms, an integration, and which one a log tells."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import seaopt as so
from seaopt.errors import PlantError
from seaopt.plants.friction import list_fall_parameters

LOAD = {"c_m": 0.12, "c_e": 0.25, "c_ms": 0.05, "c_es": 0.1, "q_m": 0.7, "q_e": 1.3}
PARTS = {
    "M1": (), "M2": ("stribeck",), "M3": ("load_friction",), "M4": ("stribeck", "load_friction", "load_stribeck"),
    "M5": ("stribeck", "load_friction", "load_stribeck"),
    "M6": ("stribeck", "load_friction", "load_stribeck", "load_square"),
}  # fmt: skip
MOTOR = {"J_m": 3e-5, "b_r": 2e-5, "K_tau": 0.05, "N": 60.0, "k_s": 200.0, "f_c": 0.01, "v_s": 0.1}


def published(model, v, motor, outer, p):
    """Return tau_f of the published models; tau_m and tau_e act on the joint, sigma is of exponent two."""
    sigma = np.exp(-((v / p["v_st"]) ** 2))
    own, more = p["f_s"] - p["f_c"], abs(outer - motor)
    level = {
        "M1": p["f_c"], "M2": p["f_c"] + sigma * own, "M3": p["f_c"] + p["c_m"] * more,
        "M4": p["f_c"] + p["c_m"] * more + sigma * (own + p["c_ms"] * more),
        "M5": p["f_c"] + abs(p["c_e"] * outer - p["c_m"] * motor)
        + sigma * (own + abs(p["c_es"] * outer - p["c_ms"] * motor)),
    }  # fmt: skip
    if model != "M6":
        return level[model]
    smaller = p["q_e"] * outer**2 if abs(outer) < abs(motor) else p["q_m"] * motor**2
    return level["M5"] + (sigma * smaller if outer * motor < 0 else 0.0)


@pytest.mark.parametrize("model", list(PARTS))
def test_the_parts_are_the_published_models(model):
    plant, rng = so.plants.rotary(parts=list(PARTS[model])), np.random.default_rng(1)
    p = MOTOR | LOAD | {"f_s": 0.015, "v_st": 4.0, "v_s": 1e-9}
    if model in ("M3", "M4"):
        p |= {"c_e": p["c_m"], "c_es": p["c_ms"]}
    values = plant.complete(
        plant.defaults.update(**{name: value for name, value in p.items() if name in plant.parameters})
    )
    friction = plant.friction["tau_f"]
    for _ in range(30):
        x = dict(zip(plant.states, rng.normal(size=4) * [3.0, 5.0, 0.05, 1.0], strict=True))
        current = 2.0 * rng.normal()
        outer = -MOTOR["k_s"] * (x["theta_m"] / 60.0 - x["theta_l"]) / 60.0  # of the spring, at the motor
        force = friction.force_at(SimpleNamespace(**x), SimpleNamespace(I=current), values.by_attribute)
        expected = published(model, x["thetad_m"], MOTOR["K_tau"] * current, outer, p) * np.sign(x["thetad_m"])
        assert float(force) == pytest.approx(expected, rel=1e-9)


def test_a_gear_that_holds_and_slides_under_load_is_that_of_an_integration_with_events():
    """It lets go at K I = f_c/(1 - c_m), and slides until it stops again and holds."""
    plant = so.plants.let_stick(so.plants.rotary(link="locked", parts=["load_friction"]))
    p = MOTOR | {"c_m": 0.2, "c_e": 0.15}
    params = plant.defaults.update(**{name: value for name, value in p.items() if name in plant.parameters})
    t = np.arange(400) / 1000
    current = 2.0 * t
    run = so.simulate(plant, params, so.Log.from_arrays(time=t, I=current), hold="first", rtol=1e-7)
    start = p["f_c"] / (1 - p["c_m"]) / p["K_tau"] / 2.0
    moving = np.flatnonzero(np.abs(run["thetad_m"]) > 1e-9)[0]
    assert t[moving] == pytest.approx(start, abs=2e-3)

    def rates(time, y):
        motor, output = p["K_tau"] * 2.0 * time, p["k_s"] * y[0] / 60.0 / 60.0
        rub = p["f_c"] + abs(p["c_m"] * motor + p["c_e"] * output)
        return [y[1], (motor - output - p["b_r"] * y[1] - rub) / p["J_m"]]

    def stops(time, y):
        return y[1]

    stops.direction, stops.terminal = -1, True
    slide = solve_ivp(rates, (start, 0.4), [0.0, 1e-12], events=stops, rtol=1e-9, atol=1e-12, dense_output=True)
    inside = (t > start) & (t < slide.t[-1])
    assert np.max(np.abs(run["theta_m"][inside] - slide.sol(t[inside])[0])) < 2e-4 * np.max(slide.y[0])


@pytest.mark.slow
def test_compare_names_the_friction_of_the_log_on_what_it_was_not_fitted_to():
    """A knee with its link held, torque up and down: a gear that rubs by its load, against Coulomb's and Stribeck's."""
    truth = MOTOR | {"c_m": 0.15, "c_e": 0.1, "f_s": 0.02, "v_st": 4.0}

    def make(parts):
        return so.plants.let_stick(so.plants.rotary(link="locked", parts=list(parts)))

    def values(plant, **other):
        known = {name: value for name, value in (truth | other).items() if name in plant.parameters}
        return plant.defaults.update(**known)

    source, t = make(PARTS["M3"]), np.arange(3000) / 500
    current = 1.5 * np.sin(2 * np.pi * 0.5 * t) + 1.2 * np.sin(2 * np.pi * (0.3 * t + 0.4 * t**2))
    run = so.simulate(source, values(source), so.Log.from_arrays(time=t, I=current), rtol=1e-5)
    noise = 0.01 * np.std(run["tau_s"]) * np.random.default_rng(4).normal(size=t.size)
    log = so.Log.from_arrays(time=t, I=current, tau_s=run["tau_s"] + noise)
    fits = {}
    for name in ("M1", "M2", "M3"):
        plant = make(PARTS[name])
        free = [one for one in ("b_r", "f_c", "f_s", "c_m", "c_e") if one in plant.parameters]
        start = values(plant, c_m=0.05, c_e=0.05, f_c=0.02).free(*free)
        experiment = so.Experiment(plant=plant, log=log, offset=False, initial_state="rest")
        fits[name] = so.fit([experiment], start, method=so.OutputError(search=False), holdout=0.4)
    ranking = so.compare(fits)
    assert ranking.preferred == "M3", str(ranking)
    assert fits["M3"].met and not fits["M1"].met and not fits["M2"].met, "\n".join(map(str, fits.values()))
    for name in ("b_r", "f_c", "c_m", "c_e"):
        found = fits["M3"].parameters[name]
        assert abs(found.value - truth[name]) < 4.0 * found.std, found


def test_parts_that_need_others_are_refused():
    with pytest.raises(PlantError, match="needs stribeck and load_friction"):
        so.plants.rotary(parts=["load_stribeck"])
    with pytest.raises(PlantError, match="needs load_friction"):
        so.plants.high_impedance(parts=["stribeck", "load_square"])


def test_the_parameters_that_friction_falls_with():
    plant = so.plants.high_impedance(parts=["stribeck"])
    assert list_fall_parameters(plant, plant.friction["F_f"]) == ("f_c", "f_s", "v_st")
