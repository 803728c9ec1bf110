r"""A problem file for logs that nobody has described yet: what is seen in them, what is guessed, what has to be asked.

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

import json
import math
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
from jaxtyping import Float

from seaopt.errors import LogError, ProblemError
from seaopt.formatting import join_words, printable
from seaopt.logs import assess_quality
from seaopt.logs.quality.clock import JITTER_LIMIT, ClockQuality, assess_clock
from seaopt.problem.proposal.actuators import (
    Facts,
    Proposed,
    propose_linear,
    propose_rotary,
    screw_travel,
)
from seaopt.problem.proposal.questions import Interview, Question
from seaopt.problem.proposal.roles import (
    DESCRIPTIONS,
    FOLLOWS,
    INPUTS,
    LINEAR_OUTPUTS,
    ROTARY_OUTPUTS,
    Assignment,
    assign,
    guess_unit,
    is_held,
    is_rotary,
)
from seaopt.problem.proposal.survey import Survey, SurveyedColumn, regress, slow_sign, survey_log
from seaopt.problem.proposal.vocabulary import COUNTS, is_m_open, read_header
from seaopt.records import record
from seaopt.signals import Signal, Table
from seaopt.units import factor, header_unit

FULL_DUTIES = (1, 100, 255, 885, 1000, 1023, 4095, 32767)  # of registers, for a full duty
ABOVE_RESONANCE = 2.5  # bandwidth over resonance that is asked for first
USUAL_BANDWIDTHS_HZ = (15.0, 60.0)  # of a problem file that gives no bandwidth_range_hz
DEFAULT_BANDWIDTH_HZ = 20.0
LEAST_RATE_HZ = 500.0  # of a controller; a slower log was not its clock
HOLDOUT_S = 10.0  # a log from which a fifth can be kept back
GEARED = (1.5, 1000.0)  # slopes of motor over link that are a gear's
BRIDGE = 5.0  # periods that an irregular clock may skip
RETUNE = 4
LINK_END = re.compile(r"[\s_.\-/]l$")  # of a name, beside one that ends in m: the link, and the motor
COMMENT_AT = 56  # column of the comments


@record
class ProposedColumn:
    """A row of what was made of a log's columns; `doubt` says what of it is a guess."""

    log: str
    column: str
    role: str
    unit: str
    description: str
    doubt: str


@record
class Proposal:
    """A problem file's text, what was made of the columns, all questions, and those of them that nobody answered.

    `guessed` are the guesses that results rest on, as the file's key of that name has them.
    """

    text: str
    columns: tuple[ProposedColumn, ...]
    questions: tuple[Question, ...]
    guesses: tuple[Question, ...]
    guessed: tuple[str, ...]


@record(eq=False)
class _Log:
    """A log with its roles."""

    survey: Survey
    roles: Assignment
    name: str
    file: str
    plant: str
    units: Mapping[str, str]
    scales: Mapping[str, float]
    time_unit: str
    clock: ClockQuality | None
    rate_hz: float

    @property
    def outputs(self) -> tuple[str, ...]:
        """What is fitted; a link that is held has no angle."""
        return tuple(role for role in self.roles.outputs if not (role == "theta_l" and self.plant == "held"))

    @property
    def signals(self) -> dict[str, Float[np.ndarray, " n"]]:
        """Samples of each role in SI."""
        return {
            role: one.values * factor(self.units[role], _SI[role]) * self.scales.get(role, 1.0)
            for role, one in self.roles.columns.items()
        }


_SI = {
    "I": "A", "torque": "A", "V": "V", "duty": "-", "goal": "rad", "F1": "N", "F2": "N", "q": "m", "screw": "rad",
    "phi": "rad", "tau_s": "N m", "theta_m": "rad", "theta_l": "rad", "deflection": "rad",
}  # fmt: skip


