"""`seaopt fleet`: what is given on the command line, and what is printed of the result."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from seaopt.cli.session import show_progress
from seaopt.cli.show import heading, show_verdicts
from seaopt.cli.terminal import Terminal
from seaopt.errors import LogError
from seaopt.files import to_json
from seaopt.formatting import format_count
from seaopt.reporting.verdict import Reason, StageVerdict


def run_fleet(
    problem: Path, names: Sequence[str], folder: Path, *, manifest: Path | None, identity: str | None,
    scheduler: str | None, workers: int | None, like: str | None, time_limit_s: float | None, json: bool, quiet: bool,
    verbose: bool,
) -> bool:  # fmt: skip
    """Fit the logs, and print verdict and spread; return whether every log is met."""
    # Before workers start, who inherit it: threads of BLAS would fight over cores that all have a log.
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "POLARS_MAX_THREADS"):
        os.environ.setdefault(name, "1")
    from seaopt.executors import Processes, connect_dask
    from seaopt.fleet import fit_fleet, read_manifest
    from seaopt.fleet.result import ALIGN, HEAD, list_cells

    if (manifest is None) == (not names):
        raise LogError("give the logs either as LOGS, files or patterns in quotes, or as --manifest FILE")
    errors = Terminal(stderr=True)
    logs = list(names) if manifest is None else read_manifest(manifest)
    with ExitStack() as stack:
        if scheduler is not None:
            executor = stack.enter_context(connect_dask(scheduler))
        else:
            executor = Processes(workers)
            stack.callback(executor.shutdown, cancel_futures=True)
        try:
            with show_progress(errors, "fitting the fleet", errors.say) as tell:
                fleet = fit_fleet(
                    problem, logs, folder, executor=executor, like=like, identity=identity, time_limit_s=time_limit_s,
                    progress=tell,
                )  # fmt: skip
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"what was finished is in {folder}; the same command goes on from there") from None
    if json:
        sys.stdout.write(to_json(fleet.to_dict()))
        return fleet.met
    console = Terminal()
    reasons = tuple(Reason(what=f"{text} ({log})", where="", count=count) for text, count, log in fleet.reasons)
    again = () if fleet.met else ("mend what failed, then type the same command: only that is fitted again",)
    show_verdicts(
        console,
        [StageVerdict(met=fleet.met, text=f"Fleet: {fleet.verdict}", reasons=reasons, next=again)],
        verbose=verbose,
    )
    if quiet:
        return fleet.met
    heading(console, "Fleet", f"{format_count(len(fleet.rows), 'log')}, {fleet.unchanged} done before")
    console.tabulate(list_cells(fleet.spreads), HEAD, ALIGN)
    console.wrap(f"wrote {folder / 'fleet'} (Parquet, a row a log), {folder / 'fleet.json'}")
    return fleet.met
