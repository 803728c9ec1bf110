"""The bootstrap against closed forms, and against the covariance that a fit takes from the residuals' colour."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.signal import lfilter

import seaopt as so
from seaopt.bench import PAPER_STAND
from seaopt.errors import EstimationError
from seaopt.estimation import bootstrap
from seaopt.estimation.uncertainty.bootstrap import estimate_block_length
from seaopt.executors import Processes
from tests.checks import leave_out_hypotheses

FREE = ("J", "b_r", "eta")
DRAWS = 400


def coloured(a, n, seed, columns=1):
    """Return AR(1) noise of unit variance."""
    white = np.random.default_rng(seed).normal(size=(n + 500, columns))
    return lfilter([np.sqrt(1 - a * a)], [1, -a], white, axis=0)[500:]


def stand_fit(stand, thor, a, **options):
    log = so.virtual_log(stand, thor, PAPER_STAND, duration_s=60, rate_hz=400, seed=3)
    noise = 5.0 * coloured(a, len(log), 1, 2)
    log = so.Log.from_arrays(time=log.time, I=log["I"], F1=log["F1"] + noise[:, 0], F2=log["F2"] + noise[:, 1])
    return so.fit(
        [so.Experiment(plant=stand, log=log, name="stand", outputs=("F1", "F2"))], thor.free(*FREE), **options
    )


@pytest.fixture(scope="module")
def noisy(stand, thor):
    with pytest.MonkeyPatch.context() as patch:
        leave_out_hypotheses(patch)
        return stand_fit(stand, thor, 0.9)


@pytest.mark.parametrize("a", [0.5, 0.8, 0.95])
def test_the_blocks_of_ar1_noise_are_the_known_optimum(a):
    """b = (6 N)^(1/3) (a / (1 - a^2))^(2/3) for AR(1) (Carlstein 1986; Politis and White 2004, sec. 3)."""
    n = 40_000
    known = (6 * n) ** (1 / 3) * (a / (1 - a * a)) ** (2 / 3)
    found = np.median([estimate_block_length(coloured(a, n, seed)) for seed in range(5)])
    assert found == pytest.approx(known, rel=0.25)


def test_white_residuals_need_no_blocks(stand, thor):
    fit = stand_fit(stand, thor, 0.0)
    found = bootstrap(fit, DRAWS)
    assert found.blocks["stand"] <= 3
    for name in FREE:
        assert found.std(name) == pytest.approx(fit.white_covariance.std(name), rel=4 / np.sqrt(2 * DRAWS))


def test_its_std_is_the_sandwichs_on_coloured_noise(noisy):
    """Within four standard errors of Monte Carlo and the 5 % that blocks of 1.3 % of the log leave out."""
    found = bootstrap(noisy, DRAWS)
    for name in FREE:
        assert noisy.covariance.std(name) > 2.5 * noisy.white_covariance.std(name)
        assert found.std(name) == pytest.approx(noisy.covariance.std(name), rel=4 / np.sqrt(2 * DRAWS) + 0.05)


def test_a_step_is_a_refit_where_noise_is_small(noisy):
    """The same seed draws the same blocks: each refit is the step to second order."""
    steps, refits = bootstrap(noisy, 40), bootstrap(noisy, 40, refit=True)
    for i, name in enumerate(FREE):
        away = np.abs(steps.draws[:, i] - refits.draws[:, i])
        assert np.max(away) < 0.02 * noisy.covariance.std(name)


@pytest.mark.parametrize(
    "make", [lambda: ThreadPoolExecutor(3), pytest.param(lambda: Processes(2), marks=pytest.mark.slow)]
)
def test_refits_are_the_same_bit_for_bit_wherever_they_are_made(stand, thor, short_log, make):
    fit = so.fit([so.Experiment(plant=stand, log=short_log, outputs=("F1", "F2"))], thor.free("J", "b_r"))
    here = bootstrap(fit, 20, refit=True)
    with make() as executor:
        there = bootstrap(fit, 20, refit=True, executor=executor)
    np.testing.assert_array_equal(there.draws, here.draws)


def test_percentiles_and_priors_are_the_gaussian_ones(stand, thor, short_log):
    """A prior far tighter than the log's own knowledge is what the draws show."""
    prior = thor.with_parameters(*(so.Parameter(name="eta", value=1.0, unit="-", free=True, prior_std=1e-6),))
    fit = so.fit(
        [so.Experiment(plant=stand, log=short_log, outputs=("F1",))], prior.free("J", "eta"), diagnostics=False
    )
    found = bootstrap(fit, DRAWS)
    assert found.std("eta") == pytest.approx(1e-6, rel=4 / np.sqrt(2 * DRAWS))
    low, high = found.interval("eta")
    assert high - low == pytest.approx(2 * 1.96e-6, rel=0.2)


def test_missing_samples_and_a_robust_loss_are_allowed_for(stand, thor, short_log):
    force = short_log["F1"].copy()
    force[1000:1400] = np.nan
    force[::50] += 200.0
    log = so.Log.from_arrays(time=short_log.time, I=short_log["I"], F1=force)
    fit = so.fit(
        [so.Experiment(plant=stand, log=log)], thor.free("J", "b_r"), loss=so.Huber(), holdout=0.1, diagnostics=False
    )
    found = bootstrap(fit, DRAWS)
    for name in ("J", "b_r"):
        assert found.std(name) == pytest.approx(fit.covariance.std(name), rel=4 / np.sqrt(2 * DRAWS) + 0.05)


def test_bad_arguments_say_what_to_do(noisy, stand, thor, short_log):
    with pytest.raises(EstimationError, match="draws = 5 are too few for a covariance; give 20 or more"):
        bootstrap(noisy, 5)
    with pytest.raises(EstimationError, match="block = 0 samples"):
        bootstrap(noisy, block=0)
    bench = so.Experiment(plant=stand, log=short_log, outputs=("F1",))
    with pytest.raises(EstimationError, match="enter only together"):
        bootstrap(so.fit([bench], thor.free("K_tau", "eta")))
    with pytest.raises(EstimationError, match="errors of prediction"):
        bootstrap(so.fit([bench], thor.free("J"), method=so.PredictionError()), refit=True)