@np.errstate(over="ignore", invalid="ignore")  # of a column with numbers near the largest float
def propose(logs: Sequence[Path], answers: Mapping[str, str], folder: Path, title: str = "") -> Proposal:
    """Return a problem file for logs; `answers` are texts by the keys of `Question`, `folder` is the file's.

    Raises
    ------
    SeaoptError
        A log cannot be read or lies outside the folder, or an answer is not one.

    """
    interview = Interview(answers)
    surveys = [_survey(path, interview) for path in logs]
    turns, doubt = is_rotary([one for survey in surveys for one in survey.columns])
    if doubt:
        kind = interview.ask(
            "actuator", "Is the actuator rotary (a gear) or linear (a screw)?", "rotary" if turns else "linear", doubt,
            ("rotary", "linear"),
        )  # fmt: skip
        turns = kind == "rotary"
    assignments = [_assign(survey, interview, turns) for survey in surveys]
    described = [
        _describe_log(*pair, interview, folder, at) for at, pair in enumerate(zip(surveys, assignments, strict=True))
    ]
    if len({log.roles.input for log in described}) > 1:
        names = join_words([f"{log.survey.name} ({log.roles.input})" for log in described])
        raise ProblemError(f"{names} are driven by different inputs; write a problem file for each: seaopt new LOG")
    facts = Facts(
        input=described[0].roles.input, places=tuple(dict.fromkeys(log.plant for log in described)),
        outputs=frozenset(role for log in described for role in log.outputs), gear_ratio=_find_ratio(described),
    )  # fmt: skip
    actuator = (propose_rotary if turns else propose_linear)(interview, facts)
    text = _write(title or described[0].survey.path.stem, described, actuator, interview)
    return Proposal(
        text=text, columns=tuple(row for log in described for row in _list_columns(log)),
        questions=tuple(interview.questions),
        guesses=tuple(one for one in interview.questions if one.key not in interview.answers),
        guessed=tuple(interview.list_guessed()),
    )  # fmt: skip


def _survey(path: Path, interview: Interview) -> Survey:
    key = f"time:{path.name}"
    survey = survey_log(path, interview.answers.get(key))
    if len(survey.clocks) > 1 and survey.clock is not None:
        interview.ask(key, f"Which column of {path.name} is the time?", survey.clock.name, "the first of them",
                      survey.clocks)  # fmt: skip
    columns = tuple(_settle_m(one, survey, interview) for one in survey.columns)
    return replace(survey, columns=columns)


def _settle_m(column: SurveyedColumn, survey: Survey, interview: Interview) -> SurveyedColumn:
    """Return a column of which the m at the end of its name is settled: beside signs of a gear it is the motor."""
    if not is_m_open(column.header):
        return column
    geared = any(one.header.quantity == "torque" or LINK_END.search(one.name) for one in survey.columns)
    meaning = "motor" if geared else interview.ask(
        f"m:{column.name}", f'Is "{column.name}" in metres, or an angle of the motor?', "metres",
        "no column is a torque, nor of a link", ("metres", "motor"),
    )  # fmt: skip
    return replace(column, header=read_header(column.name, metres=False)) if meaning == "motor" else column


def _assign(survey: Survey, interview: Interview, turns: bool) -> Assignment:
    """Return the roles of a log's columns, which are asked for one by one where the guess is not right."""
    roles = assign(survey, rotary=turns, given={})
    whole = interview.ask(
        "roles", "Are these the right columns?", "yes", "by names and samples", ("yes", "no"),
    )  # fmt: skip
    if whole == "yes":
        return _check_outputs(roles, survey)
    known = {one.name: role for role, one in roles.columns.items()}
    choices = (*INPUTS, *(ROTARY_OUTPUTS if turns else LINEAR_OUTPUTS), "none")
    given = {
        one.name: interview.ask(
            f"role:{one.name}", f'What is column "{one.name}"?', known.get(one.name, "none"), "by its name", choices
        )
        for one in survey.columns
    }
    chosen = [role for role in given.values() if role in INPUTS]
    if len(chosen) != 1:
        raise ProblemError(f"{survey.name}: {len(chosen)} columns are inputs; give exactly one of {', '.join(INPUTS)}")
    known = {name: "" if role == "none" else role for name, role in given.items()}
    return _check_outputs(assign(survey, rotary=turns, given=known), survey)


