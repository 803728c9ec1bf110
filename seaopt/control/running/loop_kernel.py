"""Kernels of sampled loops, for `closed_loop`: CasADi functions, run compiled or by CasADi's virtual machine.

`seaopt_sample` is sensor, law and delay at one sample; between samples the plant's inputs are held (`held`).
Parameters and the law's matrices are data, so that one compilation serves every draw and every controller of a
structure. The two ways give the same numbers to rounding, of which a quantiser can make a step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.bench import Sensors
from seaopt.control.laws.plausibility import LARGEST
from seaopt.control.running.held import (
    MAX_EXPANDED_STEPS,
    advance_function,
    observe_function,
    plant_source,
    read_code,
)
from seaopt.control.running.law_step import LawShape, express_step, list_numbers
from seaopt.control.running.sampled_loop import LoopState, SampledLoop, channel_names
from seaopt.errors import SimulationError, require_memory
from seaopt.plants import Plant
from seaopt.plants.memo import memo
from seaopt.plants.sensors.deflection import weigh_encoders
from seaopt.records import record
from seaopt.simulation.native import Kernel, define_constants, load_kernel, row_addresses

INSTANT = 1e-9  # of a sample: after it an output shows what the command does at once
CHAINED_SAMPLES = 250  # samples that the virtual machine chains in one call
Rows = Float[np.ndarray, "runs n"]


@record(eq=False)
class Job:
    """The data of runs, checked. `lag` picks, of the newest command and those that wait, the one in force at the start
    of a sample and the one after `late_s` seconds of it.
    """

    reference: Rows
    noise: Float[np.ndarray, "runs n y"]
    external: Float[np.ndarray, "n ne"]
    p: Float[np.ndarray, "runs np"]
    lag: Float[np.ndarray, "runs w"]
    late_s: Float[np.ndarray, " runs"]
    start: LoopState
    start_s: float

    @property
    def fails(self) -> bool:
        """Whether something that a law is given is not a number. Without that a reading beyond what it takes for one
        is that of a loop that runs away, which is followed up to what floats can hold.
        """
        return not all(np.all(np.abs(signal) <= LARGEST) for signal in (self.reference, self.noise))


@record(eq=False)
class Steps:
    """Integration steps of a sample: `coarse` and twice as many. Both are doubled in a sample whose two ends differ by
    more than `most`, while the coarse ones are at most `finest`.
    """

    coarse: int
    finest: int
    most: Float[np.ndarray, "runs nx"]

    @property
    def even(self) -> bool:
        """Whether every sample takes the same number."""
        return self.finest == self.coarse


@record(eq=False)
class LoopArrays:
    """What a kernel leaves behind: arrays of one row per run."""

    x: Float[np.ndarray, "runs nx"]
    z: Float[np.ndarray, "runs nz"]
    peak: Float[np.ndarray, "runs ny"]
    error: Float[np.ndarray, "runs nx"]
    size: Float[np.ndarray, "runs nx"]
    y: Float[np.ndarray, "runs n ny"]
    applied: Rows
    states: Float[np.ndarray, "runs n nx"]


@record
class _Device:
    """What a sensor does to a reading besides adding an offset and noise."""

    saturates: bool
    quantises: bool

    def read(self, value: Any, numbers: Any) -> Any:
        """Return the reading of a value; the numbers are those of `_describe_device`."""
        offset, highest, quantum = ca.vertsplit(numbers)
        reading = value + offset
        if self.saturates:
            reading = ca.fmin(ca.fmax(reading, -highest), highest)
        return quantum * ca.floor(reading / quantum + 0.5) if self.quantises else reading


def _describe_device(sensors: Sensors, name: str) -> tuple[_Device, list[float]]:
    """Return a sensor, and the numbers that are data: offset, range and step."""
    highest, quantum = sensors.saturation.get(name), sensors.quantisation.get(name, 0.0)
    device = _Device(saturates=highest is not None, quantises=bool(quantum))
    return device, [sensors.offset.get(name, 0.0), highest or 0.0, quantum]


@record
class _Structure:
    """What the functions of a loop depend on besides its plant; all else is data."""

    law: LawShape
    measured: tuple[str, ...]
    waiting: int
    rounds_current: bool
    devices: tuple[_Device, ...]  # one per measured output
    encoders: tuple[tuple[str, _Device], ...]  # with errors, of those that the reading is computed from
    sticks: bool
    over: str | None  # which state a schedule is over, of a plant that has it

    @property
    def columns(self) -> int:
        """How many numbers of a sample are data: an error of each reading, and where a scheduling variable is."""
        return len(self.measured) + (self.law.schedule is not None)


def _structure_of(loop: SampledLoop, job: Job) -> _Structure:
    sensors, names = loop.sensors, loop.signals
    return _Structure(
        law=replace(LawShape.of_law(loop.law), holds=job.fails or loop.law.gate is not None),
        measured=names,
        waiting=loop.waiting,
        rounds_current=bool(loop.command_step),
        devices=tuple(_describe_device(sensors, name)[0] for name in names),
        encoders=tuple((encoder, _describe_device(sensors, encoder)[0]) for encoder in loop.encoders),
        sticks=loop.sticks,
        over=loop.place if loop.place in loop.plant.states else None,
    )


def _sample_function(plant: Plant, structure: _Structure) -> Any:
    """Return the CasADi function (t, x, z, e, r, w, p, c, lag) -> (z+, u, late, y): sensor, law and delay at a sample.
    `u` holds the current in force at first, `late` is the one after it.
    """
    law, queue, measured, kept = structure.law, structure.waiting, len(structure.measured), structure.law.kept
    z, r, w = ca.SX.sym("z", kept + queue), ca.SX.sym("r"), ca.SX.sym("w", structure.columns)
    e, devices = ca.SX.sym("e", len(plant.inputs) - 1), ca.SX.sym("devices", 3, measured + len(structure.encoders))
    numbers, amplifier = ca.SX.sym("c", sum(law.number_sizes)), ca.SX.sym("amplifier", 2)
    c = ca.vertcat(numbers, amplifier, ca.vec(devices))
    observe = observe_function(plant, structure.sticks)
    lag, behind = ca.SX.sym("lag", 2 * (queue + 1)), ca.reshape(z[kept:], queue, 1)
    first, second = lag[: queue + 1], lag[queue + 1 :]
    waiting = ca.densify(ca.mtimes(ca.reshape(first[1:], queue, 1).T, behind))
    outputs = dict(
        zip(plant.outputs, ca.vertsplit(observe(plant.t, plant.x, ca.vertcat(waiting, e), plant.p)), strict=False)
    )
    readings: list[Any] = []
    for column, (signal, device) in enumerate(zip(structure.measured, structure.devices, strict=True)):
        reading, weights = outputs.get(signal, 0.0) + w[column], {}
        if signal in outputs:
            weights = weigh_encoders(plant, signal)
        for number, (name, encoder) in enumerate(structure.encoders, measured):
            if name in weights:
                reading += weights[name] * (encoder.read(outputs[name], devices[:, number]) - outputs[name])
        readings.append(device.read(reading, devices[:, column]))
    further = [readings[structure.measured.index(name)] for name in law.further]
    variable = w[-1] if structure.over is None else plant.x[list(plant.states).index(structure.over)]
    current, after = express_step(law, numbers, z[:kept], r, readings[: law.measured], further, variable)
    if structure.rounds_current:
        step, most = ca.vertsplit(amplifier)
        current = step * ca.floor(current / step + 0.5)
        if law.limited:
            current = ca.fmin(ca.fmax(current, -most), most)
    moved = ca.vertcat(after, *([current, *(behind[i] for i in range(queue - 1))] if queue else []))
    commands = ca.vertcat(current, behind)
    u, late = ca.vertcat(ca.dot(first, commands), e), ca.dot(second, commands)
    arguments = [plant.t, plant.x, z, e, r, w, plant.p, c, lag]
    return ca.Function("seaopt_sample", arguments, [ca.densify(moved), u, late, observe(plant.t, plant.x, u, plant.p)])


def _constants(loop: SampledLoop) -> Float[np.ndarray, " m"]:
    numbers = [loop.command_step, loop.most if math.isfinite(loop.most) else 0.0]
    for name in (*loop.signals, *loop.encoders):
        numbers += _describe_device(loop.sensors, name)[1]
    return np.concatenate([list_numbers(loop.law), numbers])


@memo
def _kernel(plant: Plant, structure: _Structure) -> tuple[Any, Kernel | None]:
    """Return the function of one sample, and the library of a loop where there is a compiler."""
    sample = _sample_function(plant, structure)
    return sample, load_kernel(_source(plant, structure, sample), "seaopt_loops")


def make_kernel(loop: SampledLoop, job: Job) -> Callable[[Job, Steps], LoopArrays]:
    """Return what runs a job: compiled code or, without a compiler, CasADi's virtual machine."""
    native, constants = _kernel(loop.plant, _structure_of(loop, job))[1], _constants(loop)
    if native is None:
        return partial(_run_interpreted, loop, constants)
    return partial(_run_compiled, loop, constants, native)


