"""A bring-up in words: sections for print, terminal and notebook, and the page to take to the machine."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.control import Controller, ForceMPC, ScheduledController
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.formatting import format_count, format_number, join_words
from seaopt.machine.bringup.expected import KEPT, Band, Expected, OuterExpected
from seaopt.machine.bringup.plan import BringUp, Stage
from seaopt.machine.response.verdicts import find_friction, has_dry_friction, list_limits
from seaopt.reporting.figures.panel import BAND, BLUE, VERMILION, Panel, frequency_panel, to_decibel
from seaopt.reporting.page.chart import make_chart
from seaopt.reporting.page.provenance import describe_provenance
from seaopt.reporting.page.render import write_result_page
from seaopt.reporting.sections.data import Commands, KeyFigure, Reason, Section, Step, Table, Verdict, mark_met
from seaopt.reporting.sections.kinds.certificate import find_remedy, state_failure
from seaopt.reporting.sections.kinds.controller import explain_sliding, say_bandwidths, show_stuck_bandwidth
from seaopt.reporting.sections.verdict import doubt_design
from seaopt.robustness.certificate.requirement import group_failures
from seaopt.units import mechanics_of, unit_after

PARTS = {"stages": "Stages", "provenance": "Provenance"}
ALWAYS = (
    "a signal is beyond its figure below.",
    "held grows, or status is the fault of the gate: the law has lost its reading.",
    "a tone is heard, or the command alternates from tick to tick: the loop is near its limit.",
)
BEGIN = (
    "begin with force_law_init and force_law_reset of what is read at that moment, without which the first command is "
    "a jump by what is read ({}/force_law_stage.c does all of it)"
)
BEGIN_PLAN = "begin with force_mpc_reset, at rest and with nothing loaded{} ({{}}/force_mpc_stage.c does all of it)"
TWO_BANDWIDTHS = (
    "Dry friction makes two bandwidths, of the full law {}: the first where the motor slides, the second in motions so "
    "small that it sticks; what is played lies between."
)
SLIDES = (
    "The bands are of the machine as it slides. It has {} of dry friction at the spring: motions whose force is not "
    "many times that lie outside the bands, also on a right machine. seaopt accept judges such logs at the amplitude "
    "that was played."
)
STILL = (
    "THIS STAGE DOES NOT MOVE THE MOTOR: its effort swings by {} at most, and dry friction holds {}; no amplitude "
    "within its share of the limits is above. It tells whether the law runs, at its rate, with the signs and units of "
    "command and reading, and whether the loop is quiet while the motor is stuck. It tells nothing of bandwidth, peaks "
    "and margins of the machine as it moves. Give it a larger --share or larger limits, or watch the next stage as "
    "the first that moves."
)
MOVED = "Its effort swings by {} at most, and dry friction holds {}: the motor moves."
KEEPS = f"Of certified machines {100.0 * KEPT:.0f} % stay below each figure that is expected at most."
UNDER = (
    "Under this reference the model has {}, simulated with its dry friction; with that seaopt accept compares the log."
)
BREAKS = "ITS LOG CANNOT CONFIRM {}: at this amplitude, beside dry friction, certified machines break {} themselves. {}"
ENOUGH = "Plan it again with --share {}, at which they keep all limits."
NO_SHARE = "No amplitude that was tried within the limits of command, travel and force avoids it; raise these limits."
LOWERED = (
    "At a share of {} they keep all, but the limit of the command stands in the way: its peak comes to it there, "
    "and such periods are lost. Raise that limit."
)
RAN_AWAY = (
    "THE LOOP RUNS AWAY on {} of the machines that this law is to run on: they are not among what is expected here, so "
    "that a machine may do more. Tune and certify it for them first."
)
UNTOLD = "{} cannot be confirmed in {}: see there."
HELD = "No motion is expected in {}: dry friction holds the motor there."
NEXT = "Go on to the next stage when the log of this one is accepted: seaopt accept PROBLEM LOG --stage NAME."


def judge(result: BringUp, commands: Commands) -> Verdict | None:
    """Return the verdict: whether the law of every stage is certified."""
    good = [stage for stage in result.stages if stage.met]
    failures = [(stage, failure) for stage in result.stages for failure in group_failures(stage.requirements)]
    reasons = tuple(
        Reason(
            what=f"{stage.name}: the certificate of its law failed, on {state_failure(failure)}",
            where=failure.worst.where,
            count=failure.count,
        )
        for stage, failure in failures
    )
    remedies = dict.fromkeys(filter(None, (find_remedy(failure.worst) for _, failure in failures)))
    text = f"Bring-up: {len(good)} of {format_count(len(result.stages), 'stage')} with a certified law"
    verdict = Verdict(met=result.met, text=text, reasons=reasons, next=tuple(Step(text=each) for each in remedies))
    return doubt_design(verdict, commands.fit) if result.fit_met is False else verdict


OUTER = (
    "These stages are of the force law alone: leave the outer loop out, with the link as in the design plant, and give "
    "the law the reference itself. Close the outer loop after the last stage, and log {}"
)
UNSTABLE = (
    "These stages are of the force law alone. DO NOT CLOSE ITS OUTER LOOP: by the model it is not stable with the link "
    "as in {}, so that there is no reference to play with it. Choose another stiffness or damping, and certify."
)
PLACE = (
    "its x_0 as the reference, with the link's position: seaopt accept replays both, and judges the loop with the "
    "outer loop in it. {}"
)
OVER = "Let x_0 move by the last stage's reference over the stiffness, {}."
PLAY_OUTER = (
    "Close the outer loop, with the link as in {}, and play {}/outer_reference.csv (or outer_reference.c) as {}: "
)
FORCE = "what step was given as the reference; or, with the link's position, the force that the damping is added to."


def summarise(result: BringUp) -> list[KeyFigure]:
    """Return the bandwidth of each stage."""
    return [
        KeyFigure(
            name=stage.name,
            value=say_bandwidths(stage.controller, stage.controller.spec.bandwidth_hz),
            against=stage.note,
        )
        for stage in result.stages
    ]


def _say_outer(stages: Sequence[Stage], outer: OuterLoop) -> str:
    """Return when to close the outer loop, and what to log then."""
    if any(stage.outer_unstable for stage in stages):
        return UNSTABLE.format(outer.plant or "the plant of the link")
    return OUTER.format(_say_logged(stages[-1], outer))


def _say_logged(stage: Stage, outer: OuterLoop) -> str:
    """Return what to log with an outer loop closed, and what to play where there is no reference for it."""
    if not outer.stiffness:
        return FORCE
    stiffness = f"{outer.stiffness:.4g} {mechanics_of(outer.place_unit).stiffness}"
    return PLACE.format("Its reference is below." if stage.around else OVER.format(stiffness))


def describe(result: BringUp) -> list[Section]:
    """Return a table of the stages, then each with what to play, to log, to expect, and when to stop."""
    rows = tuple(_list_row(stage) for stage in result.stages)
    head = ("stage", "law", "bandwidth (Hz)", "stuck (Hz)", "limit", "reference", "lasts (s)", "Ms expected")
    last = result.stages[-1].controller
    outer = () if last.outer is None else (_say_outer(result.stages, last.outer),)
    still = [stage.name for stage in result.stages if stage.still]
    held = [HELD.format(join_words(still))] if still else []
    held += [UNTOLD.format(join_words(stage.broken), stage.name) for stage in result.stages if stage.broken]
    overview = Section(
        title="Stages",
        part="stages",
        tables=(Table(head=head, rows=rows, align="<<>>>>>>"),),
        remarks=(*held, *_explain_bandwidths(last), *(f"Stop a stage when {text}" for text in ALWAYS), NEXT, *outer),
    )
    around = (_describe_outer(stage, stage.around) for stage in result.stages if stage.around is not None)
    return [overview, *(_describe_stage(stage) for stage in result.stages), *around]


def _explain_bandwidths(controller: Controller) -> tuple[str, ...]:
    """Return which bandwidth is which, where friction makes two."""
    stuck = show_stuck_bandwidth(controller)
    both = [TWO_BANDWIDTHS.format(say_bandwidths(controller, controller.spec.bandwidth_hz))] if stuck else []
    return (*both, *explain_sliding(controller))


def _explain_friction(controller: Controller) -> tuple[str, ...]:
    """Return of what the bands are where the plant has dry friction, which they leave out."""
    if not has_dry_friction(controller) or controller.design is None:
        return ()
    friction = find_friction(controller)
    return (SLIDES.format(f"{format_number(friction, 3)}{unit_after(controller.command.effort_unit)}"),)


def _say_whether_it_moves(stage: Expected) -> tuple[str, ...]:
    """Return whether what is played moves the motor, where it has dry friction."""
    if stage.effort is None or stage.friction is None:
        return ()
    unit = unit_after(stage.controller.command.effort_unit)
    sizes = (f"{format_number(value, 3)}{unit}" for value in (stage.effort, stage.friction))
    return ((STILL if stage.still else MOVED).format(*sizes),)


def say_prediction(stage: Expected) -> tuple[str, ...]:
    """Return what the model does under a stage's own reference beside the limits, and which it breaks."""
    if stage.prediction is None:
        return ()
    figures, peaks, limits = stage.prediction.figures, stage.prediction.peaks, list_limits(stage.controller)
    parts = [
        f"{name} {format_number(figures.get(name), 3)} ({format_number(peaks[name], 3)} at worst, "
        f"{format_number(limit, 3)} allowed)"
        for name, limit in limits.items()
    ]
    bandwidth, asked = (
        format_number(value, 3) for value in (figures.get("bandwidth"), stage.controller.spec.bandwidth_hz)
    )
    said = UNDER.format(join_words([*parts, f"a bandwidth of {bandwidth} Hz ({asked} Hz asked of it as it slides)"]))
    if not stage.broken:
        return (said,)
    remedy = NO_SHARE
    if stage.enough is not None:
        remedy = (LOWERED if stage.lowered else ENOUGH).format(format_number(stage.enough, 2))
    limit = "that limit" if len(stage.broken) == 1 else "those limits"
    return said, BREAKS.format(join_words(stage.broken), limit, remedy)


