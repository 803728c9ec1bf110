"""Logs of a machine under an exported law, by a simulator in C (machine.c) that shares no equation with seaopt."""

from __future__ import annotations

import ctypes
import math
import subprocess
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

import seaopt as so

SOURCE = Path(__file__).with_name("machine.c")
STEPS = 20  # integration steps per tick


@dataclass(frozen=True)
class Machine:
    """THOR's stand: M = J/r^2, b = b_r/r^2, per ampere eta K_tau/r, r = l/(2 pi N_p)."""

    mass: float = 3.31e-6 / (0.002 / (6.0 * math.pi)) ** 2
    damping: float = 1.31e-4 / (0.002 / (6.0 * math.pi)) ** 2
    stiffness: float = 655000.0
    per_ampere: float = 0.0255 / (0.002 / (6.0 * math.pi))
    coulomb: float = 0.0
    smoothing: float = 1e-3
    mass2: float = 0.0
    stiffness2: float = 0.0
    damping2: float = 0.0
    delay_s: float = 0.0
    late: float = 1.0  # ticks from a reading to the command being put out
    law_gain: float = 1.0
    reading_sign: float = 1.0
    drive_sign: float = 1.0
    sensor_range: float = 1e9
    current_step: float = 0.0
    force_step: float = 0.0
    every: float = 1.0

    def with_mode(self, frequency_hz: float, share: float = 0.15, damping: float = 0.03) -> Machine:
        """Return the machine with a mass on a spring at the nut, tuned to a frequency."""
        m2, w = share * self.mass, 2.0 * math.pi * frequency_hz
        return replace(self, mass2=m2, stiffness2=m2 * w * w, damping2=2.0 * damping * m2 * w)


class Bench:
    """A law, exported and compiled, to be run on machines."""

    def __init__(self, compiler, folder, controller, name="law"):
        self.controller, self.folder = controller, Path(folder) / name
        so.export(controller, self.folder, allow_infeasible=True)
        library = self.folder / "machine.so"
        sources = [str(self.folder / "force_law.c"), str(SOURCE)]
        flags = ["-O2", "-std=c99", "-ffp-contract=off", "-shared", "-fPIC", f"-I{self.folder}"]
        subprocess.run([*compiler, *flags, *sources, "-lm", "-o", str(library)], check=True, capture_output=True)
        self._run = ctypes.CDLL(str(library)).run

    def log(self, machine, reference, *, noise=2.0, seed=1, period=None, decimals=None):
        """Return the log of a run: the law's clock is `period`, its sample time if left out."""
        period = period or self.controller.sample_time_s
        n = reference.size
        reference = np.ascontiguousarray(reference, dtype=float)
        errors = noise * np.random.default_rng(seed).normal(size=n)
        force, current = np.zeros(n), np.zeros(n)
        numbers = (ctypes.c_double * len(fields(machine)))(*(getattr(machine, f.name) for f in fields(machine)))
        pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in (reference, errors, force, current)]
        self._run(numbers, ctypes.c_long(n), ctypes.c_long(STEPS), ctypes.c_double(period), *pointers)
        if decimals is not None:
            force, current = np.round(force, decimals), np.round(current, decimals + 2)
        units = {"reference": "N", "I": "A", "F1": "N"}
        time = period * np.arange(n)
        return so.Log.from_arrays(time=time, reference=reference, I=current, F1=force, units=units, source="bench")


def multisine(period, lines, periods, amplitude, seed, bias=0.0):
    """Return a reference of equal sines at these lines of a period, with random phases and a largest value."""
    rng = np.random.default_rng(seed)
    spectrum = np.zeros(period // 2 + 1, dtype=complex)
    spectrum[lines] = np.exp(2j * np.pi * rng.uniform(size=len(lines)))
    wave = np.fft.irfft(spectrum, period)
    return bias + np.tile(amplitude * wave / np.max(np.abs(wave)), periods)
