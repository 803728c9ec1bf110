"""Whatever is given, the command ends, with one line on stderr and exit code 2 where it refuses; never a traceback."""

from __future__ import annotations

import io
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest

import seaopt as so
import seaopt.cli
from tests.cli.conftest import run_process

BASE = """schema = 1
[plant.stand]
kind = "high_impedance"
[parameters]
J = { value = 3e-6, free = true, min = 1e-8, max = 1e-4 }
"""
EXPERIMENT = """[[experiment]]
name = "a"
plant = "stand"
log = "ok.csv"
time = "time [s]"
inputs = { I = { column = "I", unit = "A" } }
outputs = { F1 = { column = "F1", unit = "N" } }
"""
CONTROLLER = '[controller]\nplant = "stand"\nbandwidth_hz = 30\n'
VIRTUAL = '[[experiment]]\nname = "v"\nplant = "stand"\nvirtual = { seed = 1, duration_s = 1e6, rate_hz = 1e6, ' \
          "excitation = { noise = { std = 1, band_hz = 10 } } }\n"  # fmt: skip


def write_csv(path, head, rows=400):
    rng = np.random.default_rng(0)
    lines = [",".join(f"{value:.4g}" for value in (t, *rng.normal(size=len(head) - 1))) for t in np.arange(rows) / 400]
    path.write_text(",".join(head) + "\n" + "\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture
def bad(folder):
    """Return a folder with a log that is good, and a function that writes problem files."""
    write_csv(folder / "ok.csv", ["time [s]", "I", "F1"])

    def write(text):
        (folder / "p.toml").write_text(text, encoding="utf-8")
        return "p.toml"

    return write


@contextmanager
def ended_within(seconds):
    """Fail where a call hangs."""

    def fail(*_):
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, fail)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def check_refused(result, *words):
    assert result.returncode == 2, result.stderr
    assert result.stderr.startswith("seaopt: ") and result.stderr.count("\n") == 1
    for word in words:
        assert word in result.stderr
    assert not set(result.stderr) & {"\x1b", "\x07"}


