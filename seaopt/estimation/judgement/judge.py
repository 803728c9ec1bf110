"""The judgement of a fit: findings of each of its outputs and parameters, and what is likely to be the cause.

Three looks are taken at every fit. What it explains is compared with what some model of the inputs could (see
`coherence`). Its residual is held against the noise floor: what the inputs account for in it, the model lacks. And
whatever was fixed, parameters and delays, is tested for being wrong (see `score_test`), for a wrong value may leave
hardly any residual and yet move the estimates far. Only where one of them finds something are other explanations
refitted (see `causes`), so that a good fit does not pay for them.

A cause is an error where it takes half of a residual away or moves an estimate beyond its interval: the parameters of
such a fit are not what it says.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from seaopt.estimation.judgement.candidates import free_delay
from seaopt.estimation.judgement.causes import Cause, find_causes
from seaopt.estimation.judgement.coherence import CoherentShare, measure_coherence
from seaopt.estimation.judgement.score_test import ScoreTest, find_candidates, run_score_tests
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.residual_statistics import ResidualsByExperiment
from seaopt.estimation.result.findings import FitFinding, OutputFit, order_findings
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.parameters import Parameter
from seaopt.plants import Plant
from seaopt.progress import Progress, divide, ignore
from seaopt.simulation import depends_on_time
from seaopt.units import unit_after

TESTS, CAUSES = 1.0, 3.0  # of the time of a judgement that tries causes
HALF, MOST = 0.5, 0.8  # of what could be explained: an error below the one, a warning below the other
WORSE = -1.0  # fit percent below which a constant explains more, beyond rounding and an offset that is fixed
RUNS_AWAY = -1e3  # fit percent below which a free run is ten times as large as what was measured
LITTLE = 0.02  # of an output's energy: where no model explains more, explaining less is no fault
CHANCE = 1e-6  # probability below which a test is not chance
DOUBTFUL = 1e-3  # probability of a score below which a refit decides: far from the truth a score falls short of that
SYSTEMATIC = 0.5  # of a residual's power: more than its noise
LARGE = 3e-3  # of an output's energy: a systematic residual of 5 % of its size
VISIBLE = 1e-4  # of one of 1 %
SMALL = 1e-5  # below which a systematic residual is worth no word
FAR_ABOVE = 5.0  # times the noise between neighbouring samples, from third differences (variance 20 times the noise's)
HELD_OUT = 0.9  # of the share explained over the samples used
WORSE_HELD_OUT = 2.0  # times the rms over the samples used
APART_STDS, APART = 4.0, 0.1  # standard deviations and periods by which delays of one plant may differ
PUSH = 4.0  # standard deviations that a bound holds an estimate away from where the logs want it
NOISELESS = 1e-6  # of the spread: 20 bits, and less than rounding to single precision makes of a log
FEWEST_SAMPLES, SAMPLES_PER_UNKNOWN = 100, 15
RIVAL_SHARE = 0.9  # of what the best cause gains: no reason to prefer one
FAR = 3.0  # times beyond a plausible range


def judge(fit: Fit, alternatives: Sequence[Plant] = (), progress: Progress = ignore) -> Fit:
    """Return the fit with what its outputs explain, and what is wrong with it.

    `fit`: with its minimum; `alternatives`: other plants that may have been on the bench, tried where this one does
    not explain the logs.
    """
    minimum = fit.require_minimum("judge")
    testing, trying = divide(progress, TESTS, CAUSES)
    testing("fitted; testing the residuals", 0.0)
    residuals = minimum.residuals()
    shares = {
        experiment.name: measure_coherence(experiment, residuals[experiment.name])
        for experiment in minimum.problem.experiments
    }
    outputs = _score_held_out_shots(fit, _state_shares(fit, shares))
    fit = replace(fit, outputs=outputs)
    excess = _measure_excess(minimum.problem, residuals)
    findings = [*_find_unexplained(fit, shares, excess), *_find_held_out(outputs), *_find_at_bound(fit, minimum)]
    findings += [
        *_find_implausible(fit),
        *_find_contradicting_delays(fit),
        *_find_few_samples(fit, minimum),
        *_find_noiseless(fit, minimum),
    ]
    tests = _run_tests(fit, minimum)
    suspects = {name: test for name, test in tests.items() if test.p < DOUBTFUL}
    wrong = (
        bool(suspects)
        or any(ratio > FAR_ABOVE for row in excess.values() for ratio in row.values())  # noise of a colour is so, too
        or any(finding.severity != "note" for finding in findings)
        or fit.status != "converged"
    )
    if wrong:
        poor = any(finding.kind == "explained" for finding in findings) or fit.status == "not_identifiable"
        causes = find_causes(fit, residuals, suspects, alternatives, poor=poor, progress=trying)
        findings += _name_causes(fit, causes, suspects)
    return _conclude(fit, findings)


def _measure_excess(problem: FitProblem, residuals: ResidualsByExperiment) -> dict[str, dict[str, float]]:
    """Return how many times its noise between neighbouring samples each output's residual is."""
    excess: dict[str, dict[str, float]] = {}
    for output in problem.outputs:
        raw = [part[np.isfinite(part)] for part in residuals[output.experiment.name].raw_of(output.name)]
        thirds = np.concatenate([np.diff(part, 3) for part in raw])
        noise = float(np.sqrt(np.mean(thirds**2) / 20.0)) if thirds.size else 0.0
        size = float(np.std(np.concatenate(raw))) if thirds.size else 0.0
        excess.setdefault(output.experiment.name, {})[output.name] = size / max(noise, 1e-300)
    return excess


