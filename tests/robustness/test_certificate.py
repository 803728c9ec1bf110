"""The certificate's claims, recomputed one by one and in python-control."""

from __future__ import annotations

import inspect

import control
import numpy as np
import pytest
from scipy.stats import beta

import seaopt as so
from seaopt.errors import ControlError
from seaopt.robustness import batch_figures, failure_bound
from seaopt.robustness.draws import check_ranges

SPEC = so.ControllerSpec(
    bandwidth_hz=30, max_sensitivity=1.6, max_complementary=1.3, max_reference_peak=1.3, max_noise_gain=25
)


@pytest.fixture(scope="module")
def controller(stand, swing, thor):
    corners = {f"I_p = {v}": (swing, thor.update(I_p=v)) for v in (0.2, 0.6)}
    return so.tune(stand, thor, SPEC, robust_to={"swing": swing, **corners})


@pytest.fixture(scope="module")
def certificate(controller, stand, swing, thor):
    params = thor.prior(J=2e-9, b_r=2e-7, eta=1e-4)
    return so.certify(controller, {"stand": stand, "swing": swing}, params, ranges={"I_p": (0.2, 0.6)}, samples=1375)


def test_it_passes_with_the_stated_bound(certificate):
    assert certificate.passed
    assert certificate.monte_carlo.failures == 0
    assert certificate.monte_carlo.failure_probability_bound < 0.01001
    assert "passed" in repr(certificate)


def test_every_requirement_carries_its_numbers(certificate):
    names = {(item.name, item.where) for item in certificate.requirements}
    assert ("max_sensitivity", "swing") in names
    assert ("spectral_radius", "stand") in names
    assert all(item.met for item in certificate.requirements)
    content = certificate.to_dict()
    assert content["schema"] == "seaopt/robustness/1"
    assert set(content["plants"]["swing"]["worst"]["parameters"]) == {"J", "b_r", "eta", "I_p"}


def test_the_swing_plants_loop_is_python_controls(controller, swing, thor, certificate):
    """Hold, delay and loop in python-control: eigenvalues of the feedback connection and the peak of S."""
    ts = controller.sample_time_s
    model = swing.linearize(thor)[0, 0] * controller.current_per_force_A_per_N
    plant = control.sample_system(model, ts, method="zoh")
    c_y = control.tf(controller.measurement.num, controller.measurement.den, ts)
    loop = control.ss(plant) * control.ss(c_y) * control.ss(control.tf([1], [1, 0], ts))
    closed = control.feedback(loop, 1)
    figures = certificate.plants["swing"]
    assert np.abs(closed.poles()).max() == pytest.approx(figures.spectral_radius, rel=1e-6)
    w = 2 * np.pi * np.geomspace(0.1, 499, 40_000)
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
    assert (again.ms, again.mt) == (pytest.approx(worst.ms), pytest.approx(worst.mt))
    assert worst.ms >= certificate.plants["swing"].ms


def test_a_controller_that_fails_is_named_with_its_witness(controller, swing, thor):
    certificate = so.certify(controller, {"swing": swing}, thor, ranges={"eta": (0.5, 4.0)}, samples=200)
    assert not certificate.passed
    assert certificate.monte_carlo.failures > 0
    (broken,) = [item for item in certificate.requirements if not item.met]
    assert broken.name == "monte_carlo_failures"
    assert "eta =" in broken.where
    assert "NOT MET" in repr(certificate)


def test_an_unstable_draw_is_a_failure(controller, stand, thor):
    certificate = so.certify(controller, {"stand": stand}, thor, ranges={"eta": (20.0, 21.0)}, samples=20)
    assert certificate.monte_carlo.failures == 20
    assert np.isinf(certificate.worst["stand"].ms)
    assert certificate.to_dict()["monte_carlo"]["failure_probability_bound"] == 1.0


@pytest.mark.parametrize(("n", "k"), [(1375, 0), (688, 0), (1000, 3), (50, 50)])
def test_the_bound_is_clopper_pearson(n, k):
    expected = 1.0 if k == n else beta.ppf(1 - 1e-6, k + 1, n - k)
    assert failure_bound(n, k, 1 - 1e-6) == pytest.approx(expected, rel=1e-9)


def test_fit_covariance_drives_the_draws(controller, stand, swing, short_log, thor):
    fit = so.fit([so.Experiment(plant=stand, log=short_log, outputs=("F1", "F2"))], thor.free("J", "b_r", "eta"))
    certificate = so.certify(controller, {"stand": stand, "swing": swing}, fit, samples=100)
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
    fit = so.fit([so.Experiment(plant=stand, log=short_log)], thor.free("J", "eta", "K_tau"))
    with pytest.raises(ControlError, match="not identifiable"):
        so.certify(controller, {"stand": stand}, fit)


def test_the_law_alone_is_certified(controller, stand, thor):
    """Halve both transfer functions: the design figures are of the halved law, not of what was tuned."""
    from dataclasses import replace

    from seaopt.control import TransferFunction

    halved = {n: TransferFunction(num=0.5 * getattr(controller, n).num, den=getattr(controller, n).den)
              for n in ("reference", "measurement")}  # fmt: skip
    certificate = so.certify(replace(controller, **halved), {"stand": stand}, thor)
    (row,) = [item for item in certificate.requirements if item.name == "bandwidth_hz"]
    assert not row.met
    assert row.value < 20


def test_nothing_uncertain_is_no_statement(controller, stand, thor):
    certificate = so.certify(controller, {"stand": stand}, thor)
    assert certificate.monte_carlo.samples == 0
    assert certificate.monte_carlo.failure_probability_bound == 1.0
    assert "nothing is uncertain" in repr(certificate)


def test_fits_that_cannot_be_trusted(controller, stand, short_log, thor):
    bench = so.Experiment(plant=stand, log=short_log, outputs=("F1", "F2"))
    method = so.OutputError(search=False, max_iterations=2)
    stopped = so.fit([bench], thor.update(J=1e-6, b_r=1e-3).free("J", "b_r"), method=method)
    assert stopped.status != "converged"
    with pytest.raises(ControlError, match="has not converged"):
        so.certify(controller, {"stand": stand}, stopped)
    good = so.fit([bench], thor.free("J"))
    with pytest.raises(ControlError, match="give the Fit itself"):
        so.certify(controller, {"stand": stand}, good.parameters)


def test_a_parameter_on_its_bound_is_drawn_from_one_side(controller, stand, short_log, thor):
    start = thor.update(J=5e-6).free("J", "b_r").bound(J=(3.3101e-6, 1e-5))
    fit = so.fit([so.Experiment(plant=stand, log=short_log, outputs=("F1", "F2"))], start)
    certificate = so.certify(controller, {"stand": stand}, fit, samples=200)
    assert certificate.worst["stand"].parameters["J"] >= 3.3101e-6


def test_a_known_parameters_prior_is_drawn_too(controller, stand, short_log, thor):
    from dataclasses import replace

    known = thor.free("J").with_parameters(replace(thor["k"], prior_std=5e3))
    fit = so.fit([so.Experiment(plant=stand, log=short_log, outputs=("F1", "F2"))], known)
    certificate = so.certify(controller, {"stand": stand}, fit, samples=50)
    assert set(certificate.worst["stand"].parameters) == {"J", "k"}
