"""The search for what a model lacks: every hypothesis is refitted, and taken only where it removes the excess.

The excess is a residual's rms over the noise of its sensor, of the output where it is most, over the samples that are
fitted and over those that are held out: what follows the one part alone explains neither. Large misfits bend what one
step predicts: a spring that hardens ranked sixth by its step, and was the cause. So each hypothesis takes several,
from the fit's values; one that does not help is left soon. None is taken that leaves the excess high, unless it takes
98 % of its power: friction that grows with the load takes a part of nearly everything. Where one does not suffice the
best three are joined with each other, and then with every other one, two in all. A second effect has to earn its place:
a pair often gets on where its parts got stuck, so that either is then tried alone from there; and beside one that would
be taken alone it has to remove all of the excess that is left.

What this may cost is counted (`budget`): refits begin as long as the search's share lasts, and the best of them is
settled, and parted where it is a pair, from what the whole judgement has left. A refit that asks for integration steps
out of proportion to the fit's is left undecided: bristles that slip fast are so stiff. Their search often ends in no
minimum, and where they still leave an excess is undecided, too. So is a pair whose parts are not tried because nothing
is left.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import wraps
from typing import ParamSpec

import numpy as np

from seaopt.errors import SeaoptError
from seaopt.estimation.judgement.hypotheses import HYPOTHESES, Change, Hypothesis, change_plants, measure_sizes
from seaopt.estimation.judgement.hypothesis_ranking import (
    ASKS,
    HALF,
    NEARLY,
    REMOVED,
    Refit,
    TriedHypotheses,
    rank_refits,
    takes_half,
)
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_problem import (
    BudgetError,
    Evaluation,
    FitProblem,
    count_evaluations,
    count_left,
    pose_problem,
)
from seaopt.estimation.problem.noise_floor import NoiseFloor, measure_floors
from seaopt.estimation.problem.residual_statistics import ResidualsByExperiment, compute_residuals
from seaopt.estimation.problem.shapes import Vector
from seaopt.estimation.result.covariance import measure_colour
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.estimation.solver.budget import EvaluationBudget
from seaopt.estimation.solver.least_squares import FIRST_RADIUS, find_blocked, minimise
from seaopt.estimation.solver.settle import ROUGH_SUBSTEPS, coarsen, estimate_sigma
from seaopt.estimation.solver.step_shares import copy_steps
from seaopt.estimation.solver.step_size import choose_first_steps, has_bristles, hold_bristles, refine_bristles
from seaopt.parameters import ParameterSet
from seaopt.progress import Progress, ignore

ROUND, ROUNDS = 4, 5  # iterations of a refit between two looks at whether it helps, and how many looks
MOST_ROUNDS = 15  # where each of them halves the power that is left
HELPS = 0.02  # of a residual's power beyond noise, that a round has to take from some output
CLOSE = 1e-3  # over the size of the start: the second radius that a step may have
BASES = 3  # hypotheses, the best, beside which each other one is tried
BACK = 1e-3  # of a residual's power, beyond the least yet, from which a refit is on its way back to it
SLIGHT = 0.2  # of that: a step that may gain half as much ends a round
NEAR = 1e-2  # squared standard deviations that may be left to the minimum

P = ParamSpec("P")


def search_hypotheses(
    fit: Fit,
    residuals: ResidualsByExperiment,
    floors: Mapping[str, NoiseFloor],
    budget: EvaluationBudget,
    progress: Progress = ignore,
    *,
    doubtful: bool = False,
) -> TriedHypotheses:
    """Return the hypotheses that were tried, the best first; none where the residual asks for none.

    `fit`: with its minimum, `residuals`, `floors`: there; `budget`: what the search may take; `doubtful`: whether
    values hang on little of the residual, so that what is hardly more than noise asks, too.
    """
    minimum = fit.require_minimum("search_hypotheses")
    first = _find_excess(minimum.problem, residuals, floors)
    if (first <= ASKS and not doubtful) or minimum.problem.predicts:
        return TriedHypotheses()
    search = _Search(fit, minimum, first, budget, progress)
    judged = rank_refits(search.run(), first, measure_colour(fit.covariance, fit.white_covariance))
    return replace(judged, ended=search.ended)


class _Search:
    """A search's budget, and what it knows of the fit; lives only inside `search_hypotheses`."""

    def __init__(self, fit: Fit, minimum: Minimum, first: float, budget: EvaluationBudget, progress: Progress) -> None:
        self.fit, self.minimum, self.budget, self.progress = fit, minimum, budget, progress
        self.first, self.helps = first, HELPS * (1.0 - max(first, 1.0) ** -2)
        self.sizes = measure_sizes(fit)
        # Which no refit tells from other values; but far from the logs sensitivities say little.
        self.silent = {effect.part for effect in fit.silent if first <= REMOVED}
        self.base = minimum.problem.evaluate(minimum.z)
        self.ended = False
        self.tried = set[tuple[Change | None, Hypothesis]]()  # also those that are refused

    def run(self) -> list[Refit]:
        """Return the refits of single hypotheses, and of pairs with the best of them where none suffices."""
        # Steps as coarse as the residual allows: that of a fit which explains little asks for few.
        problem, fitted = self.minimum.problem, self.base
        if self.first > REMOVED:
            problem, fitted = coarsen(problem, self.minimum.z)
        single = list(self.try_each(problem, fitted, self.fit.experiments, self.fit.parameters))
        single.sort(key=lambda refit: (refit.undecided, refit.excess))
        gone_on = [*map(self.go_on, single[:BASES]), *single[BASES:]]
        refits = self.go_further(sorted(map(self.doubt, gone_on), key=lambda refit: (refit.undecided, refit.excess)))
        bases = [refit for refit in refits[:BASES] if not refit.undecided]
        partners = [refit.change.hypotheses[-1] for refit in bases]
        # The best with each other first: of two effects either alone may take little.
        rounds = [(best, partners[number:]) for number, best in enumerate(bases[:-1], start=1)]
        for number, (best, others) in enumerate([*rounds, *((best, HYPOTHESES) for best in bases)]):
            least = min(refit.excess for refit in refits)
            if least <= (REMOVED if number >= len(bases) else ASKS) or best.excess >= self.first:
                break
            values, done = _take_values(best), [set(refit.change.hypotheses) for refit in refits]
            refits += self.try_each(
                best.problem, best.evaluation, best.change.experiments, values, best.change, done, others
            )
        decided = [refit for refit in refits if not refit.undecided]
        if not decided:
            return refits
        # Near noise likelihoods tell apart what hardly differs in excess.
        best = min(decided, key=lambda refit: refit.excess if self.first > ASKS else -refit.gain)
        settled = _settle(best, best.evaluation)
        alone = list[Refit]()
        if len(best.change.hypotheses) > 1 and settled.excess <= max(REMOVED, NEARLY * self.first):
            alone += self.try_alone(settled)
            if count_left() < 1.0:
                self.ended, settled = True, replace(settled, undecided=True)
        return _keep_best([*(refit for refit in refits if refit is not best), settled, *alone])

    def go_further(self, refits: list[Refit]) -> list[Refit]:
        """Return the refits, the best first, with what goes further than the best where that leaves some excess."""
        best = next((refit for refit in refits if not refit.undecided), None)
        further = best.change.hypotheses[0].further if best else None
        if best is None or further is None or best.excess <= ASKS or not takes_half(self.first, best.excess):
            return refits
        change = change_plants(further, self.fit.experiments, self.fit.parameters, self.sizes)
        refit = _refit_alone(change, best, self.helps, self.base, self.budget) if change else None
        return refits if refit is None or refit.excess >= best.excess else [refit, *refits]

    def go_on(self, refit: Refit) -> Refit:
        """Return a refit that is on its way to a minimum after as many rounds again."""
        if refit.undecided or not self.is_on_its_way(refit):
            return refit
        start = refit.evaluation
        further = _descend(refit.change, refit.problem, start, self.base, self.base, self.helps, self.budget)
        return replace(further, evaluations=refit.evaluations + further.evaluations) if further else refit

    def is_on_its_way(self, refit: Refit) -> bool:
        """Tell whether a refit has helped and was left before its minimum."""
        return not refit.at_minimum and refit.excess <= (1.0 - self.helps) * self.first

    def doubt(self, refit: Refit) -> Refit:
        """Return a refit as undecided where bristles leave an excess on their way to a minimum: how far they got before
        they became too stiff is chance, and says nothing against them.
        """
        if refit.undecided or not has_bristles(refit.problem) or refit.excess <= REMOVED:
            return refit
        return replace(refit, undecided=self.is_on_its_way(refit))

    def try_alone(self, pair: Refit) -> Iterator[Refit]:
        """Yield each part of a pair alone, from the pair's values: one of them may explain as much."""
        for hypothesis in pair.change.hypotheses:
            change = change_plants(hypothesis, self.fit.experiments, self.fit.parameters, self.sizes)
            assert change is not None  # it is in a pair
            refit = _refit_alone(change, pair, self.helps, self.base, self.budget)
            if refit is not None:
                yield refit

    def try_each(
        self,
        problem: FitProblem,
        fitted: Evaluation,
        experiments: tuple[Experiment, ...],
        params: ParameterSet,
        before: Change | None = None,
        done: Sequence[set[Hypothesis]] = (),
        hypotheses: Sequence[Hypothesis] = HYPOTHESES,
    ) -> Iterator[Refit]:
        """Yield the refits of each hypothesis that is not there yet, as long as the budget lasts."""
        for number, hypothesis in enumerate(hypotheses, start=1):
            known = before is not None and {*before.hypotheses, hypothesis} in done
            if hypothesis.part in self.silent or known or (before, hypothesis) in self.tried:
                continue
            change = change_plants(hypothesis, experiments, params, self.sizes, before)
            if change is None:
                continue
            if self.budget.left <= (0.0 if before is None else 2.0 * ROUND):  # a pair leaves what settles the best
                self.ended = True
                return
            self.tried.add((before, hypothesis))
            beside = "" if before is None else f", beside {before.effect}"
            told = f"trying cause {number} of {len(hypotheses)}: {hypothesis.effect}{beside}"
            self.progress(told, self.budget.share)
            refit = _refit(change, problem, fitted, self.helps, self.base, self.budget)
            if refit is not None:
                yield refit


