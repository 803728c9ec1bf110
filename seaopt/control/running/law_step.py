"""A law's step, scheduled or not, as an expression of CasADi: outer loop, gate, hold, terms, limit, heat.

A law whose inputs are numbers (within +-1e15) gives finite ones, so that only the inputs are asked. What is kept from
one sample to the next is the law's state, what its terms remember, the gate's last reading with how many were refused
since, the temperatures, the place of a schedule, what the outer loop keeps, and the last command, which is repeated
where a sample cannot be used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, reduce
from importlib.resources import files
from operator import add, mul
from threading import get_ident
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float

from seaopt.control.laws.plausibility import LARGEST
from seaopt.control.laws.realisation import LawState, RunnableLaw
from seaopt.control.loops.compensation.terms import CompensationShape, compensate
from seaopt.control.loops.outer_loop import FIRST, follow_link
from seaopt.control.scheduling.runnable_schedule import RunnableSchedule, ScheduleShape, ScheduleState
from seaopt.plants.motor.heat_guard import HEAT_NUMBERS, limit_current, warm_winding
from seaopt.records import record
from seaopt.simulation.direct_call import DirectCall
from seaopt.simulation.native import Kernel, define_constants, generate_code, load_kernel

GATE_NUMBERS, OUTER_NUMBERS = 5, 4
CHUNK = 500  # samples that a law is run over in one call of the virtual machine
_POINTERS = ("c", "r", "y", "w", "place", "kept", "out")
_ARGUMENTS = np.dtype([("n", np.int64), *((name, np.uint64) for name in _POINTERS)])


@record
class LawShape:
    """What a law's step depends on; all else is numbers."""

    states: int
    measured: int
    limited: bool
    gated: bool
    heated: bool
    compensation: CompensationShape
    schedule: ScheduleShape | None = None
    holds: bool = True  # the last command where an input is not a number
    encoders: tuple[str, ...] = ()  # that the gate reads
    position: str = ""  # that the outer loop reads, where there is one
    pushed: bool = False  # it has no stiffness, so that the reference is a force

    @classmethod
    def of_law(cls, law: RunnableLaw | RunnableSchedule) -> LawShape:
        """Return the shape of a law."""
        schedule = law.shape if isinstance(law, RunnableSchedule) else None
        return cls(
            states=law.c.size if isinstance(law, RunnableLaw) else len(law.table.states),
            measured=law.measured,
            limited=bool(np.isfinite(law.command_limit)),
            gated=law.gate is not None,
            heated=law.heat is not None,
            compensation=CompensationShape() if law.compensation is None else law.compensation.shape,
            schedule=schedule,
            encoders=() if law.gate is None else law.gate.reads,
            position="" if law.outer is None else law.outer.position,
            pushed=law.outer is not None and not law.outer.stiffness,
        )

    @property
    def further(self) -> tuple[str, ...]:
        """The outputs that are read besides what is fed back."""
        positions = (self.position,) if self.position else ()
        return tuple(dict.fromkeys((*self.compensation.reads, *self.encoders, *positions)))

    @property
    def row_sizes(self) -> tuple[int, ...]:
        """How many numbers of a sample are given: reference, what is fed back, what is read besides, the place."""
        return 1, self.measured, len(self.further), int(self.schedule is not None)

    @property
    def sizes(self) -> tuple[int, ...]:
        """How many numbers are kept: of state, terms, gate, temperatures, place, outer loop, command."""
        placed, around = int(self.schedule is not None), len(FIRST) * bool(self.position)
        return self.states, self.compensation.remembered, 3 * self.gated, 2 * self.heated, placed, around, 1

    @property
    def kept(self) -> int:
        """How many in all."""
        return sum(self.sizes)

    @property
    def number_sizes(self) -> tuple[int, ...]:
        """How many numbers of each kind `list_numbers` gives: of the law by itself, limit, command, what is around it,
        terms.
        """
        gate = GATE_NUMBERS * self.gated + (2 + len(self.encoders) if self.encoders else 0)
        guards = gate, HEAT_NUMBERS * self.heated, OUTER_NUMBERS * bool(self.position)
        law = sum(self.matrix_sizes) if self.schedule is None else self.schedule.size
        return law, 1, 1, *guards, self.compensation.size if self.schedule is None else 0

    @property
    def matrix_sizes(self) -> tuple[int, ...]:
        """How many numbers each matrix of a law has that is not scheduled."""
        n, y = self.states, self.measured
        return n * n, n, y * n, n, n, 1, y


