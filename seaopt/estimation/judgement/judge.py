"""The judgement of a fit: what is wrong with its outputs and parameters, and the likely causes.

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
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from seaopt.estimation.judgement.another_start import find_other_minimum
from seaopt.estimation.judgement.causes import Explanation, find_causes
from seaopt.estimation.judgement.coherence import CoherentShare, measure_coherence
from seaopt.estimation.judgement.command_rate import find_unlogged_command
from seaopt.estimation.judgement.hypothesis_ranking import ASKS, REMOVED, TriedHypotheses
from seaopt.estimation.judgement.hypothesis_search import search_hypotheses
from seaopt.estimation.judgement.intervals import (
    find_excesses,
    find_rough,
    find_rounding,
    find_single_event,
    find_step_error,
    find_wrong_starts,
    free_starts,
    leaves_something,
)
from seaopt.estimation.judgement.score_test import Freed, ScoreTest, free_fixed, run_score_tests
from seaopt.estimation.judgement.second_log import FAR, compare_logs, has_two_amplitudes
from seaopt.estimation.judgement.silence import find_silent
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_problem import BudgetError, limit_evaluations
from seaopt.estimation.problem.noise_floor import NoiseFloor, measure_floors
from seaopt.estimation.problem.normal_equations import invert
from seaopt.estimation.problem.residual_statistics import ResidualsByExperiment
from seaopt.estimation.result.findings import (
    FitFinding,
    OutputFit,
    find_ended_search,
    find_energy,
    find_unsearched,
    order_findings,
)
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.estimation.result.model_error import ModelError, estimate_model_error
from seaopt.estimation.result.summary import summarise
from seaopt.estimation.result.trials import HypothesisTrial
from seaopt.estimation.result.widening import widen
from seaopt.estimation.solver.budget import EVALUATIONS, EvaluationBudget
from seaopt.estimation.solver.least_squares import find_blocked
from seaopt.formatting import format_percent, join_words
from seaopt.parameters import Parameter
from seaopt.plants import Plant
from seaopt.progress import Progress, divide, ignore
from seaopt.units import unit_after

OF_HYPOTHESES, OF_CAUSES = 3, 2  # times those, that refits of hypotheses and of other causes may take
# Times the search, that a judgement may take: another start, and the search for causes.
TESTS, CAUSES = 1.0, float(OF_HYPOTHESES + OF_CAUSES)
HALF, MOST = 0.5, 0.8  # of what could be explained: an error below the one, a warning below the other
WORSE = -1.0  # fit percent below which a constant explains more, beyond rounding and an offset that is fixed
ALIKE = 0.95  # of an output's energy, that a multiple of the model explains where only sign or unit are wrong
TURNED = 0.1  # by which the factor may differ from 1 or -1
RUNS_AWAY = -1e3  # fit percent below which a free run is ten times as large as what was measured
LITTLE = 0.02  # of an output's energy: where no model explains more, explaining less is no fault
CHANCE = 1e-6  # probability below which a test is not chance
DOUBTFUL = 1e-3  # probability of a score below which a refit decides: far from the truth a score falls short of that
# What follows the inputs in a residual is an error where it is so many times its sensor's noise (`noise_floor`), and
# takes more than such a share of the output's energy: 5 % and 1 % of its size.
SYSTEMATIC = ((1.0, 3e-3), (5.0, 1e-4))
SMALL = 1e-5  # below which a systematic residual is worth no word
HELD_OUT = 0.9  # of the share explained over the samples used
WORSE_HELD_OUT = 2.0  # times the rms over the samples used
NOISE_HELD_OUT = 1.2  # times the sensor's noise, up to which what is left of samples held out is that
APART_STDS, APART = 4.0, 0.1  # standard deviations and periods by which delays of one plant may differ
HARDLY = 0.02  # half of an interval over its value, from which what is told apart weakly may be far off
TICK = 0.1  # of a sample, by which a delay may be beyond its bound
PUSH = 4.0  # standard deviations that a bound holds an estimate away from where the logs want it
NOISELESS = 1e-6  # of the spread: 20 bits, and less than rounding to single precision makes of a log
FEWEST_SAMPLES, SAMPLES_PER_UNKNOWN = 100, 15
RIVAL_SHARE = 0.9  # of what the best cause gains: no reason to prefer one
BEYOND = 3.0  # times beyond a plausible range


def judge(
    fit: Fit,
    alternatives: Sequence[Plant] = (),
    progress: Progress = ignore,
    validation: Sequence[Experiment] = (),
    *,
    causes: bool = True,
    evaluations: int = EVALUATIONS,
    freed: Freed | None = None,
) -> Fit:
    """Return the fit with how much of its outputs is explained, and what is wrong with it.

    `fit`: with its minimum; `alternatives`: other plants that may have been on the bench, tried where this one does
    not explain the logs; `validation`: logs that were not fitted, whose own values are compared with the fit's;
    `causes`: whether to look for what the model lacks; `evaluations`: what the fit took, of which the search for causes
    may take five times as many, and five times `EVALUATIONS` where it took fewer (see `budget`), and another start once
    as many; `freed`: the minimum's problem with what was fixed free, where that is at hand.
    """
    minimum = fit.require_minimum("judge")
    evaluations = max(evaluations, EVALUATIONS)
    testing, trying = divide(progress, TESTS, CAUSES)
    testing("fitted; testing the residuals", 0.0)
    residuals = minimum.residuals()
    shares = {
        f"{experiment.name}.{output}": share
        for experiment in minimum.problem.experiments
        for output, share in measure_coherence(experiment, residuals[experiment.name]).items()
    }
    fit = _score_held_out_shots(_state_shares(fit, shares), minimum.problem.holdout)
    noise = fit.covariance if fit.delay_covariance is None else fit.delay_covariance
    floors = measure_floors(minimum.problem, residuals, minimum.z)
    error = estimate_model_error(minimum.problem, minimum.z, residuals, floors, noise.matrix)
    fit = compare_logs(widen(_state_excess(fit, error.excess), error.matrix), validation)
    fit = replace(fit, silent=find_silent(fit, freed))
    with limit_evaluations(TESTS * evaluations):
        command = find_unlogged_command(fit, residuals, floors, error.excess)
    standing = None if command is None else command.standing
    if command is not None and command.values is not None:
        fit = _widen_to(fit, command.values)
    testing(f"trying another start, at most {evaluations} evaluations", 0.5)
    with limit_evaluations(TESTS * evaluations):
        another = [] if standing == "certain" else list(find_other_minimum(fit))
    findings = [
        *_find_unexplained(fit, shares, error.excess),
        *_find_held_out(fit, minimum.problem.holdout),
        *_find_at_bound(fit, minimum),
        *_find_implausible(fit),
        *_find_contradicting_delays(fit),
        *_find_few_samples(minimum),
        *_find_noiseless(fit, minimum),
        *find_excesses(fit),
        *find_rough(fit, error),
        *find_rounding(fit, error),
        *find_wrong_starts(fit),
        *find_single_event((*fit.experiments, *(each for each in validation if _tells(fit, each))), minimum),
        *another,
    ]
    commanded = () if command is None else command.findings
    tests = {} if standing == "certain" else _run_tests(fit, minimum, freed)
    suspects = {name: test for name, test in tests.items() if test.p < DOUBTFUL}
    if standing == "certain" or not causes:
        found = [*findings, *commanded, *find_step_error(fit)]
        if not causes:
            asks = suspects or leaves_something(fit, findings, error, ASKS) or _hangs_on_little(fit, findings)
            found.append(find_unsearched(asked=bool(asks)))
        return _conclude(replace(fit, findings=order_findings(found)))
    if standing == "likely":
        evaluations = EVALUATIONS  # what brings a random force is hardly among the causes
    budget = EvaluationBudget.begin((OF_HYPOTHESES + OF_CAUSES) * evaluations, minimum.problem.count_work(minimum.z))
    with budget.enforce():
        fit, findings, search = _search_causes(
            fit, findings, residuals, floors, error, suspects, alternatives, budget, evaluations, trying
        )
    if standing == "possible":
        findings += commanded
    elif standing == "likely" and not any(refit.excess <= REMOVED for refit in search.able):
        findings = [*(each for each in findings if each.kind != "cause"), *commanded]
        search = search.yield_to_another()
    findings += find_step_error(fit)  # at last, for no cause explains it
    return _conclude(replace(fit, findings=order_findings(findings), hypotheses=search.trials))


def _search_causes(
    fit: Fit,
    findings: list[FitFinding],
    residuals: ResidualsByExperiment,
    floors: Mapping[str, NoiseFloor],
    error: ModelError,
    suspects: Mapping[str, ScoreTest],
    alternatives: Sequence[Plant],
    budget: EvaluationBudget,
    evaluations: int,
    progress: Progress,
) -> tuple[Fit, list[FitFinding], TriedHypotheses]:
    """Return the fit with intervals that reach to what explains it as well, its findings with the causes that are
    named, and what became of each hypothesis. `findings`: those yet; `evaluations`: those of a share of the budget.
    """
    wrong = {finding.where for finding in findings if finding.kind == "initial" and finding.severity == "error"}
    if wrong:
        found, trials = _judge_with_free_starts(fit, wrong, alternatives, budget, progress)
        return fit, [*findings, *found], TriedHypotheses(trials=trials)
    noticed = leaves_something(fit, findings, error, FAR)  # noise of a colour is so, too
    little = any(finding.kind == "explained" for finding in findings)
    doubtful = _hangs_on_little(fit, findings)
    looking = budget.part(OF_HYPOTHESES * evaluations)
    search = TriedHypotheses()
    if not little:
        # What settles them may take more than their share, and leaves the other causes one.
        with budget.enforce(leaving=evaluations):
            refitting = divide(progress, OF_HYPOTHESES, OF_CAUSES)[0]
            search = search_hypotheses(fit, residuals, floors, looking, refitting, doubtful=doubtful)
    ended = search.ended
    if search.partial is not None:
        fit, findings = _reach(fit, findings, error, search.partial)
    if noticed or suspects or search.able:
        trying = budget.part(OF_CAUSES * evaluations + max(looking.left, 0.0))
        causes = find_causes(
            fit,
            residuals,
            suspects,
            alternatives,
            poor=little or fit.status == "not_identifiable",
            noticed=noticed,
            hypotheses=search.able,
            budget=trying,
            progress=divide(progress, looking.spent, trying.evaluations)[1],
        )
        ended = ended or trying.left <= 0.0
        named = list(_name_causes(fit, causes, suspects, ended=ended))
        told = all(has_two_amplitudes(fit.logs, e.plant.name) for e in fit.experiments)
        rivals = _list_rivals(causes)
        material = any(cause.material for cause in rivals)
        if rivals and (not material or (told and all(cause.refit for cause in rivals))):
            # Causes tell how far the values are off, hypotheses of a high excess those of logs of both amplitudes: the
            # interval has all of them.
            others = [cause.problem.unknowns.by_name(cause.z) for cause in rivals]
            fit, findings = _reach(fit, findings, error, *others)
            named = [replace(each, severity="warning") if each.kind == "cause" else each for each in named]
        findings += named
        search = search if not causes or causes[0].refit is not None else search.yield_to_another()
    return fit, [*findings, *([find_ended_search(budget.evaluations)] if ended else [])], search


def _judge_with_free_starts(
    fit: Fit, names: Collection[str], alternatives: Sequence[Plant], budget: EvaluationBudget, progress: Progress
) -> tuple[list[FitFinding], tuple[HypothesisTrial, ...]]:
    """Return the causes that are named with the states free in which experiments of these names begin, for what is left
    of a transient looks like much else, and the hypotheses that are tried then.
    """
    minimum = fit.require_minimum("_judge_with_free_starts")
    freed, at, _ = free_starts(minimum, names)
    try:
        solved = minimum.method.go_on(freed, at, None)
        if solved is None:
            return [], ()
        other = summarise(solved, minimum.method, True, time.perf_counter())
        judged = judge(other, alternatives, progress, evaluations=int(budget.left / (OF_HYPOTHESES + OF_CAUSES + 1)))
    except BudgetError:
        return [find_ended_search(budget.evaluations)], ()
    begins = f"with the state free in which {join_words(sorted(names))} begins: "
    named = [replace(each, text=begins + each.text) for each in judged.findings if each.kind in ("cause", "fixed")]
    return [*named, *(each for each in judged.findings if each.kind == "budget")], judged.hypotheses


def _hangs_on_little(fit: Fit, findings: Sequence[FitFinding]) -> bool:
    """Tell whether values are known only roughly, or weakly apart: a scale that a small part of the log tells is moved
    far by so little that the model lacks that the residual looks white.
    """
    weak = {name for direction in fit.identifiability.weak for name in direction}
    hanging = any((fit.parameters[name].known or 0.0) > HARDLY for name in weak)
    return hanging or any(finding.kind == "rough" for finding in findings)


def _tells(fit: Fit, validation: Experiment) -> bool:
    """Tell whether a log that is not fitted would determine the values alone, so that it is evidence."""
    alone = fit.logs.get(validation.name)
    return alone is not None and alone.determined


def _reach(
    fit: Fit, findings: Sequence[FitFinding], error: ModelError, *others: Mapping[str, float]
) -> tuple[Fit, list[FitFinding]]:
    """Return the fit with intervals that reach to other values, and its findings with what is then known roughly."""
    fit = _widen_to(fit, *others)
    return fit, [*(each for each in findings if each.kind != "rough"), *find_rough(fit, error)]


def _widen_to(fit: Fit, *others: Mapping[str, float]) -> Fit:
    """Return the fit with intervals that reach to other values of its parameters and delays, by what they differ the
    most.
    """
    noise = fit.covariance if fit.delay_covariance is None else fit.delay_covariance
    minimum = fit.require_minimum("_widen_to")
    before = minimum.problem.unknowns.by_name(minimum.z)
    apart = [[values.get(name, before[name]) - before[name] for values in others] for name in noise.names]
    shift = np.array([max(each, key=abs) for each in apart])
    return widen(fit, np.outer(shift, shift))


def _state_excess(fit: Fit, excess: Mapping[str, float]) -> Fit:
    """Return the fit with how many times its sensor's noise the residual of each output is."""
    outputs = {
        name: {output: replace(fitted, excess=excess[f"{name}.{output}"]) for output, fitted in row.items()}
        for name, row in fit.outputs.items()
    }
    return replace(fit, outputs=outputs)


