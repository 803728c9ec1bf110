"""A controller for the target: C99 that needs no library, its gains as a C header, and a MATLAB script.

The C code is `RunnableLaw.step` with the numbers filled in: one struct, `init`, `reset` and `step`; no allocation, no
include but its own header, nothing global that changes. In double it gives the same commands as `RunnableLaw` to
rounding. In float the integral stops where an increment is less than half a unit in its last place, at an error of
about 6e-8 abs(x)/(k_i T_s) (x: the integral's part of the force): take double where k_i is small.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from types import NoneType
from typing import Any, Literal

import numpy as np

from seaopt.codec import check_agrees, from_content, to_content
from seaopt.control.deploy.c_text import (
    LARGEST_NUMBER,
    Precision,
    Writer,
    check_prefix,
    identifier,
    literal,
    name_unit,
    render,
    strip_markup,
)
from seaopt.control.deploy.schedule_export import SCHEDULE_TEMPLATES, describe_schedule, read_runnable
from seaopt.control.deploy.target import (
    LOG_TEMPLATES,
    STAGE_TEMPLATES,
    TARE_TEMPLATES,
    Tare,
    describe_log,
    describe_stops,
    describe_tare,
    describe_unwatched,
    hash_law,
)
from seaopt.control.laws.command import name_gain_units
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.plausibility import LARGEST, PlausibilityGate
from seaopt.control.laws.realisation import RunnableLaw, check_guards, find_raised_limit, runnable
from seaopt.control.laws.spec import check_command_limits
from seaopt.control.laws.structures import AGREES
from seaopt.control.laws.verdict import join_limits
from seaopt.control.loops.compensation.link_feedforward import multiply_out
from seaopt.control.loops.compensation.ripple_term import COSINE, MOST_TURNS, SINE, RippleTerm
from seaopt.control.loops.compensation.terms import Compensation, FrictionTerm, GravityTerm
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.scheduling.runnable_schedule import RunnableSchedule
from seaopt.control.scheduling.scheduled_controller import ScheduledController
from seaopt.errors import ControlError, FileError, require_type
from seaopt.files import check_folder, write_text
from seaopt.formatting import join_words
from seaopt.plants.motor.heat_guard import HeatGuard
from seaopt.plants.motor.thermal import MotorRating
from seaopt.units import mechanics_of

TEMPLATES = {"{}.h": "law.h.jinja", "{}.c": "law.c.jinja", "{}_gains.h": "gains.h.jinja", "{}_gains.m": "gains.m.jinja"}
PLAN = "force_mpc"  # prefix of the names in C of predictive control
FIGURES = {
    "bandwidth_hz": "bandwidth {:.4g} Hz", "ms": "Ms {:.4g}", "mt": "Mt {:.4g}", "noise_gain": "noise gain {:.4g}",
    "gain_margin_db": "gain margin {:.4g} dB", "phase_margin_deg": "phase margin {:.4g} deg",
}  # fmt: skip


def export(
    controller: Controller | ScheduledController | Mapping[str, Any],
    folder: Path | str,
    *,
    precision: Precision = "double",
    name: str = "force_law",
    current_limit_A: float | None = None,
    command_limit: float | None = None,
    tracking_time_s: float | None = None,
    gate: PlausibilityGate | Literal[False] | None = None,
    derate: bool | HeatGuard | None = None,
    allow_infeasible: bool = False,
    fit_met: bool | None = None,
    uncertified: str = "",
    log_rows: int | None = None,
    tare: Tare | None = None,
    stop: Mapping[str, float] | None = None,
) -> tuple[Path, ...]:
    """Write a controller as C99, with its gains as a C header and as a MATLAB script.

    Parameters
    ----------
    controller : Controller, ScheduledController or mapping
        The controller, or the content of its controller.json; of a schedule NAME.h and NAME.c alone are written
        (`seaopt.control.deploy.schedule_export`).
    folder : path
        For NAME.h, NAME.c, NAME_gains.h and NAME_gains.m; created if it does not exist.
    precision : {"double", "float"}
        Of the C code.
    name : str
        Prefix of every name in C: a letter, then letters, digits and underscores.
    current_limit_A, command_limit : float, optional
        In place of the specification's limit: of a current, or of whatever is commanded, in its unit. Give one.
    tracking_time_s : float, optional
        As in `seaopt.control.laws.realisation.runnable`.
    gate : PlausibilityGate or False, optional
        Which readings the law believes, and what it does about the others; the controller's own if left out, none with
        False.
    derate : bool or HeatGuard, optional
        Lower the limit as the winding warms up, by `seaopt.plants.motor.heat_guard`: of a design plant with the part
        "thermal" that is commanded a current; or by a guard of your own, with a margin say, at the law's sample time.
        What the controller says if left out.
    allow_infeasible : bool
        Also write a controller that misses its limits; the files state it.
    fit_met : bool, optional
        Whether the fit that it was tuned with is met; the files state one that is not. What a controller.json says of
        it, if left out.
    uncertified : str
        Why no certificate vouches for it, in words that the files state; "" where one does, or where nothing is said.
    log_rows : int, optional
        Rows of a ring, a power of two: NAME_log.h and NAME_log.c log what the law is given and returns
        (`seaopt.control.deploy.target`).
    tare : Tare, optional
        NAME_tare.h and NAME_tare.c average the zero of the force at rest.
    stop : mapping of str to float, optional
        With `log_rows`, of a stage of bring-up: NAME_stage.h and NAME_stage.c start the law from what is read, play the
        reference.h beside them, log, and stop where a reading that is fed back is beyond these.

    Returns
    -------
    tuple of Path
        The files.

    Raises
    ------
    ControlError
        The controller is not feasible or not stable on its design plant, or an argument is out of range.
    FileError
        The content is malformed or contradicts its law, or the folder cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import seaopt as so
    >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)
    >>> controller = so.tune(so.plants.high_impedance(), so.plants.thor(), spec)
    >>> [path.name for path in export(controller, tempfile.mkdtemp(), name="knee")]
    ['knee.h', 'knee.c', 'knee_gains.h', 'knee_gains.m']
    """
    if precision not in LARGEST_NUMBER:
        raise ControlError(f'precision = "{precision}" is not known; use "double" or "float"')
    prefix = check_prefix(name)
    check_folder(Path(folder))
    check_command_limits(current_limit_A, command_limit)
    require_type(derate, (bool, HeatGuard, NoneType), "derate", "give True, False or a HeatGuard", ControlError)
    limit = command_limit if current_limit_A is None else current_limit_A
    if isinstance(controller, Mapping) and fit_met is None:
        fit_met = controller.get("fit_met", True) is True
    content = controller.to_dict() if isinstance(controller, ScheduledController) else controller
    law: RunnableLaw | RunnableSchedule
    if isinstance(content, Mapping) and content.get("schedule") is not None:
        law, stored = read_runnable(content, limit, tracking_time_s)
        figures, heat = list[str](), read_guard(content)
        missed, met = "; ".join(content["schedule"]["broken"]), content["feasible"]
        templates, kind = SCHEDULE_TEMPLATES, "schedule"
    else:
        stored, figures, heat = _read(content)
        templates, missed, met, kind = TEMPLATES, join_limits(stored.binding), stored.met, "controller"
        law = runnable(stored, command_limit=limit, tracking_time_s=tracking_time_s, gate=False, heat=False)
    heat = derate if isinstance(derate, HeatGuard) else heat
    derate = stored.derate if derate is None else derate
    if derate and heat is None:
        raise ControlError(
            "derate = True, but nothing is known of the motor's heat; tune on a plant with the part thermal that "
            "is commanded a current"
        )
    gate = stored.gate if gate is None else None if gate is False else gate
    heat = heat if derate else None
    check_guards(gate, heat, law.command)
    law = replace(law, gate=gate, heat=heat)
    words = _describe(stored, law) | {
        "achieved": figures,
        "feasible": met,
        "kind": kind,
        "blocking": strip_markup(missed),
    }
    writers = {".m": repr, ".h": literal(precision), ".c": literal(precision)}
    numbers = {
        suffix: _write_numbers(stored, law, write, precision)
        | (describe_schedule(law, stored, write) if isinstance(law, RunnableSchedule) else _numbers(stored, law, write))
        for suffix, write in writers.items()
    }
    if not met and not allow_infeasible:
        raise ControlError(f"the {kind} misses {missed}; tune one that does not, or allow an infeasible one")
    context = words | {
        "name": prefix,
        "NAME": prefix.upper(),
        "precision": precision,
        "fit_met": fit_met,
        "uncertified": strip_markup(uncertified),
        "raised_from": strip_markup(find_raised_limit(stored.command, stored.spec, limit)),
    }
    beside, described = _describe_beside(context, stored, law, log_rows, tare, stop)
    return _write(Path(folder), {**templates, **beside}, context | described, numbers)


def export_beside(
    controller: Controller,
    folder: Path | str,
    *,
    precision: Precision = "double",
    log_rows: int | None = None,
    tare: Tare | None = None,
    stop: Mapping[str, float] | None = None,
) -> tuple[Path, ...]:
    """Write beside the C code of predictive control what `export` writes beside a law: log, stage and tare.

    Parameters
    ----------
    controller : Controller
        The law while no limit is active, of `seaopt.robustness.linear_controller`.
    folder, precision, log_rows, tare, stop
        As in `export`.

    Returns
    -------
    tuple of Path
        The files.

    Raises
    ------
    ControlError
        An argument is out of range.
    FileError
        The folder cannot be written.
    """
    law = runnable(controller)
    words = _describe(controller, law) | _write_numbers(controller, law, literal(precision), precision)
    context = {"name": PLAN, "NAME": PLAN.upper(), "precision": precision} | words
    reads = dict.fromkeys((*controller.further, *controller.signals[1:]))  # as `ReadsLink.reads` has them
    plan = [f"read_{identifier(name)}" for name in reads]
    templates, described = _describe_beside(context, controller, law, log_rows, tare, stop, plan)
    return _write(Path(folder), templates, context | described, {})


def _write(
    folder: Path,
    templates: Mapping[str, str],
    context: Mapping[str, Any],
    numbers: Mapping[str, Mapping[str, Any]],
) -> tuple[Path, ...]:
    """Write each template's text, all of them rendered before the first is written. `numbers`: of each suffix."""
    texts = {
        pattern.format(context["name"]): render(template, {**context, **numbers.get(pattern[-2:], {})})
        for pattern, template in templates.items()
    }
    return tuple(write_text(folder / file, text) for file, text in texts.items())


