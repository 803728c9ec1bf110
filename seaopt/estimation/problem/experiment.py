"""An experiment: a plant, its log, and the known facts about sensors, delay and initial state."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import field, replace
from itertools import combinations, pairwise
from typing import Literal

import numpy as np
from jaxtyping import Bool, Int

from seaopt.errors import EstimationError, require_number, require_type, suggestion
from seaopt.estimation.problem.shapes import Signal
from seaopt.formatting import format_count, join_words
from seaopt.logs import Log
from seaopt.logs.log.saturation import mask_saturated
from seaopt.logs.quality.channel import BEYOND
from seaopt.logs.quality.clock import split_rows
from seaopt.logs.quality.faults import find_quantisation, find_runs, has_step
from seaopt.options import check_options, option
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.plants.plant import follow_readings
from seaopt.plants.sensors.difference import DifferencedSpeed, add_difference, find_state
from seaopt.records import record
from seaopt.signals import measure_white
from seaopt.simulation import Hold, Segment
from seaopt.simulation.simulate import input_samples
from seaopt.units import factor, same_dimension, unit_after

EXPERIMENT_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,63}")
SHORTEST_SHOT = 4  # samples
BEGINNING = 64  # samples
BRIDGED = 4  # missing samples in a row, that a line stands in for
FEWEST_READ = 16  # samples that tell a reading's noise
ROUGH = 0.3  # rad of a wave, that takes 4 % of it
Mask = Literal["auto", "declared", "none"]
InitialState = Literal["estimate", "rest"] | Mapping[str, float]


@record(eq=False, repr=False, keywords=True)
class Experiment:
    """One log of one plant.

    Raises
    ------
    EstimationError
        The log has no measured output or lacks an input, a unit has the wrong dimension, or a name is unknown.
    LogError
        The log is not uniformly sampled.
    """

    plant: Plant = option("The model of what was on the bench.")
    log: Log = option("Channels with the names of the plant's inputs, and of the outputs that were measured.")
    name: str = option("For results and messages.", default="experiment")
    outputs: tuple[str, ...] = option(
        "Measured outputs; every output of the plant that the log has, if empty.", default=()
    )
    sigma: Mapping[str, float] = option(
        "Standard deviation of the noise by output, SI; estimated where left out.", default_factory=dict[str, float]
    )
    quantisation: Mapping[str, float] = option(
        "Step that readings are rounded to, by output, SI: the error is then uniform over a step, besides white noise, "
        "and follows the motion. Where left out, steps that the log shows may make it so.",
        default_factory=dict[str, float],
    )
    initial_state: InitialState = option(
        '"estimate": unknown in each segment; "rest": zero; or states with values, zero where left out.',
        default="estimate",
    )
    offset: bool | Mapping[str, float] = option(
        "One unknown offset per output (true), none (false), or known ones.", default=True
    )
    parameters: Mapping[str, float | Parameter] = option(
        "Values, or free ones, of this log alone, in the plant's units: a payload, a gain of the firmware. A free one "
        "stands among the fit's parameters as EXPERIMENT.NAME.",
        default_factory=dict[str, "float | Parameter"],
    )
    delay_s: float | Parameter = option(
        "Delay from the input's column to its effect; a free one is estimated.", default=0.0
    )
    gain: Mapping[str, float | Parameter] = option(
        "Gain of each output's sensor, 1 where left out: measured = gain * output + offset + drift. A free one is "
        "estimated.",
        default_factory=dict[str, "float | Parameter"],
    )
    hold: Hold = option(
        'The input between samples: "zero" for a command, "first" for a measured one, straight lines.', default="zero"
    )
    drift: int = option(
        "Slow drift of the sensors: order of a polynomial over the log that is added to each output (Legendre's, so "
        "that the offset stays the mean).",
        default=0,
        least=0,
        most=5,
    )
    shots: int = option(
        "Parts that each segment is cut into, with initial states of their own: for a plant that diverges in "
        "simulation. The information of the joints is lost.",
        default=1,
        least=1,
        most=100_000,
    )
    saturation: Mapping[str, tuple[float, float]] = option(
        "Range of each sensor: samples at its ends or beyond become missing.",
        default_factory=dict[str, tuple[float, float]],
    )
    mask: Mask = option(
        'Which saturated samples of outputs become missing, as `notes` states. "auto": those outside the declared '
        'ranges, and those at clear flat tops where no range is declared; "declared": the former alone. A saturated '
        "input is what the plant received.",
        default="auto",
    )
    gaps: Literal["split", "error"] = option(
        '"split": a gap in the log starts a new segment with its own initial state; "error": it is refused.',
        default="split",
    )
    differences: Mapping[str, DifferencedSpeed] = option(
        "Measured speeds that are differences of a position over samples of this log: outputs that the plant then has "
        "besides its own. What the device held before a segment's first sample is part of the initial state.",
        default_factory=dict[str, DifferencedSpeed],
    )
    feedback: bool = option(
        "Taken under a law that reads the outputs: the input carries their noise. Such a log is fitted as any other, "
        "best by errors of prediction, and judges no certificate.",
        default=False,
    )
    log_segments: tuple[slice, ...] = field(init=False)  # the log's samples between gaps

    def __post_init__(self) -> None:
        for value, kind, what, remedy in (
            (self.plant, Plant, "plant", "give a Plant"),
            (self.log, Log, "log", "give a Log"),
            (self.name, str, "name", "give a text"),
            (self.outputs, (tuple, list), "outputs", "give names in a tuple"),
            (self.feedback, bool, "feedback", "give True or False"),
        ):
            require_type(value, kind, what, remedy, EstimationError)
        if not EXPERIMENT_NAME.fullmatch(self.name):
            raise EstimationError(
                f'experiment name "{self.name[:40]}" is not a name; start with a letter, then letters, digits, _ and -'
            )
        self._add_differences()
        chosen = tuple(self.outputs) or tuple(name for name in self.plant.outputs if name in self.log.signals)
        if not chosen:
            raise self._refuse(
                f"the log has none of the outputs of {self.plant.name} ({', '.join(self.plant.outputs)}); name a "
                "channel after each measured output"
            )
        object.__setattr__(self, "outputs", chosen)
        object.__setattr__(self, "log_segments", tuple(self.log.segments))
        self._check_outputs()
        self._check_units()
        self._check_parameters()
        self._check_settings()
        self._mask()
        self._split_at_lost()
        self._check_sizes()

    def _refuse(self, text: str) -> EstimationError:
        return EstimationError(f"experiment {self.name}: {text}")

    def list_own(self) -> dict[str, Parameter]:
        """Return the parameters of this log alone that are free, by their names in the plant."""
        free = {name: value for name, value in self.parameters.items() if isinstance(value, Parameter) and value.free}
        return {name: replace(value, name=f"{self.name}.{name}") for name, value in free.items()}

    def apply_own(self, params: ParameterSet) -> ParameterSet:
        """Return parameters with this log's own in their places; of those that a fit has estimated, their estimates."""
        if not self.parameters:
            return params
        local: list[Parameter] = []
        for name, stated in self.parameters.items():
            value = params.get(f"{self.name}.{name}", stated)
            value = value.value if isinstance(value, Parameter) else float(value)
            local.append(Parameter(name=name, value=value, unit=self.plant.parameter_unit(name)))
        return params.with_parameters(*local)

    def follow(self, params: ParameterSet) -> Plant:
        """Return the plant as it is simulated in a fit: it follows the positions that are outputs, where they are fine
        enough.
        """
        plant = self.plant
        if not plant.followed:
            return plant
        values = plant.complete(self.apply_own(params))
        fine = all(
            values[each.wave].value <= self.find_finest(each.state) and self._is_whole(each.state)
            for each in plant.followed.values()
        )
        return follow_readings(plant) if fine else plant

    def describe_readings(self, params: ParameterSet) -> list[str]:
        """Return what a fit makes of the readings that its plant can follow, one sentence each: those too coarse,
        or with too few samples in a row.
        """
        plant, sentences = self.plant, list[str]()
        values = plant.complete(self.apply_own(params))
        for each in plant.followed.values():
            finest, wave = self.find_finest(each.state), values[each.wave].value
            if finest and not self._is_whole(each.state):
                sentences.append(f"{each.state}: too few samples in a row are there: the position is the model's own")
            elif 0.0 < finest < wave:
                sentences.append(
                    f"{each.state}: noise and steps are {ROUGH * wave / finest:.2g} rad of a wave of {each.wave} = "
                    f"{wave:.4g}, above {ROUGH:g}: the position is the model's own there"
                )
        return sentences

    def reads(self, state: str) -> bool:
        """Tell whether one of the measured outputs is a state, with enough samples to tell its noise."""
        return state in self.outputs and int(np.count_nonzero(np.isfinite(self.log[state]))) >= FEWEST_READ

    def find_finest(self, state: str) -> float:
        """Return how many radians per unit a wave over a state may have, so that noise and steps of what was read of it
        are a small part of the wave; zero where nothing was.
        """
        if not self.reads(state) or is_constant(self.log[state]):
            return 0.0
        values = self.log[state][np.isfinite(self.log[state])]
        return ROUGH / max(measure_white(values), find_quantisation(values) / np.sqrt(12.0), 1e-300)

    def read(self, state: str) -> Signal:
        """Return what a sensor has read of a state, without the gain and the offset that are known of it; a line where
        samples are missing.
        """
        offset = self.offset.get(state, 0.0) if isinstance(self.offset, Mapping) else 0.0
        gain = self.gain.get(state, 1.0)
        values, there = self.log[state], np.isfinite(self.log[state])
        whole = np.interp(self.log.time, self.log.time[there], values[there])
        return (whole - offset) / (gain.value if isinstance(gain, Parameter) else gain)

    def _add_differences(self) -> None:
        """Give the plant the outputs that are differences; one of theirs that it has already is there to stay."""
        where = f"experiment {self.name}: differences"
        require_type(self.differences, Mapping, where, "give a mapping", EstimationError)
        plant, initial = self.plant, self.initial_state
        made = plant.sampling.differences if plant.sampling is not None else {}
        for name, difference in self.differences.items():
            require_type(difference, DifferencedSpeed, f"{where}: {name}", "give a DifferencedSpeed", EstimationError)
            if made.get(name, difference) != difference:
                raise self._refuse(
                    f"differences: {name} = {difference}, but {plant.name} has it made already, as {made[name]}; "
                    "give the plant without differences"
                )
            if name not in made:
                plant = add_difference(plant, name, difference, self.log.period)
            position = find_state(plant, difference.of)
            if isinstance(initial, Mapping) and position in initial:  # known to be there, and taken to rest there
                history = {f"{name}_held_{i}": initial[position] for i in range(1, difference.samples + 1)}
                initial = {**history, **initial}
        if isinstance(initial, Mapping) and plant.sampling is not None:  # firmware has read it before
            reads = plant.sampling.reads.items()
            initial = {**{kept: initial[state] for kept, state in reads if state in initial}, **initial}
        object.__setattr__(self, "plant", plant)
        object.__setattr__(self, "initial_state", initial)

    def _check_outputs(self) -> None:
        for name in self.outputs:
            require_type(name, str, f"experiment {self.name}: outputs", "give a name each", EstimationError)
            if self.outputs.count(name) > 1:
                raise self._refuse(f"outputs names {name} twice; keep one")
            if name not in self.plant.outputs:
                raise self._refuse(
                    f'output "{name}" is not one of {self.plant.name}; {suggestion(name, self.plant.outputs)}'
                )
            if not np.any(np.isfinite(self.log[name])):
                raise self._refuse(f"output {name} has no finite sample; leave it out of outputs")

    def _check_units(self) -> None:
        for kind, names in (("input", self.plant.inputs), ("output", self.plant.outputs)):
            for name, unit in names.items():
                logged = self.log.signals[name].unit if name in self.log.signals else ""
                if logged and logged != unit and not same_dimension(logged, unit):
                    raise self._refuse(
                        f"channel {name} is in {logged}, but the {kind} of {self.plant.name} is in "
                        f"{unit or 'no unit'}; correct the column's unit"
                    )

    def _check_parameters(self) -> None:
        require_type(self.parameters, Mapping, f"experiment {self.name}: parameters", "give a mapping", EstimationError)
        self._check_names("parameters", self.parameters, self.plant.parameters, f"one of {self.plant.name}")
        for name, value in self.parameters.items():
            unit = self.plant.parameter_unit(name)
            if not isinstance(value, Parameter):
                number = require_number(value, f"experiment {self.name}: parameters: {name}", EstimationError)
                if not np.isfinite(number):
                    raise self._refuse(f"parameters: {name} = {number} is not finite")
            elif value.unit != unit and not (same_dimension(value.unit, unit) and factor(value.unit, unit) == 1.0):
                raise self._refuse(
                    f"parameters: {name} is in {value.unit}, but {self.plant.name} has it in {unit or 'no unit'}; "
                    "convert it"
                )

    def _check_names(self, what: str, names: Collection[str], choices: Collection[str], kind: str) -> None:
        for name in names:
            if name not in choices:
                raise self._refuse(f'{what} names "{name}", which is not {kind}; {suggestion(name, choices)}')

    def _check_settings(self) -> None:
        self._check_each_output()
        if isinstance(self.initial_state, Mapping):
            self._check_names("initial_state", self.initial_state, self.plant.states, f"a state of {self.plant.name}")
        elif not isinstance(self.initial_state, str) or self.initial_state not in ("estimate", "rest"):
            raise self._refuse(
                f'initial_state = {self.initial_state!r} is not known; give "estimate", "rest" or values by state'
            )
        check_options(self, EstimationError, f"experiment {self.name}: ")
        delay = self.delay_s
        if isinstance(delay, Parameter):
            delay = delay.value * scale_to_seconds(delay)
        if isinstance(delay, bool) or not isinstance(delay, int | float) or not 0.0 <= delay < np.inf:
            raise self._refuse(f"delay_s = {delay!r} is not a time; give seconds, 0 or more")
        if delay > self.log.duration_s:
            raise self._refuse(
                f"delay_s = {delay:g} is longer than its log of {self.log.duration_s:.4g} s; give fewer seconds"
            )
        if self.gaps == "error" and len(self.log_segments) > 1:
            raise self._refuse(
                f'the log has {format_count(len(self.log_segments) - 1, "gap")} and gaps = "error"; use '
                'gaps = "split", or slice_s to choose a segment'
            )

    def _check_each_output(self) -> None:
        """Check the settings that have a value for each output."""
        require_type(self.offset, (bool, Mapping), f"experiment {self.name}: offset", "give a mapping", EstimationError)
        offset = {} if isinstance(self.offset, bool) else self.offset
        settings = {"sigma": self.sigma, "gain": self.gain, "offset": offset, "saturation": self.saturation}
        settings["quantisation"] = self.quantisation
        for what, values in settings.items():
            if not isinstance(values, Mapping):
                raise self._refuse(f"{what} = {values!r}; give a mapping of output to value")
            for name, value in values.items():
                ends = value if what == "saturation" and isinstance(value, tuple | list) else (value,)
                for number in ends:
                    if not isinstance(number, Parameter):
                        require_number(number, f"experiment {self.name}: {what} of {name}", EstimationError)
            self._check_names(what, values, self.outputs, "a measured output")
        for name, value in self.sigma.items():
            if not 0.0 < value < np.inf:
                raise self._refuse(f"sigma of {name} = {value:g} is not positive; leave it out to estimate it")
        for name, step in self.quantisation.items():
            if not 0.0 < step < np.inf or not has_step(self.log[name], step):
                raise self._refuse(self._describe_step(name, step))
        for name, ends in self.saturation.items():
            if not isinstance(ends, tuple | list) or len(ends) != 2 or not ends[0] < ends[1]:
                raise self._refuse(f"saturation of {name} = {ends} is not a range; give [low, high]")

    def _describe_step(self, name: str, step: float) -> str:
        """Return that an output's readings have another step than the one that is stated, or none."""
        unit, shown = unit_after(self.plant.outputs[name]), find_quantisation(self.log[name])
        stated = f"quantisation of {name} = {step:.6g}{unit}"
        if not shown:
            return (
                f"{stated}, but the channel's readings are not whole steps of any size apart, as of a log that was "
                "filtered, resampled, or written with more digits than the sensor has; log what the sensor read, or "
                "leave quantisation out"
            )
        finer = " (the log has finer digits than the sensor that is stated)" if shown < step else ""
        return (
            f"{stated}, but the channel's readings are {shown:.6g}{unit} apart{finer}; write quantisation = "
            f"{{ {name} = {shown:.6g} }}, or leave it out"
        )

    def _mask(self) -> None:
        """Make saturated samples missing in the experiment's own log."""
        if self.mask == "none":
            return
        log = mask_saturated(self.log, self.outputs, ranges=self.saturation, search=self.mask == "auto")
        for name in self.outputs:
            if not np.any(np.isfinite(log[name])):
                raise self._refuse(f"every sample of {name} is saturated; correct saturation, or leave it out")
        object.__setattr__(self, "log", log)

    def _split_at_lost(self) -> None:
        """Leave out of the segments where a reading that the plant can follow is missing for longer than a line
        bridges: where it has moved by then, and in what state the plant is after it, nothing tells.
        """
        lost = np.zeros(len(self.log), dtype=bool)
        for each in self.plant.followed.values():
            lost |= self._find_lost(each.state) if self.reads(each.state) else False
        kept = [
            slice(whole.start + rows.start, whole.start + rows.stop)
            for whole in self.log_segments
            for rows in split_rows(np.flatnonzero(np.diff(lost[whole])) + 1, whole.stop - whole.start, FEWEST_READ)
            if not lost[whole.start + rows.start]
        ]
        if np.any(lost) and kept:
            object.__setattr__(self, "log_segments", tuple(kept))

    def _find_lost(self, output: str) -> Bool[np.ndarray, " n"]:
        """Return the samples at which an output is missing, more of them in a row than a line bridges."""
        lost = ~np.isfinite(self.log[output])
        runs = find_runs(lost)
        for first, last in zip(runs.start.tolist(), runs.stop.tolist(), strict=True):
            lost[first:last] = last - first > BRIDGED
        return lost

    def _is_whole(self, state: str) -> bool:
        """Tell whether a reading is nowhere lost in the segments."""
        lost = self._find_lost(state) if self.reads(state) else np.ones(len(self.log), dtype=bool)
        return not any(np.any(lost[rows]) for rows in self.log_segments)

    def _check_sizes(self) -> None:
        """Refuse samples that no sensor gives and no declared range masks: one of them is all that a fit would see."""
        for name in {*self.outputs, *self.plant.inputs} & set(self.log.signals):
            rows = np.flatnonzero(np.abs(self.log[name]) > BEYOND)
            if rows.size:
                raise self._refuse(
                    f"{format_count(rows.size, 'sample')} of channel {name} beyond any sensor "
                    f"({self.log[name][rows[0]]:.3g} at {self.log.time[rows[0]]:.6g} s); set such samples to NaN, or "
                    "correct unit or scale"
                )

    def __repr__(self) -> str:
        count = format_count(len(self.log_segments), "segment")
        return f"Experiment {self.name}: {self.plant.name}, {', '.join(self.outputs)} from {self.log.source} ({count})"

    def rename(self, name: str) -> Experiment:
        """Return the experiment under another name."""
        return replace(self, name=name)

    @property
    def notes(self) -> tuple[str, ...]:
        """How the log was changed, and which of its samples have no weight, one sentence each."""
        log, segments = self.log, tuple(self.log.segments)
        notes = list(log.notes)
        if segments != (slice(0, len(log)),):
            alone = len(log) - sum(rows.stop - rows.start for rows in segments)
            notes.append(
                f"{format_count(len(log.gaps), 'gap')} split the log into {format_count(len(segments), 'segment')}"
                + (f", {format_count(alone, 'sample')} alone between gaps left out" if alone else "")
            )
        if self.log_segments != segments:
            followed = join_words(sorted({each.state for each in self.plant.followed.values()} & {*self.outputs}))
            count = sum(rows.stop - rows.start for rows in self.log_segments)
            notes.append(
                f"{followed}: more than {BRIDGED} samples in a row are missing, so that the log is left out there: "
                f"{count} of {len(log)} samples are used, in {format_count(len(self.log_segments), 'segment')}"
            )
        for name in self.outputs:
            missing = int(np.count_nonzero(~np.isfinite(log[name])))
            if missing:
                notes.append(f"{name}: {missing} of {len(log)} samples are missing or masked and have no weight")
        for name in (*self.plant.inputs, *self.outputs):
            if name in log.signals and is_constant(log[name]):
                text = f"{name}: is constant at {np.fmax.reduce(log[name]):.6g} {log.signal(name).unit}".rstrip()
                notes += [text] if text not in notes else []  # reading a file says it already
        named = [name for name in (*self.plant.inputs, *self.outputs) if name in log.signals]
        for a, b in combinations(named, 2):
            if b in self.outputs and not is_constant(log[b]) and _are_same(log[a], log[b]):
                text = (
                    "their noise is one, and the stds count it once"
                    if a in self.outputs
                    else "as an input it is taken for exact, noise included; name another column if that is not what "
                    "drives"
                )
                notes.append(f"{a} and {b} are the same samples: {text}")
        return tuple(notes)

    def segments(self, holdout: float = 0.0, plant: Plant | None = None) -> list[Segment]:
        """Return the segments that are simulated, of the plant that `follow` made if that is given; the last fraction
        `holdout` of the time gets no weight.
        """
        u = input_samples(self.plant, self.log)
        if plant is not None:
            u += tuple(self.read(plant.followed[name].state) for name in plant.read_inputs)
        y = tuple(self.log[name] for name in self.outputs)
        time, first, duration = self.log.time, float(self.log.time[0]), self.log.duration_s
        used = (np.arange(len(self.log)) < self.count_fitted(holdout)).astype(np.uint8) if holdout else None
        step = 2.0 * self.log.period / duration
        wholes = [whole for whole in self.log_segments for _ in self._cuts(whole)[1:]]
        return [
            Segment(
                u=tuple(channel[whole.start : rows.stop] for channel in u),
                y=tuple(channel[rows] for channel in y),
                keep=() if used is None else (used[rows],) * len(y),
                lead=rows.start - whole.start,
                start_s=float(time[rows.start]),
                drift_span=(2.0 * (float(time[rows.start]) - first) / duration - 1.0, step),
            )
            for rows, whole in zip(self.segment_rows, wholes, strict=True)
        ]

    def count_fitted(self, holdout: float) -> int:
        """Return how many samples come before the last fraction `holdout` of the time."""
        time = self.log.time
        return int(np.searchsorted(time, time[0] + (1.0 - holdout) * self.log.duration_s, side="right"))

    @property
    def segment_rows(self) -> list[slice]:
        """The samples of each segment that is simulated from an initial state of its own."""
        return [slice(a, b) for whole in self.log_segments for a, b in pairwise(self._cuts(whole))]

    def _cuts(self, whole: slice) -> list[int]:
        """Return the rows at which a segment of the log is cut into shots, its ends included."""
        return (whole.start + cut_into_shots(whole.stop - whole.start, self.shots)).tolist()


