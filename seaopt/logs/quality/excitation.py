"""Excitation of an input by third-octave bands, those to which an output responds, and what they can identify."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from seaopt import welch
from seaopt.codec import Key
from seaopt.logs.quality.spectra import Spectra
from seaopt.records import record
from seaopt.signals import VectorN, bridge

RANGE_DB = 40.0  # below the strongest band; what is weaker is not excited
DIP_BANDS = 3  # of a third of an octave, between usable ones: the coherence may be low in them
REACHED = 0.1  # of the largest power in a band; what is weaker is the window's
PEAK = 1.2  # times the response in the lowest usable band, from which a largest one is a peak
BESIDE = 1.6  # times and divided by the middle of the band of the largest response: where its peak is looked for
SMOOTHING = np.array([0.25, 0.75, 1.0, 0.75, 0.25]) / 3.0  # of the lines of a whole log
MOST_ROWS = 1 << 21  # of which a peak is looked for
LEAST_COHERENCE = 0.5  # of an output with the input, power-weighted; below it most of the output is something else


@record
class ThirdOctave:
    """A band of a third of an octave."""

    json_keys = (
        *("low_hz", "high_hz", "reach_hz", "share", "level_db", "coherence", "gain"),
        Key(field="usable", name="told"),
    )

    # low_hz, high_hz: edges
    low_hz: float
    high_hz: float
    reach_hz: float  # highest frequency in it that is excited
    share: float  # of the input's power
    # power of the band, or density in it, whichever is nearer to its largest value anywhere, relative to that
    level_db: float
    coherence: float | None  # of the output that answers best; None without outputs
    # size of the response of the output that answers best over all bands, in its unit over the input's
    gain: float | None
    # whether a model can be identified from it: within 40 dB of the strongest, and coherence of 0.5 or more
    usable: bool

    @property
    def middle_hz(self) -> float:
        """Its middle, on a logarithmic axis."""
        return float(np.sqrt(self.low_hz * self.high_hz))


@record
class InputExcitation:
    """The bands of one input; `output` is the one whose gains they have, "" where there is none."""

    json_keys = (
        *(Key(field="usable_hz", name="told_hz"), "sentence", "bands", "channel", "nyquist_hz", "output"),
        Key(field="top_hz", name="top_hz", omit_none=True),
    )

    channel: str
    bands: tuple[ThirdOctave, ...]
    nyquist_hz: float
    output: str = ""
    top_hz: float | None = None  # where the response is largest in and beside the band where it is, by lines of a log

    @property
    def usable_hz(self) -> tuple[float, float] | None:
        """The widest run of usable bands, in octaves; None where there is none. A dip of the coherence within it is
        part of it, where the input excites: beside a sharp resonance the window leaks its power, and at an
        antiresonance little is left of the output.
        """
        best: tuple[float, float] | None = None
        start: float | None = None
        dip = 0
        for band in self.bands:
            if not band.usable:
                dip += 1
                if dip > DIP_BANDS or band.level_db < -RANGE_DB:
                    start = None
                continue
            dip = 0
            start = band.low_hz if start is None else start
            if best is None or band.reach_hz / start > best[1] / best[0]:
                best = (start, band.reach_hz)
        return best

    @property
    def rolls_off_hz(self) -> float | None:
        """Where the response has fallen to half of its largest value, above that and within the usable bands."""
        places = self._find_roll_off()
        return None if places is None else places[1].middle_hz

    @property
    def peak_hz(self) -> float | None:
        """Where the response is largest, if that is a peak: it falls to half above, and is less below."""
        places = self._find_roll_off()
        if places is None:
            return None
        top, lowest = places[0], next(band for band in self.bands if band.usable)
        return (self.top_hz or top.middle_hz) if (top.gain or 0.0) > PEAK * (lowest.gain or 0.0) else None

    def _find_roll_off(self) -> tuple[ThirdOctave, ThirdOctave] | None:
        """Return the band of the largest response and the first above it of half as much; None where none is."""
        usable = self.usable_hz
        inside = [band for band in self.bands if band.usable and usable and usable[0] <= band.low_hz < usable[1]]
        gains = [band.gain for band in inside if band.gain is not None]
        if len(gains) < 3 or len(gains) < len(inside):
            return None
        top = int(np.argmax(gains))
        half = next((at for at in range(top, len(gains)) if gains[at] <= 0.5 * gains[top]), None)
        return None if half is None else (inside[top], inside[half])

    @property
    def sentence(self) -> str:
        """Which frequencies show a linear response, and what that means for a fit."""
        usable = self.usable_hz
        if usable is None:
            return (
                f"no output follows {self.channel} linearly at {self.bands[0].low_hz:.2g} Hz or above: check the "
                "channels, and drive harder. Of slower motion, friction and large swings this test says nothing: a fit "
                "may still identify their parameters"
            )
        low, high = usable
        if self.bands[0].coherence is not None:
            sentence = f"the outputs respond to {self.channel} between {low:.3g} and {high:.3g} Hz"
        else:
            sentence = f"{self.channel} is excited between {low:.3g} and {high:.3g} Hz"
        if high < 0.8 * self.nyquist_hz:
            sentence += f"; nothing above {high:.3g} Hz"
        peak, half = self.peak_hz, self.rolls_off_hz
        if peak is not None:
            sentence += f"; the response of {self.output} is largest near {peak:.2g} Hz and falls to half above"
        elif half is not None:
            sentence += f"; the response of {self.output} has fallen to half near {half:.2g} Hz, without a peak"
        elif self.bands[0].gain is not None:
            sentence += "; no response falls to half in there: only a fit tells how well it shows inertia and stiffness"
        if low > 4.0 * self.bands[0].low_hz:
            sentence += f"; nothing linear below {low:.3g} Hz, where static gain and friction would be told apart"
        return sentence


def assess_excitation(spectra: Spectra, channel: str, outputs: Sequence[str]) -> InputExcitation | None:
    """Return the bands that an input excites and in which `outputs` let a model be identified; None of a constant."""
    f, power = spectra.frequency_hz[1:], spectra.power(channel)[1:]
    total = float(np.sum(power))
    if total <= 0.0:
        return None
    answering = [name for name in outputs if np.sum(spectra.power(name)[1:]) > 0.0]
    coherences = {name: spectra.coherence(channel, name)[1:] for name in answering}
    # Gains are all of one output, or they could not be compared.
    loudest = max(answering, key=lambda name: float(power @ coherences[name]), default=None)
    gains = np.abs(spectra.cross(channel, loudest)[1:]) / np.maximum(power, 1e-300) if loudest is not None else None
    # Third octaves with the lowest line at the middle of the first.
    count = int(np.ceil(3.0 * np.log2(f[-1] / f[0]))) + 1
    edges = f[0] * 2.0 ** ((np.arange(count + 1) - 0.5) / 3.0)
    places = np.digitize(f, edges) - 1
    rows = [np.flatnonzero(places == k) for k in range(count)]
    sums = np.array([np.sum(power[row]) for row in rows])
    densities = np.array([np.mean(power[row]) if row.size else 0.0 for row in rows])
    # A sine fills one line of a wide band, noise all of it: judged by power and by density, each counts as excited.
    with np.errstate(divide="ignore"):
        levels = 10.0 * np.log10(np.maximum(sums / np.max(sums), densities / np.max(densities)))
    bands: list[ThirdOctave] = []
    for k, row in enumerate(rows):
        if not row.size:
            continue
        weight = power[row] / max(float(np.sum(power[row])), 1e-300)
        best = max((float(weight @ coherence[row]) for coherence in coherences.values()), default=None)
        bands.append(
            ThirdOctave(
                low_hz=float(edges[k]),
                high_hz=float(min(edges[k + 1], f[-1])),
                reach_hz=float(np.max(f[row[power[row] >= REACHED * np.max(power[row])]])),
                share=float(sums[k] / total),
                level_db=float(max(levels[k], -300.0)),
                coherence=best,
                gain=float(weight @ gains[row]) if gains is not None else None,
                usable=bool(levels[k] >= -RANGE_DB and (best is None or best >= LEAST_COHERENCE)),
            )
        )
    return InputExcitation(channel=channel, bands=tuple(bands), nyquist_hz=float(f[-1]), output=loudest or "")


def find_top(excitation: InputExcitation, u: VectorN, y: VectorN, period: float) -> float | None:
    """Return where the response of y to u is largest, near the peak of bands; None where no line there is usable.

    Of lines of the whole log, smoothed: a chirp passes a resonance within one window or two, which see a part of its
    ringing, and windows of a sixteenth of a log and thirds of an octave are wider than a light damping's peak.
    """
    near = excitation.peak_hz
    if near is None:
        return None
    u, y = (bridge(values[:MOST_ROWS]) for values in (u, y))
    f = np.fft.rfftfreq(u.size, period)
    inside = np.flatnonzero((f > near / BESIDE) & (f < near * BESIDE))
    if inside.size < SMOOTHING.size:
        return None
    first, second = np.fft.rfft(u - np.mean(u))[inside], np.fft.rfft(y - np.mean(y))[inside]
    cross = np.convolve(np.conj(first) * second, SMOOTHING, "same")
    power, other = (np.convolve(welch.square(lines), SMOOTHING, "same") for lines in (first, second))
    coherence = welch.coherence(cross, power, other)
    good = (coherence >= LEAST_COHERENCE) & (power >= REACHED * np.max(power))
    if not np.any(good):
        return None
    std = np.sqrt(np.maximum(1.0 - coherence[good], 0.0) / coherence[good])  # up to a factor
    return welch.find_top(f[inside][good], np.abs(cross[good]) / power[good], std)[0]