def _check_outputs(roles: Assignment, survey: Survey) -> Assignment:
    """Refuse a log of an input alone."""
    if not roles.outputs:
        raise LogError(
            f"{survey.name}: nothing is measured besides the input, {roles.columns[roles.input].name}; log a force, a "
            "torque or an angle as well"
        )
    return roles


def _describe_log(survey: Survey, roles: Assignment, interview: Interview, folder: Path, at: int) -> _Log:
    """Return a log with units, clock and plant."""
    unit, sure = survey.clock_unit()
    key = f"unit:{survey.clock.name}" if survey.clock is not None else ""
    if survey.clock is not None and not sure:
        unit = interview.ask(key, f'Unit of the time "{survey.clock.name}"?', unit, "by the size of its steps",
                             ("s", "ms", "us", "ns"))  # fmt: skip
    clock = None
    if survey.clock is None:
        text = f"Sample rate of {survey.name}, which has no clock, in Hz"
        rate = interview.number(f"rate:{survey.name}", text, 1000.0, "the file has no column of times")
    else:
        clock = assess_clock(survey.clock.values * factor(unit, "s"), str(survey.path))
        rate = clock.rate_hz
    units, scales = _ask_units(roles, interview)
    log = _Log(
        survey=survey, roles=roles, name=_spell_name(survey.path.stem, at), file=_relative(survey.path, folder),
        plant="", units=units, scales=scales, time_unit=unit, clock=clock, rate_hz=rate,
    )  # fmt: skip
    log = replace(log, scales=scales | _find_signs(log))
    return replace(log, plant=_ask_link(log, interview))


def _relative(path: Path, folder: Path) -> str:
    try:
        path.name.encode()
    except UnicodeEncodeError:
        raise ProblemError(
            f"{path}: a problem file cannot name it, for its name is not UTF-8; rename the log"
        ) from None
    try:
        return path.resolve().relative_to(folder.resolve()).as_posix()
    except ValueError:
        beside = shlex.join(["seaopt", "new", str(path), "-o", str(path.parent / "problem.toml")])
        raise ProblemError(
            f"{path}: is not in the folder of the problem file, {folder}; write that beside the log: {beside}"
        ) from None


def _spell_name(stem: str, at: int) -> str:
    """Return an experiment's name: letters, digits, _ and -, the first a letter."""
    text = "".join(one if one.isascii() and (one.isalnum() or one in "_-") else "_" for one in stem)[:60]
    return text if text[:1].isalpha() else f"log{at + 1}_{text}".rstrip("_")


def _ask_units(roles: Assignment, interview: Interview) -> tuple[dict[str, str], dict[str, float]]:
    """Return each role's unit, and what its numbers are multiplied with besides."""
    units: dict[str, str] = {}
    scales: dict[str, float] = {}
    for role, column in roles.columns.items():
        unit, why = guess_unit(role, column)
        if why:
            text = f'Unit of "{column.name}" ({DESCRIPTIONS[role]})?'
            unit = interview.ask(f"unit:{column.name}", text, unit, why, _choices_of(role))
        if unit == COUNTS:
            turn = interview.number(
                f"counts:{column.name}", f'Steps of "{column.name}" for a whole turn', 4096.0, "a common encoder's"
            )
            unit, scales[role] = "rad", 2.0 * math.pi / turn
        elif role == "duty" and unit != "percent" and column.largest > 1.5:
            full = next((one for one in FULL_DUTIES if one >= column.largest), FULL_DUTIES[-1])
            scales[role] = 1.0 / interview.number(
                f"duty:{column.name}", f'Number of "{column.name}" at full duty', full, "the next usual one"
            )
            unit = "-"
        elif role == "torque":  # of a current whose constant is 1 N m/A
            scales[role], unit = factor(unit, "N m"), "A"
        units[role] = unit
    return units, scales


