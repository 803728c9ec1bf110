"""What a cause of another command is, and what differs from what was certified, in words."""

from __future__ import annotations

from collections.abc import Sequence

from seaopt.control import Controller
from seaopt.formatting import format_number, join_words
from seaopt.machine.alternatives import Edited, EditedGain
from seaopt.machine.causes import Cause
from seaopt.machine.differences.certified import Untold
from seaopt.machine.differences.drift import Drift
from seaopt.machine.differences.size_fit import Difference
from seaopt.machine.differences.size_search import find_end
from seaopt.machine.gains.free_gains import SAME_GAINS
from seaopt.machine.replay import Replay
from seaopt.machine.response.judged import Bias, Doubt, Judged
from seaopt.machine.response.reach import CLOSEST, FEWEST_LINES, Band
from seaopt.machine.response.reported import Reported
from seaopt.machine.response.tripped import Trip
from seaopt.machine.response.verdicts import LEAST_PHASES
from seaopt.units import unit_after

EVERY_TICK = "of a log with every n-th tick"
OPEN = {
    "terms": "terms of the law (friction, gravity, ripple) are not linear; log every tick",
    "outer": "the outer loop has no stiffness, so that the link drifts from period to period, and its lines tell "
    "nothing; log every tick",
    "moving": "the schedule's variable moves; hold it at a value, or log every tick",
    "periods": "its reference has to repeat, a whole number of rows each time, three times at least and with the "
    "command below its limit; play such a one, or log every tick",
    "saturated": "the command is at its limit in most rows, where all laws look alike; check signs and units, and "
    "lower the amplitude",
    "phases": "dry friction folds into its lines; play six sets of random phases, or log every tick",
    "aliases": "lines of the reference above half of the log's rate come back as others; play slower ones, or log "
    "every tick",
}
BREAKS = (
    "{}: {} themselves break the limit as judged, {}, under the reference that was played ({} at worst), so that the "
    "log cannot tell whether this one keeps it; record a larger amplitude, beside which dry friction is less"
)
NONE_BELOW = (
    "{}: {} themselves fall below -3 dB at {} under the reference that was played, and none of its lines tells whether "
    "this one does earlier; record a larger amplitude, beside which dry friction is less"
)
TURNS = (
    "stability: under the reference that was played 1 + L of {} turns as that of an unstable loop, too, though theirs "
    "is stable, so that the log cannot tell; record a larger amplitude, beside which dry friction is less"
)
NOT_TOLD = {
    "phases": "dry friction folds into the lines of each set of phases, so that the log tells neither whether the "
    f"machine is another one nor what differs; record {LEAST_PHASES} sets of random phases, with the command below its "
    "limit",
    "limit": "in too many periods the command is at its limit, so that the log tells neither whether the machine is "
    "another one nor what differs; record again at a smaller amplitude, or allow a larger limit",
    "drift": "it may be the reading that drifts, or what it is compared with; log another sensor that knows the force, "
    "or where the command is compared, record again with more periods or a larger reference, beside which noise and "
    "friction are less",
}
UNTOLD = {
    "short, gain": "a law whose {} is half as large",
    "short, factor": "a {} that is halved",
    "short, late": "a {} of one tick later",
}


def _say_open(cause: Cause) -> str:
    """Return why a log does not tell which law it is of, and what would."""
    if cause.kind in OPEN:
        of = "" if cause.kind == "saturated" else f", {EVERY_TICK}"
        return f"undecided{of}: {OPEN[cause.kind]}"
    if cause.kind == "rounding":
        value = format_number(cause.value)
        return f"undecided: rounding of the log allows {value} (rms) of the command; log it with more digits"
    other = UNTOLD[cause.kind].format("reading" if cause.what == "readings" else cause.what)
    seconds = "no length" if cause.value is None else f"{format_number(cause.value, 2)} s"
    more = f"{seconds} of this reference would decide"
    if cause.tells_hz is not None:
        more += f"; play a line at {format_number(cause.tells_hz, 2)} Hz in it, too, or log every tick"
    elif cause.value is None:
        more += "; play lines where that acts, or log every tick"
    return f"undecided: the log cannot tell this law from {other}; {more}"


