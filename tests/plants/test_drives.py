"""What drives the motor: voltage, duty and a firmware's servo, against equations that are written here again."""

from __future__ import annotations

import pickle
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import seaopt as so
from seaopt.errors import PlantError
from seaopt.simulation.compiled import Program
from seaopt.simulation.discretisation import Clock
from seaopt.simulation.interpreted import interpret_pass
from seaopt.simulation.model import make_model
from seaopt.simulation.native import find_compiler
from seaopt.simulation.passes import Point, Segment, Weights

MOTOR = {
    "J_m": 2e-5, "b_r": 1e-5, "K_tau": 0.05, "N": 60.0, "k_s": 200.0, "c_s": 0.3, "J_l": 0.08, "d_l": 0.1, "eta": 0.8,
    "R": 0.6, "L_m": 4e-4, "V_s": 12.0,
}  # fmt: skip
RATE_HZ = 500.0


def values_of(plant, **other):
    """Return the motor's values of a plant's parameters."""
    own = {name: value for name, value in (MOTOR | other).items() if name in plant.parameters}
    stated = [so.Parameter(name="k_p", value=1.0, unit="-")] if "k_p" in own else []  # has no default
    return plant.defaults.with_parameters(*stated).update(**own)


def motion(t, x, current, p):
    """Return the rates of [theta_m, its rate, theta_l, its rate] of the two-mass drive."""
    torque = p["k_s"] * (x[0] / p["N"] - x[2]) + p["c_s"] * (x[1] / p["N"] - x[3])
    return [
        x[1], (p["eta"] * p["K_tau"] * current - p["b_r"] * x[1] - torque / p["N"]) / p["J_m"],
        x[3], (torque - p["d_l"] * x[3]) / p["J_l"],
    ]  # fmt: skip


def integrate(rates, size, n):
    """Return states at n samples, with scipy's integrator sample by sample."""
    states, x = [np.zeros(size)], np.zeros(size)
    for k in range(n - 1):
        run = solve_ivp(
            lambda t, x, k=k: rates(t, x, k), (0.0, 1.0 / RATE_HZ), x, rtol=1e-9, atol=1e-12, method="LSODA"
        )
        x = run.y[:, -1]
        states.append(x)
    return np.array(states)


@pytest.mark.parametrize("part", ["voltage_input", "duty_input"])
@pytest.mark.parametrize("inductance", [False, True])
def test_voltage_and_duty_are_those_of_a_motor_with_back_emf(part, inductance):
    plant = so.plants.rotary(parts=[part, *(["inductance"] if inductance else [])])
    n = 200
    drive = 1.3 * np.sin(np.linspace(0.0, 12.0, n) ** 1.5)  # of the duty, beyond its limit at times
    volts = 6.0 * drive if part == "voltage_input" else 12.0 * np.clip(drive, -1.0, 1.0)

    def rates(t, x, k):
        if not inductance:
            return motion(t, x, (volts[k] - MOTOR["K_tau"] * x[1]) / MOTOR["R"], MOTOR)
        slope = (volts[k] - MOTOR["R"] * x[4] - MOTOR["K_tau"] * x[1]) / MOTOR["L_m"]
        return [*motion(t, x, x[4], MOTOR), slope]

    expected = integrate(rates, 5 if inductance else 4, n)
    name = "V" if part == "voltage_input" else "duty"
    log = so.Log.from_arrays(time=np.arange(n) / RATE_HZ, **{name: 6.0 * drive if name == "V" else drive})
    run = so.simulate(plant, values_of(plant), log, rtol=1e-9)
    assert np.allclose(run["theta_m"], expected[:, 0], atol=1e-6 * np.max(np.abs(expected[:, 0])))
    current = expected[:, 4] if inductance else (volts - MOTOR["K_tau"] * expected[:, 1]) / MOTOR["R"]
    assert np.allclose(run["I"], current, atol=1e-6 * np.max(np.abs(current)))


