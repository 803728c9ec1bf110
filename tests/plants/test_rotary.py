"""The rotary actuator against Newton and Euler written body by body, the books of energy, and its first equations."""

from __future__ import annotations

import math
from itertools import product

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

import seaopt as so
from seaopt.control import command_of
from seaopt.errors import PlantError
from seaopt.plants import wrapped
from seaopt.plants.friction import find_breakaway, find_dry_friction, friction_slopes
from seaopt.plants.impacts import catch, check_held, release, strike
from tests.casadi_functions import compile_expression

VALUES = {
    "J_m": 1.3e-4, "b_r": 2e-3, "K_tau": 0.06, "N": 70.0, "k_s": 250.0, "c_s": 0.7, "J_l": 0.2, "d_l": 0.3, "eta": 0.85,
    "f_c": 0.02, "v_s": 3.0, "f_s": 0.035, "v_st": 12.0, "J_h": 0.004, "m": 2.5, "L": 0.2, "g": 9.81, "k_3": 4e4,
    "g_b": 2e-3, "eps_b": 3e-4,
}  # fmt: skip
PARTS = (), ("stribeck", "backlash"), ("hardening",)
KINDS = list(product(("free", "locked", "pendulum"), ("unlumped", "lumped"), ("link1", "link2"), PARTS))


def make(link, drive, spring, parts):
    plant = so.plants.rotary(link, drive, spring, parts, external=True)
    params = plant.defaults.update(**{name: value for name, value in VALUES.items() if name in plant.parameters})
    return plant, params


def functions_of(plant, params):
    """Return f and h, named, as functions of (x, u)."""
    p = plant.complete(params).vector
    arguments = (plant.x, plant.u, plant.p)
    f, h = (compile_expression(arguments, expression) for expression in (plant.dynamics, plant.output))
    return (
        lambda x, u: dict(zip(plant.states, f(x, u, p), strict=True)),
        lambda x, u: dict(zip(plant.outputs, h(x, u, p), strict=True)),
    )


def dry(speed, parts):
    v = VALUES
    fall = (v["f_s"] - v["f_c"]) * math.exp(-((speed / v["v_st"]) ** 2)) if "stribeck" in parts else 0.0
    return (v["f_c"] + fall) * math.tanh(speed / v["v_s"])


def twist_torque(twist, rate, parts):
    """Return the spring's torque and the energy in it (by quadrature)."""
    v = VALUES

    def law(angle):
        g, e = v["g_b"], v["eps_b"]
        z = angle + 0.5 * (math.hypot(angle - g, e) - math.hypot(angle + g, e)) if "backlash" in parts else angle
        return v["k_s"] * z + (v["k_3"] * z**3 if "hardening" in parts else 0.0)

    corners = [corner for corner in (-v["g_b"], v["g_b"]) if min(0.0, twist) < corner < max(0.0, twist)]
    stored = quad(law, 0.0, twist, epsrel=1e-12, limit=200, points=corners or None)[0]
    return law(twist) + v["c_s"] * rate, stored


