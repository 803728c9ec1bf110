"""How often a met fit is right where the actuator is not the model: `make truth [ARGS="--fits 60 --seed 7"]`.

Each case is an actuator of `actuators.py` with none, one or two effects that the fitted model lacks. It is fitted as
its user would fit it: friction that sticks (--smooth: none), a free delay, values off by up to a factor of two; to
one log at full amplitude, or (--logs 2) to that and one at half of it. A fit that is not met is made again as it
advises, up to three times: with the parts that `seaopt fit --explain` would add, or with the log at half the
amplitude that it asks for. A fit is *bad* where it is met and has a parameter both 3 % off and outside 4 standard
deviations of its 95 % interval, that of noise and model. Each case runs in a process of its own with a bound on its
processor time; no new ones begin after --minutes of it together. Tables are printed, and with --json FILE every case
is kept; --read FILE... prints the tables of what was kept.
"""

from __future__ import annotations

import argparse
import json
import resource
import signal
import sys
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import scipy.special

sys.path.insert(0, str(Path(__file__).parent))
from actuators import EFFECTS, KINDS, RATE_HZ, Actuator

SEEDS = 1_000_000  # between those of a case's logs
FREE = {True: ("J", "b_r", "k", "f_c", "eta"), False: ("J_m", "b_r", "k_s", "f_c", "eta")}
SILENT = {"efficiency", "stand"}  # what no such log can tell: only words can warn
BAD_SHARE, BAD_STDS, QUANTILE = 0.03, 4.0, 1.959964
AMPLITUDES = (1.0, 0.5)  # of the largest, of the first and the second log
ROUNDS = 3  # of advice that is followed
LEAST = 2e-5  # of a value, which a clock is off by: widths are over that, or over the noise's std
KNOWN = 0.2  # half the width of an interval over its value


def draw_cases(count: int, rng: np.random.Generator, *, locked: bool) -> Iterator[Actuator]:
    """Yield actuators of every kind in turn: a sixth as modelled, half with one effect, a third with two."""
    kinds, effects = list(KINDS), list(EFFECTS)
    for k in range(count):
        kind = kinds[k % len(kinds)]
        link = "pendulum" if kind != "screw" and rng.uniform() < 0.4 and not locked else "locked"
        possible = [name for name in effects if not (name == "stand" and link == "pendulum")]
        number = (0, 1, 1, 1, 2, 2)[k // len(kinds) % 6]
        chosen = rng.choice(possible, size=number, replace=False)
        sizes = {str(name): round(float(rng.uniform(0.6, 1.3)), 3) for name in chosen}
        yield Actuator(kind=kind, link=link, effects=sizes, delay_s=round(float(rng.uniform(0.0003, 0.003)), 5))


def fit_case(actuator: Actuator, seed: int, seconds: float, logs: int, limit_s: float) -> dict[str, Any]:
    """Return what a fit says of an actuator's logs, and what is true, round by round of following its advice."""
    resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time() + limit_s), resource.RLIM_INFINITY))
    import seaopt as so
    from seaopt.problem.explained import find_explanation

    rng, known = np.random.default_rng(seed), actuator.find_truth(seconds=seconds, seed=seed)
    (plant, params, delay), free = pose(actuator, known), list_free(actuator)
    params = params.update(**{name: known[name] * 2.0 ** rng.uniform(-1, 1) for name in free})

    def record(k: int) -> so.Experiment:
        readings = actuator.record(seconds=seconds, amplitude=AMPLITUDES[k], seed=seed + SEEDS * k)
        log = so.Log.from_arrays(**readings).restamp(rate_hz=RATE_HZ)
        outputs = tuple(name for name in readings if name not in ("time", "I"))
        return so.Experiment(plant=plant, log=log, outputs=outputs, delay_s=delay, name=f"log{k}")

    experiments = [record(k) for k in range(logs)]
    rounds, advice = list[dict[str, Any]](), "as it is"
    while True:
        started = time.process_time()
        fit = so.fit(experiments, params)
        rounds.append({"advice": advice, "cpu_s": round(time.process_time() - started, 2)} | describe(fit, known, free))
        if fit.met or len(rounds) > ROUNDS:
            break
        # As `seaopt fit --explain` does; then the log that the verdict asks for.
        found = find_explanation(fit)
        if found is not None:
            advice = f"with {', '.join(found.parts)}"
            for part in found.parts:
                plant = so.plants.add_part(plant, part)
            params = plant.defaults.with_parameters(*params.values())
            params = params.update(**{**found.parameters, **found.fixed}).free(*found.frees)
            experiments = [replace(experiment, plant=plant) for experiment in experiments]
            for i, experiment in enumerate(experiments):
                if hold := found.holds.get(experiment.name):
                    experiments[i] = replace(experiment, log=experiment.log.hold("I", *hold))
        elif better := find_better(fit):
            advice = f"from another {', '.join(better)}"
            params = params.update(**better).free(*better)
        elif len(experiments) == 1 and any(error.kind == "excess" for error in fit.errors):
            advice = "with a log at half the amplitude"
            experiments.append(record(1))
        else:
            break
    return rounds[-1] | {"rounds": rounds, "cpu_s": round(sum(each["cpu_s"] for each in rounds), 2)}


