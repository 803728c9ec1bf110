r"""The response to a sine of finite amplitude, predicted by describing functions of friction and of saturation.

Friction above its flattest slope is replaced by :math:`N(V)` (`seaopt.control.laws.friction`), the current limit by

.. math:: \sigma(x) = \frac{2}{\pi} \Big( \arcsin x + x \sqrt{1 - x^2} \Big), \qquad x = F_\mathrm{sat} / U \le 1,

each at the amplitude that it meets, of velocity V and of motor effort U. With the law's effort
:math:`\sigma (C_r r - C_y y)` and the fundamental alone of what is held in between, V follows from

.. math:: V\,|1 + N(V) H_\sigma| = |T_{v\sigma}|\, A

for every :math:`\sigma`, H from friction effort and T from reference to velocity, and :math:`\sigma` from its own
function of U. Where several V solve this, the smallest is taken: the loop comes from rest.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control import Controller
from seaopt.control.laws.friction import AMPLITUDES, describe_friction, take_friction_out
from seaopt.control.loops.friction_loop import FUNDAMENTAL
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import list_smoothing, take_sliding
from seaopt.records import record

JUMP = 1e-6  # m/s or rad/s, over which a friction that sticks is smoothed
SATURATION_GAINS = np.geomspace(1.0, 1e-2, 80)
Response = Complex[np.ndarray, " f"]


def predict_gain(
    controller: Controller,
    plant: Plant,
    params: ParameterSet,
    f: Float[np.ndarray, " f"],
    amplitude: Float[np.ndarray, " a"],
) -> Complex[np.ndarray, "a f"]:
    """Return force over reference at amplitudes (N) and frequencies (Hz): fundamental, other frictions sliding."""
    values = plant.complete(params)
    if plant.sticks:
        values = plant.complete(values.update(**dict.fromkeys(list_smoothing(plant), JUMP)))
    loop = controller.close(take_sliding(plant, values), values)
    p, open_loop = loop.plant.response(f), loop.open_loop(f)
    c_y, c_r = loop.law.feedback_responses(f), loop.law.reference_response(f)
    limit = controller.command_limit
    most = np.inf if limit is None else limit / controller.command.per_effort
    friction = _FrictionPort.of(controller, plant, values, f)
    gains = SATURATION_GAINS if limit is not None else SATURATION_GAINS[:1]
    sigma = gains[:, None, None]
    closed = 1.0 / (1.0 + sigma * open_loop)  # (s, 1, f)
    a = amplitude[None, :, None]
    fed_back = np.sum(c_y * friction.on_outputs, axis=0)  # of a unit of friction
    w = friction.effort(sigma, closed, c_r, fed_back, a)  # (s, a, f)
    effort = closed * (c_r * a - fed_back * w)
    force = p * sigma * effort + friction.on_outputs[0] * w
    share = np.minimum(most / np.maximum(np.abs(effort), 1e-300), 1.0)
    met = 2.0 / np.pi * (np.arcsin(share) + share * np.sqrt(1.0 - share**2))
    first = np.argmax(met >= sigma, axis=0)  # from no saturation downwards
    return np.take_along_axis(force, first[None], axis=0)[0] / amplitude[:, None]


@record(eq=False)
class _FrictionPort:
    """The friction of a plant as a port of its loop, at frequencies; none where nothing changes with the velocity."""

    on_outputs: Complex[np.ndarray, "y f"]
    mobility: Response
    by_motor: Response
    gains: Float[np.ndarray, " v"]

    @classmethod
    def of(
        cls, controller: Controller, plant: Plant, params: ParameterSet, f: Float[np.ndarray, " f"]
    ) -> _FrictionPort:
        (loop,) = take_friction_out(controller, plant, [params])
        nothing = np.zeros(f.size, dtype=complex)
        if loop is None or loop.only_port is None:
            still = np.zeros(AMPLITUDES.size)
            return cls(on_outputs=nothing[None], mobility=nothing, by_motor=nothing, gains=still)
        port = loop.only_port
        seen = np.vstack([loop.velocity[port], loop.sensed])
        opened = loop.respond(2 * np.pi * f * loop.plant.sample_time_s, FUNDAMENTAL, seen)
        mobility, *on_outputs = opened.by_friction[:, 0, :, port].T
        return cls(
            on_outputs=np.array(on_outputs) + loop.through[:, port, None],
            mobility=mobility,
            by_motor=opened.by_motor[:, 0, 0],
            gains=describe_friction(plant, params, list(plant.friction)[port], AMPLITUDES),
        )

    def effort(
        self,
        sigma: Float[np.ndarray, "s 1 1"],
        closed: Complex[np.ndarray, "s 1 f"],
        c_r: Response,
        fed_back: Response,
        amplitude: Float[np.ndarray, "1 a 1"],
    ) -> Complex[np.ndarray, "s a f"]:
        """Return the fundamental of the friction's effort on the plant; `fed_back` is the law's of a unit of it."""
        h = self.mobility - self.by_motor * sigma * closed * fed_back
        t = self.by_motor * sigma * closed * c_r
        if not np.any(self.gains):
            return np.zeros(np.broadcast_shapes(t.shape, amplitude.shape), dtype=complex)
        v = AMPLITUDES[:, None, None, None]
        # Rising, so that the smallest V is taken where several will do.
        needed = np.maximum.accumulate(v * np.abs(1.0 + self.gains[:, None, None, None] * h), axis=0)[:, :, 0]
        driven = np.abs(t) * amplitude
        above = np.clip(np.count_nonzero(needed[:, :, None] < driven, axis=0), 1, AMPLITUDES.size - 1)
        rows, _, columns = np.ogrid[: above.shape[0], :1, : above.shape[2]]
        low, high = (np.log(needed[above - step, rows, columns]) for step in (1, 0))
        share = np.clip((np.log(np.maximum(driven, 1e-300)) - low) / np.maximum(high - low, 1e-12), 0.0, 1.0)
        gain = (1.0 - share) * self.gains[above - 1] + share * self.gains[above]
        return -gain * t * amplitude / (1.0 + gain * h)
