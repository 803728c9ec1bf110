"""Logs recorded under an exported law, judged: is it this law, and does the machine do what was certified."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import field, fields, replace
from functools import partial
from typing import Annotated, Any, Literal, TypeVar

import numpy as np

from seaopt.codec import Constraints, Key, check_agrees, from_content, list_keys, read_fields, to_content
from seaopt.control import Controller, ForceMPC, ScheduledController, draw, runnable
from seaopt.control.deploy.target import hash_law
from seaopt.control.laws.delay import find_drive
from seaopt.control.loops.sampled_plant import conditions
from seaopt.control.scheduling.scheduled_controller import place_variable
from seaopt.errors import FileError, LogError, require_number, require_type
from seaopt.estimation import Fit
from seaopt.formatting import join_words
from seaopt.logs import Log
from seaopt.machine.causes import Cause
from seaopt.machine.decimated import shift_command
from seaopt.machine.differences.certified import EXPLAINED, Differences, compare
from seaopt.machine.differences.rate_of_commands import find_rate
from seaopt.machine.differences.size_fit import Difference
from seaopt.machine.replay import Replay, replay, replay_stretches
from seaopt.machine.response.enclosed import enclose_outer, enclose_ticks
from seaopt.machine.response.periods import Blocks, Played, cut_periods, join_blocks
from seaopt.machine.response.reported import Reported, read_status
from seaopt.machine.response.tripped import Trip, find_refused, find_trip
from seaopt.machine.response.verdicts import Motion, Response, judge_response
from seaopt.machine.stepped import SAME_PLACE, Others, Source, stand, stands_still
from seaopt.machine.ticks import FEWEST, Gaps, Ticks, find_reference, take_ticks
from seaopt.machine.wording import say_position_stays
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import Result, Worded, record
from seaopt.robustness import check_ranges
from seaopt.units import unit_after

DRAWS, SEED = 200, 1
OUTER_LOOP = (
    "an outer loop was closed around the law, so that the link and what touches it are in the response; give the plant "
    "of the link (link), or leave the outer loop out, with the link as in the design plant"
)
WITH_OTHERS = "an outer loop was closed around the law, and not in other logs; judge logs with it by themselves"
OTHER_LAW = "the logs are not of this law; mend that first, then record again"
TRIPPED = "the gate tripped before the reference had repeated often enough; record all of it again"
UNTOLD_LAW = "the logs do not tell whether they are of this law; record what would tell, as is said of each"
ACCEPTANCE_SCHEMA = "seaopt/acceptance/1"
FILE, ACCEPT_AGAIN = "acceptance.json", "judge its logs again"
FULL = "full"  # how the stages of a bring-up are named that are of the full law
StageName = Annotated[str, Constraints(pattern=r"^\w+$")]  # that of its folder
T = TypeVar("T")


@record
class LoggedReplay(Replay):
    """The replay of a log, as acceptance.json has it."""

    log: str
    gaps: Gaps | None
    status: Reported | None


@record
class Replays:
    """The replays of all logs."""

    met: bool
    logs: tuple[LoggedReplay, ...]


@record
class Place:
    """Where a schedule's variable stood."""

    over: str
    value: float
    unit: str


@record
class Origin:
    """Whose logs an acceptance.json is of."""

    law: str
    stage: StageName | None
    place: Place | None


