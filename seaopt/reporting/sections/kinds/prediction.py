"""Measured and modelled outputs of one log in words: how well each output is predicted."""

from __future__ import annotations

from seaopt.estimation import ModelledOutputs
from seaopt.formatting import format_number
from seaopt.reporting.sections.data import Section, Table
from seaopt.units import unit_after


def describe(prediction: ModelledOutputs) -> list[Section]:
    """Return the scores of the outputs."""
    rows = tuple(
        (
            name,
            f"{row['fit_percent']:.2f}",
            format_number(row["band_fit_percent"]),
            f"{row['rms_residual']:.4g}",
            unit_after(row["unit"]).strip(),
        )
        for name, row in prediction.to_dict().items()
    )
    return [
        Section(
            title=f"Prediction of {prediction.name}",
            aside=f"{prediction.time.size} samples, with initial states and offsets of its own",
            tables=(Table(head=("output", "fit %", "in the band", "residual", ""), rows=rows, align="<>>><"),),
        )
    ]
