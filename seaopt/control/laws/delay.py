"""The two delays of a loop: the drive's, which the plant has, and the program's, in whole samples.

An experiment's delay runs from a row's command to its effect in the log's measurement: what command path, drive, sensor
and transport add, as far as the log's clock sees it. That is the drive's delay. It is a condition of every plant
(`seaopt.control.loops.sampled_plant`), exact in fractions of a sample. The program adds whole samples between a reading
and the command being put out: none where the program that logged read and wrote in one tick, as its log shows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, TypeVar

import casadi as ca
import numpy as np

from seaopt.control.laws.limits import BY_NAME, LIFTABLE, Limit
from seaopt.control.loops.sampled_plant import (
    DRIVE_DELAY,
    add_drive_delay,
    drop_drive_delay,
    list_names,
    read_conditions,
)
from seaopt.errors import ControlError, require_type
from seaopt.estimation import Fit
from seaopt.estimation.result.covariance import Covariance
from seaopt.formatting import format_count, join_words
from seaopt.frequency import MeasuredResponse
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.parts import list_dead_times
from seaopt.plants.plant import require_plant
from seaopt.records import record


class LoopSpec:
    """What the specifications of a law and of a plan have in common; see the options of these names."""

    __slots__ = ()
    __dataclass_fields__: ClassVar[dict[str, Any]]
    measured: Any
    bandwidth_hz: Any
    sample_rate_hz: Any
    compute_delay_samples: Any
    drive_delay_s: Any
    delay_samples: Any
    current_limit_A: Any
    command_limit: Any

    @property
    def limits(self) -> tuple[Limit, ...]:
        """The rows that a loop is judged by."""
        raise NotImplementedError

    @property
    def sample_time_s(self) -> float:
        """Seconds between samples."""
        return 1.0 / self.sample_rate_hz

    @property
    def loop_delay_samples(self) -> int:
        """Whole samples of delay that a loop is closed with besides the drive's: as given, or 1."""
        samples = self.compute_delay_samples if self.delay_samples is None else self.delay_samples
        return 1 if samples is None else samples

    @property
    def limit_asked(self) -> float | None:
        """The limit of the command that is asked for, in its unit; None for none."""
        return self.command_limit if self.current_limit_A is None else self.current_limit_A

    def allowed(self, limit: Limit) -> float | None:
        """Return the value that a limit allows; None where it is not imposed."""
        return limit.allow(getattr(self, limit.name) if limit.has_field else None, self.bandwidth_hz)

    @property
    def lifted(self) -> tuple[str, ...]:
        """The limits with a default that are not imposed."""
        return tuple(name for name in LIFTABLE if getattr(self, name, None) is False and BY_NAME[name].is_default)

    @property
    def lifted_notes(self) -> tuple[str, ...]:
        """A remark on each of them."""
        return tuple(f"{name} = false: this limit is not imposed" for name in self.lifted)


class LoopDelays:
    """Both delays of a controller together, for a law and a plan alike."""

    __slots__ = ()
    spec: Any
    sample_time_s: Any
    compute_delay_samples: Any
    drive_delay_s: Any

    @property
    def delay_samples(self) -> float:
        """Both delays together, in samples; a fraction as the drive has it."""
        return self.compute_delay_samples + self.drive_delay_s / self.sample_time_s

    @property
    def delays(self) -> str:
        """Both delays and their sum, in words."""
        older = self.spec.delay_samples is not None
        return describe_delays(self.compute_delay_samples, self.drive_delay_s, self.sample_time_s, older=older)

    def delay(self, params: ParameterSet) -> ParameterSet:
        """Return parameters with the delay of this controller's drive, as `place_drive_delay`."""
        return place_drive_delay(self.spec, params, self.drive_delay_s)


@record
class Drive:
    """The drive's delay, s, and the experiment whose fit it is of; None of one that is given."""

    delay_s: float
    fitted_in: str | None = None

    def take_covariance(self, fit: Fit) -> Covariance:
        """Return a fit's covariance, of noise and model, of the parameters, and of this delay with them."""
        joint, fitted = fit.total_delay_covariance, f"{self.fitted_in}.delay_s"
        if joint is None or fitted not in joint.names:
            return fit.total_covariance
        names = fit.covariance.names
        rows = [joint.names.index(name) for name in (*names, fitted)]
        return Covariance(names=(*names, DRIVE_DELAY), matrix=joint.matrix[np.ix_(rows, rows)])


SpecT = TypeVar("SpecT", bound=LoopSpec)
DELAY_KEYS = ("compute_delay_samples", "drive_delay_s", "delay_samples")
TOLD_STDS = 3.0  # by which two fitted delays differ that are two
NEGLIGIBLE = 0.01  # of a sample: a delay that is beyond another by less is as long


