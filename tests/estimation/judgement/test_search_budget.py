"""A search for causes makes at most five times the evaluations of its fit; a fit says where that ended it.

They are counted here, one by one, on logs of actuators that NumPy integrates.
"""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
from scipy import signal

import seaopt as so
from seaopt.estimation.problem.fit_problem import BudgetError, FitProblem, count_left, limit_evaluations
from seaopt.estimation.solver.budget import EVALUATIONS, EvaluationBudget
from seaopt.estimation.solver.least_squares import minimise
from tests.actuator_logs import KNEE, SCREW, drive, integrate, screw

RATE_HZ = 400.0
FREE = ("J_m", "b_r", "k_s", "f_c")


def record_joint(*, harder=0.0, load=0.0, sharp=5.0, seconds=5.0):
    """Return the log of a motor on a held spring that hardens, with friction that grows with its load."""
    p, rng = KNEE | {"f_c": 0.02, "c_s": 0.0}, np.random.default_rng(3)
    t, current = drive(seconds, RATE_HZ, 4.0, top_hz=30.0)

    def spring(angle):
        return p["k_s"] * angle / p["N"] * (1.0 + harder * (angle / p["N"]) ** 2)

    def rates(x, ampere):
        angle, speed = x
        level = p["f_c"] + load * abs(spring(angle)) / p["N"]
        rub = level * math.tanh(speed / sharp) + p["b_r"] * speed
        return speed, (p["K_tau"] * ampere - rub - spring(angle) / p["N"]) / p["J_m"]

    angle, _ = integrate(rates, 2, current, 1.0 / RATE_HZ, 4)
    torque = np.array([spring(each) for each in angle])
    return so.Log.from_arrays(
        time=t,
        I=current,
        tau_s=torque + rng.normal(scale=0.02, size=t.size),
        theta_m=angle + rng.normal(scale=2e-3, size=t.size),
    )


def pose_joint(log, *, sticks):
    plant = so.plants.rotary(link="locked")
    plant = so.plants.let_stick(plant) if sticks else plant
    known = {name: value for name, value in {**KNEE, "c_s": 0.0, "v_s": 5.0}.items() if name in plant.parameters}
    params = plant.defaults.update(**known).update(J_m=3e-5, b_r=2e-4, k_s=250.0, f_c=0.015).free(*FREE)
    return so.Experiment(plant=plant, log=log, outputs=("tau_s", "theta_m"), initial_state="rest"), params


def pose_screw(spoil):
    t, current = drive(4.0, 1000.0, 3.0, top_hz=150.0)
    columns = {name: values for name, values in screw(current, 1000.0).items() if name in ("I", "F1", "F2")}
    plant = so.plants.high_impedance()
    log = so.Log.from_arrays(time=t, **spoil(columns))
    params = so.plants.thor().update(**SCREW).update(J=2e-6, b_r=2.5e-4).free("J", "b_r")
    return so.Experiment(plant=plant, log=log, outputs=("F1", "F2")), params


def filter_force(columns):
    """What no hypothesis about the actuator tells: singles and pairs use up their share."""
    return columns | {"F1": signal.lfilter([0.27], [1.0, -0.73], columns["F1"])}


@pytest.fixture
def counts(monkeypatch):
    """Count evaluations from outside: of all of a fit, of its second start, of the search for causes."""
    counts = dict.fromkeys(("fit", "find_other_minimum", "_search_causes"), 0)
    evaluate, judgement = FitProblem.evaluate, sys.modules["seaopt.estimation.judgement.judge"]
    within = ["fit"]

    def count(problem, z):
        result = evaluate(problem, z)
        for name in within:
            counts[name] += 1
        return result

    def watch(name):
        call = getattr(judgement, name)

        def watched(*args, **options):
            within.append(name)
            try:
                result = call(*args, **options)
                return result if isinstance(result, tuple) else list(result)
            finally:
                within.remove(name)

        monkeypatch.setattr(judgement, name, watched)

    monkeypatch.setattr(FitProblem, "evaluate", count)
    watch("find_other_minimum")
    watch("_search_causes")
    return counts