def pose(actuator: Actuator, known: Mapping[str, float]) -> tuple[Any, Any, Any]:
    """Return the plant that is fitted to an actuator, its parameters at what is known, some free, and the delay."""
    import seaopt as so

    linear = KINDS[actuator.kind].linear
    base = so.plants.high_impedance() if linear else so.plants.rotary(link=actuator.link)
    plant = base if actuator.smooth else so.plants.let_stick(base)
    values = {name: value for name, value in known.items() if name in plant.parameters}
    delay = so.Parameter(name="delay", value=1e-3, unit="s", min=0.0, max=0.01, free=True)
    return plant, plant.defaults.update(**values).free(*list_free(actuator)), delay


def list_free(actuator: Actuator) -> tuple[str, ...]:
    """Return the parameters that are fitted."""
    names = FREE[KINDS[actuator.kind].linear]
    return tuple(name for name in names if name != "f_c" or not actuator.smooth)


def find_better(fit: Any) -> dict[str, float]:
    """Return the values that a fit's errors say parameters should have: free ones to start from, or fixed ones."""
    asked = {name: value for error in fit.errors for name, (value, _) in error.preferred.items()}
    return {name: value for name, value in asked.items() if name in fit.parameters}


def describe(fit: Any, known: Mapping[str, float], free: Sequence[str]) -> dict[str, Any]:
    """Return what a fit says of its parameters, beside what is true, and its findings."""
    content = fit.to_dict()
    fitted = content["parameters"]
    return {
        "met": fit.met,
        "status": fit.status,
        "parameters": {
            name: {
                "true": known[name],
                "value": fitted[name]["value"],
                "noise_std": fitted[name]["std"],
                "std": (fitted[name]["ci95"][1] - fitted[name]["ci95"][0]) / (2.0 * QUANTILE),
            }
            for name in free
            if name in known and fitted[name]["std"] is not None
        },
        "excess": max(each.get("excess") or 0.0 for row in content["outputs"].values() for each in row.values()),
        "silent": {effect.part: list(effect.shifts) for effect in fit.silent},
        "findings": [f"{finding.severity} {finding.kind} {finding.where}" for finding in fit.findings],
    }


def run_case(job: tuple[Actuator, int, float, int, float]) -> dict[str, Any]:
    """Return a case's row; what its process did not live to say is a row, too."""
    actuator, seed, *_, limit_s = job
    context = get_context("forkserver")
    context.set_forkserver_preload(["seaopt"])
    row: dict[str, Any] = asdict(actuator) | {"seed": seed}
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send, args=(sender, *job))
    process.start()
    sender.close()
    try:
        return row | receiver.recv()
    except EOFError:
        process.join()
        late = process.exitcode == -signal.SIGXCPU
        return row | _say_failed(f"not done in {limit_s:g} s" if late else f"crashed: exit {process.exitcode}", limit_s)
    finally:
        process.join()


