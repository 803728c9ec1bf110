r"""Ms of a scheduled law from above, on a whole stretch of its variable between two points of its table.

Where the plant has the variable, law and plant change together over one coordinate; where it has not, the law alone
does. Both are enclosed over boxes of it (`seaopt.robustness.bounds.scheduled_law`), and branch and bound shows that
every frozen loop of the stretch is stable, and what no Ms exceeds (`seaopt.robustness.bounds.bracket`): with all parts
of the law, its outer loop, and what its terms feed back.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from seaopt.codec import OrInfinite
from seaopt.control import Controller, GainTable
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.plants.memo import memo
from seaopt.records import record
from seaopt.robustness.bounds.bracket import Budget, bracket
from seaopt.robustness.bounds.scheduled_law import ScheduledLaw
from seaopt.robustness.uncertainty.draws import combine_uncertainty

BUDGET = Budget(tolerance=0.02, boxes=400, seconds=20.0)
PLACE = "schedule_place"  # a parameter, of a plant without the variable


@record
class StretchBound:
    """A bound on Ms for every value of the variable on a stretch, at the nominal values of all else.

    Parameters
    ----------
    plant : str
        Its name.
    low, high : float
        Ends of the stretch.
    ms : float
        No Ms is larger; infinite where nothing is shown.
    reason : str
        Why nothing is shown; empty where it is.
    """

    plant: str
    low: float
    high: float
    ms: OrInfinite
    reason: str

    @property
    def shown(self) -> bool:
        """Whether every loop of the stretch is shown to be stable."""
        return not self.reason


@memo
def place_plant(plant: Plant, over: str, unit: str) -> Plant:
    """Return a plant that has a schedule's variable, or a parameter in its place that nothing depends on."""
    if {over, PLACE} & {*plant.parameters, *plant.states}:
        return plant
    return replace(plant, parameters={**plant.parameters, PLACE: Parameter(name=PLACE, value=0.0, unit=unit)})


def bound_stretch(
    name: str, middle: Controller, table: GainTable, plant: Plant, params: ParameterSet, low: float, high: float
) -> StretchBound:
    """Bound Ms of a schedule on a stretch between points, `middle` at its middle with terms and outer loop, on a plant
    of `split_states`.
    """
    values = ParameterSet(replace(each, std=None) for each in params.values())  # of a fit its values alone count here
    plant = place_plant(plant, table.over, table.unit)
    place = PLACE if PLACE in plant.parameters else table.over
    law = ScheduledLaw.of(table, low, high, middle, plant, place)
    unknown = combine_uncertainty(values, ParameterSet(), {place: (low, high)}, {name: plant})
    unknown = replace(unknown, names=(), covariance=np.zeros((0, 0)))
    bounded = bracket(middle, plant, unknown, budget=BUDGET, scheduled=law)
    reason = "" if bounded.bounded_stable else bounded.left_out or f"no bound in {bounded.boxes} boxes"
    return StretchBound(plant=name, low=low, high=high, ms=np.inf if reason else bounded.ms_upper, reason=reason)
