"""Response and differences on logs of a machine that shares nothing with seaopt."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats

import seaopt as so
from seaopt.machine.bringup.excitation import design_excitation
from seaopt.machine.design_run import run_design
from seaopt.machine.page.verdict import say_needed, say_undecided
from seaopt.machine.response.discs import Ratio
from seaopt.machine.response.judged import Prediction
from seaopt.machine.response.measured_margins import list_margins
from seaopt.machine.response.periods import LeftOut, cut_periods, find_period, join_blocks
from seaopt.machine.response.verdicts import Measured, judge_response, measure
from seaopt.machine.ticks import take_ticks
from tests.machine.conftest import FRICTION
from tests.machine.simulator import Bench, Machine, multisine

LINES = np.unique(np.round(np.geomspace(1, 150, 40)).astype(int))
REFERENCE = multisine(1000, LINES, 10, 60.0, 3, bias=300.0)


def respond(machine, f, controller, delay, period=1e-3):
    """Return L and Y/R of the simulator's equations: sampled exactly by python's own matrix exponential; `period`: of
    the ticks, in which the law's numbers are the same.
    """
    a = np.array([[0.0, 1.0], [-machine.stiffness / machine.mass, -machine.damping / machine.mass]])
    b = np.array([0.0, machine.per_ampere * controller.per_effort / machine.mass])
    whole = np.zeros((3, 3))
    whole[:2, :2], whole[:2, 2] = a, b
    moved = scipy.linalg.expm(whole * period)
    z = np.exp(2j * np.pi * f * period)
    plant = np.array([machine.stiffness * np.linalg.solve(x * np.eye(2) - moved[:2, :2], moved[:2, 2])[0] for x in z])
    plant = plant * z**-delay
    forward, feedback = controller.law.responses(f * period / 1e-3)
    return -feedback * plant, forward * plant / (1.0 - feedback * plant)


def test_the_measured_loop_is_that_of_the_equations(controller, bench):
    machine = Machine()
    response = so.accept(controller, [bench.log(machine, REFERENCE, noise=0.0)]).response
    (part,) = response.measured
    loop, tracking = respond(machine, part.f, controller, 1)
    assert np.allclose(part.loop.value, loop, rtol=1e-4) and np.allclose(part.tracking.value, tracking, rtol=1e-4)
    by_name = {row.name: row for row in response.judged}
    assert np.isclose(by_name["Ms"].value, np.max(1.0 / np.abs(1.0 + loop)), rtol=1e-4)
    assert response.met and all(row.outcome == "confirmed" for row in response.judged if row.limit is not None)


def test_margins_are_those_of_the_equations(controller, bench):
    import control

    machine = Machine()
    response = so.accept(controller, [bench.log(machine, REFERENCE)]).response
    f = np.geomspace(0.5, 200.0, 4000)
    loop = control.frd(respond(machine, f, controller, 1)[0], 2.0 * np.pi * f)
    gain, phase, *_, crossing = control.stability_margins(loop)[:5]
    truth = {
        "gain margin": 20.0 * np.log10(gain),
        "phase margin": phase,
        "delay margin": 1e3 * np.radians(phase) / crossing,
    }
    rows = {row.name: row for row in response.judged if row.name in truth}
    assert [row.unit for row in rows.values()] == ["dB", "deg", "ms"]
    for name, value in truth.items():
        assert rows[name].low < value < rows[name].high and np.isclose(rows[name].value, value, rtol=0.1), name
        assert np.isclose(rows[name].predicted, value, rtol=0.05)


def test_a_margin_whose_interval_would_say_nothing_is_not_told_and_what_tells_it_is_said(controller, bench):
    """Once as many periods are recorded as it says, the margin of the equations is told."""
    noise, short = 9.0, REFERENCE[: 4 * 1000]
    result = so.accept(controller, [bench.log(Machine(), short, noise=noise)])
    row = next(row for row in result.response.judged if row.name == "gain margin")
    assert row.low is None and row.high is None and row.periods > result.response.measured[0].periods
    text = " ".join(str(result).split())
    assert "does not tell the gain margin" in text and f"{row.periods} periods in all" in text
    long = np.tile(REFERENCE[:1000], row.periods + 1)
    after = so.accept(controller, [bench.log(Machine(), long, noise=noise, seed=2)])
    told = next(row for row in after.response.judged if row.name == "gain margin")
    assert told.low is not None and told.low > 0.0


def test_a_line_at_which_the_effort_is_not_sure_is_the_one_that_decides_with_periods(controller, bench):
    """Its loop gain is small there, so that nothing else leaves Ms open; the std of the mean falls with the root."""
    blocks = cut_periods(controller, take_ticks(controller, bench.log(Machine(), REFERENCE, noise=0.0)))
    count, added = len(blocks.effort), np.zeros_like(blocks.effort)
    turns = np.exp(2j * np.pi * np.arange(count) / count)  # of no mean
    added[:, -1] = turns * np.abs(np.mean(blocks.effort[:, -1])) / 2.5 * np.sqrt(count - 1.0)  # 2.5 std, of 5 asked
    changed = blocks.change_efforts(lambda each: each.effort + added)
    (row,) = (row for row in judge_response(controller, [changed], 0.95).judged if row.name == "Ms")
    assert (row.outcome, row.periods, row.where_hz) == ("undecided", 4 * count, blocks.f[-1]) and row.high < row.limit


@pytest.mark.parametrize("theirs", [1.0, 1.1])
def test_a_bandwidth_that_certified_machines_have_not_at_the_lowest_line_is_not_confirmed(controller, bench, theirs):
    """A machine below -3 dB at all lines was confirmed, as none lay below nine tenths of the least bandwidth."""
    machine = replace(Machine(), per_ampere=0.02 * Machine().per_ampere)
    assert np.max(np.abs(respond(machine, LINES, controller, 1)[1])) < np.sqrt(0.5)
    log = bench.log(machine, multisine(1000, LINES, 10, 10.0, 3), noise=0.05)  # whose command is below its limit
    result, blocks = so.accept(controller, [log]), cut_periods(controller, take_ticks(controller, log))
    prediction = Prediction(figures={}, peaks={}, bandwidth_hz=theirs * LINES[0], turned=False)
    response = judge_response(controller, [blocks], 0.95, prediction=prediction)
    (row,) = (each for each in response.judged if each.name == "bandwidth")
    assert (row.outcome, row.certified, row.periods) == ("undecided", prediction.bandwidth_hz, None), row
    assert row.limit == pytest.approx(0.9 * theirs) and "larger amplitude" in say_needed(result, row)
    (said,) = (each for each in say_undecided(result, response).split("; ") if each.startswith("bandwidth, as played"))
    assert f"fall below -3 dB at {theirs:g} Hz" in said


def run_at(bench, machine, rate):
    """Return the log of a machine whose law is stepped at another rate, with the time that its firmware believes."""
    run = bench.log(machine, REFERENCE, noise=0.5, period=1e-3 / rate)
    signals = {name: run[name] for name in ("reference", "I", "F1")}
    return so.Log.from_arrays(time=1e-3 * np.arange(len(run)), **signals)


@pytest.mark.parametrize("rate", [0.5, 0.25])
def test_a_law_at_another_rate_whose_command_is_at_its_limit_in_each_period_is_named(controller, bench, rate):
    """There is no response to tell it by, but the machine answers the commands."""
    machine = replace(Machine(), damping=1.2 * Machine().damping, per_ampere=0.97 * Machine().per_ampere)
    result = so.accept(controller, [run_at(bench, machine, rate)])
    (text,) = result.left_out.values()
    assert not result.met and result.response is None and not result.experiments
    assert "check the rate at which the law is stepped" in text or "check the signs" in text
    assert result.to_dict()["stepped"]["value"] == 1e3 * rate and f"stepped at {1e3 * rate:g} Hz" in str(result)


@pytest.mark.parametrize("changes", [{}, {"drive_sign": -1.0}, {"stiffness": 2.0}, {"mass": 2.0}])
def test_no_rate_is_named_where_the_law_is_stepped_at_its_own(controller, bench, changes):
    from seaopt.machine.differences.rate_of_commands import find_rate

    base = Machine()
    machine = replace(base, **{name: value * getattr(base, name) for name, value in changes.items()})
    log = bench.log(machine, REFERENCE, noise=2.0)
    assert find_rate(controller, take_ticks(controller, log)) is None


@pytest.mark.parametrize("factors", [{"k": 1.5, "J": 0.7}, {"k": 1 / 1.5, "J": 1 / 0.7}])
def test_a_machine_of_other_values_is_not_one_at_another_rate(controller, factors):
    """It is as fast as the certified one at 683 Hz or 1463 Hz would be, and no timer runs at those."""
    base = controller.design[1]
    values = base.update(**{name: base[name].value * factor for name, factor in factors.items()})
    run = run_design(controller, [values], REFERENCE)
    log = so.Log.from_arrays(
        time=1e-3 * np.arange(REFERENCE.size), reference=REFERENCE, F1=run.outputs["F1"][0], I=run.current[0]
    )
    result = so.accept(controller, [log], uncertainty=base, ranges={"eta": (0.95, 1.05), "b_r": (1.0e-4, 1.6e-4)})
    assert result.response.rate == 1.0 and len(result.experiments) == 1
    assert not any(each.kind == "rate" for each in result.differences.found)


@pytest.mark.parametrize("rate", [0.5, 2.0])
def test_a_law_at_another_rate_is_named_by_its_response_where_the_clock_of_the_log_counts_ticks(
    compiler, tmp_path, controller, rate
):
    controller = so.tune(*controller.design, replace(controller.spec, bandwidth_hz=15))
    bench = Bench(compiler, tmp_path, controller)
    machine = replace(Machine(), damping=1.1 * Machine().damping)
    log = run_at(bench, machine, rate)
    ranges = {"eta": (0.95, 1.05), "b_r": (1.0e-4, 1.6e-4)}
    result = so.accept(controller, [log], uncertainty=so.plants.thor(), ranges=ranges)
    first = result.differences.found[0]
    assert result.replayed and not result.met and not result.experiments
    assert (first.kind, first.value) == ("rate", 1e3 * rate) and f"stepped at {1e3 * rate:g} Hz" in str(result)
    judged = tuple(replace(row, outcome="undecided", periods=12) for row in result.response.judged)
    open_ = replace(result.response, judged=judged, needs_lines=(3.0, 50.0), missing=((3.0, 50.0),))
    said = " ".join(str(replace(result, response=open_)).split())
    assert "record again once the law is stepped at its rate" in said
    assert "lines from 3 to 50 Hz" not in said and "periods in all" not in said
    assert said.index("the law is stepped at") < said.index("the log does not decide")

    import control

    rows = {row.name: row for row in result.response.judged}
    f = np.geomspace(0.5, 200.0, 4000)
    loop, tracking = respond(machine, f, controller, 1, 1e-3 / rate)
    phase, *_, crossing = control.stability_margins(control.frd(loop, 2.0 * np.pi * f))[1:5]
    down = f[np.flatnonzero(np.abs(tracking) < np.sqrt(0.5))[0]]
    (part,) = result.response.measured
    at_lines = respond(machine, part.f, controller, 1, 1e-3 / rate)[0]
    assert rows["Ms"].low < np.max(1.0 / np.abs(1.0 + at_lines)) < rows["Ms"].high
    assert np.isclose(rows["bandwidth"].value, down, rtol=0.1)
    assert np.isclose(rows["delay margin"].value, 1e3 * np.radians(phase) / crossing, rtol=0.15)


def test_the_right_machine_is_accepted(controller, bench):
    result = so.accept(controller, [bench.log(Machine(), REFERENCE)])
    assert result.met and result.differences.inside and result.differences.misfit < 2.0, result


def test_what_differs_by_less_than_a_machine_and_its_model_is_said_to_do_so(controller, bench):
    """1 % of the motor's torque without noise: within the 2 % of the response that are allowed, and named."""
    machine = replace(Machine(), per_ampere=0.99 * Machine().per_ampere)
    result = so.accept(controller, [bench.log(machine, REFERENCE, noise=0.01)])
    assert result.met and {result.differences.found[0].name, *result.differences.found[0].alike} & {"eta", "K_tau"}
    text = " ".join(str(result).split())
    assert "to 2 % of its response" in text and "may make more: dry friction at a smaller amplitude" in text


