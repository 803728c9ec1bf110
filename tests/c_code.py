"""Exported C, compiled strictly and run, for tests."""

from __future__ import annotations

import ctypes
import re
import subprocess

import numpy as np

from seaopt.control import export_mpc
from seaopt.control.deploy.export import export

STRICT = ["-Wall", "-Wextra", "-Werror", "-std=c99", "-pedantic"]
CONVERSIONS = ["-Wconversion", "-Wsign-conversion", "-Wdouble-promotion", "-Wshadow"]


class LoadedLaw:
    """A law that was exported to a folder, compiled there, through ctypes."""

    def __init__(self, compiler, folder, name, inputs, precision="double", gated=False):
        library = folder / "law.so"
        command = [*compiler, *STRICT, "-O2", "-shared", "-fPIC", str(folder / f"{name}.c"), "-o", str(library)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        real = ctypes.c_double if precision == "double" else ctypes.c_float
        order = int(re.search(r"_ORDER (\d+)", (folder / f"{name}.h").read_text())[1])
        gate = (
            ("refused", ctypes.c_ulong),
            ("measurement_N", real),
            ("known", ctypes.c_int),
            ("disagrees", ctypes.c_int),
        )

        class Law(ctypes.Structure):
            _fields_ = (
                ("x", real * max(order, 1)), ("current_A", real), ("held", ctypes.c_ulong), ("status", ctypes.c_int),
                *(gate if gated else ()),
            )  # fmt: skip

        self.law, self.library = Law(), ctypes.CDLL(str(library))
        self._step, self._reset = (getattr(self.library, f"{name}_{what}") for what in ("step", "reset"))
        self._step.argtypes = [ctypes.POINTER(Law), *[real] * inputs]
        self._step.restype = real
        self._reset.argtypes = [ctypes.POINTER(Law), *[real] * inputs, real]
        self._init = getattr(self.library, f"{name}_init")
        self.init()

    def init(self):
        self._init(ctypes.byref(self.law))

    def step(self, reference, *measurements):
        return self._step(ctypes.byref(self.law), float(reference), *map(float, measurements))

    def reset(self, *values):
        self._reset(ctypes.byref(self.law), *values)

    def run(self, references, measurements):
        return np.array([self.step(r, *np.ravel(y)) for r, y in zip(references, measurements, strict=True)])


class CompiledLaw(LoadedLaw):
    """A law, exported and compiled."""

    def __init__(self, compiler, folder, controller, precision, **options):
        export(controller, folder, precision=precision, name="law", **options)
        gate = options.get("gate")
        inputs = controller.law.d.size + (len({*gate.reads} - {*controller.signals}) if gate else 0)
        super().__init__(compiler, folder, "law", inputs, precision, gate is not None)


class LoadedMPC:
    """Predictive control that was exported to a folder: its files without a warning, as the program of its example."""

    def __init__(self, compiler, folder):
        self.folder = folder
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


class CompiledSchedule:
    """An exported schedule through ctypes."""

    def __init__(self, compiler, folder, schedule, precision="double", **options):
        export(schedule, folder, precision=precision, name="law", **options)
        library = folder / "law.so"
        # No fused operations, so that every product is rounded as NumPy's.
        flags = [*STRICT, "-O2", "-ffp-contract=off", "-shared", "-fPIC"]
        done = subprocess.run(
            [*compiler, *flags, str(folder / "law.c"), "-o", str(library)], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        real = ctypes.c_double if precision == "double" else ctypes.c_float

        law = schedule.runnable()
        terms = law.compensation
        rubs = terms is not None and terms.friction is not None
        at_rest = {term.reads for term in (terms.gravity, terms.ripple) if term} if terms else ()
        heat = (
            *((name, ctypes.c_double) for name in ("rise_winding", "rise_case", "limit")),
            ("derated", ctypes.c_int),
        )
        gate = (("refused", ctypes.c_ulong), ("measurement_Nm", real), ("known", ctypes.c_int))

        class Law(ctypes.Structure):
            _fields_ = (
                ("x", real * len(law.reset().x)), ("current_A", real), ("held", ctypes.c_ulong),
                ("status", ctypes.c_int), ("place", real), ("misplaced", ctypes.c_ulong),
                *(heat if options.get("derate") else ()),
                *(gate if options.get("gate") else ()),
                *((("friction_last", real), ("friction_known", ctypes.c_int)) if rubs else ()),
            )  # fmt: skip

        reads = () if terms is None else terms.reads
        self.law, self.library = Law(), ctypes.CDLL(str(library))
        self.library.law_step.argtypes = [ctypes.POINTER(Law), *[real] * (2 + law.measured + len(reads))]
        self.library.law_step.restype = real
        self.library.law_reset.argtypes = [ctypes.POINTER(Law), *[real] * (3 + law.measured + len(at_rest))]
        self.library.law_init(ctypes.byref(self.law))

    def step(self, reference, measurement, place, further=()):
        return self.library.law_step(ctypes.byref(self.law), reference, *np.ravel(measurement), *further, place)

    def reset(self, reference, measurement, place, command, further=()):
        self.library.law_reset(ctypes.byref(self.law), reference, *np.ravel(measurement), *further, place, command)


class CompiledMPC(LoadedMPC):
    """A `ForceMPC`, exported and compiled."""

    def __init__(self, compiler, folder, mpc, **options):
        super().__init__(compiler, export_mpc(mpc, folder, **options))


class CompiledLog:
    """A law with its log, compiled strictly, through ctypes."""

    def __init__(self, compiler, folder, controller, rows, precision="double", **options):
        export(controller, folder, name="law", log_rows=rows, precision=precision, **options)
        made = folder / "log.so"
        command = [*compiler, *STRICT, *CONVERSIONS, "-O2", "-shared", "-fPIC", folder / "law.c", folder / "law_log.c"]
        done = subprocess.run([*command, "-o", made], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        self.library = ctypes.CDLL(str(made))
        header = (folder / "law_log.h").read_text()
        stated = {name: int(value) for name, value in re.findall(r"#define LAW_LOG_(\w+) (\d+)UL", header)}
        self.bytes, self.row_bytes = stated["BYTES"], stated["ROW_BYTES"]
        self.real = ctypes.c_double if precision == "double" else ctypes.c_float
        self.ring = (ctypes.c_uint32 * (self.bytes // 4))()
        self.header = bytes((ctypes.c_char * stated["HEADER_BYTES"]).in_dll(self.library, "law_log_header"))
        self.library.law_log_init(self.ring)

    def push(self, status, *values):
        return self.library.law_log_push(self.ring, status, *map(self.real, values))

    def drain(self, size):
        into = ctypes.create_string_buffer(size)
        count = self.library.law_log_drain(self.ring, into, ctypes.c_uint32(size))
        return into.raw[:count]

    @property
    def hash(self):
        return re.search(b'"hash": "([0-9a-f]+)"', self.header)[1]

    @property
    def overruns(self):
        return self.ring[2]

    def file(self, path, rows):
        path.write_bytes(self.header + rows)
        return path
