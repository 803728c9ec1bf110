"""The compiled passes: pass.c, with the exact matrices of a linear plant, or with step.c around CasADi's generated rate
and output of another.

Steps are compiled for each model, passes for each size of one, and what they do to residuals (sums.c) once for all;
passes of several stretches side by side (lanes.c) have their steps in themselves.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Sequence
from functools import lru_cache
from importlib.resources import files
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float, Shaped

from seaopt.errors import SimulationError
from seaopt.plants.memo import memo
from seaopt.records import record
from seaopt.signals import VectorM, VectorX
from seaopt.simulation.discretisation import Clock, transition
from seaopt.simulation.integrator import Rates, output_function, rate_functions, step_function, write_in_lanes
from seaopt.simulation.model import Model
from seaopt.simulation.native import (
    Kernel,
    define_constants,
    find_kernel,
    generate_code,
    load_library,
    row_addresses,
)
from seaopt.simulation.parts import LANES, PARALLEL, count_parts, join_parts, moves_little
from seaopt.simulation.passes import DoubleSum, Influence, Lagged, Layout, Pass, Point, Segment, Weights, layout_of

FORGOTTEN = 1e-24  # of a state, in any units: far below rounding
LOSSES = ("square", "huber", "soft_l1")


_INFLUENCES = (
    (np.int64, ("lags", "parts", "outputs_of", "columns_in", "forms")),
    (np.uint64, ("places", "into", "correlation", "ring", "form")),
)
_FIELDS = (  # of seaopt_pass_args behind its channels; pointers are whole numbers
    (np.int64, ("from", "to", "length", "lead", "shared", "drift_terms", "v_columns", "lag_a", "lag_b", "lag_c")),
    (np.int64, ("settle", "start", "output_rows", "sections", "loss", "warm", "run_up")),
    (np.float64, ("t0", "tau0", "dtau")),
    (
        np.uint64,
        ("plant", "model", "correction", "x0", "offset", "gain", "drift", "sos", "knee", "gram", "rho", "count"),
    ),
    (np.uint64, ("outputs", "columns", "states", "changes", "carry")),
    *_INFLUENCES,  # in it
)


@lru_cache(maxsize=32)
def _arguments(nu: int, ny: int) -> np.dtype[Any]:
    """Return seaopt_pass_args of pass.c."""
    channels = [("u", np.uint64, (nu,)), ("y", np.uint64, (ny,)), ("keep", np.uint64, (ny,)), ("steps", np.uint64)]
    return np.dtype([*channels, *((name, kind) for kind, names in _FIELDS for name in names)])


@memo
def _has_constant(model: Model) -> bool:
    """Tell whether a linear model has a constant term, for some parameters."""
    both, where = ca.vertcat(model.f, model.h), ca.vertcat(model.x, model.u)
    return not ca.simplify(ca.substitute(both, where, ca.DM.zeros(where.numel()))).is_zero()


def _count_delayed(model: Model, point: Point) -> int:
    """Return DELAYED of layout.h: inputs in force besides u_a of a linear plant; of others, what a free delay moves."""
    clock = point.clock
    if model.linear:
        return len(clock.lags) - 1 if clock.split or clock.hold == "first" else 0
    return clock.delay_free * (2 if clock.hold == "first" or model.reads else 1)


def pass_source(model: Model, layout: Layout, delayed: int, *, measured: bool) -> str:
    """Return the C source of passes over data with measured outputs, or of simulations alone. Of a plant it has nothing
    but sizes, and what a device samples: plants of one size share it.
    """
    constants = {**_name_sizes(model, layout, delayed, measured=measured), "LINEAR": int(model.linear)}
    constants |= {"NCP": _pad_to_vectors(layout.columns), "CORRECT": int(layout.corrected)}
    if model.linear:
        constants["NI"] = model.nu * (1 + delayed) + _has_constant(model)
    else:
        constants["READ"] = model.reads
    headers = map(_text, ("sums.h", "stack.h", "layout.h", "step.h", "pass.h"))
    return "\n".join((define_constants(constants), *headers, _write_sampling(model), _text("pass.c")))


def step_source(model: Model, layout: Layout, delayed: int, *, measured: bool) -> str:
    """Return the C source of the steps and outputs of a plant that is not linear."""
    constants = _name_sizes(model, layout, delayed, measured=measured)
    constants |= {"NQ": model.np, "STEPPED": int(model.sticks and not model.by_events), "JOINT": int(model.by_events)}
    if constants["STEPPED"]:
        step, output = step_function(model), output_function(model)
        plain = [_drop_derivatives(step, "seaopt_plain_step"), _drop_derivatives(output, "seaopt_plain_output")]
        generated = generate_code(step, output, *plain)
    else:
        rates = rate_functions(model, moving=delayed == 2)
        constants |= _count_nonzeros(rates)
        generated = generate_code(rates.rate, rates.output, *([rates.joint] if model.by_events else []))
        generated += _write_chains(model, rates, in_lanes=False)
    headers = ("sums.h", "layout.h", "step.h", *(("tanh.h",) if re.search(r"\btanh\(", generated) else ()))
    return "\n".join((define_constants(constants), *map(_text, headers), generated, _text("step.c")))


def lanes_source(model: Model, layout: Layout, delayed: int) -> str:
    """Return the C source of the passes of several stretches side by side; nothing of a plant that has none: it is
    linear, sticks, samples, or has an operation that is not known of vectors.
    """
    if model.linear or model.sticks or layout.corrected or _write_sampling(model):
        return ""
    rates = rate_functions(model, moving=delayed == 2)
    functions = [write_in_lanes(function) for function in (rates.rate, rates.output)]
    if not all(functions):
        return ""
    constants = _name_sizes(model, layout, delayed, measured=True) | _count_nonzeros(rates)
    constants |= {"NCP": _pad_to_vectors(layout.columns), "LINEAR": 0, "NQ": model.np, "READ": model.reads}
    constants["CONSTANTS"] = rates.rate.numel_in(4)
    generated = "".join((*functions, _write_chains(model, rates, in_lanes=True)))
    tanh = ("tanh.h",) if "seaopt_tanh" in generated else ()
    headers = ("sums.h", "stack.h", "layout.h", *tanh, "lanes.h", "pass.h")
    return "\n".join((define_constants(constants), *map(_text, headers), generated, _text("lanes.c")))


def _name_sizes(model: Model, layout: Layout, delayed: int, *, measured: bool) -> dict[str, float]:
    """Return the constants of layout.h that passes and steps have in common."""
    sizes = {"NX": model.nx, "NU": model.nu, "NY": model.ny, "NJP": _pad_to_vectors(layout.states)}
    return {**sizes, "DELAYED": delayed, "MEASURED": int(measured)}


def _count_nonzeros(rates: Rates) -> dict[str, float]:
    patterns = (*rates.rate_pattern, *rates.output_pattern)
    return {f"NNZ_{name}": len(each) for name, each in zip(("FX", "FP", "HX", "HP"), patterns, strict=True)}


def _write_sampling(model: Model) -> str:
    """Return the states that are set at samples and their combinations, as C; nothing where there are none."""
    sampling = model.plant.sampling
    if sampling is None or model.linear:
        return ""
    rows, weights = sampling.matrix(tuple(model.plant.states))
    kept, read, keeps = model.read_states
    lines = list[str]()
    if rows:
        table = ", ".join("{" + ", ".join(map(repr, row)) + "}" for row in weights.tolist())
        lines += [f"#define SAMPLED {len(rows)}", f"static const int sampled_state[SAMPLED] = {{{_join(rows)}}};"]
        lines += [f"static const double sampled_from[SAMPLED][NX] = {{{table}}};"]
    if kept:
        lines += [f"#define KEPT {len(kept)}", f"#define KEPT_BY {keeps}"]
        lines += [f"static const int kept_state[KEPT] = {{{_join(kept)}}}, kept_of[KEPT] = {{{_join(read)}}};"]
    return "".join(f"{line}\n" for line in lines)


def _join(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers))


def _drop_derivatives(function: ca.Function, name: str) -> ca.Function:
    """Return a function's first result alone."""
    arguments = function.sx_in()
    return ca.Function(name, arguments, function.call(arguments)[:1], {"cse": True})


