from __future__ import annotations

import math
import subprocess
import sys

import pytest

import seaopt as so
from seaopt import units
from seaopt.errors import UnitError
from seaopt.plants.equations.declaration import PLAIN_UNIT
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


@pytest.mark.parametrize(
    ("unit", "si"),
    [
        ("N m/rad", "N m/rad"),
        ("N m/deg", "N m/rad"),
        ("kN/mm", "N/m"),
        ("N s/mm", "N s/m"),
        ("N m s/rad", "N m s/rad"),
        ("mN m/A", "N m/A"),
        ("N/A", "N/A"),
        ("V s/rad", "V s/rad"),
        ("mohm", "ohm"),
        ("mH", "H"),
    ],
)
def test_units_of_an_actuator_are_those_that_engineers_write(unit, si):
    assert si_unit(unit) == si and factor(si_unit(unit), si) == 1.0


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


def test_usual_units_are_what_pint_makes_of_them(monkeypatch):
    usual = dict(units._USUAL)
    pairs = [(unit, other) for unit in usual for other in usual]
    quick = {pair: same_dimension(*pair) for pair in pairs}
    monkeypatch.setattr(units, "_USUAL", {})
    for unit, (si, scale) in usual.items():
        assert si_unit.__wrapped__(unit) == si
        assert factor.__wrapped__(unit, si) == scale
    assert {pair: same_dimension(*pair) for pair in pairs} == quick


@pytest.mark.parametrize("unit", ["m", "1/(N m)", "m/(N m)", "kg m^2", "N m s/rad", "1/K", "N/m^3", "W/K", "N s^2/m/A"])
def test_units_of_plants_that_are_not_looked_up_are_pints(unit):
    assert PLAIN_UNIT.fullmatch(unit)
    assert units._parse(unit) is not None


@pytest.mark.parametrize("unit", ["m//s", "m/", "(m", "m m)", "N m/(s", "flurb", "m^", "1/1/", "kg^22", "m  s"])
def test_units_that_are_looked_up(unit):
    assert not PLAIN_UNIT.fullmatch(unit)


def test_usual_units_need_no_pint():
    code = "import sys; from seaopt.units import factor, si_unit; factor('deg', 'rad'); sys.exit('pint' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("unit", ["cnt", "Counts", "ticks", "inc", "LSB"])
def test_steps_of_an_encoder_are_a_number_by_whichever_name(unit, tmp_path):
    assert factor(unit, "") == 1.0 and si_unit(unit) == "" and not same_dimension(unit, "N")
    (tmp_path / "log.csv").write_text(f"t [s],ENC [{unit}],I [A]\n0,4096,1\n1,4097,2\n2,4098,3\n", encoding="utf-8")
    assert so.read_log(tmp_path / "log.csv")["ENC"].tolist() == [4096.0, 4097.0, 4098.0]