def bodies(link, drive, spring, parts, x, current, torque):
    """Return accelerations and torques by Newton and Euler, each body cut free, with momentum and power of all.

    An ideal gear pushes the rotor with -t/N, its output with t and the housing with t/N - t; the lumped drive has no
    rotor, its motor pushes with N times its torque between housing and output.
    """
    v, x = VALUES, dict(x)
    w_m, w_l, turn = x["thetad_m"], x.get("thetad_l", 0.0), x.get("theta_l", 0.0)
    motor = v["eta"] * v["K_tau"] * current - v["b_r"] * w_m - dry(w_m, parts)
    weight = v["m"] * v["g"] * v["L"] if link == "pendulum" else 0.0
    load = torque - v["d_l"] * w_l - weight * math.sin(turn)
    t_s, stored = twist_torque(x["theta_m"] / v["N"] - turn, w_m / v["N"] - w_l, parts)
    n, held, rotor = v["N"], link == "locked", v["J_m"]
    housing = v["J_h"]  # with the spring at link 1
    w_h = w_l - w_m / n if spring == "link1" else 0.0
    # Unknown: the motor's acceleration, the link's, the gear's (or lumped motor's) torque t on the output.
    a, b = np.zeros((3, 3)), np.zeros(3)
    if held:
        a[1, 1] = 1.0
    else:
        a[1, 1], b[1] = v["J_l"], load + (t_s if spring == "link2" else 0.0)
        a[1, 2] = -1.0 if spring == "link1" else 0.0
    h_m, h_l = (-1.0 / n, 1.0) if spring == "link1" else (0.0, 0.0)  # the housing's acceleration, of the two
    if drive == "unlumped":
        a[0], b[0] = [rotor * (1.0 + h_m), rotor * h_l, 1.0 / n], motor
    if spring == "link2" and drive == "unlumped":
        a[2, 2], b[2] = 1.0, t_s
    elif spring == "link2":
        a[0], b[0] = [n**2 * rotor / n, 0.0, -1.0], -t_s
        a[2, 2], b[2] = 1.0, n * motor
    elif drive == "unlumped":
        a[2], b[2] = [housing * h_m, housing * h_l, 1.0 - 1.0 / n], t_s - motor
    else:
        a[0], b[0] = [(housing + n**2 * rotor) * h_m, (housing + n**2 * rotor) * h_l, 1.0], t_s
        a[2, 2], b[2] = 1.0, n * motor
    a_m, a_l, t = np.linalg.solve(a, b)
    a_h = h_m * a_m + h_l * a_l
    if spring == "link1":
        on_ground, on_link = -t_s, t
    elif drive == "unlumped":
        on_ground, on_link = t / n - t - motor, t_s
    else:
        on_ground, on_link = -t, t_s
    hung = n**2 * rotor if drive == "lumped" else 0.0
    w_hung, a_hung = (w_h, a_h) if spring == "link1" else (w_m / n, a_m / n)
    own = rotor if drive == "unlumped" else 0.0
    own_housing = housing if spring == "link1" else 0.0
    kinetic = own * (w_m + w_h) ** 2 + own_housing * w_h**2 + hung * w_hung**2
    kinetic += 0.0 if held else v["J_l"] * w_l**2
    energy = stored + 0.5 * kinetic + weight * (1.0 - math.cos(turn))
    # A locked link's load goes into the ground beside the housing's.
    changed = own * (a_m + a_h) + own_housing * a_h + hung * a_hung + (0.0 if held else v["J_l"] * a_l)
    put = v["eta"] * v["K_tau"] * current * w_m + torque * w_l
    twist_rate = w_m / n - w_l
    lost = v["b_r"] * w_m**2 + dry(w_m, parts) * w_m + v["d_l"] * w_l**2 + v["c_s"] * twist_rate**2
    outputs = {"tau_s": t_s, "tau_h": on_ground, "tau_l": on_link, "theta_m": x["theta_m"], "theta_l": turn}
    outputs["deflection"] = x["theta_m"] / n - turn
    books = {"energy": energy, "put": put, "lost": lost, "momentum": changed, "load": load, "on_link": on_link}
    return (a_m, a_l), outputs, books


def draw_state(plant, rng):
    scale = {"theta_m": 0.5, "thetad_m": 8.0, "theta_l": 0.4, "thetad_l": 1.0}
    return np.array([scale[name] * rng.normal() for name in plant.states])


@pytest.mark.parametrize(("link", "drive", "spring", "parts"), KINDS)
def test_newton_and_euler_agree(link, drive, spring, parts):
    plant, params = make(link, drive, spring, parts)
    f, h = functions_of(plant, params)
    rng = np.random.default_rng(5)
    for _ in range(5):
        x, u = draw_state(plant, rng), rng.normal(size=2) * [3.0, 5.0]
        (a_m, a_l), outputs, books = bodies(link, drive, spring, parts, zip(plant.states, x, strict=True), *u)
        rates, read = f(x, u), h(x, u)
        assert rates["thetad_m"] == pytest.approx(a_m, rel=1e-8, abs=1e-7)
        assert link == "locked" or rates["thetad_l"] == pytest.approx(a_l, rel=1e-8, abs=1e-7)
        assert read == pytest.approx({name: outputs[name] for name in plant.outputs}, rel=1e-8, abs=1e-8)
        if link != "locked":  # of everything that turns: the ground takes tau_h, the world brings the load
            assert books["momentum"] + read["tau_h"] - books["load"] == pytest.approx(0.0, abs=1e-8)
        stored = ca.Function("e", [plant.x, plant.p], [plant.stored_energy()])
        assert float(stored(x, plant.complete(params).vector)) == pytest.approx(books["energy"], rel=1e-9)


