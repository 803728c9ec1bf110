"""The certificate's claims, recomputed one by one and in python-control."""

from __future__ import annotations

import inspect
import json
import re
from dataclasses import replace

import control
import numpy as np
import pytest
from scipy.stats import beta, binom, binomtest

import seaopt as so
from seaopt.control.laws.friction import find_friction_margin
from seaopt.errors import ControlError
from seaopt.files import seal, to_json
from seaopt.parameters import Parameter
from seaopt.reporting.sections import write_html
from seaopt.robustness import batch_figures, failure_bound
from seaopt.robustness.certificate.cases import digest_laws
from seaopt.robustness.certificate.friction import friction_requirements
from seaopt.robustness.certificate.simulated import STEPS
from seaopt.robustness.uncertainty.draws import Uncertainty, check_ranges
from tests.checks import leave_out
from tests.laws import scaled
from tests.words import flatten

SPEC = so.ControllerSpec(
    bandwidth_hz=30, max_sensitivity=1.6, max_complementary=1.3, max_reference_peak=1.3, max_noise_gain=25
)

NOISE = so.Sensors(noise_std={"F1": 2.0})


@pytest.fixture(scope="module")
def controller(stand, swing, thor):
    corners = {f"I_p = {v}": (swing, thor.update(I_p=v)) for v in (0.2, 0.6)}
    return so.tune(stand, thor, SPEC, robust_to={"swing": swing, **corners})


@pytest.fixture(scope="module")
def certificate(controller, stand, swing, thor):
    params, plants = thor.prior(J=2e-9, b_r=2e-7, eta=1e-4), {"stand": stand, "swing": swing}
    return so.certify(
        controller,
        plants,
        params,
        ranges={"I_p": (0.2, 0.6)},
        samples=1375,
        max_failure_probability=0.01,
        simulations=False,
    )


@pytest.fixture
def linear(without_steps):
    """Let a test's certificates have no simulated steps."""
    with without_steps():
        yield


def test_it_passes_with_the_stated_bound(certificate):
    assert certificate.passed
    assert certificate.monte_carlo.failures == 0
    assert certificate.monte_carlo.failure_probability_bound < 0.01001
    assert "passed" in repr(certificate)


def test_what_takes_long_is_left_out_where_a_requirement_is_broken_and_only_there(controller, stand, swing, thor):
    strict, options = replace(controller, spec=replace(SPEC, max_sensitivity=1.1)), {"samples": 20, "sensors": NOISE}
    for law, holds in ((controller, True), (strict, False)):
        whole, brief = (so.certify(law, {"swing": swing}, thor, **options, thorough=each) for each in (True, False))
        assert whole.met is brief.met is holds
        if holds:
            assert brief.requirements == whole.requirements and brief.remarks == whole.remarks
            continue
        kept = {"nominal", "drawn"}
        assert brief.requirements == tuple(row for row in whole.requirements if row.scope in kept)
        assert (
            whole.simulated is not None
            and brief.simulated is None
            and len(brief.requirements) < len(whole.requirements)
        )
        assert "what takes long was left out" in " ".join(repr(brief).split())


def test_every_requirement_says_of_which_plants_and_at_which_risk(certificate):
    draws = certificate.monte_carlo
    said = {row.name: (row.scope, row.risk) for row in certificate.requirements}
    assert said["max_sensitivity"] == ("nominal", None) and said["step_settling_s"] == ("simulated", None)
    wrong = binom.cdf(draws.failures, draws.samples, draws.failure_probability_bound)  # had it the bound, so few fail
    for name in ("monte_carlo_failures", "max_failure_probability"):
        assert said[name] == ("drawn", pytest.approx(wrong, rel=1e-3))
    assert [row["scope"] for row in certificate.to_dict()["requirements"]] == [
        row.scope for row in certificate.requirements
    ]
    assert "drawn, risk 1e-06" in write_html(certificate)


def test_every_requirement_carries_its_numbers(certificate):
    names = {(item.name, item.where) for item in certificate.requirements}
    assert ("max_sensitivity", "swing") in names
    assert ("spectral_radius", "stand") in names
    assert all(item.met for item in certificate.requirements)
    content = certificate.to_dict()
    assert content["schema"] == "seaopt/robustness/3"
    assert set(content["plants"]["swing"]["worst"]["parameters"]) == {"J", "b_r", "eta", "I_p"}


