"""Random actuators with friction, tuned and certified: do those that pass do what their certificate says?

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.bench_friction [N] [FILE]

N actuators (1,000 if left out) are drawn, tuned at a random bandwidth with the default limits and a noise gain of 25,
and certified, in two processes. FILE keeps a line of JSON per actuator, so that a run that was stopped goes on where
it was. Those that are certified are then simulated by `tests.stick_slip`, which shares no code with the product: steps
of 0.5 to 80 % of the force that the current holds and of 0.2 to 20 times the friction, as far as they do not saturate,
on smoothed friction as declared and on Coulomb's jump. A step overshoots if its largest force, between samples too, is
above 1.1 times the reference peak allowed; it rings if the force turns three times or more in the last third, by more
than a tenth of the step. On Coulomb's jump a step that is smaller than the friction may wait long until the integral
lets go: what is still a tenth off in the end is counted apart, as late.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

import seaopt as so
from seaopt.errors import SeaoptError
from tests.stick_slip import Mass, simulate

PEAK, GRACE = 1.3, 1.1
RINGING, TURNS = 0.1, 3
SHARES = (0.005, 0.02, 0.1, 0.3, 0.5, 0.8)
FRICTIONS = (0.2, 0.5, 1.0, 2.0, 5.0, 20.0)
SAMPLES = 1500
BATCH = 300  # runs simulated at once
PROCESSES = 2


def draw(number: int) -> tuple[dict[str, float], dict[str, Any]]:
    """Return the parameters of an actuator, and what is asked of its controller."""
    rng = np.random.default_rng([14, number])

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    lead, gear, torque = between(1e-3, 1e-2), between(1.0, 5.0), between(0.02, 0.1)
    r = lead / (2 * math.pi * gear)
    mass, stiffness = between(3.0, 200.0), between(5e4, 2e6)
    load = mass * between(0.003, 0.1)
    damping = 2 * between(0.02, 0.6) * math.sqrt(stiffness * (mass + load))
    held = between(300.0, 5000.0)
    efficiency = float(rng.uniform(0.6, 1.0))
    friction = held * between(2e-3, 0.1)
    params = {
        "m_l": load, "k": stiffness, "l": lead, "N_p": gear, "K_tau": torque, "J": mass * r**2, "b_r": damping * r**2,
        "eta": efficiency, "f_c": friction, "v_s": between(3e-4, 1e-2),
    }  # fmt: skip
    spec = {
        "bandwidth_hz": float(rng.uniform(8.0, 40.0)), "delay_samples": int(rng.integers(1, 4)), "max_noise_gain": 25.0,
        "current_limit_A": held * r / (efficiency * torque), "max_reference_peak": PEAK,
    }  # fmt: skip
    return params, spec


def examine(number: int) -> dict[str, Any]:
    """Tune and certify one actuator."""
    values, asked = draw(number)
    stand, params = so.plants.high_impedance(), so.plants.thor().update(**values)
    out: dict[str, Any] = {"number": number, "feasible": False, "certified": False}
    begin, used = time.perf_counter(), time.process_time()
    try:
        controller = so.tune(stand, params, so.ControllerSpec(**asked, bandwidth_range_hz=(5.0, 60.0)))
        out |= {"feasible": controller.feasible, "tune_s": time.perf_counter() - begin, "law": controller.to_dict()}
        out["per_effort"] = controller.command.per_effort
        begin = time.perf_counter()
        if controller.feasible:
            certificate = so.certify(controller, {"stand": stand}, params, simulations=False)
            out |= {
                "certified": certificate.passed, "certify_s": time.perf_counter() - begin,
                "broken": [row.name for row in certificate.requirements if not row.met],
                "proved": all(margin.shown for margin in certificate.friction.values()),
            }  # fmt: skip
        else:
            out["broken"] = list(controller.active_constraints)
    except SeaoptError as error:
        out["error"] = f"{type(error).__name__}: {error}"
    out["processor_s"] = time.process_time() - used
    return json.loads(json.dumps(out, default=lambda value: value.tolist()))


def count_turns(signal: np.ndarray, size: float) -> int:
    """Return how often a signal turns, by more than a size."""
    turns, direction, extreme = 0, 0, signal[0]
    for value in signal:
        if direction * (value - extreme) > 0 or (direction == 0 and abs(value - signal[0]) > size):
            direction, extreme = direction or int(np.sign(value - signal[0])), value
        elif direction and abs(value - extreme) > size:
            turns, direction, extreme = turns + 1, -direction, value
    return turns


def simulate_steps(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Simulate the steps of every certified actuator that do not saturate; return what went wrong."""
    masses, laws, steps, numbers, limits = [], [], [], [], []
    for row in rows:
        values, asked = draw(row["number"])
        held = asked["current_limit_A"] / row["per_effort"]
        for step in (*(share * held for share in SHARES), *(times * values["f_c"] for times in FRICTIONS)):
            masses.append(values)
            laws.append(row["law"])
            steps.append(step)
            numbers.append(row["number"])
            limits.append(held)
    step, limit, number = np.array(steps), np.array(limits), np.array(numbers)
    found: dict[str, Any] = {}
    for kind, jump in (("smoothed friction", False), ("Coulomb's jump", True)):
        over, ringing, late, effort = (np.zeros(step.size) for _ in range(4))
        for first in range(0, step.size, BATCH):
            some = slice(first, first + BATCH)
            runs = simulate(
                [Mass.of(values, jump=jump) for values in masses[some]], laws[some],
                np.repeat(step[some, None], SAMPLES, axis=1), substeps=20,
            )  # fmt: skip
            over[some], late[some] = runs.overshoot(step[some]), np.abs(runs.force[:, -1] / step[some] - 1.0)
            last = runs.force[:, -SAMPLES // 3 :] / step[some, None]
            ringing[some] = [count_turns(force, RINGING) for force in last]
            effort[some] = np.max(np.abs(runs.effort), axis=1)
        judged = effort <= limit
        beyond, rings = judged & (1.0 + over > GRACE * PEAK), judged & (ringing >= TURNS)
        found[kind] = {
            "steps judged": int(np.count_nonzero(judged)),
            "actuators that overshoot": sorted(set(number[beyond].tolist())),
            "actuators that ring": sorted(set(number[rings].tolist())),
            "actuators with a late step": len(set(number[judged & (late > RINGING)].tolist())),
            "largest overshoot": float(np.max(over[judged], initial=0.0)),
        }
    return found


def main(count: int, file: Path | None) -> None:
    done = [json.loads(line) for line in file.read_text().splitlines()] if file is not None and file.exists() else []
    known = {row["number"] for row in done}
    with ProcessPoolExecutor(PROCESSES) as pool:
        for row in pool.map(examine, [number for number in range(count) if number not in known]):
            done.append(row)
            if file is not None:
                with file.open("a") as out:
                    out.write(json.dumps(row) + "\n")
    done = [row for row in done if row["number"] < count]
    certified = [row for row in done if row["certified"]]
    refused = Counter(name for row in done if row["feasible"] and not row["certified"] for name in row["broken"])
    blocked = Counter(name.split(" (")[0] for row in done if not row["feasible"] for name in row.get("broken", ()))
    print(f"{len(done)} actuators: {sum(row['feasible'] for row in done)} feasible, {len(certified)} certified")
    print(f"  not feasible because of {dict(blocked)}; errors {Counter(row.get('error', '') for row in done)}")
    print(f"  feasible and not certified because of {dict(refused)}")
    print(f"  stability proved for the friction of {sum(row['proved'] for row in certified)} of those certified")
    for name in ("tune_s", "certify_s", "processor_s"):
        times = [row[name] for row in done if name in row]
        if times:
            print(f"  {name}: mean {np.mean(times):.2f}, median {np.median(times):.2f}, largest {max(times):.1f}")
    if certified:
        used = time.process_time()
        for kind, figures in simulate_steps(certified).items():
            print(f"{kind}: {figures}")
        each = (time.process_time() - used) / len(certified)
        print(f"  simulated with {each:.2f} s of processor time per actuator")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000, Path(sys.argv[2]) if len(sys.argv) > 2 else None)
