"""Where work is done: in this process, in processes that may die, or on a Dask cluster.

What takes an `executor` takes any `concurrent.futures.Executor`. The work is cut into parts that do not depend on it,
what is random is drawn before, and the results come back in order: they are the same, bit for bit, whatever the
executor and the number of its workers.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import lru_cache
from types import NoneType
from typing import Any, Generic, TypeVar

from seaopt.errors import SeaoptError, require_type

__all__ = ["Processes", "Shared", "connect_dask", "count_cores", "count_workers", "map_ordered"]

Item = TypeVar("Item")
Result = TypeVar("Result")

MOST_WORKERS, MOST_PER_CORE = 64, 4  # processes that may be asked for: the larger one
QUEUED = 2  # parts in flight per worker: the next one lies ready while one is worked on
RESTORED = 8  # shared objects that a worker keeps
IPOPT = threading.Lock()  # held while it solves: MUMPS, in it, has state that all threads of a process share


class Processes(Executor):
    """Processes of this machine; where one dies, new ones take the work that is given next.

    A `ProcessPoolExecutor` is broken for good once a process of it dies. Here the futures of what was in flight fail
    with `BrokenProcessPool` all the same, and `submit` goes on with a new pool. The processes ignore Ctrl-C, which the
    caller handles, and end where the caller is killed.

    `workers`: how many; as many as there are cores, if left out.

    Raises SeaoptError: `workers` is not a whole number above zero, or far more than there are cores: all of them start
    at once.

    Examples
    --------
    >>> with Processes(workers=1) as executor:  # in a script below `if __name__ == "__main__":`
    ...     executor.submit(abs, -2).result()
    2
    """

    def __init__(self, workers: int | None = None) -> None:
        if workers is not None and (isinstance(workers, bool) or not isinstance(workers, int) or workers < 1):
            raise SeaoptError(f"workers = {workers!r} is not a number of processes; give 1 or more")
        most = max(MOST_WORKERS, MOST_PER_CORE * count_cores())
        if workers is not None and workers > most:
            raise SeaoptError(f"workers = {workers} is far more than this machine has cores; give {most} at most")
        self._max_workers = workers or count_cores()  # named as the standard library's
        self._pool: ProcessPoolExecutor | None = None
        self._lock = threading.Lock()

    def submit(self, fn: Callable[..., Result], /, *args: Any, **kwargs: Any) -> Future[Result]:
        """Do as `Executor.submit`."""
        with self._lock:
            if self._pool is not None:
                try:
                    return self._pool.submit(fn, *args, **kwargs)
                except BrokenProcessPool:
                    self._pool.shutdown(wait=False, cancel_futures=True)
            # Forked processes would inherit locks that threads of polars and BLAS hold.
            self._pool = ProcessPoolExecutor(
                self._max_workers, mp_context=multiprocessing.get_context("spawn"), initializer=_live_with_parent
            )
            return self._pool.submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Do as `Executor.shutdown`; what is cancelled is not waited for: its processes are ended."""
        with self._lock:
            pool, self._pool = self._pool, None
        if pool is None:
            return
        if cancel_futures:
            for process in tuple((pool._processes or {}).values()):
                process.kill()
        pool.shutdown(wait=wait, cancel_futures=cancel_futures)


