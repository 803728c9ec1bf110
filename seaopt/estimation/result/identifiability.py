r"""Identifiability: rank, condition, and the directions of the parameters that the data do not show, in words.

The Hessian of the parameters, everything else an experiment has of its own eliminated, is scaled to a unit diagonal. An
eigenvalue that is zero to rounding is a direction in which the parameters can change together without any effect on
any output (a null direction of the sensitivities); a small one is a direction that only the parameters' different
shares in the noise distinguish. Whether a null direction belongs to the plant or to the log follows from a second look:
the sensitivities to a rich made-up input. What that does not show, no log of these outputs can show.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import replace

import numpy as np

from seaopt.codec import OrInfinite
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.normal_equations import RANK, eliminate
from seaopt.estimation.problem.shapes import Matrix, ParameterVector, Vector
from seaopt.formatting import format_percent, join_words
from seaopt.parameters import ParameterSet
from seaopt.plants import CompletedParameters
from seaopt.records import record
from seaopt.simulation import Segment, run_passes
from seaopt.units import unit_after

WEAK = 1e-5  # eigenvalues below this part of the largest: standard deviations a few hundred times those of one alone
ROUNDING = 1e-5  # of the largest relative change along a direction: less is none
RICH = 600  # samples of made-up input


@record
class Identifiability:
    """The directions of the free parameters that the data identify, and those that they do not.

    Parameters
    ----------
    rank, free : int
        Directions seen in the data (and priors), and free parameters.
    condition : float
        Ratio of the largest to the smallest singular value of the normalised sensitivities.
    unidentifiable : tuple of mappings
        One per direction that has no effect: relative changes {NAME: weight} that leave every output as it is.
    weak : tuple of mappings
        The same for directions that have hardly any effect.
    structural_rank : int
        Directions that a rich input would show on the same outputs; below `free`, no log can identify all parameters.
    """

    rank: int
    free: int
    condition: OrInfinite
    unidentifiable: tuple[dict[str, float], ...]
    weak: tuple[dict[str, float], ...] = ()
    structural_rank: int = -1

    @property
    def unidentified(self) -> frozenset[str]:
        """Every parameter that changes along a direction without effect: its value is one choice among others."""
        return frozenset(name for direction in self.unidentifiable for name in direction)

    def determines(self, slope: Mapping[str, float], values: Mapping[str, float]) -> bool:
        """Tell whether a figure with this slope in the parameters is the same along every direction without effect.
        `values`: the parameters', to which the directions are relative.
        """
        for direction in self.unidentifiable:
            parts = [slope.get(name, 0.0) * weight * (abs(values[name]) or 1.0) for name, weight in direction.items()]
            if abs(sum(parts)) > ROUNDING * sum(abs(part) for part in parts):
                return False
        return True


def assess_identifiability(hessian: Matrix, names: tuple[str, ...], values: ParameterVector) -> Identifiability:
    """Return the identifiability of the first ``len(names)`` unknowns, the others eliminated from the Hessian. `values`
    are those of the unknowns, to which changes along an unseen direction are relative.
    """
    p = len(names)
    if not p:
        return Identifiability(rank=0, free=0, condition=1.0, unidentifiable=())
    reduced, diagonal = eliminate(hessian, p), np.diag(hessian)[:p]
    size = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    eigenvalues, vectors = np.linalg.eigh(reduced / np.outer(size, size))
    largest = max(float(eigenvalues[-1]), 1e-300)
    smallest = max(float(eigenvalues[0]), 0.0)
    relative = size * np.where(values != 0.0, np.abs(values), 1.0)

    def directions(chosen: ParameterVector, cut: float) -> tuple[dict[str, float], ...]:
        weighted: list[dict[str, float]] = []
        for k in np.flatnonzero(chosen):
            weights = vectors[:, k] / relative
            weights = weights / np.max(np.abs(weights))
            weighted.append({name: float(w) for name, w in zip(names, weights, strict=True) if abs(w) > cut})
        return tuple(weighted)

    unseen = eigenvalues <= RANK * largest
    return Identifiability(
        rank=p - int(np.count_nonzero(unseen)),
        free=p,
        condition=float(np.sqrt(largest / smallest)) if smallest > RANK * largest else np.inf,
        unidentifiable=directions(unseen.astype(float), ROUNDING),
        weak=directions((~unseen & (eigenvalues <= WEAK * largest)).astype(float), 0.1),
    )


def compute_structural_rank(problem: FitProblem, z: Vector) -> int:
    """Return how many directions of the parameters a rich input would show on the outputs that were measured. The input
    is white noise of the log's own size on every input that the log excites, from rest and without noise.
    """
    p = problem.unknowns.shared
    information = np.diag(problem.unknowns.precision[:p])
    rng = np.random.default_rng(0)
    for experiment in problem.experiments:
        model, index, log = experiment.model, experiment.theta, experiment.segments[0].samples
        spans = [float(np.ptp(channel)) for channel in log.u]
        u = tuple(span * rng.normal(size=RICH) for span in spans)
        rich = Segment(u=u, y=(np.zeros(RICH),) * model.ny, start_s=log.start_s)
        point = replace(experiment.point(z), correction=None)
        passes = run_passes(model, rich, point, np.zeros(model.nx))
        for o in range(model.ny):
            gram = passes.gram[o, 1 : 1 + index.size, 1 : 1 + index.size] / experiment.sigma[o] ** 2
            information[index[:, None], index] += gram
    if not np.all(np.isfinite(information)):
        return -1
    size = np.sqrt(np.where(np.diag(information) > 0.0, np.diag(information), 1.0))
    values = np.linalg.eigvalsh(information / np.outer(size, size))
    return int(np.count_nonzero(values > RANK * max(float(values[-1]), 1e-300)))


def describe_direction(direction: dict[str, float], alone_seen: bool) -> str:
    """Return in words what cannot be identified. `direction`: relative changes that have no effect; `alone_seen`:
    whether the outputs depend on the parameter, if it is one alone.
    """
    names = sorted(direction)
    if len(names) == 1:
        if alone_seen:
            kinds = "gain, offset, delay, initial state"
            return f"{names[0]} cannot be distinguished from an experiment's own unknowns ({kinds})"
        return f"{names[0]} has no effect on any output"
    if len(names) == 2 and abs(abs(direction[names[0]]) - abs(direction[names[1]])) < 1e-2:
        how = "product" if direction[names[0]] * direction[names[1]] < 0.0 else "ratio"
        return f"{names[0]} and {names[1]} enter only together, as their {how}"
    weights = list(direction.values())
    if min(weights) > 0.99 * max(weights) > 0.0:
        return f"{join_words(names)} are known only in their ratios: all of them times one factor change no output"
    changes = ", ".join(f"{name} {format_percent(direction[name], 3, '+')}" for name in names)
    return f"{join_words(names)} enter only together: {changes} change no output"


def warn_unidentified(params: ParameterSet, used: Container[str] | None = None) -> tuple[str, ...]:
    """Return a warning that names values from a fit that cannot identify them, and one of those fitted for logs alone.

    Nothing where there are none.

    Parameters
    ----------
    params : ParameterSet
        The parameters of a computation.
    used : container of str, optional
        The names that matter; all if left out.
    """
    alone = _warn_alone(params.given if isinstance(params, CompletedParameters) else params, used)
    names = [name for name in params.unidentified_names if used is None or name in used]
    if not names:
        return alone
    values = ", ".join(f"{name} = {params[name].value:.4g}{unit_after(params[name].unit)}" for name in names)
    verb = "is" if len(names) == 1 else "are"
    return (
        f"the fit does not identify {join_words(names)}: {values} {verb} one choice among others that fit as well, "
        "and what follows at these values holds for no other; excite more, or give a value, a prior, or a range to "
        "certify over",
        *alone,
    )


def _warn_alone(params: ParameterSet, used: Container[str] | None) -> tuple[str, ...]:
    """Return a warning of each parameter that was fitted for single logs, EXPERIMENT.NAME: nothing else takes those."""
    fitted: dict[str, list[str]] = {}
    for label, parameter in params.items():
        experiment, dot, name = label.partition(".")
        if dot and (used is None or name in used):
            value = f"{parameter.value:.4g}{unit_after(parameter.unit)}"
            fitted.setdefault(name, []).append(f"{value} in {experiment}")
    taken = {
        name: f"{name} = {params[name].value:.4g}{unit_after(params[name].unit)}" if name in params else "its default"
        for name in fitted
    }
    return tuple(
        f"{name} was fitted for single logs ({', '.join(values)}), and what follows is for {taken[name]}; give the "
        "value that is meant, or a range to certify over"
        for name, values in fitted.items()
    )
