"""Errors that say what was wrong, with which value, and what to do about it.

Every error that bad input can cause is a `SeaoptError`. Its text names the argument, the value and the
remedy, on one line; the command line prints that line and exits with 2. A defect of seaopt itself, whatever the
input, is an `InternalError`, with which it exits with 70.
"""

from __future__ import annotations

import difflib
import numbers
import traceback
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

MOST_GB = 4.0  # of numbers that one call keeps in memory at a time


class SeaoptError(Exception):
    """Bad input, or a question that has no answer; the message is one line and says what to do.

    Examples
    --------
    >>> raise SeaoptError("bandwidth_hz = 80 is outside 15 to 60; choose one inside, or give bandwidth_range_hz")
    Traceback (most recent call last):
    ...
    seaopt.errors.SeaoptError: bandwidth_hz = 80 is outside 15 to 60; choose one inside, or give bandwidth_range_hz
    """


class ParameterError(SeaoptError, KeyError):
    """A parameter is unknown, lacks a value, or lies outside its bounds.

    It is a KeyError too, which is what the methods of a mapping expect: `ParameterSet.get` rests on it.
    """

    __str__ = Exception.__str__  # KeyError's puts quotes around the message


class UnitError(SeaoptError):
    """A unit is unknown or has the wrong dimension."""


class PlantError(SeaoptError):
    """A plant is not well defined, or is asked for something that it does not have.

    `plant` is the name that the text begins with, empty where it names none, and `reason` what follows.
    """

    def __init__(self, reason: str, *, plant: str = "") -> None:
        super().__init__(f"plant {plant}: {reason}" if plant else reason)
        self.plant, self.reason = plant, reason


class LogError(SeaoptError):
    """A log cannot be read, or does not hold what is asked of it.

    `keys` are the remedies as options of whoever reads the log from a file of settings, each by itself enough.
    """

    def __init__(self, *args: object, keys: Sequence[Mapping[str, Any]] = ()) -> None:
        super().__init__(*args)
        self.keys = tuple(keys)


class SimulationError(SeaoptError):
    """A simulation cannot be made, or left the numbers that can be trusted. `run`: of several, the one that did."""

    def __init__(self, *args: object, run: int = 0) -> None:
        super().__init__(*args)
        self.run = run


class UnplayedError(SimulationError):
    """A scenario that cannot be simulated: which, on what plant, at which draw ("nominal", or its number from 1), and
    its parameters where they differ from the nominal ones.
    """

    def __init__(
        self,
        *args: object,
        plant: str = "",
        scenario: str = "",
        draw: str = "",
        parameters: Mapping[str, float] | None = None,
        seed: int | None = None,
    ) -> None:
        super().__init__(*args)
        self.plant, self.scenario, self.draw, self.seed = plant, scenario, draw, seed
        self.parameters = dict(parameters or {})


class StepSizeError(SimulationError):
    """No number of integration steps that is tried reaches the accuracy asked for."""


class EstimationError(SeaoptError):
    """A fit is not well posed."""


class ControlError(SeaoptError):
    """A controller specification is contradictory or out of range."""


class RunawayError(ControlError):
    """A closed loop grows beyond what a computer has numbers for."""


class ProblemError(SeaoptError):
    """A problem file is not valid."""


class FileError(SeaoptError):
    """A file cannot be read or written."""


class UnknownAttributeError(SeaoptError, AttributeError):
    """A result has no such attribute; an AttributeError too, which `hasattr`, `copy` and notebooks expect."""


class KeywordError(SeaoptError, TypeError):
    """A record of the user's is made with a keyword that it does not have."""


class TruthValueError(SeaoptError, TypeError):
    """A result is taken for a truth value."""


class InternalError(Exception):
    """A defect of seaopt, not of the input: no SeaoptError, so that nothing takes it for one.

    Its text is one line, its note what it takes to see the defect again, and its cause the error that came up.
    """

    @classmethod
    def of(cls, error: Exception, call: str, request: str) -> InternalError:
        """Return the error that reports another one of a call, with what was asked of it."""
        package = Path(__file__).parent
        places = [
            frame for frame in traceback.extract_tb(error.__traceback__) if package in Path(frame.filename).parents
        ]
        where = "".join(f" at {Path(frame.filename).relative_to(package)}:{frame.lineno}" for frame in places[-1:])
        reason = " ".join(str(error).split()) or "no text"
        out = cls(
            f"{call} came upon a defect of seaopt, {type(error).__name__}{where}: {reason}; please report it with the "
            "request below, and change the request a little to go on"
        )
        out.add_note(request)
        return out


def suggestion(name: str, valid: Iterable[str]) -> str:
    """Return what to say after an unknown `name`: the nearest known one, or all of them.

    Examples
    --------
    >>> suggestion("bandwith_hz", ["bandwidth_hz", "measured"])
    'did you mean "bandwidth_hz"?'
    >>> suggestion("zzz", ["J", "b_r"])
    'known: J, b_r'
    """
    names = list(valid)
    near = difflib.get_close_matches(str(name), names, n=1, cutoff=0.6)
    if near:
        return f'did you mean "{near[0]}"?'
    return "known: " + (", ".join(names) if names else "none")


def require_type(
    value: Any,
    kind: type[Any] | tuple[type[Any], ...],
    argument: str,
    remedy: str,
    error: type[SeaoptError] = SeaoptError,
) -> None:
    """Refuse an argument of another type.

    Examples
    --------
    >>> require_type("x.csv", dict, "log", "give a Log")
    Traceback (most recent call last):
    ...
    seaopt.errors.SeaoptError: log = 'x.csv' is a str; give a Log
    """
    if not isinstance(value, kind):
        raise error(f"{argument} = {' '.join(repr(value)[:60].split())} is a {type(value).__name__}; {remedy}")


def require_number(value: Any, argument: str, error: type[SeaoptError] = SeaoptError) -> float:
    """Return a real number as a float; what is none, a flag among them, is refused.

    Examples
    --------
    >>> require_number(2, "k")
    2.0
    >>> require_number(1j, "k")
    Traceback (most recent call last):
    ...
    seaopt.errors.SeaoptError: k = 1j is a complex; give a real number
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise error(f"{argument} = {repr(value)[:60]} is a {type(value).__name__}; give a real number")
    try:
        return float(value)
    except OverflowError:
        raise error(f"{argument} is larger than 1e308; give a number that a computer has") from None


def require_memory(numbers: float, argument: str, error: type[SeaoptError] = SeaoptError) -> None:
    """Refuse what would keep so many numbers in memory that they take more than `MOST_GB`.

    Examples
    --------
    >>> require_memory(1e10, "duration_s = 1e+07")
    Traceback (most recent call last):
    ...
    seaopt.errors.SeaoptError: duration_s = 1e+07 takes about 80 GB of memory, and 4 GB is the most; give less
    """
    size_GB = 8e-9 * numbers
    if not size_GB <= MOST_GB:
        raise error(f"{argument} takes about {size_GB:.2g} GB of memory, and {MOST_GB:g} GB is the most; give less")


def require_seed(seed: Any, error: type[SeaoptError] = SeaoptError) -> int:
    """Return the seed of random numbers; what numpy would not take is refused.

    Examples
    --------
    >>> require_seed(-1)
    Traceback (most recent call last):
    ...
    seaopt.errors.SeaoptError: seed = -1 is not a seed; give a whole number, 0 or more
    """
    if isinstance(seed, bool) or not isinstance(seed, numbers.Integral) or seed < 0:
        raise error(f"seed = {repr(seed)[:60]} is not a seed; give a whole number, 0 or more")
    return int(seed)
