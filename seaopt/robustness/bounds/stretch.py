r"""Ms of a scheduled law from above, on a whole stretch of its variable: the plant enclosed, the law's change added.

On a stretch with the middle :math:`\bar s` the loop of the middle's law, :math:`\bar C`, is bounded by branch and bound
for every plant of the stretch: it is stable there, with :math:`|S| \le M_S` and :math:`|T| \le M_T`
(`seaopt.robustness.bounds.bracket`). The law itself changes by no more than :math:`|C_s/\bar C - 1| \le \epsilon` at
any frequency (`GainTable.bound_change`), and

.. math::
    1 + P_s C_s = (1 + P_s \bar C)\Big(1 + T\,\frac{C_s - \bar C}{\bar C}\Big), \qquad
    |S_s| \le \frac{M_S}{1 - \epsilon M_T} \quad \text{where } \epsilon M_T < 1 .

On the way from :math:`\bar C` to :math:`C_s` nothing crosses -1, and the poles of the law on or outside the unit circle
stay, so that every frozen loop of the stretch is stable. :math:`\epsilon` is the largest of a curve without resonances
on `ANGLES` frequencies, with a thousandth added.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from seaopt.codec import OrInfinite
from seaopt.control import Controller, GainTable
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.bounds.bracket import Budget, bracket
from seaopt.robustness.uncertainty.draws import combine_uncertainty

ANGLES = 4000
LOWEST = 1e-9  # of the sample rate: from here
ROUNDING = 1.001
BUDGET = Budget(tolerance=0.02, boxes=400, seconds=20.0)


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
    change : float
        By which share of itself the law differs from that of the middle, at most.
    reason : str
        Why nothing is shown; empty where it is.
    """

    plant: str
    low: float
    high: float
    ms: OrInfinite
    change: OrInfinite
    reason: str

    @property
    def shown(self) -> bool:
        """Whether every loop of the stretch is shown to be stable."""
        return not self.reason


def bound_stretch(
    name: str, middle: Controller, table: GainTable, plant: Plant, params: ParameterSet, low: float, high: float
) -> StretchBound:
    """Bound Ms of a schedule on a stretch between points, `middle` at its middle, on a plant without friction."""
    terms = middle.compensation
    if terms is not None and any(name in plant.outputs for name in terms.reads):
        reason = "what a compensation feeds back of gravity, ripple or speed is not bounded"
        return StretchBound(plant=name, low=low, high=high, ms=np.inf, change=np.inf, reason=reason)
    frequencies = np.geomspace(LOWEST, 0.5, ANGLES) / table.sample_time_s
    change = ROUNDING * float(np.max(table.bound_change(low, high, frequencies)))
    if np.isinf(change):
        reason = "how far a law with other parts than a pid and a prefilter changes between two values is not bounded"
        return StretchBound(plant=name, low=low, high=high, ms=np.inf, change=np.inf, reason=reason)
    moves = table.over in plant.parameters or table.over in plant.states
    ranges = {table.over: (low, high)} if moves else {}  # of a plant without the variable the law alone changes
    values = ParameterSet(replace(each, std=None) for each in params.values())  # of a fit its values alone count here
    unknown = combine_uncertainty(values, ParameterSet(), ranges, {name: plant})
    bounded = bracket(middle, plant, replace(unknown, names=(), covariance=np.zeros((0, 0))), budget=BUDGET)
    reason = ""
    if not bounded.bounded_stable:
        reason = bounded.left_out or f"no bound in {bounded.boxes} boxes"
    elif not change * bounded.mt_upper < 1.0:
        reason = f"the law changes by {100 * change:.3g} % on the stretch, with Mt up to {bounded.mt_upper:.3g}"
    ms = np.inf if reason else bounded.ms_upper / (1.0 - change * bounded.mt_upper)
    return StretchBound(plant=name, low=low, high=high, ms=float(ms), change=change, reason=reason)
