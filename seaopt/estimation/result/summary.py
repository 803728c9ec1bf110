"""From a minimum to the result of a fit: covariance, what cannot be identified, how well each output is explained."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.errors import EstimationError
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_experiment import FitOutput
from seaopt.estimation.problem.fit_problem import Evaluation, FitProblem
from seaopt.estimation.problem.normal_equations import invert
from seaopt.estimation.problem.residual_statistics import StatisticsByExperiment, compute_statistics
from seaopt.estimation.problem.shapes import Matrix, ParameterMatrix, ParameterVector, Vector
from seaopt.estimation.result.covariance import Covariance, compute_bread, compute_meat, compute_white_meat, mark_unseen
from seaopt.estimation.result.findings import DerivedFigure, OutputFit, find_energy
from seaopt.estimation.result.fit_result import Fit, FitStatus, Minimum, Provenance
from seaopt.estimation.result.identifiability import (
    Identifiability,
    assess_identifiability,
    compute_structural_rank,
    describe_direction,
)
from seaopt.estimation.result.nuisance import describe_nuisance
from seaopt.estimation.solver.least_squares import Solution
from seaopt.estimation.solver.methods import Method
from seaopt.estimation.solver.settle import Solved, explains_little
from seaopt.estimation.solver.step_size import StepError
from seaopt.formatting import format_number, join_words
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.units import unit_after

CHANCE_POWER = 200.0  # N R^2 below which a model explains nothing: some parameters' worth of chance, and noise's colour
NONZERO_STDS = 2.0  # standard deviations from which a value differs from zero
ANOTHER_SIZE = 100.0  # times the start, which hints at a unit rather than at a bad guess
# Samples below which intervals are too narrow: in 100 windows of the stand's log 90 to 96 % at 40, 92 % at 100.
FEW_SAMPLES = 400
VAGUE = 3.0  # a std of so many times the value is no estimate


def summarise(solved: Solved, method: Method, diagnostics: bool, started: float) -> Fit:
    """Return the result at a minimum."""
    problem, solution = solved.problem, solved.solution
    unknowns, z, p, params = problem.unknowns, solution.z, problem.unknowns.shared, problem.params
    evaluation = solution.evaluation
    if not np.isfinite(evaluation.cost):
        raise EstimationError(f"the fit has no finite cost: {solution.message}")
    if diagnostics:
        problem.keep(z)
    statistics = compute_statistics(problem, z) if diagnostics else None
    seen_white, seen_robust, joint, unseen, variance = _compute_covariances(problem, evaluation, statistics)
    names = unknowns.names[:p]
    identifiability = assess_identifiability(evaluation.hessian, names, z[:p])
    unseen = np.where([name in identifiability.unidentified for name in names], 1.0, unseen)
    white, robust = mark_unseen(seen_white, unseen), mark_unseen(seen_robust, unseen)
    joint[:p, :p] = robust
    delayed = tuple(f"{e.name}.delay_s" for e in problem.experiments if e.slots.delay.index is not None)
    if identifiability.rank < identifiability.free:
        identifiability = replace(identifiability, structural_rank=compute_structural_rank(problem, z))
    std = np.sqrt(np.diag(robust))
    fitted = params.with_parameters(
        *(
            replace(params[name], value=float(z[i]), std=float(std[i]), identified=bool(np.isfinite(std[i])))
            for i, name in enumerate(names)
        )
    )
    sizes = _take_sizes(problem)
    outputs = describe_outputs(problem, z, statistics) if statistics is not None else {}
    status, message = _find_status(solution, identifiability, evaluation.hessian, names, solved.step_error)
    vague = _find_vague(fitted, sizes, identifiability) if status == "converged" else {}
    unidentified = [*vague]
    if vague:
        remedy = "excite more, or fix it, or give it a prior, at what is known of it from elsewhere"
        message = f"poorly identified: {', '.join(vague.values())}; {remedy}"
    if status == "converged" and (vague or not all(fitted[name].identified for name in names)):
        status = "not_identifiable"
    if statistics is not None and not _explains_something(problem, outputs, statistics):
        status, unidentified = "not_identifiable", names
        message = (
            f"the model explains nothing of any output; check the input's sign, the channels and units ({message})"
        )
    elif method.remedy and status != "converged" and explains_little(problem, evaluation.power):
        message = f"{message}; {method.remedy}"
    fitted = fitted.with_parameters(*(replace(fitted[name], identified=False) for name in unidentified))
    bounded = [name for name, parameter in fitted.items() if parameter.free and parameter.at_bound]
    if bounded:
        message = (
            f"{message}; {join_words(bounded)} {'is at its bound' if len(bounded) == 1 else 'are at their bounds'}"
        )
    experiments = tuple(experiment.data for experiment in problem.experiments)
    return Fit(
        status=status,
        message=message,
        parameters=fitted,
        covariance=Covariance(names=names, matrix=robust),
        white_covariance=Covariance(names=names, matrix=white),
        delay_covariance=Covariance(names=(*names, *delayed), matrix=joint) if delayed else None,
        derived=derive_figures(experiments, fitted, Covariance(names=names, matrix=seen_robust), identifiability),
        outputs=outputs,
        nuisance={
            experiment.name: describe_nuisance(experiment, z, statistics, variance)
            for experiment in problem.experiments
        },
        identifiability=identifiability,
        cost=evaluation.cost,
        iterations=solution.iterations,
        samples=int(sum(float(np.sum(power.counts)) for power in evaluation.power.values())),
        provenance=Provenance(wall_s=time.perf_counter() - started),
        step_error_sigma=solved.step_error.output,
        step_error_parameter=solved.step_error.parameter,
        log_likelihood=_compute_log_likelihood(problem, evaluation),
        unknowns=z.size,
        method=method.key,
        notes=(
            *(f"{experiment.name}: {note}" for experiment in experiments for note in experiment.notes),
            *(f"{each.name}: {text}" for each in experiments for text in each.describe_readings(fitted)),
            *_find_oddities(fitted, sizes, evaluation),
        ),
        experiments=experiments,
        minimum=Minimum(problem=problem, z=z, method=method, statistics=statistics),
    )


def _take_sizes(problem: FitProblem) -> ParameterSet:
    """Return the parameters at their starts; a speed that smooths friction at its plant's own, for it may be tiny."""
    names, sizes = {problem.unknowns.names[i] for i in problem.find_smoothing()}, problem.params
    for experiment in problem.experiments:
        for name, parameter in experiment.data.plant.parameters.items():
            if name in names and isinstance(parameter, Parameter):
                sizes = sizes.with_parameters(replace(sizes[name], value=parameter.value))
    return sizes