@pytest.mark.parametrize(
    ("machine", "kind", "name", "value"),
    [
        (replace(Machine(), per_ampere=0.85 * Machine().per_ampere), "parameter", "K_tau", 0.85),
        (replace(Machine(), stiffness=0.8 * Machine().stiffness), "parameter", "k", 0.8),
        (replace(Machine(), damping=2.0 * Machine().damping), "parameter", "b_r", 2.0),
        (replace(Machine(), delay_s=2e-3), "delay", "delay", 2e-3),
        (replace(Machine(), late=2.0), "delay", "delay", 1e-3),
        (Machine().with_mode(40.0), "mode", "mode", 40.0),
    ],
)
def test_another_machine_is_found_and_named(controller, bench, machine, kind, name, value):
    result = so.accept(controller, [bench.log(machine, REFERENCE)])
    assert result.replayed and not result.met and not result.differences.inside
    first = result.differences.found[0]
    assert name in (first.name, *first.alike) and np.isclose(first.value, value, rtol=0.05), result
    assert first.kind == kind or first.alike


def test_a_parameter_that_the_response_hardly_tells_has_no_interval(controller, bench):
    stand, values = controller.design
    blind = replace(controller, design=(stand, values.with_parameters(replace(values["b_r"], value=1e-12, min=0.0))))
    result = so.accept(blind, [bench.log(replace(Machine(), stiffness=0.8 * Machine().stiffness), REFERENCE)])
    assert result.differences is not None and repr(result)


