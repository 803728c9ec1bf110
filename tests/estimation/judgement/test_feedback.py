"""Residuals of logs that were taken under a law, whose inputs carry the outputs' noise; the loop is the test's own."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from scipy import signal, stats

import seaopt as so
from seaopt.estimation.judgement.coherence import measure_coherence

T = 1e-3
MASS, DAMPING, STIFFNESS = 250.0, 3000.0, 6.5e5
PLANT = so.Plant(
    name="stand", states={"x": "m", "v": "m/s"}, inputs={"u": "N"}, outputs={"F": "N"},
    parameters={"m": "kg", "b": "N s/m", "k": "N/m"},
    f=lambda t, x, u, p: {"x": x.v, "v": (u.u - p.b * x.v - p.k * x.x) / p.m}, h=lambda t, x, u, p: {"F": p.k * x.x},
)  # fmt: skip


def run(seed, *, n=8000, noise=20.0, lag=0.0, mode_hz=0.0):
    """Return a log of a loop with a gain of 2, an integral and a derivative, a sample late; `lag`: of the noise's own
    past; `mode_hz`: of a tenth of the mass on a spring at the nut.
    """
    rng = np.random.default_rng(seed)
    a = np.zeros((5, 5))
    a[0, 1] = a[2, 3] = 1.0
    a[1, [0, 1, 4]] = np.array([-STIFFNESS, -DAMPING, 1.0]) / MASS
    if mode_hz:
        small, w = 0.1 * MASS, 2.0 * np.pi * mode_hz
        link, damper = small * w**2, 0.04 * small * w
        a[1] += np.array([-link, -damper, link, damper, 0.0]) / MASS
        a[3, :4] = np.array([link, damper, -link, -damper]) / small
    moved = scipy.linalg.expm(a * T)
    reference = 100.0 * signal.lfilter([0.1], [1.0, -0.9], rng.normal(size=n))
    errors = signal.lfilter([noise], [1.0, -lag], rng.normal(size=n))
    x, integral, waiting, before, rows = np.zeros(5), 0.0, 0.0, 0.0, np.empty((n, 2))
    for k in range(n):
        force = STIFFNESS * x[0] + errors[k]
        x[4] = waiting
        rows[k] = waiting, force
        integral += 20.0 * T * (reference[k] - force)
        waiting = 2.0 * (reference[k] - force) + integral - 0.02 * (force - before) / T
        before = force
        x = moved @ x
    return so.Log.from_arrays(time=T * np.arange(n), u=rows[:, 0], F=rows[:, 1])


def fit(log, *free, feedback=True, **options):
    off = dict.fromkeys(free, 0.8)
    values = {"m": (MASS, "kg"), "b": (DAMPING, "N s/m"), "k": (STIFFNESS, "N/m")}
    params = so.ParameterSet.of(**{name: (off.get(name, 1.0) * value, unit) for name, (value, unit) in values.items()})
    experiment = so.Experiment(plant=PLANT, log=log, feedback=feedback, name="log")
    return so.fit([experiment], params.free(*free), **options)


def list_residuals(result):
    return [finding for finding in result.findings if finding.kind == "residual"]


def test_noise_that_goes_round_the_loop_is_not_said_to_follow_the_input():
    log = run(1)
    result = fit(log, "m", "b")
    assert result.met and not list_residuals(result), result
    so.testing.assert_recovered(result, {"m": MASS, "b": DAMPING}, sigmas=4)
    taken_for_open = fit(log, "m", "b", feedback=False)  # where the input tells the noise
    assert not taken_for_open.met and taken_for_open.findings


@pytest.mark.parametrize("lag", [0.0, 0.9, 0.999])
def test_the_probability_of_a_right_model_is_uniform(lag):
    """Kolmogorov and Smirnov's test over 40 logs, the plant known, of white and of coloured noise."""
    found = []
    for seed in range(40):
        minimum = fit(run(seed, n=2000, lag=lag), diagnostics=False).require_minimum("test")
        (one,) = minimum.problem.experiments
        found.append(measure_coherence(one, minimum.residuals()["log"])["F"].p)
    assert stats.kstest(found, "uniform").pvalue > 1e-3, np.sort(found)[:5]


@pytest.mark.parametrize("mode_hz", [25.0, 40.0])
def test_a_mode_that_the_model_lacks_is_seen_under_a_law(mode_hz):
    (finding,) = list_residuals(fit(run(2, noise=2.0, mode_hz=mode_hz), "m", "b"))
    assert finding.where == "log.F" and "of the residual's power follows the inputs" in finding.text
