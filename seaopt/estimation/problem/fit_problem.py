r"""The weighted least-squares problem of a fit, evaluated by one pass per segment.

Residuals are in units of sigma: the cost is half their squared norm plus half that of the priors' residuals. A pass
gives each output's Gram matrix of [residual, derivatives]; weighting by 1/sigma^2 and adding up gives the cost, its
gradient and the Gauss-Newton Hessian.

Residuals are affine in some unknowns :math:`\nu` (offsets, drifts, initial states of linear plants). With squares as
the loss each evaluation moves to the best of them, which the same Gram matrices give exactly (variable projection,
Golub and Pereyra, SIAM J. Numer. Anal. 10(2), 1973, in Kaufman's form):

.. math:: \nu^* = \nu - H_{\nu\nu}^{-1} g_\nu, \qquad
          c^* = c - \tfrac12 g_\nu^T H_{\nu\nu}^{-1} g_\nu, \qquad
          g_\zeta^* = g_\zeta - H_{\zeta\nu} H_{\nu\nu}^{-1} g_\nu .

Process noise is an unknown through :math:`\lambda`, the logarithm of its standard deviation. Where it is hardly there
the residuals follow its variance :math:`w = e^{2\lambda}`, so that
:math:`c_{\lambda\lambda} = 4 w^2 c_{ww} + 2 c_\lambda`; where it rules they follow 1/w, which turns the sign of the
last term. Gauss and Newton see the first term alone, which dies out on either side: :math:`2 |c_\lambda|` is added, or
steps overshoot and the region shrinks for all unknowns. It stays in the Hessian that the covariance inverts:
where noise is hardly there it is the true second derivative.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from seaopt.errors import EstimationError
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_experiment import (
    FitExperiment,
    FitOutput,
    ResidualPower,
    make_fit_experiment,
    model_experiment,
)
from seaopt.estimation.problem.losses import Loss
from seaopt.estimation.problem.normal_equations import QuadraticModel, solve_seen
from seaopt.estimation.problem.shapes import Vector
from seaopt.estimation.problem.unknowns import Unknowns, collect
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants.friction import list_smoothing
from seaopt.records import record
from seaopt.simulation import Pass, measure_room, threads

LOST = 1e-3  # below zero: a sum of squares that is nothing but rounding of a far larger one
STILL = 1e-9  # of what its input could give a joint: no speed
ALONE = 8_000  # samples below which experiments are not worth a thread each

T = TypeVar("T")
_evaluations: ContextVar[int] = ContextVar("evaluations", default=0)
_work: ContextVar[int] = ContextVar("work", default=0)
_most: ContextVar[float] = ContextVar("most", default=np.inf)


class BudgetError(EstimationError):
    """As many evaluations were made as a search may make (`limit_evaluations`)."""


@record(eq=False)
class PassSet:
    """The passes of every experiment's segments, by its name, and the unknowns at which they were made."""

    z: Vector
    by_experiment: Mapping[str, tuple[Pass, ...]]


@record(eq=False)
class Evaluation(QuadraticModel):
    """Cost, gradient and Gauss-Newton Hessian at `z`, and the power of each experiment's residuals.

    Residuals are straight from where `passes` were made to `z`: the two differ in the linear unknowns alone, or by the
    last step of a search (see `least_squares`).
    """

    power: Mapping[str, ResidualPower]
    passes: PassSet


