"""From a minimum to the result of a fit: covariance, what cannot be told, how well each output is explained."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.errors import EstimationError
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.losses import Linear
from seaopt.estimation.problem.methods import Method, MultipleShooting, OutputError
from seaopt.estimation.problem.normal_equations import inverse
from seaopt.estimation.problem.residual_statistics import Leftover, leftover
from seaopt.estimation.problem.residuals import Evaluation, Residuals, sees_level
from seaopt.estimation.problem.unknowns import Locals, Unknowns
from seaopt.estimation.result.covariance import Covariance, coloured, robust_bread, robust_meat, with_infinities
from seaopt.estimation.result.findings import Derived, Nuisance, OutputFit
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.estimation.result.identifiability import Identifiability, identifiability, listed, structural_rank, told
from seaopt.estimation.solver.least_squares import Solution
from seaopt.estimation.solver.solve import Solved, explains_little
from seaopt.estimation.solver.step_size import MAX_SUBSTEPS, StepError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.units import unit_after

CHANCE_POWER = 200.0  # N R^2 below which a model explains nothing: some parameters' worth of chance, and noise's colour
ANOTHER_SIZE = 100.0  # times the start, which hints at a unit rather than at a bad guess
FEW = (
    400  # samples below which intervals are too narrow: in 100 windows of the stand's log 90 to 96 % at 40, 92 % at 100
)
VAGUE = 3.0  # a std of so many times the value is no estimate


def summarise(params: ParameterSet, solved: Solved, method: Method, diagnostics: bool, started: float) -> Fit:
    """Return the result at a minimum."""
    problem, solution = solved.problem, solved.solution
    unknowns, z, p = problem.unknowns, solution.z, problem.unknowns.shared
    found = solution.evaluation
    if not np.isfinite(found.cost):
        raise EstimationError(f"the fit has no finite cost: {solution.message}")
    left = [leftover(problem, e, z) for e in range(len(problem.experiments))] if diagnostics else None
    white, robust = _covariances(problem, found, left)
    names = unknowns.names[:p]
    seen = identifiability(found.hessian, names, z[:p])
    if seen.rank < seen.free:
        seen = replace(seen, structural_rank=structural_rank(problem, z))
    std, variance = np.sqrt(np.diag(robust)), np.diag(inverse(found.hessian)[0])
    fitted = params.with_parameters(
        *(
            replace(params[name], value=float(z[i]), std=float(std[i]), identified=bool(np.isfinite(std[i])))
            for i, name in enumerate(names)
        )
    )
    covariance = Covariance(names=names, matrix=robust)
    status, message = _status(solution, seen, found.hessian, names, solved.step_error)
    if status == "converged":
        fitted, message = _open(fitted, params, message)
        status = "converged" if all(fitted[name].identified for name in names) else "not_identifiable"
    outputs = _outputs(problem, z, left) if left is not None else {}
    if left is not None and not _explained(problem, outputs, left):
        status = "not_identifiable"
        fitted = _marked(fitted, names)
        message = (
            f"the model explains nothing of any output; check the input's sign, the channels and units ({message})"
        )
    elif explains_little(problem, found) and status != "converged" and isinstance(method, OutputError):
        message = f"{message}; the simulation may run away: try PredictionError() or MultipleShooting()"
    bounded = [name for name, item in fitted.items() if item.free and item.at_bound]
    if bounded:
        message = f"{message}; {listed(bounded)} {'is at its bound' if len(bounded) == 1 else 'are at their bounds'}"
    return Fit(
        status=status,
        message=message,
        parameters=fitted,
        covariance=covariance,
        white_covariance=Covariance(names=names, matrix=white),
        derived=_derived(problem.experiments, fitted, covariance),
        outputs=outputs,
        nuisance={
            e.name: _nuisance(e, unknowns, i, z, problem.substeps[i], _levels(problem, i, left), variance)
            for i, e in enumerate(problem.experiments)
        },
        identifiability=seen,
        cost=found.cost,
        iterations=solution.iterations,
        samples=int(sum(float(np.sum(row)) for row in found.counts)),
        wall_s=time.perf_counter() - started,
        step_error_sigma=solved.step_error.output,
        step_error_parameter=solved.step_error.parameter,
        log_likelihood=_log_likelihood(problem, found),
        unknowns=z.size,
        method=_method_name(method),
        notes=(
            *(f"{e.name}: {note}" for e in problem.experiments for note in e.notes),
            *_oddities(fitted, params, found),
        ),
        experiments=problem.experiments,
        minimum=Minimum(problem=problem, z=z),
    )


def _oddities(fitted: ParameterSet, given: ParameterSet, found: Evaluation) -> list[str]:
    """Say what a search does not mind, but a reader should: values of another size, and few samples."""
    odd: list[str] = []
    for name, item in fitted.items():
        start = given[name].value
        if not item.free or start * item.value <= 0.0:
            continue
        times, way = (item.value / start, "above") if item.value / start > 1.0 else (start / item.value, "below")
        if times > ANOTHER_SIZE:
            odd.append(
                f"{name} = {item.value:.3g} is {times:.0f} times {way} its start of {start:.3g}: "
                "check the units of time, inputs and outputs"
            )
    samples = int(max(float(np.max(row)) for row in found.counts))
    if samples < FEW:
        odd.append(f"{samples} samples are few: 95 % intervals of so short a log cover about 90 %")
    return odd


def _method_name(method: Method) -> str:
    if isinstance(method, OutputError):
        return "output_error"
    return "multiple_shooting" if isinstance(method, MultipleShooting) else "prediction_error"


def _covariances(
    problem: Residuals, found: Evaluation, left: list[Leftover] | None
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "p p"]]:
    """Return the covariance of the plants' parameters for white residuals, and for those that there are."""
    p, prior, z = problem.unknowns.shared, problem.unknowns.precision, found.z
    squares = isinstance(problem.loss, Linear)
    bread = found.hessian if squares else robust_bread(problem, z) + np.diag(prior)
    back, unseen = inverse(bread)
    columns = back[:, :p]
    known = (columns.T * prior) @ columns
    white = back[:p, :p]
    if not squares:
        sums = left if left is not None else [leftover(problem, e, z) for e in range(len(problem.experiments))]
        white = columns.T @ robust_meat(problem, z, sums) @ columns + known
    white = with_infinities(white, unseen[:p])
    if left is None:
        return white, white
    return white, with_infinities(coloured(problem, z, columns, left) + known, unseen[:p])