@pytest.mark.parametrize(
    ("ranges", "says"),
    [({"kk": (6e5, 7e5)}, "no plant has it"), ({"k": (7e5, 6e5)}, "empty")],
)
def test_a_wrong_range_is_refused(controller, bench, ranges, says):
    with pytest.raises(so.SeaoptError, match=says):
        so.accept(controller, [bench.log(Machine(), REFERENCE)], uncertainty=so.plants.thor(), ranges=ranges)


def test_a_sensor_at_its_range_is_named(controller, bench):
    log = bench.log(replace(Machine(), sensor_range=330.0), REFERENCE)
    result = so.accept(controller, [log])
    assert not result.met and result.differences.found[0].kind == "range"


def test_a_figure_that_the_machine_breaks_is_refuted_and_one_in_the_noise_is_undecided(controller, bench):
    late = so.accept(controller, [bench.log(replace(Machine(), delay_s=2e-3), REFERENCE)])
    (ms,) = (row for row in late.response.judged if row.name == "Ms")
    assert ms.outcome == "refuted" and ms.low > ms.limit
    noisy = so.accept(controller, [bench.log(Machine(), REFERENCE[:4000], noise=6.0)])
    (ms,) = (row for row in noisy.response.judged if row.name == "Ms")
    assert ms.outcome == "undecided" and ms.periods > 3 and ms.low < ms.limit < ms.high


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        ([1, 28], "record at least 8 lines from"),
        (range(20, 130, 3), "lines from {low:.3g} to 20 Hz, each at most 1.5 times"),
        ([1, 2, 4, 8, 16, 32, 64, 128], "lines from 8 to 64 Hz, each at most 1.5 times"),
        (LINES[LINES < 57], "beside the lines that were played a line at {high:.3g} Hz or above"),
    ],
)
def test_lines_that_miss_the_crossover_confirm_nothing_and_the_row_says_which_to_play(controller, bench, lines, says):
    machine = replace(Machine(), delay_s=2e-3)
    result = so.accept(controller, [bench.log(machine, multisine(1000, np.array(lines), 10, 60.0, 3, bias=300.0))])
    low, high = result.response.needs_lines
    crossover = controller.achieved.crossover_hz
    assert np.isclose(low, crossover / 4.0) and np.isclose(high, 2.0 * crossover)
    outcomes = {row.name: row.outcome for row in result.response.judged}
    assert "confirmed" not in outcomes.values() and outcomes["stability"] == "undecided" and not result.met
    assert says.format(low=low, high=high) in " ".join(repr(result).split())