def test_a_supply_that_sags_is_an_input_and_a_log_without_it_has_the_rated_one():
    plant = so.plants.rotary(parts=["duty_input", "supply_input"])
    n = 200
    drive = 1.3 * np.sin(np.linspace(0.0, 12.0, n) ** 1.5)
    supply = 11.0 - 3.0 * np.abs(drive)

    def rates(t, x, k):
        volts = supply[k] * np.clip(drive[k], -1.0, 1.0)
        return motion(t, x, (volts - MOTOR["K_tau"] * x[1]) / MOTOR["R"], MOTOR)

    expected, time = integrate(rates, 4, n), np.arange(n) / RATE_HZ
    run = so.simulate(
        plant, values_of(plant), so.Log.from_arrays(time=time, duty=drive, supply=supply), rtol=1e-9, hold="zero"
    )
    assert np.allclose(run["theta_m"], expected[:, 0], atol=1e-6 * np.max(np.abs(expected[:, 0])))
    log, rated = so.Log.from_arrays(time=time, duty=drive), so.plants.rotary(parts=["duty_input"])
    assert np.allclose(
        so.simulate(plant, values_of(plant), log)["theta_m"], so.simulate(rated, values_of(rated), log)["theta_m"]
    )
    assert plant.actuation.effort(SimpleNamespace(**MOTOR)) == rated.actuation.effort(SimpleNamespace(**MOTOR))
    with pytest.raises(PlantError, match='"supply_input" needs duty_input'):
        so.plants.rotary(parts=["voltage_input", "supply_input"])


@pytest.mark.parametrize("inductance", [False, True])
def test_a_supply_sags_by_what_the_bridge_takes_from_it(inductance):
    """I from E + R I = d (V_s - R_b d I) in the rotor's rest frame, and that voltage given as a log of the supply."""
    plant = so.plants.rotary(parts=["duty_input", "supply_sag", *(["inductance"] if inductance else [])])
    n, sag = 200, 0.15
    duty = 0.9 * np.sin(np.linspace(0.0, 12.0, n) ** 1.5)

    def find_current(x, k):
        return (12.0 * duty[k] - MOTOR["K_tau"] * x[1]) / (MOTOR["R"] + sag * duty[k] ** 2)

    def rates(t, x, k):
        if not inductance:
            return motion(t, x, find_current(x, k), MOTOR)
        volts = duty[k] * (12.0 - sag * duty[k] * x[4])
        return [*motion(t, x, x[4], MOTOR), (volts - MOTOR["R"] * x[4] - MOTOR["K_tau"] * x[1]) / MOTOR["L_m"]]

    expected = integrate(rates, 5 if inductance else 4, n)
    log = so.Log.from_arrays(time=np.arange(n) / RATE_HZ, duty=duty)
    run = so.simulate(plant, values_of(plant, R_b=sag), log, rtol=1e-9)
    assert np.allclose(run["theta_m"], expected[:, 0], atol=1e-6 * np.max(np.abs(expected[:, 0])))
    assert plant.linearize(values_of(plant, R_b=sag)).B[1, 0] == plant.linearize(values_of(plant)).B[1, 0]


def test_a_screw_takes_from_the_supply_what_it_heats_and_makes():
    """V I = R I^2 + F_m qd/eta: the back-EMF is that of K_tau, whatever the losses of the screw."""
    plant = so.plants.high_impedance(parts=["voltage_input"])
    params = so.plants.thor().update(eta=0.7).with_parameters(so.Parameter(name="R", value=0.5, unit="ohm"))
    log = so.Log.from_arrays(time=np.arange(300) / RATE_HZ, V=np.full(300, 2.0))
    run = so.simulate(plant, params, log)
    p = {name: parameter.value for name, parameter in plant.complete(params).items()}
    force = p["K_tau"] / (p["l"] / (2 * np.pi * p["N_p"])) * run["I"]
    assert np.allclose(2.0 * run["I"], 0.5 * run["I"] ** 2 + force * run["qd"], rtol=1e-9, atol=1e-9)


