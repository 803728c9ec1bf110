"""From a start to the minimum: rounds of least squares, of estimating sigma, and of refining the integration step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from seaopt.estimation.problem.fit_experiment import MAX_SUBSTEPS, ResidualPower
from seaopt.estimation.problem.fit_problem import Evaluation, FitProblem
from seaopt.estimation.problem.residual_statistics import compute_experiment_residuals
from seaopt.estimation.problem.shapes import PerOutput, Vector
from seaopt.estimation.solver.least_squares import DECREMENT, STILL_MOVING, Callback, Solution, find_blocked, minimise
from seaopt.estimation.solver.step_shares import even_steps, share_many, share_steps
from seaopt.estimation.solver.step_size import (
    StepChecks,
    StepError,
    bound_steps,
    check_steps,
    choose_first_steps,
    find_worst,
    refine_steps,
)
from seaopt.plants.friction import remembers
from seaopt.records import record

MAX_ROUNDS = 12  # of estimating sigma and choosing the step
UNEXPLAINED = 0.2  # of an output's spread: a fit of a nonlinear plant that leaves more looks for another start
ROUGH = 1.0  # squared standard deviations to the minimum, near enough to tell the sigmas
ROUGH_ITERATIONS, ROUGH_ROUNDS, ROUGH_SUBSTEPS = 15, 2, 8  # of a minimum that is only to be compared with another
NEAR = 1e-2  # squared standard deviations that may be left to it
FALL = 4.0  # of a smoothing speed of friction, in a stage
TOLD = 2.0  # of the misfit, which is twice a log-likelihood: what sharper friction has to gain
ROOM = 0.25  # of the finest steps, up to which a smoothing speed is searched: the rest makes the steps' error small
HALF = 0.5  # of those, beyond which nothing sharper is tried
THROWS = (-0.3, -0.03, 0.03, 0.3)  # of the speed that its input could give a joint
FLAT = 1e-6  # of a cost where joints stick, or friction gets sharp: far less than its noise
JUMPY_DECREMENT = 1e-2  # there residuals jump a little as a stop moves to another integration step
FLAT_DECREMENT = 1e-3  # process noise that is hardly there is a flat direction: slow to search


@record(eq=False)
class Solved:
    """A minimum, and the problem with the sigma and the step with which it was found."""

    problem: FitProblem
    solution: Solution[Evaluation]
    step_error: StepError

    @property
    def misfit(self) -> float:
        """The misfit of its evaluation: see `measure_misfit`."""
        return measure_misfit(self.solution.evaluation)

    @property
    def follows_log(self) -> bool:
        """Whether the search has converged, and its minimum explains the log."""
        evaluation = self.solution.evaluation
        converged = self.solution.status == "converged" and bool(np.isfinite(evaluation.cost))
        return converged and not explains_little(self.problem, evaluation.power)


def settle(problem: FitProblem, start: Evaluation, max_iterations: int, callback: Callback | None) -> Solved:
    """Minimise; estimate the unknown sigmas and refine the step until neither changes. What friction that sticks soon
    stops is at rest at first: a search that is far off would throw the joint, and end where it swings in place of what
    drives it.
    """

    def solve(stage: FitProblem, evaluation: Evaluation) -> Solved:
        return _settle(stage, evaluation, max_iterations, callback)

    places, unknowns = problem.find_resting(start.z), problem.unknowns
    if not places:
        return sharpen(problem, start, solve)
    resting = sharpen(replace(problem, unknowns=unknowns.bound(places, 0.0, 0.0)), start, solve)
    freed = replace(resting.problem, unknowns=unknowns)
    solved = sharpen(freed, resting.solution.evaluation, solve)
    iterations = resting.solution.iterations + solved.solution.iterations
    thrown = _throw(solved.problem, solved.solution.evaluation)
    if thrown is not None:
        moving = sharpen(solved.problem, thrown, solve)
        iterations += moving.solution.iterations
        solved = min(solved, moving, key=lambda each: each.misfit)
    return replace(solved, solution=replace(solved.solution, iterations=iterations))


def _throw(problem: FitProblem, resting: Evaluation) -> Evaluation | None:
    """Return where a joint at rest is thrown, and a step from there gains: at rest no slope tells of its speed."""
    best, least = None, resting.cost - TOLD
    for place in problem.find_stopped():
        for share in THROWS if np.isfinite(resting.cost) else ():
            z = resting.z.copy()
            z[place] = share * problem.unknowns.prior_std[place]
            thrown = problem.evaluate(z)
            free = ~find_blocked(thrown, problem.unknowns.low, problem.unknowns.high)
            reached = thrown.cost - 0.5 * thrown.distance_squared(free) if np.isfinite(thrown.cost) else np.inf
            if reached < least:
                best, least = thrown, reached
    return best


def sharpen(problem: FitProblem, start: Evaluation, solve: Callable[[FitProblem, Evaluation], Solved]) -> Solved:
    """Solve a problem; friction's free smoothing speeds fall by stages, as long as the logs gain by it. The sharper
    friction is, the stiffer is the plant and the less do the logs tell how sharp: a search that went straight down
    would end where nothing can be simulated. Each stage lets a speed fall to a quarter. The last is the one that ends
    above that, beyond which the next gains no more than chance gives, as its slope or its minimum tells, or takes too
    fine steps.
    """
    places, unknowns = problem.find_smoothing(), problem.unknowns
    if not places:
        return solve(problem, start)

    def solve_stage(problem: FitProblem, evaluation: Evaluation) -> Solved:
        fall = max(1.0 / FALL, _measure_stiffness(problem, evaluation.z))
        low = np.maximum(unknowns.low[places], fall * evaluation.z[places])
        return solve(replace(problem, unknowns=unknowns.bound(places, low, unknowns.high[places])), evaluation)

    stiffness = _measure_stiffness(problem, start.z)
    if stiffness > 1.0:  # too sharp to begin with
        z = start.z.copy()
        z[places] *= stiffness
        start = problem.evaluate(z)
    solved = solve_stage(problem, start)
    while np.any(solved.solution.z[places] <= solved.problem.unknowns.low[places]):
        if _measure_stiffness(problem, solved.solution.z) > HALF or not np.isfinite(solved.misfit):
            break
        evaluation = solved.solution.evaluation
        # The slope by the speeds is that of the best cost, and flattens towards 0.
        if 2.0 * float(evaluation.gradient[places] @ evaluation.z[places]) <= TOLD:
            break
        sharper = solve_stage(solved.problem, solved.solution.evaluation)
        if not solved.misfit - sharper.misfit > TOLD:
            break
        solved = sharper
    return replace(solved, problem=replace(solved.problem, unknowns=unknowns))


def _measure_stiffness(problem: FitProblem, z: Vector) -> float:
    """Return the stable integration steps over those that a search may take."""
    return max(e.count_stable_steps(z) for e in problem.experiments) / (ROOM * MAX_SUBSTEPS)


def _settle(problem: FitProblem, start: Evaluation, max_iterations: int, callback: Callback | None) -> Solved:
    unknowns, iterations = problem.unknowns, 0
    if not np.isfinite(start.cost):
        solution = minimise(problem, start, unknowns.low, unknowns.high)
        return Solved(problem=problem, solution=solution, step_error=StepError(output=np.inf))
    problem, evaluation = choose_first_steps(problem, start)
    decrement = FLAT_DECREMENT if problem.predicts else DECREMENT
    flat = measure_flatness(problem)
    if flat:
        decrement = JUMPY_DECREMENT
    checks: StepChecks = {}
    rough, before = problem.straight and not explains_little(problem, evaluation.power), 0.0
    if rough:  # so good a start gives sigmas good enough to come near the minimum, and there they are estimated well
        problem = problem.with_values("sigma", estimate_sigma(problem, evaluation.power, evaluation.z))
        evaluation = problem.assemble(evaluation.passes)
    for attempt in range(MAX_ROUNDS):
        solution = minimise(
            bound_steps(problem, evaluation),
            evaluation,
            unknowns.low,
            unknowns.high,
            decrement=ROUGH if rough else decrement,
            max_iterations=max(max_iterations - iterations, 1),
            callback=_tell_round(callback, problem, attempt + 1, MAX_ROUNDS),
            follow=problem.follow if problem.straight and attempt else None,
            before=before,  # in true sigmas
            flat=flat,
        )
        evaluation, iterations = solution.evaluation, iterations + solution.iterations
        lost = solution.lost and explains_little(problem, evaluation.power)
        if lost or not np.isfinite(evaluation.cost):
            solution = replace(solution, iterations=iterations)
            return Solved(problem=problem, solution=solution, step_error=StepError(output=np.inf))
        sigma = estimate_sigma(problem, evaluation.power, evaluation.z)
        settled = all(np.allclose(sigma[e.name], e.sigma, rtol=5e-3) for e in problem.experiments)
        before_refining = problem = problem.with_values("sigma", sigma)
        if problem.loss.quadratic:
            evaluation = problem.assemble(evaluation.passes, evaluation.z)  # other sigmas need no other passes
        elif not settled:
            evaluation = problem.evaluate(evaluation.z)
        problem, evaluation, checks = refine_steps(problem, evaluation, checks if settled else {})
        done, spent = settled and not rough and problem is before_refining, iterations >= max_iterations
        rough, before = False, solution.before
        if done or spent or attempt == MAX_ROUNDS - 1:
            solution = replace(solution, z=evaluation.z, evaluation=evaluation, iterations=iterations)
            if not done and spent:
                solution = replace(solution, status="max_iterations", message=STILL_MOVING)
            elif not done:
                message = f"sigma or the integration step still changes after {MAX_ROUNDS} rounds; give sigma"
                solution = replace(solution, status="stalled", message=message)
            worst = find_worst(check_steps(problem, evaluation, checks))
            return Solved(problem=problem, solution=solution, step_error=worst)
    raise AssertionError  # the last attempt returns


def _tell_round(
    callback: Callback | None, problem: FitProblem, number: int, most: int
) -> Callable[[Evaluation], None] | None:
    """Return what tells a callback of the round, of how many at most, and of unknowns that are on a bound."""
    if callback is None:
        return None
    unknowns = problem.unknowns
    held = {name for name, low, high in zip(unknowns.names, unknowns.low, unknowns.high, strict=True) if low == high}

    def tell(evaluation: Evaluation) -> None:
        at_bound = [name for name in unknowns.find_at_bound(evaluation.z) if name not in held]
        callback(
            f"round {number} of {most}" + (f", {', '.join(at_bound)} at a bound" if at_bound else ""), evaluation.cost
        )

    return tell


def measure_flatness(problem: FitProblem) -> float:
    """Return the share of the cost that is no change: nothing where no joint sticks, or bends before it slips, nor gets
    as sharp as it likes, and the cost is smooth. A search among the kinks that a step makes of sharp friction creeps on
    with the last digit, in place of shorter steps that take the kinks away.
    """
    kinks = any(e.model.sticks or remembers(e.data.plant) for e in problem.experiments)
    return FLAT if kinks or problem.find_smoothing() else 0.0


def coarsen(problem: FitProblem, z: Vector) -> tuple[FitProblem, Evaluation]:
    """Return a problem with integration steps as coarse as its residual at z allows, and its evaluation there."""
    problem = even_steps(problem).with_each(substeps=1)
    return choose_first_steps(problem, problem.evaluate(z), ROUGH_SUBSTEPS, roughly=True)


def settle_roughly(
    problem: FitProblem,
    start: Evaluation,
    callback: Callback | None = None,
    ends: Callable[[Evaluation], bool] | None = None,
    *,
    checked: bool = False,
) -> Solved:
    """Return a minimum near enough to be compared with others: sigma is estimated twice, the step chosen once. `ends`:
    tells of each point whether it is all that is asked for; `checked`: the steps are fine enough as they are.
    """
    evaluation = start
    if not checked:
        problem, evaluation = choose_first_steps(problem, start, ROUGH_SUBSTEPS)
        problem = even_steps(problem)
        problem = problem.with_each(substeps=min(ROUGH_SUBSTEPS, *(e.substeps for e in problem.experiments)))
    else:
        problem, evaluation = share_many(problem, evaluation)
    unknowns, solution, iterations = problem.unknowns, None, 0
    for attempt in range(ROUGH_ROUNDS):
        problem, evaluation = _take_sigma(problem, evaluation)
        solution = minimise(
            bound_steps(problem, evaluation),
            evaluation,
            unknowns.low,
            unknowns.high,
            decrement=NEAR,
            max_iterations=ROUGH_ITERATIONS,
            callback=_tell_round(callback, problem, attempt + 1, ROUGH_ROUNDS),
            flat=measure_flatness(problem),
            ends=ends,
        )
        evaluation, iterations = solution.evaluation, iterations + solution.iterations
        if not np.isfinite(evaluation.cost) or (ends is not None and ends(evaluation)):
            break
    assert solution is not None
    solution = replace(solution, iterations=iterations)
    return Solved(problem=problem, solution=solution, step_error=StepError())


def _take_sigma(problem: FitProblem, evaluation: Evaluation) -> tuple[FitProblem, Evaluation]:
    """Return a problem with the sigmas of its residuals, which need no other passes where the loss is quadratic."""
    problem = problem.with_values("sigma", estimate_sigma(problem, evaluation.power, evaluation.z))
    if not problem.loss.quadratic:
        return problem, problem.evaluate(evaluation.z)
    return problem, problem.assemble(evaluation.passes, evaluation.z)


def refine_to(solved: Solved, fine: FitProblem, ends: Callable[[Evaluation], bool] | None = None) -> Solved:
    """Return a rough minimum with integration steps as fine as a problem's, so that it can be compared with its own.
    `ends`: tells of each point whether it is all that is asked for.
    """
    problem, z = solved.problem, solved.solution.z
    most = max(experiment.even_substeps for experiment in fine.experiments)
    coarser = {e.name: max(most, e.count_even_steps(z)) for e in problem.experiments if e.even_substeps < most}
    if not coarser:
        return solved
    problem = share_steps(even_steps(problem, coarser), z, coarser)
    problem, evaluation = _take_sigma(problem, problem.evaluate(solved.solution.z))
    if ends is not None and ends(evaluation):
        found = replace(solved.solution, z=evaluation.z, evaluation=evaluation)
        return Solved(problem=problem, solution=found, step_error=StepError())
    solution = minimise(
        bound_steps(problem, evaluation),
        evaluation,
        problem.unknowns.low,
        problem.unknowns.high,
        decrement=NEAR,
        max_iterations=ROUGH_ITERATIONS,
        flat=measure_flatness(problem),
        ends=ends,
    )
    return Solved(problem=problem, solution=solution, step_error=StepError())


def measure_misfit(evaluation: Evaluation) -> float:
    """Return a likelihood that does not depend on the sigmas that were assumed; infinite where a plant overflows."""
    if not np.isfinite(evaluation.cost):
        return np.inf
    rows = [(power.squares, power.counts) for power in evaluation.power.values()]
    return float(sum(np.sum(n * np.log(np.maximum(s, 1e-300) / np.maximum(n, 1.0))) for s, n in rows))


def explains_little(problem: FitProblem, power: Mapping[str, ResidualPower]) -> bool:
    """Tell whether the residual of some output is a large part of its spread."""
    return not all(np.all(power[e.name].rms <= UNEXPLAINED * e.spread) for e in problem.experiments)


def estimate_sigma(problem: FitProblem, power: Mapping[str, ResidualPower], z: Vector) -> dict[str, PerOutput]:
    """Return the rms of each residual where sigma is not given; never less than rounding of the signal."""
    sigma: dict[str, PerOutput] = {}
    for experiment in problem.experiments:
        rms = power[experiment.name].rms
        if not problem.loss.quadratic:  # the standard deviation of Gaussian noise under outliers
            weighted = compute_experiment_residuals(experiment, z).weighted
            scales = [1.4826 * float(np.median(np.abs(r[r != 0.0]))) for r in weighted.T]
            rms = np.array(scales) * experiment.sigma
        # A constant output has no size of its own.
        floor = np.maximum(1e-9 * np.where(experiment.spread > 0.0, experiment.spread, 1.0), 1e-300)
        estimated = np.maximum(rms, floor)
        rows = zip(experiment.data.outputs, estimated.tolist(), strict=True)
        sigma[experiment.name] = np.array([experiment.data.sigma.get(name, s) for name, s in rows])
    return sigma