def _find_oddities(fitted: ParameterSet, params: ParameterSet, evaluation: Evaluation) -> list[str]:
    """Return remarks for a reader: values of another size than their start, and few samples."""
    odd: list[str] = []
    for name, parameter in fitted.items():
        start = params[name].value
        if not parameter.free or start * parameter.value <= 0.0:
            continue
        ratio = parameter.value / start
        times, way = (ratio, "above") if ratio > 1.0 else (1.0 / ratio, "below")
        # What does not differ from zero is small by chance: no unit explains it.
        differs = parameter.std is None or parameter.std < abs(parameter.value) / NONZERO_STDS
        if times > ANOTHER_SIZE and (ratio > 1.0 or differs):
            odd.append(
                f"{name} = {parameter.value:.3g} is {format_number(times)} times {way} its start of {start:.3g}: "
                "check the units of time, inputs and outputs"
            )
    samples = int(max(float(np.max(power.counts)) for power in evaluation.power.values()))
    if samples < FEW_SAMPLES:
        odd.append(f"{samples} samples are few: 95 % intervals of so short a log cover about 90 %")
    return odd


def _compute_covariances(
    problem: FitProblem, evaluation: Evaluation, statistics: StatisticsByExperiment | None
) -> tuple[ParameterMatrix, ParameterMatrix, Float[np.ndarray, "q q"], ParameterVector, Vector]:
    """Return the parameters' covariance for white residuals and for the actual ones, and how much is unseen. The colour
    of residuals that are a stated rounding's is known, and in the model covariance (`rounding`). Both are
    over what is seen alone, and so is the third, of parameters and delays together; the fourth is how much of each
    parameter is not seen (0 to 1, squared). The last are the variances of all unknowns: of parameters, delays and gains
    for the actual residuals, of others for white ones.
    """
    p, prior, z = problem.unknowns.shared, problem.unknowns.precision, evaluation.z
    bread = evaluation.hessian if problem.loss.quadratic else compute_bread(problem, z)
    inverse, unseen = invert(bread)
    variance = np.diag(inverse).copy()
    delays = [e.slots.delay.index for e in problem.experiments if e.slots.delay.index is not None]
    gains = [slot.index for e in problem.experiments for slot in e.slots.gain if slot.index is not None]
    stated, q = [*range(p), *delays, *gains], p + len(delays)
    if not stated:
        return np.zeros((0, 0)), np.zeros((0, 0)), np.zeros((0, 0)), np.zeros(0), variance
    columns = inverse[:, stated]
    from_priors = (columns.T * prior) @ columns
    white = inverse[stated][:, stated]
    if not problem.loss.quadratic:
        sums = statistics if statistics is not None else compute_statistics(problem, z)
        white = columns.T @ compute_white_meat(problem, z, sums) @ columns + from_priors
    of_rounding = all(e.is_rounding(evaluation.power[e.name].rms) for e in problem.experiments)
    robust = white if statistics is None or of_rounding else compute_meat(problem, z, columns, statistics) + from_priors
    variance[stated] = np.diag(robust)
    return white[:p, :p], robust[:p, :p], robust[:q, :q].copy(), unseen[:p], variance


