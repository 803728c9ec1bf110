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
    """Return the response from one input to every output of a linear model, and its derivatives.

    `model`: linear; see `seaopt.simulation.linearise`. `theta`: its free parameters. `clock`: period, hold and delay.
    `f`: frequencies in Hz. `source`: number of the input. Returned: with respect to theta, then to the delay where
    ``clock.delay_free``.
    """
    blocks = transition(model, theta, clock)
    nx, nu = model.nx, model.nu
    z = np.exp(2j * np.pi * f * clock.period)
    drives = np.zeros((len(blocks), z.size, nx + model.ny), dtype=complex)
    for i, lag in enumerate(clock.lags):
        drives += z[:, None] ** -float(lag) * blocks[:, None, :, nx + i * nu + source]
    inner = z[:, None, None] * np.eye(nx) - blocks[0, :nx, :nx]
    state = np.linalg.solve(inner, drives[0, :, :nx, None])[:, :, 0]
    c = blocks[0, nx:, :nx]
    observed = np.linalg.solve(inner.transpose(0, 2, 1), np.broadcast_to(c.T, (z.size, nx, model.ny)))
    slopes = [
        state @ block[nx:, :nx].T
        + drive[:, nx:]
        + np.einsum("mxy,mx->my", observed, state @ block[:nx, :nx].T + drive[:, :nx])
        for block, drive in zip(blocks[1:], drives[1:], strict=True)
    ]
    shape = (len(slopes), z.size, model.ny)
    return state @ c.T + drives[0, :, nx:], np.array(slopes, dtype=complex).reshape(shape)
