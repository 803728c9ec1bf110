"""Energy, momentum, and what the parts do: laws that the code was not written from."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

import seaopt as so
from seaopt.errors import PlantError
from seaopt.plants import PARTS, wrapped
from tests.casadi_functions import compile_expression

INSIDE = ("stribeck", "backlash", "hardening", "spring_damping", "screw_mode")
VALUES = {
    "f_c": 20.0,
    "f_s": 35.0,
    "v_s": 5e-3,
    "v_st": 2e-2,
    "c_k": 150.0,
    "k_3": 2e11,
    "d1": 0.2,
    "d2": 0.3,
    "eta": 0.9,
}


def values_of(plant):
    params = plant.defaults
    return params.update(**{name: value for name, value in VALUES.items() if name in params})


def numbers(plant, params):
    """Return f and h as NumPy functions of (x, u)."""
    p = plant.complete(params).vector
    arguments = (plant.x, plant.u, plant.p)
    f, h = (compile_expression(arguments, expression) for expression in (plant.dynamics, plant.output))
    return (lambda x, u: f(x, u, p)), (lambda x, u: h(x, u, p))


def spring_energy(delta, parts, p):
    """Return the energy stored in spring and play, by quadrature of the written law."""

    def force(x):
        z = x
        if "backlash" in parts:
            g, e = p["g_b"], p["eps_b"]
            z = x + 0.5 * (math.hypot(x - g, e) - math.hypot(x + g, e))
        return p["k"] * z + (p["k_3"] * z**3 if "hardening" in parts else 0.0)

    corners = sorted({c for c in (-p.get("g_b", 0), p.get("g_b", 0)) if min(0, delta) < c < max(0, delta)})
    return quad(force, 0, delta, epsabs=1e-13, epsrel=1e-12, limit=200, points=corners or None)[0]


def books(x, u, links, drive, spring, parts, p, energy=True):
    """Return stored energy, dissipated power and power put in, written from the bodies and not from the code."""
    s = dict(x)
    r = p["l"] / (2 * math.pi * p["N_p"])
    rotor, b_m = p["J"] / r**2, p["b_r"] / r**2
    position, speed, stored, lost, put = {}, {}, 0.0, 0.0, 0.0
    for i, link in enumerate(links, start=1):
        if link == "fixed":
            position[i] = speed[i] = 0.0
        elif link == "mass":
            position[i], speed[i] = s[f"x_{i}"], s[f"v_{i}"]
            stored += 0.5 * p[f"m_{i}"] * speed[i] ** 2
        else:
            phi, rate = s[f"phi{i}"], s[f"phid{i}"]
            position[i], speed[i] = p[f"L_a{i}"] * math.sin(phi), p[f"L_a{i}"] * math.cos(phi) * rate
            stored += 0.5 * p[f"I_p{i}"] * rate**2 + p[f"m{i}"] * p["g"] * p[f"L{i}"] * (1 - math.cos(phi))
            lost += p[f"d{i}"] * rate**2
        put += u[f"Fe{i}"] * speed[i]
    stretch, stretch_rate = s.get("s", 0.0), s.get("sd", 0.0)
    qd = s["qd"]
    if spring == "link1":
        nut = speed[2] + stretch_rate
        body = nut + qd
        delta, delta_rate = s["q"] + position[2] + stretch - position[1], body - speed[1]
    elif drive == "unlumped":
        nut = speed[1] - qd + stretch_rate
        body = speed[1]
        delta, delta_rate = position[2] - (position[1] - s["q"] + stretch), speed[2] - nut
    else:
        nut = speed[1] + stretch_rate
        body = nut - qd
        delta, delta_rate = position[2] - (position[1] + stretch - s["q"]), speed[2] - body
    if drive == "unlumped":
        stored += 0.5 * rotor * qd**2 + 0.5 * p["m_l"] * body**2
    else:
        stored += 0.5 * (p["m_l"] + rotor) * body**2
    stored = stored + spring_energy(delta, parts, p) if energy else 0.0
    if "screw_mode" in parts:
        stored += 0.5 * p["m_n"] * nut**2 + 0.5 * p["k_b"] * stretch**2
        lost += p["c_b"] * stretch_rate**2
    if "spring_damping" in parts:
        lost += p["c_k"] * delta_rate**2
    level = p["f_c"] + ((p["f_s"] - p["f_c"]) * math.exp(-((qd / p["v_st"]) ** 2)) if "stribeck" in parts else 0.0)
    lost += b_m * qd**2 + level * math.tanh(qd / p["v_s"]) * qd
    put += p["eta"] * p["K_tau"] / r * u["I"] * qd
    return stored, lost, put


COMBINATIONS = [
    (links, drive, spring, parts)
    for links in (("fixed", "fixed"), ("mass", "pendulum"), ("pendulum", "mass"))
    for drive in ("unlumped", "lumped")
    for spring in ("link1", "link2")
    for parts in ((), INSIDE)
]
LONGER = (("mass", "pendulum"), "unlumped", "link1", INSIDE)


@pytest.mark.parametrize(("links", "drive", "spring", "parts"), COMBINATIONS)
def test_energy_is_conserved(links, drive, spring, parts):
    """Along a trajectory, power in = rate of stored energy + dissipated, integrated, to 1e-8 of the energy."""
    plant = so.plants.two_link(*links, drive=drive, spring=spring, parts=parts)
    params = values_of(plant)
    p = {name: item.value for name, item in params.items()}
    rate, _ = numbers(plant, params)
    rng = np.random.default_rng(3)
    start = 1e-2 * rng.normal(size=len(plant.states)) * [0.05 if n in ("q", "s") else 1 for n in plant.states]
    n = len(plant.states)

    def inputs(t):
        return {"I": 2 * math.sin(40 * t), "Fe1": 15 * math.cos(25 * t), "Fe2": -20 * math.sin(31 * t)}

    def extended(t, z):
        u = inputs(t)
        _, lost, put = books(zip(plant.states, z[:n], strict=True), u, links, drive, spring, parts, p, energy=False)
        return np.r_[rate(z[:n], list(u.values())), lost, put]

    # One combination for longer: two and a half periods of its slowest input, and all of its parts.
    duration_s = 0.15 if (links, drive, spring, parts) == LONGER else 0.06
    run = solve_ivp(extended, (0, duration_s), np.r_[start, 0, 0], method="DOP853", rtol=1e-12, atol=1e-14)
    first, last = (
        books(zip(plant.states, run.y[:n, k], strict=True), inputs(0), links, drive, spring, parts, p)[0]
        for k in (0, -1)
    )
    lost, put = run.y[n, -1], run.y[n + 1, -1]
    assert abs(first + put - lost - last) <= 1e-8 * max(first, last, abs(put), lost)


@pytest.mark.parametrize("drive", ["unlumped", "lumped"])
@pytest.mark.parametrize("spring", ["link1", "link2"])
@pytest.mark.parametrize("parts", [(), INSIDE])
def test_momentum_is_conserved_between_free_masses(drive, spring, parts):
    """Both links free: d/dt of all momentum along x is Fe1 + Fe2, whatever the motor does; the links feel +F1, -F2."""
    plant = so.plants.two_link("mass", "mass", drive=drive, spring=spring, parts=parts)
    params = values_of(plant)
    p = {name: item.value for name, item in params.items()}
    rate, output = numbers(plant, params)
    rng = np.random.default_rng(1)
    for _ in range(20):
        x = 1e-3 * rng.normal(size=len(plant.states))
        u = rng.normal(size=3) * [3, 50, 50]
        d = dict(zip(plant.states, rate(x, u), strict=True))
        f1, f2 = output(x, u)[:2]
        scale = abs(f1) + abs(f2) + abs(u[1]) + abs(u[2]) + 1
        assert p["m_1"] * d["v_1"] == pytest.approx(f1 + u[1], abs=1e-9 * scale)
        assert p["m_2"] * d["v_2"] == pytest.approx(-f2 + u[2], abs=1e-9 * scale)
        sdd = d.get("sd", 0.0)
        r = p["l"] / (2 * math.pi * p["N_p"])
        sprung = p["m_l"] + (p["J"] / r**2 if drive == "lumped" else 0.0)
        if spring == "link1":
            nut = d["v_2"] + sdd
            body = nut + d["qd"]
        elif drive == "unlumped":
            nut, body = d["v_1"] - d["qd"] + sdd, d["v_1"]
        else:
            nut = d["v_1"] + sdd
            body = nut - d["qd"]
        momentum = p["m_1"] * d["v_1"] + p["m_2"] * d["v_2"] + sprung * body
        momentum += p["m_n"] * nut if "screw_mode" in parts else 0.0
        assert momentum == pytest.approx(u[1] + u[2], abs=1e-8 * scale)


def test_an_impulse_on_link_2_moves_m_l_without_turning_j(thor):
    """Sec. II-E: with m_1 fixed, an impulse on m_2 moves m_l through the spring; the lumped model must turn J."""
    accelerations = {}
    for drive in ("unlumped", "lumped"):
        plant = so.plants.two_link("fixed", "mass", drive=drive)
        params = plant.defaults.update(m_2=10.0)
        rate, _ = numbers(plant, params)
        d = dict(zip(plant.states, rate(np.zeros(4), [0.0, 0.0, 1.0]), strict=True))
        accelerations[drive] = {"link": d["v_2"], "sprung": d["v_2"] + d["qd"], "turn": abs(d["qd"])}
    unlumped, lumped = accelerations["unlumped"], accelerations["lumped"]
    # Unlumped: link and m_l go together, (10 + 0.646) kg and next to nothing of the 294 kg of J/r^2.
    assert unlumped["sprung"] / unlumped["link"] == pytest.approx(1.0, abs=0.01)
    assert unlumped["turn"] < 0.01 * unlumped["link"]
    assert unlumped["link"] == pytest.approx(1 / 10.646, rel=0.01)
    # Lumped: m_k stays behind, so the screw must turn as fast as the link moves.
    assert abs(lumped["sprung"]) < 1e-9
    assert lumped["turn"] == pytest.approx(lumped["link"])


def test_either_end_measures_the_same_force_only_when_unlumped(thor):
    """F1/F2: resonance at 160 Hz unlumped, 7.47 Hz lumped (printed), so about one over 15-60 Hz only when unlumped."""
    s = 2j * np.pi * np.geomspace(15, 60, 30)
    for drive, near in (("unlumped", True), ("lumped", False)):
        model = so.plants.high_impedance(drive=drive).linearize(thor)
        ratio = np.array([model(x)[0, 0] / model(x)[1, 0] for x in s])
        assert bool(np.max(np.abs(np.abs(ratio) - 1)) < 0.2) is near


def test_rotary_conserves_angular_momentum():
    """Motor, link and housing: J_m thetadd_m + J_l thetadd_l + d_l thetad_l + tau_h = 0."""
    plant = so.plants.rotary()
    params = plant.defaults.update(d_l=0.4, c_s=2.0)
    rate, output = numbers(plant, params)
    rng = np.random.default_rng(0)
    for _ in range(10):
        x, u = rng.normal(size=4), rng.normal(size=1)
        d, y = rate(x, u), output(x, u)
        total = params["J_m"].value * d[1] + params["J_l"].value * d[3] + 0.4 * x[3] + y[3]
        assert total == pytest.approx(0.0, abs=1e-9 * np.abs(y).max())


def test_rotary_energy_and_frequencies():
    plant = so.plants.rotary()
    params = plant.defaults.update(b_r=0.0)
    poles = plant.linearize(params).poles()
    derived = plant.derived_values()
    wanted = [derived[name][0] for name in ("antiresonance_hz", "resonance_hz")]
    antiresonance, resonance = map(float, ca.Function("d", [plant.p], wanted)(plant.complete(params).vector))
    assert np.max(np.abs(poles.imag)) / 2 / np.pi == pytest.approx(resonance, rel=1e-9)
    zeros = plant.linearize(params)[1, 0].zeros()
    assert np.max(np.abs(zeros.imag)) / 2 / np.pi == pytest.approx(antiresonance, rel=1e-6)


def test_the_two_mass_drive_is_rotary_with_n_1():
    """problems/twomass.py's own plant, its matrices from rotary: J_m = 1, N = 1."""
    plant = so.plants.rotary()
    params = plant.defaults.update(J_m=1.0, N=1.0, J_l=0.908, k_s=109340.0, c_s=0.79, b_r=2.0, d_l=24.7, K_tau=201.0)
    model = plant.linearize(params)
    expected = np.array(
        [
            [0, 1, 0, 0],
            [-109340, -2.79, 109340, 0.79],
            [0, 0, 0, 1],
            [109340 / 0.908, 0.79 / 0.908, -109340 / 0.908, -25.49 / 0.908],
        ]
    )
    np.testing.assert_allclose(model.A, expected)
    np.testing.assert_allclose(model.B.ravel(), [0, 201, 0, 0])


