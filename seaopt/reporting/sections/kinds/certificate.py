"""A certificate in words: its verdict with remedies, margins, requirements, worst cases and draws."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from seaopt.control import Controller, ScheduledController
from seaopt.control.laws.limits import BY_REQUIREMENT, OTHER_NOISE
from seaopt.control.laws.verdict import advise_easing
from seaopt.formatting import MISSING, format_band, format_count, format_number, format_values, join_words
from seaopt.reporting.figures.certificate import label_requirement
from seaopt.reporting.sections.data import (
    Cell,
    Commands,
    KeyFigure,
    Mark,
    Reason,
    Section,
    Step,
    Table,
    Verdict,
    list_notes,
    mark_met,
    show_limit,
)
from seaopt.reporting.sections.kinds.controller import explain_sliding, show_costs
from seaopt.reporting.sections.kinds.simulated import list_left_out, summarise_findings
from seaopt.reporting.sections.kinds.verification import describe_steps
from seaopt.robustness import Certificate, PlantMargins
from seaopt.robustness.certificate.certificate import NO_MODEL
from seaopt.robustness.certificate.compensation import GRAVITY_COMPENSATION
from seaopt.robustness.certificate.requirement import DESIGN_PLANT, Failure, Requirement, group_failures
from seaopt.robustness.certificate.scheduled import name_rate_unit
from seaopt.robustness.certificate.simulated import SIMULATION_FAILURES
from seaopt.robustness.uncertainty.draws import Plants
from seaopt.units import unit_after

FROM_DRAWS = ("monte_carlo_failures", "worst_case", "max_failure_probability")
RETUNE = "retune = 4 in [robustness] tunes for the worst cases, too"
REPLAN = "a lower bandwidth_hz in [controller], or narrower ranges in [robustness]"  # what plans is not tuned again
REMEDIES = {
    **dict.fromkeys(FROM_DRAWS, RETUNE),
    "step_overshoot": "lower max_reference_peak in [controller]",
    "step_settling_s": "a lower bandwidth_hz in [controller]",
    "steady_error": "a lower bandwidth_hz in [controller]",
    "sustained_oscillation": "a lower bandwidth_hz, or min_friction_margin in [controller]",
    "impedance_stable": "less stiffness, or more damping, in [impedance]",
    "impedance_rest": "less stiffness, or more damping, in [impedance]",
    "impedance_draws": "less stiffness, or more damping, in [impedance]",
    "impedance_damper": "other stiffness, damping or velocity_filter_s in [impedance], inside the region of the report",
    GRAVITY_COMPENSATION: "a smaller fraction of gravity in compensate of [controller], or an [impedance]",
    "ripple_compensation": "a smaller fraction of ripple, or fewer of its cycles, in compensate of [controller]",
    "friction_compensation": 'from = "reference", a larger speed or a smaller fraction in compensate of [controller]',
    "constrained_failure_probability": "more constrained_runs in [robustness]",
    "min_schedule_rate": "a smaller min_rate in [controller.schedule], or a higher bandwidth_hz",
    "log_sensitivity": "seaopt fit --explain, which names what the model may lack, or a lower bandwidth_hz",
    "log_agreement": "seaopt fit with that log, too, or --explain; another actuator, or a column in another unit?",
    "limit_cycle": "a lower bandwidth_hz, or min_friction_margin in [controller]",
}
SLOWER = "a lower bandwidth_hz, or more reserve, in [controller]"
# What a run did that it may not, by the kind of its fault, and what to change.
CAUSES = {
    "overflow": ("its numbers overflow", SLOWER),
    "unstable": ("the loop is unstable in its last phase", SLOWER),
    "growth": ("a motion grows under a constant reference", SLOWER),
    "outbreak": ("noise sets off a motion that grows", SLOWER),
    "gate": ("the gate takes a true reading for a fault", ""),
    "current": ("the command is above its limit", ""),
    "rest": ("the limit of the command does not hold the plant at rest", "a larger limit of the command"),
    "no event": ("what is to happen does not", ""),
    "not simulated": (
        "a scenario could not be simulated to its accuracy, so that nothing is known of it",
        "sticks = true of the plant, a larger v_s, or narrower ranges of its friction",
    ),
}


RISK = "By chance one of what states a risk is wrong with a probability of {:.2g} at most, the sum of these shares."
# The limits that keep the feedback from doing more, by what asks it to.
MORE_FEEDBACK = ("max_sensitivity", "max_complementary", "min_disk_margin", "max_noise_gain", OTHER_NOISE)
EASED_BY: dict[str, tuple[str, ...]] = {"step_settling_s": MORE_FEEDBACK, "steady_error": MORE_FEEDBACK}


SWINGS = (
    "A swinging output puts a zero of the plant near 1 Hz that no controller can fill, so that its −3 dB bandwidth is "
    "no measure of tracking: read the tracking band."
)


def judge(certificate: Certificate, commands: Commands) -> Verdict:
    """Return the verdict on a certificate, and what could not be checked."""
    verdict = _judge_checked(certificate, commands)
    unchecked = certificate.unchecked
    if not unchecked:
        return verdict
    text = f"{verdict.text}; {join_words(list(unchecked))} NOT CHECKED"
    reasons = [Reason(what=f"{what} could not be checked", where=why) for what, why in unchecked.items()]
    return replace(verdict, text=text, reasons=(*verdict.reasons, *reasons))


def _judge_checked(certificate: Certificate, commands: Commands) -> Verdict:
    if certificate.schedule is not None:
        return _judge_schedule(certificate, certificate.schedule, commands)
    draws = certificate.monte_carlo
    if certificate.met:
        runs = "" if certificate.runs is None else f", {len(certificate.runs.rows)} simulated runs passed"
        if not certificate.models:
            return Verdict(met=True, text=f"Certificate: passed, {NO_MODEL}")
        if not draws.samples:
            text = f"Certificate: passed, nothing was uncertain, so that nothing was drawn{runs}"
            return Verdict(met=True, text=text, next=_advise_ranges(certificate) if commands.certify else ())
        bound = f", failure probability below {draws.failure_probability_bound:.2g}"
        text = f"Certificate: passed, {format_count(draws.failures, 'failure')} in {draws.samples} draws{bound}{runs}"
        return Verdict(met=True, text=text)
    broken = [row for row in certificate.requirements if not row.met]
    failures = group_failures(broken)
    controller, models = certificate.controller, certificate.models
    reasons = [explain_failure(failure, controller, models=models) for failure in failures]
    remedies = [advise(failure.worst, controller, models=models) for failure in failures]
    if certificate.fails_by_weight:
        remedies = [REMEDIES[GRAVITY_COMPENSATION]]
    if certificate.constrained is not None:
        remedies = [certificate.constrained.remedy, *(REPLAN if text == RETUNE else text for text in remedies)]
    first = next((text for text in remedies if text), "")
    again = _repeat(first, commands, otherwise="tune and certify again")
    costs = show_costs(certificate.controller.spec.bandwidth_hz, commands)
    return Verdict(
        met=False,
        text=f"Certificate: failed, {len(broken)} of {len(certificate.requirements)} requirements not met",
        reasons=tuple(reasons),
        next=(again, *([costs] if certificate.constrained is None else ())),
    )


def _judge_schedule(certificate: Certificate, schedule: ScheduledController, commands: Commands) -> Verdict:
    """Return the verdict on a schedule's certificate, with its assumption."""
    draws = certificate.monte_carlo
    if certificate.met:
        drawn = (
            f"{format_count(draws.failures, 'failure')} in {draws.samples} draws"
            if draws.samples
            else "nothing was uncertain, so that nothing was drawn"
        )
        rate = f"{certificate.fastest:.3g} {name_rate_unit(schedule)}"
        swept = f"; {schedule.over} up to {rate} in sweeps" if certificate.sweeps else ""
        return Verdict(met=True, text=f"Certificate: passed with {schedule.over} standing still, {drawn}{swept}")
    broken = [row for row in certificate.requirements if not row.met]
    laws, models = schedule.controllers, certificate.models
    remedies = (row.remedy or advise(row, *laws, models=models) for row in broken)
    if certificate.fails_by_weight:
        remedies = iter([REMEDIES[GRAVITY_COMPENSATION]])
    change = next((text for text in remedies if text), "raise reserve, or add points")
    return Verdict(
        met=False,
        text=f"Certificate: failed, {len(broken)} of {len(certificate.requirements)} requirements not met",
        reasons=tuple(explain_failure(failure, *laws, models=models) for failure in group_failures(broken)),
        next=(Step(text=schedule.remedy) if schedule.remedy else _repeat(change, commands, otherwise="tune again"),),
    )


