"""How steep a friction stability is shown for, at nominal parameters and over draws, for the certificate.

At the nominal parameters every multiplier is tried. Over draws the one that served there is tried first, and the others
only where it shows too little: a margin of a draw is then a lower bound of what could be shown.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from seaopt.control import Controller
from seaopt.control.laws.friction_margin import find_friction_margin, find_friction_margins
from seaopt.control.loops.absolute_stability import FrictionMargin
from seaopt.formatting import format_values
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import has_friction
from seaopt.records import record
from seaopt.robustness.uncertainty.draws import Uncertainty
from seaopt.robustness.uncertainty.worst import place_values

MARGIN_DRAWS = 100  # at most so many are looked at


@record
class FrictionDraws:
    """For how many draws stability is shown for every friction curve of their sector, and the least margin.

    A draw without friction counts.

    Parameters
    ----------
    samples, shown : int
        Draws looked at, and those for which it is.
    least_slope : float
        The steepest friction for which it is, N s/m (N m s/rad), of the draw with the least; zero where it is not for
        one, infinite where none is bounded.
    factor : float
        That slope over the draw's own; zero where nothing is shown.
    parameters : mapping
        That draw: the first for which nothing is shown, if there is one.

    """

    samples: int
    shown: int
    least_slope: float
    factor: float
    parameters: dict[str, float]

    def __str__(self) -> str:
        head = f"over draws, it is shown for {self.shown} of {self.samples}"
        where = f" at {format_values(self.parameters)}" if self.parameters else ""
        if not self.least_slope:
            return f"{head}; the first for which it is not is{where or ' the plant as it is'}"
        if np.isinf(self.least_slope):
            return f"{head}, however steep"
        return f"{head}, the least up to {self.factor:.3g} times its own{where}"


def find_nominal_margins(
    controller: Controller, models: Mapping[str, Plant], params: ParameterSet
) -> dict[str, FrictionMargin]:
    """Return the friction margin of every plant that has friction."""
    margins = {name: find_friction_margin(controller, model, params) for name, model in models.items()}
    return {name: margin for name, margin in margins.items() if margin is not None}


def find_margins_at_draws(
    controller: Controller, models: Mapping[str, Plant], unknown: Uncertainty, nominal: Mapping[str, FrictionMargin],
    samples: int, rng: np.random.Generator, required: float | None = None,
) -> dict[str, FrictionDraws]:  # fmt: skip
    """Return margins at draws, of plants for which stability, or the slope required, is shown at nominal parameters.

    Those that have friction at draws alone are among them.
    """
    count, varied = min(samples, MARGIN_DRAWS), [row.name for row in unknown.varied()]
    enough = {
        name: nominal.get(name) for name, model in models.items()
        if has_friction(model, unknown.nominal, varied) and _shows_enough(nominal.get(name), required)
    }  # fmt: skip
    if not count or not enough:
        return {}
    draws = unknown.list_draws(count, rng)
    return {
        name: _count_shown(controller, models[name], unknown.nominal, draws, margin) for name, margin in enough.items()
    }


def _shows_enough(margin: FrictionMargin | None, required: float | None) -> bool:
    """Tell whether the nominal parameters leave something to look for at draws; without friction there they do."""
    return margin is None or margin.shown or (required is not None and margin.least_slope >= required)


def _count_shown(
    controller: Controller, plant: Plant, nominal: ParameterSet, draws: list[dict[str, float]],
    known: FrictionMargin | None,
) -> FrictionDraws:  # fmt: skip
    """Return for how many draws of one plant stability is shown, and the least margin."""
    placed = [place_values(plant, nominal, draw) for draw in draws]
    keys = [tuple((name, each[name].value) for name in each) for each in placed]
    distinct = dict(zip(keys, placed, strict=True))  # draws that vary what this plant does not have are one loop
    first, least = ("", 0.0) if known is None else (known.multiplier, 1.0 if known.shown else 0.0)
    found = find_friction_margins(controller, plant, list(distinct.values()), first, least)
    margins = dict(zip(distinct, found, strict=True))
    shown, slope, factor, place = 0, np.inf, np.inf, 0
    for k, key in enumerate(keys):
        margin = margins[key]
        shown += margin is None or margin.shown  # without friction there is nothing to show
        if margin is not None and margin.least_slope < slope:
            slope, factor, place = margin.least_slope, margin.factor, k
    used = {name: value for name, value in draws[place].items() if name in placed[place]}
    return FrictionDraws(samples=len(draws), shown=shown, least_slope=slope, factor=factor, parameters=used)
