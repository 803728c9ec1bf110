"""A fit in words: its verdict, the parameters with what follows from them, and how well each output is explained."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence

from seaopt.estimation import Fit
from seaopt.estimation.result.findings import DerivedFigure
from seaopt.estimation.result.trials import spell_hold, spell_parameters, spell_parts
from seaopt.formatting import MISSING, format_count, format_number, format_percent, join_words
from seaopt.parameters import Parameter
from seaopt.reporting.sections.data import Commands, Item, KeyFigure, Reason, Section, Step, Table, Verdict, list_notes
from seaopt.units import unit_after

RESOLVED = 2.0  # standard deviations by which a value differs from zero, to be proposed
NAME, PARAMETERS = "NAME", "[parameters]"  # of a plant whose table is not known; and the place of what is freed
DELAY_ROOM = 5.0  # times a delay that was found, up to which it may go
MOST_PLACES = 3  # that a reason names
EXPLAINED = (
    "explained: share of the output's energy that the model accounts for; of at most: the share that any model of "
    "these inputs could account for, estimated from the log alone; over noise: the residual over its sensor's noise"
)


def judge(fit: Fit, commands: Commands) -> Verdict:
    """Return the verdict on a fit: what forbids its use, each reason once with its places."""
    size = f"{fit.samples} samples"
    percents = [each.fit_percent for row in fit.outputs.values() for each in row.values()]
    if fit.met and not fit.outputs:
        return Verdict(met=True, text=f"Fit: converged, {size}; not judged, as diagnostics = False leaves that out")
    if fit.met:
        ends = list(dict.fromkeys(f"{end:.1f}" for end in (min(percents), max(percents)))) if percents else []
        outputs = f", outputs fit to {' to '.join(ends)} %" if ends else ""
        return Verdict(met=True, text=f"Fit: converged, {size}{outputs}{_name_silent(fit)}{_say_unsearched(fit)}")
    status = "" if fit.status == "converged" else f"{fit.status.replace('_', ' ')}, "
    errors = [(each.text, each.where) for each in fit.errors]
    if fit.status != "converged" and not _repeats(fit):
        errors.insert(0, (fit.message, ""))
    reasons = tuple(_group(errors))
    unsearched = any(each.kind == "unsearched" for each in fit.errors)
    first = "look for causes, without --no-causes and causes = false:" if unsearched else "correct the file, then"
    again = [Step.typed(first, commands.fit)] if commands.fit else []
    return Verdict(
        met=False,
        text=f"Fit: {status}{size}, {format_count(len(reasons), 'reason')} why it is not met{_name_silent(fit)}"
        f"{_say_unsearched(fit)}",
        reasons=reasons,
        next=(*_list_cures(fit, commands.plants), *again),
    )


def summarise(fit: Fit) -> list[KeyFigure]:
    """Return the least percentage that an output is fitted to."""
    percents = {
        f"{name}.{output}": output_fit.fit_percent
        for name, row in fit.outputs.items()
        for output, output_fit in row.items()
    }
    if not percents:
        return []
    least = min(percents, key=percents.__getitem__)
    return [KeyFigure(name="fit", value=f"{percents[least]:.2f} %", against=f"least of the outputs: {least}")]


def describe(fit: Fit) -> list[Section]:
    """Return the sections of a fit."""
    size = f"{fit.samples} samples, {format_count(fit.iterations, 'iteration')}, {fit.wall_s:.1f} s"
    return [
        Section(
            title="Parameters",
            aside=size,
            part="parameters",
            sentences=tuple(_list_caveats(fit)),
            tables=(_tabulate_parameters(fit),),
        ),
        *_describe_outputs(fit),
        *_describe_logs(fit),
        *list_notes("the fit", fit.notes, _list_findings(fit)),
        *_describe_details(fit),
    ]


def _list_caveats(fit: Fit) -> Iterator[str]:
    if not _repeats(fit):
        yield f"{_begin_sentence(fit, fit.message)}."
    if fit.caveat:
        yield f"{_begin_sentence(fit, fit.caveat)}."
    for direction in fit.identifiability.unidentifiable:
        yield f"Not identifiable: {' + '.join(f'{weight:.2g} {name}' for name, weight in direction.items())}."
    yield from _say_silent(fit)


def _begin_sentence(fit: Fit, text: str) -> str:
    """Return a text with a capital, but where it begins with a name: of a parameter, or of an experiment's output."""
    word = text.split(" ", 1)[0].rstrip(",;")
    return text if word in fit.parameters or not word.replace("-", "").isalpha() else f"{text[:1].upper()}{text[1:]}"


