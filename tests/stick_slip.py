r"""A stick-slip simulator for tests and benchmarks, which shares no code with the product.

A mass on a spring with friction, driven by a sampled law through hold and delay:

.. math:: m \ddot q + b \dot q + f(\dot q) + k q = F_m, \qquad F = k q,

which is the actuator with both links fixed. Friction is Coulomb's law, :math:`f \in f_c\,\mathrm{Sgn}(\dot q)` (with
:math:`f_s` and :math:`v_{st}` Stribeck's), or smoothed by :math:`\tanh(\dot q/v_s)`. It is integrated by the
theta method (Moreau and Jean's, for set-valued friction) with the friction force implicit: where it sticks the velocity
is zero, not small. The law is the difference equation of controller.json, stepped by hand; many actuators run at once,
a few one after the other in plain floats, which are quicker then.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

THETA = 0.55  # weight of a step's end: at one half what sticks would not come to rest
NEWTON_STEPS, NEWTON_ROUNDING = 8, 1e-14
FEW = 4  # runs; more are quicker at once
FLOATS = SimpleNamespace(  # what NumPy does with arrays, for one run
    abs=abs, maximum=max, minimum=min, exp=math.exp, tanh=math.tanh, any=bool, all=bool,
    where=lambda yes, this, other: this if yes else other, sign=lambda x: math.copysign(1.0, x),
)  # fmt: skip


@dataclass(frozen=True)
class Mass:
    """An actuator with its links fixed: kg, N s/m, N/m, N; v_s and v_st in m/s, v_s = 0 for a jump; half the play."""

    m: float
    b: float
    k: float
    f_c: float
    f_s: float = 0.0
    v_s: float = 0.0
    v_st: float = 1.0
    play: float = 0.0

    @classmethod
    def of(cls, p: Mapping[str, float], *, jump: bool = False) -> Mass:
        """Return the high-impedance actuator, its spring at link 1, of parameters by their names."""
        r = p["l"] / (2 * np.pi * p["N_p"])
        return cls(
            m=p["J"] / r**2 + p["m_l"], b=p["b_r"] / r**2, k=p["k"], f_c=p["f_c"], f_s=p.get("f_s", 0.0),
            v_s=0.0 if jump else p["v_s"], v_st=p.get("v_st", 1.0),
            play=p.get("g_b", 0.0),
        )  # fmt: skip


@dataclass(frozen=True)
class Runs:
    """Time (s), force and motor effort (N), shape (runs, samples), and the largest force between samples too."""

    time: np.ndarray
    force: np.ndarray
    effort: np.ndarray
    largest: np.ndarray

    def overshoot(self, step: np.ndarray) -> np.ndarray:
        """Return the largest force over the step, less one."""
        return self.largest / np.abs(step) - 1.0

    def residual(self, step: np.ndarray, share: float = 1 / 3) -> np.ndarray:
        """Return the largest error in the last `share` of the time, over the step."""
        last = self.force[:, -int(share * self.time.size) :]
        return np.max(np.abs(last / step[:, None] - 1.0), axis=1)

    def ringing(self, step: np.ndarray, share: float = 1 / 3) -> np.ndarray:
        """Return the peak-to-peak force in the last `share` of the time, over the step."""
        last = self.force[:, -int(share * self.time.size) :]
        return np.ptp(last, axis=1) / np.abs(step)


def simulate(
    masses: Sequence[Mass], laws: Sequence[Mapping[str, Any]], reference: np.ndarray, *, substeps: int = 50,
    velocity: np.ndarray | None = None,
) -> Runs:  # fmt: skip
    """Simulate each mass under its law (the content of a controller.json), from rest or with a first velocity (m/s).

    `reference` is (runs, samples); all laws have one sample time.
    """
    if 1 < len(masses) <= FEW:
        first = [None] * len(masses) if velocity is None else velocity[:, None]
        runs = [
            simulate([mass], [law], row[None], substeps=substeps, velocity=one)
            for mass, law, row, one in zip(masses, laws, reference, first, strict=True)
        ]
        force, effort, largest = (np.concatenate([getattr(run, name) for run in runs])
                                  for name in ("force", "effort", "largest"))  # fmt: skip
        return Runs(time=runs[0].time, force=force, effort=effort, largest=largest)
    period, n, alone = laws[0]["sample_time_s"], reference.shape[1], len(masses) == 1
    ops = FLOATS if alone else np
    names = ("m", "b", "k", "f_c", "f_s", "v_s", "v_st", "play")
    values = [np.array([getattr(each, name) for each in masses], dtype=float) for name in names]
    values.append(np.zeros(len(masses)) if velocity is None else np.array(velocity, dtype=float))
    m, b, k, f_c, f_s, v_s, v_st, play, v = (each.item() for each in values) if alone else values
    f_s = ops.maximum(f_s, f_c)
    h = period / substeps
    reach = THETA * h
    # What no run has is left out of the steps.
    falls, loose, smooth = ops.any(f_s > f_c), ops.any(play > 0.0), v_s > 0.0
    friction, inertia = reach * f_c, m + reach * (b + reach * k)
    steps = [_DifferenceEquations(laws, path) for path in ("reference", "measurement")]
    delays = np.array([round(law["delay_samples"], 9) for law in laws]).astype(int, casting="unsafe")
    effort, force = np.zeros((len(masses), n)), np.zeros((len(masses), n))
    q = spring = largest = 0.0 * v
    for sample in range(n):
        force[:, sample] = spring
        effort[:, sample] = steps[0].step(reference[:, sample]) - steps[1].step(force[:, sample])
        before = sample - delays
        applied = np.where(before >= 0, effort[np.arange(len(masses)), np.maximum(before, 0)], 0.0)
        applied = applied.item() if alone else applied
        for _ in range(substeps):
            if falls:
                friction = reach * (f_c + (f_s - f_c) * ops.exp(-((v / v_st) ** 2)))
            if loose:
                inertia = m + reach * (b + reach * k * (ops.abs(q) >= play))
            mean = _solve_velocity(ops, inertia, m * v + reach * (applied - spring), friction, v_s, smooth)
            q = q + h * mean
            v = (mean - (1.0 - THETA) * v) / THETA
            spring = k * (q - ops.minimum(ops.maximum(q, -play), play) if loose else q)
            largest = ops.maximum(largest, ops.abs(spring))
    return Runs(time=period * np.arange(n), force=force, effort=effort, largest=np.atleast_1d(largest))


def _solve_velocity(ops, inertia, push, friction, v_s, smooth):
    """Return the velocity w of inertia w + friction Sgn(w) = push, or where `smooth` with tanh(w/v_s) for Sgn."""
    size = ops.abs(push)
    w = ops.maximum(size - friction, 0.0) / inertia
    if ops.any(smooth):
        scale = ops.where(smooth, v_s, 1.0)
        at = ops.maximum(w, size / (inertia + friction / scale))  # both are below the root of a concave function
        for _ in range(NEWTON_STEPS):
            curve = ops.tanh(at / scale)
            slope = inertia + friction / scale * (1.0 - curve**2)
            change = (size - inertia * at - friction * curve) / slope
            at = at + change
            if ops.all(ops.abs(change) <= NEWTON_ROUNDING * at):
                break
        w = ops.where(smooth, at, w)
    return ops.sign(push) * w


class _DifferenceEquations:
    """y_k = sum num_i u_(k-i) - sum den_i y_(k-i), one per run."""

    def __init__(self, laws: Sequence[Mapping[str, Any]], path: str) -> None:
        order = max(max(len(law[path]["num"]), len(law[path]["den"])) for law in laws)
        self.num, self.den = np.zeros((len(laws), order)), np.zeros((len(laws), order))
        for row, law in enumerate(laws):
            self.num[row, : len(law[path]["num"])] = law[path]["num"]
            self.den[row, : len(law[path]["den"])] = law[path]["den"]
        self.inputs, self.outputs = np.zeros((len(laws), order)), np.zeros((len(laws), order))

    def step(self, value: np.ndarray) -> np.ndarray:
        self.inputs = np.column_stack([value, self.inputs[:, :-1]])
        new = np.sum(self.num * self.inputs, axis=1) - np.sum(self.den[:, 1:] * self.outputs[:, :-1], axis=1)
        self.outputs = np.column_stack([new, self.outputs[:, :-1]])
        return new
