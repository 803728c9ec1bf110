"""Two channels together: the lag at which they agree best, and whether their signs agree."""

from __future__ import annotations

import numpy as np

from seaopt.logs.spectra import Spectra
from seaopt.records import record

FINE = 8  # lags a sample: the correlation is interpolated in frequency, then by a parabola
NEAR = 3  # samples of lag within which signs are compared
FLIPPED = 0.3  # correlation beyond which a negative sign is a flip


@record
class Pair:
    """The cross-correlation of two channels.

    Parameters
    ----------
    first, second : str
        Channels; a positive lag says that the second is late.
    lag_s : float
        Where the correlation is largest in size, a fraction of a sample by a parabola through three.
    correlation : float
        There, with its sign.
    leads : bool
        Whether the second is clearly ahead: nothing within a tenth of that correlation where it is late.
    flipped : bool
        Whether the correlation within three samples of no lag is mostly negative.

    """

    first: str
    second: str
    lag_s: float
    correlation: float
    leads: bool
    flipped: bool


def pair(found: Spectra, first: str, second: str) -> Pair | None:
    """Return how two channels go together; None where one has no power.

    Examples
    --------
    >>> from seaopt.logs.spectra import spectra
    >>> x = np.random.default_rng(1).normal(size=4000)
    >>> both = spectra({"a": x[5:], "b": -x[:-5]}, [slice(0, 3995)], 0.01)
    >>> agreed = pair(both, "a", "b")
    >>> round(agreed.lag_s, 3), agreed.correlation < -0.9
    (0.05, True)

    """
    own = [float(np.fft.irfft(found.power(name))[0]) for name in (first, second)]
    if min(own) <= 0.0:
        return None
    cross = found.cross(first, second)
    fine = 2 * (cross.size - 1) * FINE
    rho = FINE * np.fft.irfft(cross, fine) / np.sqrt(own[0] * own[1])
    reach = rho.size // 4
    lags = np.arange(-reach, reach + 1)
    near = rho[lags]  # negative lags are at the end
    best = int(np.argmax(np.abs(near)))
    shift = 0.0
    if 0 < best < near.size - 1:
        below, top, above = np.sign(near[best]) * near[best - 1 : best + 2]
        bend = float(below - 2.0 * top + above)
        shift = 0.5 * float(below - above) / bend if bend < 0.0 else 0.0
    close = near[np.abs(lags) <= NEAR * FINE]
    return Pair(
        first=first,
        second=second,
        lag_s=float(lags[best] + shift) / FINE * found.period,
        correlation=float(near[best]),
        leads=bool(lags[best] < 0 and np.max(np.abs(near[lags >= 0])) < 0.9 * abs(near[best])),
        flipped=bool(-np.min(close) > max(FLIPPED, 1.5 * np.max(close))),
    )
