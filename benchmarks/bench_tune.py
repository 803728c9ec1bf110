"""The tuner against a long global search, on random plants and specifications: python benchmarks/bench_tune.py

Each case draws a THOR-like actuator, a structure, limits, a rate and a delay, with or without a swinging output to be
robust to. scipy's differential evolution then searches the same numbers for about 50 times the tuner's time, with
the bandwidth met in closed form. Both answers are judged by the same NumPy code, which shares nothing with the
tuner but the plant's continuous matrices and the law's definition. Options: --cases 40 --seed 1 --times 50 --only N;
--refusals N rechecks the first N refusals of another seed by such a search; --requests N answers those of the tests,
of which the refusals are to take 5 s of processor time at most (OMP_NUM_THREADS=1 --requests 301);
--mixsyn 1 sets THOR's pid beside the H-infinity law of python-control's mixsyn (slycot) instead.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.linalg import expm
from scipy.optimize import differential_evolution

import seaopt as so
from seaopt.control import Gains, Loop, command_of
from seaopt.control.laws.structures import Notch
from seaopt.errors import InternalError, SeaoptError

LOWEST_HZ, RATE = 0.1, 2 * np.pi * 0.05
FULL = {"pd": "dT", "pid": "idT", "pid_dob": "idTQ"}


@dataclass(frozen=True)
class Case:
    spec: so.ControllerSpec
    params: so.ParameterSet
    swing: bool

    @property
    def plants(self):
        return [so.plants.high_impedance(), *([so.plants.moving_output()] if self.swing else [])]


def draw(rng: np.random.Generator) -> Case:
    """Draw a plant and a specification, some of which nothing can meet."""

    def maybe(chance, low, high):
        return float(rng.uniform(low, high)) if rng.random() < chance else False

    thor = so.plants.thor()
    spread = {"J": 0.8, "b_r": 1.0, "k": 0.8, "m_l": 0.5}
    values = {name: thor[name].value * np.exp(rng.uniform(-s, s)) for name, s in spread.items()}
    params = thor.update(**values, I_p=rng.uniform(0.2, 0.6))
    structure = str(rng.choice(["pd", "pid", "pid", "pid_dob"]))
    noise = float(np.exp(rng.uniform(np.log(25), np.log(300)))) if rng.random() < 0.7 else False
    spec = so.ControllerSpec(
        structure=structure, bandwidth_hz=float(rng.uniform(15, 60)), compute_delay_samples=int(rng.integers(0, 3)),
        sample_rate_hz=float(rng.choice([500.0, 1e3, 1e3, 2e3])), max_sensitivity=float(rng.uniform(1.45, 2.2)),
        max_complementary=maybe(0.6, 1.15, 1.6), max_reference_peak=maybe(0.6, 1.05, 1.5), max_noise_gain=noise,
        min_disk_margin=maybe(0.2, 0.6, 1.1), objective=str(rng.choice(["disturbance", "disturbance", "noise"])),
        reference_weights=str(rng.choice(["error", "error", "measurement"])),
        notch=Notch() if structure == "pid" and rng.random() < 0.2 else None, max_droop_db=False,
        min_filter_samples=False,
    )  # fmt: skip
    return Case(spec=spec, params=params, swing=bool(rng.random() < 0.5))


def absolute(values):
    """Return absolute values, as np.abs does in three times as long, to be safe from overflow."""
    return np.sqrt(values.real**2 + values.imag**2)


class Judge:
    """Limits and objective of a law in NumPy alone, for many laws at once."""

    def __init__(self, case: Case, controller: so.Controller) -> None:
        spec, self.case = case.spec, case
        self.ts, self.spec = spec.sample_time_s, spec
        gain = command_of(case.plants[0], case.params, "F1").per_effort
        self.held = [self.hold(plant.linearize(case.params), gain) for plant in case.plants]
        nyquist = 0.5 / self.ts
        f = [np.geomspace(1e-3, LOWEST_HZ, 60)[:-1], np.geomspace(LOWEST_HZ, 0.9999 * nyquist, 500)]
        f.append(np.linspace(0.5, 1.5, 40) * spec.bandwidth_hz)
        for a, *_ in self.held:
            poles = np.log(np.linalg.eigvals(a).astype(complex)) / self.ts
            for pole in poles[(poles.imag > 0) & (-poles.real < 0.3 * np.abs(poles))]:
                width = max(-pole.real, 1e-3 * abs(pole)) / (2 * np.pi)
                f.append(abs(pole) / (2 * np.pi) + width * np.linspace(-4, 4, 41))
        f = np.unique(np.concatenate([*f, [spec.bandwidth_hz, spec.sensitivity_bandwidth_limit_hz]]))
        self.f = f[(f >= 1e-3) & (f < nyquist)]
        self.q = np.exp(-2j * np.pi * self.f * self.ts)
        self.p = [self.response(held) for held in self.held]
        self.at = int(np.argmin(np.abs(self.f - spec.bandwidth_hz)))
        a, b, c = self.held[0]
        self.k_ff = 1.0 / float(c @ np.linalg.solve(np.eye(a.shape[0]) - a, b))
        inside = np.flatnonzero((self.f >= LOWEST_HZ) & (self.f <= spec.bandwidth_hz))
        self.weights = np.zeros(self.f.size)
        self.weights[inside] = np.gradient(np.log(self.f[inside]))
        self.weights[inside[[0, -1]]] *= 0.5
        observer = controller.observer
        if observer is not None:
            polynomial = np.polynomial.polynomial.polyval
            self.kept = polynomial(self.q, observer.nominal.kept)
            self.inverse = math.prod(
                polynomial(self.q, part.num) / polynomial(self.q, part.den) for part in observer.nominal.inverse
            )

    def hold(self, model, gain):
        n = model.A.shape[0]
        block = np.zeros((n + 1, n + 1))
        block[:n, :n], block[:n, n] = model.A, model.B[:, 0] * gain
        whole = expm(block * self.ts)
        return whole[:n, :n], whole[:n, n], np.asarray(model.C)[0]

    def response(self, held):
        a, b, c = held
        values, vectors = np.linalg.eig(a)
        residues = (c @ vectors) * np.linalg.solve(vectors, b)
        return (residues / (1 / self.q[:, None] - values)).sum(axis=1) * self.q**self.spec.compute_delay_samples

    def law(self, numbers, only=slice(None)):
        """Return C_y and C_r for columns of named numbers, each of shape (n, 1), at all frequencies or some."""
        q, ts = self.q[only], self.ts
        rate = (1 - q) / (numbers["T"] + ts - q * numbers["T"])
        series, more = 1.0, 0.0
        if self.spec.structure == "pid_dob":
            lag = (ts / (numbers["Q"] + ts - q * numbers["Q"])) ** 2
            series, more = 1 / (1 - lag * self.kept[only]), lag * self.inverse[only]
        if self.spec.notch is not None:
            s, w = (1 - q) / (1 + q), np.tan(np.pi * numbers["f"] * ts)
            damping = 2 * numbers["w"] * w * s
            series = series * (s**2 + numbers["g"] * damping + w**2) / (s**2 + damping + w**2)
        both = numbers["p"] + numbers["i"] * ts / 2 * (1 + q) / (1 - q)
        forward = numbers["d"] * rate if self.spec.reference_weights == "error" else 0.0
        return series * (both + numbers["d"] * rate + more), series * (both + forward + self.k_ff)

    def proportional(self, numbers):
        """Return both k_p with the bandwidth, from three samples of the quadratic equation."""

        def gap(k_p):
            at = slice(self.at, self.at + 1)
            c_y, c_r = (c[:, 0] for c in self.law(numbers | {"p": np.full_like(numbers["d"], k_p)}, at))
            p = self.p[0][self.at]
            return 2 * np.abs(p * c_r) ** 2 - np.abs(1 + p * c_y) ** 2

        zero, one, two = gap(0.0), gap(1.0), gap(2.0)
        a, b = (two - 2 * one + zero) / 2, (4 * one - 3 * zero - two) / 2
        with np.errstate(invalid="ignore", divide="ignore"):
            root = np.sqrt(b**2 - 4 * a * zero)
            return [np.nan_to_num((-b + sign * root) / (2 * a), nan=-1.0)[:, None] for sign in (1, -1)]

    def judge(self, numbers):
        """Return the largest excess over a limit (as a ratio), whether loops may be stable, and the objective."""
        spec, (c_y, c_r) = self.spec, self.law(numbers)
        worst, value = np.zeros(c_y.shape[0]), np.zeros(c_y.shape[0])
        turned = np.zeros(c_y.shape[0])

        def top(curve, limit):
            nonlocal worst
            if limit:
                worst = np.maximum(worst, np.max(curve, axis=1) / limit)

        for row, p in enumerate(self.p):
            loop = p * c_y
            s = 1 / (1 + loop)
            size = absolute(s)
            top(size, spec.max_sensitivity)
            top(absolute(loop * s), spec.max_complementary)
            top(absolute(s - loop * s), spec.min_disk_margin and 2 / spec.min_disk_margin)
            turned = np.minimum(turned, np.sum(np.angle(s[:, :-1] * np.conj(s[:, 1:])), axis=1))
            if spec.objective == "disturbance":
                value = np.maximum(value, size @ self.weights)
            if row == 0:
                t, noise = absolute(p * c_r * s), absolute(c_y * s)
                top(t, spec.max_reference_peak)
                top(noise, spec.max_noise_gain)
                top(size[:, self.f <= spec.sensitivity_bandwidth_limit_hz], np.sqrt(0.5))
                top(1 / t[:, self.f < 0.97 * spec.bandwidth_hz], np.sqrt(2))
                if spec.objective == "noise":
                    value = np.max(noise, axis=1)
        if spec.structure == "pid":
            worst = np.maximum(worst, 1 + RATE * (1 + numbers["p"][:, 0]) - numbers["i"][:, 0])
        return worst, turned > -0.3 * np.pi, value


def ranges(case: Case, judge: Judge):
    """Return the numbers searched, logarithmically, and their ranges."""
    f_b, inverse = case.spec.bandwidth_hz, 1 / abs(judge.p[0][judge.at])
    w_b = 2 * np.pi * f_b
    every = {
        "i": (0.3, 3 * w_b * (1 + inverse)), "d": (1e-3 * inverse / w_b, 30 * inverse / w_b),
        "T": (1e-2 * judge.ts, 4 / w_b), "Q": (0.2 * judge.ts, 3.0),
        "f": (1.2 * f_b, 0.45 / judge.ts), "w": (0.02, 1.0), "g": (0.01, 1.0),
    }  # fmt: skip
    if case.spec.structure == "pid_dob":
        every["i"] = (1e-2, every["i"][1])
    names = FULL[case.spec.structure] + ("fwg" if case.spec.notch is not None else "")
    return names, [tuple(np.log(every[name])) for name in names]


def search(case: Case, judge: Judge, seconds: float, seed: int, generations: int = 100_000):
    """Return the best numbers of a differential evolution, and how many laws it looked at."""
    names, bounds = ranges(case, judge)
    started, looked, allowed = time.process_time(), 0, 1.0 - case.spec.reserve

    def cost(v):
        nonlocal looked
        v = np.atleast_2d(v.T)
        looked += 2 * v.shape[0]
        numbers = {name: np.exp(v[:, [i]]) for i, name in enumerate(names)}
        numbers.setdefault("i", np.zeros_like(numbers["d"]))
        out = np.full(v.shape[0], np.inf)
        for k_p in judge.proportional(numbers):
            worst, stable, value = judge.judge(numbers | {"p": np.maximum(k_p, 0.0)})
            merit = np.log(value) + 20 * np.log(np.maximum(worst / allowed, 1.0))
            merit += np.where(stable, 0.0, 50.0) + np.where(k_p[:, 0] < 0.0, 100.0, 0.0)
            out = np.fmin(out, merit)
        return out

    found = differential_evolution(
        cost, bounds, seed=seed, maxiter=generations, popsize=12, tol=1e-9, polish=False, vectorized=True, init="sobol",
        updating="deferred", callback=lambda intermediate_result: time.process_time() - started > seconds,
    )  # fmt: skip
    numbers = {name: np.exp(np.array([[found.x[i]]])) for i, name in enumerate(names)}
    numbers.setdefault("i", np.zeros((1, 1)))
    answers = [numbers | {"p": np.maximum(k_p, 0.0)} for k_p in judge.proportional(numbers) if k_p[0, 0] >= 0.0]
    return answers, looked


def of_controller(controller: so.Controller):
    names = {"p": "k_p", "i": "k_i", "d": "k_d", "T": "T_f", "Q": "T_q", "f": "notch_frequency_hz", "w": "notch_width",
             "g": "notch_depth"}  # fmt: skip
    return {short: np.array([[controller.gains[name]]]) for short, name in names.items() if name in controller.gains}


def stable(case: Case, controller: so.Controller, numbers) -> bool:
    """Tell by eigenvalues whether a law's loops are stable."""
    one = {name: float(value[0, 0]) for name, value in numbers.items()}
    observer = controller.observer
    gains = Gains(
        k_p=one["p"], k_i=one["i"], k_d=one["d"], T_f=one["T"], k_r=1.0 + one["p"],
        observer=None if observer is None else replace(observer, T_q=one["Q"]),
        notch=Notch(frequency_hz=one["f"], width=one["w"], depth=one["g"]) if "f" in one else None,
    )  # fmt: skip
    law = gains.law(case.spec.structure, case.spec.sample_time_s)
    loops = [Loop(plant=controller.plant(p, case.params), law=law) for p in case.plants]
    return all(np.max(np.abs(loop.eigenvalues())) < 1.0 for loop in loops)