def _keep_best(refits: Sequence[Refit]) -> list[Refit]:
    """Return the refits, of several with the same hypotheses the one that leaves the least."""
    best = dict[frozenset[Hypothesis], Refit]()
    for refit in sorted(refits, key=lambda refit: refit.excess):
        best.setdefault(frozenset(refit.change.hypotheses), refit)
    return list(best.values())


def _take_values(refit: Refit) -> ParameterSet:
    """Return a refit's parameters at its minimum."""
    return refit.problem.params.update(**{name: refit.values[name] for name in refit.problem.shared_names})


def _or_none(refit: Callable[P, Refit | None]) -> Callable[P, Refit | None]:
    """Return a refit that is None where it is refused: what does not make a problem explains nothing."""

    @wraps(refit)
    def tried(*args: P.args, **kwargs: P.kwargs) -> Refit | None:
        try:
            return refit(*args, **kwargs)
        except SeaoptError:
            return None

    return tried


@_or_none
def _refit(
    change: Change, old: FitProblem, fitted: Evaluation, helps: float, base: Evaluation, budget: EvaluationBudget
) -> Refit | None:
    """Return the minimum with a change, from the fit's, `base` the fit without any; None where it cannot be simulated.

    A search that takes less than `helps` of the residual's power in a round of iterations is given up, and so is one
    that has come to the end of the budget.
    """
    before = count_evaluations()
    problem = _pose(change, old)
    begins = _begin_segments(problem, old, fitted.z)
    values = {**begins, **old.unknowns.by_name(fitted.z)}
    problem, start = _choose_start(change, problem, values, fitted, budget)
    refit = _descend(change, _rest(problem, start, old), start, fitted, base, helps, budget)
    return refit and replace(refit, evaluations=count_evaluations() - before)


