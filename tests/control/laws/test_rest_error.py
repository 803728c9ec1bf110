"""How far friction may hold a law without an integral from its reference, by the tests' own stick-slip simulator."""

from __future__ import annotations

import numpy as np

import seaopt as so
from tests.stick_slip import Mass, simulate


def test_no_reference_ends_further_off_than_the_note_says(stand):
    """Steps of many sizes, held until all is at rest: the worst comes within a tenth of the bound, none passes it."""
    rubbing = so.plants.thor().update(f_c=25.0, v_s=1e-4)
    spec = so.ControllerSpec(structure="pd", bandwidth_hz=20, max_sensitivity=1.6, max_noise_gain=25)
    controller = so.tune(stand, rubbing, spec)
    assert controller.rest_error > 0.0
    assert any(f"friction may hold it {controller.rest_error:.3g} N" in note for note in controller.notes)
    mass = Mass.of({name: rubbing[name].value for name in rubbing}, jump=True)
    ends = np.linspace(2.0, 120.0, 60)  # ramps: what arrives slowly stops short
    reference = ends[:, None] * np.minimum(np.arange(3000) / 2000.0, 1.0)
    runs = simulate([mass] * ends.size, [controller.to_dict()] * ends.size, reference, substeps=10)
    assert np.max(np.ptp(runs.force[:, -200:], axis=1)) < 1e-3
    errors = np.abs(runs.force[:, -1] - ends)
    assert 0.9 * controller.rest_error < np.max(errors) < 1.001 * controller.rest_error


def test_an_integral_leaves_nothing(stand):
    rubbing = so.plants.thor().update(f_c=25.0)
    controller = so.tune(stand, rubbing, so.ControllerSpec(bandwidth_hz=20, max_noise_gain=25))
    assert controller.rest_error == 0.0 and not any("without an integral" in note for note in controller.notes)
