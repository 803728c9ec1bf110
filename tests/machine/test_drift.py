"""A sensor that drifts while the law holds its reading to the reference is noticed, by what else knows the force."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.files import to_json
from seaopt.machine.acceptance import Acceptance
from seaopt.machine.differences.drift import find_drifts
from seaopt.machine.page.page import write_acceptance_page
from seaopt.machine.ticks import take_ticks
from seaopt.machine.wording import say_drift
from tests.machine.conftest import FRICTION
from tests.machine.simulator import Bench, Machine, multisine
from tests.machine.test_response import LINES

PERIOD, LASTS = 1000, 11.0  # s, of the periods that are judged
REFERENCE = multisine(PERIOD, LINES, 12, 60.0, 3, bias=300.0)
RIGHT = Machine()


def find(controller, log):
    return find_drifts(controller, [take_ticks(controller, log)])


def with_encoder(log, force, stiffness=RIGHT.stiffness):
    """Return a log with the nut's place, in steps of a tenth of a micrometre, by the true force."""
    signals = {name: log[name] for name in ("reference", "I", "F1")}
    return so.Log.from_arrays(
        time=log.time, q=np.round(force / stiffness, 7), units={"q": "m"}, source="bench", **signals
    )


def test_a_reading_that_drifts_is_refused_with_its_size(controller, bench, tmp_path):
    """It was met: the reading follows its reference, and the lines of each period are those of a right machine."""
    log = bench.log(RIGHT, REFERENCE, noise=0.2, drift=1.0)
    result = so.accept(controller, [log])
    (drift,) = result.differences.drifts
    assert (drift.name, drift.beside, drift.unit, drift.lasts_s, drift.of_reading) == ("F1", "I", "N", LASTS, True)
    assert drift.low < 1.0 * LASTS < drift.high and drift.high - drift.low < 1.0, drift
    assert result.replayed and result.response.met and result.differences.each_line, result
    assert not result.met and not result.differences.inside and not result.differences.found
    said = " ".join(repr(result).split())
    words = r"F1 drifts by 1[01](\.\d)? N in 11 s beside I"
    assert re.search(words, said) and "its response is another one" not in said, said
    content = json.loads(to_json(result.to_dict()))
    assert Acceptance.from_dict(content, controller).differences.drifts == (drift,)
    assert re.search(words, " ".join(write_acceptance_page(result, tmp_path / "page.html").read_text().split()))


@pytest.mark.parametrize("drift", [2.0, -1.5])
def test_an_encoder_tells_the_drift_of_a_sensor(controller, bench, drift):
    log = bench.log(RIGHT, REFERENCE, drift=drift)
    found = find(controller, with_encoder(log, log["F1"] - drift * log.time))
    assert [each.beside for each in found] == ["q", "I"] and all(each.of_reading for each in found)
    assert all(each.low < drift * LASTS < each.high for each in found), found


TIME = np.arange(REFERENCE.size) / PERIOD  # s
ZEROS = {  # N, and the size as far as the means over the periods tell
    "jumps at a period's edge": (100.0 * (TIME >= 6.0), 100.0),
    "jumps within a period": (100.0 * (TIME > 6.4), 100.0),
    "jumps by little": (12.0 * (TIME >= 6.0), 12.0),
    "warms up": (30.0 * (1.0 - np.exp(-TIME / 2.0)), 30.0 * 2.0 * (1.0 - np.exp(-0.5)) * (np.exp(-0.5) - np.exp(-5.5))),
    "goes out and back": (60.0 * np.sin(np.pi * TIME / 12.0) ** 2, 58.0),
}


@pytest.mark.parametrize("kind", ZEROS)
def test_a_zero_that_moves_by_no_line_is_refused_with_its_size(controller, bench, kind):
    """It was met: of a line that does not fit, its own residuals hide any slope."""
    off, size = ZEROS[kind]
    log = bench.log(RIGHT, REFERENCE, noise=0.2, drift=off)
    (alone,), beside = find(controller, log), find(controller, with_encoder(log, log["F1"] - off))
    assert [each.beside for each in beside] == ["q", "I"], beside
    for each in (alone, *beside):
        assert each.of_reading and 2.0 <= each.lasts_s <= LASTS, each
        assert each.value == pytest.approx(size if each.value > 0.0 else -size, rel=0.04), each
    result = so.accept(controller, [log])
    assert not result.met and result.differences.drifts == (alone,), result


