"""What feedforward of the link's motion and a prefilter win and cost: THOR's swing, times, and a long global search.

    python benchmarks/bench_link_feedforward.py [--times 40] [--cases 40] [--prefilter 40]

First THOR at 30 Hz: where references are followed on the swing, with and without feedforward, and with parameters other
than those the path is made of. `--times` tunes random specifications with both options; `--cases` compares the
objective of laws with both, and `--prefilter` of laws with a prefilter alone, with scipy's differential evolution, on
equations of motion, hold and law that are written here. Both sides have the limits less the tuner's reserve, and the
path that the tuner chose; both laws are then judged on ten times as many frequencies, and the tuner's under the limits
as they are asked, with the eigenvalues of loops assembled from its gains.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import expm
from scipy.optimize import differential_evolution
from scipy.signal import tf2ss

import seaopt as so
from seaopt.control import LinkFeedforward
from seaopt.control.loops.compensation.link_feedforward import LinkPath

TS = 1e-3
SEARCHED, JUDGED, GENERATIONS, SEEDS = 200, 3000, 400, (1,)
PREFILTERS = ("", "first_order", "second_order")
STAND, SWING, THOR = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25, min_sensitivity_bandwidth_hz=6)


def report_band(name: str, controller: so.Controller, **changes: float) -> None:
    """Print where the swing follows, and its peaks, with parameters other than the path's."""
    params = THOR.update(**changes)
    swing, stand = controller.close(SWING, params).figures(), controller.close(STAND, params).figures()
    low, high = swing.tracking_band_hz or (np.nan, np.nan)
    other = f"{1e-6 * stand.other_noise_gains[0]:.3g} N/um" if stand.other_noise_gains else ""
    fraction = "" if controller.link is None else f"{controller.link.fraction:.2f}"
    print(
        f"{name:38s} {fraction:5s} {low:5.2f} to {high:5.2f} Hz  Ms {swing.ms:.3f}  stand: Ms {stand.ms:.3f}, "
        f"|S| to {stand.sensitivity_bandwidth_hz:.1f} Hz  {other}  {'met' if controller.feasible else 'NOT MET'}"
    )


def compare_thor() -> None:
    """Print THOR with and without the path, and with errors of the model."""
    bare = so.tune(STAND, THOR, SPEC, {"swing": SWING})
    report_band("no feedforward", bare)
    for name, asked in (
        ("default", LinkFeedforward()), ("no high-pass", LinkFeedforward(high_pass_hz=0.0)),
        ("corner 100 Hz", LinkFeedforward(corner_hz=100.0)), ("corner 20 Hz", LinkFeedforward(corner_hz=20.0)),
        ("fraction 0.5", LinkFeedforward(fraction=0.5)),
    ):  # fmt: skip
        report_band(name, so.tune(STAND, THOR, replace(SPEC, link_feedforward=asked), {"swing": SWING}))
    fed = so.tune(STAND, THOR, replace(SPEC, link_feedforward=LinkFeedforward()), {"swing": SWING})
    J, b_r = THOR["J"].value, THOR["b_r"].value
    for share in (0.8, 0.9, 1.1, 1.2):
        report_band(f"default, J and b_r times {share}", fed, J=share * J, b_r=share * b_r)
    for I_p in (0.2, 0.6):
        report_band(f"default, I_p {I_p}", fed, I_p=I_p)


def draw_case(rng: np.random.Generator, feed_link: bool = True) -> tuple[so.ParameterSet, so.ControllerSpec]:
    """Return an actuator and a specification, with the link fed forward, or with a prefilter alone."""
    params = THOR.update(
        J=3.31e-6 * rng.uniform(0.6, 1.6), b_r=1.31e-4 * rng.uniform(0.6, 1.6), k=655e3 * rng.uniform(0.6, 1.6),
        I_p=rng.uniform(0.25, 0.8), m=rng.uniform(2.0, 6.0),
    )  # fmt: skip
    spec = replace(
        SPEC, bandwidth_hz=float(rng.uniform(16.0, 40.0)), max_sensitivity=float(rng.uniform(1.5, 1.9)),
        max_noise_gain=float(rng.uniform(25.0, 60.0)), min_sensitivity_bandwidth_hz=None,
        prefilter=str(rng.choice(PREFILTERS[1 - feed_link :])) or None,
        link_feedforward=LinkFeedforward() if feed_link else None,
        reference_weights=str(rng.choice(["tuned", "error"])),
    )  # fmt: skip
    return params, spec


