"""The compiled pass: pass.c around CasADi's generated step, or around the exact matrices of a linear plant."""

from __future__ import annotations

import ctypes
import re
from importlib.resources import files
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.simulation.compiler import load_library
from seaopt.simulation.discretisation import transition
from seaopt.simulation.integrator import output_function, step_function
from seaopt.simulation.model import Model
from seaopt.simulation.passes import Pass, Point, Segment, Weights

_DOUBLES = ctypes.POINTER(ctypes.c_double)
_BYTES = ctypes.POINTER(ctypes.c_ubyte)


class _Arguments(ctypes.Structure):
    """seaopt_pass_args of pass.c, field by field."""

    _fields_ = (
        ("n", ctypes.c_long), ("u", _DOUBLES), ("y", _DOUBLES), ("keep", _BYTES),
        ("lag_a", ctypes.c_long), ("lag_b", ctypes.c_long), ("model", _DOUBLES),
        ("x0", _DOUBLES), ("offset", _DOUBLES), ("gain", _DOUBLES),
        ("sos", _DOUBLES), ("sections", ctypes.c_long), ("settle", ctypes.c_long), ("knee", _DOUBLES),
        ("gram", _DOUBLES), ("rho", _DOUBLES), ("count", _DOUBLES),
        ("outputs", _DOUBLES), ("columns", _DOUBLES), ("states", _DOUBLES), ("last", _DOUBLES),
    )  # fmt: skip


def kernel_source(model: Model, delay_free: bool) -> str:
    """Return the C source of the pass of a model."""
    constants = {
        "NX": model.nx, "NU": model.nu, "NY": model.ny, "NP": model.np + delay_free, "NQ": model.np,
        "NA": model.p.numel(),
        "LINEAR": int(model.linear),
    }  # fmt: skip
    generated = ""
    if not model.linear:
        step, output = step_function(model), output_function(model)
        constants |= {
            "SZ_W": max(step.sz_w(), output.sz_w()),
            "SZ_ARG": max(step.sz_arg(), output.sz_arg()),
            "SZ_RES": max(step.sz_res(), output.sz_res()),
        }
        generator = ca.CodeGenerator("kernel")
        generator.add(step)
        generator.add(output)
        generated = _inlined(generator.dump())
    defines = "".join(f"#define {name} {value}\n" for name, value in constants.items())
    body = files("seaopt.simulation").joinpath("pass.c").read_text(encoding="utf-8")
    return f"{defines}{generated}\n{body}"


def _inlined(source: str) -> str:
    """Return CasADi's generated code with its two functions made static, for the compiler to inline."""
    return re.sub(r"CASADI_SYMBOL_EXPORT int (seaopt_(?:step|output))\(", r"static inline int \1(", source)


def kernel(model: Model, delay_free: bool) -> Any:
    """Return the compiled function of a model's pass, or None where there is no compiler."""
    key = f"kernel{int(delay_free)}"
    if key not in model.functions:
        library = load_library(kernel_source(model, delay_free))
        function = library.seaopt_pass if library else None
        if function is not None:
            function.argtypes, function.restype = [ctypes.POINTER(_Arguments)], ctypes.c_int
        model.functions[key] = function
    return model.functions[key]


def _settings(model: Model, point: Point, segment: Segment) -> Float[np.ndarray, " m"]:
    clock = point.clock
    if model.linear:
        return transition(model, point.theta, clock).ravel()
    foh = float(clock.hold == "first")
    return np.array(
        [*model.parameters(point.theta), point.substeps, clock.period, clock.fraction_s, foh, segment.start_s]
    )


def compiled_pass(
    model: Model,
    segment: Segment,
    point: Point,
    weights: Weights,
    *,
    outputs: bool,
    columns: bool,
    states: bool,
) -> Pass | None:
    """Run the compiled pass; None where there is no compiler."""
    clock = point.clock
    function = kernel(model, clock.delay_free)
    if function is None:
        return None
    n, ny, nx = segment.u.shape[0], model.ny, model.nx
    nc = model.np + clock.delay_free + nx + 3
    keep_alive: list[Any] = []

    def doubles(array: Any) -> Any:
        if array is None:
            return None
        flat = np.ascontiguousarray(array, dtype=float)
        keep_alive.append(flat)
        return flat.ctypes.data_as(_DOUBLES)

    result = Pass(
        gram=np.zeros((ny, nc, nc)),
        loss=np.zeros(ny),
        count=np.zeros(ny),
        outputs=np.empty((n, ny)) if outputs else None,
        columns=np.empty((n, ny, nc)) if columns else None,
        states=np.empty((n, nx)) if states else None,
        last=np.empty(nx),
    )
    keep = None if segment.keep is None else np.ascontiguousarray(segment.keep)
    arguments = _Arguments(
        n=n, u=doubles(segment.u), y=doubles(segment.y), keep=None if keep is None else keep.ctypes.data_as(_BYTES),
        lag_a=clock.lags[0], lag_b=clock.lags[1], model=doubles(_settings(model, point, segment)),
        x0=doubles(point.x0), offset=doubles(point.offset), gain=doubles(point.gain),
        sos=doubles(weights.sections), sections=len(weights.sections), settle=weights.settle,
        knee=doubles(weights.knee), gram=doubles(result.gram), rho=doubles(result.loss), count=doubles(result.count),
        outputs=doubles(result.outputs), columns=doubles(result.columns), states=doubles(result.states),
        last=doubles(result.last),
    )  # fmt: skip
    function(ctypes.byref(arguments))
    return result
