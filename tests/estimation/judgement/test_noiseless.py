"""A channel without noise: what is said of stds that follow from rounding."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so

PLANT, THOR = so.plants.high_impedance(), so.plants.thor()


@pytest.mark.parametrize(("noise_std", "sigma", "told"), [(0.0, {}, True), (0.0, {"F1": 2.0}, False), (0.5, {}, False)])
def test_a_residual_of_rounding_is_noted(noise_std, sigma, told):
    """The fit is met all the same: nothing is wrong with the model."""
    rng = np.random.default_rng(1)
    time = np.arange(1200) / 400.0
    current = np.convolve(rng.normal(0.0, 2.0, time.size), np.ones(4) / 4.0, "same")
    run = so.simulate(PLANT, THOR, so.Log.from_arrays(time=time, I=current))
    force = run["F1"] + rng.normal(0.0, 1.0, time.size) * noise_std
    experiment = so.Experiment(
        plant=PLANT, log=so.Log.from_arrays(time=time, I=current, F1=force), sigma=sigma, name="run"
    )
    fit = so.fit([experiment], THOR.update(J=2e-6).free("J"))
    assert fit.met
    assert [one.where for one in fit.findings if one.kind == "noise"] == (["run.F1"] if told else [])
