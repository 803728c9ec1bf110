"""The vector of a fit's unknowns: parameters of the plants first, then each experiment's own."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from seaopt.errors import EstimationError, suggestion
from seaopt.estimation.experiment import Experiment
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants.linear import point
from seaopt.simulation import Model, make_model


@dataclass(frozen=True, slots=True, kw_only=True)
class Slot:
    """A value that is either known, or an entry of the vector of unknowns."""

    value: float
    index: int | None = None

    def at(self, z: Float[np.ndarray, " n"]) -> float:
        """Return the value at `z`."""
        return self.value if self.index is None else float(z[self.index])


@dataclass(frozen=True, slots=True, kw_only=True)
class Locals:
    """The slots of one experiment: delay, gain and offset an output, initial state a segment."""

    delay: Slot
    gain: tuple[Slot, ...]
    offset: tuple[Slot, ...]
    initial: tuple[tuple[Slot, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Unknowns:
    """All that a fit may change, with bounds and priors.

    Parameters
    ----------
    names : tuple of str
        One a value; an experiment's own are written EXPERIMENT.WHAT.
    start, low, high : array, shape (n,)
        First value and bounds.
    prior_std : array, shape (n,)
        Infinite where there is no prior; a prior is centred on `start`.
    shared : int
        The first so many are parameters of the plants.
    locals_of : tuple of Locals
        One an experiment.
    models : tuple of Model
        One an experiment, in its own free parameters.

    """

    names: tuple[str, ...]
    start: Float[np.ndarray, " n"]
    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]
    prior_std: Float[np.ndarray, " n"]
    shared: int
    locals_of: tuple[Locals, ...]
    models: tuple[Model, ...]

    def theta(self, model: Model, z: Float[np.ndarray, " n"]) -> Float[np.ndarray, " np"]:
        """Return a model's free parameters at `z`."""
        return z[self.theta_index(model)]

    def theta_index(self, model: Model) -> list[int]:
        """Return where a model's free parameters stand."""
        return [self.names.index(name) for name in model.free]


class _Builder:
    """Collects unknowns one by one; lives only inside `collect`."""

    def __init__(self) -> None:
        self.items: list[Parameter] = []

    def add(self, item: Parameter) -> Slot:
        self.items.append(item)
        return Slot(value=item.value, index=len(self.items) - 1)

    def maybe(self, given: float | Parameter, name: str, low: float) -> Slot:
        """Add a free Parameter under `name`; a number, or one that is not free, is known."""
        if not isinstance(given, Parameter):
            return Slot(value=float(given))
        if not given.free:
            return Slot(value=given.value)
        return self.add(
            Parameter(
                name=name, value=given.value, unit=given.unit, free=True, min=max(given.min, low), max=given.max,
                prior_std=given.prior_std,
            )
        )  # fmt: skip


def collect(experiments: tuple[Experiment, ...], params: ParameterSet) -> Unknowns:
    """List the unknowns of a fit.

    Raises
    ------
    EstimationError
        Nothing is free, or a free parameter belongs to no plant of the experiments.

    """
    used = {name for experiment in experiments for name in experiment.plant.parameters}
    for name in params.free_names:
        if name not in used:
            raise EstimationError(
                f"parameter {name} is free, but no plant of the experiments has it; {suggestion(name, used)}"
            )
    if not params.free_names:
        raise EstimationError("no parameter is free; free one: params.free('J'), or free = true in a problem file")
    builder = _Builder()
    for name in params.free_names:
        builder.add(params[name])
    shared = len(builder.items)
    models = tuple(make_model(e.plant, params, params.free_names, e.outputs) for e in experiments)
    places = tuple(_locals(builder, experiment) for experiment in experiments)
    items = builder.items
    return Unknowns(
        names=tuple(item.name for item in items),
        start=np.array([item.value for item in items]),
        low=np.array([item.min for item in items]),
        high=np.array([item.max for item in items]),
        prior_std=np.array([item.prior_std if item.prior_std is not None else math.inf for item in items]),
        shared=shared,
        locals_of=places,
        models=models,
    )


def _locals(builder: _Builder, experiment: Experiment) -> Locals:
    name, plant = experiment.name, experiment.plant
    delay = builder.maybe(experiment.delay_s, f"{name}.delay_s", 0.0)
    gain = tuple(builder.maybe(experiment.gain.get(o, 1.0), f"{name}.gain.{o}", -math.inf) for o in experiment.outputs)
    offset: list[Slot] = []
    for output in experiment.outputs:
        if experiment.offset is True:
            unit = plant.outputs[output]
            offset.append(builder.add(Parameter(name=f"{name}.offset.{output}", value=0.0, unit=unit, free=True)))
        else:
            known = experiment.offset if experiment.offset else {}
            offset.append(Slot(value=float(known.get(output, 0.0))))
    initial: list[tuple[Slot, ...]] = []
    for number in range(len(experiment.log.segments)):
        if experiment.initial_state == "estimate":
            label = f"{name}.initial" if number == 0 else f"{name}.initial{number + 1}"
            initial.append(
                tuple(
                    builder.add(Parameter(name=f"{label}.{state}", value=0.0, unit=unit, free=True))
                    for state, unit in plant.states.items()
                )
            )
        else:
            known_state = None if experiment.initial_state == "rest" else dict(experiment.initial_state)
            initial.append(tuple(Slot(value=float(v)) for v in point("state", plant.states, known_state)))
    return Locals(delay=delay, gain=gain, offset=tuple(offset), initial=tuple(initial))
