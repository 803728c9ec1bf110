r"""The pass without a compiler: NumPy for linear plants, CasADi's virtual machine for the others.

A linear recursion :math:`z_{k+1} = F z_k + B w_k,\ o_k = H z_k + D w_k` is lifted over blocks of L samples: the
outputs of a block are one matrix product of its first state and its inputs, so that the only loop in Python is over
blocks, and it carries the state alone. :math:`z` holds the state and its sensitivities.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.simulation.discretisation import transition
from seaopt.simulation.integrator import output_function, step_function
from seaopt.simulation.model import Model
from seaopt.simulation.passes import Pass, Point, Segment, Weights

BLOCK = 32
CHUNK = 4096

Trace = tuple[Float[np.ndarray, "n ny"], Float[np.ndarray, "n ny nt"], Float[np.ndarray, "n1 nx"]]


def interpreted_pass(
    model: Model,
    segment: Segment,
    point: Point,
    weights: Weights,
    *,
    outputs: bool,
    columns: bool,
    states: bool,
) -> Pass:
    """Run the pass in NumPy and CasADi's virtual machine."""
    held = _held_inputs(segment, point)
    y, dy, x = _linear_trace(model, point, held) if model.linear else _nonlinear_trace(model, segment, point, held)
    ny, nc = model.ny, dy.shape[2] + 3
    gram, loss, count = np.zeros((ny, nc, nc)), np.zeros(ny), np.zeros(ny)
    v = None
    if segment.y is not None:
        v, present = _columns(segment, point, weights, y, dy)
        for o in range(ny):
            size = np.abs(v[present[:, o], o, 0])
            weight = np.minimum(1.0, weights.knee[o] / np.maximum(size, 1e-300))
            inside = size <= weights.knee[o]
            with np.errstate(invalid="ignore"):
                tail = weights.knee[o] * (size - 0.5 * weights.knee[o])
            rows = v[present[:, o], o]
            gram[o] = (rows * weight[:, None]).T @ rows
            loss[o] = float(np.sum(np.where(inside, 0.5 * size**2, tail)))
            count[o] = float(size.size)
    return Pass(
        gram=gram,
        loss=loss,
        count=count,
        outputs=y if outputs else None,
        columns=v if columns else None,
        states=x[:-1] if states else None,
        last=x[-1],
    )


def _held_inputs(segment: Segment, point: Point) -> Float[np.ndarray, "n w"]:
    """Return [u_a, u_b, 1] of every sample."""
    n = segment.u.shape[0]
    rows = np.arange(n)
    ua, ub = (segment.u[np.clip(rows - lag, 0, n - 1)] for lag in point.clock.lags)
    return np.hstack([ua, ub, np.ones((n, 1))])


def _augmented(model: Model, blocks: Float[np.ndarray, "..."]) -> tuple[Any, Any, Any, Any]:
    """Return F, B, H, D of the recursion of z = [x, dx/dtheta_1, ..., dx/dx0_1, ...]."""
    nx, ny, count = model.nx, model.ny, blocks.shape[0] - 1
    nt = count + nx
    width = blocks.shape[2] - nx
    f = np.kron(np.eye(nt + 1), blocks[0, :nx, :nx])
    h = np.kron(np.eye(nt + 1), blocks[0, nx:, :nx])
    b, d = np.zeros(((nt + 1) * nx, width)), np.zeros(((nt + 1) * ny, width))
    for j in range(count + 1):
        b[j * nx : (j + 1) * nx], d[j * ny : (j + 1) * ny] = blocks[j, :nx, nx:], blocks[j, nx:, nx:]
        if j:
            f[j * nx : (j + 1) * nx, :nx], h[j * ny : (j + 1) * ny, :nx] = (
                blocks[j, :nx, :nx],
                blocks[j, nx:, :nx],
            )
    return f, b, h, d