def check_delays(spec: LoopSpec, most: int) -> None:
    """Refuse delays that are none, or two that say the same."""
    for name in ("compute_delay_samples", "delay_samples"):
        value: Any = getattr(spec, name)
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= most:
            raise ControlError(f"{name} = {value!r} is not a whole number of samples from 0 to {most}; give {name} = 1")
    drive: Any = spec.drive_delay_s
    longest = most / spec.sample_rate_hz
    if drive is not None and (
        isinstance(drive, bool) or not isinstance(drive, (int, float)) or not 0.0 <= drive <= longest
    ):
        raise ControlError(
            f"drive_delay_s = {drive!r} is not from 0 to {longest:g} s, {most} samples; it is in seconds: 0.002 is 2 ms"
        )
    new = [name for name in ("compute_delay_samples", "drive_delay_s") if getattr(spec, name) is not None]
    if spec.delay_samples is not None and new:
        raise ControlError(
            f"delay_samples = {spec.delay_samples} and {new[0]} = {getattr(spec, new[0]):g} are both given, and "
            "delay_samples is the whole loop; keep compute_delay_samples and drive_delay_s"
        )


def count_response_samples(spec: LoopSpec, measured: MeasuredResponse) -> float:
    """Return the samples that a measured response is turned by: the program's, for the drive's delay is in it. Raises
    ControlError: the older key is given, the whole loop, and the log alone has more.
    """
    if spec.delay_samples is None:
        return spec.loop_delay_samples
    late = spec.delay_samples - measured.clock.delay_s * spec.sample_rate_hz
    if late < -NEGLIGIBLE:
        raise ControlError(
            f"frf:{measured.name}: the log has a delay of {1e3 * measured.clock.delay_s:.4g} ms and delay_samples = "
            f"{spec.delay_samples} is {1e3 * spec.delay_samples / spec.sample_rate_hz:.4g} ms; give "
            "compute_delay_samples in its place"
        )
    return max(late, 0.0)


def find_given_drive_delay(spec: LoopSpec) -> float | None:
    """Return the drive's delay that a specification states; none is left where the whole loop is given."""
    return spec.drive_delay_s if spec.delay_samples is None else 0.0


def place_drive_delay(spec: LoopSpec, params: ParameterSet, drive_delay_s: float) -> ParameterSet:
    """Return parameters with a drive's delay where they have none of their own; without any where samples count it."""
    return add_drive_delay(params, drive_delay_s) if spec.delay_samples is None else drop_drive_delay(params)


def find_drive_delay(spec: LoopSpec, plant: Plant, source: Fit | ParameterSet) -> float:
    """Return the drive's delay: as the specification states it, or as the fit or the parameters have it."""
    return find_drive(spec, plant, source).delay_s


def find_drive(spec: LoopSpec, plant: Plant, source: Fit | ParameterSet) -> Drive:
    """Return the drive's delay, and of a fit the experiment that tells it: the one with the longest."""
    stated = find_given_drive_delay(spec)
    if stated is not None:
        return Drive(delay_s=float(stated))
    if not isinstance(source, Fit):
        return Drive(delay_s=read_conditions(plant, source).get(DRIVE_DELAY, 0.0))
    fitted = {name: experiment.delay_s for name, experiment in source.list_delayed(plant).items()}
    longest = max(fitted, key=lambda name: fitted[name], default=None)
    return Drive(delay_s=0.0) if longest is None else Drive(delay_s=fitted[longest], fitted_in=longest)


def split_delayed(
    spec: LoopSpec, design: Plant, plants: Mapping[str, Plant], source: Fit | ParameterSet
) -> dict[str, Plant]:
    """Return plants with the delays that their own experiments have; one twice whose experiments differ. The parameters
    have the longest delay of the design plant, from which each plant's own is counted.
    """
    if not isinstance(source, Fit) or find_given_drive_delay(spec) is not None:
        return dict(plants)
    least, nominal = NEGLIGIBLE / spec.sample_rate_hz, source.delay_s(design)
    out: dict[str, Plant] = {}
    for name, plant in plants.items():
        out[name] = plant
        delayed = source.list_delayed(plant).values()
        delayed = [each for each in delayed if plant is design or each.plant == plant.name]
        delayed.sort(key=lambda each: each.delay_s)
        if not delayed:
            continue
        first, last = delayed[0], delayed[-1]
        if abs(last.delay_s - nominal) > least:
            out[name] = replace(plant, drive_offset_s=last.delay_s - nominal)
        std = math.hypot(first.std.get("delay_s", 0.0), last.std.get("delay_s", 0.0))
        if last.delay_s - first.delay_s > max(least, TOLD_STDS * std):
            out[f"{name}, shortest delay"] = replace(plant, drive_offset_s=first.delay_s - nominal)
    return out


