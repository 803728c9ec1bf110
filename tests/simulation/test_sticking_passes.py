"""Friction that sticks, in simulation and fit: against closed forms, differences, and the tests' own simulator."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import seaopt as so
from seaopt.errors import PlantError
from seaopt.plants.plant import state_space
from seaopt.plants.roles import Friction
from seaopt.simulation import Clock, Point, Segment, Weights, make_model, run_passes
from seaopt.simulation.interpreted import interpret_pass
from tests.stick_slip import Mass, simulate

FREE = ("m", "k", "f_c")


def make_block(**roles):
    """Return a mass on a spring with friction that sticks."""
    rub = Friction(velocity=lambda x, p: x.v, jump=lambda v, p: p.f_c, force=lambda v, p: p.f_c * ca.tanh(v / 1e-3))
    return so.Plant(
        name="block", states={"x": "m", "v": "m/s"}, inputs={"F": "N"}, outputs={"x": "m", "push": "N"},
        parameters={"m": "kg", "k": "N/m", "f_c": "N"},
        f=lambda t, x, u, p: {"x": x.v, "v": (u.F - p.k * x.x - u.rub) / p.m},
        h=lambda t, x, u, p: {"x": x.x, "push": u.F - u.rub},
        friction={"rub": replace(rub, **roles)}, sticks=True,
    )  # fmt: skip


BLOCK, VALUES = make_block(), so.ParameterSet.of(m=(2.0, "kg"), k=(800.0, "N/m"), f_c=(3.0, "N"))


@pytest.fixture(scope="module")
def drive():
    """Return two seconds at 500 Hz of a force that grows, below friction at first."""
    t = np.arange(1000) / 500
    return 8.0 * np.sin(2 * np.pi * 1.3 * t) * (0.2 + t)


def make_point(theta, hold="zero", *, free=False, delay_s=0.0):
    """Return a point of the block's passes."""
    clock = Clock(period=2e-3, hold=hold, delay_s=delay_s, delay_free=free)
    return Point(theta=np.array(theta), offset=np.zeros(2), gain=np.ones(2), clock=clock, substeps=3)


@pytest.mark.parametrize(
    ("hold", "free"),
    [
        ("zero", False),
        ("first", True),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in (("first", False), ("zero", True))),
    ],
)
def test_compiled_and_interpreted_passes_agree_and_their_derivatives_are_those_of_differences(drive, hold, free):
    model, start, plain = make_model(BLOCK, VALUES, FREE), np.array([0.01, 0.0]), Weights.plain(2)
    segment = Segment(u=(drive,), y=(np.zeros(drive.size), np.zeros(drive.size)))
    theta, delay = np.array([2.0, 800.0, 3.0]), 0.7e-3
    assert model.sticks and not model.linear

    def run(theta, delay):
        point = make_point(theta, hold, free=free, delay_s=delay)
        return run_passes(model, segment, point, start, plain, outputs=True, columns=True)

    here = run(theta, delay)
    there = interpret_pass(
        model,
        segment,
        make_point(theta, hold, free=free, delay_s=delay),
        plain,
        drive.size,
        start,
    )
    assert np.allclose(here.outputs, there.outputs, rtol=1e-10, atol=1e-13)
    assert np.allclose(here.gram, there.gram, rtol=1e-8, atol=1e-8 * np.max(np.abs(there.gram)))
    places = [
        *((j, np.eye(3)[j] * 1e-5 * theta[j], 0.0) for j in range(3)),
        *([(3, np.zeros(3), 1e-7)] if free else []),
    ]
    for column, by, late in places:
        size = np.linalg.norm(by) + late
        differences = (run(theta + by, delay + late).outputs - run(theta - by, delay - late).outputs) / (2 * size)
        stated = here.columns[:, :, 1 + column]
        # A joint that stops or lets go in another sample makes a small jump, which a difference sees.
        off = np.abs(stated[:, 0] - differences[:, 0]) / np.max(np.abs(differences[:, 0]))
        assert np.quantile(off, 0.99) < 1e-3 and np.max(off) < 0.01


def test_a_free_delay_of_whole_samples_has_the_derivatives_of_one_beside_it(drive):
    model, start, plain = make_model(BLOCK, VALUES, FREE), np.zeros(2), Weights.plain(2)
    segment = Segment(u=(drive,), y=(np.zeros(drive.size), np.zeros(drive.size)))

    def run(delay):
        point = make_point([2.0, 800.0, 3.0], free=True, delay_s=delay)
        return run_passes(model, segment, point, start, plain, outputs=True, columns=True)

    whole, beside = run(2e-3), run(2e-3 + 1e-9)
    assert np.allclose(whole.outputs[:, 0], beside.outputs[:, 0], atol=1e-8)
    size = np.max(np.abs(beside.columns[:, 0]), axis=0)  # of the speed that sticks at the start it is zero
    assert np.all(np.abs(whole.columns[:, 0] - beside.columns[:, 0]) <= 1e-3 * size + 1e-8)


def test_a_held_joint_stands_still_and_its_force_is_what_holds_it(drive):
    log = so.Log.from_arrays(time=np.arange(100) / 500, F=np.full(100, 2.5))
    run = so.simulate(BLOCK, VALUES, log)
    assert np.all(np.abs(run["v"]) < 1e-15) and np.allclose(run["push"], 0.0, atol=1e-12)
    creeping = so.simulate(replace(BLOCK, sticks=False), VALUES, log)
    assert creeping["x"][-1] > 1e-5


