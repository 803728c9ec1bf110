"""Random subjects, tuned and certified; those that pass are played here, by equations and matrices of this file's own.

    python benchmarks/subjects/run.py --seconds 900 --count 300 --seed 1

A subject is a machine (linear or rotary, with and without friction), a structure, its parts, a bandwidth, a rate and a
delay, one law or a schedule of two to five points, which is tuned until it is certified. Of a certified one nothing
may be unstable (eigenvalues of sample-by-sample matrices), over its limit of Ms or Mt by more than 0.5 % (a grid of
frequencies), or ringing (a step on the nonlinear plant, by Runge-Kutta's method), with friction stuck and sliding, at
parameters drawn here within what was certified. Of the package only the law's matrices are used, frozen where a
schedule is.
"""

from __future__ import annotations

import argparse
import collections
import json
import sys
import time
from typing import ClassVar

import numpy as np
from scipy.linalg import expm

import seaopt as so
from seaopt.control import LinkFeedforward, Notch, Prefilter, command_of
from seaopt.errors import SeaoptError
from seaopt.robustness import tune_certified

OVER, GRID, STEP_PERIODS = 1.005, 4000, 12
LONGER = 3  # times as long: what rings goes on, and the jolt of a friction that turns round does not
SPREAD = {"k_s": 0.03, "J_l": 0.08, "k": 0.03, "I_p": 0.08}  # what is drawn, as a share


class Rotary:
    """A motor, a gear, a spring, and a link that is held or swings: states theta_m, its rate, theta_l, its rate."""

    signals: ClassVar = {"tau_s": lambda p, x, swings: p["k_s"] * (x[0] / p["N"] - x[2] * swings),
               "thetad_m": lambda p, x, swings: x[1], "theta_m": lambda p, x, swings: x[0],
               "theta_l": lambda p, x, swings: x[2] * swings}  # fmt: skip
    regulated, speed, over = "tau_s", "thetad_m", "k_s"

    def __init__(self, rng):
        scale = lambda low=0.7, high=1.4: float(rng.uniform(low, high))  # noqa: E731
        self.values = {
            "N": 100.0, "K_tau": 0.0369 * scale(), "eta": 0.7, "J_m": 2.4e-5 * scale(), "b_r": 4e-4 * scale(),
            "k_s": 280 * scale(), "J_l": 0.25 * scale(), "d_l": 0.3 * scale(), "m": 4.0 * scale(), "L": 0.2,
            "g": 9.81, "f_c": 0.002 * scale() * (rng.random() < 0.5), "v_s": 1.0,
        }  # fmt: skip
        self.stand, self.swing = so.plants.rotary(link="locked"), so.plants.rotary(link="pendulum")
        self.params = self.swing.defaults.update(**self.values)
        self.size = 0.4  # N m, of a step

    @staticmethod
    def move(p, x, current, swings, friction):
        torque = p["k_s"] * (x[0] / p["N"] - x[2] * swings)
        push = p["K_tau"] * p["eta"] * current - p["b_r"] * x[1] - friction(p["f_c"], x[1]) - torque / p["N"]
        turn = torque - p["d_l"] * x[3] - p["m"] * p["g"] * p["L"] * np.sin(x[2])
        return np.array([x[1], push / p["J_m"], x[3] * swings, turn / p["J_l"] * swings])


