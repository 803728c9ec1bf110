"""The parameters, plants and options of an actuator that logs were recorded on: which are known, and which are fitted.

A log of an effort (force, torque) with the motor's motion tells the spring; one of an effort alone knows the inertia
only over the stiffness, and one of angles alone only over the torque constant. What no log can tell has to be known: it
is asked, and is a prior or fixed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from seaopt.parameters import Parameter
from seaopt.plants import rotary, thor
from seaopt.plants.parts import PARTS
from seaopt.problem.proposal.questions import Interview
from seaopt.records import record
from seaopt.units import unit_after

# Of the actuators of robots, from a finger to an excavator, in SI: what lies outside is likely in another unit.
USUAL = {
    "N": (1.0, 2000.0), "N_p": (0.1, 20.0), "K_tau": (5e-4, 20.0), "R": (5e-3, 100.0), "V_s": (3.0, 1000.0),
    "k_s": (0.02, 2e5), "k_n": (0.02, 2e5), "k": (1e3, 1e8), "l": (2e-4, 0.1), "L_a": (2e-3, 1.0), "L": (5e-3, 2.0),
    "m": (5e-3, 500.0), "I_p": (1e-6, 500.0),
}  # fmt: skip
PRIOR = 0.05  # share that a data sheet's value may be off
WIDE = (0.5, 2.0)  # of an inertia that somebody estimated: its range
INERTIA_OVER_POINT = 4.0 / 3.0  # of a slender link about its end
DESIGN = "held"  # the plant that controllers are designed on
MOVING = ("hanging", "swing")  # plants that a controller must hold on besides
_DRIVES: dict[str, tuple[str, ...]] = {"V": ("voltage_input",), "duty": ("duty_input",), "goal": ("position_servo",)}
_LINKS = {"held": "locked", "free": "free", "hanging": "pendulum"}
_SCREWS = {"held": "high_impedance", "swing": "moving_output"}
_SCALES = "cannot be identified from the log; {} with it"
_ALL_SCALE = _SCALES.format("all torques scale")


@record
class ParameterLine:
    """A line of [parameters]."""

    name: str
    number: float
    comment: str
    prior_std: float | None = None
    bounds: Mapping[str, float] | None = None  # of one that is fitted; empty without any

    @property
    def value(self) -> str:
        """It as it is written: the number, or a table with it."""
        number, keys = f"{self.number:.10g}", [] if self.prior_std is None else [f"prior_std = {self.prior_std:.3g}"]
        if self.bounds is not None:
            keys += ["free = true", *(f"{key} = {end:.10g}" for key, end in self.bounds.items())]
        return f"{{ value = {number}, {', '.join(keys)} }}" if keys else number


@record
class Facts:
    """The input of the logs, all their outputs, and the places (held, free, ...) of their links."""

    input: str
    outputs: frozenset[str]
    places: tuple[str, ...]
    gear_ratio: float | None = None


@record
class Proposed:
    """An actuator as it goes into a problem file."""

    lines: tuple[ParameterLine, ...]
    plants: Mapping[str, Mapping[str, object]]  # the options of each [plant.NAME]
    measured: str  # what a controller regulates; "" where nothing can be
    ranges: Mapping[str, tuple[float, float]]  # of what nobody measured

    @property
    def robust_to(self) -> tuple[str, ...]:
        """The plants that a controller must hold on besides."""
        return tuple(name for name in self.plants if name in MOVING)


class _ParameterLines:
    """Lines of [parameters], each with what it is and what of it is a guess."""

    def __init__(self, interview: Interview, facts: Facts, defaults: Mapping[str, Parameter], stiffness: str) -> None:
        """Take the parameters of an actuator, of the parts around it, and of a sensor that computes its effort."""
        self.interview = interview
        self.parts = _DRIVES.get(facts.input, ())
        (nominal,) = PARTS["deflection_sensor"]
        around = {parameter.name: parameter for part in self.parts for parameter in PARTS[part]}
        self.defaults = {**defaults, **around, nominal.name: replace(nominal, unit=stiffness)}
        self.lines: list[ParameterLine] = []

    def value(self, name: str) -> float:
        """Return the number of a line that is there."""
        return next(line.number for line in self.lines if line.name == name)

    def add(self, name: str, number: float, mark: str = "", **more: Any) -> None:
        """Add a line; `more` are further fields of `ParameterLine`."""
        parameter = self.defaults[name]
        about = ", ".join(text for text in (parameter.description, unit_after(parameter.unit).strip("- ")) if text)
        comment = "; ".join(
            filter(None, (about, self.interview.mark(mark or name), self.interview.list_doubts().get(name)))
        )
        self.lines.append(ParameterLine(name=name, number=number, comment=comment, **more))

    def free(self, name: str, start: float | None = None, **bounds: float) -> None:
        value = self.defaults[name].value if start is None else start
        self.add(name, value, bounds=bounds)

    def require(
        self, name: str, label: str, guess: float | None = None, why: str = "a typical value", *, meaning: str = ""
    ) -> float:
        """Ask for a value that no log can tell, and write it."""
        start = self.defaults[name].value if guess is None else guess
        detail = meaning + self._in_unit(name)
        value = self.interview.number(name, label, start, why, detail=detail, usual=USUAL.get(name))
        self.add(name, value)
        return value

    def perhaps(self, name: str, label: str, *, identified: bool, why: str) -> None:
        """Ask for a value that the logs may tell: known, it is a prior; unknown, free if they tell, else a guess."""
        value = self.optional(name, label, "it is fitted" if identified else why)
        if value is not None:
            self.add(name, value, prior_std=PRIOR * value)
        elif identified:
            self.free(name)
        else:
            self.interview.assume(name)
            self.add(name, self.defaults[name].value)

    def optional(self, name: str, label: str, why: str) -> float | None:
        """Ask for a value that may be unknown."""
        return self.interview.optional(name, label, why, detail=self._in_unit(name), usual=USUAL.get(name))

    def _in_unit(self, name: str) -> str:
        unit = unit_after(self.defaults[name].unit).strip()
        return f", in {unit}" if unit not in ("", "-") else ""


def propose_rotary(interview: Interview, facts: Facts) -> Proposed:
    """Return a gear's actuator."""
    lines = _ParameterLines(interview, facts, rotary(link="pendulum").defaults, "N m/rad")
    effort, motor, link = (name in facts.outputs for name in ("tau_s", "theta_m", "theta_l"))
    moves = any(mounting != "held" for mounting in facts.places)
    why = "typical of a module; take it from the data sheet"
    if facts.gear_ratio is not None:
        why = "the motor turns this many times as far as the link"
    lines.require("N", "Gear ratio N", facts.gear_ratio, why, meaning=" (turns of the motor for one of the output)")
    _add_drive(lines, facts, effort=effort)
    lines.free("J_m")
    lines.free("b_r")
    lines.free("f_c", 0.2 * lines.defaults["J_m"].value * 100.0, max=10.0)
    identified = (effort and (motor or "deflection" in facts.outputs)) or (moves and (motor or link))
    why = _SCALES.format("J_m, b_r and f_c scale")
    lines.perhaps("k_s", "Stiffness of the spring k_s", identified=identified, why=why)
    interview.assume(
        "c_s", "an undamped spring; with the link held its damping adds to b_r; a fit says where it explains more"
    )
    lines.add("c_s", 0.0)
    if moves:
        lines.free("J_l")
        lines.free("d_l", 0.1)
    if "hanging" in facts.places:
        lines.require("m", "Mass of the hanging link", why="a typical value; only m L matters, and L is fitted")
        lines.free("L", max=2.0)
    places = list(facts.places)
    measured = "tau_s" if effort else "tau_d" if motor and link else ""
    if facts.input == "goal":  # the firmware's loop is closed already
        measured = ""
    parts, ranges = list(lines.parts), dict[str, tuple[float, float]]()
    if measured:
        places.append(DESIGN)
        if "hanging" not in places:
            ranges = _add_payload(lines, places)
    if measured == "tau_d":  # the torque of two encoders, by a constant of the firmware's
        text = "Stiffness k_n that the firmware multiplies the deflection by"
        lines.require("k_n", text, lines.value("k_s"), "that of the spring")
        parts.append("deflection_sensor")
    options = {"parts": parts} if parts else {}
    plants = {mounting: {"kind": "rotary", "link": _LINKS[mounting], **options} for mounting in places}
    return Proposed(lines=tuple(lines.lines), plants=plants, measured=measured, ranges=ranges)


