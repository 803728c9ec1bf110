"""The integration step of nonlinear plants: its error, in sigmas of outputs and parameters, and how fine it must be."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from seaopt.estimation.problem.fit_experiment import FIRST_SAMPLES, MAX_SUBSTEPS, FitExperiment
from seaopt.estimation.problem.fit_problem import Evaluation, FitProblem
from seaopt.estimation.problem.normal_equations import invert
from seaopt.estimation.problem.shapes import PerOutput, Vector
from seaopt.estimation.solver.step_shares import share_many, share_steps
from seaopt.plants.friction import remembers
from seaopt.records import record
from seaopt.simulation import Pass

STEP_ERROR_SIGMA = 0.01  # integration error allowed in an output, in sigma
STEP_ERROR_PARAMETER = 0.1  # and in a parameter, in its standard deviations
TOLERATED = 3.0  # times that, where no finer steps are left: an interval of 95 % then covers 94 %
FIRST_STEP_ERROR = 0.1  # allowed in an output while sigma is not yet known
ROUGH_STEP_ERROR = 0.05  # rms, of minima that are only compared: a part in 400 of a residual's power
MUCH_FINER = 4.0  # times: a change of the step whose error is not taken on trust
NEARBY = 10.0  # standard deviations, over which a step error does not change
# Of an order: where a joint that sticks stops, residuals jump, and finer steps make that no better for ever.
MOST_STEPS = {4: MAX_SUBSTEPS, 2: 32}
# Between events order four needs no more, and what turns or stops by chance gains nothing; twice that where a sharp
# corner, such as that of play, leaves more than is tolerated.
MOST_STEPS_BY_EVENTS = 16
STIFF, STIFFER = 8.0, 4.0  # stable steps per sample that a search may always take, and times those at its start
SAME_COST = 1e-2  # relative change of a cost, with steps of half the length, that bristles at the start may make
EXACT = 1e-6  # noise below this part of an output's spread asks no more of the integrator


@record
class StepError:
    """Integration error at the minimum: largest in an output, in sigma, and in a parameter, in standard deviations."""

    output: float = 0.0
    parameter: float = 0.0

    @property
    def small(self) -> bool:
        """Whether it may be left out of account."""
        return max(self.output / STEP_ERROR_SIGMA, self.parameter / STEP_ERROR_PARAMETER) <= TOLERATED


@record(eq=False)
class StepCheck:
    """The step error of an experiment, where it was found, and with which steps."""

    error: StepError
    z: Vector
    substeps: int


StepChecks = Mapping[str, StepCheck]  # by experiment, those that are known


def choose_first_steps(
    problem: FitProblem, start: Evaluation, most: int = MAX_SUBSTEPS, *, roughly: bool = False
) -> tuple[FitProblem, Evaluation]:
    """Return the problem with steps that do for a first search, `most` per sample at most, and its evaluation there.

    `roughly`: for a minimum that is only compared, so that a jump here and there, where a joint stops, does not count.
    """
    while True:
        finer = problem.map(lambda e, evaluation=start: _choose_first_steps(e, evaluation, most, roughly=roughly))
        if finer == [experiment.count_steps(start.z) for experiment in problem.experiments]:
            return share_many(problem, start)
        problem = _with_substeps(problem, finer)
        start = problem.evaluate(start.z)


def _choose_first_steps(experiment: FitExperiment, evaluation: Evaluation, most: int, *, roughly: bool) -> int:
    """Return the steps that an experiment's first samples ask for."""
    z, fine = evaluation.passes.z, []
    if experiment.model.linear or experiment.count_steps(z) >= most:
        return experiment.count_steps(z)
    halved = _halve_steps(experiment)
    for segment in experiment.segments:
        stop = min(segment.samples.n, FIRST_SAMPLES)
        fine.append(halved.run(segment, z, stop=stop, sums=False, outputs=True))
    coarse, allowed = evaluation.passes.by_experiment[experiment.name], FIRST_STEP_ERROR
    error = _measure_output_error(experiment, z, coarse, fine, rms=roughly)
    if roughly:
        allowed = ROUGH_STEP_ERROR
    return min(_choose_steps(experiment.count_steps(z), StepError(output=error), allowed, experiment), most)


def has_bristles(problem: FitProblem) -> bool:
    """Tell whether some plant's friction bends before it slips."""
    return any(remembers(experiment.data.plant) for experiment in problem.experiments)


