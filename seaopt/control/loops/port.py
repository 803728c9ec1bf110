"""The port of an actuator whose other links are held, as responses (`seaopt.control.laws.passivity`)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control.loops.sampled_plant import (
    DigitalPlant,
    Measured,
    find_delay,
    find_rows,
    read_conditions,
    sample_matrices,
)
from seaopt.control.loops.transfer_function import Frequencies, Response
from seaopt.control.systems.resolvent import Resolvent
from seaopt.errors import ControlError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant, state_space
from seaopt.plants.friction import leave_out_waves
from seaopt.plants.memo import memo
from seaopt.plants.motor.thermal import freeze_heat
from seaopt.plants.plant import share_drive
from seaopt.records import record
from seaopt.signals import ComplexN, MatrixNN, VectorN
from seaopt.units import LINEAR

BESIDE = 1e-7  # of a pole: nearer, the response is evaluated this far beside it
NOT_AFFINE = 1e-6  # Delta of this share of its terms, and more, makes the condition quadratic in the gains


@record(eq=False)
class PortResponse:
    """G_11, G_12, G_21, G_22 of the module's docstring at some frequencies; what is fed back has a row each."""

    motor_to_read: Complex[np.ndarray, "y m"]
    motion_to_read: Complex[np.ndarray, "y m"]
    motor_to_port: Response
    motion_to_port: Response

    @property
    def determinant(self) -> Complex[np.ndarray, "y m"]:
        """Delta, of every fed-back signal."""
        return self.motor_to_read * self.motion_to_port - self.motion_to_read * self.motor_to_port

    def impedance(self, law: Complex[np.ndarray, "... m"]) -> Response:
        """Return Z under F_m = - sum of law_i y_i; of one signal the law may be a vector."""
        law = np.atleast_2d(law)
        return (self.motion_to_port + np.sum(self.determinant * law, axis=0)) / (
            1.0 + np.sum(self.motor_to_read * law, axis=0)
        )


@record(eq=False)
class PortModel:
    """A linearised plant whose port is moved, its other links held."""

    a: MatrixNN  # a, motor, force: x' = a x + motor F_m + force F_e, shapes (n, n), (n,), (n,)
    motor: VectorN
    force: VectorN
    read: Float[np.ndarray, "y n+2"]  # every signal that the law reads, the regulated force first, of x, F_m and F_e
    speed: int  # speed, position: which states are the port's speed and its position
    position: int
    mass: float  # the inertia on the port (kg or kg m^2), which is taken off again
    delay_s: float = 0.0  # of the motor, besides the controller's
    place_unit: str = LINEAR.position  # of the port's motion: m or rad

    def response(self, f: Frequencies) -> PortResponse:
        """Return the responses to motor force and to motion, F_e being what that motion takes. They are infinite at an
        undamped pole, though Z under feedback is not: there they are those just beside it.
        """
        s, at = 2j * np.pi * self._beside(f), self.force[self.speed]
        # The speed is v, the position v/s, and F_e is what moves them: s v = a x + b F_m + at F_e in the speed's row.
        taken, pushed = -self.a[self.speed] / at, -self.motor[self.speed] / at
        a, b, c, d = self.load(taken, pushed)
        rows, direct, of_force = np.vstack([c, taken]), np.append(d, pushed), np.append(self.read[:, -1], 1.0)[:, None]
        causes = np.column_stack([b, a[:, self.speed], a[:, self.position], self.force / at])
        inside = ~np.isin(np.arange(b.size), [self.speed, self.position])
        answers = Resolvent.of(a[inside][:, inside], causes[inside], rows[:, inside]).respond(s)
        driven = answers[:, 0] + direct[:, None]
        moved = answers[:, 1] + rows[:, [self.speed]] + (answers[:, 2] + rows[:, [self.position]]) / s
        moved += answers[:, 3] * s + of_force * (s / at)
        late = np.exp(-s * self.delay_s)
        return PortResponse(
            motor_to_read=driven[:-1] * late,
            motion_to_read=moved[:-1],
            motor_to_port=driven[-1] * late,
            motion_to_port=moved[-1] - s * self.mass,
        )

    def load(
        self, taken: VectorN, pushed: float
    ) -> tuple[MatrixNN, VectorN, Float[np.ndarray, "y n"], Float[np.ndarray, " y"]]:
        """Return the plant from motor force to what is read, its port loaded: F_e = taken x + pushed F_m."""
        n, of_force = self.motor.size, self.read[:, -1]
        a, b = self.a + np.outer(self.force, taken), self.motor + self.force * pushed
        return a, b, self.read[:, :n] + np.outer(of_force, taken), self.read[:, n] + of_force * pushed

    def hold_link(self, sample_time_s: float, delay_samples: int) -> DigitalPlant:
        """Return the sampled plant from motor force to what is fed back with link 2 at rest."""
        at = self.force[self.speed]
        a, b, c, d = self.load(-self.a[self.speed] / at, -self.motor[self.speed] / at)
        moving = np.arange(b.size) != self.speed  # states that cannot move are left out
        while np.any(still := moving & ~np.any(a[:, moving], axis=1) & (b == 0.0)):
            moving &= ~still
        linear = a[moving][:, moving], b[moving], c[:, moving], d
        return sample_matrices(linear, self.delay_s, sample_time_s, delay_samples)

    def find_poles(self) -> ComplexN:
        """Return the poles with link 2 at rest (rad/s)."""
        moved = self.load(-self.a[self.speed] / self.force[self.speed], 0.0)[0]
        return np.linalg.eigvals(moved).astype(complex)

    def _beside(self, f: Frequencies) -> Frequencies:
        out = f.copy()
        for pole in self.find_poles():
            near = np.abs(2j * np.pi * out - pole) < BESIDE * np.abs(pole)
            out[near] = abs(pole.imag) * (1.0 + BESIDE) / (2 * np.pi)
        return out


