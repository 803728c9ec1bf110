"""Remarks on ranges that are valid but may not be meant: an angle past a right one, the screw's mode left out."""

from __future__ import annotations

import math
from collections.abc import Mapping

from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.robustness import place_value
from seaopt.robustness.uncertainty.draws import SCREW_MASS, SCREW_MODE


def range_remarks(
    ranges: Mapping[str, tuple[float, float]], plants: Mapping[str, Plant], nominal: ParameterSet
) -> list[str]:
    """Return a sentence for a range that turns an angle past a right one, or leaves out the nominal screw's mode.

    A nominal value outside its range is among the notes of the certificate.

    Parameters
    ----------
    ranges : mapping of name to (low, high)
        Good ones: `seaopt.robustness.check_ranges`.
    plants : mapping of name to Plant
        What is certified.
    nominal : ParameterSet
        Its values.

    """
    remarks: list[str] = []
    angles = {name for plant in plants.values() for name, unit in plant.states.items() if unit == "rad"}
    for name, (low, high) in ranges.items():
        place = f"robustness.parameters.{name} = [{low:g}, {high:g}]"
        if name == SCREW_MODE and _screw_mode_outside(low, high, plants, nominal):
            remarks.append(f"{place} Hz leaves out the nominal mode, so that no draw is like the nominal plant")
        if name in angles and max(-low, high) > 0.5 * math.pi:
            ends = f"{math.degrees(low):.4g} to {math.degrees(high):.4g}"
            remarks.append(f"{place} is in rad: {ends} degrees, beyond a right angle; keep it if that is meant")
    return remarks


def _screw_mode_outside(low: float, high: float, plants: Mapping[str, Plant], nominal: ParameterSet) -> bool:
    """Tell whether the nominal m_n is none of those that put the mode into the range: a higher one needs less mass."""
    plant = next(plant for plant in plants.values() if SCREW_MASS in plant.parameters)
    ends = (place_value(plant, nominal, SCREW_MODE, end, plants) for end in (low, high))
    heavy, light = (values[SCREW_MASS].value for values in ends if values is not None)
    return not light <= plant.complete(nominal)[SCREW_MASS].value <= heavy
