"""The predictions of a fit: in free run and one sample ahead, over the samples used and over those held out.

The prediction one sample ahead is a steady-state Kalman filter's (see `steady_state_filter`). A fit of errors of
prediction has one; for any other the plant stays as fitted, and the process noise is the multiple of the states' size
that predicts best.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from seaopt.estimation.problem.fit_experiment import FitExperiment, FitOutput
from seaopt.estimation.problem.residual_statistics import (
    ExperimentResiduals,
    ResidualsByExperiment,
    compute_experiment_residuals,
    compute_residuals,
)
from seaopt.estimation.problem.shapes import Parts, Signal
from seaopt.estimation.problem.unknowns import Slot
from seaopt.estimation.result.fit_result import Minimum
from seaopt.estimation.solver.prediction import add_predictors
from seaopt.records import record

NOISE_LEVELS = (np.log(1e-6), np.log(0.1))  # of process noise over the states' size
RUNAWAY_COST = 1e300  # of a filter that runs away
LEVEL_TOLERANCE = 0.3  # no finer than the forecast feels


@record
class Percent:
    """Fit percent, in the fit's band, over the samples used and over those held out; None where there are none."""

    used: float
    held_out: float | None

    def __str__(self) -> str:
        return f"{self.used:.2f} %" + ("" if self.held_out is None else f" (held out {self.held_out:.2f} %)")


def split_samples(output: FitOutput) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return which samples of an output took part in the fit, and which were held out but can be predicted."""
    segments, o, settle = output.experiment.segments, output.index, output.experiment.weights.settle
    used = np.concatenate([segment.mark_counted(settle)[:, o] for segment in segments])
    started = np.concatenate([np.full(segment.samples.n, segment.has_start) for segment in segments])
    present = np.concatenate([np.isfinite(channel) for channel in output.measured])
    kept = np.concatenate([segment.mark_counted(0)[:, o] for segment in segments])
    return used, ~kept & started & present


def compute_percent(output: FitOutput, residuals: ResidualsByExperiment) -> Percent:
    """Return 100 (1 - |residual| / |measured - mean|), in the fit's band, over samples used and over those held out."""
    measured = filter_to_band(output.experiment, output.measured)
    raw = filter_to_band(output.experiment, residuals[output.experiment.name].raw_of(output.name))

    def percent(rows: Bool[np.ndarray, " n"]) -> float:
        spread = measure_length(measured[rows] - np.mean(measured[rows]))
        return 100.0 * (1.0 - measure_length(raw[rows]) / max(spread, 1e-150))

    used, held_out = split_samples(output)
    return Percent(used=percent(used), held_out=percent(held_out) if np.any(held_out) else None)


def measure_length(signal: Signal) -> float:
    """Return the root of the sum of squares, also of a free run that runs away so far that its squares overflow."""
    largest = float(np.max(np.abs(signal), initial=0.0))
    return largest * float(np.linalg.norm(signal / largest)) if 0.0 < largest < np.inf else largest


def filter_to_band(experiment: FitExperiment, rows: Parts) -> Signal:
    """Return one signal of all segments, filtered to the fit's band where it has one; missing samples count as zero."""
    signals = [np.where(np.isfinite(row), row, 0.0) for row in rows]
    sections = experiment.weights.sections
    if len(sections):
        from scipy.signal import sosfilt, sosfilt_zi  # deferred: 1 s

        sos = np.insert(sections, 3, 1.0, axis=1)
        start = np.asarray(sosfilt_zi(sos))  # as if the first sample had stood for ever: no step at the start
        signals = [np.asarray(sosfilt(sos, row, zi=start * row[0])[0]) for row in signals]
    return np.concatenate(signals)


def simulate_freely(minimum: Minimum, residuals: ResidualsByExperiment) -> ResidualsByExperiment:
    """Return what the simulation leaves over, which is the fit's own residuals unless they are errors of prediction."""
    if not minimum.problem.predicts:
        return residuals
    return compute_residuals(minimum.problem.with_each(predictor=None), minimum.z)


def predict_one_step(minimum: Minimum) -> ResidualsByExperiment | None:
    """Return the errors of prediction one sample ahead, held-out samples too; None where no filter is found."""
    problem = minimum.problem
    if problem.predicts:  # which sees what is measured only where it is not held out
        return {e.name: compute_experiment_residuals(_keep_all(e), minimum.z) for e in problem.experiments}
    predicting = add_predictors(problem.with_each(band_hz=None), minimum.z, follows=False)
    if predicting is None:
        return None
    errors: dict[str, ExperimentResiduals] = {}
    for experiment in predicting.experiments:
        used = np.concatenate([segment.mark_counted(0) for segment in experiment.segments])
        predicted = _predict_at_best_level(_keep_all(experiment), minimum.z, used)
        if predicted is None:
            return None
        errors[experiment.name] = predicted
    return errors


def _keep_all(experiment: FitExperiment) -> FitExperiment:
    """Return the experiment with weight on the samples that were held out."""
    segments = (replace(segment, samples=replace(segment.samples, keep=())) for segment in experiment.segments)
    return replace(experiment, segments=tuple(segments))


def _predict_at_best_level(
    experiment: FitExperiment, z: Float[np.ndarray, " unknowns"], used: Bool[np.ndarray, "n ny"]
) -> ExperimentResiduals | None:
    """Return the errors of prediction at the level of process noise that predicts the used samples best."""
    from scipy.optimize import minimize_scalar  # deferred: scipy is slow to load

    def predict(level: float) -> ExperimentResiduals:
        noise = (Slot(value=float(level)),) * experiment.model.nx
        return compute_experiment_residuals(replace(experiment, slots=replace(experiment.slots, noise=noise)), z)

    def cost(level: float) -> float:
        with np.errstate(all="ignore"):
            squares = np.sum(np.where(used, predict(level).raw, 0.0) ** 2, axis=0)
            total = float(np.sum(np.log(np.maximum(squares, 1e-300))))
        return total if np.isfinite(total) else RUNAWAY_COST

    best = minimize_scalar(cost, bounds=NOISE_LEVELS, method="bounded", options={"xatol": LEVEL_TOLERANCE})
    return predict(float(best.x)) if best.fun < RUNAWAY_COST else None