def _conclude(fit: Fit) -> Fit:
    """Return the fit as stalled where it converged and explains too little."""
    worst = next((error for error in fit.errors if error.kind == "explained"), None)
    if fit.status != "converged" or worst is None:
        return fit
    return replace(fit, status="stalled", message=f"{worst.where}: {worst.text} ({fit.message})")


def _state_shares(fit: Fit, shares: Mapping[str, CoherentShare]) -> Fit:
    """Return the fit with the shares of its outputs' energy that are explained, and that some model could explain."""
    outputs = {
        name: {output: _state_share(fitted, shares.get(f"{name}.{output}")) for output, fitted in row.items()}
        for name, row in fit.outputs.items()
    }
    return replace(fit, outputs=outputs)


def _state_share(fitted: OutputFit, share: CoherentShare | None) -> OutputFit:
    if fitted.fit_percent < RUNS_AWAY:  # in free run, as a plant that is held to its log may
        return fitted
    percents = (fitted.band_fit_percent, fitted.fit_percent)
    explained = find_energy(next((p for p in percents if p is not None and math.isfinite(p)), 0.0))
    if share is None:
        return replace(fitted, explained=explained)
    follows = max(share.residual, 0.0) if share.p < CHANCE else 0.0
    explainable = max(share.output, explained + (1.0 - explained) * follows)
    return replace(fitted, explained=explained, explainable=explainable)


