"""`seaopt accept`: files in, files out, exit codes."""

from __future__ import annotations

import json
import re
import shutil
from functools import partial

import numpy as np
import pytest

import seaopt as so
from seaopt.cli.main import app
from seaopt.cli.session import Session
from seaopt.errors import LogError
from seaopt.files import to_json, write_json
from seaopt.machine import bring_up
from seaopt.problem.loop_logs import read_loop_log
from seaopt.problem.proposal import propose
from seaopt.robustness.certificate.simulated import SIMULATIONS
from tests.c_code import CompiledLog
from tests.checks import leave_out
from tests.machine.simulator import Bench, Machine, multisine
from tests.machine.test_response import LINES

PROBLEM = """
schema = 1
title = "Stand"
parameters = { I_p = { value = 0.36, unit = "kg m^2" } }  # of the other plant alone
plant = { stand = { kind = "high_impedance" }, swing = { kind = "moving_output" } }
robustness = { plants = ["swing"], parameters = { I_p = [0.2, 0.6] }, samples = 5 }
controller = { plant = "stand", measured = "F1", bandwidth_hz = 30, max_sensitivity = 1.6, current_limit_A = 9.0 }
"""


@pytest.fixture(scope="module")
def folder(compiler, tmp_path_factory):
    """Return a folder with a problem, its controller, and logs of two machines."""
    from typer.testing import CliRunner

    home = tmp_path_factory.mktemp("accept")
    (home / "stand.toml").write_text(PROBLEM)
    with pytest.MonkeyPatch.context() as patch:
        leave_out(patch, SIMULATIONS)
        for command in ("tune", "certify"):
            assert CliRunner().invoke(app, [command, str(home / "stand.toml"), "-o", str(home / "out")]).exit_code == 0
    content = json.loads((home / "out" / "controller.json").read_text())
    problem = so.read_problem(home / "stand.toml")
    controller = so.Controller.from_dict(content, problem.design_plant, problem.values(problem.parameters))
    bench, reference = Bench(compiler, home, controller), multisine(1000, LINES, 8, 60.0, 3, bias=300.0)
    so.write_log(bench.log(Machine(), reference, decimals=3), home / "good.csv")
    so.write_log(bench.log(Machine(law_gain=0.5), reference, decimals=3), home / "half.csv")
    ring, log = CompiledLog(compiler, home, controller, 512), so.read_log(home / "good.csv")
    rows = b""
    for row in np.column_stack([log["reference"], log["F1"], log["I"]]):
        ring.push(0, *row)
        rows += ring.drain(ring.row_bytes)
    ring.file(home / "good.sealog", rows[:-1])
    (home / "other.sealog").write_bytes(ring.header.replace(ring.hash, b"0123456789abcdef") + rows)
    (home / "cut.sealog").write_bytes(ring.header[:-9])
    bare = (home / "good.csv").read_text().replace(" [N]", "").replace(" [A]", "").replace("reference", "goal")
    (home / "bare.csv").write_text(bare)
    return home


@pytest.fixture
def accept(folder, capsys):
    def run(*arguments):
        from typer.testing import CliRunner

        return CliRunner().invoke(
            app, ["accept", str(folder / "stand.toml"), *map(str, arguments), "-o", str(folder / "out")]
        )

    return run


def test_a_log_of_this_law_is_accepted(folder, accept):
    done = accept(folder / "good.csv")
    assert done.exit_code == 0, done.output
    content = json.loads((folder / "out" / "acceptance.json").read_text())
    assert content["schema"] == "seaopt/acceptance/1" and content["met"] and content["replay"]["met"]
    assert "Replay" in (folder / "out" / "acceptance.html").read_text()


