"""Explanations of the logs that are better than a fit's: each candidate is refitted, and weighed by what it gains.

What a candidate gains is the logarithm of its likelihood over the fit's, at each one's own residuals. The gain counts
only beyond what chance gives a residual of this colour. The search may end before all was tried: so what a score speaks
for is tried first, and a refit that the budget cuts off is not compared with any.

A damper c in a spring of stiffness k puts its force ahead of its deflection by c/k, as a late stamp of the deflection
would; what else it does is small: it damps a motion that friction damps as well, and its force grows as (w c/k)^2/2.
Over samples that both are fitted to, the likelihoods of such a pair differ by little of what either gains. So each is
fitted to the first part of the logs, from where it is, and compared over the rest.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.errors import SeaoptError
from seaopt.estimation.judgement.candidates import Candidate, list_candidates
from seaopt.estimation.judgement.hypothesis_ranking import Refit
from seaopt.estimation.judgement.score_test import ScoreTest
from seaopt.estimation.judgement.second_log import FAR
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_experiment import measure_spread
from seaopt.estimation.problem.fit_problem import (
    BudgetError,
    Evaluation,
    FitProblem,
    count_left,
    limit_evaluations,
    pose_problem,
)
from seaopt.estimation.problem.normal_equations import invert
from seaopt.estimation.problem.residual_statistics import ResidualsByExperiment, compute_residuals
from seaopt.estimation.problem.shapes import Vector
from seaopt.estimation.result.covariance import measure_colour
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.estimation.result.trials import spell_hold
from seaopt.estimation.solver.budget import EvaluationBudget
from seaopt.estimation.solver.settle import (
    ROUGH_ITERATIONS,
    Solved,
    coarsen,
    measure_misfit,
    refine_to,
    settle_roughly,
    sharpen,
)
from seaopt.estimation.solver.step_shares import copy_steps
from seaopt.formatting import format_percent, join_words
from seaopt.parameters import QUANTILE
from seaopt.plants import Plant
from seaopt.progress import Progress, ignore
from seaopt.records import record

ENOUGH = 10.0  # of log-likelihood, over the colour of the residual: a gain that chance does not give
SOLVED = 0.02  # of the residual's power of a poor fit: what leaves less is the cause, and others need not be tried
HALVED = 0.5  # of a residual's power: what leaves less is another explanation, wherever the estimates are
MOVED_STDS, MOVED_SHARE = 5.0, 0.01  # an estimate that another explanation moves so far was not what it said
HOPELESS, PATIENCE = 1.4, 8  # a misfit that is larger by so much of the samples, after so many iterations, stays so
STILL, SLIGHT = 5, 0.1  # iterations in a row that gain so little of misfit end a refit: where a delay's slope has kinks
HELD_OUT = 0.3  # of each log, its end, where the fit holds out nothing
BLOCKS = 20  # of each log's end, whose differences are taken for independent
SURE = 2.5  # standard deviations by which one of two is nearer to held-out samples
COMPARES = 8  # evaluations that are kept for that: two fits near their minima take four
PROMISES = 0.5  # of a gain that counts: what shows with coarse steps, the same in fit and refit, before finer are made
SEEN = 1e-6  # probability below which a score is not chance
FIRST_DELAYS = (0, -2, 5, 20, -20)  # samples, from which a refit with a free delay starts


@record(eq=False)
class Explanation:
    """Another explanation of the logs."""

    text: str  # with what it does to the residuals and the estimates
    where: str
    gain: float  # logarithm of its likelihood over the fit's
    solved: bool  # whether it leaves hardly anything of the residual of any output
    # whether it moves an estimate beyond what the fit says, or takes half of a residual's power away: of a residual
    # near its noise that is no reason to doubt values that stay within their intervals
    material: bool
    preferred: Mapping[str, tuple[float, float]]  # value and std that the refit gives what it frees
    refit: Refit | None = None  # of a hypothesis about what the model lacks
    jumps: bool = False  # friction that is smoothed: it is to stick, and its speed is not to be freed
    apart: bool = False  # channels that are late, each by itself
    # of its refit, and where its minimum is
    problem: FitProblem
    z: Vector


def find_causes(
    fit: Fit,
    residuals: ResidualsByExperiment,
    suspects: Mapping[str, ScoreTest],
    alternatives: Sequence[Plant],
    *,
    poor: bool,
    noticed: bool = True,
    hypotheses: Sequence[Refit] = (),
    budget: EvaluationBudget | None = None,
    progress: Progress = ignore,
) -> list[Explanation]:
    """Return what explains the logs better than the fit, the best first. `fit`: with its minimum; `residuals`: of the
    fit; `suspects`: what was fixed and is at odds with the logs; `alternatives`: other plants that may have been on the
    bench; `poor`: whether the fit explains so little that its estimates are no start: what searches does so from its
    own; `noticed`: whether anything is wrong besides the suspects; `hypotheses`: those that remove the excess;
    `budget`: after which nothing more is tried; `progress`: called before each that is tried.
    """
    minimum = fit.require_minimum("find_causes")
    fitted = minimum.problem.evaluate(minimum.z)
    whole = _measure_powers(fitted, minimum.problem)
    colour = measure_colour(fit.covariance, fit.white_covariance)
    causes = list(_weigh_hypotheses(fit, hypotheses, whole, colour))
    candidates = list(list_candidates(fit, minimum, residuals, suspects, alternatives, poor=poor, noticed=noticed))
    if not poor:
        candidates = _put_seen_first(candidates, suspects)
    # Steps as coarse as the residual allows, until a refit is worth finer ones.
    coarse, rough = minimum.problem, fitted
    if not _is_near_noise(fit) and not coarse.predicts:
        try:
            coarse, rough = coarsen(coarse, minimum.z)
            rough = settle_roughly(coarse, rough, checked=True).solution.evaluation
        except BudgetError:
            candidates = []
    explained = False
    for number, candidate in enumerate(candidates, start=1):
        if candidate.further and not explained:
            continue
        explained = False
        spent = 0.0 if budget is None else budget.share
        if spent >= 1.0:
            break
        progress(f"trying cause {number} of {len(candidates)}", max(spent, (number - 1) / len(candidates)))
        kept = COMPARES if all(_find_rivals(fit, causes)) else 0
        try:
            with limit_evaluations(count_left() - kept):
                steps = [(coarse, rough)]
                if _is_seen(candidate, suspects) and coarse is not minimum.problem:
                    steps.append((minimum.problem, fitted))  # what coarse steps hide, for it bends as they do
                solved = next(_list_promising(fit, candidate, steps, measure_misfit(fitted), colour), None)
                if solved is None:
                    continue
                before = _measure_kept(fit, minimum.problem, minimum.z, candidate.kept) if candidate.kept else whole
                solved = refine_to(solved, minimum.problem)
                if count_left() < 1.0:  # cut off where it is, which is no minimum
                    break
        except BudgetError:
            break
        except SeaoptError:  # what does not make a problem explains nothing
            continue
        cause = _weigh(fit, candidate, solved.problem, solved.solution.evaluation, before, colour, poor=poor)
        if cause is not None:
            causes.append(cause)
            explained = True
            if poor and cause.solved:
                break
    best = max((cause.gain for cause in causes), default=0.0)
    # Of explanations that chance alone sets apart, the one that frees least comes first.
    causes.sort(key=lambda c: (c.gain < best - ENOUGH, c.z.size if c.gain >= best - ENOUGH else 0, -c.gain))
    return _drop_worse(fit, causes)


def _is_seen(candidate: Candidate, suspects: Mapping[str, ScoreTest]) -> bool:
    """Tell whether a score is clearly against the value of something that a candidate frees."""
    return any(suspects[name].p < SEEN for name in candidate.frees if name in suspects)


def _put_seen_first(candidates: Sequence[Candidate], suspects: Mapping[str, ScoreTest]) -> list[Candidate]:
    """Return the candidates with those in front that a score speaks for, and what follows them: where the budget ends
    the search, it ends among what nothing speaks for.
    """
    groups: list[list[Candidate]] = []
    for candidate in candidates:
        if candidate.further:
            groups[-1].append(candidate)
        else:
            groups.append([candidate])
    groups.sort(key=lambda group: not _is_seen(group[0], suspects))
    return [candidate for group in groups for candidate in group]


def _drop_worse(fit: Fit, causes: list[Explanation]) -> list[Explanation]:
    """Return the causes, the best first, with the better over held-out samples of channels that are late and the
    spring's damper; both where chance alone sets them apart, or neither is the best.
    """
    late, damped = _find_rivals(fit, causes)
    if late is None or damped is None or causes[0] not in (late, damped):
        return causes
    try:
        nearer = compare_held_out((damped.problem, damped.z), (late.problem, late.z))
    except SeaoptError:  # too little is left to fit
        return causes
    worse = late if nearer > SURE else damped if nearer < -SURE else None
    return [cause for cause in causes if cause is not worse]


def _find_rivals(fit: Fit, causes: Sequence[Explanation]) -> tuple[Explanation | None, Explanation | None]:
    """Return the first cause of channels that are late, and of the spring's damper; None where there is none."""
    dampers = {e.plant.spring.damper for e in fit.experiments if e.plant.spring is not None}
    late = next((cause for cause in causes if cause.apart), None)
    return late, next((cause for cause in causes if dampers & cause.preferred.keys()), None)


