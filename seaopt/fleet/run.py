"""The same fit over many logs, wherever they lie and whichever of them fail."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import polars as pl

from seaopt.errors import FileError, LogError, SeaoptError, require_number
from seaopt.executors import Processes, check_executor
from seaopt.files import check_folder, check_name, read_json, to_json, write_json
from seaopt.fleet.dispatch import Dispatcher
from seaopt.fleet.logs import FleetLog, find_logs
from seaopt.fleet.plan import list_columns, make_plan
from seaopt.fleet.result import FLEET_SCHEMA, Fleet
from seaopt.fleet.table import FleetTable, find_done, make_schema, note_short_logs, read_rows
from seaopt.fleet.worker import FAILED, MET, NOT_MET, UNCHANGED, name_process
from seaopt.problem import Problem, read_problem
from seaopt.progress import Progress, ignore

TIME_LIMIT_S = 600.0


def fit_fleet(
    problem: Problem | Path | str,
    logs: Sequence[str | Path | FleetLog],
    folder: Path | str | None = None,
    *,
    executor: Executor | None = None,
    like: str | None = None,
    identity: str | None = None,
    time_limit_s: float | None = TIME_LIMIT_S,
    progress: Progress = ignore,
) -> Fleet:
    """Fit each of many logs by itself, as one experiment of a problem says: a `Fleet`, one row each.

    Parameters
    ----------
    problem : Problem, or path of a problem file
        Its plant, parameters and [fit]; its experiment with a log says how each is read, with slice, offsets, sigma.
    logs : sequence of str, Path or FleetLog
        Files, patterns such as ``"logs/**/*.csv"``, addresses that fsspec opens, or what `read_manifest` returns.
    folder : Path or str, optional
        Where the table is, and stays: logs that are done there, with the same content, problem and version, are not
        fitted again, those that failed are. In memory only, if left out.
    executor : Executor, optional
        Any of `concurrent.futures`, whose workers see the same files: `seaopt.executors.Processes()` if left out, or
        what `seaopt.executors.connect_dask` yields.
    like : str, optional
        The experiment that says how logs are read; the first with a log if left out.
    identity : str, optional
        As in `find_logs`: ``"{robot}/{actuator}_{run}.csv"``.
    time_limit_s : float or None
        For one log; None for none.
    progress : callable, optional
        Called with what is done and the share of it (`seaopt.progress.Progress`).

    Raises
    ------
    SeaoptError
        There are no logs; the problem does not say how to read one; the table cannot be written (what is written
        stays, and the same call goes on from there); the executor takes no more work.

    Examples
    --------
    >>> import tempfile
    >>> from concurrent.futures import ThreadPoolExecutor
    >>> import seaopt as so
    >>> from seaopt.bench import PAPER_STAND
    >>> folder = Path(tempfile.mkdtemp())
    >>> _ = (folder / "stand.toml").write_text('''
    ... schema = 1
    ... parameters = { J = { value = 2e-6, free = true }, b_r = { value = 2e-4, free = true } }
    ... plant.stand.kind = "high_impedance"
    ... [[experiment]]
    ... name = "test"
    ... plant = "stand"
    ... log = "first.csv"
    ... time = "time [s]"
    ... inputs = { I = "I [A]" }
    ... outputs = { F1 = "F1 [N]" }
    ... ''')
    >>> plant, truth, cells = so.plants.high_impedance(), so.plants.thor(), so.Sensors(noise_std={"F1": 2.0})
    >>> for n in (1, 2):
    ...     log = so.virtual_log(plant, truth, PAPER_STAND, duration_s=5, rate_hz=400, seed=n, sensors=cells)
    ...     _ = so.write_log(log, folder / f"joint{n}.csv")
    >>> with ThreadPoolExecutor(1) as executor:
    ...     fleet = so.fit_fleet(folder / "stand.toml", [folder / "joint*.csv"], executor=executor,
    ...                          identity="{joint}.csv")
    >>> fleet.counts, fleet.rows["joint"].to_list()
    ({'met': 2, 'not met': 0, 'failed': 0}, ['joint1', 'joint2'])
    """
    check_executor(executor)
    problem = problem if isinstance(problem, Problem) else read_problem(problem)
    if time_limit_s is not None and not require_number(time_limit_s, "time_limit_s") > 0.0:
        raise SeaoptError(f"time_limit_s = {time_limit_s:g} leaves no time; give seconds above zero, or None")
    chosen = _choose_logs(logs, identity)
    plan = make_plan(problem, like, time_limit_s, name_process())
    columns, names = list_columns(plan.make_problem()), list(chosen[0].identity)
    schema = make_schema(columns, names)
    for name in names:
        if name in make_schema(columns, ()):
            raise LogError(f'identity has a column "{name}", which the table has for something else; rename it')
    with ExitStack() as stack:
        if folder is None:
            root = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="seaopt-fleet-")))
        else:
            root = Path(folder)
            check_folder(root)
            check_name(root, "a fleet's tables cannot lie there; give another folder: -o out")
        table = FleetTable(root, schema, plan)
        stack.callback(table.close)
        if executor is None:
            executor = Processes()
            stack.callback(executor.shutdown, cancel_futures=True)
        table.relabel(names, chosen)
        unchanged = _fit_all(table, executor, chosen, progress)
        named = pl.col("log").is_in([log.path for log in chosen])
        table.put(note_short_logs(table.read().filter(named)))
        content = table.read()
        rows = content.filter(named).select(*schema)
        result = Fleet(
            rows=rows,
            units=columns.units,
            identity=tuple(names),
            unchanged=unchanged,
            fitted=columns.fitted,
            free=columns.free,
        )
        if folder is not None:
            summary = result.to_dict() | {"problem_sha256": plan.digest, "version": plan.version}
            summary["other_logs"] = content.filter(~named)["log"].to_list()
            write_json(root / "fleet.json", _keep_summary(root / "fleet.json", summary, result) | summary)
    return result


def read_fleet(folder: Path | str) -> Fleet:
    """Return what the last `fit_fleet`, or `seaopt fleet`, left in a folder; nothing is fitted.

    Parameters
    ----------
    folder : Path or str
        That of the results, with fleet.json.

    Returns
    -------
    Fleet
        Of the logs that were named last, with what fleet.json says of drift and population; all logs are `unchanged`.

    Raises
    ------
    FileError
        A file is missing or damaged, is of an older seaopt, or a later run was stopped.

    Examples
    --------
    >>> read_fleet("no_such_folder")
    Traceback (most recent call last):
    seaopt.errors.FileError: no_such_folder/fleet.json: ...
    """
    root, remedy = Path(folder), "type the command of the fleet again"
    content = read_json(root / "fleet.json", FLEET_SCHEMA, remedy=remedy)
    missing = [name for name in ("fitted", "free", "other_logs") if name not in content]
    if missing:
        raise FileError(f"{root / 'fleet.json'}: has no {missing[0]}, as of an older seaopt; {remedy}")
    rows = read_rows(root).filter(~pl.col("log").is_in(content["other_logs"]))
    fleet = Fleet(
        rows=rows,
        units=content["units"],
        identity=tuple(content["identity"]),
        unchanged=len(rows),
        fitted=tuple(content["fitted"]),
        free=tuple(content["free"]),
        drift=content.get("drift"),
        population=content.get("population"),
    )
    if fleet.counts != content["counts"]:
        raise FileError(f"{root}: its table has changed since fleet.json, as where a run was stopped; {remedy}")
    return fleet


def _keep_summary(path: Path, content: dict[str, Any], fleet: Fleet) -> dict[str, Any]:
    """Return what fleet.json has besides, drift and population, where it is of the same results."""
    if fleet.unchanged < len(fleet.rows) or not path.exists():
        return {}
    try:
        before, now = read_json(path, FLEET_SCHEMA), json.loads(to_json(content))
    except FileError:  # edited, or of an older seaopt: it is written anew
        return {}
    return before if all(before.get(key) == value for key, value in now.items()) else {}


def _choose_logs(logs: Sequence[str | Path | FleetLog], identity: str | None) -> tuple[FleetLog, ...]:
    """Return the logs with their identities."""
    sources = [logs] if isinstance(logs, str | Path) else list(logs)
    listed = tuple(log for log in sources if isinstance(log, FleetLog))
    if not listed:
        return find_logs([log for log in sources if not isinstance(log, FleetLog)], identity)
    if len(listed) < len(sources) or identity is not None:
        raise LogError("logs has some that are FleetLog, with identities of their own; give all so, without identity")
    if len({log.path for log in listed}) < len(listed) or len({tuple(log.identity) for log in listed}) > 1:
        raise LogError("logs has one twice, or identities of different names; give each once, with the same names")
    return listed


def _fit_all(table: FleetTable, executor: Executor, logs: Sequence[FleetLog], progress: Progress) -> int:
    """Fit what is not done, and write it; return how many logs were done before."""
    done_before = find_done(table.read(), table.plan)
    counts = dict.fromkeys((MET, NOT_MET, FAILED, UNCHANGED), 0)
    try:
        for batch in Dispatcher(executor, table.plan, logs, done_before).run():
            table.add([row for row in batch if row["status"] != UNCHANGED])
            for row in batch:
                counts[row["status"]] += 1
            done = sum(counts.values())
            bad = "".join(f", {counts[name]} {name}" for name in (NOT_MET, FAILED) if counts[name])
            progress(f"{done} of {len(logs)} logs{bad}", done / len(logs))
    except BaseException:
        with suppress(SeaoptError):  # of a full disk the first error tells
            table.flush()
        raise
    table.finish()
    return counts[UNCHANGED]
