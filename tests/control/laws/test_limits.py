"""The table of limits: specification, problem schema, documentation and judgement are what its rows say."""

from __future__ import annotations

import re
from dataclasses import fields, replace

import control
import numpy as np
import pytest

import seaopt as so
from seaopt.control.laws.limits import BY_NAME, FIELDS, LIFTABLE, LIMITS, MeasuredLoop, PortFigures
from seaopt.control.laws.structures import DisturbanceObserver, Gains, Nominal
from seaopt.control.laws.verdict import (
    BindingLimit,
    explain_broken,
    join_limits,
    judge_all,
    list_active,
    list_broken,
    shorten_blocked,
)
from seaopt.control.loops.law import Law, count_filter_samples, find_integral_rate
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.control.mpc.spec import MPC_LIMITS, MPCSpec
from seaopt.errors import ControlError
from seaopt.problem.schema import ControllerTable
from tests import laws
from tests.pages import read_page

SPEC = so.ControllerSpec(
    bandwidth_hz=30, max_sensitivity=1.6, max_complementary=1.3, min_disk_margin=0.5, max_reference_peak=1.2,
    max_noise_gain=25, passive_band_hz=(1, 60),
)  # fmt: skip

PLAIN = replace(SPEC, passive_band_hz=None)


@pytest.fixture(scope="module")
def loop(stand, thor):
    return so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30)).close(stand, thor)


@pytest.fixture(scope="module")
def plain(stand, thor):
    return so.tune(stand, thor, PLAIN)


@pytest.fixture(scope="module")
def figures(loop):
    """Return figures that keep every limit of SPEC with room to spare."""
    return replace(
        loop.figures(), stable=True, spectral_radius=0.999, ms=1.4, mt=1.1, disk_margin=0.8, reference_peak=1.0,
        noise_gain=10.0, sensitivity_bandwidth_hz=8.0, bandwidth_hz=30.1, droop_db=0.5, return_hz=None,
    )  # fmt: skip


def loops(design, other=None, cosine=0.5, *, held_stable=True):
    port = PortFigures(least_cosine=cosine, at_hz=5.0, held_stable=held_stable)
    return [
        MeasuredLoop(name="stand", figures=design, port=port),
        MeasuredLoop(name="swing", figures=other or design),
    ]


def name_broken(verdicts):
    return [str(limit) for limit in list_broken(verdicts)]


def table_of_the_docs():
    """Return the rows of the table below "Limits" as lists of cells."""
    section = read_page("theory/tuning.md").split("## Limits\n")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


def test_the_documentation_has_the_table():
    head, _, *rows = table_of_the_docs()
    assert head == ["limit", "meaning", "the figure is", "of", "unit", "left out", "where it is broken"]
    assert rows == [
        [f"`{limit.name}`", limit.meaning, limit.sense, limit.scope, limit.unit, limit.default_text, limit.remedies]
        for limit in LIMITS
    ]


def test_specification_and_schema_have_the_rows_fields_and_defaults():
    defaults = {field.name: field.default for field in fields(so.ControllerSpec)}
    for limit in FIELDS:
        column = ControllerTable.model_fields[limit.name]
        assert defaults[limit.name] == limit.default
        assert column.is_required() if limit.name == "bandwidth_hz" else column.default == limit.default
        assert column.description == limit.description


def test_every_field_that_limits_a_figure_has_a_row():
    named = {
        field.name for field in fields(so.ControllerSpec) if re.match("m(ax|in)_|.*bandwidth_hz|passive", field.name)
    }
    assert named == {limit.name for limit in FIELDS}


@pytest.mark.parametrize("limit", [limit for limit in FIELDS if limit.above is not None], ids=lambda limit: limit.name)
def test_the_range_of_a_field_is_the_rows(limit):
    for value in (limit.above, limit.below):
        if value is not None:
            with pytest.raises(ControlError, match=limit.name):
                so.ControllerSpec(**{limit.name: value})
    assert getattr(so.ControllerSpec(**{limit.name: limit.above + 0.1}), limit.name) == limit.above + 0.1


