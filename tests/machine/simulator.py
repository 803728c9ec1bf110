"""Logs of a machine under an exported law, by a simulator in C (machine.c) that shares no equation with seaopt."""

from __future__ import annotations

import ctypes
import math
import subprocess
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

import seaopt as so
from seaopt.control import Controller, ForceMPC, ScheduledController, export_mpc

SOURCE = Path(__file__).with_name("machine.c")
STEPS = 20  # integration steps per tick


@dataclass(frozen=True)
class Machine:
    """THOR's stand: M = J/r^2 + m_l, b = b_r/r^2, per ampere eta K_tau/r, r = l/(2 pi N_p)."""

    mass: float = 3.31e-6 / (0.002 / (6.0 * math.pi)) ** 2 + 0.646
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
    drive_limit: float = 1e9  # behind the logged command
    drive_drift: float = 0.0  # A/s, that it adds

    @classmethod
    def of_knee(cls, values) -> Machine:
        """Return a locked rotary actuator, as it is seen at its output: N^2 J_m, N^2 b_r, N eta K_tau per ampere."""
        at = {name: parameter.value for name, parameter in values.items()}
        gear = at["N"]
        return cls(
            mass=gear**2 * at["J_m"],
            damping=gear**2 * at["b_r"],
            stiffness=at["k_s"],
            per_ampere=gear * at["eta"] * at["K_tau"],
            coulomb=gear * at["f_c"],
            smoothing=at["v_s"] / gear,
        )

    def with_mode(self, frequency_hz: float, share: float = 0.15, damping: float = 0.03) -> Machine:
        """Return the machine with a mass on a spring at the nut, tuned to a frequency."""
        m2, w = share * self.mass, 2.0 * math.pi * frequency_hz
        return replace(self, mass2=m2, stiffness2=m2 * w * w, damping2=2.0 * damping * m2 * w)


class Bench:
    """A law, exported and compiled, to be run on machines; `exported`: its C is in the folder already."""

    def __init__(self, compiler, folder, controller, name="law", *, exported=False):
        self.controller, self.folder = controller, Path(folder) / name
        kind = ["-DPLAN", "-DREADS"] if isinstance(controller, ForceMPC) else []
        if isinstance(controller, ScheduledController):
            kind = ["-DPLACED"]
        elif isinstance(controller, Controller) and controller.further:
            kind = ["-DREADS"]
        if not exported and isinstance(controller, ForceMPC):
            export_mpc(controller, self.folder)
        elif not exported:
            so.export(controller, self.folder, allow_infeasible=True)
        library = self.folder / "machine.so"
        sources = [*map(str, sorted(self.folder.glob("*.c"))), str(SOURCE)]
        flags = ["-O2", "-std=c99", "-ffp-contract=off", "-shared", "-fPIC", *kind, f"-I{self.folder}"]
        subprocess.run([*compiler, *flags, *sources, "-lm", "-o", str(library)], check=True, capture_output=True)
        self._run = ctypes.CDLL(str(library)).run

    @property
    def signal(self):
        """What is regulated, and its unit."""
        law = self.controller
        if isinstance(law, ForceMPC):
            return law.measured, law.actuation.reference_unit
        first = law.controllers[0] if isinstance(law, ScheduledController) else law
        return first.signals[0], first.command.reference_unit

    def log(self, machine, reference, *, noise=2.0, seed=1, period=None, decimals=None, places=None, drift=0.0):
        """Return the log of a run: the law's clock is `period`, its sample time if left out; `places`: of a schedule,
        its variable in each tick; `drift`: of the sensor, per second, or by how much it is off in each tick.
        """
        law = self.controller
        period = period or (law.table if isinstance(law, ScheduledController) else law).sample_time_s
        n = reference.size
        reference = np.ascontiguousarray(reference, dtype=float)
        creep = drift * period * np.arange(n) if np.ndim(drift) == 0 else drift
        errors = noise * np.random.default_rng(seed).normal(size=n) + creep
        place, force, current = np.zeros(n) if places is None else places.copy(), np.zeros(n), np.zeros(n)
        numbers = (ctypes.c_double * len(fields(machine)))(*(getattr(machine, f.name) for f in fields(machine)))
        pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in (reference, errors, place, force, current)]
        self._run(numbers, ctypes.c_long(n), ctypes.c_long(STEPS), ctypes.c_double(period), *pointers)
        if decimals is not None:
            force, current = np.round(force, decimals), np.round(current, decimals + 2)
        name, unit = self.signal
        columns = {"time": period * np.arange(n), "reference": reference, "I": current, name: force}
        units = {"reference": unit, "I": "A", name: unit}
        if places is not None:
            columns, units = (
                columns | {self.controller.over: places},
                units | {self.controller.over: self.controller.unit},
            )
        elif further := law.further if isinstance(law, Controller) else law.reads:
            columns, units = columns | {further[0]: place}, units | {further[0]: "m"}
        return so.Log.from_arrays(**columns, units=units, source="bench")


def multisine(period, lines, periods, amplitude, seed, bias=0.0):
    """Return a reference of equal sines at these lines of a period, with random phases and a largest value."""
    rng = np.random.default_rng(seed)
    spectrum = np.zeros(period // 2 + 1, dtype=complex)
    spectrum[lines] = np.exp(2j * np.pi * rng.uniform(size=len(lines)))
    wave = np.fft.irfft(spectrum, period)
    return bias + np.tile(amplitude * wave / np.max(np.abs(wave)), periods)
