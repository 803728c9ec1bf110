"""What a fit says of spoiled logs, and of honest ones: `python benchmarks/bench_spoilings.py [SEEDS [HONEST]]`.

The stand and the swing are integrated here, by fourth-order Runge-Kutta at a fixed step, independently of the product.
Each row is one spoiling over some seeds: how often the fit was met (0 is right), how often its 3-sigma intervals missed
the truth, and the kinds of findings. Then honest logs: how often an error or a warning accused them.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np
import scipy.signal

import seaopt as so

TRUTH = {
    "m_l": 0.646, "k": 655e3, "l": 0.002, "N_p": 3.0, "K_tau": 0.0255, "J": 3.31e-6, "b_r": 1.31e-4, "eta": 1.0,
    "f_c": 0.0, "v_s": 1e-3, "I_p": 0.36, "m": 4.0, "L": 0.3, "L_a": 0.0725, "d": 0.0, "g": 9.81,
}  # fmt: skip
RATE_HZ, SECONDS, SUBSTEPS = 400.0, 15.0, 6
Arrays = dict[str, np.ndarray]


def integrate(slope: Callable[[np.ndarray, float], np.ndarray], start: np.ndarray, drive: np.ndarray) -> np.ndarray:
    """Return the states at every sample of a drive that is held between samples."""
    step = 1.0 / (RATE_HZ * SUBSTEPS)
    x, rows = start, np.empty((drive.size, start.size))
    for i, u in enumerate(drive.tolist()):
        rows[i] = x
        for _ in range(SUBSTEPS):
            k1 = slope(x, u)
            k2 = slope(x + 0.5 * step * k1, u)
            k3 = slope(x + 0.5 * step * k2, u)
            x = x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + slope(x + step * k3, u))
    return rows


DRIVES = {"zero": "zoh", "first": "foh"}


def stand(current: np.ndarray, p: dict[str, float], hold: str = "zero") -> Arrays:
    """Return what load cells read with both links held: (M + m_l) qdd = F_m - b qd - k q - friction.

    Without friction the current may be joined by lines between samples, hold = "first", as some drives do.
    """
    r = p["l"] / (2.0 * math.pi * p["N_p"])
    b, moving, gain = p["b_r"] / r**2, p["J"] / r**2 + p["m_l"], p["eta"] * p["K_tau"] / r
    if p["f_c"] == 0.0:
        a = np.array([[0.0, 1.0], [-p["k"] / moving, -b / moving]])
        c = np.array([[p["k"], 0.0], p["m_l"] * a[1] + [p["k"], 0.0]])
        system = (a, np.array([[0.0], [gain / moving]]), c, np.array([[0.0], [p["m_l"] * gain / moving]]))
        _, y, _ = scipy.signal.dlsim(scipy.signal.cont2discrete(system, 1.0 / RATE_HZ, DRIVES[hold]), current)
        return {"I": current, "F1": y[:, 0], "F2": y[:, 1]}

    def slope(x: np.ndarray, u: float) -> np.ndarray:
        friction = p["f_c"] * math.tanh(x[1] / p["v_s"])
        return np.array([x[1], (gain * u - b * x[1] - p["k"] * x[0] - friction) / moving])

    x = integrate(slope, np.zeros(2), current)
    f1 = p["k"] * x[:, 0]
    acceleration = (gain * current - b * x[:, 1] - f1 - p["f_c"] * np.tanh(x[:, 1] / p["v_s"])) / moving
    return {"I": current, "F1": f1, "F2": f1 + p["m_l"] * acceleration}


def swing(current: np.ndarray, p: dict[str, float]) -> Arrays:
    """Return the same with link 2 a pendulum: x_2 = L_a sin(phi), q = x_l - x_2."""
    r = p["l"] / (2.0 * math.pi * p["N_p"])
    b, big, gain = p["b_r"] / r**2, p["J"] / r**2, p["eta"] * p["K_tau"] / r

    def force(x: np.ndarray, u: float) -> tuple[float, float, float]:
        """F2 follows from M (xdd_l - xdd_2) = F_m - b qd - F2, linear in F2."""
        xl, vl, phi, w = x
        cosine, sine, f1 = math.cos(phi), math.sin(phi), p["k"] * xl
        arm = p["L_a"] * cosine
        rest = -(p["m"] * p["g"] * p["L"] * sine + p["d"] * w) / p["I_p"]
        left = big * (-f1 / p["m_l"] - arm * rest + p["L_a"] * sine * w**2)
        f2 = (gain * u - b * (vl - arm * w) - left) / (1.0 + big * (1.0 / p["m_l"] + arm**2 / p["I_p"]))
        return f1, f2, rest - f2 * arm / p["I_p"]

    def slope(x: np.ndarray, u: float) -> np.ndarray:
        f1, f2, turn = force(x, u)
        return np.array([x[1], (f2 - f1) / p["m_l"], x[3], turn])

    x = integrate(slope, np.zeros(4), current)
    f1, f2, _ = np.array([force(row, u) for row, u in zip(x, current.tolist(), strict=True)]).T
    return {"I": current, "F1": f1, "F2": f2}


def excite(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return a chirp of 0.1 to 100 Hz with noise, or a multisine, or noise alone."""
    t, kind = np.arange(n) / RATE_HZ, rng.integers(3)
    noise = scipy.signal.lfilter([0.3], [1.0, -0.7], rng.normal(size=n))
    if kind == 0:
        return 2.0 * scipy.signal.chirp(t, 0.1, t[-1], 100.0, "logarithmic") + noise
    if kind == 1:
        lines = np.unique(np.round(np.geomspace(0.1, 90.0, 40) * t[-1])) / t[-1]
        return sum(0.4 * np.cos(2 * np.pi * (f * t + rng.random())) for f in lines) + 0.0
    return 3.0 * noise