PROBLEMS = {
    "digits": (BASE + "x = " + "9" * 5000, "TOML"),
    "nested": (BASE + "x = " + "[" * 100_000, "TOML"),
    "nested less": (BASE + "x = " + "[" * 200 + "]" * 200, "nested"),
    "many bits": (BASE + "[robustness]\nsamples = 0x" + "F" * 4000, "16000 bits"),
    "many bits in a unit": (BASE + EXPERIMENT.replace('"N"', '"N", scale = 0x' + "F" * 4000), "16000 bits"),
    "late": (BASE + EXPERIMENT + "delay_s = 1e300\n", "delay_s"),
    "control": (BASE.replace("J =", '"J\\u001b]0;x\\u0007" ='), "\\x1b]0;x"),
    "scale": (BASE + EXPERIMENT.replace('"N"', '"N", scale = 1e300'), "scale"),
    "scale and offset": (BASE + EXPERIMENT.replace('"N"', '"N", scale = 1e308, offset = 1e308'), "scale"),
    "rate": (BASE + EXPERIMENT + "resample = { rate_hz = 1e9 }\n", "rate_hz"),
    "virtual": (BASE + VIRTUAL, "GB of memory"),
    "unit": (BASE + EXPERIMENT.replace('"A"', '"A^9^9^9^9"'), "unit"),
    "nul": (BASE + EXPERIMENT.replace("ok.csv", "a\\u0000b"), "cannot be read"),
    "long": (BASE + EXPERIMENT.replace("ok.csv", "n" * 300), "cannot be read"),
    "delay": (BASE + EXPERIMENT + "delay_s = nan\n", "delay_s"),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_problem_files_are_refused_in_one_line(seaopt, bad, name):
    text, word = PROBLEMS[name]
    with ended_within(30):
        check_refused(seaopt("fit", bad(text)), word)


def test_a_part_that_is_no_name_is_refused(bad, folder):
    """In a process of its own: the tests' checks of types would see it first."""
    bad(BASE.replace('impedance"', 'impedance"\nparts = [["x"]]') + EXPERIMENT)
    check_refused(run_process("fit", "p.toml", cwd=folder), "part")


OPTIONS = {
    "stretch": (("frf", "p.toml", "--stretch", "inf"), "stretch"),
    "sweep": (("tune", "p.toml", "--sweep", "1:1e300:1e-300"), "--sweep"),
    "sweep of nan": (("tune", "p.toml", "--sweep", "nan:inf:1"), "--sweep"),
    "counter": (("inspect", "ok.csv", "--counter", "I=" + "9" * 5000), "--counter"),
    "unit": (("inspect", "ok.csv", "--channel", "I=I", "--unit", "I=(((9^99)^99)^99)^99"), "unit"),
    "rate": (("inspect", "ok.csv", "--rate-hz", "nan"), "rate_hz"),
    "long log": (("inspect", "n" * 300), "cannot be read"),
    "long problem": (("fit", "n" * 300), "cannot be read"),
    "long folder": (("inspect", "ok.csv", "-o", "n" * 300), "folder"),
    "long folder of results": (("fit", "p.toml", "-o", "n" * 300), "folder"),
    "below a file": (("inspect", "ok.csv", "-o", "ok.csv/x"), "cannot be"),
    "long results": (("export", "n" * 300, "--c", "c"), "folder"),
    "long new file": (("new", "ok.csv", "--yes", "-o", "n" * 300 + ".toml"), "cannot be written"),
    "law of nothing": (("certify", "p.toml", "--controller", "empty.toml"), "empty.toml: should have one of"),
    "below what is no folder": (("fit", "p.toml", "-o", "ok.csv/x"), "cannot be"),
    "below what nobody writes": (("inspect", "ok.csv", "-o", "/proc/x"), "cannot be"),
    "control": (("inspect", "no\x1b]0;x\x07file"), "\\x1b]0;x"),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_options_are_refused_in_one_line(seaopt, bad, folder, name):
    bad(BASE + EXPERIMENT + CONTROLLER)
    (folder / "empty.toml").touch()
    arguments, word = OPTIONS[name]
    with ended_within(30):
        check_refused(seaopt(*arguments), word)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (EXPERIMENT, "out/fit.json: no such file; run seaopt fit p.toml -o out first"),
        (CONTROLLER, "out/controller.json: no such file; run seaopt tune p.toml -o out first"),
        ("", "has no [[experiment]] and no [controller]"),
    ],
)
def test_a_report_of_nothing_says_what_to_run(seaopt, bad, text, words):
    result = seaopt("report", bad(BASE.replace("free = true, ", "") + text), "-o", "out")
    check_refused(result, words)


@pytest.mark.parametrize("kind", ["fifo", "device"])
def test_only_regular_files_are_read(seaopt, bad, folder, kind):
    place = folder / "pipe"
    if kind == "fifo":
        os.mkfifo(place)
    else:
        place.symlink_to("/dev/zero")
    bad(BASE + EXPERIMENT + CONTROLLER)
    (folder / "out").mkdir()
    with ended_within(30):
        check_refused(seaopt("inspect", "pipe"), "regular file")
        check_refused(seaopt("fit", "pipe"), "regular file")
        place.rename(folder / "out" / "fit.json")
        check_refused(seaopt("tune", "p.toml"), "regular file")


@pytest.mark.parametrize("content", ["[" * 200_000, '{"a":' * 200_000, '[{"t": 0, "x": ' + "9" * 5000 + "}]"])
def test_json_of_any_depth_is_refused(seaopt, bad, folder, content):
    (folder / "deep.json").write_text(content, encoding="utf-8")
    check_refused(seaopt("inspect", "deep.json"), "deep.json")
    bad(BASE + EXPERIMENT + CONTROLLER)
    (folder / "out").mkdir()
    (folder / "out" / "fit.json").write_text('{"schema": "seaopt/fit/1", "a": ' + content, encoding="utf-8")
    check_refused(seaopt("tune", "p.toml"), "fit.json")


