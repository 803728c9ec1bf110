"""Fit plants to logs: one call from experiments to parameters with their uncertainty.

`fit` is the door of this package, and its body the way through it: experiments are checked and become a least-squares
problem (`seaopt.estimation.problem`), a method finds a start and the minimum (`solver`), the minimum becomes a result
with covariance and identifiability (`result`), and the result is judged: does it explain its logs, and what would
explain them better (`judgement`)?
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from seaopt.errors import EstimationError, require_type
from seaopt.estimation.judgement.judge import CAUSES, TESTS, judge
from seaopt.estimation.judgement.score_test import free_fixed
from seaopt.estimation.problem.experiment import Experiment, check_shots, is_constant
from seaopt.estimation.problem.fit_experiment import MAX_SUBSTEPS, FitExperiment
from seaopt.estimation.problem.fit_problem import FitProblem, count_evaluations, pose_problem
from seaopt.estimation.problem.losses import Huber, Loss, SoftL1, Squares
from seaopt.estimation.result.findings import find_guesses, find_sharp_friction, find_unjudged, order_findings
from seaopt.estimation.result.fit_result import Fit
from seaopt.estimation.result.summary import summarise
from seaopt.estimation.solver.delay_cells import search_delays
from seaopt.estimation.solver.least_squares import Callback
from seaopt.estimation.solver.methods import Method, OutputError
from seaopt.estimation.solver.settle import Solved
from seaopt.estimation.solver.step_size import hold_bristles
from seaopt.formatting import tell_apart
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import can_stick, let_stick, list_smoothing
from seaopt.plants.motor.thermal import list_guessed_heat
from seaopt.plants.plant import require_plant
from seaopt.progress import Progress, divide, ignore
from seaopt.simulation import keep_passes
from seaopt.simulation.simulate import input_samples
from seaopt.units import unit_after

SEARCH, JUDGEMENT = 1.0, TESTS + CAUSES  # of the time of a fit that goes wrong, at most; one that does not ends early
# How many iterations follow is unknown; from here on what the judgement may take is a scale.
SCALED = (SEARCH + TESTS) / (SEARCH + JUDGEMENT)
USUAL_ITERATIONS = 10  # of a whole fit
SLOW_STEPS, SLOW = 2.0, 1e5  # steps in a sample, and in a pass, from which smoothed friction is said to be slow
SHARP_STEPS = 8.0  # in a sample, from which so slow a friction is fitted as it jumps


def fit(
    experiments: Sequence[Experiment],
    params: ParameterSet,
    *,
    method: Method | None = None,
    loss: Loss | None = None,
    band_hz: tuple[float, float] | None = None,
    holdout: float = 0.0,
    diagnostics: bool = True,
    causes: bool = True,
    alternatives: Sequence[Plant] = (),
    validation: Sequence[Experiment] = (),
    start: Fit | None = None,
    keep: Callable[[Fit], object] | None = None,
    progress: Progress = ignore,
) -> Fit:
    """Fit the free parameters of `params` to one or several experiments that share them.

    Parameters
    ----------
    experiments : sequence of Experiment
        Logs with their plants.
    params : ParameterSet
        Values, bounds and priors; the free ones are estimated, from anywhere within a factor of ten. With none free
        the logs are scored.
    method : OutputError, MultipleShooting or PredictionError, optional
        How the plant is compared with a log; OutputError if left out.
    loss : Squares, Huber or SoftL1, optional
        Least squares if left out.
    band_hz : (low, high), optional
        Residuals are weighted to this band.
    holdout : float
        The last fraction of each log is kept back, for validation.
    diagnostics : bool
        False leaves out what needs the residuals of every sample: the stds are then those for white residuals, the
        outputs' figures are missing, and the fit is not judged.
    causes : bool
        False leaves out the search for what the model lacks, which takes most of the time of a fit that leaves
        something; the fit's findings say so, and it is not met where it leaves what asks for the search.
    alternatives : sequence of Plant
        Other plants that may have been on the bench: where a log is not explained, they are tried.
    validation : sequence of Experiment
        Logs that are not fitted: each is refitted alone, and what its values differ by is in the model's std.
    start : Fit, optional
        An earlier fit of the same plants, of fewer logs: the search goes on from its values and delays, without looking
        for a start, and looks for one where what it comes to explains little. Priors stay where `params` has them.
    keep : callable, optional
        Called with the fit before it is judged, which may take several times as long as its search; it is not met.
    progress : callable, optional
        Called with what is done and the share of it that is done (`seaopt.progress.Progress`): each iteration, each
        cause that is tried; and without a share where the search could be quicker.

    Returns
    -------
    Fit
        With status "not_identifiable" when the data do not determine some direction; it then holds what they do
        determine.

    Raises
    ------
    EstimationError
        The fit is not well posed: no samples, a free parameter that no plant has.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.bench import PAPER_STAND, Sensors, virtual_log
    >>> plant, truth = so.plants.high_impedance(), so.plants.thor()
    >>> log = virtual_log(plant, truth, PAPER_STAND, duration_s=20, rate_hz=400, seed=1,
    ...                   sensors=Sensors(noise_std={"F1": 2.0, "F2": 2.0}))
    >>> experiment = so.Experiment(plant=plant, log=log, outputs=("F1", "F2"))
    >>> result = so.fit([experiment], truth.update(J=1e-6, b_r=5e-4).free("J", "b_r"))
    >>> result.status, abs(result.parameters["J"].value / 3.31e-6 - 1) < 0.001
    ('converged', True)
    """
    started = time.perf_counter()
    chosen = method if method is not None else OutputError()
    named = _name_apart(experiments)
    if not 0.0 <= holdout <= 0.9:
        raise EstimationError(f"holdout = {holdout:g} is not a fraction; give 0 (none) to 0.9")
    check_choices(chosen, loss, band_hz)
    band = None if band_hz is None else (band_hz[0], band_hz[1])  # a list is taken, too
    if start is not None:
        require_type(start, Fit, "start", "give an earlier fit", EstimationError)
    _check_differences(named, chosen)
    _check_motion(named)
    problem = pose_problem(
        named,
        params,
        loss=loss if loss is not None else Squares(),
        band_hz=band,
        holdout=holdout,
        noise=chosen.models_noise,
    )
    _check_samples(problem)
    _check_stiffness(problem)
    sharp = _list_sharp(problem)
    for experiment, steps in _list_slow(problem):
        progress(_say_slow(experiment, steps, switched=experiment.name in sharp))
    problem = _let_stick(problem, sharp)
    searching, judging = divide(progress, SEARCH, JUDGEMENT if diagnostics else 0.0)
    searching("looking for a start", 0.0)
    callback = _count_iterations(searching)
    before = count_evaluations()
    with keep_passes():
        solved = None if start is None else _go_on(problem, start, chosen, callback)
        solved = solved or chosen.solve(hold_bristles(problem, problem.unknowns.start), callback)
        solved = search_delays(solved, chosen.max_iterations, callback)
        evaluations = count_evaluations() - before
        # Its passes serve all that follows.
        freed = free_fixed(solved.problem, solved.solution.z) if diagnostics else None
        result = summarise(solved, chosen, diagnostics, started)
        if keep is not None:
            keep(replace(result, findings=order_findings((*result.findings, find_unjudged()))))
        if diagnostics:
            judged = judge(
                result, alternatives, judging, validation, causes=causes, evaluations=evaluations, freed=freed
            )
            result = _name_guesses(judged, named, params)
    result = replace(result, validation=tuple(validation), holdout=holdout)
    if sharp:
        result = replace(result, findings=order_findings((*result.findings, *map(find_sharp_friction, sharp))))
    progress(f"{result.samples} samples, {result.iterations} iterations, {result.status.replace('_', ' ')}", 1.0)
    return result


def _go_on(problem: FitProblem, earlier: Fit, method: Method, callback: Callback) -> Solved | None:
    """Return the minimum near an earlier fit's values; None where it explains little."""
    values = {name: earlier.parameters[name].value for name in earlier.covariance.names}
    by_plant = {each.plant: each for each in earlier.nuisance.values()}
    for experiment in problem.experiments:
        name, plant = experiment.name, experiment.data.plant.name
        nuisance = earlier.nuisance.get(name, by_plant.get(plant))
        if nuisance is None:
            continue
        values[f"{name}.delay_s"] = nuisance.delay_s
        values |= {f"{name}.gain.{output}": gain for output, gain in nuisance.gain.items()}
        for number, states in enumerate(nuisance.initial_state if name in earlier.nuisance else ()):
            label = f"{name}.initial{number + 1 if number else ''}"
            values |= {f"{label}.{state}": value for state, value in states.items()}
    unknowns = problem.unknowns
    z = np.clip(unknowns.start_from(values), unknowns.low, unknowns.high)
    return method.go_on(hold_bristles(problem, z), z, callback)


