"""Measured responses in problem files: frf:NAME, from the file to the verdict."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import seaopt as so
from seaopt.cli.main import app
from seaopt.control.loops.compensation.terms import FORGOTTEN
from seaopt.control.scheduling.tuning import find_response_place
from seaopt.errors import ControlError, ProblemError
from seaopt.problem.stages import certify_problem, list_plants, tune_problem
from seaopt.robustness.certificate.simulated import SIMULATIONS
from tests.checks import leave_out

FILE = """
schema = 1
title = "measured"
[plant.stand]
kind = "high_impedance"
[[experiment]]
name = "chirp"
plant = "stand"
delay_s = 0.001
virtual = { seed = 1, duration_s = 40, rate_hz = 1000, noise_std = { F1 = 1.0 }, excitation = { chirp = { amplitude = 4.0, f0_hz = 0.1, f1_hz = 150 }, noise = { std = 2.0, band_hz = 200 } } }
[controller]
plant = "PLANT"
bandwidth_hz = 30
max_sensitivity = 1.7
max_noise_gain = 80
robust_to = [OTHERS]
[robustness]
samples = 50
"""  # noqa: E501


@pytest.fixture
def write(tmp_path):
    def write(plant="stand", others='"frf:chirp"'):
        path = tmp_path / "problem.toml"
        path.write_text(FILE.replace("PLANT", plant).replace("OTHERS", others))
        return path

    return write


def test_a_response_is_read_with_the_delay_that_its_experiment_has(write):
    problem = so.read_problem(write())
    design, others = list_plants(problem, problem.parameters)
    assert design is problem.design_plant
    assert others["frf:chirp"].clock.delay_s == 0.001 and others["frf:chirp"].confidence == 0.95
    controller = tune_problem(problem, problem.parameters)
    assert controller.feasible and [one.name for one in controller.measured] == ["frf:chirp"]
    measured = problem.measure_responses(problem.parameters)
    certificate = so.certify(
        controller, problem.certified_plants(), problem.parameters, simulations=False, measured=measured
    )  # fmt: skip
    rows = [row for row in certificate.requirements if row.where.startswith("frf:chirp: on measured points, at 95 %")]
    assert {row.name for row in rows} == {"spectral_radius", "max_sensitivity", "max_complementary"}
    assert certificate.passed


def test_a_response_counts_where_its_experiment_was_taken(write):
    """The experiment's own value, else that of the parameters, else the default of its plant."""
    path = write()
    for more, values in (("", {}), ("\nparameters = { k = 750000 }", {"k": 750000.0})):
        path.write_text(path.read_text().replace("delay_s = 0.001", f"delay_s = 0.001{more}"))
        problem = so.read_problem(path)
        response = problem.measure_responses(problem.parameters)["frf:chirp"]
        assert response.values == values
    bare = replace(response, values={})
    given = so.plants.thor().update(k=7e5)
    assert find_response_place("k", "frf:chirp", response, given) == 750000.0
    assert find_response_place("k", "frf:chirp", bare, given) == 7e5
    own = so.plants.high_impedance().defaults["k"].value
    assert find_response_place("k", "frf:chirp", bare, so.ParameterSet()) == own


@pytest.mark.slow
def test_an_observer_has_the_plant_on_the_bench_for_its_nominal_one(write):
    """The static gain of its inverse is that which was measured, as the reference's weight is."""
    path = write("frf:chirp", "")
    path.write_text(path.read_text().replace("max_sens", 'structure = "pid_dob"\nmax_sens'))
    problem = so.read_problem(path)
    controller = tune_problem(problem, problem.parameters)
    design, _ = list_plants(problem, problem.parameters)
    measured = controller.spec.see_response(design, controller.command).static_gain
    assert controller.met and controller.observer is not None
    assert controller.observer.nominal.static_inverse == pytest.approx(1.0 / measured, rel=1e-9)
    # Open loop of the test's own: the sampled stand of the model, which is what was measured but for noise.
    loop = controller.close(problem.design_plant, problem.parameters)
    assert np.max(np.abs(loop.eigenvalues())) < 1.0
    assert loop.figures().ms < 1.7 and loop.figures().bandwidth_hz == pytest.approx(30.0, rel=0.05)