def test_an_accepted_log_is_an_experiment_of_a_fit(folder, accept):
    done = accept(folder / "good.csv", "--reference", "reference")
    assert "good_under_law.toml" in done.output
    accept(shutil.copy(folder / "good.sealog", folder / "next.sealog"))  # another log, whose table is another file
    tables = (folder / "out" / "again" / "good_under_law.toml").read_text()
    free = "parameters = { J = { value = 2.5e-6, free = true }, eta = { value = 0.9, free = true }, I_p"
    text = PROBLEM.replace("parameters = { I_p", free, 1) + '[fit]\nmethod = "prediction_error"\n' + tables
    (folder / "again.toml").write_text(text)
    problem = so.read_problem(folder / "again.toml")
    (experiment,) = problem.experiments()
    log, raw = experiment.log, so.read_log(folder / "good.csv")
    assert experiment.feedback and experiment.delay_s == 0.0  # the program's sample of delay is in the rows
    assert np.array_equal(log["I"], raw["I"][:-1]) and np.array_equal(log["F1"], raw["F1"][1:])


def test_a_problem_file_for_a_log_of_the_target_says_that_it_is_under_a_law(folder):
    (note,) = [note for note in propose([folder / "good.sealog"], {}, folder).notes if "law" in note]
    assert "good.sealog: was logged under a law" in note and "seaopt accept" in note
    assert not [note for note in propose([folder / "good.csv"], {}, folder).notes if "law" in note]


def test_a_log_of_the_target_is_taken_as_it_is(folder, accept):
    good = accept(folder / "good.sealog")
    assert good.exit_code == 0
    assert "its last row is cut off and left out: 31 of 32 bytes are there" in " ".join(good.output.split())
    other = accept(folder / "other.sealog")
    assert other.exit_code == 1 and "another, 0123456789abcdef" in other.output
    cut = accept(folder / "cut.sealog")
    assert "header is cut off or damaged" in str(cut.exception)


def test_a_log_of_the_target_has_its_own_names_whatever_the_problem_says_of_others(folder):
    others = '[acceptance]\nreference = "goal [N]"\ntime = "clock"\nrate_hz = 500\ncolumns = { I = "iq [mA]" }\n'
    (folder / "others.toml").write_text(PROBLEM + others)
    log = read_loop_log(so.read_problem(folder / "others.toml"), folder / "good.sealog", {"reference": "N", "I": "A"})
    assert set(log.signals) == {"reference", "I"} and round(log.period, 9) == 1e-3
    with pytest.raises(LogError, match="goal"):
        read_loop_log(so.read_problem(folder / "others.toml"), folder / "good.csv", {"reference": "N", "I": "A"})


def test_columns_without_units_and_with_other_names_are_read(folder, accept):
    assert accept(folder / "bare.csv", "--reference", "goal").exit_code == 0
    wrong = accept(folder / "bare.csv")
    assert wrong.exit_code != 0 and "--reference COLUMN" in str(wrong.exception)


def test_the_reference_is_found_by_its_name_with_its_unit_or_without(folder, accept):
    text = (folder / "good.csv").read_text()
    (folder / "x0.csv").write_text(text.replace("reference [N]", "goal [N]", 1))
    assert accept(folder / "x0.csv", "--reference", "goal").exit_code == 0
    wrong = accept(folder / "good.csv", "--reference", "goal")  # in place of which `reference` is not taken
    assert wrong.exit_code != 0 and 'no column "goal"' in str(wrong.exception)
    wrong = accept(folder / "good.csv", "--reference", "goal [N]")  # no more alike by its unit
    assert "did you mean" not in str(wrong.exception) and "known: time [s], reference [N]" in str(wrong.exception)


def test_an_output_that_the_law_does_not_read_is_taken_where_its_column_is_stated(folder):
    log = so.read_log(folder / "good.csv")
    names = {name: log[name] for name in log.signals}
    so.write_log(so.Log.from_arrays(time=log.time, units={"F2": "N"}, F2=2.0 * log["F1"], **names), folder / "two.csv")
    units, outputs = {"reference": "N", "F1": "N", "I": "A"}, {"F1": "N", "F2": "N"}
    problem = folder / "beside.toml"
    for stated in ("", '[acceptance]\ncolumns = { F2 = "F2 [N]" }\n'):
        problem.write_text(PROBLEM + stated)
        read = read_loop_log(so.read_problem(problem), folder / "two.csv", units, beside=outputs)
        assert ("F2" in read.signals) == bool(stated)
        assert "F2" not in read_loop_log(so.read_problem(problem), folder / "two.csv", units).signals


