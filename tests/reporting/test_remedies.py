"""What is said to do about a certificate that is refused, done: it has to help."""

from __future__ import annotations

from dataclasses import replace

import pytest

import seaopt as so
from seaopt.control import CompensateGravity, add_compensation
from seaopt.control.laws.verdict import BindingLimit, advise_easing
from seaopt.reporting.sections.data import Commands
from seaopt.reporting.sections.kinds import controller as controllers
from seaopt.reporting.sections.kinds.certificate import REMEDIES, advise, judge
from seaopt.robustness import JointTuning
from seaopt.robustness.certificate.requirement import Requirement
from seaopt.robustness.certificate.simulated import STEPS
from tests.checks import leave_out

SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.7, max_complementary=1.3)


@pytest.fixture(autouse=True)
def without_steps(monkeypatch):
    leave_out(monkeypatch, STEPS)


def test_a_plant_that_was_not_tuned_for_is_named_and_helps_when_it_is(stand, thor):
    plants = {"stand": stand, "swing": so.plants.moving_output()}
    alone = so.tune(stand, thor, SPEC)
    certificate = so.certify(alone, plants, thor, simulations=False)
    assert judge(certificate, Commands()).next[0].text.startswith('add "swing" to robust_to in [controller]')
    both = so.tune(stand, thor, SPEC, robust_to={"swing": plants["swing"]})
    assert so.certify(both, plants, thor, simulations=False).met


def test_to_tune_for_a_plant_is_advised_only_where_that_is_possible(stand, thor):
    controller = so.tune(stand, thor, SPEC)
    assert not controller.robust_to
    row = Requirement(name="max_sensitivity", limit=1.7, value=1.9, met=False, plant="stand")
    other = so.plants.moving_output()
    assert "robust_to" in advise(row, controller, models={"stand": other})
    assert "robust_to" not in advise(row, controller, models={"stand": stand})  # the design plant by its name
    by_hand = so.assess(controller.law, stand, thor, SPEC)
    assert "robust_to" not in advise(row, by_hand, models={"stand": other})  # which nothing tunes


def test_a_weight_that_the_tuner_does_not_see_is_compensated_less():
    knee, held = so.plants.rotary("pendulum"), so.plants.rotary("locked")
    values = knee.defaults.update(
        N=100.0, K_tau=0.0369, eta=0.7, J_m=2.4e-5, b_r=1e-4, k_s=300.0, J_l=0.25, d_l=0.3, m=3.0, L=0.25, f_c=0.0
    )
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=15, max_sensitivity=1.6)
    law = so.tune(held, values, spec, robust_to={"knee": knee})

    def certify(fraction):
        carrying = add_compensation(law, gravity=CompensateGravity(fraction=fraction), link=(knee, values))
        return so.certify(carrying, {"knee": knee}, values, ranges={"m": (2.8, 3.2)}, samples=20, simulations=False)

    refused = certify(0.95)
    verdict = judge(refused, Commands())
    assert verdict.next[0].text.startswith(REMEDIES["gravity_compensation"])
    assert not any(
        "retune" in text or "robust_to" in text
        for text in (*(step.text for step in verdict.next), *map(str, verdict.reasons))
    )
    drawn = tuple(row for row in refused.requirements if row.name != "gravity_compensation")
    assert judge(replace(refused, requirements=drawn), Commands()).next[0] == verdict.next[0]  # by the worst plant
    rounds = JointTuning(status="rounds", controller=law, certificate=refused, rounds=(), robust_to={})
    assert "more rounds" not in rounds.explanation and "smaller fraction" in rounds.explanation
    assert certify(0.85).met


def test_only_a_limit_that_binds_is_eased(stand, thor):
    controller = so.tune(stand, thor, SPEC)
    assert not any(name.startswith("max_noise_gain") for name in controller.active_constraints)
    error = Requirement(name="steady_error", limit=0.03, value=0.04, met=False, plant="stand")
    text = advise(error, controller, models={})
    assert "lower bandwidth_hz" in text and "noise" not in text
    noise, stand_peak = BindingLimit(name="max_noise_gain"), BindingLimit(name="max_complementary", plant="stand")
    bound = replace(controller, binding=(noise, stand_peak, noise))
    assert advise(error, bound, models={}).endswith("or raise max_noise_gain and max_complementary")
    unliftable = [BindingLimit(name=name) for name in ("min_sensitivity_bandwidth_hz", "shoulder_hz")]
    assert advise_easing(unliftable) == "lower min_sensitivity_bandwidth_hz"


def test_a_link_that_nothing_holds_is_what_an_integral_fails_on(stand, thor):
    """A free mass takes no lasting force: P(0) = 0, which cancels an integral. To ease a limit changes nothing."""
    free = so.plants.two_link(link2="mass", spring="link2")
    values = thor.with_parameters(*free.defaults.values()).update(m_2=3.0)
    plants = {"free": free}
    controller = so.tune(stand, values, SPEC, robust_to=plants)
    verdict = controllers.judge(controller, Commands())
    assert "nothing holds the link there" in verdict.reasons[0].what
    assert not any("raise" in step.text or "lower" in step.text for step in verdict.next)
    certificate = so.certify(controller, plants, values, samples=2, simulations=False)
    where = judge(certificate, Commands()).reasons[0].where
    assert "nothing holds the link there" in where and "tune with that plant" not in where
