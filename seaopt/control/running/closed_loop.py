r"""The loop as it will run: a continuous nonlinear plant and a law that acts once per sample.

At sample k the load cell reads :math:`m_k = Q(y_k + n_k)`, noise :math:`n_k` and quantisation Q as `Sensors` says; the
law `RunnableLaw` makes of it and of the reference a motor force, limited, with its anti-windup; the current
:math:`I = g\,\mathrm{sat}(F)` may be rounded to the amplifier's step, but never to one above the limit, waits
`delay_samples` samples (and `delay_s` more, where a run's parameters hold that) and is then held for one. In between

.. math:: \dot x = f(t, x, u, p), \qquad u \text{ constant},

is integrated by Runge-Kutta's method of order four in fixed steps. Every sample is integrated twice, with n and with 2n
steps; the finer result goes on, a fifteenth of the difference estimates its error (order four), and n is doubled until
that is below `rtol` of each state's largest value in every sample. It is the error of one sample from the same start:
a quantiser would turn any difference into a whole step, so that two whole runs cannot be compared. A run that
leaves what floats can hold has no error to look at: it is taken for the loop's doing, and not for that of steps too
long for the plant, where half as long ones lose it in the same sample or the next, after states as large.

With friction that sticks the steps are those of `seaopt.simulation.sticking`, whose error where a joint stops is of a
lower order: the difference itself is the estimate, and the steps are halved until it is below `STICKING_RTOL`; in the
samples alone that need it, which are those where a joint stops or starts.

Peaks are of every fine step, not of the samples alone: a mode at 160 Hz has six samples a period at 1 kHz, whose
largest can be 13 % below the top.

A law without delay sees the output of this moment. Where that contains the current itself (F2 of some plants) the
loop would be algebraic; it is refused.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.control.loops.sampled_plant import exponentiate, find_delay, read_conditions, whole_samples
from seaopt.control.running.loop_kernel import Job, LoopArrays, Rows, Steps, make_kernel
from seaopt.control.running.sampled_loop import LoopState, SampledLoop, at_rest, channel_names
from seaopt.control.scheduling.runnable_schedule import RunnableSchedule
from seaopt.errors import SimulationError, StepSizeError, require_seed, suggestion
from seaopt.formatting import format_count
from seaopt.parameters import ParameterSet
from seaopt.plants import CompletedParameters, Plant, state_space
from seaopt.plants.equations.declaration import ENERGY
from seaopt.plants.friction import SLIDING, friction_states
from seaopt.plants.plant import dynamics_function, name_input
from seaopt.records import record
from seaopt.units import name_command, unit_after

__all__ = ["ENERGY", "LoopRun", "LoopState", "SampledLoop", "at_rest", "run_loop"]

MAX_LOOP_SUBSTEPS = 512
ALIKE = 0.5  # of its largest value, by which a state of a run that is lost may differ between two numbers of steps
FASTEST_GUESSED = 1e6  # of a mode, radians a sample: beyond, the guess is the largest, and a power may overflow
RTOL, STICKING_RTOL = 1e-6, 3e-5
ALLOWED = 0.1  # of that, in samples that have steps of their own: what a held joint creeps in each adds up
# A state below that share of the largest, or of what a sample makes of it without friction, is at rest but for
# rounding. Where a joint sticks it creeps by a step's own error besides, while the command changes within a sample.
RESTS, STICKING_RESTS = 1e-10, 1.0
SAMPLES_MOVED = 2.0 ** np.arange(7)  # over which it is looked for what a sample makes of a state


@record(eq=False)
class LoopRun:
    """What runs did, sample by sample."""

    time: Float[np.ndarray, " n"]  # seconds
    reference: Rows  # shape (runs, n); N
    # shape (runs, n); the plant's outputs (as they are, not as measured), and "energy" (J) where the plant declares it
    outputs: Mapping[str, Rows]
    current: Rows  # shape (runs, n); A, in force at the end of the sample
    states: Float[np.ndarray, "runs n nx"]  # the plant's states
    peaks: Mapping[str, Float[np.ndarray, " runs"]]  # largest magnitude of each output over all integration steps
    end: LoopState  # one sample after the last
    error: float  # estimated integration error of the worst sample, over the state's largest value
    substeps: int  # integration steps per sample; friction that sticks takes more where a joint stops or starts
    wall_s: float  # time the simulation took, with steps that were too long, but not compilation
    command: tuple[str, str] = ("I", "A")

    def __repr__(self) -> str:
        return describe_runs(
            "LoopRun",
            f"from {self.time[0]:.4g} to {self.time[-1]:.4g} s",
            self.current,
            self.peaks,
            self.error,
            self.command,
        )


def describe_runs(
    kind: str,
    span: str,
    current: Rows,
    peaks: Mapping[str, Float[np.ndarray, " runs"]],
    error: float,
    command: tuple[str, str],
    more: str = "",
) -> str:
    """Describe simulated runs in one line: how many, of how many samples, and the largest magnitudes."""
    runs, samples = current.shape
    largest = ", ".join(f"{name} {np.max(value):.4g}" for name, value in peaks.items())
    return (
        f"{kind} of {format_count(runs, 'run')} of {samples} samples, {span}: largest magnitudes {largest}, "
        f"{name_command(*command)} {np.max(np.abs(current)):.4g}{unit_after(command[1])}; "
        f"{more}integration error {error:.1g}"
    )


def run_loop(
    loop: SampledLoop,
    params: Sequence[ParameterSet],
    reference: Float[np.ndarray, "..."],
    *,
    start: LoopState | None = None,
    external: Mapping[str, Float[np.ndarray, " n"]] | None = None,
    seed: int = 0,
    noise_gain: float | Float[np.ndarray, " runs"] = 1.0,
    start_s: float = 0.0,
    rtol: float | None = None,
    standing: float | Float[np.ndarray, "..."] = 0.0,
    places: float | Float[np.ndarray, " n"] = math.nan,
) -> LoopRun:
    """Run a loop, once for each set of parameters.

    Parameters
    ----------
    loop : SampledLoop
        Plant, law and devices.
    params : sequence of ParameterSet
        One per run; `delay_s` among them is delay besides the controller's, exact between samples too.
    reference : array, shape (n,) or (runs, n)
        F_ref at each sample, N.
    start : LoopState, optional
        At rest at zero if left out.
    external : mapping of input name to array, shape (n,), optional
        The plant's other inputs, such as Fe2, held between samples; zero where left out.
    seed : int
        Of the sensor noise, the same in every run: what differs between runs is the parameters.
    noise_gain : float or array, shape (runs,)
        By which that noise is multiplied in each run.
    start_s : float
        Time of the first sample.
    rtol : float, optional
        Of the integration, see the module's docstring.
    standing : float or array, shape (runs,) or (runs, k)
        Where the link stands of a plant that holds it, as the law reads it: the k signals of `SampledLoop.standing`.
    places : float or array, shape (n,)
        The scheduling variable that a schedule is given on a plant that does not have it as a state; none if left out.

    Returns
    -------
    LoopRun
        Not finite where a run overflows.

    Raises
    ------
    StepSizeError
        No number of steps reaches `rtol`.
    SimulationError
        An argument does not fit, or it is open whether the loop runs away.

    Examples
    --------
    >>> import numpy as np, seaopt as so
    >>> from seaopt.control.laws.realisation import runnable
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6))
    >>> loop = SampledLoop(plant=stand, law=runnable(controller), measured="F1", delay_samples=1)
    >>> run = run_loop(loop, [thor], np.full(1000, 100.0))
    >>> round(float(run.outputs["F1"][0, -1]))
    100
    """
    if not params:
        raise SimulationError("run_loop got no parameters; give one ParameterSet per run")
    runs, values = len(params), [loop.plant.complete(each) for each in params]
    wanted = np.atleast_2d(reference).astype(float)
    if wanted.ndim != 2 or wanted.shape[0] not in (1, runs) or not wanted.shape[1]:
        raise SimulationError(f"reference has the shape {reference.shape}; give (n,) or ({runs}, n)")
    n = wanted.shape[1]
    noise = _noise(loop, values, n, seed, noise_gain, standing)
    if isinstance(loop.law, RunnableSchedule):
        noise = np.dstack([noise, np.broadcast_to(0.0 if loop.place in loop.plant.states else places, (runs, n))])
    job = Job(
        reference=np.ascontiguousarray(np.broadcast_to(wanted, (runs, n))),
        noise=noise,
        external=_external(loop.plant, external or {}, n),
        p=np.array([each.vector for each in values]).reshape(runs, -1),
        **_lags(loop, values),
        start=start if start is not None else at_rest(loop, runs),
        start_s=start_s,
    )
    if job.start.x.shape != (runs, len(loop.plant.states)):
        raise SimulationError(f"start has {job.start.x.shape[0]} runs and params {runs}; give one state per run")
    if rtol is None:
        rtol = STICKING_RTOL if loop.sticks else RTOL
    # Friction that sticks has no slope at rest.
    matrices = state_space(friction_states(loop.plant)[SLIDING] if loop.sticks else loop.plant, values[0])
    guess, before, wall_s = _first_guess(matrices[0], loop.law.sample_time_s, rtol), None, 0.0
    pushes = [_push_at_start(loop.plant, each, job.start.x[run]) for run, each in enumerate(values)]
    moved = _bound_motion(matrices[0], np.stack([matrices[1][:, 0], *pushes]), loop.law.sample_time_s)
    execute = make_kernel(loop, job)
    steps = Steps(coarse=guess, finest=guess, most=np.full_like(job.start.x, math.inf))
    while True:
        begin = time.perf_counter()
        arrays = execute(job, steps)
        wall_s += time.perf_counter() - begin
        kept = _first_lost_sample(arrays) == n
        sizes = _sizes(arrays, moved[0], moved[1:], sticks=loop.sticks)
        with np.errstate(invalid="ignore"):
            errors = np.nan_to_num(arrays.error / sizes, nan=np.inf) / (1.0 if loop.sticks else 15.0)
        error = float(np.max(errors[kept], initial=0.0))
        shortest = 2 * steps.coarse > MAX_LOOP_SUBSTEPS or not (steps.even or np.all(arrays.error <= steps.most))
        decided = bool(np.all(kept)) or (
            before is not None and bool(np.all(kept | _lose_alike(before, arrays, shortest=shortest)))
        )
        if error <= rtol and decided:
            return _result(loop, job, arrays, error, 2 * steps.coarse, wall_s)
        if shortest:
            tried = f"plant {loop.plant.name}: {2 * steps.finest} steps per sample"
            if decided:
                worst, state = np.unravel_index(np.argmax(np.where(kept[:, None], errors, 0.0)), errors.shape)
                raise StepSizeError(
                    f"{tried} leave an error of {error:.1e} of the state {list(loop.plant.states)[state]} "
                    f"(rtol = {rtol:g}); check the parameters, smooth the friction (v_s), or raise rtol",
                    run=int(worst),
                )
            raise SimulationError(
                f"{tried} do not decide whether the loop runs away or the steps are too long; check the parameters",
                run=int(np.argmin(kept)),
            )
        before, steps = arrays, _shorten(steps, rtol * sizes if loop.sticks and np.all(kept) else None)


def _shorten(steps: Steps, allowed: Rows | None) -> Steps:
    """Return the steps to try next: half as long; where errors are `allowed`, in the samples alone that exceed them."""
    if allowed is None:
        return Steps(coarse=2 * steps.coarse, finest=2 * steps.coarse, most=np.full_like(steps.most, math.inf))
    coarse = steps.coarse if steps.even else 2 * steps.coarse
    halvings = (MAX_LOOP_SUBSTEPS // coarse).bit_length() - 1
    return Steps(coarse=coarse, finest=coarse * 2**halvings, most=ALLOWED * allowed)


def _sizes(
    arrays: LoopArrays, motion: Float[np.ndarray, " nx"], unheld: Float[np.ndarray, "runs nx"], *, sticks: bool
) -> Float[np.ndarray, "runs nx"]:
    """Return what an error in a sample is measured by: the state's largest value. A state that rests, or that friction
    holds, has rounding for a value: it is measured by the largest of the others, by `motion`, what an ampere would make
    of it in a sample without friction, and by `unheld`, what the first sample would without.
    """
    free = motion * np.max(np.abs(arrays.applied), axis=1, keepdims=True, initial=0.0) + unheld
    with np.errstate(invalid="ignore"):
        resting = RESTS * np.max(arrays.size, axis=1, keepdims=True)
        size = np.maximum(np.maximum(arrays.size, resting), (STICKING_RESTS if sticks else RESTS) * free)
    return np.where(size > 0.0, size, 1.0)


def _first_lost_sample(arrays: LoopArrays) -> Int[np.ndarray, " runs"]:
    """Return each run's first sample that is not finite; the number of samples where all are."""
    finite = np.all(np.isfinite(arrays.states), axis=2) & np.all(np.isfinite(arrays.y), axis=2)
    finite[:, -1] &= np.all(np.isfinite(arrays.x), axis=1)
    return np.where(np.all(finite, axis=1), finite.shape[1], np.argmin(finite, axis=1))


