"""The note on bandwidth at amplitudes of use, against sines of the tests' own stick-slip simulator."""

from __future__ import annotations

import re

import numpy as np
import pytest

import seaopt as so
from tests.stick_slip import Mass, simulate


@pytest.mark.slow
def test_the_bandwidths_at_amplitudes_of_use_are_those_of_simulated_sines(stand):
    """Between the lowest and the highest named, the gain falls through -3 dB; at the sliding bandwidth none has it."""
    rubbing = so.plants.thor().update(
        k=120e3, m_l=0.9, l=0.005, N_p=1.0, K_tau=0.075, J=1.2e-5, b_r=2.5e-4, eta=0.86, f_c=25.0, v_s=0.004
    )
    spec = so.ControllerSpec(
        bandwidth_hz=15, compute_delay_samples=2, max_sensitivity=1.6, max_noise_gain=25, current_limit_A=10.0
    )
    controller = so.tune(stand, rubbing, spec)
    note = next(
        note
        for note in so.certify(controller, {"stand": stand}, rubbing, simulations=False).notes
        if "sliding; " in note
    )
    sliding, low, high, *shares = (float(text) for text in re.findall(r"\d+\.?\d*", note))
    assert (sliding, shares) == (15.0, [2.0, 50.0])
    assert low < high < sliding
    frequencies = np.array([0.8 * low, 1.15 * high, sliding])
    amplitudes = controller.force_limit(1e-3) * np.array([0.02, 0.1, 0.5])
    f, a = (grid.ravel() for grid in np.meshgrid(frequencies, amplitudes))
    n, last = 2200, 1000  # samples of 1 ms; the last second is measured
    reference = a[:, None] * np.sin(2e-3 * np.pi * f[:, None] * np.arange(n))
    mass = Mass.of({name: rubbing[name].value for name in rubbing})
    runs = simulate([mass] * f.size, [controller.to_dict()] * f.size, reference, substeps=20)
    phase = np.exp(-2e-3j * np.pi * f[:, None] * np.arange(n))[:, -last:] * np.hanning(last)
    ratio = [np.abs(np.sum(signal[:, -last:] * phase, axis=1)) for signal in (runs.force, reference)]
    below, above, at_sliding = (ratio[0] / ratio[1]).reshape(3, 3).T
    assert np.all(below > np.sqrt(0.5))
    assert np.all(above < np.sqrt(0.5))
    assert np.all(at_sliding < np.sqrt(0.5))
