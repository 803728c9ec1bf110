"""Logs of actuators that NumPy integrates by Runge-Kutta's classical steps, from equations written down here alone."""

from __future__ import annotations

import math

import numpy as np

KNEE = {
    "J_m": 2.4e-5, "b_r": 1.5e-4, "f_c": 0.004, "v_s": 1.0, "N": 100.0, "K_tau": 0.037, "k_s": 300.0, "J_l": 0.25,
    "d_l": 0.4, "mgL": 0.0,
}  # fmt: skip
SCREW = {"J": 3.31e-6, "b_r": 1.31e-4, "m_l": 0.646, "k": 655e3, "l": 0.002, "N_p": 3.0, "K_tau": 0.0255}


def drive(duration_s, rate_hz, amplitude, seed=0, top_hz=40.0):
    """Return times, and a current that holds each value: a chirp that slows, and noise below `top_hz`."""
    t = np.arange(round(duration_s * rate_hz)) / rate_hz
    low = 0.1
    sweep = 2 * math.pi * low * duration_s / math.log(top_hz / low) * ((top_hz / low) ** (t / duration_s) - 1.0)
    lines = np.fft.rfft(np.random.default_rng(seed).normal(size=t.size))
    lines[np.fft.rfftfreq(t.size, 1 / rate_hz) > top_hz] = 0.0
    noise = np.fft.irfft(lines, t.size)
    return t, amplitude * (np.sin(sweep) + 0.3 * noise / np.std(noise))


def integrate(rates, states, inputs, period, steps=2):
    """Return the states at the samples of an input that is held between them; plain floats, which are quicker here."""
    x, h, rows = [0.0] * states, period / steps, []

    def move(x, k, by):
        return [a + by * b for a, b in zip(x, k, strict=True)]

    for u in map(float, inputs):
        rows.append(x)
        for _ in range(steps):
            k1 = rates(x, u)
            k2 = rates(move(x, k1, 0.5 * h), u)
            k3 = rates(move(x, k2, 0.5 * h), u)
            k4 = rates(move(x, k3, h), u)
            x = [a + h / 6.0 * (p + 2 * q + 2 * r + s) for a, p, q, r, s in zip(x, k1, k2, k3, k4, strict=True)]
    return np.array(rows).T


def knee(inputs, rate_hz, *, locked=False, current=None, noise=1.0, seed=5, **values):
    """Return the channels of a rotary actuator; `current` makes the current of (u, theta_m, omega_m), if u is none."""
    p = KNEE | values
    make = current or (lambda u, angle, speed: u)

    def rates(x, u):
        motor, speed, link, turn = x
        torque = p["k_s"] * (motor / p["N"] - link)
        rub = p["b_r"] * speed + p["f_c"] * math.tanh(speed / p["v_s"])
        push = p["K_tau"] * make(u, motor, speed) - rub - torque / p["N"]
        swing = (torque - p["d_l"] * turn - p["mgL"] * math.sin(link)) / p["J_l"]
        return speed, push / p["J_m"], 0.0 if locked else turn, 0.0 if locked else swing

    motor, speed, link, _ = integrate(rates, 4, inputs, 1.0 / rate_hz)
    rng = np.random.default_rng(seed)

    def read(values, std):
        return values + noise * std * rng.normal(size=values.size)

    return {
        "I": np.array([make(u, a, s) for u, a, s in zip(inputs, motor, speed, strict=True)]),
        "tau_s": read(p["k_s"] * (motor / p["N"] - link), 0.02), "theta_m": read(motor, 2e-3),
        "theta_l": read(link, 2e-4), "omega_m": read(speed, 0.05),
    }  # fmt: skip


def screw(inputs, rate_hz, *, noise=1.0, seed=6, **values):
    """Return the channels of a ball screw on a stand: F1 at the spring, F2 at the nut, q the nut's place."""
    p = SCREW | values
    r = p["l"] / (2 * math.pi * p["N_p"])
    heavy, b, gain = p["J"] / r**2, p["b_r"] / r**2, p["K_tau"] / r

    def rates(x, u):
        q, v = x
        return v, (gain * u - b * v - p["k"] * q) / (heavy + p["m_l"])

    q, v = integrate(rates, 2, inputs, 1.0 / rate_hz)
    rise = (gain * np.asarray(inputs) - b * v - p["k"] * q) / (heavy + p["m_l"])
    rng = np.random.default_rng(seed)

    def read(values, std):
        return values + noise * std * rng.normal(size=values.size)

    force = p["k"] * q
    return {
        "I": np.asarray(inputs), "F1": read(force, 2.0), "F2": read(force + p["m_l"] * rise, 2.0), "q": read(q, 1e-7),
        "theta_m": read(q / r, 1e-3),
    }  # fmt: skip


def write_csv(path, columns, *, delimiter=",", decimal=".", digits=9):
    """Write columns by header."""
    rows = [delimiter.join(columns)]
    for row in zip(*columns.values(), strict=True):
        rows.append(delimiter.join(f"{value:.{digits}g}".replace(".", decimal) for value in row))
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path