@_or_none
def _refit_alone(change: Change, pair: Refit, helps: float, base: Evaluation, budget: EvaluationBudget) -> Refit | None:
    """Return the minimum with one part of a pair, from the pair's values, as `_refit` does; whatever is left of the
    budget, for a pair is not believed without.
    """
    problem = _pose(change, pair.problem)
    start = problem.evaluate(problem.unknowns.start_from(pair.values))
    budget = EvaluationBudget.begin(ROUNDS * ROUND, max(budget.unit, problem.count_work(start.z)))
    return _descend(change, problem, start, base, base, helps, budget)


def _pose(change: Change, old: FitProblem) -> FitProblem:
    """Return a change's problem, with the noise and the steps of another one of the same logs."""
    problem = pose_problem(change.experiments, change.params, loss=old.loss, band_hz=old.band_hz, holdout=old.holdout)
    problem = problem.with_values("sigma", {e.name: e.sigma for e in old.experiments})
    return copy_steps(problem, old)


@_or_none
def _descend(
    change: Change,
    problem: FitProblem,
    start: Evaluation,
    fitted: Evaluation,
    base: Evaluation,
    helps: float,
    budget: EvaluationBudget,
) -> Refit | None:
    """Return the minimum that rounds of iterations come to from a start, as `_refit` does."""
    before = count_evaluations()
    if not np.isfinite(start.cost):
        left = Refit(change=change, problem=problem, evaluation=start, excess=np.inf, gain=-np.inf, evaluations=0)
        return replace(left, undecided=True) if has_bristles(problem) else None
    evaluation, unknowns, powers = start, problem.unknowns, _measure_powers(start)
    at_fit = least = checked = _measure_powers(fitted)
    radius, undecided = FIRST_RADIUS, False
    for number in range(MOST_ROUNDS):
        undecided = not budget.allows(problem, evaluation.z)
        if undecided:
            break
        # The smaller the residual has become, the finer must be the steps.
        if np.any(powers < HALF * checked):
            problem, evaluation = choose_first_steps(problem, evaluation, ROUGH_SUBSTEPS, roughly=True)
            checked = powers
        low, high, first = unknowns.low, unknowns.high, evaluation
        near = NEAR if np.any(powers < HALF * at_fit) else max(NEAR, SLIGHT * helps * first.cost)
        points = [first]
        solution = minimise(
            problem, first, low, high, decrement=near, max_iterations=ROUND, first_radius=radius, callback=points.append
        )
        evaluation = solution.evaluation
        if points[-2:] == [evaluation] * 2 and has_bristles(problem):  # stiffer ones may ask for shorter steps
            finer = refine_bristles(problem, evaluation.z)
            undecided = finer is problem or not budget.allows(finer, evaluation.z)
            if undecided:
                break
            problem = finer
        if evaluation is first and solution.status == "max_iterations" and radius == FIRST_RADIUS:
            radius = CLOSE  # every step went too far
            continue
        if not np.isfinite(evaluation.cost):
            return None
        problem = problem.with_values("sigma", estimate_sigma(problem, evaluation.power, evaluation.z))
        evaluation = problem.assemble(evaluation.passes, evaluation.z)
        before_round, powers = powers, _measure_powers(evaluation)
        away = before_round - least  # a start may be far from the fit, and takes rounds to come back
        comes_near = np.any((away > BACK * least) & (powers - least < HALF * away))
        if np.all(powers > (1.0 - helps) * np.minimum(least, before_round)) and not comes_near:
            break
        if number >= ROUNDS - 1 and not np.any(powers < HALF * before_round):
            break
        if budget.left <= 0.0:
            break
        least = np.minimum(least, powers)
    refit = _weigh(change, problem, evaluation, base)
    return replace(refit, undecided=undecided and refit.excess > REMOVED, evaluations=count_evaluations() - before)