def hold_bristles(
    problem: FitProblem, z: Vector, within: Callable[[FitProblem], bool] = lambda finer: True
) -> FitProblem:
    """Return the problem with steps short enough for bristles at z, which are stiff where they slip. How fast they slip
    only a simulation tells: with steps too long for it that overflows, or makes a cost that half as long ones change.
    `within`: tells of a problem whether its steps are not too many.
    """
    if not has_bristles(problem):
        return problem
    cost = np.nan
    while True:
        new_cost = problem.evaluate(z).cost
        if np.isfinite(new_cost) and abs(new_cost - cost) <= SAME_COST * new_cost:
            return problem
        finer = refine_bristles(problem, z)
        if finer is problem or not within(finer):
            return problem
        problem, cost = finer, new_cost


def refine_bristles(problem: FitProblem, z: Vector) -> FitProblem:
    """Return the problem with steps half as long where there are bristles, if that is still allowed."""
    steps = [experiment.count_steps(z) for experiment in problem.experiments]
    finer = [
        min(2 * count, MAX_SUBSTEPS) if remembers(experiment.data.plant) else count
        for experiment, count in zip(problem.experiments, steps, strict=True)
    ]
    return share_steps(problem, z, _list_finer(problem, steps, finer))


def refine_steps(
    problem: FitProblem, evaluation: Evaluation, checks: StepChecks
) -> tuple[FitProblem, Evaluation, StepChecks]:
    """Return the problem with steps whose error is small, its evaluation there, and the errors that are known there.
    That of a step that was made finer is not: its order says how fine it must be, and the next minimum is looked at.
    """
    while True:
        checks = check_steps(problem, evaluation, checks)
        substeps = [experiment.count_steps(evaluation.z) for experiment in problem.experiments]
        finer = [
            _choose_steps(steps, checks[e.name].error, STEP_ERROR_SIGMA, e)
            for e, steps in zip(problem.experiments, substeps, strict=True)
        ]
        if finer == substeps:
            return problem, evaluation, checks
        trusted = all(new < MUCH_FINER * old for new, old in zip(finer, substeps, strict=True))
        problem = share_steps(problem, evaluation.z, _list_finer(problem, substeps, finer))
        # Where the error was looked at steps of half the length have been made; offsets follow from there. Where joints
        # stick a search goes another way by as little as rounding.
        made, curved = evaluation.passes.z, ~problem.unknowns.linear
        followed = problem.exactly_linear and np.array_equal(made[curved], evaluation.z[curved])
        sticks = any(experiment.model.sticks for experiment in problem.experiments)
        evaluation = problem.evaluate(made if followed and not sticks else evaluation.z)
        if trusted:
            return problem, evaluation, checks


def check_steps(problem: FitProblem, evaluation: Evaluation, checks: StepChecks) -> StepChecks:
    """Return the step error of every experiment: known still, where neither its step nor the minimum has changed."""

    def check(experiment: FitExperiment) -> StepCheck:
        earlier, substeps = checks.get(experiment.name), experiment.count_steps(evaluation.z)
        if earlier is not None and earlier.substeps == substeps and _lies_near(evaluation, earlier.z):
            return earlier
        return StepCheck(error=measure_step_error(problem, experiment, evaluation), z=evaluation.z, substeps=substeps)

    return {e.name: made for e, made in zip(problem.experiments, problem.map(check), strict=True)}


@np.errstate(all="ignore")
def _lies_near(evaluation: Evaluation, z: Vector) -> bool:
    """Tell whether the step error at z holds here, too; it does not where derivatives are not finite."""
    moved = evaluation.z - z
    distance = moved @ evaluation.hessian @ moved
    return bool(np.isfinite(distance) and distance < NEARBY**2)


def find_worst(checks: StepChecks) -> StepError:
    """Return the largest of all experiments' errors."""
    errors = [check.error for check in checks.values()]
    return StepError(output=max(error.output for error in errors), parameter=max(error.parameter for error in errors))


@record(eq=False)
class BoundedSteps:
    """A problem whose cost is infinite where a plant is far stiffer than at a start: nothing is simulated there."""

    problem: FitProblem
    start: Evaluation
    most: float  # stable steps per sample

    def evaluate(self, z: Vector) -> Evaluation:
        """Return the evaluation at z."""
        if _find_stiffest(self.problem, z) > self.most:
            return replace(self.start, z=z, cost=np.inf)
        return self.problem.evaluate(z)


