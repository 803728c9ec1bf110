"""A second search: on a cost of many lobes it finds the lowest, on one of a single minimum it says nothing."""

from __future__ import annotations

import casadi as ca
import numpy as np

import seaopt as so
from seaopt.estimation.judgement import another_start
from seaopt.estimation.problem.fit_problem import limit_evaluations

N = 4000
WAVE = so.Plant(
    name="wave", states={"z": "-"}, inputs={"u": "-"}, outputs={"y": "-"}, parameters={"a": "-"},
    f=lambda t, x, u, p: {"z": u.u - x.z}, h=lambda t, x, u, p: {"y": ca.sin(p.a * u.u) + 0 * x.z},
)  # fmt: skip


def fit_from(start):
    """Return the fit of y = sin(a u), a = 1, u up to 20: its cost has a lobe every 0.3 or so."""
    rng = np.random.default_rng(2)
    u = np.linspace(0.0, 20.0, N)
    y = np.sin(u) + 0.05 * rng.normal(size=N)
    log = so.Log.from_arrays(time=np.arange(N) * 1e-2, u=u, y=y)
    bench = so.Experiment(plant=WAVE, log=log, initial_state="rest", offset=False, name="log")
    params = so.ParameterSet.of(a=(start, "-")).free("a")
    return so.fit([bench], params, method=so.OutputError(search=False))


def list_starts(fit):
    return [finding for finding in fit.findings if finding.kind == "starts"]


def test_a_start_in_a_higher_lobe_is_told_of_the_lowest():
    fit = fit_from(1.45)
    assert abs(fit.parameters["a"].value - 1.0) > 0.2
    (finding,) = list_starts(fit)
    assert finding.severity == "error" and not fit.met
    assert abs(finding.preferred["a"][0] - 1.0) < 0.01
    assert "explains the logs better" in finding.text


def test_a_search_that_is_left_before_its_end_says_so_and_keeps_what_it_found():
    fit = fit_from(1.45)
    kinds = []
    for most in (3, 6, 10, 20, 40, 80):
        with limit_evaluations(most):
            kinds.append([each.kind for each in another_start.find_other_minimum(fit)])
    assert kinds[0] == ["budget"] and kinds[-1] == ["starts"]
    found = [("starts" in each) for each in kinds]
    assert found == sorted(found)  # what fewer evaluations found, more do not lose


def test_the_lowest_lobe_is_not_doubted():
    fit = fit_from(1.02)
    assert abs(fit.parameters["a"].value - 1.0) < 0.01
    assert not list_starts(fit) and fit.met


def test_a_minimum_that_is_far_worse_is_not_refined(monkeypatch):
    """A lobe of the wave leaves 3 % of its power where the noise is 0.5 %: coarse steps tell."""
    refined = []
    monkeypatch.setattr(another_start, "refine_to", lambda *given: refined.append(given))
    assert not list_starts(fit_from(1.02))
    assert not refined


def test_to_start_elsewhere_takes_all_values():
    """One does not move, and is stated beside the other: from the given value of it the search may go astray again."""
    plant = so.Plant(
        name="waves", states={"z": "-"}, inputs={"u": "-"}, outputs={"y": "-", "v": "-"},
        parameters={"a": "-", "k": "-"}, f=lambda t, x, u, p: {"z": u.u - x.z},
        h=lambda t, x, u, p: {"y": ca.sin(p.a * u.u) + 0 * x.z, "v": p.k * u.u},
    )  # fmt: skip
    rng, u = np.random.default_rng(2), np.linspace(0.0, 20.0, N)
    outputs = {"y": np.sin(u) + 0.05 * rng.normal(size=N), "v": 3.0 * u + 0.05 * rng.normal(size=N)}
    log = so.Log.from_arrays(time=np.arange(N) * 1e-2, u=u, **outputs)
    bench = so.Experiment(plant=plant, log=log, initial_state="rest", offset=False, name="log")
    params = so.ParameterSet.of(a=(1.45, "-"), k=(1.0, "-")).free("a", "k")
    fit = so.fit([bench], params, method=so.OutputError(search=False))
    (finding,) = list_starts(fit)
    assert finding.where == "a" and abs(finding.preferred["k"][0] - 3.0) < 0.01
