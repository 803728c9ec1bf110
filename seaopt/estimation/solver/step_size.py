"""The integration step of nonlinear plants: its error, in sigmas of outputs and parameters, and how fine it must be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.estimation.problem.normal_equations import inverse
from seaopt.estimation.problem.residuals import WATCHED, Evaluation, Residuals
from seaopt.records import record
from seaopt.simulation import Pass

STEP_ERROR_SIGMA = 0.01  # integration error allowed in an output, in sigma
STEP_ERROR_PARAMETER = 0.1  # and in a parameter, in its standard deviations
FIRST_STEP_ERROR = 0.1  # allowed in an output while sigma is not yet known
MUCH_FINER = 4.0  # times: a change of the step whose error is not taken on trust
NEARBY = 10.0  # standard deviations, over which a step error does not change
MAX_SUBSTEPS = 256
EXACT = 1e-6  # noise below this part of an output's spread asks no more of the integrator


@record
class StepError:
    """Integration error at the minimum: largest in an output, in sigma, and in a parameter, in standard deviations."""

    output: float = 0.0
    parameter: float = 0.0

    @property
    def small(self) -> bool:
        """Whether it may be left out of account."""
        return self.output <= STEP_ERROR_SIGMA and self.parameter <= STEP_ERROR_PARAMETER


@record(eq=False)
class Check:
    """The step error of an experiment, where it was found, and with which steps."""

    error: StepError
    z: Float[np.ndarray, " n"]
    substeps: int


Checks = tuple[Check | None, ...]  # one an experiment


def started(problem: Residuals, start: Evaluation) -> tuple[Residuals, Evaluation]:
    """Return the problem with steps that do for a first search, and its evaluation there."""
    while True:
        finer = tuple(problem.map(lambda e, p=problem, here=start: _first_steps(p, e, here)))
        if finer == problem.substeps:
            return problem, start
        problem = replace(problem, substeps=finer)
        start = problem.evaluate(start.z)


def _first_steps(problem: Residuals, e: int, here: Evaluation) -> int:
    """Return the steps that an experiment's first samples ask for."""
    if problem.unknowns.models[e].linear:
        return problem.substeps[e]
    halved, fine = _halved(problem, e), []
    for s, piece in enumerate(problem.segments[e]):
        edges = np.array([0, min(piece.n, WATCHED)])
        fine.append(halved.run(e, s, here.origin, edges=edges, sums=False, outputs=True))
    error = _output_error(problem, e, here.origin, here.passes[e], fine)
    return _steps(problem.substeps[e], StepError(output=error), FIRST_STEP_ERROR)


def refined(problem: Residuals, here: Evaluation, checks: Checks) -> tuple[Residuals, Evaluation, Checks]:
    """Return the problem with steps whose error is small, its evaluation there, and the errors that are known there.

    That of a step that was made finer is not: order four says how fine it must be, and the next minimum is looked at.
    """
    while True:
        checks = checked(problem, here, checks)
        errors = [check.error for check in checks if check is not None]
        finer = tuple(_steps(m, error, STEP_ERROR_SIGMA) for m, error in zip(problem.substeps, errors, strict=True))
        if finer == problem.substeps:
            return problem, here, checks
        trusted = all(new < MUCH_FINER * old for new, old in zip(finer, problem.substeps, strict=True))
        problem = replace(problem, substeps=finer)
        here = problem.evaluate(here.z)
        if trusted:
            return problem, here, checks


def checked(problem: Residuals, here: Evaluation, checks: Checks) -> Checks:
    """Return the step error of every experiment: known still, where neither its step nor the minimum has changed."""

    def look(e: int) -> Check:
        known = checks[e]
        if known is not None and known.substeps == problem.substeps[e]:
            moved = here.z - known.z
            if moved @ here.hessian @ moved < NEARBY**2:
                return known
        return Check(error=step_error(problem, e, here), z=here.z, substeps=problem.substeps[e])

    return tuple(problem.map(look))


def worst_of(checks: Checks) -> StepError:
    """Return the largest of all experiments' errors."""
    known = [check.error for check in checks if check is not None]
    return StepError(output=max(error.output for error in known), parameter=max(error.parameter for error in known))


def _steps(steps: int, error: StepError, allowed: float) -> int:
    """Return how many steps a sample an error asks for."""
    over = max(error.output / allowed, error.parameter * STEP_ERROR_SIGMA / (STEP_ERROR_PARAMETER * allowed))
    if over <= 1.0 or not np.isfinite(over):
        return steps
    finer = steps * min(1.1 * over**0.25, MUCH_FINER)  # order four says how much finer
    return min(max(int(np.ceil(finer)), steps + 1), MAX_SUBSTEPS)


@np.errstate(all="ignore")
def step_error(problem: Residuals, e: int, here: Evaluation) -> StepError:
    """Return the integration error of experiment e, from steps of half the length (order four: 16/15 of the change).

    In a parameter it is the move of the minimum, H^-1 (change of the gradient), in standard deviations: an error far
    below the noise can add up over a long log. In an output it is the largest change, in sigma, over each segment's
    first samples.
    """
    if problem.unknowns.models[e].linear:
        return StepError()
    fine = _halved(problem, e).passes_of(e, here.origin)
    worst = _output_error(problem, e, here.origin, here.passes[e], fine)
    sigma = np.maximum(problem.sigma[e], EXACT * problem.spread[e])
    weighted = problem.with_sigma(tuple(sigma if i == e else own for i, own in enumerate(problem.sigma)))
    coarse, gradient = weighted.normal(e, here.passes[e]), weighted.normal(e, fine)[0, 1:]
    gradient, hessian = gradient - coarse[0, 1:], coarse[1:, 1:] + np.diag(problem.unknowns.precision)
    if not (np.isfinite(worst) and np.all(np.isfinite(hessian)) and np.all(np.isfinite(gradient))):
        return StepError(output=np.inf, parameter=np.inf)
    back, _ = inverse(hessian)
    p = problem.unknowns.shared
    std = np.sqrt(np.maximum(np.diag(back)[:p], 1e-300))
    moved = np.abs(back @ gradient)[:p] * 16.0 / 15.0 / std
    return StepError(output=worst, parameter=float(np.max(moved, initial=0.0)))


def _halved(problem: Residuals, e: int) -> Residuals:
    """Return the problem with steps of half the length in experiment e."""
    return replace(problem, substeps=tuple(2 * m if i == e else m for i, m in enumerate(problem.substeps)))


@np.errstate(all="ignore")
def _output_error(
    problem: Residuals, e: int, z: Float[np.ndarray, " n"], coarse: Sequence[Pass], fine: Sequence[Pass]
) -> float:
    """Return the largest integration error in an output of experiment e, in sigma; see `step_error`."""
    scale = problem.point(e, z).gain / np.maximum(problem.sigma[e], EXACT * problem.spread[e])
    worst = 0.0
    for one, two in zip(coarse, fine, strict=True):
        assert one.outputs is not None and two.outputs is not None
        change = float(np.max(np.abs(scale * (one.outputs - two.outputs)))) * 16.0 / 15.0
        worst = max(worst, change if np.isfinite(change) else np.inf)
    return worst