def test_the_swing_plants_loop_is_python_controls(controller, swing, thor, certificate):
    """Hold, delay and loop in python-control: eigenvalues of the feedback connection and the peak of S."""
    ts = controller.sample_time_s
    model = swing.linearize(thor)[0, 0] * controller.command.per_effort
    plant = control.sample_system(model, ts, method="zoh")
    c_y = control.tf(controller.measurement.num, controller.measurement.den, ts)
    loop = control.ss(plant) * control.ss(c_y) * control.ss(control.tf([1], [1, 0], ts))
    closed = control.feedback(loop, 1)
    figures = certificate.plants["swing"]
    assert np.abs(closed.poles()).max() == pytest.approx(figures.spectral_radius, rel=1e-6)
    w = 2 * np.pi * np.geomspace(0.1, 499, 10_000)
    s = 1 / (1 + loop(np.exp(1j * w * ts)))
    assert figures.ms == pytest.approx(np.abs(s).max(), rel=1e-4)


def test_the_batch_is_the_one_by_one_path(controller, swing, thor):
    rng = np.random.default_rng(0)
    draws = {"I_p": rng.uniform(0.2, 0.6, 60), "J": 3.31e-6 * rng.uniform(0.7, 1.4, 60), "d": rng.uniform(0, 1, 60)}
    found = batch_figures(controller, swing, thor, draws)
    for k in range(60):
        figures = controller.close(swing, thor.update(**{n: float(v[k]) for n, v in draws.items()})).figures()
        assert found.ms[k] == pytest.approx(figures.ms, rel=1e-6)
        assert found.mt[k] == pytest.approx(figures.mt, rel=1e-6)
        assert found.spectral_radius[k] == pytest.approx(figures.spectral_radius, rel=1e-9)


def test_the_worst_draw_is_a_witness(certificate, controller, swing, thor):
    worst = certificate.worst["swing"]
    again = controller.close(swing, thor.update(**worst.parameters)).figures()
    assert (again.ms, again.mt) == (pytest.approx(worst.witness.ms), pytest.approx(worst.witness.mt))
    assert worst.ms >= certificate.plants["swing"].ms


def test_a_controller_that_fails_is_named_with_its_witness(controller, stand, thor):
    certificate = so.certify(
        controller, {"stand": stand}, thor, ranges={"eta": (0.5, 4.0)}, samples=200, simulations=False
    )
    assert not certificate.passed
    assert certificate.monte_carlo.failures > 0
    broken = [item for item in certificate.requirements if not item.met]
    assert broken[0].name == "monte_carlo_failures"
    assert all("eta =" in item.where for item in broken)  # the others are steps at that worst draw
    assert repr(certificate).startswith("not met")


@pytest.mark.usefixtures("linear")
def test_an_unstable_draw_is_a_failure(controller, stand, thor):
    certificate = so.certify(
        controller, {"stand": stand}, thor, ranges={"eta": (20.0, 21.0)}, samples=20, simulations=False
    )
    assert certificate.monte_carlo.failures == 20
    assert np.isinf(certificate.worst["stand"].ms)
    assert certificate.to_dict()["monte_carlo"]["failure_probability_bound"] == 1.0


@pytest.mark.parametrize(("n", "k"), [(1375, 0), (688, 0), (1000, 3), (50, 50)])
def test_the_bound_is_clopper_pearson(n, k):
    expected = 1.0 if k == n else beta.ppf(1 - 1e-6, k + 1, n - k)
    searched = binomtest(k, n, alternative="less").proportion_ci(1 - 1e-6, method="exact").high
    assert failure_bound(n, k, 1 - 1e-6) == pytest.approx(expected, rel=1e-9) == pytest.approx(searched, rel=1e-9)


