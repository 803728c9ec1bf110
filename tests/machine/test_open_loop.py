"""A log in which something was played as the command, without the law, is told from one under any law."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import chirp, cont2discrete, lfilter

import seaopt as so
from seaopt.control import PlausibilityGate
from tests.machine.simulator import Bench, Machine, multisine
from tests.machine.test_replay import LINES, REFERENCE

N = 6000
TIME = 1e-3 * np.arange(N)
PLAYED = {
    "multisine": multisine(1000, LINES, 6, 1.5, 3, bias=0.5),
    "chirp": 1.2 * chirp(TIME, 0.5, TIME[-1], 100.0),
    "steps": 0.5 * ((TIME // 0.5) % 4),
    "noise": np.random.default_rng(5).normal(size=N),
}
REFERENCES = {"rest": 0.0 * TIME, "what was played": None, "another": multisine(1000, LINES, 6, 250.0, 9, bias=300.0)}


def play(current, reference, noise=2.0, decimals=2, seed=1):
    """Return the log of a current on the machine's own equation: M y'' + b y' + k y = k (force per ampere) I."""
    m = Machine()
    b, a, _ = cont2discrete(([m.per_ampere * m.stiffness], [m.mass, m.damping, m.stiffness]), 1e-3)
    force = lfilter(np.ravel(b), a, current) + noise * np.random.default_rng(seed).normal(size=current.size)
    columns = {"reference": 240.0 * current if reference is None else reference, "I": np.round(current, 4)}
    return so.Log.from_arrays(time=1e-3 * np.arange(current.size), F1=np.round(force, decimals), **columns)


PAIRS = [(played, reference) for played in PLAYED for reference in REFERENCES]
TELLING = {("multisine", "rest"), ("chirp", "another"), ("steps", "what was played"), ("noise", "rest")}


@pytest.mark.parametrize(
    ("played", "reference"), [pytest.param(*pair, marks=[pytest.mark.slow] * (pair not in TELLING)) for pair in PAIRS]
)
def test_a_command_that_was_played_without_the_law_is_an_open_loop(controller, played, reference):
    log = play(PLAYED[played], REFERENCES[reference])
    result = so.accept(controller, [log])
    (row,) = result.replays
    first, words = row.causes[0], str(result)
    assert not row.met and first.explains and (first.kind, first.what) == ("open loop", "F1"), row
    assert "does not follow F1: the loop was open" in " ".join(words.split()) and "record" in words


def is_open(controller, log):
    (row,) = so.accept(controller, [log]).replays
    return any(cause.kind == "open loop" and cause.explains for cause in row.causes)


@pytest.mark.parametrize(("law_gain", "noise"), [(1.0, 2.0), (0.5, 0.3), (0.1, 2.0), (0.02, 0.3)])
@pytest.mark.parametrize("reference", [REFERENCE, 300.0 + 100.0 * chirp(TIME, 0.5, TIME[-1], 100.0)])
def test_a_law_of_whatever_gain_is_not(controller, bench, reference, law_gain, noise):
    log = bench.log(Machine(law_gain=law_gain), reference, noise=noise, decimals=2)
    assert not is_open(controller, log)


@pytest.mark.parametrize("changes", [{"late": 3.0}, {"every": 2.0}, {"delay_s": 2e-3}, {"sensor_range": 330.0}])
def test_nor_is_a_law_that_is_late_or_reads_badly(controller, bench, changes):
    log = bench.log(replace(Machine(), law_gain=0.3, **changes), REFERENCE)
    assert not is_open(controller, log)


def test_nor_is_a_log_at_the_limit(controller, bench):
    reference = 4000.0 * np.sign(np.sin(0.02 * np.arange(N)))
    for law_gain in (1.0, 0.3):
        assert not is_open(controller, bench.log(Machine(law_gain=law_gain), reference))


def test_readings_without_noise_tell_nothing(controller):
    """Rounding is noise that no law saw."""
    for decimals in (0, 9):
        assert not is_open(controller, play(PLAYED["multisine"], 0.0 * TIME, noise=0.0, decimals=decimals))


@pytest.mark.parametrize("fades", [0, 80])
def test_a_command_that_was_stopped_is_no_open_loop(controller, bench, fades):
    log = bench.log(Machine(), REFERENCE)
    command, stop = log["I"].copy(), 2500
    command[stop:] *= np.clip(1.0 - np.arange(len(log) - stop) / max(fades, 1e-9), 0.0, None)
    columns = {name: log[name] for name in ("reference", "F1")}
    result = so.accept(controller, [so.Log.from_arrays(time=log.time, I=command, **columns)])
    first = result.replays[0].causes[0]
    assert (first.kind, first.what) == ("stopped", "command") and not result.met
    assert first.value == pytest.approx((stop + fades) * 1e-3, abs=2e-3)
    assert "it is this law until the command was stopped" in " ".join(str(result).split())


def test_a_gate_of_the_firmware_that_tripped_is_a_stop(compiler, tmp_path, controller):
    gate = PlausibilityGate(range_N=(-1500.0, 1500.0), max_step_N=1000.0, max_held=3, ramp_per_s=50.0)
    bench = Bench(compiler, tmp_path, replace(controller, gate=gate))
    reference = 0.3 * REFERENCE
    reference[3000:] += 3000.0  # the force goes beyond the range
    log = bench.log(Machine(), reference)
    first = so.accept(controller, [log]).replays[0].causes[0]
    assert (first.kind, first.what) == ("stopped", "command") and 3.0 < first.value < 3.5


@pytest.mark.parametrize("lost", [1000, 3000])
def test_a_gate_that_tripped_of_readings_that_are_no_numbers_is_a_stop(compiler, tmp_path, controller, lost):
    gate = PlausibilityGate(range_N=(-1500.0, 1500.0), max_step_N=1000.0, max_held=3, ramp_per_s=50.0)
    bench = Bench(compiler, tmp_path, replace(controller, gate=gate))
    off = np.zeros(REFERENCE.size)
    off[lost : lost + 400] = np.nan  # a wire that is loose: after it no row has the law, before it none the stop
    result = so.accept(replace(controller, gate=gate), [bench.log(Machine(), REFERENCE, drift=off)])
    first = result.replays[0].causes[0]
    assert (first.kind, first.what) == ("stopped", "command") and not result.met
    assert lost <= 1000.0 * first.value <= lost + 400


def test_a_reference_that_is_zero_throughout_may_not_be_the_one_that_was_given(controller, bench):
    """It said that the force is 0.1 times what it should be, and not what to log."""
    log, still = bench.log(Machine(), REFERENCE), np.zeros(REFERENCE.size)
    result = so.accept(
        controller, [log.with_values(log.time, {name: log[name] for name in log.signals} | {"reference": still}, "")]
    )
    assert result.replays[0].causes[0].kind == "still" and not result.met
    assert "log the one that the law was given" in " ".join(str(result).split())
    rests = bench.log(Machine(), still)
    assert so.accept(controller, [rests]).replays[0].met
    turned = rests.with_values(rests.time, {name: rests[name] for name in rests.signals} | {"F1": -rests["F1"]}, "")
    assert so.accept(controller, [turned]).replays[0].causes[0].kind == "sign"