def bound_steps(problem: FitProblem, start: Evaluation) -> BoundedSteps:
    """Return the problem with a bound on steps where joints stick: one that is thrown far off takes ever more."""
    sticks = any(experiment.model.sticks for experiment in problem.experiments)
    most = max(STIFF, STIFFER * _find_stiffest(problem, start.z)) if sticks else np.inf
    return BoundedSteps(problem=problem, start=start, most=most)


def _find_stiffest(problem: FitProblem, z: Vector) -> float:
    return max(experiment.count_stable_steps(z) for experiment in problem.experiments)


def _list_finer(problem: FitProblem, before: Sequence[int], finer: Sequence[int]) -> dict[str, int]:
    return {e.name: new for e, old, new in zip(problem.experiments, before, finer, strict=True) if new != old}


def _with_substeps(problem: FitProblem, substeps: Sequence[int]) -> FitProblem:
    return problem.with_values("substeps", {e.name: m for e, m in zip(problem.experiments, substeps, strict=True)})


def _choose_steps(steps: int, error: StepError, allowed: float, experiment: FitExperiment) -> int:
    """Return how many steps per sample an error asks for."""
    over = max(error.output / allowed, error.parameter * STEP_ERROR_SIGMA / (STEP_ERROR_PARAMETER * allowed))
    if over <= 1.0 or not np.isfinite(over):
        return steps
    model = experiment.model
    order, most = model.order, MOST_STEPS[model.order]
    if model.by_events:
        most = MOST_STEPS_BY_EVENTS if over <= TOLERATED else 2 * MOST_STEPS_BY_EVENTS
    finer = steps * min(1.1 * over ** (1.0 / order), MUCH_FINER)
    return min(max(int(np.ceil(finer)), steps + 1), max(most, steps))


@np.errstate(all="ignore")
def measure_step_error(problem: FitProblem, experiment: FitExperiment, evaluation: Evaluation) -> StepError:
    """Return the integration error of an experiment, from the change that steps of half the length bring. In a
    parameter it is the move of the minimum, H^-1 (change of the gradient), in standard deviations: an error far below
    the noise can add up over a long log. In an output it is the largest change, in sigma, over each segment's first
    samples.
    """
    if experiment.model.linear:
        return StepError()
    z, passes, n = evaluation.passes.z, evaluation.passes.by_experiment[experiment.name], evaluation.z.size
    fine = _halve_steps(experiment).run_all(z)
    worst = _measure_output_error(experiment, z, passes, fine)
    weighted = replace(experiment, sigma=_floored_sigma(experiment))
    coarse = weighted.normal(passes, n)
    gradient = weighted.normal(fine, n)[0, 1:] - coarse[0, 1:]
    hessian = coarse[1:, 1:] + np.diag(problem.unknowns.precision)
    if not (np.isfinite(worst) and np.all(np.isfinite(hessian)) and np.all(np.isfinite(gradient))):
        return StepError(output=np.inf, parameter=np.inf)
    inverse, _ = invert(hessian)
    p = problem.unknowns.shared
    std = np.sqrt(np.maximum(np.diag(inverse)[:p], 1e-300))
    moved = np.abs(inverse @ gradient)[:p] * _whole_error(experiment) / std
    return StepError(output=worst, parameter=float(np.max(moved, initial=0.0)))


def _halve_steps(experiment: FitExperiment) -> FitExperiment:
    return replace(experiment, halved=True)


def _whole_error(experiment: FitExperiment) -> float:
    """Return an integration error over the change that steps of half the length bring."""
    return 2.0**experiment.model.order / (2.0**experiment.model.order - 1.0)


def _floored_sigma(experiment: FitExperiment) -> PerOutput:
    return np.maximum(experiment.sigma, EXACT * experiment.spread)


@np.errstate(all="ignore")
def _measure_output_error(
    experiment: FitExperiment, z: Vector, coarse: Sequence[Pass], fine: Sequence[Pass], *, rms: bool = False
) -> float:
    """Return the largest integration error in an output of an experiment, or its rms, in sigma: see
    `measure_step_error`. Segments that are held out whole begin anywhere: no sample tells of their states.
    """
    scale = experiment.point(z).gain / _floored_sigma(experiment)
    worst = 0.0
    for segment, rough, halved in zip(experiment.segments, coarse, fine, strict=True):
        if not segment.has_start:
            continue
        assert rough.outputs is not None and halved.outputs is not None
        apart = scale * (rough.outputs - halved.outputs)
        change = np.sqrt(np.max(np.mean(apart**2, axis=0))) if rms else np.max(np.abs(apart))
        change = float(change) * _whole_error(experiment)
        worst = max(worst, change if np.isfinite(change) else np.inf)
    return worst