@pytest.mark.usefixtures("linear")
def test_fit_covariance_drives_the_draws(controller, stand, swing, short_log, thor):
    fit = so.fit([so.Experiment(plant=stand, log=short_log, outputs=("F1", "F2"))], thor.free("J", "b_r", "eta"))
    certificate = so.certify(controller, {"stand": stand, "swing": swing}, fit, samples=100, simulations=False)
    assert certificate.passed
    assert set(certificate.worst["stand"].parameters) == {"J", "b_r", "eta"}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"ranges": {"I_q": (0, 1)}}, "I_q"),
        ({"ranges": {"I_p": (1, 0)}}, "empty"),
        ({"ranges": {"I_p": (-1, 1)}}, "bounds"),
        ({"samples": 0}, "samples"),
        ({"confidence": 1.5}, "confidence"),
    ],
)
def test_bad_input(controller, swing, thor, options, words):
    with pytest.raises(ControlError, match=words):
        so.certify(controller, {"swing": swing}, thor, **options)


@pytest.mark.parametrize(
    ("ranges", "words"),
    [
        ({"I_p": 0.3}, "range of I_p = 0.3 is not a range; give (low, high)"),
        ({"I_p": (0.2,)}, "range of I_p = (0.2,) is not a range; give (low, high)"),
        ({"I_p": (0.2, "0.3")}, "range of I_p = (0.2, '0.3') is not a range; give (low, high)"),
        ({"I_p": None}, "range of I_p = None is not a range; give (low, high)"),
        (["I_p"], "ranges is a list; give a mapping of name to (low, high)"),
    ],
)
def test_what_is_no_range_is_told_in_one_line(swing, ranges, words):
    """As without the type checks of the tests."""
    with pytest.raises(ControlError) as raised:
        inspect.unwrap(check_ranges)(ranges, {"swing": swing})
    assert str(raised.value) == words


def test_an_unidentifiable_fit_is_not_certified(controller, stand, short_log, thor):
    fit = so.fit([so.Experiment(plant=stand, log=short_log)], thor.free("J", "eta", "K_tau"), diagnostics=False)
    with pytest.raises(ControlError, match="not identifiable"):
        so.certify(controller, {"stand": stand}, fit)


def test_the_law_alone_is_certified(controller, stand, thor):
    """Halve the law: the design figures are of the halved law, not of what was tuned."""
    from dataclasses import replace

    certificate = so.certify(
        replace(controller, law=scaled(controller.law, 0.5)), {"stand": stand}, thor, simulations=False
    )
    (row,) = [item for item in certificate.requirements if item.name == "bandwidth_hz"]
    assert not row.met
    assert row.value < 20


def test_nothing_uncertain_is_no_statement(controller, stand, thor):
    certificate = so.certify(controller, {"stand": stand}, thor, simulations=False)
    assert certificate.monte_carlo.samples == 0
    assert certificate.monte_carlo.failure_probability_bound == 1.0
    assert "nothing is uncertain" in flatten(repr(certificate))


def test_fits_that_cannot_be_trusted(controller, stand, short_log, thor):
    bench = so.Experiment(plant=stand, log=short_log, outputs=("F1", "F2"))
    method = so.OutputError(search=False, max_iterations=2)
    stopped = so.fit([bench], thor.update(J=1e-6, b_r=1e-3).free("J", "b_r"), method=method)
    assert stopped.status != "converged"
    with pytest.raises(ControlError, match=r"has not converged .*fit again \(seaopt fit PROBLEM"):
        so.certify(controller, {"stand": stand}, stopped)
    good = so.fit([bench], thor.free("J"))
    with pytest.raises(ControlError, match="give the Fit itself"):
        so.certify(controller, {"stand": stand}, good.parameters)


@pytest.mark.usefixtures("linear")
def test_a_parameter_on_its_bound_is_drawn_from_one_side(controller, stand, short_log, thor):
    start = thor.update(J=5e-6).free("J", "b_r").bound(J=(3.3101e-6, 1e-5))
    fit = so.fit([so.Experiment(plant=stand, log=short_log, outputs=("F1", "F2"))], start)
    certificate = so.certify(controller, {"stand": stand}, fit, samples=200, simulations=False)
    assert certificate.worst["stand"].parameters["J"] >= 3.3101e-6


