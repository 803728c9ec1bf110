"""Fit plants to logs: one call from experiments to parameters with their uncertainty."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.errors import EstimationError
from seaopt.estimation.covariance import Covariance, Identifiability, counted, identifiability, posterior, sandwich
from seaopt.estimation.experiment import Experiment
from seaopt.estimation.first_guess import first_guess
from seaopt.estimation.least_squares import Callback, Solution, minimise
from seaopt.estimation.residuals import Evaluation, Huber, Linear, Loss, Residuals
from seaopt.estimation.result import Derived, Fit, Nuisance, OutputFit
from seaopt.estimation.unknowns import Unknowns, collect
from seaopt.parameters import Parameter, ParameterSet

STEP_ERROR_SIGMA = 0.01  # integration error allowed in an output, in sigma
MAX_SUBSTEPS = 256
VAGUE = 3.0  # a std of so many times the value is no estimate
MAX_ROUNDS = 12  # of estimating sigma and choosing the step


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputError:
    """Single shooting: the plant is simulated over each segment from its initial state.

    Parameters
    ----------
    max_iterations : int
        Of least squares.
    search : bool
        Look for a start from the logs' frequency responses, over two decades around the given values; the given
        values are kept where they explain the logs better.
    seed : int
        Of that search.

    """

    max_iterations: int = 60
    search: bool = True
    seed: int = 0


def fit(
    experiments: Sequence[Experiment],
    params: ParameterSet,
    *,
    method: OutputError | None = None,
    loss: Loss | None = None,
    band_hz: tuple[float, float] | None = None,
    holdout: float = 0.0,
    callback: Callback | None = None,
) -> Fit:
    """Fit the free parameters of `params` to one or several experiments that share them.

    Parameters
    ----------
    experiments : sequence of Experiment
        Logs with their plants.
    params : ParameterSet
        Values, bounds and priors; the free ones are estimated, from anywhere within a factor of ten.
    method : OutputError, optional
        How the plant is compared with a log.
    loss : Linear or Huber, optional
        Least squares if left out.
    band_hz : (low, high), optional
        Residuals are weighted to this band.
    holdout : float
        The last fraction of each log is kept back, for validation.
    callback : callable, optional
        Called with (iteration, cost).

    Returns
    -------
    Fit
        With status "not_identifiable" when the data cannot tell some direction; it then holds what can be told.

    Raises
    ------
    EstimationError
        The fit is not well posed: nothing free, no samples, a free parameter that no plant has.

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
    named = _named(experiments)
    if not 0.0 <= holdout < 1.0:
        raise EstimationError(f"holdout = {holdout:g} is not a fraction; give 0 (none) to 0.9")
    complete = _complete(named, params)
    unknowns = collect(named, complete)
    problem = _problem(named, unknowns, loss if loss is not None else Linear(), band_hz, holdout)
    start = _start(problem, chosen, band_hz)
    solution, problem, step_error = _solve(problem, start, chosen, callback)
    return _result(named, complete, problem, solution, step_error, holdout, started)


def _named(experiments: Sequence[Experiment]) -> tuple[Experiment, ...]:
    """Return the experiments under names of their own."""
    if isinstance(experiments, Experiment):
        raise EstimationError("fit takes a list of experiments; put the experiment in brackets, [experiment]")
    if not experiments:
        raise EstimationError("no experiment is given; give at least one Experiment(plant=..., log=...)")
    seen: set[str] = set()
    out: list[Experiment] = []
    for experiment in experiments:
        name, number = experiment.name, 1
        while name in seen:
            number += 1
            name = f"{experiment.name}{number}"
        seen.add(name)
        out.append(experiment if name == experiment.name else experiment.renamed(name))
    return tuple(out)


def _complete(experiments: tuple[Experiment, ...], params: ParameterSet) -> ParameterSet:
    """Return every parameter of the plants, in order, and the free ones that no plant has (an error later)."""
    items: dict[str, Parameter] = {}
    for experiment in experiments:
        for name, item in experiment.plant.complete(params).items():
            items.setdefault(name, item)
    for name in params.free_names:
        items.setdefault(name, params[name])
    return ParameterSet(items.values())


def _problem(
    experiments: tuple[Experiment, ...], unknowns: Unknowns, loss: Loss, band_hz: tuple[float, float] | None,
    holdout: float,
) -> Residuals:  # fmt: skip
    segments = tuple(tuple(experiment.segments(holdout)) for experiment in experiments)
    sigma: list[Float[np.ndarray, " ny"]] = []
    for experiment in experiments:
        spread = [float(np.nanstd(experiment.log[name])) for name in experiment.outputs]
        known = [experiment.sigma.get(name, s or 1.0) for name, s in zip(experiment.outputs, spread, strict=True)]
        sigma.append(np.array(known))
    problem = Residuals(
        experiments=experiments, segments=segments, unknowns=unknowns, sigma=tuple(sigma), loss=loss, band_hz=band_hz,
        substeps=(1,) * len(experiments),
    )  # fmt: skip
    for e, experiment in enumerate(experiments):
        settle = problem.weights(e).settle
        longest = max(segment.u.shape[0] for segment in segments[e])
        if longest <= settle + 8:
            raise EstimationError(
                f"experiment {experiment.name}: its longest segment has {longest} samples and the band filter takes "
                f"{settle} to settle; widen band_hz or use a longer log"
            )
    return problem