def test_a_servo_that_runs_every_few_rows_is_that_of_its_equations():
    """With a limit and an integral; it reads every seventh row, from the fourth on."""
    plant = so.plants.rotary(parts=["duty_input", "position_servo", "servo_integral", "servo_limit", "servo_sample"])
    gains = {"k_p": 40.0, "k_d": 0.3, "k_i": 60.0, "g_s": 0.01, "c_max": 0.5}
    n, every, first = 300, 7, 3
    goal = 3.0 * np.sin(np.arange(n) / 15.0)
    read = [0.0, 0.0, goal[0]]  # position, speed and goal as the firmware has them

    def rates(t, x, k):
        if t == 0.0 and (k - first) % every == 0 and k > 0:
            read[:] = [x[0], x[1], goal[k]]
        error = read[2] - read[0]
        wanted = gains["g_s"] * (gains["k_p"] * error - gains["k_d"] * read[1] + gains["k_i"] * x[4])
        command = min(max(wanted, -0.5), 0.5)
        current = (MOTOR["V_s"] * command - MOTOR["K_tau"] * x[1]) / MOTOR["R"]
        return [*motion(t, x, current, MOTOR), 0.0 if command != wanted and wanted * error > 0 else error]

    expected = integrate(rates, 5, n)
    log = so.Log.from_arrays(time=np.arange(n) / RATE_HZ, goal=goal).hold("goal", every, first)
    run = so.simulate(plant, values_of(plant, **gains), log, rtol=1e-5)
    assert np.max(np.abs(run["theta_m"] - expected[:, 0])) < 2e-4 * np.max(np.abs(expected[:, 0]))
    with pytest.raises(PlantError, match='"servo_hold" and "servo_sample" are both given'):
        so.plants.rotary(parts=["position_servo", "servo_hold", "servo_sample"])


def test_a_servo_with_everything_is_that_of_its_equations():
    plant = so.plants.rotary(parts=["duty_input", "position_servo", "servo_integral", "servo_limit"])
    gains = {"k_p": 40.0, "k_d": 0.3, "k_i": 60.0, "g_s": 0.01, "c_max": 0.5}
    n = 300
    goal = 3.0 * np.sign(np.sin(np.arange(n) / 45.0))

    def rates(t, x, k):
        error = goal[k] - x[0]
        wanted = gains["g_s"] * (gains["k_p"] * error - gains["k_d"] * x[1] + gains["k_i"] * x[4])
        command = min(max(wanted, -0.5), 0.5)
        current = (MOTOR["V_s"] * command - MOTOR["K_tau"] * x[1]) / MOTOR["R"]
        return [*motion(t, x, current, MOTOR), 0.0 if command != wanted and wanted * error > 0 else error]

    expected = integrate(rates, 5, n)
    run = so.simulate(
        plant, values_of(plant, **gains), so.Log.from_arrays(time=np.arange(n) / RATE_HZ, goal=goal), rtol=1e-5
    )
    assert np.max(np.abs(run["theta_m"] - expected[:, 0])) < 2e-4 * np.max(np.abs(expected[:, 0]))


def test_firmware_that_holds_what_it_reads_is_late_by_half_of_that():
    """To first order: its command is of a position that goes on by half a sample time's worth of speed."""
    plant = so.plants.rotary(parts=["duty_input", "position_servo", "servo_hold", "servo_limit"])
    gains = {"k_p": 40.0, "k_d": 0.3, "g_s": 0.01, "c_max": 0.5, "T_h": 2e-3}
    n = 300
    goal = 3.0 * np.sin(np.arange(n) / 25.0)

    def rates(t, x, k):
        wanted = gains["g_s"] * (gains["k_p"] * (goal[k] - x[0] + 1e-3 * x[1]) - gains["k_d"] * x[1])
        current = (MOTOR["V_s"] * min(max(wanted, -0.5), 0.5) - MOTOR["K_tau"] * x[1]) / MOTOR["R"]
        return motion(t, x, current, MOTOR)

    expected = integrate(rates, 4, n)
    log = so.Log.from_arrays(time=np.arange(n) / RATE_HZ, goal=goal)
    run = so.simulate(plant, values_of(plant, **gains), log, rtol=1e-5)
    assert np.max(np.abs(run["theta_m"] - expected[:, 0])) < 2e-4 * np.max(np.abs(expected[:, 0]))
    with pytest.raises(PlantError, match='"servo_hold" needs position_servo'):
        so.plants.rotary(parts=["duty_input", "servo_hold"])


