"""Two channels together: the lag at which they agree best, and whether their signs agree."""

from __future__ import annotations

import numpy as np

from seaopt.logs.quality.spectra import Spectra
from seaopt.records import record

LAGS_PER_SAMPLE = 8  # the correlation is interpolated in frequency, then by a parabola
SIGN_LAGS = 3  # samples of lag within which signs are compared
FLIPPED = 0.3  # correlation beyond which a negative sign is a flip


@record
class ChannelPair:
    """The cross-correlation of two channels."""

    # first, second: channels; a positive lag says that the second is late
    first: str
    second: str
    lag_s: float  # where the correlation is largest in size, a fraction of a sample by a parabola through three
    correlation: float  # there, with its sign
    leads: bool  # whether the second is clearly ahead: nothing within a tenth of that correlation where it is late
    flipped: bool  # whether the correlation within three samples of no lag is mostly negative


def correlate_channels(spectra: Spectra, first: str, second: str) -> ChannelPair | None:
    """Return lag and sign of the cross-correlation of two channels; None where one has no power."""
    powers = [float(np.fft.irfft(spectra.power(name))[0]) for name in (first, second)]
    if min(powers) <= 0.0:
        return None
    cross = spectra.cross(first, second)
    # Zeros above the Nyquist frequency interpolate the correlation between samples.
    fine = 2 * (cross.size - 1) * LAGS_PER_SAMPLE
    rho = LAGS_PER_SAMPLE * np.fft.irfft(cross, fine) / np.sqrt(powers[0] * powers[1])
    reach = rho.size // 4
    lags = np.arange(-reach, reach + 1)
    near = rho[lags]  # negative lags are at the end
    best = int(np.argmax(np.abs(near)))
    # The vertex of the parabola through the three lags around the largest: a fraction of a fine lag.
    shift = 0.0
    if 0 < best < near.size - 1:
        below, top, above = np.sign(near[best]) * near[best - 1 : best + 2]
        bend = float(below - 2.0 * top + above)
        shift = 0.5 * float(below - above) / bend if bend < 0.0 else 0.0
    close = near[np.abs(lags) <= SIGN_LAGS * LAGS_PER_SAMPLE]
    return ChannelPair(
        first=first,
        second=second,
        lag_s=float(lags[best] + shift) / LAGS_PER_SAMPLE * spectra.period,
        correlation=float(near[best]),
        leads=bool(lags[best] < 0 and np.max(np.abs(near[lags >= 0])) < 0.9 * abs(near[best])),
        flipped=bool(-np.min(close) > max(FLIPPED, 1.5 * np.max(close))),
    )
