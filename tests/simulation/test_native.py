"""Native code: who may write to its folder, and what an interrupt (Ctrl-C) does while threads write to memory."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import weakref
from types import SimpleNamespace

import numpy as np
import pytest

from seaopt.simulation import native

needs_compiler = pytest.mark.skipif(native.find_compiler() is None, reason="no C compiler")

SLOW = r"""
#define _POSIX_C_SOURCE 200809L
#include <time.h>
typedef struct { double wait_s; double *result; } job;
__attribute__((visibility("default"))) int slow(const job *jobs, long count) {
    for (long i = 0; i < count; i++) {
        struct timespec wait = {0, (long)(1e9 * jobs[i].wait_s)};
        nanosleep(&wait, 0);
        *jobs[i].result += 1.0;
    }
    return 0;
}
"""

# Loops run on and on; every interrupt must come out as KeyboardInterrupt, and leave the process fit for the next run.
LOOPS = """
import os
import signal
import time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a script's background job begins with it ignored
os.sched_getaffinity = lambda process: {0, 1}  # two threads on any machine
import numpy as np
import seaopt as so
from seaopt.control import Law, TransferFunction
from seaopt.control.laws.realisation import realise
from seaopt.control.running.closed_loop import SampledLoop, run_loop

den = np.array([1.0, -1.5, 0.5])
tops = [19.001, -35.9995, 16.9995], [18.001, -34.4995, 16.4995]
pair = [TransferFunction(num=np.array(num), den=den) for num in tops]
law = realise(
    Law.from_transfer_functions(*pair, sample_time_s=1e-3), per_effort=1 / 240.3318, command_limit=9.0,
)
loop = SampledLoop(plant=so.plants.moving_output(), law=law, measured="F1", delay_samples=1)
params = [so.plants.thor().update(I_p=value) for value in np.linspace(0.2, 0.6, 16)]
expected = run_loop(loop, params, np.full(500, 80.0)).outputs["F1"]
interrupts = 0
for _ in range(ROUNDS):
    deadline = time.monotonic() + 5.0  # an interrupt while CasADi converts an array is lost
    try:
        print("running", flush=True)
        while time.monotonic() < deadline:
            run_loop(loop, params, np.full(4000, 80.0))
    except KeyboardInterrupt:
        interrupts += 1
    except SystemError as error:  # in that conversion, too
        if not isinstance(error.__cause__, KeyboardInterrupt):
            raise
        interrupts += 1
    np.testing.assert_array_equal(run_loop(loop, params, np.full(500, 80.0)).outputs["F1"], expected)
