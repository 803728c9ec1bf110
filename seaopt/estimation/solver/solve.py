"""From a problem to its minimum: starts, rounds of least squares, sigma, and the integration step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.estimation.problem.losses import Linear
from seaopt.estimation.problem.methods import Method
from seaopt.estimation.problem.observer import Observer
from seaopt.estimation.problem.residual_statistics import errors
from seaopt.estimation.problem.residuals import WATCHED, Evaluation, Residuals
from seaopt.estimation.solver.first_guess import first_guess
from seaopt.estimation.solver.least_squares import DECREMENT, Callback, Solution, minimise
from seaopt.estimation.solver.step_size import EXACT, Checks, StepError, checked, refined, started, worst_of
from seaopt.records import record
from seaopt.simulation import Point, Segment, run_passes

MAX_ROUNDS = 12  # of estimating sigma and choosing the step
UNEXPLAINED = 0.2  # of an output's spread: a fit of a nonlinear plant that leaves more looks for another start
ROUGH = 1.0  # squared standard deviations to the minimum, near enough to tell the sigmas
NOISE_DECREMENT = 1e-3  # process noise that is hardly there is a flat direction: Gauss-Newton is slow along it
HELD_REACH = 100.0  # a plant that is held to the log may be moved far at once
FURTHER = 5  # guesses of the frequency responses that are tried at most
PLACES = 48  # over which a nonlinear plant is linearised for its filter


@record(eq=False)
class Solved:
    """A minimum, and the problem with the sigma and the step with which it was found."""

    problem: Residuals
    solution: Solution
    step_error: StepError


def output_error(problem: Residuals, method: Method, callback: Callback | None) -> Solved:
    """Single shooting from the best start that can be found."""
    best, guessed = best_start(problem, method)
    found = settle(problem, best, method.max_iterations, callback) if np.isfinite(best.cost) else None
    if found is not None and not (method.search and _doubtful(found, guessed)):
        return found
    for start in _further(problem, best, guessed, method) if method.search else ():
        other = settle(problem, problem.evaluate(start), method.max_iterations, callback)
        found = other if found is None else min(found, other, key=_misfit)
        if not _doubtful(found, guessed):
            break
    return found if found is not None else settle(problem, best, method.max_iterations, callback)


def _further(
    problem: Residuals, best: Evaluation, guessed: list[Float[np.ndarray, " n"]], method: Method
) -> Iterator[Float[np.ndarray, " n"]]:
    """Yield further starts: held to the log from the given values and from the best, then the other guesses."""
    for start in (problem.unknowns.start, best.z):
        predicted = held_start(problem, start, method.max_iterations)
        if predicted is not None:
            yield predicted
    yield from guessed[1:FURTHER]


def settle(problem: Residuals, start: Evaluation, max_iterations: int, callback: Callback | None) -> Solved:
    """Minimise; estimate the unknown sigmas and refine the step until neither changes."""
    unknowns, iterations = problem.unknowns, 0
    if not np.isfinite(start.cost):
        solution = minimise(problem.evaluate, start, unknowns.low, unknowns.high)
        return Solved(problem=problem, solution=solution, step_error=StepError(output=np.inf))
    problem, here = started(problem, start)
    decrement = DECREMENT if problem.observers is None else NOISE_DECREMENT
    checks: Checks = (None,) * len(problem.experiments)
    rough, before = problem.straight and not explains_little(problem, here), 0.0
    if rough:  # as good a start tells the sigmas well enough to come near the minimum, and there they are told well
        problem = problem.with_sigma(estimated_sigma(problem, here))
        here = problem.assemble(here.origin, here.passes)
    for attempt in range(MAX_ROUNDS):
        solution = minimise(
            problem.evaluate, here, unknowns.low, unknowns.high, decrement=ROUGH if rough else decrement,
            max_iterations=max(max_iterations - iterations, 1), callback=callback,
            follow=problem.followed if problem.straight and attempt else None, before=before,  # in true sigmas
        )  # fmt: skip
        here, iterations = solution.evaluation, iterations + solution.iterations
        if not np.isfinite(here.cost):
            solution = replace(solution, iterations=iterations)
            return Solved(problem=problem, solution=solution, step_error=StepError(output=np.inf))
        sigma = estimated_sigma(problem, here)
        settled = all(np.allclose(new, old, rtol=5e-3) for new, old in zip(sigma, problem.sigma, strict=True))
        steps, problem = problem.substeps, problem.with_sigma(sigma)
        if isinstance(problem.loss, Linear):
            here = problem.assemble(here.origin, here.passes, here.z)  # other sigmas need no other passes
        elif not settled:
            here = problem.evaluate(here.z)
        problem, here, checks = refined(problem, here, checks if settled else (None,) * len(checks))
        done, spent = settled and not rough and problem.substeps == steps, iterations >= max_iterations
        rough, before = False, solution.before
        if done or spent or attempt == MAX_ROUNDS - 1:
            solution = replace(solution, z=here.z, evaluation=here, iterations=iterations)
            if not done and spent:
                message = f"still moving after {iterations} iterations; raise max_iterations or start closer"
                solution = replace(solution, status="max_iterations", message=message)
            elif not done:
                message = f"sigma or the integration step still changes after {MAX_ROUNDS} rounds; give sigma"
                solution = replace(solution, status="stalled", message=message)
            return Solved(problem=problem, solution=solution, step_error=worst_of(checked(problem, here, checks)))
    raise AssertionError  # the last attempt returns


def best_start(problem: Residuals, method: Method) -> tuple[Evaluation, list[Float[np.ndarray, " n"]]]:
    """Return the better of the given values and the best guess of the frequency responses, and all the guesses.

    A guess that matches the responses may still simulate badly: those of a lightly damped mode are blurred, and a mode
    a little off is out of phase after some periods. Held to the log, such a guess finds the mode.
    """
    if not method.search:
        return problem.evaluate(problem.unknowns.start), []
    rng = np.random.default_rng(method.seed)
    guesses, matched = first_guess(problem.experiments, problem.unknowns, problem.band_hz, rng)
    guessed = problem.evaluate(guesses[0]) if guesses else None
    if guessed is not None and matched and not explains_little(problem, guessed):
        return guessed, guesses
    given = problem.evaluate(problem.unknowns.start)
    best = given if guessed is None or guessed.cost > given.cost else guessed
    if matched and explains_little(problem, best):
        held = held_start(problem, guesses[0], method.max_iterations)
        best = best if held is None else min(best, problem.evaluate(held), key=_cost)
    return best, guesses


def _cost(evaluation: Evaluation) -> float:
    return evaluation.cost


def _doubtful(found: Solved, guessed: list[Float[np.ndarray, " n"]]) -> bool:
    """Tell whether another start is worth trying: it did not converge, or a nonlinear plant explains little."""
    if found.solution.status != "converged" or not np.isfinite(found.solution.evaluation.cost):
        return True
    if guessed and all(model.linear for model in found.problem.unknowns.models):
        return False
    return explains_little(found.problem, found.solution.evaluation)


def explains_little(problem: Residuals, evaluation: Evaluation) -> bool:
    """Tell whether the residual of some output is a large part of its spread."""
    for e, experiment in enumerate(problem.experiments):
        for o in range(len(experiment.outputs)):
            spread = float(problem.spread[e][o])
            rms = float(np.sqrt(evaluation.squares[e][o] / max(evaluation.counts[e][o], 1.0)))
            if not rms <= UNEXPLAINED * spread:
                return True
    return False


def _misfit(found: Solved) -> float:
    """Return a likelihood that does not depend on the sigmas that were assumed."""
    evaluation = found.solution.evaluation
    if not np.isfinite(evaluation.cost):
        return np.inf
    rows = zip(evaluation.squares, evaluation.counts, strict=True)
    return float(sum(np.sum(n * np.log(np.maximum(s, 1e-300) / np.maximum(n, 1.0))) for s, n in rows))


def held_start(problem: Residuals, start: Float[np.ndarray, " n"], iterations: int) -> Float[np.ndarray, " n"] | None:
    """Return the minimum of the errors of prediction by a filter of fixed gain, which holds the plant to the log.

    The filter does not trust the plant, so that a plant that is far off predicts badly but cannot run away; its gain
    is made anew from where the state has been, a few times. None where that finds nothing finite.
    """
    problem = replace(problem, substeps=(1,) * len(problem.experiments), loss=Linear(), band_hz=None)
    z = start.copy()
    for _ in range(4):
        watched = with_observers(problem, z, follows=False)
        if watched is None:
            return None
        low, high = problem.unknowns.low, problem.unknowns.high
        solution = minimise(watched.evaluate, z, low, high, reach=HELD_REACH, max_iterations=iterations)
        if not np.isfinite(solution.evaluation.cost):
            return None
        last, z = z, solution.z
        problem = problem.with_sigma(estimated_sigma(watched, solution.evaluation))
        if np.allclose(z, last, rtol=1e-3, atol=0.0):
            break
    return z


def with_observers(problem: Residuals, z: Float[np.ndarray, " n"], *, follows: bool) -> Residuals | None:
    """Return the problem whose residuals are errors of prediction; None where the filter finds no finite state."""
    observers: list[Observer] = []
    for e, experiment in enumerate(problem.experiments):
        spread = problem.spread[e]
        seen = [_watched(problem, e, o) for o in range(len(experiment.outputs))]
        sensors = [noise_of(y, float(s)) for y, s in zip(seen, spread, strict=True)]
        observer = _observer(problem, e, z, np.array(sensors), spread)
        if observer is None:
            return None
        observers.append(replace(observer, follows=follows))
    return replace(problem, observers=tuple(observers))


def _watched(problem: Residuals, e: int, o: int) -> Float[np.ndarray, " n"]:
    """Return the first samples of an output that are not held out."""
    piece = problem.segments[e][0]
    y = piece.y[o][:WATCHED]
    return y[piece.keep[o][:WATCHED] > 0] if piece.keep else y


def noise_of(y: Float[np.ndarray, " n"], spread: float) -> float:
    """Return the standard deviation of white noise on a smooth signal: the median third difference, over sqrt(20)."""
    third = np.abs(np.diff(y[np.isfinite(y)], 3))
    noise = 1.4826 * float(np.median(third)) / np.sqrt(20.0) if third.size else 0.0
    return max(noise, EXACT * spread, 1e-300)


@np.errstate(all="ignore")
def _observer(
    problem: Residuals, e: int, z: Float[np.ndarray, " n"], sensors: Float[np.ndarray, " ny"],
    spread: Float[np.ndarray, " ny"],
) -> Observer | None:  # fmt: skip
    """Return an observer whose sizes and places come from its own estimates of the state, after a few rounds."""
    model, piece, point = problem.unknowns.models[e], problem.segments[e][0], problem.point(e, z)
    places = np.zeros((PLACES, model.nx + model.nu))
    size = _first_size(problem, e, point, spread)
    observer = Observer(size=size, sensors=sensors, places=places, gain=point.gain, follows=False)
    rows = np.linspace(0, min(piece.n, WATCHED) - 1, PLACES).astype(int)
    u, y, keep = (tuple(c[:WATCHED] for c in channels) for channels in (piece.inputs, piece.y, piece.keep))
    short = Segment(u=u, y=y, keep=keep, start_s=piece.start_s)
    for _ in range(3):
        correction = observer.correction(
            model, replace(point, clock=replace(point.clock, delay_free=False)), np.zeros(0)
        )
        if not np.all(np.isfinite(correction)):
            return None
        settings = replace(point, clock=replace(point.clock, delay_free=False), correction=correction)
        states = run_passes(model, short, settings, np.zeros((1, model.nx)), sums=False, states=True).states
        assert states is not None
        if not np.all(np.isfinite(states)):
            return None
        places = np.column_stack([states[rows], *(channel[rows] for channel in short.u)])
        size = np.maximum(np.std(states, axis=0), 1e-9 * np.max(np.abs(size)))
        observer = Observer(size=size, sensors=sensors, places=places, gain=point.gain, follows=False)
    return observer


def _first_size(problem: Residuals, e: int, point: Point, spread: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " nx"]:
    """Return the size of each state that would show as the outputs' spread within ten samples."""
    model = problem.unknowns.models[e]
    observer = Observer(
        size=np.ones(model.nx), sensors=np.ones(model.ny), places=np.zeros((1, model.nx + model.nu)),
        gain=np.ones(model.ny),
    )  # fmt: skip
    a, c = observer.plants(model, point, point.theta[None])
    rows, power = [], np.eye(model.nx)
    for _ in range(10):
        rows.append(np.max(np.abs(c[0] @ power) / spread[:, None], axis=0))
        power = a[0] @ power
    seen = np.max(rows, axis=0)
    return 1.0 / np.where(np.isfinite(seen) & (seen > 0.0), seen, 1.0)