def _list_row(stage: Stage) -> tuple[Any, ...]:
    controller, excitation = stage.controller, stage.excitation
    unit, limit = unit_after(controller.command.reference_unit), controller.command_limit
    ms = format_number(max(stage.sensitivity.low), 3), format_number(max(stage.sensitivity.high), 3)
    return (
        stage.name,
        mark_met(stage.met, "certified", "not certified"),
        format_number(controller.spec.bandwidth_hz, 3),
        show_stuck_bandwidth(controller),
        "none" if limit is None else controller.command.show(limit),
        f"{format_number(excitation.bias, 3)} ± {format_number(excitation.amplitude, 3)}{unit}",
        format_number(excitation.lasts_s, 3),
        " to ".join(dict.fromkeys(ms)),
    )


def _describe_stage(stage: Stage) -> Section:
    controller = stage.controller
    source, name, begin = stage.source, "force_law", BEGIN
    held = f"Keep {source.over} at {format_number(stage.place)}." if isinstance(source, ScheduledController) else ""
    if isinstance(source, ForceMPC):
        terms = ", call force_mpc_terms before each step" if source.compensation or source.link else ""
        ahead = ", give force_mpc_step_ahead the references that follow" if source.spec.preview_samples else ""
        name, begin = "force_mpc", BEGIN_PLAN.format(terms + ahead)
    sentences = [
        *([held] if held else []),
        *([f"{stage.note[0].upper()}{stage.note[1:]}."] if stage.note else []),
        f"Flash {stage.name}/{name}.c, {begin.format(stage.name)}, play {stage.name}/reference.csv (or reference.c): "
        f"{_say_played(stage)}",
        f"Log in each tick, at {1.0 / controller.sample_time_s:g} Hz: {join_words(stage.channels)} "
        f"({stage.name}/{name}_log.c does).",
        f"Expect: a step of the reference{_say_size(stage)} peaks at {_say_top(stage)} of its size "
        f"({stage.name}/expected_step.csv); the response over frequency is in {stage.name}/expected_tracking.csv.",
        *_say_ran_away(stage),
        *_say_whether_it_moves(stage),
        *say_prediction(stage),
        *_explain_friction(controller),
        KEEPS,
    ]
    return Section(
        title=f"Stage {stage.name}", part="stages", sentences=tuple(sentences), tables=(_tabulate_peaks(stage),)
    )


