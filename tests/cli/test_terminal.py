"""What reaches a terminal: eighty columns, verdicts first, each failure once, no control characters."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from typer.main import get_command

import seaopt as so
from seaopt.cli.main import app
from seaopt.cli.progress import TimeLeft
from seaopt.cli.terminal import Terminal
from seaopt.reporting.sections.data import Verdict
from seaopt.reporting.sections.kinds.certificate import explain_failure
from seaopt.reporting.sections.text import render_verdict
from seaopt.robustness.certificate.requirement import Requirement, group_failures


def broken(name, value, limit, plant, **fields):
    return Requirement(name=name, limit=limit, value=value, met=False, plant=plant, **fields)


def explain(failure):
    return explain_failure(failure, models={})


def test_the_same_failure_in_twelve_runs_is_said_once():
    rows = [broken("step_overshoot", 1.4 + 0.01 * k, 1.3, f"plant {k}", scenario="step") for k in range(12)]
    (reason,) = map(explain, group_failures(rows))
    assert (reason.count, reason.where) == (12, "plant 11, step")
    assert "1.51" in reason.what and "1.3" in reason.what


def test_what_must_be_large_is_worst_where_it_is_least():
    rows = [broken("min_disk_margin", value, 0.7, str(value), sense="≥") for value in (0.6, 0.2, 0.5)]
    (reason,) = map(explain, group_failures(rows))
    assert reason.where == "0.2"


def test_of_an_unstable_plant_only_that_is_said():
    rows = [
        broken("spectral_radius", 1.2, 1.0, "swing"),
        broken("max_sensitivity", np.inf, 1.6, "swing"),
        broken("max_complementary", np.inf, 1.3, "swing"),
        broken("max_noise_gain", 30.0, 25.0, "stand"),
    ]
    unstable, other = map(explain, group_failures(rows))
    assert "swing" in unstable.what and "2 more" in unstable.where
    assert other.what.startswith("max_noise_gain 30")


@pytest.mark.parametrize(
    ("fields", "subject"),
    [({"plant": "frf:chirp", "text": "on measured points, at 95 %"}, "frf:chirp"),
     ({"plant": "knee", "state": "stuck", "place": ("phi", 0.4)}, "phi = 0.4, knee stuck")],
)  # fmt: skip
def test_what_is_unstable_is_named_whatever_its_name_holds(fields, subject):
    (reason,) = map(explain, group_failures([broken("spectral_radius", 1.2, 1.0, **fields)]))
    assert reason.what == f"unstable on {subject}"


@pytest.mark.parametrize("width", [20, 40, 80])
def test_nothing_of_a_table_or_of_a_path_is_lost_however_narrow(width, capsys):
    console = Terminal(width=width)
    rows = [("natural_frequency_hz", "10.665", "± 15", "Hz"), ("J", "1.6348e-06", "± 4.5e-06", "kg m^2")]
    console.tabulate(rows, ("parameter", "value", "std", "unit"), "<>><")
    console.write(render_verdict(Verdict(met=False, text="Controller: every limit met, on a fit"), width))
    console.list_files(["a b/c.json", "out with blanks/report.html"])
    text = capsys.readouterr().out
    lines = text.splitlines()
    assert all(cell in text for row in rows for cell in row)
    assert "a b/c.json" in text and lines[-1].endswith("out with blanks/report.html")
    first = next(at for at, line in enumerate(lines) if line.startswith("not met  Controller:"))
    rest = [line for line in lines[first + 1 :] if not line.startswith(("wrote", "out"))]
    assert all(re.match(r" {9}\S", line) for line in rest)
    assert all(line == line.rstrip() for line in lines[first:])


@pytest.fixture
def narrow(seaopt, monkeypatch):
    def _narrow(*arguments):
        monkeypatch.setenv("COLUMNS", "80")
        return seaopt(*arguments)

    return _narrow


def test_a_controller_fits_a_terminal_of_eighty_columns(copied, narrow):
    out = narrow("tune", "short.toml", "-o", "all")
    lines = out.stdout.splitlines()
    assert lines[0].startswith("met      Controller: pid on F1, 30 Hz")
    assert max(map(len, lines)) <= 80 and len(lines) <= 40
    assert "\x1b" not in out.stdout  # colours are a terminal's
    quiet = narrow("tune", "short.toml", "-o", "all", "--quiet")
    assert quiet.stdout.splitlines() == lines[:1] and quiet.returncode == 0
    loud = narrow("tune", "short.toml", "-o", "all", "--verbose")
    assert len(loud.stdout) > len(quiet.stdout) and "Active limits:" in " ".join(loud.stdout.split())


def test_a_limit_that_cannot_be_met_ends_with_the_line_to_write(copied, narrow, short):
    hard = short.replace("max_noise_gain = 25", "max_noise_gain = 3\nbandwidth_range_hz = [28, 32]")
    (copied / "hard.toml").write_text(hard, encoding="utf-8")
    (copied / "all" / "controller.json").unlink()
    out = narrow("tune", "hard.toml", "-o", "all")
    assert out.returncode == 1 and (copied / "all" / "controller.json").exists()
    first, *rest = out.stdout.splitlines()
    assert first.startswith("not met  Controller: ")
    words = " ".join(" ".join(rest).split())
    assert words.count("max_noise_gain 3") <= 1 and "seaopt tune hard.toml -o all --sweep" in words
    assert max(map(len, out.stdout.splitlines())) <= 90  # a command to copy is on one line


def test_tables_of_responses_and_of_sweeps_fit_eighty_columns(copied, narrow, without_drawing):
    """A long name, here of a plant at a corner of a range, is broken in its cell."""
    for arguments, verdict in (
        (("frf", "short.toml"), "met      chirp: every response is coherent"),
        (("tune", "short.toml", "--sweep", "25:45:20"), ""),
    ):
        out = narrow(*arguments, "-o", "all")
        lines = out.stdout.splitlines()
        assert lines[0].startswith(verdict) and max(map(len, lines)) <= 80 and len(lines) <= 40, out.stdout
    rows = [line.split() for line in lines]
    assert ["25", "yes"] in [row[:2] for row in rows] and any("not met at 45 Hz" in line for line in lines)
    assert {"worst", "limit"} <= {word for row in rows for word in row}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "quiet"),
    [
        (("frf", "short.toml", "-o", "all"), "met  "),
        (("simulate", "short.toml", "-o", "all"), "wrote "),
        (("inspect", "log.csv"), "log.csv: "),
        (("export", "all", "--c", "firmware"), "wrote "),
    ],
)
def test_every_command_says_less_or_more(copied, narrow, without_drawing, arguments, quiet):
    rows = [f"{t / 400},{t % 7},{t % 11}" for t in range(400)]
    (copied / "log.csv").write_text("\n".join(["time [s],I [A],F1 [N]", *rows]), encoding="utf-8")
    little, usual, much = (narrow(*arguments, *option).stdout for option in (["--quiet"], [], ["--verbose"]))
    assert all(line.startswith((quiet, "all/", "firmware/")) for line in little.splitlines())
    assert 0 < len(little) <= len(usual) <= len(much)


def test_help_is_what_the_bare_command_prints(seaopt):
    out = seaopt()
    assert out.returncode == 0
    assert {"demo", "new", "run", "--install-completion"} <= set(out.stdout.replace("│", " ").split())


def test_no_help_has_brackets_which_rich_would_take_for_markup():
    """Such as [controller.gate], which was left out of the text."""
    commands = get_command(app).commands
    texts = {f"{name} {option.name}": option.help or "" for name, one in commands.items() for option in one.params}
    assert len(texts) > 80 and [name for name, text in texts.items() if "[" in text] == []


def test_shells_complete_commands(tmp_path):
    asked = {"_SEAOPT_COMPLETE": "complete_bash", "COMP_WORDS": "seaopt ins", "COMP_CWORD": "1"}
    code = "from seaopt.cli.main import app; app(prog_name='seaopt')"
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path, env=os.environ | asked
    )
    assert process.stdout.split() == ["inspect"]
    assert app.info.name == "seaopt"


def test_texts_of_files_are_shown_and_not_obeyed(capsys):
    console = Terminal()
    evil = "a\x1b]0;title\x07b\x1b[31mc\u202ed"
    console.say(evil)
    console.wrap(f"word {evil}")
    console.tabulate([(evil, "1")], ("name", "value"), "<>")
    out = capsys.readouterr().out
    assert not {"\x1b", "\x07", "\u202e"} & set(out)
    assert out.count("title") == 3


def test_a_misspelt_column_of_a_log_does_not_reach_the_terminal_raw(folder, seaopt):
    (folder / "log.csv").write_text("t [s],I\x1b[31m [A],F1 [N]\n0,1,2\n0.1,1,3\n", encoding="utf-8")
    (folder / "p.toml").write_text(
        'schema = 1\n[plant.a]\nkind = "high_impedance"\n[[experiment]]\nname = "x"\nplant = "a"\nlog = "log.csv"\n'
        'time = "t [s]"\ninputs = { I = "I [A]" }\noutputs = { F1 = "F1 [N]" }\n',
        encoding="utf-8",
    )
    out = seaopt("fit", "p.toml")
    assert out.returncode == 2 and "\x1b" not in out.stderr


def test_no_color_and_files_have_no_colours(monkeypatch):
    monkeypatch.setenv("NO_COLOR", "1")
    console = Terminal(force_terminal=True, width=80, record=True)
    with console.capture() as captured:
        console.say("met", style="green")
    assert "\x1b[32m" not in captured.get()
    monkeypatch.delenv("NO_COLOR")
    console = Terminal(force_terminal=True, width=80, color_system="standard")
    with console.capture() as captured:
        console.say("met", style="green")
    assert "\x1b[32m" in captured.get()


def follow(moves, asked):
    """Return what is told at each of some times, of a stage whose share is that of `moves` from a time on."""
    now, told, moves = 0.0, [], list(moves)
    left = TimeLeft(lambda: now)
    for at in asked:
        while moves and moves[0][0] <= at:
            now, share = moves.pop(0)
            left.move(share)
        now = at
        told.append(left.tell())
    return told


def test_the_time_left_is_that_of_the_share_that_is_done():
    steady = [(float(t), t / 100.0) for t in range(1, 100)]
    told = ["", "at most 3 min left", "at most 2 min left", "at most 30 s left"]
    assert follow(steady, [1.0, 40.0, 60.0, 90.0]) == told
    assert follow([(60.0, 0.4)], [60.0]) == ["at most 4 min left"] and follow([], [5.0]) == [""]


def test_a_number_many_times_what_was_spent_is_not_told():
    assert follow([(60.0, 0.1)], [60.0]) == [""]


def test_a_number_that_was_wrong_is_followed_by_another_one():
    """A machine that is busy with others from there on: 3 minutes at most were told, and then nothing any more."""
    moves = [(float(t), t / 100.0) for t in range(1, 41)] + [(40.0 + 25.0 * k, 0.4 + 0.01 * k) for k in range(1, 61)]
    first, *others = follow(moves, [40.0, 540.0, 900.0])
    assert first == "at most 3 min left"
    for at, text in zip((540.0, 900.0), others, strict=True):
        assert text.endswith("min left") and 60.0 * float(text.split()[2]) >= 40.0 + 25.0 * 60 - at, (at, text)


def test_what_turns_slow_ends_before_what_was_told_or_nothing_is():
    """A fit that is searched in a second, and then tries thirty causes for a second each."""
    moves = [(0.1 * k, 0.06 * k) for k in range(1, 11)] + [(1.0 + k, 0.6 + 0.4 * k / 30) for k in range(1, 31)]
    asked = [4.0, 11.0, 21.0, 26.0]
    told = follow(moves, asked)
    assert told[1] and told[-1]
    for at, text in zip(asked, told, strict=True):
        seconds = float(text.split()[2]) * (60.0 if "min" in text else 1.0) if text else 31.0 - at
        assert 31.0 - at <= seconds < 3.0 * (31.0 - at) + 10.0, (at, text)


def test_a_number_that_was_told_rises_where_it_was_wrong_alone():
    """Half in ten seconds, and then nothing: what was told falls, until it is far too little, or has passed."""
    told = follow([(1.0, 0.1), (10.0, 0.5)], [10.0, 16.0, 18.0, 30.0, 300.0])
    assert told == ["at most 30 s left", "at most 20 s left", "", "at most 50 s left", "at most 13 min left"]


def test_the_last_part_may_take_as_long_as_the_longest_did():
    assert follow([(1.0, 0.1), (41.0, 0.9), (42.0, 0.98)], [42.0]) == ["at most 2 min left"]


def test_nothing_is_left_to_tell_at_the_end():
    assert follow([(5.0, 0.5), (10.0, 1.0)], [60.0]) == [""]


def test_a_fit_that_fails_is_told_with_what_to_do(folder, narrow, stand_alone):
    """The spring is stated twice as stiff as it is: one error for each output, said once."""
    wrong = stand_alone.replace("[plant.stand]", "k = 1310000\n[plant.stand]", 1)
    wrong = wrong.replace("truth = { J", "truth = { k = 655000, J")
    (folder / "wrong.toml").write_text(wrong, encoding="utf-8")
    out = narrow("fit", "wrong.toml", "-o", "wrong")
    assert out.returncode == 1, out.stdout
    assert out.stdout.startswith("not met  Fit: ")
    assert "seaopt fit wrong.toml -o wrong" in out.stdout
    assert not so.Fit.from_dict(json.loads((folder / "wrong" / "fit.json").read_text(encoding="utf-8"))).met