@pytest.mark.parametrize("rate", [1.0, 6.0])
def test_an_encoder_that_creeps_refuses_nothing(controller, bench, rate):
    """It was refused, though the law does not read it, and the command goes with the reading."""
    log = bench.log(RIGHT, REFERENCE[: 12 * PERIOD if rate == 1.0 else 4 * PERIOD], noise=0.2)
    (drift,) = find(controller, with_encoder(log, log["F1"] + rate * log.time))
    assert (drift.beside, drift.of_reading) == ("q", False), drift
    if rate != 1.0:
        return
    assert drift.low < -rate * LASTS < drift.high, drift
    result = so.accept(controller, [with_encoder(log, log["F1"] + rate * log.time)])
    assert result.differences.drifts == (drift,) and result.differences.inside and result.response.met, result
    assert "q drifts by 11 N in 11 s beside F1" in say_drift(drift, "I"), drift


@pytest.mark.parametrize("rubs", [False, True])
def test_an_encoder_that_creeps_beside_much_noise_refuses_no_right_machine(bench, dry, rubs):
    """39 of 40 were refused: whether the command stays where it was, to 2 % of a small reading, is lost in noise. How
    much of what the encoder has it does not have is told all the same; and no reading that drifts is let go for it.
    """
    rng = np.random.default_rng(5)
    if rubs:
        bench, reference = dry
    told = {"encoder": [], "reading": []}
    for seed in range(20):
        share, eta, damping, stiffness = rng.uniform(0.3, 1.0), *rng.uniform(0.8, 1.2, 3)
        if not rubs:
            reference = multisine(PERIOD, LINES, 8, 80.0, seed)
        machine = replace(
            RIGHT, per_ampere=eta * RIGHT.per_ampere, damping=damping * RIGHT.damping,
            stiffness=stiffness * RIGHT.stiffness, coulomb=FRICTION * rng.uniform(0.5, 1.5) * rubs, smoothing=5e-3,
        )  # fmt: skip
        played = share * reference
        creep = rng.uniform(5.0, 40.0) * np.arange(played.size) / played.size
        given = {"noise": rng.uniform(2.0, 4.0), "seed": seed}
        log, drifting = bench.log(machine, played, **given), bench.log(machine, played, drift=creep, **given)
        for name, each, force in (("encoder", log, log["F1"] + creep), ("reading", drifting, drifting["F1"] - creep)):
            found = find(bench.controller, with_encoder(each, force, machine.stiffness))
            told[name] += [drift.of_reading for drift in found if drift.beside == "q"]
    assert True not in told["encoder"] and told["encoder"].count(False) >= (12 if rubs else 19), told
    assert False not in told["reading"] and told["reading"].count(True) >= (6 if rubs else 17), told


def test_an_encoder_or_a_reading_that_the_log_does_not_tell_apart_is_undecided(controller, bench):
    """It was refused."""
    log = bench.log(RIGHT, multisine(PERIOD, LINES, 5, 20.0, 3), noise=8.0)
    logged = with_encoder(log, log["F1"] + 2.0 * log.time)
    result = so.accept(controller, [logged])
    (drift,) = result.differences.drifts
    assert (drift.beside, drift.of_reading) == ("q", None), drift
    assert result.differences.untold == "drift" and not result.met and not result.differences.inside, result
    said = " ".join(repr(result).split())
    assert "it is undecided whether the machine is" in said and "the zero of one of both sensors moves" in said, said
    content = json.loads(to_json(result.to_dict()))
    assert Acceptance.from_dict(content, controller).differences.drifts == (drift,)


@pytest.mark.parametrize("rate", [2.0, 3.0])
def test_a_reading_with_which_neither_encoder_nor_command_goes_is_not_cleared(controller, bench, rate):
    """Both drift, the encoder faster, so that it is off beside the reading in one direction and the command in the
    other.
    """
    log = bench.log(RIGHT, REFERENCE, noise=0.2, drift=1.0)
    result = so.accept(controller, [with_encoder(log, log["F1"] + (rate - 1.0) * log.time)])
    assert not result.met and not result.differences.inside
    assert True in {each.of_reading for each in result.differences.drifts}


def test_a_drive_that_drifts_leaves_a_reading_that_an_encoder_goes_with(controller, bench):
    """Without the encoder nothing tells which of both it is."""
    machine = replace(RIGHT, drive_drift=0.01)
    log = bench.log(machine, REFERENCE)
    (alone,), (beside,) = find(controller, log), find(controller, with_encoder(log, log["F1"]))
    truth = 0.01 * machine.per_ampere * LASTS
    assert (alone.beside, alone.of_reading) == ("I", True) and (beside.beside, beside.of_reading) == ("I", False)
    assert all(each.low < truth < each.high for each in (alone, beside)), (alone, truth)


