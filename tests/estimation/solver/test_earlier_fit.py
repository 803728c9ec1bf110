"""A fit of more logs goes on from an earlier one: to the same minimum, in fewer evaluations."""

from __future__ import annotations

from dataclasses import replace

import pytest

import seaopt as so
from seaopt.estimation.problem.fit_problem import count_evaluations
from tests.actuator_logs import KNEE, SCREW, drive, knee, screw

RATE_HZ = 400.0


def pose_screw(seed):
    t, current = drive(4.0, 1000.0, 3.0, seed=seed, top_hz=150.0)
    columns = {name: values for name, values in screw(current, 1000.0, seed=seed).items() if name in ("I", "F1", "F2")}
    params = so.plants.thor().update(**SCREW).update(J=2e-6, b_r=2.5e-4).free("J", "b_r")
    log = so.Log.from_arrays(time=t, **columns)
    return so.Experiment(plant=so.plants.high_impedance(), log=log, outputs=("F1", "F2"), name=f"log{seed}"), params


def pose_knee(seed, *, sticks=False, late=3):
    t, current = drive(5.0, RATE_HZ, 4.0, seed=seed, top_hz=30.0)
    columns = knee(current, RATE_HZ, locked=True, seed=seed, f_c=0.02, v_s=0.5 if sticks else 5.0)
    channels = {name: columns[name][late:] for name in ("tau_s", "theta_m")}
    log = so.Log.from_arrays(time=t[late:], I=current[:-late], **channels)
    plant = so.plants.rotary(link="locked")
    plant = so.plants.let_stick(plant) if sticks else plant
    known = {name: value for name, value in {**KNEE, "c_s": 0.0, "v_s": 5.0}.items() if name in plant.parameters}
    params = plant.defaults.update(**known).update(J_m=5e-5, b_r=3e-4, k_s=150.0, f_c=0.01)
    delay = so.Parameter(name="delay", value=1e-3, unit="s", min=0.0, max=0.02, free=True)
    name = f"log{seed}"
    bench = so.Experiment(plant=plant, log=log, outputs=("tau_s", "theta_m"), delay_s=delay, name=name)
    return bench, params.free("J_m", "b_r", "k_s", "f_c")


def fit_counted(experiments, params, **options):
    before = count_evaluations()
    fit = so.fit(experiments, params, diagnostics=False, **options)
    return fit, count_evaluations() - before


@pytest.mark.parametrize(
    ("pose", "share"),
    [(pose_screw, 0.5), (pose_knee, 0.5), (lambda seed: pose_knee(seed, sticks=True), 0.5)],
    ids=["screw", "knee", "sticking knee"],
)
def test_more_logs_go_on_from_the_earlier_minimum(pose, share):
    (first, params), (second, _) = pose(1), pose(2)
    earlier = so.fit([first], params, diagnostics=False)
    afresh, many = fit_counted([first, second], params)
    # As from its file: the minimum in memory is not asked for.
    going_on, few = fit_counted([first, second], params, start=so.Fit.from_dict(earlier.to_dict()))
    assert going_on.status == afresh.status == "converged"
    assert few <= share * many
    for name in afresh.covariance.names:
        there, here = afresh.parameters[name], going_on.parameters[name]
        assert abs(here.value - there.value) < 0.05 * there.std, name
        assert here.std == pytest.approx(there.std, rel=0.01)


def test_a_prior_stays_where_it_is():
    """Only the search begins elsewhere: a prior's centre is the given value."""
    (first, params), (second, _) = pose_screw(1), pose_screw(2)
    params = params.with_parameters(so.Parameter(name="J", value=2e-6, unit="kg m^2", prior_std=1e-10, free=True))
    earlier = so.fit([first], params, diagnostics=False)
    afresh = so.fit([first, second], params, diagnostics=False)
    going_on = so.fit([first, second], params, start=earlier, diagnostics=False)
    assert afresh.parameters["J"].value < 0.98 * SCREW["J"]
    assert abs(going_on.parameters["J"].value - afresh.parameters["J"].value) < 0.05 * afresh.parameters["J"].std


def test_an_earlier_fit_that_explains_little_is_left():
    """Its values are those of another actuator, whose friction holds it: a start is looked for."""
    first, params = pose_knee(1, sticks=True)
    afresh = so.fit([first], params, diagnostics=False)
    wrong = replace(afresh, parameters=afresh.parameters.update(J_m=2e-3, k_s=2.0, f_c=0.5), minimum=None)
    again = so.fit([first], params, start=wrong, diagnostics=False)
    assert again.status == afresh.status == "converged"
    for name in afresh.covariance.names:
        assert again.parameters[name].value == pytest.approx(afresh.parameters[name].value, rel=1e-3)
