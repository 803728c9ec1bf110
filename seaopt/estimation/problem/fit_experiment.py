"""An experiment in a fit: its data and model, the slots of its unknowns, and the weights of its residuals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.estimation.problem.band import design_filter, sees_level
from seaopt.estimation.problem.experiment import Experiment, scale_to_seconds
from seaopt.estimation.problem.losses import Loss
from seaopt.estimation.problem.normal_equations import add_gram
from seaopt.estimation.problem.shapes import Parts, PerOutput, Signal, Vector
from seaopt.estimation.problem.steady_state_filter import SteadyStateFilter
from seaopt.estimation.problem.unknowns import Slot, Slots, find_places
from seaopt.parameters import Parameter
from seaopt.records import record
from seaopt.simulation import (
    Clock,
    Model,
    Pass,
    Point,
    Segment,
    Weights,
    count_stable_steps,
    keep_part,
    run_passes,
    stream,
)

CACHED_SAMPLES = 1 << 14  # whose sums stay in a core's cache
FIRST_SAMPLES = 8_000  # that tell the integration error in an output, and a filter's sizes and places
MAX_SUBSTEPS = 256
ROUNDED = 1.5  # times the rms of a rounding's error, up to which a residual is taken for that
SLACK = 1e-9  # of a sample: rounding of a delay
FIRST_PART = 20  # a segment is left out at its start for one of so many parts at most


@record(eq=False)
class FitSegment:
    """A segment of a log, or a shot of one, that is simulated from a state of its own."""

    samples: Segment  # the data
    initial: tuple[Slot, ...]  # the state at the first sample
    # The unknown of each derivative column of a pass, -1 for none: without and with a filter's correction.
    columns: tuple[Int[np.ndarray, " nc"], ...]
    predictor_columns: tuple[Int[np.ndarray, " nd"], ...]

    def start(self, z: Vector) -> Float[np.ndarray, " nx"]:
        """Return the state at the first sample."""
        return np.array([slot.at(z) for slot in self.initial])

    def mark_counted(self, settle: int, rows: slice | None = None) -> Bool[np.ndarray, "n ny"]:
        """Return which samples take part in the cost, after those that a filter takes to settle."""
        chosen = rows if rows is not None else slice(0, self.samples.n)
        present = np.stack([np.isfinite(channel[chosen]) for channel in self.samples.y])
        if self.samples.keep:
            present &= np.stack([mask[chosen] > 0 for mask in self.samples.keep])
        present[:, : max(settle - chosen.start, 0)] = False
        return present.T

    def take_first(self, count: int) -> FitSegment:
        """Return the first so many samples."""
        old = self.samples
        samples = replace(
            old,
            u=tuple(channel[: old.lead + count] for channel in old.u),
            y=tuple(channel[:count] for channel in old.y),
            keep=tuple(mask[:count] for mask in old.keep),
            shares=None if old.shares is None else old.shares[:, :count],
        )
        return replace(self, samples=samples)

    @property
    def has_start(self) -> bool:
        """Whether the data show the initial state: not where all samples are held out."""
        return not self.samples.keep or bool(np.any(self.samples.keep[0]))


@record(eq=False)
class ResidualPower:
    """Weighted sum of squares and count of each output's residuals."""

    squares: PerOutput
    counts: PerOutput

    @property
    def rms(self) -> PerOutput:
        """The root of the mean square of each output."""
        return np.sqrt(self.squares / np.maximum(self.counts, 1.0))