def colour(rng: np.random.Generator, n: int, kind: str) -> np.ndarray:
    """Return noise of unit size: white, coloured by one pole, or heavy-tailed (Student's t of three degrees)."""
    if kind == "coloured":
        pole = rng.uniform(0.5, 0.97)
        return scipy.signal.lfilter([math.sqrt(1.0 - pole**2)], [1.0, -pole], rng.normal(size=n + 500))[500:]
    return rng.normal(size=n) if kind == "white" else rng.standard_t(3, size=n) / math.sqrt(3.0)


@dataclass
class Case:
    """A log to be made, and how it is fitted."""

    truth: dict[str, float] = field(default_factory=dict)
    start: dict[str, float] = field(default_factory=dict)
    free: tuple[str, ...] = ("J", "b_r")
    model: str = "stand"
    bench: str = "stand"
    samples: int = int(RATE_HZ * SECONDS)
    noise: str = "white"
    noise_n: float = 4.0
    spoil: Callable[[Arrays, np.random.Generator], None] = lambda log, rng: None
    clip_n: float | None = None
    bounds: dict[str, float] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    rate: float = RATE_HZ
    hold: Literal["zero", "first"] = "zero"


def make_fit(case: Case, seed: int) -> so.Fit:
    """Return the fit of a case."""
    rng = np.random.default_rng(seed)
    run = {"stand": partial(stand, hold=case.hold), "swing": swing}[case.bench]
    log = run(excite(rng, case.samples), TRUTH | case.truth)
    log["I"] = log["I"].copy()
    for name in ("F1", "F2"):
        clean = log[name] if case.clip_n is None else np.clip(log[name], -case.clip_n, case.clip_n)
        log[name] = clean + case.noise_n * colour(rng, clean.size, case.noise) + rng.normal() * 20.0
    case.spoil(log, rng)
    plants = {"stand": so.plants.high_impedance(), "swing": so.plants.moving_output()}
    length = min(values.size for values in log.values())
    recorded = so.Log.from_arrays(
        time=np.arange(length) / case.rate, **{name: values[:length] for name, values in log.items()}
    )
    start = {"J": 2e-6, "b_r": 2.5e-4} | case.start
    params = so.plants.thor().update(**{n: v for n, v in start.items() if n in case.free or n in case.start})
    params = params.free(*case.free)
    for name, low in case.bounds.items():
        params = params.with_parameters(replace(params[name], value=max(params[name].value, low), min=low))
    experiment = so.Experiment(plant=plants[case.model], log=recorded, outputs=("F1", "F2"), name="log", hold=case.hold)
    others = [plant for name, plant in plants.items() if name != case.model]
    return so.fit([experiment], params, alternatives=others, **case.options)


