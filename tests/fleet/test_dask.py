"""A fleet on a Dask cluster of separate processes: workers killed, scheduler restarted, encrypted."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import polars as pl
import pytest

import seaopt as so
from seaopt.executors import connect_dask
from tests.fleet.conftest import compare, start

pytest.importorskip("distributed")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]
ROOT = Path(__file__).resolve().parents[2]
SITE = os.pathsep.join(filter(None, [str(ROOT / "tests/fleet/site"), str(ROOT), os.environ.get("PYTHONPATH")]))
STARTED_S = 180.0


def find_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def run_module(module, *arguments, **environment):
    return subprocess.Popen(
        [sys.executable, "-m", module, *map(str, arguments)], start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": SITE, "DASK_DISTRIBUTED__WORKER__DAEMON": "True", **environment},
    )  # fmt: skip


def start_scheduler(port, *arguments, **environment):
    options = ("--host", "127.0.0.1", "--port", port, "--no-dashboard", *arguments)
    return run_module("distributed.cli.dask_scheduler", *options, **environment)


def start_workers(address, folder):
    options = ("--nworkers", 2, "--nthreads", 1, "--no-dashboard", "--local-directory", folder)
    return run_module("distributed.cli.dask_worker", address, *options)


@contextmanager
def cluster(folder, scheme="tcp", **environment):
    """Yield address, scheduler's and worker's processes of a cluster with two workers under nannies."""
    port = find_port()
    address = f"{scheme}://127.0.0.1:{port}"
    processes = [start_scheduler(port, *(("--protocol", scheme) if scheme == "tls" else ()), **environment)]
    processes.append(start_workers(address, folder))
    try:
        yield address, processes, port
    finally:
        for process in processes:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def list_workers(address):
    """Return the pids of a cluster's workers, once there are two."""
    from distributed import Client

    with Client(address, timeout=STARTED_S, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=STARTED_S)
        return list(client.run(os.getpid).values())


def local(rows):
    return rows.with_columns(pl.col("log").str.replace(r"trouble://\w+/", "/"))


def wait_for_rows(out, process):
    end = time.monotonic() + STARTED_S
    while not list((out / "fleet").glob("*.parquet")):
        assert process.poll() is None and time.monotonic() < end, process.communicate()
        time.sleep(0.05)


def test_the_same_table_from_a_cluster_also_where_a_log_kills_workers(
    made, tmp_path, undisturbed, limit_s, monkeypatch
):
    paths = sorted((made / "logs").glob("*.csv"))
    monkeypatch.setenv("PYTHONPATH", SITE)
    # Dask itself would give a log to four workers, one after another, each time the fleet tries it.
    with cluster(tmp_path, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="0") as (address, _, _):
        list_workers(address)
        with connect_dask(address) as executor:
            logs = [f"trouble://kill{paths[0]}", f"trouble://hang{paths[1]}", *paths[2:]]
            fleet = so.fit_fleet(made / "stand.toml", logs, executor=executor, time_limit_s=limit_s)
    bad = fleet.rows.filter(pl.col("status") == "failed")
    assert sorted(bad["log"]) == sorted(logs[:2])
    compare(fleet.rows.filter(pl.col("status") != "failed"), undisturbed.rows[2:])


@pytest.mark.parametrize("what", ["worker", "scheduler"])
def test_what_dies_mid_run_loses_nothing(made, tmp_path, undisturbed, what):
    logs = [f"trouble://slow{path}" for path in sorted((made / "logs").glob("*.csv"))]
    with cluster(tmp_path / "work") as (address, processes, port):
        pids = list_workers(address)
        process = start(
            made / "stand.toml", *logs, "-o", tmp_path / "out", "--scheduler", address, cwd=tmp_path, PYTHONPATH=SITE
        )
        wait_for_rows(tmp_path / "out", process)
        if what == "worker":
            os.kill(pids[0], signal.SIGKILL)
        else:
            for old in processes:  # Dask's workers end with their scheduler
                os.killpg(old.pid, signal.SIGKILL)
                old.wait()
            processes[:] = [start_scheduler(port), start_workers(address, tmp_path / "again")]
        _, told = process.communicate(timeout=STARTED_S)
    assert process.returncode == 0, told
    compare(local(pl.read_parquet(tmp_path / "out/fleet")), undisturbed.rows)


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    """Return a folder with the key and certificate of an authority, and one that it has signed."""
    folder = tmp_path_factory.mktemp("tls")
    if shutil.which("openssl") is None:
        pytest.skip("no openssl")
    new = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2"]
    for name, subject in (("one", "/CN=127.0.0.1"), ("stranger", "/CN=stranger")):
        files = ["-keyout", f"{name}.key", "-out", f"{name}.pem", "-subj", subject]
        subprocess.run([*new, *files], cwd=folder, check=True, capture_output=True)
    return folder


def make_settings(folder, name):
    """Return Dask's settings of TLS as environment variables."""
    settings = {"DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION": "true"}
    settings["DASK_DISTRIBUTED__COMM__TLS__CA_FILE"] = str(folder / "one.pem")
    for role in ("CLIENT", "SCHEDULER", "WORKER"):
        settings[f"DASK_DISTRIBUTED__COMM__TLS__{role}__CERT"] = str(folder / f"{name}.pem")
        settings[f"DASK_DISTRIBUTED__COMM__TLS__{role}__KEY"] = str(folder / f"{name}.key")
    return settings


def test_a_fleet_over_tls_and_no_stranger(made, tmp_path, undisturbed, certificates, monkeypatch):
    for name, value in make_settings(certificates, "one").items():
        monkeypatch.setenv(name, value)
    order = (made / "stand.toml", made / "logs/*.csv", "-o", tmp_path / "out", "--scheduler")
    with cluster(tmp_path / "work", "tls") as (address, _, _):
        process = start(*order, address, cwd=tmp_path, PYTHONPATH=SITE)
        _, told = process.communicate(timeout=STARTED_S)
        assert process.returncode == 0, told
        compare(pl.read_parquet(tmp_path / "out/fleet"), undisturbed.rows)
        stranger = start(*order, address, cwd=tmp_path, PYTHONPATH=SITE, **make_settings(certificates, "stranger"))
        _, told = stranger.communicate(timeout=STARTED_S)
        assert stranger.returncode == 2 and "does not answer" in told
