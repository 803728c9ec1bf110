r"""Does firmware take its command only every so many rows of a log? What that leaves in a residual, whatever the plant.

A command that is held over M rows is, besides late by (M - 1)/2 of them, different from row to row of each period:

.. math:: a_{M,p}(k) = u(k - (k - p) \bmod M) - \frac{1}{M} \sum_{p'} u(k - (k - p') \bmod M)

The mean over the phases is what a plant with a filter in front makes as well; a is not, for its spectrum is that of the
command about multiples of 1/(M T), where there is no command. With G of the plant as it slides, residuals are regressed
on :math:`G a_{M,p}` in the frequency domain, divided by what they have nearby, for all M and p.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Complex, Float

from seaopt.estimation.judgement.traces.ripple_search import NEARBY
from seaopt.estimation.problem.fit_experiment import FitExperiment
from seaopt.estimation.problem.residual_statistics import ExperimentResiduals
from seaopt.parameters import ParameterSet
from seaopt.plants.friction import remove_friction
from seaopt.plants.plant import state_space
from seaopt.signals import HOLDS

MOST = 20  # rows that a value may stand for
LONGEST = 16_384  # rows that are looked at
LEAST, OF_CHANCE = 0.01, 40.0  # of a whitened residual that a hold has to account for, and times a row's share

Signal = Float[np.ndarray, " n"]


def find_holds(
    experiment: FitExperiment, left: ExperimentResiduals, params: ParameterSet
) -> Mapping[int, tuple[float, int]]:
    """Return by number of rows the share of a residual that a hold over them accounts for at most, and the row at which
    it begins then; empty where nothing is told: no single command that is held, or a log with gaps.
    """
    data = experiment.data
    plant, log = data.plant, data.log
    command = plant.actuation.input if plant.actuation else ""
    plain = data.hold == "zero" and not data.feedback and len(left.segments) == len(data.log_segments) == 1
    if not plain or command not in log.signals or HOLDS in log.signals or plant.sampling is not None:
        return {}
    rows = slice(0, LONGEST)
    u, raw = log[command][data.log_segments[0]][rows], left.segments[0].raw[rows].T
    raw = np.nan_to_num(np.nanmean(raw, axis=1, keepdims=True) - raw)  # measured less model
    size = np.sqrt(np.sum(raw**2, axis=1, keepdims=True))
    if u.size < 4 * MOST or not np.all(size > 0.0) or not np.ptp(u):
        return {}
    residual = np.fft.rfft(raw / size)
    nearby = min(NEARBY, residual.shape[1])
    own = np.stack([np.convolve(row, np.full(nearby, 1.0 / nearby), "same") for row in np.abs(residual) ** 2])
    own = np.sqrt(np.maximum(own, 1e-300))
    residual, gain = residual / own, _respond(experiment, params, command, u.size) / size / own
    whole = float(np.sum(np.abs(residual) ** 2))
    least, found = max(LEAST, OF_CHANCE / u.size), dict[int, tuple[float, int]]()
    for samples in range(2, MOST + 1):
        index = np.arange(u.size)
        held = np.stack([u[np.maximum(index - (index - first) % samples, 0)] for first in range(samples)])
        columns = np.fft.rfft(held - np.mean(held, axis=0))[:, None] * gain
        along = np.sum(np.real(np.conj(columns) * residual), axis=(1, 2))
        shares = along * np.maximum(along, 0.0) / np.sum(np.abs(columns) ** 2, axis=(1, 2)) / whole
        first = int(np.argmax(shares))
        if shares[first] > least:
            start = data.log_segments[0].start
            found[samples] = float(shares[first]), (start + first) % samples
    return found


def _respond(experiment: FitExperiment, params: ParameterSet, command: str, n: int) -> Complex[np.ndarray, "ny f"]:
    """Return what the sliding plant makes of a command that is held from row to row, at the frequencies of n rows."""
    plant, period = experiment.data.plant, experiment.period
    from scipy.linalg import expm  # deferred: scipy is slow to load

    a, b, c, d = state_space(remove_friction(plant), params)
    outputs = [list(plant.outputs).index(name) for name in experiment.data.outputs]
    column, nx = list(plant.inputs).index(command), len(a)
    whole = expm(period * np.block([[a, b[:, [column]]], [np.zeros((1, nx + 1))]]))
    z = np.exp(2j * np.pi * np.fft.rfftfreq(n))[1:, None, None]
    states = np.linalg.solve(z * np.eye(nx) - whole[:nx, :nx], whole[:nx, nx:])
    response = (c[outputs] @ states)[:, :, 0].T + d[outputs, column : column + 1]
    return np.concatenate([np.zeros((len(outputs), 1)), response], axis=1)
