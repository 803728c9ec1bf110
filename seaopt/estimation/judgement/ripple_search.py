r"""At which wave number of the motor's position a residual repeats: where a refit with cogging starts.

A force :math:`a \sin(n q) + b \cos(n q)` on the motor moves an output by what the plant makes of it, G. With the motion
q that the fit has, and G of the plant as it slides, residuals are regressed on :math:`G \sin(n q)` and :math:`G \cos(n
q)` for each n, all in the frequency domain: products of spectra are those of signals. Where the motor passes a quarter
of a period in a sample the force comes and goes faster than the log shows, and counts as none. The n that accounts for
most of the power of some output is where the refit starts; from others it would not get there, as minima lie one beside
the other.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Complex, Float

from seaopt.estimation.problem.correlation import load_fft
from seaopt.estimation.problem.fit_experiment import FitExperiment
from seaopt.estimation.problem.residual_statistics import ExperimentResiduals
from seaopt.parameters import ParameterSet
from seaopt.plants.friction import friction_matrices, remove_friction
from seaopt.plants.plant import Plant, state_space

MOST = 1200  # wave numbers that are tried
LONGEST = 10_000  # samples, where the motor travels most: each wave number costs two spectra of them
FINE = 8  # steps on either side of the best
LEAST = 0.1  # of a residual's power that a ripple has to account for
TURNS = 0.25  # of a period, the most that the motor moves in a sample
SLOW = 0.2  # of the samples that have to be as slow as that

Spectra = Complex[np.ndarray, "ny f"]


def find_ripple(
    experiment: FitExperiment,
    left: ExperimentResiduals,
    params: ParameterSet,
    position: Float[np.ndarray, " n"],
    number: int,
) -> Mapping[str, float]:
    """Return amplitudes and wave number of the cogging that residuals show best; empty where they show none.

    `position`: of the motor as the fit has it, over segment `number`.
    """
    looked = _find_travel(position)
    position, raw = position[looked], left.segments[number].raw.T[:, looked]
    raw = np.nan_to_num(raw - np.nanmean(raw, axis=1, keepdims=True))
    size = np.sqrt(np.sum(raw**2, axis=1))
    travel, moved = float(np.ptp(position)), np.abs(np.gradient(position))
    if not travel or not np.all(size > 0.0):
        return {}
    step = np.pi / travel
    top = min(2.0 * np.pi * TURNS / max(float(np.quantile(moved, SLOW)), 1e-300), MOST * step)
    residual = load_fft().rfft(raw / size[:, None])
    gain = _respond(experiment.data.plant, params, experiment.data.outputs, experiment.period, position.size)
    gain = gain / size[:, None]

    def weigh(wave: float) -> tuple[float, float, float]:
        """Return the share of an output's power that a wave number accounts for, and both amplitudes."""
        slow = moved * wave < 2.0 * np.pi * TURNS
        turned = load_fft().rfft(np.stack([np.sin(wave * position), np.cos(wave * position)]) * slow)
        columns = gain[:, None, :] * turned
        gram = np.sum(np.real(columns[:, :, None, :] * np.conj(columns[:, None, :, :])), axis=(0, 3))
        right = np.sum(np.real(columns * np.conj(residual[:, None, :])), axis=(0, 2))
        amplitudes = np.linalg.lstsq(gram, right, rcond=1e-9)[0]
        rest = residual - np.einsum("c,ocf->of", amplitudes, columns)
        share = 1.0 - np.sum(np.abs(rest) ** 2, axis=1) / np.sum(np.abs(residual) ** 2, axis=1)
        return float(np.max(share)), float(amplitudes[0]), float(amplitudes[1])

    best = max(np.arange(2.0 * step, top, step), key=lambda wave: weigh(wave)[0], default=0.0)
    if not best:
        return {}
    best = max(best + step * np.linspace(-1.0, 1.0, 2 * FINE + 1), key=lambda wave: weigh(wave)[0])
    share, a, b = weigh(best)
    return {"a_g": a, "b_g": b, "n_g": float(best)} if share > LEAST else {}


def _find_travel(position: Float[np.ndarray, " n"]) -> slice:
    """Return the samples, at most LONGEST, over which a position travels most: a motor at rest shows no cogging."""
    travelled = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(position)))])
    begin = int(np.argmax(travelled[LONGEST - 1 :] - travelled[: 1 - LONGEST])) if position.size > LONGEST else 0
    return slice(begin, begin + LONGEST)


def _respond(plant: Plant, params: ParameterSet, outputs: tuple[str, ...], period: float, n: int) -> Spectra:
    """Return what a force against the motor's motion makes of each output, at the frequencies of n samples; 0 at 0."""
    sliding = remove_friction(plant)
    a, _, c, _ = state_space(sliding, params)
    zero = np.zeros(len(plant.states)), np.zeros(len(plant.inputs))
    to_states, to_outputs, _ = (
        np.array(each) for each in friction_matrices(plant)(*zero, plant.complete(params).vector)
    )
    rows = [list(plant.outputs).index(name) for name in outputs]
    values, vectors = np.linalg.eig(a)
    into, out = np.linalg.solve(vectors, to_states[:, :1].astype(complex)), c[rows] @ vectors
    s = 2j * np.pi * np.fft.rfftfreq(n, period)[1:]
    response = (out[:, :, None] * (into / (s - values[:, None]))).sum(axis=1) + to_outputs[rows, :1]
    return np.concatenate([np.zeros((len(rows), 1)), response], axis=1)
