"""The passes, compiled where there is a compiler and interpreted where there is none."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.simulation.compiled import Program
from seaopt.simulation.discretisation import check_period
from seaopt.simulation.interpreted import interpret_pass
from seaopt.simulation.model import Model
from seaopt.simulation.passes import Pass, Point, Segment, Weights

STREAM_SAMPLES = 1 << 16  # of a stream that are in memory at a time


def run_passes(
    model: Model,
    segment: Segment,
    point: Point,
    x0: Float[np.ndarray, " nx"],
    weights: Weights | None = None,
    *,
    stop: int | None = None,
    sums: bool = True,
    outputs: bool = False,
    output_rows: int | None = None,
    columns: bool = False,
    states: bool = False,
) -> Pass:
    """Run a segment, or its first samples, from a state.

    Parameters
    ----------
    model, segment, point, weights
        What is simulated, on which data, with which unknowns, and how residuals are weighted (not at all if None).
    x0 : array, shape (nx,)
        State at the first sample.
    stop : int, optional
        Run so many first samples; all if left out.
    sums : bool
        Whether Gram matrices, losses, counts and derivatives are wanted: a simulation alone is several times quicker.
        Without measured outputs compiled code makes none.
    outputs, columns, states : bool
        Keep the model outputs, the residuals with their derivatives, the state trajectory.
    output_rows : int, optional
        Keep the outputs of so many first samples only.

    Returns
    -------
    Pass
        Numbers that are not finite where the simulation left what floats can hold.
    """
    check_period(model, point.clock)
    chosen = weights if weights is not None else Weights.plain(model.ny)
    last = segment.n if stop is None else stop
    program = Program.make(model, segment, point, chosen)
    if program is not None:
        return program.run(
            0, last, x0, sums=sums, outputs=outputs, output_rows=output_rows, columns=columns, states=states
        )
    result = interpret_pass(model, segment, point, chosen, last, x0)
    assert result.outputs is not None
    return replace(
        result,
        outputs=result.outputs[:output_rows] if outputs else None,
        columns=result.columns if columns else None,
        states=result.states if states else None,
    )


def stream(
    model: Model,
    segment: Segment,
    point: Point,
    x0: Float[np.ndarray, " nx"],
    weights: Weights | None = None,
    *,
    chunk: int = STREAM_SAMPLES,
    columns: bool = False,
) -> Iterator[Pass]:
    """Yield the outputs, and the columns if asked, of one segment chunk by chunk, in the memory of one chunk.

    A chunk's arrays are written over by the next. There are no sums.
    """
    chosen = weights if weights is not None else Weights.plain(model.ny)
    program = Program.make(model, segment, point, chosen)
    if program is None:
        whole = interpret_pass(model, segment, point, chosen, segment.n, x0)
        assert whole.outputs is not None
        for start in range(0, segment.n, chunk):
            rows = slice(start, start + chunk)
            v = whole.columns[rows] if columns and whole.columns is not None else None
            yield replace(whole, outputs=whole.outputs[rows], columns=v, states=None)
        return
    carry, part = program.carry(), None
    for start in range(0, segment.n, chunk):
        end = min(start + chunk, segment.n)
        part = program.run(start, end, x0, sums=False, outputs=True, columns=columns, resume=carry, room=part)
        yield part


def double_sum(
    model: Model,
    segment: Segment,
    point: Point,
    x0: Float[np.ndarray, " nx"],
    weights: Weights,
    into: Float[np.ndarray, "ny p nc"],
    r: Float[np.ndarray, "lags1 ny ny"],
) -> Float[np.ndarray, "2 p p"] | None:
    """Return the sum over t and s of a(t)' R(t - s) a(s), and of it what t = s gives; None where there is no compiler.

    Both are summed in one pass.

    Parameters
    ----------
    model, segment, point, x0, weights
        As of `run_passes`.
    into : array, shape (ny, p, nc)
        Takes the column v of an output to its influence a on p estimates; its first column is zero.
    r : array, shape (lags + 1, ny, ny)
        R(k)[a, b] of output a with output b so many samples before; R(-k) = R(k)'. Time grows with the lags.
    """
    program = Program.make(model, segment, point, weights)
    return None if program is None else program.double_sum(x0, into, r)
