r"""The loop as it will run: a continuous nonlinear plant and a law that acts once a sample.

At sample k the load cell reads :math:`m_k = Q(y_k + n_k)`, noise :math:`n_k` and quantisation Q as `Sensors` says; the
law `RunnableLaw` makes of it and of the reference a motor force, limited, with its anti-windup; the current
:math:`I = g\,\mathrm{sat}(F)` may be rounded to the amplifier's step, waits `delay_samples` samples and is then
held for one. In between

.. math:: \dot x = f(t, x, u, p), \qquad u \text{ constant},

is integrated by Runge-Kutta's method of order four in fixed steps. Every sample is integrated twice, with n and with 2n
steps; the finer result goes on, a fifteenth of the difference estimates its error (order four), and n is doubled until
that is below `rtol` of each state's largest value in every sample. It is the error of one sample from the same start:
a quantiser would turn any difference into a whole step, so that two whole runs cannot be compared.

Peaks are of every fine step, not of the samples alone: a mode at 160 Hz has six samples a period at 1 kHz, whose
largest can be 13 % below the top.

A law without delay sees the output of this moment. Where that contains the current itself (F2 of some plants) the
loop would be algebraic; it is refused.
"""

from __future__ import annotations

import ctypes
import math
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.bench import Sensors
from seaopt.control.realisation import RunnableLaw
from seaopt.errors import SimulationError, suggestion
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant, state_space
from seaopt.simulation.compiled import threads, workers
from seaopt.simulation.compiler import load_library

