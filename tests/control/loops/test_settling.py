"""What a step leaves, against python-control's simulation of the same loop; and what a tuned law says of it."""

from __future__ import annotations

import control
import numpy as np
import pytest

import seaopt as so
from seaopt.control import assess, parallel_pid


@pytest.fixture(scope="module")
def stand():
    return so.plants.high_impedance(), so.plants.thor()


@pytest.fixture(scope="module")
def tuned(stand):
    return so.tune(*stand, so.ControllerSpec(measured="F1", bandwidth_hz=30, max_noise_gain=25))


def test_what_is_left_is_that_of_the_simulated_step(stand, tuned):
    loop = tuned.close(*stand)
    samples = 200
    model = loop.to_control()
    reference = np.vstack([np.zeros(samples + 1), np.ones(samples + 1)])
    step = control.forced_response(model, T=np.arange(samples + 1) * tuned.sample_time_s, U=reference).outputs[0]
    end = float(np.real(loop.tracking(np.array([1e-9]))[0]))
    for k in (0, 5, 40, samples):
        assert loop.measure_step_left(k * tuned.sample_time_s) == pytest.approx(end - step[k], abs=1e-6)


def test_a_law_whose_integral_takes_seconds_says_so(stand, tuned):
    """The tuner leaves an integral no more than it brings in time: this one is of a law of one's own."""
    law = parallel_pid(k_p=3.0, k_i=1.0, k_d=0.06, T_f=2.5e-3, b=1.0, feedforward=0.6, sample_time_s=1e-3)
    slow = assess(law, *stand, tuned.spec)
    left = abs(slow.close(*stand).measure_step_left(20.0 / slow.achieved.bandwidth_hz))
    assert left > 0.05
    assert any(f"of the reference is still {100 * left:.2g} % off" in note for note in slow.notes)
    assert not any("of the reference" in note for note in tuned.notes)
