"""Parameters of one log alone: a payload that is known, one that is fitted, constants in a log's header."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import seaopt as so
from seaopt.errors import EstimationError, ProblemError
from seaopt.estimation import warn_unidentified
from seaopt.reporting.comparison import experiment_survey

RATE_HZ, K, B = 200.0, 400.0, 1.5
MASSES = {"light": 0.5, "heavy": 2.0}
CART = """
[plant.cart]
states = { x = "m", v = "m/s" }
inputs = { F = "N" }
outputs = { x = "m" }
parameters = { m = "kg", k = "N/m", b = "N s/m" }
f = { x = "v", v = "(F - k*x - b*v)/m" }
h = { x = "x" }
"""


def make_cart():
    """Return a cart on a spring."""
    return so.Plant(
        name="cart", states={"x": "m", "v": "m/s"}, inputs={"F": "N"}, outputs={"x": "m"},
        parameters={"m": "kg", "k": "N/m", "b": "N s/m"},
        f=lambda t, x, u, p: {"x": x.v, "v": (u.F - p.k * x.x - p.b * x.v) / p.m}, h=lambda t, x, u, p: {"x": x.x},
    )  # fmt: skip


def record(mass, seed):
    """Return time, force and position of a cart, from scipy's integrator, with noise of 0.1 mm."""
    rng = np.random.default_rng(seed)
    t = np.arange(1500) / RATE_HZ
    force = 5.0 * np.sign(np.sin(2 * np.pi * (0.4 * t + 0.5 * t**2)))
    x, rows = np.zeros(2), []
    for push in force:
        rows.append(x[0])
        x = solve_ivp(
            lambda t, y, push=push: [y[1], (push - K * y[0] - B * y[1]) / mass],
            (0.0, 1 / RATE_HZ),
            x,
            rtol=1e-8,
            atol=1e-10,
        ).y[:, -1]
    return t, force, np.array(rows) + 1e-4 * rng.normal(size=t.size)


@pytest.fixture(scope="module")
def records():
    return {name: record(mass, seed) for seed, (name, mass) in enumerate(MASSES.items())}


@pytest.fixture(scope="module")
def experiments(records):
    """Return both logs; the mass of the light cart is known, that of the heavy one is not."""
    heavy = so.Parameter(name="m", value=1.0, unit="kg", free=True, min=0.0)
    given = {"light": MASSES["light"], "heavy": heavy}
    return [
        so.Experiment(
            plant=make_cart(), log=so.Log.from_arrays(time=t, F=f, x=x), name=name, offset=False,
            parameters={"m": given[name]},
        )
        for name, (t, f, x) in records.items()
    ]  # fmt: skip


@pytest.fixture(scope="module")
def fit(experiments):
    start = so.ParameterSet.of(k=(250.0, "N/m"), b=(0.5, "N s/m")).bound(k=(0, 1e5), b=(0, 1e3)).free("k", "b")
    return so.fit(experiments, start, diagnostics=False)


def test_one_of_a_log_alone_goes_with_a_band_without_0_hz(experiments):
    """Whether the start is forgotten before the band's filter settles depends on the plant, its own mass included."""
    start = so.ParameterSet.of(k=(390.0, "N/m"), b=(B, "N s/m")).free("k")
    fit = so.fit(experiments[1:], start, band_hz=(1.0, 40.0), diagnostics=False)
    assert fit.parameters["heavy.m"].value == pytest.approx(MASSES["heavy"], rel=0.05)


def test_a_known_and_a_free_mass_of_one_log_each(fit):
    assert fit.met, str(fit)
    for name, truth in (("k", K), ("b", B), ("heavy.m", MASSES["heavy"])):
        found = fit.parameters[name]
        assert found.free and abs(found.value - truth) < 4.0 * found.std < 0.02 * truth, found
    assert "heavy.m" in str(fit) and "heavy.m" in fit.covariance.names


