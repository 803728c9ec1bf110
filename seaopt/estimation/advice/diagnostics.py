"""What is wrong with a fit, and what to do about it: tests of its residuals, of its predictions, and of its data.

The tests have modules of their own: `correlation` of residuals, `forecasts`, `leverage`, and `score_test` for
parameters that were fixed. What they found is put into plain sentences here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, field
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.estimation.advice.forecasts import (
    Percent,
    compute_percent,
    filter_to_band,
    predict_one_step,
    simulate_freely,
    split_samples,
)
from seaopt.estimation.judgement.causes import free_delay
from seaopt.estimation.judgement.score_test import SIGNIFICANCE, Culprit, ScoreTest, correlate_with_inputs, find_culprit
from seaopt.estimation.problem.correlation import INPUT_LAGS, QUANTILE, CrossCorrelation, autocorrelation
from seaopt.estimation.problem.fit_experiment import FitExperiment, FitOutput
from seaopt.estimation.problem.residual_statistics import (
    ExperimentResiduals,
    ResidualsByExperiment,
    compute_statistics,
)
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.estimation.solver.least_squares import minimise
from seaopt.estimation.uncertainty.leverage import PRIORS, Leverage, measure_leverage
from seaopt.formatting import html_text
from seaopt.records import record
from seaopt.simulation import depends_on_time
from seaopt.units import unit_after

LARGE = 0.05  # of an output's rms: a residual that is worth words for its colour alone
HALF = 0.5  # of a residual's power: a delay that leaves less is taken for its cause
WORSE_HELD_OUT = 1.5  # times the rms over the samples used: a held-out residual that is worth words
LITTLE = 0.01  # share of what is known
DELAY_REFIT_ITERATIONS = 25


@record(eq=False)
class OutputDiagnostics:
    """The residual of one output of one experiment.

    Parameters
    ----------
    whiteness_p : float
        Ljung-Box p-value of the weighted residual.
    autocorrelation : array, shape (lags + 1,)
        Of the weighted residual.
    autocorrelation_bound : float
        99 % bound at one lag, for a white residual.
    inputs : mapping of input to CrossCorrelation
        Inputs that move.
    free_run, one_step : Percent
        Fit of the simulation, and of the prediction one sample ahead; the latter is NaN where no filter is found.

    """

    whiteness_p: float
    autocorrelation: Float[np.ndarray, " lags1"]
    autocorrelation_bound: float
    inputs: Mapping[str, CrossCorrelation]
    free_run: Percent
    one_step: Percent


@record(eq=False, repr=False)
class Diagnostics:
    """What `diagnose` returns; ``print(diagnostics)`` is a report.

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
    sentences : tuple of str
        What is wrong and what to do about it, the worst first; empty if no problem was found.
    residuals : mapping of experiment to ExperimentResiduals
        What was tested.

    """

    outputs: Mapping[str, Mapping[str, OutputDiagnostics]]
    leverage: Mapping[str, Leverage]
    at_bound: tuple[str, ...]
    held: Mapping[str, ScoreTest]
    aic: float
    bic: float
    sentences: tuple[str, ...]
    residuals: ResidualsByExperiment = field(default_factory=dict[str, ExperimentResiduals], repr=False)

    @property
    def ok(self) -> bool:
        """Whether no problem was found."""
        return not self.sentences

    def to_dict(self) -> dict[str, Any]:
        """Return the content as numbers, lists and text."""
        return {
            "outputs": {
                name: {output: _output_dict(one) for output, one in row.items()} for name, row in self.outputs.items()
            },
            "leverage": {
                name: {"parameters": dict(source.parameters), "whole": source.whole}
                for name, source in self.leverage.items()
            },
            "at_bound": list(self.at_bound), "held": {name: asdict(test) for name, test in self.held.items()},
            "aic": self.aic, "bic": self.bic, "sentences": list(self.sentences),
        }  # fmt: skip

    def __repr__(self) -> str:
        lines = ["Diagnostics: " + ("no problem found" if self.ok else f"{len(self.sentences)} to look at")]
        lines += [f"  - {sentence}" for sentence in self.sentences]
        for name, row in self.outputs.items():
            for output, one in row.items():
                lines.append(f"  {name}.{output}: whiteness p {one.whiteness_p:.2g}; {_percents(one)}")
                lines += [
                    f"    against {u}: {cross.worst:.2g} of the 99 % bound, at lag {cross.worst_lag}"
                    for u, cross in one.inputs.items()
                ]
        lines += [
            f"  {name} = {test.value:.6g}{unit_after(test.unit)} held fixed: chi-square {test.chi2:.3g}, one step with "
            f"it free goes to {test.preferred:.4g}"
            for name, test in self.held.items()
            if test.p < SIGNIFICANCE
        ]
        for name, source in self.leverage.items():
            shares = ", ".join(f"{parameter} {100 * share:.3g} %" for parameter, share in source.parameters.items())
            lines.append(f"  {name} brings {100 * source.whole:.3g} % of what is known: {shares}")
        lines.append(f"  AIC {self.aic:.6g}, BIC {self.bic:.6g}")
        return "\n".join(lines)

    _repr_html_ = html_text


def _output_dict(one: OutputDiagnostics) -> dict[str, Any]:
    return {
        "whiteness_p": one.whiteness_p,
        "autocorrelation": one.autocorrelation,
        "autocorrelation_bound": one.autocorrelation_bound,
        "inputs": {
            name: {
                "lags": cross.lags, "values": cross.values, "bound": cross.bound, "p": cross.p,
                "worst_lag": cross.worst_lag, "outside": cross.outside,
            }
            for name, cross in one.inputs.items()
        },
        "free_run": {"used": one.free_run.used, "held_out": one.free_run.held_out},
        "one_step": {"used": one.one_step.used, "held_out": one.one_step.held_out},
    }  # fmt: skip


def _percents(one: OutputDiagnostics) -> str:
    parts: list[str] = []
    for what, percent in (("simulated", one.free_run), ("one sample ahead", one.one_step)):
        held_out = "" if percent.held_out is None else f" (held out {percent.held_out:.2f} %)"
        parts.append(f"{what} {percent.used:.2f} %{held_out}")
    return ", ".join(parts)


def diagnose(fit: Fit) -> Diagnostics:
    """Test a fit: residuals, predictions, bounds, and where its information comes from.

    Parameters
    ----------
    fit : Fit
        As `fit` returned it.

    Returns
    -------
    Diagnostics

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
    >>> print(diagnose(fit).sentences[0])
    late.F1: the residual follows I, ... with a delay of 5 ms 99 % of its power is gone; free delay_s

    """
    minimum = fit.require_minimum("diagnose")
    problem = minimum.problem
    residuals = minimum.residuals()
    free, ahead = simulate_freely(minimum, residuals), predict_one_step(minimum)
    white = _find_whiteness(fit, minimum)
    outputs: dict[str, dict[str, OutputDiagnostics]] = {experiment.name: {} for experiment in problem.experiments}
    for output in problem.outputs:
        whiteness_p = white[output.experiment.name][output.name]
        outputs[output.experiment.name][output.name] = _diagnose_output(output, residuals, free, ahead, whiteness_p)
    leverage, at_bound = measure_leverage(minimum), problem.unknowns.find_at_bound(minimum.z)
    tests, culprit = find_culprit(minimum, fit, residuals)
    sentences = [] if fit.status == "converged" else [f"the fit is {fit.status.replace('_', ' ')}: {fit.message}"]
    sentences += [f"{name} lies on its bound: widen the bound, or fix it there and say why" for name in at_bound]
    sentences += [*_advise_on_outputs(fit, outputs, residuals, free, culprit), *_advise_on_leverage(leverage)]
    return Diagnostics(
        outputs=outputs, leverage=leverage, at_bound=at_bound, held=tests, aic=fit.aic, bic=fit.bic,
        sentences=tuple(sentences), residuals=residuals,
    )  # fmt: skip


def _find_whiteness(fit: Fit, minimum: Minimum) -> dict[str, dict[str, float]]:
    """Return each output's Ljung-Box p, which a fit without diagnostics does not have."""
    if fit.outputs:
        return {name: {output: row.whiteness_p for output, row in rows.items()} for name, rows in fit.outputs.items()}
    statistics = compute_statistics(minimum.problem, minimum.z)
    return {name: {output: sums.whiteness(output) for output in sums.outputs} for name, sums in statistics.items()}


