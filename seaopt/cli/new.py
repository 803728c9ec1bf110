"""`seaopt new`: show the columns of some logs, ask what they do not say, write a problem file."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

from seaopt.cli.inspect import parse_pairs
from seaopt.cli.progress import show_progress
from seaopt.cli.terminal import Terminal
from seaopt.errors import ProblemError, SeaoptError
from seaopt.files import check_regular, exists, to_json, write_text
from seaopt.formatting import join_words
from seaopt.problem.proposal import Proposal, Question, propose
from seaopt.problem.reading import check_problem

COLUMN_HEAD = ("column", "role", "unit", "meaning")
GUESS_HEAD = ("guess", "value", "why")


def write_problem(
    logs: Sequence[Path],
    output: Path | None,
    *,
    yes: bool,
    force: bool,
    json: bool,
    time: str | None = None,
    channels: Sequence[str] = (),
    units: Sequence[str] = (),
) -> Path:
    """Write a problem file for logs and return its path; without `yes` what they leave open is asked. Raises
    SeaoptError: a log cannot be read, a file is there already, an option is malformed, or an answer is missing.
    """
    columns = parse_pairs("--channel", channels) | ({"time": time} if time is not None else {})
    look = partial(propose, columns=columns, units=parse_pairs("--unit", units))
    target = _choose_target(logs, output, force=force)
    folder = target.parent
    console, errors = Terminal(stderr=json), Terminal(stderr=True)
    with show_progress(errors, "looking at the logs", errors.say, brief=True) as tell:
        proposal = look(logs, {}, folder, target.stem, tell)
    if yes or json:
        check_problem(proposal.text, target)
        write_text(target, proposal.text)
    else:
        proposal = _interview(console, target, proposal, lambda given: look(logs, given, folder, target.stem))
    if json:
        content = {
            "schema": "seaopt/new/1",
            "file": str(target),
            "columns": [asdict(column) for column in proposal.columns],
            "guesses": {question.key: question.guess for question in proposal.guesses},
            "guessed": list(proposal.guessed),
            "notes": list(proposal.notes),
        }
        sys.stdout.write(to_json(content))
        return target
    if yes:
        _print_columns(console, proposal)
    _print_end(console, proposal, target)
    return target


def _choose_target(logs: Sequence[Path], output: Path | None, *, force: bool) -> Path:
    """Return the file to write; one that is a log, is there already, or is no problem file by its name is refused."""
    for log in logs:
        check_regular(log)
    target = output or (logs[0].with_suffix(".toml") if len(logs) == 1 else logs[0].parent / "problem.toml")
    command = shlex.join(["seaopt", "new", *map(str, logs), "-o"])
    other = shlex.quote(str(target.parent / f"{target.stem or 'problem'}.toml"))
    if target.suffix.lower() != ".toml":
        raise ProblemError(f"{target}: a problem file ends in .toml; type {command} {other}")
    if any(exists(target) and exists(log) and target.samefile(log) for log in logs):
        raise ProblemError(
            f"{target}: is one of the logs, which are never replaced; give another file: -o problem.toml"
        )
    if exists(target) and not force:
        again = f"{command} {shlex.quote(str(target))} --force"
        raise ProblemError(f"{target}: is there already; to replace it type {again}")
    return target


def _interview(
    console: Terminal, target: Path, proposal: Proposal, look: Callable[[Mapping[str, str]], Proposal]
) -> Proposal:
    """Ask question by question, and write the file; an empty answer takes the guess, which stays marked as one unless
    it was a choice. An answer that the file is refused for is asked again.
    """
    done, answers = set[str](), dict[str, str]()
    while True:
        while question := next((question for question in proposal.questions if question.key not in done), None):
            done.add(question.key)
            if question.key == "roles":
                _print_columns(console, proposal)
            answer = _ask(console, question)
            if answer or question.choices:
                answers[question.key] = answer or question.guess
                proposal = look(answers)
        try:
            check_problem(proposal.text, target)
        except SeaoptError as error:
            wrong = next((key for key in reversed(answers) if _is_taken(target, look, answers, key)), None)
            if wrong is None:
                raise
            console.say(f"  {error}", style="red")
            done.remove(wrong)
            answers.pop(wrong)
            proposal = look(answers)
        else:
            write_text(target, proposal.text)
            return proposal


def _is_taken(
    target: Path, look: Callable[[Mapping[str, str]], Proposal], answers: Mapping[str, str], without: str
) -> bool:
    """Tell whether the other commands take the file with a guess in place of one of the answers."""
    try:
        text = look({key: answer for key, answer in answers.items() if key != without}).text
        check_problem(text, target)
    except SeaoptError:
        return False
    return True


def _ask(console: Terminal, question: Question) -> str:
    """Return an answer that counts, "" for the guess. Raises ProblemError: nobody answers."""
    choices = f" ({', '.join(question.choices)})" if question.choices else ""
    console.say(f"{question.text}{choices}", style="bold")
    console.say(f"  Enter: {question.guess}" + (f", {question.why}" if question.why else ""), style="dim")
    doubted = ""
    while True:
        console.say("  > ", end="")
        line = sys.stdin.readline()
        if not line:
            raise ProblemError(f'nobody answers "{question.text}"; add --yes to take the best guess of each')
        if not line.strip():
            return ""
        try:
            answer = question.read(line)
            if not (doubt := question.doubt(answer)) or answer == doubted:
                return answer
            doubted = answer
            console.say(f"  {doubt}: type it again to keep it, or correct it", style="red")
        except ProblemError as error:
            console.say(f"  {error}", style="red")


def _print_columns(console: Terminal, proposal: Proposal) -> None:
    """Print the role of each column."""
    for log in dict.fromkeys(column.log for column in proposal.columns):
        console.say(f"{log}:")
        rows = [
            (row.column, row.role or "–", row.unit, row.description + (" (guessed)" if row.doubt else ""))
            for row in proposal.columns
            if row.log == log
        ]
        console.tabulate(rows, COLUMN_HEAD)


def _describe_guesses(proposal: Proposal) -> list[tuple[str, str, str]]:
    """Return a row for each of the guesses that results rest on: what it is, what was taken, and why."""
    rows = {question.entry: (question.label, question.guess, question.why) for question in proposal.questions}
    for row in proposal.columns:
        rows[f"role of {row.column}"] = (f'Column "{row.column}"', row.role, row.doubt)
    return [rows.get(name, (name, "", "see its line in the file")) for name in proposal.guessed]


def _print_end(console: Terminal, proposal: Proposal, target: Path) -> None:
    """Print what was written, what of it is a guess, and the command to type next."""
    console.say(f"wrote {target}", soft_wrap=True)
    if proposal.guessed:
        count = len(proposal.guessed)
        values = "1 value is a guess" if count == 1 else f"{count} values are guesses"
        console.wrap(f'{values}, listed in every verdict until removed from "guessed":')
        console.tabulate(_describe_guesses(proposal), GUESS_HEAD)
    if proposal.open:
        console.say("To be fitted, or for you to choose:")
        rows = [(question.label, question.guess, question.why) for question in proposal.open]
        console.tabulate(rows, ("quantity", "value", "why"))
    for note in proposal.notes:
        console.wrap(f"note: {note}")
    out = shlex.quote(str(target.with_suffix("")))
    console.say(f"next: seaopt run {shlex.quote(str(target))} -o {out}", soft_wrap=True)
    if proposal.single:
        console.wrap(
            f"then: record the test of {join_words(proposal.single)} once more at half the amplitude, and uncomment "
            "that log in the file; one amplitude alone hides what the model lacks"
        )