def _conclude(fit: Fit, findings: Sequence[FitFinding]) -> Fit:
    """Return the fit with its findings, errors first; one that explains too little did not converge."""
    ordered = order_findings(findings)
    unexplained = [finding for finding in ordered if finding.kind == "explained" and finding.severity == "error"]
    if fit.status == "converged" and unexplained:
        message = f"{unexplained[0].where}: {unexplained[0].text} ({fit.message})"
        return replace(fit, status="stalled", message=message, findings=ordered)
    return replace(fit, findings=ordered)


def _state_shares(fit: Fit, shares: Mapping[str, Mapping[str, CoherentShare]]) -> dict[str, dict[str, OutputFit]]:
    """Return the outputs with what is explained of them and what could be: at least what is."""
    stated: dict[str, dict[str, OutputFit]] = {}
    for name, row in fit.outputs.items():
        stated[name] = {}
        for output, fitted in row.items():
            explained = _explained(fitted)
            share = shares[name].get(output)
            explainable = None if share is None or explained is None else _explainable(share, explained)
            stated[name][output] = replace(fitted, explained=explained, explainable=explainable)
    return stated


def _explainable(share: CoherentShare, explained: float) -> float:
    """Return the share that the inputs account for, what they account for of the residual included."""
    follows = share.residual if share.p < CHANCE else 0.0
    return max(share.output, explained + (1.0 - explained) * max(follows, 0.0))


def _score_held_out_shots(fit: Fit, outputs: dict[str, dict[str, OutputFit]]) -> dict[str, dict[str, OutputFit]]:
    """Return the outputs with a score of what was held out of logs cut into shots, which start from unknown states."""
    holdout = fit.require_minimum("judge").problem.holdout
    for experiment in fit.experiments if holdout else ():
        rows, log = outputs.get(experiment.name, {}), experiment.log
        if experiment.shots == 1 or all(row.holdout_fit_percent is not None for row in rows.values()):
            continue
        tail = log.between((1.0 - holdout) * log.duration_s, log.duration_s)
        shots = max(1, round(experiment.shots * holdout))
        score = fit.predict(replace(experiment, log=tail, shots=shots, outputs=experiment.outputs)).fit_percent
        outputs[experiment.name] = {name: replace(row, holdout_fit_percent=score[name]) for name, row in rows.items()}
    return outputs


def _explained(output: OutputFit) -> float | None:
    """Return the share of an output's energy that its free run explains; None where that runs away, as a plant may."""
    percents = (output.band_fit_percent, output.fit_percent)
    if output.fit_percent < RUNS_AWAY:
        return None
    percent = next((value for value in percents if value is not None and math.isfinite(value)), 0.0)
    return max(1.0 - (1.0 - percent / 100.0) ** 2, 0.0)


def _find_unexplained(
    fit: Fit, shares: Mapping[str, Mapping[str, CoherentShare]], excess: Mapping[str, Mapping[str, float]]
) -> Iterator[FitFinding]:
    """Yield outputs that are explained less than they could be, and residuals that follow an input.

    What follows the inputs is an error where it is more than noise: more than the rest of the residual, or far above
    what neighbouring samples differ by; the rest may be what a nonlinearity leaves.
    """
    for name, row in fit.outputs.items():
        for output, fitted in row.items():
            where = f"{name}.{output}"
            share = shares[name].get(output)
            percents = [
                fitted.fit_percent,
                *(p for p in (fitted.band_fit_percent, fitted.one_step_fit_percent) if p is not None),
            ]
            if fitted.explained is not None and max(percents) < WORSE:
                text = "the model explains it worse than a constant: look for jumps, such as a counter that wraps"
                yield FitFinding(severity="error", kind="explained", where=where, text=text)
                continue
            if fitted.explained is None or fitted.explainable is None or share is None:
                continue
            ratio = fitted.explained / max(fitted.explainable, 1e-300)
            if ratio < MOST and fitted.explainable > LITTLE:
                text = (
                    f"the model explains {100 * fitted.explained:.3g} % of its energy, and the inputs account for "
                    f"{100 * fitted.explainable:.3g} %"
                )
                yield FitFinding(
                    severity="error" if ratio < HALF else "warning", kind="explained", where=where, text=text
                )
            elif share.p < CHANCE and share.residual > 0.0 and share.power > SMALL:
                band = " to ".join(dict.fromkeys(f"{end:.3g}" for end in share.band_hz))
                follows = np.sqrt(share.residual) * excess[name][output]
                bad = (share.residual > SYSTEMATIC and share.power > LARGE) or (
                    follows > FAR_ABOVE and share.power > VISIBLE
                )
                text = (
                    f"{100 * share.residual:.2g} % of the residual's power follows the inputs, most of all at "
                    f"{band} Hz: the model lacks something, and the stds allow for noise alone"
                )
                yield FitFinding(severity="error" if bad else "warning", kind="residual", where=where, text=text)


