"""seaopt beside other estimators, on one problem and one machine: `make bench-peers`.

    python benchmarks/peers/run.py [--only jax,seaopt] [--rounds 3] [--limit 200] [--folder DIR] [--write]

The problem is in problem.py, each peer in a script of its own, which also runs by itself. Peers live in virtual
environments under ~/.cache/seaopt-peers, made with `python -m venv` and `pip install -r requirements/NAME.txt`; seaopt
runs from this checkout in the interpreter that runs this file. A peer that cannot be installed, fails or takes too long
is a row that says so.

Times are in seconds of wall clock. "first process" has nothing compiled on disk, for seaopt and JAX alike; "next
process" finds what the first left (imports, set-up and one solve, the best of the rounds); "warm" is another solve in
the same process, the best of all. Rounds go through the peers in turn, so that a busy moment of a shared machine does
not fall on one of them. BLAS has one thread: two, on two busy cores, made the SciPy peers two to three times slower.
Peers take one Runge-Kutta step a sample, which biases no parameter by more than 0.2 standard deviations; seaopt chooses
its own number, under its rule that no output be wrong by more than a hundredth of the noise.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
CACHE = Path.home() / ".cache" / "seaopt-peers"
QUICK_S = 30.0  # a peer whose first process takes longer is not run again
REPEAT = 4
TOLD = ("version", "evaluations", "parameters", "error_sigma", "peak_rss_mb", "note")
RESERVE_S = 15.0  # of the limit, for a slow peer to stop by itself and tell what it has

Row = dict[str, Any]


class PeerError(Exception):
    """A peer has no result; the message is its remark in the table."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Peer:
    """A script, the environment it runs in (none: this interpreter) and its arguments."""

    script: str
    venv: str = ""
    name: str = ""
    arguments: tuple[str, ...] = ()


PEERS = {
    "seaopt": Peer(script="peer_seaopt.py"),
    "jax": Peer(script="peer_jax.py", venv="jax"),
    "jax4": Peer(
        script="peer_jax.py", venv="jax", name="the same, 4 steps a sample as seaopt", arguments=("--substeps", "4")
    ),
    "optimistix": Peer(script="peer_optimistix.py", venv="jax"),
    "casadi": Peer(script="peer_casadi.py", venv="casadi"),
    "multiple_shooting": Peer(script="peer_multiple_shooting.py", venv="casadi"),
    "mujoco": Peer(script="peer_mujoco.py", venv="mujoco"),
    "jax_sysid": Peer(script="peer_jax_sysid.py", venv="jax_sysid"),
    "lmfit": Peer(script="peer_lmfit.py", venv="casadi"),
}


@dataclass(slots=True)
class Runs:
    """What a peer's processes told: the first one's row, and the times of all."""

    first: Row
    again: list[Row] = field(default_factory=list)


def last_line(text: str) -> str:
    """Return the last line that says something, shortened."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1][:160] if lines else "no message"


def interpreter(venv: str, folder: Path) -> Path:
    """Return the interpreter of a virtual environment, made and filled when it is missing or out of date."""
    if not venv:
        return Path(sys.executable)
    home, wanted = folder / venv, HERE / "requirements" / f"{venv}.txt"
    python, stamp = home / "bin" / "python", home / "requirements.txt"
    if stamp.exists() and stamp.read_text() == wanted.read_text():
        return python
    print(f"installing {wanted.name} in {home}", file=sys.stderr)
    for command in (
        [sys.executable, "-m", "venv", "--clear", str(home)],
        [str(python), "-m", "pip", "install", "--quiet", "-r", str(wanted)],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise PeerError(f"not installed: {last_line(done.stderr)}")
    stamp.write_text(wanted.read_text())
    return python


def data_file(folder: Path) -> Path:
    """Return the problem's data, made when problem.py has changed."""
    source = HERE / "problem.py"
    path = folder / f"problem-{hashlib.sha256(source.read_bytes()).hexdigest()[:12]}.npz"
    if not path.exists():
        print(f"making {path}", file=sys.stderr)
        subprocess.run([sys.executable, str(source), str(path)], check=True)
    return path


def environment(cache: Path) -> dict[str, str]:
    """Return the environment of a peer: one BLAS thread, and compiled code kept in `cache`."""
    return {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "SEAOPT_CACHE_DIR": str(cache),
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }


