"""A drive's current and a cell on a slower clock of its own: each reading counts once, at its own time.

The joint is simulated here, at 10 kHz under a current that the drive holds for a millisecond.
"""

import numpy as np
import pytest
from scipy.signal import chirp, cont2discrete, dlsim

import seaopt as so
from seaopt.logs import Readings

N, C_S, K_S, NOISE = 50.0, 1.0, 300.0, 0.05
TRUTH = {"J_m": 4e-5, "b_r": 1e-3, "K_tau": 0.07}


def fit_cell(every, first):
    """Return the fit of a cell that reads every so many tenths of a millisecond, from one of them on."""
    rng, t, parts = np.random.default_rng(1), np.arange(10_000) * 1e-3, 10
    current = 3.0 * (
        0.6 * chirp(t, 0.2, 10.0, 40.0) + 0.3 * np.interp(t, np.linspace(0, 10, 201), rng.normal(size=201))
    )
    J_m, b_r, K_tau = TRUTH.values()
    a = np.array([[0.0, 1.0], [-K_S / N**2 / J_m, -(b_r + C_S / N**2) / J_m]])
    torque = np.array([[K_S / N, C_S / N]])
    fine = cont2discrete((a, np.array([[0.0], [K_tau / J_m]]), torque, np.zeros((1, 1))), 1e-3 / parts)
    y = dlsim((*fine[:4], 1e-3 / parts), np.repeat(current, parts))[1][first::every, 0]
    own = 1e-3 / parts * np.arange(first, t.size * parts, every)
    log = so.Log.from_arrays(time=t, I=current, tau_s=Readings()(t, own, y + NOISE * rng.normal(size=y.size)))
    plant = so.plants.rotary(link="locked")
    known = plant.defaults.update(N=N, c_s=C_S, k_s=K_S, f_c=0.0)
    start = known.update(J_m=1e-4, b_r=1e-4, K_tau=0.05).free(*TRUTH)
    return so.fit([so.Experiment(plant=plant, log=log, outputs=("tau_s",))], start)


@pytest.mark.parametrize(("every", "first"), [(20, 3), (21, 3), (40, 7)])
def test_readings_of_a_slower_clock_give_a_right_fit_that_is_met(every, first):
    """On lines between them the residual was 3 to 4 times the noise, and causes were named that are not there."""
    fit = fit_cell(every, first)
    assert fit.met
    for name, value in TRUTH.items():
        assert abs(fit.parameters[name].value / value - 1.0) < 2e-3
        assert abs(fit.parameters[name].value - value) < 3.0 * fit.parameters[name].total_std
    output = fit.outputs["experiment"]["tau_s"]
    assert output.excess < 1.2 and output.rms_residual == pytest.approx(NOISE, rel=0.12)
    assert output.explainable is not None and output.explainable > 0.98
