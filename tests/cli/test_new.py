"""`seaopt new`: a problem file from a raw log, with answers and without."""

from __future__ import annotations

import io
import json
import os
import re
import shlex

import pytest

import seaopt as so
from tests.actuator_logs import drive, knee, write_csv


@pytest.fixture
def held(folder):
    """Put knee.csv, a log of a held knee, into the folder."""
    t, current = drive(3.0, 400.0, 2.0)
    log = knee(current, 400.0, locked=True)
    return write_csv(folder / "knee.csv", {"t [s]": t, "I [A]": log["I"], "tau_s [N m]": log["tau_s"]})


@pytest.fixture
def answer(monkeypatch):
    def _answer(*lines):
        monkeypatch.setattr("sys.stdin", io.StringIO("".join(f"{line}\n" for line in lines)))

    return _answer


def test_a_file_is_written_beside_the_log_and_never_over_another(folder, seaopt, held):
    out = seaopt("new", "knee.csv", "--yes")
    assert out.returncode == 0, out.stderr
    assert "seaopt run knee.toml -o knee" in out.stdout
    written = (folder / "knee.toml").read_text(encoding="utf-8")
    assert "guessed: " in written and list(so.read_problem(folder / "knee.toml").plants) == ["held"]
    again = seaopt("new", "knee.csv", "--yes")
    assert again.returncode == 2 and "seaopt new knee.csv -o knee.toml --force" in again.stderr
    assert (folder / "knee.toml").read_text(encoding="utf-8") == written
    assert seaopt("new", "knee.csv", "--yes", "--force").returncode == 0


def test_what_is_written_runs(folder, seaopt, held):
    assert seaopt("new", "knee.csv", "-y").returncode == 0
    assert seaopt("simulate", "knee.toml", "-o", "sim").returncode == 0


def test_answers_are_asked_for_until_they_count(folder, seaopt, held, answer):
    answer("", "", "hundred", "100", "0.037", "", "unknown", "20", "1000", "9")
    out = seaopt("new", "knee.csv", "-o", "asked.toml")
    assert out.returncode == 0, out.stderr
    assert '"hundred" is not a positive number' in out.stdout
    problem = so.read_problem(folder / "asked.toml")
    assert (problem.parameters["N"].value, problem.parameters["K_tau"].value) == (100.0, 0.037)
    assert (problem.spec.bandwidth_hz, problem.spec.sample_rate_hz, problem.spec.current_limit_A) == (20.0, 1000.0, 9.0)
    assert "guessed" in next(line for line in problem_lines(folder / "asked.toml") if line.startswith("k_s"))


def test_an_answer_that_the_file_is_refused_for_is_asked_again(folder, seaopt, held, answer):
    answer("", "", "100", "0.037", "250", "unknown", "20", "12", "9", "2000")
    out = seaopt("new", "knee.csv", "-o", "asked.toml")
    assert out.returncode == 0, out.stderr
    assert "sample_rate_hz = 12 is too slow" in out.stdout and out.stdout.count("Rate at which") == 2
    spec = so.read_problem(folder / "asked.toml").spec
    assert (spec.sample_rate_hz, spec.current_limit_A, spec.bandwidth_hz) == (2000.0, 9.0, 20.0)


def problem_lines(path):
    return path.read_text(encoding="utf-8").splitlines()


def test_without_an_answer_nothing_is_written(folder, seaopt, held, answer):
    answer("yes")
    out = seaopt("new", "knee.csv")
    assert out.returncode == 2 and "--yes" in out.stderr
    assert not (folder / "knee.toml").exists()


def test_json_has_the_columns_and_the_guesses(folder, seaopt, held):
    content = json.loads(seaopt("new", "knee.csv", "--json").stdout)
    assert content["file"] == "knee.toml"
    assert {row["column"]: row["role"] for row in content["columns"]} == {
        "t [s]": "time", "I [A]": "input", "tau_s [N m]": "tau_s",
    }  # fmt: skip
    assert float(content["guesses"]["N"]) > 0


