"""Plants written in the problem file: the built-in ones again, through the same stages; mistakes and their places."""

from __future__ import annotations

import pickle
import tomllib

import casadi as ca
import numpy as np
import pytest

import seaopt as so
from seaopt.bench import Chirp
from seaopt.cli.provenance import digest_sources
from seaopt.control import passivity
from seaopt.plants import plant_of_kind
from seaopt.plants.friction import friction_matrices, friction_slopes
from seaopt.plants.impacts import catch, release
from seaopt.plants.plant import deflection_row, dynamics_function, output_function, state_space
from seaopt.problem import json_schema

# The stand and the swing phase of Orekhov et al. 2015, unlumped, spring at link 1, by eliminating F2 by hand.
THOR = """
schema = 1
[parameters]
J = { value = 2e-6, free = true, min = 1e-8 }
f_c = 12.0

[plant.stand]
states = { q = "m", qd = "m/s" }
inputs = { I = "A" }
outputs = { F1 = "N", F2 = "N", q = "m" }
energy = "0.5*(M + m_l)*qd^2 + 0.5*k*q^2"
[plant.stand.parameters]
PARAMETERS
[plant.stand.definitions]
r = "l/(2*pi*N_p)"
M = "J/r^2"
F_m = "eta*K_tau/r*I - b_r/r^2*qd - F_f"
qdd = "(F_m - k*q)/(M + m_l)"
[plant.stand.f]
q = "qd"
qd = "qdd"
[plant.stand.h]
F1 = "k*q"
F2 = "k*q + m_l*qdd"
q = "q"
[plant.stand.friction.F_f]
velocity = "qd"
force = "f_c*tanh(v/v_s)"
slopes = ["0", "f_c/v_s"]
jump = "f_c"
smoothing = "v_s"
[plant.stand.actuation]
input = "I"
effort = "eta*K_tau/r"
efficiency = "eta"
[plant.stand.sensing]
regulated = ["F1", "F2"]
motor_position = "q"
motor_speed = "qd"
[plant.stand.spring]
deflection = "q"
unit = "m"
stiffness = "k"
[[plant.stand.ports]]
probe = "bare"

[plant.bare]
kind = "two_link"
link2 = "mass"

[plant.swing]
states = { q = "m", qd = "m/s", phi = "rad", phid = "rad/s" }
inputs = { I = "A" }
outputs = { F1 = "N", F2 = "N", q = "m", phi = "rad", x_2 = "m" }
energy = '''0.5*M*qd^2 + 0.5*m_l*(qd + L_a*cos(phi)*phid)^2 + 0.5*I_p*phid^2
            + m*g*L*(1 - cos(phi)) + 0.5*k*delta^2'''
[plant.swing.parameters]
PARAMETERS
L_a = "m"
I_p = "kg m^2"
m = { unit = "kg", value = 4.0, min = 0 }
L = "m"
d = "N m s/rad"
g = "m/s^2"
[plant.swing.definitions]
F2 = '''(k*delta + m_l*(F_m/M - L_a*cos(phi)*G/I_p - L_a*sin(phi)*phid^2))
        / (1 + m_l/M + m_l*(L_a*cos(phi))^2/I_p)'''
G = "m*g*L*sin(phi) + d*phid"
F_m = "eta*K_tau/r*I - b_r/r^2*qd - F_f"
delta = "q + L_a*sin(phi)"
M = "J/r^2"
r = "l/(2*pi*N_p)"
[plant.swing.f]
q = "qd"
qd = "(F_m - F2)/M"
phi = "phid"
phid = "-(F2*L_a*cos(phi) + G)/I_p"
[plant.swing.h]
F1 = "k*delta"
F2 = "F2"
q = "q"
phi = "phi"
x_2 = "L_a*sin(phi)"
[plant.swing.friction.F_f]
velocity = "qd"
force = "f_c*tanh(v/v_s)"
slopes = ["0", "f_c/v_s"]
jump = "f_c"
[plant.swing.actuation]
input = "I"
effort = "eta*K_tau/r"
efficiency = "eta"
[plant.swing.sensing]
regulated = ["F1", "F2"]
[plant.swing.spring]
deflection = "delta"
unit = "m"
stiffness = "k"
[[plant.swing.ports]]
motion = "x_2"
coordinate = "phi"
rate = "phid"
payload = ["I_p", "m"]
drive = "q"
ratio = 1
held = "stand"
probe = "bare"
"""
DECLARED = """m_l = "kg"
k = "N/m"
l = "m"
N_p = "-"
K_tau = "N m/A"
J = "kg m^2"
b_r = "N m s"
eta = { unit = "-", value = 1.0 }
f_c = "N"
v_s = "m/s"
"""
EXPERIMENT = """
[[experiment]]
name = "swing"
plant = "swing"
virtual = { seed = 2, duration_s = 6, rate_hz = 400, noise_std = { F1 = 2.0, F2 = 2.0 }, truth = { J = 3.31e-6 }, \
excitation = { noise = { std = 3.5, band_hz = 150 } } }
[controller]
plant = "stand"
bandwidth_hz = 30
robust_to = ["swing"]
"""