def test_where_a_limit_is_refuted_no_periods_are_asked_for_another(controller, bench):
    """Noise leaves Mt open beside Ms, which is refuted: its periods are of a loop that is to be mended."""
    log = bench.log(replace(Machine(), delay_s=1e-3), REFERENCE[:4000], noise=3.0)
    result = so.accept(controller, [log])
    outcomes = [row.outcome for row in result.response.judged if row.limit is not None]
    assert "refuted" in outcomes and any(row.periods for row in result.response.judged)
    words = " ".join(str(result).split())
    assert "mend what is refuted first, then record again" in words and "periods in all" not in words


def measure_errors(controller, bench, periods, seeds, noise=1.0):
    """Return for loop and tracking the errors of logs over the equations', the std that each states, and its radius."""
    rows = {"loop": [], "tracking": []}
    for seed in range(seeds):
        log = bench.log(Machine(), REFERENCE[: 1000 * (periods + 1)], noise=noise, seed=seed)
        part = measure(controller, cut_periods(controller, take_ticks(controller, log)), by_phases=False)
        assert part.blocks == periods
        for (name, kept), exact in zip(rows.items(), respond(Machine(), part.f, controller, 1), strict=True):
            centre, radius = getattr(part, name).disc(0.05)
            kept.append((np.abs(centre - exact), getattr(part, name).std, radius))
    return part.f, {name: np.moveaxis(kept, 1, 0) for name, kept in rows.items()}


