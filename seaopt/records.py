"""The base of this package's data: one decorator, and the attribute through which results draw themselves."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import wraps
from importlib import import_module
from operator import attrgetter
from reprlib import recursive_repr
from typing import TYPE_CHECKING, Any, TypeVar, dataclass_transform, overload

from seaopt.errors import KeywordError, TruthValueError, UnknownAttributeError, suggestion
from seaopt.options import document_options, option

T = TypeVar("T")
_MET = attrgetter("met")  # a field of some results, a property of others
# What people who know lmfit, SciPy and python-control try first, and what has it here.
GUESSES = {
    "params": "parameters", "stderr": 'parameters["NAME"].std', "success": "met", "ok": "met",
    "residuals": "minimum.residuals()", "save": "to_dict()", "to_json": "to_dict()",
    "kp": 'gains["k_p"]', "ki": 'gains["k_i"]', "kd": 'gains["k_d"]',
    "k_p": 'gains["k_p"]', "k_i": 'gains["k_i"]', "k_d": 'gains["k_d"]',
    "bandwidth": "achieved.bandwidth_hz", "cov": "covariance", "covar": "covariance", "nit": "iterations",
}  # fmt: skip


@overload
def record(cls: type[T], /) -> type[T]: ...
@overload
def record(*, eq: bool = True, repr: bool = True, keywords: bool = False) -> Callable[[type[T]], type[T]]: ...
@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(field, option))
def record(cls: type[Any] | None = None, /, *, eq: bool = True, repr: bool = True, keywords: bool = False) -> Any:
    """Make a class a frozen, slotted dataclass with keyword-only fields. `eq`: compare by value; False, by identity,
    where fields are arrays or symbols. `repr`: of all fields; False where the class prints itself. `keywords`: answer
    an unknown keyword with the nearest field, for what users write: it costs a microsecond per call.
    """
    decorate = dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)

    def make(plain: type[Any]) -> type[Any]:
        made = decorate(plain)
        methods = {**(_compare_by_value(made) if eq else {}), **({"__repr__": _name_fields} if repr else {})}
        for name in methods.keys() - made.__dict__.keys():
            setattr(made, name, methods[name])
        if any("option" in each.metadata for each in fields(made)):
            made.__doc__ = document_options(made)
        return _explain_keywords(made) if keywords else made

    return make if cls is None else make(cls)


def _compare_by_value(cls: type[Any]) -> dict[str, Any]:
    """Return what makes two of a class equal where their fields are. A dataclass does the same by code that it compiles
    for each class, which takes a tenth of the time in which a first command loads.
    """
    names = [each.name for each in fields(cls) if each.compare]
    values = attrgetter(*names, "__class__")  # two names at least make it a tuple

    def compare(self: Any, other: object) -> Any:
        return values(self) == values(other) if other.__class__ is self.__class__ else NotImplemented

    def hash_values(self: Any) -> int:
        return hash(values(self))

    return {"__eq__": compare, "__hash__": hash_values}


@recursive_repr()
def _name_fields(self: Any) -> str:
    named = (f"{each.name}={getattr(self, each.name)!r}" for each in fields(self) if each.repr)
    return f"{type(self).__qualname__}({', '.join(named)})"


def _explain_keywords(cls: type[Any]) -> type[Any]:
    """Let the constructor answer an unknown keyword with a SeaoptError that names the nearest."""
    make = cls.__init__

    @wraps(make)
    def construct(self: Any, *args: Any, **fields: Any) -> None:
        try:
            make(self, *args, **fields)
        except TypeError as error:
            keywords = [name for name, each in cls.__dataclass_fields__.items() if each.init]
            wrong = next((name for name in fields if name not in keywords), None)
            if wrong is None:
                raise
            raise KeywordError(f"{cls.__name__} has no {wrong}; {suggestion(wrong, keywords)}") from error

    cls.__init__ = construct
    return cls


WORDS = "seaopt.reporting.sections"  # found by its name when a result is printed, as what draws is
PLOTS = "seaopt.reporting.plots"


class Worded:
    """A result that prints itself, in text and in notebooks, with the sections that the report has of it, too."""

    __slots__ = ()

    def __repr__(self) -> str:
        return import_module(WORDS).write_text(self)

    def _repr_html_(self) -> str:
        return import_module(WORDS).write_html(self)


class Result:
    """A result with a verdict: `met`; a wrong name is answered with the right one."""

    __slots__ = ()

    @property
    def passed(self) -> bool:
        """The same as `met`."""
        return _MET(self)

    @property
    def feasible(self) -> bool:
        """The same as `met`."""
        return _MET(self)

    def __bool__(self) -> bool:
        raise TruthValueError(
            f"a {type(self).__name__} has no truth value, which would be true whatever the result says; use .met"
        )

    if not TYPE_CHECKING:  # or every name would be known to a type checker

        def __getattr__(self, name: str) -> Any:
            if hasattr(type(self), name):  # a property that failed by itself, whose own error tells more
                return object.__getattribute__(self, name)
            kind = type(self).__name__
            if name.startswith("_"):
                raise UnknownAttributeError(f"{kind} has no attribute {name}")
            names = [each for each in dir(type(self)) if not each.startswith("_")]
            guess = GUESSES.get(name, "")
            remedy = f"use .{guess}" if guess and re.split(r"\W", guess)[0] in names else suggestion(name, names)
            raise UnknownAttributeError(f"{kind} has no attribute {name}; {remedy}")


class PlotAccessor:
    """The attribute `plot` of a result: all figures of it when called, each by itself by name, listed by `dir`. What
    draws lies above the results in the layers. It is imported by its name when `plot` is read, so that nothing below
    imports it, and a plotting library is loaded when something is drawn.
    """

    def __get__(self, result: object, owner: type | None = None) -> Any:
        return self if result is None else import_module(PLOTS).Plots(result)