ENERGY = "energy"
MAX_SUBSTEPS = 512
RTOL = 1e-6
CHUNK = 250  # samples that the virtual machine chains in one call
EXPANDED = 8  # coarse steps up to which a sample is one flat list of operations there
Rows = Float[np.ndarray, "runs n"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampledLoop:
    """A plant, the law that runs, and what stands between them.

    Parameters
    ----------
    plant : Plant
        Its first input is the motor current.
    law : RunnableLaw
        As exported.
    measured : str
        The output that is fed back.
    delay_samples : int
        Whole samples from measurement to output, besides the hold.
    sensors : Sensors
        Noise, offset, range and quantisation of the measured output.
    current_step_A : float
        What the current is rounded to; 0 for not at all.

    Raises
    ------
    SimulationError
        The plant has no such output, a number is out of range, or the loop is algebraic.

    """

    plant: Plant
    law: RunnableLaw
    measured: str
    delay_samples: int
    sensors: Sensors = field(default_factory=Sensors)
    current_step_A: float = 0.0

    def __post_init__(self) -> None:
        plant = self.plant
        if self.measured not in plant.outputs:
            raise SimulationError(
                f'measured = "{self.measured}" is not an output of {plant.name}; '
                + suggestion(self.measured, plant.outputs)
            )
        if not self.current_step_A >= 0.0:
            raise SimulationError(f"current_step_A = {self.current_step_A:g} is negative; give zero or more")
        for what in ("noise_std", "quantisation", "saturation"):
            if not getattr(self.sensors, what).get(self.measured, 0.0) >= 0.0:
                raise SimulationError(f"{what} of {self.measured} is negative; give zero or more")
        row = plant.output[list(plant.outputs).index(self.measured)]
        if self.delay_samples == 0 and ca.depends_on(row, plant.u[0]):
            raise SimulationError(
                f"{self.measured} of {plant.name} contains the present current, which a law without delay sets from "
                "it; give delay_samples = 1 or more, or measure another output"
            )

    @property
    def watched(self) -> tuple[str, ...]:
        """The outputs, and the energy where the plant declares it."""
        return (*self.plant.outputs, *((ENERGY,) if self.plant.energy is not None else ()))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopState:
    """Where runs stand: states of the plant, and of the law with the commands that still wait.

    Parameters
    ----------
    x : array, shape (runs, nx)
    z : array, shape (runs, n + delay_samples)

    """

    x: Float[np.ndarray, "runs nx"]
    z: Float[np.ndarray, "runs nz"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopRun:
    """What runs did, sample by sample.

    Parameters
    ----------
    time : array, shape (n,)
        Seconds.
    reference : array, shape (runs, n)
        N.
    outputs : mapping of name to array, shape (runs, n)
        The plant's outputs (as they are, not as measured), and "energy" (J) where the plant declares it.
    current : array, shape (runs, n)
        A, in force from this sample to the next.
    states : array, shape (runs, n, nx)
        The plant's states.
    peaks : mapping of name to array, shape (runs,)
        Largest magnitude of each output over all integration steps.
    end : LoopState
        One sample after the last.
    error : float
        Estimated integration error of the worst sample, over the state's largest value.
    substeps : int
        Integration steps a sample.
    wall_s : float
        Time the simulation took, compilation not included.

    """

    time: Float[np.ndarray, " n"]
    reference: Rows
    outputs: Mapping[str, Rows]
    current: Rows
    states: Float[np.ndarray, "runs n nx"]
    peaks: Mapping[str, Float[np.ndarray, " runs"]]
    end: LoopState
    error: float
    substeps: int
    wall_s: float


def at_rest(loop: SampledLoop, runs: int = 1, x: Float[np.ndarray, " nx"] | None = None) -> LoopState:
    """Return `runs` loops whose law is at zero and whose plant is in state x, zero if left out."""
    start = np.zeros(len(loop.plant.states)) if x is None else x
    return LoopState(x=np.tile(start, (runs, 1)), z=np.zeros((runs, loop.law.c.size + loop.delay_samples)))


def run_loop(
    loop: SampledLoop,
    params: Sequence[ParameterSet],
    reference: Float[np.ndarray, "..."],
    *,
    start: LoopState | None = None,
    external: Mapping[str, Float[np.ndarray, " n"]] | None = None,
    seed: int = 0,
    start_s: float = 0.0,
    rtol: float = RTOL,
) -> LoopRun:
    """Run a loop, once for each set of parameters.

    Parameters
    ----------
    loop : SampledLoop
        Plant, law and devices.
    params : sequence of ParameterSet
        One a run.
    reference : array, shape (n,) or (runs, n)
        F_ref at each sample, N.
    start : LoopState, optional
        At rest at zero if left out.
    external : mapping of input name to array, shape (n,), optional
        The plant's other inputs, such as Fe2, held between samples; zero where left out.
    seed : int
        Of the sensor noise; run i has the i-th stream of it, whatever the other runs.
    start_s : float
        Time of the first sample.
    rtol : float
        Of the integration, see the module's docstring.

    Returns
    -------
    LoopRun
        Not finite where a run left what floats can hold.

    Raises
    ------
    SimulationError
        No number of steps reaches `rtol`, or an argument does not fit.

    Examples
    --------
    >>> import numpy as np, seaopt as so
    >>> from seaopt.control.realisation import runnable
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6))
    >>> loop = SampledLoop(plant=stand, law=runnable(controller), measured="F1", delay_samples=1)
    >>> run = run_loop(loop, [thor], np.full(1000, 100.0))
    >>> round(float(run.outputs["F1"][0, -1]))
    100

    """
    if not params:
        raise SimulationError("run_loop got no parameters; give one ParameterSet a run")
    runs = len(params)
    wanted = np.atleast_2d(reference).astype(float)
    if wanted.ndim != 2 or wanted.shape[0] not in (1, runs) or not wanted.shape[1]:
        raise SimulationError(f"reference has the shape {reference.shape}; give (n,) or ({runs}, n)")
    n = wanted.shape[1]
    job = _Job(
        reference=np.ascontiguousarray(np.broadcast_to(wanted, (runs, n))),
        noise=_noise(loop, runs, n, seed),
        external=_external(loop.plant, external or {}, n),
        p=np.array([loop.plant.parameter_values(item) for item in params]).reshape(runs, -1),
        start=start if start is not None else at_rest(loop, runs),
        start_s=start_s,
    )
    if job.start.x.shape != (runs, len(loop.plant.states)):
        raise SimulationError(f"start has {job.start.x.shape[0]} runs and params {runs}; give one state a run")
    substeps = _first_guess(loop, params, rtol)
    execute = _kernel(loop)
    while True:
        begin = time.perf_counter()
        found = execute(job, substeps)
        wall_s = time.perf_counter() - begin
        scale = np.where(found.size > 0.0, found.size, 1.0)
        with np.errstate(invalid="ignore"):
            errors = np.max(found.error / scale, axis=1) / 15.0
        errors = errors[np.isfinite(errors)]
        error = float(np.max(errors)) if errors.size else 0.0
        if error <= rtol:
            return _result(loop, job, found, error, substeps, wall_s)
        if 2 * substeps > MAX_SUBSTEPS:
            raise SimulationError(
                f"plant {loop.plant.name}: {2 * substeps} steps a sample leave an error of {error:.1e} of a state "
                f"(rtol = {rtol:g}); check the parameters, smooth the friction (v_s), or raise rtol"
            )
        substeps *= 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Job:
    """The data of runs, checked; `external` has shape (n, nu - 1), p (runs, np)."""

    reference: Rows
    noise: Rows
    external: Float[np.ndarray, "n ne"]
    p: Float[np.ndarray, "runs np"]
    start: LoopState
    start_s: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Trace:
    """What a kernel leaves behind: arrays of one row a run."""

    x: Float[np.ndarray, "runs nx"]
    z: Float[np.ndarray, "runs nz"]
    peak: Float[np.ndarray, "runs ny"]
    error: Float[np.ndarray, "runs nx"]
    size: Float[np.ndarray, "runs nx"]
    y: Float[np.ndarray, "runs n ny"]
    applied: Rows
    states: Float[np.ndarray, "runs n nx"]
    wall_s: float = 0.0


def _result(loop: SampledLoop, job: _Job, found: _Trace, error: float, substeps: int, wall_s: float) -> LoopRun:
    names = loop.watched
    return LoopRun(
        time=job.start_s + loop.law.sample_time_s * np.arange(job.reference.shape[1]),
        reference=job.reference,
        outputs={name: found.y[:, :, i] for i, name in enumerate(names)},
        current=found.applied,
        states=found.states,
        peaks={name: found.peak[:, i] for i, name in enumerate(names)},
        end=LoopState(x=found.x, z=found.z),
        error=error,
        substeps=2 * substeps,
        wall_s=wall_s,
    )


def _noise(loop: SampledLoop, runs: int, n: int, seed: int) -> Rows:
    std = loop.sensors.noise_std.get(loop.measured, 0.0)
    if not std:
        return np.zeros((runs, n))
    return std * np.stack([stream.normal(size=n) for stream in np.random.default_rng(seed).spawn(runs)])


def _external(plant: Plant, given: Mapping[str, Float[np.ndarray, " n"]], n: int) -> Float[np.ndarray, "n ne"]:
    names = list(plant.inputs)[1:]
    for name, values in given.items():
        if name not in names:
            raise SimulationError(f'external = {{"{name}": ...}} is no such input; {suggestion(name, names)}')
        if values.shape != (n,):
            raise SimulationError(f"external {name} has the shape {values.shape}; give ({n},), one value a sample")
    columns = [given.get(name, np.zeros(n)) for name in names]
    return np.ascontiguousarray(np.column_stack(columns) if columns else np.zeros((n, 0)), dtype=float)


def _first_guess(loop: SampledLoop, params: Sequence[ParameterSet], rtol: float) -> int:
    """Return half the steps that a mode of the first plant, at rest, needs: n (|s| T/n)^5 / 120 = rtol for the 2n."""
    fastest = float(np.max(np.abs(np.linalg.eigvals(state_space(loop.plant, params[0])[0])), initial=0.0))
    steps = ((fastest * loop.law.sample_time_s) ** 5 / (120.0 * rtol)) ** 0.25
    return int(np.clip(math.ceil(0.5 * steps), 1, 64))


def _sample_function(loop: SampledLoop) -> Any:
    """Return the CasADi function (t, x, z, e, r, w, p, c) -> (z+, u, y) of sensor, law and delay at one sample."""
    plant, n, delay = loop.plant, loop.law.c.size, loop.delay_samples
    z, r, w = ca.SX.sym("z", n + delay), ca.SX.sym("r"), ca.SX.sym("w")
    e, c = ca.SX.sym("e", len(plant.inputs) - 1), ca.SX.sym("c", _constants(loop).size)
    observe = _observe(loop)
    waiting = z[n + delay - 1] if delay else ca.SX(0)
    reading = observe(plant.t, plant.x, ca.vertcat(waiting, e), plant.p)[list(plant.outputs).index(loop.measured)] + w
    size = n * n
    a, rest = ca.reshape(c[:size], n, n), ca.vertsplit(c[size:])
    vector = [ca.vertcat(*rest[i * n : (i + 1) * n]) for i in range(4)]
    b_r, b_y, out, windup = vector
    d_r, d_y, limit, gain, offset, highest, quantum, step = rest[4 * n :]
    reading = reading + offset
    if loop.sensors.saturation.get(loop.measured) is not None:
        reading = ca.fmin(ca.fmax(reading, -highest), highest)
    if loop.sensors.quantisation.get(loop.measured):
        reading = quantum * ca.floor(reading / quantum + 0.5)
    x = z[:n]
    force = ca.dot(out, x) + d_r * r - d_y * reading
    limited = ca.fmin(ca.fmax(force, -limit), limit) if math.isfinite(loop.law.current_limit_A) else force
    after = ca.mtimes(a, x) + b_r * r - b_y * reading + windup * (limited - force)
    current = gain * limited
    if loop.current_step_A:
        current = step * ca.floor(current / step + 0.5)
    applied = waiting if delay else current
    moved = ca.vertcat(after, *([current, *(z[n + i] for i in range(delay - 1))] if delay else []))
    u = ca.vertcat(applied, e)
    arguments = [plant.t, plant.x, z, e, r, w, plant.p, c]
    return ca.Function("seaopt_sample", arguments, [ca.densify(moved), u, observe(plant.t, plant.x, u, plant.p)])


def _constants(loop: SampledLoop) -> Float[np.ndarray, " m"]:
    law, sensors, name = loop.law, loop.sensors, loop.measured
    limit = law.force_limit_N if math.isfinite(law.current_limit_A) else 0.0
    numbers = [
        law.d_reference, law.d_measurement, limit, law.current_per_force_A_per_N, sensors.offset.get(name, 0.0),
        sensors.saturation.get(name, 0.0), sensors.quantisation.get(name, 0.0), loop.current_step_A,
    ]  # fmt: skip
    return np.concatenate([law.a.ravel("F"), law.b_reference, law.b_measurement, law.c, law.anti_windup, numbers])


def _observe(loop: SampledLoop) -> Any:
    plant = loop.plant
    rows = [plant.output] + ([plant.stored_energy()] if plant.energy is not None else [])
    return ca.Function("observe", [plant.t, plant.x, plant.u, plant.p], [ca.densify(ca.vertcat(*rows))])


def _advance_function(loop: SampledLoop) -> Any:
    """Return the CasADi function (t, x, peak, u, p, h) -> (x+, peak+): one Runge-Kutta step, and the largest |y|."""
    plant = loop.plant
    rate = ca.Function("rate", [plant.t, plant.x, plant.u, plant.p], [plant.dynamics])
    t, x, u, p, h = plant.t, plant.x, plant.u, plant.p, ca.SX.sym("h")
    peak = ca.SX.sym("peak", len(loop.watched))
    k1 = rate(t, x, u, p)
    k2 = rate(t + h / 2, x + h / 2 * k1, u, p)
    k3 = rate(t + h / 2, x + h / 2 * k2, u, p)
    k4 = rate(t + h, x + h * k3, u, p)
    after = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    top = ca.fmax(peak, ca.fabs(_observe(loop)(t + h, after, u, p)))
    return ca.Function("seaopt_advance", [t, x, peak, u, p, h], ca.cse([ca.densify(after), ca.densify(top)]))


def _kernel(loop: SampledLoop) -> Any:
    """Return what runs a job: compiled where there is a compiler, CasADi's virtual machine else; once a structure."""
    sensors = loop.sensors
    key = (
        f"closed loop {loop.measured} {loop.law.c.size} {loop.delay_samples} {bool(loop.current_step_A)} "
        f"{sensors.saturation.get(loop.measured) is None} {bool(sensors.quantisation.get(loop.measured))} "
        f"{math.isfinite(loop.law.current_limit_A)}"
    )
    if key not in loop.plant.cache:
        sample, advance = _sample_function(loop), _advance_function(loop)
        library = load_library(_source(loop, sample, advance))
        if library is not None:
            library.seaopt_loops.argtypes, library.seaopt_loops.restype = [ctypes.c_void_p, ctypes.c_long], ctypes.c_int
        loop.plant.cache[key] = (sample, advance, library, {})
    sample, advance, library, chains = loop.plant.cache[key]
    constants = _constants(loop)

    def execute(job: _Job, substeps: int) -> _Trace:
        if library is not None:
            return _compiled(loop, job, substeps, constants, library)
        return _interpreted(loop, job, substeps, constants, sample, advance, chains)

    return execute


def _source(loop: SampledLoop, sample: Any, advance: Any) -> str:
    both = (sample, advance)
    constants = {
        "NX": len(loop.plant.states), "NU": len(loop.plant.inputs), "NE": len(loop.plant.inputs) - 1,
        "NY": len(loop.watched), "NZ": loop.law.c.size + loop.delay_samples,
        "SZ_W": max(f.sz_w() for f in both), "SZ_ARG": max(f.sz_arg() for f in both),
        "SZ_RES": max(f.sz_res() for f in both), "SZ_IW": max(f.sz_iw() for f in both),
    }  # fmt: skip
    generator = ca.CodeGenerator("closed_loop")
    for function in both:
        generator.add(function)
    code = re.sub(r"CASADI_SYMBOL_EXPORT int (seaopt_(?:sample|advance))\(", r"static inline int \1(", generator.dump())
    defines = "".join(f"#define {name} {value}\n" for name, value in constants.items())
    return "\n".join((defines, code, files("seaopt.control").joinpath("closed_loop.c").read_text(encoding="utf-8")))


def _empty(loop: SampledLoop, job: _Job) -> _Trace:
    runs, n = job.reference.shape
    nx, ny = len(loop.plant.states), len(loop.watched)
    return _Trace(
        x=np.array(job.start.x, dtype=float, order="C"), z=np.array(job.start.z, dtype=float, order="C"),
        peak=np.zeros((runs, ny)), error=np.zeros((runs, nx)), size=np.zeros((runs, nx)),
        y=np.zeros((runs, n, ny)), applied=np.zeros((runs, n)), states=np.zeros((runs, n, nx)),
    )  # fmt: skip


_POINTERS = ("p", "c", "r", "w", "e", "x", "z", "peak", "error", "size", "y", "applied", "states")
_ARGUMENTS = np.dtype(
    [
        ("n", np.int64),
        ("substeps", np.int64),
        ("t0", float),
        ("period", float),
        *((name, np.uint64) for name in _POINTERS),
    ]
)


def _compiled(loop: SampledLoop, job: _Job, substeps: int, c: Float[np.ndarray, " m"], library: Any) -> _Trace:
    trace = _empty(loop, job)
    runs, n = job.reference.shape
    arguments = np.zeros(runs, dtype=_ARGUMENTS)
    arguments["n"], arguments["substeps"] = n, substeps
    arguments["t0"], arguments["period"] = job.start_s, loop.law.sample_time_s
    rows = {"p": job.p, "r": job.reference, "w": job.noise} | {
        name: getattr(trace, name) for name in ("x", "z", "peak", "error", "size", "y", "applied", "states")
    }
    for name, array in rows.items():
        arguments[name] = array.ctypes.data + array.strides[0] * np.arange(runs)
    arguments["c"], arguments["e"] = c.ctypes.data, job.external.ctypes.data
    bounds = np.linspace(0, runs, min(runs, workers()) + 1).astype(int)
    size = arguments.dtype.itemsize
    if len(bounds) == 2:
        library.seaopt_loops(arguments.ctypes.data, runs)
        return trace
    jobs = [
        threads().submit(library.seaopt_loops, arguments.ctypes.data + int(a) * size, int(b - a))
        for a, b in pairwise(bounds)
    ]
    for done in jobs:
        done.result()
    return trace


def _interpreted(
    loop: SampledLoop, job: _Job, substeps: int, c: Float[np.ndarray, " m"], sample: Any, advance: Any,
    chains: dict[tuple[int, int], Any],
) -> _Trace:  # fmt: skip
    """Run in CasADi's virtual machine: the same two functions, chained in a third."""
    trace = _empty(loop, job)
    runs, n = job.reference.shape
    chunk = min(n, CHUNK)
    key = (substeps, chunk)
    if key not in chains:
        period = _period_function(loop, sample, advance, substeps)
        chains[key] = (period.expand() if substeps <= EXPANDED else period).mapaccum(chunk)
    times = job.start_s + loop.law.sample_time_s * np.arange(n)
    for run in range(runs):
        state = np.concatenate([getattr(trace, name)[run] for name in ("x", "z", "peak", "error", "size")])
        shared = [np.repeat(item[:, None], chunk, axis=1) for item in (job.p[run], c)]
        signals = np.vstack([times, job.external.T, job.reference[run], job.noise[run]])
        for first in range(0, n, chunk):
            count = min(chunk, n - first)
            piece = signals[:, np.minimum(np.arange(first, first + chunk), n - 1)]  # the last one is filled up
            after, y, applied, states = (
                np.array(item)[:, :count]
                for item in chains[key](state, piece[:1], piece[1:-2], piece[-2:-1], piece[-1:], *shared)
            )
            rows = slice(first, first + count)
            trace.y[run, rows], trace.applied[run, rows], trace.states[run, rows] = y.T, applied[0], states.T
            state = after[:, -1]
        for name in ("x", "z", "peak", "error", "size"):
            width = getattr(trace, name).shape[1]
            getattr(trace, name)[run], state = state[:width], state[width:]
    return trace


def _period_function(loop: SampledLoop, sample: Any, advance: Any, substeps: int) -> Any:
    """Return ([x, z, peak, error, size], t, e, r, w, p, c) -> (the same a sample later, y, applied, x)."""
    sizes = [len(loop.plant.states), loop.law.c.size + loop.delay_samples, len(loop.watched)]
    state = ca.MX.sym("state", sizes[0] * 3 + sizes[1] + sizes[2])
    t, r, w = (ca.MX.sym(name) for name in "trw")
    e, p, c = (ca.MX.sym(name, sample.numel_in(i)) for name, i in (("e", 3), ("p", 6), ("c", 7)))
    x, z, peak, error, size = ca.vertsplit(state, np.cumsum([0, *sizes, sizes[0], sizes[0]]).tolist())
    after, u, y = sample(t, x, z, e, r, w, p, c)
    top = ca.fmax(peak, ca.fabs(y))
    ends: list[tuple[Any, Any]] = []
    for steps in (substeps, 2 * substeps):
        h, at, highest = loop.law.sample_time_s / steps, x, top
        for i in range(steps):
            at, highest = advance(t + i * h, at, highest, u, p, h)
        ends.append((at, highest))
    (coarse, _), (fine, top) = ends
    grown = ca.vertcat(fine, after, top, ca.fmax(error, ca.fabs(fine - coarse)), ca.fmax(size, ca.fabs(fine)))
    return ca.Function("seaopt_period", [state, t, e, r, w, p, c], [grown, y, u[0], x])
