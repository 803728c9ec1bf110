r"""Inputs ahead of the motor: a voltage or a duty in place of a current, and a firmware that holds a position.

Parts around any plant:

``voltage_input``
    The input is the motor's voltage V: :math:`V = R I + K_e \omega`. In SI the back-EMF constant K_e is K_tau (V s/rad
    and N m/A are the same unit), so that it is no parameter of its own: :math:`K_e \omega I` is the power that the
    motor makes, before the losses of the transmission. The plant's actuation states the speed that this takes.
``duty_input``
    The input is the duty of a full bridge on the supply V_s: :math:`V = V_s \min(\max(d, -1), 1)`.
``supply_input``
    With a duty: the supply that was logged is an input, `supply` (V), in place of V_s wherever it is above zero. A log
    without it, and a controller's design, have V_s.
``supply_sag``
    The supply has a resistance R_b: the bridge takes d I from it, and the supply's voltage is less by :math:`R_b d I`.
``inductance``
    With one of them: :math:`V = R I + L_m \dot I + K_e \omega`; the current is then a state.
``position_servo``
    The input is the goal of a position, that of the motor (of the link, where the plant has no other), and
    :math:`c = g_s (k_p (\mathrm{goal} - \theta) - k_d \dot\theta)` is the input inside: current, voltage or duty. Gains
    may be those of a firmware's registers; g_s is what one unit of gain and error makes.
``servo_integral``
    Adds :math:`g_s k_i \int (\mathrm{goal} - \theta)`; at the limit of c it stands still.
``servo_limit``
    c stays within +-c_max.
``servo_hold``
    The firmware reads its position every T_h and holds c in between, so that c is of what it read T_h/2 ago on average;
    the goal is late by the log's delay alone. To first order that is
    :math:`c = g_s (k_p (\mathrm{goal} - \theta + T_h \dot\theta / 2) - k_d \dot\theta)`: damping is taken away.
``servo_sample``
    The firmware computes c of what it reads at those samples of the log at which the input `holds` is zero, and holds
    it in between; the goal has to stand as long, as `Log.hold` makes it. Without `holds` it reads at every sample.
``servo_delay``
    c acts T_v late, the goal in it too. A servo that runs at a rate f and takes T to compute acts as late as a delay of
    :math:`T + 1/(2 f)`.

With one of the first two the current I (A) is among the outputs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import field, replace
from typing import Any

import casadi as ca

from seaopt.errors import PlantError
from seaopt.parameters import Parameter, declare
from seaopt.plants.motor.thermal import RESISTANCE, find_resistance
from seaopt.plants.plant import Plant, refuse_clash
from seaopt.plants.roles import Actuation, Port, Sampling, change_ports, put_behind, with_values
from seaopt.records import record
from seaopt.signals import HOLDS

PARTS: dict[str, tuple[Parameter, ...]] = {
    "voltage_input": (RESISTANCE,),
    "duty_input": (RESISTANCE, declare("V_s", 24.0, "V", 1e-9, "supply voltage", (1.0, 1e3))),
    "inductance": (declare("L_m", 1e-3, "H", 1e-12, "winding inductance", (1e-7, 1)),),
    "supply_input": (),
    "supply_sag": (declare("R_b", 0.0, "ohm", 0.0, "resistance of the supply", (0, 100)),),
    "position_servo": (
        declare("k_p", 1.0, "-", 0.0, "gain of the servo, in the units that g_s, 1 unless given, converts"),
        declare("k_d", 0.0, "s", 0.0, "damping of the servo, in its own units"),
        declare("g_s", 1.0, "-", 0.0, "command of one unit of gain and error"),
    ),
    "servo_integral": (declare("k_i", 0.0, "1/s", 0.0, "integral gain of the servo"),),
    "servo_sample": (),
    "servo_hold": (declare("T_h", 0.0, "s", 0.0, "sample time of the servo's firmware"),),
    "servo_limit": (declare("c_max", 1.0, "-", 0.0, "limit of the servo's command"),),
}
SERVO = ("position_servo", "servo_integral", "servo_hold", "servo_limit")
STATED = ("k_p",)  # without a default: who has a servo knows its gain, and any other one would be a guess
INPUTS = {"voltage_input": ("V", "V"), "duty_input": ("duty", "-")}
SUPPLY = "supply"  # the input that is the voltage on which a duty is

# What a plant's input is, or all of its inputs, and beside its own {state: rate} and {output: value}.
_Solved = tuple[Any, Mapping[str, Any], Mapping[str, Any]]


@record(eq=False)
class _DriveEquations:
    """A drive ahead of a plant's first input: its own input, states and outputs with units, and its equations. `solve`
    is (t, x, u, p) -> (what the plant's input is, {state: rate}, {output: value}).
    """

    name: str
    input: str
    unit: str
    states: Mapping[str, str]
    outputs: Mapping[str, str]
    parameters: tuple[Parameter, ...]
    solve: Callable[[Any, Any, Any, Any], _Solved]
    effort: Callable[[Any], Any]  # of the parameters: what one unit of the new input is of the plant's, at rest
    largest: Callable[[Any], Any] | None = None  # of the new input
    optional: Mapping[str, str] = field(default_factory=dict[str, str])  # further inputs, zero where a log has none
    sampling: Sampling | None = None  # of its own states


def drive_electrically(plant: Plant, parts: Collection[str]) -> Plant:
    """Return a plant whose input is the voltage or the duty of its motor. Raises PlantError: the plant does not state
    its actuation, or not the speed on which its effort works; or has such an input.
    """
    part = "duty_input" if "duty_input" in parts else "voltage_input"
    actuation, inductive = plant.actuation, "inductance" in parts
    if actuation is None or actuation.speed is None:
        raise PlantError(
            f'part "{part}" needs the speed on which the motor works; give the role '
            "actuation = Actuation(input, effort, speed=lambda x, p: ...)",
            plant=plant.name,
        )
    speed, current, (name, unit) = actuation.speed, actuation.input, INPUTS[part]
    winding = plant.winding  # one that warms up brings its resistance

    def find_emf(x: Any, p: Any) -> Any:
        lossless = p if actuation.efficiency is None else with_values(p, {actuation.efficiency: 1.0})
        return actuation.effort(lossless) * speed(x, p)

    def find_supply(u: Any, p: Any) -> Any:
        return ca.if_else(u.supply > 0.0, u.supply, p.V_s) if "supply_input" in parts else p.V_s

    def solve(t: Any, x: Any, u: Any, p: Any) -> _Solved:
        share = 1.0 if part == "voltage_input" else ca.fmin(ca.fmax(u.duty, -1.0), 1.0)
        driving = share * (u.V if part == "voltage_input" else find_supply(u, p)) - find_emf(x, p)
        # The bridge takes share * I from the supply, and gives share of its voltage.
        resistance = find_resistance(winding, x, p) + (p.R_b * share**2 if "supply_sag" in parts else 0.0)
        if inductive:
            flows = getattr(x, current)
            return flows, {current: (driving - resistance * flows) / p.L_m}, {current: flows}
        return driving / resistance, {}, {current: driving / resistance}

    chosen = [parameter for each in (part, "supply_sag", "inductance") if each in parts for parameter in PARTS[each]]
    added = tuple(parameter for parameter in chosen if winding is None or parameter is not RESISTANCE)
    unit_of_current = plant.inputs[current]
    return _put_before(
        plant,
        _DriveEquations(
            name=part,
            input=name,
            unit=unit,
            states={current: unit_of_current} if inductive else {},
            outputs={current: unit_of_current},
            parameters=added,
            solve=solve,
            effort=lambda p: (1.0 if part == "voltage_input" else p.V_s) / find_resistance(winding, None, p),
            largest=(lambda p: 1.0) if part == "duty_input" else None,
            optional={SUPPLY: "V"} if "supply_input" in parts else {},
        ),
        change_ports(plant.ports, drive_electrically, tuple(parts)),
    )


def add_servo(plant: Plant, parts: Collection[str]) -> Plant:
    """Return a plant commanded by the goal of a position that firmware holds. Raises PlantError: no position, or no
    speed beside it where readings are held.
    """
    sensing = plant.sensing
    position = sensing and (sensing.motor_position or sensing.link_position)
    if not sensing or not position:
        raise PlantError(
            'part "position_servo" needs the position that it holds; give the role '
            "sensing = Sensing(regulated, motor_position=...)",
            plant=plant.name,
        )
    rate = sensing.motor_speed if sensing.motor_position else (plant.port.rate if plant.port else None)
    if "servo_hold" in parts and not rate:
        raise PlantError(
            'part "servo_hold" needs the speed of the position that is held; give the role '
            "sensing = Sensing(regulated, motor_position=..., motor_speed=...)",
            plant=plant.name,
        )
    sampled, read = "servo_sample" in parts, {name: f"{name}_read" for name in (position, rate) if name}
    if sampled and not read.keys() <= plant.states.keys():
        raise PlantError(
            'part "servo_sample" needs a position, and a speed beside it if there is one, that are states; give '
            "such ones in the role sensing",
            plant=plant.name,
        )
    source = next(iter(plant.inputs))
    integral, limited = "servo_integral" in parts, "servo_limit" in parts
    commanded = {} if source in plant.outputs else {source: plant.inputs[source]}  # a log may hold it, too

    def solve(t: Any, x: Any, u: Any, p: Any) -> _Solved:
        x = with_values(x, {name: getattr(x, kept) for name, kept in read.items()}) if sampled else x
        reading = getattr(x, position, None)
        error = u.goal - (plant.h(t, x, with_values(u, {source: 0.0}), p)[position] if reading is None else reading)
        error += 0.5 * p.T_h * getattr(x, rate) if "servo_hold" in parts and rate else 0.0
        command = p.g_s * (p.k_p * error - (p.k_d * getattr(x, rate) if rate else 0.0))
        command += p.g_s * p.k_i * x.error_sum if integral else 0.0
        limited_command = ca.fmin(ca.fmax(command, -p.c_max), p.c_max) if limited else command
        winds_up = ca.logic_and(limited_command != command, command * error > 0.0)
        return (
            limited_command,
            {
                **({"error_sum": ca.if_else(winds_up, 0.0, error)} if integral else {}),
                **(dict.fromkeys(read.values(), 0.0) if sampled else {}),
            },
            dict.fromkeys(commanded, limited_command),
        )

    added = [parameter for part in SERVO if part in parts for parameter in PARTS[part]]
    unit = plant.outputs.get(position) or plant.states[position]
    states = {kept: plant.states[name] for name, kept in read.items()} if sampled else {}
    return _put_before(
        plant,
        _DriveEquations(
            name="position_servo",
            input="goal",
            unit=unit,
            states={**({"error_sum": f"{unit} s"} if integral else {}), **states},
            outputs=commanded,
            parameters=tuple(parameter for parameter in added if rate or parameter.name != "k_d"),
            solve=solve,
            effort=lambda p: p.g_s * p.k_p,
            optional={HOLDS: "-"} if sampled else {},
            sampling=Sampling(reads={kept: name for name, kept in read.items()}, kept_by=HOLDS) if sampled else None,
        ),
        change_ports(plant.ports, add_servo, tuple(parts)),
    )


def _put_before(plant: Plant, drive: _DriveEquations, ports: tuple[Port, ...]) -> Plant:
    """Return a plant behind a drive, with ports whose plants are behind it, too."""
    source = next(iter(plant.inputs))
    refuse_clash(
        plant,
        drive.name,
        (drive.input, *drive.optional, *drive.outputs, *(parameter.name for parameter in drive.parameters)),
        source,
    )

    def solve_inside(t: Any, x: Any, u: Any, p: Any) -> _Solved:
        inside, rates, outputs = drive.solve(t, x, u, p)
        return with_values(u, {source: inside}), rates, outputs

    def f(t: Any, x: Any, u: Any, p: Any) -> Mapping[str, Any]:
        inside, rates, _ = solve_inside(t, x, u, p)
        return {**plant.f(t, x, inside, p), **rates}

    def h(t: Any, x: Any, u: Any, p: Any) -> Mapping[str, Any]:
        inside, _, outputs = solve_inside(t, x, u, p)
        return {**plant.h(t, x, inside, p), **outputs}

    added = {
        parameter.name: parameter.unit if parameter.name in STATED else parameter for parameter in drive.parameters
    }
    before = plant.actuation
    actuation = before and Actuation(
        input=drive.input,
        effort=lambda p: before.effort(p) * drive.effort(p),
        unit=before.unit,
        efficiency=before.efficiency,
        largest=drive.largest,
    )
    remaining = {name: unit for name, unit in plant.inputs.items() if name != source}
    optional = plant.optional_inputs - {source} | ({drive.input} if source in plant.optional_inputs else set())
    return replace(
        plant,
        name=f"{plant.name} with {drive.name}",
        f=f,
        h=h,
        actuation=actuation,
        states={**plant.states, **drive.states},
        inputs={drive.input: drive.unit, **remaining, **drive.optional},
        outputs={**plant.outputs, **drive.outputs},
        optional_inputs=frozenset((*optional, *drive.optional)),
        parameters={**plant.parameters, **added},
        sampling=drive.sampling or plant.sampling,
        friction=put_behind(plant.friction, lambda x, u, p: solve_inside(0.0, x, u, p)[0]),
        ports=ports,
    )
