"""Diagnostics of a fit, with remedies: tests of its residuals, of its predictions, and of its data.

The fit's own judgement (see `judge`) names faults of the model: its findings come first. Tests of the residuals that
need more than the verdict does have modules of their own: `correlation`, `forecasts`, `leverage`, and `score_test` for
parameters that were fixed. Their results are put into sentences here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.codec import to_content
from seaopt.estimation.advice.forecasts import Percent, compute_percent, predict_one_step, simulate_freely
from seaopt.estimation.judgement.judge import judge
from seaopt.estimation.judgement.score_test import ScoreTest, run_score_tests
from seaopt.estimation.problem.correlation import (
    INPUT_LAGS,
    QUANTILE,
    CrossCorrelation,
    autocorrelation,
    cross_correlation,
)
from seaopt.estimation.problem.fit_experiment import FitOutput
from seaopt.estimation.problem.residual_statistics import ExperimentResiduals, ResidualsByExperiment, compute_statistics
from seaopt.estimation.result.findings import FitFinding
from seaopt.estimation.result.fit_result import Fit
from seaopt.estimation.result.summary import describe_outputs
from seaopt.estimation.uncertainty.leverage import PRIORS, Leverage, measure_leverage
from seaopt.formatting import format_percent
from seaopt.records import PlotAccessor, Result, Worded, record

SIGNIFICANCE = 0.01  # a test that fails with less than this probability by chance is reported
LARGE = 0.05  # of an output's rms: a residual that is worth words for its colour alone
LITTLE = 0.01  # share of the information


@record(eq=False)
class OutputDiagnostics:
    """The residual of one output of one experiment."""

    whiteness_p: float  # Ljung-Box p-value of the weighted residual
    autocorrelation: Float[np.ndarray, " lags1"]  # of the weighted residual
    autocorrelation_bound: float  # 99 % bound at one lag, for a white residual
    inputs: Mapping[str, CrossCorrelation]  # inputs that move
    # free_run, one_step: fit of the simulation, and of the prediction one sample ahead; the latter is NaN where no
    # filter is found
    free_run: Percent
    one_step: Percent


@record(eq=False, repr=False)
class Diagnostics(Result, Worded):
    """Tests of a fit; ``print(diagnostics)`` is a report.

    Parameters
    ----------
    outputs : mapping of experiment to mapping of output to OutputDiagnostics
    leverage : mapping of experiment to Leverage
        With "priors", where there are some.
    at_bound : tuple of str
        Unknowns that lie on a bound.
    held : mapping of name to ScoreTest
        The test of each fixed parameter, the one that would lower the cost most first; without those that have
        the same effect as the free ones, or that would make a linear plant nonlinear.
    aic, bic : float
        Of the fit.
    findings : tuple of FitFinding
        Of the fit; of one that was made without diagnostics, of its judgement here.
    sentences : tuple of str
        Faults with their remedies, the worst first; empty if no problem was found.
    residuals : mapping of experiment to ExperimentResiduals
        The residuals that were tested.
    """

    plot = PlotAccessor()
    json_keys = ("met", "outputs", "leverage", "at_bound", "held", "aic", "bic", "sentences")

    outputs: Mapping[str, Mapping[str, OutputDiagnostics]]
    leverage: Mapping[str, Leverage]
    at_bound: tuple[str, ...]
    held: Mapping[str, ScoreTest]
    aic: float
    bic: float
    findings: tuple[FitFinding, ...]
    sentences: tuple[str, ...]
    residuals: ResidualsByExperiment = field(default_factory=dict[str, ExperimentResiduals], repr=False)

    @property
    def met(self) -> bool:
        """Whether no problem was found."""
        return not self.sentences

    def to_dict(self) -> dict[str, Any]:
        """Return the content as numbers, lists and text."""
        return to_content(self)


def diagnose(fit: Fit) -> Diagnostics:
    """Test a fit: residuals, predictions, bounds, and where its information comes from (`Diagnostics`).

    Parameters
    ----------
    fit : Fit
        As `fit` returned it.

    Raises
    ------
    EstimationError
        The fit was read from a file.

    Examples
    --------
    A delay that the model lacks:

    >>> import seaopt as so
    >>> from seaopt.bench import PAPER_STAND, Sensors, virtual_log
    >>> from seaopt.estimation import diagnose
    >>> plant, truth = so.plants.high_impedance(), so.plants.thor()
    >>> log = virtual_log(plant, truth, PAPER_STAND, duration_s=20, rate_hz=400, seed=1,
    ...                   sensors=Sensors(noise_std={"F1": 2.0}))
    >>> late = so.Log.from_arrays(time=log.time[:-2], I=log["I"][2:], F1=log["F1"][:-2])
    >>> fit = so.fit([so.Experiment(plant=plant, log=late, name="late")], truth.free("J", "b_r"))
    >>> cause = next(finding for finding in diagnose(fit).findings if finding.kind == "cause")
    >>> print(cause.text)
    likely cause: a delay of 5... ms; give delay_s, or free it ...
    >>> value, std = cause.preferred["late.delay_s"]
    >>> abs(value - 0.005) < 3 * std
    True
    """
    minimum = fit.require_minimum("diagnose")
    problem = minimum.problem
    if not fit.outputs:
        fit = judge(replace(fit, outputs=describe_outputs(problem, minimum.z, compute_statistics(problem, minimum.z))))
    residuals = minimum.residuals()
    free, ahead = simulate_freely(minimum, residuals), predict_one_step(minimum)

    def test(output: FitOutput) -> OutputDiagnostics:
        name = output.experiment.name
        residual = np.concatenate(residuals[name].weighted_of(output.name))
        return OutputDiagnostics(
            whiteness_p=fit.outputs[name][output.name].whiteness_p,
            autocorrelation=autocorrelation(residual, min(INPUT_LAGS, residual.size - 1)),
            autocorrelation_bound=QUANTILE / float(np.sqrt(max(np.count_nonzero(residual), 1))),
            inputs=_correlate_with_inputs(output, residuals),
            free_run=compute_percent(output, free),
            one_step=Percent(used=np.nan, held_out=None) if ahead is None else compute_percent(output, ahead),
        )

    outputs = problem.map_outputs(test)
    leverage, at_bound = measure_leverage(minimum), problem.unknowns.find_at_bound(minimum.z)
    sentences = [] if fit.status == "converged" else [f"the fit is {fit.status.replace('_', ' ')}: {fit.message}"]
    sentences += [f"{finding.where}: {finding.text}" if finding.where else finding.text for finding in fit.findings]
    sentences += [*_advise_on_outputs(fit, outputs, residuals), *_advise_on_leverage(leverage)]
    return Diagnostics(
        outputs=outputs,
        leverage=leverage,
        at_bound=at_bound,
        held=run_score_tests(minimum),
        aic=fit.aic,
        bic=fit.bic,
        findings=fit.findings,
        sentences=tuple(sentences),
        residuals=residuals,
    )


def _correlate_with_inputs(output: FitOutput, residuals: ResidualsByExperiment) -> dict[str, CrossCorrelation]:
    """Return the correlation of an output's residual with each input that moves."""
    segments = output.experiment.segments
    weighted = residuals[output.experiment.name].weighted_of(output.name)
    pairs = {
        name: cross_correlation(weighted, [segment.samples.inputs[i] for segment in segments])
        for i, name in enumerate(output.experiment.data.plant.inputs)
    }
    return {name: cross for name, cross in pairs.items() if cross is not None}