def _add_drive(lines: _ParameterLines, facts: Facts, *, effort: bool) -> None:
    """Add K_tau and eta, of which a log tells the product at most, and what stands between command and current. A
    commanded torque makes K_tau and eta one.
    """
    scaled = "Torque constant K_tau of the motor"
    if facts.input == "torque":
        side = lines.interview.ask(
            "torque_at",
            "Is the commanded torque that of the motor or of the output",
            "output",
            "as most robot drives take it",
            ("output", "motor"),
            detail=", behind the gear?",
        )
        lines.add("K_tau", 1.0 / lines.value("N") if side == "output" else 1.0, mark="torque_at")
        if effort:
            lines.free("eta", max=2.0)
    elif not effort:
        lines.require("K_tau", scaled, why=_ALL_SCALE)
    else:
        value = lines.optional("K_tau", scaled, "it is fitted, and includes the losses of the drive")
        if value is None:
            lines.free("K_tau")
        else:
            lines.add("K_tau", value)
            lines.free("eta", 0.9, max=1.5)
    if facts.input in ("V", "duty"):
        lines.require("R", "Winding resistance R", why="a typical value; take it from the data sheet")
    if facts.input == "duty":
        lines.require("V_s", "Supply voltage V_s")
    if facts.input == "goal":
        lines.require(
            "k_p", "Gain k_p of the position loop: current for one rad of error at the motor", 10.0, _ALL_SCALE
        )