print(interrupts)
"""
DELAYS_S = (0.0, 0.03, 0.1, 0.2, 0.3)


@needs_compiler
def test_an_interrupted_closed_loop_ends_cleanly():
    """Ctrl-C came out of the wait for the threads, whose memory was then freed: a segmentation fault each time."""
    source = LOOPS.replace("ROUNDS", str(len(DELAYS_S)))
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    environment = os.environ | {"MALLOC_MMAP_THRESHOLD_": "65536"}  # who writes to freed memory dies of it at once
    with subprocess.Popen([sys.executable, "-c", source], env=environment, **options) as process:
        assert process.stdout is not None
        for delay_s in DELAYS_S:
            if process.stdout.readline() != b"running\n":
                break
            time.sleep(delay_s)
            process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors.decode()
    assert int(output) > len(DELAYS_S) // 2


@pytest.fixture
def slow_jobs(monkeypatch):
    """Return a kernel that waits, jobs for two threads, and where they count."""
    monkeypatch.setattr(native, "workers", lambda: 2)
    native._threads_of.cache_clear()
    kernel = native.load_kernel(SLOW, "slow")
    assert kernel is not None
    results = np.zeros(2)
    jobs = np.zeros(2, dtype=[("wait_s", float), ("result", np.uint64)])
    jobs["result"] = native.row_addresses(results)
    yield kernel, jobs, results
    native._threads_of.cache_clear()


@needs_compiler
@pytest.mark.parametrize("interrupts", [1, 3])
def test_an_interrupt_waits_for_the_threads(slow_jobs, interrupts, monkeypatch):
    kernel, jobs, results = slow_jobs
    jobs["wait_s"] = 0.0, 0.3
    left, wait = [None] * interrupts, native.wait

    def interrupted_wait(futures):
        if left:
            left.pop()
            raise KeyboardInterrupt
        return wait(futures)

    monkeypatch.setattr(native, "wait", interrupted_wait)
    with pytest.raises(KeyboardInterrupt):
        kernel.run(jobs, results)
    np.testing.assert_array_equal(results, 1.0)


@needs_compiler
@pytest.mark.parametrize("queued", [True, False])
def test_an_interrupt_while_jobs_are_handed_out_waits_for_the_threads(slow_jobs, queued, monkeypatch):
    """For those that have begun: the second thread's work goes to the queue, or is lost."""
    kernel, jobs, results = slow_jobs
    jobs["wait_s"] = 0.0, 0.3
    pool = native.threads()

    def submit(*arguments):
        if queued:
            begun = pool.submit(*arguments)
            while not begun.running():
                time.sleep(1e-3)
        raise KeyboardInterrupt

    monkeypatch.setattr(native, "threads", lambda: SimpleNamespace(submit=submit))
    with pytest.raises(KeyboardInterrupt):
        kernel.run(jobs, results)
    np.testing.assert_array_equal(results, [0.0, float(queued)])


@needs_compiler
def test_a_thread_keeps_its_memory(slow_jobs, monkeypatch):
    """Even where nobody waits for it."""
    kernel, jobs, results = slow_jobs
    jobs["wait_s"] = 0.0, 0.3
    waiting = []
    monkeypatch.setattr(native, "_join", lambda futures, interrupt: waiting.extend(futures))
    kernel.run(jobs, results)
    memory = weakref.ref(results)
    del jobs, results, slow_jobs
    assert not waiting[0].done()
    assert memory() is not None
    native.wait(waiting)


def test_the_kernel_folder_is_private(tmp_path, monkeypatch):
    monkeypatch.setenv("SEAOPT_CACHE_DIR", str(tmp_path / "cache"))
    folder = native.cache_folder()
    assert folder is not None
    assert folder.stat().st_mode & 0o777 == 0o700
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "kernels").symlink_to(elsewhere)
    monkeypatch.setenv("SEAOPT_CACHE_DIR", str(tmp_path / "linked"))
    assert native.cache_folder() is None


def test_a_linked_kernel_folder_is_refused_before_its_mode_is_touched(tmp_path, monkeypatch):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    elsewhere.chmod(0o755)
    (tmp_path / "kernels").symlink_to(elsewhere)
    monkeypatch.setenv("SEAOPT_CACHE_DIR", str(tmp_path))
    assert native.cache_folder() is None
    assert elsewhere.stat().st_mode & 0o777 == 0o755


ANSWER = '__attribute__((visibility("default"))) int answer(const void *jobs, long count) { return 42; } /* %s */'


@pytest.fixture
def kernels(tmp_path, monkeypatch):
    """Return an empty folder for kernels."""
    monkeypatch.setenv("SEAOPT_CACHE_DIR", str(tmp_path))
    native.load_library.cache_clear()
    native._warn_once.cache_clear()
    yield native.cache_folder()
    native.load_library.cache_clear()


@pytest.fixture
def make_compiler(tmp_path, monkeypatch):
    """Return what puts a shell script in the place of the compiler."""

    def make(script):
        compiler = tmp_path / "compiler"
        compiler.write_text(f"#!/bin/sh\n{script}\n", encoding="utf-8")
        compiler.chmod(0o700)
        monkeypatch.setenv("SEAOPT_COMPILER", str(compiler))

    return make


def damage_nothing(library):
    pass


