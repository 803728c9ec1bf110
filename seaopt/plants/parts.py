r"""Effects of real actuators: optional parts that compose, each with its own parameters.

Inside the actuator, a screw's (`two_link` and its special cases; v is the nut's speed, dq/dt) or a gear's (`rotary`; v
is the motor's, and the units are N m and rad):

``stribeck``
    Friction rises at low speed (Stribeck 1902; Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30(7), 1994),
    smoothed through zero: :math:`F_f = [f_c + (f_s - f_c) e^{-(v/v_{st})^2}] \tanh(v/v_s)`; without it
    :math:`F_f = f_c \tanh(v/v_s)`. Viscous friction is b_r, in every plant.
``load_friction``
    Friction grows with what the transmission carries (Duclusaud and Passault, Extended Friction Models for the Physics
    Simulation of Servo Actuators, 2024: M3, and M5 with both shares): :math:`|c_m F_m + c_e F_e|` is added to f_c, with
    the motor's effort F_m and the spring's F_e, both at the motor (the nut), where the friction is.
``load_stribeck``
    With the two before, breakaway friction grows too (M4 and M5): :math:`|c_{ms} F_m + c_{es} F_e|` is added to f_s
    beside what is added to f_c.
``load_square``
    With these, breakaway friction has a part of the square of the smaller of F_m and F_e, where they oppose each other
    (M6): q_m F_m^2 or q_e F_e^2.
``lugre``
    Friction of bristles that bend before they slip (Canudas de Wit, Olsson, Astrom, Lischinsky, IEEE TAC 40(3), 1995):
    :math:`\dot z = v - \sigma_0 |v| z / g(v)` and :math:`F_f = \sigma_0 z + \sigma_1 \dot z`, with g(v) what the other
    parts make of dry friction without its smoothing, Stribeck's curve among it. It needs an f_c above zero. The model's
    sigma_2 is the viscous friction b_r that every plant has. At rest it is a spring of the stiffness sigma_0; v_s then
    smooths the curve of describing functions alone.
``hysteresis``
    A spring of the stiffness k_h beside the main one, which gives way at a deflection y_h of its own: Bouc's and Wen's
    law (Wen, J. Eng. Mech. Div. 102(2), 1976) of the exponent n_h, with beta = gamma,
    :math:`\dot z = \dot\delta - \tfrac12 (\dot\delta + |\dot\delta| \operatorname{sgn} z) |z/y_h|^{n_h}` and
    :math:`F = \dots + k_h z`. So it unloads elastically, the stiffness stays from k to k + k_h, and
    :math:`k_h z (\dot\delta - \dot z) \ge 0` is lost, whatever the motion. The larger n_h, the more at once it
    slips, as an element of Maxwell's does, whose tangent jumps. With n_h = 1 a cycle from -A to A loses
    :math:`2 k_h [2 y_h (A - z_0) - z_0^2/2]`, with :math:`z_0 = y_h [1 - W(e^{1 - 2 A/y_h})]`, Lambert's W.
``backlash``
    Play of total width :math:`2 g_b` in series with the spring: the spring sees
    :math:`z(\delta) = \delta + \tfrac12\big(\sqrt{(\delta-g_b)^2+\epsilon^2} - \sqrt{(\delta+g_b)^2+\epsilon^2}\big)`,
    which is nearly 0 within the play and :math:`\delta \mp g_b` beyond it; :math:`\epsilon` rounds the corners.
``hardening``
    :math:`F = k z + k_3 z^3`.
``spring_damping``
    :math:`F = \dots + c_k \dot\delta`, parallel to spring and play; `rotary` has it without this part, as c_s.
``screw_mode``
    Of a ball screw, which is axially elastic: it stretches by s, with stiffness k_b and damping c_b, and moves an
    effective mass m_n at the nut: with both links fixed and a heavy rotor, a mode at
    :math:`\tfrac{1}{2\pi}\sqrt{(k + k_b)/(m_l + m_n)}`. The defaults put it at 80 Hz with a damping ratio of 0.03,
    where the paper saw one (between 70 and 80 Hz, with the actuator's length). They leave the static stiffness within
    a tenth, which takes an m_n of 28 kg: an effective mass, much more than the screw's own, which a load cell at link
    2 feels too (F1/F2 falls to 0.46 at 60 Hz) and which swings along with a moving output. These figures are for the
    unlumped drive with the spring at link 1; with the spring at link 2 the mode is at 84 Hz, and the lumped drive
    damps it away.

Around any plant, besides those of `seaopt.plants.drives`:

``current_loop``
    The motor current lags the command: first order, bandwidth current_loop_hz.
``load_cell``
    Forces and torques are read through a first-order sensor of bandwidth load_cell_hz.
``sensor_filter``
    They are read through a low-pass of second order, of frequency sensor_filter_hz and damping zeta_f (1/sqrt(2) is
    Butterworth's), as amplifiers have against aliasing.
``command_delay``, ``measurement_delay``
    Dead times T_c before the input and T_m behind the same outputs, as Padé approximants of order three: the phase is
    right to one degree up to a frequency of 0.45/T. `simulate` and experiments take an exact ``delay_s``; the parts are
    for linearisation and continuous-time loops.
``droop``, ``falling_torque``, ``friction_drift``, ``friction_direction``, ``back_driving``, ``cogging``, ``stand``
    A motor that saturates, is weaker at speed or cogs, friction that changes over a log, with the direction or with
    who drives whom, a stand that gives: `seaopt.plants.motor.effects`.
``deflection_sensor``
    One more output, what two encoders and a nominal stiffness make: `seaopt.plants.sensors.deflection`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Literal

import casadi as ca

from seaopt.errors import PlantError, suggestion
from seaopt.parameters import Parameter, declare
from seaopt.plants import drives
from seaopt.plants.friction import can_stick
from seaopt.plants.memo import keep_last, memo
from seaopt.plants.motor import effects
from seaopt.plants.motor.thermal import PARAMETERS, add_heat
from seaopt.plants.plant import Plant, agree
from seaopt.plants.roles import change_ports, put_behind
from seaopt.plants.sensors.deflection import PARTS as SENSOR_PARTS
from seaopt.plants.sensors.deflection import keep_weights, read_deflection
from seaopt.records import record

Part = Literal[
    "stribeck", "load_friction", "load_stribeck", "load_square", "lugre", "hysteresis", "backlash", "hardening",
    "spring_damping", "screw_mode", "droop", "falling_torque", "friction_drift", "friction_direction", "back_driving",
    "cogging", "stand", "current_loop", "load_cell", "sensor_filter", "command_delay",
    "measurement_delay", "voltage_input", "duty_input", "supply_input", "supply_sag", "inductance", "position_servo",
    "servo_integral", "servo_limit", "servo_hold", "servo_sample", "servo_delay", "deflection_sensor", "thermal",
]  # fmt: skip

SHARPNESS = declare("n_h", 1.0, "-", 1.0, "how much at once it gives way, an exponent")
LEAST_SHARE = 1e-6  # of y_h that it is deflected by at least, for its logarithm

PARTS: dict[str, tuple[Parameter, ...]] = {
    "stribeck": (
        declare("f_s", 0.0, "N", 0.0, "breakaway friction at the screw", (0, 100000)),
        declare("v_st", 5e-3, "m/s", 1e-9, "Stribeck speed", (0.00001, 10)),
    ),
    "load_friction": (
        declare("c_m", 0.0, "-", 0.0, "friction over the motor's effort"),
        declare("c_e", 0.0, "-", 0.0, "friction over the spring's effort"),
    ),
    "load_stribeck": (
        declare("c_ms", 0.0, "-", 0.0, "of the motor's effort, at breakaway"),
        declare("c_es", 0.0, "-", 0.0, "of the spring's effort, at breakaway"),
    ),
    "load_square": (
        declare("q_m", 0.0, "1/N", 0.0, "of the motor's squared, at breakaway"),
        declare("q_e", 0.0, "1/N", 0.0, "of the spring's squared, at breakaway"),
    ),
    "lugre": (
        declare("f_c", 20.0, "N", 1e-9, "Coulomb friction at the screw", (0, 100000)),
        declare("sigma_0", 5e6, "N/m", 0.0, "stiffness of the bristles"),
        declare("sigma_1", 2e3, "N s/m", 0.0, "damping of the bristles"),
    ),
    "hysteresis": (
        declare("k_h", 0.0, "N/m", 0.0, "stiffness of the spring that gives way"),
        declare("y_h", 1e-4, "m", 1e-12, "deflection at which it gives way"),
        SHARPNESS,
    ),
    "backlash": (
        declare("g_b", 2e-5, "m", 0.0, "half of the play", (0, 0.1)),
        declare("eps_b", 2e-6, "m", 1e-12, "rounding of the play's corners"),
    ),
    "hardening": (declare("k_3", 0.0, "N/m^3", 0.0, "cubic stiffness"),),
    "spring_damping": (declare("c_k", 0.0, "N s/m", 0.0, "spring damping"),),
    "screw_mode": (
        declare("k_b", 6.55e6, "N/m", 0.0, "axial stiffness of the screw"),
        declare("c_b", 860.0, "N s/m", 0.0, "damping of the screw"),
        declare("m_n", 27.9, "kg", 1e-9, "effective mass at the nut"),
    ),
    "current_loop": (declare("current_loop_hz", 500.0, "Hz", 1e-6, "current loop bandwidth"),),
    "load_cell": (declare("load_cell_hz", 500.0, "Hz", 1e-6, "load cell bandwidth"),),
    "sensor_filter": (
        declare("sensor_filter_hz", 500.0, "Hz", 1e-6, "frequency of the sensor's low-pass"),
        declare("zeta_f", math.sqrt(0.5), "-", 1e-3, "damping of the sensor's low-pass"),
    ),
    "command_delay": (declare("T_c", 1e-3, "s", 1e-9, "delay of the command"),),
    "measurement_delay": (declare("T_m", 1e-3, "s", 1e-9, "delay of the measurement"),),
    "servo_delay": (declare("T_v", 1e-3, "s", 1e-9, "delay of the servo's command"),),
    **effects.PARTS,
    **drives.PARTS,
    **SENSOR_PARTS,
    "thermal": PARAMETERS,
}
INSIDE: tuple[Part, ...] = (
    "stribeck", "load_friction", "load_stribeck", "load_square", "lugre", "hysteresis", "backlash", "hardening",
    "spring_damping", "screw_mode",
)  # fmt: skip
BREAKAWAY = 1.5  # of Coulomb friction, where bristles need a default
# What a part needs beside it: one part of each group.
NEEDS: dict[str, tuple[tuple[str, ...], ...]] = {
    **dict.fromkeys(("load_stribeck", "load_square"), (("stribeck",), ("load_friction",))),
    **dict.fromkeys(
        ("servo_integral", "servo_limit", "servo_hold", "servo_sample", "servo_delay"), (("position_servo",),)
    ),
    **dict.fromkeys(("supply_input", "supply_sag"), (("duty_input",),)),
    "inductance": (tuple(drives.INPUTS),),
}
LOADS = {"motor": 0.0, "output": 0.0}  # of friction that grows with them, as linear analysis takes it


def parameters(parts: Sequence[str], of_part: Mapping[str, tuple[Parameter, ...]]) -> list[Parameter]:
    """Return the parameters of the parts that sit inside the actuator, from a screw's or a gear's table. Bristles slip
    at the friction's own level, so that with them breakaway friction is above zero, as f_c is.
    """
    chosen = [parameter for part in parts if part in INSIDE for parameter in of_part[part]]
    sliding = next((parameter for parameter in chosen if parameter.name == "f_c"), None)
    if sliding is None:
        return chosen
    breakaway = {"value": BREAKAWAY * sliding.value, "min": sliding.min}
    return [replace(parameter, **breakaway) if parameter.name == "f_s" else parameter for parameter in chosen]


def check_parts(parts: Sequence[str]) -> None:
    """Refuse an unknown part, one given twice, and parts that exclude each other or need one that is not there."""
    if isinstance(parts, str) or not isinstance(parts, Sequence):
        raise PlantError(f"parts = {parts!r} is not a list of names; give a list such as ['load_cell']")
    for part in parts:
        if not isinstance(part, str) or part not in PARTS:
            raise PlantError(f'part "{part}" is not known; {suggestion(str(part), PARTS)}')
        if list(parts).count(part) > 1:
            raise PlantError(f'part "{part}" is given twice; each part goes on once')
        missing = [" or ".join(group) for group in NEEDS.get(part, ()) if not set(group) & set(parts)]
        if missing:
            raise PlantError(f'part "{part}" needs {" and ".join(missing)}; add it')
    electric = [part for part in drives.INPUTS if part in parts]
    if len(electric) > 1:
        raise PlantError('parts "voltage_input" and "duty_input" are both given; the motor has one input: give one')
    if {"servo_hold", "servo_sample"} <= set(parts):
        raise PlantError('parts "servo_hold" and "servo_sample" are both given; the one is roughly the other: give one')
    if electric and "current_loop" in parts:
        raise PlantError(f'parts "{electric[0]}" and "current_loop" are both given; a current loop takes a current')


def play(deflection: Any, p: Any) -> Any:
    """Return what the spring sees of a deflection behind the play."""
    before = ca.sqrt((deflection - p.g_b) ** 2 + p.eps_b**2)
    return deflection + 0.5 * (before - ca.sqrt((deflection + p.g_b) ** 2 + p.eps_b**2))


def spring_force(parts: Sequence[str], deflection: Any, k: Any, p: Any) -> Any:
    """Return the force (N, N m) of a spring of stiffness k at a deflection (m, rad), without its damper's."""
    z = play(deflection, p) if "backlash" in parts else deflection
    force = k * z
    return force + p.k_3 * z**3 if "hardening" in parts else force