@record(eq=False, repr=False)
class Acceptance(Result, Worded):
    """What logs under a law say of it.

    Parameters
    ----------
    controller : Controller
        The law that is to have run: of a schedule where its variable stood, of predictive control while no limit is
        active.
    sources : tuple of str
        The logs.
    replays : tuple of Replay
        Of each log, how near the law comes to the logged command, and what else would come nearer.
    response : Response or None
        The measured loop, and which of its limits the logs confirm or refute; None where it cannot be judged.
    differences : Differences or None
        The measured plant beside the certified one.
    left_out : mapping of str to str
        Why there is no response, or none of a log.
    place : (str, float, str) or None
        Of a schedule its variable, where that stood, and its unit.
    gaps : tuple of Gaps or None
        Of each log, what it lacks.
    reported : tuple of Reported or None
        Of each log, what its own channel `status` says of the law.
    stepped : Difference or None
        The rate at which the law is stepped, where no log has a response and what the machine made of the commands
        tells that it is another than that of the log's clock.
    enclosed : bool
        Whether the response is that of the loop with the law's outer loop in it, on the plant of its link.
    experiments : tuple of (Plant, Log)
        The logs that are of the law, for a fit: what was on the bench, and a row per tick with the command that was in
        force and what was read. Of one in which the outer loop ran that is the plant of its link.
    certificate : {"met", "failed", "missing"} or None
        Of the law; None where nothing is known of one, as in `accept`. Without one that is met the law is not accepted.
    broken : tuple of str
        The requirements that a certificate says are not met.
    stage : str or None
        Of a bring-up, whose law this is; None of the full law. The law of a stage before the last is another one:
        accepting its logs says nothing of the full law.
    fit_met : bool or None
        Whether the fit that the law was tuned with is met; None where nothing is known of one. Without one that is met
        the law is not accepted.
    """

    json_keys = (
        *("met", "certificate"),
        Key(field="broken", name="certificate_failed"),
        Key(field="logs", name="replay"),
        *("response", "enclosed", "differences", "left_out", "stepped"),
        *(Key(field="stood", name="place"), "law", "stage"),
        Key(field="fit_met", name="fit_met", omit_none=True),
    )

    controller: Controller
    sources: tuple[str, ...]
    replays: tuple[Replay, ...]
    response: Response | None = None
    differences: Differences | None = None
    left_out: Mapping[str, str] = field(default_factory=dict[str, str])
    place: tuple[str, float, str] | None = None
    gaps: tuple[Gaps | None, ...] = ()
    reported: tuple[Reported | None, ...] = ()
    stepped: Difference | None = None
    experiments: tuple[tuple[Plant, Log], ...] = ()
    enclosed: bool = False
    certificate: Literal["met", "failed", "missing"] | None = None
    broken: tuple[str, ...] = ()
    stage: StageName | None = None
    fit_met: bool | None = None

    @property
    def of_full(self) -> bool:
        """Whether it is of the full law."""
        return self.stage is None or self.stage.startswith(FULL)

    @property
    def replayed(self) -> bool:
        """Whether every log was made by this law."""
        return all(row.met for row in self.replays)

    @property
    def met(self) -> bool:
        """Whether every log was made by this law, each limit of the loop is confirmed, and the machine is one of those
        that were certified, or, where nothing is known of a certificate, within the uncertainty that was given; no
        link's position may have stayed under a closed outer loop, and the fit is met.
        """
        judged = self.response is not None and self.response.met
        certified = self.certificate in ("met", None) and (self.differences is None or self.differences.inside)
        followed = all(row.position_stays is None for row in self.replays)
        return self.replayed and judged and certified and followed and self.fit_met is not False

    @property
    def logs(self) -> Replays:
        """What acceptance.json has of each log."""
        parts = zip(self.sources, self.replays, self.gaps, self.reported, strict=True)
        names = [each.name for each in fields(Replay)]
        rows = (
            LoggedReplay(log=log, gaps=gaps, status=status, **{name: getattr(row, name) for name in names})
            for log, row, gaps, status in parts
        )
        return Replays(met=self.replayed, logs=tuple(rows))

    @property
    def law(self) -> str:
        """What tells the law from any other."""
        return hash_source(self.controller)

    @property
    def stood(self) -> Place | None:
        """What acceptance.json has of the place."""
        return self.place and Place(over=self.place[0], value=self.place[1], unit=self.place[2])

    def to_dict(self) -> dict[str, Any]:
        """Return the content of acceptance.json (schema seaopt/acceptance/1)."""
        return {"schema": ACCEPTANCE_SCHEMA} | to_content(self)

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], controller: Source) -> Acceptance:
        """Return the acceptance of an acceptance.json, without logs and measured responses; nothing is replayed.
        `controller`: as of `accept`. Raises FileError: a field is missing or malformed, or contradicts another.
        """
        missing = [key.name for key in list_keys(cls) if key.name not in content and not key.omit_none]
        if missing:
            raise FileError(f"{FILE}: key {missing[0]} is missing; {ACCEPT_AGAIN}")
        read = read_fields(cls, content, FILE, remedy=ACCEPT_AGAIN)
        (logs,) = _read_part(content, "replay", Replays)
        for place in _read_part(content, "place", Place):
            read["place"] = place.over, place.value, place.unit
        for motion in _read_part(content["response"] or {}, "friction", Motion):
            read["response"] = replace(read["response"], effort=motion.effort, friction=motion.dry)
        result = cls(
            **read,
            controller=stand(controller, None if read.get("place") is None else read["place"][1]),
            sources=tuple(row.log for row in logs.logs),
            replays=logs.logs,
            gaps=tuple(row.gaps for row in logs.logs),
            reported=tuple(row.status for row in logs.logs),
        )
        made = to_content(result)
        (made["response"] or {}).pop("measured", None)
        if isinstance(controller, ForceMPC):  # that is designed again, to what figures are known to on another machine
            del made["law"]
        check_agrees(content, made, FILE, remedy=ACCEPT_AGAIN)
        return result


