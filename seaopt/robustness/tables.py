"""What notebooks show of a certificate: tables of plants, worst cases, draws and requirements."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from seaopt.markup import figure, items, paragraph, table

if TYPE_CHECKING:
    from seaopt.robustness.certificate import Certificate
    from seaopt.robustness.worst import Worst

_PLANT_HEAD = (
    "plant", "stable", "Ms", "Mt", "worst Ms", "worst Mt", "gain margin", "phase margin", "delay margin",
    "disk margin", "tracking band", "worst case at",
)  # fmt: skip


def certificate_html(found: Certificate) -> str:
    """Return the plants, the draws, every requirement with what decides it, and what was simulated."""
    verdict = paragraph(f"Certificate: {'passed' if found.passed else 'FAILED'}")
    plants = table(_PLANT_HEAD, [_plant_row(found, name) for name in found.plants])
    required = table(
        ("requirement", "where", "value", "limit", "met"),
        [
            (
                item.name,
                item.where,
                figure(item.value),
                f"{item.sense} {figure(item.limit)}",
                "yes" if item.met else "NO",
            )
            for item in sorted(found.requirements, key=lambda item: item.met)
        ],
    )
    varied = paragraph(f"varied: {'; '.join(map(str, found.varied))}") if found.varied else ""
    simulated = items(found.simulated.lines()) if found.simulated is not None else ""
    return verdict + items(found.notes) + plants + varied + draws_html(found.monte_carlo) + required + simulated


def draws_html(found: Any) -> str:
    """Return the numbers of draws and failures, and the bound; `found` is a `MonteCarlo`."""
    shown = [(field.name.replace("_", " "), getattr(found, field.name)) for field in fields(found)]
    return table(("draws", ""), [(name, f"{value:.7g}") for name, value in shown if isinstance(value, (int, float))])


def worst_html(found: Worst) -> str:
    """Return a worst case's figures and its parameters in SI units."""
    said = found.witness
    rows = [("Ms", f"{figure(found.ms)} at {figure(said.ms_hz, 'Hz')}"), ("Mt", figure(found.mt))]
    rows += [("spectral radius", f"{said.spectral_radius:.6g}")]
    return table(("worst case", ""), [*rows, *((name, f"{value:.5g}") for name, value in found.parameters.items())])


def _plant_row(found: Certificate, name: str) -> tuple[str, ...]:
    item, worst, margins = found.plants[name], found.worst[name], found.margins[name]
    band, late = item.tracking_band_hz, margins.sampled_delay_s
    return (
        name, "yes" if item.stable else "NO", figure(item.ms), figure(item.mt), figure(worst.ms), figure(worst.mt),
        figure(item.gain_margin_db, "dB"), figure(item.phase_margin_deg, "deg"),
        figure(None if late is None else 1e3 * late, "ms"), figure(item.disk_margin),
        "–" if band is None else f"{band[0]:.3g} to {band[1]:.4g} Hz", _where(worst.parameters),
    )  # fmt: skip


def _where(parameters: Mapping[str, float]) -> str:
    return ", ".join(f"{name} = {value:.4g}" for name, value in parameters.items()) or "–"
