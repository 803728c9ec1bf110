"""What was commanded before a log begins is not in it: the samples that it still reaches have no weight. On responses
of scipy's fine lifted simulation of a mass on a spring, which was at rest without a current until the log began."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim

import seaopt as so

M, B, K, G, RATE, FINE, N, NOISE = 2.0, 300.0, 5e4, 50.0, 400.0, 10, 3000, 1e-5
DRIVE = so.Plant(
    name="drive", states={"q": "m", "v": "m/s"}, inputs={"I": "A"}, outputs={"q": "m"},
    parameters={"M": "kg", "b": "N s/m", "G": "N/A"},
    f=lambda t, x, u, p: {"q": x.v, "v": (p.G * u.I - p.b * x.v - K * x.q) / p.M},
    h=lambda t, x, u, p: {"q": x.q},
)  # fmt: skip
FREE = so.ParameterSet.of(M=(1.8, "kg"), b=(250.0, "N s/m"), G=(45.0, "N/A")).free("M", "b", "G")


def excite(first):
    """Return a current that begins with these samples."""
    current = 5.0 * np.random.default_rng(2).normal(size=N)
    current[: len(first)] = first
    return current


def bench_of(current, samples_late, *, most_s=0.02, **options):
    """Return a log whose current takes effect so many samples late, in tenths, and whose delay is free."""
    late = round(samples_late * FINE)
    u = np.concatenate([np.zeros(late), np.repeat(current, FINE)])[: N * FINE]
    a = np.array([[0.0, 1.0], [-K / M, -B / M]])
    system = cont2discrete((a, np.array([[0.0], [G / M]]), np.eye(2), np.zeros((2, 1))), 1.0 / (RATE * FINE))
    q = dlsim(system, u)[2][::FINE, 0] + NOISE * np.random.default_rng(1).normal(size=N)
    log = so.Log.from_arrays(time=np.arange(N) / RATE, I=current, q=q)
    delay = so.Parameter(name="delay_s", value=1e-3, unit="s", free=True, min=0.0, max=most_s)
    return so.Experiment(plant=DRIVE, log=log, delay_s=delay, name="log", **options)


@pytest.mark.parametrize("samples_late", [0.4, 1.4, 2.9])
def test_a_log_that_begins_in_motion_leaves_noise_alone(samples_late):
    """A first current that is taken to be held before leaves hundreds of times the noise in the first samples."""
    fit = so.fit([bench_of(excite([15.0, -10.0, 8.0]), samples_late)], FREE)
    figures = fit.outputs["log"]["q"]
    assert figures.excess == pytest.approx(1.0, abs=0.05) and figures.sigma == pytest.approx(NOISE, rel=0.05)
    assert fit.met and fit.nuisance["log"].delay_s * RATE == pytest.approx(samples_late, abs=1e-2)
    so.testing.assert_recovered(fit, so.ParameterSet.of(M=(M, "kg"), b=(B, "N s/m"), G=(G, "N/A")), sigmas=4)


@pytest.mark.parametrize(
    ("first", "options", "left_out"),
    [
        ([15.0, -10.0], {}, 8),  # 0.02 s
        ([15.0, -10.0], {"most_s": 0.0171}, 7),
        ([15.0, -10.0], {"most_s": 3.0}, N // 20),
        ([15.0, -10.0], {"most_s": np.inf}, 1),  # up to where the search begins
        ([15.0, -10.0], {"initial_state": "rest"}, 0),
        ([0.0, 15.0], {}, 0),  # nothing is commanded yet
        ([15.0] * (N // 20), {}, 0),  # rests
        ([15.0] * 5, {}, 8),  # is held for some rows
        ([15.0, -10.0], {"shots": 3}, 8),  # the first of them alone
    ],
)
def test_samples_are_left_out_where_an_earlier_current_is_still_in_force(first, options, left_out):
    fit = so.fit([bench_of(excite(first), 0.0, **options)], FREE, diagnostics=False)
    assert fit.samples == N - left_out


@pytest.mark.parametrize(("options", "held"), [({"shots": 3}, 1), ({}, 5)])
def test_noise_alone_is_left_of_a_log_in_shots_and_of_a_command_that_is_held_for_some_rows(options, held):
    """The first samples left 1.7 times the noise of both."""
    current = np.repeat(excite([15.0, -10.0, 8.0]), held)[:N]
    fit = so.fit([bench_of(current, 1.4, **options)], FREE)
    assert fit.outputs["log"]["q"].excess == pytest.approx(1.0, abs=0.05) and fit.met
    so.testing.assert_recovered(fit, so.ParameterSet.of(M=(M, "kg"), b=(B, "N s/m"), G=(G, "N/A")), sigmas=4)


def test_the_latest_delay_is_taken_in_its_unit():
    delay = so.Parameter(name="delay_s", value=1.0, unit="ms", free=True, min=0.0, max=20.0)
    data = replace(bench_of(excite([15.0, -10.0]), 0.0), delay_s=delay)
    assert so.fit([data], FREE, diagnostics=False).samples == N - 8