def _choices_of(role: str) -> tuple[str, ...]:
    angle = ("rad", "deg", COUNTS)
    return {
        "I": ("A", "mA"), "torque": ("N m", "mN m"), "V": ("V", "mV"), "duty": ("-", "percent"), "F1": ("N", "kN"),
        "F2": ("N", "kN"), "q": ("m", "mm", "um"), "tau_s": ("N m", "mN m"),
    }.get(role, angle)  # fmt: skip


def _find_signs(log: _Log) -> dict[str, float]:
    """Return scales that turn a sensor round which falls as the effort rises; the first effort counts as right."""
    signals = log.signals
    effort = next((role for role in ("tau_s", "F1", "F2") if role in signals), None)
    turned: dict[str, float] = {}
    if effort is None or log.survey.clock is None:
        return turned
    for role in ("F2", "theta_m", "screw", "q"):
        # The motor's place follows the effort only where the link is held; elsewhere no sign is sure.
        follows = role in signals and role != effort and regress(signals[role], signals[effort])[1] > FOLLOWS
        if follows and slow_sign(signals[effort], signals[role], log.rate_hz) < 0:
            turned[role] = -log.scales.get(role, 1.0)
    return turned


def _ask_link(log: _Log, interview: Interview) -> str:
    """Return which plant a log was recorded on: held, moving, or hanging."""
    roles, key = log.roles, f"link:{log.survey.name}"
    if not roles.rotary:
        return "swing" if "phi" in roles.columns else "held"
    units = {role: factor(log.units[role], "rad") * log.scales.get(role, 1.0) for role in ("theta_m", "theta_l")
             if role in log.units}  # fmt: skip
    held, why = is_held(roles, units.get("theta_l", 1.0), units.get("theta_m", 1.0))
    return interview.ask(
        key, f"In {log.survey.name}, is the link held, free, or hanging (gravity pulls it back)?",
        "held" if held else "free", why, ("held", "free", "hanging"),
    )  # fmt: skip


def _find_ratio(logs: Sequence[_Log]) -> float | None:
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


def _list_columns(log: _Log) -> list[ProposedColumn]:
    survey = log.survey
    rows: list[ProposedColumn] = []
    if survey.clock is not None:
        rows.append(ProposedColumn(
            log=survey.name, column=survey.clock.name, role="time", unit=log.time_unit, description="time",
            doubt=_doubt_clock(survey),
        ))  # fmt: skip
    for role, column in log.roles.columns.items():
        rows.append(ProposedColumn(
            log=survey.name, column=column.name, role="input" if role == log.roles.input else role,
            unit=column.header.unit or log.units[role], description=DESCRIPTIONS[role],
            doubt=log.roles.doubts.get(column.name, ""),
        ))  # fmt: skip
    for name, why in {**dict.fromkeys((one.name for one in log.roles.unused), ""), **survey.left_out}.items():
        text = f"not used: {why}" if why else "not used"
        rows.append(ProposedColumn(log=survey.name, column=name, role="", unit="", description=text, doubt=""))
    return rows


