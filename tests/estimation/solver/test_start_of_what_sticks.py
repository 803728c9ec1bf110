"""The unknown initial speed of a joint that sticks: at rest where the log does not tell, found where it does.

The log is of a time-stepping simulation written here (Moreau's, in which friction is what stops the rotor within a
step, as far as its level reaches), of a knee with its link held.
"""

import numpy as np
import pytest

import seaopt as so
from seaopt.estimation.problem.fit_problem import count_evaluations
from seaopt.estimation.problem.normal_equations import QuadraticModel
from seaopt.estimation.problem.unknowns import collect
from seaopt.estimation.solver.least_squares import minimise
from seaopt.progress import ignore

PERIOD, N, PARTS = 1e-3, 4000, 20
TRUTH = {"J_m": 1e-4, "k_s": 300.0, "f_c": 0.03, "b_r": 1e-4}
GEAR, K_TAU, C_S = 50.0, 0.05, 0.3


def simulate_rotor(current, speed):
    h, angle, out = PERIOD / PARTS, 0.0, np.empty((N, 2))
    for k in range(N):
        out[k] = angle, TRUTH["k_s"] * angle / GEAR + C_S * speed / GEAR
        for _ in range(PARTS):
            torque = (TRUTH["k_s"] * angle + C_S * speed) / GEAR
            free = speed + h / TRUTH["J_m"] * (K_TAU * current[k] - torque / GEAR - TRUTH["b_r"] * speed)
            most = h / TRUTH["J_m"] * TRUTH["f_c"]
            before, speed = speed, np.sign(free) * max(abs(free) - most, 0.0)
            angle += 0.5 * h * (before + speed)
    return out


def fit_start(seed, output, speed, quiet_s, friction=0.01, progress=ignore, shots=1):
    rng, t = np.random.default_rng(seed), np.arange(N) * PERIOD
    lines = (0.7, 1.9, 4.1, 7.3, 12.1, 20.0)
    current = (t > quiet_s) * sum(0.6 * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in lines)
    angle, torque = simulate_rotor(current, speed).T
    reading, noise = (angle, 0.01) if output == "theta_m" else (torque, 0.05)
    log = so.Log.from_arrays(time=t, I=current, **{output: reading + noise * rng.normal(size=N)})
    plant = so.plants.let_stick(so.plants.rotary(link="locked"))
    start = plant.defaults.update(c_s=C_S, J_m=2e-4, k_s=200.0, f_c=friction, b_r=3e-4).free(*TRUTH)
    experiment = so.Experiment(plant=plant, log=log, outputs=(output,), shots=shots)
    return so.fit([experiment], start, diagnostics=False, progress=progress)


@pytest.mark.parametrize(("seed", "output"), [(0, "theta_m"), (1, "theta_m"), (2, "tau_s")])
def test_a_joint_that_is_held_starts_at_rest(seed, output):
    """With its initial speed looked for at once, three of eight such fits ended at 20 rad/s, ten stds off."""
    fit = fit_start(seed, output, speed=0.0, quiet_s=0.4)
    assert fit.status == "converged"
    (state,) = fit.nuisance["experiment"].initial_state
    assert abs(state["thetad_m"]) < 5.0
    for name, true in TRUTH.items():
        assert abs(fit.parameters[name].value - true) < 4.0 * fit.parameters[name].std + 2e-3 * true


def test_friction_that_holds_the_joint_throughout_is_no_start_to_end_at():
    """At f_c = 0.4 nothing moves, and no slope tells of anything: the search went off to inertias of 1e10."""
    notes = []
    fit = fit_start(
        4, "theta_m", speed=0.0, quiet_s=0.4, friction=0.4, progress=lambda note, share=None: notes.append(note)
    )
    assert fit.status == "converged"
    assert any("looking for a start, round 1 of 2" in note for note in notes)
    for name, true in TRUTH.items():
        assert abs(fit.parameters[name].value - true) < 4.0 * fit.parameters[name].std + 2e-3 * true


def test_shots_within_a_stretch_start_in_motion():
    plant = so.plants.let_stick(so.plants.rotary(link="locked"))
    log = so.Log.from_arrays(time=np.arange(60) * PERIOD, I=np.sin(np.arange(60.0)), theta_m=np.cos(np.arange(60.0)))
    one = so.Experiment(plant=plant, log=log, outputs=("theta_m",), shots=3)
    unknowns = collect((one,), plant.defaults.update(f_c=0.1).free("k_s"))[0]
    known = {name for name, std in zip(unknowns.names, unknowns.prior_std, strict=True) if np.isfinite(std)}
    assert known == {"experiment.initial.thetad_m"}


@pytest.mark.parametrize(("shots", "seed"), [(5, 5), (10, 5), (5, 6)])
def test_shots_that_begin_where_the_joint_is_held_leave_its_speed_alone(shots, seed):
    """No sample shows it, and rounding took it to 1e127 rad/s in every step: such fits ended at the given values."""
    before = count_evaluations()
    fit = fit_start(seed, "theta_m", speed=0.0, quiet_s=0.5, friction=0.06, shots=shots)
    assert fit.status == "converged"
    assert count_evaluations() - before < 100
    for name, true in TRUTH.items():
        assert abs(fit.parameters[name].value - true) < 4.0 * fit.parameters[name].std + 2e-3 * true


@pytest.mark.parametrize("seed", range(5))
def test_a_search_leaves_alone_what_nothing_shows(seed):
    rng = np.random.default_rng(seed)
    matrix, nearest = rng.normal(size=(120, 40)), rng.normal(size=40)
    matrix[:, 7] = 0.0

    class Bent:
        def evaluate(self, z):
            residuals, slopes = matrix @ np.arctan(z - nearest), matrix / (1.0 + (z - nearest) ** 2)
            return QuadraticModel(
                z=z,
                cost=0.5 * residuals @ residuals,
                gradient=slopes.T @ residuals,
                hessian=slopes.T @ slopes,
                linear=np.zeros(40, bool),
            )

    infinite = np.full(40, np.inf)
    solution = minimise(Bent(), np.ones(40), -infinite, infinite, max_iterations=100)
    assert solution.z[7] == 1.0
    np.testing.assert_allclose(np.delete(solution.z, 7), np.delete(nearest, 7), atol=1e-6)


def test_one_that_is_thrown_is_found_to_be():
    fit = fit_start(3, "tau_s", speed=8.0, quiet_s=0.0)
    (state,) = fit.nuisance["experiment"].initial_state
    assert state["thetad_m"] == pytest.approx(8.0, abs=0.5)
    for name, true in TRUTH.items():
        assert abs(fit.parameters[name].value - true) < 4.0 * fit.parameters[name].std + 2e-3 * true