def _name_guesses(result: Fit, experiments: tuple[Experiment, ...], params: ParameterSet) -> Fit:
    """Return a fit that names the parameters of a motor's heat that were left at their defaults."""
    names = [name for e in experiments for name in list_guessed_heat(e.plant, {*params, *e.parameters})]
    guesses = find_guesses(list(dict.fromkeys(names)))
    return replace(result, findings=order_findings((*result.findings, *guesses))) if guesses else result


def _count_iterations(progress: Progress) -> Callback:
    """Return what counts the iterations of all searches of a fit; as many as usual are expected to follow."""
    count = 0

    def tell(where: str, cost: float) -> None:
        nonlocal count
        count += 1
        progress(f"{where}, iteration {count}, cost {cost:.6g}", count / (count + USUAL_ITERATIONS))

    return tell


def check_choices(method: Any, loss: Any, band_hz: Any) -> None:
    """Refuse what is not a method, a loss or a band."""
    if not isinstance(method, Method):
        raise EstimationError(
            f"method = {method!r} is not a valid method; expected one of OutputError(), MultipleShooting(), "
            "PredictionError()"
        )
    if loss is not None and not isinstance(loss, Squares | Huber | SoftL1):
        raise EstimationError(f"loss = {loss!r} is not a valid loss; expected one of Squares(), Huber(), SoftL1()")
    if band_hz is not None and (not isinstance(band_hz, tuple | list) or len(band_hz) != 2):
        raise EstimationError(f"band_hz = {band_hz!r} is not a band; give (low, high) in Hz")
    if band_hz is not None and method.models_noise:
        raise EstimationError(
            f"band_hz = {band_hz!r} does not go with {type(method).__name__}, whose filter models the noise; leave it "
            "out"
        )