def _measure_powers(evaluation: Evaluation, problem: FitProblem) -> Float[np.ndarray, "outputs 2"]:
    """Return, output by output, the residual's mean square over the measured one's, and how many samples count."""
    rows: list[Float[np.ndarray, "_ 2"]] = []
    for e in problem.experiments:
        power = evaluation.power[e.name]
        shares = power.squares / np.maximum(power.counts, 1.0) / np.maximum(e.spread**2, 1e-300)
        rows.append(np.column_stack([shares, power.counts]))
    return np.maximum(np.concatenate(rows), 1e-24)


def _list_promising(
    fit: Fit, candidate: Candidate, steps: Sequence[tuple[FitProblem, Evaluation]], misfit: float, colour: float
) -> Iterator[Solved]:
    """Yield refits that may gain what counts over the fit with the same steps. `steps`: problems with those to search
    with, and the fit's minimum there; `misfit`: of the fit.
    """
    minimum = fit.require_minimum("find_causes")
    for problem, there in steps:
        solved = _refit(minimum, candidate, problem, misfit + HOPELESS * fit.samples)
        if solved is None:
            continue
        kept = candidate.kept
        before = _measure_kept(fit, problem, there.z, kept) if kept else _measure_powers(there, problem)
        if _measure_gain(before, solved) > PROMISES * ENOUGH * colour:
            yield solved