@lru_cache(maxsize=8)
def _text(name: str) -> str:
    return files("seaopt.simulation").joinpath(name).read_text(encoding="utf-8")


def _write_chains(model: Model, rates: Rates, *, in_lanes: bool) -> str:
    """Return the C functions that take derivatives through the rate and the output."""
    rate = _chain_code("rate", rates.rate_pattern, model.nx, in_lanes=in_lanes)
    return rate + _chain_code("output", rates.output_pattern, model.ny, in_lanes=in_lanes)


def _chain_code(
    name: str, pattern: tuple[list[tuple[int, int]], list[tuple[int, int]]], rows: int, *, in_lanes: bool
) -> str:
    """Return the C function out = [0, A Z + B] for A, B of a sparsity pattern: one loop over derivatives per row."""
    a, b = pattern
    kind, width, loop, entry = (
        ("lanes", "NJ", "int j = 1; j < NJ; j++", "z[{}][j]")
        if in_lanes
        else ("double", "NJP", "int j = 0; j < NJP / 4; j++", "((const vec *)z[{}])[j]")
    )
    lines = [
        f"static inline void seaopt_{name}_chain(const {kind} *a, const {kind} *b,",
        f"        const {kind} (*restrict z)[{width}], {kind} (*restrict out)[{width}]) {{",
        "    const vec zero = {0.0, 0.0, 0.0, 0.0}; (void)zero;",
    ]
    for row in range(rows):
        terms = " + ".join(f"a[{k}] * {entry.format(j)}" for k, (i, j) in enumerate(a) if i == row)
        to = f"out[{row}][j]" if in_lanes else f"((vec *)out[{row}])[j]"
        lines.append(f"    for ({loop}) {to} = {terms or 'zero'};")
        lines += [f"    out[{row}][{1 + j}] += b[{k}];" for k, (i, j) in enumerate(b) if i == row]
    return "\n".join([*lines, "}\n"])


