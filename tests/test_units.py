from __future__ import annotations

import math

import pytest

from seaopt import units
from seaopt.errors import UnitError
from seaopt.units import factor, same_dimension, si_unit


@pytest.mark.parametrize(
    ("unit", "to", "expected"),
    [
        ("mA", "A", 1e-3),
        ("deg", "rad", math.pi / 180),
        ("kN", "N", 1e3),
        ("kg m^2", "kg m^2", 1.0),
        ("g cm^2", "kg m^2", 1e-7),
        ("N m s", "N m s", 1.0),
        ("usec", "s", 1e-6),
        ("lbf", "N", 4.4482216152605),  # exact by definition
        ("rpm", "rad/s", 2 * math.pi / 60),
        ("mm", "m", 1e-3),
        ("-", "", 1.0),
        ("N/mm", "N/m", 1e3),
    ],
)
def test_factors(unit, to, expected):
    assert factor(unit, to) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("unit", ["flurb", "__import__('os')", "m" * 200, "[N]", "1 +"])
def test_nonsense_is_refused(unit):
    with pytest.raises(UnitError):
        factor(unit, "N")


def test_dimensions_are_compared():
    with pytest.raises(UnitError, match="not one of A"):
        factor("V", "A")
    with pytest.raises(UnitError, match="offset"):
        factor("degC", "K")
    assert same_dimension("deg", "rad")
    assert not same_dimension("N", "A")
    assert si_unit("kN") == "N"
    assert si_unit("m^3") == "m^3"


def test_texts_of_units():
    assert [f"{0.3:g}{units.unit_after(unit)}" for unit in ("m", "-")] == ["0.3 m", "0.3"]
    assert units.divide_units("A", "N m") == "A/(N m)"
    assert units.divide_units("-", "N") == "1/N"
    assert units.divide_units("N m", "N m") == "N m/(N m)"
    assert [units.bare_name(header) for header in ("F1 [N]", "cur")] == ["F1", "cur"]


def test_commands_are_called_by_their_unit_else_by_their_name():
    commands = [("I", "A"), ("V", "V"), ("duty", "-")]
    assert [units.name_command(*command) for command in commands] == ["current", "voltage", "duty"]
    assert [units.show_command(9.0, "I", "A"), units.show_command(0.8, "duty", "-")] == ["9 A", "0.8 of duty"]


def test_quantities_of_linear_and_rotary_actuators():
    assert (units.LINEAR.damping, units.ROTARY.damping) == ("N s/m", "N m s/rad")
    assert (units.ROTARY.stiffness, units.ROTARY.impulse) == ("N m/rad", "N m s")
    assert units.mechanics_of("N m").word == "torque"
    assert (units.mechanics_of("rad").inertia, units.mechanics_of("N").word) == ("kg m^2", "force")
