"""The steps of predictive control by its own exported C, where there is a compiler: what runs of many samples take."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from seaopt.control.mpc.active_set import UNFINISHED
from seaopt.control.mpc.export import collect_code, list_sources
from seaopt.control.mpc.mpc import ForceMPC, References
from seaopt.control.mpc.step import MPCState, read_references
from seaopt.plants.memo import memo
from seaopt.simulation.native import load_library

NAME, FAULT = "seaopt_plan", 2
CALL = f"""
#pragma GCC optimize ("fp-contract=off")
#include "force_mpc.c"
#include "active_set.c"
__attribute__((visibility("default"))) long {NAME}_size(void) {{ return sizeof(force_mpc); }}
__attribute__((visibility("default"))) void {NAME}_reset(force_mpc *s) {{ force_mpc_reset(s); }}
__attribute__((visibility("default"))) double {NAME}(force_mpc *s, const double *r, long known, double y,
                                                     const double *readings, double *target, int *told) {{
#if FORCE_MPC_TERMS
  force_mpc_terms(s, r[0], readings);
#endif
  double command = force_mpc_step_ahead(s, r, (int)known, y);
  (void)readings;
  *target = s->target;
  told[0] = s->solved;
  told[1] = s->iterations;
  told[2] = s->status;
  return command;
}}
"""


class PlanSample(NamedTuple):
    """What a step made: the command, the nearest force to the last reference that the limits hold, and how it ended."""

    command: float
    target: float
    solved: bool
    unfinished: bool  # not solved for want of iterations
    iterations: int
    faulted: bool  # by the gate


Stepper = Callable[[float | References, float, Sequence[float]], PlanSample]


def make_stepper(plan: ForceMPC, start: MPCState | None = None) -> Stepper:
    """Return what does one step after the other, from a state or from rest at zero: what `ForceMPC.step` does, compiled
    where it begins at zero and there is a compiler.
    """
    library = _compile(plan) if start is None else None
    return _step_here(plan, start or plan.start) if library is None else _step_compiled(plan, library)


def _step_here(plan: ForceMPC, state: MPCState) -> Stepper:
    def step(reference: float | References, measurement: float, readings: Sequence[float]) -> PlanSample:
        nonlocal state
        made = plan.step(state, reference, measurement, readings)
        state, unfinished = made.state, made.status.startswith(UNFINISHED) and not made.solved
        return PlanSample(made.command, made.target_N, made.solved, unfinished, made.iterations, state.gate.fault)

    return step


def _step_compiled(plan: ForceMPC, library: Any) -> Stepper:
    memory = ctypes.create_string_buffer(library.seaopt_plan_size())
    library.seaopt_plan_reset(memory)
    target, told, most, call = ctypes.c_double(), (ctypes.c_int * 3)(), plan.spec.max_iterations, library.seaopt_plan
    places = (ctypes.c_double * max(len(plan.reads), 1))()
    pointers, preview = (ctypes.byref(target), told), plan.spec.preview_samples

    def step(reference: float | References, measurement: float, readings: Sequence[float]) -> PlanSample:
        known = np.ascontiguousarray(read_references(reference, preview))
        places[: len(readings)] = readings
        command = call(memory, known.ctypes.data, known.size, measurement, places, *pointers)
        solved, iterations, status = told
        return PlanSample(
            command, target.value, bool(solved), not solved and iterations >= most, iterations, status == FAULT
        )

    return step


@memo
def _compile(plan: ForceMPC) -> Any:
    """Return the library of a plan's C code; None where there is no compiler."""
    files = list_sources(collect_code(plan))
    included = re.compile(r'^\s*#include "(\S+)"$', re.MULTILINE)

    def insert(text: str) -> str:
        return included.sub(lambda line: insert(files.get(line[1], "")), text)

    library: Any = load_library(insert(CALL), NAME)
    if library is not None:
        library.seaopt_plan.restype = ctypes.c_double
        library.seaopt_plan.argtypes = [
            ctypes.c_void_p, ctypes.c_void_p, ctypes.c_long, ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p,
            ctypes.c_void_p,
        ]  # fmt: skip
    return library