def _lose_alike(before: LoopArrays, after: LoopArrays, *, shortest: bool) -> Bool[np.ndarray, " runs"]:
    """Tell which runs two numbers of steps lose in the same way: about the same sample, and alike until there. Steps
    that are too long for what is fast lose a loop at once, too, with about the same largest state; but not with the
    same values of what is fast. Where a run is lost before a sample tells, steps as short as can be have to tell.
    """
    lost = np.stack([_first_lost_sample(before), _first_lost_sample(after)])
    alike = (np.abs(lost[1] - lost[0]) <= 1) & ((np.min(lost, axis=0) > 1) | shortest)
    for run in np.flatnonzero(alike):
        coarse, fine = (arrays.states[run, : max(int(np.min(lost[:, run])), 1)] for arrays in (before, after))
        size = np.max(np.maximum(np.abs(coarse), np.abs(fine)), axis=0)
        scale = np.maximum(size, RESTS * np.max(size))
        alike[run] = bool(np.all(np.max(np.abs(fine - coarse), axis=0) <= ALIKE * scale))
    return alike


def _result(loop: SampledLoop, job: Job, arrays: LoopArrays, error: float, substeps: int, wall_s: float) -> LoopRun:
    names = channel_names(loop.plant)
    return LoopRun(
        time=job.start_s + loop.law.sample_time_s * np.arange(job.reference.shape[1]),
        reference=job.reference,
        outputs={name: arrays.y[:, :, i] for i, name in enumerate(names)},
        current=arrays.applied,
        states=arrays.states,
        peaks={name: arrays.peak[:, i] for i, name in enumerate(names)},
        end=LoopState(x=arrays.x, z=arrays.z),
        error=error,
        command=name_input(loop.plant),
        substeps=2 * substeps,
        wall_s=wall_s,
    )