def test_nothing_is_broken_or_active_with_room_to_spare(figures):
    verdicts = judge_all(SPEC, loops(figures))
    assert list_broken(verdicts) == list_active(SPEC, verdicts) == []
    assert len(verdicts) == 2 * 4 + 9


# What the figures become; just within the limit, and just beyond it.
EDGES = {
    "stability": ({"spectral_radius": 1.0 - 2e-11}, {"spectral_radius": 1.0 - 1e-12, "stable": False}),
    "max_sensitivity": ({"ms": 1.6 * (1 + 0.9e-6)}, {"ms": 1.6 * (1 + 1.1e-6)}),
    "max_complementary": ({"mt": 1.3 * (1 + 0.9e-6)}, {"mt": np.inf}),
    "min_disk_margin": ({"disk_margin": 0.5 * (1 - 0.9e-6)}, {"disk_margin": 0.0}),
    "max_reference_peak": ({"reference_peak": 1.2}, {"reference_peak": 1.21}),
    "max_noise_gain": ({"noise_gain": 25.0}, {"noise_gain": 25.1}),
    "min_sensitivity_bandwidth_hz": ({"sensitivity_bandwidth_hz": 5.995}, {"sensitivity_bandwidth_hz": 5.993}),
    "max_droop_db": ({"droop_db": 1.0}, {"droop_db": 1.01}),
    "shoulder_hz": ({"return_hz": 89.6}, {"return_hz": 89.5}),
    "bandwidth_hz": ({"bandwidth_hz": 30.149}, {"bandwidth_hz": None}),
}


@pytest.mark.parametrize("name", EDGES)
def test_a_limit_is_kept_up_to_its_tolerance(name, figures):
    within, beyond = (replace(figures, **changes) for changes in EDGES[name])
    everywhere = BY_NAME[name].scope == "every plant"
    assert list_broken(judge_all(SPEC, loops(within))) == []
    label = f"{name} (swing)" if everywhere else name
    broken = judge_all(SPEC, loops(figures, beyond)) if everywhere else judge_all(SPEC, loops(beyond, figures))
    assert name_broken(broken) == [label]
    if not everywhere:
        assert list_broken(judge_all(SPEC, loops(figures, beyond))) == []
    active = list_active(SPEC, judge_all(SPEC, loops(figures, within) if everywhere else loops(within, figures)))
    assert list(map(str, active)) == ([] if BY_NAME[name].reserve == "none" else [label])


@pytest.mark.parametrize(
    ("cosine", "held_stable", "broken"), [(-0.9e-9, True, False), (-1.1e-9, True, True), (0.5, False, True)]
)
def test_a_passive_band_needs_a_held_loop_that_does_not_grow(figures, cosine, held_stable, broken):
    verdicts = judge_all(SPEC, loops(figures, cosine=cosine, held_stable=held_stable))
    assert name_broken(verdicts) == ["passive_band_hz"] * broken


DEFAULTS = {
    "stability": 1.0, "max_sensitivity": 1.7, "max_complementary": 1.3, "max_reference_peak": 1.3, "max_droop_db": 1.0,
    "min_sensitivity_bandwidth_hz": 6.0, "bandwidth_hz": 30.0, "shoulder_hz": 90.0, "min_filter_samples": 1.0,
    "integral_rad_s": 0.1 * np.pi,
}  # fmt: skip


