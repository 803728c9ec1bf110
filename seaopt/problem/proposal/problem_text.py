"""The text of a problem file from described logs and their actuator, with guesses marked in its comments."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from seaopt.formatting import format_toml, printable, tell_apart
from seaopt.logs import assess_quality
from seaopt.logs.quality.clock import JITTER_LIMIT
from seaopt.problem.proposal.actuators import DESIGN, ParameterLine, Proposed, screw_travel
from seaopt.problem.proposal.described_log import GEARED, SI_UNITS, DescribedLog, doubt_clock, list_single, make_table
from seaopt.problem.proposal.questions import Interview
from seaopt.problem.proposal.roles import DESCRIPTIONS, FOLLOWS
from seaopt.problem.proposal.sensor_noise import combine_noise, limit_noise_gain, list_sensors
from seaopt.problem.proposal.survey import SurveyedColumn, regress
from seaopt.problem.proposal.traits import OUTLIERS
from seaopt.units import factor, header_unit, is_unit

USUAL_BANDWIDTHS_HZ = (15.0, 60.0)  # of a problem file that gives no bandwidth_range_hz
ABOVE_RESONANCE = 2.5  # bandwidth over resonance that is asked for first
DEFAULT_BANDWIDTH_HZ = 20.0
LEAST_RATE_HZ = 500.0  # of a controller; a slower log was not its clock
HOLDOUT_S = 10.0  # a log from which a fifth can be kept back
BRIDGE = 5.0  # periods that an irregular clock may skip
RETUNE = 4
COMMENT_AT = 56  # column of the comments
HALF = "_half"  # at the end of the name of a log at half the amplitude

Rows = dict[str, tuple[str, str]]  # values with their comments, by key


def write_problem_text(title: str, logs: Sequence[DescribedLog], actuator: Proposed, interview: Interview) -> str:
    """Return the text of the problem file."""
    head = [
        "# Written by seaopt new. Check every value marked as guessed before you run.",
        "schema = 1",
        f"title = {format_toml(title)}",
    ]
    lines = [
        "",
        _comment("[parameters]", "SI units; free = true is fitted"),
        *_align({line.name: (line.value, line.comment) for line in actuator.lines}),
    ]
    sticks = any(log.traits.standing for log in logs)
    if sticks:
        lines += _offer_stribeck(actuator.lines)
    for name, options in actuator.plants.items():
        lines += ["", f"[plant.{name}]", *(f"{key} = {format_toml(value)}" for key, value in options.items())]
        if sticks:
            parts = options.get("parts", [])
            assert isinstance(parts, list)
            lines += [f"# parts = {format_toml([*parts, 'stribeck'])}", "# sticks = true  # friction jumps at rest"]
    names, single = set[str](), list_single(logs)
    for log in logs:
        name = tell_apart(log.name, names, "_")
        names.add(name)
        keys = [_describe_delay(log, logs)]
        if log is not logs[0]:
            keys.append('# use = "validate"  # keeps this log out of the fit, which is then scored on it')
        head_rows, channels = _describe_experiment(log, name, interview), _describe_channels(log, actuator, interview)
        lines += ["", *_write_experiment(head_rows, keys, channels)]
        if any(log is each for each in single):
            lines += _offer_second_log(log, name, head_rows, channels, keys[:1] if _find_delayed(log, logs) else [])
    lines += _describe_fit(logs)
    if actuator.measured:
        lines += ["", "[controller]", *_align(_describe_controller(logs, actuator, interview))]
        lines += ["", "[robustness]", *_align(_describe_robustness(logs, actuator))]
    else:
        lines += [
            "",
            "# No [controller]: these logs have no torque or force to regulate. From encoders on both sides of the",
            '# spring firmware makes one: parts = ["deflection_sensor"], measured = "tau_d", or "F_d" of a screw.',
        ]
    if guessed := interview.list_guessed():
        head += [
            "# Guesses; every verdict lists them. Once you have measured one, correct it and remove it here.",
            f"guessed = {format_toml(guessed)}",
        ]
    return "\n".join([*head, *lines]) + "\n"


def _write_experiment(rows: Rows, keys: Sequence[str], channels: Mapping[str, Rows]) -> list[str]:
    """Return the lines of an experiment; `keys` are lines that stand behind the first rows."""
    tables = [line for table, each in channels.items() for line in (f"[experiment.{table}]", *_align(each))]
    return ["[[experiment]]", *_align(rows), *keys, *tables]


def _describe_channels(log: DescribedLog, actuator: Proposed, interview: Interview) -> dict[str, Rows]:
    """Return the entries of a log's channels by table."""
    tables = {"inputs": (log.roles.input,), "outputs": log.outputs}
    return {
        table: dict(_describe_channel(log, role, actuator, interview) for role in roles)
        for table, roles in tables.items()
    }


