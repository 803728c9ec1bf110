"""The tuner's problem with an outer loop, against matrices from sample to sample written here, and python-control."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import casadi as ca
import control
import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.control import Impedance, add_impedance, critical_impedance, sweep, tune_schedule
from seaopt.control.laws.command import command_of
from seaopt.control.running.fed_back import close_whole, split_states
from seaopt.control.tuning import interior_point, possible_bandwidths
from seaopt.control.tuning.convex_concave import linearise_law
from seaopt.control.tuning.found_law import meet_outer
from seaopt.control.tuning.frequencies import make_grid
from seaopt.control.tuning.optimisation_problem import SCOPES, Task
from seaopt.control.tuning.tuner import make_task
from seaopt.errors import ControlError
from seaopt.progress import ignore
from tests.hand_loops import find_peaks, respond

TS, T_V = 1e-3, 5e-3
HELD, KNEE, FREE = (so.plants.rotary(link) for link in ("locked", "pendulum", "free"))
VALUES = KNEE.defaults.update(
    N=100.0, K_tau=0.0369, eta=0.7, J_m=2.4e-5, b_r=1e-4, k_s=300.0, J_l=0.25, d_l=0.3, m=3.0, L=0.25, f_c=0.0, v_s=1.0
)
STAND, SWING = so.plants.high_impedance(), so.plants.moving_output()
THOR = so.plants.thor().update(d=4.0, f_c=0.0)
OF_KNEE = so.ControllerSpec(measured="tau_s", bandwidth_hz=15, max_sensitivity=1.6)
CASCADE = replace(OF_KNEE, structure="cascade", measured=("tau_s", "thetad_m"), prefilter="second_order")
ASKED = Impedance(stiffness=120.0, damping=6.0, velocity_filter_s=T_V)


def move_knee(v):
    """Return the joint's A and B of a current, and rows of torque, link, motor and motor's speed."""
    n, k, c, weight = v["N"], v["k_s"], v["c_s"], v["m"] * v["g"] * v["L"]
    a = np.array([
        [0, 1, 0, 0],
        [-k / n**2 / v["J_m"], -(v["b_r"] + c / n**2) / v["J_m"], k / n / v["J_m"], c / n / v["J_m"]],
        [0, 0, 0, 1],
        [k / n / v["J_l"], c / n / v["J_l"], -(k + weight) / v["J_l"], -(v["d_l"] + c) / v["J_l"]],
    ])  # fmt: skip
    rows = {"tau_s": [k / n, c / n, -k, -c], "theta_m": [1, 0, 0, 0], "thetad_m": [0, 1, 0, 0]}
    return a, np.array([0.0, v["eta"] * v["K_tau"] / v["J_m"], 0.0, 0.0]), np.eye(4)[2], rows


def move_swing(v):
    """The same of the linear actuator with a pendulum on link 2, of the screw's travel, its speed, angle and rate; the
    link is where the pendulum's lever ends, and feels the force the other way round.
    """
    r = v["l"] / (2 * np.pi * v["N_p"])
    heavy, arm, lug = v["J"] / r**2, v["L_a"], v["m_l"]
    inertia = np.array([[heavy + lug, lug * arm], [lug * arm, v["I_p"] + lug * arm**2]])
    spring, weight = v["k"] * np.array([1.0, arm]), v["m"] * v["g"] * v["L"]
    push = np.array([
        [-spring[0], -v["b_r"] / r**2, -spring[1], 0.0],
        [-arm * spring[0], 0.0, -arm * spring[1] - weight, -v["d"]],
    ])  # fmt: skip
    speeds = np.linalg.solve(inertia, push)
    a = np.array([[0, 1, 0, 0], speeds[0], [0, 0, 0, 1], speeds[1]])
    b = np.linalg.solve(inertia, [v["eta"] * v["K_tau"] / r, 0.0])
    return a, np.array([0.0, b[0], 0.0, b[1]]), arm * np.eye(4)[2], {"F1": [spring[0], 0.0, spring[1], 0.0]}


def close_by_hand(law, moving, signals, gain, around, sigma, waits=1):
    """Return the loop from disturbance of the command to command: of joint, waiting commands, law, and the filter of
    the link's speed.
    """
    a, b, link, outputs = moving
    whole = expm(np.block([[a, b[:, None]], [np.zeros((1, 5))]]) * TS)
    m, first = law.c.size, 4 + waits
    size = first + m + 1
    pole, rate = T_V / (T_V + TS), 1.0 / (T_V + TS)
    asked = np.zeros(size)
    asked[:4] = -sigma * (around.stiffness + around.damping * rate) * link
    asked[-1] = -sigma * around.damping
    reads = np.array([np.concatenate([outputs[name], np.zeros(size - 4)]) for name in signals])
    effort = law.d[0] * asked + law.d[1:] @ reads
    effort[first : first + m] += law.c
    rows, into = np.zeros((size, size)), np.zeros((size, 1))
    rows[:4, :4], rows[:4, 4] = whole[:4, :4], whole[:4, 4]
    for k in range(waits - 1):
        rows[4 + k, 5 + k] = 1.0
    rows[first - 1], into[first - 1] = gain * effort, gain
    rows[first : first + m, first : first + m] = law.a
    rows[first : first + m] += np.outer(law.b[:, 0], asked) + law.b[:, 1:] @ reads
    rows[-1, :4], rows[-1, -1] = (pole - 1.0) * rate * link, pole
    return control.ss(rows, into, effort[None], np.ones((1, 1)), TS)


def find_ms_and_mt(hand):
    return find_peaks(hand, lambda s: s, lambda s: 1.0 - s)


@cache
def make_case(name: str) -> Task:
    """Return a task without an outer loop, whose second plant has a link that moves."""
    if name in ("swing", "swing_dob"):
        spec = so.ControllerSpec(bandwidth_hz=20, structure="pid_dob" if name == "swing_dob" else "pid")
        return make_task(STAND, THOR, spec, {"swing": SWING})
    spec = {"knee": OF_KNEE, "late": replace(OF_KNEE, compute_delay_samples=2), "cascade": CASCADE}[name]
    return make_task(HELD, VALUES, spec, {"knee": KNEE})


def describe_case(name: str):
    """Return motion, command, direction of the outer loop, and the size of an impedance."""
    linear = name.startswith("swing")
    plant, values = (SWING, THOR) if linear else (KNEE, VALUES)
    v = {key: values[key].value for key in plant.parameters}
    moving, command = (move_swing if linear else move_knee)(v), command_of(plant, values, "F1" if linear else "tau_s")
    return moving, command, -1.0 if linear else 1.0, v["L_a"] ** -2 if linear else 1.0


@cache
def tune_force(*, linear: bool = False):
    """Return a force law of the actuator alone."""
    return so.tune(STAND, THOR, so.ControllerSpec(bandwidth_hz=20)) if linear else so.tune(HELD, VALUES, OF_KNEE)


def surround(name: str, around: Impedance, task: Task) -> Task:
    linear = name.startswith("swing")
    force = tune_force(linear=linear)
    whole = add_impedance(force, *((SWING, THOR) if linear else (KNEE, VALUES)), around)
    return task.enclosed(whole.outer, force.command.per_effort)


def draw_numbers(task, rng):
    """Return the numbers of a law that may be stable."""
    scale = 10.0 ** rng.uniform(-1.5, 0.7, 14)
    x = scale * np.array([1.0, 10.0, 0.02, 0.3, 0.01, 0.1, 1e-3, 1.0, 12.0, 0.1, 0.5, 0.5, 0.1, 0.7])
    x[8] = 0.0 if task.speed_loop is None or rng.random() < 0.5 else max(x[8], 4.0)
    x[3], x[4] = min(x[3], 1.0 + x[0]), min(x[4], x[2])
    return x


@pytest.mark.parametrize("name", ["knee", "late", "cascade", "swing", "swing_dob"])
def test_curves_figures_and_stability_are_those_of_the_loop_by_hand(name):
    """Of 40 random laws and impedances each."""
    rng, plain, f = np.random.default_rng(5), make_case(name), np.geomspace(0.02, 495.0, 300)
    moving, command, sigma, unit = describe_case(name)
    stable = 0
    for number in range(40):
        size = unit * (1.0 if number % 2 else 0.3)
        around = Impedance(
            stiffness=size * rng.uniform(0.0, 150.0), damping=size * rng.uniform(-1.0, 8.0), velocity_filter_s=T_V
        )
        task = surround_fast(name, around)
        x = draw_numbers(plain, rng)
        law, z = task.law_of(x), np.exp(2j * np.pi * f * TS)
        waits = task.spec.loop_delay_samples
        hand = close_by_hand(law, moving, task.signals, command.per_effort, around, sigma, waits)
        radius = np.max(np.abs(hand.poles()))
        loop = task.loop(x, 1)
        assert np.max(np.abs(loop.eigenvalues())) == pytest.approx(radius, abs=2e-8)
        grid = task.grid(f)
        at = task.respond(grid, x)
        np.testing.assert_allclose(1.0 / grid.plants.at(1).add_up(at.c_y, at.c_v, at.c_r), respond(hand, z), rtol=2e-6)
        held = grid.plants.at(0)
        np.testing.assert_array_equal(held.add_up(at.c_y, at.c_v, at.c_r), held.alone.add_up(at.c_y, at.c_v, at.c_r))
        if radius < 1.0 - 1e-6:
            stable += 1
            found = loop.figures()
            assert (found.ms, found.mt) == pytest.approx(find_ms_and_mt(hand), rel=1e-4)
    assert stable >= 7, stable
    np.testing.assert_allclose(respond(hand, z), hand(z), rtol=1e-8)  # python-control's own way


@cache
def direct(name: str):
    return surround(name, replace(ASKED, stiffness=1.0), make_case(name)).moved


def surround_fast(name: str, around: Impedance) -> Task:
    """Return a case's task with an impedance, its plants sampled once."""
    moved = direct(name)
    outer = replace(moved.outer, stiffness=around.stiffness, damping=around.damping)
    return replace(make_case(name), moved=replace(moved, outer=outer))


