"""`seaopt accept`: the logs that are given, the laws of the folder, and what is printed and written."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from seaopt.cli.export import list_broken_requirements, parse_tare
from seaopt.cli.inspect import parse_pairs
from seaopt.cli.progress import show_progress
from seaopt.cli.provenance import FILES, digest_sources
from seaopt.cli.session import SCHEMAS, Session
from seaopt.cli.show import show_sections, show_verdicts
from seaopt.cli.terminal import Amount, Terminal, spell_call
from seaopt.codec import from_content
from seaopt.control import Controller, ForceMPC, MPCSpec, ScheduledController
from seaopt.control.laws.delay import find_drive_delay
from seaopt.control.mpc.stored import TUNE_AGAIN, check_described
from seaopt.errors import ProblemError, SeaoptError
from seaopt.estimation import Fit
from seaopt.files import read_json, to_json, write_json, write_text
from seaopt.formatting import join_words
from seaopt.logs import Quality, write_log
from seaopt.logs.quality.report import QUALITY_SCHEMA
from seaopt.machine import Acceptance, BringUp, Stage, accept, bring_up
from seaopt.machine.acceptance import ACCEPTANCE_SCHEMA, FULL, hash_source, read_origin, take_ranges
from seaopt.machine.bringup.files import write_stage
from seaopt.machine.bringup.page import write_bring_up_page
from seaopt.machine.bringup.plan import BRINGUP_SCHEMA, StoredReference, StoredStage, list_stages
from seaopt.machine.bringup.stages import OF_A_STAGE, slow_down
from seaopt.machine.page.page import write_acceptance_page
from seaopt.machine.response.periods import Played
from seaopt.machine.stepped import Source, stand
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.problem import Problem, certify_problem, tune_problem
from seaopt.problem.loop_logs import read_loop_log
from seaopt.problem.stages import design_mpc, read_law, read_sweep
from seaopt.reporting.responses import Responses
from seaopt.reporting.sections import judge
from seaopt.reporting.sections.data import Commands
from seaopt.robustness import Certificate, JointTuning, linear_controller
from seaopt.signals import REFERENCE, STATUS

FILE, PAGE, QUALITY = FILES["accept"], "acceptance.html", "quality.json"
BRING_UP, PLAN = "bringup", "bringup.json"  # the folder of the stages, and what they are
LATER = 5e-3  # s, by which a drive may be later than twice what it was
AGAIN = "again"  # the folder of accepted logs, for a fit
TABLE = """
# A loop carries noise back into its command: fit such logs by prediction errors, method = "prediction_error" in [fit].
[[experiment]]
name = "{name}"
plant = "{plant}"
log = "{log}"
time = "time [s]"
inputs = {{ {inputs} }}
outputs = {{ {outputs} }}
feedback = true
"""
DELAYED = "delay_s = {{ value = {delay:.6g}, free = true, max = {most:.6g} }}\n"


def accept_logs(
    problem: Path,
    logs: Sequence[Path],
    folder: Path,
    *,
    reference: str | None,
    stage: str | None,
    at: float | None,
    json: bool,
    amount: Amount,
) -> bool:
    """Judge logs under the folder's controller, or that of a stage of its bring-up, write and print what they give;
    return whether it is accepted.
    """
    session = Session(problem, folder)
    law, errors = session.law(), Terminal(stderr=True)
    session.warn_of_design(session.problem.certified_plants().values())
    source = _find_law(session, stage)
    path = _find_file(folder, stage)
    controller = law.controllers[0] if isinstance(law, ScheduledController) else law
    units = _list_units(controller)
    if isinstance(source, ScheduledController):
        units[source.over] = source.unit
    units[STATUS] = "-"
    link = _find_link(session, source)
    plants = (session.problem.design_plant,) if link is None else (session.problem.design_plant, link[0])
    beside = {name: unit for plant in plants for name, unit in plant.outputs.items()}
    with show_progress(errors, "judging the logs", errors.say) as tell:
        tell("reading the logs", 0.0)
        held = () if controller.outer is None else (controller.outer.position,)  # in the stages of the law alone
        read = [read_loop_log(session.problem, log, units, reference, beside=beside, at_rest=held) for log in logs]
        for text in (f"note: {log.source}: {note}" for log in read for note in log.notes):
            errors.wrap(text)
        tell("replaying the law, and comparing the machine with its model", 0.1)
        result = accept(
            source,
            read,
            at=at,
            others=_find_others(session, folder, path),
            uncertainty=session.parameters(),
            ranges=take_ranges(controller, session.problem.ranges, link),
            played=_find_played(folder, stage, path),
            link=link,
        )
    certificate, broken = _find_certificate(folder, stage, path)
    result = replace(result, certificate=certificate, broken=broken, stage=stage, fit_met=session.fit_met())
    content = write(result, session, logs)
    written = write_again(result, session)
    if written:
        tables = join_words([str(path) for path in written if path.suffix == ".toml"])
        errors.wrap(f"note: to fit these logs too, put what is in {tables} into the problem file")
    files = [folder / FILE, folder / PAGE, *written]
    again = session.spell("certify" if stage is None else "bringup")
    commands = Commands(fit=session.spell("fit"), tune=session.spell("tune"), certify=again)
    return _show(result, content, files, json=json, amount=amount, commands=commands)


def _show(
    result: Acceptance | BringUp,
    content: dict[str, Any],
    files: Sequence[Path],
    *,
    json: bool,
    amount: Amount,
    commands: Commands,
) -> bool:
    """Print a result; return whether it is met. `files`: that were written of it; `commands`: to type next."""
    if json:
        sys.stdout.write(to_json(content))
        return result.met
    console = Terminal()
    verdict = judge(result, commands)
    show_verdicts(console, [] if verdict is None else [verdict], verbose=amount == "verbose")
    if amount != "quiet":
        show_sections(console, result, verbose=amount == "verbose")
        console.list_files(files)
    return result.met


def _find_played(folder: Path, stage: str | None, path: Path) -> Played | None:
    """Return how long the reference of a stage is, by the bring-up of a folder; None where it has no such stage."""
    planned = (each for each in _list_planned(folder, path) if each.name == (stage or FULL))
    plan = next(planned, None)
    if plan is None:
        return None
    outer = plan.outer  # of the outer loop, where that has a reference
    return _count_seconds(plan.reference, outer=None if outer is None else _count_seconds(outer.reference))


def _count_seconds(reference: StoredReference, outer: Played | None = None) -> Played:
    """Return how long a planned reference is."""
    return Played(period_s=reference.period_s, lasts_s=reference.lasts_s, outer=outer)


def _list_planned(folder: Path, path: Path) -> tuple[StoredStage, ...] | list[StoredStage]:
    """Return the stages of a folder's bring-up that are of the law of `path`, which may have been tuned again since."""
    try:
        stages = list_stages(read_json(folder / FILES["bringup"], BRINGUP_SCHEMA))
        laws = [read_json(folder / BRING_UP / each.name / path.name, SCHEMAS["tune"]) for each in stages]
        final = read_json(path, SCHEMAS["tune"])
    except SeaoptError:  # none was planned, or it was edited
        return []
    same = ("law", "schedule", "mpc")
    pairs = zip(stages, laws, strict=True)
    return [stage for stage, law in pairs if all(law.get(key) == final.get(key) for key in same)]


