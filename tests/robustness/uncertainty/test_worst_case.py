"""Conditions, worst cases and batches: recomputed one by one, by scipy's global search, and from other models."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

import seaopt as so
from seaopt.control import Loop
from seaopt.control.loops.margins import margins, nu_gap
from seaopt.errors import ControlError
from seaopt.parameters import Parameter
from seaopt.robustness import batch_figures, place_value, plant_margins
from seaopt.robustness.uncertainty import batch

SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6)


@pytest.fixture(scope="module")
def controller(robust_controller):
    return robust_controller


@pytest.fixture(scope="module")
def progress():
    """Return the calls of the certificate's progress."""
    return []


@pytest.fixture(scope="module")
def certificate(controller, swing, thor, progress):
    return so.certify(
        controller, {"swing": swing}, thor, ranges={"I_p": (0.15, 0.6)}, samples=50, seed=1,
        progress=lambda *each: progress.append(each),
        simulations=False,
    )  # fmt: skip


def with_(params, name, value, unit):
    return params.with_parameters(Parameter(name=name, value=value, unit=unit))


def test_a_batch_with_conditions_is_the_one_by_one_path(controller, swing, thor):
    rng = np.random.default_rng(0)
    draws = {
        "I_p": rng.uniform(0.2, 0.6, 25), "d": rng.uniform(0, 2e-3, 25), "phi": rng.uniform(-0.8, 0.8, 25),
        "delay_s": rng.uniform(0, 2.5e-3, 25),
    }  # fmt: skip
    batched = batch_figures(controller, swing, thor, draws)
    for k in range(25):
        at = thor.update(I_p=float(draws["I_p"][k]), d=float(draws["d"][k]))
        at = with_(with_(at, "phi", float(draws["phi"][k]), "rad"), "delay_s", float(draws["delay_s"][k]), "s")
        figures = controller.close(swing, at).figures()
        assert batched.spectral_radius[k] == pytest.approx(figures.spectral_radius, rel=1e-9)
        assert batched.ms[k] == pytest.approx(figures.ms, rel=1e-9)
        assert batched.mt[k] == pytest.approx(figures.mt, rel=1e-9)


@pytest.mark.parametrize("b_r", [1e160, *(pytest.param(b_r, marks=pytest.mark.slow) for b_r in (1e12, 1e300))])
def test_draws_beyond_computing_are_failures(b_r, controller, stand, thor):
    """A hopeless fit's: entries that overflow were a LinAlgError."""
    figures = batch_figures(controller, stand, thor, {"b_r": np.array([1.31e-4, b_r])})
    nominal = controller.close(stand, thor).figures()
    assert figures.spectral_radius[0] == pytest.approx(nominal.spectral_radius, rel=1e-9)
    assert figures.spectral_radius[1] >= 1.0 - 1e-9
    for options in ({"ranges": {"b_r": (0.0, b_r)}}, {}):
        values = thor if options else thor.with_parameters(replace(thor["b_r"], value=b_r, prior_std=min(b_r, 1e150)))
        certificate = so.certify(controller, {"stand": stand}, values, samples=50, **options, simulations=False)
        assert not certificate.passed
        assert certificate.monte_carlo.failures >= 49


@pytest.mark.parametrize("value", [np.inf, np.nan])
def test_a_plant_that_is_not_finite_is_not_stable(value, controller, stand, thor, monkeypatch):
    plant = controller.plant(stand, thor)
    a = np.where(np.eye(len(plant.a)) > 0, value, plant.a)
    loop = Loop(plant=replace(plant, a=a), law=controller.law)
    figures = loop.figures()
    assert (figures.stable, figures.spectral_radius, figures.ms) == (False, np.inf, np.inf)
    assert margins(loop).disks == {}
    assert nu_gap(controller.close(stand, thor), loop) == (1.0, None)
    hold = batch.hold
    monkeypatch.setattr(batch, "hold", lambda *args: (np.full_like(hold(*args)[0], value), *hold(*args)[1:]))
    figures = batch_figures(controller, stand, thor, {"b_r": np.full(3, 1.31e-4)})
    assert np.all(figures.spectral_radius == np.inf)
    assert np.all(figures.ms == np.inf)


