"""Each detector against faults that are put in on purpose, and silence where there is none."""

from __future__ import annotations

import json

import numpy as np
import pytest
import scipy.io
import scipy.signal
from hypothesis import given
from hypothesis import strategies as st

import seaopt as so
from seaopt.bench import PAPER_STAND, PAPER_SWING, Multisine, Noise
from seaopt.errors import LogError
from seaopt.files import to_json
from seaopt.logs import RawLog, assess_quality
from seaopt.logs.log.saturation import mask_saturated
from seaopt.logs.quality.channel import assess_channel
from seaopt.logs.quality.clock import advise_clock, measure_steps, timestamp_resolution
from seaopt.logs.quality.faults import count_repeats, find_quantisation, find_runs
from seaopt.logs.quality.lags import correlate_channels
from seaopt.logs.quality.spectra import compute_spectra
from seaopt.signals import Signal, median

GRAVE = ("error", "warning")


MOTOR = ["time", "iq_adx", "theta_mx", "theta_my"]


def channels(log):
    return {name: log[name].copy() for name in log.signals}


def table(log, time=None, **changed):
    values = channels(log) | changed
    units = {name: signal.unit for name, signal in log.signals.items()}
    signals = {name: Signal(name=name, values=array, unit=units.get(name, "")) for name, array in values.items()}
    return RawLog(time=log.time.copy() if time is None else time, signals=signals, source="test")


def grave(quality):
    return [(item.kind, item.channel) for item in quality.findings if item.severity in GRAVE]


def test_a_clean_log_has_no_fault(short_log):
    assert grave(short_log.quality) == []


@pytest.mark.parametrize("kind", ["swing", "two_link", "rotary", "multisine", "quiet", "chirp"])
def test_no_false_alarm(kind, stand, swing, thor):
    noise = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0})
    sine = (Multisine(amplitudes=(1.0,) * 40, frequencies_hz=tuple(2.5 * k for k in range(1, 41))),)
    log = {
        "swing": lambda: so.virtual_log(swing, thor, PAPER_SWING, duration_s=20, rate_hz=400, seed=1, sensors=noise),
        "two_link": lambda: so.virtual_log(
            so.plants.two_link(link1="mass", link2="mass"), thor, PAPER_SWING, duration_s=20, rate_hz=400, seed=2
        ),
        "rotary": lambda: so.virtual_log(
            so.plants.rotary(), so.plants.rotary().defaults, PAPER_STAND, duration_s=20, rate_hz=1000, seed=3
        ),
        "multisine": lambda: so.virtual_log(stand, thor, sine, duration_s=20, rate_hz=400, seed=4, sensors=noise),
        "quiet": lambda: so.virtual_log(stand, thor, PAPER_STAND, duration_s=20, rate_hz=400, seed=5),
        "chirp": lambda: so.virtual_log(
            stand, thor, PAPER_STAND[:1], duration_s=60, rate_hz=400, seed=6, sensors=noise
        ),
    }[kind]()  # fmt: skip
    assert [item for item in grave(log.quality) if item[0] != "constant"] == []


def test_the_clock_s_faults_are_counted(short_log):
    time = short_log.time.copy()
    time[500] = time[499]
    time[900], time[901] = time[901], time[900]
    time[1500] = np.nan
    time[3000:] += 0.1  # 40 samples
    time[6000:] += 0.025  # 10 samples
    quality = assess_quality(table(short_log, time))
    assert quality.of("duplicate")[0].count == 1
    assert quality.of("duplicate")[0].where_s[0][0] == pytest.approx(time[500])
    assert quality.of("backwards")[0].count == 1
    assert quality.of("time_missing")[0].count == 1
    gap = max(quality.of("gap"), key=lambda item: item.value)
    assert gap.value >= 50
    assert (time[2999], time[3000]) in gap.where_s and (time[5999], time[6000]) in gap.where_s
    assert quality.clock.lost[list(quality.clock.gaps).index(3000)] == 40


