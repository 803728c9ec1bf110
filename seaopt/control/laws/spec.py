"""The specification of a controller, for the tuner and the certificate: a bandwidth, the limits, and what runs it."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any, Literal

from seaopt.codec import to_content
from seaopt.control.laws.command import Command
from seaopt.control.laws.delay import LoopSpec, check_delays, count_response_samples
from seaopt.control.laws.limits import BANDWIDTH_TOLERANCE, BY_NAME, LIFTABLE, LIMITS, Limit, list_given_limits
from seaopt.control.laws.plausibility import LARGEST
from seaopt.control.laws.structures import (
    CASCADE,
    CUSTOM,
    PREFILTER_ORDERS,
    Notch,
    Prefilter,
    PrefilterOrder,
    ReferenceWeights,
    SpeedLaw,
    SpeedLoop,
    Structure,
)
from seaopt.control.loops.compensation.link_feedforward import LOWEST_HZ, LinkFeedforward
from seaopt.control.loops.measured.plant import MeasuredPlant, sample_measured
from seaopt.control.loops.sampled_plant import Measured, find_signals, list_names
from seaopt.errors import ControlError, suggestion
from seaopt.formatting import join_words
from seaopt.frequency import MeasuredResponse
from seaopt.options import check_options, option
from seaopt.records import record

Level = float | Literal[False] | None  # of a limit: None is its default, False lifts it
MAX_DELAY_SAMPLES = 1000
HIGHEST_CORNER = 0.45  # of the sample rate: of a filter that is part of the law


def _limit(name: str, **described: Any) -> Any:
    """Return the option of a limit, with default and text of its row."""
    return option(BY_NAME[name].description, default=BY_NAME[name].default, **described)


@record(keywords=True)
class ControllerSpec(LoopSpec):
    """A bandwidth and the limits of `seaopt.control.laws.limits`: left out, each has its default; False lifts one.

    Raises
    ------
    ControlError
        A value is out of range, or two contradict each other.
    """

    measured: Measured = option(
        "The output that is regulated; or a list, it first and then what else is fed back, such as the motor's speed.",
        default="F1",
    )
    bandwidth_hz: float = _limit("bandwidth_hz", unit="Hz", stated=True)
    bandwidth_range_hz: tuple[float, float] = option(
        "Range in which a bandwidth may be asked for; it has no other effect.", default=(15.0, 60.0), unit="Hz"
    )
    structure: Structure = option(
        "A pid_dob has a disturbance observer whose nominal plant is the design plant; a cascade closes a loop on the "
        "motor's speed, the second of `measured`, inside the force loop; custom is a law that is given "
        "(`seaopt.assess`), which may have more than bandwidth_hz.",
        default="pid",
    )
    speed_loop: SpeedLaw = option(
        "The law of a cascade's inner loop: a PI rejects disturbances better, and hunts with the force loop's "
        "integral where dry friction sticks.",
        default="P",
    )
    notch: Notch | None = option("A notch in series.", default=None, switch=True)
    link_feedforward: LinkFeedforward | None = option(
        "Adds the effort that the link's measured motion needs, from the model of the first plant whose link moves.",
        default=None,
        switch=True,
    )
    prefilter: PrefilterOrder | Prefilter | None = option(
        "A low-pass of the reference alone, of this order, tuned with the gains; bandwidth_hz and all limits hold "
        "with it.",
        default=None,
    )
    reference_weights: ReferenceWeights = option(
        "k_r and c, by which the reference enters: tuned with the gains; of the error, k_r = 1/P(0) + k_p and c = 1; "
        "or the derivative of the measurement alone, c = 0, with k_r tuned.",
        default="tuned",
    )
    sample_rate_hz: float = option("Rate at which the controller runs.", default=1000.0, unit="Hz", above=0.0, most=1e6)
    compute_delay_samples: int | None = option(
        "Whole samples from a reading to the command being put out, besides the hold: the user's program. Left out: 0 "
        "where the log shows a delay behind a held command, else 1.",
        default=None,
    )
    drive_delay_s: float | None = option(
        "From the command to its effect, exact in fractions of a sample, for a delay that no log shows; that of the "
        "fit where left out.",
        default=None,
        unit="s",
    )
    delay_samples: int | None = option(
        "The older key: both delays together, in whole samples. Not beside the other two.", default=None
    )
    max_sensitivity: Level = _limit("max_sensitivity")
    max_complementary: Level = _limit("max_complementary")
    min_disk_margin: Level = _limit("min_disk_margin")
    max_reference_peak: Level = _limit("max_reference_peak")
    max_droop_db: Level = _limit("max_droop_db")
    max_noise_gain: Level = _limit("max_noise_gain")
    max_other_noise_gain: Level = _limit("max_other_noise_gain")
    min_filter_samples: Level = _limit("min_filter_samples")
    min_friction_margin: Level = _limit("min_friction_margin")
    min_sensitivity_bandwidth_hz: Level = _limit("min_sensitivity_bandwidth_hz")
    min_bandwidth_sliding_fast_hz: Level = _limit("min_bandwidth_sliding_fast_hz")
    passive_band_hz: tuple[float, float] | None = _limit("passive_band_hz")
    objective: Literal["disturbance", "noise"] = option(
        "What is sought among the laws that keep the limits: the least integral over log-frequency of |S| "
        "from 0.1 Hz to bandwidth_hz on the worst plant, or the least noise gain.",
        default="disturbance",
    )
    current_limit_A: float | None = option(
        "Largest current of the motor; it does not shape the gains. The controller says which force it leaves.",
        default=None,
        unit="A",
    )
    command_limit: float | None = option(
        "The same of another command, in its unit: a voltage, or a duty. Give one of the two.", default=None
    )
    step_N: float | None = option(
        "Size of the step that is judged, which the limit of the command must at least hold.", default=None, above=0.0
    )
    reserve: float = option(
        "Share by which each limit is met with room to spare, so that parameters as uncertain as a fit leaves them do "
        "not break it.",
        default=0.005,
        least=0.0,
        below=0.5,
    )
    bandwidth_tolerance: float = option(
        "Share of bandwidth_hz by which a law that is given, not tuned (`seaopt.assess`), may fall short of it.",
        default=BANDWIDTH_TOLERANCE,
        least=0.0,
        below=0.5,
    )

    def __post_init__(self) -> None:
        self._check_measured()
        check_options(self, ControlError)
        self._check_rates()
        check_delays(self, MAX_DELAY_SAMPLES)
        for name in LIFTABLE:
            BY_NAME[name].check(getattr(self, name), self.bandwidth_hz)
        self._check_filters()
        band: Any = self.passive_band_hz
        if band is not None:
            if not isinstance(band, tuple) or len(band) != 2 or not all(isinstance(f, (int, float)) for f in band):
                raise ControlError(f"passive_band_hz = {band!r} is not a band; give (low, high)")
            low, high = band
            if not LOWEST_HZ <= low < high < 0.5 * self.sample_rate_hz:
                raise ControlError(
                    f"passive_band_hz = [{low:g}, {high:g}] is not a band; give {LOWEST_HZ:g} <= low < high < "
                    f"{0.5 * self.sample_rate_hz:g} Hz, half the sample rate"
                )
        check_command_limits(self.current_limit_A, self.command_limit)

    def _check_measured(self) -> None:
        measured: Any = self.measured
        names = list_names(measured) if isinstance(measured, str | tuple) else ()
        if not names or not all(isinstance(name, str) and name for name in names) or len({*names}) < len(names):
            raise ControlError(
                f'measured = {measured!r} is not an output, nor several; give a name such as "F1", or a tuple of '
                "different ones, the regulated first"
            )
        if self.structure == CASCADE and len(names) != 2:
            raise ControlError(
                f'measured = {list(names)}: structure = "cascade" reads the regulated output and the motor\'s speed; '
                f'give both: measured = ["{names[0]}", "thetad_m"]'
            )

    def _check_rates(self) -> None:
        f, (low, high) = self.bandwidth_hz, self.bandwidth_range_hz
        if not f > 0.0:
            raise ControlError(
                f"bandwidth_hz = {f:g} is not positive; give it in Hz: bandwidth_hz = {abs(f) or 30.0:g}"
            )
        if not 0.0 < low < high:
            raise ControlError(
                f"bandwidth_range_hz = [{low:g}, {high:g}] is not a range; give 0 < low < high: "
                "bandwidth_range_hz = [15, 60]"
            )
        if not low <= f <= high:
            raise ControlError(
                f"bandwidth_hz = {f:g} is outside {low:g} to {high:g}; choose one inside, or give another range: "
                f"bandwidth_range_hz = [{min(low, f):g}, {max(high, f):g}]"
            )
        if not 4.0 * f < self.sample_rate_hz:
            raise ControlError(
                f"sample_rate_hz = {self.sample_rate_hz:g} is too slow for bandwidth_hz = {f:g}; sample more than four "
                f"times as fast: sample_rate_hz = {10.0 * f:g}"
            )

    def _check_filters(self) -> None:
        notch, path = self.notch, self.link_feedforward
        for name, value, kind in (("notch", notch, Notch), ("link_feedforward", path, LinkFeedforward)):
            if not isinstance(value, kind | None):
                raise ControlError(
                    f"{name} = {value!r} is a {type(value).__name__}; give a {kind.__name__}, in a file {name} = true"
                )
        check_prefilter(self.prefilter, self.sample_rate_hz)
        for name, part in (("notch", notch), ("link_feedforward", path)):
            if part is not None:
                _check_part(name, part, self.sample_rate_hz)
        if path is not None and path.measured in list_names(self.measured):
            raise ControlError(
                f'link_feedforward.measured = "{path.measured}" is fed back already; measure the link\'s motion'
            )

    @property
    def reference_filter(self) -> Prefilter | None:
        """The prefilter with its fields; None without one."""
        return check_prefilter(self.prefilter, self.sample_rate_hz)

    @property
    def regulated(self) -> str:
        """The output that is regulated, the first of what is measured."""
        return list_names(self.measured)[0]

    def find_speed_loop(self, reads: tuple[str, ...]) -> SpeedLoop | None:
        """Return what the speed loop of a cascade reads, of the outputs that its law reads; None without one."""
        names = list_names(self.measured)
        return SpeedLoop(differenced=reads[: len(names)] != names) if self.structure == CASCADE else None

    @property
    def limits(self) -> tuple[Limit, ...]:
        """The rows that a loop is judged by."""
        return list_given_limits(self.bandwidth_tolerance) if self.structure == CUSTOM else LIMITS

    def level(self, name: str) -> float | None:
        """Return the value that the limit of a name allows; None where it is not imposed."""
        return self.allowed(BY_NAME[name])

    @property
    def sensitivity_bandwidth_limit_hz(self) -> float:
        """The smallest allowed sensitivity bandwidth: as given, or bandwidth_hz/5."""
        return self.level("min_sensitivity_bandwidth_hz") or 0.0

    def see_response(self, measured: MeasuredResponse, command: Command) -> MeasuredPlant:
        """Return what a controller of this specification, which gives a command, sees of a measured response.

        Raises ControlError: the response is not of all outputs that the law reads, or of another one or input; the law
        reads the motion of a link that the response's plant does not hold; or as `sample_measured`.
        """
        outputs = {each.output: each for each in (measured, *measured.further)}
        reads = find_signals(measured.plant, self.measured)
        if self.link_feedforward is not None and measured.plant.moves:
            raise ControlError(
                f"frf:{measured.name}: is of {join_words([*outputs])} alone, and of a plant whose link moves, which "
                "link_feedforward reads; give a model of that plant, and responses of one that holds its link"
            )
        missing = [name for name in reads[1:] if name not in outputs]
        if missing:
            raise ControlError(
                f"frf:{measured.name}: is of {join_words([*outputs])} alone, and the law reads {join_words(reads)}, "
                f"whose responses are needed together, of one log: have {join_words(missing)} in it, or give a model "
                "of that plant"
            )
        ends = (("output", measured.output, self.regulated), ("input", measured.source, command.input))
        for end, measured_at, used in ends:
            if measured_at != used:
                raise ControlError(
                    f"frf:{measured.name}: is measured at the {end} {measured_at}, and the controller's is {used}; "
                    "measure that"
                )
        waits, of_reads = count_response_samples(self, measured), [outputs[name] for name in reads]
        return sample_measured(of_reads, command.per_effort, self.sample_time_s, waits)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields, as in a problem file."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        values["prefilter"] = self.reference_filter
        if self.bandwidth_tolerance == BANDWIDTH_TOLERANCE:
            del values["bandwidth_tolerance"]  # stands in no file of a law that was tuned
        if self.min_bandwidth_sliding_fast_hz is None:
            del values["min_bandwidth_sliding_fast_hz"]  # stands in no file of a plant without such friction
        if self.delay_samples is None:
            del values["delay_samples"]
            values["compute_delay_samples"] = self.loop_delay_samples
        return values | {name: to_content(values[name]) for name in ("notch", "prefilter", "link_feedforward")}


def check_command_limits(current_limit_A: float | None, command_limit: float | None) -> None:
    """Refuse two limits of the command, and one that is not positive or too large to compute with; infinity is none."""
    if current_limit_A is not None and command_limit is not None:
        raise ControlError(
            f"current_limit_A = {current_limit_A:g} and command_limit = {command_limit:g} are both given; give one"
        )
    for name, value in (("current_limit_A", current_limit_A), ("command_limit", command_limit)):
        if value is not None and not 0.0 < value <= LARGEST and value != math.inf:
            kind = "not positive" if not value > 0.0 else f"above {LARGEST:g}"
            raise ControlError(f"{name} = {value:g} is {kind}; give the motor's limit")


def check_prefilter(stated: Any, sample_rate_hz: float) -> Prefilter | None:
    """Return a prefilter with its fields; None without one. Raises ControlError: it is none, or out of range."""
    if not isinstance(stated, Prefilter | None) and stated not in PREFILTER_ORDERS:
        raise ControlError(
            f"prefilter = {stated!r} is not known; {suggestion(str(stated), PREFILTER_ORDERS)}; or give a Prefilter"
        )
    chosen = Prefilter(order=stated) if isinstance(stated, str) else stated
    if chosen is not None:
        _check_part("prefilter", chosen, sample_rate_hz)
        if chosen.damping is not None and not chosen.is_second_order:
            raise ControlError(
                f"prefilter.damping = {chosen.damping!r} is of a filter of second order; leave it out, or give "
                'order = "second_order"'
            )
    return chosen


def _check_part(name: str, part: Notch | LinkFeedforward | Prefilter, sample_rate_hz: float) -> None:
    """Refuse a filter's numbers that are out of range."""
    check_options(part, ControlError, f"{name}.")
    highest = HIGHEST_CORNER * sample_rate_hz
    for field in fields(part):
        value = getattr(part, field.name)
        if field.name.endswith("_hz") and value and not LOWEST_HZ <= value <= highest:
            raise ControlError(f"{name}.{field.name} = {value!r} is not {LOWEST_HZ:g} to {highest:g}")
