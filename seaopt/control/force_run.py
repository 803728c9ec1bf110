"""A digital law on a plant as it is, nonlinear and continuous, with delay, sensor noise and disturbance."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.errors import ControlError, suggestion
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant

State = TypeVar("State")
SUBSTEPS = 4  # of Runge and Kutta's fourth order, a sample


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ForceRun:
    """What a closed loop did.

    Parameters
    ----------
    time, reference, force, current, law_time_s : arrays, shape (n,)
        Seconds; N; N at the samples, without the sensor's noise; A as commanded; and the time (s) that each step of the
        law took.
    state : array, shape (n, nx)
        Of the plant.

    """

    time: Float[np.ndarray, " n"]
    reference: Float[np.ndarray, " n"]
    force: Float[np.ndarray, " n"]
    current: Float[np.ndarray, " n"]
    law_time_s: Float[np.ndarray, " n"]
    state: Float[np.ndarray, "n nx"]

    @property
    def overshoot(self) -> float:
        """How far the force goes beyond the last reference, as a fraction of the step from the first sample's force."""
        step = self.reference[-1] - self.force[0]
        return max(float(np.max((self.force - self.reference[-1]) / step)), 0.0)

    def __repr__(self) -> str:
        return (
            f"ForceRun of {self.time.size} samples, {self.time[-1]:.4g} s: reference to {self.reference[-1]:.4g} N, "
            f"force up to {np.max(np.abs(self.force)):.4g} N and {self.force[-1]:.4g} N at the end, current up to "
            f"{np.max(np.abs(self.current)):.4g} A"
        )

    def settling_time_s(self, band: float = 0.02) -> float:
        """Return the time from the reference's first change until the force stays within `band` of the step.

        Infinite where it has not at the last sample.
        """
        changed = np.flatnonzero(np.diff(self.reference)) + 1
        first = float(self.time[changed[0]] if changed.size else self.time[0])
        step = abs(self.reference[-1] - self.force[0])
        outside = np.flatnonzero(np.abs(self.force - self.reference[-1]) > band * step)
        if not outside.size:
            return 0.0
        return float(self.time[outside[-1] + 1]) - first if outside[-1] + 1 < self.time.size else np.inf


def close_loop(
    step: Callable[[State, float, float], tuple[float, State]],
    start: State,
    plant: Plant,
    params: ParameterSet,
    reference: Float[np.ndarray, " n"],
    *,
    measured: str = "F1",
    sample_time_s: float = 1e-3,
    delay_samples: int = 1,
    sensor_std: float = 0.0,
    disturbance_A: float | Float[np.ndarray, " n"] = 0.0,
    seed: int = 0,
) -> ForceRun:
    """Run a law on a plant from rest.

    Parameters
    ----------
    step : callable ``(state, reference, measurement) -> (current, state)``
        The law, such as ``mpc.command``; it sees the measurement before its current.
    start
        Its state at the first sample.
    plant, params
        As it is, not only as the law was designed for.
    reference : array, shape (n,)
        N, one value a sample.
    measured : str
        The output that the law sees.
    sample_time_s : float
        Seconds.
    delay_samples : int
        Whole samples from a command to the plant.
    sensor_std : float
        White noise on the measurement.
    disturbance_A : float or array, shape (n,)
        Added to the current inside the plant.
    seed : int
        Of the noise.

    Raises
    ------
    ControlError
        The plant has no such output, or the loop runs away.

    """
    if measured not in plant.outputs:
        raise ControlError(
            f'measured = "{measured}" is not an output of {plant.name}; {suggestion(measured, plant.outputs)}'
        )
    n, p = reference.size, ca.DM(plant.parameter_values(params))
    advance, output = _sampled(plant, sample_time_s)
    row, rest = list(plant.outputs).index(measured), [0.0] * (len(plant.inputs) - 1)
    noise = sensor_std * np.random.default_rng(seed).normal(size=n)
    disturbance = np.broadcast_to(np.asarray(disturbance_A, dtype=float), n)
    x, law, waiting, applied = ca.DM.zeros(len(plant.states), 1), start, [0.0] * delay_samples, 0.0
    force, current, took, states = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros((n, len(plant.states)))
    for k in range(n):
        if waiting:
            applied = waiting[0]
        force[k] = float(output(x, [applied + disturbance[k], *rest], p)[row])
        began = time.perf_counter()
        current[k], law = step(law, float(reference[k]), float(force[k] + noise[k]))
        took[k] = time.perf_counter() - began
        waiting = [*waiting, float(current[k])]
        applied = waiting.pop(0)
        states[k] = np.array(x).ravel()
        x = advance(x, [applied + disturbance[k], *rest], p)
        if not np.all(np.isfinite(np.array(x))):
            raise ControlError(f"the loop on {plant.name} runs away at t = {k * sample_time_s:g} s; tune it again")
    clock = sample_time_s * np.arange(n)
    return ForceRun(time=clock, reference=reference, force=force, current=current, law_time_s=took, state=states)


def _sampled(plant: Plant, sample_time_s: float) -> tuple[Any, Any]:
    """Return the plant over one sample of constant input, and its outputs, as CasADi functions of (x, u, p)."""
    key = f"sampled {sample_time_s!r}"
    if key not in plant.cache:
        arguments = [plant.x, plant.u, plant.p]
        f = ca.Function("f", arguments, [ca.substitute(plant.dynamics, plant.t, 0.0)])
        x, u, p = (ca.SX.sym(name, item.numel()) for name, item in zip("xup", arguments, strict=True))
        h, y = sample_time_s / SUBSTEPS, x
        for _ in range(SUBSTEPS):
            k_1 = f(y, u, p)
            k_2 = f(y + h / 2 * k_1, u, p)
            k_3 = f(y + h / 2 * k_2, u, p)
            y += h / 6 * (k_1 + 2 * k_2 + 2 * k_3 + f(y + h * k_3, u, p))
        output = ca.Function("h", arguments, [ca.substitute(plant.output, plant.t, 0.0)])
        plant.cache[key] = (ca.Function("advance", [x, u, p], [y]), output)
    return plant.cache[key]
