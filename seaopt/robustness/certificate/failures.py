"""What a certificate fails on, for those who say it: each requirement once, by its worst case, with a count."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from seaopt.formatting import format_count
from seaopt.records import record
from seaopt.robustness.certificate.certificate import Requirement

STABILITY = "spectral_radius"


@record(eq=False)
class Failure:
    """Requirements of one name that are not met.

    Parameters
    ----------
    worst : Requirement
        The one that is missed by most.
    count : int
        How many there are.
    places : tuple of str
        The plants that they are of.
    follows : int
        How many other requirements have no value because of this one: an unstable plant has no margins.

    """

    worst: Requirement
    count: int
    places: tuple[str, ...]
    follows: int = 0

    @property
    def unstable(self) -> bool:
        """Whether it is instability, of which only the plants are worth saying."""
        return self.worst.name == STABILITY

    @property
    def consequence(self) -> str:
        """What follows from it besides, after a semicolon; "" where nothing does."""
        return f"; {format_count(self.follows, 'more requirement')} cannot be met then" if self.follows else ""


def group_failures(requirements: Sequence[Requirement]) -> list[Failure]:
    """Return what is not met, each kind once, the worst first; of a plant that is unstable only that.

    Parameters
    ----------
    requirements : sequence of Requirement
        Of a certificate; those that are met are left out.

    """
    broken = [row for row in requirements if not row.met]
    unstable = any(row.name == STABILITY for row in broken)
    rows = [row for row in broken if not unstable or row.name == STABILITY or np.isfinite(row.value)]
    kinds: dict[str, list[Requirement]] = {}
    for row in rows:
        kinds.setdefault(row.name, []).append(row)
    failures = [
        Failure(
            worst=max(of_kind, key=_rank), count=len(of_kind),
            places=tuple(dict.fromkeys(row.where.split(":")[0] for row in of_kind)),
            follows=len(broken) - len(rows) if name == STABILITY else 0,
        )
        for name, of_kind in kinds.items()
    ]  # fmt: skip
    return sorted(failures, key=lambda one: (not one.unstable, -_rank(one.worst)))


def usage_of(row: Requirement) -> float | None:
    """Return which share of its limit a requirement uses, above 1 where it is not met; None where a share says nothing.

    A stable loop's spectral radius is next to 1 however stable it is.
    """
    if not np.isfinite(row.value):
        return None if row.met else np.inf
    if row.name == STABILITY or row.sense == "=":
        return None if row.met else np.inf
    if row.limit == 0.0:
        return 0.0 if row.met else np.inf
    if row.sense == "≥":
        return row.limit / row.value if row.value > 0.0 else np.inf
    return row.value / row.limit


def _rank(row: Requirement) -> float:
    return usage_of(row) or 0.0
