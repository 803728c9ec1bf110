"""A sampled loop with its friction taken out, as a port from friction efforts to what they move.

The test of stability looks at it at all aliases of an angle (`seaopt.control.loops.absolute_stability`), describing
functions at the fundamental alone (`seaopt.control.laws.friction`).
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from jaxtyping import Complex, Float, Int

from seaopt.control.loops.drift import take_linear
from seaopt.control.loops.law import Law
from seaopt.control.loops.loop import Loop
from seaopt.control.loops.sampled_plant import (
    DigitalPlant,
    Measured,
    find_rest,
    find_rows,
    linearise_sets,
    sample_linear,
)
from seaopt.control.systems.resolvent import Resolvent
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import SLIDING, find_bristle_stiffness, friction_matrices, friction_slopes, friction_states
from seaopt.plants.memo import memo
from seaopt.records import record
from seaopt.signals import MatrixNN, VectorM, VectorN

FUNDAMENTAL = np.zeros(1, dtype=int)  # the order of the angle itself


@record(eq=False)
class FrictionLoop:
    r"""A sampled loop with its friction taken out: :math:`\dot x = A x + b u - B_f \varphi(v)`, v = C_v x, y = C x."""

    a: MatrixNN  # a, motor: the continuous plant without friction, and the effect of the motor effort u
    motor: VectorN
    friction: Float[np.ndarray, "n p"]  # the effect of each friction effort in the direction of its velocity
    # velocity, sensed: the velocities that friction acts on, and the outputs that the law reads, the regulated first
    velocity: Float[np.ndarray, "p n"]
    sensed: Float[np.ndarray, "y n"]
    through: Float[np.ndarray, "y p"]  # the effect of each friction effort on those outputs themselves
    slopes: Float[np.ndarray, " p"]  # the steepest slope of each friction curve, N s/m (N m s/rad)
    plant: DigitalPlant  # the same plant, sampled, from u to y, with its delay
    law: Law  # its C_y closes the loop
    delay_s: float = 0.0  # of the motor effort, besides the whole samples of `plant`
    linear: bool = True  # besides its friction the plant is linear, once links that turn are linearised at rest
    linearised: bool = False  # some link is
    remembers: bool = False  # some friction has bristles, and is no curve of its velocity

    @property
    def sampled(self) -> Loop:
        """The sampled loop without friction."""
        return Loop(plant=self.plant, law=self.law)

    @property
    def obstacle(self) -> str:
        """Why no test of absolute stability is for this loop, whatever its law; empty where one is."""
        if not self.linear:
            return "the plant is not linear besides its friction"
        if self.remembers:
            return "friction with bristles is no curve of its velocity"
        if np.any(self.through * self.slopes):  # a sampled jump has no bounded gain
            return "friction acts on the measured output itself"
        return ""

    @property
    def only_port(self) -> int | None:
        """The one friction that changes with its velocity; None where none or several do."""
        ports = np.flatnonzero(self.slopes)
        return int(ports[0]) if ports.size == 1 else None

    def respond(
        self, theta: VectorM, orders: Int[np.ndarray, " k"], seen: Float[np.ndarray, "y n"]
    ) -> FrictionResponse:
        """Return what friction efforts and motor commands do to some rows of the states, the loop open. `theta`:
        angles, 2 pi times frequency over sample rate. `orders`: which aliases: that of order k is theta + 2 pi k.
        """
        period = self.plant.sample_time_s
        s = 1j * (theta[:, None] + 2 * np.pi * orders) / period
        resolvent = Resolvent.of(self.a, np.column_stack([self.friction, self.motor]), seen)
        response = np.moveaxis(resolvent.respond(s.ravel()), -1, 0).reshape(*s.shape, len(seen), -1)
        # The hold over a period, (1 - exp(-sT))/(sT): the numerator is the same at all aliases.
        drive = (-np.expm1(-1j * theta) * np.exp(-1j * theta * self.plant.delay_samples))[:, None] / (s * period)
        if self.delay_s:
            drive = drive * np.exp(-s * self.delay_s)
        return FrictionResponse(by_friction=response[..., :-1], by_motor=response[..., -1] * drive[..., None])

    def feedback(self, theta: VectorM) -> Complex[np.ndarray, "y m"]:
        """Return K, the motor command per measured output that comes from elsewhere, with the loop closed."""
        f = theta / (2 * np.pi * self.plant.sample_time_s)
        return self.law.feedback_responses(f) * self.sampled.sensitivity(f)


@record(eq=False)
class FrictionResponse:
    """Rows of the states at m angles and k aliases."""

    by_friction: Complex[np.ndarray, "m k y p"]  # per unit of each friction effort, as it pushes
    by_motor: Complex[np.ndarray, "m k y"]  # per unit of the sampled motor command at the fundamental, delayed and held


def make_friction_loops(
    plant: Plant, sets: Sequence[ParameterSet], measured: Measured, per_effort: float, delay_samples: int, law: Law
) -> list[FrictionLoop | None]:
    """Return, per set of parameters with the same conditions, the sliding loop of `measured` (the regulated output
    first) with what friction has above its flattest slope taken out; None without friction. `per_effort`: the command
    for one unit of the law's effort. `delay_samples`: whole samples from measurement to output, besides the hold.
    """
    plant = take_linear(plant, measured)
    values = [plant.complete(params) for params in sets]
    spans = [np.subtract(*friction_slopes(plant, each)[::-1]) for each in values]
    remembers = [any(find_bristle_stiffness(plant, each)) for each in values]
    if not np.any(spans) and not any(remembers):
        return [None] * len(sets)
    sliding, rows = friction_states(plant)[SLIDING], find_rows(plant, measured)
    blocks, delays = linearise_sets(sliding, values, measured, per_effort)
    sampled = sample_linear(blocks, delays, law.sample_time_s, delay_samples)
    loops: list[FrictionLoop | None] = []
    for k, each in enumerate(values):
        if not np.any(spans[k]) and not remembers[k]:
            loops.append(None)
            continue
        x, u = find_rest(plant, each)
        on_states, on_outputs, velocity = (np.array(block) for block in friction_matrices(plant)(x, u, each.vector))
        linear, linearised = _check_linear(sliding, x, each.vector)
        loops.append(
            FrictionLoop(
                a=blocks[0][k],
                motor=blocks[1][k],
                friction=on_states,
                velocity=velocity,
                sensed=blocks[2][k],
                through=on_outputs[rows],
                slopes=spans[k],
                plant=sampled[k],
                law=law,
                delay_s=float(delays[k]),
                linear=linear,
                linearised=linearised,
                remembers=remembers[k],
            )
        )
    return loops


@memo
def _differentiate(plant: Plant) -> tuple[ca.SX, tuple[int, ...]]:
    """Return the equations' slopes by states and inputs, and which states are those of a link that turns."""
    angles = {port.coordinate: port.rate for port in plant.ports if plant.states.get(port.coordinate or "") == "rad"}
    turning = tuple(i for i, name in enumerate(plant.states) if name in angles or name in angles.values())
    return ca.jacobian(ca.vertcat(plant.dynamics, plant.output), ca.vertcat(plant.x, plant.u)), turning


def _check_linear(plant: Plant, at_rest: VectorN, values: Float[np.ndarray, " p"]) -> tuple[bool, bool]:
    """Tell whether a plant is linear once links that turn stay about their rest; and whether some link then does."""
    slopes, turning = _differentiate(plant)
    variables = ca.vertcat(plant.x, plant.u)
    if not ca.depends_on(slopes, variables):
        return True, False
    slopes = ca.substitute(slopes, plant.p, ca.DM(values))
    kept = [column for column in range(slopes.shape[1]) if column not in turning]
    turned = ca.vertcat(*(float(at_rest[i]) if i in turning else plant.x[i] for i in range(len(plant.states))))
    remaining = ca.substitute(slopes[:, kept], plant.x, turned)
    linear = not ca.depends_on(ca.vec(remaining), variables)
    return linear, linear and bool(ca.depends_on(ca.vec(slopes), variables))
