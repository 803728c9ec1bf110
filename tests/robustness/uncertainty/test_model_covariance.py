"""Draws of a certificate are of noise and model together, delays included."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control.laws.delay import Drive
from seaopt.control.loops.sampled_plant import DRIVE_DELAY
from seaopt.errors import ControlError
from seaopt.estimation.result.covariance import Covariance
from seaopt.estimation.result.widening import widen
from seaopt.robustness.uncertainty.draws import combine_uncertainty
from seaopt.testing import virtual_experiment


def spread(shift):
    """Return the covariance of J and b_r that move together, and of a delay that moves alone."""
    matrix = np.zeros((3, 3))
    matrix[:2, :2], matrix[2, 2] = np.outer(shift[:2], shift[:2]), shift[2] ** 2
    return matrix


@pytest.fixture(scope="module")
def fitted():
    """A fit with a free delay, and 2 % of J and b_r together, 10 % of the delay, added as the model's."""
    stand, thor = so.plants.high_impedance(), so.plants.thor()
    delay = so.Parameter(name="delay", value=1e-3, unit="s", min=0.0, max=1e-2, free=True)
    bench = replace(virtual_experiment(stand, thor), delay_s=delay)
    fit = so.fit([bench], thor.free("J", "b_r"))
    (name,) = (name for name in fit.delay_covariance.names if name.endswith("delay_s"))
    shift = np.array([0.02 * fit.parameters["J"].value, 0.02 * fit.parameters["b_r"].value, 1e-4])
    return stand, fit, widen(fit, spread(shift)), shift, name.split(".")[0]


def test_draws_scatter_as_noise_and_model_together(fitted):
    stand, fit, wide, shift, experiment = fitted
    drive = Drive(delay_s=fit.delay_s(stand), fitted_in=experiment)
    uncertain = combine_uncertainty(wide, so.ParameterSet(), {}, {"stand": stand}, drive)
    assert uncertain.names == ("J", "b_r", DRIVE_DELAY)
    expected = fit.total_delay_covariance.matrix + spread(shift)
    assert uncertain.covariance == pytest.approx(expected, rel=1e-9)
    values = uncertain.values(uncertain.draw(4000, np.random.default_rng(1)))
    assert np.std(values["J"]) == pytest.approx(np.hypot(shift[0], fit.parameters["J"].total_std), rel=0.05)
    assert np.corrcoef(values["J"], values["b_r"])[0, 1] > 0.95  # the matrix is kept, not its diagonal


def test_the_covariance_of_the_fit_stays_that_of_the_noise(fitted):
    _, fit, wide, shift, experiment = fitted
    assert np.array_equal(wide.covariance.matrix, fit.covariance.matrix)
    assert wide.parameters["J"].std == fit.parameters["J"].std
    assert wide.parameters["J"].model_std == pytest.approx(np.hypot(shift[0], fit.parameters["J"].model_std))
    assert wide.nuisance[experiment].fitted["delay_s"].model_std >= 1e-4
    r, m_k = wide.derived["r"], wide.derived["m_k"]
    assert r.model_std == 0.0 and m_k.model_std > 0.015 * m_k.value  # m_k grows with J


def test_what_the_fit_leaves_open_of_no_certified_plant_does_not_stand_in_the_way(fitted):
    """Of friction that differs by direction, which the plant of the experiments alone has."""
    stand, fit, *_ = fitted
    directed = so.plants.high_impedance(parts=("friction_direction",))
    names, n = fit.covariance.names, len(fit.covariance.names)
    matrix = np.full((n + 1, n + 1), np.inf)
    matrix[:n, :n] = fit.covariance.matrix
    vague = replace(
        fit,
        status="not_identifiable",
        parameters=fit.parameters.with_parameters(replace(directed.defaults["f_a"], free=True, identified=False)),
        covariance=Covariance(names=(*names, "f_a"), matrix=matrix),
        delay_covariance=None,
        model_covariance=None,
    )
    uncertain = combine_uncertainty(vague, so.ParameterSet(), {}, {"stand": stand})
    assert uncertain.names == names and np.array_equal(uncertain.covariance, fit.covariance.matrix)
    with pytest.raises(ControlError, match="f_a is not identifiable"):
        combine_uncertainty(vague, so.ParameterSet(), {}, {"stand": stand, "directed": directed})
    ranged = combine_uncertainty(vague, so.ParameterSet(), {"f_a": (0.0, 1.0)}, {"stand": stand, "directed": directed})
    assert ranged.names == names and set(ranged.ranges) == {"f_a"}
