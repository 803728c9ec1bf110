"""Speed by difference: the model differences its own position, exactly, and a fit of it has no bias.

The logs are of matrices written here, discretised by scipy, and differenced by NumPy.
"""

import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

import seaopt as so
from seaopt.errors import EstimationError, PlantError, SimulationError
from seaopt.plants import DifferencedSpeed
from seaopt.plants.sensors.difference import add_difference
from seaopt.simulation import Clock, Point, Segment, make_model, run_passes
from seaopt.simulation.interpreted import interpret_pass
from seaopt.simulation.passes import Weights

PERIOD, N = 4e-3, 4000
TRUTH = {"J_m": 2e-4, "b_r": 1e-3, "N": 50.0, "k_s": 300.0, "c_s": 0.3, "J_l": 0.1, "d_l": 0.2}
FREE = ("J_m", "k_s", "c_s", "J_l", "d_l")
CASES = {
    "one sample": DifferencedSpeed(of="theta_m"),
    "three samples": DifferencedSpeed(of="theta_m", samples=3),
    "with a lag": DifferencedSpeed(of="theta_m", samples=2, lag_hz=15.0),
}


def difference_by_hand(position, case):
    """Return what a device makes of a position that was at rest at zero before."""
    before = np.concatenate([np.zeros(case.samples), position[: -case.samples]])
    raw = (position - before) / (case.samples * PERIOD)
    if case.lag_hz is None:
        return raw
    a = 1.0 - np.exp(-2 * np.pi * case.lag_hz * PERIOD)
    return lfilter([a], [1.0, a - 1.0], raw)


@pytest.fixture(scope="module")
def motion():
    """A knee at 250 Hz, its current and motor angle, discretised exactly."""
    p = TRUTH
    pull, damp = p["k_s"] / p["N"], p["c_s"] / p["N"]
    j = p["J_m"]
    a = np.array([
        [0, 1, 0, 0], [-pull / p["N"] / j, -(damp / p["N"] + p["b_r"]) / j, pull / j, damp / j],
        [0, 0, 0, 1], [pull / p["J_l"], damp / p["J_l"], -p["k_s"] / p["J_l"], -(p["c_s"] + p["d_l"]) / p["J_l"]],
    ])  # fmt: skip
    f, g, *_ = cont2discrete((a, np.array([[0], [0.05 / p["J_m"]], [0], [0]]), np.eye(4), np.zeros((4, 1))), PERIOD)
    current = np.convolve(np.random.default_rng(1).normal(size=N), np.ones(5) / 5, mode="same")
    x, path = np.zeros(4), np.empty(N)
    for k in range(N):
        path[k], x = x[0], f @ x + g[:, 0] * current[k]
    return np.arange(N) * PERIOD, current, path


def record(motion, speed, **options):
    time, current, _ = motion
    log = so.Log.from_arrays(time=time, I=current, speed=speed)
    return so.Experiment(log=log, outputs=("speed",), **options)


def start():
    plant = so.plants.rotary()
    return plant, plant.defaults.update(**TRUTH).update(J_m=1e-4, k_s=200.0, c_s=0.5, J_l=0.2, d_l=0.1).free(*FREE)


