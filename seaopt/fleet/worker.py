"""Fit a batch of logs in a worker process, one after another, and return a row for each.

A log that cannot be read or fitted is a row with its reason. One that takes longer than the time limit is interrupted,
by a signal in a process's main thread, by an exception in another one; where neither gets through, in compiled code or
on a dead network drive, the worker process ends itself, which the client notices.
"""

from __future__ import annotations

import ctypes
import faulthandler
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import lru_cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.errors import SeaoptError
from seaopt.estimation import Experiment, Fit
from seaopt.estimation.result.findings import FitFinding
from seaopt.fleet.logs import FleetLog, open_local
from seaopt.fleet.plan import VERSION, Plan, name_correlation
from seaopt.logs.quality.clock import assess_clock
from seaopt.logs.quality.findings import Finding, find_clock_faults
from seaopt.problem import Problem, fit_problem

Row = dict[str, Any]
MET, NOT_MET, FAILED, UNCHANGED = "met", "not met", "failed", "unchanged"
GAP = "gap"  # kind of finding of a log with gaps
GRACE_S = 5.0  # after the time limit, until the process is ended
ENDED = 1  # its exit code


class _TimeLimitError(BaseException):
    """A log took too long. Code that handles every Exception must not handle this."""


def name_process() -> str:
    """Return what no other process of the cluster is called."""
    return f"{socket.gethostname()}:{os.getpid()}"


def fit_batch(plan: Plan, logs: Sequence[FleetLog], digests: Mapping[str, str]) -> list[Row]:
    """Return a row for each log; one whose contents are those in `digests` is "unchanged" and not fitted again."""
    return [_fit_log(plan, log, digests.get(log.path)) for log in logs]


@lru_cache(maxsize=4)
def _load(plan: Plan) -> Problem:
    return plan.make_problem()


def _fit_log(plan: Plan, log: FleetLog, stored_digest: str | None) -> Row:
    """Return a log's row."""
    started = time.perf_counter()
    row: Row = {"log": log.path, **log.identity}
    try:
        if plan.version != VERSION:
            where = socket.gethostname()
            reason = f"the worker on {where} has seaopt {VERSION}, the client {plan.version}; install the same"
            return row | {"status": FAILED, "reason": reason, "total_s": 0.0}
        _load(plan)  # once, and not in the log's time
        with _limit_time(plan):
            row |= _describe_fit(plan, log, stored_digest)
    except SeaoptError as error:
        row |= {"status": FAILED, "reason": str(error)}
    except _TimeLimitError:
        row |= {"status": FAILED, "reason": describe_limit(plan)}
    except MemoryError:
        row |= {"status": FAILED, "reason": f"{log.path}: does not fit in the worker's memory"}
    except Exception as error:  # whatever is wrong with one log, the others go on
        row |= {"status": FAILED, "reason": f"{type(error).__name__}: {error}"}
    return row | {"total_s": time.perf_counter() - started}


def describe_limit(plan: Plan) -> str:
    """Return the reason of a log that took too long."""
    return f"takes longer than the time limit of {plan.time_limit_s:g} s; shorten it, or raise the limit"


def _describe_fit(plan: Plan, log: FleetLog, stored_digest: str | None) -> Row:
    problem = _load(plan)
    with open_local(log.path) as (path, digest):
        if digest == stored_digest:
            return {"status": UNCHANGED}
        row: Row = {"log_sha256": digest}
        try:
            experiment = problem.experiment_like(path, keep_slice=True)
            fitted = fit_problem(problem, [experiment])
        except SeaoptError as error:
            return row | {"status": FAILED, "reason": str(error)}
    row |= describe(fitted, experiment.name)
    return row | {"findings": [*row["findings"], *_find_gaps(experiment)]}


def _find_gaps(experiment: Experiment) -> list[dict[str, str]]:
    """Return the finding of a log with gaps, in the words of `seaopt inspect`; a fit alone bears them."""
    log = experiment.log
    faults = find_clock_faults(assess_clock(log.time, log.source), log.time)
    return [_note(fault, experiment.name, fault.sentence) for fault in faults if fault.kind == GAP]


def _note(finding: Finding | FitFinding, where: str, text: str) -> dict[str, str]:
    return {"severity": finding.severity, "kind": finding.kind, "where": where, "text": text}