def test_what_is_left_out_has_its_default_and_false_lifts_it(figures):
    verdicts = judge_all(so.ControllerSpec(bandwidth_hz=30), loops(figures)[:1])
    assert {verdict.limit.name: verdict.allowed for verdict in verdicts} == DEFAULTS
    optional = [name for name in DEFAULTS if name not in ("stability", "bandwidth_hz", "shoulder_hz", "integral_rad_s")]
    spec = so.ControllerSpec(bandwidth_hz=30, **dict.fromkeys(optional, False))
    assert set(spec.lifted) == set(optional)
    kept = judge_all(spec, loops(figures)[:1])
    assert [verdict.limit.name for verdict in kept] == ["stability", "bandwidth_hz", "shoulder_hz", "integral_rad_s"]
    none = so.ControllerSpec(bandwidth_hz=30, **dict.fromkeys(optional))
    assert judge_all(none, loops(figures)[:1])[1].allowed == 1.7


def test_filter_and_integral_are_those_of_the_law(stand, thor, plain):
    """A law put in the place of the tuned one is judged by its own filter and integral, whatever the gains say."""
    controller = plain
    own = controller.design_loop
    assert own.filter_samples == controller.gains["T_f"] / 1e-3 and own.integral_rad_s > 0.1 * np.pi
    ahead, back = laws.multiply_out("pid", 1e-3, k_p=0.5, k_i=0.3, k_d=4e-3, T_f=2e-4, k_r=1.5)
    other = replace(controller, law=laws.law_of(back.num, back.den, (ahead.num, ahead.den)))
    design = other.measure("stand", other.close(stand, thor).figures())
    assert design.filter_samples == pytest.approx(0.2, rel=1e-9)
    assert design.integral_rad_s == pytest.approx(0.2, rel=1e-6)
    assert {"min_filter_samples", "integral_rad_s"} <= set(name_broken(judge_all(PLAIN, [design])))
    assert {"min_filter_samples", "integral_rad_s"} <= {
        row.name for row in so.certify(other, {"stand": stand}, thor, simulations=False).requirements if not row.met
    }


@pytest.mark.parametrize(
    ("poles", "samples"),
    [([0.75], 3.0), ([0.75, 0.0, 0.0, 0.0], 3.0), ([0.75, 0.75], 3.0), ([0.4, 0.75], 2 / 3), ([0.75, -0.5], 3.0),
     ([0.0, 0.0, 0.0], np.inf), ([-0.5], np.inf), ([0.2 + 0.3j, 0.2 - 0.3j], np.inf)],
)  # fmt: skip
def test_only_lags_between_zero_and_one_are_filters_of_a_derivative(poles, samples):
    lag = TransferFunction(num=np.array([1.0, 0.3]), den=np.poly(poles).real)
    law = Law.from_transfer_functions(lag, lag, sample_time_s=1e-3)
    assert count_filter_samples(law) == pytest.approx(samples, rel=1e-5)


@pytest.mark.parametrize("count", [2, 8, 16, 20])
def test_a_measurement_averaged_over_samples_keeps_the_filter_of_the_law(loop, count):
    ahead, back = loop.law.transfer_functions()
    average = TransferFunction(num=np.convolve(back.num, np.full(count, 1.0 / count)), den=back.den)
    averaged = Law.from_transfer_functions(ahead, average, sample_time_s=1e-3)
    assert count_filter_samples(averaged) == pytest.approx(count_filter_samples(loop.law), rel=1e-4)
    assert count_filter_samples(averaged) > 0.99