def _source(plant: Plant, structure: _Structure, sample: ca.Function) -> str:
    constants = {
        "NU": len(plant.inputs), "NE": len(plant.inputs) - 1, "NW": structure.columns,
        "NZ": structure.law.kept + structure.waiting, "INSTANT": INSTANT,
    }  # fmt: skip
    return define_constants(constants) + plant_source(plant, structure.sticks, sample) + read_code("closed_loop.c")


def _allocate(loop: SampledLoop, job: Job) -> LoopArrays:
    runs, n = job.reference.shape
    nx, ny = len(loop.plant.states), len(channel_names(loop.plant))
    require_memory(runs * n * (nx + ny + 1), f"{runs} runs of {n} samples", SimulationError)
    return LoopArrays(
        x=np.array(job.start.x, dtype=float, order="C"),
        z=np.array(job.start.z, dtype=float, order="C"),
        peak=np.zeros((runs, ny)),
        error=np.zeros((runs, nx)),
        size=np.zeros((runs, nx)),
        y=np.zeros((runs, n, ny)),
        applied=np.zeros((runs, n)),
        states=np.zeros((runs, n, nx)),
    )


_CARRIED = ("x", "z", "peak", "error", "size")  # from sample to sample
_POINTERS = ("p", "c", "lag", "most", "r", "w", "e", "x", "z", "peak", "error", "size", "y", "applied", "states")
_ARGUMENTS = np.dtype(
    [
        ("n", np.int64),
        ("substeps", np.int64),
        ("finest", np.int64),
        ("t0", float),
        ("period", float),
        ("late_s", float),
        *((name, np.uint64) for name in _POINTERS),
    ]
)


