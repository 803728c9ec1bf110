r"""Which samples take how many integration steps.

Where friction is smoothed, speeds that cross zero ask for a hundred times finer steps than all others. With
:math:`n_k` steps of order p sample k adds :math:`c_k n_k^{-p}` to the integration error, and :math:`c_k` is known from
what steps of half the length change in it. The fewest steps whose errors add up to no more than those of a number N in
every sample are

.. math:: n_k = \lambda c_k^{1/(p+1)}, \qquad \lambda^p = N^p \sum_k c_k^{1/(p+1)} / \sum_k c_k .

They are chosen where a search has come to and stay as they are while it goes on, so that residuals are smooth.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.estimation.problem.fit_experiment import MAX_SUBSTEPS, FitExperiment
from seaopt.estimation.problem.fit_problem import Evaluation, FitProblem
from seaopt.estimation.problem.shapes import Vector
from seaopt.plants.friction import remembers
from seaopt.simulation import find_stable_steps

FEW = 8  # steps in every sample that are not worth a choice
WORTH = 0.5  # of the steps that the same number in every sample takes
GRAIN = 4.0  # numbers of steps in an octave of them: without a compiler each number is code of its own
TINY = 1e-300
Samples = Float[np.ndarray, " m"]


def share_steps(problem: FitProblem, z: Vector, steps: Mapping[str, int]) -> FitProblem:
    """Return the problem with so many steps in every sample of the experiments that are named, or shared out with the
    same error where that takes far fewer.
    """
    if not steps:
        return problem
    shared = problem.map(lambda e: _share(e, z, steps[e.name]) if e.name in steps else e)
    return replace(problem, experiments=tuple(shared))


def share_many(problem: FitProblem, evaluation: Evaluation) -> tuple[FitProblem, Evaluation]:
    """Return a problem whose many steps are shared out where they are not yet, and its evaluation."""
    many = {
        e.name: e.count_steps(evaluation.z)
        for e in problem.experiments
        if _may_share(e) and e.count_steps(evaluation.z) > FEW and not _has_shares(e)
    }
    if not many or not np.isfinite(evaluation.cost):
        return problem, evaluation
    shared = share_steps(problem, evaluation.z, many)
    if not any(map(_has_shares, shared.experiments)):
        return problem, evaluation
    return shared, shared.evaluate(evaluation.z)


def copy_steps(problem: FitProblem, other: FitProblem) -> FitProblem:
    """Return the problem with the steps of another one's experiments: shared out as there where the samples are the
    same, or else the same number in every sample.
    """
    others = {experiment.name: experiment for experiment in other.experiments}

    def take(experiment: FitExperiment) -> FitExperiment:
        old = others.get(experiment.name)
        if old is None:
            return experiment
        if not (_has_shares(old) and _may_share(experiment) and _list_samples(experiment) == _list_samples(old)):
            return _with_even_steps(experiment, old.even_substeps)
        return _with_shares(replace(experiment, substeps=old.substeps), [s.samples.shares for s in old.segments])

    return replace(problem, experiments=tuple(map(take, problem.experiments)))


def even_steps(problem: FitProblem, names: Collection[str] | None = None) -> FitProblem:
    """Return the problem with as exact steps in every sample where they are shared out; `names`: of these experiments,
    all if left out.
    """
    shared = {e.name for e in problem.experiments if _has_shares(e) and (names is None or e.name in names)}
    if not shared:
        return problem
    experiments = (_with_even_steps(e, e.even_substeps) if e.name in shared else e for e in problem.experiments)
    return replace(problem, experiments=tuple(experiments))


def _list_samples(experiment: FitExperiment) -> list[tuple[float, int]]:
    return [(segment.samples.start_s, segment.samples.n) for segment in experiment.segments]


def _with_even_steps(experiment: FitExperiment, steps: int) -> FitExperiment:
    return _with_shares(replace(experiment, substeps=steps), [None] * len(experiment.segments))


def _has_shares(experiment: FitExperiment) -> bool:
    return experiment.segments[0].samples.shares is not None


def _may_share(experiment: FitExperiment) -> bool:
    return not (experiment.model.linear or experiment.model.sticks or remembers(experiment.data.plant))


def _with_shares(experiment: FitExperiment, shares: Sequence[Float[np.ndarray, "2 n"] | None]) -> FitExperiment:
    segments = (
        segment if segment.samples.shares is part else replace(segment, samples=replace(segment.samples, shares=part))
        for segment, part in zip(experiment.segments, shares, strict=True)
    )  # the same ones where nothing changes: kept passes are told apart by them
    return replace(experiment, segments=tuple(segments))


@np.errstate(all="ignore")
def _share(experiment: FitExperiment, z: Vector, steps: int) -> FitExperiment:
    whole = _with_even_steps(experiment, steps)
    if steps <= FEW or not _may_share(experiment):
        return whole
    before, order = experiment.count_steps(z), experiment.model.order
    counts, errors, stable = _measure(experiment, z)
    errors = np.maximum(errors, TINY)
    factors = errors * counts**order
    roots = factors ** (1.0 / (order + 1.0))
    allowed = np.sum(errors) * (before / steps) ** order
    asked = (np.sum(roots) / allowed) ** (1.0 / order) * roots
    uniform = min((np.sum(factors) / allowed) ** (1.0 / order), MAX_SUBSTEPS)
    grain = np.exp2(np.floor(np.log2(np.maximum(asked, GRAIN))) - np.log2(GRAIN))
    taken = np.clip(np.ceil(asked / grain) * grain, 1.0, MAX_SUBSTEPS)
    if not np.all(np.isfinite(asked + stable)) or np.mean(np.maximum(taken, stable)) > WORTH * uniform:
        return whole
    most, ends = np.max(taken), np.cumsum([segment.samples.n for segment in experiment.segments])[:-1]
    shares = np.array([taken / most, stable / experiment.count_least_steps(z)])
    return replace(_with_shares(experiment, np.split(shares, ends, axis=1)), substeps=int(most))


def _measure(experiment: FitExperiment, z: Vector) -> tuple[Samples, Samples, Samples]:
    """Return of every sample the steps that it takes, by how much half as long ones change its next state over each
    state's size, and how many steps are stable there or in the samples next to it.
    """
    point = experiment.point(z)
    passes = [experiment.run(segment, z, sums=False, states=True, changes=True) for segment in experiment.segments]
    states = np.concatenate([each.states for each in passes if each.states is not None])
    size = np.maximum(np.sqrt(np.mean(states**2, axis=0)), TINY)
    parts = list[tuple[Samples, ...]]()
    for segment, each in zip(experiment.segments, passes, strict=True):
        assert each.changes is not None and each.states is not None
        here = find_stable_steps(experiment.model, point, segment.samples, each.states)
        near = np.pad(here, 1, mode="edge")
        stable = np.maximum(np.maximum(near[:-2], near[2:]), here)
        parts.append((point.count_steps(segment.samples), np.max(np.abs(each.changes) / size, axis=1), stable))
    counts, errors, stable = map(np.concatenate, zip(*parts, strict=True))
    return counts.astype(float), errors, stable
