"""Executors: order and bounded queue of the map, and processes that come back after one of them dies."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor

import casadi as ca
import pytest

import seaopt as so
from seaopt.errors import SeaoptError
from seaopt.executors import QUEUED, Processes, connect_dask, count_workers, map_ordered, solve_ipopt


class Counting(Executor):
    """Works at once, and counts what is submitted."""

    _max_workers = 3

    def __init__(self):
        self.submitted = 0

    def submit(self, fn, /, *args, **kwargs):
        self.submitted += 1
        future = Future()
        future.set_result(fn(*args, **kwargs))
        return future


def test_an_interrupt_ends_what_ipopt_solves():
    """CasADi takes Ctrl-C for a failure of the solver, and returns."""
    x = ca.MX.sym("x", 200)
    cost = ca.sum1((x[1:] - x[:-1] ** 2) ** 2 * 100 + (1 - x[:-1]) ** 2)
    endless = {"tol": 1e-300, "max_iter": 10**6, "acceptable_iter": 0, "hessian_approximation": "limited-memory"}
    quiet = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", **endless}}
    solver = ca.nlpsol("endless", "ipopt", {"x": x, "f": cost}, quiet)
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, 0.05)
    try:
        with pytest.raises(KeyboardInterrupt):
            solve_ipopt(solver, x0=[2.0] * 200)
    finally:
        signal.signal(signal.SIGALRM, before)


def late(k):
    time.sleep(0.02 * (k % 3))
    return k


def test_results_come_in_order_whoever_is_first():
    with ThreadPoolExecutor(4) as threads:
        assert list(map_ordered(late, range(20), threads)) == list(range(20))
    assert list(map_ordered(late, range(4))) == list(range(4))


@pytest.mark.parametrize("method", [None, "fork", "spawn", "forkserver"])
def test_processes_that_are_forked_are_refused(method):
    """A fleet waited for ever in one: polars has threads, whose locks a forked process inherits."""
    context = multiprocessing.get_context(method)
    with ProcessPoolExecutor(1, mp_context=context if method else None) as executor:
        if context.get_start_method() == "fork":
            with pytest.raises(SeaoptError, match="are forked"):
                so.fit_fleet("none.toml", [], executor=executor)
            with pytest.raises(SeaoptError, match="are forked"):
                list(map_ordered(abs, [-1], executor))
        else:
            assert list(map_ordered(abs, [-1], executor)) == [1]


def test_few_are_in_flight():
    executor = Counting()
    results = map_ordered(abs, iter(range(1000)), executor)
    next(results)
    assert executor.submitted == QUEUED * count_workers(executor) == 6


@pytest.mark.parametrize("workers", [0, 100_000])
def test_a_number_of_workers_is_checked(workers):
    with pytest.raises(SeaoptError, match=f"workers = {workers}"):
        Processes(workers)


def test_processes_go_on_after_a_death():
    with Processes(1) as executor:
        first = executor.submit(os.getpid).result()
        with pytest.raises(BrokenExecutor):
            executor.submit(os._exit, 3).result()
        again = executor.submit(os.getpid).result()
        with pytest.raises(SeaoptError, match=r"a process died.*fewer workers"):
            list(map_ordered(os._exit, [3], executor))
    assert os.getpid() not in (first, again) and first != again


def test_a_scheduler_that_is_not_there_is_said():
    pytest.importorskip("distributed")
    with pytest.raises(SeaoptError, match="does not answer"), connect_dask("tcp://127.0.0.1:9", timeout_s=0.5):
        pass