def say_cause(cause: Cause, command: str) -> str:
    """Return what a cause means for who wrote the firmware. `command`: the name of what the law returns."""
    if cause.undecided:
        return _say_open(cause)
    value = format_number(cause.value)
    match cause.kind:
        case "rate" if cause.what == "clock":
            return f"the law is stepped at {value} Hz by the log's clock"
        case "rate" if cause.what == "law":
            return f"the law is stepped only every few rows, at {value} Hz"
        case "rate":
            return f"the numbers are those of a law made for {value} Hz"
        case "late":
            return f"the {cause.what} {'comes' if cause.what == 'command' else 'come'} {value} {cause.unit} late"
        case "sign":
            return f"the sign of {cause.what} is turned"
        case "open loop":
            return (
                f"the command does not follow {cause.what}: the loop was open; let the law make the command in each "
                "tick of what was read, and record under a reference that moves"
            )
        case "still":
            return (
                f"no command of this law is for a reference of {value} throughout, as it was logged: log the one that "
                "the law was given; if it was that, another law ran, or more than one column is wrong"
            )
        case "unit" if cause.what == command:
            return f"{cause.what} is in another unit: the logged value is {value} times what the law returned"
        case "unit":
            logged = format_number(None if cause.value is None else 1.0 / cause.value)
            return f"{cause.what} is in another unit: the logged value is {logged} times what the law was given"
        case "factor":
            return f"{cause.what} is {value} times what it should be"
        case "gain" if cause.edited is not None:
            return _say_edited(cause.what, cause.edited.factor, cause.edited, cause.edited)
        case "gain":
            return f"the gain {cause.what} is {value}"
        case "limit" if cause.what == "behind the law":
            return f"the command is limited to {value}{unit_after(cause.unit)} behind the law, which is not told of it"
        case "limit":
            return f"the command is limited to {value}{unit_after(cause.unit)}"
        case "feedforward":
            return f"the feedforward of the {cause.what} is missing or another one"
        case "place":
            return f"the law was given {value}{unit_after(cause.unit)} as {cause.what}"
        case "shift":
            return f"the law was given {cause.what} with {value}{unit_after(cause.unit)} added to what was logged"
        case "compensation":
            return f"the compensation of {cause.what} is missing"
        case "part":
            return f"the {cause.what} is missing"
        case "gains":
            return _say_gains(cause)
        case "column":
            return (
                f"the column of the reference is that of {cause.what}: name the one of what the law was given "
                "(--reference COLUMN, or [acceptance] in the problem file)"
            )
        case "stopped":
            return (
                f"it is this law until the command was stopped, which is zero from {value} s on: a gate that tripped, "
                "a signal that left its figure, or a hand; look at the status that the law logs, and record again"
            )
        case "another law":
            return f"it is the law of {cause.what}"
        case _:
            return f"the {cause.kind} is {cause.what}"


def say_trip(controller: Controller, trip: Trip) -> str:
    """Return when a gate tripped, what of, and for how long the law was stopped."""
    assert controller.gate is not None
    unit, (low, high) = unit_after(controller.command.reference_unit), map(format_number, controller.gate.range_N)
    step = format_number(controller.gate.max_step_N)
    why = {
        "range": f"outside its range, {low} to {high}{unit}",
        "step": f"more than its largest step, {step}{unit} a tick, from the one before",
        "encoders": "that do not agree with the encoders",
    }[trip.why]
    return (
        f"the gate tripped at {trip.at_s:.3f} s, of {trip.readings} readings in a row {why} (the last "
        f"{format_number(trip.reading)}{unit}), and the law was stopped for the rest, {trip.stopped_s:.4g} s: look at "
        "the sensor and its cable, or at the gate where the readings are true"
    )


def say_position_stays(controller: Controller, value: float) -> str:
    """Return that a link's position stays while the outer loop is closed, and what to do about it."""
    outer = controller.outer
    assert outer is not None
    at = f"{format_number(value)}{unit_after(outer.place_unit)}"
    return (
        f"{outer.position} stays at {at} with the outer loop closed, while what that is given moves: its encoder is "
        "dead or not read, or the link was held, so that nothing is judged of the outer loop; move the link by hand "
        f"with the drive off, close the outer loop only where {outer.position} follows, and record again"
    )


