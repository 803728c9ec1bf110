"""The command that a controller sends to the motor for an effort: the plant's actuation, in numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Annotated

from seaopt.codec import Constraints
from seaopt.control.laws.delay import LoopSpec
from seaopt.control.laws.structures import PREFILTER
from seaopt.control.loops.sampled_plant import static_gain
from seaopt.errors import ControlError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.plant import describe_parameters, evaluate, find_range
from seaopt.records import record
from seaopt.units import Mechanics, divide_units, mechanics_of, name_command, show_command, unit_after

GAIN_UNITS = {"T_f": "s", "T_q": "s", "T_v": "s", PREFILTER: "Hz"}  # besides those of effort over what is measured


@record
class Command:
    """An input of the plant, in proportion to an effort.

    Parameters
    ----------
    input, unit : str
        What is commanded, such as I in A.
    per_effort : float
        The command for one unit of effort.
    effort_unit : str
        Of the effort: N, or N m.
    largest : float or None
        The largest command that acts, by the plant's actuation; None where it states none.
    measured_unit : str
        Of what is fed back, and of its reference, where it is no effort: rad of an angle.
    """

    input: str
    unit: str
    per_effort: Annotated[float, Constraints(gt=0.0)]
    effort_unit: str
    largest: Annotated[float, Constraints(gt=0.0)] | None = None
    measured_unit: str = ""

    @property
    def word(self) -> str:
        """The commanded quantity: current, voltage, or the input's own name."""
        return name_command(self.input, self.unit)

    @property
    def label(self) -> str:
        """The word with the unit in brackets, for axes and columns."""
        unit = unit_after(self.unit).strip()
        return f"{self.word} [{unit}]" if unit else self.word

    @property
    def symbol(self) -> str:
        """A name of the command in code, with its unit: current_A, voltage_V, command_duty, command_goal_rad."""
        word = f"command_{self.input}" if self.word == self.input else self.word
        return "_".join(re.findall("[A-Za-z0-9_]+", f"{word} {unit_after(self.unit).replace('/', '_per_')}"))

    @property
    def limit_symbol(self) -> str:
        """A name of its limit in code: CURRENT_LIMIT_A, VOLTAGE_LIMIT_V, DUTY_LIMIT."""
        return self.symbol.removeprefix("command_").replace(self.word, f"{self.word}_limit", 1).upper()

    def show(self, value: float) -> str:
        """Return a command as text, with its unit; of a pure number with what it is."""
        return show_command(value, self.input, self.unit)

    def limit(self, requested: float | None) -> float | None:
        """Return the limit that holds: the one requested, and no more than what acts; None without any."""
        limits = [limit for limit in (requested, self.largest) if limit is not None]
        return min(limits, default=None)

    @property
    def reference_unit(self) -> str:
        """The unit of the reference and of the measurement."""
        return self.measured_unit or self.effort_unit

    @property
    def gain_unit(self) -> str:
        """The unit of effort over what is measured: N/N, N m/(N m), N m/rad."""
        return divide_units(self.effort_unit, self.reference_unit)

    @property
    def mechanics(self) -> Mechanics:
        """Units and words of the effort and of what it moves."""
        return mechanics_of(self.effort_unit)

    @property
    def per_effort_unit(self) -> str:
        """The unit of `per_effort`, such as A/N or A/(N m)."""
        return divide_units(self.unit, self.effort_unit)


