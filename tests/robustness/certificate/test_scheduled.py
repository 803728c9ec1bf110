"""The certificate of a schedule."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.control import tune_schedule
from seaopt.control.loops.absolute_stability import FrictionMargin
from seaopt.errors import ControlError, FileError
from seaopt.executors import Shared
from seaopt.files import to_json
from seaopt.progress import ignore
from seaopt.reporting.page.report import _list_plates, _sort_results
from seaopt.robustness.certificate import scheduled
from seaopt.robustness.certificate.cases import CertifyOptions, CheckContext, add_design, pose
from seaopt.robustness.certificate.friction import FRICTION, MarginDraws
from seaopt.robustness.certificate.limits import measure_responses
from seaopt.robustness.certificate.measured_draws import measure_draws
from seaopt.robustness.certificate.scheduled import require_motion, require_rate
from seaopt.robustness.verification import limit_cycles, schedule_sweep, verification
from seaopt.robustness.verification.schedule_motion import Motion
from seaopt.robustness.verification.schedule_sweep import Sweep
from seaopt.robustness.verification.verification import Verification
from seaopt.simulation import Clock
from tests.schedules import POINTS, read_knee, tune_knee
from tools.golden import compare

RANGES = {"I_p": (0.33, 0.39), "k": (645e3, 665e3)}


@pytest.fixture(scope="module")
def certificate():
    stand, swing, values = read_knee()
    return so.certify(
        tune_knee(), {"stand": stand, "swing": swing}, values, ranges=RANGES, samples=90, simulations=False
    )


def test_it_passes_and_looks_at_the_points_and_between_them(certificate):
    assert certificate.passed, certificate
    values = list(certificate.values)
    assert set(POINTS) < set(values)
    assert values == sorted(values) and len(values) == 9
    assert certificate.monte_carlo.samples == 90 and certificate.monte_carlo.failures == 0


def test_its_figures_are_those_of_the_law_on_the_plant_there(certificate):
    _, swing, values = read_knee()
    for value, place in list(zip(certificate.values, certificate.places, strict=True))[::3]:
        here = values.update(phi=value)
        expected = certificate.schedule.at(value).close(swing, here).figures()
        assert place.plants["swing"].ms == pytest.approx(expected.ms, rel=1e-9)


def test_what_is_of_one_law_is_drawn_at_a_place_alone(certificate):
    names = {*dir(certificate.plot)} - {"requirements"}
    assert names >= {"sensitivity", "step", "bandwidth", "impedance", "friction", "draws"}
    for name in names:
        with pytest.raises(ControlError, match=rf"certificate\.places\[0\]\.plot\.{name}\(\)"):
            getattr(certificate.plot, name)()
    place = certificate.places[-1]
    drawn = {line.get_label(): line.get_ydata() for line in place.plot.sensitivity().lines}
    assert 10.0 ** (np.max(drawn["swing"]) / 20.0) == pytest.approx(place.plants["swing"].ms, rel=1e-4)
    law = replace(certificate.controller, robust_to=())
    plates = {plate.name: plate for plate in _list_plates(_sort_results([law, certificate]))}
    assert {*plates} == {"loop", "schedule"} and not plates["loop"].heading  # of the law on its design plant


def test_the_certificate_of_each_place_prints_itself_between_the_points_too(certificate):
    assert any(not place.margins for place in certificate.places)
    for place in certificate.places:
        assert "Margins on every plant" in repr(place)


def test_every_stretch_is_proved_and_above_what_was_found(certificate):
    assert all(one.shown for one in certificate.stretches) and len(certificate.stretches) == 16
    largest = max(loop.ms for place in certificate.places for loop in place.plants.values())
    assert max(one.ms for one in certificate.stretches) >= largest
    assert "proved" in certificate.proof
    scopes = {row.scope for row in certificate.requirements if row.name == "limits_between_points"}
    assert scopes == {"nominal"} and all(row.scope for row in certificate.requirements)
    lost = replace(certificate.stretches[0], reason="no bound in 400 boxes")
    assert replace(certificate, stretches=(lost,)).proof.startswith("nothing is proved")


@pytest.mark.slow
def test_draws_beyond_what_the_law_bears_fail_it():
    stand, swing, values = read_knee()
    wide = so.certify(
        tune_knee(), {"stand": stand, "swing": swing}, values, ranges={"K_f": (120.0, 600.0)}, samples=45,
        simulations=False,
    )  # fmt: skip
    assert not wide.passed and wide.monte_carlo.failures > 0


def test_once_it_is_broken_somewhere_the_other_places_are_not_simulated():
    stand, swing, values = read_knee()
    schedule = tune_knee()
    strict = replace(schedule.spec, max_sensitivity=1.1)
    strict = replace(schedule, controllers=tuple(replace(each, spec=strict) for each in schedule.controllers))
    failed = so.certify(strict, {"stand": stand, "swing": swing}, values, ranges=RANGES, samples=9, thorough=False)
    assert "what takes long was left out" in " ".join(repr(failed).split())
    assert not failed.met and not failed.sweeps and not failed.stretches
    assert len(failed.places) == 9 and failed.monte_carlo.samples == 9
    assert all(place.simulated is None and not isinstance(place.steps, Verification) for place in failed.places)


@pytest.mark.slow
def test_a_limit_that_is_broken_between_the_points_fails_it():
    stand, _, values = read_knee()
    spec = so.ControllerSpec(measured="tau", bandwidth_hz=30, max_sensitivity=1.55, current_limit_A=5.0)
    coarse = tune_schedule(stand, values, spec, "phi", [0.0, 1.15])
    assert all(one.feasible for one in coarse.controllers) and not coarse.feasible
    assert "points = [0, 0.575, 1.15]" in coarse.remedy
    found = so.certify(coarse, {"stand": stand}, values, simulations=False)
    missed = {row.name for row in found.requirements if not row.met}
    assert not found.passed and {"limits_between_points", "max_sensitivity"} <= missed


def ask(schedule, **limits):
    """Return a schedule of which other limits are asked."""
    return replace(
        schedule, controllers=tuple(replace(one, spec=replace(one.spec, **limits)) for one in schedule.controllers)
    )


def test_a_loop_between_the_points_that_breaks_a_limit_fails_it():
    """At a value that nobody looks at: a limit on Ms that is below what the loop has there."""
    (stand, _, values), knee = read_knee(), tune_knee()
    strict = ask(knee, max_sensitivity=knee.at(0.05).close(stand, values.update(phi=0.05)).figures().ms - 0.01)
    for schedule, count in ((knee, 0), (strict, 1)):
        certificate = so.certify(schedule, {"stand": stand}, values, samples=1, simulations=False)
        rows = [row for row in certificate.requirements if row.name == "limits_between_points" and not row.met]
        missed = [row for row in rows if row.place[1] < 0.05]  # of the first stretch
        assert len(missed) == count
    (row,) = missed
    (over, value), ms = row.place, schedule.at(row.place[1]).close(stand, values.update(phi=row.place[1])).figures().ms
    assert over == "phi" and 0.0 <= value <= 0.1 and row.plant == "stand" and f"Ms is {ms:.5g}, above" in row.text


def test_a_draw_that_lies_on_its_limit_keeps_it():
    """Ms one by one: a limit below the largest by half of what rounding may do is kept, by ten times that it is not."""
    _, swing, values = read_knee()
    plants, ranges, rng = {"swing": swing}, {"I_p": (0.33, 0.39)}, np.random.default_rng(1)
    cases = pose(tune_knee(), plants, values, ranges, so.ParameterSet())[0.2]
    drawn = cases.unknown.list_draws(4, rng)
    largest = max(cases.controller.close(swing, values.update(phi=0.2, **draw)).figures().ms for draw in drawn)
    for beyond, fails in ((5e-7, False), (1e-5, True)):
        spec = replace(cases.controller.spec, max_sensitivity=float(largest / (1.0 + beyond)))
        alone = replace(cases, controller=replace(cases.controller, spec=spec), models=plants, plants=plants)
        failed, _, _ = measure_draws(Shared(alone), 4, np.random.default_rng(1), None, ignore)
        assert np.any(failed[1]) == fails


def find_radius(law, values, at, slope=0.0):
    """Return the largest eigenvalue of the swinging knee under a law, by its equations and its gains, sample by sample.
    `slope` is of viscous friction besides at the screw.
    """
    v, phi = {name: values[name].value for name in values} | at, at["phi"]
    arm, force = v["L_a"] * np.cos(phi), v["mgL"] * np.tan(phi) / v["L_a"]  # at rest
    torque = np.array([arm * v["k"], 0.0, -(arm**2) * v["k"] - v["L_a"] * np.sin(phi) * force, 0.0])
    a = np.zeros((4, 4))
    a[0, 1] = a[2, 3] = 1.0
    a[1] = np.array([-v["k"], -v["b"] - slope, v["k"] * arm, 0.0]) / v["M"]
    a[3] = (torque - np.array([0.0, 0.0, v["mgL"] * np.cos(phi), v["d"]])) / v["I_p"]
    ts, g = law.sample_time_s, law.gains
    held = expm(np.block([[a, np.eye(4)[:, [1]] / v["M"]], [np.zeros((1, 5))]]) * ts)[:4]

    def step(state):
        x, effort, integral, last, slewed = state[:4], *state[4:]
        y = torque @ x
        integral = integral + g["k_i"] * ts / 2 * (y + last)
        slewed = (g["T_f"] * slewed + y - last) / (g["T_f"] + ts)
        return [*(held @ [*x, effort]), -g["k_p"] * y - integral - g["k_d"] * slewed, integral, y, slewed]

    return np.max(np.abs(np.linalg.eigvals(np.array([step(unit) for unit in np.eye(8)]).T)))


def test_the_worst_case_between_the_points_has_the_eigenvalues_of_its_equations(certificate):
    _, _, values = read_knee()
    between = [(v, place) for v, place in zip(certificate.values, certificate.places, strict=True) if v not in POINTS]
    assert len(between) == 6
    for value, place in between:
        worst = place.worst["swing"]
        at = {"I_p": 0.36, "mgL": 11.8, "d": 2.0, "phi": value} | worst.parameters
        assert find_radius(place.controller, values, at) == pytest.approx(worst.witness.spectral_radius, abs=1e-6)
        assert worst.ms >= place.plants["swing"].ms
        rows = [row for row in certificate.requirements if row.place == ("phi", value) and row.name == "worst_case"]
        assert {row.plant for row in rows} == {"stand", "swing"} and all(row.met for row in rows)


def test_the_design_plant_is_certified_too_where_another_plant_has_its_name():
    stand, swing, values = read_knee()
    assert add_design(stand, {"design": swing}) == {"design plant": stand, "design": swing}
    assert list(add_design(stand, {"swing": swing, "stand": stand})) == ["swing", "stand"]
    with pytest.raises(ControlError, match='are called "design" and "design plant"'):
        so.certify(tune_knee(), {"design": swing, "design plant": swing}, values)


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


def test_friction_is_looked_at_on_a_plant_that_moves_the_variable_and_over_draws(tmp_path):
    """Viscous friction is in the sector: with as much of it as is shown the eigenvalues by hand are stable."""
    swing, values = read_rubbing_knee(tmp_path)
    schedule, ranges = ask(tune_knee(), min_friction_margin=1e9), {"I_p": (0.33, 0.39), "f_c": (5.0, 10.0)}
    cases = pose(schedule, {"stand": read_knee()[0], "swing": swing}, values, ranges, so.ParameterSet())[0.2]
    rng = np.random.default_rng(2)
    context = CheckContext(
        subject=schedule,
        shared=Shared(cases),
        source=values,
        options=CertifyOptions(samples=4),
        drawing=rng,
        rng=rng,
        place=("phi", 0.2),
    )
    found = FRICTION.measure(context, ignore)
    (row,) = found.requirements
    margin, draws = found.fields["friction"]["swing"], found.fields["friction_draws"].get("swing")
    assert (row.name, row.plant, row.limit) == ("min_friction_margin", "swing", 1e9)
    assert row.value == min(margin.least_slope, np.inf if draws is None else draws.least_slope)
    for share in (0.01, 0.3, 1.0):
        at = {"I_p": 0.36, "mgL": 11.8, "d": 2.0, "phi": 0.2}
        assert find_radius(cases.controller, values, at, share * min(margin.least_slope, 1e12)) < 1.0


def test_its_file_states_friction_at_the_worst_place(certificate):
    """Where it is not shown to be harmless, whatever slope is; else where the least is shown, nominal or drawn."""
    drawn = MarginDraws(samples=9, shown=9, least_slope=30.0, factor=1.0, parameters={})
    places, worst = list(certificate.places), []
    ever_worse = [(50.0, 2.0, {}), (40.0, 2.0, {}), (np.inf, 2.0, {"swing": drawn}), (60.0, 0.9, {})]
    for k, (slope, factor, draws) in enumerate(ever_worse):
        margin = FrictionMargin(slopes=(slope,), factor=factor, frequency_hz=1.0, multiplier="circle")
        places[k] = replace(places[k], friction={"swing": margin}, friction_draws=draws)
        content = replace(certificate, places=tuple(places)).to_dict()
        worst.append(content["friction"]["swing"]["place"]["phi"])
    assert worst == list(certificate.values[:4])


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


def judge_responses(schedule, parameters, measured):
    place = next(iter(pose(schedule, {}, read_knee()[2], {}, so.ParameterSet()).values()))
    rng = np.random.default_rng(1)
    context = CheckContext(
        subject=schedule,
        shared=Shared(place),
        source=parameters,
        options=CertifyOptions(),
        drawing=rng,
        rng=rng,
        measured=measured,
    )
    return measure_responses(replace(context, places=[context]), ignore).requirements


def test_a_measured_response_is_judged_with_the_law_of_the_value_that_the_parameters_have():
    """A response measured without error, by the lever's equations: Ms is the largest of the measured points."""
    stand, swing, values = read_knee()
    schedule, there = tune_knee(), values.update(phi=0.2)
    v, f, ts = {name: values[name].value for name in values}, np.arange(0.5, 300.0, 0.5), 1e-3
    held = expm(np.array([[0.0, 1.0, 0.0], [-v["k"], -v["b"], 1.0], [0.0, 0.0, 0.0]]) / [[1.0], [v["M"]], [1.0]] * ts)
    z = np.exp(2j * np.pi * f * ts)
    per_newton = np.linalg.solve(z[:, None, None] * np.eye(2) - held[:2, :2], np.tile(held[:2, 2:], (f.size, 1, 1)))
    response = v["L_a"] * np.cos(0.2) * v["k"] * per_newton[:, 0, 0]
    measured = so.MeasuredResponse(
        name="chirp", plant=stand, source="I", output="tau", clock=Clock(period=ts, hold="zero", delay_s=0.0),
        frequency_hz=f, response=v["K_f"] * response, radius=0.0 * f, confidence=0.95, averages=np.full(f.size, 100),
    )  # fmt: skip
    rows = {row.name: row for row in judge_responses(schedule, there, {"frf:chirp": measured})}
    g, q = schedule.at(0.2).gains, 1.0 / z
    slope = (1.0 - q) / (g["T_f"] + ts - g["T_f"] * q)
    law = g["k_p"] + g["k_i"] * ts / 2 * (1.0 + q) / (1.0 - q) + g["k_d"] * slope
    assert rows["max_sensitivity"].place == ("phi", 0.2)
    assert rows["max_sensitivity"].value == pytest.approx(np.max(np.abs(1.0 / (1.0 + response * law * q))), rel=2e-3)
    elsewhere = replace(measured, name="other", values={"phi": 0.4})
    with pytest.raises(ControlError, match="frf:other was taken at phi = 3, outside the points"):
        judge_responses(schedule, there, {"frf:other": replace(elsewhere, values={"phi": 3.0})})
    both = judge_responses(schedule, there, {"frf:other": elsewhere, "frf:chirp": measured})
    assert [row.place for row in both if row.name == "max_sensitivity"] == [("phi", 0.4), ("phi", 0.2)]
    with pytest.raises(ControlError, match="one value of phi, which is not given"):
        judge_responses(schedule, so.ParameterSet(), {"frf:chirp": replace(measured, plant=swing)})