def _check_differences(experiments: tuple[Experiment, ...], method: Method) -> None:
    """Refuse speeds by difference where the noise is taken for white: a difference has each position's noise twice."""
    for experiment in experiments if method.models_noise else ():
        if experiment.differences:
            raise EstimationError(
                f"experiment {experiment.name}: differences do not go with {type(method).__name__}(), whose filter "
                "takes each reading's noise for independent of the last; use OutputError() or MultipleShooting(), or "
                "fit the position itself"
            )


def _name_apart(experiments: Sequence[Experiment]) -> tuple[Experiment, ...]:
    """Return the experiments under names of their own."""
    if isinstance(experiments, Experiment):
        raise EstimationError("fit takes a list of experiments; put the experiment in brackets, [experiment]")
    if not experiments:
        raise EstimationError("no experiment is given; give at least one Experiment(plant=..., log=...)")
    require_type(experiments, Sequence, "experiments", "give a list of Experiment", EstimationError)
    for index, experiment in enumerate(experiments):
        require_type(experiment, Experiment, f"experiments[{index}]", "give an Experiment", EstimationError)
        require_plant(experiment.plant, f"experiments[{index}]", EstimationError)
    named: dict[str, Experiment] = {}
    for experiment in experiments:
        name = tell_apart(experiment.name, named)
        named[name] = experiment if name == experiment.name else experiment.rename(name)
    return tuple(named.values())