@record(eq=False)
class FitProblem:
    """Experiments and their unknowns: what a fit minimises."""

    # the data, with their models and weights; loss, band and holdout are the same in all
    experiments: tuple[FitExperiment, ...]
    unknowns: Unknowns  # what may change
    params: ParameterSet  # every parameter of the plants, free or not, as the fit starts

    @property
    def outputs(self) -> tuple[FitOutput, ...]:
        """Each measured output of each experiment."""
        return tuple(output for experiment in self.experiments for output in experiment.outputs)

    @property
    def loss(self) -> Loss:
        """The loss of all experiments."""
        return self.experiments[0].loss

    @property
    def band_hz(self) -> tuple[float, float] | None:
        """The band of all experiments."""
        return self.experiments[0].band_hz

    @property
    def holdout(self) -> float:
        """The part of each log that is held out."""
        return self.experiments[0].holdout

    @property
    def predicts(self) -> bool:
        """Whether the residuals are errors of prediction, not of simulation."""
        return self.experiments[0].predictor is not None

    @property
    def all_linear(self) -> bool:
        """Whether every plant is linear."""
        return all(experiment.model.linear for experiment in self.experiments)

    def with_each(self, **changes: Any) -> FitProblem:
        """Return the problem with the same changes to each experiment."""
        return replace(self, experiments=tuple(replace(experiment, **changes) for experiment in self.experiments))

    def with_values(self, field: str, values: Mapping[str, Any]) -> FitProblem:
        """Return the problem with other values of one field of its experiments, by their names."""
        experiments = (replace(e, **{field: values[e.name]}) if e.name in values else e for e in self.experiments)
        return replace(self, experiments=tuple(experiments))

    def map(self, call: Callable[[FitExperiment], T]) -> list[T]:
        """Call for every experiment; in threads of their own where they are long enough."""
        if len(self.experiments) < 2 or sum(experiment.samples for experiment in self.experiments) < ALONE:
            return [call(experiment) for experiment in self.experiments]
        futures = [threads().submit(copy_context().run, call, experiment) for experiment in self.experiments]
        return [future.result() for future in futures]

    def map_outputs(self, call: Callable[[FitOutput], T]) -> dict[str, dict[str, T]]:
        """Call for every output, and return what comes of it by experiment and output."""
        return {e.name: {output.name: call(output) for output in e.outputs} for e in self.experiments}

    def keep(self, z: Vector) -> None:
        """Make the passes at z with all that may be asked of them, where there is room to keep them."""
        if sum(experiment.count_bytes() for experiment in self.experiments) <= measure_room():
            self.map(lambda experiment: experiment.run_all(z, keep=True))

    def keep_within(self, z: Vector, wider: FitProblem, at: Float[np.ndarray, " m"]) -> None:
        """Make the passes of the same problem with more unknowns with all that may be asked of them, and keep those at
        z as parts of them, where there is room and both are simulations.
        """
        there = {experiment.name: experiment for experiment in wider.experiments}
        if not self.predicts and sum(e.count_bytes() for e in wider.experiments) <= measure_room():
            self.map(lambda experiment: experiment.keep_within(z, there[experiment.name], at))

    def simulates_alike(self, z: Vector, wider: FitProblem, at: Float[np.ndarray, " m"]) -> bool:
        """Tell whether the same problem with more unknowns simulates each experiment as this one does at z."""
        there = {experiment.name: experiment for experiment in wider.experiments}
        return all(experiment.simulates_alike(z, there[experiment.name], at) for experiment in self.experiments)

    def evaluate(self, z: Vector) -> Evaluation:
        """Return cost, gradient and Hessian at the best linear unknowns; infinite if it overflows or is too stiff."""
        if count_left() < 1.0:
            raise BudgetError("no evaluation is left of those that this search may make")
        _evaluations.set(_evaluations.get() + 1)
        _work.set(_work.get() + self.count_work(z))
        passes = self.map(lambda experiment: (experiment.name, experiment.run_all(z)))
        evaluation = self.assemble(PassSet(z=z, by_experiment=dict(passes)))
        return replace(evaluation, cost=np.inf) if any(e.is_too_stiff(z) for e in self.experiments) else evaluation

    def count_work(self, z: Vector) -> int:
        """Return what an evaluation at z takes: its integration steps, and one for the residual of each sample."""
        return sum(experiment.samples + experiment.count_all_steps(z) for experiment in self.experiments)

    @property
    def shared_names(self) -> tuple[str, ...]:
        """The free parameters of the plants, which come first among the unknowns."""
        return self.unknowns.names[: self.unknowns.shared]

    def find_smoothing(self) -> list[int]:
        """Return the unknowns that are speeds over which some plant's friction is smoothed through zero."""
        plants = [experiment.data.plant for experiment in self.experiments if not experiment.model.sticks]
        names = {name for plant in plants for name in list_smoothing(plant)}
        return [i for i, name in enumerate(self.shared_names) if name in names]

    @property
    def seeks_play(self) -> bool:
        """Whether a spring's play is among the unknowns: there are then minima in which it opens at other times."""
        springs = (experiment.data.plant.spring for experiment in self.experiments)
        return any(spring is not None and spring.play in self.shared_names for spring in springs)

    def find_stopped(self) -> list[int]:
        """Return the unknowns that are speeds at a start which friction that sticks can stop: those with a prior."""
        unknowns = self.unknowns
        pairs = enumerate(zip(unknowns.names, unknowns.prior_std, strict=True))
        return [i for i, (name, std) in pairs if i >= unknowns.shared and ".initial" in name and np.isfinite(std)]

    def find_resting(self, z: Vector) -> list[int]:
        """Return those unknowns where all of them are at rest, to rounding; none where one is not."""
        places = self.find_stopped()
        return places if np.all(np.abs(z[places]) <= STILL * self.unknowns.prior_std[places]) else []

    @np.errstate(all="ignore")  # a plant that overflows gives a cost that is not finite, which callers check
    def assemble(self, passes: PassSet, to: Vector | None = None) -> Evaluation:
        """Return the evaluation that passes give: other sigmas need no other passes. It is that of `to`, if given, as
        far as residuals are straight to there.
        """
        z, n, unknowns = passes.z, passes.z.size, self.unknowns
        cost, gradient, hessian = unknowns.prior(z)
        normal = np.zeros((1 + n, 1 + n))
        for experiment in self.experiments:
            row = passes.by_experiment[experiment.name]
            experiment.add_normal(normal, row)
            cost += experiment.cost(row)
        gradient, hessian = gradient + normal[0, 1:], hessian + normal[1:, 1:]
        noise = [slot.index for e in self.experiments for slot in e.slots.noise if slot.index is not None]
        hessian[noise, noise] += 2.0 * np.abs(normal[0, 1:][noise])  # see above; each is of one experiment
        finite = np.isfinite(cost) and np.all(np.isfinite(gradient)) and np.all(np.isfinite(hessian))
        linear = unknowns.linear if self.exactly_linear else np.zeros(n, dtype=bool)
        moved = np.zeros(n) if to is None else to - z
        if finite and to is not None:
            bent = hessian @ moved
            cost += float(moved @ (gradient + 0.5 * bent))
            gradient = gradient + bent
        if finite and np.any(linear):
            best = np.zeros(n)
            best[linear] = -solve_seen(hessian[linear][:, linear], gradient[linear], 1e-13)
            cost += 0.5 * float(best @ gradient)
            finite = finite and cost > -LOST
            gradient = np.where(linear, 0.0, gradient + hessian @ best)
            moved += best
        return Evaluation(
            z=z + moved,
            cost=cost if finite else np.inf,
            gradient=gradient,
            hessian=hessian,
            linear=linear,
            power={e.name: e.power(passes.by_experiment[e.name], moved) for e in self.experiments},
            passes=passes,
        )

    def follow(self, evaluation: Evaluation, z: Vector) -> Evaluation:
        """Return the evaluation at a `z` nearby, as far as residuals are straight to there."""
        return self.assemble(evaluation.passes, z)

    @property
    def straight(self) -> bool:
        """Whether a pass gives the weighted residuals nearby too: it does for least squares of simulation errors."""
        return self.loss.quadratic and not self.predicts

    @property
    def exactly_linear(self) -> bool:
        """Whether the linear unknowns' best values follow from one evaluation."""
        return self.loss.quadratic and (not self.predicts or self.all_linear)

    def rebuild(
        self, params: ParameterSet, z: Vector, data: Mapping[str, Experiment] | None = None
    ) -> tuple[FitProblem, Float[np.ndarray, " m"]]:
        """Return the problem with other parameters free, and `z` in its unknowns; new ones are at their start.
        `params`: whose free ones are the unknowns; `z`: unknowns of this problem; `data`: experiments that take the
        place of those of the same name.
        """
        experiments = tuple((data or {}).get(e.name, e.data) for e in self.experiments)
        unknowns, modelled = collect(experiments, params, noise=self.predicts, band_hz=self.band_hz)
        start, values = unknowns.start.copy(), unknowns.start.copy()
        for name, first, value in zip(self.unknowns.names, self.unknowns.start, z, strict=True):
            if name in unknowns.names:
                index = unknowns.names.index(name)
                start[index], values[index] = first, value
        rebuilt = tuple(
            replace(old, data=new, **model_experiment(new, model, slots, unknowns.names, old.holdout))
            for old, new, (model, slots) in zip(self.experiments, experiments, modelled, strict=True)
        )
        return FitProblem(experiments=rebuilt, unknowns=replace(unknowns, start=start), params=params), values


