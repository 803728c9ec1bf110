"""Acceptance on machines with faults: accepted rightly, found, named; coverage of the discs. `--seeds N` of each.

    python benchmarks/acceptance/run.py --seeds 5 [--on stand knee] [--first 100] [--only FAULT ...] [-o FILE.json]
    python benchmarks/acceptance/run.py --discs --seeds 60    the discs alone, of the plant whose equations are linear

The machines are those of tests/machine/machine.c, which shares no equation with seaopt, under the exported C: the THOR
stand with a pid at 30 Hz, and a rotary knee with dry friction at 20 Hz under a pid whose disturbance observer is all
that integrates. Each seed draws the machine within the certificate's uncertainty, noise, phases and the resolution of
the log, for each fault anew.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import seaopt as so  # noqa: E402
from seaopt.control import Gains  # noqa: E402
from seaopt.machine.response.periods import cut_periods  # noqa: E402
from seaopt.machine.response.verdicts import judge_response  # noqa: E402
from seaopt.machine.ticks import take_ticks  # noqa: E402
from seaopt.simulation.native import find_compiler  # noqa: E402
from tests.machine.simulator import Bench, Machine  # noqa: E402

LINEAR = ("none", "eta 15 % low", "friction doubled", "spring 20 % softer")  # whose loops have equations
OLD = "old/controller.json"


@dataclass(frozen=True)
class Subject:
    """An actuator with a law, and what it is certified for."""

    plant: so.Plant
    nominal: so.ParameterSet
    spec: so.ControllerSpec
    ranges: dict[str, tuple[float, float]]
    machine: Machine  # at the nominal values
    slower_hz: float
    noise: tuple[float, float]  # std of a reading
    decimals: tuple[int, int]  # of a logged reading
    limits: dict[str, float]
    names: dict[str, str]  # of damping, stiffness, and dry friction

    @cached_property
    def law(self):
        return so.tune(self.plant, self.nominal, self.spec)

    @cached_property
    def slower(self):
        return so.tune(self.plant, self.nominal, replace(self.spec, bandwidth_hz=self.slower_hz))

    @cached_property
    def benches(self):
        """Those of the law, of one without feedforward, of one without observer, and of another controller.json."""
        law, spec, folder = self.law, replace(self.spec, structure="custom"), tempfile.mkdtemp()
        gains = Gains.from_names(law.gains, law.observer, law.speed_loop, law.link)

        def change(**changes):
            made = replace(gains, **changes).law(law.spec.structure, law.sample_time_s).balanced()
            return replace(law, law=made, structure="custom", gains={}, spec=spec)

        laws = {"law": law, "bare": change(k_r=gains.k_p), "slower": self.slower}
        laws |= {"undisturbed": change(observer=None)} if gains.observer is not None else {}
        return {name: Bench(find_compiler(), folder, each, name) for name, each in laws.items()}

    @cached_property
    def stage(self):
        plan = so.bring_up(
            self.law, {"stand": self.plant}, self.nominal, ranges=self.ranges, samples=20, fractions=(),
            limits=self.limits,
        )  # fmt: skip
        return plan.stages[-1]

    def draw(self, rng):
        """Return a machine within what was certified."""
        eta, damping = (rng.uniform(*self.ranges[name]) / self.nominal[name].value for name in ("eta", "b_r"))
        drawn = replace(self.machine, per_ampere=self.machine.per_ampere * eta, damping=self.machine.damping * damping)
        if "f_c" in self.ranges:
            share = rng.uniform(*self.ranges["f_c"]) / self.nominal["f_c"].value
            drawn = replace(drawn, coulomb=drawn.coulomb * share)
        return drawn

    def list_faults(self, machine):
        """Return by name: the bench, the machine, the log's clock, and what the first cause or difference must be."""
        (signal,), names, peak = self.law.signals, self.names, self.stage.excitation.peaks
        harder = replace(machine, damping=2.0 * machine.damping, coulomb=2.0 * machine.coulomb)
        lower = replace(machine, stiffness=0.8 * machine.stiffness)
        weaker = replace(machine, per_ampere=0.85 * machine.per_ampere)
        friction = tuple(("parameter", names[key]) for key in ("damping", "coulomb") if key in names)
        weak = (("parameter", "eta"), ("parameter", "K_tau"), ("gain", "gain"))
        late = replace(machine, delay_s=2e-3)
        faults = {
            "none": ("law", machine, None, ()),
            "wrong rate": ("law", machine, 2e-3, (("rate", "clock"),)),
            "one tick late": ("law", replace(machine, late=2.0), None, (("delay", "delay"),)),
            "gain halved": ("law", replace(machine, law_gain=0.5), None, (("factor", "I"),)),
            "eta 15 % low": ("law", weaker, None, weak),
            "delay 2 ms more": ("law", late, None, (("delay", "delay"),)),
            "mode at 40 Hz": ("law", machine.with_mode(40.0), None, (("mode", "mode"),)),
            "friction doubled": ("law", harder, None, friction),
            "spring 20 % softer": ("law", lower, None, (("parameter", names["stiffness"]),)),
            "sign": ("law", replace(machine, reading_sign=-1.0), None, (("sign", signal),)),
            "saturated sensor": ("law", replace(machine, sensor_range=0.6 * peak[signal]), None, (("range", signal),)),
            "drive limited": (
                "law",
                replace(machine, drive_limit=0.5 * peak["I"]),
                None,
                (("drive limit", "drive_limit"),),
            ),
            "missing feedforward": ("bare", machine, None, (("feedforward", "reference"),)),
            "another controller": ("slower", machine, None, (("another law", OLD),)),
        }
        if "undisturbed" in self.benches:
            faults["missing observer"] = ("undisturbed", machine, None, (("part", "disturbance observer"),))
        return faults


