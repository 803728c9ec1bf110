r"""A problem file for logs that nobody has described yet, from what they show, guesses, and answers to questions.

`propose` knows no terminal. It takes the answers that are there, guesses the others, and returns the file's text with
the questions it had; whoever asks them calls it again with one answer more, until none is open:

>>> import tempfile
>>> folder = Path(tempfile.mkdtemp())
>>> _ = (folder / "knee.csv").write_text("t [s],I [A],tau_s [N m]\n0,0,0\n0.01,1,2\n0.02,0.5,3\n")
>>> proposal = propose([folder / "knee.csv"], {"N": "100"}, folder)
>>> [question.key for question in proposal.questions][:3], "N     = 100" in proposal.text
(['roles', 'link:knee.csv', 'N'], True)
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from seaopt.errors import LogError, ProblemError
from seaopt.files import check_name
from seaopt.formatting import format_count, join_words
from seaopt.logs.quality.clock import assess_clock
from seaopt.logs.reading.vocabulary import COUNTS, UNITS_OF, is_m_open, read_header
from seaopt.problem.proposal.actuators import Facts, propose_linear, propose_rotary
from seaopt.problem.proposal.described_log import GEARED, DescribedLog, doubt_clock, list_single, make_table
from seaopt.problem.proposal.problem_text import write_problem_text
from seaopt.problem.proposal.questions import Interview, Question, name_entry
from seaopt.problem.proposal.roles import (
    DESCRIPTIONS,
    FOLLOWS,
    INPUTS,
    LINEAR_OUTPUTS,
    OF_INPUT,
    OF_OUTPUT,
    ROTARY_OUTPUTS,
    Assignment,
    assign,
    guess_unit,
    is_held,
    is_rotary,
)
from seaopt.problem.proposal.stated import Stated
from seaopt.problem.proposal.survey import ENOUGH as FEW
from seaopt.problem.proposal.survey import LogSurvey, SurveyedColumn, regress, slow_sign, survey_log
from seaopt.problem.proposal.traits import OUTLIERS, find_traits
from seaopt.progress import Progress, count_off, divide, ignore
from seaopt.records import record
from seaopt.units import factor, same_dimension

READING, LOOKING = 1.0, 1.0  # shares of the time
UNITS = {  # that a column of a role may be in; the others are angles
    "I": ("A", "mA"), "torque": ("N m", "mN m"), "V": ("V", "mV"), "duty": ("-", "percent"), "F1": ("N", "kN"),
    "F2": ("N", "kN"), "q": ("m", "mm", "um"), "tau_s": ("N m", "mN m"),
}  # fmt: skip
FULL_DUTIES = (1, 100, 255, 885, 1000, 1023, 4095, 32767)  # of registers, for a full duty
POSITIONS = {"q", "screw", "phi", "theta_m", "theta_l"}
LINK_END = re.compile(r"[\s_.\-/]l$")  # of a name, beside one that ends in m: the link, and the motor


@record
class ProposedColumn:
    """A column of a log with its role; `doubt` says what of it is a guess."""

    log: str
    column: str
    role: str
    unit: str
    description: str
    doubt: str


@record
class Proposal:
    """A problem file's text, the roles of the columns, all questions, and the guesses for those without an answer.

    `guessed` are the guesses that results rest on, as the file's key of that name has them; `notes` are remarks on what
    the logs show; `single`: the last log of each plant whose logs have one amplitude: the file asks for another.
    """

    text: str
    columns: tuple[ProposedColumn, ...]
    questions: tuple[Question, ...]
    guesses: tuple[Question, ...]
    guessed: tuple[str, ...]
    notes: tuple[str, ...]
    single: tuple[str, ...]

    @property
    def open(self) -> tuple[Question, ...]:
        """The guesses that no result rests on: what a fit finds, and what is chosen, as the bandwidth is."""
        return tuple(guess for guess in self.guesses if guess.entry not in self.guessed and guess.key != "roles")


@np.errstate(over="ignore", invalid="ignore")  # of a column with numbers near the largest float
def propose(
    logs: Sequence[Path],
    answers: Mapping[str, str],
    folder: Path,
    title: str = "",
    progress: Progress = ignore,
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
) -> Proposal:
    """Return a problem file for logs; `answers` are texts by the keys of `Question`, `folder` is the file's. `columns`
    and `units` are those of roles that are known, "time" among them. `progress` is called before each log is read, and
    before each is looked at. Raises SeaoptError: a log cannot be read or lies outside the folder, or an answer is not
    one.
    """
    interview, stated = Interview(answers), Stated(columns=columns or {}, units=units or {})
    reading, looking = divide(progress, READING, LOOKING)
    surveys = [_survey(path, interview, stated) for path in count_off(logs, "reading log", reading)]
    stated.check(surveys)
    turns, doubt = is_rotary([column for survey in surveys for column in survey.columns])
    if stated.rotary is not None:
        turns = stated.rotary
    elif doubt:
        label, guess = "Is the actuator rotary (a gear) or linear (a screw or a belt)", "rotary" if turns else "linear"
        turns = interview.ask("actuator", label, guess, doubt, ("rotary", "linear")) == "rotary"
    assignments = [_assign(survey, interview, turns, stated) for survey in surveys]
    pairs = list(zip(surveys, assignments, strict=True))
    described = [
        _describe_log(*pair, interview, folder, at, stated)
        for at, pair in enumerate(count_off(pairs, "looking at log", looking))
    ]
    progress(format_count(len(logs), "log"), 1.0)
    if len({log.roles.input for log in described}) > 1:
        names = join_words([f"{log.survey.name} ({log.roles.input})" for log in described])
        raise ProblemError(f"{names} are driven by different inputs; write a problem file for each: seaopt new LOG")
    facts = Facts(
        input=described[0].roles.input,
        places=tuple(dict.fromkeys(log.plant for log in described)),
        outputs=frozenset(role for log in described for role in log.outputs),
        gear_ratio=_find_ratio(described),
    )
    actuator = (propose_rotary if turns else propose_linear)(interview, facts)
    text = write_problem_text(title or described[0].survey.path.stem, described, actuator, interview)
    return Proposal(
        text=text,
        columns=tuple(row for log in described for row in _list_columns(log)),
        questions=tuple(interview.questions),
        guesses=tuple(question for question in interview.questions if question.key not in interview.answers),
        guessed=tuple(interview.list_guessed()),
        notes=(
            *(note for log in described for note in _list_notes(log)),
            *(f"{name_entry(key)}: {doubt}; check its unit" for key, doubt in interview.list_doubts().items()),
        ),
        single=tuple(log.file for log in list_single(described)),
    )


def _survey(path: Path, interview: Interview, stated: Stated) -> LogSurvey:
    key = f"time:{path.name}"
    survey = survey_log(path, stated.clock or interview.answers.get(key), stated.unit_of)
    if stated.clock is not None:
        survey = replace(survey, clocks=(stated.clock,))
    if len(survey.clocks) > 1 and survey.clock is not None:
        interview.ask(
            key, f"Which column of {path.name} is the time", survey.clock.name, "the first of them", survey.clocks
        )
    columns = tuple(_settle_m(column, survey, interview) for column in survey.columns)
    return replace(survey, columns=columns)


def _settle_m(column: SurveyedColumn, survey: LogSurvey, interview: Interview) -> SurveyedColumn:
    """Return a column of which the m at the end of its name is settled: beside signs of a gear it is the motor."""
    if not is_m_open(column.header):
        return column
    geared = any(column.header.quantity == "torque" or LINK_END.search(column.name) for column in survey.columns)
    meaning = (
        "motor"
        if geared
        else interview.ask(
            f"m:{column.name}",
            f'Is "{column.name}" in metres',
            "metres",
            "no column is a torque, nor of a link",
            ("metres", "motor"),
            detail=", or an angle of the motor?",
        )
    )
    return replace(column, header=read_header(column.name, metres=False)) if meaning == "motor" else column


def _assign(survey: LogSurvey, interview: Interview, turns: bool, stated: Stated) -> Assignment:
    """Return the roles of a log's columns, which are asked for one by one where the guess is not right."""
    roles = assign(survey, rotary=turns, given=stated.roles)
    whole = interview.ask("roles", "Are these the right columns", "yes", "by names and samples", ("yes", "no"))
    if whole == "yes":
        return _check_outputs(roles, survey)
    assigned = {column.name: role for role, column in roles.columns.items()}
    choices = (*INPUTS, *(ROTARY_OUTPUTS if turns else LINEAR_OUTPUTS), "none")
    answered = {
        column.name: stated.roles.get(column.name)
        or interview.ask(
            f"role:{column.name}",
            f'What is column "{column.name}"',
            assigned.get(column.name, "none"),
            "by its name",
            choices,
        )
        for column in survey.columns
    }
    chosen = [role for role in answered.values() if role in INPUTS]
    if len(chosen) != 1:
        raise ProblemError(f"{survey.name}: {len(chosen)} columns are inputs; give exactly one of {', '.join(INPUTS)}")
    answers = {name: "" if role == "none" else role for name, role in answered.items()}
    return _check_outputs(assign(survey, rotary=turns, given=answers), survey)