def _noise(
    loop: SampledLoop,
    params: Sequence[CompletedParameters],
    n: int,
    seed: int,
    gain: float | Float[np.ndarray, " runs"],
    standing: float | Float[np.ndarray, "..."],
) -> Float[np.ndarray, "runs n y"]:
    """Return the noise of every reading, that of further ones drawn after the first; where a held link stands too."""

    def find_std(values: CompletedParameters, name: str) -> float:
        if name in loop.standing:
            fed_back = name == loop.link or (loop.law.outer is not None and name == loop.law.outer.position)
            return loop.sensors.noise_std.get(name, 0.0) if fed_back else 0.0
        return loop.sensors.combine_errors(loop.plant, values, name)[0]

    std = np.array([[find_std(values, name) for name in loop.signals] for values in params])
    std = std * np.reshape(gain, (-1, 1))
    noise = np.zeros((len(params), n, len(loop.signals)))
    places = np.reshape(standing, (-1, 1)) if np.ndim(standing) < 2 else standing
    for name, position in zip(loop.standing, np.broadcast_to(places, (len(params), len(loop.standing))).T, strict=True):
        noise[:, :, loop.signals.index(name)] = position[:, None]
    if not np.any(std):
        return noise
    rng = np.random.default_rng(require_seed(seed, SimulationError))
    return noise + std[:, None, :] * np.column_stack([rng.normal(size=n) for _ in loop.signals])


