"""Read the header of a log's column: which quantity, in which unit, of what, commanded or measured.

Names are read word by word ("mot_pos", "motorPosition" and "Motorposition [Grad]" are the same), in English and German,
as engineers and drives write them. What a header leaves open `seaopt.problem.proposal.roles` looks up in the data.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Literal

from seaopt.errors import SeaoptError
from seaopt.records import record
from seaopt.units import COUNT_UNITS, bare_name, is_unit, si_unit

Quantity = Literal["time", "current", "voltage", "duty", "force", "torque", "angle", "length", "speed", "other", ""]
Side = Literal["motor", "link", "spring", ""]

QUANTITY_WORDS: dict[Quantity, frozenset[str]] = {
    "time": frozenset({
        "time", "t", "timestamp", "timestamps", "zeit", "tout", "stamp", "clock", "sekunden", "uptime", "elapsed",
        "millis", "micros",
    }),
    "current": frozenset({"i", "iq", "cur", "curr", "current", "amps", "ampere", "amperes", "strom", "imot", "im"}),
    "voltage": frozenset({"u", "uq", "vq", "volt", "volts", "voltage", "spannung"}),
    "duty": frozenset({"duty", "dutycycle", "pwm", "tastgrad"}),
    "force": frozenset({"f", "f1", "f2", "force", "kraft", "loadcell", "cell", "zugkraft"}),
    "torque": frozenset({"tau", "torque", "trq", "tq", "moment", "drehmoment", "taus", "taum"}),
    "angle": frozenset({"theta", "phi", "angle", "winkel", "ang", "deg", "thetam", "thetal", "rotation"}),
    "length": frozenset({"weg", "stroke", "travel", "displacement", "hub", "x1", "x2"}),
    "speed": frozenset({
        "speed", "vel", "velocity", "omega", "drehzahl", "geschwindigkeit", "qd", "dq", "thetad", "dtheta", "rate",
        "rpm", "winkelgeschwindigkeit", "v", "w", "acc", "accel", "acceleration",
    }),
    "other": frozenset({
        "temp", "temperature", "temperatur", "status", "state", "flag", "flags", "count", "counter", "index", "idx",
        "id", "seq", "error", "mode", "enable", "bus", "vbus", "supply", "battery", "power", "checksum", "crc", "row",
        "sample", "samples", "no", "nr",
    }),
}  # fmt: skip
PLACE_WORDS = frozenset({"pos", "position", "lage", "enc", "encoder", "q", "x", "y", "coordinate", "geber"})
SIDE_WORDS: dict[Side, frozenset[str]] = {
    "spring": frozenset({
        "spring", "feder", "sea", "s", "deflection", "defl", "compression", "auslenkung", "federweg", "sensor", "taus",
        "twist", "stretch",
    }),
    "motor": frozenset({"motor", "mot", "m", "rotor", "screw", "nut", "spindel", "antrieb", "drive", "thetam", "taum"}),
    "link": frozenset({
        "link", "load", "joint", "output", "out", "l", "arm", "knee", "elbow", "ankle", "hip", "shank", "leg",
        "gelenk", "abtrieb", "last", "pendulum", "pendel", "lever", "hebel", "phi", "thetal",
    }),
}  # fmt: skip
COMMAND_WORDS = frozenset({
    "cmd", "command", "commanded", "goal", "ref", "reference", "target", "set", "setpoint", "des", "desired", "soll",
    "demand", "sp",
})  # fmt: skip
MEASURED_WORDS = frozenset({"act", "actual", "meas", "measured", "ist", "present", "fb", "feedback"})
DEFLECTION_WORDS = frozenset({"deflection", "defl", "compression", "auslenkung", "federweg", "twist", "stretch"})
# Within a longer word, as German composes them: Motorstrom, Gelenkwinkel, Sollposition.
LONG = 4

SUFFIXES = {
    "ma": "mA", "a": "A", "amp": "A", "mv": "mV", "v": "V", "n": "N", "kn": "kN", "nm": "N m", "mnm": "mN m",
    "nmm": "N mm", "rad": "rad", "mrad": "mrad", "deg": "deg", "grad": "deg", "mm": "mm", "um": "um", "m": "m",
    "s": "s", "sec": "s", "sek": "s", "ms": "ms", "msec": "ms", "us": "us", "usec": "us", "\u00b5s": "us",
    "\u03bcs": "us", "ns": "ns", "pct": "percent", "percent": "percent",
    "counts": "counts", "ticks": "counts", "cnt": "counts", "inc": "counts", "rpm": "rpm", "dps": "deg/s",
    "rad_s": "rad/s", "deg_s": "deg/s", "m_s": "m/s", "mm_s": "mm/s",
}  # fmt: skip
UNITS_OF: dict[Quantity, str] = {
    "time": "s", "current": "A", "voltage": "V", "duty": "", "force": "N", "torque": "N m", "angle": "rad",
    "length": "m",
}  # fmt: skip
COUNTS = "counts"
# Of a unit that is there: what it measures.
_QUANTITY_OF: dict[str, Quantity] = {
    "s": "time", "A": "current", "V": "voltage", "N": "force", "N m": "torque", "rad": "angle", "m": "length",
    "rad/s": "speed", "m/s": "speed", "degC": "other", "K": "other", "W": "other", "Hz": "other",
    "rad/s^2": "speed", "m/s^2": "speed",
}  # fmt: skip


@record
class Header:
    """A column's name, read."""

    name: str  # as the file has it
    quantity: Quantity  # "" where the name does not say
    side: Side  # of which part of the actuator
    unit: str  # from brackets or a suffix; "counts" of an encoder's steps, "" where there is none
    commanded: bool = False  # whether the name says so
    measured: bool = False  # whether the name says so
    deflection: bool = False  # whether the name says so
    number: int | None = None  # of F1, F2