def stores_in_closed_form(parts: Sequence[str]) -> bool:
    """Tell whether `spring_energy` knows the spring's energy: of play and hardening together it does not."""
    return not ("backlash" in parts and "hardening" in parts)


def spring_energy(parts: Sequence[str], deflection: Any, k: Any, p: Any) -> Any:
    """Return the energy that spring and play store at a deflection (m, rad), J: the integral of `spring_force`."""
    if "backlash" in parts:

        def primitive(a: Any) -> Any:
            root = ca.sqrt(a**2 + p.eps_b**2)
            return 0.5 * (a * root + p.eps_b**2 * ca.asinh(a / p.eps_b))

        before = primitive(deflection - p.g_b) + primitive(p.g_b)
        return k * 0.5 * (deflection**2 + before - primitive(deflection + p.g_b) + primitive(p.g_b))
    energy = 0.5 * k * deflection**2
    return energy + 0.25 * p.k_3 * deflection**4 if "hardening" in parts else energy


def dry_friction(parts: Sequence[str], speed: Any, p: Any) -> Any:
    """Return Coulomb's friction and what parts add to it (N, N m), smoothed through zero."""
    return friction_level(parts, speed, p) * ca.tanh(speed / p.v_s)


def friction_level(parts: Sequence[str], speed: Any, p: Any) -> Any:
    """Return what dry friction is without its smoothing (N, N m); at zero speed what holds the drive at rest."""
    sliding, breakaway = p.f_c, p.f_s if "stribeck" in parts else None
    if "load_friction" in parts:
        sliding += ca.fabs(p.c_m * p.motor + p.c_e * p.output)
    if breakaway is None:
        return sliding
    breakaway += sliding - p.f_c
    if "load_stribeck" in parts:
        breakaway += ca.fabs(p.c_ms * p.motor + p.c_es * p.output)
    if "load_square" in parts:
        smaller = ca.if_else(ca.fabs(p.motor) > ca.fabs(p.output), p.q_e * p.output**2, p.q_m * p.motor**2)
        breakaway += ca.if_else(p.motor * p.output > 0.0, smaller, 0.0)
    return sliding + (breakaway - sliding) * ca.exp(-((speed / p.v_st) ** 2))