def say_status(reported: Reported, row: Replay) -> str:
    """Return what the machine's own status says of a law that was stopped; nothing where it was not, by both."""
    fault = "" if reported.fault_s is None else f"its status is a fault from {reported.fault_s:.3f} s on"
    if reported.contradicts and fault:
        return f"{fault}, but the logged command is that of the law to the end; look at which status is logged"
    if reported.contradicts:
        return "its status has no fault, though the gate tripped by its readings; look at which status is logged"
    stopped = any(cause.kind == "stopped" for cause in row.causes)
    return fault or ("its status has no fault: a stage ended itself, or a hand stopped it" if stopped else "")


def say_certified_break(name: str, row: Judged, machines: str) -> str:
    """Return that a limit is broken by what was certified, under the reference that was played, and what to record.
    `machines`: whose worst figure that is.
    """
    assert row.certified is not None
    if row.name == "stability":
        return TURNS.format(machines)
    limit, worst = (f"{format_number(value, 3)}{unit_after(row.unit)}" for value in (row.limit, row.certified))
    if row.name == "bandwidth":
        return NONE_BELOW.format(name, machines, worst)
    return BREAKS.format(name, machines, limit, worst)


def say_open(name: str, doubt: Doubt | None) -> str:
    """Return an undecided figure with the lines at which it is."""
    if doubt is None:
        return name
    return f"{name} ({_say_lines(doubt)})"


def say_unsure(name: str, doubt: Doubt) -> str:
    """Return why a figure whose interval may lie within its limit is undecided."""
    return (
        f"{name} is open {_say_lines(doubt)}, whatever its interval is: the command there is too near its own scatter "
        "for a gain that is sure; a larger reference at that frequency, or the periods that are named, would make it so"
    )


def _say_lines(doubt: Doubt) -> str:
    """Return the lines at which a figure is open."""
    low, high = (format_number(edge, 3) for edge in (doubt.lines_hz[0], doubt.lines_hz[-1]))
    return f"at {low} Hz" if len(doubt.lines_hz) == 1 else f"at {len(doubt.lines_hz)} lines from {low} to {high} Hz"


def say_drift(drift: Drift, command: str) -> str:
    """Return by how much a reading drifts beside what, and what would tell which of both it is. `command`: its name."""
    size = f"{format_number(abs(drift.value), 3)}{unit_after(drift.unit)} in {format_number(drift.lasts_s, 3)} s"
    said = f"{drift.name} drifts by {size} beside {drift.beside}"
    if drift.beside != command and drift.of_reading is False:
        return (
            f"{drift.beside} drifts by {size} beside {drift.name}, which the command or another sensor goes with: the "
            f"zero of {drift.beside} moves, not that of {drift.name}; tare, and record again"
        )
    if drift.beside != command and drift.of_reading is None:
        return f"{said}, while the reference repeats: the zero of one of both sensors moves; tare, and record again"
    if drift.beside != command:
        return (
            f"{said}, which the command or another sensor does not go with, while the reference repeats: its zero "
            "moves, and with it the true value; tare, and record again"
        )
    if drift.of_reading is None:
        return f"{said}, and the other sensors do not agree on whether it is the reading's; tare, and record again"
    if not drift.of_reading:
        return f"{said}, but not beside another sensor: the drive or a load on the motor drifts, not the reading"
    return (
        f"{said}, while the reference repeats: the sensor's zero moves, and with it the true value, or else the drive "
        "or a load on the motor does; an encoder of the deflection in the log, with less noise than that, would tell "
        "which; tare, and record again"
    )


def say_untold(untold: Untold) -> str:
    """Return why logs do not tell whether the machine is one of those that were certified, and what to record."""
    return NOT_TOLD[untold]


def say_bias(bias: Bias) -> str:
    """Return how far off the plant would be without the reference."""
    most, where = format_number(100.0 * bias.largest, 2), format_number(bias.where_hz, 3)
    why = ", as noise goes round the loop" if bias.by_noise else ""
    return (
        f"Taken from command and readings alone, the plant would be off by up to {most} % (at {where} Hz){why}; here "
        "all is taken from the reference."
    )


def _say_edited(name: str, factor: float | None, edited: Edited, where: Edited | EditedGain) -> str:
    """Return by what a gain of a table was multiplied, and where."""
    return f"the gain {name} is {format_number(factor)} times what was exported {_say_points(edited, where)}"