def measure_times(count: int) -> None:
    """Print the processor time of one tune with both options."""
    rng, spent, met = np.random.default_rng(1), [], 0
    for _ in range(count):
        params, spec = draw_case(rng)
        start = time.process_time()
        met += so.tune(STAND, params, spec, {"swing": SWING}).feasible
        spent.append(time.process_time() - start)
    print(
        f"{count} tunes with both options: median {np.median(spent):.2f} s of processor time, 90 % below "
        f"{np.quantile(spent, 0.9):.2f} s, longest {max(spent):.2f} s; {met} met"
    )


class Judge:
    """Limits and objective of laws on stand and swing, from the equations of motion, by NumPy alone.

    A law is (k_p, k_i, k_d, T_f, k_r, c, corner of the prefilter in Hz, its damping).
    """

    def __init__(self, params: so.ParameterSet, spec: so.ControllerSpec, link: LinkPath | None) -> None:
        self.spec, self.link = spec, link
        self.values = {name: params[name].value for name in params}
        self.models = [make_motion(self.values, free) for free in (False, True)]
        self.look(SEARCHED)

    def look(self, count: int) -> None:
        """Look at this many frequencies, and others where limits begin, end, or are sharp."""
        b, v = self.spec.bandwidth_hz, self.values
        free_link = np.sqrt(v["m"] * v["g"] * v["L"] / v["I_p"]) / (2 * np.pi)
        marks = [0.1, b, 0.97 * b, 1.03 * b, b / 3, b / 5, 3 * b]
        self.f = np.unique(np.r_[np.geomspace(0.01, 499.9, count), np.linspace(0.5, 4 * b, count // 3),
                                 free_link * np.linspace(0.9, 1.1, count // 10), marks])  # fmt: skip
        self.q = np.exp(-2j * np.pi * self.f * TS)
        self.p, self.p_x = np.array([respond(*model, self.q) for model in self.models]).transpose(1, 0, 2)
        self.path = np.zeros_like(self.q)
        if self.link is not None:
            num, den = make_path(self.values, self.link)
            self.path = np.polyval(num, 1 / self.q) / np.polyval(den, 1 / self.q)
        inside = np.flatnonzero((self.f >= 0.1) & (self.f <= b * (1 + 1e-9)))
        step, self.weights = 0.5 * np.diff(np.log(self.f[inside])), np.zeros(self.f.size)
        self.weights[inside[:-1]] += step
        self.weights[inside[1:]] += step

    def respond(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return prefilter, C_r before it, and C_y of rows of x."""
        k_p, k_i, k_d, T_f, k_r, c, corner, damping = x.T[:, :, None]
        s = (1 - self.q) / (1 + self.q)
        rate, integral = (1 - self.q) / (T_f + TS - self.q * T_f), k_i * TS / 2 / s
        w, order = np.tan(np.pi * corner * TS), self.spec.prefilter
        low = {
            None: np.ones_like(w * s), "first_order": w / (s + w),
            "second_order": w**2 / (s**2 + 2 * damping * w * s + w**2),
        }[order]  # fmt: skip
        return low, k_r + integral + c * k_d * rate, k_p + integral + k_d * rate

    def place(self, x: np.ndarray) -> list[np.ndarray]:
        """Return both laws that have the bandwidth exactly, by k_r where that is tuned and by k_p where not."""
        at = int(np.argmin(np.abs(self.f - self.spec.bandwidth_hz)))
        p, rest = self.p[0, at], 1 - self.p_x[0, at] * self.path[at]
        if self.spec.reference_weights == "tuned":
            low, c_r, c_y = (part[:, at] for part in self.respond(x * [1, 1, 1, 1, 0, 1, 1, 1]))
            size = np.abs(rest + p * c_y) / (np.sqrt(2) * np.abs(p * low))
            with np.errstate(invalid="ignore"):
                half = np.sqrt(size**2 - c_r.imag**2)
            solved, changed = [-c_r.real + half, -c_r.real - half], [4]
        else:
            low, _, c_y = (part[:, at] for part in self.respond(x * [0, 1, 1, 1, 0, 1, 1, 1]))
            share, ahead, one = 2 * np.abs(p * low) ** 2, 1 + c_y, rest + p * c_y  # C_r = 1 + C_y
            square, linear = share - np.abs(p) ** 2, share * ahead.real - (p * one.conj()).real
            constant = share * np.abs(ahead) ** 2 - np.abs(one) ** 2
            with np.errstate(invalid="ignore", divide="ignore"):
                half = np.sqrt(linear**2 - square * constant)
                solved, changed = [(-linear + half) / square, (-linear - half) / square], [0, 4]
        out = []
        for number in solved:
            law = x.copy()
            law[:, changed] = number[:, None]
            law[:, 4] += 0.0 if self.spec.reference_weights == "tuned" else 1.0
            out.append(law)
        return out

    def judge(self, x: np.ndarray, keep: float) -> tuple[np.ndarray, np.ndarray]:
        """Return how much of a limit is used at most, beyond 1 for an unstable loop too, and the objective.

        `keep` is the share of a limit that may be used, as the tuner takes its reserve off (docs/theory/tuning.md).
        """
        spec, f, half, b = self.spec, self.f, np.sqrt(0.5), self.spec.bandwidth_hz * (1 + 1e-9)
        low, c_r, c_y = self.respond(np.where(np.isfinite(x), x, 0.0))
        one = (1 - self.p_x * self.path)[:, None] + self.p[:, None] * c_y
        size = 1 / np.abs(one)
        tracking = np.abs(self.p[0] * low * c_r) * size[0]
        used = [
            np.max(size, axis=(0, 2)) / (spec.max_sensitivity * keep),
            np.max(np.abs(one - 1) * size, axis=(0, 2)) / (1.3 * keep),
            np.max(tracking, axis=1) / (1.3 * keep),
            np.max(np.abs(c_y) * size[0], axis=1) / (spec.max_noise_gain * keep),
            np.max(size[0][:, f <= b / 5], axis=1) / (half * keep),
            10 ** (-keep / 20) / np.min(tracking[:, f <= b / 3], axis=1),
            half / np.min(tracking[:, f <= 0.97 * b], axis=1),
            np.max((tracking * (f / b) ** 0.25)[:, (f >= 1.0299 * b) & (f <= 3 * b)], axis=1) / (half * keep),
            2 * np.pi * 0.05 * (1 + x[:, 0]) / x[:, 1], 1 - x[:, 0], 1 - x[:, 4], x[:, 4] - x[:, 0],
            (1 + x[:, 0] - x[:, 4]) / (0.02 * (1 + x[:, 0] + x[:, 1] * 80 / spec.bandwidth_hz)),
        ]  # fmt: skip
        turn = np.unwrap(np.angle(one), axis=2)
        turned = np.min(turn[:, :, -1] - turn[:, :, 0], axis=0) < -0.3 * np.pi
        worst = np.where(turned, 1e3, np.nan_to_num(np.max(used, axis=0), nan=1e3, posinf=1e3))
        return worst, np.max(size @ self.weights, axis=0)

    def radius(self, law: np.ndarray) -> float:
        """Return the largest magnitude of an eigenvalue of both loops, assembled from the gains."""
        k_p, k_i, k_d, T_f = law[:4]
        feedback = sum_fractions(([k_p], [1.0]), (k_i * TS / 2 * np.array([1, 1]), [1, -1]),
                                 (k_d * np.array([1, -1]), [T_f + TS, -T_f]))  # fmt: skip
        parts = [(tf2ss(*feedback), -1.0)]
        if self.link is not None:
            parts.append((tf2ss(*make_path(self.values, self.link)), 1.0))
        return max(find_radius(model, parts) for model in self.models)

    def search(self, seed: int) -> tuple[float, np.ndarray]:
        """Return cost and law of the best that differential evolution finds, with the bandwidth solved for."""
        b = self.spec.bandwidth_hz
        low, high = np.log([[0.03, 0.1, 3e-4, TS, 0.3 * b, 0.4], [30.0, 1e3, 1.0, 4 / (2 * np.pi * b), 450.0, 2.0]])
        bounds = [*zip(low, high, strict=True), (0.0, 1.0)]

        def list_laws(z: np.ndarray) -> list[np.ndarray]:
            k_p, k_i, k_d, T_f, corner, damping = np.exp(z[:6])
            c = z[6] if self.spec.reference_weights == "tuned" else np.ones_like(k_p)
            return self.place(np.column_stack([k_p, k_i, k_d, T_f, 0 * k_p, c, corner, damping]))

        def price(law: np.ndarray) -> np.ndarray:
            worst, value = self.judge(law, 1.0 - self.spec.reserve)
            return np.log(value) + 30.0 * np.log(np.maximum(worst, 1.0))

        found = differential_evolution(
            lambda z: np.minimum(*map(price, list_laws(z))), bounds, popsize=14, maxiter=GENERATIONS, tol=1e-9,
            seed=seed, vectorized=True, updating="deferred", polish=False, init="sobol",
        )  # fmt: skip
        laws = list_laws(np.asarray(found.x)[:, None])
        return float(found.fun), min(laws, key=lambda law: float(price(law)[0]))


def make_motion(v: dict[str, float], free: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A and B of stand or swing under a motor force at 1 kHz, and the rows of F1 and x_2."""
    r, lever = v["l"] / (2 * np.pi * v["N_p"]), v["L_a"]
    mass = np.array([[v["J"] / r**2 + v["m_l"], v["m_l"] * lever], [v["m_l"] * lever, v["I_p"] + v["m_l"] * lever**2]])
    stiffness = v["k"] * np.outer([1.0, lever], [1.0, lever]) + np.diag([0.0, v["m"] * v["g"] * v["L"]])
    damping, rows = np.diag([v["b_r"] / r**2, 0.0]), np.array([[v["k"], v["k"] * lever], [0.0, lever]])
    n = 2 if free else 1
    mass, stiffness, damping, rows = mass[:n, :n], stiffness[:n, :n], damping[:n, :n], rows[:, :n]
    a = np.zeros((2 * n + 1, 2 * n + 1))
    a[:n, n : 2 * n] = np.eye(n)
    a[n : 2 * n, :n], a[n : 2 * n, n : 2 * n] = -np.linalg.solve(mass, stiffness), -np.linalg.solve(mass, damping)
    a[n : 2 * n, 2 * n] = np.linalg.inv(mass)[:, 0]
    held = expm(a * TS)
    return held[:-1, :-1], held[:-1, -1], np.hstack([rows, 0.0 * rows])


def make_path(v: dict[str, float], link: LinkPath) -> tuple[np.ndarray, np.ndarray]:
    """Return numerator and denominator, in z, of the path: drive's inertia and damping, low-pass and high-pass."""
    r, minus, plus = v["l"] / (2 * np.pi * v["N_p"]), np.array([1.0, -1.0]), np.array([1.0, 1.0])
    w, slow = (np.tan(np.pi * hz * TS) for hz in (link.corner_hz, link.high_pass_hz))
    twice, mixed, whole = np.convolve(minus, minus), np.convolve(minus, plus), np.convolve(plus, plus)
    effort = -v["J"] / r**2 * (2 / TS) ** 2 * twice - v["b_r"] / r**2 * (2 / TS) * mixed
    low_pass = twice + np.sqrt(2) * w * mixed + w**2 * whole
    return link.fraction * w**2 * np.convolve(effort, minus), np.convolve(low_pass, minus + slow * plus)


def respond(a: np.ndarray, b: np.ndarray, rows: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the outputs per command, one sample late."""
    inner = 1 / q[:, None, None] * np.eye(b.size) - a
    return (np.linalg.solve(inner, np.broadcast_to(b[:, None], (q.size, b.size, 1)))[:, :, 0] @ rows.T).T * q


def sum_fractions(*parts: tuple[Any, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return the sum of quotients of polynomials."""
    num, den = np.zeros(1), np.ones(1)
    for one, under in parts:
        num, den = np.polyadd(np.convolve(num, under), np.convolve(one, den)), np.convolve(den, under)
    return num, den


def find_radius(model: tuple[np.ndarray, ...], parts: list[tuple[Any, float]]) -> float:
    """Return the spectral radius of a plant with one sample of delay under the sum of state spaces of its outputs."""
    a, b, rows = model
    n, sizes = b.size, [law[0].shape[0] for law, _ in parts]
    step = np.zeros((n + 1 + sum(sizes),) * 2)
    step[:n, :n], step[:n, n] = a, b
    at = n + 1
    for ((f, g, h, d), sign), row, size in zip(parts, rows, sizes, strict=False):
        step[at : at + size, at : at + size], step[at : at + size, :n] = f, np.outer(g[:, 0], row)
        step[n, at : at + size] = sign * h[0]
        step[n, :n] += sign * d[0, 0] * row
        at += size
    return float(np.max(np.abs(np.linalg.eigvals(step))))


def compare_search(count: int, feed_link: bool) -> None:
    """Print the tuner's objective over that of a differential evolution in all numbers of the law but the path's."""
    rng, ratios, refused, lost = np.random.default_rng(2 if feed_link else 3), [], [], []
    for number in range(count):
        params, spec = draw_case(rng, feed_link)
        controller = so.tune(STAND, params, spec, {"swing": SWING})
        judge, g, b = Judge(params, spec, controller.link), controller.gains, spec.bandwidth_hz
        own = np.array([[g["k_p"], g["k_i"], g["k_d"], g["T_f"], g["k_r"], g["c"],
                         g.get("prefilter_corner_hz", b), g.get("prefilter_damping", 1.0)]])  # fmt: skip
        other = min((judge.search(seed) for seed in SEEDS), key=lambda found: found[0])[1]
        judge.look(JUDGED)
        (used,), (mine,) = judge.judge(own, 1.0)
        used = max(used, 1 + min(abs(law[0, 4] / own[0, 4] - 1) for law in judge.place(own)) - 0.01)
        (searched,), (value,) = judge.judge(other, 1.0 - spec.reserve)
        if controller.feasible and (used > 1.001 or judge.radius(own[0]) >= 1.0):
            refused.append(number)
        if controller.feasible and searched < 1.005:
            ratios.append(mine / value)
        elif searched < 1.0 and judge.radius(other[0]) < 1.0:
            lost.append(number)
        path = "" if controller.link is None else f"fraction {controller.link.fraction:.2f}, "
        met = "feasible" if controller.feasible else "not feasible"
        print(
            f"{number}: {path}{spec.prefilter or 'no prefilter'}, {met}, objective {mine:.4f} (usage {used:.4f}), "
            f"search {value:.4f} (usage {searched:.4f}), ratio {mine / value:.4f}",
            flush=True,
        )
    print(
        f"{len(ratios)} of {count} compared; objective over the search's: median {np.median(ratios):.4f}, worst "
        f"{max(ratios):.4f}, {sum(ratio <= 1.03 for ratio in ratios)} within 3 %; refused by the judge: "
        f"{refused or 'none'}; feasible to the search alone: {lost or 'none'}"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=0, help="random specifications to tune")
    parser.add_argument("--cases", type=int, default=0, help="cases to compare with a global search")
    parser.add_argument("--prefilter", type=int, default=0, help="cases of a prefilter alone to compare with it")
    asked = parser.parse_args()
    if not (asked.cases or asked.prefilter):
        compare_thor()
    if asked.times:
        measure_times(asked.times)
    for count, feed_link in ((asked.cases, True), (asked.prefilter, False)):
        if count:
            compare_search(count, feed_link)
