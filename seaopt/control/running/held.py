"""A plant over a time in which its inputs are held, as between two samples: compiled, or by CasADi's virtual machine.

Where friction sticks `seaopt_slide` is a step in which no joint stops. Most are, and compiled code takes no other then.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from importlib.resources import files
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.control.running.sampled_loop import channel_names
from seaopt.plants import Plant
from seaopt.plants.memo import memo
from seaopt.simulation.direct_call import DirectCall
from seaopt.simulation.native import define_constants, generate_code, load_library
from seaopt.simulation.runge_kutta import runge_kutta_step
from seaopt.simulation.sticking import sliding_step, sticking_output, sticking_step

MAX_EXPANDED_STEPS = 8  # coarse steps per sample up to which the virtual machine's operations are one flat list
State = Float[np.ndarray, " nx"]
Ends = tuple[State, State, Float[np.ndarray, " ny"]]
Hold = Callable[[float, State, Sequence[float], Float[np.ndarray, " np"], float, int], Ends]


@memo
def observe_function(plant: Plant, sticks: bool) -> Any:
    """Return the CasADi function (t, x, u, p) -> outputs, and the energy where the plant declares it."""
    output = sticking_output(plant)(plant.t, plant.x, plant.u, plant.p) if sticks else plant.output
    rows = [output] + ([plant.stored_energy()] if plant.energy is not None else [])
    return ca.Function("seaopt_observe", [plant.t, plant.x, plant.u, plant.p], [ca.densify(ca.vertcat(*rows))])


@memo
def step_function(plant: Plant, sticks: bool) -> Any:
    """Return the CasADi function (t, x, u, p, h) -> x+: one integration step, u held; of Runge's and Kutta's fourth
    order where nothing sticks.
    """
    if sticks:
        return sticking_step(plant)
    rate = ca.Function("rate", [plant.t, plant.x, plant.u, plant.p], [plant.dynamics])
    t, x, u, p, h = plant.t, plant.x, plant.u, plant.p, ca.SX.sym("h")
    after = runge_kutta_step(lambda t, x: rate(t, x, u, p), t, x, h)
    return ca.Function("seaopt_step", [t, x, u, p, h], [ca.cse(ca.densify(after))])


@memo
def advance_function(plant: Plant, sticks: bool) -> Any:
    """Return the CasADi function (t, x, peak, u, p, h) -> (x+, peak+): one integration step, and the largest |y|."""
    t, x, u, p, h = plant.t, plant.x, plant.u, plant.p, ca.SX.sym("h")
    peak = ca.SX.sym("peak", len(channel_names(plant)))
    after = step_function(plant, sticks)(t, x, u, p, h)
    top = ca.fmax(peak, ca.fabs(observe_function(plant, sticks)(t + h, after, u, p)))
    return ca.Function("seaopt_advance", [t, x, peak, u, p, h], ca.cse([after, ca.densify(top)]))


def read_code(name: str) -> str:
    """Return the text of a file of C beside this one."""
    return files("seaopt.control.running").joinpath(name).read_text(encoding="utf-8")


def plant_source(plant: Plant, sticks: bool, *functions: ca.Function) -> str:
    """Return the C of a plant's steps (piece.h), with further functions."""
    steps = [step_function(plant, sticks), observe_function(plant, sticks), *([sliding_step(plant)] if sticks else [])]
    constants = {"NX": len(plant.states), "NY": len(channel_names(plant)), "STICKS": int(sticks)}
    return "\n".join((define_constants(constants), generate_code(*functions, *steps), read_code("piece.h")))


def make_hold(plant: Plant, sticks: bool) -> Hold:
    """Return what takes (t, x, u, p, T, steps) to x after T in so many steps and in twice as many, and the largest
    outputs of these.
    """
    library = _compile(plant, sticks)
    return _hold_interpreted(plant, sticks) if library is None else _hold_compiled(plant, library)


@memo
def _compile(plant: Plant, sticks: bool) -> Any:
    """Return the library of held.c; None where there is no compiler."""
    library: Any = load_library(plant_source(plant, sticks) + read_code("held.c"), "seaopt_hold")
    if library is not None:
        library.seaopt_hold.argtypes = [*[ctypes.c_double] * 2, ctypes.c_long, *[ctypes.c_void_p] * 6]
        library.seaopt_hold.restype = None
    return library


def _hold_compiled(plant: Plant, library: Any) -> Hold:
    sizes = [len(each) for each in (plant.states, plant.inputs, plant.parameters)]
    ends = (np.zeros(sizes[0]), np.zeros(sizes[0]), np.zeros(len(channel_names(plant))))
    given, call = [np.zeros(size) for size in sizes], library.seaopt_hold
    pointers = [array.ctypes.data for array in (*given, *ends)]

    def hold(t: float, x: State, u: Sequence[float], p: Float[np.ndarray, " np"], lasting: float, steps: int) -> Ends:
        for numbers, argument in zip(given, (x, u, p), strict=True):
            numbers[:] = argument
        call(t, lasting, steps, *pointers)
        return ends[0].copy(), ends[1].copy(), ends[2].copy()

    return hold


def _hold_interpreted(plant: Plant, sticks: bool) -> Hold:
    calls = dict[int, DirectCall]()

    def hold(t: float, x: State, u: Sequence[float], p: Float[np.ndarray, " np"], lasting: float, steps: int) -> Ends:
        if steps not in calls:
            calls[steps] = DirectCall(_ends(plant, steps, sticks))
        coarse, fine, peak = (end[:, 0] for end in calls[steps](t, x, u, p, lasting))
        return coarse, fine, peak

    return hold


@memo
def _ends(plant: Plant, substeps: int, sticks: bool) -> Any:
    """Return the CasADi function (t, x, u, p, T) -> x after T in `substeps` steps and in twice as many, and the largest
    outputs of these.
    """
    step = advance_function(plant, sticks)
    t, x, u, p, lasting = (
        ca.MX.sym(name, size) for name, size in zip("txupT", map(step.numel_in, (0, 1, 3, 4, 5)), strict=True)
    )
    ends, top = list[Any](), None
    for count in (substeps, 2 * substeps):
        at, top, h = x, ca.MX.zeros(step.numel_in(2)), lasting / count
        for i in range(count):
            at, top = step(t + i * h, at, top, u, p, h)
        ends.append(ca.densify(at))
    whole = ca.Function("held", [t, x, u, p, lasting], [*ends, ca.densify(top)])
    return whole.expand() if substeps <= MAX_EXPANDED_STEPS else whole