@pytest.mark.usefixtures("linear")
def test_a_known_parameters_prior_is_drawn_too(controller, stand, short_log, thor):
    from dataclasses import replace

    known = thor.free("J").with_parameters(replace(thor["k"], prior_std=5e3))
    fit = so.fit([so.Experiment(plant=stand, log=short_log, outputs=("F1", "F2"))], known)
    certificate = so.certify(controller, {"stand": stand}, fit, samples=50, simulations=False)
    assert set(certificate.worst["stand"].parameters) == {"J", "k"}


def test_draws_have_the_fits_covariance_whatever_the_units_and_the_order():
    """Entries from 1e-13 to 1e9 in an order that a factor of the covariance itself would lose."""
    std = np.array([3e4, 1e-7, 1e-5, 2e-9])
    rng = np.random.default_rng(5)
    root = rng.normal(size=(4, 4))
    correlation = root @ root.T
    correlation /= np.sqrt(np.outer(np.diag(correlation), np.diag(correlation)))
    covariance = correlation * np.outer(std, std)
    names = ("k_b", "J", "b_r", "c_b")
    nominal = so.ParameterSet(Parameter(name=name, value=0.0, unit="-") for name in names)
    unknown = Uncertainty(nominal=nominal, names=names, covariance=covariance, ranges={})
    points = np.eye(4)
    moved = unknown.values(points)
    still = unknown.values(0.0 * points)
    factor = np.stack([moved[name] - still[name] for name in names])
    np.testing.assert_allclose(factor @ factor.T / np.outer(std, std), correlation, atol=1e-12)


def test_the_design_plant_is_certified_though_nobody_lists_it(controller, stand, swing, thor):
    """A law whose own plant breaks the limit on a draw must not pass on another plant alone."""
    heavy = {"J": (3.31e-6, 6e-6)}
    alone = so.certify(controller, {"swing": swing}, thor, ranges=heavy, samples=50, simulations=False)
    listed = so.certify(
        controller, {"design": stand, "swing": swing}, thor, ranges=heavy, samples=50, simulations=False
    )
    assert list(alone.plants) == ["design", "swing"]
    assert alone.worst["design"].ms == pytest.approx(listed.worst["design"].ms, rel=1e-9)
    assert alone.monte_carlo == listed.monte_carlo
    again = so.robustness.Certificate.from_dict(alone.to_dict(), controller, {"swing": swing}, alone.parameters)
    assert repr(again) == repr(alone)


@pytest.mark.usefixtures("linear")
def test_another_law_meets_other_draws(controller, stand, thor):
    """A law tuned with the worst draws of a certificate must not be certified on the same draws."""
    softer = replace(controller, law=scaled(controller.law, 1.0, 0.9))
    points = [
        so.certify(law, {"stand": stand}, thor, ranges={"eta": (0.9, 1.0)}, samples=1, seed=seed, simulations=False)
        for law, seed in ((controller, 1), (controller, 1), (controller, 2), (softer, 1))
    ]
    assert len({digest_laws(controller), digest_laws(softer)}) == 2
    assert repr(points[0]) == repr(points[1])
    assert points[0].monte_carlo != points[2].monte_carlo


@pytest.mark.slow
def test_failures_are_told_apart(controller, stand, swing, thor):
    """Eigenvalues and peaks of each draw, one by one, against the counts."""
    ranges = {"I_p": (0.002, 0.6), "delay_s": (0.0, 2e-3)}
    found = so.certify(
        controller, {"stand": stand, "swing": swing}, thor, ranges=ranges, samples=300, simulations=False
    ).monte_carlo
    assert found.unstable + found.over_ms + found.over_mt == found.failures
    assert min(found.unstable, found.over_ms) > 0
    assert f"{found.unstable} unstable" in str(found)


def test_what_is_varied_is_stated(certificate, controller, stand, swing):
    told = {item.name: item for item in certificate.varied}
    assert (told["I_p"].low, told["I_p"].high, told["I_p"].std, told["I_p"].unit) == (0.2, 0.6, None, "kg m^2")
    assert told["J"].std == pytest.approx(2e-9)
    assert re.search(r"I_p +uniform .* 0\.2 +0\.6 +kg m\^2", repr(certificate))
    plants = {"stand": stand, "swing": swing}
    again = so.robustness.Certificate.from_dict(certificate.to_dict(), controller, plants, certificate.parameters)
    assert again.varied == certificate.varied


