r"""The outer loop of an impedance: stiffness and damping at the link, as a reference for the force loop.

.. math:: F_\mathrm{ref} = \sigma \left( K_v (x_0 - x) - D_v D(q) x \right), \qquad
          D(q) = \frac{1}{T_v + T_s}\, \frac{1 - q}{1 - q\, T_v/(T_v + T_s)}, \qquad q = z^{-1}

x is the link's position as sampled, m or rad, and D(q) its filtered backward difference, as in
`seaopt.control.laws.structures`. :math:`\sigma` is the measured effort per effort on the link, so that a positive
:math:`K_v` pulls the link to :math:`x_0`: 1 for a rotary actuator, -1 for a linear one, whose link 2 feels -F.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float

from seaopt.codec import Constraints
from seaopt.control.systems.block import Block
from seaopt.errors import ControlError
from seaopt.options import check_options, option
from seaopt.records import record
from seaopt.signals import ComplexM, VectorM
from seaopt.units import mechanics_of

POSITION, SPEED = "position", "speed"  # of the link
OuterState = tuple[Any, Any, Any]  # the filter's, whether there was a sample before, and the last reference
FIRST: OuterState = (0.0, 0.0, 0.0)


@record
class Impedance:
    """A stiffness and a damping to be rendered at the link.

    Raises
    ------
    ControlError
        A number is not finite, or the stiffness or the filter is negative.

    Examples
    --------
    >>> Impedance(stiffness=50.0, damping=2.0).stiffness
    50.0
    """

    stiffness: float = option("K_v, N/m or N m/rad.", least=0.0)
    damping: float = option("D_v, N s/m or N m s/rad; below zero it takes damping away.")
    velocity_filter_s: float | None = option(
        "Time constant T_v of the speed that is computed from the position; one sample where left out.",
        default=None,
        unit="s",
        least=0.0,
    )

    def __post_init__(self) -> None:
        check_options(self, ControlError)

    def filter_for(self, sample_time_s: float) -> float:
        """Return T_v at a sample time."""
        return sample_time_s if self.velocity_filter_s is None else self.velocity_filter_s


@record
class OuterLoop:
    """The outer loop as it runs, once a sample, before the force law.

    Parameters
    ----------
    stiffness, damping : float
        K_v and D_v.
    velocity_filter_s : float
        T_v.
    direction : float
        The measured effort per effort on the link.
    sample_time_s : float
        Seconds.
    place_unit : str
        Of the position: m or rad.
    plant : str
        The name of the plant whose link it is, where it has one.
    position : str
        The output that is read for x.

    Examples
    --------
    >>> outer = OuterLoop(
    ...     stiffness=10.0, damping=1.0, velocity_filter_s=0.0, direction=1.0, sample_time_s=0.1, place_unit="rad"
    ... )
    >>> reference, state = outer.step(outer.reset(0.0), 1.0, 0.2)
    >>> reference  # 10 (1 - 0.2) - (0.2 - 0)/0.1
    6.0
    """

    stiffness: Annotated[float, Constraints(ge=0.0)]
    damping: float
    velocity_filter_s: Annotated[float, Constraints(ge=0.0)]
    direction: float
    sample_time_s: Annotated[float, Constraints(gt=0.0)]
    place_unit: Annotated[str, Constraints(pattern="^(m|rad)$")]
    plant: str = ""
    position: str = ""

    @property
    def impedance(self) -> Impedance:
        """The impedance that it renders."""
        return Impedance(stiffness=self.stiffness, damping=self.damping, velocity_filter_s=self.velocity_filter_s)

    def describe(self) -> str:
        """Return what it renders, in words."""
        called = mechanics_of(self.place_unit)
        return (
            f"renders {self.stiffness:.4g} {called.stiffness} and {self.damping:.4g} {called.damping} at the link, the "
            f"speed filtered with {1e3 * self.velocity_filter_s:.3g} ms"
        )

    @property
    def pole(self) -> float:
        """The share of the filtered speed that stays from one sample to the next."""
        return self.velocity_filter_s / (self.velocity_filter_s + self.sample_time_s)

    @property
    def rate(self) -> float:
        """The filtered speed that a step of the position adds, 1/s."""
        return 1.0 / (self.velocity_filter_s + self.sample_time_s)

    def reset(self, position: float) -> float:
        """Return the state of a link at rest: what is taken off the next difference."""
        return -self.rate * position

    def step(self, state: float, reference: float, position: float) -> tuple[float, float]:
        """Return the force law's reference of this sample, and the next state.

        Parameters
        ----------
        state : float
            Of `reset`, or of the last step.
        reference, position : float
            x_0 and x, m or rad.
        """
        after, _, force = follow_link(self.numbers, (state, 1.0, 0.0), reference, position)
        return force, after

    @property
    def per_given(self) -> float:
        """The force that it asks for by a unit of what it is given: of x_0, or without a stiffness of a force."""
        return self.direction * self.stiffness or 1.0

    def split(self, reference: Any) -> tuple[Any, Any]:
        """Return x_0, and the force that is asked for besides, of what the law that runs is given. Without a stiffness
        no x_0 does anything, and what is given is that force.
        """
        return (reference, 0.0) if self.stiffness else (0.0, reference)

    @property
    def numbers(self) -> list[float]:
        """Its numbers, as `follow_link` takes them."""
        return [self.direction * self.stiffness, self.direction * self.damping, self.pole, self.rate]

    def ask(self, references: Any, positions: Any) -> Float[np.ndarray, "... n"]:
        """Return the references of the force law that runs, over samples as `run`, of what that law is given."""
        position, force = self.split(references)
        return self.run(position, positions) + force

    def run(self, references: Any, positions: Any) -> Float[np.ndarray, "... n"]:
        """Return the force law's references over samples, from rest at the first position."""
        from scipy.signal import lfilter  # deferred: scipy.signal brings scipy.stats, which takes half a second

        speed = np.asarray(lfilter([self.rate, -self.rate], [1.0, -self.pole], positions - positions[..., :1]))
        return self.direction * (self.stiffness * (references - positions) - self.damping * speed)

    def filter_speed(self, position: str = POSITION, kept: float = 1.0) -> Block:
        """Return the filtered speed of a position, of which a share is taken off the next."""
        unit = np.ones((1, 1))
        a, b, d = self.pole * unit, self.rate * (self.pole - kept) * unit, self.rate * unit
        return Block(a=a, b=b, c=unit, d=d, inputs=(position,), outputs=(SPEED,))

    def difference(self, z: ComplexM) -> ComplexM:
        """Return D at points of the z plane."""
        return self.rate * (z - 1.0) / (z - self.pole)

    def difference_slope(self, z: VectorM) -> VectorM:
        """Return dD/dz."""
        return self.rate * (1.0 - self.pole) / (z - self.pole) ** 2


def follow_link(numbers: Sequence[Any], kept: Sequence[Any], reference: Any, position: Any) -> OuterState:
    """Return what an outer loop keeps after a sample, the force law's reference last; of floats, or of expressions."""
    (stiffness, damping, pole, rate), (state, before, _) = numbers, kept
    speed = before * (state + rate * position)  # at first the link is at rest
    return pole * speed - rate * position, 1.0, stiffness * (reference - position) - damping * speed