def read_origin(content: Mapping[str, Any]) -> Origin:
    """Return whose logs an acceptance.json is of. Raises FileError: that is missing or malformed."""
    return from_content(Origin, content, FILE, remedy=ACCEPT_AGAIN)


def _read_part(content: Mapping[str, Any], key: str, cls: type[T]) -> tuple[T, ...]:
    """Return a part of acceptance.json; none where it is null."""
    part = content.get(key)
    return () if part is None else (from_content(cls, part, f"{FILE}: {key}", remedy=ACCEPT_AGAIN),)


def accept(
    controller: Source,
    logs: Sequence[Log],
    *,
    reference: str | None = None,
    at: float | None = None,
    others: Others | None = None,
    uncertainty: Fit | ParameterSet | None = None,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    confidence: float = 0.95,
    played: Played | None = None,
    link: tuple[Plant, ParameterSet] | None = None,
) -> Acceptance:
    """Judge logs that were recorded under a controller's exported law (`Acceptance`).

    Parameters
    ----------
    controller : Controller, ScheduledController or ForceMPC
        The law that is to have run.
    logs : sequence of Log
        Each with a row per tick of the law: its reference, what it read (`controller.signals`), and what it
        commanded, under the names of the plant's outputs and of the commanded input; of a schedule its variable.
    reference : str, optional
        The reference's channel; "reference" or "ref" if left out.
    at : float, optional
        Where a schedule's variable stood, of logs that do not have it.
    others : mapping of name to Controller, ScheduledController or ForceMPC, optional
        Laws that may have run in its place, such as those of earlier tunings.
    uncertainty : Fit or ParameterSet, optional
        What a machine may be, with `ranges`, such as the controller was certified for: draws of it say how far one may
        be from the model.
    ranges : mapping of str to (low, high), optional
        As in `certify`, of what the design plant has.
    confidence : float
        Of each statement on the response.
    played : Played, optional
        How long the reference is that was to be played: a log that is shorter than its period is told so.
    link : (Plant, ParameterSet), optional
        The plant whose link the law's outer loop moves, with its values, for logs in which it ran.

    Raises
    ------
    LogError
        A channel is missing, or a log is too short.
    ControlError
        A range is empty, or names nothing that the design plant has.

    Notes
    -----
    A log that has every n-th tick is compared line by line, which takes a periodic reference whose lines lie below half
    of the log's rate, and whose period is a whole number of rows. It is of this law where it excludes those with a gain
    of half its size, with a reference, reading or command that is halved, or with a tick more delay; else undecided.
    Laws with another part that it does not exclude are its replay's `possible`.

    A law with an outer loop is replayed with it where the reference is the link's place, in m or rad, and the link's
    position is in the log; with `link` the response is that of the whole loop, broken at the command, on this plant, as
    certified: nothing is asked of its bandwidth. A reference in N or N m is the one that the force law was given, or,
    without a stiffness, the force that the outer loop's damping is added to: whichever the law makes the command of.
    Of logs with and without the outer loop the response is of those without.

    Law and log go by ticks, and so does the clock of a log that has none of its own: a law that is stepped at another
    rate makes the logged command all the same. The machine goes by seconds, and its response tells the rate; then all
    of the response is stated in the machine's seconds. Where the command is at its limit in every period, what the
    machine made of it tells the rate (`stepped`).

    A schedule is replayed as its variable moves; its response is judged where that stands still, against the figures
    that the law has there. Predictive control is replayed with its limits; its response is that of the law while none
    is active.

    The response is judged on logs whose reference is periodic, of three periods at least, the first of which is left
    out; with dry friction six sets of random phases are needed. Limits are those of the controller's specification with
    5 % of grace; of the bandwidth with 10 %.

    Examples
    --------
    >>> import numpy as np
    >>> import seaopt as so
    >>> spec = so.ControllerSpec(bandwidth_hz=30, current_limit_A=9.0)
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> controller = so.tune(stand, thor, spec)
    >>> reference = 40.0 * np.sign(np.sin(20.0 * np.arange(1000) * 1e-3))
    >>> force, effort = controller.close(stand, thor).simulate(reference)
    >>> log = so.Log.from_arrays(
    ...     time=1e-3 * np.arange(1000), reference=reference, F1=force, I=controller.per_effort * effort
    ... )
    >>> so.accept(controller, [log]).replays[0].met
    True
    """
    kinds = (Controller, ScheduledController, ForceMPC)
    require_type(controller, kinds, "controller", "give what tune, assess or force_mpc returned", LogError)
    require_type(logs, Sequence, "logs", "give a list of logs", LogError)
    if not logs:
        raise LogError("logs is empty; give the logs that were recorded under the law")
    for log in logs:
        require_type(log, Log, "logs", "give logs of read_log or Log.from_arrays", LogError)
    if not 0.5 <= require_number(confidence, "confidence", LogError) < 1.0:
        raise LogError(f"confidence = {confidence:g} is not between 0.5 and 1; give 0.95")
    if ranges and controller.design is not None:
        plants = {"design plant": controller.design[0]} | ({} if link is None else {"link": link[0]})
        check_ranges(ranges, plants)
    rows, replays, law = list[Ticks](), list[Replay](), stand(controller, at)
    for log, ticks in zip(logs, list_ticks(controller, logs, reference, at), strict=True):
        tried, outer = [(ticks, replay(controller, ticks, others))], law.outer
        given = find_reference(log, reference)
        unclear = outer is not None and outer.stiffness and given is not None and given.unit in ("", "-")
        may_be_outer = outer is not None and outer.position in log.signals and (unclear or not outer.stiffness)
        if not tried[0][1].met and may_be_outer:
            with suppress(LogError):  # the position has gaps
                (before,) = list_ticks(controller, [log], reference, at, before=True)
                tried.append((before, replay(controller, before, others)))
        chosen, row = max(tried, key=lambda pair: (pair[1].met, pair[1].explained, pair[1].undecided))
        unit_missing = bool(unclear) and not row.met and not row.explained
        row = replace(row, unit_missing=unit_missing, begins=chosen.begins, position_stays=chosen.position_stays)
        split = chosen.gaps is not None and chosen.rendered is None and row.ticks_per_row == 1
        if split and (row.met or not np.any(chosen.command)):
            (whole,) = list_ticks(controller, [log], reference, at, whole=True)
            row = replay_stretches(controller, row, chosen, whole, others or {})
        row = _check_header(controller, log, _check_column(law, log, row, reference), others or {})
        if row.met and row.ticks_per_row == 1:
            row = replace(row, trip=find_trip(stand(controller, chosen.middle), chosen))
        rows.append(chosen)
        replays.append(row)
    law = stand(controller, rows[0].middle)
    place = None
    if isinstance(controller, ScheduledController) and rows[0].middle is not None:
        place = controller.over, rows[0].middle, controller.unit
    sources = tuple(log.source for log in logs)
    experiments = tuple(
        (plant, replace(make_experiment(law, plant, ticks, row.command_late), law=hash_source(controller)))
        for ticks, row in zip(map(_end_at_trip, rows, (row.trip for row in replays)), replays, strict=True)
        if row.met
        and row.position_stays is None
        and _has_commands(ticks, row)
        and (plant := _find_plant(law, ticks, link)) is not None
    )
    result = Acceptance(
        controller=law,
        sources=sources,
        replays=tuple(replays),
        reported=tuple(read_status(log, row) for log, row in zip(logs, replays, strict=True)),
        place=place,
        gaps=tuple(ticks.gaps for ticks in rows),
        experiments=experiments,
    )
    if not result.replayed:
        told = any(not row.met and not row.undecided for row in replays)
        return replace(result, left_out={"response": OTHER_LAW if told else UNTOLD_LAW})
    rows = [
        _take_whole(controller, log, ticks, row, reference, at) if row.ticks_per_row == 1 else ticks
        for log, ticks, row in zip(logs, rows, replays, strict=True)
    ]
    rows = [_end_at_trip(ticks, find_trip(law, ticks)) for ticks in rows]
    blocks, left_out = list[Blocks](), dict[str, str]()
    around = all(ticks.rendered is not None for ticks in rows)
    apart = law if around and link is not None else None  # the force law, where `law` has the outer loop in it
    if apart is not None and link is not None:
        law = enclose_outer(apart, link if place is None else (link[0], place_variable(*link, place[0], place[1])))
        rows, result = [enclose_ticks(law, ticks) for ticks in rows], replace(result, enclosed=True)
    judge = partial(judge_response, tracks=apart is None)
    planned = played if apart is None or played is None else played.outer
    for ticks, row in zip(rows, replays, strict=True):
        try:
            if row.position_stays is not None:
                raise LogError(say_position_stays(result.controller, row.position_stays))
            if ticks.rendered is not None:
                raise LogError(OUTER_LOOP if around else WITH_OTHERS)
            if len(ticks) < FEWEST:
                raise LogError(TRIPPED)
            refused = find_refused(law, ticks) if row.ticks_per_row == 1 else None
            cut = cut_periods(law, ticks if place is None else require_still(controller, ticks), refused, planned)
            blocks.append(shift_command(law, cut, row.command_late) if row.ticks_per_row > 1 else cut)
        except LogError as error:
            left_out[ticks.source] = str(error) if row.trip is None else TRIPPED
    if not blocks:
        pairs = zip(rows, replays, strict=True)
        told = [find_rate(law, ticks) for ticks, row in pairs if ticks.rendered is None and _has_commands(ticks, row)]
        stepped = next((each for each in told if each is not None), None)
        kept = () if stepped is not None else result.experiments  # whose clock is wrong
        return replace(result, left_out=left_out, stepped=stepped, experiments=kept)
    response = judge(law, join_blocks(blocks), confidence)
    whole = [ticks for ticks in rows if ticks.source not in left_out]
    draws = list_draws(law, uncertainty, ranges, DRAWS, SEED)
    differences = compare(law, response.measured, whole, draws, confidence, apart)
    if differences is not None and differences.prediction is not None:
        response = judge(law, join_blocks(blocks), confidence, prediction=differences.prediction)
    first = differences.found[0] if differences is not None and differences.found else None
    if first is not None and first.kind == "rate" and first.size and first.explains >= EXPLAINED:
        # The figures are of the machine's seconds, and the log is none for a fit.
        response = judge(law, join_blocks(blocks), confidence, first.size)
        result = replace(result, experiments=())
    return replace(result, response=response, differences=differences, left_out=left_out)