@pytest.mark.parametrize(("link", "drive", "spring", "parts"), [kind for kind in KINDS if kind[3] != ("hardening",)])
def test_energy_is_conserved_over_a_run(link, drive, spring, parts):
    """What goes in is stored or lost, integrated over a run with a torque on the link."""
    plant, params = make(link, drive, spring, parts)
    f, _ = functions_of(plant, params)
    n = len(plant.states)

    def inputs(t):
        return [2.0 * math.sin(40 * t), 3.0 * math.cos(23 * t)]

    def rate(t, z):
        u = inputs(t)
        w_m, w_l = z[1], z[3] if n == 4 else 0.0
        put = VALUES["eta"] * VALUES["K_tau"] * u[0] * w_m + u[1] * w_l
        lost = VALUES["b_r"] * w_m**2 + dry(w_m, parts) * w_m + VALUES["d_l"] * w_l**2
        lost += VALUES["c_s"] * (w_m / VALUES["N"] - w_l) ** 2
        return [*f(z[:n], u).values(), put, lost]

    start = draw_state(plant, np.random.default_rng(3))
    run = solve_ivp(rate, (0.0, 0.2), np.r_[start, 0.0, 0.0], method="DOP853", rtol=1e-10, atol=1e-12)
    stored = [
        bodies(link, drive, spring, parts, zip(plant.states, run.y[:n, k], strict=True), 0.0, 0.0)[2]["energy"]
        for k in (0, -1)
    ]
    put, lost = run.y[n:, -1]
    assert abs(stored[0] + put - lost - stored[1]) <= 1e-7 * max(*stored, abs(put), lost)


def test_the_first_rotary_is_a_special_case():
    """f, h and eigenvalues of the two-mass drive as the design writes them, at random points and parameters."""
    plant = so.plants.rotary()
    function = ca.Function("both", [plant.x, plant.u, plant.p], [plant.dynamics, plant.output])
    rng = np.random.default_rng(1)
    for _ in range(20):
        v = {name: VALUES[name] * 10 ** rng.uniform(-1, 1) for name in
             ("J_m", "b_r", "K_tau", "N", "k_s", "c_s", "J_l", "d_l")}  # fmt: skip
        params = plant.defaults.update(**v)
        theta_m, w_m, theta_l, w_l = x = rng.normal(size=4)
        current = rng.normal()
        tau_s = v["k_s"] * (theta_m / v["N"] - theta_l) + v["c_s"] * (w_m / v["N"] - w_l)
        a_m = (v["K_tau"] * current - v["b_r"] * w_m - tau_s / v["N"]) / v["J_m"]
        a_l = (tau_s - v["d_l"] * w_l) / v["J_l"]
        f, h = (np.array(part).ravel() for part in function(x, current, plant.complete(params).vector))
        np.testing.assert_allclose(f, [w_m, a_m, w_l, a_l], rtol=1e-12)
        named = dict(zip(plant.outputs, h, strict=True))
        expected = {"tau_s": tau_s, "theta_m": theta_m, "theta_l": theta_l, "tau_h": -v["J_m"] * a_m - tau_s}
        assert {name: named[name] for name in expected} == pytest.approx(expected, rel=1e-12)
        n, k, c = v["N"], v["k_s"], v["c_s"]
        matrix = np.array([
            [0, 1, 0, 0],
            [-k / n**2 / v["J_m"], -(v["b_r"] + c / n**2) / v["J_m"], k / n / v["J_m"], c / n / v["J_m"]],
            [0, 0, 0, 1],
            [k / n / v["J_l"], c / n / v["J_l"], -k / v["J_l"], -(c + v["d_l"]) / v["J_l"]],
        ])  # fmt: skip
        np.testing.assert_allclose(plant.linearize(params).A, matrix, rtol=1e-12)


