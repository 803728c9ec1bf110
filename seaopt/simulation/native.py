"""Compile, load and call native code: the kernels of log passes and of closed loops, where there is a C compiler.

A kernel is one C function ``int f(const jobs *, long count)`` that does independent jobs one after the other.
`load_kernel` compiles it once per user and source, in however many processes; `Kernel.run` shares the jobs among
threads.

The shared libraries are in a folder of the user's own (mode 0700, refused if anyone else can write to it, or if it is
a link). A library's name is the hash of its source, flags and compiler, and the hash of its content: Python would die
of a library that was cut off, so one that does not match its name is compiled again. A new library is first loaded in
a child process, even if the compiler's exit status is zero. A compiler that does not end within a minute is not asked
again for an hour. Where one fails, a line is logged, and everything is computed without it. ``SEAOPT_COMPILER`` names
a compiler, or "none" to use none; ``SEAOPT_CACHE_DIR`` names the folder.

Threads write to arrays by address, which nothing but this module keeps alive. An interrupt (Ctrl-C) reaches the main
thread alone, while the others still write: `Kernel.run` raises it when they have ended. Between two instructions of
Python another one may still end that wait; but each thread holds on to the arrays of its jobs, so that no memory is
freed under it whatever becomes of the caller.
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
import os
import platform
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, suppress
from functools import lru_cache
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Int, Shaped

from seaopt.records import record

THREAD_NAME = "seaopt-native"
COMPILER_S = 60.0  # time limit of a compiler for one library,
PER_CHARACTER_S = 5e-4  # and for each character of its source: ten times what an idle machine takes
HUNG_S = 3_600.0  # for which a compiler that took longer is not asked again
BUSY = 3.0  # processes that wait for each processor: there a compiler that takes long does not hang
ORPHAN_S = 3_600.0  # after which nobody waits for the compiler of a folder any more
BUILD = "build-"  # prefix of those folders
# Loops are unrolled as by -O3. What is left out of -O2 moves instructions about, after all sums are in their order: the
# numbers are the same to the last bit, as quickly, and compile in nine tenths of the time.
FLAGS = (
    *("-O2", "-fpeel-loops", "-fno-gcse", "-fno-schedule-insns2", "-fno-caller-saves"),
    *("-std=gnu99", "-fPIC", "-shared", "-fno-math-errno", "-fvisibility=hidden"),
)
CLONES = ("-fipa-cp-clone",)  # copies of a pass for constant arguments; clang and zig refuse unknown options
NATIVE = ("-march=native", "-mprefer-vector-width=256", "-mno-avx512f")
LOAD = "import ctypes, sys; getattr(ctypes.CDLL(sys.argv[1]), sys.argv[2])"  # 15 ms, of the half second of a compiler


def find_compiler() -> list[str] | None:
    """Return the command of a C compiler, or None: SEAOPT_COMPILER, cc, gcc, clang, or the ziglang package."""
    wanted = os.environ.get("SEAOPT_COMPILER", "")
    if wanted.lower() == "none" or os.name == "nt":
        return None
    for name in (wanted,) if wanted else ("cc", "gcc", "clang"):
        path = shutil.which(name)
        if path:
            return [path]
    try:
        import ziglang  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None
    return [sys.executable, "-m", "ziglang", "cc"] if ziglang.__file__ else None


def cache_folder() -> Path | None:
    """Return the user's kernel folder, made with mode 0700; None where it is not safe to load code from."""
    from platformdirs import user_cache_path

    base = os.environ.get("SEAOPT_CACHE_DIR")
    folder = (Path(base) if base else user_cache_path("seaopt")) / "kernels"
    if folder.is_symlink():  # before its mode is touched, which is that of whatever it leads to
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if folder.lstat().st_uid == os.getuid():
            folder.chmod(0o700)
    except (OSError, ValueError):
        return None
    return folder if _is_private(folder) else None


def _is_private(path: Path) -> bool:
    """Tell whether a file or folder, not a link, is the user's own and nobody else can write to it."""
    try:
        status = path.lstat()
    except OSError:
        return False
    only_users = status.st_uid == os.getuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return only_users and not stat.S_ISLNK(status.st_mode)


@lru_cache(maxsize=64)
def load_library(source: str, name: str) -> ctypes.CDLL | None:
    """Return the library of a C source that exports `name`, compiled or cached. None without compiler or folder."""
    compiler, folder = find_compiler(), cache_folder()
    if compiler is None or folder is None:
        return None
    content = (source, LOAD, *FLAGS, *CLONES, *NATIVE, *compiler, sys.platform, _processor())
    key = _digest("\0".join(content).encode())
    library = _find_whole(folder, key) or _compile_once(compiler, source, name, folder, key)
    if library is not None and _is_private(library):
        with suppress(OSError):  # built for another machine that shares this folder
            return ctypes.CDLL(str(library))
    return None


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _find_whole(folder: Path, key: str) -> Path | None:
    """Return the library of a key whose content has the hash in its name."""
    listed = _list_libraries(folder).get(key)
    for library in chain([] if listed is None else [folder / listed], folder.glob(f"{key}.*.so")):
        with suppress(OSError):
            if library.name == f"{key}.{_digest(library.read_bytes())}.so":
                return library
    return None


