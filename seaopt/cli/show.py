"""How results look on a terminal: the verdict with its reasons, then one screen of figures in tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from seaopt.cli.frontier import print_frontier
from seaopt.cli.terminal import Terminal
from seaopt.control import Controller, ForceMPC, ScheduledController
from seaopt.control.laws.command import name_gain_units
from seaopt.estimation import Fit, ModelledOutputs
from seaopt.formatting import MISSING, format_count, format_number, printable
from seaopt.parameters import Parameter
from seaopt.problem import Problem
from seaopt.reporting.verdict import Reason, StageVerdict
from seaopt.robustness import Certificate, ScheduleCertificate
from seaopt.units import unit_after

MOST_ROWS = 14  # of a table; --verbose prints them all
MOST_REASONS = 8
MOST_NOTES = 4
MOST_CHARACTERS = 240  # of a reason
MET, UNMET = ("met    ", "green"), ("not met", "red")


SIMULATED = (
    "simulation_NAME.csv: the plant with the values of [parameters], sensors ideal",
    "virtual_NAME.csv: the log of a virtual experiment, with its truth, noise and offsets, as a fit reads it",
)


def show_figures(console: Terminal, stage: str, results: Mapping[str, Any], problem: Problem) -> None:
    """Print one screen of a stage's figures."""
    match stage:
        case "simulate":
            for line in SIMULATED[: 2 if any(table.virtual for table in problem.table.experiment) else 1]:
                console.wrap(line)
        case "frf":
            results[stage].show(console)
        case "sweep":
            print_frontier(results[stage], console)
        case "fit":
            show_fit(console, results[stage], results.get("scores", ()))
        case "tune":
            show_designed(console, results[stage])
            if problem.mpc is not None:
                show_plan(console, results["mpc"])
        case "certify":
            show_certified(console, results[stage])
        case _:
            pass


def show_all(console: Terminal, stage: str, results: Mapping[str, Any], problem: Problem) -> None:
    """Print all that a result has to say."""
    if stage in ("frf", "simulate"):
        show_figures(console, stage, results, problem)
        for part in results[stage].values() if stage == "simulate" else results[stage].list_forms():
            console.say(repr(part))
        return
    console.say("")
    if stage == "tune" and "joint" in results:
        console.say(repr(results["joint"]))
    console.say(repr(results[stage]))
    for score in results.get("scores", ()) if stage == "fit" else ():
        console.say(repr(score))


def show_verdicts(console: Terminal, verdicts: Sequence[StageVerdict], *, verbose: bool = False) -> None:
    """Print a line per stage, below it what is not met, and at the end what to type next."""
    for verdict in verdicts:
        word, colour = MET if verdict.met else UNMET
        console.label(word, verdict.text, style=colour, indent=9)
        show_reasons(console, verdict.reasons, verbose=verbose)
        for text in verdict.next:
            advice, command, rest = text.partition("type seaopt")
            console.wrap(f"next: {advice}{'type' if command else ''}", indent=9)
            if command:  # on a line of its own, to be copied
                console.say(f"{' ' * 11}seaopt{rest}", soft_wrap=True)


def show_reasons(console: Terminal, reasons: Sequence[Reason], *, verbose: bool) -> None:
    """Print each reason once, with where it is worst and in how many places besides."""
    shown = reasons if verbose else reasons[:MOST_REASONS]
    for reason in shown:
        more = f" (and {reason.count - 1} more)" if reason.count > 1 else ""
        where = reason.where if verbose or len(reason.where) <= MOST_CHARACTERS else _cut(reason.where)
        console.wrap(f"{reason.what}{more}" + (f": {where}" if where else ""), indent=9)
    if len(reasons) > len(shown):
        console.wrap(f"and {len(reasons) - len(shown)} more: --verbose prints them", indent=9)


def _cut(text: str) -> str:
    return text[: MOST_CHARACTERS - 4].rsplit(" ", 1)[0] + " ..."


