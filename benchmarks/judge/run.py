"""How often a certified law keeps its limits on actuators that are not the model, with and without the logs as judge.

    python benchmarks/judge/run.py --fits 60 --seed 7 [--first 0] [--exact [--spoil gain]] [--json FILE]
    python benchmarks/judge/run.py --read FILE ...

Actuators, effects and logs are those of benchmarks/truth, which share nothing with seaopt. Each is fitted to one log
(--holdout: but its last part; --validate: another, of that share of the amplitude, is for validation), tuned with a
reserve of 3 %, and certified. Then its law closes the loop around the actuator itself, in C: Ms is measured from a
multisine on the command to the command, at two amplitudes with random phases, and a step is played. A law is *bad*
where Ms is over its limit by more than the grace of the certificate, or the step overshoots by more than 1.1 times the
reference peak, or does not settle. With --exact nothing is missing from any model, and a law is judged by its logs
alone: one that is refused, and is not bad, was refused wrongly. Only laws that a log refuses or confirms are played
there. With --spoil the log for validation is another actuator's, with half the gain or 3 ms more of delay, and what is
counted is how many such logs a certificate names, and how many of them for the model alone, as Ms is kept.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.special

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "truth"))
from actuators import KINDS, RATE_HZ, Actuator  # noqa: E402
from run import FREE, SEEDS, draw_cases  # noqa: E402

import seaopt as so  # noqa: E402
from seaopt.errors import SeaoptError  # noqa: E402
from seaopt.robustness.uncertainty.logs import judge_log  # noqa: E402

BANDWIDTH_HZ = {"screw": 25.0, "ankle": 15.0}
OTHERS_HZ, RESERVE = 10.0, 0.03
DIRECT: dict[str, Any] = {"measured": ("tau_s", "thetad_m"), "structure": "cascade"}  # no pid keeps its limits
SHARES = (0.5, 0.2)  # of the log's rms, of the multisine on the command
PHASES, PERIOD_S, GRACE = 3, 2.0, 1.05
LOG_ROWS = "log_sensitivity", "log_agreement"
HALF, LATER_S = 0.5, 3e-3  # another actuator's gain, and its delay beyond that of the one that was fitted


def make_case(actuator: Actuator, seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """Return what is certified of an actuator, and what its law does on it."""
    rng, kind = np.random.default_rng(seed), KINDS[actuator.kind]
    base = so.plants.high_impedance() if kind.linear else so.plants.rotary(link=actuator.link)
    plant, free = so.plants.let_stick(base), FREE[kind.linear]
    known = {name: value for name, value in actuator.truth.items() if name in plant.parameters}
    params = plant.defaults.update(**known | {name: known[name] * 2.0 ** rng.uniform(-1, 1) for name in free})
    delay = so.Parameter(name="delay", value=1e-3, unit="s", min=0.0, max=0.01, free=True)

    def record(of: Actuator, share: float, seed: int, gain: float = 1.0, **fields: Any) -> so.Experiment:
        readings = of.record(seconds=options.seconds, amplitude=share, seed=seed)
        readings["I"] = readings["I"] / gain
        log = so.Log.from_arrays(**readings).restamp(rate_hz=RATE_HZ)
        outputs = tuple(name for name in readings if name not in ("time", "I"))
        return so.Experiment(plant=plant, log=log, outputs=outputs, **fields)

    fitted = record(actuator, options.amplitude, seed, delay_s=delay, name="log0")
    later = LATER_S if options.spoil == "delay" else 0.0
    other = replace(actuator, delay_s=actuator.delay_s + later)
    gain, share = HALF if options.spoil == "gain" else 1.0, options.validate * options.amplitude
    others = [record(other, share, seed + SEEDS, gain, name="other")] if options.validate else []
    fit = so.fit([fitted], params.free(*free), validation=others, holdout=options.holdout)
    row: dict[str, Any] = {"fit_met": fit.met, "status": fit.status}
    chosen = DIRECT if actuator.kind == "direct" else {"measured": "F1" if kind.linear else "tau_s"}
    rms = float(np.std(fitted.log["I"]))
    spec = so.ControllerSpec(
        bandwidth_hz=BANDWIDTH_HZ.get(actuator.kind, OTHERS_HZ), bandwidth_range_hz=(1.0, 100.0), reserve=RESERVE,
        current_limit_A=kind.current, **chosen,
    )  # fmt: skip
    controller = so.tune(plant, fit, spec)
    row["tuned"] = controller.met
    if not controller.met:
        return row
    if options.exact:  # what other checks say of it does not matter
        limit = spec.level("max_sensitivity")
        verdicts = [verdict for log in (fitted, *others) for verdict in judge_log(controller, fit, log, limit)[0]]
        broken = (
            any(verdict.outcome == "refuted" for verdict in verdicts),
            any(verdict.agreement is not None and verdict.agreement.contradicts for verdict in verdicts),
        )
        row |= {"refused": [name for name, is_broken in zip(LOG_ROWS, broken, strict=True) if is_broken]}
        row |= {"certified": True} | ({} if options.spoil is None else {"spoiled": options.spoil})
        confirmed = any(verdict.outcome == "confirmed" for verdict in verdicts)
        played = options.spoil is None and (any(broken) or confirmed)
    else:
        certificate = so.certify(controller, {"stand": plant}, fit, samples=500, simulations=False)
        verdicts, row["refused"] = certificate.logs, [each.name for each in certificate.requirements if not each.met]
        row["certified"], played = not {*row["refused"]} - {*LOG_ROWS}, True
    row["logs"] = [asdict(verdict) for verdict in verdicts]
    return row | (play(actuator, controller, rms, rng) if played else {})


def play(actuator: Actuator, controller: so.Controller, rms: float, rng: np.random.Generator) -> dict[str, Any]:
    """Return Ms of the loop around the actuator at two amplitudes, what a step does, and whether any of it is bad."""
    limit = controller.spec.level("max_sensitivity")
    peaks = [measure_ms(actuator, controller, share * rms, rng) for share in SHARES]
    overshoot, left = play_step(actuator, controller)
    most = controller.spec.level("max_reference_peak")
    return {
        "ms": max(peaks), "limit": GRACE * limit, "peaks": peaks, "overshoot": overshoot, "left": left,
        "nominal_ms": controller.achieved.ms,
        "bad": bool(max(peaks) > GRACE * limit or overshoot > 1.1 * most or left > 0.1),
    }  # fmt: skip


def close(actuator: Actuator, controller: so.Controller, reference: np.ndarray, extra: np.ndarray) -> Any:
    """Return current and force of a loop, with a current that is added."""
    law = {name: np.array(part) for name, part in controller.to_dict()["law"].items()}
    a, b, c, d = (law[name] for name in "ABCD")
    per, top, x = controller.command.per_effort, KINDS[actuator.kind].current, np.zeros(len(a))

    def step(i: int, force: float, position: float) -> float:
        nonlocal x
        read = np.array([reference[i], force, position][: b.shape[1]])
        effort = float(np.ravel(c @ x + d @ read)[0])
        x = a @ x + b @ read
        return float(np.clip(per * effort + extra[i], -top, top))

    return actuator.close(step, reference.size, controller.sample_time_s, controller.compute_delay_samples)


def measure_ms(actuator: Actuator, controller: so.Controller, rms: float, rng: np.random.Generator) -> float:
    """Return the largest sensitivity at lines of a multisine: the mean over sets of phases."""
    period = round(PERIOD_S / controller.sample_time_s)
    lines = np.unique(np.round(np.geomspace(1.0, 120.0, 60) * PERIOD_S).astype(int))
    responses = []
    for _ in range(PHASES):
        spectrum = np.zeros(period // 2 + 1, dtype=complex)
        spectrum[lines] = np.exp(2j * np.pi * rng.uniform(size=lines.size))
        extra = np.fft.irfft(spectrum, period)
        extra *= rms / np.std(extra)
        current, _ = close(actuator, controller, np.zeros(2 * period), np.tile(extra, 2))
        responses.append(np.fft.rfft(current[period:])[lines] / np.fft.rfft(extra)[lines])
    return float(np.max(np.abs(np.mean(responses, axis=0))))


def play_step(actuator: Actuator, controller: so.Controller) -> tuple[float, float]:
    """Return the largest force of a step over it, and the range of the last quarter over the step."""
    count = round(3.0 / controller.sample_time_s)
    size = 0.3 * KINDS[actuator.kind].current / controller.command.per_effort
    _, force = close(actuator, controller, np.full(count, size), np.zeros(count))
    return float(np.max(force) / size), float(np.ptp(force[-count // 4 :]) / size)


def summarise(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield how often certified laws are bad, without the logs as judge and with them; of the laws that the logs refuse
    alone, how many wrongly; and of those that samples which were not fitted confirm, how many are over Ms.
    """
    done = [row for row in rows if "refused" in row]
    certified = [row for row in done if row["certified"]]
    refuted = [row for row in certified if _is_refused(row)]
    kept = [row for row in certified if not _is_refused(row)]
    others = [row for row in done if not row["certified"]]
    yield f"{len(rows)} cases, {len(done)} tuned; {sum(row['fit_met'] for row in done)} on fits that are met"
    if any("spoiled" in row for row in done):
        alone = sum(row["refused"] == [LOG_ROWS[1]] for row in done)
        yield f"another actuator's log     named {len(refuted)} of {len(done)}; {alone} for the model alone"
        return
    all_played = all("ms" in row for row in done)  # not so with --exact
    for name, laws in (("without the logs", certified), ("with them", kept)) if all_played else ():
        met = [row for row in laws if row["fit_met"]]
        yield f"certified {name:16s} {_count_bad(laws)}; on fits that are met {_count_bad(met)}"
    fine = sum(not row["bad"] for row in refuted)
    yield f"refused by a log alone     {len(refuted)}, of which fine {fine}: of all {_share(fine, len(certified))}"
    if others:
        also = [row for row in others if _is_refused(row)]
        yield f"refused by other checks    {_count_bad(others)}; by a log too {_count_bad(also)}"
    confirmed = [row for row in done if any(log["outcome"] == "confirmed" for log in row["logs"])]
    if confirmed:
        over = sum(row["ms"] > row["limit"] for row in confirmed)
        yield f"confirmed by a log         {len(confirmed)}, over Ms {over}: {_share(over, len(confirmed))}"