def command_of(plant: Plant, params: ParameterSet, measured: str) -> Command:
    """Return what a controller commands on a plant: by its actuation, else by its static gain to the regulated output.

    Parameters
    ----------
    plant, params
        The design plant and its parameters.
    measured : str
        The output that is fed back; taken as the regulated one where the plant does not say which that is.

    Raises
    ------
    ControlError
        The effort of one unit, or the largest command, is not positive, or the plant states no actuation and has no
        static gain or a negative one.

    Examples
    --------
    >>> import seaopt as so
    >>> command = command_of(so.plants.high_impedance(), so.plants.thor(), "F1")
    >>> print(f"{command.per_effort:.6f} {command.per_effort_unit}")  # r/(eta K_tau) of (2) and (3)
    0.004161 A/N
    """
    source, unit = next(iter(plant.inputs.items()))
    values = plant.complete(params)
    if plant.actuation is not None:
        effort, effort_unit = evaluate(plant.actuation.effort, values), plant.actuation.unit
        if not 0.0 < effort < math.inf:
            described = describe_parameters(plant.actuation.effort, values)
            raise ControlError(
                f"plant {plant.name}: one {unit} of {source} makes an effort of {effort:g} {effort_unit}, which must "
                f"be positive; check {described or 'its actuation'}"
            )
    else:
        regulated = plant.sensing.regulated if plant.sensing is not None else ()
        output = measured if measured in regulated or not regulated else regulated[0]
        effort, effort_unit = static_gain(plant, values, output), plant.outputs[output]
        if not 1e-12 < effort < math.inf:
            remedy = "reverse the input or the output, or give it" if -math.inf < effort < -1e-12 else "give it"
            raise ControlError(
                f"plant {plant.name} states no actuation, and its static gain from {source} to {output} is "
                f"{effort:g}; {remedy} actuation = Actuation(input, effort)"
            )
    measured_unit = plant.outputs.get(measured, effort_unit)
    return Command(
        input=source,
        unit=unit,
        per_effort=1.0 / effort,
        effort_unit=effort_unit,
        largest=find_range(plant, values),
        measured_unit="" if measured_unit == effort_unit else measured_unit,
    )


def limit_notes(command: Command, spec: LoopSpec) -> tuple[str, ...]:
    """Say which quantity a limit holds where no current is commanded, and where the command's own range is narrower."""
    notes, requested = list[str](), spec.limit_asked
    key = "command_limit" if spec.current_limit_A is None else "current_limit_A"
    in_amperes = {
        "current_limit_A": ("command_limit", command.unit),
        "current_slew_A_per_s": ("command_slew_per_s", divide_units(command.unit, "s")),  # of a plan alone
    }
    for name, (other, unit) in in_amperes.items():
        value: float | None = getattr(spec, name, None)
        if value is not None and command.unit != "A":
            notes.append(
                f"{name} = {value:g} limits the command, {value:g}{unit_after(unit)} of {command.input}, not the "
                f"current itself; {other} is the same under its own name"
            )
    if command.largest is not None and (requested is None or requested > command.largest):
        reason = "no limit is given" if requested is None else f"{key} = {requested:g} is more than acts"
        reach = f"{command.largest:.4g}{unit_after(command.unit)}"
        notes.append(f"{reason}: the {command.word} is limited to its range, {reach}")
    return tuple(notes)


def actuation_notes(plant: Plant, command: Command) -> tuple[str, ...]:
    """Say what was assumed of a plant that states no actuation."""
    if plant.actuation is not None:
        return ()
    return (
        f"{plant.name} states no actuation: one {command.unit} of {command.input} was taken to make "
        f"{1.0 / command.per_effort:.4g} {command.effort_unit}, its static gain; give it actuation where that is wrong",
    )


def name_gain_units(command: Command) -> dict[str, str]:
    """Return the units of the gains of a law that gives efforts, by name; what is not there has none."""
    units = name_rates(command.effort_unit, command.reference_unit, command.mechanics)
    if command.effort_unit == command.reference_unit:
        units |= {"k_i": "1/s", "k_d": "s"}
    return GAIN_UNITS | units


def name_rates(unit: str, measured: str, mechanics: Mechanics) -> dict[str, str]:
    """Return the units of gains from a measured signal, its integral and rate, and a motor's speed, to some unit."""
    ratio, seconds = divide_units(unit, measured), f"{unit_after(unit).strip()} s".strip()
    return {
        "k_p": ratio,
        "k_i": divide_units(unit, f"{measured} s"),
        "k_d": divide_units(seconds, measured),
        "k_r": ratio,
        "k_ff": ratio,
        "k_v": divide_units(seconds, mechanics.position),
    }


def describe_cascade(gains: Mapping[str, float], command: Command) -> str:
    """Return the gains of a cascade as a drive with a speed loop is set: speeds per force error."""
    called = command.mechanics
    units = name_rates(f"{called.position}/s", command.reference_unit, called)
    drive = ", ".join(
        f"{name} = {gains[name] / gains['k_v']:.5g} {units[name]}" for name in ("k_p", "k_i", "k_d", "k_r")
    )
    inside = f"a PI of T_v = {gains['T_v']:.4g} s" if "T_v" in gains else "a P"
    return f"as speeds asked of the motor's speed loop, {inside} of k_v: {drive}"
