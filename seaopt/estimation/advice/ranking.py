"""A ranking of fits: what `compare` returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Any

from seaopt.estimation.advice.forecasts import Percent
from seaopt.estimation.result.fit_result import Fit
from seaopt.formatting import format_table, html_text
from seaopt.records import record


@record(eq=False)
class Ranked:
    """One fit in a ranking.

    Parameters
    ----------
    name : str
        Its label.
    aic, bic : float
        With every sample counted.
    effective_bic : float
        With the effective number of samples, up to a constant that all fits share.
    unknowns : int
        Sigmas included.
    free_run : mapping of experiment to mapping of output to Percent
        Fit of the simulation, over the samples used and those held out.
    held_out_ratio : float or None
        Held-out residual over that of the first in the ranking, geometric mean over outputs; None if nothing is held
        out.

    """

    name: str
    aic: float
    bic: float
    effective_bic: float
    unknowns: int
    free_run: Mapping[str, Mapping[str, Percent]]
    held_out_ratio: float | None


@record(eq=False)
class Band:
    """Power of the residuals in one octave of one output: mean squares by fit, in the output's unit squared."""

    experiment: str
    output: str
    unit: str
    low_hz: float
    high_hz: float
    power: Mapping[str, float]


@record(eq=False, repr=False)
class Ranking:
    """What `compare` returns; ``print(ranking)`` is a report.

    Parameters
    ----------
    rows : tuple of Ranked
        Best first, by effective BIC.
    preferred : str or None
        The first's name; None if undecided.
    evidence : str
        For it, against the next: "very strong", "strong", "positive" or "undecided".
    samples, effective_samples : int, float
        Of all outputs.
    bands : tuple of Band
        Residual power per octave, of every output.
    sentences : tuple of str
        The verdict, and why.
    fits : mapping of name to Fit
        In the order of `rows`.

    """

    rows: tuple[Ranked, ...]
    preferred: str | None
    evidence: str
    samples: int
    effective_samples: float
    bands: tuple[Band, ...]
    sentences: tuple[str, ...]
    fits: Mapping[str, Fit] = field(repr=False)

    @property
    def decisive(self) -> bool:
        """Whether the evidence is very strong: a difference of BIC beyond 10, and no objection by held-out samples."""
        return self.evidence == "very strong"

    def to_dict(self) -> dict[str, Any]:
        """Return the content as numbers, lists and text."""
        return {
            "preferred": self.preferred, "evidence": self.evidence, "samples": self.samples,
            "effective_samples": self.effective_samples, "sentences": list(self.sentences),
            "ranking": [
                {
                    "name": row.name, "aic": row.aic, "bic": row.bic, "effective_bic": row.effective_bic,
                    "unknowns": row.unknowns, "held_out_ratio": row.held_out_ratio,
                    "free_run": {
                        name: {output: {"used": p.used, "held_out": p.held_out} for output, p in outputs.items()}
                        for name, outputs in row.free_run.items()
                    },
                }
                for row in self.rows
            ],
            "bands": [
                {"experiment": band.experiment, "output": band.output, "low_hz": band.low_hz, "high_hz": band.high_hz,
                 "unit": f"({band.unit})^2", "power": dict(band.power)}
                for band in self.bands
            ],
        }  # fmt: skip

    def __repr__(self) -> str:
        head = ("", "effective BIC", "BIC", "AIC", "unknowns", "free run (held out) [%]")
        rows = format_table((self._cells(row) for row in self.rows), head, "<>>>>")
        return "\n  ".join([f"Ranking: {self.sentences[0]}", *self.sentences[1:], *rows])

    def _cells(self, row: Ranked) -> list[str]:
        """Return a row of the table; the criteria are counted from those of the best fit."""
        first = self.rows[0]
        percents = ", ".join(
            f"{name}.{output} {p.used:.2f}" + ("" if p.held_out is None else f" ({p.held_out:.2f})")
            for name, outputs in row.free_run.items()
            for output, p in outputs.items()
        )
        away = (row.effective_bic - first.effective_bic, row.bic - first.bic, row.aic - first.aic)
        return [row.name, *(f"{value:+.6g}" for value in away), str(row.unknowns), percents]

    _repr_html_ = html_text
