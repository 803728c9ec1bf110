r"""The terms that a law adds because the plant is known: once a sample, in Python, in simulation and in C.

Friction is met with an effort of the size of a fraction of Coulomb friction and of the sign of a velocity,

.. math:: c_k = \gamma F_c\, \mathrm{sat}(v_k / v_0), \qquad \mathrm{sat}(x) = \min(\max(x, -1), 1),

where :math:`v_k` is the velocity at the friction: the one that the reference asks for with the link at rest,
:math:`v_k = g (r_k - r_{k-1})/T_s`, which is outside every loop, or the one that is measured,
:math:`v_k = g (\theta_k - \theta_{k-1})/T_s` of an encoder at the motor, which is a feedback
(`seaopt.control.loops.compensation.stability`). The saturation has the slope of a hyperbolic tangent at rest, needs no
library on a target, and is monotone and odd, which is all that the test of stability asks.

Gravity is met through the reference: what the spring has to carry so that the link stands still where it is,

.. math:: r_k' = r_k + \gamma G(x_k), \qquad G(x) = \sum_n g_n T_n(\xi), \qquad
          \xi = \mathrm{sat}\left(\frac{2 x - x_\mathrm{lo} - x_\mathrm{hi}}{x_\mathrm{hi} - x_\mathrm{lo}}\right),

of the link's measured position x, as a series of Chebyshev polynomials summed by Clenshaw's recurrence, constant
beyond its range. Torque ripple is met with a Fourier series of the motor's angle
(`seaopt.control.loops.compensation.ripple_term`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

from numpy.polynomial.chebyshev import chebder, chebval

from seaopt.codec import Constraints, to_content
from seaopt.control.loops.compensation.ripple_term import RippleTerm, sum_ripple
from seaopt.errors import ControlError
from seaopt.formatting import format_percent
from seaopt.options import check_options, option
from seaopt.records import record

FrictionSource = Literal["reference", "speed"]
SOURCES: tuple[FrictionSource, ...] = ("reference", "speed")
DEFAULT_FRACTION = 0.8
Memory = tuple[float, float]  # whether there was a sample before, and what it had of what is differenced
FORGOTTEN: Memory = (0.0, 0.0)


@record
class CompensateFriction:
    """The options of a compensation of friction.

    Raises
    ------
    ControlError
        A value is out of range.

    Examples
    --------
    >>> CompensateFriction(fraction=0.9).source
    'reference'
    """

    fraction: float = option(
        "Share of the design plant's Coulomb friction; above 1 is more than there is.",
        default=DEFAULT_FRACTION,
        above=0.0,
        most=1.5,
    )
    source: FrictionSource = option(
        'The motor speed that the "reference" asks for, outside the loop; or its measured "speed", inside.',
        default="reference",
        key="from",
    )
    speed: float | None = option(
        "v_0, at which it has its full size, m/s or rad/s at the friction. Left out: the plant's own smoothing; of the "
        "measured speed at least twice what stability is shown for on the design plant.",
        default=None,
        above=0.0,
    )

    def __post_init__(self) -> None:
        check_options(self, ControlError, "compensate.friction.")


@record
class CompensateGravity:
    """The options of a compensation of gravity.

    Raises
    ------
    ControlError
        The fraction is out of range.
    """

    fraction: float = option(
        "Share of what the spring carries at rest; above 1 a link falls upwards.", default=1.0, above=0.0, most=1.5
    )

    def __post_init__(self) -> None:
        check_options(self, ControlError, "compensate.gravity.")


@record
class GravityTerm:
    """Compensation of gravity as it runs."""

    # of Chebyshev's polynomials, the fraction in them, in the unit of the reference
    coefficients: Annotated[tuple[float, ...], Constraints(min_length=1, max_length=100)]
    low: float  # low, high: the range of the link's position in which they hold, in its unit
    high: float
    reads: Annotated[str, Constraints(min_length=1)]  # the output that is the link's position
    unit: str
    fraction: Annotated[float, Constraints(gt=0.0)]  # of what the spring carries at rest

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ControlError("should have low below high")

    @property
    def numbers(self) -> list[float]:
        """Middle of the range, 2 over its width, and the coefficients."""
        return [0.5 * (self.low + self.high), 2.0 / (self.high - self.low), *self.coefficients]

    def effort(self, position: float) -> float:
        """Return what is added to the reference at a position."""
        return _sum_series(self.numbers, position, _Floats)

    def slope(self, position: float) -> float:
        """Return its slope there; zero beyond the range."""
        if not self.low <= position <= self.high:
            return 0.0
        middle, scale, *coefficients = self.numbers
        return float(scale * chebval(scale * (position - middle), chebder(coefficients)))

    def scaled(self, factor: float) -> GravityTerm:
        """Return the term times a factor."""
        return replace(self, coefficients=tuple(factor * coefficient for coefficient in self.coefficients))

    def describe(self, effort_unit: str) -> str:
        """Return what it does in words."""
        largest = max(abs(self.effort(self.low)), abs(self.effort(self.high)), abs(self.effort(0.5 * self.high)))
        return (
            f"{format_percent(self.fraction)} of the link's weight, by {self.reads} from {self.low:.3g} to "
            f"{self.high:.3g} {self.unit}, of the order of {largest:.3g} {effort_unit}"
        )


@record
class FrictionTerm:
    """Compensation of friction as it runs."""

    effort: Annotated[float, Constraints(gt=0.0)]  # full size, fraction times Coulomb friction, in the command's unit
    speed: Annotated[float, Constraints(gt=0.0)]  # v_0, at the friction
    speed_unit: str  # m/s or rad/s
    fraction: Annotated[float, Constraints(gt=0.0)]  # of the Coulomb friction of the design plant
    source: FrictionSource  # where the velocity is from
    reads: str  # the output that is differenced, a position of the motor; empty where it is the reference
    velocity_per_rate: float  # g, the velocity at the friction per rate of what is differenced

    def __post_init__(self) -> None:
        if bool(self.reads) != (self.source == "speed"):
            raise ControlError('should have reads where source is "speed", and only there')

    @property
    def slope(self) -> float:
        """Effort over velocity at rest, its steepest, N s/m (N m s/rad)."""
        return self.effort / self.speed

    def share_per_step(self, sample_time_s: float) -> float:
        """Return what the difference of two samples is multiplied with, v/v_0."""
        return self.velocity_per_rate / (self.speed * sample_time_s)

    def describe(self, effort_unit: str) -> str:
        """Return what it does in words."""
        whence = "the reference's rate" if self.source == "reference" else f"the speed of {self.reads}"
        return (
            f"{format_percent(self.fraction)} of Coulomb friction, {self.effort:.4g} {effort_unit} at the spring, from "
            f"{whence}, at full size from {self.speed:.3g} {self.speed_unit}"
        )


@record
class Compensation:
    """The terms that a law adds to its effort and to its reference.

    Parameters
    ----------
    sample_time_s : float
        Seconds.
    friction : FrictionTerm, optional
    gravity : GravityTerm, optional
    ripple : RippleTerm, optional

    Examples
    --------
    >>> term = FrictionTerm(
    ...     effort=40.0, speed=0.01, speed_unit="m/s", fraction=0.8, source="speed", reads="q", velocity_per_rate=1.0
    ... )
    >>> compensation = Compensation(sample_time_s=1e-3, friction=term)
    >>> _, _, memory = compensation.step((0.0, 0.0), 0.0, [0.2])
    >>> round(compensation.step(memory, 0.0, [0.200005])[1], 9)  # 5 mm/s of 10 mm/s
    20.0
    """

    json_keys = ("friction", "gravity", "ripple")

    sample_time_s: float
    friction: FrictionTerm | None = None
    gravity: GravityTerm | None = None
    ripple: RippleTerm | None = None

    @property
    def reads(self) -> tuple[str, ...]:
        """The outputs that it reads, besides what the law does."""
        named = [term.reads for term in (self.friction, self.gravity, self.ripple) if term is not None]
        return tuple(dict.fromkeys(name for name in named if name))

    @property
    def numbers(self) -> list[float]:
        """Its numbers, in the order in which `compensate` takes them."""
        numbers: list[float] = []
        if self.friction is not None:
            numbers += [self.friction.effort, self.friction.share_per_step(self.sample_time_s)]
        for term in (self.gravity, self.ripple):
            numbers += [] if term is None else term.numbers
        return numbers

    @property
    def shape(self) -> CompensationShape:
        """Its structure, without its numbers."""
        return CompensationShape(
            friction=None if self.friction is None else self.friction.source,
            reads=self.reads,
            gravity=0 if self.gravity is None else len(self.gravity.numbers),
            link=0 if self.gravity is None else self.reads.index(self.gravity.reads),
            ripple=() if self.ripple is None else self.ripple.cycles,
            motor=0 if self.ripple is None else self.reads.index(self.ripple.reads),
        )

    def step(
        self, memory: Memory, reference: float, readings: Sequence[float], numbers: Sequence[float] | None = None
    ) -> tuple[float, float, Memory]:
        """Return the reference that the law gets, the effort that is added to its own, and the next memory.

        Parameters
        ----------
        memory : (float, float)
            Of the last sample; `FORGOTTEN` at the first, which counts as at rest.
        reference : float
            Of this sample.
        readings : sequence of float
            Of `reads`, in their order.
        numbers : sequence of float, optional
            In place of its own: of a schedule, those of the place.

        Raises
        ------
        ControlError
            There are not as many readings as outputs.
        """
        if len(readings) != len(self.reads):
            raise ControlError(
                f"readings: the compensation reads {', '.join(self.reads) or 'nothing'}, and got {len(readings)}; give "
                "one reading for each"
            )
        at = self.numbers if numbers is None else numbers
        shaped, effort, kept = compensate(self.shape, at, memory, reference, readings, _Floats)
        return shaped, effort, (kept[0], kept[1]) if kept else FORGOTTEN

    def mix(self, other: Compensation, share: float) -> Compensation:
        """Return the terms that a share of the way to another's coefficients, of the same shape, leads to."""
        friction, gravity, ripple = (
            term and replace(term, **{name: _mix(getattr(term, name), getattr(end, name), share) for name in names})
            for term, end, names in (
                (self.friction, other.friction, ("effort", "velocity_per_rate")),
                (self.gravity, other.gravity, ("coefficients",)),
                (self.ripple, other.ripple, ("cos", "sin")),
            )
        )
        return replace(self, friction=friction, gravity=gravity, ripple=ripple)

    def to_dict(self) -> dict[str, Any]:
        """Return its terms, for controller.json."""
        return to_content(self)

    def describe(self, effort_unit: str) -> list[str]:
        """Return what it does, one line for each term."""
        terms = {"friction": self.friction, "gravity": self.gravity, "ripple": self.ripple}
        return [f"{name}: {term.describe(effort_unit)}" for name, term in terms.items() if term is not None]


