"""A controller's outer loop and the force law behind it as one linear law, and the loop that both close."""

from __future__ import annotations

from dataclasses import replace

from seaopt.control.laws.controller import Controller
from seaopt.control.loops.loop import Loop
from seaopt.control.loops.moved_link import enclose_law, find_position, keep_share, show_position
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant


def enclose(controller: Controller, plant: Plant, *, of_force: bool = False) -> Controller:
    """Return a controller whose law has its outer loop in it, on a plant whose link moves; else the controller itself.
    `of_force` is of `enclose_law`.
    """
    signals, outer = controller.signals, controller.outer
    position = None if outer is None else find_position(plant, outer)
    if outer is None or position is None:
        return controller
    signals = signals if position in signals else (*signals, position)
    signal = signals.index(position) if position in controller.signals else None
    law = enclose_law(controller.law, outer, signal, kept=keep_share(position), of_force=of_force)
    return replace(controller, law=law, reads=signals, outer=None)


def close_outer(controller: Controller, plant: Plant, params: ParameterSet) -> Loop:
    """Return the loop of a controller around a plant, with its outer loop where the link moves. Its reference is the
    force law's.
    """
    if controller.outer is not None:
        plant = show_position(plant, controller.outer, controller.signals)
    return enclose(controller, plant, of_force=True).close(plant, params)