def _measure_kept(
    fit: Fit, problem: FitProblem, z: Vector, kept: Sequence[Experiment]
) -> Float[np.ndarray, "outputs 2"]:
    """Return the powers of a fit's residuals at z over some of its samples."""
    problem, z = problem.rebuild(fit.parameters, z, {e.name: e for e in kept})
    spread = {e.name: np.array([measure_spread(e.log[name]) for name in e.outputs]) for e in kept}
    problem = problem.with_values("spread", spread)
    return _measure_powers(problem.evaluate(z), problem)


def _measure_gain(before: Float[np.ndarray, "outputs 2"], solved: Solved) -> float:
    """Return the logarithm of a likelihood over the fit's; of other outputs there is no limit."""
    after = _measure_powers(solved.solution.evaluation, solved.problem)
    if len(after) != len(before):
        return np.inf
    return 0.5 * float(np.sum(before[:, 1] * (np.log(before[:, 0]) - np.log(after[:, 0]))))


def _refit(minimum: Minimum, candidate: Candidate, coarse: FitProblem, most: float) -> Solved | None:
    """Return the minimum with the change: from the fit's, or from where its method finds a start. `coarse`: the problem
    with the steps to search with; `most`: the misfit above which a search is soon given up.
    """
    old = minimum.problem
    problem = pose_problem(
        candidate.experiments,
        candidate.params,
        loss=old.loss,
        band_hz=old.band_hz,
        holdout=old.holdout,
        noise=old.predicts,
    )
    names, z = problem.unknowns.names, problem.unknowns.start.copy()
    if old.predicts:
        solved = replace(minimum.method, max_iterations=ROUGH_ITERATIONS, search=False).solve(problem, None)
        return solved if np.isfinite(solved.solution.evaluation.cost) else None
    fitted = old.unknowns.by_name(minimum.z)
    for i, name in enumerate(names):
        if i >= problem.unknowns.shared:  # parameters start from the candidate's own
            z[i] = fitted.get(name, z[i])
    problem = copy_steps(problem, coarse)
    if candidate.gains:
        z = _compare_gains(problem, z, candidate.gains)
    start = problem.evaluate(z)
    for samples in FIRST_DELAYS if candidate.delays else ():
        other = z.copy()
        for name in candidate.delays:
            i = names.index(name)
            other[i] = np.clip(z[i] + samples * problem.experiments[0].period, problem.unknowns.low[i], None)
        start = min(start, problem.evaluate(other), key=lambda evaluation: evaluation.cost)
    plants = {e.data.plant for e in old.experiments}
    checked = all(e.data.plant in plants for e in problem.experiments)
    misfits = [measure_misfit(start)]

    def ends(evaluation: Evaluation) -> bool:
        misfits.append(measure_misfit(evaluation))
        still = len(misfits) > STILL and misfits[-1] > misfits[-1 - STILL] - SLIGHT
        return still or (len(misfits) > 1 + PATIENCE and misfits[-1] > most)

    def solve(problem: FitProblem, start: Evaluation) -> Solved:
        return settle_roughly(problem, start, ends=ends, checked=checked)

    # Only the freed parameter's friction is sharpened: what the fit found out already needs no other search.
    solved = solve(problem, start) if old.find_smoothing() else sharpen(problem, start, solve)
    return solved if np.isfinite(solved.misfit) else None