def _own_std(experiment: Experiment, places: Locals, variance: Float[np.ndarray, " n"]) -> dict[str, float]:
    """Return the standard deviations of the experiment's free delay and gains."""
    slots = {"delay_s": places.delay}
    slots |= {f"gain.{name}": slot for name, slot in zip(experiment.outputs, places.gain, strict=True)}
    free = {key: slot.index for key, slot in slots.items() if slot.index is not None}
    return {key: float(np.sqrt(max(variance[index], 0.0))) for key, index in free.items()}


def _levels(problem: Residuals, e: int, left: list[Leftover] | None) -> list[float]:
    """Return the offsets that the fit did not see, from what is left over on average."""
    experiment = problem.experiments[e]
    if left is None or not _level_unseen(problem, experiment):
        return [0.0] * len(experiment.outputs)
    return [-part.bias for part in left[e].used]


def _log_likelihood(problem: Residuals, found: Evaluation) -> float:
    """Return the Gaussian likelihood at the residuals' own sigma, which is that of its best value."""
    total = 0.0
    for squares, counts, sigma in zip(found.squares, found.counts, problem.sigma, strict=True):
        variance = np.maximum(squares / np.maximum(counts, 1.0), (1e-12 * sigma) ** 2)
        total -= 0.5 * float(np.sum(counts * (np.log(2.0 * np.pi * variance) + 1.0)))
    return total


def _marked(fitted: ParameterSet, names: Sequence[str]) -> ParameterSet:
    """Return the parameters with `names` marked as not identified."""
    return fitted.with_parameters(*(replace(fitted[name], identified=False) for name in names))


def _open(fitted: ParameterSet, given: ParameterSet, message: str) -> tuple[ParameterSet, str]:
    """Call those parameters not identified that are less certain than their size: the log hardly shows them."""
    vague = {
        name: f"{name} = {item.value:.3g} ± {item.std:.2g}{unit_after(item.unit)}"
        for name, item in fitted.items()
        if item.free and item.std is not None and item.std > VAGUE * max(abs(item.value), abs(given[name].value))
    }
    if not vague:
        return fitted, message
    message = f"the logs hardly show {', '.join(vague.values())}: excite more, fix it, or give it a prior"
    return _marked(fitted, [*vague]), message


def _status(
    solution: Solution, seen: Identifiability, hessian: Float[np.ndarray, "n n"], names: tuple[str, ...],
    step: StepError,
) -> tuple[str, str]:  # fmt: skip
    if seen.rank == seen.free:
        if not step.small:
            found = f"{step.output:.2g} sigma in an output and {step.parameter:.2g} std in a parameter"
            return "stalled", f"steps of 1/{MAX_SUBSTEPS} sample still leave an error of {found}"
        weak = "; ".join(
            f"{listed(sorted(direction))} are only weakly told apart (condition {seen.condition:.2g}): "
            "each would be known far better if the others were"
            for direction in seen.weak
        )
        return solution.status, f"{solution.message}; {weak}" if weak else solution.message
    seen_alone = {name: bool(hessian[i, i] > 0.0) for i, name in enumerate(names)}
    words = "; ".join(told(direction, seen_alone.get(min(direction), True)) for direction in seen.unidentifiable)
    if 0 <= seen.structural_rank < seen.free:
        return "not_identifiable", f"{words}: fix one, give it a prior, or measure another output"
    return "not_identifiable", f"{words} in this log: excite more, fix one, or give it a prior"