def _repeat(change: str, commands: Commands, *, otherwise: str) -> Step:
    """Return what to change, and the command that certifies again; `otherwise` where no command was typed."""
    first = f"{change}; then" if change else ""
    return Step.typed(first, commands.certify) if commands.certify else Step(text=f"{first} {otherwise}".strip())


def _advise_ranges(certificate: Certificate) -> tuple[Step, ...]:
    """Return the line of the file that makes something uncertain: a tenth about the first parameter that is not 0."""
    for plant in certificate.linear_models.values():
        for name in plant.parameters:
            value = certificate.parameters[name].value if name in certificate.parameters else 0.0
            if value:
                low, high = sorted((0.9 * value, 1.1 * value))
                row = f"parameters = {{ {name} = [{low:.3g}, {high:.3g}] }}"
                return (Step(text="to certify what is not known well add to [robustness]:", copied=(row,)),)
    return ()


def advise(row: Requirement, *controllers: Controller, models: Plants) -> str:
    """Return what to change where a requirement is not met: by the limits that bind in the laws it is of."""
    limit, remedy = BY_REQUIREMENT.get(row.name), find_remedy(row)
    if limit is not None:
        plants = {DESIGN_PLANT, *(name for law in controllers for name in law.robust_to)}
        designs = [law.design[0] for law in controllers if law.design is not None]
        plants |= {name for name, model in models.items() if any(model is design for design in designs)}
        tuned = all(law.met and law.structure != "custom" for law in controllers)
        if limit.scope == "every plant" and row.plant not in plants and tuned:
            return f'add "{row.plant}" to robust_to in [controller]'
        unmet = [text for law in controllers if not law.met for text in law.blocked_by]
        remedy = f"the tuning says why: {unmet[0]}" if unmet else limit.remedy
    among = EASED_BY.get(row.name, ()) if limit is None else limit.eased_by
    easing = advise_easing([limit for law in controllers for limit in law.binding], among)
    return f"{remedy}, or {easing}" if easing else remedy