def _external(plant: Plant, signals: Mapping[str, Float[np.ndarray, " n"]], n: int) -> Float[np.ndarray, "n ne"]:
    names = list(plant.inputs)[1:]
    for name, values in signals.items():
        if name not in names:
            raise SimulationError(
                f'external has "{name}", which is not another input of {plant.name}; {suggestion(name, names)}'
            )
        if values.shape != (n,):
            raise SimulationError(f"external {name} has the shape {values.shape}; give ({n},), one value per sample")
    columns = [signals.get(name, np.zeros(n)) for name in names]
    return np.ascontiguousarray(np.column_stack(columns) if columns else np.zeros((n, 0)), dtype=float)


def _lags(loop: SampledLoop, params: Sequence[CompletedParameters]) -> dict[str, Any]:
    """Return which commands are in force in each run, and from when; `lag` and `late_s` of a job."""
    queue = loop.waiting
    lag, late_s = np.zeros((len(params), 2, queue + 1)), np.zeros(len(params))
    for run, values in enumerate(params):
        delay = float(find_delay(loop.plant, read_conditions(loop.plant, values)))
        if not 0.0 <= delay <= loop.longest_delay_s:
            raise SimulationError(
                f"a delay of {delay:g} s is outside 0 to longest_delay_s = {loop.longest_delay_s:g}; give the loop the "
                "longest of all runs"
            )
        whole, late_s[run] = whole_samples(delay, loop.law.sample_time_s)
        newer = loop.delay_samples + whole
        lag[run, 0, newer + (late_s[run] > 0.0)] = lag[run, 1, newer] = 1.0
    return {"lag": lag.reshape(len(params), -1), "late_s": late_s}