def _start(problem: Residuals, method: OutputError, band_hz: tuple[float, float] | None) -> Float[np.ndarray, " n"]:
    """Return the better of the given values and those that match the frequency responses."""
    given = problem.unknowns.start
    if not method.search:
        return given
    guess = first_guess(problem.experiments, problem.unknowns, band_hz, np.random.default_rng(method.seed))
    if guess is None:
        return given
    return guess if problem.evaluate(guess).cost <= problem.evaluate(given).cost else given


def _solve(
    problem: Residuals, start: Float[np.ndarray, " n"], method: OutputError, callback: Callback | None
) -> tuple[Solution, Residuals, float]:
    """Minimise; estimate the unknown sigmas and refine the step until neither changes."""
    unknowns, z, iterations = problem.unknowns, start, 0
    problem, error = _refined(problem, z, 0.1)
    for attempt in range(MAX_ROUNDS):
        solution = minimise(
            problem.evaluate,
            z,
            unknowns.low,
            unknowns.high,
            reach=_reach(unknowns, start),
            max_iterations=method.max_iterations,
            callback=callback,
        )
        z, iterations = solution.z, iterations + solution.iterations
        updated = _estimated_sigma(problem, solution.evaluation, z)
        settled = all(np.allclose(new, old, rtol=5e-3) for new, old in zip(updated, problem.sigma, strict=True))
        finer, error = _refined(problem.with_sigma(updated), z, STEP_ERROR_SIGMA)
        if (settled and finer.substeps == problem.substeps) or attempt == MAX_ROUNDS - 1:
            return replace(solution, iterations=iterations), problem, error
        problem = finer
    raise AssertionError  # the last attempt returns