def explain_failure(failure: Failure, *controllers: Controller, models: Plants) -> Reason:
    """Return what a certificate fails on, by its worst case; `controllers`: the laws it is of."""
    row = failure.worst
    if failure.unstable:
        return Reason(
            what=state_failure(failure), where=f"{advise(row, *controllers, models=models)}{failure.consequence}"
        )
    return Reason(what=state_failure(failure), where=row.where, count=failure.count)


def state_failure(failure: Failure) -> str:
    """Return what a certificate fails on, by its worst case: the figure and its limit, and what a run did."""
    row = failure.worst
    if failure.unstable:
        return f"unstable on {', '.join(failure.subjects)}"
    value, limit = format_number(row.value, 4), format_number(row.limit, 4)
    cause = CAUSES[row.cause][0] if row.cause in CAUSES else row.cause
    counted = row.name == SIMULATION_FAILURES and cause  # what has a figure of its own is said by its name
    return f"{row.name} {value}, limit {row.sense} {limit}{f' ({cause})' if counted else ''}"


def find_remedy(row: Requirement) -> str:
    """Return what to change where a requirement is not met, whatever binds in its law, besides its own remedy."""
    limit = BY_REQUIREMENT.get(row.name)
    by_cause = CAUSES[row.cause][1] if row.name == SIMULATION_FAILURES and row.cause in CAUSES else ""
    return REMEDIES.get(row.name, by_cause if limit is None else limit.remedy)


