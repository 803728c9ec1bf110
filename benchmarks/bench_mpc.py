"""Force steps that saturate, pid against predictive control, and what a step of the latter costs.

    python benchmarks/bench_mpc.py

Times are of 200,000 steps of the exported C in closed loop, references that jump every 50 samples, with noise; and the
force error with references known ahead.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

import seaopt as so
from seaopt.control import MPCSpec, close_loop, export_mpc, force_mpc, sample
from seaopt.control.laws.realisation import runnable

STAND, SWING, THOR = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
LIMIT_A, BANDWIDTH_HZ, STEPS, TS = 9.0, 30.0, 200_000, 1e-3


def laws(*, told=False):
    """Return every law by name, as (step, start)."""
    spec = so.ControllerSpec(bandwidth_hz=BANDWIDTH_HZ, current_limit_A=LIMIT_A, max_sensitivity=1.6)
    controller = so.tune(STAND, THOR, spec, robust_to={"swing": SWING})
    law, f = runnable(controller), controller.achieved
    if told:
        print(f"pid: Ms {f.ms:.3g}, reference peak {f.reference_peak:.3g}, noise gain {f.noise_gain:.3g}")
    found = {"pid" + ("" if controller.feasible else " (not feasible)"): (law.step, law.reset())}
    for name, slew in (("mpc", None), ("mpc, 2000 A/s", 2000.0), ("mpc, 500 A/s", 500.0)):
        mpc = force_mpc(STAND, THOR, MPCSpec(current_limit_A=LIMIT_A, current_slew_A_per_s=slew))
        found[name] = (mpc.command, mpc.start)
    return found


def compare_steps():
    laws(told=True)
    print(f"{'force step':>10}  {'law':<28} {'overshoot':>9} {'to 5 %':>8} {'to 2 %':>8} {'peak current':>12}")
    for size in (200.0, 500.0, 1000.0, 1500.0, 2000.0):
        reference = np.where(np.arange(500) < 10, 0.0, size)
        for name, (step, start) in laws().items():
            run = close_loop(step, start, STAND, THOR, reference)
            times = [f"{1e3 * run.settling_time_s(band):.0f} ms" for band in (0.05, 0.02)]
            peak = np.max(np.abs(run.current))
            print(f"{size:8g} N  {name:<28} {run.overshoot:>9.1%} {times[0]:>8} {times[1]:>8} {peak:>10.2f} A")


CASES = {
    "no slew limit": {"current_slew_A_per_s": None},
    "2000 A/s": {},
    "500 A/s": {"current_slew_A_per_s": 500.0},
    "2000 A/s, speed": {"bounds": {"qd": (-0.05, 0.05)}},
    "2000 A/s, speed, force": {"bounds": {"qd": (-0.05, 0.05), "F1": (-1800.0, 1800.0)}},
    "the same, 20 iterations": {"bounds": {"qd": (-0.05, 0.05), "F1": (-1800.0, 1800.0)}, "max_iterations": 20},
}

# The loop around the exported step: the plant held over a sample, references that jump every 50 samples, noise.
HARNESS = """
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include "force_mpc.h"
#define N {states}
#define STEPS {steps}
static const double A[N][N] = {{{a}}}, B[N] = {{{b}}}, C[N] = {{{c}}};
static unsigned long long seed = 1;
static double uniform(void) {{
  seed = seed * 6364136223846793005ULL + 1442695040888963407ULL;
  return (double)(seed >> 11) / 9007199254740992.0 * 2 - 1;
}}
static double now(void) {{
  struct timespec t;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}}
