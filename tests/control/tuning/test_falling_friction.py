"""Friction that falls with speed: laws for plants that grow as they slide, by eigenvalues and simulated stick-slip."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.errors import FileError
from seaopt.files import to_json
from seaopt.plants.friction import falls
from tests.laws import measurement_matrices
from tests.stick_slip import Mass, simulate

VALUES = {
    "k": 120e3, "m_l": 0.9, "l": 0.005, "N_p": 1.0, "K_tau": 0.075, "J": 1.2e-5, "b_r": 2.5e-4, "eta": 0.86,
    "f_c": 25.0, "v_s": 0.004,
}  # fmt: skip
SPEC = so.ControllerSpec(
    bandwidth_hz=20, compute_delay_samples=2, max_sensitivity=1.6, max_noise_gain=25, current_limit_A=10.0
)  # fmt: skip
NEAR = replace(SPEC, bandwidth_range_hz=(19.0, 21.0))  # few bandwidths to look at besides
STRIBECK_SLOPE = np.sqrt(2.0 / np.e)  # of (f_s - f_c)/v_st: the steepest fall of exp(-(v/v_st)^2)


@pytest.fixture(scope="module")
def plant():
    return so.plants.high_impedance(parts=("stribeck",))


def falling(plant, f_s, v_st):
    return plant.complete(so.plants.thor()).update(**VALUES, f_s=f_s, v_st=v_st)


def find_radius(law, params, slope):
    """Return the closed loop's largest eigenvalue with viscous friction of a slope, written out for this test."""
    mass = Mass.of({name: params[name].value for name in params})
    a = np.array([[0.0, 1.0], [-mass.k / mass.m, -(mass.b + slope) / mass.m]])
    whole = expm(np.block([[a, np.array([[0.0], [1.0 / mass.m]])], [np.zeros((1, 3))]]) * 1e-3)
    law_a, law_b, law_c, law_d = measurement_matrices(law)
    n = law_a.shape[0]
    # States: position, velocity, the two commands under way (the older is held now), the law's own.
    closed = np.zeros((4 + n, 4 + n))
    closed[:2, :2], closed[:2, 2] = whole[:2, :2], whole[:2, 2]
    closed[2, 3] = 1.0
    closed[3, 0], closed[3, 4:] = -law_d * mass.k, -law_c
    closed[4:, 0], closed[4:, 4:] = law_b * mass.k, law_a
    return np.max(np.abs(np.linalg.eigvals(closed))), np.max(np.abs(np.linalg.eigvals(whole[:2, :2])))


@pytest.fixture(scope="module")
def tuned(plant):
    return so.tune(plant, falling(plant, 35.0, 0.02), SPEC)


@pytest.fixture(scope="module")
def impossible(plant):
    return so.tune(plant, falling(plant, 50.0, 0.005), NEAR)


def test_a_plant_that_grows_as_it_slides_is_stabilised_from_its_fall_to_its_steepest_slope(plant, tuned):
    """At 429 N s/m of fall and 395 of damping it grows without control, and the law holds it at every slope between."""
    params = falling(plant, 35.0, 0.02)
    fall = STRIBECK_SLOPE * 10.0 / 0.02
    assert tuned.feasible
    assert find_radius(tuned.law, params, -fall)[1] > 1.0
    for slope in (-fall, -0.5 * fall, 0.0, 1e3, 35.0 / 0.004):
        assert find_radius(tuned.law, params, slope)[0] < 1.0
    assert tuned.achieved.bandwidth_hz == pytest.approx(20.0, rel=0.005)
    assert tuned.achieved.ms <= 1.6


def test_steps_of_the_stabilised_plant_end_without_hunting(plant, tuned):
    """Simulated with the falling curve itself, at sizes from below its friction to well above."""
    steps = np.array([20.0, 60.0, 200.0, 600.0])
    params = falling(plant, 35.0, 0.02)
    mass = Mass.of({name: params[name].value for name in params})
    runs = simulate([mass] * steps.size, [tuned.to_dict()] * steps.size, np.tile(steps[:, None], 1000), substeps=20)
    assert np.all(runs.ringing(steps) < 0.02)
    assert np.all(runs.overshoot(steps) < 0.3 * 1.1)