def _run_compiled(loop: SampledLoop, c: Float[np.ndarray, " m"], native: Kernel, job: Job, steps: Steps) -> LoopArrays:
    arrays = _allocate(loop, job)
    runs, n = job.reference.shape
    arguments = np.zeros(runs, dtype=_ARGUMENTS)
    arguments["n"], arguments["substeps"], arguments["finest"] = n, steps.coarse, steps.finest
    arguments["t0"], arguments["period"] = job.start_s, loop.law.sample_time_s
    arguments["late_s"] = job.late_s
    results = {field.name: getattr(arrays, field.name) for field in fields(arrays)}
    rows = {"p": job.p, "lag": job.lag, "most": steps.most, "r": job.reference, "w": job.noise, **results}
    for name, array in rows.items():
        arguments[name] = row_addresses(array)
    arguments["c"], arguments["e"] = c.ctypes.data, job.external.ctypes.data
    native.run(arguments, (job, c, steps, arrays))
    return arrays


def _run_interpreted(loop: SampledLoop, c: Float[np.ndarray, " m"], job: Job, steps: Steps) -> LoopArrays:
    """Run in CasADi's virtual machine: its functions of a sample and of a step, chained in another."""
    arrays = _allocate(loop, job)
    runs, n = job.reference.shape
    chunk = min(n, CHAINED_SAMPLES)
    split = bool(np.any(job.late_s))
    structure = _structure_of(loop, job)
    chain = _chain(loop.plant, structure, loop.law.sample_time_s, steps.coarse, steps.finest, chunk, split)
    times = job.start_s + loop.law.sample_time_s * np.arange(n)
    for run in range(runs):
        state = np.concatenate([getattr(arrays, name)[run] for name in _CARRIED])
        constants = (job.p[run], c, job.lag[run], job.late_s[run : run + 1], steps.most[run])
        shared = [np.repeat(constant[:, None], chunk, axis=1) for constant in constants]
        signals = (times[None], job.external.T, job.reference[run, None], job.noise[run].T)
        for first in range(0, n, chunk):
            at = np.minimum(np.arange(first, first + chunk), n - 1)  # the last chunk is filled up
            results = chain(state, *(signal[:, at] for signal in signals), *shared)
            rows = slice(first, min(first + chunk, n))
            after, y, applied, states = (np.array(part)[:, : rows.stop - first] for part in results)
            arrays.y[run, rows], arrays.applied[run, rows], arrays.states[run, rows] = y.T, applied[0], states.T
            state = after[:, -1]
        for name in _CARRIED:
            width = getattr(arrays, name).shape[1]
            getattr(arrays, name)[run], state = state[:width], state[width:]
    return arrays


