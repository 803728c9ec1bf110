r"""What no such log can tell: effects that other values of a fit's parameters make up for without a trace.

A stand that gives is in series with the spring. A transmission that rubs more where it drives than where it is driven
is one with another inertia, friction and efficiency. A damper across a spring whose other end is held is friction of
the motor. A motor whose torque droops is a weaker one where all commands have one size. No residual shows any of them,
so that each is looked for where it is not: its parameter :math:`\delta` joins the unknowns at its neutral value, zero,
or where it is fixed, with the sensitivities of all of them,

.. math:: s^2 = H_{\delta\delta} - H_{\delta\theta} H_{\theta\theta}^{-1} H_{\theta\delta}, \qquad
          \frac{d\theta}{d\delta} = -H_{\theta\theta}^{-1} H_{\theta\delta} .

Along that direction the residual changes by s standard deviations per unit. Where a size that actuators have changes it
by less than 5 the logs do not tell it, and the parameters that move along with it are named, with by how much.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from seaopt.errors import SeaoptError
from seaopt.estimation.judgement.hypotheses import list_additions
from seaopt.estimation.judgement.score_test import Freed
from seaopt.estimation.problem.fit_problem import Evaluation, FitProblem
from seaopt.estimation.problem.normal_equations import solve_seen
from seaopt.estimation.result.findings import SilentEffect
from seaopt.estimation.result.fit_result import Fit

SEEN = 5.0  # standard deviations by which an effect has to change the residual to be told
TOUCHED = 0.005  # of a value, that the effect has to move it by to be named
SOLVED = 1e-13


def find_silent(fit: Fit, freed: Freed | None = None) -> tuple[SilentEffect, ...]:
    """Return the effects that a fit's logs do not tell, by one pass with all of them; none of a fit that has none.
    `freed`: a problem in which more is free, where that is at hand: if that has them, no other pass is made.
    """
    minimum = fit.require_minimum("find_silent")
    if minimum.problem.predicts or not fit.covariance.names:
        return ()
    try:
        if freed is None or not freed.additions:
            additions = tuple(list_additions(minimum.problem, minimum.z))
            if not additions:
                return ()
            freed = Freed.make(minimum.problem, minimum.z, additions=additions)
        evaluation = freed.problem.evaluate(freed.z)
    except SeaoptError:  # what does not make a problem tells nothing
        return ()
    if not np.all(np.isfinite(evaluation.hessian)):
        return ()
    return tuple(_find_ties(fit, minimum.problem, freed, evaluation))


def _find_ties(fit: Fit, problem: FitProblem, freed: Freed, evaluation: Evaluation) -> Iterator[SilentEffect]:
    """Yield the effects whose direction leaves the residual as it is, and that touch some parameter."""
    names, hessian = freed.problem.unknowns.names, evaluation.hessian
    others = np.array([i for i, name in enumerate(names) if name in problem.unknowns.names])
    for addition in freed.additions:
        parameter, size = addition.parameter, addition.size
        i = names.index(parameter.name)
        shift = -solve_seen(hessian[others][:, others], hessian[others, i], SOLVED)
        left = max(float(hessian[i, i] + hessian[i, others] @ shift), 0.0)
        moves = {names[k]: float(each) for k, each in zip(others, shift, strict=True) if names[k] in fit.parameters}
        touched = {name: move for name, move in moves.items() if abs(move) * size > _measure_least(fit, name)}
        if touched and size * np.sqrt(left) < SEEN:
            yield SilentEffect(
                effect=addition.effect,
                part=addition.part,
                parameter=parameter.name,
                unit=parameter.unit,
                size=size,
                shifts=touched,
                seen=size * float(np.sqrt(left)),
            )


def _measure_least(fit: Fit, name: str) -> float:
    """Return by how much a value has to move to be named; one that is as good as zero by its standard deviation."""
    parameter = fit.parameters[name]
    value, std = abs(parameter.value), parameter.std or 0.0
    return max(TOUCHED * value, std) if value < 2.0 * std else TOUCHED * value
