"""A log whose torque firmware made of two encoders: met as what it is, and named where it is taken for a load cell's.

The log is of matrices written here, with the spring's damper, discretised by scipy, and of rounded encoders.
"""

import numpy as np
import pytest
from scipy.signal import cont2discrete

import seaopt as so

J_M, B_R, K_TAU, N, K_S, C_S, J_L, D_L, K_N = 1e-4, 1e-3, 0.05, 50.0, 300.0, 0.6, 0.1, 0.3, 310.0
TRUTH = {"J_m": J_M, "b_r": B_R, "k_s": K_S, "c_s": C_S, "J_l": J_L, "d_l": D_L}

AWAY = {"J_m": 2e-4, "b_r": 5e-4, "k_s": 200.0, "c_s": 0.3, "d_l": 0.1, "J_l": 0.2}
K_N_GUESS = so.Parameter(name="k_n", value=250.0, unit="N m/rad")


@pytest.fixture(scope="module")
def log():
    period, n, rng = 2e-3, 2000, np.random.default_rng(4)
    pull, damp = K_S / N, C_S / N
    a = np.array([
        [0, 1, 0, 0], [-pull / N / J_M, -(damp / N + B_R) / J_M, pull / J_M, damp / J_M],
        [0, 0, 0, 1], [pull / J_L, damp / J_L, -K_S / J_L, -(C_S + D_L) / J_L],
    ])  # fmt: skip
    b = np.array([[0], [K_TAU / J_M], [0], [0]])
    f, g, *_ = cont2discrete((a, b, np.eye(4), np.zeros((4, 1))), period)
    current = np.convolve(rng.normal(size=n), np.ones(4) / 4, mode="same")
    x, path = np.zeros(4), np.empty((n, 4))
    for k in range(n):
        path[k], x = x, f @ x + g[:, 0] * current[k]
    motor, link = (np.round(path[:, i] / step) * step for i, step in ((0, 2 * np.pi / 4096), (2, 2 * np.pi / 2**16)))
    return {"time": np.arange(n) * period, "I": current, "theta_m": motor}, K_N * (motor / N - link)


def fit_as(log, output, start, *free):
    signals, torque = log
    named = so.Log.from_arrays(**signals, **{output: torque})
    plant = so.plants.rotary(parts=["deflection_sensor"] if output == "tau_d" else [])
    experiment = so.Experiment(plant=plant, log=named, outputs=(output, "theta_m"), initial_state="rest")
    return so.fit([experiment], so.ParameterSet([*plant.defaults.values(), K_N_GUESS]).update(**start).free(*free))


def test_the_fit_is_met_where_the_output_is_what_it_is(log):
    fit = fit_as(log, "tau_d", {**AWAY, "k_n": K_N}, *TRUTH)
    assert fit.met
    so.testing.assert_recovered(fit, TRUTH, sigmas=4)


def test_taken_for_a_load_cell_it_is_named(log):
    fit = fit_as(log, "tau_s", AWAY, *TRUTH)
    assert not fit.met
    causes = [finding.text for finding in fit.findings if finding.kind == "cause"]
    assert causes
    assert "tau_s is the torque from deflection" in causes[0].split("; or")[0]


def test_its_gain_may_be_free(log):
    fit = fit_as(log, "tau_d", TRUTH, "k_n", "k_s", "J_l")
    assert fit.met
    so.testing.assert_recovered(fit, {"k_n": K_N, "k_s": K_S, "J_l": J_L}, sigmas=4)
