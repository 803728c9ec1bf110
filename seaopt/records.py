"""What this package's data have in common: one decorator, and the attribute through which results draw themselves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, TypeVar, dataclass_transform, overload

T = TypeVar("T")


@overload
def record(cls: type[T], /) -> type[T]: ...
@overload
def record(*, eq: bool = True, repr: bool = True) -> Callable[[type[T]], type[T]]: ...
@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(field,))
def record(cls: type[Any] | None = None, /, *, eq: bool = True, repr: bool = True) -> Any:
    """Make a class a frozen, slotted dataclass with keyword-only fields.

    Parameters
    ----------
    cls : type, optional
        The class, where the decorator stands without brackets.
    eq : bool
        Compare by value. Give False where fields are arrays or symbols: such records compare, and hash, by identity.
    repr : bool
        Write a repr of all fields; False where the class prints itself.

    Examples
    --------
    >>> @record
    ... class Point:
    ...     x_m: float
    >>> Point(x_m=1.0)
    Point(x_m=1.0)

    """
    decorate = dataclass(frozen=True, slots=True, kw_only=True, eq=eq, repr=repr)
    return decorate if cls is None else decorate(cls)


class PlotAccessor:
    """The attribute `plot` of a result: all figures of it when called, each by itself by name, listed by `dir`.

    What draws lies above the results in the layers. It is found by its name when `plot` is read, so that nothing below
    imports it, and a plotting library is loaded when something is drawn.

    Parameters
    ----------
    home : str
        MODULE:CLASS of what draws; it is made with the result.

    """

    def __init__(self, home: str) -> None:
        self._home = home

    def __get__(self, result: object, owner: type | None = None) -> Any:
        if result is None:
            return self
        module, _, name = self._home.partition(":")
        return getattr(import_module(module), name)(result)
