"""How often a log of noise alone has a line outside its disc, at the risk of a false refutation.

    python benchmarks/judge/noise.py [--logs 400] [--seconds 15] [--inputs chirp steps] [--noises white hum]

The model has no error, so that the response of what it leaves is zero at every line of every window. At a risk of 1 %
of a log, shared among all its lines, one log in a hundred may have a line whose disc leaves zero out. The truth is
known, and nothing is fitted: what is counted is the statistics of `seaopt.frequency.residual` alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
import scipy.signal

from seaopt.frequency.residual import measure_residual

RATE_HZ, BANDWIDTH_HZ, RISK, EACH = 500.0, 15.0, 0.01, 0.05
Generator = np.random.Generator


def _chirp(n: int) -> np.ndarray:
    share, growth = np.arange(n) / n, np.log(300.0)
    return np.sin(2 * np.pi * 0.1 * n / RATE_HZ / growth * np.expm1(growth * share))


def _sines(n: int, rng: Generator, lines: np.ndarray, period: int) -> np.ndarray:
    """Return a multisine of random phases, of period `period`, or not repeated."""
    spectrum = np.zeros(period // 2 + 1, dtype=complex)
    spectrum[lines] = np.exp(2j * np.pi * rng.uniform(size=lines.size))
    one = np.fft.irfft(spectrum, period)
    return np.resize(one / np.std(one), n)


def _lag(corner_hz: float) -> Callable[[int, Generator], np.ndarray]:
    return lambda n, rng: _filter([1.0, -np.exp(-2 * np.pi * corner_hz / RATE_HZ)], n, rng)


def _filter(denominator: list[float], n: int, rng: Generator) -> np.ndarray:
    return scipy.signal.lfilter([1.0], denominator, rng.normal(size=n + 500))[500:]


INPUTS: dict[str, Callable[[int, Generator], np.ndarray]] = {
    "chirp": lambda n, _: _chirp(n),
    "both": lambda n, rng: _chirp(n) + 0.4 * _sines(n, rng, np.array([5, 9, 17, 31, 58, 110]), n),
    "white": lambda n, rng: rng.normal(size=n),
    "steps": lambda n, rng: np.repeat(rng.uniform(-1, 1, n // 250 + 1), 250)[:n],
    "periodic": lambda n, rng: _sines(n, rng, np.arange(1, 120), 1000),
}
NOISES: dict[str, Callable[[int, Generator], np.ndarray]] = {
    "white": lambda n, rng: rng.normal(size=n),
    "lag_5_hz": _lag(5.0),
    "lag_half_hz": _lag(0.5),
    "mode": lambda n, rng: _filter([1.0, -1.9323, 0.9950], n, rng),  # at 20 Hz, damped by 1 %
    "student": lambda n, rng: rng.standard_t(3, size=n),
    "bursts": lambda n, rng: rng.normal(size=n) * np.where(np.arange(n) // 500 % 5 == 0, 3.0, 1.0),
    "hum": lambda n, rng: (
        rng.normal(size=n) + 3.0 * np.sin(2 * np.pi * (10.0 * np.arange(n) / RATE_HZ + rng.uniform()))
    ),
}


def count_outside(kind: str, noise: str, logs: int, seconds: float, seed: int = 1) -> tuple[int, float]:
    """Return of how many logs a line is outside its disc at the risk of the log, and the share of all lines that are
    outside theirs at 5 %.
    """
    rng, n = np.random.default_rng(seed), round(seconds * RATE_HZ)
    logs_outside = lines = outside = 0
    for _ in range(logs):
        u, error = INPUTS[kind](n, rng), NOISES[noise](n, rng)
        found = measure_residual(
            u, np.zeros((1, n)), error[None], 1.0 / RATE_HZ, [slice(0, n)],
            longest_s=120.0 / BANDWIDTH_HZ, highest_hz=0.25 * RATE_HZ,
        )  # fmt: skip
        alpha, missed = RISK / sum(each.frequency_hz.size for each in found), False
        for each in found:
            _, centre, std, unseen = each.read(np.ones((1, each.frequency_hz.size), dtype=complex))
            missed |= bool(np.any(np.abs(centre) > std * each.widen(alpha) + unseen))
            outside += int(np.sum(np.abs(centre) > std * each.widen(EACH)))
            lines += centre.size
        logs_outside += missed
    return logs_outside, outside / max(lines, 1)


def main() -> None:
    """Count the inputs and noises that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=400)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--inputs", nargs="*", choices=INPUTS, default=list(INPUTS))
    parser.add_argument("--noises", nargs="*", choices=NOISES, default=list(NOISES))
    options = parser.parse_args()
    for kind in options.inputs:
        for noise in options.noises:
            logs, share = count_outside(kind, noise, options.logs, options.seconds)
            print(f"{kind:9s} {noise:12s} logs {100 * logs / options.logs:6.2f} %, lines at 5 % {100 * share:.2f} %")


if __name__ == "__main__":
    main()
