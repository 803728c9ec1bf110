r"""A published torsion actuator under its published laws and under one tuned here, judged by NumPy and SciPy alone.

Gear, rotor, bar and limit of the motor are those of barkanu/SEATorqueControlBenchmarking (IEEE Robotics and
Automation Magazine, June 2022), and so are form and gains of the laws, read from its C code: a PID on the torsion, a
cascade of a PI on the torque around a PI on the motor's filtered speed, and a cascade with a disturbance observer,
every 0.5 ms and written out in the period that they are computed in. The code does not show all filters of its
encoders: motor speed and torsion are taken as they are.
docs/evidence/torsion_actuator.md has what comes out.

    python problems/torsion_actuator.py
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.linalg import expm

import seaopt as so
from seaopt.control import runnable

PROBLEM = Path(__file__).with_suffix(".toml")
GEAR, ROTOR, DAMPER, BAR = 100.0, 2.781e-4, 1.5e-3, 5000.0
MOTOR_LIMIT = 1.4  # N m, that the published code keeps to; 13.7 A
PERIOD = 5e-4
DERIVATIVE_CORNER = 1600.0  # rad/s, of the derivative's filter in the code of the cascade
STEP, DURATION = 20.0, 1.5  # N m, s
TORQUE_PER_AMPERE = 0.102  # N m, at the motor
FREQUENCIES = np.geomspace(0.05, 999.0, 20_000)


Step = Callable[[np.ndarray, np.ndarray], tuple[float, np.ndarray]]  # of state and (reference, torque, speed)


@dataclass(frozen=True)
class TwoSignalLaw:
    """x+ = a x + b (reference, torque, motor speed), u = c x + d (the same): motor torque times the gear, N m."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray

    def respond(self, z: np.ndarray) -> np.ndarray:
        """Return u per input at points of the z plane, shape (m, 3)."""
        n = self.c.size
        x = np.linalg.solve(z[:, None, None] * np.eye(n) - self.a, np.broadcast_to(self.b + 0j, (z.size, n, 3)))
        return np.einsum("i,mij->mj", self.c, x) + self.d


def read_matrices(step: Step, size: int) -> TwoSignalLaw:
    """Return the matrices of a linear step, from what it does to each state and each input by itself."""
    states = [step(row, np.zeros(3)) for row in np.eye(size)]
    inputs = [step(np.zeros(size), row) for row in np.eye(3)]
    return TwoSignalLaw(
        a=np.array([after for _, after in states]).T, b=np.array([after for _, after in inputs]).T,
        c=GEAR * np.array([u for u, _ in states]), d=GEAR * np.array([u for u, _ in inputs]),
    )  # fmt: skip


def lag(state: float, value: float, corner: float) -> tuple[float, float]:
    """Return a first-order lag by Tustin's rule, as its code has it: what comes out, and the next state."""
    gain = 1.0 / (1.0 + 2.0 / (corner * PERIOD))
    pole = -(1.0 - 2.0 / (corner * PERIOD)) * gain
    out = gain * value + state
    return out, gain * value + pole * out