class Linear:
    """A ball screw between a link that is held and one that is held or swings: q, its rate, phi, its rate."""

    signals: ClassVar = {"F1": lambda p, x, swings: p["k"] * (x[0] + p["L_a"] * np.sin(x[2]) * swings),
               "x_2": lambda p, x, swings: p["L_a"] * np.sin(x[2]) * swings}  # fmt: skip
    regulated, speed, over = "F1", None, "k"

    def __init__(self, rng):
        scale = lambda low=0.7, high=1.4: float(rng.uniform(low, high))  # noqa: E731
        thor = so.plants.thor()
        self.stand, self.swing = so.plants.high_impedance(), so.plants.moving_output()
        changed = {name: thor[name].value * scale() for name in ("K_tau", "J", "b_r", "k")}
        changed |= {"I_p": 0.36 * scale(), "m": 4.0 * scale(), "d": 0.5 * scale()}
        changed |= {"f_c": 60.0 * scale() * (rng.random() < 0.5), "v_s": 0.01}
        self.params = self.swing.complete(thor.update(**{k: v for k, v in changed.items() if k in thor}))
        missing = {k: v for k, v in changed.items() if k not in thor}
        self.params = self.params.given.update(**missing) if missing else self.params.given
        self.values = {name: one.value for name, one in self.swing.complete(self.params).items()}
        per_effort = command_of(self.stand, self.params, "F1").per_effort  # r/(eta K_tau)
        self.values["r"] = per_effort * self.values["eta"] * self.values["K_tau"]
        self.size = 60.0  # N

    @staticmethod
    def move(p, x, current, swings, friction):
        r, cos, sin = p["r"], np.cos(x[2]), np.sin(x[2])
        inertia, spring = p["J"] / r**2, p["k"] * (x[0] + p["L_a"] * sin * swings)
        push = p["eta"] * p["K_tau"] / r * current - p["b_r"] / r**2 * x[1] - friction(p["f_c"], x[1])
        weight = (-p["m"] * p["g"] * p["L"] * sin - p["d"] * x[3]) / p["I_p"]
        lever = p["L_a"] * swings
        # m_l (qdd + L_a cos phidd - L_a sin phid^2) = F2 - F1, M qdd = push - F2, I_p phidd = I_p weight - F2 L_a cos
        left = 1.0 + p["m_l"] * (1.0 / inertia + lever**2 * cos**2 / p["I_p"])
        right = spring + p["m_l"] * (push / inertia + lever * cos * weight - lever * sin * x[3] ** 2)
        other = right / left
        turn = weight - other * lever * cos / p["I_p"]
        return np.array([x[1], (push - other) / inertia, x[3] * swings, turn * swings])


def draw_subject(number, seed):
    """Return a machine, a specification, and the points of a schedule or none."""
    rng = np.random.default_rng([seed, number])
    machine = (Rotary if rng.random() < 0.55 else Linear)(rng)
    structures = ["pd", "pid", "pid", "pid_dob"] + (["cascade"] if machine.speed else [])
    structure = str(rng.choice(structures))
    measured = (machine.regulated, machine.speed) if structure == "cascade" else machine.regulated
    parts = {}
    if rng.random() < 0.25:
        parts["notch"] = Notch()
    if rng.random() < 0.3:
        parts["prefilter"] = Prefilter(order=str(rng.choice(["first_order", "second_order"])))
    if rng.random() < 0.25:
        parts["link_feedforward"] = LinkFeedforward()
    spec = so.ControllerSpec(
        measured=measured, structure=structure, bandwidth_hz=float(rng.uniform(15, 26)),
        max_sensitivity=float(rng.uniform(1.5, 1.9)), reserve=float(rng.choice([0.03, 0.05])),
        sample_rate_hz=float(rng.choice([500, 1000, 2000])), compute_delay_samples=int(rng.integers(0, 2)) or 1,
        current_limit_A=9.0, **parts,
    )  # fmt: skip
    value = machine.values[machine.over]
    points = np.linspace(0.8, 1.25, rng.integers(2, 6)) * value if rng.random() < 0.3 else None
    return machine, spec, points, rng


def linearise(machine, p, swings, slope, names):
    """Return A, b and the rows of what is read, at rest, with friction of a slope, by central differences."""
    kept = slice(None) if swings else slice(2)
    rub = lambda _, v: slope * v  # noqa: E731
    move = lambda x, u: machine.move(p, x, u, swings, rub)  # noqa: E731
    h = np.array([1e-6, 1e-6, 1e-6, 1e-6])
    a = np.array([(move(e * d, 0.0) - move(-e * d, 0.0)) / (2 * d) for e, d in zip(np.eye(4), h, strict=True)]).T
    c = np.array([
        [(machine.signals[n](p, e * d, swings) - machine.signals[n](p, -e * d, swings)) / (2 * d)
         for e, d in zip(np.eye(4), h, strict=True)] for n in names
    ])  # fmt: skip
    return a[kept, kept], move(np.zeros(4), 1.0)[kept], c[:, kept]