def _describe_outer(stage: Stage, around: OuterExpected) -> Section:
    """Return what to play, to log and to expect with the outer loop closed."""
    controller, outer = around.controller, around.outer
    what = "x_0" if outer.stiffness else "the force that the damping is added to"
    given = f"{what}, {format_number(around.excitation.amplitude, 3)}{unit_after(around.unit)} at most"
    *before, command = stage.channels
    sentences = (
        PLAY_OUTER.format(outer.plant or "the plant of the link", stage.name, given) + _say_played(around),
        f"Log in each tick, at {1.0 / controller.sample_time_s:g} Hz: "
        f"{join_words(list(dict.fromkeys((*before, outer.position, command))))}; the reference is what was played, in "
        f"{around.unit}.",
        f"Expect: {around.follows} after a step of the reference{_say_size(around)} peaks at {_say_top(around)} of its "
        f"size ({stage.name}/expected_outer_step.csv); the response over frequency is in "
        f"{stage.name}/expected_outer_tracking.csv.",
        *_say_ran_away(around),
        *_say_whether_it_moves(around),
        *_explain_friction(controller),
        KEEPS,
    )
    title = f"Stage {stage.name}, with the outer loop"
    return Section(title=title, part="stages", sentences=sentences, tables=(_tabulate_peaks(around),))


def _say_played(expected: Expected) -> str:
    """Return how a reference goes on."""
    excitation = expected.excitation
    f, sets = excitation.frequency_hz, format_count(excitation.phases, "set")
    lasts = f"{format_number(excitation.period_s, 3)} s"
    return (
        f"it fades in over {lasts}, then {sets} of phases of {excitation.periods} periods of {lasts}, {f.size} lines "
        f"from {format_number(f[0], 3)} to {format_number(f[-1], 3)} Hz, then it fades out."
    )