def compare(case: Case, times: float, seed: int) -> dict:
    """Tune, search, and judge both."""
    plant, *others = case.plants
    robust_to = dict.fromkeys(("swing",), others[0]) if others else {}
    started = time.process_time()
    controller = so.tune(plant, case.params, case.spec, robust_to=robust_to)
    tuned_s = time.process_time() - started
    judge = Judge(case, controller)
    worst, _, value = judge.judge(of_controller(controller))
    answers, looked = search(case, judge, times * tuned_s, seed)
    answers = [answer for answer in answers if stable(case, controller, answer)]
    judged = [tuple(float(np.ravel(item)[0]) for item in judge.judge(answer)) for answer in answers]
    best = min(judged, key=lambda item: (max(item[0], 1.0) + (item[1] < 0.5), item[2]), default=(np.inf, 0.0, np.nan))
    return {
        "feasible": controller.feasible, "usage": float(worst[0]), "value": float(value[0]), "tuned_s": tuned_s,
        "search_feasible": best[0] <= 1.0 + 1e-6 and best[1] > 0.5, "search_usage": best[0], "search_value": best[2],
        "looked": looked, "largest": controller.largest_bandwidth_hz, "why": controller.explanation,
        "structure": case.spec.structure + ("+notch" if case.spec.notch else ""), "objective": case.spec.objective,
        "bandwidth": case.spec.bandwidth_hz, "swing": case.swing,
    }  # fmt: skip


