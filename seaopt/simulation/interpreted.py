"""The pass without a compiler: NumPy for linear plants, CasADi's virtual machine for the others.

The log of a linear plant is cut into chunks of `ABREAST` samples, which start at rest and run side by side; what each
inherits from the one before is added to it (superposition), so that Python's loops are over a chunk and over chunks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float, Int

from seaopt.plants.memo import memo
from seaopt.records import record
from seaopt.signals import VectorM, VectorN, VectorX
from seaopt.simulation.discretisation import Hold, transition
from seaopt.simulation.integrator import output_function, step_function
from seaopt.simulation.model import Model
from seaopt.simulation.passes import Layout, Pass, Point, Segment, Weights, layout_of

ABREAST = 64  # few, as the power of an unstable plant's matrix up to this one is taken
FOLDED_SAMPLES = 4096  # that CasADi's virtual machine chains in one call

# Outputs, their derivatives, and states.
Trajectory = tuple[Float[np.ndarray, "n ny"], Float[np.ndarray, "n ny nt"], Float[np.ndarray, "n nx"]]


@np.errstate(all="ignore")  # a plant that overflows gives numbers that are not finite, as the compiled pass does
def interpret_pass(
    model: Model, segment: Segment, point: Point, weights: Weights, stop: int, x0: VectorX, *, changes: bool = False
) -> Pass:
    """Run the samples before `stop` in NumPy and CasADi's virtual machine; keep outputs, columns and states."""
    layout, forcing = layout_of(model.nx, model.ny, model.np, point), _inputs_in_force(model, segment, point)[:stop]
    if model.linear and point.correction is None:
        (y, dy, x), changed = _linear_trajectory(model, layout, point, forcing, x0), None
    else:
        (y, dy, x), changed = _folded_trajectory(model, segment, point, forcing, x0, changes=changes)
    ny, nc, v = model.ny, layout.columns, None
    gram, loss, count = np.zeros((ny, nc, nc)), np.zeros(ny), np.zeros(ny)
    if segment.y:
        v, present = _columns(segment, point, weights, layout, y, dy)
        for o in range(ny):
            kept = v[present[:, o], o]
            losses, weight = _loss_and_weight(kept[:, 0], weights.loss, float(weights.knee[o]))
            gram[o] = (kept * weight[:, None]).T @ kept
            loss[o], count[o] = float(np.sum(losses)), float(len(kept))
    return Pass(gram=gram, loss=loss, count=count, outputs=y, columns=v, states=x, changes=changed)


def _loss_and_weight(r: VectorN, loss: str, knee: float) -> tuple[VectorN, VectorN]:
    """Return the loss of each residual and the weight that makes its square's gradient the loss's."""
    size = np.abs(r)
    if loss == "soft_l1":
        root = np.sqrt(1.0 + (r / knee) ** 2)
        return knee**2 * (root - 1.0), 1.0 / root
    if loss == "square" or not np.isfinite(knee):
        return 0.5 * r**2, np.ones_like(r)
    inside = size <= knee
    return np.where(inside, 0.5 * r**2, knee * (size - 0.5 * knee)), np.where(
        inside, 1.0, knee / np.maximum(size, 1e-300)
    )


def _inputs_in_force(model: Model, segment: Segment, point: Point) -> Float[np.ndarray, "n w"]:
    """Return [u_a, u_b, ..., 1] of every sample; of a nonlinear plant that follows readings, also the inputs of the
    four samples around, and of one that reads its own states those of the next.
    """
    n, u = segment.n, np.column_stack(segment.u)
    rows = segment.lead + np.arange(n)
    inputs = (u[np.clip(rows - lag, 0, len(u) - 1)] for lag in _list_lags(model, point))
    return np.hstack([*inputs, np.ones((n, 1))])


def _list_lags(model: Model, point: Point) -> tuple[int, ...]:
    around = (1, 0, -1, -2) if model.reads and not model.linear else ()
    return (*point.clock.lags, *around, *((-1,) if model.read_states[0] else ()))


