"""Compile a kernel's C source with the machine's compiler, once a user and source; none is needed.

The shared libraries live in a folder of the user's own (mode 0700, refused if anyone else can write to it) under
the hash of their source, flags and compiler. ``SEAOPT_COMPILER`` names a compiler, or "none" to use none;
``SEAOPT_CACHE_DIR`` names the folder.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import stat
import subprocess
import sys
import tempfile
from functools import lru_cache
from pathlib import Path

FLAGS = ("-O3", "-std=gnu99", "-fPIC", "-shared", "-fno-math-errno", "-fvisibility=hidden")
NATIVE = (
    "-march=native",
    "-mprefer-vector-width=256",
    "-mno-avx512f",
)


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
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        folder.chmod(0o700)
    except OSError:
        return None
    return folder if _private(folder) else None


def _private(path: Path) -> bool:
    """Tell whether a file or folder, not a link, is the user's own and nobody else can write to it."""
    try:
        status = path.lstat()
    except OSError:
        return False
    own = status.st_uid == os.getuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return own and not stat.S_ISLNK(status.st_mode)


@lru_cache(maxsize=64)
def load_library(source: str) -> ctypes.CDLL | None:
    """Return the shared library of a C source, compiled or from the cache; None without compiler or folder."""
    compiler, folder = find_compiler(), cache_folder()
    if compiler is None or folder is None:
        return None
    key = hashlib.sha256("\0".join((source, *FLAGS, *compiler, sys.platform, _processor())).encode()).hexdigest()
    library = folder / f"{key}.so"
    if not library.exists() and not _compile(compiler, source, library):
        return None
    if not _private(library):
        return None
    try:
        return ctypes.CDLL(str(library))
    except OSError:  # built for another machine that shares this folder
        pass
    try:
        return ctypes.CDLL(str(library)) if _compile(compiler, source, library) else None
    except OSError:
        return None


@lru_cache(maxsize=1)
def _processor() -> str:
    """Return what tells processors with other instructions apart: several machines may share a home folder."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line for line in lines if line.startswith(("flags", "Features"))), platform.machine())


def _compile(compiler: list[str], source: str, library: Path) -> bool:
    return any(_compiled([*compiler, *FLAGS, *extra], source, library) for extra in (NATIVE, ()))


def _compiled(start: list[str], source: str, library: Path) -> bool:
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        code, built = Path(folder) / "kernel.c", Path(folder) / "kernel.so"
        code.write_text(source, encoding="utf-8")
        command = [*start, str(code), "-o", str(built), "-lm"]
        try:
            done = subprocess.run(command, capture_output=True, timeout=120, check=False)  # noqa: S603
        except (OSError, subprocess.SubprocessError):
            return False
        if done.returncode or not built.exists():
            return False
        built.chmod(0o700)
        built.replace(library)
    return True
