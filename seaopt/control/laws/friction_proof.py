"""Whether a controller is shown to be stable on a plant for every friction curve of its sector, for the certificate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from seaopt.control.laws.controller import Controller
from seaopt.control.loops.absolute_stability import FrictionMargin, friction_margin
from seaopt.control.loops.friction_loop import FrictionLoop
from seaopt.control.loops.law import Law
from seaopt.control.loops.loop import STABLE, Loop
from seaopt.control.loops.sampled_plant import find_rest, linearise_sets, sample_linear
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import SLIDING, friction_matrices, friction_slopes, friction_states


def prove_friction(
    controller: Controller, plant: Plant, params: ParameterSet, first: str = "", least: float = 0.0
) -> FrictionMargin | None:
    """Return how much steeper friction may be with stability shown, between the samples too; None without friction.

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
        itself (a sampled jump has no bounded gain), or where nothing was shown: that is no proof of an oscillation.

    Examples
    --------
    >>> import seaopt as so
    >>> stand, rubbing = so.plants.high_impedance(), so.plants.thor().update(f_c=50.0)
    >>> controller = so.tune(stand, rubbing, so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6))
    >>> prove_friction(controller, stand, rubbing).proved
    True

    """
    return prove_friction_sets(controller, plant, [params], first, least)[0]


def prove_friction_sets(
    controller: Controller, plant: Plant, sets: Sequence[ParameterSet], first: str = "", least: float = 0.0
) -> list[FrictionMargin | None]:
    """Return `prove_friction` of a plant at several sets of parameters, all with the same conditions among them."""
    return [
        None if loop is None else prove_loop(loop, first, least) for loop in take_friction_out(controller, plant, sets)
    ]


def prove_loop(loop: FrictionLoop, first: str = "", least: float = 0.0) -> FrictionMargin:
    """Return the margin of a loop with its friction taken out; see `prove_friction`."""
    closed = Loop(plant=loop.plant, law=loop.law)
    if np.max(np.abs(closed.eigenvalues())) >= STABLE:
        return lack_proof(loop.slopes.size, "unstable without friction")
    if np.any(loop.through * loop.slopes):
        return lack_proof(loop.slopes.size, "friction acts on the measured output itself")
    return friction_margin(loop, first, least)


def lack_proof(frictions: int, reason: str) -> FrictionMargin:
    """Return the margin of a plant of which nothing can be shown, with the reason."""
    return FrictionMargin(factor=0.0, slopes=(0.0,) * frictions, frequency_hz=0.0, multiplier=f"none: {reason}")


def take_friction_out(
    controller: Controller, plant: Plant, sets: Sequence[ParameterSet]
) -> list[FrictionLoop | None]:  # fmt: skip
    """Return `make_friction_loops` of a controller."""
    return make_friction_loops(
        plant, sets, controller.spec.measured, controller.command.per_effort, controller.delay_samples, controller.law
    )


def make_friction_loops(
    plant: Plant, sets: Sequence[ParameterSet], measured: str, per_effort: float, delay_samples: int, law: Law
) -> list[FrictionLoop | None]:
    """Return, per set of parameters, the sliding loop with what friction has above its flattest slope taken out.

    Parameters
    ----------
    plant : Plant
        With its friction.
    sets : sequence of ParameterSet
        All with the same conditions among them.
    measured : str
        The output that is fed back.
    per_effort : float
        The command that the law's effort becomes, per unit.
    delay_samples : int
        Whole samples from measurement to output, besides the hold.
    law : Law
        Its sample time is the loop's.

    Returns
    -------
    list of FrictionLoop or None
        None where there is no friction.

    """
    values = [plant.complete(params) for params in sets]
    spans = [np.subtract(*friction_slopes(plant, each)[::-1]) for each in values]
    if not np.any(spans):
        return [None] * len(sets)
    sliding = friction_states(plant)[SLIDING]
    linear, delays = linearise_sets(sliding, values, measured, per_effort)
    sampled = sample_linear(linear, delays, law.sample_time_s, delay_samples)
    loops: list[FrictionLoop | None] = []
    for k, (each, span) in enumerate(zip(values, spans, strict=True)):
        on_states, on_outputs, velocity = (
            np.array(block) for block in friction_matrices(plant)(*find_rest(plant, each), each.vector)
        )
        loops.append(None if not np.any(span) else FrictionLoop(
            a=linear[0][k], motor=linear[1][k], measured=linear[2][k], friction=on_states, velocity=velocity,
            through=on_outputs[list(plant.outputs).index(measured)], slopes=span, plant=sampled[k],
            law=law, delay_s=float(delays[k]),
        ))  # fmt: skip
    return loops