@record(eq=False)
class FitExperiment:
    """One experiment of a fit."""

    data: Experiment  # as the user gave it
    segments: tuple[FitSegment, ...]  # what is simulated
    model: Model  # the plant, in its own free parameters
    theta: Int[np.ndarray, " np"]  # where those stand among the unknowns
    slots: Slots  # its other unknowns
    sigma: PerOutput  # of the filtered residual of each output
    spread: PerOutput  # standard deviation of each measured output
    loss: Loss  # applied to residuals in sigma
    band_hz: tuple[float, float] | None = None  # residuals are filtered to this band
    holdout: float = 0.0  # last fraction of the log that gets no weight
    # Least number of integration steps per sample, their peak where they are shared out; see `count_steps`.
    substeps: int = 1
    halved: bool = False  # whether each of them is made in two
    predictor: SteadyStateFilter | None = None  # with one, the residual is the error of the prediction one sample ahead

    @property
    def name(self) -> str:
        """The experiment's name."""
        return self.data.name

    @property
    def period(self) -> float:
        """Time between samples, in s."""
        return self.data.log.period

    @property
    def outputs(self) -> tuple[FitOutput, ...]:
        """Each measured output."""
        return tuple(FitOutput(experiment=self, index=o, name=name) for o, name in enumerate(self.data.outputs))

    @property
    def samples(self) -> int:
        """Samples of all segments."""
        return sum(segment.samples.n for segment in self.segments)

    @property
    def longest(self) -> int:
        """Samples of the longest segment."""
        return max(segment.samples.n for segment in self.segments)

    def take_first(self, count: int) -> FitExperiment:
        """Return the experiment with the first so many samples of each segment."""
        return replace(self, segments=tuple(segment.take_first(count) for segment in self.segments))

    def count_weighted(self) -> Int[np.ndarray, " ny"]:
        """Return how many samples of each output are there and have a weight."""
        marks = (segment.mark_counted(0).T for segment in self.segments)
        # Row by row: along an axis NumPy takes ten times as long.
        return np.sum([[np.count_nonzero(row) for row in rows] for rows in marks], axis=0)

    @property
    def weights(self) -> Weights:
        """The filter and the loss."""
        sections, settle = design_filter(self.band_hz, self.period)
        knee = self.loss.threshold * self.sigma
        return Weights(sections=sections, settle=settle, knee=knee, loss=self.loss.kind)

    def is_rounding(self, rms: PerOutput) -> bool:
        """Tell whether residuals of such an rms are the rounding of readings, of steps that are stated."""
        plain = self.loss.quadratic and self.predictor is None and self.band_hz is None
        steps = np.array([self.data.quantisation.get(name, 0.0) for name in self.data.outputs])
        return plain and bool(np.all(rms <= ROUNDED * steps / np.sqrt(12.0)))

    @property
    def level_unseen(self) -> bool:
        """Whether offsets are to be estimated that the band does not show: they are then the mean residuals."""
        return self.data.offset is True and not sees_level(self.band_hz)

    @property
    def even_substeps(self) -> int:
        """`substeps`, or where those are shared out about the number in every sample that leaves the same error."""
        shares = [s.samples.shares[0] for s in self.segments if s.samples.shares is not None]
        if not shares:
            return self.substeps
        part, order = np.concatenate(shares), self.model.order  # an error is as the part's power of order + 1
        return int(np.ceil(self.substeps * (np.sum(part ** (order + 1)) / np.sum(part)) ** (1.0 / order)))

    def count_even_steps(self, z: Vector) -> int:
        """Return the integration steps per sample where none are shared out."""
        return max(self.even_substeps, self.count_least_steps(z))

    def count_steps(self, z: Vector) -> int:
        """Return the integration steps per sample: more than asked for where fewer would be unstable."""
        return max(self.substeps, self.count_least_steps(z))

    def count_all_steps(self, z: Vector) -> int:
        """Return the integration steps of all samples; a linear plant takes one in each."""
        if self.model.linear:
            return self.samples
        point = self.point(z)
        return sum(
            s.samples.n * point.most_steps if s.samples.shares is None else int(np.sum(point.count_steps(s.samples)))
            for s in self.segments
        )

    def count_least_steps(self, z: Vector) -> int:
        """Return the integration steps per sample that are stable, or 1 where those are too many."""
        stable = self.count_stable_steps(z)
        return 1 if stable > MAX_SUBSTEPS else max(int(stable), 1)

    def is_too_stiff(self, z: Vector) -> bool:
        """Whether rates near rest, as sharp friction's, ask for finer steps than `MAX_SUBSTEPS` in a sample."""
        return self.count_stable_steps(z) > MAX_SUBSTEPS

    def count_stable_steps(self, z: Vector) -> float:
        """Return how many integration steps per sample are stable, whatever `substeps`."""
        return 1.0 if self.model.linear else count_stable_steps(self.model, z[self.theta], self.period)

    def point(self, z: Vector) -> Point:
        """Return where the passes are made."""
        slots = self.slots
        point = Point(
            theta=z[self.theta],
            offset=np.array([slot.at(z) for slot in slots.offset]),
            gain=np.array([slot.at(z) for slot in slots.gain]),
            drift=np.array([[slot.at(z) for slot in row] for row in slots.drift]),
            clock=Clock(
                period=self.period,
                hold=self.data.hold,
                delay_s=slots.delay.at(z),
                delay_free=slots.delay.index is not None,
            ),
            substeps=1 if self.is_too_stiff(z) else self.substeps,  # its cost is infinite, whatever it would be
            stable=self.count_least_steps(z),
            halved=self.halved,
        )
        if self.predictor is None:
            return point
        noise = np.array([slot.at(z) for slot in slots.noise])
        return replace(point, correction=self.predictor.correction(self.model, point, noise))

    def columns(self, segment: FitSegment) -> tuple[Int[np.ndarray, " nc"], ...]:
        """Return, for each output, the unknown of each derivative column of a pass; -1 where that is known."""
        return segment.columns if self.predictor is None else segment.predictor_columns

    def count_bytes(self) -> int:
        """Return the room that the outputs and columns of all passes take."""
        return 8 * sum(s.samples.n * sum(2 + len(places) for places in self.columns(s)) for s in self.segments)

    def run(self, segment: FitSegment, z: Vector, **keep: Any) -> Pass:
        """Run the pass of one segment."""
        return run_passes(self.model, segment.samples, self.point(z), segment.start(z), self.weights, **keep)

    def simulates_alike(self, z: Vector, wider: FitExperiment, at: Float[np.ndarray, " m"]) -> bool:
        """Tell whether the same experiment with more unknowns has the same states, in the same steps."""
        (ours, theirs), (point, other) = (self.model, wider.model), (self.point(z), wider.point(at))
        return (
            (ours.linear, tuple(ours.plant.states)) == (theirs.linear, tuple(theirs.plant.states))
            and (point.substeps, point.stable, point.halved) == (other.substeps, other.stable, other.halved)
            and all(a.samples.shares is b.samples.shares for a, b in zip(self.segments, wider.segments, strict=True))
        )

    def keep_within(self, z: Vector, wider: FitExperiment, at: Float[np.ndarray, " m"]) -> None:
        """Make the passes of the same experiment with more unknowns, and keep those at z as a part of them, where it
        simulates alike.
        """
        if not self.simulates_alike(z, wider, at):
            return
        point, other = self.point(z), wider.point(at)
        free, delays = wider.model.free, [point.clock.delay_free, other.clock.delay_free]
        columns = [0, *(1 + free.index(name) for name in self.model.free), *([1 + len(free)] if delays[0] else [])]
        for segment, larger in zip(self.segments, wider.segments, strict=True):
            of_outputs = range(1 + len(free) + delays[1], 1 + len(larger.columns[0]))
            smaller, more = (
                (each.model, part.samples, where, part.start(unknowns), each.weights)
                for each, part, where, unknowns in ((self, segment, point, z), (wider, larger, other, at))
            )
            keep_part(smaller, more, [*columns, *of_outputs])

    def run_all(self, z: Vector, *, keep: bool = False) -> tuple[Pass, ...]:
        """Run the pass of every segment; those of a nonlinear plant keep the outputs of the first samples. `keep`: all
        of it, see `run_passes`.
        """
        point, weights = self.point(z), self.weights
        rows = 0 if self.model.linear else FIRST_SAMPLES
        return tuple(
            run_passes(
                self.model,
                segment.samples,
                point,
                segment.start(z),
                weights,
                outputs=rows > 0,
                output_rows=rows,
                keep=keep,
            )
            for segment in self.segments
        )

    def stream(
        self, segment: FitSegment, z: Vector, point: Point, *, columns: bool, chunk: int
    ) -> Iterator[tuple[slice, Pass]]:
        """Yield rows of a segment and their part of a pass, chunk by chunk."""
        first = 0
        for part in stream(
            self.model, segment.samples, point, segment.start(z), self.weights, chunk=chunk, columns=columns
        ):
            assert part.outputs is not None
            rows = slice(first, first + len(part.outputs))
            first = rows.stop
            yield rows, part

    def normal(self, passes: Sequence[Pass], n: int) -> Float[np.ndarray, "n1 n1"]:
        """Return the normal matrix of [residual, n unknowns], in sigma, of the passes of every segment."""
        total = np.zeros((1 + n, 1 + n))
        self.add_normal(total, passes)
        return total

    def add_normal(self, normal: Float[np.ndarray, "n1 n1"], passes: Sequence[Pass]) -> None:
        """Add it in place: a matrix for each of many logs would take more than their passes."""
        for segment, sums in zip(self.segments, passes, strict=True):
            for o, places in enumerate(self.columns(segment)):
                add_gram(normal, sums.gram[o] / self.sigma[o] ** 2, places)

    def cost(self, passes: Sequence[Pass]) -> float:
        """Return the loss of the passes of every segment, in sigma."""
        return sum(float(np.sum(sums.loss / self.sigma**2)) for sums in passes)

    def power(self, passes: Sequence[Pass], moved: Vector) -> ResidualPower:
        """Return the power of the residuals after unknowns in which they are straight have moved."""
        squares, counts = np.zeros(len(self.sigma)), np.zeros(len(self.sigma))
        of_place = np.append(moved, 0.0)  # the last one is of places that are no unknown, -1
        for segment, sums in zip(self.segments, passes, strict=True):
            for o, places in enumerate(self.columns(segment)):
                step = np.concatenate([[1.0], of_place[places]])
                squares[o] += max(float(step @ sums.gram[o] @ step), 0.0)
                counts[o] += sums.count[o]
        return ResidualPower(squares=squares, counts=counts)


