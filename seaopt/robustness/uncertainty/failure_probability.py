"""The probability of failure, bounded from failures among independent draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
from jaxtyping import Bool

from seaopt.formatting import html_table
from seaopt.records import record


@record
class MonteCarlo:
    """Draws and failures; with `confidence`, the probability of failure is below `failure_probability_bound`.

    Of the failures, `unstable` draws are unstable on some plant; of the others, `over_ms` break Ms, and `over_mt` Mt
    alone.
    """

    samples: int
    failures: int
    seed: int
    failure_probability_bound: float
    confidence: float
    unstable: int = 0
    over_ms: int = 0
    over_mt: int = 0

    @property
    def risk(self) -> float | None:
        """The probability with which the bound is wrong; None where nothing was drawn."""
        return 1.0 - self.confidence if self.samples else None

    @property
    def count_text(self) -> str:
        """How many draws fail, and by what."""
        if not self.samples:
            return "no draws"
        counts = ((self.unstable, "unstable"), (self.over_ms, "over Ms"), (self.over_mt, "over Mt"))
        kinds = ", ".join(f"{count} {kind}" for count, kind in counts if count)
        return f"{self.failures} failures in {self.samples} draws" + (f" ({kinds})" if kinds else "")

    def __str__(self) -> str:
        if not self.samples:
            remedy = "give a fit, prior_std or ranges for a statement on robustness"
            return f"{self.count_text}: nothing is uncertain; {remedy}"
        if self.failures == self.samples:
            return self.count_text
        return (
            f"{self.count_text}: failure probability below {self.failure_probability_bound:.3g} at a confidence of "
            f"{_format_confidence(self.confidence)}"
        )

    def _repr_html_(self) -> str:
        return format_draws(self)


def failure_bound(samples: int, failures: int, confidence: float) -> float:
    """Return the upper Clopper-Pearson bound of a failure probability (Biometrika 26, 1934).

    Examples
    --------
    >>> round(failure_bound(1375, 0, 1 - 1e-6), 4)
    0.01
    """
    if failures >= samples:
        return 1.0
    # scipy.stats.binomtest searches for the same number, to 2e-12, and costs as much to import as 1,000 draws take.
    from scipy.special import betaincinv

    return float(betaincinv(failures + 1, samples - failures, confidence))


def count_failures(failed: Bool[np.ndarray, "3 n"], seed: int, confidence: float) -> MonteCarlo:
    """Return what draws say of which `find_failures` tells how each failed on some plant."""
    unstable, over_ms, over_mt = failed
    kinds = (unstable, over_ms & ~unstable, over_mt & ~over_ms & ~unstable)
    counts = {name: int(np.sum(kind)) for name, kind in zip(("unstable", "over_ms", "over_mt"), kinds, strict=True)}
    samples, failures = unstable.size, sum(counts.values())
    bound = failure_bound(samples, failures, confidence)
    return MonteCarlo(
        samples=samples, failures=failures, seed=seed, confidence=confidence, failure_probability_bound=bound, **counts
    )


def join_counts(parts: Sequence[MonteCarlo]) -> MonteCarlo:
    """Return what draws say that were counted apart, of one seed and confidence."""
    names, first = ("samples", "failures", "unstable", "over_ms", "over_mt"), parts[0]
    totals = {name: sum(getattr(part, name) for part in parts) for name in names}
    bound = failure_bound(totals["samples"], totals["failures"], first.confidence)
    return replace(first, failure_probability_bound=bound, **totals)


def format_draws(draws: MonteCarlo) -> str:
    """Return as HTML the numbers of draws and failures, and the bound."""
    rows = [(field.name.replace("_", " "), f"{getattr(draws, field.name):.7g}") for field in fields(draws)]
    return html_table(("draws", ""), rows)


def _format_confidence(value: float) -> str:
    complement = 1.0 - value
    return f"1 - {complement:.0e}" if complement < 1e-3 else f"{value:.3%}"