def test_a_clamped_flexible_link_is_rotary_with_a_heavy_motor():
    """The flexible link's published 2.94 Hz with its base clamped: k_s = J_l (2 pi 2.94)^2."""
    plant = so.plants.rotary()
    inertia = 0.0038
    params = plant.defaults.update(J_m=1e6, N=70.0, J_l=inertia, k_s=inertia * (2 * np.pi * 2.94) ** 2, b_r=0.0)
    poles = plant.linearize(params).poles()
    assert np.max(np.abs(poles.imag)) / 2 / np.pi == pytest.approx(2.94, rel=1e-4)


def test_the_screw_mode_is_at_80_hz_and_keeps_the_rest(thor):
    plant = so.plants.high_impedance(parts=("screw_mode",))
    model = plant.linearize(thor)
    frequencies = np.sort(np.abs(model.poles())) / 2 / np.pi
    assert frequencies[-1] == pytest.approx(80, rel=0.01)
    assert frequencies[0] == pytest.approx(7.5, rel=0.1)
    damping = -model.poles().real / np.abs(model.poles())
    assert damping[np.argmax(np.abs(model.poles()))] == pytest.approx(0.03, rel=0.1)
    np.testing.assert_allclose(model.dcgain()[:2, 0], 240.33, rtol=1e-4)


