"""Many plants at once: closed-loop eigenvalues and peaks of S and T for every draw, vectorised."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control import Controller, TransferFunction
from seaopt.control.loop import LOWEST_HZ
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant, jacobians

Curves = Callable[[Float[np.ndarray, "n m"]], Float[np.ndarray, "n m"]]

CHUNK = 128
BASE_POINTS = 160
MAXIMA = 3  # local maxima refined
FAN = np.array([0.0, 0.1, 0.25, 0.5, 1.0, 2.0, 4.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BatchFigures:
    """Spectral radius, Ms and Mt of every draw (infinite where unstable), arrays of shape (n,)."""

    spectral_radius: Float[np.ndarray, " n"]
    ms: Float[np.ndarray, " n"]
    mt: Float[np.ndarray, " n"]


def batch_figures(
    controller: Controller, plant: Plant, nominal: ParameterSet, draws: dict[str, Float[np.ndarray, " n"]]
) -> BatchFigures:
    """Close `controller` around `plant` at every draw.

    Peaks are found on a grid of each draw's own, with points about the poles of its plant and of its loop, and
    refined by zooming.
    """
    count = len(next(iter(draws.values()))) if draws else 1
    values = np.repeat(np.array(plant.parameter_values(nominal))[:, None], count, axis=1)
    for row, name in enumerate(plant.parameters):
        if name in draws:
            values[row] = draws[name]
    parts = [_chunk(controller, plant, values[:, k : k + CHUNK]) for k in range(0, count, CHUNK)]
    radius, ms, mt = (np.concatenate(items) for items in zip(*parts, strict=True))
    return BatchFigures(spectral_radius=radius, ms=ms, mt=mt)


def _chunk(controller: Controller, plant: Plant, p: Float[np.ndarray, "np n"]) -> tuple[Float[np.ndarray, " n"], ...]:
    a, b, c, d = _sampled(controller, plant, p)
    eigenvalues = _closed_eigenvalues(controller, a, b, c, d)
    radius = np.max(np.abs(eigenvalues), axis=1)
    f = _grids(controller.sample_time_s, np.linalg.eigvals(a).astype(complex), eigenvalues)

    def loop_gain(x: Float[np.ndarray, "n m"]) -> Complex[np.ndarray, "n m"]:
        z = np.exp(2j * np.pi * x * controller.sample_time_s)
        inner = z[:, :, None, None] * np.eye(a.shape[1]) - a[:, None]
        state = np.linalg.solve(inner, np.broadcast_to(b[:, None, :, None].astype(complex), (*x.shape, a.shape[1], 1)))
        p_z = np.einsum("nmi,ni->nm", state[..., 0], c) + d[:, None]
        return p_z * z**-controller.delay_samples * _response(controller.measurement, z)

    def s(x: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        return np.abs(1.0 / (1.0 + loop_gain(x)))

    def t(x: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        gain = loop_gain(x)
        return np.abs(gain / (1.0 + gain))

    stable = radius < 1.0
    return radius, np.where(stable, _peaks(s, f), np.inf), np.where(stable, _peaks(t, f), np.inf)


def _response(tf: TransferFunction, z: Complex[np.ndarray, "n m"]) -> Complex[np.ndarray, "n m"]:
    q = 1.0 / z
    return np.polynomial.polynomial.polyval(q, tf.num) / np.polynomial.polynomial.polyval(q, tf.den)


def _sampled(
    controller: Controller, plant: Plant, p: Float[np.ndarray, "np n"]
) -> tuple[Float[np.ndarray, "..."], ...]:
    """Return the sampled matrices of every draw: exact zero-order hold."""
    from scipy.linalg import expm

    n, nx, nu, ny = p.shape[1], len(plant.states), len(plant.inputs), len(plant.outputs)
    row = list(plant.outputs).index(controller.spec.measured)
    key = f"jacobians{n}"
    if key not in plant.cache:
        plant.cache[key] = jacobians(plant).map(n)
    found = [np.array(item) for item in plant.cache[key](np.zeros((nx, n)), np.zeros((nu, n)), p)]
    a = found[0].reshape(nx, n, nx).transpose(1, 0, 2)
    b = found[1].reshape(nx, n, nu).transpose(1, 0, 2)[:, :, 0] * controller.current_per_force_A_per_N
    c = found[2].reshape(ny, n, nx).transpose(1, 0, 2)[:, row]
    d = found[3].reshape(ny, n, nu).transpose(1, 0, 2)[:, row, 0] * controller.current_per_force_A_per_N
    block = np.zeros((n, nx + 1, nx + 1))
    block[:, :nx, :nx], block[:, :nx, nx] = a, b
    whole = np.asarray(expm(block * controller.sample_time_s))
    return whole[:, :nx, :nx], whole[:, :nx, nx], c, d


def _closed_eigenvalues(
    controller: Controller, a: Float[np.ndarray, "n x x"], b: Float[np.ndarray, "n x"], c: Float[np.ndarray, "n x"],
    d: Float[np.ndarray, " n"],
) -> Complex[np.ndarray, "n m"]:  # fmt: skip
    k, count, nx = controller.delay_samples, a.shape[0], a.shape[1]
    ac, bc, cc, dc = controller.measurement.state_space()
    n, m = nx + k, bc.size
    big, drive, sense = np.zeros((count, n, n)), np.zeros((count, n)), np.zeros((count, n))
    big[:, :nx, :nx], sense[:, :nx] = a, c
    through = d
    if k:
        big[:, :nx, n - 1], sense[:, n - 1], drive[:, nx] = b, d, 1.0
        for i in range(1, k):
            big[:, nx + i, nx + i - 1] = 1.0
        through = np.zeros(count)
    else:
        drive = b
    loop = 1.0 / (1.0 + through * dc)
    closed = np.zeros((count, n + m, n + m))
    closed[:, :n, :n] = big - (dc * loop)[:, None, None] * drive[:, :, None] * sense[:, None, :]
    closed[:, :n, n:] = -loop[:, None, None] * drive[:, :, None] * cc
    closed[:, n:, :n] = loop[:, None, None] * bc[:, None] * sense[:, None, :]
    closed[:, n:, n:] = ac - (loop * through)[:, None, None] * np.outer(bc, cc)
    return np.linalg.eigvals(closed).astype(complex)


def _grids(
    ts: float, plant_poles: Complex[np.ndarray, "n x"], loop_poles: Complex[np.ndarray, "n m"]
) -> Float[np.ndarray, "n k"]:
    nyquist = 0.5 / ts
    base = np.geomspace(LOWEST_HZ, nyquist, BASE_POINTS)
    poles = np.concatenate([plant_poles, loop_poles], axis=1)
    f0 = np.abs(np.angle(poles)) / (2 * np.pi * ts)
    width = np.abs(1.0 - np.abs(poles)) * nyquist / np.pi
    fan = np.concatenate([-FAN[:0:-1], FAN])
    near = (f0[:, :, None] + width[:, :, None] * fan).reshape(poles.shape[0], -1)
    whole = np.concatenate([np.broadcast_to(base, (poles.shape[0], base.size)), near], axis=1)
    return np.sort(np.clip(whole, LOWEST_HZ, nyquist), axis=1)


def _peaks(curve: Curves, f: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
    """Return the largest value of each row's curve: the highest local maxima of its grid, refined by zooming."""
    values = curve(f)
    rows = np.arange(f.shape[0])
    top = np.max(values, axis=1)
    inner = values[:, 1:-1]
    local = np.where((inner >= values[:, :-2]) & (inner >= values[:, 2:]), inner, -np.inf)
    for _ in range(MAXIMA):
        at = np.argmax(local, axis=1)
        # Of a plateau or of doubled points, the neighbours are the same maximum.
        for near in (at - 1, at, at + 1):
            local[rows, np.clip(near, 0, local.shape[1] - 1)] = -np.inf
        low, high = f[rows, np.maximum(at - 1, 0)], f[rows, np.minimum(at + 3, f.shape[1] - 1)]
        for _ in range(6):
            x = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, 11)
            y = curve(x)
            top = np.maximum(top, np.max(y, axis=1))
            k = np.clip(np.argmax(y, axis=1), 1, x.shape[1] - 2)
            low, high = x[rows, k - 1], x[rows, k + 1]
    return top