@lru_cache(maxsize=8)
def _list_libraries(folder: Path) -> dict[str, str]:
    """Return what was in a folder by key: it may hold thousands, and looking through them takes milliseconds."""
    return {path.name.partition(".")[0]: path.name for path in folder.glob("*.so")}


@lru_cache(maxsize=1)
def _processor() -> str:
    """Return what tells processors with other instructions apart: several machines may share a home folder."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line for line in lines if line.startswith(("flags", "Features"))), platform.machine())


def _compile_once(compiler: list[str], source: str, name: str, folder: Path, key: str) -> Path | None:
    """Return the library of a source; of several processes that want it at a time one compiles, and others wait."""
    import fcntl  # not on Windows, where nothing is compiled

    path = folder / f"{key}.lock"
    with ExitStack() as stack:
        with suppress(OSError):  # a disk without locks: everybody compiles
            fcntl.flock(stack.enter_context(path.open("w")), fcntl.LOCK_EX)  # ends with the process
        library = _find_whole(folder, key) or _compile(compiler, source, name, folder, key)
        with suppress(OSError):  # whoever waits has it open still
            path.unlink()
    return library


def _compile(compiler: list[str], source: str, name: str, folder: Path, key: str) -> Path | None:
    """Return the library that a compiler makes of a source; None, and a line in the log, if anything goes wrong."""
    hung = folder / f"{_digest(chr(0).join(compiler).encode())}.hung"
    with suppress(OSError):
        for orphan in folder.glob(f"{BUILD}*"):
            if time.time() - orphan.lstat().st_mtime > ORPHAN_S:
                shutil.rmtree(orphan, ignore_errors=True)
    try:
        if hung.exists() and abs(time.time() - hung.lstat().st_mtime) < HUNG_S:
            trouble = f"did not end less than {HUNG_S / 60:g} minutes ago, and is not asked again so soon"
        else:
            for options in ((*CLONES, *NATIVE), NATIVE, CLONES, ()):
                library = _run_compiler([*compiler, *FLAGS, *options], source, name, folder, key)
                if library is not None:
                    return library
            trouble = "fails, or makes nothing that can be loaded"
    except subprocess.TimeoutExpired as error:
        trouble = f"did not end within {error.timeout:.2g} s"
        with suppress(OSError):
            if os.getloadavg()[0] < BUSY * (os.cpu_count() or 1):
                hung.touch()
    except OSError as error:  # no room on the disk, among others
        trouble = error.strerror or str(error)
    _warn_once(f"C compiler {' '.join(compiler)}: {trouble}; slower without it; SEAOPT_COMPILER names another, or none")
    return None


@lru_cache(maxsize=8)
def _warn_once(text: str) -> None:
    logging.getLogger("seaopt").warning("seaopt: %s", text)


def _run_compiler(command: list[str], source: str, name: str, folder: Path, key: str) -> Path | None:
    """Compile a source, load the result in a child process, and give it its name in the folder."""
    with tempfile.TemporaryDirectory(dir=folder, prefix=BUILD, ignore_cleanup_errors=True) as build:
        code, built = Path(build) / "kernel.c", Path(build) / "kernel.so"
        code.write_text(source, encoding="utf-8")
        limit_s = COMPILER_S + PER_CHARACTER_S * len(source)
        loading = [sys.executable, "-I", "-S", "-c", LOAD, str(built), name]  # may die of it: SIGBUS, SIGSEGV
        if not (_succeeds([*command, str(code), "-o", str(built), "-lm"], limit_s) and _succeeds(loading, limit_s)):
            return None
        built.chmod(0o700)
        return built.replace(folder / f"{key}.{_digest(built.read_bytes())}.so")


def _succeeds(command: list[str], limit_s: float) -> bool:
    """Run a command and tell whether it ends with status 0; one that does not end is killed with all it started. Raises
    TimeoutExpired: it did not end in time. `Popen.wait` with a limit would look only every 50 ms.
    """
    silent, expired = subprocess.DEVNULL, threading.Event()
    process = subprocess.Popen(command, stdin=silent, stdout=silent, stderr=silent, start_new_session=True)  # noqa: S603

    def kill() -> None:
        expired.set()
        with suppress(OSError):
            os.killpg(process.pid, signal.SIGKILL)  # a compiler's driver starts others

    timer = threading.Timer(limit_s, kill)
    timer.start()
    try:
        status = process.wait()
    except BaseException:
        kill()
        process.wait()
        raise
    finally:
        timer.cancel()
    if expired.is_set():
        raise subprocess.TimeoutExpired(command, limit_s)
    return status == 0


def define_constants(constants: Mapping[str, float]) -> str:
    """Return the preprocessor's lines that define constants."""
    return "".join(f"#define {name} {value}\n" for name, value in constants.items())


