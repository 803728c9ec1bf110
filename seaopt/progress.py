"""How far a long call has come: one hook for every layer, and what a part of a call makes of it.

The share is of time, as well as it can be told beforehand: what takes as long as it takes is weighted by what it takes
as a rule. So it may leap when something ends early, but it only grows, and it is 1 at the end.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import accumulate, pairwise
from typing import Protocol, TypeVar, runtime_checkable

Item = TypeVar("Item")


@runtime_checkable
class Progress(Protocol):
    """Called now and then by what takes long.

    Parameters
    ----------
    note : str
        What is done just now; without a share, a remark that is worth keeping.
    share : float, optional
        Of the whole call that is done, from 0 to 1; never less than before.
    """

    def __call__(self, note: str, share: float | None = None, /) -> None:
        """Report."""
        ...


def ignore(note: str, share: float | None = None, /) -> None:
    """Tell nobody."""


def divide(progress: Progress, *weights: float) -> list[Progress]:
    """Return the hooks of the parts of a call, one after another, each of which runs from 0 to 1. `progress`: the hook
    of the whole. `weights`: how long each part takes, in any unit.

    Examples
    --------
    >>> first, second = divide(lambda note, share=None: print(note, share), 1.0, 3.0)
    >>> first("half of the first", 0.5); second("the second begins", 0.0); second("a remark")
    half of the first 0.125
    the second begins 0.25
    a remark None
    """
    ends = [0.0, *accumulate(weights)]
    total = ends[-1] or 1.0
    return [_narrow(progress, low / total, high / total) for low, high in pairwise(ends)]


def count_off(items: Sequence[Item], what: str, progress: Progress) -> Iterator[Item]:
    """Yield items that take about as long each, telling before each which one it is.

    Examples
    --------
    >>> for plant in count_off(["stand", "swing"], "plant", lambda note, share=None: print(note, share)):
    ...     pass
    plant 1 of 2 0.0
    plant 2 of 2 0.5
    """
    for number, item in enumerate(items):
        progress(f"{what} {number + 1} of {len(items)}", number / len(items))
        yield item


def prefix(progress: Progress, text: str) -> Progress:
    """Return a hook with a text before every note."""
    return lambda note, share=None, /: progress(f"{text}, {note}", share)


def _narrow(progress: Progress, low: float, high: float) -> Progress:
    def tell(note: str, share: float | None = None, /) -> None:
        progress(note, None if share is None else (1.0 - share) * low + share * high)

    return tell
