"""What a certificate requires: the specification's limits, each figure against its own, and what decides."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from seaopt.control import Controller, LoopFigures
from seaopt.control.laws.passivity import held_stable, least_cosine
from seaopt.control.laws.verdict import BANDWIDTH_TOLERANCE, PASSIVE
from seaopt.control.loops.port import port_of
from seaopt.parameters import ParameterSet
from seaopt.robustness.certificate.certificate import MonteCarlo, Requirement
from seaopt.robustness.uncertainty.severity import UNSTABLE
from seaopt.robustness.uncertainty.worst import ROUNDING, Worst

REMEDY = "; tune with that plant in robust_to, a larger reserve or a lower bandwidth"


def design_requirements(controller: Controller, achieved: LoopFigures, values: ParameterSet) -> list[Requirement]:
    """Return what is required of the design plant at the nominal parameters `values`; `achieved` is its loop there."""
    spec = controller.spec
    reached = achieved.bandwidth_hz if achieved.bandwidth_hz is not None else np.inf
    rows = [
        Requirement(
            name="bandwidth_hz", limit=spec.bandwidth_hz, value=reached, where="design",
            met=bool(abs(reached / spec.bandwidth_hz - 1.0) <= BANDWIDTH_TOLERANCE),
        ),
        Requirement(
            name="min_sensitivity_bandwidth_hz", limit=spec.sensitivity_bandwidth_limit_hz,
            value=achieved.sensitivity_bandwidth_hz, where="design",
            met=achieved.sensitivity_bandwidth_hz >= spec.sensitivity_bandwidth_limit_hz * (1 - 1e-3),
        ),
    ]  # fmt: skip
    peaks = (("max_reference_peak", achieved.reference_peak), ("max_noise_gain", achieved.noise_gain))
    rows += [item for name, value in peaks for item in _upper(name, getattr(spec, name), value, "design")]
    return rows + _passive(controller, values)


def _passive(controller: Controller, values: ParameterSet) -> list[Requirement]:
    """Return that Re Z >= 0 of the design plant's port in the passive band, as the least Re Z/abs(Z)."""
    spec, band = controller.spec, controller.spec.passive_band_hz
    if band is None or controller.design is None:
        return []
    port = port_of(controller.design[0], values, spec.measured, controller.current_per_force_A_per_N)
    cosine, at_hz = least_cosine(port, controller.measurement, controller.sample_time_s, controller.delay_samples, band)
    held = held_stable(port, controller)
    met = cosine >= PASSIVE and held
    mend = "" if met else "; tune with this band, or narrow it" if held else "; the loop grows with its link held"
    where = f"design, Re Z/|Z| at {at_hz:.4g} Hz, of {band[0]:g} to {band[1]:g} Hz{mend}"
    return [Requirement(name="passive_band_hz", limit=0.0, value=cosine, met=met, where=where)]


def plant_requirements(controller: Controller, name: str, figures: LoopFigures) -> list[Requirement]:
    """Return what is required of every plant at the nominal parameters."""
    spec = controller.spec
    return [
        Requirement(
            name="spectral_radius",
            limit=1.0,
            value=figures.spectral_radius,
            met=figures.stable,
            where=name if figures.stable else f"{name}: the loop is UNSTABLE",
        ),
        *_upper("max_sensitivity", spec.max_sensitivity, figures.ms, name),
        *_upper("max_complementary", spec.max_complementary, figures.mt, name),
        *_lower("min_disk_margin", spec.min_disk_margin, figures.disk_margin, name),
    ]


def _upper(name: str, limit: float | None, value: float, where: str) -> list[Requirement]:
    if limit is None:
        return []
    return [Requirement(name=name, limit=limit, value=value, met=bool(value <= limit * (1 + ROUNDING)), where=where)]


def _lower(name: str, limit: float | None, value: float, where: str) -> list[Requirement]:
    if limit is None:
        return []
    return [Requirement(name=name, limit=limit, value=value, met=bool(value >= limit * (1 - ROUNDING)), where=where)]


def draw_requirements(
    result: MonteCarlo, worst: Mapping[str, Worst], max_failure_probability: float | None = None
) -> list[Requirement]:
    """Return what the draws require; where none fails, that the worst case found by search does not either."""
    bound = _bound(result, max_failure_probability)
    if not result.samples:
        return bound
    name = max(worst, key=lambda key: worst[key].severity)
    found = worst[name]
    where = ", ".join(f"{key} = {value:.4g}" for key, value in found.parameters.items())
    size = f"has Ms {found.ms:.4g}, Mt {found.mt:.4g}" if found.severity < UNSTABLE else "is UNSTABLE"
    witness = f"{name}: worst case {size}" + (f" at {where}" if where else "")
    rows = [
        Requirement(
            name="monte_carlo_failures", limit=0.0, value=float(result.failures), met=result.failures == 0,
            where=witness + (REMEDY if result.failures else ""),
        )
    ]  # fmt: skip
    if not result.failures:
        rows += [row for key, item in worst.items() for row in _worst_requirements(key, item)]
    return rows + bound


def _bound(result: MonteCarlo, limit: float | None) -> list[Requirement]:
    """Return that the stated failure probability is low enough, where that is asked for."""
    if limit is None:
        return []
    value = result.failure_probability_bound if result.samples else 1.0
    fewest = int(np.ceil(np.log(1.0 - result.confidence) / np.log1p(-limit))) if limit < 1.0 else 1
    where = f"{result.failures} failures in {result.samples} draws"
    if not result.samples:
        where = "nothing is uncertain, so that nothing was drawn; give a fit, prior_std or ranges"
    elif value > limit:
        where += f"; {fewest} draws without a failure would do"
    return [
        Requirement(name="max_failure_probability", limit=limit, value=value, met=bool(value <= limit), where=where)
    ]


def _worst_requirements(name: str, found: Worst) -> list[Requirement]:
    """Return how much of the limits the worst case uses: 1 is all of it."""
    if not found.limited and found.severity < UNSTABLE:
        return []
    where = ", ".join(f"{key} = {value:.4g}" for key, value in found.parameters.items())
    met = found.severity <= 1.0 + ROUNDING
    used = found.severity if found.severity < UNSTABLE else np.inf
    return [
        Requirement(
            name="worst_case",
            limit=1.0,
            value=used,
            met=met,
            where=f"{name}{'' if found.severity < UNSTABLE else ', UNSTABLE,'} at {where}" + ("" if met else REMEDY),
        )
    ]
