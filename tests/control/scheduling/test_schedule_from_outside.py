"""A scheduled pid against difference equations, a plant and frozen loops of the test's own.

The law is that of the design's structures, F_m = k_r r - k_p y + k_i I (r - y) + k_d D (c r - y), with gains on lines
between the points, and states that keep their meaning while these move: the sum so far as an effort, reference and
measurement as the derivative's filter has them. The plant is problems/lever_knee.toml by hand: a drive of inertia M
pulls a crank of length L_a through a spring, and the shank swings or is held.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.control import GainTable, ScheduledController
from seaopt.control.running.closed_loop import LoopState, SampledLoop, run_loop
from seaopt.control.running.law_step import list_kept
from seaopt.control.scheduling.scheduled_controller import freeze, place_variable
from tests.c_code import CompiledSchedule
from tests.schedules import read_knee

TS, LIMIT = 1e-3, 5.0  # s, A
GAINS = {
    "k_p": [60.0, 63.0, 74.0], "k_i": [2900.0, 2400.0, 1750.0], "k_d": [0.78, 0.75, 0.8], "T_f": [1e-3, 1.2e-3, 1.8e-3],
    "k_r": [66.0, 72.0, 91.0], "c": [0.6, 0.5, 0.35],
}  # fmt: skip
K_F, M, B, K, L_A, I_P, MGL, D = 240.0, 294.0, 11600.0, 655e3, 0.0725, 0.36, 11.8, 2.0


class OwnSchedule:
    """The scheduled law, sample by sample; gains by hand from the tuned points."""

    def __init__(self, schedule):
        self.points, self.fallback = schedule.points, schedule.fallback
        self.rows = [{name: row[i] for name, row in GAINS.items()} for i in range(len(self.points))]
        self.place, self.reference, self.measurement, self.total, self.current = self.fallback, 0.0, 0.0, 0.0, 0.0

    def find_gains(self, place):
        """Return the gains, and the share of the anti-windup: T_s/(T_t + T_s), T_t = k_r/k_i - T_s/2, at the points."""
        shares = [TS / (row["k_r"] / row["k_i"] + TS / 2) for row in self.rows]
        rows = [row | {"share": share} for row, share in zip(self.rows, shares, strict=True)]
        if place <= self.points[0] or place >= self.points[-1]:
            return rows[0 if place <= self.points[0] else -1]
        for (low, first), (high, last) in pairwise(zip(self.points, rows, strict=True)):
            if low <= place < high:
                t = (place - low) / (high - low)
                return {name: (1 - t) * first[name] + t * last[name] for name in first}
        raise AssertionError(place)

    def find_effort(self, g, r, y):
        """Return the effort, and what half a sample adds to the sum."""
        half = g["k_i"] * TS * (r - y) / 2
        rate = (g["c"] * (r - self.reference) - (y - self.measurement)) / (g["T_f"] + TS)
        return g["k_r"] * r - g["k_p"] * y + self.total + half + g["k_d"] * rate, half

    def reset(self, reference, measurement, place, current):
        self.place = place if math.isfinite(place) else self.fallback
        self.reference, self.measurement, self.total, self.current = reference, measurement, 0.0, current
        self.total = current * K_F - self.find_effort(self.find_gains(self.place), reference, measurement)[0]

    def step(self, r, y, place):
        self.place = place if math.isfinite(place) else self.place
        if not math.isfinite(r + y):
            return self.current
        g = self.find_gains(self.place)
        effort, half = self.find_effort(g, r, y)
        used = min(max(effort, -LIMIT * K_F), LIMIT * K_F)
        self.total += 2 * half + g["share"] * (used - effort)
        share = TS / (g["T_f"] + TS)
        self.reference += share * (r - self.reference)
        self.measurement += share * (y - self.measurement)
        self.current = used / K_F
        return self.current


def move_knee(x, current):
    """Return the rates of (q, v, phi, omega) of the swinging shank."""
    q, v, phi, omega = x
    force = K * (q - L_A * math.sin(phi))
    turn = (L_A * math.cos(phi) * force - MGL * math.sin(phi) - D * omega) / I_P
    return v, (K_F * current - B * v - force) / M, omega, turn


def step_knee(x, current, parts=5):
    """Return the state a sample later, by Runge-Kutta's method of fourth order in steps of a fifth of it."""
    add = lambda x, rate, h: [one + h * slope for one, slope in zip(x, rate, strict=True)]  # noqa: E731
    h = TS / parts
    for _ in range(parts):
        first = move_knee(x, current)
        second = move_knee(add(x, first, h / 2), current)
        third = move_knee(add(x, second, h / 2), current)
        last = move_knee(add(x, third, h), current)
        x = [
            one + h / 6 * (a + 2 * b + 2 * c + d) for one, a, b, c, d in zip(x, first, second, third, last, strict=True)
        ]
    return x