@memo
def load_passes(
    model: Model, layout: Layout, delayed: int, *, measured: bool, in_lanes: bool
) -> tuple[Kernel, int] | None:
    """Return the compiled passes of a model, and the address of the steps that they take, 0 where they have them in
    themselves; None where there is no compiler.
    """
    lanes = lanes_source(model, layout, delayed) if in_lanes and measured else ""
    sources = {"seaopt_passes": lanes or pass_source(model, layout, delayed, measured=measured)}
    sources["seaopt_sums"] = _sums_source()
    if not (lanes or model.linear):
        sources["seaopt_steps"] = step_source(model, layout, delayed, measured=measured)
    libraries = dict[str, ctypes.CDLL]()
    for name, source in sources.items():
        library = load_library(source, name)
        if library is None:
            return None
        libraries[name] = library
    passes, steps = libraries["seaopt_passes"], libraries.get("seaopt_steps")
    ctypes.c_void_p.in_dll(passes, "sums").value = _address_in(libraries["seaopt_sums"], "seaopt_sums")
    passes.carry_size.restype = passes.count_lanes.restype = ctypes.c_long
    return find_kernel(passes, "seaopt_passes"), 0 if steps is None else _address_in(steps, "seaopt_steps")


def _address_in(library: ctypes.CDLL, name: str) -> int:
    return ctypes.addressof(ctypes.c_char.in_dll(library, name))


def _sums_source() -> str:
    return _text("sums.h") + _text("sums.c")


