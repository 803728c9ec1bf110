"""The compiled passes: pass.c around CasADi's generated rate and output, or the exact matrices of a linear plant.

A kernel of passes is compiled for each model; what they do to residuals (sums.c) once for all.
"""

from __future__ import annotations

import ctypes
import re
from functools import lru_cache
from importlib.resources import files
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float, Shaped

from seaopt.errors import SimulationError
from seaopt.plants.memo import memo
from seaopt.signals import VectorM, VectorX
from seaopt.simulation.discretisation import Clock, transition
from seaopt.simulation.halves import join_columns, moves_little
from seaopt.simulation.integrator import output_function, rate_functions, step_function
from seaopt.simulation.model import Model
from seaopt.simulation.native import Kernel, define_constants, generate_code, load_kernel, load_library, row_addresses
from seaopt.simulation.passes import DoubleSum, Influence, Lagged, Layout, Pass, Point, Segment, Weights, layout_of

PARALLEL = 20_000  # samples below which a second thread does not pay
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
    (np.uint64, ("model", "correction", "x0", "offset", "gain", "drift", "sos", "knee", "gram", "rho", "count")),
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


def kernel_source(model: Model, layout: Layout, delayed: int, *, measured: bool) -> str:
    """Return the C source of the passes of a model, over data with measured outputs or of simulations alone."""
    constants = {
        "NX": model.nx,
        "NU": model.nu,
        "NY": model.ny,
        "NJP": _pad_to_vectors(layout.states),
        "NCP": _pad_to_vectors(layout.columns),
        "LINEAR": int(model.linear),
        "STEPPED": int(model.sticks and not model.by_events),
        "JOINT": int(model.by_events),
        "CORRECT": int(layout.corrected),
        "DELAYED": delayed,
        "MEASURED": int(measured),
    }
    generated = _write_sampling(model)
    if model.linear:
        constants["NI"] = model.nu * (1 + delayed) + _has_constant(model)
    else:
        constants |= {"NQ": model.np, "READ": model.reads}
    if constants["STEPPED"]:
        step, output = step_function(model), output_function(model)
        plain = [_drop_derivatives(step, "seaopt_plain_step"), _drop_derivatives(output, "seaopt_plain_output")]
        generated += generate_code(step, output, *plain)
    elif not model.linear:
        rates = rate_functions(model, moving=delayed == 2)
        patterns = (*rates.rate_pattern, *rates.output_pattern)
        constants |= dict(zip(("NNZ_FX", "NNZ_FP", "NNZ_HX", "NNZ_HP"), (len(p) for p in patterns), strict=True))
        generated += generate_code(rates.rate, rates.output, *([rates.joint] if model.by_events else []))
        generated += _chain_code("rate", rates.rate_pattern, model.nx)
        generated += _chain_code("output", rates.output_pattern, model.ny)
    tanh = ("tanh.h",) if re.search(r"\btanh\(", generated) else ()
    headers = map(_text, ("sums.h", "stack.h", "layout.h", *tanh))
    return "\n".join((define_constants(constants), *headers, generated, _text("pass.c")))


def _write_sampling(model: Model) -> str:
    """Return the states that are set at samples and their combinations, as C; nothing where there are none."""
    sampling = model.plant.sampling
    if sampling is None or model.linear:
        return ""
    rows, weights = sampling.matrix(tuple(model.plant.states))
    table = ", ".join("{" + ", ".join(map(repr, row)) + "}" for row in weights.tolist())
    return (
        f"#define SAMPLED {len(rows)}\nstatic const int sampled_state[SAMPLED] = {{{', '.join(map(str, rows))}}};\n"
        f"static const double sampled_from[SAMPLED][NX] = {{{table}}};\n"
    )


def _drop_derivatives(function: ca.Function, name: str) -> ca.Function:
    """Return a function's first result alone."""
    arguments = function.sx_in()
    return ca.Function(name, arguments, function.call(arguments)[:1], {"cse": True})


@lru_cache(maxsize=8)
def _text(name: str) -> str:
    return files("seaopt.simulation").joinpath(name).read_text(encoding="utf-8")


def _chain_code(name: str, pattern: tuple[list[tuple[int, int]], list[tuple[int, int]]], rows: int) -> str:
    """Return the C function out = [0, A Z + B] for A, B of a sparsity pattern: one loop over derivatives per row."""
    a, b = pattern
    lines = [
        f"static inline void seaopt_{name}_chain(const double *a, const double *b,",
        "        const double (*restrict z)[NJP], double (*restrict out)[NJP]) {",
        "    const vec zero = {0.0, 0.0, 0.0, 0.0}; (void)zero;",
    ]
    for row in range(rows):
        terms = " + ".join(f"a[{k}] * ((const vec *)z[{j}])[j]" for k, (i, j) in enumerate(a) if i == row)
        lines.append(f"    for (int j = 0; j < NJP / 4; j++) ((vec *)out[{row}])[j] = {terms or 'zero'};")
        lines += [f"    out[{row}][{1 + j}] += b[{k}];" for k, (i, j) in enumerate(b) if i == row]
    return "\n".join([*lines, "}\n"])