def test_an_edited_verdict_is_not_believed(certificate, controller, stand, swing):
    content = certificate.to_dict()
    content["requirements"][0]["met"] = False
    plants = {"stand": stand, "swing": swing}
    with pytest.raises(so.SeaoptError, match="was edited"):
        so.robustness.Certificate.from_dict(content, controller, plants, certificate.parameters)
    again = so.robustness.Certificate.from_dict(seal(content), controller, plants, certificate.parameters)
    assert not again.passed


@pytest.mark.usefixtures("linear")
def test_a_nominal_value_outside_its_range_is_noted(controller, swing, thor):
    found = so.certify(controller, {"swing": swing}, thor, ranges={"I_p": (0.5, 0.6)}, samples=5, simulations=False)
    assert "I_p = 0.36 lies outside its range of 0.5 to 0.6" in found.notes[0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"seed": -1}, "seed = -1"),
        ({"ranges": {"I_p": (True, 2)}}, "give \\(low, high\\)"),
        ({"ranges": {"phi": (-30, 30)}}, "angles are in rad"),
        ({"ranges": {"delay_s": (0, 0.5)}}, "500 samples"),
        ({"min_rate": 5.0}, "min_rate = 5 is of a schedule"),
    ],
)
def test_bad_numbers_are_told_in_one_line(controller, swing, thor, options, words):
    with pytest.raises(ControlError, match=words):
        so.certify(controller, {"swing": swing}, thor, **{"samples": 5, **options})


def test_a_range_beyond_the_given_sets_own_bounds(controller, swing, thor):
    narrow = thor.with_parameters(replace(thor["I_p"], max=0.5))
    with pytest.raises(ControlError, match="of the given parameters"):
        so.certify(controller, {"swing": swing}, narrow, ranges={"I_p": (0.2, 0.6)}, samples=5)


def test_the_bound_is_required_where_it_is_asked_for(certificate, controller, stand, thor):
    """1375 draws without a failure bound it by 1 % (ln(1e6)/ln(1/0.99) = 1374.6); 50 by 24 %, which is noted."""
    assert certificate.passed and any(row.name == "max_failure_probability" for row in certificate.requirements)
    options = {"ranges": {"eta": (0.9, 1.0)}, "max_failure_probability": 0.01}
    few = so.certify(controller, {"stand": stand}, thor, samples=50, **options, simulations=False)
    (row,) = [item for item in few.requirements if not item.met]
    assert (row.name, row.limit) == ("max_failure_probability", 0.01)
    assert row.value == pytest.approx(1.0 - 1e-6 ** (1 / 50), rel=1e-9)
    assert "1375 draws without a failure would do" in row.where
    assert "below 0.24" in few.notes[-1]
    assert not so.certify(
        controller, {"stand": stand}, thor, max_failure_probability=0.01, simulations=False
    ).passed  # nothing is drawn


@pytest.mark.usefixtures("linear")
def test_values_in_other_units_are_the_same_values(controller, stand, thor):
    """646 g known within 1 g, and 0.2 ms of delay."""
    late = [Parameter(name="delay_s", value=value, unit=unit) for value, unit in ((2e-4, "s"), (0.2, "ms"))]
    kilograms = thor.with_parameters(replace(thor["m_l"], prior_std=1e-3), late[0])
    grams = Parameter(name="m_l", value=646.0, unit="g", prior_std=1.0, min=0.0)
    found = [
        so.certify(controller, {"stand": stand}, params, ranges={"eta": (0.9, 1.0)}, samples=50, simulations=False)
        for params in (kilograms, thor.with_parameters(grams, late[1]))
    ]
    assert found[1].worst["stand"].ms == pytest.approx(found[0].worst["stand"].ms, rel=1e-9)
    assert found[1].worst["stand"].parameters == pytest.approx(found[0].worst["stand"].parameters, rel=1e-9)
    told = [next(item for item in each.varied if item.name == "m_l") for each in found]
    assert told[1].std == pytest.approx(told[0].std)