def _check_outputs(roles: Assignment, survey: LogSurvey) -> Assignment:
    """Refuse a log of an input alone."""
    if not roles.outputs:
        raise LogError(
            f"{survey.name}: nothing is measured besides the input, {roles.columns[roles.input].name}; log a force, a "
            "torque or an angle as well, or put it into this file if another file of the test has it"
        )
    return roles


def _describe_log(
    survey: LogSurvey, roles: Assignment, interview: Interview, folder: Path, at: int, stated: Stated
) -> DescribedLog:
    """Return a log with units, clock and plant."""
    unit, sure = survey.clock_unit()
    key = f"unit:{survey.clock.name}" if survey.clock is not None else ""
    if survey.clock is not None and not sure:
        unit = interview.ask(
            key, f'Unit of the time "{survey.clock.name}"', unit, "by the size of its steps", ("s", "ms", "us", "ns")
        )
    clock = None
    if survey.clock is None:
        label, why = f"Sample rate of {survey.name}", "the file has no column of times"
        rate = interview.number(f"rate:{survey.name}", label, 1000.0, why, detail=", which has no clock, in Hz")
    else:
        clock = assess_clock(survey.clock.values * factor(unit, "s"), str(survey.path))
        rate = clock.rate_hz
    units, scales = _ask_units(roles, interview, stated)
    log = DescribedLog(
        survey=survey,
        roles=roles,
        name=_spell_name(survey.path.stem, at),
        file=_relative(survey.path, folder),
        plant="",
        units=units,
        scales=scales,
        time_unit=unit,
        clock=clock,
        rate_hz=rate,
    )
    log = replace(log, scales=scales | _find_signs(log))
    log = replace(log, plant=_ask_link(log, interview))
    table = make_table(log, log.outputs)
    if table is None:
        return log
    positions = [name for name in log.outputs if name in POSITIONS]
    is_command = not roles.columns[roles.input].header.measured
    return replace(log, traits=find_traits(table, roles.input, log.outputs, positions, is_command=is_command))