def bound_friction_slopes(parts: Sequence[str], p: Any) -> tuple[Any, Any]:
    """Return bounds of the slope of `dry_friction` over all speeds, N s/m (N m s/rad): the flattest and the steepest.
    Without a load. The smoothing's slope is largest at rest, level/v_s, and never negative; that of (f_s - f_c)
    exp(-(v/v_st)^2) is largest at v_st/sqrt(2), |f_s - f_c| sqrt(2/e)/v_st.
    """
    if "stribeck" not in parts:
        return 0.0, p.f_c / p.v_s
    turn = math.sqrt(2.0 / math.e) / p.v_st
    return -ca.fmax(p.f_s - p.f_c, 0.0) * turn, p.f_s / p.v_s + ca.fmax(p.f_c - p.f_s, 0.0) * turn


def lugre_rate(parts: Sequence[str], z: Any, speed: Any, p: Any) -> Any:
    """Return the rate of the deflection z of LuGre's bristles."""
    return speed - p.sigma_0 * ca.fabs(speed) * z / friction_level(parts, speed, p)


def hysteresis_rate(z: Any, speed: Any, p: Any) -> Any:
    """Return the rate of the deflection z of the spring that gives way, at a rate of the main spring's deflection."""
    share = ca.fmax(ca.fabs(z) / p.y_h, LEAST_SHARE) ** p.n_h
    return speed - 0.5 * (speed + ca.fabs(speed) * ca.sign(z)) * share