def test_models_beside_the_response_are_certified_too(write):
    """The response has the design's limits, models those of every plant: a bandwidth is asked of the response alone."""
    path = write("frf:chirp", "")
    text = path.read_text().replace("samples = 50", 'samples = 5\nplants = ["stand"]\nparameters = { k = [6e5, 7e5] }')
    path.write_text(text)
    problem = so.read_problem(path)
    controller = tune_problem(problem, problem.parameters)
    certificate = certify_problem(problem, controller, problem.parameters)
    bands = [row for row in certificate.requirements if row.name == "bandwidth_hz"]
    assert [row.text.startswith("on measured points") for row in bands] == [True]
    assert certificate.monte_carlo.samples == 5 and set(certificate.plants) == {"stand"}
    assert certificate.met, [row for row in certificate.requirements if not row.met]


WARM = """
schema = 1
title = "warm knee"
[parameters]
N = 100
K_tau = 0.0369
eta = 0.7
J_m = 2.4e-5
b_r = 4e-4
f_c = 0.002
v_s = 1.0
k_s = 280
J_l = 0.25
d_l = 0.1
m = 4.0
L = 0.2
[plant.stand]
kind = "rotary"
link = "locked"
parts = ["thermal"]
[plant.swing]
kind = "rotary"
link = "pendulum"
[[experiment]]
name = "chirp"
plant = "stand"
virtual = { seed = 1, duration_s = 40, rate_hz = 1000, noise_std = { tau_s = 0.01 }, excitation = { chirp = { amplitude = 2.0, f0_hz = 0.1, f1_hz = 150 }, noise = { std = 1.0, band_hz = 200 } } }
[controller]
plant = "frf:chirp"
measured = "tau_s"
bandwidth_hz = 16
max_sensitivity = 1.7
max_noise_gain = 60
compute_delay_samples = 1
current_limit_A = 9.0
derate = true
compensate = { friction = { fraction = 0.4 }, gravity = { plant = "swing", fraction = 0.8 } }
gate = { range_N = [-300, 300] }
[robustness]
plants = ["swing"]
samples = 5
"""  # noqa: E501


def test_what_no_response_tells_is_of_the_model_of_what_was_measured(tmp_path):
    """Heat, friction and the largest step of the actuator that is on the stand, and the weight of the link: as of a law
    that is designed on its model, and by the equations of the pendulum.
    """
    path = tmp_path / "knee.toml"
    path.write_text(WARM)
    problem = so.read_problem(path)
    controller = tune_problem(problem, problem.parameters)
    assert controller.design is None and controller.derate
    path.write_text(WARM.replace('"frf:chirp"', '"stand"'))
    modelled = so.read_problem(path)
    other = tune_problem(modelled, modelled.parameters)
    assert controller.heat_guard == other.heat_guard
    assert controller.gate.max_step_N == pytest.approx(other.gate.max_step_N, rel=1e-9)
    terms = controller.compensation
    assert terms.friction.effort == pytest.approx(0.4 * 0.002 * 100, rel=1e-6)
    angle = np.linspace(-1.5, 1.5, 7)
    gravity = replace(terms, friction=None)
    held = [gravity.step(FORGOTTEN, 0.0, [float(at)])[0] for at in angle]
    np.testing.assert_allclose(held, 0.8 * 4.0 * 9.81 * 0.2 * np.sin(angle), atol=1e-4)
    content = json.loads(so.files.to_json(controller.to_dict()))
    again = so.Controller.from_dict(content, list_plants(problem, problem.parameters)[0], problem.parameters)
    assert again.heat_guard == controller.heat_guard and again.compensation == controller.compensation
    certificate = certify_problem(problem, controller, problem.parameters)
    assert certificate.simulated.verification.rows


def test_a_design_on_a_response_is_tuned_again_at_draws_of_the_models_it_is_certified_on(write):
    path = write("frf:chirp", "")
    kept = (
        FILE.replace("PLANT", "frf:chirp")
        .replace("OTHERS", "")
        .replace("max_sensitivity = 1.7", "max_sensitivity = 1.5")
    )
    drawn = 'samples = 50\nretune = 4\nplants = ["stand"]\nparameters = { k = [5e5, 8e5], eta = [0.9, 1.1] }'
    path.write_text(kept.replace("samples = 50", drawn))
    problem = so.read_problem(path)
    done = tune_problem(problem, problem.parameters)
    assert done.met and len(done.rounds) == 2, done
    assert done.controller.design is None and set(done.certificate.plants) == {"stand"}
    stand = problem.plants["stand"]
    for k in (5e5, 8e5):
        for eta in (0.9, 1.1):
            loop = done.controller.close(stand, stand.defaults.update(k=k, eta=eta))
            assert np.max(np.abs(loop.eigenvalues())) < 1.0 and loop.figures().ms < 1.5 * 1.001
    path.write_text(kept.replace("samples = 50", "samples = 50\nretune = 2"))
    problem = so.read_problem(path)
    with pytest.raises(ProblemError, match=r"name models in plants of \[robustness\]"):
        tune_problem(problem, problem.parameters)