@pytest.mark.parametrize("inner", ["[" * 900 + "]" * 900, '{"a":' * 900 + "1" + "}" * 900, "9" * 4000])
def test_results_of_any_depth_are_refused(copied, seaopt, inner):
    """A controller.json that Python reads, but whose digest it could not make."""
    path = copied / "all" / "controller.json"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("{", '{"a": ' + inner + ", ", 1), encoding="utf-8")
    for command in ("export all --c c", "certify short.toml -o all", "report short.toml -o all"):
        check_refused(seaopt(*command.split()), "controller.json", "not valid JSON")


def test_a_log_that_a_link_puts_elsewhere_is_refused_and_not_quoted(seaopt, bad, folder, tmp_path_factory):
    secret = tmp_path_factory.mktemp("elsewhere") / "secret.csv"
    secret.write_text("time [s],hunter2\n" * 9, encoding="utf-8")
    (folder / "ok.csv").unlink()
    (folder / "ok.csv").symlink_to(secret)
    result = seaopt("fit", bad(BASE + EXPERIMENT))
    check_refused(result, "link")
    assert "hunter2" not in result.stderr
    (folder / "within.csv").symlink_to(folder / "real.csv")
    write_csv(folder / "real.csv", ["time [s]", "I", "F1"])
    within = EXPERIMENT.replace("ok.csv", "within.csv").replace('"F1"', '"F11"')  # read as far as its columns
    result = seaopt("fit", bad(BASE + within))
    assert "F11" in result.stderr and "link" not in result.stderr


def test_names_that_a_terminal_obeys_or_that_look_like_markup_are_shown(seaopt, folder):
    """And drawn: "$" begins a formula in a figure, "[/" ends a colour in a terminal."""
    write_csv(folder / "odd.csv", ["time [s]", "$\\foo$ [N]", "a[/b]c", "F\x1b]0;t\x07\x9b31m", "x\u202ey"])
    shown = seaopt("inspect", "odd.csv", "-o", "out")
    assert shown.returncode == 0, shown.stderr
    assert "$\\foo$" in shown.stdout and "a[/b]c" in shown.stdout and "F\\x1b]0;t\\x07\\x9b31m" in shown.stdout
    listed, written = seaopt("inspect", "odd.csv", "--list"), seaopt("inspect", "odd.csv", "--json")
    for text in (shown.stdout, listed.stdout, written.stdout):
        assert not set(text) & {"\x1b", "\x07", "\x9b", "\u202e"}
    assert "F\x1b]0;t\x07\x9b31m" in json.loads(written.stdout)["channels"]
    assert "$\\foo$" in (folder / "out" / "quality.svg").read_text(encoding="utf-8")


@pytest.mark.parametrize("options", [(), ("-o", "out")])
def test_the_largest_numbers_are_looked_at(seaopt, bad, folder, options):
    rng = np.random.default_rng(0)
    values = rng.normal(size=(400, 2))
    values[[5, 7], 1] = 1e308, -1e308
    rows = "\n".join(f"{k / 400},{a},{b}" for k, (a, b) in enumerate(values))
    (folder / "ok.csv").write_text(f"time [s],I,F1\n{rows}\n", encoding="utf-8")
    assert seaopt("inspect", "ok.csv", *options).returncode == 1
    check_refused(seaopt("fit", bad(BASE + EXPERIMENT)), "F1")


def test_many_columns_are_looked_at_in_time(seaopt, folder):
    """40,000 took minutes where something was done for every pair of names."""
    count, rows = 2000, 20
    head = ",".join(["time [s]", *(f"c{k} [N]" for k in range(count))])
    body = "\n".join(",".join([f"{row / 100}", *(str((k * row) % 7) for k in range(count))]) for row in range(rows))
    (folder / "wide.csv").write_text(f"{head}\n{body}\n", encoding="utf-8")
    with ended_within(60):
        assert seaopt("inspect", "wide.csv").returncode == 0


def run_inspect(folder, *arguments, **options):
    return subprocess.run(
        [sys.executable, "-m", "seaopt.cli", "inspect", *arguments],
        cwd=folder, stderr=subprocess.PIPE, check=False, **options,
    )  # fmt: skip


