"""Scheduled gains: the law that interpolates them, and its tuning."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import GainTable, ScheduledController, realise, tune_schedule
from seaopt.control.laws.structures import Gains
from seaopt.control.scheduling.runnable_schedule import make_runnable
from seaopt.control.scheduling.scheduled_controller import list_inner
from seaopt.control.scheduling.tuning import _count_hops
from seaopt.errors import ControlError, FileError
from seaopt.files import seal, to_json
from seaopt.reporting.sections.kinds.schedule import describe_plants_at_points
from tests.schedules import read_knee, tune_knee

ROWS = {
    "k_p": [57.0, 90.0, 161.0], "k_i": [4297.0, 6000.0, 11236.0], "k_d": [0.95, 1.4, 2.45], "T_f": [1e-3, 2e-3, 3e-3],
    "k_r": [55.0, 88.0, 156.0], "c": [0.63, 0.4, 0.2],
}  # fmt: skip
POINTS = (0.0, 0.7, 1.15)


def make_table(**changed):
    gains = {name: np.array(row) for name, row in (ROWS | changed).items()}
    return GainTable(over="phi", unit="rad", points=np.array(POINTS), gains=gains, structure="pid", sample_time_s=1e-3)


def simulate_by_hand(table, place, references, measurements):
    """Direct form of the structure's equation, sums and differences kept as such; no limit."""
    ts, integral, rate, before = table.sample_time_s, 0.0, 0.0, None
    out = []
    for r, y, s in zip(references, measurements, place, strict=True):
        g = {name: np.interp(s, table.points, row) for name, row in table.gains.items()}
        error, weighted = r - y, g["c"] * r - y
        last_error, last_weighted = (0.0, 0.0) if before is None else before
        integral += g["k_i"] * ts / 2 * (error + last_error)
        rate = g["T_f"] / (g["T_f"] + ts) * rate + (weighted - last_weighted) / (g["T_f"] + ts)
        out.append(g["k_r"] * r - g["k_p"] * y + integral + g["k_d"] * rate)
        before = (error, weighted)
    return np.array(out)


class TestGainTable:
    def test_gains_are_those_of_the_points_and_of_lines_between_them(self):
        table = make_table()
        for name, row in ROWS.items():
            for s in (0.0, 0.2, 0.7, 1.0, 1.15):
                assert table.interpolate(s)[name] == pytest.approx(np.interp(s, POINTS, row), rel=1e-14)

    @pytest.mark.parametrize(("value", "end"), [(-3.0, 0), (9.0, -1), (math.inf, -1), (-math.inf, 0)])
    def test_beyond_the_ends_the_ends_count(self, value, end):
        assert make_table().interpolate(value)["k_p"] == ROWS["k_p"][end]

    def test_points_that_do_not_ascend_and_a_single_one_are_refused(self):
        for points in ([1.0, 0.0], [0.0, 0.0], [0.5], [0.0, math.nan]):
            with pytest.raises(ControlError, match="points of phi"):
                GainTable(
                    over="phi", unit="rad", points=np.array(points),
                    gains={name: np.array(row[: len(points)]) for name, row in ROWS.items()}, structure="pid",
                    sample_time_s=1e-3,
                )  # fmt: skip

    def test_an_integral_at_some_points_only_is_refused(self):
        with pytest.raises(ControlError, match=r"k_i is 0 at phi = 0\.7"):
            make_table(k_i=[10.0, 0.0, 10.0])