def _find_certificate(
    folder: Path, stage: str | None, path: Path
) -> tuple[Literal["met", "failed", "missing"], tuple[str, ...]]:
    """Return what the certificate of a law says, and which requirements are not met; of a stage, and of a full law that
    was not certified by itself, what its bring-up found.
    """
    if stage is None:
        try:
            broken = list_broken_requirements(path, folder / FILES["certify"])
        except SeaoptError:  # it is of another law, or was edited
            broken = None
        if broken is not None:
            return "failed" if broken else "met", tuple(broken)
    planned = _list_planned(folder, path)
    met = [each.met for each in planned if each.name == stage or (stage is None and each.name.startswith(FULL))]
    return ("met" if all(met) else "failed") if met else "missing", ()


def read_besides(session: Session, alone: bool) -> dict[str, Any]:
    """Return what lies in a session's folder besides fit, law and certificate, as it was written, by the commands that
    made it; what is damaged, or of another problem, law or certificate, is left out with a remark. `alone`: also what
    no stage of a whole run makes.
    """
    folder, problem = session.folder, session.problem

    def read_responses(content: dict[str, Any]) -> Responses:
        return Responses.from_dict(content, problem=problem, fit=session.read_besides("fit", Fit.from_dict))

    def read_quality() -> Quality | None:
        path = folder / QUALITY
        return Quality.from_dict(read_json(path, QUALITY_SCHEMA)) if path.exists() else None

    besides = session.read_besides
    kinds: dict[str, Callable[[], Any]] = {
        "sweep": lambda: besides("sweep", partial(read_sweep, problem, session.parameters())),
    }
    if alone:
        kinds |= {
            "frf": lambda: besides("frf", read_responses),
            "inspect": read_quality,
            "accept": lambda: besides("accept", partial(_read_acceptance, session), ACCEPTANCE_SCHEMA),
            "bringup": lambda: besides("bringup", partial(_read_bring_up, session), BRINGUP_SCHEMA),
        }
    found = dict[str, Any]()
    for name, read in kinds.items():
        try:
            found[name] = read()
        except SeaoptError as error:
            session.say(f"left out: {error}")
    return {name: result for name, result in found.items() if result is not None}


