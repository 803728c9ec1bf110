r"""At which wave number of the motor's position a residual repeats: where a refit with cogging starts.

A force :math:`a \sin(n q) + b \cos(n q)` on the motor moves an output by what the plant makes of it, G. With the motion
q that was measured, or else that the fit has, and G of the plant as it slides, residuals are regressed on
:math:`G \sin(n q)` and :math:`G \cos(n q)`, all in the frequency domain: products of spectra are those of signals.
There residuals are divided by what they have nearby, for what drifts slowly is alike for every n. Where the motor
passes a quarter of a period in a sample the force comes and goes faster than the log shows, and counts as none. The n
that accounts for most of the power of some output is where the refit starts; from others it would not get there, as
minima lie one beside the other. Which n are worth a regression is looked up first: what residuals have of a force is
summed up place by place of the motor, and the spectrum of that has all n at once.

Where a link moves, what the simulated friction does at another time than the true one is far more than cogging: there
the force is what the measured motion lacks (`seaopt.estimation.judgement.traces.missing_force`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from seaopt.estimation.judgement.traces.missing_force import find_missing_force
from seaopt.estimation.judgement.traces.whitening import Spectra, is_told, whiten
from seaopt.estimation.problem.correlation import find_quick_size
from seaopt.estimation.problem.fit_experiment import FitExperiment
from seaopt.estimation.problem.residual_statistics import ExperimentResiduals
from seaopt.estimation.problem.shapes import Vector
from seaopt.parameters import ParameterSet
from seaopt.plants.friction import friction_matrices, remove_friction
from seaopt.plants.plant import Plant, state_space

MOST = 4000  # wave numbers, one for each half period over the travel
LONGEST = 10_000  # samples, where the motor travels most: each wave number that is tried costs two spectra of them
TRIED = 8  # of each octave
PLACES = 8  # per period of the largest wave number, that what residuals have of a force is summed up in
FINE = 8  # steps on either side of the best
TURNS = 0.25  # of a period, the most that the motor moves in a sample
SURE = 1.0 / 3.0  # of the wave number that a reading is fine enough for: its steps repeat with the position, too
SLOW = 0.2  # of the samples that have to be as slow as that

Weight = tuple[float, int, float, float]  # share that a wave number accounts for, of so many samples; both amplitudes


def find_ripple(
    experiment: FitExperiment,
    left: ExperimentResiduals,
    params: ParameterSet,
    position: Float[np.ndarray, " n"],
    number: int,
) -> Mapping[str, float]:
    """Return amplitudes and wave number of the cogging that residuals show best; empty where they show none.

    `position`: of the motor, over segment `number`.
    """
    looked = _find_travel(position)
    position = position[looked]
    whitened = whiten(left.segments[number].raw.T[:, looked])
    if not np.ptp(position) or whitened is None or experiment.data.plant.sampling is not None:
        return {}
    (residual, scale), moved = whitened, np.abs(np.gradient(position))
    gain = _respond(experiment.data.plant, params, experiment.data.outputs, experiment.period, position.size) / scale

    def weigh(wave: float) -> Weight:
        slow = moved * wave < 2.0 * np.pi * TURNS
        turned = np.fft.rfft(np.stack([np.sin(wave * position), np.cos(wave * position)]) * slow)
        columns = gain[:, None, :] * turned
        gram = np.sum(np.real(columns[:, :, None, :] * np.conj(columns[:, None, :, :])), axis=(0, 3))
        right = np.sum(np.real(columns * np.conj(residual[:, None, :])), axis=(0, 2))
        amplitudes = np.linalg.lstsq(gram, right, rcond=1e-9)[0]
        rest = residual - np.einsum("c,ocf->of", amplitudes, columns)
        share = 1.0 - np.sum(np.abs(rest) ** 2, axis=1) / np.sum(np.abs(residual) ** 2, axis=1)
        return float(np.max(share)), position.size, float(amplitudes[0]), float(amplitudes[1])

    force = np.fft.irfft(np.sum(np.conj(gain) * residual, axis=0), position.size)
    return _search_waves(position, force, moved, weigh)


def find_followed_ripple(
    experiment: FitExperiment, params: ParameterSet, rows: slice, z: Vector
) -> Mapping[str, float]:
    """Return amplitudes and wave number of the cogging in the force that a measured motion lacks, over some rows of a
    log; empty where there is none.
    """
    missing = find_missing_force(experiment, params, rows, z)
    if missing is None:
        return {}
    position, force, moved = missing.position, missing.force, np.abs(missing.speed) * experiment.period

    def weigh(wave: float) -> Weight:
        slow = moved * wave < 2.0 * np.pi * TURNS
        waves = np.column_stack([np.sin(wave * position[slow]), np.cos(wave * position[slow])])
        a, b = np.linalg.lstsq(waves, force[slow], rcond=1e-9)[0]
        rest = force[slow] - waves @ (a, b)
        return 1.0 - float(np.sum(rest**2) / np.sum(force[slow] ** 2)), int(np.sum(slow)), float(a), float(b)

    return _search_waves(position, force, moved, weigh, SURE * experiment.data.find_finest(missing.state))


def _search_waves(
    position: Float[np.ndarray, " n"],
    force: Float[np.ndarray, " n"],
    moved: Float[np.ndarray, " n"],
    weigh: Callable[[float], Weight],
    finest: float = np.inf,
) -> Mapping[str, float]:
    """Return the cogging of the wave number that weighs most, up to the `finest`; empty where none counts. `force`: by
    which those that are worth a look are looked up; `moved`: from one sample to the next.
    """
    step = np.pi / float(np.ptp(position))
    top = min(2.0 * np.pi * TURNS / max(float(np.quantile(moved, SLOW)), 1e-300), MOST * step, finest)
    best = max(_list_waves(position, force, moved, step, top), key=lambda wave: weigh(wave)[0], default=0.0)
    if not best:
        return {}
    best = max(best + step * np.linspace(-1.0, 1.0, 2 * FINE + 1), key=lambda wave: weigh(wave)[0])
    share, count, a, b = weigh(best)
    return {"a_g": a, "b_g": b, "n_g": float(best)} if is_told(share, count) else {}


def move_zero(experiment: FitExperiment, z: Vector, ripple: Mapping[str, float], state: str) -> Mapping[str, float]:
    """Return a ripple over what a sensor reads as it is over the state, from which its offset is unknown."""
    if not ripple or state not in experiment.data.outputs:
        return ripple
    i = experiment.data.outputs.index(state)
    offset = experiment.point(z).offset[i] - experiment.slots.offset[i].value
    turned = complex(ripple["a_g"], ripple["b_g"]) * np.exp(1j * ripple["n_g"] * offset)
    return {**ripple, "a_g": float(turned.real), "b_g": float(turned.imag)}


def _list_waves(
    position: Float[np.ndarray, " n"],
    force: Float[np.ndarray, " n"],
    moved: Float[np.ndarray, " n"],
    step: float,
    top: float,
) -> list[float]:
    """Return the wave numbers at which a force repeats most over the positions, some of each octave up to the top."""
    grid = 2.0 * np.pi / (PLACES * top)
    place = ((position - position.min()) / grid).astype(int)
    size = find_quick_size(int(np.ceil(2.0 * np.pi / (step * grid))))
    waves, chosen, high = 2.0 * np.pi / (size * grid) * np.arange(size // 2 + 1), list[float](), top
    while high > 2.0 * step:
        slow = moved * high < 2.0 * np.pi * TURNS
        power = np.abs(np.fft.rfft(np.bincount(place, force * slow, size)))
        there = np.flatnonzero((waves > max(0.5 * high, 2.0 * step)) & (waves <= high))
        chosen += waves[there[np.argsort(power[there])[-TRIED:]]].tolist()
        high *= 0.5
    return chosen


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