def test_jitter_is_measured(short_log):
    rng = np.random.default_rng(0)
    shaken = short_log.time + 0.0025 * rng.uniform(-0.1, 0.1, len(short_log))
    quality = assess_quality(table(short_log, shaken))
    step = np.diff(shaken)
    assert quality.clock.jitter_rms == pytest.approx(np.std(step), rel=1e-3)
    assert quality.clock.jitter_max == pytest.approx(np.max(np.abs(step - 0.0025)), rel=1e-2)
    assert not quality.clock.rounded_only
    assert "log.resample(rate_hz=400)" in quality.of("jitter")[0].sentence


@pytest.mark.parametrize("how", [np.round, np.floor])
def test_rounded_timestamps_are_told_from_jitter(short_log, how):
    quality = assess_quality(table(short_log, how(short_log.time * 1000) / 1000))
    assert quality.clock.rounded_only
    assert quality.clock.rounding == pytest.approx(1e-3)
    assert "log.restamp()" in quality.of("jitter")[0].sentence


def test_small_jitter_is_no_finding(short_log):
    shaken = short_log.time + 0.0025 * np.random.default_rng(0).uniform(-0.01, 0.01, len(short_log))
    assert not assess_quality(table(short_log, shaken)).of("jitter")


def test_missing_samples_are_counted(short_log):
    holed = short_log["F1"].copy()
    holed[100:140] = np.nan
    holed[700] = np.inf
    finding = assess_quality(table(short_log, F1=holed)).of("missing")[0]
    assert (finding.channel, finding.count) == ("F1", 41)
    assert finding.where_s[0] == (short_log.time[100], short_log.time[139])


def test_a_channel_without_numbers_is_an_error(short_log):
    finding = assess_quality(table(short_log, F1=np.full(len(short_log), np.nan))).of("missing")[0]
    assert finding.severity == "error"


def test_a_constant_channel_is_found(short_log):
    assert assess_quality(table(short_log, F2=np.full(len(short_log), 3.0))).of("constant")[0].channel == "F2"


@pytest.mark.parametrize(("unit", "held"), [("rad", True), ("m/s", True), ("N", False), ("A", False)])
def test_a_motion_that_stands_still_may_be_that_of_a_link_that_is_held(short_log, unit, held):
    still = Signal(name="link", values=np.full(len(short_log), 0.3), unit=unit)
    log = RawLog(time=short_log.time, signals={"F1": short_log.signals["F1"], "link": still}, source="test")
    (finding,) = assess_quality(log).of("constant")
    assert ("link is held" in finding.sentence) == held and "wiring" in finding.sentence


@pytest.mark.parametrize("length", [15, 200])
@pytest.mark.parametrize("quantum", [0.0, 0.5])
def test_a_frozen_sensor_is_stuck(short_log, length, quantum):
    frozen = short_log["F1"].copy()
    frozen = quantum * np.round(frozen / quantum) if quantum else frozen
    frozen[2000 : 2000 + length] = frozen[2000]
    frozen[-500:] = frozen[-500]
    finding = assess_quality(table(short_log, F1=frozen)).of("stuck")[0]
    assert (finding.channel, finding.count) == ("F1", 500 + length)
    assert finding.where_s[0] == (short_log.time[2000], short_log.time[1999 + length])


def test_samples_of_a_joint_that_stuck_are_to_be_left():
    """A mass of 1 kg under a sine of 3 N, with dry friction of 2 N: it sticks at each reversal."""
    time = np.arange(0.0, 10.0, 1e-3)
    force, position, speed = 3.0 * np.sin(2.0 * np.pi * time), np.zeros(time.size), 0.0
    for k in range(1, time.size):
        driven = speed + 1e-3 * force[k]
        speed = np.sign(driven) * max(abs(driven) - 2e-3, 0.0)
        position[k] = position[k - 1] + 1e-3 * speed
    signals = {"F": Signal(name="F", values=force, unit="N"), "x": Signal(name="x", values=position, unit="m")}
    (finding,) = assess_quality(RawLog(time=time, signals=signals, source="test")).of("stuck")
    assert finding.channel == "x"
    assert "If the joint stuck there, leave those samples, for a fit of friction needs them" in finding.sentence