def test_parts_at_their_neutral_values_change_nothing(thor):
    plain = so.plants.moving_output()
    dressed = so.plants.moving_output(parts=("stribeck", "backlash", "hardening", "spring_damping"))
    neutral = thor.with_parameters(*dressed.defaults.values()).update(g_b=0.0, f_s=0.0)
    rng = np.random.default_rng(0)
    x, u = 1e-3 * rng.normal(size=4), [1.0]
    for a, b in zip(numbers(plain, thor), numbers(dressed, neutral), strict=True):
        np.testing.assert_allclose(a(x, u), b(x, u), rtol=1e-9)


def test_backlash_is_a_dead_zone(thor):
    """Within the play next to no force, beyond it the spring's, 20 um later."""
    plant = so.plants.high_impedance(parts=("backlash",))
    params = thor.with_parameters(*plant.defaults.values()).update(g_b=2e-5, eps_b=1e-7)
    _, output = numbers(plant, params)
    assert abs(output([1e-5, 0], [0])[0]) < 0.01 * 655e3 * 1e-5
    assert output([1e-4, 0], [0])[0] == pytest.approx(655e3 * 8e-5, rel=1e-3)


def test_stribeck_falls_from_breakaway_to_coulomb(thor):
    plant = so.plants.high_impedance(drive="lumped", parts=("stribeck",))
    params = thor.with_parameters(*plant.defaults.values()).update(f_c=20, f_s=50, v_s=1e-4, v_st=5e-3, b_r=0.0)
    _, output = numbers(plant, params)
    slow, fast = (-output([0, v], [0])[1] for v in (1e-3, 5e-2))  # F2 = F_m - friction
    assert slow == pytest.approx(20 + 30 * math.exp(-0.04), rel=1e-3)
    assert fast == pytest.approx(20, rel=1e-3)