def _add_payload(lines: _ParameterLines, places: list[str]) -> dict[str, tuple[float, float]]:
    """Add the link that will hang from the joint, where no log had it, and return the range of its inertia. A link
    without gravity is no plant to certify on: under a torque controller its angle drifts.
    """
    mass = lines.optional(
        "m",
        "Mass of the link that will hang from the joint",
        "without it the certificate covers the held link only, not a moving one",
    )
    if mass is None:
        return {}
    lines.add("m", mass)
    reach = lines.require("L", "Distance L from its centre of mass to the joint", why="a typical value; measure it")
    places.append("hanging")
    if "free" in places:
        return {}
    point = float(f"{INERTIA_OVER_POINT * mass * reach**2:.3g}")
    inertia = lines.require("J_l", "Its inertia J_l about the joint", point, "a third more than that of a point mass")
    lines.require("d_l", "Damping d_l at the joint", 0.1)
    return {"J_l": (WIDE[0] * inertia, WIDE[1] * inertia)}


def propose_linear(interview: Interview, facts: Facts) -> Proposed:
    """Return a ball screw's actuator."""
    lines = _ParameterLines(interview, facts, thor(), "N/m")
    forces, moves = facts.outputs & {"F1", "F2"}, "swing" in facts.places
    also = ", and correct the scale of q with it" if "screw" in facts.outputs else ""
    why = f"a typical value; take it from the data sheet{also}"
    meaning = " (lead of the screw, or circumference of the belt's pulley)"
    lines.require("l", "Travel l for one turn", why=why, meaning=meaning)
    lines.require("N_p", "Reduction N_p between motor and screw", 1.0, f"driven directly{also}")
    _add_drive(lines, facts, effort=bool(forces))
    lines.free("J", 1e-5)
    lines.free("b_r")
    lines.free("f_c", 5.0)
    identified = bool(forces) and bool(facts.outputs & {"q", "screw"})
    lines.perhaps("k", "Stiffness of the spring k", identified=identified, why=_SCALES.format("J, b_r and f_c scale"))
    if len(forces) == 2:
        lines.free("m_l", min=1e-3)
    if moves:
        _add_pendulum(lines, "pendulum")
        lines.free("I_p")
        lines.free("d", 0.1)
    places, measured = list(facts.places), "F1" if "F1" in forces else "F2" if forces else ""
    if facts.input == "goal":
        measured = ""
    ranges: dict[str, tuple[float, float]] = {}
    if measured:
        places.append(DESIGN)
    if measured and not moves:
        inertia = lines.optional(
            "I_p",
            "Inertia of the link that the actuator will swing, about its pivot",
            "without it the certificate covers the held link only, not a moving one",
        )
        if inertia is not None:
            _add_pendulum(lines, "link")
            lines.add("I_p", inertia)
            places.append("swing")
            ranges["I_p"] = (WIDE[0] * inertia, WIDE[1] * inertia)
    options = {"drive": "unlumped", **({"parts": list(lines.parts)} if lines.parts else {})}
    plants = {mounting: {"kind": _SCREWS[mounting], **options} for mounting in places}
    return Proposed(lines=tuple(lines.lines), plants=plants, measured=measured, ranges=ranges)


def _add_pendulum(lines: _ParameterLines, noun: str) -> None:
    lines.require("L_a", "Lever arm L_a of the force about the pivot", why="a typical value; measure it")
    lines.require("m", f"Mass of the {noun}", why="a typical value; weigh it")
    lines.require("L", "Distance L from its centre of mass to the pivot", why="a typical value; measure it")


def screw_travel(lines: Sequence[ParameterLine]) -> float:
    """Return how far the nut goes for a radian of the motor."""
    values = {line.name: line.number for line in lines}
    return values["l"] / (2.0 * math.pi * values["N_p"])
