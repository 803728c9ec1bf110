"""Give logs to workers in batches, and take back what they return, whatever happens to a worker.

A batch is about 0.1 s of work, so that handing it over costs little, and few of them are in flight, so that a million
logs wait here and not in a scheduler. Where a worker dies, nobody knows which log it was: those that were in
flight are tried again at the end, one at a time and alone, and one on which a worker dies twice gets the blame.
"""

from __future__ import annotations

import errno
from collections import deque
from collections.abc import Generator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from contextlib import suppress
from time import monotonic, sleep

from seaopt.errors import SeaoptError
from seaopt.executors import QUEUED, count_workers
from seaopt.fleet.logs import FleetLog
from seaopt.fleet.plan import Plan
from seaopt.fleet.worker import FAILED, Row, describe_limit, fit_batch

BATCH_S = 0.1  # of work in a batch
LARGEST = 1000  # logs in a batch
LOOK_S = 1.0  # between looks at what is in flight, where nothing is said to be done
COUNT_S = 5.0  # between counts of the workers
DEATHS = 2  # of a worker that works on one log alone, until that log is given up
PATIENCE_S, AGAIN_S = 120.0, 1.0  # how long, and how often, work is offered to an executor that takes none
REMEDIES: dict[int | None, str] = {
    errno.EMFILE: "allow more open files (ulimit -n 1024)",
    errno.ENFILE: "close what holds files open on this machine",
    errno.EAGAIN: "allow more processes (ulimit -u)",
    errno.ENOMEM: "give it more memory (ulimit -v)",
}


class Dispatcher:
    """The logs that wait, and the batches that are in flight; `digests` is as in `fit_batch`."""

    def __init__(self, executor: Executor, plan: Plan, logs: Sequence[FleetLog], digests: Mapping[str, str]) -> None:
        self.executor = executor
        self.plan = plan
        self.digests = digests
        self.waiting = deque(logs)
        self.suspects: deque[FleetLog] = deque()
        self.deaths: dict[str, int] = {}
        self.flying: dict[Future[list[Row]], tuple[FleetLog, ...]] = {}
        self.alone = False  # whether what is in flight is one suspect
        self.log_s: float | None = None  # a log's mean time, of late
        self.workers, self.counted = 1, float("-inf")

    def run(self) -> Generator[list[Row]]:
        """Yield the rows of each batch as it is done. Raises SeaoptError: the executor takes no more work."""
        try:
            while self.waiting or self.suspects or self.flying:
                self._fill()
                wait(self.flying, LOOK_S, return_when=FIRST_COMPLETED)
                # `wait` is not told of a future that Dask has cancelled, as it does where the scheduler is lost.
                for future in [future for future in self.flying if future.done()]:
                    yield self._take(future)
        finally:
            for future in self.flying:
                future.cancel()

    def _fill(self) -> None:
        """Submit batches until enough are in flight; a suspect only where nothing else is."""
        if monotonic() - self.counted >= COUNT_S:  # a cluster's come and go, and counting asks the scheduler
            with suppress(Exception):  # which may be gone, too
                self.workers = count_workers(self.executor)
            self.counted = monotonic()
        most = QUEUED * self.workers
        self.alone = self.alone and bool(self.flying)
        while self.waiting and len(self.flying) < most:
            size = self._choose_size(most)
            self._submit(tuple(self.waiting.popleft() for _ in range(size)))
        if self.suspects and not self.waiting and not self.flying:
            self.alone = True
            self._submit((self.suspects.popleft(),))

    def _choose_size(self, most: int) -> int:
        if self.log_s is None:
            return 1
        share = -(-len(self.waiting) // most)  # the last batches end together
        return max(1, min(int(BATCH_S / max(self.log_s, 1e-9)), LARGEST, share))

    def _submit(self, batch: tuple[FleetLog, ...]) -> None:
        done = {log.path: self.digests[log.path] for log in batch if log.path in self.digests}
        patience = PATIENCE_S if hasattr(self.executor, "_client") else 0.0  # a scheduler that restarts is back soon
        end = monotonic() + patience
        while True:
            try:
                self.flying[self.executor.submit(fit_batch, self.plan, batch, done)] = batch
                return
            except Exception as error:  # each engine has its own
                if monotonic() >= end:
                    remedy = REMEDIES.get(getattr(error, "errno", None), "start the workers again")
                    raise SeaoptError(
                        f"the executor takes no more work ({type(error).__name__}: {error}); {remedy}"
                    ) from error
                sleep(AGAIN_S)

    def _take(self, future: Future[list[Row]]) -> list[Row]:
        """Return the rows of a batch that came back; of one that did not, those of logs that are given up."""
        batch = self.flying.pop(future)
        try:
            rows = future.result()
        except CancelledError:  # the scheduler was lost, which is no log's fault
            self.waiting.extend(batch)
            return []
        except Exception:  # `fit_batch` raises nothing: a worker was lost
            return self._suspect(batch)
        mean = sum(row["total_s"] for row in rows) / len(rows)
        self.log_s = mean if self.log_s is None else 0.7 * self.log_s + 0.3 * mean
        return rows

    def _suspect(self, batch: tuple[FleetLog, ...]) -> list[Row]:
        """Put the logs of a lost batch aside; a log that was alone for the second time gets the blame."""
        if not self.alone:
            self.suspects.extend(batch)
            return []
        (log,) = batch
        self.deaths[log.path] = deaths = self.deaths.get(log.path, 0) + 1
        if deaths < DEATHS:
            self.suspects.append(log)
            return []
        limit = "" if self.plan.time_limit_s is None else f", or it {describe_limit(self.plan)}"
        reason = f"the worker process died on it {deaths} times: out of memory, or a fault of compiled code{limit}"
        return [{"log": log.path, **log.identity, "status": FAILED, "reason": reason}]