def _score_held_out_shots(fit: Fit, holdout: float) -> Fit:
    """Return the fit with a score of what was held out of logs cut into shots, which start from unknown states."""
    outputs = dict(fit.outputs)
    for experiment in fit.experiments if holdout else ():
        rows, log = outputs.get(experiment.name, {}), experiment.log
        if experiment.shots == 1 or all(row.holdout_fit_percent is not None for row in rows.values()):
            continue
        tail = log.between((1.0 - holdout) * log.duration_s, log.duration_s)
        shots = max(1, round(experiment.shots * holdout))
        score = fit.predict(replace(experiment, log=tail, shots=shots)).fit_percent
        outputs[experiment.name] = {name: replace(row, holdout_fit_percent=score[name]) for name, row in rows.items()}
    return replace(fit, outputs=outputs)


def _list_outputs(fit: Fit) -> Iterator[tuple[str, OutputFit]]:
    """Yield each output's name, EXPERIMENT.OUTPUT, and how well it is explained."""
    for name, row in fit.outputs.items():
        for output, fitted in row.items():
            yield f"{name}.{output}", fitted


def _warn(kind: str, where: str, text: str, *, bad: bool = False) -> FitFinding:
    """Return a warning, or an error where it is bad."""
    return FitFinding(severity="error" if bad else "warning", kind=kind, where=where, text=text)