def _compute_log_likelihood(problem: FitProblem, evaluation: Evaluation) -> float:
    """Return the Gaussian likelihood at the residuals' own sigma, which is that of its best value."""
    total = 0.0
    for experiment in problem.experiments:
        power = evaluation.power[experiment.name]
        variance = np.maximum(power.squares / np.maximum(power.counts, 1.0), (1e-12 * experiment.sigma) ** 2)
        total -= 0.5 * float(np.sum(power.counts * (np.log(2.0 * np.pi * variance) + 1.0)))
    return total


def _find_vague(fitted: ParameterSet, params: ParameterSet, identifiability: Identifiability) -> dict[str, str]:
    """Return the free parameters that are less certain than their size, in words: the log hardly shows them. Of several
    that hardly have an effect but together, a std beyond the value is enough: another start ends elsewhere.
    """
    beyond = {name for name, p in fitted.items() if (p.std or 0.0) > abs(p.value)}
    weak = (beyond.intersection(direction) for direction in identifiability.weak)
    together = {name for names in weak if len(names) > 1 for name in names}
    return {
        name: f"{name} = {p.value:.3g} ± {p.std:.2g}{unit_after(p.unit)}"
        for name, p in fitted.items()
        if p.free
        and p.std is not None
        and (name in together or p.std > VAGUE * max(abs(p.value), abs(params[name].value)))
    }


def _find_status(
    solution: Solution[Evaluation],
    identifiability: Identifiability,
    hessian: Matrix,
    names: tuple[str, ...],
    step: StepError,
) -> tuple[FitStatus, str]:
    if identifiability.rank == identifiability.free:
        if not step.small:
            error = f"{step.output:.2g} sigma in an output and {step.parameter:.2g} std in a parameter"
            return "stalled", f"the finest integration steps still leave an error of {error}"
        weak = "; ".join(
            f"{join_words(sorted(direction))} are only weakly distinguished (condition "
            f"{identifiability.condition:.2g}): each would be known far better if the others were"
            for direction in identifiability.weak
        )
        return solution.status, f"{solution.message}; {weak}" if weak else solution.message
    has_effect = {name: bool(hessian[i, i] > 0.0) for i, name in enumerate(names)}
    words = "; ".join(
        describe_direction(direction, has_effect.get(min(direction), True))
        for direction in identifiability.unidentifiable
    )
    if 0 <= identifiability.structural_rank < identifiability.free:
        return "not_identifiable", f"{words}: fix one, give it a prior, or measure another output"
    return "not_identifiable", f"{words} in this log: excite more, fix one, or give it a prior"


