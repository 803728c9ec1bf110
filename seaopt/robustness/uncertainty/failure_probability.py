"""What failures among independent draws say of the probability of failure."""

from __future__ import annotations


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
