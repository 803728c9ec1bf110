r"""What no such log can tell: effects that other values of a fit's parameters make up for without a trace.

A stand that gives is in series with the spring. A transmission that rubs more where it drives than where it is driven
is one with another inertia, friction and efficiency. A damper across a spring whose other end is held is friction of
the motor. No residual shows any of them, so that each is looked for where it is not: its parameter :math:`\delta` joins
the unknowns at its neutral value, zero, or where it is fixed, with the sensitivities of all of them,

.. math:: s^2 = H_{\delta\delta} - H_{\delta\theta} H_{\theta\theta}^{-1} H_{\theta\delta}, \qquad
          \frac{d\theta}{d\delta} = -H_{\theta\theta}^{-1} H_{\theta\delta} .

Along that direction the residual changes by s standard deviations per unit. Where a size that actuators have changes it
by less than 5 the logs do not tell it, and the parameters that move along with it are named, with by how much.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from seaopt.errors import SeaoptError
from seaopt.estimation.judgement.hypotheses import HYPOTHESES
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_problem import Evaluation, FitProblem
from seaopt.estimation.problem.normal_equations import solve_seen
from seaopt.estimation.result.findings import SilentEffect
from seaopt.estimation.result.fit_result import Fit
from seaopt.estimation.solver.step_shares import copy_steps
from seaopt.parameters import Parameter
from seaopt.plants import Plant, add_part
from seaopt.plants.memo import memo
from seaopt.records import record

SEEN = 5.0  # standard deviations by which an effect has to change the residual to be told
TOUCHED = 0.005  # of a value, that the effect has to move it by to be named
SOLVED = 1e-13


@record(eq=False)
class _Addition:
    """An effect that logs may not show, its part ("" where plants have it), its parameter, and experiments with it."""

    effect: str
    part: str
    parameter: Parameter
    size: float
    experiments: dict[str, Experiment]


def find_silent(fit: Fit) -> tuple[SilentEffect, ...]:
    """Return the effects that a fit's logs do not tell, by one pass with all of them; none of a fit that has none."""
    problem, z = fit.require_minimum("find_silent").problem, fit.require_minimum("find_silent").z
    added = list(_add_each(fit))
    if not added or problem.predicts or not fit.covariance.names:
        return ()
    data: dict[str, Experiment] = {}
    for addition in added:
        data |= addition.experiments
    free = fit.parameters.with_parameters(*(replace(addition.parameter, free=True) for addition in added))
    try:
        joint, start = problem.rebuild(free, z, data)
        joint = copy_steps(joint, problem)
        evaluation = joint.evaluate(start)
    except SeaoptError:  # what does not make a problem tells nothing
        return ()
    if not np.all(np.isfinite(evaluation.hessian)):
        return ()
    return tuple(_find_ties(fit, joint, evaluation, added))


def _find_ties(fit: Fit, joint: FitProblem, evaluation: Evaluation, added: list[_Addition]) -> Iterator[SilentEffect]:
    """Yield the effects whose direction leaves the residual as it is, and that touch some parameter."""
    names, hessian = joint.unknowns.names, evaluation.hessian
    others = np.array([i for i, name in enumerate(names) if name not in {each.parameter.name for each in added}])
    for addition in added:
        parameter, size = addition.parameter, addition.size
        i = names.index(parameter.name)
        shift = -solve_seen(hessian[others][:, others], hessian[others, i], SOLVED)
        left = max(float(hessian[i, i] + hessian[i, others] @ shift), 0.0)
        moves = {names[k]: float(each) for k, each in zip(others, shift, strict=True) if names[k] in fit.parameters}
        touched = {
            name: move for name, move in moves.items() if abs(move) * size > TOUCHED * abs(fit.parameters[name].value)
        }
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


def _add_each(fit: Fit) -> Iterator[_Addition]:
    """Yield the hypotheses that logs may not show, on those experiments whose plants take them, one after the other;
    and what plants have of it without a part, fixed.
    """
    experiments = {experiment.name: experiment for experiment in fit.experiments}
    for hypothesis in HYPOTHESES:
        if hypothesis.usual is None:
            continue
        changed: dict[str, Experiment] = {}
        names: set[str] = set()
        for name, experiment in experiments.items():
            if (built_in := hypothesis.built_in(experiment.plant)) is not None:
                if built_in not in experiment.parameters:
                    changed[name] = experiment
                    names.add(built_in)
            elif (plant := _add(experiment.plant, hypothesis.part)) is not None:
                changed[name] = replace(experiment, plant=plant)
                names |= plant.parameters.keys() - experiment.plant.parameters.keys()
        if len(names) != 1:
            continue
        (name,) = names
        first = next(iter(changed.values()))
        parameter, spring = first.plant.parameters[name], first.plant.spring
        is_there = name in experiments[first.name].plant.parameters
        if is_there:
            parameter = fit.parameters[name]
        elif name in fit.parameters:
            continue
        if not isinstance(parameter, Parameter) or parameter.free or spring is None or not spring.stiffness:
            continue
        stiffness = first.plant.complete(first.apply_own(fit.parameters))[spring.stiffness].value
        experiments |= changed
        yield _Addition(
            effect=hypothesis.effect + (" more" if parameter.value else ""),
            part="" if is_there else hypothesis.part,
            parameter=parameter,
            size=hypothesis.usual(stiffness),
            experiments=changed,
        )


@memo
def _add(plant: Plant, part: str) -> Plant | None:
    """Return a plant with a part; None where it does not take it."""
    try:
        return add_part(plant, part)
    except SeaoptError:
        return None
