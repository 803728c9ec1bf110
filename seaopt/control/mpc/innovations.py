r"""The noise of a plant, from a log: what makes the innovations of its Kalman filter most likely.

With the sensors' standard deviations and each input's white noise as unknowns, :math:`\theta`, the innovations
:math:`\epsilon_k` of the steady-state filter are independent with covariance S if :math:`\theta` is right, so that

.. math:: \hat\theta = \arg\min_\theta \; \log\det S(\theta)
          + \frac1N \sum_k (\epsilon_k - \bar\epsilon)^T S(\theta)^{-1} (\epsilon_k - \bar\epsilon)

(Ljung, System Identification, 2nd ed., Sec. 7.4). The mean of the innovations is what constant offsets of the sensors
leave, :math:`\bar\epsilon = (I - C (I - A + A L C)^{-1} A L)\, o`. The search is Nelder and Mead's in logarithms, from
sensors as the outputs' third differences have them, which no plant of a few tens of hertz moves.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.control.mpc.estimator import Estimator, estimator
from seaopt.control.mpc.noise import NoiseModel
from seaopt.errors import ControlError
from seaopt.estimation import Fit
from seaopt.logs import Log
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant

DECADES = 8  # of the input's noise below what would explain the whole output
SETTLING = 10  # the first tenth of the log is left out: the filter starts at rest
MIN_NOISE_SAMPLES = 200
UNSEEN_OFFSET = 1e-6  # of what sensors show of their offsets; a part as small as that is the plant's own place


def estimate_noise(
    plant: Plant, params: ParameterSet | Fit, log: Log, *, outputs: tuple[str, ...] = ("F1",), delay_samples: int = 0
) -> NoiseModel:
    """Return the sensors' noise and offsets, and a white noise on the plant's first input, that explain a log best.

    An offset that the plant's position could explain, such as that of a free body, is left at zero.

    Parameters
    ----------
    plant, params
        As for `estimator`.
    log : Log
        Without gaps, from about rest; the samples that the plant was fitted to, or others.
    outputs : tuple of str
        What was measured.
    delay_samples : int
        Whole samples from the logged input to the drive; `drive_delay_s` among the parameters is the drive's own.

    Raises
    ------
    ControlError
        As `estimator` and `Estimator.run`; or the log is too short.
    """
    if len(log) < MIN_NOISE_SAMPLES:
        raise ControlError(f"{log.source} has {len(log)} samples; noise takes at least {MIN_NOISE_SAMPLES}")
    from scipy.optimize import minimize  # deferred: scipy is slow to load

    drive = next(iter(plant.inputs))
    for name in outputs:
        if not np.ptp(log[name]) > 0.0:  # NaN too
            raise ControlError(f"{log.source}: {name} stands still or has missing samples; give a part that moves")
    sensors = {name: _third_difference(log[name]) for name in outputs}
    base = NoiseModel(sensor_std=sensors, input_noise={drive: 1.0})

    def filter_of(logs: Float[np.ndarray, " q"]) -> Estimator:
        scale = np.exp(logs)
        trial = replace(
            base,
            sensor_std={name: sensors[name] * float(s) for name, s in zip(outputs, scale[1:], strict=True)},
            input_noise={drive: float(scale[0])},
        )
        return estimator(plant, params, trial, outputs=outputs, sample_time_s=log.period, delay_samples=delay_samples)

    def cost(logs: Float[np.ndarray, " q"]) -> float:
        kalman = filter_of(logs)
        e = _settled_innovations(kalman, log)
        S = kalman.innovation_covariance
        spread = e - e.mean(axis=0)
        return float(np.linalg.slogdet(S)[1] + np.sum(spread * np.linalg.solve(S, spread.T).T) / len(e))

    full = np.log(np.std(log[drive]) * np.sqrt(log.period) + 1e-9)
    levels = full - np.log(10.0) * np.arange(0.0, DECADES, 0.5)
    trials = np.array([[level, *np.zeros(len(outputs))] for level in levels])
    start = trials[int(np.argmin([cost(trial) for trial in trials]))]
    simplex = np.vstack([start, start + np.eye(start.size)])
    options = {"xatol": 1e-3, "fatol": 1e-9, "maxfev": 200 * start.size, "initial_simplex": simplex}
    kalman = filter_of(minimize(cost, start, method="Nelder-Mead", options=options).x)
    return replace(kalman.noise, offset=_offsets(kalman, _settled_innovations(kalman, log).mean(axis=0)))


def _settled_innovations(kalman: Estimator, log: Log) -> Float[np.ndarray, "m ny"]:
    innovations = kalman.run(log).innovations
    return np.column_stack([innovations[name][len(log) // SETTLING :] for name in kalman.outputs])


def _third_difference(y: Float[np.ndarray, " n"]) -> float:
    """Return the standard deviation of white noise on a smooth signal: third differences have 20 times its variance."""
    return max(float(np.sqrt(np.mean(np.diff(y, 3) ** 2) / 20.0)), 1e-9 * float(np.ptp(y)))


def _offsets(kalman: Estimator, mean: Float[np.ndarray, " ny"]) -> dict[str, float]:
    lead = kalman.A @ kalman.gain
    n = len(kalman.A)
    passed = np.eye(mean.size) - kalman.C @ np.linalg.solve(np.eye(n) - kalman.A + lead @ kalman.C, lead)
    offsets = np.linalg.lstsq(passed, mean, rcond=UNSEEN_OFFSET)[0]
    return dict(zip(kalman.outputs, offsets.tolist(), strict=True))
