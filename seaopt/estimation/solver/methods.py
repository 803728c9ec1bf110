"""The methods of `fit`, which compare a plant with a log: objects with their own options that solve a problem."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from typing import ClassVar

import numpy as np

from seaopt.errors import EstimationError, require_seed
from seaopt.estimation.problem.experiment import check_shots
from seaopt.estimation.problem.fit_problem import Evaluation, FitProblem
from seaopt.estimation.problem.noise_floor import measure_most
from seaopt.estimation.problem.normal_equations import invert
from seaopt.estimation.problem.shapes import Vector
from seaopt.estimation.solver.delay_cells import shift_start
from seaopt.estimation.solver.first_guess import guess_from_responses
from seaopt.estimation.solver.growing import follow_parts
from seaopt.estimation.solver.least_squares import Callback, name_phase
from seaopt.estimation.solver.loosening import loosen_start
from seaopt.estimation.solver.prediction import add_predictors, find_predicting_start
from seaopt.estimation.solver.settle import Solved, explains_little, settle, settle_roughly
from seaopt.estimation.solver.shots import cut_problem, find_start_on_shots, grow_shots
from seaopt.estimation.solver.starts_around import LOST, search_around
from seaopt.records import record

FAR = 10.0  # times its start: a parameter whose standard deviation is larger than itself there has lost its effect
ANOTHER_FIT = 2.0  # residual power in one go, over that on shots, that is no longer the same fit
FURTHER = 5  # guesses of the frequency responses that are tried at most


@record
class Method(ABC):
    """A method of `fit`: a limit of iterations, a search for a start, and a way to solve a problem."""

    key: ClassVar[str]
    models_noise: ClassVar[bool] = False  # with process noise among the unknowns, in place of a band
    remedy: ClassVar[str] = ""  # where it ends badly

    max_iterations: int = 120
    search: bool = True
    seed: int = 0

    @abstractmethod
    def solve(self, problem: FitProblem, callback: Callback | None) -> Solved:
        """Return the minimum, and the problem with the sigma and the step with which it was found."""

    def go_on(self, problem: FitProblem, z: Vector, callback: Callback | None) -> Solved | None:
        """Return the minimum near values that an earlier search has found; None where it explains little."""
        solved = settle(problem, problem.evaluate(z), self.max_iterations, name_phase(callback, "from an earlier fit"))
        return solved if solved.follows_log else None


@record
class OutputError(Method):
    """Single shooting: the plant is simulated over each segment from its initial state.

    Parameters
    ----------
    max_iterations : int
        Of least squares.
    search : bool
        Look for a start: from the logs' frequency responses, over two decades around the given values, and, where that
        fails, by predicting sample by sample with a filter that keeps the simulation near the log. The given
        values are kept where they explain the logs better.
    seed : int
        Of that search.
    """

    key: ClassVar[str] = "output_error"
    remedy: ClassVar[str] = (
        "the simulation may run away: try another method, PredictionError() or MultipleShooting(), method = "
        '"prediction_error" or "multiple_shooting" in [fit]'
    )

    def solve(self, problem: FitProblem, callback: Callback | None) -> Solved:
        """Settle from the best start that can be found."""
        best, guesses = find_start(problem, self, callback)
        best, spent = _approach_waves(problem, best, callback) if self.search else (best, 0)
        if self.search and any(e.model.sticks for e in problem.experiments):
            best, more = _approach_sticking(problem, best, self, callback)
            spent += more
        solved = settle(problem, best, self.max_iterations, callback)
        solved = replace(solved, solution=replace(solved.solution, iterations=spent + solved.solution.iterations))
        if not self.search:
            return solved
        solved = _bring_back(solved, self, callback)
        doubtful = problem.seeks_play or _is_doubtful(solved, guesses)
        for start in _further_starts(problem, best, guesses, self, callback) if doubtful else ():
            evaluation = problem.evaluate(start)
            tell = name_phase(callback, "another start")
            if not _is_hopeless(problem, evaluation, solved, tell):
                other = settle(problem, evaluation, self.max_iterations, tell)
                solved = min(solved, other, key=lambda each: each.misfit)
                if not _is_doubtful(solved, guesses):
                    break
        return search_around(solved, self.seed, self.max_iterations, callback)


@record
class MultipleShooting(Method):
    """Output error whose search begins on shots: each segment is cut, each shot starts from a state of its own.

    For plants that are unstable, or a start far off: a simulation that restarts at intervals cannot diverge. The shots
    grow until one is left: the result is that of `OutputError` wherever both find it. Where the plant diverges in one
    pass the shots keep their own initial states, as the message states: the intervals are then wider.

    Parameters
    ----------
    segments : int
        Shots per log segment; a segment shorter than the longest may have fewer. Each shot needs a sample more than the
        plant has states, and at least four.
    max_iterations, seed
        As in `OutputError`.
    search : bool
        Start from the logs' frequency responses where they explain the logs better than the given values.
    """

    key: ClassVar[str] = "multiple_shooting"

    segments: int = 50

    def __post_init__(self) -> None:
        if self.segments < 1:
            raise EstimationError(f"MultipleShooting(segments={self.segments}): give at least 1")

    def solve(self, problem: FitProblem, callback: Callback | None) -> Solved:
        """Let the shots grow and settle in one go; or on shots of the first length if the plant runs away."""
        for experiment in problem.experiments:
            check_shots(
                experiment.data, experiment.longest, self.segments, f"MultipleShooting(segments={self.segments})"
            )
        start, _ = find_start(problem, self, callback)
        shared, first = problem.unknowns.shared, start.z.copy()
        if self.search and (not np.isfinite(start.cost) or explains_little(problem, start.power)):
            predicting = find_predicting_start(
                problem, first, self.max_iterations, name_phase(callback, "looking for a start")
            )
            first = first if predicting is None else predicting
        z = first.copy()
        for number, theta in enumerate(grow_shots(problem, first, self.segments, callback)):
            if theta is None:
                break
            z[:shared] = theta
            if not number:
                first[:shared] = theta
        _, z = cut_problem(problem, z, 1)
        solved = settle(problem, problem.evaluate(z), self.max_iterations, callback)
        if self.search and solved.follows_log:
            solved = _bring_back(solved, self, callback)
        if solved.follows_log:
            return solved
        if self.search:
            # Shots may follow a log that no input drives; a plant that is simulated in one go cannot.
            other = OutputError(max_iterations=self.max_iterations, seed=self.seed).solve(problem, callback)
            if other.follows_log:
                return other
        apart = self._settle_apart(problem, first, callback)
        return solved if _explains_as_much(solved, apart) else apart

    def _settle_apart(self, problem: FitProblem, z: Vector, callback: Callback | None) -> Solved:
        """Settle on shots that keep initial states of their own, for a plant that runs away in one go."""
        shots, values = cut_problem(problem, z, self.segments)
        for experiment in shots.experiments:
            settle_rows, longest = experiment.weights.settle, experiment.longest
            if longest <= 2 * settle_rows:
                raise EstimationError(
                    f"experiment {experiment.name}: the plant runs away in simulation, and its shots have {longest} "
                    f"samples, of which the band filter takes {settle_rows} to settle; use fewer segments or no band_hz"
                )
        solved = settle(shots, shots.evaluate(values), self.max_iterations, callback)
        message = f"{solved.solution.message}; the plant runs away in one go: shots keep initial states of their own"
        return replace(solved, solution=replace(solved.solution, message=message))


@record
class PredictionError(Method):
    """The residual is the error of the prediction one sample ahead, by a steady-state Kalman filter.

    For plants with noise on the plant itself, not only on the sensors: process noise (one strength per state) over the
    measurement noise is estimated with the parameters, and the filter's gain follows from it and from the plant. The
    measurement noise is taken from the outputs' third differences; together they are scaled by the size of the
    prediction errors. A band is refused: the filter is itself a model of the noise.

    Parameters
    ----------
    max_iterations, seed
        As in `OutputError`.
    search : bool
        Start from the logs' frequency responses where they explain the logs better than the given values.
    """

    key: ClassVar[str] = "prediction_error"
    models_noise: ClassVar[bool] = True

    max_iterations: int = 240

    def solve(self, problem: FitProblem, callback: Callback | None) -> Solved:
        """Settle with a filter that hardly trusts the plant, then with one whose noise is estimated."""
        best, _ = find_start(problem, self, callback)
        solved: Solved | None = None
        follows = problem.all_linear and not explains_little(problem, best.power)
        for start in (*([best.z] if np.isfinite(best.cost) else []), problem.unknowns.start):
            # A plant that already simulates well would be led away: held to the log, it may do without its input.
            tell = name_phase(callback, "looking for a start")
            z = (
                best.z
                if follows and start is best.z
                else find_predicting_start(problem, start, self.max_iterations, tell)
            )
            other = None if z is None else self._settle_predicting(problem, z, callback)
            if other is not None and (solved is None or other.misfit < solved.misfit):
                solved = other
            if solved is not None and solved.solution.status == "converged":
                break
        if self.search and (solved is None or _simulates_badly(solved)):
            simulated = OutputError(max_iterations=self.max_iterations, seed=self.seed).solve(problem, callback)
            if not _simulates_badly(simulated):
                solved = self._settle_predicting(problem, simulated.solution.z, callback) or solved
        return solved if solved is not None else settle(problem, best, self.max_iterations, callback)

    def go_on(self, problem: FitProblem, z: Vector, callback: Callback | None) -> Solved | None:
        """Return the minimum of the errors of prediction near such values; None where it simulates badly."""
        solved = self._settle_predicting(problem, z, callback)
        return None if solved is None or _simulates_badly(solved) else solved

    def _settle_predicting(self, problem: FitProblem, start: Vector, callback: Callback | None) -> Solved | None:
        """Return the minimum of the errors of prediction near a start; None where no filter is found."""
        predicting = add_predictors(problem, start, follows=True)
        if predicting is None:
            return None
        solved = settle(predicting, predicting.evaluate(start), self.max_iterations, callback)
        again = add_predictors(solved.problem, solved.solution.z, follows=True)
        if again is not None and not problem.all_linear:
            solved = settle(again, again.evaluate(solved.solution.z), self.max_iterations, callback)
        return solved


def find_start(
    problem: FitProblem, method: Method, callback: Callback | None = None
) -> tuple[Evaluation, list[Vector]]:
    """Return the better of the given values and the best guess of the frequency responses, and all the guesses. A guess
    that matches the responses may still simulate badly: those of a lightly damped mode are blurred, and a mode a little
    off is out of phase after some periods. On short shots, or held to the log, such a guess finds the mode.
    """
    if not method.search or not problem.unknowns.shared:
        return loosen_start(problem, problem.evaluate(problem.unknowns.start)), []
    rng = np.random.default_rng(require_seed(method.seed, EstimationError))
    guesses, matched = guess_from_responses(problem, rng)
    waves = _list_waves(problem, sizes=True)  # no response shows them
    for guess in guesses:
        guess[waves] = problem.unknowns.start[waves]
    guessed = problem.evaluate(guesses[0]) if guesses else None
    if guessed is not None and matched and not explains_little(problem, guessed.power):
        return guessed, guesses
    first = shift_start(problem, problem.evaluate(problem.unknowns.start))
    best = loosen_start(problem, first if guessed is None or guessed.cost > first.cost else guessed)
    if guesses and (matched or problem.all_linear) and explains_little(problem, best.power):
        callback = name_phase(callback, "looking for a start")
        # Of a linear plant the best initial states of shots follow from one evaluation.
        z = (
            find_start_on_shots(problem, guesses[0], callback)
            if problem.all_linear
            else find_predicting_start(problem, guesses[0], method.max_iterations, callback)
        )
        best = best if z is None else min(best, problem.evaluate(z), key=lambda each: each.cost)
    return best, guesses


def _approach_waves(problem: FitProblem, start: Evaluation, callback: Callback | None) -> tuple[Evaluation, int]:
    """Return a rough minimum at the given numbers of waves, and its iterations; the start where none is better. While
    other values are far off the number follows what they leave, to one from which nothing leads back.
    """
    places = _list_waves(problem)
    if not places or not np.isfinite(start.cost):
        return start, 0
    held = replace(problem, unknowns=problem.unknowns.bound(places, start.z[places], start.z[places]))
    rough = settle_roughly(held, held.evaluate(start.z), name_phase(callback, "looking for a start"))
    found = problem.evaluate(rough.solution.z)
    return found if found.cost <= start.cost else start, rough.solution.iterations


def _list_waves(problem: FitProblem, *, sizes: bool = False) -> list[int]:
    """Return where the numbers of waves stand among the unknowns, with or without their sizes."""
    readings = [reading for e in problem.experiments for reading in e.model.plant.followed.values()]
    names = {name for each in readings for name in (each.wave, *(each.sizes if sizes else ()))}
    return [i for i, name in enumerate(problem.unknowns.names) if name.rpartition(".")[2] in names]


def _approach_sticking(
    problem: FitProblem, start: Evaluation, method: Method, callback: Callback | None
) -> tuple[Evaluation, int]:
    """Return a start that is far off followed over growing parts of the logs, where that leaves noise; or else, of one
    that explains little, the better of a rough minimum from it and, where that explains little too, one from where the
    plant predicts; and the iterations of rough minima. Where joints move at other times than in the log the cost has
    many minima, none of which explains it: a search that went all the way would creep.
    """
    roughly, finite = name_phase(callback, "looking for a start"), bool(np.isfinite(start.cost))
    if finite and measure_most(problem, start.z) > LOST:
        followed = follow_parts(problem, start, roughly)
        if followed is not None:
            return followed, 0
    if not explains_little(problem, start.power):
        return start, 0
    minima = [settle_roughly(problem, start, roughly)] if finite else []
    if not minima or explains_little(minima[0].problem, minima[0].solution.evaluation.power):
        z = find_predicting_start(problem, start.z, method.max_iterations, roughly)
        predicting = None if z is None else problem.evaluate(z)
        if predicting is not None and np.isfinite(predicting.cost):
            minima.append(settle_roughly(problem, predicting, roughly))
    if not minima:
        return start, 0
    best = min(minima, key=lambda each: each.misfit)
    return problem.evaluate(best.solution.z), sum(each.solution.iterations for each in minima)


def _bring_back(solved: Solved, method: Method, callback: Callback | None) -> Solved:
    """Return the better of a minimum and one from where parameters that lost their effect are at their start again. So
    friction's fall over a speed that becomes tiny: nothing brings it back, and the others have taken its place.
    """
    problem, evaluation, shared = solved.problem, solved.solution.evaluation, solved.problem.unknowns.shared
    if not np.isfinite(evaluation.cost) or not np.all(np.isfinite(evaluation.hessian)):
        return solved
    start, z = problem.unknowns.start[:shared], solved.solution.z[:shared]
    variances = np.diag(invert(evaluation.hessian)[0])[:shared]
    far = (np.abs(z) < np.abs(start) / FAR) | (np.abs(z) > FAR * np.abs(start))
    lost = np.flatnonzero(far & (start != 0.0) & (variances > z**2))
    if not lost.size:
        return solved
    again = solved.solution.z.copy()
    again[lost] = start[lost]
    other = settle(problem, problem.evaluate(again), method.max_iterations, name_phase(callback, "another start"))
    return min(solved, other, key=lambda each: each.misfit)


def _explains_as_much(solved: Solved, other: Solved) -> bool:
    """Tell whether a minimum has converged and leaves about as much of the logs as another: both see noise alone."""
    power, least = solved.solution.evaluation.power, other.solution.evaluation.power
    return solved.solution.status == "converged" and all(
        np.all(power[name].rms ** 2 < ANOTHER_FIT * least[name].rms ** 2) for name in least
    )


def _simulates_badly(solved: Solved) -> bool:
    """Tell whether a minimum explains little in free run, whatever it predicts one sample ahead."""
    simulating = solved.problem.with_each(predictor=None)
    return explains_little(simulating, simulating.evaluate(solved.solution.z).power)


def _is_doubtful(solved: Solved, guesses: list[Vector]) -> bool:
    """Tell whether another start is worth trying: it did not converge, or a nonlinear plant explains little."""
    evaluation = solved.solution.evaluation
    if solved.solution.status != "converged" or not np.isfinite(evaluation.cost):
        return True
    if guesses and solved.problem.all_linear:
        return False
    return explains_little(solved.problem, evaluation.power)


def _is_hopeless(problem: FitProblem, start: Evaluation, best: Solved, callback: Callback | None) -> bool:
    """Tell whether a start, settled roughly, explains little and no more than the best: most that go astray stay so. To
    find its minimum all the same takes the longest: where nothing is explained the search creeps, and simulations that
    run away ask for ever finer steps.
    """
    if not np.isfinite(best.misfit):
        return False
    rough = settle_roughly(problem, start, callback)
    evaluation = rough.solution.evaluation
    astray = np.isfinite(evaluation.cost) and rough.misfit >= best.misfit
    return bool(astray) and explains_little(rough.problem, evaluation.power)


def _further_starts(
    problem: FitProblem, best: Evaluation, guesses: list[Vector], method: Method, callback: Callback | None
) -> Iterator[Vector]:
    """Yield further starts: predicting from the given values and from the best, then the other guesses."""
    for start in (problem.unknowns.start, best.z):
        tell = name_phase(callback, "another start")
        predicting = find_predicting_start(problem, start, method.max_iterations, tell)
        if predicting is not None:
            yield predicting
    yield from guesses[1:FURTHER]