def _describe_beside(
    context: Mapping[str, Any],
    stored: Controller,
    law: RunnableLaw | RunnableSchedule,
    log_rows: int | None,
    tare: Tare | None,
    stop: Mapping[str, float] | None,
    plan: list[str] | None = None,
) -> tuple[dict[str, str], dict[str, Any]]:
    """Return the templates of what runs beside a law, and their words and numbers. `plan`: of predictive control, what
    its terms read.
    """
    templates, described = dict[str, str](), dict[str, Any](plan=plan)
    if log_rows is not None:
        names = tuple(dict.fromkeys((*stored.signals, *law.further)))
        units, digest = _list_units(stored), hash_law(law, stored.outer)
        described |= describe_log(context, law, names, log_rows, units=units, digest=digest)
        templates |= LOG_TEMPLATES
        if stop is not None:
            described["stops"] = describe_stops(stop, stored.signals, units, name_unit(stored.command))
            units |= {stored.command.input: stored.command.unit}
            described["unwatched"] = describe_unwatched(stop, stored.signals, units)
            templates |= STAGE_TEMPLATES
    if tare is not None:
        require_type(tare, Tare, "tare", "give a Tare", ControlError)
        unit_after = strip_markup(f" {stored.command.reference_unit}")
        described |= {"tare": describe_tare(tare, law.sample_time_s), "unit_after": unit_after}
        templates |= TARE_TEMPLATES
    return templates, described


