"""Noise and quantisation of the sensors that a controller reads, as logs show them, and the noise gain they allow."""

from __future__ import annotations

import math
from collections.abc import Sequence

from seaopt.problem.proposal.actuators import Proposed
from seaopt.problem.proposal.described_log import DescribedLog
from seaopt.records import record

COARSE = 0.5  # of the noise: a step from which quantisation is worth naming
NOISE_GAIN = 50.0  # that is allowed up to WIDEST times the resonance, and by the square of the bandwidth above
WIDEST = 4.0
NOISY = 0.25  # of the largest effort in the logs: what noise may make of the motor's


@record
class SensorNoise:
    """White noise before a sensor rounds its readings, and the step that they are rounded to, in SI."""

    std: float = 0.0
    step: float = 0.0

    @property
    def total(self) -> float:
        """Standard deviation of both together: rounding adds a twelfth of the squared step."""
        return math.hypot(self.std, self.step / math.sqrt(12.0))


def measure_noise(logs: Sequence[DescribedLog], output: str) -> SensorNoise:
    """Return an output's noise from sample to sample, of the log that has most of it; none where no log has it."""
    candidates = [SensorNoise()]
    for log in logs:
        if output in log.roles.columns:
            column, scale = log.roles.columns[output], abs(log.si_scale(output))
            seen, step = column.noise * scale, column.quantum * scale
            rounded = step if step > COARSE * seen else 0.0
            candidates.append(SensorNoise(std=math.sqrt(max(seen**2 - rounded**2 / 12.0, 0.0)), step=rounded))
    return max(candidates, key=lambda noise: noise.total)


def list_sensors(logs: Sequence[DescribedLog], actuator: Proposed) -> dict[str, SensorNoise]:
    """Return the noise of each sensor that the controller reads; a torque of two encoders has theirs."""
    names = ("theta_m", "theta_l") if actuator.measured == "tau_d" else (actuator.measured,)
    noises = {name: measure_noise(logs, name) for name in names}
    return {name: noise for name, noise in noises.items() if noise.total > 0.0}


def combine_noise(sensors: dict[str, SensorNoise], actuator: Proposed) -> float:
    """Return the standard deviation of the regulated effort's noise."""
    if actuator.measured != "tau_d":
        return max((noise.total for noise in sensors.values()), default=0.0)
    values = {line.name: line.number for line in actuator.lines}
    weights = {"theta_m": values["k_n"] / values["N"], "theta_l": values["k_n"]}
    return math.hypot(*(weights[name] * noise.total for name, noise in sensors.items()))


def limit_noise_gain(
    logs: Sequence[DescribedLog], output: str, noise: float, bandwidth_hz: float, resonance_hz: float | None
) -> float:
    """Return a limit on the motor's effort over sensor noise that lets noise make a quarter of the largest effort. It
    is at most `NOISE_GAIN`, and no less than a bandwidth so far above the resonance needs.
    """
    needed = (bandwidth_hz / (WIDEST * resonance_hz)) ** 2 if resonance_hz else 1.0
    most, least = NOISE_GAIN * max(1.0, needed), NOISE_GAIN * needed
    swings = [log.roles.columns[output].swing * abs(log.si_scale(output)) for log in logs if output in log.outputs]
    allowed = NOISY * max(swings, default=0.0) / noise if noise > 0.0 and swings else most
    return min(max(allowed, least), most)