def _first_guess(a: Float[np.ndarray, "nx nx"], period: float, rtol: float) -> int:
    """Return half the steps that the fastest mode at rest needs: n (|s| T/n)^5 / 120 = rtol for the 2n."""
    fastest = float(np.max(np.abs(np.linalg.eigvals(a)), initial=0.0))
    steps = min(fastest * period, FASTEST_GUESSED) ** 1.25 / (120.0 * rtol) ** 0.25
    return int(np.clip(math.ceil(0.5 * steps), 1, 64))


def _push_at_start(plant: Plant, params: CompletedParameters, x: Float[np.ndarray, " nx"]) -> Float[np.ndarray, " nx"]:
    """Return the rates of the states at the start, without a command: what friction there holds, such as cogging."""
    return dynamics_function(plant)(x, np.zeros(len(plant.inputs)), params.vector).full().ravel()


def _bound_motion(
    a: Float[np.ndarray, "nx nx"], rates: Float[np.ndarray, "k nx"], period: float
) -> Float[np.ndarray, "k nx"]:
    """Return about how far each of k rates moves each state in a sample: the most that they do in 1, 2, 4, ... samples,
    over the square of their number, since what only a spring moves has hardly begun to in the first.
    """
    k, spans = len(rates), SAMPLES_MOVED.size
    stacked = np.broadcast_to(a, (k * spans, *a.shape)), np.repeat(rates, spans, axis=0)
    _, moved = exponentiate(*stacked, np.tile(period * SAMPLES_MOVED, k))
    with np.errstate(invalid="ignore"):
        shares = np.abs(moved.reshape(k, spans, -1)) / SAMPLES_MOVED[:, None] ** 2
    # A plant beyond computing has no motion to measure by.
    return np.max(np.nan_to_num(shares, posinf=0.0), axis=1)