def test_current_loop_and_load_cell_are_first_order(stand, thor):
    plant = wrapped(stand, ["current_loop", "load_cell"])
    params = thor.with_parameters(*plant.defaults.values()).update(current_loop_hz=200, load_cell_hz=300)
    inner, outer = stand.linearize(thor), plant.linearize(params)
    for f in (1.0, 50.0, 400.0):
        s = 2j * np.pi * f
        expected = inner(s)[:2, 0] / (1 + s / (400 * np.pi)) / (1 + s / (600 * np.pi))
        np.testing.assert_allclose(outer(s)[:2, 0], expected, rtol=1e-9)
        np.testing.assert_allclose(outer(s)[2, 0], inner(s)[2, 0] / (1 + s / (400 * np.pi)), rtol=1e-9)


@pytest.mark.parametrize("zeta", [None, 0.4])
def test_a_sensors_filter_is_a_low_pass_of_second_order(stand, thor, zeta):
    """Butterworth's where no damping is stated; at rest it reads what is."""
    plant = wrapped(stand, ["sensor_filter"])
    params = thor.with_parameters(*plant.defaults.values()).update(
        sensor_filter_hz=60, **({"zeta_f": zeta} if zeta else {})
    )
    inner, outer, w = stand.linearize(thor), plant.linearize(params), 120 * np.pi
    damping = 2 * (zeta or math.sqrt(0.5))
    for f in (0.01, 30.0, 60.0, 400.0):
        s = 2j * np.pi * f / w
        np.testing.assert_allclose(outer(s * w)[:2, 0], inner(s * w)[:2, 0] / (1 + damping * s + s**2), rtol=1e-9)
        np.testing.assert_allclose(outer(s * w)[2, 0], inner(s * w)[2, 0], rtol=1e-9)