@pytest.mark.parametrize("name", ["knee", "cascade", "swing_dob"])
def test_gradients_are_exact(name, monkeypatch):
    """Of 1 + L, which is affine in the gains; and the interior point's constraints are the curves, with a slope that
    differences have.
    """
    task = surround(
        name,
        ASKED if name != "swing_dob" else Impedance(stiffness=2e4, damping=900.0, velocity_filter_s=T_V),
        make_case(name),
    )
    x = np.array([2.0, 30.0, 0.02, 0.5, 0.005, 0.3, 2e-3, 0.05, 12.0, 0.1, 0.5, 1.0, 0.08, 0.7])
    x[8] = x[8] if name == "cascade" else 0.0
    x, grid = task.tidy(x), make_grid(task)
    change = np.array([0.3, 2.0, 1e-3, 0.2, 1e-3, 0.05])[task.gains_tuned]
    moved = x.copy()
    moved[task.gains_tuned] += change
    at, before, after = linearise_law(task, grid, x), task.respond(grid, x), task.respond(grid, moved)
    distances = [grid.plants.add_up(law.c_y, law.c_v, law.c_r) for law in (before, after)]
    by = grid.plants.change(change @ at.by_y, change @ at.by_v, change @ at.by_r)
    np.testing.assert_allclose(distances[1] - distances[0], by, rtol=1e-7, atol=1e-11)

    asked = {}

    def catch(solver, **given):
        asked.update(given, solver=solver)
        return {"x": given["x0"]}

    monkeypatch.setattr(interior_point, "solve_ipopt", catch)
    chosen = interior_point._choose_points(task, grid, x)
    interior_point._solve(task, grid, x, chosen, 3.0)
    start, data = asked["x0"], asked["p"]
    constraints = asked["solver"].get_function("nlp_g")
    variables, given = ca.MX.sym("v", start.size), ca.MX.sym("p", data.size)
    slopes = ca.Function("slopes", [variables, given], [ca.jacobian(constraints(variables, given), variables)])
    usage = task.usage(grid, task.respond(grid, x))
    rows = np.concatenate([np.log(usage[kind].ravel()[chosen[kind]]) for kind in grid.levels])
    found = np.array(constraints(start, data)).ravel()[-rows.size :] + start[-1]
    np.testing.assert_allclose(found[rows > -5.0], rows[rows > -5.0], atol=1e-5)  # below, smoothing shows
    exact, step = np.array(slopes(start, data)), 1e-6
    for k in range(start.size - 2):
        ends = [np.array(constraints(start + sign * step * np.eye(start.size)[k], data)).ravel() for sign in (1, -1)]
        np.testing.assert_allclose(exact[:, k], (ends[0] - ends[1]) / (2 * step), rtol=1e-4, atol=1e-5)


