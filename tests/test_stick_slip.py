"""The stick-slip simulator of the tests, against closed forms and SciPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.stick_slip import Mass, simulate

ACTUATOR = Mass(m=2.0, b=0.0, k=800.0, f_c=5.0)
PASS_ON = {  # effort = reference, at once
    "sample_time_s": 1e-3, "delay_samples": 0, "reference": {"num": [1.0], "den": [1.0]},
    "measurement": {"num": [0.0], "den": [1.0]},
}  # fmt: skip


def test_dry_friction_takes_four_f_c_a_cycle_and_holds():
    """From rest under F the mass swings between F -+ (F - f_c), (F - 3 f_c), ... and sticks within f_c of F."""
    force = 47.0
    runs = simulate([ACTUATOR], [PASS_ON], np.full((1, 1000), force), substeps=25)
    period = 2 * np.pi * np.sqrt(2.0 / 800.0)
    swing = force - 5.0  # half a cycle with friction against it: about F - f_c
    ends = [2 * swing]
    for _ in range(3):
        ends.append(2 * (force + (-1) ** len(ends) * -5.0) - ends[-1])
    times = np.round(np.arange(1, 5) * period / 2 / 1e-3).astype(int)
    assert runs.force[0, times] == pytest.approx(ends, rel=2e-3)
    assert runs.largest[0] == pytest.approx(ends[0], rel=1e-3)
    assert np.ptp(runs.force[0, -100:]) < 1e-9 and abs(runs.force[0, -1] - force) <= 5.0


@pytest.mark.parametrize("f_s", [pytest.param(0.0, marks=pytest.mark.slow), 8.0])
def test_smoothed_friction_is_the_differential_equation(f_s):
    mass = replace(ACTUATOR, b=3.0, v_s=0.02, f_s=f_s, v_st=0.1)
    runs = simulate([mass], [PASS_ON], np.full((1, 400), 20.0), substeps=40)

    def rate(_t, x):
        level = 5.0 + max(f_s - 5.0, 0.0) * np.exp(-((x[1] / 0.1) ** 2))
        return [x[1], (20.0 - 3.0 * x[1] - level * np.tanh(x[1] / 0.02) - 800.0 * x[0]) / 2.0]

    exact = solve_ivp(rate, (0.0, 0.399), [0.0, 0.0], t_eval=runs.time, rtol=1e-9, atol=1e-12, method="LSODA")
    assert 800.0 * exact.y[0] == pytest.approx(runs.force[0], abs=0.02)


def test_the_law_waits_for_its_delay():
    """Stuck under f_c: y_k = r_k + y_(k-1)/2 is a sum of halves, and the mass moves once it has waited."""
    law = {
        "sample_time_s": 1e-3, "delay_samples": 3, "reference": {"num": [1.0], "den": [1.0, -0.5]},
        "measurement": {"num": [0.0, 0.1], "den": [1.0, -0.5]},
    }  # fmt: skip
    runs = simulate([ACTUATOR, ACTUATOR], [law, law], np.repeat([[2.0], [2.8]], 30, axis=1))
    assert runs.effort[0, :4] == pytest.approx([2.0, 3.0, 3.5, 3.75])
    assert np.all(runs.force[0] == 0.0)  # 4 N stick
    assert np.flatnonzero(runs.force[1])[0] == 4 + 3  # 5.25 N is the fourth command: held from sample 6