def _linear_trajectory(
    model: Model, layout: Layout, point: Point, forcing: Float[np.ndarray, "n w"], x0: VectorX
) -> Trajectory:
    """Return the trace of a linear plant: the state first, which with the inputs drives its derivatives."""
    nx, count = model.nx, layout.states - 1
    blocks = transition(model, point.theta, point.clock)
    a, c = blocks[0, :nx, :nx], blocks[0, nx:, :nx]
    x = _run_abreast(a, x0[:, None], (forcing @ blocks[0, :nx, nx:].T)[:, :, None])[:, :, 0]
    driven = np.zeros((len(forcing), nx + model.ny, count))
    driven[:, :, : len(blocks) - 1] = np.moveaxis(np.hstack([x, forcing]) @ blocks[1:].transpose(0, 2, 1), 0, 2)
    start = np.zeros((nx, count))
    start[:, layout.shared : layout.shared + nx] = np.eye(nx)
    s = _run_abreast(a, start, driven[:, :nx])
    return x @ c.T + forcing @ blocks[0, nx:, nx:].T, c @ s + driven[:, nx:], x


def _run_abreast(
    a: Float[np.ndarray, "nx nx"], start: Float[np.ndarray, "nx nc"], driven: Float[np.ndarray, "n nx nc"]
) -> Float[np.ndarray, "n nx nc"]:
    """Return z_0 to z_{n-1} of z_{k+1} = a z_k + driven_k."""
    (n, nx, nc), count = driven.shape, -(-len(driven) // ABREAST)
    padded = np.zeros((count * ABREAST, nx, nc))
    padded[:n] = driven
    forces = padded.reshape(count, ABREAST, nx, nc).transpose(1, 2, 0, 3).reshape(ABREAST, nx, count * nc)
    z = np.zeros((ABREAST + 1, nx, count * nc))
    for i in range(ABREAST):
        z[i + 1] = a @ z[i] + forces[i]
    power, ends = np.linalg.matrix_power(a, ABREAST), z[ABREAST].reshape(nx, count, nc)
    inherited = np.empty((nx, count, nc))
    for k in range(count):
        inherited[:, k] = start
        start = power @ start + ends[:, k]
    late = inherited.reshape(nx, count * nc)
    for i in range(ABREAST):
        z[i] += late
        late = a @ late
    return z[:ABREAST].reshape(ABREAST, nx, count, nc).transpose(2, 0, 1, 3).reshape(-1, nx, nc)[:n]


def _split(model: Model, scheme: _Scheme, w: Any) -> tuple[Any, list[Any], list[Any]]:
    """Return t, the inputs in force, and those of the samples around, of a sample's data."""
    nu = model.nu
    rows = [w[2 + i * nu : 2 + (i + 1) * nu] for i in range(scheme.rows)]
    return w[0], rows[: scheme.inputs], rows[scheme.inputs : scheme.inputs + (4 if model.reads else 0)]


def _blocks(model: Model, scheme: _Scheme, data: Any) -> list[Any]:
    """Return the blocks of `transition` from its numbers."""
    rows, width = model.nx + model.ny, model.nx + scheme.inputs * model.nu + 1
    return [ca.reshape(part, width, rows).T for part in ca.vertsplit(data, rows * width)]


@record
class _Scheme:
    """How samples are stepped: all of a `Point` that expressions depend on."""

    hold: Hold
    delay_free: bool
    fractional: bool  # older inputs act for the first part of a period
    inputs: int  # in force
    rows: int  # of inputs, in a sample's data
    steps: tuple[int, ...]  # numbers of steps that samples take

    @classmethod
    def of(cls, model: Model, point: Point, steps: Int[np.ndarray, " m"]) -> _Scheme:
        clock = point.clock
        return cls(
            hold=clock.hold,
            delay_free=clock.delay_free,
            fractional=clock.fraction_s > 0.0,
            inputs=len(clock.lags),
            rows=len(_list_lags(model, point)),
            steps=tuple(steps.tolist()),
        )


def _advance(model: Model, scheme: _Scheme, layout: Layout, z: Any, w: Any, data: Any) -> Any:
    """Return the state and its derivatives one sample on, in as many steps as it takes."""
    if len(scheme.steps) == 1:
        return _take_steps(model, scheme, layout, z, w, data, steps=scheme.steps[0])
    arguments = [ca.MX.sym(name, *value.shape) for name, value in (("z", z), ("w", w), ("data", data))]
    ways = [
        ca.Function("steps", arguments, [_take_steps(model, scheme, layout, *arguments, steps=steps)])
        for steps in scheme.steps
    ]
    return ca.Function.conditional("advance", ways[:-1], ways[-1])(w[1], z, w, data)


def _take_steps(model: Model, scheme: _Scheme, layout: Layout, z: Any, w: Any, data: Any, *, steps: int) -> Any:
    nx, nu = model.nx, model.nu
    t, inputs, read = _split(model, scheme, w)
    x, s = z[:, 0], z[:, 1:]
    padding = ca.MX.zeros(nx, layout.states - 1 - model.np - scheme.delay_free)
    if model.linear:
        blocks, v = [block[:nx, :] for block in _blocks(model, scheme, data)], ca.vertcat(x, *inputs, 1.0)
        forced = ca.horzcat(*(ca.mtimes(block, v) for block in blocks[1:]), padding)
        return ca.horzcat(ca.mtimes(blocks[0], v), ca.mtimes(blocks[0][:, :nx], s) + forced)
    step, p, period = step_function(model), data[:-2], data[-2] + data[-1]
    joined = scheme.hold == "first"
    for part in (0, 1) if scheme.delay_free or scheme.fractional else (1,):
        h, dh = data[data.numel() - 2 + part] / steps, (-1.0 if part else 1.0) / steps
        base = inputs[0] if joined or part else inputs[1]
        slope = (inputs[1] - inputs[0] if part else inputs[0] - inputs[-1]) / period if joined else ca.MX.zeros(nu)
        for i in range(steps) if part else range(-steps, 0):  # the older line ends at u_a, the newer begins there
            ends, moved = [base + slope * h * k for k in (i, i + 1)], [slope * dh * k for k in (i, i + 1)]
            for end, k in enumerate((i, i + 1)) if read else ():
                curve, rate = _follow(read, (data[-2] + h * k) / period)
                ends[end] = _put_readings(model, ends[end], curve)
                # The delay moves where steps begin on a reading's curve.
                moved[end] = _put_readings(model, moved[end], rate * (1.0 + dh * k) / period)
            x, a, b = step(t, x, *ends, p, h)
            forced = [b[:, : model.np]]
            if scheme.delay_free:
                along = ca.vertcat(dh, *moved)
                forced.append(ca.mtimes(b[:, model.np :], along))
            s = ca.mtimes(a, s) + ca.horzcat(*forced, padding)
            t = t + h
    after, sampling = ca.horzcat(x, s), model.plant.sampling
    if sampling is not None:
        rows, weights = sampling.matrix(tuple(model.plant.states))
        if rows:
            after[rows, :] = ca.mtimes(ca.DM(weights), z)
        kept, read, keeps = model.read_states
        if kept:
            following = w[2 + (scheme.rows - 1) * nu + keeps]
            after[kept, :] = ca.if_else(following > 0.0, after[kept, :], after[read, :])
    return after


def _follow(read: list[Any], s: Any) -> tuple[Any, Any]:
    """Return the inputs at a place s in the period and their rates per period, of a curve through samples around."""
    before, now, after, later = read
    c1, c3 = 0.5 * (after - before), 0.5 * (later - before) + 1.5 * (now - after)
    c2 = after - now - c1 - c3
    return now + s * (c1 + s * (c2 + s * c3)), c1 + s * (2.0 * c2 + 3.0 * s * c3)


def _put_readings(model: Model, inputs: Any, readings: Any) -> Any:
    """Return inputs with the last ones, which are readings, in their place."""
    first = model.nu - model.reads
    return ca.vertcat(inputs[:first], readings[first:])


def _observe(model: Model, scheme: _Scheme, layout: Layout, z: Any, w: Any, data: Any) -> Any:
    """Return the outputs and their derivatives."""
    t, inputs, read = _split(model, scheme, w)
    x, s = z[:, 0], z[:, 1:]
    if model.linear:
        blocks, v = [block[model.nx :, :] for block in _blocks(model, scheme, data)], ca.vertcat(x, *inputs, 1.0)
        y, c = ca.mtimes(blocks[0], v), blocks[0][:, : model.nx]
        direct = [ca.mtimes(block, v) for block in blocks[1:]]
    else:
        u, du = inputs[1] if scheme.fractional else inputs[0], ca.MX.zeros(model.nu)
        if scheme.hold == "first":
            du = (inputs[-1] - inputs[0]) / (data[-2] + data[-1]) if scheme.inputs == 3 else du
            u = inputs[0] + data[-2] * du
        if read:
            u, du = _put_readings(model, u, read[1]), _put_readings(model, du, ca.MX.zeros(model.nu))
        y, c, d, by_input = output_function(model)(t, x, u, data[:-2])
        direct = [d, ca.mtimes(by_input, du)] if scheme.delay_free else [d]
    count = sum(block.shape[1] for block in direct)
    return ca.horzcat(y, ca.mtimes(c, s) + ca.horzcat(*direct, ca.MX.zeros(model.ny, layout.states - 1 - count)))


def _correct(layout: Layout, z: Any, y: Any, w: Any, sensors: Any) -> Any:
    """Return what the prediction errors take off the next state and its derivatives. w ends in [measured, present,
    drift basis]; known is [offset, gain, drift, correction and its derivatives].
    """
    nx, ny, nd = layout.nx, layout.ny, layout.drift_terms
    measured, present, basis = ca.vertsplit(w, [0, ny, 2 * ny, 2 * ny + nd])
    offset, gain, drift, correction = ca.vertsplit(sensors, [0, ny, 2 * ny, (2 + nd) * ny, sensors.numel()])
    coefficients = ca.reshape(drift, nd, ny).T
    gains = [ca.reshape(part, ny, nx).T for part in ca.vertsplit(correction, nx * ny)]
    rows = []
    for o in range(ny):
        value = gain[o] * y[o, 0] + offset[o] + ca.mtimes(coefficients[o, :], basis) - measured[o]
        sensor_columns = ca.vertcat(1.0, basis, y[o, 0])
        before = ca.MX.zeros(layout.shared + nx + o * layout.per_output)
        after = ca.MX.zeros((ny - 1 - o) * layout.per_output)
        derivative = gain[o] * y[o, 1:] + ca.vertcat(before, sensor_columns, after).T
        rows.append(present[o] * ca.horzcat(value, derivative))
    v = ca.vertcat(*rows)
    moved = ca.horzcat(*(ca.mtimes(g, v[:, 0]) for g in gains[1:]), ca.MX.zeros(nx, layout.states - len(gains)))
    return ca.mtimes(gains[0], v) + ca.horzcat(ca.MX.zeros(nx, 1), moved)


@memo
def _program(model: Model, layout: Layout, scheme: _Scheme, sizes: tuple[int, int, int]) -> tuple[Any, Any]:
    """Return CasADi's (Z, w, data) -> Z+ and (Z, w, data) -> [y, derivatives], of one sample. The sizes are those of w,
    of the plant's part of the data, and of all data.
    """
    z, w = ca.MX.sym("z", model.nx, layout.states), ca.MX.sym("w", sizes[0])
    data = ca.MX.sym("data", sizes[2])
    plant = data[: sizes[1]]
    y = _observe(model, scheme, layout, z, w, plant)
    after = _advance(model, scheme, layout, z, w, plant)
    if layout.corrected:
        after = after - _correct(layout, z, y, w[2 + scheme.rows * model.nu :], data[sizes[1] :])
    return ca.Function("sample", [z, w, data], [after]), ca.Function("output", [z, w, data], [y])


@memo
def _chain(model: Model, layout: Layout, scheme: _Scheme, sizes: tuple[int, int, int], n: int) -> Any:
    """Return the state's function of `_program` over n samples, one after the other."""
    return _program(model, layout, scheme, sizes)[0].mapaccum(n)


@memo
def _output_map(model: Model, layout: Layout, scheme: _Scheme, sizes: tuple[int, int, int], n: int) -> Any:
    """Return the outputs' function of `_program` for n samples at once."""
    return _program(model, layout, scheme, sizes)[1].map(n)


def _fold(
    chain: Callable[[int], Any], z: Float[np.ndarray, "nx nj"], w: Float[np.ndarray, "n w"], data: VectorM
) -> Float[np.ndarray, "n1 nx nj"]:
    """Fold over all samples at most FOLDED_SAMPLES at a time; the last ones are filled up to a power of two, so that
    few functions do for all lengths, with repeats, which are dropped.
    """
    n, (nx, nj) = len(w), z.shape
    path = np.empty((n + 1, nx, nj))
    path[0] = z
    for start in range(0, n, FOLDED_SAMPLES):
        part, count = w[start : start + FOLDED_SAMPLES], min(FOLDED_SAMPLES, n - start)
        size = 1 << (count - 1).bit_length()
        part = np.vstack([part, np.repeat(part[-1:], size - count, axis=0)])
        block = np.array(chain(size)(path[start], part.T, data)).reshape(nx, size, nj)
        path[start + 1 : start + 1 + count] = block.transpose(1, 0, 2)[:count]
    return path


def _folded_trajectory(
    model: Model, segment: Segment, point: Point, forcing: Float[np.ndarray, "n w"], x0: VectorX, *, changes: bool
) -> tuple[Trajectory, Float[np.ndarray, "n nx"] | None]:
    """Return the trace of a nonlinear plant, or of one whose state each prediction error corrects, and by how much
    steps of half the length change its states, if that is wanted.
    """
    counts = point.count_steps(segment)
    steps, which = np.unique(counts[: max(len(forcing), 1)], return_inverse=True)
    which = which[: len(forcing)]
    layout, scheme = layout_of(model.nx, model.ny, model.np, point), _Scheme.of(model, point, steps)
    clock, time = point.clock, segment.start_s + point.clock.period * np.arange(len(forcing))
    if model.linear:
        data = transition(model, point.theta, clock).ravel()
    else:
        data = np.append(model.parameters(point.theta), (clock.fraction_s, clock.period - clock.fraction_s))
    w, plant_size = np.column_stack([time, which, forcing[:, :-1]]), data.size
    if point.correction is not None:
        measured, present = read_measured(segment, len(forcing))
        w = np.hstack([w, measured, present, segment.drift_basis(slice(0, len(forcing)), layout.drift_terms)])
        sensors = (point.offset, point.gain, point.drift, point.correction)
        data = np.concatenate([data, *(np.asarray(values).ravel() for values in sensors)])
    sizes, n = (w.shape[1], plant_size, data.size), len(w)
    start = np.zeros((model.nx, layout.states))
    start[:, 0] = x0
    start[:, 1 + layout.shared : 1 + layout.shared + model.nx] = np.eye(model.nx)
    path = _fold(lambda count: _chain(model, layout, scheme, sizes, count), start, w, data)
    flat = path[:-1].transpose(1, 0, 2).reshape(model.nx, n * layout.states)
    outputs = _output_map(model, layout, scheme, sizes, n)(flat, w.T, np.repeat(data[:, None], n, 1))
    y, changed = np.array(outputs).reshape(model.ny, n, layout.states).transpose(1, 0, 2), None
    if changes:
        halved = _program(model, layout, _Scheme.of(model, point, 2 * steps), sizes)[0].map(n)
        after = np.array(halved(flat, w.T, np.repeat(data[:, None], n, 1))).reshape(model.nx, n, layout.states)
        changed = after[:, :, 0].T - path[1:, :, 0]
    return (y[:, :, 0], y[:, :, 1:], path[:-1, :, 0]), changed


def read_measured(segment: Segment, stop: int) -> tuple[Float[np.ndarray, "n ny"], Any]:
    """Return the measured outputs, zero where missing, and which are present."""
    measured = np.column_stack([channel[:stop] for channel in segment.y])
    present = np.isfinite(measured)
    if segment.keep:
        present &= np.column_stack([mask[:stop] for mask in segment.keep]).astype(bool)
    return np.where(present, measured, 0.0), present


def _columns(
    segment: Segment,
    point: Point,
    weights: Weights,
    layout: Layout,
    y: Float[np.ndarray, "n ny"],
    dy: Float[np.ndarray, "n ny nt"],
) -> tuple[Float[np.ndarray, "n ny nc"], Any]:
    """Return v of every sample, and which samples count."""
    measured, present = read_measured(segment, len(y))
    basis = segment.drift_basis(slice(0, len(y)), point.drift_terms)
    v = np.zeros((len(y), layout.ny, layout.columns))
    v[:, :, 0] = point.read(y.T, segment, slice(0, len(y))).T - measured
    v[:, :, 1 : 1 + dy.shape[2]] = point.gain[:, None] * dy
    for o in range(layout.ny):
        first = 1 + layout.shared + layout.nx + (o * layout.per_output if layout.corrected else 0)
        v[:, o, first] += 1.0
        v[:, o, first + 1 : first + 1 + point.drift_terms] += basis
        v[:, o, first + layout.per_output - 1] += y[:, o]
    v[~present] = 0.0
    if len(weights.sections):
        from scipy.signal import sosfilt

        sos = np.insert(weights.sections, 3, 1.0, axis=1)
        v = np.asarray(sosfilt(sos, v, axis=0))
    present[: weights.settle] = False
    return v, present