def test_rest_and_coarse_encoders_are_not_stuck(short_log):
    values = channels(short_log)
    for name in values:
        values[name][:1500] = np.random.default_rng(1).normal(0, 1e-3 * np.std(values[name]), 1500)
    values["q"] = 1e-5 * np.round(values["q"] / 1e-5)
    assert not assess_quality(table(short_log, **values)).of("stuck")


def test_a_held_channel_says_its_own_rate(short_log):
    slow = np.repeat(short_log["F2"][::5], 5)
    assert assess_quality(table(short_log, F2=slow)).of("held", "F2")[0].count == 5


@pytest.mark.parametrize("share", [0.6, 0.75])
@pytest.mark.parametrize("sides", ["both", "high"])
def test_clipping_is_found_and_measured(short_log, share, sides):
    limit = share * np.max(np.abs(short_log["F1"]))
    clipped = np.clip(short_log["F1"], -limit if sides == "both" else -np.inf, limit)
    quality = assess_quality(table(short_log, F1=clipped))
    assert {rail.side for rail in quality.channels["F1"].rails} == ({"low", "high"} if sides == "both" else {"high"})
    assert all(rail.clear for rail in quality.channels["F1"].rails)
    assert quality.channels["F1"].saturated == np.count_nonzero(np.abs(clipped) == limit)
    assert {item.severity for item in quality.of("clipping")} == {"warning"}
    assert not quality.of("stuck")


def test_clipping_is_found_behind_an_outlier_and_a_converter(short_log):
    limit = 0.7 * np.max(np.abs(short_log["F1"]))
    clipped = 0.25 * np.round(np.clip(short_log["F1"], -limit, limit) / 0.25)
    clipped[1000] = 3 * limit
    quality = assess_quality(table(short_log, F1=clipped)).channels["F1"]
    assert [rail.clear for rail in quality.rails] == [True, True]
    assert quality.outliers.tolist() == [1000]


@pytest.mark.parametrize("kind", ["sine", "square", "rest"])
def test_what_is_no_clipping(kind):
    t = np.arange(8000) / 400
    values = {
        "sine": 0.02 * np.round(np.sin(2 * np.pi * 0.7 * t) / 0.02),
        "square": np.sign(np.sin(2 * np.pi * 0.7 * t + 0.1)),
        "rest": np.maximum(0.0, np.sin(2 * np.pi * 0.05 * t)) ** 2,
    }[kind]
    log = so.Log.from_arrays(time=t, F1=values, I=np.random.default_rng(0).normal(size=t.size))
    assert not [item for item in log.quality.of("clipping", "F1") if item.severity != "note"]


@pytest.mark.parametrize("step", [0.5, 7.0, 1e-3])
def test_the_quantisation_step_is_found(short_log, step):
    rounded = step * np.round(short_log["F1"] / step) + 0.3
    quality = assess_quality(table(short_log, F1=rounded))
    assert quality.channels["F1"].quantum == pytest.approx(step, rel=1e-6)
    assert quality.channels["F2"].quantum == 0.0


def test_outliers_are_found_where_they_are(short_log):
    wild, rows = short_log["F1"].copy(), [800, 1201, 1202, 4000, 7000]
    wild[rows] += np.array([900.0, -1200.0, -1300.0, 1000.0, -900.0])
    assert assess_quality(table(short_log, F1=wild)).channels["F1"].outliers.tolist() == rows


@pytest.mark.parametrize("mains", [50.0, 60.0])
def test_hum_is_measured(stand_log, mains):
    t = stand_log.time
    hum = 5.0 * np.sin(2 * np.pi * mains * t) + 3.0 * np.sin(2 * np.pi * 3 * mains * t + 1)
    quality = assess_quality(table(stand_log, F1=stand_log["F1"] + hum)).channels
    assert quality["F1"].hum.mains_hz == mains
    assert quality["F1"].hum.lines_hz == (mains, 3 * mains)
    assert quality["F1"].hum.rms == pytest.approx(np.sqrt((25 + 9) / 2), rel=0.1)
    assert quality["F2"].hum is None