def rest_knee(phi):
    """Return the state at rest, the torque there, and the current that holds it."""
    torque = MGL * math.sin(phi)
    force = torque / (L_A * math.cos(phi))
    return [force / K + L_A * math.sin(phi), 0.0, phi, 0.0], torque, force / K_F


@pytest.fixture(scope="module")
def schedule():
    """Return a schedule whose gains all change, T_f and c among them; nothing is tuned."""
    stand, swing, values = read_knee()
    points, others = (0.1, 0.35, 0.6), {"swing": (swing, values)}
    spec = so.ControllerSpec(
        measured="tau", bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=LIMIT, compute_delay_samples=1
    )
    table = GainTable(
        over="phi", unit="rad", points=np.array(points), gains={name: np.array(row) for name, row in GAINS.items()},
        structure="pid", sample_time_s=TS,
    )  # fmt: skip
    controllers = tuple(freeze(table, point, spec, (stand, values), others)[0] for point in points)
    return ScheduledController(
        over="phi", unit="rad", points=points, controllers=controllers, others=others, fallback=0.35
    ).with_places()


@pytest.fixture(scope="module")
def swung(schedule):
    """Return references, torques, angles and currents of the swinging knee under the own law, a sample late."""
    x, torque, current = rest_knee(0.3)
    law, n = OwnSchedule(schedule), 1500
    law.reset(torque, torque, 0.3, current)
    k = np.arange(n)
    references = torque + 10.0 * np.cos(2 * np.pi * 0.9 * TS * k) + 60.0 * ((k // 40 % 10 == 3) & (k > 200))
    references -= 120.0 * ((k // 20 % 20 == 7) & (k > 200))
    out, waiting = np.zeros((n, 3)), current
    for row, reference in zip(out, references, strict=True):
        torque = L_A * math.cos(x[2]) * K * (x[0] - L_A * math.sin(x[2]))
        row[:] = torque, x[2], law.step(reference, torque, x[2])
        x, waiting = step_knee(x, waiting), row[2]
    return references, *out.T


def test_the_swinging_knee_is_where_an_own_simulation_has_it(schedule, swung):
    """The angle moves by itself through all of the table and beyond, the command saturates, and the gains follow."""
    references, torques, angles, currents = swung
    assert angles.min() < schedule.points[0] and angles.max() > schedule.points[-1]
    assert 0.05 < np.mean(np.abs(currents) == LIMIT) < 0.7
    _, swing, values = read_knee()
    x, torque, current = rest_knee(0.3)
    law = schedule.runnable()
    loop = SampledLoop(plant=swing, law=law, measured="tau", delay_samples=1, place="phi")
    kept = list_kept(law, law.reset(torque, torque, 0.3, current))
    start = LoopState(x=np.array([x]), z=np.array([[*kept, current]]))
    run = run_loop(loop, [values], references, start=start, rtol=1e-8)
    np.testing.assert_allclose(run.outputs["tau"][0], torques, atol=1e-5 * np.max(np.abs(torques)))
    np.testing.assert_allclose(run.states[0, :, 2], angles, atol=1e-6)
    np.testing.assert_allclose(run.current[0, 1:], currents[:-1], atol=1e-4 * LIMIT)  # a sample later


def test_the_compiled_law_commands_what_the_own_one_does(compiler, tmp_path, schedule, swung):
    """On the readings of that run, with some of them missing, from a reset to another torque and current."""
    references, torques, angles, _ = (one.copy() for one in swung)
    angles[100:110], angles[700], references[400], torques[401:404] = np.nan, np.inf, np.nan, np.inf
    own, python = OwnSchedule(schedule), schedule.runnable()
    for precision, share in (("double", 1e-11), ("float", 1e-3)):
        compiled = CompiledSchedule(compiler, tmp_path / precision, schedule, precision, allow_infeasible=True)
        for start in ((0.5, 0.2, math.nan, 1.0), (3.0, -2.0, 0.5, -4.0)):
            own.reset(*start)
            compiled.reset(*start)
            state, rows = python.reset(*start), []
            for sample in zip(references, torques, angles, strict=True):
                command, state = python.step(state, *sample)
                rows.append((own.step(*sample), command, compiled.step(*sample)))
            expected, found, flashed = np.array(rows).T
            np.testing.assert_allclose(found, expected, atol=1e-11 * LIMIT)
            np.testing.assert_allclose(flashed, expected, atol=share * LIMIT)


def close_own(schedule, place, swinging):
    """Return the largest eigenvalue of the own frozen loop, and the peaks of abs(S) and abs(T)."""
    arm, force = L_A * math.cos(place), MGL * math.tan(place) / L_A if swinging else 0.0
    a = np.zeros((4, 4))
    a[0, 1], a[1, :3], a[2, 3] = 1.0, [-K / M, -B / M, K * arm / M], 1.0
    c = np.array([arm * K, 0.0, -arm * arm * K - L_A * math.sin(place) * force, 0.0])
    a[3] = c / I_P - np.array([0.0, 0.0, MGL * math.cos(place), D]) / I_P
    kept = slice(None) if swinging else slice(2)
    a, c = a[kept, kept], c[kept]
    n = c.size
    block = np.zeros((n + 1, n + 1))
    block[:n, :n], block[1, n] = a, 1.0 / M
    step = expm(block * TS)
    a, b = step[:n, :n], step[:n, n]
    g = OwnSchedule(schedule).find_gains(place)
    alpha = 1.0 / (g["T_f"] + TS)
    loop = np.zeros((n + 3, n + 3))  # of plant, waiting effort, sum, and filtered measurement, the reference zero
    loop[:n, :n], loop[:n, n] = a, b
    loop[n, :n] = -(g["k_p"] + g["k_i"] * TS / 2 + g["k_d"] * alpha) * c
    loop[n, n + 1 :] = 1.0, g["k_d"] * alpha
    loop[n + 1, :n], loop[n + 1, n + 1] = -g["k_i"] * TS * c, 1.0
    loop[n + 2, :n], loop[n + 2, n + 2] = alpha * TS * c, 1.0 - alpha * TS
    poles, vectors = np.linalg.eig(a)
    left, right = c @ vectors, np.linalg.solve(vectors, b)
    z = np.exp(2j * np.pi * TS * np.geomspace(0.02, 499.0, 40000))
    plant = (left * right / (z[:, None] - poles)).sum(axis=1) / z
    difference = (1.0 - 1.0 / z) / (g["T_f"] + TS - g["T_f"] / z)
    feedback = g["k_p"] + g["k_i"] * TS / 2 * (z + 1.0) / (z - 1.0) + g["k_d"] * difference
    s = 1.0 / (1.0 + plant * feedback)
    return np.max(np.abs(np.linalg.eigvals(loop))), np.max(np.abs(s)), np.max(np.abs(1.0 - s))


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 0.75, 1.0])
def test_standing_still_its_figures_are_those_of_own_matrices(schedule, share):
    stand, swing, values = read_knee()
    for low, high in pairwise(schedule.points):
        place = low + share * (high - low)
        frozen, worst = schedule.at(place), []
        for plant, swinging in ((stand, False), (swing, True)):
            figures = frozen.close(plant, place_variable(plant, values, "phi", place)).figures()
            radius, ms, mt = close_own(schedule, place, swinging)
            assert (figures.spectral_radius, figures.ms, figures.mt) == pytest.approx((radius, ms, mt), rel=1e-5)
            worst.append((ms, mt))
            if not swinging:
                assert (frozen.achieved.spectral_radius, frozen.achieved.ms) == pytest.approx((radius, ms), rel=1e-5)
        for stated in schedule.between:
            if stated.value == place:
                assert (stated.ms, stated.mt) == pytest.approx(np.max(worst, axis=0), rel=1e-5)
    assert len(schedule.between) == 6
