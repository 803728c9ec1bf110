"""Force steps that saturate, pid against predictive control, and what a step of the latter costs.

    python benchmarks/bench_mpc.py

Times are of 10,000 steps over 2,000 random references with sensor noise, and are told over the sample time of 1 ms.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

import seaopt as so
from seaopt.control import MPCSpec, close_loop, export_mpc, force_mpc
from seaopt.control.laws.realisation import runnable

STAND, SWING, THOR = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
LIMIT_A, BANDWIDTH_HZ, STEPS, TS = 9.0, 30.0, 10_000, 1e-3


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


def over_sample(seconds):
    found = np.array([np.median(seconds), np.percentile(seconds, 99.9), np.max(seconds)]) / TS
    return "median {:.3f}, 99.9 % {:.3f}, worst {:.3f}".format(*found)


def time_steps():
    rng = np.random.default_rng(0)
    reference = np.repeat(rng.uniform(-2200.0, 2200.0, STEPS // 50), 50)
    for slew in (None, 2000.0, 500.0):
        mpc = force_mpc(STAND, THOR, MPCSpec(current_limit_A=LIMIT_A, current_slew_A_per_s=slew))
        steps, pairs = [], []

        def watched(state, r, y, mpc=mpc, steps=steps, pairs=pairs):
            step = mpc.step(state, r, y)
            steps.append(step)
            pairs.append(f"{r!r} {y!r}")
            return step.current_A, step.state

        run = close_loop(watched, mpc.start, STAND, THOR, reference, sensor_std=2.0)
        failed = sum(not step.solved for step in steps)
        print(f"\nslew limit {slew} A/s: {len(steps)} steps, {failed} without a solution, at the limit of current in "
              f"{np.mean(np.abs(run.current) > LIMIT_A - 1e-6):.0%}, iterations at most "
              f"{max(step.iterations for step in steps)}")  # fmt: skip
        print(f"  Python step / sample time:      {over_sample(np.array([step.step_time_s for step in steps]))}")
        print(f"  OSQP alone in it / sample time: {over_sample(np.array([step.solve_time_s for step in steps]))}")
        time_c(mpc, pairs, run.current)


def time_c(mpc, pairs, currents):
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        print("  no C compiler: the exported code is not timed")
        return
    with tempfile.TemporaryDirectory() as place:
        folder = export_mpc(mpc, Path(place) / "code")
        sources = sorted(str(path.relative_to(folder)) for path in [*folder.glob("*.c"), *folder.glob("src/*.c")])
        paths = ["-std=c99", "-O2", "-Iinc/public", "-Iinc/private", "-I."]
        subprocess.run([compiler, *paths, *sources, "-lm", "-o", "example"], cwd=folder, check=True)
        runs = [
            subprocess.run([str(folder / "example")], input="\n".join(pairs), capture_output=True, text=True).stdout
            for _ in range(5)
        ]
        size = (folder / "example").stat().st_size
    rows = np.array([[line.split() for line in said.splitlines()] for said in runs], dtype=float)
    seconds, rows = rows[:, :, 3].min(axis=0), rows[0]  # the same step every time: the least is what it takes
    print(f"  exported C, CPU / sample time:  {over_sample(seconds)}; {size // 1000} kB, currents as Python's "
          f"within {np.max(np.abs(rows[:, 0] - currents)):.1e} A")  # fmt: skip


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
    margins()
