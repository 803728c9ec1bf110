"""CMA-ES and MuJoCo's `minimize` on the elastic joint of problems/elastic_joint.py: `joint.py` runs this and compares.

Both search the logarithms of the same seven unknowns from the same start, on the same simulation: JAX, compiled, all
candidates at once. Between substeps the joint moves exactly, as in the simulator of the truth, with fewer of them.
CMA-ES ("practice of the field": 4096 candidates a generation; its own default: 9 for seven unknowns) is `cmaes` from
the package index. It knows no derivatives and states no intervals. `minimize` takes finite differences, eight
candidates at once; its interval here is the usual one, from its last Jacobian, taking the residuals as white.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from cmaes import CMA
from jax.scipy.linalg import expm
from mujoco import minimize

jax.config.update("jax_enable_x64", True)

WITHIN = np.log(30.0)  # of the start, either way
FLAT = 1e-10  # relative spread of a generation's costs at which CMA-ES ends


def make_simulation(data: dict[str, Any], substeps: int) -> Callable[[Any], Any]:
    """Return the compiled map from candidates, shape (n, 7), to residuals in steps of noise, shape (n, samples)."""
    names, known = list(data["names"]), data["known"]
    goal, measured, sigma, h = data["goal"], data["theta_m"], data["sigma"], data["period"] / substeps
    reach = int(np.ceil(30.0 * data["start"][names.index("delay_s")] / h)) + 1
    held = jnp.concatenate([jnp.full(reach, goal[0]), jnp.repeat(jnp.asarray(goal), substeps)])

    def run(z: Any) -> Any:
        p = {**known, **dict(zip(names, jnp.exp(z), strict=True))}
        drive, pull, drag = p["K_tau"] * p["k_p"], p["k_s"] / p["N"], p["c_s"] / p["N"]
        motor = [-(pull / p["N"] + drive), -(drag / p["N"] + p["K_tau"] * p["k_d"] + p["b_r"]), pull, drag, drive, -1.0]
        link = [pull, drag, -p["k_s"], -p["c_s"], 0.0, 0.0]
        a = jnp.zeros((6, 6)).at[0, 1].set(1.0).at[2, 3].set(1.0)
        a = a.at[1].set(jnp.stack(jnp.broadcast_arrays(*map(jnp.asarray, motor))) / p["J_m"])
        a = a.at[3].set(jnp.stack(jnp.broadcast_arrays(*map(jnp.asarray, link))) / p["J_l"])
        step = expm(a * h)[:4]
        late = p["delay_s"] / h
        whole = jnp.floor(late).astype(int)
        share = late - whole

        def move(x: Any, k: Any) -> tuple[Any, Any]:
            angle = x[0]
            for j in range(substeps):
                at = k * substeps + j + reach - whole
                x = step[:, :4] @ x + step[:, 4] * ((1 - share) * held[at] + share * held[at - 1])
                x = x + step[:, 5] * jnp.clip(-x[1] / step[1, 5], -p["f_c"], p["f_c"])
            return x, angle

        angles = jax.lax.scan(move, jnp.zeros(4), jnp.arange(len(goal)))[1]
        residual = (angles - jnp.asarray(measured)) / sigma
        return residual - jnp.mean(residual)  # the encoder begins anywhere

    return jax.jit(jax.vmap(run))


def search_by_cma(simulate: Callable[[Any], Any], start: Any, population: int, limit_s: float) -> dict[str, Any]:
    """Return what CMA-ES finds."""
    cost, begin = jax.jit(lambda z: jnp.sum(simulate(z) ** 2, axis=1)), time.perf_counter()
    bounds = np.column_stack([start - WITHIN, start + WITHIN])
    search = CMA(mean=start, sigma=0.5, bounds=bounds, population_size=population or None, seed=1)
    best, count, note = (start, np.inf), 0, "costs flat"
    while True:
        candidates = np.array([search.ask() for _ in range(search.population_size)])
        costs = np.nan_to_num(np.asarray(cost(candidates)), nan=1e300, posinf=1e300)
        search.tell(list(zip(candidates, costs.tolist(), strict=True)))
        count += len(candidates)
        if np.min(costs) < best[1]:
            best = candidates[np.argmin(costs)], float(np.min(costs))
        if np.ptp(costs) < FLAT * np.min(costs):
            break
        if search.should_stop():
            note = "its own stop"
            break
        if time.perf_counter() - begin > limit_s:
            note = f"stopped after {limit_s:.0f} s"
            break
    return {"z": best[0].tolist(), "cost": best[1], "simulations": count, "note": note}


def search_by_minimize(simulate: Callable[[Any], Any], start: Any) -> dict[str, Any]:
    """Return what `minimize` finds, with a standard deviation of each logarithm from finite differences."""
    count = 0

    def residual(z: Any) -> Any:
        nonlocal count
        count += z.shape[1]
        padded = np.repeat(z[:, :1], max(len(start), z.shape[1]), axis=1)  # one shape, compiled once
        padded[:, : z.shape[1]] = z
        return np.asarray(simulate(padded.T)).T[:, : z.shape[1]]

    z, trace = minimize.least_squares(
        start, residual, bounds=[start - WITHIN, start + WITHIN], x_scale="jac", verbose=minimize.Verbosity.SILENT
    )
    at, small = residual(z[:, None]), 1e-6
    jacobian = (residual(z[:, None] + small * np.eye(len(z))) - at) / small
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * float(np.mean(at**2))
    cost, note = float(np.sum(at**2)), f"{len(trace)} iterations"
    return {"z": z.tolist(), "cost": cost, "simulations": count, "note": note, "cov": covariance.tolist()}


def main() -> None:
    """Search once to compile and once more, and print the second as a line of JSON."""
    parser = argparse.ArgumentParser()
    parser.add_argument("data", type=Path)
    parser.add_argument("method", choices=("cma", "minimize"))
    parser.add_argument("--population", type=int, default=0)
    parser.add_argument("--substeps", type=int, default=4)
    parser.add_argument("--limit", type=float, default=600.0)
    asked = parser.parse_args()
    data = json.loads(asked.data.read_text())
    start, simulate = np.log(data["start"]), make_simulation(data, asked.substeps)
    batch = len(start) if asked.method == "minimize" else asked.population or 4 + int(3 * np.log(len(start)))
    np.asarray(simulate(np.tile(start, (batch, 1))))
    begin, busy = time.perf_counter(), time.process_time()
    if asked.method == "cma":
        answer = search_by_cma(simulate, start, asked.population, asked.limit)
    else:
        answer = search_by_minimize(simulate, start)
    spent = {"wall_s": time.perf_counter() - begin, "cpu_s": time.process_time() - busy}
    print(json.dumps({**answer, **spent, "names": data["names"], "samples": len(data["goal"])}))


if __name__ == "__main__":
    main()