def values():
    """Return THOR's published parameters as the lines of a problem file."""
    own = {name: item.value for name, item in so.plants.thor().items() if name not in ("J", "f_c")}
    return "".join(f"{name} = {value!r}\n" for name, value in own.items())


TEXT = THOR.replace("PARAMETERS", DECLARED).replace("f_c = 12.0\n", f"f_c = 12.0\n{values()}") + EXPERIMENT


@pytest.fixture
def read(tmp_path):
    def _read(text=TEXT, old="", new=""):
        assert old in text
        path = tmp_path / "problem.toml"
        path.write_text(text.replace(old, new, 1) if old else text, encoding="utf-8")
        return so.read_problem(path)

    return _read


@pytest.fixture
def thor(read):
    """Return the file's parameters, at the truth."""
    return read().parameters.update(J=3.31e-6)


@pytest.mark.parametrize("name", ["stand", "swing"])
def test_the_built_in_plants_as_text_are_the_same(read, thor, name):
    """f, h, energy and every role at random points."""
    own, built_in = read().plants[name], {"stand": so.plants.high_impedance, "swing": so.plants.moving_output}[name]()
    rng = np.random.default_rng(1)
    p, p_2 = own.complete(thor).vector, built_in.complete(thor).vector
    start = rng.normal(size=len(own.states)), [0.0], p
    energies = [
        ca.Function("e", [plant.x, plant.p], [plant.stored_energy()]) for plant in (own, built_in)
    ]  # fmt: skip
    for _ in range(20):
        x, u = rng.normal(size=len(own.states)) * [1e-3, 0.1, 1.0, 3.0][: len(own.states)], rng.normal(size=1)
        np.testing.assert_allclose(dynamics_function(own)(x, u, p), dynamics_function(built_in)(x, u, p_2), rtol=1e-9)
        np.testing.assert_allclose(output_function(own)(0, x, u, p), output_function(built_in)(0, x, u, p_2), rtol=1e-9)
        gain = [float(energy(x, q) - energy(start[0], q)) for energy, q in zip(energies, (p, p_2), strict=True)]
        assert gain[0] == pytest.approx(gain[1], rel=1e-9)
        blocks = [friction_matrices(plant)(x, u, q) for plant, q in ((own, p), (built_in, p_2))]
        for one, other in zip(*blocks, strict=True):
            np.testing.assert_allclose(np.array(one), np.array(other), rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(friction_slopes(own, thor), friction_slopes(built_in, thor))
    np.testing.assert_array_equal(
        deflection_row(own, own.complete(thor)), deflection_row(built_in, built_in.complete(thor))
    )
    for one, other in zip(state_space(own, thor), state_space(built_in, thor), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


def test_what_is_held_and_probed_is_another_plant_of_the_file(read, thor):
    problem, built_in = read(), so.plants.moving_output()
    swing = problem.plants["swing"]
    assert swing.port.held() is problem.plants["stand"] and swing.port.probe() is problem.plants["bare"]
    assert problem.with_partners(["swing"]) == ["stand", "bare", "swing"]
    x = np.array([1e-3, 0.02, 0.3, -1.0])
    caught = [catch(plant, plant.complete(thor), x, plant.port) for plant in (swing, built_in)]
    np.testing.assert_allclose(caught[0][0], caught[1][0], rtol=1e-9)
    assert caught[0][1:] == pytest.approx(caught[1][1:], rel=1e-9)
    states = [
        release(plant, plant.complete(thor), plant.port, caught[0][0], {"phi": 0.2}) for plant in (swing, built_in)
    ]
    np.testing.assert_allclose(*states, rtol=1e-9)


@pytest.mark.slow
def test_friction_that_sticks_and_parts_around_are_those_of_the_built_in_plant(read, thor):
    text = TEXT.replace("[plant.stand]\n", '[plant.stand]\nsticks = true\nparts = ["current_loop"]\n', 1)
    own = read(text, 'held = "stand"\n', "").plants["stand"]
    built_in = plant_of_kind("high_impedance", sticks=True, parts=["current_loop"])
    chirp = (Chirp(amplitude=0.2, f0_hz=5, f1_hz=20),)
    log = so.virtual_log(built_in, built_in.complete(thor), chirp, duration_s=0.2, rate_hz=400, seed=1)
    runs = [so.simulate(plant, thor, log) for plant in (own, built_in)]
    np.testing.assert_allclose(runs[0]["F1"], runs[1]["F1"], rtol=1e-6, atol=1e-6)


def test_friction_grows_with_a_load(read):
    text = """
schema = 1
[parameters]
f_c = 1.0
K = 0.5
J = 0.2
[plant.gear]
states = { theta = "rad", omega = "rad/s" }
inputs = { I = "A" }
outputs = { theta = "rad" }
parameters = { f_c = "N m", K = "N m/A", J = "kg m^2" }
f = { theta = "omega", omega = "(K*I - rub)/J" }
h = { theta = "theta" }
actuation = { input = "I", effort = "K", unit = "N m", speed = "omega" }
[plant.gear.friction.rub]
velocity = "omega"
force = "(f_c + 0.1*abs(torque))*tanh(v/0.01)"
slopes = ["0", "(f_c + 0.1*abs(torque))/0.01"]
jump = "f_c + 0.1*abs(torque)"
loads = { torque = "K*I" }
rated = { torque = 2.0 }
unit = "N m"
"""
    problem = read(text)
    gear = problem.plants["gear"]
    rates = np.array(dynamics_function(gear)([0.0, 3.0], [4.0], gear.complete(problem.parameters).vector)).ravel()
    np.testing.assert_allclose(rates, [3.0, (0.5 * 4.0 - 1.2) / 0.2])
    assert friction_slopes(gear, problem.parameters)[1] == pytest.approx([120.0])  # at the rated load
    assert pickle.loads(pickle.dumps(gear)).friction["rub"].rated == {"torque": 2.0}
    with pytest.raises(so.SeaoptError, match="the loads torque, and rated has none"):
        read(text, "rated = { torque = 2.0 }\n", "")
    with pytest.raises(so.SeaoptError, match=r"parameters.K has the name of a friction's load"):
        read(text.replace("torque", "K"))


def test_a_partner_alone_is_not_certified(read):
    problem = read(old='held = "stand"\n', new="")
    assert list(problem.certified_plants()) == ["stand", "swing"]


@pytest.fixture
def both(read):
    """Return the problem, without friction, with its plants as data and with the built-in ones."""
    text = [line for line in TEXT[TEXT.index("[[experiment]]") :].splitlines() if line]
    kinds = '[plant.stand]\nkind = "high_impedance"\n[plant.swing]\nkind = "moving_output"\n'
    head = f"schema = 1\n[parameters]\nJ = {{ value = 2e-6, free = true, min = 1e-8 }}\n{values()}"
    return read(old="f_c = 12.0", new="f_c = 0.0"), read("\n".join([head, kinds, *text]))


@pytest.mark.slow
def test_the_fit_is_that_of_the_built_in_plant(both):
    fits = [so.fit(one.experiments(), one.parameters, **one.fit_options) for one in both]
    own, built_in = (fit.parameters["J"] for fit in fits)
    assert fits[0].met and own.value == pytest.approx(3.31e-6, rel=0.01)
    assert own.value == pytest.approx(built_in.value, rel=1e-6)
    assert own.std == pytest.approx(built_in.std, rel=1e-3)


@pytest.mark.slow
def test_controller_and_certificate_are_those_of_the_built_in_plants(both, thor):
    laws = [so.tune(one.design_plant, one.parameters, one.spec) for one in both]
    assert laws[0].feasible and laws[0].gains == pytest.approx(laws[1].gains, rel=1e-9)
    bands = [passivity(law, one.design_plant, thor) for law, one in zip(laws, both, strict=True)]
    np.testing.assert_allclose(bands[0].bands_hz, bands[1].bands_hz, rtol=1e-9)
    certificates = [
        so.certify(
            law, one.certified_plants(), one.parameters, ranges={"I_p": (0.2, 0.6)}, samples=20, simulations=False
        )
        for law, one in zip(laws, both, strict=True)
    ]
    assert certificates[0].passed == certificates[1].passed
    for one, another in zip(*(certificate.requirements for certificate in certificates), strict=True):
        assert (one.name, one.met) == (another.name, another.met)
        assert one.value == pytest.approx(another.value, rel=1e-6)


def test_a_plant_as_data_pickles_as_it_is(read, thor):
    swing = read().plants["swing"]
    again = pickle.loads(pickle.dumps(swing))
    x, p = [1e-3, 0.02, 0.3, -1.0], swing.complete(thor).vector
    np.testing.assert_array_equal(dynamics_function(swing)(x, [1.0], p), dynamics_function(again)(x, [1.0], p))
    assert list(again.port.held().states) == ["q", "qd"]


def test_a_changed_equation_makes_a_result_stale(read, tmp_path):
    before = {stage: digest_sources(read(), stage, tmp_path)["problem"] for stage in ("fit", "tune", "certify")}
    changed = read(old='F2 = "k*q + m_l*qdd"', new='F2 = "k*q + 2*m_l*qdd"')  # of the stand, which no experiment has
    after = {stage: digest_sources(changed, stage, tmp_path)["problem"] for stage in before}
    assert [before[stage] == after[stage] for stage in ("fit", "tune", "certify")] == [True, False, False]
    changed = read(old='G = "m*g*L*sin(phi)', new='G = "m*g*L*tan(phi)')
    assert digest_sources(changed, "fit", tmp_path)["problem"] != before["fit"]
    partner = read(old='[plant.bare]\nkind = "two_link"', new='[plant.bare]\nkind = "two_link"\ndrive = "lumped"')
    assert digest_sources(partner, "certify", tmp_path)["problem"] != before["certify"]


def test_what_is_declared_and_not_used_is_noted(read):
    assert read().notes == []
    odd = read(old='r = "l/(2*pi*N_p)"', new='r = "l/(2*pi*N_p)"\nwork = "k*N_p"')
    assert odd.notes == [
        'plant.stand.definitions.work is not used; leave it out, or look for the equation that lacks "work"'
    ]
    odd = read(old='m_l = "kg"\n', new='m_l = "kg"\nI_p = "kg m^2"\n')
    assert [note.split(" ")[0] for note in odd.notes] == ["plant.stand.parameters.I_p"]


def test_the_time_may_drive(read):
    text = """
schema = 1
parameters.w = 3.0
[plant.clock]
states = { y = "m" }
outputs = { y = "m" }
parameters = { w = "rad/s" }
f.y = "w*cos(w*t)"
h.y = "y"
"""
    plant = read(text).plants["clock"]
    dynamics = ca.Function("f", [plant.t, plant.x, plant.p], [plant.dynamics])
    assert float(dynamics(0.4, 0.0, 3.0)) == pytest.approx(3 * np.cos(1.2))


def test_the_velocity_of_a_friction_is_its_own_name(read):
    """A state v is what f means by v; in a friction's curves v is the velocity, without definitions of the state."""
    text = """
schema = 1
parameters.f_c = 2.0
parameters.m = 4.0
[plant.block]
states = { x = "m", v = "m/s" }
inputs = { F = "N" }
outputs = { x = "m" }
parameters = { f_c = "N", m = "kg" }
definitions = { twice = "2*v" }
f = { x = "twice/2", v = "(F - rub)/m" }
h = { x = "x" }
friction.rub = { velocity = "3*v", force = "f_c*v" }
"""
    plant = read(text).plants["block"]
    assert [float(row) for row in ca.vertsplit(dynamics_function(plant)([0, 5], [7], [2, 4]))] == [5, (7 - 2 * 15) / 4]
    with pytest.raises(so.SeaoptError, match=r'friction.rub.force, column 5: "twice" is a definition'):
        read(text, 'force = "f_c*v"', 'force = "f_c*twice"')
    with pytest.raises(so.SeaoptError, match=r"parameters.v has the name of the velocity"):
        read(text.replace('v = "m/s"', 'w = "m/s"').replace("v =", "w ="), 'm = "kg" }', 'm = "kg", v = "m" }')


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('q = "qd"\nqd', 'q = "qdd_"\nqd', r'plant.stand: f.q, column 1: unknown name "qdd_"; did you mean "qdd"'),
        ("- k*q)/(M", "- k*q/(M", r"definitions.qdd, column 1: this bracket is never closed"),
        ('q = "qd"\nqd', 'qdot = "qd"\nqd', r'f.qdot is the equation of no state; did you mean "qd"'),
        ('q = "qd"\nqd', "qd", r'state "q" has no equation; write f.q'),
        ('F1 = "k*q"\n', "", r'output "F1" has no equation; write h.F1'),
        ('q = "q"\n', 'q = "I"\n', r'h.q is the input "I" itself'),
        ('q = "q"\n', 'q = "F1"\n', r'h.q, column 1: "F1" is an output'),
        ('q = "q"\n', 'q = "l"\n', r'output "q" depends on no state and no input'),
        ('q = "q"\n', "q = true\n", r"plant.stand.h.q = True: should be a valid string"),
        ('M = "J/r^2"', 'M = "M*J"', r"definitions use each other in a circle, M -> M"),
        ('r = "l/(', 'r = "M/(', r"in a circle, (M -> r -> M|r -> M -> r)"),
        ('r = "l/(', 't = "l/(', r"definitions.t has the name of the time"),
        ('r = "l/(', 'sin = "l/(', r"definitions.sin has the name of a function"),
        ('r = "l/(', 'k = "l/(', r"definitions.k is also one of parameters"),
        ('r = "l/(', '"r 2" = "l/(', r'definitions: "r 2" is not a name'),
        ('l = "m"', 'l = "mm"', r'parameters.l = "mm" is not an SI unit; write "m"'),
        ('l = "m"', 'l = "flurb"', r'parameters.l: unit "flurb" is not known'),
        ('l = "m"', "l = { value = 1.0 }", r"plant.stand.parameters.l.unit is missing"),
        ('l = "m"', 'l = "m"\nextra = "m"', r"parameters.extra is missing"),
        ('unit = "-", value = 1.0', 'unit = "-", value = 1.0, min = 2', r"eta = 1 is outside its bounds"),
        ("outputs = { F1", "output = { F1", r'unknown key plant.stand.output; did you mean "outputs"'),
        ('[plant.stand.f]\nq = "qd"\nqd = "qdd"\n', "", r"plant.stand.f is missing"),
        ('effort = "eta', 'efort = "eta', r'unknown key plant.stand.actuation.efort; did you mean "effort"'),
        ('effort = "eta', 'effort = "q*eta', r'actuation.effort, column 1: "q" is a state, which may not stand here'),
        ('input = "I"', 'input = "U"', r'plant.stand: actuation.input = "U" is not one of its own'),
        ('["F1", "F2"]', '["F3"]', r'sensing.regulated = "F3" is not one of its own'),
        ('stiffness = "k"', 'stiffness = "c"', r'spring.stiffness = "c" is not one of its own'),
        ('deflection = "q"', 'deflection = "q - I"', r'spring.deflection, column 5: "I" is an input'),
        ('motor_speed = "qd"', 'motor_sped = "qd"', r'did you mean "motor_speed"'),
        ('velocity = "qd"', 'velocity = "I"', r'friction.F_f.velocity, column 1: "I" is an input'),
        ('force = "f_c*tanh(v', 'force = "f_c*tanh(qd', r'friction.F_f.force, column 10: "qd" is a state'),
        ('slopes = ["0", "f_c/v_s"]', 'slopes = ["0"]', r"slopes = .* is not a range"),
        ('smoothing = "v_s"', 'smoothing = "v"', r'friction.F_f.smoothing = "v" is not one of its own'),
        ("- b_r/r^2*qd - F_f", "- b_r/r^2*qd", r"friction.F_f is in no equation"),
        ('probe = "bare"', 'probe = "bear"', r'ports names "bear", which is not a \[plant\] .* did you mean "bare"'),
        ('probe = "bare"', 'held = "stand"', r"in a circle, stand -> stand"),
        ('held = "stand"', 'held = "bare"', r"ports.1.held: plant .* has the states q, qd, x_2, v_2"),
        ('motion = "x_2"', 'motin = "x_2"', r'unknown key plant.swing.ports.1.motin; did you mean "motion"'),
        ('energy = "0.5', 'energy = "I*0.5', r'energy, column 1: "I" is an input'),
        ("[plant.stand]\n", '[plant.stand]\nkind = "rotary"\n', r"either a kind or f, h, .* take one out"),
    ],
)  # fmt: skip
def test_mistakes_are_one_clear_line_with_their_place(read, old, new, words):
    with pytest.raises(so.SeaoptError, match=words) as raised:
        read(TEXT, old, new)
    assert "\n" not in str(raised.value) and "problem.toml" in str(raised.value)