@pytest.mark.parametrize("delay", [-3.0, 0.4, 2.3, 40.75])
def test_delays_are_found_to_a_fraction_of_a_sample(delay):
    n = 20000
    f = np.fft.rfftfreq(n)
    spectrum = np.fft.rfft(np.random.default_rng(3).normal(size=n)) * (f < 0.4)
    u = np.fft.irfft(spectrum, n)
    y = np.fft.irfft(spectrum * np.exp(-2j * np.pi * f * delay), n)
    log = so.Log.from_arrays(time=np.arange(n) / 1000, I=u, F1=y)
    (pair,) = log.quality.pairs
    assert 1000 * pair.lag_s == pytest.approx(delay, abs=0.06)
    (finding,) = log.quality.of("delay")
    assert finding.severity == ("warning" if delay < -1.5 else "note")


def test_a_sign_flip_is_an_error(short_log):
    quality = assess_quality(table(short_log, F2=-short_log["F2"]))
    assert quality.of("sign")[0].severity == "error"
    assert "opposite sign" in quality.of("sign")[0].sentence


def test_excitation_says_what_it_reaches(stand, thor):
    slow = (Noise(std=2.0, band_hz=8.0),)
    sensors = so.Sensors(noise_std={"F1": 0.5, "F2": 0.5})
    log = so.virtual_log(stand, thor, slow, duration_s=40, rate_hz=400, seed=1, sensors=sensors)
    excitation = log.quality.excitation["I"]
    assert excitation.usable_hz[1] == pytest.approx(8.0, abs=0.45)
    assert "nothing above 8" in excitation.sentence
    assert sum(band.share for band in excitation.bands) == pytest.approx(1.0)
    power = np.abs(np.fft.rfft(log["I"])[1:]) ** 2
    f = np.fft.rfftfreq(len(log), 1 / 400)[1:]
    band = next(band for band in excitation.bands if band.low_hz < 4.0 < band.high_hz)
    share = np.sum(power[(f >= band.low_hz) & (f < band.high_hz)]) / np.sum(power)
    assert band.share == pytest.approx(share, rel=0.25)


def test_an_input_that_nothing_answers_to_is_a_warning():
    rng = np.random.default_rng(0)
    log = so.Log.from_arrays(time=np.arange(8000) / 400, I=rng.normal(size=8000), F1=rng.normal(size=8000))
    assert log.quality.of("excitation")[0].severity == "warning"


def test_a_counter_shows_lost_samples(recorded):
    def read(name):
        rows = np.genfromtxt(recorded("formats") / "acqtools" / name, delimiter=",", skip_header=1, max_rows=27)
        return RawLog(
            time=1e-6 * rows[:, 0], signals={"msr": Signal(name="msr", values=rows[:, 1].copy())}, source=name
        )

    lost = assess_quality(read("Wmsr2_loss.csv"))
    gap = lost.of("gap")[0]
    assert (gap.channel, gap.value, gap.severity) == ("msr", 1.0, "error")
    assert gap.where_s[0][0] == pytest.approx(14 * 40e-6)
    assert not assess_quality(read("Wex1_noError.csv")).of("gap")
    assert not assess_quality(read("Wmsr1_ini.csv")).of("gap")


def test_a_swung_pendulum_s_encoder_is_not_stuck(recorded):
    rows = np.genfromtxt(recorded("ak80") / "data_measured.csv", delimiter=",", skip_header=1)
    log = so.Log.from_arrays(time=rows[:, 0], position=rows[:, 1], velocity=rows[:, 2], torque=rows[:, 3])
    quality = assess_quality(log, inputs=["torque"])
    assert grave(quality) == []
    assert quality.channels["position"].quantum == pytest.approx(0.0029145, rel=1e-4)
    assert quality.clock.rate_hz == pytest.approx(500, rel=1e-3)


def test_a_two_mass_drive_is_clean_and_its_load_angle_turned_around(recorded):
    content = scipy.io.loadmat(recorded("twomass") / "MultisineTypeA.mat", squeeze_me=True, variable_names=MOTOR)
    log = so.Log.from_arrays(
        time=content["time"], I=content["iq_adx"], motor=content["theta_mx"], load=content["theta_my"],
        units={"time": "us", "I": "A", "motor": "rad", "load": "rad"},
    )  # fmt: skip
    quality = log.quality
    assert grave(quality) == []
    assert next(item for item in quality.pairs if item.first == "motor").correlation < -0.8


