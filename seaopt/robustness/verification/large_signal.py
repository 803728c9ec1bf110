r"""Bandwidth against amplitude, from stuck through sliding to saturation, by a stepped sine, and predicted.

A sine :math:`F_\mathrm{ref} = A \sin 2\pi f t` is kept until the loop has settled; the first harmonic of the force over
whole periods is the describing-function gain at (f, A). As long as nothing saturates it is the linear response, up
to the amplitude

.. math:: A_\mathrm{max}(f) = \frac{F_\mathrm{sat}}{|C_r S|} = F_\mathrm{sat} \frac{|P|}{|T_r|},

the saturation map: the motor force that a tracked reference takes, T/P, is a property of the plant, whatever the
controller. Below the dry friction the force follows through a plant that sticks, or creeps, and reaches less far.
The same gains are predicted by describing functions (`amplitude_prediction`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Complex, Float

from seaopt.codec import NullIs
from seaopt.control import Controller, runnable
from seaopt.control.loops.loop import Loop
from seaopt.control.loops.peaks import HALF_POWER
from seaopt.control.running.closed_loop import run_loop
from seaopt.errors import ControlError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import find_dry_friction, take_sliding
from seaopt.progress import Progress, ignore
from seaopt.records import PlotAccessor, Worded, record
from seaopt.robustness.verification.amplitude_prediction import predict_gain
from seaopt.robustness.verification.scenarios import build_loop
from seaopt.units import LINEAR

MEASURED_PERIODS, SETTLING_PERIODS = 6, 12
LEAST_SETTLING_S = 0.6
AMPLITUDES = (0.1, 0.5, 1.0, 2.0, 4.0)  # of the force that the limit allows at the bandwidth
SWEEP_POINTS = 14
STATIC_HZ = 1e-3  # stands for 0 Hz
LEAST_FRICTION, MOST_FRICTION, FRICTION_AMPLITUDES = 0.1, 50.0, 9  # times the dry friction: from stuck to sliding
SLOWEST_STUCK = 15.0  # times slower than the bandwidth: where sweeps begin on a plant with friction
PREDICTED_POINTS = 80


@record(eq=False, repr=False)
class LargeSignal(Worded):
    """Gain and bandwidth against amplitude.

    Parameters
    ----------
    plant : str
        The plant's name.
    frequency_hz : array, shape (f,)
    amplitude_N : array, shape (a,)
        Of F_ref.
    gain : complex array, shape (a, f)
        First harmonic of the measured force over that of F_ref.
    saturated : bool array, shape (a, f)
        Whether the current reached its limit after settling.
    onset_N : array, shape (f,)
        A_max of the linear loop.
    bandwidth_hz : tuple of float or None, one per amplitude
        Frequency at which the gain falls 3 dB below the linear loop's at 0 Hz, where a link moves for the last time;
        None: not within the sweep.
    predicted_hz : tuple of float or None, one per amplitude
        The same by describing functions.
    friction_N : float
        The dry friction, as an effort at the spring; zero where there is none.
    unit : str
        Of the amplitudes: N, or N m.
    """

    plot = PlotAccessor()

    plant: str
    frequency_hz: Float[np.ndarray, " f"]
    amplitude_N: Float[np.ndarray, " a"]
    gain: Complex[np.ndarray, "a f"]
    saturated: Bool[np.ndarray, "a f"]
    onset_N: Annotated[Float[np.ndarray, " f"], NullIs(value=math.inf)]
    bandwidth_hz: tuple[float | None, ...]
    predicted_hz: tuple[float | None, ...]
    friction_N: float
    unit: str = LINEAR.unit


def large_signal(
    controller: Controller,
    plant: Plant,
    parameters: ParameterSet,
    *,
    amplitudes_N: tuple[float, ...] | None = None,
    frequencies_hz: tuple[float, ...] | None = None,
    progress: Progress = ignore,
) -> LargeSignal:
    """Sweep a controller over frequency and amplitude on a nonlinear plant, without noise (`LargeSignal`).

    Parameters
    ----------
    controller : Controller
        With a current limit, unless the plant has friction.
    plant, parameters
        The plant that it runs on.
    amplitudes_N : tuple of float, optional
        Multiples of what the limit allows at the bandwidth if left out; with friction from a tenth of it upwards.
    frequencies_hz : tuple of float, optional
        From a fifth of the bandwidth to twice if left out, with friction from a fifteenth; each is moved to the nearest
        with whole periods in whole samples.
    progress : callable, optional
        Called before each frequency (`seaopt.progress.Progress`).

    Raises
    ------
    ControlError
        The controller has no limit and the plant no friction, the linear loop is unstable, or an amplitude or
        frequency is out of range.

    Examples
    --------
    >>> import seaopt as so
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)
    >>> sweep = large_signal(so.tune(stand, thor, spec), stand, thor, amplitudes_N=(20.0, 800.0))
    >>> round(sweep.bandwidth_hz[0]), sweep.bandwidth_hz[1] < 25
    (30, True)
    """
    parameters = controller.delay(parameters)
    limit, period, band = controller.command_limit, controller.sample_time_s, controller.spec.bandwidth_hz
    values = plant.complete(parameters)
    friction = sum(find_dry_friction(plant, values).values())
    if limit is None and not friction:
        raise ControlError(
            "the command has no limit, so that nothing saturates; give current_limit_A (command_limit) in the spec"
        )
    linear = controller.close(take_sliding(plant, values), values)
    if not linear.figures().stable:
        raise ControlError(f"the linear loop on {plant.name} is unstable, so that no response settles; tune another")
    # A gate gives its sensor up at the largest amplitudes, where there is no response then.
    loop = build_loop(controller, plant, [parameters], runnable(controller, gate=False))
    loop = replace(loop, sticks=plant.sticks)  # a smoothed curve would let the motor creep
    if frequencies_hz is None:
        wanted = np.geomspace(band / (SLOWEST_STUCK if friction else 5.0), 2 * band, SWEEP_POINTS)
    else:
        wanted = np.array(frequencies_hz, float)
    if not (np.all(wanted > 0.0) and np.all(np.diff(wanted) > 0.0) and np.all(wanted < 0.25 / period)):
        raise ControlError(
            f"frequencies_hz = {frequencies_hz} do not rise from above 0 to {0.25 / period:g}; sort them"
        )
    lengths = np.round(MEASURED_PERIODS / (wanted * period)).astype(int)
    f = MEASURED_PERIODS / (lengths * period)
    onset = _compute_onset(controller, linear, f)
    static = float(np.abs(linear.tracking(np.array([STATIC_HZ])))[0])
    at_band = float(_compute_onset(controller, linear, np.array([float(band)]))[0])
    amplitude = np.array(amplitudes_N if amplitudes_N is not None else _choose_amplitudes(at_band, friction), float)
    if not (amplitude.size and np.all(amplitude > 0.0)):
        raise ControlError(f"amplitudes_N = {amplitudes_N} are not positive; give some")
    gain = np.zeros((amplitude.size, f.size), dtype=complex)
    saturated = np.zeros(gain.shape, dtype=bool)
    samples = lengths + np.ceil(np.maximum(SETTLING_PERIODS / f, LEAST_SETTLING_S) / period).astype(int)
    for column, (frequency, length, n) in enumerate(zip(f, lengths, samples, strict=True)):
        progress(f"{frequency:.3g} Hz", float(np.sum(samples[:column]) / np.sum(samples)))
        phase = 2 * np.pi * frequency * period * np.arange(n)
        run = run_loop(loop, [parameters] * amplitude.size, amplitude[:, None] * np.sin(phase))
        force, current = run.outputs[loop.regulated][:, -length:], run.current[:, -length:]
        gain[:, column] = 2j * np.mean(force * np.exp(-1j * phase[-length:]), axis=1) / amplitude
        saturated[:, column] = np.max(np.abs(current), axis=1) >= (math.inf if limit is None else limit * (1 - 1e-9))
    dense = np.geomspace(f[0], f[-1], PREDICTED_POINTS)
    predicted = np.abs(predict_gain(controller, plant, values, dense, amplitude))
    return LargeSignal(
        plant=plant.name,
        frequency_hz=f,
        amplitude_N=amplitude,
        gain=gain,
        saturated=saturated,
        onset_N=onset,
        bandwidth_hz=tuple(_find_bandwidth(f, np.abs(row), static, plant.moves) for row in gain),
        predicted_hz=tuple(_find_bandwidth(dense, row, static, plant.moves) for row in predicted),
        friction_N=friction,
        unit=controller.command.reference_unit,
    )


def predict_bandwidths(
    controller: Controller, plant: Plant, parameters: ParameterSet, amplitude: Float[np.ndarray, " a"]
) -> tuple[float | None, ...]:
    """Return the bandwidth (Hz) at amplitudes of the reference (N), by describing functions, as in a `LargeSignal`."""
    band, values = controller.spec.bandwidth_hz, plant.complete(parameters)
    f = np.geomspace(band / SLOWEST_STUCK, min(2.0 * band, 0.24 / controller.sample_time_s), PREDICTED_POINTS)
    linear = controller.close(take_sliding(plant, values), values)
    static = float(np.abs(linear.tracking(np.array([STATIC_HZ])))[0])
    gains = np.abs(predict_gain(controller, plant, values, f, amplitude))
    return tuple(_find_bandwidth(f, row, static, plant.moves) for row in gains)


def _choose_amplitudes(at_band: float, friction: float) -> Float[np.ndarray, " a"]:
    """Return amplitudes (N) from stuck to saturation, of what is there of the two."""
    saturating = np.array(AMPLITUDES) * at_band
    if not friction:
        return saturating
    last = saturating[-1] if math.isfinite(at_band) else MOST_FRICTION * friction
    return np.geomspace(min(LEAST_FRICTION * friction, 0.1 * last), last, FRICTION_AMPLITUDES)


def _compute_onset(controller: Controller, loop: Loop, f: Float[np.ndarray, " f"]) -> Float[np.ndarray, " f"]:
    """Return the amplitude (N) at which the linear loop's current saturates; infinite without a limit."""
    limit = controller.command_limit
    effort = np.abs(loop.tracking(f) / loop.plant.response(f))
    return np.full(f.size, np.inf) if limit is None else limit / controller.command.per_effort / effort


def _find_bandwidth(
    f: Float[np.ndarray, " f"], gain: Float[np.ndarray, " f"], static: float, moves: bool
) -> float | None:
    """Return where the gain falls through 3 dB below the static one, on straight lines in logarithms. It is the first
    fall, and the last where the link moves: below its tracking band such a plant does not follow.
    """
    level = np.log(np.maximum(gain, 1e-300)) - math.log(HALF_POWER * static)
    falls = np.flatnonzero((level[:-1] >= 0.0) & (level[1:] < 0.0))
    if not falls.size or (moves and level[-1] >= 0.0) or (not moves and level[0] < 0.0):
        return None
    k = int(falls[-1 if moves else 0])
    share = level[k] / (level[k] - level[k + 1])
    return float(np.exp(np.log(f[k]) + share * (np.log(f[k + 1]) - np.log(f[k]))))