class TestRunnableSchedule:
    @pytest.mark.parametrize("place", [0.0, 0.3, 0.7, 1.15])
    def test_standing_still_it_is_the_law_of_the_interpolated_gains(self, place):
        table, rng = make_table(), np.random.default_rng(1)
        scheduled = make_runnable(table)
        frozen = realise(Gains.from_names(table.interpolate(place)).law("pid", 1e-3))
        state, other = scheduled.reset(2.0, 1.5, place, 30.0), frozen.reset(2.0, 1.5, 30.0)
        for _ in range(400):
            r, y = rng.normal(size=2)
            command, state = scheduled.step(state, r, y, place)
            expected, other = frozen.step(other, r, y)
            assert command == pytest.approx(expected, rel=1e-9, abs=1e-9)

    def test_at_a_point_its_anti_windup_is_that_of_the_plain_law(self):
        table = make_table()
        scheduled, frozen = make_runnable(table, limit=50.0), realise(table.law(0.7), command_limit=50.0)
        state, other = scheduled.reset(place=0.7), frozen.reset()
        for k in range(600):
            r = 5.0 if k < 300 else 0.2
            command, state = scheduled.step(state, r, 0.1, 0.7)
            expected, other = frozen.step(other, r, 0.1)
            assert command == pytest.approx(expected, rel=1e-9, abs=1e-9)

    def test_while_it_moves_the_states_keep_their_meaning(self):
        # With c and T_f the same at all points the direct form has the same states, so that both agree on the way,
        # but for the integral: a trapezium takes both ends' k_i, and this law each end's own, which differ by a sample.
        table = make_table(c=[0.5] * 3, T_f=[1e-3] * 3, k_i=[1e-3] * 3)
        law, n = make_runnable(table), 500
        place = 0.575 - 0.575 * np.cos(2 * np.pi * 3.0 * np.arange(n) * 1e-3)
        rng = np.random.default_rng(2)
        references, measurements = np.cumsum(rng.normal(size=(2, n)), axis=1) * 0.1
        references[0] = measurements[0] = 0.0
        state, out = law.reset(place=0.0), np.zeros(n)
        for k in range(n):
            out[k], state = law.step(state, references[k], measurements[k], place[k])
        expected = simulate_by_hand(table, place, references, measurements)
        assert np.max(np.abs(out - expected)) < 1e-9 * np.max(np.abs(expected))

    def test_at_rest_a_moving_integral_gain_moves_nothing(self):
        law = make_runnable(make_table(k_p=[80.0] * 3, k_r=[78.0] * 3))
        state = law.reset(3.0, 3.0, 0.0, 40.0)
        for s in np.linspace(0.0, 1.15, 50):
            command, state = law.step(state, 3.0, 3.0, s)
            assert command == pytest.approx(40.0, rel=1e-12)

    def test_a_missing_place_is_the_last_one_and_first_of_all_the_fallback(self):
        law = make_runnable(make_table(), fallback=1.15)
        for start, expected in ((math.nan, 1.15), (0.3, 0.3)):
            state = law.reset(place=start)
            lost, after = law.step(state, 1.0, 0.0, math.nan)
            told, _ = law.step(state, 1.0, 0.0, expected)
            assert lost == told and after.misplaced == state.misplaced + 1
        assert law.step(after, 1.0, 0.0, 0.5)[1].misplaced == 0

    def test_a_reading_that_is_not_finite_holds_the_last_command(self):
        law = make_runnable(make_table(), limit=50.0)
        command, state = law.step(law.reset(place=0.2), 0.3, 0.1, 0.2)
        held, after = law.step(state, 0.3, math.nan, 0.4)
        assert held == command and after.held == 1 and np.array_equal(after.x, state.x)


@pytest.fixture(scope="module")
def plants():
    return read_knee()


@pytest.fixture(scope="module")
def schedule():
    return tune_knee()