def summarise(certificate: Certificate) -> list[KeyFigure]:
    """Return the largest Ms found, and how many draws failed; nothing of measured points alone, or of a schedule."""
    if not certificate.models or certificate.schedule is not None:
        return []
    level, draws = certificate.controller.spec.level("max_sensitivity"), certificate.monte_carlo
    ms = max(worst.ms for worst in certificate.worst.values())
    on = f"on {format_count(len(certificate.plants), 'plant')}" + ("" if level is None else f", at most {level:g}")
    figures = [KeyFigure(name="worst Ms found", value=format_number(ms, 3), against=on)]
    if draws.samples:
        failed = f"{draws.failures} of {draws.samples}"
        figures.append(KeyFigure(name="draws failed", value=failed, against="all plants together"))
    return figures


def describe(certificate: Certificate) -> list[Section]:
    """Return the margins of every plant, the requirements, the worst cases, the draws, and the findings; of a schedule
    the figures at every value of its variable.
    """
    if certificate.schedule is not None:
        return [
            _tabulate_places(certificate, certificate.schedule),
            *list_notes("the schedule's certificate", certificate.notes),
        ]
    simulated = certificate.simulated
    left_out = [] if simulated is None else list_left_out(simulated, simulated.unchecked)
    return [
        _list_requirements(certificate),
        Section(
            title="Margins on every plant",
            aside=certificate.monte_carlo.count_text if certificate.models else "measured points alone",
            part="certificate",
            tables=(_tabulate_margins(certificate),),
            remarks=(
                "Stability by eigenvalues, peaks and crossings by level sets, not off a grid. Gain: how far it may rise"
                "; the delay margin is that of the sampled loop with the delay in it; worst: of the worst case found.",
                *([SWINGS] if _swings(certificate) else []),
                *(explain_sliding(law) if isinstance(law := certificate.controller, Controller) else ()),
                *_describe_simulation(certificate),
            ),
        ),
        *(_describe_uncertainty(certificate) if certificate.models else ()),
        *_describe_logs(certificate),
        *_describe_draws(certificate),
        *list_notes("the certificate", [*certificate.notes, *left_out]),
    ]


def _tabulate_places(certificate: Certificate, schedule: ScheduledController) -> Section:
    """Return the figures at every value of a schedule's variable."""
    rows = tuple(
        (
            f"{value:.4g}",
            "point" if value in schedule.points else "between",
            f"{max(figures.ms for figures in each.plants.values()):.3f}",
            f"{max(figures.mt for figures in each.plants.values()):.3f}",
            f"{max(case.ms for case in each.worst.values()):.3f}",
            f"{each.monte_carlo.failures} of {each.monte_carlo.samples}",
        )
        for value, each in zip(certificate.values, certificate.places, strict=True)
    )
    head = (f"{schedule.over}{unit_after(schedule.unit)}", "", "Ms", "Mt", "worst Ms", "draws that fail")
    return Section(
        title="What is certified",
        aside=certificate.monte_carlo.count_text,
        part="schedule",
        tables=(Table(head=head, rows=rows, align="><>>>>"),),
        remarks=(f"{certificate.monte_carlo}.",),
    )


def _swings(certificate: Certificate) -> bool:
    """Tell whether the -3 dB bandwidth of some plant says nothing: it has fallen before its tracking band starts. That
    may start above 0 Hz for a peak of the reference, too.
    """
    bands = ((figures.tracking_band_hz, figures.bandwidth_hz) for figures in certificate.plants.values())
    return any(band is not None and band[0] > 1.0 and (hz is None or hz < band[0]) for band, hz in bands)


