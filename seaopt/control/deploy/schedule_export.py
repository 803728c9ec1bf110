"""A scheduled controller for the target: C99 with the table of its gains, which needs no library.

The C code is `RunnableSchedule.step`, operation for operation: the step of `seaopt.control.scheduling.step_order` is
traced. One struct, `init`, `reset` and `step`, no allocation, and no include but its own header. The step takes the
scheduling variable beside reference and measurement; outside the table the gains of its ends count, and one that is not
finite is replaced by the last that was, or by the table's `fallback` where there was none since the reset.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from seaopt.control.deploy.c_text import Writer, identifier, name_unit, strip_markup
from seaopt.control.deploy.trace import Term, Trace
from seaopt.control.laws.command import name_gain_units
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.structures import AGREES
from seaopt.control.loops.compensation.terms import Compensation, compensate
from seaopt.control.scheduling.gain_table import CORNERS
from seaopt.control.scheduling.runnable_schedule import RunnableSchedule, name_terms
from seaopt.control.scheduling.scheduled_controller import ScheduledController, is_alike
from seaopt.control.scheduling.step_order import SHARE
from seaopt.errors import FileError

SCHEDULE_TEMPLATES = {"{}.h": "law.h.jinja", "{}.c": "law.c.jinja"}
WARPED = "tan(pi f T)"  # the unit of a corner in the table, in words


def read_runnable(
    content: Mapping[str, Any], limit: float | None = None, tracking_time_s: float | None = None
) -> tuple[RunnableSchedule, Controller]:
    """Return the law of a schedule's controller.json, ready to run, and its first controller. Raises ControlError,
    FileError.
    """
    from seaopt.control.scheduling.stored import read_points  # deferred: pydantic

    table, _, controllers = read_points(content)
    first = controllers[0]
    if not all(is_alike(each.compensation, first.compensation) for each in controllers):
        raise FileError("controller.json: terms are not alike at all points; tune again")
    schedule = ScheduledController.of_points(table, controllers)
    law = schedule.runnable(limit=limit, tracking_time_s=tracking_time_s)
    if tracking_time_s is None and not np.allclose(law.anti_windup, table.anti_windup, rtol=AGREES, atol=0.0):
        raise FileError("controller.json: schedule.anti_windup is not what the gains give; tune again")
    return law, first


def describe_schedule(law: RunnableSchedule, first: Controller, number: Writer) -> dict[str, Any]:
    """Return words and numbers of the table, and the step traced."""
    table = law.table
    units = name_gain_units(first.command) | dict.fromkeys(CORNERS.values(), WARPED)
    rows = {**table.columns, SHARE: law.anti_windup, **_list_varying(law)}
    signals = [f"read_{identifier(name)}" for name in first.signals[1:]]
    terms = law.compensation or Compensation(sample_time_s=law.sample_time_s)
    integrators = table.integrates or "T_v" in table.gains or bool(table.nominals)
    at_rest = {term.reads for term in (terms.gravity, terms.ripple if integrators else None) if term is not None}
    resets = [f"read_{identifier(name)}" for name in terms.reads if name in at_rest]
    return {
        **_trace(law, f"reference_{name_unit(first.command)}", list(rows), signals, number),
        "integrators": integrators,
        "resets": [name for name in resets if name not in signals],
        "over": strip_markup(table.over),
        "over_unit": strip_markup(table.unit),
        "place": f"at_{identifier(table.over)}",
        "ends": [f"{table.points[k]:g}" for k in (0, -1)],
        "shown_fallback": f"{law.fallback:g}",
        "count": table.points.size,
        "points": ", ".join(number(float(value)) for value in table.points),
        "columns": [f"{key}{f' [{units[key]}]' if key in units else ''}" for key in rows],
        "rows": [", ".join(number(float(row[i])) for row in rows.values()) for i in range(table.points.size)],
        "fallback": number(law.fallback),
    }


def _trace(law: RunnableSchedule, force: str, columns: list[str], signals: list[str], number: Writer) -> dict[str, Any]:
    """Return step and reset as lines of C, and what they are given and keep."""
    order = law.table.order
    states = list(law.table.states)

    def begin(reference: str, reading: str) -> tuple[Trace, dict[str, Term], dict[str, Term], Term, list[Term]]:
        trace = Trace(number)
        gains = {name: Term(trace, f"g[{i}]") for i, name in enumerate(columns)}
        x = {name: Term(trace, f"law->x[{i}]") for i, name in enumerate(states)}
        return trace, gains, x, Term(trace, reference), [Term(trace, text) for text in (reading, *signals)]

    trace, gains, x, reference, readings = begin(force, "reading")
    reference, added = _compensate(law, gains, reference, _REMEMBERED)
    effort, applied, after = order.step(
        gains, x, reference, readings, lambda effort: trace.keep(f"limited({effort.text}, most)", [effort.text]), added
    )
    results = [trace.write(value) for value in (effort, applied, *after.values())]
    step = trace.list_needed(results)
    trace, gains, x, reference, readings = begin("reference", "measurement")
    reference, added = _compensate(law, gains, reference, ())
    effort = Term(trace, "effort")
    start = order.continue_from(gains, effort if added is None else effort - added, reference, readings)
    starts = [trace.write(value) for value in start.values()]
    return {
        "order": len(states),
        "storage": len(states),
        "states": states,
        "step_lines": step,
        "unlimited": results[0],
        "applied": results[1],
        "after": results[2:],
        "reset_lines": trace.list_needed(starts),
        "starts": starts,
    }


class _Operations:
    """The operations of `compensate`, written down."""

    @staticmethod
    def fmin(a: Any, b: Any) -> Any:
        return a.trace.choose(b, "<", a)

    @staticmethod
    def fmax(a: Any, b: Any) -> Any:
        return a.trace.choose(b, ">", a)

    @staticmethod
    def floor(a: Any) -> Any:
        return a.trace.keep(f"floored({a.text})", [a.text])


_REMEMBERED = ("((law->friction_known != 0) ? (real)1 : (real)0)", "law->friction_last")


def _list_varying(law: RunnableSchedule) -> dict[str, Any]:
    """Return those numbers of the compensation that differ from point to point, with names of their own."""
    rows = () if law.terms is None else law.terms.T
    return {name: row for name, row in zip(name_terms(law.terms), rows, strict=True) if np.any(row != row[0])}


def _compensate(
    law: RunnableSchedule, gains: Mapping[str, Term], reference: Term, memory: Sequence[Any]
) -> tuple[Term, Any]:
    """Return the law's reference and what is added to its effort; at a reset nothing is remembered of friction."""
    if law.compensation is None or law.terms is None:
        return reference, None
    shape, trace = law.compensation.shape, reference.trace
    numbers = [gains.get(*pair) for pair in zip(name_terms(law.terms), law.terms[0].tolist(), strict=True)]
    if not memory and shape.friction is not None:
        shape, numbers = replace(shape, friction=None), numbers[2:]
    readings = [Term(trace, f"or_zero(read_{identifier(name)})") for name in shape.reads]
    before = [Term(trace, text) if isinstance(text, str) else text for text in memory]
    shaped, added, _ = compensate(shape, numbers, before, reference, readings, _Operations)
    return shaped, added
