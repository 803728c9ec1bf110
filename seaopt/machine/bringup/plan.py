"""A bring-up: its stages, each a law with what is played and expected, and how bringup.json has them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np

from seaopt.codec import Constraints, Key, OrInfinite, check_agrees, from_content, to_content
from seaopt.control import ForceMPC
from seaopt.errors import FileError
from seaopt.machine.acceptance import StageName, hash_source
from seaopt.machine.bringup.excitation import Excitation, count_periods
from seaopt.machine.bringup.expected import KEPT, Band, Expected, OuterExpected, enclose_link
from seaopt.machine.response.judged import Prediction
from seaopt.machine.response.verdicts import Motion, list_limits
from seaopt.machine.stepped import Source, stand
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import Result, Worded, record
from seaopt.robustness import Certificate, Requirement
from seaopt.signals import REFERENCE

BRINGUP_SCHEMA = "seaopt/bringup/2"
FILE, PLAN_AGAIN = "bringup.json", "plan the stages again: seaopt bringup"


@record(eq=False)
class Stage(Expected, Result):
    """One law on its way to the machine.

    Parameters
    ----------
    name : str
        Of its folder.
    source : Controller, ScheduledController or ForceMPC
        What is exported; `controller` is it as a law: of a schedule where its variable stands, of predictive control
        while no limit is active.
    requirements : tuple of Requirement
        Those of its law's certificate.
    certificate : Certificate or None
        None where the stage was read from bringup.json.
    note : str
        In what the stage differs from what was planned.
    place : float or None
        Where a schedule's variable is to stand.
    around : OuterExpected or None
        Of the full law: what to play when its outer loop is closed, too, where the plant of its link is known, and the
        loop is stable on it.
    outer_unstable : bool
        Whether the plant of the link is known, and by the model the outer loop is not stable on it.
    """

    name: str
    source: Source
    requirements: tuple[Requirement, ...]
    certificate: Certificate | None = None
    note: str = ""
    place: float | None = None
    around: OuterExpected | None = None
    outer_unstable: bool = False

    @property
    def met(self) -> bool:
        """Whether its law is certified."""
        return all(row.met for row in self.requirements)

    @property
    def channels(self) -> tuple[str, ...]:
        """What to log in each tick."""
        controller, source = self.controller, self.source
        over = () if source.over is None else (source.over,)
        return tuple(
            dict.fromkeys((REFERENCE, *controller.signals, *controller.further, *over, controller.command.input))
        )


@record
class StoredReference:
    """A reference without its waves."""

    amplitude: float
    bias: float
    unit: str
    period_s: Annotated[float, Constraints(gt=0.0)]
    periods: Annotated[int, Constraints(ge=1)]
    phases: Annotated[int, Constraints(ge=1)]
    frequency_hz: Annotated[tuple[float, ...], Constraints(min_length=1)]

    @property
    def lasts_s(self) -> float:
        """How long all of it lasts."""
        return count_periods(self.phases, self.periods) * self.period_s


@record
class _UnderReference:
    """What certified machines do under a stage's own reference, beside the limits of its law."""

    figures: Mapping[str, float]
    peaks: Mapping[str, OrInfinite]
    bandwidth_hz: OrInfinite
    turned: bool
    limits: Mapping[str, float]
    broken: tuple[str, ...]
    enough_share: float | None
    lowered: bool


@record
class _Bands:
    """Between what responses lie on the draws."""

    tracking: Band
    sensitivity: Band
    step: Band


@record
class _Played:
    """What is played, and what it is to do."""

    reference: StoredReference
    friction: Motion | None
    under_reference: _UnderReference | None
    peaks: Mapping[str, float]
    limits: Mapping[str, float]
    stop: Mapping[str, float]
    step_size: float | None
    expected: _Bands
    ran_away: int


@record
class StoredStage(_Played):
    """A stage, whose law is in its own controller.json."""

    json_keys = (
        *("name", "note", "met", "law", "place", "bandwidth_hz", "command_limit", "channels", "rate_hz"),
        *("reference", "friction", "under_reference", "peaks", "limits", "stop", "step_size", "expected", "ran_away"),
        *("outer", "outer_unstable", "requirements"),
    )

    name: StageName
    note: str
    met: bool
    law: str  # what tells it from any other
    place: float | None
    bandwidth_hz: float
    command_limit: float | None
    channels: tuple[str, ...]
    rate_hz: float
    outer: _Played | None
    outer_unstable: bool
    requirements: Annotated[tuple[Requirement, ...], Constraints(min_length=1)]


@record
class StoredPlan:
    """What bringup.json has."""

    json_keys = ("met", *(Key(field=name, name=name, omit_none=True) for name in ("fit_met", "peaks_kept")), "stages")

    met: bool
    fit_met: bool | None = None
    peaks_kept: float | None = None  # share of certified machines that stay below each of `peaks`; None in older files
    stages: Annotated[tuple[StoredStage, ...], Constraints(min_length=1)]


