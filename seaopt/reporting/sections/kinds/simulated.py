"""What a certificate simulated, in words: its runs, sweeps of amplitudes and port, as sections and in a few lines."""

from __future__ import annotations

from collections.abc import Container, Iterator

import numpy as np

from seaopt.control import Passivity
from seaopt.formatting import format_number
from seaopt.reporting.sections.data import Commands, Section, Table, Verdict, list_notes
from seaopt.reporting.sections.kinds import contact, verification
from seaopt.robustness.certificate.simulated import Simulated
from seaopt.robustness.verification.environments import StabilityMap
from seaopt.robustness.verification.large_signal import LargeSignal

SWEEP_COLUMNS = (
    "Bandwidth: where the gain is 3 dB below the linear loop's at 0 Hz, – if not within the sweep; predicted: by "
    "describing functions; saturates from: the lowest frequency at which the command reaches its limit."
)


def judge(result: Simulated | LargeSignal, commands: Commands) -> Verdict | None:
    """Return the verdict on the runs; None where none could be played, and of a sweep."""
    runs = None if isinstance(result, LargeSignal) else result.verification
    return None if runs is None else verification.judge(runs, commands)


def describe(result: Simulated | LargeSignal) -> list[Section]:
    """Return the sections of every part, and why parts are left out; or the section of a sweep of amplitudes."""
    if isinstance(result, LargeSignal):
        return [_describe_sweep(result)]
    ports = (part for part in (result.passivity, result.environments) if part is not None)
    return [
        *([] if result.verification is None else verification.describe(result.verification)),
        *map(_describe_sweep, result.large_signal),
        *(section for port in ports for section in contact.describe(port)),
        *list_notes("the simulation", list_left_out(result)),
    ]


def list_left_out(simulated: Simulated, shown: Container[str] = ()) -> list[str]:
    """Return what was not simulated, and why, but for what is `shown` elsewhere."""
    return [f"no {what}: {reason}" for what, reason in simulated.left_out.items() if what not in shown]


def summarise_findings(simulated: Simulated) -> Iterator[str]:
    """Yield a line for each part; neither what failed nor what is left out is among them."""
    runs = simulated.verification
    if runs is not None:
        failed, count = len(runs.failures), len(runs.rows)
        yield f"simulation: {f'{failed} of {count} runs FAILED' if failed else f'{count} runs passed'}"
        yield from verification.describe_tracking(runs)
    for sweep in simulated.large_signal:
        yield f"bandwidth on {sweep.plant} against amplitude: {_summarise_sweep(sweep)}"
    if simulated.passivity is not None:
        yield f"port at link 2: {_summarise_passivity(simulated.passivity)}"
    if simulated.environments is not None:
        yield f"environments at link 2: {_summarise_environments(simulated.environments)}"


def _describe_sweep(sweep: LargeSignal) -> Section:
    """Return the bandwidth at every amplitude, simulated and predicted, and where the command saturates."""
    amplitudes = zip(sweep.amplitude_N, sweep.bandwidth_hz, sweep.predicted_hz, sweep.saturated, strict=True)
    rows = tuple(
        (
            format_number(amplitude),
            format_number(band),
            format_number(predicted),
            format_number(sweep.frequency_hz[np.argmax(saturated)]) if np.any(saturated) else "",
        )
        for amplitude, band, predicted, saturated in amplitudes
    )
    head = (f"amplitude {sweep.unit}", "bandwidth Hz", "predicted Hz", "saturates from Hz")
    return Section(
        title=f"Bandwidth against amplitude on {sweep.plant}",
        aside=f"dry friction {sweep.friction_N:.4g} {sweep.unit}" if sweep.friction_N else "",
        part="amplitude",
        tables=(Table(head=head, rows=rows, align=">>>>"),),
        remarks=(SWEEP_COLUMNS,),
    )


def _summarise_sweep(sweep: LargeSignal) -> str:
    """Return the bandwidths in one line: with friction when stuck, at its widest, and saturated."""
    pairs = list(zip(sweep.amplitude_N, sweep.bandwidth_hz, strict=True))
    if sweep.friction_N:
        widest = max(pairs, key=lambda pair: pair[1] or 0.0)
        pairs = [pair for pair in pairs if pair in (pairs[0], widest, pairs[-1])]
    return ", ".join(
        f"{'–' if hz is None else f'{hz:.3g} Hz'} at {amplitude:.4g} {sweep.unit}" for amplitude, hz in pairs
    )


def _summarise_passivity(port: Passivity) -> str:
    if not port.held_stable:
        return "passive nowhere: the loop is UNSTABLE with link 2 held"
    bands = contact.list_passive_bands(port) or "nowhere"
    if port.violated_hz is None:
        return f"passive {bands}"
    return f"passive {bands}; everywhere with a damper of {-port.least_damping_N_s_per_m:.3g} {port.unit}"


def _summarise_environments(stability: StabilityMap) -> str:
    called = stability.called
    if stability.everywhere:
        return f"stable against all of {stability.stable.size} {called.inertias} on springs and dampers"
    shares = ", ".join(
        f"{np.count_nonzero(stable)} at {damping:g}"
        for damping, stable in zip(stability.damping, stability.stable, strict=True)
    )
    return f"of {stability.stable[0].size} {called.inertias} on springs, stable by damping ({called.damping}): {shares}"