class TestTuneSchedule:
    def test_every_point_has_the_bandwidth_on_its_own_plant(self, schedule, plants):
        stand, _, values = plants
        for point, controller in zip(schedule.points, schedule.controllers, strict=True):
            figures = controller.close(stand, values.update(phi=point)).figures()
            assert figures.bandwidth_hz == pytest.approx(30.0, rel=0.005)
            assert figures.ms <= 1.6

    def test_gains_move_one_way_as_the_arm_does(self, schedule):
        assert np.all(np.diff(schedule.table.gains["k_p"]) > 0.0)

    def test_between_the_points_the_limits_hold_on_the_plant_there(self, schedule, plants):
        stand, swing, values = plants
        assert schedule.feasible, schedule
        for place in schedule.between:
            law = schedule.at(place.value)
            here = values.update(phi=place.value)
            for plant in (stand, swing):
                assert law.close(plant, here).figures().ms <= 1.6
            assert place.bandwidth_hz >= 0.9 * 30.0

    def test_what_is_stored_is_read_back_the_same(self, schedule, plants, no_simulation):
        stand, swing, values = plants
        written = to_json(schedule.to_dict())
        sealed = json.loads(to_json(seal(schedule.to_dict())))
        again = ScheduledController.from_dict(sealed, stand, values, {"swing": (swing, values)})
        assert repr(again) == repr(schedule) and to_json(again.to_dict()) == written

    def test_gains_that_are_not_those_of_the_controllers_are_refused(self, schedule, plants):
        content = json.loads(to_json(schedule.to_dict()))
        content["gains"]["k_p"][1] *= 1.01
        with pytest.raises(FileError, match=r"at phi = 0\.4, controller.json: law is not what gains"):
            ScheduledController.from_dict(content, plants[0], plants[2])

    def test_a_reader_of_controllers_refuses_a_schedule(self, schedule, plants):
        with pytest.raises(FileError):
            so.Controller.from_dict(json.loads(to_json(schedule.to_dict())), plants[0], plants[2])

    @pytest.mark.slow
    def test_bandwidths_may_differ_from_point_to_point(self, plants):
        spec = so.ControllerSpec(measured="tau", bandwidth_hz=30, max_sensitivity=1.6, reserve=0.03)
        made = tune_schedule(plants[0], plants[2], spec, "phi", [0.0, 0.4], bandwidths_hz=[30, 25])
        assert [round(one.achieved.bandwidth_hz, 1) for one in made.controllers] == [30.0, 25.0]

    def test_gains_that_do_not_change_are_noted(self, schedule):
        same = replace(schedule, controllers=(schedule.controllers[0],) * len(schedule.points))
        assert any("one law" in note for note in same.notes)
        assert not any("one law" in note for note in schedule.notes)

    def test_what_cannot_be_scheduled_is_refused(self, plants):
        stand, _, values = plants
        spec = so.ControllerSpec(measured="tau", bandwidth_hz=30)
        for changed, over, what in (
            ({"structure": "custom"}, "phi", "custom"),
            ({}, "ph", "phi"),
            ({}, "delay_s", "delay"),
        ):
            with pytest.raises(ControlError, match=what):
                tune_schedule(stand, values, replace(spec, **changed), over, [0.0, 0.4])


@pytest.mark.slow
def test_a_schedule_keeps_limits_that_one_law_cannot():
    """The table of docs/howto/scheduling.md: 24 Hz with the leg bent are too much for one law."""
    problem = so.read_problem("problems/lever_knee.toml")
    stand, swing, values = read_knee()
    points = problem.schedule.points
    others = {
        f"{plant.name} at {value:g}": (plant, values.with_parameters(replace(values["phi"], value=value)))
        for plant in (stand, swing) for value in points
    }  # fmt: skip
    bent = values.update(phi=points[-1])
    for hz, feasible in ((22.0, True), (24.0, False)):
        assert so.tune(stand, bent, replace(problem.spec, bandwidth_hz=hz), others).feasible is feasible
    schedule = tune_schedule(stand, values, problem.spec, "phi", points, {"swing": swing})
    assert schedule.feasible and {one.spec.bandwidth_hz for one in schedule.controllers} == {30.0}


