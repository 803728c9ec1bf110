"""The verdict on an acceptance: what is met, and why not."""

from __future__ import annotations

from functools import partial

from seaopt.formatting import format_count, format_number, join_words
from seaopt.machine.acceptance import Acceptance
from seaopt.machine.causes import Cause
from seaopt.machine.differences.certified import EXPLAINED, Differences
from seaopt.machine.differences.comparison import TOLERATED
from seaopt.machine.replay import Replay
from seaopt.machine.response.verdicts import LEAST_PHASES, LONGEST, Judged, Response
from seaopt.machine.wording import (
    say_cause,
    say_certified_break,
    say_difference,
    say_drift,
    say_missing,
    say_open,
    say_position_stays,
    say_status,
    say_trip,
    say_untold,
)
from seaopt.plants.friction import list_friction_parameters
from seaopt.reporting.sections.data import Commands, Reason, Step, Style, Verdict
from seaopt.reporting.sections.verdict import doubt_design
from seaopt.units import unit_after

OUTCOMES: dict[str, Style] = {"confirmed": "good", "refuted": "bad", "undecided": "warning"}
MISSED = (
    "no cause was found: are these the logs of this problem, and was the C code exported from this controller.json?"
)
PARTLY = "which explains {} of the difference: more than that differs, and its size may be another one beside it"
NO_UNIT = (
    "the column of the reference states no unit: write [{}] in its header if it is x_0, which the outer loop was "
    "given, or [{}] if it is what the law was given, and judge again"
)
SIZED = {"factor", "gain", "place", "shift"}  # kinds of causes with a size that is fitted
UNTOLD = "the log does not tell them apart; log it with more digits"
LARGER = (
    "a larger amplitude, beside which dry friction is less (it is another one than in the model, which more periods do "
    "not change; or fit again with this log, and tune)"
)
LATER = (
    "look for {} ms in the firmware: a tick too many, a filter; if they stay, write under [controller], in place of a "
    "line of that name, and tune again:"
)
ANOTHER = (
    "if the machine is so, put the tables of again/*.toml into the problem file, fit these logs too{}, and tune again:"
)
NO_MODEL = "the machine was compared with no model, since the law was designed on none"
UNCERTIFIED = {
    "missing": "not certified: there is no certificate of this law",
    "failed": "not certified: the certificate of this law FAILED",
}


def judge(result: Acceptance, commands: Commands) -> Verdict | None:
    """Return the verdict on an acceptance."""
    rows = list(zip(result.sources, result.replays, strict=True))
    off = [(source, row) for source, row in rows if not row.met]
    reasons = [Reason(what=_say_mismatch(row, result), where=source) for source, row in off]
    reasons += [Reason(what=say_trip(result.controller, row.trip), where=source) for source, row in rows if row.trip]
    reasons += [
        Reason(what=say_position_stays(result.controller, row.position_stays), where=source)
        for source, row in rows
        if row.position_stays is not None
    ]
    count = format_count(len(result.sources), "log")
    parts = [f"the law makes the logged command in {len(result.sources) - len(off)} of {count}"]
    reported = zip(result.sources, result.reported, result.replays, strict=True)
    reasons += [
        Reason(what=say_status(each, row), where=source) for source, each, row in reported if each and each.contradicts
    ]
    response, differences, undecided = result.response, result.differences, list[Reason]()
    if response is not None:
        limited = [row for row in response.judged if row.limit is not None]
        counts = {outcome: sum(row.outcome == outcome for row in limited) for outcome in OUTCOMES}
        parts.append(f"{counts['confirmed']} of {len(limited)} limits confirmed, {counts['refuted']} refuted")
        if response.still:
            parts.append("dry friction held the motor, so that they are of the stuck machine alone")
        reasons += [Reason(what=_say_refuted(row)) for row in limited if row.outcome == "refuted"]
        if counts["undecided"]:
            undecided = [Reason(what=f"the log does not decide {say_undecided(result, response)}")]
    if response is not None and differences is None:
        parts.append(NO_MODEL)
    if differences is not None and not differences.inside:
        parts.append(say_inside(result, differences))
        first = response is not None and response.rate != 1.0  # by which all figures are other ones
        reasons += list_drifts(result, differences)[:1]
        if differences.found or differences.untold or not (differences.read_wrongly and differences.each_line):
            said = say_untold(differences.untold) if differences.untold else _say_best(differences)
            reasons.insert(0 if first else len(reasons), Reason(what=said))
    reasons += undecided  # what differs may be why
    if result.stepped is not None:
        reasons.append(Reason(what=say_difference(result.stepped)))
    if result.certificate in UNCERTIFIED:
        parts.append("the law is not certified")
        reasons.append(Reason(what=UNCERTIFIED[result.certificate], where=", ".join(result.broken)))
    if response is None and result.replayed:
        reasons += [Reason(what=f"no response: {text}") for text in list_left_out(result)]
    steps = _list_remedies(result, commands)
    if result.certificate == "missing" and commands.certify:
        steps.append(Step(text="certify the law:", copied=(commands.certify,)))
    text = f"{name_acceptance(result)}: {'; '.join(parts)}"
    verdict = Verdict(met=result.met, text=text, reasons=tuple(reasons), next=tuple(steps))
    return doubt_design(verdict, commands.fit) if result.fit_met is False else verdict


