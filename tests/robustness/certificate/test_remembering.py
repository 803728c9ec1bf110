"""Friction and springs that remember, certified: a loop that is fine at rest alone does not pass."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from seaopt.control.laws.realisation import runnable
from seaopt.control.loops.loop import Loop
from seaopt.control.running.closed_loop import SampledLoop, run_loop
from seaopt.plants.friction import STUCK, friction_states

SPEC = so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.7)


def with_own(thor, plant, **values):
    return thor.with_parameters(*(one for one in plant.parameters.values() if one.name not in thor)).update(**values)


def failing(certificate):
    return {row.where for row in certificate.requirements if not row.met}


def test_a_loop_that_is_fine_at_rest_and_rings_once_it_slides_fails(thor):
    """Tuned on bristles that hold, as a linearisation at rest has them, it rings once they slip."""
    stand = so.plants.high_impedance(parts=["lugre"])
    params = with_own(thor, stand, f_c=60.0, sigma_0=2e6)
    at_rest = friction_states(stand)[STUCK]
    controller = so.tune(at_rest, params, SPEC)
    assert controller.feasible
    rest = Loop(plant=controller.plant(stand, params), law=controller.law).figures()
    assert rest.ms == pytest.approx(controller.achieved.ms, rel=1e-9)  # the linearisation at rest says no more
    assert rest.reference_peak <= 1.3
    loop = SampledLoop(
        plant=stand, law=runnable(controller), measured="F1", delay_samples=controller.compute_delay_samples
    )
    force = run_loop(loop, [params], np.full(400, 1500.0)).outputs["F1"][0]
    crossings = np.flatnonzero(np.diff(np.sign(force - 1500.0)))
    assert np.max(force) > 1.35 * 1500.0
    assert crossings.size >= 4
    certificate = so.certify(controller, {"stand": stand}, params, simulations=False)
    assert not certificate.passed
    assert certificate.plants["stand stuck"].ms <= 1.7
    assert certificate.plants["stand sliding"].ms > 2.0
    assert any("stand sliding" in where for where in failing(certificate))
    assert max(row.overshoot for row in certificate.steps.rows) > 0.35, "steps are played"


@pytest.mark.slow
def test_a_spring_with_hysteresis_is_certified_at_its_stiffest_and_its_softest(thor):
    """They are plain springs of k and of k + k_h, each with its figures; a law tuned for k alone fails on the other."""
    stand, plain = so.plants.high_impedance(parts=["hysteresis"]), so.plants.high_impedance()
    params = with_own(thor, stand, k_h=1.2e6)
    controller = so.tune(plain, thor, SPEC)
    certificate = so.certify(controller, {"stand": stand}, params, simulations=False)
    for name, k in (("stand sliding", 655e3), ("stand spring_slip stuck", 655e3 + 1.2e6)):
        expected = controller.close(plain, thor.update(k=k)).figures()
        assert certificate.plants[name].ms == pytest.approx(expected.ms, rel=1e-6)
        assert certificate.plants[name].mt == pytest.approx(expected.mt, rel=1e-6)
    assert certificate.plants["stand sliding"].ms < 1.7 < certificate.plants["stand spring_slip stuck"].ms
    assert not certificate.passed
    assert not any("stand sliding" in where for where in failing(certificate))
    assert certificate.to_dict()["friction"]["stand"]["sector_stable"] is None


@pytest.mark.slow
def test_tuned_on_all_its_states_it_passes_and_says_what_is_not_shown(thor):
    stand = so.plants.high_impedance(parts=["lugre", "hysteresis"])
    params = with_own(thor, stand, f_c=30.0, k_h=6e4)
    controller = so.tune(stand, params, SPEC)
    certificate = so.certify(controller, {"stand": stand}, params, simulations=False)
    assert certificate.passed
    assert list(certificate.plants) == [f"stand {state}" for state in friction_states(stand)]
    assert "bristles" in str(certificate.friction["stand"])
    assert {row.friction for row in certificate.steps.scenarios["stand"]} == {"sticking"}  # as they are: once each