def _take_whole(source: Source, log: Log, ticks: Ticks, row: Replay, reference: str | None, at: float | None) -> Ticks:
    """Return all ticks of a log whose longest stretch is of the law, each with the command that was made in it."""
    if ticks.gaps is not None and ticks.rendered is None:
        (ticks,) = list_ticks(source, [log], reference, at, whole=True)
    return ticks.move_command(row.command_late) if row.command_late else ticks


def _has_commands(ticks: Ticks, row: Replay) -> bool:
    """Tell whether a log has each command, and what the machine made of it."""
    return row.ticks_per_row == 1 and len(ticks) >= FEWEST


def _find_plant(law: Controller, ticks: Ticks, link: tuple[Plant, ParameterSet] | None) -> Plant | None:
    """Return the plant that a log is of: where the outer loop ran, that of its link. None where that is not known."""
    found = (law.design or law.measured_on) if ticks.rendered is None else link
    return None if found is None else found[0]


def _end_at_trip(ticks: Ticks, trip: Trip | None) -> Ticks:
    """Return the ticks before the readings of which the law's gate made a fault."""
    return ticks if trip is None else ticks.take(slice(0, trip.row))


def _check_column(law: Controller, log: Log, row: Replay, reference: str | None) -> Replay:
    """Return a replay with the signal whose column was read as the reference, too, where it is not met."""
    given = find_reference(log, reference)
    if row.met or given is None or not given.origin.column:
        return row
    source = given.origin.file, given.origin.column
    names = [name for name in (law.command.input, *law.signals) if name in log.signals and name != given.name]
    for name in names:
        origin = log.signal(name).origin
        if (origin.file, origin.column) == source:
            cause = Cause(kind="column", what=name, value=None, unit="", removes=1.0, explains=True)
            return replace(row, causes=(cause, *row.causes))
    return row