def _list_remedies(result: Acceptance, commands: Commands) -> list[Step]:
    """Return what to do about the difference that explains best, where a remedy is known; it is one of two things: of
    the firmware, or of the machine, which the law is then tuned for.
    """
    differences = result.differences
    if not commands.tune or differences is None or differences.inside or differences.untold:
        return []
    steps = list[Step]()
    for each in differences.found[:1]:
        spec = result.controller.spec
        if each.kind == "delay" and each.value > 0.0 and spec.delay_samples is None:
            late = result.controller.drive_delay_s + each.value
            lines = (f"drive_delay_s = {format_number(late)}", commands.tune)
            steps.append(Step(text=LATER.format(f"{1e3 * each.value:.3g}"), copied=lines))
        if each.kind in ("parameter", "gain") and each.value > 0.0 and result.experiments:
            free = f", with {each.name} free" if each.kind == "parameter" else ""
            steps.append(Step(text=ANOTHER.format(free), copied=(commands.fit, commands.tune)))
    return steps


def name_acceptance(result: Acceptance) -> str:
    """Return of which law the acceptance is."""
    if result.stage is None:
        return "Acceptance"
    return f"Acceptance of {result.stage}" + ("" if result.of_full else ", not of the full law")


def list_left_out(result: Acceptance) -> list[str]:
    """Return why there is no response of some logs, but for those of which the verdict says more."""
    pairs = zip(result.sources, result.replays, strict=True)
    stay = {source for source, row in pairs if row.position_stays is not None}
    return [text for source, text in result.left_out.items() if source not in stay]


def name_machines(result: Acceptance) -> str:
    """Return of which machines the worst is that was predicted under the reference that was played."""
    return "certified machines" if result.certificate == "met" else "machines within the uncertainty that was given"


def say_inside(result: Acceptance, differences: Differences) -> str:
    """Return whether the machine is one of those that were certified, or else of what it was compared with."""
    model = "the plant of the link" if result.enclosed else "the design plant"
    given = "within the uncertainty that was given" if differences.nearest else model
    what = "one of those that were certified" if result.certificate == "met" else given
    if differences.untold:
        return f"it is undecided whether the machine is {what}"
    if differences.inside:
        return f"the machine is {what}, to {100.0 * TOLERATED:.0f} % of its response"
    return f"the machine is not {what}"


def list_drifts(result: Acceptance, differences: Differences) -> list[Reason]:
    """Return the drifts of readings, those that may be the readings' own and the largest first."""
    order = (True, None, False)
    ranked = sorted(differences.drifts, key=lambda each: (order.index(each.of_reading), -abs(each.value)))
    command = result.controller.command.input
    return [Reason(what=say_drift(each, command), where=each.log) for each in ranked]


def _say_best(differences: Differences) -> str:
    """Return what explains best that the machine is another one, those that the log does not tell apart, and whether
    more than that is there.
    """
    if not differences.found:
        return "its response is another one"
    best, *others = differences.found
    said = "; or ".join(map(say_difference, (best, *(each for each in others if each.untold))))
    return said if best.explains >= EXPLAINED else f"{said}, {PARTLY.format(f'{100.0 * best.explains:.0f} %')}"


def name_figure(row: Judged) -> str:
    """Return the name of a figure, with the state of the machine that its limit is of."""
    return f"{row.name}, {row.state}" if row.state else row.name


def _say_refuted(row: Judged) -> str:
    if row.name == "stability":
        return "stability is refuted"
    limit = f"{name_figure(row)} {row.sense} {format_number(row.limit)}{unit_after(row.unit)} is refuted"
    return f"{limit}: {format_number(row.value, 3)} ({show_interval(row)}){_say_where(row)}"


