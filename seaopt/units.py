"""Conversion to SI, once, where data comes in (pint), the unit texts that go out, and the units in column headers.

A unit text is what an engineer writes: "N/m", "kg m^2", "mA", "deg", "usec". A space between units multiplies.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from seaopt.errors import UnitError
from seaopt.records import record

if TYPE_CHECKING:
    import pint

DIMENSIONLESS = frozenset({"", "-", "1"})
CELSIUS = frozenset({"degC", "°C", "celsius", "Celsius", "C"})  # a log has temperatures, and no charges in coulombs
# Steps of an encoder or a converter, which are a pure number.
COUNT_UNITS = frozenset(
    {"counts", "count", "ticks", "cnt", "inc", "incr", "increments", "ink", "inkr", "inkremente", "lsb", "steps"}
)
# What pint would read otherwise (Nm as a textile's length per mass, Grad as a gigaradian), or not at all.
_SYNONYMS = {
    "usec": "us", "msec": "ms", "nsec": "ns", "secs": "s", "Ohm": "ohm", "degC": "degC",
    "Nm": "(N*m)", "mNm": "(mN*m)", "kNm": "(kN*m)", "Nmm": "(N*mm)", "Ncm": "(N*cm)",
    "Grad": "deg", "dps": "(deg/s)", "rev": "turn", "Amp": "A", "Amps": "A", "amps": "A", "Volt": "V", "Volts": "V",
}  # fmt: skip
# A colon is an index's, as in x(:,2).
_HEADER = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\]):]*)[\])]\s*$")
# Python would work for years on 9^9^9^9.
_POWER = re.compile(r"(?:\^|\*\*)[\s(+-]*(\d*)")
_POWER_OF_POWER = re.compile(r"(?:\^|\*\*)\s*\(?\s*[-+]?\s*[\d.]+\s*\)?\s*(?:\^|\*\*)")
MAX_POWERS = 6
_TOKEN = re.compile(r"[A-Za-zµμΩ°%]+")


COMMON_SI = ("", "m", "s", "kg", "N", "A", "rad", "N m", "m/s", "rad/s", "m/s^2", "V", "rad/s^2", "K", "Hz", "W")
# In place of base units: stiffness, damping, torque per current, speed per voltage, winding.
DERIVED_SI = ("N/m", "N m/rad", "N s/m", "N m s/rad", "N/A", "N m/A", "V s/rad", "ohm", "H")
# What nearly all logs are in, in SI: asking pint takes half a second the first time.
_USUAL = {
    **{unit: (unit, 1.0) for unit in COMMON_SI}, **dict.fromkeys(DIMENSIONLESS, ("", 1.0)), "Nm": ("N m", 1.0),
    "ms": ("s", 1e-3), "us": ("s", 1e-6), "mA": ("A", 1e-3), "mV": ("V", 1e-3), "mm": ("m", 1e-3), "kN": ("N", 1e3),
    "deg": ("rad", 0.0174532925199433), "deg/s": ("rad/s", 0.0174532925199433), "rpm": ("rad/s", 0.10471975511966),
}  # fmt: skip
_PURE = {"rad": "", "rad/s": "Hz"}  # of what dimension angles are as pure numbers


@lru_cache(maxsize=1)
def _registry() -> pint.UnitRegistry[Any]:
    import pint  # deferred: 0.2 s

    return pint.UnitRegistry(cache_folder=None)


def _pint_text(unit: str) -> str:
    """Rewrite an engineer's unit text ("kg m^2", "N m s/rad") as one that pint parses."""
    text = unit.strip().replace("·", "*").replace("µ", "u").replace("μ", "u").replace("°", "deg")
    text = _TOKEN.sub(lambda token: _name_unit(token.group(0)), text)
    return re.sub(r"(?<=[\w)])\s+(?=[A-Za-z(])", "*", text)


def _name_unit(word: str) -> str:
    """Return the name that pint has for a unit."""
    return "count" if word.lower() in COUNT_UNITS else _SYNONYMS.get(word, word)


@lru_cache(maxsize=256)
def _parse(unit: str) -> Any:
    if unit.strip() in DIMENSIONLESS:
        return _registry().dimensionless
    if len(unit) > 80 or not re.fullmatch(r"[\w *\t/^().·µμ°%Ω+-]+", unit):
        raise UnitError(f'unit "{unit[:80]}" cannot be read; write it like "N", "kg m^2" or "rad/s"')
    powers = _POWER.findall(unit)
    nested = _POWER_OF_POWER.search(unit) or (len(powers) > 1 and re.search(r"\)\s*(?:\^|\*\*)", unit))
    if nested or len(powers) > MAX_POWERS or any(len(digits) > 2 for digits in powers):
        raise UnitError(f'unit "{unit}" raises to a power that no unit has; write it like "N", "kg m^2" or "rad/s"')
    registry = _registry()
    try:
        return registry.Unit("degC" if unit.strip() in CELSIUS else _pint_text(unit))
    except Exception as error:  # pint raises many kinds, tokenizer errors among them
        raise UnitError(f'unit "{unit}" is not known; write it like "N", "mA", "kg m^2" or "rad/s"') from error


