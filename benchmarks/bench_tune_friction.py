"""The tuner on random actuators with friction, against a global search: python benchmarks/bench_tune_friction.py

Each case draws a linear actuator on its stand with Coulomb friction, a bandwidth and a delay. It stands for two linear
plants, sliding and stuck, which share their law; what is asked is design.md's: Ms, Mt, reference peak and noise gain on
both, and on the sliding one the bandwidth, droop, no shoulder, and the band in which |S| stays below -3 dB. Plants,
laws and limits are written here again from the equations of motion, and share nothing with the product. scipy's
differential evolution searches k_p, k_i, k_d, T_f and c, k_r following from the bandwidth, with the least integral of
|S| as its goal. Options: --cases 20 --seed 1 --times 30 (of the tuner's processor time; 0: the tuner alone).
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm
from scipy.optimize import differential_evolution

import seaopt as so

LEAST_RATE = 2 * np.pi * 0.05  # rad/s, of k_i/(1 + k_p)
LIMITS = {"max_sensitivity": 1.6, "max_complementary": 1.3, "max_reference_peak": 1.3, "max_noise_gain": 25.0}
RANGE_HZ = (5.0, 60.0)
ISSUE = {
    "k": 120e3, "m_l": 0.9, "l": 0.005, "N_p": 1.0, "K_tau": 0.075, "J": 1.2e-5, "b_r": 2.5e-4, "eta": 0.86,
    "f_c": 25.0, "v_s": 0.004,
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """An actuator's parameters, the bandwidth asked, and the delay in samples at 1 kHz."""

    values: dict[str, float]
    bandwidth_hz: float
    delay_samples: int = 2

    @property
    def spec(self) -> so.ControllerSpec:
        return so.ControllerSpec(
            bandwidth_hz=self.bandwidth_hz,
            bandwidth_range_hz=RANGE_HZ,
            compute_delay_samples=self.delay_samples,
            **LIMITS,
        )

    def tune(self) -> so.Controller:
        return so.tune(so.plants.high_impedance(), so.plants.thor().update(**self.values), self.spec)


def draw(rng: np.random.Generator) -> Case:
    """Draw an actuator with a spring resonance of 6 to 40 Hz, and friction of a few to many newtons."""
    values = dict(ISSUE)
    for name, spread in (("k", 1.0), ("J", 0.8), ("b_r", 0.7), ("m_l", 0.5), ("f_c", 1.2), ("v_s", 0.7)):
        values[name] *= float(np.exp(rng.uniform(-spread, spread)))
    return Case(values, bandwidth_hz=float(rng.uniform(12.0, 45.0)), delay_samples=int(rng.integers(1, 3)))


