"""What is asked of a force controller within limits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from types import NoneType
from typing import Any

import numpy as np

from seaopt.control.laws.delay import LoopSpec, check_delays
from seaopt.control.laws.limits import BY_NAME, Limit
from seaopt.control.laws.spec import HIGHEST_CORNER, ControllerSpec, Level, check_prefilter
from seaopt.control.laws.structures import Prefilter, PrefilterOrder
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.control.mpc.noise import NoiseModel
from seaopt.errors import ControlError, require_type
from seaopt.options import check_options, list_options, option
from seaopt.records import record

NO_SLEW_LIMIT = 1e12  # A/s or another unit's, far above which the plan's rows for it vanish in rounding
MAX_HORIZON_SAMPLES = 500  # of a horizon
MAX_MPC_DELAY_SAMPLES = 100
FILTER_DAMPING = 0.7  # of a prefilter that states none
MAX_MPC_ITERATIONS = 10_000
MPC_BANDWIDTH_TOLERANCE = 0.02  # the weight makes the bandwidth of a plan with every current free; few cost accuracy
MPC_LIMITS = (  # of the table of limits, those of a loop without gains
    *(BY_NAME[name] for name in (
        "stability", "max_sensitivity", "max_complementary", "min_disk_margin", "max_reference_peak", "max_droop_db",
        "max_noise_gain", "min_sensitivity_bandwidth_hz", "shoulder_hz",
    )),
    replace(
        BY_NAME["bandwidth_hz"], tolerance=MPC_BANDWIDTH_TOLERANCE,
        meaning="lowest frequency at which |F/F_ref| is 3 dB below its value at 0 Hz, met to 2 %",
        remedy="plan with more moves, or over a shorter horizon",
    ),
)  # fmt: skip

CONTROLLER_OPTIONS = {each.name: each for each in list_options(ControllerSpec)}


def _shared(name: str) -> Any:
    """Return an option that a plan has in common with gains."""
    shared = CONTROLLER_OPTIONS[name]
    return option(shared.option.text, default=shared.default, unit=shared.option.unit)


@record(keywords=True)
class MPCSpec(LoopSpec):
    """Limits of the plan, and bandwidth and margins while none of them is active.

    Raises
    ------
    ControlError
        A value is out of range, or two contradict each other.
    """

    current_limit_A: float | None = option(
        "The command, a current, stays within plus and minus this.", default=None, unit="A", above=0.0
    )
    command_limit: float | None = option("The same of another command, in its unit. Give one.", default=None, above=0.0)
    current_slew_A_per_s: float | None = option(
        "Largest rate of the command, a current; no limit where left out.",
        default=None,
        unit="A/s",
        above=0.0,
        most=NO_SLEW_LIMIT,
    )
    command_slew_per_s: float | None = option(
        "The same of another command, in its unit per second. Give one of the two.",
        default=None,
        above=0.0,
        most=NO_SLEW_LIMIT,
    )
    measured: str = option("The output that is fed back.", default="F1")
    bandwidth_hz: float = option(
        "Frequency at which |F/F_ref| is 3 dB below its static value while no limit is active, on the design plant; it "
        "sets the weight of the command's increments, and is a limit: a plan of few moves over a long horizon may miss "
        "it by more than 2 %.",
        default=30.0,
        unit="Hz",
        above=0.0,
    )
    sample_rate_hz: float = option("Rate at which the controller runs.", default=1000.0, unit="Hz", above=0.0)
    compute_delay_samples: int | None = _shared("compute_delay_samples")
    drive_delay_s: float | None = _shared("drive_delay_s")
    delay_samples: int | None = _shared("delay_samples")
    decay: float = option(
        "Time constant with which the force error dies out, times 2 pi bandwidth_hz; the larger, the less overshoot "
        "and the more noise in the command.",
        default=0.8,
        least=0.0,
        below=1.0,
    )
    horizon_s: float = option("How far it plans.", default=0.05, unit="s", above=0.0)
    moves: int = option(
        "Free commands in a plan, with straight lines between.", default=12, least=2, most=MAX_HORIZON_SAMPLES
    )
    prefilter: PrefilterOrder | Prefilter | None = option(
        "A low-pass of the reference alone, of this order, before the plan, whose bandwidth rises so that bandwidth_hz "
        "holds with it. Left out, its corner is at twice bandwidth_hz, and its damping 0.7.",
        default=None,
    )
    largest_force_N: float | None = option(
        "A force that the limit of the command must be able to hold; a limit too low for it is refused.",
        default=None,
        above=0.0,
    )
    bounds: Mapping[str, tuple[float, float]] = option(
        "Within [low, high] stay these outputs and states of the plant, deflection and rate of its spring "
        "(`spring_deflection`, `spring_rate`), in their units. The bounds are soft: a plan breaks them where none "
        "keeps them, and then as little as it can.",
        default_factory=dict[str, tuple[float, float]],
    )
    preview_samples: int = option(
        "References beyond the present one that the law may be given; the horizon and the delay at most.",
        default=0,
        least=0,
        most=MAX_HORIZON_SAMPLES,
    )
    max_iterations: int = option(
        "Iterations of the solver in one step, each of which takes in or lets go a limit of the plan. Where they "
        "do not suffice, its plan is used if it keeps the limits; otherwise the last plan goes on.",
        default=100,
        least=1,
        most=MAX_MPC_ITERATIONS,
    )
    noise: NoiseModel | None = option(
        "What the Kalman filter counts on. Left out, one that makes the filter quick: its sensor noise is 1/120 of the "
        "static gain (2 N for THOR), the noise of the current 1 A s^(1/2), its drift 3 A s^(-1/2).",
        default=None,
    )
    max_sensitivity: Level = _shared("max_sensitivity")
    max_complementary: Level = _shared("max_complementary")
    min_disk_margin: Level = _shared("min_disk_margin")
    max_reference_peak: Level = _shared("max_reference_peak")
    max_droop_db: Level = _shared("max_droop_db")
    max_noise_gain: Level = _shared("max_noise_gain")
    min_sensitivity_bandwidth_hz: Level = _shared("min_sensitivity_bandwidth_hz")

    def __post_init__(self) -> None:
        if (self.current_limit_A is None) == (self.command_limit is None):
            raise ControlError(
                f"current_limit_A = {self.current_limit_A}, command_limit = {self.command_limit}: give one of the two"
            )
        check_options(self, ControlError)
        if self.current_slew_A_per_s is not None and self.command_slew_per_s is not None:
            raise ControlError(
                f"current_slew_A_per_s = {self.current_slew_A_per_s:g} and command_slew_per_s = "
                f"{self.command_slew_per_s:g} are both given; give one"
            )
        require_type(self.noise, (NoiseModel, NoneType), "noise", "give a NoiseModel", ControlError)
        if not 4.0 * self.bandwidth_hz < self.sample_rate_hz:
            raise ControlError(
                f"sample_rate_hz = {self.sample_rate_hz:g} is too slow for bandwidth_hz = {self.bandwidth_hz:g}; "
                "sample more than four times as fast"
            )
        check_delays(self, MAX_MPC_DELAY_SAMPLES)
        if not self.moves <= self.samples <= MAX_HORIZON_SAMPLES:
            raise ControlError(
                f"horizon_s = {self.horizon_s:g} is {self.samples} samples; it takes {self.moves} (moves) to "
                f"{MAX_HORIZON_SAMPLES}"
            )

        check_prefilter(self.prefilter, self.sample_rate_hz)
        self._check_bounds()
        for limit in MPC_LIMITS:
            if limit.has_field:
                limit.check(getattr(self, limit.name), self.bandwidth_hz)

    def _check_bounds(self) -> None:
        if not isinstance(self.bounds, Mapping):
            raise ControlError(f"bounds is a {type(self.bounds).__name__}; give a mapping of name to (low, high)")
        for name, ends in self.bounds.items():
            numbers = isinstance(ends, (tuple, list)) and len(ends) == 2
            if not (numbers and all(isinstance(end, (int, float)) and math.isfinite(end) for end in ends)):
                raise ControlError(f"bounds of {name} = {ends!r} are not two numbers; give (low, high)")
            if not ends[0] < ends[1]:
                raise ControlError(f"bounds of {name} = {ends!r} leave nothing between; give (low, high)")
        if self.preview_samples > self.samples + self.loop_delay_samples:
            raise ControlError(
                f"preview_samples = {self.preview_samples} reach beyond horizon_s = {self.horizon_s:g} and the delay; "
                f"give preview_samples = {self.samples + self.loop_delay_samples} at most"
            )

    @property
    def reference_filter(self) -> Prefilter | None:
        """The prefilter with its numbers; None without one."""
        chosen, highest = check_prefilter(self.prefilter, self.sample_rate_hz), HIGHEST_CORNER * self.sample_rate_hz
        if chosen is None:
            return None
        damping = (chosen.damping or FILTER_DAMPING) if chosen.is_second_order else None
        return replace(chosen, corner_hz=chosen.corner_hz or min(2.0 * self.bandwidth_hz, highest), damping=damping)

    @property
    def low_pass(self) -> TransferFunction | None:
        """The prefilter as it runs; None without one."""
        chosen = self.reference_filter
        return None if chosen is None else chosen.filters(self.sample_time_s)[0]

    @property
    def limits(self) -> tuple[Limit, ...]:
        """The rows that its loop is judged by."""
        return MPC_LIMITS

    @property
    def samples(self) -> int:
        """Samples in the horizon."""
        return round(self.horizon_s * self.sample_rate_hz)

    @property
    def slew_asked(self) -> float | None:
        """The limit of the command's rate, in its unit per second; None for none."""
        return self.command_slew_per_s if self.current_slew_A_per_s is None else self.current_slew_A_per_s

    @property
    def slew_per_sample(self) -> float:
        """Largest change of the command from one sample to the next; infinite without a limit."""
        return np.inf if self.slew_asked is None else self.slew_asked * self.sample_time_s
