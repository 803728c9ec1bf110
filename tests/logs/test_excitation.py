"""What a quality report says of excitation is true of logs of which more is known than the report can see."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

import seaopt as so
from seaopt.logs import assess_quality

J, B, MGL = 0.19, 0.1, 3.3


def swing_up(seconds=6.0, rate_hz=500.0):
    """Return times, torque, angle, speed and acceleration of a pendulum that is pumped up, by Runge-Kutta's steps."""
    h, x, rows = 1.0 / rate_hz, np.array([0.02, 0.0]), []

    def push(x):
        return 1.5 * np.tanh(3.0 * x[1]) * np.exp(-0.3 * abs(x[0]))

    def rate(x, u):
        return np.array([x[1], (u - B * x[1] - MGL * np.sin(x[0])) / J])

    for k in range(round(seconds * rate_hz)):
        u = push(x)
        rows.append((k * h, u, x[0], x[1], rate(x, u)[1]))
        k1 = rate(x, u)
        k2 = rate(x + 0.5 * h * k1, u)
        k3 = rate(x + 0.5 * h * k2, u)
        k4 = rate(x + h * k3, u)
        x = x + h / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
    return np.array(rows).T


def test_of_a_log_that_tells_the_inertia_nothing_else_is_said():
    """A slow, large swing: nothing is coherent above the first line, and least squares find J within 2 %."""
    t, u, angle, speed, rise = swing_up()
    rng = np.random.default_rng(0)
    inertia = np.linalg.lstsq(np.stack([rise, speed, np.sin(angle)], 1), u + 0.05 * rng.normal(size=u.size), rcond=None)
    assert inertia[0][0] == pytest.approx(J, rel=0.02)
    log = so.Log.from_arrays(time=t, torque=u + 0.05 * rng.normal(size=t.size), theta=np.round(angle / 3e-3) * 3e-3)
    (finding,) = assess_quality(log, inputs=["torque"]).of("excitation")
    assert "cannot" not in finding.sentence and "no parameter" not in finding.sentence
    assert "slower motion" in finding.sentence and "a fit may" in finding.sentence


def test_a_response_without_a_peak_is_not_said_to_hide_the_inertia():
    """A stiff spring's force up to a third of its resonance: 1/(1 - r^2) rises by 12 %, which tells k/m to 1 %."""
    rng = np.random.default_rng(1)
    rate, n, f0 = 1000.0, 40_000, 60.0
    lines = np.fft.rfft(rng.normal(size=n))
    f = np.fft.rfftfreq(n, 1 / rate)
    lines[(f > 20.0) | (f < 0.5)] = 0.0
    response = 1.0 / (1.0 - (f / f0) ** 2 + 0.1j * f / f0)
    u, y = np.fft.irfft(lines, n), np.fft.irfft(lines * response, n)
    log = so.Log.from_arrays(time=np.arange(n) / rate, I=u, F1=y + 1e-4 * rng.normal(size=n))
    (finding,) = log.quality.of("excitation")
    assert "cannot" not in finding.sentence and "falls to half" in finding.sentence


def test_of_one_sine_it_is_not_said_that_inertia_hardly_matters():
    """A spring's torque and its motor's angle under 1 Hz, resonance 5.4 Hz: least squares find J to 1 %."""
    t = np.arange(4000) / 500.0
    rng, w = np.random.default_rng(2), 2.0 * np.pi
    inertia, damping, stiffness = 2.4e-5, 1e-4, 0.03
    u = 0.2 * np.sin(w * t)
    response = 1.0 / (stiffness - inertia * w**2 + 1j * damping * w)
    theta, speed, rise = (0.2 * np.imag(response * (1j * w) ** n * np.exp(1j * w * t)) for n in range(3))
    torque = stiffness * theta + 1e-4 * rng.normal(size=t.size)
    known = np.linalg.lstsq(np.stack([rise, speed], 1), u - torque, rcond=None)[0]
    assert known[0] == pytest.approx(inertia, rel=0.01)
    log = so.Log.from_arrays(time=t, I=u, tau_s=torque, theta_m=theta + 1e-4 * rng.normal(size=t.size))
    (finding,) = assess_quality(log, inputs=["I"]).of("excitation")
    assert "little effect" not in finding.sentence and "only a fit tells" in finding.sentence


def answer_of_a_mode(kind, seconds, damping, natural_hz, rate=1000.0):
    """Return a log of a drive from 0.2 to 40 Hz through a mode, by its exact discretisation, with noise and 3 gaps."""
    rng, n = np.random.default_rng(0), round(seconds * rate)
    t, omega = np.arange(n) / rate, 2.0 * np.pi * natural_hz
    if kind == "noise":
        u = rng.normal(size=n)
    elif kind == "multisine":
        lines, base = np.arange(1, 160), np.arange(4000) / rate
        wave = np.cos(2.0 * np.pi * np.outer(lines, base) / 4.0 + rng.uniform(0.0, 2.0 * np.pi, (lines.size, 1)))
        u = np.resize(np.sum(wave, axis=0), n)
    else:
        u = scipy.signal.chirp(t, 0.2, seconds, 40.0, kind, phi=-90)
    top, below, _ = scipy.signal.cont2discrete(([omega**2], [1.0, 2.0 * damping * omega, omega**2]), 1.0 / rate)
    y = scipy.signal.lfilter(top.ravel(), below, u)
    y += 0.02 * np.std(y) * rng.normal(size=n)
    kept = np.delete(np.arange(n), rng.choice(n, 3, replace=False))
    return so.Log.from_arrays(time=t[kept], I=u[kept], F1=y[kept])


@pytest.mark.parametrize("damping", [0.03, 0.1, 0.2])
@pytest.mark.parametrize("natural_hz", [8.5, 20.0])
@pytest.mark.parametrize(
    ("kind", "seconds"),
    [
        *(("logarithmic", seconds) for seconds in (12.0, 30.0, 60.0)),
        *(("linear", 30.0), ("noise", 60.0), ("multisine", 30.0)),
    ],
)
def test_the_peak_of_a_mode_is_where_its_closed_form_has_it(kind, seconds, damping, natural_hz):
    """To 3 %: 6.8 Hz was said of 8.49 Hz under a chirp of 30 s, and of others up to 26 % off."""
    found = answer_of_a_mode(kind, seconds, damping, natural_hz).quality.excitation["I"].peak_hz
    assert found == pytest.approx(natural_hz * np.sqrt(1.0 - 2.0 * damping**2), rel=0.03)
