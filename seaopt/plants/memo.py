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
