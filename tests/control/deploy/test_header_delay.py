"""A law driven as its header says, on a drive that takes its time: the loop has the figures that were stated.

The simulator is the test's own: the stand's linear equations over a grid of 20 us, the command as the header has it put
out, its effect as late as the drive is. Peak of abs(S) and bandwidth come from impulse responses of that simulation.
"""

from __future__ import annotations

import ctypes
import subprocess

import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.control.deploy.export import export
from seaopt.control.laws.realisation import runnable

PERIOD, SUBSTEPS, SAMPLES, POINTS = 1e-3, 50, 4000, 1 << 16
SPEC = so.ControllerSpec(bandwidth_hz=35, max_sensitivity=1.65, max_noise_gain=40)
WRAPPER = """
#include "law.h"
static law_law one;
void begin(void) { law_init(&one); }
double answer(double reference, double reading) { return law_step(&one, reference, reading); }
int samples_to_wait(void) { return LAW_COMPUTE_DELAY_SAMPLES; }
"""


class Drive:
    """The stand behind a drive that is late, in steps of 20 us: x+ = a x + b u, the command held in each."""

    def __init__(self, plant, params, delay_samples):
        system = plant.linearize(params)
        row = list(plant.outputs).index("F1")
        n = system.A.shape[0]
        block = np.zeros((n + 1, n + 1))
        block[:n, :n], block[:n, n] = system.A, system.B[:, 0]
        fine = expm(block * PERIOD / SUBSTEPS)
        self.late = round(delay_samples * SUBSTEPS)
        self.c, self.x, self.a, self.b = system.C[row], np.zeros(n), fine[:n, :n], fine[:n, n]
        assert system.D[row, 0] == 0.0

    def play(self, command, wait, reference, disturbance):
        """Return the readings: `command` of reference and reading, put out `wait` samples after the reading."""
        put_out, readings = np.zeros(SAMPLES + wait), np.zeros(SAMPLES)
        hop, whole = np.linalg.matrix_power(self.a, SUBSTEPS), self.late // SUBSTEPS
        part = self.late - whole * SUBSTEPS
        into = [np.linalg.matrix_power(self.a, SUBSTEPS - 1 - k) @ self.b for k in range(SUBSTEPS)]
        older, newer = sum(into[:part], np.zeros_like(self.b)), sum(into[part:], np.zeros_like(self.b))
        x = self.x.copy()
        for k in range(SAMPLES):
            readings[k] = self.c @ x + disturbance[k]
            put_out[k + wait] = command(reference[k], readings[k])
            acting = [put_out[j] if j >= 0 else 0.0 for j in (k - whole - 1, k - whole)]
            x = hop @ x + older * acting[0] + newer * acting[1]
        return readings

    def measure(self, begin, command, wait):
        """Return Ms and the bandwidth, Hz, of the simulated loop."""
        impulse, f = np.eye(1, SAMPLES)[0], np.fft.rfftfreq(POINTS, PERIOD)
        begin()
        reading = self.play(command, wait, 0.0 * impulse, impulse)
        begin()
        force = self.play(command, wait, impulse, 0.0 * impulse)
        assert max(abs(reading[-1]), abs(force[-1])) < 1e-6
        peak = np.max(np.abs(np.fft.rfft(reading, POINTS)))
        tracking = np.abs(np.fft.rfft(force, POINTS))
        return peak, f[np.flatnonzero(tracking < tracking[0] / np.sqrt(2.0))[0]]


def fit_late(plant, thor, delay_samples):
    """Return the fit of a log that the same drive made, its program reading and writing in one tick."""
    rng = np.random.default_rng(8)
    current = np.repeat(rng.normal(size=500), 4) + 0.3 * rng.normal(size=2000)
    current[:10] = 0.0  # nothing is known of the command before the log
    path = iter(current)
    drive = Drive(plant, thor, delay_samples)
    force = drive.play(lambda r, y: next(path, 0.0), 0, np.zeros(SAMPLES), np.zeros(SAMPLES))[: current.size]
    log = so.Log.from_arrays(time=PERIOD * np.arange(current.size), I=current, F1=force + rng.normal(size=current.size))
    delay = so.Parameter(name="delay_s", value=1e-3, unit="s", free=True, max=0.01)
    experiment = so.Experiment(plant=plant, log=log, sigma={"F1": 1.0}, initial_state="rest", delay_s=delay)
    return so.fit([experiment], thor.update(b_r=1.3e-4).free("b_r"), diagnostics=False)


def load(compiler, controller, folder):
    """Return what begins and what answers of a law that was exported and compiled, and how long it waits."""
    export(controller, folder, name="law")
    (folder / "wrapper.c").write_text(WRAPPER)
    flags = ["-std=c99", "-O1", "-ffp-contract=off", "-shared", "-fPIC"]
    subprocess.run([*compiler, *flags, "law.c", "wrapper.c", "-lm", "-o", "law.so"], cwd=folder, check=True)
    library = ctypes.CDLL(str(folder / "law.so"))
    library.answer.argtypes, library.answer.restype = [ctypes.c_double] * 2, ctypes.c_double
    return library.begin, library.answer, library.samples_to_wait()


def interpret(controller):
    """Return the same of the law in Python."""
    law, state = runnable(controller), []

    def begin():
        state[:] = [law.reset()]

    def answer(reference, reading):
        command, state[0] = law.step(state[0], reference, reading)
        return command

    return begin, answer, controller.compute_delay_samples


@pytest.mark.parametrize(
    "late", [pytest.param(0.3, marks=pytest.mark.slow), 1.32, pytest.param(2.3, marks=pytest.mark.slow)]
)
def test_a_law_on_a_late_drive_has_the_figures_that_were_stated(late, stand, thor, request, tmp_path):
    fit = fit_late(stand, thor, late)
    controller = so.tune(stand, fit, SPEC)
    assert controller.feasible and controller.compute_delay_samples == 0
    assert controller.drive_delay_s == pytest.approx(late * PERIOD, abs=5e-6)
    drive, stated = Drive(stand, thor, late), controller.achieved
    assert drive.measure(*interpret(controller)) == pytest.approx((stated.ms, stated.bandwidth_hz), rel=0.01)
    compiler = request.getfixturevalue("compiler")
    assert drive.measure(*load(compiler, controller, tmp_path)) == pytest.approx(
        (stated.ms, stated.bandwidth_hz), rel=0.01
    )
    header = (tmp_path / "law.h").read_text()
    assert "at once, within the sample of the reading" in header and "do not wait for them" in header
    assert controller.delays in header


def test_a_program_that_takes_a_sample_is_stated_with_it(stand, thor):
    """The drive's delay as given, and a sample of the program's: 2.32 in all."""
    spec = so.ControllerSpec(
        bandwidth_hz=30, max_sensitivity=1.65, max_noise_gain=40, compute_delay_samples=1, drive_delay_s=1.32e-3
    )
    controller = so.tune(stand, thor, spec)
    found = Drive(stand, thor, 1.32).measure(*interpret(controller))
    assert found == pytest.approx((controller.achieved.ms, controller.achieved.bandwidth_hz), rel=0.01)
