"""A scheduled law with every part: standing still it is the plain law of its gains, and in C it is what Python has.

The plain law is another realisation (balanced, its integrators a chain), and runs by other code.
"""

import json
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.signal import bilinear, lfilter

import seaopt as so
from seaopt.control import (
    Compensation,
    Controller,
    GainTable,
    LinkFeedforward,
    LinkPath,
    Notch,
    Prefilter,
    ScheduledController,
    export,
    realise,
    runnable,
    tune_schedule,
)
from seaopt.control.laws.structures import Gains, SpeedLoop
from seaopt.control.loops.compensation.ripple_term import RippleTerm
from seaopt.control.loops.measured.loop import MeasuredFigures
from seaopt.control.running.closed_loop import SampledLoop, run_loop
from seaopt.control.scheduling.runnable_schedule import make_runnable
from seaopt.errors import ControlError
from seaopt.files import to_json
from tests.c_code import CompiledSchedule, LoadedLaw
from tests.schedules import read_knee, tune_knee

TS, POINTS = 1e-3, (0.0, 0.7, 1.15)
PID = {
    "k_p": [57.0, 90.0, 161.0], "k_i": [4297.0, 6000.0, 11236.0], "k_d": [0.95, 1.4, 2.45], "T_f": [1e-3, 2e-3, 3e-3],
    "k_r": [55.0, 88.0, 156.0], "c": [0.63, 0.4, 0.2],
}  # fmt: skip
NOTCH = {"notch_frequency_hz": [60.0, 70.0, 90.0], "notch_width": [0.3, 0.4, 0.5], "notch_depth": [0.1, 0.2, 0.5]}
FIRST = {"prefilter_corner_hz": [30.0, 40.0, 50.0]}
SECOND = FIRST | {"prefilter_damping": [0.7, 0.8, 0.9]}
INNER, INTEGRAL = {"k_v": [3.0, 4.0, 5.0], "k_ff": [1.0, 1.2, 1.5]}, {"T_v": [0.05, 0.06, 0.08]}
SPEED, ENCODER = SpeedLoop(differenced=False), SpeedLoop(differenced=True)
LAWS = {
    "pid": ({}, None),
    "notch": (NOTCH, None),
    "first-order prefilter": (FIRST, None),
    "notch and prefilter": (NOTCH | SECOND, None),
    "cascade": (INNER, SPEED),
    "cascade of two integrals on an encoder": (INNER | INTEGRAL, ENCODER),
    "cascade with notch and prefilter": (INNER | INTEGRAL | NOTCH | SECOND, ENCODER),
    "cascade without an outer integral": (INNER | INTEGRAL | {"k_i": [0.0] * 3}, SPEED),
}


def make_table(gains, speed, links=()):
    return GainTable(
        over="phi", unit="rad", points=np.array(POINTS), structure="pid" if speed is None else "cascade",
        gains={name: np.array(row) for name, row in (PID | gains).items()}, sample_time_s=TS, speed=speed,
        links=links,
    )  # fmt: skip


