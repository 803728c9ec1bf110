"""The port at link 2 of an actuator whose link 1 is held, as responses (`seaopt.control.laws.passivity`)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control.loops.sampled_plant import DELAY, conditions_of
from seaopt.errors import ControlError, suggestion
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant, state_space
from seaopt.records import record

Frequencies = Float[np.ndarray, " m"]
Response = Complex[np.ndarray, " m"]
BESIDE = 1e-7  # of a pole: nearer, the response is evaluated this far beside it
NOT_AFFINE = 1e-6  # Delta of this share of its terms, and more, makes the condition quadratic in the gains


@record(eq=False)
class PortResponse:
    """G_11, G_12, G_21, G_22 of the module's docstring at some frequencies; `feedback` is the fed-back force."""

    motor_to_feedback: Response
    motion_to_feedback: Response
    motor_to_port: Response
    motion_to_port: Response

    @property
    def determinant(self) -> Response:
        """Delta."""
        return self.motor_to_feedback * self.motion_to_port - self.motion_to_feedback * self.motor_to_port

    def impedance(self, law: Response) -> Response:
        """Return Z under F_m = -law F."""
        return (self.motion_to_port + self.determinant * law) / (1.0 + self.motor_to_feedback * law)


@record(eq=False)
class Port:
    """A linearised plant whose link 2 is moved and whose link 1 is held.

    Parameters
    ----------
    a, motor, force
        x' = a x + motor F_m + force Fe2, shapes (n, n), (n,), (n,).
    feedback : array, shape (n + 2,)
        The fed-back force of x, F_m and Fe2.
    speed : int
        Which state is v_2.
    mass : float
        m_2, kg, which is taken off again.
    delay_s : float
        Of the motor, besides the controller's.

    """

    a: Float[np.ndarray, "n n"]
    motor: Float[np.ndarray, " n"]
    force: Float[np.ndarray, " n"]
    feedback: Float[np.ndarray, " n+2"]
    speed: int
    mass: float
    delay_s: float = 0.0

    def response(self, f: Frequencies) -> PortResponse:
        """Return the responses to motor force and to motion, Fe2 being what that motion takes.

        They are infinite at an undamped pole, though Z under feedback is not: there they are those just beside it.
        """
        n, s = self.motor.size, 2j * np.pi * self._beside(f)
        inner = np.zeros((f.size, n + 1, n + 1), dtype=complex)
        inner[:, :n, :n] = s[:, None, None] * np.eye(n) - self.a
        inner[:, :n, n] = -self.force
        inner[:, n, self.speed] = 1.0
        causes = np.zeros((n + 1, 2))
        causes[:n, 0], causes[n, 1] = self.motor, 1.0
        x = np.linalg.solve(inner, np.broadcast_to(causes.astype(complex), (f.size, n + 1, 2)))
        taken = x[:, n]
        read = np.einsum("i,mij->mj", self.feedback[:n], x[:, :n]) + self.feedback[n + 1] * taken
        read[:, 0] += self.feedback[n]
        late = np.exp(-s * self.delay_s)
        return PortResponse(
            motor_to_feedback=read[:, 0] * late,
            motion_to_feedback=read[:, 1],
            motor_to_port=taken[:, 0] * late,
            motion_to_port=taken[:, 1] - s * self.mass,
        )

    def modes_hz(self) -> tuple[Frequencies, Frequencies]:
        """Return frequency and half width of the poles with link 2 at rest."""
        poles = self._poles()
        return np.abs(np.imag(poles)) / (2 * np.pi), np.abs(np.real(poles)) / (2 * np.pi)

    def link_held(self) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, " k"], Float[np.ndarray, " k"], float]:
        """Return (a, b, c, d) from motor force to the fed-back one with link 2 at rest, what cannot move left out."""
        n, at = self.motor.size, self.force[self.speed]
        taken, pulled = -self.a[self.speed] / at, -self.motor[self.speed] / at  # Fe2 of x and of F_m
        a, b = self.a + np.outer(self.force, taken), self.motor + self.force * pulled
        c, d = self.feedback[:n] + self.feedback[n + 1] * taken, self.feedback[n] + self.feedback[n + 1] * pulled
        moving = np.arange(n) != self.speed
        while np.any(still := moving & ~np.any(a[:, moving], axis=1) & (b == 0.0)):
            moving &= ~still
        return a[np.ix_(moving, moving)], b[moving], c[moving], float(d)

    def _poles(self) -> Complex[np.ndarray, " n"]:
        """Return the poles with link 2 at rest."""
        moved = self.a - np.outer(self.force, self.a[self.speed]) / self.force[self.speed]
        return np.linalg.eigvals(moved).astype(complex)

    def _beside(self, f: Frequencies) -> Frequencies:
        out = f.copy()
        for pole in self._poles():
            near = np.abs(2j * np.pi * out - pole) < BESIDE * np.abs(pole)
            out[near] = abs(complex(pole).imag) * (1.0 + BESIDE) / (2 * np.pi)
        return out


def port_of(plant: Plant, params: ParameterSet, measured: str, current_per_force_A_per_N: float) -> Port:
    """Return a plant's port at link 2, driven by the current for a motor force.

    Raises
    ------
    ControlError
        The plant has no such port or output.

    """
    if plant.port is None:
        raise ControlError(f"plant {plant.name} has no port at link 2; use high_impedance, moving_output or two_link")
    port: Plant = plant.port()
    if measured not in port.outputs:
        raise ControlError(
            f'measured = "{measured}" is not an output of {port.name}; {suggestion(measured, port.outputs)}'
        )
    a, b, c, d = state_space(port, params)
    motor, external = (list(port.inputs).index(name) for name in ("I", "Fe2"))
    row = list(port.outputs).index(measured)
    return Port(
        a=a,
        motor=current_per_force_A_per_N * b[:, motor],
        force=b[:, external].copy(),
        feedback=np.concatenate([c[row], [current_per_force_A_per_N * d[row, motor], d[row, external]]]),
        speed=list(port.states).index("v_2"),
        mass=port.complete(params)["m_2"].value,
        delay_s=conditions_of(plant, params).get(DELAY, 0.0),
    )


def held(f: Frequencies, sample_time_s: float, delay_samples: int) -> Response:
    """Return the response of a delay and a zero-order hold."""
    return np.sinc(f * sample_time_s) * np.exp(-2j * np.pi * f * sample_time_s * (0.5 + delay_samples))


def sight(port: Port, sample_time_s: float, delay_samples: int, f: Frequencies) -> tuple[Response, Response]:
    """Return G_11 with delay and hold, and G_22/abs(G_22), with which passivity is affine in the gains.

    Raises
    ------
    ControlError
        The measured force does not tell the force at the port.

    """
    response = port.response(f)
    g11, g22 = response.motor_to_feedback, response.motion_to_port
    size = np.abs(g11 * g22) + np.abs(response.motion_to_feedback * response.motor_to_port)
    if np.any(np.abs(response.determinant) > NOT_AFFINE * size):
        raise ControlError(
            "the force at the port does not follow from the measured one alone (an elastic screw between them), so "
            "that passivity is not affine in the gains; leave the constraint out and read the band that is reported"
        )
    return g11 * held(f, sample_time_s, delay_samples), g22 / np.abs(g22)
