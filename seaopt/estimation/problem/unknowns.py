"""The vector of a fit's unknowns: parameters of the plants first, then each experiment's own."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float

from seaopt.errors import EstimationError, SeaoptError, suggestion
from seaopt.estimation.problem.band import design_filter, sees_level
from seaopt.estimation.problem.experiment import Experiment
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants.plant import fill_vector, name_symbols
from seaopt.records import record
from seaopt.simulation import Clock, Model, depends_on_time, linearise, make_model, transition
from seaopt.simulation.simulate import input_samples
from seaopt.units import factor

REACH = 1e9  # times its first value, or what is plausible: a parameter without a bound of its own is held there
REACHED_SAMPLES = 256  # within which an input brings a joint to speed
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
class Slots:
    """The slots of one experiment: delay; gain, offset and drift per output; initial state per segment.

    `noise` is there for prediction-error fits alone: logarithms of the process noise per state.
    """

    delay: Slot
    gain: tuple[Slot, ...]
    offset: tuple[Slot, ...]
    drift: tuple[tuple[Slot, ...], ...]
    initial: tuple[tuple[Slot, ...], ...]
    noise: tuple[Slot, ...] = ()


@record(eq=False)
class Unknowns:
    """The vector of all that a fit may change, with bounds and priors."""

    names: tuple[str, ...]  # one per value; an experiment's own are written EXPERIMENT.WHAT
    start: Float[np.ndarray, " n"]  # start, low, high: first value and bounds
    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]
    prior_std: Float[np.ndarray, " n"]  # infinite where there is no prior; a prior is centred on `start`
    linear: Bool[np.ndarray, " n"]  # what residuals are affine in: offsets, drifts, and initial states of linear plants
    shared: int  # the first so many are parameters of the plants

    @property
    def precision(self) -> Float[np.ndarray, " n"]:
        """What the priors know of each unknown: 1/std^2, zero where there is none."""
        return self.prior_std**-2.0

    def find_at_bound(self, z: Float[np.ndarray, " n"]) -> tuple[str, ...]:
        """Return the names of those that lie on a bound, to rounding."""
        width = 1e-9 * np.maximum(np.abs(z), 1e-300)
        touching = (z - self.low <= width) | (self.high - z <= width)
        return tuple(name for name, flag in zip(self.names, touching, strict=True) if flag)

    def prior(self, z: Float[np.ndarray, " n"]) -> tuple[float, Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
        """Return the priors' part of the cost at `z`, of its gradient and of its Hessian."""
        away = (z - self.start) / self.prior_std
        return 0.5 * float(away @ away), away / self.prior_std, np.diag(self.precision)


class _Builder:
    """Collects unknowns one by one; lives only inside `collect`."""

    def __init__(self) -> None:
        self.entries: list[Parameter] = []
        self.linear: list[bool] = []

    def add(self, entry: Parameter, linear: bool = False) -> Slot:
        self.entries.append(entry)
        self.linear.append(linear)
        return Slot(value=entry.value, index=len(self.entries) - 1)

    def add_if_free(
        self, value: float | Parameter, name: str, unit: str, low: float = -math.inf, high: float = math.inf
    ) -> Slot:
        """Add a free Parameter under `name`; a number, or one that is not free, is known. Its unit is converted."""
        if not isinstance(value, Parameter):
            return Slot(value=float(value))
        try:
            scale = factor(value.unit, unit) if value.unit else 1.0
        except SeaoptError as error:
            raise EstimationError(f"{name} is in {value.unit}, and must be in {unit}: {error}") from error
        if not value.free:
            return Slot(value=scale * value.value)
        prior = None if value.prior_std is None else scale * value.prior_std
        return self.add(
            Parameter(
                name=name,
                value=scale * value.value,
                unit=unit,
                free=True,
                min=max(scale * value.min, low),
                max=min(scale * value.max, high),
                prior_std=prior,
            )
        )


