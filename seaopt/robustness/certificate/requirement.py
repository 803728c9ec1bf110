"""A requirement of a certificate as data; where it is decided becomes words here, and nowhere else.

What is not met is said once: each kind of requirement by its worst case, with a count (`group_failures`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from seaopt.codec import Constraints, Key, OrInfinite
from seaopt.control.laws.limits import LIMIT_ROUNDING, Symbol
from seaopt.formatting import format_count, format_number, format_values
from seaopt.records import Result, record

KEPT_TO = 1e-3  # share of a limit by which a row that is read may be beyond it: figures are known to less
MIN_FRICTION_MARGIN = "min_friction_margin"
SPECTRAL_RADIUS = "spectral_radius"  # of which a plant that is unstable fails
LIMIT_CYCLE = "limit_cycle"
LOG_SENSITIVITY = "log_sensitivity"  # of the law, by a log of the fit
LOG_AGREEMENT = "log_agreement"  # of that log with the model
UNSTABLE_LOOP = "the loop is UNSTABLE"
DESIGN_PLANT = "design plant"  # whose own limits are judged
# Of which plants a check speaks: at the nominal parameters, at draws of them, those that were measured, or runs that
# were simulated; "" in an older file.
CheckScope = Literal["", "nominal", "drawn", "measured", "simulated"]


class Spot(NamedTuple):
    """A plant, the state of its friction ("" without), and the value at which a schedule's variable stands."""

    plant: str
    state: str = ""
    place: tuple[str, float] | None = None


@record
class DrawnAt:
    """A set of parameters besides the nominal ones: where it differs, and what a run needs to be played again."""

    parameters: Mapping[str, float] = field(default_factory=dict[str, float])  # empty at the nominal ones
    number: str = ""  # "nominal", or the number of a draw from 1; "" of what is no run
    seed: int | None = None  # of a run's noise and random excitations


@record
class Requirement(Result):
    """One figure against its limit.

    Parameters
    ----------
    name : str
        What is required: "max_sensitivity", "monte_carlo_failures", "step_settling_s", ...
    limit, value : float
        In `unit`.
    met : bool
    sense : {"≤", "≥", "="}
        What the value must be to the limit.
    tolerance : float
        Share of the limit by which the value may be beyond it.
    unit : str
        Empty for ratios and counts.
    plant, state : str
        Whose figure it is, and whether its friction was "sliding" or "stuck"; "" without friction.
    place : (str, float) or None
        The variable of a schedule and its value.
    scenario : str
        What was simulated.
    draw : DrawnAt or None
        The parameters that decide.
    cause : str or None
        Of a run that fails, what it did that it may not: "growth", "outbreak", "gate", "not simulated", ...
    text, remedy : str
        What was found besides, and what to do about it.
    count : int
        Runs that miss it in the same way, of which this is the worst.
    scope : {"nominal", "drawn", "measured", "simulated"}
        What is known by it; "" in an older file.
    risk : float or None
        Share of the risk: the probability with which chance makes the statement wrong; None where none is stated.

    Examples
    --------
    >>> row = Requirement(name="max_sensitivity", limit=1.6, value=1.7, met=False, plant="swing", state="stuck")
    >>> row.where
    'swing stuck'
    """

    json_keys = (
        "name", "limit", "value", "met", "sense", "tolerance", "unit", "plant", "state", Key(field="at", name="place"),
        "scenario", "draw", Key(field="cause", name="cause", omit_none=True), "text", "remedy", "count", "scope",
        "risk", "where",
    )  # fmt: skip

    name: str
    limit: OrInfinite
    value: OrInfinite
    met: bool
    sense: Symbol = "≤"
    tolerance: Annotated[float, Constraints(ge=0.0, le=0.5)] = KEPT_TO
    unit: str = ""
    plant: str = ""
    state: str = ""
    place: tuple[str, float] | None = None
    scenario: str = ""
    draw: DrawnAt | None = None
    cause: str | None = None
    text: str = ""
    remedy: str = ""
    count: Annotated[int, Constraints(ge=1)] = 1
    scope: CheckScope = ""
    risk: Annotated[float, Constraints(ge=0.0, le=1.0)] | None = None

    @property
    def at(self) -> Annotated[dict[str, float], Constraints(min_length=1, max_length=1)] | None:
        """The place as a file has it."""
        return None if self.place is None else dict([self.place])

    @property
    def keeps(self) -> bool:
        """Whether the value keeps the limit but for its tolerance; what is met may need more, as a stable loop."""
        slack = self.tolerance * (abs(self.limit) or 1.0)
        if self.sense == "=":
            return abs(self.value - self.limit) <= slack
        return self.value >= self.limit - slack if self.sense == "≥" else self.value <= self.limit + slack

    def __post_init__(self) -> None:
        for name in ("limit", "value"):  # a whole number is read back as one with a point, and sealed so
            object.__setattr__(self, name, float(getattr(self, name)))

    @property
    def statement(self) -> tuple[str, str, str]:
        """What the risk is of: all rows of the draws together, or of a measured response; each row of a log is one."""
        of_log = self.name if self.name in (LOG_SENSITIVITY, LOG_AGREEMENT) else ""
        return self.scope, self.plant if self.scope == "measured" else "", of_log

    @property
    def subject(self) -> str:
        """Whose figure it is in words: the schedule's value, the plant and the state of its friction."""
        where_in_schedule = "" if self.place is None else "{} = {:.4g}".format(*self.place)
        return ", ".join(filter(None, (where_in_schedule, f"{self.plant} {self.state}".strip())))

    @property
    def where(self) -> str:
        """Where it is decided, in words: subject, scenario, draw and seed at parameters: what was found; remedy."""
        drawn = self.draw or DrawnAt()
        number = f"draw {drawn.number}" if drawn.number else ""
        seed = "" if drawn.seed is None else f"seed {drawn.seed}"
        spot = ", ".join(filter(None, (self.subject, self.scenario, number, seed)))
        at = " at ".join(filter(None, (spot, format_values(drawn.parameters, missing=""))))
        decided = ": ".join(filter(None, (at, self.text)))
        more = f"the worst of {self.count} such runs" if self.count > 1 else ""
        return "; ".join(filter(None, (decided, more, self.remedy)))

    def __str__(self) -> str:
        value, limit = (format_number(number, 6) for number in (self.value, self.limit))
        return f"{self.name} = {value}, must be {self.sense} {limit}{self.unit and f' {self.unit}'} ({self.where})"


