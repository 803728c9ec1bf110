r"""The linear loop of a scenario's last phase, for its judgement: its stability, and the force that noise makes.

White noise of variance :math:`s_n^2` on the reading and :math:`s_u^2` on the motor force leave

.. math:: \frac{1}{f_N} \int_{f_0}^{f_N} s_n^2 |T|^2 + s_u^2 |P S|^2 \, df

of the force's variance above :math:`f_0`, with :math:`T = LS` and :math:`f_N` half the sample rate. A step :math:`q` of
a sensor or amplifier counts as white noise of variance :math:`q^2/12`.
"""

from __future__ import annotations

import math

import numpy as np

from seaopt.control.laws.outer_run import enclose
from seaopt.control.loops.loop import GROWING, STABLE, Loop
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.verification.playback import Rig, apply_load
from seaopt.robustness.verification.scenarios import Scenario

REAL = 1e-12  # rad a sample: an eigenvalue of a smaller angle is real but for rounding


@record(eq=False)
class LinearView:
    """The linear loop of a scenario's last phase, at rest."""

    loop: Loop
    noise: tuple[float, ...]  # std of the white noise that represents each sensor, the regulated one's first
    step_N: float  # the same of the rounded current
    drifts: bool = False  # nothing holds the link that an outer loop reads, whose damping alone leaves it where it is

    @property
    def instability(self) -> str:
        """The eigenvalue that makes the loop unstable, as text; empty where it is stable."""
        poles, period = self.loop.eigenvalues(), self.loop.plant.sample_time_s
        fastest = poles[np.argmax(np.abs(poles))] if poles.size else 0.0
        radius = abs(fastest)
        if radius < STABLE or (self.drifts and radius <= GROWING):
            return ""
        if not math.isfinite(radius):
            return "unstable: the linear loop has an eigenvalue that is not finite"
        angle = abs(np.angle(fastest))
        hz = angle / (2 * np.pi * period) if angle > REAL else 0.0
        grows = f", doubling in {math.log(2) * period / math.log(radius):.3g} s" if radius > 1.0 + 1e-12 else ""
        return f"unstable: the linear loop's spectral radius is {radius:.6g}, at {hz:.4g} Hz{grows}"

    def force_std(self, lowest_hz: float = 0.0) -> float:
        """Return the standard deviation (N) of the force that noise makes above a frequency; the loop is stable."""
        if not (any(self.noise) or self.step_N):
            return 0.0
        f = self.loop.grid()
        f = np.concatenate([[lowest_hz], f[f > lowest_hz]]) if lowest_hz else f
        by_effort = np.abs(self.loop.plant.response(f) * self.loop.sensitivity(f))
        by_noise = np.array(self.noise) ** 2 @ np.abs(self.loop.law.feedback_responses(f)) ** 2
        power = by_effort**2 * (by_noise + self.step_N**2)
        return math.sqrt(float(np.trapezoid(power, f)) / self.loop.plant.nyquist_hz)


def linearise_last_phase(rig: Rig, scenario: Scenario, drawn: ParameterSet) -> LinearView:
    """Return the linear loop of a scenario's last phase, with the load and the link as they are then. It is that of the
    plant at rest, where the phase ends, with friction as steep as it is there; what the loop does in motion the
    simulation shows. `drawn` has the parameters and conditions of the run.
    """
    last = scenario.phases[-1]
    plant = rig.partner if last.held and rig.partner is not None else rig.plant
    params = drawn.with_parameters(*plant.complete(drawn).values())
    for phase in scenario.phases:
        params = apply_load(params, {name: factor for name, factor in phase.scale.items() if name in plant.parameters})
    return view_loop(rig, plant, params)


def view_loop(rig: Rig, plant: Plant, params: ParameterSet) -> LinearView:
    """Return the linear loop on a plant at rest, with the noise of a rig's devices."""
    controller, outer = rig.controller, rig.controller.outer
    enclosed = enclose(controller, plant)
    return LinearView(
        loop=Loop(plant=enclosed.plant(plant, params), law=enclosed.law),
        noise=tuple(_combine_std(*rig.find_errors(name)) for name in enclosed.signals),
        step_N=_combine_std(0.0, rig.command_step / controller.command.per_effort),
        drifts=outer is not None and not outer.stiffness,
    )


def _combine_std(std: float, step: float) -> float:
    """Return the standard deviation of noise and of rounding to a step."""
    return math.hypot(std, step / math.sqrt(12.0))
