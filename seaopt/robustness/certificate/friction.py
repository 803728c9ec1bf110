"""How steep a friction stability is shown for, at nominal parameters and over draws, for the certificate.

At the nominal parameters every multiplier is tried. Over draws the one that served there is tried first, and the others
only where it proves too little: a margin of a draw is then a lower bound of what could be proved.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from seaopt.control import Controller
from seaopt.control.laws.friction_proof import prove_friction, prove_friction_sets
from seaopt.control.loops.absolute_stability import FrictionMargin
from seaopt.formatting import format_values
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import has_friction
from seaopt.records import record
from seaopt.robustness.uncertainty.draws import Uncertainty
from seaopt.robustness.uncertainty.worst import place_values

PROVED_DRAWS = 100  # at most so many are looked at


@record
class FrictionDraws:
    """For how many draws stability is proved for every friction curve of their sector, and the least margin.

    A draw without friction counts as proved.

    Parameters
    ----------
    samples, proved : int
        Draws looked at, and those with a proof.
    least_slope : float
        The steepest friction that is proved, N s/m (N m s/rad), of the draw with the least; zero where one has no
        proof, infinite where none is bounded.
    factor : float
        That slope over the draw's own; zero where there is no proof.
    parameters : mapping
        That draw: the first without a proof, if there is one.

    """

    samples: int
    proved: int
    least_slope: float
    factor: float
    parameters: dict[str, float]

    def __str__(self) -> str:
        head = f"over draws, it is shown for {self.proved} of {self.samples}"
        where = f"at {format_values(self.parameters)}"
        if not self.least_slope:
            return f"{head}; the first for which it is not is {where}"
        if np.isinf(self.least_slope):
            return f"{head}, however steep"
        return f"{head}, the least up to {self.factor:.3g} times its own {where}"


def prove_frictions(
    controller: Controller, models: Mapping[str, Plant], params: ParameterSet
) -> dict[str, FrictionMargin]:
    """Return the friction margin of every plant that has friction."""
    margins = {name: prove_friction(controller, model, params) for name, model in models.items()}
    return {name: margin for name, margin in margins.items() if margin is not None}


def prove_friction_draws(
    controller: Controller, models: Mapping[str, Plant], unknown: Uncertainty, nominal: Mapping[str, FrictionMargin],
    samples: int, rng: np.random.Generator, required: float | None = None,
) -> dict[str, FrictionDraws]:  # fmt: skip
    """Prove stability at draws, of the plants with a proof, or the slope required, at the nominal parameters.

    Those that have friction at draws alone are among them.
    """
    count, varied = min(samples, PROVED_DRAWS), [row.name for row in unknown.varied()]
    enough = {
        name: nominal.get(name) for name, model in models.items()
        if has_friction(model, unknown.nominal, varied) and _shows_enough(nominal.get(name), required)
    }  # fmt: skip
    if not count or not enough:
        return {}
    values = unknown.values(unknown.draw(count, rng))
    draws = [{name: float(column[k]) for name, column in values.items()} for k in range(count)]
    return {
        name: _prove_draws(controller, models[name], unknown.nominal, draws, margin) for name, margin in enough.items()
    }


def _shows_enough(margin: FrictionMargin | None, required: float | None) -> bool:
    """Tell whether the nominal parameters leave something to look for at draws; without friction there they do."""
    return margin is None or margin.proved or (required is not None and margin.least_slope >= required)


def _prove_draws(
    controller: Controller, plant: Plant, nominal: ParameterSet, draws: list[dict[str, float]],
    known: FrictionMargin | None,
) -> FrictionDraws:  # fmt: skip
    """Return how many draws of one plant have a proof, and the least margin."""
    placed = [place_values(plant, nominal, draw) for draw in draws]
    keys = [tuple((name, each[name].value) for name in each) for each in placed]
    distinct = dict(zip(keys, placed, strict=True))  # draws that vary what this plant does not have are one loop
    first, least = ("", 0.0) if known is None else (known.multiplier, 1.0 if known.proved else 0.0)
    found = prove_friction_sets(controller, plant, list(distinct.values()), first, least)
    margins = dict(zip(distinct, found, strict=True))
    proved, slope, factor, place = 0, np.inf, np.inf, 0
    for k, key in enumerate(keys):
        margin = margins[key]
        proved += margin is None or margin.proved  # without friction there is nothing to prove
        if margin is not None and margin.least_slope < slope:
            slope, factor, place = margin.least_slope, margin.factor, k
    used = {name: value for name, value in draws[place].items() if name in placed[place]}
    return FrictionDraws(samples=len(draws), proved=proved, least_slope=slope, factor=factor, parameters=used)