@record
class _Filter:
    """A linear filter z' = A z + b v, out = c z + d v, its entries expressions of the parameters."""

    a: Any
    b: Any
    c: Any
    d: Any


def _lag(p: Any, name: str) -> _Filter:
    rate = 2 * math.pi * getattr(p, name)
    return _Filter(a=-ca.SX(rate), b=ca.SX(rate), c=ca.SX(1), d=ca.SX(0))


def _low_pass(p: Any, name: str) -> _Filter:
    """w^2 / (s^2 + 2 zeta w s + w^2); the second state is the rate over w, so that both have the signal's size."""
    rate = 2 * math.pi * getattr(p, name)
    a = rate * ca.vertcat(ca.horzcat(ca.SX(0), 1), ca.horzcat(ca.SX(-1), -2 * p.zeta_f))
    return _Filter(a=a, b=rate * ca.vertcat(0, 1), c=ca.horzcat(ca.SX(1), 0), d=ca.SX(0))


def _pade(p: Any, name: str) -> _Filter:
    """exp(-s T) by Padé's (3, 3): (120 - 60 sT + 12 (sT)^2 - (sT)^3) / (120 + 60 sT + 12 (sT)^2 + (sT)^3)."""
    rate = 1 / getattr(p, name)  # in units of T the entries are numbers, and the states have the signal's size
    a = rate * ca.vertcat(ca.horzcat(0, 1, 0), ca.horzcat(0, 0, 1), ca.horzcat(-120, -60, -12))
    return _Filter(a=a, b=rate * ca.vertcat(0, 0, 1), c=ca.horzcat(ca.SX(240), 0, 24), d=ca.SX(-1))