def _diagnose_output(
    output: FitOutput, residuals: ResidualsByExperiment, free: ResidualsByExperiment,
    ahead: ResidualsByExperiment | None, whiteness_p: float,
) -> OutputDiagnostics:  # fmt: skip
    residual = np.concatenate(residuals[output.experiment.name].weighted_of(output.name))
    count = int(np.count_nonzero(residual))
    return OutputDiagnostics(
        whiteness_p=whiteness_p,
        autocorrelation=autocorrelation(residual, min(INPUT_LAGS, residual.size - 1)),
        autocorrelation_bound=QUANTILE / float(np.sqrt(max(count, 1))),
        inputs=correlate_with_inputs(output, residuals),
        free_run=compute_percent(output, free),
        one_step=Percent(used=np.nan, held_out=None) if ahead is None else compute_percent(output, ahead),
    )


def _advise_on_outputs(
    fit: Fit, outputs: Mapping[str, Mapping[str, OutputDiagnostics]], residuals: ResidualsByExperiment,
    free: ResidualsByExperiment, culprit: Culprit | None,
) -> list[str]:  # fmt: skip
    """Return what is wrong with the residuals, and what to do about it; the parameter to blame first."""
    problem = fit.require_minimum("diagnose").problem
    trials = {
        experiment.name: _try_delay(fit, experiment)
        for experiment in problem.experiments
        if any(_follows_input(row) for row in outputs[experiment.name].values())
    }
    if culprit is not None and not _is_to_blame(culprit, problem.outputs, outputs, trials):
        culprit = None
    sentences = [] if culprit is None else [culprit.sentence]
    for output in problem.outputs:
        row, trial = outputs[output.experiment.name][output.name], trials.get(output.experiment.name)
        about_inputs = _advise_on_inputs(output, row, residuals, trial, culprit)
        whitened = culprit is not None and culprit.remainders[output.label].white
        # What the inputs would explain is not noise, whatever a filter predicts of it.
        lacking = [one for one in fit.findings if one.kind == "explained" and one.where == output.label]
        sentences += [f"{one.where}: {one.text}" for one in lacking]
        quiet = whitened or bool(lacking)
        sentences += about_inputs or ([] if quiet else _advise_on_colour(output, row, problem.predicts))
        sentences += _advise_on_held_out(output, row, free)
    return sentences


