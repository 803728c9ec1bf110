"""What is worth a word about ranges that may stand: the nominal plant outside them, an angle past a right one."""

from __future__ import annotations

import math
from collections.abc import Mapping

from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.robustness import placed
from seaopt.robustness.draws import SCREW_MASS, SCREW_MODE
from seaopt.units import unit_after

_NOMINAL = "is certified too but lies outside what is drawn"


def range_remarks(
    ranges: Mapping[str, tuple[float, float]], plants: Mapping[str, Plant], nominal: ParameterSet
) -> list[str]:
    """Return a sentence for every range that leaves out the nominal plant, or turns an angle past a right one.

    Parameters
    ----------
    ranges : mapping of name to (low, high)
        Good ones: `seaopt.robustness.check_ranges`.
    plants : mapping of name to Plant
        What is certified.
    nominal : ParameterSet
        Its values; a condition that it does not have is zero.

    """
    found: list[str] = []
    angles = {name for plant in plants.values() for name, unit in plant.states.items() if unit == "rad"}
    for name, (low, high) in ranges.items():
        place = f"robustness.parameters.{name} = [{low:g}, {high:g}]"
        if name == SCREW_MODE:
            if _screw_mode_outside(low, high, plants, nominal):
                found.append(f"{place} Hz does not contain the nominal mode, which {_NOMINAL}")
        else:
            value, unit = (nominal[name].value, nominal[name].unit) if name in nominal else (0.0, "")
            if not low <= value <= high:
                found.append(f"{place} does not contain the nominal {value:.5g}{unit_after(unit)}, which {_NOMINAL}")
        if name in angles and max(-low, high) > 0.5 * math.pi:
            ends = f"{math.degrees(low):.4g} to {math.degrees(high):.4g}"
            found.append(f"{place} is in rad: {ends} degrees, beyond a right angle; keep it if that is meant")
    return found


def _screw_mode_outside(low: float, high: float, plants: Mapping[str, Plant], nominal: ParameterSet) -> bool:
    """Tell whether the nominal m_n is none of those that put the mode into the range: a higher one needs less mass."""
    plant = next(item for item in plants.values() if SCREW_MASS in item.parameters)
    ends = (placed(plant, nominal, SCREW_MODE, end, plants) for end in (low, high))
    heavy, light = (item[SCREW_MASS].value for item in ends if item is not None)
    return not light <= plant.complete(nominal)[SCREW_MASS].value <= heavy
