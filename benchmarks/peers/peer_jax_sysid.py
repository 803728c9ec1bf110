"""jax-sysid: its discrete-time `Model` of one RK4 sample, L-BFGS-B on reverse-mode gradients, no regularisation."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import simulate_jax
from jax_sysid.models import Model
from problem import LOWER, NOISE_N, SCALE, START, UPPER, Answer, Data, K, Settings, report

PARAMETERS, STATE = SCALE[:5], SCALE[5:]


def model(substeps: int) -> Model:
    """Return the plant with states in units of SCALE; the output is the force over the noise."""

    def after(x: jax.Array, u: jax.Array, params: list[jax.Array]) -> jax.Array:
        z = [params[0][j] * PARAMETERS[j] for j in range(4)]
        position, speed = simulate_jax.advance(x[0] * STATE[0], x[1] * STATE[1], u[0], z, substeps)
        return jnp.stack([position / STATE[0], speed / STATE[1]])

    def output(x: jax.Array, u: jax.Array, params: list[jax.Array]) -> jax.Array:
        return jnp.reshape((K * x[0] * STATE[0] + params[0][4] * PARAMETERS[4]) / NOISE_N, 1)

    return Model(2, 1, 1, state_fcn=after, output_fcn=output)


def prepare(data: Data, settings: Settings) -> Callable[[], Answer]:
    """Make the model; jax-sysid compiles in its fit."""
    force, current = data.force[:, None] / NOISE_N, data.current[:, None]
    low, high = ([jnp.asarray(bound[:5] / PARAMETERS)] for bound in (LOWER, UPPER))

    def solve() -> Answer:
        plant = model(settings.substeps)
        plant.loss(rho_x0=0.0, rho_th=0.0, train_x0=True)
        plant.optimization(adam_epochs=0, lbfgs_epochs=1000, iprint=-1, params_min=low, params_max=high)
        plant.init(params=[jnp.asarray(START[:5] / PARAMETERS)], x0=jnp.zeros(2))
        plant.fit(force, current)
        theta = np.concatenate([np.asarray(plant.params[0]) * PARAMETERS, np.asarray(plant.x0).ravel() * STATE])
        return Answer(theta=theta, evaluations=0, note="evaluations not told; compiles in every solve")

    return solve


if __name__ == "__main__":
    report("jax-sysid Model, L-BFGS-B", "jax-sysid", prepare)
