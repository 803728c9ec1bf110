"""What rounding hides tick by tick, told over a whole log, on a machine that shares nothing with seaopt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.machine.gains.free_gains import make_law
from seaopt.machine.hidden import Segments, find_hidden, respond
from seaopt.machine.stepped import make_setting, play
from seaopt.machine.ticks import take_ticks
from tests.machine.simulator import Bench, multisine

LINES = np.unique(np.round(np.geomspace(1, 60, 25)).astype(int))
REFERENCE = multisine(1000, LINES, 20, 1.0, 3) + 4.0 * np.sin(2e-4 * np.pi * np.arange(20000))


@pytest.fixture(scope="module")
def benches(compiler, tmp_path_factory, observed):
    """Return those of the law, of it without its observer, and of it with a k_p that is 0.3 % smaller."""
    law, folder = observed[0], tmp_path_factory.mktemp("knee")
    gains, spec = law.read_gains(), replace(law.spec, structure="custom")

    def make(name, **changes):
        made = replace(gains, **changes).law("pid_dob", 1e-3).balanced()
        return Bench(compiler, folder, replace(law, law=made, structure="custom", gains={}, spec=spec), name)

    return {"law": make("law"), "bare": make("bare", observer=None), "weak": make("weak", k_p=0.997 * gains.k_p)}


def record(bench, machine, seed, decimals=3, noise=0.02):
    return bench.log(machine, REFERENCE, noise=noise, seed=seed, decimals=decimals).between(0.3, 19.9)


def test_responses_are_those_of_the_law(observed):
    law = observed[0]
    f = np.geomspace(1e-3, 0.45, 50)
    setting = make_setting(law, take_ticks(law, so.Log.from_arrays(**_ramp(law))))
    forward, *feedback = respond(setting.linear, f)
    expected = law.law.responses(f / law.sample_time_s) * law.per_effort
    np.testing.assert_allclose(forward, expected[0], rtol=1e-6)
    np.testing.assert_allclose(np.abs(feedback[0]), np.abs(expected[1]), rtol=1e-6)


def _ramp(law):
    rows = np.arange(200.0)
    return {"time": 1e-3 * rows, "reference": rows, "tau_s": rows, "I": 1e-3 * rows}


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_a_missing_observer_is_told_below_the_rounding_of_every_tick(observed, benches, seed):
    law, machine = observed
    log = record(benches["bare"], machine, seed)
    result = so.accept(law, [log])
    cause = result.replays[0].causes[0]
    assert (cause.kind, cause.what) == ("part", "disturbance observer") and cause.explains, result
    assert play(make_setting(law, take_ticks(law, log))).met and cause.sigmas > 12.0
    assert not result.replays[0].met
    assert "stands out of the rounding of the whole log by" in " ".join(str(result).split())


def test_shares_are_as_the_rounding_of_a_right_law_scatters_them(observed, benches):
    """That of the observer, in logs whose rounding is drawn anew: zero, with the std that is stated."""
    law, machine = observed
    bare = make_law(law, replace(law.read_gains(), observer=None))
    scores = []
    for seed in range(12):
        ticks = take_ticks(law, record(benches["law"], machine, seed))
        setting = make_setting(law, ticks)
        match, changed = play(setting), bare(setting)
        assert match.met and find_hidden(setting, match, {}) == ()
        share, std = Segments.make(setting, match).find_share(changed.linear, play(changed).commands - match.commands)
        scores.append(share / std)
    assert np.max(np.abs(scores)) < 4.0 and 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.6, scores


def test_the_rounding_of_a_reference_that_repeats_is_the_same_each_time(observed, benches):
    """Twenty times the same errors are no twenty times as many: such shares were said to stand out by 6 to 10 std."""
    law, machine = observed
    bare = make_law(law, replace(law.read_gains(), observer=None))
    scores = []
    for seed in range(8):
        periodic = multisine(1000, LINES, 20, 1.0, seed)
        log = benches["law"].log(machine, periodic, noise=0.02, seed=seed, decimals=4)
        columns = {"reference": np.round(log["reference"], 2), "I": log["I"], "tau_s": log["tau_s"]}
        setting = make_setting(law, take_ticks(law, so.Log.from_arrays(time=log.time, **columns)))
        match, changed = play(setting), bare(setting)
        share, std = Segments.make(setting, match).find_share(changed.linear, play(changed).commands - match.commands)
        scores.append(share / std)
    assert np.max(np.abs(scores)) < 4.0, scores


def test_a_gain_that_is_a_little_off_has_its_size(observed, benches):
    law, machine = observed
    (row,) = so.accept(law, [record(benches["weak"], machine, 1, decimals=2)]).replays
    cause = row.causes[0]
    assert not row.met and (cause.kind, cause.what) == ("gain", "k_p")
    assert cause.value == pytest.approx(0.997 * law.gains["k_p"], rel=1e-3)


def test_counts_that_hide_the_noise_tell_nothing(observed, benches):
    """Rounding that goes with the signal is no noise, and looks like other laws."""
    law, machine = observed
    ticks = take_ticks(law, record(benches["law"], machine, 1, decimals=0, noise=0.01))
    setting = make_setting(law, ticks)
    assert find_hidden(setting, play(setting), {}) == ()


@pytest.mark.parametrize("decimals", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_the_mean_of_a_references_rounding_that_repeats_is_not_another_law(observed, benches, decimals):
    """Over sixty periods it runs up in two integrals to many times what rounding makes at random."""
    law, machine = observed
    periodic = multisine(1000, LINES, 60, 1.0, 1)
    met = {}
    for name in ("law", "weak"):
        log = benches[name].log(machine, periodic, noise=0.02, seed=1, decimals=4)
        columns = {"reference": np.round(log["reference"], decimals), "I": log["I"], "tau_s": log["tau_s"]}
        (row,) = so.accept(law, [so.Log.from_arrays(time=log.time, **columns)]).replays
        met[name] = row.met
        causes = [(cause.kind, cause.what) for cause in row.causes[:1]]
        assert not causes if name == "law" else causes == [("gain", "k_p")], (name, row)
    assert met == {"law": True, "weak": False}