@pytest.mark.parametrize(("names", "periods"), [(("loop", "tracking"), 9), (("loop",), 3)])
def test_discs_hold_the_loop_of_the_equations_as_often_as_they_state_at_slow_lines_and_at_fast_ones(
    controller, bench, names, periods
):
    """Noise that goes round the loop moves the motor: below 11 Hz, what the ends of a period add to its coefficient is
    twice the noise at its line.
    """
    f, measured = measure_errors(controller, bench, periods, 60)
    for name in names:
        errors, stds, radii = measured[name]
        for chosen in (f <= 11.0, (f > 11.0) & (f <= 40.0), f > 40.0):
            size = np.mean(errors[:, chosen] ** 2 / np.mean(stds[:, chosen] ** 2, axis=0))
            held, count = np.mean(errors[:, chosen] <= radii[:, chosen]), errors[:, chosen].size
            assert 0.8 < size < 1.2 and abs(held - 0.95) < 4.0 * np.sqrt(0.05 * 0.95 / count), (name, size, held)


def test_phases_are_told_apart_and_the_first_period_of_each_is_left_out(controller, bench):
    reference = np.concatenate([multisine(1000, LINES, 3, 60.0, seed, bias=300.0) for seed in range(6)])
    assert find_period(reference) == 1000
    blocks = cut_periods(controller, take_ticks(controller, bench.log(Machine(), reference)))
    assert blocks.realisations == 6 and len(blocks.reference) == 12 and np.allclose(blocks.f, LINES)


@pytest.mark.parametrize("bias", [0.0, 600.0, 3000.0])
def test_the_period_is_found_under_a_bias_that_fades_in(bias):
    wave, rise = multisine(1000, LINES, 1, 60.0, 3), np.linspace(0.0, 1.0, 1000)
    reference = np.concatenate([rise * (bias + wave), bias + np.tile(wave, 6), rise[::-1] * (bias + wave)])
    assert find_period(reference) == 1000


def test_two_periods_are_enough_to_find_one_and_of_many_the_shortest_is_found():
    assert find_period(multisine(2000, LINES, 2, 60.0, 3)) == 2000
    assert find_period(multisine(100, np.arange(1, 20), 400, 60.0, 3, bias=300.0)) == 100


@pytest.mark.parametrize("decimals", [12, 3])
def test_a_ramp_has_no_period(decimals):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert find_period(np.round(np.linspace(0.0, 700.0, 40_000), decimals)) is None
        assert find_period(np.full(100, 3.0)) is None


@pytest.mark.parametrize(
    ("reference", "says"),
    [
        (100.0 * np.sin(np.arange(4000) ** 1.5 * 1e-3), "does not repeat"),
        (multisine(1000, LINES, 2, 60.0, 3), "at least 3 periods"),
        (multisine(1000, LINES, 4, 900.0, 3), "lower the amplitude"),
    ],
)
def test_a_log_that_tells_no_response_says_what_to_record(controller, bench, reference, says):
    result = so.accept(controller, [bench.log(Machine(), reference)])
    assert result.replayed and result.response is None and not result.met
    assert says in result.left_out["bench"] and says in " ".join(repr(result).split())