def _say_ran_away(expected: Expected) -> list[str]:
    """Return that draws are not among what is expected, where their loop grows without end."""
    return [RAN_AWAY.format(format_count(expected.ran_away, "draw"))] if expected.ran_away else []


def _say_top(expected: Expected) -> str:
    """Return the peak of a step, from the least to the largest of the draws."""
    step = expected.step
    return " to ".join(dict.fromkeys(format_number(max(edge), 3) for edge in (step.low, step.high)))


def _tabulate_peaks(stage: Expected) -> Table:
    """Return how large signals may become."""
    controller, excitation = stage.controller, stage.excitation
    outputs = {} if controller.design is None else controller.see(controller.design[0]).outputs
    units = {controller.command.input: controller.command.unit, **outputs}
    rows = tuple(
        (
            name,
            f"{format_number(peak, 3)}{unit_after(units.get(name, ''))}",
            f"{format_number(stage.stop[name], 3)}{unit_after(units.get(name, ''))}",
            f"{format_number(limit, 3)}{unit_after(units.get(name, ''))}" if limit is not None else "",
        )
        for name, peak, limit in ((name, peak, excitation.limits.get(name)) for name, peak in excitation.peaks.items())
    )
    return Table(head=("signal", "expected at most", "stop beyond", "limit"), rows=rows, align="<>>>")


def _say_size(stage: Expected) -> str:
    """Return up to which size a step is one of the linear loop."""
    unit = unit_after(stage.unit)
    return "" if stage.step_size is None else f" of up to {format_number(stage.step_size, 3)}{unit}"


def _list_panels(name: str, stage: Expected) -> Iterator[Panel]:
    friction = _explain_friction(stage.controller)
    step, tracking = _say_width(stage.step), _say_width(stage.tracking)
    if friction:
        captions = [f"The band is that of the certificate's draws, {each}. {friction[0]}" for each in (step, tracking)]
    else:
        captions = [
            f"The step must lie in the band, which is that of the certificate's draws, {step}.",
            f"The measured response must lie in the band, {tracking}.",
        ]

    def draw_step(axis: Any) -> None:
        _draw_band(axis, stage.step, lambda values: np.asarray(values))

    def draw_tracking(axis: Any) -> None:
        _draw_band(axis, stage.tracking, to_decibel)

    yield Panel(
        name=f"step_{name}", title=f"{name}: step", draw=draw_step, x="time [s]",
        y=(f"{stage.follows} over the step [-]",), tight=True,
        caption=captions[0],
    )  # fmt: skip
    yield frequency_panel(
        name=f"tracking_{name}", title=f"{name}: tracking", draw=draw_tracking, y=("|Y/R| [dB]",),
        tight=True, caption=captions[1],
    )  # fmt: skip


def _draw_band(axis: Any, band: Band, scale: Any) -> None:
    axis.fill_between(band.at, scale(band.low), scale(band.high), color=BAND)
    for edge, label in ((band.low, "band of the draws"), (band.high, None)):
        axis.plot(band.at, scale(edge), color=VERMILION, linewidth=0.9, label=label)
    axis.plot(band.at, scale(band.nominal), color=BLUE, linewidth=0.9, linestyle="--", label="expected")


def _say_width(band: Band) -> str:
    """Return how wide a band is, which a figure may not show."""
    width = max(high - low for low, high in zip(band.low, band.high, strict=True))
    return f"at most {format_number(100.0 * width / max(band.high), 2)} % of the largest value wide"


def write_bring_up_page(
    result: BringUp,
    path: Path | str,
    *,
    title: str = "Bring-up",
    files: Sequence[Path | str] = (),
    command: str = "",
) -> Path:
    """Write an HTML page of a bring-up, to be printed; it needs no network and no other file.

    Parameters
    ----------
    result : BringUp
        Of `bring_up`.
    path : path
        The page.
    title : str
        Heading of the page.
    files : sequence of path
        What it was made of: the problem file.
    command : str
        What was typed to make it, to be stated.

    Raises
    ------
    FileError
        The folder cannot be written.
    """
    shown: dict[str, Expected] = {stage.name: stage for stage in result.stages}
    shown |= {f"{stage.name}_outer": stage.around for stage in result.stages if stage.around is not None}
    plates = [
        {"heading": name, "text": "", "charts": [make_chart(panel) for panel in _list_panels(name, each)]}
        for name, each in shown.items()
    ]
    return write_result_page(
        path,
        title=title,
        parts=PARTS,
        verdict=judge(result, Commands()),
        glance=summarise(result),
        sections=[*describe(result), describe_provenance((), files, command)],
        plates={"stages": plates},
    )