@memo
def _chain(
    plant: Plant, structure: _Structure, sample_time_s: float, coarse: int, finest: int, chunk: int, split: bool
) -> Any:
    """Return `_period_function` of `chunk` samples in a row."""
    period = _period_function(plant, structure, sample_time_s, coarse, finest, split)
    return (period.expand() if coarse == finest <= MAX_EXPANDED_STEPS else period).mapaccum(chunk)


def _period_function(
    plant: Plant, structure: _Structure, sample_time_s: float, coarse: int, finest: int, split: bool
) -> Any:
    """Return ([x, z, peak, error, size], t, e, r, w, p, c, lag, late_s, most) -> (the same a sample later, y, current,
    x).
    """
    sample, _ = _kernel(plant, structure)
    sizes = [len(plant.states), structure.law.kept + structure.waiting, len(channel_names(plant))]
    state = ca.MX.sym("state", sizes[0] * 3 + sizes[1] + sizes[2])
    t, r, late_s = (ca.MX.sym(name) for name in ("t", "r", "late_s"))
    e, w, p, c, lag = (
        ca.MX.sym(name, sample.numel_in(i)) for name, i in (("e", 3), ("w", 5), ("p", 6), ("c", 7), ("lag", 8))
    )
    most = ca.MX.sym("most", sizes[0])
    x, z, peak, error, size = ca.vertsplit(state, np.cumsum([0, *sizes, sizes[0], sizes[0]]).tolist())
    after, u, late, y = sample(t, x, z, e, r, w, p, c, lag)
    top = ca.fmax(peak, ca.fabs(y))
    between = partial(_between_samples, plant, structure, sample_time_s, split=split)
    arguments = [x, top, u, ca.vertcat(late, e), t, late_s, p]
    refine: ca.Function | None = None
    for halvings in reversed(range((finest // coarse).bit_length())):
        refine = _refine_function(between(coarse * 2 ** (halvings + 1)), refine)
    assert refine is not None
    fine, top, moved = refine(*arguments, most, between(coarse)(*arguments)[0])
    grown = ca.vertcat(fine, after, top, ca.fmax(error, moved), ca.fmax(size, ca.fabs(fine)))
    return ca.Function("seaopt_period", [state, t, e, r, w, p, c, lag, late_s, most], [grown, y, late, x])


def _between_samples(plant: Plant, structure: _Structure, sample_time_s: float, steps: int, *, split: bool) -> Any:
    """Return the CasADi function (x, peak, u, newer, t, late_s, p) -> (x+, peak+): a sample in so many steps."""
    advance = advance_function(plant, structure.sticks)
    x, peak, u, p = (ca.MX.sym(name, advance.numel_in(i)) for name, i in (("x", 1), ("peak", 2), ("u", 3), ("p", 4)))
    newer, t, late_s = ca.MX.sym("newer", u.numel()), ca.MX.sym("t"), ca.MX.sym("late_s")
    pieces = [(u, t, late_s), (newer, t + late_s, sample_time_s - late_s)] if split else [(newer, t, sample_time_s)]
    at, highest = x, peak
    for number, (command, begin, lasting) in enumerate(pieces):
        h = lasting / steps
        if number:  # an output that the command reaches at once
            _, highest = advance(begin, at, highest, command, p, INSTANT * sample_time_s)
        for i in range(steps):
            at, highest = advance(begin + i * h, at, highest, command, p, h)
    return ca.Function("between", [x, peak, u, newer, t, late_s, p], [at, highest])


def _refine_function(fine: ca.Function, finer: ca.Function | None) -> Any:
    """Return the CasADi function (..., most, coarse) -> (x+, peak+, |x+ - coarse|): a sample in the steps of `fine`
    or, where their end is further than `most` from that of coarser ones, in those of `finer`.
    """
    numbers = [ca.MX.sym(fine.name_in(i), fine.numel_in(i)) for i in range(fine.n_in())]
    most, coarse = (ca.MX.sym(name, fine.numel_in(0)) for name in ("most", "coarse"))
    x, peak = fine(*numbers)
    ends = [x, peak, ca.fabs(x - coarse)]
    if finer is not None:
        kept = [ca.MX.sym(name, end.numel()) for name, end in zip(("x", "peak", "moved"), ends, strict=True)]
        keep = ca.Function("keep", [*numbers, most, *kept], kept)
        further = ca.Function("further", [*numbers, most, *kept], list(finer(*numbers, most, kept[0])))
        disagree = ca.sum1(ca.logic_not(ends[2] <= most))  # of NaN, too
        ends = list(ca.Function.if_else("choose", further, keep)(disagree, *numbers, most, *ends))
    return ca.Function("refine", [*numbers, most, coarse], ends)