@pytest.mark.parametrize(
    ("ok", "fault", "told"),
    [
        ("0", "0", {"held": 0, "fault_s": None, "contradicts": False}),
        ("0", "2", {"held": 0, "fault_s": 4.0, "contradicts": True}),
        ("fine", "bad", None),
        ("17", "23", None),
    ],
)
def test_a_column_of_the_law_s_status_is_read_and_one_of_another_status_is_let_be(folder, accept, ok, fault, told):
    header, *rows = (folder / "good.csv").read_text().splitlines()
    lines = [f"{row},{ok if k < 4000 else fault}" for k, row in enumerate(rows)]
    (folder / "status.csv").write_text("\n".join([f"{header},status", *lines]) + "\n")
    done = accept(folder / "status.csv")
    assert done.exit_code == 0 and "is constant" not in done.output, done.output
    assert json.loads((folder / "out" / "acceptance.json").read_text())["replay"]["logs"][0]["status"] == told
    assert ("look at which status is logged" in " ".join(done.output.split())) == (fault == "2")


@pytest.mark.parametrize(("clock", "jitter_s", "gap"), [("jitter", 2e-4, 1), ("jitter", 3e-4, 60), ("none", 0.0, 0)])
def test_what_is_advised_of_an_uneven_clock_or_none_can_be_written_and_does(folder, clock, jitter_s, gap, tmp_path):
    """Each row is a tick, whenever it was stamped; one that is lost is a gap."""
    from typer.testing import CliRunner

    log = so.read_log(folder / "good.csv")
    stamps = log.time + np.random.default_rng(1).uniform(-jitter_s, jitter_s, len(log))
    header, *rows = (folder / "good.csv").read_text().splitlines()
    names, kept = header.split(","), np.delete(np.arange(len(log)), slice(5000, 5000 + gap))
    at = names.index("time [s]")
    cells = [row.split(",") for row in rows]
    if clock == "jitter":
        lines = [",".join([*cells[k][:at], f"{stamps[k]:.6f}", *cells[k][at + 1 :]]) for k in kept]
    else:
        header = ",".join([*names[:at], *names[at + 1 :]])
        lines = [",".join([*row[:at], *row[at + 1 :]]) for row in cells]
    (tmp_path / "log.csv").write_text("\n".join([header, *lines]) + "\n")

    def accept(problem):
        arguments = ["accept", str(problem), str(tmp_path / "log.csv"), "-o", str(folder / "out")]
        return CliRunner().invoke(app, arguments)

    refused = str(accept(folder / "stand.toml").exception)
    assert "[acceptance]" in refused and "rate_hz = " in refused and "call log" not in refused
    assert clock == "none" or refused.endswith("rate_hz = 1000")
    (folder / "even.toml").write_text(PROBLEM + "[acceptance]\nrate_hz = 1000\n")
    done = accept(folder / "even.toml")
    assert done.exit_code == 0, done.output
    (row,) = json.loads((folder / "out" / "acceptance.json").read_text())["replay"]["logs"]
    assert row["rate_hz"] == pytest.approx(1000.0) and row["ticks"] == (len(kept) if clock == "jitter" else len(log))
    assert clock == "none" or (row["stretches"] == 2 and row["gaps"]["longest"] == 5000)