def _compare_gains(problem: FitProblem, z: Vector, gains: Sequence[str]) -> Vector:
    """Return the unknowns with each gain as a simulation compares with its output."""
    z, residuals = z.copy(), compute_residuals(problem, z)
    for output in problem.outputs:
        name = f"{output.experiment.name}.gain.{output.name}"
        if name not in gains:
            continue
        measured = np.concatenate(output.measured)
        model = measured + np.concatenate(residuals[output.experiment.name].raw_of(output.name))
        good = np.isfinite(model)
        model, measured = model[good] - np.mean(model[good]), measured[good] - np.mean(measured[good])
        size = float(model @ model)
        z[problem.unknowns.names.index(name)] = float(model @ measured) / size if size > 0.0 else 1.0
    return z


def _weigh_hypotheses(
    fit: Fit, hypotheses: Sequence[Refit], before: Float[np.ndarray, "outputs 2"], colour: float
) -> Iterator[Explanation]:
    """Yield what hypotheses about what the model lacks are worth, each with the part that brings it."""
    for refit in hypotheses:
        added = join_words([f"{name} = {value:.4g}" for name, value in {**refit.frees, **refit.fixed}.items()])
        parts, holds = join_words(refit.change.parts), refit.change.holds
        word = "part" if len(refit.change.parts) == 1 else "parts"
        written = join_words([f"{spell_hold(hold)} in [[experiment]] {name}" for name, hold in holds.items()])
        advice = [f"add {word} {parts}" + (f", with {added}" if added else "")] if parts else []
        advice += [f"write {written}"] if written else []
        candidate = Candidate(
            where=", ".join([*refit.frees, *holds]),
            experiments=refit.change.experiments,
            params=refit.change.params,
            says=f"{refit.change.effect}; {join_words(advice)}",
            frees=dict.fromkeys(refit.frees, 0.0),
        )
        cause = _weigh(fit, candidate, refit.problem, refit.evaluation, before, colour, poor=False)
        if cause is not None:
            yield replace(cause, refit=refit, material=cause.material or not refit.at_minimum)


def _is_near_noise(fit: Fit) -> bool:
    """Tell whether no residual is so far above its sensor's noise that intervals of one log hold no more."""
    rows = fit.outputs.values()
    return all(figures.excess is not None and figures.excess <= FAR for row in rows for figures in row.values())