def _follows_input(row: OutputDiagnostics) -> bool:
    return any(cross.p < SIGNIFICANCE and cross.worst_lag >= 0 for cross in row.inputs.values())


@record(eq=False)
class _DelayTrial:
    """What a free delay of one experiment's input would change: the delay, and the power left of each output."""

    delay_s: float
    remaining: Mapping[str, float]
    early: bool


def _try_delay(fit: Fit, experiment: FitExperiment) -> _DelayTrial | None:
    """Refit from the minimum with the delay free; None where it is free already, or cannot be."""
    minimum = fit.require_minimum("diagnose")
    if experiment.slots.delay.index is not None or depends_on_time(experiment.model):
        return None
    known, name = experiment.slots.delay.value, experiment.name
    span = INPUT_LAGS * experiment.period
    trial, z = minimum.problem.rebuild(
        fit.parameters, minimum.z, {name: free_delay(experiment.data, known, known + span)}
    )
    before = trial.evaluate(z)
    after = minimise(
        trial, before, trial.unknowns.low, trial.unknowns.high, max_iterations=DELAY_REFIT_ITERATIONS
    )  # fmt: skip
    refitted = next(each.slots.delay.at(after.z) for each in trial.experiments if each.name == name)
    remaining = after.evaluation.power[name].squares / np.maximum(before.power[name].squares, 1e-300)
    return _DelayTrial(
        delay_s=refitted, remaining=dict(zip(experiment.data.outputs, remaining.tolist(), strict=True)),
        early=refitted <= known + 1e-3 * experiment.period,
    )  # fmt: skip


def _is_to_blame(
    culprit: Culprit, measured: tuple[FitOutput, ...], outputs: Mapping[str, Mapping[str, OutputDiagnostics]],
    trials: Mapping[str, _DelayTrial | None],
) -> bool:  # fmt: skip
    """Tell whether a fixed parameter explains whatever goes with an input, and does so better than a delay.

    Where nothing does, it must leave white residuals: of what else moves the plant the test knows nothing.
    """
    related = False
    for output in measured:
        row, trial = outputs[output.experiment.name][output.name], trials.get(output.experiment.name)
        if all(cross.p >= SIGNIFICANCE for cross in row.inputs.values()):
            continue
        related, remainder = True, culprit.remainders[output.label]
        if trial is not None and trial.remaining[output.name] < min(HALF, remainder.power):
            return False
        if not remainder.explained:
            return False
    return related or all(remainder.white for remainder in culprit.remainders.values())


