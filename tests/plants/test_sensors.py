"""Torque from deflection: transfer functions by hand, readings from encoders, and the loop that feeds it back."""

import control
import numpy as np
import pytest
from scipy.signal import cont2discrete

import seaopt as so
from seaopt.control.laws.realisation import runnable
from seaopt.control.running.closed_loop import SampledLoop, run_loop
from seaopt.errors import ParameterError, PlantError
from seaopt.parameters import Parameter
from seaopt.plants.sensors.deflection import evaluate_weights, find_scale
from seaopt.robustness.verification.playback import Rig

KNEE = {"J_m": 1e-4, "b_r": 1e-3, "K_tau": 0.05, "N": 50.0, "k_s": 300.0, "c_s": 1.5, "J_l": 0.1, "d_l": 0.05}


def make_knee(link="locked", **more):
    plant = so.plants.rotary(link=link, parts=["deflection_sensor"])
    nominal = Parameter(name="k_n", value=320.0, unit="N m/rad")
    own = {name: value for name, value in {**KNEE, **more}.items() if name in plant.parameters}
    return plant, plant.defaults.with_parameters(nominal).update(**own)


def test_deflection_lacks_the_damping_that_a_load_cell_reads():
    """Locked, by hand: tau_d/I = k_n K N/D, tau_s/I = (k_s + c_s s) K N/D, D = N^2 (J s^2 + b s) + c_s s + k_s."""
    plant, params = make_knee()
    s = 2j * np.pi * np.array([0.3, 4.0, 5.5, 40.0])
    k = KNEE
    below = k["N"] ** 2 * (k["J_m"] * s**2 + k["b_r"] * s) + k["c_s"] * s + k["k_s"]
    for output, above in (("tau_d", 320.0 + 0 * s), ("tau_s", k["k_s"] + k["c_s"] * s)):
        response = plant.linearize(params)(s)[list(plant.outputs).index(output), 0]
        np.testing.assert_allclose(response, above * k["K_tau"] * k["N"] / below, rtol=1e-10)


def test_a_law_says_by_what_the_firmwares_stiffness_is_off():
    """At rest tau_d = k_n delta and tau_s = k_s delta, so that a reference acts with k_s/k_n of its size."""
    plant, params = make_knee()
    spec = so.ControllerSpec(measured="tau_d", bandwidth_hz=15, sample_rate_hz=1000)
    controller = so.tune(plant, params, spec)
    text = " ".join(controller.notes)
    assert "tau_d reads 1.067 times the spring's torque" in text and "0.9375 times a reference acts" in text
    assert np.isclose(controller.close(plant, params).tracking(np.array([1e-3]))[0].real, 1.0, rtol=1e-3)
    right = plant.complete(params.update(k_n=300.0))
    assert np.isclose(find_scale(plant, right, "tau_d"), 1.0) and find_scale(plant, right, "tau_s") is None


def test_a_screw_has_a_force_from_deflection():
    plant = so.plants.moving_output(parts=["deflection_sensor", "spring_damping"])
    params = plant.defaults.with_parameters(Parameter(name="k_n", value=6e5, unit="N/m")).update(c_k=2e4, k=655e3)
    response = dict(zip(plant.outputs, plant.linearize(params)(2j * np.pi * 7.0)[:, 0], strict=True))
    assert response["F_d"] == pytest.approx(6e5 * (response["q"] + response["x_2"]), rel=1e-10)
    assert abs(response["F_d"] / 6e5 * 655e3 - response["F1"]) > 0.01 * abs(response["F1"])


def test_weights_of_encoders_are_slopes():
    plant, params = make_knee("free")
    c = plant.linearize(params).C[list(plant.outputs).index("tau_d")]
    states = list(plant.states)
    weights = evaluate_weights(plant, plant.complete(params), "tau_d")
    assert weights == pytest.approx({name: c[states.index(name)] for name in ("theta_m", "theta_l")}, rel=1e-12)
    assert evaluate_weights(plant, plant.complete(params), "tau_s") == {}


def test_a_virtual_sensor_computes_from_what_the_encoders_read():
    plant, params = make_knee("free")
    steps = {"theta_m": 2 * np.pi / 4096, "theta_l": 2 * np.pi / 2**14}
    sensors = so.Sensors(quantisation=steps, noise_std={"theta_l": 1e-4}, offset={"theta_m": 0.2})
    log = so.virtual_log(plant, params, (so.bench.Noise(std=1.0, band_hz=20.0),), duration_s=5, rate_hz=500, seed=3,
                         sensors=sensors)  # fmt: skip
    expected = 320.0 * (log["theta_m"] / 50.0 - log["theta_l"])
    np.testing.assert_allclose(log["tau_d"], expected, atol=1e-9)
    assert np.std(log["tau_d"] - 320.0 * log["deflection"]) > 0.03  # 320 x 1e-4 N m of noise alone
    std, step = sensors.combine_errors(plant, plant.complete(params), "tau_d")
    assert std == pytest.approx(0.032)
    assert step == pytest.approx(np.hypot(320.0 / 50.0 * steps["theta_m"], 320.0 * steps["theta_l"]))


def test_the_nominal_stiffness_has_no_default():
    plant = so.plants.rotary(parts=["deflection_sensor"])
    with pytest.raises(ParameterError, match="k_n"):
        plant.linearize(plant.defaults)
    bare = so.Plant(
        name="mass", states={"v": "m/s"}, inputs={"F": "N"}, outputs={"v": "m/s"}, parameters={"m": "kg"},
        f=lambda t, x, u, p: {"v": u.F / p.m}, h=lambda t, x, u, p: {"v": x.v},
    )  # fmt: skip
    with pytest.raises(PlantError, match="SeriesSpring"):
        so.plants.wrapped(bare, ["deflection_sensor"])


