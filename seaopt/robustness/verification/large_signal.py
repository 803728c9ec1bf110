r"""The bandwidth that remains at large amplitudes, where the current saturates, by a stepped sine.

A sine :math:`F_\mathrm{ref} = A \sin 2\pi f t` is kept until the loop has settled; the first harmonic of the force over
whole periods is the describing-function gain at (f, A). As long as nothing saturates it is the linear response, up
to the amplitude

.. math:: A_\mathrm{max}(f) = \frac{F_\mathrm{sat}}{|C_r S|} = F_\mathrm{sat} \frac{|P|}{|T_r|},

the saturation map: the motor force that a tracked reference takes, T/P, is a property of the plant, whatever the
controller.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Complex, Float

from seaopt.control import Controller
from seaopt.control.laws.realisation import runnable
from seaopt.control.loops.peaks import HALF_POWER
from seaopt.control.running.closed_loop import SampledLoop, run_loop
from seaopt.errors import ControlError
from seaopt.formatting import html_text
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record

MEASURED_PERIODS, SETTLING_PERIODS = 6, 12
LEAST_SETTLING_S = 0.6
AMPLITUDES = (0.1, 0.5, 1.0, 2.0, 4.0)  # of the force that the limit allows at the bandwidth
SWEEP_POINTS = 14
STATIC_HZ = 1e-3  # stands for 0 Hz


@record(eq=False)
class LargeSignal:
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
        Highest frequency at which the gain is not yet 3 dB below the linear loop's at 0 Hz; None: not within the sweep.

    """

    plant: str
    frequency_hz: Float[np.ndarray, " f"]
    amplitude_N: Float[np.ndarray, " a"]
    gain: Complex[np.ndarray, "a f"]
    saturated: Bool[np.ndarray, "a f"]
    onset_N: Float[np.ndarray, " f"]
    bandwidth_hz: tuple[float | None, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return amplitudes, bandwidths and the saturation map, for robustness.json."""
        return {
            "plant": self.plant,
            "amplitude_N": self.amplitude_N.tolist(),
            "bandwidth_hz": list(self.bandwidth_hz),
            "saturation_map": {"frequency_hz": self.frequency_hz.tolist(), "amplitude_N": self.onset_N.tolist()},
        }

    def __repr__(self) -> str:
        lines = [f"Large-signal bandwidth on {self.plant}"]
        for amplitude, band, hit in zip(self.amplitude_N, self.bandwidth_hz, self.saturated, strict=True):
            bandwidth = "not within the sweep" if band is None else f"{band:.4g} Hz"
            from_hz = f", saturates from {self.frequency_hz[np.argmax(hit)]:.4g} Hz" if np.any(hit) else ""
            lines.append(f"  {amplitude:.4g} N: {bandwidth}{from_hz}")
        return "\n".join(lines)

    _repr_html_ = html_text


def large_signal(
    controller: Controller,
    plant: Plant,
    parameters: ParameterSet,
    *,
    amplitudes_N: tuple[float, ...] | None = None,
    frequencies_hz: tuple[float, ...] | None = None,
) -> LargeSignal:
    """Sweep a controller over frequency and amplitude on a nonlinear plant, without noise.

    Parameters
    ----------
    controller : Controller
        With a current limit.
    plant, parameters
        The plant that it runs on.
    amplitudes_N : tuple of float, optional
        Multiples of what the limit allows at the bandwidth if left out.
    frequencies_hz : tuple of float, optional
        From a fifth to twice the bandwidth if left out; each is moved to the nearest with whole periods in whole
        samples.

    Returns
    -------
    LargeSignal

    Raises
    ------
    ControlError
        The controller has no current limit, its linear loop on the plant is unstable, or an amplitude or frequency is
        out of range.

    Examples
    --------
    >>> import seaopt as so
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)
    >>> sweep = large_signal(so.tune(stand, thor, spec), stand, thor, amplitudes_N=(20.0, 800.0))
    >>> round(sweep.bandwidth_hz[0]), sweep.bandwidth_hz[1] < 25
    (30, True)

    """
    limit, period, band = controller.spec.current_limit_A, controller.sample_time_s, controller.spec.bandwidth_hz
    if limit is None:
        raise ControlError("the controller has no current_limit_A, so that nothing saturates; give one in its spec")
    if not controller.close(plant, parameters).figures().stable:
        raise ControlError(f"the linear loop on {plant.name} is unstable, so that no response settles; tune another")
    loop = SampledLoop(
        plant=plant, law=runnable(controller), measured=controller.spec.measured, delay_samples=controller.delay_samples
    )
    if frequencies_hz is None:
        wanted = np.geomspace(band / 5, 2 * band, SWEEP_POINTS)
    else:
        wanted = np.array(frequencies_hz, float)
    if not (np.all(wanted > 0.0) and np.all(np.diff(wanted) > 0.0) and np.all(wanted < 0.25 / period)):
        raise ControlError(
            f"frequencies_hz = {frequencies_hz} do not rise from above 0 to {0.25 / period:g}; sort them"
        )
    lengths = np.round(MEASURED_PERIODS / (wanted * period)).astype(int)
    f = MEASURED_PERIODS / (lengths * period)
    onset = _compute_onset(controller, plant, parameters, f)
    static = float(np.abs(controller.close(plant, parameters).tracking(np.array([STATIC_HZ])))[0])
    at_band = float(_compute_onset(controller, plant, parameters, np.array([float(band)]))[0])
    amplitude = np.array(amplitudes_N, float) if amplitudes_N is not None else np.array(AMPLITUDES) * at_band
    if not (amplitude.size and np.all(amplitude > 0.0)):
        raise ControlError(f"amplitudes_N = {amplitudes_N} are not positive; give some")
    gain = np.zeros((amplitude.size, f.size), dtype=complex)
    saturated = np.zeros(gain.shape, dtype=bool)
    for column, (frequency, length) in enumerate(zip(f, lengths, strict=True)):
        n = length + math.ceil(max(SETTLING_PERIODS / frequency, LEAST_SETTLING_S) / period)
        phase = 2 * np.pi * frequency * period * np.arange(n)
        run = run_loop(loop, [parameters] * amplitude.size, amplitude[:, None] * np.sin(phase))
        force, current = run.outputs[loop.measured][:, -length:], run.current[:, -length:]
        gain[:, column] = 2j * np.mean(force * np.exp(-1j * phase[-length:]), axis=1) / amplitude
        saturated[:, column] = np.max(np.abs(current), axis=1) >= limit * (1 - 1e-9)
    return LargeSignal(
        plant=plant.name, frequency_hz=f, amplitude_N=amplitude, gain=gain, saturated=saturated, onset_N=onset,
        bandwidth_hz=tuple(_find_bandwidth(f, np.abs(row), static) for row in gain),
    )  # fmt: skip


def _compute_onset(
    controller: Controller, plant: Plant, parameters: ParameterSet, f: Float[np.ndarray, " f"]
) -> Float[np.ndarray, " f"]:
    limit = controller.spec.current_limit_A
    assert limit is not None
    loop = controller.close(plant, parameters)
    motor = np.abs(loop.reference.response(f, controller.sample_time_s) * loop.sensitivity(f))
    return limit / controller.command.per_effort / motor


def _find_bandwidth(f: Float[np.ndarray, " f"], gain: Float[np.ndarray, " f"], static: float) -> float | None:
    """Return where the gain last falls through 3 dB below the static one, on straight lines in logarithms."""
    level = np.log(np.maximum(gain, 1e-300)) - math.log(HALF_POWER * static)
    falls = np.flatnonzero((level[:-1] >= 0.0) & (level[1:] < 0.0))
    if not falls.size or level[-1] >= 0.0:
        return None
    k = int(falls[-1])
    share = level[k] / (level[k] - level[k + 1])
    return float(np.exp(np.log(f[k]) + share * (np.log(f[k + 1]) - np.log(f[k]))))