def _send(sender: Any, *job: Any) -> None:
    try:
        row = fit_case(*job)
    except Exception as error:  # a defect of the product or of this benchmark: the other cases go on
        traceback.print_exc()
        row = _say_failed(f"crashed: {type(error).__name__}", time.process_time())
    sender.send(row | {"process_s": time.process_time()})


def _say_failed(status: str, seconds: float) -> dict[str, Any]:
    """Return the row of a case that has no fit."""
    empty: dict[str, Any] = {"parameters": {}, "findings": [], "rounds": [], "silent": {}}
    return empty | {"met": False, "status": status, "cpu_s": seconds, "process_s": seconds}


def find_bad(row: dict[str, Any]) -> set[str]:
    """Return the parameters of a fit that are 3 % off and outside 4 standard deviations."""
    return {
        name
        for name, p in row["parameters"].items()
        if abs(p["value"] / p["true"] - 1) > BAD_SHARE and abs(p["value"] - p["true"]) > BAD_STDS * p["std"]
    }


def is_bad(row: dict[str, Any]) -> bool:
    """Tell whether a fit has such a parameter."""
    return bool(find_bad(row))


def is_named(row: dict[str, Any]) -> bool:
    """Tell whether the verdict says of all of them that no such log tells them."""
    return find_bad(row) <= {name for names in row["silent"].values() for name in names}


