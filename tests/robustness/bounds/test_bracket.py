"""Bounds from above: never below any draw, near the worst case found, and nothing bounded that is not so."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

import seaopt as so
from seaopt.errors import ControlError
from seaopt.parameters import Parameter
from seaopt.robustness import Bracket, Budget, Uncertainty, batch_figures, bracket, combine_uncertainty
from seaopt.robustness.bounds.region import build_region
from seaopt.robustness.uncertainty.draws import LEVEL
from seaopt.robustness.uncertainty.worst import find_worst, measure_worst
from tests.laws import law_of
from tests.words import flatten


@pytest.fixture(scope="module")
def controller(robust_controller):
    return robust_controller


def of(plant, params, ranges):
    return combine_uncertainty(params, so.ParameterSet(), ranges, {"plant": plant})


def draws(unknown, count, seed=0):
    """Return points of the set: inside the ellipsoid, on its edge, and at the corners of the ranges."""

    rng = np.random.default_rng(seed)
    g, k = len(unknown.names), len(unknown.ranges)
    x = rng.normal(size=(count, g))
    if g:
        size = np.sqrt(chi2.ppf(LEVEL, g)) * rng.uniform(size=count) ** (1.0 / g)
        size[::2] = np.sqrt(chi2.ppf(LEVEL, g))
        x *= (size / np.linalg.norm(x, axis=1))[:, None]
    t = rng.uniform(-1.0, 1.0, (count, k))
    t[::3] = np.sign(t[::3])
    points = np.hstack([x, t])
    return points[unknown.inside(points)]


CASES = {  # plant, standard deviations, ranges, draws
    "stand, fit": ("stand", {"J": 3.3e-8, "b_r": 2e-6, "eta": 0.01}, {}, 4000),
    "swing, fit and inertia": ("swing", {"J": 3.3e-8, "b_r": 2e-6, "eta": 0.01}, {"I_p": (0.3, 0.5)}, 4000),
    "swing, damping": ("swing", {}, {"I_p": (0.3, 0.5), "d": (0.0, 0.1)}, 2000),
    "swing, delay": ("swing", {}, {"I_p": (0.3, 0.5), "delay_s": (0.0, 2.4e-3)}, 2000),
    "swing, angle": ("swing", {}, {"phi": (-0.2, 0.6)}, 2000),
}


QUICK = ("swing, delay", "swing, angle")


@pytest.mark.parametrize(
    "case", [case if case in QUICK else pytest.param(case, marks=pytest.mark.slow) for case in CASES]
)
def test_no_draw_is_above_the_bound_and_the_bound_is_near(case, controller, thor, request):
    name, priors, ranges, count = CASES[case]
    plant = request.getfixturevalue(name)
    unknown = of(plant, thor.prior(**priors) if priors else thor, ranges)
    bounds = bracket(controller, plant, unknown)
    figures = batch_figures(controller, plant, unknown.nominal, unknown.values(draws(unknown, count)))
    assert bounds.bounded_stable
    assert np.max(figures.spectral_radius) < 1.0
    assert np.max(figures.ms) <= bounds.ms_upper <= 1.012 * bounds.ms_lower
    assert np.max(figures.mt) <= bounds.mt_upper <= 1.012 * bounds.mt_lower


def test_what_was_met_is_no_worse_than_what_the_search_finds(controller, stand, thor):
    """Centres of boxes that reach beyond the ellipsoid are no plants of the set."""
    unknown = of(stand, thor.prior(J=3.3e-7, b_r=2e-5, eta=0.03), {})
    worst = find_worst(controller, stand, unknown, np.zeros((1, 3)))
    bounds = bracket(controller, stand, unknown, budget=Budget(tolerance=0.05))
    assert 0.95 * worst.ms <= bounds.ms_lower <= worst.ms * (1.0 + 1e-6)


@pytest.mark.parametrize(
    ("part", "ranges"),
    [
        ("current_loop", {"current_loop_hz": (150.0, 250.0)}),
        ("screw_mode", {"screw_mode_hz": (70.0, 80.0)}),
        ("measurement_delay", {"eta": (0.9, 1.0)}),
    ],
)
def test_parts_are_bounded_too(part, ranges, controller, thor):
    plant = so.plants.moving_output(parts=[part])
    unknown = of(plant, thor, ranges)
    bounds = bracket(controller, plant, unknown)
    figures = batch_figures(controller, plant, unknown.nominal, unknown.values(draws(unknown, 500)))
    assert bounds.bounded_stable
    assert np.max(figures.ms) <= bounds.ms_upper <= 1.012 * bounds.ms_lower
    assert np.max(figures.mt) <= bounds.mt_upper <= 1.012 * bounds.mt_lower


def first_order(controller, params):
    """Return a lag with an uncertain gain, closed by proportional feedback without delay."""
    plant = so.Plant(
        name="lag", states={"x": "N"}, inputs={"I": "A"}, outputs={"F1": "N"},
        parameters={
            "K": Parameter(name="K", value=1.0, unit="N/A"), "tau": Parameter(name="tau", value=0.01, unit="s"),
        },
        f=lambda t, x, u, p: {"x": (p.K * u.I - x.x) / p.tau}, h=lambda t, x, u, p: {"F1": x.x},
    )  # fmt: skip
    return plant, replace(
        controller, law=law_of([3.0]), compute_delay_samples=0,
        command=replace(controller.command, per_effort=1.0),
        spec=so.ControllerSpec(bandwidth_hz=30),
    )  # fmt: skip


@pytest.mark.parametrize("tolerance", [0.1, 0.01, 0.001])
def test_a_lag_with_uncertain_gain_has_its_closed_form(tolerance, controller, thor):
    """x+ = a x + K (1 - a) u, u = -3 m: abs(S) peaks at z = -1, as (1 + a)/(1 + a - 3 K (1 - a))."""
    plant, lag = first_order(controller, thor)
    unknown = of(plant, so.ParameterSet(plant.defaults.values()), {"K": (1.0, 4.0)})
    bounds = bracket(lag, plant, unknown, budget=Budget(tolerance=tolerance))
    a = np.exp(-lag.sample_time_s / 0.01)
    exact = (1 + a) / (1 + a - 12.0 * (1 - a))
    assert bounds.bounded_stable
    assert exact <= bounds.ms_upper <= exact * (1.0 + tolerance + 1e-6)
    assert bounds.ms_lower == pytest.approx(exact, rel=1e-6)


def test_feedthrough_without_delay_is_bounded(controller, thor):
    """y = K u and u = -3 m: S = 1/(1 + 3 K), and a pole comes from infinity where 1 + 3 K = 0."""
    plant, lag = first_order(controller, thor)
    direct = so.Plant(
        name="direct", states=plant.states, inputs=plant.inputs, outputs=plant.outputs, parameters=plant.parameters,
        f=plant.f, h=lambda t, x, u, p: {"F1": p.K * u.I + 1e-3 * x.x},
    )  # fmt: skip
    unknown = of(direct, so.ParameterSet(plant.defaults.values()), {"K": (0.5, 2.0)})
    bounds = bracket(lag, direct, unknown)
    assert bounds.bounded_stable
    assert bounds.ms_upper == pytest.approx(0.4, rel=0.02)
    unknown = of(direct, so.ParameterSet(plant.defaults.values()), {"K": (-0.6, 0.5)})
    assert not bracket(lag, direct, unknown, budget=Budget(boxes=300)).bounded_stable


def test_a_jump_at_a_whole_sample_of_delay_is_covered(controller, stand, thor):
    """F2 follows the command at once: read before the command changes, it is a sample late for any delay above none."""
    on_f2 = replace(controller, spec=so.ControllerSpec(bandwidth_hz=30, measured="F2"))
    unknown = of(stand, thor, {"delay_s": (0.0, 1e-6)})
    figures = batch_figures(on_f2, stand, thor, {"delay_s": np.array([0.0, 1e-9])})
    assert figures.ms[0] > 1.002 * figures.ms[1]
    bounds = bracket(on_f2, stand, unknown, budget=Budget(tolerance=5e-4))
    assert figures.ms[0] <= bounds.ms_upper <= 1.001 * figures.ms[0]


def test_a_range_of_delay_begins_where_the_drives_ends(controller, stand, thor):
    """The same set of loops: 0.7 to 1.3 ms, all of it a range, or the last 0.6 ms beyond a drive's, given or ranged."""
    whole = bracket(controller, stand, of(stand, thor, {"delay_s": (0.7e-3, 1.3e-3)}))
    late = thor.with_parameters(Parameter(name="drive_delay_s", value=0.7e-3, unit="s"))
    for params, ranges in (
        (late, {"delay_s": (0.0, 0.6e-3)}), (thor, {"drive_delay_s": (0.7e-3, 1.0e-3), "delay_s": (0.0, 0.3e-3)}),
    ):  # fmt: skip
        parts = bracket(controller, stand, of(stand, params, ranges))
        assert parts.ms_upper == pytest.approx(whole.ms_upper, rel=1e-9)
        assert parts.bounded_stable