def _find_unexplained(
    fit: Fit, shares: Mapping[str, CoherentShare], excess: Mapping[str, float]
) -> Iterator[FitFinding]:
    """Yield outputs that are explained less than they could be, and residuals that follow an input.

    What follows the inputs is measured in its sensor's noise, on every plant alike, and is an error by `SYSTEMATIC`.
    Where logs of two amplitudes tell what it does to the values it is none.
    """
    told = {
        f"{e.name}.{output}"
        for e in fit.experiments
        for output in e.outputs
        if has_two_amplitudes(fit.logs, e.plant.name)
    }
    for where, fitted in _list_outputs(fit):
        share, explained, explainable = shares.get(where), fitted.explained, fitted.explainable
        percents = (fitted.fit_percent, fitted.band_fit_percent, fitted.one_step_fit_percent)
        if explained is not None and max(percent for percent in percents if percent is not None) < WORSE:
            yield _warn("explained", where, _explain_worse(fit, where), bad=True)
            continue
        if explained is None or explainable is None or share is None:
            continue
        ratio = explained / max(explainable, 1e-300)
        if ratio < MOST and explainable > LITTLE:
            text = (
                f"the model explains {format_percent(explained)} of its energy, and the inputs account for "
                f"{format_percent(explainable)}"
            )
            yield _warn("explained", where, text, bad=ratio < HALF)
        elif share.p < CHANCE and share.residual > 0.0 and share.power > SMALL:
            band = " to ".join(dict.fromkeys(f"{end:.3g}" for end in share.band_hz))
            follows = math.sqrt(share.residual) * excess[where]
            bad = where not in told and any(follows > least and share.power > power for least, power in SYSTEMATIC)
            text = (
                f"{format_percent(share.residual, 2)} of the residual's power follows the inputs, most of all at "
                f"{band} Hz, {follows:.2g} times its sensor's noise: the model lacks something"
            )
            yield _warn("residual", where, text, bad=bad)