def _advise_on_outputs(
    fit: Fit, outputs: Mapping[str, Mapping[str, OutputDiagnostics]], residuals: ResidualsByExperiment
) -> list[str]:
    """Return what the residuals show besides the fit's findings."""
    problem, sentences = fit.require_minimum("diagnose").problem, list[str]()
    # What a cause or the inputs would explain is not noise, whatever a filter predicts of it.
    explained = any(finding.kind in ("cause", "explained") for finding in fit.findings)
    for output in problem.outputs:
        row = outputs[output.experiment.name][output.name]
        about_inputs = _advise_on_inputs(output, row, residuals, explained=explained)
        sentences += about_inputs or ([] if explained else _advise_on_colour(output, row, problem.predicts))
    return sentences


def _advise_on_inputs(
    output: FitOutput, row: OutputDiagnostics, residuals: ResidualsByExperiment, *, explained: bool
) -> list[str]:
    """Return which input the residual follows and what that means."""
    sentences: list[str] = []
    for name, cross in row.inputs.items():
        if cross.p >= SIGNIFICANCE:
            continue
        lag, size = cross.worst_lag, f"({cross.worst:.2g} times the 99 % bound)"
        if lag < 0 and output.experiment.data.feedback:
            continue  # as it does under any law
        if lag < 0:
            sentences.append(
                f"{output.label}: {name} follows the residual, most around lag {lag} {size}: feedback was on, or "
                f"{name} is stamped late: shift its channel, or log the current itself"
            )
            continue
        late = f" = {1e3 * lag * output.experiment.period:.3g} ms" if lag else ""
        residual = np.concatenate(residuals[output.experiment.name].weighted_of(output.name))
        power = np.cumsum(np.abs(np.fft.rfft(residual)) ** 2)
        frequency = float(np.searchsorted(power, 0.5 * power[-1]) / (residual.size * output.experiment.period))
        remaining = "what no cause above explains is a missing pole" if explained else "a missing pole"
        sentences.append(
            f"{output.label}: the residual follows {name}, most around lag {lag}{late} {size}, half of its power is "
            f"below {frequency:.3g} Hz: {remaining}; compare() it with a plant that has one more part"
        )
    return sentences


def _advise_on_colour(output: FitOutput, row: OutputDiagnostics, predicts: bool) -> list[str]:
    """Return that a residual is coloured, or predictable, though it follows no input."""
    free, ahead = row.free_run, row.one_step
    if row.whiteness_p >= SIGNIFICANCE or predicts:
        return []
    if np.isfinite(ahead.used) and 100.0 - ahead.used < 0.5 * (100.0 - free.used):
        return [
            f"{output.label}: one sample ahead it is right to {ahead.used:.1f} %, simulated to {free.used:.1f} %, and "
            "follows no input: something else moves the plant; fit with PredictionError()"
        ]
    if 1.0 - free.used / 100.0 > LARGE:
        return [
            f"{output.label}: the residual follows no input but is coloured (p = {row.whiteness_p:.1g}): friction, "
            "drift or disturbances; the std allows for it, PredictionError() would use it"
        ]
    return []


def _advise_on_leverage(leverage: Mapping[str, Leverage]) -> list[str]:
    """Return which experiment adds nothing, and which parameters are known from their priors alone."""
    useless = [
        f"{name} brings {format_percent(source.whole, 2)} of the information: it could be left out"
        for name, source in leverage.items()
        if name != PRIORS and len(leverage) > 1 and source.whole < LITTLE
    ]
    priors = leverage[PRIORS].parameters if PRIORS in leverage else {}
    return useless + [
        f"{100 * share:.0f} % of the information on {parameter} is its prior: the logs hardly correct it"
        for parameter, share in priors.items()
        if share > 1.0 - 10.0 * LITTLE
    ]