@lru_cache(maxsize=64)
def _compile_figures(plant: Plant) -> tuple[Any, dict[str, str]]:
    """Return the CasADi function p -> (figures, their gradients in rows), and their units by name."""
    figures = plant.derived_values()
    values = ca.vertcat(ca.SX(0, 1), *(expression for expression, _ in figures.values()))
    slopes = ca.densify(ca.jacobian(values, plant.p))
    return ca.Function("derived", [plant.p], [ca.densify(values), slopes]), {
        n: unit for n, (_, unit) in figures.items()
    }


def derive_figures(
    experiments: tuple[Experiment, ...], fitted: ParameterSet, seen: Covariance, identifiability: Identifiability
) -> dict[str, DerivedFigure]:
    """Return the plants' derived figures; their variance is g' Sigma g with CasADi's gradient g. Sigma is over what is
    seen. A figure that is the same along every direction that is not has its variance from that, whatever single
    parameters have (an estimable function: Searle, Linear Models, 1971, ch. 5); any other has none. One that depends on
    parameters of one log alone is that log's, EXPERIMENT.NAME.
    """
    out: dict[str, DerivedFigure] = {}
    sizes = {name: fitted[name].value for name in seen.names}
    for experiment in experiments:
        plant = experiment.plant
        function, units = _compile_figures(plant)
        values, slopes = (np.array(array) for array in function(plant.complete(experiment.apply_own(fitted)).vector))
        local = {name: parameter.name for name, parameter in experiment.list_own().items()}
        names = [local.get(name, "" if name in experiment.parameters else name) for name in plant.parameters]
        free = [name for name in seen.names if name in names]
        rows = [seen.names.index(name) for name in free]
        matrix = seen.matrix[rows][:, rows]
        alone = [name in experiment.parameters for name in plant.parameters]
        for i, (figure, unit) in enumerate(units.items()):
            name = f"{experiment.name}.{figure}" if np.any(slopes[i, alone]) else figure
            g = slopes[i, [names.index(parameter) for parameter in free]]
            determined = identifiability.determines(dict(zip(free, g.tolist(), strict=True)), sizes)
            std = float(np.sqrt(max(float(g @ matrix @ g), 0.0))) if determined else np.inf
            out.setdefault(name, DerivedFigure(value=float(values[i, 0]), unit=unit, std=std))
    return out


def describe_outputs(
    problem: FitProblem, z: Vector, statistics: StatisticsByExperiment
) -> dict[str, dict[str, OutputFit]]:
    """Return how well each output is explained, on the samples used and on those held out."""
    simulated = compute_statistics(problem.with_each(predictor=None), z) if problem.predicts else statistics

    def describe(output: FitOutput) -> OutputFit:
        experiment, name = output.experiment, output.name
        sums, weighted = simulated[experiment.name], statistics[experiment.name]
        used, held_out = sums.used[name], sums.held_out[name]
        if experiment.level_unseen:
            used, held_out = used.shift(used.bias), held_out.shift(used.bias)
        return OutputFit(
            fit_percent=used.fit_percent if used.fit_percent is not None else np.nan,
            holdout_fit_percent=held_out.fit_percent,
            band_fit_percent=weighted.in_band[name].fit_percent if weighted.in_band else None,
            one_step_fit_percent=weighted.used[name].fit_percent if problem.predicts else None,
            rms_residual=float(np.sqrt(used.power / max(used.count, 1))),
            sigma=output.sigma,
            unit=output.unit,
            whiteness_p=weighted.whiteness(name),
            spread=output.spread,
        )

    return problem.map_outputs(describe)


def _explains_something(
    problem: FitProblem, outputs: Mapping[str, Mapping[str, OutputFit]], statistics: StatisticsByExperiment
) -> bool:
    """Tell whether some output is explained better than by chance: N R^2 of its band is far above its mean, 1."""
    for output in problem.outputs:
        row = outputs[output.experiment.name][output.name]
        percents = (row.fit_percent, row.band_fit_percent, row.one_step_fit_percent)
        gain = find_energy(max(0.0, *(percent for percent in percents if percent is not None)))
        if gain > 0.5 or gain * statistics[output.experiment.name].count_of(output.name) > CHANCE_POWER:
            return True
    return False