def test_as_many_guesses_are_printed_as_the_file_names(folder, seaopt, held):
    out = seaopt("new", "knee.csv", "--yes").stdout
    guessed = so.read_problem(folder / "knee.toml").table.guessed
    printed, rest = out.split("To be fitted")
    head, rows = re.search(r"\n(\d+) values are guesses, .*\n  guess .*\n((?:  .*\n)+)$", printed).groups()
    assert int(head) == len(guessed) == len(rows.splitlines()) and "Bandwidth of the controller" in rest


def test_several_logs_are_several_experiments(folder, seaopt, held):
    (folder / "second run.csv").write_bytes(held.read_bytes())
    out = seaopt("new", "knee.csv", "second run.csv", "--yes")
    says = " ".join(out.stdout.split())
    assert out.returncode == 0 and "the test of second run.csv once more at half the amplitude" in says  # both have one
    problem = so.read_problem(folder / "problem.toml")
    assert [experiment.name for experiment in problem.table.experiment] == ["knee", "second_run"]
    assert len(problem.experiments()) == 2


def test_the_log_of_half_the_amplitude_is_asked_for_where_none_was_given(folder, seaopt, held):
    """Of the held link both are there; of the link that swings one."""
    for name, amplitude, locked in (("half", 1.0, True), ("swing", 2.0, False)):
        t, current = drive(3.0, 400.0, amplitude)
        log = knee(current, 400.0, locked=locked)
        columns = {"t [s]": t, "I [A]": log["I"], "tau_s [N m]": log["tau_s"]}
        columns |= {} if locked else {"theta_l [rad]": log["theta_l"]}
        write_csv(folder / f"{name}.csv", columns)
    both = seaopt("new", "knee.csv", "half.csv", "--yes")
    assert both.returncode == 0 and "once more" not in both.stdout, both.stdout
    three = seaopt("new", "knee.csv", "half.csv", "swing.csv", "--yes", "--force")
    says = " ".join(three.stdout.split())
    assert "record the test of swing.csv once more at half the amplitude" in says, says


def test_a_log_that_is_not_there_is_one_line(folder, seaopt):
    out = seaopt("new", "none.csv", "--yes")
    (line,) = out.stderr.strip().splitlines()
    assert out.returncode == 2 and line.startswith("seaopt: none.csv")