_FILTERS = {
    "current_loop": (_lag, "current_loop_hz", "input", 1),
    "load_cell": (_lag, "load_cell_hz", "output", 1),
    "sensor_filter": (_low_pass, "sensor_filter_hz", "output", 2),
    "command_delay": (_pade, "T_c", "input", 3),
    "measurement_delay": (_pade, "T_m", "output", 3),
    "servo_delay": (_pade, "T_v", "input", 3),
}

_DEAD_TIMES = ("command_delay", "measurement_delay")  # from a command to what a log has of its effect

# What is the motor's and the transmission's own, behind the drive.
_EFFECTS: dict[str, Callable[[Plant], Plant]] = {
    "droop": effects.let_droop,
    "falling_torque": effects.let_torque_fall,
    "friction_drift": effects.let_friction_drift,
    "friction_direction": effects.let_friction_differ,
    "back_driving": effects.let_back_driving_differ,
    "cogging": effects.let_cog,
    "stand": effects.let_stand_give,
}
_WRAPPERS: dict[str, Callable[[Plant, Sequence[str]], Plant]] = {
    "position_servo": drives.add_servo,
    "deflection_sensor": lambda plant, parts: read_deflection(plant),
}
# From the motor outwards; a load cell does not read what encoders do, which the delay of the readings comes after.
_ORDER = (
    "current_loop", "servo_delay", "position_servo", "command_delay", "load_cell", "sensor_filter",
    "deflection_sensor", "measurement_delay",
)  # fmt: skip


