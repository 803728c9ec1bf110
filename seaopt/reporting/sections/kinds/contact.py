"""The port at link 2 in words: where it is passive, what it is stable against, and scores of controllers there."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from seaopt.control import Passivity, Scorecard
from seaopt.control.impedance.scorecard import HEADS
from seaopt.formatting import format_band, format_number, join_words
from seaopt.reporting.sections.data import Section, Table
from seaopt.robustness.verification.environments import StabilityMap
from seaopt.units import LINEAR, ROTARY


def describe(result: Passivity | StabilityMap | Scorecard) -> list[Section]:
    """Return bands and violations, the count of stable environments and the worst of them, or a table of scores."""
    if isinstance(result, Passivity):
        return [
            Section(
                title="Passivity at link 2",
                aside=f"link 1 held, {format_band((result.low_hz, result.high_hz), 'Hz')}",
                part="contact",
                sentences=tuple(_describe_passivity(result)),
            )
        ]
    if isinstance(result, StabilityMap):
        return [_describe_environments(result)]
    return [_describe_scores(result)]


def list_passive_bands(port: Passivity) -> str:
    """Return the bands in which a port is passive; "" if there are none."""
    return join_words([format_band(band, "Hz") for band in port.bands_hz])


def _describe_passivity(port: Passivity) -> Iterator[str]:
    if not port.held_stable:
        yield "The loop is unstable with link 2 held, so that the actuator is not passive at any frequency."
        return
    if port.violated_hz is None:
        yield "Passive in all of this band: the actuator absorbs power from whatever moves link 2."
    else:
        bands = list_passive_bands(port)
        yield (
            f"Passive at {bands}, where the actuator absorbs power from whatever moves link 2 (Re Z ≥ 0)."
            if bands
            else "Not passive at any frequency of this band."
        )
        damper = f"{-port.least_damping_N_s_per_m:.4g} {port.unit}"
        yield (
            f"Re Z is lowest at {port.least_hz:.4g} Hz: {port.least_damping_N_s_per_m:.4g} {port.unit}, "
            f"{port.least_cosine:.3g} of |Z|. A damper of {damper} at link 2 makes it passive in the whole band."
        )
    if port.limit_hz is not None:
        word = ROTARY.word if port.unit == ROTARY.damping else LINEAR.word
        yield f"From {port.limit_hz:.4g} Hz on the measured {word} and the {word} at the port have opposite signs."


def _describe_environments(stability: StabilityMap) -> Section:
    """Return how many environments the loop is stable against, by their damping, and the worst of them."""
    called, worst = stability.called, stability.worst
    count, unstable = stability.stable.size, np.count_nonzero(~stability.stable)
    growth = "dies out" if worst.doubling_s is None else f"doubles in {worst.doubling_s:.3g} s"
    rows = tuple(
        (format_number(damping), str(np.count_nonzero(stable)), str(stable.size))
        for damping, stable in zip(stability.damping, stability.stable, strict=True)
    )
    return Section(
        title="Coupled stability at link 2",
        aside=f"{called.inertias} of {format_band((stability.mass[0], stability.mass[-1]), called.inertia)} on springs "
        f"of {format_band((stability.stiffness[0], stability.stiffness[-1]), called.stiffness)}, link 1 held",
        part="contact",
        sentences=(
            f"{f'Unstable against {unstable} of' if unstable else 'Stable against all of'} {count} environments, "
            f"and {'stable' if stability.fixed_stable else 'unstable'} with link 2 fixed.",
            f"The {'worst' if unstable else 'slowest'}: {worst.m_2:.4g} {called.inertia} on {worst.k_e:.4g} "
            f"{called.stiffness} with a damper of {worst.d_e:.4g} {called.damping}, whose oscillation at "
            f"{worst.frequency_hz:.4g} Hz {growth}.",
        ),
        tables=(Table(head=(f"damper {called.damping}", "stable", "of"), rows=rows, align=">>>"),),
    )


def _describe_scores(card: Scorecard) -> Section:
    """Return the table of scores."""
    rows = tuple((name, *score.cells()) for name, score in card.scores.items())
    return Section(
        title="Scorecard",
        aside=f"impedance and damper in {card.unit}",
        part="contact",
        tables=(Table(head=("controller", *HEADS), rows=rows, align="<".ljust(len(HEADS) + 1, ">")),),
        remarks=(
            "On the design plant, link 1 held. Damper: what makes the impedance passive everywhere; of no control: "
            "a root mean square from 0.1 Hz to the bandwidth; noise: from the sensor to the effort, at its peak "
            "and for white noise.",
        ),
    )
