"""Ms of a scheduled law from above, on whole stretches of its variable."""

import math
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import CompensateGravity, Compensation, ScheduledController, compensate_schedule, tune_schedule
from seaopt.control.loops.compensation.ripple_term import RippleTerm
from seaopt.control.running.fed_back import LaterTerms, close_whole, split_states
from seaopt.robustness.bounds import stretch
from seaopt.robustness.bounds.stretch import bound_stretch
from tests.control.tuning.test_outer_loop import (
    ASKED,
    HELD,
    KNEE,
    OF_KNEE,
    VALUES,
    close_by_hand,
    give_outer,
    move_knee,
)
from tests.hand_loops import find_peaks
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
    assert max(one.ms for one in found) <= bound.ms <= 1.03 * max(one.ms for one in found)


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
    assert bound.shown and max(found) <= bound.ms <= 1.03 * max(found)


def test_with_its_outer_loop_no_loop_has_more_than_its_bound():
    """Ms by hand; of the force loop alone the bound is another."""
    points, spec = [250.0, 350.0], replace(OF_KNEE, structure="pid_dob", max_noise_gain=60.0)
    options = {"outer": lambda one: give_outer(ASKED, one.controllers[0]).outer}
    schedule = tune_schedule(HELD, VALUES, spec, "k_s", points, {"knee": KNEE}, **options)
    middle = replace(schedule.controllers[0], law=schedule.table.law(300.0))
    (moved,) = split_states(middle, {"knee": KNEE}, VALUES).values()
    found = []
    for stiffness in np.linspace(*points, 9):
        v = {name: VALUES[name].value for name in VALUES} | {"k_s": float(stiffness)}
        law = schedule.table.law(float(stiffness))
        hand = close_by_hand(law, move_knee(v), middle.signals, middle.command.per_effort, ASKED, 1.0)
        found.extend(find_peaks(hand, lambda s: s))
    bound = bound_stretch("knee", middle, schedule.table, moved, VALUES.update(k_s=300.0), *points)
    alone = bound_stretch("knee", replace(middle, outer=None), schedule.table, KNEE, VALUES.update(k_s=300.0), *points)
    assert bound.shown and max(found) <= bound.ms * (1 + 1e-6) and bound.ms <= 1.03 * max(found)
    assert abs(alone.ms - bound.ms) > 1e-4


@pytest.mark.parametrize("fraction", [0.6, 1.0])
def test_a_weight_whose_load_it_is_scheduled_over_is_compensated_on_the_way(fraction):
    """Its coefficients are lines over the load; the link carries what is left of its weight."""
    values, points = VALUES.update(m=1.0, L=0.2, d_l=0.5), (0.5, 3.0)
    law = so.tune(HELD, values, replace(OF_KNEE, max_noise_gain=60.0))
    options = {"over": "m", "unit": "kg", "points": points, "controllers": (law, law), "others": {}, "fallback": 0.5}
    plain = ScheduledController(**options)
    schedule = compensate_schedule(plain, gravity=CompensateGravity(fraction=fraction), link=(KNEE, values))
    first, last = (schedule.terms_at(point) for point in points)
    assert first != last
    later = LaterTerms(terms=last, over="m", low=points[0], high=points[1])
    middle = replace(schedule.controllers[0], law=schedule.table.law(1.0), compensation=first)
    (moved,) = split_states(middle, {"knee": KNEE}, values, later=later).values()
    bound = bound_stretch("knee", middle, schedule.table, moved, values.update(m=1.0), *points)
    found = []
    for load in np.linspace(*points, 9):
        frozen = replace(law, compensation=schedule.terms_at(float(load)))
        (shown,) = split_states(frozen, {"knee": KNEE}, values).values()
        found.append(close_whole(frozen, shown, values.update(m=float(load))).figures())
    assert bound.shown and all(one.stable for one in found)
    assert max(one.ms for one in found) <= bound.ms <= 1.03 * max(one.ms for one in found)


def test_a_ripple_that_is_compensated_is_left_out_as_at_the_points():
    schedule, (_, swing, values) = tune_knee(), read_knee()
    term = RippleTerm(cycles=(1,), cos=(0.7,), sin=(0.2,), period=1.0, reads="phi", unit="rad", fraction=1.0)
    middle = replace(schedule.at(0.05), compensation=Compensation(sample_time_s=1e-3, ripple=term))
    bounds = [
        bound_stretch("it", one, schedule.table, swing, values.update(phi=0.05), 0.0, 0.1)
        for one in (middle, schedule.at(0.05))
    ]
    assert bounds[0].shown and bounds[0] == bounds[1]


def test_a_loop_that_is_unstable_on_a_stretch_is_named_with_its_value():
    schedule, (stand, _, values) = tune_knee(), read_knee()
    table = schedule.table
    gains = {name: row.copy() for name, row in table.gains.items()}
    gains["k_p"][1] *= 40.0  # far beyond what the delay allows
    wild = replace(table, gains=gains)
    bound = bound_stretch("stand", schedule.at(0.2), wild, stand, values.update(phi=0.2), 0.0, 0.4)
    assert not bound.shown and math.isinf(bound.ms) and bound.broken == "the loop is unstable"
    assert bound.reason == f"at phi = {bound.broken_at:.6g} the loop is unstable" and 0.0 < bound.broken_at <= 0.4
    frozen = replace(schedule.at(0.2), law=wild.law(bound.broken_at))
    assert not frozen.close(stand, values.update(phi=bound.broken_at)).figures().stable


def test_a_loop_beyond_the_limit_on_ms_is_named_with_its_value():
    """The proof that it is stable stands."""
    schedule, (stand, _, values) = tune_knee(), read_knee()
    least = min(schedule.at(s).close(stand, values.update(phi=s)).figures().ms for s in (0.0, 0.05, 0.1))
    strict = replace(schedule.at(0.05), spec=replace(schedule.spec, max_sensitivity=least - 0.01))
    bound = bound_stretch("stand", strict, schedule.table, stand, values.update(phi=0.05), 0.0, 0.1)
    found = schedule.at(bound.broken_at).close(stand, values.update(phi=bound.broken_at)).figures()
    assert bound.shown and bound.broken.startswith(f"Ms is {found.ms:.5g}, above {least - 0.01:g}")


def test_a_pole_that_comes_out_of_one_as_a_gain_starts_refutes_nothing(monkeypatch):
    """An integral that is zero at the first point: beside it the pole is within rounding of 1, and nothing grows."""
    monkeypatch.setattr(stretch, "BUDGET", replace(stretch.BUDGET, boxes=130))
    plant, values, points = so.plants.high_impedance(), so.plants.thor(), [2e5, 3e6]
    spec = so.ControllerSpec(bandwidth_hz=25, structure="pid_dob", max_sensitivity=1.8, max_noise_gain=60)
    schedule = tune_schedule(plant, values, spec, "k", points)
    bound = bound_stretch("it", schedule.at(1.6e6), schedule.table, plant, values.update(k=1.6e6), *points)
    beside = schedule.at(points[0] + 0.5).close(plant, values.update(k=points[0] + 0.5))
    assert 1.0 - 1e-11 < np.max(np.abs(beside.eigenvalues())) < 1.0
    assert not bound.shown and "1 to rounding" in bound.reason and "boxes, with which the search ends" in bound.reason
    assert "unstable" not in bound.broken