def _nuisance(
    experiment: Experiment, unknowns: Unknowns, e: int, z: Float[np.ndarray, " n"], substeps: int,
    levels: list[float], variance: Float[np.ndarray, " n"],
) -> Nuisance:  # fmt: skip
    places = unknowns.locals_of[e]
    return Nuisance(
        delay_s=places.delay.at(z),
        gain={name: slot.at(z) for name, slot in zip(experiment.outputs, places.gain, strict=True)},
        offset={
            name: slot.at(z) + level
            for name, slot, level in zip(experiment.outputs, places.offset, levels, strict=True)
        },
        drift={
            name: tuple(slot.at(z) for slot in row) for name, row in zip(experiment.outputs, places.drift, strict=True)
        },
        initial_state=tuple(
            {name: slot.at(z) for name, slot in zip(experiment.plant.states, row, strict=True)}
            for row in places.initial
        ),
        noise={name: slot.at(z) for name, slot in zip(experiment.plant.states, places.noise, strict=False)},
        std=_own_std(experiment, places, variance),
        substeps=substeps,
    )


@lru_cache(maxsize=64)
def _derived_figures(plant: Plant) -> tuple[Any, dict[str, str]]:
    """Return the CasADi function p -> (figures, their gradients in rows), and their units by name."""
    figures = plant.derived_values()
    values = ca.vertcat(ca.SX(0, 1), *(expression for expression, _ in figures.values()))
    slopes = ca.densify(ca.jacobian(values, plant.p))
    return ca.Function("derived", [plant.p], [ca.densify(values), slopes]), {
        n: unit for n, (_, unit) in figures.items()
    }


def _derived(experiments: tuple[Experiment, ...], fitted: ParameterSet, covariance: Covariance) -> dict[str, Derived]:
    """Return the plants' derived figures; their variance is g' Sigma g with CasADi's gradient g."""
    out: dict[str, Derived] = {}
    for experiment in experiments:
        plant = experiment.plant
        function, units = _derived_figures(plant)
        values, slopes = (np.array(found) for found in function(plant.parameter_values(fitted)))
        names = list(plant.parameters)
        free = [name for name in covariance.names if name in names]
        rows = [covariance.names.index(name) for name in free]
        matrix = covariance.matrix[np.ix_(rows, rows)]
        for i, (name, unit) in enumerate(units.items()):
            g = slopes[i, [names.index(item) for item in free]]
            used = g != 0.0
            block = matrix[np.ix_(used, used)]
            variance = float(g[used] @ block @ g[used]) if np.all(np.isfinite(block)) else np.inf
            std = float(np.sqrt(max(variance, 0.0)))
            out.setdefault(name, Derived(value=float(values[i, 0]), unit=unit, std=std))
    return out


def _outputs(problem: Residuals, z: Float[np.ndarray, " n"], left: list[Leftover]) -> dict[str, dict[str, OutputFit]]:
    """Return how well each output is explained, on the samples used and on those held out."""
    simulated = left
    if problem.observers is not None:
        plain = replace(problem, observers=None)
        simulated = [leftover(plain, e, z) for e in range(len(problem.experiments))]
    found: dict[str, dict[str, OutputFit]] = {}
    for e, experiment in enumerate(problem.experiments):
        found[experiment.name] = {}
        for o, name in enumerate(experiment.outputs):
            used, rest = simulated[e].used[o], simulated[e].rest[o]
            if _level_unseen(problem, experiment):
                used, rest = used.levelled(used.bias), rest.levelled(used.bias)
            found[experiment.name][name] = OutputFit(
                fit_percent=used.fit_percent if used.fit_percent is not None else np.nan,
                holdout_fit_percent=rest.fit_percent,
                band_fit_percent=left[e].band[o].fit_percent if left[e].band else None,
                one_step_fit_percent=None if problem.observers is None else left[e].used[o].fit_percent,
                rms_residual=float(np.sqrt(used.power / max(used.count, 1))),
                sigma=float(problem.sigma[e][o]),
                unit=experiment.plant.outputs[name],
                whiteness_p=left[e].whiteness(o),
            )
    return found


def _level_unseen(problem: Residuals, experiment: Experiment) -> bool:
    """Tell whether an offset is wanted that the fit's band does not show: it is then what is left over on average."""
    return experiment.offset is True and not sees_level(problem.band_hz)


def _explained(problem: Residuals, outputs: dict[str, dict[str, OutputFit]], left: list[Leftover]) -> bool:
    """Tell whether some output is explained better than by chance: N R^2 of its band is far above its mean, 1."""
    for e, experiment in enumerate(problem.experiments):
        for o, name in enumerate(experiment.outputs):
            row = outputs[experiment.name][name]
            shown = max(
                percent
                for percent in (row.fit_percent, row.band_fit_percent, row.one_step_fit_percent)
                if percent is not None
            )
            gain = 1.0 - (1.0 - max(shown, 0.0) / 100.0) ** 2
            if gain > 0.5 or gain * float(left[e].count[o]) > CHANCE_POWER:
                return True
    return False