def test_a_report_shows_what_lies_in_the_folder_as_its_commands_printed_it(folder, accept, tmp_path, monkeypatch):
    """Quality, acceptance and bring-up are read back: nothing is judged, planned or certified again."""
    from typer.testing import CliRunner

    assert accept(folder / "good.csv").exit_code == 0
    here = shutil.copytree(folder, tmp_path / "copy")
    problem = here / "stand.toml"

    def run(command, *arguments):
        return CliRunner().invoke(app, [command, *map(str, arguments)])

    assert run("inspect", here / "good.csv", "-o", here / "out").exit_code in (0, 1)
    monkeypatch.setattr("seaopt.cli.machine.bring_up", partial(bring_up, fractions=()))  # no slower laws are tuned
    planned = run("bringup", problem, "-o", here / "out", "--limit", "F1=900")
    assert planned.exit_code == 0, planned.output
    for name in ("accept", "bring_up", "certify_problem"):
        monkeypatch.setattr(f"seaopt.cli.machine.{name}", None)
    done = run("report", problem, "-o", here / "out")
    assert done.exit_code == 0, (done.output, done.exception)
    text, page = " ".join(done.output.split()), (here / "out" / "report.html").read_text()
    assert (
        "Bring-up: 1 of 1 stage with a certified law" in text and "the law makes the logged command in 1 of 1" in text
    )
    for words in ("Stage full", "expected at most", "Quality of the logs", "good.csv", "Measured and model"):
        assert words in page, words

    path = here / "out" / "bringup" / "bringup.json"
    content = path.read_text()
    path.write_text(content.replace('"met": true', '"met": false', 1))
    edited = run("report", problem, "-o", here / "out")
    assert edited.exit_code == 0 and "bringup.json: was edited" in " ".join(edited.output.split())
    assert "Stage full" not in (here / "out" / "report.html").read_text()
    path.write_text(content)
    law = here / "out" / "bringup" / "full" / "controller.json"
    law.unlink()
    lost = run("report", problem, "-o", here / "out")
    assert lost.exit_code == 0 and "left out: stage full" in " ".join(lost.output.split())


@pytest.fixture
def planned(folder, accept, tmp_path, monkeypatch):
    """Return a folder with a bring-up of a stage before the full law (the same law), and what reports of it."""
    from typer.testing import CliRunner

    def run(command, *arguments):
        done = CliRunner().invoke(app, [command, str(here / "stand.toml"), *map(str, arguments), "-o", str(out)])
        assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
        return done.exit_code, " ".join(done.output.split())

    here = shutil.copytree(folder, tmp_path / "copy")
    out = here / "out"
    shutil.rmtree(out / "bringup", ignore_errors=True)
    monkeypatch.setattr("seaopt.cli.machine.bring_up", partial(bring_up, fractions=()))
    monkeypatch.setattr("seaopt.cli.session.write_report", lambda results, path, **_: path)
    assert run("bringup", "--limit", "F1=900")[0] == 0
    content = json.loads((out / "bringup" / "bringup.json").read_text())
    content["stages"] = [content["stages"][0] | {"name": "stage_1"}, *content["stages"]]
    write_json(out / "bringup" / "bringup.json", content)
    shutil.copytree(out / "bringup" / "full", out / "bringup" / "stage_1")
    return here, run


def test_a_report_calls_the_acceptance_of_a_stage_none_of_the_full_law(planned):
    here, run = planned
    code, text = run("accept", here / "good.csv", "--stage", "stage_1")
    assert code == 0 and "Acceptance of stage_1, not of the full law" in text
    assert "they say nothing of the full law" in (here / "out" / "acceptance.html").read_text()
    code, text = run("report")
    assert code == 0 and "Acceptance of stage_1, not of the full law" in text and "Acceptance:" not in text
    assert "Bring-up: 2 of 2 stages" in text


def test_a_report_leaves_out_what_is_of_another_problem_or_certificate(planned):
    here, run = planned
    problem, certificate = here / "stand.toml", here / "out" / "robustness.json"
    assert run("accept", here / "good.csv")[0] == 0
    text, kept = problem.read_text(), certificate.read_bytes()
    certificate.unlink()
    problem.write_text(text.replace("[0.2, 0.6]", "[0.01, 6.0]"))
    _, told = run("report")
    assert "Acceptance" not in told and "Bring-up" not in told
    for name, again in (("acceptance.json", "accept"), ("bringup.json", "bringup")):
        assert f"{name}: was made from another problem file" in told and f"run seaopt {again}" in told
    problem.write_text(text)
    shutil.rmtree(here / "out" / "bringup")
    _, told = run("report")
    assert "the certificate of its law was met, and is missing now; run seaopt accept" in told
    certificate.write_bytes(kept)
    assert "Acceptance: the law makes" in run("report")[1]