def require_at_most(name: str, value: float, limit: float, **fields: Any) -> Requirement:
    """Return a requirement of a value that must not be above its limit; one that lies on it is met."""
    met = bool(value <= limit + LIMIT_ROUNDING * abs(limit))
    return Requirement(name=name, value=value, limit=limit, met=met, **fields)


def require_at_least(name: str, value: float, limit: float, **fields: Any) -> Requirement:
    """Return a requirement of a value that must not be below its limit; one that lies on it is met."""
    met = bool(value >= limit - LIMIT_ROUNDING * abs(limit))
    return Requirement(name=name, value=value, limit=limit, met=met, sense="≥", **fields)


@record(eq=False)
class Failure:
    """Requirements of one name that are not met."""

    worst: Requirement  # the one that is missed by most
    count: int
    subjects: tuple[str, ...]  # plants, with the state of their friction and the value of a schedule's variable
    follows: int = 0  # other requirements that have no value because of this one: an unstable plant has no margins

    @property
    def unstable(self) -> bool:
        """Whether it is instability, of which only the plants are worth saying."""
        return self.worst.name == SPECTRAL_RADIUS

    @property
    def consequence(self) -> str:
        """How many requirements have no value because of it, after a semicolon; "" where none has."""
        return f"; {format_count(self.follows, 'more requirement')} cannot be met then" if self.follows else ""


def group_failures(requirements: Sequence[Requirement]) -> list[Failure]:
    """Return what is not met, each kind once, the worst first; of a plant that is unstable only that."""
    broken = [row for row in requirements if not row.met]
    unstable = any(row.name == SPECTRAL_RADIUS for row in broken)
    rows = [row for row in broken if not unstable or row.name == SPECTRAL_RADIUS or np.isfinite(row.value)]
    kinds: dict[str, list[Requirement]] = {}
    for row in rows:
        kinds.setdefault(row.name, []).append(row)
    failures = [
        Failure(
            worst=max(rows_of_kind, key=_rank),
            count=len(rows_of_kind),
            subjects=tuple(dict.fromkeys(row.subject for row in rows_of_kind)),
            follows=len(broken) - len(rows) if name == SPECTRAL_RADIUS else 0,
        )
        for name, rows_of_kind in kinds.items()
    ]
    return sorted(failures, key=lambda failure: (not failure.unstable, -_rank(failure.worst)))


def usage_of(row: Requirement) -> float | None:
    """Return which share of its limit a requirement uses, above 1 where it is not met; None where, as of a stable
    loop's spectral radius, a share says nothing.
    """
    if not np.isfinite(row.value) or row.name == SPECTRAL_RADIUS or row.sense == "=":
        return None if row.met else np.inf
    if row.limit == 0.0:
        return 0.0 if row.met else np.inf
    if row.sense == "≥":
        return row.limit / row.value if row.value > 0.0 else np.inf
    return row.value / row.limit


def _rank(row: Requirement) -> float:
    return usage_of(row) or 0.0
