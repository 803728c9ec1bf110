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

from seaopt.estimation.judgement.traces.whitening import Spectra, is_told, whiten
from seaopt.estimation.problem.fit_experiment import FitExperiment
from seaopt.estimation.problem.residual_statistics import ExperimentResiduals
from seaopt.parameters import ParameterSet
from seaopt.plants.friction import remove_friction
from seaopt.plants.plant import state_space
from seaopt.signals import HOLDS, find_taken

MOST = 20  # rows that a value may stand for
LONGEST = 16_384  # rows that are looked at


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
    u, whitened = log[command][data.log_segments[0]][rows], whiten(-left.segments[0].raw[rows].T)  # measured less model
    if u.size < 4 * MOST or whitened is None or not np.ptp(u):
        return {}
    residual, scale = whitened
    gain = _respond(experiment, params, command, u.size) / scale
    whole, found = float(np.sum(np.abs(residual) ** 2)), dict[int, tuple[float, int]]()
    for samples in range(2, MOST + 1):
        held = np.stack([u[find_taken(u.size, samples, first)[0]] for first in range(samples)])
        columns = np.fft.rfft(held - np.mean(held, axis=0))[:, None] * gain
        along = np.sum(np.real(np.conj(columns) * residual), axis=(1, 2))
        shares = along * np.maximum(along, 0.0) / np.sum(np.abs(columns) ** 2, axis=(1, 2)) / whole
        first = int(np.argmax(shares))
        if is_told(float(shares[first]), u.size):
            start = data.log_segments[0].start
            found[samples] = float(shares[first]), (start + first) % samples
    return found


def _respond(experiment: FitExperiment, params: ParameterSet, command: str, n: int) -> Spectra:
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