def list_numbers(law: RunnableLaw | RunnableSchedule) -> Float[np.ndarray, " m"]:
    """Return the numbers of a law, as `express_step` takes them."""
    gate, limit = law.gate, law.force_limit_N if np.isfinite(law.command_limit) else 0.0
    numbers = [limit, law.per_effort]
    if gate is not None:
        numbers += [*gate.range_N, gate.max_step_N, gate.max_held, gate.ramp_per_s * law.sample_time_s]
        numbers += [] if gate.agreement is None else gate.agreement.numbers
    numbers += [] if law.heat is None else law.heat.numbers
    numbers += [] if law.outer is None else law.outer.numbers
    if isinstance(law, RunnableSchedule):
        return np.concatenate([law.numbers, numbers])
    numbers += [] if law.compensation is None else law.compensation.numbers
    matrices = law.a.ravel("F"), law.b_reference, law.b_measurement.ravel("F"), law.c, law.anti_windup
    return np.concatenate([*matrices, [law.d_reference], np.ravel(law.d_measurement), numbers])


def list_kept(law: RunnableLaw | RunnableSchedule, state: LawState) -> Float[np.ndarray, " n"]:
    """Return what a law in a state keeps, as `express_step` takes it."""
    seen = state.gate
    parts = (
        state.x,
        state.memory[: LawShape.of_law(law).compensation.remembered],
        () if law.gate is None else (np.nan_to_num(seen.measurement), not np.isnan(seen.measurement), seen.held),
        () if law.heat is None else state.heat,
        (state.place,) if isinstance(state, ScheduleState) else (),
        () if law.outer is None else state.outer,
        (state.command,),
    )
    return np.concatenate(parts).astype(float)


def find_faults(law: RunnableLaw | RunnableSchedule, kept: Float[np.ndarray, "runs n"]) -> Bool[np.ndarray, " runs"]:
    """Tell where the gate of a law, of which this is kept, has given up its sensor."""
    shape = LawShape.of_law(law)
    if law.gate is None:
        return np.zeros(len(kept), dtype=bool)
    return kept[:, sum(shape.sizes[:3]) - 1] > law.gate.max_held


def run_law(
    law: RunnableLaw | RunnableSchedule,
    references: Float[np.ndarray, " n"],
    measured: Float[np.ndarray, "n y"],
    further: Float[np.ndarray, "n r"],
    places: Float[np.ndarray, " n"] | None,
    start: LawState,
) -> Float[np.ndarray, " n"]:
    """Return the commands of a law over samples whose inputs are numbers, by the step that the compiled loop runs.
    `further`: what its terms read; `places`: of a schedule, its variable.
    """
    # Without a limit it is infinite here, and so one kernel less.
    shape = replace(LawShape.of_law(law), limited=True, holds=law.gate is not None)
    numbers, kept = list_numbers(law), list_kept(law, start)
    if not np.isfinite(law.command_limit):
        numbers[shape.number_sizes[0]] = np.inf
    signals, out = (references, measured, further, () if places is None else places), np.empty(references.size)
    rows = [
        np.ascontiguousarray(signal, dtype=float).reshape(out.size, width)
        for signal, width in zip(signals, shape.row_sizes, strict=True)
    ]
    kernel = _load_kernel(shape)
    if kernel is None:
        return _run_interpreted(shape, numbers, kept, rows)
    arguments = np.zeros(1, dtype=_ARGUMENTS)
    arguments["n"] = out.size
    for name, array in zip(_POINTERS, (numbers, *rows, kept, out), strict=True):
        arguments[name] = array.ctypes.data
    kernel.run(arguments, (numbers, rows, kept, out), parallel=False)
    return out


