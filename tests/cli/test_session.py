"""What stages say, refuse and take from each other, asked in this process: quicker than the command."""

from __future__ import annotations

import json
import re
import shutil
import time
from io import StringIO
from threading import enumerate as enumerate_threads

import numpy as np
import pytest

import seaopt as so
from seaopt.cli.export import export_controller
from seaopt.cli.main import run
from seaopt.cli.provenance import digest_sources
from seaopt.cli.session import Session
from seaopt.cli.terminal import Terminal
from seaopt.files import seal
from seaopt.logs import write_log

BENCH = """
schema = 1
[parameters]
J = { value = 3e-6, free = true, min = 1e-8, max = 1e-4 }
[plant.stand]
kind = "high_impedance"
[[experiment]]
name = "lines"
plant = "stand"
[experiment.virtual]
seed = 1
duration_s = 2
rate_hz = 400
noise_std = { F1 = 2.0 }
truth = { J = 3.31e-6 }
excitation = { multisine = { amplitudes = [1.0, 1.0], frequencies_hz = [5.0, 15.0] } }
"""


@pytest.fixture
def write(tmp_path):
    def _write(text, name="problem.toml"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return _write


def test_a_run_without_a_controller_says_what_it_left_out(write, tmp_path, capsys, without_drawing):
    path = write(BENCH + "[robustness]\nparameters = { f_c = [0.0, 0.01] }\n")
    run(path, tmp_path / "out")
    told = " ".join(capsys.readouterr().err.split())
    assert "writing the report: 5 figures" in told
    assert f"left out: tuning and certifying: {path} has [robustness] but no [controller]; add one" in told
    for stage in ("tune", "certify"):
        with pytest.raises(so.SeaoptError, match=r"has no \[controller\]; add one to tune or certify"):
            Session(path, tmp_path / "out").run(stage)


def test_a_fit_of_one_more_log_goes_on_from_the_folder_s(write, tmp_path, capsys):
    """Only where all else is as it was: with another bound, and with the same logs again, it begins afresh."""
    more = BENCH.replace('name = "lines"', 'name = "more"').replace("seed = 1", "seed = 2")
    both = BENCH + more[more.index("[[experiment]]") :]

    def fit(text, folder):
        session = Session(write(text), tmp_path / folder)
        session.run("fit")
        return session.results["fit"], "goes on from the values of" in " ".join(capsys.readouterr().err.split())

    afresh, went_on = fit(both, "new")
    assert not went_on
    one, went_on = fit(BENCH, "out")
    assert not went_on
    going_on, went_on = fit(both, "out")
    assert went_on
    assert going_on.parameters["J"].value == pytest.approx(afresh.parameters["J"].value, rel=1e-6)
    assert going_on.parameters["J"].std == pytest.approx(afresh.parameters["J"].std, rel=1e-3)
    assert one.parameters["J"].value != going_on.parameters["J"].value
    assert not fit(both, "out")[1]
    fit(BENCH, "out")
    assert not fit(both.replace("max = 1e-4", "max = 1e-3"), "out")[1]


def test_simulate_writes_the_model_and_the_virtual_log(write, tmp_path, capsys):
    """The log has the true inertia and a noise of 2 N, the model the file's values and no noise."""
    problem = so.read_problem(write(BENCH))
    session = Session(write(BENCH), tmp_path / "out")
    session.run("simulate")
    session.show(False, ["simulate"])
    told = capsys.readouterr().out
    assert "simulation_NAME.csv: the plant with the values" in told and "virtual_NAME.csv: the log of" in told
    channels = {"I": "I [A]", "F1": "F1 [N]"}
    model, bench = (
        so.read_log(tmp_path / "out" / f"{kind}_lines.csv", time="time [s]", channels=channels)
        for kind in ("simulation", "virtual")
    )
    truth = so.simulate(problem.plants["stand"], problem.parameters.update(J=3.31e-6), bench)
    assert np.std(bench["F1"] - truth["F1"]) == pytest.approx(2.0, rel=0.1)
    first = so.simulate(problem.plants["stand"], problem.parameters, bench)
    np.testing.assert_allclose(model["F1"], first["F1"], atol=1e-9)


DESIGN = """
schema = 1
[parameters]
J = { value = 3.31e-6, prior_std = 1e-8, min = 1e-8, max = 1e-4 }
eta = { value = 0.95, max = 2.0 }
[plant.stand]
kind = "high_impedance"
[plant.swing]
kind = "moving_output"
[[experiment]]
name = "lines"
plant = "stand"
virtual = { seed = 1, duration_s = 2, rate_hz = 400, excitation = { noise = { std = 1.0, band_hz = 50 } } }
[controller]
plant = "stand"
bandwidth_hz = 30
max_sensitivity = 1.6
[robustness]
plants = ["swing"]
parameters = { I_p = [0.3, 0.5] }
samples = 60
"""
CORNERS = DESIGN.replace("max_sensitivity", 'robust_to = ["swing"]\nmax_sensitivity')
DRAWS = DESIGN.replace("max_sensitivity", "draws = 4\nmax_sensitivity")
RETUNE = DESIGN + "retune = 2\n"
MORE = '\n[plant.heavy]\nkind = "moving_output"\nparts = ["load_cell"]\n[[experiment]]'


@pytest.mark.parametrize(
    ("text", "old", "new", "changed"),
    [
        (DESIGN, "samples = 60", "samples = 70", "certify"),
        (DESIGN, "samples = 60", "samples = 60\nseed = 9", "certify"),
        (DESIGN, "[0.3, 0.5]", "[0.2, 0.5]", "certify"),
        (DESIGN, "samples = 60", "samples = 60\ncurrent_step_A = 0.01", "certify"),
        (DESIGN, '["swing"]', "[]", "certify"),
        (DESIGN, "\n[[experiment]]", MORE, ""),
        (DESIGN, "schema = 1", 'schema = 1\ntitle = "another"', ""),
        (DESIGN, "max_sensitivity = 1.6", "max_sensitivity = 1.5", "tune"),
        (DESIGN, "J = ", "m_l = 0.7\nJ = ", "fit tune certify"),
        (DESIGN, "J = ", "I_p = 0.4\nJ = ", "certify"),
        (DESIGN, "duration_s = 2", "duration_s = 3", "fit"),
        (DESIGN, "samples = 60", "samples = 60\nretune = 2", "tune"),
        (CORNERS, "samples = 60", "samples = 60\nseed = 9", "certify"),
        (CORNERS, "[0.3, 0.5]", "[0.2, 0.5]", "tune certify"),
        (CORNERS, "J = ", "I_p = 0.4\nJ = ", "tune certify"),
        (DRAWS, "samples = 60", "samples = 70", "certify"),
        (DRAWS, "samples = 60", "samples = 60\nseed = 9", "tune certify"),
        (DRAWS, "prior_std = 1e-8", "prior_std = 2e-8", "fit tune certify"),
        (RETUNE, "samples = 60", "samples = 70", "tune certify"),
        (RETUNE, "retune = 2", "retune = 3", "tune"),
        (RETUNE, '["swing"]', "[]", "tune certify"),
    ],
)
def test_a_result_counts_what_it_depends_on(write, tmp_path, text, old, new, changed):
    assert old in text
    before, after = so.read_problem(write(text)), so.read_problem(write(text.replace(old, new, 1), "after.toml"))
    stages = ("fit", "tune", "certify")
    moved = [
        stage for stage in stages if digest_sources(before, stage, tmp_path) != digest_sources(after, stage, tmp_path)
    ]
    assert moved == changed.split()


@pytest.mark.slow
def test_one_controller_answers_new_questions_and_no_others(write, tmp_path, capsys, without_simulation):
    """Without experiments, so that nothing is fitted; a certificate of an old controller is refused too."""
    text = DESIGN[: DESIGN.index("[[experiment]]")] + DESIGN[DESIGN.index("[controller]") :]
    folder = tmp_path / "out"
    Session(write(text), folder).run("tune")
    held = (folder / "controller.json").read_bytes()
    for old, new in (("samples = 60", "samples = 20"), ("[0.3, 0.5]", "[0.4, 0.5]")):
        session = Session(write(text.replace(old, new)), folder)
        session.run("certify")
    assert session.results["certify"].monte_carlo.samples == 60
    session.show(False, ["certify"])
    told = capsys.readouterr()
    remark = "note the nominal I_p = 0.36 lies outside its range of 0.4 to 0.5"
    assert remark in " ".join(told.out.split())
    assert (folder / "controller.json").read_bytes() == held
    with pytest.raises(so.SeaoptError, match=r"robustness.json: was made from another.*run seaopt certify"):
        Session(write(text), folder).run("report")
    with pytest.raises(so.SeaoptError, match=r"controller.json: was made from another.*run seaopt tune"):
        Session(write(text.replace("max_sensitivity = 1.6", "max_sensitivity = 1.5")), folder).run("certify")


def test_a_law_that_no_round_certifies_has_the_reason_beside_it(write, tmp_path, capsys):
    text = DESIGN[: DESIGN.index("[[experiment]]")] + DESIGN[DESIGN.index("[controller]") :]
    text = text.replace("[0.3, 0.5]", "[0.02, 2.0]").replace("samples = 60", "samples = 20\nretune = 1")
    session = Session(write(text), tmp_path / "out")
    session.run("tune")
    session.show(False, ["tune"])
    told = " ".join(capsys.readouterr().out.split())
    assert told.startswith("not met Joint tuning: NOT certified (rounds, 1 round)")
    assert "1 round was too few: " in told[: told.index("met Controller")]


@pytest.fixture(scope="module")
def tuned_once(tmp_path_factory):
    """Return a problem's text without experiments, and the folder of its controller, which ranges shaped."""
    text = CORNERS[: CORNERS.index("[[experiment]]")] + CORNERS[CORNERS.index("[controller]") :]
    path = tmp_path_factory.mktemp("tuned") / "problem.toml"
    path.write_text(text, encoding="utf-8")
    Session(path, path.parent / "out").run("tune")
    return text, path.parent / "out"


@pytest.fixture
def tuned(tuned_once, tmp_path):
    """Return the same text, and a copy of that folder for a test to change."""
    text, folder = tuned_once
    return text, shutil.copytree(folder, tmp_path / "out")


def edit(folder, changes, *, sealed):
    """Change entries of controller.json; `sealed` gives it the digest of what it is then."""
    content = json.loads((folder / "controller.json").read_text(encoding="utf-8"))
    for key, value in changes.items():
        content[key] = {**content[key], **value} if isinstance(value, dict) else value
    content = seal(content) if sealed else content
    (folder / "controller.json").write_text(json.dumps(content), encoding="utf-8")
    return content


def test_a_controller_that_ranges_shaped_answers_for_others(write, tuned, capsys, without_simulation):
    text, folder = tuned
    session = Session(write(text.replace("[0.3, 0.5]", "[0.1, 0.5]")), folder)
    session.run("certify")
    assert session.results["certify"].varied[-1].low == 0.1
    assert "another [robustness]" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("changes", [{"spec": {"max_sensitivity": 99.0}}, {"feasible": False}, {"gains": {"k_p": 9.0}}])
def test_an_edited_controller_is_refused(write, tuned, tmp_path, changes):
    text, folder = tuned
    edit(folder, changes, sealed=False)
    with pytest.raises(so.SeaoptError, match=r"was edited.*run seaopt tune"):
        Session(write(text), folder).law()
    with pytest.raises(so.SeaoptError, match=r"was edited.*run seaopt tune"):
        export_controller(folder, tmp_path / "c", json=False)


def test_a_controller_is_judged_by_the_problems_limits(write, tuned):
    text, folder = tuned
    held = edit(folder, {}, sealed=True)
    assert Session(write(text), folder).law().gains == held["gains"]
    edit(folder, {"spec": {"max_sensitivity": 99.0}}, sealed=True)
    with pytest.raises(so.SeaoptError, match=r"spec.max_sensitivity is 99.0, and .*asks for 1.6"):
        Session(write(text), folder).law()


def test_feasible_is_found_out_again(write, tuned):
    """The loop of this law has Ms 1.3 or so, by the tests of the tuner; asked for 1.05, it is not feasible."""
    text, folder = tuned
    content = edit(folder, {"feasible": True, "spec": {"max_sensitivity": 1.05}}, sealed=True)
    problem = so.read_problem(write(text))
    controller = so.Controller.from_dict(content, problem.design_plant, problem.parameters)
    assert not controller.feasible
    assert "max_sensitivity (design plant)" in controller.active_constraints


def test_a_fit_made_again_from_the_same_file_keeps_its_controller(write, tmp_path, monkeypatch):
    """How long a fit took, and on what, is part of no digest."""
    path = write(BENCH + '[controller]\nplant = "stand"\nbandwidth_hz = 30\n')
    Session(path, tmp_path).run("fit")
    Session(path, tmp_path).run("tune")
    before = json.loads((tmp_path / "fit.json").read_text(encoding="utf-8"))
    monkeypatch.setattr("platform.python_version", lambda: "4.0")
    Session(path, tmp_path).run("fit")
    after = json.loads((tmp_path / "fit.json").read_text(encoding="utf-8"))
    assert after["provenance"] != before["provenance"] and after["provenance"]["python"] == "4.0"
    assert after["made_from"] == before["made_from"] and "wall_s" not in after
    Session(path, tmp_path).law()  # is not refused


def test_logs_that_are_not_fitted_are_scored(write, tmp_path, capsys):
    """An experiment with use = "validate", and its log by `seaopt validate`: the same score, that of the noise."""
    stand, thor = so.plants.high_impedance(), so.plants.thor()
    for name, seed in (("first", 1), ("second", 2)):
        log = so.virtual_log(
            stand, thor, so.bench.PAPER_STAND, duration_s=5, rate_hz=400, seed=seed, initial_state={"q": 3e-4},
            sensors=so.Sensors(noise_std={"F1": 20.0}, offset={"F1": 100.0 * seed}),
        )  # fmt: skip
        write_log(log, tmp_path / f"{name}.csv")
    text = '[[experiment]]\nname = "{0}"\nplant = "stand"\nlog = "{0}.csv"\n{1}'
    columns = 'time = "time [s]"\ninputs = { I = "I [A]" }\noutputs = { F1 = "F1 [N]" }\n'
    header = BENCH.split("[[experiment]]")[0]
    path = write(header + text.format("first", columns) + text.format("second", 'use = "validate"\n' + columns))
    session = Session(path, tmp_path / "out")
    session.run("fit")
    stored = json.loads((tmp_path / "out" / "fit.json").read_text(encoding="utf-8"))
    assert list(stored["outputs"]) == ["first"] and stored["met"] is True
    scored = stored["validation"]["second"]["F1"]
    assert scored["rms_residual"] == pytest.approx(20.0, rel=0.05)
    capsys.readouterr()
    Session(path, tmp_path / "out").validate(tmp_path / "second.csv", None, as_json=False, amount="quiet")
    told = " ".join(capsys.readouterr().out.split())
    assert told.endswith(f"second.csv: F1 {scored['fit_percent']:.2f} %")
    Session(path, tmp_path / "out").validate(tmp_path / "second.csv", None, as_json=True)
    again = json.loads(capsys.readouterr().out)
    assert again["outputs"]["F1"]["fit_percent"] == pytest.approx(scored["fit_percent"], abs=1e-6)
    assert again["met"] is True and all(row["distance"] < 3.0 for row in again["values"].values())


def test_a_design_on_a_fit_that_is_not_met_says_so(write, tmp_path, capsys):
    """The stiffness is known to be twice what it is and the sensors tell: fit, tune and export exit with 1."""
    wrong = BENCH.replace("[plant.stand]", "k = 1310000\nb_r = { value = 1e-4, free = true }\n[plant.stand]")
    wrong = wrong.replace("duration_s = 2", "duration_s = 10").replace("F1 = 2.0", "F1 = 0.5, F2 = 0.5")
    wrong = wrong.replace("truth = { J", "truth = { k = 655000, J").replace(
        "multisine = { amplitudes = [1.0, 1.0], frequencies_hz = [5.0, 15.0] }", "noise = { std = 3.0, band_hz = 150 }"
    )
    path = write(wrong + '[controller]\nplant = "stand"\nmeasured = "F1"\nbandwidth_hz = 30\nsample_rate_hz = 1000\n')
    session = Session(path, tmp_path / "out")
    for stage in ("fit", "tune"):
        session.run(stage)
    assert not session.met(["fit"]) and not session.met(["tune"])
    session.show(False, ["fit", "tune"])
    out = capsys.readouterr().out
    assert out.startswith("not met  Fit: ") and "on a fit that is not met" in out
    controller = json.loads((tmp_path / "out" / "controller.json").read_text(encoding="utf-8"))
    assert controller["fit_met"] is False
    assert not export_controller(tmp_path / "out", tmp_path / "c", json=False)


def test_what_was_guessed_is_named_by_every_verdict_until_it_is_taken_out(write, tmp_path, capsys, without_drawing):
    known = BENCH.replace("[plant.stand]", "b_r = { value = 1e-4, free = true }\n[plant.stand]")
    known += '[controller]\nplant = "stand"\nmeasured = "F1"\nbandwidth_hz = 30\nsample_rate_hz = 1000\n'
    guessed = known.replace("schema = 1\n", 'schema = 1\nguessed = ["N_p", "unit of F1, F2"]\n')
    session = Session(write(guessed), tmp_path / "out")
    for stage in ("fit", "tune"):
        session.run(stage)
    session.show(False, ["fit", "tune"])
    out = " ".join(capsys.readouterr().out.split())
    lines = out.split("met ")[1:3]
    assert all("on 2 guesses: N_p, unit of F1, F2" in line for line in lines)
    content = json.loads((tmp_path / "out" / "fit.json").read_text(encoding="utf-8"))
    (finding,) = (one for one in content["findings"] if one["kind"] == "guess")
    assert finding["severity"] == "warning" and finding["where"] == "on 2 guesses: N_p, unit of F1, F2"
    assert so.Fit.from_dict(content).verdict.endswith("on 2 guesses: N_p, unit of F1, F2")
    session.run("report")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert page.count("every limit met, on 2 guesses: N_p, unit of F1, F2") >= 1
    controller = json.loads((tmp_path / "out" / "controller.json").read_text(encoding="utf-8"))
    assert controller["guessed"] == ["N_p", "unit of F1, F2"]
    with pytest.raises(so.SeaoptError, match=r"made from another problem file .*; is .* the file of"):
        Session(write(known), tmp_path / "out").parameters()


def test_a_long_stage_writes_its_progress_to_a_file(write, tmp_path, monkeypatch, capsys):
    """At most one line per interval, also while the stage tells nothing; none where it ends before."""
    monkeypatch.setattr("seaopt.cli.progress.REPORT_S", 0.2)

    def take_long(session, tell):
        tell("iteration 3, cost 12.5", 0.5)
        time.sleep(0.7)

    monkeypatch.setattr(Session, "_fit", take_long)
    session = Session(write(BENCH), tmp_path / "out")
    session.run("fit")
    *lines, last = capsys.readouterr().err.splitlines()
    assert 1 <= len(lines) <= 3 and last == "fitting the logs: iteration 3, cost 12.5"
    assert all(line.startswith("fitting the logs, ") and "iteration 3, cost 12.5" in line for line in lines)
    monkeypatch.setattr(Session, "_fit", lambda session, tell: tell("reading logs", 0.0))
    session.run("fit")
    assert capsys.readouterr().err == "fitting the logs: reading logs\n"

    def fail(session, tell):
        raise so.SeaoptError("wrong")

    monkeypatch.setattr(Session, "_fit", fail)
    with pytest.raises(so.SeaoptError):
        session.run("fit")
    assert not capsys.readouterr().err and "write_lines" not in " ".join(thread.name for thread in enumerate_threads())


@pytest.mark.slow
def test_a_terminal_is_told_the_time_that_is_left(write, tmp_path, monkeypatch):
    """Of real stages, which take longer than a short while; a remark stays below the bar."""
    monkeypatch.setattr("seaopt.cli.progress.SHOWN_AFTER_S", 0.0)
    text = DESIGN[: DESIGN.index("[[experiment]]")] + DESIGN[DESIGN.index("[controller]") :]
    session = Session(write(text), tmp_path / "out")
    for stage in ("tune", "certify"):
        shown = StringIO()
        session._console = Terminal(file=shown, force_terminal=True, width=100)
        session.run(stage)
        assert re.search(r"\d+ (s|min) left", shown.getvalue()), shown.getvalue()

    def certify(_, tell):
        tell("worth keeping")
        tell("running", 0.5)

    monkeypatch.setattr(Session, "_certify", certify)
    session.run("certify")
    assert "note: worth keeping" in shown.getvalue()


@pytest.mark.slow
def test_a_law_of_ones_own_is_certified_as_the_tuned_one(write, tmp_path):
    """The tuned law given back as matrices has its certificate; a controller that was tuned is not written over."""
    path = write(
        'schema = 1\n[plant.stand]\nkind = "high_impedance"\n[controller]\nplant = "stand"\nmeasured = "F1"\n'
        "bandwidth_hz = 30\nmax_sensitivity = 1.6\n[robustness]\nsamples = 20\nparameters = { b_r = [5e-5, 2e-4] }\n"
    )
    tuned, mine = tmp_path / "tuned", tmp_path / "mine"
    for stage in ("tune", "certify"):
        Session(path, tuned).run(stage)
    session = Session(path, mine)
    session.take_law(tuned / "controller.json")
    session.run("certify")
    one, other = (json.loads((folder / "robustness.json").read_text()) for folder in (tuned, mine))
    for name in ("ms", "mt", "bandwidth_hz", "disk_margin"):
        assert one["plants"]["stand"][name] == pytest.approx(other["plants"]["stand"][name], rel=1e-6)
    assert one["passed"] == other["passed"]
    assert json.loads((mine / "controller.json").read_text())["structure"] == "custom"
    with pytest.raises(so.SeaoptError, match="give the law another folder"):
        Session(path, tuned).take_law(tuned / "controller.json")
    wrong = write('sample_rate_hz = 1000\ndelay_samples = 1\nmeasured = "F2"\n[pid]\nk_p = 1.0\n', "law.toml")
    with pytest.raises(so.SeaoptError, match='measured = "F2"'):
        Session(path, mine).take_law(wrong)


def test_what_was_done_has_a_verdict_where_a_later_stage_fails(folder, seaopt, design, monkeypatch):
    (folder / "problem.toml").write_text(design, encoding="utf-8")
    monkeypatch.setattr(Session, "_certify", lambda *_: (_ for _ in ()).throw(so.SeaoptError("no room; make some")))
    done = seaopt("run", "problem.toml", "-o", "out")
    assert done.returncode == 2
    assert "no room" in done.stderr
    assert "Controller" in done.stdout.splitlines()[0]