@lru_cache(maxsize=1024)
def factor(unit: str, to: str) -> float:
    """Return the number that turns a value in `unit` into one in `to`. `unit`, `to`: unit texts; "", "-" and "1" are
    dimensionless. Raises UnitError: a unit is unknown, the dimensions differ, or the scale has an offset (degrees
    Celsius).
    """
    if unit.strip() == to.strip():
        return 1.0
    si, scale = _USUAL.get(unit.strip(), (None, 1.0))
    if si is not None and si == to.strip():
        return scale
    source, target = _parse(unit), _parse(to)
    if source.dimensionality != target.dimensionality:
        raise UnitError(f'unit "{unit}" is not one of {to or "a pure number"}; give a unit with that dimension')
    zero, scale = (_registry().Quantity(value, source).to(target).magnitude for value in (0.0, 1.0))
    if abs(zero) > 0.0:
        raise UnitError(f'unit "{unit}" has an offset against "{to}"; convert the values before reading them')
    return float(f"{scale:.15g}")


@lru_cache(maxsize=1024)
def si_unit(unit: str) -> str:
    """Return the SI unit of the same dimension, as text: "mA" gives "A", "deg" gives "rad"; "degC" is its own."""
    if unit.strip() in CELSIUS:  # the offset against K makes it a unit of its own
        return "degC"
    if unit.strip() in _USUAL:
        return _USUAL[unit.strip()][0]
    parsed = _parse(unit)
    angular = "radian" in str(_registry().Quantity(1, parsed).to_root_units().units)
    for candidate in (*COMMON_SI, *DERIVED_SI):
        if parsed.dimensionality == _parse(candidate).dimensionality and angular == ("rad" in candidate):
            return candidate
    return f"{_registry().Quantity(1.0, parsed).to_base_units().units:~C}".replace("**", "^").replace("*", " ")


def is_unit(text: str) -> bool:
    """Return whether a text is a known unit."""
    try:
        si_unit(text)
    except UnitError:
        return False
    return True


def same_dimension(first: str, second: str) -> bool:
    """Return whether two unit texts have the same dimension (angles count as pure numbers, as in SI)."""
    if first.strip() in _USUAL and second.strip() in _USUAL:
        pure = [_PURE.get(unit, unit) for unit in (_USUAL[first.strip()][0], _USUAL[second.strip()][0])]
        return pure[0] == pure[1]
    return bool(_parse(first).dimensionality == _parse(second).dimensionality)


def unit_after(unit: str) -> str:
    """Return a unit as it follows a number in a sentence: a space and the unit, or nothing for a pure number."""
    return "" if unit.strip() in DIMENSIONLESS else f" {unit.strip()}"


def divide_units(unit: str, by: str) -> str:
    """Return the text of a unit over another."""
    over, under = unit_after(unit).strip() or "1", unit_after(by).strip() or "1"
    return f"{over}/({under})" if " " in under or "/" in under else f"{over}/{under}"


def name_command(source: str, unit: str) -> str:
    """Return what to call the input that a controller commands: by its unit, else by its own name."""
    return {"A": "current", "V": "voltage"}.get(unit, source)


def show_command(value: float, source: str, unit: str) -> str:
    """Return a value of a commanded input as text, with its unit; a pure number with what it is."""
    return f"{value:.4g}{unit_after(unit) or f' of {name_command(source, unit)}'}"


def header_unit(header: str) -> str | None:
    """Return the unit in a header's brackets, None where there is none.

    Examples
    --------
    >>> header_unit("F1 [N]"), header_unit("Time(usec)"), header_unit("cur"), header_unit("x(:,2)")
    ('N', 'usec', None, None)
    """
    match = _HEADER.match(header)
    return match["unit"].strip() if match else None


def bare_name(header: str) -> str:
    """Return a header without its unit."""
    match = _HEADER.match(header)
    return match["name"].strip() or header if match else header


@record
class Mechanics:
    """How a linear or a rotary actuator's quantities are called: its effort (force, N), its inertia (mass, kg)."""

    word: str
    unit: str
    position: str
    inertia_word: str
    inertias: str
    inertia: str

    @property
    def stiffness(self) -> str:
        """The unit of effort over place."""
        return f"{self.unit}/{self.position}"

    @property
    def damping(self) -> str:
        """The unit of effort over speed."""
        return f"{self.unit} s/{self.position}"

    @property
    def impulse(self) -> str:
        """The unit of effort times time."""
        return f"{self.unit} s"

    @property
    def gain(self) -> str:
        """The unit of effort over effort."""
        return divide_units(self.unit, self.unit)


LINEAR = Mechanics(word="force", unit="N", position="m", inertia_word="mass", inertias="masses", inertia="kg")
ROTARY = Mechanics(
    word="torque", unit="N m", position="rad", inertia_word="inertia", inertias="inertias", inertia="kg m^2"
)


def mechanics_of(unit: str) -> Mechanics:
    """Return how quantities are called where efforts, or places, have a unit: N or m, N m or rad."""
    return ROTARY if unit in (ROTARY.unit, ROTARY.position) else LINEAR
