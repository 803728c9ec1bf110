"""The elastic joint of docs/evidence/elastic_joint.md by seaopt, CMA-ES and MuJoCo's minimize: time, error, interval.

    python benchmarks/peers/joint.py [--seed 0] [--limit 600] [--without-4096]

One log, one start, one machine, one after the other. Times are of a solve whose code is compiled; seaopt's row is its
whole answer, with diagnostics and verdict, and another is without. The peers' unknowns, bounds and simulation are in
peer_joint.py.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from run import CACHE, environment, interpreter, last_line

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "problems"))
import elastic_joint as joint

NAMES = [*joint.START, "delay_s"]
FIGURES = ("resonance_hz", "antiresonance_hz", "J_l", "k_s", "f_c", "delay_s")
PEERS = {
    "CMA-ES, 4096 candidates": ("cma", "--population", "4096"),
    "CMA-ES, its own population": ("cma",),
    "MuJoCo minimize.least_squares": ("minimize",),
}

Row = dict[str, Any]


def solve_ours(log: Any, diagnostics: bool) -> Row:
    """Return the second fit's figures, values and standard deviations."""
    joint.fit_elastic(log, diagnostics=diagnostics)
    begin, busy = time.perf_counter(), time.process_time()
    fit = joint.fit_elastic(log, diagnostics=diagnostics)
    spent = {"wall_s": time.perf_counter() - begin, "cpu_s": time.process_time() - busy}
    own = fit.nuisance["experiment"]
    figures = {
        **{name: fit.parameters[name].value for name in joint.START},
        **{name: one.value for name, one in fit.derived.items()},
    }
    stds = {name: (fit.derived[name] if name in fit.derived else fit.parameters[name]).std for name in FIGURES[:-1]}
    return {
        **spent, "values": {**figures, "delay_s": own.delay_s}, "std": {**stds, "delay_s": own.std["delay_s"]},
        "simulations": None, "note": f"{fit.iterations} iterations",
    }  # fmt: skip


def solve_peer(path: Path, arguments: tuple[str, ...], limit_s: float) -> Row:
    """Return a peer's figures; an interval where it has one."""
    python = interpreter("joint", CACHE)
    command = [str(python), str(Path(__file__).with_name("peer_joint.py")), str(path), *arguments]
    done = subprocess.run(
        [*command, "--limit", str(limit_s)], capture_output=True, text=True, check=False, env=environment(path.parent)
    )
    if done.returncode:
        raise SystemExit(f"{arguments[0]}: {last_line(done.stderr)}")
    row: Row = json.loads(done.stdout.splitlines()[-1])
    z = np.array(row["z"])
    row["values"], row["std"] = find_figures(z), {}
    if "cov" in row:
        small = 1e-6
        slope = {name: np.zeros(len(z)) for name in FIGURES}
        for i, step in enumerate(small * np.eye(len(z))):
            moved = find_figures(z + step)
            for name in FIGURES:
                slope[name][i] = (moved[name] - row["values"][name]) / small
        row["std"] = {name: float(np.sqrt(one @ np.array(row["cov"]) @ one)) for name, one in slope.items()}
    return row


def find_figures(z: np.ndarray) -> dict[str, float]:
    """Return the figures of a candidate."""
    values = dict(zip(NAMES, np.exp(z), strict=True))
    return {**values, **joint.find_resonances(values)}


def main() -> None:
    """Solve, and print a table in markdown."""
    parser = argparse.ArgumentParser(description="The elastic joint by seaopt and by others.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=float, default=600.0, help="seconds a search may take")
    parser.add_argument("--without-4096", action="store_true", help="leave out the slowest")
    asked = parser.parse_args()
    truth, goal = joint.draw_truth(asked.seed), joint.sweep()
    angles = joint.simulate(truth, goal)[:, :, 0]
    log = joint.record(goal, angles, asked.seed)
    known = {**truth, **joint.find_resonances(truth)}
    start = [*joint.START.values(), 1.0 / joint.RATE_HZ]
    rows = {"seaopt": solve_ours(log, True), "seaopt, without diagnostics": solve_ours(log, False)}
    with tempfile.TemporaryDirectory(prefix="seaopt-joint-") as scratch:
        path = Path(scratch) / "log.json"
        content = {
            "names": NAMES, "start": start, "known": {**joint.KNOWN, **joint.GAINS}, "goal": goal.tolist(),
            "theta_m": log["theta_m"].tolist(), "sigma": joint.STEP["theta_m"] / 12**0.5, "period": 1.0 / joint.RATE_HZ,
        }  # fmt: skip
        path.write_text(json.dumps(content))
        for name, arguments in PEERS.items():
            if "4096" in name and asked.without_4096:
                continue
            print(f"{time.strftime('%H:%M:%S')} {name}", file=sys.stderr)
            rows[name] = solve_peer(path, arguments, asked.limit)
    print("| | seconds | of processor time | x seaopt | simulations | " + " | ".join(FIGURES) + " | remark |")
    print("|---" * (6 + len(FIGURES)) + "|")
    for name, row in rows.items():
        cells = [name, f"{row['wall_s']:.2f}", f"{row['cpu_s']:.2f}", f"{row['wall_s'] / rows['seaopt']['wall_s']:.1f}"]
        cells.append(str(row["simulations"] or "–"))
        for figure in FIGURES:
            error = 100 * (row["values"][figure] / known[figure] - 1)
            std = row["std"].get(figure)
            cells.append(f"{error:+.3f} %" + ("" if std is None else f" ± {100 * std / known[figure]:.3f}"))
        print("| " + " | ".join([*cells, row["note"]]) + " |")


if __name__ == "__main__":
    main()
