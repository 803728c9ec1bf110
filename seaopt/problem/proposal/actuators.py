"""What is known and what is fitted of the actuator that some logs are of: parameters, plants and their options.

A log of an effort (force, torque) with the motor's motion tells the spring; one of an effort alone knows the inertia
only over the stiffness, and one of angles alone only over the torque constant. What no log can tell has to be known: it
is asked, and is a prior or fixed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from seaopt.parameters import Parameter
from seaopt.plants import rotary, thor
from seaopt.plants.parts import PARTS
from seaopt.problem.proposal.questions import Interview
from seaopt.records import record
from seaopt.units import unit_after

PRIOR = 0.05  # share that a data sheet's value may be off
WIDE = (0.5, 2.0)  # of an inertia that somebody estimated: its range
INERTIA_OVER_POINT = 4.0 / 3.0  # of a slender link about its end
_DRIVES: dict[str, tuple[str, ...]] = {"V": ("voltage_input",), "duty": ("duty_input",), "goal": ("position_servo",)}


@record
class ParameterLine:
    """A line of [parameters]."""

    name: str
    value: str
    comment: str


@record
class Facts:
    """What the logs have: the input, the outputs of them all, and the places (held, free, ...) of their links."""

    input: str
    outputs: frozenset[str]
    places: tuple[str, ...]
    gear_ratio: float | None = None


@record
class Proposed:
    """An actuator as it goes into a problem file."""

    lines: tuple[ParameterLine, ...]
    plants: Mapping[str, Mapping[str, object]]  # of each [plant.NAME]
    measured: str  # what a controller regulates; "" where nothing can be
    design: str  # the plant that it is designed on
    robust_to: tuple[str, ...]  # the plants that it must hold on besides
    ranges: Mapping[str, tuple[float, float]]  # of what nobody measured


class _Lines:
    """Lines of [parameters], each with what it is and what of it is a guess."""

    def __init__(self, interview: Interview, defaults: Mapping[str, Parameter]) -> None:
        self.interview, self.defaults = interview, defaults
        self.lines: list[ParameterLine] = []

    def add(self, name: str, value: str, *marks: str) -> None:
        parameter = self.defaults[name]
        about = ", ".join(text for text in (parameter.description, unit_after(parameter.unit).strip("- ")) if text)
        guess = self.interview.mark(*marks)
        self.lines.append(ParameterLine(name=name, value=value, comment="; ".join(t for t in (about, guess) if t)))

    def free(self, name: str, start: float | None = None, **bounds: float) -> None:
        value = self.defaults[name].value if start is None else start
        more = "".join(f", {key} = {number:.10g}" for key, number in bounds.items())
        self.add(name, f"{{ value = {value:.10g}, free = true{more} }}", name)

    def known(self, name: str, text: str, guess: float | None = None, why: str = "a usual one") -> float:
        """Ask for a value that no log can tell, and write it."""
        start = self.defaults[name].value if guess is None else guess
        value = self.interview.number(name, _with_unit(text, self.defaults[name]), start, why)
        self.add(name, f"{value:.10g}", name)
        return value

    def perhaps(self, name: str, text: str, *, told: bool, why: str) -> float | None:
        """Ask for a value that the logs may tell: known, it is a prior; unknown, free if they tell, else a guess."""
        parameter = self.defaults[name]
        value = self.interview.optional(name, f"{_with_unit(text, parameter)}, or unknown", why)
        if value is not None:
            self.add(name, f"{{ value = {value:.10g}, prior_std = {PRIOR * value:.3g} }}", name)
        elif told:
            self.free(name)
        else:
            self.interview.assume(name)
            self.add(name, f"{parameter.value:.10g}", name)
        return value


def _with_unit(text: str, parameter: Parameter) -> str:
    unit = unit_after(parameter.unit).strip()
    return f"{text}, in {unit}" if unit not in ("", "-") else text


def propose_rotary(interview: Interview, facts: Facts) -> Proposed:
    """Return a gear's actuator."""
    parts = _DRIVES.get(facts.input, ())
    pendulum = rotary(link="pendulum")
    lines = _Lines(interview, _list_defaults(pendulum.defaults, parts, "N m/rad"))
    effort, motor, link = (name in facts.outputs for name in ("tau_s", "theta_m", "theta_l"))
    moves = any(place != "held" for place in facts.places)
    ratio, why = facts.gear_ratio, "the gear ratio of a module; take it from the data sheet"
    if ratio is not None:
        why = "the motor turns so many times as far as the link"
    lines.known("N", "Gear ratio N (turns of the motor for one of the output)", ratio, why)
    _add_torque_constant(lines, facts, effort=effort)
    _add_drive(lines, facts)
    lines.free("J_m")
    lines.free("b_r")
    lines.free("f_c", 0.2 * lines.defaults["J_m"].value * 100.0, max=10.0)
    seen = (effort and (motor or "deflection" in facts.outputs)) or (moves and (motor or link))
    lines.perhaps(
        "k_s",
        "Stiffness of the spring k_s",
        told=seen,
        why="fitted" if seen else "no log tells it: J_m, b_r and f_c are right only in their ratio to it",
    )
    if moves:
        lines.free("J_l")
        lines.free("d_l", 0.1)
    if "hanging" in facts.places:
        lines.known("m", "Mass of the hanging link", why="a usual one; only m L counts, and L is fitted")
        lines.free("L", max=2.0)
    plants: dict[str, Mapping[str, object]] = {}
    options: dict[str, object] = {"parts": list(parts)} if parts else {}
    for place in facts.places:
        plants.setdefault(place, {"kind": "rotary", "link": _LINKS[place], **options})
    return _finish_rotary(lines, facts, plants, options, effort=effort, both=motor and link)