def say_undecided(result: Acceptance, response: Response) -> str:
    """Return of which limits a log does not say enough, and what to record so that it does."""
    rows = [row for row in response.judged if row.limit is not None and row.outcome == "undecided"]
    broken = [
        say_certified_break(name_figure(row), row, name_machines(result)) for row in rows if row.certified is not None
    ]
    rows = [row for row in rows if row.certified is None]
    if broken and not rows:
        return "; ".join(broken)
    if response.rate != 1.0:  # of these lines no more is needed: they are others once the timer is right
        return f"{join_words([name_figure(row) for row in rows])}: record again once the law is stepped at its rate"
    # a loop that is mended is another one, which other periods decide
    refuted = any(row.limit is not None and row.outcome == "refuted" for row in response.judged)
    near = [] if refuted else [_say_near(row) for row in rows if row.near is not None]
    rows = rows if refuted else [row for row in rows if row.near is None]
    tripped = any(row.trip is not None for row in result.replays)
    record: list[str] = ["all of the reference again, without a trip of the gate"] if tripped else []
    if response.needs_phases and not tripped:
        below = (
            " and with the command below its limit" if any(part.left_out.limit for part in response.measured) else ""
        )
        record.append(f"{LEAST_PHASES} sets of random phases{below}, which dry friction asks for")
    if response.needs_lines is not None:
        record.append(say_missing(response.needs_lines, response.missing))
    if clipped := _is_clipped(result):
        record.append("again with the readings within the range of their sensor")
    periods = 0 if tripped or refuted or clipped else max((row.periods or 0 for row in rows), default=0)
    if rows and not tripped and _rubs(result):
        record.append(LARGER)
    elif periods:
        record.append(f"{periods} periods in all ({format_number(periods * response.period_s, 3)} s)")
    wanted = join_words(record) or ("again" if refuted else "more periods, or a larger reference")
    first = "mend what is refuted first, then " if refuted else ""
    others = [f"{join_words([say_open(name_figure(row), row.doubt) for row in rows])}: {first}record {wanted}"]
    others = others if rows else []
    return "; ".join([*others, *near, *broken])


def _is_clipped(result: Acceptance) -> bool:
    """Tell whether a sensor is at its range, so that the response has that in it, whatever the periods."""
    return result.differences is not None and any(each.kind == "range" for each in result.differences.found)


def _rubs(result: Acceptance) -> bool:
    """Tell whether dry friction is named as what differs."""
    found = () if result.differences is None else result.differences.found[:1]
    design = result.controller.design
    if not found or design is None:
        return False
    parts = (found[0], *found[0].beside)
    return bool({name for part in parts for name in (part.name, *part.alike)} & list_friction_parameters(design[0]))


def _say_near(row: Judged) -> str:
    """Return that a figure lies at its limit."""
    unit, value, near = unit_after(row.unit), format_number(row.value, 4), format_number(100.0 * (row.near or 0.0), 2)
    return (
        f"{name_figure(row)}: the estimate, {value}{unit}, is within {near} % of the limit as judged, "
        f"{format_number(row.limit, 4)}{unit}, so that no record of sensible length decides (over ten "
        f"minutes); play a larger reference{_say_where(row)}, or ask for less or tune for more of it"
    )


def _say_where(row: Judged) -> str:
    return "" if row.where_hz is None else f" at {format_number(row.where_hz, 3)} Hz"


def say_needed(result: Acceptance, row: Judged) -> str:
    """Return what would decide a figure, or tell a margin, in a cell: periods, where they can be recorded."""
    assert result.response is not None
    if row.certified is not None:
        return "a larger amplitude"
    if row.periods is None or _is_clipped(result):
        return ""
    if row.periods * result.response.period_s > LONGEST or (row.limit is not None and _rubs(result)):
        return f"a larger amplitude{_say_where(row)}"
    return format_count(row.periods, "period")


def show_interval(row: Judged) -> str:
    """Return the interval of a figure."""
    if not row.told:
        return "not told"
    return f"{format_number(row.low, 3, 'none')} to {format_number(row.high, 3, 'none')}"


def _say_mismatch(row: Replay, result: Acceptance) -> str:
    said, outer = _say_off(row, result), result.controller.outer
    if not row.unit_missing or outer is None:
        return said
    return f"{NO_UNIT.format(outer.place_unit, result.controller.command.reference_unit)}; {said}"


def _is_untold(first: Cause, other: Cause) -> bool:
    """Tell whether a cause may be in place of the first: both leave nothing but rounding, each with a size of another
    signal that is fitted.
    """
    return other.explains and not other.besides and {first.kind, other.kind} <= SIZED and other.what != first.what


def _say_off(row: Replay, result: Acceptance) -> str:
    unit = unit_after(result.controller.command.unit)
    say = partial(say_cause, command=result.controller.command.input)
    if row.undecided:
        return say(row.causes[0])
    if row.explained:
        first, *others = row.causes
        untold = [say(first), *(say(other) for other in others if _is_untold(first, other))]
        return say(first) if len(untold) == 1 else f"{'; or '.join(untold)}: {UNTOLD}"
    off = f"the command is off by {format_number(row.mismatch, 3)}{unit} (rms), of {format_number(row.rms, 3)}{unit}"
    if row.ticks_per_row > 1:
        off = f"{off}, or lines of the reference lie above half of the log's rate"
    if not row.causes:
        return f"{off}; {MISSED}"
    first, *others = row.causes
    if others and others[0].besides and others[0].explains:
        return f"{say(first)}, and {say(others[0])}"
    return f"{off}; nearest: {say(first)} ({100.0 * first.removes:.0f} % of it)"
