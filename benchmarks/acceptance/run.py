"""Acceptance on machines with faults: accepted rightly, found, named; coverage of the discs. `--seeds N` of each.

    python benchmarks/acceptance/run.py --seeds 5 [-o FILE.json]

The machines are those of tests/machine/machine.c, which shares no equation with seaopt, under the exported C. The law
is the THOR stand's at 30 Hz; each seed draws the machine within the certificate's uncertainty, noise, phases and the
resolution of the log.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import seaopt as so  # noqa: E402
from seaopt.control import Gains  # noqa: E402
from seaopt.simulation.native import find_compiler  # noqa: E402
from tests.machine.simulator import Bench, Machine  # noqa: E402

STAND, THOR = so.plants.high_impedance(), so.plants.thor()
SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=45, current_limit_A=9.0)
RANGES = {"eta": (0.97, 1.0), "b_r": (1.2e-4, 1.4e-4)}
NOMINAL = THOR.update(eta=0.985)


def make_benches(folder):
    """Return the benches of the law, of one without feedforward, and of another controller.json."""
    law = so.tune(STAND, NOMINAL, SPEC)
    slower = so.tune(STAND, NOMINAL, replace(SPEC, bandwidth_hz=22.0))
    gains = Gains(**{name: law.gains[name] for name in ("k_p", "k_i", "k_d", "T_f", "c")}, k_r=law.gains["k_p"])
    bare = replace(
        law, law=gains.law("pid", 1e-3).balanced(), structure="custom", gains={}, spec=replace(SPEC, structure="custom")
    )
    laws = {"law": law, "bare": bare, "slower": slower}
    return {name: Bench(find_compiler(), folder, each, name) for name, each in laws.items()}, law, slower


def list_faults(machine):
    """Return by name: the bench, the machine, the log's clock, and what the first cause or difference must be."""
    harder = replace(machine, damping=2.0 * machine.damping)
    lower = replace(machine, stiffness=0.8 * machine.stiffness)
    weaker = replace(machine, per_ampere=0.85 * machine.per_ampere)
    return {
        "none": ("law", machine, None, ()),
        "wrong rate": ("law", machine, 2e-3, (("rate", "clock"),)),
        "one tick late": ("law", replace(machine, late=2.0), None, (("delay", "delay"),)),
        "gain halved": ("law", replace(machine, law_gain=0.5), None, (("factor", "I"),)),
        "eta 15 % low": ("law", weaker, None, (("parameter", "eta"), ("parameter", "K_tau"), ("gain", "gain"))),
        "delay 2 ms more": ("law", replace(machine, delay_s=2e-3), None, (("delay", "delay"),)),
        "mode at 40 Hz": ("law", machine.with_mode(40.0), None, (("mode", "mode"),)),
        "friction doubled": ("law", harder, None, (("parameter", "b_r"),)),
        "spring 20 % softer": ("law", lower, None, (("parameter", "k"),)),
        "sign": ("law", replace(machine, reading_sign=-1.0), None, (("sign", "F1"),)),
        "saturated sensor": ("law", replace(machine, sensor_range=240.0), None, (("range", "F1"),)),
        "missing feedforward": ("bare", machine, None, (("feedforward", "reference"),)),
        "another controller": ("slower", machine, None, (("another law", "old/controller.json"),)),
    }  # fmt: skip


def draw_machine(rng):
    """Return a machine within what was certified."""
    nominal, eta = Machine(), rng.uniform(*RANGES["eta"])
    damping = nominal.damping * rng.uniform(*RANGES["b_r"]) / 1.31e-4
    return replace(nominal, per_ampere=nominal.per_ampere * eta, damping=damping)


