"""`seaopt accept`: the logs that are given, the laws of the folder, and what is printed and written."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from seaopt.cli.progress import show_progress
from seaopt.cli.provenance import FILES
from seaopt.cli.session import SCHEMAS, Session
from seaopt.cli.show import show_sections, show_verdicts
from seaopt.cli.terminal import Amount, Terminal
from seaopt.control import Controller
from seaopt.control.laws.stored import read_controller
from seaopt.errors import ProblemError, SeaoptError
from seaopt.files import read_json, to_json, write_json
from seaopt.machine import Acceptance, accept
from seaopt.machine.page import write_acceptance_page
from seaopt.problem.loop_logs import REFERENCE, read_loop_log
from seaopt.reporting.sections import judge

FILE, PAGE = "acceptance.json", "acceptance.html"


def accept_logs(
    problem: Path, logs: Sequence[Path], folder: Path, *, reference: str | None, json: bool, amount: Amount
) -> bool:
    """Judge logs under the folder's controller, write and print what they give; return whether it is accepted."""
    session = Session(problem, folder)
    controller, errors = _take_controller(session), Terminal(stderr=True)
    units = _list_units(controller)
    with show_progress(errors, "judging the logs", errors.say) as tell:
        tell("reading the logs", 0.0)
        read = [read_loop_log(session.problem, log, units, reference) for log in logs]
        result = accept(
            controller,
            read,
            others=_find_others(folder, controller),
            uncertainty=session.parameters(),
            ranges=session.problem.ranges,
        )
    content = write(result, session, logs)
    if json:
        sys.stdout.write(to_json(content))
        return result.met
    console = Terminal()
    verdict = judge(result)
    show_verdicts(console, [] if verdict is None else [verdict], verbose=amount == "verbose")
    if amount != "quiet":
        show_sections(console, result, verbose=amount == "verbose")
        console.list_files([folder / FILE, folder / PAGE])
    return result.met


def _take_controller(session: Session) -> Controller:
    law = session.law()
    if not isinstance(law, Controller) or session.problem.mpc is not None:
        raise ProblemError(
            f"{session.problem.source}: acceptance takes one law, and this problem has a schedule or predictive "
            "control; freeze the place, and give that law's problem"
        )
    return law


def _list_units(controller: Controller) -> dict[str, str]:
    """Return the channels that a log of a controller has, with their units."""
    command = controller.command
    outputs = {} if controller.design is None else dict(controller.see(controller.design[0]).outputs)
    further = () if controller.compensation is None else controller.compensation.reads
    names = (*controller.signals, *further)
    read = {name: outputs.get(name, command.reference_unit) for name in names}
    return {REFERENCE: command.reference_unit, command.input: command.unit, **read}


def _find_others(folder: Path, controller: Controller) -> dict[str, Controller]:
    """Return the other controllers that lie in a folder, and one level below, by their files."""
    others: dict[str, Controller] = {}
    for path in sorted([*folder.glob("*.json"), *folder.glob("*/*.json")]):
        if path == folder / FILES["tune"] or not path.is_file():
            continue
        try:
            stored = read_controller(read_json(path, SCHEMAS["tune"]))
        except SeaoptError:  # another kind of file, or of another version
            continue
        others[str(path.relative_to(folder))] = Controller(**stored, achieved=controller.achieved)
    return others


def write(result: Acceptance, session: Session, logs: Sequence[Path]) -> dict[str, Any]:
    """Write acceptance.json and its page; return the content of the first."""
    command = shlex.join(["seaopt", *sys.argv[1:]])
    content = result.to_dict() | {"problem": session.problem.source}
    write_json(session.folder / FILE, content)
    files = [Path(session.problem.source), *logs]
    title = f"Acceptance: {session.problem.title}"
    write_acceptance_page(result, session.folder / PAGE, title=title, files=files, command=command)
    return content
