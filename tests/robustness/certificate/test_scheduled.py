"""The certificate of a schedule."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import seaopt as so
from seaopt.control import tune_schedule
from seaopt.control.laws.friction_margin import find_friction_margin
from seaopt.errors import ControlError, FileError
from seaopt.executors import Shared
from seaopt.files import to_json
from seaopt.parameters import ParameterSet
from seaopt.robustness import ScheduleCertificate, certify_schedule
from seaopt.robustness.certificate import scheduled
from seaopt.robustness.certificate.certify import add_design, find_own_drive
from seaopt.robustness.certificate.measured_draws import Loops, measure_draws
from seaopt.robustness.certificate.requirements import require_motion, require_rate
from seaopt.robustness.certificate.scheduled import (
    _certify_place,
    _require_friction,
)
from seaopt.robustness.uncertainty.batch import batch_figures
from seaopt.robustness.uncertainty.draws import combine_uncertainty
from seaopt.robustness.uncertainty.failure_probability import count_failures
from seaopt.robustness.verification import limit_cycles, schedule_sweep, verification
from seaopt.robustness.verification.schedule_motion import Motion
from seaopt.robustness.verification.schedule_sweep import Sweep
from tests.schedules import POINTS, read_knee, tune_knee
from tools.golden import compare

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


def ask(schedule, **limits):
    """Return a schedule of which other limits are asked."""
    return replace(
        schedule, controllers=tuple(replace(one, spec=replace(one.spec, **limits)) for one in schedule.controllers)
    )


def know(schedule, plants, values, ranges):
    """Return what is uncertain of the plants, with the variable where the values have it."""
    drive = find_own_drive(schedule.controllers[0], values)
    return combine_uncertainty(values, ParameterSet(), ranges, plants, drive)


def test_a_draw_that_lies_on_its_limit_keeps_it_as_in_the_certificate_of_one_law():
    _, swing, values = read_knee()
    schedule, value, models = tune_knee(), 0.2, {"swing": swing}
    unknown = know(schedule, models, values.update(phi=value), {"I_p": (0.33, 0.39)})
    points = unknown.draw(4, np.random.default_rng(1))
    largest = np.max(batch_figures(schedule.at(value), swing, unknown.nominal, unknown.values(points)).ms)
    for beyond, fails in ((5e-7, False), (5e-6, True)):
        asked = ask(schedule, max_sensitivity=float(largest / (1.0 + beyond)))
        loops = Loops(controller=asked.at(value), models=models, plants=models, unknown=unknown, bounds=None)
        failed, _, _ = measure_draws(Shared(loops), 4, np.random.default_rng(1), None, lambda *_: None)
        alone = count_failures(failed, 1, 0.99)
        place, _ = _certify_place(Shared((asked, models)), (value, unknown, points, np.random.default_rng(2)))
        assert (place.over_ms > 0, alone.over_ms > 0) == (fails, fails)
        assert place.over_ms == alone.over_ms


def test_the_design_plant_is_certified_too_where_another_plant_has_its_name():
    stand, swing, values = read_knee()
    assert add_design(stand, {"design": swing}) == {"design plant": stand, "design": swing}
    assert list(add_design(stand, {"swing": swing, "stand": stand})) == ["swing", "stand"]
    with pytest.raises(ControlError, match='are called "design" and "design plant"'):
        certify_schedule(tune_knee(), {"design": swing, "design plant": swing}, values)


def read_rubbing_knee(folder):
    """Return the swinging shank with Coulomb friction at the screw, and its parameters."""
    before, swing = Path("problems/lever_knee.toml").read_text(encoding="utf-8").split("[plant.swing.parameters]")
    swing = swing.replace("- b*v - F)/M", "- b*v - F - rub)/M").replace(
        "[plant.swing.f]",
        'f_c = { unit = "N", value = 40 }\nv_s = { unit = "m/s", value = 1e-3 }\n[plant.swing.friction.rub]\n'
        'velocity = "v"\nforce = "f_c*tanh(v/v_s)"\njump = "f_c"\n'
        'slopes = ["0", "f_c/v_s"]\nunit = "N"\n\n[plant.swing.f]',
    )  # fmt: skip
    path = folder / "rubbing.toml"
    path.write_text(f"{before}[plant.swing.parameters]{swing}", encoding="utf-8")
    problem = so.read_problem(path)
    return problem.plants["swing"], problem.parameters


def test_the_friction_margin_is_asked_of_a_plant_that_moves_the_variable_and_of_its_draws(tmp_path):
    schedule, value = ask(tune_knee(), min_friction_margin=1e9), 0.2
    stand, _, _ = read_knee()
    swing, values = read_rubbing_knee(tmp_path)
    models = {"stand": stand, "swing": swing}
    unknown = know(schedule, models, values.update(phi=value), {"I_p": (0.33, 0.39), "f_c": (5.0, 10.0)})
    rows = _require_friction(schedule, models, value, unknown, 4, np.random.default_rng(2))
    controller, nominal = schedule.at(value), unknown.nominal
    margin = find_friction_margin(controller, swing, nominal)
    assert len(rows) == 1 and rows[0].where.startswith("swing")
    assert rows[0].value <= margin.least_slope and rows[0].limit == 1e9
    assert _require_friction(tune_knee(), models, value, unknown, 4, np.random.default_rng(2)) == []


def test_a_rate_is_required_where_it_is_asked_and_the_slowest_sweep_always(certificate):
    def sweep(rate, fault=""):
        return Sweep(plant="swing", rate=rate, frequency_hz=1.0, peak=1.2, left=0.01, fault=fault)

    some = replace(certificate, sweeps={"swing": (sweep(1.0), sweep(2.0), sweep(4.0, "is lost"))})
    none = replace(certificate, sweeps={"swing": (sweep(1.0, "is lost"),)})
    assert some.fastest == 2.0 and "up to 2 rad/s" in some.assumption
    met = [require_rate(some.sweeps["swing"], "rad/s", least).met for least in (None, 1.5, 3.0)]
    assert met == [True, True, False]
    assert not require_rate(none.sweeps["swing"], "rad/s", None).met


def test_a_motion_slower_than_the_rate_asked_is_not_met():
    slow = Motion(
        plant="swing", asked=3.0, rate=1.5, low=0.1, high=0.5, size=4.5, left=0.3, ringing=0.01, fault="",
    )  # fmt: skip
    short = require_motion(slow, "phi", "rad/s", 3.0)
    assert (short.met, short.limit, short.value, short.sense) == (False, 3.0, 1.5, "≥")
    assert "3 rad/s is not reached within the table and the command's limit; ask a smaller min_rate" in short.where
    assert require_motion(slow, "phi", "rad/s", 1.5).met
    tried = require_motion(slow, "phi", "rad/s", None)  # nothing was asked: what is shown is stated
    assert tried.met and tried.limit == tried.value == 1.5 and "is not reached" in tried.where
    for least in (None, 1.0):
        rings = require_motion(replace(slow, fault="rings"), "phi", "rad/s", least)
        assert not rings.met and rings.value == 0.0


def test_a_range_of_what_it_is_over_is_refused():
    stand, _, values = read_knee()
    with pytest.raises(ControlError, match="range of phi"):
        certify_schedule(tune_knee(), {"stand": stand}, values, ranges={"phi": (0.0, 1.0)})


def test_a_file_reads_back_without_simulating(certificate, monkeypatch):
    stand, swing, values = read_knee()
    found = replace(
        certificate,
        sweeps={"swing": (Sweep(plant="swing", rate=1.0, frequency_hz=1.0, peak=np.inf, left=0.1, fault="is lost"),)},
        motions={"swing": Motion(plant="swing", asked=3.0, rate=1.5, low=0.1, high=0.5, size=4.5, left=0.3,
                                 ringing=0.01, fault="")},
    )  # fmt: skip
    content = json.loads(to_json(found.to_dict()))
    worst = found.places[0].worst["stand"]
    kept = content["places"][0]["worst"]["stand"]["largest"]
    assert kept == {"ms": worst.largest[0].parameters, "mt": worst.largest[1].parameters}

    def refuse(*args, **keywords):
        raise AssertionError("reading a result must not simulate")

    for module, name in ((verification, "play"), (schedule_sweep, "close_loop"),
                         (limit_cycles, "run_loop"), (scheduled, "bound_stretch")):  # fmt: skip
        monkeypatch.setattr(module, name, refuse)
    plants = {"stand": stand, "swing": swing}
    again = ScheduleCertificate.from_dict(content, found.schedule, plants, values, ranges=RANGES)
    own = json.loads(to_json(again.to_dict()))
    for place in (*content["places"], *own["places"]):  # digests change with the last digit
        place["simulated"] = {**(place["simulated"] or {}), "made_from": None}
    assert not list(compare(content, own, "", sentences=True))
    assert again.requirements == found.requirements
    assert again.notes == found.notes
    content = json.loads(to_json(found.to_dict()))
    del content["places"][0]["worst"]["stand"]["largest"]
    with pytest.raises(FileError, match=r"key places.1.worst.stand.largest is missing; certify again"):
        ScheduleCertificate.from_dict(content, found.schedule, plants, values, ranges=RANGES)


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