def _offer_second_log(
    log: DescribedLog, name: str, rows: Rows, channels: Mapping[str, Rows], keys: Sequence[str]
) -> list[str]:
    """Return lines, to be taken in by hand, of a second log that shows what the model lacks."""
    stem, dot, suffix = log.file.rpartition(".")
    file = f"{stem}{HALF}{dot}{suffix}" if dot else f"{log.file}{HALF}"
    second = {"name": f"{name}{HALF}", "log": file, "use": "validate"}
    rows = rows | {key: (format_toml(value), "") for key, value in second.items()}
    bare_rows, *bare = [{key: (value, "") for key, (value, _) in each.items()} for each in (rows, *channels.values())]
    return [
        "",
        "# Record the same test once more at half the amplitude, and uncomment these lines. Where the model lacks",
        "# friction, play or a motor that saturates, its parameters fit one amplitude and miss the other, and one",
        "# amplitude alone hides that.",
        *(f"# {line}" for line in _write_experiment(bare_rows, keys, dict(zip(channels, bare, strict=True)))),
    ]


def _offer_stribeck(lines: Sequence[ParameterLine]) -> list[str]:
    """Return lines, to be taken in by hand, of friction that is larger at rest than as it slides."""
    sliding = next((line.number for line in lines if line.name == "f_c"), 1.0)
    return [
        "# A position stands still again and again. If friction sticks, uncomment these lines, here and in the plants:",
        f"# f_s = {{ value = {1.5 * sliding:.3g}, free = true }}  # breakaway friction, above f_c",
    ]


def _describe_delay(log: DescribedLog, logs: Sequence[DescribedLog]) -> str:
    """Return the line of a log's delay: fitted where the log, or another of this drive, shows one, else a remark."""
    delayed = _find_delayed(log, logs)
    delay = None if delayed is None else delayed.traits.delay_s
    if delayed is None or delay is None:
        return "# delay_s = { value = 0.002, free = true, max = 0.02 }  # if the input takes effect late"
    text = f"delay_s = {{ value = {delay:.2g}, free = true, max = {max(4.0 * delay, 0.02):.2g} }}"
    why = "the outputs respond late, by their phase"
    return _comment(text, why if delayed is log else f"{delayed.survey.name} shows it, and the drive is the same")


def _find_delayed(log: DescribedLog, logs: Sequence[DescribedLog]) -> DescribedLog | None:
    """Return the log that shows the delay of a log's input: itself, else the first of one logged alike."""

    def logged(each: DescribedLog) -> tuple[str, bool]:
        return each.roles.input, bool(each.roles.columns[each.roles.input].header.measured)

    return next((x for x in (log, *logs) if x.traits.delay_s is not None and logged(x) == logged(log)), None)


def _describe_fit(logs: Sequence[DescribedLog]) -> list[str]:
    """Return [fit], where the logs ask for it."""
    lasts = all(log.survey.columns[0].values.size / log.rate_hz >= HOLDOUT_S for log in logs)
    outliers = sum(log.traits.outliers for log in logs)
    far, rows = outliers >= OUTLIERS, list[str]()
    if lasts:
        rows.append(_comment("holdout = 0.2", "the last fifth of each log is kept back, to judge the fit by"))
    if far:
        rows.append(_comment('loss = "huber"', f"{outliers} samples are outliers"))
    elif lasts:
        rows.append('# loss = "huber"  # if there are outliers')
    return ["", "[fit]", *rows] if rows else []


def _describe_experiment(log: DescribedLog, name: str, interview: Interview) -> Rows:
    rows = {
        "name": (format_toml(name), ""),
        "plant": (format_toml(log.plant), interview.mark(f"link:{log.survey.name}")),
        "log": (format_toml(log.file), "relative to this file"),
    }
    clock = log.survey.clock
    if clock is None:
        rows["rate_hz"] = f"{log.rate_hz:.10g}", interview.mark(f"rate:{log.survey.name}")
    else:
        marks = [interview.mark(f"unit:{clock.name}"), _mark_role(clock.name, doubt_clock(log.survey), interview)]
        rows["time"] = _spell_column(clock.name, log.time_unit, 1.0), "; ".join(filter(None, marks))
    if log.roles.columns[log.roles.input].header.measured:
        rows["hold"] = '"first"', "the input was measured: straight lines between its samples"
    if log.survey.overlap_s is not None:
        low, high = log.survey.overlap_s
        window = [math.ceil(1e6 * low) / 1e6, math.floor(1e6 * high) / 1e6]
        rows["window_s"] = format_toml(window), "the times that all clocks have"
    return rows | _describe_clock(log)