def _write(title: str, logs: Sequence[_Log], actuator: Proposed, interview: Interview) -> str:
    """Return the text of the problem file."""
    head = [
        "# Written by seaopt new. What a comment calls guessed was not asked, or nobody knew it: look at that first.",
        "schema = 1",
        f"title = {_quote(title)}",
    ]
    lines = [
        "",
        _comment("[parameters]", "SI units; what is free is fitted"),
        *_align([(f"{line.name} = {line.value}", line.comment) for line in actuator.lines]),
    ]
    for name, options in actuator.plants.items():
        lines += ["", f"[plant.{name}]", *(f"{key} = {_value(value)}" for key, value in options.items())]
    names: set[str] = set()
    for log in logs:
        name = next(one for one in _number_names(log.name) if one not in names)
        names.add(name)
        lines += ["", "[[experiment]]", *_align(_describe_experiment(log, name, interview))]
        lines.append("# delay_s = { value = 0.002, free = true, max = 0.02 }  # where the input takes effect late")
        if log is not logs[0]:
            lines.append('# use = "validate"  # keeps this log out of the fit, which is then scored on it')
        for table, roles in (("inputs", (log.roles.input,)), ("outputs", log.outputs)):
            channels = [_describe_channel(log, role, actuator, interview) for role in roles]
            lines += [f"[experiment.{table}]", *_align(channels)]
    if all(_lasts(log) for log in logs):
        lines += [
            "",
            "[fit]",
            _comment("holdout = 0.2", "the last fifth of each log is kept back, to judge the fit by"),
            '# loss = "huber"  # where single samples are far off',
        ]
    if actuator.measured:
        lines += ["", "[controller]", *_align(_describe_controller(logs, actuator, interview))]
        lines += ["", "[robustness]", *_align(_describe_robustness(logs, actuator))]
    else:
        lines += ["", "# No [controller]: these logs have neither a torque or force, nor both encoders of the spring."]
    if guessed := interview.list_guessed():
        head += [
            "# What was guessed, named in every verdict; take a name out once you know its value and have written it.",
            f"guessed = {_value(guessed)}",
        ]
    return "\n".join([*head, *lines]) + "\n"


def _number_names(name: str) -> Iterator[str]:
    """Yield a name, and then the name with 2, 3, ... at its end."""
    yield name
    yield from (f"{name}_{number}" for number in count(2))


def _doubt_clock(survey: Survey) -> str:
    """Return why a log's clock is a guess; "" where its name says that it is one."""
    return "" if survey.clock is None or survey.clocks else "the time, as it only rises, and evenly"


def _describe_experiment(log: _Log, name: str, interview: Interview) -> list[tuple[str, str]]:
    rows = [(f"name = {_quote(name)}", ""), (f"plant = {_quote(log.plant)}", interview.mark(f"link:{log.survey.name}"))]
    rows.append((f"log = {_quote(log.file)}", "relative to this file"))
    clock = log.survey.clock
    if clock is None:
        rows.append((f"rate_hz = {log.rate_hz:.10g}", interview.mark(f"rate:{log.survey.name}")))
    else:
        marks = [interview.mark(f"unit:{clock.name}"), _mark_role(clock.name, _doubt_clock(log.survey), interview)]
        text = f"time = {_spell_column(clock.name, log.time_unit, 1.0)}"
        rows.append((text, "; ".join(filter(None, marks))))
    if log.roles.columns[log.roles.input].header.measured:
        rows.append(('hold = "first"', "the input was measured: straight lines between its samples"))
    return rows + _describe_clock(log)


def _describe_channel(log: _Log, role: str, actuator: Proposed, interview: Interview) -> tuple[str, str]:
    """Return a channel's entry, and what of it is a guess."""
    column, unit, scale = log.roles.columns[role], log.units[role], log.scales.get(role, 1.0)
    name, notes = {"torque": "I", "screw": "q"}.get(role, role), [DESCRIPTIONS[role]]
    guesses = [interview.mark(f"unit:{column.name}", f"counts:{column.name}", f"duty:{column.name}")]
    guesses.append(_mark_role(column.name, log.roles.doubts.get(column.name, ""), interview))
    if role == "screw":  # the nut goes r for a radian
        scale, unit = scale * screw_travel(actuator.lines) * factor(unit, "rad"), "m"
        notes.append("as the place of the nut, by the lead of the screw")
    if role == "torque":
        notes.append("as a current, by K_tau")
    if role == "theta_m" and log.plant != "held" and _reads_output(log):
        scale *= next(float(line.value) for line in actuator.lines if line.name == "N")
        interview.assume(f"gear:{column.name}")
        guesses.append("guessed: it is given behind the gear, so times N")
    if scale < 0.0:
        interview.assume(f"sign:{column.name}")
        guesses.append("guessed: turned round, as it falls where the effort rises")
    return f"{name} = {_spell_column(column.name, unit, scale)}", "; ".join([*notes, *filter(None, guesses)])


