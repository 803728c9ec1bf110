"""Show that a controller is stable on a plant for every friction curve of its sector, for the certificate."""

from __future__ import annotations

from collections.abc import Sequence

from seaopt.control.laws.controller import ClosesLoops
from seaopt.control.loops.absolute_stability import FrictionMargin, friction_margin
from seaopt.control.loops.friction_loop import FrictionLoop, make_friction_loops
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant


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
