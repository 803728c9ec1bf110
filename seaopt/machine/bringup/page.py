"""A bring-up in words: sections for print, terminal and notebook, and the page to take to the machine."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.control import Controller, ForceMPC, ScheduledController
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.formatting import format_count, format_number, join_words
from seaopt.machine.bringup.stages import Band, BringUp, Stage
from seaopt.machine.response.verdicts import find_friction, has_dry_friction
from seaopt.reporting.figures.panel import BAND, BLUE, VERMILION, Panel, frequency_panel, to_decibel
from seaopt.reporting.page.chart import make_chart
from seaopt.reporting.page.provenance import describe_provenance
from seaopt.reporting.page.render import write_result_page
from seaopt.reporting.sections.data import Commands, KeyFigure, Reason, Section, Table, Verdict, mark_met
from seaopt.reporting.sections.kinds.controller import explain_sliding, say_bandwidths, show_stuck_bandwidth
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
HELD = "No motion is expected in {}: dry friction holds the motor there."
NEXT = "Go on to the next stage when the log of this one is accepted: seaopt accept PROBLEM LOG --stage NAME."


def judge(result: BringUp, commands: Commands) -> Verdict | None:
    """Return the verdict: whether the law of every stage is certified."""
    good = [stage for stage in result.stages if stage.certificate.met]
    reasons = tuple(
        Reason(what="the certificate of its law failed", where=stage.name)
        for stage in result.stages
        if not stage.certificate.met
    )
    text = f"Bring-up: {len(good)} of {format_count(len(result.stages), 'stage')} with a certified law"
    return Verdict(met=result.met, text=text, reasons=reasons)


OUTER = (
    "These stages are of the force law alone: leave the outer loop out, with the link as in the design plant, and give "
    "the law the reference itself. Close the outer loop after the last stage, and log {}"
)
PLACE = (
    "its x_0 as the reference, with the link's position: seaopt accept replays both, and judges the loop with the "
    "outer loop in it. Let x_0 move by the last stage's reference over the stiffness, {}."
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


def _say_logged(controller: Controller, outer: OuterLoop) -> str:
    """Return what to log, and to play, with an outer loop closed."""
    unit = mechanics_of(outer.place_unit).stiffness
    return PLACE.format(f"{outer.stiffness:.4g} {unit}") if controller.renders else FORCE


def describe(result: BringUp) -> list[Section]:
    """Return a table of the stages, then each with what to play, to log, to expect, and when to stop."""
    rows = tuple(_list_row(stage) for stage in result.stages)
    head = ("stage", "law", "bandwidth (Hz)", "stuck (Hz)", "limit", "reference", "lasts (s)", "Ms expected")
    last = result.stages[-1].controller
    outer = () if last.outer is None else (OUTER.format(_say_logged(last, last.outer)),)
    still = [stage.name for stage in result.stages if stage.still]
    held = (HELD.format(join_words(still)),) if still else ()
    overview = Section(
        title="Stages",
        part="stages",
        tables=(Table(head=head, rows=rows, align="<<>>>>>>"),),
        remarks=(*held, *_explain_bandwidths(last), *(f"Stop a stage when {text}" for text in ALWAYS), NEXT, *outer),
    )
    return [overview, *(_describe_stage(stage) for stage in result.stages)]


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


def _say_whether_it_moves(stage: Stage) -> tuple[str, ...]:
    """Return whether what is played moves the motor, where it has dry friction."""
    if stage.effort is None or stage.friction is None:
        return ()
    unit = unit_after(stage.controller.command.effort_unit)
    sizes = (f"{format_number(value, 3)}{unit}" for value in (stage.effort, stage.friction))
    return ((STILL if stage.still else MOVED).format(*sizes),)


def _list_row(stage: Stage) -> tuple[Any, ...]:
    controller, excitation = stage.controller, stage.excitation
    unit, limit = unit_after(controller.command.reference_unit), controller.command_limit
    ms = format_number(max(stage.sensitivity.low), 3), format_number(max(stage.sensitivity.high), 3)
    return (
        stage.name,
        mark_met(stage.certificate.met, "certified", "not certified"),
        format_number(controller.spec.bandwidth_hz, 3),
        show_stuck_bandwidth(controller),
        "none" if limit is None else controller.command.show(limit),
        f"{format_number(excitation.bias, 3)} ± {format_number(excitation.amplitude, 3)}{unit}",
        format_number(excitation.reference.size * excitation.sample_time_s, 3),
        " to ".join(dict.fromkeys(ms)),
    )


def _describe_stage(stage: Stage) -> Section:
    controller, excitation = stage.controller, stage.excitation
    period = excitation.waves.shape[1] * excitation.sample_time_s
    f = excitation.frequency_hz
    step = stage.step
    top = format_number(max(step.low), 3), format_number(max(step.high), 3)
    outputs = {} if controller.design is None else controller.see(controller.design[0]).outputs
    units = {controller.command.input: controller.command.unit, **outputs}
    source, code = stage.source, "force_mpc.c" if isinstance(stage.source, ForceMPC) else "force_law.c"
    held = f"Keep {source.over} at {format_number(stage.place)}." if isinstance(source, ScheduledController) else ""
    begin = "begin with force_mpc_reset" if isinstance(source, ForceMPC) else BEGIN.format(stage.name)
    ring = "" if isinstance(source, ForceMPC) else f" ({stage.name}/force_law_log.c does)"
    sentences = [
        *([held] if held else []),
        *([f"{stage.note[0].upper()}{stage.note[1:]}."] if stage.note else []),
        f"Flash {stage.name}/{code}, {begin}, play {stage.name}/reference.csv (or reference.c): it fades in over "
        f"{format_number(period, 3)} s, then {format_count(len(excitation.waves), 'set')} of phases of "
        f"{excitation.periods} periods of {format_number(period, 3)} s, {f.size} lines from {format_number(f[0], 3)} "
        f"to {format_number(f[-1], 3)} Hz, then it fades out.",
        f"Log in each tick, at {1.0 / controller.sample_time_s:g} Hz: {join_words(stage.channels)}{ring}.",
        f"Expect: a step of the reference{_say_size(stage)} peaks at {' to '.join(dict.fromkeys(top))} of its size "
        f"({stage.name}/expected_step.csv); the response over frequency is in {stage.name}/expected_tracking.csv.",
        *_say_whether_it_moves(stage),
        *_explain_friction(controller),
    ]
    rows = tuple(
        (
            name,
            f"{format_number(peak, 3)}{unit_after(units.get(name, ''))}",
            f"{format_number(stage.stop[name], 3)}{unit_after(units.get(name, ''))}",
            f"{format_number(limit, 3)}{unit_after(units.get(name, ''))}" if limit is not None else "",
        )
        for name, peak, limit in ((name, peak, excitation.limits.get(name)) for name, peak in excitation.peaks.items())
    )
    table = Table(head=("signal", "expected at most", "stop beyond", "limit"), rows=rows, align="<>>>")
    return Section(title=f"Stage {stage.name}", part="stages", sentences=tuple(sentences), tables=(table,))


def _say_size(stage: Stage) -> str:
    """Return up to which size a step is one of the linear loop."""
    unit = unit_after(stage.controller.command.reference_unit)
    return "" if stage.step_size is None else f" of up to {format_number(stage.step_size, 3)}{unit}"


def _list_panels(stage: Stage) -> Iterator[Panel]:
    unit, friction = stage.controller.spec.regulated, _explain_friction(stage.controller)
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
        name=f"step_{stage.name}", title=f"{stage.name}: step", draw=draw_step, x="time [s]",
        y=(f"{unit} over the step [-]",), tight=True,
        caption=captions[0],
    )  # fmt: skip
    yield frequency_panel(
        name=f"tracking_{stage.name}", title=f"{stage.name}: tracking", draw=draw_tracking, y=("|Y/R| [dB]",),
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
    fit_met: bool = True,
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
    fit_met : bool
        Whether the fit that the law was tuned with is met; the verdict states one that is not.

    Raises
    ------
    FileError
        The folder cannot be written.
    """
    plates = [
        {"heading": stage.name, "text": "", "charts": [make_chart(panel) for panel in _list_panels(stage)]}
        for stage in result.stages
    ]
    return write_result_page(
        path,
        title=title,
        parts=PARTS,
        verdict=judge(result, Commands()),
        fit_met=fit_met,
        glance=summarise(result),
        sections=[*describe(result), describe_provenance((), files, command)],
        plates={"stages": plates},
    )