def test_what_is_asked_of_the_design_plant_alone_is_asked_of_the_force_law():
    """Of one whose own link moves: bandwidth, noise and tracking are those without the outer loop, Ms and Mt with it;
    and so are those of a controller that is read again.
    """
    values = VALUES.update(m=6.0)
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=15, max_droop_db=False, max_reference_peak=False)
    task = make_task(KNEE, values, replace(spec, max_noise_gain=40.0), {})
    force = tune_force()
    around = add_impedance(force, KNEE, values, replace(ASKED, stiffness=30.0, damping=2.0)).outer
    closed, x = (
        task.enclosed(around, force.command.per_effort),
        np.array([2.0, 30.0, 0.02, 0.5, 0.005, 0.3, 2e-3, 0.05, 0.0, 0.1, 0.5, 1.0, 0.08, 0.7]),
    )
    grid, alone = closed.grid(np.geomspace(0.1, 400.0, 200)), task.grid(np.geomspace(0.1, 400.0, 200))
    law = closed.respond(grid, x)
    with_outer, without = closed.usage(grid, law), task.usage(alone, law)
    for curve in SCOPES["design plant"]:
        if curve in without:
            np.testing.assert_array_equal(with_outer[curve], without[curve])
    assert np.max(np.abs(with_outer["max_complementary"] - without["max_complementary"])) > 0.05
    (loop,), (force_alone,) = closed.measure(x), task.measure(x)
    assert loop.figures.bandwidth_hz == force_alone.figures.bandwidth_hz
    assert loop.figures.noise_gain == force_alone.figures.noise_gain
    assert loop.figures.mt == pytest.approx(closed.loop(x).figures().mt, rel=1e-9)
    assert abs(loop.figures.mt - force_alone.figures.mt) > 0.01