@pytest.mark.parametrize("structure", ["pid", "pid_dob"])
@pytest.mark.parametrize("rate", [0.05, 0.4])
def test_the_rate_of_the_integral_is_the_loops_slowest_pole(stand, thor, plain, structure, rate):
    """Of the loop by python-control on the stand, whose static gain is 1; beside an observer it is the second."""
    plant = plain.close(stand, thor).plant
    observer = DisturbanceObserver(nominal=Nominal.of(plant), T_q=8e-3) if structure == "pid_dob" else None
    gains = Gains(k_p=0.4, k_i=1.4 * rate, k_d=2e-3, T_f=2e-3, k_r=1.4, observer=observer)
    law = gains.law(structure, 1e-3)
    model = control.ss(plant.a, plant.b[:, None], plant.c, plant.d[:, None], 1e-3)
    late = model * control.ss(control.tf([1.0], [1.0, *[0.0] * plant.delay_samples], 1e-3))
    c_y = control.ss(law.a, -law.b[:, 1:], law.c[None], -law.d[1], 1e-3)
    poles = np.log(control.feedback(late * c_y, 1).poles()) / 1e-3
    slowest = float(np.min(np.abs(poles)))
    assert find_integral_rate(law) == pytest.approx(slowest, rel=2e-3 + 0.05 * rate)
    made = replace(plain, law=law, gains=gains.by_name(), observer=observer, spec=replace(PLAIN, structure=structure))
    broken = name_broken(judge_all(PLAIN, [replace(made, structure=structure).measure("stand", plain.achieved)]))
    assert ("integral_rad_s" in broken) == (rate < 0.1 * np.pi)


def test_a_filter_that_is_faster_than_the_sampling_is_refused(figures):
    loop = replace(loops(figures)[0], filter_samples=0.99)
    assert name_broken(judge_all(SPEC, [loop])) == ["min_filter_samples"]


def test_each_broken_limit_is_named_once_with_its_worst_figure_and_its_plants(figures, loop):
    states = [replace(figures, ms=1.7), replace(figures, ms=2.0, noise_gain=26.0), replace(figures, ms=1.9)]
    names = ("design plant sliding", "design plant stuck", "swing")
    measured = [MeasuredLoop(name=name, figures=one) for name, one in zip(names, states, strict=True)]
    texts = explain_broken(PLAIN, judge_all(PLAIN, measured, 2), measured[0], loop)
    assert list(texts) == [text.split()[0] for text in texts.values()] == ["max_sensitivity", "max_noise_gain"]
    assert "2 of 1.6" in texts["max_sensitivity"] and "design plant stuck and 2 more" in texts["max_sensitivity"]
    assert "26 of 25" in texts["max_noise_gain"] and "(design plant stuck)" in texts["max_noise_gain"]


def test_a_figure_that_hardly_breaks_its_limit_is_told_from_it(figures, loop):
    measured = [MeasuredLoop(name="design plant", figures=replace(figures, ms=1.60004))]
    texts = explain_broken(PLAIN, judge_all(PLAIN, measured, 1), measured[0], loop)
    assert "1.60004 of 1.6" in texts["max_sensitivity"]


def test_a_message_has_room_for_the_worst_limits_and_counts_the_rest():
    blocked = [f"max_something_{number} {number}.123 of 1.6 (design plant sliding)" for number in range(8)]
    text = shorten_blocked(blocked)
    assert text.startswith(blocked[0]) and blocked[3] not in text and "more limits" in text
    assert len(text) < 180
    assert shorten_blocked(blocked[:1]) == blocked[0]


@pytest.mark.parametrize("level", [np.inf, -np.inf, np.nan, True])
def test_a_level_that_is_not_a_finite_number_is_refused_and_the_way_to_lift_it_named(level):
    for name in LIFTABLE:
        with pytest.raises(ControlError, match=rf"{name} = .*false"):
            so.ControllerSpec(bandwidth_hz=20, **{name: level})
    for name in {limit.name for limit in MPC_LIMITS if limit.has_field} - {"bandwidth_hz"}:
        with pytest.raises(ControlError, match=rf"{name} = .*false"):
            MPCSpec(bandwidth_hz=20, current_limit_A=9.0, **{name: level})


def test_a_limit_is_named_once_with_its_plants():
    labels = ["max_sensitivity (sliding)", "max_sensitivity (stuck)", "max_noise_gain"]
    limits = list(map(BindingLimit._from_json, labels))
    assert list(map(str, limits)) == labels
    assert limits[1] == BindingLimit(name="max_sensitivity", plant="stuck")
    assert join_limits(limits) == "max_sensitivity (sliding and stuck), max_noise_gain"
