"""A digital law that is a Python function, such as a predictive one, on a plant as it is, nonlinear and continuous.

A law that is a `RunnableLaw` or a `RunnableSchedule` runs in `seaopt.control.running.closed_loop`, compiled and over
many draws at once. Here is what that cannot do: any callable, called once per sample. The plant between the samples is
the same, with the same steps and the same error: each sample is integrated with n and with 2n of them, and n doubled
until they agree to `rtol`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.bench import Sensors
from seaopt.control.loops.sampled_plant import (
    DELAYS,
    Measured,
    find_delay,
    find_rows,
    list_names,
    read_conditions,
    whole_samples,
)
from seaopt.control.running.closed_loop import MAX_LOOP_SUBSTEPS, RTOL, STICKING_RTOL
from seaopt.control.running.held import Hold, make_hold, observe_function
from seaopt.control.running.sampled_loop import channel_names, largest_command
from seaopt.errors import ControlError, RunawayError, StepSizeError, require_seed
from seaopt.parameters import ParameterSet
from seaopt.plants import CompletedParameters, Plant
from seaopt.plants.plant import name_input
from seaopt.plants.sensors.deflection import evaluate_weights
from seaopt.records import record
from seaopt.simulation.direct_call import DirectCall
from seaopt.units import LINEAR, mechanics_of, name_command, unit_after

State = TypeVar("State")
FIRST_SUBSTEPS = 2  # coarse steps per sample to begin with
STANDS = 1e-8  # of the largest state so far: a speed below it, of a plant that rests away from zero, is rounding


@record(eq=False)
class ForceRun:
    """What a closed loop did.

    Parameters
    ----------
    time, reference, force, current, law_time_s : arrays, shape (n,)
        Seconds; N; N at the samples, without the sensor's errors; A as the amplifier makes it; and the time (s) that
        each step of the law took.
    state : array, shape (n, nx)
        Of the plant.
    outputs : mapping of name to array, shape (n,)
        Of the plant at the samples, without the sensors' errors, and "energy" (J) where the plant declares it.
    peaks : mapping of name to float
        Largest magnitude of each over all integration steps.
    error : float
        Estimated integration error of the worst sample, over the state's largest value until then.
    substeps : int
        Integration steps per sample, at the end.
    unit : str
        Of reference and force: N, or N m of a torque.
    """

    time: Float[np.ndarray, " n"]
    reference: Float[np.ndarray, " n"]
    force: Float[np.ndarray, " n"]
    current: Float[np.ndarray, " n"]
    law_time_s: Float[np.ndarray, " n"]
    state: Float[np.ndarray, "n nx"]
    outputs: Mapping[str, Float[np.ndarray, " n"]]
    peaks: Mapping[str, float]
    error: float
    substeps: int
    unit: str = LINEAR.unit
    command: tuple[str, str] = ("I", "A")

    @property
    def overshoot(self) -> float:
        """How far the force goes beyond the last reference, as a fraction of the step from the first sample's force."""
        step = self.reference[-1] - self.force[0]
        return max(float(np.max((self.force - self.reference[-1]) / step)), 0.0)

    def __repr__(self) -> str:
        unit, word = self.unit, mechanics_of(self.unit).word
        return (
            f"ForceRun of {self.time.size} samples, {self.time[-1]:.4g} s: reference to {self.reference[-1]:.4g} "
            f"{unit}, {word} up to {np.max(np.abs(self.force)):.4g} {unit} and {self.force[-1]:.4g} {unit} at the end, "
            f"{name_command(*self.command)} up to {np.max(np.abs(self.current)):.4g}{unit_after(self.command[1])}"
        )

    def settling_time_s(self, band: float = 0.02) -> float:
        """Return the time from the reference's first change until the force stays within `band` of the step.

        Infinite where it has not at the last sample.
        """
        changed = np.flatnonzero(np.diff(self.reference)) + 1
        first = float(self.time[changed[0]] if changed.size else self.time[0])
        step = abs(self.reference[-1] - self.force[0])
        outside = np.flatnonzero(np.abs(self.force - self.reference[-1]) > band * step)
        if not outside.size:
            return 0.0
        return float(self.time[outside[-1] + 1]) - first if outside[-1] + 1 < self.time.size else np.inf