@pytest.mark.parametrize(
    ("name", "ranges"),
    [("swing", {"delay_s": (0.0, 1e-2)}), ("stand", {"eta": (0.01, 20.0)}), ("swing", {"delay_s": (6.6e-3, 6.7e-3)})],
)
def test_an_unstable_set_is_never_bounded_stable(name, ranges, controller, thor, request):
    plant = request.getfixturevalue(name)
    bounds = bracket(controller, plant, of(plant, thor, ranges), budget=Budget(boxes=200))
    assert not bounds.bounded_stable
    assert (bounds.ms_upper, bounds.mt_upper) == (np.inf, np.inf)
    assert "no bound" in repr(bounds)


@pytest.mark.slow
def test_a_budget_that_runs_out_leaves_bounds_that_hold(controller, swing, thor):
    unknown = of(swing, thor.prior(J=3.3e-7, b_r=2e-5), {"I_p": (0.3, 0.5)})
    figures = batch_figures(controller, swing, unknown.nominal, unknown.values(draws(unknown, 2000)))
    last = np.inf
    for boxes in (1, 130):
        bounds = bracket(controller, swing, unknown, budget=Budget(boxes=boxes))
        assert np.max(figures.ms) <= bounds.ms_upper <= last
        last = bounds.ms_upper
    assert last < 2.0


