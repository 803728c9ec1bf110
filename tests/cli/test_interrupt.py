"""Ctrl-C, and the command started as a module."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from functools import partial

import pytest
from typer.testing import CliRunner

import seaopt as so
from seaopt.cli import main
from seaopt.cli.main import app
from seaopt.cli.session import Session
from seaopt.machine import bring_up
from tests.cli.test_session import BENCH as FITTED
from tests.machine.simulator import Bench, Machine, multisine
from tests.machine.test_response import LINES


def test_the_package_runs_as_the_command():
    out = subprocess.run([sys.executable, "-m", "seaopt", "--version"], capture_output=True, text=True, check=False)
    assert (out.returncode, out.stdout[:7]) == (0, "seaopt ")


@pytest.mark.parametrize("module", ["seaopt.errors", "typer", "seaopt.cli.main"])
def test_ctrl_c_among_the_imports_is_one_line_too(module, tmp_path):
    """It came out as a traceback, or as an error of the import that it hit."""
    log = tmp_path / "log.csv"  # long enough that the command still reads it when the signal comes
    log.write_text("time,F1\n" + "".join(f"{1e-3 * k:.3f},{k % 7}\n" for k in range(100_000)))
    options = [sys.executable, "-X", "importtime", "-m", "seaopt", "inspect", str(log)]
    with subprocess.Popen(options, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        lines = []
        for line in process.stderr:
            lines.append(line)
            if line.split("|")[-1].strip() == module:
                os.kill(process.pid, signal.SIGSTOP)  # it is where it is, however slow this process is
                process.send_signal(signal.SIGINT)
                os.kill(process.pid, signal.SIGCONT)
    said = [line for line in lines if not line.startswith("import time:") and line.strip()]
    assert (process.returncode, said) == (130, ["seaopt: interrupted\n"])


def test_ctrl_c_is_one_line_and_exits_130(tmp_path, monkeypatch, capsys, design):
    def stop(*_):
        raise KeyboardInterrupt

    (tmp_path / "problem.toml").write_text(design, encoding="utf-8")
    monkeypatch.setattr(Session, "_tune", stop)
    monkeypatch.setattr(sys, "argv", ["seaopt", "tune", str(tmp_path / "problem.toml"), "-o", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as leaving:
        main()
    assert leaving.value.code == 130
    told = capsys.readouterr().err.strip().splitlines()
    assert told[-1] == f"seaopt: interrupted; what was finished is in {tmp_path / 'out'}"


BENCH = (
    FITTED
    + """[controller]
plant = "stand"
measured = "F1"
bandwidth_hz = 30
"""
)
KILLED = """
import os, signal, sys
import seaopt.estimation
from seaopt.cli import main
fit = sys.modules["seaopt.estimation.fit"]
fit.judge = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)
main()
"""


def test_a_fit_that_is_killed_as_it_is_judged_is_there_and_nobody_takes_it_for_met(tmp_path, capsys):
    """Until then its values are those of a run that ends: the plant's own, within its std."""
    problem, out = tmp_path / "problem.toml", tmp_path / "out"
    problem.write_text(BENCH, encoding="utf-8")
    arguments = [sys.executable, "-c", KILLED, "fit", str(problem), "-o", str(out)]
    assert subprocess.run(arguments, capture_output=True, check=False).returncode == -signal.SIGKILL
    assert [path.name for path in out.iterdir()] == ["fit.json"]
    content = json.loads((out / "fit.json").read_text(encoding="utf-8"))
    (error,) = (row for row in content["findings"] if row["severity"] == "error")
    assert content["met"] is False and error["kind"] == "unjudged" and content["status"] == "converged"
    inertia = content["parameters"]["J"]
    assert abs(inertia["value"] - 3.31e-6) < 5.0 * inertia["std"] < 0.02 * 3.31e-6
    session = Session(problem, out)
    session.run("tune")
    assert not session.met(["tune"]) and "it is not judged" in " ".join(capsys.readouterr().err.split())
    assert json.loads((out / "controller.json").read_text(encoding="utf-8"))["fit_met"] is False
    whole = Session(problem, out)
    whole.run("fit")
    assert whole.met(["fit"]) and whole.results["fit"].parameters["J"].value == inertia["value"]


def test_bringup_and_accept_say_that_a_fit_is_not_met(tmp_path, monkeypatch, capsys, compiler, without_simulation):
    """Both took it as met: they exited 0, and no file of theirs had a word of it."""
    monkeypatch.setattr("seaopt.cli.machine.bring_up", partial(bring_up, fractions=()))  # no slower laws are tuned

    def stop(*_, **__):
        raise KeyboardInterrupt

    def run(command, *arguments):
        return CliRunner().invoke(app, [command, str(problem), *arguments, "-o", str(out)])

    def read(name):
        return json.loads((out / name).read_text(encoding="utf-8"))

    problem, out = tmp_path / "problem.toml", tmp_path / "out"
    problem.write_text(
        BENCH + "max_sensitivity = 1.6\ncurrent_limit_A = 9.0\n[robustness]\nsamples = 5\n", encoding="utf-8"
    )
    session = Session(problem, out)
    with monkeypatch.context() as patch:
        patch.setattr(sys.modules["seaopt.estimation.fit"], "judge", stop)
        with pytest.raises(KeyboardInterrupt):
            session.run("fit")
    session = Session(problem, out)
    session.run("tune")
    capsys.readouterr()
    session.show(False, ["tune"])
    remedy = f"next: fit again, and mend what that names: seaopt fit {problem} -o {out}"
    assert remedy in " ".join(capsys.readouterr().out.split())
    log = Bench(compiler, tmp_path, session.law()).log(Machine(), multisine(1000, LINES, 8, 60.0, 3, bias=300.0))
    arguments = {"bringup": [], "accept": [str(so.write_log(log, tmp_path / "log.csv"))]}
    for command, name in (("bringup", "bringup/bringup.json"), ("accept", "acceptance.json")):
        done = run(command, *arguments[command])
        said = " ".join(done.output.split())
        assert done.exit_code == 1 and "on a fit that is not met" in said and "it is not judged" in said, said
        assert remedy in said
        content = read(name)
        assert content["met"] is False and content["fit_met"] is False
        assert "on a fit that is not met" in (out / name).with_suffix(".html").read_text(encoding="utf-8")
    assert read("bringup/full/controller.json")["fit_met"] is False
    assert "NOT MET: the fit" in (out / "bringup" / "full" / "force_law.h").read_text(encoding="utf-8")
    Session(problem, out).run("fit")
    Session(problem, out).run("tune")
    done = run("accept", *arguments["accept"])
    assert done.exit_code == 0 and read("acceptance.json")["fit_met"] is True, done.output