@cache
def tune_knee(around, spec=OF_KNEE):
    """Return a law tuned with the impedance."""
    return so.tune(HELD, VALUES, spec, {"knee": KNEE}, outer=lambda law: give_outer(around, law).outer)


@cache
def tune_alone():
    return so.tune(HELD, VALUES, OF_KNEE, {"knee": KNEE})


def give_outer(around, law):
    if not isinstance(around, Impedance):
        around = critical_impedance(law, KNEE, VALUES, around, velocity_filter_s=T_V)
    return add_impedance(law, KNEE, VALUES, around)


def measure_by_hand(law, around):
    moving, command, sigma, _ = describe_case("knee")
    hand = close_by_hand(law.law, moving, law.signals, command.per_effort, around, sigma)
    assert np.max(np.abs(hand.poles())) < 1.0
    return find_ms_and_mt(hand)


@pytest.mark.parametrize(
    ("around", "spec"),
    [
        (ASKED, OF_KNEE),
        (40.0, OF_KNEE),
        (ASKED, replace(OF_KNEE, structure="pid_dob", max_noise_gain=60.0)),
        (ASKED, replace(CASCADE, max_other_noise_gain=5.0)),
        (ASKED, replace(OF_KNEE, compute_delay_samples=1, drive_delay_s=0.4e-3)),
    ],
)
def test_a_law_keeps_its_limits_with_the_outer_loop(around, spec):
    """Which a pid tuned without does not; of critical damping the loop has its double pole."""
    law = tune_knee(around, spec)
    assert law.met and law.outer is not None and give_outer(around, law).outer == law.outer
    if spec.drive_delay_s is None:
        ms, mt = measure_by_hand(law, law.outer.impedance)
        assert ms <= 1.6 * (1 + 1e-4) and mt <= 1.3 * (1 + 1e-4)
    if spec is OF_KNEE:
        without = give_outer(around, tune_alone())
        assert max(measure_by_hand(without, without.outer.impedance)) > 1.3
    figures = close_whole(law, *place(law, KNEE)).figures()
    assert figures.ms <= 1.6 * (1 + 2e-6) and figures.mt <= 1.3 * (1 + 2e-6)
    held = law.close(HELD, law.delay(VALUES)).figures()
    assert held.bandwidth_hz == pytest.approx(15.0, rel=0.005) and held.mt <= 1.3 * (1 + 2e-6)