@pytest.mark.slow
def test_a_fall_that_cannot_be_had_is_answered_with_the_largest_that_can(plant, impossible):
    """With a tenth less than the largest it is feasible, with half as much again it is not."""
    controller, possible, fall = impossible, impossible.possible, STRIBECK_SLOPE * 25.0 / 0.005
    assert not controller.feasible
    assert controller.active_constraints[0].startswith("stability")
    assert possible.fall == pytest.approx(fall, rel=1e-6)
    assert f"{fall:.4g} N s/m" in controller.explanation and f"{possible.largest_fall:.4g}" in controller.explanation
    assert "f_c, f_s and v_st" in controller.explanation and len(controller.explanation) < 240
    assert so.tune(plant, falling(plant, 50.0, 0.005 * fall / (0.9 * possible.largest_fall)), SPEC).feasible
    steeper = so.tune(plant, falling(plant, 50.0, 0.005 * fall / (1.5 * possible.largest_fall)), NEAR)
    assert not steeper.feasible


def test_where_no_law_is_stable_anywhere_it_is_said_and_can_be_read_back(plant, impossible):
    """No bandwidth misses the limits least then, and infinity has no place in a file."""
    params, controller = falling(plant, 50.0, 0.005), impossible
    assert controller.possible.closest_hz is None and controller.possible.missed_by is None
    assert "no stable law" in controller.explanation and "inf" not in controller.explanation
    content = json.loads(to_json(controller.to_dict()))
    assert so.Controller.from_dict(content, plant, params).explanation == controller.explanation
    for name in ("fall", "largest_fall", "closest_hz"):
        half = content["possible"] | {"closest_hz": 20.0, "missed_by": 0.1} | {name: None}
        with pytest.raises(FileError, match=r"possible.* both"):
            so.Controller.from_dict(content | {"possible": half}, plant, params)


def test_a_bandwidth_that_a_falling_plant_allows_is_named_and_can_be_had(plant):
    """It is droop that blocks at 15 Hz, where the plant is stabilised: friction is not to blame."""
    params, near = falling(plant, 35.0, 0.018), replace(SPEC, bandwidth_hz=15.0, bandwidth_range_hz=(14.0, 15.5))
    controller = so.tune(plant, params, near)
    largest = controller.largest_bandwidth_hz
    assert not controller.feasible and controller.achieved.stable
    assert 14.0 <= largest < 15.0 and f"{largest:.4g} Hz" in controller.explanation
    assert "friction" not in controller.explanation
    assert so.tune(plant, params, replace(near, bandwidth_hz=largest)).feasible


def test_the_sliding_bandwidth_is_a_range_from_fast_to_the_steepest_fall(plant, tuned):
    """Fast a curve falls no more, as that of Coulomb's friction alone; no motion keeps to the speed of the fall."""
    params = falling(plant, 35.0, 0.02)
    coulomb = tuned.close(plant, params.update(f_s=VALUES["f_c"])).figures().bandwidth_hz
    assert tuned.bandwidth_sliding_fast_hz == pytest.approx(coulomb, rel=1e-9)
    assert coulomb < 0.95 * tuned.achieved.bandwidth_hz
    content = json.loads(to_json(tuned.to_dict()))
    assert content["achieved"]["bandwidth_sliding_fast_hz"] == pytest.approx(coulomb, rel=1e-9)
    verdict, *_ = repr(tuned).splitlines()
    assert f"{coulomb:.3g} to 20 Hz sliding and" in verdict
    assert f"{coulomb:.4g} Hz where it slides fast" in " ".join(repr(tuned).split())


def respond_fast(law, params, f):
    """Return F/F_ref at frequencies where the slope of friction is zero, written out for this test."""
    mass = Mass.of({name: params[name].value for name in params})
    a = np.array([[0.0, 1.0], [-mass.k / mass.m, -mass.b / mass.m]])
    whole = expm(np.block([[a, np.array([[0.0], [1.0 / mass.m]])], [np.zeros((1, 3))]]) * 1e-3)
    z = np.exp(2j * np.pi * f * 1e-3)
    force = np.array([mass.k * np.linalg.solve(each * np.eye(2) - whole[:2, :2], whole[:2, 2])[0] for each in z])
    ahead, back = (
        np.polynomial.polynomial.polyval(1.0 / z, path["num"]) / np.polynomial.polynomial.polyval(1.0 / z, path["den"])
        for path in (law["reference"], law["measurement"])
    )
    force = force * z**-2.0
    return force * ahead / (1.0 + force * back)


