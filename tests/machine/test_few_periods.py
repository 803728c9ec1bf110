"""Intervals of sizes from few periods, on samples of the test's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

import seaopt as so
from seaopt.machine.differences.few_periods import find_most_noise, find_widening
from tests.machine.simulator import Machine, multisine
from tests.machine.test_pairs import RANGES
from tests.machine.test_response import LINES


def draw_error(rng, blocks, slopes):
    """Return the error of a size that is fitted to the means of some blocks, over the std that the fit tells."""
    noise = rng.normal(size=(2, blocks, slopes.size))
    rows = noise[0] + 1j * noise[1]
    mean = rows.mean(axis=0)
    std = np.sqrt(np.sum(np.abs(rows - mean) ** 2, axis=0) / (blocks * (blocks - 1)))
    column = slopes / (std / np.sqrt(2.0))
    size = np.linalg.lstsq(column[:, None], mean.real / (std / np.sqrt(2.0)), rcond=None)[0][0]
    left = np.sum(np.abs((mean - size * slopes) / std) ** 2) / slopes.size
    return size * np.linalg.norm(column) / np.sqrt(max(left, 1.0))


@pytest.mark.parametrize("blocks", [2, 3, 4, 9])
@pytest.mark.parametrize("spread", [0.0, 0.7])
def test_an_interval_holds_as_often_as_it_states(blocks, spread):
    rng = np.random.default_rng(5)
    slopes = np.exp(rng.normal(0.0, spread, 24))
    far = 1.96 * find_widening(blocks, slopes.size)
    held = np.mean([abs(draw_error(rng, blocks, slopes)) < far for _ in range(3000)])
    assert 0.938 < held < (0.965 if spread == 0.0 else 0.985), held  # 0.95, whose std is 0.004


@pytest.mark.parametrize("blocks", [3, 6, 18])
def test_a_right_model_leaves_more_than_most_noise_as_rarely_as_it_states(blocks):
    noise = np.random.default_rng(6).normal(size=(2, 4000, blocks, 24))
    rows = noise[0] + 1j * noise[1]
    mean = rows.mean(axis=1)
    square = np.sum(np.abs(rows - mean[:, None]) ** 2, axis=1) / (blocks * (blocks - 1))
    left = np.mean(np.abs(mean) ** 2 / square, axis=1)
    assert abs(np.mean(left > find_most_noise(blocks, 24)) - 0.05) < 0.012  # whose std is 0.0035


def test_of_many_periods_most_noise_is_a_chi_square():
    assert find_most_noise(400, 24) == pytest.approx(chi2.ppf(0.95, 48) / 48.0, abs=0.02)


def test_with_many_periods_an_interval_is_that_of_known_noise():
    assert find_widening(400, 24) == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
def test_three_periods_tell_a_soft_spring_to_within_its_interval(controller, bench):
    machine, reference = Machine(), multisine(1000, LINES, 3, 60.0, 3)
    soft, held = replace(machine, stiffness=0.8 * machine.stiffness), 0
    for seed in range(10):
        log = bench.log(soft, reference, noise=2.0, seed=seed)
        result = so.accept(controller, [log], uncertainty=so.plants.thor(), ranges=RANGES)
        first = result.differences.found[0]
        assert first.name == "k" and not first.beside and first.low is not None
        held += first.low <= 0.8 <= first.high
    assert held >= 8, held  # of 95 %, a chance of 1 in 90 for less
