"""The second-order form against known systems: scipy's and python-control's responses, and the paper's (16)."""

from __future__ import annotations

import control
import numpy as np
import pytest
from scipy.signal import cont2discrete, freqz, lfilter

import seaopt as so
from seaopt.errors import LogError
from seaopt.frequency import second_order
from seaopt.frequency.sampled import sampled_response
from seaopt.simulation import Clock, make_model

RATE = 400.0
PRINTED = (2166.0, 39.53, 2279.0)  # (16)


def record(form, n, rng, noise=0.0):
    """Return noise and what a system K/(s^2 + a s + b) makes of it behind a zero-order hold, by scipy."""
    gain, a, b = form
    num, den, _ = cont2discrete(([gain], [1.0, a, b]), 1 / RATE, method="zoh")
    u = rng.normal(size=n)
    y = lfilter(num.ravel(), den, u)
    return u, y + noise * rng.normal(size=n)


def scatter(found, form):
    return (found.values[:3] - np.array(form)) / np.sqrt(np.diag(found.covariance)[:3])


def test_the_papers_16_is_found_again_without_a_guess():
    u, y = record(PRINTED, 65_600, np.random.default_rng(16), noise=0.05)
    found = second_order(so.h1(u, y, 1 / RATE), Clock(period=1 / RATE))
    np.testing.assert_allclose(found.values[:3], PRINTED, rtol=0.003)
    assert np.all(np.abs(scatter(found, PRINTED)) < 3.0)
    assert found.static_gain.value == pytest.approx(0.950, abs=2e-3)
    # Table I and Sec. III-A: k/m_k is the mean of K and b.
    drive = found.drive(655_000.0, 1.0)
    assert drive.m_k_averaged.value == pytest.approx(294.9, rel=0.004)
    assert drive.b_m_averaged.value == pytest.approx(11660.0, rel=0.004)


@pytest.mark.parametrize("form", [PRINTED, (5.0, 3.0, 900.0), (-2e4, 60.0, 4e4), (700.0, 200.0, 700.0)])
def test_other_systems_are_found_too(form):
    u, y = record(form, 65_600, np.random.default_rng(1))
    found = second_order(so.h1(u, y + 0.02 * y.std(), 1 / RATE), Clock(period=1 / RATE))
    np.testing.assert_allclose(found.values[:3], form, rtol=0.02)


@pytest.mark.slow
def test_the_stated_std_is_the_scatter_where_noise_rules():
    rng = np.random.default_rng(2)
    z = []
    for _ in range(60):
        u, y = record(PRINTED, 16_000, rng, noise=0.3)
        z.append(scatter(second_order(so.h1(u, y, 1 / RATE), Clock(period=1 / RATE)), PRINTED))
    assert np.all(np.abs(np.mean(z, axis=0)) < 0.5)
    assert np.all((np.std(z, axis=0) > 0.6) & (np.std(z, axis=0) < 1.3))


def test_a_delay_is_estimated_where_it_is_free():
    u, y = record(PRINTED, 65_600, np.random.default_rng(3), noise=0.02)
    late = np.concatenate([np.zeros(3), y[:-3]])
    found = second_order(so.h1(u, late, 1 / RATE), Clock(period=1 / RATE, delay_free=True))
    assert found.delay_s.value == pytest.approx(3 / RATE, abs=4 * found.delay_s.std)
    np.testing.assert_allclose(found.values[:3], PRINTED, rtol=0.005)
    known = second_order(so.h1(u, late, 1 / RATE), Clock(period=1 / RATE, delay_s=3 / RATE))
    assert known.delay_s.std == 0.0
    np.testing.assert_allclose(known.values[:3], PRINTED, rtol=0.005)


def test_the_form_sampled_is_scipys():
    gain, a, b = PRINTED
    num, den, _ = cont2discrete(([gain], [1.0, a, b]), 1 / RATE, method="zoh")
    u, y = record(PRINTED, 20_000, np.random.default_rng(4))
    found = second_order(so.h1(u, y, 1 / RATE), Clock(period=1 / RATE))
    f = np.array([0.5, 5.0, 50.0, 150.0])
    _, response = freqz(num.ravel(), den, worN=2 * np.pi * f / RATE)
    np.testing.assert_allclose(found.response(f), response, rtol=0.02)


def test_sampled_plants_respond_as_python_controls(stand, swing, thor):
    f = np.array([0.3, 2.0, 7.5, 17.0, 90.0])
    for plant in (stand, swing):
        sampled = control.sample_system(plant.linearize(thor), 1 / RATE, method="zoh")
        model = make_model(plant, thor)
        response, _ = sampled_response(model, np.zeros(0), Clock(period=1 / RATE), f)
        for row in range(len(plant.outputs)):
            reference = sampled[row, 0](np.exp(2j * np.pi * f / RATE))
            np.testing.assert_allclose(response[:, row], np.squeeze(reference), rtol=1e-6)


@pytest.mark.parametrize("hold", ["zero", "first"])
@pytest.mark.parametrize("output", ["F1", "F2"])
def test_derivatives_are_those_of_finite_differences(stand, thor, hold, output):
    model = make_model(stand, thor, ("J", "b_r"), (output,))
    theta, f, delay = np.array([thor["J"].value, thor["b_r"].value]), np.array([1.0, 8.0, 120.0]), 0.0031

    def at(values, delay):
        return sampled_response(model, values, Clock(period=1 / RATE, hold=hold, delay_s=delay, delay_free=True), f)

    slopes = at(theta, delay)[1]
    assert slopes.shape == (3, f.size, 1)
    for i, value in enumerate(theta):
        step = np.eye(2)[i] * 1e-5 * value
        numeric = (at(theta + step, delay)[0] - at(theta - step, delay)[0]) / (2e-5 * value)
        np.testing.assert_allclose(slopes[i], numeric, rtol=1e-6)
    numeric = (at(theta, delay + 1e-7)[0] - at(theta, delay - 1e-7)[0]) / 2e-7
    np.testing.assert_allclose(slopes[2], numeric, rtol=1e-5)


def test_the_windows_spread_is_the_estimates_bias():
    """With white input and short stretches H1 misses the peak; spread over three lines, scipy's response meets it."""
    form = (1.0, 20.0, (2 * np.pi * 12) ** 2)
    gain, a, b = form
    num, den, _ = cont2discrete(([gain], [1.0, a, b]), 1 / RATE, method="zoh")
    u, y = record(form, 400_000, np.random.default_rng(5))
    estimate = so.h1(u, y, 1 / RATE, stretch_s=1.0)

    def known(f):
        return freqz(num.ravel(), den, worN=2 * np.pi * f / RATE)[1]

    near = (estimate.frequency_hz > 10) & (estimate.frequency_hz < 14)
    bare, spread = (np.abs(h[near] / estimate.response[near] - 1) for h in (known(estimate.frequency_hz),
                                                                          estimate.expected(known)))  # fmt: skip
    assert np.max(bare) > 0.1
    assert np.max(spread) < 3 * np.max(estimate.relative_std[near])


def test_incoherent_estimates_are_refused():
    rng = np.random.default_rng(6)
    with pytest.raises(LogError, match="excite more, or use a longer log"):
        second_order(so.h1(rng.normal(size=4000), rng.normal(size=4000), 1 / RATE), Clock(period=1 / RATE))
