"""A plant as a digital controller sees it: sampled through a zero-order hold, one input to one output, with delay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float

from seaopt.errors import ControlError, suggestion
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant, state_space
from seaopt.simulation.discretisation import expm_with_derivatives

StateSpace = tuple[Float[np.ndarray, "n n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"], float]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DigitalPlant:
    """x+ = a x + b u, y = c x + d u at a sample time, and whole samples of delay before u.

    Parameters
    ----------
    a, b, c, d
        Matrices, shapes (n, n), (n,), (n,) and a number.
    sample_time_s : float
        Seconds.
    delay_samples : int
        From measurement to output, besides the hold.
    static_gain : float
        y/u at 0 Hz, from the continuous plant; infinite where it has an integrator.

    """

    a: Float[np.ndarray, "n n"]
    b: Float[np.ndarray, " n"]
    c: Float[np.ndarray, " n"]
    d: float
    sample_time_s: float
    delay_samples: int
    static_gain: float

    @property
    def nyquist_hz(self) -> float:
        """Half the sample rate."""
        return 0.5 / self.sample_time_s

    def response(self, f: Float[np.ndarray, " m"]) -> Complex[np.ndarray, " m"]:
        """Return P(z) z^-delay at frequencies in Hz."""
        z = np.exp(2j * np.pi * f * self.sample_time_s)
        n = self.b.size
        inner = z[:, None, None] * np.eye(n) - self.a
        x = np.linalg.solve(inner, np.broadcast_to(self.b[:, None].astype(complex), (f.size, n, 1)))[:, :, 0]
        return (x @ self.c + self.d) * z**-self.delay_samples

    def delayed(self) -> StateSpace:
        """Return a state-space model that holds the delay as states."""
        k, n = self.delay_samples, self.b.size
        if k == 0:
            return self.a, self.b, self.c, self.d
        a = np.zeros((n + k, n + k))
        a[:n, :n], a[:n, n + k - 1] = self.a, self.b
        for i in range(1, k):
            a[n + i, n + i - 1] = 1.0
        b = np.zeros(n + k)
        b[n] = 1.0
        c = np.concatenate([self.c, np.zeros(k)])
        c[n + k - 1] = self.d
        return a, b, c, 0.0


def sample(
    plant: Plant, params: ParameterSet, measured: str, gain: float, sample_time_s: float, delay_samples: int
) -> DigitalPlant:
    """Return the digital plant from motor force to a measured force, linearised at rest.

    Parameters
    ----------
    plant, params
        The plant; its first input is the motor current.
    measured : str
        The output that is fed back.
    gain : float
        A/N: the current that the controller commands for a motor force.
    sample_time_s : float
        Seconds.
    delay_samples : int
        Whole samples of delay.

    Raises
    ------
    ControlError
        The plant has no such output.

    """
    if measured not in plant.outputs:
        raise ControlError(
            f'measured = "{measured}" is not an output of {plant.name}; {suggestion(measured, plant.outputs)}'
        )
    a, b, c, d = state_space(plant, params)
    row = list(plant.outputs).index(measured)
    b0, c0, d0 = gain * b[:, 0], c[row], gain * float(d[row, 0])
    n = a.shape[0]
    block = np.zeros((n + 1, n + 1))
    block[:n, :n], block[:n, n] = a, b0
    whole, _ = expm_with_derivatives(block * sample_time_s, np.zeros((0, n + 1, n + 1)))
    with np.errstate(divide="ignore", invalid="ignore"):
        try:
            static = float(d0 - c0 @ np.linalg.solve(a, b0)) if np.linalg.cond(a) < 1e14 else np.inf
        except np.linalg.LinAlgError:
            static = np.inf
    return DigitalPlant(
        a=whole[:n, :n], b=whole[:n, n], c=c0, d=d0, sample_time_s=sample_time_s, delay_samples=delay_samples,
        static_gain=static,
    )  # fmt: skip