def generate_code(*functions: ca.Function) -> str:
    """Return CasADi's C code of functions, static for the compiler to inline; SZ_ARG to SZ_W are the room they need."""
    generator = ca.CodeGenerator("kernel")
    for function in functions:
        generator.add(function)
    code = generator.dump().replace("\nCASADI_SYMBOL_EXPORT ", "\nstatic inline ")
    sizes = {"ARG": ca.Function.sz_arg, "RES": ca.Function.sz_res, "IW": ca.Function.sz_iw, "W": ca.Function.sz_w}
    return define_constants({f"SZ_{name}": max(map(size, functions)) for name, size in sizes.items()}) + code


@record(eq=False)
class Kernel:
    """A compiled function ``int f(const jobs *, long count)``, and the library it is from."""

    function: Any
    library: ctypes.CDLL

    def run(self, jobs: Shaped[np.ndarray, " jobs"], buffers: object, *, parallel: bool = True, least: int = 1) -> None:
        """Do all jobs, in threads of their own if `parallel`; ctypes lets go of the interpreter's lock. `jobs`: one row
        per job, laid out as the C structure; pointers are whole numbers; `buffers`: whatever owns the memory that the
        jobs point to; `parallel`: whether the jobs are long enough for threads to pay; `least`: jobs of a thread.
        Raises KeyboardInterrupt: once no thread works on these jobs any more; those that none has begun are left.
        Raises MemoryError: there is no room for the stack that a plant of many states needs.
        """
        inside = threading.current_thread().name.startswith(
            THREAD_NAME
        )  # waiting for its own pool, it could wait forever
        parts = min(max(len(jobs) // least, 1), workers()) if parallel and not inside else 1
        bounds, size = np.linspace(0, len(jobs), parts + 1).astype(int), jobs.dtype.itemsize
        spans = [(jobs.ctypes.data + int(a) * size, int(b - a)) for a, b in pairwise(bounds)]
        owners = (jobs, buffers)
        futures = [Future[int]() for _ in spans[1:]]  # ahead of their calls: an interrupt may lose what submit returns
        interrupt: BaseException | None = None
        failed = 0
        try:
            for future, span in zip(futures, spans[1:], strict=True):
                threads().submit(_call, future, self.function, *span, owners)
            failed = self.function(*spans[0])
        except BaseException as error:
            interrupt = error
        if _join(futures, interrupt) or failed:
            raise MemoryError("no room for the stack of a simulation")


def _call(future: Future[int], function: Any, address: int, count: int, owners: object) -> None:
    """Call a native function unless its future is cancelled; hold on to the `owners` of its memory meanwhile."""
    if future.set_running_or_notify_cancel():
        failed = 1
        try:
            failed = function(address, count)
        finally:
            future.set_result(failed)


def _join(futures: list[Future[int]], interrupt: BaseException | None) -> bool:
    """Wait for all that have begun, or all; raise the last interrupt at the end. Returns whether one failed."""
    waiting = True
    while waiting:
        try:
            if interrupt is not None:
                for future in futures:
                    future.cancel()
            wait([future for future in futures if not future.done()])
            waiting = False
        except KeyboardInterrupt as error:
            interrupt = error
    if interrupt is not None:
        raise interrupt
    return any(future.result() for future in futures)


def load_kernel(source: str, name: str) -> Kernel | None:
    """Return the function `name` of a C source as a kernel; None where there is no compiler."""
    library = load_library(source, name)
    return None if library is None else find_kernel(library, name)


def find_kernel(library: ctypes.CDLL, name: str) -> Kernel:
    """Return the function `name` of a library as a kernel."""
    function = getattr(library, name)
    function.argtypes, function.restype = [ctypes.c_void_p, ctypes.c_long], ctypes.c_int
    return Kernel(function=function, library=library)


def row_addresses(array: Shaped[np.ndarray, "rows ..."]) -> Int[np.ndarray, " rows"]:
    """Return the address of each row of an array."""
    return array.ctypes.data + array.strides[0] * np.arange(len(array))


def workers() -> int:
    """Return how many threads native code may use: the cores of this process, at most 8."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, 8)


@lru_cache(maxsize=1)
def _threads_of(process: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers(), thread_name_prefix=f"{THREAD_NAME}-{process}")


def threads() -> ThreadPoolExecutor:
    """Return the pool of this process, made anew after a fork."""
    return _threads_of(os.getpid())
