r"""What each log of a plant says alone: values that differ between logs are not known better than they differ.

A model that lacks something fits one log with values that make up for it, and another amplitude asks for others. So a
second log of the same plant decides what no test of one log can: each log is refitted alone, from the fit's values,
and

- values that differ from the fit's by more than 3 of their standard deviations widen the model covariance by what they
  differ;
- where the residual is far above its sensor's noise, the values at the smallest and the largest amplitude do so,
  whatever they differ by, :math:`(\theta_\text{small} - \theta_\text{large})^2`. A plant without two amplitudes has no
  intervals then that could be believed.

Correlations of the differences are kept: what differs is one vector per pair of logs.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from seaopt.codec import OrInfinite
from seaopt.errors import SeaoptError
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_problem import pose_problem
from seaopt.estimation.problem.losses import Loss, Squares
from seaopt.estimation.problem.noise_floor import measure_floors
from seaopt.estimation.problem.shapes import ParameterMatrix, ParameterVector
from seaopt.estimation.result.findings import LogValues
from seaopt.estimation.result.fit_result import Fit
from seaopt.estimation.result.model_error import LITTLE, estimate_model_error, find_effort
from seaopt.estimation.result.summary import summarise
from seaopt.estimation.result.widening import widen
from seaopt.estimation.solver.methods import OutputError
from seaopt.estimation.solver.settle import settle_roughly
from seaopt.records import Result, Worded, record

SECOND = 0.75  # of the larger amplitude, up to which another log is a second amplitude
APART = 3.0  # standard deviations from which the values of logs differ
FAR = 3.0  # excess from which intervals of one log hold no more
MORE = 2.0  # times the excess of the fit's logs, that another log may have


def compare_logs(fit: Fit, validation: Sequence[Experiment] = ()) -> Fit:
    """Return the fit with what each log says alone, and a model covariance that has what they differ by. `validation`:
    logs that were not fitted. Logs of a plant are compared where it has several, and where the residual of one is not
    the noise of its sensor; those for validation always are.
    """
    logs: dict[str, LogValues] = {}
    matrix: ParameterMatrix = np.zeros((0, 0))
    for plant in dict.fromkeys(e.plant.name for e in (*fit.experiments, *validation)):
        fitted = [e for e in fit.experiments if e.plant.name == plant]
        others = [e for e in validation if e.plant.name == plant]
        excess = find_excess(fit, plant)
        if not fitted or len(fitted) + len(others) < 2 or (excess <= LITTLE and not others):
            continue
        group = dict(_weigh_each(fit, fitted, others))
        logs |= group
        shift = _find_shift(fit, group, excess)
        matrix = shift[:, None] * shift if not matrix.size else matrix + shift[:, None] * shift
    return replace(widen(fit, matrix) if matrix.size else fit, logs=logs) if logs else fit


@record(repr=False)
class LogComparison(Result, Worded):
    """What a log that was not fitted says of the values of a fit.

    Parameters
    ----------
    name : str
        The experiment's.
    log : LogValues
        Its own values, with std of noise, its amplitude and its excess.
    values : mapping of parameter to (value, std)
        Those of the fit, with std of noise and model together.
    amplitudes : tuple of float
        Of the fit's logs of the same plant.
    excess : float
        The residual of the fit over its sensors' noise, on its logs of the same plant.
    fit_met : bool
        Whether the fit is met, without which nothing is.
    """

    name: str
    log: LogValues
    values: Mapping[str, tuple[float, OrInfinite]]
    amplitudes: tuple[float, ...] = ()
    excess: float = 1.0
    fit_met: bool = True

    @property
    def explained(self) -> bool:
        """Whether the model, with values of the log's own, leaves little more of it than the fit leaves of its logs."""
        return self.log.excess <= max(FAR, MORE * self.excess)

    @property
    def distances(self) -> dict[str, float]:
        """What both values of each parameter differ by, in standard deviations of the difference."""
        return {
            name: abs(value - alone) / max(float(np.hypot(std, alone_std)), 1e-300)
            for name, (alone, alone_std) in self.log.values.items()
            for value, std in (self.values[name],)
        }

    @property
    def met(self) -> bool | None:
        """Whether no value differs by more than 3 standard deviations, of a fit that is met and a log that its model
        explains; None where the log determines them not.
        """
        if not self.log.determined:
            return None
        return self.fit_met and self.explained and max(self.distances.values(), default=0.0) <= APART

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict, the values of both and their distances."""
        return {
            "met": self.met,
            "amplitude": self.log.amplitude,
            "amplitudes_fitted": list(self.amplitudes),
            "excess": self.log.excess,
            "excess_fitted": self.excess,
            "fit_met": self.fit_met,
            "values": {
                name: {
                    "fit": self.values[name][0],
                    "fit_std": self.values[name][1],
                    "log": alone,
                    "log_std": std,
                    "distance": self.distances[name],
                }
                for name, (alone, std) in self.log.values.items()
            },
        }


def compare_with_log(
    fit: Fit, experiment: Experiment, loss: Loss | None = None, band_hz: tuple[float, float] | None = None
) -> LogComparison:
    """Refit the free parameters on another log, and compare them with a fit's.

    Parameters
    ----------
    fit : Fit
        Also one that was read from a file.
    experiment : Experiment
        The other log; its initial state, offsets and delay are its own.
    loss, band_hz : Loss, (low, high) in Hz, optional
        As the fit was made, for one that was read from a file.

    Returns
    -------
    LogComparison
        Prints itself; `met` where the fit is, no value differs by more than 3 standard deviations, and the model
        explains the log.

    Raises
    ------
    EstimationError
        The log is too short, or has a free parameter of its own that the fit has not.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.testing import virtual_experiment
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> one, other = (virtual_experiment(stand, thor, seed=n) for n in (1, 2))
    >>> compare_with_log(so.fit([one], thor.update(J=2e-6).free("J", "b_r")), other).met
    True
    """
    log = _read_values(fit, _refit(fit, experiment, loss, band_hz), experiment)
    output = experiment.outputs[find_effort(experiment)]
    rows = [row for name, row in fit.outputs.items() if fit.nuisance[name].plant in ("", experiment.plant.name)]
    spreads = [row[output].spread for row in rows if output in row]
    return LogComparison(
        name=experiment.name,
        log=log,
        values={name: (fit.parameters[name].value, fit.parameters[name].total_std or 0.0) for name in log.values},
        amplitudes=tuple(spread for spread in spreads if spread is not None),
        excess=max((each.excess or 0.0 for row in rows for each in row.values()), default=0.0),
        fit_met=fit.met,
    )


def find_excess(fit: Fit, plant: str) -> float:
    """Return the largest excess of the outputs of a plant's experiments."""
    rows = (fit.outputs.get(e.name, {}) for e in fit.experiments if e.plant.name == plant)
    return max((figures.excess or 0.0 for row in rows for figures in row.values()), default=0.0)