def wrapped(
    plant: Plant, parts: Sequence[str], *, source: str | None = None, outputs: Sequence[str] | None = None
) -> Plant:
    """Return a plant behind its current loop and delays, read through its load cells; any plant is possible.

    Parameters
    ----------
    plant : Plant
        The plant inside.
    parts : sequence of str
        Of current_loop, load_cell, sensor_filter, command_delay and measurement_delay, and of `seaopt.plants.drives`,
        each once.
    source : str, optional
        The input that passes current loop and command delay; the first if left out.
    outputs : sequence of str, optional
        The outputs that pass load cell, filter and measurement delay; those that are regulated if left out.

    Raises
    ------
    PlantError
        A part, the input or every output is unknown.

    Examples
    --------
    >>> from seaopt.plants import high_impedance
    >>> list(wrapped(high_impedance(), ["current_loop", "load_cell"]).states)
    ['q', 'qd', 'I_current_loop_1', 'F1_load_cell_1', 'F2_load_cell_1']
    """
    check_parts(parts)
    for part in parts:
        if part in INSIDE:
            raise PlantError(
                f'part "{part}" sits inside an actuator; give it to two_link, high_impedance, moving_output or rotary'
            )
    if "thermal" in parts:
        plant = add_heat(plant)
    for part, change in _EFFECTS.items():
        plant = change(plant) if part in parts else plant
    if "voltage_input" in parts or "duty_input" in parts:
        plant = drives.drive_electrically(plant, parts)
    for part in _ORDER:
        if part not in parts:
            continue
        if part in _WRAPPERS:
            plant = _WRAPPERS[part](plant, parts)
            continue
        where = _FILTERS[part][2]
        if where == "input":
            name = source if source is not None else next(iter(plant.inputs))
            if name not in plant.inputs:
                raise PlantError(f'plant {plant.name} has no input "{name}"; {suggestion(name, plant.inputs)}')
            signals = [name]
        else:
            regulated = plant.sensing.regulated if plant.sensing is not None else ()
            signals = [name for name in (regulated if outputs is None else outputs) if name in plant.outputs]
            if not signals:
                reading = f"none of the outputs {', '.join(outputs)}" if outputs else "no regulated output"
                raise PlantError(f"plant {plant.name} has {reading} that {part} reads; name others")
        plant = _add_filter(plant, part, signals)
    return plant