def test_predictions_take_each_logs_own(fit, experiments):
    for experiment in experiments:
        assert fit.predict(experiment).fit_percent["x"] > 99.0
    heavy = experiments[1]
    wrong = so.Experiment(
        plant=heavy.plant, log=heavy.log, name="other", offset=False, parameters={"m": MASSES["light"]}
    )
    assert fit.predict(wrong).fit_percent["x"] < 80.0


def test_a_problem_file_reads_them_from_itself_and_from_headers(records, tmp_path):
    for name, (t, f, x) in records.items():
        lines = [f"# payload = {MASSES[name]} kg", "time [s],F [N],x [m]"]
        lines += [f"{a!r},{b!r},{c!r}" for a, b, c in zip(t.tolist(), f.tolist(), x.tolist(), strict=True)]
        (tmp_path / f"{name}.csv").write_text("\n".join(lines) + "\n")
    table = 'plant = "cart"\ntime = "time [s]"\noffset = false\ninputs = { F = "F [N]" }\noutputs = { x = "x [m]" }\n'
    text = "schema = 1\n[parameters]\nk = { value = 250, free = true }\nb = { value = 0.5, free = true }\n" + CART
    text += f'[[experiment]]\nname = "light"\nlog = "light.csv"\n{table}'
    text += 'parameters = { m = { column = "payload", from = "header", unit = "kg" } }\n'
    text += f'[[experiment]]\nname = "heavy"\nlog = "heavy.csv"\n{table}'
    text += "parameters = { m = { value = 1.0, free = true } }\n"
    (tmp_path / "cart.toml").write_text(text)
    problem = so.read_problem(tmp_path / "cart.toml")
    light, heavy = problem.experiments()
    assert light.parameters == {"m": 0.5} and heavy.parameters["m"].free
    fit = so.fit([light, heavy], problem.parameters)
    assert abs(fit.parameters["heavy.m"].value - 2.0) < 4.0 * fit.parameters["heavy.m"].std
    (tmp_path / "cart.toml").write_text(text.replace("parameters = { m = { value", "parameters = { mm = { value"))
    with pytest.raises(ProblemError, match='names "mm"'):
        so.read_problem(tmp_path / "cart.toml").experiments()


def test_wrong_ones_are_refused(experiments):
    one = experiments[0]
    wrong = {"mm": 1.0}, {"m": float("nan")}, {"m": so.Parameter(name="m", value=1.0, unit="N")}, {"m": "heavy"}
    for parameters in wrong:
        with pytest.raises(EstimationError, match="parameters"):
            so.Experiment(plant=one.plant, log=one.log, parameters=parameters)
    with pytest.raises(EstimationError, match="is free, but"):
        so.fit(experiments[:1], so.ParameterSet.of(m=(1.0, "kg"), k=(K, "N/m"), b=(B, "N s/m")).free("m"))


def make_derived_cart():
    """Return the cart with its frequency, and what it has of its damper alone, as derived figures."""
    figures = lambda p: {"f": ((p.k / p.m) ** 0.5 / (2 * np.pi), "Hz"), "tau": (p.b / p.k, "s")}  # noqa: E731
    return replace(make_cart(), derived=figures)


def test_derived_figures_of_own_parameters_are_their_logs_own(experiments):
    """d log f = (d log k - d log m)/2; the std of f follows from the covariance of k and heavy.m."""
    start = so.ParameterSet.of(k=(250.0, "N/m"), b=(0.5, "N s/m")).bound(k=(0, 1e5), b=(0, 1e3)).free("k", "b")
    fit = so.fit([replace(e, plant=make_derived_cart()) for e in experiments], start, diagnostics=False)
    assert set(fit.derived) == {"light.f", "heavy.f", "tau"}
    k, m, names = fit.parameters["k"].value, fit.parameters["heavy.m"].value, list(fit.covariance.names)
    slopes = np.zeros(len(names))
    slopes[[names.index("k"), names.index("heavy.m")]] = 0.5 / k, -0.5 / m
    heavy = fit.derived["heavy.f"]
    assert np.isclose(heavy.value, np.sqrt(k / m) / (2 * np.pi))
    assert np.isclose(heavy.std, heavy.value * np.sqrt(slopes @ fit.covariance.matrix @ slopes))
    assert np.isclose(fit.derived["light.f"].value, np.sqrt(k / MASSES["light"]) / (2 * np.pi))