@pytest.mark.parametrize(
    ("pose", "ended"),
    [
        (lambda: pose_screw(filter_force), True),
        (lambda: pose_screw(lambda columns: columns), False),
        (lambda: pose_joint(record_joint(harder=8.0), sticks=False), None),
        (lambda: pose_joint(record_joint(harder=8.0, load=0.08), sticks=False), None),
        (lambda: pose_joint(record_joint(harder=8.0, load=0.08, sharp=0.5, seconds=2.0), sticks=True), None),
    ],
    ids=["filtered screw", "right screw", "hardening", "two effects", "two effects, sticking"],
)
def test_a_search_for_causes_makes_at_most_five_times_the_evaluations_of_its_fit(pose, ended, counts):
    experiment, params = pose()
    fit = so.fit([experiment], params, diagnostics=False)
    fitting, counts["fit"] = max(counts["fit"], EVALUATIONS), 0
    fit = so.fit([experiment], params)
    searching, another = counts["_search_causes"], counts["find_other_minimum"]
    assert searching <= 5 * fitting
    assert another <= fitting
    notes = [finding for finding in fit.findings if finding.kind == "budget"]
    assert [note.severity for note in notes] == ["note"] * len(notes)
    assert all(f"{5 * fitting} evaluations" in note.text for note in notes)
    assert notes or searching < 5 * fitting
    if ended is not None:
        assert bool(notes) == ended


def test_no_cause_is_tried_twice_from_the_same_start(monkeypatch):
    """Pairs that were refused, as none that are left off are, were refitted again with each other cause in turn."""
    search, tried, told = sys.modules["seaopt.estimation.judgement.hypothesis_search"], [], []
    refit = search._refit

    def refuse_pairs(change, old, fitted, *rest):
        tried.append((*(each.effect for each in change.hypotheses), fitted.z.tobytes()))
        return refit(change, old, fitted, *rest) if len(change.hypotheses) == 1 else None

    monkeypatch.setattr(search, "_refit", refuse_pairs)
    experiment, params = pose_joint(record_joint(harder=8.0, load=0.08, seconds=2.0), sticks=False)
    so.fit([experiment], params, progress=lambda note, share=None: told.append(note))
    pairs = [each for each in tried if len(each) == 3]
    assert len(pairs) > 10
    assert len(set(tried)) == len(tried)
    causes = [note for note in told if ": " in note and note.startswith("trying cause")]
    assert len(set(causes)) == len(causes) >= len(tried)
    assert sum(", beside " in note for note in causes) == len(pairs)


def test_a_search_that_may_not_go_on_returns_what_it_has():
    experiment, params = pose_screw(lambda columns: columns)
    fit = so.fit([experiment], params, diagnostics=False)
    problem = fit.require_minimum("").problem
    z = problem.unknowns.start_from(problem.unknowns.by_name(problem.unknowns.start) | {"J": 1e-5})
    start = problem.evaluate(z)
    low, high = problem.unknowns.low, problem.unknowns.high
    with limit_evaluations(2):
        solution = minimise(problem, start, low, high)
        assert count_left() == 0.0
        with pytest.raises(BudgetError), limit_evaluations(5):  # the outer one holds
            problem.evaluate(z)
    assert (solution.status, solution.iterations) == ("max_iterations", 2)
    assert solution.evaluation.cost < start.cost
    assert minimise(problem, start, low, high).status == "converged"


def test_a_part_of_a_budget_is_no_more_than_what_is_left_of_it():
    experiment, params = pose_screw(lambda columns: columns)
    minimum = so.fit([experiment], params, diagnostics=False).require_minimum("")
    budget = EvaluationBudget.begin(10, minimum.problem.count_work(minimum.z))
    for _ in range(4):
        minimum.problem.evaluate(minimum.z)
    assert (budget.made, budget.part(3).left, budget.part(100).left) == (4, 3, 6)
    with budget.enforce(leaving=5):
        minimum.problem.evaluate(minimum.z)
        with pytest.raises(BudgetError):
            minimum.problem.evaluate(minimum.z)
    assert budget.made == 5