static int order(const void *a, const void *b) {{
  const double *one = a, *other = b;
  return *one < *other ? -1 : *one > *other;
}}
int main(void) {{
  static force_mpc law;
  static double took[STEPS];
  double x[N] = {{0}}, late = 0, reference = 0, sum = 0;
  int most = 0, unsolved = 0, unfinished = 0;
  force_mpc_reset(&law);
  for (int k = 0; k < STEPS; k++) {{
    if (k % 50 == 0) reference = 2000 * uniform();
    double y = 0, next[N];
    for (int i = 0; i < N; i++) y += C[i] * x[i];
    y += 2 * (uniform() + uniform() + uniform());
    double began = now();
    double u = (double)force_mpc_step(&law, reference, y);
    took[k] = now() - began;
    sum += took[k];
    if (law.iterations > most) most = law.iterations;
    unsolved += !law.solved;
    unfinished += law.iterations == FORCE_MPC_MAX_ITERATIONS;
    for (int i = 0; i < N; i++) {{
      next[i] = B[i] * late;
      for (int j = 0; j < N; j++) next[i] += A[i][j] * x[j];
    }}
    for (int i = 0; i < N; i++) x[i] = next[i];
    late = u;
  }}
  qsort(took, STEPS, sizeof *took, order);
  printf("%.3f %.3f %.3f %d %g %g\\n", 1e6 * sum / STEPS, 1e6 * took[(int)(0.9999 * STEPS)], 1e6 * took[STEPS - 1],
         most, (double)unfinished / STEPS, (double)unsolved / STEPS);
  return 0;
}}
"""


def time_steps():
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        print("\nno C compiler: the exported code is not timed")
        return
    print(f"\nprocessor time of a step of the exported C (-O2, double), {STEPS} steps in closed loop, us")
    print(f"{'limits':<26} {'mean':>7} {'99.99 %':>8} {'most':>8} {'iterations':>10} {'unfinished':>10} {'no plan':>8}")
    digital = sample(STAND, THOR, "F1", 1.0, TS, 0)
    for name, options in CASES.items():
        spec = MPCSpec(**{"current_limit_A": LIMIT_A, "current_slew_A_per_s": 2000.0, **options})
        with tempfile.TemporaryDirectory() as place:
            folder = export_mpc(force_mpc(STAND, THOR, spec), Path(place) / "code")
            (folder / "example.c").unlink()
            plant = {key: ", ".join(map(repr, getattr(digital, key).ravel().tolist())) for key in "abc"}
            code = HARNESS.format(states=digital.b.size, steps=STEPS, **plant)
            (folder / "timing.c").write_text(code, encoding="utf-8")
            sources = sorted(path.name for path in folder.glob("*.c"))
            flags = ["-std=c99", "-O2"]
            subprocess.run([compiler, *flags, *sources, "-lm", "-o", "timing"], cwd=folder, check=True)
            said = subprocess.run([str(folder / "timing")], capture_output=True, text=True, check=True).stdout.split()
        mean, rare, most = map(float, said[:3])
        print(
            f"{name:<26} {mean:7.1f} {rare:8.1f} {most:8.1f} {said[3]:>10} {float(said[4]):10.3%} {float(said[5]):8.3%}"
        )


def track_ahead():
    print("\nforce error with references known ahead, rms N, bandwidth 20 Hz")
    time = TS * np.arange(600)
    references = {
        "sine, 10 Hz, 300 N": 300 * np.sin(2 * np.pi * 10 * time),
        "sine, 20 Hz, 150 N": 150 * np.sin(2 * np.pi * 20 * time),
        "step of 500 N": np.where(time < 0.1, 0.0, 500.0), "ramp, 5000 N/s": np.clip(5000 * (time - 0.1), 0, 800),
    }  # fmt: skip
    for name, reference in references.items():
        errors = []
        for ahead in (0, 5, 10, 20, 40):
            spec = MPCSpec(
                current_limit_A=LIMIT_A, current_slew_A_per_s=2000.0, bandwidth_hz=20.0, preview_samples=ahead
            )  # fmt: skip
            mpc = force_mpc(STAND, THOR, spec)
            run = close_loop(mpc.command, mpc.start, STAND, THOR, reference, preview_samples=ahead)
            errors.append(f"{ahead:2d}: {np.sqrt(np.mean((run.force - reference)[100:] ** 2)):6.1f}")
        print(f"{name:<20} {'   '.join(errors)}")


def margins():
    mpc = force_mpc(STAND, THOR, MPCSpec(current_limit_A=LIMIT_A))
    print("\nwithout limits, designed on the stand")
    for name, plant in (("stand", STAND), ("swing", SWING)):
        f = mpc.close(plant, THOR).figures()
        print(f"  {name}: stable {f.stable}, bandwidth {f.bandwidth_hz:.3g} Hz, Ms {f.ms:.3g}, Mt {f.mt:.3g}")
        print(f"    gain margin {f.gain_margin_db:.3g} dB, phase margin {f.phase_margin_deg:.3g} deg, noise gain "
              f"{f.noise_gain:.3g}")  # fmt: skip


if __name__ == "__main__":
    compare_steps()
    time_steps()
    track_ahead()
    margins()