@pytest.mark.parametrize("encoding", ["ascii", pytest.param("latin-1", marks=pytest.mark.slow)])
def test_a_terminal_of_few_characters_gets_the_others_as_escapes(folder, encoding):
    write_csv(folder / "u.csv", ["time [s]", "Kraft µ Ω [N]"])
    done = run_inspect(folder, "u.csv", env=os.environ | {"PYTHONIOENCODING": encoding}, stdout=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"\\u03a9" in done.stdout


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")  # noqa: PTH110
@pytest.mark.parametrize("options", [(), pytest.param(("--json",), marks=pytest.mark.slow)])
def test_a_full_disk_under_stdout_is_one_line(folder, options):
    write_csv(folder / "ok.csv", ["time [s]", "F1 [N]"])
    with open("/dev/full", "wb") as full:  # noqa: PTH123
        done = run_inspect(folder, "ok.csv", *options, stdout=full)
    assert done.returncode == 2
    assert done.stderr.startswith(b"seaopt: stdout: ") and done.stderr.count(b"\n") == 1


def test_names_that_are_not_utf8_are_files_too(folder):
    write_csv(folder / "ok.csv", ["time [s]", "F1 [N]"])
    shutil.copy(folder / "ok.csv", os.fsencode(folder) + b"/l\xff.csv")
    done = run_inspect(folder, b"l\xff.csv", "-o", b"out\xfe", "--json", stdout=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (0, b"")
    json.loads(io.TextIOWrapper(io.BytesIO(done.stdout), encoding="utf-8").read())
    assert (os.fsencode(folder) + b"/out\xfe/quality.json").decode("utf-8", "surrogateescape")
    assert os.path.exists(os.fsencode(folder) + b"/out\xfe/quality.json")  # noqa: PTH110


# A command, a line of a problem file, an option, or a call of Python, at the end of the message.
REMEDY = re.compile(r'(seaopt [a-z]+( \S+)*|\bls \S+|\w+ = \S.*|-o \w+|"[\w:.]+")( in \[\w+\])?( (again|first))?$')
REFUSALS = {
    "missing problem": (("run", "nothing.toml"), "", ""),
    "missing log": (("fit", "p.toml"), '"ok.csv"', '"gone.csv"'),
    "empty log": (("fit", "p.toml"), '"ok.csv"', '"empty.csv"'),
    "log that is missing": (("inspect", "gone.csv"), "", ""),
    "wrong column": (("fit", "p.toml"), 'column = "F1"', 'column = "F11"'),
    "no such column": (("fit", "p.toml"), 'column = "F1"', 'column = "torque"'),
    "no TOML": (("fit", "p.toml"), "schema = 1", "schema ="),
    "unknown key": (("tune", "p.toml"), "bandwidth_hz", "bandwith_hz"),
    "missing key": (("tune", "p.toml"), "bandwidth_hz = 30\n", ""),
    "kind of value": (("tune", "p.toml"), "bandwidth_hz = 30", 'bandwidth_hz = "fast"'),
    "bandwidth": (("tune", "p.toml"), "bandwidth_hz = 30", "bandwidth_hz = 99"),
    "limit": (("tune", "p.toml"), "bandwidth_hz = 30", "bandwidth_hz = 30\nmax_sensitivity = 0.9"),
    "sample rate": (("tune", "p.toml"), "bandwidth_hz = 30", "bandwidth_hz = 30\nsample_rate_hz = 50"),
    "delay": (("tune", "p.toml"), "bandwidth_hz = 30", "bandwidth_hz = 30\ndelay_samples = 9999"),
    "bounds": (("fit", "p.toml"), "value = 3e-6", "value = 3.0"),
    "plant": (("tune", "p.toml"), 'plant = "stand"\nbandwidth', 'plant = "stad"\nbandwidth'),
    "measured": (("tune", "p.toml"), "bandwidth_hz = 30", 'bandwidth_hz = 30\nmeasured = "F3"'),
    "name twice": (("fit", "p.toml"), "[controller]", EXPERIMENT + "[controller]"),
    "no controller": (("tune", "p.toml"), CONTROLLER, ""),
    "no experiment": (("fit", "p.toml"), EXPERIMENT, ""),
    "nothing to simulate": (("simulate", "p.toml"), EXPERIMENT, ""),
    "stage before": (("tune", "p.toml"), "", ""),
    "no results": (("export", "none", "--c", "c"), "", ""),
    "folder": (("fit", "p.toml", "-o", "ok.csv"), "", ""),
    "law that is missing": (("certify", "p.toml", "--controller", "gone.json"), "", ""),
    "sweep": (("tune", "p.toml", "--sweep", "15"), "", ""),
}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("inspect", "my logs"), ["seaopt", "inspect", "my logs/NAME.csv"]),
        (("inspect", "my logs/empty.csv"), ["seaopt", "inspect", "my logs/empty.csv"]),
        (("inspect", "my logs/none.csv"), ["ls", "my logs"]),
        (("inspect", "my logs/ok.csv", "--time", "zzz"), ["seaopt", "inspect", "my logs/ok.csv", "--list"]),
        (("inspect", "my logs/ok.csv", "--unit", "a b=N"), ["--channel", "a b=COLUMN", "--unit", "a b=N"]),
        (("new", "my logs/words.csv"), ["seaopt", "inspect", "my logs/words.csv", "--list"]),
        (("export", "my logs", "--c", "c"), ["seaopt", "run", "PROBLEM", "-o", "my logs"]),
    ],
)
def test_a_command_to_type_takes_names_with_blanks(seaopt, folder, arguments, words):
    (folder / "my logs").mkdir()
    write_csv(folder / "my logs" / "ok.csv", ["time [s]", "F1 [N]"])
    (folder / "my logs" / "empty.csv").touch()
    (folder / "my logs" / "words.csv").write_text("a,b\nx,y\nz,w\n", encoding="utf-8")
    result = seaopt(*arguments)
    check_refused(result)
    typed = shlex.join(words)
    assert typed in result.stderr, result.stderr