def _check_header(source: Source, log: Log, row: Replay, others: Others) -> Replay:
    """Return a replay with the law that the log says it was taken under, where that is another and the replay does not
    tell why.
    """
    if row.explained or isinstance(source, ForceMPC) or log.law in ("", hash_source(source)):
        return row
    named = [name for name, other in others.items() if hash_source(other) == log.law]
    kind, what = ("another law", named[0]) if named else ("law by the log's header", f"another, {log.law}")
    cause = Cause(kind=kind, what=what, value=None, unit="", removes=1.0, explains=True)
    return replace(row, met=False, causes=(cause, *row.causes))


def hash_source(source: Source) -> str:
    """Return what tells a law from any other, as the log of the target has it; of predictive control its linear law."""
    if isinstance(source, ScheduledController):
        return hash_law(source.runnable(), source.outer)
    source = stand(source, None)
    return hash_law(runnable(source), source.outer)


def list_ticks(
    source: Source,
    logs: Sequence[Log],
    reference: str | None,
    at: float | None,
    *,
    before: bool = False,
    whole: bool = False,
) -> list[Ticks]:
    """Return the ticks of logs. Raises LogError: those of a schedule stand at different values, or at none of it."""
    if at is not None:
        require_number(at, "at", LogError)
        if source.over is None:
            raise LogError(f"at = {at:g}: the law is not scheduled; leave it out")
    law = stand(source, at)
    rows = [take_ticks(law, log, reference, source.over, at, before=before, whole=whole) for log in logs]
    if not isinstance(source, ScheduledController):
        return rows
    low, high = source.points[0], source.points[-1]
    middles = [ticks.middle or 0.0 for ticks in rows] + ([] if at is None else [at])
    near = SAME_PLACE * (high - low)
    for middle in middles:
        if not low - near <= middle <= high + near:
            raise LogError(
                f"{source.over} is {middle:g}, and the schedule is from {low:g} to {high:g}{unit_after(source.unit)}; "
                "check the column and its unit, or give --at VALUE"
            )
    if max(middles) - min(middles) > near:
        values = join_words([f"{value:.4g}" for value in sorted(set(middles))])
        raise LogError(f"the logs have {source.over} at {values}; accept those of each value by themselves")
    return rows


