"""What a controller sends to the motor for an effort: the plant's actuation, in numbers."""

from __future__ import annotations

import math

import numpy as np

from seaopt.control.loops.sampled_plant import static_gain
from seaopt.errors import ControlError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.plant import describe_parameters, evaluate
from seaopt.records import record
from seaopt.units import Mechanics, mechanics_of, unit_after


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

    """

    input: str
    unit: str
    per_effort: float
    effort_unit: str

    @property
    def mechanics(self) -> Mechanics:
        """Units and words of the effort and of what it moves."""
        return mechanics_of(self.effort_unit)

    @property
    def per_effort_unit(self) -> str:
        """The unit of `per_effort`, such as A/N or A/(N m)."""
        effort = f"({self.effort_unit})" if " " in self.effort_unit else self.effort_unit
        return f"{self.unit}/{effort}"


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
        The effort of one unit is not positive, or the plant states no actuation and has no static gain or a
        negative one.

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
            known = describe_parameters(plant.actuation.effort, values)
            raise ControlError(
                f"plant {plant.name}: one {unit} of {source} makes an effort of {effort:g} {effort_unit}, which must "
                f"be positive; check {known or 'its actuation'}"
            )
    else:
        known = plant.sensing.regulated if plant.sensing is not None else ()
        output = measured if measured in known or not known else known[0]
        effort, effort_unit = static_gain(plant, values, output), plant.outputs[output]
        if -math.inf < effort < -1e-12:
            raise ControlError(
                f"plant {plant.name} states no actuation, and its static gain from {source} to {output} is negative, "
                f"{effort:g}; reverse the input or the output, or give it actuation = Actuation(input, effort)"
            )
        if not (np.isfinite(effort) and effort > 1e-12):
            raise ControlError(
                f"plant {plant.name} states no actuation, and its static gain from {source} to {output} is "
                f"{effort:g}; give it actuation = Actuation(input, effort)"
            )
    return Command(input=source, unit=unit, per_effort=1.0 / effort, effort_unit=effort_unit)


def limit_notes(command: Command, limit: float | None) -> tuple[str, ...]:
    """Say what a limit of the current is of where something else is commanded: a voltage, a duty."""
    if limit is None or command.unit == "A":
        return ()
    return (
        f"current_limit_A = {limit:g} is of what is commanded, {limit:g}{unit_after(command.unit)} of {command.input}: "
        "the current itself is not limited",
    )


def actuation_notes(plant: Plant, command: Command) -> tuple[str, ...]:
    """Say what was assumed of a plant that states no actuation."""
    if plant.actuation is not None:
        return ()
    return (
        f"{plant.name} states no actuation: one {command.unit} of {command.input} was taken to make "
        f"{1.0 / command.per_effort:.4g} {command.effort_unit}, its static gain; give it actuation where that is wrong",
    )
