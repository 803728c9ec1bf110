"""The certificate of a controller that compensates friction from the speed, or from the reference."""

from __future__ import annotations

import json

import pytest

import seaopt as so
from seaopt.control import CompensateFriction, add_compensation
from seaopt.files import to_json
from seaopt.robustness.certificate.compensation import (
    FROM_REFERENCE,
    describe_compensation,
    find_nominal_compensation,
)

STAND, PARAMETERS = so.plants.high_impedance(), so.plants.thor().update(f_c=100.0)
RANGES = {"f_c": (20.0, 120.0), "K_tau": (0.024, 0.027)}


@pytest.fixture(scope="module")
def controller():
    return so.tune(STAND, PARAMETERS, so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6, reserve=0.05))


def certify(controller, **options):
    return so.certify(
        controller, {"stand": STAND}, PARAMETERS, ranges=RANGES, samples=5, simulations=False, **options
    )  # fmt: skip


def find(certificate):
    return [row for row in certificate.requirements if row.name == "friction_compensation"]


@pytest.mark.slow
def test_stability_is_required_with_less_friction_than_is_compensated(controller):
    chosen = add_compensation(controller, friction=CompensateFriction(fraction=0.9, source="speed"))
    certificate = certify(chosen)
    (row,) = find(certificate)
    assert row.met
    assert row.limit == pytest.approx(chosen.compensation.friction.slope)
    assert certificate.compensation_draws["stand"].shown == 5
    shown = float(row.where.split("shown up to ")[1].split(" ")[0])
    assert shown == pytest.approx(row.value * chosen.compensation.friction.speed / 100.0, rel=1e-2)
    assert row.value == certificate.compensation_draws["stand"].least_slope < certificate.compensation["stand"].slope
    stored = json.loads(to_json(certificate.to_dict()))
    again = type(certificate).from_dict(stored, chosen, {"stand": STAND}, PARAMETERS)
    assert again.compensation_draws == certificate.compensation_draws
    assert again.compensation["stand"].slope == pytest.approx(stored["compensation"]["stand"]["slope"])


@pytest.mark.slow
def test_what_is_too_steep_is_not_met(controller):
    steep = add_compensation(controller, friction=CompensateFriction(fraction=0.9, source="speed", speed=5e-4))
    certificate = certify(steep)
    (row,) = find(certificate)
    assert not row.met
    assert row.sense == "≥"
    assert not certificate.passed
    assert 0.0 < row.value < row.limit
    assert not certificate.compensation_draws


def test_reference_changes_no_stability(controller):
    added = add_compensation(controller, friction=CompensateFriction())
    assert not find_nominal_compensation(added, {"stand": STAND}, PARAMETERS)
    assert describe_compensation(added, {}, {}) == (FROM_REFERENCE,)
    assert describe_compensation(controller, {}, {}) == ()
