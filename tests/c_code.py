"""Exported C, compiled strictly and run, for tests."""

from __future__ import annotations

import ctypes
import re
import subprocess

import numpy as np

from seaopt.control import export_mpc
from seaopt.control.deploy.export import export

STRICT = ["-Wall", "-Wextra", "-Werror", "-std=c99", "-pedantic"]


class CompiledLaw:
    """An exported law through ctypes."""

    def __init__(self, compiler, folder, controller, precision, **options):
        export(controller, folder, precision=precision, name="law", **options)
        library = folder / "law.so"
        command = [*compiler, *STRICT, "-O2", "-shared", "-fPIC", str(folder / "law.c"), "-o", str(library)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        real = ctypes.c_double if precision == "double" else ctypes.c_float
        order = int(re.search(r"_ORDER (\d+)", (folder / "law.h").read_text())[1])

        class Law(ctypes.Structure):
            _fields_ = (
                ("x", real * max(order, 1)),
                ("current_A", real),
                ("held", ctypes.c_ulong),
                ("status", ctypes.c_int),
                ("refused", ctypes.c_ulong),
                ("measurement_N", real),
                ("known", ctypes.c_int),
            )  # fmt: skip; the last three are there with a gate

        self.law, self.library = Law(), ctypes.CDLL(str(library))
        read = controller.law.d.size - 1
        self.library.law_step.argtypes = [ctypes.POINTER(Law), real, *[real] * read]
        self.library.law_step.restype = real
        self.library.law_reset.argtypes = [ctypes.POINTER(Law), real, *[real] * read, real]
        self.library.law_init(ctypes.byref(self.law))

    def step(self, reference, *measurements):
        return self.library.law_step(ctypes.byref(self.law), float(reference), *map(float, measurements))

    def reset(self, *values):
        self.library.law_reset(ctypes.byref(self.law), *values)

    def run(self, references, measurements):
        return np.array([self.step(r, *np.ravel(y)) for r, y in zip(references, measurements, strict=True)])


class CompiledMPC:
    """An exported `ForceMPC`: its files without a warning, as the program of its example."""

    def __init__(self, compiler, folder, mpc, **options):
        self.folder = export_mpc(mpc, folder, **options)
        files = sorted(path.name for path in self.folder.glob("*.c"))
        subprocess.run([*compiler, *STRICT, "-O1", *files, "-lm", "-o", "example"], cwd=self.folder, check=True)

    def run(self, references, measurements):
        """Return a row per sample: the current, whether it was solved, iterations, ..., what the gate says.

        A reference is a number, or with preview an array of the present one and those that follow.
        """
        samples = zip(references, measurements, strict=True)
        lines = "\n".join(" ".join(repr(float(x)) for x in (*np.atleast_1d(r), y)) for r, y in samples)
        said = subprocess.run([str(self.folder / "example")], input=lines, capture_output=True, text=True, check=True)
        return np.array([line.split() for line in said.stdout.splitlines()], dtype=float)