def test_a_stage_is_a_name_and_never_a_path(planned):
    """The law of a folder beside the bring-up was taken, and the acceptance could not be read back."""
    from typer.testing import CliRunner

    def refuse(stage, remedy):
        arguments = ["accept", here / "stand.toml", here / "good.csv", "--stage", stage, "-o", here / "out"]
        with pytest.raises(so.SeaoptError, match=f"has no stage of this name; {remedy}"):
            CliRunner().invoke(app, [*map(str, arguments)], catch_exceptions=False)

    here, _ = planned
    shutil.copytree(here / "out" / "bringup" / "full", here / "out" / "x")
    before = {*here.rglob("*")}
    for stage in ("../x", "stage_1/../../x", "stage_1/", "./stage_1", "", ".", "..", "stage_9", here / "out" / "x"):
        refuse(stage, "there are full, stage_1$")
    shutil.rmtree(here / "out" / "bringup")
    refuse("../x", "make it: seaopt bringup")
    assert {*here.rglob("*")} < before


@pytest.mark.parametrize(
    ("file", "change"),
    [
        ("acceptance.json", {"stage": 5}),
        ("acceptance.json", {"stage": "../bringup/stage_1"}),
        ("acceptance.json", {"place": [1.0]}),
        ("acceptance.json", {"response": []}),
        ("bringup/bringup.json", {"stages": None}),
        ("bringup/bringup.json", {"stages": []}),
        ("bringup/bringup.json", {"stages": [{"met": True}]}),
        ("bringup/bringup.json", {"schema": "seaopt/bringup/1"}),
    ],
)
def test_a_report_leaves_out_a_file_that_is_malformed(folder, accept, planned, file, change):
    here, run = planned
    assert run("accept", here / "good.csv")[0] == 0
    path = here / "out" / file
    write_json(path, json.loads(path.read_text()) | change)
    code, text = run("report")
    assert code == 0 and f"{path.name}: " in text and "left out: " in text
    assert run("accept", here / "good.csv")[0] == 0


def test_a_whole_run_is_not_judged_by_what_an_earlier_acceptance_says(planned):
    here, run = planned
    assert run("accept", here / "half.csv")[0] == 1 and run("report")[0] == 1
    session = Session(here / "stand.toml", here / "out")
    session.law()  # as a whole run has, which makes it
    session.run("report")
    assert session.met(["tune", "certify", "report"]) and "accept" not in session.results


@pytest.mark.parametrize("again", [False, True])
def test_no_length_is_advised_from_a_bring_up_of_another_law(folder, accept, tmp_path, again):
    """The stage's folder has the law that was planned, and the problem's may have been tuned again since."""
    planned, law = folder / "out" / "bringup", json.loads((folder / "out" / "controller.json").read_text())
    read = so.read_problem(folder / "stand.toml")
    controller = so.Controller.from_dict(law, read.design_plant, read.values(read.parameters))
    plants, values = read.certified_plants(), read.values(read.parameters)
    certificate = so.certify(controller, plants, values, samples=5, simulations=False)
    plan = bring_up(controller, plants, values, fractions=(), limits={"F1": 900.0}, certificate=certificate)
    content = json.loads(to_json(plan.to_dict()))
    content["stages"][0]["reference"] |= {"period_s": 4.0, "periods": 10, "phases": 1}
    law["law"] |= {"D": [2.0 * value for value in np.ravel(law["law"]["D"]).tolist()]} if again else {}
    write_json(planned / "full" / "controller.json", law)
    write_json(planned / "bringup.json", content)
    log = so.read_log(folder / "good.csv")
    so.write_log(log.between(0.0, 0.9), tmp_path / "short.csv")
    done = " ".join(accept(tmp_path / "short.csv").output.split())
    shutil.rmtree(planned)
    assert ("shorter than one period" in done) is not again, done
    assert ("does not repeat" in done) is again