def _mark_role(column: str, doubt: str, interview: Interview) -> str:
    """Return that a column's role is a guess, as the end of a comment, unless somebody has said that all are right."""
    if not doubt or "roles" in interview.answers:
        return ""
    interview.assume(f"role:{column}")
    return f"guessed: {doubt}"


def _reads_output(log: _Log) -> bool:
    """Tell whether the motor's angle is given behind the gear: it is that of the link, nearly."""
    signals = log.signals
    if "theta_l" not in signals:
        return False
    slope, share = regress(signals["theta_m"], signals["theta_l"])
    return share > FOLLOWS and 1.0 / GEARED[0] < slope < GEARED[0]


def _describe_clock(log: _Log) -> list[tuple[str, str]]:
    """Return what the log's clock needs before it can be fitted."""
    clock, rows = log.clock, list[tuple[str, str]]()
    if clock is None:
        return rows
    if clock.repeated.size:
        rows.append(('duplicates = "first"', f"{clock.repeated.size} times occur twice"))
    if clock.jitter_max > JITTER_LIMIT * clock.period:
        if clock.rounded_only:
            rows.append(('resample = "restamp"', "the timestamps are rounded"))
        else:
            rate = float(f"{clock.rate_hz:.3g}")
            rows.append((
                f"resample = {{ rate_hz = {rate:.10g}, bridge_s = {BRIDGE / rate:.3g} }}", "the clock is irregular",
            ))  # fmt: skip
    return rows


def _lasts(log: _Log) -> bool:
    return log.survey.columns[0].values.size / log.rate_hz >= HOLDOUT_S


def _describe_controller(logs: Sequence[_Log], actuator: Proposed, interview: Interview) -> list[tuple[str, str]]:
    rows = [
        (f"plant = {_quote(actuator.design)}", ""),
        (f"measured = {_quote(actuator.measured)}", "what is regulated"),
    ]
    rows.append(('structure = "pid"', ""))
    guess, why = _guess_bandwidth(logs)
    band = interview.number("bandwidth_hz", "Bandwidth of the controller, in Hz", guess, why)
    rows.append((f"bandwidth_hz = {band:.10g}", interview.mark("bandwidth_hz")))
    low, high = USUAL_BANDWIDTHS_HZ
    if not low <= band <= high:
        rows.append((f"bandwidth_range_hz = [{min(low, band / 4.0):.3g}, {max(high, band):.3g}]", ""))
    rate = logs[0].rate_hz
    usual = float(f"{rate:.4g}") if rate >= LEAST_RATE_HZ else 1000.0
    why = "that of the log" if rate >= LEAST_RATE_HZ else "a usual one"
    sampled = interview.number("sample_rate_hz", "Rate at which the controller will run, in Hz", usual, why)
    rows.append((f"sample_rate_hz = {sampled:.10g}", interview.mark("sample_rate_hz")))
    rows.append(_describe_limit(logs, interview))
    if actuator.robust_to:
        rows.append((f"robust_to = {_value(list(actuator.robust_to))}", "Ms and Mt hold there too"))
    return rows