class Judge:
    """Limits and objective of laws in NumPy alone, for many laws at once: columns k_p, k_i, k_d, T_f, w_r, w_c."""

    def __init__(self, case: Case, ts: float = 1e-3) -> None:
        self.case, self.ts, f_b = case, ts, case.bandwidth_hz
        self.f = np.unique(
            np.r_[
                np.geomspace(1e-3, 0.1, 40), np.geomspace(0.1, 0.4999 / ts, 700), f_b * np.linspace(0.3, 3.0, 150), f_b
            ]
        )
        self.at = int(np.argmin(np.abs(self.f - f_b)))
        self.q = np.exp(-2j * np.pi * self.f * ts)
        v = case.values
        radius = v["l"] / (2 * np.pi * v["N_p"])
        mass, damping = v["J"] / radius**2 + v["m_l"], v["b_r"] / radius**2
        held = [self.hold(mass, b, v["k"]) for b in (damping, damping + v["f_c"] / v["v_s"])]
        self.discrete = held
        self.p = [self.response(*one) for one in held]
        inside = np.flatnonzero((self.f >= 0.1) & (self.f <= f_b))
        self.weights = np.zeros(self.f.size)
        self.weights[inside] = np.gradient(np.log(self.f[inside]))
        self.weights[inside[[0, -1]]] *= 0.5

    def hold(self, mass, damping, k):
        """Return the sampled M q'' + b q' + k q = F, output k q."""
        block = np.zeros((3, 3))
        block[0, 1], block[1] = 1.0, np.array([-k, -damping, 1.0]) / mass
        whole = expm(block * self.ts)
        return whole[:2, :2], whole[:2, 2], np.array([k, 0.0])

    def response(self, a, b, c):
        values, vectors = np.linalg.eig(a)
        residues = (c @ vectors) * np.linalg.solve(vectors.astype(complex), b)
        return (residues / (1 / self.q[:, None] - values)).sum(axis=1) * self.q**self.case.delay_samples

    def law(self, numbers):
        """Return C_y, and C_r but for its weights k_r, and D."""
        k_p, k_i, k_d, t_f = (numbers[:, [i]] for i in range(4))
        rate = (1 - self.q) / (t_f + self.ts - self.q * t_f)
        whole = k_i * self.ts / 2 * (1 + self.q) / (1 - self.q)
        return k_p + whole + k_d * rate, 1.0 + k_p + whole + (k_d - numbers[:, [5]]) * rate

    def place(self, numbers):
        """Return the laws that have the bandwidth, one for each root w_r that is between k_r = 1 + k_p and 0."""
        c_y, c_r = (c[:, self.at] for c in self.law(numbers))
        p = self.p[0][self.at]
        size = np.abs(1 + p * c_y) / (np.sqrt(2) * np.abs(p))
        with np.errstate(invalid="ignore"):
            half = np.sqrt(size**2 - c_r.imag**2)
        out = []
        for sign in (-1, 1):
            one = numbers.copy()
            one[:, 4] = c_r.real + sign * half
            out.append(np.where((one[:, [4]] >= 0) & (one[:, [4]] <= 1 + one[:, [0]]), one, np.nan))
        return out

    def judge(self, numbers):
        """Return the largest usage of a limit, whether loops may be stable, and the objective."""
        f, f_b, count = self.f, self.case.bandwidth_hz, numbers.shape[0]
        c_y, c_r = self.law(numbers)
        c_r = c_r - numbers[:, [4]]
        worst, value, turned = np.zeros(count), np.zeros(count), np.zeros(count)
        for number, p in enumerate(self.p):
            one = 1 + p * c_y
            s, t = 1 / np.abs(one), np.abs(p * c_r / one)
            rows = [s / 1.6, np.abs(p * c_y) * s / 1.3, t / 1.3, np.abs(c_y) * s / 25.0]
            if number == 0:
                rows += [
                    s[:, f <= f_b / 5] * np.sqrt(2), 10 ** (-1 / 20) / t[:, f <= f_b / 3],
                    np.sqrt(0.5) / t[:, f < 0.97 * f_b], np.sqrt(2) * t[:, (f >= 1.03 * f_b) & (f <= 3 * f_b)],
                ]  # fmt: skip
            for row in rows:
                worst = np.maximum(worst, np.nan_to_num(row, nan=np.inf).max(axis=1))
            angle = np.unwrap(np.angle(one), axis=1)
            turned = np.minimum(turned, angle[:, -1] - angle[:, 0])
            value = np.maximum(value, s @ self.weights)
        return worst, turned > -0.3 * np.pi, value

    def radius(self, numbers) -> float:
        """Return the largest magnitude of an eigenvalue of both loops, from the characteristic polynomial."""
        k_p, k_i, k_d, t_f = numbers[:4]
        alpha, ts = t_f / (t_f + self.ts), self.ts
        den = np.convolve([1, -1], [1, -alpha])
        num = (
            k_p * den
            + k_i * ts / 2 * np.convolve([1, 1], [1, -alpha])
            + k_d / (t_f + ts) * np.convolve([1, -1], [1, -1])
        )
        out = 0.0
        for a, b, c in self.discrete:
            under = np.poly(a)
            over = np.poly(a - np.outer(b, c)) - under
            left = np.convolve(den, np.r_[under, np.zeros(self.case.delay_samples)])
            right = np.convolve(num, over)
            right = np.r_[np.zeros(left.size - right.size), right]
            out = max(out, np.abs(np.roots(left + right)).max())
        return out