def _describe_channel(
    log: DescribedLog, role: str, actuator: Proposed, interview: Interview
) -> tuple[str, tuple[str, str]]:
    """Return a channel's name, and its entry with what of it is a guess."""
    column, unit, scale = log.roles.columns[role], log.units[role], log.scales.get(role, 1.0)
    name, notes = {"torque": "I", "screw": "q"}.get(role, role), [DESCRIPTIONS[role]]
    guesses = [interview.mark(f"unit:{column.name}", f"counts:{column.name}", f"duty:{column.name}")]
    guesses.append(_mark_role(column.name, log.roles.doubts.get(column.name, ""), interview))
    if role == "screw":  # the nut goes r for a radian
        scale, unit = scale * screw_travel(actuator.lines) * factor(unit, "rad"), "m"
        notes.append("as the place of the nut, l/(2 pi N_p) for a radian: the scale changes with l and N_p")
    if role == "torque":
        notes.append("as a current, by K_tau, which the scale changes with")
    if role == "theta_m" and log.plant != "held" and reads_output(log):
        scale *= next(line.number for line in actuator.lines if line.name == "N")
        interview.assume(f"gear:{column.name}")
        guesses.append("guessed: measured behind the gear, so times N")
    if scale < 0.0:
        interview.assume(f"sign:{column.name}")
        guesses.append("guessed: sign reversed, as it falls when the effort rises")
    smooth = column.fast if role != log.roles.input else column.header.measured
    rule = "linear" if smooth else "readings" if role != log.roles.input else "hold"
    keys = _spell_clock(column, log, rule) if column.clock else {}
    return name, (_spell_column(column.name, unit, scale, keys), "; ".join([*notes, *filter(None, guesses)]))


def _spell_clock(column: SurveyedColumn, log: DescribedLog, rule: str) -> dict[str, object]:
    """Return the keys of a column that has times of its own, aligned by a rule."""
    stated = header_unit(column.clock)
    unit = {} if stated and is_unit(stated) else {"unit": log.survey.clock_units[column.clock]}
    return {"time": {"column": column.clock, **unit}, "align": {rule: {}}}


def _mark_role(column: str, doubt: str, interview: Interview) -> str:
    """Return that a column's role is a guess, as the end of a comment, unless somebody has said that all are right."""
    if not doubt or "roles" in interview.answers:
        return ""
    interview.assume(f"role:{column}")
    return f"guessed: {doubt}"


def reads_output(log: DescribedLog) -> bool:
    """Tell whether the motor's angle is given behind the gear: it is that of the link, nearly."""
    signals = log.signals
    if "theta_l" not in signals:
        return False
    slope, share = regress(signals["theta_m"], signals["theta_l"])
    return share > FOLLOWS and 1.0 / GEARED[0] < slope < GEARED[0]


def _describe_clock(log: DescribedLog) -> Rows:
    """Return what the log's clock needs before it can be fitted."""
    clock, rows = log.clock, Rows()
    if clock is None:
        return rows
    if clock.repeated.size:
        rows["duplicates"] = '"first"', f"{clock.repeated.size} times occur twice"
    driver, rate = log.roles.columns.get(log.roles.input), float(f"{clock.rate_hz:.3g}")
    hole = 0 if driver is None else driver.hole
    if hole:
        bridge = f"bridge_s = {max(hole + 1.5, BRIDGE) / rate:.3g}"
        settings = f"{{ rate_hz = {rate:.10g}, {bridge}, rule = {{ readings = {{}} }} }}"
        rows["resample"] = settings, "the input is in some rows only, with the others between them"
    elif clock.jitter_max > JITTER_LIMIT * clock.period:
        settings = f"{{ rate_hz = {rate:.10g}, bridge_s = {BRIDGE / rate:.3g} }}", "the clock is irregular"
        rows["resample"] = ('"restamp"', "the timestamps are rounded") if clock.rounded_only else settings
    return rows