def _repeats(fit: Fit) -> bool:
    """Tell whether a fit's message says what one of its errors says, which the verdict has."""
    return any(fit.message in each.text or f"{each.where}: {each.text}" in fit.message for each in fit.errors)


def _name_silent(fit: Fit) -> str:
    """Return what the logs cannot tell, for the verdict; "" where there is nothing."""
    ties = [f"{join_words(list(each.shifts))} where {each.effect}" for each in fit.silent]
    rates = (each for each in fit.findings if each.kind == "command" and each.severity == "note")
    ties += [f"{each.where}.delay_s where the command was held at {each.rate_hz:.4g} Hz" for each in rates]
    return f"; cannot be told from such a log: {'; '.join(ties)}" if ties else ""


def _say_unsearched(fit: Fit) -> str:
    """Return that causes were not looked for, for the verdict; "" where they were, or where an error says it."""
    noted = any(each.kind == "unsearched" and each.severity == "note" for each in fit.findings)
    return "; causes were not looked for" if noted else ""


def _say_silent(fit: Fit) -> Iterator[str]:
    """Yield of each effect that no such log tells by how much the values would be other ones with it."""
    for each in fit.silent:
        moves: dict[str, list[str]] = {}
        for name, shift in each.shifts.items():
            parameter, moved = fit.parameters[name], abs(shift * each.size)
            of_value = format_percent(moved / abs(parameter.value), 2) if parameter.value else f"{moved:.3g}"
            unit = "" if parameter.value else unit_after(parameter.unit)
            moves.setdefault(f"{of_value}{unit} {'more' if shift * each.size > 0.0 else 'less'}", []).append(name)
        would = " and ".join(f"{join_words(names)} would be {by}" for by, names in moves.items())
        size = f"{each.size:.3g}{unit_after(each.unit)}"
        added = f"= {size} (part {each.part})" if each.part else f"{size} more"
        what = f"whether {each.effect}: with {each.parameter} {added} {would}"
        yield f"Such logs cannot tell {what}, and the outputs the same."


def _tabulate_parameters(fit: Fit) -> Table:
    rows = [
        (
            parameter.name,
            f"{parameter.value:.6g}",
            _spread(parameter.std),
            _spread(parameter.model_std),
            _interval(parameter.ci95),
            _known(parameter.known),
            _unit(parameter.unit),
            _remark(parameter),
            parameter.description,
        )
        for parameter in fit.parameters.values()
        if parameter.free
    ]
    for remark, figures in (("of one log", fit.own_unknowns), ("derived", fit.derived)):
        rows += [_tabulate_figure(name, figure, remark) for name, figure in figures.items()]
    return Table(
        label="Fitted parameters, and what follows from them",
        head=("parameter", "value", "std", "model std", "95 % interval", "known to", "unit", "", "meaning"),
        rows=tuple(rows),
        align="<>>>>><<<",
        optional=("model std", "95 % interval", "meaning"),
    )


def _describe_logs(fit: Fit) -> Iterator[Section]:
    """Yield what each log says alone, where several were compared."""
    if not fit.logs:
        return
    logs = tuple(
        (name, format_number(log.amplitude, 3), format_number(log.excess, 2)) for name, log in fit.logs.items()
    )
    rows = tuple(
        (parameter, f"{fit.parameters[parameter].value:.6g}", name, f"{value:.6g}", _spread(std))
        for parameter in fit.covariance.names
        for name, log in fit.logs.items()
        if parameter in log.values
        for value, std in [log.values[parameter]]
    )
    head = ("parameter", "by all", "log", "by it alone", "std")
    yield Section(
        title="Values by each log alone",
        part="parameters",
        tables=(
            Table(label="Logs that were compared", head=("log", "amplitude", "over noise"), rows=logs, align="<>>"),
            Table(label="Values by each log alone", head=head, rows=rows, align="<><>>"),
        ),
        remarks=("amplitude: standard deviation of the spring's force or torque, in the output's unit",),
    )


