"""The compiled passes: pass.c around CasADi's generated rate and output, or the exact matrices of a linear plant.

A kernel of passes is compiled for each model; what they do to residuals (sums.c) once for all.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from importlib.resources import files
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.errors import SimulationError
from seaopt.plants.memo import memo
from seaopt.simulation.discretisation import Clock, transition
from seaopt.simulation.integrator import output_function, rate_functions, step_function
from seaopt.simulation.model import Model
from seaopt.simulation.native import Kernel, define_constants, generate_code, load_kernel, load_library, row_addresses
from seaopt.simulation.passes import Layout, Pass, Point, Segment, Weights, layout_of

PARALLEL = 20_000  # samples below which a second thread does not pay
FORGOTTEN = 1e-24  # of a state, in any units: far below rounding
LOSSES = ("square", "huber", "soft_l1")


@lru_cache(maxsize=32)
def _arguments(nu: int, ny: int) -> np.dtype[Any]:
    """Return seaopt_pass_args of pass.c, field by field; pointers are whole numbers."""
    pointer, whole, real = np.uint64, np.int64, np.float64
    return np.dtype(
        [
            ("from", whole),
            ("to", whole),
            ("length", whole),
            ("lead", whole),
            ("u", pointer, (nu,)),
            ("y", pointer, (ny,)),
            ("keep", pointer, (ny,)),
            ("shared", whole),
            ("drift_terms", whole),
            ("z_columns", whole),
            ("v_columns", whole),
            ("lag_a", whole),
            ("lag_b", whole),
            ("lag_c", whole),
            ("settle", whole),
            ("start", whole),
            ("output_rows", whole),
            ("t0", real),
            ("tau0", real),
            ("dtau", real),
            ("model", pointer),
            ("correction", pointer),
            ("x0", pointer),
            ("offset", pointer),
            ("gain", pointer),
            ("drift", pointer),
            ("sos", pointer),
            ("sections", whole),
            ("loss", whole),
            ("knee", pointer),
            ("gram", pointer),
            ("rho", pointer),
            ("count", pointer),
            ("outputs", pointer),
            ("columns", pointer),
            ("states", pointer),
            ("last", pointer),
            ("carry", pointer),
            ("lags", whole),
            ("parts", whole),
            ("outputs_of", whole),
            ("columns_in", whole),
            ("into", pointer),
            ("correlation", pointer),
            ("ring", pointer),
            ("form", pointer),
            ("warm", whole),
        ]
    )


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
    return clock.delay_free * (2 if clock.hold == "first" else 1)


def kernel_source(model: Model, layout: Layout, delayed: int, *, measured: bool) -> str:
    """Return the C source of the passes of a model, over data with measured outputs or of simulations alone."""
    constants = {
        "NX": model.nx, "NU": model.nu, "NY": model.ny, "NJP": _pad_to_vectors(layout.states),
        "NCP": _pad_to_vectors(layout.columns), "LINEAR": int(model.linear), "STEPPED": int(model.sticks),
        "CORRECT": int(layout.corrected), "DELAYED": delayed, "MEASURED": int(measured),
    }  # fmt: skip
    generated = _write_sampling(model)
    constants |= {"NI": model.nu * (1 + delayed) + _has_constant(model)} if model.linear else {"NQ": model.np}
    if model.sticks:
        step, output = step_function(model), output_function(model)
        plain = [_drop_derivatives(step, "seaopt_plain_step"), _drop_derivatives(output, "seaopt_plain_output")]
        generated += generate_code(step, output, *plain)
    elif not model.linear:
        rates = rate_functions(model, moving=delayed == 2)
        patterns = (*rates.rate_pattern, *rates.output_pattern)
        constants |= dict(zip(("NNZ_FX", "NNZ_FP", "NNZ_HX", "NNZ_HP"), (len(p) for p in patterns), strict=True))
        chains = (
            _chain_code("rate", rates.rate_pattern, model.nx),
            _chain_code("output", rates.output_pattern, model.ny),
        )
        generated += "\n".join((generate_code(rates.rate, rates.output), *chains))
    return "\n".join(
        (define_constants(constants), *map(_text, ("sums.h", "stack.h", "layout.h")), generated, _text("pass.c"))
    )


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
    return "\n".join([*lines, "}"])


@memo
def load_passes(model: Model, layout: Layout, delayed: int, *, measured: bool) -> Kernel | None:
    """Return the compiled passes of a model, or None where there is no compiler."""
    kernel = load_kernel(kernel_source(model, layout, delayed, measured=measured), "seaopt_passes")
    sums = load_library(_text("sums.h") + _text("sums.c"), "seaopt_sums")
    if kernel is None or sums is None:
        return None
    table = ctypes.c_char.in_dll(sums, "seaopt_sums")
    ctypes.c_void_p.in_dll(kernel.library, "sums").value = ctypes.addressof(table)
    kernel.library.carry_size.restype = ctypes.c_long
    return kernel


def _pad_to_vectors(count: int) -> int:
    return (count + 3) // 4 * 4


@lru_cache(maxsize=8)
def _discretise(model: Model, theta: bytes, clock: Clock) -> Float[np.ndarray, "blocks rows cols"]:
    """Return the transition matrices, which all segments of a log share."""
    return transition(model, np.frombuffer(theta), clock)


def _linear_data(model: Model, point: Point, layout: Layout) -> Float[np.ndarray, " m"]:
    """Return D and A of pass.c: rows of [x+; y], forced with derivatives last, and by the state."""
    blocks = _discretise(model, point.theta.tobytes(), point.clock)
    nx, nu, rows, delayed = model.nx, model.nu, model.nx + model.ny, _count_delayed(model, point)
    used = [*range(nx + nu * (1 + delayed))] + ([blocks.shape[2] - 1] if _has_constant(model) else [])
    d = np.zeros((rows, len(used), _pad_to_vectors(layout.states)))
    d[:, :, : blocks.shape[0]] = blocks[:, :, used].transpose(1, 2, 0)
    d[:, :nx, 0] = 0.0  # the state itself goes through A
    return np.concatenate([d.ravel(), blocks[0, :, :nx].ravel()])


@np.errstate(over="ignore", invalid="ignore")
def _memory_of(a: Float[np.ndarray, "nx nx"], limit: int) -> int:
    """Return the power of two of samples after which nothing is left of a state; 0 if that is more than a limit."""
    samples = 1
    while samples <= limit:
        if float(np.max(np.abs(a), initial=0.0)) < FORGOTTEN:
            return samples
        a, samples = a @ a, 2 * samples
    return 0


def _settings(model: Model, point: Point) -> Float[np.ndarray, " m"]:
    clock = point.clock
    foh = float(clock.hold == "first")
    constants = model.parameters(point.theta)
    if not model.sticks:
        rates = rate_functions(model, moving=_count_delayed(model, point) == 2)
        constants = np.array(rates.prepare(constants)).ravel()
    return np.array([point.substeps, clock.period, clock.fraction_s, foh, *constants])


def _reuse_or_make(room: Any, shape: tuple[int, ...]) -> Any:
    """Return an array of a shape, in a room that is long enough if there is one: fresh memory costs its first touch."""
    return np.empty(shape) if room is None or len(room) < shape[0] else room[: shape[0]]


class _Memory:
    """Keeps arrays alive while their addresses are in use."""

    def __init__(self) -> None:
        self.arrays: list[Any] = []

    def address(self, array: Any) -> int:
        if array is None:
            return 0
        self.arrays.append(array)
        return int(array.ctypes.data)

    def constant(self, array: Any) -> int:
        return self.address(np.ascontiguousarray(array, dtype=float))


class Program:
    """The passes of one segment at one point, ready to run."""

    def __init__(
        self, model: Model, segment: Segment, point: Point, weights: Weights, layout: Layout, kernel: Kernel
    ) -> None:
        self.model, self.segment, self.layout, self.kernel = model, segment, layout, kernel
        self.memory = memory = _Memory()
        data = _linear_data(model, point, layout) if model.linear else _settings(model, point)
        ny = model.ny
        base = np.zeros(1, dtype=_arguments(model.nu, ny))
        base["length"] = segment.n
        base["lead"] = segment.lead
        base["u"] = [memory.constant(channel) + 8 * segment.lead for channel in segment.u]
        base["y"] = [memory.constant(channel) for channel in segment.y] if segment.y else 0
        base["keep"] = [memory.address(np.ascontiguousarray(mask)) for mask in segment.keep] if segment.keep else 0
        base["shared"], base["drift_terms"] = layout.shared, layout.drift_terms
        base["z_columns"], base["v_columns"] = layout.states, layout.columns
        base["lag_a"], base["lag_b"], base["lag_c"] = (*point.clock.lags, 0)[:3]
        base["settle"], base["t0"] = weights.settle, segment.start_s
        base["tau0"], base["dtau"] = segment.drift_span
        base["model"] = memory.constant(data)
        base["correction"] = self._correction(point)
        base["offset"], base["gain"] = memory.constant(point.offset), memory.constant(point.gain)
        base["drift"] = memory.constant(point.drift)
        base["sos"], base["sections"] = memory.constant(weights.sections), len(weights.sections)
        base["loss"], base["knee"] = LOSSES.index(weights.loss), memory.constant(weights.knee)
        self.base = base
        self.run_up = 0  # samples in which all of a state is forgotten, so that two halves may run at once; 0: serially
        if model.linear and segment.n >= PARALLEL and not (layout.corrected or weights.settle or len(weights.sections)):
            self.run_up = _memory_of(
                data[-(model.nx + ny) * model.nx :].reshape(-1, model.nx)[: model.nx], segment.n // 8
            )

    @classmethod
    def make(cls, model: Model, segment: Segment, point: Point, weights: Weights) -> Program | None:
        """Return the program, or None where there is no compiler."""
        layout = layout_of(model.nx, model.ny, model.np, point)
        kernel = load_passes(model, layout, _count_delayed(model, point), measured=bool(segment.y))
        return None if kernel is None else cls(model, segment, point, weights, layout, kernel)

    def _correction(self, point: Point) -> int:
        if point.correction is None:
            return 0
        padded = np.zeros((self.model.nx, self.model.ny, _pad_to_vectors(self.layout.states)))
        padded[:, :, : point.correction.shape[0]] = point.correction.transpose(1, 2, 0)
        return self.memory.constant(padded)

    def run(
        self,
        first: int,
        last: int,
        x0: Float[np.ndarray, " nx"],
        *,
        sums: bool = True,
        outputs: bool = False,
        output_rows: int | None = None,
        columns: bool = False,
        states: bool = False,
        resume: Float[np.ndarray, " m"] | None = None,
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
        sums_alone = sums and resume is None and not (outputs or columns or states)
        edges, starts, warm = self._split(first, last, x0, halve=sums_alone and n >= max(PARALLEL, 4 * self.run_up))
        parts = len(warm)
        gram, loss, count = np.zeros((parts, ny, nc, nc)), np.zeros((parts, ny)), np.zeros((parts, ny))
        kept = {
            "outputs": _reuse_or_make(room.outputs if room else None, (rows, ny)) if outputs else None,
            "columns": _reuse_or_make(room.columns if room else None, (n, ny, nc))
            if columns and self.segment.y
            else None,
            "states": np.empty((n, nx)) if states else None,
        }
        arguments = np.repeat(self.base, parts)
        arguments["from"], arguments["to"], arguments["output_rows"] = edges[:-1] - warm, edges[1:], rows
        arguments["start"], arguments["warm"] = edges[:-1] - warm if resume is None else 0, warm
        for name, array in {"x0": starts, "rho": loss, "count": count}.items():
            arguments[name] = row_addresses(array)
        if sums:
            arguments["gram"] = row_addresses(gram)
        for name, array in kept.items():
            if array is not None:
                arguments[name] = array.ctypes.data
        if resume is not None:
            arguments["carry"] = resume.ctypes.data
        buffers = (self.memory, gram, loss, count, kept, starts, resume)
        self.kernel.run(arguments, buffers, parallel=n >= PARALLEL)
        return Pass(gram=np.sum(gram, axis=0), loss=np.sum(loss, axis=0), count=np.sum(count, axis=0), **kept)

    def double_sum(
        self, x0: Float[np.ndarray, " nx"], into: Float[np.ndarray, "ny p nc"], r: Float[np.ndarray, "lags1 ny ny"]
    ) -> Float[np.ndarray, "2 p p"]:
        """Return the sum over t and s of a(t)' R(t - s) a(s), and of it what t = s gives.

        The a are the influences into v of the samples that count.
        """
        ny, p, nc = into.shape
        width = _pad_to_vectors(p)
        padded, halved = np.zeros((ny, nc, width)), np.array(r, order="C")
        padded[:, :, :p] = into.transpose(0, 2, 1)
        halved[0] *= 0.5
        edges, starts, warm = self._split(0, self.segment.n, x0, halve=True)
        warm[1:] += len(r)  # influences reach so far back
        ring, form = np.zeros((len(warm), 2 * len(r), ny, width)), np.zeros((len(warm), 2, width, width))
        arguments = np.repeat(self.base, len(warm))
        arguments["from"], arguments["start"], arguments["to"] = edges[:-1] - warm, edges[:-1] - warm, edges[1:]
        arguments["warm"], arguments["lags"], arguments["parts"] = warm, len(r) - 1, width // 4
        arguments["outputs_of"], arguments["columns_in"] = ny, nc
        arguments["into"], arguments["correlation"] = padded.ctypes.data, halved.ctypes.data
        for name, array in {"x0": starts, "ring": ring, "form": form}.items():
            arguments[name] = row_addresses(array)
        buffers = (self.memory, padded, halved, starts, ring, form)
        self.kernel.run(arguments, buffers, parallel=self.segment.n >= PARALLEL)
        total = np.sum(form, axis=0)
        return (total + total.transpose(0, 2, 1))[:, :p, :p]

    def _split(self, first: int, last: int, x0: Float[np.ndarray, " nx"], *, halve: bool) -> tuple[Any, Any, Any]:
        """Return edges, starts and run-up of what runs at once: two halves where the state is soon forgotten, or one.

        The second half starts at zero and forgets it before it counts.
        """
        if not (halve and self.run_up):
            return np.array([first, last]), np.array(x0[None], dtype=float), np.zeros(1, dtype=int)
        starts = np.vstack([x0, np.zeros_like(x0)])
        return np.array([first, (first + last) // 2, last]), starts, np.array([0, self.run_up])

    def carry(self) -> Float[np.ndarray, " m"]:
        """Return room for what a shot hands from one call to the next."""
        return np.zeros(int(self.kernel.library.carry_size()))
