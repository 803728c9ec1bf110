"""The command as a user runs it: exit codes, one-line errors, JSON on stdout, nothing half written."""

from __future__ import annotations

import json
import re

import pytest

import seaopt as so
from seaopt.reporting.responses import Responses


def test_run_leaves_everything(done):
    assert done.returncode == 0, done.stderr
    for name in (
        "fit.json",
        "controller.json",
        "robustness.json",
        "report.html",
        "figures/loop.svg",
        "figures/loop.png",
    ):
        assert (done.results / name).stat().st_size > 500
    assert not list(done.results.rglob(".*"))
    assert "Certificate: passed" in done.stdout
    assert "fitting the logs" in done.stderr
    assert "warning" not in done.stderr and "not identif" not in done.stdout
    fit = json.loads((done.results / "fit.json").read_text(encoding="utf-8"))
    assert fit["schema"] == "seaopt/fit/2"
    assert fit["status"] == "converged"
    for field in ("cost", "iterations", "samples", "provenance", "derived", "covariance", "outputs", "identifiability"):
        assert field in fit
    assert set(fit["outputs"]["chirp"]["F1"]) >= {
        "fit_percent",
        "holdout_fit_percent",
        "rms_residual",
        "sigma",
        "unit",
        "whiteness_p",
    }
    assert set(fit["derived"]) >= {"r", "m_k", "b_m", "natural_frequency_hz", "damping_ratio"}


def test_certify_simulates_and_looks_at_the_port(done):
    content = json.loads((done.results / "robustness.json").read_text(encoding="utf-8"))
    assert content["simulation"]["passed"]
    assert content["simulation"]["sensors"]["noise_std"] == {"F1": 2.0}
    assert {row["draw"] for row in content["simulation"]["rows"]} == {"nominal", "1"}
    assert content["passivity"]["environments"]["fixed_stable"]
    assert "34 runs passed" in done.stdout and "swing tracks references between" in done.stdout


@pytest.mark.slow
def test_a_simulation_that_fails_exits_1_with_its_witness(folder, seaopt, design):
    """A load cell that stops at 20 N never shows the force that is asked for."""
    text = design.replace("noise_std = { F1 = 2.0 }", "saturation = { F1 = 20.0 }").replace('["swing"]', "[]")
    text = text.replace("I_p = [0.2, 0.6]", "eta = [0.9, 1.0]")
    (folder / "clipped.toml").write_text(text, encoding="utf-8")
    assert seaopt("tune", "clipped.toml").returncode == 0
    out = seaopt("certify", "clipped.toml")
    assert out.returncode == 1, out.stderr
    words = " ".join(out.stdout.split())
    assert words.startswith("not met Certificate: failed, ") and words.count("steady_error") == 1
    assert ": stand, " in words and ", seed 1 at eta = 1: the force ends" in words
    assert "seaopt tune clipped.toml -o out" in words


@pytest.mark.slow
def test_retune_tunes_until_certified(folder, seaopt, design, without_drawing, without_simulation):
    ranges = "I_p = [0.2, 0.6], delay_s = [0.0, 4e-4]"
    text = design.replace("I_p = [0.2, 0.6]", ranges) + "retune = 4\nbounds = true\n"
    (folder / "retune.toml").write_text(text.replace('robust_to = ["swing"]', ""), encoding="utf-8")
    out = seaopt("run", "retune.toml", "-o", "retune")
    assert out.returncode == 0, out.stdout + out.stderr
    assert "Joint tuning: certified in 2 rounds" in out.stdout
    assert "Certificate: passed" in out.stdout
    worst = json.loads((folder / "retune" / "robustness.json").read_text(encoding="utf-8"))["plants"]["swing"]["worst"]
    assert worst["bounded_stable"]
    assert worst["ms"] <= worst["ms_upper"] <= 1.012 * worst["ms"]
    assert "swing: bounded, rounding estimated: all stable" in (folder / "retune" / "report.html").read_text(
        encoding="utf-8"
    )
    plants = json.loads((folder / "retune" / "controller.json").read_text(encoding="utf-8"))["spec"]["robust_to"]
    assert any("round 1" in name for name in plants)


def test_the_fit_stage_is_the_fit_of_the_library(folder, seaopt):
    out = seaopt("fit", "short.toml", "-o", "steps", "--json")
    assert out.returncode == 0, out.stderr
    stored = json.loads((folder / "steps" / "fit.json").read_text(encoding="utf-8"))
    assert json.loads(out.stdout) == stored
    problem = so.read_problem(folder / "short.toml")
    direct = so.fit(problem.experiments(), problem.parameters, **problem.fit_options)
    assert stored["parameters"].keys() == direct.parameters.keys()
    for name, parameter in direct.parameters.items():
        assert stored["parameters"][name]["value"] == pytest.approx(parameter.value, rel=1e-9)
        if parameter.free:
            assert stored["parameters"][name]["std"] == pytest.approx(parameter.std, rel=1e-9)


