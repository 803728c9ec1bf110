"""Integration steps that are fine where a speed crosses zero and coarse elsewhere, against SciPy's DOP853."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import seaopt as so
from seaopt.estimation.solver.settle import coarsen
from seaopt.estimation.solver.step_shares import copy_steps, even_steps
from seaopt.estimation.solver.step_size import STEP_ERROR_SIGMA, measure_step_error

RATE_HZ, SECONDS = 500.0, 5.0
MOTOR = {"J_m": 2.4e-5, "b_r": 1e-4, "f_c": 0.012, "v_s": 0.5, "N": 100.0, "K_tau": 0.05, "k_s": 300.0}
LINK = {"J_l": 0.25, "d_l": 0.3, "m": 2.5, "L": 0.2}
NOISE = {"theta_m": 1e-3, "theta_l": 1e-4, "tau_s": 0.06}
LINKS = ("locked", "pendulum")


def simulate(p, current, link, start):
    """Return the states at the samples of a current that is held between them; zero of a link that is held."""

    def rates(t, x, ampere):
        angle, speed, turned, turning = x
        torque = p["k_s"] * (angle / p["N"] - turned)
        rub = p["f_c"] * math.tanh(speed / p["v_s"]) + p["b_r"] * speed
        swing = (torque - p["d_l"] * turning - p["m"] * 9.81 * p["L"] * math.sin(turned)) / p["J_l"]
        return speed, (p["K_tau"] * ampere - rub - torque / p["N"]) / p["J_m"], turning, swing * (link == "pendulum")

    x, states = np.array(start), []
    for ampere in current:
        states.append(x)
        span = (0.0, 1.0 / RATE_HZ)
        x = solve_ivp(rates, span, x, "DOP853", args=(ampere,), rtol=1e-10, atol=1e-12, first_step=span[1]).y[:, -1]
    return dict(zip(("theta_m", "thetad_m", "theta_l", "thetad_l"), np.array(states).T, strict=True))


def pose(link):
    """Return a log, its outputs and the plant."""
    t = np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ
    sweep = 2.0 * math.pi * 0.5 * SECONDS / math.log(20.0) * (20.0 ** (t / SECONDS) - 1.0)
    current = 1.5 * np.sin(sweep) + 0.5 * np.sin(2.0 * math.pi * 0.7 * t + 1.0)
    channels = simulate(MOTOR | LINK, current, link, np.zeros(4))
    channels["tau_s"] = MOTOR["k_s"] * (channels["theta_m"] / MOTOR["N"] - channels["theta_l"])
    rng = np.random.default_rng(3)
    outputs = ("theta_m", "theta_l" if link == "pendulum" else "tau_s")
    readings = {name: channels[name] + rng.normal(scale=NOISE[name], size=t.size) for name in outputs}
    return so.Log.from_arrays(time=t, I=current, **readings), outputs


@pytest.fixture(scope="module", params=LINKS)
def posed(request):
    """Return the link, the fit and its problem's experiment."""
    link, (log, outputs) = request.param, pose(request.param)
    plant = so.plants.rotary(link=link)
    known = {name: value for name, value in (MOTOR | LINK).items() if name in plant.parameters}
    params = plant.defaults.update(**known | {"J_m": 3e-5, "f_c": 0.009, "k_s": 250.0}).free("J_m", "f_c", "k_s")
    fit = so.fit([so.Experiment(plant=plant, log=log, outputs=outputs)], params, diagnostics=False)
    return link, fit, fit.require_minimum("").problem.experiments[0]


def test_few_samples_take_many_steps(posed):
    _, fit, experiment = posed
    (segment,) = experiment.segments
    steps = experiment.point(fit.require_minimum("").z).count_steps(segment.samples)
    assert steps.max() > 16 and steps.mean() < 0.25 * steps.max()
    speed = experiment.run(segment, fit.require_minimum("").z, states=True).states[:, 1]
    before, after = speed[:-1], speed[1:]
    slow = (before * after < 0.0) | (np.minimum(np.abs(before), np.abs(after)) < 10.0 * MOTOR["v_s"])
    assert np.all(slow[steps[:-1] > 0.5 * steps.max()])  # which turn, or nearly


def test_they_are_as_exact_as_the_same_number_everywhere(posed):
    link, fit, experiment = posed
    minimum, (own,) = fit.require_minimum(""), fit.nuisance.values()
    values = {name: fit.parameters[name].value if name in fit.parameters else LINK[name] for name in MOTOR | LINK}
    start = [*own.initial_state[0].values(), 0.0, 0.0][:4]
    exact = simulate(values, experiment.data.log["I"], link, start)
    exact["tau_s"] = values["k_s"] * (exact["theta_m"] / values["N"] - exact["theta_l"])
    found = experiment.run(experiment.segments[0], minimum.z, outputs=True).outputs
    for column, name in zip(found.T, experiment.data.outputs, strict=True):
        assert np.max(np.abs(column - exact[name])) < STEP_ERROR_SIGMA * NOISE[name]
    # In parameters: the minimum with finer steps is the same.
    error = measure_step_error(minimum.problem, experiment, minimum.problem.evaluate(minimum.z))
    assert error.small
    assert error.output < STEP_ERROR_SIGMA


def test_the_minimum_is_that_of_fine_steps_everywhere(posed):
    _, fit, experiment = posed
    minimum = fit.require_minimum("")
    plain = replace(experiment.segments[0], samples=replace(experiment.segments[0].samples, shares=None))
    uniform = replace(minimum.problem, experiments=(replace(experiment, segments=(plain,), substeps=64),))
    at = uniform.evaluate(minimum.z)
    free = np.ones(minimum.z.size, dtype=bool)
    assert at.distance_squared(free) < 0.05**2  # standard deviations


def test_steps_of_another_problem_are_even_where_they_cannot_be_shared_out(posed):
    _, fit, experiment = posed
    minimum = fit.require_minimum("")
    problem = minimum.problem
    steps = experiment.point(minimum.z).count_steps(experiment.segments[0].samples)
    assert steps.mean() < experiment.even_substeps < experiment.substeps
    even = even_steps(problem).experiments[0]
    assert even.segments[0].samples.shares is None and even.substeps == experiment.even_substeps
    own = copy_steps(even_steps(problem), problem).experiments[0]
    assert own.substeps == experiment.substeps
    assert own.segments[0].samples.shares is experiment.segments[0].samples.shares
    segment = experiment.segments[0]
    shifted = replace(segment, samples=replace(segment.samples, start_s=1.0, shares=None))
    other = replace(problem, experiments=(replace(experiment, segments=(shifted,), substeps=1),))
    assert copy_steps(other, problem).experiments[0].substeps == experiment.even_substeps
    errors = [
        measure_step_error(each, each.experiments[0], each.evaluate(minimum.z)).parameter
        for each in (problem, even_steps(problem))
    ]
    assert 0.25 < errors[1] / errors[0] < 4.0
    coarse, _ = coarsen(problem, minimum.z)
    assert coarse.experiments[0].segments[0].samples.shares is None
