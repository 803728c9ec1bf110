"""Ripple identified from slow logs of a simulator of its own: amplitudes, harmonics, coverage, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

import seaopt as so
from seaopt.control import identify_ripple
from seaopt.logs import Log

TRUE = {6: (0.05, -0.02), 18: (0.0, 0.01)}
RATE_HZ = 200.0


def turn(seed, seconds=30.0, colour=0.0, turns=1.4, force=False):
    """Return a log of a motor that sweeps back and forth under friction, ripple and noise, at a speed that varies."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    rate = 2.0 * np.pi * 2.0 / seconds
    theta = 2.0 * np.pi * turns * np.sin(rate * t + 0.3)
    speed = 2.0 * np.pi * turns * rate * np.cos(rate * t + 0.3)
    ripple = sum(a * np.cos(n * theta) + b * np.sin(n * theta) for n, (a, b) in TRUE.items())
    noise = lfilter([np.sqrt(1.0 - colour**2)], [1.0, -colour], rng.normal(size=t.size))
    torque = 3.0 * np.sin(0.7 * t)
    command = 0.02 + 0.3 * np.tanh(speed / 0.01) + np.where(speed > 0, 0.04, 0.06) * speed + ripple + 0.02 * noise
    channels = {"I": command + (0.1 * torque if force else 0.0), "theta_m": theta + 1e-4 * rng.normal(size=t.size)}
    units = {"I": "A", "theta_m": "rad", "tau_s": "N m"}
    return Log.from_arrays(time=t, **channels, tau_s=torque, units=units, source="turn")


def deviations(fit):
    """Return how many std each coefficient is off."""
    rows = zip(fit.cycles, fit.cos, fit.cos_std, fit.sin, fit.sin_std, strict=True)
    return np.array(
        [((cos - TRUE[n][0]) / cos_std, (sin - TRUE[n][1]) / sin_std) for n, cos, cos_std, sin, sin_std in rows]
    )


@pytest.mark.parametrize(("colour", "force"), [(0.0, False), (0.9, True)])
def test_amplitudes_and_friction_are_recovered(colour, force):
    for seed in range(3):
        fit = identify_ripple(turn(seed, colour=colour, force=force), force="tau_s" if force else None, cycles=[6, 18])
        assert np.all(np.abs(deviations(fit)) < 3.5)
        assert fit.cos_std[0] < 0.004
        assert fit.coulomb == pytest.approx(0.3, abs=4.0 * fit.coulomb_std)
        assert fit.viscous == pytest.approx((0.04, 0.06), abs=0.02)
        assert fit.per_force == (pytest.approx(0.1, abs=2e-3) if force else None)


def test_harmonics_are_found():
    fit = identify_ripple(turn(4))
    assert fit.cycles == (6, 18)
    again = so.control.CompensateRipple(cycles=fit.cycles, cos=fit.cos, sin=fit.sin, period=2.0 * np.pi)
    assert fit.compensation() == again
    assert fit.amplitudes[0] == pytest.approx(np.hypot(0.05, 0.02), abs=2e-3)


def test_stds_are_those_of_least_squares_for_white_noise():
    fit = identify_ripple(turn(5), cycles=[6, 18])
    assert fit.cos_std[0] == pytest.approx(0.02 * np.sqrt(2.0 / fit.samples), rel=0.2)
    coloured = identify_ripple(turn(5, colour=0.9), cycles=[6, 18])
    assert coloured.cos_std[0] > 1.5 * fit.cos_std[0]


@pytest.mark.parametrize(
    ("log", "more", "named"),
    [
        (turn(1, turns=0.3), {}, "at least one whole revolution"),
        (turn(1).between(10.6, 17.9), {}, r"backwards over 0 %"),
        (turn(1), {"angle": "tau_s"}, "period"),
        (turn(1), {"cycles": [0]}, "whole number"),
        (turn(1), {"cycles": []}, "empty"),
        (turn(1), {"highest": 4}, "differs from chance"),
    ],
)
def test_what_a_log_cannot_tell_is_refused(log, more, named):
    with pytest.raises(so.SeaoptError, match=named):
        identify_ripple(log, **more)


@pytest.mark.slow
@pytest.mark.parametrize("colour", [0.0, 0.9])
def test_intervals_cover(colour):
    z = np.array([deviations(identify_ripple(turn(seed, colour=colour), cycles=[6, 18])) for seed in range(200)])
    assert 0.92 < np.mean(np.abs(z) < 1.96) < 0.98