def measure(machine, controller, p, swings, slope):
    """Return the largest eigenvalue of the sampled loop, and the peaks of S and T."""
    law, ts, delay = controller.law, controller.sample_time_s, controller.compute_delay_samples
    a, b, c = linearise(machine, p, swings, slope, controller.signals)
    n, m = a.shape[0], law.a.shape[0]
    step = expm(np.block([[a, b[:, None]], [np.zeros((1, n + 1))]]) * ts)
    a, b = step[:n, :n], step[:n, n] * controller.command.per_effort
    size = n + delay + m
    whole = np.zeros((size, size))
    whole[:n, :n] = a
    into = slice(n + delay, size)
    effort = np.zeros(size)
    effort[:n], effort[into] = law.d[1:] @ c, law.c
    if delay:
        whole[:n, n] = b
        for i in range(delay - 1):
            whole[n + i, n + i + 1] = 1.0
        whole[n + delay - 1] = effort
    else:
        whole[:n] += np.outer(b, effort)
    whole[into, :n], whole[into, into] = law.b[:, 1:] @ c, law.a
    f = np.geomspace(0.05, 0.4999 / ts, GRID)
    z = np.exp(2j * np.pi * f * ts)
    eye_n, eye_m = np.eye(n), np.eye(m)
    plant = np.linalg.solve(z[:, None, None] * eye_n - a, np.broadcast_to(b[:, None], (f.size, n, 1)))
    plant = (c @ plant)[:, :, 0] * (z[:, None] ** -delay)
    back = law.d[1:]
    if m:
        inner = np.linalg.solve(
            z[:, None, None] * eye_m - law.a, np.broadcast_to(law.b[:, 1:], (f.size, m, c.shape[0]))
        )
        back = (law.c @ inner) + law.d[1:]
    loop = -np.sum(plant * back, axis=1)
    peak = float(np.max(np.abs(1.0 / (1.0 + loop))))
    return float(np.max(np.abs(np.linalg.eigvals(whole)))), peak, float(np.max(np.abs(loop / (1.0 + loop))))


def play(machine, controller, p, swings, periods=STEP_PERIODS):
    """Return what rings at the end of a step, over the step: the fast part, and how it grew over the last fifth."""
    law, ts, delay = controller.law, controller.sample_time_s, controller.compute_delay_samples
    n = int(periods / controller.spec.bandwidth_hz / ts)
    smooth = lambda level, v: level * np.tanh(v / p["v_s"])  # noqa: E731
    x, kept, queue, read = np.zeros(4), np.zeros(law.a.shape[0]), [0.0] * delay, np.zeros(n)
    parts = max(4, int(ts / 1e-4))
    for k in range(n):
        y = np.array([machine.signals[name](p, x, swings) for name in controller.signals])
        read[k] = y[0]
        given = np.concatenate([[machine.size], y])
        effort = law.c @ kept + law.d @ given
        kept = law.a @ kept + law.b @ given
        queue.append(float(np.clip(controller.command.per_effort * effort, -9.0, 9.0)))
        current, h = queue.pop(0), ts / parts
        for _ in range(parts):
            first = machine.move(p, x, current, swings, smooth)
            second = machine.move(p, x + h / 2 * first, current, swings, smooth)
            third = machine.move(p, x + h / 2 * second, current, swings, smooth)
            x = x + h / 6 * (first + 2 * second + 2 * third + machine.move(p, x + h * third, current, swings, smooth))
        if not np.all(np.isfinite(x)):
            return np.inf, np.inf
    window = n // 5
    slow = np.linalg.qr(np.vander(np.linspace(-1, 1, window), 3))[0]
    fast = [part - slow @ (slow.T @ part) for part in (read[-2 * window : -window], read[-window:])]
    before, last = (float(np.max(np.abs(part))) / machine.size for part in fast)
    return last, last / max(before, 1e-12)