def test_whole_samples_of_delay_are_the_controllers_own(controller, stand, thor):
    late = controller.close(stand, with_(thor, "delay_s", 2e-3, "s")).figures()
    own = replace(controller, compute_delay_samples=controller.compute_delay_samples + 2).close(stand, thor).figures()
    assert late.ms == pytest.approx(own.ms, rel=1e-10)
    assert late.spectral_radius == pytest.approx(own.spectral_radius, rel=1e-9)


def test_the_worst_case_is_scipys_on_one_range(controller, swing, thor, certificate):
    """One parameter: a bounded scalar search over Ms, and both ends."""

    def minus_ms(value):
        return -controller.close(swing, thor.update(I_p=float(value))).figures().ms

    inner = minimize_scalar(minus_ms, bounds=(0.15, 0.6), method="bounded")
    best = max(-inner.fun, -minus_ms(0.15), -minus_ms(0.6))
    assert certificate.worst["swing"].ms == pytest.approx(best, rel=1e-6)


@pytest.mark.slow
def test_the_worst_case_of_several_is_no_less_than_any_corner_or_draw(controller, swing, thor):
    ranges = {"I_p": (0.2, 0.6), "L_a": (0.065, 0.08), "eta": (0.9, 1.1), "delay_s": (0.0, 3e-4)}
    certificate = so.certify(controller, {"swing": swing}, thor, ranges=ranges, samples=200, simulations=False)
    corners = np.array(np.meshgrid(*ranges.values())).reshape(4, -1)
    figures = batch_figures(controller, swing, thor, dict(zip(ranges, corners, strict=True)))
    fresh = np.random.default_rng(7)
    draws = {name: fresh.uniform(*ends, 2000) for name, ends in ranges.items()}
    assert certificate.worst["swing"].ms >= max(
        figures.ms.max(), batch_figures(controller, swing, thor, draws).ms.max()
    ) * (1 - 1e-6)


def test_the_gaussian_part_stays_inside_its_ellipsoid(controller, swing, thor):
    params = thor.prior(J=1e-7, b_r=1e-5)
    certificate = so.certify(controller, {"swing": swing}, params, samples=100, simulations=False)
    at = certificate.worst["swing"].parameters
    size = ((at["J"] - 3.31e-6) / 1e-7) ** 2 + ((at["b_r"] - 1.31e-4) / 1e-5) ** 2
    assert size == pytest.approx(chi2.ppf(0.999, 2), rel=1e-3)


@pytest.mark.slow
def test_the_worst_case_on_a_physical_bound_is_a_dense_searchs(controller, swing, thor):
    """The bound on b_r cuts the ellipse where the gradient leads: the best point lies along it."""
    tight = thor.prior(J=2e-7, b_r=4e-5).with_parameters(
        replace(thor["b_r"], prior_std=4e-5, min=1.25e-4), replace(thor["J"], prior_std=2e-7)
    )
    certificate = so.certify(controller, {"swing": swing}, tight, samples=200, simulations=False)
    radius, angle = np.meshgrid(np.linspace(0.0, np.sqrt(chi2.ppf(0.999, 2)), 20), np.linspace(0.0, 2 * np.pi, 241))
    b_r = np.maximum(1.31e-4 + 4e-5 * (radius * np.sin(angle)).ravel(), 1.25e-4)
    figures = batch_figures(
        controller, swing, tight, {"J": 3.31e-6 + 2e-7 * (radius * np.cos(angle)).ravel(), "b_r": b_r}
    )
    worst = certificate.worst["swing"]
    assert worst.parameters["b_r"] == pytest.approx(1.25e-4, rel=1e-6)
    assert worst.ms >= figures.ms.max() * (1 - 1e-6)
    assert worst.ms <= figures.ms.max() * 1.001