def _list_defaults(own: Mapping[str, Parameter], parts: Sequence[str], stiffness: str) -> dict[str, Parameter]:
    """Return the parameters of an actuator with parts around it, and of a sensor that computes its effort."""
    (nominal,) = PARTS["deflection_sensor"]
    around = {parameter.name: parameter for part in parts for parameter in PARTS[part]}
    return {**own, **around, nominal.name: replace(nominal, unit=stiffness)}


_LINKS = {"held": "locked", "free": "free", "hanging": "pendulum"}


def _add_torque_constant(lines: _Lines, facts: Facts, *, effort: bool) -> None:
    """Add K_tau and eta, of which a log tells the product at most; a commanded torque makes them one."""
    if facts.input == "torque":
        side = lines.interview.ask(
            "torque_at",
            "Is the commanded torque that of the motor or of the output, behind the gear?",
            "output",
            "as drives of robots take it",
            ("output", "motor"),
        )
        gear = float(lines.lines[0].value)
        lines.add("K_tau", f"{1.0 / gear if side == 'output' else 1.0:.10g}", "torque_at")
        if effort:
            lines.free("eta", max=2.0)
        return
    if not effort:
        lines.known("K_tau", "Torque constant K_tau of the motor", why="no log tells it: all torques are in its ratio")
        return
    value = lines.interview.optional(
        "K_tau", "Torque constant K_tau of the motor, in N m/A, or unknown", "fitted, with the losses in it"
    )
    if value is None:
        lines.free("K_tau")
        return
    lines.add("K_tau", f"{value:.10g}", "K_tau")
    lines.free("eta", 0.9, max=1.5)


def _add_drive(lines: _Lines, facts: Facts) -> None:
    """Add what stands between the command and the current."""
    if facts.input in ("V", "duty"):
        lines.known("R", "Winding resistance R", why="a usual one; take it from the data sheet")
    if facts.input == "duty":
        lines.known("V_s", "Supply voltage V_s", why="a usual one")
    if facts.input == "goal":
        lines.known(
            "k_p",
            "Gain k_p of the position loop: current in A for one rad of error at the motor",
            10.0,
            "no log tells it: all torques are in its ratio",
        )


def _finish_rotary(
    lines: _Lines,
    facts: Facts,
    plants: dict[str, Mapping[str, object]],
    options: Mapping[str, object],
    *,
    effort: bool,
    both: bool,
) -> Proposed:
    """Return the actuator with the plants that its controller is for: the link held, and as it hangs from the joint."""
    measured = "tau_s" if effort else "tau_d" if both else ""
    if facts.input == "goal" or not measured:  # a firmware's loop is closed already
        return Proposed(lines=tuple(lines.lines), plants=plants, measured="", design="", robust_to=(), ranges={})
    plants.setdefault("held", {"kind": "rotary", "link": "locked", **options})
    ranges = _add_payload(lines, plants, options)
    if measured == "tau_d":  # the torque of two encoders, by a constant of the firmware's
        spring = next(line.value for line in lines.lines if line.name == "k_s")
        nominal = float(re.findall(r"\d[\d.e+-]*", spring)[0])
        lines.known("k_n", "Stiffness k_n by which torque is computed of the two encoders", nominal, "the spring's")
        parts = [*_DRIVES.get(facts.input, ()), "deflection_sensor"]
        plants = {name: {**table, "parts": parts} for name, table in plants.items()}
    robust_to = tuple(name for name in plants if name == "hanging")
    return Proposed(
        lines=tuple(lines.lines), plants=plants, measured=measured, design="held", robust_to=robust_to, ranges=ranges
    )