@pytest.mark.slow
def test_stages_one_by_one_give_the_same_files(copied, seaopt, done, without_drawing, without_simulation):
    """From the same fit.json: what a stage reads is what an earlier one would have handed on."""
    for name in ("controller.json", "robustness.json", "report.html"):
        (copied / "all" / name).unlink()
    for stage in ("tune", "certify", "report"):
        step = seaopt(stage, "short.toml", "-o", "all")
        assert step.returncode == 0, step.stderr
    for name in ("controller.json", "robustness.json"):
        whole, steps = (json.loads((f / name).read_text(encoding="utf-8")) for f in (done.results, copied / "all"))
        if name == "controller.json":
            assert steps["gains"] == pytest.approx(whole["gains"], rel=1e-6)
            assert steps["measurement"]["num"] == pytest.approx(whole["measurement"]["num"], rel=1e-6)
        else:
            assert steps["monte_carlo"] == whole["monte_carlo"]
            whole_met, steps_met = (
                {(row["name"], row["where"]): row["met"] for row in content["requirements"]}
                for content in (whole, steps)
            )
            # By the whole path every scenario, whose steps are asked for too; here none.
            simulated = {key for key in whole_met if key[0].startswith(("simulation_", "step_"))}
            assert len({name for name, _ in simulated}) > 1
            assert steps_met.keys() == whole_met.keys() - simulated
            assert all(steps_met.values()) and all(whole_met.values())
    page = (copied / "all" / "report.html").read_text(encoding="utf-8")
    assert "Parameters" in page and "Margins on every plant" in page and "Requirements" in page


@pytest.mark.parametrize(
    ("old", "new", "stage", "words"),
    [
        ("max_sensitivity = 1.6", "max_sensitivity = 1.2", "certify", "run seaopt tune"),
        ("holdout = 0.2", "holdout = 0.1", "tune", "run seaopt fit"),
    ],
)
def test_results_of_another_problem_are_refused(folder, seaopt, done, short, old, new, stage, words):
    (folder / "edited.toml").write_text(short.replace(old, new), encoding="utf-8")
    out = seaopt(stage, "edited.toml", "-o", done.results)
    assert out.returncode == 2
    assert words in out.stderr


def test_a_controller_of_another_fit_is_not_exported(copied, seaopt):
    assert seaopt("export", "all", "--c", "firmware").returncode == 0
    fit = json.loads((copied / "all" / "fit.json").read_text(encoding="utf-8"))
    fit["parameters"]["J"]["value"] *= 1.001
    (copied / "all" / "fit.json").write_text(json.dumps(fit), encoding="utf-8")
    out = seaopt("export", "all", "--c", "other")
    assert out.returncode == 2
    assert "was tuned with another fit" in out.stderr
    assert not (copied / "other").exists()


OPEN = ("[plant.stand]", "K_tau = { value = 0.0255, free = true }\n[plant.stand]", 1)  # only eta K_tau is seen


def test_a_wrong_controller_keeps_no_fit_from_its_logs(folder, seaopt, stand_alone):
    problem, said = folder / "stand.toml", "bandwidth_hz = 3 is outside 15 to 60"
    problem.write_text(stand_alone.replace("bandwidth_hz = 30", "bandwidth_hz = 3"), encoding="utf-8")
    out = seaopt("fit", "stand.toml")
    assert out.returncode == 0 and f"warning: stand.toml: {said}" in out.stderr
    out = seaopt("tune", "stand.toml")
    assert out.returncode == 2 and said in out.stderr


def test_an_unidentifiable_fit_exits_1_with_a_report(folder, seaopt, stand_alone, without_drawing, without_causes):
    text = stand_alone.replace(*OPEN).replace("duration_s = 20", "duration_s = 4")
    (folder / "open.toml").write_text(text, encoding="utf-8")
    out = seaopt("run", "open.toml", "-o", "open")
    assert out.returncode == 1
    assert "enter only together" in out.stdout
    assert "left out: tuning and certifying: they need a fit that has converged" in out.stderr
    assert (folder / "open" / "report.html").exists()
    assert not (folder / "open" / "controller.json").exists()
    assert not list(folder.rglob(".*"))


