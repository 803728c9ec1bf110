"""The vector of a fit's unknowns: parameters of the plants first, then each experiment's own."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Bool

from seaopt.errors import EstimationError, SeaoptError, suggestion
from seaopt.estimation.problem.band import design_filter, sees_level
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.shapes import Matrix, Vector
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

    def at(self, z: Vector) -> float:
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
    """All that a fit may change, with bounds and priors."""

    names: tuple[str, ...]  # one per value; an experiment's own are written EXPERIMENT.WHAT
    start: Vector  # start, low, high: first value and bounds
    low: Vector
    high: Vector
    prior_std: Vector  # infinite where there is no prior; a prior is centred on `start`
    linear: Bool[np.ndarray, " n"]  # what residuals are affine in: offsets, drifts, and initial states of linear plants
    shared: int  # the first so many are parameters of the plants

    @property
    def precision(self) -> Vector:
        """The priors' information on each unknown: 1/std^2, zero where there is none."""
        return self.prior_std**-2.0

    def bound(self, places: Any, low: Any, high: Any) -> Unknowns:
        """Return the unknowns with other bounds at some places."""
        lows, highs = self.low.copy(), self.high.copy()
        lows[places], highs[places] = low, high
        return replace(self, low=lows, high=highs)

    def by_name(self, z: Vector) -> dict[str, float]:
        """Return the unknowns by their names."""
        return dict(zip(self.names, z.tolist(), strict=True))

    def start_from(self, values: Mapping[str, float]) -> Vector:
        """Return the start, with values in place of those of the same name."""
        return np.array([values.get(name, first) for name, first in self.by_name(self.start).items()])

    def find_at_bound(self, z: Vector) -> tuple[str, ...]:
        """Return the names of those that lie on a bound, to rounding."""
        width = 1e-9 * np.maximum(np.abs(z), 1e-300)
        touching = (z - self.low <= width) | (self.high - z <= width)
        return tuple(name for name, flag in zip(self.names, touching, strict=True) if flag)

    def prior(self, z: Vector) -> tuple[float, Vector, Matrix]:
        """Return the priors' part of the cost at `z`, of its gradient and of its Hessian."""
        away = (z - self.start) / self.prior_std
        return 0.5 * float(away @ away), away / self.prior_std, np.diag(self.precision)


class _Builder:
    """Collects unknowns one by one; lives only inside `collect`."""

    def __init__(self, shared: Sequence[Parameter]) -> None:
        self.entries = [*shared]
        self.linear = [False] * len(shared)

    def add(self, name: str, unit: str, value: float = 0.0, *, linear: bool = False, **limits: float | None) -> Slot:
        """Add an unknown of an experiment; `limits` are its bounds and its prior."""
        fields: dict[str, Any] = {"name": name, "unit": unit, "value": value, "free": True, **limits}
        self.entries.append(Parameter(**fields))
        self.linear.append(linear)
        return Slot(value=value, index=len(self.entries) - 1)

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
        return self.add(
            name,
            unit,
            scale * value.value,
            min=max(scale * value.min, low),
            max=min(scale * value.max, high),
            prior_std=None if value.prior_std is None else scale * value.prior_std,
        )

    def take_start(self, experiment: Experiment, model: Model) -> Vector:
        """Return the first values of a model's free parameters."""
        places = find_places(experiment, model, [entry.name for entry in self.entries])
        return np.array([self.entries[index].value for index in places])


def collect(
    experiments: tuple[Experiment, ...],
    params: ParameterSet,
    noise: bool = False,
    band_hz: tuple[float, float] | None = None,
) -> tuple[Unknowns, tuple[tuple[Model, Slots], ...]]:
    """Return the unknowns of a fit, and of each experiment its model in the free parameters, and its slots. With
    `noise`, the process noise is unknown too. A band that leaves out 0 Hz does not see offsets and drifts, nor an
    initial state that is forgotten before the band filter has settled: those are then not estimated. Raises
    EstimationError: a free parameter belongs to no plant of the experiments.
    """
    used = {name for e in experiments for name in e.plant.parameters if name not in e.parameters}
    used |= {local.name for experiment in experiments for local in experiment.list_own().values()}
    for name in params.free_names:
        if name not in used:
            raise EstimationError(
                f"parameter {name} is free, but no plant of the experiments has it; {suggestion(name, used)}"
            )
    shared = [params[name] for name in params.free_names]
    builder = _Builder(shared)
    modelled: list[tuple[Model, Slots]] = []
    for experiment in experiments:
        model = _make_model(experiment, params)
        if noise and model.read_states[0]:
            raise EstimationError(
                f"experiment {experiment.name}: {experiment.plant.name} reads its states at some samples alone, so "
                "that no one gain corrects them all; fit it with OutputError()"
            )
        modelled.append((model, _make_slots(builder, experiment, model, noise, band_hz)))
    entries = [*map(_limit, shared), *builder.entries[len(shared) :]]
    unknowns = Unknowns(
        names=tuple(entry.name for entry in entries),
        start=np.array([entry.value for entry in entries]),
        low=np.array([entry.min for entry in entries]),
        high=np.array([entry.max for entry in entries]),
        prior_std=np.array([math.inf if entry.prior_std is None else entry.prior_std for entry in entries]),
        linear=np.array(builder.linear, dtype=bool),
        shared=len(shared),
    )
    return unknowns, tuple(modelled)