def _add_payload(
    lines: _Lines, plants: dict[str, Mapping[str, object]], options: Mapping[str, object]
) -> dict[str, tuple[float, float]]:
    """Add the link that will hang from the joint, where no log had it, and return the range of its inertia.

    A link without gravity is no plant to certify on: under a torque controller its angle drifts.
    """
    if "hanging" in plants:
        return {}
    ranges: dict[str, tuple[float, float]] = {}
    mass = lines.interview.optional(
        "m",
        "Mass of the link that will hang from the joint, in kg, or unknown",
        "the controller is then certified with the link held, and not on one that moves",
    )
    if mass is None:
        return ranges
    lines.add("m", f"{mass:.10g}", "m")
    reach = lines.known("L", "Distance L from its centre of mass to the joint", why="a usual one; measure it")
    if "free" not in plants:
        inertia = lines.known(
            "J_l",
            "Its inertia J_l about the joint",
            float(f"{INERTIA_OVER_POINT * mass * reach**2:.3g}"),
            "a third more than that of a point mass",
        )
        lines.known("d_l", "Damping d_l at the joint", 0.1, "a usual one")
        ranges["J_l"] = (WIDE[0] * inertia, WIDE[1] * inertia)
    plants["hanging"] = {"kind": "rotary", "link": _LINKS["hanging"], **options}
    return ranges


def propose_linear(interview: Interview, facts: Facts) -> Proposed:
    """Return a ball screw's actuator."""
    parts = _DRIVES.get(facts.input, ())
    lines = _Lines(interview, _list_defaults(thor(), parts, "N/m"))
    forces = facts.outputs & {"F1", "F2"}
    placed = bool(facts.outputs & {"q", "screw"})
    lines.known("l", "Lead of the screw l (travel for one turn)", why="a usual one; take it from the data sheet")
    lines.known("N_p", "Reduction N_p between motor and screw", 1.0, "driven directly")
    _add_torque_constant(lines, facts, effort=bool(forces))
    _add_drive(lines, facts)
    lines.free("J", 1e-5)
    lines.free("b_r")
    lines.free("f_c", 5.0)
    seen = bool(forces) and placed
    lines.perhaps(
        "k",
        "Stiffness of the spring k",
        told=seen,
        why="fitted" if seen else "no log tells it: J, b_r and f_c are right only in their ratio to it",
    )
    if len(forces) == 2:
        lines.free("m_l", min=1e-3)
    moves = "swing" in facts.places
    if moves:
        lines.known("L_a", "Lever arm L_a of the force about the pivot", why="a usual one; measure it")
        lines.known("m", "Mass of the pendulum", why="a usual one; weigh it")
        lines.known("L", "Distance L from its centre of mass to the pivot", why="a usual one; measure it")
        lines.free("I_p")
        lines.free("d", 0.1)
    options: dict[str, object] = {"drive": "unlumped", **({"parts": list(parts)} if parts else {})}
    kinds = {"held": "high_impedance", "swing": "moving_output"}
    plants: dict[str, Mapping[str, object]] = {place: {"kind": kinds[place], **options} for place in facts.places}
    if facts.input == "goal" or not forces:
        return Proposed(lines=tuple(lines.lines), plants=plants, measured="", design="", robust_to=(), ranges={})
    plants.setdefault("held", {"kind": "high_impedance", **options})
    ranges: dict[str, tuple[float, float]] = {}
    if not moves:
        inertia = interview.optional(
            "I_p",
            "Inertia of the link that the actuator will swing, about its pivot, in kg m^2, or unknown",
            "the output was held; without it the certificate says nothing of a link that moves",
        )
        if inertia is not None:
            lines.known("L_a", "Lever arm L_a of the force about the pivot", why="a usual one; measure it")
            lines.known("m", "Mass of the link", why="a usual one; weigh it")
            lines.known("L", "Distance L from its centre of mass to the pivot", why="a usual one; measure it")
            lines.add("I_p", f"{inertia:.10g}", "I_p")
            plants["swing"] = {"kind": "moving_output", **options}
            ranges["I_p"] = (WIDE[0] * inertia, WIDE[1] * inertia)
    measured = "F1" if "F1" in forces else "F2"
    return Proposed(
        lines=tuple(lines.lines),
        plants=plants,
        measured=measured,
        design="held",
        robust_to=tuple(name for name in plants if name == "swing"),
        ranges=ranges,
    )


def screw_travel(lines: Sequence[ParameterLine]) -> float:
    """Return how far the nut goes for a radian of the motor."""
    values = {line.name: float(line.value) for line in lines if line.name in ("l", "N_p")}
    return values["l"] / (2.0 * math.pi * values["N_p"])