def pid_on_torsion(state: np.ndarray, seen: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the motor torque of the published PID: gains 1800, 600 and 12 on the torsion in rad."""
    error, torsion = (seen[0] - seen[1]) / BAR, seen[1] / BAR
    slow, after = lag(state[2], torsion, DERIVATIVE_CORNER)
    integral = state[0] + 0.5 * PERIOD * (error + state[1])
    speed = DERIVATIVE_CORNER * (torsion - slow)
    return 1800.0 * error + 600.0 * integral - 12.0 * speed, np.array([integral, error, after])


def cascade(state: np.ndarray, seen: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the motor torque of the published cascade: 16 and 7 around .045 and .012 on the filtered motor speed."""
    error = seen[0] - seen[1]
    outer = state[0] + 7.0 * PERIOD * error
    speed, after = lag(state[2], seen[2], 1600.0)
    inner_error = 16.0 * error + outer - speed
    inner = state[1] + 0.012 * PERIOD * inner_error
    return 0.045 * inner_error + inner, np.array([outer, inner, after])


def cascade_with_observer(state: np.ndarray, seen: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the motor torque of the later cascade, 3.5, .6 and .023 around .15 and .05, with a disturbance observer.

    The observer has the published corner of 600 rad/s in its textbook form, with the rotor's own inertia.
    """
    torque, torque_after = lag(state[0], seen[1], 600.0)
    slow, slow_after = lag(state[1], seen[1], DERIVATIVE_CORNER)
    error = seen[0] - torque
    outer = state[2] + 0.5 * PERIOD * (error + state[3])
    inner_error = 3.5 * error + 0.6 * outer - 0.023 * DERIVATIVE_CORNER * (seen[1] - slow) - seen[2]
    inner = state[4] + 0.5 * PERIOD * (inner_error + state[5])
    moved = 600.0 * ROTOR * seen[2]
    seen_torque, observer_after = lag(state[6], state[7] + moved, 600.0)
    motor = 0.15 * inner_error + 0.05 * inner + (seen_torque - moved)
    after = [torque_after, slow_after, outer, error, inner, inner_error, observer_after, motor]
    return motor, np.array(after)


PUBLISHED: dict[str, tuple[Step, int]] = {
    "PID on the torsion": (pid_on_torsion, 3), "cascaded PID": (cascade, 3),
    "cascaded PID, observer": (cascade_with_observer, 8),
}  # fmt: skip


def of_tuned(law: so.control.Law) -> TwoSignalLaw:
    """Return a law on the torque alone."""
    return TwoSignalLaw(a=law.a, b=np.column_stack([law.b, np.zeros(law.c.size)]), c=law.c, d=np.append(law.d, 0.0))


def sample_plant() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rotor on the bar, the link held and the drive sliding: x+ = a x + b u, (torque, motor speed) = c x."""
    block = np.zeros((3, 3))
    block[0, 1] = 1.0
    block[1] = np.array([-BAR / GEAR**2, -DAMPER, 1.0 / GEAR]) / ROTOR
    whole = expm(block * PERIOD)
    return whole[:2, :2], whole[:2, 2], np.array([[BAR / GEAR, 0.0], [0.0, 1.0]])


def judge(law: TwoSignalLaw, run: np.ndarray) -> dict[str, float]:
    """Return figures of a law and its step: the loop is broken at the motor, where it has one signal in any case."""
    a, b, c = sample_plant()
    z = np.exp(2j * np.pi * FREQUENCIES * PERIOD)
    plant = np.linalg.solve(z[:, None, None] * np.eye(2) - a, np.broadcast_to(b[:, None] + 0j, (z.size, 2, 1)))
    plant = plant[:, :, 0] @ c.T
    response = law.respond(z)
    loop = -np.sum(response[:, 1:] * plant, axis=1)
    sensitivity = 1.0 / (1.0 + loop)
    tracking = np.abs(plant[:, 0] * response[:, 0] * sensitivity)
    size = np.abs(loop)
    crossings = np.flatnonzero((size[:-1] - 1.0) * (size[1:] - 1.0) < 0.0)
    phase = np.abs(np.degrees(np.angle(-loop[crossings])))
    n = law.c.size
    closed = np.zeros((2 + n, 2 + n))
    closed[:2] = np.column_stack([a + np.outer(b, law.d[1:] @ c), np.outer(b, law.c)])
    closed[2:] = np.column_stack([law.b[:, 1:] @ c, law.a])
    below = np.flatnonzero(tracking < tracking[0] / np.sqrt(2.0))
    cosine = find_cosine(law)
    negative = np.flatnonzero(cosine < -1e-6)
    ends = run[-400:].mean()
    return {
        "radius": float(np.max(np.abs(np.linalg.eigvals(closed)))),
        "bandwidth_hz": float(FREQUENCIES[below[0]]) if below.size else np.inf,
        "reference_peak": float(np.max(tracking) / tracking[0]),
        "ms": float(np.max(np.abs(sensitivity))),
        "phase_margin_deg": float(np.min(phase)) if phase.size else np.inf,
        "noise_gain": float(np.max(np.abs(response[:, 1] * sensitivity))),
        "passive_to_hz": float(FREQUENCIES[negative[0]]) if negative.size else np.inf,
        "overshoot": float(max(np.max(run) / STEP - 1.0, 0.0)),
        "rise_ms": 1e3 * PERIOD * float(np.argmax(run > 0.9 * STEP) - np.argmax(run > 0.1 * STEP)),
        "ends": float(ends),
    }


def find_cosine(law: TwoSignalLaw) -> np.ndarray:
    """Return Re Z/|Z| at the link, the law linear and time-invariant with its hold."""
    s = 2j * np.pi * FREQUENCIES
    hold = np.sinc(FREQUENCIES * PERIOD) * np.exp(-0.5 * s * PERIOD)
    response = law.respond(np.exp(s * PERIOD)) * hold[:, None]
    # theta_m and u of v = 1: J s^2 theta + b s theta = u/N - tau/N, tau = k (theta/N - v/s)
    by_torque, by_speed = response[:, 1], response[:, 2]
    inner = ROTOR * s**2 + DAMPER * s + (1.0 - by_torque) * BAR / GEAR**2 - by_speed * s / GEAR
    theta = (1.0 - by_torque) * BAR / GEAR / s / inner
    z = BAR * (1.0 / s - theta / GEAR)
    return z.real / np.abs(z)


def run_law(law: TwoSignalLaw) -> np.ndarray:
    """Return the bar's torque after a step of the reference, with the motor's limit, the drive sliding."""
    a, b, c = sample_plant()
    x, state, most = np.zeros(2), np.zeros(law.c.size), MOTOR_LIMIT * GEAR
    out = np.empty(int(DURATION / PERIOD))
    for i in range(out.size):
        seen = np.array([STEP, *(c @ x)])
        out[i] = seen[1]
        x, state = a @ x + b * np.clip(law.c @ state + law.d @ seen, -most, most), law.a @ state + law.b @ seen
    return out


def tune(bandwidth_hz: float, noise_gain: float) -> so.Controller:
    """Return a law on the torque alone, of a bandwidth, with at most a noise gain."""
    problem = so.read_problem(PROBLEM)
    assert problem.spec is not None
    spec = replace(problem.spec, bandwidth_hz=bandwidth_hz, max_noise_gain=noise_gain)
    return so.tune(problem.design_plant, problem.parameters, spec)


def run_tuned(controller: so.Controller) -> np.ndarray:
    """Return the step of `step` under a tuned law as it is exported, with its anti-windup."""
    a, b, c = sample_plant()
    law = runnable(controller, command_limit=MOTOR_LIMIT / TORQUE_PER_AMPERE)
    x, state = np.zeros(2), law.reset()
    out = np.empty(int(DURATION / PERIOD))
    for i in range(out.size):
        out[i] = float(c[0] @ x)
        current, state = law.step(state, STEP, out[i])
        x = a @ x + b * current * TORQUE_PER_AMPERE * GEAR
    return out


def compare() -> dict[str, dict[str, float]]:
    """Return the figures of every published law, and of one tuned here for its bandwidth and noise gain."""
    rows: dict[str, dict[str, float]] = {}
    for name, (step_of, size) in PUBLISHED.items():
        law = read_matrices(step_of, size)
        rows[name] = judge(law, run_law(law))
        tuned = tune(round(rows[name]["bandwidth_hz"], 1), rows[name]["noise_gain"])
        rows[f"tuned for {name}"] = judge(of_tuned(tuned.law), run_tuned(tuned)) | {"feasible": float(tuned.feasible)}
    return rows


if __name__ == "__main__":
    for label, figures in compare().items():
        print(label, {key: round(value, 4) for key, value in figures.items()})