@pytest.mark.slow
def test_a_design_on_a_response_takes_the_motion_of_the_link_of_a_model(tmp_path):
    """The link of the stand stands still in its log: there the law is as without it, and on the swing it helps."""
    path = tmp_path / "knee.toml"
    plain = WARM.replace("derate = true", 'robust_to = ["swing"]').replace("gate = { range_N = [-300, 300] }", "")
    plain = re.sub(r"compensate = .*", "", plain)
    laws = []
    for text in (plain, plain.replace("max_noise", "link_feedforward = true\nmax_noise")):
        path.write_text(text)
        problem = so.read_problem(path)
        laws.append(tune_problem(problem, problem.parameters))
        assert laws[-1].met and laws[-1].design is None
    _, fed = laws
    assert fed.link is not None and fed.link.measured == "theta_l"
    swing, z = problem.plants["swing"], np.exp(2j * np.pi * np.geomspace(0.05, 499.0, 20_000) * 1e-3)
    loop = fed.close(fed.see(swing), problem.parameters)
    assert np.max(np.abs(loop.eigenvalues())) < 1.0
    assert np.max(np.abs(loop.to_control()(z)[0, 0])) <= 1.7 * 1.001
    response = list_plants(problem, problem.parameters)[0]
    again = so.Controller.from_dict(json.loads(so.files.to_json(fed.to_dict())), response, problem.parameters)
    assert again.link == fed.link and again.achieved.ms == pytest.approx(fed.achieved.ms, rel=1e-9)
    certificate = certify_problem(problem, fed, problem.parameters)
    assert set(certificate.plants) >= {"swing sliding"} and certificate.simulated.verification.rows
    narrow = [law.close(law.see(swing), problem.parameters).figures().tracking_band_hz[0] for law in laws]
    assert narrow[1] < narrow[0]  # the swinging link hinders tracking from further down


def test_what_feeds_the_motor_back_is_shown_to_be_stable_on_models(tmp_path, monkeypatch):
    """A response is of friction that slides; stability with it compensated as it is at rest takes a model."""
    leave_out(monkeypatch, SIMULATIONS)
    path = tmp_path / "knee.toml"
    speed = re.sub("compensate = .*", 'compensate = { friction = { fraction = 0.2, from = "speed" } }', WARM)
    speed = speed.replace("derate = true", 'robust_to = ["swing"]')
    path.write_text(speed)
    problem = so.read_problem(path)
    controller = tune_problem(problem, problem.parameters)
    assert controller.design is None and controller.compensation.friction.reads == "theta_m"
    certificate = certify_problem(problem, controller, problem.parameters)
    shown = [row for row in certificate.requirements if row.name == "friction_compensation"]  # nominal and drawn
    assert {row.plant: row.met for row in shown} == {"design": True, "swing": True}, shown
    assert [text for text in certificate.remarks if text.startswith("frf:chirp: of the law where friction slides")]
    path.write_text(speed.replace('["swing"]', "[]"))
    problem = so.read_problem(path)
    with pytest.raises(ControlError, match=r"compensate\.friction feeds the motor's motion back, most steeply at rest"):
        certify_problem(problem, controller, problem.parameters)


def test_a_law_of_ones_own_is_measured_on_the_response(write, tmp_path):
    path = write("frf:chirp", "")
    problem = so.read_problem(path)
    tuned = tune_problem(problem, problem.parameters)
    own = so.control.assess(
        tuned.law, list_plants(problem, problem.parameters)[0], problem.parameters, problem.spec
    )  # fmt: skip
    assert own.structure == "custom" and own.design is None
    assert own.achieved.ms == pytest.approx(tuned.achieved.ms, rel=1e-9)


