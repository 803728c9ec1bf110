"""Roles of the parts of a plant: what a controller commands, what is measured, where the world touches it.

A plant states its roles when it is made, so that tuning, certificates and simulation never guess them from names.
Expressions of a role are functions of the plant's namespaces, as `f` and `h` are; names are those of its own states,
inputs, outputs and parameters, whose units the plant knows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import field, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.options import option
from seaopt.records import record
from seaopt.units import mechanics_of

Expression = Callable[[Any], Any]  # of the parameters p
StateExpression = Callable[[Any, Any], Any]  # of the states x and the parameters p
PlantMaker = Callable[[], Any]  # makes another plant; untyped, for the plant's module imports this one


def _one(p: Any) -> float:
    return 1.0


@record(eq=False)
class Actuation:
    """The input that a controller commands, and the effort that it makes."""

    input: str = option("The input that a controller commands, the first of the plant's.")
    effort: Expression = option("Force or torque at the spring that one unit of it makes, in terms of the parameters.")
    unit: str = option("Of the effort: N, or N m.", default="N")
    efficiency: str | None = option(
        "Parameter that is the transmission's efficiency, which scales the effort.", default=None
    )
    speed: StateExpression | None = option(
        "Speed on which the effort works, in terms of states and parameters: effort times speed is the power that the "
        "motor makes, which gives the back-EMF.",
        default=None,
    )
    largest: Expression | None = option(
        "End of the command's range, 1 for a duty: more of it changes nothing.", default=None
    )


@record
class Sensing:
    """Regulated and sensed signals: names of outputs, or of states."""

    regulated: tuple[str, ...] = option(
        "Forces or torques at the spring or behind it that may be controlled, the first as a rule; load cells read "
        "them.",
        default=(),
    )
    motor_position: str | None = option("Output or state that an encoder on the motor reads.", default=None)
    motor_speed: str | None = option("The same of its speed.", default=None)
    link_position: str | None = option("Output or state that an encoder on the link reads.", default=None)
    from_encoders: tuple[str, ...] = option(
        "Outputs that a device computes from these two positions, with their errors.", default=()
    )
    # By output, a function of p: how much it moves with each encoder, where that is not its slope: behind a filter.
    weights: Mapping[str, Callable[[Any], Mapping[str, Any]]] = field(
        default_factory=dict[str, Callable[[Any], Mapping[str, Any]]], repr=False
    )
    still: tuple[str, ...] = option("Outputs that stay at zero, as the motion of a link does that is held.", default=())


@record
class Reading:
    """A state whose place an estimation may give to what a sensor on it has read: the wave that is in f passes many
    crests, which a simulated state that is off by one of them would take for one another. A motor that moves over many
    crests has no slope of it on average; one that rests may have any up to the steepest.
    """

    state: str
    wave: str  # parameter: the phase (rad) that one unit of the state makes
    sizes: tuple[str, ...]  # parameters: of its sine and its cosine
    friction: str  # the force that it adds to


@record(eq=False)
class SeriesSpring:
    """The elastic element."""

    deflection: StateExpression = option("How far it is deflected, in terms of states and parameters.")
    unit: str = option("Of the deflection: m or rad.")
    stiffness: str | None = option("Parameter that is its stiffness, where one is.", default=None)
    pull: StateExpression | None = option(
        "What it pulls with, in terms of states and parameters; stiffness times deflection if left out.", default=None
    )
    mass: str | None = option(
        "Derived figure: what swings on the spring, which (16) of Orekhov et al. 2015 reads from a second-order "
        "response with k known.",
        default=None,
    )
    damping: str | None = option("Derived figure: its damping, read likewise.", default=None)
    damper: str | None = option("Parameter that damps it, where one does.", default=None)
    play: str | None = option(
        "Parameter that is its play, where it has some; a fit that looks for it starts more than once.", default=None
    )


@record(eq=False)
class Bristles:
    r"""Bristles, which give before a friction slides, so that at rest it is a spring: a friction that remembers.

    The bristles' deflection z is a state of the plant, whose rate stands in `f`, and the force is
    :math:`\sigma_0 z + \sigma_1 \dot z`. While they hold, z follows the coordinate whose rate the velocity is.
    """

    state: str  # the deflection z, the plant's own
    coordinate: StateExpression  # what z follows
    # stiffness, damping: sigma_0 and sigma_1
    stiffness: Expression
    damping: Expression
    rate: Callable[[Any, Any, Any], Any]  # dz/dt, the velocity until they slip


@record(eq=False)
class Friction:
    """A dissipative force of one velocity, opposite to it; what grows in proportion to the velocity may stay in `f`.

    In `f` and `h` the force stands among the inputs under the friction's name, ``u.NAME``.

    Examples
    --------
    A gear that rubs by a tenth of the torque that the motor gives it:

    >>> rub = Friction(
    ...     velocity=lambda x, p: x.omega, unit="N m",
    ...     force=lambda v, p: (p.f_c + 0.1 * abs(p.load)) * v / abs(v),
    ...     loads=lambda x, u, p: {"load": p.K_tau * u.I}, rated={"load": 2.0},
    ... )
    >>> p, x = SimpleNamespace(f_c=1.0, K_tau=0.5), SimpleNamespace(omega=3.0)
    >>> rub.force_at(x, SimpleNamespace(I=4.0), p)
    1.2
    """

    velocity: StateExpression = option("The velocity that it opposes, in terms of states and parameters.")
    force: Callable[[Any, Any], Any] = option(
        "The force, in terms of v, the velocity, and the parameters: a curve, positive where the velocity is."
    )
    unit: str = option("Of the force: N, or N m.", default="N")
    effort: Expression = option("Effort at the spring that one unit of the force takes.", default=_one)
    slopes: Callable[[Any], tuple[Any, Any]] | None = option(
        "Flattest and steepest slope of the curve over all velocities, negative where it falls; sampled if left out.",
        default=None,
    )
    jump: Callable[[Any, Any], Any] | None = option(
        "The curve without its smoothing, for speeds from zero up: what it is at zero is what holds the joint at rest. "
        "A simulation in which the joint sticks takes it in the curve's place; a friction without one is its curve.",
        default=None,
    )
    smoothing: str | None = option(
        "Parameter that is the speed over which the curve is smoothed through zero. As it falls the force tends to a "
        "jump at rest, and a fit lets it fall by stages.",
        default=None,
    )
    loads: Callable[[Any, Any, Any], Mapping[str, Any]] | None = option(
        "What it grows with, by name, such as the torque that a gear transmits, in terms of states, inputs and "
        "parameters: the other formulas find it among the parameters.",
        default=None,
    )
    rated: Mapping[str, float] = option(
        "The largest size of each load, with which linear analysis, which knows none, takes the friction.",
        default_factory=dict[str, float],
    )
    bristles: Bristles | None = option(
        "What gives before it slides: `force` is then the curve of steady sliding, and the force that of the bristles.",
        default=None,
    )

    def force_at(self, x: Any, u: Any, p: Any) -> Any:
        """Return the force of a state, inputs and parameters."""
        if self.bristles is None:
            return self.force(self.velocity(x, p), self.add_loads(x, u, p))
        spring = self.bristles.stiffness(p) * getattr(x, self.bristles.state)
        return spring + self.bristles.damping(p) * self.find_rate(x, u, p)

    def find_rate(self, x: Any, u: Any, p: Any) -> Any:
        """Return the rate of the bristles' deflection."""
        assert self.bristles is not None
        return self.bristles.rate(getattr(x, self.bristles.state), self.velocity(x, p), self.add_loads(x, u, p))

    def add_loads(self, x: Any, u: Any, p: Any) -> Any:
        """Return the parameters, and the loads of a state and inputs among them."""
        return p if self.loads is None else with_values(p, self.loads(x, u, p))

    def add_rated(self, p: Any) -> Any:
        """Return the parameters, and the rated loads among them."""
        return with_values(p, self.rated) if self.rated else p

    @property
    def jumps(self) -> bool:
        """Whether a simulation can take it as a jump at rest: bristles are simulated as they are."""
        return self.jump is not None and self.bristles is None

    @property
    def slope_unit(self) -> str:
        """The unit of the curve's slope: N s/m, or N m s/rad of a torque."""
        return mechanics_of(self.unit).damping


