"""The Kalman filter against its equations, against simulated truths, and on data that nothing was fitted to."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from seaopt.bench import PAPER_STAND
from seaopt.control import NoiseModel, estimate_noise, estimator
from seaopt.errors import ControlError
from seaopt.estimation.problem.steady_state_filter import kalman_gain

NOISE = NoiseModel(sensor_std={"F1": 2.0, "F2": 2.0}, input_noise={"I": 0.005})
PERIOD = 1 / 400


def disturbed(plant, params, seed, duration_s, delay=0):
    """Return a log of a plant moved by unknown current noise (0.1 A a sample), and what really happened."""
    rng = np.random.default_rng(seed)
    log = so.virtual_log(plant, params, PAPER_STAND, duration_s=duration_s, rate_hz=400, seed=seed)
    n = len(log)
    moved = np.concatenate([np.zeros(delay), log["I"]])[:n] + 0.1 * rng.normal(size=n)
    truth = so.simulate(plant, params, so.Log.from_arrays(time=log.time, I=moved))
    read = {name: truth[name] + 2.0 * rng.normal(size=n) + offset for name, offset in (("F1", 3.0), ("F2", -1.0))}
    return so.Log.from_arrays(time=log.time, I=log["I"], **read), truth


@pytest.fixture(scope="module")
def stand_test(stand, thor):
    """Return 25 s to learn from, 15 s that are held out, and the truth of those, with one sample of delay."""
    log, truth = disturbed(stand, thor, 1, 40.0, delay=1)
    return log.between(0.0, 25.0), log.between(25.0025, 40.0), truth.between(25.0025, 40.0)


@pytest.mark.parametrize("kind", ["stand", "swing", "screw"])
@pytest.mark.parametrize("outputs", [("F1",), ("F1", "F2")])
def test_gain_is_the_limit_of_the_riccati_recursion(stand, swing, thor, kind, outputs):
    plant = {"stand": stand, "swing": swing, "screw": so.plants.high_impedance(parts=("screw_mode",))}[kind]
    found = estimator(plant, plant.complete(thor), NOISE, outputs=outputs, sample_time_s=PERIOD)
    A, C, n = found.A, found.C, len(found.A)
    Q, R = np.zeros((n, n)), 4.0 * np.eye(len(outputs))
    Q[-1, -1] = 0.005**2 / PERIOD
    P = Q
    for _ in range(5000):
        S = C @ P @ C.T + R
        P = A @ (P - P @ C.T @ np.linalg.solve(S, C @ P)) @ A.T + Q
    assert found.gain == pytest.approx(P @ C.T @ np.linalg.inv(C @ P @ C.T + R), rel=1e-6, abs=1e-6 * found.gain.max())
    doubled = kalman_gain(A[None], C[None], np.diag(Q)[None], np.diag(R))[0]
    assert np.max(np.abs(doubled - A @ found.gain) / np.max(np.abs(doubled), axis=0)) < 3e-4  # it forgets 1e-6 a sample


def test_innovations_are_white_on_held_out_data_of_the_stand(stand, thor, stand_test):
    """Plant fitted to the first 25 s by its prediction errors, noise from the same, whiteness on the last 15 s."""
    learn, held, _ = stand_test
    start = thor.update(J=2e-6, b_r=3e-4, eta=0.8).free("J", "b_r", "eta")
    experiment = so.Experiment(plant=stand, log=learn, outputs=("F1",), delay_s=PERIOD)
    fit = so.fit([experiment], start, method=so.PredictionError(), diagnostics=False)
    noise = estimate_noise(stand, fit, learn, outputs=("F1", "F2"), delay_samples=1)
    found = estimator(stand, fit, noise, outputs=("F1", "F2"), sample_time_s=PERIOD, delay_samples=1)
    run = found.run(held)
    assert min(run.whiteness_p.values()) > 0.01
    e = np.column_stack([run.innovations[name][run.settled :] for name in found.outputs])
    assert np.cov(e.T) == pytest.approx(found.innovation_covariance, rel=0.05)


@pytest.mark.parametrize("wrong", ["J", "delay", "noise"])
def test_innovations_of_a_wrong_model_are_not_white(stand, thor, stand_test, wrong):
    _, held, _ = stand_test
    noise = NoiseModel(sensor_std={"F1": 2.0}, input_noise={"I": 0.05 if wrong == "noise" else 0.005})
    params = thor.update(J=thor["J"].value * (1.05 if wrong == "J" else 1.0))
    found = estimator(stand, params, noise, sample_time_s=PERIOD, delay_samples=0 if wrong == "delay" else 1)
    assert found.run(held).whiteness_p["F1"] < 1e-6


@pytest.mark.parametrize("outputs", [("F1",), ("F1", "F2")])
def test_errors_are_as_large_as_it_says(stand, thor, stand_test, outputs):
    _, held, truth = stand_test
    noise = NoiseModel(sensor_std=NOISE.sensor_std, input_noise={"I": 0.005}, offset={"F1": 3.0, "F2": -1.0})
    found = estimator(stand, thor, noise, outputs=outputs, sample_time_s=PERIOD, delay_samples=1)
    run = found.run(held)
    for name, real in (("F1", "F1"), ("F2", "F2"), ("spring_rate", "qd"), ("spring_deflection", "q")):
        error = (run[name] - truth[real])[run.settled :]
        assert np.std(error) == pytest.approx(run.std[name], rel=0.06), name
    assert run.std["F1"] < 1.3 and run.std["spring_rate"] < 4e-4


def test_it_tells_the_motion_of_a_link_that_no_sensor_sees(swing, thor):
    """Pendulum at small angles from F1 alone; the spring's rate is qd + x_2 dot."""
    rng = np.random.default_rng(3)
    n = 8000
    time, w = np.arange(n) / 400, 0.01 * rng.normal(size=n)
    current = 0.05 * np.sin(2 * np.pi * 2.0 * time)
    truth = so.simulate(swing, thor, so.Log.from_arrays(time=time, I=current + w))
    log = so.Log.from_arrays(time=time, I=current, F1=truth["F1"] + 0.5 * rng.normal(size=n))
    noise = NoiseModel(sensor_std={"F1": 0.5}, input_noise={"I": 0.0005})
    run = estimator(swing, thor, noise, sample_time_s=PERIOD).run(log)
    late = slice(n // 2, None)
    rate = truth["qd"] + thor["L_a"].value * np.cos(truth["phi"]) * truth["phid"]
    for name, real in (("phi", truth["phi"]), ("phid", truth["phid"]), ("spring_rate", rate)):
        assert np.std((run[name] - real)[late]) < 1.3 * run.std[name] < 0.6 * np.std(real[late]), name


def test_noise_and_offsets_are_found(stand, thor, stand_test):
    learn, _, _ = stand_test
    found = estimate_noise(stand, thor, learn, outputs=("F1", "F2"), delay_samples=1)
    assert found.input_noise["I"] == pytest.approx(0.1 * np.sqrt(PERIOD), rel=0.05)
    assert found.sensor_std == pytest.approx({"F1": 2.0, "F2": 2.0}, rel=0.02)
    assert found.offset == pytest.approx({"F1": 3.0, "F2": -1.0}, abs=0.5)


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_a_run_is_its_steps(stand, thor, delay):
    log, _ = disturbed(stand, thor, 4, 1.0, delay=delay)
    noise = NoiseModel(sensor_std={"F2": 2.0}, input_noise={"I": 0.005}, input_drift={"I": 0.1})
    found = estimator(stand, thor, noise, outputs=("F2",), sample_time_s=PERIOD, delay_samples=delay)
    run, state = found.run(log), found.start
    for k in range(len(log)):
        state = found.step(state, np.array([log["I"][k]]), np.array([log["F2"][k]]))
        for name, value in found.values(state).items():
            assert value == pytest.approx(run[name][k], rel=1e-9, abs=1e-9 * np.max(np.abs(run[name])))


def test_a_missing_sample_is_predicted(stand, thor):
    found = estimator(stand, thor, NOISE, sample_time_s=PERIOD)
    state = found.step(found.start, np.array([1.0]), np.array([np.nan]))
    assert np.isnan(state.innovation[0])
    assert state.predicted == pytest.approx(found.B[:, 0], abs=1e-12)


def test_the_drift_takes_what_is_constant(stand, thor):
    log, _ = disturbed(stand, thor, 5, 5.0)
    shifted = so.Log.from_arrays(time=log.time, I=log["I"] - 0.5, F1=log["F1"] - 3.0)
    noise = NoiseModel(sensor_std={"F1": 2.0}, input_noise={"I": 0.005}, input_drift={"I": 0.05})
    run = estimator(stand, thor, noise, sample_time_s=PERIOD).run(shifted)
    assert np.mean(run["I_drift"][len(log) // 2 :]) == pytest.approx(0.5, abs=3 * run.std["I_drift"])


def test_sensors_of_a_fit(stand, thor, short_log):
    fit = so.fit([so.Experiment(plant=stand, log=short_log, outputs=("F1", "F2"))], thor.free("J", "b_r"))
    noise = NoiseModel.from_fit(fit, input_noise={"I": 0.01})
    assert noise.sensor_std == pytest.approx({"F1": 2.0, "F2": 2.0}, rel=0.03)
    assert noise.offset["F1"] == pytest.approx(3.0, abs=0.1)
    with pytest.raises(ControlError, match='no experiment "swing"; known: experiment'):
        NoiseModel.from_fit(fit, experiment="swing")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"outputs": ("F3",)}, "not one of high_impedance"),
        ({"outputs": ()}, "name each measured output once"),
        ({"outputs": ("F1", "q")}, "nothing for the measured output q"),
        ({"sample_time_s": 0.0}, "seconds above zero"),
        ({"delay_samples": -1}, "not a whole number"),
        ({"noise": NoiseModel(sensor_std={"F1": 2.0})}, "nothing but the sensors is noisy"),
        ({"noise": NoiseModel(sensor_std={"F1": 2.0}, input_noise={"J": 1.0})}, 'input_noise names "J"'),
        ({"plant": so.plants.rotary(), "outputs": ("tau_s",)}, "theta_. of rotary .* measure another output"),
        ({"params": so.plants.thor().update(f_c=5.0)}, "dry friction at rest has no linear model"),
    ],
)
def test_bad_input_is_one_line(stand, thor, options, said):
    plant = options.pop("plant", stand)
    params = options.pop("params", thor if plant is stand else plant.defaults)
    default = NOISE if plant is stand else NoiseModel(sensor_std={"tau_s": 0.1}, input_noise={"I": 0.1})
    with pytest.raises(ControlError, match=said) as caught:
        estimator(plant, params, options.pop("noise", default), **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("sensor", [{"F1": 0.0}, {"F1": -1.0}, {"F1": np.nan}])
def test_a_sensor_without_noise_is_refused(sensor):
    with pytest.raises(ControlError, match="noise: sensor_std"):
        NoiseModel(sensor_std=sensor)


def test_noise_of_a_log_that_stands_still_is_refused(stand, thor):
    still = so.Log.from_arrays(time=np.arange(500) / 400, I=np.zeros(500), F1=np.ones(500))
    with pytest.raises(ControlError, match="F1 stands still"):
        estimate_noise(stand, thor, still)


def test_a_log_of_another_rate_or_with_holes_is_refused(stand, thor):
    log, _ = disturbed(stand, thor, 6, 1.0)
    found = estimator(stand, thor, NOISE, sample_time_s=1e-3)
    with pytest.raises(ControlError, match="make one with the log's sample_time_s"):
        found.run(log)
    force = log["F1"].copy()
    force[100] = np.nan
    holed = so.Log.from_arrays(time=log.time, I=log["I"], F1=force)
    with pytest.raises(ControlError, match=r"missing at t = 0.25 s"):
        estimator(stand, thor, NOISE, sample_time_s=PERIOD).run(holed)