def scale_to_seconds(delay: Parameter) -> float:
    """Return what makes seconds of a delay's value; 1 where it states no unit of time."""
    return factor(delay.unit, "s") if same_dimension(delay.unit, "s") else 1.0


def is_constant(values: Signal) -> bool:
    """Tell whether all samples are the same, as far as they are there."""
    return bool(np.fmin.reduce(values) == np.fmax.reduce(values))


def _are_same(first: Signal, second: Signal) -> bool:
    """Tell whether two channels are the same samples; of most that are not, the beginning tells."""
    return all(np.array_equal(first[:end], second[:end], equal_nan=True) for end in (BEGINNING, None))


def cut_into_shots(n: int, shots: int) -> Int[np.ndarray, " shots1"]:
    """Return the first rows of shots of about equal length, and one past the last; no shot is under four samples."""
    return np.linspace(0, n, max(1, min(shots, n // SHORTEST_SHOT)) + 1).astype(int)


def check_shots(experiment: Experiment, longest: int, shots: int, setting: str) -> None:
    """Refuse shots too short for the states they start from. As many samples of one output as there are states
    determine the state at a shot's start, where it can be determined; with no more than that, a shot would follow its
    log whatever the parameters are. Segments shorter than the longest are cut into fewer. Raises EstimationError: the
    longest segment does not have a sample more than the plant has states, and at least four, for each shot.
    """
    states = len(experiment.plant.states)
    least = max(SHORTEST_SHOT, states + 1)
    if longest >= shots * least or shots == 1:
        return
    possible = longest // least
    remedy = f"give {possible} or fewer" if possible > 1 else "leave it out, and use a longer log or OutputError()"
    raise EstimationError(
        f"experiment {experiment.name}: {setting} leaves {longest / shots:.3g} samples per shot, of {longest} in the "
        f"longest segment; a shot of {experiment.plant.name} starts from {states} unknown states and needs at least "
        f"{least} samples: {remedy}"
    )