def test_a_drift_is_told_beside_dry_friction(dry):
    """Whose mean over a period is another one in each set of phases, by more than the sensor drifts."""
    bench, reference = dry
    machine = replace(RIGHT, coulomb=FRICTION, smoothing=5e-3)
    for drift in (0.0, 0.5):
        log = bench.log(machine, reference, noise=0.5, drift=drift)
        found = find(bench.controller, log)
        assert len(found) == (drift > 0.0), found
        assert all(each.low < drift * each.lasts_s < each.high for each in found), found


@pytest.mark.parametrize("share", [1.0, 0.05])
def test_a_jump_is_told_beside_dry_friction_by_an_encoder_or_its_size(dry, share):
    """Beside the command alone one of less than four times the friction is as of a motor that it holds, so that it does
    not tell whether the encoder jumps.
    """
    bench, reference = dry
    machine = replace(RIGHT, coulomb=FRICTION, smoothing=5e-4)
    # at 13.4 s no period is judged: another set of phases begins, which has another offset beside the command
    for size, at, told in ((0.0, 11400, []), (40.0, 11400, ["q"]), (40.0, 13400, ["q"]), (250.0, 11400, ["q", "I"])):
        off = size * (np.arange(reference.size) >= at)
        log = bench.log(machine, share * reference, noise=0.5, drift=off)
        found = find(bench.controller, with_encoder(log, log["F1"] - off))
        assert [each.beside for each in found] == told and not any(each.of_reading is False for each in found), found
        assert any(each.of_reading for each in found) is ("I" in told), (size, found)


@pytest.mark.parametrize("eta", [0.8, 1.0, 1.2])
def test_no_drift_is_seen_where_friction_holds_a_knee(compiler, tmp_path, observed, eta):
    """Its command hunts by up to twice the friction, while the noise within most periods is small."""
    law, machine = observed
    bench, loose = Bench(compiler, tmp_path, law), Machine.of_knee(law.design[1])
    for seed, (share, bias, friction, smoothing) in enumerate(
        (share, bias, friction, smoothing)
        for share in (1.0, 0.2, 0.02)
        for bias in (0.0, 2.0, 10.0)
        for friction, smoothing in ((0.5, 1.0), (1.5, 0.02))
    ):
        reference = multisine(PERIOD, LINES, 12 if seed % 2 else 30, 10.0 * share, seed, bias=bias)
        knee = replace(
            machine, per_ampere=eta * loose.per_ampere, coulomb=friction * loose.coulomb,
            smoothing=smoothing * loose.smoothing,
        )  # fmt: skip
        assert not find(law, bench.log(knee, reference, noise=0.02, seed=seed)), (share, bias, friction, smoothing)


@pytest.mark.parametrize("rubs", [False, True])
def test_no_drift_is_seen_where_there_is_none(bench, dry, rubs):
    """Of machines of another efficiency, friction, spring and noise, 40 of each kind."""
    rng = np.random.default_rng(11)
    if rubs:
        bench, reference = dry
    for seed in range(40):
        if not rubs:
            reference = multisine(PERIOD, LINES, 8, rng.uniform(20.0, 80.0), seed, bias=rng.uniform(-300.0, 300.0))
        eta, damping, stiffness = rng.uniform(0.8, 1.2, 3)
        machine = replace(
            RIGHT, per_ampere=eta * RIGHT.per_ampere, damping=damping * RIGHT.damping,
            stiffness=stiffness * RIGHT.stiffness, coulomb=FRICTION * rng.uniform(0.5, 1.5) * rubs, smoothing=5e-3,
        )  # fmt: skip
        log = bench.log(machine, reference, noise=rng.uniform(0.1, 4.0), seed=seed)
        assert not find(bench.controller, with_encoder(log, log["F1"], machine.stiffness)), (seed, machine)


def test_an_interval_holds_the_drift(controller, bench):
    """Of 60 logs, at 1 - 1e-4 each. What the ends of a period add to its mean goes to and fro, so that it is wider."""
    off = []
    for seed in range(60):
        (drift,) = find(controller, bench.log(RIGHT, REFERENCE, drift=3.0, seed=seed))
        assert drift.low < 3.0 * LASTS < drift.high, drift
        off.append((drift.value - 3.0 * LASTS) / (drift.high - drift.low))
    # of Student's t of 9 degrees of freedom the std is 1.13, and 1 - 1e-4 within 6.59 to each side
    assert 0.3 < np.std(off) / (1.13 / (2.0 * 6.594)) < 1.2, np.std(off)