def _explain_worse(fit: Fit, where: str) -> str:
    """Return why a constant explains an output better: by a regression of it on the model's, its sign or unit."""
    experiment, output = next(
        (each, output) for each in fit.experiments for output in each.outputs if f"{each.name}.{output}" == where
    )
    run = fit.predict(experiment)
    there = np.isfinite(run.measured[output]) & np.isfinite(run.model[output])
    measured, model = (each[output][there] - each[output][there].mean() for each in (run.measured, run.model))
    both, energy = float(measured @ model), float(model @ model)
    gain = both / energy if energy else 0.0
    worse = "the model explains it worse than a constant"
    if not gain or abs(gain - 1.0) < TURNED or gain * both < ALIKE * float(measured @ measured):
        return f"{worse}: another plant, sign or unit, or jumps such as a counter that wraps"
    scale = -1.0 if abs(gain + 1.0) < TURNED else 1.0 / gain
    what = join_words([*(["sign"] if gain < 0.0 else []), *(["unit or scale"] if scale != -1.0 else [])])
    return (
        f"{worse}, and {scale:.4g} times it well: the log has another {what} of it (or of the input, where every "
        f'output is so); write {output} = {{ column = "...", scale = {scale:.4g} }}, or multiply the scale it has'
    )


def _find_held_out(fit: Fit, holdout: float) -> Iterator[FitFinding]:
    """Yield outputs that are explained far less where they were held out."""
    outputs = ((e, y, fitted) for e in fit.experiments for y, fitted in fit.outputs[e.name].items())
    for e, y, fitted in outputs:
        if fitted.holdout_fit_percent is None or not math.isfinite(fitted.holdout_fit_percent):
            continue
        held_out, used = find_energy(fitted.holdout_fit_percent), find_energy(fitted.fit_percent)
        worse = (1.0 - held_out) / max(1.0 - used, 1e-300)
        if worse >= WORSE_HELD_OUT**2 and held_out <= 0.99 * used and not _leaves_noise(e, y, fitted, holdout):
            text = (
                f"{format_percent(used, 4)} is explained of the samples used and {format_percent(held_out, 4)} of "
                "those held out: the plant changed, is excited elsewhere, or the fit follows what does not repeat; "
                "log longer, or fix parameters"
            )
            yield _warn("held_out", f"{e.name}.{y}", text, bad=held_out < HELD_OUT * used)