def _reach(unknowns: Unknowns, start: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the size of the plants' parameters, and infinity for what starts at zero and the experiments' own."""
    reach = np.full(start.size, np.inf)
    shared = np.abs(start[: unknowns.shared])
    reach[: unknowns.shared] = np.where(shared > 0.0, shared, np.inf)
    return reach


def _estimated_sigma(
    problem: Residuals, found: Evaluation, z: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " ny"], ...]:
    """Return the rms of each residual where sigma is not given; never less than rounding of the signal."""
    out: list[Float[np.ndarray, " ny"]] = []
    for e, experiment in enumerate(problem.experiments):
        row: list[float] = []
        for o, name in enumerate(experiment.outputs):
            rms = float(np.sqrt(found.squares[e][o] / max(found.counts[e][o], 1.0)))
            if isinstance(problem.loss, Huber):
                rms = _median_scale(problem, e, o, z)
            floor = 1e-9 * float(np.nanmax(np.abs(experiment.log[name])))
            row.append(experiment.sigma.get(name, max(rms, floor, 1e-300)))
        out.append(np.array(row))
    return tuple(out)


def _median_scale(problem: Residuals, e: int, o: int, z: Float[np.ndarray, " n"]) -> float:
    """Return 1.4826 times the median absolute residual: the standard deviation of Gaussian noise under outliers."""
    sizes: list[Float[np.ndarray, " m"]] = []
    for s in range(len(problem.segments[e])):
        columns = problem.run(e, s, z, columns=True).columns
        assert columns is not None
        present = counted(problem, e, s, problem.weights(e).settle)[:, o] > 0.0
        sizes.append(np.abs(columns[present, o, 0]))
    return 1.4826 * float(np.median(np.concatenate(sizes)))


def _refined(problem: Residuals, z: Float[np.ndarray, " n"], allowed: float) -> tuple[Residuals, float]:
    """Return the problem with integration steps whose error is below `allowed` sigma, and that error."""
    substeps = list(problem.substeps)
    worst = 0.0
    for e, model in enumerate(problem.unknowns.models):
        if model.linear:
            continue
        while True:
            error = _step_error(replace(problem, substeps=tuple(substeps)), e, z)
            if error <= allowed or substeps[e] >= MAX_SUBSTEPS:
                break
            substeps[e] *= 2
        worst = max(worst, error)
    return replace(problem, substeps=tuple(substeps)), worst


def _step_error(problem: Residuals, e: int, z: Float[np.ndarray, " n"]) -> float:
    """Return the largest difference to steps of half the length, in sigma, over 15/16: order four."""
    halved = replace(problem, substeps=tuple(2 * m if i == e else m for i, m in enumerate(problem.substeps)))
    worst = 0.0
    for s in range(len(problem.segments[e])):
        coarse, fine = problem.run(e, s, z, outputs=True).outputs, halved.run(e, s, z, outputs=True).outputs
        assert coarse is not None and fine is not None
        with np.errstate(invalid="ignore"):
            error = float(np.max(np.abs(coarse - fine) / problem.sigma[e])) * 16.0 / 15.0
            worst = max(worst, error if np.isfinite(error) else np.inf)
    return worst


def _result(
    experiments: tuple[Experiment, ...], params: ParameterSet, problem: Residuals, solution: Solution,
    step_error: float, holdout: float, started: float,
) -> Fit:  # fmt: skip
    unknowns, z, p = problem.unknowns, solution.z, problem.unknowns.shared
    evaluation = problem.evaluate(z)
    if not np.isfinite(evaluation.cost):
        raise EstimationError(f"the fit has no finite cost: {solution.message}")
    parts = sandwich(problem, z)
    prior = unknowns.prior_std**-2.0
    full = posterior(parts.bread, parts.meat, prior)
    white = posterior(parts.bread, parts.bread, prior)
    names = unknowns.names[:p]
    covariance = Covariance(names=names, matrix=full[:p, :p])
    seen = identifiability(evaluation.hessian, names, z[:p])
    fitted = params.with_parameters(
        *(replace(params[name], value=float(z[i]), std=float(np.sqrt(full[i, i]))) for i, name in enumerate(names))
    )
    nuisance = {e.name: _nuisance(e, unknowns, i, z, problem.substeps[i]) for i, e in enumerate(experiments)}
    status, message = _status(solution, seen, evaluation.hessian, names, step_error)
    if status == "converged":
        status, message = _open(fitted, params, message)
    result = Fit(
        status=status,
        message=message,
        parameters=fitted,
        covariance=covariance,
        white_covariance=Covariance(names=names, matrix=white[:p, :p]),
        derived=_derived(experiments, fitted, covariance),
        outputs={},
        nuisance=nuisance,
        identifiability=seen,
        cost=evaluation.cost,
        iterations=solution.iterations,
        samples=int(sum(float(np.sum(row)) for row in evaluation.counts)),
        wall_s=0.0,
        step_error_sigma=step_error,
        experiments=experiments,
    )
    outputs = {
        e.name: _explained(result, problem, i, holdout, parts.whiteness[i], z) for i, e in enumerate(experiments)
    }
    return replace(result, outputs=outputs, wall_s=time.perf_counter() - started)


def _told(direction: dict[str, float], hessian: Float[np.ndarray, "n n"], names: tuple[str, ...]) -> str:
    """Say in words what cannot be told."""
    if len(direction) > 1:
        return f"{' and '.join(direction)} enter only together"
    (name,) = direction
    if hessian[names.index(name), names.index(name)] > 0.0:
        return f"{name} cannot be told from an experiment's own unknowns (gain, offset, delay, initial state)"
    return f"{name} has no effect on any output"


def _open(fitted: ParameterSet, given: ParameterSet, message: str) -> tuple[str, str]:
    """Call a fit not identifiable whose parameters are less certain than their size: the log hardly shows them."""
    vague = [
        f"{name} = {item.value:.3g} ± {item.std:.2g} {item.unit}"
        for name, item in fitted.items()
        if item.free and item.std is not None and item.std > VAGUE * max(abs(item.value), abs(given[name].value))
    ]
    if not vague:
        return "converged", message
    return "not_identifiable", f"the logs hardly show {', '.join(vague)}: excite more, fix it, or give it a prior"


def _status(
    solution: Solution, seen: Identifiability, hessian: Float[np.ndarray, "n n"], names: tuple[str, ...], error: float
) -> tuple[str, str]:
    if seen.rank == seen.free:
        if error > STEP_ERROR_SIGMA:
            return "stalled", f"steps of 1/{MAX_SUBSTEPS} sample still leave an error of {error:.2g} sigma"
        return solution.status, solution.message
    told = "; ".join(_told(direction, hessian, names) for direction in seen.unidentifiable)
    return "not_identifiable", f"{told}: fix one, give it a prior, or measure another output"


def _nuisance(
    experiment: Experiment, unknowns: Unknowns, e: int, z: Float[np.ndarray, " n"], substeps: int
) -> Nuisance:
    places = unknowns.locals_of[e]
    return Nuisance(
        delay_s=places.delay.at(z),
        gain={name: slot.at(z) for name, slot in zip(experiment.outputs, places.gain, strict=True)},
        offset={name: slot.at(z) for name, slot in zip(experiment.outputs, places.offset, strict=True)},
        initial_state=tuple(
            {name: slot.at(z) for name, slot in zip(experiment.plant.states, row, strict=True)}
            for row in places.initial
        ),
        substeps=substeps,
    )


def _derived(experiments: tuple[Experiment, ...], fitted: ParameterSet, covariance: Covariance) -> dict[str, Derived]:
    """Return the plants' derived figures; their variance is g' Sigma g with CasADi's gradient g."""
    out: dict[str, Derived] = {}
    for experiment in experiments:
        plant = experiment.plant
        values = plant.parameter_values(fitted)
        names = list(plant.parameters)
        free = [name for name in covariance.names if name in names]
        rows = [covariance.names.index(name) for name in free]
        matrix = covariance.matrix[np.ix_(rows, rows)]
        for name, (expression, unit) in plant.derived_values().items():
            function: Any = ca.Function(
                "derived", [plant.p], [expression, ca.densify(ca.gradient(expression, plant.p))]
            )
            value, slope = function(values)
            g = np.array(slope).ravel()[[names.index(item) for item in free]]
            used = g != 0.0
            block = matrix[np.ix_(used, used)]
            variance = float(g[used] @ block @ g[used]) if np.all(np.isfinite(block)) else np.inf
            std = float(np.sqrt(max(variance, 0.0)))
            out.setdefault(name, Derived(value=float(value), unit=unit, std=std))
    return out


def _explained(
    result: Fit,
    problem: Residuals,
    e: int,
    holdout: float,
    whiteness: list[float],
    z: Float[np.ndarray, " n"],
) -> dict[str, OutputFit]:
    """Return how well each output is explained, on the samples used and on those held out."""
    experiment = problem.experiments[e]
    measured = np.vstack([segment.y for segment in problem.segments[e] if segment.y is not None])
    pieces = [problem.run(e, s, z, outputs=True).outputs for s in range(len(problem.segments[e]))]
    own = result.nuisance[experiment.name]
    gain, offset = np.array(list(own.gain.values())), np.array(list(own.offset.values()))
    model = np.vstack([piece for piece in pieces if piece is not None]) * gain + offset
    # A segment that lies wholly in the part held out has no initial state: it says nothing of the model.
    started = np.concatenate([
        np.full(segment.u.shape[0], segment.keep is None or bool(np.any(segment.keep)))
        for segment in problem.segments[e]
    ])  # fmt: skip
    kept = np.vstack([
        segment.keep if segment.keep is not None else np.ones((segment.u.shape[0], gain.size), dtype=np.uint8)
        for segment in problem.segments[e]
    ]).astype(bool)  # fmt: skip
    out: dict[str, OutputFit] = {}
    for o, name in enumerate(experiment.outputs):
        used = kept[:, o] & np.isfinite(measured[:, o])
        rest = ~kept[:, o] & started & np.isfinite(measured[:, o])
        residual = measured[:, o] - model[:, o]
        out[name] = OutputFit(
            fit_percent=_fit_percent(measured[used, o], residual[used]),
            holdout_fit_percent=_fit_percent(measured[rest, o], residual[rest]) if np.any(rest) else None,
            band_fit_percent=_band_fit_percent(problem, e, o, z),
            rms_residual=float(np.sqrt(np.mean(residual[used] ** 2))),
            sigma=float(problem.sigma[e][o]),
            unit=experiment.plant.outputs[name],
            whiteness_p=whiteness[o],
        )
    return out


def _band_fit_percent(problem: Residuals, e: int, o: int, z: Float[np.ndarray, " n"]) -> float | None:
    """Return the fit of the filtered signals, over the samples that counted; None without a band."""
    weights = problem.weights(e)
    if not len(weights.sections):
        return None
    residual, signal = 0.0, 0.0
    for s, segment in enumerate(problem.segments[e]):
        columns = problem.run(e, s, z, columns=True).columns
        assert columns is not None and segment.y is not None
        present = counted(problem, e, s, weights.settle)[:, o] > 0.0
        gain, offset = problem.point(e, s, z).gain[o], problem.point(e, s, z).offset[o]
        modelled = gain * columns[:, o, -1] + offset * columns[:, o, -2]  # the filtered model output
        measured = (modelled - columns[:, o, 0])[present]
        residual += float(np.sum(columns[present, o, 0] ** 2))
        signal += float(np.sum((measured - np.mean(measured)) ** 2))
    return 100.0 * (1.0 - float(np.sqrt(residual / max(signal, 1e-300))))


def _fit_percent(measured: Float[np.ndarray, " n"], residual: Float[np.ndarray, " n"]) -> float:
    spread = float(np.linalg.norm(measured - np.mean(measured)))
    return 100.0 * (1.0 - float(np.linalg.norm(residual)) / max(spread, 1e-300))