@memo
def add_part(plant: Plant, part: str) -> Plant:
    """Return a plant with one more part, made again where it can be. Raises PlantError: the two do not go together."""
    recipe = plant.recipe
    if recipe is None or not _is_made(plant):
        made = wrapped(plant, [part])
    else:
        check_parts((*recipe.parts, part))
        made = recipe.make((*recipe.parts, part))
    sticks, offset = plant.sticks and can_stick(made), plant.drive_offset_s
    if (made.sticks, made.drive_offset_s) == (sticks, offset):  # to make it again takes as long as to make it
        return made
    return replace(made, sticks=sticks, drive_offset_s=offset)


@memo
def _is_made(plant: Plant) -> bool:
    """Tell whether its recipe makes a plant, at one point; states and outputs that a device adds are its own."""
    assert plant.recipe is not None
    made = plant.recipe.make(plant.recipe.parts)
    if tuple(made.parameters) != tuple(plant.parameters) or tuple(made.inputs) != tuple(plant.inputs):
        return False
    if not (made.states.keys() <= plant.states.keys() and made.outputs.keys() <= plant.outputs.keys()):
        return False
    return agree(made, plant)


def list_dead_times(plant: Plant) -> tuple[str, ...]:
    """Return the parameters of a plant that are delays of command and measurement."""
    delays = [parameter for part in _DEAD_TIMES for parameter in PARTS[part]]
    return tuple(parameter.name for parameter in delays if plant.parameters.get(parameter.name) == parameter)


def _add_filter(plant: Plant, part: str, signals: Sequence[str]) -> Plant:
    """Return a plant with one filter on each of the named inputs or outputs that it has."""
    law, parameter, where, order = _FILTERS[part]
    units = plant.inputs if where == "input" else plant.outputs
    signals = [signal for signal in signals if signal in units]
    if parameter in plant.parameters:
        raise PlantError(f"plant {plant.name} has {part} already; each part goes on once")
    states = {signal: [f"{signal}_{part}_{i}" for i in range(1, order + 1)] for signal in signals}
    added = {state: units[signal] for signal in signals for state in states[signal]}

    def state(x: Any, signal: str) -> Any:
        return ca.vertcat(*(getattr(x, name) for name in states[signal]))

    def replace_signals(sources: Mapping[str, Any], x: Any, p: Any) -> dict[str, Any]:
        """Return inputs or outputs with those that are filtered in place of their sources."""
        filters = law(p, parameter)
        return {**sources, **{s: ca.mtimes(filters.c, state(x, s)) + filters.d * sources[s] for s in signals}}

    @keep_last
    def find_inputs(x: Any, u: Any, p: Any) -> SimpleNamespace:
        return SimpleNamespace(**replace_signals(vars(u), x, p)) if where == "input" else u

    def f(t: Any, x: Any, u: Any, p: Any) -> Mapping[str, Any]:
        filters, sources = law(p, parameter), vars(u) if where == "input" else plant.h(t, x, u, p)
        rates = dict(plant.f(t, x, find_inputs(x, u, p), p))
        for s in signals:
            rate = ca.mtimes(filters.a, state(x, s)) + filters.b * sources[s]
            rates |= dict(zip(states[s], ca.vertsplit(rate), strict=True))
        return rates

    def h(t: Any, x: Any, u: Any, p: Any) -> Mapping[str, Any]:
        out = plant.h(t, x, find_inputs(x, u, p), p)
        return out if where == "input" else replace_signals(out, x, p)

    return replace(
        plant,
        name=f"{plant.name} with {part}",
        states={**plant.states, **added},
        parameters={**plant.parameters, **{parameter.name: parameter for parameter in PARTS[part]}},
        f=f,
        h=h,
        ports=change_ports(plant.ports, _add_filter, part, signals),
        friction=put_behind(plant.friction, find_inputs) if where == "input" else plant.friction,
        sensing=keep_weights(plant) if where == "output" else plant.sensing,
    )