def _leaves_noise(experiment: Experiment, output: str, fitted: OutputFit, holdout: float) -> bool:
    """Tell whether what is left of an output's samples held out is its sensor's noise: a chirp that ends where the
    plant hardly answers leaves little else to explain there.
    """
    spread = float(np.nanstd(experiment.log[output][experiment.count_fitted(holdout) :]))
    left = (1.0 - (fitted.holdout_fit_percent or 0.0) / 100.0) * spread
    return left <= NOISE_HELD_OUT * fitted.rms_residual / (fitted.excess or math.inf)


def _find_at_bound(fit: Fit, minimum: Minimum) -> Iterator[FitFinding]:
    """Yield unknowns at a bound: errors where the logs want them far beyond it."""
    unknowns, z = minimum.problem.unknowns, minimum.z
    at_bound = [unknowns.names.index(name) for name in unknowns.find_at_bound(z)]
    if not at_bound:
        return
    evaluation = minimum.problem.evaluate(z)
    # A command and its reading are not logged at one instant: a delay of none may come out as a little less.
    periods = {e.slots.delay.index: e.period for e in minimum.problem.experiments if e.slots.delay.index is not None}
    for i in at_bound:
        name = unknowns.names[i]
        curvature = float(evaluation.hessian[i, i])
        inward = 1.0 if z[i] - unknowns.low[i] <= unknowns.high[i] - z[i] else -1.0
        push = inward * float(evaluation.gradient[i]) / math.sqrt(max(curvature, 1e-300))
        beyond = push / math.sqrt(max(curvature, 1e-300))
        parameter = fit.parameters.get(name)
        away = parameter is not None and not parameter.at_bound
        bad = (push > PUSH and beyond > TICK * periods.get(i, 0.0)) or away
        if away:
            remedy = "the farthest that a fit searches: the logs do not limit it; fix it, or give it a bound or a prior"
        elif bad:
            remedy = "the logs want it beyond: widen the bound, or look for what the model lacks"
        else:
            remedy = "widen the bound, or fix it there and say why"
        text = f"{z[i]:.4g} lies on its bound{',' if away else ';'} {remedy}"
        if i in periods and unknowns.low[i] == 0.0 and inward > 0.0:
            free = ~find_blocked(evaluation, unknowns.low, unknowns.high) | (np.arange(z.size) == i)
            variance = np.diag(invert(evaluation.hessian[free][:, free])[0])[np.count_nonzero(free[:i])]
            text = _explain_no_delay(float(evaluation.gradient[i] * variance), bad=bad)
        yield FitFinding(severity="error" if bad else "note", kind="bound", where=name, text=text)


