"""What a judgement simulates with steps as fine as a fit's, or finer: only what it needs them for."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.estimation.judgement import causes, hypothesis_search
from seaopt.estimation.judgement.candidates import Candidate
from seaopt.estimation.judgement.hypotheses import HYPOTHESES, Sizes, change_plants
from seaopt.estimation.judgement.judge import OF_HYPOTHESES
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.solver.budget import EVALUATIONS, OUT_OF_PROPORTION
from seaopt.estimation.solver.settle import refine_to
from tests.actuator_logs import integrate

RATE_HZ, SECONDS, STEPS = 250.0, 6.0, 16
TRUTH = {"J_m": 2.4e-5, "b_r": 1e-4, "f_c": 0.012, "N": 100.0, "K_tau": 0.05, "k_s": 300.0}
SHARP, SMOOTH = 0.2, 4.0  # rad/s


def record():
    """Return the log of a motor on a held spring, whose friction turns within a twentieth of what the fit takes."""
    rng, n, p = np.random.default_rng(3), round(SECONDS * RATE_HZ), TRUTH
    t = np.arange(n) / RATE_HZ
    sweep = 2 * math.pi * 0.3 * SECONDS / math.log(60) * (60 ** (t / SECONDS) - 1.0)
    current = 2.0 * np.sin(sweep) + np.sin(2 * math.pi * 0.7 * t + 1.0)

    def rates(x, ampere):
        angle, speed = x
        rub = p["f_c"] * math.tanh(speed / SHARP) + p["b_r"] * speed
        return speed, (p["K_tau"] * ampere - rub - p["k_s"] * angle / p["N"] ** 2) / p["J_m"]

    angle, _ = integrate(rates, 2, current, 1.0 / RATE_HZ, STEPS)
    return so.Log.from_arrays(
        time=t, I=current, tau_s=p["k_s"] * angle / p["N"] + rng.normal(scale=0.06, size=n),
        theta_m=angle + rng.normal(scale=1e-4, size=n),
    )  # fmt: skip


@pytest.fixture(scope="module")
def log():
    return record()


def pose(log):
    plant = so.plants.rotary(link="locked")
    given = {"J_m": 3.4e-5, "b_r": 2e-4, "k_s": 200.0, "f_c": 0.008}
    params = plant.defaults.update(**TRUTH | given, v_s=SMOOTH).free(*given)
    return so.Experiment(plant=plant, log=log, outputs=("tau_s", "theta_m")), params


def fit_log(log):
    experiment, params = pose(log)
    return so.fit([experiment], params)


def test_only_what_gains_with_coarse_steps_is_refitted_with_fine_ones(log, monkeypatch):
    experiment, params = pose(log)
    refined = []

    def refine(solved, fine):
        refined.append(set(solved.problem.shared_names) - set(fine.shared_names))
        return refine_to(solved, fine)

    monkeypatch.setattr(causes, "refine_to", refine)
    fit = so.fit([experiment], params)
    assert any(finding.kind == "cause" and finding.where == "v_s" for finding in fit.errors), fit.findings
    assert refined == [{"v_s"}]  # and neither delays, poles, nor what would take a value of its own


def test_a_pole_goes_no_farther_than_a_log_shows(log):
    experiment, params = pose(log)
    hypothesis = next(each for each in HYPOTHESES if each.part == "current_loop")
    sizes = Sizes(current=3.0, speed=100.0, travel=10.0, friction=0.012, deflection=0.05, stiffness=300.0)
    change = change_plants(hypothesis, (experiment,), params, sizes)
    assert change.params["current_loop_hz"].max == pytest.approx(2.0 * RATE_HZ)
    slow = replace(
        experiment, log=so.Log.from_arrays(time=np.arange(len(log)), **{name: log[name] for name in log.signals})
    )
    change = change_plants(
        hypothesis, (slow,), params, sizes
    )  # of one sample a second: 60 Hz is not to be started from
    assert change.params["current_loop_hz"].value == change.params["current_loop_hz"].max == pytest.approx(2.0)


def test_what_takes_steps_out_of_proportion_is_not_decided(log, monkeypatch):
    """Bristles that slip as fast as this motor turns: stiff, and not what the fit lacks."""
    experiment, params = pose(log)
    evaluate, works = FitProblem.evaluate, []

    def count(problem, z):
        if "sigma_0" in problem.shared_names:
            works.append(problem.count_work(z))
        return evaluate(problem, z)

    monkeypatch.setattr(FitProblem, "evaluate", count)
    fit = so.fit([experiment], params)
    minimum = fit.require_minimum("")
    unit, steps = minimum.problem.count_work(minimum.z), minimum.problem.experiments[0].substeps
    assert unit == round(SECONDS * RATE_HZ) * (1 + steps)
    (trial,) = (each for each in fit.hypotheses if each.parts == ("lugre",))
    assert trial.outcome == "undecided"
    assert len(works) >= trial.evaluations > 0
    assert 8 * unit < max(works) <= OUT_OF_PROPORTION * unit
    assert fit.hypotheses[-1] is trial
    assert all(each.outcome != "undecided" for each in fit.hypotheses[:-1])
    assert so.Fit.from_dict(fit.to_dict(), ()).hypotheses == fit.hypotheses


def test_no_last_digit_decides_what_is_named(log):
    """How far bristles get before they are too stiff is chance, and so is what they leave of the budget to others."""
    for seed in (1, 2, 8):
        rng = np.random.default_rng(seed)
        digits = {name: log[name] * (1.0 + 1e-12 * rng.uniform(-1.0, 1.0, len(log))) for name in log.signals}
        fit = fit_log(so.Log.from_arrays(time=log.time, **digits))
        assert [(one.kind, one.where) for one in fit.errors] == [("cause", "v_s"), ("excess", "experiment.theta_m")]
        assert [trial.parts for trial in fit.hypotheses if trial.outcome == "undecided"] == [("lugre",)]


@pytest.mark.parametrize(
    "refused", [("servo_hold", "servo_sample", "servo_delay", "supply_sag"), ("command_delay", "supply_sag"),
               ("command_delay", "current_loop")], ids=["current", "goal", "goal of a servo that commands a duty"]
)  # fmt: skip
def test_each_hypothesis_can_be_looked_at_in_the_least_budget(refused):
    """But for those that plants with such an input do not take."""
    sizes = Sizes(
        current=1.0, speed=1.0, travel=1.0, friction=1.0, deflection=1.0, stiffness=1.0,
        ripple={"a_g": 1.0, "n_g": 1.0}, holds={"log": (6, 0)},
    )  # fmt: skip
    tried = [hypothesis for hypothesis in HYPOTHESES if hypothesis.part not in refused]
    starts = sum(len(hypothesis.starts(sizes)) for hypothesis in tried)
    assert starts + hypothesis_search.ROUND * (len(tried) + 2) <= OF_HYPOTHESES * EVALUATIONS


def test_a_refit_whose_slopes_overflow_is_worth_nothing(log):
    experiment, params = pose(log)
    fit = so.fit([experiment], params, diagnostics=False)
    minimum = fit.require_minimum("")
    better = minimum.problem.evaluate(minimum.z)
    power = {name: replace(each, squares=each.squares / 4.0) for name, each in better.power.items()}
    better = replace(better, power=power)
    candidate = Candidate(
        where="v_s", experiments=fit.experiments, params=fit.parameters, says="v_s", frees={"J_m": 0.0}
    )

    def weigh(evaluation):
        before = causes._measure_powers(minimum.problem.evaluate(minimum.z), minimum.problem)
        return causes._weigh(fit, candidate, minimum.problem, evaluation, before, 1.0, poor=False)

    assert weigh(better) is not None
    for value in (np.nan, np.inf):
        hessian = better.hessian.copy()
        hessian[0, 1] = hessian[1, 0] = value
        assert weigh(replace(better, hessian=hessian)) is None