@record(eq=False)
class FitOutput:
    """One measured output of one experiment; `index` is its place among them."""

    experiment: FitExperiment
    index: int
    name: str

    @property
    def label(self) -> str:
        """EXPERIMENT.OUTPUT, for results and messages."""
        return f"{self.experiment.name}.{self.name}"

    @property
    def unit(self) -> str:
        """The output's unit."""
        return self.experiment.data.plant.outputs[self.name]

    @property
    def sigma(self) -> float:
        """Standard deviation of the filtered residual."""
        return float(self.experiment.sigma[self.index])

    @property
    def spread(self) -> float:
        """Standard deviation of the measured samples."""
        return float(self.experiment.spread[self.index])

    @property
    def measured(self) -> Parts:
        """The samples of each segment."""
        return [segment.samples.y[self.index] for segment in self.experiment.segments]


def make_fit_experiment(
    data: Experiment,
    model: Model,
    slots: Slots,
    names: Sequence[str],
    *,
    loss: Loss,
    band_hz: tuple[float, float] | None,
    holdout: float,
) -> FitExperiment:
    """Return an experiment in the unknowns of these names; a sigma that is not stated is the output's spread."""
    spread = [measure_spread(data.log[name]) for name in data.outputs]
    sigma = [data.sigma.get(name, size or 1.0) for name, size in zip(data.outputs, spread, strict=True)]
    return FitExperiment(
        data=data,
        **model_experiment(data, model, slots, names, holdout),
        sigma=np.array(sigma),
        spread=np.array(spread),
        loss=loss,
        band_hz=band_hz,
        holdout=holdout,
    )