def _read(controller: Controller | Mapping[str, Any]) -> tuple[Controller, list[str], HeatGuard | None]:
    """Return a controller, the lines on its figures, and its heat guard."""
    if isinstance(controller, Controller):
        return controller, _figures(controller), controller.heat_guard
    if "mpc" in controller:
        raise ControlError(
            "the controller plans, and its law here is that of no active limit; write its C code with export_mpc, or "
            "type seaopt export DIR"
        )
    return Controller.read(controller), _stated(controller), read_guard(controller)


def read_guard(content: Mapping[str, Any], margin_K: float = 0.0) -> HeatGuard | None:
    """Return the heat guard of a controller.json, where it has one, made again from its network with a margin. Raises
    FileError: the file's own guard is not that of its network. Raises ControlError: a number is missing or out of
    range.
    """
    heat = content.get("heat")
    guard = heat.get("guard") if isinstance(heat, Mapping) else None
    if not isinstance(heat, Mapping) or not isinstance(guard, Mapping):
        return None
    source, remedy, period = "controller.json: heat", "tune again", content["sample_time_s"]
    rating = from_content(MotorRating, heat, source, remedy=remedy)
    stated = from_content(HeatGuard, guard, f"{source}.guard", remedy=remedy)
    made = to_content(HeatGuard.of_rating(rating, period))
    check_agrees(to_content(stated), made, f"{source}.guard", remedy=remedy, rtol=AGREES)
    return HeatGuard.of_rating(rating, period, margin_K=margin_K)


