"""The findings on a fit in plain sentences: what is wrong, and what to do about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.estimation.advice.forecasts import Percent, in_band, used_and_held_out
from seaopt.estimation.advice.score_test import CHANCE, Culprit
from seaopt.estimation.problem.correlation import LAGS, CrossCorrelation
from seaopt.estimation.problem.residual_statistics import Errors
from seaopt.estimation.problem.residuals import Residuals
from seaopt.estimation.problem.unknowns import collect
from seaopt.estimation.result.fit_result import Fit
from seaopt.estimation.solver.least_squares import minimise
from seaopt.estimation.uncertainty.leverage import PRIORS, Leverage
from seaopt.parameters import Parameter
from seaopt.records import record

LARGE = 0.05  # of an output's rms: a residual that is worth words for its colour alone
HALF = 0.5  # of a residual's power: a delay that leaves less is taken for its cause
WORSE = 1.5  # times the rms: a held-out residual that is worth words
LITTLE = 0.01  # share of what is known
REFIT = 25  # evaluations of a trial refit


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


def sentences(
    fit: Fit, outputs: dict[str, dict[str, OutputDiagnostics]], leverage: dict[str, Leverage],
    at_bound: tuple[str, ...], left: list[list[Errors]], free: list[list[Errors]], culprit: Culprit | None,
) -> tuple[str, ...]:  # fmt: skip
    """Return what is wrong and what to do about it; nothing where nothing is seen."""
    problem = fit.at_minimum("diagnose").problem
    told: list[str] = [] if fit.ok else [f"the fit is {fit.status.replace('_', ' ')}: {fit.message}"]
    told += [f"{name} lies on its bound: widen the bound, or fix it there and say why" for name in at_bound]
    trials = [
        _Later.of(fit, e) if any(_follows(item) for item in outputs[experiment.name].values()) else None
        for e, experiment in enumerate(problem.experiments)
    ]
    culprit = culprit if culprit is not None and _blamed(culprit, fit, outputs, trials) else None
    told += [] if culprit is None else [culprit.sentence]
    for e, experiment in enumerate(problem.experiments):
        for o, name in enumerate(experiment.outputs):
            item, label = outputs[experiment.name][name], f"{experiment.name}.{name}"
            found = _about_inputs(problem, e, o, item, label, left, trials[e], culprit)
            whitened = culprit is not None and bool(culprit.white[e][o])
            told += found or ([] if whitened else _about_colour(item, label, problem.observers is not None))
            told += _about_held_out(problem, e, o, item, label, free)
    return (*told, *_about_leverage(leverage))


def _follows(item: OutputDiagnostics) -> bool:
    return any(found.p < CHANCE and found.worst_lag >= 0 for found in item.inputs.values())


def _blamed(
    culprit: Culprit, fit: Fit, outputs: dict[str, dict[str, OutputDiagnostics]], trials: list[_Later | None]
) -> bool:
    """Tell whether a held parameter explains whatever goes with an input, and does so better than a delay.

    Where nothing does, it must leave white residuals: of what else moves the plant the test knows nothing.
    """
    related = False
    for e, (experiment, trial) in enumerate(zip(fit.experiments, trials, strict=True)):
        for o, name in enumerate(experiment.outputs):
            if all(found.p >= CHANCE for found in outputs[experiment.name][name].inputs.values()):
                continue
            related = True
            if trial is not None and trial.left[o] < min(HALF, float(culprit.left[e][o])):
                return False
            if not culprit.explains(e, o):
                return False
    return related or all(bool(np.all(row)) for row in culprit.white)


@record(eq=False)
class _Later:
    """What a free delay of one experiment's input would change: the delay, and each output's sum of squares."""

    delay_s: float
    left: Float[np.ndarray, " ny"]
    early: bool

    @staticmethod
    def of(fit: Fit, e: int) -> _Later | None:
        """Refit from the minimum with the delay free; None where it is free already."""
        minimum = fit.at_minimum("diagnose")
        problem, old = minimum.problem, minimum.problem.unknowns
        if old.locals_of[e].delay.index is not None:
            return None
        known = old.locals_of[e].delay.value
        span = LAGS * problem.experiments[e].log.period
        delay = Parameter(name="delay_s", value=known, unit="s", free=True, min=0.0, max=known + span)
        experiments = tuple(replace(x, delay_s=delay) if i == e else x for i, x in enumerate(problem.experiments))
        new = collect(experiments, fit.parameters, noise=problem.observers is not None)
        start, z = new.start.copy(), new.start.copy()
        for name, first, value in zip(old.names, old.start, minimum.z, strict=True):
            start[new.names.index(name)], z[new.names.index(name)] = first, value
        trial = replace(problem, experiments=experiments, unknowns=replace(new, start=start))
        before = trial.evaluate(z)
        after = minimise(trial.evaluate, before, new.low, new.high, max_iterations=REFIT)
        place = new.locals_of[e].delay
        return _Later(
            delay_s=place.at(after.z),
            left=after.evaluation.squares[e] / np.maximum(before.squares[e], 1e-300),
            early=place.at(after.z) <= known + 1e-3 * problem.experiments[e].log.period,
        )


def _about_inputs(
    problem: Residuals, e: int, o: int, item: OutputDiagnostics, label: str, left: list[list[Errors]],
    trial: _Later | None, culprit: Culprit | None,
) -> list[str]:  # fmt: skip
    """Say which input the residual follows and what that means."""
    told: list[str] = []
    period = problem.experiments[e].log.period
    for name, found in item.inputs.items():
        if found.p >= CHANCE:
            continue
        lag, size = found.worst_lag, f"({found.worst:.2g} times the 99 % bound)"
        if lag < 0:
            told.append(
                f"{label}: {name} follows the residual, most around lag {lag} {size}: feedback was on, or "
                f"{name} is stamped late: shift its channel, or log the current itself"
            )
            continue
        late = f" = {1e3 * lag * period:.3g} ms" if lag else ""
        told.append(
            f"{label}: the residual follows {name}, most around lag {lag}{late} {size}: "
            f"{_remedy(problem, e, o, left, trial, culprit)}"
        )
    return told


def _remedy(
    problem: Residuals, e: int, o: int, left: list[list[Errors]], trial: _Later | None, culprit: Culprit | None
) -> str:
    """Say whether a held parameter or a delay would explain the residual; a missing pole or resonance otherwise."""
    if culprit is not None:
        rest = (
            "nothing follows it" if culprit.clean[e][o] else f"{100.0 * culprit.left[e][o]:.2g} % of its power is left"
        )
        return f"with {culprit.first} {rest}"
    if trial is not None and trial.left[o] < HALF:
        gone = 100.0 * (1.0 - float(trial.left[o]))
        return f"with a delay of {1e3 * trial.delay_s:.3g} ms {gone:.0f} % of its power is gone; free delay_s"
    residual = np.concatenate([error.weighted[:, o] for error in left[e]])
    frequency = _centre_hz(residual, problem.experiments[e].log.period)
    what = "a missing pole, or an input that is stamped late" if trial is not None and trial.early else "a missing pole"
    return f"{what}; half of its power is below {frequency:.3g} Hz: compare() it with a plant that has one more part"


def _centre_hz(residual: Float[np.ndarray, " n"], period: float) -> float:
    """Return the frequency that halves the power of a residual."""
    power = np.cumsum(np.abs(np.fft.rfft(residual)) ** 2)
    return float(np.searchsorted(power, 0.5 * power[-1]) / (residual.size * period))


def _about_colour(item: OutputDiagnostics, label: str, predicts: bool) -> list[str]:
    """Say that a residual is coloured, or predictable, though it follows no input."""
    free, one = item.free_run, item.one_step
    if item.whiteness_p >= CHANCE or predicts:
        return []
    if np.isfinite(one.used) and 100.0 - one.used < 0.5 * (100.0 - free.used):
        return [
            f"{label}: one sample ahead it is right to {one.used:.1f} %, simulated to {free.used:.1f} %, and follows "
            "no input: something else moves the plant; fit with PredictionError()"
        ]
    if 1.0 - free.used / 100.0 > LARGE:
        return [
            f"{label}: the residual follows no input but is coloured (p = {item.whiteness_p:.1g}): friction, drift or "
            "disturbances; the std allows for it, PredictionError() would use it"
        ]
    return []


def _about_held_out(
    problem: Residuals, e: int, o: int, item: OutputDiagnostics, label: str, free: list[list[Errors]]
) -> list[str]:
    """Say that held-out samples leave a larger residual than those used."""
    if item.free_run.held_out is None:
        return []
    residual = in_band(problem, e, [error.raw[:, o] for error in free[e]])
    used, held = (float(np.sqrt(np.mean(residual[rows] ** 2))) for rows in used_and_held_out(problem, e, o))
    if held <= WORSE * used:
        return []
    unit = problem.experiments[e].plant.outputs[problem.experiments[e].outputs[o]]
    return [
        f"{label}: held out the residual's rms is {held:.3g} {unit}, over the samples used {used:.3g} {unit}: the "
        "plant changed, is excited elsewhere, or the fit follows what does not repeat; log longer, or fix parameters"
    ]


def _about_leverage(leverage: dict[str, Leverage]) -> list[str]:
    """Say which experiment tells nothing, and which parameters only their priors tell."""
    told: list[str] = []
    for name, item in leverage.items():
        if name != PRIORS and len(leverage) > 1 and item.whole < LITTLE:
            told.append(f"{name} brings {100 * item.whole:.2g} % of what is known: it could be left out")
        if name == PRIORS:
            told += [
                f"what is known of {parameter} is {100 * share:.0f} % prior: the logs hardly correct it"
                for parameter, share in item.parameters.items()
                if share > 1.0 - 10.0 * LITTLE
            ]
    return told