def cut(library):
    library.write_bytes(library.read_bytes()[:5000])


def empty(library):
    library.write_bytes(b"")


def flip(library):
    content = bytearray(library.read_bytes())
    content[len(content) // 2] ^= 1
    library.write_bytes(content)


def rename(library):
    library.rename(library.with_name(f"{library.name.partition('.')[0]}.{'0' * 64}.so"))


LOAD = """
from seaopt.simulation import native
library = native.load_library({source!r}, "answer")
print(library.answer(None, 0))
"""


@needs_compiler
@pytest.mark.parametrize("damage", [damage_nothing, cut, empty, flip, rename])
def test_a_damaged_kernel_is_compiled_again(kernels, damage):
    """Loading a library that was cut off ends Python with SIGBUS, in every run from then on: so in a process apart."""
    source = ANSWER % damage.__name__
    assert native.load_library(source, "answer") is not None
    (library,) = kernels.glob("*.so")
    copy = library.with_name("copy")  # this process has the library itself mapped
    copy.write_bytes(library.read_bytes())
    copy.chmod(0o700)
    copy.replace(library)
    inode = library.stat().st_ino
    damage(library)
    process = subprocess.run(
        [sys.executable, "-c", LOAD.format(source=source)], capture_output=True, text=True, check=False
    )
    assert (process.returncode, process.stdout) == (0, "42\n"), process.stderr
    assert native._find_whole(kernels, library.name.partition(".")[0]) == library
    assert (library.stat().st_ino == inode) == (damage is damage_nothing)


def test_a_compiler_that_hangs_is_asked_once(kernels, make_compiler, monkeypatch, tmp_path, caplog):
    """It and what it started are killed; the next process does not wait again."""
    make_compiler(f'echo asked >> "{tmp_path}/asked"; sleep 30 & wait')
    monkeypatch.setattr(native, "COMPILER_S", 0.3)
    monkeypatch.setattr(native.os, "getloadavg", lambda: (1.0, 1.0, 1.0))
    begin = time.monotonic()
    assert native.load_library(ANSWER % "hangs", "answer") is None
    (line,) = caplog.messages
    assert line.startswith("seaopt: C compiler ") and "did not end within 0." in line
    native.load_library.cache_clear()
    assert native.load_library(ANSWER % "hangs", "answer") is None
    assert native.load_library(ANSWER % "hangs with another source", "answer") is None
    assert time.monotonic() - begin < 5.0
    assert (tmp_path / "asked").read_text(encoding="utf-8").count("asked") == 1
    assert not list(kernels.glob(f"{native.BUILD}*"))
    (marker,) = kernels.glob("*.hung")
    for asked, day in ((2, 1.0), (3, time.time() + 1e8)):  # long ago, or before a clock that was ahead was set
        os.utime(marker, (day, day))
        assert native.load_library(ANSWER % f"another day, {asked}", "answer") is None
        assert (tmp_path / "asked").read_text(encoding="utf-8").count("asked") == asked


def test_a_compiler_that_a_busy_machine_holds_up_is_asked_again(kernels, make_compiler, monkeypatch, tmp_path):
    """It was not asked for an hour, by everybody who shares the cache."""
    make_compiler(f'echo asked >> "{tmp_path}/asked"; sleep 30 & wait')
    monkeypatch.setattr(native, "COMPILER_S", 0.3)
    monkeypatch.setattr(native.os, "getloadavg", lambda: (10.0 * os.cpu_count(), 1.0, 1.0))
    for time_asked in (1, 2):
        assert native.load_library(ANSWER % f"held up {time_asked}", "answer") is None
        assert (tmp_path / "asked").read_text(encoding="utf-8").count("asked") == time_asked
    assert not list(kernels.glob("*.hung"))


@needs_compiler
def test_processes_that_want_one_kernel_compile_it_once(kernels, make_compiler, tmp_path):
    make_compiler(f'echo asked >> "{tmp_path}/asked"; sleep 0.3; exec {native.shutil.which("cc")} "$@"')
    program = [sys.executable, "-c", LOAD.format(source=ANSWER % "at once")]
    processes = [subprocess.Popen(program, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    assert [process.communicate(timeout=60)[0] for process in processes] == ["42\n"] * 3
    assert (tmp_path / "asked").read_text(encoding="utf-8").count("asked") == 1
    assert {file.suffix for file in kernels.iterdir()} == {".so"}


@needs_compiler
@pytest.mark.parametrize("unknown", ["-fipa*", "-m*", "-fipa* | -m*"])
def test_a_compiler_that_refuses_options_compiles_without_them(kernels, make_compiler, unknown):
    """As clang and zig, whose error for an option of gcc alone left no kernel at all."""
    make_compiler(
        f'for option; do case "$option" in {unknown}) exit 1;; esac; done; exec {native.shutil.which("cc")} "$@"'
    )
    assert native.load_library(ANSWER % unknown, "answer") is not None


# What a shell script does in the compiler's place, once $out is the file that it is to write and $good a good library.
FAULTY = {
    "fails": "exit 1",
    "fails with half a library": 'head -c 5000 "$good" > "$out"; exit 1',
    "fails with a whole library": 'cp "$good" "$out"; exit 1',
    "is killed over half a library": 'head -c 5000 "$good" > "$out"; kill -9 $$',
    "is killed over a whole library": 'cp "$good" "$out"; kill -SEGV $$',
    "calls half a library good": 'head -c 5000 "$good" > "$out"',
    "calls a library of nothing good": ': > "$out"',
    "calls text good": 'echo "int x;" > "$out"',
    "calls a folder good": 'mkdir "$out"',
    "writes nothing": "exit 0",
    "writes another library": 'cp "$good" "$out"',
}


FAULTY_RUNS = """
import json, os, sys
from seaopt.simulation import native
for script in json.load(sys.stdin):
    with open(os.environ["SEAOPT_COMPILER"], "w") as stream:
        stream.write(script)
    for _ in range(2):
        print(native.load_kernel({source!r} + script.splitlines()[-1] + "*/", "answer"), flush=True)
        native.load_library.cache_clear()
"""


@needs_compiler
def test_what_a_faulty_compiler_leaves_is_never_loaded(kernels, make_compiler, compiler, tmp_path):
    """In a process apart: half a library with its own hash beside it ended every later run with SIGBUS."""
    good, code = tmp_path / "good.so", tmp_path / "good.c"
    code.write_text("int another(void) { return 7; }", encoding="utf-8")
    subprocess.run([*compiler, "-shared", "-fPIC", str(code), "-o", str(good)], check=True)
    make_compiler("")
    head = f'#!/bin/sh\ngood="{good}"; while [ "$1" != "-o" ]; do shift; done; out="$2"\n'
    done = subprocess.run(
        [sys.executable, "-c", FAULTY_RUNS.format(source=ANSWER.partition("%")[0])],
        input=json.dumps([head + fault for fault in FAULTY.values()]), capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout.split()) == (0, ["None"] * 2 * len(FAULTY)), done.stderr
    assert done.stderr.startswith("seaopt: C compiler ") and done.stderr.count("\n") == 1
    assert not list(kernels.iterdir())


@needs_compiler
def test_what_killed_compilers_left_is_swept(kernels):
    old, new = kernels / "build-old", kernels / "build-new"
    for left in (old, new):
        left.mkdir()
        (left / "kernel.c").write_text("int x;", encoding="utf-8")
    os.utime(old, (1.0, 1.0))
    assert native.load_library(ANSWER % "sweeps", "answer") is not None
    assert not old.exists() and new.exists()


@needs_compiler
def test_a_full_disk_under_the_kernels_is_as_no_compiler(kernels, monkeypatch):
    def refuse(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(native.Path, "replace", refuse)
    assert native.load_library(ANSWER % "full disk", "answer") is None
    assert not list(kernels.glob("*.so"))