def _find_held_out(outputs: Mapping[str, Mapping[str, OutputFit]]) -> Iterator[FitFinding]:
    """Yield outputs that are explained far less where they were held out."""
    for name, row in outputs.items():
        for output, fitted in row.items():
            if fitted.holdout_fit_percent is None or not math.isfinite(fitted.holdout_fit_percent):
                continue
            held_out = max(1.0 - (1.0 - fitted.holdout_fit_percent / 100.0) ** 2, 0.0)
            used = max(1.0 - (1.0 - fitted.fit_percent / 100.0) ** 2, 0.0)
            worse = (1.0 - held_out) / max(1.0 - used, 1e-300)
            if worse < WORSE_HELD_OUT**2 or held_out > 0.99 * used:
                continue
            yield FitFinding(
                severity="error" if held_out < HELD_OUT * used else "warning",
                kind="held_out",
                where=f"{name}.{output}",
                text=f"{100 * used:.4g} % is explained of the samples used and {100 * held_out:.4g} % of those held "
                "out: the plant changed, is excited elsewhere, or the fit follows what does not repeat; log longer, or "
                "fix parameters",
            )


def _find_at_bound(fit: Fit, minimum: Minimum) -> Iterator[FitFinding]:
    """Yield unknowns at a bound: errors where the logs want them far beyond it."""
    unknowns, z = minimum.problem.unknowns, minimum.z
    touching = unknowns.find_at_bound(z)
    if not touching:
        return
    evaluation = minimum.problem.evaluate(z)
    for name in touching:
        i = unknowns.names.index(name)
        curvature = float(evaluation.hessian[i, i])
        inward = 1.0 if z[i] - unknowns.low[i] <= unknowns.high[i] - z[i] else -1.0
        push = inward * float(evaluation.gradient[i]) / math.sqrt(max(curvature, 1e-300))
        parameter = fit.parameters.get(name)
        away = parameter is not None and not parameter.at_bound
        bad = push > PUSH or away
        if away:
            remedy = "which is as far as a fit searches: the logs do not hold it; fix it, or give it a bound or a prior"
        elif bad:
            remedy = "the logs want it beyond: widen the bound, or look for what the model lacks"
        else:
            remedy = "widen the bound, or fix it there and say why"
        yield FitFinding(
            severity="error" if bad else "note",
            kind="bound",
            where=name,
            text=f"{z[i]:.4g} lies on its bound{',' if away else ';'} {remedy}",
        )


def _find_implausible(fit: Fit) -> Iterator[FitFinding]:
    """Yield free parameters of built-in plants that lie outside what such actuators have."""
    plants = {experiment.plant.name: experiment.plant for experiment in fit.experiments}.values()
    for name in fit.covariance.names:
        declared = next((plant.parameters[name] for plant in plants if name in plant.parameters), None)
        if not isinstance(declared, Parameter) or declared.plausible is None:
            continue
        (low, high), parameter = declared.plausible, fit.parameters[name]
        value = parameter.value
        if low <= value <= high or not parameter.identified:
            continue
        far = value > FAR * high or value * FAR < low
        yield FitFinding(
            severity="error" if far else "warning",
            kind="range",
            where=name,
            text=f"{name} = {value:.4g}{unit_after(parameter.unit)}; actuators of this kind have {low:g} to {high:g}: "
            "check the units of inputs and outputs, such as mA read as A, and the fixed parameters",
        )