def test_fit_of_a_log_that_holds_goal_and_position_alone():
    """The servo's gain known, an encoder on the motor tells spring, link and damping behind a firmware loop."""
    plant = so.plants.rotary(parts=["duty_input", "position_servo"])
    gains = {"k_p": 1.0, "g_s": 0.05}
    rng, n = np.random.default_rng(2), 4000
    t = np.arange(n) / RATE_HZ
    goal = 0.8 * np.sin(2 * np.pi * (0.3 * t + 0.9 * t**2)) * 2.0
    truth = values_of(plant, **gains)
    run = so.simulate(plant, truth, so.Log.from_arrays(time=t, goal=goal))
    step = 2 * np.pi / 4096 / 4
    log = so.Log.from_arrays(
        time=t, goal=goal, theta_m=np.round((run["theta_m"] + 2e-4 * rng.normal(size=n)) / step) * step
    )
    start = truth.update(k_s=120.0, J_l=0.05, b_r=3e-5).free("k_s", "J_l", "b_r")
    fit = so.fit([so.Experiment(plant=plant, log=log, offset=False)], start)
    assert fit.met, str(fit)
    for name in ("k_s", "J_l", "b_r"):
        found = fit.parameters[name]
        assert abs(found.value - truth[name].value) < 4.0 * found.std < 0.3 * truth[name].value


@pytest.mark.slow
@pytest.mark.parametrize("inside", ["I", "duty"])
def test_what_a_servo_commands_may_be_logged_beside_its_goal(inside):
    """Goal in, current out: integrated here, then fitted from the current alone."""
    plant = so.plants.rotary(parts=["position_servo", *(["duty_input"] if inside == "duty" else [])])
    gain = 1.5 if inside == "I" else 0.05
    goal = np.convolve(np.random.default_rng(7).normal(size=1500), np.ones(20) / 5.0, mode="same")

    def command_of(x, k):
        return gain * (goal[k] - x[0])

    def current_of(x, k):
        if inside == "I":
            return command_of(x, k)
        return (MOTOR["V_s"] * np.clip(command_of(x, k), -1.0, 1.0) - MOTOR["K_tau"] * x[1]) / MOTOR["R"]

    path = integrate(lambda t, x, k: motion(t, x, current_of(x, k), MOTOR), 4, goal.size)
    current = np.array([current_of(x, k) for k, x in enumerate(path)])
    command = np.array([command_of(x, k) for k, x in enumerate(path)])
    t = np.arange(goal.size) / RATE_HZ
    truth = values_of(plant, k_p=gain, g_s=1.0)
    run = so.simulate(plant, truth, so.Log.from_arrays(time=t, goal=goal), rtol=1e-6)
    for name, expected in (("I", current), (inside, command)):
        assert np.max(np.abs(run[name] - expected)) < 2e-4 * np.max(np.abs(expected))
    noise = 1e-3 * np.std(current) * np.random.default_rng(8).normal(size=goal.size)
    log = so.Log.from_arrays(time=t, goal=goal, I=current + noise)
    start = truth.update(k_s=1.3 * MOTOR["k_s"], J_l=1.2 * MOTOR["J_l"]).free("k_s", "J_l")
    one = so.Experiment(plant=plant, log=log, outputs=("I",), initial_state="rest", offset=False)
    fit = so.fit([one], start, diagnostics=False)
    for name in ("k_s", "J_l"):
        assert abs(fit.parameters[name].value - MOTOR[name]) < 4.0 * fit.parameters[name].std + 1e-3 * MOTOR[name]


def test_a_torque_controller_commands_the_voltage():
    plant = so.plants.rotary(link="locked", parts=["voltage_input"])
    assert plant.actuation.input == "V"
    effort = plant.actuation.effort(plant.complete(values_of(plant)).by_attribute)
    assert effort == pytest.approx(60.0 * 0.8 * 0.05 / 0.6)
    again = pickle.loads(pickle.dumps(plant))
    assert again.inputs == plant.inputs and again.port.probe is not None


def test_a_limit_of_the_current_is_said_to_be_one_of_the_voltage():
    """Linear in the command: 12 V at rest are 12 times the effort of one, N eta K_tau / R."""
    plant = so.plants.rotary(link="locked", parts=["voltage_input"])
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=15, current_limit_A=12.0)
    controller = so.tune(plant, plant.defaults, spec)
    at_rest = 12.0 * 50.0 * 0.05 / 1.0
    assert any("12 V of V" in note for note in controller.notes)
    assert f"12 V allows a reference of {at_rest:.4g} N m at rest" in " ".join(str(controller).split())