def make_stand():
    thor = so.plants.thor().update(eta=0.985)
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=45, current_limit_A=9.0)
    nominal = Machine()
    return Subject(
        so.plants.high_impedance(), thor, spec, {"eta": (0.97, 1.0), "b_r": (1.2e-4, 1.4e-4)},
        replace(nominal, per_ampere=0.985 * nominal.per_ampere), 22.0, (0.5, 2.0), (1, 3), {"F1": 600.0},
        {"damping": "b_r", "stiffness": "k"},
    )  # fmt: skip


def make_knee():
    plant = so.plants.rotary(link="locked")
    stated = {"N": 100, "K_tau": 0.0369, "eta": 0.7, "J_m": 2.4e-5, "b_r": 1e-4, "f_c": 0.005, "v_s": 1.0, "k_s": 300.0}
    values = plant.complete(so.ParameterSet()).update(**stated)
    spec = so.ControllerSpec(  # its observer is its only integral
        bandwidth_hz=20, structure="pid_dob", measured="tau_s", max_sensitivity=1.6, max_noise_gain=45,
        reference_weights="error", current_limit_A=9.0,
    )  # fmt: skip
    ranges = {"eta": (0.68, 0.72), "b_r": (0.9e-4, 1.1e-4), "f_c": (0.004, 0.006)}
    return Subject(
        plant, values, spec, ranges, Machine.of_knee(values), 15.0, (0.01, 0.04), (3, 4), {"tau_s": 20.0},
        {"damping": "b_r", "stiffness": "k_s", "coulomb": "f_c"},
    )  # fmt: skip


SUBJECTS = {"stand": make_stand, "knee": make_knee}


def record(subject, bench, machine, period, rng):
    """Return the log of a run, some of them rounded."""
    decimals = int(rng.integers(*subject.decimals, endpoint=True)) if rng.uniform() < 0.5 else None
    reference = subject.stage.excitation.reference
    seed = int(rng.integers(1 << 30))
    log = bench.log(machine, reference, noise=rng.uniform(*subject.noise), seed=seed, period=period, decimals=decimals)
    return log.between(float(rng.uniform(0.0, 0.5)), float(log.time[-1]))


def judge(subject, log):
    """Return the acceptance of a log, and its first name with those that are as good."""
    result = so.accept(
        subject.law, [log], others={OLD: subject.slower}, uncertainty=subject.nominal, ranges=subject.ranges
    )
    causes = [cause for row in result.replays for cause in row.causes]
    found = [] if result.differences is None else list(result.differences.found)
    if causes:
        return result, [(causes[0].kind, causes[0].what)]
    return result, [(found[0].kind, name) for name in (found[0].name, *found[0].alike)] if found else [()]