def _advise_on_inputs(
    output: FitOutput, row: OutputDiagnostics, residuals: ResidualsByExperiment, trial: _DelayTrial | None,
    culprit: Culprit | None,
) -> list[str]:  # fmt: skip
    """Return which input the residual follows and what that means."""
    sentences: list[str] = []
    for name, cross in row.inputs.items():
        if cross.p >= SIGNIFICANCE:
            continue
        lag, size = cross.worst_lag, f"({cross.worst:.2g} times the 99 % bound)"
        if lag < 0:
            sentences.append(
                f"{output.label}: {name} follows the residual, most around lag {lag} {size}: feedback was on, or "
                f"{name} is stamped late: shift its channel, or log the current itself"
            )
            continue
        late = f" = {1e3 * lag * output.experiment.period:.3g} ms" if lag else ""
        sentences.append(
            f"{output.label}: the residual follows {name}, most around lag {lag}{late} {size}: "
            f"{_find_remedy(output, residuals, trial, culprit)}"
        )
    return sentences


def _find_remedy(
    output: FitOutput, residuals: ResidualsByExperiment, trial: _DelayTrial | None, culprit: Culprit | None
) -> str:
    """Return whether a fixed parameter or a delay would explain the residual; a missing pole or resonance otherwise."""
    if culprit is not None:
        remainder = culprit.remainders[output.label]
        rest = (
            "nothing follows it"
            if remainder.follows_no_input
            else f"{100.0 * remainder.power:.2g} % of its power is left"
        )
        return f"with {culprit.first} {rest}"
    if trial is not None and trial.remaining[output.name] < HALF:
        gone = 100.0 * (1.0 - trial.remaining[output.name])
        return f"with a delay of {1e3 * trial.delay_s:.3g} ms {gone:.0f} % of its power is gone; free delay_s"
    residual = np.concatenate(residuals[output.experiment.name].weighted_of(output.name))
    frequency = _find_centre_hz(residual, output.experiment.period)
    what = "a missing pole, or an input that is stamped late" if trial is not None and trial.early else "a missing pole"
    return f"{what}; half of its power is below {frequency:.3g} Hz: compare() it with a plant that has one more part"


def _find_centre_hz(residual: Float[np.ndarray, " n"], period: float) -> float:
    """Return the frequency that halves the power of a residual."""
    power = np.cumsum(np.abs(np.fft.rfft(residual)) ** 2)
    return float(np.searchsorted(power, 0.5 * power[-1]) / (residual.size * period))


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


def _advise_on_held_out(output: FitOutput, row: OutputDiagnostics, free: ResidualsByExperiment) -> list[str]:
    """Return that held-out samples leave a larger residual than those used."""
    if row.free_run.held_out is None:
        return []
    residual = filter_to_band(output.experiment, free[output.experiment.name].raw_of(output.name))
    used, held_out = (float(np.sqrt(np.mean(residual[rows] ** 2))) for rows in split_samples(output))
    if held_out <= WORSE_HELD_OUT * used:
        return []
    return [
        f"{output.label}: held out the residual's rms is {held_out:.3g} {output.unit}, over the samples used "
        f"{used:.3g} {output.unit}: the plant changed, is excited elsewhere, or the fit follows what does not repeat; "
        "log longer, or fix parameters"
    ]


def _advise_on_leverage(leverage: Mapping[str, Leverage]) -> list[str]:
    """Return which experiment adds nothing, and which parameters are known from their priors alone."""
    sentences: list[str] = []
    for name, source in leverage.items():
        if name != PRIORS and len(leverage) > 1 and source.whole < LITTLE:
            sentences.append(f"{name} brings {100 * source.whole:.2g} % of what is known: it could be left out")
        if name == PRIORS:
            sentences += [
                f"what is known of {parameter} is {100 * share:.0f} % prior: the logs hardly correct it"
                for parameter, share in source.parameters.items()
                if share > 1.0 - 10.0 * LITTLE
            ]
    return sentences