@record(eq=False, repr=False)
class BringUp(Result, Worded):
    """The stages of a bring-up, the full law last.

    Parameters
    ----------
    stages : tuple of Stage
        In the order in which they are played.
    fit_met : bool or None
        Whether the fit that the laws were tuned with is met; None where nothing is known of one.
    peaks_kept : float or None
        The share of certified machines that stay below each of the peaks; None as read from a file of before.
    """

    stages: tuple[Stage, ...]
    fit_met: bool | None = None
    peaks_kept: float | None = KEPT

    @property
    def met(self) -> bool:
        """Whether the law of every stage is certified, and the fit is met."""
        return all(stage.met for stage in self.stages) and self.fit_met is not False

    def to_dict(self) -> dict[str, Any]:
        """Return the content of bringup.json (schema seaopt/bringup/2)."""
        stages = tuple(map(_describe, self.stages))
        stored = StoredPlan(met=self.met, fit_met=self.fit_met, peaks_kept=self.peaks_kept, stages=stages)
        return {"schema": BRINGUP_SCHEMA} | to_content(stored)

    @classmethod
    def from_dict(
        cls, content: Mapping[str, Any], laws: Mapping[str, Source], link: tuple[Plant, ParameterSet] | None = None
    ) -> BringUp:
        """Return the bring-up of a bringup.json, without certificates and the references themselves; nothing is tuned
        or simulated. `laws`: that of each stage, by its name. `link`: as of `bring_up`. Raises FileError: a field is
        missing or malformed, contradicts another, or is of another law.
        """
        stored = from_content(StoredPlan, content, FILE, remedy=PLAN_AGAIN)
        stages = tuple(_make_stage(each, laws, link) for each in stored.stages)
        plan = cls(stages=stages, fit_met=stored.fit_met, peaks_kept=stored.peaks_kept)
        check_agrees(content, plan.to_dict(), FILE, remedy=PLAN_AGAIN)
        return plan


def list_stages(content: Mapping[str, Any]) -> tuple[StoredStage, ...]:
    """Return the stages of a bringup.json, without their laws. Raises FileError: a field is missing or malformed."""
    return from_content(StoredPlan, content, FILE, remedy=PLAN_AGAIN).stages


def _describe(stage: Stage) -> StoredStage:
    controller, around = stage.controller, stage.around
    return StoredStage(
        name=stage.name,
        note=stage.note,
        met=stage.met,
        law=hash_source(stage.source),
        place=stage.place,
        bandwidth_hz=controller.spec.bandwidth_hz,
        command_limit=controller.command_limit,
        channels=stage.channels,
        rate_hz=1.0 / controller.sample_time_s,
        outer=None if around is None else _Played(**_describe_played(around)),
        outer_unstable=stage.outer_unstable,
        requirements=stage.requirements,
        **_describe_played(stage),
    )


def _describe_played(expected: Expected) -> dict[str, Any]:
    excitation, prediction = expected.excitation, expected.prediction
    return {
        "reference": StoredReference(
            amplitude=excitation.amplitude,
            bias=excitation.bias,
            unit=expected.unit,
            period_s=excitation.period_s,
            periods=excitation.periods,
            phases=excitation.phases,
            frequency_hz=tuple(excitation.frequency_hz.tolist()),
        ),
        "friction": expected.motion,
        "under_reference": None
        if prediction is None
        else _UnderReference(
            **to_content(prediction),
            limits=list_limits(expected.controller),
            broken=expected.broken,
            enough_share=expected.enough,
            lowered=expected.lowered,
        ),
        "peaks": excitation.peaks,
        "limits": excitation.limits,
        "stop": expected.stop,
        "step_size": expected.step_size,
        "ran_away": expected.ran_away,
        "expected": _Bands(tracking=expected.tracking, sensitivity=expected.sensitivity, step=expected.step),
    }


def _make_stage(stored: StoredStage, laws: Mapping[str, Source], link: tuple[Plant, ParameterSet] | None) -> Stage:
    """Return a stage with its law."""
    source = laws.get(stored.name)
    if source is None:
        raise FileError(f"{FILE}: stage {stored.name} has no law; {PLAN_AGAIN}")
    if not isinstance(source, ForceMPC) and hash_source(source) != stored.law:  # that is designed again
        raise FileError(f"{FILE}: stage {stored.name} is of law {stored.law}, not {hash_source(source)}; {PLAN_AGAIN}")
    controller, around = stand(source, stored.place), None
    if stored.outer is not None:
        at = None if source.over is None or stored.place is None else (source.over, stored.place)
        enclosed = enclose_link(controller, link, at)
        if controller.outer is None or enclosed is None:
            raise FileError(f"{FILE}: stage {stored.name} has an outer loop, which its law has not; {PLAN_AGAIN}")
        played = _make_played(stored.outer, enclosed.sample_time_s)
        around = OuterExpected(controller=enclosed, outer=controller.outer, **played)
    return Stage(
        name=stored.name,
        source=source,
        controller=controller,
        requirements=stored.requirements,
        note=stored.note,
        place=stored.place,
        around=around,
        outer_unstable=stored.outer_unstable,
        **_make_played(stored, controller.sample_time_s),
    )


def _make_played(stored: _Played, sample_time_s: float) -> dict[str, Any]:
    """Return the fields of what is expected, but for the law."""
    reference, under, motion = stored.reference, stored.under_reference, stored.friction
    excitation = Excitation(
        sample_time_s=sample_time_s,
        bias=reference.bias,
        amplitude=reference.amplitude,
        period=round(reference.period_s / sample_time_s),
        phases=reference.phases,
        lines=np.round(np.array(reference.frequency_hz) * reference.period_s).astype(int),
        periods=reference.periods,
        peaks=stored.peaks,
        limits=stored.limits,
    )
    prediction = None
    if under is not None:
        names = ("figures", "peaks", "bandwidth_hz", "turned")
        prediction = Prediction(**{name: getattr(under, name) for name in names})
    return {
        "excitation": excitation,
        "tracking": stored.expected.tracking,
        "sensitivity": stored.expected.sensitivity,
        "step": stored.expected.step,
        "step_size": stored.step_size,
        "stop": stored.stop,
        "effort": None if motion is None else motion.effort,
        "friction": None if motion is None else motion.dry,
        "prediction": prediction,
        "enough": None if under is None else under.enough_share,
        "lowered": under is not None and under.lowered,
        "ran_away": stored.ran_away,
    }
