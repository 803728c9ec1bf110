r"""A loop with dry friction: how much of its curves is shown to be stable, and the limit cycles where it is not.

Stability is shown for every friction curve of a sector (`seaopt.control.loops.absolute_stability`). Where that fails,
limit cycles are predicted by the describing function.

Friction is what its curve :math:`\varphi` has above its flattest slope (the rest is in the plant). A velocity
:math:`V \sin \omega t` meets a force whose fundamental is :math:`N(V) V \sin \omega t`,

.. math:: N(V) = \frac{1}{\pi V} \int_0^{2\pi} \varphi(V \sin\theta) \sin\theta \, d\theta,

by quadrature of the declared curve. With H the sampled loop from friction effort to velocity at the fundamental, no
aliases (see `seaopt.control.loops.absolute_stability`), a cycle needs :math:`1 + N(V) H(j\omega) = 0`: H is real and
negative where its phase crosses, and N(V) = -1/H there. It is stable where a larger amplitude damps it (Loeb; Gelb,
Vander Velde, Multiple-Input Describing Functions, 1968): the pole moves by :math:`dN / (N^2 H')` on the imaginary axis.

A describing function knows the fundamental alone. It is good where the loop filters harmonics and the cycle slides
through; cycles that stick for a while at each turn (hunting of an integral against static friction) can be missed.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from jaxtyping import Complex

from seaopt.control.laws.controller import ClosesLoops, Controller
from seaopt.control.loops.absolute_stability import FrictionMargin, friction_margin
from seaopt.control.loops.friction_loop import FUNDAMENTAL, FrictionLoop, make_friction_loops
from seaopt.control.loops.transfer_function import Frequencies, Response
from seaopt.control.systems.crossings import find_crossings
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import friction_slopes, remembers
from seaopt.records import record

ANGLES = 512  # of the quadrature
AMPLITUDES = np.geomspace(1e-7, 1e2, 271)  # m/s or rad/s
LOWEST_HZ, FREQUENCIES = 1e-2, 3000
DERIVATIVE = 1e-5  # relative step of frequency and amplitude


@record
class LimitCycle:
    """A limit cycle that the describing function of friction predicts."""

    frequency_hz: float
    force_N: float  # amplitude of the measured output
    velocity: float  # amplitude of the velocity that the friction acts on, m/s or rad/s
    stable: bool  # the loop comes back to it; an unstable one bounds what a loop recovers from
    state: tuple[float, ...]  # the plant's states at the cycle's largest friction velocity


def find_friction_margin(controller: ClosesLoops, plant: Plant, params: ParameterSet) -> FrictionMargin | None:
    """Return how much steeper friction may be with stability shown, between the samples too; None without friction. The
    linear plant is the sliding one; what a curve's slope is above its flattest is in the sector. The controller's
    measurement path closes the loop; the reference stands still; `params` may hold conditions. The factor is zero where
    the sliding loop is unstable, has an `obstacle` (`FrictionLoop`), or nothing was shown, which does not show an
    oscillation.
    """
    return find_friction_margins(controller, plant, [params])[0]


def find_friction_margins(
    controller: ClosesLoops, plant: Plant, sets: Sequence[ParameterSet], first: str = "", least: float = 0.0
) -> list[FrictionMargin | None]:
    """Return `find_friction_margin` at sets of parameters with the same conditions; see `friction_margin`."""
    loops = take_friction_out(controller, plant, sets)
    return [None if loop is None else friction_margin(loop, first, least) for loop in loops]


def take_friction_out(controller: ClosesLoops, plant: Plant, sets: Sequence[ParameterSet]) -> list[FrictionLoop | None]:
    """Return `make_friction_loops` of a controller."""
    late, waits = [controller.delay(params) for params in sets], controller.compute_delay_samples
    return make_friction_loops(plant, late, controller.signals, controller.per_effort, waits, controller.law)


def describe_friction(plant: Plant, params: ParameterSet, name: str, amplitude: Frequencies) -> Frequencies:
    """Return the describing function N (N s/m) of a friction above its flattest slope, at velocity amplitudes."""
    values = plant.complete(params)
    flattest = friction_slopes(plant, values)[0][list(plant.friction).index(name)]
    friction, v = plant.friction[name], ca.SX.sym("v")
    force_at_speed = ca.SX(friction.force(v, friction.add_rated(values.by_attribute)))
    curve = ca.Function("friction", [v], [force_at_speed]).map(ANGLES)
    theta = (np.arange(ANGLES) + 0.5) * 2 * np.pi / ANGLES
    wave = amplitude[:, None] * np.sin(theta)
    force = np.array(curve(wave.reshape(1, -1))).reshape(wave.shape) - flattest * wave
    return 2.0 * np.mean(force * np.sin(theta), axis=1) / amplitude


def predict_limit_cycles(controller: Controller, plant: Plant, params: ParameterSet) -> tuple[LimitCycle, ...]:
    """Return the limit cycles that the describing function of a plant's friction predicts, the fastest last; the
    reference stands still. None are predicted where several frictions change with velocity, nor where one has bristles:
    before they slip they are a spring, which the curve of steady sliding knows nothing of.
    """
    if remembers(plant):
        return ()
    (loop,) = take_friction_out(controller, plant, [params])
    if loop is None or loop.only_port is None:
        return ()
    port = loop.only_port
    name = list(plant.friction)[port]
    gains = describe_friction(plant, params, name, AMPLITUDES)
    cycles: list[LimitCycle] = []
    for f in _find_crossings(loop, port):
        h, y, x = _respond(loop, port, f * np.array([1.0, 1.0 + DERIVATIVE]))
        slope = (h[1] - h[0]) / (2j * np.pi * f * DERIVATIVE)
        wanted = float(-1.0 / h[0].real)
        for velocity in _find_amplitudes(gains, wanted):
            around = np.array([velocity * (1 - DERIVATIVE), velocity * (1 + DERIVATIVE)])
            rise = float(np.diff(describe_friction(plant, params, name, around))[0])
            friction = wanted * velocity
            cycles.append(
                LimitCycle(
                    frequency_hz=f,
                    force_N=float(abs(y[0]) * friction),
                    velocity=velocity,
                    stable=bool(rise * np.real(1.0 / slope) < 0.0),
                    state=tuple(float(value) for value in np.real(-x[0] * friction)),
                )
            )
    return tuple(cycles)


def _find_crossings(loop: FrictionLoop, port: int) -> list[float]:
    """Return the frequencies (Hz) at which the friction's loop is real and negative."""
    nyquist = 0.5 / loop.plant.sample_time_s
    modes = np.abs(np.imag(np.linalg.eigvals(loop.a))) / (2 * np.pi)
    close = (modes[:, None] * np.linspace(0.8, 1.25, 91)).ravel()
    grid = np.concatenate([np.geomspace(LOWEST_HZ, 0.999 * nyquist, FREQUENCIES), close])
    grid = np.unique(grid[(grid > LOWEST_HZ) & (grid < nyquist)])
    crossings = find_crossings(lambda f: np.imag(_respond(loop, port, f)[0]), grid)
    return crossings[np.real(_respond(loop, port, crossings)[0]) < 0.0].tolist()