def test_loads_of_friction_see_the_current_behind_the_drive():
    inner = so.Plant(
        name="hub", states={"q": "rad", "w": "rad/s"}, inputs={"I": "A"}, outputs={"q": "rad"},
        parameters={"J": "kg m^2", "K": "N m/A", "c": "-"},
        f=lambda t, x, u, p: {"q": x.w, "w": (p.K * u.I - u.rub) / p.J}, h=lambda t, x, u, p: {"q": x.q},
        actuation=so.plants.Actuation(input="I", effort=lambda p: p.K, unit="N m", speed=lambda x, p: x.w),
        friction={"rub": so.plants.Friction(
            velocity=lambda x, p: x.w, unit="N m", loads=lambda x, u, p: {"load": p.K * u.I}, rated={"load": 1.0},
            force=lambda v, p: p.c * ca.fabs(p.load) * ca.tanh(v / 1e-3), jump=lambda v, p: p.c * ca.fabs(p.load),
        )},
    )  # fmt: skip
    plant = so.plants.let_stick(so.plants.wrapped(inner, ["voltage_input"]))
    params = so.ParameterSet.of(J=(1.0, "kg m^2"), K=(0.5, "N m/A"), c=(0.2, "-"), R=(2.0, "ohm"))
    t = np.arange(500) / RATE_HZ
    run = so.simulate(plant, params, so.Log.from_arrays(time=t, V=np.ones(500)), rtol=1e-9)
    rate = (1 - 0.2) * 0.5 / 2.0  # of speed, less what the back-EMF takes
    decay = (1 - 0.2) * 0.5**2 / 2.0
    assert np.allclose(run["w"], rate / decay * (1 - np.exp(-decay * t)), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("parts", "word"),
    [
        (["voltage_input", "duty_input"], "one input"), (["voltage_input", "current_loop"], "takes a current"),
        (["inductance"], "needs voltage_input or duty_input"), (["servo_integral"], "needs position_servo"),
    ],
)  # fmt: skip
def test_parts_that_do_not_go_together_are_refused(parts, word):
    with pytest.raises(PlantError, match=word):
        so.plants.rotary(parts=parts)


def test_plants_without_the_roles_are_refused():
    free = so.Plant(
        name="mass", states={"x": "m", "v": "m/s"}, inputs={"F": "N"}, outputs={"x": "m"}, parameters={"m": "kg"},
        f=lambda t, x, u, p: {"x": x.v, "v": u.F / p.m}, h=lambda t, x, u, p: {"x": x.x},
    )  # fmt: skip
    for part, role in (("voltage_input", "speed="), ("position_servo", "motor_position")):
        with pytest.raises(PlantError, match=role):
            so.plants.wrapped(free, [part])


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize(("delay_s", "free"), [(0.0, False), (0.0033, True)])
def test_what_firmware_reads_is_the_same_without_a_compiler(delay_s, free):
    """With derivatives, and from an initial state in which it has read something else than is there."""
    plant, n = so.plants.rotary(parts=["position_servo", "servo_sample"]), 60
    params = values_of(plant, k_p=2.0, k_d=0.01, f_c=0.01)
    log = so.Log.from_arrays(time=np.arange(n) / RATE_HZ, goal=np.sin(np.arange(n) / 9.0)).hold("goal", 5, 2)
    model = make_model(plant, params, ("J_m", "k_s", "f_c"), ("tau_s", "theta_m"))
    noise = np.random.default_rng(3).normal(size=(2, n))
    segment = Segment(u=(log["goal"], log["holds"]), y=tuple(noise))
    point = Point(
        theta=np.array(params.values_of(model.free)), offset=np.zeros(2), gain=np.ones(2), substeps=3,
        clock=Clock(period=1.0 / RATE_HZ, delay_s=delay_s, delay_free=free),
    )  # fmt: skip
    weights, x0 = Weights(sections=np.zeros((0, 5)), settle=0, knee=np.full(2, 9e9), loss="square"), np.zeros(model.nx)
    x0[list(plant.states).index("theta_m_read")] = 0.1
    fast = Program.make(model, segment, point, weights).run(0, n, x0, outputs=True, columns=True, states=True)
    slow = interpret_pass(model, segment, point, weights, n, x0)
    read, there = (slow.states[:, list(plant.states).index(name)] for name in ("theta_m_read", "theta_m"))
    assert np.array_equal(read[2:], np.repeat(there[2::5], 5)[: n - 2]) and np.all(read[:2] == 0.1)
    for name in ("outputs", "columns", "states"):
        a, b = getattr(fast, name), getattr(slow, name)
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10 * np.max(np.abs(b)), err_msg=name)