def has_two_amplitudes(logs: Mapping[str, LogValues], plant: str) -> bool:
    """Tell whether those logs of a plant that determine the values alone have two amplitudes."""
    amplitudes = [log.amplitude for log in logs.values() if log.determined and log.plant == plant]
    return len(amplitudes) > 1 and min(amplitudes) <= SECOND * max(amplitudes)


def _weigh_each(
    fit: Fit, fitted: Sequence[Experiment], others: Sequence[Experiment]
) -> Iterator[tuple[str, LogValues]]:
    """Yield the name of each log that can be fitted, and its values."""
    alone = len(fit.experiments) == 1
    for experiment in (*fitted, *others):
        try:
            refit = fit if alone and experiment in fitted else _refit(fit, experiment)
        except SeaoptError:  # a log that makes no problem says nothing
            continue
        yield experiment.name, _read_values(fit, refit, experiment)


def _refit(
    fit: Fit, experiment: Experiment, loss: Loss | None = None, band_hz: tuple[float, float] | None = None
) -> Fit:
    """Return the fit of one log alone, from the values of the whole; `loss`, `band_hz`: of a fit read from a file."""
    old = None if fit.minimum is None else fit.minimum.problem
    start = fit.parameters.with_parameters(
        *(replace(fit.parameters[name], std=None, model_std=None) for name in fit.covariance.names)
    )
    if old is not None:
        loss, band_hz = old.loss, old.band_hz
    predicts, method = old is not None and old.predicts, OutputError() if fit.minimum is None else fit.minimum.method
    problem = pose_problem((experiment,), start, loss=loss or Squares(), band_hz=band_hz, noise=predicts)
    started = time.perf_counter()
    if predicts:
        solved = replace(method, search=False).solve(problem, None)
    elif old is None:
        solved = settle_roughly(problem, problem.evaluate(problem.unknowns.start))
    else:
        z = problem.unknowns.start_from(old.unknowns.by_name(fit.require_minimum("").z))
        problem = problem.with_each(substeps=max(e.even_substeps for e in old.experiments))
        solved = settle_roughly(problem, problem.evaluate(z))
    refit = summarise(solved, method, True, started)
    # What its own residual's colour and parts add belongs to how well it knows its values.
    found = refit.require_minimum("_refit")
    noise = refit.covariance if refit.delay_covariance is None else refit.delay_covariance
    residuals = found.residuals()
    floors = measure_floors(found.problem, residuals, found.z)
    error = estimate_model_error(found.problem, found.z, residuals, floors, noise.matrix)
    outputs = {
        experiment.name: {
            name: replace(figures, excess=error.excess[f"{experiment.name}.{name}"])
            for name, figures in refit.outputs[experiment.name].items()
        }
    }
    return replace(widen(refit, error.colour), outputs=outputs)


def _read_values(fit: Fit, refit: Fit, experiment: Experiment) -> LogValues:
    names = [name for name in fit.covariance.names if name in refit.covariance.names]
    return LogValues(
        plant=experiment.plant.name,
        amplitude=float(np.nanstd(experiment.log[experiment.outputs[find_effort(experiment)]])),
        excess=find_excess(refit, experiment.plant.name),
        values={name: (refit.parameters[name].value, refit.parameters[name].total_std or 0.0) for name in names},
        determined=refit.status != "not_identifiable" and all(refit.parameters[name].identified for name in names),
    )


def _find_shift(fit: Fit, logs: Mapping[str, LogValues], excess: float) -> ParameterVector:
    """Return what the logs' values differ by, of each parameter the most; zero for the delays."""
    noise = fit.covariance if fit.delay_covariance is None else fit.delay_covariance
    shift = np.zeros(len(noise.names))
    determined = [log for log in logs.values() if log.determined]
    if not determined:
        return shift
    large, small = (choose(determined, key=lambda log: log.amplitude) for choose in (max, min))
    pair = excess > FAR and has_two_amplitudes(logs, determined[0].plant)
    for i, name in enumerate(fit.covariance.names):
        value, std = fit.parameters[name].value, fit.covariance.std(name)
        moves = [
            log.values[name][0] - value
            for log in determined
            if name in log.values and abs(log.values[name][0] - value) > APART * np.hypot(std, log.values[name][1])
        ]
        if pair and name in small.values and name in large.values:
            moves.append(small.values[name][0] - large.values[name][0])
        shift[i] = max(moves, key=abs, default=0.0)
    return shift