def test_nothing_uncertain_is_the_nominal_loop(controller, stand, thor):
    bounds = bracket(controller, stand, of(stand, thor, {}))
    nominal = controller.close(stand, thor).figures()
    assert nominal.ms <= bounds.ms_upper <= 1.011 * nominal.ms
    assert bounds.ms_lower == pytest.approx(nominal.ms, rel=1e-9)


def test_the_set_of_a_plant_is_the_shadow_of_the_fits(swing, stand, thor):
    """Every draw's parameters lie in the region, and its half axes are as long as the ellipsoid's."""
    unknown = of(swing, thor.prior(J=3.3e-8, b_r=2e-6, I_p=0.02), {"eta": (0.9, 1.0)})
    within = build_region(stand, unknown)
    assert set(within.names) == {"J", "b_r", "eta"}
    assert (within.ball, within.size) == (2, 3)
    values = unknown.values(draws(unknown, 3000))
    shape = within.slopes[:2, :2]
    y = np.linalg.solve(shape, np.array([values[n] for n in within.names[:2]]) - within.centre[:2, None])
    assert np.max(np.linalg.norm(y, axis=0)) == pytest.approx(1.0, abs=5e-3)


def test_physical_bounds_cut_the_set(stand, thor):
    """Half of the ellipsoid has negative friction, which no draw has: no box goes there."""
    within = build_region(stand, of(stand, thor.prior(b_r=1e-4), {}))
    boxes = within.cover(1e-3)
    low = within.evaluate(boxes.centre - boxes.radius)["b_r"]
    assert np.min(low) == pytest.approx(0.0, abs=1e-12)


def test_the_certificate_states_and_keeps_the_bounds(controller, swing, thor, tmp_path):
    ranges = {"I_p": (0.3, 0.5)}
    certificate = so.certify(
        controller, {"swing": swing}, thor, ranges=ranges, samples=50, bounds=Budget(), simulations=False
    )
    bounds = certificate.brackets["swing"]
    assert certificate.worst["swing"].ms <= bounds.ms_upper < 1.011 * certificate.worst["swing"].ms
    assert "bounded, rounding estimated: all stable, Ms below 1.5" in flatten(repr(certificate))
    content = json.loads(json.dumps(certificate.to_dict(), default=lambda array: array.tolist()))
    assert content["plants"]["swing"]["worst"]["bounded_stable"] is True
    again = so.robustness.Certificate.from_dict(content, controller, {"swing": swing}, thor)
    assert again.brackets == certificate.brackets
    plain = replace(certificate, brackets={})
    assert "ms_upper" not in plain.to_dict()["plants"]["swing"]["worst"]


