"""Compared fits in words: which one is preferred and why, and their criteria."""

from __future__ import annotations

from seaopt.estimation import Ranking
from seaopt.formatting import format_number
from seaopt.reporting.sections.data import Section, Table
from seaopt.reporting.sections.kinds.diagnostics import format_percent


def describe(ranking: Ranking) -> list[Section]:
    """Return the verdict with its reasons, and a row per fit; criteria are counted from those of the best."""
    best = ranking.rows[0]
    rows = tuple(
        (
            row.name,
            *(
                f"{getattr(row, criterion) - getattr(best, criterion):+.6g}"
                for criterion in ("effective_bic", "bic", "aic")
            ),
            str(row.unknowns),
            ", ".join(
                f"{name}.{output} {format_percent(percent)}"
                for name, outputs in row.free_run.items()
                for output, percent in outputs.items()
            ),
        )
        for row in ranking.rows
    )
    return [
        Section(
            title="Ranking",
            part="ranking",
            sentences=ranking.sentences,
            tables=(
                Table(
                    label="Fits compared",
                    head=("fit", "effective BIC", "BIC", "AIC", "unknowns", "simulated (held out) %"),
                    rows=rows,
                    align="<>>>><",
                ),
            ),
            remarks=(
                f"The residuals are coloured: {format_number(ranking.effective_samples, 3)} of {ranking.samples} "
                "samples count as independent. Differences of BIC beyond 10 are very strong evidence.",
            ),
        )
    ]