def cover(measured, subject, bench, machine):
    """Return by group how many discs at 95 % hold the loop and the tracking of the machine's own equations, of how
    many. Those of the plant, of 1 + L and of the sensitivity are the loop's.
    """
    from tests.machine.test_response import respond

    groups = {}
    for part in measured:
        truths = respond(machine, part.f, bench.controller, 1)
        slow, fast = part.f <= subject.spec.bandwidth_hz / 3.0, part.f > 4.0 / 3.0 * subject.spec.bandwidth_hz
        bands = {"slow": slow, "about the bandwidth": ~slow & ~fast, "fast": fast}
        for name, truth in zip(("loop", "tracking"), truths, strict=True):
            centre, radius = getattr(part, name).disc(0.05)
            held = np.abs(centre - truth) <= radius
            for band, chosen in bands.items():
                counts = np.array([np.sum(held[chosen]), np.sum(chosen)])
                groups[name, band] = groups.get((name, band), 0) + counts
    return groups


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
    rows = [row for row in result.response.judged if row.outcome == "refuted" and row.name in truth]
    keeps = {
        row.name: truth[row.name] <= row.limit if row.sense == "at most" else truth[row.name] >= row.limit
        for row in rows
        if row.limit is not None
    }
    return [name for name, kept in keeps.items() if kept]


def run_subject(name, options):
    """Print and return how often each fault of a subject is found and named."""
    subject, table, covered, broken, judged = SUBJECTS[name](), {}, {}, 0, 0
    for number, fault in enumerate(subject.list_faults(subject.machine)):
        if options.only and fault not in options.only:
            continue
        found = named = 0
        otherwise = []
        for seed in range(options.first, options.first + options.seeds):
            rng = np.random.default_rng([seed, 7, number])
            key, faulty, period, expected = subject.list_faults(subject.draw(rng))[fault]
            result, names = judge(subject, record(subject, subject.benches[key], faulty, period, rng))
            right = any(each in expected for each in names)
            found, named = found + (not result.met), named + right
            if expected and not right:
                otherwise.append(f"{seed}: {names[0]}")
            if not expected and not result.met:
                otherwise.append(f"{seed}: {result!r}")
            if fault in LINEAR and not faulty.coulomb and result.response is not None:
                add_counts(covered, fault, cover(result.response.measured, subject, subject.benches[key], faulty))
                broken, judged = broken + len(find_broken(result, subject.benches[key], faulty)), judged + 5
        table[fault] = {"found": found, "named": named, "of": options.seeds, "otherwise": otherwise}
        counts = f"found {found:3d}/{options.seeds}  named {named:3d}/{options.seeds}"
        print(f"{name:6s} {fault:22s} {counts}  {otherwise}", flush=True)
    print_counts(covered)
    if covered:
        print(f"{broken} of {judged} rows refuted wrongly")
    return table


def add_counts(covered, fault, counted):
    """Add the counts of a log to those of its groups."""
    for (quantity, band), counts in counted.items():
        for group in ((quantity, "all"), (quantity, band), (quantity, fault)):
            covered[group] = covered.get(group, 0) + counts


def print_counts(covered):
    for (quantity, group), (held, count) in covered.items():
        print(f"discs at 95 % of the {quantity}, {group}: {100.0 * held / count:.1f} % of {count} hold the truth")


def count_discs(options):
    """Print how many discs of the stand hold its own equations, without judging its logs."""
    subject, covered = make_stand(), {}
    for number, fault in enumerate(subject.list_faults(subject.machine)):
        for seed in range(options.first, options.first + options.seeds) if fault in LINEAR else ():
            rng = np.random.default_rng([seed, 7, number])
            key, faulty, period, _ = subject.list_faults(subject.draw(rng))[fault]
            log = record(subject, subject.benches[key], faulty, period, rng)
            response = judge_response(subject.law, [cut_periods(subject.law, take_ticks(subject.law, log))], 0.95)
            add_counts(covered, fault, cover(response.measured, subject, subject.benches[key], faulty))
    print_counts(covered)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--on", nargs="*", default=list(SUBJECTS), choices=list(SUBJECTS))
    parser.add_argument("--only", nargs="*", default=None)
    parser.add_argument("--discs", action="store_true")
    parser.add_argument("-o", "--output", type=Path, default=None)
    options = parser.parse_args()
    start = time.process_time()
    if options.discs:
        count_discs(options)
    tables = {} if options.discs else {name: run_subject(name, options) for name in options.on}
    print(f"{time.process_time() - start:.0f} s of processor time")
    if options.output is not None:
        options.output.write_text(json.dumps(tables, indent=1) + "\n")


if __name__ == "__main__":
    main()
