"""Whether measured figures keep a specification, and how near they come to its limits."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.loops.loop import Loop, LoopFigures
from seaopt.control.loops.peaks import HALF_POWER

BANDWIDTH_TOLERANCE = 0.005
ROUNDING = 1e-6
PASSIVE = -1e-9  # Re Z/abs(Z) that is still called zero

Port = tuple[float, float] | None  # the least Re Z/abs(Z) in the passive band, and where in Hz, if one is asked for


class Use(NamedTuple):
    """One limit: its name, with the plant where it holds for all, the figure, what is allowed, and their ratio."""

    label: str
    value: float
    allowed: float
    ratio: float


def uses(spec: ControllerSpec, names: tuple[str, ...], figures: list[LoopFigures]) -> list[Use]:
    """Return each peak limit that is imposed; the first figures are the design plant's."""
    out: list[Use] = []

    def at_most(label: str, value: float, allowed: float | None) -> None:
        if allowed is not None:
            out.append(Use(label, value, allowed, value / allowed))

    for name, item in zip(names, figures, strict=True):
        at_most(f"max_sensitivity ({name})", item.ms, spec.max_sensitivity)
        at_most(f"max_complementary ({name})", item.mt, spec.max_complementary)
        if spec.min_disk_margin is not None:
            ratio = spec.min_disk_margin / max(item.disk_margin, 1e-12)
            out.append(Use(f"min_disk_margin ({name})", item.disk_margin, spec.min_disk_margin, ratio))
    at_most("max_reference_peak", figures[0].reference_peak, spec.max_reference_peak)
    at_most("max_noise_gain", figures[0].noise_gain, spec.max_noise_gain)
    return out


def broken(spec: ControllerSpec, names: tuple[str, ...], figures: list[LoopFigures], port: Port = None) -> list[str]:
    """Return the limits that the figures break, with the plant that breaks them."""
    design = figures[0]
    out = [f"stability ({name})" for name, item in zip(names, figures, strict=True) if not item.stable]
    out += [use.label for use in uses(spec, names, figures) if use.ratio > 1 + ROUNDING]
    reached = design.bandwidth_hz
    if reached is None or abs(reached / spec.bandwidth_hz - 1) > BANDWIDTH_TOLERANCE:
        out.append("bandwidth_hz")
    if design.sensitivity_bandwidth_hz < spec.sensitivity_bandwidth_limit_hz * (1 - 1e-3):
        out.append("min_sensitivity_bandwidth_hz")
    if port is not None and port[0] < PASSIVE:
        out.append("passive_band_hz")
    return out


def active(spec: ControllerSpec, names: tuple[str, ...], figures: list[LoopFigures], port: Port = None) -> list[str]:
    """Return the limits that are met with no more than the reserve and a hundredth to spare."""
    near = 1.0 - spec.reserve - 0.01
    out = [use.label for use in uses(spec, names, figures) if use.ratio > near]
    if figures[0].sensitivity_bandwidth_hz < 1.01 * spec.sensitivity_bandwidth_limit_hz:
        out.append("min_sensitivity_bandwidth_hz")
    if port is not None and port[0] < spec.reserve + 0.01:
        out.append("passive_band_hz")
    return out


def explained(
    spec: ControllerSpec, names: tuple[str, ...], figures: list[LoopFigures], loop: Loop, port: Port = None
) -> tuple[str, ...]:
    """Return what blocks, each limit with the figure that the best compromise reaches; `loop` is the design plant's."""
    known = {use.label: f"{use.label} {use.value:.4g} of {use.allowed:g}" for use in uses(spec, names, figures)}
    design = figures[0]
    known["bandwidth_hz"] = (
        "bandwidth_hz, of which there is none" if design.bandwidth_hz is None
        else f"bandwidth_hz {design.bandwidth_hz:.4g} of {spec.bandwidth_hz:g}"
    )  # fmt: skip
    known["min_sensitivity_bandwidth_hz"] = _sensitivity_told(spec.sensitivity_bandwidth_limit_hz, loop)
    if port is not None and spec.passive_band_hz is not None:
        low, high = spec.passive_band_hz
        known["passive_band_hz"] = (
            f"passive_band_hz = [{low:g}, {high:g}], Re Z/|Z| {port[0]:.3g} of 0 at {port[1]:.4g} Hz"
        )
    return tuple(known.get(label, label) for label in broken(spec, names, figures, port))


def _sensitivity_told(limit_hz: float, loop: Loop) -> str:
    """Return by how much abs(S) exceeds -3 dB: where it first does says little when it lies along it."""
    f = loop.grid()
    reached = float(np.max(np.abs(loop.sensitivity(np.append(f[f < limit_hz], limit_hz)))))
    return f"min_sensitivity_bandwidth_hz, |S| reaches {reached:.4f} below {limit_hz:g} Hz, {HALF_POWER:.4f} allowed"