def put_behind(frictions: Mapping[str, Friction], find_inputs: Callable[[Any, Any, Any], Any]) -> dict[str, Friction]:
    """Return the frictions of a plant whose own inputs follow from others, by (x, u, p): their loads see its own."""
    still = dict.fromkeys(frictions, 0.0)  # loads do not depend on friction

    def put(friction: Friction) -> Friction:
        loads = friction.loads
        if loads is None:
            return friction
        return replace(friction, loads=lambda x, u, p: loads(x, find_inputs(x, with_values(u, still), p), p))

    return {name: put(friction) for name, friction in frictions.items()}


@record(eq=False)
class Port:
    """Where the world touches an actuator: at one of its links, which moves or is held."""

    motion: str | None = option(
        "Output that is the port's position; left out where the plant has it held.", default=None
    )
    coordinate: str | None = option(
        "State of the link alone, which the plant with the port held has not.", default=None
    )
    rate: str | None = option("State: the rate of that.", default=None)
    effort: str | None = option(
        "Input: the world's force or torque along the motion, where there is one.", default=None
    )
    payload: tuple[str, ...] = option("Parameters that grow when the link carries more.", default=())
    drive: str | None = option("State of the motor that the spring adds to the motion.", default=None)
    ratio: Expression = option(
        "By how much: with the port held at y, the held plant counts that state from -ratio y.", default=_one
    )
    held: PlantMaker | None = option("The same actuator with this port held.", default=None)
    probe: PlantMaker | None = option(
        "The same actuator with its other links held and a bare inertia on this one, for the impedance there: its "
        "first port has motion and coordinate in one, the effort, and the inertia as its payload.",
        default=None,
    )


