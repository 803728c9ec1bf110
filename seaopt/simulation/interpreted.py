"""The pass without a compiler: the state and its sensitivities, sample by sample in NumPy.

What changes from plant to plant is one function of a sample, (Z, k) -> (Z+, Y), where Z is the state with its
derivatives behind it, one column per unknown, and Y the outputs with theirs: of a linear plant products of its exact
matrices, of others CasADi's step with its derivatives.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from seaopt.simulation.direct_call import DirectCall
from seaopt.simulation.discretisation import transition
from seaopt.simulation.integrator import output_function, step_function
from seaopt.simulation.model import Model
from seaopt.simulation.passes import Layout, Pass, Point, Segment, Weights, layout_of

Columns = Float[np.ndarray, "_ nj"]
Sample = Callable[[Columns, int], tuple[Columns, Columns]]


@np.errstate(all="ignore")  # a plant that overflows gives numbers that are not finite, as the compiled pass does
def interpret_pass(
    model: Model, segment: Segment, point: Point, weights: Weights, stop: int, x0: Float[np.ndarray, " nx"]
) -> Pass:
    """Run the samples before `stop`, and keep outputs, columns and states."""
    layout, gains = layout_of(model.nx, model.ny, model.np, point), point.correction
    sample = (_linear_sample if model.linear else _nonlinear_sample)(model, segment, point)
    z = np.zeros((model.nx, layout.states))
    z[:, 0] = x0
    z[:, 1 + layout.shared : 1 + layout.shared + model.nx] = np.eye(model.nx)
    y, states = np.empty((stop, model.ny, layout.states)), np.empty((stop, model.nx))
    for k in range(stop):
        states[k] = z[:, 0]
        z, y[k] = sample(z, k)
        if gains is not None:
            (v,), _ = _compare(segment, point, layout, y[k : k + 1], slice(k, k + 1))
            z -= gains[0] @ v
            z[:, 1 : len(gains)] -= (gains[1:] @ v[:, 0]).T
    ny, nc, columns = model.ny, layout.columns, None
    gram, loss, count = np.zeros((ny, nc, nc)), np.zeros(ny), np.zeros(ny)
    if segment.y:
        columns, counts = _compare(segment, point, layout, y, slice(0, stop))
        if len(weights.sections):
            from scipy.signal import sosfilt  # deferred: scipy is slow to load

            columns = np.asarray(sosfilt(np.insert(weights.sections, 3, 1.0, axis=1), columns, axis=0))
        counts[: weights.settle] = False
        for o in range(ny):
            v = columns[counts[:, o], o]
            losses, weight = _loss_and_weight(v[:, 0], weights.loss, float(weights.knee[o]))
            gram[o] = (v * weight[:, None]).T @ v
            loss[o], count[o] = float(np.sum(losses)), float(len(v))
    return Pass(gram=gram, loss=loss, count=count, outputs=y[:, :, 0].copy(), columns=columns, states=states)


def _linear_sample(model: Model, segment: Segment, point: Point) -> Sample:
    """Return the function of a sample of a linear plant."""
    nx, blocks = model.nx, transition(model, point.theta, point.clock)
    matrix, driving = blocks[0, :, :nx].copy(), blocks
    driving[0, :, :nx] = 0.0  # the state itself goes through `matrix`
    inputs = _inputs_in_force(segment, point).reshape(segment.n, -1)

    def sample(z: Columns, k: int) -> tuple[Columns, Columns]:
        both = matrix @ z
        both[:, : len(driving)] += (driving @ np.concatenate((z[:, 0], inputs[k], (1.0,)))).T
        return both[:nx], both[nx:]

    return sample


def _nonlinear_sample(model: Model, segment: Segment, point: Point) -> Sample:
    """Return the function of a sample of another plant.

    With a fraction of a delay an older input acts first: u_b held, or the line from u_c to u_a; then u_a held, or the
    line from u_a to u_b.
    """
    step, output = DirectCall(step_function(model)), DirectCall(output_function(model))
    clock, count, p = point.clock, model.np, model.parameters(point.theta)
    inputs, fraction_s, joined = _inputs_in_force(segment, point), clock.fraction_s, clock.hold == "first"
    level = np.zeros(model.nu)

    def observe(z: Columns, t: float, held: Float[np.ndarray, "lags nu"]) -> Columns:
        slope = (held[-1] - held[0]) / clock.period if joined and clock.split else level
        u = held[1] if fraction_s > 0.0 and not joined else held[0] + fraction_s * slope
        y, by_state, by_theta, by_input = output(t, z[:, 0], u, p)
        both = by_state @ z
        both[:, :1] = y
        both[:, 1 : 1 + count] += by_theta
        if clock.delay_free:
            both[:, 1 + count] += by_input @ slope
        return both

    def advance(z: Columns, t: float, held: Float[np.ndarray, "lags nu"]) -> Columns:
        older = (held[0] - held[-1] if joined else level) / clock.period
        newer = (held[1] - held[0] if joined else level) / clock.period
        parts = [(held[0], newer, range(point.substeps), clock.period - fraction_s, -1.0)]
        if clock.split:  # the older line ends at u_a, where the newer one begins
            parts.insert(0, (held[0 if joined else 1], older, range(-point.substeps, 0), fraction_s, 1.0))
        for base, slope, steps, lasting_s, growth in parts:
            h, dh = lasting_s / point.substeps, growth / point.substeps  # the delay makes h longer, by dh a second
            for i in steps:
                x, by_state, moved = step(t, z[:, 0], base + slope * h * i, base + slope * h * (i + 1), p, h)
                z = by_state @ z
                z[:, :1] = x
                z[:, 1 : 1 + count] += moved[:, :count]
                if clock.delay_free:
                    z[:, 1 + count] += moved[:, count:] @ np.concatenate(((dh,), slope * dh * i, slope * dh * (i + 1)))
                t += h
        return z

    def sample(z: Columns, k: int) -> tuple[Columns, Columns]:
        t, sampling = segment.start_s + k * clock.period, model.plant.sampling
        after = advance(z, t, inputs[k])
        if sampling is not None:
            rows, weights = sampling.matrix(tuple(model.plant.states))
            after[rows] = weights @ z
        return after, observe(z, t, inputs[k])

    return sample


def _inputs_in_force(segment: Segment, point: Point) -> Float[np.ndarray, "n lags nu"]:
    """Return u_a, u_b, ... of every sample; before and after the log the first and the last input act."""
    u = np.column_stack(segment.u)
    rows = segment.lead + np.arange(segment.n)[:, None] - np.array(point.clock.lags)
    return u[np.clip(rows, 0, len(u) - 1)]


def _compare(
    segment: Segment, point: Point, layout: Layout, y: Float[np.ndarray, "m ny nj"], rows: slice
) -> tuple[Float[np.ndarray, "m ny nc"], Bool[np.ndarray, "m ny"]]:
    """Return v of the samples in `rows`, zero where an output is missing, and which are there."""
    measured = np.column_stack([channel[rows] for channel in segment.y])
    present = np.isfinite(measured)
    if segment.keep:
        present &= np.column_stack([mask[rows] for mask in segment.keep]).astype(bool)
    v = np.zeros((*measured.shape, layout.columns))
    v[:, :, : layout.states] = point.gain[:, None] * y
    v[:, :, 0] = point.read(y[:, :, 0].T, segment, rows).T - measured
    basis = segment.drift_basis(rows, point.drift_terms)
    for o in range(layout.ny):
        first = 1 + layout.shared + layout.nx + (o * layout.own if layout.corrected else 0)
        v[:, o, first] += 1.0
        v[:, o, first + 1 : first + 1 + point.drift_terms] += basis
        v[:, o, first + layout.own - 1] += y[:, o, 0]
    v[~present] = 0.0
    return v, present


def _loss_and_weight(
    r: Float[np.ndarray, " n"], loss: str, knee: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the loss of each residual and the weight that makes its square's gradient the loss's."""
    if loss == "soft_l1":
        root = np.sqrt(1.0 + (r / knee) ** 2)
        return knee**2 * (root - 1.0), 1.0 / root
    if loss == "square" or not np.isfinite(knee):
        return 0.5 * r**2, np.ones_like(r)
    size = np.maximum(np.abs(r), 1e-300)
    inside = size <= knee
    return np.where(inside, 0.5 * r**2, knee * (size - 0.5 * knee)), np.where(inside, 1.0, knee / size)