def search(judge: Judge, seconds: float, seed: int):
    """Return the best law of a differential evolution."""
    case = judge.case
    inverse = 1 / np.abs(judge.p[0][judge.at])
    w_b = 2 * np.pi * case.bandwidth_hz
    logs = [
        (0.02 * max(inverse, 1), 30 * max(inverse, 1)),
        (LEAST_RATE, 4 * w_b),
        (1e-3 * inverse / w_b, 30 * inverse / w_b),
    ]
    logs.append((judge.ts, 4 / w_b))
    bounds = [*(tuple(np.log(pair)) for pair in logs), (0.0, 1.0)]
    started, allowed = time.process_time(), 1.0 - case.spec.reserve

    def numbers_of(v):
        k_p, rate, k_d, t_f = np.exp(v[:4])
        return np.column_stack([k_p, rate * (1 + k_p), k_d, t_f, 0.0 * k_p, v[4] * k_d])

    def merit_of(numbers):
        worst, stable, value = judge.judge(np.nan_to_num(numbers))
        merit = np.log(value) + 20 * np.log(np.maximum(worst / allowed, 1.0)) + np.where(stable, 0.0, 50.0)
        return np.where(np.isnan(numbers[:, 4]), 200.0, merit)

    def cost(v):
        return np.fmin(*(merit_of(numbers) for numbers in judge.place(numbers_of(np.atleast_2d(v.T).T))))

    found = differential_evolution(
        cost, bounds, seed=seed, maxiter=100_000, popsize=12, tol=1e-9, polish=False, vectorized=True, init="sobol",
        updating="deferred", callback=lambda intermediate_result: time.process_time() - started > seconds,
    )  # fmt: skip
    laws = np.concatenate(judge.place(numbers_of(found.x[:, None])))
    return laws[np.argmin(merit_of(laws))]


def of_controller(controller: so.Controller):
    """Return a controller's numbers."""
    k_p, k_i, k_d, t_f, k_r, c = (controller.gains[name] for name in ("k_p", "k_i", "k_d", "T_f", "k_r", "c"))
    return np.array([k_p, k_i, k_d, t_f, 1 + k_p - k_r, (1 - c) * k_d])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (("cases", 20), ("seed", 1), ("times", 30.0)):
        parser.add_argument(f"--{name}", type=type(default), default=default)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    cases = [Case(ISSUE, f) for f in (10.0, 15.0, 20.0, 25.0, 30.0, 40.0)] + [draw(rng) for _ in range(args.cases)]
    cases[0].tune()  # builds the programs once
    times, worse = [], 0
    print(f"{'Hz':>6} {'f_c':>6} {'tuned':>8} {'usage':>7} {'search':>8} {'usage':>7} {'ratio':>7} {'cpu s':>6}")
    for number, case in enumerate(cases):
        started = time.process_time()
        controller = case.tune()
        times.append(time.process_time() - started)
        judge = Judge(case)
        law = of_controller(controller)
        (worst,), _, (value,) = judge.judge(law[None])
        row = f"{case.bandwidth_hz:6.1f} {case.values['f_c']:6.1f} {value:8.4f} {worst:7.4f}"
        if args.times:
            best = search(judge, args.times * max(times[-1], 0.5), number)
            (other_worst,), _, (other,) = judge.judge(np.nan_to_num(best)[None])
            possible = other_worst <= 1 + 1e-6 and judge.radius(best) < 1
            bad = bool(possible and (not controller.feasible or value > 1.03 * other))
            worse += bad
            row += f" {other:8.4f} {other_worst:7.4f} {value / other:7.4f}" + " BAD" * bad
        wrong = bool(controller.feasible and (worst > 1 + 1e-4 or judge.radius(law) >= 1))
        print(f"{row} {times[-1]:6.2f}{' WRONG' * wrong} {controller.explanation}", flush=True)
    print(f"processor time of a tune: median {np.median(times):.2f} s, largest {max(times):.2f} s; {worse} are worse")


if __name__ == "__main__":
    main()