def test_control_characters_of_a_header_do_not_reach_the_terminal(folder, seaopt, held):
    text = held.read_text(encoding="utf-8").replace("I [A]", "\x1b]0;title\x07I [A]", 1)
    (folder / "evil.csv").write_text(text, encoding="utf-8")
    out = seaopt("new", "evil.csv", "--yes")
    assert "\x1b" not in out.stdout + out.stderr and "\x07" not in out.stdout
    assert "\x1b" not in (folder / "evil.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize("target", ["knee.csv", "./knee.csv", "link.toml", "keep"])
def test_a_log_is_never_written_over(folder, seaopt, held, target):
    (folder / "link.toml").symlink_to("knee.csv")
    before = held.read_bytes()
    for force in ((), ("--force",)):
        out = seaopt("new", "knee.csv", "-y", "-o", target, *force)
        assert out.returncode == 2 and "--force" not in out.stderr and len(out.stderr.strip().splitlines()) == 1
    assert held.read_bytes() == before and (folder / "link.toml").is_symlink() and not (folder / "keep").exists()


def test_a_log_in_toml_is_never_written_over_by_the_name_beside_it(folder, seaopt, held):
    log = held.rename(folder / "knee.toml")
    before = log.read_bytes()
    assert seaopt("new", "knee.toml", "-y", "--force").returncode == 2
    assert log.read_bytes() == before


def test_a_log_taken_for_a_problem_file_is_not_offered_as_the_file_to_write(folder, seaopt, held):
    out = seaopt("fit", "knee.csv")
    assert out.returncode == 2 and "seaopt new knee.csv" in out.stderr and "-o" not in out.stderr


def test_brackets_that_are_no_unit_are_refused_with_the_command_that_reads_them(folder, seaopt):
    rows = "\n".join(f"{k / 100},{k % 7},{k % 5}" for k in range(300))
    (folder / "odd.csv").write_text(f't [s],I [A],F1 `a` [q"x]\n{rows}\n', encoding="utf-8")
    out = seaopt("inspect", "odd.csv")
    command = out.stderr.strip().split("as in seaopt ")[1]
    assert out.returncode == 2 and seaopt(*shlex.split(command)).returncode == 0


def test_a_header_with_a_line_break_in_quotes_is_read(folder, seaopt):
    rows = "\n".join(f"{k / 100},{k % 7},{k % 5}" for k in range(300))
    (folder / "lines.csv").write_text(f't [s],"I\n[A]",F1 [N]\n{rows}\n', encoding="utf-8")
    log = so.read_log(folder / "lines.csv", time="t [s]", channels={"I": "I [A]", "F1": "F1 [N]"})
    assert len(log) == 300 and log["I"][:8].tolist() == [0, 1, 2, 3, 4, 5, 6, 0]
    assert seaopt("inspect", "lines.csv").returncode == 0


def test_a_folder_is_no_log(folder, seaopt):
    out = seaopt("new", ".", "-y")
    assert out.returncode == 2 and "is a folder" in out.stderr


def test_a_name_that_is_no_text_is_refused(folder, seaopt, held):
    try:
        (folder / os.fsdecode(b"bad\xff.csv")).write_bytes(held.read_bytes())
    except OSError:
        pytest.skip("this file system holds names of text alone")
    out = seaopt("new", os.fsdecode(b"bad\xff.csv"), "-y")
    assert out.returncode == 2 and "rename the log" in out.stderr
    assert not list(folder.glob("bad*.toml")) and not list(folder.glob(".seaopt*"))


def test_commands_to_type_are_quoted(folder, seaopt, held):
    (folder / "my log.csv").write_bytes(held.read_bytes())
    assert seaopt("new", "my log.csv", "-y").returncode == 0
    out = seaopt("new", "my log.csv", "-y")
    assert out.returncode == 2 and "seaopt new 'my log.csv' -o 'my log.toml' --force" in out.stderr


def test_columns_and_their_units_can_be_named(folder, seaopt):
    t, current = drive(3.0, 400.0, 2.0)
    log = knee(current, 400.0, locked=True)
    write_csv(folder / "bare.csv", {"n": 1e3 * t, "a": log["I"], "b": 1e3 * log["tau_s"]})
    named = ("--time", "n", "--channel", "I=a", "--channel", "tau_s=b", "--unit", "tau_s=mN m", "--unit", "time=ms")
    out = seaopt("new", "bare.csv", "--yes", *named)
    assert out.returncode == 0, out.stderr
    (experiment,) = so.read_problem(folder / "bare.toml").experiments()
    assert experiment.log.rate_hz == pytest.approx(400.0)
    assert abs(experiment.log["tau_s"] - log["tau_s"]).max() < 1e-6
    wrong = seaopt("new", "bare.csv", "--yes", "--force", "--channel", "I")
    assert wrong.returncode == 2 and "write --channel NAME=VALUE" in wrong.stderr


def test_a_value_that_is_unusual_is_asked_for_again(folder, seaopt, answer):
    """A lever of 25, which is millimetres; then a mass of 900 kg that is meant."""
    t, current = drive(3.0, 400.0, 2.0)
    of = knee(current, 400.0)
    write_csv(folder / "leg.csv", {"t [s]": t, "I [A]": of["I"], "F1 [N]": of["tau_s"], "phi [rad]": of["theta_l"]})
    answer("", "", "", "", "", "25", "0.025", "900", "900", *[""] * 20)
    out = seaopt("new", "leg.csv", "-o", "leg.toml")
    assert out.returncode == 0, out.stderr
    assert "25 is unusual, 0.002 to 1 are common: type it again to keep it" in out.stdout
    problem = so.read_problem(folder / "leg.toml")
    assert (problem.parameters["L_a"].value, problem.parameters["m"].value) == (0.025, 900.0)
    assert "900 is unusual" in next(line for line in problem_lines(folder / "leg.toml") if line.startswith("m "))
    assert "note: m: 900 is unusual" in out.stdout
