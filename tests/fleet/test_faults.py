"""Faults in earnest: workers and clients killed, logs that hang, Ctrl-C, a full disk. Nothing is lost or twice."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from pathlib import Path

import polars as pl
import pytest

import seaopt as so
from seaopt.executors import Processes
from seaopt.fleet import worker
from tests.fleet.conftest import LOGS, compare, start

pytest.importorskip("fsspec")
ROOT = Path(__file__).resolve().parents[2]
SITE = os.pathsep.join(filter(None, [str(ROOT / "tests/fleet/site"), str(ROOT), os.environ.get("PYTHONPATH")]))
STARTED_S = 120.0  # on a machine that has other things to do


@pytest.fixture
def troubled(monkeypatch):
    """Let worker processes, and this one, know addresses that make trouble."""
    from fsspec import register_implementation

    monkeypatch.setenv("PYTHONPATH", SITE)
    register_implementation("trouble", "tests.fleet.trouble.Trouble", clobber=True)


def disturb(what, path):
    return f"trouble://{what}{path}"


def local(rows):
    """Return rows with local paths in place of the addresses that make trouble."""
    return rows.with_columns(pl.col("log").str.replace(r"trouble://\w+/", "/"))


def wait_for_rows(out, process, count=1):
    """Wait until a table has rows."""
    end = time.monotonic() + STARTED_S
    while time.monotonic() < end and process.poll() is None:
        parts = list((out / "fleet").glob("*.parquet"))
        if parts and sum(len(pl.read_parquet(part)) for part in parts) >= count:
            return
        time.sleep(0.05)
    raise AssertionError(process.communicate()[1])


def list_workers(pid):
    """Return the processes that a process has started, and those that they have."""
    found = subprocess.run(["ps", "-e", "-o", "pid=,ppid="], capture_output=True, text=True, check=True).stdout
    parents = dict(map(int, line.split()) for line in found.splitlines())
    return [child for child, parent in parents.items() if parent == pid or parents.get(parent) == pid]


@pytest.mark.slow
def test_a_log_that_kills_its_worker_is_blamed_alone(made, troubled, undisturbed):
    paths = sorted((made / "logs").glob("*.csv"))
    logs = [disturb("kill", paths[0]), *paths[1:]]
    with Processes(2) as executor:
        fleet = so.fit_fleet(made / "stand.toml", logs, executor=executor)
    bad = fleet.rows.filter(pl.col("status") == "failed")
    assert bad["log"].to_list() == [logs[0]] and "died on it 2 times" in bad["reason"][0]
    compare(fleet.rows.filter(pl.col("status") != "failed"), undisturbed.rows[1:])


@pytest.mark.slow
def test_a_log_that_hangs_is_stopped_also_where_python_cannot(made, troubled, limit_s):
    paths = sorted((made / "logs").glob("*.csv"))
    logs = [disturb("hang", paths[0]), disturb("lock", paths[1]), paths[2]]
    with Processes(2) as executor:
        fleet = so.fit_fleet(made / "stand.toml", logs, executor=executor, time_limit_s=limit_s)
    reasons = dict(zip(fleet.rows["log"], fleet.rows["reason"], strict=True))
    assert reasons[str(paths[2])] is None
    assert reasons[logs[0]].startswith(f"takes longer than the time limit of {limit_s:g} s")
    assert "died" in reasons[logs[1]] and f"time limit of {limit_s:g} s" in reasons[logs[1]]


class Deadly(Executor):
    """Works at once; a batch with a log of some name does not come back, nor what is handed over with it."""

    _max_workers = 2

    def __init__(self, name):
        self.name = name
        self.sizes = []

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        self.sizes.append(len(args[1]))
        if any(self.name in log.path for log in args[1]) or len(self.sizes) == 2:
            future.set_exception(BrokenExecutor("a process died"))
        else:
            future.set_result(fn(*args, **kwargs))
        return future


def test_what_was_lost_with_a_worker_is_tried_alone(made, undisturbed):
    executor = Deadly("r0_j0")
    fleet = so.fit_fleet(made / "stand.toml", [made / "logs/*.csv"], executor=executor)
    bad = fleet.rows.filter(pl.col("status") == "failed")
    assert [path[-9:] for path in bad["log"]] == ["r0_j0.csv"] and "died on it 2 times" in bad["reason"][0]
    compare(fleet.rows.filter(pl.col("status") != "failed"), undisturbed.rows[1:])
    assert executor.sizes[-3:] == [1, 1, 1]


def test_an_executor_that_is_broken_for_good_is_said(made):
    executor = ThreadPoolExecutor(1)
    executor.shutdown()
    with pytest.raises(so.SeaoptError, match="takes no more work"):
        so.fit_fleet(made / "stand.toml", [made / "logs/*.csv"], executor=executor)


@pytest.mark.parametrize(("number", "remedy"), [(errno.EMFILE, "ulimit -n 1024"), (errno.EAGAIN, "ulimit -u")])
def test_a_limit_on_the_workers_is_named(made, number, remedy):
    class Limited(ThreadPoolExecutor):
        def submit(self, *args, **kwargs):
            raise OSError(number, os.strerror(number))

    with Limited(1) as executor, pytest.raises(so.SeaoptError, match=f"takes no more work.*{remedy}"):
        so.fit_fleet(made / "stand.toml", [made / "logs/r0_j0.csv"], executor=executor)


def test_a_thread_that_hangs_is_stopped(made, monkeypatch):
    def hang(*_):
        while True:
            time.sleep(0.01)

    monkeypatch.setattr(worker, "_describe_fit", hang)
    with ThreadPoolExecutor(1) as executor:
        fleet = so.fit_fleet(made / "stand.toml", [made / "logs/r0_j0.csv"], executor=executor, time_limit_s=0.2)
    assert "time limit" in fleet.rows["reason"][0]


def test_a_bug_in_one_fit_does_not_stop_the_others(made, monkeypatch):
    def fail(plan, log, known):
        raise ZeroDivisionError("no luck")

    monkeypatch.setattr(worker, "_describe_fit", fail)
    with ThreadPoolExecutor(1) as executor:
        fleet = so.fit_fleet(made / "stand.toml", [made / "logs/*.csv"], executor=executor)
    assert fleet.reasons == (("ZeroDivisionError: no luck", LOGS, str(made / "logs/r0_j0.csv")),)


def test_a_truncated_log_is_said(stand):
    path = stand / "logs/r0_j0.parquet"
    pl.read_csv(stand / "logs/r0_j0.csv").write_parquet(path)
    path.write_bytes(path.read_bytes()[:-100])
    with ThreadPoolExecutor(1) as executor:
        fleet = so.fit_fleet(stand / "stand.toml", [path, stand / "logs/r0_j1.csv"], executor=executor)
    assert fleet.counts == {"met": 1, "not met": 0, "failed": 1}
    assert "r0_j0.parquet" in fleet.reasons[0][2]


@pytest.mark.slow
@pytest.mark.parametrize("how", ["worker killed", "client killed", "interrupted"])
def test_what_was_done_stays_and_the_rest_is_done_again(made, tmp_path, undisturbed, how):
    logs = [disturb("slow", path) for path in sorted((made / "logs").glob("*.csv"))]
    order = (made / "stand.toml", *logs, "-o", tmp_path / "out", "--workers", 2)
    process = start(*order, cwd=tmp_path, PYTHONPATH=SITE)
    if how == "worker killed":
        end = time.monotonic() + STARTED_S
        while len(workers := list_workers(process.pid)) < 3 and time.monotonic() < end:  # and multiprocessing's own
            time.sleep(0.05)
        time.sleep(2.0)
        os.kill(workers[-1], signal.SIGKILL)
        _, told = process.communicate(timeout=STARTED_S)
        assert process.returncode == 0, told
    else:
        wait_for_rows(tmp_path / "out", process)
        workers = list_workers(process.pid)
        if how == "client killed":
            process.kill()
        else:
            os.killpg(process.pid, signal.SIGINT)
        _, told = process.communicate(timeout=STARTED_S)
        if how == "interrupted":
            assert process.returncode == 130 and "goes on from there" in told
            assert "Traceback" not in told
        kept = sum(len(pl.read_parquet(part)) for part in (tmp_path / "out/fleet").glob("*.parquet"))
        assert kept > 0
        end = time.monotonic() + 20.0
        while any(Path(f"/proc/{pid}").exists() for pid in workers) and time.monotonic() < end:
            time.sleep(0.1)
        assert not [pid for pid in workers if Path(f"/proc/{pid}").exists()]  # no orphans
        again = start(*order, "--json", cwd=tmp_path, PYTHONPATH=SITE)
        _, told = again.communicate(timeout=STARTED_S)
        assert again.returncode == 0, told
    compare(local(pl.read_parquet(tmp_path / "out/fleet")), undisturbed.rows)


def fill_up(path):
    handle = os.open(path, os.O_WRONLY | os.O_CREAT)
    try:
        while os.write(handle, b"0" * 512):
            pass
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
    finally:
        os.close(handle)


@pytest.fixture
def small_disk(tmp_path):
    """Return the folder of a disk of 128 kB, or skip: half of it for parts that are not merged yet."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = shutil.which("mount")
    if (
        mount is None
        or subprocess.run(
            [mount, "-t", "tmpfs", "-o", "size=128k", "tmpfs", place], capture_output=True, check=False
        ).returncode
    ):
        pytest.skip("no disk of its own can be mounted here")
    yield place
    subprocess.run(["umount", "-l", place], check=True)


