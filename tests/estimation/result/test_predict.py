"""Another log is scored from its own initial state and offset, against the truth that scipy simulates."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

import seaopt as so

M, B, K = 2.0, 3.0, 800.0


def spring(t, x, u, p):
    return {"x": x.v, "v": (u.F - p.b * x.v - p.k * x.x) / p.m}


PLANT = so.Plant(
    name="spring", states={"x": "m", "v": "m/s"}, inputs={"F": "N"}, outputs={"x": "m"},
    parameters={"m": "kg", "b": "N s/m", "k": "N/m"}, f=spring, h=lambda t, x, u, p: {"x": x.x},
)  # fmt: skip
PARAMS = so.ParameterSet.of(m=(1.5, "kg"), b=(2.0, "N s/m"), k=(K, "N/m"))


def make_log(seed, start, offset, noise=1e-4, n=2000):
    """Return a log of the mass on its spring, from scipy's dlsim, and the true position."""
    rng = np.random.default_rng(seed)
    force = 20.0 * rng.normal(size=n)
    system = (np.array([[0.0, 1.0], [-K / M, -B / M]]), np.array([[0.0], [1.0 / M]]), np.eye(2), np.zeros((2, 1)))
    _, states, _ = signal.dlsim(signal.cont2discrete(system, 0.005), force, x0=np.array(start))
    log = so.Log.from_arrays(time=0.005 * np.arange(n), F=force, x=states[:, 0] + offset + noise * rng.normal(size=n))
    return log, states[:, 0]


@pytest.fixture(scope="module")
def fitted():
    log, _ = make_log(1, [0.0, 0.0], 0.01)
    return so.fit([so.Experiment(plant=PLANT, log=log, name="first")], PARAMS.free("m", "b"), diagnostics=False)


def test_another_log_is_predicted_from_its_own_start_and_offset(fitted):
    log, truth = make_log(2, [0.3, -2.0], -0.2)
    score = fitted.predict(so.Experiment(plant=PLANT, log=log, name="second"))
    error = score.model["x"] - (truth - 0.2)
    assert np.sqrt(np.mean(error**2)) < 3e-5
    assert score.own.initial_state[0]["x"] == pytest.approx(0.3, abs=1e-3)
    assert score.own.offset["x"] == pytest.approx(-0.2, abs=1e-4)
    residual = score.model["x"] - log["x"]
    expected = 100 * (1 - np.linalg.norm(residual) / np.linalg.norm(log["x"] - log["x"].mean()))
    assert score.fit_percent["x"] == pytest.approx(expected)
    assert "second" in repr(score) and f"{expected:.2f}" in repr(score)


def test_a_log_that_has_nothing_of_its_own_is_scored(fitted):
    """Neither an initial state nor an offset is to be found then."""
    log, truth = make_log(2, [0.0, 0.0], 0.0)
    score = fitted.predict(so.Experiment(plant=PLANT, log=log, name="second", initial_state="rest", offset=False))
    assert np.sqrt(np.mean((score.model["x"] - truth) ** 2)) < 3e-5


def test_a_fit_that_is_not_judged_says_so(fitted):
    assert "not judged" in str(fitted)


def test_a_fit_with_nothing_free_scores_a_log(fitted):
    log, _ = make_log(3, [0.1, 0.0], 0.0)
    score = so.fit([so.Experiment(plant=PLANT, log=log)], fitted.parameters.fix())
    assert score.met
    assert score.outputs["experiment"]["x"].fit_percent > 98.5
    wrong = so.fit([so.Experiment(plant=PLANT, log=log)], PARAMS.update(m=4.0))
    assert not wrong.met


def test_a_holdout_with_shots_has_its_score():
    log, _ = make_log(4, [0.0, 0.0], 0.0)
    one = so.Experiment(plant=PLANT, log=log, shots=10)
    fit = so.fit([one], PARAMS.free("m", "b"), holdout=0.3)
    assert fit.outputs["experiment"]["x"].holdout_fit_percent > 98.0
