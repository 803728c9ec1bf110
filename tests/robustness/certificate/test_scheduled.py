"""The certificate of a schedule."""

import json
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import tune_schedule
from seaopt.errors import ControlError
from seaopt.files import to_json
from seaopt.robustness import certify_schedule
from seaopt.robustness.certificate.scheduled import _require_motion, _require_rate
from seaopt.robustness.verification.schedule_motion import Motion
from seaopt.robustness.verification.schedule_sweep import Sweep
from tests.schedules import POINTS, read_knee, tune_knee

RANGES = {"I_p": (0.33, 0.39), "k": (645e3, 665e3)}


@pytest.fixture(scope="module")
def certificate():
    stand, swing, values = read_knee()
    return certify_schedule(
        tune_knee(), {"stand": stand, "swing": swing}, values, ranges=RANGES, samples=90, simulations=False
    )


def test_it_passes_and_looks_at_the_points_and_between_them(certificate):
    assert certificate.passed, certificate
    values = [place.value for place in certificate.places]
    assert [place.value for place in certificate.places if place.point] == list(POINTS)
    assert values == sorted(values) and len(values) == 9
    assert certificate.monte_carlo.samples == 90 and certificate.monte_carlo.failures == 0


def test_its_figures_are_those_of_the_law_on_the_plant_there(certificate):
    _, swing, values = read_knee()
    for place in certificate.places[::3]:
        here = values.update(phi=place.value)
        expected = certificate.schedule.at(place.value).close(swing, here).figures()
        assert place.plants["swing"].ms == pytest.approx(expected.ms, rel=1e-9)


def test_every_stretch_is_proved_and_above_what_was_found(certificate):
    assert all(one.shown for one in certificate.stretches) and len(certificate.stretches) == 16
    assert max(one.ms for one in certificate.stretches) >= max(place.ms for place in certificate.places)
    assert "proved" in certificate.proof
    lost = replace(certificate.stretches[0], reason="no bound in 400 boxes")
    assert replace(certificate, stretches=(lost,)).proof.startswith("nothing is proved")


@pytest.mark.slow
def test_draws_beyond_what_the_law_bears_fail_it():
    stand, swing, values = read_knee()
    wide = certify_schedule(
        tune_knee(), {"stand": stand, "swing": swing}, values, ranges={"K_f": (120.0, 600.0)}, samples=45,
        simulations=False,
    )  # fmt: skip
    assert not wide.passed and wide.monte_carlo.failures > 0


@pytest.mark.slow
def test_a_limit_that_is_broken_between_the_points_fails_it():
    stand, _, values = read_knee()
    spec = so.ControllerSpec(measured="tau", bandwidth_hz=30, max_sensitivity=1.55, current_limit_A=5.0)
    coarse = tune_schedule(stand, values, spec, "phi", [0.0, 1.15])
    assert all(one.feasible for one in coarse.controllers) and not coarse.feasible
    assert "points = [0, 0.575, 1.15]" in coarse.remedy
    found = certify_schedule(coarse, {"stand": stand}, values, simulations=False)
    missed = {row.name for row in found.requirements if not row.met}
    assert not found.passed and {"limits_between_points", "max_sensitivity"} <= missed


def test_a_rate_is_required_where_it_is_asked_and_the_slowest_sweep_always(certificate):
    def sweep(rate, fault=""):
        return Sweep(plant="swing", rate=rate, frequency_hz=1.0, peak=1.2, left=0.01, fault=fault)

    some = replace(certificate, sweeps={"swing": (sweep(1.0), sweep(2.0), sweep(4.0, "is lost"))})
    none = replace(certificate, sweeps={"swing": (sweep(1.0, "is lost"),)})
    assert some.fastest == 2.0 and "up to 2 rad/s" in some.assumption
    assert [row.met for row in _require_rate(some, None) + _require_rate(some, 1.5)] == [True, True]
    assert not _require_rate(some, 3.0)[0].met and not _require_rate(none, None)[0].met


def test_a_motion_slower_than_the_rate_asked_is_not_met():
    schedule = tune_knee()
    slow = Motion(
        plant="swing", asked=3.0, rate=1.5, low=0.1, high=0.5, size=4.5, left=0.3, ringing=0.01, fault="",
    )  # fmt: skip
    short = _require_motion(slow, schedule, 3.0)
    assert (short.met, short.limit, short.value, short.sense) == (False, 3.0, 1.5, "≥")
    assert "3 rad/s is not reached within the table and the command's limit; ask a smaller min_rate" in short.where
    assert _require_motion(slow, schedule, 1.5).met
    tried = _require_motion(slow, schedule, None)  # nothing was asked: what is shown is stated
    assert tried.met and tried.limit == tried.value == 1.5 and "is not reached" in tried.where
    for least in (None, 1.0):
        rings = _require_motion(replace(slow, fault="rings"), schedule, least)
        assert not rings.met and rings.value == 0.0


def test_a_range_of_what_it_is_over_is_refused():
    stand, _, values = read_knee()
    with pytest.raises(ControlError, match="range of phi"):
        certify_schedule(tune_knee(), {"stand": stand}, values, ranges={"phi": (0.0, 1.0)})


def test_what_is_written_is_json_with_its_verdict(certificate):
    content = json.loads(to_json(certificate.to_dict()))
    assert content["schema"] == "seaopt/schedule_robustness/1" and content["passed"] is True
    assert len(content["stretches"]) == 16 and content["fastest_rate"] == 0.0


@pytest.mark.slow
def test_with_simulations_it_states_how_fast_the_variable_may_move():
    stand, swing, values = read_knee()
    found = certify_schedule(
        tune_knee(), {"stand": stand, "swing": swing}, values, ranges=RANGES, samples=90, min_rate=0.5
    )
    assert found.passed, found
    assert 0.5 < found.fastest < np.inf and set(found.sweeps) == {"stand", "swing"}
    assert set(found.motions) == {"swing"} and found.motions["swing"].rate == pytest.approx(0.5, rel=0.05)
    (row,) = (row for row in found.requirements if row.name == "min_motion_rate")
    assert row.met and "moves phi by itself" in row.where and row.where in found.notes
    assert all(place.simulated is not None for place in found.places if place.point)