@pytest.mark.usefixtures("linear")
def test_a_ranged_parameter_that_nobody_gave_has_its_default(controller, stand, swing):
    """A set with the stand's names alone: the swing's inertia is the plant's, inside its range."""
    stands = stand.complete(so.plants.thor())
    found = so.certify(controller, {"swing": swing}, stands, ranges={"I_p": (0.3, 0.4)}, samples=5, simulations=False)
    (told,) = found.varied
    assert told.value == 0.36
    assert not told.outside


@pytest.fixture(scope="module")
def rubbing():
    """The actuator of a published complaint: certified at rest, it rang when its friction let go."""
    return so.plants.thor().update(
        k=120e3, m_l=0.9, l=0.005, N_p=1, K_tau=0.075, J=1.2e-5, b_r=2.5e-4, eta=0.86, f_c=25, v_s=0.004
    )


def test_a_plant_with_friction_is_certified_sliding_and_stuck(stand, rubbing):
    """Its figures are those of the loops with viscous friction of no slope, and of f_c/v_s, computed by hand."""
    spec = so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6, max_noise_gain=25, compute_delay_samples=2)
    controller = so.tune(stand, rubbing.update(f_c=0.0), spec)
    certificate = so.certify(controller, {"stand": stand}, rubbing, samples=10, simulations=False)
    assert list(certificate.plants) == ["stand sliding", "stand stuck"]
    radius = rubbing["l"].value / (2 * np.pi * rubbing["N_p"].value)
    for state, slope in (("sliding", 0.0), ("stuck", 25 / 0.004)):
        viscous = rubbing.update(f_c=0.0, b_r=2.5e-4 + slope * radius**2)
        expected = controller.close(stand, viscous).figures()
        assert certificate.plants[f"stand {state}"].ms == pytest.approx(expected.ms, rel=1e-8)
        assert certificate.plants[f"stand {state}"].mt == pytest.approx(expected.mt, rel=1e-8)
    assert not certificate.passed
    assert any(
        row.name == "max_sensitivity" and "stuck" in row.where for row in certificate.requirements if not row.met
    )
    tuned = json.loads(to_json(controller.to_dict()))
    assert tuned["feasible"] and type(controller).from_dict(tuned, stand, rubbing.update(f_c=0.0)).feasible
    assert not type(controller).from_dict(tuned, stand, rubbing).feasible
    content = certificate.to_dict()
    assert content["friction"]["stand"]["sector_stable"] is True
    again = type(certificate).from_dict(content, controller, {"stand": stand}, certificate.parameters)
    assert list(again.plants) == list(certificate.plants)
    assert again.friction == certificate.friction


@pytest.mark.slow
def test_stability_with_friction_is_shown_over_draws_and_may_be_required(stand, thor):
    """Viscous friction is in the sector: at every draw the loop with the least slope shown has stable eigenvalues."""
    rubbing = thor.update(f_c=50.0)
    controller = so.tune(stand, rubbing, so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6, max_noise_gain=25))
    ranges = {"eta": (0.8, 1.1), "f_c": (20.0, 80.0)}
    certificate = so.certify(
        controller, {"stand": stand}, rubbing, ranges=ranges, samples=20, min_friction_margin=1e4, simulations=False
    )
    drawn = certificate.friction_draws["stand"]
    assert (drawn.samples, drawn.shown) == (20, 20)
    assert drawn.least_slope == pytest.approx(drawn.factor * drawn.parameters["f_c"] / rubbing["v_s"].value)
    radius = thor["l"].value / (2 * np.pi * thor["N_p"].value)
    for eta in (0.8, 1.1, drawn.parameters["eta"]):
        viscous = thor.update(eta=eta, b_r=thor["b_r"].value + drawn.least_slope * radius**2)
        assert np.max(np.abs(controller.close(stand, viscous).eigenvalues())) < 1.0
    (row,) = [row for row in certificate.requirements if row.name == "min_friction_margin"]
    assert row.met and row.sense == "≥" and row.value == min(drawn.least_slope, *certificate.friction["stand"].slopes)
    again = type(certificate).from_dict(certificate.to_dict(), controller, {"stand": stand}, certificate.parameters)
    assert again.friction_draws == certificate.friction_draws


