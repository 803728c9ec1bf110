"""One decorator for this package's data: frozen, slotted dataclasses whose fields are given by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
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
