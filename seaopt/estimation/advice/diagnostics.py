"""What is wrong with a fit, and what to do about it: tests of its residuals, of its predictions, and of its data.

The tests have modules of their own: `correlation` of residuals, `forecasts`, `leverage`, `held` for parameters that
were held fixed, and `advice` for what is said.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, field
from typing import Any

import numpy as np

from seaopt.estimation.advice.advice import OutputDiagnostics, sentences
from seaopt.estimation.advice.forecasts import Percent, fit_percent, free_run, one_step
from seaopt.estimation.advice.score_test import CHANCE, Held, culprit
from seaopt.estimation.problem.correlation import LAGS, QUANTILE, CrossCorrelation, autocorrelation, cross_correlation
from seaopt.estimation.problem.residual_statistics import Errors, leftover
from seaopt.estimation.problem.residuals import Residuals
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.estimation.uncertainty.leverage import Leverage, leverage
from seaopt.formatting import html_text
from seaopt.records import record
from seaopt.units import unit_after


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
    held : mapping of name to Held
        The test of each parameter that was held fixed, that which would lower the cost most first; without those that
        the free ones stand for, or that would make a linear plant nonlinear.
    aic, bic : float
        Of the fit.
    sentences : tuple of str
        What is wrong and what to do about it, the worst first; empty if nothing is seen.
    residuals : list of lists of Errors
        What was tested, of each experiment and segment.

    """

    outputs: Mapping[str, Mapping[str, OutputDiagnostics]]
    leverage: Mapping[str, Leverage]
    at_bound: tuple[str, ...]
    held: Mapping[str, Held]
    aic: float
    bic: float
    sentences: tuple[str, ...]
    residuals: list[list[Errors]] = field(default_factory=list[list[Errors]], repr=False)

    @property
    def ok(self) -> bool:
        """Whether nothing is seen to be wrong."""
        return not self.sentences

    def to_dict(self) -> dict[str, Any]:
        """Return the content as numbers, lists and text."""
        return {
            "outputs": {
                name: {output: _output_dict(item) for output, item in row.items()} for name, row in self.outputs.items()
            },
            "leverage": {
                name: {"parameters": dict(item.parameters), "whole": item.whole} for name, item in self.leverage.items()
            },
            "at_bound": list(self.at_bound), "held": {name: asdict(item) for name, item in self.held.items()},
            "aic": self.aic, "bic": self.bic, "sentences": list(self.sentences),
        }  # fmt: skip

    def __repr__(self) -> str:
        lines = ["Diagnostics: " + ("nothing is seen to be wrong" if self.ok else f"{len(self.sentences)} to look at")]
        lines += [f"  - {sentence}" for sentence in self.sentences]
        for name, row in self.outputs.items():
            for output, item in row.items():
                lines.append(f"  {name}.{output}: whiteness p {item.whiteness_p:.2g}; {_percents(item)}")
                lines += [
                    f"    against {u}: {found.worst:.2g} of the 99 % bound, at lag {found.worst_lag}"
                    for u, found in item.inputs.items()
                ]
        lines += [
            f"  {name} = {item.value:.6g}{unit_after(item.unit)} held fixed: chi-square {item.chi2:.3g}, one step with "
            f"it free goes to {item.preferred:.4g}"
            for name, item in self.held.items()
            if item.p < CHANCE
        ]
        for name, item in self.leverage.items():
            shares = ", ".join(f"{parameter} {100 * share:.3g} %" for parameter, share in item.parameters.items())
            lines.append(f"  {name} brings {100 * item.whole:.3g} % of what is known: {shares}")
        lines.append(f"  AIC {self.aic:.6g}, BIC {self.bic:.6g}")
        return "\n".join(lines)

    _repr_html_ = html_text


def _output_dict(item: OutputDiagnostics) -> dict[str, Any]:
    return {
        "whiteness_p": item.whiteness_p,
        "autocorrelation": item.autocorrelation,
        "autocorrelation_bound": item.autocorrelation_bound,
        "inputs": {
            name: {
                "lags": found.lags, "values": found.values, "bound": found.bound, "p": found.p,
                "worst_lag": found.worst_lag, "outside": found.outside,
            }
            for name, found in item.inputs.items()
        },
        "free_run": {"used": item.free_run.used, "held_out": item.free_run.held_out},
        "one_step": {"used": item.one_step.used, "held_out": item.one_step.held_out},
    }  # fmt: skip