def test_a_witness_verifies_itself_and_goes_back_to_the_tuner(controller, stand, thor, certificate):
    assert certificate.brackets == {}
    worst = certificate.worst["swing"]
    assert worst.verify(controller)
    plant, values = worst
    assert controller.close(plant, values).figures().ms == pytest.approx(worst.ms, rel=1e-9)
    other = so.tune(stand, thor, SPEC)
    assert not worst.verify(other)
    again = so.tune(stand, thor, SPEC, robust_to=certificate.worst)
    assert again.close(plant, values).figures().ms <= 1.6


def test_a_worst_case_that_no_draw_hit_fails_the_certificate(controller, swing, thor):
    """The edge lies at an end of the range that five draws miss; the search finds it, and the requirement names it."""
    certificate = so.certify(
        controller, {"swing": swing}, thor, ranges={"I_p": (0.3, 1.0)}, samples=5, simulations=False
    )
    assert certificate.monte_carlo.failures == 0
    assert controller.close(swing, thor.update(I_p=0.3)).figures().ms > 1.6
    (row,) = [row for row in certificate.requirements if not row.met]
    assert row.name == "worst_case"
    assert "I_p = 0.3" in row.where
    assert not certificate.passed


def test_the_screws_mode_is_where_it_was_asked(thor):
    plant = so.plants.high_impedance(parts=["screw_mode"])
    for hz in (70.0, 80.0):
        values = place_value(plant, thor, "screw_mode_hz", hz, {"stand": plant})
        modes = np.abs(plant.linearize(values).poles()) / (2 * np.pi)
        assert np.min(np.abs(modes - hz)) < 0.02


def test_the_sampled_delay_margin_ends_stability(controller, stand, thor):
    figures = plant_margins(controller, stand, thor)
    edge = figures.sampled_delay_s
    assert controller.close(stand, with_(thor, "delay_s", edge * (1 - 1e-6), "s")).figures().stable
    assert not controller.close(stand, with_(thor, "delay_s", edge * (1 + 1e-6), "s")).figures().stable
    assert figures.margins.delay_s == pytest.approx(edge, rel=5e-3)  # a phase at the crossover, not the hold itself


def test_draws_are_not_the_callers_stream(certificate):
    """A tuner that drew from the same seed has not seen these draws."""
    first = np.random.default_rng(1).uniform(0.15, 0.6, 50)
    assert not np.any(np.isclose(certificate.worst["swing"].parameters["I_p"], first))


@pytest.mark.usefixtures("certificate")
def test_progress_runs_to_the_end(progress):
    """Both plants are drawn on: the design plant is one."""
    assert [note for note, _ in progress if note.endswith("50 draws")] == [
        "design, 50 of 50 draws",
        "swing, 50 of 50 draws",
    ]
    assert progress[-1][0].startswith("50 draws, ") and progress[-1][1] == 1.0


@pytest.mark.parametrize(
    ("ranges", "words"),
    [
        ({"delay_s": (-1e-3, 1e-3)}, "bounds"),
        ({"screw_mode_hz": (70.0, 80.0)}, r'no plant has it; add parts = \["screw_mode"\] to one'),
        ({"phi": (0.0, np.inf)}, "not finite"),
        ({"phi": (0.0, 0.3), "q": (0.0, 1e-3)}, "rests at one"),
    ],
)
def test_bad_conditions(controller, swing, thor, ranges, words):
    with pytest.raises(ControlError, match=words):
        so.certify(controller, {"swing": swing}, thor, ranges=ranges, samples=5)


def test_a_screw_mode_out_of_reach(controller, thor):
    plant = so.plants.high_impedance(parts=["screw_mode"])
    with pytest.raises(ControlError, match="beyond what m_n alone can do"):
        so.certify(controller, {"stand": plant}, thor, ranges={"screw_mode_hz": (70.0, 800.0)}, samples=5)