def change_ports(ports: Iterable[Port], change: Callable[..., Any], *arguments: Any) -> tuple[Port, ...]:
    """Return ports whose makers make what `change`, which pickles by its name, makes of their plants."""

    def remake(make: PlantMaker | None) -> PlantMaker | None:
        return None if make is None else partial(_make_changed, make, change, arguments)

    return tuple(replace(port, held=remake(port.held), probe=remake(port.probe)) for port in ports)


def _make_changed(make: PlantMaker, change: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    return change(make(), *arguments)


def with_values(space: Any, values: Mapping[str, Any]) -> SimpleNamespace:
    """Return a namespace with other values, or further ones."""
    return SimpleNamespace(**{**vars(space), **values})


@record(eq=False)
class Winding:
    """The motor's winding, where it warms up: `seaopt.plants.motor.thermal`.

    Parameters
    ----------
    rises : (str, str)
        The states that are the temperatures of winding and case above the ambient's, K.
    temperatures : (str, str)
        The outputs that are their temperatures, degC.
    effort : callable ``p -> expression``
        The effort at the spring that an ampere makes.
    unit : str
        Of the effort.
    """

    rises: tuple[str, str]
    temperatures: tuple[str, str]
    effort: Expression
    unit: str


@record(eq=False)
class Recipe:
    """How a plant is made: its parts, and what makes it with others, ``parts -> Plant``."""

    parts: tuple[str, ...]
    make: Callable[[tuple[Any, ...]], Any]  # of names of parts, which `check_parts` has checked


@record(eq=False)
class Sampling:
    """States that stand still between samples, and are set at each: memories of a device that samples."""

    period_s: float | None = None  # between samples, the only one that such a plant is simulated with; None: any
    # what each becomes after a sample: a combination of states as they were at the sample
    sets: Mapping[str, Mapping[str, float]] = field(default_factory=dict[str, Mapping[str, float]])
    differences: Mapping[str, Any] = field(default_factory=dict[str, Any])  # the speeds that these memories are for
    # states that a device reads, by the states that have what it read: anew at each sample at which the input that is
    # `kept_by` is zero, before it acts
    reads: Mapping[str, str] = field(default_factory=dict[str, str])
    kept_by: str = ""

    def matrix(self, states: Sequence[str]) -> tuple[list[int], Float[np.ndarray, "m nx"]]:
        """Return which states are set, and their combinations of all."""
        rows = [list(states).index(name) for name in self.sets]
        weights = [[weights.get(name, 0.0) for name in states] for weights in self.sets.values()]
        return rows, np.array(weights).reshape(len(rows), len(states))


@record
class Mode:
    """A mode whose frequency one parameter sets, so that an uncertainty may be given as a range of that frequency."""

    name: str = option("Name of the frequency in ranges, ending in _hz.")
    parameter: str = option("Parameter that sets it; more of it lowers the frequency.")
    state: str = option("State that moves most in it.")