def model_experiment(
    data: Experiment, model: Model, slots: Slots, names: Sequence[str], holdout: float
) -> dict[str, Any]:
    """Return the fields of a `FitExperiment` that depend on what is unknown."""
    theta = find_places(data, model, names)
    shared = [*theta, *_indices([slots.delay] if slots.delay.index is not None else [])]
    noise = _indices(slots.noise)
    rows = zip(slots.offset, slots.drift, slots.gain, strict=True)
    sensors = [_indices([offset, *drift, gain]) for offset, drift, gain in rows]
    segments: list[FitSegment] = []
    whole = data.segments(holdout, model.plant)
    early = _count_early(data, whole)
    for samples, initial in zip(whole, slots.initial, strict=True):
        state = _indices(initial)
        together = np.array([*shared, *noise, *state, *chain.from_iterable(sensors)], dtype=int)
        segments.append(
            FitSegment(
                samples=_leave_out(samples, 0 if samples.lead else early),
                initial=initial,
                predictor_columns=(together,) * len(sensors),
                columns=tuple(np.array([*shared, *state, *row], dtype=int) for row in sensors),
            )
        )
    return {"model": model, "slots": slots, "theta": np.array(theta, dtype=int), "segments": tuple(segments)}


def _count_early(data: Experiment, segments: Sequence[Segment]) -> int:
    """Return how many samples of each segment may come before its first input takes effect, as late as the delay may
    be. What was commanded until then is not in the log, unless it rests where the log begins. The estimated state is
    one from which a simulation is right after the delay; before, a motor's position was 70 times its noise off.
    """
    delay = data.delay_s
    if isinstance(delay, Parameter):
        latest = delay.max if delay.free and np.isfinite(delay.max) else delay.value
        delay = latest * scale_to_seconds(delay)
    first = [samples for samples in segments if not samples.lead]  # of shots the others have what was before them
    if data.initial_state != "estimate" or not any(_begins_in_motion(data, samples) for samples in first):
        return 0
    shortest = min(samples.n for samples in first)
    return min(int(np.ceil(max(delay, 0.0) / data.log.period - SLACK)), shortest // FIRST_PART)


def _begins_in_motion(data: Experiment, samples: Segment) -> bool:
    """Tell whether an input is neither zero at a segment's start nor rests there: a command may be held for some rows
    in motion, too.
    """
    pairs = zip(data.plant.inputs, samples.inputs, strict=False)  # what a plant reads of itself comes after
    firsts = [values[: max(2, samples.n // FIRST_PART)] for name, values in pairs if name != data.plant.clock]
    return any(first[0] != 0.0 and np.ptp(first) > 0.0 for first in firsts)


def _leave_out(samples: Segment, early: int) -> Segment:
    """Return a segment without the first so many samples of its outputs."""
    if not early:
        return samples
    return replace(samples, y=tuple(np.append(np.full(early, np.nan), channel[early:]) for channel in samples.y))


def _indices(slots: Sequence[Slot]) -> list[int]:
    return [-1 if slot.index is None else slot.index for slot in slots]


def measure_spread(values: Signal) -> float:
    """Return the standard deviation of the samples that are there, in the memory of a chunk."""
    first = float(values[np.argmax(np.isfinite(values))])
    count, total, square = 0, 0.0, 0.0
    for start in range(0, values.size, CACHED_SAMPLES):
        part = values[start : start + CACHED_SAMPLES] - first
        level = float(np.sum(part))
        if not np.isfinite(level):
            part = part[np.isfinite(part)]
            level = float(np.sum(part))
        count, total, square = count + part.size, total + level, square + float(np.einsum("m,m->", part, part))
    return float(np.sqrt(max(square / count - (total / count) ** 2, 0.0)))