def judge(bench, law, slower, machine, period, reference, rng):
    """Return the acceptance of a run, and its first name."""
    decimals = int(rng.integers(1, 4)) if rng.uniform() < 0.5 else None
    log = bench.log(machine, reference, noise=rng.uniform(0.5, 2.0), seed=int(rng.integers(1 << 30)), period=period,
                    decimals=decimals)  # fmt: skip
    start = float(rng.uniform(0.0, 0.5))
    log = log.between(start, float(log.time[-1]))
    result = so.accept(law, [log], others={"old/controller.json": slower}, uncertainty=NOMINAL, ranges=RANGES)
    causes = [cause for row in result.replays for cause in row.causes]
    found = [] if result.differences is None else list(result.differences.found)
    first = causes[0] if causes else found[0] if found else None
    names = () if first is None else (first.kind, first.what if causes else first.name)
    alike = [] if causes or not found else [(found[0].kind, name) for name in found[0].alike]
    return result, [names, *alike]


def cover(result, bench, machine):
    """Return how many discs at 95 % hold the loop of the machine's own equations, and how many there are."""
    from tests.machine.test_response import respond

    held = count = 0
    for part in result.response.measured:
        truth = respond(machine, part.f, bench.controller, 1)[0]
        centre, radius = part.loop.disc(0.05)
        held, count = held + int(np.sum(np.abs(centre - truth) <= radius)), count + truth.size
    return held, count


def find_broken(result, bench, machine):
    """Return the limits, as judged, that were refuted though the machine's own equations keep them."""
    from tests.machine.test_response import respond

    f = np.geomspace(0.3, 300.0, 4000)
    loop, tracking = respond(machine, f, bench.controller, 1)
    truth = {
        "Ms": np.max(1.0 / np.abs(1.0 + loop)), "Mt": np.max(np.abs(loop / (1.0 + loop))),
        "reference peak": np.max(np.abs(tracking)), "stability": 2.0,
        "bandwidth": f[np.flatnonzero(np.abs(tracking) < np.sqrt(0.5))[0]],
    }  # fmt: skip
    rows = [row for row in result.response.judged if row.outcome == "refuted" and row.limit is not None]
    keeps = {
        row.name: truth[row.name] <= row.limit if row.sense == "at most" else truth[row.name] >= row.limit
        for row in rows
    }
    return [name for name, kept in keeps.items() if kept]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", nargs="*", default=None)
    parser.add_argument("-o", "--output", type=Path, default=None)
    options = parser.parse_args()
    benches, law, slower = make_benches(tempfile.mkdtemp())
    plan = so.bring_up(law, {"stand": STAND}, NOMINAL, ranges=RANGES, samples=20, fractions=(), limits={"F1": 600.0})
    table, held, count, broken, judged, start = {}, 0, 0, 0, 0, time.process_time()
    for name in list_faults(Machine()):
        if options.only and name not in options.only:
            continue
        found = named = 0
        others = []
        for seed in range(options.seeds):
            rng = np.random.default_rng([seed, 7])
            machine = draw_machine(rng)
            key, faulty, period, expected = list_faults(machine)[name]
            reference = plan.stages[-1].excitation.reference
            result, names = judge(benches[key], law, slower, faulty, period, reference, rng)
            found += not result.met
            named += any(each in expected for each in names)
            if expected and not any(each in expected for each in names):
                others.append(str(names[0]))
            if not expected and not result.met:
                others.append(repr(result))
            linear = name in ("none", "eta 15 % low", "friction doubled", "spring 20 % softer")
            if linear and result.response is not None:
                a, b = cover(result, benches[key], faulty)
                held, count = held + a, count + b
                broken, judged = broken + len(find_broken(result, benches[key], faulty)), judged + 5
        table[name] = {"found": found, "named": named, "of": options.seeds, "otherwise": others}
        print(f"{name:22s} found {found:3d}/{options.seeds}  named {named:3d}/{options.seeds}  {others}", flush=True)
    if count:
        wrongly = f"{broken} of {judged} rows refuted wrongly"
        print(f"discs at 95 %: {100.0 * held / count:.1f} % of {count} hold the truth; {wrongly}")
    print(f"{time.process_time() - start:.0f} s of processor time")
    if options.output is not None:
        options.output.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