def _list_notes(log: DescribedLog) -> Iterator[str]:
    """Yield remarks on what a log shows."""
    name, traits = log.survey.name, log.traits
    count = log.survey.columns[0].values.size
    if count < FEW:
        yield f"{name}: {count} samples are few to tell columns and units by, or to fit; check the roles"
    if log.survey.law:
        yield (
            f"{name}: was logged under a law, so that its input answers the noise of the sensor, and acts later than "
            "its row: seaopt accept writes it as an experiment to fit"
        )
    if traits.unexcited is not None:
        yield f"{name}: {replace(traits.unexcited, channel=log.roles.columns[log.roles.input].name).sentence}"
    if traits.delay_s is not None:
        yield f"{name}: the outputs respond about {1e3 * traits.delay_s:.2g} ms late: delay_s is fitted"
    if traits.outliers >= OUTLIERS:
        yield f'{name}: {traits.outliers} samples are outliers: loss = "huber" tolerates them'
    if traits.standing:
        yield (
            f"{name}: {join_words(traits.standing)} stands still again and again: friction sticks (the file has lines "
            "for it), or a sensor stops (seaopt inspect)"
        )


def _relative(path: Path, folder: Path) -> str:
    check_name(path.name, "a problem file cannot name it: rename the log", ProblemError)
    try:
        return path.resolve().relative_to(folder.resolve()).as_posix()
    except ValueError:
        beside = shlex.join(["seaopt", "new", str(path), "-o", str(path.parent / "problem.toml")])
        raise ProblemError(
            f"{path}: is not in the folder of the problem file, {folder}; write that beside the log: {beside}"
        ) from None


def _spell_name(stem: str, at: int) -> str:
    """Return an experiment's name: letters, digits, _ and -, the first a letter."""
    text = "".join(letter if letter.isascii() and (letter.isalnum() or letter in "_-") else "_" for letter in stem)[:60]
    return text if text[:1].isalpha() else f"log{at + 1}_{text}".rstrip("_")