def _run_interpreted(
    shape: LawShape,
    numbers: Float[np.ndarray, " m"],
    kept: Float[np.ndarray, " k"],
    signals: Sequence[Float[np.ndarray, "n _"]],
) -> Float[np.ndarray, " n"]:
    """Run in CasADi's virtual machine."""
    run, numbers, n = _chain_steps(shape, get_ident()), np.tile(numbers, CHUNK), len(signals[0])
    out = np.empty(n)
    for first in range(0, n, CHUNK):
        at = np.minimum(np.arange(first, first + CHUNK), n - 1)  # the last chunk is filled up
        after, commands = run(kept, numbers, *(signal[at].ravel() for signal in signals))
        out[first : first + CHUNK] = commands[0, : n - first]
        kept = after[:, -1]
    return out


@lru_cache(maxsize=16)
def _chain_steps(shape: LawShape, _thread: int) -> DirectCall:
    """Return the steps of a chunk in a row, which a thread has to itself: what is kept after each, and the commands."""
    return DirectCall(_step_function(shape).mapaccum(CHUNK))


@lru_cache(maxsize=64)
def _load_kernel(shape: LawShape) -> Kernel | None:
    """Return the compiled steps of a law; None where there is no compiler."""
    sizes = zip(("NY", "NW", "NP"), shape.row_sizes[1:], strict=True)
    constants = define_constants({"NK": shape.kept, **dict(sizes)})
    template = files("seaopt.control.running").joinpath("law_run.c").read_text(encoding="utf-8")
    return load_kernel("\n".join((constants, generate_code(_step_function(shape)), template)), "seaopt_laws")


def _step_function(shape: LawShape) -> Any:
    """Return the CasADi function (kept, numbers, reference, measured, further, place) -> (kept+, command)."""
    kept, numbers = ca.SX.sym("kept", shape.kept), ca.SX.sym("numbers", sum(shape.number_sizes))
    names = "r", "y", "w", "place"
    r, y, more, variable = (ca.SX.sym(name, size) for name, size in zip(names, shape.row_sizes, strict=True))
    command, after = express_step(shape, numbers, kept, r, ca.vertsplit(y), ca.vertsplit(more), variable)
    arguments = [kept, numbers, r, y, more, variable]
    return ca.Function("seaopt_step", arguments, [ca.densify(after), ca.densify(command)])


def _is_number(value: Any) -> Any:
    return ca.fabs(value) <= LARGEST