def double_sum_of_columns(
    made: Pass, counted: Bool[np.ndarray, "n ny"], into: Influence, r: Lagged, *, forms: int
) -> DoubleSum | None:
    """Return what `Program.double_sum` does, of a pass whose columns are there."""
    sums = load_library(_sums_source(), "seaopt_sums")
    if sums is None or made.columns is None:
        return None
    places = np.arange(into.shape[2]) if made.chosen is None else made.chosen
    empty = np.zeros(1, dtype=[(n, k) for k, ns in _INFLUENCES for n in ns])
    arguments, buffers, form = _lay_out_influences(into, places, r, empty, forms)
    chosen, v = np.ascontiguousarray(counted, dtype=np.int32), np.ascontiguousarray(made.columns)
    pointers = (ctypes.c_void_p(array.ctypes.data) for array in (arguments, v, chosen))
    sums.seaopt_sum_twice(*pointers, ctypes.c_long(len(v)), ctypes.c_long(v.shape[2]))
    del buffers
    return _halve_form(form, into.shape[1])


def _lay_out_influences(into: Any, places: Any, r: Any, arguments: Any, forms: int) -> tuple[Any, Any, Any]:
    """Return arguments with the influences in them, the memory that they point to, and what is summed, by argument.
    Columns without influence are left out.
    """
    moves = np.flatnonzero(np.any(into != 0.0, axis=(0, 1)))
    ny, p, width = len(into), into.shape[1], _pad_to_vectors(into.shape[1])
    padded, halved, rows = (
        np.zeros((ny, moves.size, width)),
        np.array(r, order="C"),
        np.asarray(places[moves], np.int64),
    )
    padded[:, :, :p] = into[:, :, moves].transpose(0, 2, 1)
    halved[0] *= 0.5
    ring, form = np.zeros((len(arguments), 2 * len(r), ny, width)), np.zeros((len(arguments), forms, width, width))
    sizes = {"lags": len(r) - 1, "parts": width // 4, "outputs_of": ny, "columns_in": moves.size, "forms": forms}
    pointed = {"places": rows.ctypes.data, "into": padded.ctypes.data, "correlation": halved.ctypes.data}
    for name, value in {**sizes, **pointed, "ring": row_addresses(ring), "form": row_addresses(form)}.items():
        arguments[name] = value
    return arguments, (rows, padded, halved, ring, form), form


def _halve_form(form: Any, p: int) -> DoubleSum:
    total = np.sum(form, axis=0)
    return (total + total.transpose(0, 2, 1))[:, :p, :p]


def _pad_to_vectors(count: int) -> int:
    return (count + 3) // 4 * 4


@lru_cache(maxsize=8)
def _discretise(model: Model, theta: bytes, clock: Clock) -> Float[np.ndarray, "blocks rows cols"]:
    """Return the transition matrices, which all segments of a log share."""
    return transition(model, np.frombuffer(theta), clock)


def _linear_data(model: Model, point: Point, layout: Layout) -> VectorM:
    """Return D and A of pass.c: rows of [x+; y], forced with derivatives last, and by the state."""
    blocks = _discretise(model, point.theta.tobytes(), point.clock)
    nx, nu, rows, delayed = model.nx, model.nu, model.nx + model.ny, _count_delayed(model, point)
    used = [*range(nx + nu * (1 + delayed))] + ([blocks.shape[2] - 1] if _has_constant(model) else [])
    d = np.zeros((rows, len(used), _pad_to_vectors(layout.states)))
    d[:, :, : blocks.shape[0]] = blocks[:, :, used].transpose(1, 2, 0)
    d[:, :nx, 0] = 0.0  # the state itself goes through A
    return np.concatenate([d.ravel(), blocks[0, :, :nx].ravel()])


@np.errstate(over="ignore", invalid="ignore")
def _count_memory(a: Float[np.ndarray, "nx nx"], limit: int) -> int:
    """Return the power of two of samples after which nothing is left of a state; 0 if that is more than a limit."""
    samples = 1
    while samples <= limit:
        if float(np.max(np.abs(a), initial=0.0)) < FORGOTTEN:
            return samples
        a, samples = a @ a, 2 * samples
    return 0


def _settings(model: Model, point: Point) -> VectorM:
    clock = point.clock
    foh = float(clock.hold == "first")
    constants = model.parameters(point.theta)
    if model.by_events or not model.sticks:
        rates = rate_functions(model, moving=_count_delayed(model, point) == 2)
        constants = np.array(rates.prepare(constants)).ravel()
    return np.array([clock.period, clock.fraction_s, foh, *constants])


def _reuse_or_make(room: Any, shape: tuple[int, ...]) -> Any:
    """Return an array of a shape, in a room that is long enough if there is one: fresh memory costs its first touch."""
    return np.empty(shape) if room is None or len(room) < shape[0] else room[: shape[0]]


@record(eq=False)
class _Parts:
    """Parts of a pass: their arguments, and what they point to, the sums and the ends of each part in a row."""

    arguments: Shaped[np.ndarray, " parts"]
    edges: Any
    starts: Any
    ends: Any
    gram: Any
    loss: Any
    counts: Any
    outputs: Any
    columns: Any


class Program:
    """The passes of one segment at one point, ready to run."""

    def __init__(
        self,
        model: Model,
        segment: Segment,
        point: Point,
        weights: Weights,
        layout: Layout,
        compiled: tuple[Kernel, int],
    ) -> None:
        self.model, self.segment, self.layout, (self.kernel, plant) = model, segment, layout, compiled
        self.memory: list[Any] = []  # arrays that stay alive while their addresses are in use
        data, ny = _linear_data(model, point, layout) if model.linear else _settings(model, point), model.ny
        base = np.zeros(1, dtype=_arguments(model.nu, ny))
        base["length"], base["lead"], base["t0"] = segment.n, segment.lead, segment.start_s
        base["u"] = [self._address(channel) + 8 * segment.lead for channel in segment.u]
        base["y"] = [self._address(channel) for channel in segment.y] or 0
        base["keep"] = [self._address(mask, np.uint8) for mask in segment.keep] or 0
        base["steps"] = 0 if model.linear else self._address(point.count_steps(segment), np.int64)
        base["shared"], base["drift_terms"], base["v_columns"] = layout.shared, layout.drift_terms, layout.columns
        base["lag_a"], base["lag_b"], base["lag_c"] = (*point.clock.lags, 0)[:3]
        base["tau0"], base["dtau"] = segment.drift_span
        base["settle"], base["sections"] = weights.settle, len(weights.sections)
        base["loss"], base["plant"] = LOSSES.index(weights.loss), plant
        pointed = {"model": data, "sos": weights.sections, "knee": weights.knee}
        pointed |= {name: getattr(point, name) for name in ("offset", "gain", "drift")}
        if point.correction is not None:
            pointed["correction"] = np.zeros((model.nx, ny, _pad_to_vectors(layout.states)))
            pointed["correction"][:, :, : len(point.correction)] = point.correction.transpose(1, 2, 0)
        for name, array in pointed.items():
            base[name] = self._address(array)
        self.base = base
        self.joins = self.kernel.library.count_lanes() > 1  # whether parts may be joined, see `run_parts`
        self.run_up = 0  # samples in which all of a state is forgotten, so that two halves may run at once; 0: serially
        filtered = layout.corrected or weights.settle or len(weights.sections)
        if model.linear and segment.n >= PARALLEL and not filtered:
            a = data[-(model.nx + ny) * model.nx :].reshape(-1, model.nx)[: model.nx]
            self.run_up = _count_memory(a, segment.n // 8)

    @classmethod
    def make(
        cls, model: Model, segment: Segment, point: Point, weights: Weights, *, in_lanes: bool = False
    ) -> Program | None:
        """Return the program, or None where there is no compiler; `in_lanes`: one that may run in parts, if it can."""
        layout = layout_of(model.nx, model.ny, model.np, point)
        lanes, delayed = in_lanes and not len(weights.sections), _count_delayed(model, point)
        compiled = load_passes(model, layout, delayed, measured=bool(segment.y), in_lanes=lanes)
        return None if compiled is None else cls(model, segment, point, weights, layout, compiled)

    def _address(self, array: Any, kind: Any = float) -> int:
        """Return the address of an array's numbers, side by side."""
        self.memory.append(np.ascontiguousarray(array, dtype=kind))
        return int(self.memory[-1].ctypes.data)

    def run(
        self,
        first: int,
        last: int,
        x0: VectorX,
        *,
        sums: bool = True,
        outputs: bool = False,
        output_rows: int | None = None,
        columns: bool = False,
        states: bool = False,
        changes: bool = False,
        resume: VectorM | None = None,
        room: Pass | None = None,
    ) -> Pass:
        """Run the samples from `first` to before `last`; with `resume`, go on where the samples before them stopped.
        Outputs are those of the first `output_rows` samples, of all if it is left out. Outputs and columns are written
        into the `room` of a pass that is not needed any more, if there is one.
        """
        nx, ny, nc, n = self.model.nx, self.model.ny, self.layout.columns, last - first
        rows = n if output_rows is None else min(output_rows, n)
        if x0.shape != (nx,) or not 0 <= first <= last <= self.segment.n:
            raise SimulationError(
                f"{nx} states, samples {first} to {last} of {self.segment.n}: x0 or the samples do not fit"
            )
        sums_alone = sums and resume is None and not (outputs or columns or states or changes)
        edges, starts, warm = self._split(first, last, x0, halve=sums_alone and n >= max(PARALLEL, 4 * self.run_up))
        parts = len(warm)
        gram, loss, count = np.zeros((parts, ny, nc, nc)), np.zeros((parts, ny)), np.zeros((parts, ny))
        kept: dict[str, Any] = dict.fromkeys(("outputs", "columns", "states", "changes"))
        if outputs:
            kept["outputs"] = _reuse_or_make(room.outputs if room else None, (rows, ny))
        if columns and self.segment.y:
            kept["columns"] = _reuse_or_make(room.columns if room else None, (n, ny, nc))
        if states:
            kept["states"] = np.empty((n, nx))
        if changes:
            kept["changes"] = np.zeros((n, nx))
        arguments = self._place(edges, warm, x0=starts, rho=loss, count=count, **{"gram": gram} if sums else {})
        arguments["output_rows"] = rows
        if resume is not None:
            arguments["start"], arguments["carry"] = 0, resume.ctypes.data
        for name, array in kept.items():
            if array is not None:
                arguments[name] = array.ctypes.data
        buffers = (self.memory, gram, loss, count, kept, starts, resume)
        self.kernel.run(arguments, buffers, parallel=n >= PARALLEL)
        sums_of = {name: np.sum(each, axis=0) for name, each in (("gram", gram), ("loss", loss), ("count", count))}
        return Pass(**sums_of, **kept)

    def run_parts(
        self, x0: VectorX, run_up: int, *, output_rows: int, columns: bool
    ) -> tuple[Pass | None, Float[np.ndarray, "parts nx nx"]]:
        """Run all samples in parts at once, the states of all but the first after a run-up; None where one is not the
        state in which the part before ends. Returns the derivatives of each part's last state by its first, too. See
        `seaopt.simulation.parts`.
        """
        parts = self._cut(x0, count_parts(self.segment.n, run_up), output_rows=output_rows, columns=columns)
        parts.arguments["run_up"][1:] = run_up
        self.kernel.run(parts.arguments, (self.memory, parts), parallel=self.segment.n >= PARALLEL, least=LANES)
        return self._join(parts) if self._meet(parts) else None, self._read_sensitivities(parts)

    def _read_sensitivities(self, parts: _Parts) -> Float[np.ndarray, "parts nx nx"]:
        return np.array([self._read_derivatives(end)[:, self.layout.start] for end in parts.ends])

    def _cut(self, x0: VectorX, count: int, *, output_rows: int, columns: bool) -> _Parts:
        """Return so many parts of all samples that are still to be run, all from the same state."""
        ny, nc, n = self.model.ny, self.layout.columns, self.segment.n
        edges, starts = np.linspace(0, n, count + 1).astype(int), np.array([x0] * count, dtype=float)
        gram, loss, counts = np.zeros((count, ny, nc, nc)), np.zeros((count, ny)), np.zeros((count, ny))
        outputs, v = np.empty((output_rows, ny)), np.empty((n if columns else 0, ny, nc))
        ends = np.array([self.carry()] * count)
        arguments = self._place(
            edges, np.zeros(count, dtype=int), x0=starts, rho=loss, count=counts, gram=gram, carry=ends
        )
        arguments["output_rows"] = np.clip(output_rows - edges[:-1], 0, np.diff(edges))
        arguments["outputs"] = outputs.ctypes.data + outputs.strides[0] * edges[:-1]
        if columns:
            arguments["columns"] = v.ctypes.data + v.strides[0] * edges[:-1]
        return _Parts(
            arguments=arguments, edges=edges, starts=starts, ends=ends, gram=gram, loss=loss, counts=counts,
            outputs=outputs if output_rows else None, columns=v if columns else None,
        )  # fmt: skip

    def _meet(self, parts: _Parts) -> bool:
        """Tell whether each part begins where the one before ends."""
        reached = (self._read_derivatives(end)[:, 0] for end in parts.ends)
        pairs = zip(reached, parts.starts[1:], parts.gram[1:], strict=False)
        return all(moves_little(start, end, gram, self.layout) for end, start, gram in pairs)

    @np.errstate(all="ignore")  # a plant that overflows
    def _join(self, parts: _Parts) -> Pass:
        joins, at = join_parts([self._read_derivatives(end) for end in parts.ends], self.layout), self.layout.start
        if parts.columns is not None:
            for join, first, last in zip(joins[1:], parts.edges[1:], parts.edges[2:], strict=False):
                rows = parts.columns[first:last].reshape(-1, self.layout.columns)
                rows += rows[:, at] @ (join - np.eye(self.layout.columns))[at]
        return Pass(
            gram=np.sum(joins.transpose(0, 2, 1)[:, None] @ parts.gram @ joins[:, None], axis=0),
            loss=np.sum(parts.loss, axis=0),
            count=np.sum(parts.counts, axis=0),
            outputs=parts.outputs,
            columns=parts.columns,
        )

    def _read_derivatives(self, carried: VectorM) -> Float[np.ndarray, "nx nj"]:
        """Return the state and its derivatives as a pass leaves them."""
        width = _pad_to_vectors(self.layout.states)
        return carried[: self.model.nx * width].reshape(-1, width)[:, : self.layout.states]

    def double_sum(self, x0: VectorX, into: Influence, r: Lagged, *, forms: int) -> DoubleSum:
        """Return the sum over t, s of a(t)' R(t - s) a(s), and of two forms its part t = s; a: influences that count
        into v.
        """
        edges, starts, warm = self._split(0, self.segment.n, x0, halve=True)
        warm[1:] += len(r)  # influences reach so far back
        arguments, influences, form = _lay_out_influences(
            into, np.arange(into.shape[2]), r, self._place(edges, warm, x0=starts), forms
        )
        self.kernel.run(arguments, (self.memory, starts, influences), parallel=self.segment.n >= PARALLEL)
        return _halve_form(form, into.shape[1])

    def _place(self, edges: Any, warm: Any, **rows: Any) -> Shaped[np.ndarray, " parts"]:
        """Return the arguments of parts between edges, each with its own row of the arrays."""
        arguments = np.repeat(self.base, len(warm))
        arguments["from"] = arguments["start"] = edges[:-1] - warm
        arguments["to"], arguments["warm"] = edges[1:], warm
        for name, array in rows.items():
            arguments[name] = row_addresses(array)
        return arguments

    def _split(self, first: int, last: int, x0: VectorX, *, halve: bool) -> tuple[Any, Any, Any]:
        """Return edges, starts and run-up of what runs at once: two halves where the state is soon forgotten, or one.
        The second half starts at zero and forgets it before it counts.
        """
        if not (halve and self.run_up):
            return np.array([first, last]), np.array(x0[None], dtype=float), np.zeros(1, dtype=int)
        starts = np.vstack([x0, np.zeros_like(x0)])
        return np.array([first, (first + last) // 2, last]), starts, np.array([0, self.run_up])

    def carry(self) -> VectorM:
        """Return room for what a shot hands from one call to the next."""
        return np.zeros(int(self.kernel.library.carry_size()))