def read_header(name: str, unit: str | None = None, *, metres: bool = True, brackets: bool = True) -> Header:
    """Return what a column's header says; `unit` is what the file itself states. Without `metres` an m at the end of a
    name is the motor; without `brackets` what stands in them is part of the name.
    """
    stated, bare = _clean_unit(unit), bare_name(name) if brackets else name
    suffix, stem = ("", bare) if stated else split_unit(bare)
    if suffix == "m" and not metres:
        suffix, stem = "", bare
    words = split_words(stem)
    kinds = _list_quantities(words, stem)
    position = bool(_matches(words, PLACE_WORDS | DEFLECTION_WORDS))
    if suffix and not _fits(suffix, kinds, words, position=position):
        suffix, words = "", split_words(bare)
        kinds = _list_quantities(words, bare)
    measures = _quantity_of_unit(stated or suffix)
    if "other" in kinds and measures in ("", "voltage", "current"):  # of the supply, say
        measures = "other"
    if "speed" in kinds and measures in ("angle", "length"):  # a speed in rad, say, is none the less no angle
        measures = "speed"
    quantity = (
        "voltage" if bare == "V" else measures or _decide(kinds, position=position, counts=COUNTS in (stated, suffix))
    )
    return Header(
        name=name,
        quantity=quantity,
        side=_find_side(words),
        unit=stated or suffix,
        commanded=bool(_matches(words, COMMAND_WORDS)),
        measured=bool(_matches(words, MEASURED_WORDS)),
        deflection=bool(_matches(words, DEFLECTION_WORDS)),
        number=_find_number(words),
    )


def is_m_open(header: Header) -> bool:
    """Tell whether the m at the end of a name is metres or the motor, which the name alone does not say."""
    return header.unit == "m" and read_header(header.name, metres=False).quantity == "angle"


def find_unit_in_name(name: str) -> str | None:
    """Return the unit that a name ends in, as i_cmd_A or time_s; None where it ends in none, or in what may be none."""
    header = read_header(name)
    is_sure = is_unit(header.unit) and not is_count(header.unit) and not is_m_open(header)
    return header.unit if header.unit and is_sure else None


def is_count(unit: str) -> bool:
    """Tell whether a header's unit is the steps of an encoder or a converter."""
    return unit.strip().lower().rstrip(".") in COUNT_UNITS


