"""Residuals as spectra over what they have nearby, in which what drifts slowly is alike at every frequency."""

from __future__ import annotations

import numpy as np
from jaxtyping import Complex, Float

NEARBY = 31  # lines of a spectrum over which its power is its own
LEAST, OF_CHANCE = 0.01, 40.0  # of a whitened residual that a cause has to account for, and times a sample's share

Spectra = Complex[np.ndarray, "ny f"]


def whiten(
    raw: Float[np.ndarray, "ny n"],
) -> tuple[Spectra, Float[np.ndarray, "ny f"]] | None:
    """Return the spectra of residuals, without their means, over what each has nearby, and what they were divided by,
    as a response is to be, too; None where one of them is nothing, or not there.
    """
    if not np.all(np.any(np.isfinite(raw), axis=1)):
        return None
    raw = np.nan_to_num(raw - np.nanmean(raw, axis=1, keepdims=True))
    size = np.sqrt(np.sum(raw**2, axis=1, keepdims=True))
    if not np.all(size > 0.0):
        return None
    residual = np.fft.rfft(raw / size)
    nearby = min(NEARBY, residual.shape[1])
    own = np.stack([np.convolve(row, np.full(nearby, 1.0 / nearby), "same") for row in np.abs(residual) ** 2])
    own = np.sqrt(np.maximum(own, 1e-300))
    return residual / own, size * own


def is_told(share: float, count: int) -> bool:
    """Tell whether a share of a whitened residual of so many samples is more than chance gives."""
    return share > max(LEAST, OF_CHANCE / count)