def _explain_no_delay(early_s: float, *, bad: bool) -> str:
    """Return what a delay of none says; `early_s`: by how much a step to the minimum without a bound is negative."""
    if not bad:
        return "no delay can be told from none, and there is no shorter one: leave delay_s out, or give it as 0"
    return (
        f"a delay cannot be negative, and the outputs are some {1e3 * early_s:.2g} ms ahead of what acts on them: the "
        "command is stamped late, or the outputs early; shift the channel (clock_offset_s), or look for what the model "
        "lacks"
    )


def _find_implausible(fit: Fit) -> Iterator[FitFinding]:
    """Yield parameters of built-in plants that lie outside what such actuators have: free ones, and fixed ones."""
    declared = {name: each for e in fit.experiments for name, each in e.plant.parameters.items()}
    for name, each in declared.items():
        if not isinstance(each, Parameter) or each.plausible is None or name not in fit.parameters:
            continue
        (low, high), parameter = each.plausible, fit.parameters[name]
        value = parameter.value
        if low <= value <= high or not (parameter.identified or not parameter.free) or value == each.value:
            continue
        check = "the units of inputs and outputs, such as mA read as A, and the fixed parameters"
        text = (
            f"{name} = {value:.4g}{unit_after(parameter.unit)}; actuators of this kind have {low:g} to {high:g}: check "
            f"{check if parameter.free else 'this fixed value and its unit'}"
        )
        yield _warn("range", name, text, bad=parameter.free and (value > BEYOND * high or value * BEYOND < low))


def _find_contradicting_delays(fit: Fit) -> Iterator[FitFinding]:
    """Yield fitted delays that differ from the one that is known best among the logs of the same plant."""
    for plant in dict.fromkeys(experiment.plant.name for experiment in fit.experiments):
        fitted = {
            e.name: (fit.nuisance[e.name].fitted["delay_s"], e.log.period)
            for e in fit.experiments
            if e.plant.name == plant and "delay_s" in fit.nuisance[e.name].std
        }
        best = min(fitted, key=lambda name: fitted[name][0].std, default="")
        for name, (delay, period) in fitted.items():
            other = fitted[best][0]
            if abs(delay.value - other.value) > max(APART_STDS * math.hypot(delay.std, other.std), APART * period):
                text = (
                    f"a delay of {1e3 * delay.value:.4g} ± {1e3 * delay.std:.2g} ms contradicts that of {best}, "
                    f"{1e3 * other.value:.4g} ± {1e3 * other.std:.2g} ms: a delay makes up for what the model lacks in "
                    "one of them, or they were recorded apart; look at both, or give delay_s"
                )
                yield _warn("delay", f"{name}.delay_s", text)