def _weigh(
    fit: Fit,
    candidate: Candidate,
    problem: FitProblem,
    evaluation: Evaluation,
    before: Float[np.ndarray, "outputs 2"],
    colour: float,
    *,
    poor: bool,
) -> Explanation | None:
    """Return what a refit is worth; None where chance gives as much, where it is no other explanation, or where its
    slopes do not tell how well its values are known.
    """
    after = _measure_powers(evaluation, problem)
    if len(after) != len(before) or not np.all(np.isfinite(evaluation.hessian)):  # slopes of a run that overflows
        return None
    fall = np.log(before[:, 0]) - np.log(after[:, 0])
    gain = 0.5 * float(np.sum(before[:, 1] * fall)) / colour
    values = problem.unknowns.by_name(evaluation.z)
    variances = colour * np.diag(invert(evaluation.hessian)[0])
    stds = dict(zip(values, np.sqrt(np.maximum(variances, 0.0)).tolist(), strict=True))
    left = float(np.exp(-np.max(fall)))
    text = candidate.describe(values, stds) if gain > ENOUGH and not (poor and left > HALVED) else None
    if text is None:
        return None
    moved: list[tuple[float, str]] = []
    inside = True
    for name in fit.covariance.names:
        old = fit.parameters[name]
        away = abs(values.get(name, old.value) - old.value)
        half = QUANTILE * (old.total_std or 0.0)
        inside = inside and away <= half
        if away > max(MOVED_STDS * (old.std or 0.0), half, MOVED_SHARE * abs(old.value)):
            moved.append((away / max(abs(old.value), 1e-300), name))
    effects = [f"takes {format_percent(1.0 - left)} of a residual's power away"] if left < 1.0 - 1e-3 else []
    if moved:
        _, name = max(moved)
        effects.append(f"moves {name} from {fit.parameters[name].value:.4g} to {values[name]:.4g}")
    jumps = candidate.jumps(values, stds)
    return Explanation(
        text=f"{text} ({' and '.join(effects)})" if effects else text,
        where=candidate.where,
        gain=gain,
        solved=bool(np.all(after[:, 0] < SOLVED * before[:, 0])),
        preferred={}
        if jumps
        else {name: (values[name] - shift, stds[name]) for name, shift in candidate.frees.items()},
        jumps=jumps,
        material=bool(moved) or candidate.certain or (left < HALVED and not (inside and _is_near_noise(fit))),
        apart=candidate.apart,
        problem=problem,
        z=evaluation.z,
    )


def compare_held_out(
    first: tuple[FitProblem, Float[np.ndarray, " n"]], second: tuple[FitProblem, Float[np.ndarray, " m"]]
) -> float:
    """Return by how many standard deviations the first minimum is nearer than the second to what neither was fitted to.
    Both are of the same outputs of the same logs, which either may have as experiments of their own.
    """
    pairs = zip(_list_held_out(*first), _list_held_out(*second), strict=True)
    blocks = np.zeros(BLOCKS)
    for ours, theirs in pairs:
        nearer = (theirs - ours) / min(np.nanmean(ours), np.nanmean(theirs))
        blocks += [np.nansum(block) for block in np.array_split(nearer, BLOCKS)]
    return float(np.mean(blocks) / max(np.std(blocks, ddof=1) / np.sqrt(BLOCKS), 1e-300))


def _list_held_out(problem: FitProblem, z: Vector) -> list[Float[np.ndarray, " k"]]:
    """Return each output's squared residuals over the last part of its log, at the minimum over the rest."""
    if not problem.holdout:
        rest = pose_problem(
            tuple(e.data for e in problem.experiments),
            problem.params,
            loss=problem.loss,
            band_hz=problem.band_hz,
            holdout=HELD_OUT,
        )
        rest = copy_steps(rest.with_values("sigma", {e.name: e.sigma for e in problem.experiments}), problem)
        solved = settle_roughly(rest, rest.evaluate(z), checked=True)
        problem, z = solved.problem, solved.solution.evaluation.z
    residuals = compute_residuals(problem, z)
    rows: list[Float[np.ndarray, " k"]] = []
    for experiment in problem.experiments:
        parts = zip(experiment.segments, residuals[experiment.name].segments, strict=True)
        squares = [left.raw[part.samples.keep[0] == 0] ** 2 for part, left in parts]
        rows += list(np.concatenate(squares).T)
    return rows