def _tabulate_figure(name: str, figure: DerivedFigure, remark: str) -> tuple[str, ...]:
    interval, percent = (_interval(figure.ci95), _known(figure.known)) if figure.total_std else ("", "")
    stds = (_spread(figure.std), _spread(figure.model_std))
    return (name, f"{figure.value:.6g}", *stds, interval, percent, _unit(figure.unit), remark, "")


def _describe_outputs(fit: Fit) -> Iterator[Section]:
    rows = [
        (
            f"{name}.{output}",
            f"{figures.fit_percent:.2f}",
            format_number(figures.holdout_fit_percent),
            format_number(figures.one_step_fit_percent),
            format_number(figures.band_fit_percent),
            _percent(figures.explained),
            _percent(figures.explainable),
            f"{figures.rms_residual:.4g}",
            _unit(figures.unit),
            format_number(figures.excess, 2),
            format_number(figures.sigma),
            format_number(fit.nuisance[name].offset.get(output), 3) if name in fit.nuisance else MISSING,
            format_number(figures.whiteness_p, 2),
        )
        for name, row in fit.outputs.items()
        for output, figures in row.items()
    ]
    columns = ("fit %", "held out", "one step", "in the band", "explained", "of at most", "residual", "", "over noise")
    more = ("sigma", "offset", "whiteness p")
    head = ("output", *columns, *more)
    table = Table(label="Fit of every output", head=head, rows=tuple(rows), align="<>>>>>>><>>>>", optional=more)
    if rows:
        yield Section(title="Fit of every output", part="fit", tables=(table,), remarks=(EXPLAINED,))


def _list_findings(fit: Fit) -> Iterator[Item]:
    """Yield what whoever uses the fit should know; errors stand in the verdict."""
    for finding in fit.findings:
        if finding.severity != "error":
            yield Item(severity=finding.severity, text=": ".join(filter(None, (finding.where, finding.text))))
    for name, nuisance in fit.nuisance.items():
        if (count := len(nuisance.initial_state)) > 1:
            yield Item(severity="note", text=f"{name}: {count} segments, each with its initial state")


def _describe_details(fit: Fit) -> Iterator[Section]:
    fixed = [parameter for parameter in fit.parameters.values() if not parameter.free]
    if fixed:
        rows = tuple(
            (parameter.name, f"{parameter.value:.6g}", _unit(parameter.unit), parameter.description)
            for parameter in fixed
        )
        head = ("parameter", "value", "unit", "meaning")
        table = Table(label="Fixed parameters", head=head, rows=rows, align="<><<")
        title = f"{format_count(len(fixed), 'parameter')} not fitted"
        yield Section(title=title, part="parameters", folded=True, tables=(table,))


def _group(pairs: Iterable[tuple[str, str]]) -> Iterator[Reason]:
    """Yield each text once, with the places that it is said of."""
    places: dict[str, list[str]] = {}
    for text, where in pairs:
        places.setdefault(text, []).append(where)
    for text, where in places.items():
        named = list(dict.fromkeys(filter(None, where)))
        what = ", ".join(named[:MOST_PLACES]) or "the fit"
        yield Reason(what=what, where=text, count=1 + len(named[MOST_PLACES:]))


