"""An acceptance in words: sections for print, terminal and notebook, and the page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from seaopt.control import Controller
from seaopt.formatting import format_count, format_number, format_percent, join_words
from seaopt.machine.acceptance import Acceptance
from seaopt.machine.differences.certified import Differences
from seaopt.machine.differences.comparison import TOLERATED
from seaopt.machine.differences.size_fit import Difference
from seaopt.machine.page.figures import list_panels
from seaopt.machine.page.verdict import (
    OUTCOMES,
    judge,
    list_drifts,
    list_left_out,
    name_figure,
    name_machines,
    say_inside,
    say_needed,
    say_undecided,
    show_interval,
)
from seaopt.machine.reference_offset import Offset
from seaopt.machine.replay import Replay
from seaopt.machine.response.measured_margins import MARGINS
from seaopt.machine.response.periods import say_left_out
from seaopt.machine.response.reported import Reported
from seaopt.machine.response.verdicts import LONGEST, SHORT_BY, Judged, Measured, Response, compares_amplitudes
from seaopt.machine.ticks import AT_LIMIT, Gaps
from seaopt.machine.wording import say_bias, say_cause, say_difference, say_status, say_trip, say_unsure, say_untold
from seaopt.reporting.page.chart import make_chart
from seaopt.reporting.page.provenance import describe_provenance
from seaopt.reporting.page.render import write_result_page
from seaopt.reporting.sections.data import Commands, Item, KeyFigure, Mark, Section, Table, mark_met
from seaopt.reporting.sections.kinds.controller import explain_sliding, say_bandwidths, show_stuck_bandwidth
from seaopt.units import unit_after

NEEDED = "would decide"  # heads a column
PARTS = {
    "replay": "Is it this law",
    "causes": "Why the command differs",
    "response": "Does the loop keep its limits",
    "differences": "What differs from the model",
    "provenance": "Provenance",
}
MOST_CAUSES = 5
LITTLE = 0.5  # of it, below which the limit of a stuck machine says little
NO_GAINS = (
    "The law has no gains with names (it is one's own, or predictive control): a part that is left out, or a gain "
    "that is another, is not looked for in such a log; log every tick, where all of it counts."
)
ENCLOSED = (
    "The loop is the whole one, with the outer loop in it, on the plant of its link, broken at the command: that is "
    "what was certified there. Of how it tracks a force nothing is asked."
)
NO_MARGIN = (
    "The log does not tell the {}: its interval would be 1.5 times as wide as the margin itself, or wider. {} would "
    "tell it; lines that lie closer about it help, too."
)
ONE_BY_ONE = "Each line by itself is within reach of some such machine, but none of them explains all lines together."
RATE = (
    "These figures are in the machine's seconds: the law is stepped at {} times the rate that the log's clock says, "
    "and all that is read off that clock is wrong."
)
STILL = (
    "In these logs dry friction holds the motor: the effort swings by {} at most, and friction takes {}. The figures "
    "are of the stuck machine. They tell that the law runs, with the signs and units that it was exported for, and "
    "that the loop is quiet while stuck; of the machine as it moves they tell nothing. Play a larger reference."
)
STUCK = (
    "The bandwidth that is judged is that of the machine that is stuck, which any amplitude has: it is not the {} that "
    "was asked of the machine as it slides. At the amplitude of the log it is {}."
)
SLIDES = "Predicted is the actuator as it slides, but for a figure stuck; its bandwidth is {}."
PLAYED = (
    "Predicted is the model under the reference of the log, simulated: with dry friction it is another one at another "
    "amplitude; its bandwidth is {}."
)
AS_PLAYED = (
    "The bandwidth that is judged is the least that {} have under this reference, {}: it is not the {} that was asked "
    "of the machine as it slides. Here it is {}."
)
AS_ASKED = "The bandwidth that is judged is what was asked, {}: {} have no less under this reference. Here it is {}."
REACHES = ", which is what was asked"
ALLOWED = ", which is less than was asked and no less than the {} that are allowed, with {} of grace"
FASTER = ", {} times what was asked: nothing bounds it above, so look at Ms and Mt"
WORTH = (
    " The limit of {} is {} of what was asked: it tells a loop that runs from one that does not, and says little of "
    "its speed."
)
ONE_AMPLITUDE = (
    "With dry friction this holds at the amplitude of the log only: play one of twice or half of it as well, with the "
    "same lines."
)
EACH_AMPLITUDE = "With dry friction this holds at these amplitudes only: the gain is another one at each."
SHORT = "; a larger reference comes nearer to what was asked"
STABILITY = (
    "Stability is the least |1 + L| over the radius of its disc (no unit): above 1 no disc holds zero, where the loop "
    "would be at its limit of stability."
)
SLIGHT = (
    f"The rows are within the {100.0 * TOLERATED:.0f} % of the response by which a machine may be off every certified "
    "one. Elsewhere they may make more: dry friction at a smaller amplitude."
)
ONE_ALONE = "Each row is by itself, in place of the others: shares do not add up."
NOT_TOLD = "Rows whose shares are alike are not told apart by the log."
TWO_AMPLITUDES = (
    "A limit of the drive and a smaller gain are told apart by a log at half the amplitude: a gain stays as it is."
)
IN_PART = "No row explains all of it to the noise."
TWO_AT_MOST = (
    "An interval holds where no more than two of the model's values and its delay are others, named or hidden by "
    "noise: beside more of them, or what the model lacks, the true size may be outside."
)
NOTHING_ELSE = (
    "The intervals of a mode, a rate or a limit of the drive, and of what is named beside one, hold where nothing else "
    "differs: beside a difference that noise hides, or that they take up, the true size may be outside."
)
UNLESS = "The interval of {} holds unless one of these is off, too, which does what it does: {}."
BEGINS = (
    "Of {} the first {} are left out: in them the filter of the outer loop's velocity forgets what was before the log, "
    "which the log does not have."
)
HIDDEN = (
    "In {} no tick is off by more than rounding allows, but all of them together are: what that cause makes stands out "
    "of the rounding of the whole log by {} std."
)
AND = "with the first one also: "
OF_A_STAGE = (
    "The logs are of {} of the bring-up, whose law is another one: they say nothing of the full law, which is accepted "
    "by logs of its own."
)


def _say_stuck(row: Judged, controller: Controller) -> str:
    """Return of which bandwidth the row is, and which one was asked."""
    asked = controller.spec.bandwidth_hz
    sizes = [f"{format_number(each, 3)} Hz" for each in (asked, row.limit)]
    said = STUCK.format(sizes[0], _say_reached(row, asked))
    little = row.limit is not None and row.limit < LITTLE * asked
    return said + (WORTH.format(sizes[1], f"{100.0 * (row.limit or 0.0) / asked:.0f} %") if little else "")


def _say_as_played(row: Judged, result: Acceptance) -> str:
    """Return of which bandwidth the row is, and which one was asked."""
    asked = result.controller.spec.bandwidth_hz
    least = (row.limit or 0.0) / (1.0 - SHORT_BY)
    machines, reached = name_machines(result), _say_reached(row, asked)
    sizes = [f"{format_number(each, 3)} Hz" for each in (least, asked)]
    if sizes[0] == sizes[1]:
        return AS_ASKED.format(sizes[1], machines, reached)
    return AS_PLAYED.format(machines, *sizes, reached)


def _say_reached(row: Judged, asked: float) -> str:
    """Return a bandwidth with its interval, and whether it is what was asked."""
    value, allowed = row.value or 0.0, (1.0 - SHORT_BY) * asked
    said = f"{format_number(value, 3)} Hz ({show_interval(row)})"
    if value < allowed:
        return said + SHORT
    if value > (1.0 + SHORT_BY) * asked:
        return said + FASTER.format(format_number(value / asked, 2))
    less = row.high is not None and row.high < asked
    return said + (ALLOWED.format(f"{format_number(allowed, 3)} Hz", format_percent(SHORT_BY)) if less else REACHES)


def _say_no_margin(row: Judged, response: Response) -> str:
    """Return that a margin is not told, and what would tell it."""
    larger = f"larger reference near {format_number(row.where_hz, 3)} Hz"
    lasts = math.inf if row.periods is None else row.periods * response.period_s
    if lasts > LONGEST:
        return NO_MARGIN.format(row.name, f"A {larger}")
    return NO_MARGIN.format(row.name, f"{row.periods} periods in all ({format_number(lasts, 3)} s) or a {larger}")


def describe(result: Acceptance) -> list[Section]:
    """Return what was compared, what may be the cause where it differs, and what the response says."""
    sections = _describe_replay(result)
    told = [] if result.of_full else [OF_A_STAGE.format(result.stage)]
    if result.place is not None:
        over, value, unit = result.place
        told.append(f"The schedule is judged where {over} stood: {format_number(value)}{unit_after(unit)}.")
    sections[0] = replace(sections[0], sentences=tuple(told))
    if result.response is not None:
        sections.append(_describe_response(result, result.response))
    if result.differences is not None:
        sections.append(_describe_differences(result, result.differences))
    return sections


def _describe_response(result: Acceptance, response: Response) -> Section:
    rows = tuple(
        (
            name_figure(row),
            "" if row.limit is None else Mark(text=row.outcome, style=OUTCOMES[row.outcome]),
            "" if row.limit is None else f"{row.sense} {format_number(row.limit)}{unit_after(row.unit)}",
            f"{format_number(row.value, 3)}{unit_after(row.unit)}",
            "" if row.name == "stability" else show_interval(row),
            format_number(row.predicted, 3),
            format_number(row.where_hz, 3),
            say_needed(result, row),
        )
        for row in response.judged
    )
    head = ("figure", "verdict", "limit", "measured", "interval", "predicted", "at (Hz)", NEEDED)
    aside = ", ".join(_say_extent(part) for part in response.measured)
    remarks = [
        f"Each statement holds with a probability of {format_percent(response.confidence, 6)}. Limits are those of the "
        "specification with 5 % of grace, of the bandwidth 10 %. "
        "Nothing is said between the lines and beyond them.",
        STABILITY,
    ]
    if result.enclosed:
        remarks.append(ENCLOSED)
    if response.rate != 1.0:
        remarks.append(RATE.format(format_number(response.rate, 3)))
    played = result.differences is not None and result.differences.prediction is not None
    if show_stuck_bandwidth(result.controller) or played:
        both = say_bandwidths(result.controller, result.controller.achieved.bandwidth_hz)
        remarks.append((PLAYED if played else SLIDES).format(both))
    remarks += explain_sliding(result.controller)
    remarks += [_say_stuck(row, result.controller) for row in response.judged if row.state == "stuck"]
    remarks += [_say_as_played(row, result) for row in response.judged if row.state == "as played"]
    remarks += [_say_no_margin(row, response) for row in response.judged if row.name in MARGINS and not row.told]
    remarks += [
        f"{say_unsure(name_figure(row), row.doubt)}."
        for row in response.judged
        if row.doubt is not None and row.doubt.why == "command"
    ]
    if response.still:
        unit = unit_after(result.controller.command.effort_unit)
        sizes = (f"{format_number(value, 3)}{unit}" for value in (response.effort, response.friction))
        remarks.insert(0, STILL.format(*sizes))
    biases = [bias for part in response.measured if (bias := part.find_bias(1.0 - response.confidence)) is not None]
    if biases:
        remarks.append(say_bias(max(biases, key=lambda each: each.largest)))
    if response.at_amplitude_only:
        remarks.append(EACH_AMPLITUDE if compares_amplitudes(response.measured) else ONE_AMPLITUDE)
    if any(row.outcome == "undecided" for row in response.judged if row.limit is not None):
        remarks.append(
            f"Undecided is no doubt about the machine: the log does not decide {say_undecided(result, response)}."
        )
    remarks += [f"Left out: {text}" for text in list_left_out(result)]
    items = tuple(_warn_left_out(part) for part in response.measured if part.left_out.total)
    tables = (Table(head=head, rows=rows, align="<<>>>>>>", optional=(NEEDED,)),)
    return Section(title="Response", part="response", aside=aside, tables=tables, remarks=tuple(remarks), items=items)


def _tell_missing(result: Acceptance) -> list[Section]:
    """Return the section of a response that is not there: why, and what to record. A text says that in its verdict."""
    if result.response is not None:
        return []
    told = [] if result.stepped is None else [say_difference(result.stepped)]
    told += result.left_out.values()
    told += [
        f"{source}: {say_cause(row.causes[0], result.controller.command.input)}"
        for source, row in zip(result.sources, result.replays, strict=True)
        if row.undecided
    ]
    items = tuple(Item(severity="warning", text=text) for text in told)
    return [Section(title="No response", part="response", items=items)]


def _warn_left_out(part: Measured) -> Item:
    """Return how many periods are not used, why, and what to do."""
    total, why = part.left_out.total, "; ".join(say_left_out(part.left_out))
    text = f"{total} of {format_count(part.periods + total, 'period')} left out: {why}"
    return Item(severity="warning", text=text)


def _say_extent(part: Measured) -> str:
    """Return how much was measured."""
    low, high = (format_number(edge, 3) for edge in (part.f[0], part.f[-1]))
    counts = format_count(part.periods, "period"), format_count(part.phases, "set")
    return f"{counts[0]}, {counts[1]} of phases, {part.f.size} lines from {low} to {high} Hz"


def _show_ranges(each: Difference) -> str:
    """Return the interval of a difference, of two that explain it together both."""
    return "; ".join(filter(None, map(_show_range, (each, *each.beside))))


def _show_range(each: Difference) -> str:
    """Return an interval, of a delay in ms as it is said."""
    if each.low is None or each.high is None:
        return ""
    scale, unit = {"delay": (1e3, " ms"), "mode": (1.0, " Hz")}.get(each.kind, (1.0, ""))
    size = ""
    if each.changes_low is not None:
        size = f", {format_number(each.changes_low, 3)} to {format_number(each.changes_high, 3)} times"
    return f"{format_number(scale * each.low, 3)} to {format_number(scale * each.high, 3)}{unit}{size}"


def _describe_differences(result: Acceptance, differences: Differences) -> Section:
    rows = tuple(
        (
            say_difference(each),
            _show_ranges(each),
            format_percent(each.explains),
        )
        for each in differences.found
    )
    inside, off = say_inside(result, differences), format_number(differences.misfit**0.5, 3)
    sentences = [f"{inside[0].upper()}{inside[1:]}: the measured plant is off by {off} times its noise (rms)."]
    if differences.untold:
        untold = say_untold(differences.untold)
        sentences.append(f"{untold[0].upper()}{untold[1:]}.")
    elif differences.each_line and not differences.inside and not differences.read_wrongly:
        sentences.append(ONE_BY_ONE)
    if differences.nearest:
        nearest = ", ".join(f"{name} {format_number(value)}" for name, value in differences.nearest.items())
        whose = "certificate's draws" if result.certificate == "met" else "draws of the uncertainty that was given"
        sentences.append(f"The nearest of the {whose}: {nearest}.")
    tables = (Table(head=("difference", "95 % interval", "explains"), rows=rows, align="<>>"),) if rows else ()
    items = tuple(Item(severity="warning", text=str(reason)) for reason in list_drifts(result, differences))
    return Section(
        title="Measured and model", part="differences", sentences=tuple(sentences), tables=tables,
        remarks=_remark(differences), items=items,
    )  # fmt: skip


def _remark(differences: Differences) -> tuple[str, ...]:
    """Return how rows of the table of differences are to be read."""
    if not differences.found:
        return ()
    remarks = [SLIGHT] if differences.inside else []
    remarks += [ONE_ALONE] if len(differences.found) > 1 else []
    if any(each.untold for each in differences.found):
        remarks.append(NOT_TOLD)
        if any(each.kind == "drive limit" for each in differences.found):
            remarks.append(TWO_AMPLITUDES)
    remarks += [] if differences.explained else [IN_PART]
    return (*remarks, *_remark_on_intervals(differences.found))


def _remark_on_intervals(found: Sequence[Difference]) -> Iterator[str]:
    """Yield beside which other differences intervals hold."""
    told = [each for each in found if each.low is not None]
    if any(each.held_beside_others for each in told):
        yield TWO_AT_MOST
    if not all(each.held_beside_others for each in told):
        yield NOTHING_ELSE
    for part in (part for each in told for part in (each, *each.beside) if part.unless):
        yield UNLESS.format(part.name, ", ".join(map(" with ".join, part.unless)))


def _describe_replay(result: Acceptance) -> list[Section]:
    """Return how near the replay comes, and the causes that were tried."""
    unit = result.controller.command.unit
    rows = tuple(
        (
            Path(source).name,
            Mark(text="undecided", style="warning") if row.undecided else mark_met(row.met),
            str(row.ticks),
            *(format_number(value, 3) for value in (row.mismatch, row.largest, row.allowed, row.rms)),
            format_percent(row.saturated, 2),
            format_number(row.rate_hz),
        )
        for source, row in zip(result.sources, result.replays, strict=True)
    )
    head = ("log", "verdict", "ticks", f"off (rms, {unit})", "at most", "rounding", "command", "at limit", "rate (Hz)")
    late = sorted({row.command_late for row in result.replays if row.met and row.command_late})
    say = partial(say_cause, command=result.controller.command.input)
    remarks = tuple(
        f"The command is logged {abs(by)} row {'late' if by > 0 else 'early'}, which is allowed." for by in late
    )
    rows_of = sorted({row.ticks_per_row for row in result.replays if row.ticks_per_row > 1})
    remarks += tuple(
        f"A log has one row for {each} ticks: it is compared at the lines of the reference." for each in rows_of
    )
    if rows_of and result.controller.read_gains() is None:
        remarks += (NO_GAINS,)
    if result.replayed:
        remarks += (_say_reach(result),)
    for source, gaps, reported, row in zip(result.sources, result.gaps, result.reported, result.replays, strict=True):
        remarks += tuple(_remark_log(result.controller, Path(source).name, gaps, reported, row))
    sections = [
        Section(
            title="Replay",
            part="replay",
            tables=(Table(head=head, rows=rows, align="<<>>>>>>>", optional=("rounding", "rate (Hz)")),),
            remarks=(
                "The law is fed with the logged reference and readings; its command is compared with the log's.",
                *remarks,
            ),
        )
    ]
    for source, row in zip(result.sources, result.replays, strict=True):
        table = tuple(
            (
                AND * cause.besides + say(cause),
                format_percent(cause.removes, 4),
                mark_met(cause.explains, "all", "in part"),
            )
            for cause in row.causes[: 0 if row.undecided else MOST_CAUSES]
        )
        if table:
            table = Table(head=("if", "removes", "explains"), rows=table, align="<><")
            sections.append(
                Section(title=f"Causes that were tried on {Path(source).name}", part="causes", tables=(table,))
            )
    return sections


def _remark_log(
    controller: Controller, name: str, gaps: Gaps | None, reported: Reported | None, row: Replay
) -> Iterator[str]:
    """Yield what is to be known of one log beside how near its replay comes."""
    if gaps:
        yield _say_gaps(name, gaps, row)
    if row.begins > 1:
        yield BEGINS.format(name, format_count(row.begins, "row"))
    if row.trip:
        trip = say_trip(controller, row.trip)
        yield f"In {name} {trip}. What comes after is left out of the response and of the log for a fit."
    if reported is not None and (status := say_status(reported, row)):
        yield f"By {name} {status}."
    if row.met and row.possible:
        possible = ", or that ".join(say_cause(each, controller.command.input) for each in row.possible)
        yield f"{name} does not exclude that {possible}."
    if row.offset is not None:
        yield _say_offset(name, row.offset, unit_after(controller.command.reference_unit))
    if row.causes and row.causes[0].sigmas is not None:
        yield HIDDEN.format(name, format_number(row.causes[0].sigmas, 2))


def _say_offset(name: str, offset: Offset, unit: str) -> str:
    """Return that the reference which a law was given is not the logged one."""
    value, way = f"{format_number(abs(offset.value), 3)}{unit}", ("below", "above")[int(offset.value > 0.0)]
    reading = ", or the reading as much the other way" if offset.or_reading else ""
    return (
        f"In {name} the law was given a reference {value} {way} the logged one{reading}, within half of its step of "
        f"{format_number(offset.step, 3)}{unit}: cut off digits make it, rounded ones do not. Log it with more digits."
    )


def _say_reach(result: Acceptance) -> str:
    """Return up to which command the logs judge the machine."""
    most, mostly = (
        max(values) for values in zip(*((row.command_most, row.command_mostly) for row in result.replays), strict=True)
    )
    unit, limit = unit_after(result.controller.command.unit), result.controller.command_limit
    sizes = [f"{format_number(each, 3)}{unit}" for each in (most, mostly)]
    allowed = "" if limit is None or most >= AT_LIMIT * limit else f", of {format_number(limit, 3)}{unit} allowed"
    return (
        f"The command goes up to {sizes[0]}{allowed}, in 95 % of the ticks to {sizes[1]}: a drive or machine that is "
        "another one only above that is not seen."
    )


def _say_gaps(name: str, gaps: Gaps, row: Replay) -> str:
    """Return what a log lacks, and what to do about it."""
    lacks = [f"no row of {format_count(gaps.ticks, 'tick')}"] if gaps.ticks else []
    lacks += [f"{format_count(gaps.rows, 'row')} with a number missing"] if gaps.rows else []
    places = f"in {format_count(gaps.count, 'place')}, the first after {format_number(gaps.first_s, 6)} s"
    replayed = f"its longest stretch without, of {format_count(gaps.longest, 'tick')}"
    if row.stretches > 1:
        each = "each from a state that its own first rows tell"
        replayed = f"{row.stretches} stretches without, of {format_count(row.ticks, 'tick')} in all, {each}"
    return (
        f"{name} has {join_words(lacks)} by its clock, {places}: the law is replayed on {replayed}, and each period "
        "that misses a row is left out of the response. Log every tick; where none is lost and the stamps alone leap, "
        "leave the time column out of the log and state [acceptance] rate_hz in the problem file."
    )


def summarise(result: Acceptance) -> list[KeyFigure]:
    """Return how near the replay comes."""
    worst = max(result.replays, key=lambda row: row.mismatch or 0.0)
    unit = unit_after(result.controller.command.unit)
    off, size = (f"{format_number(value, 3)}{unit}" for value in (worst.mismatch, worst.rms))
    figures = [KeyFigure(name="command off (rms)", value=off, against=f"of {size}")]
    for row in () if result.response is None else result.response.judged:
        if row.limit is not None and row.name != "stability":
            limit = f"{row.sense} {format_number(row.limit)}{unit_after(row.unit)}, {row.outcome}"
            value = f"{format_number(row.value, 3)}{unit_after(row.unit)}"
            figures.append(KeyFigure(name=name_figure(row), value=value, against=limit))
    return figures


def write_acceptance_page(
    result: Acceptance,
    path: Path | str,
    *,
    title: str = "Acceptance",
    files: Sequence[Path | str] = (),
    logs: Sequence[Path | str] = (),
    command: str = "",
) -> Path:
    """Write an HTML page of an acceptance; it needs no network and no other file. `title`: its heading. `files`: the
    problem file. `logs`: those that were judged. `command`: what was typed to make it, to be stated. Raises FileError:
    the folder cannot be written.
    """
    return write_result_page(
        path,
        title=title,
        parts=PARTS,
        verdict=judge(result, Commands()),
        glance=summarise(result),
        sections=[*describe(result), *_tell_missing(result), describe_provenance((), files, command, logs)],
        plates={
            "response": [{"heading": "", "text": "", "charts": [make_chart(panel) for panel in list_panels(result)]}]
        },
    )