def express_step(
    shape: LawShape,
    numbers: Any,
    kept: Any,
    reference: Any,
    measured: Sequence[Any],
    further: Sequence[Any],
    variable: Any = None,
) -> tuple[Any, Any]:
    """Return the command and what is kept after a sample; `further`: the readings of what the shape names so;
    `variable`: the scheduling variable, where there is one.
    """
    law, most, gain, gate, heat, around, added = ca.vertsplit(numbers, np.cumsum([0, *shape.number_sizes]).tolist())
    x, memory, seen, rises, at, outer, last = ca.vertsplit(kept, np.cumsum([0, *shape.sizes]).tolist())
    if shape.position:
        position = further[shape.further.index(shape.position)]
        x_0, force = (0.0, reference) if shape.pushed else (reference, 0.0)
        moved = ca.vertcat(*follow_link(ca.vertsplit(around), ca.vertsplit(outer), x_0, position))
        if shape.holds:
            moved = ca.if_else(ca.logic_and(_is_number(x_0), _is_number(position)), moved, outer)
        outer, reference = moved, force + moved[-1]
    fault, has_last, measured, memory, rises = 0.0, 1.0, list(measured), ca.vertsplit(memory), ca.vertsplit(rises)
    if shape.gated:
        encoders = [further[shape.further.index(name)] for name in shape.encoders]
        measured[0], seen, fault = _screen(ca.vertsplit(gate), ca.vertsplit(seen), measured[0], encoders)
        has_last = seen[1]
    further, limit = further[: len(shape.compensation.reads)], most * gain
    if shape.heated:
        cool = limit_current(ca.vertsplit(heat), rises, ca)
        limit = ca.fmin(limit, cool) if shape.limited else cool
        most = limit / gain

    def saturate(force: Any) -> Any:
        return ca.fmin(ca.fmax(force, -most), most) if shape.limited or shape.heated else force

    gains, terms = dict[str, Any](), ca.vertsplit(added)
    if shape.schedule is not None:
        at = ca.if_else(_is_number(variable), variable, at)
        gains = shape.schedule.express_gains(law, at)
        terms = [gains[name] for name in shape.schedule.columns[-shape.compensation.size :] if shape.compensation.size]
    r, effort, after = compensate(shape.compensation, terms, memory, reference, further, ca)
    if shape.schedule is not None:
        _, applied, following = shape.schedule.express_step(gains, x, r, measured, saturate, effort)
    else:
        applied, following = _advance(shape, law, x, r, ca.vertcat(*measured), saturate, effort)
    command, moved = gain * applied, ca.vertcat(following, *after)
    if shape.holds:
        usable = reduce(ca.logic_and, map(_is_number, [reference, *measured, *further]))
        usable = ca.logic_and(ca.logic_and(usable, has_last), ca.logic_not(fault))
        command, moved = (ca.if_else(usable, *pair) for pair in ((command, last), (moved, ca.vertcat(x, *memory))))
    if shape.gated:
        ramp = gate[GATE_NUMBERS - 1]
        command = ca.if_else(fault, last - ca.fmin(ca.fmax(last, -ramp), ramp), command)
    if shape.heated:
        command = ca.fmin(ca.fmax(command, -limit), limit)
        rises = warm_winding(ca.vertsplit(heat), rises, command, ca)
    return command, ca.vertcat(moved, *(seen if shape.gated else ()), *rises, at, outer, command)


def _advance(
    shape: LawShape, numbers: Any, x: Any, r: Any, read: Any, saturate: Callable[[Any], Any], effort: Any
) -> tuple[Any, Any]:
    """Return what is left of the effort of a law of matrices in its limit, and the next state."""
    n, y = shape.states, shape.measured
    a, b_r, b_y, out, windup, d_r, d_y = ca.vertsplit(numbers, np.cumsum([0, *shape.matrix_sizes]).tolist())
    force = ca.densify(ca.mtimes(out.T, x)) + d_r * r - ca.dot(d_y, read) + effort
    applied = saturate(force)
    after = ca.mtimes(ca.reshape(a, n, n), x) + b_r * r - ca.mtimes(ca.reshape(b_y, n, y), read)
    return applied, after + windup * (applied - force)


def _screen(
    numbers: Sequence[Any], seen: Sequence[Any], reading: Any, encoders: Sequence[Any]
) -> tuple[Any, list[Any], Any]:
    """Return the reading to use, what the gate has seen, and whether that is a fault: `PlausibilityGate.screen`."""
    (low, high, step, longest, _, *agreement), (last, has_last, refused) = numbers, seen
    near = ca.logic_or(ca.logic_not(has_last), ca.fabs(reading - last) <= step * (refused + 1.0))
    believed = ca.logic_and(ca.logic_and(reading >= low, reading <= high), near)
    if encoders:
        limit, share, *weights = agreement
        through = reduce(add, map(mul, weights, encoders))
        agrees = ca.fabs(reading - through) <= limit + share * ca.fabs(through)
        believed = reduce(ca.logic_and, map(_is_number, encoders), ca.logic_and(believed, agrees))
    believed = ca.logic_and(believed, refused <= longest)  # beyond that a fault, which lasts
    used = ca.if_else(believed, reading, last)
    after = ca.if_else(believed, 0.0, ca.if_else(refused <= longest, refused + 1.0, refused))
    return used, [used, ca.logic_or(has_last, believed), after], after > longest
