"""The problem every peer solves: a series elastic actuator on its stand, with Coulomb friction, from one chirp.

    m dv/dt = Kf i - b v - Fc tanh(v / v_s) - k x,    dx/dt = v,    F = k x + offset + noise

The spring k = 655000 N/m and the smoothing speed v_s = 5 mm/s are known; m, b, Kf, Fc, the offset and the initial state
are not. 65,600 samples at 400 Hz of a logarithmic chirp of 4 A from 0.1 to 40 Hz; the mode lies at sqrt(k/m)/(2 pi) =
8.1 Hz, inside it. The current is held between samples, so that every peer integrates the same input as the truth, which
takes four Runge-Kutta steps a sample. The Fisher information is of the seven unknowns, by complex-step derivatives.

A peer imports this module, which needs NumPy alone. `python problem.py FILE.npz` makes the data.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import resource
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

RATE_HZ = 400.0
STEP_S = 1.0 / RATE_HZ
SAMPLES = 65_600
CHIRP_HZ = (0.1, 40.0)
AMPLITUDE_A = 4.0
K = 655_000.0  # N/m
V_S = 5e-3  # m/s
NOISE_N = 10.0
SEED = 1
SUBSTEPS = 4

NAMES = ("m", "b", "Kf", "Fc", "offset")
UNITS = ("kg", "N s/m", "N/A", "N", "N")
TRUTH = np.array([250.0, 3000.0, 200.0, 100.0, 20.0, 0.0, 0.0])  # the last two are x(0) in m and v(0) in m/s
START = np.array([400.0, 6000.0, 120.0, 20.0, 0.0, 0.0, 0.0])
LOWER = np.array([1.0, 0.0, 1.0, 0.0, -1e4, -1.0, -10.0])
UPPER = np.array([1e4, 1e6, 1e4, 1e4, 1e4, 1.0, 10.0])
SCALE = np.array([400.0, 6000.0, 120.0, 20.0, 10.0, 1e-3, 1e-2])  # for peers that do not scale by themselves


@dataclass(frozen=True, slots=True, kw_only=True)
class Data:
    """Current (A) and force (N), both of shape (n,), and the standard deviation of each of the seven unknowns."""

    current: np.ndarray
    force: np.ndarray
    std: np.ndarray


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the command line asks: Runge-Kutta steps a sample, and the seconds after which a slow peer stops itself."""

    substeps: int
    limit_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What a solve gives: the estimates (the first five are NAMES), simulations it took, and a remark."""

    theta: np.ndarray
    evaluations: int
    note: str = ""


def chirp(amplitude: float = AMPLITUDE_A, samples: int = SAMPLES) -> np.ndarray:
    """Return the current (A) at the samples."""
    t, (low, high) = np.arange(samples) * STEP_S, CHIRP_HZ
    scale = samples * STEP_S / np.log(high / low)
    return amplitude * np.sin(2 * np.pi * low * scale * np.expm1(t / scale))


def rates(x: np.ndarray, v: np.ndarray, u: float, theta: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return dx/dt and dv/dt."""
    m, b, gain, coulomb = theta[:4]
    return v, (gain * u - b * v - coulomb * np.tanh(v / V_S) - K * x) / m


def simulate(theta: np.ndarray, current: np.ndarray, substeps: int = SUBSTEPS) -> np.ndarray:
    """Return the force of each sample, shape (n, ...), for unknowns of shape (7, ...), by RK4."""
    h = STEP_S / substeps
    x, v = theta[5], theta[6]
    force = np.empty((current.size, *np.shape(x)), dtype=theta.dtype)
    for i, u in enumerate(current):
        force[i] = K * x + theta[4]
        for _ in range(substeps):
            x1, v1 = rates(x, v, u, theta)
            x2, v2 = rates(x + h / 2 * x1, v + h / 2 * v1, u, theta)
            x3, v3 = rates(x + h / 2 * x2, v + h / 2 * v2, u, theta)
            x4, v4 = rates(x + h * x3, v + h * v3, u, theta)
            x, v = x + h / 6 * (x1 + 2 * x2 + 2 * x3 + x4), v + h / 6 * (v1 + 2 * v2 + 2 * v3 + v4)
    return force


def differentiate(current: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the true force, shape (n,), and its derivatives by the unknowns over the noise, (n, 7): complex steps."""
    tiny = 1e-30
    columns = simulate(TRUTH[:, None] + 1j * tiny * np.eye(TRUTH.size), current)
    return columns[:, 0].real, columns.imag / (tiny * NOISE_N)


def make(path: Path) -> None:
    """Write current, noisy force, noiseless force and the Fisher-information standard deviations to an .npz file."""
    current = chirp()
    truth, jacobian = differentiate(current)
    size = np.linalg.norm(jacobian, axis=0)
    scaled = jacobian / size
    std = np.sqrt(np.diag(np.linalg.inv(scaled.T @ scaled))) / size
    force = truth + NOISE_N * np.random.default_rng(SEED).standard_normal(SAMPLES)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, current=current, force=force, truth=truth, std=std)


def load(path: Path) -> Data:
    """Read what `make` wrote."""
    with np.load(path) as content:
        return Data(current=content["current"], force=content["force"], std=content["std"])


def report(peer: str, package: str, prepare: Callable[[Data, Settings], Callable[[], Answer]]) -> None:
    """Prepare and solve as the command line asks, and print one line of JSON.

    Parameters
    ----------
    peer : str
        Its name in the table.
    package : str
        The distribution whose version is told.
    prepare : callable
        Builds and compiles what can be built beforehand and returns the solve. Its time is `setup_s`; imports count in
        the process alone.

    """
    parser = argparse.ArgumentParser()
    parser.add_argument("data", type=Path)
    parser.add_argument("--repeat", type=int, default=1, help="solve so often in this process")
    parser.add_argument("--substeps", type=int, default=1, help="Runge-Kutta steps a sample")
    parser.add_argument("--limit", type=float, default=1e9, help="seconds after which a slow peer stops itself")
    asked = parser.parse_args()
    data = load(asked.data)
    started = time.perf_counter()
    solve = prepare(data, Settings(substeps=asked.substeps, limit_s=asked.limit))
    setup_s, solves, cpu = time.perf_counter() - started, [], []
    for _ in range(asked.repeat):
        started, busy = time.perf_counter(), time.process_time()
        answer = solve()
        solves.append(time.perf_counter() - started)
        cpu.append(time.process_time() - busy)
    row: dict[str, Any] = {
        "peer": peer,
        "version": importlib.metadata.version(package),
        "setup_s": setup_s,
        "solve_s": solves[0],
        "warm_s": solves[1:],
        "solve_cpu_s": cpu,
        "evaluations": answer.evaluations,
        "parameters": dict(zip(NAMES, map(float, answer.theta), strict=False)),
        "error_sigma": float(np.max(np.abs(answer.theta - TRUTH)[:5] / data.std[:5])),
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "note": answer.note,
    }
    print(json.dumps(row))


if __name__ == "__main__":
    make(Path(sys.argv[1]))
