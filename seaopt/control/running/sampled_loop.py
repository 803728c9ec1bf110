"""A plant, the law that runs, and what stands between them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import field

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.bench import Sensors
from seaopt.control.laws.realisation import RunnableLaw
from seaopt.control.loops.sampled_plant import Measured, find_delay, read_conditions, whole_samples
from seaopt.control.running.law_step import LawShape, list_kept
from seaopt.control.scheduling.runnable_schedule import RunnableSchedule
from seaopt.errors import SimulationError, suggestion
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.equations.declaration import ENERGY
from seaopt.plants.friction import can_stick
from seaopt.plants.sensors.deflection import weigh_encoders
from seaopt.records import record
from seaopt.units import show_command


@record(eq=False)
class SampledLoop:
    """A plant, the law that runs, and the devices between them.

    Parameters
    ----------
    plant : Plant
        Its first input is what the law commands, the motor current as a rule.
    law : RunnableLaw or RunnableSchedule
        As exported.
    measured : str or tuple of str
        The output that is fed back, or the outputs that the law reads, the regulated one first.
    delay_samples : int
        Whole samples from measurement to output, besides the hold.
    sensors : Sensors
        Noise, offset, range and quantisation of the measured output, and of the encoders that it is computed from,
        whose noise is the output's.
    command_step : float
        What the command is rounded to, in its unit; 0 for not at all. The largest is the last whole step within the
        law's limit.
    longest_delay_s : float
        The longest delay among the conditions of any run's parameters (`find_longest_delay`): the drive's and what is
        besides `delay_samples`, of any length.
    sticks : bool
        Dry friction jumps at rest, so that what sticks stands still (`seaopt.simulation.sticking`), in place of the
        smoothed curve.
    link : str, optional
        Of what is measured the link's motion: a plant without that output holds this link, which stands still there.
    place : str, optional
        The scheduling variable of a schedule: a state of the plant, which the law is given as it is; else `run_loop`
        is told where it stands.

    Raises
    ------
    SimulationError
        The plant has no such output, or no friction that sticks, a number is out of range, or the loop is algebraic.
    """

    plant: Plant
    law: RunnableLaw | RunnableSchedule
    measured: Measured
    delay_samples: int
    sensors: Sensors = field(default_factory=Sensors)
    command_step: float = 0.0
    longest_delay_s: float = 0.0
    sticks: bool = False
    link: str | None = None
    place: str | None = None

    def __post_init__(self) -> None:
        plant = self.plant
        for name in self.signals:
            if name not in plant.outputs and name not in self.standing:
                raise SimulationError(
                    f'measured = "{name}" is not an output of {plant.name}; ' + suggestion(name, plant.outputs)
                )
        if len(self.fed_back) != self.law.measured:
            raise SimulationError(
                f"measured = {list(self.fed_back)} are {len(self.fed_back)} outputs, and the law reads "
                f"{self.law.measured}; give as many"
            )
        if self.sticks and not can_stick(plant):
            raise SimulationError(
                f"sticks = True, but {plant.name} has no friction that jumps at rest; give its Friction a jump"
            )
        for name in ("command_step", "longest_delay_s"):
            if not getattr(self, name) >= 0.0:
                raise SimulationError(f"{name} = {getattr(self, name):g} is negative; give zero or more")
        self.sensors.refuse_negative((*self.signals, *self.encoders), SimulationError)
        if self.command_step and not self.most:
            limit = show_command(self.law.command_limit, *self.law.command)
            raise SimulationError(
                f"command_step = {self.command_step:g} is above the limit of {limit}, so that every command but "
                "zero is; give the amplifier's step"
            )
        for name in self.signals if self.delay_samples == 0 else ():
            if name not in self.standing and ca.depends_on(plant.output[list(plant.outputs).index(name)], plant.u[0]):
                raise SimulationError(
                    f"{name} of {plant.name} contains the present command, which a law without delay sets from "
                    "it; give delay_samples = 1 or more, or measure another output"
                )

    @property
    def fed_back(self) -> tuple[str, ...]:
        """The outputs that the law feeds back, the regulated one first."""
        return (self.measured,) if isinstance(self.measured, str) else self.measured

    @property
    def signals(self) -> tuple[str, ...]:
        """The outputs that are read: what is fed back, and what the law's terms and its gate read besides."""
        return tuple(dict.fromkeys((*self.fed_back, *self.law.further)))

    @property
    def standing(self) -> tuple[str, ...]:
        """What is read of a link that the plant holds: what the law is fed, and by which gravity is compensated."""
        gravity = None if self.law.compensation is None else self.law.compensation.gravity
        weighed = None if gravity is None or self.plant.moves else gravity.reads
        gate = None if self.law.gate is None else self.law.gate.agreement
        encoders = () if gate is None or self.plant.moves else gate.reads
        position = None if self.law.outer is None or self.plant.moves else self.law.outer.position
        named = dict.fromkeys((self.link, weighed, *encoders, position))
        return tuple(name for name in named if name is not None and name not in self.plant.outputs)

    @property
    def law_states(self) -> int:
        """How many numbers the law keeps."""
        return LawShape.of_law(self.law).kept

    @property
    def regulated(self) -> str:
        """The first of them."""
        return self.signals[0]

    @property
    def encoders(self) -> tuple[str, ...]:
        """The encoders that the measured outputs are computed from and that have an offset, a range or a step."""
        erring = self.sensors.erring & self.plant.outputs.keys()
        signals = [name for name in self.signals if name not in self.standing]
        used = [name for signal in signals for name in weigh_encoders(self.plant, signal) if name in erring]
        return tuple(dict.fromkeys(used))

    @property
    def waiting(self) -> int:
        """Number of commands that are delayed, or act, behind the newest."""
        if not self.longest_delay_s:
            return self.delay_samples
        return self.delay_samples + whole_samples(self.longest_delay_s, self.law.sample_time_s)[0] + 1

    @property
    def most(self) -> float:
        """The largest current: the law's limit, or the last whole step of the amplifier within it."""
        return largest_command(self.law.command_limit, self.command_step)


def find_longest_delay(plant: Plant, params: Iterable[ParameterSet]) -> float:
    """Return the longest delay, s, among the conditions of several runs' parameters."""
    return max((float(find_delay(plant, read_conditions(plant, each))) for each in params), default=0.0)


def channel_names(plant: Plant) -> tuple[str, ...]:
    """Return the outputs, and the energy where the plant declares it."""
    return (*plant.outputs, *((ENERGY,) if plant.energy is not None else ()))


@record(eq=False)
class LoopState:
    """Where runs stand: states of the plant, and of the law with the commands that still wait."""

    x: Float[np.ndarray, "runs nx"]
    z: Float[np.ndarray, "runs nz"]


def at_rest(loop: SampledLoop, runs: int = 1, x: Float[np.ndarray, " nx"] | None = None) -> LoopState:
    """Return `runs` loops whose law was reset and whose plant is in state x, zero if left out."""
    start = np.zeros(len(loop.plant.states)) if x is None else x
    z = np.concatenate([list_kept(loop.law, loop.law.reset()), np.zeros(loop.waiting)])
    return LoopState(x=np.tile(start, (runs, 1)), z=np.tile(z, (runs, 1)))


def largest_command(limit: float, step: float) -> float:
    """Return the last whole step within a current limit; the limit itself without a step."""
    if not step or math.isinf(limit):
        return limit
    return step * math.floor(limit / step * (1.0 + 1e-12))
