"""How steep a friction stability is shown for, at nominal parameters and over draws, for the certificate.

At the nominal parameters every multiplier is tried. Over draws the one that served there is tried first, and the others
only where it shows too little: a margin of a draw is then a lower bound of what could be shown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from functools import partial

import numpy as np

from seaopt.codec import OrInfinite
from seaopt.control import Controller
from seaopt.control.laws.friction_margin import find_friction_margin, find_friction_margins
from seaopt.control.loops.absolute_stability import FrictionMargin
from seaopt.executors import Shared
from seaopt.formatting import format_values
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import has_friction
from seaopt.records import record
from seaopt.robustness.certificate.measured_draws import Draw, Loops, judge_draws, select_own
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
    least_slope: OrInfinite
    factor: OrInfinite
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
    loops: Shared[Loops],
    nominal: Mapping[str, FrictionMargin],
    samples: int,
    rng: np.random.Generator,
    required: float | None = None,
    executor: Executor | None = None,
) -> dict[str, FrictionDraws]:
    """Return margins at draws, of plants for which stability, or the slope required, is shown at nominal parameters.

    Those that have friction at draws alone are among them.
    """
    unknown, count = loops.value.unknown, min(samples, MARGIN_DRAWS)
    varied = [row.name for row in unknown.varied()]
    enough = {
        name: nominal.get(name)
        for name, model in loops.value.models.items()
        if has_friction(model, unknown.nominal, varied) and _shows_enough(nominal.get(name), required)
    }
    if not count or not enough:
        return {}
    draws = unknown.list_draws(count, rng)
    return {name: _count_shown(loops, name, draws, margin, executor) for name, margin in enough.items()}


def _shows_enough(margin: FrictionMargin | None, required: float | None) -> bool:
    """Tell whether the nominal parameters leave something to look for at draws; without friction there they do."""
    return margin is None or margin.shown or (required is not None and margin.least_slope >= required)


def _count_shown(
    loops: Shared[Loops], name: str, draws: Sequence[Draw], known: FrictionMargin | None, executor: Executor | None
) -> FrictionDraws:
    """Return for how many draws of one plant stability is shown, and the least margin."""
    own = select_own(loops, name, draws)
    distinct = {tuple(draw.items()): draw for draw in own}  # draws that vary what this plant does not have are one loop
    found = judge_draws(partial(_find_margins, known), loops, name, list(distinct.values()), executor)
    margins = dict(zip(distinct, found, strict=True))
    shown, slope, factor, place = 0, np.inf, np.inf, 0
    for k, draw in enumerate(own):
        margin = margins[tuple(draw.items())]
        shown += margin is None or margin.shown  # without friction there is nothing to show
        if margin is not None and margin.least_slope < slope:
            slope, factor, place = margin.least_slope, margin.factor, k
    return FrictionDraws(samples=len(draws), shown=shown, least_slope=slope, factor=factor, parameters=own[place])


def _find_margins(
    known: FrictionMargin | None, loops: Shared[Loops], name: str, draws: Sequence[Draw]
) -> list[FrictionMargin | None]:
    """Return the margins of one plant at draws, the multiplier that served at the nominal parameters tried first."""
    first, least = ("", 0.0) if known is None else (known.multiplier, 1.0 if known.shown else 0.0)
    plant, nominal = loops.value.models[name], loops.value.unknown.nominal
    placed = [place_values(plant, nominal, draw) for draw in draws]
    return find_friction_margins(loops.value.controller, plant, placed, first, least)
