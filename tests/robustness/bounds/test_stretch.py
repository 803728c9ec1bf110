"""Ms of a scheduled law from above, on whole stretches of its variable."""

from dataclasses import replace

import numpy as np
import pytest

from seaopt.robustness.bounds.stretch import bound_stretch
from tests.schedules import read_knee, tune_knee


@pytest.mark.parametrize(("which", "low", "high"), [(0, 0.0, 0.1), (1, 0.45, 0.5)])  # stand, swing
def test_no_frozen_loop_of_a_stretch_has_more_than_its_bound(which, low, high):
    schedule, values = tune_knee(), read_knee()[2]
    plant = read_knee()[which]
    middle = 0.5 * (low + high)
    bound = bound_stretch("it", schedule.at(middle), schedule.table, plant, values.update(phi=middle), low, high)
    found = [
        schedule.at(s).close(plant, values.update(phi=s)).figures() for s in np.linspace(low, high, 9)
    ]  # fmt: skip
    assert bound.shown and all(one.stable for one in found)
    assert max(one.ms for one in found) <= bound.ms <= 1.15 * max(one.ms for one in found)


def test_a_law_that_changes_too_much_on_a_stretch_is_not_said_to_be_stable():
    schedule, (stand, _, values) = tune_knee(), read_knee()
    table = schedule.table
    gains = {name: row.copy() for name, row in table.gains.items()}
    gains["k_p"][1] *= 40.0  # far beyond what the delay allows
    wild = replace(table, gains=gains)
    bound = bound_stretch("stand", schedule.at(0.2), wild, stand, values.update(phi=0.2), 0.0, 0.4)
    assert not bound.shown and np.isinf(bound.ms) and "changes by" in bound.reason