def require_still(source: Source, ticks: Ticks) -> Ticks:
    """Return the ticks of a schedule whose variable stands still. Raises LogError: it moves."""
    assert isinstance(source, ScheduledController) and ticks.place is not None
    if not stands_still(ticks.place, source.points):
        low, high = np.nanmin(ticks.place), np.nanmax(ticks.place)
        raise LogError(
            f"{ticks.source}: {source.over} moves from {low:.4g} to {high:.4g}{unit_after(source.unit)}, and the "
            "response is judged where it stands; hold it at a value"
        )
    return ticks


def make_experiment(controller: Controller, plant: Plant, ticks: Ticks, late: int) -> Log:
    """Return a log of a plant whose rows have the command that is in force there. `late`: rows by which it is logged
    late.
    """
    moved, command = ticks.move_command(late - controller.spec.loop_delay_samples), controller.command
    names = (*controller.signals, *controller.further)
    columns = dict(zip(names, np.column_stack([moved.measured, moved.further]).T, strict=True))
    columns |= {name: part for name, part in moved.beside.items() if name in plant.outputs}
    if controller.outer is not None and moved.given is not None:
        columns[controller.outer.position] = moved.given[:, 1]
    outputs = controller.see(plant).outputs
    units = {name: outputs.get(name, "") for name in columns} | {command.input: command.unit}
    return Log.from_arrays(
        time=np.arange(len(moved)) / ticks.rate_hz,
        units={name: unit or "-" for name, unit in units.items()},
        source=ticks.source,
        **columns,
        **{command.input: moved.command},
    )


def list_draws(
    controller: Controller,
    uncertainty: Fit | ParameterSet | None,
    ranges: Mapping[str, tuple[float, float]] | None,
    count: int,
    seed: int,
) -> list[dict[str, float]]:
    """Return draws of what the controller was certified for; none where nothing is uncertain."""
    if uncertainty is None or controller.design is None:
        return []
    inside = take_ranges(controller, ranges or {})
    if not inside and isinstance(uncertainty, ParameterSet) and all(p.prior_std is None for p in uncertainty.values()):
        return []
    return draw(uncertainty, count, seed, inside, find_drive(controller.spec, controller.design[0], uncertainty))


def take_ranges(
    controller: Controller,
    ranges: Mapping[str, tuple[float, float]],
    link: tuple[Plant, ParameterSet] | None = None,
) -> dict[str, tuple[float, float]]:
    """Return the ranges of what the design plant has, or that of a moving link, of those of all plants whose values a
    set may hold.
    """
    names = set[str]()
    for plant, values in (pair for pair in (controller.design, link) if pair is not None):
        names |= {*plant.parameters, *(conditions((plant,)).keys() & values.keys())}
    return {name: ends for name, ends in ranges.items() if name in names}
