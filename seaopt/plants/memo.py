"""Functions of a plant that are computed once for each plant and kept as long as it lives.

What a function returns is kept in its first argument, under the function and the other arguments. So nothing outlives
its plant, and two functions never meet under one key. Of two threads that ask for the same at once, both may compute
it; both get what the first one kept.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar, runtime_checkable


@runtime_checkable
class Remembering(Protocol):
    """An object with a memory, such as a plant."""

    @property
    def memory(self) -> dict[Any, Any]:
        """Results by function and arguments."""
        ...


Owner = TypeVar("Owner", bound=Remembering)
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def memo(function: Callable[Concatenate[Owner, Arguments], Result]) -> Callable[Concatenate[Owner, Arguments], Result]:
    """Make a function of a plant, and of hashable arguments, compute its result once for each of them."""

    @wraps(function)
    def remember(owner: Owner, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        key = (remember, args, tuple(kwargs.items()))
        if key not in owner.memory:
            owner.memory.setdefault(key, function(owner, *args, **kwargs))
        return owner.memory[key]

    return remember


def keep_last(function: Callable[..., Result]) -> Callable[..., Result]:
    """Make a function of spaces of symbols (x, u, p) return what it last did, where the symbols are the very same: a
    plant's f and h are each given them.
    """
    kept: tuple[list[dict[str, Any]], Result] | None = None

    @wraps(function)
    def repeat(*spaces: Any) -> Result:
        nonlocal kept
        given, last = [dict(vars(space)) for space in spaces], kept
        if last is None or not all(map(_are_same, last[0], given)):
            kept = last = given, function(*spaces)
        return last[1]

    return repeat


def _are_same(some: dict[str, Any], others: dict[str, Any]) -> bool:
    return some.keys() == others.keys() and all(some[name] is others[name] for name in some)