def judge(machine, law_at, spec, places, ranges, rng):
    """Return the faults of a certified subject, in words."""
    faults = []
    limits = spec.level("max_sensitivity"), spec.level("max_complementary")
    for place in places:
        controller = law_at(place)
        for draw in range(4):
            p = dict(machine.values)
            for name, (low, high) in ranges.items():
                p[name] = float(rng.uniform(low, high)) if draw else p[name]
            if place is not None:
                p[machine.over] = place
            for swings in (0.0, 1.0):
                for slope in {0.0, p["f_c"] / p["v_s"]}:
                    radius, ms, mt = measure(machine, controller, p, swings, slope)
                    where = f"swings {swings:g}, slope {slope:.3g}, draw {draw}, at {place}"
                    if radius >= 1.0 + 1e-9:
                        faults.append(f"unstable: {radius:.6f}, {where}")
                    for name, peak, limit in (("Ms", ms, limits[0]), ("Mt", mt, limits[1])):
                        if limit is not None and peak > OVER * limit:
                            faults.append(f"{name} {peak:.4f} of {limit:.4f}, {where}")
                if draw < 2:
                    last, growth = play(machine, controller, p, swings)
                    if not last < 0.02 and not growth < 0.7:
                        last, growth = play(machine, controller, p, swings, LONGER * STEP_PERIODS)
                    if not last < 0.02 and not growth < 0.7:
                        faults.append(f"rings: {last:.3g} of the step, {growth:.2f} times before, {where}")
    return faults


def run_subject(number, seed):
    """Return what became of a subject, and its faults."""
    machine, spec, points, rng = draw_subject(number, seed)
    kind = f"{type(machine).__name__} {spec.structure}{'' if points is None else ' schedule'}"
    plants = {"stand": machine.stand, "swing": machine.swing}
    ranges = {
        name: (value * (1 - share), value * (1 + share))
        for name, share in SPREAD.items()
        if (value := machine.values.get(name)) is not None and (points is None or name != machine.over)
    }
    options = {"ranges": ranges, "samples": 20, "seed": number + 1}
    try:
        if points is None:
            law = so.tune(machine.stand, machine.params, spec, robust_to={"swing": machine.swing})
            if not law.met:
                return kind, "limits not met", []
            certificate = so.certify(law, plants, machine.params, simulations=False, **options)
        else:
            of_points = {"over": machine.over, "points": points.tolist(), "rounds": 3}
            done = tune_certified(machine.stand, machine.params, spec, plants, **of_points, **options)
            law, certificate = done.controller, done.certificate
            if certificate is None:
                return kind, "limits not met", []
    except SeaoptError as error:
        return kind, f"refused: {str(error)[:90]}", []
    if not certificate.met:
        return kind, "not certified", []
    places = [None] if points is None else [points[0], *rng.uniform(points[0], points[-1], 2)]
    at = (lambda _: law) if points is None else law.at
    return kind, "certified", judge(machine, at, spec, places, ranges, rng)


def main():
    """Run subjects until the time is over, and print what came of them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=900.0)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--schedules", action="store_true", help="schedules alone")
    options = parser.parse_args()
    begin, came, kinds, bad = time.monotonic(), collections.Counter(), collections.Counter(), {}
    for number in range(options.first, options.first + options.count):
        if time.monotonic() - begin > options.seconds:
            break
        if options.schedules and draw_subject(number, options.seed)[2] is None:
            continue
        kind, what, faults = run_subject(number, options.seed)
        came[what] += 1
        kinds[f"{kind}: {what}"] += 1
        if faults:
            bad[number] = faults
        print(f"{number:4d} {time.monotonic() - begin:6.0f} s  {kind:28s} {what}  {'; '.join(faults[:2])}", flush=True)
    print(json.dumps({"subjects": sum(came.values()), "came": came, "kinds": kinds, "faults": bad}, indent=1))
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