def test_delays_have_the_exact_phase_in_their_band(stand, thor):
    """One degree up to 0.45/T, and unit gain everywhere."""
    plant = wrapped(stand, ["command_delay", "measurement_delay"])
    params = thor.with_parameters(*plant.defaults.values()).update(T_c=2e-3, T_m=1e-3)
    inner, outer = stand.linearize(thor), plant.linearize(params)
    for f in (1.0, 50.0, 220.0):
        s = 2j * np.pi * f
        ratio = outer(s)[0, 0] / inner(s)[0, 0]
        assert abs(ratio) == pytest.approx(1.0, rel=1e-6)
        assert abs(np.degrees(np.angle(ratio / np.exp(-3e-3 * s)))) < 1.0


# What changes a friction's curve has none to change where bristles make it.
ON_A_CURVE = ("friction_drift", "friction_direction", "back_driving", "cogging")


@pytest.mark.slow
@pytest.mark.parametrize(
    "excluded",
    [
        ("voltage_input", "duty_input", "supply_input", "supply_sag", "inductance", "lugre", "servo_sample"),
        ("duty_input", "supply_input", "supply_sag", "current_loop", "servo_hold", *ON_A_CURVE),
        ("voltage_input", "current_loop", "servo_hold", *ON_A_CURVE),
    ],
)
def test_every_part_composes_on_every_plant(excluded):
    parts = tuple(part for part in PARTS if part not in (*excluded, "stand"))
    for plant in (
        so.plants.high_impedance(parts=(*parts, "stand")),
        so.plants.moving_output(parts=parts, spring="link2"),
        so.plants.two_link("mass", "pendulum", parts=parts),
        so.plants.rotary(parts=tuple(part for part in parts if part != "screw_mode")),
    ):
        stated = [
            so.Parameter(name=n, value=300.0, unit=plant.parameter_unit(n)) for n in ("k_n", "k_p")
        ]  # no defaults
        rate, output = numbers(plant, plant.defaults.with_parameters(*stated))
        x, u = np.full(len(plant.states), 1e-3), np.ones(len(plant.inputs))
        assert np.all(np.isfinite(rate(x, u)))
        assert np.all(np.isfinite(output(x, u)))


def test_unknown_parts_are_refused(stand):
    with pytest.raises(PlantError, match='did you mean "backlash"'):
        so.plants.high_impedance(parts=("backlas",))
    with pytest.raises(PlantError, match="none of the outputs"):
        wrapped(so.plants.rotary(), ["load_cell"], outputs=("F1", "F2"))
    with pytest.raises(PlantError, match='no input "V"'):
        wrapped(stand, ["current_loop"], source="V")


def test_wrapping_keeps_time():
    plant = so.Plant(
        name="clock", states={"v": "m/s"}, inputs={"u": "N"}, outputs={"w": "m/s"}, parameters={"a": "1/s"},
        f=lambda t, x, u, p: {"v": u.u - p.a * x.v + t}, h=lambda t, x, u, p: {"w": x.v + 5 * t},
    )  # fmt: skip
    dressed = wrapped(plant, ["load_cell"], outputs=("w",))
    assert ca.depends_on(dressed.dynamics[1], dressed.t)


def test_parts_that_do_not_belong_are_refused(stand):
    for words, attempt in (
        ("sits inside", lambda: wrapped(so.plants.rotary(), ("stribeck",))),
        ("given twice", lambda: so.plants.high_impedance(parts=("load_cell", "load_cell"))),
        ("already", lambda: wrapped(wrapped(stand, ["load_cell"]), ["load_cell"])),
    ):
        with pytest.raises(PlantError, match=words):
            attempt()


def test_installed_packages_add_kinds(monkeypatch):
    import seaopt.plants.kinds as kinds

    class Entry:
        name, value = "my_actuator", "mine:actuator"

        @staticmethod
        def load():
            return lambda drive="unlumped": so.plants.high_impedance(drive=drive)

    class Broken(Entry):
        name = "broken"

        @staticmethod
        def load():
            raise ImportError("no module named mine")

    monkeypatch.setattr(kinds, "entry_points", lambda group: [Entry, Broken])
    assert kinds.plant_of_kind("my_actuator", drive="lumped").name == "high_impedance(lumped)"
    with pytest.raises(PlantError, match="no module named mine"):
        kinds.plant_of_kind("broken")
