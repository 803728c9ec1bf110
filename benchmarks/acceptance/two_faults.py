"""Two faults at once: how often the intervals that are stated hold the truth. `--seeds N` of each combination.

    python benchmarks/acceptance/two_faults.py --seeds 20 [--on stand knee] [--first 100] [--only NAME ...]

The subjects, their machines and logs are those of run.py. Counted are the first of the causes that are listed, and what
is named beside it; not so where it is named as alike to what is off in its place.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from run import SUBJECTS, record  # sets the path

import seaopt as so

MODE_HZ = 40.0
# factors of a machine's numbers, delay in s, a mode
COMBINATIONS = {
    "friction 20 %, delay 1 ms": {"friction": 1.2, "delay_s": 1e-3},
    "friction 50 %, delay 0.3 ms": {"friction": 1.5, "delay_s": 3e-4},
    "gain -10 %, delay 1 ms": {"gain": 0.9, "delay_s": 1e-3},
    "gain -5 %, delay 0.3 ms": {"gain": 0.95, "delay_s": 3e-4},
    "inertia 20 %, friction 20 %": {"inertia": 1.2, "friction": 1.2},
    "inertia 10 %, friction 50 %": {"inertia": 1.1, "friction": 1.5},
    "mode at 40 Hz, gain -10 %": {"gain": 0.9, "mode": 0.15},
    "mode at 40 Hz, gain -30 %": {"gain": 0.7, "mode": 0.15},
    "spring -10 %, delay 0.5 ms": {"spring": 0.9, "delay_s": 5e-4},
}


def apply(subject, drawn, faults):
    """Return a machine with faults, and the truth by the names under which it is stated."""
    machine, nominal = drawn, subject.machine
    rotor = nominal.mass - (subject.nominal["m_l"].value if "m_l" in subject.nominal else 0.0)
    inertia, friction = faults.get("inertia", 1.0), faults.get("friction", 1.0)
    machine = replace(
        machine,
        mass=machine.mass + (inertia - 1.0) * rotor,
        damping=machine.damping * friction,
        coulomb=machine.coulomb * friction,
        stiffness=machine.stiffness * faults.get("spring", 1.0),
        per_ampere=machine.per_ampere * faults.get("gain", 1.0),
        delay_s=faults.get("delay_s", 0.0),
    )
    gain, damping = machine.per_ampere / nominal.per_ampere, machine.damping / nominal.damping
    inertial = "J" if "J" in subject.nominal else "J_m"
    truth = dict.fromkeys(subject.plant.complete(subject.nominal), 1.0) | {
        "eta": gain, "K_tau": gain, "gain": gain, subject.names["damping"]: damping, inertial: inertia,
        subject.names["stiffness"]: faults.get("spring", 1.0), "delay": machine.delay_s,
        "mode": MODE_HZ if "mode" in faults else np.inf,
    }  # fmt: skip
    if "coulomb" in subject.names:
        truth[subject.names["coulomb"]] = machine.coulomb / nominal.coulomb
    if "mode" in faults:
        machine = machine.with_mode(MODE_HZ, faults["mode"])
    return machine, truth


def judge(stated, parts, truth):
    """Return whether the interval of one of some parts holds the truth; None where none is stated, or another of those
    that are named as alike is off.
    """
    if stated.low is None or stated.high is None:
        return None
    off = {name for name, value in truth.items() if value != {"delay": 0.0, "mode": np.inf}.get(name, 1.0)}
    if not {part.name for part in parts} <= off and any(off & {*part.alike} for part in parts):
        return None
    if any(off >= {*names} for names in stated.unless):
        return None
    return stated.low <= truth.get(stated.name, np.nan) <= stated.high


def run_subject(name, options):
    """Print how many intervals hold, by combination."""
    subject, total = SUBJECTS[name](), np.zeros(2, dtype=int)
    for number, (combination, faults) in enumerate(COMBINATIONS.items()):
        if options.only and combination not in options.only:
            continue
        held, said, names, lines = 0, 0, {}, []
        for seed in range(options.first, options.first + options.seeds):
            rng = np.random.default_rng([seed, 11, number])
            machine, truth = apply(subject, subject.draw(rng), faults)
            log = record(subject, subject.benches["law"], machine, None, rng)
            result = so.accept(subject.law, [log], uncertainty=subject.nominal, ranges=subject.ranges)
            found = () if result.differences is None else result.differences.found[:1]
            parts = [part for first in found for part in (first, *first.beside)]
            judged = [judge(part, parts, truth) for part in parts]
            held, said = held + judged.count(True), said + judged.count(True) + judged.count(False)
            key = "+".join(sorted(part.name for part in parts)) or "nothing"
            names[key] = names.get(key, 0) + 1
            for part, holds in zip(parts, judged, strict=True):
                if holds is False or options.verbose:
                    ends = " to ".join("none" if end is None else f"{end:.4g}" for end in (part.low, part.high))
                    lines.append(
                        f"    {seed} {key}: {part.name} {part.value:.4g} ({ends}), true {truth[part.name]:.4g}"
                    )
                    lines[-1] += f" {part.alike} unless {part.unless}, left {found[0].left:.2f}: {holds}"
        total += held, said
        print(f"{name} {combination:28s} {held:3d} of {said:3d} hold; named {names}", flush=True)
        if lines:
            print("\n".join(lines), flush=True)
    print(f"{name}: {total[0]} of {total[1]} intervals hold the truth, {100.0 * total[0] / max(total[1], 1):.1f} %")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--on", nargs="*", default=list(SUBJECTS), choices=list(SUBJECTS))
    parser.add_argument("--only", nargs="*", default=None)
    parser.add_argument("--verbose", action="store_true", help="all intervals, not those alone that miss")
    options = parser.parse_args()
    start = time.process_time()
    for name in options.on:
        run_subject(name, options)
    print(f"{time.process_time() - start:.0f} s of processor time")


if __name__ == "__main__":
    main()