def _read_acceptance(session: Session, content: dict[str, Any]) -> Acceptance:
    """Return the acceptance of a folder. Raises ProblemError: its law was tuned, planned or certified again since."""
    path, again, origin = session.folder / FILES["accept"], f"run {session.spell('accept')} again", read_origin(content)
    source = _find_law(session, origin.stage)
    law = stand(source, None if origin.place is None else origin.place.value)
    if not isinstance(source, ForceMPC) and origin.law != hash_source(law):
        raise ProblemError(f"{path}: is of another law than is there now; {again}")
    result = Acceptance.from_dict(content, source)
    certificate, broken = _find_certificate(session.folder, origin.stage, _find_file(session.folder, origin.stage))
    if (result.certificate, result.broken) != (certificate, broken):
        stated = result.certificate or "not known"
        raise ProblemError(f"{path}: the certificate of its law was {stated}, and is {certificate} now; {again}")
    return result


def _read_bring_up(session: Session, content: dict[str, Any]) -> BringUp:
    """Return the bring-up of a folder. Raises ProblemError: a stage has another law than it had."""
    full = _find_law(session, None)
    laws = {stage.name: _find_law(session, stage.name) for stage in list_stages(content)}
    *_, final = laws.values()
    if hash_source(final) != hash_source(full):
        path, again = session.folder / FILES["bringup"], session.spell("bringup")
        raise ProblemError(f"{path}: is of another law than is there now; run {again} again")
    return BringUp.from_dict(content, laws, _find_link(session, full))


def _find_file(folder: Path, stage: str | None) -> Path:
    """Return the file of a folder's law, or of that of a stage of its bring-up."""
    return folder / FILES["tune"] if stage is None else folder / BRING_UP / stage / FILES["tune"]


def _find_law(session: Session, stage: str | None) -> Source:
    """Return the law of a folder, or that of a stage of its bring-up. Raises ProblemError: it has no such stage."""
    if stage is None:
        law = session.law()
        return law if session.problem.mpc is None else session.plan()
    folder = session.folder / BRING_UP
    names = sorted(path.parent.name for path in folder.glob(f"*/{FILES['tune']}"))
    if stage not in names:  # a name, never a path
        remedy = f"there are {', '.join(names)}" if names else f"make it: {session.spell('bringup')}"
        raise ProblemError(f"stage {stage}: {folder} has no stage of this name; {remedy}")
    return _read_stage(session, _find_file(session.folder, stage))


def _read_stage(session: Session, path: Path) -> Source:
    """Return the law of a stage of a bring-up."""
    problem, content = session.problem, read_json(path, SCHEMAS["tune"])
    if problem.mpc is not None:
        stated = {name: content["mpc"]["spec"][name] for name in OF_A_STAGE}
        return design_mpc(replace(problem, mpc=replace(problem.mpc, **stated)), session.parameters())
    return read_law(problem, session.parameters(), content)


def _read_plan(session: Session, content: dict[str, Any]) -> ForceMPC | None:
    """Return the predictive control that a file describes; None where it is none, or other parameters made it."""
    problem = session.problem
    if problem.mpc is None or "mpc" not in content:
        return None
    try:
        spec = from_content(MPCSpec, content["mpc"]["spec"], "mpc.spec", remedy=TUNE_AGAIN)
        plan = design_mpc(replace(problem, mpc=spec), session.parameters())
        check_described(content["mpc"], plan, source="mpc", problem=str(problem.source), remedy=TUNE_AGAIN)
    except (SeaoptError, KeyError, TypeError):
        return None
    return plan


