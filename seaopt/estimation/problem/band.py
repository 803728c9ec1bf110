"""The band of a fit: the filter that residuals pass before they are weighted, and whether it shows an offset."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float

from seaopt.errors import EstimationError


def sees_level(band_hz: tuple[float, float] | None) -> bool:
    """Tell whether residuals of a band show an offset: whether the band begins at 0 Hz."""
    return band_hz is None or band_hz[0] <= 0.0


@lru_cache(maxsize=32)
def design_filter(band_hz: tuple[float, float] | None, period: float) -> tuple[Float[np.ndarray, "m 5"], int]:
    """Return the sections of a Butterworth filter of order 4 for a band, and the samples it takes to settle. An edge at
    0 or at the Nyquist frequency needs no filter. Raises EstimationError: the band is empty.
    """
    none = np.zeros((0, 5)), 0
    if band_hz is None:
        return none
    low, high = band_hz
    nyquist = 0.5 / period
    if not 0.0 <= low < high or low >= nyquist:
        raise EstimationError(
            f"band_hz = [{low:g}, {high:g}] is not a band below the Nyquist frequency {nyquist:g} Hz; "
            "give [low, high] with 0 <= low < high"
        )
    from scipy.signal import butter  # deferred: 1 s

    if low > 0.0 and high < 0.999 * nyquist:
        sos = butter(4, [low, high], "bandpass", fs=1 / period, output="sos")
    elif low > 0.0:
        sos = butter(4, low, "highpass", fs=1 / period, output="sos")
    elif high < 0.999 * nyquist:
        sos = butter(4, high, "lowpass", fs=1 / period, output="sos")
    else:
        return none
    sections = np.ascontiguousarray(np.asarray(sos)[:, [0, 1, 2, 4, 5]])
    sections.setflags(write=False)
    slowest = max(float(np.max(np.abs(np.roots([1.0, a1, a2])))) for a1, a2 in sections[:, 3:])
    if not slowest < 1.0:  # a pole at 1 to rounding, which never settles
        raise EstimationError(
            f"band_hz = [{low:g}, {high:g}] is too slow at {1 / period:g} Hz; give 0 or a higher start"
        )
    return sections, int(np.ceil(np.log(1e-4) / np.log(slowest)))