def _describe_controller(logs: Sequence[DescribedLog], actuator: Proposed, interview: Interview) -> Rows:
    resonance, why = _find_resonance(logs)
    low, high = USUAL_BANDWIDTHS_HZ
    guess = min(max(5.0 * round(ABOVE_RESONANCE * resonance / 5.0), low), high) if resonance else DEFAULT_BANDWIDTH_HZ
    band = interview.number("bandwidth_hz", "Bandwidth of the controller", guess, why, detail=", in Hz")
    rows = {
        "plant": (format_toml(DESIGN), ""),
        "measured": (format_toml(actuator.measured), "what is regulated"),
        "structure": ('"pid"', ""),
        "bandwidth_hz": (f"{band:.10g}", interview.mark("bandwidth_hz")),
    }
    if not low <= band <= high:
        rows["bandwidth_range_hz"] = f"[{min(low, band / 4.0):.3g}, {max(high, band):.3g}]", ""
    rate = logs[0].rate_hz
    usual, why = (float(f"{rate:.4g}"), "that of the log") if rate >= LEAST_RATE_HZ else (1000.0, "a typical value")
    label = "Rate at which the controller will run"
    sampled = interview.number("sample_rate_hz", label, usual, why, detail=", in Hz")
    rows["sample_rate_hz"] = f"{sampled:.10g}", interview.mark("sample_rate_hz")
    delayed = any(log.traits.delay_s for log in logs)
    default = "0, as for the program that logged" if delayed else "1"
    delay = f"from a reading to its command, besides the drive's fitted delay; {default} if left out"
    rows["# compute_delay_samples"] = "1", delay
    rows |= _describe_limit(logs, interview)
    noise = combine_noise(list_sensors(logs, actuator), actuator)
    gain = limit_noise_gain(logs, actuator.measured, noise, band, resonance)
    unit = SI_UNITS.get(actuator.measured, "N m")
    example = f": {noise:.3g} {unit} make up to {gain * noise:.3g} {unit}" if noise else ""
    rows["max_noise_gain"] = f"{gain:.3g}", f"motor effort over sensor noise, at its peak{example}"
    if actuator.robust_to:
        rows["robust_to"] = format_toml(list(actuator.robust_to)), "Ms and Mt hold there too"
    return rows


def _describe_limit(logs: Sequence[DescribedLog], interview: Interview) -> Rows:
    """Return the limit of the command, which is at least what the logs have."""
    role = logs[0].roles.input
    largest = max(float(np.nanmax(np.abs(log.signals[role]))) for log in logs)
    what, unit = {"V": ("voltage", "V"), "duty": ("duty", "1 is full")}.get(role, ("current", "A"))
    unit = "N m, as K_tau takes it" if role == "torque" else unit
    guess = 1.0 if role == "duty" else float(f"{largest:.2g}")
    why = "the whole bridge" if role == "duty" else "the largest of the logs"
    key = "current_limit_A" if role in ("I", "torque") else "command_limit"
    limit = interview.number(key, f"Largest {what} that the drive may give", guess, why, detail=f" ({unit})")
    return {key: (f"{limit:.10g}", interview.mark(key))}


def _describe_robustness(logs: Sequence[DescribedLog], actuator: Proposed) -> Rows:
    rows = {"plants": (format_toml([DESIGN, *actuator.robust_to]), "certified, over the uncertainty of the fit")}
    if actuator.ranges:
        ranges = ", ".join(f"{name} = [{low:.4g}, {high:.4g}]" for name, (low, high) in actuator.ranges.items())
        rows["parameters"] = f"{{ {ranges} }}", "half to twice the value given"
    if actuator.ranges or any(line.prior_std is not None for line in actuator.lines):
        rows["retune"] = f"{RETUNE}", "rounds of tuning for the worst case that the certificate finds"
    if sensors := list_sensors(logs, actuator):
        figures = {"noise_std": {}, "quantisation": {}}
        for name, noise in sensors.items():
            figures["noise_std"] |= {name: float(f"{noise.std:.3g}")} if noise.std else {}
            figures["quantisation"] |= {name: float(f"{noise.step:.4g}")} if noise.step else {}
        levels = {kind: levels for kind, levels in figures.items() if levels}
        rows["sensors"] = format_toml(levels), "as measured in the log, from sample to sample"
    return rows


def _find_resonance(logs: Sequence[DescribedLog]) -> tuple[float | None, str]:
    """Return where the effort's response peaks or falls off, in the first log that shows it, and why to go above it."""
    for log in logs:
        role = next((role for role in ("tau_s", "F1", "F2") if role in log.signals), None)
        table = make_table(log, [role]) if role is not None else None
        if table is None:
            continue
        for band in assess_quality(table, inputs=[log.roles.input]).excitation.values():
            if band.peak_hz is not None and band.rolls_off_hz is not None:
                return band.peak_hz, f"above the resonance, which the log has near {band.peak_hz:.2g} Hz"
            if band.rolls_off_hz is not None:
                why = f"above {band.rolls_off_hz:.2g} Hz, where the response has fallen to half"
                return band.rolls_off_hz, why
    return None, "a typical value"


def _spell_column(name: str, unit: str, scale: float, keys: Mapping[str, object] | None = None) -> str:
    """Return a column as a problem file writes it: its header alone where that says its unit."""
    if scale == 1.0 and header_unit(name) == unit and not keys:
        return format_toml(name)
    return format_toml({"column": name, "unit": unit} | ({"scale": scale} if scale != 1.0 else {}) | dict(keys or {}))


def _align(rows: Rows) -> list[str]:
    """Return lines with their comments below one another, and the signs of equality too."""
    width = max(map(len, rows))
    return [_comment(f"{name:<{width}} = {value}", comment) for name, (value, comment) in rows.items()]


def _comment(text: str, comment: str) -> str:
    return f"{text:<{COMMENT_AT - 2}}  # {printable(comment)}" if comment else text