def test_discs_hold_the_truth_as_often_as_they_say():
    rng, alpha, misses, far = np.random.default_rng(1), 0.05, 0, 0
    truth, runs, m = 0.8 - 0.6j, 400, 25
    for _ in range(runs):
        w = np.full((6, m), 2.0 + 1j) + 0.05 * (rng.normal(size=(6, m)) + 1j * rng.normal(size=(6, m)))
        z = truth * (2.0 + 1j) + 0.3 * (rng.normal(size=(6, m)) + 1j * rng.normal(size=(6, m)))
        ratio = Ratio(numerator=z, denominator=w)
        centre, radius = ratio.disc(alpha)
        misses += np.count_nonzero(np.abs(centre - truth) > radius)
        far += np.count_nonzero(np.real((centre - truth) * np.exp(0.3j)) > ratio.radial(alpha))
    low, high = scipy.stats.binom.ppf([1e-4, 1.0 - 1e-4], runs * m, alpha)
    assert low <= misses <= high and low <= far <= high


def test_what_is_divided_by_nothing_sure_has_the_set_of_fieller():
    rng, alpha, held, known, runs = np.random.default_rng(2), 0.1, 0, 0, 4000
    truth, w0 = 1.5 + 0.5j, 1.0
    w = w0 + 0.8 * (rng.normal(size=(5, runs)) + 1j * rng.normal(size=(5, runs)))
    z = truth * w0 + 0.5 * (rng.normal(size=(5, runs)) + 1j * rng.normal(size=(5, runs)))
    ratio = Ratio(numerator=z, denominator=w)
    centre, radius = ratio.disc(alpha)
    unsure = ~ratio.sure
    held, known = np.mean((np.abs(centre - truth) <= radius)[unsure]), np.mean(np.isfinite(radius[unsure]))
    assert np.mean(unsure) > 0.5 and held > 0.86 and known < 1.0


def test_with_dry_friction_what_is_predicted_is_of_the_reference_that_was_played(dry):
    """The simulator's right machine has the figures that stand beside its own; as it slides they are others."""
    bench, reference = dry
    machine = replace(Machine(), coulomb=FRICTION, smoothing=5e-3)
    result = so.accept(bench.controller, [bench.log(machine, reference, noise=0.5)])
    rows = {row.name: row for row in result.response.judged if row.predicted is not None}
    assert {"Ms", "Mt", "reference peak", "bandwidth", "phase margin"} <= rows.keys()
    assert all(np.isclose(row.value, row.predicted, rtol=0.03) for row in rows.values()), rows
    assert rows["bandwidth"].state == "as played" and rows["bandwidth"].outcome == "confirmed"
    sliding = bench.controller.achieved
    assert abs(sliding.phase_margin_deg - rows["phase margin"].value) > 3.0
    assert "under the reference of the log, simulated" in " ".join(repr(result).split())
    of_all = [replace(row, limit=0.9 * 30.0) if row.name == "bandwidth" else row for row in result.response.judged]
    fast = replace(result, response=replace(result.response, judged=tuple(of_all)))  # all have what was asked
    said = " ".join(repr(fast).split())
    assert "that is judged is what was asked, 30 Hz: " in said and "it is not the 30 Hz" not in said
    harder = so.accept(bench.controller, [bench.log(replace(machine, coulomb=3.0 * FRICTION), reference, noise=0.5)])
    (slower,) = (row for row in harder.response.judged if row.name == "bandwidth")
    assert slower.outcome == "refuted" and slower.value < slower.limit < rows["bandwidth"].value, slower


@pytest.mark.slow
def test_with_dry_friction_the_machine_is_predicted_at_the_amplitude_that_was_played(dry):
    bench, reference = dry
    machine = replace(Machine(), coulomb=FRICTION, smoothing=5e-3)
    right = so.accept(bench.controller, [bench.log(machine, reference)])
    assert right.met and right.response.at_amplitude_only and right.differences.misfit < 2.0, right
    stiff = so.accept(bench.controller, [bench.log(replace(machine, coulomb=2.0 * FRICTION), reference)])
    first = stiff.differences.found[0]
    assert not stiff.met and "f_c" in (first.name, *first.alike) and first.explains > 0.95, stiff


