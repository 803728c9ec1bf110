"""The tuner's cascade against a long global search and an independent judge, and against a PID at the same limits.

    python benchmarks/bench_cascade.py [CASES]
    python benchmarks/bench_cascade.py knee

Random rotary actuators and specifications (Ms, Mt, reference peak, droop, noise gains, bandwidth, delay), on the stand
and with the shank free, friction sliding and stuck. Plants, laws, limits and objective are computed here by NumPy
alone: scipy's differential evolution, from several seeds, minimises the same objective under the limits that the tuner
has, less the same reserve, with the reference's weight from the bandwidth equation. In two things it is freer: its
frequencies are fewer, and it takes any T_v at which both integrals together are quick enough, the tuner only those
below 0.8 s. What `so.tune` calls feasible is judged on 4000 frequencies and by the eigenvalues of a loop that is
assembled from the gains. Times are of the processor. Speed loops are P in even cases and PI in odd ones. Each case is
printed as it ends. With `knee`: what speed loops win and cost on problems/knee.toml.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
from scipy.linalg import expm
from scipy.optimize import differential_evolution

import seaopt as so

STAND, SWING = so.plants.rotary(link="locked"), so.plants.rotary(link="pendulum")
KNEE = {"J_m": 2.4e-5, "b_r": 1e-4, "K_tau": 0.0369, "N": 100.0, "eta": 0.7, "k_s": 300.0, "f_c": 0.005, "v_s": 1.0,
        "J_l": 0.25, "d_l": 0.3, "m": 4.0, "L": 0.2}  # fmt: skip
KNEE_LIMITS = {"bandwidth_hz": 15.0, "max_sensitivity": 1.6, "max_complementary": 1.3, "max_reference_peak": 1.3,
               "max_noise_gain": 45.0}  # fmt: skip
INTEGRAL = 2 * np.pi * 0.05
RESERVE = 0.005  # that the tuner keeps on its limits
SEARCHED, GENERATIONS, SEARCHES = 160, 400, (1, 2, 3)
KEPT = 1.0001  # usage of a law that keeps the limits, in the search
OFFSET = 0.05  # of the rate 1/T_v in the search: below it there is no integral inside


class Case:
    """A rotary actuator, free and held, sliding and stuck, and a specification, as arrays of its own."""

    def __init__(
        self, values: dict[str, float], limits: dict[str, float], free: bool, delay: int = 1, speed_loop: str = "P"
    ) -> None:
        self.values, self.limits, self.free, self.delay, self.ts = values, limits, free, delay, 1e-3
        self.speed_loop = speed_loop
        steepest = values["f_c"] / values["v_s"]
        self.models = [self.discretise(link, slope) for link in (False, True)[: 1 + free] for slope in (0.0, steepest)]
        f_b = limits["bandwidth_hz"]
        marks = [f_b, f_b / 3, f_b / 5, 0.97 * f_b, 1.03 * f_b, 3 * f_b]
        self.f = np.unique(np.concatenate([np.geomspace(0.1, 499.0, SEARCHED), np.linspace(0.5, 4 * f_b, 50), marks]))
        self.see(self.f)

    @classmethod
    def draw(cls, seed: int) -> Case:
        """Return a random one about the knee."""
        rng = np.random.default_rng(seed)
        spread = {"J_m": 0.6, "b_r": 0.7, "k_s": 0.7, "f_c": 0.7, "J_l": 0.5, "d_l": 0.6, "m": 0.3}
        values = KNEE | {name: KNEE[name] * float(np.exp(rng.uniform(-s, s))) for name, s in spread.items()}
        limits = {
            "bandwidth_hz": float(rng.uniform(8.0, 25.0)), "max_sensitivity": float(rng.uniform(1.4, 1.9)),
            "max_complementary": float(rng.uniform(1.2, 1.6)), "max_reference_peak": float(rng.uniform(1.1, 1.4)),
            "max_noise_gain": float(np.exp(rng.uniform(np.log(10.0), np.log(80.0)))),
        }  # fmt: skip
        if rng.random() < 0.5:
            limits["max_other_noise_gain"] = float(np.exp(rng.uniform(np.log(100.0), np.log(1500.0))))
        return cls(values, limits, free=rng.random() < 0.7, delay=1 + int(rng.random() < 0.3),
                   speed_loop=("P", "PI")[seed % 2])  # fmt: skip

    @property
    def plants(self) -> dict[str, Any]:
        """What the law must hold on besides the stand."""
        return {"swing": SWING} if self.free else {}

    def spec(self, structure: str) -> so.ControllerSpec:
        """Return the specification."""
        measured = ("tau_s", "thetad_m") if structure == "cascade" else "tau_s"
        limits = {name: level for name, level in self.limits.items() if structure == "cascade" or "other" not in name}
        return so.ControllerSpec(
            structure=structure, measured=measured, speed_loop=self.speed_loop, compute_delay_samples=self.delay,
            bandwidth_range_hz=(3.0, 60.0), **limits,
        )  # fmt: skip

    def discretise(self, free: bool, slope: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return a, b and the rows of torque and motor position, per effort, with a friction of this slope."""
        v = self.values
        k, n, inertia, damping = v["k_s"], v["N"], v["J_m"], v["b_r"] + slope
        a = np.array([[0.0, 1.0], [-k / n**2 / inertia, -damping / inertia]])
        b, c = np.array([0.0, 1.0 / n / inertia]), np.array([[k / n, 0.0], [1.0, 0.0]])
        if free:
            stiffness, load = k + v["m"] * 9.81 * v["L"], v["J_l"]
            more = np.array([[0.0, 0.0, 0.0, 1.0], [k / n / load, 0.0, -stiffness / load, -v["d_l"] / load]])
            a = np.vstack([np.hstack([a, [[0.0, 0.0], [k / n / inertia, 0.0]]]), more])
            b, c = np.append(b, [0.0, 0.0]), np.hstack([c, [[-k, 0.0], [0.0, 0.0]]])
        size = b.size
        block = expm(np.block([[a, b[:, None]], [np.zeros((1, size + 1))]]) * self.ts)
        return block[:size, :size], block[:size, size], c

    def see(self, f: np.ndarray) -> None:
        """Look at the plants at these frequencies."""
        self.f, self.q = f, np.exp(-2j * np.pi * f * self.ts)
        self.seen = []
        for a, b, c in self.models:
            inner = 1.0 / self.q[:, None, None] * np.eye(b.size) - a
            x = np.linalg.solve(inner, np.broadcast_to(b[:, None].astype(complex), (f.size, b.size, 1)))[:, :, 0]
            self.seen.append((x @ c.T).T * self.q**self.delay)
        inside = f <= self.limits["bandwidth_hz"] * (1 + 1e-9)
        self.weights = np.zeros(f.size)
        step = 0.5 * np.diff(np.log(f[inside]))
        self.weights[np.flatnonzero(inside)[:-1]] += step
        self.weights[np.flatnonzero(inside)[1:]] += step

    def respond(self, x: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return C_y, C_v, the series part and the rest of C_r for numbers k_p, k_i, k_d, T_f, k_v, 1/T_v and c."""
        k_p, k_i, k_d, T_f, k_v, rate, c = (column[:, None] for column in x.T)
        integral, derivative = self.ts / 2 * (1 + self.q) / (1 - self.q), (1 - self.q) / (T_f + self.ts - T_f * self.q)
        series = 1.0 + rate * integral
        c_y = series * (k_p + k_i * integral + k_d * derivative)
        return (
            c_y,
            series * k_v * (1 - self.q) / self.ts,
            series,
            series * (k_i * integral + c * k_d * derivative) + 1.0,
        )

    def weigh(self, x: np.ndarray) -> np.ndarray:
        """Return both weights k_r of the reference that make the bandwidth; not a number where there is none."""
        c_y, c_v, series, rest = self.respond(x)
        at, (torque, position) = int(np.argmin(np.abs(self.f - self.limits["bandwidth_hz"]))), self.seen[0]
        radius = np.abs(1 + torque * c_y + position * c_v)[:, at] / np.sqrt(2) / np.abs(torque * series)[:, at]
        middle = (rest / series)[:, at]
        with np.errstate(invalid="ignore"):
            half = np.sqrt(radius**2 - middle.imag**2)
        return np.array([-middle.real + half, -middle.real - half])

    def judge(self, x: np.ndarray, k_r: np.ndarray, keep: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Return the largest usage of a limit, of each weight, and the objective, the integral of abs(S) over ln f.

        Of n laws, each with a column of weights.
        """
        c_y, c_v, series, rest = self.respond(x)
        lim, f, f_b, rate = self.limits, self.f, self.limits["bandwidth_hz"], x[:, 5]
        slow = np.where(rate > 0.0, 1.0 / (1.0 / np.maximum(rate, 1e-9) + x[:, 0] / x[:, 1]), x[:, 1] / (1 + x[:, 0]))
        used, objective = INTEGRAL / slow, np.zeros(len(x))
        tracked = 1.0 - (k_r + 1.0)

        def most(curve: np.ndarray, where: Any = slice(None)) -> None:
            nonlocal used
            used = np.maximum(used, np.max(curve[:, where], axis=1))

        for number, (torque, position) in enumerate(self.seen):
            distance = 1.0 + torque * c_y + position * c_v
            s = 1.0 / distance
            size = np.abs(s)
            turn = np.sum(np.angle(distance[:, 1:] * np.conj(distance[:, :-1])), axis=1)
            used = np.where(turn < -0.3 * np.pi, 1e3, used)  # an encirclement
            most(size / (keep * lim["max_sensitivity"]))
            most(np.abs(1.0 - s) / (keep * lim["max_complementary"]))
            objective = np.maximum(objective, size @ self.weights)
            if number >= 2:
                continue
            most(np.abs(c_y) * size / (keep * lim["max_noise_gain"]))
            if "max_other_noise_gain" in lim:
                most(np.abs(c_v) * size / (keep * lim["max_other_noise_gain"]))
            if number == 0:  # the stand, sliding
                most(size * np.sqrt(2.0) / keep, f <= f_b / 5 * (1 + 1e-9))
            for row, weight in enumerate(k_r):
                tracking = np.abs(torque * s * (series * weight[:, None] + rest))
                worst = [np.max(tracking, axis=1) / (keep * lim["max_reference_peak"])]
                if number == 0:
                    later = (f >= 1.03 * f_b * (1 - 1e-9)) & (f <= 3.0 * f_b * (1 + 1e-9))
                    worst += [
                        10 ** (-keep / 20) / np.min(tracking[:, f <= f_b / 3 * (1 + 1e-9)], axis=1),
                        np.sqrt(0.5) / np.min(tracking[:, f <= 0.97 * f_b * (1 + 1e-9)], axis=1),
                        np.max(tracking[:, later] * (f[later] / f_b) ** 0.25, axis=1) * np.sqrt(2.0) / keep,
                    ]
                tracked[row] = np.maximum(tracked[row], np.max(worst, axis=0))
        return np.nan_to_num(np.maximum(used, tracked), nan=1e3), objective

    def search(self) -> tuple[float, float, np.ndarray]:
        """Return usage, objective and numbers of the best law that differential evolution finds from any seed."""
        return min(map(self.evolve, SEARCHES), key=lambda found: (max(found[0], KEPT), found[1]))

    def evolve(self, seed: int) -> tuple[float, float, np.ndarray]:
        """Return the same of one seed: of laws that keep the limits the objective counts, of others the usage."""
        slowest = 4.0 / (2 * np.pi * self.limits["bandwidth_hz"])
        # k_p, the rate k_i/(1 + k_p), k_d/k_p, T_f, k_v and 1/T_v, as logarithms; and c
        low = np.array([*np.log([0.1, INTEGRAL, 1e-5, self.ts, 1e-3, OFFSET]), 0.0])
        high = np.array([*np.log([100.0, 500.0, 0.1, slowest, 3.0, 1.0 / self.ts]), 1.0])

        def unpack(z: np.ndarray) -> np.ndarray:
            x = np.column_stack([np.exp(z[:6].T), z[6]])
            x[:, 1] *= 1.0 + x[:, 0]
            x[:, 2] *= x[:, 0]
            x[:, 5] = np.where((x[:, 5] > 2 * OFFSET) & (self.speed_loop == "PI"), x[:, 5], 0.0)
            return x

        def weigh(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            k_r = self.weigh(x)
            used, value = self.judge(x, np.where(np.isfinite(k_r), k_r, 0.0), 1.0 - RESERVE)
            used = np.maximum(used, 1.0 + (k_r - x[:, 0]) / (1.0 + x[:, 0]))  # no more weight than feedback
            return np.min(np.where(np.isfinite(k_r), used, 1e2), axis=0), value

        def cost(z: np.ndarray) -> np.ndarray:
            used, value = weigh(unpack(z))
            return np.where(used <= KEPT, np.log(np.maximum(value, 1e-9)), 10.0 + np.log(used))

        found = differential_evolution(
            cost, list(zip(low, high, strict=True)), seed=seed, maxiter=GENERATIONS, popsize=14, tol=1e-10,
            polish=False, vectorized=True, updating="deferred", init="sobol",
        )  # fmt: skip
        x = unpack(np.asarray(found.x)[:, None])
        used, value = weigh(x)
        return float(used[0]), float(value[0]), x[0]

    def radius(self, gains: dict[str, float]) -> float:
        """Return the largest magnitude of an eigenvalue of all loops, assembled from the gains here."""
        return max(float(np.max(np.abs(np.linalg.eigvals(self.close(model, gains))))) for model in self.models)

    def close(self, model: tuple[np.ndarray, ...], gains: dict[str, float]) -> np.ndarray:
        """Return the closed loop's matrix: plant, delay, both integrals, the derivative's state, the last position."""
        (a, b, c), ts, n, rate = model, self.ts, model[1].size, 1.0 / gains.get("T_v", np.inf)
        size = n + self.delay + 4
        step, lag = np.zeros((size, size)), gains["T_f"] / (gains["T_f"] + ts)
        y, position, outer, slope, inner, last = np.zeros((6, size))
        y[:n], position[:n] = c[0], c[1]
        outer[n + self.delay], slope[n + self.delay + 1], inner[n + self.delay + 2], last[n + self.delay + 3] = np.ones(
            4
        )
        summed = outer - 0.5 * ts * y  # trapezoids: the state holds what came before, with half of the newest then
        change = slope - y / (gains["T_f"] + ts)
        wanted = -gains["k_p"] * y + gains["k_i"] * summed + gains["k_d"] * change
        error = wanted - gains["k_v"] * (position - last) / ts
        command = error + rate * (inner + 0.5 * ts * error)
        step[:n, :n] = a
        step[:n] += np.outer(b, np.eye(size)[n + self.delay - 1])
        step[n] = command
        for k in range(1, self.delay):
            step[n + k, n + k - 1] = 1.0
        step[n + self.delay] = outer - ts * y
        step[n + self.delay + 1] = lag * change + y / (gains["T_f"] + ts)
        step[n + self.delay + 2] = inner + ts * error
        step[n + self.delay + 3] = position
        kept = np.arange(size) != n + self.delay + 2 if rate == 0.0 else np.ones(size, dtype=bool)
        return step[kept][:, kept]

    def look(self, gains: dict[str, float]) -> tuple[float, float]:
        """Return usage and objective of a tuned law on 4000 frequencies; the usage is infinite of an unstable one."""
        searched = self.f
        marks = [self.limits["bandwidth_hz"] * share for share in (1.0, 1 / 3, 1 / 5, 0.97, 1.03, 3.0)]
        self.see(np.unique(np.concatenate([np.geomspace(0.1, 499.9, 4000), marks])))
        x = np.array([[gains["k_p"], gains["k_i"], gains["k_d"], gains["T_f"], gains["k_v"],
                       1.0 / gains.get("T_v", np.inf), gains["c"]]])  # fmt: skip
        used, value = self.judge(x, np.array([[gains["k_r"]]]))
        miss = min(abs(gains["k_r"] - float(one[0])) for one in self.weigh(x)) / (1.0 + gains["k_p"])
        self.see(searched)
        stable = self.radius(gains) < 1.0
        return (max(float(used[0, 0]), 1.0 + max(0.0, miss - 0.01)) if stable else np.inf), float(value[0])


def run(seed: int) -> dict[str, Any]:
    """Return what tuner, judge and search say of one case, and print it."""
    case = Case.draw(seed)
    params = SWING.defaults.update(**case.values)
    started = time.process_time()
    tuned = so.tune(STAND, params, case.spec("cascade"), case.plants)
    took = time.process_time() - started
    used, value = case.look(dict(tuned.gains))
    started = time.process_time()
    search_used, search_value, found = case.search()
    searched = search_used <= KEPT
    ratio = value / search_value if searched and tuned.feasible else np.nan
    gains = ", ".join(f"{name} {number:.3g}" for name, number in tuned.gains.items())
    print(f"{seed:4d} {case.speed_loop:2s} {'feasible' if tuned.feasible else 'not     '} {took:6.2f} s  usage "
          f"{used:.4f}  integral {value:.4f}  search {search_value:.4f} ({search_used:.4f}, "
          f"{time.process_time() - started:.0f} s)  ratio {ratio:.3f}  {gains}; found "
          f"{np.array2string(found, precision=3, max_line_width=200)}", flush=True)  # fmt: skip
    return {"seed": seed, "time": took, "feasible": tuned.feasible, "usage": used, "ratio": ratio, "searched": searched}


def report(rows: list[dict[str, Any]]) -> None:
    """Print what counts."""
    ratios = np.array([row["ratio"] for row in rows if np.isfinite(row["ratio"])])
    times = np.array([row["time"] for row in rows])
    kept = [row for row in rows if row["feasible"]]
    lost = [row["seed"] for row in rows if not row["feasible"] and row["searched"]]
    print(f"{len(rows)} cases, {len(kept)} feasible, {ratios.size} of these to the search; to the search alone: {lost}")
    soon = np.array([row["time"] for row in kept])
    print(f"processor time of a tune: median {np.median(times):.2f} s, largest {np.max(times):.2f} s; of a feasible "
          f"one {np.median(soon):.2f} s, {np.max(soon):.2f} s")  # fmt: skip
    print(f"objective over the search's: least {np.min(ratios):.4f}, median {np.median(ratios):.4f}, largest "
          f"{np.max(ratios):.4f}, within 3 %: {np.count_nonzero(ratios <= 1.03)} of {ratios.size}")  # fmt: skip
    print("refused by the judge:", [row["seed"] for row in kept if row["usage"] > 1.001] or "none")


def compare_knee() -> None:
    """Print what the speed loop wins and costs on the knee, at the same limits."""
    params = SWING.defaults.update(**KNEE)
    for structure, speed_loop in (("pid", "P"), ("cascade", "P"), ("cascade", "PI")):
        case = Case(KNEE, KNEE_LIMITS, free=True, speed_loop=speed_loop)
        tuned = so.tune(STAND, params, case.spec(structure), case.plants)
        gains = {"k_v": 0.0, **tuned.gains}
        if structure == "pid":
            gains["k_r"] -= 1.0  # beside the feedforward, as in a cascade
        used, value = case.look(gains)
        a = tuned.achieved
        others = ", ".join(f"{one:.4g} N m/rad" for one in a.other_noise_gains) or "none"
        print(f"{structure if structure == 'pid' else f'{structure} {speed_loop}':10s} integral of |S| {value:.4f}, "
              f"usage {used:.4f}, Ms {a.ms:.3f}, noise gain {a.noise_gain:.3g} (encoder: {others}), sensitivity "
              f"bandwidth {a.sensitivity_bandwidth_hz:.3g} Hz, delay margin {a.delay_margin_ms:.3g} ms, phase margin "
              f"{a.phase_margin_deg:.3g} deg")  # fmt: skip


def main() -> None:
    """Run the cases, or the knee."""
    if sys.argv[1:] == ["knee"]:
        compare_knee()
        return
    report([run(seed) for seed in range(int(sys.argv[1]) if len(sys.argv) > 1 else 40)])


if __name__ == "__main__":
    main()
