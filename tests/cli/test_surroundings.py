"""Names of files, locales and limits of the system as they come: one line and exit code 2, or the result."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import polars as pl
import pytest

import seaopt as so
from seaopt.__main__ import main
from seaopt.errors import LogError
from tests.fleet.conftest import PROBLEM, write_log

LOG = {"time": "time [s]", "channels": {"I": "I [A]", "F1": "F1 [N]"}}


@pytest.fixture
def stand(folder):
    """Return a folder with stand.toml and r0.csv, and room for what is not UTF-8."""
    (folder / "stand.toml").write_text(PROBLEM, encoding="utf-8")
    write_log(folder / "r0.csv", 0)
    return folder


@pytest.mark.skipif(sys.platform != "linux", reason="names of other systems are text")
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((b"l\xff.csv",), "the fleet's table cannot name it: rename the log"),
        ((b"*.csv",), "the fleet's table cannot name it: rename the log"),
        ((b"--manifest", b"l\xff.csv"), "rename the manifest"),
        ((b"r0.csv", b"-o", b"o\xff"), "a fleet's tables cannot lie there; give another folder"),
    ],
)
def test_a_fleet_says_which_names_no_table_can_hold(stand, seaopt, arguments, words):
    shutil.copy(stand / "r0.csv", os.fsencode(stand) + b"/l\xff.csv")
    done = seaopt("fleet", "stand.toml", *map(os.fsdecode, arguments))
    assert done.returncode == 2 and words in done.stderr and len(done.stderr.splitlines()) == 1, done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="names of other systems are text")
def test_a_parquet_log_whose_name_is_not_utf8_is_refused(stand):
    frame = pl.DataFrame({"time [s]": [0.0, 0.1, 0.2], "I [A]": [1.0, 2.0, 3.0], "F1 [N]": [1.0, 1.0, 2.0]})
    frame.write_parquet(stand / "good.parquet")
    name = os.fsdecode(os.fsencode(stand) + b"/l\xff.parquet")
    shutil.copy(stand / "good.parquet", name)
    with pytest.raises(LogError, match="is not UTF-8; Polars cannot open it: rename the file"):
        so.read_log(name, **LOG)


@pytest.mark.skipif(sys.platform != "linux", reason="names of other systems are text")
def test_a_log_named_in_utf8_on_a_system_of_another_encoding_has_the_remedy(stand):
    os.rename(stand / "r0.csv", os.fsencode(stand) + "/größe.csv".encode())  # noqa: PTH104
    text = PROBLEM.replace("logs/r0_j0.csv", "größe.csv")
    (stand / "stand.toml").write_text(text, encoding="utf-8")
    environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [sys.executable, "-m", "seaopt.cli", "fit", "stand.toml"]
    done = subprocess.run(command, capture_output=True, check=False, cwd=stand, env=environment)
    assert done.returncode == 2 and b"names of files are ascii here: set PYTHONUTF8=1" in done.stderr, done.stderr
    done = subprocess.run(command, capture_output=True, check=False, cwd=stand, env=environment | {"PYTHONUTF8": "1"})
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("stated", "taken"), [(None, "1"), ("4", "4")])
def test_commands_take_one_thread_of_blas_unless_told_otherwise(monkeypatch, stated, taken):
    """With two on busy cores, the fit of all gains in `seaopt accept` takes ten times the processor time."""
    monkeypatch.setattr(sys.modules["seaopt.cli.main"], "main", lambda: None)
    monkeypatch.setattr(sys, "argv", ["seaopt", "accept"])
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", stated or "")
    if stated is None:
        monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    main()
    assert os.environ["OPENBLAS_NUM_THREADS"] == taken