def count_evaluations() -> int:
    """Return how often problems have been evaluated here, which is what searches are counted in, not in seconds."""
    return _evaluations.get()


def count_left() -> float:
    """Return how many evaluations may still be made here: see `limit_evaluations`."""
    return _most.get() - _evaluations.get()


@contextmanager
def limit_evaluations(count: float) -> Generator[None]:
    """Refuse evaluations inside after so many, with `BudgetError`; a limit around it holds, too."""
    token = _most.set(min(_most.get(), _evaluations.get() + count))
    try:
        yield
    finally:
        _most.reset(token)


def count_work() -> int:
    """Return what these evaluations took, in integration steps (`FitProblem.count_work`)."""
    return _work.get()


def pose_problem(
    experiments: tuple[Experiment, ...],
    params: ParameterSet,
    *,
    loss: Loss,
    band_hz: tuple[float, float] | None = None,
    holdout: float = 0.0,
    noise: bool = False,
) -> FitProblem:
    """Return the fit of the free parameters, others at the plants' defaults; with `noise`, of the process noise too."""
    names = [experiment.name for experiment in experiments]
    if len(set(names)) < len(names):
        raise EstimationError(f"experiments are named {', '.join(names)}; give each a name of its own")
    params = _complete_parameters(experiments, params)
    unknowns, modelled = collect(experiments, params, noise=noise, band_hz=band_hz)
    posed = tuple(
        make_fit_experiment(data, model, slots, unknowns.names, loss=loss, band_hz=band_hz, holdout=holdout)
        for data, (model, slots) in zip(experiments, modelled, strict=True)
    )
    return FitProblem(experiments=posed, unknowns=unknowns, params=params)


def _complete_parameters(experiments: tuple[Experiment, ...], params: ParameterSet) -> ParameterSet:
    """Return every parameter of the plants, in order, and the free ones that no plant has (an error later)."""
    parameters: dict[str, Parameter] = {}
    for experiment in experiments:
        for name, parameter in experiment.plant.complete(experiment.apply_own(params)).items():
            parameters.setdefault(name, params.get(name, parameter) if name in experiment.parameters else parameter)
        for local in experiment.list_own().values():
            parameters.setdefault(local.name, params.get(local.name, local))
    for name in params.free_names:
        parameters.setdefault(name, params[name])
    return ParameterSet(parameters.values())
