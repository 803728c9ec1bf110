"""Welch's averages: windows under Hann's taper that overlap by half, without their means (Welch 1967).

The taper is the periodic one, whose transform is nothing but three lines, (-1/4, 1/2, -1/4): what reads spectra here
counts on it (Parseval's 3/8, the mean of three lines that an H1 estimate is). Two channels' windows are cut alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Complex, Float

INDEPENDENT = 0.947  # averages that a window counts as, half of which is the next one's (Welch 1967, Hann)
MEAN_SQUARE = 0.375  # of the taper
NEAR_PEAK = 0.89  # of a peak's height: 1 dB below it
FEWEST_LINES = 8  # for a curve through a peak
Start = TypeVar("Start")


def hann(length: int) -> Float[np.ndarray, " n"]:
    """Return Hann's taper of a period."""
    return np.hanning(length + 1)[:length]


def list_starts(runs: Iterable[slice], length: int) -> list[int]:
    """Return the first rows of the windows that lie in runs of rows, each half a window after the last."""
    return [row for run in runs for row in range(run.start, run.stop - length + 1, max(length // 2, 1))]


def thin(starts: Sequence[Start], most: int) -> list[Start]:
    """Return at most so many of the windows, evenly spread over all of them."""
    if len(starts) <= most:
        return list(starts)
    return [starts[i] for i in np.linspace(0, len(starts) - 1, most).astype(int)]


def count_averages(windows: int) -> float:
    """Return how many independent averages so many windows are worth."""
    return max(1.0, INDEPENDENT * windows)


def transform(
    windows: Float[np.ndarray, "*shape n"], taper: Float[np.ndarray, " n"]
) -> Complex[np.ndarray, "*shape m"]:
    """Return the spectra of windows without their means, tapered; the windows are used up."""
    windows -= windows.mean(axis=-1, keepdims=True)
    windows *= taper  # in place: fresh memory costs more than the transform
    return np.fft.rfft(windows)


def square(values: Complex[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Return the squared magnitude; np.abs would take a root first."""
    return np.real(values) ** 2 + np.imag(values) ** 2


def coherence(
    cross: Complex[np.ndarray, "*shape"], first: Float[np.ndarray, "*shape"], second: Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """Return the squared coherence of each line, of the averaged cross-spectrum and powers."""
    return square(cross) / np.maximum(first * second, 1e-300)


def find_top(
    f: Float[np.ndarray, " m"], size: Float[np.ndarray, " m"], std: Float[np.ndarray, " m"]
) -> tuple[float, float]:
    """Return where a response is largest, and how large: the top of a cubic through the lines within 1 dB of the
    largest, in logarithms, or that line where there are too few. `size` is its size at lines, `std` relative.
    """
    top = int(np.argmax(size))
    at, height = float(f[top]), float(size[top])
    first = top - int(np.argmax(np.append(size[top::-1] < NEAR_PEAK * size[top], True)))
    last = top + int(np.argmax(np.append(size[top:] < NEAR_PEAK * size[top], True)))
    near = slice(max(first + 1, 0), last)
    if last - near.start < FEWEST_LINES:
        return at, height
    x = np.log(f[near] / at)
    curve = np.polyfit(x, np.log(size[near]), 3, w=1.0 / np.maximum(std[near], 1e-9))
    dense = np.linspace(x[0], x[-1], 401)
    best = int(np.argmax(np.polyval(curve, dense)))
    return at * float(np.exp(dense[best])), float(np.exp(np.polyval(curve, dense[best])))
