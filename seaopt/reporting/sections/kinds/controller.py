"""A controller in words: its verdict, the gains, what was asked and achieved."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache

from seaopt.control import Controller, LoopFigures
from seaopt.control.laws.command import describe_cascade, name_gain_units
from seaopt.control.laws.limits import BANDWIDTH_TOLERANCE, FAST_BANDWIDTH
from seaopt.control.laws.verdict import advise_easing, join_limits, list_design_figures
from seaopt.control.loops.law import describe_integrators
from seaopt.formatting import MISSING, format_band, format_count, format_figure, format_number
from seaopt.reporting.sections.data import Commands, KeyFigure, Reason, Section, Step, Table, Verdict, list_notes

NO_NOTCH = 0.999  # gain at a notch's centre from which it only adds order
SWEEP_SPREAD = (0.6, 1.6)  # of the bandwidth asked, that a sweep for another one spans


def judge(controller: Controller, commands: Commands) -> Verdict:
    """Return the verdict on a controller; `sweep` is the command that tunes at a range of bandwidths, if there is."""
    spec = controller.spec
    name = f"Controller: {controller.structure} on {spec.regulated}, {say_bandwidths(controller, spec.bandwidth_hz)}"
    if controller.met:
        on = " on measured points" if controller.design is None else ""
        fast = _find_unasked(controller)
        if fast is None:
            return Verdict(met=True, text=f"{name}, every limit met{on}")
        return Verdict(
            met=True,
            text=f"{name}, every limit met; none asks for more than {format_figure(fast, 'Hz')} sliding fast",
            next=(Step(text=f"to ask for it there, too: {FAST_BANDWIDTH} = {spec.bandwidth_hz:g} in [controller]"),),
        )
    blocked = controller.blocked_by or (join_limits(controller.binding),)
    reasons = [Reason(what=text) for text in blocked]
    return Verdict(
        met=False,
        text=f"{name}, {format_count(len(reasons), 'limit')} not met",
        reasons=tuple(reasons),
        next=_advise_bandwidth(controller, commands),
    )


def _find_unasked(controller: Controller) -> float | None:
    """Return the bandwidth where it slides fast, if that is below the one asked and no limit is on it."""
    fast, asked_hz = _measure_fast(controller), controller.spec.bandwidth_hz
    short = fast is not None and fast < asked_hz * (1.0 - BANDWIDTH_TOLERANCE)
    return fast if short and controller.spec.level(FAST_BANDWIDTH) is None else None


def say_bandwidths(controller: Controller, bandwidth_hz: float | None) -> str:
    """Return a bandwidth; where friction makes two of it, with the one that is left while it sticks."""
    moving, stuck = _say_sliding(controller, bandwidth_hz), show_stuck_bandwidth(controller)
    return f"{moving} and {stuck} Hz stuck" if stuck else moving


def _say_sliding(controller: Controller, bandwidth_hz: float | None) -> str:
    """Return a bandwidth; of a plant with friction as that where it slides, and where friction falls with the speed
    from the one where it slides fast.
    """
    moving, fast = format_figure(bandwidth_hz, "Hz", missing="none"), _measure_fast(controller)
    if fast is not None and bandwidth_hz is not None:
        low, high = sorted((fast, bandwidth_hz))
        moving = f"{format_number(low, 3)} to {format_figure(high, 'Hz')}"
    return f"{moving} sliding" if _measure_stuck(controller) else moving


def show_stuck_bandwidth(controller: Controller) -> str:
    """Return the bandwidth that is left while friction sticks, in Hz; nothing without friction, and of a plant that
    stands still then: its linear stand-in is that of a speed of smoothing, which such a plant does not have.
    """
    if controller.design is not None and controller.design[0].sticks:
        return ""
    return next((format_number(row.bandwidth_hz, 3, "no") for _, row in _measure_stuck(controller)), "")


@lru_cache(maxsize=4)  # verdict and sections of a controller are written one after the other
def _measure_stuck(controller: Controller) -> list[tuple[str, LoopFigures]]:
    """Return the figures of the design plant where its friction sticks, by state; none without friction."""
    return [] if controller.design is None else [*controller.measure_states().items()][1:]


@lru_cache(maxsize=4)
def _measure_fast(controller: Controller) -> float | None:
    """Return the bandwidth where the design plant slides fast, if its friction falls with the speed before."""
    return controller.bandwidth_sliding_fast_hz


def explain_sliding(controller: Controller) -> Iterator[str]:
    """Yield of which sliding a bandwidth is, where friction falls with the speed."""
    if (fast := _measure_fast(controller)) is not None:
        falling = format_number(controller.achieved.bandwidth_hz, missing="none")
        yield (
            f"Friction that falls with the speed makes a range of the sliding bandwidth: {falling} Hz where it falls "
            f"the steepest, which no motion keeps to, and {format_number(fast)} Hz where it slides fast."
        )


def _advise_bandwidth(controller: Controller, commands: Commands) -> tuple[Step, ...]:
    """Return the line of the file with a bandwidth that is possible, or how to look for what is."""
    possible, wanted_hz = controller.possible, controller.spec.bandwidth_hz
    if possible is None:
        return (show_costs(wanted_hz, commands),)
    first = Step(text=str(possible))
    if possible.nearest_hz:
        nearest = min(possible.nearest_hz, key=lambda hz: abs(hz - wanted_hz))
        return (first, show_costs(wanted_hz, commands, first=f"bandwidth_hz = {nearest:.4g} in [controller], or "))
    unstable = any(limit.name == "stability" for limit in controller.binding)
    easing = "" if unstable else advise_easing(controller.binding)  # figures of no stable law bind nothing
    return (first, show_costs(wanted_hz, commands, first=f"{easing} in [controller]; " if easing else ""))


def show_costs(bandwidth_hz: float, commands: Commands, *, first: str = "") -> Step:
    """Return how to see what bandwidths about one cost; `first`: what to try before."""
    text = f"{first}to see what other bandwidths cost"
    if not commands.tune:
        return Step(text=f"{text} call seaopt.control.sweep")
    return Step.typed(text, f"{commands.sweep} {_choose_range(bandwidth_hz)}")


def _choose_range(bandwidth_hz: float) -> str:
    low, high = (factor * bandwidth_hz for factor in SWEEP_SPREAD)
    step = max(float(f"{(high - low) / 6:.1g}"), 0.1)
    return f"{step * math.floor(low / step):.4g}:{step * math.ceil(high / step):.4g}:{step:.4g}"


def summarise(controller: Controller) -> list[KeyFigure]:
    """Return bandwidth and margins on the design plant."""
    achieved, spec, on = controller.achieved, controller.spec, "design plant"
    ms, gain_unit = spec.level("max_sensitivity"), controller.command.gain_unit
    against, allowed = f"asked {spec.bandwidth_hz:g} Hz", "" if ms is None else f"at most {ms:g}"
    if stuck := show_stuck_bandwidth(controller):
        against = f"{stuck} Hz stuck, {against}"
    return [
        KeyFigure(name="bandwidth", value=_say_sliding(controller, achieved.bandwidth_hz), against=against),
        KeyFigure(name="Ms", value=format_number(achieved.ms, 3), against=allowed),
        KeyFigure(name="phase margin", value=format_figure(achieved.phase_margin_deg, "deg", 3), against=on),
        KeyFigure(name="noise gain", value=format_figure(achieved.noise_gain, gain_unit, 3), against=on),
    ]


def describe(controller: Controller) -> list[Section]:
    """Return the gains, what was asked and achieved, what surrounds the law, and the findings."""
    spec, command = controller.spec, controller.command
    law = (
        f"{command.mechanics.word.capitalize()} of the motor F_m = C_r F_ref − C_y {spec.regulated}; {command.input} = "
        f"{command.per_effort:.6g} {command.per_effort_unit} × F_m."
    )
    active, head = join_limits(controller.binding) or "none", (controller.judged_on, "achieved", "asked")
    return [
        Section(
            title="Controller",
            aside=f"{controller.structure} on {spec.regulated} at {spec.sample_rate_hz:g} Hz, {controller.delays}",
            part="controller",
            sentences=(law, *_describe_parts(controller)),
            tables=(_tabulate_gains(controller),),
        ),
        Section(
            title="Asked and achieved",
            part="controller",
            tables=(Table(head=head, rows=tuple(list_achieved(controller)), align="<><"),),
            remarks=(
                f"Active limits: {active}." if controller.met else f"{controller.explanation}.",
                *_describe_friction(controller),
                *_describe_forces(controller),
                *describe_surroundings(controller),
            ),
        ),
        *list_notes("the controller", controller.notes),
    ]


def list_achieved(controller: Controller) -> list[tuple[str, str, str]]:
    """Return the figures of the design plant: what each is, what was achieved, what was asked."""
    a, a_range = controller.achieved, controller.design_loop.fast is not None
    rows, stuck = list[tuple[str, str, str]](), _measure_stuck(controller)
    for row in list_design_figures(controller.spec, controller.design_loop):
        limit, asked = row.limit, row.allowed_text
        label = limit.label
        if limit.name == "bandwidth_hz" and (show_stuck_bandwidth(controller) or a_range):
            label = f"{label}, sliding"
        if limit.name == FAST_BANDWIDTH:
            asked = asked or "not required"
        rows.append((label, format_figure(row.value, row.unit), asked))
        if limit.name == (FAST_BANDWIDTH if a_range else "bandwidth_hz") and show_stuck_bandwidth(controller):
            rows += [(f"bandwidth,{state}", format_figure(each.bandwidth_hz, "Hz"), "") for state, each in stuck]
    if controller.prefilter is not None:
        rows.append(("bandwidth without prefilter", format_figure(controller.bandwidth_without_prefilter_hz, "Hz"), ""))
    return [
        *rows,
        ("tracking band", format_band(a.tracking_band_hz, "Hz", MISSING), ""),
        ("gain margin", format_figure(a.gain_margin_db, "dB"), ""),
        ("phase margin", format_figure(a.phase_margin_deg, "deg"), ""),
        ("delay margin", format_figure(a.delay_margin_ms, "ms"), ""),
    ]


def _tabulate_gains(controller: Controller) -> Table:
    units, commanded = name_gain_units(controller.command), controller.engineering
    rows: list[tuple[str, ...]] = []
    for name, value in controller.gains.items():
        as_command, unit = commanded.get(name, (None, ""))
        figure = MISSING if as_command is None else f"{as_command:.5g}"
        rows.append((name, f"{value:.5g}", units.get(name, ""), figure, unit))
    head = ("gain", "value", "", f"as {controller.command.word}", "")
    return Table(label="Gains", head=head, rows=tuple(rows), align="<><><")


def _describe_parts(controller: Controller) -> Iterator[str]:
    """Yield what the gains stand for, part by part of the law."""
    gains = controller.gains
    if not gains:
        yield f"A law of order {controller.law.c.size} with {describe_integrators(controller.law)}."
    if gains.get("k_v"):
        yield f"{describe_cascade(gains, controller.command)}."
    if controller.observer is not None:
        yield f"Disturbance observer: Q is 3 dB down at {controller.observer.bandwidth_hz:.4g} Hz."
    if "notch_depth" in gains:
        f, width, depth = (gains[f"notch_{name}"] for name in ("frequency_hz", "width", "depth"))
        use = "" if depth < NO_NOTCH else ": of no use, tune without it"
        yield f"Notch: {f:.4g} Hz, width {width:.3g}, gain at its centre {depth:.3g}{use}."
    low_pass = controller.prefilter
    if low_pass is not None:
        damping = "" if low_pass.damping is None else f", damping {low_pass.damping:.3g}"
        bare = format_number(controller.bandwidth_without_prefilter_hz, missing="none")
        yield (
            f"Prefilter of {low_pass.order.replace('_', ' ')}: {low_pass.corner_hz:.4g} Hz{damping}; without it the "
            f"bandwidth is {bare} Hz."
        )


def _describe_friction(controller: Controller) -> Iterator[str]:
    """Yield the friction margin, and what the design plant achieves when it sticks; nothing without friction."""
    if controller.design is None:
        return
    if controller.friction is not None:
        loop, least = controller.design_loop, controller.spec.level("min_friction_margin")
        limit = "" if least is None else f" (asked {least:g})"
        slope = f"{format_number(loop.friction_slope)} {loop.slope_unit}"
        yield f"Friction margin {slope}{limit}: {controller.friction.describe()}."
    yield from explain_sliding(controller)
    sliding = "These figures are of the sliding design plant, on which the bandwidth is placed;"
    if controller.design[0].sticks:
        sliding = f"{sliding} a reference that moves the motor less than its friction holds is not followed;"
    for state, figures in _measure_stuck(controller):
        bandwidth = format_number(figures.bandwidth_hz, missing="none")
        width = f"bandwidth {bandwidth} Hz, " if show_stuck_bandwidth(controller) else ""
        yield f"{sliding}{state}: {width}{figures.describe_peaks()}."


def _describe_forces(controller: Controller) -> Iterator[str]:
    """Yield what reference the limit of the command allows, and what the motor can do without overheating."""
    slow, fast = controller.force_limit(0.0), controller.force_limit(controller.spec.bandwidth_hz)
    if slow is not None and fast is not None and controller.command_limit is not None:
        unit, band = controller.command.reference_unit, controller.spec.bandwidth_hz
        yield (
            f"The limit of {controller.command.show(controller.command_limit)} allows a reference of {slow:.4g} {unit} "
            f"at rest and {fast:.4g} {unit} at {band:g} Hz, whatever the gains."
        )
    if controller.rating is not None:
        yield from (f"Motor: {line}." for line in controller.rating.describe())


def describe_surroundings(controller: Controller) -> Iterator[str]:
    """Yield what runs around the law: an outer loop, compensation, a gate."""
    if controller.outer is not None:
        yield f"{controller.outer.describe()}."
    if controller.compensation is not None:
        for line in controller.compensation.describe(controller.command.effort_unit):
            yield f"Compensates {line}."
    if controller.gate is not None:
        yield f"{controller.gate.describe(controller.command.reference_unit)}."
    if controller.derate:
        yield "The limit falls as the winding warms up."
