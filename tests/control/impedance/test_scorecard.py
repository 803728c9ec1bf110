"""The scorecard against the actuator's equations and a simulation of white noise."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from seaopt.control import scorecard

STAND, THOR = so.plants.high_impedance(), so.plants.thor()
PERIOD = 1e-3


@pytest.fixture(scope="module")
def controller() -> so.Controller:
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25, compute_delay_samples=1)
    return so.tune(STAND, THOR, spec)


def test_impedance_is_that_of_the_equations(controller: so.Controller) -> None:
    """Z = (m_l s^2 + k)(M s + b_m)/(m_k s^2 + b_m s + k (1 + C')), by hand."""
    value = {name: THOR[name].value for name in ("m_l", "k", "J", "l", "N_p", "b_r")}
    r = value["l"] / (2 * np.pi * value["N_p"])
    k, m_l, mass, damper = value["k"], value["m_l"], value["J"] / r**2, value["b_r"] / r**2
    s = np.array([2j * np.pi])
    late = np.exp(-1.5 * s * PERIOD) * np.sinc(PERIOD)
    law = controller.law.measurement_response(np.array([1.0])) * late
    z = (m_l * s**2 + k) * (mass * s + damper) / ((mass + m_l) * s**2 + damper * s + k * (1 + law))
    score = scorecard({"pid": controller})["pid"]
    assert score.impedance_1hz == pytest.approx(float(np.abs(z[0])), rel=1e-6)
    assert score.bandwidth_hz == controller.achieved.bandwidth_hz
    assert score.noise_gain == controller.achieved.noise_gain
    assert score.unit == "N s/m"


def test_noise_is_that_of_a_simulation(controller: so.Controller) -> None:
    system = controller.close(STAND, THOR).system().block
    noise = np.random.default_rng(0).normal(size=100_000)
    x, effort = np.zeros(len(system.a)), np.empty(noise.size)
    for i, n in enumerate(noise):
        effort[i] = system.c[1] @ x + system.d[1, 0] * n
        x = system.a @ x + system.b[:, 0] * n
    assert scorecard({"pid": controller})["pid"].noise_rms == pytest.approx(np.std(effort), rel=0.02)


def test_no_controller_is_refused() -> None:
    with pytest.raises(so.SeaoptError, match="no controller"):
        scorecard({})
