"""What a fit does with saturated, missing and unevenly sampled data, and that it says so."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from seaopt.bench import PAPER_STAND
from seaopt.errors import EstimationError, LogError
from seaopt.estimation.problem.fit_problem import pose_problem
from seaopt.estimation.problem.losses import Squares
from tests.words import flatten

FREE = ("J", "b_r", "eta")


@pytest.fixture(scope="module")
def start(thor):
    return thor.update(J=2e-6, b_r=2e-4, eta=0.9).free(*FREE)


@pytest.fixture(scope="module")
def limit(short_log):
    return float(0.6 * np.max(np.abs(short_log["F1"] - 3.0)))


@pytest.fixture(scope="module")
def clipped(stand, thor, limit):
    sensors = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0}, saturation={"F1": limit})
    return so.virtual_log(stand, thor, PAPER_STAND, duration_s=20, rate_hz=400, seed=12, sensors=sensors)


def off(fit, truth):
    """Return how many standard deviations each free parameter is off."""
    return {name: abs(fit.parameters[name].value - truth[name].value) / fit.parameters[name].std for name in FREE}


def fitted(stand, log, start, method=None, **options):
    return so.fit(
        [so.Experiment(plant=stand, log=log, outputs=("F1",), **options)], start, method=method, diagnostics=False
    )


def test_clipping_ruins_a_fit_that_does_not_mask_it(stand, thor, clipped, start):
    found = off(fitted(stand, clipped, start, mask="none"), thor)
    assert max(found.values()) > 8.0


@pytest.mark.parametrize("method", [so.OutputError(), so.MultipleShooting(), so.PredictionError()])
@pytest.mark.parametrize("how", ["auto", "declared"])
def test_masking_takes_the_bias_away_and_says_so(stand, thor, clipped, limit, start, how, method):
    options = {"saturation": {"F1": (-limit, limit)}} if how == "declared" else {}
    fit = fitted(stand, clipped, start, method, mask=how, **options)
    assert max(off(fit, thor).values()) < 3.0
    count = np.count_nonzero(np.abs(clipped["F1"]) >= limit)
    assert f"experiment: F1: {count} samples" in fit.notes[0]
    assert fit.notes[0] in flatten(repr(fit))
    assert so.Fit.from_dict(fit.to_dict()).notes == fit.notes
    assert fit.samples == len(clipped) - count


def test_masking_can_be_confined_to_what_is_declared(stand, clipped):
    kept = so.Experiment(plant=stand, log=clipped, outputs=("F1",), mask="declared")
    assert kept.log is clipped and kept.notes == ()


def test_a_saturated_input_is_what_the_plant_got(stand, thor, start):
    log = so.virtual_log(stand, thor, PAPER_STAND, duration_s=20, rate_hz=400, seed=12)
    driven = so.Log.from_arrays(time=log.time, I=np.clip(log["I"], -2.0, 2.0), units={"I": "A"})
    run = so.simulate(stand, thor, driven)
    noisy = run["F1"] + 2.0 * np.random.default_rng(0).normal(size=len(log))
    both = so.Log.from_arrays(time=log.time, I=driven["I"], F1=noisy, units={"I": "A", "F1": "N"})
    fit = fitted(stand, both, start)
    assert fit.notes == ()
    assert max(off(fit, thor).values()) < 3.0


def test_a_clean_log_is_left_alone(stand, short_log):
    assert so.Experiment(plant=stand, log=short_log).log is short_log


def test_gaps_and_missing_samples_are_noted(stand, short_log, start):
    keep = np.ones(len(short_log), dtype=bool)
    keep[3000:3010] = keep[3011:3050] = False
    arrays = {name: values[keep] for name, values in short_log.to_arrays().items()}
    arrays["F1"][:5] = np.nan
    log = so.Log.from_arrays(**arrays)
    notes = fitted(stand, log, start).notes
    assert "experiment: 2 gaps split the log into 2 segments, 1 sample alone between gaps left out" in notes
    assert f"experiment: F1: 5 of {len(log)} samples are missing or masked and have no weight" in notes


def test_jitter_is_resampled_only_when_asked(stand, thor, short_log, start):
    rng = np.random.default_rng(0)
    shaken = np.sort(short_log.time + rng.uniform(-3e-4, 3e-4, len(short_log)))
    channels = {name: np.interp(shaken, short_log.time, short_log[name]) for name in ("I", "F1")}
    log = so.Log.from_arrays(time=shaken, units={"I": "A", "F1": "N"}, **channels)
    with pytest.raises(LogError, match=r"call log.resample\(rate_hz=400\)"):
        fitted(stand, log, start)
    fit = fitted(stand, log.resample(rate_hz=400), start)
    assert "resampled from 400 Hz to 400 Hz" in fit.notes[0]


def test_the_problem_file_declares_it(tmp_path, stand, clipped, limit):
    late = so.Log.from_arrays(**{**clipped.to_arrays(), "time": np.round(clipped.time, 3)})
    so.write_log(late, tmp_path / "log.csv")
    (tmp_path / "problem.toml").write_text(
        'schema = 1\n[parameters]\nJ = { value = 2e-6, free = true }\n[plant.stand]\nkind = "high_impedance"\n'
        '[[experiment]]\nname = "chirp"\nplant = "stand"\nlog = "log.csv"\ntime = "time [s]"\n'
        'inputs = { I = { column = "I", unit = "A" } }\noutputs = { F1 = { column = "F1", unit = "N" } }\n'
        'slice_s = [0.0, 15.0]\nresample = "restamp"\n'
        f'saturation = {{ F1 = [{-limit}, {limit}] }}\nmask = "declared"\n',
        encoding="utf-8",
    )
    (experiment,) = so.read_problem(tmp_path / "problem.toml").experiments()
    said = " ".join(experiment.notes)
    for words in ("cut to 0 to 15 s", "rounded to 0.001 s", "declared range"):
        assert words in said


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"mask": "clipped"}, "is not known"),
        ({"saturation": {"F1": (5.0, -5.0)}}, "is not a range"),
        ({"saturation": {"F3": (-5.0, 5.0)}}, "not a measured output"),
        ({"saturation": {"F1": (1e4, 2e4)}}, "every sample of F1 is saturated"),
    ],
)
def test_what_makes_no_sense_is_refused(stand, short_log, options, words):
    with pytest.raises(EstimationError, match=words):
        so.Experiment(plant=stand, log=short_log, outputs=("F1",), **options)


@pytest.mark.parametrize(("channel", "size"), [("F1", 1e31), ("I", 3.4e38), ("F1", -1e200)])
def test_a_sample_that_no_sensor_gives_is_refused_where_no_range_masks_it(stand, channel, size):
    t = np.arange(200) / 400
    samples = {"I": np.sin(40 * t), "F1": 50 * np.sin(40 * t)}
    samples[channel][70] = size
    log = so.Log.from_arrays(time=t, **samples, units={"I": "A", "F1": "N"})
    with pytest.raises(so.errors.EstimationError, match=f"1 sample of channel {channel} beyond .* at 0.175 s"):
        so.Experiment(plant=stand, log=log)
    if channel == "F1":
        masked = so.Experiment(plant=stand, log=log, saturation={"F1": (-1e4, 1e4)})
        assert np.flatnonzero(np.isnan(masked.log["F1"])).tolist() == [70]


def test_a_delay_in_ms_is_compared_with_the_log_in_seconds(stand, thor, short_log):
    delay = so.Parameter(name="delay_s", value=500.0 * short_log.duration_s, unit="ms", free=True)
    bench = so.Experiment(plant=stand, log=short_log, outputs=("F1",), delay_s=delay)
    problem = pose_problem((bench,), thor.free("J"), loss=Squares())
    assert problem.experiments[0].slots.delay.value == pytest.approx(0.5 * short_log.duration_s)