@pytest.mark.parametrize("name", REFUSALS)
def test_what_is_refused_ends_with_what_to_type(seaopt, bad, folder, name):
    arguments, old, new = REFUSALS[name]
    text = BASE + EXPERIMENT + CONTROLLER
    assert old in text
    bad(text.replace(old, new, 1))
    (folder / "empty.csv").write_text("", encoding="utf-8")
    result = seaopt(*arguments)
    check_refused(result)
    assert REMEDY.search(result.stderr.strip()), result.stderr


@pytest.mark.parametrize(
    ("change", "words"), [({"schema": "seaopt/fit/1"}, "schema"), ({"made_from": {}}, "made_from"), ({"met": 3}, "")]
)
def test_a_stale_fit_is_refused_with_the_command_that_makes_it_again(copied, seaopt, change, words):
    path = copied / "all" / "fit.json"
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | change), encoding="utf-8")
    result = seaopt("tune", "short.toml", "-o", "all")
    check_refused(result, words)
    assert REMEDY.search(result.stderr.strip()), result.stderr


@pytest.mark.parametrize(
    ("arguments", "text", "command"),
    [
        (["fit", "p.toml"], "sigma is odd", "seaopt schema problem"),
        (["inspect", "a.csv"], "sigma is odd", "seaopt inspect --help"),
        (["fit", "p.toml"], "give sigma = 2", ""),
        (["fit", "p.toml"], "run seaopt fit first", ""),
    ],
)
def test_a_refusal_without_a_remedy_says_where_to_look(monkeypatch, capsys, arguments, text, command):
    command_line = sys.modules["seaopt.cli.main"]
    monkeypatch.setattr(sys, "argv", ["seaopt", *arguments])
    monkeypatch.setattr(command_line, "app", lambda **_: (_ for _ in ()).throw(so.SeaoptError(text)))
    with pytest.raises(SystemExit):
        command_line.main()
    assert capsys.readouterr().err.rstrip().endswith(command or text)
