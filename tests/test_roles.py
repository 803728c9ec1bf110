"""Plants without defaults, every name unlike the built-in ones, go the whole way and come to the built-in figures."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from functools import partial
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

import seaopt as so
from seaopt.control import MPCSpec, command_of, export, force_mpc, passivity
from seaopt.control.laws.friction import find_friction_margin
from seaopt.control.loops.loop import LoopFigures
from seaopt.errors import ControlError, PlantError
from seaopt.plants import Actuation, Friction, Port, Sensing, wrapped
from seaopt.plants.friction import find_dry_friction
from seaopt.plants.impacts import catch, release
from seaopt.plants.plant import deflection_row
from seaopt.robustness.verification.environments import coupled_stability
from seaopt.robustness.verification.verification import verify
from tests.words import flatten

WORDS = {
    "q": "weg", "qd": "tempo", "phi": "winkel", "phid": "drehung", "x_2": "ort", "v_2": "geschwindigkeit", "I": "strom",
    "Fe1": "stoss_vorn", "Fe2": "stoss_hinten", "F1": "kraft_vorn", "F2": "kraft_hinten", "F_f": "reibung",
    "m_l": "schlitten", "k": "steifigkeit", "l": "steigung", "N_p": "getriebe", "K_tau": "drehmoment", "J": "laeufer",
    "b_r": "zaehigkeit", "eta": "wirkungsgrad", "f_c": "trockene", "v_s": "glaettung", "I_p": "traegheit", "m": "masse",
    "L": "laenge", "L_a": "hebel", "d": "gelenk", "g": "schwere", "m_2": "klotz",
}  # fmt: skip
UNITS = {"A": "V", "N": "N m", "N m/A": "N m/V"}  # a drive commanded in volts, whose effort is a torque
FIGURES = [field.name for field in fields(LoopFigures)]


def reworded(plant: so.Plant) -> so.Plant:
    """Return a plant with other names and units for everything, through the same equations."""

    def outer(names):
        return {WORDS[name]: UNITS.get(unit, unit) for name, unit in names.items()}

    def inner(space):
        back = {word: name for name, word in WORDS.items()}
        return SimpleNamespace(**{back.get(word, word): value for word, value in vars(space).items()})

    def of_states(expression):
        return lambda x, p: expression(inner(x), inner(p))

    def of_parameters(expression):
        return None if expression is None else lambda p: expression(inner(p))

    def port(port):
        words = {field: WORDS[getattr(port, field)] for field in ("motion", "coordinate", "rate", "effort", "drive")
                 if getattr(port, field)}  # fmt: skip
        makers = {field: partial(remake, getattr(port, field)) for field in ("held", "probe") if getattr(port, field)}
        payload = tuple(WORDS[name] for name in port.payload)
        return Port(**words, **makers, payload=payload, ratio=of_parameters(port.ratio))

    actuation, spring, sensing = plant.actuation, plant.spring, plant.sensing
    return so.Plant(
        name="antrieb",
        states=outer(plant.states),
        inputs=outer(plant.inputs),
        outputs=outer(plant.outputs),
        parameters={WORDS[name]: UNITS.get(item.unit, item.unit) for name, item in plant.parameters.items()},
        f=lambda t, x, u, p: {WORDS[name]: rate for name, rate in plant.f(t, *map(inner, (x, u, p))).items()},
        h=lambda t, x, u, p: {WORDS[name]: value for name, value in plant.h(t, *map(inner, (x, u, p))).items()},
        energy=of_states(plant.energy),
        optional_inputs=frozenset(WORDS[name] for name in plant.optional_inputs),
        actuation=Actuation(
            input="strom", effort=of_parameters(actuation.effort), unit="N m", efficiency="wirkungsgrad"
        ),
        sensing=Sensing(regulated=tuple(WORDS[name] for name in sensing.regulated), motor_position="weg"),
        spring=replace(
            spring, deflection=of_states(spring.deflection), stiffness="steifigkeit", mass=None, damping=None
        ),
        ports=tuple(port(item) for item in plant.ports),
        friction={
            WORDS[name]: Friction(
                velocity=of_states(item.velocity), force=lambda v, p, item=item: item.force(v, inner(p)), unit="N m"
            )
            for name, item in plant.friction.items()
        },
    )


def remake(make):
    return reworded(make())


def reworded_parameter(item):
    return replace(item, name=WORDS[item.name], unit=UNITS.get(item.unit, item.unit))


SPEC = so.ControllerSpec(
    bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0, passive_band_hz=(0.1, 20.0)
)
RANGES = {"I_p": (0.2, 0.6), "phi": (-0.3, 0.3), "J": (2.5e-6, 4e-6)}


@pytest.fixture(scope="module")
def words(thor):
    bare_inertia = so.plants.two_link("fixed", "mass").defaults["m_2"]  # of the port's probe
    return so.ParameterSet(reworded_parameter(item) for item in (*thor.values(), bare_inertia))


@pytest.fixture(scope="module")
def pair(stand, swing, thor, words):
    """Return the built-in controller and plants, and the reworded ones."""
    built_in = so.tune(stand, thor, SPEC, robust_to={"swing": swing})
    strange_stand, strange_swing = reworded(stand), reworded(swing)
    strange = so.tune(strange_stand, words, replace(SPEC, measured="kraft_vorn"), robust_to={"swing": strange_swing})
    return (built_in, stand, swing, thor), (strange, strange_stand, strange_swing, words)


def test_the_tuned_controller_is_the_same(pair):
    (built_in, *_), (strange, *_) = pair
    assert strange.feasible
    assert strange.gains == pytest.approx(built_in.gains, rel=1e-9)
    for name in FIGURES:
        found, expected = getattr(strange.achieved, name), getattr(built_in.achieved, name)
        assert found == (None if expected is None else pytest.approx(expected, rel=1e-9)), name
    assert strange.command == replace(built_in.command, input="strom", unit="V", effort_unit="N m")
    assert "V/(N m)" in repr(strange)
    again = so.Controller.from_dict(strange.to_dict(), *strange.design)
    assert again.command == strange.command and again.notes == strange.notes
    (of_volts,) = set(strange.notes) - set(built_in.notes)
    assert "9 V of strom" in of_volts  # the limit is of the command


def test_a_friction_margin_has_the_unit_of_the_plants_friction(pair):
    """A torque's is in N m s/rad; the figure is the built-in plant's."""
    shown = []
    for (controller, plant, _, params), f_c in zip(pair, ("f_c", WORDS["f_c"]), strict=True):
        rubbing = params.update(**{f_c: 20.0})
        margin = find_friction_margin(controller, plant, rubbing)
        shown += [repr(replace(controller, design=(plant, rubbing), friction=margin))]
    built_in, strange = (re.search(r"Friction margin (\S+) (N.*?)(?=[:(])", flatten(text)).groups() for text in shown)
    assert built_in == (strange[0], "N s/m") and strange[1] == "N m s/rad"


@pytest.mark.slow
def test_the_certificate_is_the_same(pair):
    certificates = [
        so.certify(
            controller, {"stand": stand, "swing": swing}, params, samples=60,
            ranges={name if params is built_in else WORDS[name]: ends for name, ends in RANGES.items()},
        simulations=False,
    )
        for controller, stand, swing, params in pair
        for built_in in (pair[0][3],)
    ]  # fmt: skip
    first, second = certificates
    assert first.passed == second.passed and first.monte_carlo.failures == second.monte_carlo.failures
    for name in ("stand", "swing"):
        assert second.worst[name].severity == pytest.approx(first.worst[name].severity, rel=1e-6)
    for one, other in zip(first.requirements, second.requirements, strict=True):
        assert (one.name, one.met) == (other.name, other.met)
        assert other.value == pytest.approx(one.value, rel=1e-6)


@pytest.mark.slow
def test_the_scenarios_and_what_they_show_are_the_same(pair):
    first, second = (
        verify(controller, {"stand": stand, "swing": swing}, params) for controller, stand, swing, params in pair
    )
    assert {row.scenario for row in second.rows} >= {"impact", "payload", "fall through 90 deg", "contact"}
    assert [(row.plant, row.scenario, row.passed) for row in first.rows] == [
        (row.plant, row.scenario, row.passed) for row in second.rows
    ]
    for one, other in zip(first.rows, second.rows, strict=True):
        for name in ("peak_force_N", "peak_command", "peak_angle_rad", "peak_energy_J", "final_error_N"):
            a, b = getattr(one, name), getattr(other, name)
            assert (a is None and b is None) or b == pytest.approx(a, rel=1e-5, abs=1e-9), (one.scenario, name)


def test_port_and_environments_are_the_same(pair):
    first, second = (passivity(controller, stand, params) for controller, stand, _, params in pair)
    np.testing.assert_allclose(second.bands_hz, first.bands_hz, rtol=1e-9)
    assert second.least_damping_N_s_per_m == pytest.approx(first.least_damping_N_s_per_m, rel=1e-9)
    maps = [
        coupled_stability(controller, stand, params, points=4, dampings_N_s_per_m=(10.0,))
        for controller, stand, _, params in pair
    ]
    np.testing.assert_allclose(maps[1].spectral_radius, maps[0].spectral_radius, rtol=1e-9)
    assert maps[0].fixed_stable == maps[1].fixed_stable


def test_predictive_control_is_the_same(pair):
    laws = [
        force_mpc(stand, params, MPCSpec(current_limit_A=9.0, measured=controller.spec.measured))
        for controller, stand, _, params in pair
    ]
    np.testing.assert_allclose(laws[1].kalman.gain, laws[0].kalman.gain, rtol=1e-9)
    assert laws[1].kalman.units[laws[1].kalman.names.index("spring_deflection")] == "m"
    steps = [law.step(law.start, reference_N=2000.0, measurement_N=10.0) for law in laws]
    assert steps[1].command == pytest.approx(steps[0].command, rel=1e-9)
    loops = [law.close(swing, params).figures() for law, (_, _, swing, params) in zip(laws, pair, strict=True)]
    assert loops[1].ms == pytest.approx(loops[0].ms, rel=1e-9)


def test_the_exported_code_is_the_same(pair, tmp_path):
    texts = []
    for number, (controller, *_) in enumerate(pair):
        export(controller, tmp_path / str(number))
        texts.append({path.name: path.read_text(encoding="utf-8") for path in (tmp_path / str(number)).iterdir()})
    assert "COMMAND_PER_EFFORT" in texts[0]["force_law_gains.h"] and "/* A/N */" in texts[0]["force_law_gains.h"]
    assert "/* V/(N m) */" in texts[1]["force_law_gains.h"]
    for name, text in texts[0].items():
        assert len(texts[1][name].splitlines()) == len(text.splitlines())


def test_parts_pass_the_roles_on(swing, thor):
    plant = wrapped(reworded(swing), ["current_loop", "load_cell"])
    assert plant.actuation is not None and plant.moves
    assert list(plant.port.held().states) == ["weg", "tempo", *list(plant.states)[4:]]
    assert list(plant.port.probe().states)[:4] == ["weg", "tempo", "ort", "geschwindigkeit"]


def test_rotary_roles():
    plant = so.plants.rotary()
    params = plant.complete(plant.defaults)
    command = command_of(plant, params, "tau_s")
    assert (command.input, command.effort_unit) == ("I", "N m")
    assert 1.0 / command.per_effort == pytest.approx(50.0 * 0.05)
    np.testing.assert_allclose(deflection_row(plant, params), [1 / 50.0, 0.0, -1.0, 0.0])
    state = np.array([0.3, 0.0, 0.01, 0.0])
    held, _, loss = catch(plant, params, state, plant.port)
    assert held[0] / 50.0 == pytest.approx(0.3 / 50.0 - 0.01)  # the twist stays
    assert loss == 0.0
    np.testing.assert_allclose(release(plant, params, plant.port, held, {"theta_l": 0.01}), state)


def test_friction_enters_by_its_role(thor):
    """The curve that the role gives is the force in f: J qdd/r^2 loses it."""
    plant = so.plants.high_impedance(parts=("stribeck",))
    params = thor.with_parameters(*plant.complete(thor).values()).update(f_c=20.0, f_s=35.0)
    friction = plant.friction["F_f"]
    p = SimpleNamespace(**{name: item.value for name, item in plant.complete(params).items()})
    f = ca.Function("f", [plant.x, plant.u, plant.p], [plant.dynamics])
    mass = plant.derived_values()["m_k"]
    m_k = float(ca.Function("m", [plant.p], [mass[0]])(plant.complete(params).vector))
    for speed in (-0.02, 1e-3, 0.1):
        with_it, without = (
            float(f([0.0, speed], [0.0], plant.complete(values).vector)[1])
            for values in (params, params.update(f_c=0.0, f_s=0.0))
        )
        assert m_k * (without - with_it) == pytest.approx(float(friction.force(speed, p)), rel=1e-9)
    for f_c in (20.0, 0.0):
        dry = find_dry_friction(plant, plant.complete(params.update(f_c=f_c)))
        level = max(
            float(friction.force(v, SimpleNamespace(**vars(p) | {"f_c": f_c}))) for v in np.geomspace(1e-5, 1, 999)
        )
        assert dry == {"F_f": pytest.approx(level, rel=0.01)} and 25.0 < level < 35.0


def mass_on_a_spring(**roles):
    return so.Plant(
        name="own", states={"x": "m", "v": "m/s"}, inputs={"U": "V"}, outputs={"F": "N", "y": "m"},
        parameters={"m": "kg", "k": "N/m", "c": "N s/m", "K": "N/V"},
        h=lambda t, x, u, p: {"F": p.k * x.x, "y": x.x},
        **{"f": lambda t, x, u, p: {"x": x.v, "v": (p.K * u.U - p.k * x.x - p.c * x.v) / p.m}, **roles},
    )  # fmt: skip


OWN = so.ParameterSet.of(m=(2.0, "kg"), k=(8e4, "N/m"), c=(300.0, "N s/m"), K=(12.5, "N/V"))


def test_a_plant_without_actuation_gets_it_from_its_static_gain():
    spec = so.ControllerSpec(measured="F", bandwidth_hz=20, bandwidth_range_hz=(1.0, 60.0))
    controller = so.tune(mass_on_a_spring(), OWN, spec)
    assert controller.command.per_effort == pytest.approx(1 / 12.5, rel=1e-12)
    assert any("states no actuation" in note and "12.5 N" in note for note in controller.notes)
    stated = mass_on_a_spring(actuation=Actuation(input="U", effort=lambda p: p.K))
    other = so.tune(stated, OWN, spec)
    assert other.gains == pytest.approx(controller.gains, rel=1e-9)
    assert not any("actuation" in note for note in other.notes)


def test_without_a_static_gain_the_role_is_named():
    floating = mass_on_a_spring()
    free = replace(floating, f=lambda t, x, u, p: {"x": x.v, "v": (p.K * u.U - p.c * x.v) / p.m})
    with pytest.raises(ControlError, match=r"actuation = Actuation\(input, effort\)"):
        command_of(free, OWN, "F")


def test_an_effort_without_the_right_sign_is_refused():
    reverse = OWN.update(K=-12.5)
    with pytest.raises(ControlError, match=r"is -12\.5; reverse the input"):
        command_of(mass_on_a_spring(), reverse, "F")
    stated = mass_on_a_spring(actuation=Actuation(input="U", effort=lambda p: p.K))
    with pytest.raises(ControlError, match=r"check K = -12\.5 N/V"):
        command_of(stated, reverse, "F")


def test_viscous_friction_as_a_role_is_not_dry():
    """The damper c as a role: the same controller, and predictive control is not refused."""
    damper = Friction(velocity=lambda x, p: x.v, force=lambda v, p: p.c * v)
    plant = mass_on_a_spring(
        f=lambda t, x, u, p: {"x": x.v, "v": (p.K * u.U - p.k * x.x - u.damper) / p.m}, friction={"damper": damper}
    )
    assert find_dry_friction(plant, plant.complete(OWN)) == {}
    spec = so.ControllerSpec(measured="F", bandwidth_hz=20, bandwidth_range_hz=(1.0, 60.0), current_limit_A=10.0)
    assert so.tune(plant, OWN, spec).gains == pytest.approx(so.tune(mass_on_a_spring(), OWN, spec).gains, rel=1e-9)
    assert force_mpc(plant, OWN, MPCSpec(current_limit_A=10.0, measured="F")).kalman.gain.size
    dry = replace(damper, force=lambda v, p: p.c * v + 200.0 * ca.tanh(1e3 * v))
    sticking = replace(plant, friction={"damper": dry})
    assert find_dry_friction(sticking, sticking.complete(OWN)) == {"damper": pytest.approx(200.0)}
    with pytest.raises(ControlError, match="the friction damper of 200 N"):
        so.tune(sticking, OWN, spec)


@pytest.mark.parametrize(
    ("roles", "word"),
    [
        ({"actuation": Actuation(input="I", effort=lambda p: 1.0)}, "actuation.input"),
        ({"sensing": Sensing(regulated=("F1",))}, "sensing.regulated"),
        ({"ports": (Port(motion="x_2"),)}, "port.motion"),
        ({"ports": (Port(motion="y", coordinate="y"),)}, "port.coordinate"),
        ({"ports": (Port(payload=("M",)),)}, "port.payload"),
        ({"friction": {"v": Friction(velocity=lambda x, p: x.v, force=lambda v, p: v)}}, '"v" is in states'),
    ],
)
def test_roles_that_name_nothing_are_refused(roles, word):
    with pytest.raises(PlantError, match=word):
        mass_on_a_spring(**roles)


@pytest.mark.parametrize("kind", [so.plants.high_impedance, so.plants.moving_output])
def test_figures_of_a_plant_with_friction_are_those_in_motion(kind, thor):
    """Loop, port, environments and predictive control's margins: friction at rest is damping that vanishes."""
    plant, sticky, stand = kind(), thor.update(f_c=60.0), so.plants.high_impedance()
    controller = so.tune(stand, thor, so.ControllerSpec(structure="pd", bandwidth_hz=40, max_noise_gain=25))
    law = force_mpc(stand, thor, MPCSpec(current_limit_A=9.0))
    for figures in (
        lambda params: controller.close(plant, params).figures().ms,
        lambda params: law.close(plant, params).figures().ms,
        lambda params: passivity(controller, plant, params).least_damping_N_s_per_m,
        lambda params: coupled_stability(
            controller, plant, params, points=3, dampings_N_s_per_m=(10.0,)
        ).spectral_radius,
    ):  # fmt: skip
        np.testing.assert_allclose(figures(sticky), figures(thor), rtol=1e-9)