def close_loop(
    step: Callable[..., tuple[float, State]],
    start: State,
    plant: Plant,
    params: ParameterSet,
    reference: Float[np.ndarray, " n"],
    *,
    measured: Measured = "F1",
    sample_time_s: float = 1e-3,
    delay_samples: int = 1,
    preview_samples: int = 0,
    sensors: Sensors | None = None,
    command_step: float = 0.0,
    command_limit: float = np.inf,
    disturbance: float | Float[np.ndarray, " n"] = 0.0,
    seed: int = 0,
    start_state: Float[np.ndarray, " nx"] | None = None,
    start_command: float = 0.0,
    sticks: bool = False,
    rtol: float | None = None,
    sizes: float | Float[np.ndarray, " nx"] = 0.0,
) -> ForceRun:
    """Run a law on a plant, from rest at zero where no other start is given.

    Parameters
    ----------
    step : callable ``(state, reference, measurement) -> (current, state)``
        The law, such as ``mpc.command``; it sees the measurement before its current. `reference` is a number, or an
        array with `preview_samples`.
    start
        Its state at the first sample.
    plant, params
        The plant to run on, which may differ from the design plant; `delay_s` among the parameters is delay besides
        `delay_samples`.
    reference : array, shape (n,)
        N, one value per sample.
    measured : str or tuple of str
        The output that the law sees; or several, the regulated one first, which it then sees as an array.
    sample_time_s : float
        Seconds.
    delay_samples : int
        Whole samples from a command to the plant.
    preview_samples : int
        How many references beyond the present one the law is given: it is called with an array of them all, the present
        one first, fewer at the end; with 0, with the present one as a number.
    sensors : Sensors, optional
        Noise, offset, range and quantisation of the measured output, and of the encoders that it is computed from;
        ideal if left out.
    command_step : float
        What the amplifier rounds the command to, in its unit; 0 for not at all.
    command_limit : float
        The amplifier's; with a step the largest is the last whole one within it.
    disturbance : float or array, shape (n,)
        Added to the current inside the plant.
    seed : int
        Of the noise.
    start_state : array, shape (nx,), optional
        Of the plant, at the first sample.
    start_command : float
        What acts until the first command does.
    sticks : bool
        Dry friction jumps at rest, so that what sticks stands still, in place of the smoothed curve.
    rtol : float, optional
        Of the integration, of each state's largest value so far.
    sizes : float or array, shape (nx,)
        At least that large the states will be.

    Raises
    ------
    ControlError
        `preview_samples` is no number of samples, the plant has no such output, or that output responds to the
        current at once, the parameters contain another condition than delays and no `start_state` is given, a sensor's
        error or command_step is negative, that step is above the limit, or the loop diverges.
    SimulationError
        No number of steps reaches `rtol`.
    """
    values = plant.complete(params)
    extra_delay_s = _check(plant, values, measured, delay_samples, placed=start_state is not None)
    whole, rest_s = whole_samples(extra_delay_s, sample_time_s)
    if isinstance(preview_samples, bool) or not isinstance(preview_samples, int) or preview_samples < 0:
        raise ControlError(f"preview_samples = {preview_samples!r} is not a whole number of samples; give 0, 1, ...")
    newer, n, p = delay_samples + whole, reference.size, values.vector
    output, names = DirectCall(observe_function(plant, sticks)), channel_names(plant)
    integrator = _Integrator(
        plant=plant,
        hold=make_hold(plant, sticks),
        sticks=sticks,
        rtol=rtol or (STICKING_RTOL if sticks else RTOL),
        size=sizes,
    )
    idle = [0.0] * (len(plant.inputs) - 1)
    devices, signals = sensors or Sensors(), list_names(measured)
    rng = np.random.default_rng(require_seed(seed, ControlError))
    row, reads = find_rows(plant, signals)[0], [_place_sensor(devices, plant, values, name) for name in signals]
    noise = np.array([devices.combine_errors(plant, values, name)[0] * rng.normal(size=n) for name in signals])
    if not command_step >= 0.0:
        raise ControlError(f"command_step = {command_step:g} is negative; give the amplifier's step, 0 for none")
    most = largest_command(command_limit, command_step)
    if not most:
        raise ControlError(
            f"command_step = {command_step:g} is above the limit of the command, {command_limit:g}, so that "
            "every command is zero; give the amplifier's step"
        )
    disturbance = np.broadcast_to(np.asarray(disturbance, dtype=float), n)
    x = np.zeros(len(plant.states)) if start_state is None else start_state
    law, time_s = start, sample_time_s * np.arange(n)
    made, current, law_time_s, states = np.zeros((n, len(names))), *np.zeros((2, n)), np.zeros((n, len(x)))

    def inputs(k: int, sample: int) -> list[float]:
        return [(current[sample] if sample >= 0 else start_command) + disturbance[k], *idle]

    for k in range(n):
        older = k - newer - (rest_s > 0.0)
        made[k] = outputs = output(time_s[k], x, inputs(k, min(older, k - 1)), p)[0][:, 0]
        call_start_s = time.perf_counter()
        coming = reference[k : k + 1 + preview_samples] if preview_samples else float(reference[k])
        readings = [read(outputs, float(each)) for read, each in zip(reads, noise[:, k], strict=True)]
        command, law = step(law, coming, readings[0] if len(reads) == 1 else np.array(readings))
        law_time_s[k] = time.perf_counter() - call_start_s
        current[k] = _convert_command(command, command_step, most)
        states[k] = x
        if rest_s > 0.0:
            x = integrator.advance(time_s[k], x, inputs(k, older), p, rest_s)
        x = integrator.advance(time_s[k] + rest_s, x, inputs(k, k - newer), p, sample_time_s - rest_s)
    return ForceRun(
        time=time_s,
        reference=reference,
        force=made[:, row],
        current=current,
        law_time_s=law_time_s,
        state=states,
        outputs=dict(zip(names, made.T, strict=True)),
        peaks=dict(zip(names, np.maximum(integrator.peak, np.max(np.abs(made), axis=0)).tolist(), strict=True)),
        error=integrator.error,
        substeps=2 * integrator.substeps,
        unit=plant.outputs[signals[0]],
        command=name_input(plant),
    )


