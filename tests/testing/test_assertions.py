"""The assertions for users' checks: they pass on what is right, and say in numbers what is not."""

from __future__ import annotations

from dataclasses import replace

import pytest

import seaopt as so


@pytest.fixture(scope="module")
def truth():
    return so.plants.thor()


@pytest.fixture(scope="module")
def experiment(truth):
    return so.testing.virtual_experiment(so.plants.high_impedance(), truth, duration_s=5, seed=3)


@pytest.fixture(scope="module")
def fit(experiment, truth):
    return so.fit([experiment], truth.update(J=2e-6).free("J", "b_r"))


def test_the_truth_is_recovered_and_another_is_not(fit, truth):
    so.testing.assert_recovered(fit, truth, sigmas=4, within=0.05)
    with pytest.raises(AssertionError, match="TOO FAR") as failure:
        so.testing.assert_recovered(fit, {"J": 3.31e-6 * 1.5, "b_r": 1.31e-4})
    assert "J" in str(failure.value) and str(failure.value).count("TOO FAR") == 1
    with pytest.raises(so.SeaoptError, match="b_r"):
        so.testing.assert_recovered(fit, {"J": 3.31e-6})


def test_another_log_is_predicted_to_the_percents_asked(fit, truth):
    other = so.testing.virtual_experiment(so.plants.high_impedance(), truth, duration_s=5, seed=4, name="other")
    found = fit.predict(other).fit_percent
    so.testing.assert_predicts(fit, other, fit_percent=min(found.values()) - 0.01)
    so.testing.assert_predicts(fit, other, fit_percent={"F1": found["F1"] - 0.01})
    with pytest.raises(AssertionError, match="TOO LOW") as failure:
        so.testing.assert_predicts(fit, other, fit_percent={"F1": found["F1"] - 0.01, "F2": found["F2"] + 0.01})
    assert str(failure.value).count("TOO LOW") == 1 and f"{found['F2']:.2f} %" in str(failure.value)
    with pytest.raises(so.SeaoptError, match="q"):
        so.testing.assert_predicts(fit, other, fit_percent={"q": 90})


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sigmas": float("nan")}, "sigmas = nan is not finite"),
        ({"sigmas": -3.0}, "sigmas = -3.0 is not positive"),
        ({"within": float("inf")}, "within = inf is not finite"),
    ],
)
def test_limits_of_a_recovery_are_positive_numbers(fit, truth, options, words):
    with pytest.raises(so.SeaoptError, match=words):
        so.testing.assert_recovered(fit, truth, **options)


def test_nothing_to_compare_is_no_success(fit, experiment, truth):
    with pytest.raises(so.SeaoptError, match="nothing to compare"):
        so.testing.assert_recovered(so.fit([experiment], truth), truth)
    with pytest.raises(so.SeaoptError, match="nothing to compare"):
        so.testing.assert_predicts(fit, experiment, {})
    with pytest.raises(so.SeaoptError, match=r'fit_percent\["F1"\] = nan is not finite'):
        so.testing.assert_predicts(fit, experiment, {"F1": float("nan")})


def test_a_certificate_that_fails_lists_what_is_not_met(truth):
    stand = so.plants.high_impedance()
    controller = so.tune(stand, truth, so.ControllerSpec(bandwidth_hz=30))
    good = so.certify(controller, {"stand": stand}, truth, ranges={"eta": (0.95, 1)}, samples=20, simulations=False)
    so.testing.assert_certified(good)
    with pytest.raises(AssertionError, match="failure probability"):
        so.testing.assert_certified(good, failure_probability=0.01)
    first, *rest = good.requirements
    bad = replace(good, requirements=(replace(first, met=False), *rest))
    with pytest.raises(AssertionError, match="not certified") as failure:
        so.testing.assert_certified(bad)
    assert first.name in str(failure.value) and first.where in str(failure.value)


def test_virtual_experiments_measure_what_is_regulated_with_a_hundredth_of_noise(truth):
    plant = so.plants.high_impedance()
    bench = so.testing.virtual_experiment(plant, truth, duration_s=20)
    ideal = so.simulate(plant, truth, bench.log)
    assert bench.outputs == plant.sensing.regulated
    for name in bench.outputs:
        noise = bench.log[name] - ideal[name]
        assert noise.std() == pytest.approx(0.01 * ideal[name].std(), rel=0.05)
    again = so.testing.virtual_experiment(plant, truth, duration_s=20)
    assert (again.log["F1"] == bench.log["F1"]).all()
    assert so.testing.virtual_experiment(plant, truth, noise_std={"q": 1e-6}, duration_s=1).outputs == ("q",)
