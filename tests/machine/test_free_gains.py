"""A law with another set of gains, under the exported C of it on a machine that shares nothing with seaopt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import Gains
from seaopt.control.laws.structures import Prefilter
from seaopt.machine.wording import say_cause
from tests.machine.conftest import SPEC
from tests.machine.simulator import Bench, Machine, multisine
from tests.machine.test_replay import cause_of, rename

CHANGES = {"k_p": 0.8, "k_i": 1.6, "k_d": 0.9, "T_f": 0.6, "k_r": 0.85, "c": 0.5}
LINES = np.unique(np.round(np.geomspace(1, 120, 40)).astype(int))
LARGE = multisine(1000, LINES, 4, 250.0, 3, bias=300.0)  # which takes the command to its limit now and then
GENTLE = multisine(1000, LINES, 4, 100.0, 3, bias=300.0)


def make_bench(compiler, folder, controller, gains, **spec):
    """Return the bench of a controller's law with other gains, which it is not told."""
    law = gains.law("pid", 1e-3).balanced()
    spec = replace(SPEC, structure="custom", **spec)
    return Bench(compiler, folder, replace(controller, law=law, structure="custom", gains={}, spec=spec))


@pytest.mark.parametrize(
    ("reference", "decimals", "tolerance"), [(GENTLE, None, 1e-6), (GENTLE, 2, 5e-3), (LARGE, None, 1e-5)]
)
def test_another_set_of_gains_is_found_with_its_numbers(compiler, tmp_path, controller, reference, decimals, tolerance):
    numbers = {name: CHANGES[name] * controller.gains[name] for name in CHANGES}
    log = make_bench(compiler, tmp_path, controller, Gains.from_names(numbers)).log(
        Machine(), reference, noise=5.0, decimals=decimals
    )
    cause = cause_of(controller, log)
    assert (cause.kind, cause.what) == ("gains", "law") and cause.exported == controller.gains
    assert cause.gains == pytest.approx(numbers, rel=tolerance)
    says = " ".join(str(so.accept(controller, [log])).split())
    assert "a law with another set of gains: c " in says and "exported)" in says


def test_a_law_without_its_prefilter_and_with_other_gains_is_found(compiler, tmp_path, controller):
    stated = replace(Gains.from_names(controller.gains), prefilter=Prefilter(corner_hz=40.0))
    exported = replace(controller, gains=stated.by_name(), law=stated.law("pid", 1e-3).balanced())
    numbers = stated.by_name() | {"k_p": 1.2 * stated.k_p, "prefilter_corner_hz": 25.0}
    log = make_bench(compiler, tmp_path, controller, Gains.from_names(numbers)).log(Machine(), GENTLE)
    cause = cause_of(exported, log)
    assert cause.kind == "gains" and cause.gains == pytest.approx(numbers, rel=1e-5)


def test_an_older_law_with_another_limit_is_named_by_its_gains(compiler, tmp_path, controller):
    older = so.tune(so.plants.high_impedance(), so.plants.thor(), replace(SPEC, bandwidth_hz=22.0))
    lower = replace(older, spec=replace(older.spec, current_limit_A=4.0))
    log = Bench(compiler, tmp_path, lower).log(Machine(), GENTLE)
    assert np.mean(np.abs(log["I"]) >= 4.0) > 0.02
    result = so.accept(controller, [log], others={"old/controller.json": older})
    first, second = result.replays[0].causes[:2]
    assert (first.kind, first.value) == ("limit", 4.0) and second.besides and second.explains
    assert (second.kind, second.what) == ("gains", "old/controller.json")
    says = " ".join(str(result).split())
    assert "limited to 4 A, and it is a law with another set of gains, those of old/controller.json" in says
    assert "with the first one also: it is a law" in says


def test_a_limit_that_the_law_is_not_told_of_is_one_cause(controller, bench):
    """A drive that limits the command behind the law, which logs what is left."""
    log = bench.log(Machine(), GENTLE)
    clipped = so.Log.from_arrays(
        time=log.time, reference=log["reference"], F1=log["F1"], I=np.clip(log["I"], -4.0, 4.0), source="bench"
    )
    cause = cause_of(controller, clipped)
    assert (cause.kind, cause.what, cause.value) == ("limit", "behind the law", 4.0)
    assert "limited to 4 A behind the law, which is not told of it" in " ".join(say_cause(cause, "I").split())


@pytest.mark.parametrize("factor", [0.5, -1.0])
def test_a_fault_of_one_number_is_not_called_another_set(controller, bench, factor):
    log = bench.log(replace(Machine(), law_gain=factor) if factor > 0 else replace(Machine(), reading_sign=-1.0), LARGE)
    (row,) = so.accept(controller, [log]).replays
    assert "gains" not in {cause.kind for cause in row.causes}


@pytest.mark.parametrize("late", [1, -1])
def test_a_fault_of_a_log_whose_command_is_a_row_late_is_named(compiler, tmp_path, controller, bench, late):
    def shift(log):
        return rename(log, I=np.roll(log["I"], late)).between(0.1, 3.8)

    half = so.accept(controller, [shift(bench.log(replace(Machine(), law_gain=0.5), GENTLE))])
    first, second = half.replays[0].causes[:2]
    assert (first.kind, first.what, first.value) == ("late", "command", late)
    assert (second.kind, second.what, second.besides, second.explains) == ("factor", "I", True, True)
    assert second.value == pytest.approx(0.5) and "late, and I is 0.5 times" in " ".join(str(half).split())
    numbers = {name: CHANGES[name] * controller.gains[name] for name in CHANGES}
    log = make_bench(compiler, tmp_path, controller, Gains.from_names(numbers)).log(Machine(), GENTLE)
    first, second = so.accept(controller, [shift(log)]).replays[0].causes[:2]
    assert (first.kind, second.kind, second.besides) == ("late", "gains", True)
    assert second.gains == pytest.approx(numbers, rel=1e-6)


def test_of_a_command_that_is_all_at_its_limit_the_sign_is_named_ahead_of_units(controller, bench):
    log = bench.log(replace(Machine(), reading_sign=-1.0), GENTLE).between(0.1, 3.8)
    assert np.mean(np.abs(log["I"]) >= 9.0 - 1e-6) > 0.99
    first = so.accept(controller, [log]).replays[0].causes[0]
    assert (first.kind, first.value) == ("sign", -1.0)
