"""Fit plants to logs: one call from experiments to parameters with their uncertainty."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.errors import EstimationError
from seaopt.estimation.problem.experiment import Experiment, check_shots, is_constant
from seaopt.estimation.problem.losses import Huber, Linear, Loss, SoftL1
from seaopt.estimation.problem.methods import Method, MultipleShooting, OutputError, PredictionError
from seaopt.estimation.problem.residual_statistics import count_of
from seaopt.estimation.problem.residuals import Residuals, spread_of
from seaopt.estimation.problem.unknowns import Unknowns, collect
from seaopt.estimation.result.fit_result import Fit
from seaopt.estimation.result.summary import summarise
from seaopt.estimation.solver.least_squares import Callback
from seaopt.estimation.solver.shooting import multiple_shooting
from seaopt.estimation.solver.solve import Solved, output_error, prediction_error
from seaopt.parameters import Parameter, ParameterSet
from seaopt.simulation.simulate import input_samples


def fit(
    experiments: Sequence[Experiment],
    params: ParameterSet,
    *,
    method: Method | None = None,
    loss: Loss | None = None,
    band_hz: tuple[float, float] | None = None,
    holdout: float = 0.0,
    diagnostics: bool = True,
    callback: Callback | None = None,
) -> Fit:
    """Fit the free parameters of `params` to one or several experiments that share them.

    Parameters
    ----------
    experiments : sequence of Experiment
        Logs with their plants.
    params : ParameterSet
        Values, bounds and priors; the free ones are estimated, from anywhere within a factor of ten.
    method : OutputError, MultipleShooting or PredictionError, optional
        How the plant is compared with a log; OutputError if left out.
    loss : Linear, Huber or SoftL1, optional
        Least squares if left out.
    band_hz : (low, high), optional
        Residuals are weighted to this band.
    holdout : float
        The last fraction of each log is kept back, for validation.
    diagnostics : bool
        False leaves out what needs the residuals of every sample: the stds are then those for white residuals, and
        the outputs' figures are not there.
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
    if not 0.0 <= holdout <= 0.9:
        raise EstimationError(f"holdout = {holdout:g} is not a fraction; give 0 (none) to 0.9")
    check_choices(chosen, loss, band_hz)
    _check_motion(named)
    complete = _complete(named, params)
    unknowns = collect(named, complete, noise=isinstance(chosen, PredictionError), band_hz=band_hz)
    problem = _problem(named, unknowns, loss if loss is not None else Linear(), band_hz, holdout)
    solved = _solved(problem, complete, chosen, callback)
    return summarise(complete, solved, chosen, diagnostics, started)


def check_choices(method: Any, loss: Any, band_hz: Any) -> None:
    """Refuse what is no method, no loss or no band."""
    if not isinstance(method, OutputError | MultipleShooting | PredictionError):
        raise EstimationError(
            f"method = {method!r} is no method; give OutputError(), MultipleShooting() or PredictionError()"
        )
    if loss is not None and not isinstance(loss, Linear | Huber | SoftL1):
        raise EstimationError(f"loss = {loss!r} is no loss; give Linear(), Huber() or SoftL1()")
    if band_hz is not None and (not isinstance(band_hz, tuple | list) or len(band_hz) != 2):
        raise EstimationError(f"band_hz = {band_hz!r} is not a band; give (low, high) in Hz")
    if band_hz is not None and isinstance(method, PredictionError):
        raise EstimationError(
            f"band_hz = {band_hz!r} does not go with PredictionError, whose filter models the noise; leave it out"
        )


def _solved(problem: Residuals, params: ParameterSet, method: Method, callback: Callback | None) -> Solved:
    if isinstance(method, MultipleShooting):
        return multiple_shooting(problem, params, method, callback)
    if isinstance(method, PredictionError):
        return prediction_error(problem, method, callback)
    return output_error(problem, method, callback)


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
    spreads: list[Float[np.ndarray, " ny"]] = []
    for experiment in experiments:
        spread = [spread_of(experiment.log[name]) for name in experiment.outputs]
        spreads.append(np.array(spread))
        known = [experiment.sigma.get(name, s or 1.0) for name, s in zip(experiment.outputs, spread, strict=True)]
        sigma.append(np.array(known))
    problem = Residuals(
        experiments=experiments, segments=segments, unknowns=unknowns, sigma=tuple(sigma), loss=loss, band_hz=band_hz,
        substeps=(1,) * len(experiments), holdout=holdout, spread=tuple(spreads),
    )  # fmt: skip
    for e, experiment in enumerate(experiments):
        settle = problem.weights(e).settle
        seen = sum(count_of(piece) for piece in segments[e])
        for name, count in zip(experiment.outputs, np.asarray(seen), strict=True):
            if not count:
                raise EstimationError(
                    f"experiment {experiment.name}: output {name} has no sample that counts; "
                    "leave it out of outputs, or keep back less (holdout)"
                )
        whole = max(stretch.stop - stretch.start for stretch in experiment.stretches)
        check_shots(experiment, whole, experiment.shots, f"shots = {experiment.shots}")
        longest = max(segment.n for segment in segments[e])
        if longest <= settle + 2:
            raise EstimationError(
                f"experiment {experiment.name}: its longest segment has {longest} samples"
                + (f" and the band filter takes {settle} to settle; widen band_hz or" if settle else ";")
                + " use a longer log"
            )
    return problem
