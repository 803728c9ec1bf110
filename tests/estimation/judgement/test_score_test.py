"""Score tests of parameters held fixed: against closed forms, false alarms in coloured noise, and refits."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

import seaopt as so
from seaopt.bench import PAPER_STAND, PAPER_SWING
from seaopt.estimation import diagnose
from seaopt.estimation.judgement.score_test import run_score_tests
from seaopt.files import to_json

pytestmark = pytest.mark.usefixtures("without_hypotheses")  # which no score test reads
NOISE = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0})
SUM = so.Plant(
    name="sum", states={"z": "-"}, inputs={"u": "-", "v": "-"}, outputs={"y": "-"}, parameters={"a": "-", "c": "-"},
    f=lambda t, x, u, p: {"z": u.u - x.z}, h=lambda t, x, u, p: {"y": p.a * u.u + p.c * u.v + 0 * x.z},
)  # fmt: skip


def ar1(a, n, rng):
    return lfilter([1.0], [1.0, -a], rng.normal(size=n + 300))[300:]


def regression(u, v, y, c, **options):
    log = so.Log.from_arrays(time=np.arange(float(y.size)), u=u, v=v, y=y)
    bench = so.Experiment(plant=SUM, log=log, initial_state="rest", offset=False, **options)
    params = so.ParameterSet.of(a=(1.0, "-"), c=(c, "-")).free("a")
    fit = so.fit([bench], params, method=so.OutputError(search=False))
    return run_score_tests(fit.minimum)["c"]


def test_a_regression_has_the_textbooks_multiplier():
    """y = a u + c v + e, c held at 0: s = w' e, w what u leaves of v; for white e chi-square is s^2 / w' w."""
    rng = np.random.default_rng(0)
    u, v, e = rng.normal(size=(3, 20_000))
    v += 0.5 * u
    found = regression(u, v, 2.0 * u + 0.05 * v + e, 0.0, sigma={"y": 1.0})
    residual = (2.0 * u + 0.05 * v + e) - u * (u @ (2.0 * u + 0.05 * v + e)) / (u @ u)
    alone = v - u * (u @ v) / (u @ u)
    score, information = alone @ residual, alone @ alone
    assert found.preferred == pytest.approx(score / information, rel=1e-6)
    assert found.fall == pytest.approx(score**2 / (2 * information), rel=1e-6)
    assert found.chi2 == pytest.approx(score**2 / information, rel=0.1)  # the residuals' variance is estimated
    assert found.p == pytest.approx(chi2.sf(found.chi2, 1), rel=1e-6)


@pytest.mark.slow
def test_coloured_residuals_raise_no_false_alarm():
    """5 % of right values are beyond the 5 % point; a test for white residuals calls half of them wrong."""
    rng, n, beyond, white = np.random.default_rng(4), 1500, 0, 0
    for _ in range(80):
        u, v, e = ar1(0.9, n, rng), ar1(0.9, n, rng), ar1(0.9, n, rng)
        found = regression(u, v, 2.0 * u + 0.5 * v + e, 0.5)
        beyond += found.chi2 > chi2.isf(0.05, 1)
        white += 2.0 * found.fall > chi2.isf(0.05, 1)
    assert beyond <= 12
    assert white > 24


@pytest.fixture(scope="module")
def bench(stand, thor):
    log = so.virtual_log(stand, thor, PAPER_STAND, duration_s=40, rate_hz=400, seed=3, sensors=NOISE)
    return so.Experiment(plant=stand, log=log, name="stand", outputs=("F1", "F2"))


def test_a_stiffness_held_20_percent_off_is_named_and_not_the_models_structure(bench, thor):
    """F2/F1 is 1 + m_l s^2/k, and J and b_r take up the rest: k too large or m_l too small, no residual tells which."""
    wrong = thor.update(k=1.2 * thor["k"].value).free("J", "b_r", "eta")
    fit = so.fit([bench], wrong)
    found = diagnose(fit)
    assert set(found.held) == {"k", "m_l"}  # l, N_p and K_tau are what J, b_r and eta stand for
    (cause,) = (one for one in found.findings if one.kind == "cause")
    assert set(cause.preferred) == {"k", "m_l"} and not fit.met
    for name, true in (("k", thor["k"].value), ("m_l", 1.2 * thor["m_l"].value)):
        again = so.fit([bench], wrong.free(name))
        value, std = cause.preferred[name]
        assert value == pytest.approx(again.parameters[name].value, abs=0.5 * std)
        assert value == pytest.approx(true, abs=4 * std)
        assert std == pytest.approx(again.parameters[name].std, rel=0.3)
        assert found.held[name].chi2 == pytest.approx(2 * (again.log_likelihood - fit.log_likelihood), rel=0.1)
        assert diagnose(again).met
    assert json.loads(to_json(found.to_dict()))["held"]["k"]["value"] == 1.2 * thor["k"].value
    assert "k = 786000 N/m held fixed: chi-square" in repr(found)


@pytest.mark.slow
def test_a_parameter_that_nothing_stands_for_is_named_alone(swing, thor):
    """Friction held at zero: no input is followed, the residual is coloured, and freeing it leaves it white."""
    truth = thor.update(f_c=30.0, v_s=5e-3)
    log = so.virtual_log(swing, truth, PAPER_SWING, duration_s=20, rate_hz=400, seed=3, sensors=NOISE)
    bench = so.Experiment(plant=swing, log=log, name="swing", outputs=("F1", "F2"))
    found = diagnose(so.fit([bench], truth.update(f_c=0.0).free("J", "b_r", "eta")))
    (cause,) = (finding for finding in found.findings if finding.kind == "cause")
    assert f"f_c: {cause.text}" in found.sentences
    value, std = cause.preferred["f_c"]
    assert value == pytest.approx(30.0, abs=4 * std)