def test_a_range_of_what_it_is_over_is_refused():
    stand, _, values = read_knee()
    with pytest.raises(ControlError, match="range of phi"):
        so.certify(tune_knee(), {"stand": stand}, values, ranges={"phi": (0.0, 1.0)})


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
    kept = content["schedule"]["places"][0]["plants"]["stand"]["worst"]["largest"]
    assert [kept[name]["parameters"] for name in ("ms", "mt")] == [each.parameters for each in worst.largest]

    def refuse(*args, **keywords):
        raise AssertionError("reading a result must not simulate")

    for module, name in ((verification, "play"), (schedule_sweep, "run_loop"),
                         (limit_cycles, "run_loop"), (scheduled, "bound_stretch")):  # fmt: skip
        monkeypatch.setattr(module, name, refuse)
    plants = {"stand": stand, "swing": swing}
    again = so.Certificate.from_dict(content, found.schedule, plants, values, ranges=RANGES)
    own = json.loads(to_json(again.to_dict()))
    content["made_from"] = own["made_from"] = None  # digests change with the last digit
    assert not list(compare(content, own, "", sentences=True))
    assert again.requirements == found.requirements
    assert again.notes == found.notes
    content = json.loads(to_json(found.to_dict()))
    content["schedule"]["places"][0]["plants"]["stand"]["worst"]["ms"] = 1.0
    with pytest.raises(FileError, match=r"was edited"):
        so.Certificate.from_dict(content, found.schedule, plants, values, ranges=RANGES)
    content = json.loads(to_json(found.to_dict()))
    content["schedule"]["stretches"] = []
    with pytest.raises(FileError, match=r"was edited"):
        so.Certificate.from_dict(content, found.schedule, plants, values, ranges=RANGES)
    del content["made_from"]
    with pytest.raises(FileError, match=r"written by hand"):
        so.Certificate.from_dict(content, found.schedule, plants, values, ranges=RANGES)


def test_what_is_written_is_json_with_its_verdict(certificate):
    content = json.loads(to_json(certificate.to_dict()))
    assert content["schema"] == "seaopt/robustness/3" and content["passed"] is True
    assert len(content["schedule"]["stretches"]) == 16 and content["schedule"]["fastest_rate"] == 0.0


@pytest.mark.slow
def test_with_simulations_it_states_how_fast_the_variable_may_move():
    stand, swing, values = read_knee()
    found = so.certify(tune_knee(), {"stand": stand, "swing": swing}, values, ranges=RANGES, samples=90, min_rate=0.5)
    assert found.passed, found
    assert 0.5 < found.fastest < np.inf and set(found.sweeps) == {"stand", "swing"}
    assert set(found.motions) == {"swing"} and found.motions["swing"].rate == pytest.approx(0.5, rel=0.05)
    (row,) = (row for row in found.requirements if row.name == "min_motion_rate")
    assert row.met and "moves phi by itself" in row.where and row.where in found.notes
    simulated = [v for v, place in zip(found.values, found.places, strict=True) if place.simulated is not None]
    assert simulated == list(POINTS)