def estimated_sigma(problem: Residuals, found: Evaluation) -> tuple[Float[np.ndarray, " _"], ...]:
    """Return the rms of each residual where sigma is not given; never less than rounding of the signal."""
    out: list[Float[np.ndarray, " ny"]] = []
    robust = None if isinstance(problem.loss, Linear) else _median_scales(problem, found.z)
    for e, experiment in enumerate(problem.experiments):
        row: list[float] = []
        for o, name in enumerate(experiment.outputs):
            rms = float(np.sqrt(found.squares[e][o] / max(found.counts[e][o], 1.0)))
            if robust is not None:
                rms = robust[e][o]
            floor = 1e-9 * (float(problem.spread[e][o]) or 1.0)  # a constant output has no size of its own
            row.append(experiment.sigma.get(name, max(rms, floor, 1e-300)))
        out.append(np.array(row))
    return tuple(out)


def _median_scales(problem: Residuals, z: Float[np.ndarray, " n"]) -> list[list[float]]:
    """Return 1.4826 times the median absolute residual: the standard deviation of Gaussian noise under outliers."""
    found: list[list[float]] = []
    for e, row in enumerate(errors(problem, z)):
        weighted = np.concatenate([error.weighted for error in row])
        used = [weighted[weighted[:, o] != 0.0, o] for o in range(weighted.shape[1])]
        found.append(
            [1.4826 * float(np.median(np.abs(r))) * float(s) for r, s in zip(used, problem.sigma[e], strict=True)]
        )
    return found


def prediction_error(problem: Residuals, method: Method, callback: Callback | None) -> Solved:
    """Prediction errors: first of a filter that hardly trusts the plant, then of one whose noise is estimated."""
    best, _ = best_start(problem, method)
    starts = [best.z] if np.isfinite(best.cost) else []
    found: Solved | None = None
    for start in (*starts, problem.unknowns.start):
        z = held_start(problem, start, method.max_iterations)
        watched = None if z is None else with_observers(problem, z, follows=True)
        if z is None or watched is None:
            continue
        one = settle(watched, watched.evaluate(z), method.max_iterations, callback)
        again = with_observers(one.problem, one.solution.z, follows=True)
        if again is not None and not all(model.linear for model in problem.unknowns.models):
            one = settle(again, again.evaluate(one.solution.z), method.max_iterations, callback)
        found = one if found is None else min(found, one, key=_misfit)
        if found.solution.status == "converged":
            break
    return found if found is not None else settle(problem, best, method.max_iterations, callback)
