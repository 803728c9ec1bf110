"""What feedforward of the link's motion and a prefilter win and cost: THOR's swing, times, and a long global search.

    python benchmarks/bench_link_feedforward.py [--times 40] [--cases 40]

First THOR at 30 Hz: where references are followed on the swing, with and without feedforward, and with parameters other
than those the path is made of. `--times` tunes random specifications with both options; `--cases` compares the
objective with scipy's differential evolution, on equations of motion, hold and law that are written here.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from scipy.linalg import expm
from scipy.optimize import differential_evolution

import seaopt as so
from seaopt.control import LinkFeedforward

TS = 1e-3
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


def draw_case(rng: np.random.Generator) -> tuple[so.ParameterSet, so.ControllerSpec]:
    """Return an actuator and a specification."""
    params = THOR.update(
        J=3.31e-6 * rng.uniform(0.6, 1.6), b_r=1.31e-4 * rng.uniform(0.6, 1.6), k=655e3 * rng.uniform(0.6, 1.6),
        I_p=rng.uniform(0.25, 0.8), m=rng.uniform(2.0, 6.0),
    )  # fmt: skip
    spec = replace(
        SPEC, bandwidth_hz=float(rng.uniform(16.0, 40.0)), max_sensitivity=float(rng.uniform(1.5, 1.9)),
        max_noise_gain=float(rng.uniform(25.0, 60.0)), min_sensitivity_bandwidth_hz=None,
        prefilter=str(rng.choice(["first_order", "second_order"])), link_feedforward=LinkFeedforward(),
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
    """Limits and objective of laws on stand and swing, from the equations of motion, by NumPy alone."""

    def __init__(self, params: so.ParameterSet, spec: so.ControllerSpec, controller: so.Controller) -> None:
        self.spec, self.controller, bandwidth = spec, controller, spec.bandwidth_hz
        marks = [bandwidth, 0.97 * bandwidth, 1.03 * bandwidth, bandwidth / 3, bandwidth / 5, 3 * bandwidth]
        self.f = np.unique(np.r_[np.geomspace(0.01, 499.0, 500), np.linspace(0.3, 60.0, 300), marks])
        self.q = np.exp(-2j * np.pi * self.f * TS)
        values = {name: params[name].value for name in params}
        self.models = [make_motion(values, free) for free in (False, True)]
        self.p, self.p_x = np.array([respond(a, b, rows, self.q) for a, b, rows in self.models]).transpose(1, 0, 2)
        link = controller.link
        assert link is not None
        s = (1 - self.q) / (1 + self.q)
        w, slow = (np.tan(np.pi * hz * TS) for hz in (link.corner_hz, link.high_pass_hz))
        r = values["l"] / (2 * np.pi * values["N_p"])
        effort = -values["J"] / r**2 * (2 * s / TS) ** 2 - values["b_r"] / r**2 * (2 * s / TS)
        self.path = link.fraction * effort * w**2 / (s**2 + np.sqrt(2) * w * s + w**2) * s / (s + slow)
        self.weights = np.where(
            (self.f <= bandwidth * (1 + 1e-9)) & (self.f >= 0.1), np.gradient(np.log(self.f)), 0.0
        )  # fmt: skip

    def law(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return C_r and C_y of (k_p, k_i, k_d, T_f, share of k_r, c, corner in Hz, damping), rows of x."""
        k_p, k_i, k_d, T_f, share, c, corner, damping = x.T[:, :, None]
        q, s = self.q, (1 - self.q) / (1 + self.q)
        rate, integral = (1 - q) / (T_f + TS - q * T_f), k_i * TS / 2 * (1 + q) / (1 - q)
        w = np.tan(np.pi * corner * TS)
        first = self.spec.prefilter == "first_order"
        low = w / (s + w) if first else w**2 / (s**2 + 2 * damping * w * s + w**2)
        return low * (share * (1 + k_p) + integral + c * k_d * rate), k_p + integral + k_d * rate

    def judge(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how much of a limit is used at most, beyond 1 for an unstable loop too, and the objective."""
        spec, f, reserve = self.spec, self.f, 1.0 - self.spec.reserve
        c_r, c_y = self.law(x)
        rest = 1 - self.p_x * self.path
        one = rest[:, None] + self.p[:, None] * c_y
        s = 1 / one
        loop = one - 1
        tracking, half, b = np.abs(self.p[0] * c_r * s[0]), np.sqrt(0.5), spec.bandwidth_hz
        used = [
            np.max(np.abs(s), axis=(0, 2)) / (spec.max_sensitivity * reserve),
            np.max(np.abs(loop * s), axis=(0, 2)) / (1.3 * reserve), np.max(tracking, axis=1) / (1.3 * reserve),
            np.max(np.abs(c_y * s[0]), axis=1) / (spec.max_noise_gain * reserve),
            np.max(np.abs(s[0])[:, f <= b / 5], axis=1) / half,
            10 ** (-1 / 20) / np.min(tracking[:, f <= b / 3], axis=1),
            half / np.min(tracking[:, f <= 0.97 * b], axis=1),
            np.max((tracking * (f / b) ** 0.25)[:, (f >= 1.03 * b) & (f <= 3 * b)], axis=1) / half,
            1 + 20 * np.abs(np.log(tracking[:, np.argmin(np.abs(f - b))] / half)),
        ]  # fmt: skip
        turn = np.min([np.unwrap(np.angle(loop_one))[:, -1] - np.angle(loop_one)[:, 0] for loop_one in one], axis=0)
        worst = np.max(used, axis=0) + 50.0 * (turn < -0.3 * np.pi)
        return worst, np.max(np.abs(s) @ self.weights, axis=0)


def make_motion(v: dict[str, float], free: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A and B of stand or swing under a motor force at 1 kHz, and the rows of F1 and x_2."""
    r = v["l"] / (2 * np.pi * v["N_p"])
    lever = v["L_a"] if free else 0.0
    mass = np.array([[v["J"] / r**2 + v["m_l"], v["m_l"] * lever], [v["m_l"] * lever, v["I_p"] + v["m_l"] * lever**2]])
    stiffness = v["k"] * np.outer([1.0, lever], [1.0, lever]) + np.diag([0.0, v["m"] * v["g"] * v["L"]])
    a = np.zeros((5, 5))
    a[:2, 2:4] = np.eye(2)
    a[2:4, :2], a[2:4, 2:4] = -np.linalg.solve(mass, stiffness), -np.linalg.solve(mass, np.diag([v["b_r"] / r**2, 0.0]))
    a[2:4, 4] = np.linalg.solve(mass, [1.0, 0.0])
    held = expm(a * TS)
    return held[:4, :4], held[:4, 4], np.array([[v["k"], v["k"] * lever, 0.0, 0.0], [0.0, lever, 0.0, 0.0]])


def respond(a: np.ndarray, b: np.ndarray, rows: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the outputs per command, one sample late."""
    inner = 1 / q[:, None, None] * np.eye(4) - a
    return (np.linalg.solve(inner, np.broadcast_to(b[:, None], (q.size, 4, 1)))[:, :, 0] @ rows.T).T * q


def compare_search(count: int) -> None:
    """Print the tuner's objective over that of a differential evolution in all numbers of the law."""
    rng, ratios, refused = np.random.default_rng(2), [], 0
    for number in range(count):
        params, spec = draw_case(rng)
        controller = so.tune(STAND, params, spec, {"swing": SWING})
        if not controller.feasible:
            print(f"{number}: not feasible, {controller.explanation}")
            continue
        judge, g = Judge(params, spec, controller), controller.gains
        own = np.array([[g["k_p"], g["k_i"], g["k_d"], g["T_f"], g["k_r"] / (1 + g["k_p"]), g["c"],
                         g["prefilter_corner_hz"], g.get("prefilter_damping", 1.0)]])  # fmt: skip
        used, mine = judge.judge(own)
        refused += bool(used[0] > 1.003)
        value = search(judge)
        ratios.append(float(mine[0] / value))
        print(
            f"{number}: tuned {mine[0]:.4f} (usage {used[0]:.4f}), search {value:.4f}, ratio {ratios[-1]:.4f}",
            flush=True,
        )
    within = np.mean(np.array(ratios) <= 1.03)
    print(
        f"{len(ratios)} of {count} feasible, {refused} refused by the judge; objective over the search's: median "
        f"{np.median(ratios):.4f}, worst {max(ratios):.4f}, {100 * within:.0f} % within 3 %"
    )


def search(judge: Judge, generations: int = 350) -> float:
    """Return the least objective of a law that keeps the limits, by differential evolution."""
    b, tuned = judge.spec.bandwidth_hz, judge.spec.reference_weights == "tuned"
    bounds = [(-1.0, 1.3), (-0.5, 2.5), (-3.5, -0.3), (-3.0, np.log10(4 / (2 * np.pi * b))),
              (0.0, 1.0), (0.0, 1.0), (np.log10(0.3 * b), np.log10(450.0)), (np.log10(0.4), np.log10(2.0))]  # fmt: skip

    def cost(v: np.ndarray) -> np.ndarray:
        x = v.T.copy()
        x[:, [0, 1, 2, 3, 6, 7]] = 10 ** x[:, [0, 1, 2, 3, 6, 7]]
        if not tuned:
            x[:, 4:6] = 1.0
        x[:, 1] = np.maximum(x[:, 1], 2 * np.pi * 0.05 * (1 + x[:, 0]))
        worst, value = judge.judge(x)
        return np.where(worst > 1.0005, 10.0 + 10.0 * np.minimum(worst, 1e3), 0.0) + np.log(value)

    found = differential_evolution(
        cost, bounds, popsize=12, maxiter=generations, tol=1e-8, seed=1, vectorized=True, updating="deferred",
        polish=False, mutation=(0.4, 0.9),
    )  # fmt: skip
    return float(np.exp(found.fun)) if found.fun < 8.0 else np.inf


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=0, help="random specifications to tune")
    parser.add_argument("--cases", type=int, default=0, help="cases to compare with a global search")
    asked = parser.parse_args()
    compare_thor()
    if asked.times:
        measure_times(asked.times)
    if asked.cases:
        compare_search(asked.cases)
