"""Ms of a scheduled law from above, on whole stretches of its variable."""

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import Compensation
from seaopt.control.loops.compensation.ripple_term import RippleTerm
from seaopt.robustness.bounds.stretch import bound_stretch
from tests.schedules import read_knee, tune_knee


@pytest.mark.parametrize(
    ("which", "low", "high"), [pytest.param(0, 0.0, 0.1, marks=pytest.mark.slow), (1, 0.45, 0.5)]
)  # stand, swing
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


def test_values_of_a_fit_are_bounded_as_the_same_values_without_their_stds():
    schedule, (stand, _, values) = tune_knee(), read_knee()
    fitted = values.with_parameters(replace(values.update(k=655e3)["k"], std=10.0, identified=True))
    known, found = (
        bound_stretch("it", schedule.at(0.05), schedule.table, stand, one.update(phi=0.05), 0.0, 0.1)
        for one in (values.update(k=655e3), fitted)
    )
    assert found.shown and found.ms == known.ms


def test_of_a_plant_without_the_variable_the_law_alone_changes():
    schedule, (stand, _, values) = tune_knee(), read_knee()
    straight = so.Plant(
        name="leg straight", states=stand.states, inputs=stand.inputs, outputs=stand.outputs,
        parameters={name: unit for name, unit in stand.parameters.items() if name != "phi"},
        f=lambda t, x, u, p: {"q": x.v, "v": (p.K_f * u.I - p.b * x.v - p.k * x.q) / p.M},
        h=lambda t, x, u, p: {"tau": p.L_a * p.k * x.q}, actuation=stand.actuation,
    )  # fmt: skip
    bound = bound_stretch("it", schedule.at(0.05), schedule.table, straight, values, 0.0, 0.1)
    found = [schedule.at(s).close(straight, values).figures().ms for s in np.linspace(0.0, 0.1, 5)]
    assert bound.shown and max(found) <= bound.ms <= 1.15 * max(found)


def test_terms_that_feed_back_are_not_bounded():
    """The bound is of the law without them; one whose signal a plant does not have is a constant on it."""
    schedule, (stand, swing, values) = tune_knee(), read_knee()
    term = RippleTerm(cycles=(1,), cos=(0.7,), sin=(0.2,), period=1.0, reads="phi", unit="rad", fraction=1.0)
    added = Compensation(sample_time_s=1e-3, ripple=term)
    middle = replace(schedule.at(0.05), compensation=added)
    assert "phi" in swing.outputs and "phi" not in stand.outputs
    for plant, shown in ((swing, False), (stand, True)):
        bound = bound_stretch("it", middle, schedule.table, plant, values.update(phi=0.05), 0.0, 0.1)
        assert bound.shown == shown and ("not bounded" in bound.reason) != shown


def test_a_law_that_changes_too_much_on_a_stretch_is_not_said_to_be_stable():
    schedule, (stand, _, values) = tune_knee(), read_knee()
    table = schedule.table
    gains = {name: row.copy() for name, row in table.gains.items()}
    gains["k_p"][1] *= 40.0  # far beyond what the delay allows
    wild = replace(table, gains=gains)
    bound = bound_stretch("stand", schedule.at(0.2), wild, stand, values.update(phi=0.2), 0.0, 0.4)
    assert not bound.shown and np.isinf(bound.ms) and "changes by" in bound.reason