@pytest.mark.skipif(sys.platform != "linux", reason="tmpfs")
def test_a_full_disk_loses_nothing_that_was_written(made, small_disk, undisturbed):
    fill, out = small_disk / "fill", small_disk / "out"
    with ThreadPoolExecutor(1) as executor:
        so.fit_fleet(made / "stand.toml", [made / "logs/r0_*.csv"], out, executor=executor)
        fill_up(fill)
        with pytest.raises(so.SeaoptError, match="No space left"):
            so.fit_fleet(made / "stand.toml", [made / "logs/*.csv"], out, executor=executor)
        assert len(pl.read_parquet(out / "fleet")) == 4
        fill.unlink()
        fleet = so.fit_fleet(made / "stand.toml", [made / "logs/*.csv"], out, executor=executor)
    assert fleet.unchanged == 4
    compare(pl.read_parquet(out / "fleet"), undisturbed.rows)


def test_a_worker_of_another_version_is_refused(made, monkeypatch):
    monkeypatch.setattr(worker, "VERSION", "0.0.1")
    with ThreadPoolExecutor(1) as executor:
        fleet = so.fit_fleet(made / "stand.toml", [made / "logs/r0_j0.csv"], executor=executor)
    assert "has seaopt 0.0.1, the client" in fleet.rows["reason"][0]