def _say_points(edited: Edited, where: Edited | EditedGain) -> str:
    """Return where a table was edited."""
    if where.everywhere:
        return f"at all points of {edited.over} that the log reaches"
    return f"at {edited.over} = {format_number(where.points[0])}{unit_after(edited.unit)}"


def _say_gains(cause: Cause) -> str:
    """Return which gains a law has that are not the exported ones, the most different first."""
    if cause.edited is not None and cause.edited.pair:
        return ", and ".join(_say_edited(part.name, part.factor, cause.edited, part) for part in cause.edited.pair)
    found, exported = cause.gains or {}, cause.exported or {}
    apart = {name: abs(found[name] - value) / max(abs(found[name]), abs(value)) for name, value in exported.items()}
    named = [name for name in sorted(apart, key=lambda name: -apart[name]) if apart[name] > SAME_GAINS]
    values = [f"{name} {format_number(found[name])} ({format_number(exported[name])} exported)" for name in named]
    whose = "" if cause.what == "law" else f", those of {cause.what}"
    if cause.edited is not None:
        return f"the gains {_say_points(cause.edited, cause.edited)} are others: {', '.join(values)}"
    return f"it is a law with another set of gains{whose}: {', '.join(values)}"


def say_missing(reach: Band, missing: Sequence[Band]) -> str:
    """Return which lines to record. `reach`: from where to where they are to lie."""
    if tuple(missing) == (reach,):
        low, high = (format_number(edge, 3) for edge in reach)
        return f"at least {FEWEST_LINES} lines from {low} to {high} Hz, each at most {CLOSEST:g} times the one before"
    parts, several = list[str](), False
    for band in missing:
        low, high = (format_number(edge, 3) for edge in band)
        if band[1] > CLOSEST * band[0]:
            several = True
            parts.append(f"lines from {low} to {high} Hz")
        else:
            parts.append(f"a line at {low} Hz or below" if band[0] == reach[0] else f"a line at {high} Hz or above")
    close = f", each at most {CLOSEST:g} times the one before" if several else ""
    return f"beside the lines that were played {join_words(parts)}{close}"


def say_difference(each: Difference) -> str:
    """Return a difference in words; of two that explain it together both."""
    return ", and ".join(map(_say_part, (each, *each.beside)))


def _say_part(each: Difference) -> str:
    others = [
        f"{name} {''.join(_say_factor(name, value))}" for name, value in zip(each.alike, each.alike_values, strict=True)
    ]
    also = f" (or {', or '.join(others)})" if others else ""
    match each.kind:
        case "range":
            return (
                f"{each.name} stops at {format_number(each.value)}{unit_after(each.unit)}: its sensor is at its range"
            )
        case "delay":
            way = "later" if each.value > 0.0 else "earlier"
            return f"the loop is {abs(1e3 * each.value):.3g} ms {way} than in the model"
        case "mode":
            pole = "" if each.size is None else f", its pole at {format_number(each.value / each.size, 3)} Hz"
            size = (
                "" if each.changes is None else f", which changes the response {format_number(each.changes, 2)} times"
            )
            return f"there is a mode at {format_number(each.value, 3)} Hz{pole}{size}"
        case "drive limit":
            level = f"{format_number(each.value, 3)}{unit_after(each.unit)}"
            return f"the drive gives at most {level} of what is commanded"
        case "rate":
            return (
                f"the law is stepped at {format_number(each.value)} Hz by what the machine does, "
                f"{format_number(each.size, 3)} times the rate of the log's clock; check the timer that calls it"
            )
        case "gain":
            turned = "the sign of the drive is turned; " if each.value < 0.0 else ""
            return f"{turned}the force per command is {format_number(each.value, 3)} times the model's{also}"
        case _:
            number, bound = _say_factor(each.name, each.value)
            return f"{each.name} is {number} times its value{bound}{also}"


def _say_factor(name: str, value: float) -> tuple[str, str]:
    """Return a factor, and where it is at an end of what is tried, in which direction it may be further."""
    end = 0 if name == "gain" else find_end(value)
    return format_number(value, 2 if end else 3), ("", " or more", " or less")[end]