def make_signals(speed, samples=1200):
    """Return references and readings that take the law to its limit and back."""
    rng = np.random.default_rng(5)
    references, readings = rng.normal(size=samples), rng.normal(size=(samples, 1 if speed is None else 2))
    references[: samples // 2] += 4.0
    return references, readings * [1.0, 0.01][: readings.shape[1]]


@pytest.mark.parametrize(("place", "limit"), [(0.0, None), (0.3, None), (0.7, None), (0.7, 600.0)])
@pytest.mark.parametrize("name", LAWS)
def test_standing_still_it_is_the_plain_law_saturated_too(name, place, limit):
    gains, speed = LAWS[name]
    table = make_table(gains, speed)
    law = Gains.from_names(table.interpolate(place), speed=speed).law(table.structure, TS)
    scheduled, plain = make_runnable(table, limit=limit), realise(law, command_limit=limit)
    state, other = scheduled.reset(place=place), plain.reset()
    commands = np.zeros((1200, 2))
    for row, r, y in zip(commands, *make_signals(speed), strict=True):
        row[0], state = scheduled.step(state, float(r), y, place)
        row[1], other = plain.step(other, float(r), float(y[0]) if y.size == 1 else y)
    np.testing.assert_allclose(*commands.T, atol=1e-12 * np.max(np.abs(commands)))
    assert limit is None or 0.3 < np.mean(np.abs(commands[:, 1]) == limit) < 0.95


@pytest.mark.parametrize("name", [name for name in LAWS if "without" not in name])
def test_a_reset_continues_from_its_command_and_stays_at_rest(name):
    gains, speed = LAWS[name]
    law = make_runnable(make_table(gains, speed))
    resting = [2.0] if speed is None else [2.0, 0.3 * speed.differenced]
    state = law.reset(2.0, np.array(resting), 0.3, 25.0)
    for _ in range(50):
        command, state = law.step(state, 2.0, np.array(resting), 0.3)
        assert command == pytest.approx(25.0, rel=1e-9)


def make_link(fraction, *, is_speed, high_pass_hz):
    return LinkPath(
        measured="x", unit="m/s" if is_speed else "m", inertia=40.0, damping=900.0, is_speed=is_speed,
        fraction=fraction, corner_hz=25.0, high_pass_hz=high_pass_hz,
    )  # fmt: skip


@pytest.mark.parametrize("is_speed", [False, True])
@pytest.mark.parametrize("high_pass_hz", [0.0, 3.0])
def test_what_is_fed_forward_of_the_link_is_that_of_filters_by_scipy(is_speed, high_pass_hz):
    """(M s^2 + b s) of a position, between its filters, each made sampled by itself with its own corner prewarped."""
    links = tuple(make_link(share, is_speed=is_speed, high_pass_hz=high_pass_hz) for share in (0.4, 0.8, 0.9))
    law = make_runnable(make_table(NOTCH, None, links))
    w, high = (2.0 / TS * np.tan(np.pi * f * TS) for f in (25.0, high_pass_hz))
    top = [40.0, 900.0] if is_speed else [40.0, 900.0, 0.0]
    filters = [bilinear(np.array(top) * w**2, [1.0, np.sqrt(2.0) * w, w**2], fs=1.0 / TS)]
    filters += [bilinear([1.0, 0.0], [1.0, high], fs=1.0 / TS)] if high_pass_hz else []
    motion = np.cumsum(np.random.default_rng(6).normal(size=900)) * 1e-5
    expected = 0.6 * motion  # half the way from the first point to the second
    for num, den in filters:
        expected = lfilter(num, den, expected)
    state, found = law.reset(place=0.35), np.zeros(900)
    for k, x in enumerate(motion):
        found[k], state = law.step(state, 0.0, np.array([0.0, x]), 0.35)
    np.testing.assert_allclose(found, expected, atol=1e-10 * np.max(np.abs(expected)))
    state = law.reset(2.0, np.array([2.0, 0.3]), 0.35, 25.0)
    for _ in range(50):
        command, state = law.step(state, 2.0, np.array([2.0, 0.3]), 0.35)
        assert command == pytest.approx(25.0, rel=1e-9)


def test_links_that_differ_in_kind_are_refused():
    links = [make_link(0.5, is_speed=False, high_pass_hz=high) for high in (0.0, 3.0, 3.0)]
    with pytest.raises(ControlError, match="link_feedforward of a schedule reads one signal"):
        make_table({}, None, tuple(links))


def test_corners_are_lines_as_the_filter_has_them():
    table = make_table(NOTCH, None)
    middle = np.tan(np.pi * TS * np.array(NOTCH["notch_frequency_hz"][:2])).mean()
    assert np.tan(np.pi * TS * table.interpolate(0.35)["notch_frequency_hz"]) == pytest.approx(middle, rel=1e-12)


def test_half_a_notch_and_gains_of_a_cascade_without_its_signal_are_refused():
    with pytest.raises(ControlError, match="notch_width"):
        make_table({"notch_frequency_hz": [60.0] * 3, "notch_depth": [0.5] * 3}, None)
    with pytest.raises(ControlError, match="k_ff, k_v"):
        make_table(INNER, None)


PARTS = ["notch and prefilter", "cascade", "observer", "observer and notch", "link", "link and observer"]


@pytest.fixture(scope="module", params=PARTS)
def schedule(request):
    """Return a tuned schedule."""
    if "link" in request.param:
        stand, swing, values = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
        spec = so.ControllerSpec(
            bandwidth_hz=30.0, max_sensitivity=1.6, reserve=0.03, current_limit_A=9.0,
            link_feedforward=LinkFeedforward(),
        )  # fmt: skip
        if "observer" in request.param:
            spec = replace(spec, structure="pid_dob", bandwidth_hz=20.0, max_sensitivity=1.9, max_complementary=1.6)
        return tune_schedule(stand, values, spec, "I_p", (0.36, 0.6), {"swing": swing})
    if request.param == "cascade":
        plant, over, points = so.plants.rotary(link="locked"), "k_s", (250.0, 300.0)
        spec = so.ControllerSpec(
            measured=("tau_s", "thetad_m"), structure="cascade", bandwidth_hz=15, max_sensitivity=1.6, reserve=0.03,
            current_limit_A=2.0, prefilter=Prefilter(),
        )  # fmt: skip
        return tune_schedule(plant, plant.defaults, spec, over, points)
    parts = {"structure": "pid_dob"} if "observer" in request.param else {"prefilter": Prefilter(order="second_order")}
    if "notch" in request.param:
        parts["notch"] = Notch(frequency_hz=120.0, width=0.4, depth=0.5)
    spec = so.ControllerSpec(
        measured="tau", bandwidth_hz=30, max_sensitivity=1.6, reserve=0.03, current_limit_A=5.0, **parts
    )
    stand, _, values = read_knee()
    return tune_schedule(stand, values, spec, "phi", (0.0, 0.5))


def test_on_the_plant_it_is_the_linear_loop_of_its_point(schedule):
    """With the variable at a point, from rest, far from the command's limit; the law reads all of its signals."""
    controller, point = schedule.controllers[0], schedule.points[0]
    plant, values = controller.design
    law, references = schedule.runnable(), np.full(300, 1e-3)
    loop = SampledLoop(plant=plant, law=law, measured=controller.signals, delay_samples=1)
    run = run_loop(loop, [plant.complete(values).drop_conditions()], references, places=point, rtol=1e-8)
    expected, _ = controller.close(plant, values).simulate(references)
    np.testing.assert_allclose(run.outputs[controller.signals[0]][0], expected, atol=1e-6 * np.max(np.abs(expected)))


def test_an_observer_sees_the_limited_command(schedule):
    """Q and Q/P_n multiplied out, as difference equations of the test's own, beside those of the pid"""
    controller, point = schedule.controllers[0], schedule.points[0]
    if controller.observer is None or schedule.table.order.notch or schedule.table.order.link:
        pytest.skip("another law")
    law, g, n = schedule.runnable(), controller.gains, 900
    q, inverse = controller.observer.filters(TS)
    limit, rng = law.command_limit / law.per_effort, np.random.default_rng(8)
    references, readings = rng.normal(size=n) + 30.0 * (np.arange(n) < 450), rng.normal(size=n)
    share = law.anti_windup[0]

    def filtered(part, given, before, k):
        top = sum(b * given[k - i] for i, b in enumerate(part.num) if k >= i and b)
        return top - sum(a * before[k - i] for i, a in enumerate(part.den) if 0 < i <= k)

    applied, known, seen = np.zeros(n), np.zeros(n), np.zeros(n)
    total = x_r = x_y = 0.0
    state, commands = law.reset(place=point), np.zeros(n)
    for k, (r, y) in enumerate(zip(references, readings, strict=True)):
        half = g["k_i"] * TS * (r - y) / 2
        rate = (g["c"] * (r - x_r) - (y - x_y)) / (g["T_f"] + TS)
        v = g["k_r"] * r - g["k_p"] * y + total + half + g["k_d"] * rate
        known[k], seen[k] = filtered(q, applied, known, k), filtered(inverse, readings, seen, k)
        effort = v + known[k] - seen[k]
        applied[k] = min(max(effort, -limit), limit)
        total += 2 * half + share * (applied[k] - effort)
        x_r += TS / (g["T_f"] + TS) * (r - x_r)
        x_y += TS / (g["T_f"] + TS) * (y - x_y)
        commands[k], state = law.step(state, float(r), float(y), point)
    np.testing.assert_allclose(commands, applied * law.per_effort, atol=1e-9 * law.command_limit)
    assert 0.1 < np.mean(np.abs(commands) == law.command_limit) < 0.9


@pytest.mark.parametrize("limited", [False, True])
def test_standing_still_a_tuned_one_is_what_runs_at_its_place(schedule, limited):
    """Between the points too, an observer's with the gain of its nominal plant on a line; saturated as exported."""
    limit, rng = None if limited else math.inf, np.random.default_rng(4)
    law = schedule.runnable(limit=limit)
    low, high = schedule.points
    size = np.array([0.02, 0.006] if law.measured > 1 else [1.0, 0.3])
    if schedule.table.order.link:
        size = np.array([20.0, 3e-6])
    for place in (low, 0.6 * low + 0.4 * high):
        plain = runnable(schedule.at(place), command_limit=limit)
        state, other, pairs = law.reset(place=place), plain.reset(), np.zeros((800, 2))
        for k, pair in enumerate(pairs):
            r, y = size[0] * (rng.normal() + 30.0 * (k < 300)), size[-law.measured :] * rng.normal(size=law.measured)
            pair[0], state = law.step(state, r, y, place)
            pair[1], other = plain.step(other, r, y if y.size > 1 else float(y[0]))
        np.testing.assert_allclose(*pairs.T, atol=1e-11 * np.max(np.abs(pairs)))
        assert not limited or 0.05 < np.mean(np.abs(pairs[:, 0]) == law.command_limit) < 0.95


def test_frozen_its_file_and_its_c_wind_up_as_it_runs(schedule, compiler, tmp_path):
    low, high = schedule.points
    place = 0.6 * low + 0.4 * high
    frozen, law = schedule.at(place), schedule.runnable()
    content = json.loads(to_json(frozen.to_dict()))
    again = Controller.from_dict(content, *frozen.design)
    assert again.share == frozen.share
    export(content, tmp_path, name="law", allow_infeasible=True)
    compiled = LoadedLaw(compiler, tmp_path, "law", again.law.d.size)
    state, rng, pairs = law.reset(place=place), np.random.default_rng(4), np.zeros((800, 2))
    size = np.array([0.02, 0.006] if law.measured > 1 else [1.0, 0.3])
    size = np.array([20.0, 3e-6]) if schedule.table.order.link else size
    for k, pair in enumerate(pairs):
        r, y = size[0] * (rng.normal() + 30.0 * (k < 300)), size[-law.measured :] * rng.normal(size=law.measured)
        pair[0], state = law.step(state, r, y, place)
        pair[1] = compiled.step(r, *y)
    np.testing.assert_allclose(*pairs.T, atol=1e-11 * np.max(np.abs(pairs)))
    for refusing in (runnable, partial(export, folder=tmp_path)):
        with pytest.raises(ControlError, match="winds up as that does"):
            refusing(frozen, tracking_time_s=0.5)


def test_what_is_added_is_outside_the_law_and_its_observer(schedule):
    """A term's effort is no part of what an observer takes for the law's: of the plain law neither."""
    term = RippleTerm(cycles=(1,), cos=(0.7,), sin=(0.2,), period=1.0, reads="z", unit="m", fraction=1.0)
    added, rng = Compensation(sample_time_s=TS, ripple=term), np.random.default_rng(7)
    law, (place, _) = schedule.runnable(limit=np.inf), schedule.points
    law = replace(law, compensation=added, terms=np.array([added.numbers] * 2))
    plain = realise(schedule.at(place).law, per_effort=law.per_effort, compensation=added)
    state, other, pairs = law.reset(place=place), plain.reset(), np.zeros((800, 2))
    for k, pair in enumerate(pairs):
        r, y, z = rng.normal(), 0.01 * rng.normal(size=law.table.order.measured), [0.003 * k]
        pair[0], state = law.step(state, r, y, place, z)
        pair[1], other = plain.step(other, r, y if y.size > 1 else float(y[0]), z)
    np.testing.assert_allclose(*pairs.T, atol=1e-10 * np.max(np.abs(pairs)))


def test_a_tuned_one_rests_where_it_is_reset(schedule):
    law, resting = schedule.runnable(), np.zeros(schedule.table.order.measured)
    resting[0] = 2.0
    state = law.reset(2.0, resting, schedule.points[0], 1.25)
    for _ in range(40):
        command, state = law.step(state, 2.0, resting, schedule.points[0])
        assert command == pytest.approx(1.25, rel=1e-9)


def test_every_limit_holds_at_the_points_and_between(schedule):
    assert schedule.met, schedule


def test_a_file_of_it_reads_back_the_same(schedule):
    written = to_json(schedule.to_dict())
    again = ScheduledController.from_dict(json.loads(written), *schedule.design, schedule.others)
    assert to_json(again.to_dict()) == written


def test_a_measured_response_stays_at_its_point_in_the_file():
    figures = MeasuredFigures(
        name="frf:chirp", confidence=0.95, points=3, band_hz=(1.0, 3.0), bandwidth_hz=(30.0, None), stable=True, ms=1.5,
        ms_hz=2.0, mt=1.2, disk_margin=0.8, noise_gain=2.0, reference_peak=1.1, droop_db=0.0,
    )  # fmt: skip
    schedule = tune_knee()
    first, second, third = schedule.controllers
    schedule = replace(schedule, controllers=(first, replace(second, measured=(figures,)), third))
    written = to_json(schedule.to_dict())
    again = ScheduledController.from_dict(json.loads(written), *schedule.design, schedule.others)
    assert [each.measured for each in again.controllers] == [(), (figures,), ()]


@pytest.mark.parametrize(("precision", "share"), [("double", 1e-13), ("float", 2e-3)])
def test_in_c_every_command_is_pythons(schedule, precision, share, compiler, tmp_path):
    law, compiled = schedule.runnable(), CompiledSchedule(compiler, tmp_path, schedule, precision)
    rng, several = np.random.default_rng(3), law.table.order.measured > 1
    scale = np.array([0.02, 0.02] if several else [1.0])
    if schedule.table.order.link:
        scale = np.array([10.0, 1e-5])
    references, readings = 3.0 * scale[0] * rng.normal(size=2000), scale * rng.normal(size=(2000, 1 + several))
    references[800:1200] += 40.0 * scale[0]
    low, high = schedule.points
    places = low + (high - low) * (0.5 + 0.7 * np.sin(np.arange(2000) / 150.0))
    places[300:320], places[700] = np.nan, np.inf
    references[50], readings[51:55, -1] = np.nan, np.inf
    start = (0.5, 0.2 * scale, np.nan, 1.0)
    state, pairs = law.reset(*start), np.zeros((2000, 2))
    compiled.reset(*start)
    for pair, r, y, place in zip(pairs, references, readings, places, strict=True):
        pair[0], state = law.step(state, float(r), y, float(place))
        pair[1] = compiled.step(float(r), y, float(place))
        assert (compiled.law.held, compiled.law.misplaced) == (state.held, state.misplaced)
    np.testing.assert_allclose(*pairs.T, rtol=0.0, atol=share * law.command_limit)
    assert 0.1 < np.mean(np.abs(pairs[:, 0]) == law.command_limit) < 0.9