def _ask_units(roles: Assignment, interview: Interview, stated: Stated) -> tuple[dict[str, str], dict[str, float]]:
    """Return each role's unit, and what its numbers are multiplied with besides."""
    units: dict[str, str] = {}
    scales: dict[str, float] = {}
    for role, column in roles.columns.items():
        unit, why = guess_unit(role, column)
        _check_unit(role, unit, column.name, stated)
        if why:
            choices, detail = UNITS.get(role, ("rad", "deg", COUNTS)), f" ({DESCRIPTIONS[role]})?"
            unit = interview.ask(f"unit:{column.name}", f'Unit of "{column.name}"', unit, why, choices, detail=detail)
        si = UNITS_OF.get(OF_INPUT.get(role) or OF_OUTPUT[role], "")
        if unit == COUNTS and si != "rad":
            label, why = f'One step of "{column.name}"', "full scale over its steps; take it from the manual"
            unit, scales[role] = si, interview.number(f"counts:{column.name}", label, 1e-3, why, detail=f", in {si}")
        elif unit == COUNTS:
            turn = interview.number(
                f"counts:{column.name}", f'Steps of "{column.name}" for a whole turn', 4096.0, "a common encoder's"
            )
            unit, scales[role] = "rad", 2.0 * math.pi / turn
        elif role == "duty" and unit != "percent" and column.largest > 1.5:
            full = next((duty for duty in FULL_DUTIES if duty >= column.largest), FULL_DUTIES[-1])
            scales[role] = 1.0 / interview.number(
                f"duty:{column.name}", f'Number of "{column.name}" at full duty', full, "the next usual one"
            )
            unit = "-"
        elif role == "torque":  # of a current whose constant is 1 N m/A
            scales[role], unit = factor(unit, "N m"), "A"
        units[role] = unit
    return units, scales


def _check_unit(role: str, unit: str, column: str, stated: Stated) -> None:
    """Refuse a unit that is not one of the role that the user gave a column."""
    wanted = UNITS_OF.get(OF_INPUT.get(role) or OF_OUTPUT[role], "")
    if column in stated.roles and wanted and unit != COUNTS and not same_dimension(unit, wanted):
        option = f"--unit {role}={wanted.replace(' ', '')}"
        raise LogError(f'column "{column}" is in {unit}, and {role} is in {wanted}; correct it: {option}')


def _find_signs(log: DescribedLog) -> dict[str, float]:
    """Return scales that turn a sensor round which falls as the effort rises; the first effort counts as right."""
    signals = log.signals
    effort = next((role for role in ("tau_s", "F1", "F2") if role in signals), None)
    if effort is None or log.survey.clock is None:
        return {}
    # The motor's place follows the effort only where the link is held; elsewhere no sign is sure.
    following = [
        role
        for role in ("F2", "theta_m", "screw", "q")
        if role in signals and role != effort and regress(signals[role], signals[effort])[1] > FOLLOWS
    ]
    falling = [role for role in following if slow_sign(signals[effort], signals[role], log.rate_hz) < 0]
    return {role: -log.scales.get(role, 1.0) for role in falling}


def _ask_link(log: DescribedLog, interview: Interview) -> str:
    """Return which plant a log was recorded on: held, moving, or hanging."""
    roles, key = log.roles, f"link:{log.survey.name}"
    if not roles.rotary:
        return "swing" if "phi" in roles.columns else "held"
    is_locked, why = is_held(roles, log.si_scale("theta_l"), log.si_scale("theta_m"))
    return interview.ask(
        key,
        f"Link in {log.survey.name}",
        "held" if is_locked else "free",
        why,
        ("held", "free", "hanging"),
        detail=": is it held, free, or hanging (gravity pulls it back)?",
    )


def _find_ratio(logs: Sequence[DescribedLog]) -> float | None:
    """Return the gear ratio that the motion of motor and link suggests; 1 of a servo that reports one side alone."""
    for log in logs:
        signals = log.signals
        if "theta_m" in signals and "theta_l" in signals and log.plant != "held":
            slope, share = regress(signals["theta_m"], signals["theta_l"])
            if share > FOLLOWS and GEARED[0] < slope < GEARED[1]:
                return float(round(slope)) if abs(slope - round(slope)) < 0.02 * slope else float(f"{slope:.3g}")
        if log.roles.input == "goal" and not {"theta_m", "theta_l"} <= signals.keys():
            return 1.0
    return None


def _list_columns(log: DescribedLog) -> list[ProposedColumn]:
    survey, rows = log.survey, list[ProposedColumn]()

    def add(column: str, role: str, unit: str, description: str, doubt: str = "") -> None:
        row = ProposedColumn(log=survey.name, column=column, role=role, unit=unit, description=description, doubt=doubt)
        rows.append(row)

    if survey.clock is not None:
        add(survey.clock.name, "time", log.time_unit, "time", doubt_clock(survey))
    for role, column in log.roles.columns.items():
        what = "input" if role == log.roles.input else role
        unit, doubt = column.header.unit or log.units[role], log.roles.doubts.get(column.name, "")
        add(column.name, what, unit, DESCRIPTIONS[role], doubt)
    for name, why in {**log.roles.unused, **survey.left_out}.items():
        add(name, "", "", f"not used: {why}")
    return rows
