"""Logs that do not begin in the state that their experiment states, of joints that are simulated here."""

import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.estimation.problem.fit_problem import count_evaluations
from seaopt.estimation.solver.budget import EVALUATIONS

RATE_HZ, N, K_TAU, SUBSTEPS = 500.0, 50.0, 0.07, 20
TRUTH = {"J_m": 4e-5, "b_r": 1e-3, "k_s": 300.0}


def record(seed, *, lead_s=0.0, noise=1e-3, friction=0.0, seconds=10.0):
    """Return the log of a held joint that began so many seconds earlier: in each of its exact steps dry friction is
    what would stop it, at most `friction`.
    """
    rng, before = np.random.default_rng(seed), round(lead_s * RATE_HZ)
    t, f = np.arange(round(seconds * RATE_HZ) + before) / RATE_HZ, np.arange(0.2, 12.0, 0.1)
    current = np.cos(2 * np.pi * np.outer(t, f) + rng.uniform(0, 2 * np.pi, f.size)).sum(axis=1)
    current /= current.std()
    J_m, b_r, k_s = TRUTH.values()
    rates = np.zeros((4, 4))
    rates[:2] = [[0, 1, 0, 0], [-k_s / N**2 / J_m, -b_r / J_m, K_TAU / J_m, -1 / J_m]]
    (a, b, c, d), (e, f, g, h) = expm(rates / RATE_HZ / SUBSTEPS)[:2].tolist()
    x, v, angle = 0.0, 0.0, np.empty(t.size)
    for i, value in enumerate(current.tolist()):  # plain floats: a tenth of the time of NumPy's
        angle[i] = x
        for _ in range(SUBSTEPS):
            x, v = a * x + b * v + c * value, e * x + f * v + g * value
            stop = min(max(-v / h, -friction), friction)
            x, v = x + d * stop, v + h * stop
    read = angle[before:] + noise * rng.normal(size=t.size - before)
    return so.Log.from_arrays(time=t[: t.size - before], I=current[before:], theta_m=read)


def fit(log, friction=0.0, band_hz=None, **settings):
    return fit_logs({"chirp": (log, {"initial_state": "rest", **settings})}, friction, band_hz)


def fit_logs(logs, friction=0.0, band_hz=None):
    """Return the fit of logs, each with the settings of its experiment."""
    plant = so.plants.rotary(link="locked")
    plant = so.plants.let_stick(plant) if friction else plant
    start = {name: 1.2 * value for name, value in TRUTH.items()} | {"f_c": 1.2 * friction}
    known = plant.defaults.update(K_tau=K_TAU, N=N, c_s=0.0, **start)
    names = (*TRUTH, "f_c") if friction else tuple(TRUTH)
    experiments = [
        so.Experiment(plant=plant, log=log, name=name, outputs=("theta_m",), **settings)
        for name, (log, settings) in logs.items()
    ]
    return so.fit(experiments, known.free(*names), band_hz=band_hz)


def find_initial(result):
    return [finding for finding in result.findings if finding.kind == "initial"]


@pytest.mark.parametrize("friction", [0.0, 0.02])
def test_a_log_that_begins_in_motion_is_not_met_as_one_that_rested(friction):
    log = record(1, lead_s=2.0, friction=friction)
    wrong = fit(log, friction)
    (finding,) = find_initial(wrong)
    assert not wrong.met
    assert (finding.severity, finding.where) == ("error", "chirp")
    assert 'initial_state = "estimate"' in finding.text and "slice_s" in finding.text
    assert finding.proposal == '[[experiment]]\ninitial_state = "estimate"'
    assert not any(each.kind == "cause" for each in wrong.findings)  # nothing else is blamed
    right = fit(log, friction, initial_state="estimate")
    assert right.met and not find_initial(right)
    for name, value in TRUTH.items():
        assert right.parameters[name].value == pytest.approx(value, rel=2e-3)


@pytest.mark.parametrize("friction", [0.0, 0.02])
@pytest.mark.parametrize("other", ["rest", "estimate"])
@pytest.mark.parametrize("seed", [1, 3])
def test_one_of_two_logs_that_begins_in_motion_is_named(seed, other, friction):
    """A step that frees how both begin throws the joint where it sticks: 40 times the noise had no cause. Beside a log
    whose state is free it ended in an error of Python's.
    """
    begins = {"still": (record(seed, friction=friction), {"initial_state": other})}
    moves = {"moving": (record(seed + 1, lead_s=2.0, friction=friction), {"initial_state": "rest"})}
    wrong = fit_logs(begins | moves, friction)
    assert not wrong.met
    assert [(each.where, each.severity) for each in find_initial(wrong)] == [("moving", "error")]
    assert not any(each.kind == "cause" for each in wrong.findings)


@pytest.mark.parametrize("lead_s", [0.0, 2.0])
def test_a_band_that_forgets_how_a_log_begins_leaves_nothing_to_be_said_of_that(lead_s):
    """No state is free there, of which there would be a probability."""
    result = fit(record(3, lead_s=lead_s), band_hz=(0.5, 100.0))
    assert result.met and not find_initial(result)


def test_a_wrong_position_is_noticed_as_a_wrong_speed_is():
    assert find_initial(fit(record(2), initial_state={"theta_m": 0.3}))[0].severity == "error"


def test_what_the_model_lacks_is_named_beside_a_wrong_start():
    """A position that is stated wrongly hides friction of 5 mN m, which the model has not."""
    before = count_evaluations()
    wrong = fit(record(1, lead_s=2.0, friction=0.005), initial_state={"theta_m": 1.0})
    assert find_initial(wrong)[0].severity == "error" and not wrong.met
    (cause,) = (finding for finding in wrong.findings if finding.kind == "cause")
    assert cause.where == "f_c" and cause.text.startswith("with the state free in which chirp begins: ")
    assert cause.preferred["f_c"][0] == pytest.approx(0.005, rel=0.02)
    assert wrong.hypotheses
    assert count_evaluations() - before < 2 * 6 * EVALUATIONS  # of a fit and its judgement


def test_a_little_motion_at_the_start_is_noticed_under_much_noise():
    (finding,) = find_initial(fit(record(1, lead_s=2.0, noise=0.1)))
    assert finding.severity == "warning"


@pytest.mark.parametrize("noise", [1e-3, 0.1])
@pytest.mark.parametrize("seed", range(4))
def test_a_log_that_begins_at_rest_is_met(seed, noise):
    right = fit(record(seed, noise=noise))
    assert right.met and not find_initial(right)


def test_a_log_in_pieces_that_all_begin_at_rest_is_not_blamed():
    """With twelve pieces 24 states are freed, which by chance take 12 of log-likelihood away."""
    for seed in range(4):
        pieces, begin = [record(50 * seed + k, seconds=1.0) for k in range(12)], 0.0
        times = list[np.ndarray]()
        for piece in pieces:
            times.append(piece.time + begin)
            begin += float(piece.time[-1]) + 0.5
        columns = {name: np.concatenate([piece[name] for piece in pieces]) for name in ("I", "theta_m")}
        log = so.Log.from_arrays(time=np.concatenate(times), **columns)
        assert not find_initial(fit(log)), seed