def _weigh(change: Change, problem: FitProblem, evaluation: Evaluation, base: Evaluation) -> Refit:
    """Return the refit that a search has come to; near noise likelihoods are compared, for which steps are finer."""
    excess, gain = _measure_excess(problem, evaluation.z), _measure_gain(base, evaluation)
    refit = Refit(change=change, problem=problem, evaluation=evaluation, excess=excess, gain=gain, evaluations=0)
    if excess <= REMOVED:
        try:
            problem, evaluation = choose_first_steps(problem, evaluation, ROUGH_SUBSTEPS)
        except BudgetError:
            return refit
        if problem is not refit.problem:
            refit = _settle(replace(refit, problem=problem), evaluation)
    return refit


def _settle(refit: Refit, start: Evaluation) -> Refit:
    """Return a refit at its minimum, which says how far what is missing moves the values."""
    low, high = refit.problem.unknowns.low, refit.problem.unknowns.high
    evaluation = minimise(refit.problem, start, low, high, decrement=NEAR, max_iterations=2 * ROUND).evaluation
    if evaluation is refit.evaluation:
        return refit
    excess = _measure_excess(refit.problem, evaluation.z)
    gain = refit.gain + _measure_gain(refit.evaluation, evaluation)
    return replace(refit, evaluation=evaluation, excess=excess, gain=gain)


def _choose_start(
    change: Change, problem: FitProblem, fitted: dict[str, float], at_fit: Evaluation, budget: EvaluationBudget
) -> tuple[FitProblem, Evaluation]:
    """Return the evaluation at the fit's values and the best start of what is added, with steps that hold there: that
    from which a step of all else is to gain the most, for what a fit has in place of an effect is at odds with most.
    Its cost is infinite where such steps would be out of proportion.
    """
    unknowns, starts = problem.unknowns, list[tuple[FitProblem, Evaluation]]()
    delays = [e.slots.delay.index for e in problem.experiments if e.slots.delay.index is not None]
    hypothesis, springs = change.hypotheses[-1], {e.plant.spring for e in change.experiments}
    stiffnesses = [unknowns.names.index(s.stiffness) for s in springs if s and s.stiffness in unknowns.names]
    for start in change.starts:
        z = unknowns.start_from({**fitted, **start})
        z[delays] -= change.lag(start)
        z[stiffnesses] -= hypothesis.stiffens(change.sizes, start)
        z = np.clip(z, unknowns.low, unknowns.high)
        if not budget.allows(problem, z):
            starts.append((problem, replace(at_fit, z=z, cost=np.inf)))
            continue
        evaluation, stable = problem.evaluate(z), problem
        if not np.isfinite(evaluation.cost):
            stable = hold_bristles(problem, z, lambda finer, z=z: budget.allows(finer, z))
            evaluation = stable.evaluate(z) if stable is not problem else evaluation
        starts.append((stable, evaluation))
    others = np.array([name in fitted for name in unknowns.names])

    def reach(start: tuple[FitProblem, Evaluation]) -> float:
        _, evaluation = start
        if not np.isfinite(evaluation.cost):
            return np.inf
        free = others & ~find_blocked(evaluation, unknowns.low, unknowns.high)
        return evaluation.cost - 0.5 * evaluation.distance_squared(free)

    return min(starts, key=reach)