def _tabulate_margins(certificate: Certificate) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name, figures in certificate.plants.items():
        worst = certificate.worst[name]
        margins = certificate.margins.get(name)  # none between the points of a schedule
        if not figures.stable:
            rows.append((name, Mark(text="unstable", style="bad"), *[MISSING] * 10))
            continue
        rows.append(
            (
                name,
                f"{figures.ms:.3f}",
                f"{worst.ms:.3f}",
                f"{figures.mt:.3f}",
                f"{worst.mt:.3f}",
                format_number(margins and margins.margins.gain_up_db, 3),
                format_number(figures.phase_margin_deg, 3),
                MISSING if margins is None else _format_delay(margins),
                format_number(figures.disk_margin, 3),
                format_band(figures.tracking_band_hz, missing=MISSING),
                format_number(figures.bandwidth_hz),
                format_number(margins and margins.margins.gain_down_db, 3),
            )
        )
    head = ("plant", "Ms", "worst Ms", "Mt", "worst Mt", "gain dB", "phase °", "delay ms", "disk")
    more = ("tracking band Hz", "bandwidth Hz", "gain down dB")
    return Table(head=(*head, *more), rows=tuple(rows), align="<".ljust(12, ">"), optional=more)


def _format_delay(margins: PlantMargins) -> str:
    """Return the delay, in ms, by which a loop may be later."""
    late = margins.sampled_delay_s
    return f"> {1e3 * margins.searched_delay_s:.2g}" if late is None else f"{1e3 * late:.3g}"


def _describe_simulation(certificate: Certificate) -> Iterator[str]:
    """Yield what was found in simulation, and at the link."""
    if certificate.runs is not None:
        yield from describe_steps(certificate.runs)
    if certificate.simulated is not None:
        yield from summarise_findings(certificate.simulated)
    if certificate.impedance is not None:
        yield from (f"impedance: {line}" for line in certificate.impedance.lines())


def _describe_logs(certificate: Certificate) -> Iterator[Section]:
    """Yield what the fit's logs say of the loop."""
    rows = tuple(
        (
            verdict.experiment,
            verdict.samples,
            verdict.outcome,
            format_number(verdict.ms, 3),
            format_number(verdict.ms_predicted, 3),
            format_number(verdict.ms_hz, 3),
            format_number(verdict.ms_least, 3),
            format_band(verdict.band_hz),
            f"{verdict.amplitude:.3g} {verdict.unit}" + (", and at that alone" if verdict.at_amplitude else ""),
        )
        for verdict in certificate.logs
    )
    figures = ("Ms measured", "predicted", "at Hz", "at least", "tells at Hz")
    head = ("log", "samples", "says", *figures, "rms of the input")
    if rows:
        yield Section(
            title="What the logs of the fit say of the loop",
            part="certificate",
            screen=False,
            tables=(Table(head=head, rows=rows, align="<<<>>>>><"),),
            remarks=(
                "The response of each log, what the model leaves of it included, under the law. Samples that were "
                "fitted are not independent: they can refute the law, and confirm nothing. Beyond the band, and where "
                "a resonance is narrower than its lines, a log says nothing.",
            ),
        )


def _describe_draws(certificate: Certificate) -> Iterator[Section]:
    """Yield what the draws of the simulated runs are."""
    drawn = {} if certificate.runs is None else certificate.list_draws()
    runs = [f"draw {number} on {name}" for name, draws in drawn.items() for number in range(1, len(draws) + 1)]
    if runs:
        states = " (with friction sliding, and stuck)" if any(len(draws) > 1 for draws in drawn.values()) else ""
        sentence = (
            "Every scenario is simulated at the nominal parameters and at the worst case that the certificate found on "
            f"its plant{states}: {join_words(runs)}."
        )
        yield Section(title="Parameters of the simulated runs", part="simulation", screen=False, sentences=(sentence,))