def test_with_dry_friction_fewer_than_six_sets_of_phases_confirm_nothing(dry):
    bench, reference = dry
    log = bench.log(replace(Machine(), coulomb=FRICTION, smoothing=5e-3), reference[:8000])
    result = so.accept(bench.controller, [log])
    response, text = result.response, " ".join(repr(result).split())
    assert response.needs_phases and {row.outcome for row in response.judged} == {"undecided"}
    assert "0 of 5 limits confirmed, 0 refuted" in text
    assert "its bandwidth is 30 Hz sliding and" in text
    assert (
        "the log does not decide stability, Ms, Mt, reference peak and bandwidth, as played: record 6 sets of random"
        in text
    )


@pytest.mark.parametrize(
    ("friction", "second", "says"),
    [
        (FRICTION, 0.85, "holds at the amplitude of the log only: play one of twice or half"),  # gains agree to 3 %
        (FRICTION, 0.4, "holds at these amplitudes only"),
        (0.05 * FRICTION, 0.5, None),
    ],
)
def test_two_amplitudes_that_are_apart_tell_whether_friction_makes_another_machine_of_each(dry, friction, second, says):
    bench, reference = dry
    machine = replace(Machine(), coulomb=friction, smoothing=5e-3)
    logs = [bench.log(machine, scale * reference, noise=0.5) for scale in (1.0, second)]
    # without noise, by the sums of the last periods of all sets of phases: force over command, as both per reference
    period, gains = find_period(reference), list[np.ndarray]()
    lines = np.round(cut_periods(bench.controller, take_ticks(bench.controller, logs[0])).f * period * 1e-3).astype(int)
    for scale in (1.0, second):
        log = bench.log(machine, scale * reference, noise=0.0)
        played, force, current = (
            np.fft.rfft(log[name].reshape(-1, period)[3::4])[:, lines] for name in ("reference", "F1", "I")
        )
        gains.append(np.abs(np.sum(force / played, axis=0) / np.sum(current / played, axis=0)))
    same = bool(np.all(np.abs(gains[1] / gains[0] - 1.0) < 0.1))
    result = so.accept(bench.controller, logs)
    assert result.response.at_amplitude_only == (says is not None)
    assert same == (friction < FRICTION or second > 0.8)
    said = " ".join(repr(result).split())
    assert says in said if says else "amplitude of the log only" not in said and "amplitudes only" not in said


def test_turns_of_a_loop_that_friction_holds_are_counted_beside_the_stuck_plant(compiler, tmp_path):
    """A slow stage of a knee hardly slides: its machine comes to rest, its loop is nowhere near the sliding one."""
    plant = so.plants.rotary(link="locked")
    stated = {"N": 60, "K_tau": 0.05, "eta": 0.8, "J_m": 2e-5, "b_r": 1e-4, "f_c": 0.01, "v_s": 1.0, "k_s": 250.0}
    values = plant.complete(so.ParameterSet()).update(**stated)
    spec = so.ControllerSpec(
        bandwidth_hz=4.5, bandwidth_range_hz=(4.0, 60.0), measured="tau_s", max_noise_gain=45, current_limit_A=9.0
    )
    law = so.tune(plant, values, spec)
    options = {"share": 0.125, "bias": 0.0, "phases": 6, "periods": 4, "limits": {"tau_s": 30.0}}
    played = design_excitation(law, **options, seed=1).reference
    log = Bench(compiler, tmp_path, law).log(Machine.of_knee(values), np.append(played, np.zeros(2000)), noise=0.02)
    assert np.std(log["tau_s"][-500:]) < 0.2 * np.std(log["tau_s"])  # nearly at rest at the end: stable
    groups = join_blocks([cut_periods(law, take_ticks(law, log))])
    stability = next(row for row in judge_response(law, groups, 0.95).judged if row.name == "stability")
    assert stability.outcome == "confirmed", stability