def _figures(controller: Controller) -> list[str]:
    """Return what a controller achieves, computed again where its design plant is known."""
    if controller.design is None:
        return _format_figures("As stated by the controller, not computed again", asdict(controller.achieved))
    figures = controller.close(*controller.design).figures()
    if not figures.stable:
        raise ControlError("the controller's law is not stable on its design plant; tune one that is")
    return _format_figures("Achieved on the design plant", asdict(figures))


def _stated(content: Mapping[str, Any]) -> list[str]:
    """Return what a controller.json, which does not hold the design plant, says of it."""
    achieved = content.get("achieved")
    if not isinstance(achieved, Mapping):
        raise FileError("controller.json: achieved is missing or not a table; tune again")
    for name, value in achieved.items():
        if name in FIGURES and value is not None and (isinstance(value, bool) or not isinstance(value, (int, float))):
            raise FileError(f"controller.json: achieved.{name} is {value!r}, not a number; tune again")
    return _format_figures("As stated by controller.json, not computed again", achieved)


def _format_figures(whence: str, achieved: Mapping[str, Any]) -> list[str]:
    """Return the lines that the header has on figures."""
    parts = [text.format(achieved[key]) for key, text in FIGURES.items() if achieved.get(key) is not None]
    if len(parts) == len(FIGURES):
        return [f"{whence}: {', '.join(parts[:3])},", f"{', '.join(parts[3:])}."]
    return [f"{whence}: {', '.join(parts) or 'nothing that was measured'}."]


def _describe(stored: Controller, law: RunnableLaw | RunnableSchedule) -> dict[str, Any]:
    """Return what the files say in words."""
    command, drive, outer = stored.command, stored.drive_delay_s, stored.outer
    return {
        "structure": strip_markup(stored.structure),
        "measured": strip_markup(", ".join(stored.signals)),
        "effort": command.mechanics.word,
        "command": {name: strip_markup(getattr(command, name)) for name in ("word", "unit", "effort_unit")},
        "symbol": command.symbol,
        "LIMIT": command.limit_symbol,
        "suffix": name_unit(command),
        "rate_hz": f"{1.0 / law.sample_time_s:.10g}",
        "compute_delay_samples": stored.compute_delay_samples,
        "drive_delay_s": repr(float(drive)),
        "drive_delay_ms": f"{1e3 * drive:.4g}" if drive else "",
        "older": stored.spec.delay_samples is not None,
        "delays": stored.delays,
        "limited": math.isfinite(law.command_limit),
        "scheduled": isinstance(law, RunnableSchedule),
        "gated": law.gate is not None,
        "heated": law.heat is not None,
        "outer_units": None if outer is None else mechanics_of(outer.place_unit),
        "max_held": law.gate.max_held if law.gate is not None else 0,
    }


