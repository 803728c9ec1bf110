"""What tuning leaves to the draws of the certificate: a law on its limits has no room for what the fit leaves open."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from seaopt.problem import certify_problem, tune_problem
from seaopt.robustness import JointTuning
from seaopt.robustness.certificate.simulated import SIMULATIONS
from tests.checks import leave_out

TEXT = """schema = 1
[parameters]
k = {{ value = 655000, prior_std = {std} }}
eta = {{ value = 1.0, prior_std = 0.02 }}
[plant.stand]
kind = "high_impedance"
[controller]
plant = "stand"
measured = "F1"
bandwidth_hz = 30
max_sensitivity = {ms}
[robustness]
samples = 200
"""


@pytest.fixture
def make(tmp_path):
    """Return what reads a problem of a stand whose spring and efficiency are known to a few percent."""

    def read(extra="", *, std=20000, ms=1.6):
        (tmp_path / "problem.toml").write_text(TEXT.format(std=std, ms=ms) + extra, encoding="utf-8")
        return so.read_problem(tmp_path / "problem.toml")

    return read


def find_largest_ms(controller, k: float, eta: float) -> float:
    """Return the peak of S by python-control's state spaces, on frequencies of the test's."""
    plant, params = controller.design
    loop = controller.close(plant, params.update(k=k, eta=eta)).to_control()
    z = np.exp(2j * np.pi * np.geomspace(1.0, 499.0, 4000) * controller.sample_time_s)
    return float(np.max(np.abs(loop(z)[0, 0])))


def test_a_law_keeps_its_limits_at_the_draws(make, monkeypatch):
    """Tuned once it lies on its limits, and a tenth more stiffness breaks them; by default there is room for that."""
    leave_out(monkeypatch, SIMULATIONS)  # which take most of the time, and neither law fails
    once, problem = make("retune = 0\n"), make()
    bare, tuned = tune_problem(once, once.parameters), tune_problem(problem, problem.parameters)
    assert bare.met and isinstance(tuned, JointTuning) and tuned.met
    corners = [(655000.0 + 60000.0 * a, 1.0 + 0.04 * b) for a in (-1, 1) for b in (-1, 1)]
    assert max(find_largest_ms(bare, *at) for at in corners) > 1.63
    assert max(find_largest_ms(tuned.controller, *at) for at in corners) <= 1.6
    assert not certify_problem(once, bare, once.parameters).met
    assert certify_problem(problem, tuned.controller, problem.parameters).met


def test_what_cannot_be_kept_at_the_draws_says_what_can(make):
    problem = make(std=60000, ms=1.3)
    tuned = tune_problem(problem, problem.parameters)
    assert tuned.status == "infeasible" and 15.0 < tuned.controller.largest_bandwidth_hz < 30.0


def test_a_law_with_room_is_tuned_once(make):
    """Of what nothing is uncertain there is nothing to look at."""
    problem = make()
    tuned = tune_problem(problem, so.plants.thor())
    assert isinstance(tuned, so.Controller) and tuned.met