def collect(
    experiments: tuple[Experiment, ...],
    params: ParameterSet,
    noise: bool = False,
    band_hz: tuple[float, float] | None = None,
) -> tuple[Unknowns, tuple[tuple[Model, Slots], ...]]:
    """Return the unknowns of a fit, and of each experiment its model in the free parameters, and its slots.

    With `noise`, the process noise is unknown too.

    A band that leaves out 0 Hz does not see offsets and drifts, nor an initial state that is forgotten before the band
    filter has settled: those are then not estimated.

    Raises EstimationError: a free parameter belongs to no plant of the experiments.
    """
    used = {name for e in experiments for name in e.plant.parameters if name not in e.parameters}
    used |= {local.name for experiment in experiments for local in experiment.list_own().values()}
    for name in params.free_names:
        if name not in used:
            raise EstimationError(
                f"parameter {name} is free, but no plant of the experiments has it; {suggestion(name, used)}"
            )
    builder = _Builder()
    for name in params.free_names:
        builder.add(params[name])
    shared = len(builder.entries)
    models = tuple(_make_model(experiment, params) for experiment in experiments)
    pairs = zip(experiments, models, strict=True)
    modelled = tuple((model, _make_slots(builder, experiment, model, noise, band_hz)) for experiment, model in pairs)
    entries = [*map(_limit, builder.entries[:shared]), *builder.entries[shared:]]
    unknowns = Unknowns(
        names=tuple(entry.name for entry in entries),
        start=np.array([entry.value for entry in entries]),
        low=np.array([entry.min for entry in entries]),
        high=np.array([entry.max for entry in entries]),
        prior_std=np.array([entry.prior_std if entry.prior_std is not None else math.inf for entry in entries]),
        linear=np.array(builder.linear),
        shared=shared,
    )
    return unknowns, modelled


def _make_model(experiment: Experiment, params: ParameterSet) -> Model:
    """Return an experiment's model in what is free of its plant, for all logs or for this one."""
    shared = [name for name in params.free_names if name not in experiment.parameters]
    local = [name for name, parameter in experiment.list_own().items() if parameter.name in params.free_names]
    return make_model(experiment.plant, experiment.apply_own(params), (*shared, *local), experiment.outputs)


def find_places(experiment: Experiment, model: Model, names: Sequence[str]) -> list[int]:
    """Return where the free parameters of an experiment's model are among the unknowns of these names."""
    local = experiment.list_own()
    return [names.index(local[name].name if name in local else name) for name in model.free]


def _limit(parameter: Parameter) -> Parameter:
    """Return a parameter with bounds far out where it has none: what has no effect may run away as far as floats go."""
    size = max(abs(parameter.value), *(abs(end) for end in parameter.plausible or (0.0,)))
    far = REACH * size if size > 0.0 else math.inf
    return replace(parameter, min=max(parameter.min, -far), max=min(parameter.max, far))


def _make_slots(
    builder: _Builder, experiment: Experiment, model: Model, noise: bool, band_hz: tuple[float, float] | None
) -> Slots:
    name = experiment.name
    level = sees_level(band_hz)
    forgotten = not level and _forgets_start(builder, experiment, model, band_hz)
    # An input that comes after the log's end is not in it.
    delay = builder.add_if_free(experiment.delay_s, f"{name}.delay_s", "s", 0.0, experiment.log.duration_s)
    gain = tuple(builder.add_if_free(experiment.gain.get(o, 1.0), f"{name}.gain.{o}", "-") for o in experiment.outputs)
    no_drift: tuple[tuple[Slot, ...], ...] = ((),) * len(experiment.outputs)
    if delay.index is not None and depends_on_time(model):
        raise EstimationError(
            f"experiment {name}: delay_s is free and {experiment.plant.name} depends on time itself; "
            "give delay_s a value"
        )
    return Slots(
        delay=delay,
        gain=gain,
        offset=_add_offsets(builder, experiment, level),
        drift=_add_drifts(builder, experiment) if level else no_drift,
        initial=_add_initial(builder, experiment, model, forgotten),
        noise=_add_noise(builder, experiment) if noise else (),
    )


def _add_zero(builder: _Builder, name: str, unit: str, linear: bool = True) -> Slot:
    return builder.add(Parameter(name=name, value=0.0, unit=unit, free=True), linear)


def _add_offsets(builder: _Builder, experiment: Experiment, level: bool) -> tuple[Slot, ...]:
    if experiment.offset is True and level:
        units = experiment.plant.outputs
        return tuple(_add_zero(builder, f"{experiment.name}.offset.{o}", units[o]) for o in experiment.outputs)
    given = experiment.offset if isinstance(experiment.offset, Mapping) else {}
    return tuple(Slot(value=float(given.get(o, 0.0))) for o in experiment.outputs)