def _write_gate(gate: PlausibilityGate, sample_time_s: float, number: Writer) -> dict[str, Any]:
    """Return a gate's numbers, exact for the code and rounded for what is read."""
    (low, high), agreement = gate.range_N, gate.agreement
    exact = {"low": low, "high": high, "step": gate.max_step_N, "ramp": gate.ramp_per_s * sample_time_s}
    encoders: list[dict[str, str]] = []
    if agreement is not None:
        exact |= {"apart": agreement.limit, "share": agreement.share, "percent": 100.0 * agreement.share}
        encoders = [
            {"NAME": identifier(name).upper(), "symbol": f"read_{identifier(name)}", "weight": number(weight)}
            for name, weight in zip(agreement.reads, agreement.weights, strict=True)
        ]
    return {name: number(value) for name, value in exact.items()} | {
        **{f"shown_{name}": f"{value:.6g}" for name, value in exact.items()},
        "encoders": encoders,
        "taken": "".join(f", real {each['symbol']}" for each in encoders),
        "passed": "".join(f", {each['symbol']}" for each in encoders),
        "encoders_named": strip_markup(join_words(gate.reads)),
    }


def _list_units(stored: Controller) -> dict[str, str]:
    """Return the units of what a law reads, as far as its design plant, or what it is stored with, tells them."""
    gate, link, terms = stored.gate, stored.link, stored.compensation
    parts = () if terms is None else (terms.gravity, terms.ripple)
    units = {part.reads: part.unit for part in parts if part is not None}
    if link is not None:
        units[link.measured] = link.unit
    if gate is not None and gate.agreement is not None:
        units |= dict(zip(gate.reads, gate.agreement.units, strict=False))
    if stored.design is not None:
        units |= stored.see(stored.design[0]).outputs
    return units | {stored.signals[0]: stored.command.reference_unit}


def _write_numbers(
    stored: Controller, law: RunnableLaw | RunnableSchedule, number: Writer, precision: Precision
) -> dict[str, Any]:
    """Return what surrounds any law as text: what it reads, limits, guards, terms, outer loop."""
    readings = [strip_markup(name) for name in stored.signals[1:]]
    added = stored.compensation or Compensation(sample_time_s=law.sample_time_s)
    largest = float(LARGEST_NUMBER[precision])
    return {
        "more": [
            {
                "output": name,
                "NAME": name.upper(),
                "symbol": f"read_{name}",
                "argument": f"{name}_given",
                "minus": f" - C_{name} {name}",
            }
            for name in map(identifier, readings)
        ],
        "largest": number(LARGEST),
        "effort_limit": number(min(law.force_limit_N, largest)),
        "command_limit": number(min(law.command_limit, largest)),
        "per_effort": number(law.per_effort),
        "per_effort_unit": stored.command.per_effort_unit,
        "sample_time_s": number(law.sample_time_s),
        "gate": {} if law.gate is None else _write_gate(law.gate, law.sample_time_s, number),
        "heat": {} if law.heat is None else {name: repr(value) for name, value in asdict(law.heat).items()},
        "hottest": "" if law.heat is None else f"{law.heat.ambient + law.heat.allowed_rise:g}",
        "ambient": "" if law.heat is None else f"{law.heat.ambient:g}",
        "outer": {} if stored.outer is None else _write_outer(stored.outer, number),
        "friction": {} if added.friction is None else _write_friction(added.friction, added.sample_time_s, number),
        "gravity": {} if added.gravity is None else _write_gravity(added.gravity, number),
        "ripple": {} if added.ripple is None else _write_ripple(added.ripple, number),
        "further": [
            {"output": name, "symbol": f"read_{identifier(name)}", "used": name in added.reads}
            for name in law.further
            if name not in readings
        ],
    }