def late(name: str, samples: int) -> Callable[[Arrays, np.random.Generator], None]:
    """Return what stamps a channel so many samples late (early where negative)."""

    def spoil(log: Arrays, rng: np.random.Generator) -> None:
        for one in name.split():
            log[one] = np.roll(log[one], samples)
        for one in log:
            log[one] = log[one][abs(samples) : -abs(samples)]

    return spoil


def scale(**factors: float) -> Callable[[Arrays, np.random.Generator], None]:
    """Return what multiplies channels."""

    def spoil(log: Arrays, rng: np.random.Generator) -> None:
        for name, times in factors.items():
            log[name] = log[name] * times

    return spoil


def swap(first: str, second: str) -> Callable[[Arrays, np.random.Generator], None]:
    """Return what swaps two columns."""

    def spoil(log: Arrays, rng: np.random.Generator) -> None:
        log[first], log[second] = log[second], log[first]

    return spoil


def low_pass(names: str, cut_hz: float) -> Callable[[Arrays, np.random.Generator], None]:
    """Return what reads channels through one pole."""

    def spoil(log: Arrays, rng: np.random.Generator) -> None:
        pole = math.exp(-2.0 * math.pi * cut_hz / RATE_HZ)
        for name in names.split():
            log[name] = scipy.signal.lfilter([1.0 - pole], [1.0, -pole], log[name])

    return spoil


def from_half(change: Callable[[np.ndarray], np.ndarray], *names: str) -> Callable[[Arrays, np.random.Generator], None]:
    """Return what changes channels in the second half of the log."""

    def spoil(log: Arrays, rng: np.random.Generator) -> None:
        for name in names:
            half = log[name].size // 2
            log[name] = np.concatenate([log[name][:half], change(log[name][half:])])

    return spoil


def clip_input(log: Arrays, rng: np.random.Generator) -> None:
    """The logged current saturates at half of its size, the real one does not."""
    log["I"] = np.clip(log["I"], -0.5 * np.std(log["I"]), 0.5 * np.std(log["I"]))


def disturb(log: Arrays, rng: np.random.Generator) -> None:
    """Forces that follow no current at all."""
    for name in ("F1", "F2"):
        log[name] = 500.0 * rng.normal(size=log[name].size)


SPOILINGS: dict[str, Case] = {
    "I and F1 swapped": Case(spoil=swap("I", "F1")),
    "I and F2 swapped": Case(spoil=swap("I", "F2")),
    "F1 and F2 swapped": Case(spoil=swap("F1", "F2")),
    "I of wrong sign": Case(spoil=scale(I=-1.0)),
    "F1 of wrong sign": Case(spoil=scale(F1=-1.0)),
    "F2 of wrong sign": Case(spoil=scale(F2=-1.0)),
    "mA as A, eta free": Case(spoil=scale(I=1e3), free=("J", "b_r", "eta")),
    "mA as A, eta known": Case(spoil=scale(I=1e3)),
    "kA as A, eta known": Case(spoil=scale(I=1e-3)),
    "F1 in kN": Case(spoil=scale(F1=1e-3)),
    "F1 in lbf": Case(spoil=scale(F1=1 / 4.448)),
    "F1, F2 in lbf": Case(spoil=scale(F1=1 / 4.448, F2=1 / 4.448)),
    "F1, F2 in lbf, eta free": Case(spoil=scale(F1=1 / 4.448, F2=1 / 4.448), free=("J", "b_r", "eta")),
    "k twice": Case(start={"k": 1310e3}),
    "k half": Case(start={"k": 327e3}),
    "k 1.1": Case(start={"k": 720e3}),
    "lead twice": Case(start={"l": 0.004}),
    "N_p 2 for 3": Case(start={"N_p": 2.0}),
    "K_tau 1.2": Case(start={"K_tau": 0.0306}),
    "m_l 10 for 0.646": Case(start={"m_l": 10.0}),
    "I late by 20": Case(spoil=late("I", 20)),
    "I late by 2": Case(spoil=late("I", 2)),
    "forces late by 20": Case(spoil=late("F1 F2", 20)),
    "forces late by 2": Case(spoil=late("F1 F2", 2)),
    "F1 late by 2": Case(spoil=late("F1", 2)),
    "F2 late by 20": Case(spoil=late("F2", 20)),
    "clipped ahead of noise, 500 N": Case(clip_n=500.0, spoil=lambda log, rng: None),
    "clipped ahead of noise, 900 N": Case(clip_n=900.0),
    "clipped current": Case(spoil=clip_input),
    "F1 behind 20 Hz": Case(spoil=low_pass("F1", 20.0)),
    "F1, F2 behind 20 Hz": Case(spoil=low_pass("F1 F2", 20.0)),
    "F1, F2 behind 80 Hz": Case(spoil=low_pass("F1 F2", 80.0)),
    "swing log on the stand": Case(bench="swing"),
    "stand log on the swing": Case(model="swing"),
    "friction of 20 N": Case(truth={"f_c": 20.0}),
    "friction of 60 N": Case(truth={"f_c": 60.0}),
    "friction of 200 N": Case(truth={"f_c": 200.0}),
    "8 samples": Case(samples=8),
    "40 samples": Case(samples=40),
    "sampled at twice the rate": Case(rate=2.0 * RATE_HZ),
    "J at its bound": Case(bounds={"J": 6e-6}),
    "plant changes half-way, held out": Case(
        spoil=from_half(lambda y: scipy.signal.lfilter([1.0], [1.0, 0.4], y), "F1", "F2"), options={"holdout": 0.5}
    ),
    "F2 dead from half-way": Case(spoil=from_half(lambda y: 0.0 * y, "F2")),
    "forces of another log": Case(spoil=disturb),
}


