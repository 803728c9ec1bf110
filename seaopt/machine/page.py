"""An acceptance in words: sections for print, terminal and notebook, and the page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from seaopt.files import write_text
from seaopt.formatting import format_count, format_number
from seaopt.machine.acceptance import Acceptance
from seaopt.machine.replay import Cause, Replay
from seaopt.reporting.page.provenance import describe_provenance
from seaopt.reporting.page.render import render_parts, render_template
from seaopt.reporting.sections.data import Commands, KeyFigure, Reason, Section, Table, Verdict, mark_met
from seaopt.units import unit_after

PARTS = {
    "replay": "Is it this law",
    "causes": "Why the command differs",
    "provenance": "Provenance",
}
MOST_CAUSES = 5
MISSED = (
    "no cause was found: are these the logs of this problem, and was the C code exported from this controller.json?"
)


def say_cause(cause: Cause) -> str:
    """Return what a cause means for who wrote the firmware."""
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
        case "unit":
            return f"{cause.what} is in another unit: {value} times what it should be"
        case "factor":
            return f"{cause.what} is {value} times what it should be"
        case "gain":
            return f"the gain {cause.what} is {value}"
        case "limit":
            return f"the command is limited to {value}{unit_after(cause.unit)}"
        case "feedforward":
            return f"the feedforward of the {cause.what} is missing or another one"
        case "compensation":
            return f"the compensation of {cause.what} is missing"
        case "part":
            return f"the {cause.what} is missing"
        case "another law":
            return f"it is the law of {cause.what}"
        case _:
            return f"the {cause.kind} is {cause.what}"


def judge(result: Acceptance, commands: Commands) -> Verdict | None:
    """Return the verdict on an acceptance."""
    off = [(source, row) for source, row in zip(result.sources, result.replays, strict=True) if not row.met]
    reasons = tuple(Reason(what=_say_mismatch(row, result), where=source) for source, row in off)
    count = format_count(len(result.sources), "log")
    text = f"Replay: the law makes the logged command in {len(result.sources) - len(off)} of {count}"
    return Verdict(met=result.met, text=text, reasons=reasons)


def _say_mismatch(row: Replay, result: Acceptance) -> str:
    unit = unit_after(result.controller.command.unit)
    if row.causes and row.causes[0].explains:
        return say_cause(row.causes[0])
    off = f"the command is off by {format_number(row.mismatch, 3)}{unit} (rms), of {format_number(row.rms, 3)}{unit}"
    if not row.causes:
        return f"{off}; {MISSED}"
    return f"{off}; nearest: {say_cause(row.causes[0])} ({100.0 * row.causes[0].removes:.0f} % of it)"


def describe(result: Acceptance) -> list[Section]:
    """Return what was compared, and what may be the cause where it differs."""
    unit = result.controller.command.unit
    rows = tuple(
        (
            source,
            mark_met(row.met),
            str(row.ticks),
            *(format_number(value, 3) for value in (row.mismatch, row.largest, row.allowed, row.rms)),
            f"{100.0 * row.saturated:.2g} %",
            format_number(row.rate_hz),
        )
        for source, row in zip(result.sources, result.replays, strict=True)
    )
    head = ("log", "verdict", "ticks", f"off (rms, {unit})", "at most", "rounding", "command", "at limit", "rate (Hz)")
    late = sorted({row.command_late for row in result.replays if row.met and row.command_late})
    remarks = tuple(
        f"The command is logged {abs(by)} row {'late' if by > 0 else 'early'}, which is allowed." for by in late
    )
    sections = [
        Section(
            title="Replay",
            part="replay",
            tables=(Table(head=head, rows=rows, align="<<>>>>>>>", optional=("rate (Hz)", "at limit")),),
            remarks=(
                "The law is fed with the logged reference and readings; its command is compared with the log's.",
                *remarks,
            ),
        )
    ]
    for source, row in zip(result.sources, result.replays, strict=True):
        table = tuple(
            (say_cause(cause), f"{100.0 * cause.removes:.4g} %", mark_met(cause.explains, "all", "in part"))
            for cause in row.causes[:MOST_CAUSES]
        )
        if table:
            table = Table(head=("if", "removes", "explains"), rows=table, align="<><")
            sections.append(Section(title=f"Causes that were tried on {source}", part="causes", tables=(table,)))
    return sections


def summarise(result: Acceptance) -> list[KeyFigure]:
    """Return how near the replay comes."""
    worst = max(result.replays, key=lambda row: row.mismatch)
    unit = unit_after(result.controller.command.unit)
    off, size = (f"{format_number(value, 3)}{unit}" for value in (worst.mismatch, worst.rms))
    return [KeyFigure(name="command off (rms)", value=off, against=f"of {size}")]


def write_acceptance_page(
    result: Acceptance,
    path: Path | str,
    *,
    title: str = "Acceptance",
    files: Sequence[Path | str] = (),
    command: str = "",
) -> Path:
    """Write an HTML page of an acceptance; it needs no network and no other file.

    Parameters
    ----------
    result : Acceptance
        Of `accept`.
    path : path
        The page.
    title : str
        Heading of the page.
    files : sequence of path
        What it was made of: the problem file and the logs.
    command : str
        What was typed to make it, to be stated.

    Raises
    ------
    FileError
        The folder cannot be written.
    """
    verdict = judge(result, Commands())
    html = render_template(
        "page.html.jinja",
        title=title,
        parts=PARTS,
        verdicts=[verdict],
        glance=summarise(result),
        described=render_parts([*describe(result), describe_provenance((), files, command)], PARTS),
        plates={},
        doubt="",
        controller=None,
        header=None,
    )
    return write_text(Path(path), html)