def _numbers(stored: Controller, law: RunnableLaw, number: Writer) -> dict[str, Any]:
    """Return the numbers of one law as text; a law without states is given one that stays zero."""

    def row(values: Iterable[float]) -> str:
        return ", ".join(number(float(value)) for value in values) or number(0.0)

    per_reference, per_measurement = law.find_rest()
    transfer_functions = multiply_out(stored.law, stored.link)
    b, d, resting = (
        np.reshape(part, (-1, law.measured)).T for part in (law.b_measurement, law.d_measurement, per_measurement)
    )
    readings = list(map(identifier, stored.signals[1:]))
    added = law.compensation or Compensation(sample_time_s=law.sample_time_s)
    at_rest = added.gravity, added.ripple if law.integrators else None  # without an integral no effort is set
    units = name_gain_units(stored.command)
    return {
        "order": law.c.size,
        "storage": max(law.c.size, 1),
        "integrators": law.integrators,
        "a": [row(values) for values in law.a] or [number(0.0)],
        "b_reference": row(law.b_reference),
        "b_measurement": row(b[0]),
        "c": row(law.c),
        "d_reference": number(law.d_reference),
        "d_measurement": number(float(d[0, 0])),
        "anti_windup": row(law.anti_windup),
        "rest_reference": row(per_reference),
        "rest_measurement": row(resting[0]),
        "columns_of": {
            name: {"b": row(b[i]), "d": number(float(d[i, 0])), "rest": row(resting[i])}
            for i, name in enumerate(readings, start=1)
        },
        "tracking_time_s": None if law.tracking_time_s is None else number(law.tracking_time_s),
        "gains": [
            {"name": identifier(key), "value": number(float(value)), "unit": units.get(key, "-")}
            for key, value in stored.gains.items()
        ],
        "resets": [
            f"read_{identifier(name)}"
            for name in dict.fromkeys(term.reads for term in at_rest if term is not None)
            if identifier(name) not in readings
        ],
        "transfer_functions": [
            {"name": key, "num": row(tf.num), "den": row(tf.den)}
            for key, tf in zip(
                ("reference", "measurement", *(f"measurement_{name}" for name in readings)),
                transfer_functions,
                strict=True,
            )
        ],
    }


def _write_outer(outer: OuterLoop, number: Writer) -> dict[str, Any]:
    """Return the numbers of the outer loop as text, its direction in the gains."""
    return {
        "stiffness": number(outer.direction * outer.stiffness),
        "damping": number(outer.direction * outer.damping),
        "velocity_filter_s": number(outer.velocity_filter_s),
        "pole": number(outer.pole),
        "rate": number(outer.rate),
        "place_unit": outer.place_unit,
        "pushed": not outer.stiffness,
        "shown_stiffness": f"{outer.stiffness:.6g}",
        "shown_damping": f"{outer.damping:.6g}",
    }


def _write_friction(term: FrictionTerm, sample_time_s: float, number: Writer) -> dict[str, str]:
    """Return the compensation of friction as text."""
    return {
        "effort": number(term.effort),
        "speed": number(term.speed),
        "speed_unit": term.speed_unit,
        "share": number(term.share_per_step(sample_time_s)),
        "read": f"read_{identifier(term.reads)}" if term.reads else "",
        "whence": f"the speed of {strip_markup(term.reads)}" if term.reads else "the rate of the reference",
        "percent": f"{100.0 * term.fraction:.3g}",
    }


def _write_gravity(term: GravityTerm, number: Writer) -> dict[str, Any]:
    """Return the compensation of gravity as text."""
    middle, scale, *coefficients = term.numbers
    return {
        "middle": number(middle),
        "scale": number(scale),
        "terms": len(coefficients),
        "coefficients": ", ".join(map(number, coefficients)),
        "read": f"read_{identifier(term.reads)}",
        "output": strip_markup(term.reads),
        "unit": term.unit,
        "percent": f"{100.0 * term.fraction:.3g}",
    }


def _write_ripple(term: RippleTerm, number: Writer) -> dict[str, Any]:
    """Return the compensation of torque ripple as text, every harmonic up to the last."""
    rows = term.harmonics
    return {
        "terms": len(rows),
        "cos": ", ".join(number(cos) for cos, _ in rows),
        "sin": ", ".join(number(sin) for _, sin in rows),
        "per_unit": number(1.0 / term.period),
        "quarter": number(0.5 * math.pi),
        "most": number(MOST_TURNS),
        "sine": ", ".join(map(number, SINE)),
        "cosine": ", ".join(map(number, COSINE)),
        "sine_terms": len(SINE),
        "cosine_terms": len(COSINE),
        "cycles": ", ".join(map(str, term.cycles)),
        "read": f"read_{identifier(term.reads)}",
        "output": strip_markup(term.reads),
        "unit": term.unit,
        "period": f"{term.period:.6g}",
        "percent": f"{100.0 * term.fraction:.3g}",
    }