def _percents(item: OutputDiagnostics) -> str:
    parts: list[str] = []
    for what, percent in (("simulated", item.free_run), ("one sample ahead", item.one_step)):
        held = "" if percent.held_out is None else f" (held out {percent.held_out:.2f} %)"
        parts.append(f"{what} {percent.used:.2f} %{held}")
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
    A delay that the fit does not know of:

    >>> import seaopt as so
    >>> from seaopt.bench import PAPER_STAND, Sensors, virtual_log
    >>> from seaopt.estimation import diagnose
    >>> plant, truth = so.plants.high_impedance(), so.plants.thor()
    >>> log = virtual_log(plant, truth, PAPER_STAND, duration_s=20, rate_hz=400, seed=1,
    ...                   sensors=Sensors(noise_std={"F1": 2.0}))
    >>> late = so.Log.from_arrays(time=log.time[:-2], I=log["I"][2:], F1=log["F1"][:-2])
    >>> found = so.fit([so.Experiment(plant=plant, log=late, name="late")], truth.free("J", "b_r"))
    >>> print(diagnose(found).sentences[0])
    late.F1: the residual follows I, ... with a delay of 5 ms 99 % of its power is gone; free delay_s

    """
    minimum = fit.at_minimum("diagnose")
    problem = minimum.problem
    left = minimum.errors()
    free, ahead = free_run(minimum, left), one_step(minimum)
    white = _whiteness(fit, minimum)
    outputs = {
        experiment.name: {
            name: _output(problem, e, o, left, free, ahead, white[experiment.name][name])
            for o, name in enumerate(experiment.outputs)
        }
        for e, experiment in enumerate(problem.experiments)
    }  # fmt: skip
    shares, at_bound = leverage(minimum), _at_bound(minimum)
    held, blamed = culprit(minimum, fit, left)
    return Diagnostics(
        outputs=outputs, leverage=shares, at_bound=at_bound, held=held, aic=fit.aic, bic=fit.bic,
        sentences=sentences(fit, outputs, shares, at_bound, left, free, blamed), residuals=left,
    )  # fmt: skip


def _whiteness(fit: Fit, minimum: Minimum) -> dict[str, dict[str, float]]:
    """Return each output's Ljung-Box p, which a fit without diagnostics does not have."""
    if fit.outputs:
        return {name: {output: item.whiteness_p for output, item in row.items()} for name, row in fit.outputs.items()}
    sums = [leftover(minimum.problem, e, minimum.z) for e in range(len(fit.experiments))]
    return {
        experiment.name: {name: one.whiteness(o) for o, name in enumerate(experiment.outputs)}
        for experiment, one in zip(fit.experiments, sums, strict=True)
    }


def _output(
    problem: Residuals, e: int, o: int, left: list[list[Errors]], free: list[list[Errors]],
    ahead: list[list[Errors]] | None, whiteness_p: float,
) -> OutputDiagnostics:  # fmt: skip
    residual = np.concatenate([error.weighted[:, o] for error in left[e]])
    count = int(np.count_nonzero(residual))
    inputs: dict[str, CrossCorrelation] = {}
    for i, name in enumerate(problem.experiments[e].plant.inputs):
        found = cross_correlation(
            [error.weighted[:, o] for error in left[e]], [piece.inputs[i] for piece in problem.segments[e]]
        )
        if found is not None:
            inputs[name] = found
    nothing = Percent(used=np.nan, held_out=None)
    return OutputDiagnostics(
        whiteness_p=whiteness_p,
        autocorrelation=autocorrelation(residual, min(LAGS, residual.size - 1)),
        autocorrelation_bound=QUANTILE / float(np.sqrt(max(count, 1))),
        inputs=inputs,
        free_run=fit_percent(problem, e, o, free),
        one_step=nothing if ahead is None else fit_percent(problem, e, o, ahead),
    )


def _at_bound(minimum: Minimum) -> tuple[str, ...]:
    unknowns, z = minimum.problem.unknowns, minimum.z
    width = 1e-9 * np.maximum(np.abs(z), 1e-300)
    touching = (z - unknowns.low <= width) | (unknowns.high - z <= width)
    return tuple(name for name, flag in zip(unknowns.names, touching, strict=True) if flag)
