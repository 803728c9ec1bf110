from __future__ import annotations

import math

import pytest

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
