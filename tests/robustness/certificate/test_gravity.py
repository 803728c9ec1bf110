"""The requirement on a controller that compensates gravity: no link that hangs may rise, whatever it weighs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import seaopt as so
from seaopt.control import (
    CompensateGravity,
    Impedance,
    SampledLoop,
    add_compensation,
    add_impedance,
    run_loop,
    runnable,
)
from seaopt.files import to_json
from seaopt.robustness.certificate import compensation
from seaopt.robustness.certificate.compensation import NEUTRAL, choose_worst, measure_gravity
from seaopt.robustness.certificate.limits import WITH_TERMS
from tests.hanging_link import KNEE, VALUES, tune_held


@pytest.fixture(scope="module")
def plain():
    return tune_held()


def find_worst_gravity(controller, plant, nominal, draws):
    return choose_worst(measure_gravity(controller, plant, nominal, draw) for draw in draws)


def compensate(controller, fraction):
    return add_compensation(controller, gravity=CompensateGravity(fraction=fraction), link=(KNEE, VALUES))


def test_eigenvalue_is_that_of_the_link_under_what_is_left_of_its_weight(plain):
    found = find_worst_gravity(compensate(plain, 1.2), KNEE, VALUES, [{}])
    left = 4.0 * 9.81 * 0.2 * (1.0 - 1.2)  # J s^2 + d s + left = 0, and the torque follows its reference at once
    rate = (-0.5 + np.sqrt(0.25 - 4.0 * 0.3 * left)) / 0.6
    assert found.at == pytest.approx(0.0, abs=1e-9)
    assert (found.radius - 1.0) / 1e-3 == pytest.approx(rate, rel=0.05)


def test_eigenvalue_has_the_damping_of_an_impedance_without_stiffness(plain):
    def find(fraction, damping):
        damped = add_impedance(compensate(plain, fraction), KNEE, VALUES, Impedance(stiffness=0.0, damping=damping))
        return find_worst_gravity(damped, KNEE, VALUES, [{}]).radius

    left = 4.0 * 9.81 * 0.2 * (1.0 - 1.2)
    rate = (-5.5 + np.sqrt(5.5**2 - 4.0 * 0.3 * left)) / 0.6
    assert (find(1.2, 5.0) - 1.0) / 1e-3 == pytest.approx(rate, rel=0.05)
    assert find(0.8, 200.0) > 1.0  # more than the force loop renders


def test_damping_and_weight_act_alike_in_either_order(plain):
    damping = Impedance(stiffness=0.0, damping=5.0)
    orders = (
        add_impedance(compensate(plain, 0.9), KNEE, VALUES, damping),
        compensate(add_impedance(plain, KNEE, VALUES, damping), 0.9),
    )
    assert to_json(orders[0].to_dict()) == to_json(orders[1].to_dict())
    loop = SampledLoop(plant=KNEE, law=runnable(orders[1], outer=True), measured="tau_s", delay_samples=1)
    turned = run_loop(loop, [VALUES], np.full(3000, 0.5)).outputs["theta_l"][0]

    def move(t, x):  # the link, whose torque follows at once
        return x[1], (0.5 - 5.0 * x[1] - 0.5 * x[1] - 0.1 * 4.0 * 9.81 * 0.2 * np.sin(x[0])) / 0.3

    t = 1e-3 * np.arange(3000)
    expected = solve_ivp(move, (0.0, t[-1]), (0.0, 0.0), t_eval=t, rtol=1e-8).y[0]
    np.testing.assert_allclose(turned, expected, atol=0.02 * expected[-1])


def test_a_link_that_weighs_less_than_is_compensated_is_found(plain):
    lighter = [{}, {"m": 3.5}, {"m": 4.5}]
    whole = compensate(plain, 1.0)
    neutral = find_worst_gravity(whole, KNEE, VALUES, [{}])
    assert neutral.radius <= 1.0 + NEUTRAL
    assert find_worst_gravity(compensate(plain, 0.8), KNEE, VALUES, lighter).radius < 1.0
    worst = find_worst_gravity(whole, KNEE, VALUES, lighter)
    assert (worst.radius > 1.0 + NEUTRAL, worst.parameters) == (True, {"m": 3.5})
    held = compensate(add_impedance(plain, KNEE, VALUES, Impedance(stiffness=20.0, damping=1.0)), 1.0)
    assert find_worst_gravity(held, KNEE, VALUES, lighter).radius < 1.0


def test_nothing_is_shown_of_a_link_that_falls_by_itself_wherever_it_is(plain, monkeypatch):
    monkeypatch.setattr(compensation, "find_radius", lambda *_, **__: 1.1)
    assert np.isinf(find_worst_gravity(compensate(plain, 0.8), KNEE, VALUES, [{}]).radius)


@pytest.mark.slow
def test_certificate_requires_it(plain):
    certificate = so.certify(
        compensate(plain, 1.0), {"knee": KNEE}, VALUES, ranges={"m": (3.7, 4.3)}, samples=5, simulations=False
    )
    (row,) = [row for row in certificate.requirements if row.name == "gravity_compensation"]
    assert WITH_TERMS in certificate.notes
    assert not row.met
    assert row.where.startswith("knee at m = 3") and row.text.endswith("at 0 rad")


def test_an_impedance_stands_where_it_is_asked_to(plain):
    stiff = compensate(add_impedance(plain, KNEE, VALUES, Impedance(stiffness=20.0, damping=1.0)), 1.0)
    loop = SampledLoop(plant=KNEE, law=runnable(stiff, outer=True), measured="tau_s", delay_samples=1)
    ends = run_loop(loop, [VALUES], np.full(4000, 0.6)).outputs["theta_l"][0]
    assert ends[-1] == pytest.approx(0.6, abs=2e-3)  # 20 N m/rad against 4.4 N m: without it 0.45
