r"""Limit cycles of play, predicted by its describing function, for plants whose spring has backlash.

Play shows in the plant's Jacobian: along one state the matrices change from those within the play, :math:`A_0`, to
those beyond it, :math:`A_1`, and stay there, :math:`A(\delta) = A_0 + s(\delta) (A_1 - A_0)` with s from 0 to 1. An
oscillation of amplitude D in that state meets, at its fundamental,

.. math:: N(D) = \frac{2}{\pi} \int_0^\pi s(D \cos\theta) \sin^2\theta \, d\theta

of the change (the fundamental of a curve with the slope s, by parts). The sampled loop with the plant
:math:`A_0 + N (A_1 - A_0)` has a pair of eigenvalues on the unit circle where it can oscillate; the cycle is stable
where a larger amplitude, which is a larger N, damps it (Gelb, Vander Velde, Multiple-Input Describing Functions, 1968).
The reference stands at zero, friction slides, and no link moves: a static load keeps a spring out of its play.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.control.laws.controller import Controller
from seaopt.control.laws.friction import LimitCycle
from seaopt.control.loops.loop import Loop
from seaopt.control.loops.sampled_plant import find_rows, sample_matrices
from seaopt.parameters import ParameterSet
from seaopt.plants import CompletedParameters, Plant, jacobians
from seaopt.plants.friction import take_sliding
from seaopt.records import record

DEFLECTIONS = np.concatenate([[0.0], np.geomspace(1e-8, 1e-1, 211)])  # m or rad
FLAT_FROM = 0.9  # of these deflections: from here play has no effect any more
LEAST_CHANGE, ROUNDING = 1e-3, 1e-3
SHARES = np.concatenate([np.geomspace(1e-4, 0.02, 60), np.linspace(0.02, 1.0, 141)[1:]])
BISECTIONS = 40
ANGLES = 256


@record(eq=False)
class _Play:
    """A state along which the plant has play: matrices (a, b, c, d) within and beyond it, and the share s between."""

    state: int
    within: tuple[Any, ...]
    beyond: tuple[Any, ...]
    share: Float[np.ndarray, " d"]

    def mix(self, share: float) -> list[Any]:
        """Return the matrices at a share of the change."""
        return [low + share * (high - low) for low, high in zip(self.within, self.beyond, strict=True)]


def predict_play_cycles(controller: Controller, plant: Plant, params: ParameterSet) -> tuple[LimitCycle, ...]:
    """Return the limit cycles that the describing function of a plant's play predicts; none without play."""
    if plant.moves:
        return ()
    values = plant.complete(controller.delay(params)).drop_conditions()
    sliding = take_sliding(plant, values)
    return tuple(
        cycle
        for play in _find_plays(controller, sliding, values)
        for cycle in _predict(controller, controller.close(sliding, values), play)
    )


def _find_plays(controller: Controller, plant: Plant, params: CompletedParameters) -> list[_Play]:
    rows, gain = find_rows(plant, controller.signals), controller.command.per_effort

    def linearise(x: Float[np.ndarray, " n"]) -> tuple[Any, ...]:
        a, b, c, d = (np.array(block) for block in jacobians(plant)(x, np.zeros(len(plant.inputs)), params.vector))
        return a, b[:, 0] * gain, c[rows], d[rows, 0] * gain

    plays: list[_Play] = []
    for state in range(len(plant.states)):
        direction = np.eye(len(plant.states))[state]
        within, beyond = (linearise(deflection * direction) for deflection in DEFLECTIONS[[0, -1]])
        change = beyond[0] - within[0]
        size = float(np.sum(change**2))
        if np.sqrt(size) <= LEAST_CHANGE * np.max(np.abs(beyond[0])):  # no square of what a draw may make huge
            continue
        matrices = np.array([linearise(deflection * direction)[0] for deflection in DEFLECTIONS])
        share = np.sum((matrices - matrices[0]) * change, axis=(1, 2)) / size
        flat = np.abs(share[int(FLAT_FROM * share.size) :] - 1.0) < ROUNDING
        if np.all(flat) and np.all(np.diff(share) > -ROUNDING):
            plays.append(_Play(state=state, within=within, beyond=beyond, share=share))
    return plays


def _predict(controller: Controller, loop: Loop, play: _Play) -> list[LimitCycle]:
    def find_pole(share: float) -> complex:
        chosen = sample_matrices(play.mix(share), 0.0, controller.sample_time_s, loop.plant.delay_samples)
        poles = replace(loop, plant=chosen).eigenvalues()
        swinging = poles[np.abs(np.imag(poles)) > 0.0]
        return complex(swinging[np.argmax(np.abs(swinging))]) if swinging.size else 0j

    growth = np.array([abs(find_pole(share)) - 1.0 for share in SHARES])
    gains = describe_play(play.share, DEFLECTIONS[1:])
    cycles: list[LimitCycle] = []
    for i in np.flatnonzero(growth[:-1] * growth[1:] < 0.0):
        low, high = float(SHARES[i]), float(SHARES[i + 1])
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if (abs(find_pole(middle)) - 1.0) * growth[i] > 0.0 else (low, middle)
        at = int(np.searchsorted(gains, low))
        if not 0 < at < gains.size:
            continue
        part = (low - gains[at - 1]) / (gains[at] - gains[at - 1])
        deflection = float(DEFLECTIONS[at] * (DEFLECTIONS[at + 1] / DEFLECTIONS[at]) ** part)
        speed = abs(np.angle(find_pole(low))) / controller.sample_time_s
        regulated = play.mix(low)[2][0]
        cycles.append(
            LimitCycle(
                frequency_hz=float(speed / (2 * np.pi)),
                force_N=float(abs(regulated[play.state]) * deflection),
                velocity=float(speed * deflection),
                stable=bool(growth[i] > 0.0),
                state=tuple(float(value) for value in deflection * np.eye(loop.plant.b.size)[play.state]),
            )
        )
    return cycles


def describe_play(share: Float[np.ndarray, " d"], amplitude: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """Return N at amplitudes, of a share s that is known at `DEFLECTIONS`."""
    theta = (np.arange(ANGLES) + 0.5) * np.pi / ANGLES
    met = np.interp(np.abs(amplitude[:, None] * np.cos(theta)), DEFLECTIONS, share)
    return 2.0 * np.mean(met * np.sin(theta) ** 2, axis=1)