def _list_requirements(certificate: Certificate) -> Section:
    """Return what is missed, each kind once with its count, and then what is met."""
    groups = [(failure.worst, failure.count) for failure in group_failures(certificate.requirements)]
    groups += [(row, 1) for row in certificate.requirements if row.met]
    rows = tuple(
        (
            mark_met(row.met),
            label_requirement(row),
            format_number(row.value),
            show_limit(row.sense, row.limit, row.tolerance),
            unit_after(row.unit).strip(),
            (f"{row.where} (the worst of {count} such failures)" if count > 1 else row.where)
            + ("" if row.risk is None else f"; {row.scope}, risk {row.risk:.2g}"),
        )
        for row, count in groups
    )
    unchecked = Mark(text="not checked", style="warning")  # why is beside the verdict
    rows += tuple((unchecked, what, MISSING, "", "", "") for what in certificate.unchecked)
    head = ("verdict", "requirement", "value", "limit", "unit", "where")
    remark = (
        "Worst case, of its limits: the largest share of a limit that the worst parameters found use; 1 is all of it."
        if certificate.models
        else f"{certificate.draws[:1].upper()}{certificate.draws[1:]}. Every response in the discs about the points "
        "keeps the limits above."
    )
    return Section(
        title="Requirements",
        part="certificate",
        screen=False,
        tables=(Table(head=head, rows=rows, align="<<>><<"),),
        remarks=(remark, *([RISK.format(certificate.risk)] if certificate.risk else ())),
    )


def _describe_uncertainty(certificate: Certificate) -> Iterator[Section]:
    """Yield the worst cases, what was drawn, and the perturbations that each loop survives."""
    rows = tuple(
        (
            name,
            format_number(worst.ms),
            format_number(worst.witness.ms_hz),
            format_number(worst.mt),
            format_number(worst.witness.spectral_radius, 6),
            format_values(worst.parameters, 5, "nominal")
            + "".join(
                f"; largest {figure} at {format_values(at.parameters)}" for figure, at in worst.elsewhere.items()
            ),
        )
        for name, worst in certificate.worst.items()
    )
    limits = tuple(f"{name}: {bracket.statement}" for name, bracket in certificate.brackets.items())
    yield Section(
        title="Worst case found",
        part="certificate",
        screen=False,
        tables=(Table(head=("plant", "Ms", "at Hz", "Mt", "radius", "parameters"), rows=rows, align="<>>>><"),),
        remarks=(
            *limits,
            "Found among the draws and by a search from the worst of them and from vertices of the ranges, over 99.9 % "
            "of the fit's distribution and all of the ranges; there may be worse cases"
            f"{', up to the bounds' if limits else ''}. certificate.worst[plant].verify(controller) checks each again.",
        ),
    )
    draws = certificate.monte_carlo
    varied = tuple(
        (
            each.name,
            "uniform" if each.std is None else "Gaussian, correlated as fitted",
            format_number(each.value),
            format_number(each.std, 2),
            format_number(each.low),
            format_number(each.high),
            each.unit,
        )
        for each in certificate.varied
    )
    head = ("varied", "distribution", "nominal", "std", "from", "to", "unit")
    yield Section(
        title="Probability of failure",
        part="certificate",
        screen=False,
        sentences=(f"{draws}, seed {draws.seed}." if draws.samples else f"{draws}.",),
        tables=(Table(label="What is drawn", head=head, rows=varied, align="<<>>>><"),),
    )
    disks = tuple(
        (
            name,
            kind,
            format_number(disk.alpha, 3),
            format_number(disk.frequency_hz),
            f"{disk.perturbation.real:.4g}{disk.perturbation.imag:+.4g} j",
            f"{disk.gain_range[0]:.3g} to {format_number(disk.gain_range[1], 3)}",
            f"± {disk.phase_deg:.3g}",
        )
        for name, margins in certificate.margins.items()
        for kind, disk in margins.margins.disks.items()
    )
    head = ("plant", "disk", "size", "at Hz", "factor on the loop", "gains inside", "phases inside °")
    yield Section(
        title="Smallest destabilising perturbations",
        part="certificate",
        folded=True,
        tables=(Table(head=head, rows=disks, align="<<>>>>>"),),
        remarks=("The loop survives every factor inside the disk; the factor named puts a pole on the unit circle.",),
    )