@record
class CompensationShape:
    """Which terms a compensation has, and which readings are the link's and the motor's; all else is numbers."""

    friction: FrictionSource | None = None
    reads: tuple[str, ...] = ()
    gravity: int = 0
    link: int = 0
    ripple: tuple[int, ...] = ()
    motor: int = 0

    @property
    def remembered(self) -> int:
        """How many numbers it keeps from one sample to the next."""
        return 0 if self.friction is None else 2

    @property
    def size(self) -> int:
        """How many numbers it takes."""
        return (0 if self.friction is None else 2) + self.gravity + (1 + 2 * len(self.ripple) if self.ripple else 0)


class _Floats:
    """The operations of `compensate` on floats; what is not a number stays so."""

    @staticmethod
    def fmin(a: float, b: float) -> float:
        return b if b < a else a

    @staticmethod
    def fmax(a: float, b: float) -> float:
        return b if b > a else a

    @staticmethod
    def floor(a: float) -> float:
        return float(math.floor(a)) if math.isfinite(a) else a


def compensate(
    shape: CompensationShape,
    numbers: Sequence[Any],
    memory: Sequence[Any],
    reference: Any,
    readings: Sequence[Any],
    operations: Any,
) -> tuple[Any, Any, list[Any]]:
    """Return the law's reference, added effort and next memory; `operations`: casadi for expressions, else numpy."""
    shaped, added, rubs = reference, 0.0, 0 if shape.friction is None else 2
    if shape.gravity:
        shaped = reference + _sum_series(numbers[rubs : rubs + shape.gravity], readings[shape.link], operations)
    if shape.ripple:
        added = sum_ripple(shape.ripple, numbers[rubs + shape.gravity :], readings[shape.motor], operations)
    if shape.friction is None:
        return shaped, added, []
    effort, share_per_step = numbers[:2]
    now = reference if shape.friction == "reference" else readings[0]
    share = memory[0] * share_per_step * (now - memory[1])
    return shaped, added + effort * _limit(share, operations), [1.0, now]


def _mix(first: Any, last: Any, share: float) -> Any:
    """Return a number, or each of some, a share of the way from the first to the last."""
    if isinstance(first, tuple):
        return tuple(_mix(a, b, share) for a, b in zip(first, last, strict=True))
    return (1.0 - share) * first + share * last


def _limit(value: Any, operations: Any) -> Any:
    return operations.fmax(operations.fmin(value, 1.0), -1.0)


def _sum_series(numbers: Sequence[Any], position: Any, operations: Any) -> Any:
    """Return a series of Chebyshev's polynomials, by Clenshaw's recurrence; constant beyond its range."""
    middle, scale, *coefficients = numbers
    scaled = _limit(scale * (position - middle), operations)
    last, before = 0.0 * scaled, 0.0 * scaled
    for coefficient in coefficients[:0:-1]:
        last, before = 2.0 * scaled * last - before + coefficient, last
    return scaled * last - before + coefficients[0]
