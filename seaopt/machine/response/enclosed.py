"""A law and the outer loop around it as one law, which reads the link's position, too, on the plant of that link.

What the outer loop is given is known without error, which the force law's own reference is not: that has the readings
of the position in it. From there on the loop is one as any other, broken at the command.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from seaopt.control import Controller
from seaopt.control.laws.outer_run import enclose
from seaopt.control.loops.moved_link import find_position, keep_share, show_position
from seaopt.errors import LogError
from seaopt.machine.ticks import Ticks
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant


def enclose_outer(controller: Controller, link: tuple[Plant, ParameterSet]) -> Controller:
    """Return a controller whose law has the outer loop in it, on the plant whose link that moves, with the figures of
    that loop: nothing is asked of how it tracks a force. Raises LogError: the plant has no such position.
    """
    outer, (plant, values) = controller.outer, link
    assert outer is not None
    shown = show_position(plant, outer, controller.signals)
    if find_position(shown, outer) is None:
        raise LogError(f"link: {plant.name} has no output {outer.position}; give the plant that the outer loop is of")
    enclosed = enclose(controller, shown, of_force=True)
    return replace(enclosed, design=(shown, values), achieved=enclosed.close(shown, values).figures())


def enclose_ticks(enclosed: Controller, ticks: Ticks) -> Ticks:
    """Return the ticks of a force law as those of its law with the outer loop in it."""
    from scipy.signal import lfilter  # deferred: 0.3 s

    read = enclosed.signals if len(enclosed.signals) == ticks.measured.shape[1] else enclosed.signals[:-1]
    kept = keep_share(enclosed.signals[-1])
    if kept < 1.0 and ticks.given is not None:  # a link that nothing holds, whose place drifts
        given, position = ticks.given.T
        moved = np.asarray(lfilter([1.0, -1.0], [1.0, -kept], position - position[0]))
        ticks = replace(ticks, given=np.column_stack([given, moved]))
    return take_given(ticks, enclosed.signals[-1], read)


def take_given(ticks: Ticks, position: str, signals: Sequence[str]) -> Ticks:
    """Return ticks with what the outer loop was given as their reference, and its position among the readings, which
    are those of the force law's signals.
    """
    assert ticks.given is not None
    given, moved = ticks.given.T
    measured = ticks.measured if position in signals else np.column_stack([ticks.measured, moved])
    beside = {name: part for name, part in ticks.beside.items() if name not in (*signals, position)}
    return replace(ticks, reference=given, measured=measured, beside=beside, rendered=None, given=None)
