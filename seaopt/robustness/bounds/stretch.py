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
from seaopt.robustness.uncertainty.batch import batch_figures
from seaopt.robustness.uncertainty.draws import Column, combine_uncertainty
from seaopt.robustness.uncertainty.severity import find_failures, limits

BUDGET = Budget(tolerance=0.02, boxes=400)
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
    broken_at : float, optional
        A value whose loop was measured to be unstable, or beyond the limit on Ms or Mt.
    broken : str
        What it breaks; empty where none was found.
    """

    plant: str
    low: float
    high: float
    ms: OrInfinite
    reason: str
    broken_at: float | None = None
    broken: str = ""

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
    variable = PLACE if PLACE in plant.parameters else table.over
    law = ScheduledLaw.of(table, low, high, middle, plant, variable)
    unknown = combine_uncertainty(values, ParameterSet(), {variable: (low, high)}, {name: plant})
    unknown = replace(unknown, names=(), covariance=np.zeros((0, 0)))
    bounded = bracket(middle, plant, unknown, budget=BUDGET, scheduled=law)
    worst = {name: np.array([value]) for name, value in bounded.parameters.items()}
    broken, reason = _name_broken(law, unknown.nominal, worst) if worst else "", ""
    if not bounded.bounded_stable and not np.isfinite(bounded.ms_lower):
        reason = f"at {table.over} = {bounded.parameters[variable]:.6g} {broken}"
    elif not bounded.bounded_stable:
        ended = ", with which the search ends" * (bounded.boxes >= BUDGET.boxes)
        reason = ", ".join(filter(None, (f"no bound in {bounded.boxes} boxes{ended}", bounded.left_out)))
    return StretchBound(
        plant=name,
        low=low,
        high=high,
        ms=np.inf if reason else bounded.ms_upper,
        reason=reason,
        broken_at=bounded.parameters[variable] if broken else None,
        broken=broken,
    )


def _name_broken(law: ScheduledLaw, nominal: ParameterSet, values: dict[str, Column]) -> str:
    """Return what the loop that stands at values breaks; empty where it keeps its limits."""
    controller = law.at(float(values[law.coordinate][0]))
    figures = batch_figures(controller, law.plant, nominal, values)
    unstable, ms, mt = find_failures(controller, figures)[:, 0]
    if unstable:
        return "the loop is unstable"
    ms_limit, mt_limit = limits(controller)
    texts = [f"Ms is {figures.ms[0]:.5g}, above {ms_limit:g}" * bool(ms)]
    texts += [f"Mt is {figures.mt[0]:.5g}, above {mt_limit:g}" * bool(mt)]
    return " and ".join(filter(None, texts))