@pytest.mark.slow
def test_values_that_the_fit_does_not_identify_are_named_wherever_they_are_used(
    folder, seaopt, stand_alone, without_simulation
):
    ranges = "I_p = [0.2, 0.6], K_tau = [0.024, 0.027], eta = [0.9, 1.0]"
    text = stand_alone.replace(*OPEN).replace("I_p = [0.2, 0.6]", ranges)
    (folder / "ranged.toml").write_text(text.replace("max_sensitivity = 1.6", "max_sensitivity = 1.8"), "utf-8")
    assert seaopt("fit", "ranged.toml").returncode == 1
    for stage, file in (("tune", "controller.json"), ("certify", "robustness.json")):
        out = seaopt(stage, "ranged.toml")
        assert "warning: the fit does not identify K_tau and eta: K_tau = 0.0" in out.stderr
        assert "note the fit does not identify K_tau and eta: K_tau = 0.0" in " ".join(out.stdout.split())
        note = json.loads((folder / "out" / file).read_text(encoding="utf-8"))["notes"][0]
        assert "K_tau" in note and " b_r" not in note


def test_json_on_stdout_is_the_file(copied, seaopt):
    out = seaopt("tune", "short.toml", "-o", "all", "--json")
    assert json.loads(out.stdout) == json.loads((copied / "all" / "controller.json").read_text(encoding="utf-8"))


def test_simulate_writes_csv(folder, seaopt):
    out = seaopt("simulate", "short.toml", "-o", "sim")
    assert out.returncode == 0, out.stderr
    log = so.read_log(folder / "sim" / "simulation_chirp.csv", time="time [s]", channels={"F1": "F1 [N]"})
    assert len(log) == 8000


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("fit", "nothing.toml"), "seaopt new LOG -o nothing.toml"),
        (("tune", "short.toml", "-o", "empty"), "run seaopt fit"),
        (("certify", "short.toml", "-o", "empty"), "run seaopt fit"),
        (("report", "short.toml", "-o", "empty"), "run seaopt fit"),
        (("fit", "short.toml", "-o", "short.toml"), "is a file"),
        (("fit", "."), "is a folder.*toml"),
        (("tune", "rotary.toml"), 'write measured = "tau_s" in \\[controller\\]'),
        (("fit", "speed.toml"), 'differences = { speed = { of = "theta_m" } }'),
        (("fit", "bristles.toml"), "leave out sticks = true"),
        (("export", "empty", "--c", "c"), "seaopt run PROBLEM -o empty"),
        (("schema", "robust"), 'did you mean "robustness"'),
        (("tune", "wide.toml"), "bandwidth_hz = 99 is outside 15 to 60"),
        (("fit", "column.toml"), 'no column "F1 \\[kN\\]"'),
    ],
)
def test_bad_input_is_one_line_and_exits_2(folder, seaopt, short, arguments, words):
    (folder / "wide.toml").write_text(short.replace("bandwidth_hz = 30", "bandwidth_hz = 99"), encoding="utf-8")
    (folder / "log.csv").write_text("time [s],I [A],F1 [N]\n0,1,2\n0.1,1,2\n", encoding="utf-8")
    rotary = 'schema = 1\n[plant.a]\nkind = "rotary"\n'
    (folder / "rotary.toml").write_text(rotary + '[controller]\nplant = "a"\nbandwidth_hz = 15\n', encoding="utf-8")
    (folder / "bristles.toml").write_text(rotary + 'parts = ["lugre"]\nsticks = true\n', encoding="utf-8")
    columns = 'log = "log.csv"\ninputs = { I = "I [A]" }\noutputs = { speed = "F1 [N]" }\n'
    (folder / "speed.toml").write_text(rotary + f'[[experiment]]\nname = "x"\nplant = "a"\n{columns}', encoding="utf-8")
    (folder / "column.toml").write_text(
        'schema = 1\n[parameters]\nJ = { value = 1e-6, free = true }\n[plant.a]\nkind = "high_impedance"\n'
        '[[experiment]]\nname = "x"\nplant = "a"\nlog = "log.csv"\ntime = "time [s]"\ninputs = { I = "I [A]" }\n'
        'outputs = { F1 = "F1 [kN]" }\n',
        encoding="utf-8",
    )
    out = seaopt(*arguments)
    assert out.returncode == 2
    (last,) = out.stderr.strip().splitlines()
    assert last.startswith("seaopt: ")
    assert re.search(words, last)
    assert not list((folder / "empty").glob("*")) and not list(folder.rglob(".*"))


@pytest.mark.parametrize(
    ("document", "key"), [("problem", "plant"), ("fit", "covariance"), ("robustness", "monte_carlo")]
)
def test_schema_prints_a_json_schema(seaopt, document, key):
    schema = json.loads(seaopt("schema", document).stdout)
    assert schema["type"] == "object" and key in schema["required"]


def test_unknown_options_exit_2(seaopt):
    assert seaopt("fit", "short.toml", "--fast").returncode == 2
    assert seaopt("fly").returncode == 2
    assert seaopt("--version").stdout.startswith("seaopt 0.")