def score(fit: so.Fit, truth: dict[str, float]) -> bool:
    """Tell whether a 3-sigma interval misses the truth."""
    rows = [fit.parameters[name] for name in fit.covariance.names]
    return any(abs(row.value - truth[row.name]) > 3.0 * (row.std or 0.0) for row in rows)


def judge_spoilings(seeds: int, names: list[str]) -> None:
    """Print one row per spoiling."""
    print(f"{'spoiling':34} {'met':>5} {'converged':>9} {'missed':>6} {'met and missed':>14}  findings")
    for name in names:
        case, met, converged, missed, both, kinds = SPOILINGS[name], 0, 0, 0, 0, Counter[str]()
        causes = Counter[str]()
        for seed in range(seeds):
            try:
                fit = make_fit(case, seed)
            except so.SeaoptError as error:
                kinds[f"refused: {str(error)[:60]}"] += 1
                continue
            wrong = score(fit, TRUTH | case.truth)
            met, missed, both = met + fit.met, missed + wrong, both + (fit.met and wrong)
            converged += fit.status == "converged"
            kinds.update({f"{one.severity[0]}:{one.kind}" for one in fit.findings})
            causes.update(one.text for one in fit.findings if one.kind == "cause")
        said = ", ".join(f"{kind} {count}" for kind, count in kinds.most_common())
        print(f"{name:34} {met:5} {converged:9} {missed:6} {both:14}  {said}", flush=True)
        for text, count in causes.most_common(2):
            print(f"{'':12}{count} x {text[:170]}")


def judge_honest(count: int) -> None:
    """Print how often honest logs are accused."""
    accused = Counter[str]()
    for seed in range(count):
        noise = ("white", "coloured", "heavy")[seed % 3]
        rng = np.random.default_rng(10_000 + seed)
        case = Case(
            noise=noise, noise_n=float(10 ** rng.uniform(0.0, 2.0)), samples=int(rng.integers(1500, 6000)),
            truth={"J": TRUTH["J"] * rng.uniform(0.5, 2.0), "b_r": TRUTH["b_r"] * rng.uniform(0.5, 2.0)},
            hold="first" if seed % 5 == 4 else "zero",
        )  # fmt: skip
        fit = make_fit(case, 20_000 + seed)
        worst = [one for one in fit.findings if one.severity != "note"]
        accused.update({f"{noise} {one.severity}" for one in worst} | {one.severity for one in worst})
        for one in worst:
            print(
                f"  seed {seed}, {noise}, hold {case.hold}, {case.noise_n:.3g} N, {case.samples}: {one.severity} "
                f"{one.kind}: {one.text}"
            )
    print(f"{count} honest fits: {dict(accused)}")


if __name__ == "__main__":
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    chosen = [name for name in SPOILINGS if not sys.argv[3:] or any(word in name for word in sys.argv[3:])]
    judge_spoilings(seeds, chosen if seeds else [])
    judge_honest(int(sys.argv[2]) if len(sys.argv) > 2 else 500)
