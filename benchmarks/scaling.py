"""How time and memory grow with what is given: `python benchmarks/scaling.py [--out FILE.json] [--only WORD]`.

Each size is a process of its own, forked after the imports: one call to compile and fill caches, then one that counts:
its processor time, children included, and its peak memory above what the process held before. An exponent is the slope
of log time over log size between the two largest sizes, of memory likewise where it is above 10 MB.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy

import numpy as np
from bench_fleet import PROBLEM, Here

import seaopt as so
from seaopt.bench import PAPER_STAND
from seaopt.robustness import batch_figures

STAND, SWING, THOR = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
START = THOR.update(J=2e-6, b_r=3e-4).free("J", "b_r")
SENSORS = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0})
SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_complementary=1.3)
Call = Callable[[], Any]


def record(samples: int, seed: int = 1, params: so.ParameterSet = THOR) -> so.Log:
    """Return a log of the stand."""
    return so.virtual_log(STAND, params, PAPER_STAND, duration_s=samples / 400, rate_hz=400, seed=seed, sensors=SENSORS)


def fit_stand(log: so.Log, **options: Any) -> Call:
    """Return a fit of two parameters."""
    experiment = so.Experiment(plant=STAND, log=log, outputs=("F1", "F2"), **options)
    return lambda: so.fit([experiment], START)


def fit_rubbing(samples: int) -> Call:
    """Return a fit with Coulomb friction."""
    truth = THOR.update(f_c=60.0, v_s=5e-3)
    experiment = so.Experiment(plant=STAND, log=record(samples, params=truth), outputs=("F1", "F2"))
    return lambda: so.fit([experiment], truth.update(J=2e-6, f_c=20.0).free("J", "b_r", "f_c"))


def fit_chain(states: int, free: int) -> Call:
    """Return a fit of a chain of masses to the last one's position, with some of its springs free."""
    count = states // 2
    pairs = [(f"x{i}", f"v{i}") for i in range(count)]

    def rates(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        at = [0.0, *(getattr(x, name) for name, _ in pairs)]
        pulls = [getattr(p, f"k{i}") * (at[i + 1] - at[i]) for i in range(count)]
        pulls.append(u.F)
        moves = {}
        for i, (place, speed) in enumerate(pairs):
            moves[place] = getattr(x, speed)
            moves[speed] = pulls[i + 1] - pulls[i] - p.c * getattr(x, speed)
        return moves

    plant = so.Plant(
        name="chain",
        states={name: unit for pair in pairs for name, unit in zip(pair, ("m", "m/s"), strict=True)},
        inputs={"F": "N"}, outputs={name: "m" for name, _ in pairs},
        parameters={"c": "1/s", **{f"k{i}": "1/s^2" for i in range(count)}},
        f=rates, h=lambda t, x, u, p: {name: getattr(x, name) for name, _ in pairs},
    )  # fmt: skip
    truth = so.ParameterSet.of(c=(2.0, "1/s"), **{f"k{i}": (2000.0, "1/s^2") for i in range(count)})
    rng, t = np.random.default_rng(0), np.arange(10_000) / 400
    run = so.simulate(plant, truth, so.Log.from_arrays(time=t, F=rng.normal(size=t.size)))
    outputs = {name: run[name] + 1e-6 * rng.normal(size=t.size) for name, _ in pairs}
    log = so.Log.from_arrays(time=t, F=run["F"], **outputs)
    names = [f"k{i}" for i in range(free)]
    experiment = so.Experiment(plant=plant, log=log, outputs=(pairs[-1][0],))
    start = truth.update(**dict.fromkeys(names, 2100.0)).free(*names)
    return lambda: so.fit([experiment], start)


def fit_logs(count: int) -> Call:
    """Return one fit of many logs."""
    experiments = [
        so.Experiment(plant=STAND, log=record(2000, seed=k), name=f"log{k}", outputs=("F1", "F2")) for k in range(count)
    ]
    return lambda: so.fit(experiments, START)


def tune_for(plants: int) -> Call:
    """Return a tuning for the stand and so many plants with the output free."""
    others = {f"swing{k}": (SWING, THOR.update(I_p=0.2 + 0.4 * k / plants)) for k in range(plants)}
    return lambda: so.tune(STAND, THOR, SPEC, others)


def judge_draws(count: int) -> Call:
    """Return the figures of so many draws."""
    law = so.tune(STAND, THOR, SPEC)
    draws = {"J": 3.31e-6 * np.random.default_rng(0).uniform(0.8, 1.2, count)}
    return lambda: batch_figures(law, STAND, THOR, draws)


def certify_draws(count: int) -> Call:
    """Return a certificate with so many draws, steps not simulated."""
    law = so.tune(STAND, THOR, SPEC)
    return lambda: so.certify(
        law, {"stand": STAND}, THOR, ranges={"J": (3e-6, 3.6e-6)}, samples=count, simulations=False
    )


def fit_many(count: int) -> Call:
    """Return the fits of a fleet in this process."""
    folder = Path(tempfile.mkdtemp(prefix="scaling-"))
    (folder / "stand.toml").write_text(PROBLEM)
    for k in range(count):
        so.write_log(record(2000, seed=k), folder / f"{k:07d}.csv")
    return lambda: so.fit_fleet(folder / "stand.toml", sorted(folder.glob("*.csv")), executor=Here())


CASES: dict[str, tuple[tuple[int, ...], Callable[[int], Call]]] = {
    "fit over samples": ((20_000, 80_000, 320_000, 1_280_000), lambda n: fit_stand(record(n))),
    "friction fit over samples": ((4000, 16_000, 64_000), fit_rubbing),
    "fit over states": ((4, 8, 16, 32), lambda n: fit_chain(n, 2)),
    "fit over free parameters": ((2, 4, 8, 16), lambda n: fit_chain(32, n)),
    "fit over segments": ((4, 16, 64, 256), lambda n: fit_stand(record(40_000), shots=n)),
    "fit over logs": ((4, 16, 64, 128), fit_logs),
    "tune over plants": ((1, 4, 16), tune_for),
    "figures over draws": ((1000, 10_000, 100_000), judge_draws),
    "certificate over draws": ((1000, 4000, 16_000), certify_draws),
    "fleet over logs": ((4, 16, 64), fit_many),
}


def read_memory(field: str) -> float:
    """Return a figure of this process's memory, MB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1e3 for line in lines if line.startswith(field))


def measure(name: str, size: int, out: Any) -> None:
    """Put the time and the memory of a case on a queue."""
    call = CASES[name][1](size)
    call()
    held = read_memory("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")
    spent = lambda: time.process_time() + sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])  # noqa: E731
    began = spent()
    call()
    out.put({"size": size, "s": spent() - began, "MB": max(read_memory("VmHWM") - held, 0.0)})


def find_exponents(rows: list[dict[str, float]]) -> dict[str, float | None]:
    """Return the slopes between the two largest sizes; none of memory that stays small."""
    last, end = rows[-2:]
    grown = np.log(end["size"] / last["size"])
    slope = lambda key: float(np.log(end[key] / last[key]) / grown)  # noqa: E731
    return {"time": slope("s"), "memory": slope("MB") if end["MB"] > 10.0 and last["MB"] > 1.0 else None}


def draw(found: dict[str, Any], path: Path) -> None:
    """Draw time and memory over size, each beside the line of proportion."""
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams |= {"svg.fonttype": "none", "svg.hashsalt": "scaling"}
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained")
    for axis, key, what in ((axes[0], "s", "time"), (axes[1], "MB", "memory")):
        for name, case in found.items():
            rows, exponent = case["rows"], case["exponents"][what]
            if exponent is None:
                continue
            least = rows[-1]["size"]
            axis.loglog(
                [row["size"] / least for row in rows], [row[key] for row in rows], ".-", label=f"{name}: {exponent:.2f}"
            )
        axis.set(xlabel="size, of the largest", ylabel={"s": "processor time, s", "MB": "peak memory, MB"}[key])
        axis.set_title(f"{what}, with its exponent between the two largest sizes")
        axis.legend(fontsize=7)
    figure.savefig(path)


def main() -> None:
    """Measure, print, write and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/scaling.json"))
    parser.add_argument("--only", default="", help="cases whose name contains this")
    options = parser.parse_args()
    context, found = multiprocessing.get_context("fork"), {}
    for name, (sizes, _) in CASES.items():
        if options.only not in name:
            continue
        rows = []
        for size in sizes:
            queue = context.Queue()
            child = context.Process(target=measure, args=(name, size, queue))
            child.start()
            rows.append(queue.get())
            child.join()
        found[name] = {"rows": rows, "exponents": find_exponents(rows)}
        exponents = found[name]["exponents"]
        memory = "-" if exponents["memory"] is None else f"{exponents['memory']:.2f}"
        grown = "; ".join(f"{row['size']:,}: {row['s']:.3g} s, {row['MB']:.0f} MB" for row in rows)
        print(f"{name:28s} time {exponents['time']:5.2f}  memory {memory:>5s}   {grown}", flush=True)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    draw(found, options.out.with_suffix(".svg"))


if __name__ == "__main__":
    main()
