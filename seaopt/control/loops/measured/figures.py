"""Figures of a law on measured frequency responses: the worst in their discs, and the assumptions."""

from __future__ import annotations

from collections.abc import Sequence

from seaopt.codec import OrInfinite, OrNaN
from seaopt.control.loops.law import Law
from seaopt.control.loops.measured.loop import DiscLoop
from seaopt.control.loops.measured.plant import ASSUMED, MeasuredPlant
from seaopt.formatting import format_number
from seaopt.records import record


@record
class MeasuredFigures:
    """A law on one measured response; the figures are the worst of all responses in its discs, as in `LoopFigures`."""

    name: str  # such as frf:chirp
    confidence: float  # that the discs hold the truth, all of them
    points: int  # measured frequencies
    band_hz: tuple[float, float]  # (low, high)
    bandwidth_hz: tuple[float | None, float | None]  # (low or None, high or None); of the responses in the discs
    stable: bool  # shown to be stable, by the turns of 1 + L, under what is `assumed`
    # ms, ms_hz, mt, disk_margin, noise_gain, reference_peak, droop_db: infinite, and the disk margin zero, where it is
    # not
    ms: OrInfinite
    ms_hz: OrNaN
    mt: OrInfinite
    disk_margin: float
    noise_gain: OrInfinite
    reference_peak: OrInfinite
    droop_db: OrInfinite
    assumed: str = ASSUMED  # of the plant, besides the points

    def __str__(self) -> str:
        low, high = (format_number(f, 3) for f in self.band_hz)
        head = (
            f"{self.name}: on {self.points} measured points from {low} to {high} Hz, at {100 * self.confidence:.4g} %"
        )
        if not self.stable:
            return f"{head}, not shown to be stable"
        least, most = (format_number(f, missing="none") for f in self.bandwidth_hz)
        return (
            f"{head}: bandwidth {least} to {most} Hz, Ms {self.ms:.4g}, Mt {self.mt:.4g}, noise gain "
            f"{self.noise_gain:.4g}; assumed: {self.assumed}"
        )


def measure_discs(plant: MeasuredPlant, law: Law, bandwidth_hz: float) -> MeasuredFigures:
    """Return the figures of a law on a measured response; the bandwidth is that asked for."""
    loop = DiscLoop(plant=plant, law=law)
    figures = loop.figures(bandwidth_hz)
    taken = ("stable", "ms", "ms_hz", "mt", "disk_margin", "noise_gain", "reference_peak", "droop_db")
    return MeasuredFigures(
        name=plant.name,
        confidence=plant.confidence,
        points=plant.f.size,
        band_hz=(float(plant.f[0]), float(plant.f[-1])),
        bandwidth_hz=loop.bandwidths_hz() if figures.stable else (None, None),
        **{name: getattr(figures, name) for name in taken},
    )


def measure_all_discs(plants: Sequence[object], law: Law, bandwidth_hz: float) -> tuple[MeasuredFigures, ...]:
    """Return the figures of a law on those of some plants that are measured."""
    return tuple(measure_discs(plant, law, bandwidth_hz) for plant in plants if isinstance(plant, MeasuredPlant))