SPEC = {"bandwidth_hz": 15.0, "sample_rate_hz": 1000.0, "max_noise_gain": False}


def test_it_is_fed_back_as_what_it_is():
    """The tuned loop against python-control, and against a recursion of its own with rounding encoders."""
    plant, params = make_knee()
    controller = so.tune(plant, params, so.ControllerSpec(measured="tau_d", **SPEC))
    assert controller.feasible
    per_effort = controller.command.per_effort
    model = plant.linearize(params)
    held = control.sample_system(model[model.find_output("tau_d"), model.find_input("I")], 1e-3) * per_effort
    f = np.array([1.0, 10.0, 60.0])
    z = np.exp(2j * np.pi * f * 1e-3)
    np.testing.assert_allclose(
        controller.plant(plant, params).response(f), held(z) * z**-controller.compute_delay_samples, rtol=1e-8
    )

    a, b, _, _, _ = cont2discrete((model.A, model.B[:, :1], model.C, model.D), 1e-3)
    law, step, x = runnable(controller), 2 * np.pi / 1024, np.zeros(2)
    inside, waiting, path = np.zeros(law.c.size), [0.0] * controller.compute_delay_samples, []
    for _ in range(400):
        path.append(320.0 / 50.0 * x[0])
        reading = 320.0 / 50.0 * step * np.floor(x[0] / step + 0.5)
        effort = law.c @ inside + law.d_reference * 2.0 - law.d_measurement * reading
        inside = law.a @ inside + law.b_reference * 2.0 - law.b_measurement * reading
        waiting.append(effort * per_effort)
        x = a @ x + b[:, 0] * waiting.pop(0)
    loop = SampledLoop(
        plant=plant, law=law, measured="tau_d", delay_samples=controller.compute_delay_samples,
        sensors=so.Sensors(quantisation={"theta_m": step}),
    )  # fmt: skip
    run = run_loop(loop, [params], np.full(400, 2.0))
    np.testing.assert_allclose(run.outputs["tau_d"][0], path, atol=1e-5)
    exact = SampledLoop(plant=plant, law=law, measured="tau_d", delay_samples=controller.compute_delay_samples)
    ideal = run_loop(exact, [params], np.full(400, 2.0))
    assert np.max(np.abs(ideal.outputs["tau_d"] - run.outputs["tau_d"])) > 1e-3


def test_noise_of_encoders_reaches_the_loop():
    plant, params = make_knee()
    controller = so.tune(plant, params, so.ControllerSpec(measured="tau_d", **SPEC))
    runs = []
    for noise in ({"theta_m": 2e-3}, {"tau_d": 320.0 / 50.0 * 2e-3}):
        loop = SampledLoop(
            plant=plant, law=runnable(controller), measured="tau_d", delay_samples=controller.compute_delay_samples,
            sensors=so.Sensors(noise_std=noise),
        )  # fmt: skip
        runs.append(run_loop(loop, [params], np.ones(300)).outputs["tau_d"])
    np.testing.assert_allclose(*runs, atol=1e-12)


@pytest.mark.parametrize("part", ["measurement_delay", "load_cell", "sensor_filter"])
def test_an_encoders_error_passes_a_delay_and_a_load_cell(part):
    """Both have a gain of 1 at rest, so that an offset e of theta_m is k_n e/N of tau_d, one of theta_l is -k_n e."""
    plant, params = make_knee("free")
    behind = so.plants.wrapped(plant, [part])
    assert evaluate_weights(behind, behind.complete(params), "tau_d") == pytest.approx(
        {"theta_m": 320.0 / 50.0, "theta_l": -320.0}
    )
    sensors, noise = so.Sensors(offset={"theta_m": 0.01, "theta_l": 1e-4}), (so.bench.Noise(std=0.1, band_hz=20.0),)
    erring, ideal = (
        so.virtual_log(behind, params, noise, duration_s=0.2, rate_hz=500, seed=3, sensors=one)["tau_d"]
        for one in (sensors, so.Sensors())
    )
    np.testing.assert_allclose(erring - ideal, 320.0 / 50.0 * 0.01 - 320.0 * 1e-4, atol=1e-9)


def test_offset_and_range_of_an_encoder_reach_the_loop():
    """An integrating law brings the reading to 2: tau_d rests at 2 - k_n e/N, and moves on where theta_m is clipped."""
    plant, params = make_knee()
    controller = so.tune(plant, params, so.ControllerSpec(measured="tau_d", current_limit_A=10.0, **SPEC))

    def rest(n=1500, **errors):
        loop = SampledLoop(
            plant=plant, law=runnable(controller), measured="tau_d", delay_samples=controller.compute_delay_samples,
            sensors=so.Sensors(**errors),
        )  # fmt: skip
        return run_loop(loop, [params], np.full(n, 2.0)).outputs["tau_d"][0, -1]

    assert rest() == pytest.approx(2.0, abs=1e-6)
    assert rest(offset={"theta_m": 0.2}) == pytest.approx(2.0 - 320.0 / 50.0 * 0.2, abs=1e-6)
    assert rest(saturation={"theta_m": 0.1}) > 10.0  # the reading ends at 0.64, and the law pushes on
    stage = Rig(controller=controller, plant=plant, sensors=so.Sensors(offset={"theta_m": 0.2}))
    assert not stage.is_ideal  # a scenario is judged beside its ideal twin
    assert stage.ideal.is_ideal