def take_own_delays(
    spec: LoopSpec, design: Plant, plants: Mapping[str, Any], source: Fit | ParameterSet
) -> dict[str, Any]:
    """Return plants with the longest delay of their own experiments; what comes with values of its own as it is."""
    if not isinstance(plants, Mapping):
        raise ControlError(f"robust_to is a {type(plants).__name__}; give a mapping of name to plant")
    alone = {name: plant for name, plant in plants.items() if isinstance(plant, Plant)}
    late = split_delayed(spec, design, alone, source)
    return {name: late.get(name, plant) for name, plant in plants.items()}


def settle_delays(
    spec: SpecT, plant: Plant, source: Fit | ParameterSet, *, plans: bool = False
) -> tuple[SpecT, ParameterSet]:
    """Return a specification with its samples, and values with the drive's delay: what a loop is closed with. Samples
    that are left out are none where the design plant's log shows what a program does that reads and writes in one tick:
    a delay behind a command that is held. It takes an output without the present command in it, and a law that does not
    plan; else it is 1.
    """
    require_plant(plant, "plant", ControlError)
    require_type(source, (Fit, ParameterSet), "params", "give a Fit, or a ParameterSet", ControlError)
    values = source.parameters if isinstance(source, Fit) else source
    late = find_drive_delay(spec, plant, source)
    values = add_drive_delay(drop_drive_delay(values), late)
    if spec.compute_delay_samples is not None or spec.delay_samples is not None:
        return spec, values
    outputs = list(plant.outputs)
    rows = [plant.output[outputs.index(name)] for name in list_names(spec.measured) if name in outputs]
    shown = isinstance(source, Fit) and source.shows_delay(plant) and not plans
    at_once = shown and not any(ca.depends_on(row, plant.u[0]) for row in rows)
    return replace(spec, compute_delay_samples=0 if at_once else 1), values


def describe_delays(
    compute_delay_samples: int, drive_delay_s: float, sample_time_s: float, *, older: bool = False
) -> str:
    """Return both delays and their sum, in the words of terminal, page and header; of an `older` key the sum alone."""
    if older:
        return f"delay {format_count(compute_delay_samples, 'sample')} in all, the drive's among them"
    computing = f"compute delay {format_count(compute_delay_samples, 'sample')}"
    if not drive_delay_s:
        return f"{computing}, no drive delay"
    total = compute_delay_samples + drive_delay_s / sample_time_s
    return f"{computing} + drive delay {1e3 * drive_delay_s:.4g} ms = {total:.4g} samples"


def warn_delays(spec: LoopSpec, plant: Plant, source: Fit | ParameterSet) -> tuple[str, ...]:
    """Return warnings of an older key, of a delay that counts twice, and of less in all than the experiments have."""
    warnings: list[str] = []
    if spec.delay_samples is not None:
        warnings.append(
            f"delay_samples = {spec.delay_samples} is an older key, the whole loop in samples with the drive's delay "
            "in it; give compute_delay_samples (from a reading to the command being put out), and drive_delay_s where "
            "no log shows it"
        )
    stated = [f"{name} = {getattr(spec, name):g}" for name in ("delay_samples", "drive_delay_s") if getattr(spec, name)]
    parts = list_dead_times(plant) if stated else ()
    if parts:
        values = plant.complete(source.parameters if isinstance(source, Fit) else source)
        delays = join_words([f"{name} = {1e3 * values[name].value:.4g} ms" for name in parts])
        warnings.append(
            f"{delays} of the plant counts besides {stated[0]}: if that is the same delay, it counts twice; leave out "
            "one of them"
        )
    if not isinstance(source, Fit):
        return tuple(warnings)
    settled, _ = settle_delays(spec, plant, source)
    fitted, rate = source.delay_s(plant), spec.sample_rate_hz
    counted = settled.loop_delay_samples + find_drive_delay(spec, plant, source) * rate
    if counted < fitted * rate - NEGLIGIBLE:
        name = "delay_samples" if spec.delay_samples is not None else "drive_delay_s"
        warnings.append(
            f"{name} = {getattr(spec, name):g}, but the experiments have a delay of {1e3 * fitted:.4g} ms, "
            f"{fitted * rate:.4g} samples at {rate:g} Hz: a loop with that delay has smaller margins than stated for "
            f"{counted:.4g} samples; leave {name} out, and the fit's delay is taken"
        )
    return tuple(warnings)
