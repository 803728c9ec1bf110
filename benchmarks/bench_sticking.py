"""Fits of a knee whose friction sticks, with a free delay: processor time of a fit with its verdict, by length of log.

    OMP_NUM_THREADS=1 python -m benchmarks.bench_sticking [SECONDS ...] [--seed 3] [--smooth V_S] [--limit 150]
        [--keep NAME] [--page docs/evidence/intervals.md]

The knee (N = 80, 1 kHz, two encoders and the spring's torque) is simulated by benchmarks/truth, its link held and as a
pendulum; values start off by up to a factor of two. With --smooth friction is smoothed over V_S rad/s instead. A fit
that has not ended after --limit seconds of processor time is left. With --keep the rows are kept in sticking.json under
a name, such as that of the state that is measured, and --page writes the table of all that is kept into a page, between
its two marks.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import seaopt as so

sys.path.insert(0, str(Path(__file__).parent / "truth"))
import actuators

RATE_HZ = 1000.0
KNEE = actuators._rotary(
    J_m=1.2e-4, b_r=5e-4, K_tau=0.08, N=80.0, k_s=350.0, f_c=0.06, torque=0.1, current=8.0, chirp_hz=(0.1, 20.0)
)
FREE = ("J_m", "b_r", "k_s", "f_c", "eta")
KEPT = Path(__file__).parent / "sticking.json"
MARKS = ("<!-- bench_sticking: begin -->\n", "<!-- bench_sticking: end -->\n")
LINKS = {"locked": "held", "pendulum": "pendulum"}


@contextmanager
def limit_processor(seconds: float) -> Iterator[None]:
    """Raise TimeoutError inside after so many seconds of processor time."""

    def stop(*_: Any) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def fit_knee(link: str, seconds: float, seed: int, v_s: float | None) -> tuple[so.Fit, float]:
    """Return the fit of a knee's log, and its processor time."""
    actuators.RATE_HZ, actuators.SUBSTEPS, actuators.KINDS["knee"] = RATE_HZ, 400, KNEE
    readings = actuators.Actuator(kind="knee", link=link).record(seconds=seconds, amplitude=1.0, seed=seed)
    log = so.Log.from_arrays(**readings).restamp(rate_hz=RATE_HZ)
    plant = so.plants.rotary(link=link)
    if v_s is None:
        plant = so.plants.let_stick(plant)
    rng = np.random.default_rng(seed)
    known = {name: value for name, value in KNEE.values.items() if name in plant.parameters}
    guess = {name: known[name] * 2.0 ** rng.uniform(-1, 1) for name in FREE}
    smooth = {} if v_s is None else {"v_s": v_s}
    params = plant.defaults.update(**known | guess | smooth).free(*FREE)
    delay = so.Parameter(name="delay", value=1e-3, unit="s", min=0.0, max=0.01, free=True)
    outputs = tuple(name for name in readings if name not in ("time", "I"))
    started = time.process_time()
    fit = so.fit([so.Experiment(plant=plant, log=log, outputs=outputs, delay_s=delay)], params)
    return fit, time.process_time() - started


def measure(link: str, seconds: float, seed: int, v_s: float | None, limit_s: float) -> dict[str, Any]:
    """Return the row of a fit: its processor time, None where it has not ended, how it ended, and its largest error."""
    row: dict[str, Any] = {"link": link, "seconds": seconds, "seed": seed, "limit_s": limit_s, "cpu_s": None}
    try:
        with limit_processor(limit_s):
            fit, cpu = fit_knee(link, seconds, seed, v_s)
    except TimeoutError:
        return row
    off = max(abs(fit.parameters[name].value / KNEE.values[name] - 1.0) for name in FREE)
    return row | {"cpu_s": round(cpu, 3), "status": fit.status, "met": bool(fit.met), "off": float(f"{off:.2g}")}


def describe(row: dict[str, Any]) -> str:
    """Return a row in words."""
    if row["cpu_s"] is None:
        return f"not done in {row['limit_s']:.0f} s"
    met = "met" if row["met"] else f"{row['status'].replace('_', ' ')}, not met"
    return f"{row['cpu_s']:.2g} s, {met}, {100 * row['off']:.2g} % off"


def format_table(kept: dict[str, list[dict[str, Any]]]) -> str:
    """Return the table of what is kept: a row for each log, a column for each name."""
    logs = dict.fromkeys((row["seconds"], row["link"]) for rows in kept.values() for row in rows)
    lines = [f"| log | {' | '.join(kept)} |", "|---|" + "---|" * len(kept)]
    for seconds, link in sorted(logs):
        rows = [[r for r in rows if (r["seconds"], r["link"]) == (seconds, link)] for rows in kept.values()]
        cells = [describe(found[0]) if found else "not measured" for found in rows]
        lines.append(f"| {seconds:g} s, link {LINKS[link]} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def write_page(page: Path, kept: dict[str, list[dict[str, Any]]]) -> None:
    """Write the table of what is kept into a page, between its marks."""
    text = page.read_text(encoding="utf-8")
    before, rest = text.split(MARKS[0])
    after = rest.split(MARKS[1])[1]
    page.write_text(before + MARKS[0] + format_table(kept) + MARKS[1] + after, encoding="utf-8")


def main() -> None:
    """Fit logs of the lengths that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seconds", type=float, nargs="*")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--smooth", type=float)
    parser.add_argument("--limit", type=float, default=150.0)
    parser.add_argument("--keep")
    parser.add_argument("--page", type=Path)
    options = parser.parse_args()
    kept: dict[str, list[dict[str, Any]]] = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.exists() else {}
    for seconds in options.seconds or ([] if options.page else [8.0, 15.0, 30.0, 60.0]):
        for link in LINKS:
            row = measure(link, seconds, options.seed, options.smooth, options.limit)
            print(f"{link:8s} {seconds:5.0f} s  {describe(row)}", flush=True)
            if options.keep:
                rows = kept.setdefault(options.keep, [])
                rows[:] = [each for each in rows if (each["seconds"], each["link"]) != (seconds, link)] + [row]
                KEPT.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    if options.page:
        write_page(options.page, kept)


if __name__ == "__main__":
    main()
