"""Profiles against closed forms and against R."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.stats import norm

import seaopt as so
from seaopt.errors import EstimationError
from seaopt.estimation import profile

# R 4, stats::profile.nls, example(profile.nls) as printed in tests/Examples/stats-Ex.Rout.save of R's sources: the data
# set BOD (Bates and Watts 1988, appendix A1.4), demand ~ A (1 - exp(-exp(lrc) Time)); profile t and parameter.
R_PROFILES = {
    "A": ((-3.0873, 13.59751), (-1.8906, 15.41836), (-0.6080, 17.75662), (0.9465, 22.06851), (2.1841, 29.75928),
          (2.9028, 41.42542)),
    "lrc": ((-2.9550, -2.184153), (-1.5710, -1.293871), (-0.5412, -0.845157), (1.1022, -0.207623), (2.1335, 0.234850),
            (3.0276, 0.779458)),
}  # fmt: skip
TIME = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 7.0])
DEMAND = np.array([8.3, 10.3, 19.0, 16.0, 15.6, 19.8])


def static(outputs, parameters):
    """Return a plant without memory; its only state follows x and is not seen."""
    return so.Plant(
        name="regression", states={"z": "-"}, inputs={"x": "-"}, outputs={"y": "-"},
        parameters=dict.fromkeys(parameters, "-"), f=lambda t, x, u, p: {"z": u.x - x.z},
        h=lambda t, x, u, p: {"y": outputs(u.x, p) + 0 * x.z},
    )  # fmt: skip


def experiment(plant, x, y, **options):
    """Return an experiment; a log takes nine samples or more: what is lacking is left unmeasured."""
    lacking = max(9 - x.size, 0)
    log = so.Log.from_arrays(
        time=np.arange(x.size + lacking, dtype=float), x=np.append(x, np.full(lacking, x[-1])),
        y=np.append(y, np.full(lacking, np.nan)),
    )  # fmt: skip
    return so.Experiment(plant=plant, log=log, initial_state="rest", offset=False, **options)


@pytest.fixture(scope="module")
def demand():
    """The fit to BOD, weighted with R's residual standard error, which divides by n - 2."""
    plant = static(lambda x, p: p.A * (1 - ca.exp(-ca.exp(p.lrc) * x)), ("A", "lrc"))
    given = so.ParameterSet.of(A=(20.0, "-"), lrc=(-0.5, "-")).free("A", "lrc")
    rms = so.fit([experiment(plant, TIME, DEMAND)], given).outputs["experiment"]["y"].rms_residual
    return so.fit([experiment(plant, TIME, DEMAND, sigma={"y": rms * np.sqrt(6 / 4)})], given)


@pytest.mark.parametrize(("name", "tau", "value"), [(name, *row) for name, rows in R_PROFILES.items() for row in rows])
def test_the_profile_is_that_of_r(demand, name, tau, value):
    """R prints tau to four decimals: the value where ours equals it agrees to what that leaves."""
    found = profile(demand, name, points=0, level=2 * norm.cdf(abs(tau)) - 1, coloured=False)
    slope = 8.0 if name == "A" and tau > 2.5 else 2.0  # R's table: dA/dtau up to 20 std at its end
    allowed = slope * 1e-3 * demand.white_covariance.std(name)
    assert found.interval[int(tau > 0)] == pytest.approx(value, abs=allowed)


def test_a_curved_profile_takes_few_refits(demand):
    found = profile(demand, "A", points=0, coloured=False)
    assert found.refits <= 14
    assert found.closed == (True, True)
    low, high = found.interval
    assert high - found.estimate > 1.5 * (found.estimate - low)


def line(seed, correlation=0.0, n=400):
    rng = np.random.default_rng(seed)
    x, e = rng.normal(size=n), rng.normal(size=n)
    for i in range(1, n):
        e[i] += correlation * e[i - 1]
    plant = static(lambda x, p: p.a * x + p.b * x**2, ("a", "b"))
    given = so.ParameterSet.of(a=(1.0, "-"), b=(0.5, "-")).free("a", "b")
    return x, so.fit([experiment(plant, x, 2.0 * x - x**2 + e, sigma={"y": 1.0})], given)


def test_of_a_linear_model_it_is_the_closed_form():
    """y = a x + b x^2 + e, sigma = 1: tau is a straight line of slope 1/std, std from (X'X)^-1."""
    x, fit = line(1)
    design = np.column_stack([x, x**2])
    std = np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    for i, name in enumerate(("a", "b")):
        found = profile(fit, name, points=5, coloured=False)
        middle = fit.parameters[name].value
        reach = 1.959963985 * std[i]
        np.testing.assert_allclose(found.interval, (middle - reach, middle + reach), rtol=1e-6)
        np.testing.assert_allclose(found.tau, (found.values - middle) / std[i], atol=1e-4)


def test_coloured_residuals_widen_it_as_they_widen_the_std():
    _, fit = line(2, correlation=0.8, n=4000)
    found = profile(fit, "a", points=0)
    assert found.scale == pytest.approx((fit.covariance.std("a") / fit.white_covariance.std("a")) ** 2)
    np.testing.assert_allclose(found.interval, found.wald, rtol=1e-6)


def test_an_end_at_a_bound_and_an_end_that_is_nowhere():
    """y = a b x: the cost does not rise along a b = const, but for the bound."""
    plant = static(lambda x, p: p.a * p.b * x, ("a", "b"))
    x = np.linspace(-1, 1, 50)
    y = 2 * x + 0.1 * np.random.default_rng(3).normal(size=50)
    given = so.ParameterSet.of(a=(1.0, "-"), b=(2.0, "-")).bound(a=(0.5, np.inf)).free("a", "b")
    fit = so.fit([experiment(plant, x, y, sigma={"y": 0.1})], given, method=so.OutputError(search=False))
    assert fit.status == "not_identifiable"
    found = profile(fit, "a", points=0)
    assert found.interval == (0.5, np.inf)
    assert found.closed == (False, False)


def test_bad_arguments_say_what_to_do(demand):
    with pytest.raises(EstimationError, match='"Lrc" is not a free parameter of the plants; did you mean "lrc"'):
        profile(demand, "Lrc")
    with pytest.raises(EstimationError, match=r"level = 95 is not between 0 and 1"):
        profile(demand, "A", level=95.0)
    with pytest.raises(EstimationError, match="read from a file; call fit again"):
        profile(so.Fit.from_dict(demand.to_dict()), "A")