@pytest.mark.parametrize(
    ("friction", "case"), [("none", "one sample"), ("smooth", "three samples"), ("sticking", "with a lag")]
)
def test_simulated_differences_are_those_of_the_simulated_angle(friction, case):
    """Linear, nonlinear and sticking plants, compiled and interpreted: exactly, at every sample."""
    plant = so.plants.rotary()
    params = plant.defaults.update(**TRUTH, f_c=0.0 if friction == "none" else 0.02)
    plant = so.plants.let_stick(plant) if friction == "sticking" else plant
    observed = add_difference(plant, "speed", CASES[case], PERIOD)
    model = make_model(observed, params, (), ("theta_m", "speed"))
    segment = Segment(u=(np.random.default_rng(2).normal(size=60),))
    point = Point(
        theta=np.zeros(0), offset=np.zeros(2), gain=np.ones(2), clock=Clock(period=PERIOD, delay_s=1e-3), substeps=2
    )
    x0 = np.zeros(len(observed.states))
    for run in (
        run_passes(model, segment, point, x0, outputs=True),
        interpret_pass(model, segment, point, Weights.plain(2), 60, x0),
    ):
        angle, speed = run.outputs.T
        np.testing.assert_allclose(speed, difference_by_hand(angle, CASES[case]), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("f_c", [0.0, 0.02])
def test_derivatives_are_those_of_finite_differences(f_c):
    plant = add_difference(so.plants.rotary(), "speed", CASES["with a lag"], PERIOD)
    params = so.plants.rotary().defaults.update(**TRUTH, f_c=f_c)
    model = make_model(plant, params, ("J_m", "k_s"), ("speed",))
    segment = Segment(u=(np.random.default_rng(3).normal(size=60),), y=(np.zeros(60),))

    def run(theta, x0, **keep):
        point = Point(
            theta=theta, offset=np.zeros(1), gain=np.ones(1), substeps=2,
            clock=Clock(period=PERIOD, delay_s=1e-3, delay_free=True),
        )  # fmt: skip
        return run_passes(model, segment, point, x0, **keep)

    theta, x0 = np.array([2e-4, 300.0]), np.linspace(0.1, 0.4, model.nx)
    columns = run(theta, x0, columns=True).columns[:, 0, 1:]
    for i, step in enumerate((2e-9, 3e-3)):
        moved = [run(theta + sign * step * np.eye(2)[i], x0, outputs=True).outputs[:, 0] for sign in (1, -1)]
        expected = (moved[0] - moved[1]) / (2 * step)
        np.testing.assert_allclose(columns[:, i], expected, atol=1e-5 * np.max(np.abs(expected)))
    for i in range(model.nx):
        moved = [run(theta, x0 + sign * 1e-4 * np.eye(model.nx)[i], outputs=True).outputs[:, 0] for sign in (1, -1)]
        expected = (moved[0] - moved[1]) / 2e-4
        np.testing.assert_allclose(columns[:, 3 + i], expected, atol=1e-5 * np.max(np.abs(expected)))


@pytest.mark.parametrize("case", CASES)
def test_a_fit_of_differences_recovers_the_truth(motion, case):
    plant, params = start()
    noise = 0.02 * np.random.default_rng(4).normal(size=N)
    speed = difference_by_hand(motion[2], CASES[case]) + noise
    judged = case == "with a lag"
    one = record(motion, speed, plant=plant, differences={"speed": CASES[case]})
    fit = so.fit([one], params, diagnostics=judged)
    assert fit.status == "converged"
    assert not judged or fit.met, str(fit)
    for name in FREE:
        assert abs(fit.parameters[name].value - TRUTH[name]) < 4.0 * fit.parameters[name].std


def test_taken_for_the_state_s_speed_it_is_half_a_sample_late(motion):
    """The wrong model fits a delay of T/2 that is not there, and its estimates are off by many stds without one."""
    plant, params = start()
    speed = difference_by_hand(motion[2], CASES["one sample"]) + 0.02 * np.random.default_rng(4).normal(size=N)
    h, outputs = plant.h, {**plant.outputs, "speed": "rad/s"}
    naive = so.Plant(
        name="naive", states=plant.states, inputs=plant.inputs, outputs=outputs, parameters=plant.parameters, f=plant.f,
        h=lambda t, x, u, p: {**h(t, x, u, p), "speed": x.thetad_m}, friction=plant.friction,
    )  # fmt: skip
    delay = so.Parameter(name="d", value=1e-3, unit="s", free=True, max=0.02)
    late = so.fit([record(motion, speed, plant=naive, delay_s=delay)], params, diagnostics=False)
    assert late.nuisance["experiment"].delay_s == pytest.approx(0.5 * PERIOD, rel=0.05)
    wrong = so.fit([record(motion, speed, plant=naive)], params, diagnostics=False)
    right = so.fit([record(motion, speed, plant=plant, differences={"speed": DifferencedSpeed(of="theta_m")})], params,
                   diagnostics=False)  # fmt: skip
    far = [abs(wrong.parameters[n].value - TRUTH[n]) / right.parameters[n].std for n in FREE]
    near = [abs(right.parameters[n].value - TRUTH[n]) / right.parameters[n].std for n in FREE]
    assert max(near) < 4.0
    assert max(far) > 20.0


def test_multiple_shooting_is_the_same_minimum(motion):
    plant, params = start()
    case = CASES["with a lag"]
    speed = difference_by_hand(motion[2], case) + 0.02 * np.random.default_rng(5).normal(size=N)
    one = record(motion, speed, plant=plant, differences={"speed": case})
    fits = [
        so.fit([one], params, method=m, diagnostics=False) for m in (so.OutputError(), so.MultipleShooting(segments=8))
    ]
    for name in FREE:
        a, b = (fit.parameters[name] for fit in fits)
        assert abs(a.value - b.value) < 0.02 * a.std


def test_the_first_difference_of_a_stretch_tells_what_was_held(motion):
    """After a gap, and at the start, whatever stands there changes no estimate."""
    plant, params = start()
    time, current, angle = motion
    speed = difference_by_hand(angle, CASES["one sample"]) + 0.02 * np.random.default_rng(6).normal(size=N)
    kept = np.r_[0:2000, 2100:N]
    fits = []
    for shift in (0.0, 100.0):
        moved = speed.copy()
        moved[[0, 2100]] += shift
        log = so.Log.from_arrays(time=time[kept], I=current[kept], speed=moved[kept])
        one = so.Experiment(plant=plant, log=log, outputs=("speed",), differences={"speed": CASES["one sample"]},
                            sigma={"speed": 0.02})  # fmt: skip
        fits.append(so.fit([one], params, diagnostics=False))
    assert len(one.log_segments) == 2
    for name in FREE:
        a, b = (fit.parameters[name] for fit in fits)
        assert abs(a.value - b.value) < 1e-3 * a.std


def test_a_known_start_was_there_before(motion):
    log = so.Log.from_arrays(time=np.arange(50) * PERIOD, I=np.zeros(50), speed=np.zeros(50))
    one = so.Experiment(
        plant=so.plants.rotary(), log=log, outputs=("speed",), initial_state={"theta_m": 5.0, "theta_l": 0.1},
        differences={"speed": DifferencedSpeed(of="theta_m", samples=2)},
    )  # fmt: skip
    assert one.initial_state == {"theta_m": 5.0, "theta_l": 0.1, "speed_held_1": 5.0, "speed_held_2": 5.0}


def test_a_known_start_is_that_of_an_output_which_is_the_state():
    """At rest at 0.3 rad the speed is zero from the first sample, not 0.3 rad over a period."""
    cart = so.Plant(
        name="cart", states={"x": "m", "v": "m/s"}, inputs={"F": "N"}, outputs={"place": "m"},
        parameters={"m": so.Parameter(name="m", value=2.0, unit="kg")},
        f=lambda t, x, u, p: {"x": x.v, "v": u.F / p.m}, h=lambda t, x, u, p: {"place": x.x},
    )  # fmt: skip
    log = so.Log.from_arrays(time=np.arange(50) * PERIOD, F=np.zeros(50), speed=np.zeros(50))
    one = so.Experiment(
        plant=cart, log=log, outputs=("speed",), initial_state={"x": 0.3},
        differences={"speed": DifferencedSpeed(of="place", samples=2)},
    )  # fmt: skip
    assert one.initial_state == {"x": 0.3, "speed_held_1": 0.3, "speed_held_2": 0.3}
    run = so.simulate(one.plant, one.plant.defaults, log, initial_state=dict(one.initial_state))
    np.testing.assert_allclose(run["speed"], 0.0, atol=1e-12)


def test_the_response_is_that_of_the_recursion():
    case, s = CASES["with a lag"], 2j * np.pi * np.array([1.0, 20.0, 90.0])
    t = np.arange(4000) * PERIOD
    for value in s:
        read = case.read(np.exp(value * t).real, PERIOD)[2000:]
        expected = (case.respond(np.array([value]), PERIOD)[0] * np.exp(value * t)).real[2000:]
        np.testing.assert_allclose(read, expected, atol=1e-6 * np.max(np.abs(expected)))


def test_what_cannot_be_differenced_is_refused(motion, tmp_path):
    plant, params = start()
    speed = motion[2]
    one = record(motion, speed, plant=plant, differences={"speed": DifferencedSpeed(of="theta_m")})
    with pytest.raises(EstimationError, match=r"PredictionError.*OutputError"):
        so.fit([one], params, method=so.PredictionError())
    with pytest.raises(PlantError, match='no position "theta_x"'):
        record(motion, speed, plant=plant, differences={"speed": DifferencedSpeed(of="theta_x")})
    with pytest.raises(PlantError, match="is no state"):
        record(motion, speed, plant=plant, differences={"speed": DifferencedSpeed(of="tau_s")})
    with pytest.raises(PlantError, match="samples = 0"):
        DifferencedSpeed(of="theta_m", samples=0)
    for use in (
        one.plant.linearize,
        lambda params: so.plants.to_control(one.plant, params),
        lambda params: so.plants.export_fmu(one.plant, params, tmp_path / "x.fmu"),
        lambda params: so.tune(one.plant, params, so.ControllerSpec(measured="tau_s", bandwidth_hz=15.0)),
        lambda params: so.tune(
            replace(one.plant, actuation=None), params, so.ControllerSpec(measured="tau_s", bandwidth_hz=15.0)
        ),
    ):
        with pytest.raises(PlantError, match="holds samples"):
            use(params)
    assert not list(tmp_path.iterdir())
    with pytest.raises(SimulationError, match="samples every"):
        so.simulate(one.plant, params, so.Log.from_arrays(time=np.arange(10) * 1e-3, I=np.zeros(10)))


def test_a_problem_file_declares_it(tmp_path):
    text = """
schema = 1
[parameters]
J_m = { value = 1e-4, free = true }
k_s = { value = 250, free = true }
d_l = 0.2
c_s = 0.3
[plant.knee]
kind = "rotary"
[[experiment]]
name = "shake"
plant = "knee"
differences = { speed = { of = "theta_m", samples = 2, lag_hz = 30 } }
[experiment.virtual]
seed = 1
duration_s = 20
rate_hz = 250
truth = { J_m = 2e-4, k_s = 300 }
outputs = ["speed"]
quantisation = { theta_m = 0.001534 }
excitation = { noise = { std = 1.0, band_hz = 30 } }
"""
    path = tmp_path / "p.toml"
    path.write_text(text)
    problem = so.read_problem(path)
    (one,) = problem.experiments()
    assert one.log.signals["speed"].unit == "rad/s"
    fit = so.fit([one], problem.parameters, diagnostics=False, **problem.fit_options)
    assert fit.parameters["J_m"].value == pytest.approx(2e-4, rel=1e-3)
    assert fit.parameters["k_s"].value == pytest.approx(300.0, rel=1e-3)
    path.write_text(text.replace('name = "shake"', 'name = "shake"\ndecimate = 2'))
    with pytest.raises(so.SeaoptError, match="decimate"):
        so.read_problem(path).experiments()


def test_it_survives_pickling():
    plant = add_difference(so.plants.rotary(), "speed", CASES["with a lag"], PERIOD)
    log = so.Log.from_arrays(time=np.arange(50) * PERIOD, I=np.sin(np.arange(50.0)))
    runs = [so.simulate(each, plant.defaults, log)["speed"] for each in (plant, pickle.loads(pickle.dumps(plant)))]
    np.testing.assert_array_equal(*runs)


def test_a_plant_of_one_s_own_in_symbols_has_one():
    plant = so.Plant(
        name="cart", states={"x": "m", "v": "m/s"}, inputs={"F": "N"}, outputs={"place": "m"},
        parameters={"m": so.Parameter(name="m", value=2.0, unit="kg")},
        f=lambda t, x, u, p: {"x": x.v, "v": (u.F - ca.tanh(x.v)) / p.m}, h=lambda t, x, u, p: {"place": x.x},
    )  # fmt: skip
    observed = add_difference(plant, "w", DifferencedSpeed(of="place"), 0.01)
    assert observed.outputs["w"] == "m/s"
    assert observed.sampling.sets == {"w_held_1": {"x": 1.0}}


def test_another_difference_than_the_plant_has_is_refused(motion):
    """It was ignored: the plant of an experiment has its differences already, and replace() gives that plant."""
    one = record(motion, motion[2], plant=so.plants.rotary(), differences={"speed": CASES["one sample"]})
    assert replace(one, name="again").plant is one.plant
    with pytest.raises(EstimationError, match="without differences"):
        replace(one, differences={"speed": CASES["three samples"]})
    other = replace(one, plant=so.plants.rotary(), differences={"speed": CASES["three samples"]})
    assert other.plant.sampling.sets["speed_held_3"] == {"speed_held_2": 1.0}
    with pytest.raises(PlantError, match="of its own"):
        replace(one, outputs=("theta_m",), differences={"theta_m": CASES["one sample"]})