def test_friction_that_grows_with_the_load_slides_and_holds_as_in_closed_form():
    """Without a spring, and friction c + l |F|: v' = ((1 - l) F - c)/m beyond F = c/(1 - l), and rest below."""
    block = make_block(
        force=lambda v, p: (p.f_c + 0.25 * ca.fabs(p.load)) * ca.tanh(v / 1e-3),
        jump=lambda v, p: p.f_c + 0.25 * ca.fabs(p.load),
        loads=lambda x, u, p: {"load": u.F}, rated={"load": 10.0},
    )  # fmt: skip
    values = VALUES.update(k=0.0)
    t = np.arange(1000) / 500
    rising = 4.0 * t  # lets go at 4 N
    run = so.simulate(block, values, so.Log.from_arrays(time=t, F=rising), hold="first", rtol=1e-9)
    since = np.maximum(t - 1.0, 0.0)
    assert np.allclose(run["v"], (0.75 * 4.0 * since**2 / 2) / 2.0, atol=1e-6)
    assert state_space(block, values)[0][1, 1] == pytest.approx(-3.0 / 2.0 / 1e-3)  # at rest there is no load


@pytest.mark.slow
def test_fit_finds_an_actuator_that_truly_sticks_and_says_met():
    """Coulomb's jump by the tests' own simulator: found within four standard deviations, without smoothing."""
    stand = so.plants.let_stick(so.plants.high_impedance())
    truth = so.plants.thor().update(f_c=35.0)
    values = {name: parameter.value for name, parameter in stand.complete(truth).items()}
    rate, n, rng = 1000.0, 2500, np.random.default_rng(3)
    t = np.arange(n) / rate
    tones = np.unique(np.round(np.geomspace(0.5, 60, 25) / 0.25) * 0.25)
    current = 2.0 * np.sin(2 * np.pi * 0.5 * t) + 0.3 * sum(
        np.sin(2 * np.pi * tone * t + rng.uniform(0, 2 * np.pi)) for tone in tones
    )
    through = {"num": [1.0], "den": [1.0]}
    law = {
        "sample_time_s": 1 / rate,
        "delay_samples": 0,
        "reference": through,
        "measurement": {"num": [0.0], "den": [1.0]},
    }
    effort = values["eta"] * values["K_tau"] / (values["l"] / (2 * np.pi * values["N_p"]))
    run = simulate([Mass.of(values, jump=True)], [law], effort * current[None], substeps=30)
    log = so.Log.from_arrays(time=t, I=current, F1=run.force[0] + 2.0 * rng.normal(size=n))
    start = truth.update(J=2e-6, b_r=2e-4, f_c=10.0).free("J", "b_r", "f_c")
    fit = so.fit([so.Experiment(plant=stand, log=log, outputs=("F1",))], start)
    assert fit.met, str(fit)
    for name in ("J", "b_r", "f_c"):
        found = fit.parameters[name]
        assert abs(found.value - values[name]) < 4.0 * found.std, found
    assert fit.parameters["f_c"].std < 0.5


def test_what_cannot_stick_and_loads_that_are_not_rated_are_refused():
    with pytest.raises(PlantError, match="jump"):
        so.plants.let_stick(make_block(jump=None))
    with pytest.raises(PlantError, match="rated"):
        make_block(loads=lambda x, u, p: {"load": u.F})
    with pytest.raises(PlantError, match="is a parameter"):
        make_block(loads=lambda x, u, p: {"k": u.F}, rated={"k": 1.0})
    with pytest.raises(PlantError, match="true or false"):
        so.plants.plant_of_kind("high_impedance", sticks="yes")
    assert so.plants.plant_of_kind("high_impedance", sticks=True).sticks


@pytest.mark.slow
def test_a_fall_of_friction_that_lost_its_effect_on_the_way_is_brought_back():
    """Stribeck's fall: from this start the search once ended at v_st = 7e-5, where it does nothing, and said met."""
    stand = so.plants.let_stick(so.plants.high_impedance(parts=["stribeck"]))
    own = (so.Parameter(name="f_s", value=30.0, unit="N"), so.Parameter(name="v_st", value=0.01, unit="m/s"))
    truth = so.plants.thor().update(f_c=20.0).with_parameters(*own)
    values = {name: parameter.value for name, parameter in stand.complete(truth).items()}
    rate, n, rng = 500.0, 4000, np.random.default_rng(2)
    t = np.arange(n) / rate
    tones = np.unique(np.round(np.geomspace(0.25, 60, 30) / 0.125) * 0.125)
    current = np.sin(2 * np.pi * 0.25 * t) + 0.9 / np.sqrt(15) * sum(
        np.sin(2 * np.pi * tone * t + rng.uniform(0, 2 * np.pi)) for tone in tones
    )
    through = {"num": [1.0], "den": [1.0]}
    law = {"sample_time_s": 1 / rate, "delay_samples": 0, "reference": through, "measurement": through | {"num": [0.0]}}
    effort = values["eta"] * values["K_tau"] / (values["l"] / (2 * np.pi * values["N_p"]))
    run = simulate([Mass.of(values, jump=True)], [law], effort * current[None], substeps=60)
    log = so.Log.from_arrays(time=t, I=current, F1=run.force[0] + 2.0 * rng.normal(size=n))
    start = truth.update(J=2.5e-6, b_r=2e-4, f_c=12.0, f_s=20.0, v_st=0.02, eta=0.9)
    free = start.free("J", "b_r", "eta", "f_c", "f_s", "v_st")
    fit = so.fit([so.Experiment(plant=stand, log=log, outputs=("F1",))], free)
    assert fit.met, str(fit)
    for name in free.free_names:
        assert abs(fit.parameters[name].value - values[name]) < 4.0 * fit.parameters[name].std, fit.parameters[name]