def _convert_command(command: float, step: float, most: float) -> float:
    """Return what an amplifier makes of a command: the nearest step, within its limit."""
    rounded = step * math.floor(command / step + 0.5) if step else command
    return min(max(rounded, -most), most)


def _place_sensor(
    sensors: Sensors, plant: Plant, values: CompletedParameters, measured: str
) -> Callable[[Float[np.ndarray, " ny"], float], float]:
    """Return what reads an output, given all outputs and noise, with the errors of the encoders it comes from."""
    sensors.refuse_negative(sensors.names, ControlError)
    names, erring = list(plant.outputs), sensors.erring & plant.outputs.keys()
    weights = evaluate_weights(plant, values, measured)
    encoders = [(name, names.index(name), weight) for name, weight in weights.items() if name in erring]

    def read(outputs: Float[np.ndarray, " ny"], noise: float) -> float:
        value = float(outputs[names.index(measured)]) + noise
        for name, row, weight in encoders:
            true = float(outputs[row])
            value += weight * (sensors.convert(name, true) - true)
        return sensors.convert(measured, value)

    return read


def _check(plant: Plant, params: CompletedParameters, measured: Measured, delay_samples: int, *, placed: bool) -> float:
    """Return the delay besides the whole samples, s, of arguments that fit together."""
    rows = find_rows(plant, measured)
    conditions = read_conditions(plant, params)
    moved = [name for name, value in conditions.items() if value and name not in DELAYS]
    if moved and not placed:
        raise ControlError(
            f"the parameters hold {', '.join(moved)}, but close_loop starts at rest at zero; leave it out"
        )
    extra_delay_s = float(find_delay(plant, conditions))
    if not delay_samples and not extra_delay_s and ca.depends_on(plant.output[rows], plant.u[0]):
        raise ControlError(
            f"{' or '.join(list_names(measured))} of {plant.name} contains the present command, which a law without "
            "delay sets from it; give "
            "delay_samples = 1 or more, or measure another output"
        )
    return extra_delay_s


@dataclass(slots=True, kw_only=True)  # remembers the steps and errors of the run so far
class _Integrator:
    """A plant integrated while its inputs are held, in as many steps as it has needed so far."""

    plant: Plant
    hold: Hold
    sticks: bool
    rtol: float
    substeps: int = FIRST_SUBSTEPS
    error: float = 0.0
    size: Any = 0.0
    peak: Any = 0.0  # largest magnitudes of the outputs

    def advance(
        self, t: float, x: Float[np.ndarray, " nx"], u: list[float], p: Float[np.ndarray, " np"], lasting: float
    ) -> Any:
        """Return the state after a time `lasting`, the inputs held."""
        while True:
            coarse, fine, peak = self.hold(t, x, u, p, lasting, self.substeps)
            size = np.maximum(self.size, np.maximum(np.abs(x), np.abs(fine)))
            scale = np.maximum(size, STANDS * np.max(size))
            with np.errstate(invalid="ignore"):
                error = float(np.max(np.abs(fine - coarse) / np.where(scale > 0.0, scale, 1.0)))
            error /= 1.0 if self.sticks else 15.0
            if error <= self.rtol:
                self.error, self.size, self.peak = max(self.error, error), size, np.maximum(self.peak, peak)
                return fine
            if 2 * self.substeps > MAX_LOOP_SUBSTEPS:
                break
            self.substeps *= 2
        if not np.all(np.isfinite(fine)):
            raise RunawayError(f"the loop on {self.plant.name} runs away at t = {t:g} s; tune it again")
        raise StepSizeError(
            f"plant {self.plant.name}: {2 * self.substeps} steps per sample leave an error of {error:.1e} of a state "
            f"at t = {t:g} s (rtol = {self.rtol:g}); check the parameters and that the loop does not run away, smooth "
            "the friction (v_s), or raise rtol"
        )
