"""One finished run that every test of the command shares, and the command called in this process."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import seaopt as so
from seaopt.cli import main
from seaopt.robustness.certificate.simulated import SIMULATIONS
from tests.checks import leave_out

DEMO = so.demo_path().read_text(encoding="utf-8")
SHORTER = {
    "duration_s = 164": "duration_s = 20",
    "duration_s = 60, rate_hz = 400, noise_std = { F1 = 2.0, F2": "duration_s = 6, rate_hz = 400, noise_std = { F1",
    "samples = 1375": "samples = 60",
}
SHORT = DEMO
for _long, _short in SHORTER.items():
    assert _long in SHORT
    SHORT = SHORT.replace(_long, _short)


def run_process(*arguments, cwd):
    """Run the command as a user does, with warnings as errors."""
    return subprocess.run(
        [sys.executable, "-W", "error", "-m", "seaopt.cli", *map(str, arguments)],
        capture_output=True, text=True, check=False, cwd=cwd, env={**os.environ, "COLUMNS": "200"},
    )  # fmt: skip


@pytest.fixture(scope="session")
def short() -> str:
    """Return a problem file's text: the demo's on short logs, with few draws."""
    return SHORT


@pytest.fixture(scope="session")
def stand_alone(short) -> str:
    """Return the same problem with the first experiment alone."""
    return short[: short.rindex("[[experiment]]")] + short[short.index("[fit]") :]


@pytest.fixture(scope="session")
def design() -> str:
    """Return the same problem without experiments, at about the values that they give."""
    text = SHORT[: SHORT.index("[[experiment]]")] + SHORT[SHORT.index("[controller]") :]
    for guess, fitted in (("1.5e-6", "3.31e-6"), ("4e-4", "1.31e-4"), ("0.7", "0.95"), ("free = true", "free = false")):
        text = text.replace(guess, fitted)
    return text


@pytest.fixture(scope="session")
def done(tmp_path_factory):
    """Return a run of `short` that is over; its `folder` holds short.toml and the results in all. Not to be changed."""
    folder = tmp_path_factory.mktemp("cli")
    (folder / "short.toml").write_text(SHORT, encoding="utf-8")
    process = run_process("run", "short.toml", "-o", "all", cwd=folder)
    return SimpleNamespace(
        folder=folder, returncode=process.returncode, stdout=process.stdout, stderr=process.stderr,
        results=folder / "all",
    )  # fmt: skip


@pytest.fixture
def folder(tmp_path, short) -> Path:
    """Return a folder with short.toml, of the test's own."""
    (tmp_path / "short.toml").write_text(short, encoding="utf-8")
    return tmp_path


@pytest.fixture
def copied(folder, done) -> Path:
    """Return that folder with a copy of the finished results in all, for a test that changes them."""
    shutil.copytree(done.results, folder / "all")
    return folder


@pytest.fixture
def seaopt(folder, monkeypatch, capsys):
    """Return what runs the command in `folder` in this process: quicker than a new one."""
    monkeypatch.chdir(folder)
    monkeypatch.setenv("COLUMNS", "200")

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["seaopt", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        output = capsys.readouterr()
        return SimpleNamespace(returncode=int(end.value.code or 0), stdout=output.out, stderr=output.err)

    return call


@pytest.fixture
def without_simulation(monkeypatch):
    """Let `certify` leave out the simulations: the finished run has them."""
    leave_out(monkeypatch, SIMULATIONS)