@memo
def probe_of(plant: Plant) -> Plant:
    """Return the plant that shows what the port is to the world: a bare inertia on it, the other links held. It is
    without heat, as all that looks at linear loops. Raises ControlError: the plant states no port, or its port states
    no probe.
    """
    if plant.port is None or plant.port.probe is None:
        missing = "has no port at link 2" if plant.port is None else "has a port that states no probe"
        raise ControlError(
            f"plant {plant.name} {missing}; use high_impedance, moving_output, "
            "two_link or rotary, or give ports = (Port(..., probe=...),)"
        )
    return share_drive(freeze_heat(leave_out_waves(plant.port.probe())), plant)


def port_of(plant: Plant, params: ParameterSet, measured: Measured, per_effort: float) -> PortModel:
    """Return a plant's port, driven by the command for an effort. Raises ControlError: no such port or output."""
    probe = probe_of(plant)
    values, rows = probe.complete(params), find_rows(probe, measured)
    effort, coordinate, rate, inertia = bare_port(probe)
    a, b, c, d = state_space(probe, values)
    external, states = list(probe.inputs).index(effort), list(probe.states)
    return PortModel(
        a=a,
        motor=per_effort * b[:, 0],
        force=b[:, external].copy(),
        read=np.column_stack([c[rows], per_effort * d[rows, 0], d[rows, external]]),
        speed=states.index(rate),
        position=states.index(coordinate),
        mass=values[inertia].value,
        delay_s=float(find_delay(plant, read_conditions(plant, params))),
        place_unit=probe.states[coordinate],
    )


def bare_port(probe: Plant) -> tuple[str, str, str, str]:
    """Return the names of a probe's port: the world's effort, the link's coordinate and rate, and its inertia. Raises
    ControlError: the probe does not state them.
    """
    port = probe.port
    if port is None or not (port.effort and port.coordinate and port.rate) or len(port.payload) != 1:
        raise ControlError(
            f"the probe {probe.name} does not say what its port is; give it ports = (Port(effort, coordinate, rate, "
            "motion, payload),), the payload being one inertia"
        )
    return port.effort, port.coordinate, port.rate, port.payload[0]


def hold_response(f: Frequencies, sample_time_s: float, delay_samples: int) -> Response:
    """Return the response of a delay and a zero-order hold."""
    return np.sinc(f * sample_time_s) * np.exp(-2j * np.pi * f * sample_time_s * (0.5 + delay_samples))


@record(eq=False)
class PassivityCondition:
    r"""Re Z >= 0 as a condition on the feedback C, one row per signal: Re[unit (1 + forces C) conj(1 + loops C)] >= 0.
    :math:`Z/|G_{22}|` is that over :math:`|1 + \text{loops}\,C|^2`.
    """

    unit: Response  # shape (m,); :math:`G_{22}/|G_{22}|`
    # loops, forces: :math:`G_{11}` and :math:`\Delta/G_{22}` with delay and hold, of every signal; `forces` is zero
    # where what is measured tells the force at the port, and the condition is then affine in C
    loops: Complex[np.ndarray, "y m"]
    forces: Complex[np.ndarray, "y m"]


def weigh_passivity(port: PortModel, sample_time_s: float, delay_samples: int, f: Frequencies) -> PassivityCondition:
    """Return what passivity asks of the feedback at frequencies."""
    response, late = port.response(f), hold_response(f, sample_time_s, delay_samples)
    loops, moved, delta = response.motor_to_read, response.motion_to_port, response.determinant
    size = np.abs(loops * moved) + np.abs(response.motion_to_read * response.motor_to_port)
    delta = np.where(np.abs(delta) > NOT_AFFINE * size, delta, 0.0)
    return PassivityCondition(unit=moved / np.abs(moved), loops=loops * late, forces=delta * late / moved)