def recheck_refusals(count: int):
    """Yield of as many refusals whether another evolution finds a law that keeps the limits, which makes it wrong."""
    refused, number = 0, 0
    while refused < count:
        case, number = draw(np.random.default_rng((11, number))), number + 1
        plant, *others = case.plants
        started = time.process_time()
        controller = so.tune(plant, case.params, case.spec, dict(zip(["swing"], others, strict=False)))
        tuned_s = time.process_time() - started
        if controller.feasible:
            continue
        refused += 1
        judge, allowed = Judge(case, controller), 1.0 - case.spec.reserve
        answers, _ = search(case, judge, np.inf, number, generations=120)
        kept = [a for a in answers if judge.judge(a)[0][0] <= allowed * (1.0 + 1e-6)]
        wrong = any(stable(case, controller, answer) for answer in kept)
        print(f"{number - 1:4d} {case.spec.structure} {tuned_s:6.2f} s {'WRONG' if wrong else ''}", flush=True)
        yield wrong


def answer_requests(count: int) -> None:
    """Print how many of the tests' random requests end in a defect, and the processor time of the refusals."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from tests.control.tuning.drawn_requests import draw_request

    defects, times = 0, []
    for seed in range(count):
        request, started, how = draw_request(np.random.default_rng(seed)), time.process_time(), "refused"
        try:
            controller = request.tune()
        except SeaoptError:
            how = "not possible"
        except InternalError as error:
            how, defects = f"DEFECT {error}", defects + 1
        else:
            how = "feasible" if controller.feasible else "refused"
        spent = time.process_time() - started
        times += [spent] * (how == "refused")
        print(f"{seed:4d} {spent:6.2f} s {how}", flush=True)
    print(f"{count} requests, {defects} defects; processor time of {len(times)} refusals: median "
          f"{np.median(times):.2f} s, 95 % {np.percentile(times, 95):.2f} s, largest {max(times):.2f} s, "
          f"{sum(t > 5.0 for t in times)} above 5 s")  # fmt: skip


def beside_mixsyn(bandwidth_hz: float = 30.0, ms: float = 1.6, noise_gain: float = 60.0) -> None:
    """Print THOR's stand under a tuned pid and under mixed sensitivity synthesis.

    The latter is continuous (mixsyn does not know a sample time): hold and delay are a second-order Pade, abs(S) is
    to stay below ms and, below a corner, to fall to 1e-4; abs(KS) below noise_gain. No bandwidth can be asked for: the
    corner is the highest with which both are kept (gamma = 1).
    """
    import control

    plant, params = so.plants.high_impedance(), so.plants.thor()
    spec = so.ControllerSpec(bandwidth_hz=bandwidth_hz, max_sensitivity=ms, max_noise_gain=noise_gain)
    started = time.process_time()
    found = so.tune(plant, params, spec)
    tuned_s = time.process_time() - started
    model, gain = plant.linearize(params), command_of(plant, params, "F1").per_effort
    row = list(plant.outputs).index(spec.measured)
    given = control.ss(model.A, gain * model.B[:, [0]], model.C[[row]], gain * model.D[[row], :1])
    late = control.tf2ss(*control.pade((0.5 + spec.compute_delay_samples) * spec.sample_time_s, 2))
    low, high = 0.1, 100.0
    started = time.process_time()
    while high / low > 1.01:
        corner = np.sqrt(low * high)
        w1 = control.tf([1 / ms, 2 * np.pi * corner], [1, 2e-4 * np.pi * corner])
        made, _, (gamma, _) = control.mixsyn(given * late, w1=w1, w2=control.tf([1], [noise_gain]))
        if gamma <= 1.0:
            low, law = corner, made
        else:
            high = corner
    made_s = time.process_time() - started
    f = np.geomspace(1e-3, 1e4, 20_000)
    s = 2j * np.pi * f
    p = control.frequency_response(given, 2 * np.pi * f).complex * np.exp(-s * (0.5 + spec.compute_delay_samples) / 1e3)
    k = control.frequency_response(law, 2 * np.pi * f).complex
    sensitivity = 1 / (1 + p * k)
    t = np.abs(p * k * sensitivity)
    under = np.flatnonzero(t < t[0] / np.sqrt(2))
    inside = (f >= LOWEST_HZ) & (f <= bandwidth_hz)
    tuned = np.abs(found.close(plant, params).sensitivity(f[inside]))
    rejected = [np.trapezoid(size, np.log(f[inside])) for size in (tuned, np.abs(sensitivity)[inside])]
    a, slow = found.achieved, f[np.argmax(np.abs(sensitivity) > np.sqrt(0.5))]
    print(f"{'':12}{'Hz':>7}{'Ms':>7}{'noise gain':>12}{'|S| < -3 dB to':>16}{'int |S| dlnf':>14}{'order':>7}"
          f"{'fastest pole':>14}{'cpu s':>7}")  # fmt: skip
    print(f"{'so.tune pid':12}{a.bandwidth_hz:7.2f}{a.ms:7.3f}{a.noise_gain:12.1f}{a.sensitivity_bandwidth_hz:13.2f} Hz"
          f"{rejected[0]:14.3f}{found.law.c.size:7d}{'discrete':>14}{tuned_s:7.2f}")  # fmt: skip
    print(f"{'mixsyn':12}{f[under[0]] if under.size else np.nan:7.2f}{np.abs(sensitivity).max():7.3f}"
          f"{np.abs(k * sensitivity).max():12.1f}{slow:13.2f} Hz{rejected[1]:14.3f}{law.nstates:7d}"
          f"{np.abs(law.poles()).max():14.3g}{made_s:7.2f}, corner {low:.3g} Hz")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (("cases", 40), ("seed", 1), ("times", 50.0), ("only", -1), ("mixsyn", 0), ("refusals", 0),
                          ("requests", 0)):  # fmt: skip
        parser.add_argument(f"--{name}", type=type(default), default=default)
    args = parser.parse_args()
    if args.mixsyn:
        beside_mixsyn()
        return
    if args.requests:
        answer_requests(args.requests)
        return
    if args.refusals:
        print(f"{sum(recheck_refusals(args.refusals))} of {args.refusals} refused wrongly")
        return
    rng = np.random.default_rng(args.seed)
    cases = [draw(rng) for _ in range(args.cases)]
    compare(cases[0], 0.0, 0)  # builds the programs once
    rows = []
    print(f"{'':>3} {'law':11} {'goal':5} {'Hz':>5} {'swing':5} {'tuned':>9} {'usage':>7} {'search':>9} {'usage':>7}"
          f" {'ratio':>7} {'cpu s':>6} {'looked at':>9}")  # fmt: skip
    for number, case in enumerate(cases):
        if args.only >= 0 and number != args.only:
            continue
        row = compare(case, args.times, number)
        rows.append(row)
        ratio = row["value"] / row["search_value"] if row["feasible"] and row["search_feasible"] else np.nan
        row["ratio"] = ratio
        row["bad"] = (
            ratio > 1.03 or (row["feasible"] and row["usage"] > 1.0 + 1e-4)
            or (row["search_feasible"] and not row["feasible"])
        )  # fmt: skip
        print(f"{number:3d} {row['structure']:11} {row['objective'][:5]} {row['bandwidth']:5.1f} {row['swing']!s:5} "
              f"{row['value']:9.4g} {row['usage']:7.4f} {row['search_value']:9.4g} {row['search_usage']:7.4f} "
              f"{ratio:7.4f} {row['tuned_s']:6.2f} {row['looked']:9d} {'BAD' if row['bad'] else ''} {row['why']}",
              flush=True)  # fmt: skip
    times = np.array([row["tuned_s"] for row in rows])
    ratios = np.array([row["ratio"] for row in rows if np.isfinite(row["ratio"])])
    print(f"{len(rows)} cases, {sum(row['feasible'] for row in rows)} feasible, {sum(row['bad'] for row in rows)} bad; "
          f"processor time of a tune: median {np.median(times):.3f} s, largest {times.max():.2f} s")  # fmt: skip
    if ratios.size:
        print(f"objective over the search's: median {np.median(ratios):.4f}, largest {ratios.max():.4f}, "
              f"least {ratios.min():.4f}")  # fmt: skip


if __name__ == "__main__":
    main()