def _find_link(session: Session, source: Source) -> tuple[Plant, ParameterSet] | None:
    """Return the plant whose link a law's outer loop moves, with its values; None without one."""
    if source.outer is None or source.outer.plant not in session.problem.plants:
        return None
    return session.problem.plants[source.outer.plant], session.values()


def _list_units(controller: Controller) -> dict[str, str]:
    """Return the channels that a log of a controller has, with their units."""
    command = controller.command
    outputs = {} if controller.design is None else dict(controller.see(controller.design[0]).outputs)
    names = (*controller.signals, *controller.further)
    read = {name: outputs.get(name, command.reference_unit) for name in names}
    if controller.outer is not None:
        read.setdefault(controller.outer.position, controller.outer.place_unit)
    reference = "" if controller.renders else command.reference_unit  # with an outer loop it may be a place, too
    return {REFERENCE: reference, command.input: command.unit, **read}


def _find_others(session: Session, folder: Path, excluded: Path) -> dict[str, Source]:
    """Return the other controllers that lie in a folder, and two levels below, by their files; predictive control that
    other parameters made by its linear law.
    """
    controllers: dict[str, Source] = {}
    for path in sorted([*folder.glob("*.json"), *folder.glob("*/*.json"), *folder.glob(f"{BRING_UP}/*/*.json")]):
        if path == excluded or not path.is_file():
            continue
        try:
            content = read_json(path, SCHEMAS["tune"])
            kind = ScheduledController if content.get("schedule") else Controller
            plan = _read_plan(session, content)
            controllers[str(path.relative_to(folder))] = kind.read(content) if plan is None else plan
        except SeaoptError:  # another kind of file, or of another version
            continue
    return controllers


def write(result: Acceptance, session: Session, logs: Sequence[Path]) -> dict[str, Any]:
    """Write acceptance.json and its page; return the content of the first."""
    command = spell_call()
    content = result.to_dict() | {"problem": session.problem.source}
    made_from = digest_sources(session.problem, "accept", session.folder)
    write_json(session.folder / FILE, content | {"made_from": made_from})
    write_acceptance_page(
        result,
        session.folder / PAGE,
        title=f"Acceptance: {session.problem.title}",
        files=[Path(session.problem.source)],
        logs=logs,
        command=command,
    )
    return content


def write_again(result: Acceptance, session: Session) -> list[Path]:
    """Write the logs that are of the law as a fit takes them, and beside each the table of its experiment."""
    problem, folder, files = session.problem, session.folder / AGAIN, list[Path]()
    delay = find_drive_delay(result.controller.spec, problem.design_plant, session.parameters())
    for plant, log in result.experiments:
        name = next(name for name, each in problem.plants.items() if each is plant)
        stem = re.sub(r"\W+", "_", Path(log.source).stem) or "log"
        label = f"{stem}_under_{result.stage or 'law'}"
        if folder / f"{label}.csv" in files:  # another log of this name, of another folder
            label += f"_{len(files)}"
        path = write_log(log, folder / f"{label}.csv")
        headers = {head.partition(" ")[0]: head for head in log.to_polars().columns}
        inputs, outputs = (
            ", ".join(f'{each} = "{headers[each]}"' for each in names if each in headers)
            for names in (plant.inputs, plant.outputs)
        )
        place = os.path.relpath(path, problem.folder).replace(os.sep, "/")
        table = TABLE.format(name=label, plant=name, log=place, inputs=inputs, outputs=outputs)
        table += DELAYED.format(delay=delay, most=2.0 * delay + LATER) if delay else ""
        files += [path, write_text(folder / f"{label}.toml", table)]
    return files