def test_the_report_is_strict_json(short_log):
    broken = short_log["F1"].copy()
    broken[:30] = np.nan
    quality = assess_quality(table(short_log, F1=broken, F2=np.full(len(short_log), np.nan)))
    content = json.loads(to_json(quality.to_dict()))
    assert content["schema"] == "seaopt/quality/1"
    assert content["channels"]["F1"]["missing"] == 30
    assert content["counts"]["error"] == 1
    assert "missing" in repr(quality) and "<table>" in quality._repr_html_()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda log: assess_quality(log, inputs=["cur"]), 'inputs names "cur"'),
        (lambda log: assess_quality(table(log, np.zeros(len(log)))), "never increases"),
        (lambda log: assess_quality(so.Log.from_arrays(time=[0.0, 1.0])), "holds no channel"),
    ],
)
def test_what_cannot_be_judged_is_said(short_log, call, words):
    with pytest.raises(LogError, match=words):
        call(short_log)


@pytest.mark.parametrize("n", [2, 3, 5, 17, 40])
def test_short_logs_are_judged_as_far_as_they_go(n):
    rng = np.random.default_rng(n)
    log = so.Log.from_arrays(time=np.arange(n) / 10, I=rng.normal(size=n), F1=rng.normal(size=n))
    assert log.quality.clock.rate_hz == pytest.approx(10)
    assert grave(log.quality) in ([], [("excitation", "I")])


NUMBERS = st.one_of(
    st.sampled_from([0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 1e300, -1e300, 1e-300]), st.floats(-10, 10)
)