def _list_cures(fit: Fit, plants: Mapping[str, Sequence[str]]) -> Iterator[Step]:
    """Yield what to write for the likely cause that is named first, with the lines, place by place. What is not told
    from zero is not to be freed, nor how sharp friction is: a search for that takes long and ends nowhere. What comes
    with a part comes with its line, beside the parts that the plant has. `plants`: the parts of each table.
    """
    named = (each for each in fit.findings if each.kind == "cause")
    cause = next((each for each in named if each.preferred or each.sticks or each.proposal), None)
    if cause is None:
        return
    trials = {name: row for row in reversed(fit.hypotheses) for name in row.frees}
    held = next((row for row in fit.hypotheses if row.holds and row.proposal == cause.proposal), None)
    added: dict[str, None] = dict.fromkeys(held.parts if held else ())
    places: dict[str, dict[str, None]] = {}
    for name in cause.preferred if cause.together is None else cause.together:
        value, std = cause.preferred[name]
        if abs(value) <= RESOLVED * std:
            continue
        if name in trials and name not in fit.parameters:
            added.update(dict.fromkeys(trials[name].parts))
            table, rows = PARAMETERS, spell_parameters(trials[name].frees, trials[name].fixed)
        else:
            declared = next(
                (each.plant.parameters[name] for each in fit.experiments if name in each.plant.parameters), None
            )
            table, *rows = spell_cure(name, value, _list_kept(declared, fit.parameters.get(name))) or [PARAMETERS]
        places.setdefault(table, {}).update(dict.fromkeys(rows))
    if not plants:
        recipes = [experiment.plant.recipe for experiment in fit.experiments[:1]]
        plants = {NAME: [part for recipe in recipes if recipe is not None for part in recipe.parts]}
    for name, parts in plants.items():
        rows = ["sticks = true"] if cause.sticks else []
        rows += spell_parts((*parts, *added)) if added else []
        if rows:
            yield _write_under(f"[plant.{name}]", rows)
    for name, hold in held.holds.items() if held else ():
        yield _write_under(f"[[experiment]], that of the name {name}", [spell_hold(hold)])
    for table, lines in places.items():
        if lines:
            yield _write_under(table, lines)


def _write_under(table: str, rows: Iterable[str]) -> Step:
    return Step(text=f"write under {table}, in place of a line of that name if there is one:", copied=tuple(rows))


def _list_kept(declared: object, stated: Parameter | None) -> dict[str, float]:
    """Return what a parameter's new line would lose: bounds that are closer than those of its plant, and a prior."""
    if not isinstance(declared, Parameter) or stated is None:
        return {}
    closer = {"min": stated.min > declared.min, "max": stated.max < declared.max}
    kept = {end: getattr(stated, end) for end, is_closer in closer.items() if is_closer}
    return kept if stated.prior_std is None else {**kept, "prior_std": stated.prior_std}


def spell_cure(name: str, value: float, kept: Mapping[str, float] | None = None) -> list[str]:
    """Return the place in a problem file and the line there that frees what a log would have otherwise, with its bounds
    and its prior, which are `kept`; nothing where there is no such line.
    """
    *experiment, parameter = name.split(".")
    if not experiment:
        numbers = dict(kept or {})
        inside = min(max(float(f"{value:.4g}"), numbers.get("min", -math.inf)), numbers.get("max", math.inf))
        rows = {"value": _spell(inside), "free": "true"} | {key: _spell(each) for key, each in numbers.items()}
        return [PARAMETERS, f"{parameter} = {{ {', '.join(f'{key} = {each}' for key, each in rows.items())} }}"]
    if parameter == "delay_s" and value > 0.0:
        settings = f"value = {value:.4g}, free = true, max = {DELAY_ROOM * value:.2g}"
        return [f"[[experiment]] {experiment[0]}, beside its log", f"delay_s = {{ {settings} }}"]
    return []


def _spell(number: float) -> str:
    """Return a number with all of its digits."""
    short = f"{number:.6g}"
    return short if float(short) == number else repr(float(number))


def _remark(parameter: Parameter) -> str:
    words = ["at its bound"] if parameter.at_bound else ["prior"] if parameter.prior_std is not None else []
    return ", ".join([*words, *([] if parameter.identified else ["not identified"])])


def _spread(std: float | None) -> str:
    return f"± {std:.2g}" if std else MISSING  # what is fixed has none


def _interval(ends: tuple[float, float] | None) -> str:
    finite = ends is not None and all(map(math.isfinite, ends))
    return " to ".join(format_number(end, 6) for end in ends) if ends is not None and finite else MISSING


def _known(share: float | None) -> str:
    """Return to how many percent a value is known; nothing of what an interval does not tell from zero."""
    return format_percent(share, 2) if share is not None and share < 1.0 else MISSING


def _percent(share: float | None) -> str:
    return MISSING if share is None else f"{100 * share:.1f} %"


def _unit(unit: str) -> str:
    return unit_after(unit).strip()
