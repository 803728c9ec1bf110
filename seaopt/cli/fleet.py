"""`seaopt fleet`: what is given on the command line, and what is printed of the result."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from seaopt.cli.progress import show_progress
from seaopt.cli.show import show_sections, show_verdicts
from seaopt.cli.terminal import Amount, Terminal, spell_call
from seaopt.errors import LogError, SeaoptError
from seaopt.files import read_json, to_json, write_json
from seaopt.formatting import format_count
from seaopt.reporting.sections import judge
from seaopt.reporting.sections.data import Commands
from seaopt.reporting.sections.text import LABEL

if TYPE_CHECKING:
    from seaopt.fleet import Drift, Fleet, FleetLog, Population

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "POLARS_MAX_THREADS")
PAGE, ACTUATORS = "fleet.html", "actuators.parquet"


def run_fleet(
    problem: Path,
    names: Sequence[str],
    folder: Path,
    *,
    manifest: Path | None,
    identity: str | None,
    scheduler: str | None,
    workers: int | None,
    like: str | None,
    time_limit_s: float | None,
    drift: Mapping[str, Any],
    json: bool,
    amount: Amount,
) -> bool:
    """Fit the logs, write and print what they give; return whether all are met. `drift`: options of `find_drift`."""
    # Before workers start, who inherit it: threads of BLAS would fight over cores that all have a log.
    for name in THREADS:
        os.environ.setdefault(name, "1")
    from seaopt.executors import Processes, connect_dask
    from seaopt.fleet import estimate_population, find_drift, find_logs, fit_fleet, read_manifest
    from seaopt.problem import read_problem

    if (manifest is None) == (not names):
        raise LogError("give the logs either as LOGS, files or patterns in quotes, or as --manifest FILE")
    errors = Terminal(stderr=True)
    logs = find_logs(names, identity) if manifest is None else read_manifest(manifest)
    _check_options(logs, drift)
    read = read_problem(problem, design=False)
    if read.refused:
        errors.say(f"warning: {read.refused}; a design refuses this")
    with ExitStack() as stack:
        if scheduler is not None:
            executor = stack.enter_context(connect_dask(scheduler))
        else:
            executor = Processes(workers)
            stack.callback(executor.shutdown, cancel_futures=True)
        try:
            with show_progress(errors, "fitting the fleet", errors.say) as tell:
                fleet = fit_fleet(
                    read, logs, folder, executor=executor, like=like, time_limit_s=time_limit_s, progress=tell
                )
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"what was finished is in {folder}; the same command goes on from there") from None
    result = find_drift(fleet, **drift)
    population, missing = None, ""
    try:
        population = estimate_population(fleet, actuator=drift["actuator"], time=drift["time"])
    except SeaoptError as error:
        missing = str(error)
    content = _write(fleet, result, population, folder, problem)
    if json:
        sys.stdout.write(to_json(content))
        return fleet.met
    console = Terminal()
    _show(console, fleet, result, verbose=amount == "verbose")
    if amount != "quiet":
        show_sections(console, fleet)
        if population is None:
            console.wrap(f"no population: {missing}", indent=2)
        else:
            show_sections(console, population)
        console.wrap(
            f"wrote {folder / 'fleet'} (Parquet, one row per log), {folder / ACTUATORS} (one row per actuator), "
            f"{folder / 'fleet.json'}, {folder / PAGE}"
        )
    return fleet.met


def _check_options(logs: Sequence[FleetLog], drift: Mapping[str, Any]) -> None:
    """Refuse options of drift before any log is fitted."""
    from seaopt.fleet import Fleet, order_runs
    from seaopt.fleet.cusum import choose_threshold
    from seaopt.fleet.drift import PER_RUNS
    from seaopt.fleet.history import parse_time
    from seaopt.fleet.table import tabulate_logs

    names = tuple(logs[0].identity)
    history = order_runs(
        Fleet(rows=tabulate_logs(logs, names), units={}, identity=names), drift["actuator"], drift["time"]
    )
    choose_threshold(drift["false_alarms"], PER_RUNS, 1)
    if drift["since"] is not None:
        parse_time(drift["since"], history)


def _write(fleet: Fleet, drift: Drift, population: Population | None, folder: Path, problem: Path) -> dict[str, Any]:
    """Write the table of the actuators, the page, and what fleet.json has of both; return its content."""
    from seaopt.fleet import tabulate_actuators, write_actuators, write_fleet_page
    from seaopt.fleet.result import FLEET_SCHEMA

    content = fleet.to_dict() | {
        "drift": drift.to_dict(),
        "population": None if population is None else population.to_dict(),
    }
    made_from = read_json(folder / "fleet.json", FLEET_SCHEMA)
    write_json(folder / "fleet.json", made_from | content)
    write_actuators(tabulate_actuators(fleet, drift, population), folder / ACTUATORS)
    write_fleet_page(
        fleet,
        drift,
        folder / PAGE,
        population=population,
        title=f"Fleet: {problem.stem}",
        files=[problem],
        command=spell_call(),
    )
    return content


def _show(console: Terminal, fleet: Fleet, drift: Drift, *, verbose: bool) -> None:
    """Print the verdict on the logs, and which actuators have an alarm."""
    verdict = judge(fleet, Commands(fit="seaopt fleet"))
    show_verdicts(console, [] if verdict is None else [verdict], verbose=verbose)
    if fleet.short:
        count = format_count(len(fleet.short), "log")
        console.wrap(f"much shorter than the others: {count} ({fleet.short[0]})", indent=LABEL)
    if fleet.gaps:
        log, text = fleet.gaps[0]
        console.wrap(f"with gaps: {format_count(len(fleet.gaps), 'log')} ({log}: {text})", indent=LABEL)
    if drift.left_out:
        total = format_count(len(fleet.rows), "log")
        console.wrap(f"left out of drift, of {total}: {drift.describe_left_out()}", indent=LABEL)
    steady = judge(drift)
    if steady is None:
        console.wrap(f"Drift: {drift.verdict}", indent=LABEL)
        return
    show_verdicts(console, [steady], verbose=verbose)
    if drift.history.warning:
        console.wrap(f"warning: {drift.history.warning}", indent=LABEL)