def _describe_limit(logs: Sequence[_Log], interview: Interview) -> tuple[str, str]:
    """Return the limit of the command, which is at least what the logs have."""
    role = logs[0].roles.input
    largest = max(float(np.nanmax(np.abs(log.signals[role]))) for log in logs)
    what, unit = {"V": ("voltage", "V"), "duty": ("duty", "1 is full")}.get(role, ("current", "A"))
    unit = "N m, as K_tau takes it" if role == "torque" else unit
    guess = 1.0 if role == "duty" else float(f"{largest:.2g}")
    why = "the whole bridge" if role == "duty" else "the largest of the logs"
    key = "current_limit_A" if role in ("I", "torque") else "command_limit"
    limit = interview.number(key, f"Largest {what} that the drive may give ({unit})", guess, why)
    return f"{key} = {limit:.10g}", interview.mark(key)


def _describe_robustness(logs: Sequence[_Log], actuator: Proposed) -> list[tuple[str, str]]:
    rows = [
        (
            f"plants = {_value([actuator.design, *actuator.robust_to])}",
            "what is certified, besides what the fit leaves open",
        )
    ]
    if actuator.ranges:
        ranges = ", ".join(f"{name} = [{low:.4g}, {high:.4g}]" for name, (low, high) in actuator.ranges.items())
        rows.append((f"parameters = {{ {ranges} }}", "half to twice what was given"))
    if actuator.ranges or any("prior_std" in line.value for line in actuator.lines):
        rows.append((f"retune = {RETUNE}", "rounds of tuning for the worst case that the certificate finds"))
    noise = [
        log.roles.columns[actuator.measured].noise * factor(log.units[actuator.measured], _SI[actuator.measured])
        for log in logs
        if actuator.measured in log.roles.columns
    ]
    if noise and max(noise) > 0.0:
        level = f"{{ {actuator.measured} = {max(noise):.3g} }}"
        rows.append((f"sensors = {{ noise_std = {level} }}", "of the log, from sample to sample"))
    return rows


def _guess_bandwidth(logs: Sequence[_Log]) -> tuple[float, str]:
    """Return a bandwidth above where the effort's response peaks, or falls off, in the first log that shows it."""
    for log in logs:
        signals = log.signals
        role = next((role for role in ("tau_s", "F1", "F2") if role in signals), None)
        if role is None or log.survey.clock is None:
            continue
        time = log.survey.clock.values * factor(log.time_unit, "s")
        channels = {name: Signal(name=name, values=signals[name].copy(), unit="") for name in (log.roles.input, role)}
        table = Table(time=time, signals=channels, source=log.survey.name)
        excitation = assess_quality(table, inputs=[log.roles.input]).excitation
        for one in excitation.values():
            if one.rolls_off_hz is not None:
                place = one.peak_hz or one.rolls_off_hz
                low, high = USUAL_BANDWIDTHS_HZ
                guess = min(max(5.0 * round(ABOVE_RESONANCE * place / 5.0), low), high)
                shown = f"above the resonance, which the log has near {place:.2g} Hz"
                return guess, shown if one.peak_hz else f"above {place:.2g} Hz, where the response has fallen to half"
    return DEFAULT_BANDWIDTH_HZ, "a usual one"


def _spell_column(name: str, unit: str, scale: float) -> str:
    """Return a column as a problem file writes it: its header alone where that says its unit."""
    if scale == 1.0 and header_unit(name) == unit:
        return _quote(name)
    more = f", scale = {scale:.10g}" if scale != 1.0 else ""
    return f"{{ column = {_quote(name)}, unit = {_quote(unit)}{more} }}"


def _quote(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007F")


def _value(value: object) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"  # pyright: ignore[reportUnknownArgumentType]
    return _quote(str(value))


def _align(rows: Sequence[tuple[str, str]]) -> list[str]:
    """Return lines with their comments below one another, and the signs of equality too."""
    width = max(len(text.split(" = ")[0]) for text, _ in rows)
    named = [(text.split(" = ", 1), comment) for text, comment in rows]
    return [_comment(f"{name:<{width}} = {value}", comment) for (name, value), comment in named]


def _comment(text: str, comment: str) -> str:
    return f"{text:<{COMMENT_AT - 2}}  # {printable(comment)}" if comment else text