@pytest.mark.parametrize("equation", ["(" * 200_000 + "q", "1e400*q", "9" * 5000, "q/0", "log(-1)*q", "q" * 1_000_000])
def test_hostile_equations_are_refused_by_name(read, equation):
    with pytest.raises(so.SeaoptError, match=r"plant.stand: f.qd"):
        read(TEXT, 'qd = "qdd"\n', f'qd = "{equation}"\n')


def test_many_definitions_that_double_each_other_are_read(read):
    """2^200 terms if they were written out; a CasADi expression shares them."""
    chain = "".join(f'a{n + 1} = "a{n} + a{n}"\n' for n in range(200))
    problem = read(TEXT, 'r = "l/(2*pi*N_p)"', f'a0 = "1"\n{chain}r = "l/(2*pi*N_p)*a200/2^200"')
    plant = problem.plants["stand"]
    effort = plant.actuation.effort(plant.complete(problem.parameters).by_attribute)
    assert float(effort) == pytest.approx(240.33, rel=1e-3)


def test_the_json_schema_knows_both_kinds_of_plant():
    jsonschema = pytest.importorskip("jsonschema")
    schema = jsonschema.Draft202012Validator(json_schema())
    content = tomllib.loads(TEXT)
    assert not list(schema.iter_errors(content))
    changes = {"f": None}, {"outputs": {"F1": 3}}, {"friction": {"F_f": {"velocity": "qd"}}}, {"h_": {}}
    for change in changes:
        wrong = {"stand": {**content["plant"]["stand"], **change}}
        assert list(schema.iter_errors({**content, "plant": wrong})), change


def test_an_output_may_have_the_name_of_a_function(read):
    text = (
        TEXT[: TEXT.index("[[experiment]]")]
        .replace("F1 =", "exp =", 2)
        .replace('"F1"', '"exp"', 1)
        .replace('r = "l', 'r = "exp(0)*l', 1)
    )
    plant = read(text).plants["stand"]
    assert next(iter(plant.outputs)) == "exp" and plant.sensing.regulated == ("exp", "F2")


def test_a_plant_has_so_much_text(read):
    sums = "".join(f'b{n} = "{"+k" * 4500}"\n' for n in range(6))
    with pytest.raises(so.SeaoptError, match=r"plant.stand: has 5\d+ characters of text; give at most 50000"):
        read(TEXT, "[plant.stand.definitions]", f"[plant.stand.definitions]\n{sums}")


def test_a_plant_has_so_many_names(read):
    with pytest.raises(so.SeaoptError, match=r"plant.stand: has 60[0-9] names; give at most 500"):
        read(
            TEXT,
            "[plant.stand.definitions]",
            "[plant.stand.definitions]\n" + "".join(f"b{n} = 1\n" for n in range(582)),
        )
