"""A screw whose spring is damped, fitted without: the part is named, with all lines that add it."""

import pytest

import seaopt as so
from seaopt.bench import PAPER_STAND
from seaopt.reporting.sections import judge


def test_a_damped_spring_of_a_screw_is_named_with_the_lines_that_add_it(thor):
    """What comes next was the value alone, which without its part does nothing."""
    plant = so.plants.high_impedance()
    damped = so.plants.add_part(plant, "spring_damping")
    truth = damped.defaults.with_parameters(*thor.subset(["m_l", "k", "l", "N_p", "K_tau", "J", "b_r"]).values())
    noise = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0})
    log = so.virtual_log(
        damped, truth.update(c_k=600.0), PAPER_STAND, duration_s=20, rate_hz=400, seed=1, sensors=noise
    )
    start = thor.update(J=1e-6, b_r=5e-4, m_l=1.0).free("J", "b_r", "m_l")
    fit = so.fit([so.Experiment(plant=plant, log=log, outputs=("F1", "F2"))], start)
    assert not fit.met
    row = next(row for row in fit.hypotheses if row.parts == ("spring_damping",))
    assert row.frees["c_k"] == pytest.approx(600.0, rel=0.02)
    part, value, *_ = judge(fit).next
    assert part.text.startswith("write under [plant.NAME]") and part.copied == ('parts = ["spring_damping"]',)
    assert value.text.startswith("write under [parameters]") and value.copied[0].startswith("c_k = { value = ")