def summarise(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield a table of what became of the cases, by what the model lacks."""
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        names = sorted(row["effects"])
        groups["nothing missing" if not names else names[0] if len(names) == 1 else "two effects"].append(row)
        silent = SILENT & set(names)
        groups[
            "= all that a log can show" if names and not silent else "= what no log shows" if silent else "="
        ].append(row)
        groups["= link held" if row["link"] == "locked" else "= pendulum"].append(row)
    groups.pop("=", None)
    yield f"{'missing':26s} fits  met  bad  named  met: in 95 %  all: bad  in 95 %  known  width  not done  median s"
    for name in sorted(groups, key=lambda name: (name.startswith("="), name)):
        group = groups[name]
        met = [row for row in group if row["met"]]
        late = sum(row["status"].startswith("not done") for row in group)
        done = [row for row in group if row["parameters"]]
        known = [all(map(is_known, row["parameters"].values())) for row in done]
        widths = [
            p["std"] / max(p.get("noise_std", p["std"]), LEAST * abs(p["value"]))
            for row in done
            for p in row["parameters"].values()
        ]
        width = f"{np.median(widths):.2f}" if widths else "-"
        yield (
            f"{name:26s} {len(group):4d} {len(met):4d} {sum(map(is_bad, met)):4d} "
            f"{sum(is_bad(row) and is_named(row) for row in met):6d} {cover(met):>12s} "
            f"{sum(map(is_bad, done)):9d} {cover(done):>7s} {sum(known):6d} {width:>6s} {late:9d} "
            f"{np.median([row['cpu_s'] for row in group]):9.1f}"
        )
    shown = [row for row in rows if not SILENT & set(row["effects"]) and row["met"]]
    bad = sum(map(is_bad, shown))
    if bad < len(shown):
        bound = 1.0 - float(scipy.special.betaincinv(len(shown) - bad, bad + 1, 0.05))
        yield f"bad, of what a log can show: {bad} of {len(shown)} met, below {100 * bound:.2g} % at 95 % confidence"
    yield from summarise_rounds(rows)
    yield from summarise_obstacles(rows)


def summarise_rounds(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield how many fits were met after each round of advice, and what the rounds were."""
    yield f"\n{'round':34s} made  met  bad of met  median s"
    for number in range(ROUNDS + 1):
        made = [row["rounds"][number] for row in rows if len(row["rounds"]) > number]
        for advice in sorted({each["advice"] for each in made}):
            group = [each for each in made if each["advice"] == advice]
            met = [each for each in group if each["met"]]
            seconds = np.median([each["cpu_s"] for each in group])
            line = f"{number} {advice:32s} {len(group):4d} {len(met):4d}"
            yield f"{line} {sum(map(is_bad, met)):11d} {seconds:9.1f}"


def summarise_obstacles(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield which errors keep fits from met in the end, alone and with others, and how good those fits are."""
    yield f"\n{'what keeps fits from met':26s} fits  alone  bad if met  all in 95 % and known"
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for row in rows:
        if row["met"]:
            continue
        kinds = {finding.split()[1] for finding in row["findings"] if finding.startswith("error")}
        kinds |= {row["status"]} - {"converged"}
        good = all(is_known(p) and is_inside(p) for p in row["parameters"].values())
        for kind in kinds or {"no error"}:
            counts[kind] += Counter(fits=1, alone=len(kinds) == 1, bad=is_bad(row), good=good)
    for kind, count in sorted(counts.items(), key=lambda pair: -pair[1]["fits"]):
        yield f"{kind:26s} {count['fits']:4d} {count['alone']:6d} {count['bad']:11d} {count['good']:21d}"


def cover(rows: list[dict[str, Any]]) -> str:
    """Return how many of the 95 % intervals hold the truth, in percent."""
    inside = [is_inside(p) for row in rows for p in row["parameters"].values()]
    return f"{100 * np.mean(inside):.0f} %" if inside else "-"


def is_inside(parameter: dict[str, float]) -> bool:
    """Tell whether a 95 % interval holds the truth."""
    return abs(parameter["value"] - parameter["true"]) <= QUANTILE * parameter["std"]


def is_known(parameter: dict[str, float]) -> bool:
    """Tell whether an interval is at most as wide as a verdict allows."""
    return QUANTILE * parameter["std"] <= KNOWN * abs(parameter["value"])


def main() -> None:
    """Run the cases that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fits", type=int, default=90)
    parser.add_argument("--first", type=int, default=0, help="of a seed's cases, that is fitted first")
    parser.add_argument("--minutes", type=float, default=180.0, help="of processor time, after which no case begins")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=15.0, help="length of each log")
    parser.add_argument("--limit", type=float, default=60.0, help="processor time of a fit, s")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--exact", action="store_true", help="nothing is missing from any model")
    parser.add_argument("--smooth", action="store_true", help="with --exact: no dry friction, and none is fitted")
    parser.add_argument("--logs", type=int, default=1, choices=(1, 2), help="2: a second one at half the amplitude")
    parser.add_argument("--locked", action="store_true", help="links held: no pendulums, whose fits take long")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--read", type=Path, nargs="*", help="print the table of kept cases, and run none")
    options = parser.parse_args()
    if options.smooth and not options.exact:
        parser.error("--smooth needs --exact: several effects are of dry friction")
    if options.read:
        kept = [row for file in options.read for row in json.loads(file.read_text())]
        print("\n".join(summarise(kept)))
        return
    cases = list(draw_cases(options.first + options.fits, np.random.default_rng(options.seed), locked=options.locked))
    if options.exact:
        cases = [replace(case, effects={}) for case in cases]
    cases = [replace(case, smooth=options.smooth) for case in cases]
    jobs = [
        (case, 1000 * options.seed + k, options.seconds, options.logs, options.limit) for k, case in enumerate(cases)
    ][options.first :]
    rows: list[dict[str, Any]] = []

    def run(job: tuple[Actuator, int, float, int, float]) -> dict[str, Any] | None:
        return None if sum(row["process_s"] for row in rows) > 60.0 * options.minutes else run_case(job)

    with ThreadPoolExecutor(options.workers) as pool:
        for row in pool.map(run, jobs):
            if row is None:
                break
            rows.append(row)
            effects = ", ".join(row["effects"]) or "nothing missing"
            errors = {finding.split()[1] for finding in row["findings"] if finding.startswith("error")}
            verdict = "BAD" if row["met"] and is_bad(row) else "met" if row["met"] else row["status"]
            end = f"{verdict} {', '.join(sorted(errors))} [{'; '.join(r['advice'] for r in row['rounds'][1:])}]"
            number = options.first + len(rows)
            print(
                f"{number:4d} {row['kind']:7s} {row['link']:9s} {effects:30s} {row['cpu_s']:6.1f} s  {end}", flush=True
            )
            if options.json:
                options.json.write_text(json.dumps(rows, indent=1))
    print("\n".join(summarise(rows)))


if __name__ == "__main__":
    main()