def test_margins_of_a_loop_that_crosses_a_gain_of_one_three_times(controller):
    f = np.geomspace(1.0, 200.0, 20001)
    w, s, late = 2.0 * np.pi * f, 2j * np.pi * f, 0.0085
    for gain in (9.0, 4.0):
        loop = 2.0 * np.pi * gain / s / ((f / 70.0) ** 2 * -1.0 + 0.04j * f / 70.0 + 1.0) * np.exp(-s * late)
        at = np.flatnonzero(np.diff(np.abs(loop) > 1.0))
        margins = (np.angle(loop[at]) + 2.0 * np.pi) % (2.0 * np.pi) - np.pi
        turns = np.flatnonzero((np.diff(np.sign(loop.imag)) != 0.0) & (loop.real[:-1] < 0.0))
        truth = {
            "gain margin": min(-20.0 * np.log10(np.abs(loop[turns])), key=abs),
            "phase margin": np.degrees(margins[np.argmin(np.abs(margins))]),
            "delay margin": 1e3 * np.min(margins % (2.0 * np.pi) / w[at]),
        }
        ratio = Ratio(numerator=np.tile(loop, (2, 1)), denominator=np.ones((2, f.size)) + 0j)
        counts = {"periods": 2, "blocks": 2, "phases": 1, "amplitude": 1.0, "left_out": LeftOut()}
        part = Measured(f=f, loop=ratio, tracking=ratio, outputs={"F1": ratio}, direct=loop, by_noise=loop, **counts)
        rows = {row.name: row.value for row in list_margins(controller, [part], 0.05)}
        assert gain != 9.0 or np.isclose(rows["phase margin"], 61.68, atol=0.05)  # the others are -125 and 64 degrees
        assert rows.keys() == truth.keys()
        assert all(np.isclose(rows[name], truth[name], rtol=1e-2) for name in rows), (rows, truth)


@pytest.mark.parametrize(("beyond", "near"), [(3e-4, True), (-3e-4, True), (0.02, False)])
def test_a_figure_at_its_limit_is_said_to_be_so_in_place_of_hours_to_record(controller, bench, beyond, near):
    log = bench.log(Machine(), REFERENCE, noise=6.0)
    value = next(row.value for row in so.accept(controller, [log]).response.judged if row.name == "Ms")
    asked = replace(controller, spec=replace(controller.spec, max_sensitivity=value * (1.0 + beyond) / 1.05))
    result = so.accept(asked, [log])
    (ms,) = (row for row in result.response.judged if row.name == "Ms")
    words = " ".join(str(result).split())
    assert ms.outcome == "undecided" and ("no record of sensible length" in words) == near, ms
    assert f"{ms.periods} periods in all" not in words if near else ms.near is None
    assert not near or np.isclose(ms.near, abs(beyond), rtol=0.01)


def test_a_loop_that_ran_away_is_told_to_check_its_signs(controller, bench):
    """Of a force that the sensor has with its sign turned: the law does what it is told, and the loop runs away."""
    log = bench.log(Machine(drive_sign=-1.0), multisine(1000, LINES, 4, 60.0, 3))
    assert np.mean(np.abs(log["I"]) > 0.99 * controller.command_limit) > 0.9
    result = so.accept(controller, [log])
    assert "check the signs of command and readings" in " ".join(repr(result).split())


@pytest.mark.parametrize("seed", [1, 2])
def test_the_interval_of_a_bandwidth_agrees_with_its_outcome(controller, bench, seed):
    """It ended below the limit that was confirmed: its ends were those of all lines and of one, the wrong way round."""
    lines = np.unique(np.round(np.geomspace(1, 150, 70)).astype(int))
    f = np.geomspace(1.0, 150.0, 4000)
    truth = f[np.abs(respond(Machine(), f, controller, 1)[1]) < np.sqrt(0.5)][0]
    log = bench.log(Machine(), multisine(1000, lines, 6, 60.0, seed), noise=2.0, seed=seed)
    row = {each.name: each for each in so.accept(controller, [log]).response.judged}["bandwidth"]
    assert row.low < truth < row.high and row.outcome == "confirmed"
    assert row.low >= np.max(lines[lines <= row.limit])