@pytest.mark.parametrize(("drive", "spring"), list(product(("unlumped", "lumped"), ("link1", "link2"))))
def test_derived_figures_are_those_of_the_eigenvalues(drive, spring):
    plant, params = make("locked", drive, spring, ())
    params = params.update(f_c=0.0)
    names = list(plant.derived_values())
    values = ca.Function("d", [plant.p], [value for value, _ in plant.derived_values().values()])
    figures = dict(zip(names, map(float, values(plant.complete(params).vector)), strict=True))
    if spring == "link1":
        params = params.update(c_s=0.0)
        figures |= dict(zip(names, map(float, values(plant.complete(params).vector)), strict=True))
    pole = plant.linearize(params).poles()[0]
    assert abs(pole) / (2 * np.pi) == pytest.approx(figures["natural_frequency_hz"], rel=1e-9)
    if spring == "link2":
        assert -pole.real / abs(pole) == pytest.approx(figures["damping_ratio"], rel=1e-9)


def test_a_hanging_shank_swings_at_its_own_frequency():
    """With the motor held, the antiresonance of theta_m is the pendulum on the spring, gravity with it."""
    plant, params = make("pendulum", "unlumped", "link2", ())
    model = plant.linearize(params.update(f_c=0.0, c_s=0.0, d_l=0.0))
    weight = VALUES["m"] * VALUES["g"] * VALUES["L"]
    zeros = model[list(plant.outputs).index("theta_m"), 0].zeros()
    assert np.max(np.abs(zeros.imag)) == pytest.approx(math.sqrt((VALUES["k_s"] + weight) / VALUES["J_l"]), rel=1e-6)
    figure = ca.Function("d", [plant.p], [plant.derived_values()["antiresonance_hz"][0]])
    found = float(figure(plant.complete(params).vector)) * 2 * np.pi
    assert found == pytest.approx(np.max(np.abs(zeros.imag)), rel=1e-6)


def test_the_roles_of_a_knee():
    plant, params = make("pendulum", "unlumped", "link2", ("stribeck",))
    values, v = plant.complete(params), VALUES
    command = command_of(plant, values, "tau_s")
    assert 1.0 / command.per_effort == pytest.approx(v["N"] * v["eta"] * v["K_tau"])
    assert (command.effort_unit, plant.actuation.efficiency) == ("N m", "eta")
    assert find_breakaway(plant, values) == pytest.approx(v["N"] * v["f_s"])
    largest = max(dry(speed, ("stribeck",)) for speed in np.linspace(0.0, 50.0, 5001))
    assert find_dry_friction(plant, values)["tau_f"] == pytest.approx(v["N"] * largest, rel=0.01)
    smooth = so.plants.rotary("locked")
    of_smooth = smooth.complete(smooth.defaults.update(f_c=0.05, v_s=20.0))
    assert find_dry_friction(smooth, of_smooth)["tau_f"] == pytest.approx(50.0 * 0.05, rel=0.01)
    flattest, steepest = friction_slopes(plant, values)
    speeds = np.linspace(-60, 60, 20001)
    slopes = np.gradient([dry(speed, ("stribeck",)) for speed in speeds], speeds)
    assert flattest[0] <= slopes.min() and steepest[0] >= slopes.max()
    assert plant.friction["tau_f"].slope_unit == "N m s/rad"
    assert plant.port.payload == ("J_l", "m") and plant.port.effort == "tau_e"
    read = plant.sensing
    assert (read.motor_position, read.motor_speed, read.link_position) == ("theta_m", "thetad_m", "theta_l")