def test_a_worse_plant_met_on_the_way_is_the_worst_case(controller, swing, thor):
    unknown = of(swing, thor, {"I_p": (0.1, 0.6)})
    mild = measure_worst(controller, swing, thor, {"I_p": 0.36})
    bounds = bracket(controller, swing, unknown, mild)
    assert bounds.ms_lower > mild.ms
    again = measure_worst(controller, swing, thor, bounds.parameters)
    assert again.ms == pytest.approx(bounds.ms_lower, rel=1e-9)


def test_what_cannot_be_enclosed_is_left_out(controller, stand, thor):
    import casadi as ca

    plant = so.Plant(
        name="odd", states=stand.states, inputs=stand.inputs, outputs=stand.outputs, parameters=stand.parameters,
        f=lambda t, x, u, p: stand.f(t, x, u, p) | {"q": x.qd * (1.0 + ca.erf(p.eta - 1.0))}, h=stand.h,
        friction=stand.friction,
    )  # fmt: skip
    bounds = bracket(controller, plant, of(plant, thor, {"eta": (0.9, 1.0)}))
    assert "erf" in bounds.left_out
    assert not bounds.bounded_stable
    assert "no bound: " in bounds.statement


def test_figures_are_rounded_up():
    bounds = Bracket(
        ms_lower=1.5, ms_upper=1.54401, mt_lower=1.2, mt_upper=12.3450001, bounded_stable=True, boxes=3
    )  # fmt: skip
    assert bounds.statement == "bounded, rounding estimated: all stable, Ms below 1.545, Mt below 12.35"


def test_a_search_ends_by_what_it_has_bounded_and_what_it_has_by_then_holds(controller, thor):
    """A slow machine and a fast one end at the same: no clock is asked."""
    swing = so.plants.moving_output()
    unknown = of(swing, thor.prior(J=3.3e-8, b_r=2e-6, eta=0.01), {"I_p": (0.3, 0.5)})
    figures = batch_figures(controller, swing, unknown.nominal, unknown.values(draws(unknown, 200)))
    first, last = (bracket(controller, swing, unknown, None, Budget(arcs=arcs)) for arcs in (1, 1_000_000))
    assert first.boxes < last.boxes
    assert not np.isfinite(first.ms_upper) or first.ms_upper >= last.ms_upper
    assert last.bounded_stable and np.max(figures.ms) <= last.ms_upper


@pytest.mark.parametrize("wrong", [{"tolerance": 0.0}, {"boxes": 0}, {"arcs": 0}])
def test_bad_budgets(wrong):
    with pytest.raises(ControlError, match="is not above 0"):
        Budget(**wrong)


@pytest.mark.parametrize("order", [("b_r", "J", "m_l", "k", "K_tau"), ("K_tau", "k", "m_l", "J", "b_r")])
def test_the_region_has_the_covariance_whatever_the_order(order, stand, thor):
    """Standard deviations from 2e-7 to 2e4, correlated: the axes times themselves are the covariance again."""
    std = {"b_r": 1e-5, "J": 2e-7, "m_l": 0.02, "k": 2e4, "K_tau": 2e-4}
    root = np.random.default_rng(2).normal(size=(5, 5))
    correlation = root @ root.T
    correlation /= np.sqrt(np.outer(np.diag(correlation), np.diag(correlation)))
    scale = np.array([std[name] for name in order])
    unknown = Uncertainty(
        nominal=stand.complete(thor), names=order, covariance=correlation * np.outer(scale, scale), ranges={}
    )
    within = build_region(stand, unknown)
    rows = within.slopes / scale[:, None] / np.sqrt(chi2.ppf(LEVEL, 5))
    np.testing.assert_allclose(rows @ rows.T, correlation, atol=1e-9)


@pytest.mark.parametrize("eta", [0.6, 1.5])
def test_a_range_of_no_width_is_that_value(eta, controller, stand, thor):
    """As if the value had been given, by the search and by the bound."""
    ranges = {"m_l": (0.5, 0.7)}
    pinned = combine_uncertainty(thor, so.ParameterSet(), ranges | {"eta": (eta, eta)}, {"stand": stand})
    updated = combine_uncertainty(thor.update(eta=eta), so.ParameterSet(), ranges, {"stand": stand})
    budget = Budget(boxes=50)
    bounds, expected = (bracket(controller, stand, unknown, None, budget) for unknown in (pinned, updated))
    assert bounds.bounded_stable
    assert bounds.ms_upper == pytest.approx(expected.ms_upper, rel=1e-9)