def place(law, plant):
    (shown,) = split_states(law, {"": plant}, VALUES).values()
    return shown, VALUES


def test_a_law_that_keeps_its_limits_with_the_outer_loop_is_left_as_it_is():
    law = tune_knee(replace(ASKED, stiffness=40.0, damping=2.0))
    assert law.met and law.gains == tune_alone().gains


def test_what_cannot_be_met_is_said_with_what_can():
    """Too little damping: the force loop alone would keep every limit. The bandwidth advised does keep them."""
    loose = replace(ASKED, stiffness=80.0, damping=1.0)
    law = tune_knee(loose)
    assert tune_alone().met and not law.met and "max_complementary" in law.explanation and law.possible is not None
    (nearest, *_) = law.possible.nearest_hz
    faster = tune_knee(loose, replace(OF_KNEE, bandwidth_hz=float(f"{nearest:.4g}")))
    assert faster.met
    assert max(measure_by_hand(faster, loose)) <= 1.6 * (1 + 1e-4)


def test_a_damping_at_a_link_that_nothing_holds_leaves_its_drift_out():
    """By hand an eigenvalue of 1, of where the link is, which no margin depends on."""
    loose = replace(ASKED, stiffness=0.0, damping=2.0)
    plants = {"free": FREE}
    force = tune_force()
    law = add_impedance(force, FREE, VALUES, loose)
    (shown,) = split_states(law, plants, VALUES).values()
    moving, command, sigma, _ = describe_case("knee")
    moving = move_knee({name: VALUES[name].value for name in VALUES} | {"m": 0.0})
    hand = close_by_hand(law.law, moving, law.signals, command.per_effort, loose, sigma)
    radii = np.sort(np.abs(hand.poles()))
    assert radii[-1] == pytest.approx(1.0, abs=1e-8) and radii[-2] < 0.9999
    found = close_whole(law, shown, VALUES).figures()
    assert found.stable and (found.ms, found.mt) == pytest.approx(find_ms_and_mt(hand), rel=1e-3)
    tuned = so.tune(HELD, VALUES, OF_KNEE, {"free": FREE}, outer=lambda _: law.outer)
    assert tuned.met and tuned.outer == law.outer


def test_a_schedule_keeps_its_limits_with_its_outer_loop():
    """At each point and between them, of the loop by hand."""
    points = [250.0, 300.0, 350.0]
    options = {"robust_to": {"knee": KNEE}, "outer": lambda one: give_outer(ASKED, one.controllers[0]).outer}
    schedule = tune_schedule(HELD, VALUES, OF_KNEE, "k_s", points, **options)
    assert schedule.met
    places = [*zip(points, schedule.controllers, strict=True), *((v, schedule.at(v)) for v in (262.5, 325.0))]
    for stiffness, law in places:
        assert law.outer == schedule.controllers[0].outer
        v = {name: VALUES[name].value for name in VALUES} | {"k_s": stiffness}
        hand = close_by_hand(law.law, move_knee(v), law.signals, law.command.per_effort, ASKED, 1.0)
        ms, mt = find_ms_and_mt(hand)
        assert ms <= 1.6 * (1 + 1e-4) and mt <= 1.3 * (1 + 1e-4)
    again = type(schedule).from_dict(schedule.to_dict(), HELD, VALUES, schedule.others)
    assert again.met and [place.broken for place in again.between] == [place.broken for place in schedule.between]


