"""Remarks on ranges that are valid but may not be meant: an angle past a right one, a nominal mode left out."""

from __future__ import annotations

import math
from collections.abc import Mapping

from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.robustness import place_value
from seaopt.robustness.uncertainty.draws import find_modes


def range_remarks(
    ranges: Mapping[str, tuple[float, float]], plants: Mapping[str, Plant], nominal: ParameterSet
) -> list[str]:
    """Return a sentence for a range that turns an angle past a right one, or leaves out a nominal mode.

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
    modes = find_modes(plants)
    angles = {name for plant in plants.values() for name, unit in plant.states.items() if unit == "rad"}
    for name, (low, high) in ranges.items():
        place = f"robustness.parameters.{name} = [{low:g}, {high:g}]"
        if name in modes and _mode_outside(name, (low, high), plants, nominal):
            remarks.append(f"{place} Hz leaves out the nominal mode, so that no draw is like the nominal plant")
        if name in angles and max(-low, high) > 0.5 * math.pi:
            ends = f"{math.degrees(low):.4g} to {math.degrees(high):.4g}"
            remarks.append(f"{place} is in rad: {ends} degrees, beyond a right angle; keep it if that is meant")
    return remarks


def _mode_outside(name: str, ends_hz: tuple[float, float], plants: Mapping[str, Plant], nominal: ParameterSet) -> bool:
    """Tell whether the nominal value is none of those that put a mode into the range."""
    plant = find_modes(plants)[name]
    assert plant.mode is not None
    placements = (place_value(plant, nominal, name, end, plants) for end in ends_hz)
    values = [each[plant.mode.parameter].value for each in placements if each is not None]
    return not min(values) <= plant.complete(nominal)[plant.mode.parameter].value <= max(values)
