"""What is asked of a force controller within limits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field, replace
from types import NoneType

import numpy as np

from seaopt.control.laws.delay import check_delays, count_loop_samples
from seaopt.control.laws.limits import BY_NAME, Limit
from seaopt.control.laws.spec import Level
from seaopt.control.mpc.noise import NoiseModel
from seaopt.errors import ControlError, require_type
from seaopt.records import record

NO_SLEW_LIMIT = 1e12  # A/s, far above which the plan's rows for it vanish in rounding
MAX_HORIZON_SAMPLES = 500  # of a horizon
MAX_MPC_DELAY_SAMPLES = 100
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


@record(keywords=True)
class MPCSpec:
    """Limits of the plan, and bandwidth and margins while none of them is active.

    Parameters
    ----------
    current_limit_A, command_limit : float
        The command, a current or whatever the plant's first input is, stays within plus and minus this. Give one.
    current_slew_A_per_s : float, optional
        Largest rate of change of the command, in its unit over s; None: no limit.
    measured : str
        The output that is fed back, F1 as a rule.
    bandwidth_hz : float
        Frequency at which abs(F/F_ref) is 3 dB below its static value as long as no limit is active, on the design
        plant; it sets the weight of the current's increments, and is a limit: a plan of few moves over a long
        horizon may miss it by more than 2 %.
    sample_rate_hz : float
        Of the controller.
    compute_delay_samples : int, optional
        Whole samples from a reading to the command being put out, besides the hold; 1 if left out.
    drive_delay_s : float, optional
        Seconds from the command to its effect; left out, where `force_mpc` is given a fit, that of its experiments on
        the design plant.
    delay_samples : int, optional
        The older key: the whole loop in samples, the drive's delay among them. Not beside the other two.
    decay : float
        Time constant with which the force error should die out, times 2 pi bandwidth_hz, from 0 to below 1: the
        larger, the less overshoot and the more noise in the current.
    horizon_s : float
        How far it plans.
    moves : int
        Number of free currents in the plan, with straight lines between.
    largest_force_N : float, optional
        A force that the current limit must be able to hold; a limit too low for it is refused.
    bounds : mapping of name to (low, high)
        Of outputs and states of the plant, deflection and rate of its spring (`spring_deflection`, `spring_rate`), in
        their units. They are soft: a plan breaks them where none keeps them, and then as little as it can.
    preview_samples : int
        How many references beyond the present one the controller may be given; the horizon and the delay at most.
    max_iterations : int
        Of the solver in one step, each of which takes in or lets go a limit of the plan. Where they do not suffice, its
        plan is used if it keeps the limits; otherwise the last plan goes on.
    noise : NoiseModel, optional
        Of the Kalman filter, with a drift of the current. If left out, one that makes the filter quick: its sensor
        noise is 1/120 of the static gain (2 N for THOR), the noise of the current 1 A s^(1/2), its drift 3 A s^(-1/2).
    max_sensitivity, max_complementary, min_disk_margin : float, optional
        Limits of the loop, as in `ControllerSpec`: left out, each has its default; False lifts one.
    max_reference_peak, max_droop_db, max_noise_gain, min_sensitivity_bandwidth_hz : float, optional
        Likewise.

    Raises
    ------
    ControlError
        A value is out of range, or two contradict each other.

    """

    current_limit_A: float | None = None
    command_limit: float | None = None
    current_slew_A_per_s: float | None = None
    measured: str = "F1"
    bandwidth_hz: float = 30.0
    sample_rate_hz: float = 1000.0
    compute_delay_samples: int | None = None
    drive_delay_s: float | None = None
    delay_samples: int | None = None
    decay: float = 0.8
    horizon_s: float = 0.05
    moves: int = 12
    largest_force_N: float | None = None
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict[str, tuple[float, float]])
    preview_samples: int = 0
    max_iterations: int = 100
    noise: NoiseModel | None = None
    max_sensitivity: Level = BY_NAME["max_sensitivity"].default
    max_complementary: Level = BY_NAME["max_complementary"].default
    min_disk_margin: Level = BY_NAME["min_disk_margin"].default
    max_reference_peak: Level = BY_NAME["max_reference_peak"].default
    max_droop_db: Level = BY_NAME["max_droop_db"].default
    max_noise_gain: Level = BY_NAME["max_noise_gain"].default
    min_sensitivity_bandwidth_hz: Level = None

    def __post_init__(self) -> None:
        if (self.current_limit_A is None) == (self.command_limit is None):
            raise ControlError(
                f"current_limit_A = {self.current_limit_A}, command_limit = {self.command_limit}: give one of the two"
            )
        for name in ("bandwidth_hz", "sample_rate_hz", "horizon_s"):
            self._positive(name)
        for name in ("current_limit_A", "command_limit", "current_slew_A_per_s", "largest_force_N"):
            if getattr(self, name) is not None:
                self._positive(name)
        if self.current_slew_A_per_s is not None and self.current_slew_A_per_s > NO_SLEW_LIMIT:
            raise ControlError(f"current_slew_A_per_s = {self.current_slew_A_per_s:g} limits nothing; leave it out")
        require_type(self.noise, (NoiseModel, NoneType), "noise", "give a NoiseModel", ControlError)
        if isinstance(self.decay, bool) or not isinstance(self.decay, (int, float)) or not 0.0 <= self.decay < 1.0:
            raise ControlError(f"decay = {self.decay!r} is not from 0 to below 1, where the bandwidth ends; lower it")
        ranges = {
            "moves": (2, MAX_HORIZON_SAMPLES), "max_iterations": (1, MAX_MPC_ITERATIONS),
            "preview_samples": (0, MAX_HORIZON_SAMPLES),
        }  # fmt: skip
        for name, (least, most) in ranges.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
                raise ControlError(f"{name} = {value!r} is not a whole number from {least} to {most}")
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

        self._check_bounds()
        for limit in MPC_LIMITS:
            if limit.has_field:
                limit.check(getattr(self, limit.name), self.bandwidth_hz)

    def _positive(self, name: str) -> None:
        value = getattr(self, name)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.0 < value < math.inf:
            raise ControlError(f"{name} = {value!r} is not a number above zero; give one")

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
    def lag_s(self) -> float:
        """Time constant with which a force error dies out at no cost, s."""
        return self.decay / (2.0 * math.pi * self.bandwidth_hz)

    @property
    def loop_delay_samples(self) -> int:
        """Whole samples of delay that a loop is closed with besides the drive's: as given, or 1."""
        return count_loop_samples(self)

    @property
    def limits(self) -> tuple[Limit, ...]:
        """The rows that its loop is judged by."""
        return MPC_LIMITS

    def allowed(self, limit: Limit) -> float | None:
        """Return the value that one of `MPC_LIMITS` allows; None where it is not imposed."""
        return limit.allow(getattr(self, limit.name) if limit.has_field else None, self.bandwidth_hz)

    @property
    def limit_asked(self) -> float:
        """The limit of the command that is asked for, in its unit."""
        limit = self.command_limit if self.current_limit_A is None else self.current_limit_A
        assert limit is not None
        return limit

    @property
    def sample_time_s(self) -> float:
        """Seconds between samples."""
        return 1.0 / self.sample_rate_hz

    @property
    def samples(self) -> int:
        """Samples in the horizon."""
        return round(self.horizon_s * self.sample_rate_hz)

    @property
    def slew_per_sample_A(self) -> float:
        """Largest change of current from one sample to the next; infinite without a limit."""
        slew = self.current_slew_A_per_s
        return np.inf if slew is None else slew * self.sample_time_s