def _find_few_samples(minimum: Minimum) -> Iterator[FitFinding]:
    """Yield that there are too few samples for the unknowns, so that neither values nor intervals can be trusted."""
    counts = [int(np.max(experiment.count_weighted())) for experiment in minimum.problem.experiments]
    samples, unknowns = sum(counts), minimum.z.size
    if max(counts) < FEWEST_SAMPLES or samples < SAMPLES_PER_UNKNOWN * unknowns:
        text = f"{samples} samples are too few for {unknowns} unknowns: nothing tests the model; log longer"
        yield _warn("samples", "", text, bad=True)


def _find_noiseless(fit: Fit, minimum: Minimum) -> Iterator[FitFinding]:
    """Yield outputs whose estimated noise is less than any sensor's: stds that follow from it say nothing."""
    for output in minimum.problem.outputs:
        rms = fit.outputs[output.experiment.name][output.name].rms_residual
        if output.name not in output.experiment.data.sigma and 0.0 <= rms < NOISELESS * output.spread:
            yield FitFinding(
                severity="note",
                kind="noise",
                where=output.label,
                text=f"its residual of {rms:.2g}{unit_after(output.unit)} is rounding, less than the noise of any "
                "sensor, as of simulated data: the stds say nothing; give the noise that it would have: sigma = ...",
            )


def _run_tests(fit: Fit, minimum: Minimum, freed: Freed | None) -> dict[str, ScoreTest]:
    """Test fixed parameters and delays; where residuals are coloured, those that make linear plants nonlinear too."""
    if fit.status == "not_identifiable":
        return {}
    freed = freed or free_fixed(minimum.problem, minimum.z)
    tests = run_score_tests(minimum, freed)
    white = all(output.whiteness_p > CHANCE for _, output in _list_outputs(fit))
    for name in () if white else freed.bending:
        tests |= run_score_tests(minimum, Freed.make(minimum.problem, minimum.z, (name,)))
    return tests


def _list_rivals(causes: Sequence[Explanation]) -> list[Explanation]:
    """Return the causes that explain the residuals as well as the best, but not those that add to it, up to three."""
    rivals = [cause for cause in causes if cause.gain > RIVAL_SHARE * causes[0].gain]
    names = rivals[0].preferred.keys() if rivals else set[str]()
    return [each for each in rivals if not (names and names < each.preferred.keys())][:3]


def _name_causes(
    fit: Fit, causes: Sequence[Explanation], suspects: Mapping[str, ScoreTest], *, ended: bool
) -> Iterator[FitFinding]:
    """Yield the explanation that is the most likely, and others that explain as much. `ended`: not all was tried."""
    against = next((name for name, test in suspects.items() if test.p < CHANCE), None)
    if not causes and against is not None:
        test = suspects[against]
        tried = "the search for causes ended before all was tried" if ended else "no other value alone explains them"
        text = (
            f"{against} = {test.value:.4g} is fixed, and the logs are against it (chi-square {test.chi2:.3g} on one "
            f"degree of freedom), but {tried}"
        )
        yield _warn("fixed", against, text)
    if not causes:
        return
    rivals = _list_rivals(causes)
    text = "; or ".join(cause.text for cause in rivals)
    if len(rivals) == 1:
        text = f"likely cause: {text}"
    else:
        text = f"{len(rivals)} causes fit equally well, and the logs cannot separate them: {text}"
    where = ", ".join(dict.fromkeys(cause.where for cause in rivals))
    finding = _warn("cause", where, text, bad=any(cause.material for cause in rivals))
    refit = rivals[0].refit
    yield replace(
        finding,
        preferred={name: value for cause in reversed(rivals) for name, value in cause.preferred.items()},
        together=tuple(rivals[0].preferred) or None,
        proposal="[plant.NAME]\nsticks = true" if rivals[0].jumps else refit and refit.proposal,
        python="plant = so.plants.let_stick(plant)" if rivals[0].jumps else refit and refit.python,
        sticks=rivals[0].jumps or None,
    )
