"""How far the stages are while they run: real ones, on small problems."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from seaopt.cli.progress import LEAST_SHARE, TimeLeft
from seaopt.control import sweep
from seaopt.estimation.fit import SCALED
from seaopt.logs import assess_quality
from seaopt.problem.proposal import propose
from seaopt.progress import divide
from seaopt.robustness import Budget, tune_certified
from seaopt.robustness.verification.large_signal import large_signal

STAND, SWING, THOR = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)
RANGES = {"I_p": (0.3, 0.5)}


class Heard:
    """A hook that keeps what it is told."""

    def __init__(self):
        self.notes, self.shares = [], []

    def __call__(self, note, share=None, /):
        if share is not None:
            self.notes.append(note)
            self.shares.append(share)

    def check(self, *words):
        assert self.shares[0] >= 0.0 and self.shares[-1] == 1.0
        assert np.all(np.diff(self.shares) >= 0.0)
        for word in words:
            assert any(word in note for note in self.notes), (word, self.notes)


@pytest.fixture
def heard():
    return Heard()


@pytest.fixture(scope="module")
def controller():
    return so.tune(STAND, THOR, SPEC, {"swing": SWING})


def make_experiment(truth):
    time = np.arange(1200) / 400.0
    rng = np.random.default_rng(1)
    current = np.convolve(rng.normal(0.0, 2.0, time.size), np.ones(4) / 4.0, "same")
    run = so.simulate(STAND, truth, so.Log.from_arrays(time=time, I=current))
    force = run["F1"] + rng.normal(0.0, 0.5, time.size)
    return so.Experiment(plant=STAND, log=so.Log.from_arrays(time=time, I=current, F1=force))


def test_parts_of_a_call_follow_each_other(heard):
    for part in divide(heard, 1.0, 0.0, 3.0, 0.1, 0.7):
        for share in (0.0, 0.3, 1.0):
            part("running", share)
    heard.check()
    assert heard.shares[5] == heard.shares[2] == pytest.approx(1.0 / 4.8)


def test_a_fit_that_is_met_tells_its_iterations(heard):
    so.fit([make_experiment(THOR)], THOR.update(J=2e-6).free("J"), progress=heard)
    heard.check("looking for a start", "iteration 1, cost", "round 1 of 12", "testing the residuals", "converged")


def test_a_fit_that_is_not_met_tells_the_causes_that_it_tries(heard):
    wrong = THOR.update(k=2.0 * THOR["k"].value)
    assert not so.fit([make_experiment(THOR)], wrong.free("J"), progress=heard).met
    heard.check("trying cause 1 of", "trying cause 2 of")


def test_no_time_left_is_told_of_a_fit_until_its_causes_are_a_scale():
    now, told = 0.0, {}
    left = TimeLeft(lambda: now, told_from=SCALED + LEAST_SHARE)

    def hear(note, share=None, /):
        nonlocal now
        now += 3.0 if "cause" in note else 0.1
        if share is not None:
            left.move(share)
            told[note] = left.tell()

    so.fit([make_experiment(THOR)], THOR.update(k=2.0 * THOR["k"].value).free("J"), progress=hear)
    words = [text.split() for text in told.values() if text]
    numbers = [60.0 * float(number) if unit == "min" else float(number) for _, _, number, unit, _ in words]
    assert [note for note in told if "cause" in note][3:], told
    assert not any(text for note, text in told.items() if "iteration" in note), told
    assert numbers and numbers == sorted(numbers, reverse=True), told


def test_a_tune_tells_its_starts(heard):
    so.tune(STAND, THOR, SPEC, progress=heard)
    heard.check("start 2 of 3", "refining start 1 of")


def test_a_tune_that_is_not_possible_tells_the_bandwidths_that_it_tries(heard):
    spec = so.ControllerSpec(structure="pd", bandwidth_hz=30, max_noise_gain=3, bandwidth_range_hz=(29, 31))
    assert not so.tune(STAND, THOR, spec, progress=heard).feasible
    heard.check("Hz instead", "refining start")


def test_a_sweep_of_large_signals_tells_its_frequencies(heard):
    law = so.tune(STAND, THOR, SPEC)
    large_signal(law, STAND, THOR, amplitudes_N=(20.0,), frequencies_hz=(5.0, 20.0, 40.0), progress=heard)
    assert [note for note in heard.notes if "Hz" in note] == heard.notes and len(heard.notes) == 3
    assert heard.shares[0] == 0.0 < heard.shares[1] < heard.shares[2] < 1.0  # the slowest takes longest


NO_MARGIN = so.ControllerSpec(measured="tau_s", bandwidth_hz=15, min_friction_margin=10.0)


def rub():
    plant = so.plants.rotary(link="locked")
    return plant, plant.defaults.update(f_c=0.005, v_s=1.0)


@pytest.mark.slow
def test_a_friction_margin_that_cannot_be_had_is_told_as_it_is_raised(heard):
    assert not so.tune(*rub(), NO_MARGIN, progress=heard).feasible
    heard.check("friction margin")


@pytest.mark.slow
def test_what_a_friction_margin_takes_is_told_before_it_is_over():
    def stop(note, share=None, /):
        if "friction margin" in note:
            raise InterruptedError(note)

    with pytest.raises(InterruptedError, match="friction margin"):
        so.tune(*rub(), NO_MARGIN, progress=stop)


def test_a_sweep_tells_its_bandwidths(heard):
    sweep(STAND, THOR, SPEC, [20, 30, 40], progress=heard)
    heard.check("20 Hz, start 1 of", "30 Hz, ", "40 Hz, ", "3 bandwidths")
    first = next(number for number, note in enumerate(heard.notes) if note.startswith("30 Hz"))
    assert heard.shares[first] == pytest.approx(1 / 3)


def test_a_certificate_tells_draws_searches_and_scenarios(heard, controller):
    so.certify(
        controller, {"swing": SWING}, THOR, ranges=RANGES, samples=40, bounds=Budget(boxes=1), progress=heard
    )  # fmt: skip
    heard.check(
        "swing, 40 of 40 draws", "worst case, plant 2 of 2", "friction at the draws",
        "design, scenario 1 of 8", "swing, scenario 8 of 8", "large signals", "passivity", "environments",
    )  # fmt: skip
    assert sum("scenario" in note for note in heard.notes) > 16


@pytest.mark.slow
def test_rounds_of_tuning_are_told(heard):
    tune_certified(STAND, THOR, SPEC, {"swing": SWING}, ranges=RANGES, samples=40, rounds=3, progress=heard)
    heard.check("round 1, start 1 of", "round 1, swing, 40 of 40 draws", "certified after")


def test_a_log_is_looked_at_channel_by_channel_and_proposed_log_by_log(heard, tmp_path):
    rng = np.random.default_rng(0)
    signals = {"I": rng.normal(size=400), "F1": rng.normal(size=400)}
    assess_quality(so.Log.from_arrays(time=np.arange(400) / 400, **signals), progress=heard)
    heard.check("channel 1 of 2", "spectra and pairs of channels")
    heard = Heard()
    rows = ["t [s],I [A],tau_s [N m]", *(f"{k / 400},{signals['I'][k]},{signals['F1'][k]}" for k in range(400))]
    (tmp_path / "knee.csv").write_text("\n".join(rows), encoding="utf-8")
    propose([tmp_path / "knee.csv"], {}, tmp_path, progress=heard)
    heard.check("reading log 1 of 1", "looking at log 1 of 1")