def _begin_segments(problem: FitProblem, old: FitProblem, z: Vector) -> dict[str, float]:
    """Return the states in which a fit's own run passes the beginnings of segments that the fit did not have: where a
    position is lost that only the changed plant follows.
    """
    begins, names = dict[str, float](), problem.unknowns.names
    for new, before in zip(problem.experiments, old.experiments, strict=True):
        if len(new.segments) == len(before.segments):
            continue
        passed = np.zeros((len(before.data.log), before.model.nx))
        for segment, rows in zip(before.segments, before.data.segment_rows, strict=True):
            passed[rows] = before.run(segment, z, sums=False, states=True).states
        for segment, rows in zip(new.segments, new.data.segment_rows, strict=True):
            at = dict(zip(before.data.plant.states, passed[rows.start].tolist(), strict=True))
            slots = zip(new.data.plant.states, segment.initial, strict=True)
            begins |= {names[slot.index]: at[state] for state, slot in slots if slot.index is not None and state in at}
    return begins


def _rest(problem: FitProblem, start: Evaluation, old: FitProblem) -> FitProblem:
    """Return a problem whose joints start as the fit has them, at rest: no slope tells with which speed, or with which
    state of what is added. A segment that the fit did not have starts anywhere. `old`: the problem of the fit.
    """
    places, unknowns = problem.find_resting(start.z), problem.unknowns
    if not places:
        return problem
    before = dict(zip(old.unknowns.names, old.unknowns.low == old.unknowns.high, strict=True))
    groups = {name.rpartition(".")[0] for name in before}
    places += [
        i
        for i, name in enumerate(unknowns.names)
        if i >= unknowns.shared and before.get(name, name.rpartition(".")[0] in groups)
    ]
    return replace(problem, unknowns=unknowns.bound(places, start.z[places], start.z[places]))


@np.errstate(all="ignore")  # a run that overflows, where it is held out alone, has no finite excess
def _measure_excess(problem: FitProblem, z: Vector) -> float:
    """Return how many times its noise a residual at `z` is, where it is most."""
    residuals = compute_residuals(problem, z)
    return _find_excess(problem, residuals, measure_floors(problem, residuals, z))


@np.errstate(all="ignore")
def _find_excess(problem: FitProblem, residuals: ResidualsByExperiment, floors: Mapping[str, NoiseFloor]) -> float:
    """Return how many times its noise a residual is, where it is most: of the samples used and of those held out.

    Infinite where the model runs away.
    """
    ratios = [0.0]
    for experiment in problem.experiments:
        floor = floors[experiment.name]
        ratios += floor.excess.tolist()
        if experiment.holdout and problem.band_hz is None:
            parts = zip(experiment.segments, residuals[experiment.name].segments, strict=True)
            pairs = [(np.stack(part.samples.keep, axis=1) == 0, left.raw) for part, left in parts]
            squares = np.concatenate([np.where(held_out, raw**2, np.nan) for held_out, raw in pairs])
            count = np.maximum(np.count_nonzero(np.isfinite(squares), axis=0), 1)
            ratios += (np.sqrt(np.nansum(squares, axis=0) / count) / (floor.noise * experiment.sigma)).tolist()
    return float(np.max(np.nan_to_num(ratios, nan=np.inf)))


def _measure_powers(evaluation: Evaluation) -> Vector:
    return np.concatenate([power.squares / np.maximum(power.counts, 1.0) for power in evaluation.power.values()])


def _measure_gain(before: Evaluation, after: Evaluation) -> float:
    """Return the logarithm of a likelihood over another one's, at each one's own residuals."""
    counts = np.concatenate([power.counts for power in before.power.values()])
    powers = (np.maximum(_measure_powers(each), 1e-300) for each in (before, after))
    was, left = powers
    return 0.5 * float(np.sum(counts * (np.log(was) - np.log(left))))
