"""The controller of a folder of results, as C and as gains."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from seaopt.cli.provenance import FILES, digest
from seaopt.cli.session import OWN_LAW, SCHEMAS
from seaopt.cli.terminal import Amount, Terminal
from seaopt.codec import from_content, to_content
from seaopt.control import Controller
from seaopt.control.deploy.c_text import strip_markup
from seaopt.control.deploy.export import export, export_beside, read_guard
from seaopt.control.deploy.target import Tare
from seaopt.control.laws.plausibility import Agreement, GateSpec, PlausibilityGate
from seaopt.control.laws.realisation import choose_limit, find_raised_limit
from seaopt.control.laws.verdict import join_limits
from seaopt.control.mpc.export import SOURCES, set_gate, set_heat, write_code
from seaopt.control.mpc.stored import read_code
from seaopt.errors import ControlError, ProblemError
from seaopt.files import exists, read_json, to_json
from seaopt.plants.motor.heat_guard import HeatGuard
from seaopt.reporting.sections.verdict import UNMET


def export_controller(
    results: Path,
    target: Path,
    json: bool,
    derate_margin_K: float | None = None,
    amount: Amount = "usual",
    gate: Mapping[str, Any] | None = None,
    **options: Any,
) -> bool:
    """Write the controller of `results` to `target`, say what was written, and tell whether it may be used. It may
    where it is feasible, on a fit that is met, and the certificate beside it passed. Raises SeaoptError: there is no
    controller, it was edited or made from another fit than the one beside it, or it cannot be written.
    """
    path, certificate = results / FILES["tune"], results / FILES["certify"]
    of_problem = f"PROBLEM -o {shlex.quote(str(results))}"
    if not exists(path):
        raise ProblemError(f"{path}: no such file; give the folder of results, or make them: seaopt run {of_problem}")
    content = read_json(path, SCHEMAS["tune"], remedy=f"run seaopt tune {of_problem}{OWN_LAW}")
    fitted = results / FILES["fit"]
    expected = content["made_from"].get(fitted.name)
    if expected is not None and fitted.exists() and digest(fitted) != expected:
        raise ProblemError(f"{path}: was tuned with another fit than {fitted.name} beside it; run seaopt tune again")
    if derate_margin_K is not None and options["derate"] is False:
        raise ProblemError("--no-derate and --derate-margin: type one of them")
    if derate_margin_K is not None:  # without a guard `export` says what is missing
        options["derate"] = read_guard(content, derate_margin_K) or True
    options["gate"] = choose_gate(content, gate or {}, options)
    failed = list_broken_requirements(path, certificate)
    options["uncertified"] = (
        "seaopt certify was not run on this law"
        if failed is None
        else f"the certificate of this law FAILED: {', '.join(failed)}"
        if failed
        else ""
    )
    write = _write_plan if "mpc" in content else export
    written = [str(file) for file in write(content, target, **options)]
    feasible, fit_met = content["feasible"], content.get("fit_met", True) is True
    met = feasible and fit_met and failed == []
    if limit := _find_raised_limit(content, options):
        what, says = ("designed", "figures say") if failed is None else ("certified", "certificate says")
        Terminal(stderr=True).wrap(
            f"warning: this limit is above the one that the controller was {what} with, {limit}: its {says} nothing "
            "about larger commands; raise the limit in the problem file, then tune and certify again"
        )
    if failed is not None and (typed := _list_typed(content, options)):
        Terminal(stderr=True).wrap(
            f"warning: {' and '.join(typed)} of this export: the certificate's simulated runs are of the law as the "
            "problem file has it; write gate and derate into its [controller], then tune and certify again"
        )
    if json:
        result = {
            "schema": "seaopt/export/1",
            "met": met,
            "feasible": feasible,
            "fit_met": fit_met,
            "certified": failed == [],
            "certificate_failed": failed or [],
            "files": written,
        }
        sys.stdout.write(to_json(result))
        return met
    console = Terminal()
    schedule = content["schedule"]
    missed = [_join_missed(content)] if schedule is None else schedule["broken"]
    for good, text in (
        (fit_met, UNMET),
        (feasible, "; ".join(missed)),
        (failed == [], f"not certified: {options['uncertified']}"),
    ):
        if not good:
            console.wrap(f"not met: {text}")
    if failed is None:
        console.wrap(f"next: type seaopt certify {of_problem}")
    if amount != "quiet" or met:
        console.list_files(written)
    for note in content.get("notes") or () if amount == "verbose" else ():
        console.wrap(f"note: {note}", indent=2)
    return met


def parse_tare(stated: str | None) -> Tare | None:
    """Return the tare that is typed, as NOISE:LIMIT; None for none."""
    if stated is None:
        return None
    try:
        noise, limit = (float(each) for each in stated.split(":"))
        return Tare(noise=noise, limit=limit)
    except (ValueError, ControlError):
        raise ProblemError(
            f"--tare {stated}: is not the std of the force and the largest zero; type such as --tare 2:50"
        ) from None


def _list_typed(content: Mapping[str, Any], options: Mapping[str, Any]) -> list[str]:
    """Return the parts of the law that options make another than that of the certificate."""
    gate = options["gate"]
    if "mpc" in content:  # whose guards are among the numbers of its code
        code = read_code(content["mpc"]["code"])
        other = gate is not None and set_gate(code, gate or None, content["sample_time_s"]).to_dict() != code.to_dict()
        derates = code.heat is not None
    else:
        guards = content.get("guards") or {}
        other = gate is not None and (to_content(gate) if gate else None) != guards.get("gate")
        derates = guards.get("derate", False)
    differs = {
        "the gate": other,
        "the heat guard": options["derate"] is not None and options["derate"] != derates,
        "the anti-windup": options["tracking_time_s"] is not None,
    }
    return [name for name, differ in differs.items() if differ]


def choose_gate(
    content: Mapping[str, Any], gate: Mapping[str, Any], options: Mapping[str, Any]
) -> PlausibilityGate | Literal[False] | None:
    """Return the gate that is typed; False for none, None for that of the controller. `gate` has the keys of
    [controller.gate], None where nothing is typed, its range as LOW:HIGH, and `leave_out`.
    """
    typed = {name: value for name, value in gate.items() if value is not None and value is not False}
    leave_out, ends = typed.pop("leave_out", False), typed.pop("range_N", None)
    if leave_out and ends is not None:
        raise ProblemError("--no-gate and --gate: type one of them")
    if ends is None:
        if typed:
            option = {"max_step_N": "max-step", "max_held": "max-held", "ramp_s": "ramp"}[next(iter(typed))]
            raise ProblemError(f"--gate-{option}: no gate is typed; add --gate LOW:HIGH")
        return False if leave_out else None
    try:
        low, high = (float(end) for end in ends.split(":"))
    except ValueError:
        raise ProblemError(f"--gate {ends}: is not a range; type --gate LOW:HIGH, such as -4000:4000") from None
    try:
        spec = GateSpec(range_N=(low, high), **typed)
    except ControlError as error:
        raise ProblemError(f"--gate: {error}") from error
    step = _find_own_step(content) if spec.max_step_N is None else spec.max_step_N
    limit = _find_limit(content, options)
    if step is None:
        raise ProblemError(
            "--gate: controller.json does not say how far the plant moves in a sample; type --gate-max-step, or write "
            f"[controller.gate] with range_N = [{low:g}, {high:g}] in the problem file: seaopt tune computes it then"
        )
    if limit is None:
        raise ProblemError("--gate: the command has no limit from which it goes to zero; type --current-limit")
    agreement, source = _read_own_gate(content).get("agreement"), "controller.json: guards.gate.agreement"
    return PlausibilityGate(
        range_N=(low, high),
        max_step_N=step,
        max_held=spec.max_held,
        ramp_per_s=limit / spec.ramp_s,
        agreement=agreement and from_content(Agreement, agreement, source, remedy="tune again"),
    )


def _find_own_step(content: Mapping[str, Any]) -> float | None:
    """Return how far a reading moves in a sample by the controller's own gate; None without one."""
    if "mpc" in content:
        return read_code(content["mpc"]["code"]).numbers.get("step")
    return _read_own_gate(content).get("max_step_N")


