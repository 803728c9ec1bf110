"""The replay of an exported law on logs of a machine that shares nothing with seaopt, and the names of its faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import Gains, runnable
from seaopt.machine.bringup.excitation import design_excitation
from seaopt.machine.stepped import find_at_limit, find_modes, find_steady, follow
from seaopt.machine.ticks import take_ticks
from seaopt.machine.wording import say_cause
from tests.machine.conftest import SPEC
from tests.machine.simulator import Bench, Machine, multisine

LINES = np.unique(np.round(np.geomspace(1, 120, 40)).astype(int))
REFERENCE = multisine(1000, LINES, 4, 250.0, 3, bias=300.0)


def rename(log, **columns):
    """Return a log with other columns in place of some."""
    arrays = {"time": log.time, "reference": log["reference"], "I": log["I"], "F1": log["F1"]} | columns
    return so.Log.from_arrays(source="bench", **arrays)


def cause_of(controller, log, **options):
    """Return the first cause that the replay names."""
    (row,) = so.accept(controller, [log], **options).replays
    assert not row.met and row.causes[0].explains, row
    return row.causes[0]


@pytest.mark.parametrize("noise", [0.0, 5.0])
def test_the_exported_law_is_replayed_to_the_last_digits(controller, bench, noise):
    (row,) = so.accept(controller, [bench.log(Machine(), REFERENCE, noise=noise)]).replays
    assert row.met and row.mismatch < 1e-12 and row.command_late == 0 and row.causes == ()


def test_what_a_state_adds_to_the_commands_is_what_steps_add(controller):
    """Of rows whose command is at its limit, now and then, and of none."""
    law = runnable(controller)
    limited = np.repeat([False, True, False, True], [700, 30, 1, 69])
    states, expected = np.eye(law.c.size), []
    for at_limit in limited:
        effort = law.c @ states
        expected.append(law.per_effort * effort)
        states = law.a @ states - at_limit * np.outer(law.anti_windup, effort)
    np.testing.assert_allclose(find_modes(law, limited), expected, rtol=1e-9, atol=1e-12 * np.max(np.abs(expected)))
    assert find_modes(law, limited[:0]).shape == (0, law.c.size)
    x, expected = np.zeros(law.c.size), []
    for at_limit in limited:  # of a reference of one
        effort = law.c @ x + law.d_reference
        expected.append(law.per_effort * effort)
        x = law.a @ x + law.b_reference - at_limit * law.anti_windup * effort
    np.testing.assert_allclose(find_steady(law, limited), expected, rtol=1e-9, atol=1e-12 * np.max(np.abs(expected)))


@pytest.mark.parametrize("share", [1.0, 0.5, 0.0])
def test_commands_with_the_limit_as_logged_are_those_of_steps(controller, bench, share):
    law, ticks = runnable(controller), take_ticks(controller, bench.log(Machine(), 4.0 * REFERENCE))
    limited, x, expected = find_at_limit(ticks, law), np.zeros(law.c.size), []
    assert 0.1 < np.mean(limited) < 0.9
    for reference, reading, command, at_limit in zip(
        ticks.reference, ticks.measured[:, 0], ticks.command, limited, strict=True
    ):
        effort = law.c @ x + law.d_reference * reference - law.d_measurement * reading
        expected.append(law.per_effort * effort)
        over = share * law.force_limit_N * np.sign(command) - effort
        x = law.a @ x + law.b_reference * reference - law.b_measurement * reading + at_limit * law.anti_windup * over
    atol = 1e-12 * np.max(np.abs(expected))
    np.testing.assert_allclose(follow(law, ticks, limited, share), expected, rtol=1e-9, atol=atol)


@pytest.mark.parametrize("decimals", [None, 2, 0])
def test_a_log_that_begins_in_the_middle_and_is_rounded_is_the_same_law(controller, bench, decimals):
    log = bench.log(Machine(), REFERENCE, decimals=decimals).between(1.2345, 3.7)
    assert so.accept(controller, [log]).replayed


@pytest.mark.parametrize("late", [0, 1])
@pytest.mark.parametrize("cut", [np.floor, np.ceil, np.round, lambda values: np.round(values - 0.2)])
def test_an_offset_of_a_reference_in_coarse_steps_is_said_where_rounding_does_not_make_it(
    controller, bench, cut, late, tmp_path
):
    step, log = 0.5, bench.log(Machine(), REFERENCE)
    logged = step * cut(log["reference"] / step)
    truth, made = float(np.mean(log["reference"] - logged)), cut is not np.round
    columns = {"reference": logged, "F1": log["F1"], "I": np.roll(log["I"], late)}
    result = so.accept(controller, [so.Log.from_arrays(time=log.time, **columns).between(0.05, 9.5)])
    (row,) = result.replays
    assert row.met and row.command_late == late and made == (row.offset is not None), row
    text = " ".join(repr(result).split())
    assert made == ("within half of its step of 0.5 N" in text)
    if row.offset is not None:
        assert abs(row.offset.value - truth) < 3.0 * row.offset.std < 0.1 * step, (row.offset, truth)
        assert row.offset.step == pytest.approx(step) and not row.offset.or_reading
        assert f"{abs(row.offset.value):.3g} N {'above' if truth > 0.0 else 'below'}" in text
        assert result.to_dict()["replay"]["logs"][0]["offset"]["value"] == row.offset.value


@pytest.mark.parametrize("late", [1, -1])
def test_a_command_that_is_logged_a_row_late_or_early_is_allowed(controller, bench, late):
    log = bench.log(Machine(), REFERENCE)
    shifted = rename(log, I=np.roll(log["I"], late)).between(0.1, 3.5)
    (row,) = so.accept(controller, [shifted]).replays
    assert row.met and row.command_late == late


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"law_gain": 0.5}, ("factor", "I", 0.5)),
        ({"reading_sign": -1.0}, ("sign", "F1", -1.0)),
        ({"reading_sign": 1e-3}, ("unit", "F1", 1e-3)),  # of which a command hardly shows more than of an open loop
        ({"every": 2.0}, ("rate", "law", 500.0)),
    ],
)
def test_a_fault_of_the_firmware_has_its_name(controller, bench, changes, expected):
    cause = cause_of(controller, bench.log(replace(Machine(), **changes), REFERENCE))
    assert (cause.kind, cause.what) == expected[:2] and np.isclose(cause.value, expected[2], rtol=1e-6)


STEPS = 100.0 * ((np.arange(3000) // 500) % 4)


@pytest.mark.parametrize("reference", [STEPS, 100.0 * np.sign(np.sin(0.02 * np.arange(3000)))])
def test_levels_of_a_reference_are_no_rounding_under_which_any_command_passes(controller, bench, reference):
    log = bench.log(Machine(), reference)
    (row,) = so.accept(controller, [log]).replays
    assert row.met and row.allowed < 0.01 * row.rms
    for factor in (0.5, -1.0, 0.0):
        assert not so.accept(controller, [rename(log, I=factor * log["I"])]).replayed


def test_a_log_whose_rounding_allows_much_of_the_command_is_undecided(controller, bench):
    log = bench.log(Machine(), STEPS)
    result = so.accept(controller, [rename(log, F1=50.0 * np.round(log["F1"] / 50.0))])
    (row,) = result.replays
    assert not row.met and row.allowed > 0.1 * row.rms and [cause.kind for cause in row.causes] == ["rounding"]
    assert "more digits" in str(result)


COARSE = 100.0  # N, of a converter's counts


def test_a_log_that_is_saturated_throughout_is_not_called_rounded(controller):
    push, noise = np.ones(4000), np.random.default_rng(1).normal(size=4000)
    log = so.Log.from_arrays(time=1e-3 * np.arange(4000), reference=5000.0 * push, I=9.0 * push, F1=2000.0 + noise)
    result = so.accept(controller, [log])
    assert [cause.kind for cause in result.replays[0].causes] == ["saturated"] and result.replays[0].undecided
    assert "undecided: the command is at its limit in most rows" in " ".join(str(result).split())


def test_counts_that_the_law_reads_are_not_what_a_log_is_rounded_to(controller, bench):
    log = bench.log(replace(Machine(), force_step=COARSE), REFERENCE)
    assert np.unique(log["F1"]).size < 30
    (row,) = so.accept(controller, [log]).replays
    assert row.met and row.mismatch < 1e-12 and row.allowed < 0.01 * row.rms


def test_a_fault_that_rounding_would_hide_is_named_where_it_leaves_nothing(controller, bench):
    """A command 1.5 % too large, within what counts would allow if the log had rounded them."""
    log = bench.log(replace(Machine(), force_step=COARSE), REFERENCE)
    cause = cause_of(controller, rename(log, I=1.015 * log["I"]))
    assert (cause.kind, cause.what) == ("factor", "I") and np.isclose(cause.value, 1.015, rtol=1e-6)


def test_counts_of_another_law_are_no_rounding_either(controller, bench):
    log = bench.log(replace(Machine(), force_step=COARSE), REFERENCE)
    (row,) = so.accept(controller, [rename(log, I=0.5 * log["I"])]).replays
    assert row.causes[0].explains and row.allowed < 0.01 * row.rms


def test_a_sign_is_listed_once(controller, bench):
    result = so.accept(controller, [bench.log(replace(Machine(), reading_sign=-1.0), REFERENCE)])
    (row,) = result.replays
    causes = [(cause.kind, cause.what, cause.value) for cause in row.causes]
    assert ("sign", "F1", -1.0) in causes and len(set(causes)) == len(causes)
    assert row.saturated > 0.995 and "  100 %  1000" in str(result)  # at limit, rate


def test_readings_that_a_log_rounds_are_still_allowed_for(controller, bench):
    log = bench.log(Machine(), REFERENCE)
    (row,) = so.accept(controller, [rename(log, F1=COARSE * np.round(log["F1"] / COARSE))]).replays
    assert row.allowed > 0.05 * row.rms and (row.met or row.causes[0].kind == "rounding")


def test_a_law_that_is_stepped_at_another_rate_is_told_by_the_clock(controller, bench):
    cause = cause_of(controller, bench.log(Machine(), REFERENCE, period=2e-3))
    assert (cause.kind, cause.what) == ("rate", "clock") and np.isclose(cause.value, 500.0)


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        (lambda log: {"I": 1e3 * log["I"]}, ("unit", "I", 1e3, "the logged value is 1000 times what the law returned")),
        (
            lambda log: {"F1": 1e-3 * log["F1"]},
            ("unit", "F1", 1e3, "the logged value is 0.001 times what the law was given"),
        ),
        (lambda log: {"reference": -log["reference"]}, ("sign", "reference", -1.0, "the sign of reference is turned")),
    ],
)
def test_a_column_in_another_unit_or_sign_has_its_name(controller, bench, columns, expected):
    log = bench.log(Machine(), REFERENCE)
    cause = cause_of(controller, rename(log, **columns(log)))
    assert (cause.kind, cause.what) == expected[:2] and np.isclose(cause.value, expected[2])
    assert say_cause(cause, "I").endswith(expected[3])


def test_no_two_causes_of_one_log_are_said_alike(controller, bench):
    log = bench.log(Machine(), REFERENCE)
    (row,) = so.accept(controller, [rename(log, F1=0.0 * log["F1"])]).replays
    said = [say_cause(cause, "I") for cause in row.causes]
    assert len(said) == len(set(said)) > 3, said


def test_another_law_and_another_limit_are_named(compiler, tmp_path, controller):
    stand, thor = so.plants.high_impedance(), so.plants.thor()
    slower = so.tune(stand, thor, replace(SPEC, bandwidth_hz=22.0))
    log = Bench(compiler, tmp_path, slower).log(Machine(), REFERENCE)
    cause = cause_of(controller, log, others={"old/controller.json": slower})
    assert (cause.kind, cause.what) == ("another law", "old/controller.json")
    lower = Bench(compiler, tmp_path, replace(controller, spec=replace(SPEC, current_limit_A=2.0)), "lower")
    cause = cause_of(controller, lower.log(Machine(), REFERENCE))
    assert (cause.kind, cause.value) == ("limit", 2.0)


def test_a_missing_feedforward_is_named(compiler, tmp_path, controller):
    gains = {name: controller.gains[name] for name in ("k_p", "k_i", "k_d", "T_f", "c")}
    law = Gains(**gains, k_r=controller.gains["k_p"]).law("pid", 1e-3).balanced()
    custom = replace(controller, law=law, structure="custom", gains={}, spec=replace(SPEC, structure="custom"))
    cause = cause_of(controller, Bench(compiler, tmp_path, custom).log(Machine(), REFERENCE))
    assert (cause.kind, cause.what) == ("feedforward", "reference")


def test_a_loop_that_is_open_by_mistake_is_named(controller, bench):
    log = bench.log(replace(Machine(), reading_sign=0.0), REFERENCE)
    cause = cause_of(controller, log)
    assert (cause.kind, cause.what) == ("open loop", "F1")


def test_what_a_log_lacks_is_said_with_what_to_record(controller, bench):
    log = bench.log(Machine(), REFERENCE)
    lacks = {"reference": "--reference COLUMN", "I": "as it returned it", "F1": "log in each tick F1"}
    for left_out, says in lacks.items():
        arrays = {"time": log.time} | {name: log[name] for name in ("reference", "I", "F1") if name != left_out}
        with pytest.raises(so.SeaoptError, match=says):
            so.accept(controller, [so.Log.from_arrays(**arrays)])
    with pytest.raises(so.SeaoptError, match="log at least 50 ticks"):
        so.accept(controller, [log.between(0.0, 0.02)])


def test_a_log_in_which_nothing_moves_tells_no_law(controller):
    still = {"reference": np.full(1000, 300.0), "F1": np.full(1000, 300.0), "I": np.full(1000, 0.3)}
    with pytest.raises(so.SeaoptError, match="nothing moves in it"):
        so.accept(controller, [so.Log.from_arrays(time=1e-3 * np.arange(1000), **still)])


def test_a_command_of_its_own_is_not_called_a_limit(controller, bench):
    log = bench.log(Machine(), REFERENCE[:4000])
    sine = 0.3 + 0.05 * np.sin(0.05 * np.arange(4000))
    result = so.accept(
        controller, [so.Log.from_arrays(time=log.time, reference=log["reference"], F1=log["F1"], I=sine)]
    )
    assert not result.replayed and "limit" not in {cause.kind for cause in result.replays[0].causes}


def test_a_place_that_is_no_number_is_refused(controller, bench):
    log = bench.log(Machine(), REFERENCE[:200])
    with pytest.raises(so.SeaoptError, match="at = True is a bool"):
        so.accept(controller, [log], at=True)


def test_a_law_with_gravity_compensation_is_replayed_from_the_middle_of_a_run_and_its_fault_is_named():
    from seaopt.control import CompensateGravity, SampledLoop, add_compensation, run_loop, runnable

    swing, values = so.plants.moving_output(), so.plants.thor().update(d=2.0)
    spec = so.ControllerSpec(bandwidth_hz=20, current_limit_A=9.0, max_sensitivity=1.6)
    law = so.tune(so.plants.high_impedance(), values, spec, {"swing": swing})
    law = add_compensation(law, gravity=CompensateGravity(fraction=0.9), link=(swing, values))
    reference = multisine(1000, LINES, 3, 20.0, 3)
    loop = SampledLoop(plant=swing, law=runnable(law), measured="F1", delay_samples=1)
    run = run_loop(loop, [swing.complete(values).drop_conditions()], reference)
    late = slice(701, None)  # the command of a row is put out in the next one
    columns = {name: run.outputs[name][0][700:-1] for name in ("F1", "x_2")}
    columns |= {"time": 1e-3 * np.arange(reference.size - 701), "reference": reference[700:-1]}
    log = so.Log.from_arrays(**columns, I=run.current[0][late])
    assert so.accept(law, [log]).replayed
    cause = cause_of(law, so.Log.from_arrays(**columns, I=0.5 * run.current[0][late]))
    assert (cause.kind, cause.what) == ("factor", "I") and np.isclose(cause.value, 0.5)


GENTLE = multisine(1000, LINES, 8, 60.0, 3, bias=300.0)


def keep_every(log, every, *, late=0, factor=1.0, rows=slice(2, -2)):
    """Return every n-th row of a log, with the command some rows late, and scaled."""
    columns = {name: log[name][rows][::every] for name in ("reference", "F1")} | {"time": log.time[rows][::every]}
    return so.Log.from_arrays(**columns, I=factor * np.roll(log["I"], late)[rows][::every])


@pytest.mark.parametrize("late", [0, 1, -1])
def test_a_log_of_every_second_tick_is_compared_at_its_lines(controller, bench, late):
    log = bench.log(Machine(), GENTLE)
    result = so.accept(controller, [keep_every(log, 2, late=late)])
    (row,) = result.replays
    assert row.met and (row.ticks_per_row, row.command_late) == (2, late), result
    assert result.differences.inside and "refuted" not in {each.outcome for each in result.response.judged}
    cause = cause_of(controller, keep_every(log, 2, late=late, factor=0.5))
    assert (cause.kind, cause.what) == ("factor", "I") and np.isclose(cause.value, 0.5, rtol=0.01)


SLOW = np.unique(np.round(np.geomspace(1, 45, 20)).astype(int))


@pytest.fixture(scope="module")
def halved(compiler, tmp_path_factory, controller):
    """Return the benches of the law with each gain at half its size."""
    gains, folder = Gains.from_names(controller.gains), tmp_path_factory.mktemp("halved")
    benches = {}
    for name in ("k_p", "k_i", "k_d"):
        law = replace(gains, **{name: 0.5 * controller.gains[name]}).law("pid", 1e-3).balanced()
        custom = replace(controller, law=law, structure="custom", gains={}, spec=replace(SPEC, structure="custom"))
        benches[name] = Bench(compiler, folder, custom, name)
    return benches


@pytest.mark.parametrize("every", [2, 10])
@pytest.mark.parametrize("periods", [4, 12])
def test_few_rows_of_a_right_law_are_never_another_and_a_halved_gain_is_never_this_law(
    controller, bench, halved, every, periods
):
    for seed in range(3):
        reference = multisine(1000, SLOW, periods, 60.0, seed, bias=300.0)
        right = so.accept(controller, [keep_every(bench.log(Machine(), reference, seed=seed), every)])
        (row,) = right.replays
        assert row.met or row.undecided, row
        if row.undecided:
            assert row.causes[0].value > 0.001 * reference.size and "would decide" in str(right), right
        for name, each in halved.items():
            (row,) = so.accept(controller, [keep_every(each.log(Machine(), reference, seed=seed), every)]).replays
            assert not row.met
            cause = row.causes[0]
            assert row.undecided or (cause.kind, cause.what) == ("gain", name), (seed, name, row)
            assert row.undecided or np.isclose(cause.value, 0.5 * controller.gains[name], rtol=0.2)


def test_long_logs_of_every_tenth_tick_name_a_halved_derivative_a_weak_drive_and_say_of_a_turned_sign_what_to_check(
    controller, bench, halved
):
    reference = multisine(1000, SLOW, 60, 60.0, 1, bias=300.0)

    def judge(bench, machine):
        return so.accept(controller, [keep_every(bench.log(machine, reference), 10)])

    right, derivative = judge(bench, Machine()), judge(halved["k_d"], Machine())
    assert right.replayed and right.differences.inside
    (row,) = derivative.replays
    assert (row.causes[0].kind, row.causes[0].what) == ("gain", "k_d")
    assert np.isclose(row.causes[0].value, 0.5 * controller.gains["k_d"], rtol=0.05)
    weak = judge(bench, replace(Machine(), per_ampere=0.85 * Machine().per_ampere))
    assert weak.replayed and np.isclose(weak.differences.found[0].value, 0.85, atol=0.02)
    turned = judge(bench, replace(Machine(), reading_sign=-1.0))
    assert turned.replays[0].undecided and "check signs and units" in " ".join(str(turned).split())


@pytest.mark.parametrize("every", [2, 10])
def test_a_law_with_another_part_is_refuted_or_named_beside_this_law(controller, compiler, tmp_path, bench, every):
    law = replace(Gains.from_names(controller.gains), T_f=0.5 * controller.gains["T_f"]).law("pid", 1e-3).balanced()
    custom = replace(controller, law=law, structure="custom", gains={}, spec=replace(SPEC, structure="custom"))
    other, reference = Bench(compiler, tmp_path, custom), multisine(1000, SLOW, 12, 60.0, 1, bias=300.0)
    result = so.accept(controller, [keep_every(other.log(Machine(), reference), every)])
    (row,) = result.replays
    named = [(cause.kind, cause.what, cause.value) for cause in row.possible]
    assert not row.met or ("gain", "T_f", 0.5 * controller.gains["T_f"]) in named
    if row.met:
        assert "does not exclude that the gain T_f is" in str(result).replace("\n", " ")
        assert result.to_dict()["replay"]["logs"][0]["possible"]
    assert so.accept(controller, [keep_every(bench.log(Machine(), reference), every)]).replayed


def test_the_seconds_that_would_decide_do(controller, bench):
    short = keep_every(bench.log(Machine(), multisine(1000, SLOW, 4, 20.0, 1, bias=300.0)), 10)
    (row,) = so.accept(controller, [short]).replays
    assert row.undecided and row.causes[0].kind.startswith("short")
    periods = int(row.causes[0].value) + 2
    longer = keep_every(bench.log(Machine(), multisine(1000, SLOW, periods, 20.0, 1, bias=300.0)), 10)
    assert periods < 300 and so.accept(controller, [longer]).replayed


@pytest.mark.parametrize(("lines", "what"), [(np.arange(60, 90, 2), "k_i"), (np.arange(1, 7), "command")])
def test_the_lines_that_would_tell_this_law_from_another_do(controller, bench, halved, lines, what):
    """Of lines where the other law acts little no length would do; with those that are named all is told."""

    def play(bench, lines, scale):
        return keep_every(bench.log(Machine(), multisine(2000, lines, 8, scale, 1, bias=300.0)), 2)

    (row,) = so.accept(controller, [play(bench, 2 * lines, 60.0)]).replays
    cause = next(cause for cause in row.causes if cause.what == what)
    assert row.undecided and f"play a line at {cause.tells_hz:.2g} Hz" in say_cause(cause, "I")
    more = np.unique([*(2 * lines), *(round(2 * each.tells_hz) for each in row.causes if each.tells_hz)])
    scale = 60.0 * np.sqrt(more.size / lines.size)
    assert so.accept(controller, [play(bench, more, scale)]).replayed
    assert not any(so.accept(controller, [play(each, more, scale)]).replayed for each in halved.values())


@pytest.mark.parametrize(
    ("reference", "kind"),
    [
        (multisine(1000, np.arange(3, 96, 4), 8, 60.0, 3), "aliases"),
        (multisine(1000, SLOW, 8, 1500.0, 3), "saturated"),
        (300.0 + 60.0 * np.cumsum(np.random.default_rng(1).normal(size=4000)) / 60.0, "periods"),
    ],
)
def test_where_lines_of_a_right_law_cannot_be_compared_nothing_is_made_up(controller, bench, reference, kind):
    result = so.accept(controller, [keep_every(bench.log(Machine(), reference), 10)])
    (row,) = result.replays
    assert row.undecided and row.causes[0].kind == kind and repr(result), row
    assert "do not tell" in result.left_out["response"]


def test_a_log_of_every_second_tick_of_a_loop_that_ran_away_is_no_proof_of_anything(controller, bench):
    log = bench.log(replace(Machine(), reading_sign=-1.0), GENTLE)
    (row,) = so.accept(controller, [keep_every(log, 2)]).replays
    assert row.undecided and row.causes[0].kind == "saturated"


@pytest.mark.slow
def test_a_part_that_the_whole_log_alone_tells_is_named(observed, compiler, tmp_path):
    """An observer of 3 s with a hundredth of the command: where readings are rounded, a state at the first row of a
    window makes up for it there.
    """
    law, machine = observed
    gains = replace(law.read_gains(), observer=None)
    without = gains.law("pid_dob", law.sample_time_s).balanced()
    bare = replace(law, law=without, structure="custom", gains={}, spec=replace(law.spec, structure="custom"))
    bench = Bench(compiler, tmp_path, bare)
    options = {"share": 0.5, "bias": 0.0, "phases": 6, "periods": 4, "limits": {"tau_s": 20.0}}
    played = design_excitation(law, **options, seed=1).reference
    log = bench.log(replace(machine, coulomb=1.2 * machine.coulomb), played, noise=0.03, decimals=3).between(0.3, 1e3)
    (row,) = so.accept(law, [log]).replays
    assert not row.met and 2.0 < row.mismatch / row.allowed < 3.0
    assert (row.causes[0].kind, row.causes[0].what, row.causes[0].explains) == ("part", "disturbance observer", True)


def test_a_log_that_begins_amid_single_ticks_at_the_limit_is_of_its_law(controller, bench):
    """Glitches of the reference that take the command to its limit for a tick each: its anti-windup is in the state."""
    reference = np.where(np.arange(4000) % 100 == 7, 1.0, 0.0)
    largest = np.max(np.abs(bench.log(Machine(), reference, noise=0.0)["I"]))
    run = bench.log(Machine(), 9.3 / largest * reference, noise=0.0)
    limited = np.flatnonzero(np.abs(run["I"]) >= 9.0 * (1.0 - 1e-6))
    assert limited.size > 20 and np.all(np.diff(limited) > 1)
    (row,) = so.accept(controller, [run.between(0.105, 3.9)]).replays
    assert row.met and row.mismatch < 1e-9 and row.saturated > 0.0


def test_a_reference_of_coarse_steps_that_allows_any_law_explains_nothing(controller, bench):
    """As a column of another signal: its rounding allows more than the command."""
    log = bench.log(Machine(), REFERENCE)
    other = 4000.0 * np.round(np.cumsum(np.random.default_rng(1).normal(size=len(log))) / 10.0)
    columns = {name: log[name] for name in ("F1", "I")}
    wrong = so.Log.from_arrays(time=log.time, reference=other, **columns)
    slower = so.tune(*controller.design, replace(controller.spec, bandwidth_hz=20))
    (row,) = so.accept(controller, [wrong], others={"older.json": slower}).replays
    assert not row.met and not any(cause.explains for cause in row.causes), row.causes


def test_a_law_designed_on_a_response_has_its_log_as_an_experiment_of_the_plant_that_was_measured(controller, bench):
    law = replace(controller, design=None, measured_on=controller.design)
    result = so.accept(law, [bench.log(Machine(), 0.1 * REFERENCE)])
    ((plant, _),) = result.experiments
    assert plant is controller.design[0]
    assert result.differences is None and "compared with no model" in " ".join(repr(result).split())