@given(
    seed=st.integers(0, 2**32 - 1),
    pool=st.lists(NUMBERS, min_size=1, max_size=5),
    steps=st.lists(st.sampled_from([1.0, 1.0, 1.0, 1.001, 0.0, -1.0, 5.0, np.nan, 1e9]), min_size=1, max_size=6),
    n=st.integers(2, 300),
)
def test_whatever_the_numbers_a_report_or_a_seaopt_error(seed, pool, steps, n):
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.choice(steps, n))
    signals = {
        "I": Signal(name="I", values=rng.choice(np.array(pool), n)),
        "F1": Signal(name="F1", values=rng.normal(size=n), unit="N"),
        "F2": Signal(name="F2", values=np.repeat(rng.choice(np.array(pool), -(-n // 3)), 3)[:n], unit="N"),
    }
    try:
        quality = assess_quality(RawLog(time=time, signals=signals, source="any"))
    except LogError:
        return
    json.loads(to_json(quality.to_dict()))
    assert repr(quality)


def answer_of_second_order(damping, rate=400.0, hz=8.0):
    """Return a log of noise through a second-order lag with a static gain of 3, by its exact discretisation."""
    omega, rng = 2 * np.pi * hz, np.random.default_rng(4)
    lag = scipy.signal.cont2discrete(([3 * omega**2], [1, 2 * damping * omega, omega**2]), 1 / rate)
    drive = rng.normal(size=16000)
    answer = scipy.signal.lfilter(lag[0].ravel(), lag[1], drive)
    return so.Log.from_arrays(
        time=np.arange(drive.size) / rate, I=drive, F1=answer + 0.01 * rng.normal(size=drive.size)
    )


@pytest.mark.parametrize(("damping", "peak", "half"), [(0.2, 8.0, 13.5), (1.0, None, 8.0), (4.0, None, 1.75)])
def test_a_peak_is_named_only_where_there_is_one(damping, peak, half):
    """Half of the largest gain, in closed form: of damping 0.2 at 13.5 Hz, of 1 at 8 Hz, of 4 at 1.75 Hz."""
    excitation = answer_of_second_order(damping).quality.excitation["I"]
    third = 2 ** (1 / 3)
    assert half / third < excitation.rolls_off_hz < half * third**2  # the first whole band that is below
    if peak is None:
        assert excitation.peak_hz is None and "without a peak" in excitation.sentence
    else:
        assert peak / third < excitation.peak_hz < peak * third
    assert "the response of F1 " in excitation.sentence


@pytest.mark.filterwarnings("error")
def test_numbers_beyond_any_sensor_are_an_error_and_in_no_figure():
    t = np.arange(4000) / 400
    rng = np.random.default_rng(0)
    drive, force = rng.normal(size=t.size), rng.normal(size=t.size)
    plain = so.Log.from_arrays(
        time=t, I=drive, F1=np.where(np.isin(np.arange(t.size), [50, 51]), np.nan, force)
    ).quality
    force[[50, 51]] = 1e300, -1e308
    quality = so.Log.from_arrays(time=t, I=drive, F1=force).quality
    (finding,) = quality.of("beyond")
    assert (finding.severity, finding.count, finding.where_s[0][0]) == ("error", 2, t[50])
    assert not quality.of("missing") and quality.channels["F1"].std == plain.channels["F1"].std
    assert not any("inf" in one.sentence or "nan" in one.sentence or "∞" in one.sentence for one in quality.findings)


def test_samples_at_the_ends_of_a_declared_range_are_masked():
    log = so.Log.from_arrays(time=np.arange(5) / 10, F1=[0.0, 8.0, 9.0, 9.0, 3.0], units={"F1": "N"})
    masked = mask_saturated(log, ["F1"], ranges={"F1": (-9.0, 9.0)}, search=True)
    np.testing.assert_array_equal(masked["F1"], [0.0, 8.0, np.nan, np.nan, 3.0])
    assert masked.notes == ("F1: 2 samples (40 %) at or beyond its declared range of -9 to 9 N masked",)


def test_a_clipped_sine_has_one_rail_and_is_never_stuck():
    channel = assess_channel(Signal(name="F1", values=np.clip(np.sin(np.arange(999.0)), -2, 0.8)))
    assert [(rail.side, rail.value) for rail in channel.rails] == [("high", 0.8)]
    assert channel.stuck.samples == 0


def test_steps_of_a_clock_their_rounding_and_what_to_do():
    rounded = np.round(np.arange(400) / 400, 3)
    assert timestamp_resolution(rounded) == pytest.approx(1e-3)
    assert timestamp_resolution(np.arange(400) / 400) == 0.0
    period, gap_s = measure_steps(np.tile([2.7e-3, 2.7e-3, 10e-3], 100))
    assert (1.0 / period, gap_s) == pytest.approx((3.0 / 15.4e-3, 0.02), abs=1e-3)
    assert advise_clock(0.0025, rounded=True) == ("call log.restamp()", [{"resample": "restamp"}])
    assert advise_clock(0.0025)[0].startswith("call log.resample(rate_hz=400), or log.restamp(rate_hz=400) where a PC")


def test_runs_steps_and_repeats_of_values():
    x = np.sin(np.arange(1000.0))
    assert find_runs(np.array([True, True, False, True])).stop.tolist() == [2, 4]
    assert find_quantisation(0.01 * np.round(x / 0.01)) == pytest.approx(0.01) and find_quantisation(x) == 0.0
    assert count_repeats(np.repeat(np.sin(np.arange(50.0)), 4)) == 4


def test_the_lag_of_one_channel_behind_another():
    x = np.random.default_rng(1).normal(size=4000)
    both = compute_spectra({"a": x[5:], "b": -x[:-5]}, [slice(0, 3995)], 0.01)
    pair = correlate_channels(both, "a", "b")
    assert pair.lag_s == pytest.approx(0.05, abs=1e-3) and pair.correlation < -0.9


@pytest.mark.parametrize(
    "values", [[3.0], [1.0, 4.0], [5.0, -1.0, 2.0, 2.0], [np.nan, 1.0, 2.0], [np.inf, 0.0, 1.0, np.inf]]
)
def test_the_median_is_numpys(values):
    assert median(np.array(values)) == pytest.approx(np.median(values), nan_ok=True)


def test_the_median_of_many_is_numpys():
    for size in (1000, 1001):
        values = np.random.default_rng(size).normal(size=size)
        assert median(values) == np.median(values)