@pytest.mark.parametrize(("drive", "spring"), list(product(("unlumped", "lumped"), ("link1", "link2"))))
@pytest.mark.parametrize("parts", [(), ("stribeck", "load_cell", "command_delay")])
def test_the_port_holds_the_link(drive, spring, parts):
    plant, locked = (so.plants.rotary(link, drive, spring, parts) for link in ("pendulum", "locked"))
    check_held(plant, locked)
    probe = plant.port.probe()
    assert probe.ports[0].payload == ("J_l",) and probe.ports[0].effort == "tau_e"
    assert "d_l" not in probe.parameters and "m" not in probe.parameters
    for other in (so.plants.rotary("locked", drive, "link1" if spring == "link2" else "link2", parts), plant):
        with pytest.raises(PlantError, match="with a link fixed"):
            check_held(plant, other)


@pytest.mark.parametrize("spring", ["link1", "link2"])
def test_a_caught_shank_keeps_its_spring(spring):
    plant, params = make("pendulum", "unlumped", spring, ())
    values, state = plant.complete(params), np.array([0.7, 0.0, 0.2, 0.0])
    held, _, loss = catch(plant, values, state, plant.port)
    assert held[0] == pytest.approx(0.7 - VALUES["N"] * 0.2) and loss == 0.0
    np.testing.assert_allclose(release(plant, values, plant.port, held, {"theta_l": 0.2}), state, atol=1e-12)
    struck = strike(plant, values, state, "theta_l", 0.5)
    (a_m, a_l), *_ = bodies("pendulum", "unlumped", spring, (), zip(plant.states, state, strict=True), 0.0, 1e9)
    np.testing.assert_allclose(struck[[1, 3]], np.array([a_m, a_l]) * 0.5e-9, atol=1e-5)


def test_a_torque_sensor_lags():
    inner = so.plants.rotary("locked")
    outer = wrapped(inner, ["load_cell", "current_loop"])
    params = outer.defaults.update(load_cell_hz=100.0, current_loop_hz=400.0)
    for frequency in (1.0, 80.0):
        s = 2j * np.pi * frequency
        lag = 1.0 / (1 + s / (200 * np.pi)) / (1 + s / (800 * np.pi))
        found = outer.linearize(params)(s)[0, 0] / inner.linearize(params)(s)[0, 0]
        assert found == pytest.approx(lag, rel=1e-9)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"link": "loose"}, '"free" or "locked" or "pendulum"'),
        ({"drive": "belt"}, '"unlumped" or "lumped"'),
        ({"spring": "link3"}, '"link1" or "link2"'),
        ({"parts": ("screw_mode",)}, "ball screw; a gear's elasticity is part of k_s"),
    ],
)
def test_options_that_do_not_exist_are_refused(options, words):
    with pytest.raises(PlantError, match=words):
        so.plants.rotary(**options)


def test_a_torque_on_a_link_whose_motor_sticks_twists_the_spring():
    """With the motor stuck the shank rests where spring and gravity hold the torque: k_s a + m g L sin a = tau_e."""
    knee = so.plants.let_stick(so.plants.rotary("pendulum", external=True))
    params = knee.defaults.update(f_c=5.0, d_l=6.0)
    n = 1000
    log = so.Log.from_arrays(time=np.arange(n) / 500, I=np.zeros(n), tau_e=np.full(n, 40.0))
    run = so.simulate(knee, params, log, initial_state={}, rtol=1e-3)
    angle = run["theta_l"][-1]
    weight = params["m"].value * params["g"].value * params["L"].value
    assert params["k_s"].value * angle + weight * math.sin(angle) == pytest.approx(40.0, rel=1e-6)
    assert np.max(np.abs(run["theta_m"])) < 1e-5
    np.testing.assert_allclose(run["tau_s"], -params["k_s"].value * run["theta_l"], atol=1e-4)
    without = so.simulate(knee, params, so.Log.from_arrays(time=log.time, I=log["I"]), initial_state={})
    assert np.max(np.abs(without["theta_l"])) == 0.0


def test_a_plant_is_made_to_stick_by_the_option_that_a_problem_file_has():
    for make in (so.plants.rotary, so.plants.high_impedance, so.plants.moving_output, so.plants.two_link):
        assert make(sticks=True).sticks and not make().sticks
    with pytest.raises(PlantError, match="sticks by itself"):
        so.plants.rotary(parts=["lugre"], sticks=True)
