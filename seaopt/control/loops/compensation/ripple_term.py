r"""Compensation of torque ripple and cogging: a Fourier series of the measured motor angle, added to the effort.

.. math:: c_k = \sum_n a_n \cos n\varphi_k + b_n \sin n\varphi_k, \qquad \varphi_k = 2\pi\, \theta_k / \Theta,

with the fraction in the coefficients, :math:`\theta_k` the motor's position as read and :math:`\Theta` what it moves in
one revolution. A target needs no library for it: the turn is reduced to :math:`|x| \le 1/2`, sine and cosine of a
quarter of its angle (at most :math:`\pi/4`) are Taylor's polynomials, below rounding in double, two doublings of the
angle lead to :math:`e^{i\varphi}`, and its powers follow by the recurrence
:math:`e^{i n\varphi} = e^{i (n - 1)\varphi} e^{i\varphi}`, whose error grows in proportion to n.

Its slope is a stiffness at the motor, of either sign, which is feedback.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float

from seaopt.codec import Constraints
from seaopt.errors import ControlError, require_number
from seaopt.formatting import format_percent
from seaopt.options import check_options, option
from seaopt.records import record

MOST_CYCLES = 200  # per revolution
RIPPLE_FRACTION = 0.9
MOST_TURNS = 1e9  # which a C long holds
# Of y^2, highest power first: sin y = y p(y^2), cos y = q(y^2).
SINE = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(7, -1, -1))
COSINE = tuple((-1.0) ** k / math.factorial(2 * k) for k in range(8, -1, -1))
POINTS_PER_CYCLE = 64
Cycles = Annotated[int, Constraints(ge=1, le=MOST_CYCLES)]


@record
class CompensateRipple:
    """The options of a compensation of torque ripple.

    Raises
    ------
    ControlError
        The lists differ in length, a harmonic is no whole number from 1 to 200 or is there twice, or a number is out
        of range.

    Examples
    --------
    >>> CompensateRipple(cycles=(6, 12), cos=(0.1, 0.0), sin=(0.0, 0.02)).fraction
    0.9
    """

    cycles: tuple[int, ...] = option("Harmonics, in cycles per revolution.", least=1, most=MOST_CYCLES)
    cos: tuple[float, ...] = option(
        "The command that meets the ripple, for each harmonic, in the command's unit; `identify_ripple` has them."
    )
    sin: tuple[float, ...] = option("The same for the sine of each harmonic.")
    fraction: float = option("Share of the series that is compensated.", default=RIPPLE_FRACTION, above=0.0, most=1.5)
    period: float | None = option(
        "What the motor's position moves in one revolution; 2 pi where it is in rad and this is left out.",
        default=None,
        above=0.0,
    )

    def __post_init__(self) -> None:
        check_options(self, ControlError, "compensate.ripple.")
        count = len(self.cycles)
        if not count or len(self.cos) != count or len(self.sin) != count:
            raise ControlError(
                f"compensate.ripple: {count} cycles, {len(self.cos)} cos and {len(self.sin)} sin; give one of each per "
                "harmonic: ripple = { cycles = [6], cos = [0.1], sin = [0.0] }"
            )
        check_cycles(self.cycles, "compensate.ripple.cycles")
        for name, values in (("cos", self.cos), ("sin", self.sin)):
            for value in values:
                if not math.isfinite(require_number(value, f"compensate.ripple.{name}", ControlError)):
                    raise ControlError(f"compensate.ripple.{name} has {value:g}; give finite numbers")
        if not any((*self.cos, *self.sin)):
            raise ControlError("compensate.ripple: cos and sin are all zero; leave ripple out of compensate")


def check_cycles(cycles: Sequence[int], name: str) -> None:
    """Refuse harmonics that are not whole numbers from 1 to 200, each once."""
    for value in cycles:
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MOST_CYCLES:
            raise ControlError(
                f"{name} has {value!r}, which is not a whole number from 1 to {MOST_CYCLES}; give cycles per "
                "revolution, or a longer period"
            )
    if len(set(cycles)) != len(cycles):
        raise ControlError(f"{name} = {list(cycles)} has a harmonic twice; give each once")


@record
class RippleTerm:
    """Compensation of torque ripple as it runs."""

    # harmonics, in cycles per revolution
    cycles: Annotated[tuple[Cycles, ...], Constraints(min_length=1, max_length=MOST_CYCLES)]
    cos: tuple[float, ...]  # cos, sin: of each, the fraction in them, in the command's unit of effort
    sin: tuple[float, ...]
    period: Annotated[float, Constraints(gt=0.0)]  # what the reading moves in one revolution, in its unit
    reads: Annotated[str, Constraints(min_length=1)]  # the output that is the motor's position
    unit: str
    fraction: Annotated[float, Constraints(gt=0.0)]  # of the ripple

    def __post_init__(self) -> None:
        if not len(set(self.cycles)) == len(self.cycles) == len(self.cos) == len(self.sin):
            raise ControlError("should have each of cycles once, and one cos and one sin for each")

    @property
    def numbers(self) -> list[float]:
        """Revolutions per unit of the reading, and the coefficients."""
        return [1.0 / self.period, *self.cos, *self.sin]

    @property
    def harmonics(self) -> list[tuple[float, float]]:
        """Cosine and sine of every harmonic from the first to the last, as the C sums them."""
        series = {n: (cos, sin) for n, cos, sin in zip(self.cycles, self.cos, self.sin, strict=True)}
        return [series.get(n, (0.0, 0.0)) for n in range(1, max(self.cycles) + 1)]

    def effort(self, position: float) -> float:
        """Return what is added to the effort at a position."""
        return float(sum_ripple(self.cycles, self.numbers, position, np))

    def slope(self, position: float) -> float:
        """Return its slope there, effort per unit of the reading."""
        return float(self._slopes(np.array([position]))[0])

    @property
    def _rates(self) -> Float[np.ndarray, " h"]:
        """Radians per unit of the reading, of each harmonic."""
        return 2.0 * np.pi / self.period * np.array(self.cycles)

    def _slopes(self, positions: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        rates, angles = self._rates, np.outer(positions, self._rates)
        return np.cos(angles) @ (rates * self.sin) - np.sin(angles) @ (rates * self.cos)

    @property
    def steepest(self) -> tuple[float, float]:
        """Bounds of its slope over a revolution: below the least and above the largest, by 0.1 % or so."""
        rates, count = self._rates, POINTS_PER_CYCLE * max(self.cycles)
        slopes = self._slopes(np.arange(count) * (self.period / count))
        # Between points an extreme is at most half a step away, where the slope is flat.
        between = 0.5 * (0.5 * self.period / count) ** 2 * float(rates**3 @ np.hypot(self.cos, self.sin))
        return float(np.min(slopes)) - between, float(np.max(slopes)) + between

    def describe(self, effort_unit: str) -> str:
        """Return what it does in words."""
        sizes = ", ".join(
            f"{size:.3g} at {cycles}" for cycles, size in zip(self.cycles, np.hypot(self.cos, self.sin), strict=True)
        )
        return (
            f"{format_percent(self.fraction)} of the ripple over {self.reads}, {sizes} cycles per revolution "
            f"({self.period:.6g} {self.unit}), {effort_unit}"
        )


def sum_ripple(cycles: Sequence[int], numbers: Sequence[Any], position: Any, operations: Any) -> Any:
    """Return the series at a position, of floats or expressions; `operations`: the module numpy or casadi."""
    count = len(cycles)
    turns = operations.fmax(operations.fmin(numbers[0] * position, MOST_TURNS), -MOST_TURNS)
    quarter = 0.5 * math.pi * (turns - operations.floor(turns + 0.5))
    squared = quarter * quarter
    sine, cosine = quarter * _horner(SINE, squared), _horner(COSINE, squared)
    for _ in range(2):
        sine, cosine = 2.0 * sine * cosine, 1.0 - 2.0 * sine * sine
    weights = {n: (numbers[1 + i], numbers[1 + count + i]) for i, n in enumerate(cycles)}
    total, real, imaginary = 0.0 * position, 1.0, 0.0
    for n in range(1, max(cycles) + 1):
        real, imaginary = real * cosine - imaginary * sine, real * sine + imaginary * cosine
        if n in weights:
            total += weights[n][0] * real + weights[n][1] * imaginary
    return total


def _horner(coefficients: Sequence[float], value: Any) -> Any:
    total: Any = 0.0
    for coefficient in coefficients:
        total = total * value + coefficient
    return total
