"""A log with the roles and units of its columns, its clock and its plant, as a problem file will describe it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from seaopt.estimation.judgement.second_log import SECOND
from seaopt.logs.quality.clock import ClockQuality
from seaopt.problem.proposal.roles import Assignment
from seaopt.problem.proposal.survey import LogSurvey
from seaopt.problem.proposal.traits import Traits
from seaopt.records import record
from seaopt.signals import RawLog, Signal, VectorN
from seaopt.units import factor

GEARED = (1.5, 1000.0)  # slopes of motor over link that are a gear's

SI_UNITS = {
    "I": "A", "torque": "A", "V": "V", "duty": "-", "goal": "rad", "F1": "N", "F2": "N", "q": "m", "screw": "rad",
    "phi": "rad", "tau_s": "N m", "theta_m": "rad", "theta_l": "rad", "deflection": "rad",
}  # fmt: skip


@record(eq=False)
class DescribedLog:
    """A log with its roles."""

    survey: LogSurvey
    roles: Assignment
    name: str
    file: str
    plant: str
    units: Mapping[str, str]
    scales: Mapping[str, float]
    time_unit: str
    clock: ClockQuality | None
    rate_hz: float
    traits: Traits = Traits()

    @property
    def outputs(self) -> tuple[str, ...]:
        """What is fitted; a link that is held has no angle."""
        return tuple(role for role in self.roles.outputs if not (role == "theta_l" and self.plant == "held"))

    def si_scale(self, role: str) -> float:
        """Return what a role's numbers are multiplied by to be in SI; 1 of a role that the log does not have."""
        return factor(self.units[role], SI_UNITS[role]) * self.scales.get(role, 1.0) if role in self.units else 1.0

    @property
    def signals(self) -> dict[str, VectorN]:
        """Samples of each role in SI."""
        return {role: column.values * self.si_scale(role) for role, column in self.roles.columns.items()}


def make_table(log: DescribedLog, outputs: Sequence[str]) -> RawLog | None:
    """Return the input and some outputs on the log's clock, in SI; None of a log without one."""
    if log.survey.clock is None:
        return None
    time = log.survey.clock.values * factor(log.time_unit, "s")
    signals = log.signals
    channels = {name: Signal(name=name, values=signals[name].copy(), unit="") for name in (log.roles.input, *outputs)}
    return RawLog(time=time, signals=channels, source=log.survey.name)


def list_single(logs: Sequence[DescribedLog]) -> list[DescribedLog]:
    """Return the last log of each plant whose inputs have one amplitude: what a model lacks, one amplitude hides."""
    swings: dict[str, list[float]] = {}
    for log in logs:
        size = log.roles.columns[log.roles.input].swing * abs(log.si_scale(log.roles.input))
        swings.setdefault(log.plant, []).append(size)
    lasts = {log.plant: log for log in logs}
    return [lasts[plant] for plant, sizes in swings.items() if min(sizes) > SECOND * max(sizes)]


def doubt_clock(survey: LogSurvey) -> str:
    """Return why a log's clock is a guess; "" where its name says that it is one."""
    return "" if survey.clock is None or survey.clocks else "the time, as it only rises, and evenly"