def plan_bring_up(
    problem: Path,
    folder: Path,
    *,
    share: float,
    bias: float,
    limits: Sequence[str],
    tare: str | None,
    json: bool,
    amount: Amount,
) -> bool:
    """Plan the stages of the folder's controller, write and print them; return whether each has a certified law."""
    session, zeroing = Session(problem, folder), parse_tare(tare)
    source, errors, controller = session.parameters(), Terminal(stderr=True), _find_law(session, None)

    def tune_stage(fraction: float) -> Source:
        slower = _slow_down(session.problem, fraction)
        if slower.mpc is not None:
            return design_mpc(slower, source)
        tuned = tune_problem(slower, source)
        return tuned.controller if isinstance(tuned, JointTuning) else tuned

    def certify_stage(law: Source) -> Certificate:
        full = law is controller  # as `seaopt certify` does; the stages before are motions of the law alone
        problem = session.problem if full else _stand_still(session.problem, law)
        if isinstance(law, ForceMPC):
            return certify_problem(replace(problem, mpc=law.spec), linear_controller(law), source, thorough=full)
        return certify_problem(problem, law, source, large_signals=full, thorough=full)

    session.warn_of_design(session.problem.certified_plants().values())
    list_broken_requirements(folder / FILES["tune"], folder / FILES["certify"])  # raises: it is of another law
    target = folder / BRING_UP
    with show_progress(errors, "planning the stages", errors.say) as tell:

        def keep_stage(stage: Stage) -> None:
            # What an earlier run planned is not said of these stages.
            (target / PLAN).unlink(missing_ok=True)
            write_stage(stage, target / stage.name, tare=zeroing, fit_met=session.fit_met())
            tell(f"wrote {target / stage.name}")

        plan = bring_up(
            controller,
            session.problem.certified_plants(),
            source,
            ranges=session.problem.ranges,
            share=share,
            bias=bias,
            limits=_parse_limits(limits),
            sensors=session.problem.sensors,
            link=_find_link(session, controller),
            certificate=session.certificate(),
            tune_stage=tune_stage,
            certify_stage=certify_stage,
            keep_stage=keep_stage,
            progress=tell,
        )
    plan = replace(plan, fit_met=session.fit_met())
    content = plan.to_dict()
    made_from = digest_sources(session.problem, "bringup", folder)
    write_json(target / PLAN, content | {"made_from": made_from})
    page = write_bring_up_page(
        plan,
        target / "bringup.html",
        title=f"Bring-up: {session.problem.title}",
        files=[Path(session.problem.source)],
        command=spell_call(),
    )
    files = [target / PLAN, page, *(target / stage.name for stage in plan.stages)]
    commands = Commands(fit=session.spell("fit"))
    return _show(plan, content, files, json=json, amount=amount, commands=commands)


def _slow_down(problem: Problem, fraction: float) -> Problem:
    """Return a problem that asks for a fraction of the bandwidth."""
    spec, mpc, schedule = problem.spec, problem.mpc, problem.schedule
    if schedule is not None and schedule.bandwidth_hz is not None:
        problem = _change_schedule(problem, bandwidth_hz=[fraction * band for band in schedule.bandwidth_hz])
    return replace(
        problem,
        spec=None if spec is None else slow_down(spec, fraction),
        mpc=None if mpc is None else slow_down(mpc, fraction),
    )


def _stand_still(problem: Problem, law: Source) -> Problem:
    """Return what a stage before the full law is certified by: its schedule's variable stands still. Runs of predictive
    control last as much longer as it is slower, and are as many fewer where no probability is asked of them.
    """
    if problem.schedule is not None:
        return _change_schedule(problem, min_rate=None)
    table = problem.robustness
    if problem.mpc is None or table.max_failure_probability is not None:
        return problem
    runs = max(1, round(table.constrained_runs * law.spec.bandwidth_hz / problem.mpc.bandwidth_hz))
    fewer = table.model_copy(update={"constrained_runs": runs})
    return replace(problem, table=problem.table.model_copy(update={"robustness": fewer}))


def _change_schedule(problem: Problem, **changes: Any) -> Problem:
    table = problem.controller_table
    assert table.schedule is not None
    changed = table.model_copy(update={"schedule": table.schedule.model_copy(update=changes)})
    return replace(problem, table=problem.table.model_copy(update={"controller": changed}))


def _parse_limits(texts: Sequence[str]) -> dict[str, float]:
    """Return NAME=VALUE pairs as numbers."""
    limits: dict[str, float] = {}
    for name, text in parse_pairs("--limit", texts).items():
        try:
            limits[name] = float(text)
        except ValueError:
            raise ProblemError(f"--limit {name}={text}: is not a number; type such as --limit {name}=1500") from None
    return limits