def _find_amplitudes(gains: Frequencies, wanted: float) -> list[float]:
    """Return the amplitudes at which the describing function is a value, on straight lines in logarithms."""
    level = np.log(np.maximum(gains, 1e-300)) - np.log(wanted)
    return [
        float(AMPLITUDES[i] * (AMPLITUDES[i + 1] / AMPLITUDES[i]) ** (level[i] / (level[i] - level[i + 1])))
        for i in np.flatnonzero(np.sign(level[:-1]) * np.sign(level[1:]) < 0)
    ]


def _respond(loop: FrictionLoop, port: int, f: Frequencies) -> tuple[Response, Response, Complex[np.ndarray, "m n"]]:
    """Return velocity, measured output and states of a friction effort of 1 N at frequencies (Hz), the fundamentals."""
    theta = 2 * np.pi * f * loop.plant.sample_time_s
    opened = loop.respond(theta, FUNDAMENTAL, np.eye(loop.motor.size))
    by_friction, by_motor = opened.by_friction[:, 0, :, port], opened.by_motor[:, 0]
    sensed = loop.sensed @ by_friction.T + loop.through[:, port, None]
    effort = -np.sum(loop.feedback(theta) * sensed, axis=0)
    x = by_friction + by_motor * effort[:, None]
    return x @ loop.velocity[port], sensed[0] + (by_motor @ loop.sensed[0]) * effort, x
