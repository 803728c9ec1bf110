"""A fleet of short logs, made once; its problem file; and what compares tables."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import seaopt as so

LOGS = 12
PROBLEM = """
schema = 1
[parameters]
J = { value = 2e-6, free = true }
b_r = { value = 2e-4, free = true }
[plant.stand]
kind = "high_impedance"
[[experiment]]
name = "test"
plant = "stand"
log = "logs/r0_j0.csv"
time = "time [s]"
inputs = { I = "I [A]" }
outputs = { F1 = "F1 [N]" }
"""
TIMES = ["fit_s", "total_s"]


def write_log(path, seed, J=3.31e-6, n=800):
    plant, rng = so.plants.high_impedance(), np.random.default_rng(seed)
    drive = so.Log.from_arrays(time=np.arange(n) / 400, I=np.convolve(rng.normal(size=n), np.ones(5) / 5, "same"))
    force = so.simulate(plant, so.plants.thor().update(J=J), drive)["F1"] + 0.5 * rng.normal(size=n)
    table = np.column_stack([drive.time, drive["I"], force])
    np.savetxt(path, table, delimiter=",", header="time [s],I [A],F1 [N]", comments="")


@pytest.fixture(scope="session")
def made(tmp_path_factory) -> Path:
    """Return a folder with a problem file and its logs. Not to be changed."""
    folder = tmp_path_factory.mktemp("fleet")
    (folder / "logs").mkdir()
    (folder / "stand.toml").write_text(PROBLEM, encoding="utf-8")
    for k in range(LOGS):
        write_log(folder / "logs" / f"r{k // 4}_j{k % 4}.csv", k, J=3.31e-6 * (1.0 + 0.01 * k))
    return folder


@pytest.fixture(scope="session")
def undisturbed(made):
    """Return what comes of all logs where nothing goes wrong."""
    with ThreadPoolExecutor(1) as executor:
        return so.fit_fleet(made / "stand.toml", [made / "logs/*.csv"], executor=executor)


@pytest.fixture(scope="session")
def limit_s(undisturbed) -> float:
    """Return a time limit that no healthy log reaches, however busy the machine: three times the slowest, or 5 s."""
    return float(np.ceil(max(5.0, 3.0 * undisturbed.rows["total_s"].max())))


@pytest.fixture
def stand(made, tmp_path) -> Path:
    """Return a copy of that folder, of the test's own."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    return tmp_path


def compare(one: pl.DataFrame, other: pl.DataFrame, folders=("", "")) -> None:
    """Check that two tables have the same rows, bit for bit, whatever the clock said."""
    frames = [
        table.drop(TIMES).with_columns(pl.col("log", "reason").str.replace_all(str(folder), "", literal=True))
        for table, folder in zip((one, other), folders, strict=True)
    ]
    assert frames[0]["log"].n_unique() == len(frames[0])
    assert frames[0].sort("log").equals(frames[1].sort("log"))


def start(*arguments, cwd, **environment):
    """Start the command as a user does, in a process group of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "seaopt", "fleet", *map(str, arguments)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=cwd, start_new_session=True,
        env={**os.environ, "COLUMNS": "200", **environment},
    )  # fmt: skip