def _linear_trace(model: Model, point: Point, held: Float[np.ndarray, "n w"]) -> Trace:
    nx, ny = model.nx, model.ny
    f, b, h, d = _augmented(model, transition(model, point.theta, point.clock))
    n, width = held.shape
    nt = f.shape[0] // nx - 1
    z = np.zeros(f.shape[0])
    z[:nx] = point.x0
    for i in range(nx):
        z[(1 + nt - nx + i) * nx + i] = 1.0

    count = -(-n // BLOCK)
    padded = np.zeros((count * BLOCK, width))
    padded[:n] = held
    inputs = padded.reshape(count, BLOCK * width)
    powers = [np.eye(f.shape[0])]
    for _ in range(BLOCK):
        powers.append(powers[-1] @ f)
    observe = np.vstack([h @ power for power in powers[:-1]])
    state_rows = np.vstack([power[:nx] for power in powers[:-1]])
    reach = np.hstack([power @ b for power in powers[BLOCK - 1 :: -1]])
    impulse = [d, *(h @ power @ b for power in powers[: BLOCK - 1])]
    state_impulse = [np.zeros((nx, width)), *(power[:nx] @ b for power in powers[: BLOCK - 1])]

    starts = np.empty((count, f.shape[0]))
    driven = inputs @ reach.T
    whole = powers[BLOCK]
    for k in range(count):
        starts[k] = z
        z = whole @ z + driven[k]
    stacked = starts @ observe.T + inputs @ _toeplitz(impulse).T
    x = (starts @ state_rows.T + inputs @ _toeplitz(state_impulse).T).reshape(count * BLOCK, nx)
    all_outputs = stacked.reshape(count * BLOCK, nt + 1, ny)[:n]
    last = f[:nx, :nx] @ x[n - 1] + b[:nx] @ held[-1]
    return all_outputs[:, 0], all_outputs[:, 1:].transpose(0, 2, 1), np.vstack([x[:n], last])


def _toeplitz(impulse: list[Float[np.ndarray, "a w"]]) -> Float[np.ndarray, "la lw"]:
    rows, width = impulse[0].shape
    out = np.zeros((BLOCK * rows, BLOCK * width))
    for i in range(BLOCK):
        for j in range(i + 1):
            out[i * rows : (i + 1) * rows, j * width : (j + 1) * width] = impulse[i - j]
    return out


def _fold(model: Model, point: Point) -> Any:
    """Return the CasADi function (z, w, [p; older; newer]) -> z+ over CHUNK samples, z = [x, vec(sensitivities)].

    Each column of w is [t, u_a, u_b]; older and newer are the two parts of the period that a fractional delay makes.
    """
    clock, steps = point.clock, point.substeps
    split = clock.delay_free or clock.fraction_s > 0.0
    key = f"fold {clock.hold} {clock.delay_free} {split} {steps}"
    if key in model.functions:
        return model.functions[key]
    nx, nt, na = model.nx, model.np + clock.delay_free + model.nx, model.p.numel()
    z, data = ca.MX.sym("z", nx * (1 + nt)), ca.MX.sym("data", na + 2)
    w = ca.MX.sym("w", 1 + 2 * model.nu)
    x, s, p = z[:nx], ca.reshape(z[nx:], nx, nt), data[:na]
    t, ua, ub = w[0], w[1 : 1 + model.nu], w[1 + model.nu :]
    step = step_function(model)
    for part in (0, 1) if split else (1,):
        h, dh = data[na + part] / steps, (-1.0 if part else 1.0) / steps
        for i in range(steps):
            u0 = u1 = ua if part else ub
            if clock.hold == "first":
                u0, u1 = ua + (ub - ua) * (i / steps), ua + (ub - ua) * ((i + 1) / steps)
            x, a, b = step(t, x, u0, u1, p, h)
            forced = [b[:, : model.np], b[:, model.np] * dh] if clock.delay_free else [b[:, : model.np]]
            s = ca.mtimes(a, s) + ca.horzcat(*forced, ca.MX.zeros(nx, nx))
            t = t + h
    sample = ca.Function("sample", [z, w, data], [ca.vertcat(x, ca.vec(s))])
    model.functions[key] = sample.mapaccum(CHUNK)
    return model.functions[key]


def _nonlinear_trace(model: Model, segment: Segment, point: Point, held: Float[np.ndarray, "n w"]) -> Trace:
    n, nx, ny, nq, clock = held.shape[0], model.nx, model.ny, model.np, point.clock
    nt = nq + clock.delay_free + nx
    times = segment.start_s + clock.period * np.arange(n)
    fold, p = _fold(model, point), model.parameters(point.theta)
    data = np.concatenate([p, [clock.fraction_s, clock.period - clock.fraction_s]])
    z = np.concatenate([point.x0, np.hstack([np.zeros((nx, nt - nx)), np.eye(nx)]).ravel(order="F")])
    w = np.column_stack([times, held[:, :-1]])
    path = [z[:, None]]
    for start in range(0, n, CHUNK):
        part = w[start : start + CHUNK]
        if len(part) < CHUNK:
            part = np.vstack([part, np.repeat(part[-1:], CHUNK - len(part), axis=0)])
        block = np.array(fold(path[-1][:, -1], part.T, data))
        path.append(block[:, : min(CHUNK, n - start)])
    z_all = np.hstack(path).T
    x = z_all[:, :nx]
    s = z_all[:-1, nx:].reshape(n, nt, nx)  # vec() stacks columns
    now = held[:, model.nu : 2 * model.nu] if clock.fraction_s > 0 else held[:, : model.nu]
    key = f"outputs{n}"
    if key not in model.functions:
        model.functions[key] = output_function(model).map(n)
    found = model.functions[key](times, x[:-1].T, now.T, np.repeat(p[:, None], n, 1))
    y, c, d = (np.array(item) for item in found)
    c = c.reshape(ny, n, nx).transpose(1, 0, 2)
    dy = np.einsum("noi,nti->not", c, s)
    if nq:
        dy[:, :, :nq] += d.reshape(ny, n, nq).transpose(1, 0, 2)
    return y.T, dy, x


def _columns(
    segment: Segment,
    point: Point,
    weights: Weights,
    y: Float[np.ndarray, "n ny"],
    dy: Float[np.ndarray, "n ny nt"],
) -> tuple[Float[np.ndarray, "n ny nc"], Any]:
    assert segment.y is not None
    present = np.isfinite(segment.y)
    if segment.keep is not None:
        present &= segment.keep.astype(bool)
    residual = point.gain * y + point.offset - np.where(present, segment.y, 0.0)
    v = np.concatenate([residual[:, :, None], point.gain[:, None] * dy, np.ones((*y.shape, 1)), y[:, :, None]], axis=2)
    v[~present] = 0.0
    if len(weights.sections):
        from scipy.signal import sosfilt

        sos = np.insert(weights.sections, 3, 1.0, axis=1)
        v = np.asarray(sosfilt(sos, v, axis=0))
    present[: weights.settle] = False
    return v, present