def describe(fitted: Fit, name: str) -> Row:
    """Return a fit as a row: values, standard deviations and units of its unknowns and figures, verdict and findings.
    `fitted`: of one experiment. `name`: of its experiment, which the names of what is of this log alone begin with.
    """
    row: Row = {"status": MET if fitted.met else NOT_MET, "reason": None if fitted.met else fitted.verdict}
    for parameter in fitted.parameters.values():
        if parameter.free:
            short = parameter.name.removeprefix(f"{name}.")
            row |= {short: parameter.value, f"{short}_std": parameter.std}
    row |= _describe_correlations(fitted, name)
    nuisance = fitted.nuisance[name]
    for key, std in nuisance.std.items():
        value = nuisance.delay_s if key == "delay_s" else nuisance.gain[key.removeprefix("gain.")]
        row |= {key.replace(".", "_"): value, f"{key.replace('.', '_')}_std": std}
    for key, figure in fitted.derived.items():
        short = key.removeprefix(f"{name}.")
        row |= {short: figure.value, f"{short}_std": figure.std}
    for output, figures in fitted.outputs[name].items():
        row |= {f"fit_percent_{output}": figures.fit_percent, f"rms_residual_{output}": figures.rms_residual}
    return row | {
        "findings": [_note(finding, finding.where, finding.text) for finding in fitted.findings],
        "fit_status": fitted.status,
        "samples": fitted.samples,
        "iterations": fitted.iterations,
        "fit_s": fitted.wall_s,
    }


def _describe_correlations(fitted: Fit, name: str) -> Row:
    """Return the correlations of the free parameters' errors, each pair once, in the order of the covariance."""
    covariance = fitted.covariance
    names = [parameter.removeprefix(f"{name}.") for parameter in covariance.names]
    with np.errstate(invalid="ignore", divide="ignore"):
        scales = np.sqrt(np.diag(covariance.matrix))
        correlations = covariance.matrix / np.outer(scales, scales)
    return {
        name_correlation(names[i], names[j]): float(correlations[i, j]) for i, j in combinations(range(len(names)), 2)
    }


@contextmanager
def _limit_time(plan: Plan) -> Generator[None]:
    """Interrupt what takes longer than the plan's time limit; end the process where that does not help."""
    if plan.time_limit_s is None:
        yield
        return
    may_signal = threading.current_thread() is threading.main_thread() and hasattr(signal, "setitimer")
    interrupt = _interrupt_by_signal if may_signal else _interrupt_thread
    may_end = name_process() != plan.client
    with _end_process(plan.time_limit_s + GRACE_S) if may_end else nullcontext(), interrupt(plan.time_limit_s):
        yield


@contextmanager
def _end_process(seconds: float) -> Generator[None]:
    """End this process after so many seconds, whoever has Python's lock; of several threads, one that needs it."""
    if threading.current_thread() is threading.main_thread():
        with Path(os.devnull).open("w") as nowhere:
            faulthandler.dump_traceback_later(seconds, exit=True, file=nowhere)
            try:
                yield
            finally:
                faulthandler.cancel_dump_traceback_later()
        return
    with _call_after(seconds, lambda: os._exit(ENDED)):
        yield


@contextmanager
def _call_after(seconds: float, function: Callable[[], None]) -> Generator[None]:
    """Call a function in another thread after so many seconds, unless what is within is done."""
    timer = threading.Timer(seconds, function)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _stop(*_: Any) -> None:
    raise _TimeLimitError


@contextmanager
def _interrupt_by_signal(seconds: float) -> Generator[None]:
    """Raise in this, the main thread after so many seconds; it ends waiting for files, too."""
    before = signal.signal(signal.SIGALRM, _stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def _interrupt_thread(seconds: float) -> Generator[None]:
    """Raise in this thread after so many seconds, at its next line of Python."""
    thread, lock, over = threading.get_ident(), threading.Lock(), False

    def interrupt() -> None:
        with lock:  # not after the log is done, when this thread has gone on to something else
            if not over:
                ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), ctypes.py_object(_TimeLimitError))

    try:
        with _call_after(seconds, interrupt):
            yield
    finally:
        with lock:
            over = True