def _check_motion(experiments: tuple[Experiment, ...]) -> None:
    """Refuse logs in which no output moves, or that nothing drives: parameters would fit whatever they are."""
    where = ", ".join(f"experiment {experiment.name} ({experiment.log.source})" for experiment in experiments)
    first = experiments[0]
    if all(is_constant(e.log[name]) for e in experiments for name in e.outputs):
        raise EstimationError(
            f"{where}: {' and '.join(first.outputs)} constant throughout, nothing can be learnt from that; check the "
            "wiring, or choose another column"
        )
    for e in experiments:
        for name in e.outputs:
            if name not in e.sigma and is_constant(e.log[name]):
                raise EstimationError(
                    f"experiment {e.name} ({e.log.source}): output {name} is constant throughout, so that its noise "
                    "cannot be estimated and it would take all the weight; leave it out of outputs, or give its sigma"
                )
    still = all(e.plant.inputs and all(is_constant(u) for u in input_samples(e.plant, e.log)) for e in experiments)
    if still and all(experiment.initial_state == "estimate" for experiment in experiments):
        raise EstimationError(
            f"{where}: {' and '.join(first.plant.inputs)} constant throughout, nothing drives the plant; choose "
            'another column, or say where it starts: initial_state = "rest", or a mapping'
        )


def _list_slow(problem: FitProblem) -> Iterator[tuple[FitExperiment, float]]:
    """Yield experiments whose smoothed friction makes a search slow, and their steps in a sample."""
    for experiment in problem.experiments:
        plant, steps = experiment.data.plant, experiment.count_stable_steps(problem.unknowns.start)
        slow = steps >= SLOW_STEPS and steps * experiment.samples >= SLOW
        if slow and can_stick(plant) and not plant.sticks:
            yield experiment, steps


def _say_slow(experiment: FitExperiment, steps: float, *, switched: bool) -> str:
    speeds = " and ".join(list_smoothing(experiment.data.plant))
    remedy = "it is fitted as it jumps at rest" if switched else "where the joint sticks, sticks = true is quicker"
    return (
        f"experiment {experiment.name}: friction smoothed over {speeds} takes {math.ceil(steps)} steps in each of "
        f"{experiment.samples} samples; {remedy} (so.plants.let_stick)"
    )


def _list_sharp(problem: FitProblem) -> list[str]:
    """Return experiments whose friction is smoothed so sharply that a fit would take minutes.

    There are none where a smoothing speed is free: it is searched for.
    """
    return [] if problem.find_smoothing() else [e.name for e, steps in _list_slow(problem) if steps >= SHARP_STEPS]


def _let_stick(problem: FitProblem, names: Sequence[str]) -> FitProblem:
    """Return the problem with friction that jumps in some experiments."""
    data = {e.name: replace(e.data, plant=let_stick(e.data.plant)) for e in problem.experiments if e.name in names}
    return problem.rebuild(problem.params, problem.unknowns.start, data)[0] if data else problem


def _check_stiffness(problem: FitProblem) -> None:
    """Refuse friction that is too sharp to be simulated; where its smoothing speed is free, the search raises that."""
    for experiment in () if problem.find_smoothing() else problem.experiments:
        steps, plant = experiment.count_stable_steps(problem.unknowns.start), experiment.data.plant
        if steps <= MAX_SUBSTEPS:
            continue
        speeds = plant.complete(experiment.data.apply_own(problem.params))
        sharp = [
            f"give {n} = {speeds[n].value * steps / MAX_SUBSTEPS:.1e}{unit_after(speeds[n].unit)} or more in place of "
            f"{speeds[n].value:.1g}, or free it"
            for n in list_smoothing(plant)
        ]
        raise EstimationError(
            f"experiment {experiment.name}: {plant.name} is so stiff near rest that each sample takes {steps:.2g} "
            f"integration steps, and {MAX_SUBSTEPS} are the most; {' and '.join(sharp) or 'smooth what is sharp'}"
        )


def _check_samples(problem: FitProblem) -> None:
    """Refuse outputs of which no sample counts, and segments and shots that are too short."""
    for experiment in problem.experiments:
        settle, data = experiment.weights.settle, experiment.data
        for name, count in zip(data.outputs, experiment.count_weighted(), strict=True):
            if not count:
                raise EstimationError(
                    f"experiment {experiment.name}: output {name} has no sample that counts; "
                    "leave it out of outputs, or keep back less (holdout)"
                )
        whole = max(rows.stop - rows.start for rows in data.log_segments)
        check_shots(data, whole, data.shots, f"shots = {data.shots}")
        if experiment.longest <= settle + 2:
            raise EstimationError(
                f"experiment {experiment.name}: its longest segment has {experiment.longest} samples"
                + (f" and the band filter takes {settle} to settle; widen band_hz or" if settle else ";")
                + " use a longer log"
            )
