"""Ctrl-C, and the command started as a module."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from seaopt.cli import main
from seaopt.cli.session import Session


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
