"""Ctrl-C, and the command started as a module."""

from __future__ import annotations

import subprocess
import sys

import pytest

from seaopt.cli import main
from seaopt.cli.session import Session


def test_the_package_runs_as_the_command():
    out = subprocess.run([sys.executable, "-m", "seaopt", "--version"], capture_output=True, text=True, check=False)
    assert (out.returncode, out.stdout[:7]) == (0, "seaopt ")


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