def margin_rows(certificate):
    return [row for row in certificate.requirements if row.name == "min_friction_margin"]


@pytest.fixture(scope="module")
def smooth(stand, thor):
    """Return a law tuned without friction, and its parameters."""
    values = thor.update(v_s=4e-3)
    return so.tune(stand, values, so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6)), values


def test_friction_at_draws_alone_is_looked_at_too(stand, smooth):
    """The draws' proof is that of the same law at the worst draw's parameters, with friction nominal there."""
    controller, values = smooth
    ranges = {"f_c": (0.0, 50.0)}
    certificate = so.certify(
        controller, {"stand": stand}, values, ranges=ranges, samples=10, min_friction_margin=1e6, simulations=False
    )
    (row,) = margin_rows(certificate)
    drawn = certificate.friction_draws["stand"]
    assert not row.met and not certificate.passed
    assert drawn.samples == 10 and row.value == drawn.least_slope
    there = find_friction_margin(controller, stand, values.update(**drawn.parameters))
    assert there.least_slope == pytest.approx(row.value, rel=1e-3)
    (lower,) = friction_requirements({}, certificate.friction_draws, 1e4, "N s/m")
    assert lower.met
    assert "friction: none" in flatten(repr(certificate))
    assert certificate.to_dict()["friction"]["stand"]["draws"]["least_slope"] == row.value


def test_without_friction_a_margin_that_is_asked_says_so(stand, smooth):
    controller, values = smooth
    certificate = so.certify(controller, {"stand": stand}, values, min_friction_margin=1e6, simulations=False)
    (row,) = margin_rows(certificate)
    assert row.met and np.isinf(row.value) and "no friction" in row.where


def test_the_larger_of_two_friction_margins_is_required(stand, smooth):
    controller, values = smooth
    rubbing = values.update(f_c=50.0)
    asking = replace(controller, spec=replace(controller.spec, min_friction_margin=1e9))
    certificate = so.certify(asking, {"stand": stand}, rubbing, min_friction_margin=10.0, simulations=False)
    (row,) = margin_rows(certificate)
    assert row.limit == 1e9 and not row.met and not certificate.passed


def test_the_tuner_keeps_the_limits_sliding_and_stuck(stand, thor):
    rubbing = thor.update(f_c=5.0)
    controller = so.tune(
        stand, rubbing, so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_reference_peak=1.4)
    )
    assert controller.feasible
    radius = thor["l"].value / (2 * np.pi * thor["N_p"].value)
    for slope in (0.0, 5.0 / thor["v_s"].value):
        figures = controller.close(stand, thor.update(b_r=thor["b_r"].value + slope * radius**2)).figures()
        assert figures.stable and figures.ms <= 1.6 * (1 + 1e-6) and figures.reference_peak <= 1.4 * (1 + 1e-6)
    assert controller.achieved.bandwidth_hz == pytest.approx(30, rel=5e-3)


@pytest.mark.slow
def test_a_friction_margin_below_the_curves_own_slope_is_required_over_draws_too(stand, rubbing, monkeypatch):
    """Of nearly Coulomb's jump nothing is shown, a flatter curve is; at draws as at the nominal parameters."""
    # Simulated steps have no part in a margin, and take a minute on friction this sharp.
    leave_out(monkeypatch, STEPS)
    spec = so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6, compute_delay_samples=2)
    controller, sharp = so.tune(stand, rubbing, spec), rubbing.update(v_s=1e-6)
    asked = {"ranges": {"eta": (0.4, 3.0)}, "samples": 3}
    certificate = so.certify(controller, {"stand": stand}, sharp, min_friction_margin=1e3, **asked, simulations=False)
    margin, drawn = certificate.friction["stand"], certificate.friction_draws["stand"]
    assert not margin.shown and (drawn.samples, drawn.shown) == (3, 0)
    (row,) = [row for row in certificate.requirements if row.name == "min_friction_margin"]
    assert row.value == min(*margin.slopes, drawn.least_slope) < margin.slopes[0]
    assert so.certify(controller, {"stand": stand}, sharp, **asked, simulations=False).friction_draws == {}