def _is_refused(row: dict[str, Any]) -> bool:
    return any(name in row["refused"] for name in LOG_ROWS)


def _count_bad(rows: list[dict[str, Any]]) -> str:
    return f"{len(rows)}, bad of these {sum(row['bad'] for row in rows)}"


def _share(count: int, of: int) -> str:
    """Return a share, and what it is below at 95 % (Clopper and Pearson 1934)."""
    bound = scipy.special.bdtri(count, of, 0.05) if count < of else 1.0
    return f"{100 * count / max(of, 1):.1f} %, below {100 * bound:.1f} %"


def main() -> None:
    """Run the cases that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fits", type=int, default=30)
    parser.add_argument("--first", type=int, default=0, help="of a seed's cases, that is fitted first")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=15.0, help="length of each log")
    parser.add_argument("--amplitude", type=float, default=1.0, help="of the log, of the largest")
    parser.add_argument("--validate", type=float, default=0.0, help="amplitude of a second log, of the first's")
    parser.add_argument("--spoil", choices=("gain", "delay"), help="with --exact and --validate: of another actuator")
    parser.add_argument("--holdout", type=float, default=0.0, help="share of the log that is not fitted")
    parser.add_argument("--exact", action="store_true", help="nothing is missing from any model")
    parser.add_argument("--pendulums", action="store_true", help="links that swing, too, whose fits take long")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--read", type=Path, nargs="*", help="print the table of kept cases, and run none")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    if options.spoil and not (options.exact and options.validate):
        parser.error("--spoil takes --exact and --validate, the log that is spoiled")
    if options.read:
        rows = [row for file in options.read for row in json.loads(file.read_text())]
        print("\n".join(summarise(rows)))
        return
    rng = np.random.default_rng(options.seed)
    cases = list(draw_cases(options.first + options.fits, rng, locked=not options.pendulums))
    for k, case in enumerate(cases[options.first :], options.first):
        actuator, started = replace(case, effects={}) if options.exact else case, time.process_time()
        row = asdict(actuator) | {"number": k}
        try:
            row |= make_case(actuator, 1000 * options.seed + k, options)
        except SeaoptError as error:
            row |= {"status": f"{type(error).__name__}: {error}"[:200]}
        row["cpu_s"] = round(time.process_time() - started, 1)
        rows.append(row)
        found = f"Ms {row['ms']:.2f} ({row['nominal_ms']:.2f}) overshoot {row['overshoot']:.2f}" if "ms" in row else ""
        said = "BAD" if row.get("bad") else ""
        effects = ", ".join(actuator.effects) or "nothing missing"
        print(
            f"{k:4d} {actuator.kind:7s} {effects:28s} {row['cpu_s']:6.1f} s {found} {row.get('refused')} {said}",
            flush=True,
        )
        if options.json:
            options.json.write_text(json.dumps(rows, indent=1))
    print("\n".join(summarise(rows)))


if __name__ == "__main__":
    main()
