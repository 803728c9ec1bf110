"""What users carry between processes and sessions pickles and copies, and works afterwards as it did before."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest

import seaopt as so
from seaopt.files import to_json
from seaopt.plants.friction import friction_slopes, friction_states
from seaopt.simulation import make_model

TIME = np.arange(400) / 1000
CURRENT = np.sin(40 * TIME)
PLANTS = {
    "stand": lambda: so.plants.high_impedance(),
    "swing": lambda: so.plants.moving_output(drive="lumped", parts=["load_cell", "stribeck", "current_loop"]),
    "two links": lambda: so.plants.two_link(link1="mass", link2="pendulum", spring="link2"),
    "rotary": lambda: so.plants.rotary("pendulum", spring="link1"),
    "sliding": lambda: friction_states(so.plants.moving_output())["sliding"],
    "of the user": lambda: so.Plant(
        name="cart", states={"x": "m", "v": "m/s"}, inputs={"I": "A"}, outputs={"x": "m"},
        parameters={"m": so.Parameter(name="m", value=2.0, unit="kg")},
        f=lambda t, x, u, p: {"x": x.v, "v": (u.I - x.v * ca.sqrt(1 + x.x**2) + ca.sin(t)) / p.m},
        h=lambda t, x, u, p: {"x": x.x}, derived=lambda p: {"twice": (2 * p.m, "kg")},
    ),
}  # fmt: skip


def again(thing):
    return pickle.loads(pickle.dumps(thing))


def run(plant):
    log = so.Log.from_arrays(time=TIME, I=CURRENT)
    params = plant.defaults if "tau_s" in plant.outputs else so.plants.thor()
    return so.simulate(plant, params.update(f_c=20.0), log)


@pytest.mark.parametrize("name", PLANTS)
def test_a_pickled_plant_simulates_the_same(name):
    plant = PLANTS[name]()
    restored = again(plant)
    assert repr(restored) == repr(plant)
    before, after = run(plant), run(restored)
    for output in plant.outputs:
        np.testing.assert_allclose(after[output], before[output], rtol=1e-12, atol=1e-12 * np.ptp(before[output]))


def test_a_pickled_plant_keeps_its_roles():
    plant = so.plants.moving_output(parts=["load_cell", "stribeck"])
    restored, params = again(again(plant)), so.plants.thor().update(f_c=50.0)
    held, probe = restored.port.held(), restored.port.probe()
    assert list(held.states) == list(plant.port.held().states)
    assert list(probe.states) == list(plant.port.probe().states)
    np.testing.assert_array_equal(friction_slopes(restored, params), friction_slopes(plant, params))
    values = restored.complete(params)
    assert float(restored.actuation.effort(values.by_attribute)) == pytest.approx(240.3318, rel=1e-5)
    assert again(values).plant.name == restored.name


def test_a_plant_of_lambdas_works_in_another_process(tmp_path):
    file = tmp_path / "plant.pickle"
    file.write_bytes(pickle.dumps(PLANTS["of the user"]()))
    code = (
        f"import pickle; p = pickle.load(open({str(file)!r}, 'rb')); print(p.linearize(p.defaults).poles().real.min())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(done.stdout) == pytest.approx(-0.5)


def test_a_copy_of_what_never_changes_is_itself():
    plant = so.plants.high_impedance()
    model = make_model(plant, so.plants.thor(), ("J",), ("F1",))
    assert copy.deepcopy(plant) is plant and copy.copy(plant) is plant and copy.deepcopy(model) is model


@pytest.fixture(scope="module")
def whole_path():
    plant = so.plants.high_impedance()
    rng = np.random.default_rng(1)
    time = np.arange(2000) / 1000
    log = so.Log.from_arrays(time=time, I=rng.normal(size=2000))
    forces = so.simulate(plant, so.plants.thor(), log)["F1"] + rng.normal(size=2000)
    experiment = so.Experiment(plant=plant, log=so.Log.from_arrays(time=time, I=log["I"], F1=forces), outputs=("F1",))
    fit = so.fit([experiment], so.plants.thor().free("J", "b_r"))
    controller = so.tune(plant, fit.parameters, so.ControllerSpec(measured="F1", bandwidth_hz=30, structure="pd"))
    return experiment, fit, controller, so.read_problem(so.demo_path())


@pytest.mark.parametrize("way", [again, copy.deepcopy])
def test_results_pickle_and_copy(whole_path, way):
    experiment, fit, controller, problem = whole_path
    for thing in whole_path:
        assert repr(way(thing)) == repr(thing)
    other = way(fit)
    before, after = fit.predict(experiment), other.predict(other.experiments[0])
    np.testing.assert_array_equal(after.model["F1"], before.model["F1"])
    refit = so.fit([way(experiment)], so.plants.thor().free("J", "b_r"))
    assert refit.parameters["J"].value == pytest.approx(fit.parameters["J"].value, rel=1e-9)
    assert to_json(way(controller).to_dict()) == to_json(controller.to_dict())
    assert way(problem).plants.keys() == problem.plants.keys()