def _add_drifts(builder: _Builder, experiment: Experiment) -> tuple[tuple[Slot, ...], ...]:
    return tuple(
        tuple(
            _add_zero(builder, f"{experiment.name}.drift{order}.{o}", experiment.plant.outputs[o])
            for order in range(1, experiment.drift + 1)
        )
        for o in experiment.outputs
    )


def _add_initial(
    builder: _Builder, experiment: Experiment, model: Model, forgotten: bool
) -> tuple[tuple[Slot, ...], ...]:
    """A known initial state is that of each segment of the log; shots within one start from unknown ones.

    Friction that sticks soon stops a joint whatever its speed was: where nothing else tells it, it started at rest.
    """
    plant, initial = experiment.plant, experiment.initial_state
    given = fill_vector("state", plant.states, dict(initial) if isinstance(initial, Mapping) else None)
    starts = {rows.start for rows in experiment.log_segments}
    initial_slots: list[tuple[Slot, ...]] = []
    stopped = _scale_stopped_speeds(builder, experiment, model)
    for number, rows in enumerate(experiment.segment_rows):
        if forgotten or (initial != "estimate" and rows.start in starts):
            initial_slots.append(tuple(Slot(value=float(v)) for v in given))
            continue
        label = f"{experiment.name}.initial{number + 1 if number else ''}"
        scales = stopped if rows.start in starts else {}  # a shot within a segment starts in the middle of a motion
        unknown = [
            Parameter(name=f"{label}.{state}", value=0.0, unit=unit, free=True, prior_std=scales.get(state))
            for state, unit in plant.states.items()
        ]
        initial_slots.append(tuple(builder.add(entry, model.linear) for entry in unknown))
    return tuple(initial_slots)


def _scale_stopped_speeds(builder: _Builder, experiment: Experiment, model: Model) -> dict[str, float]:
    """Return how fast the states that sticking friction stops could move without it, where anything drives them.

    That is what the log's largest input makes of the linearised plant within some hundred samples, at the first values
    of what is free: a speed that no joint has at its start, and that holds one which no sample shows.
    """
    plant = experiment.plant
    if not model.sticks:
        return {}
    x, _, p = name_symbols(plant, plant.x, plant.u, plant.p)
    velocities = ca.vertcat(
        *(friction.velocity(x, p) for friction in plant.friction.values() if friction.jump is not None)
    )
    values = {entry.name: entry.value for entry in builder.entries}
    local = experiment.list_own()
    theta = np.array([values[local[name].name if name in local else name] for name in model.free])
    step = transition(linearise(replace(model, sticks=False, memory={})), theta, Clock(period=experiment.log.period))[0]
    nx, largest = model.nx, np.array([np.max(np.abs(samples)) for samples in input_samples(plant, experiment.log)])
    reached, moved = np.zeros(nx), step[:nx, nx : nx + largest.size]
    for _ in range(REACHED_SAMPLES):
        reached += np.abs(moved) @ largest
        moved = step[:nx, :nx] @ moved
    return {
        state: float(size)
        for state, size, symbol in zip(plant.states, reached, ca.vertsplit(plant.x), strict=True)
        if ca.depends_on(velocities, symbol) and 0.0 < size < np.inf
    }


def _forgets_start(
    builder: _Builder, experiment: Experiment, model: Model, band_hz: tuple[float, float] | None
) -> bool:
    """Tell whether a linear plant's initial state is gone, to a hundredth, before the band filter has settled."""
    if not model.linear or experiment.initial_state != "estimate":
        return False
    values = {entry.name: entry.value for entry in builder.entries}
    rates = model.matrices(np.array([values[name] for name in model.free]))[0][: model.nx, : model.nx]
    slowest = float(np.max(np.linalg.eigvals(rates).real)) if np.all(np.isfinite(rates)) else 0.0
    settle_s = design_filter(band_hz, experiment.log.period)[1] * experiment.log.period
    return slowest * settle_s < math.log(1e-2)


def _add_noise(builder: _Builder, experiment: Experiment) -> tuple[Slot, ...]:
    """Add the logarithms of the process noise, relative to each state's size; a wide prior holds what is not seen."""
    return tuple(
        builder.add(
            Parameter(
                name=f"{experiment.name}.noise.{state}", value=NOISE_START, unit="-", free=True, prior_std=NOISE_PRIOR
            )
        )
        for state in experiment.plant.states
    )
