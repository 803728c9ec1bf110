"""A controller's outer loop and the force law behind it as one linear law, and the loop that both close."""

from __future__ import annotations

from seaopt.control.laws.controller import Controller
from seaopt.control.loops.law import Law
from seaopt.control.loops.loop import Loop
from seaopt.control.loops.moved_link import enclose_law, find_position, keep_share, show_position
from seaopt.control.loops.sampled_plant import sample
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant


def enclose(controller: Controller, plant: Plant, *, of_force: bool = False) -> tuple[Law, tuple[str, ...]]:
    """Return the law of a controller, with its outer loop on a plant whose link moves, and the outputs it reads.
    `of_force` is of `enclose_law`.
    """
    law, signals, outer = controller.law, controller.signals, controller.outer
    position = None if outer is None else find_position(plant, outer)
    if outer is None or position is None:
        return law, signals
    kept = keep_share(position)
    if position in signals:
        return enclose_law(law, outer, signals.index(position), kept=kept, of_force=of_force), signals
    return enclose_law(law, outer, kept=kept, of_force=of_force), (*signals, position)


def close_outer(controller: Controller, plant: Plant, params: ParameterSet) -> Loop:
    """Return the loop of a controller around a plant, with its outer loop where the link moves. Its reference is the
    force law's.
    """
    if controller.outer is None:
        return controller.close(plant, params)
    plant = show_position(plant, controller.outer, controller.signals)
    return close(controller, plant, params, enclose(controller, plant, of_force=True))


def close(controller: Controller, plant: Plant, params: ParameterSet, enclosed: tuple[Law, tuple[str, ...]]) -> Loop:
    """Return the loop of a law in place of a controller's, which reads these outputs of a plant."""
    law, signals = enclosed
    per_effort, waits = controller.command.per_effort, controller.compute_delay_samples
    sampled = sample(controller.see(plant), controller.delay(params), signals, per_effort, law.sample_time_s, waits)
    return Loop(plant=sampled, law=law)