def run(peer: Peer, python: Path, data: Path, cache: Path, *, repeat: int, limit_s: float) -> Row:
    """Run a peer in a process of its own; its row, with the seconds of a process that solves once."""
    own_limit = str(limit_s - RESERVE_S)
    command = [str(python), str(HERE / peer.script), str(data), "--repeat", str(repeat), "--limit", own_limit]
    started = time.perf_counter()
    process = subprocess.Popen(
        [*command, *peer.arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=environment(cache), start_new_session=True,
    )  # fmt: skip
    try:
        out, err = process.communicate(timeout=limit_s)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        raise PeerError(f"no result in {limit_s:.0f} s") from None
    wall = time.perf_counter() - started
    told = [line for line in out.splitlines() if line.startswith("{")]
    if process.returncode or not told:
        raise PeerError(f"failed: {last_line(err)}")
    row: Row = json.loads(told[-1])
    return {**row, "process_s": wall - sum(row["warm_s"])}


def measure(keys: Iterable[str], folder: Path, rounds: int, limit_s: float) -> dict[str, Runs | str]:
    """Run every peer once on empty caches, and the quick ones again in rounds."""
    data = data_file(folder)
    found: dict[str, Runs | str] = {}
    with tempfile.TemporaryDirectory(prefix="seaopt-peers-") as scratch:

        def once(key: str, repeat: int) -> Row:
            print(f"{time.strftime('%H:%M:%S')} {key}", file=sys.stderr)
            python = interpreter(PEERS[key].venv, folder)
            return run(PEERS[key], python, data, Path(scratch) / key, repeat=repeat, limit_s=limit_s)

        for key in keys:
            try:
                found[key] = Runs(first=once(key, 1))
            except PeerError as error:
                found[key] = str(error)
        for _ in range(rounds):
            for key, runs in found.items():
                if not isinstance(runs, Runs) or runs.first["process_s"] > QUICK_S:
                    continue
                try:
                    runs.again.append(once(key, REPEAT))
                except PeerError as error:
                    print(f"{key}: {error}", file=sys.stderr)
    return found


def summary(key: str, runs: Runs | str) -> Row:
    """Return a peer's figures: best times, and what its first process said."""
    peer = PEERS[key]
    if isinstance(runs, str):
        return {"key": key, "peer": peer.name or key, "note": runs}
    first, again = runs.first, runs.again
    return {
        **{name: first[name] for name in TOLD},
        "key": key,
        "peer": peer.name or first["peer"],
        "first_process_s": first["process_s"],
        "next_process_s": min((row["process_s"] for row in again), default=None),
        "setup_s": min(row["setup_s"] for row in [first, *again]),
        "solve_s": first["solve_s"],
        "warm_s": min((s for row in again for s in row["warm_s"]), default=None),
        "warm_cpu_s": min((s for row in again for s in row["solve_cpu_s"][1:]), default=None),
    }


def shown(value: float | None, digits: str = ".2f") -> str:
    """Return a figure of the table, or a dash."""
    return "–" if value is None else format(value, digits)


def ratio(row: Row, base: Row | None, name: str) -> str:
    """Return how many times seaopt's a figure is; a slow peer's only process or solve counts as its best."""
    only = {"next_process_s": "first_process_s", "warm_s": "solve_s"}[name]
    value = row.get(name) or row.get(only)
    own = base and (base.get(name) or base.get(only))
    return f"{value / own:.1f}" if value and own else "–"


def table(rows: list[Row]) -> str:
    """Return the rows in markdown."""
    base = next((row for row in rows if row["key"] == "seaopt" and "solve_s" in row), None)
    head = (
        "peer", "version", "first process", "next process", "x seaopt", "set-up", "first solve", "warm solve",
        "of CPU", "x seaopt", "evaluations", "largest error, std", "peak MB", "remark",
    )  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for row in rows:
        cells = (
            row["peer"], row.get("version", "–"), shown(row.get("first_process_s")), shown(row.get("next_process_s")),
            ratio(row, base, "next_process_s"), shown(row.get("setup_s")), shown(row.get("solve_s")),
            shown(row.get("warm_s"), ".3f"), shown(row.get("warm_cpu_s"), ".3f"), ratio(row, base, "warm_s"),
            str(row.get("evaluations") or "–"), shown(row.get("error_sigma"), ".3g"),
            shown(row.get("peak_rss_mb"), ".0f"), row["note"],
        )  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def machine() -> Row:
    """Return what the times depend on."""
    load = [round(value, 2) for value in os.getloadavg()]
    return {"python": platform.python_version(), "system": platform.platform(), "cores": os.cpu_count(), "load": load}


def chosen(text: str | None) -> list[str]:
    """Return the peers asked for, in the order of the table."""
    names = list(PEERS) if text is None else [name.strip() for name in text.split(",")]
    for name in names:
        if name not in PEERS:
            raise SystemExit(f'--only: "{name}" is not a peer; choose from {", ".join(PEERS)}')
    return [name for name in PEERS if name in names]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="seaopt beside other estimators")
    parser.add_argument("--only", help=f"some of {','.join(PEERS)}")
    parser.add_argument("--rounds", type=int, default=3, help="of the quick peers, after the first process")
    parser.add_argument("--limit", type=float, default=200.0, help="seconds a process may take")
    parser.add_argument("--folder", type=Path, default=CACHE, help="of virtual environments and data")
    parser.add_argument("--write", action="store_true", help="write results.json beside this file")
    asked = parser.parse_args()
    if asked.limit <= 2 * RESERVE_S:
        raise SystemExit(f"--limit {asked.limit:g} is too short; give more than {2 * RESERVE_S:g} s")
    asked.folder.mkdir(parents=True, exist_ok=True)
    before = machine()
    found = measure(chosen(asked.only), asked.folder.resolve(), asked.rounds, asked.limit)
    rows = [summary(key, runs) for key, runs in found.items()]
    after = machine()
    print(table(rows))
    busy = f"load {before['load'][0]} before and {after['load'][0]} after"
    print(f"\n{before['system']}, Python {before['python']}, {before['cores']} cores, {busy}")
    if asked.write:
        content = {"before": before, "after": after, "peers": rows}
        (HERE / "results.json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