def _live_with_parent() -> None:
    """Prepare a worker process: Ctrl-C is the parent's, and it ends when the parent does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:

        def follow() -> None:
            parent.join()
            os._exit(1)  # the queue that it waits at has no other end any more

        threading.Thread(target=follow, daemon=True).start()


def check_executor(executor: Any, error: type[SeaoptError] = SeaoptError) -> None:
    """Refuse what is no executor, or None, and one whose processes would be forked, in which polars waits for ever."""
    require_type(executor, (Executor, NoneType), "executor", "give a concurrent.futures.Executor", error)
    context: Any = getattr(executor, "_mp_context", None)  # of a ProcessPoolExecutor, which has no public name for it
    if isinstance(executor, ProcessPoolExecutor) and context.get_start_method() == "fork":
        raise error(
            "executor: its processes are forked, with locks that threads here hold, and could wait for ever; give "
            'seaopt.executors.Processes(), or ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn"))'
        )


def count_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def count_workers(executor: Executor) -> int:
    """Return how many parts an executor works on at a time, as far as it tells."""
    client = getattr(executor, "_client", None)  # Dask's, whose workers come and go
    if client is not None:
        return max(sum(client.nthreads().values()), 1)
    return getattr(executor, "_max_workers", None) or count_cores()


@contextmanager
def connect_dask(address: str, timeout_s: float = 30.0) -> Generator[Executor]:
    """Connect to the scheduler of a Dask cluster, and yield its executor.

    Encryption and certificates of a ``tls://`` address are Dask's own settings (``distributed.comm.tls``).

    Raises SeaoptError: dask is not installed, or no scheduler answers.
    """
    try:
        import distributed
    except ImportError as error:
        raise SeaoptError("a Dask scheduler needs the package distributed: pip install 'seaopt[dask]'") from error
    try:
        executor = _Cluster(lambda: distributed.Client(address, timeout=timeout_s, set_as_default=False))
    except (OSError, TimeoutError, ValueError, TypeError) as error:
        raise SeaoptError(f"scheduler {address}: does not answer ({error}); check the address, and TLS") from error
    try:
        yield executor
    finally:
        executor.shutdown()


class _Cluster(Executor):
    """Dask's executor; where its client has given up a scheduler, what is submitted next connects to it anew."""

    def __init__(self, connect: Callable[[], Any]) -> None:
        self._connect = connect
        self._client = connect()

    def submit(self, fn: Callable[..., Result], /, *args: Any, **kwargs: Any) -> Future[Result]:
        if self._client.status == "closed":
            self._client = self._connect()
        return self._client.get_executor(pure=False).submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        with suppress(Exception):  # a scheduler that is gone needs no goodbye
            self._client.close(timeout=2)


def solve_ipopt(solver: Any, **arguments: Any) -> Any:
    """Return what a solver of CasADi's that is IPOPT finds, one at a time in a process. Raises KeyboardInterrupt: it
    was interrupted: by Ctrl-C, or by any signal whose handler raises. CasADi takes that for a failure of the solver,
    and drops the exception.
    """
    with IPOPT:
        try:
            return solver(**arguments)
        finally:
            if solver.stats()["return_status"] == "NonIpopt_Exception_Thrown":
                raise KeyboardInterrupt


def map_ordered(
    function: Callable[[Item], Result], items: Iterable[Item], executor: Executor | None = None
) -> Iterator[Result]:
    """Yield what a function makes of items, in their order; a bounded number of them is in flight.

    `function`: of one item; with an executor of processes, one that pickles. `executor`: where it is called; here, if
    left out.

    Raises SeaoptError: `executor` is none of `concurrent.futures`, or forks this process; or a process of it died.

    Examples
    --------
    >>> list(map_ordered(abs, [-3, 2, -1]))
    [3, 2, 1]
    >>> from concurrent.futures import ThreadPoolExecutor
    >>> with ThreadPoolExecutor(2) as threads:
    ...     list(map_ordered(abs, [-3, 2, -1], threads))
    [3, 2, 1]
    """
    check_executor(executor)
    if executor is None:
        yield from map(function, items)
        return
    most, flying = QUEUED * count_workers(executor), deque[Future[Result]]()
    try:
        for item in items:
            flying.append(executor.submit(function, item))
            if len(flying) >= most:
                yield flying.popleft().result()
        while flying:
            yield flying.popleft().result()
    except BrokenExecutor as error:
        raise SeaoptError(
            "a process died that worked on a part: something ended it, or the memory was full; give fewer workers"
        ) from error
    finally:
        for future in flying:
            future.cancel()


class Shared(Generic[Item]):
    """A value that every part of some work needs: pickled once, and restored once in each process that works on it.

    A plant that is restored for every part would each time build again what it remembers: its linearisations and
    its kernels.

    `value`: that pickles. It must not be changed.

    Examples
    --------
    >>> class Scale:
    ...     def __init__(self, shared): self.shared = shared
    ...     def __call__(self, x): return self.shared.value["factor"] * x
    >>> list(map_ordered(Scale(Shared({"factor": 3})), [1, 2]))
    [3, 6]
    """

    def __init__(self, value: Item) -> None:
        self.value = value
        self._packed: bytes | None = None

    def __reduce__(self) -> tuple[Callable[[bytes], Shared[Any]], tuple[bytes]]:
        if self._packed is None:
            self._packed = pickle.dumps(self.value)
        return _restore, (self._packed,)


@lru_cache(maxsize=RESTORED)
def _restore(packed: bytes) -> Shared[Any]:
    return Shared(pickle.loads(packed))  # noqa: S301  (what the client packed, over the executor's own connection)