def _make_model(experiment: Experiment, params: ParameterSet) -> Model:
    """Return an experiment's model in what is free of its plant, for all logs or for this one."""
    shared = [name for name in params.free_names if name not in experiment.parameters]
    local = [name for name, parameter in experiment.list_own().items() if parameter.name in params.free_names]
    return make_model(experiment.follow(params), experiment.apply_own(params), (*shared, *local), experiment.outputs)


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
    name, outputs, units = experiment.name, experiment.outputs, experiment.plant.outputs
    level = sees_level(band_hz)
    # An input that comes after the log's end is not in it.
    delay = builder.add_if_free(experiment.delay_s, f"{name}.delay_s", "s", 0.0, experiment.log.duration_s)
    gain = tuple(builder.add_if_free(experiment.gain.get(o, 1.0), f"{name}.gain.{o}", "-") for o in outputs)
    if delay.index is not None and depends_on_time(model):
        raise EstimationError(
            f"experiment {name}: delay_s is free and {experiment.plant.name} depends on time itself; "
            "give delay_s a value"
        )
    if experiment.offset is True and level:
        offset = tuple(builder.add(f"{name}.offset.{o}", units[o], linear=True) for o in outputs)
    else:
        stated = experiment.offset if isinstance(experiment.offset, Mapping) else {}
        offset = tuple(Slot(value=float(stated.get(o, 0.0))) for o in outputs)
    orders = range(1, experiment.drift + 1) if level else ()
    forgotten = not level and _forgets_start(builder, experiment, model, band_hz)
    return Slots(
        delay=delay,
        gain=gain,
        offset=offset,
        drift=tuple(
            tuple(builder.add(f"{name}.drift{order}.{o}", units[o], linear=True) for order in orders) for o in outputs
        ),
        initial=_add_initial(builder, experiment, model, forgotten),
        # A wide prior holds what is not seen.
        noise=tuple(
            builder.add(f"{name}.noise.{state}", "-", NOISE_START, prior_std=NOISE_PRIOR)
            for state in (experiment.plant.states if noise else ())
        ),
    )


def _add_initial(
    builder: _Builder, experiment: Experiment, model: Model, forgotten: bool
) -> tuple[tuple[Slot, ...], ...]:
    """Add the initial states: a known one is that of each segment of the log; shots within one start from unknown ones.
    Friction that sticks soon stops a joint whatever its speed was: where no sample shows the speed, it started at rest.
    """
    plant, initial = experiment.plant, experiment.initial_state
    initial_values = fill_vector("state", plant.states, dict(initial) if isinstance(initial, Mapping) else None)
    starts = {rows.start for rows in experiment.log.segments}
    stopped = _scale_stopped_speeds(builder, experiment, model)
    initial_slots: list[tuple[Slot, ...]] = []
    for number, rows in enumerate(experiment.segment_rows):
        if forgotten or (initial != "estimate" and rows.start in starts):
            initial_slots.append(tuple(Slot(value=float(v)) for v in initial_values))
            continue
        label = f"{experiment.name}.initial{number + 1 if number else ''}"
        scales = stopped if rows.start in starts else {}  # a shot within a segment starts in the middle of a motion
        slots = [
            builder.add(f"{label}.{state}", unit, linear=model.linear, prior_std=scales.get(state))
            for state, unit in plant.states.items()
        ]
        initial_slots.append(tuple(slots))
    return tuple(initial_slots)


def _scale_stopped_speeds(builder: _Builder, experiment: Experiment, model: Model) -> dict[str, float]:
    """Return how fast the states that sticking friction stops could move without it, where anything drives them. That
    is what the log's largest input makes of the linearised plant within some hundred samples, at the first values of
    what is free: a speed that no joint has at its start, and that holds one which no sample shows.
    """
    plant, nx = experiment.plant, model.nx
    if not model.sticks:
        return {}
    x, _, p = name_symbols(plant, plant.x, plant.u, plant.p)
    velocities = ca.vertcat(
        *(friction.velocity(x, p) for friction in plant.friction.values() if friction.jump is not None)
    )
    moving = linearise(replace(model, sticks=False, memory={}))
    step = transition(moving, builder.take_start(experiment, model), Clock(period=experiment.log.period))[0]
    largest = np.array([np.max(np.abs(samples)) for samples in input_samples(plant, experiment.log)])
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
    rates = model.matrices(builder.take_start(experiment, model))[0][: model.nx, : model.nx]
    slowest = float(np.max(np.linalg.eigvals(rates).real)) if np.all(np.isfinite(rates)) else 0.0
    settle_s = design_filter(band_hz, experiment.log.period)[1] * experiment.log.period
    return slowest * settle_s < math.log(1e-2)