def test_a_met_bandwidth_says_that_nothing_is_asked_sliding_fast(tuned):
    """The design plant slides where its friction falls the steepest; what is left fast is a row, asked for or not."""
    fast = tuned.bandwidth_sliding_fast_hz
    verdict, *_ = repr(tuned).split("\n\n")
    assert tuned.met and f"none asks for more than {fast:.4g} Hz sliding fast" in " ".join(verdict.split())
    assert "min_bandwidth_sliding_fast_hz = 20 in [controller]" in " ".join(verdict.split())
    assert re.search(rf"bandwidth, sliding fast +{fast:.4g} Hz +not required", repr(tuned))
    assert "min_bandwidth_sliding_fast_hz" not in tuned.active_constraints


def test_a_bandwidth_that_is_asked_sliding_fast_is_had_there_or_is_not_met(plant):
    """At 26 Hz the tuner keeps 18 Hz there with every other limit; at 20 Hz no law does, and it says which would."""
    params = falling(plant, 35.0, 0.02)
    asked = replace(SPEC, min_bandwidth_sliding_fast_hz=18.0, bandwidth_hz=26.0)
    controller = so.tune(plant, params, asked)
    f = np.geomspace(0.1, 60.0, 4000)
    size = np.abs(respond_fast(controller.to_dict(), params, f))
    fast = f[np.argmax(size < np.sqrt(0.5))]
    assert controller.met and controller.achieved.bandwidth_hz == pytest.approx(26.0, rel=5e-3)
    assert fast == pytest.approx(controller.bandwidth_sliding_fast_hz, rel=2e-3)
    assert fast >= 18.0 * (1.0 - 5e-3)
    certificate = so.certify(controller, {"stand": plant}, params, samples=1, simulations=False)
    (row,) = (row for row in certificate.requirements if row.name == "min_bandwidth_sliding_fast_hz")
    assert row.met and row.sense == "≥" and row.limit == 18.0 and row.unit == "Hz"
    assert row.value == pytest.approx(controller.bandwidth_sliding_fast_hz, rel=1e-9)
    given = replace(controller, spec=replace(asked, min_bandwidth_sliding_fast_hz=24.0)).to_dict()
    read = so.Controller.from_dict(json.loads(to_json(given)), plant, params)
    assert not read.met and read.active_constraints == ("min_bandwidth_sliding_fast_hz",)
    low = so.tune(plant, params, replace(asked, bandwidth_hz=20.0))
    assert not low.met and 20.0 < min(low.possible.nearest_hz) <= 26.0
    certificate = so.certify(
        replace(low, spec=replace(low.spec, min_bandwidth_sliding_fast_hz=19.0)),
        {"stand": plant},
        params,
        samples=1,
        simulations=False,
    )
    rows = {row.name: row for row in certificate.requirements}
    assert not rows["min_bandwidth_sliding_fast_hz"].met


def test_a_file_states_the_range_that_its_law_has(plant, tuned):
    params, content = falling(plant, 35.0, 0.02), json.loads(to_json(tuned.to_dict()))
    assert so.Controller.from_dict(content, plant, params).bandwidth_sliding_fast_hz is not None
    content["achieved"]["bandwidth_sliding_fast_hz"] *= 1.01
    with pytest.raises(FileError, match="bandwidth_sliding_fast_hz"):
        so.Controller.from_dict(content, plant, params)
    del content["achieved"]["bandwidth_sliding_fast_hz"]  # as older files are
    so.Controller.from_dict(content, plant, params)


def test_damping_that_differs_by_direction_does_not_fall():
    """Its slope is negative in one direction, at all speeds alike."""
    uneven = so.plants.rotary(link="locked", parts=("friction_direction",))
    params = uneven.defaults.update(f_c=0.01, b_a=1e-5)
    assert not falls(uneven, params)
    steep = so.plants.rotary(link="locked", parts=("stribeck",))
    assert falls(steep, steep.defaults.update(f_c=0.01, f_s=0.02, v_st=1.0))


def test_friction_that_does_not_fall_makes_no_range(plant, tuned):
    coulomb = replace(tuned, design=(plant, falling(plant, VALUES["f_c"], 0.02)))
    assert coulomb.bandwidth_sliding_fast_hz is None
    assert "bandwidth_sliding_fast_hz" not in coulomb.to_dict()["achieved"]
