"""The passes, compiled where there is a compiler and interpreted where there is none."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from threading import Lock
from typing import Any, TypeAlias

import numpy as np

from seaopt.signals import VectorX
from seaopt.simulation.compiled import Program, double_sum_of_columns
from seaopt.simulation.discretisation import check_period
from seaopt.simulation.interpreted import interpret_pass, read_measured
from seaopt.simulation.model import Model
from seaopt.simulation.parts import count_parts, find_run_up, guess_run_up
from seaopt.simulation.passes import DoubleSum, Influence, Lagged, Pass, Point, Segment, Weights

STREAM_SAMPLES = 1 << 16  # of a stream that are in memory at a time
KEPT_BYTES = 1 << 28  # of the passes that are kept at a time
ATTEMPTS = 2  # at a pass in parts, the second with the run-up that the first asks for

Asked: TypeAlias = tuple[Model, Segment, Point, VectorX, Weights]  # of a pass: what is simulated, from which state


class _Kept:
    """The last passes, as many as there is room for, with the models and segments that their keys name by identity.

    Threads of a fit share it.
    """

    def __init__(self) -> None:
        self._passes: dict[Any, tuple[Pass, Model, Segment]] = {}
        self._run_ups: dict[int, tuple[int, Segment]] = {}
        self._bytes = 0
        self._lock = Lock()

    def find(self, key: Any, rows: int, *, columns: bool) -> Pass | None:
        """Return a pass that has the outputs of so many samples, and columns if wanted."""
        result, *_ = self._passes.get(key, (None,))
        if result is None or (rows and (result.outputs is None or len(result.outputs) < rows)):
            return None
        return None if columns and result.columns is None else result

    def add(self, key: Any, result: Pass, model: Model, segment: Segment) -> None:
        """Keep a pass, and fewer of the older ones."""
        for array in (result.outputs, result.columns):
            if array is not None:
                array.flags.writeable = False
        with self._lock:
            self._drop(key)
            self._passes[key] = result, model, segment
            self._bytes += _measure_bytes(result)
            while self._bytes > KEPT_BYTES:
                self._drop(next(iter(self._passes)))

    def find_run_up(self, segment: Segment) -> int | None:
        """Return in how many samples of a segment a state is forgotten, 0 where they are too many; None: not known."""
        return self._run_ups.get(id(segment), (None, segment))[0]

    def keep_run_up(self, segment: Segment, samples: int) -> None:
        """Keep in how many samples of a segment a state is forgotten."""
        self._run_ups[id(segment)] = samples, segment

    def _drop(self, key: Any) -> None:
        if key in self._passes:
            self._bytes -= _measure_bytes(self._passes.pop(key)[0])


_kept: ContextVar[_Kept | None] = ContextVar("kept", default=None)


@contextmanager
def keep_passes() -> Generator[None]:
    """Keep passes meanwhile: what is asked of them again is not simulated again."""
    token = _kept.set(_Kept())
    try:
        yield
    finally:
        _kept.reset(token)


def measure_room() -> int:
    """Return how many bytes of passes with all their columns may be kept: for two of their kind; 0 if none are."""
    return 0 if _kept.get() is None else KEPT_BYTES // 2


def _measure_bytes(result: Pass) -> int:
    return result.gram.nbytes + sum(array.nbytes for array in (result.outputs, result.columns) if array is not None)


def _key(model: Model, segment: Segment, point: Point, x0: VectorX, weights: Weights) -> Any:
    """Return what tells passes apart; models and segments are told by their identity, for they are kept as well."""
    arrays = (point.theta, point.offset, point.gain, point.drift, point.correction, x0, weights.sections, weights.knee)
    numbers = tuple(None if array is None else array.tobytes() for array in arrays)
    steps = point.most_steps if segment.shares is None else (point.substeps, point.stable, point.halved)
    return id(model), id(segment), point.clock, steps, weights.settle, weights.loss, numbers


def run_passes(
    model: Model,
    segment: Segment,
    point: Point,
    x0: VectorX,
    weights: Weights | None = None,
    *,
    stop: int | None = None,
    sums: bool = True,
    outputs: bool = False,
    output_rows: int | None = None,
    columns: bool = False,
    states: bool = False,
    changes: bool = False,
    keep: bool = False,
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
    changes : bool
        Find by how much steps of half the length change each sample's next state.
    output_rows : int, optional
        Keep the outputs of so many first samples only.
    keep : bool
        Make all of the whole segment, for whoever asks for it later within `keep_passes`.

    Returns
    -------
    Pass
        Numbers that are not finite where the simulation left what floats can hold.
    """
    check_period(model, point.clock)
    chosen = weights if weights is not None else Weights.plain(model.ny)
    last = segment.n if stop is None else stop
    rows = (last if output_rows is None else min(output_rows, last)) if outputs else 0
    store = _kept.get()
    kept = store if sums and last == segment.n and not (states or changes) else None
    key = _key(model, segment, point, x0, chosen) if kept is not None else None
    result = kept.find(key, rows, columns=columns or keep) if kept is not None else None
    if result is None:
        whole = keep and kept is not None
        made = last if whole else rows
        in_lanes = store is not None and count_parts(segment.n) > 1 and store.find_run_up(segment) != 0
        program = Program.make(model, segment, point, chosen, in_lanes=in_lanes)
        if program is None:
            result = interpret_pass(model, segment, point, chosen, last, x0, changes=changes)
        elif kept is not None:
            asked = model, segment, point, x0, chosen
            result = _run_kept(kept, program, asked, output_rows=made, columns=columns or whole)
        else:
            result = program.run(
                0,
                last,
                x0,
                sums=sums,
                outputs=made > 0,
                output_rows=made,
                columns=columns,
                states=states,
                changes=changes,
            )
        if kept is not None:
            kept.add(key, result, model, segment)
    return replace(
        result,
        outputs=None if result.outputs is None or not outputs else result.outputs[:rows],
        columns=_choose_columns(result, slice(None)) if columns else None,
        chosen=None,
        states=result.states if states else None,
    )