def _find_contradicting_delays(fit: Fit) -> Iterator[FitFinding]:
    """Yield fitted delays that differ from the one that is known best among the logs of the same plant."""
    for plant in dict.fromkeys(experiment.plant.name for experiment in fit.experiments):
        fitted = {
            e.name: fit.nuisance[e.name]
            for e in fit.experiments
            if e.plant.name == plant and "delay_s" in fit.nuisance[e.name].std
        }
        if not fitted:
            continue
        best = min(fitted, key=lambda name: fitted[name].std["delay_s"])
        value, std = fitted[best].delay_s, fitted[best].std["delay_s"]
        for experiment in fit.experiments:
            estimated = fitted.get(experiment.name)
            if estimated is None or estimated is fitted[best]:
                continue
            apart, own_std = abs(estimated.delay_s - value), estimated.std["delay_s"]
            if apart > max(APART_STDS * math.hypot(own_std, std), APART * experiment.log.period):
                yield FitFinding(
                    severity="warning",
                    kind="delay",
                    where=f"{experiment.name}.delay_s",
                    text=f"a delay of {1e3 * estimated.delay_s:.4g} ± {1e3 * own_std:.2g} ms contradicts that of "
                    f"{best}, {1e3 * value:.4g} ± {1e3 * std:.2g} ms: a delay makes up for what the model lacks in one "
                    "of them, or they were recorded apart; look at both, or give delay_s",
                )


def _find_few_samples(fit: Fit, minimum: Minimum) -> Iterator[FitFinding]:
    """Yield that there are too few samples for the unknowns, so that neither values nor intervals can be trusted."""
    counts = [
        int(max(np.sum([segment.count_weighted() for segment in experiment.segments], axis=0)))
        for experiment in minimum.problem.experiments
    ]
    samples, unknowns = sum(counts), minimum.z.size
    longest = max(counts, default=0)
    if longest < FEWEST_SAMPLES or samples < SAMPLES_PER_UNKNOWN * unknowns:
        yield FitFinding(
            severity="error",
            kind="samples",
            where="",
            text=f"{samples} samples are too few for {unknowns} unknowns: nothing tests the model; log longer",
        )


def _find_noiseless(fit: Fit, minimum: Minimum) -> Iterator[FitFinding]:
    """Yield outputs whose noise was estimated and is less than any sensor's: stds that follow from it say nothing."""
    for output in minimum.problem.outputs:
        experiment, name = output.experiment, output.name
        spread = float(experiment.spread[experiment.data.outputs.index(name)])
        fitted = fit.outputs[experiment.name][name]
        if name not in experiment.data.sigma and 0.0 <= fitted.rms_residual < NOISELESS * spread:
            yield FitFinding(
                severity="note",
                kind="noise",
                where=f"{experiment.name}.{name}",
                text=f"its residual of {fitted.rms_residual:.2g}{unit_after(fitted.unit)} is rounding, less than the "
                "noise of any sensor, as of simulated data: the stds say nothing; give the noise that it "
                "would have: sigma = ...",
            )


def _run_tests(fit: Fit, minimum: Minimum) -> dict[str, ScoreTest]:
    """Test fixed parameters and delays; where residuals are coloured, those that make linear plants nonlinear too."""
    problem = minimum.problem
    if fit.status == "not_identifiable":
        return {}
    plain, bending = find_candidates(problem, fit)
    delays = {
        e.name: free_delay(e.data, e.slots.delay.value)
        for e in problem.experiments
        if e.slots.delay.index is None and not depends_on_time(e.model)
    }
    tests = run_score_tests(minimum, fit, plain, delays)
    white = all(output.whiteness_p > CHANCE for row in fit.outputs.values() for output in row.values())
    for name in () if white else bending:
        tests |= run_score_tests(minimum, fit, (name,))
    return tests


def _name_causes(fit: Fit, causes: Sequence[Cause], suspects: Mapping[str, ScoreTest]) -> Iterator[FitFinding]:
    """Yield the explanation that is the most likely, and others that explain as much."""
    if not causes:
        for name in [name for name, test in suspects.items() if test.p < CHANCE][:1]:
            yield FitFinding(
                severity="warning",
                kind="fixed",
                where=name,
                text=f"{name} = {suspects[name].value:.4g} is fixed, and the logs are against it (chi-square "
                f"{suspects[name].chi2:.3g} on one degree of freedom), but no other value alone explains them",
            )
        return
    best = causes[0]
    rivals = [cause for cause in causes if cause.gain > RIVAL_SHARE * best.gain][:3]
    if len(rivals) == 1:
        text = f"likely cause: {best.text}{best.consequence}"
    else:
        each = "; or ".join(f"{cause.text}{cause.consequence}" for cause in rivals)
        text = f"{len(rivals)} likely causes explain as much, and the logs do not tell which: {each}"
    yield FitFinding(
        severity="error" if any(cause.material for cause in rivals) else "warning",
        kind="cause",
        where=", ".join(dict.fromkeys(cause.where for cause in rivals)),
        text=text,
        preferred={name: value for cause in rivals for name, value in cause.preferred.items()},
    )
