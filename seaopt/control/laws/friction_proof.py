"""Whether a controller is proved stable on a plant for every friction curve of its sector, for the certificate."""

from __future__ import annotations

import numpy as np

from seaopt.control.laws.controller import Controller
from seaopt.control.loops.absolute_stability import FrictionLoop, FrictionMargin, friction_margin
from seaopt.control.loops.loop import STABLE, Loop
from seaopt.control.loops.sampled_plant import DELAY, find_rest, linearise, read_conditions, sample
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import SLIDING, friction_matrices, friction_slopes, friction_states, has_friction


def prove_friction(
    controller: Controller, plant: Plant, params: ParameterSet, first: str = "", least: float = 0.0
) -> FrictionMargin | None:
    """Return how much steeper friction may be with stability proved, between the samples too; None without friction.

    The linear plant of the proof is the sliding one; what a curve's slope is above its flattest is in the sector.

    Parameters
    ----------
    controller : Controller
        Its measurement path closes the loop; the reference stands still.
    plant, params
        The plant with its friction, and parameters, conditions among them.
    first, least
        As in `friction_margin`.

    Returns
    -------
    FrictionMargin or None
        With a factor of zero where the sliding loop is not stable itself, where friction acts on the measured output
        itself (a sampled jump has no bounded gain), or where nothing was proved: that is no proof of an oscillation.

    Examples
    --------
    >>> import seaopt as so
    >>> stand, rubbing = so.plants.high_impedance(), so.plants.thor().update(f_c=50.0)
    >>> controller = so.tune(stand, rubbing, so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6))
    >>> prove_friction(controller, stand, rubbing).proved
    True

    """
    loop = take_friction_out(controller, plant, params)
    if loop is None:
        return None
    closed = Loop(plant=loop.plant, law=controller.law)
    if np.max(np.abs(closed.eigenvalues())) >= STABLE:
        return lack_proof(loop.slopes.size, "unstable without friction")
    if np.any(loop.through * loop.slopes):
        return lack_proof(loop.slopes.size, "friction acts on the measured output itself")
    return friction_margin(loop, first, least)


def lack_proof(frictions: int, reason: str) -> FrictionMargin:
    """Return the margin of a plant of which nothing can be proved, with the reason."""
    return FrictionMargin(factor=0.0, slopes=(0.0,) * frictions, frequency_hz=0.0, multiplier=f"none: {reason}")


def take_friction_out(controller: Controller, plant: Plant, params: ParameterSet) -> FrictionLoop | None:
    """Return the sliding loop with what friction has above its flattest slope taken out; None without friction."""
    values = plant.complete(params)
    if not has_friction(plant, values):
        return None
    sliding = friction_states(plant)[SLIDING]
    flattest, steepest = friction_slopes(plant, values)
    measured, gain = controller.spec.measured, controller.command.per_effort
    conditions = read_conditions(plant, values)
    at = {name: np.array([value]) for name, value in conditions.items()}
    a, motor, output, _ = (block[0] for block in linearise(sliding, values.vector[:, None], at, measured, gain))
    x, u = find_rest(plant, values)
    on_states, on_outputs, velocity = (np.array(block) for block in friction_matrices(plant)(x, u, values.vector))
    return FrictionLoop(
        a=a, motor=motor, friction=on_states, velocity=velocity, measured=output,
        through=on_outputs[list(plant.outputs).index(measured)], slopes=steepest - flattest,
        plant=sample(sliding, values, measured, gain, controller.sample_time_s, controller.delay_samples),
        law=controller.law, delay_s=conditions.get(DELAY, 0.0),
    )  # fmt: skip
