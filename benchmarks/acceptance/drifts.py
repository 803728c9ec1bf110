"""Drifts of a reading, of an encoder beside it and of the drive, on right machines: found, and of which sensor.

    python benchmarks/acceptance/drifts.py SEED [COUNT]

Logs of the stand of tests/machine/machine.c without and with dry friction, with noise of 2 to 4 N about a mean of zero,
and of 0.1 to 4 N about one of up to 300 N. What drifts does so by 2 to 60 N, in either direction, evenly or at once.
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import seaopt as so  # noqa: E402
from seaopt.machine.differences.drift import find_drifts  # noqa: E402
from seaopt.machine.ticks import take_ticks  # noqa: E402
from seaopt.simulation.native import find_compiler  # noqa: E402
from tests.machine.conftest import FRICTION, SPEC, make_dry  # noqa: E402
from tests.machine.simulator import Bench, multisine  # noqa: E402
from tests.machine.test_drift import PERIOD, RIGHT, with_encoder  # noqa: E402
from tests.machine.test_response import LINES  # noqa: E402

SAID = {True: "of the reading", None: "open", False: "not of the reading"}


def record(bench, reference, machine, size, at, noise, seed):
    """Yield logs by what drifts in them."""
    time = np.arange(reference.size)
    given = {"noise": noise, "seed": seed}
    right = bench.log(machine, reference, **given)
    yield "nothing", with_encoder(right, right["F1"], machine.stiffness)
    for kind, off in (("creeps", size * time / time.size), ("jumps", size * (time > at * time.size))):
        yield f"encoder {kind}", with_encoder(right, right["F1"] + off, machine.stiffness)
        log = bench.log(machine, reference, drift=off, **given)
        yield f"reading {kind}", with_encoder(log, log["F1"] - off, machine.stiffness)
        yield f"reading {kind}, no encoder", log
    driven = replace(machine, drive_drift=size * PERIOD / time.size / machine.per_ampere)
    log = bench.log(driven, reference, **given)
    yield "drive creeps", with_encoder(log, log["F1"], machine.stiffness)


def draw(rng, dry, small):
    """Return a right machine, the size of what drifts, when it jumps, and the noise."""
    eta, damping, stiffness, friction = *rng.uniform(0.8, 1.2, 3), FRICTION * rng.uniform(0.5, 1.5) * dry
    machine = replace(
        RIGHT, per_ampere=eta * RIGHT.per_ampere, damping=damping * RIGHT.damping,
        stiffness=stiffness * RIGHT.stiffness, coulomb=friction, smoothing=5e-3,
    )  # fmt: skip
    size = rng.choice([-1.0, 1.0]) * np.exp(rng.uniform(np.log(2.0), np.log(60.0)))
    return machine, size, rng.uniform(0.3, 0.8), rng.uniform(2.0 if small else 0.1, 4.0)


def main():
    first, count = int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 40
    compiler = find_compiler()
    loose = Bench(compiler, tempfile.mkdtemp(), so.tune(so.plants.high_impedance(), so.plants.thor(), SPEC))
    rough, played = make_dry(compiler, Path(tempfile.mkdtemp()), periods=4)
    for dry, small in ((False, True), (False, False), (True, True), (True, False)):
        rng, tally, bench = np.random.default_rng(first), dict[str, Counter](), rough if dry else loose
        for seed in range(count):
            bias, periods = 0.0 if small else rng.uniform(-300.0, 300.0), int(rng.integers(4, 14))
            waves = multisine(PERIOD, LINES, periods, rng.uniform(20.0, 80.0), seed, bias=bias)
            reference = played * rng.uniform(0.1, 1.0) if dry else waves
            for name, log in record(bench, reference, *draw(rng, dry, small), [first, seed]):
                said = {each.of_reading for each in find_drifts(bench.controller, [take_ticks(bench.controller, log)])}
                word = next((text for key, text in SAID.items() if key in said), "none")
                tally.setdefault(name, Counter())[word] += 1
        for name, counts in tally.items():
            print("dry" if dry else "free", "small" if small else "any", name, dict(counts), flush=True)


if __name__ == "__main__":
    main()