def test_a_start_is_estimated_with_the_fitted_mass(fit, experiments):
    """Another log of the same experiment: the start belongs to the mass with which it is simulated."""
    heavy = experiments[1]
    later = heavy.log.between(2.0, 7.0)
    fitted = fit.predict(replace(heavy, log=later))
    known = fit.predict(replace(heavy, log=later, parameters={"m": fit.parameters["heavy.m"].value}))
    assert fitted.own.initial_state == known.own.initial_state
    assert fitted.fit_percent["x"] > 99.0


def test_a_free_parameter_that_the_fit_has_not_is_refused(fit, experiments):
    with pytest.raises(EstimationError, match=r"other\.m"):
        fit.predict(experiments[1].rename("other"))


def test_a_unit_of_another_kind_in_a_header_is_refused(records, tmp_path):
    t, f, x = records["light"]
    rows = [f"{a!r},{b!r},{c!r}" for a, b, c in zip(t.tolist(), f.tolist(), x.tolist(), strict=True)]
    (tmp_path / "light.csv").write_text("\n".join(["# payload = 0.5", "time [s],F [N],x [m]", *rows]) + "\n")
    text = "schema = 1\n[parameters]\nk = 400\nb = { value = 0.5, free = true }\n" + CART
    text += '[[experiment]]\nname = "light"\nplant = "cart"\nlog = "light.csv"\ntime = "time [s]"\n'
    text += 'inputs = { F = "F [N]" }\noutputs = { x = "x [m]" }\n'
    text += 'parameters = { m = { column = "payload", from = "header", unit = "mA" } }\n'
    (tmp_path / "cart.toml").write_text(text)
    with pytest.raises(EstimationError, match=r"cart.toml: experiment light: parameters: m is in kg, and column"):
        so.read_problem(tmp_path / "cart.toml").experiments()


def test_frequency_responses_take_each_logs_own(fit, experiments):
    k, b = (fit.parameters[name].value for name in ("k", "b"))
    for experiment, m in zip(experiments, (MASSES["light"], fit.parameters["heavy.m"].value), strict=True):
        measured, w = experiment_survey(experiment, fit), 2 * np.pi * np.array([1.0, 5.0])
        response = measured.model(measured.pairs[0], fit.parameters)(w / (2 * np.pi))
        assert np.allclose(np.abs(response), 1.0 / np.abs(k - m * w**2 + 1j * b * w), rtol=1e-2)


def test_what_is_computed_for_no_log_says_which_value_it_takes(fit):
    params = fit.parameters.with_parameters(so.Parameter(name="m", value=3.0, unit="kg"))
    assert any("heavy" in note and "m = 3" in note for note in warn_unidentified(params, {"m"}))
    assert not warn_unidentified(params, {"k"})


@pytest.mark.slow
def test_another_plant_without_the_own_parameter_is_a_cause():
    """A log of the stand, fitted as one of the pendulum with a known mass, which the stand does not have."""
    stand, swing = so.plants.high_impedance(drive="lumped"), so.plants.moving_output(drive="lumped")
    t, rng = np.arange(500) / 250, np.random.default_rng(0)
    current = np.interp(t, np.arange(0, 4.1, 0.04), rng.normal(size=103) * 1.5)
    force = so.simulate(stand, so.plants.thor(), so.Log.from_arrays(time=t, I=current))["F1"]
    log = so.Log.from_arrays(time=t, I=current, F1=force + 2.0 * rng.normal(size=t.size))
    wrong = so.Experiment(plant=swing, log=log, name="a", parameters={"m": 6.0})
    fit = so.fit([wrong], so.plants.thor().free("b_r"), alternatives=[stand])
    assert not fit.met and any(finding.kind == "cause" and stand.name in finding.text for finding in fit.findings)
