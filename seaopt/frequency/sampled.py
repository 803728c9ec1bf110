r"""The response from input samples to output samples of a linear plant, hold and delay included, and its derivatives.

With the sampled model :math:`x^+ = A x + B_a u_{k-l_a} + B_b u_{k-l_b} + ...` of
:mod:`seaopt.simulation.discretisation` and :math:`z = e^{2 \pi i f T}`,

.. math:: G = C (z - A)^{-1} B(z) + D(z), \qquad B(z) = B_a z^{-l_a} + B_b z^{-l_b} + ...

and likewise for D. This is what an H1 estimate of a log estimates; the continuous-time response lacks the hold's delay
of half a sample.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Complex, Float

from seaopt.simulation import Clock, Model, transition


def sampled_response(
    model: Model, theta: Float[np.ndarray, " np"], clock: Clock, f: Float[np.ndarray, " m"], source: int = 0
) -> tuple[Complex[np.ndarray, "m ny"], Complex[np.ndarray, "nd m ny"]]:
    """Return the response from one input to every output of a linear model, and its derivatives. `model`: linear; see
    `seaopt.simulation.linearise`. `theta`: its free parameters. `clock`: period, hold and delay. `f`: frequencies in
    Hz. `source`: number of the input. Returned: with respect to theta, then to the delay where ``clock.delay_free``.
    """
    outputs = sampled_signals(model, theta, clock, f, source)[:, :, model.nx :]
    return outputs[0], outputs[1:]


def sampled_signals(
    model: Model, theta: Float[np.ndarray, " np"], clock: Clock, f: Float[np.ndarray, " m"], source: int
) -> Complex[np.ndarray, "nd1 m nxy"]:
    """Return the responses of the states and then of the outputs; behind them, their derivatives."""
    blocks, nx = transition(model, theta, clock), model.nx
    z = np.exp(2j * np.pi * f * clock.period)
    drives = np.zeros((len(blocks), z.size, nx + model.ny), dtype=complex)
    for i, lag in enumerate(clock.lags):
        drives += z[:, None] ** -float(lag) * blocks[:, None, :, nx + i * model.nu + source]
    a, c = blocks[:, :nx, :nx].transpose(0, 2, 1), blocks[:, nx:, :nx].transpose(0, 2, 1)
    inner = z[:, None, None] * np.eye(nx) - blocks[0, :nx, :nx]
    state = np.linalg.solve(inner, drives[0, :, :nx, None])[:, :, 0]
    moved = np.linalg.solve(inner, (state @ a[1:] + drives[1:, :, :nx]).transpose(1, 2, 0)).transpose(2, 0, 1)
    states = np.concatenate([state[None], moved])
    outputs = states @ c[0] + drives[:, :, nx:]
    outputs[1:] += state @ c[1:]
    return np.concatenate([states, outputs], axis=2)