@pytest.mark.parametrize("stamped", ["jitter", "bursts", "repeats", "missing", "wrong rate"])
def test_with_a_rate_rows_are_ticks_in_the_order_in_which_they_were_written(folder, stamped, tmp_path):
    """Stamps that run backwards or repeat refuse nothing; what they cannot tell is said."""
    from typer.testing import CliRunner

    log, rng = so.read_log(folder / "good.csv"), np.random.default_rng(2)
    n = np.arange(len(log))
    stamps = {
        "jitter": log.time + 3e-4 * rng.normal(size=n.size),  # runs backwards now and then
        "bursts": 40e-3 * (n // 40) + 20e-6 * (n % 40),
        "repeats": np.floor(n / 2.0) * 2e-3,
        "missing": np.where(n == 500, np.nan, log.time),
        "wrong rate": log.time * 1.1,
    }[stamped]
    header, *rows = (folder / "good.csv").read_text().splitlines()
    at = header.split(",").index("time [s]")
    cells = [row.split(",") for row in rows]
    kept = np.delete(n, slice(5000, 5060)) if stamped == "jitter" else n
    written = [",".join([*cells[k][:at], f"{stamps[k]:.6f}", *cells[k][at + 1 :]]) for k in kept]
    (tmp_path / "log.csv").write_text("\n".join([header, *written]) + "\n")
    (folder / "ticks.toml").write_text(PROBLEM + "[acceptance]\nrate_hz = 1000\n")
    arguments = ["accept", str(folder / "ticks.toml"), str(tmp_path / "log.csv"), "-o", str(folder / "out")]
    done = CliRunner().invoke(app, arguments)
    if stamped == "wrong rate":
        assert done.exit_code != 0 and "is not the rate of its rows" in str(done.exception)
        return
    assert done.exit_code == 0, (done.output, done.exception)
    (row,) = json.loads((folder / "out" / "acceptance.json").read_text())["replay"]["logs"]
    if stamped == "jitter":
        assert row["gaps"]["ticks"] == 60 and row["gaps"]["longest"] == 5000 and row["ticks"] == len(kept)
    else:
        told = "a row that is missing cannot be told" in " ".join(done.output.split())
        assert row["gaps"] is None and row["ticks"] == n.size and told >= (stamped == "missing")


def test_a_fault_is_named_and_the_exit_code_is_one(folder, accept):
    done = accept(folder / "good.csv", folder / "half.csv")
    assert done.exit_code == 1 and "I is 0.5 times what it should be" in done.output
    content = json.loads((folder / "out" / "acceptance.json").read_text())
    assert [row["met"] for row in content["replay"]["logs"]] == [True, False]
    assert content["replay"]["logs"][1]["causes"][0]["kind"] == "factor"


@pytest.mark.parametrize(
    ("machine", "says"),
    [
        (Machine(delay_s=1e-3), r"next: look for [\d.]+ ms in the firmware.*: drive_delay_s = ([\d.]+) seaopt tune"),
        (
            Machine(mass=1.5 * Machine().mass),
            r"next: if the machine is so, put .*, fit these logs too, with J free, and tune.*: seaopt fit .* seaopt t",
        ),
    ],
)
def test_what_differs_has_its_remedy_next(folder, accept, compiler, machine, says):
    content = json.loads((folder / "out" / "controller.json").read_text())
    problem = so.read_problem(folder / "stand.toml")
    controller = so.Controller.from_dict(content, problem.design_plant, problem.values(problem.parameters))
    bench, reference = Bench(compiler, folder, controller), multisine(1000, LINES, 8, 60.0, 3, bias=300.0)
    done = accept(so.write_log(bench.log(machine, reference, decimals=3), folder / "other.csv"))
    told = re.search(says, " ".join(done.output.split()))
    assert done.exit_code == 1 and told and "certify the law" not in done.output, done.output
    if machine.delay_s:
        assert float(told[1]) == pytest.approx(machine.delay_s, rel=0.05)
        line = f"drive_delay_s = {told[1]}"
        (folder / "later.toml").write_text(PROBLEM.replace("bandwidth_hz = 30,", f"bandwidth_hz = 30, {line},"))
        assert so.read_problem(folder / "later.toml").spec.drive_delay_s == float(told[1])


@pytest.mark.parametrize("certificate", ["missing", "failed", "of another law"])
def test_a_law_without_a_certificate_that_is_met_is_not_accepted(folder, accept, tmp_path, certificate):
    """As of `seaopt export`; what was measured is shown all the same, and nothing is called certified."""
    file = folder / "out" / "robustness.json"
    content = json.loads(file.read_text())
    file.rename(tmp_path / "kept.json")
    if certificate == "failed":
        content["requirements"][0]["met"] = False
    if certificate == "of another law":
        content["made_from"]["controller.json"] = "0123456789abcdef"
    if certificate != "missing":
        write_json(file, content)
    try:
        done = accept(folder / "good.csv")
    finally:
        (tmp_path / "kept.json").replace(file)
    says, record = " ".join(done.output.split()), json.loads((folder / "out" / "acceptance.json").read_text())
    failed = certificate == "failed"
    assert done.exit_code == 1 and says.count("not met Acceptance") == 1, says
    assert not record["met"] and record["certificate"] == ("failed" if failed else "missing")
    assert record["certificate_failed"] == ([content["requirements"][0]["name"]] if failed else [])
    assert "limits confirmed, 0 refuted; the law is not certified" in says and "Ms confirmed" in says
    assert ("the certificate of this law FAILED" in says) == failed
    assert ("next: certify the law: seaopt certify" in says) == (not failed)
    page = (folder / "out" / "acceptance.html").read_text()
    for text in (says, page):
        assert "not certified:" in text and "were certified" not in text and "certificate's draws" not in text


SCHEDULED = PROBLEM.replace("9.0 }", '9.0, schedule = { over = "k", points = [5e5, 8e5] } }').replace("= 30", "= 25")


def test_a_schedule_is_accepted_at_the_value_that_is_typed(compiler, tmp_path, monkeypatch):
    from typer.testing import CliRunner

    from seaopt.control import ScheduledController

    leave_out(monkeypatch, SIMULATIONS)
    (tmp_path / "stand.toml").write_text(SCHEDULED)
    arguments = [str(tmp_path / "stand.toml"), "-o", str(tmp_path / "out")]
    for command in ("tune", "certify"):
        assert CliRunner().invoke(app, [command, *arguments]).exit_code == 0
    content = json.loads((tmp_path / "out" / "controller.json").read_text())
    problem = so.read_problem(tmp_path / "stand.toml")
    schedule = ScheduledController.from_dict(content, problem.design_plant, problem.values(problem.parameters))
    bench, reference = Bench(compiler, tmp_path, schedule), multisine(1000, LINES, 8, 60.0, 3, bias=300.0)
    log = bench.log(Machine(), reference, places=np.full(reference.size, Machine().stiffness))
    bare = so.Log.from_arrays(**{name: log[name] for name in ("reference", "I", "F1")}, time=log.time)
    so.write_log(bare, tmp_path / "log.csv")
    done = CliRunner().invoke(
        app, ["accept", arguments[0], str(tmp_path / "log.csv"), *arguments[1:], "--at", "655000"]
    )
    assert done.exit_code == 0, done.output
    assert json.loads((tmp_path / "out" / "acceptance.json").read_text())["place"]["over"] == "k"


def test_a_reference_that_is_the_column_of_the_command_leads(folder, accept):
    done = accept(folder / "bare.csv", "--reference", "I")
    text = " ".join(done.output.split())
    assert done.exit_code == 1 and "another set of gains" not in text.partition("Replay")[0]
    (log,) = json.loads((folder / "out" / "acceptance.json").read_text())["replay"]["logs"]
    assert (log["causes"][0]["kind"], log["causes"][0]["what"]) == ("column", "I")
    assert "the column of the reference is that of I" in text.partition("Replay")[0]
