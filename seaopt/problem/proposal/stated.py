"""Columns and units that the user names, by role: they take the place of guesses, and of what headers say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field

from seaopt.errors import LogError, suggestion
from seaopt.problem.proposal.roles import INPUTS, LINEAR_OUTPUTS, ROTARY_OUTPUTS
from seaopt.problem.proposal.survey import LogSurvey
from seaopt.records import record

ROLES = tuple(dict.fromkeys((*INPUTS, *ROTARY_OUTPUTS, *LINEAR_OUTPUTS)))


@record
class Stated:
    """The column of each role, and its unit; "time" is the clock's."""

    columns: Mapping[str, str] = field(default_factory=dict[str, str])
    units: Mapping[str, str] = field(default_factory=dict[str, str])

    def __post_init__(self) -> None:
        for role in self.columns:
            if role not in ROLES and role != "time":
                raise LogError(f'"{role}" is not a channel of an actuator; {suggestion(role, (*ROLES, "time"))}')
        inputs = [role for role in self.columns if role in INPUTS]
        if len(inputs) > 1:
            raise LogError(f"{' and '.join(inputs)} are named as inputs; an actuator has one input, name one of them")
        for role in self.units:
            if role not in self.columns:
                option = "--time COLUMN" if role == "time" else f"--channel {role}=COLUMN"
                raise LogError(f"unit of {role} = {self.units[role]}: name its column too: {option}")
        taken: dict[str, str] = {}
        for role, column in self.columns.items():
            if column in taken:
                raise LogError(f"column {column} is both {taken[column]} and {role}; name it once")
            taken[column] = role

    @property
    def clock(self) -> str | None:
        """The column of times, if it is named."""
        return self.columns.get("time")

    @property
    def roles(self) -> dict[str, str]:
        """The role of each column but the clock."""
        return {column: role for role, column in self.columns.items() if role != "time"}

    @property
    def unit_of(self) -> dict[str, str]:
        """Units by column."""
        return {self.columns[role]: unit for role, unit in self.units.items()}

    @property
    def rotary(self) -> bool | None:
        """Whether the actuator has a gear, else a screw; None where no role says so."""
        turning = any(role in ROTARY_OUTPUTS for role in self.columns)
        return turning or (False if any(role in LINEAR_OUTPUTS for role in self.columns) else None)

    def check(self, surveys: Sequence[LogSurvey]) -> None:
        """Refuse (LogError) columns that no log has, or that do not vary where a log has them."""
        for role, column in self.columns.items():
            names = [[each.name for each in survey.columns] for survey in surveys]
            if role == "time" or any(column in each for each in names):
                continue
            for survey in surveys:
                if (why := survey.left_out.get(column)) is not None:
                    where = f'{survey.name}: column "{column}", named as {role}'
                    raise LogError(f"{where}, is no signal: {why}; name another")
            first = surveys[0].name
            raise LogError(f'{first}: no column "{column}" for {role}; {suggestion(column, names[0])}')