def test_witnesses_are_kept_at_the_points_and_the_fallback_has_the_least_ms(stand, thor):
    """Peaks of S are those of python-control, on frequencies of the test's."""
    spec, points = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6), [2e-6, 3e-6, 4e-6]
    draw, z = {"k": 7.1e5, "eta": 1.04}, np.exp(2j * np.pi * np.geomspace(1.0, 499.0, 4000) * 1e-3)

    def find_ms(law, params):
        return np.max(np.abs(law.close(stand, params).to_control()(z)[0, 0]))

    alone = tune_schedule(stand, thor, spec, "J", points)
    kept = tune_schedule(stand, thor, spec, "J", points, witnesses={"draw": (stand, thor.update(**draw))}, near=alone)
    ms = [max(find_ms(law, thor.update(J=at, **draw)) for at, law in zip(points, each.controllers, strict=True))
          for each in (alone, kept)]  # fmt: skip
    assert ms[0] > 1.61 and ms[1] <= 1.6 and kept.met and not kept.others
    for schedule in (alone, kept):
        worst = [max(find_ms(law, thor.update(J=at)) for at in points) for law in schedule.controllers]
        assert schedule.fallback == points[int(np.argmin(worst))]


def test_draws_are_judged_between_the_points_and_what_is_not_is_named(stand, thor):
    """A draw that every point keeps breaks the limit between two: at that value, and with a point there it is kept."""
    points, drawn, value = [3e5, 9e5], {"J": 0.6 * thor["J"].value}, 6e5
    spec = so.ControllerSpec(bandwidth_hz=30, structure="pid", max_sensitivity=1.6, max_noise_gain=60)
    schedule = tune_schedule(stand, thor, spec, "k", points, {"other": stand}, draws=[drawn])
    assert all(law.met for law in schedule.controllers) and not schedule.met and not schedule.plants_at_points
    z = np.exp(2j * np.pi * np.geomspace(1.0, 499.0, 4000) * 1e-3)

    def find_ms(law, at):
        return np.max(np.abs(law.close(stand, thor.update(k=at, **drawn)).to_control()(z)[0, 0]))

    for place in schedule.between:
        over = find_ms(schedule.at(place.value), place.value) > 1.6
        assert over == any("max_sensitivity" in name for name in place.broken)
    assert find_ms(schedule.at(value), value) > 1.7
    witness = {"a draw": (stand, thor.update(**drawn))}
    at_points = tune_schedule(stand, thor, spec, "k", points, {"other": stand}, witnesses=witness)
    assert at_points.met and at_points.plants_at_points == ("a draw",)
    (said,) = describe_plants_at_points(at_points)
    assert said.startswith("Not judged between the points, only at them: a draw")
    again = ScheduledController.from_dict(
        json.loads(to_json(schedule.to_dict())), *schedule.design, schedule.others, [drawn]
    )
    assert [place.broken for place in again.between] == [place.broken for place in schedule.between]
    assert not tune_knee().plants_at_points and not describe_plants_at_points(tune_knee())


def test_a_schedule_is_followed_from_some_of_its_points(stand, thor):
    spec, points = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6), (2e-6, 2.7e-6, 3.4e-6, 4e-6)
    whole = tune_schedule(stand, thor, spec, "J", points)
    for kept in ([1, 2], [1, 3]):
        laws = tuple(whole.controllers[k] for k in kept)
        some = replace(whole, points=tuple(points[k] for k in kept), controllers=laws, between=())
        again = tune_schedule(stand, thor, spec, "J", points, near=some)
        assert again.met and again.points == points
        for name in ("k_p", "k_i", "k_d"):
            assert again.table.gains[name] == pytest.approx(whole.table.gains[name], rel=0.05)


@pytest.mark.parametrize(("rates", "hops"), [([1.0, 3.0, 9.0], 0), ([60.0, 0.3, 60.0], 2), ([0.0, 0.0, 40.0], 1)])
def test_neighbours_of_two_valleys_are_counted(rates, hops):
    assert _count_hops([(np.array([99.0, 100.0 * rate, *[1.0] * 12]), []) for rate in rates]) == hops


def test_inner_ends_are_those_of_equal_parts():
    assert list_inner([0.0, 1.0, 3.0], 2) == [0.5, 2.0]
