"""Plants of many states, whose passes need more stack than a thread has; in a thread that has little of it."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.simulation import Clock, Point, Segment, Weights, make_model, run_passes

PERIOD, SAMPLES, STEPS = 2e-3, 12, 3
K, D, M = 1e4, 5.0, 1.0
SMALL_STACK = 256 * 1024  # bytes; a thread has 8 MB as a rule


def make_chain(masses, cubic):
    """Return a row of masses with springs between them, the first at a wall, the last one pushed."""

    def rate(t, x, u, p):
        q, v = ([getattr(x, f"{kind}{i}") for i in range(masses)] for kind in "qv")
        stretch, speed = ([a - b for a, b in zip(z, [0.0, *z[:-1]], strict=True)] for z in (q, v))
        force = [p.k * (s + cubic * s**3) + D * r for s, r in zip(stretch, speed, strict=True)] + [u.F]
        return {f"q{i}": v[i] for i in range(masses)} | {f"v{i}": (force[i + 1] - force[i]) / M for i in range(masses)}

    units = {f"{kind}{i}": unit for kind, unit in (("q", "m"), ("v", "m/s")) for i in range(masses)}
    return so.Plant(
        name="chain", states=units, inputs={"F": "N"}, outputs={"end": "m"}, parameters={"k": "N/m"},
        f=rate, h=lambda t, x, u, p: {"end": getattr(x, f"q{masses - 1}")},
    )  # fmt: skip


def simulate_chain(masses, cubic, k, x0, drive):
    """Return the last mass's place: exactly where springs are linear, else by Runge-Kutta's fourth order."""
    eye = np.eye(masses)
    spread = eye - np.eye(masses, k=-1)  # places to stretches
    x, out = x0.astype(complex), []

    def rate(x, u):
        stretch, speed = spread @ x[:masses], spread @ x[masses:]
        force = k * (stretch + cubic * stretch**3) + D * speed
        return np.concatenate([x[masses:], (np.append(force[1:], u) - force) / M])

    zero = np.zeros(2 * masses)
    a = np.column_stack([rate(one, 0.0) for one in np.eye(2 * masses)]) if not cubic else np.eye(2 * masses)
    both = np.block([[a, rate(zero, 1.0)[:, None]], [np.zeros((1, 2 * masses + 1))]])
    exact = expm(both * PERIOD) if not cubic else both
    h = PERIOD / STEPS
    for u in drive:
        out.append(x[masses - 1])
        if not cubic:
            x = exact[:-1, :-1] @ x + exact[:-1, -1] * u
            continue
        for _ in range(STEPS):
            k1 = rate(x, u)
            k2 = rate(x + h / 2 * k1, u)
            k3 = rate(x + h / 2 * k2, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3, u))
    return np.array(out)


def run_in_small_thread(work):
    """Return what a call makes in a thread with a small stack."""
    results, before = [], threading.stack_size(SMALL_STACK)
    try:
        thread = threading.Thread(target=lambda: results.append(work()))
        thread.start()
    finally:
        threading.stack_size(before)
    thread.join()
    return results[0]


SIZES = [(40, 0.0)]
SIZES += [pytest.param(states, cubic, marks=pytest.mark.slow) for states in (100, 300) for cubic in (0.0, 1e4)]


@pytest.mark.parametrize(("states", "cubic"), SIZES)
def test_many_states_fit_on_any_stack(states, cubic):
    """Simulation and sensitivities, against complex steps of the test's own simulation; 100 ended in SIGSEGV."""
    masses, rng = states // 2, np.random.default_rng(3)
    plant, x0 = make_chain(masses, cubic), 1e-3 * rng.normal(size=states)
    drive, measured = rng.normal(size=(2, SAMPLES))
    model = make_model(plant, so.ParameterSet.of(k=(K, "N/m")), ("k",))
    segment = Segment(u=(drive,), y=(measured,))
    point = Point(
        theta=np.array([K]), offset=np.zeros(1), gain=np.ones(1), clock=Clock(period=PERIOD), substeps=STEPS
    )  # fmt: skip
    found = run_in_small_thread(
        lambda: run_passes(model, segment, point, x0, Weights.plain(1), outputs=True, columns=True)
    )
    step = 1e-30
    by_k = simulate_chain(masses, cubic, K + 1j * K * step, x0, drive)
    np.testing.assert_allclose(found.outputs[:, 0], by_k.real, rtol=1e-9)
    columns = found.columns[:, 0]
    np.testing.assert_allclose(columns[:, 0], by_k.real - measured, rtol=1e-9)
    sensitivity = by_k.imag / (K * step)
    np.testing.assert_allclose(columns[:, 1], sensitivity, atol=1e-9 * np.max(np.abs(sensitivity)))
    for i in (masses - 2, masses - 1, 2 * masses - 1):
        moved = simulate_chain(masses, cubic, K, x0 + 1j * step * np.eye(1, states, i).ravel(), drive).imag / step
        np.testing.assert_allclose(columns[:, 2 + i], moved, atol=1e-9 * np.max(np.abs(moved)))


@pytest.mark.slow
def test_simulations_alone_of_many_states():
    for states in (100, 500):
        masses = states // 2
        run = run_in_small_thread(
            lambda masses=masses: so.simulate(
                make_chain(masses, 0.0), so.ParameterSet.of(k=(K, "N/m")),
                so.Log.from_arrays(time=PERIOD * np.arange(SAMPLES), F=np.ones(SAMPLES)),
            )
        )  # fmt: skip
        expected = simulate_chain(masses, 0.0, K, np.zeros(states), np.ones(SAMPLES)).real
        np.testing.assert_allclose(run["end"], expected, rtol=1e-8, atol=1e-15)