@memo
def load_passes(model: Model, layout: Layout, delayed: int, *, measured: bool) -> Kernel | None:
    """Return the compiled passes of a model, or None where there is no compiler."""
    kernel = load_kernel(kernel_source(model, layout, delayed, measured=measured), "seaopt_passes")
    sums = _load_sums()
    if kernel is None or sums is None:
        return None
    table = ctypes.c_char.in_dll(sums, "seaopt_sums")
    ctypes.c_void_p.in_dll(kernel.library, "sums").value = ctypes.addressof(table)
    kernel.library.carry_size.restype = ctypes.c_long
    return kernel


def _load_sums() -> ctypes.CDLL | None:
    return load_library(_text("sums.h") + _text("sums.c"), "seaopt_sums")


def double_sum_of_columns(
    made: Pass, counted: Bool[np.ndarray, "n ny"], into: Influence, r: Lagged, *, forms: int
) -> DoubleSum | None:
    """Return what `Program.double_sum` does, of a pass whose columns are there."""
    sums = _load_sums()
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


class Program:
    """The passes of one segment at one point, ready to run."""

    def __init__(
        self, model: Model, segment: Segment, point: Point, weights: Weights, layout: Layout, kernel: Kernel
    ) -> None:
        self.model, self.segment, self.layout, self.kernel = model, segment, layout, kernel
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
        base["loss"] = LOSSES.index(weights.loss)
        pointed = {"model": data, "sos": weights.sections, "knee": weights.knee}
        pointed |= {name: getattr(point, name) for name in ("offset", "gain", "drift")}
        if point.correction is not None:
            pointed["correction"] = np.zeros((model.nx, ny, _pad_to_vectors(layout.states)))
            pointed["correction"][:, :, : len(point.correction)] = point.correction.transpose(1, 2, 0)
        for name, array in pointed.items():
            base[name] = self._address(array)
        self.base = base
        long = segment.n >= PARALLEL and not (layout.corrected or weights.settle or len(weights.sections))
        self.joins = long and not (model.linear or model.sticks)  # whether two halves may be joined, see `run_halves`
        self.run_up = 0  # samples in which all of a state is forgotten, so that two halves may run at once; 0: serially
        if model.linear and long:
            a = data[-(model.nx + ny) * model.nx :].reshape(-1, model.nx)[: model.nx]
            self.run_up = _count_memory(a, segment.n // 8)

    @classmethod
    def make(cls, model: Model, segment: Segment, point: Point, weights: Weights) -> Program | None:
        """Return the program, or None where there is no compiler."""
        layout = layout_of(model.nx, model.ny, model.np, point)
        kernel = load_passes(model, layout, _count_delayed(model, point), measured=bool(segment.y))
        return None if kernel is None else cls(model, segment, point, weights, layout, kernel)

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
        follow = sums and resume is None and self.joins  # how a state depends on the first
        carried = self.carry() if follow else resume
        if carried is not None:
            arguments["start"], arguments["carry"] = 0, carried.ctypes.data
        for name, array in kept.items():
            if array is not None:
                arguments[name] = array.ctypes.data
        buffers = (self.memory, gram, loss, count, kept, starts, carried)
        self.kernel.run(arguments, buffers, parallel=n >= PARALLEL)
        by_start = self._read_derivatives(carried)[:, -nx:] if follow and carried is not None else None
        sums_of = {name: np.sum(each, axis=0) for name, each in (("gram", gram), ("loss", loss), ("count", count))}
        return Pass(**sums_of, **kept, sensitivity=by_start)

    def run_halves(self, x0: VectorX, run_up: int, *, output_rows: int, columns: bool) -> Pass | None:
        """Run all samples in two halves at once, the state of the second after a run-up; None where that is not the
        state in which the first ends. See `seaopt.simulation.halves`.
        """
        ny, nc, n = self.model.ny, self.layout.columns, self.segment.n
        middle = (n + run_up) // 2  # the second half has its run-up besides
        gram, loss, count = np.zeros((2, ny, nc, nc)), np.zeros((2, ny)), np.zeros((2, ny))
        outputs, v = np.empty((output_rows, ny)), np.empty((n if columns else 0, ny, nc))
        starts, end = np.array([x0, x0], dtype=float), self.carry()
        edges, warm = np.array([0, middle, n]), np.zeros(2, dtype=int)
        arguments = self._place(edges, warm, x0=starts, rho=loss, count=count, gram=gram)
        arguments["run_up"], arguments["carry"][0] = (0, run_up), end.ctypes.data
        arguments["output_rows"] = min(output_rows, middle), max(output_rows - middle, 0)
        arguments["outputs"] = outputs.ctypes.data + outputs.strides[0] * edges[:2]
        if columns:
            arguments["columns"] = v.ctypes.data + v.strides[0] * edges[:2]
        self.kernel.run(arguments, (self.memory, gram, loss, count, outputs, v, starts, end))
        z = self._read_derivatives(end)
        if not moves_little(starts[1] - z[:, 0], gram[1], self.layout):
            return None
        join = join_columns(z, self.layout)
        if columns:
            v[middle:] = v[middle:] @ join
        return Pass(
            gram=gram[0] + join.T @ gram[1] @ join,
            loss=np.sum(loss, axis=0),
            count=np.sum(count, axis=0),
            outputs=outputs if output_rows else None,
            columns=v if columns else None,
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
