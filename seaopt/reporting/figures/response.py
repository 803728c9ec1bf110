"""Figures of measured frequency responses: H1 with its deviation and its coherence, and models on top."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool

from seaopt.frequency import Pair
from seaopt.records import record
from seaopt.reporting.figures.panel import BAND, MEASURED, Panel, frequency_panel, to_decibel
from seaopt.signals import VectorM

if TYPE_CHECKING:
    from matplotlib.axes import Axes

H1, DEVIATION = "H1 estimate", "± 2 std"
SHOWN = 0.3  # of coherence: below it an estimate says too little to be drawn
ROWS = (1.0, 0.8, 0.45)  # heights of magnitude, phase and coherence
POINTS = 600  # of a model
LINES = 500  # of an estimate: of more, those at even distances on the axis


@record(eq=False)
class Curve:
    """A model's response, a function of frequencies in Hz."""

    label: str
    response: Callable[[Any], Any]
    colour: str
    style: str = "-"


def response_panel(name: str, title: str, pair: Pair, curves: Sequence[Curve]) -> Panel:
    """Draw magnitude with two standard deviations, phase and coherence; the first curve tells the phase's branch."""
    estimate = pair.estimate
    f = estimate.frequency_hz

    def draw(magnitude: Axes, phase: Axes, coherence: Axes) -> None:
        drawn = _spread_lines(f)
        shown = (estimate.coherence > SHOWN) & drawn
        ends = (float(f[0]), float(f[shown][-1] if np.any(shown) else f[-1]))
        dense = np.geomspace(*ends, POINTS)
        branch = _draw_models(magnitude, phase, curves, dense)
        if np.any(shown):  # after the models, whose branch it takes
            _draw_estimate(magnitude, phase, pair, shown, np.interp(f[shown], dense, branch))
        coherence.plot(f[drawn], estimate.coherence[drawn], color=MEASURED, linewidth=0.8)
        coherence.set_ylim(0.0, 1.05)
        coherence.set_xlim(*ends)

    caption = f"H1 estimate of {pair.name} with two standard deviations, phase and coherence, and models on top."
    if f.size > LINES:
        caption += f" Of {f.size} lines, those nearest to {LINES} frequencies evenly spaced on the axis are drawn."
    return frequency_panel(
        name=name,
        title=title,
        draw=draw,
        y=(f"|{pair.name}| [dB re {pair.unit}]", "phase [deg]", "coherence [-]"),
        heights=ROWS,
        caption=caption,
    )


def _spread_lines(f: VectorM) -> Bool[np.ndarray, " m"]:
    """Return which lines of an estimate are drawn: all, or those nearest to frequencies evenly spaced in log f."""
    drawn = np.full(f.size, f.size <= LINES)
    if f.size > LINES:
        wanted = np.geomspace(f[0], f[-1], LINES)
        above = np.clip(np.searchsorted(f, wanted), 1, f.size - 1)
        drawn[np.where(wanted - f[above - 1] < f[above] - wanted, above - 1, above)] = True
    return drawn


def _draw_models(magnitude: Axes, phase: Axes, curves: Sequence[Curve], f: Any) -> Any:
    """Draw the models, all on the phase branch of the first; return that phase in degrees."""
    branch = np.zeros(f.size)
    for number, curve in enumerate(curves):
        response = curve.response(f)
        angle = np.degrees(np.unwrap(np.angle(response)))
        turns = np.round((angle[0] if number == 0 else np.median(angle - branch)) / 360.0)
        angle -= 360.0 * turns
        branch = angle if number == 0 else branch
        look: dict[str, Any] = {"color": curve.colour, "linestyle": curve.style, "linewidth": 1.4, "zorder": 3}
        magnitude.plot(f, to_decibel(response), label=curve.label, **look)
        phase.plot(f, angle, label=curve.label, **look)
    return branch


def _draw_estimate(magnitude: Axes, phase: Axes, pair: Pair, shown: Any, branch: Any) -> None:
    """Draw H1; its phase on the branch nearest the model's: noise at a dip must not shift what follows by a turn."""
    estimate = pair.estimate
    f, h, std = estimate.frequency_hz[shown], estimate.response[shown], estimate.relative_std[shown]
    level = 20 * np.log10(np.maximum(np.abs(h), 1e-300))
    angle = np.degrees(np.angle(h * np.exp(-1j * np.radians(branch)))) + branch
    low, high = (20 * np.log10(np.maximum(1.0 + side * 2.0 * std, 0.05)) for side in (-1.0, 1.0))
    magnitude.fill_between(f, level + low, level + high, color=BAND, linewidth=0.0, label=DEVIATION)
    dots: dict[str, Any] = {"color": MEASURED, "marker": ".", "markersize": 2.5, "linestyle": "", "label": H1}
    magnitude.plot(f, level, **dots)
    phase.plot(f, angle, **dots)
    room = 0.15 * float(np.ptp(level)) + 3.0
    magnitude.set_ylim(float(level.min()) - room, float(level.max()) + room)
    room = 0.15 * max(float(np.ptp(angle)), 45.0)
    phase.set_ylim(float(angle.min()) - room, float(angle.max()) + room)