def test_a_schedule_keeps_its_limits_on_a_response_at_the_point_where_it_was_taken(write, monkeypatch):
    """The stand was measured with its own spring, which is a point; the other spring is known of the model alone."""
    leave_out(monkeypatch, SIMULATIONS)
    path, own = write(), 655000
    table = f'[controller.schedule]\nover = "k"\npoints = [{own}, 750000]\n[robustness]'
    path.write_text(path.read_text().replace("[robustness]", table))
    problem = so.read_problem(path)
    schedule = tune_problem(problem, problem.parameters)
    assert [[one.name for one in each.measured] for each in schedule.controllers] == [["frf:chirp"], []]
    assert schedule.met
    certificate = certify_problem(problem, schedule, problem.parameters)
    rows = [row for row in certificate.requirements if row.where.startswith("frf:chirp") or row.plant == "frf:chirp"]
    assert {row.place for row in rows} == {("k", own)} and all(row.met for row in rows)
    apart = path.read_text().replace("delay_s = 0.001", "delay_s = 0.001\nparameters = { k = 750000 }")
    path.write_text(apart)
    problem = so.read_problem(path)
    schedule = tune_problem(problem, problem.parameters)
    assert [[one.name for one in each.measured] for each in schedule.controllers] == [[], ["frf:chirp"]]
    path.write_text(apart.replace("\nparameters = { k = 750000 }", "").replace(f"{own}, 750000", "600000, 750000"))
    problem = so.read_problem(path)
    with pytest.raises(
        ControlError, match=r"taken at k = 655000, and no point is there; give points = \[600000, 655000"
    ):
        tune_problem(problem, problem.parameters)


def test_without_a_model_no_fit_is_needed_and_points_are_certified(write, tmp_path, without_drawing):
    path = write("frf:chirp", "").rename(tmp_path / "points.toml")
    path.write_text(path.read_text().split("[robustness]")[0])
    out, run = tmp_path / "out", CliRunner()
    result = run.invoke(app, ["tune", str(path), "-o", str(out)])
    assert result.exit_code == 0 and "every limit met on measured points" in result.stdout
    stored = json.loads((out / "controller.json").read_text())
    assert stored["measured_responses"][0]["stable"] and stored["fit_met"]
    assert stored["achieved"]["bandwidth_hz"] == 30.0
    certified = run.invoke(app, ["certify", str(path), "-o", str(out)])
    assert certified.exit_code == 0 and "without a model" in " ".join(certified.stdout.split())
    robustness = json.loads((out / "robustness.json").read_text())
    names = {row["name"]: row for row in robustness["requirements"]}
    assert {"max_sensitivity", "bandwidth_hz", "max_noise_gain", "spectral_radius"} <= set(names)
    assert robustness["plants"] == {} and robustness["monte_carlo"]["samples"] == 0
    assert names["max_sensitivity"]["value"] == pytest.approx(stored["achieved"]["ms"], rel=1e-9)
    page = run.invoke(app, ["report", str(path), "-o", str(out)])
    assert page.exit_code == 0 and "without a model" in (out / "report.html").read_text()
    swept = run.invoke(app, ["tune", str(path), "-o", str(out), "--sweep", "25:30:5"])
    assert swept.exit_code == 0
    assert [row["feasible"] for row in json.loads((out / "frontier.json").read_text())["rows"]] == [True, True]


def test_a_law_that_breaks_limits_fails_on_points_and_models_are_refused(write):
    problem = so.read_problem(write("frf:chirp", ""))
    controller = tune_problem(problem, problem.parameters)
    measured = problem.measure_responses(problem.parameters)
    params, points = problem.parameters, {"frf:chirp": measured["frf:chirp"]}
    assert so.certify(controller, {}, params, measured=points).passed
    hot = replace(controller, law=controller.law.scaled(1.6))
    failed = so.certify(hot, {}, params, measured=points)
    broken = {row.name for row in failed.requirements if not row.met}
    assert not failed.passed and "max_sensitivity" in broken and repr(failed).startswith("not met")
    # The truth is the stand: what the discs call broken is so on the plant that made the log.
    assert hot.close(problem.plants["stand"], problem.values(params)).figures().ms > 1.7
    with pytest.raises(ControlError, match="designed on a measured response"):
        so.certify(controller, {"stand": problem.plants["stand"]}, params, measured=points)
    with pytest.raises(ControlError, match="measured="):
        so.certify(controller, {}, params)


@pytest.mark.slow
def test_a_fit_in_which_nothing_is_free_is_diagnosed(write):
    problem = so.read_problem(write("frf:chirp", ""))
    assert "chirp" in repr(so.diagnose(so.fit(problem.experiments(), problem.parameters)))


@pytest.mark.parametrize(
    ("plant", "others", "said"),
    [("stand", '"frf:chrip"', "chirp"), ("frf:other", "", "controller.plant"), ("stand", '"frf:"', "robust_to")],
)
def test_a_response_of_no_experiment_is_refused(write, plant, others, said):
    with pytest.raises(ProblemError, match=said):
        so.read_problem(write(plant, others))
