"""The vector of a fit's unknowns: parameters of the plants first, then each experiment's own."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.errors import EstimationError, SeaoptError, suggestion
from seaopt.estimation.problem.experiment import Experiment
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants.plant import fill_vector
from seaopt.records import record
from seaopt.simulation import Model, depends_on_time, make_model
from seaopt.units import factor

NOISE_START, NOISE_PRIOR = math.log(1e-2), 3.0  # of the logarithm of process noise over the state's size


@record
class Slot:
    """A value that is either known, or an entry of the vector of unknowns."""

    value: float
    index: int | None = None

    def at(self, z: Float[np.ndarray, " n"]) -> float:
        """Return the value at `z`."""
        return self.value if self.index is None else float(z[self.index])


@record
class Locals:
    """The slots of one experiment: delay; gain, offset and drift an output; initial state a segment.

    `noise` is there for prediction-error fits alone: logarithms of the process noise a state.
    """

    delay: Slot
    gain: tuple[Slot, ...]
    offset: tuple[Slot, ...]
    drift: tuple[tuple[Slot, ...], ...]
    initial: tuple[tuple[Slot, ...], ...]
    noise: tuple[Slot, ...] = ()


@record(eq=False)
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
    linear : array of bool, shape (n,)
        What residuals are affine in: offsets, drifts, and initial states of linear plants.
    shared : int
        The first so many are parameters of the plants.
    locals_of : tuple of Locals
        One an experiment.
    models : tuple of Model
        One an experiment, in its own free parameters.
    places : dict
        What `columns` has found.

    """

    names: tuple[str, ...]
    start: Float[np.ndarray, " n"]
    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]
    prior_std: Float[np.ndarray, " n"]
    linear: Bool[np.ndarray, " n"]
    shared: int
    locals_of: tuple[Locals, ...]
    models: tuple[Model, ...]
    places: dict[tuple[int, int, bool], list[Int[np.ndarray, " nc"]]] = field(
        init=False, default_factory=dict, repr=False
    )

    @property
    def precision(self) -> Float[np.ndarray, " n"]:
        """What the priors know of each unknown: 1/std^2, zero where there is none."""
        return self.prior_std**-2.0

    def prior(self, z: Float[np.ndarray, " n"]) -> tuple[float, Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
        """Return the priors' part of the cost at `z`, of its gradient and of its Hessian."""
        away = (z - self.start) / self.prior_std
        return 0.5 * float(away @ away), away / self.prior_std, np.diag(self.precision)

    def theta(self, model: Model, z: Float[np.ndarray, " n"]) -> Float[np.ndarray, " np"]:
        """Return a model's free parameters at `z`."""
        return z[self.theta_index(model)]

    def theta_index(self, model: Model) -> list[int]:
        """Return where a model's free parameters stand."""
        return [self.names.index(name) for name in model.free]

    def columns(self, e: int, s: int, corrected: bool = False) -> list[Int[np.ndarray, " nc"]]:
        """Return, for each output, which unknown each derivative column of segment s is; -1 for none."""
        if (e, s, corrected) not in self.places:
            self.places[e, s, corrected] = self._columns(e, s, corrected)
        return self.places[e, s, corrected]

    def _columns(self, e: int, s: int, corrected: bool) -> list[Int[np.ndarray, " nc"]]:
        places, model = self.locals_of[e], self.models[e]
        own = [
            [offset, *drift, gain] for offset, drift, gain in zip(places.offset, places.drift, places.gain, strict=True)
        ]
        shared = self.theta_index(model)
        shared += [] if places.delay.index is None else [places.delay.index]
        if corrected:
            shared += [slot.index for slot in places.noise if slot.index is not None]
        found: list[Int[np.ndarray, " nc"]] = []
        for o in range(len(own)):
            rest = [slot for row in (own if corrected else [own[o]]) for slot in row]
            index = [-1 if slot.index is None else slot.index for slot in (*places.initial[s], *rest)]
            found.append(np.array([*shared, *index], dtype=int))
        return found


class _Builder:
    """Collects unknowns one by one; lives only inside `collect`."""

    def __init__(self) -> None:
        self.items: list[Parameter] = []
        self.linear: list[bool] = []

    def add(self, item: Parameter, linear: bool = False) -> Slot:
        self.items.append(item)
        self.linear.append(linear)
        return Slot(value=item.value, index=len(self.items) - 1)

    def maybe(self, given: float | Parameter, name: str, unit: str, low: float) -> Slot:
        """Add a free Parameter under `name`; a number, or one that is not free, is known. Its unit is converted."""
        if not isinstance(given, Parameter):
            return Slot(value=float(given))
        try:
            scale = factor(given.unit, unit) if given.unit else 1.0
        except SeaoptError as error:
            raise EstimationError(f"{name} is in {given.unit}, and must be in {unit}: {error}") from error
        if not given.free:
            return Slot(value=scale * given.value)
        prior = None if given.prior_std is None else scale * given.prior_std
        return self.add(
            Parameter(
                name=name, value=scale * given.value, unit=unit, free=True, min=max(scale * given.min, low),
                max=scale * given.max, prior_std=prior,
            )
        )  # fmt: skip


def collect(
    experiments: tuple[Experiment, ...],
    params: ParameterSet,
    noise: bool = False,
    band_hz: tuple[float, float] | None = None,
) -> Unknowns:
    """List the unknowns of a fit; with `noise`, those of the process noise too.

    A band that leaves out 0 Hz does not see offsets and drifts, nor an initial state that is forgotten before the band
    filter has settled: those are then not estimated.

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
    pairs = zip(experiments, models, strict=True)
    places = tuple(_locals(builder, experiment, model, noise, band_hz) for experiment, model in pairs)
    items = builder.items
    return Unknowns(
        names=tuple(item.name for item in items),
        start=np.array([item.value for item in items]),
        low=np.array([item.min for item in items]),
        high=np.array([item.max for item in items]),
        prior_std=np.array([item.prior_std if item.prior_std is not None else math.inf for item in items]),
        linear=np.array(builder.linear),
        shared=shared,
        locals_of=places,
        models=models,
    )


def _locals(
    builder: _Builder, experiment: Experiment, model: Model, noise: bool, band_hz: tuple[float, float] | None
) -> Locals:
    name = experiment.name
    level = band_hz is None or band_hz[0] <= 0.0
    forgotten = not level and _forgotten(builder, experiment, model, band_hz)
    delay = builder.maybe(experiment.delay_s, f"{name}.delay_s", "s", 0.0)
    gain = tuple(
        builder.maybe(experiment.gain.get(o, 1.0), f"{name}.gain.{o}", "-", -math.inf) for o in experiment.outputs
    )
    no_drift: tuple[tuple[Slot, ...], ...] = ((),) * len(experiment.outputs)
    if delay.index is not None and depends_on_time(model):
        raise EstimationError(
            f"experiment {name}: delay_s is free and {experiment.plant.name} depends on time itself; "
            "give delay_s a value"
        )
    return Locals(
        delay=delay, gain=gain, offset=_offsets(builder, experiment, level),
        drift=_drifts(builder, experiment) if level else no_drift,
        initial=_initial(builder, experiment, model.linear, forgotten),
        noise=_noise(builder, experiment) if noise else (),
    )  # fmt: skip


def _free(builder: _Builder, name: str, unit: str, linear: bool = True) -> Slot:
    return builder.add(Parameter(name=name, value=0.0, unit=unit, free=True), linear)


def _offsets(builder: _Builder, experiment: Experiment, level: bool) -> tuple[Slot, ...]:
    if experiment.offset is True and level:
        units = experiment.plant.outputs
        return tuple(_free(builder, f"{experiment.name}.offset.{o}", units[o]) for o in experiment.outputs)
    known = experiment.offset if isinstance(experiment.offset, Mapping) else {}
    return tuple(Slot(value=float(known.get(o, 0.0))) for o in experiment.outputs)


def _drifts(builder: _Builder, experiment: Experiment) -> tuple[tuple[Slot, ...], ...]:
    return tuple(
        tuple(
            _free(builder, f"{experiment.name}.drift{order}.{o}", experiment.plant.outputs[o])
            for order in range(1, experiment.drift + 1)
        )
        for o in experiment.outputs
    )


def _initial(builder: _Builder, experiment: Experiment, linear: bool, forgotten: bool) -> tuple[tuple[Slot, ...], ...]:
    """A known initial state is that of each stretch of the log; shots within a stretch start from unknown ones."""
    plant, given = experiment.plant, experiment.initial_state
    known = fill_vector("state", plant.states, dict(given) if isinstance(given, Mapping) else None)
    starts = {stretch.start for stretch in experiment.stretches}
    found: list[tuple[Slot, ...]] = []
    for number, piece in enumerate(experiment.pieces):
        if forgotten or (given != "estimate" and piece.start in starts):
            found.append(tuple(Slot(value=float(v)) for v in known))
            continue
        label = f"{experiment.name}.initial{number + 1 if number else ''}"
        found.append(tuple(_free(builder, f"{label}.{state}", unit, linear) for state, unit in plant.states.items()))
    return tuple(found)


def _forgotten(builder: _Builder, experiment: Experiment, model: Model, band_hz: tuple[float, float] | None) -> bool:
    """Tell whether a linear plant's initial state is gone, to a hundredth, before the band filter has settled."""
    from seaopt.estimation.problem.residuals import band_filter  # above this module

    if not model.linear or experiment.initial_state != "estimate":
        return False
    values = {item.name: item.value for item in builder.items}
    rates = model.matrices(np.array([values[name] for name in model.free]))[0][: model.nx, : model.nx]
    slowest = float(np.max(np.linalg.eigvals(rates).real)) if np.all(np.isfinite(rates)) else 0.0
    settle_s = band_filter(band_hz, experiment.log.period)[1] * experiment.log.period
    return slowest * settle_s < math.log(1e-2)


def _noise(builder: _Builder, experiment: Experiment) -> tuple[Slot, ...]:
    """Add the logarithms of the process noise, relative to each state's size; a wide prior holds what is not seen."""
    return tuple(
        builder.add(
            Parameter(
                name=f"{experiment.name}.noise.{state}", value=NOISE_START, unit="-", free=True, prior_std=NOISE_PRIOR
            )
        )
        for state in experiment.plant.states
    )