def is_named_time(name: str) -> bool:
    """Tell whether the first word of a name is a time's, whatever follows."""
    words = split_words(re.split(r"[./]", name)[-1])
    return bool(words) and words[0] in QUANTITY_WORDS["time"]


def split_unit(name: str) -> tuple[str, str]:
    """Return the unit that a name ends in, as "_mA", "/ms" or "_rad_s", and the rest of the name; "" where in none."""
    parts = re.split(r"([\s_.\-/]+)", name.strip())
    for words in (2, 1):
        suffix = "_".join(parts[1 - 2 * words :: 2]).lower()
        if len(parts) > 2 * words and suffix in SUFFIXES:
            return SUFFIXES[suffix], "".join(parts[: -2 * words])
    return "", name


def split_words(name: str) -> list[str]:
    """Return the words of a name in small letters."""
    parts = re.findall(r"[A-Z]?[a-zäöüß]+\d*|[A-Z]+\d*(?![a-z])|[A-Z]\d*|\d+", name)
    return [part.lower() for part in parts]


def _clean_unit(unit: str | None) -> str:
    """Return a stated unit that can be used; percent and encoder steps by one name each."""
    if unit is None or not unit.strip():
        return ""
    text = unit.strip()
    if is_count(text):
        return COUNTS
    if text.lower() in ("%", "pct", "percent", "prozent"):
        return "percent"
    return text if is_unit(text) else ""


def _quantity_of_unit(unit: str) -> Quantity:
    if not unit or unit in (COUNTS, "percent", "-", "1"):
        return "duty" if unit == "percent" else ""
    try:
        return _QUANTITY_OF.get(si_unit(unit), "other" if si_unit(unit) else "")
    except SeaoptError:
        return ""


def _fits(unit: str, kinds: list[Quantity], words: list[str], *, position: bool) -> bool:
    """Tell whether a suffix is a unit of what the other words say; tau_s is a torque, and theta_m an angle."""
    measured = _quantity_of_unit(unit)
    if unit == COUNTS or measured in kinds:
        return True
    if measured in ("angle", "length"):
        return (position and "speed" not in kinds) or (not kinds and unit != "m")
    if measured in ("current", "voltage", "force") and _matches(words, COMMAND_WORDS | MEASURED_WORDS):
        return not kinds  # cmd_A, act_N: of a single letter alone nothing else could be meant
    return not kinds and len(unit) > 1 and bool(words)


def _find_number(words: list[str]) -> int | None:
    """Return the number of F1 or F2, of "force 2" or "cell1"."""
    match = re.search(r"(?:f|force|kraft|cell|loadcell)([12])$", "".join(words))
    return int(match[1]) if match else None


def _list_quantities(words: list[str], name: str) -> list[Quantity]:
    kinds: list[Quantity] = [quantity for quantity, vocabulary in QUANTITY_WORDS.items() if _matches(words, vocabulary)]
    if "time" in kinds and set(_matches(words, QUANTITY_WORDS["time"])) == {"t"} and not is_named_time(name):
        kinds.remove("time")  # as in pos_t
    # What is no signal is named in full, or else "states" would be a state.
    return [kind for kind in kinds if kind != "other" or any(word in QUANTITY_WORDS["other"] for word in words)]


def _matches(words: Iterable[str], vocabulary: frozenset[str]) -> list[str]:
    """Return the words that are known, or hold a long known one."""
    long = [word for word in vocabulary if len(word) >= LONG]
    bare = ((word, word.rstrip("0123456789")) for word in words)
    return [
        word for word, stem in bare if word in vocabulary or stem in vocabulary or any(part in word for part in long)
    ]


def _decide(kinds: list[Quantity], *, position: bool, counts: bool) -> Quantity:
    """Return the one quantity of a name's words; of several, the most telling."""
    for quantity in ("other", "speed", "duty", "current", "voltage", "torque", "force", "angle", "length", "time"):
        if quantity in kinds:
            return quantity
    return "angle" if position or counts else ""


def _find_side(words: list[str]) -> Side:
    for side in ("spring", "motor", "link"):
        if _matches(words, SIDE_WORDS[side]):
            return side
    return ""