def show_fit(console: Terminal, fit: Fit, scores: Iterable[ModelledOutputs] = ()) -> None:
    """Print the parameters and how well each output is explained."""
    rows: list[tuple[str, ...]] = [
        (
            one.name,
            f"{one.value:.5g}",
            _spread(one.std),
            unit_after(one.unit).strip(),
            _state(one),
        )
        for one in fit.parameters.values()
        if one.free
    ]
    for what, figures in (("", fit.own_unknowns), ("derived", fit.derived)):
        for name, figure in figures.items():
            rows.append((name, f"{figure.value:.5g}", _spread(figure.std), unit_after(figure.unit).strip(), what))
    heading(console, "Fit", f"{fit.samples} samples, {format_count(fit.iterations, 'iteration')}, {fit.wall_s:.1f} s")
    _tabulate(console, rows, ("parameter", "value", "std", "unit", ""), "<>><<")
    outputs = [
        (f"{name}.{output}", f"{one.fit_percent:.2f}", format_number(one.holdout_fit_percent, 4),
         _percent(one.explained), _percent(one.explainable), f"{one.rms_residual:.4g}", unit_after(one.unit).strip())
        for name, row in fit.outputs.items()
        for output, one in row.items()
    ]  # fmt: skip
    for score in scores:
        outputs += [
            (f"{score.name}.{name} (not fitted)", f"{row['fit_percent']:.2f}", MISSING, MISSING, MISSING,
             f"{row['rms_residual']:.4g}", unit_after(row["unit"]).strip())
            for name, row in score.to_dict().items()
        ]  # fmt: skip
    _tabulate(
        console, outputs, ("output", "fit %", "held out", "explained", "of at most", "residual", ""), "<>>>>><"
    )  # fmt: skip
    warnings = [one for one in fit.findings if one.severity == "warning"]
    show_reasons(console, [Reason(what=f"warning, {one.where}", where=one.text) for one in warnings], verbose=False)
    hints = [f"{one.where}: {one.text}" if one.where else one.text for one in fit.findings if one.severity == "note"]
    _show_notes(console, [*hints, *fit.notes])


def show_controller(console: Terminal, controller: Controller) -> None:
    """Print the gains, and the figures of the design plant beside what was asked."""
    spec = controller.spec
    heading(
        console,
        "Controller",
        f"{controller.structure} on {spec.regulated}, {spec.sample_rate_hz:g} Hz, {controller.delays}",
    )
    units, command = name_gain_units(controller.command), controller.engineering
    gains = [
        (name, f"{value:.5g}", units.get(name, ""), *(
            (f"{command[name][0]:.5g}", command[name][1]) if name in command else ("", "")
        ))
        for name, value in controller.gains.items()
    ]  # fmt: skip
    _tabulate(console, gains, ("gain", "value", "", f"as {controller.command.word}", ""), "<><><")
    _tabulate(console, controller.list_achieved(), (controller.judged_on, "achieved", "asked"), "<><")
    if controller.compensation is not None:
        for line in controller.compensation.describe(controller.command.effort_unit):
            console.wrap(f"compensates {line}", indent=2)
    _show_notes(console, controller.notes)


def show_plan(console: Terminal, mpc: ForceMPC) -> None:
    """Print the limits that a predictive controller plans within."""
    console.wrap(f"plans within {mpc.describe_limits()}; the figures are those while no limit is active", indent=2)
    for name, (low, high) in mpc.spec.bounds.items():
        unit = mpc.kalman.units[mpc.kalman.names.index(name)]
        console.wrap(f"{name} within {low:g} and {high:g} {unit}".rstrip(), indent=2)


def show_designed(console: Terminal, result: Controller | ScheduledController) -> None:
    """Print what was tuned: one law, or the gains at the points of a schedule."""
    if isinstance(result, Controller):
        show_controller(console, result)
        return
    spec = result.spec
    heading(
        console, "Schedule", f"{spec.structure} on {spec.regulated} over {result.over}, {spec.sample_rate_hz:g} Hz, "
        f"{result.controllers[0].delays}"
    )  # fmt: skip
    rows, heads, gains = result.list_rows(), result.row_heads, len(result.table.gains) + 1
    _tabulate(console, [row[:gains] for row in rows], heads[:gains], ">" * gains)
    _tabulate(console, [(row[0], *row[gains:]) for row in rows], (heads[0], *heads[gains:]), ">>>><")
    console.wrap(result.describe_between(), indent=2)
    _show_notes(console, result.notes)


