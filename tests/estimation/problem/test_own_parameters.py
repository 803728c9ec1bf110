"""Parameters of one log alone: a payload that is known, one that is fitted, constants in a log's header."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import seaopt as so
from seaopt.errors import EstimationError, ProblemError

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
    return so.fit(experiments, start)


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