def _read_own_gate(content: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the controller's own gate, as it is written; empty without one."""
    return (content.get("guards") or {}).get("gate") or {}


def _find_limit(content: Mapping[str, Any], options: Mapping[str, Any]) -> float | None:
    """Return the limit of the command of the exported law; None where it has none."""
    if "mpc" in content:
        return read_code(content["mpc"]["code"]).numbers["limit"]
    from seaopt.control.scheduling.stored import read_laws  # deferred: pydantic

    stored, *_ = read_laws(content)
    limit = options["command_limit"] if options["current_limit_A"] is None else options["current_limit_A"]
    limit = choose_limit(stored.command, stored.spec, limit)
    return None if limit is None or not math.isfinite(limit) else limit


def _find_raised_limit(content: Mapping[str, Any], options: Mapping[str, Any]) -> str:
    """Return the limit that the controller was designed with, where an option asks for a higher one; else ""."""
    limits = [options[name] for name in ("current_limit_A", "command_limit") if options.get(name) is not None]
    if not limits:
        return ""
    from seaopt.control.scheduling.stored import read_laws  # deferred: pydantic

    stored, *_ = read_laws(content)
    return find_raised_limit(stored.command, stored.spec, limits[0])


def _join_missed(content: Mapping[str, Any]) -> str:
    """Return the limits that the law of a controller.json misses."""
    return join_limits(Controller.read(content).binding)


def _write_plan(content: Mapping[str, Any], target: Path, **options: Any) -> tuple[Path, ...]:
    """Write the C code of predictive control; limits and names are those that it was designed with."""
    if not options.pop("allow_infeasible", False) and not content["feasible"]:
        raise ProblemError(
            f"the controller misses {_join_missed(content)}; tune one that does not, or type --allow-infeasible"
        )
    gate, derate, uncertified = options.pop("gate"), options.pop("derate"), options.pop("uncertified")
    beside = {name: options.pop(name) for name in ("log_rows", "tare")}
    typed = {name for name, value in options.items() if value not in (None, False) and name != "precision"}
    if typed - {"name"} or options["name"] != "force_law":
        raise ProblemError(
            "the C code of predictive control has the limits and the names that it was designed with: force_mpc_...; "
            "leave out all options but --precision, --derate, --log-rows, --tare and those of --gate"
        )
    if options["precision"] not in ("double", "float"):
        raise ProblemError(f'precision = "{options["precision"]}" is not known; use "double" or "float"')
    code = read_code(content["mpc"]["code"])
    if gate is not None:
        code = set_gate(code, gate or None, content["sample_time_s"])
    if derate is not None:
        guard = derate if isinstance(derate, HeatGuard) else read_guard(content)
        if derate and guard is None:
            raise ProblemError("--derate: nothing is known of the motor's heat; tune on a plant with the part thermal")
        code = set_heat(code, guard if derate else None)
    folder = write_code(
        code, target, single_precision=options["precision"] == "float", uncertified=strip_markup(uncertified)
    )
    made = export_beside(Controller.read(content), folder, precision=options["precision"], **beside)
    return (*(folder / name for name in (*SOURCES, "force_mpc_data.h", *code.parts)), *made)


def list_broken_requirements(controller: Path, certificate: Path) -> list[str] | None:
    """Return the requirements that the certificate of this controller says are not met; None without a certificate.
    Raises SeaoptError: the certificate was edited or written by hand, or is of another controller.
    """
    from seaopt.robustness.certificate.stored import read_requirements  # deferred: pydantic

    if not certificate.is_file():
        return None
    again = f"run seaopt certify PROBLEM -o {shlex.quote(str(certificate.parent))}, or delete it"
    content = read_json(certificate, SCHEMAS["certify"], remedy=again)
    if content["made_from"].get(controller.name) != digest(controller):
        raise ProblemError(f"{certificate}: is not of {controller.name} beside it; {again}")
    rows = read_requirements(content, str(certificate))
    return list(dict.fromkeys(row.name for row in rows if not row.met))