def show_certified(console: Terminal, result: Certificate | ScheduleCertificate) -> None:
    """Print what was certified: one law, or a schedule at its points, between them and in sweeps."""
    if isinstance(result, Certificate):
        show_certificate(console, result)
        return
    heading(console, "Certificate", str(result.monte_carlo).split(":")[0])
    rows = [row for row, place in zip(result.list_rows(), result.places, strict=True) if place.point]
    _tabulate(console, rows, result.row_heads, "><>>><")
    between = [place for place in result.places if not place.point]
    if between:
        console.wrap(
            f"between the points, at {format_count(len(between), 'value')}: Ms up to "
            f"{max(place.ms for place in between):.3f}", indent=2,
        )  # fmt: skip
    for note in result.notes:
        console.wrap(note, indent=2)


def show_certificate(console: Terminal, certificate: Certificate) -> None:
    """Print the margins of each plant, nominal and in the worst case, and what was simulated."""
    heading(console, "Certificate", certificate.draws.split(":")[0])
    rows: list[tuple[str, ...]] = []
    for name, figures in certificate.plants.items():
        worst, margins = certificate.worst[name], certificate.margins[name]
        if not figures.stable:
            rows.append((name, "unstable", *[MISSING] * 7))
            continue
        late = margins.sampled_delay_s
        rows.append((
            name, f"{figures.ms:.3f}", f"{worst.ms:.3f}", f"{figures.mt:.3f}", f"{worst.mt:.3f}",
            format_number(margins.margins.gain_up_db, 3), format_number(figures.phase_margin_deg, 3),
            f"{1e3 * late:.3g}" if late is not None else f"> {1e3 * margins.searched_delay_s:.2g}",
            format_number(figures.disk_margin, 3),
        ))  # fmt: skip
    _tabulate(
        console, rows, ("plant", "Ms", "worst", "Mt", "worst", "gain dB", "phase °", "delay ms", "disk"), "<>>>>>>>>"
    )  # fmt: skip
    if certificate.simulated is not None and certificate.simulated.verification is not None:
        runs = certificate.simulated.verification
        failed = len(runs.failures)
        console.wrap(f"simulation: {failed} of {len(runs.rows)} runs failed" if failed else
                     f"simulation: {len(runs.rows)} runs passed", indent=2)  # fmt: skip
        for line in runs.describe_tracking():  # no step is judged where the link gives way
            console.wrap(line, indent=2)
    _show_notes(console, certificate.notes)


def heading(console: Terminal, title: str, text: str) -> None:
    """Print the line above a result's tables."""
    console.say("")
    console.say(title, style="bold", end="  ")
    console.say(text, style="dim")


def _tabulate(console: Terminal, rows: Sequence[Sequence[str]], head: Sequence[str], align: str) -> None:
    if not rows:
        return
    console.tabulate(rows[:MOST_ROWS], head, align)
    if len(rows) > MOST_ROWS:
        console.wrap(f"and {len(rows) - MOST_ROWS} more: --verbose prints them", indent=2)


def _show_notes(console: Terminal, notes: Sequence[str]) -> None:
    """Print the beginning of each note on one line."""
    room, cut = console.width - 2, False
    for note in notes[:MOST_NOTES]:
        line = f"note: {printable(note)}"
        cut = cut or len(line) > room
        console.say(f"  {line if len(line) <= room else line[: room - 1] + '…'}", style="dim", soft_wrap=True)
    if cut or len(notes) > MOST_NOTES:
        console.say(f"  {format_count(len(notes), 'note')}: --verbose prints all of it", style="dim")


def _spread(std: float | None) -> str:
    return f"± {std:.2g}" if std else MISSING  # what is fixed has none


def _state(parameter: Parameter) -> str:
    return "at bound" if parameter.at_bound else "prior" if parameter.prior_std is not None else ""


def _percent(share: float | None) -> str:
    return MISSING if share is None else f"{100 * share:.1f} %"