def _run_kept(kept: _Kept, program: Program, asked: Asked, *, output_rows: int, columns: bool) -> Pass:
    """Run a whole segment with its sums: as parts at once, as long as none shows that it remembers a state for long."""
    model, segment, point, x0, weights = asked
    known = kept.find_run_up(segment)
    run_up = guess_run_up(segment.n) if known is None else known
    for _ in range(ATTEMPTS if program.joins and run_up else 0):
        result, sensitivities = program.run_parts(x0, run_up, output_rows=output_rows, columns=columns)
        if result is None or known is None:
            run_up = find_run_up(sensitivities, segment.n, least=2 * run_up if result is None else 0)
            kept.keep_run_up(segment, run_up)
        if result is not None:
            return result
        if not run_up:
            break
    alone = Program.make(model, segment, point, weights) if program.joins else program
    assert alone is not None
    return alone.run(0, segment.n, x0, outputs=output_rows > 0, output_rows=output_rows, columns=columns)


def keep_part(smaller: Asked, larger: Asked, columns: Sequence[int]) -> None:
    """Make the whole pass of a segment with more columns for whoever asks for it, and keep its part for who asks for
    these columns alone. Both are simulated alike, of the same plant and samples; there has to be room (`measure_room`).
    """
    kept = _kept.get()
    if kept is None:
        return
    model, segment, *_ = smaller
    run_up = kept.find_run_up(segment)
    if run_up is not None:
        kept.keep_run_up(larger[1], run_up)
    whole = run_passes(*larger, outputs=True, columns=True, keep=True)
    if whole.columns is not None:
        rows = np.array(columns)
        kept.add(_key(*smaller), replace(whole, gram=whole.gram[:, rows[:, None], rows], chosen=rows), model, segment)


def _choose_columns(result: Pass, rows: slice) -> Any:
    """Return the columns of some samples of a pass, of a part of another one those that are its own."""
    if result.columns is None or result.chosen is None:
        return None if result.columns is None else result.columns[rows]
    return result.columns[rows].take(result.chosen, axis=2)


def stream(
    model: Model,
    segment: Segment,
    point: Point,
    x0: VectorX,
    weights: Weights | None = None,
    *,
    chunk: int = STREAM_SAMPLES,
    columns: bool = False,
) -> Iterator[Pass]:
    """Yield the outputs, and the columns if asked, of one segment chunk by chunk, in the memory of one chunk.

    A chunk's arrays are written over by the next. There are no sums.
    """
    chosen = weights if weights is not None else Weights.plain(model.ny)
    store = _kept.get()
    kept = store and store.find(_key(model, segment, point, x0, chosen), segment.n, columns=columns)
    program = None if kept else Program.make(model, segment, point, chosen)
    if program is None:
        whole = kept or interpret_pass(model, segment, point, chosen, segment.n, x0)
        assert whole.outputs is not None
        for start in range(0, segment.n, chunk):
            rows = slice(start, start + chunk)
            v = _choose_columns(whole, rows) if columns else None
            yield replace(whole, outputs=whole.outputs[rows], columns=v, chosen=None, states=None)
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
    x0: VectorX,
    weights: Weights,
    into: Influence,
    r: Lagged,
    *,
    forms: int = 2,
) -> DoubleSum | None:
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
    forms : int
        1 leaves out what t = s gives.
    """
    store = _kept.get()
    kept = store and store.find(_key(model, segment, point, x0, weights), 0, columns=True)
    if not kept or kept.columns is None:
        program = Program.make(model, segment, point, weights)
        return None if program is None else program.double_sum(x0, into, r, forms=forms)
    _, counted = read_measured(segment, segment.n)
    counted[: weights.settle] = False
    return double_sum_of_columns(kept, counted, into, r, forms=forms)
