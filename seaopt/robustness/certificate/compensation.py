"""Whether a controller stays stable with its friction compensated from the speed, on every plant and over draws.

The compensation is the controller's, made for the design plant's friction; each plant and draw has its own. The test
takes friction of any steepness up to the plant's own, and none at all, so that compensating more than a draw has of it
is covered.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from seaopt.control import Controller
from seaopt.control.compensation.compensate import ENOUGH, find_compensation_margins
from seaopt.control.loops.compensation.stability import CompensationMargin
from seaopt.formatting import format_values
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.certificate.friction import MARGIN_DRAWS
from seaopt.robustness.uncertainty.draws import Uncertainty
from seaopt.robustness.uncertainty.worst import place_values

FRICTION_COMPENSATION = "friction_compensation"
FROM_REFERENCE = "friction is compensated from the reference, outside the loop: its stability is the law's without it"


@record
class CompensationDraws:
    """For how many draws stability is shown with friction compensated, and the least slope for which it is.

    Parameters
    ----------
    samples, shown : int
        Draws looked at, and those for which it is.
    least_slope : float
        The steepest compensation for which it is shown, of the draw with the least; zero where it is not for one.
    parameters : mapping
        That draw.

    """

    samples: int
    shown: int
    least_slope: float
    parameters: dict[str, float]

    def __str__(self) -> str:
        where = f", the least at {format_values(self.parameters)}" if self.parameters else ""
        return f"over draws, it is shown for {self.shown} of {self.samples}{where}"


def compensates_speed(controller: Controller) -> bool:
    """Tell whether a controller compensates friction from a measured speed, which is a feedback."""
    compensation = controller.compensation
    return compensation is not None and compensation.friction is not None and compensation.friction.source == "speed"


def find_nominal_compensation(
    controller: Controller, models: Mapping[str, Plant], params: ParameterSet
) -> dict[str, CompensationMargin]:
    """Return for how steep a compensation stability is shown, of every plant; empty where none is from the speed."""
    if not compensates_speed(controller):
        return {}
    return {
        name: find_compensation_margins(controller, model, [params], enough=ENOUGH)[0] for name, model in models.items()
    }


def find_compensation_at_draws(
    controller: Controller, models: Mapping[str, Plant], unknown: Uncertainty,
    nominal: Mapping[str, CompensationMargin], samples: int, rng: np.random.Generator,
) -> dict[str, CompensationDraws]:  # fmt: skip
    """Return the same over draws, of the plants for which it is shown at the nominal parameters."""
    enough, count = {name: margin for name, margin in nominal.items() if margin.shown}, min(samples, MARGIN_DRAWS)
    if not enough or not count:
        return {}
    values = unknown.values(unknown.draw(count, rng))
    draws = [{name: float(column[k]) for name, column in values.items()} for k in range(count)]
    found: dict[str, CompensationDraws] = {}
    for name, margin in enough.items():
        placed = [place_values(models[name], unknown.nominal, draw) for draw in draws]
        margins = find_compensation_margins(controller, models[name], placed, first=margin.multiplier)
        least = int(np.argmin([one.slope for one in margins]))
        found[name] = CompensationDraws(
            samples=count, shown=sum(one.shown for one in margins), least_slope=margins[least].slope,
            parameters={key: value for key, value in draws[least].items() if key in placed[least]},
        )  # fmt: skip
    return found


def describe_compensation(
    controller: Controller, margins: Mapping[str, CompensationMargin], draws: Mapping[str, CompensationDraws]
) -> tuple[str, ...]:
    """Return whether stability is shown with what a controller compensates, one sentence for each plant."""
    if controller.compensation is None or controller.compensation.friction is None:
        return ()
    if not compensates_speed(controller):
        return (FROM_REFERENCE,)
    return tuple(
        f"{name}: {margin}" + (f"; {draws[name]}" if name in draws else "") for name, margin in margins.items()
    )


def list_compensation(
    margins: Mapping[str, CompensationMargin], draws: Mapping[str, CompensationDraws]
) -> dict[str, dict[str, Any]]:
    """Return what robustness.json has of them, by plant."""
    return {
        name: asdict(margin) | {"shown": margin.shown, "draws": asdict(draws[name]) if name in draws else None}
        for name, margin in margins.items()
    }