def test_a_sweep_is_of_laws_with_their_outer_loop():
    """Of what is tuned at that bandwidth alone; without, Mt is beyond its limit there."""
    found = sweep(HELD, VALUES, OF_KNEE, [15.0], {"knee": KNEE}, outer=lambda law: give_outer(ASKED, law).outer)
    (law,), (row,) = found.controllers, found.rows
    assert row.met and law.outer.impedance == ASKED
    ms, mt = measure_by_hand(law, ASKED)
    assert ms <= 1.6 * (1 + 1e-4) and mt <= 1.3 * (1 + 1e-4)
    assert row.ms == pytest.approx(max(ms, law.close(HELD, VALUES).figures().ms), rel=1e-3)
    assert law.gains == pytest.approx(tune_knee(ASKED).gains, rel=1e-2)


def test_an_outer_loop_that_is_refused_is_an_error(monkeypatch):
    def refuse(_):
        raise ControlError("no critically damped impedance")

    with pytest.raises(ControlError, match="critically"):
        so.tune(HELD, VALUES, OF_KNEE, {"knee": KNEE}, outer=refuse)
    monkeypatch.setattr(possible_bandwidths, "FARTHEST_BELOW", 1.01)  # what else could be had is another test's
    law = so.tune(HELD, VALUES, replace(OF_KNEE, max_noise_gain=1.0), {"knee": KNEE}, outer=refuse)
    assert not law.met and law.outer is None


class Steps:
    """What misses its limits by a number for each outer loop that it was measured with, and is not found better."""

    met, command = True, SimpleNamespace(per_effort=1.0)

    def __init__(self, missed, outer=None):
        self.misses, self.outer, self.missed = missed, outer, 0.0 if outer is None else missed[outer]

    def enclose(self, outer, _):
        return Steps(self.misses, outer)

    def follow(self, _, *, first):
        return Steps(self.misses, self.outer)


@pytest.mark.parametrize(("missed", "taken"), [([1.3, 1.1, 1.2], 1), ([1.3, 1.1, 0.0, 0.0], 2), ([1.2] * 9, 0)])
def test_what_misses_its_limits_least_is_taken(missed, taken):
    calls = itertools.count()
    found = meet_outer(Steps(missed), lambda one: one, lambda _: min(next(calls), len(missed) - 1), ignore)
    assert found.outer == taken


def test_what_follows_an_outer_loop_tells_how_far_it_is():
    class Telling(Steps):
        def enclose(self, outer, _):
            return Telling(self.misses, outer)

        def follow(self, progress, *, first):
            progress("half of it", 0.5)
            return self

    calls, heard = itertools.count(), []
    meet_outer(Telling([1.3, 1.1, 0.0]), lambda one: one, lambda _: next(calls), lambda *note: heard.append(note))
    assert [note for note, _ in heard] == ["tuning with the outer loop", "half of it"] * 2
    assert [share for _, share in heard] == pytest.approx([0.0, 0.5 / 6, 1 / 6, 1.5 / 6])


@pytest.mark.slow
def test_a_schedule_that_misses_its_limits_misses_them_least_of_what_was_tried():
    """With a damping that gets less each time it is asked for, of which the first is already too little."""
    asked, loose = [], replace(ASKED, stiffness=80.0, damping=1.2)

    def weaken(schedule):
        damping = 1.2 - 0.2 * min(len(asked), 2)
        asked.append(give_outer(replace(loose, damping=damping), schedule.controllers[0]).outer)
        return asked[-1]

    schedule = tune_schedule(HELD, VALUES, OF_KNEE, "k_s", [250.0, 300.0], {"knee": KNEE}, outer=weaken)
    assert not schedule.met and len({one.impedance.damping for one in asked}) == 3
    assert schedule.outer == asked[0]