def test_the_report_stands_alone(done):
    page = (done.results / "report.html").read_text(encoding="utf-8")
    for fetched in re.findall(r'(?:src|href)="([^"]+)"|url\(([^)]+)\)', page):
        assert "".join(fetched).startswith(("#", "data:image/png;base64,")), fetched
    assert "http" not in re.sub(r"http://www\.w3\.org/[\w/]+", "", page)  # names of vocabularies are not fetched
    assert (done.results / "report.html").stat().st_size < 6e6
    assert page.count('<figure class="chart"') == page.count('role="img"') == page.count("<figcaption>") > 40
    for words in (
        "Parameters", "How well the model fits", "Margins on every plant", "Requirements", "tracking band",
        "Simulation of the nonlinear plants", "Bandwidth against amplitude",
        "Contact with an environment", "Re Z is lowest at", "Coupled stability at link 2",
    ):  # fmt: skip
        assert words in page
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))


def test_frf_shows_and_writes_what_the_logs_say_in_frequency(copied, seaopt):
    out = seaopt("frf", "short.toml", "-o", "all")
    assert out.returncode == 0, out.stderr
    assert "in second order" in out.stdout and "efficiency" in out.stdout
    for name in ("frf.json", "frf.svg", "frf.png"):
        assert (copied / "all" / name).stat().st_size > 500
    content = json.loads((copied / "all" / "frf.json").read_text(encoding="utf-8"))
    assert content["schema"] == "seaopt/frf/1"
    pair = content["experiments"]["chirp"]["pairs"][0]
    assert (pair["input"], pair["output"], pair["unit"]) == ("I", "F1", "N/A")
    assert pair["fitted_misfit"] < pair["model_misfit"]
    assert pair["actuator"]["efficiency"]["value"] == pytest.approx(0.95, abs=0.01)
    assert len(pair["frequency_hz"]) == len(pair["coherence"]) == len(pair["real"]) == len(pair["imag"])
    fit = so.Fit.from_dict(json.loads((copied / "all" / "fit.json").read_text(encoding="utf-8")))
    read = Responses.from_dict(content, so.read_problem(copied / "short.toml"), fit)
    misfit = read.fitted_misfit("chirp", read.surveys["chirp"].pairs[0])
    assert misfit == pytest.approx(pair["fitted_misfit"], rel=1e-6)


def test_frf_of_shorter_stretches_without_a_fit(folder, seaopt, stand_alone, without_drawing):
    (folder / "alone.toml").write_text(stand_alone, encoding="utf-8")
    out = seaopt("frf", "alone.toml", "-o", "alone", "--json", "--stretch", "2.5")
    alone = json.loads(out.stdout)["experiments"]["chirp"]["pairs"][0]
    assert alone["frequency_hz"][0] == pytest.approx(0.4)
    assert alone["fitted_misfit"] is None


def test_frf_of_a_log_that_says_nothing_exits_1(folder, seaopt, stand_alone, without_drawing):
    drowned = stand_alone.replace("noise_std = { F1 = 2.0, F2 = 2.0 }", "noise_std = { F1 = 1e6, F2 = 1e6 }")
    (folder / "drowned.toml").write_text(drowned, encoding="utf-8")
    out = seaopt("frf", "drowned.toml", "-o", "drowned")
    assert out.returncode == 1, out.stderr
    assert "too little coherence in F1/I, F2/I" in out.stdout


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([(t / 400, 1.0, t % 7) for t in range(400)], "I is constant or absent"),
        ([(t / 400 + (t > 200), t % 3, t % 7) for t in range(400)], "2 segments between gaps"),
        ([(t / 400, t % 3, t % 7) for t in range(100)], "100 samples are too few"),
    ],
)
def test_frf_of_a_bad_log_is_one_line_and_exits_2(folder, seaopt, rows, words):
    lines = ["time [s],I [A],F1 [N]", *(f"{t:.6f},{i},{f}" for t, i, f in rows)]
    (folder / "bad.csv").write_text("\n".join(lines), encoding="utf-8")
    (folder / "bad.toml").write_text(
        'schema = 1\n[plant.a]\nkind = "high_impedance"\n[[experiment]]\nname = "x"\nplant = "a"\nlog = "bad.csv"\n'
        'time = "time [s]"\ninputs = { I = "I [A]" }\noutputs = { F1 = "F1 [N]" }\n',
        encoding="utf-8",
    )
    out = seaopt("frf", "bad.toml", "-o", "bad")
    assert out.returncode == 2
    (last,) = out.stderr.strip().splitlines()
    assert last.startswith("seaopt: bad.toml: experiment x: ") and words in last
    assert not list((folder / "bad").glob("*"))
